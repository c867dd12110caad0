"""ssh-abduction show MAPS: a map as text, or as a graph for other programs."""

from __future__ import annotations

import argparse

from ssh_abduction.cli.options import Verbs, check_number
from ssh_abduction.cli.text import describe
from ssh_abduction.data.errors import MapError
from ssh_abduction.data.map_file import read_json, write_map
from ssh_abduction.data.maps import maps_of


def add_parser(verbs: Verbs) -> None:
    text = "Show maps: dstates, places, paths, links."
    parser = verbs.add_parser(
        "show", help="show maps as text, DOT, GraphML or SVG", description=text
    )
    parser.add_argument("maps", help="what solve --json printed, or one saved map")
    parser.add_argument(
        "--map",
        type=int,
        metavar="I",
        help="only the I-th map, from 1 (default: all as text, the first otherwise)",
    )
    form = parser.add_mutually_exclusive_group()
    form.add_argument(
        "--dot", action="store_true", help="Graphviz DOT: a node a dstate, a cluster a place"
    )
    form.add_argument("--graphml", action="store_true", help="GraphML: a node a dstate")
    form.add_argument(
        "--svg",
        nargs="?",
        const="-",
        type=svg_file,
        metavar="FILE.svg",
        help="a picture: places, and paths as streets through them, in metres where displacements were used (without a name: to standard output)",
    )
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    from ssh_abduction import output

    maps = maps_of(read_json(options.maps), str(options.maps))
    check_number(options.map, maps, options.maps)
    if not maps:
        if options.dot or options.graphml or options.svg:
            raise MapError(
                f"{options.maps}: maps: expected one to draw, got none; see the status that solve printed"
            )
        print("no map")
        return 0
    chosen = maps[(options.map or 1) - 1]
    if options.dot:
        print(output.to_dot(chosen))
    elif options.graphml:
        print(output.to_graphml(chosen))
    elif options.svg:
        picture = output.to_svg(chosen)
        if options.svg == "-":
            print(picture)
        else:
            write_map(options.svg, picture, "picture", "--svg")
    elif options.map:
        print(describe(chosen))
    else:
        print("\n\n".join(f"map {i + 1}\n{describe(m)}" for i, m in enumerate(maps)))
    return 0


def svg_file(name: str) -> str:
    """A file that a map is drawn into. The name has to end in .svg, so that no file of maps is taken for it and replaced."""
    if name != "-" and not name.lower().endswith(".svg"):
        raise argparse.ArgumentTypeError(f"expected a name that ends in .svg, got {name!r}")
    return name
