"""ssh-abduction map LOG …: map buildings from robots' logs, each into a folder."""

from __future__ import annotations

import argparse

from ssh_abduction.cli.import_log import add_reading
from ssh_abduction.cli.options import Verbs, add_theory, output


def add_parser(verbs: Verbs) -> None:
    text = (
        "Find the minimal maps of a building from a robot's log. Writes trace.jsonl, "
        "maps.json, page.html, report.html and run.json into a folder. With several logs, "
        "each gets its own folder, and its result is one line. Logs that are already mapped with "
        "the same settings are skipped. With --together, the logs are drives through one building, "
        "and get one map."
    )
    parser = verbs.add_parser("map", help="map a building from a robot's log", description=text)
    parser.add_argument(
        "logs",
        nargs="+",
        metavar="log",
        help=(
            "a CARMEN log, a g2o-style log with scans, a ROS 1 bag, a ROS 2 bag or MCAP; may be "
            "compressed by gzip, bzip2, xz or zstd"
        ),
    )
    parser.add_argument(
        "--together",
        action="store_true",
        help="the logs are drives through one building: find their joint maps",
    )
    parser.add_argument(
        "-o",
        "--output",
        type=output,
        required=True,
        metavar="FOLDER",
        help="folder to write; each of several logs gets a folder inside it",
    )
    parser.add_argument(
        "-n",
        "--maps",
        type=int,
        default=300,
        metavar="K",
        help="list at most K minimal maps; 0 for all (default: 300)",
    )
    parser.add_argument(
        "--time-limit",
        type=float,
        metavar="S",
        help=(
            "seconds for the search (default: so many that the whole command takes a twentieth of "
            "the time that the robot drove, but at least 30). Without this option, a search that "
            "has no map by then goes on until it has one"
        ),
    )
    parser.add_setting(
        "ladder",
        "whether to compute how much each kind of evidence helps (default: true)",
        default=True,
    )
    parser.add_setting(
        "again", "whether to map also logs that are already mapped (default: false)", default=False
    )
    many = parser.add_argument_group("many logs")
    many.add_argument(
        "--jobs",
        type=int,
        metavar="N",
        help="map N logs at a time, each in its own process; -1 for one per core (default: 1)",
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
            "topological, but without the axioms of stars, sides and paths, which a log does not "
            "show reliably"
        ),
    )
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    from ssh_abduction.cli import mapping  # loads the code for many processes

    return mapping.run(options)
