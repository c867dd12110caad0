"""ssh-abduction map LOG …: from robots' logs to the maps of their buildings, a folder each."""

from __future__ import annotations

import argparse

from ssh_abduction.cli.import_log import add_reading
from ssh_abduction.cli.options import Verbs, add_theory, output
from ssh_abduction.cli.parsing import true_or_false


def add_parser(verbs: Verbs) -> None:
    text = (
        "From a robot's log to the minimal maps of the building: trace.jsonl, maps.json, "
        "page.html, report.html and run.json in a folder. Of several logs each has a folder "
        "of its own, and its result is a line; what is done already is not done again."
    )
    parser = verbs.add_parser("map", help="map a building from a robot's log", description=text)
    parser.add_argument(
        "logs",
        nargs="+",
        metavar="log",
        help=(
            "CARMEN log or g2o-style log with scans, ROS 1 bag, ROS 2 bag, or MCAP; packed by "
            "gzip, bzip2, xz or zstd, too"
        ),
    )
    parser.add_argument(
        "-o",
        "--output",
        type=output,
        required=True,
        metavar="FOLDER",
        help="folder to write; of several logs, the folder of their folders",
    )
    parser.add_argument(
        "-n",
        "--maps",
        type=int,
        default=300,
        metavar="K",
        help="list at most K minimal maps, 0 for all (default: 300)",
    )
    parser.add_argument(
        "--time-limit",
        type=float,
        metavar="S",
        help=(
            "seconds for the minimal maps (default: what is left of a twentieth of the time that "
            "the robot drove, and 5 at least)"
        ),
    )
    parser.add_setting(
        "ladder",
        "whether to work out what each kind of evidence is worth (default: true)",
        default=True,
        type=true_or_false,
        metavar="true|false",
    )
    parser.add_argument("--again", action="store_true", help="do again what is done already")
    many = parser.add_argument_group("many logs")
    many.add_argument(
        "--jobs",
        type=int,
        metavar="N",
        help="map N logs at a time, each in a process; -1 for one a core (default: 1)",
    )
    many.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="map on the workers of the Dask scheduler at this address, tcp://host:port",
    )
    add_reading(parser)
    add_theory(
        parser,
        default=(
            "topological; without stars and sides where doors are the places, where walls do not "
            "meet at right angles, and where no map fits the stars"
        ),
    )
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    from ssh_abduction.cli import mapping  # which loads what works in other processes

    return mapping.run(options)
