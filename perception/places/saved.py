"""Saves the state of a `LiveLog` in a folder, and restores it.

`drive.scans` has a row of numbers for each scan, with its pose and its ranges. A row is never
changed, so saving again only appends. `drive.state` has the rest: one line of JSON, packed, and
then the numbers of all arrays. It is replaced as a whole, and says how much of the other file it
counts on. So a program that is killed leaves a state that can be restored.

The classes that may be saved are those of the modules below. To read a file runs no code of it.
"""

from __future__ import annotations

import json
import os
import zlib
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from itertools import chain
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from perception.errors import LogError
from perception.places import closures, distinctive, following, local_map, odometers, skeleton
from perception.places.following import Followed, GrowingTrack
from perception.readers import scans as readers
from perception.readers.scans import LaserScanner, Scan, ScanTable, shared
from ssh_abduction.data.errors import named
from ssh_abduction.data.files import read_file, write_file

STATE, SCANS = "drive.state", "drive.scans"
FORMAT, VERSION = "ssh-live", 2
MOST = 2**30  # bytes of a state
MODULES: tuple[ModuleType, ...] = (
    closures,
    distinctive,
    following,
    local_map,
    odometers,
    readers,
    skeleton,
)
CLASSES = {
    name: kind
    for module in MODULES
    for name, kind in vars(module).items()
    if isinstance(kind, type) and kind.__module__.startswith("perception.")
}
# Attributes with what can be computed again are saved empty.
CACHES = {
    ("LocalMaps", "_known"),
    ("LocalMaps", "_sums"),
    ("ClosureFinder", "_scenes"),
    ("ClosureFinder", "_matches"),
}
# Numbers of a row of `drive.scans` before the ranges: the numbers of the laser and of the ranges,
# the line, the time, two poses, whether the track is cut and broken, and a row of the track.
HEAD = 4 + 3 + 3 + 2 + following.ROW


def to_bytes(value: Any, scans: Mapping[int, int]) -> bytes:
    """Pack a tree of plain values, arrays and objects. `scans` numbers scans by their `id`."""
    arrays: list[bytes] = []
    known: dict[int, int] = {}
    alive = []  # so that no id is used twice

    def attributes(one: Any) -> dict[str, Any]:
        names = [field.name for field in fields(one)] if is_dataclass(one) else [*vars(one)]
        kind = type(one).__name__
        return {name: {} if (kind, name) in CACHES else getattr(one, name) for name in names}

    def plain(one: Any) -> Any:
        match one:
            case Enum():
                return ["enum", type(one).__name__, one.name]
            case None | bool() | str() | float() | int():
                return one
            case np.integer() | np.bool_():
                return one.item()
            case Scan() if id(one) in scans:
                return ["scan", scans[id(one)]]
            case np.ndarray():
                arrays.append(np.ascontiguousarray(one).tobytes())
                return ["array", one.dtype.str, one.shape]
            case list() | tuple() | set():
                return [type(one).__name__, *map(plain, one)]
            case deque():
                return ["deque", one.maxlen, *map(plain, one)]
            case dict():
                return ["dict", *chain.from_iterable((plain(k), plain(v)) for k, v in one.items())]
        if id(one) in known:
            return ["known", known[id(one)]]
        kind = type(one).__name__
        if CLASSES.get(kind) is not type(one):
            raise TypeError(
                f"expected an object of {', '.join(CLASSES)}, got a {kind}; add it there"
            )
        known[id(one)] = len(known)
        alive.append(one)
        return [
            "object",
            kind,
            *chain.from_iterable((k, plain(v)) for k, v in attributes(one).items()),
        ]

    tree = json.dumps(plain(value)).encode()
    return zlib.compress(tree + b"\n" + b"".join(arrays), 1)


def from_bytes(data: bytes, scans: ScanTable) -> Any:
    """Restore what `to_bytes` packed. Raises ValueError, KeyError or TypeError for other data."""
    tree, _, numbers = zlib.decompress(data).partition(b"\n")
    known: list[Any] = []
    used = 0

    def array(kind: str, shape: list[int]) -> Any:
        nonlocal used
        size = int(np.prod(shape)) if shape else 1
        found = np.frombuffer(numbers, kind, size, used).reshape(shape).copy()
        used += found.nbytes
        return found

    def restored(one: Any) -> Any:
        if not isinstance(one, list):
            return one
        sort, *rest = one
        build: dict[str, Callable[[], Any]] = {
            "enum": lambda: CLASSES[rest[0]][rest[1]],  # type: ignore[index]
            "scan": lambda: scans[rest[0]],
            "array": lambda: array(*rest),
            "list": lambda: [*map(restored, rest)],
            "tuple": lambda: (*map(restored, rest),),
            "set": lambda: {*map(restored, rest)},
            "deque": lambda: deque(map(restored, rest[1:]), rest[0]),
            "dict": lambda: dict(pairs(rest)),
            "known": lambda: known[rest[0]],
            "object": lambda: made(CLASSES[rest[0]], rest[1:]),
        }
        return build[sort]()

    def pairs(rest: list[Any]) -> list[tuple[Any, Any]]:
        return [(restored(k), restored(v)) for k, v in zip(rest[::2], rest[1::2], strict=True)]

    def made(kind: type, rest: list[Any]) -> Any:
        one: Any = object.__new__(kind)
        known.append(one)
        for name, value in zip(rest[::2], rest[1::2], strict=True):
            object.__setattr__(one, name, restored(value))
        return one

    return restored(json.loads(tree))


class Folder:
    """A folder in which the state of a drive is saved again and again."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self._saved = self._bytes = 0  # scans, and bytes, that `drive.scans` has
        self._lasers: list[LaserScanner] = []

    def save(self, scans: ScanTable, track: GrowingTrack, state: Any) -> None:
        """Append the new scans and poses, and replace the state. Raises OSError."""
        self.path.mkdir(parents=True, exist_ok=True)
        rows = track.track
        with open(self.path / SCANS, "r+b" if self._saved else "wb") as file:
            file.truncate(self._bytes)
            file.seek(self._bytes)
            for k in range(self._saved, len(scans)):
                scan = scans[k]
                if scan.laser not in self._lasers:
                    self._lasers.append(scan.laser)
                row = (
                    *(self._lasers.index(scan.laser), len(scan.ranges), scan.line),
                    np.nan if scan.time is None else scan.time,
                    *(*scan.odometry, *(scan.corrected or (np.nan,) * 3)),
                    *(k in rows.cuts, k in rows.breaks),
                    *(*rows.poses[k], *rows.covariances[k].ravel(), rows.shares[k]),
                )
                file.write(np.array([*row, *scan.ranges], np.float64).tobytes())
            self._saved, self._bytes = len(scans), file.tell()
        del rows  # It would keep the track from growing.
        numbers = {id(scans[k]): k for k in range(len(scans))}
        head = {"format": FORMAT, "version": VERSION, "bytes": self._bytes}
        lasers = to_bytes(self._lasers, {})
        head |= {"lasers": len(lasers)}
        data = json.dumps(head).encode() + b"\n" + lasers + to_bytes(state, numbers)
        write_file(self.path / STATE, data)

    def load(self) -> tuple[ScanTable, GrowingTrack, Any]:
        """Restore the scans, the track and the state. Raises LogError."""
        file = self.path / STATE
        try:
            first, _, rest = read_file(file, MOST, "the state of a drive", LogError).partition(
                b"\n"
            )
            head = json.loads(first) if first.startswith(b'{"format": "ssh-live"') else {}
            if head.get("version") != VERSION:
                raise LogError(
                    f"{named(file)}: expected a state of version {VERSION}, got "
                    f"{head.get('version', 'another file')}; move it away, and start anew"
                )
            self._lasers = from_bytes(rest[: head["lasers"]], ScanTable())
            with (self.path / SCANS).open("rb") as file_of_scans:
                data = file_of_scans.read(head["bytes"])  # a killed program may have written more
            if len(data) < head["bytes"]:
                raise ValueError(f"{named(self.path / SCANS)} is too short")
            scans, track = self._read(np.frombuffer(data, np.float64))
            state = from_bytes(rest[head["lasers"] :], scans)
        except LogError:
            raise
        except (
            OSError,
            ValueError,
            KeyError,
            TypeError,
            IndexError,
            AttributeError,
            zlib.error,
        ) as error:
            raise LogError(
                f"{named(file)}: expected the state of a drive, got a damaged file ({error}); move "
                "it away, and start anew"
            ) from None
        self._saved, self._bytes = len(scans), head["bytes"]
        return scans, track, state

    def _read(self, rows: np.ndarray[Any, np.dtype[np.float64]]) -> tuple[ScanTable, GrowingTrack]:
        scans, track, at = ScanTable(), GrowingTrack(), 0
        while at < len(rows):
            laser, beams, line, time, *poses = rows[at : at + 10].tolist()
            cut, broken, x, y, heading, *more, share = rows[at + 10 : at + HEAD].tolist()
            ranges = rows[at + HEAD : at + HEAD + int(beams)]
            at += HEAD + int(beams)
            scan = Scan(
                ranges,
                shared(self._lasers[int(laser)]),
                (poses[0], poses[1], poses[2]),
                None if np.isnan(poses[3]) else (poses[3], poses[4], poses[5]),
                None if np.isnan(time) else time,
                int(line),
            )
            scans.append(scan)
            covariance = np.reshape(more, (3, 3))
            one = Followed(scan, (x, y, heading), covariance, share, bool(cut), bool(broken))
            track.add(one)
        return scans, track
