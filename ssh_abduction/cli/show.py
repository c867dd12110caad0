"""ssh-abduction show and export: print maps, and write them in the formats of other programs."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

from ssh_abduction.cli.options import add_map, add_maps, check_number, output, trace_path
from ssh_abduction.cli.outcome import warn
from ssh_abduction.cli.parsing import Verbs
from ssh_abduction.cli.text import describe
from ssh_abduction.data.corrections import named_beside
from ssh_abduction.data.errors import MapError, said_of
from ssh_abduction.data.map_file import read_json
from ssh_abduction.data.map_parts import described
from ssh_abduction.data.maps import SSHMap, maps_of
from ssh_abduction.data.schema import FieldReader
from ssh_abduction.data.trace import Trace
from ssh_abduction.solver import drives_in


def add_show(verbs: Verbs) -> None:
    parser = verbs.add(
        "show",
        run_show,
        "print the dstates, places, paths and links of maps",
        "Print the dstates, places, paths, links and regions of maps.",
    )
    add_maps(parser)
    parser.add("--map I", "show only the map with this number, from 1 (default: all)", type=int)


def run_show(options: argparse.Namespace) -> int:
    data, where = read_json(options.maps), str(options.maps)
    maps = named_maps(maps_of(data, where), data, where)
    check_number(options.map, maps, options.maps)
    if not maps:
        print("no map")
        return 0
    if options.map:
        print(_with_regions(maps[options.map - 1]))
    else:
        print("\n\n".join(f"map {i + 1}\n{_with_regions(m)}" for i, m in enumerate(maps)))
    return 0


def _with_regions(ssh_map: SSHMap) -> str:
    """Describe a map and its regions: sets of places beside paths, or behind one place."""
    regions = [f"  {described(region, ssh_map.called)}" for region in ssh_map.regions or ()]
    return "\n".join([describe(ssh_map), *regions])


def named_maps(found: Sequence[SSHMap], data: Any, file: str) -> tuple[SSHMap, ...]:
    """Return the maps found in a file, with the names of corrections.yaml. Raises MapError."""
    steps = len(found[0].dstate_at) if found else 0
    drives = drives_in(FieldReader(file), data, steps) if found else ()
    return named_beside(found, drives, file)


# Repeats ssh_abduction.output.export, whose import of networkx would delay all verbs.
FORMATS = ("nav2", "tmap2", "graphml", "dot", "svg", "networkx-json")


def add_export(verbs: Verbs) -> None:
    parser = verbs.add(
        "export",
        run_export,
        "write a map for Nav2, tmap2, GraphML, DOT or networkx",
        "Write a map in the format of another program: a route graph for Nav2 (GeoJSON), a "
        "topological map for LCAS's topological_navigation (tmap2, YAML), GraphML, Graphviz "
        "DOT, SVG, or JSON for networkx.",
        "Positions are in metres from the first dstate if the map has poses. Otherwise they come "
        "from a layout, and a warning says so. docs/reference/formats.md describes each format.",
    )
    add_maps(parser)
    parser.add(
        "--to",
        "the format to write: nav2 and tmap2 are for programs that drive a robot, svg is a "
        "picture, and the others are graphs",
        required=True,
        choices=FORMATS,
    )
    add_map(parser)
    said = "the trace that was mapped; its turns give a better layout of a map without poses"
    parser.add("--trace TRACE", said, type=trace_path)
    parser.add(
        "-o --output FILE", "file to write (default: standard output)", default="-", type=output
    )
    parser.add_setting(
        "level",
        "what a node is: a place or a dstate (default: places for nav2 and tmap2 if the map "
        "has places, else dstates)",
        choices=("places", "dstates"),
    )
    parser.add_setting(
        "hide_undecided",
        "whether to leave out each place that the robot only passed, always between the same "
        "two neighbours (nav2 and tmap2 only; default: false)",
        default=False,
    )
    said = "in nav2 and tmap2 files (default:"
    parser.add_setting("name", f"the name of the map {said} ssh-abduction)", "ssh-abduction")
    parser.add_setting("frame", f"the name of the coordinate frame {said} map)", "map")


def run_export(options: argparse.Namespace) -> int:
    from ssh_abduction.data.map_file import write_map
    from ssh_abduction.output.export import export_doubts, export_map  # loads networkx
    from ssh_abduction.rivals.listing import Listing

    listing = Listing.load(options.maps)
    chosen = listing.maps[listing.number(options.map)]
    how: dict[str, Any] = {"level": options.level, "hide_undecided": options.hide_undecided}
    how["turns"] = None if options.trace is None else Trace.load(options.trace)
    with said_of(listing.source, MapError):
        text = export_map(chosen, options.to, name=options.name, frame=options.frame, **how)
    if options.output == "-":
        print(text.removesuffix("\n"))
    else:
        write_map(options.output, text.removesuffix("\n"))
    warn(export_doubts(chosen, options.to, **how))
    return 0
