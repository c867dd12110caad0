"""Reads the scans of a robot's log in any of the known formats."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from perception.errors import LogError
from perception.readers import bag_files, bag_topics, bags, carmen
from perception.readers.echoes import Told, interpret_log, interpret_scan
from perception.readers.lines import LONGEST_LINE, lines, opened
from perception.readers.scans import Damage, Reading, RobotLog, Scan
from ssh_abduction.data.errors import brief, named
from ssh_abduction.data.odometry import Pose
from ssh_abduction.runtime.logs import log_of

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
            or is wrong. `perception.readers.echoes.Told` explains this and the following arguments.
        mount: Position of the laser on the robot: metres ahead, metres to the left, degrees to the
            left.
        no_return: Metres from which a range means that nothing came back.
        zero_is: Meaning of ranges that are no measurement: "free" or "unknown".

    Returns:
        The log. Its `notes` say what the reader assumed or found out. Its `damaged` are the parts
        that were skipped.

    Raises:
        LogError: The file cannot be read, has no known format, or holds no scan or no odometry.
    """
    told = Told(fov, mount, no_return, zero_is)
    with _reading(path, format, scan_topic, odom_topic) as reading:
        scans: list[Scan] = []
        damaged: list[Damage] = []
        for item in reading.items:
            if isinstance(item, Scan):
                scans.append(item)
            else:
                damaged.append(item)
    if not scans:
        raise LogError(
            f"{named(path)}: expected scans, got none that can be read; {len(damaged)} are "
            f"damaged, first: {damaged[0].what if damaged else 'none'}"
        )
    meant, found_out = interpret_log(scans, told)
    # If the user gave a setting, nothing was assumed for it.
    assumed = (note for option, note in reading.assumed.items() if getattr(told, option) is None)
    log = RobotLog(
        meant,
        tuple(damaged),
        reading.format,
        os.fspath(path),
        (*reading.notes, *assumed, *found_out),
    )
    for warning in log.warnings:
        _log.warning("%s: %s", named(path), warning)
    return log


def stream_log(
    path: str | os.PathLike[str],
    format: str | None = None,
    *,
    scan_topic: str | Sequence[str] | None = None,
    odom_topic: str | None = None,
    fov: float | None = None,
    mount: Pose | None = None,
    no_return: float | None = None,
    zero_is: str | None = None,
) -> Iterator[Scan | Damage]:
    """Read the scans of a robot's log one at a time, in the order of the file.

    Arguments and errors are those of `read_log`. Unlike there, ranges are interpreted without the
    rest of the log. So a range that often repeats counts as a wall unless `no_return` is given, and
    ranges of 0 are unknown unless `zero_is` is given.

    Yields:
        Scans, and `Damage` for the parts that were skipped.
    """
    told = Told(fov, mount, no_return, zero_is)
    with _reading(path, format, scan_topic, odom_topic) as reading:
        for item in reading.items:
            yield interpret_scan(item, told) if isinstance(item, Scan) else item


@contextmanager
def _reading(
    path: str | os.PathLike[str],
    format: str | None,
    scan_topic: str | Sequence[str] | None,
    odom_topic: str | None,
) -> Iterator[Reading]:
    """Open and survey a log of any format. Raises LogError."""
    topics = [scan_topic] if isinstance(scan_topic, str) else list(scan_topic or ())
    if format is not None and format not in FORMATS:
        raise LogError(f"format: expected one of {', '.join(FORMATS)}, got {brief(format)}")
    if _is_folder(path):
        if format in LINES:
            raise LogError(
                f"{named(path)}: expected a file of the format {format}, got a folder; name "
                "the file"
            )
        with bag_topics.opened(path, "ros2") as bag:
            yield bags.read(bag, topics, odom_topic)
        return
    # A file is a log in lines or a bag, by its content.
    with opened(path) as file:
        found = format or _format(file, named(path))
        if found in LINES:
            if topics or odom_topic is not None:
                raise LogError(
                    f"{named(path)}: expected a bag, as a topic is named, got the format "
                    f"{found}; leave the topics out"
                )
            yield carmen.read(file, named(path), format)
            return
    with bag_topics.opened(path, found) as bag:
        yield bags.read(bag, topics, odom_topic)


def _is_folder(path: str | os.PathLike[str]) -> bool:
    try:
        return Path(path).is_dir()
    except ValueError:  # A null character in the path; opening the file reports it.
        return False


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
    raise LogError(
        f"{source}: expected a robot's log, got a file that begins with "
        f"{brief(head[:40].decode('utf-8', 'replace'))}; formats: {formats}"
    )
