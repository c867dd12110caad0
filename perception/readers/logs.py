"""Reads the scans of a robot's log in any of the known formats."""

from __future__ import annotations

import io
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import chain, islice
from pathlib import Path
from typing import IO, cast

from perception.errors import LogError
from perception.readers import bag_files, bags, carmen
from perception.readers.echoes import LaserOptions, interpret_log, interpreter_of
from perception.readers.lines import LONGEST_LINE, Piped, lines, piped, rereadable
from perception.readers.scans import Damage, RobotLog, Scan, ScanTable, SurveyedLog
from ssh_abduction.data.checks import a_list, a_path, a_text
from ssh_abduction.data.errors import brief, named
from ssh_abduction.data.odometry import Pose
from ssh_abduction.runtime.loggers import log_of

_log = log_of("ssh_abduction.perception.readers")

# Formats of logs, with descriptions.
LINES = {
    "carmen": "lines of CARMEN: FLASER, ROBOTLASER1 or RAWLASER1, and ODOM",
    "g2o": "lines of g2o or TORO: VERTEX2, EDGE2 and ROBOTLASER1",
}
BAGS = {
    "ros1": "a bag of ROS 1",
    "ros2": "a bag of ROS 2: a folder, or its file",
    "mcap": "a file of MCAP",
}
FORMATS = {**LINES, **BAGS}
# Number of first bytes that show a file's format.
HEAD = 2**16
# Number of first scans of a pipe that show what its poses and ranges mean.
SURVEYED = 200


def read_log(
    path: str | os.PathLike[str],
    format: str | None = None,
    *,
    scan_topic: str | Sequence[str] | None = None,
    odom_topic: str | None = None,
    fov: float | None = None,
    mount: Pose | None = None,
    no_return: float | None = None,
    zero_is: str | None = None,
    nearest: float | None = None,
    blind: tuple[float, float] | None = None,
) -> RobotLog:
    """Read a robot's log.

    Args:
        path: The file, or the folder of a ROS 2 bag.
        format: "carmen", "g2o", "ros1", "ros2" or "mcap". None finds it by the content of the file,
            not by its name.
        scan_topic: Topic of the scans in a bag, or a sequence of topics; needed if there are
            several.
        odom_topic: Topic of the odometry in a bag; needed if there are several.
        fov: Degrees from the first beam to the last, counterclockwise, if the log does not say it
            or is wrong. `perception.readers.echoes.LaserOptions` explains these six arguments.
        mount: Position of the laser on the robot: metres ahead, metres to the left, degrees to the
            left.
        no_return: A range of at least this many metres means that nothing came back.
        zero_is: Meaning of ranges that are no measurement: "free" or "unknown".
        nearest: A range of at most this many metres is of the robot itself.
        blind: Two bearings in degrees between which the robot blocks the laser.

    Returns:
        The log. Its `notes` say what the reader assumed or found out. Its `damaged` are the parts
        that were skipped.

    Raises:
        LogError: The file cannot be read, has no known format, or holds no scan or no odometry.
    """
    options = LaserOptions(fov, mount, no_return, zero_is, nearest, blind)
    with _reading(path, format, scan_topic, odom_topic, options) as reading:
        scans, damaged = ScanTable(), list[Damage]()
        for item in reading.items:
            if isinstance(item, Scan):
                scans.append(item)
            else:
                damaged.append(item)
    if not scans:
        raise LogError(
            f"{named(path)}: expected scans, got none that can be read: {len(damaged)} are "
            f"damaged, first: {damaged[0].what if damaged else 'none'}; record the log again"
        )
    meant, found_out = interpret_log(scans, options)
    notes = (*reading.notes, *_assumed(reading, options), *found_out)
    source = os.fspath(path)
    about = reading.sources, reading.odometer
    log = RobotLog(meant, tuple(damaged), reading.format, source, notes, *about)
    for warning in log.warnings:
        _log.warning("%s: %s", named(path), warning)
    return log


def live_log(
    stream: IO[bytes],
    source: str = "-",
    options: LaserOptions | None = None,
    tell: Callable[[str], None] = lambda note: None,
) -> Iterator[Scan | Damage]:
    """Read the scans of a log of CARMEN from a pipe, packed or not, while they are written.

    The first SURVEYED scans wait until they show what the poses and ranges of the log mean. `tell`
    takes each note on what the reader assumed or found out. Yield scans, and `Damage` for the parts
    that were skipped. Raises LogError if the pipe has no lines of CARMEN, or vertices, whose edges
    may come later.
    """
    if not hasattr(stream, "readline") or isinstance(stream, io.TextIOBase):
        raise LogError(f"stream: expected a stream of bytes, got {brief(stream)}; open a file")
    options = options or LaserOptions()
    text = piped(stream, named(source))
    head = carmen.head_of(text, SURVEYED)
    if not carmen.looks_like(head) or carmen.VERTEX.search(head):
        got, mend = "nothing", "check the program that sends the log"
        if head:
            got, mend = "another log", "save the log to a file, and read the file"
        raise LogError(f"{named(source)}: expected lines of CARMEN, got {got}; {mend}")
    file = cast(IO[bytes], Piped(head, text))
    reading = carmen.read(file, named(source), "carmen", surveyed=io.BytesIO(head))
    first = list(islice(reading.items, SURVEYED))
    interpret, found_out = interpreter_of([one for one in first if isinstance(one, Scan)], options)
    for note in (*reading.notes, *_assumed(reading, options), *found_out):
        tell(note)
    for item in chain(first, reading.items):
        yield interpret(item) if isinstance(item, Scan) else item


def _assumed(reading: SurveyedLog, options: LaserOptions) -> list[str]:
    """Notes on what the reader assumed. If the user gave a setting, nothing was assumed for it."""
    return [note for option, note in reading.assumed.items() if getattr(options, option) is None]


@contextmanager
def _reading(
    path: str | os.PathLike[str],
    format: str | None,
    scan_topic: str | Sequence[str] | None,
    odom_topic: str | None,
    options: LaserOptions,
) -> Iterator[SurveyedLog]:
    """Open and survey a log of any format. Raises LogError."""
    path = a_path("path", path, LogError)
    given = [scan_topic] if isinstance(scan_topic, str) else scan_topic or ()
    mend = "name topics of the bag"
    topics = [
        a_text(f"scan_topic[{i}]", topic, LogError, mend=mend)
        for i, topic in enumerate(a_list("scan_topic", given, LogError, what="topics", mend=mend))
    ]
    if odom_topic is not None:
        a_text("odom_topic", odom_topic, LogError, mend=mend)
    if format is not None and format not in FORMATS:
        raise LogError(
            f"format: expected one of {', '.join(FORMATS)}, got {brief(format)}"
            "; leave it out to recognise it"
        )
    if Path(path).is_dir():
        if format in LINES:
            raise LogError(
                f"{named(path)}: expected a file of the format {format}, got a folder; name "
                "the file"
            )
        with bag_files.bag_opened(path, "ros2") as bag:
            yield bags.read(bag, topics, odom_topic, options)
        return
    # A file is a log in lines or a bag, by its content.
    with rereadable(os.fspath(path)) as file:
        found = format or _format(file, named(path))
        if found in LINES:
            if topics or odom_topic is not None:
                raise LogError(
                    f"{named(path)}: expected a bag, because topics are given, got the format "
                    f"{found}; leave the topics out"
                )
            yield carmen.read(file, named(path), format)
            return
    with bag_files.bag_opened(path, found) as bag:
        yield bags.read(bag, topics, odom_topic, options)


def _format(file: IO[bytes], source: str) -> str:
    """The format of a file by its content. Raises LogError if it is none of FORMATS."""
    formats = "; ".join(f"{name} ({what})" for name, what in FORMATS.items())
    head, longest = b"", 0
    for _, line in lines(file, source):
        head += (line or b"")[:HEAD]
        longest = LONGEST_LINE if line is None else longest
        if len(head) > HEAD:
            break
    # All lines are too long, or the file is empty.
    if not head:
        got = f"lines of more than {longest // 2**20} MiB" if longest else "an empty file"
        raise LogError(f"{source}: expected a robot's log, got {got}; formats: {formats}")
    if (bag := bag_files.format_of(head)) is not None:
        return bag
    if carmen.looks_like(head):
        return "carmen"
    if head.startswith(b'{"format": "ssh-trace"'):
        raise LogError(f"{source}: expected a robot's log, got a trace; give it to solve")
    raise LogError(
        f"{source}: expected a robot's log, got a file that begins with "
        f"{brief(head[:40].decode('utf-8', 'replace'))}; formats: {formats}"
    )
