"""Reads ROS bags: files of ROS 1, folders and files of ROS 2, and MCAP.

It uses the package rosbags (extra `ros`); ROS itself need not be installed. It reads the laser's
scans (sensor_msgs/LaserScan, or the first echoes of MultiEchoLaserScan), the odometer's poses
(nav_msgs/Odometry) and the transforms between frames (tf2_msgs/TFMessage), with frames named as in
REP 105:

- Odometry is the pose in Odometry messages. Without these, it is the transform from `odom` to the
  robot. It is interpolated at the time of each scan.
- The mount of the laser is the transform from the frame of the robot to the frame that the scan
  names. A laser that hangs upside down turns clockwise.
- If the robot was localised, so that there are transforms from `map` to `odom`, the scans have
  corrected poses.

Times come from the headers of the messages. If these contradict themselves or each other, the times
of recording are used (`poses`).
"""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from perception.errors import LogError
from perception.readers import bag_files
from perception.readers.bag_files import cause
from perception.readers.poses import Poses, Track, clock_of, sources_of
from perception.readers.scans import Damage, Laser, Pose, Reading, Scan
from ssh_abduction.data.errors import brief, named
from ssh_abduction.data.odometry import between, moved

SCANS = ("sensor_msgs/msg/LaserScan", "sensor_msgs/msg/MultiEchoLaserScan")
ODOMETRY = ("nav_msgs/msg/Odometry",)
TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
NANO = 1e-9
# Largest difference of the messages of a fixed transform, from rounding: metres and radians.
FIXED = (0.01, 0.01)


class _Damaged(Exception):  # noqa: N818 - becomes a Damage
    """A message that cannot be read."""


@dataclass
class _Frame:
    """The transform from a parent frame to a frame.

    Attributes:
        parent: Name of the parent frame.
        translation: (3,) last translation.
        rotation: (3, 3) last rotation.
        first: First transform in the plane.
        track: Transforms over time in the plane; None for a static one.
        count: Number of messages.
        off: Largest difference from the first one, in metres and radians.
    """

    parent: str
    translation: NDArray[np.float64]
    rotation: NDArray[np.float64]
    first: Pose
    track: Track | None
    count: int = 0
    off: tuple[float, float] = (0.0, 0.0)

    @property
    def is_fixed(self) -> bool:
        return self.off[0] <= FIXED[0] and self.off[1] <= FIXED[1]


# The transforms to each frame, by parent. A frame should have one parent, but some have several.
_Frames = dict[str, dict[str, _Frame]]


class Bag:
    """An open bag.

    Attributes:
        readers: Readers of rosbags, one for each part.
        format: `ros1`, `ros2` or `mcap`.
        notes: Notes on the files.
        source: Name of the bag.
        deserialize: Turns bytes of a message kind into a message.
    """

    def __init__(self, files: bag_files.Files, store: Any, source: str) -> None:
        self.readers, self.format, self.notes, self.source = (
            files.readers,
            files.format,
            files.notes,
            source,
        )
        self.deserialize = (
            store.deserialize_ros1 if files.format == "ros1" else store.deserialize_cdr
        )

    @property
    def connections(self) -> list[Any]:
        return [connection for reader in self.readers for connection in reader.connections]

    def topics(self, *kinds: str) -> dict[str, int]:
        """The topics of these kinds, or all topics, with the number of messages."""
        counts: dict[str, int] = {}
        for connection in self.connections:
            if not kinds or connection.msgtype in kinds:
                counts[connection.topic] = counts.get(connection.topic, 0) + connection.msgcount
        return counts

    def listed(self) -> str:
        """All topics with their kinds, for error messages."""
        topics = dict.fromkeys(
            f"{c.topic} ({c.msgtype.rpartition('/')[2]})" for c in self.connections
        )
        return (
            ", ".join(list(topics)[:20]) + (", …" if len(topics) > 20 else "") if topics else "none"
        )

    def messages(self, topics: set[str]) -> Iterator[tuple[Any, int, float, Any]]:
        """Read the messages of some topics.

        Yields:
            The connection, the number within the topic, the time of recording, and the message or
            its Damage.
        """
        from rosbags.serde import SerdeError

        numbers = dict.fromkeys(topics, 0)
        for reader in self.readers:
            connections = [c for c in reader.connections if c.topic in topics]
            stored = reader.messages(connections=connections) if connections else iter(())
            while True:
                try:
                    connection, time, raw = next(stored)
                except StopIteration:
                    break
                except Exception as error:  # Damaged bytes can raise any error in the library.
                    bag_files.check_room(error, self.source)
                    number = sum(numbers.values()) + 1
                    where = " and ".join(sorted(topics))
                    what = (
                        f"{where}: expected a message, got damaged data ({cause(error)}); what "
                        "follows was not read"
                    )
                    yield connections[0], number, 0.0, Damage(number, what)
                    break
                topic = connection.topic
                numbers[topic] += 1
                try:
                    yield (
                        connection,
                        numbers[topic],
                        time * NANO,
                        self.deserialize(raw, connection.msgtype),
                    )
                except (SerdeError, ValueError, IndexError) as error:
                    what = (
                        f"{topic}: expected a message {connection.msgtype.rpartition('/')[2]}, "
                        f"got damaged data ({cause(error)})"
                    )
                    yield connection, numbers[topic], time * NANO, Damage(numbers[topic], what)


@contextmanager
def opened(path: str | os.PathLike[str], format: str) -> Iterator[Bag]:
    """Open a bag of a format. Raises LogError."""
    with bag_files.opened(Path(path), format) as files:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        store = get_typestore(Stores.ROS1_NOETIC if files.format == "ros1" else Stores.ROS2_HUMBLE)
        for kind in TRANSFORMS:
            if kind not in store.fielddefs:
                store.register(
                    get_types_from_msg("geometry_msgs/TransformStamped[] transforms", kind)
                )
        yield Bag(files, store, named(path))


def read(bag: Bag, scan_topics: Sequence[str], odom_topic: str | None) -> Reading:
    """Survey a bag, so that its scans can be read.

    Args:
        bag: The open bag.
        scan_topics: Topics of the scans; none for the only one.
        odom_topic: Topic of the odometry; None for the only one, or for transforms.

    Returns:
        The notes and the scans.

    Raises:
        LogError: There are no scans or no odometry, or several topics and none is named.
    """
    notes = list(bag.notes)
    scans = _scan_topics(bag, scan_topics)
    odometers = _chosen(bag, ODOMETRY, odom_topic, "odom")
    times, seen = _survey(bag, scans)
    said = " and ".join(scans)
    damaged: list[Damage] = []
    frames = _frames(bag, set(seen), damaged)
    frame = seen.most_common(1)[0][0]
    if odometers is not None:
        odometer, odom, base = _odometer(bag, odometers, damaged, notes)
        notes.insert(len(bag.notes), f"Scans are those of {said}, odometry that of {odometers}.")
        called = odometers
    else:
        odometer, odom, base = _odometer_of_transforms(bag, frames, frame)
        notes.append(
            f"Scans are those of {said}. There are no messages Odometry: odometry is the "
            f"transform from {odom} to {base}."
        )
        called = f"the transforms from {odom} to {base}"
    odometer = _of_one_source(odometer, called, notes)
    assumed: dict[str, str] = {}
    mounts = {frame: _mount(frames, odom, base, frame, notes, assumed) for frame in seen}
    if len(seen) > 1:
        notes.append(
            "The scans are of several frames "
            f"({', '.join(f'{count} of {name}' for name, count in seen.most_common())}): each "
            "is mounted as its own frame says."
        )
    # Transforms above the frame of the odometry correct its poses.
    above = [
        track
        for child in _ancestors(frames, odom)
        if (track := _parent(frames, child).track) is not None
    ]
    corrections = {f"the transforms above {odom}": track for track in above}
    clocks = {
        called: odometer.table()[:, :2],
        **times,
        **{name: track.table()[:, :2] for name, track in corrections.items()},
    }
    by_stamp, contradictions = clock_of(clocks)
    notes += contradictions
    if above:
        notes.append(f"Corrected poses are those of the transforms above {odom}.")
    where = _Where(
        Poses.of(odometer, by_stamp),
        [Poses.of(track, by_stamp) for track in above],
        mounts,
        by_stamp,
    )
    return Reading(bag.format, tuple(notes), _scans(bag, set(scans), where, damaged), assumed)


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
    """The topic of these kinds: the named one or the only one; None if there is none."""
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
                f"{bag.source}: --{option}-topic: expected a topic of {short}, got "
                f"{brief(name)}; those in the bag: {listed}"
            )
        return match[0]
    if len(counts) > 1:
        several = ", once for each that is to be read" if option == "scan" else ""
        raise LogError(
            f"{bag.source}: expected one topic of {short}, got {len(counts)}: {listed}; name "
            f"one with --{option}-topic{several}"
        )
    return next(iter(counts), None)


def _survey(bag: Bag, topics: Sequence[str]) -> tuple[dict[str, NDArray[np.float64]], Counter[str]]:
    """The two times of the scans of each topic, (n, 2), and the number of scans of each frame."""
    times: dict[str, list[tuple[float, float]]] = {}
    frames: Counter[str] = Counter()
    for connection, _, recorded, message in bag.messages(set(topics)):
        if not isinstance(message, Damage):
            times.setdefault(connection.topic, []).append((_stamp(message.header), recorded))
            frames[_name(message.header.frame_id)] += 1
    if not frames:
        raise LogError(
            f"{bag.source}: expected scans in {' and '.join(topics)}, got none that can be read"
        )
    return {topic: np.array(both) for topic, both in times.items()}, frames


def _odometer(
    bag: Bag, topic: str, damaged: list[Damage], notes: list[str]
) -> tuple[Track, str, str]:
    """The poses of the odometer, their frame, and the frame of the robot. Raises LogError."""
    tracks: dict[tuple[str, str, str], Track] = {}
    for connection, number, recorded, message in bag.messages({topic}):
        if isinstance(message, Damage):
            damaged.append(message)
            continue
        pose = message.pose.pose
        try:
            flat = _flat(pose.position, pose.orientation)
        except _Damaged as damage:
            damaged.append(Damage(number, f"{topic}: {damage}"))
            continue
        source = (
            _name(message.header.frame_id),
            _name(message.child_frame_id),
            getattr(connection.ext, "callerid", "") or "",
        )
        tracks.setdefault(source, Track()).add(_stamp(message.header), recorded, flat)
    if not tracks:
        raise LogError(f"{bag.source}: expected odometry in {topic}, got none that can be read")
    # Several programs may publish one topic: take the longest track, preferably from a frame odom.
    best = max(tracks, key=lambda source: (len(tracks[source].numbers), "odom" in source[0]))
    if len(tracks) > 1:

        def told(source: tuple[str, str, str]) -> str:
            odom, base, sender = source
            return f"from {odom} to {base}{f' by {sender}' if sender else ''}"

        listed = ", ".join(
            f"{len(track.table())} {told(source)}" for source, track in tracks.items()
        )
        notes.append(
            f"Several sources publish {topic}: {listed}. Those {told(best)} are read; record "
            "each source to a topic of its own."
        )
    return tracks[best], best[0], best[1]


def _odometer_of_transforms(bag: Bag, frames: _Frames, frame: str) -> tuple[Track, str, str]:
    """The same as `_odometer`, from the transforms from `odom` to the robot. Raises LogError."""
    chain = [(child, _parent(frames, child)) for child in _ancestors(frames, frame)]
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


def _of_one_source(track: Track, called: str, notes: list[str]) -> Track:
    """The poses of the first source, if those of several sources alternate."""
    sources = sources_of(track)
    if len(sources) == 1:
        return track
    table = track.table()
    first, second = (Track() for _ in range(2))
    for number in sources[0]:
        first.numbers.extend(table[number])
    for number in sources[1]:
        second.numbers.extend(table[number])
    here, there = Poses.of(first, False), Poses.of(second, False)
    apart = max(math.dist(here.at(time)[:2], there.at(time)[:2]) for time in there.times)
    notes.append(
        f"Several sources publish {called}, whose poses alternate, up to {apart:.1f} m apart: "
        f"{len(sources[0])} and {len(sources[1])} of {len(table)} messages. "
        "The first of these is read; stop the other, and record again, if it is the better one."
    )
    return first


def _frames(bag: Bag, seen: set[str], damaged: list[Damage]) -> _Frames:
    """Read the transforms. Only the ancestors of the scans' frames keep theirs over time.

    A robot has many joints, whose transforms are not needed.
    """
    frames: _Frames = {}
    topics = set(bag.topics(*TRANSFORMS))
    fixed = {topic for topic in topics if topic.endswith("tf_static")}
    for group, is_static in ((fixed, True), (topics - fixed, False)):
        for connection, number, recorded, message in bag.messages(group):
            if isinstance(message, Damage):
                damaged.append(message)
                continue
            for stamped in message.transforms:
                child, parent = _name(stamped.child_frame_id), _name(stamped.header.frame_id)
                try:
                    edge = _heard(frames, child, parent, stamped.transform, is_static)
                except _Damaged as damage:
                    damaged.append(Damage(number, f"{connection.topic}: {child}: {damage}"))
                    continue
                if edge.track is not None and (
                    edge.count == 1 or any(child in _ancestors(frames, frame) for frame in seen)
                ):
                    edge.track.add(
                        _stamp(stamped.header),
                        recorded,
                        _flat(stamped.transform.translation, stamped.transform.rotation),
                    )
    return frames


def _heard(frames: _Frames, child: str, parent: str, transform: Any, is_static: bool) -> _Frame:
    """Record a message of the transform to a frame. Raises Damaged."""
    move, turn = transform.translation, transform.rotation
    flat = _flat(move, turn)
    parents = frames.setdefault(child, {})
    edge = parents.get(parent)
    if edge is None or (edge.track is None) != is_static:
        edge = _Frame(parent, np.zeros(3), np.eye(3), flat, None if is_static else Track())
    parents.pop(parent, None)
    parents[parent] = edge  # The last parent comes last.
    edge.translation = np.array([move.x, move.y, move.z])
    if edge.track is None or edge.count == 0 or edge.off != (0.0, 0.0) or flat != edge.first:
        edge.rotation = _rotation(turn)
    edge.count += 1
    x, y, angle = between(edge.first, flat)
    edge.off = max(edge.off[0], math.hypot(x, y)), max(edge.off[1], abs(angle))
    return edge


def _parent(frames: _Frames, child: str) -> _Frame:
    """The transform to a frame from its parent.

    With several parents, it is a frame of the odometry, or else the last one.
    """
    parents = list(frames[child].values())
    return next((one for one in parents if "odom" in one.parent.rpartition("/")[2]), parents[-1])


def _ancestors(frames: _Frames, frame: str) -> list[str]:
    """The frame, its parent and so on, as far as transforms lead."""
    chain: list[str] = []
    while frame in frames and frame not in chain:
        chain.append(frame)
        frame = _parent(frames, frame).parent
    return chain


def _mount(
    frames: _Frames, odom: str, base: str, frame: str, notes: list[str], assumed: dict[str, str]
) -> tuple[Pose, bool]:
    """The pose of the laser in the frame of the robot, and whether it hangs upside down."""
    if base == frame:
        return (0.0, 0.0, 0.0), False
    chain = _ancestors(frames, frame)
    parents = [_parent(frames, child).parent for child in chain]
    # If the robot's frame is unknown, the frame below the odometry's is the robot.
    top = (
        parents.index(base)
        if base in parents
        else parents.index(odom) - 1
        if odom in parents
        else None
    )
    if top is None:
        assumed["mount"] = (f"{assumed['mount']} " if "mount" in assumed else "") + (
            f"No transform leads from the robot ({base or 'a frame without a name'}) to its laser "
            f"({frame}): the laser is taken to sit in the robot's middle and to look ahead. "
            "If it does not, say where it sits: --mount X,Y,DEGREES."
        )
        return (0.0, 0.0, 0.0), False
    translation, rotation = np.zeros(3), np.eye(3)
    for child in reversed(chain[: top + 1]):
        edge = _parent(frames, child)
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


@dataclass(frozen=True)
class _Where:
    """Poses of the robot and its lasers.

    Attributes:
        odometry: Poses by the odometer.
        corrections: Transforms above the frame of the odometry, the nearest first.
        mounts: For each frame of scans, the pose of the laser in the frame of the robot, and
            whether it hangs upside down.
        by_stamp: Whether times are those of the headers.
    """

    odometry: Poses
    corrections: list[Poses]
    mounts: dict[str, tuple[Pose, bool]]
    by_stamp: bool

    def at(self, time: float) -> tuple[Pose, Pose | None]:
        """The pose by the odometer, and the corrected one. Raises Damaged."""
        if not self.odometry.tells(time):
            begin, end = self.odometry.times[[0, -1]]
            raise _Damaged(
                f"expected odometry at the time of the scan, {time:.3f} s, got it from "
                f"{begin:.3f} to {end:.3f} s"
            )
        pose = self.odometry.at(time)
        corrected: Pose | None = pose if self.corrections else None
        for correction in self.corrections:
            assert corrected is not None
            corrected = moved(correction.at(time), corrected)
        return pose, corrected


def _scans(
    bag: Bag, topics: set[str], where: _Where, damaged: list[Damage]
) -> Iterator[Scan | Damage]:
    """Read the scans, after the damage found so far."""
    yield from damaged
    for connection, number, recorded, message in bag.messages(topics):
        if isinstance(message, Damage):
            yield message
            continue
        try:
            time = _stamp(message.header) if where.by_stamp else recorded
            pose, corrected = where.at(time)
            ranges, laser = _measured(message, *where.mounts[_name(message.header.frame_id)])
            yield Scan(ranges, laser, pose, corrected, time, number)
        except _Damaged as damage:
            yield Damage(number, f"{connection.topic}: {damage}")


def _measured(message: Any, mount: Pose, is_flipped: bool) -> tuple[NDArray[np.float64], Laser]:
    """The ranges of a message and its laser. Raises Damaged."""
    first, step, nearest, reach = (
        float(v)
        for v in (message.angle_min, message.angle_increment, message.range_min, message.range_max)
    )
    if message.__msgtype__ == SCANS[0]:
        ranges = np.array(message.ranges, dtype=np.float64)
    else:  # A beam without an echo met nothing.
        ranges = np.array(
            [beam.echoes[0] if len(beam.echoes) else np.inf for beam in message.ranges],
            dtype=np.float64,
        )
    if not len(ranges):
        raise _Damaged("expected at least one range, got none")
    if not math.isfinite(first) or not 0 < abs(step) <= math.tau:
        raise _Damaged(f"expected a first angle and a step in radians, got {first:g} and {step:g}")
    if is_flipped:
        first, step = -first, -step
    return ranges, _laser(
        first,
        step,
        len(ranges),
        reach if reach > 0 else math.inf,
        mount,
        nearest if 0 < nearest < math.inf else 0.0,
    )


@lru_cache(maxsize=64)
def _laser(
    first: float, step: float, beams: int, reach: float, mount: Pose, nearest: float
) -> Laser:
    return Laser(first, step, beams, reach, mount, nearest)


def _flat(position: Any, orientation: Any) -> Pose:
    """The pose in the plane. Raises Damaged if the numbers are no pose."""
    x, y, z, w = orientation.x, orientation.y, orientation.z, orientation.w
    numbers = position.x, position.y, position.z, x, y, z, w
    if not all(map(math.isfinite, numbers)) or x * x + y * y + z * z + w * w < 0.5:
        raise _Damaged(
            "expected a position in metres and a quaternion, got "
            f"{', '.join(f'{v:g}' for v in numbers)}"
        )
    return position.x, position.y, math.atan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)


def _rotation(q: Any) -> NDArray[np.float64]:
    """The rotation matrix of a quaternion, (3, 3)."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix(), dtype=np.float64)


def _stamp(header: Any) -> float:
    """The time of a header in seconds; 0 if it is missing."""
    return float(header.stamp.sec + header.stamp.nanosec * NANO)


def _name(frame: str) -> str:
    """The name of a frame, without the slash that it may begin with in ROS 1."""
    return frame.lstrip("/")
