"""Reader of logs in lines: CARMEN's, and g2o's or TORO's with scans.

CARMEN's lines, of which all others are skipped (http://carmen.sourceforge.net, logger):

    FLASER n range*n x y theta odom_x odom_y odom_theta [time host time]
    ROBOTLASER1 type start fov step reach accuracy remission n range*n m remission*m laser_pose robot_pose tv rv forward side axis [time host time]
    RAWLASER1 type start fov step reach accuracy remission n range*n m remission*m [time host time]
    ODOM x y theta tv rv acceleration [time host time]
    TRUEPOS true_x true_y true_theta odom_x odom_y odom_theta [time host time]
    PARAM name value ...

A g2o-style log has besides, for each scan, the corrected pose (`VERTEX2 id x y theta`, or VERTEX_SE2, in the line before the scan's), and
relative motions (`EDGE2 from to dx dy dtheta ...`, or EDGE_SE2).

What the poses of a log mean does not stand in it. The reader therefore goes through the log twice: the first time it surveys which poses
are the odometer's, how the laser is mounted, and which range says that nothing was near; the second time it yields the scans.

- If all poses of the scans are also those of the vertices, they are corrected ones, and odometry is the chain of the edges from each vertex to the next.
- If the first ODOM line after each scan repeats the scan's pose, whatever the ODOM line before the scan said, then the poses of the scans
  are corrected ones: GMapping writes logs in this way, with a NEFF line after each scan. Its ODOM lines are the odometer's increments, put behind
  each other from the corrected pose of the last scan on. Odometry is then the chain of these increments, from the line that repeats the pose of one scan to
  the last line before the next scan, which was written for the time of that scan. The jump from that line to the scan's own pose is the
  correction, and is no part of the chain.
- If the first pose of the scans wanders from the second, it is a corrected one, and the second the odometer's.
- Else the second pose is the odometer's, and the first is that of the laser, or the same.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import IO, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from perception.errors import LogError
from perception.readers.lines import LONGEST_LINE, lines
from perception.readers.scans import Damage, Laser, Reading, Scan
from ssh_abduction.errors import brief
from ssh_abduction.files import LINE_OF_A_LOG
from ssh_abduction.odometry import Pose, between, moved

# Kinds of scans, the best first, as many logs hold each scan more than once: those that say how the laser is made and where it was, then those that lack one of these.
KINDS = ("ROBOTLASER1", "FLASER", "RAWLASER1")
VERTICES, EDGES = (b"VERTEX2", b"VERTEX_SE2"), (b"EDGE2", b"EDGE_SE2")
# What the poses of the scans are, in the order in which the head of this module names it; `lines` where scans have none.
Meaning: TypeAlias = Literal["edges", "restarts", "first corrected", "raw", "lines"]
# So many scans wait for the next ODOM line, and a vertex is searched so many vertices behind another.
MOST_WAITING = 100
# Of the scans, such a share has to be as a rule says: of some scans lines are damaged.
MOST_SCANS = 0.9
# A scan has at most so many beams.
MOST_BEAMS = 100_000
# Poses beyond this, in metres, are no poses of a robot in a building.
FARTHEST = 1e6
# Two poses are the same up to such a difference in metres and radians: numbers in a log are rounded.
ROUNDED = 2e-3
# Where the laser's pose wanders farther than this from the odometer's, in metres and radians, it has been corrected; wandering less, it may have been read some milliseconds later.
WANDERED = (0.5, 0.25)
# The ranges of a SICK LMS, in centimetres, above this one are codes: "nothing came back", "dazzled", and the like (SICK, Telegrams for LMS 200, 8183 to 8191).
SICK_REACH, SICK_MOST = 81.83, 81.91
# Ranges in metres beyond this one are no measurement of any laser.
NO_RANGE = 1000.0
_WORD = re.compile(rb"[A-Za-z][A-Za-z0-9_]*$")
_PARAMETERS = {
    b"robot_frontlaser_offset": "offset",
    b"robot_frontlaser_side_offset": "side",
    b"robot_frontlaser_angular_offset": "angle",
    b"robot_front_laser_max": "reach",
    b"laser_front_laser_fov": "fov",
}


class _Damaged(Exception):  # noqa: N818 - becomes a Damage
    """A line of a known kind that cannot be read."""


@dataclass(frozen=True, slots=True)
class _ScanLine:
    """A line that holds a scan. `first` and `second` are its poses, the laser's or a corrected one and the robot's, if it has any."""

    kind: str
    ranges: NDArray[np.float64]
    shape: tuple[float, float, float] | None
    first: Pose | None
    second: Pose | None
    time: float | None


@dataclass(slots=True)
class _Survey:
    """What the first way through a log finds of one kind of scans."""

    scans: int = 0
    most: float = 0.0  # the largest range, and how often it came
    repeated: int = 0
    mount: Pose | None = None  # the first pose in the frame of the second, at the first scan; and of how many scans it is another
    wandered: int = 0
    same: int = 0  # scans whose two poses are the same
    restarts: int = (
        0  # scans whose pose the next ODOM line repeats, though the one before said otherwise; and scans at which this could be seen
    )
    moves: int = 0
    unmoved: list[int] = field(default_factory=list)  # lines of scans since whose predecessor no ODOM line tells how the robot moved
    at_vertices: int = 0  # scans whose second pose is that of the vertex before


@dataclass(slots=True)
class _Found:
    """What the first way through a log finds."""

    kinds: dict[str, _Survey] = field(default_factory=dict)
    parameters: dict[str, float] = field(default_factory=dict)
    tags: Counter[str] = field(default_factory=Counter)
    vertices: list[tuple[int, Pose]] = field(default_factory=list)
    edges: dict[tuple[int, int], Pose] = field(default_factory=dict)


def looks_like(head: bytes) -> bool:
    """Whether the beginning of a file is that of a log in lines: one of them is a message that this reader knows."""
    return LINE_OF_A_LOG.search(head) is not None


def read(file: IO[bytes], source: str, format: str | None) -> Reading:
    """A log in lines, surveyed.

    format  `carmen`, where vertices and edges are not read; `g2o`, where they have to be there; or None for what is there

    Raises LogError where the log holds no scan, or no odometry.
    """
    found = _survey(file, source, format != "carmen")
    if format == "g2o" and not found.vertices:
        raise LogError(f"{source}: expected vertices in lines VERTEX2 or VERTEX_SE2, got none; leave the format out, or name carmen")
    if not found.kinds:
        others = ", ".join(f"{count} {tag}" for tag, count in found.tags.most_common(5)) or "none"
        raise LogError(
            f"{source}: expected scans in lines FLASER, ROBOTLASER1 or RAWLASER1, got none (lines: {others}); record the laser, too"
        )
    most = max(survey.scans for survey in found.kinds.values())
    kind = next(kind for kind in KINDS if kind in found.kinds and 2 * found.kinds[kind].scans >= most)
    return _reading(file, source, found, kind)


def _reading(file: IO[bytes], source: str, found: _Found, kind: str) -> Reading:
    survey, notes = found.kinds[kind], []
    others = [other for other in (*found.kinds, "RLASER", "ROBOTLASER2") if other != kind and (other in found.kinds or found.tags[other])]
    if others:
        notes.append(f"The scans are those of the lines {kind}; those of {', '.join(dict.fromkeys(others))} are not read.")
    meaning = _meaning(found, survey, kind, source, notes)
    mount = _mount(found, survey, meaning, kind)
    reach = _reach(found, survey, kind, notes)
    return Reading("g2o" if found.vertices else "carmen", tuple(notes), _scans(file, source, found, kind, meaning, mount, reach))


def _meaning(found: _Found, survey: _Survey, kind: str, source: str, notes: list[str]) -> Meaning:
    """What the poses of the scans are. Raises LogError."""
    if found.vertices:
        if survey.at_vertices >= MOST_SCANS * survey.scans:
            if not found.edges:
                raise LogError(
                    f"{source}: expected odometry, got corrected poses alone (VERTEX2, and the same in {kind}) and no EDGE2; take the log before it was corrected"
                )
            notes.append(
                f"The robot's poses in {kind} are the corrected ones of VERTEX2. Odometry is the chain of the EDGE2 from each vertex to the next."
            )
            return "edges"
        notes.append(f"The poses in {kind} differ from those of VERTEX2: the former are taken for odometry, the latter for corrected ones.")
        return "raw"
    if kind == "RAWLASER1":
        if not found.tags["ODOM"]:
            raise LogError(f"{source}: expected odometry, got neither ODOM lines nor poses in {kind}; record the odometer, too")
        return "lines"
    if survey.same >= MOST_SCANS * survey.scans and (found.tags["NEFF"] or 2 * survey.restarts > survey.moves > 0):
        if not found.tags["ODOM"]:
            raise LogError(
                f"{source}: expected odometry, got corrected poses alone (NEFF lines, but no ODOM); take the log before it was corrected"
            )
        notes.append(
            f"The poses in {kind} are corrected ones, from which the ODOM lines start anew after each scan, as GMapping writes them. Odometry was pieced together: it is the "
            "chain of the increments of the ODOM lines between two scans, without the jumps of the correction. It is no recorded odometry."
        )
        if survey.unmoved:
            where = ", ".join(map(str, survey.unmoved[:5])) + (", …" if len(survey.unmoved) > 5 else "")
            notes.append(
                f"No ODOM line tells how the robot moved before the scans in these {len(survey.unmoved)} lines, so that it seems to have stood still: {where}."
            )
        return "restarts"
    if survey.wandered > (1 - MOST_SCANS) * survey.scans:
        notes.append(f"The first pose in {kind} wanders from the second: the first is taken for a corrected one, the second for odometry.")
        return "first corrected"
    return "raw"


def _mount(found: _Found, survey: _Survey, meaning: Meaning, kind: str) -> Pose:
    """The pose of the laser in the frame of the robot: what its poses say, else what the parameters say."""
    own = survey.mount
    if own is not None and meaning in ("raw", "edges") and max(map(abs, own)) > ROUNDED:
        x, y, angle = own
        return round(x, 3), round(y, 3), round(angle, 4)
    if kind == "ROBOTLASER1" and meaning != "first corrected":
        return (0.0, 0.0, 0.0)
    parameters = found.parameters
    return parameters.get("offset", 0.0), parameters.get("side", 0.0), parameters.get("angle", 0.0)


def _reach(found: _Found, survey: _Survey, kind: str, notes: list[str]) -> float:
    """The range that says that nothing was near, where lines do not say it themselves."""
    if kind != "FLASER":
        return math.inf
    if (reach := found.parameters.get("reach", 0.0)) > 0:
        return reach
    counted = survey.most if survey.repeated > 2 else math.ceil(survey.most)
    reach = SICK_REACH if SICK_REACH <= survey.most <= SICK_MOST else counted
    notes.append(
        f"The log does not say how far the laser reaches. By its largest range, {survey.most:g} m, which came {survey.repeated} times, it is {reach:g} m."
    )
    return reach


def _survey(file: IO[bytes], source: str, with_graph: bool) -> _Found:
    found = _Found()
    odometer: Pose | None = None
    since: dict[str, int] = {}  # ODOM lines since the last scan of a kind
    waiting: tuple[_Survey, Pose, Pose] | None = None  # a scan's survey, its pose, and the odometer's before it: until the next ODOM line
    for number, raw in lines(file, source):
        tokens = raw.split() if raw is not None else []
        if not tokens or not _WORD.match(tokens[0]):
            continue
        tag = tokens[0]
        if len(found.tags) < 100:
            found.tags[tag[:20].decode("ascii")] += 1
        try:
            if tag == b"ODOM":
                pose = _pose(tokens, 1)
                since = {kind: count + 1 for kind, count in since.items()}
                if waiting is not None:
                    survey, at, before = waiting
                    if before != at:
                        survey.moves += 1
                        survey.restarts += pose == at
                    waiting = None
                odometer = pose
            elif tag == b"PARAM":
                found.parameters.update(_parameter(tokens))
            elif tag in VERTICES and with_graph:
                found.vertices.append(_vertex(tokens))
            elif tag in EDGES and with_graph:
                ends, motion = _edge(tokens)
                found.edges.setdefault(ends, motion)
            elif (line := _scan_line(tokens)) is not None:
                survey = found.kinds.setdefault(line.kind, _Survey())
                _count(survey, line, found.vertices[-1][1] if found.vertices else None)
                if since.get(line.kind, 2) < 2:  # the first only repeats the pose of the scan before
                    survey.unmoved.append(number)
                since[line.kind] = 0
                waiting = (survey, line.second, odometer) if line.second is not None and odometer is not None else None
        except _Damaged:
            continue
    return found


def _count(survey: _Survey, line: _ScanLine, vertex: Pose | None) -> None:
    survey.scans += 1
    ranges = line.ranges[line.ranges <= NO_RANGE]
    most = float(ranges.max(initial=0.0))
    if most > survey.most:
        survey.most, survey.repeated = most, 0
    if most == survey.most:
        survey.repeated += int(np.count_nonzero(ranges == most))
    if line.first is None or line.second is None:
        return
    survey.same += line.first == line.second
    survey.at_vertices += vertex is not None and _are_same(vertex, line.second)
    mount = between(line.second, line.first)
    if survey.mount is None:
        survey.mount = mount
    x, y, angle = between(survey.mount, mount)
    survey.wandered += math.hypot(x, y) > WANDERED[0] or abs(angle) > WANDERED[1]


def _are_same(a: Pose, b: Pose) -> bool:
    return all(abs(v) <= ROUNDED for v in between(a, b))


def _scans(file: IO[bytes], source: str, found: _Found, kind: str, meaning: Meaning, mount: Pose, reach: float) -> Iterator[Scan | Damage]:
    """The scans, and what was skipped."""
    odometer = _Odometer(found, meaning)
    waiting: list[Scan | Damage] = []  # scans without a pose, whose place is known with the next ODOM line
    fov = found.parameters.get("fov")
    for number, raw in lines(file, source):
        tag = b""
        try:
            tokens = _tokens(raw)
            if not tokens:
                continue
            tag = tokens[0]
            if tag != kind.encode():
                odometer.hear(tag, tokens)
            elif (line := _scan_line(tokens)) is not None:
                scan = Scan(*_measured(line, mount, reach, fov), *odometer.place(line), line.time, number)
                waiting.append(scan)
        except _Damaged as damage:
            odometer.mishear(tag)
            waiting.append(Damage(number, str(damage)))
        if meaning != "lines" or tag == b"ODOM" or len(waiting) >= MOST_WAITING:
            yield from map(odometer.placed, waiting)
            waiting.clear()
    yield from map(odometer.placed, waiting)


@dataclass(slots=True)
class _Odometer:
    """Where the odometer puts the scans, by the lines of a log so far.

    chain     odometry, where it is pieced together
    last      pose and time of the last ODOM line; and of the one before
    restarts  whether the next ODOM line starts from a corrected pose, and tells of no motion
    truth     of the last TRUEPOS line: the true pose, and the odometer's
    """

    found: _Found
    meaning: Meaning
    chain: Pose = (0.0, 0.0, 0.0)
    last: tuple[Pose, float | None] | None = None
    before: tuple[Pose, float | None] | None = None
    restarts: bool = False
    vertex: tuple[int, Pose] | None = None
    truth: tuple[Pose, Pose] | None = None

    def hear(self, tag: bytes, tokens: list[bytes]) -> None:
        """Take in a line that is no scan's. Raises _Damaged."""
        if tag == b"ODOM":
            pose = _pose(tokens, 1)
            if self.last is not None and not self.restarts:
                self.chain = moved(self.chain, between(self.last[0], pose))
            self.before, self.last, self.restarts = self.last, (pose, _time(tokens, 7)), False
        elif tag == b"TRUEPOS":
            self.truth = _pose(tokens, 1), _pose(tokens, 4)
        elif tag == b"PARAM":
            _parameter(tokens)  # which the survey took, as it took the edges, without a word of what is damaged
        elif self.found.vertices and tag in EDGES:
            _edge(tokens)
        elif self.found.vertices and tag in VERTICES:
            vertex = _vertex(tokens)
            if self.vertex is not None and self.meaning == "edges":
                self.chain = moved(self.chain, _motion(self.found.edges, self.vertex[0], vertex[0]))
            self.vertex = vertex

    def mishear(self, tag: bytes) -> None:
        """Take in that a line is damaged. It may have been a scan's, after which ODOM lines start anew; then the next one is not taken for a motion."""
        self.restarts |= self.meaning == "restarts" and tag != b"ODOM"

    def place(self, line: _ScanLine) -> tuple[Pose, Pose | None]:
        """The pose of a scan by the odometer, and its corrected one, where it is known. Raises _Damaged."""
        first, second = line.first, line.second
        corrected: Pose | None = None
        if first is None or second is None:
            odometry = self.chain  # until it is placed
        elif self.meaning == "edges":
            if self.vertex is None or not _are_same(self.vertex[1], second):
                raise _Damaged("expected the pose of the vertex before, got another; the line of its own vertex is missing")
            return self.chain, second
        elif self.meaning == "restarts":
            odometry, corrected = self.chain, second
            self.last, self.restarts = (second, line.time), True
        else:
            odometry = second
            corrected = first if self.meaning == "first corrected" else None
        if self.truth is not None:
            corrected = moved(self.truth[0], between(self.truth[1], odometry))
        elif self.vertex is not None:
            corrected = self.vertex[1]
        return odometry, corrected

    def placed(self, item: Scan | Damage) -> Scan | Damage:
        """A scan that has no pose of its own, where the odometer was at its time between the last two ODOM lines; all else unchanged."""
        if self.meaning != "lines" or isinstance(item, Damage) or self.last is None:
            return item
        (start, began), (end, ended) = self.before or self.last, self.last
        if began is None or ended is None or item.time is None or not began <= item.time <= ended or began == ended:
            share = 0.0  # times that are cut, or run backwards, tell nothing
        else:
            share = (item.time - began) / (ended - began)
        dx, dy, turned = between(start, end)
        return replace(item, odometry=moved(start, (share * dx, share * dy, share * turned)))


def _tokens(raw: bytes | None) -> list[bytes]:
    """The words of a line; none where it is empty or a comment. Raises _Damaged for what is no message."""
    if raw is None:
        raise _Damaged(f"expected a line of at most {LONGEST_LINE // 2**20} MiB, got a longer one")
    tokens = raw.split()
    if not tokens or tokens[0].startswith(b"#"):
        return []
    if not _WORD.match(tokens[0]):
        raise _Damaged(f"expected the name of a message, got {_quoted(tokens[0])}")
    return tokens


def _motion(edges: dict[tuple[int, int], Pose], start: int, end: int) -> Pose:
    """The relative motion from one vertex to another, over those between where there is no edge. Raises _Damaged where no edges say it."""
    if (motion := edges.get((start, end))) is not None:
        return motion
    if (back := edges.get((end, start))) is not None:
        return between(back, (0.0, 0.0, 0.0))
    motion = (0.0, 0.0, 0.0)
    for vertex in range(start, min(end, start + MOST_WAITING)):
        if (step := edges.get((vertex, vertex + 1))) is None:
            break
        motion = moved(motion, step)
    else:
        if start < end <= start + MOST_WAITING:
            return motion
    raise _Damaged(f"expected an EDGE2 from vertex {start} to {end}, got none; the robot seems to have stood still")


def _measured(line: _ScanLine, mount: Pose, reach: float, fov: float | None) -> tuple[NDArray[np.float64], Laser]:
    beams = len(line.ranges)
    if line.shape is None:
        laser = _conventional(beams, math.pi if fov is None or not 0 < fov <= math.tau else fov, reach, mount)
    else:
        laser = _described(*line.shape, beams, mount)
    ranges = line.ranges
    with np.errstate(invalid="ignore"):
        ranges[ranges >= laser.reach] = np.inf
        ranges[ranges <= 0] = np.nan
    return ranges, laser


@lru_cache(maxsize=64)
def _conventional(beams: int, fov: float, reach: float, mount: Pose) -> Laser:
    """The laser of FLASER lines: the first beam is at the right. A SICK's last beam, at the left, is left out where the number of beams is even."""
    step = fov / max(1, beams - beams % 2)
    return Laser(-fov / 2, step, beams, reach, mount)


@lru_cache(maxsize=64)
def _described(first: float, step: float, reach: float, beams: int, mount: Pose) -> Laser:
    return Laser(first, step, beams, reach, mount)


def _scan_line(tokens: list[bytes]) -> _ScanLine | None:
    """The scan that a line holds; None where the line is of another kind. Raises _Damaged."""
    kind = tokens[0].decode("ascii")
    if kind not in KINDS:
        return None
    if kind == "FLASER":
        beams, after = _ranges(tokens, 1)
        poses = after
        end = after + 6
        shape = None
    else:
        if len(tokens) < 9:
            raise _Damaged(f"expected at least 8 values after {kind}, got {len(tokens) - 1}")
        start, step, reach = _number(tokens[2]), _number(tokens[4]), _number(tokens[5])
        if not 0 < abs(step) <= math.tau or abs(start) > 2 * math.tau:
            raise _Damaged(f"expected a start and a step in radians, got {start:g} and {step:g}")
        shape = start, step, reach if reach > 0 else math.inf
        beams, after = _ranges(tokens, 8)
        poses = after + 1 + _whole(tokens[after] if after < len(tokens) else b"", "remissions")
        end = poses if kind == "RAWLASER1" else poses + 11
    if not end <= len(tokens) <= end + 3:
        raise _Damaged(f"expected {end} to {end + 3} words in a {kind} of {len(beams)} beams, got {len(tokens)}")
    first, second = (None, None) if kind == "RAWLASER1" else (_pose(tokens, poses), _pose(tokens, poses + 3))
    return _ScanLine(kind, beams, shape, first, second, _time(tokens, end))


def _ranges(tokens: list[bytes], at: int) -> tuple[NDArray[np.float64], int]:
    """The ranges whose number stands at a position, and the position after them."""
    count = _whole(tokens[at] if at < len(tokens) else b"", "beams")
    if count == 0:
        raise _Damaged("expected at least one beam, got none")
    start = at + 1
    words = tokens[start : start + count]
    if len(words) < count:
        raise _Damaged(f"expected {count} ranges, got {len(words)}")
    try:
        return np.array(list(map(float, words))), start + count
    except ValueError:
        wrong = next(word for word in words if not _is_number(word))
        raise _Damaged(f"expected a range, got {_quoted(wrong)}") from None


def _pose(tokens: list[bytes], at: int) -> Pose:
    if len(tokens) < at + 3:
        raise _Damaged(f"expected a pose of three numbers after word {at}, got {max(0, len(tokens) - at)}")
    x, y, heading = map(_number, tokens[at : at + 3])
    if max(abs(x), abs(y)) > FARTHEST or abs(heading) > FARTHEST:
        raise _Damaged(f"expected a pose in metres and radians, got {x:g} {y:g} {heading:g}")
    return x, y, heading


def _vertex(tokens: list[bytes]) -> tuple[int, Pose]:
    return _whole(tokens[1] if len(tokens) > 1 else b"", "vertex"), _pose(tokens, 2)


def _edge(tokens: list[bytes]) -> tuple[tuple[int, int], Pose]:
    if len(tokens) < 3:
        raise _Damaged("expected an edge between two vertices, got fewer words")
    return (_whole(tokens[1], "vertex"), _whole(tokens[2], "vertex")), _pose(tokens, 3)


def _parameter(tokens: list[bytes]) -> dict[str, float]:
    """What a PARAM line says, if it says something of the laser."""
    if len(tokens) < 2 or tokens[1] not in _PARAMETERS:
        return {}
    return {_PARAMETERS[tokens[1]]: _number(tokens[2] if len(tokens) > 2 else b"")}


def _time(tokens: list[bytes], at: int) -> float | None:
    """The time at a position, if there is one: nothing depends on it, so a time that cannot be read is none."""
    if at >= len(tokens) or not _is_number(tokens[at]):
        return None
    time = float(tokens[at])
    return time if math.isfinite(time) else None


def _number(word: bytes) -> float:
    """A finite number. Raises _Damaged."""
    if not _is_number(word) or not math.isfinite(value := float(word)):
        raise _Damaged(f"expected a finite number, got {_quoted(word)}")
    return value


def _whole(word: bytes, what: str) -> int:
    """A whole number that is not negative. Raises _Damaged."""
    if not (word.isdigit() and len(word) < 10) or (value := int(word)) > MOST_BEAMS * 1000:
        raise _Damaged(f"expected a number ({what}), got {_quoted(word)}")
    return value


def _is_number(word: bytes) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _quoted(word: bytes) -> str:
    return brief(word[:40].decode("utf-8", "replace"), 40)
