"""Move a map into the frame of another map, such as that of Nav2, by points known in both.

>>> frame = MapFrame.of_points({"door": (0, 1 + 1j), "desk": (2, 1 + 3j)})
>>> frame.residuals, frame.sentence.split("; ")[2]
((('door', 0.0), ('desk', 0.0)), 'distances there are 1.000 times those of the map')
"""

from __future__ import annotations

import cmath
import csv
import io
import math
import os
from bisect import bisect
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ssh_abduction.data.drives import Drive, step_of
from ssh_abduction.data.errors import AbductionError, MapError, brief, named
from ssh_abduction.data.files import read_file, save_file
from ssh_abduction.data.map_parts import Pose, thing_named
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.output.layout import fitted_motion, turned_pose

COLUMNS = "place,x,y or step,x,y or time,x,y, each perhaps with yaw, or map_x,map_y,x,y"
LARGEST = 2**26  # bytes of a file of poses
SECONDS = 1.0  # between two poses of a file, between which a step may lie
NEAREST = 0.5  # in metres; nearer points say too little about the rotation


@dataclass(frozen=True)
class MapFrame:
    """Where another frame has the origin of a map. A point p of the map is at turn * p + shift.

    Attributes:
        turn: The rotation, a complex number of length 1.
        shift: The origin of the map in the other frame, in metres.
        residuals: How far each point is from where it should be, in metres, by its name.
        scale: By how much distances between the points are longer in the frame than in the map.
        mirrored: The residuals, as a root mean square, if the points of the map were mirrored.
    """

    turn: complex
    shift: complex
    residuals: tuple[tuple[str, float], ...] = ()
    scale: float = 1.0
    mirrored: float = math.inf

    @classmethod
    def of_origin(cls, x: float, y: float, degrees: float) -> MapFrame:
        """Make a frame from the pose of the first dstate in it."""
        return cls(cmath.rect(1, math.radians(degrees)), complex(x, y))

    @classmethod
    def of_points(cls, points: Mapping[str, tuple[complex, complex]]) -> MapFrame:
        """Fit a frame by least squares: the rotation and the shift, without a scale.

        Args:
            points: Points by their names, each in the map and in the frame, in metres.

        Raises:
            MapError: There are fewer than two points, or all are at one position in the map or in
                the frame.
        """
        pairs = [*points.values()]
        if min((_spread(side) for side in zip(*pairs, strict=True)), default=0.0) < NEAREST:
            raise MapError(
                f"frame: expected two points that are {NEAREST:g} m apart or more, got "
                f"{len(pairs)} within less; give points that are far apart"
            )
        turn, shift, off = _fitted(pairs)
        _, _, mirrored = _fitted([(a.conjugate(), b) for a, b in pairs])
        scale = _extent(pairs, 1) / _extent(pairs, 0)
        return cls(turn, shift, tuple(zip(points, off, strict=True)), scale, _mean(mirrored))

    @property
    def sentence(self) -> str:
        """How many points the frame was fitted to, and how far they are off, in words."""
        off = [metres for _, metres in self.residuals]
        worst, most = max(self.residuals, key=lambda point: point[1], default=("", 0.0))
        said = f"residuals {_mean(off):.2f} m (root mean square), at most {most:.2f} m ({worst})"
        share = f"distances there are {self.scale:.3f} times those of the map"
        if self.mirrored < _mean(off) / 2 - 0.01:  # not if both are 0
            share += f"; mirrored, they fit to {self.mirrored:.2f} m: is -y meant, or y,x?"
        return f"{len(off)} points; {said}; {share}"

    def moved(self, ssh_map: SSHMap) -> SSHMap:
        """Return the same map with its poses, paths, corridors, rooms and doors in this frame.

        Raises:
            MapError: The map has no poses, or has several floors or pieces, each with its frame.
        """
        _check(ssh_map)
        assert ssh_map.fit is not None

        def point(at: tuple[float, float]) -> tuple[float, float]:
            z = self.turn * complex(*at) + self.shift
            return z.real, z.imag

        def line(some: Iterable[tuple[float, float]]) -> tuple[tuple[float, float], ...]:
            return tuple(map(point, some))

        poses = tuple(
            turned_pose(pose, self.turn, complex(*point((pose.x, pose.y))))
            for pose in ssh_map.fit.poses
        )
        building = ssh_map.building
        if building is not None:
            building = replace(
                building,
                corridors=tuple(replace(c, line=line(c.line)) for c in building.corridors),
                rooms=tuple(replace(r, outline=line(r.outline)) for r in building.rooms),
                doors=tuple(replace(d, at=point(d.at)) for d in building.doors),
            )
        return replace(
            ssh_map,
            fit=replace(ssh_map.fit, poses=poses),
            paths=tuple(replace(path, line=line(path.line)) for path in ssh_map.paths),
            building=building,
        )


def _fitted(pairs: Sequence[tuple[complex, complex]]) -> tuple[complex, complex, list[float]]:
    """The rotation and the shift that fit best, and how far each point is off then."""
    turn, shift = fitted_motion([a for a, _ in pairs], [b for _, b in pairs])
    return turn, shift, [abs(turn * a + shift - b) for a, b in pairs]


def _mean(off: Sequence[float]) -> float:
    """The root mean square."""
    return math.sqrt(sum(metres**2 for metres in off) / max(1, len(off)))


def _spread(points: Sequence[complex]) -> float:
    """The largest distance between two points."""
    return max(abs(a - b) for a in points for b in points)


def _extent(pairs: Sequence[tuple[complex, complex]], side: int) -> float:
    """The root of the sum of squared distances from the middle of the points, in one frame."""
    middle = sum(pair[side] for pair in pairs) / len(pairs)
    return math.sqrt(sum(abs(pair[side] - middle) ** 2 for pair in pairs))


def has_frame(ssh_map: SSHMap) -> bool:
    """Whether all poses of a map are in one frame, which can be moved into another one."""
    one = len(ssh_map.pieces) <= 1 and len(ssh_map.floors) <= 1
    return one and bool(_poses(ssh_map))


def _check(ssh_map: SSHMap) -> None:
    if not _poses(ssh_map):
        raise MapError("frame: expected a map with poses, got one without; map a robot's log")
    if not has_frame(ssh_map):
        raise MapError(
            "frame: expected a map of one piece and one floor, got several, each with its own "
            "frame; map the drives of one floor"
        )


def frame_of_file(
    path: str | os.PathLike[str],
    ssh_map: SSHMap,
    trace: Trace | None = None,
    drives: Sequence[Drive] = (),
) -> MapFrame:
    """Fit a frame to the poses in a CSV file.

    The first line has the names of the columns: x and y in metres, perhaps yaw in radians, and
    `map_x` and `map_y` (the same point in the map), `place` (such as p4 or a name), `step` (such
    as 12 or monday:12) or `time` (seconds, as the scans have it; the poses of a localiser, between
    which those of steps are interpolated). A yaw counts as a second point, a metre ahead.

    Args:
        path: The file.
        ssh_map: The map.
        trace: The trace of the map, which has the times of steps.
        drives: The drives of the trace, to name steps.

    Raises:
        MapError: The file cannot be read, a line is wrong, or the points are too near each other.
    """
    _check(ssh_map)
    data = read_file(path, LARGEST, "a readable file of poses", MapError)
    rows = csv.reader(io.StringIO(data.decode("utf-8-sig", "replace")), skipinitialspace=True)
    header = [name.strip().lower() for name in next(rows, [])]
    keys = [name for name in ("place", "step", "time", "map_x") if name in header]
    needed = {"x", "y", *(["map_y"] if "map_x" in keys else [])}
    if len(keys) != 1 or not needed <= {*header}:
        raise MapError(
            f"{named(path)}: line 1: expected the names of columns, {COLUMNS}, got "
            f"{brief(','.join(header))}; write them"
        )
    reader = _PoseReader(ssh_map, drives, {name: k for k, name in enumerate(header)}, keys[0])
    points: dict[str, tuple[complex, complex]] = {}
    timed: list[tuple[float, complex, float | None]] = []
    for row in rows:
        if not any(cell.strip() for cell in row) or row[0].startswith("#"):
            continue
        try:
            if keys == ["time"]:
                timed.append((reader.number(row, "time"), *reader.pose(row)))
            else:
                points |= reader.points(row, rows.line_num)
        except AbductionError as error:
            raise MapError(f"{named(path)}: line {rows.line_num}: {error}") from None
    if keys == ["time"]:
        points = dict(_at_steps(sorted(timed, key=lambda pose: pose[0]), ssh_map, trace))
        if not points:
            said = "expected poses at the times of the log, got none around a step; give such poses"
            raise MapError(f"{named(path)}: time: {said}")
    try:
        return MapFrame.of_points(points)
    except MapError as error:
        raise MapError(f"{named(path)}: {error}") from None


def write_points(file: Path, points: Sequence[Sequence[float]]) -> str:
    """Write points for `frame_of_file`: of each its position in the map and in the frame.

    Returns how well they fit. Raises MapError, also if the file has something else.
    """
    pairs = {f"point {k}": (complex(*p[:2]), complex(*p[2:])) for k, p in enumerate(points, 1)}
    frame = MapFrame.of_points(pairs)
    head = "map_x,map_y,x,y"
    if file.exists() and not file.read_bytes().startswith(head.encode()):
        raise MapError(
            f"{named(file)}: expected no such file, or points that the page wrote, got another "
            "file; move it"
        )
    rows = [",".join(f"{number:g}" for number in point) for point in points]
    save_file(file, "\n".join([head, *rows, ""]).encode(), "points", MapError)
    return frame.sentence


class _PoseReader:
    """Reads the rows of a file of poses. All methods raise MapError."""

    def __init__(
        self, ssh_map: SSHMap, drives: Sequence[Drive], column: Mapping[str, int], key: str
    ) -> None:
        self._map, self._drives, self._column, self._key = ssh_map, drives, column, key

    def cell(self, row: Sequence[str], name: str) -> str:
        k = self._column[name]
        return row[k].strip() if k < len(row) else ""

    def number(self, row: Sequence[str], name: str) -> float:
        try:
            value = float(text := self.cell(row, name))
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise MapError(f"{name}: expected a number, got {brief(text)}; write one")
        return value

    def pose(self, row: Sequence[str]) -> tuple[complex, float | None]:
        """Read a position, and the yaw if there is one."""
        has_yaw = "yaw" in self._column and self.cell(row, "yaw")
        at = complex(self.number(row, "x"), self.number(row, "y"))
        return at, self.number(row, "yaw") if has_yaw else None

    def points(self, row: Sequence[str], line: int) -> dict[str, tuple[complex, complex]]:
        """Read a row about a point, a place or a step."""
        at, yaw = self.pose(row)
        text = self.cell(row, self._key)
        if self._key == "map_x":
            here = complex(self.number(row, "map_x"), self.number(row, "map_y"))
            return {f"line {line}": (here, at)}
        label = self._label(text)
        if self._key == "place" and yaw is not None:
            raise MapError("yaw: expected none for a place, which has no heading; name a step")
        return dict(_points(f"{text}, line {line}", _poses(self._map)[label], at, yaw))

    def _label(self, text: str) -> int:
        """Find the dstate that a row is about."""
        if self._key == "step":
            return self._map.dstate_at[step_of(self._drives, text)]
        kind, number = thing_named(text, self._map.names) or ("", -1)
        if text.isdecimal():
            kind = "place"
        label = next((s.id for s in self._map.dstates if s.place == number), None)
        if kind != "place" or label is None:
            raise MapError(
                f"place: expected a place of the map, such as p{self._map.places[0]} or its name, "
                f"got {brief(text)}; ssh-abduction show lists them"
            )
        return label


def _poses(ssh_map: SSHMap) -> tuple[Pose, ...]:
    return ssh_map.fit.poses if ssh_map.fit else ()


def _points(
    name: str, pose: Pose, at: complex, yaw: float | None
) -> Iterator[tuple[str, tuple[complex, complex]]]:
    """Yield the point of a pose in both frames, and with a yaw a second one a metre ahead."""
    here = complex(pose.x, pose.y)
    yield name, (here, at)
    if yaw is not None:
        yield f"ahead of {name}", (here + cmath.rect(1, pose.heading), at + cmath.rect(1, yaw))


def _at_steps(
    timed: Sequence[tuple[float, complex, float | None]], ssh_map: SSHMap, trace: Trace | None
) -> Iterator[tuple[str, tuple[complex, complex]]]:
    """Interpolate the poses of a localiser at the times of the steps."""
    times = [time for time, _, _ in timed]
    steps: Any = () if trace is None else trace.steps
    for t, step in enumerate(steps):
        time = step.extra.get("time")
        k = 0 if time is None else bisect(times, time)
        if 0 < k < len(times) and times[k] - times[k - 1] <= SECONDS:
            (begin, here, yaw), (end, there, other) = timed[k - 1 : k + 1]
            share = (time - begin) / (end - begin)
            if yaw is not None and other is not None:
                yaw += share * math.remainder(other - yaw, math.tau)
            pose = _poses(ssh_map)[ssh_map.dstate_at[t]]
            yield from _points(f"step {t}", pose, here + share * (there - here), yaw)
