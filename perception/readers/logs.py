"""From the file of a robot's log to its scans, whatever its format."""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import IO

from perception.errors import LogError
from perception.readers import carmen
from perception.readers.lines import lines, opened
from perception.readers.scans import Damage, RobotLog, Scan
from ssh_abduction.errors import brief, named

FORMATS = ("carmen", "g2o")
# So many bytes at the beginning of a file tell its format.
HEAD = 2**16


def read_log(path: str | os.PathLike[str], format: str | None = None) -> RobotLog:
    """A robot's log.

    format  one of FORMATS; guessed from the content, never from the name, where it is None

    Raises LogError where the file cannot be read, is of no known format, or holds no scan. A damaged part of it is skipped, and listed in the log's `damaged`.
    """
    with opened(path) as file:
        reading = _reading(file, path, format)
        scans: list[Scan] = []
        damaged: list[Damage] = []
        for item in reading.items:
            if isinstance(item, Scan):
                scans.append(item)
            else:
                damaged.append(item)
    return RobotLog(tuple(scans), tuple(damaged), reading.format, os.fspath(path), reading.notes)


def stream_log(path: str | os.PathLike[str], format: str | None = None) -> Iterator[Scan | Damage]:
    """The scans of a robot's log one after another, and what was skipped, in the order of the file. Arguments and errors as for `read_log`."""
    with opened(path) as file:
        yield from _reading(file, path, format).items


def _reading(file: IO[bytes], path: str | os.PathLike[str], format: str | None) -> carmen.Reading:
    source = named(path)
    if format is not None and format not in FORMATS:
        raise LogError(f"format: expected one of {', '.join(FORMATS)}, got {brief(format)}")
    if format is None and not carmen.looks_like(_head(file, source)):
        raise LogError(f"{source}: expected a robot's log ({', '.join(FORMATS)})")
    return carmen.read(file, source)


def _head(file: IO[bytes], source: str) -> bytes:
    head = b""
    for _, line in lines(file, source):
        head += line or b""
        if len(head) > HEAD:
            break
    return head
