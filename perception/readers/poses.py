"""Poses over time in a bag.

A message has two times: a stamp in its header, and the time of recording. This module chooses the
clock that is usable. It also finds out if two programs published different poses at once.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from perception.readers.scans import Array
from ssh_abduction.data.odometry import Pose

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


def sources_of(track: RecordedTrack) -> list[NDArray[np.intp]]:
    """Separate the poses of sources that alternate, such as two programs with the same transform.

    Each pose is given to the source whose last pose is nearest. If no source is near, the pose
    starts a new source. The source with the most poses comes first. If poses do not alternate, all
    are of one source.
    """
    poses = track.table()[:, 2:]
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
