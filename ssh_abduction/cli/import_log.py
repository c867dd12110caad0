"""ssh-abduction import LOG: make a trace from a robot's log."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from ssh_abduction.cli.options import add_output, check_output, write
from ssh_abduction.cli.outcome import StopFlag, on_ctrl_c, warn
from ssh_abduction.cli.parsing import Parser, Verbs
from ssh_abduction.cli.text import counted
from ssh_abduction.data.errors import AbductionError
from ssh_abduction.runtime import program

if TYPE_CHECKING:
    from perception.places.distinctive import Visit
    from perception.places.importing import Imported
    from perception.readers.scans import RobotLog


Item = TypeVar("Item")

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
    parser = verbs.add(
        "import",
        run,
        "make a trace from a robot's log",
        "Read a robot's log of laser scans and odometry, find the distinctive places that it "
        "passed, and write a trace with views, stars, displacements and actions. Corrected "
        "poses in the log become the truth, which only the command 'evaluate' uses.",
    )
    parser.add(
        "log",
        "a CARMEN log, a g2o-style log with scans, a ROS 1 bag, a ROS 2 bag or MCAP; may be "
        "compressed by gzip, bzip2, xz or zstd. '-' reads a CARMEN log from standard input, with "
        "little memory, and shows each place when it is final",
    )
    add_output(parser)
    add_reading(parser)


def add_reading(parser: Parser) -> None:
    """Add the options that say how to read a log, and how wide the robot is."""
    group = parser.add_argument_group("reading logs")
    said = "format of the log (default: guessed from its content)"
    parser.add("--format", said, to=group, choices=FORMATS)
    said = f"width of the robot in metres; it cannot pass narrower gaps (default: {WIDTH:g})"
    parser.add("--width METRES", said, to=group, type=metres)
    parser.add_setting(
        "fov DEGREES",
        "the angle from the first to the last beam of the laser; negative for a laser mounted "
        "upside down (default: from the log, else 180)",
        type=partial(_laser_value, "fov"),
    )
    said = "topic of the scans, if a bag has several; may be given again to read several lasers"
    parser.add_setting("scan_topic TOPIC", said, many=True)
    parser.add_setting("odom_topic TOPIC", "topic of the odometry, if a bag has several")
    parser.add_setting(
        "mount X,Y,DEGREES",
        "where the laser is on the robot: metres ahead of the centre, metres to the left, and "
        "degrees to the left of straight ahead (default: from the log, else 0,0,0)",
        type=partial(_laser_value, "mount"),
    )
    parser.add_setting(
        "no_return METRES",
        "a range of at least this length means that the beam hit nothing (default: the "
        "laser's maximum range, or a shorter range that often repeats and is no wall)",
        type=partial(_laser_value, "no_return"),
    )
    parser.add_setting(
        "zero_is",
        "how to read ranges that are NaN, at most 0, or below the laser's minimum: free means "
        "that the beam hit nothing, unknown that nothing is known (default: free if the "
        "neighbouring beams are long, else unknown)",
        choices=MEANINGS,
    )


def metres(text: str) -> float:
    """Convert text to metres, from 0.1 to 50. Raise ArgumentTypeError for anything else."""
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not 0.1 <= value <= 50:
        raise argparse.ArgumentTypeError(
            f"expected metres, from 0.1 to 50, got {text!r}; give the width of the robot"
        )
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


def _laser_value(field: str, text: str) -> Any:
    """Convert numbers separated by commas to the value of a field of `LaserOptions`; check it."""
    from perception.readers.echoes import LaserOptions

    try:
        numbers = tuple(map(float, text.split(",")))
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"expected numbers, got {text!r}; separate them by commas"
        ) from None
    value = numbers if field == "mount" or len(numbers) != 1 else numbers[0]
    given: dict[str, Any] = {field: value}
    try:
        LaserOptions(**given)
    except AbductionError as error:
        raise argparse.ArgumentTypeError(str(error).partition(": ")[2]) from None
    return value


def run(options: argparse.Namespace) -> int:
    check_output(options.output, "the trace")
    log, done = (_live if options.log == "-" else _whole)(options, lambda note: warn([note]))
    said = (
        f"{counted(len(log), 'scans')}, {done.track.way[-1]:.0f} m: "
        f"{counted(len(done.visits), 'visits')} to distinctive places; "
        f"{counted(len(done.trace), 'steps')}"
    )
    write(done.trace, options.output, said)
    return 0


def _whole(options: argparse.Namespace, tell: Callable[[str], None]) -> tuple[RobotLog, Imported]:
    """Import the log in a file."""
    log = read(options.log, options)
    for warning in log.warnings:
        tell(warning)
    # Imported late, so that a log that cannot be read is refused at once.
    from perception.places.importing import import_log

    return log, import_log(log, options.width or WIDTH, named_after(options.log), tell)


def _live(options: argparse.Namespace, tell: Callable[[str], None]) -> tuple[RobotLog, Imported]:
    """Import the log on standard input as it arrives, and print each visit once it is final.

    Ctrl-C ends the log: the trace is that of the drive so far.
    """
    from perception.places.importing import import_live
    from perception.readers.logs import live_log

    if options.format not in (None, "carmen") or options.scan_topic or options.odom_topic:
        raise AbductionError(
            "-: expected lines of CARMEN on standard input, got another format or a topic; save "
            "the log to a file, and name that"
        )
    if sys.stdin is None:
        raise AbductionError("standard input: expected a log, got a closed stream; name a file")
    asked = {name: getattr(options, name) for name in ("fov", "mount", "no_return", "zero_is")}
    items = live_log(sys.stdin.buffer, **asked, tell=tell)
    numbers, output = count(), sys.stderr if options.output == "-" else sys.stdout

    def show(visit: Visit) -> None:
        x, y = visit.middle
        where = f"({x:.1f}, {y:.1f}) m with {counted(len(visit.ways), 'ways')}"
        scans = f"scans {visit.begin} to {visit.end}"
        print(f"visit {next(numbers)}, {scans}: a place at {where}", file=output, flush=True)

    with until_ctrl_c(items, StopFlag()) as some:
        log, done = import_live(some, options.width or WIDTH, None, tell, show, "-")
    if more := len(done.visits) - next(numbers):
        ways = f"{counted(more, 'more visits')} where stretches of it diverge"
        print(f"at the end of the drive: {ways}", file=output)
    for warning in log.warnings:
        tell(warning)
    return log, done


@contextmanager
def until_ctrl_c(items: Iterator[Item], stop: StopFlag) -> Iterator[Iterator[Item]]:
    """Yield an iterator over items that ends at Ctrl-C, which sets `stop`."""
    waits = False

    def end() -> None:
        is_first = not stop.is_set()
        stop.ask()
        if is_first and waits:  # else the item that came last is still in use
            raise KeyboardInterrupt

    def some() -> Iterator[Item]:
        nonlocal waits
        while not stop.is_set():
            try:
                waits = True
                item = next(items)
                waits = False
            except (StopIteration, KeyboardInterrupt):
                break
            yield item
        if stop.is_set():
            program.raised.append(program.heard[-1])  # for the exit code
            print("ssh-abduction: interrupted: the log ends here", file=sys.stderr)

    with on_ctrl_c(end):
        yield some()


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
