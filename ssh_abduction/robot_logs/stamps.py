"""Pairs the scans of a laser with the poses of an odometer by their times.

>>> from ssh_abduction.robot_logs.stamps import StampPairing
>>> pairing = StampPairing()
>>> pairing.add_pose(0.0, (0.0, 0.0, 0.0))
>>> pairing.add_scan(0.5, "scan")
>>> list(pairing.ready())  # the pose after the scan has not come yet
[]
>>> pairing.add_pose(1.0, (2.0, 0.0, 0.0))
>>> list(pairing.ready())
[(0.5, 'scan', (1.0, 0.0, 0.0))]
"""

from __future__ import annotations

import math
from bisect import bisect
from collections import Counter, deque
from collections.abc import Callable, Iterator
from typing import Any

from ssh_abduction.data.odometry import Pose

# The largest numbers of scans and poses that wait.
MOST_SCANS, MOST_POSES = 2000, 20_000
# A clock that goes back by more than this many seconds has started anew.
BACK = 1.0
# A pose is not interpolated between two poses that are more than this many seconds apart.
GAP = 1.0


class StampPairing:
    """Scans wait for poses on both sides of their time. Their pose is interpolated.

    A scan is lost if poses are missing around its time.

    Attributes:
        lost: How many scans were lost, by the reason.
        restarts: How often the clock went back.
    """

    def __init__(self) -> None:
        self.lost: Counter[str] = Counter()
        self.restarts = 0
        self._scans: deque[tuple[float, Any]] = deque()
        # Scans that went back: of a clock that started anew before its first pose, or just late.
        self._early: deque[tuple[float, Any]] = deque()
        self._times: list[float] = []
        self._poses: list[Pose] = []
        self._last, self._went_back = -math.inf, False

    def add_pose(self, time: float, pose: Pose) -> None:
        """Add a pose at a time in seconds. A pose that comes late is dropped."""
        if self._times and time <= self._times[-1]:
            if self._times[-1] - time <= BACK:
                return
            self.restarts += 1
            self._drop_waiting()
            self._times, self._poses, self._went_back = [], [], not self._early
            if self._early:
                self._scans, self._early = self._early, self._scans
                self._last = self._scans[-1][0]
        self._times.append(time)
        self._poses.append(pose)
        if len(self._times) > MOST_POSES:
            del self._times[: MOST_POSES // 2], self._poses[: MOST_POSES // 2]

    def add_scan(self, time: float, scan: Any) -> None:
        """Add a scan at a time in seconds."""
        if self._went_back and time < self._last - BACK:
            # Scans by the clock before may have come after the first pose by the new one.
            self._drop_waiting()
            self._last, self._went_back = -math.inf, False
        waiting, last = self._scans, self._last
        if time < last - BACK or (self._early and self._early[-1][0] < time <= last):
            waiting = self._early
            last = waiting[-1][0] if waiting else -math.inf
        if time <= last:
            self.lost["doubled" if time == last else "out of order"] += 1
            return
        if waiting is self._scans:
            self._last = time
            if self._early:  # The clock goes on, so they were just late.
                self.lost["out of order"] += len(self._early)
                self._early.clear()
        waiting.append((time, scan))
        if len(waiting) > MOST_SCANS:
            waiting.popleft()
            self.lost["too many"] += 1

    def _drop_waiting(self) -> None:
        self.lost += Counter({"no odometry": len(self._scans)})
        self._scans.clear()

    def ready(
        self, may_go: Callable[[Any], bool] = lambda _: True
    ) -> Iterator[tuple[float, Any, Pose]]:
        """Yield the scans whose poses are known: the time, the scan and its pose.

        All scans wait while the first one may not go.
        """
        while self._scans and self._times and self._scans[0][0] <= self._times[-1]:
            if not may_go(self._scans[0][1]):
                break
            time, scan = self._scans.popleft()
            k = bisect(self._times, time)
            if k == 0 or (time > self._times[k - 1] and self._times[k] - self._times[k - 1] > GAP):
                self.lost["no odometry"] += 1
            else:
                yield time, scan, self._at(k - 1, time)

    def _at(self, k: int, time: float) -> Pose:
        """The pose at a time that is not before pose k."""
        if self._times[k] == time:
            return self._poses[k]
        a, b = self._poses[k], self._poses[k + 1]
        share = (time - self._times[k]) / (self._times[k + 1] - self._times[k])
        turn = math.remainder(b[2] - a[2], math.tau)
        return a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1]), a[2] + share * turn
