"""ssh-abduction map LOG …: map buildings from robots' logs, each into a folder."""

from __future__ import annotations

import argparse

from ssh_abduction.cli.import_log import add_reading
from ssh_abduction.cli.options import add_jobs, add_max_maps, add_theory, output
from ssh_abduction.cli.parsing import Verbs


def add_parser(verbs: Verbs) -> None:
    parser = verbs.add(
        "map",
        run,
        "map a building from a robot's log",
        "Find the minimal maps of a building from a robot's log. Writes trace.jsonl, maps.json, "
        "page.html, report.html and run.json into a folder. With several logs, each gets its own "
        "folder, and its result is one line. Logs that are already mapped with the same settings "
        "are skipped. With --together, the logs are drives through one building, and get one map.",
    )
    parser.add(
        "logs",
        "a CARMEN log, a g2o-style log with scans, a ROS 1 bag, a ROS 2 bag or MCAP; may be "
        "compressed by gzip, bzip2, xz or zstd",
        nargs="+",
        metavar="log",
    )
    parser.add("--together", "the logs are drives through one building: find their joint maps")
    said = "folder to write; each of several logs gets a folder inside it"
    parser.add("-o --output FOLDER", said, type=output, required=True)
    add_max_maps(parser, "minimal maps", 300)
    parser.add(
        "--work-limit W",
        "units of work for the search, each about a second of a quiet core; the same map on each "
        "machine (default: the time limit or, without one, a unit for 20 seconds that the robot "
        "drove, less a quarter for the ladder, and at least 30; a search that has no map then goes "
        "on for up to 64 times as long)",
        type=float,
    )
    parser.add("--time-limit S", "end the search after S seconds in any case", type=float)
    said = (
        "whether to compute how much each kind of evidence helps; this takes up to a quarter of "
        "the work limit after the search, or a few units if that is more (default: true)"
    )
    parser.add_setting("ladder", said, default=True)
    parser.add_setting(
        "again", "whether to map also logs that are already mapped (default: false)", default=False
    )
    add_jobs(parser, "map", "logs")
    add_reading(parser)
    left_out = "the axioms of stars, sides and paths, as logs do not show these reliably"
    add_theory(parser, default=f"topological, but without {left_out}")


def run(options: argparse.Namespace) -> int:
    from ssh_abduction.cli import mapping  # loads the code for many processes

    return mapping.run(options)
