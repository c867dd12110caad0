"""Reads the intact part of a bag that was cut or never closed.

Such a bag has no index, so the package rosbags cannot open it. Records are read from the beginning
up to the first damaged one. If the cut is within a chunk of messages, those before it are read.
"""

from __future__ import annotations

import bz2
import io
import os
import sqlite3
import struct
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import IO, Any, NamedTuple
from urllib.parse import quote

from perception.readers.lines import damages, zstd_module

NANO = 1_000_000_000
# Kinds of records with content: of MCAP (https://mcap.dev/spec), and of ROS 1
# (http://wiki.ros.org/Bags/Format/2.0).
SCHEMA, CHANNEL, MCAP_MESSAGE, MCAP_CHUNK = 3, 4, 5, 6
ROS1_MESSAGE, ROS1_CHUNK, CONNECTION = 2, 5, 7


class Message(NamedTuple):
    """A message of a bag."""

    connection: int  # number of the connection, which is one sender's messages to one topic
    topic: str  # name of the topic
    msgtype: str  # message kind, such as sensor_msgs/msg/LaserScan
    sender: str  # name of the sender; empty if the format does not store it
    time: int  # time of recording in nanoseconds
    data: bytes  # the serialised message


@dataclass(frozen=True)
class Connection:
    """The messages of one sender to one topic, with the fields of rosbags' connections."""

    id: int
    topic: str
    msgtype: str
    msgcount: int
    ext: SimpleNamespace  # of a ROS 1 bag: `callerid`, the name of the node that sends


class Salvage:
    """The intact messages of a bag file, with the interface of the readers of rosbags.

    The format is `ros1`, `ros2` (SQLite) or `mcap`.
    """

    def __init__(self, path: Path, format: str) -> None:
        self._path, self._read = path, READERS[format]
        found: dict[int, tuple[str, str, str]] = {}
        counts: Counter[int] = Counter()
        first, last = None, 0
        for message in self._messages():
            found.setdefault(message.connection, (message.topic, message.msgtype, message.sender))
            counts[message.connection] += 1
            first, last = message.time if first is None else first, message.time
        self.connections = [  # those with intact messages
            Connection(number, topic, kind, counts[number], SimpleNamespace(callerid=sender))
            for number, (topic, kind, sender) in found.items()
        ]
        self.count = counts.total()  # number of intact messages
        self.seconds = (last - (first or 0)) / NANO  # from the first to the last intact message

    def messages(
        self, connections: Collection[Connection]
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """Yield each message: connection, time of recording in nanoseconds, and bytes."""
        asked = {connection.id: connection for connection in connections}
        for message in self._messages():
            if message.connection in asked:
                yield asked[message.connection], message.time, message.data

    def close(self) -> None:
        """Do nothing: no file is open between two calls. Readers of rosbags have this method."""

    def _messages(self) -> Iterator[Message]:
        try:
            yield from self._read(self._path)
        except damages(OSError, struct.error, LookupError, ValueError, RuntimeError, sqlite3.Error):
            return  # The intact part ends here.


def _mcap(path: Path) -> Iterator[Message]:
    """The intact messages of an MCAP file."""
    kinds: dict[int, str] = {}
    channels: dict[int, tuple[str, str]] = {}
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
                    channels[number] = topic, kinds.get(schema, "")
            elif kind == MCAP_MESSAGE:
                number, _, time = struct.unpack_from("<HIQ", data)
                if number in channels:
                    yield Message(number, *channels[number], "", time, data[22:])


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
    connections: dict[int, tuple[str, str, str]] = {}
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
                connections[number] = (
                    header[b"topic"].decode(),
                    f"{package}/msg/{name}",
                    fields.get(b"callerid", b"").decode(),
                )
            elif number in connections:
                seconds, nano = struct.unpack("<II", header[b"time"])
                yield Message(number, *connections[number], seconds * NANO + nano, data)


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
            number: (topic, kind)
            for number, topic, kind in database.execute("SELECT id, name, type FROM topics")
        }
        for number, time, data in database.execute(
            "SELECT topic_id, timestamp, data FROM messages ORDER BY rowid"
        ):
            if number in topics and isinstance(data, bytes):
                yield Message(number, *topics[number], "", time, data)


READERS: dict[str, Callable[[Path], Iterator[Message]]] = {
    "mcap": _mcap,
    "ros1": _ros1,
    "ros2": _sqlite,
}


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
