"""Reads the lines of a log, plain or packed, one at a time.

So a long log does not fill the memory. A very long line is skipped. A packed file is recognised by
its first bytes: gzip, bzip2, xz or zstd.
"""

from __future__ import annotations

import bz2
import errno
import gzip
import importlib
import io
import lzma
import re
import shutil
import tempfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import IO, Any, cast

from perception.errors import LogError
from ssh_abduction.data.errors import named
from ssh_abduction.data.files import opened_file

# Longer lines are skipped: a scan of 10,000 beams is 100 kB.
LONGEST_LINE = 2**20
# Number of first bytes that show the encoding of a log and its line ends.
HEAD = 2**16
# The mark that may begin a text in UTF-8 or UTF-16.
MARK = re.compile(rb"^(\xef\xbb\xbf|\xff\xfe|\xfe\xff)")
# First bytes of packed files, with the packer and the command that unpacks them.
PACKERS = {
    b"\x1f\x8b": ("gzip", "zcat"),
    b"BZh": ("bzip2", "bzcat"),
    b"\xfd7zXZ\0": ("xz", "xzcat"),
    b"\x28\xb5\x2f\xfd": ("zstd", "zstdcat"),
}


@contextmanager
def rereadable(path: str) -> Iterator[IO[bytes]]:
    """Open a file to be read more than once. A pipe is copied to a temporary file.

    Raises LogError if the file cannot be read.
    """
    with opened_file(path, "a readable log", LogError) as file:
        if file.seekable():
            yield file
            return
        with tempfile.TemporaryFile() as copy:
            copied(file, copy, named(path))
            yield cast(IO[bytes], copy)


def copied(file: IO[bytes], copy: IO[bytes], source: str) -> None:
    """Copy a file from its current position to a temporary one.

    Raises LogError if the disk with the temporary folder is full.
    """
    try:
        shutil.copyfileobj(file, copy, 2**20)
        copy.flush()
    except OSError as error:
        raise (no_room(source) if is_full(error) else error) from None


def no_room(source: str) -> LogError:
    """Make the error that there is no room for temporary files."""
    where = tempfile.gettempdir()
    return LogError(
        f"{source}: expected room for a temporary copy in {where}, got a full disk; free "
        "some, or name another folder (TMPDIR=FOLDER)"
    )


def is_full(error: BaseException) -> bool:
    """Check whether an error means that a disk is full. The error may be one of SQLite."""
    return (
        getattr(error, "errno", None) in (errno.ENOSPC, errno.EDQUOT)
        or type(error).__name__ == "FullError"
    )


class Piped:
    """A stream whose first bytes, `head`, were read already and can be read again."""

    def __init__(self, head: bytes, rest: IO[bytes]) -> None:
        self._head, self._rest = io.BytesIO(head), rest

    def seek(self, offset: int) -> int:
        """Go to one of the first bytes. Bytes after them must not have been read yet."""
        return self._head.seek(offset)

    def read(self, size: int = -1) -> bytes:
        """Read bytes, at most `size`; less only at the end of the first bytes or of the stream."""
        return self._head.read(size) or self._rest.read(size)

    def readline(self, size: int = -1) -> bytes:
        """Read a line, at most `size` bytes. The bytes read in advance are whole lines."""
        return self._head.readline(size) or self._rest.readline(size)


def piped(stream: IO[bytes], source: str) -> IO[bytes]:
    """Read a pipe from its beginning, unpacking it if necessary."""
    first = stream.read(max(map(len, PACKERS)))
    return unpacked(cast(IO[bytes], Piped(first, stream)), source)


def packer(file: IO[bytes]) -> str | None:
    """Return the packer of a file by its first bytes: "gzip", "bzip2", "xz" or "zstd", or None."""
    file.seek(0)
    head = file.read(max(map(len, PACKERS)))
    return next((name for magic, (name, _) in PACKERS.items() if head.startswith(magic)), None)


def unpacked(file: IO[bytes], source: str) -> IO[bytes]:
    """Read a file from its beginning, unpacking it if necessary.

    The stream raises one of `damages()` if packed data end early or are damaged. Raises
    LogError if the package that unpacks zstd is missing.
    """
    found = packer(file)
    file.seek(0)
    if found is None:
        return file
    openers: dict[str, Callable[[IO[bytes]], Any]] = {
        "gzip": lambda f: gzip.GzipFile(fileobj=f),
        "bzip2": bz2.BZ2File,
        "xz": lzma.LZMAFile,
    }
    if found == "zstd":
        openers["zstd"] = needed_zstd(source).ZstdFile
    return cast(IO[bytes], openers[found](file))


def damages(*others: type[Exception]) -> tuple[type[Exception], ...]:
    """List the errors of `unpacked` data that end early (EOFError) or are damaged, and `others`."""
    zstd = zstd_module()
    more = (zstd.ZstdError,) if zstd else ()
    return (EOFError, gzip.BadGzipFile, zlib.error, lzma.LZMAError, *more, *others)


def needed_zstd(source: str) -> Any:
    """Return the module zstd. Python has none before 3.14. Raises LogError without its backport."""
    if (zstd := zstd_module()) is None:
        raise LogError(
            f"{source}: expected the package backports.zstd to unpack it with (zstd), got none; "
            "pip install '.[ros]' in your clone, or unpack it with zstd -d"
        )
    return zstd


def zstd_module() -> Any:
    """Return Python's zstd module, or its backport for Python before 3.14; None without both."""
    for name in ("compression.zstd", "backports.zstd"):
        try:
            return importlib.import_module(name)
        except ImportError:
            continue
    return None


class _Decoded:
    """The lines of a log whose line ends are CR, as on old Macs."""

    def __init__(self, stream: IO[bytes]) -> None:
        self._text = io.TextIOWrapper(stream, "latin-1")

    def readline(self, size: int = -1) -> bytes:
        """Read a line, at most `size` characters."""
        return self._text.readline(size).encode("latin-1")

    def __del__(self) -> None:
        """Leave the stream open: it may be read again."""
        self._text.detach()


def _decoded(stream: IO[bytes]) -> IO[bytes]:
    """Read a log line by line if its line ends are CR."""
    head = stream.read(HEAD).replace(b"\0", b"")
    stream.seek(0)
    has_returns = re.search(rb"\r[^\r\n]", head) and not re.search(rb"[\x01-\x08]", head)
    return cast(IO[bytes], _Decoded(stream)) if has_returns else stream


def lines(file: IO[bytes], source: str) -> Iterator[tuple[int, bytes | None]]:
    """Yield the lines of a file, unpacked if necessary, each with its number, from 1.

    A line of more than LONGEST_LINE bytes is None. Raises LogError if packed data end early or
    are damaged. The message says up to which line they can be read.
    """
    found = packer(file)
    number = 0
    try:
        stream = _decoded(unpacked(file, source))
        while line := stream.readline(LONGEST_LINE + 1):
            number += 1
            if len(line) <= LONGEST_LINE:
                # In UTF-16, as some shells write it, each other byte is 0.
                yield number, MARK.sub(b"", line).replace(b"\0", b"")
                continue
            # Skip the rest of a line that is too long.
            while line and not line.endswith(b"\n"):
                line = stream.readline(LONGEST_LINE)
            yield number, None
    except damages(OSError) as error:
        if found is None:
            raise
        what = (
            "they end too early" if isinstance(error, EOFError) else f"they are damaged ({error})"
        )
        tool = dict(PACKERS.values())[found]
        raise LogError(
            f"{source}: expected whole data of {found}, but after line {number} {what}; get "
            f"the file again, or unpack what there is ({tool} FILE > PART) and read that"
        ) from None
