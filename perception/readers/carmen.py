"""Reads logs in lines: CARMEN's, and those of g2o or TORO with scans.

These lines of CARMEN are read (http://carmen.sourceforge.net, logger); `...` ends with `[time host
time]`, and an R is remission:

    FLASER n range*n x y theta odom_x odom_y odom_theta ...
    ROBOTLASER1 type start fov step reach accuracy R n range*n m R*m
        laser_pose robot_pose tv rv forward side axis ...
    RAWLASER1 type start fov step reach accuracy R n range*n m R*m ...
    ODOM x y theta tv rv acceleration ...
    TRUEPOS true_x true_y true_theta odom_x odom_y odom_theta ...
    PARAM name value ...

A g2o-style log also has, for each scan, the corrected pose (`VERTEX2 id x y theta`, or VERTEX_SE2,
in the line before the scan's), and relative motions (`EDGE2 from to dx dy dtheta ...`, or
EDGE_SE2).

A log does not say what its poses mean. The reader therefore goes through it twice. The first pass
(`carmen_survey`) finds the poses of the odometer, the mount of the laser, and the range that means
"nothing near". The second pass yields the scans.

- If the poses of the scans are those of vertices, they are corrected, and odometry is the chain of
  the edges from each vertex to the next.
- If the first ODOM line after each scan repeats the pose of the scan, whatever the ODOM line before
  the scan said, then the poses of the scans are corrected. GMapping writes such logs, with a NEFF
  line after each scan. Its ODOM lines add the increments of the odometer to the corrected pose of
  the last scan. Odometry is then the chain of these increments, from the line that repeats the pose
  of one scan to the last line before the next scan, which has the time of that scan. The jump from
  that line to the pose of the scan is the correction, which is left out.
- If the first pose of the scans wanders from the second, the first is corrected, and the second is
  the odometer's.
- Otherwise the second pose is the odometer's, and the first is that of the laser, or the same.

TRUEPOS lines, which CARMEN's simulator writes, give the true pose of the robot.
"""

from __future__ import annotations

import math
from array import array
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import IO, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from perception.errors import LogError
from perception.readers.graphs import ROUNDED, Graph
from perception.readers.lines import lines
from perception.readers.messages import (
    EDGES,
    KINDS,
    NAME,
    VERTICES,
    Damaged,
    ScanLine,
    edge_of,
    parameters_of,
    pose_at,
    scan_line,
    time_at,
    vertex_of,
    words,
)
from perception.readers.scans import Damage, Laser, Reading, Scan
from ssh_abduction.data.files import LINE_OF_A_LOG
from ssh_abduction.data.odometry import Pose, between, moved

# Meaning of the poses of the scans, in the order of the docstring; `lines` if scans have no poses
# but ODOM lines are between them.
Meaning: TypeAlias = Literal["edges", "restarts", "first corrected", "raw", "lines"]
# Share of the scans that must follow a rule, since lines may be damaged.
MOST_SCANS = 0.9
# The first pose is corrected if it is this far from the second, in metres or radians. A smaller
# difference may come from reading it some milliseconds later.
WANDERED = (0.5, 0.25)
# The mount of the laser is the same in all scans up to this difference, since some logs have two
# decimals.
MOUNTED = 0.02
# Poses of vertices within this many metres of the chain of the edges are not corrected.
CORRECTED = 0.05
# Ranges of a SICK LMS from here on, in metres, are codes such as "nothing came back" or "dazzled"
# (SICK, Telegrams for LMS 200, values 8183 to 8191).
SICK_REACH, SICK_MOST = 81.83, 81.92
# No laser measures ranges beyond this, in metres.
NO_RANGE = 1000.0
# Lines of CARMEN that are ignored.
OTHERS = (b"SYNC", b"RLASER", b"ROBOTLASER2", b"RAWLASER2", *(kind.encode() for kind in KINDS))
# Numbers of beams of a FLASER that cover half a circle by convention: a SICK at 2, 1, 1/2 and 1/4
# degree, with the last beam or without it.
HALF_A_CIRCLE = (90, 91, 180, 181, 360, 361, 720, 721)
# Largest number of scans that wait for the next ODOM line.
MOST_WAITING = 100


@dataclass(slots=True)
class _Survey:
    """Findings of the first pass about one kind of scans.

    Attributes:
        scans: Number of scans.
        beams: Number of beams of the first scan.
        most: Largest range.
        repeated: Number of times that it occurs.
        mount: First pose in the frame of the second, at the first scan.
        mounted: Number of scans with about the same mount.
        wandered: Number of scans with a very different one.
        same: Number of scans whose two poses are equal.
        restarts: Number of scans whose pose the next ODOM line repeats, though the line before it
            has the same time and another pose.
        moves: Number of scans at which a restart could be seen.
        unmoved: Lines of scans before which no ODOM line tells the motion.
        poses: Second poses, three numbers each.
    """

    scans: int = 0
    beams: int = 0
    most: float = 0.0
    repeated: int = 0
    mount: Pose | None = None
    mounted: int = 0
    wandered: int = 0
    same: int = 0
    restarts: int = 0
    moves: int = 0
    unmoved: list[int] = field(default_factory=list)
    poses: array[float] = field(default_factory=lambda: array("d"))


@dataclass(slots=True)
class _Found:
    """Findings of the first pass.

    Attributes:
        kinds: Findings for each kind of scans.
        parameters: Values of PARAM lines.
        tags: Number of lines of each kind.
        graph: Vertices and edges.
        damage: Description of the first scan that cannot be read.
    """

    kinds: dict[str, _Survey] = field(default_factory=dict)
    parameters: dict[str, float] = field(default_factory=dict)
    tags: Counter[str] = field(default_factory=Counter)
    graph: Graph = field(default_factory=Graph)
    damage: str = ""


def looks_like(head: bytes) -> bool:
    """Whether one of the first lines of a file is a message that this reader knows."""
    return LINE_OF_A_LOG.search(head) is not None


def read(file: IO[bytes], source: str, format: str | None) -> Reading:
    """Survey a log in lines, so that its scans can be read.

    Args:
        file: The log.
        source: Its name, for errors.
        format: `carmen` ignores vertices and edges; `g2o` requires them; None reads what is there.

    Raises:
        LogError: The log holds no scan, or no odometry.
    """
    found = _survey(file, source, format != "carmen")
    if format == "g2o" and not found.graph.vertices:
        raise LogError(
            f"{source}: expected vertices in lines VERTEX2 or VERTEX_SE2, got none; leave the "
            "format out, or name carmen"
        )
    if not found.kinds:
        tags = ", ".join(f"{count} {tag}" for tag, count in found.tags.most_common(5)) or "none"
        why = found.damage or "record the laser, too"
        raise LogError(
            f"{source}: expected scans in lines {', '.join(KINDS)}, got none that can be read "
            f"(lines: {tags}); {why}"
        )
    # Logs often hold each scan more than once: take the best kind that has at least half as many
    # scans.
    most = max(survey.scans for survey in found.kinds.values())
    kind = next(
        kind for kind in KINDS if kind in found.kinds and 2 * found.kinds[kind].scans >= most
    )
    survey, notes = found.kinds[kind], []
    others = [
        other
        for other in (*KINDS, "RLASER", "ROBOTLASER2")
        if other != kind and (other in found.kinds or found.tags[other])
    ]
    if others:
        notes.append(
            f"The scans are those of the lines {kind}; those of {', '.join(others)} are not read."
        )
    meaning = _meaning(found, survey, kind, source, notes)
    is_corrected = meaning != "edges" or found.graph.is_corrected(CORRECTED)
    if not is_corrected:
        notes.append(
            "The poses of the vertices have not been corrected: they are the chain of the edges."
        )
    assumed: dict[str, str] = {}
    mount = _mount(found, survey, meaning, kind)
    reach = _reach(found, survey, kind, assumed)
    if kind == "FLASER" and "fov" not in found.parameters and survey.beams not in HALF_A_CIRCLE:
        assumed["fov"] = (
            f"The log does not say how wide the laser looks: its {survey.beams} beams are "
            "taken to cover 180 degrees. If they cover more or less, say so: --fov DEGREES."
        )
    items = _scans(file, source, _Odometer(found, meaning, is_corrected), kind, mount, reach)
    return Reading("g2o" if found.graph.vertices else "carmen", tuple(notes), items, assumed)


def _meaning(found: _Found, survey: _Survey, kind: str, source: str, notes: list[str]) -> Meaning:
    """What the poses of the scans mean. Raises LogError if none are the odometer's."""
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
            f"The poses in {kind} are corrected ones, from which the ODOM lines start anew after "
            "each scan, as GMapping writes them. Odometry was pieced together: it is the "
            "chain of the increments of the ODOM lines between two scans, without the jumps of the "
            "correction. It is no recorded odometry."
        )
        if survey.unmoved:
            notes.append(
                "No ODOM line tells how the robot moved before the scans in these lines, so "
                f"that it seems to have stood still: {_listed(survey.unmoved)}."
            )
        return "restarts"
    if survey.wandered > (1 - MOST_SCANS) * survey.scans:
        notes.append(
            f"The first pose in {kind} wanders from the second: the first is taken for a "
            "corrected one, the second for odometry."
        )
        return "first corrected"
    return "raw"


def _meaning_beside_graph(
    graph: Graph, survey: _Survey, kind: str, source: str, notes: list[str]
) -> Meaning:
    """What the poses of the scans mean if there are vertices. Raises LogError."""
    if graph.share_at_vertices(survey.poses) < MOST_SCANS:
        notes.append(
            f"The poses in {kind} differ from those of VERTEX2: the former are taken for "
            "odometry, the latter for corrected ones."
        )
        return "raw"
    if not graph.edges:
        raise LogError(
            f"{source}: expected odometry, got corrected poses alone (VERTEX2, and the same "
            f"in {kind}) and no EDGE2; take the log before it was corrected"
        )
    notes.append(
        f"The robot's poses in {kind} are those of VERTEX2, and so corrected ones. Odometry "
        "is the chain of the EDGE2 from each vertex to the next."
    )
    if gaps := graph.chain.gaps:
        notes.append(
            "No EDGE2 tells how the robot moved before these vertices, so that it seems to "
            f"have stood still: {_listed(gaps)}."
        )
    return "edges"


def _listed(numbers: list[int] | tuple[int, ...]) -> str:
    """The first five numbers, and how many more there are."""
    return ", ".join(map(str, numbers[:5])) + (
        f" and {len(numbers) - 5} more" if len(numbers) > 5 else ""
    )


def _mount(found: _Found, survey: _Survey, meaning: Meaning, kind: str) -> Pose:
    """The pose of the laser in the frame of the robot, by its poses or else by the parameters."""
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


def _reach(found: _Found, survey: _Survey, kind: str, assumed: dict[str, str]) -> float:
    """The range that means that nothing is near; infinite if the lines of the scans tell it."""
    if kind != "FLASER":
        return math.inf
    if (reach := found.parameters.get("reach", 0.0)) > 0:
        return reach
    reach = _without_codes(
        survey.most if survey.repeated > 2 or survey.most > SICK_REACH else math.ceil(survey.most)
    )
    assumed["no_return"] = (
        "The log does not say how far the laser reaches. By its largest range, "
        f"{survey.most:g} m, which came {survey.repeated} times, it is {reach:g} m."
    )
    return reach


def _survey(file: IO[bytes], source: str, with_graph: bool) -> _Found:
    """Go through a log, and find what its poses and ranges mean."""
    found = _Found()
    odometer: tuple[Pose, float | None] | None = None  # Pose and time of the last ODOM line.
    since: dict[str, int] = {}  # Number of ODOM lines since the last scan of each kind.
    # A scan that waits for the next ODOM line, with the ODOM line before it.
    waiting: tuple[_Survey, ScanLine, tuple[Pose, float | None] | None] | None = None
    for number, raw in lines(file, source):
        tokens = raw.split() if raw is not None else []
        if not tokens or not NAME.match(tokens[0]):
            continue
        tag = tokens[0]
        try:
            if tag == b"ODOM":
                pose, time = pose_at(tokens, 1), time_at(tokens, 7)
                since = {kind: count + 1 for kind, count in since.items()}
                if waiting is not None:
                    _count_restart(*waiting, pose, time)
                    waiting = None
                odometer = pose, time
            elif tag == b"PARAM":
                found.parameters.update(parameters_of(tokens))
            elif tag in VERTICES and with_graph:
                found.graph.vertices.append(vertex_of(tokens))
            elif tag in EDGES and with_graph:
                ends, motion = edge_of(tokens)
                found.graph.edges.setdefault(ends, motion)
            elif (line := scan_line(tokens)) is not None:
                survey = found.kinds.setdefault(line.kind, _Survey())
                _count(survey, line)
                if (
                    since.get(line.kind, 2) < 2
                ):  # The first one only repeats the pose of the scan before.
                    survey.unmoved.append(number)
                since[line.kind] = 0
                waiting = survey, line, odometer
        except Damaged as damage:
            if tag.decode("ascii") in KINDS and not found.damage:
                found.damage = f"the first is damaged, in line {number}: {damage}"
            continue
        if len(found.tags) < 100 or tag.decode("ascii") in found.tags:
            found.tags[tag[:20].decode("ascii")] += 1
    return found


def _count_restart(
    survey: _Survey,
    line: ScanLine,
    before: tuple[Pose, float | None] | None,
    pose: Pose,
    time: float | None,
) -> None:
    """Count whether an ODOM line that follows a scan repeats its pose."""
    if line.second is None or before is None or before[0] == line.second:
        return
    survey.moves += 1
    # The robot cannot have moved between two lines of the same time.
    survey.restarts += pose == line.second and (before[1] == line.time or time != line.time)


def _count(survey: _Survey, line: ScanLine) -> None:
    """Count a scan: its ranges, and how its two poses compare."""
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
    mount = between(line.second, line.first)
    survey.mount = survey.mount or mount
    x, y, angle = between(survey.mount, mount)
    survey.mounted += max(abs(x), abs(y), abs(angle)) <= MOUNTED
    survey.wandered += math.hypot(x, y) > WANDERED[0] or abs(angle) > WANDERED[1]


def _scans(
    file: IO[bytes], source: str, odometer: _Odometer, kind: str, mount: Pose, reach: float
) -> Iterator[Scan | Damage]:
    """Read the scans, and describe the lines that are skipped."""
    # Scans without poses wait here for the next ODOM line.
    waiting: list[Scan | Damage] = []
    # Some logs give degrees.
    fov = odometer.found.parameters.get("fov", math.pi)
    fov = math.radians(fov) if math.tau < fov <= 360 else fov if 0 < fov <= math.tau else math.pi
    for number, raw in lines(file, source):
        tag = b""
        try:
            tokens = words(raw)
            if not tokens:
                continue
            tag = tokens[0]
            if tag != kind.encode():
                odometer.hear(tag, tokens)
            elif (line := scan_line(tokens)) is not None:
                waiting.append(
                    Scan(
                        *_measured(line, mount, reach, fov),
                        *odometer.place(line),
                        line.time,
                        number,
                    )
                )
        except Damaged as damage:
            odometer.mishear(tag)
            waiting.append(Damage(number, str(damage)))
        if odometer.meaning != "lines" or tag == b"ODOM" or len(waiting) >= MOST_WAITING:
            yield from map(odometer.placed, waiting)
            waiting.clear()
    odometer.before = odometer.last
    yield from map(odometer.placed, waiting)


@dataclass(slots=True)
class _Odometer:
    """The pose of the odometer at each scan, from the lines of the log so far.

    Attributes:
        found: Findings of the first pass.
        meaning: Meaning of the poses of the scans.
        is_corrected: Whether the poses of vertices are corrected.
        chain: Odometry, if it is chained from ODOM lines.
        behind: The chain before the last ODOM line since the last scan.
        last: Pose and time of the last ODOM line.
        before: Pose and time of the ODOM line before that.
        restarts: Whether the next ODOM line starts from a corrected pose, so that it tells no
            motion.
        vertex: Index of the last vertex.
        truth: A corrected pose, and the odometer's at the same time.
        news: A corrected pose that waits for the odometry of the next scan.
    """

    found: _Found
    meaning: Meaning
    is_corrected: bool
    chain: Pose = (0.0, 0.0, 0.0)
    behind: Pose = (0.0, 0.0, 0.0)
    last: tuple[Pose, float | None] | None = None
    before: tuple[Pose, float | None] | None = None
    restarts: bool = False
    vertex: int | None = None
    truth: tuple[Pose, Pose] | None = None
    news: Pose | None = None

    def hear(self, tag: bytes, tokens: list[bytes]) -> None:
        """Take in a line that is not a scan. Raises Damaged."""
        if tag == b"ODOM":
            pose = pose_at(tokens, 1)
            self.behind = self.chain
            if self.last is not None and not self.restarts:
                self.chain = moved(self.chain, between(self.last[0], pose))
            self.before, self.last, self.restarts = self.last, (pose, time_at(tokens, 7)), False
        elif tag == b"NEFF":
            # The ODOM line before repeated the pose of a scan, even if the line of that scan is
            # missing.
            self.chain = self.behind
        elif tag == b"TRUEPOS":
            self.truth = pose_at(tokens, 1), pose_at(tokens, 4)
        elif tag == b"PARAM":
            # The survey already has parameters and edges. Reading them again reports damaged lines.
            parameters_of(tokens)
        elif self.found.graph.vertices and tag in EDGES:
            edge_of(tokens)
        elif self.found.graph.vertices and tag in VERTICES:
            self.news = vertex_of(tokens)[1]
            self.vertex = 0 if self.vertex is None else self.vertex + 1
        elif tag not in OTHERS:
            self.mishear(tag)

    def mishear(self, tag: bytes) -> None:
        """Take in that a line cannot be read.

        The line may have been a scan, after which ODOM lines restart. Then the next ODOM line tells
        no motion.
        """
        self.restarts |= self.meaning == "restarts" and tag != b"ODOM"

    def place(self, line: ScanLine) -> tuple[Pose, Pose | None]:
        """The pose by the odometer, and the corrected one if it is known. Raises Damaged."""
        first, second = line.first, line.second
        if first is None or second is None:
            return self.chain, None  # This is replaced in `placed`.
        if self.meaning == "edges":
            index = self.found.graph.index_at(second, self.vertex)
            if index is None:
                raise Damaged(
                    f"expected the pose of a vertex in {line.kind}, got another; the line of "
                    "its vertex is missing or damaged"
                )
            return self.found.graph.chain.poses[index], second if self.is_corrected else None
        if self.meaning == "restarts":
            self.last, self.restarts, self.behind = (second, line.time), True, self.chain
            return self.chain, second
        if self.news is not None:
            self.truth, self.news = (self.news, second), None
        return second, self._truly(second) or (first if self.meaning == "first corrected" else None)

    def placed(self, item: Scan | Damage) -> Scan | Damage:
        """Give a scan without a pose one between those of the last two ODOM lines."""
        if self.meaning != "lines" or isinstance(item, Damage) or self.last is None:
            return item
        (start, began), (end, ended) = self.before or self.last, self.last
        if (
            began is None
            or ended is None
            or item.time is None
            or not began <= item.time <= ended
            or began == ended
        ):
            share = 0.0  # Times that are cut or run backwards are useless.
        else:
            share = (item.time - began) / (ended - began)
        dx, dy, turned = between(start, end)
        odometry = moved(start, (share * dx, share * dy, share * turned))
        return replace(item, odometry=odometry, corrected=self._truly(odometry))

    def _truly(self, odometry: Pose) -> Pose | None:
        """The true pose, from the last corrected pose and the odometry since."""
        return (
            moved(self.truth[0], between(self.truth[1], odometry))
            if self.truth is not None
            else None
        )


def _measured(
    line: ScanLine, mount: Pose, reach: float, fov: float
) -> tuple[NDArray[np.float64], Laser]:
    """The ranges of a scan, and its laser."""
    beams = len(line.ranges)
    if line.shape is None:
        laser = _conventional(beams, fov, _without_codes(reach), mount)
    else:
        first, step, reach = line.shape
        laser = _described(first, step, _without_codes(reach), beams, mount)
    return line.ranges, laser


def _without_codes(reach: float) -> float:
    """The reach of a laser, without the ranges that a SICK uses as codes."""
    return SICK_REACH if SICK_REACH <= reach <= SICK_MOST else reach


@lru_cache(maxsize=64)
def _conventional(beams: int, fov: float, reach: float, mount: Pose) -> Laser:
    """The laser of FLASER lines, whose first beam is at the right.

    If the number of beams is even, the last beam of a SICK, at the left, is missing.
    """
    step = fov / max(1, beams - beams % 2)
    return Laser(-fov / 2, step, beams, reach, mount)


@lru_cache(maxsize=64)
def _described(first: float, step: float, reach: float, beams: int, mount: Pose) -> Laser:
    return Laser(first, step, beams, reach, mount)
