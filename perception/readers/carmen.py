"""Reads logs in lines: CARMEN's, and those of g2o or TORO with scans.

These lines of CARMEN are read (http://carmen.sourceforge.net, logger). `...` means `[time host
time]`, and R means remission:

    FLASER n range*n x y theta odom_x odom_y odom_theta ...
    ROBOTLASER1 type start fov step reach accuracy R n range*n m R*m
        laser_pose robot_pose tv rv forward side axis ...
    RAWLASER1 type start fov step reach accuracy R n range*n m R*m ...
    ODOM x y theta tv rv acceleration ...
    TRUEPOS true_x true_y true_theta odom_x odom_y odom_theta ...
    PARAM name value ...

A log of g2o or TORO with scans also has corrected poses and relative motions. The corrected pose of
a scan is in the line before the scan (`VERTEX2 id x y theta`, or VERTEX_SE2). Motions are edges
between these vertices (`EDGE2 from to dx dy dtheta ...`, or EDGE_SE2).

A log does not say what its poses mean. The reader therefore goes through it twice. The first pass
(`carmen_survey`) finds out which poses are the odometer's, how the laser is mounted, and which
range means "nothing near". The second pass yields the scans. There are four cases:

- The poses of the scans equal those of vertices. Then they are corrected. Odometry is computed by
  adding up the motions of the edges from each vertex to the next.
- The first ODOM line after each scan repeats the pose of the scan, although the ODOM line before
  the scan had another pose. Then the poses of the scans are corrected. GMapping writes such logs,
  with a NEFF line after each scan. Its ODOM lines add the motions of the odometer to the corrected
  pose of the last scan. Odometry is computed by adding up these motions: from the line that repeats
  a pose to the last line before the next scan. That line has the time of the next scan. The jump
  from that line to the pose of the next scan is a correction, and is left out.
- The difference between the two poses of a scan varies widely. Then the first pose is corrected,
  and the second is the odometer's.
- Otherwise, the second pose is the odometer's. The first is the laser's, or equals the second.

TRUEPOS lines, which CARMEN's simulator writes, give the true pose of the robot.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import IO

from perception.errors import LogError
from perception.readers import carmen_survey
from perception.readers.carmen_survey import KINDS, Findings, ScanLine
from perception.readers.lines import LONGEST_LINE, lines
from perception.readers.scans import (
    Array,
    Damage,
    Damaged,
    LaserScanner,
    Scan,
    SurveyedLog,
    laser_of,
)
from ssh_abduction.data.files import LINE_OF_A_LOG
from ssh_abduction.data.odometry import Pose, displacement_between, moved

# Poses of vertices were corrected if one is farther than this from its pose by odometry, in metres.
CORRECTED = 0.05
# Lines of CARMEN that are ignored.
OTHERS = (b"SYNC", b"RLASER", b"ROBOTLASER2", b"RAWLASER2", *(kind.encode() for kind in KINDS))
VERTEX = re.compile(rb"^(VERTEX2|VERTEX_SE2)\b", re.MULTILINE)
# With these numbers of beams, a FLASER line covers half a circle by convention. They are those of a
# SICK with steps of 2, 1, 1/2 and 1/4 degree, with or without the last beam.
HALF_A_CIRCLE = (90, 91, 180, 181, 360, 361, 720, 721)
# Largest number of scans that wait for the next ODOM line.
MOST_WAITING = 100


def looks_like(head: bytes) -> bool:
    """Check whether one of the first lines of a file is a message that this reader knows."""
    return LINE_OF_A_LOG.search(head) is not None


def head_of(file: IO[bytes], scans: int) -> bytes:
    """Read the first lines of a log, up to a number of scans."""
    head: list[bytes] = []
    while scans and (line := file.readline(LONGEST_LINE)):
        head.append(line)
        scans -= line.lstrip().startswith(tuple(kind.encode() for kind in KINDS))
    return b"".join(head)


def read(
    file: IO[bytes], source: str, format: str | None, surveyed: IO[bytes] | None = None
) -> SurveyedLog:
    """Survey a log in lines, so that its scans can be read when they are iterated over.

    The format `carmen` ignores vertices and edges; `g2o` requires vertices; None reads what is
    there. `surveyed` is the part of the log that is surveyed; None for all of it. Raises
    LogError if the log holds no scan, or no odometry.
    """
    found = carmen_survey.survey_of(surveyed or file, source, format != "carmen")
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
    # Logs often hold each scan in lines of several kinds. Take the best kind of line, unless it has
    # less than half the scans of the commonest kind.
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
        notes.append(f"Scans are read from the lines {kind} only, not from {', '.join(others)}.")
    meaning = carmen_survey.meaning_of(found, survey, kind, source, notes)
    is_corrected = meaning != "edges" or found.graph.is_corrected(CORRECTED)
    if not is_corrected:
        notes.append(
            "The poses of the vertices have not been corrected: they only add up the edges."
        )
    assumed: dict[str, str] = {}
    mount = carmen_survey.mount_in_log(found, survey, meaning, kind)
    reach = carmen_survey.reach_of(found, survey, kind, assumed)
    if kind == "FLASER" and "fov" not in found.parameters and survey.beams not in HALF_A_CIRCLE:
        assumed["fov"] = (
            f"The log does not say how wide the laser looks: its {survey.beams} beams are "
            "taken to cover 180 degrees. If they cover more or less, say so: --set fov=DEGREES."
        )
    items = _scans(file, source, _OdometerPoses(found, meaning, is_corrected), kind, mount, reach)
    return SurveyedLog("g2o" if found.graph.vertices else "carmen", tuple(notes), items, assumed)


def _scans(
    file: IO[bytes], source: str, odometer: _OdometerPoses, kind: str, mount: Pose, reach: float
) -> Iterator[Scan | Damage]:
    """Yield the scans, and damage for lines that cannot be read."""
    # Scans without poses wait here for the next ODOM line.
    waiting: list[Scan | Damage] = []
    # The field of view may be given in degrees. Without one, or with an invalid one, it is pi.
    fov = odometer.found.parameters.get("fov", math.pi)
    fov = math.radians(fov) if math.tau < fov <= 360 else fov if 0 < fov <= math.tau else math.pi
    for number, raw in lines(file, source):
        tag = b""
        try:
            tokens = carmen_survey.words(raw)
            if not tokens:
                continue
            tag = tokens[0]
            if tag != kind.encode():
                odometer.read_line(tag, tokens)
            elif (line := carmen_survey.scan_line(tokens)) is not None:
                carmen_survey.refuse_cut(tag, line.after, odometer.found.usual_length(tag))
                seen, pose = _measured(line, mount, reach, fov), odometer.pose_of(line)
                waiting.append(Scan(*seen, *pose, line.time, number))
        except Damaged as damage:
            odometer.skip_line(tag)
            waiting.append(Damage(number, str(damage)))
            tag = b""  # no pose that waiting scans could take
        if odometer.meaning != "lines" or tag == b"ODOM" or len(waiting) >= MOST_WAITING:
            yield from map(odometer.with_pose, waiting)
            waiting.clear()
    odometer.before = odometer.last
    yield from map(odometer.with_pose, waiting)


@dataclass(slots=True)
class _OdometerPoses:
    """Computes the pose of the odometer at each scan, from the lines of the log up to that scan."""

    found: Findings  # findings of the first pass
    meaning: carmen_survey.Meaning  # meaning of the poses of the scans
    is_corrected: bool  # whether poses of vertices count as corrected
    # Pose by odometry, computed by adding up the motions between ODOM lines.
    chain: Pose = (0.0, 0.0, 0.0)
    # Value of `chain` before the last ODOM line, or at the last scan if that came later.
    behind: Pose = (0.0, 0.0, 0.0)
    last: carmen_survey.Odom | None = None  # the last ODOM line
    before: carmen_survey.Odom | None = None  # the ODOM line before the last
    # Whether the next ODOM line starts from a corrected pose, and gives no motion.
    restarts: bool = False
    vertex: int | None = None  # index of the last vertex
    # The last corrected pose, and the pose by odometry at that time.
    truth: tuple[Pose, Pose] | None = None
    # A corrected pose that waits for the next scan, which gives its odometry.
    news: Pose | None = None

    def read_line(self, tag: bytes, tokens: list[bytes]) -> None:
        """Process a line that is no scan. Raises Damaged."""
        carmen_survey.refuse_cut(tag, len(tokens), self.found.usual_length(tag))
        if tag == b"ODOM":
            pose = carmen_survey.pose_at(tokens, 1)
            self.behind = self.chain
            if self.last is not None and not self.restarts:
                self.chain = moved(self.chain, displacement_between(self.last[0], pose))
            self.before, self.last = self.last, (pose, carmen_survey.time_at(tokens, 7))
            self.restarts = False
        elif tag == b"NEFF":
            # The last ODOM line repeated the pose of a scan, so it is no motion. The line of that
            # scan may be missing.
            self.chain = self.behind
        elif tag == b"TRUEPOS":
            self.truth = carmen_survey.pose_at(tokens, 1), carmen_survey.pose_at(tokens, 4)
        elif tag == b"PARAM":
            # The survey already has parameters and edges. Reading them again reports damaged lines.
            carmen_survey.parameters_of(tokens)
        elif self.found.graph.vertices and tag in carmen_survey.EDGES:
            carmen_survey.edge_of(tokens)
        elif self.found.graph.vertices and tag in carmen_survey.VERTICES:
            self.news = carmen_survey.vertex_of(tokens)[1]
            self.vertex = 0 if self.vertex is None else self.vertex + 1
        elif tag not in OTHERS:
            self.skip_line(tag)

    def skip_line(self, tag: bytes) -> None:
        """Note that a line cannot be read.

        If ODOM lines restart after scans, the line may have been a scan. Then the next ODOM line
        gives no motion.
        """
        self.restarts |= self.meaning == "restarts" and tag != b"ODOM"

    def pose_of(self, line: ScanLine) -> tuple[Pose, Pose | None]:
        """The pose by the odometer at a scan, and the corrected pose, if any.

        Raises Damaged if the pose should be that of a vertex, but no vertex has this pose.
        """
        first, second = line.first, line.second
        if first is None or second is None:
            return self.chain, None  # `with_pose` replaces this pose.
        if self.meaning == "edges":
            index = self.found.graph.index_at(second, self.vertex)
            if index is None:
                raise Damaged(
                    f"expected the pose of a vertex in {line.kind}, got another; the line of "
                    "its vertex is missing or damaged"
                )
            return self.found.graph.chain[index], second if self.is_corrected else None
        if self.meaning == "restarts":
            self.last, self.restarts, self.behind = (second, line.time), True, self.chain
            return self.chain, second
        if self.news is not None:
            self.truth, self.news = (self.news, second), None
        return second, self._corrected(second) or (
            first if self.meaning == "first corrected" else None
        )

    def with_pose(self, item: Scan | Damage) -> Scan | Damage:
        """If the lines of scans give no poses, interpolate the pose from the last two ODOM lines.

        Damage, and scans in other logs, are returned unchanged.
        """
        if self.meaning != "lines" or isinstance(item, Damage) or self.last is None:
            return item
        (start, began), (end, ended) = self.before or self.last, self.last
        share, time = 0.0, item.time  # Times that are cut or run backwards are useless.
        if not (began is None or time is None or ended is None) and began <= time <= ended > began:
            share = (time - began) / (ended - began)
        dx, dy, turned = displacement_between(start, end)
        odometry = moved(start, (share * dx, share * dy, share * turned))
        return replace(item, odometry=odometry, corrected=self._corrected(odometry))

    def _corrected(self, odometry: Pose) -> Pose | None:
        """The true pose, from the last corrected pose, if any, and the odometry since then."""
        if self.truth is None:
            return None
        return moved(self.truth[0], displacement_between(self.truth[1], odometry))


def _measured(line: ScanLine, mount: Pose, reach: float, fov: float) -> tuple[Array, LaserScanner]:
    """The ranges of a scan and its laser; `reach` and `fov` hold if the line does not give them."""
    beams = len(line.ranges)
    if line.shape is None:
        # FLASER lines do not give the geometry. The first beam is on the right. If the number of
        # beams is even, the last beam of a SICK, on the left, is missing.
        first, step = -fov / 2, fov / max(1, beams - beams % 2)
    else:
        first, step, reach = line.shape
    return line.ranges, laser_of(first, step, beams, carmen_survey.without_codes(reach), mount)
