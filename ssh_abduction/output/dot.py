"""Write a map in DOT, the language of Graphviz."""

from __future__ import annotations

from ssh_abduction.data.errors import printable
from ssh_abduction.data.maps import DState, SSHMap, checked_map


def to_dot(ssh_map: SSHMap) -> str:
    """Write the dstates and links of a map as DOT text.

    Each dstate (distinctive state: a place and a direction) is a node, each link an edge, and each
    place a cluster of nodes.

    Raises:
        MapError: `ssh_map` is not a map.
    """
    checked_map(ssh_map)
    lines = ["digraph map {", "  node [shape=box, style=rounded];"]
    lines += [f"  {_node(s, ssh_map)}" for s in ssh_map.dstates if s.place is None]
    for p in ssh_map.places:
        inside = " ".join(_node(s, ssh_map) for s in ssh_map.dstates if s.place == p)
        lines.append(
            f"  subgraph cluster_{p} {{ label={_quoted(ssh_map.called('place', p))}; {inside} }}"
        )
    lines += [
        f"  {source} -> {target} [label={_quoted(action)}];"
        for source, action, target in ssh_map.links
    ]
    return "\n".join([*lines, "}"])


def _node(s: DState, ssh_map: SSHMap) -> str:
    course = "" if s.path is None else f"\npath {s.path}{'+' if s.direction == 1 else '-'}"
    name = ssh_map.name_of("path", s.path)
    course += "" if name is None else f" ({name})"
    return f"{s.id} [label={_quoted(f'{s.id}: {s.shown}{course}')}];"


def _quoted(text: str) -> str:
    """Quote text as a DOT string, and escape control characters of terminals."""
    lines = (printable(line).replace("\\", "\\\\").replace('"', '\\"') for line in text.split("\n"))
    return '"' + "\\n".join(lines) + '"'
