"""ssh-abduction import LOG: a robot's log becomes a trace."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ssh_abduction.cli.options import Verbs, add_output, write
from ssh_abduction.cli.parsing import Parser
from ssh_abduction.cli.text import counted
from ssh_abduction.data.errors import AbductionError, named

if TYPE_CHECKING:
    from perception.readers.scans import RobotLog


# Those of perception.readers.logs, which would take long to load before it is known what is asked.
FORMATS = ("carmen", "g2o", "ros1", "ros2", "mcap")
PLACES = ("junctions", "doors")
# What the name of a file ends in that says how it is packed, and then what is in it.
ENDINGS = (
    ("gz", "bz2", "xz", "zst", "zstd", "lz4"),
    ("log", "clf", "carmen", "txt", "g2o", "graph", "toro", "bag", "mcap", "db3"),
)
# Those of perception.readers.echoes.
MEANINGS = ("free", "unknown")


def add_parser(verbs: Verbs) -> None:
    text = (
        "Read a robot's log of laser scans and odometry, find the distinctive places that it "
        "passed, and write a trace: views, stars, displacements, and the "
        "actions between. Corrected poses in a log become truth for evaluation; nothing that "
        "infers reads them."
    )
    parser = verbs.add_parser("import", help="make a trace of a robot's log", description=text)
    parser.add_argument(
        "log",
        help=(
            "CARMEN log or g2o-style log with scans, ROS 1 bag, ROS 2 bag, or MCAP; packed by "
            "gzip, bzip2, xz or zstd, too"
        ),
    )
    add_output(parser)
    add_reading(parser)
    parser.set_defaults(run=run)


def add_reading(parser: Parser) -> None:
    """Add the options that say how a log is read, and at which scale a building is looked at."""
    group = parser.add_argument_group("reading logs")
    group.add_argument(
        "--format", choices=FORMATS, help="format of the log (default: guessed from what is in it)"
    )
    group.add_argument(
        "--fov",
        type=partial(_told, "fov"),
        metavar="DEGREES",
        help="the angle that the beams cover; negative for a laser that hangs upside down "
        "(default: as the log says, else 180)",
    )
    group.add_argument(
        "--places",
        choices=PLACES,
        help="what the places are: where ways part or bend (junctions), or the doors that the "
        "robot drives through (doors) (default: doors where most of its way is wide and often "
        "leads through doors, and neither gateway nor radius is set; else junctions)",
    )
    parser.add_setting(
        "scan_topic",
        "topic of the scans in a bag with several; set it again to read several lasers at once",
        metavar="TOPIC",
        many=True,
    )
    parser.add_setting("odom_topic", "topic of the odometry in a bag with several", metavar="TOPIC")
    parser.add_setting(
        "mount",
        "where the laser sits on the robot: metres ahead of its middle, metres to the left, and "
        "degrees to the left of straight ahead (default: as the log says, else 0,0,0)",
        type=partial(_told, "mount"),
        metavar="X,Y,DEGREES",
    )
    parser.add_setting(
        "no_return",
        "ranges from here on mean that nothing came back (default: the laser's reach, or a "
        "shorter range that repeats and is no wall)",
        type=partial(_told, "no_return"),
        metavar="METRES",
    )
    parser.add_setting(
        "zero_is",
        "what a range of 0, below 0, below the laser's least range, or NaN means: nothing came "
        "back (free), or nothing is known (unknown) (default: free where the beams beside it "
        "are long)",
        choices=MEANINGS,
    )
    parser.add_setting("gateway", "the least width of a gateway", type=metres, metavar="METRES")
    parser.add_setting(
        "radius",
        "how far a way out must lead from the middle of a place",
        type=metres,
        metavar="METRES",
    )


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
    """A log, as the options say. Raises AbductionError."""
    from perception.readers.logs import read_log

    return read_log(path, **reading_of(options))


def reading_of(options: argparse.Namespace) -> dict[str, Any]:
    """How a log is to be read, as arguments of `read_log`."""
    return {
        name: getattr(options, name)
        for name in ("format", "scan_topic", "odom_topic", "fov", "mount", "no_return", "zero_is")
    }


def _told(field: str, text: str) -> Any:
    """What the user says of the laser, in a field of `Told`, which knows what it may be."""
    from perception.readers.echoes import Told

    try:
        numbers = tuple(map(float, text.split(",")))
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected numbers, got {text!r}") from None
    value = numbers if field == "mount" or len(numbers) != 1 else numbers[0]
    told: dict[str, Any] = {field: value}
    try:
        Told(**told)
    except AbductionError as error:
        raise argparse.ArgumentTypeError(str(error).partition(": ")[2]) from None
    return value


def run(options: argparse.Namespace) -> int:
    from perception.places.importing import import_log
    from ssh_abduction.cli.outcome import warn

    if options.log == "-":
        raise AbductionError("-: expected the file of a log, got standard input; save it to a file")
    if options.output != "-" and not Path(options.output).absolute().parent.is_dir():
        raise AbductionError(
            f"{named(options.output)}: cannot write the trace: its folder is not there; make it "
            "first"
        )
    doors = doors_of(options)
    log = read(options.log, options)
    warn(log.warnings)
    done = import_log(log, options.gateway, options.radius, named_after(options.log), doors)
    warn(done.notes)
    scale = done.scale
    places = (
        "doors"
        if scale.doors
        else (
            f"distinctive places at a radius of {scale.radius:g} m, gateways from "
            f"{scale.gateway:g} m"
        )
    )
    said = (
        f"{counted(len(log), 'scans')}, {done.track.way[-1]:.0f} m: "
        f"{counted(len(done.visits), 'visits')} to {places}; {counted(len(done.trace), 'steps')}"
    )
    write(done.trace, options.output, said)
    return 0


def doors_of(options: argparse.Namespace) -> bool | None:
    """Whether doors are the places, as asked; None where the log is to tell.

    Raises AbductionError for a scale of junctions where doors are asked for.
    """
    if options.places is None:
        return None
    doors = bool(options.places == "doors")
    for name, given in (("gateway", options.gateway), ("radius", options.radius)):
        if doors and given is not None:
            raise AbductionError(
                f"{name}: expected none with --places doors, got {given:g}; it is about ways that "
                "part, so leave it out, or ask for junctions"
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
