"""ssh-abduction import LOG: a robot's log becomes a trace."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from ssh_abduction.cli.options import Verbs, add_output, write
from ssh_abduction.cli.text import counted
from ssh_abduction.errors import SSHError, named

if TYPE_CHECKING:
    from perception.readers.scans import RobotLog


# Those of perception.readers.logs, which would take long to load before it is known what is asked.
FORMATS = ("carmen", "g2o", "ros1", "ros2", "mcap")
PLACES = ("junctions", "doors")
# What the name of a file ends in that says how it is packed, and then what is in it.
ENDINGS = ("gz", "bz2", "xz", "zst", "zstd", "lz4"), ("log", "clf", "carmen", "txt", "g2o", "graph", "toro", "bag", "mcap", "db3")


def add_parser(verbs: Verbs) -> None:
    text = (
        "Read a robot's log of laser scans and odometry, find the distinctive places that it passed, and write a trace: views, stars, displacements, and the "
        "actions between. Corrected poses in a log become truth for evaluation; nothing that infers reads them."
    )
    parser = verbs.add_parser("import", help="make a trace of a robot's log", description=text)
    parser.add_argument(
        "log", help="CARMEN log or g2o-style log with scans, ROS 1 bag, ROS 2 bag, or MCAP; packed by gzip, bzip2, xz or zstd, too"
    )
    add_output(parser)
    add_reading(parser)
    parser.set_defaults(run=run)


def add_reading(parser: argparse.ArgumentParser) -> None:
    """Add the options that say how a log is read, and at which scale a building is looked at."""
    group = parser.add_argument_group("reading logs")
    group.add_argument("--format", choices=FORMATS, help="format of the log (default: guessed from what is in it)")
    group.add_argument(
        "--scan-topic",
        action="append",
        metavar="TOPIC",
        help="of a bag: the topic of the scans, where there are several; repeat it to read several lasers at once",
    )
    group.add_argument("--odom-topic", metavar="TOPIC", help="of a bag: the topic of the odometry, where there are several")
    scale = parser.add_argument_group(
        "scale", "which ways out of a place count; the log itself suggests it by the passages that the robot drove through"
    )
    scale.add_argument("--gateway", type=metres, metavar="M", help="the least width of a gateway, in metres")
    scale.add_argument(
        "--places",
        choices=PLACES,
        help="what the places are: where ways part or bend (junctions), or the doors that the robot drives through (doors) (default: doors where most of its way is wide and leads through doors often, and neither --gateway nor --radius is given; else junctions)",
    )
    scale.add_argument("--radius", type=metres, metavar="M", help="how far a way out must lead from the middle of a place, in metres")


def metres(text: str) -> float:
    """A length that a building may have."""
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not 0.1 <= value <= 50:
        raise argparse.ArgumentTypeError(f"expected metres, from 0.1 to 50, got {text!r}")
    return value


def read(path: str, options: argparse.Namespace) -> RobotLog:
    """A log, as the options say. Raises SSHError."""
    from perception.readers.logs import read_log

    return read_log(path, options.format, scan_topic=options.scan_topic, odom_topic=options.odom_topic)


def run(options: argparse.Namespace) -> int:
    from perception.places.importing import import_log
    from ssh_abduction.cli.outcome import warn

    if options.log == "-":
        raise SSHError("-: expected the file of a log, got standard input; save it to a file")
    if options.output != "-" and not Path(options.output).absolute().parent.is_dir():
        raise SSHError(f"{named(options.output)}: cannot write the trace: its folder is not there; make it first")
    doors = doors_of(options)
    log = read(options.log, options)
    warn([*log.notes, *damage(log)])
    done = import_log(log, options.gateway, options.radius, named_after(options.log), doors)
    warn(done.notes)
    scale = done.scale
    places = "doors" if scale.doors else f"distinctive places at a radius of {scale.radius:g} m, gateways from {scale.gateway:g} m"
    said = f"{counted(len(log), 'scans')}, {done.track.way[-1]:.0f} m: {counted(len(done.visits), 'visits')} to {places}; {counted(len(done.trace), 'steps')}"
    write(done.trace, options.output, said)
    return 0


def doors_of(options: argparse.Namespace) -> bool | None:
    """Whether doors are the places, as asked; None where the log is to tell. Raises SSHError for a scale of junctions where doors are asked for."""
    if options.places is None:
        return None
    doors = bool(options.places == "doors")
    for name, given in (("--gateway", options.gateway), ("--radius", options.radius)):
        if doors and given is not None:
            raise SSHError(
                f"{name}: expected none with --places doors, got {given:g}; it is about ways that part, so leave it out, or ask for junctions"
            )
    return doors


def named_after(path: str) -> str:
    """The name of a trace that is made of a log, and of the folder of its map: that of the file, without what says how it is written."""
    name = Path(path).name
    if not name.strip("."):
        name = Path(path).resolve().name
    for endings in ENDINGS if not Path(path).is_dir() else ():
        stem, _, ending = name.rpartition(".")
        if ending.lower() in endings and stem.strip("."):
            name = stem
    return name if name.strip(".") else "log"


def damage(log: RobotLog) -> list[str]:
    """What is to be said of the parts of a log that were skipped."""
    if not log.damaged:
        return []
    first = log.damaged[0]
    were = "was" if len(log.damaged) == 1 else "were"
    return [f"{counted(len(log.damaged), 'damaged parts')} of the log {were} skipped; the first is {first.line}: {first.what}"]
