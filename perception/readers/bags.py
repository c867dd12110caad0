"""Reader of ROS bags, by the package rosbags (extra `ros`): files of ROS 1, folders and files of ROS 2, and MCAP. No ROS needs to be installed.

Read are the laser's scans (sensor_msgs/LaserScan), the odometer's poses (nav_msgs/Odometry) and the transforms between frames (tf2_msgs/TFMessage), as ROS calls frames (REP 105):

- Odometry is the pose in messages of Odometry, and where there are none the transform from `odom` to the robot. It is interpolated at the time of each scan.
- The laser's mount is the transform from the robot's frame to that of the scans. A laser that hangs upside down turns clockwise.
- Where somebody localised the robot, so that there are transforms from `map` to `odom`, the scans have corrected poses.

Times are those of the messages' headers. Where these are missing, run backwards, or are those of different clocks, they are the times at which messages were recorded.
"""

from __future__ import annotations

import math
import os
import tempfile
from array import array
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from perception.errors import LogError
from perception.readers.scans import Damage, Laser, Pose, Reading, Scan
from ssh_abduction.errors import brief, named
from ssh_abduction.odometry import moved

# How a file begins, and what its name has to end in for rosbags.
MAGICS = {b"#ROSBAG V": ("ros1", ".bag"), b"\x89MCAP0\r\n": ("mcap", ".mcap"), b"SQLite format 3\0": ("ros2", ".db3")}
SCANS, ODOMETRY = "sensor_msgs/msg/LaserScan", "nav_msgs/msg/Odometry"
TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
NANO = 1e-9
# Odometry that ends, or begins, so many seconds beside a scan still tells where the scan was taken.
BESIDE = 1.0
# Clocks that differ by more seconds are different clocks.
SAME_CLOCK = 1.0


class _Damaged(Exception):  # noqa: N818 - becomes a Damage
    """A message that cannot be read."""


@dataclass
class _Track:
    """Poses over time, which come one after another. Each has two times: that of its header, 0 where there is none, and that at which it was recorded."""

    numbers: array[float] = field(default_factory=lambda: array("d"))

    def add(self, stamp: float, recorded: float, pose: Pose) -> None:
        self.numbers.extend((stamp, recorded, *pose))

    def table(self) -> NDArray[np.float64]:
        """(n, 5): both times, and the pose."""
        return np.frombuffer(self.numbers, dtype=np.float64).reshape(-1, 5)


@dataclass(frozen=True)
class _Poses:
    """Poses over time, (n,) and (n, 3), in the order of time and with headings that do not jump."""

    times: NDArray[np.float64]
    poses: NDArray[np.float64]

    @classmethod
    def of(cls, track: _Track, by_stamp: bool) -> _Poses:
        table = track.table()
        times = table[:, 0 if by_stamp else 1]
        order = np.argsort(times, kind="stable")
        poses = table[order, 2:].copy()
        poses[:, 2] = np.unwrap(poses[:, 2])
        return cls(times[order], poses)

    def at(self, time: float) -> Pose:
        x, y, heading = (float(np.interp(time, self.times, self.poses[:, i])) for i in range(3))
        return x, y, math.remainder(heading, math.tau)

    def tells(self, time: float) -> bool:
        return bool(self.times[0] - BESIDE <= time <= self.times[-1] + BESIDE)


@dataclass
class _Frame:
    """The transform from a frame's parent to the frame.

    translation, rotation  the first one, (3,) and (3, 3)
    track                  those that came over time, in the plane; None where it never changes
    """

    parent: str
    translation: NDArray[np.float64]
    rotation: NDArray[np.float64]
    track: _Track | None


class Bag:
    """An open bag."""

    def __init__(self, reader: Any, store: Any, format: str, source: str) -> None:
        self.reader, self.format, self.source = reader, format, source
        self.deserialize = store.deserialize_ros1 if format == "ros1" else store.deserialize_cdr

    def topics(self, *kinds: str) -> dict[str, int]:
        """The topics of some kinds, or all, and how many messages each has."""
        counts: dict[str, int] = {}
        for connection in self.reader.connections:
            if not kinds or connection.msgtype in kinds:
                counts[connection.topic] = counts.get(connection.topic, 0) + connection.msgcount
        return counts

    def listed(self) -> str:
        """All topics with their kinds, as messages list them."""
        topics = dict.fromkeys(f"{c.topic} ({c.msgtype.rpartition('/')[2]})" for c in self.reader.connections)
        return ", ".join(list(topics)[:20]) + (", …" if len(topics) > 20 else "") if topics else "none"

    def messages(self, topics: set[str]) -> Iterator[tuple[str, int, float, Any]]:
        """The messages of some topics: topic, number among those of the topic, time of recording, and the message, or the Damage that it is."""
        from rosbags.serde import SerdeError

        connections = [c for c in self.reader.connections if c.topic in topics]
        numbers = dict.fromkeys(topics, 0)
        stored = self.reader.messages(connections=connections) if connections else iter(())
        while True:
            try:
                connection, time, raw = next(stored)
            except StopIteration:
                return
            except Exception as error:  # whatever a library runs into in damaged bytes
                number = sum(numbers.values()) + 1
                where = " and ".join(sorted(topics))
                yield (
                    "",
                    number,
                    0.0,
                    Damage(number, f"{where}: expected a message, got damaged data ({_cause(error)}); what follows was not read"),
                )
                return
            topic = connection.topic
            numbers[topic] += 1
            try:
                yield topic, numbers[topic], time * NANO, self.deserialize(raw, connection.msgtype)
            except (SerdeError, ValueError, IndexError) as error:
                what = f"{topic}: expected a message {connection.msgtype.rpartition('/')[2]}, got damaged data ({_cause(error)})"
                yield topic, numbers[topic], time * NANO, Damage(numbers[topic], what)


def format_of(head: bytes) -> str | None:
    """The format of a file that begins in some way; None where it is no bag."""
    return next((name for magic, (name, _) in MAGICS.items() if head.startswith(magic)), None)


@contextmanager
def opened(path: str | os.PathLike[str], format: str) -> Iterator[Bag]:
    """An open bag of a format. Raises LogError."""
    try:
        from rosbags import rosbag1, rosbag2
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError:
        raise LogError(f"{named(path)}: expected the package rosbags to read it with, got none; pip install 'ssh-abduction[ros]'") from None
    is_ros1 = format == "ros1"
    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    for kind in TRANSFORMS:
        if kind not in store.fielddefs:
            store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", kind))
    with tempfile.TemporaryDirectory() as folder:
        file = _with_suffix(Path(path), Path(folder))
        try:
            reader: Any = rosbag1.Reader(file) if is_ros1 else rosbag2.Reader(file)
            reader.open()
        except Exception as error:  # whatever a library runs into in damaged bytes
            raise LogError(
                f"{named(path)}: expected a bag ({format}), got one that cannot be opened ({_cause(error)}); index it again (rosbag reindex, ros2 bag reindex, mcap recover), or record it anew"
            ) from None
        try:
            yield Bag(reader, store, format, named(path))
        finally:
            reader.close()


def _with_suffix(path: Path, folder: Path) -> Path:
    """The path under a name from which rosbags knows what it is, whatever the file is called. Raises LogError for a folder that is no bag."""
    if path.is_dir():
        if (path / "metadata.yaml").exists():
            return path
        inside = sorted((*path.glob("*.mcap"), *path.glob("*.db3")))
        if len(inside) != 1:
            raise LogError(
                f"{named(path)}: expected a folder of ROS 2 with metadata.yaml, or with one file *.mcap or *.db3, got {len(inside)} of these; name a file"
            )
        return inside[0]
    with path.open("rb") as file:
        head = file.read(16)
    suffix = next((suffix for magic, (_, suffix) in MAGICS.items() if head.startswith(magic)), path.suffix)
    if path.suffix == suffix:
        return path
    link = folder / f"bag{suffix}"
    link.symlink_to(path.resolve())
    return link


def read(bag: Bag, scan_topic: str | None, odom_topic: str | None) -> Reading:
    """A bag, surveyed. Raises LogError where it holds no scan or no odometry, or where several topics could be meant and none is named."""
    notes: list[str] = []
    scans = _chosen(bag, SCANS, scan_topic, "scan")
    if scans is None:
        raise LogError(f"{bag.source}: expected scans (messages LaserScan), got none; topics: {bag.listed()}; record the laser, too")
    odometers = _chosen(bag, ODOMETRY, odom_topic, "odom")
    frame, laser_offset = _first_scan(bag, scans)
    damaged: list[Damage] = []
    frames = _frames(bag, frame, damaged)
    chain = _ancestors(frames, frame)
    if odometers is not None:
        odometer, odom, base = _odometer(bag, odometers, damaged)
        notes.append(f"Scans are those of {scans}, odometry that of {odometers}.")
        if not odometer.numbers:
            raise LogError(f"{bag.source}: expected odometry in {odometers}, got none that can be read")
    else:
        edge = next(
            (child for child in chain if "odom" in frames[child].parent.rpartition("/")[2] and frames[child].track is not None), None
        )
        edge = edge or next((child for child in chain if frames[child].track is not None), None)
        if edge is None:
            raise LogError(
                f"{bag.source}: expected odometry (messages Odometry, or transforms from odom to the frame {frame!r} of the scans), got none; topics: {bag.listed()}"
            )
        found = frames[edge].track
        assert found is not None
        odometer, odom, base = found, frames[edge].parent, edge
        notes.append(f"Scans are those of {scans}. There are no messages Odometry: odometry is the transform from {odom} to {base}.")
    mount, is_flipped = _mount(frames, chain, odom, base, frame, notes)
    above = [track for child in _ancestors(frames, odom) if (track := frames[child].track) is not None]
    by_stamp = all(_has_one_clock(track, laser_offset) for track in (odometer, *above))
    if not by_stamp:
        notes.append(
            "The times in the headers of the messages are missing, run backwards, or are those of different clocks: the times of recording are used."
        )
    corrections = [_Poses.of(track, by_stamp) for track in above]
    if corrections:
        notes.append(f"Corrected poses are those of the transforms above {odom}.")
    return Reading(
        bag.format, tuple(notes), _scans(bag, scans, _Poses.of(odometer, by_stamp), corrections, mount, is_flipped, by_stamp, damaged)
    )


def _chosen(bag: Bag, kind: str, name: str | None, option: str) -> str | None:
    """The topic of a kind: the one that is named, or the only one; None where there is none."""
    counts = {topic: count for topic, count in bag.topics(kind).items() if count}
    short = kind.rpartition("/")[2]
    listed = ", ".join(f"{topic} ({count} messages)" for topic, count in sorted(counts.items())) or "none"
    if name is not None:
        match = [topic for topic in counts if topic.strip("/") == name.strip("/")]
        if not match:
            raise LogError(f"{bag.source}: --{option}-topic: expected a topic of {short}, got {brief(name)}; those in the bag: {listed}")
        return match[0]
    if len(counts) > 1:
        raise LogError(f"{bag.source}: expected one topic of {short}, got {len(counts)}: {listed}; name one with --{option}-topic")
    return next(iter(counts), None)


def _first_scan(bag: Bag, topic: str) -> tuple[str, float]:
    """The frame of the first scan that can be read, and by how much the time of its header is ahead of that of its recording."""
    for _, _, recorded, message in bag.messages({topic}):
        if not isinstance(message, Damage):
            return _name(message.header.frame_id), _stamp(message.header) - recorded
    raise LogError(f"{bag.source}: expected scans in {topic}, got none that can be read")


def _odometer(bag: Bag, topic: str, damaged: list[Damage]) -> tuple[_Track, str, str]:
    """The odometer's poses, the frame in which they are, and the robot's frame."""
    track, odom, base = _Track(), "", ""
    for _, number, recorded, message in bag.messages({topic}):
        if isinstance(message, Damage):
            damaged.append(message)
            continue
        pose = message.pose.pose
        try:
            flat = _flat(pose.position, pose.orientation)
        except _Damaged as damage:
            damaged.append(Damage(number, f"{topic}: {damage}"))
            continue
        odom, base = odom or _name(message.header.frame_id), base or _name(message.child_frame_id)
        track.add(_stamp(message.header), recorded, flat)
    return track, odom, base


def _frames(bag: Bag, frame: str, damaged: list[Damage]) -> dict[str, _Frame]:
    """The transforms to frames, by their names. Those that change are kept over time for the ancestors of a frame alone, as a robot has many joints."""
    frames: dict[str, _Frame] = {}
    topics = set(bag.topics(*TRANSFORMS))
    fixed = {topic for topic in topics if topic.endswith("tf_static")}
    for group, is_fixed in ((fixed, True), (topics - fixed, False)):
        for topic, number, recorded, message in bag.messages(group):
            if isinstance(message, Damage):
                damaged.append(message)
                continue
            for stamped in message.transforms:
                child, parent = _name(stamped.child_frame_id), _name(stamped.header.frame_id)
                move, turn = stamped.transform.translation, stamped.transform.rotation
                try:
                    flat = _flat(move, turn)
                    if child not in frames:
                        track = None if is_fixed else _Track()
                        frames[child] = _Frame(parent, np.array([move.x, move.y, move.z]), _rotation(turn), track)
                except _Damaged as damage:
                    damaged.append(Damage(number, f"{topic}: {child}: {damage}"))
                    continue
                track = frames[child].track
                if track is not None and (not track.numbers or child in _ancestors(frames, frame)):
                    track.add(_stamp(stamped.header), recorded, flat)
    return frames


def _ancestors(frames: dict[str, _Frame], frame: str) -> list[str]:
    """The frame, its parent, and so on, as far as there are transforms to them."""
    chain: list[str] = []
    while frame in frames and frame not in chain:
        chain.append(frame)
        frame = frames[frame].parent
    return chain


def _mount(frames: dict[str, _Frame], chain: list[str], odom: str, base: str, frame: str, notes: list[str]) -> tuple[Pose, bool]:
    """The laser's pose in the frame of the robot, and whether it hangs upside down."""
    if base == frame:
        return (0.0, 0.0, 0.0), False
    parents = [frames[child].parent for child in chain]
    top = parents.index(base) if base in parents else parents.index(odom) - 1 if odom in parents else None
    if top is None:
        notes.append(
            f"No transform leads from the robot ({base or 'a frame without a name'}) to its laser ({frame}): the laser is taken to sit in the robot's middle and to look ahead."
        )
        return (0.0, 0.0, 0.0), False
    translation, rotation = np.zeros(3), np.eye(3)
    for child in reversed(chain[: top + 1]):
        translation = translation + rotation @ frames[child].translation
        rotation = rotation @ frames[child].rotation
    heading = math.atan2(rotation[1, 0], rotation[0, 0])
    x, y, angle = (round(float(v), 6) for v in (translation[0], translation[1], heading))
    return (x, y, angle), bool(rotation[2, 2] < 0)


def _has_one_clock(track: _Track, laser_offset: float) -> bool:
    """Whether the times in headers can be used."""
    table = track.table()
    stamps = table[:, 0]
    if not stamps.any() or (np.diff(stamps) < -SAME_CLOCK).any():
        return False
    return bool(abs(stamps[0] - table[0, 1] - laser_offset) <= SAME_CLOCK)


def _scans(
    bag: Bag, topic: str, odometry: _Poses, corrections: list[_Poses], mount: Pose, is_flipped: bool, by_stamp: bool, damaged: list[Damage]
) -> Iterator[Scan | Damage]:
    yield from damaged
    for _, number, recorded, message in bag.messages({topic}):
        if isinstance(message, Damage):
            yield message
            continue
        try:
            time = _stamp(message.header) if by_stamp else recorded
            if not odometry.tells(time):
                raise _Damaged(
                    f"expected odometry at the time of the scan, {time:.3f} s, got it from {odometry.times[0]:.3f} to {odometry.times[-1]:.3f} s"
                )
            ranges, laser = _measured(message, mount, is_flipped)
            pose = odometry.at(time)
            corrected: Pose | None = None
            if corrections:
                corrected = pose
                for correction in corrections:
                    corrected = moved(correction.at(time), corrected)
            yield Scan(ranges, laser, pose, corrected, time, number)
        except _Damaged as damage:
            yield Damage(number, f"{topic}: {damage}")


def _measured(message: Any, mount: Pose, is_flipped: bool) -> tuple[NDArray[np.float64], Laser]:
    first, step, nearest, reach = (float(v) for v in (message.angle_min, message.angle_increment, message.range_min, message.range_max))
    ranges = np.array(message.ranges, dtype=np.float64)
    if not len(ranges):
        raise _Damaged("expected at least one range, got none")
    if not math.isfinite(first) or not 0 < abs(step) <= math.tau:
        raise _Damaged(f"expected a first angle and a step in radians, got {first:g} and {step:g}")
    if is_flipped:
        first, step = -first, -step
    laser = _laser(first, step, len(ranges), reach if reach > 0 else math.inf, mount)
    with np.errstate(invalid="ignore"):
        ranges[ranges >= laser.reach] = np.inf
        ranges[(ranges < nearest) | (ranges <= 0)] = np.nan
    return ranges, laser


@lru_cache(maxsize=64)
def _laser(first: float, step: float, beams: int, reach: float, mount: Pose) -> Laser:
    return Laser(first, step, beams, reach, mount)


def _flat(position: Any, orientation: Any) -> Pose:
    """The pose in the plane. Raises _Damaged where it is none."""
    x, y, z, w = orientation.x, orientation.y, orientation.z, orientation.w
    numbers = position.x, position.y, position.z, x, y, z, w
    if not all(map(math.isfinite, numbers)) or x * x + y * y + z * z + w * w < 0.5:
        raise _Damaged(f"expected a position in metres and a quaternion, got {', '.join(f'{v:g}' for v in numbers)}")
    return position.x, position.y, math.atan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)


def _rotation(q: Any) -> NDArray[np.float64]:
    """The rotation matrix of a quaternion, (3, 3)."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix(), dtype=np.float64)


def _stamp(header: Any) -> float:
    """The time of a header, in seconds; 0 where there is none."""
    return float(header.stamp.sec + header.stamp.nanosec * NANO)


def _name(frame: str) -> str:
    """A frame's name; in ROS 1 it may begin with a slash."""
    return frame.lstrip("/")


def _cause(error: Exception) -> str:
    return (str(error) or type(error).__name__).splitlines()[0].rstrip(".")[:200]
