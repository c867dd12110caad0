"""The poses and transforms of a bag, and where its lasers are mounted on the robot."""

from __future__ import annotations

import math
from array import array
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import numpy as np

from perception.readers.bag_files import NANO, TRANSFORMS, Bag
from perception.readers.bag_geometry import Mount
from perception.readers.scans import Array, Damage, Damaged
from ssh_abduction.data.odometry import Pose, displacement_between
from ssh_abduction.data.words import first_few

# Largest difference of the messages of a fixed transform, from rounding: metres or radians.
FIXED = 0.01
# Poses turn about a wrong axis if headings differ by at most STRAIGHT radians, and the turns about
# that axis by at least TURNS.
STRAIGHT, TURNS = 0.1, 1.0


@dataclass
class RecordedTrack:
    """Poses over time, in the order of their messages."""

    # Flat list of five numbers for each pose: stamp in the header (0 if it has none) and time of
    # recording in seconds; x and y in metres; heading in radians.
    numbers: array[float] = field(default_factory=lambda: array("d"))
    # Flat list of two numbers for each pose: the turns about x and y in radians.
    tilts: array[float] = field(default_factory=lambda: array("d"))

    def add(self, stamp: float, recorded: float, pose: Pose, turn: Any) -> None:
        """Add a pose in the plane, and the quaternion that its heading was made of."""
        self.numbers.extend((stamp, recorded, *pose))
        self.tilts.extend(2 * math.atan2(part, turn.w) for part in (turn.x, turn.y))

    def table(self) -> Array:
        """Return the numbers as a table, (n, 5): stamp, time of recording, x, y, heading."""
        return np.frombuffer(self.numbers, dtype=np.float64).reshape(-1, 5)

    def upright(self, called: str, notes: list[str]) -> RecordedTrack:
        """If the poses turn about x or y and not about z, read headings about that, with a note."""
        table, tilts = self.table(), np.unwrap(np.array(self.tilts).reshape(-1, 2), axis=0)
        axis = int(np.ptp(tilts, axis=0).argmax())
        # A turn about y by more than a quarter looks like one by half a circle about z.
        turned = np.abs(np.sin(table[:, 4] - table[0, 4])).max()
        if turned > STRAIGHT or np.ptp(tilts[:, axis]) < TURNS:
            return self
        notes.append(
            f"The quaternions of {called} turn about {'xy'[axis]}, and not about z: headings are "
            "read about that axis. Write x, y, z and w in this order, x ahead, y to the left, and "
            "turns about z."
        )
        # The axis may point down. If w is written first, headings are mirrored, too.
        ways = (
            np.column_stack([table[:, :4], sign * tilts[:, axis] + turn])
            for sign, turn in product((1, -1), (0.0, math.pi))
        )
        best = max(ways, key=lambda way: _onward(way[:, 2:]))
        return RecordedTrack(array("d", best.ravel()))

    def righted(self, parent: str, child: str, notes: list[str]) -> tuple[RecordedTrack, str, str]:
        """Return the track from a frame odom to the robot, and both names, with a note on changes.

        If odom is the child, the poses may be inverted, or the names alone may be exchanged. The
        robot drives ahead along its headings by the right poses.
        """
        if "odom" not in child.rpartition("/")[2] or "odom" in parent.rpartition("/")[2]:
            return self, parent, child
        table = self.table().copy()
        x, y, heading = table[:, 2:].T
        cos, sin = np.cos(heading), np.sin(heading)
        back = np.stack([-cos * x - sin * y, sin * x - cos * y, -heading], axis=1)
        is_inverted = abs(_onward(back)) >= abs(_onward(table[:, 2:]))
        notes.append(
            f"The odometry leads from {parent} to {child}, so {child} is the child: "
            f"{'the poses are read inverted' if is_inverted else 'the names are exchanged'}. "
            f"Publish the pose of {parent} in {child}."
        )
        if is_inverted:
            table[:, 2:] = back
        return RecordedTrack(array("d", table.ravel()), self.tilts), child, parent


def _onward(poses: Array) -> float:
    """The share of its way, with these poses, (n, 3), that a robot drives ahead; -1 for back."""
    x, y = np.diff(poses[:, :2], axis=0).T
    middle = (np.unwrap(poses[:, 2])[1:] + np.unwrap(poses[:, 2])[:-1]) / 2
    return float((x * np.cos(middle) + y * np.sin(middle)).sum() / max(np.hypot(x, y).sum(), 1e-9))


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
                    edge = record_transform(frames, child, parent, transform, is_static)
                except Damaged as damage:
                    damaged.append(Damage(number, f"{connection.topic}: {child}: {damage}"))
                    continue
                if edge.track is not None and (
                    edge.count == 1
                    or "odom" in child.rpartition("/")[2]
                    or any(child in ancestors(frames, same_frame(frames, one)) for one in seen)
                ):
                    flat = flat_pose(transform.translation, transform.rotation)
                    edge.track.add(stamp_of(stamped.header), recorded, flat, transform.rotation)
    return frames


def record_transform(
    frames: Frames, child: str, parent: str, transform: Any, is_static: bool
) -> FrameTransform:
    """Record a message with the transform from a parent frame to a child frame. Raises Damaged."""
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


def same_frame(frames: Frames, name: str, beside: str = "") -> str:
    """Return the name that transforms use for a frame, such as tb1/laser for laser, or the name.

    A prefix is added, removed or changed if the transforms do not know the name, and only one of
    their frames has this name without its prefix, or with the prefix of the frame `beside` it.
    """
    known = _known(frames)
    same = [one for one in known if one.rpartition("/")[2] == name.rpartition("/")[2]]
    if len(same) > 1:
        same = [one for one in same if one.rpartition("/")[0] == beside.rpartition("/")[0]]
    return same[0] if len(same) == 1 and name not in known else name


def _known(frames: Frames) -> set[str]:
    """The names of all frames that the transforms know."""
    return {*frames, *(parent for parents in frames.values() for parent in parents)}


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


def mount_of(frames: Frames, odom: str, base: str, frame: str, notes: list[str]) -> Mount | None:
    """Return where the laser is on the robot, with its tilt; None if no transform leads there.

    `notes` receives notes on transforms that contradict each other.
    """
    if base == frame:
        return Mount()
    names = {name: same_frame(frames, name, base) for name in (odom, base, frame)}
    if renamed := [f"{name} is {same}" for name, same in names.items() if name != same]:
        notes.append(
            "The names of frames differ by a prefix (tf_prefix). In the transforms, "
            f"{' and '.join(renamed)}."
        )
    odom, base, frame = names.values() if len(names) == 3 else (odom, base, frame)
    chain = ancestors(frames, frame)
    parents = [parent_of(frames, child).parent for child in chain]
    # If no transform leads to the robot's frame, the child of the odometry's frame is the robot.
    top = parents.index(odom) - 1 if odom in parents else None
    top = parents.index(base) if base in parents else top
    if top is None:
        return None
    translation, rotation = np.zeros(3), np.eye(3)
    for child in reversed(chain[: top + 1]):
        edge = parent_of(frames, child)
        translation = translation + rotation @ edge.translation
        rotation = rotation @ edge.rotation
        if max(edge.off) > FIXED:
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
    rows = tuple(tuple(map(float, row)) for row in rotation)
    return Mount((x, y, angle), bool(rotation[2, 2] < 0), rows, float(translation[2]))


def describe_unmounted(frames: Frames, base: str, unknown: Sequence[str]) -> str:
    """Say in a note that the place of lasers with some frames on the robot is assumed."""
    tails = tuple(frame.rpartition("/")[2] for frame in unknown)
    like = sorted(name for name in _known(frames) if name.endswith(tails) and name not in unknown)
    return (
        f"No transform leads from the robot ({base or 'a frame without a name'}) to its laser "
        f"({first_few(unknown, 3)}): the laser is taken to sit in the robot's middle and to look "
        "ahead. If it does not, say where it sits: --set mount=X,Y,DEGREES."
        + (f" The transforms know {first_few(like, 3)}." if like else "")
    )


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
