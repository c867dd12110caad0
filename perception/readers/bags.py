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
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from perception.errors import LogError
from perception.readers import bag_frames
from perception.readers.bag_files import Bag
from perception.readers.bag_geometry import Mount, angles_of, believed, ranges_of
from perception.readers.echoes import LaserOptions
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
from ssh_abduction.data.odometry import Pose, moved
from ssh_abduction.data.words import counted, first_few

# Seconds beyond the ends of the odometry at which a scan still gets a pose.
BESIDE = 0.2
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


@dataclass(frozen=True)
class TimedPoses:
    """Poses sorted by time."""

    times: Array  # (n,) seconds, ascending
    # (n, 3) x and y in metres, heading in radians. Headings do not jump by a full turn.
    poses: Array

    @classmethod
    def of(cls, track: bag_frames.RecordedTrack, by_stamp: bool) -> TimedPoses:
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
# Each EACH-th scan of a frame is kept to judge the tilt of its laser, at most SAMPLES.
EACH, SAMPLES = 10, 100
# Scans that repeat earlier ones are left out if they are this many, and this share of all. A laser
# without noise repeats its scan while the robot stands, but its times differ by more than AT_ONCE
# seconds: by the stamps, or of recording. A scan of at most FEW different ranges may come again.
LEAST_REPEATED, REPEATED, AT_ONCE, FEW = 20, 0.2, (0.01, 0.1), 20
# The odometry has a gap if the robot moved by more than UNSEEN metres or radians in a pause of more
# than GAP seconds, and LONGER times the usual interval.
GAP, LONGER, UNSEEN = 1.0, 10.0, 0.1


def read(
    bag: Bag, scan_topics: Sequence[str], odom_topic: str | None, told: LaserOptions
) -> SurveyedLog:
    """Survey a bag, so that its scans can be read when they are iterated over.

    Without topics of scans, the only topic with scans is read. Without one of odometry, the
    only topic with odometry is read or, if there is none, the transforms. Raises LogError if
    there are no scans or no odometry, or several topics and none is named.
    """
    notes = list(bag.notes)
    scans = _scan_topics(bag, scan_topics)
    odometers = _chosen(bag, ODOMETRY, odom_topic, "odom")
    survey = _survey(bag, scans, told, notes)
    times, seen = survey.times, survey.frames
    damaged: list[Damage] = []
    frames = bag_frames.transforms_of(bag, set(seen), damaged)
    frame = seen.most_common(1)[0][0]

    # 1. Odometry: from its topic or, if there is none, from transforms.
    if odometers is not None:
        odometer, odom, base = _odometer(bag, odometers, damaged, notes)
        called = odometers
    else:
        odometer, odom, base = _odometer_of_transforms(bag, frames, frame, notes)
        called = f"the transforms from {odom} to {base}"
    odometer = _of_one_source(odometer.upright(called, notes), called, notes)

    # 2. Where each frame of scans is on the robot. Frames without a transform are left out, if
    # others have one.
    assumed = {"fov": text} if (text := survey.doubt) else {}
    found = {frame: bag_frames.mount_of(frames, odom, base, frame, notes) for frame in seen}
    unknown = [frame for frame, mount in found.items() if mount is None]
    if unknown and len(unknown) < len(seen) and told.mount is None:
        lost = counted(sum(seen[frame] for frame in unknown), "scans")
        notes.append(
            f"No transform leads from the robot ({base}) to {first_few(unknown, 3)}: {lost} from "
            "there are left out. Record the transforms of all lasers."
        )
        found = {frame: found[frame] for frame in seen if frame not in unknown}
    elif unknown:
        assumed["mount"] = bag_frames.describe_unmounted(frames, base, unknown)
    is_told = told.mount is not None
    mounts = {
        frame: believed(mount or Mount(), survey.some[frame], frame, bag.source, is_told, notes)
        for frame, mount in found.items()
    }

    # 3. Corrected poses: from the transforms above the frame of the odometry.
    tracks = (
        bag_frames.parent_of(frames, child).track for child in bag_frames.ancestors(frames, odom)
    )
    above = [track for track in tracks if track is not None]

    # 4. Times: by the stamps of messages, or by their recording.
    clocks = {called: odometer.table()[:, :2], **times}
    clocks |= {f"the transforms above {odom}": track.table()[:, :2] for track in above}
    by_stamp, contradictions = clock_of(clocks)
    notes += contradictions
    sources = [f"Scans come from {' and '.join(scans)}, odometry from {called}."]
    if len(mounts) > 1:
        sources.append(
            "The scans are of several frames "
            f"({', '.join(f'{count} of {name}' for name, count in seen.most_common())}): each "
            "is mounted as its own frame says."
        )
    if above:
        sources.append(f"Corrected poses come from the transforms above {odom}.")
    corrections = [TimedPoses.of(track, by_stamp) for track in above]
    poses = TimedPoses.of(odometer, by_stamp)
    notes += _describe_gaps(poses)
    where = _ScanPoses(poses, corrections, mounts, by_stamp, told.fov)
    items = _scans(bag, set(scans), where, damaged, survey.repeated)
    odometry = poses.times, poses.poses
    return SurveyedLog(bag.format, tuple(notes), items, assumed, tuple(sources), odometry)


def gaps_of(times: Array, poses: Array) -> list[int]:
    """Find the poses after which no other came for a while in which the robot moved."""
    pauses = np.diff(times)
    moves = np.abs(np.diff(poses, axis=0)).max(axis=1)
    usual = float(np.median(pauses)) if len(pauses) else 0.0
    return np.flatnonzero((pauses > max(GAP, LONGER * usual)) & (moves > UNSEEN)).tolist()


def _describe_gaps(poses: TimedPoses) -> list[str]:
    """Make a note if no odometry came for a while in which the robot moved; otherwise none."""
    times = poses.times
    if not (found := gaps_of(times, poses.poses)):
        return []
    longest = max(found, key=lambda k: times[k + 1] - times[k])
    return [
        f"The odometry has {counted(len(found), 'gaps')}: for "
        f"{times[longest + 1] - times[longest]:.1f} s from {times[longest]:.1f} s on at most. "
        "There, the track rests on the scans alone. Record the odometry without a break, or cut "
        "the log there."
    ]


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


@dataclass
class _FirstPass:
    """What the first pass over the scans of a bag finds."""

    # For each topic (n, 2): the times in the headers and of the recording, in seconds.
    times: dict[str, Array]
    frames: Counter[str]  # number of scans of each frame
    some: dict[str, list[Any]]  # a few messages of each frame
    # Topics and numbers of messages that repeat an earlier one.
    repeated: set[tuple[str, int]]
    doubt: str | None  # a note on the angles of most scans


def _survey(bag: Bag, topics: Sequence[str], told: LaserOptions, notes: list[str]) -> _FirstPass:
    """Read the scans of some topics, and note those that are repeated. Raises LogError."""
    times: dict[str, list[tuple[float, float]]] = {}
    found = _FirstPass({}, Counter(), {}, set(), None)
    doubts: Counter[str] = Counter()
    known = set[int]()
    last: dict[str, tuple[int, float, float]] = {}  # of each frame
    for connection, number, recorded, message in bag.messages(set(topics)):
        if isinstance(message, Damage):
            continue
        frame = bag_frames.frame_name(message.header.frame_id)
        stamp = bag_frames.stamp_of(message.header)
        ranges = ranges_of(message)
        content = hash((frame, ranges.tobytes()))
        same, *before = last.get(frame, (0, -math.inf, -math.inf))
        last[frame] = content, stamp, recorded
        is_other = content != same or (np.subtract((stamp, recorded), before) < AT_ONCE).all()
        if content in known and is_other and len(set(ranges)) > FEW:
            found.repeated.add((connection.topic, number))
        known.add(content)
        times.setdefault(connection.topic, []).append((stamp, recorded))
        found.frames[frame] += 1
        try:
            doubts[angles_of(message, told.fov)[2] or ""] += 1
        except Damaged as damage:
            doubts[f"!{damage}"] += 1
            continue
        some = found.some.setdefault(frame, [])
        if found.frames[frame] % EACH == 1 and len(some) < SAMPLES:
            some.append(message)
    if not found.frames:
        raise LogError(
            f"{bag.source}: expected scans in {' and '.join(topics)}, got none that can be read"
            "; record them again, or name another topic (--set scan_topic)"
        )
    [(doubt, count)] = doubts.most_common(1)
    if 2 * count > doubts.total():
        if doubt.startswith("!"):
            raise LogError(f"{bag.source}: {doubt[1:]}")
        found.doubt = doubt or None
    count, scans = len(found.repeated), found.frames.total()
    if count < max(LEAST_REPEATED, REPEATED * scans):
        found.repeated.clear()
    else:
        notes.append(
            f"{count} of {scans} scans repeat the ranges of an earlier one: they are left out. The "
            "bag was recorded twice, or while another was played in a loop."
        )
    found.times = {topic: np.array(both) for topic, both in times.items()}
    return found


def _odometer(
    bag: Bag, topic: str, damaged: list[Damage], notes: list[str]
) -> tuple[bag_frames.RecordedTrack, str, str]:
    """Read the poses of the odometer, the name of their frame, and the name of the robot's frame.

    `damaged` receives the messages that cannot be read, `notes` a note if several programs publish
    the topic. Raises LogError if no message can be read.
    """
    tracks: dict[tuple[str, str, str], bag_frames.RecordedTrack] = {}
    for connection, number, recorded, message in bag.messages({topic}):
        if isinstance(message, Damage):
            damaged.append(message)
            continue
        pose = message.pose.pose
        try:
            flat = bag_frames.flat_pose(pose.position, pose.orientation)
        except Damaged as damage:
            damaged.append(Damage(number, f"{topic}: {damage}"))
            continue
        frame, child = map(bag_frames.frame_name, (message.header.frame_id, message.child_frame_id))
        source = frame, child, getattr(connection.ext, "callerid", "") or ""
        track = tracks.setdefault(source, bag_frames.RecordedTrack())
        track.add(bag_frames.stamp_of(message.header), recorded, flat, pose.orientation)
    if not tracks:
        raise LogError(
            f"{bag.source}: expected odometry in {topic}, got none that can be read"
            f"{f' ({damaged[-1].what})' if damaged else ''}; record it again, or name another "
            "topic (--set odom_topic)"
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
    return tracks[best].righted(best[0], best[1], notes)


def _odometer_of_transforms(
    bag: Bag, frames: bag_frames.Frames, frame: str, notes: list[str]
) -> tuple[bag_frames.RecordedTrack, str, str]:
    """Read what `_odometer` returns, but from transforms from `odom` to the robot."""
    names = bag_frames.ancestors(frames, bag_frames.same_frame(frames, frame))
    chain = [(child, bag_frames.parent_of(frames, child)) for child in names]
    moving = [(child, one) for child, one in chain if one.track is not None]
    found = next(
        ((child, one) for child, one in moving if "odom" in one.parent.rpartition("/")[2]), None
    ) or next(iter(moving), None)
    # The frame odom may be the child of the robot's.
    for child in (
        [name for name in frames if "odom" in name.rpartition("/")[2]] if not found else ()
    ):
        if (track := bag_frames.parent_of(frames, child).track) is not None:
            parent = bag_frames.parent_of(frames, child).parent
            del frames[child]
            return track.righted(parent, child, notes)
    if found is None:
        raise LogError(
            f"{bag.source}: expected odometry (messages Odometry, or transforms from odom to "
            f"the frame {frame!r} of the scans), got none; topics: {bag.listed()}"
        )
    base, edge = found
    assert edge.track is not None
    return edge.track, edge.parent, base


def _of_one_source(
    track: bag_frames.RecordedTrack, called: str, notes: list[str]
) -> bag_frames.RecordedTrack:
    """If the poses of several sources alternate, keep those of the largest one, and note it."""
    table = track.table()
    sources = sources_of(table[:, 2:])
    if len(sources) == 1:
        return track
    # For the note, measure how far the poses of the two largest sources differ.
    first, second = (
        bag_frames.RecordedTrack(array("d", table[some].ravel())) for some in sources[:2]
    )
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
    mounts: dict[str, Mount]  # for each frame of scans, where the laser is
    # Whether times come from the headers of messages; otherwise, they are times of recording.
    by_stamp: bool
    fov: float | None  # the field of view in degrees, if the user says it

    def scan(self, message: Any, recorded: float, number: int) -> Scan:
        """Make the scan of a message. Raises Damaged."""
        time = bag_frames.stamp_of(message.header) if self.by_stamp else recorded
        if not self.odometry.covers(time):
            begin, end = self.odometry.times[[0, -1]]
            raise Damaged(
                f"expected odometry at the time of the scan, {time:.3f} s, got it from "
                f"{begin:.3f} to {end:.3f} s"
            )
        pose = corrected = self.odometry.at(time)
        for correction in self.corrections:
            corrected = moved(correction.at(time), corrected)
        mount = self.mounts[bag_frames.frame_name(message.header.frame_id)]
        ranges, laser = measured(message, mount, self.fov)
        return Scan(ranges, laser, pose, corrected if self.corrections else None, time, number)


def _scans(
    bag: Bag,
    topics: set[str],
    where: _ScanPoses,
    damaged: list[Damage],
    repeated: set[tuple[str, int]],
) -> Iterator[Scan | Damage]:
    """Yield the scans of a bag, and `Damage` for what cannot be read."""
    yield from damaged
    for connection, number, recorded, message in bag.messages(topics):
        if (connection.topic, number) in repeated:
            continue
        is_damaged = isinstance(message, Damage)
        if not is_damaged and bag_frames.frame_name(message.header.frame_id) not in where.mounts:
            continue
        try:
            yield message if is_damaged else where.scan(message, recorded, number)
        except Damaged as damage:
            yield Damage(number, f"{connection.topic}: {damage}")


def measured(message: Any, mount: Mount, fov: float | None = None) -> tuple[Array, LaserScanner]:
    """Read ranges and laser of a message. The beams of a flipped laser turn clockwise.

    `fov` is the field of view in degrees according to the user. Raises Damaged.
    """
    nearest, reach = float(message.range_min), float(message.range_max)
    ranges = ranges_of(message)
    if not len(ranges):
        raise Damaged("expected at least one range, got none")
    first, step, _ = angles_of(message, fov)
    reach, nearest = reach if reach > 0 else math.inf, nearest if 0 < nearest < math.inf else 0.0
    if mount.rotation:
        ranges = mount.levelled(ranges, first, step, reach)
    if mount.is_flipped:
        first, step = -first, -step
    return ranges, laser_of(first, step, len(ranges), reach, mount.pose, nearest)
