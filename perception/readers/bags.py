"""Reads ROS bags: files of ROS 1, folders and files of ROS 2, and MCAP.

The package rosbags (extra `ros`) is needed; ROS itself need not be installed. Three kinds of
messages are read: the laser's scans (sensor_msgs/LaserScan, or the first echoes of
MultiEchoLaserScan), the odometer's poses (nav_msgs/Odometry), and the transforms between frames
(tf2_msgs/TFMessage). Frames are named as in REP 105:

- Odometry is the pose in Odometry messages. If there are none, it is the transform from `odom` to
  the robot. Odometry is interpolated at the time of each scan.
- The mount of the laser is the transform from the frame of the robot to the frame that the scan
  names. The beams of a laser that hangs upside down turn clockwise.
- If there are transforms from `map` to `odom`, the robot was localised, and the scans have
  corrected poses.

Times come from the headers of the messages. If these times are out of order, or do not fit those of
other messages, the times of recording are used. The poses of two programs that
publish one topic or transform are told apart.
"""

from __future__ import annotations

import math
from array import array
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from perception.errors import LogError
from perception.readers.bag_files import NANO, TRANSFORMS, Bag
from perception.readers.scans import (
    Array,
    Damage,
    Damaged,
    LaserScanner,
    Scan,
    SurveyedLog,
    laser_of,
)
from ssh_abduction.data.errors import brief
from ssh_abduction.data.odometry import Pose, displacement_between, moved

# Seconds beyond the ends of the odometry at which a scan still gets a pose.
BESIDE = 1.0
# Clocks that differ by more than this many seconds are different clocks.
SAME_CLOCK = 1.0
# Clocks are compared at intervals of at least COMPARED seconds, at most TIMES times in a drive, by
# medians, since a single message may be late.
COMPARED, TIMES = 2.0, 100
# Poses come from several sources if the source changes at this share of the messages and each
# source sends this share.
ALTERNATING = 0.1
# At most this share of the messages is of no such source.
ASTRAY = 0.1
# Largest number of sources to distinguish.
SOURCES = 4


@dataclass
class RecordedTrack:
    """Poses over time, in the order of their messages."""

    # Flat list of five numbers for each pose: stamp in the header (0 if it has none) and time of
    # recording in seconds; x and y in metres; heading in radians.
    numbers: array[float] = field(default_factory=lambda: array("d"))

    def add(self, stamp: float, recorded: float, pose: Pose) -> None:
        self.numbers.extend((stamp, recorded, *pose))

    def table(self) -> Array:
        """Return the numbers as a table, (n, 5): stamp, time of recording, x, y, heading."""
        return np.frombuffer(self.numbers, dtype=np.float64).reshape(-1, 5)


@dataclass(frozen=True)
class TimedPoses:
    """Poses sorted by time."""

    times: Array  # (n,) seconds, ascending
    # (n, 3) x and y in metres, heading in radians. Headings do not jump by a full turn.
    poses: Array

    @classmethod
    def of(cls, track: RecordedTrack, by_stamp: bool) -> TimedPoses:
        """Sort the poses of a track: by the stamps in headers, or by the times of recording."""
        table = track.table()
        times = table[:, 0 if by_stamp else 1]
        order = np.argsort(times, kind="stable")
        poses = table[order, 2:].copy()
        poses[:, 2] = np.unwrap(poses[:, 2])
        return cls(times[order], poses)

    def at(self, time: float) -> Pose:
        """Interpolate the pose at a time in seconds."""
        x, y, heading = (float(np.interp(time, self.times, self.poses[:, i])) for i in range(3))
        return x, y, math.remainder(heading, math.tau)

    def covers(self, time: float) -> bool:
        """Check whether a time is between the first and last pose, or at most BESIDE s outside."""
        return bool(self.times[0] - BESIDE <= time <= self.times[-1] + BESIDE)


def clock_of(topics: Mapping[str, Array]) -> tuple[bool, tuple[str, ...]]:
    """Return whether to use the stamps in headers, not the times of recording; and notes.

    Stamps are used if those of each topic are consistent and those of all topics agree.
    Otherwise, the times of recording are used, even if they are wrong, too. `topics` has, for
    each topic, (n, 2) stamps and times of recording in seconds, in the order of the bag.
    """
    wrong = [text for name, times in topics.items() if (text := _wrong_stamps(name, times[:, 0]))]
    doubts = (_wrong_recording(name, times, bool(wrong)) for name, times in topics.items())
    held = "; ".join(filter(None, doubts))
    # Clocks that are fine by themselves may still disagree.
    if not held and not wrong:
        wrong = _apart(topics)
    if not wrong:
        said = f"The times of recording are of no use: {held}. The times in the headers are used."
        return True, (said,) if held else ()
    used = "The times of recording are used."
    if held:
        used = (
            f"The times of recording are no better: {held}. They are used, but what is made of "
            "them may be wrong."
        )
    return False, (f"The times in the headers contradict themselves: {'; '.join(wrong)}. {used}",)


def _wrong_stamps(name: str, stamps: Array) -> str | None:
    """Describe what is wrong with the stamps of one topic; None if nothing is wrong."""
    none = int((stamps == 0).sum())
    if none == len(stamps) or none > 2:  # A simulated clock may begin at 0.
        return f"{none} of {len(stamps)} messages of {name} have no time"
    if len(stamps) > 1 and np.ptp(stamps) == 0:
        return f"the times of {name} are the same in all {len(stamps)} messages"
    back = np.diff(stamps)
    if len(back) and back.min() < -SAME_CLOCK:
        return (
            f"the times of {name} run back {int((back < -SAME_CLOCK).sum())} times in "
            f"{len(stamps)} messages, by up to {-back.min():.1f} s"
        )
    return None


def _wrong_recording(name: str, times: Array, stamps_are_wrong: bool) -> str | None:
    """Describe what is wrong with the times of recording of a topic; None if nothing is wrong.

    They are wrong if they stand still although the stamps in the headers go on or are wrong.
    `times` has the stamps and the times of recording in seconds, (n, 2).
    """
    stamps, recorded = times.T
    if len(times) < 3:
        return None
    if np.ptp(recorded) == 0 and (stamps_are_wrong or np.ptp(stamps) > SAME_CLOCK):
        return f"the {len(times)} messages of {name} were all recorded at one time"
    # Messages that were recorded at once form a group.
    groups = np.flatnonzero(np.concatenate([[True], np.diff(recorded) > 1e-3]))
    spans = np.maximum.reduceat(stamps, groups) - np.minimum.reduceat(stamps, groups)
    late = (spans > SAME_CLOCK) & (spans < np.ptp(recorded) + SAME_CLOCK)
    sizes = np.diff([*groups, len(times)])
    if sizes[late].sum() > len(times) / 2:
        return (
            f"{sizes[late].sum()} of {len(times)} messages of {name} were recorded in "
            f"{late.sum()} bursts, each of up to {spans[late].max():.1f} s of the drive"
        )
    return None


def _apart(topics: Mapping[str, Array]) -> list[str]:
    """Describe topics whose stamps disagree with the stamps of the first topic; else empty."""
    begin = min(times[:, 1].min() for times in topics.values())
    every = max(COMPARED, (max(times[:, 1].max() for times in topics.values()) - begin) / TIMES)
    (first, reference), *others = (
        (name, _ahead(times, begin, every)) for name, times in topics.items()
    )
    said = []
    for name, (when, ahead) in others:
        # Lead of this clock relative to that of the first topic, over time.
        off = ahead - np.interp(when, *reference)
        worst = int(np.abs(off).argmax())
        if abs(off[worst]) > SAME_CLOCK:
            since = when[int(np.argmax(np.abs(off) > SAME_CLOCK))]
            said.append(
                f"the times of {name} differ from those of {first} by {off[0]:+.1f} s at the "
                f"beginning, {off[-1]:+.1f} s at the end, and {off[worst]:+.1f} s at most; from "
                f"{since:.0f} s on they differ by more than {SAME_CLOCK:g} s"
            )
    return said


def _ahead(times: Array, begin: float, every: float) -> tuple[Array, Array]:
    """Compute by how many seconds the stamps of a topic are ahead of its times of recording.

    Time is divided into intervals of `every` seconds. For each interval with messages, return the
    mean time of recording since `begin`, (k,), and the median lead of the stamps, (k,).
    """
    recorded = times[:, 1] - begin
    ahead = times[:, 0] - times[:, 1]
    part = (recorded / every).astype(int)
    parts = np.unique(part)
    return np.array([recorded[part == k].mean() for k in parts]), np.array(
        [np.median(ahead[part == k]) for k in parts]
    )


def sources_of(poses: Array) -> list[NDArray[np.intp]]:
    """Separate poses, (n, 3), of sources that alternate, such as two programs with one transform.

    Each pose is given to the source whose last pose is nearest. If no source is near, the pose
    starts a new source. The source with the most poses comes first. If poses do not alternate, all
    are of one source.
    """
    if len(poses) < 10:
        return [np.arange(len(poses))]
    over = np.abs(poses[2:] - poses[:-2])
    # At least a quarter of these steps over two poses stay within one source, even if the poses of
    # two sources come in random order.
    near = 0.05 + 4 * float(np.percentile(np.hypot(over[:, 0], over[:, 1]), 25))
    heads: list[list[float]] = []
    of: list[int] = []
    for pose in poses.tolist():
        far = [
            math.hypot(pose[0] - x, pose[1] - y) + abs(math.remainder(pose[2] - heading, math.tau))
            for x, y, heading in heads
        ]
        k = min(range(len(far)), key=far.__getitem__, default=0)
        if not far or (far[k] > near and len(heads) < SOURCES):
            k = len(heads)
            heads.append(pose)
        heads[k] = pose
        of.append(k)
    found = [np.flatnonzero(np.array(of) == k) for k in range(len(heads))]
    many = [one for one in found if len(one) >= ALTERNATING * len(poses)]
    changes = sum(a != b for a, b in pairwise(of))
    # Single poses that are out of order start many sources.
    rest = len(poses) - sum(map(len, many))
    if len(many) < 2 or changes < ALTERNATING * len(poses) or rest > ASTRAY * len(poses):
        return [np.arange(len(poses))]
    return sorted(many, key=len, reverse=True)


SCANS = ("sensor_msgs/msg/LaserScan", "sensor_msgs/msg/MultiEchoLaserScan")
ODOMETRY = ("nav_msgs/msg/Odometry",)
# Largest difference of the messages of a fixed transform, from rounding: metres and radians.
FIXED = (0.01, 0.01)


def read(bag: Bag, scan_topics: Sequence[str], odom_topic: str | None) -> SurveyedLog:
    """Survey a bag, so that its scans can be read when they are iterated over.

    Without topics of scans, the only topic with scans is read. Without one of odometry, the
    only topic with odometry is read or, if there is none, the transforms. Raises LogError if
    there are no scans or no odometry, or several topics and none is named.
    """
    notes = list(bag.notes)
    scans = _scan_topics(bag, scan_topics)
    odometers = _chosen(bag, ODOMETRY, odom_topic, "odom")
    times, seen = _survey(bag, scans)
    damaged: list[Damage] = []
    frames = transforms_of(bag, set(seen), damaged)
    frame = seen.most_common(1)[0][0]

    # 1. Odometry: from its topic or, if there is none, from transforms.
    if odometers is not None:
        odometer, odom, base = _odometer(bag, odometers, damaged, notes)
        called = odometers
    else:
        odometer, odom, base = _odometer_of_transforms(bag, frames, frame)
        called = f"the transforms from {odom} to {base}"
    odometer = _of_one_source(odometer, called, notes)

    # 2. Where each frame of scans is on the robot.
    assumed: dict[str, str] = {}
    mounts = {frame: mount_of(frames, odom, base, frame, notes, assumed) for frame in seen}

    # 3. Corrected poses: from the transforms above the frame of the odometry.
    tracks = (parent_of(frames, child).track for child in ancestors(frames, odom))
    above = [track for track in tracks if track is not None]

    # 4. Times: by the stamps of messages, or by their recording.
    clocks = {called: odometer.table()[:, :2], **times}
    clocks |= {f"the transforms above {odom}": track.table()[:, :2] for track in above}
    by_stamp, contradictions = clock_of(clocks)
    notes += contradictions
    sources = [f"Scans come from {' and '.join(scans)}, odometry from {called}."]
    if len(seen) > 1:
        sources.append(
            "The scans are of several frames "
            f"({', '.join(f'{count} of {name}' for name, count in seen.most_common())}): each "
            "is mounted as its own frame says."
        )
    if above:
        sources.append(f"Corrected poses come from the transforms above {odom}.")
    corrections = [TimedPoses.of(track, by_stamp) for track in above]
    where = _ScanPoses(TimedPoses.of(odometer, by_stamp), corrections, mounts, by_stamp)
    items = _scans(bag, set(scans), where, damaged)
    return SurveyedLog(bag.format, tuple(notes), items, assumed, tuple(sources))


def _scan_topics(bag: Bag, named: Sequence[str]) -> list[str]:
    """The topics of the scans. Raises LogError if there are none, or several and none is named."""
    found = [_chosen(bag, SCANS, name, "scan") for name in named or (None,)]
    if found == [None]:
        raise LogError(
            f"{bag.source}: expected scans (messages LaserScan), got none; topics: "
            f"{bag.listed()}; record the laser, too"
        )
    return list(dict.fromkeys(topic for topic in found if topic is not None))


def _chosen(bag: Bag, kinds: Sequence[str], name: str | None, option: str) -> str | None:
    """Choose the named topic, or the only one of some kinds, if any. Raises LogError."""
    counts = {topic: count for topic, count in bag.topics(*kinds).items() if count}
    short = kinds[0].rpartition("/")[2]
    listed = (
        ", ".join(f"{topic} ({count} messages)" for topic, count in sorted(counts.items()))
        or "none"
    )
    if name is not None:
        match = [topic for topic in counts if topic.strip("/") == name.strip("/")]
        if not match:
            raise LogError(
                f"{bag.source}: {option}_topic: expected a topic of {short}, got "
                f"{brief(name)}; those in the bag: {listed}"
            )
        return match[0]
    # No name was given, so the topic must be unique.
    if len(counts) > 1:
        several = ", once for each that is to be read" if option == "scan" else ""
        raise LogError(
            f"{bag.source}: expected one topic of {short}, got {len(counts)}: {listed}; name "
            f"one with --set {option}_topic=TOPIC{several}"
        )
    return next(iter(counts), None)


def _survey(bag: Bag, topics: Sequence[str]) -> tuple[dict[str, Array], Counter[str]]:
    """For each topic, list the times of its scans, (n, 2), and count the scans of each frame.

    The times are in seconds: from the header, and of the recording. Raises LogError.
    """
    times: dict[str, list[tuple[float, float]]] = {}
    frames: Counter[str] = Counter()
    for connection, _, recorded, message in bag.messages(set(topics)):
        if not isinstance(message, Damage):
            times.setdefault(connection.topic, []).append((stamp_of(message.header), recorded))
            frames[frame_name(message.header.frame_id)] += 1
    if not frames:
        raise LogError(
            f"{bag.source}: expected scans in {' and '.join(topics)}, got none that can be read"
            "; record them again, or name another topic (--set scan_topic)"
        )
    return {topic: np.array(both) for topic, both in times.items()}, frames


def _odometer(
    bag: Bag, topic: str, damaged: list[Damage], notes: list[str]
) -> tuple[RecordedTrack, str, str]:
    """Read the poses of the odometer, the name of their frame, and the name of the robot's frame.

    `damaged` receives the messages that cannot be read, `notes` a note if several programs publish
    the topic. Raises LogError if no message can be read.
    """
    tracks: dict[tuple[str, str, str], RecordedTrack] = {}
    for connection, number, recorded, message in bag.messages({topic}):
        if isinstance(message, Damage):
            damaged.append(message)
            continue
        pose = message.pose.pose
        try:
            flat = flat_pose(pose.position, pose.orientation)
        except Damaged as damage:
            damaged.append(Damage(number, f"{topic}: {damage}"))
            continue
        frame, child = map(frame_name, (message.header.frame_id, message.child_frame_id))
        source = frame, child, getattr(connection.ext, "callerid", "") or ""
        tracks.setdefault(source, RecordedTrack()).add(stamp_of(message.header), recorded, flat)
    if not tracks:
        raise LogError(
            f"{bag.source}: expected odometry in {topic}, got none that can be read"
            "; record it again, or name another topic (--set odom_topic)"
        )
    # Several programs may publish one topic: take the longest track, preferably from a frame odom.
    best = max(tracks, key=lambda source: (len(tracks[source].numbers), "odom" in source[0]))
    if len(tracks) > 1:
        named = {
            source: f"from {source[0]} to {source[1]}{f' by {source[2]}' if source[2] else ''}"
            for source in tracks
        }
        listed = ", ".join(f"{len(tracks[one].table())} {name}" for one, name in named.items())
        notes.append(
            f"Several sources publish {topic}: {listed}. Those {named[best]} are read; record "
            "each source to a topic of its own."
        )
    return tracks[best], best[0], best[1]


def _odometer_of_transforms(bag: Bag, frames: Frames, frame: str) -> tuple[RecordedTrack, str, str]:
    """Read what `_odometer` returns, but from transforms from `odom` to the robot."""
    chain = [(child, parent_of(frames, child)) for child in ancestors(frames, frame)]
    moving = [(child, one) for child, one in chain if one.track is not None]
    found = next(
        ((child, one) for child, one in moving if "odom" in one.parent.rpartition("/")[2]), None
    ) or next(iter(moving), None)
    if found is None:
        raise LogError(
            f"{bag.source}: expected odometry (messages Odometry, or transforms from odom to "
            f"the frame {frame!r} of the scans), got none; topics: {bag.listed()}"
        )
    base, edge = found
    assert edge.track is not None
    return edge.track, edge.parent, base


def _of_one_source(track: RecordedTrack, called: str, notes: list[str]) -> RecordedTrack:
    """If the poses of several sources alternate, keep those of the largest one, and note it."""
    table = track.table()
    sources = sources_of(table[:, 2:])
    if len(sources) == 1:
        return track
    # For the note, measure how far the poses of the two largest sources differ.
    first, second = (RecordedTrack(array("d", table[some].ravel())) for some in sources[:2])
    here, there = TimedPoses.of(first, False), TimedPoses.of(second, False)
    apart = max(math.dist(here.at(time)[:2], there.at(time)[:2]) for time in there.times)
    notes.append(
        f"Several sources publish {called}, whose poses alternate, up to {apart:.1f} m apart: "
        f"{len(sources[0])} and {len(sources[1])} of {len(table)} messages. The source of more "
        "messages is read. If the other one is better, stop the source that was read, and record "
        "again."
    )
    return first


@dataclass(frozen=True)
class _ScanPoses:
    """The poses that a bag has: of the robot over time, and of its lasers on the robot."""

    odometry: TimedPoses  # poses by the odometer
    # The transform from the parent of the odometry's frame to this frame, then that from the
    # grandparent to the parent, and so on; empty if the robot was not localised.
    corrections: list[TimedPoses]
    # For each frame of scans, the pose of the laser in the frame of the robot, and whether it hangs
    # upside down.
    mounts: dict[str, tuple[Pose, bool]]
    # Whether times come from the headers of messages; otherwise, they are times of recording.
    by_stamp: bool

    def scan(self, message: Any, recorded: float, number: int) -> Scan:
        """Make the scan of a message. Raises Damaged."""
        time = stamp_of(message.header) if self.by_stamp else recorded
        if not self.odometry.covers(time):
            begin, end = self.odometry.times[[0, -1]]
            raise Damaged(
                f"expected odometry at the time of the scan, {time:.3f} s, got it from "
                f"{begin:.3f} to {end:.3f} s"
            )
        pose = corrected = self.odometry.at(time)
        for correction in self.corrections:
            corrected = moved(correction.at(time), corrected)
        ranges, laser = _measured(message, *self.mounts[frame_name(message.header.frame_id)])
        return Scan(ranges, laser, pose, corrected if self.corrections else None, time, number)


def _scans(
    bag: Bag, topics: set[str], where: _ScanPoses, damaged: list[Damage]
) -> Iterator[Scan | Damage]:
    """Yield the scans of a bag, and `Damage` for what cannot be read."""
    yield from damaged
    for connection, number, recorded, message in bag.messages(topics):
        try:
            is_damaged = isinstance(message, Damage)
            yield message if is_damaged else where.scan(message, recorded, number)
        except Damaged as damage:
            yield Damage(number, f"{connection.topic}: {damage}")


def _measured(message: Any, mount: Pose, is_flipped: bool) -> tuple[Array, LaserScanner]:
    """Read ranges and laser of a message. The beams of a flipped laser turn clockwise."""
    first, step, nearest, reach = (
        float(v)
        for v in (message.angle_min, message.angle_increment, message.range_min, message.range_max)
    )
    if message.__msgtype__ == SCANS[0]:
        ranges = np.array(message.ranges, dtype=np.float64)
    else:  # A beam without an echo met nothing.
        echoes = [beam.echoes[0] if len(beam.echoes) else np.inf for beam in message.ranges]
        ranges = np.array(echoes, dtype=np.float64)
    if not len(ranges):
        raise Damaged("expected at least one range, got none")
    if not math.isfinite(first) or not 0 < abs(step) <= math.tau:
        raise Damaged(f"expected a first angle and a step in radians, got {first:g} and {step:g}")
    if is_flipped:
        first, step = -first, -step
    reach, nearest = reach if reach > 0 else math.inf, nearest if 0 < nearest < math.inf else 0.0
    return ranges, laser_of(first, step, len(ranges), reach, mount, nearest)


@dataclass
class FrameTransform:
    """The transform from a parent frame to a frame: the pose of the frame in its parent."""

    parent: str  # name of the parent frame
    translation: Array  # (3,) translation in the last message, in metres
    rotation: Array  # (3, 3) rotation in the last message
    first: Pose  # pose in the plane in the first message
    track: RecordedTrack | None  # poses in the plane over time; None for a static transform
    count: int = 0  # number of messages
    # Largest difference of a pose from `first`, in metres and radians.
    off: tuple[float, float] = (0.0, 0.0)

    @property
    def is_fixed(self) -> bool:
        return self.off[0] <= FIXED[0] and self.off[1] <= FIXED[1]


# The transforms to each frame, by parent. A frame should have one parent, but some have several.
Frames = dict[str, dict[str, FrameTransform]]


def transforms_of(bag: Bag, seen: set[str], damaged: list[Damage]) -> Frames:
    """Read the transforms to each frame of a bag, by the name of the parent frame.

    Transforms over time are kept only for the frames of scans (`seen`) and their ancestors. Those
    of the many joints of a robot are not needed. `damaged` receives messages that cannot be read.
    """
    frames: Frames = {}
    topics = set(bag.topics(*TRANSFORMS))
    fixed = {topic for topic in topics if topic.endswith("tf_static")}
    # Static transforms come first, so that the ancestors of the scans' frames are known.
    for group, is_static in ((fixed, True), (topics - fixed, False)):
        for connection, number, recorded, message in bag.messages(group):
            if isinstance(message, Damage):
                damaged.append(message)
                continue
            for stamped in message.transforms:
                child, parent = map(frame_name, (stamped.child_frame_id, stamped.header.frame_id))
                transform = stamped.transform
                try:
                    edge = _record(frames, child, parent, transform, is_static)
                except Damaged as damage:
                    damaged.append(Damage(number, f"{connection.topic}: {child}: {damage}"))
                    continue
                if edge.track is not None and (
                    edge.count == 1 or any(child in ancestors(frames, frame) for frame in seen)
                ):
                    flat = flat_pose(transform.translation, transform.rotation)
                    edge.track.add(stamp_of(stamped.header), recorded, flat)
    return frames


def _record(
    frames: Frames, child: str, parent: str, transform: Any, is_static: bool
) -> FrameTransform:
    """Record a message with the transform from a parent frame to a child frame."""
    from scipy.spatial.transform import Rotation

    move, turn = transform.translation, transform.rotation
    flat = flat_pose(move, turn)
    parents = frames.setdefault(child, {})
    edge = parents.get(parent)
    if edge is None or (edge.track is None) != is_static:
        edge = FrameTransform(
            parent, np.zeros(3), np.eye(3), flat, None if is_static else RecordedTrack()
        )
    parents.pop(parent, None)
    parents[parent] = edge  # The parent in the last message comes last.
    edge.translation = np.array([move.x, move.y, move.z])
    if edge.track is None or edge.count == 0 or edge.off != (0.0, 0.0) or flat != edge.first:
        edge.rotation = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
    edge.count += 1
    x, y, angle = displacement_between(edge.first, flat)
    edge.off = max(edge.off[0], math.hypot(x, y)), max(edge.off[1], abs(angle))
    return edge


def parent_of(frames: Frames, child: str) -> FrameTransform:
    """Return the pose of a frame in its parent, as a `FrameTransform` that also names the parent.

    If a frame has several parents, one with "odom" in its name is taken, otherwise the last one.
    """
    parents = list(frames[child].values())
    return next((one for one in parents if "odom" in one.parent.rpartition("/")[2]), parents[-1])


def ancestors(frames: Frames, frame: str) -> list[str]:
    """List a frame, its parent, the parent of that, and so on, as far as transforms are known."""
    chain: list[str] = []
    while frame in frames and frame not in chain:
        chain.append(frame)
        frame = parent_of(frames, frame).parent
    return chain


def mount_of(
    frames: Frames, odom: str, base: str, frame: str, notes: list[str], assumed: dict[str, str]
) -> tuple[Pose, bool]:
    """Return the pose of the laser in the frame of the robot, and whether it hangs upside down.

    `notes` receives notes on transforms that contradict each other. `assumed` receives, by the
    key "mount", a note if no transform leads to the laser. Then the laser is taken to be in the
    middle of the robot.
    """
    if base == frame:
        return (0.0, 0.0, 0.0), False
    chain = ancestors(frames, frame)
    parents = [parent_of(frames, child).parent for child in chain]
    # If no transform leads to the robot's frame, the child of the odometry's frame is the robot.
    top = parents.index(odom) - 1 if odom in parents else None
    top = parents.index(base) if base in parents else top
    if top is None:
        assumed["mount"] = (f"{assumed['mount']} " if "mount" in assumed else "") + (
            f"No transform leads from the robot ({base or 'a frame without a name'}) to its laser "
            f"({frame}): the laser is taken to sit in the robot's middle and to look ahead. "
            "If it does not, say where it sits: --set mount=X,Y,DEGREES."
        )
        return (0.0, 0.0, 0.0), False
    translation, rotation = np.zeros(3), np.eye(3)
    for child in reversed(chain[: top + 1]):
        edge = parent_of(frames, child)
        translation = translation + rotation @ edge.translation
        rotation = rotation @ edge.rotation
        if not edge.is_fixed:
            off, angle = edge.off[0], math.degrees(edge.off[1])
            notes.append(
                f"The {edge.count} transforms from {edge.parent} to {child}, by which the "
                f"laser is mounted, contradict each other by up to {off:.2f} m and "
                f"{angle:.0f} degrees: the last one is used."
            )
        if len(frames[child]) > 1:
            others = ", ".join(
                f"{one.parent} ({one.count} transforms)" for one in frames[child].values()
            )
            notes.append(
                f"The frame {child} has several parents, {others}: that from {edge.parent} is "
                "used for the laser's mount."
            )
    heading = math.atan2(rotation[1, 0], rotation[0, 0])
    x, y, angle = (round(float(v), 6) for v in (translation[0], translation[1], heading))
    return (x, y, angle), bool(rotation[2, 2] < 0)


def flat_pose(position: Any, orientation: Any) -> Pose:
    """Project a position and a quaternion to a pose in the plane.

    Raises Damaged if a number is not finite, or the quaternion is nearly 0.
    """
    x, y, z, w = orientation.x, orientation.y, orientation.z, orientation.w
    numbers = position.x, position.y, position.z, x, y, z, w
    if not all(map(math.isfinite, numbers)) or x * x + y * y + z * z + w * w < 0.5:
        raise Damaged(
            "expected a position in metres and a quaternion, got "
            f"{', '.join(f'{v:g}' for v in numbers)}"
        )
    return position.x, position.y, math.atan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)


def stamp_of(header: Any) -> float:
    """Return the time in a header in seconds; 0 means that the header has none."""
    return float(header.stamp.sec + header.stamp.nanosec * NANO)


def frame_name(frame: str) -> str:
    """Return the name of a frame without the slash at the beginning that ROS 1 allows."""
    return frame.lstrip("/")
