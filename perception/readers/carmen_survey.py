"""Parses the lines of logs of CARMEN, g2o and TORO, and finds out what they mean.

The survey is the first pass of `carmen`, where the possible meanings of poses are listed.
"""

from __future__ import annotations

import math
import re
from array import array
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, reduce
from itertools import pairwise
from typing import IO, Any, Literal, TypeAlias

import numpy as np

from perception.errors import LogError
from perception.readers.lines import LONGEST_LINE, lines
from perception.readers.scans import Array, Damaged
from ssh_abduction.data.errors import brief
from ssh_abduction.data.odometry import Pose, displacement_between, moved
from ssh_abduction.data.words import counted

# Kinds of lines with scans. Many logs hold each scan in several kinds of lines, so the most
# informative kind comes first: with the geometry of the laser and poses, without the geometry,
# without poses.
KINDS = ("ROBOTLASER1", "FLASER", "RAWLASER1")
# The lines of a pose graph.
VERTICES, EDGES = (b"VERTEX2", b"VERTEX_SE2"), (b"EDGE2", b"EDGE_SE2")
# Largest number of beams of a scan.
MOST_BEAMS = 100_000
# Poses beyond this, in metres, are not poses of a robot in a building.
FARTHEST = 1e6
NAME = re.compile(rb"[A-Za-z][A-Za-z0-9_]*$")
_PARAMETERS = {
    b"robot_frontlaser_offset": "offset",
    b"robot_frontlaser_side_offset": "side",
    b"robot_frontlaser_angular_offset": "angle",
    b"robot_front_laser_max": "reach",
    b"laser_front_laser_fov": "fov",
}
# Meaning of the poses of the scans. The first four are the cases in the docstring of `carmen`, in
# its order. `lines` means that scans have no poses, and ODOM lines between scans give them.
Meaning: TypeAlias = Literal["edges", "restarts", "first corrected", "raw", "lines"]
Odom: TypeAlias = tuple[Pose, float | None]  # pose and time of an ODOM line
# A rule about scans holds if this share of the scans follows it, since lines may be damaged.
MOST_SCANS = 0.9
# The first pose is corrected if it is this far from the second, in metres or radians. Smaller
# differences may come from a delay of milliseconds.
WANDERED = (0.5, 0.25)
# Mounts of the laser count as equal up to this difference, in metres and radians, since some logs
# have two decimals.
MOUNTED = 0.02
# Ranges of a SICK LMS from here on, in metres, are codes such as "nothing came back" or "dazzled"
# (SICK, Telegrams for LMS 200, values 8183 to 8191).
SICK_REACH, SICK_MOST = 81.83, 81.92
# No laser measures ranges beyond this, in metres.
NO_RANGE = 1000.0
# Equal poses differ by at most this, in metres and radians, since numbers in a log are rounded.
ROUNDED = 2e-3
# Between two vertices that follow each other in the file, at most this many may be missing because
# their lines are damaged.
MOST_BETWEEN = 100


@dataclass(frozen=True, slots=True)
class ScanLine:
    """A line that holds a scan."""

    kind: str  # first word of the line, one of KINDS
    ranges: Array  # (n,) ranges in metres
    # Bearing of the first beam and step between beams in radians, and reach in metres; None if the
    # line does not have them.
    shape: tuple[float, float, float] | None
    first: Pose | None  # first pose: the pose of the laser, or a corrected pose; None without poses
    second: Pose | None  # second pose: the pose of the robot; None without poses
    time: float | None  # seconds; None if missing
    after: int  # number of words after the poses


def words(raw: bytes | None) -> list[bytes]:
    """Split a line into words. None is a line that was too long to be read.

    Raises Damaged for such a line, or one that does not begin with the name of a message.
    """
    if raw is None:
        raise Damaged(f"expected a line of at most {LONGEST_LINE // 2**20} MiB, got a longer one")
    tokens = raw.split()
    if not tokens or tokens[0].startswith(b"#"):
        return []
    if not NAME.match(tokens[0]):
        raise Damaged(f"expected the name of a message, got {_quoted(tokens[0])}")
    return tokens


def scan_line(tokens: list[bytes]) -> ScanLine | None:
    """Parse a line with a scan; None for another kind of line. Raises Damaged."""
    kind = tokens[0].decode("ascii")
    if kind not in KINDS:
        return None
    # A FLASER line has only ranges and poses. Lines of other kinds begin with the geometry.
    if kind == "FLASER":
        beams, after = _ranges(tokens, 1)
        poses = after
        end = after + 6
        shape = None
    else:
        if len(tokens) < 9:
            raise Damaged(f"expected at least 8 values after {kind}, got {len(tokens) - 1}")
        start, step = number_of(tokens[2]), number_of(tokens[4])
        reach = number_of(tokens[5], may_be_infinite=True)
        if not 0 < abs(step) <= math.tau or abs(start) > 2 * math.tau:
            raise Damaged(f"expected a start and a step in radians, got {start:g} and {step:g}")
        shape = start, step, reach if reach > 0 else math.inf
        beams, after = _ranges(tokens, 8)
        poses = after + 1 + _whole(tokens[after] if after < len(tokens) else b"", "remissions")
        end = poses if kind == "RAWLASER1" else poses + 11
    if not end <= len(tokens) <= end + 3:
        raise Damaged(
            f"expected {end} to {end + 3} words in a {kind} of {len(beams)} beams, got "
            f"{len(tokens)}"
        )
    first = second = None
    if kind != "RAWLASER1":
        first, second = pose_at(tokens, poses), pose_at(tokens, poses + 3)
    return ScanLine(kind, beams, shape, first, second, time_at(tokens, end), len(tokens) - end)


def refuse_cut(tag: bytes, count: int, usual: int) -> None:
    """Raise Damaged if a line has fewer words than usual. Then its last number may be cut, too."""
    if count < usual:
        raise Damaged(
            f"expected at least {usual - count} more words, as most lines {tag.decode('ascii')} "
            "have, got the end of a line that was cut"
        )


def _ranges(tokens: list[bytes], at: int) -> tuple[Array, int]:
    """Parse a count at index `at` and its ranges: metres, (n,), and the index after them."""
    count = _whole(tokens[at] if at < len(tokens) else b"", "beams")
    if count == 0:
        raise Damaged("expected at least one beam, got none")
    start = at + 1
    words = tokens[start : start + count]
    if len(words) < count:
        raise Damaged(f"expected {count} ranges, got {len(words)}")
    try:
        return np.array(list(map(float, words))), start + count
    except ValueError:
        wrong = next(word for word in words if not _is_number(word))
        raise Damaged(f"expected a range, got {_quoted(wrong)}") from None


def pose_at(tokens: list[bytes], at: int) -> Pose:
    """Parse the pose that begins at word `at`, in metres and radians. Raises Damaged."""
    if len(tokens) < at + 3:
        raise Damaged(
            f"expected a pose of three numbers after word {at}, got {max(0, len(tokens) - at)}"
        )
    x, y, heading = map(number_of, tokens[at : at + 3])
    if max(abs(x), abs(y)) > FARTHEST or abs(heading) > FARTHEST:
        raise Damaged(f"expected a pose in metres and radians, got {x:g} {y:g} {heading:g}")
    return x, y, heading


def vertex_of(tokens: list[bytes]) -> tuple[int, Pose]:
    """Parse the line of a vertex: its number and its pose. Raises Damaged."""
    return _whole(tokens[1] if len(tokens) > 1 else b"", "vertex"), pose_at(tokens, 2)


def edge_of(tokens: list[bytes]) -> tuple[tuple[int, int], Pose]:
    """Parse the line of an edge: the numbers of its vertices, and the motion. Raises Damaged."""
    if len(tokens) < 3:
        raise Damaged("expected an edge between two vertices, got fewer words")
    return (_whole(tokens[1], "vertex"), _whole(tokens[2], "vertex")), pose_at(tokens, 3)


def parameters_of(tokens: list[bytes]) -> dict[str, float]:
    """Return the parameter of the front laser, if any, by a short name such as "fov".

    `tokens` is a PARAM line of a CARMEN log. Raises Damaged if the value is no number.
    """
    if len(tokens) < 2 or tokens[1] not in _PARAMETERS:
        return {}
    return {_PARAMETERS[tokens[1]]: number_of(tokens[2] if len(tokens) > 2 else b"")}


def time_at(tokens: list[bytes], at: int) -> float | None:
    """Parse the time in seconds in word `at`.

    None if the time is missing or unreadable. That is no error, since times are not essential.
    """
    if at >= len(tokens) or not _is_number(tokens[at]):
        return None
    time = float(tokens[at])
    return time if math.isfinite(time) else None


def number_of(word: bytes, may_be_infinite: bool = False) -> float:
    """Parse a number. Raises Damaged if it is no number, or not finite unless `may_be_infinite`."""
    if not _is_number(word) or not (math.isfinite(value := float(word)) or may_be_infinite):
        raise Damaged(f"expected a finite number, got {_quoted(word)}")
    return value


def _whole(word: bytes, what: str) -> int:
    """Parse a whole number that is not negative and not too large. Raises Damaged."""
    if not (word.isdigit() and len(word) < 10) or (value := int(word)) > MOST_BEAMS * 1000:
        raise Damaged(f"expected a number ({what}), got {_quoted(word)}")
    return value


def _is_number(word: bytes) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _quoted(word: bytes) -> str:
    return brief(word[:40].decode("utf-8", "replace"), 40)


@dataclass
class PoseGraph:
    """A pose graph: vertices with poses, and edges with motions.

    Add all vertices and edges before using the methods, which cache their results.

    Example:
        >>> graph = PoseGraph()
        >>> graph.vertices += [(0, (0.0, 0.0, 0.0)), (1, (1.1, 0.0, 0.0)), (2, (2.2, 0.0, 0.0))]
        >>> graph.edges |= {(0, 1): (1.0, 0.0, 0.0), (1, 2): (1.0, 0.0, 0.0)}
        >>> graph.chain
        [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (2.0, 0.0, 0.0)]
        >>> graph.index_at((2.2, 0.0, 0.0))
        2
    """

    # Number and pose of each vertex, in the order of the file.
    vertices: list[tuple[int, Pose]] = field(default_factory=list)
    # Dict from the numbers of two vertices to the motion from the first to the second.
    edges: dict[tuple[int, int], Pose] = field(default_factory=dict)

    @cached_property
    def chain(self) -> list[Pose]:
        """The poses by odometry at the vertices, from (0, 0, 0) on.

        Poses add up the motions along the edges. The robot is taken to have stood still if no edge
        leads to a vertex from the vertex before. A few vertices between may be missing.
        """
        poses: list[Pose] = [(0.0, 0.0, 0.0)]
        for (start, _), (end, _) in pairwise(self.vertices):
            motion = self.edges.get((start, end))
            if motion is None and (back := self.edges.get((end, start))) is not None:
                motion = displacement_between(back, (0.0, 0.0, 0.0))
            between = range(start, end) if motion is None and end <= start + MOST_BETWEEN else ()
            steps = [self.edges.get((vertex, vertex + 1)) for vertex in between]
            if motion is None and None not in steps:
                motion = reduce(moved, filter(None, steps), (0.0, 0.0, 0.0))
            poses.append(moved(poses[-1], motion or (0.0, 0.0, 0.0)))
        return poses

    def is_corrected(self, farthest: float) -> bool:
        """Check whether a vertex is more than some metres away from its pose by odometry."""
        first = self.vertices[0][1]
        return any(
            math.dist(displacement_between(first, pose)[:2], odometry[:2]) > farthest
            for (_, pose), odometry in zip(self.vertices, self.chain, strict=True)
        )

    def index_at(self, pose: Pose, guess: int | None = None) -> int | None:
        """Find the index in `vertices` of one with this pose, up to rounding; try `guess` first."""
        if guess is not None and same_pose(self.vertices[guess][1], pose):
            return guess
        near: list[int] = self._tree.query_ball_point(pose[:2], 2 * ROUNDED)
        return next((i for i in sorted(near) if same_pose(self.vertices[i][1], pose)), None)

    def share_at_vertices(self, poses: Sequence[float]) -> float:
        """Compute the share of poses (flat: x, y, heading, x, …) at vertices, up to rounding."""
        table: Array = np.reshape(poses, (-1, 3))
        last = len(self.vertices) - 1
        at = sum(
            self.index_at((x, y, heading), min(i, last)) is not None
            for i, (x, y, heading) in enumerate(table.tolist())
        )
        return at / max(1, len(table))

    @cached_property
    def _tree(self) -> Any:
        from scipy.spatial import cKDTree

        return cKDTree(np.array([pose[:2] for _, pose in self.vertices]))


@dataclass(slots=True)
class Survey:
    """Findings of the first pass about one kind of lines with scans.

    A line has two poses. The mount is the first pose as seen from the second.
    """

    scans: int = 0  # number of scans
    beams: int = 0  # number of beams of the first scan
    most: float = 0.0  # largest range in metres
    repeated: int = 0  # number of times that `most` occurs
    mount: Pose | None = None  # mount at the first scan
    mounted: int = 0  # number of scans with about the same mount
    wandered: int = 0  # number of scans with a very different mount
    same: int = 0  # number of scans whose two poses are equal
    # Number of scans for which the next ODOM line repeats the pose of the scan, though the previous
    # ODOM line has another pose. The times of the lines exclude that the robot simply moved.
    restarts: int = 0
    # Number of scans for which the previous ODOM line has another pose, so that a restart could be
    # seen.
    moves: int = 0
    # Numbers of the lines of scans before which no ODOM line gives motion.
    unmoved: list[int] = field(default_factory=list)
    # Second poses of all scans: x, y, heading, x, …
    poses: array[float] = field(default_factory=lambda: array("d"))


@dataclass(slots=True)
class Findings:
    """Findings of the first pass."""

    # Findings for each kind of lines with scans.
    kinds: dict[str, Survey] = field(default_factory=dict)
    # Values of PARAM lines about the laser, by name: offset, side, angle, reach, fov.
    parameters: dict[str, float] = field(default_factory=dict)
    tags: Counter[str] = field(default_factory=Counter)  # number of lines of each kind
    # For each kind of line with poses, how many lines have each number of words. In lines with
    # scans, only words after the poses count.
    lengths: dict[bytes, Counter[int]] = field(default_factory=lambda: defaultdict(Counter))
    graph: PoseGraph = field(default_factory=PoseGraph)  # vertices and edges of the log
    damage: str = ""  # description of the first scan that cannot be read; empty if there is none

    def usual_length(self, tag: bytes) -> int:
        """Compute the largest number of words that most lines of a kind reach."""
        lengths = self.lengths[tag]
        short = (1 - MOST_SCANS) * lengths.total()
        for length in sorted(lengths):
            short -= lengths[length]
            if short < 0:
                return length
        return 0


def meaning_of(
    found: Findings, survey: Survey, kind: str, source: str, notes: list[str]
) -> Meaning:
    """Find out what the poses of the scans mean, and append notes to `notes`.

    Raises LogError if no poses are the odometer's.
    """
    is_same = survey.same >= MOST_SCANS * survey.scans
    if kind == "RAWLASER1":
        # Scans without poses take theirs from the ODOM lines.
        if not found.tags["ODOM"]:
            raise LogError(
                f"{source}: expected odometry, got neither ODOM lines nor poses in {kind}; "
                "record the odometer, too"
            )
        return "lines"
    if found.graph.vertices:
        return _meaning_beside_graph(found.graph, survey, kind, source, notes)
    if is_same and (found.tags["NEFF"] or 2 * survey.restarts > survey.moves > 0):
        if not found.tags["ODOM"]:
            raise LogError(
                f"{source}: expected odometry, got corrected poses alone (NEFF lines, but no "
                "ODOM); take the log before it was corrected"
            )
        notes.append(
            f"The poses in {kind} are corrected, and after each scan the ODOM lines go on from its "
            "corrected pose, as in logs of GMapping. So the log has no odometry as it was "
            "recorded. It was pieced together: the motions that ODOM lines show between two scans "
            "were added up, without the jumps of the correction."
        )
        if survey.unmoved:
            more = len(survey.unmoved) - 5
            notes.append(
                "No ODOM line tells how the robot moved before the scans in these lines, so "
                f"that it seems to have stood still: {', '.join(map(str, survey.unmoved[:5]))}"
                f"{f' and {more} more' if more > 0 else ''}."
            )
        return "restarts"
    if survey.wandered > (1 - MOST_SCANS) * survey.scans:
        notes.append(
            f"The two poses in {kind} drift apart: the first is used as the corrected pose, "
            "the second as odometry."
        )
        return "first corrected"
    return "raw"


def _meaning_beside_graph(
    graph: PoseGraph, survey: Survey, kind: str, source: str, notes: list[str]
) -> Meaning:
    """Find out what the poses of scans mean if the log has vertices. Raises LogError."""
    if graph.share_at_vertices(survey.poses) < MOST_SCANS:
        notes.append(
            f"The poses in {kind} and in VERTEX2 differ: those in {kind} are used as odometry, "
            "those in VERTEX2 as corrected poses."
        )
        return "raw"
    # Corrected poses without edges give no odometry.
    if not graph.edges:
        raise LogError(
            f"{source}: expected odometry, got corrected poses alone (VERTEX2, and the same "
            f"in {kind}) and no EDGE2; take the log before it was corrected"
        )
    notes.append(
        f"The robot's poses in {kind} and in VERTEX2 are equal, so they are corrected poses. "
        "Odometry is made by adding up the motions in EDGE2 from each vertex to the next."
    )
    return "edges"


def mount_in_log(found: Findings, survey: Survey, meaning: Meaning, kind: str) -> Pose:
    """Find the pose of the laser in the frame of the robot.

    It is the difference of the two poses of a scan, or else is given by PARAM lines.
    """
    own = survey.mount
    if (
        own is not None
        and meaning in ("raw", "edges")
        and max(map(abs, own)) > ROUNDED
        and survey.mounted >= MOST_SCANS * survey.scans
    ):
        x, y, angle = own
        return round(x, 4), round(y, 4), round(angle, 5)
    if kind == "ROBOTLASER1" and meaning in ("raw", "edges"):
        return (0.0, 0.0, 0.0)
    parameters = found.parameters
    return parameters.get("offset", 0.0), parameters.get("side", 0.0), parameters.get("angle", 0.0)


def reach_of(found: Findings, survey: Survey, kind: str, assumed: dict[str, str]) -> float:
    """Find the reach of the laser in metres. A range of at least this means no return.

    It is infinite if each line with a scan gives its own. `assumed` receives, by the key
    "no_return", a note if the log does not say the reach.
    """
    if kind != "FLASER":
        return math.inf
    if (reach := found.parameters.get("reach", 0.0)) > 0:
        return reach
    reach = without_codes(
        survey.most if survey.repeated > 2 or survey.most > SICK_REACH else math.ceil(survey.most)
    )
    if reach <= 0:  # no beam measured anything, which another note says
        return math.inf
    what = (
        "a code of SICK lasers for no echo"
        if reach < survey.most
        else f"which occurs {counted(survey.repeated, 'times')}"
    )
    assumed["no_return"] = (
        "The log does not say how far the laser reaches. Its largest range is "
        f"{survey.most:g} m, {what}. So the laser is taken to reach {reach:g} m. If it reaches "
        "farther, or less far, say so: --set no_return=METRES."
    )
    return reach


def survey_of(file: IO[bytes], source: str, with_graph: bool) -> Findings:
    """Read a log, and count the evidence for the meaning of its poses and ranges.

    `with_graph` says whether to read vertices and edges.
    """
    found = Findings()
    odometer: Odom | None = None  # the last ODOM line
    since: dict[str, int] = {}  # Number of ODOM lines since the last scan of each kind.
    # A scan that waits for the next ODOM line, with the ODOM line before it.
    waiting: tuple[Survey, ScanLine, Odom | None] | None = None
    # For each edge, the kind of its line and how many words that has.
    written: dict[tuple[int, int], tuple[bytes, int]] = {}
    for number, raw in lines(file, source):
        tokens = raw.split() if raw is not None else []
        if not tokens or not NAME.match(tokens[0]):
            continue
        tag = tokens[0]
        try:
            if tag in (b"ODOM", b"TRUEPOS"):
                found.lengths[tag][len(tokens)] += 1
            if tag == b"ODOM":
                odom = pose_at(tokens, 1), time_at(tokens, 7)
                since = {kind: count + 1 for kind, count in since.items()}
                if waiting is not None:
                    _count_restart(*waiting, odom)
                    waiting = None
                odometer = odom
            elif tag == b"PARAM":
                found.parameters.update(parameters_of(tokens))
            elif tag in VERTICES and with_graph:
                found.graph.vertices.append(vertex_of(tokens))
            elif tag in EDGES and with_graph:
                ends, motion = edge_of(tokens)
                found.lengths[tag][len(tokens)] += 1
                if len(tokens) > written.get(ends, (b"", 0))[1]:
                    found.graph.edges[ends], written[ends] = motion, (tag, len(tokens))
            elif (line := scan_line(tokens)) is not None:
                survey = found.kinds.setdefault(line.kind, Survey())
                _count(survey, line)
                found.lengths[tag][line.after] += 1
                # The first ODOM line after a scan only repeats the pose of the scan.
                if since.get(line.kind, 2) < 2:
                    survey.unmoved.append(number)
                since[line.kind] = 0
                waiting = survey, line, odometer
        except Damaged as damage:
            if tag.decode("ascii") in KINDS and not found.damage:
                found.damage = f"the first is damaged, in line {number}: {damage}"
            continue
        if len(found.tags) < 100 or tag.decode("ascii") in found.tags:
            found.tags[tag[:20].decode("ascii")] += 1
    for ends, (tag, count) in written.items():
        if count < found.usual_length(tag):  # The line was cut, and its last number may be, too.
            del found.graph.edges[ends]
    return found


def _count_restart(survey: Survey, line: ScanLine, before: Odom | None, after: Odom) -> None:
    """Count whether the ODOM line after a scan repeats the pose of the scan."""
    if line.second is None or before is None or before[0] == line.second:
        return
    survey.moves += 1
    # The robot cannot have moved between two lines of the same time.
    pose, time = after
    survey.restarts += pose == line.second and (before[1] == line.time or time != line.time)


def _count(survey: Survey, line: ScanLine) -> None:
    """Count a scan: its ranges, and how its two poses differ."""
    survey.scans += 1
    survey.beams = survey.beams or len(line.ranges)
    ranges = line.ranges[line.ranges <= NO_RANGE]
    most = float(ranges.max(initial=0.0))
    if most > survey.most:
        survey.most, survey.repeated = most, 0
    if most == survey.most:
        survey.repeated += int(np.count_nonzero(ranges == most))
    if line.first is None or line.second is None:
        return
    survey.poses.extend(line.second)
    survey.same += line.first == line.second
    # A constant difference of the poses is the mount; a large change means a correction.
    mount = displacement_between(line.second, line.first)
    survey.mount = survey.mount or mount
    x, y, angle = displacement_between(survey.mount, mount)
    survey.mounted += max(abs(x), abs(y), abs(angle)) <= MOUNTED
    survey.wandered += math.hypot(x, y) > WANDERED[0] or abs(angle) > WANDERED[1]


def without_codes(reach: float) -> float:
    """Lower the reach of a laser, in metres, to exclude the ranges that a SICK uses as codes."""
    return SICK_REACH if SICK_REACH <= reach <= SICK_MOST else reach


def same_pose(a: Pose, b: Pose) -> bool:
    """Whether two poses differ by no more than a log's rounding."""
    return all(abs(v) <= ROUNDED for v in displacement_between(a, b))
