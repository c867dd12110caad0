"""Poses over time, of which each has two times: that of its header, and that at which it was recorded.

Which of the two clocks can be used, and whose poses they are where two programs publish at once, is told from the messages themselves.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.data.odometry import Pose

Array = NDArray[np.float64]

# Odometry that ends, or begins, so many seconds beside a scan still tells where the scan was taken.
BESIDE = 1.0
# Clocks that differ by more seconds are different clocks.
SAME_CLOCK = 1.0
# Clocks are compared once in so many seconds, and at most so many times in a drive: a message may be late by itself.
COMPARED, TIMES = 2.0, 100
# Poses are those of several sources if they change from one to another at such a share of the messages, and each source has such a share of them.
ALTERNATING = 0.1
# At most so many sources are told apart.
SOURCES = 4


@dataclass
class Track:
    """Poses over time, which come one after another. A stamp is the time of a header, 0 where there is none."""

    numbers: array[float] = field(default_factory=lambda: array("d"))

    def add(self, stamp: float, recorded: float, pose: Pose) -> None:
        self.numbers.extend((stamp, recorded, *pose))

    def table(self) -> Array:
        """(n, 5): stamp, time of recording, and the pose."""
        return np.frombuffer(self.numbers, dtype=np.float64).reshape(-1, 5)


@dataclass(frozen=True)
class Poses:
    """Poses over time, (n,) and (n, 3), in the order of time and with headings that do not jump."""

    times: Array
    poses: Array

    @classmethod
    def of(cls, track: Track, by_stamp: bool) -> Poses:
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


def clock_of(topics: Mapping[str, Array]) -> tuple[bool, tuple[str, ...]]:
    """Which times can be used: those of the headers, unless they contradict themselves or each other and those of recording do not.

    Args:
        topics: By what they are called, the stamps and the times of recording of the messages, (n, 2) in seconds, in the order of the bag.

    Returns:
        Whether the times of the headers are to be used, and what is to be said of the clocks.
    """
    wrong = [text for name, times in topics.items() if (text := _wrong_stamps(name, times[:, 0]))]
    held = [
        text
        for name, times in topics.items()
        if (text := _wrong_recording(name, times, bool(wrong)))
    ]
    if not held and not wrong:
        wrong = _apart(topics)
    if not wrong and not held:
        return True, ()
    if not wrong:
        return True, (
            f"The times of recording are of no use: {'; '.join(held)}. The times in the headers are used.",
        )
    said = f"The times in the headers contradict themselves: {'; '.join(wrong)}."
    if held:
        return False, (
            f"{said} The times of recording are no better: {'; '.join(held)}. They are used, but what is made of them may be wrong.",
        )
    return False, (f"{said} The times of recording are used.",)


def _wrong_stamps(name: str, stamps: Array) -> str | None:
    """What is wrong with the stamps of one topic, in themselves."""
    none = int((stamps == 0).sum())
    if none == len(stamps) or none > 2:  # a simulated clock may begin at 0
        return f"{none} of {len(stamps)} messages of {name} have none"
    if len(stamps) > 1 and np.ptp(stamps) == 0:
        return f"those of {name} are the same in all {len(stamps)} messages"
    back = np.diff(stamps)
    if len(back) and back.min() < -SAME_CLOCK:
        return f"those of {name} run back by {-back.min():.1f} s, {int((back < -SAME_CLOCK).sum())} times in {len(stamps)} messages"
    return None


def _wrong_recording(name: str, times: Array, stamps_are_wrong: bool) -> str | None:
    """What is wrong with the times at which the messages of one topic were recorded: they are held, while those of the headers go on."""
    stamps, recorded = times.T
    if len(times) < 3:
        return None
    if np.ptp(recorded) == 0 and (stamps_are_wrong or np.ptp(stamps) > SAME_CLOCK):
        return f"the {len(times)} messages of {name} were all recorded at one time"
    groups = np.flatnonzero(np.concatenate([[True], np.diff(recorded) > 1e-3]))
    spans = np.maximum.reduceat(stamps, groups) - np.minimum.reduceat(stamps, groups)
    late = (spans > SAME_CLOCK) & (spans < np.ptp(recorded) + SAME_CLOCK)
    sizes = np.diff([*groups, len(times)])
    if sizes[late].sum() > len(times) / 2:
        return f"{sizes[late].sum()} of {len(times)} messages of {name} were recorded in {late.sum()} bursts, each of up to {spans[late].max():.1f} s of the drive"
    return None


def _apart(topics: Mapping[str, Array]) -> list[str]:
    """What is to be said of topics whose clocks part from that of the first one, or never were the same."""
    begin = min(times[:, 1].min() for times in topics.values())
    every = max(COMPARED, (max(times[:, 1].max() for times in topics.values()) - begin) / TIMES)
    (first, reference), *others = (
        (name, _ahead(times, begin, every)) for name, times in topics.items()
    )
    said = []
    for name, (when, ahead) in others:
        off = ahead - np.interp(when, *reference)
        worst = int(np.abs(off).argmax())
        if abs(off[worst]) > SAME_CLOCK:
            since = when[int(np.argmax(np.abs(off) > SAME_CLOCK))]
            said.append(
                f"beside those of {first}, those of {name} are {off[0]:+.1f} s off at first and {off[-1]:+.1f} s at last, at most {off[worst]:+.1f} s, and more than {SAME_CLOCK:g} s from {since:.0f} s on"
            )
    return said


def _ahead(times: Array, begin: float, every: float) -> tuple[Array, Array]:
    """By how many seconds stamps are ahead of recording, once in so many seconds: when, (k,), and the median of each, (k,)."""
    recorded = times[:, 1] - begin
    ahead = times[:, 0] - times[:, 1]
    part = (recorded / every).astype(int)
    parts = np.unique(part)
    return np.array([recorded[part == k].mean() for k in parts]), np.array(
        [np.median(ahead[part == k]) for k in parts]
    )


def sources_of(track: Track) -> list[NDArray[np.intp]]:
    """The messages of each source, where several alternate, as where two programs publish one transform; one source where none do.

    Each message is put behind the one before it that is nearest, and is the first of another source where none is near.
    """
    poses = track.table()[:, 2:]
    if len(poses) < 10:
        return [np.arange(len(poses))]
    over = np.abs(poses[2:] - poses[:-2])
    # A quarter of these steps at least is within one source, even where two come at random.
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
    if len(many) < 2 or changes < ALTERNATING * len(poses):
        return [np.arange(len(poses))]
    return sorted(many, key=len, reverse=True)
