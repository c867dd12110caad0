"""Opens a bag, and gives access to its topics and messages.

A bag is one file or several parts of a drive, packed or not. The package rosbags reads complete
files, which have an index. Files that were cut or never closed have none. Their records
are read from the beginning up to the first damaged one. If the cut is within a chunk of messages,
those before it are read.
"""

from __future__ import annotations

import bz2
import io
import os
import re
import sqlite3
import struct
import tempfile
from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import IO, Any
from urllib.parse import quote

from perception.errors import LogError
from perception.readers.lines import (
    copied,
    damages,
    is_full,
    needed_zstd,
    no_room,
    packer,
    unpacked,
    zstd_module,
)
from perception.readers.scans import Damage
from ssh_abduction.data.checks import needed
from ssh_abduction.data.errors import named
from ssh_abduction.data.words import first_few

NANOSECONDS = 1_000_000_000  # in a second
# Kinds of records with content: of MCAP (https://mcap.dev/spec), and of ROS 1
# (http://wiki.ros.org/Bags/Format/2.0).
SCHEMA, CHANNEL, MCAP_MESSAGE, MCAP_CHUNK = 3, 4, 5, 6
ROS1_MESSAGE, ROS1_CHUNK, CONNECTION = 2, 5, 7


@dataclass
class Connection:
    """The messages of one sender to one topic, with the fields of rosbags' connections."""

    id: int
    topic: str
    msgtype: str  # message kind, such as sensor_msgs/msg/LaserScan
    ext: SimpleNamespace  # of a ROS 1 bag: `callerid`, the name of the node that sends
    msgcount: int = 0


# A message: its connection, the time of recording in nanoseconds, and the serialised message.
Message = tuple[Connection, int, bytes]


class Salvage:
    """The intact messages of a bag file, with the interface of the readers of rosbags.

    The format is `ros1`, `ros2` (SQLite) or `mcap`.
    """

    def __init__(self, path: Path, format: str) -> None:
        self._path, self._read = path, READERS[format]
        found: dict[int, Connection] = {}
        times: list[int] = []
        for connection, time, _ in self._messages():
            found.setdefault(connection.id, connection).msgcount += 1
            times = [*times[:1], time]
        self.connections = [*found.values()]  # those with intact messages
        self.count = sum(one.msgcount for one in self.connections)  # number of intact messages
        # From the first to the last intact message.
        self.seconds = (times[-1] - times[0]) / NANOSECONDS if times else 0.0

    def messages(self, connections: Collection[Connection]) -> Iterator[Message]:
        """Yield each message of these connections."""
        asked = {connection.id: connection for connection in connections}
        for connection, time, data in self._messages():
            if connection.id in asked:
                yield asked[connection.id], time, data

    def _messages(self) -> Iterator[Message]:
        try:
            yield from self._read(self._path)
        except damages(OSError, struct.error, LookupError, ValueError, RuntimeError, sqlite3.Error):
            return  # The intact part ends here.


def _mcap(path: Path) -> Iterator[Message]:
    """The intact messages of an MCAP file."""
    kinds: dict[int, str] = {}
    channels: dict[int, Connection] = {}
    with path.open("rb") as file:
        file.seek(8)
        for kind, data in _mcap_records(file, os.fstat(file.fileno()).st_size):
            # Schemas name message kinds, channels refer to schemas, messages to channels.
            if kind == SCHEMA:
                kinds[struct.unpack_from("<H", data)[0]] = _text(data, 2)[0]
            elif kind == CHANNEL:
                number, schema = struct.unpack_from("<HH", data)
                topic, end = _text(data, 4)
                if _text(data, end)[0] == "cdr":
                    channels[number] = _connection(number, topic, kinds.get(schema, ""))
            elif kind == MCAP_MESSAGE:
                number, _, time = struct.unpack_from("<HIQ", data)
                if number in channels:
                    yield channels[number], time, data[22:]


def _mcap_records(stream: IO[bytes], size: int) -> Iterator[tuple[int, bytes]]:
    """Yield the kind and content of the intact records of an MCAP stream, also in chunks."""
    while len(head := stream.read(9)) == 9:
        kind, length = struct.unpack("<BQ", head)
        data = stream.read(min(length, size))
        if kind == MCAP_CHUNK:
            packed, end = _text(data, 28)
            content = _unpacked(packed, data[end + 8 :])
            yield from _mcap_records(io.BytesIO(content), len(content))
        elif len(data) == length:
            yield kind, data
        if len(data) < length:
            return


def _ros1(path: Path) -> Iterator[Message]:
    """The intact messages of a ROS 1 bag."""
    connections: dict[int, Connection] = {}
    with path.open("rb") as file:
        file.readline()
        for header, data in _ros1_records(file, os.fstat(file.fileno()).st_size):
            kind = header[b"op"][0]
            if kind not in (CONNECTION, ROS1_MESSAGE):
                continue
            number = struct.unpack("<I", header[b"conn"])[0]
            # Connections name topic, kind and sender; messages refer to them.
            if kind == CONNECTION:
                fields = _fields(data)
                package, _, name = fields[b"type"].decode().partition("/")
                sender = fields.get(b"callerid", b"").decode()
                topic = header[b"topic"].decode()
                connections[number] = _connection(number, topic, f"{package}/msg/{name}", sender)
            elif number in connections:
                seconds, nano = struct.unpack("<II", header[b"time"])
                yield connections[number], seconds * NANOSECONDS + nano, data


def _ros1_records(stream: IO[bytes], size: int) -> Iterator[tuple[dict[bytes, bytes], bytes]]:
    """Yield the header fields and content of intact records of ROS 1, also in chunks."""

    def part() -> tuple[bytes, bool]:
        """Read the next header or content of a record; return it, and whether it is complete."""
        length = int.from_bytes(head, "little") if len(head := stream.read(4)) == 4 else size + 1
        data = stream.read(min(length, size))
        return data, len(data) == length

    # A record is a header and its data, each after its length. A chunk holds records.
    whole = True
    while whole:
        header, whole = part()
        if not whole:
            return
        data, whole = part()
        fields = _fields(header)
        if fields[b"op"][0] == ROS1_CHUNK:
            content = _unpacked(fields[b"compression"].decode(), data)
            yield from _ros1_records(io.BytesIO(content), len(content))
        elif whole:
            yield fields, data


def _sqlite(path: Path) -> Iterator[Message]:
    """The intact messages of a SQLite file of ROS 2."""
    with closing(
        sqlite3.connect(f"file:{quote(str(path))}?mode=ro&immutable=1", uri=True)
    ) as database:
        # Without this, SQLite rejects a file that is shorter than its first page says.
        database.execute("PRAGMA writable_schema=ON")
        topics = {
            row[0]: _connection(*row)
            for row in database.execute("SELECT id, name, type FROM topics")
        }
        for number, time, data in database.execute(
            "SELECT topic_id, timestamp, data FROM messages ORDER BY rowid"
        ):
            if number in topics and isinstance(data, bytes):
                yield topics[number], time, data


READERS: dict[str, Callable[[Path], Iterator[Message]]] = {
    "mcap": _mcap,
    "ros1": _ros1,
    "ros2": _sqlite,
}


def _connection(number: int, topic: str, kind: str, sender: str = "") -> Connection:
    return Connection(number, topic, kind, SimpleNamespace(callerid=sender))


def _text(data: bytes, at: int) -> tuple[str, int]:
    """Read a text that is stored after its length; return it, and the position after it."""
    (length,) = struct.unpack_from("<I", data, at)
    end = at + 4 + length
    return data[at + 4 : end].decode(), end


def _fields(data: bytes) -> dict[bytes, bytes]:
    """The fields of a header of ROS 1 by name."""
    found: dict[bytes, bytes] = {}
    at = 0
    while at < len(data):
        end = at + 4 + int(struct.unpack_from("<I", data, at)[0])
        name, _, value = data[at + 4 : end].partition(b"=")
        found[name], at = value, end
    return found


def _unpacked(packed: str, data: bytes) -> bytes:
    """Unpack the content of a chunk, as far as it exists. KeyError: unknown compression."""
    if packed in ("", "none"):
        return data
    from lz4.frame import LZ4FrameDecompressor

    unpackers: dict[str, Callable[[], Any]] = {
        "bz2": bz2.BZ2Decompressor,
        "lz4": LZ4FrameDecompressor,
        "zstd": zstd_module().ZstdDecompressor,
    }
    return bytes(unpackers[packed]().decompress(data))


# First bytes of a file, with its format and the ending that rosbags expects.
MAGICS = {
    b"#ROSBAG V": ("ros1", ".bag"),
    b"\x89MCAP0\r\n": ("mcap", ".mcap"),
    b"SQLite format 3": ("ros2", ".db3"),
}
HEAD = max(map(len, MAGICS))
# Endings of the files of bags, also of packed ones.
NAMES = re.compile(r"\.(bag|bag\.active|mcap|db3)(\.(gz|bz2|xz|zstd|zst))?$")
# Recorders number the parts of a bag: drive_0.db3, drive_1.db3. A longer number is a date or a
# year.
PART = re.compile(r"(?P<drive>.*)_(?P<number>\d{1,3})$", re.DOTALL)
REINDEX = "index it again (rosbag reindex, ros2 bag reindex, mcap recover), or record it anew"
TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
NANO = 1e-9
ZSTD = b"\x28\xb5\x2f\xfd"  # first bytes of a message that is packed with zstd


@dataclass
class Bag:
    """The open files of one drive, and access to their topics and messages."""

    source: str  # name of the bag, for errors
    format: str  # `ros1`, `ros2` or `mcap`
    folder: Path  # a temporary folder for links to the files, and for what is unpacked
    stack: ExitStack  # it closes the readers
    # A reader for each part of the drive, in order: one of rosbags, or a `Salvage`.
    readers: list[Any] = field(default_factory=list)
    # Sentences about the files that a user should know, such as that a part is missing.
    notes: list[str] = field(default_factory=list)

    def open_folder(self, path: Path) -> None:
        """Open a folder by its metadata.yaml, or else all files in it. Raises LogError."""
        parts = sorted(
            (part for part in path.iterdir() if NAMES.search(part.name) and part.is_file()),
            key=_number,
        )
        self.format = "ros2"
        if (path / "metadata.yaml").exists() and self._open_by_metadata(path, parts):
            return
        if not parts:
            raise LogError(
                f"{named(path)}: expected a folder of ROS 2 with metadata.yaml, or with files "
                "*.mcap, *.db3 or *.bag, got none of these; name a file"
            )
        # Without metadata.yaml, only names show which files belong together.
        if len({_drive(part) for part in parts}) > 1:
            names = first_few([named(part.name) for part in parts], 4)
            raise LogError(
                f"{named(path)}: expected the parts of one drive, as drive_0.db3 and drive_1.db3, "
                f"got {names}; name one of the files, or ros2 bag reindex the folder"
            )
        self.format = next((found for part in parts if (found := _format(part))), "ros2")
        self._open_parts(parts)
        if len(parts) > 1:
            self.notes.append(
                f"{named(path)} has no metadata.yaml that can be used: its {len(parts)} parts are "
                f"read as one drive, from {named(parts[0].name)} to {named(parts[-1].name)}."
            )
        self.notes += _gaps(parts)

    def _open_by_metadata(self, path: Path, parts: list[Path]) -> bool:
        """Open a folder by its metadata.yaml. Return False, with a note, if that is not possible.

        Raises LogError if the folder has no `parts` either.
        """
        try:
            reader = self._by_rosbags(path)
            self.readers.append(reader)
            if len(reader.storage.storages) < len(parts):
                self.notes.append(
                    f"{named(path / 'metadata.yaml')} names {len(reader.storage.storages)} of "
                    f"the {len(parts)} files beside it, and only these are read. To read all, "
                    "run ros2 bag reindex."
                )
            return True
        except Exception as error:  # Damaged bytes can raise any error in the library.
            raise_if_disk_is_full(error, named(path))
            if not parts:
                raise LogError(
                    f"{named(path)}: expected a bag of ROS 2, got one that cannot be opened "
                    f"({cause(error)}); {REINDEX}"
                ) from None
            self.notes.append(
                f"{named(path / 'metadata.yaml')} cannot be used ({cause(error)}): the bag is "
                "read without it."
            )
            return False

    def _open_parts(self, parts: list[Path]) -> None:
        """Open each part of a drive that can be read, or raise the error of the first part."""
        unread = []
        for part in parts:
            try:
                self.open_part(part)
            except OSError as error:
                unread.append(_unreadable(part, error))
            except LogError as error:
                unread.append(error)
        if not self.readers:
            raise unread[0]
        self.notes += [f"A part was not read. {error}" for error in unread]

    def open_part(self, path: Path) -> None:
        """Open one file, and add its reader and notes to those of the drive, or raise LogError."""
        source = named(path)
        here = (
            self.folder / f"{len(list(self.folder.iterdir()))}{dict(MAGICS.values())[self.format]}"
        )
        with path.open("rb") as file:
            if packer(file):
                self.notes += _copied(file, here, source)
            else:
                here.symlink_to(path.resolve())
        try:
            self.readers.append(self._by_rosbags(here))
            self._note_packed(source)
            return
        except Exception as error:  # Damaged bytes can raise any error in the library.
            raise_if_disk_is_full(error, named(path))
            why = cause(error).replace(str(here), source)
        salvage = Salvage(here, self.format)
        if not salvage.count:
            raise LogError(
                f"{source}: expected a bag ({self.format}), got one that cannot be opened "
                f"({why}); {REINDEX}"
            )
        self.readers.append(salvage)
        self.notes.append(
            f"{source} is cut, or was never closed ({why}): its {salvage.count} whole messages "
            f"are read, {salvage.seconds:.1f} s of the drive. What came after is lost."
        )

    def _note_packed(self, source: str) -> None:
        """Note that the messages of a file alone are packed, which its metadata.yaml would say."""
        _, _, raw = next(iter(self.readers[-1].messages()), (None, 0, b""))
        if self.format == "ros2" and bytes(raw[: len(ZSTD)]) == ZSTD:
            needed_zstd(source)
            self.notes.append(f"The messages of {source} are packed with zstd: they are unpacked.")

    def _by_rosbags(self, path: Path) -> Any:
        """Open a file or folder with rosbags, and return the reader, which the stack closes."""
        from rosbags import rosbag1, rosbag2

        reader: Any = rosbag1.Reader(path) if self.format == "ros1" else rosbag2.Reader(path)
        reader.open()
        self.stack.callback(reader.close)
        return reader

    @property
    def connections(self) -> list[Any]:
        return [connection for reader in self.readers for connection in reader.connections]

    def topics(self, *kinds: str) -> dict[str, int]:
        """Count the messages of each topic of these kinds; without any, of all topics."""
        counts: dict[str, int] = {}
        for connection in self.connections:
            if not kinds or connection.msgtype in kinds:
                counts[connection.topic] = counts.get(connection.topic, 0) + connection.msgcount
        return counts

    def listed(self) -> str:
        """Name the topics with their kinds, for error messages: at most 20, or "none"."""
        topics = dict.fromkeys(
            f"{c.topic} ({c.msgtype.rpartition('/')[2]})" for c in self.connections
        )
        return first_few([*topics], 20) or "none"

    def messages(self, topics: set[str]) -> Iterator[tuple[Any, int, float, Any]]:
        """Read the messages of some topics.

        Yield for each its connection, its number within the topic (from 1), the time of recording
        in seconds, and the message. Damage takes the place of a message that cannot be read.
        """
        from rosbags.serde import SerdeError

        numbers = dict.fromkeys(topics, 0)
        store = typestore(self.format == "ros1")
        deserialize = store.deserialize_ros1 if self.format == "ros1" else store.deserialize_cdr
        for reader in self.readers:
            connections = [c for c in reader.connections if c.topic in topics]
            try:
                for connection, time, raw in reader.messages(connections) if connections else ():
                    numbers[connection.topic] += 1
                    number = numbers[connection.topic]
                    try:
                        is_packed = self.format == "ros2" and bytes(raw[: len(ZSTD)]) == ZSTD
                        whole = needed_zstd(self.source).decompress(raw) if is_packed else raw
                        message = deserialize(whole, connection.msgtype)
                    except damages(SerdeError, ValueError, IndexError) as error:
                        what = (
                            f"{connection.topic}: expected a message "
                            f"{connection.msgtype.rpartition('/')[2]}, got damaged data "
                            f"({cause(error)})"
                        )
                        message = Damage(number, what)
                    yield connection, number, time * NANO, message
            except Exception as error:  # Damaged bytes can raise any error in the library.
                raise_if_disk_is_full(error, self.source)
                number = sum(numbers.values()) + 1
                what = (
                    f"{' and '.join(sorted(topics))}: expected a message, got damaged data "
                    f"({cause(error)}); what follows was not read"
                )
                yield connections[0], number, 0.0, Damage(number, what)


def format_of(head: bytes) -> str | None:
    """Find the format (`ros1`, `ros2`, `mcap`) of a file with these first bytes.

    None if the file is no bag.
    """
    return next((name for magic, (name, _) in MAGICS.items() if head.startswith(magic)), None)


@contextmanager
def bag_opened(path: str | os.PathLike[str], format: str) -> Iterator[Bag]:
    """Open a bag of the format `ros1`, `ros2` or `mcap`, or a folder. Raises LogError."""
    path = Path(path)
    with needed(named(path), "rosbags to read it with", "'.[ros]' in your clone", LogError):
        from rosbags import rosbag1, rosbag2  # noqa: F401 - only whether they are installed
    with ExitStack() as stack:
        try:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            bag = Bag(named(path), format, folder, stack)
            if path.is_dir():
                bag.open_folder(path)
            else:
                bag.open_part(path)
                # Other parts of the drive may lie beside the file. The user may have meant all.
                bag.notes += _beside(path)
        except OSError as error:
            raise _unreadable(path, error) from None
        yield bag


def _unreadable(path: Path, error: OSError) -> LogError:
    """Make the error for a file or folder that cannot be read, or raise one for a full disk."""
    raise_if_disk_is_full(error, named(path))
    return LogError(
        f"{named(path)}: expected a readable bag: {error.strerror or error}; check the path"
    )


def _copied(file: IO[bytes], here: Path, source: str) -> list[str]:
    """Unpack the intact part of a file to the path `here`, with a note if it is damaged."""
    with here.open("wb") as copy:
        try:
            copied(unpacked(file, source), copy, source)
        except damages() as error:
            what = (
                "ends too early" if isinstance(error, EOFError) else f"is damaged ({cause(error)})"
            )
            return [f"{source} {what}: it was unpacked as far as it is whole."]
    return []


def _format(path: Path) -> str | None:
    """The format of a file by its content; None if it is no bag or cannot be read."""
    try:
        with path.open("rb") as file:
            return format_of(unpacked(file, named(path)).read(HEAD))
    except damages(OSError):
        return None


def _drive(part: Path) -> str:
    """The name of a part's file without its number and, if it is packed, without that suffix."""
    stem, ending = NAMES.sub("", part.name), NAMES.search(part.name)
    found = PART.match(stem)
    return f"{found['drive'] if found else stem}.{ending[1] if ending else ''}"


def _number(part: Path) -> tuple[int, str]:
    """Key that sorts parts by number, then by name. The number is -1 if the name has none."""
    found = PART.match(NAMES.sub("", part.name))
    return int(found["number"]) if found else -1, part.name


def _gaps(parts: list[Path]) -> list[str]:
    """One note if numbers are missing among the sorted parts of a drive; otherwise none."""
    numbers = [number for number, _ in map(_number, parts) if number >= 0]
    missing = sorted(set(range(max(numbers, default=-1))) - set(numbers))
    if not missing:
        return []
    return [
        f"{named(parts[-1].name)} is one part of a drive. These parts are not there: "
        f"{first_few(missing, 5)}. Their scans are missing."
    ]


def _beside(path: Path) -> list[str]:
    """One note if a file is only one of several parts of a drive; otherwise none."""
    number, _ = _number(path)
    if number < 0 or not NAMES.search(path.name):
        return []
    # Other parts of the same drive in the same folder.
    parts = (part for part in path.parent.iterdir() if part != path and NAMES.search(part.name))
    with_it = sorted((part for part in parts if _drive(part) == _drive(path)), key=_number)
    if with_it:
        names = first_few([named(part.name) for part in with_it], 3)
        return [
            f"{named(path)} is one part of a drive, and is read alone. Beside it lie {names}: "
            "name the folder to read all of them."
        ]
    return _gaps([path])


def raise_if_disk_is_full(error: Exception, source: str) -> None:
    """Raise LogError if an error means that a disk is full. Then the bag itself is not damaged."""
    if is_full(error):
        raise no_room(source) from None


def cause(error: Exception) -> str:
    """Return the first line of the message of an error, shortened; without a message, its type."""
    return (str(error) or type(error).__name__).splitlines()[0].rstrip(".")[:200]


@cache
def typestore(is_ros1: bool) -> Any:
    """Make the store of rosbags with the types of messages, including transforms."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    for kind in TRANSFORMS:
        if kind not in store.fielddefs:
            store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", kind))
    return store
