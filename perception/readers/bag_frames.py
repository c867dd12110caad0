"""Reads the transforms between the frames of a robot from a bag."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from perception.readers.bag_topics import NANO, TRANSFORMS, Bag
from perception.readers.messages import Damaged
from perception.readers.poses import RecordedTrack
from perception.readers.scans import Damage
from ssh_abduction.data.odometry import Pose, displacement_between

# Largest difference of the messages of a fixed transform, from rounding: metres and radians.
FIXED = (0.01, 0.01)


@dataclass
class FrameTransform:
    """The transform from a parent frame to a frame: the pose of the frame in its parent."""

    parent: str  # name of the parent frame
    translation: NDArray[np.float64]  # (3,) translation in the last message, in metres
    rotation: NDArray[np.float64]  # (3, 3) rotation in the last message
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
        edge.rotation = _rotation(turn)
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


def _rotation(q: Any) -> NDArray[np.float64]:
    """The rotation matrix of a quaternion, (3, 3)."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix(), dtype=np.float64)


def stamp_of(header: Any) -> float:
    """Return the time in a header in seconds; 0 means that the header has none."""
    return float(header.stamp.sec + header.stamp.nanosec * NANO)


def frame_name(frame: str) -> str:
    """Return the name of a frame without the slash at the beginning that ROS 1 allows."""
    return frame.lstrip("/")
