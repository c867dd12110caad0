"""The lines of a log, plain or gzipped, one at a time: a log of hours is never in memory as a whole, and a line without an end is not either."""

from __future__ import annotations

import gzip
import os
import shutil
import tempfile
import zlib
from codecs import BOM_UTF8
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, cast

from perception.errors import LogError
from ssh_abduction.errors import named

# What is longer is no line of a log: a scan of 10,000 beams is 100 kB.
LONGEST_LINE = 2**20
GZIP = b"\x1f\x8b"


@contextmanager
def opened(path: str | os.PathLike[str]) -> Iterator[IO[bytes]]:
    """The bytes of a file that can be read more than once. A pipe is copied to a temporary file, as it can be read only once.

    Raises LogError.
    """
    try:
        file = Path(path).open("rb")  # noqa: SIM115 - it is closed below
    except OSError as error:
        raise _unreadable(path, error) from None
    except ValueError as error:  # a null character in the path
        raise LogError(f"{named(path)}: expected the path of a log: {error}") from None
    try:
        with file:
            if file.seekable():
                yield file
                return
            with tempfile.TemporaryFile() as copy:
                shutil.copyfileobj(file, copy)
                yield cast(IO[bytes], copy)
    except OSError as error:
        raise _unreadable(path, error) from None


def _unreadable(path: str | os.PathLike[str], error: OSError) -> LogError:
    return LogError(f"{named(path)}: expected a readable log: {error.strerror or error}; check the path")


def is_gzip(file: IO[bytes]) -> bool:
    file.seek(0)
    return file.read(2) == GZIP


def lines(file: IO[bytes], source: str) -> Iterator[tuple[int, bytes | None]]:
    """The lines of a file from its beginning, unpacked if it is gzipped, whatever its name, each with its number, counted from 1.

    None stands for a line that is longer than LONGEST_LINE bytes. Raises LogError where gzipped data are cut or damaged, which says up to where they can be read.
    """
    zipped = is_gzip(file)
    file.seek(0)
    unpacked = cast(IO[bytes], gzip.GzipFile(fileobj=file)) if zipped else file
    number = 0
    try:
        while line := unpacked.readline(LONGEST_LINE + 1):
            number += 1
            if len(line) <= LONGEST_LINE:
                yield number, line if number > 1 else line.removeprefix(BOM_UTF8)
                continue
            while line and not line.endswith(b"\n"):
                line = unpacked.readline(LONGEST_LINE)
            yield number, None
    except (EOFError, gzip.BadGzipFile, zlib.error) as error:
        what = "they end too early" if isinstance(error, EOFError) else str(error)
        raise LogError(
            f"{source}: expected whole gzipped data, but after line {number} {what}; get the file again, or unpack what there is (zcat FILE > PART) and read that"
        ) from None
