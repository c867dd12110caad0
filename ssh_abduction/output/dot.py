"""Write a map in DOT, the language of Graphviz."""

from __future__ import annotations

from ssh_abduction.data.errors import printable
from ssh_abduction.data.maps import DState, SSHMap, checked_map
from ssh_abduction.data.regions import course_named, ids_at, list_in_words


def to_dot(ssh_map: SSHMap) -> str:
    """Write the dstates and links of a map as DOT text.

    Each dstate (distinctive state: a place and a heading) is a node, each link an edge, and each
    place a cluster of nodes. A region behind one place is a cluster of places.

    Raises:
        MapError: `ssh_map` is not a map.
    """
    checked_map(ssh_map)
    lines = ["digraph map {", "  node [shape=box, style=rounded];"]
    lines += [f"  {_node(s, ssh_map)}" for s in ssh_map.dstates if s.place is None]
    lines += _clusters(ssh_map, {*ssh_map.places}, 0)
    lines += [
        f"  {source} -> {target} [label={_quoted(action)}];"
        for source, action, target in ssh_map.links
    ]
    return "\n".join([*lines, "}"])


def _clusters(ssh_map: SSHMap, places: set[int], after: int, indent: str = "  ") -> list[str]:
    """Write a cluster for each place and, around these, one for each region behind one place.

    Of two such regions, one contains the other, or they have no place in common. The largest come
    first.
    """
    lines, left = [], set(places)
    for region in (ssh_map.regions or ())[after:]:
        if region.door is not None and left >= {*region.places}:
            door = ssh_map.called("place", region.door)
            label = _quoted(f"{ssh_map.called('region', region.id)}, behind {door}")
            lines.append(f"{indent}subgraph cluster_region_{region.id} {{ label={label};")
            lines += _clusters(ssh_map, {*region.places}, region.id + 1, f"{indent}  ")
            lines.append(f"{indent}}}")
            left -= {*region.places}
    for p in (p for p in ssh_map.places if p in left):
        inside = " ".join(_node(s, ssh_map) for s in ssh_map.dstates if s.place == p)
        bounds = {c for r in ssh_map.regions or () if p in r.places for c in r.bounds}
        beside = f"\nright of {list_in_words(map(course_named, sorted(bounds)))}" if bounds else ""
        names = (ssh_map.name_of("region", r) for r in ids_at(ssh_map.regions, p))
        beside += "".join(f"\nin {name}" for name in names if name is not None)
        label = _quoted(ssh_map.called("place", p) + beside)
        lines.append(f"{indent}subgraph cluster_{p} {{ label={label}; {inside} }}")
    return lines


def _node(s: DState, ssh_map: SSHMap) -> str:
    course = f"\npath {s.course}" if s.course else ""
    name = ssh_map.name_of("path", s.path)
    course += "" if name is None else f" ({name})"
    course += "" if s.floor is None else f"\nfloor {s.floor}"
    return f"{s.id} [label={_quoted(f'{s.id}: {s.shown}{course}')}];"


def _quoted(text: str) -> str:
    """Quote text as a DOT string, and escape control characters of terminals."""
    lines = (printable(line).replace("\\", "\\\\").replace('"', '\\"') for line in text.split("\n"))
    return '"' + "\\n".join(lines) + '"'
