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
from dataclasses import dataclass, field
from functools import lru_cache
from typing import IO

import numpy as np
from numpy.typing import NDArray

from perception.errors import LogError
from perception.readers.lines import LONGEST_LINE, lines
from perception.readers.scans import Damage, Laser, Scan
from ssh_abduction.errors import brief
from ssh_abduction.odometry import Pose, between, moved

# Kinds of scans, the best first, as many logs hold each scan more than once: those that say how the laser is made and where it was, then those that lack one of these.
KINDS = ("ROBOTLASER1", "FLASER", "RAWLASER1")
VERTICES, EDGES = (b"VERTEX2", b"VERTEX_SE2"), (b"EDGE2", b"EDGE_SE2")
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
    mount: Pose | None = None  # the second pose in the frame of the first, at the first scan; and how far it wandered from that
    wandered: tuple[float, float] = (0.0, 0.0)
    same: bool = True
    restarts: int = (
        0  # scans whose pose the next ODOM line repeats, though the one before said otherwise; and scans at which this could be seen
    )
    moves: int = 0
    unmoved: list[int] = field(default_factory=list)  # lines of scans since whose predecessor no ODOM line tells how the robot moved
    at_vertices: bool = True


@dataclass(slots=True)
class _Found:
    """What the first way through a log finds."""

    kinds: dict[str, _Survey] = field(default_factory=dict)
    parameters: dict[str, float] = field(default_factory=dict)
    tags: Counter[str] = field(default_factory=Counter)
    vertices: list[tuple[int, Pose]] = field(default_factory=list)
    edges: dict[tuple[int, int], Pose] = field(default_factory=dict)


@dataclass(frozen=True)
class Reading:
    """A log that has been surveyed, and can now be read.

    items  scans, and what was skipped, in the order of the file
    """

    format: str
    notes: tuple[str, ...]
    items: Iterator[Scan | Damage]


def looks_like(head: bytes) -> bool:
    """Whether the beginning of a file is that of a log in lines: one of them is a message that this reader knows."""
    return (
        re.search(
            rb"^(FLASER|RLASER|ROBOTLASER\d|RAWLASER\d|ODOM|PARAM|SYNC|TRUEPOS|NEFF|VERTEX2|VERTEX_SE2|EDGE2|EDGE_SE2)\s",
            head,
            re.MULTILINE,
        )
        is not None
    )


def read(file: IO[bytes], source: str) -> Reading:
    """A log in lines, surveyed. Raises LogError where it holds no scan, or no odometry."""
    found = _survey(file, source)
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


def _meaning(found: _Found, survey: _Survey, kind: str, source: str, notes: list[str]) -> str:
    """What the poses of the scans are: `edges`, `restarts`, `lines`, `first corrected`, or `raw`, as the head of this module says."""
    if found.vertices:
        if survey.at_vertices and kind == "ROBOTLASER1":
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
    if survey.same and (found.tags["NEFF"] or 2 * survey.restarts > survey.moves > 0):
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
    if survey.wandered[0] > WANDERED[0] or survey.wandered[1] > WANDERED[1]:
        notes.append(f"The first pose in {kind} wanders from the second: the first is taken for a corrected one, the second for odometry.")
        return "first corrected"
    return "raw"


def _mount(found: _Found, survey: _Survey, meaning: str, kind: str) -> Pose:
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


def _survey(file: IO[bytes], source: str) -> _Found:
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
                if len(tokens) > 2 and tokens[1] in _PARAMETERS:
                    found.parameters[_PARAMETERS[tokens[1]]] = _number(tokens[2])
            elif tag in VERTICES:
                found.vertices.append(_vertex(tokens))
            elif tag in EDGES:
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
    survey.same &= line.first == line.second
    survey.at_vertices &= vertex is not None and _are_same(vertex, line.second)
    mount = between(line.second, line.first)
    if survey.mount is None:
        survey.mount = mount
    x, y, angle = between(survey.mount, mount)
    survey.wandered = max(survey.wandered[0], math.hypot(x, y)), max(survey.wandered[1], abs(angle))


def _are_same(a: Pose, b: Pose) -> bool:
    return all(abs(v) <= ROUNDED for v in between(a, b))


def _scans(file: IO[bytes], source: str, found: _Found, kind: str, meaning: str, mount: Pose, reach: float) -> Iterator[Scan | Damage]:
    """The scans, and what was skipped."""
    chain: Pose = (0.0, 0.0, 0.0)  # odometry, where it is pieced together
    odometer: Pose | None = None  # the last ODOM line's
    restarts = False  # whether the next ODOM line starts from a corrected pose
    vertex: tuple[int, Pose] | None = None
    truth: tuple[Pose, Pose] | None = None  # of the last TRUEPOS line: the true pose, and the odometer's

    for number, raw in lines(file, source):
        try:
            tokens = _tokens(raw)
            if not tokens:
                continue
            tag = tokens[0]
            if tag == b"ODOM":
                pose = _pose(tokens, 1)
                if odometer is not None and not restarts:
                    chain = moved(chain, between(odometer, pose))
                odometer, restarts = pose, False
            elif tag == b"TRUEPOS":
                truth = _pose(tokens, 1), _pose(tokens, 4)
            elif tag in VERTICES:
                following = _vertex(tokens)
                if vertex is not None and meaning == "edges":
                    chain = moved(chain, _motion(found, vertex[0], following[0]))
                vertex = following
            elif (line := _scan_line(tokens)) is not None and line.kind == kind:
                first, second = line.first, line.second
                corrected: Pose | None = None
                if meaning == "edges":
                    odometry, corrected = chain, second
                elif meaning == "restarts":
                    odometry, corrected = chain, second
                    odometer, restarts = second, True
                elif meaning == "lines":
                    if odometer is None:
                        raise _Damaged("expected an ODOM line before the first scan, got none")
                    odometry = odometer
                else:
                    assert first is not None
                    assert second is not None
                    odometry = second
                    if meaning == "first corrected":
                        corrected = first
                if truth is not None:
                    corrected = moved(truth[0], between(truth[1], odometry))
                elif vertex is not None:
                    corrected = vertex[1]
                yield Scan(*_measured(line, mount, reach, found.parameters.get("fov")), odometry, corrected, line.time, number)
        except _Damaged as damage:
            restarts = meaning == "restarts"  # the line may have been a scan's, after which ODOM lines start anew
            yield Damage(number, str(damage))


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


def _motion(found: _Found, start: int, end: int) -> Pose:
    """The relative motion from one vertex to the next. Raises _Damaged where no edge says it."""
    if (motion := found.edges.get((start, end))) is not None:
        return motion
    if (back := found.edges.get((end, start))) is not None:
        return between(back, (0.0, 0.0, 0.0))
    raise _Damaged(f"expected an EDGE2 from vertex {start} to {end}, got none")


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
