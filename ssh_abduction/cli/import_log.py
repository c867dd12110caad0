"""ssh-abduction import LOG: make a trace of a robot's log."""

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


# Repeats perception.readers.logs, whose import would delay all verbs.
FORMATS = ("carmen", "g2o", "ros1", "ros2", "mcap")
# Repeats perception.places.distinctive.
WIDTH = 0.5
# Endings of file names: first those of compression, then those of formats.
ENDINGS = (
    ("gz", "bz2", "xz", "zst", "zstd", "lz4"),
    ("log", "clf", "carmen", "txt", "g2o", "graph", "toro", "bag", "mcap", "db3"),
)
# Repeats perception.readers.echoes.
MEANINGS = ("free", "unknown")


def add_parser(verbs: Verbs) -> None:
    text = (
        "Read a robot's log of laser scans and odometry, find the distinctive places that it "
        "passed, and write a trace with views, stars, displacements and actions. Corrected "
        "poses in the log become the truth for evaluate. No other command uses them."
    )
    parser = verbs.add_parser("import", help="make a trace of a robot's log", description=text)
    parser.add_argument(
        "log",
        help=(
            "a CARMEN log, a g2o-style log with scans, a ROS 1 bag, a ROS 2 bag or MCAP; may be "
            "compressed by gzip, bzip2, xz or zstd"
        ),
    )
    add_output(parser)
    add_reading(parser)
    parser.set_defaults(run=run)


def add_reading(parser: Parser) -> None:
    """Add the options that say how to read a log, and how wide the robot is."""
    group = parser.add_argument_group("reading logs")
    group.add_argument(
        "--format", choices=FORMATS, help="format of the log (default: guessed from its content)"
    )
    group.add_argument(
        "--fov",
        type=partial(_told, "fov"),
        metavar="DEGREES",
        help=(
            "the angle from the first to the last beam of the laser; negative for a laser mounted "
            "upside down (default: from the log, else 180)"
        ),
    )
    group.add_argument(
        "--width",
        type=metres,
        metavar="METRES",
        help=(
            "width of the robot. Narrower parts of the free space are no ways for it (default: "
            f"{WIDTH:g})"
        ),
    )
    parser.add_setting(
        "scan_topic",
        "topic of the scans, if a bag has several; may be given again to read several lasers",
        metavar="TOPIC",
        many=True,
    )
    parser.add_setting("odom_topic", "topic of the odometry, if a bag has several", metavar="TOPIC")
    parser.add_setting(
        "mount",
        (
            "where the laser is on the robot: metres ahead of the centre, metres to the left, and "
            "degrees to the left of straight ahead (default: from the log, else 0,0,0)"
        ),
        type=partial(_told, "mount"),
        metavar="X,Y,DEGREES",
    )
    parser.add_setting(
        "no_return",
        (
            "a range of at least this length means that the beam hit nothing (default: the "
            "laser's maximum range, or a shorter range that often repeats and is no wall)"
        ),
        type=partial(_told, "no_return"),
        metavar="METRES",
    )
    parser.add_setting(
        "zero_is",
        (
            "how to read ranges that are NaN, at most 0, or below the laser's minimum: free means "
            "that the beam hit nothing, unknown that nothing is known (default: free if the "
            "neighbouring beams are long, else unknown)"
        ),
        choices=MEANINGS,
    )


def metres(text: str) -> float:
    """Convert text to metres, from 0.1 to 50. Raise ArgumentTypeError for anything else."""
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not 0.1 <= value <= 50:
        raise argparse.ArgumentTypeError(f"expected metres, from 0.1 to 50, got {text!r}")
    return value


def read(path: str, options: argparse.Namespace) -> RobotLog:
    """Read the log at `path` as the options say. Raises AbductionError."""
    from perception.readers.logs import read_log

    return read_log(path, **reading_of(options))


def reading_of(options: argparse.Namespace) -> dict[str, Any]:
    """Collect the options that are arguments of `read_log`, by name."""
    return {
        name: getattr(options, name)
        for name in ("format", "scan_topic", "odom_topic", "fov", "mount", "no_return", "zero_is")
    }


def _told(field: str, text: str) -> Any:
    """Convert text to the value of a field of `Told`, which describes the laser, and check it.

    Args:
        field: The name of the field.
        text: A number, or numbers separated by commas.
    """
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
    log = read(options.log, options)
    warn(log.warnings)
    done = import_log(
        log, options.width or WIDTH, named_after(options.log), lambda note: warn([note])
    )
    said = (
        f"{counted(len(log), 'scans')}, {done.track.way[-1]:.0f} m: "
        f"{counted(len(done.visits), 'visits')} to distinctive places; "
        f"{counted(len(done.trace), 'steps')}"
    )
    write(done.trace, options.output, said)
    return 0


def named_after(path: str) -> str:
    """Return the name of a log file without its endings, to name its trace and its run's folder."""
    name = Path(path).name
    if not name.strip("."):
        name = Path(path).resolve().name
    for endings in ENDINGS if not Path(path).is_dir() else ():
        stem, _, ending = name.rpartition(".")
        if ending.lower() in endings and stem.strip("."):
            name = stem
    return name if name.strip(".") else "log"
