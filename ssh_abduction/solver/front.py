"""The front of faults: the fewest dstates that explain a trace, for each number of faults.

Even if the trace is wrong, the causal theory has a map without faults. It needs many dstates. With
many faults, few dstates are enough. The truth is mostly at the *knee*: the number of faults at
which the number of dstates stops falling fast. A weighted sum of both numbers hides the knee.

>>> from ssh_abduction import Trace
>>> from ssh_abduction.solver.front import fault_front
>>> seen = [f"v{t % 4}" if t != 9 else "v0" for t in range(25)]
>>> front = fault_front(Trace.from_steps(seen, ["right", "travel"] * 12), most=2)
>>> [point.dstates for point in front.points], front.knee, front.prices
([13, 4, 4], 1, (0.0, 9.0))
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from ssh_abduction.data.errors import TheoryError, brief, is_whole
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace, checked_trace
from ssh_abduction.runtime.clock import each_heeding
from ssh_abduction.solver.asp.limits import LimitError, Watch, check_limit
from ssh_abduction.solver.sources.exact.engine import Task
from ssh_abduction.solver.values import Found
from ssh_abduction.theory.settle import settle
from ssh_abduction.theory.theory import Theory, checked_theory

# If the theory allows no faults, allow both kinds. Their costs do not matter for a front.
KINDS = {"misread": 1.5, "slipped": 1.5}


@dataclass(frozen=True)
class Point:
    """The fewest dstates of a map that may have some number of faults.

    Attributes:
        faults: The number of faults that a map may have.
        dstates: The fewest dstates of such a map if proven, else a lower bound.
        map: The best map found; None if none was found in time.
        proven: Whether `dstates` is proven to be the minimum.
    """

    faults: int
    dstates: int
    map: SSHMap | None
    proven: bool


@dataclass(frozen=True)
class Front:
    """The points for 0, 1, 2, … faults, as far as they were computed in time.

    A number of faults has no point if the assertions of the theory allow no map with so few faults.

    Attributes:
        points: The points, those for fewer faults first.
        stopped: Whether a time limit or Ctrl-C ended the search.
    """

    points: tuple[Point, ...]
    stopped: bool = False

    @property
    def knee(self) -> int | None:
        """The number of faults at which the number of dstates stops falling fast.

        The fall to a point is how many dstates it saves over the point with one fault less. The
        knee is the point whose fall exceeds the next fall by most. Only proven points count. None
        if no fall exceeds the next one.
        """
        counts = self._proven
        bends = {
            k: (counts[k - 1] - counts[k]) - (counts[k] - counts[k + 1])
            for k in counts
            if k - 1 in counts and k + 1 in counts
        }
        knee = max(bends, key=lambda k: bends[k], default=None)
        return knee if knee is not None and bends[knee] > 0 else None

    @property
    def prices(self) -> tuple[float, float] | None:
        """The range (low, high) of the cost of a fault in which the map at the knee costs least.

        Costs are in dstates. None if there is no such cost, or no knee.
        """
        if self.knee is None:
            return None
        counts = self._proven
        here = counts[self.knee]
        least = max(
            (here - count) / (k - self.knee) for k, count in counts.items() if k > self.knee
        )
        most = min((count - here) / (self.knee - k) for k, count in counts.items() if k < self.knee)
        return (least, most) if least < most else None

    @property
    def _proven(self) -> dict[int, int]:
        """The number of dstates of each proven point, by number of faults."""
        return {point.faults: point.dstates for point in self.points if point.proven}


def fault_front(
    trace: Trace, theory: Theory | None = None, most: int = 5, time_limit: float | None = None
) -> Front:
    """Find the fewest dstates for at most 0, 1, …, `most` faults.

    Args:
        trace: The views and actions to explain.
        theory: Theory.causal() by default. A theory without costs of faults allows both kinds:
            wrong views and wrong actions.
        most: The greatest number of faults, 0 to 1000.
        time_limit: Seconds in all; None for no limit.

    Returns:
        A point for each number of faults that was reached in time.

    Raises:
        TheoryError: The theory is not the plain causal one, it allows wrong displacements, or it
            names steps that the trace does not have; or `most` is out of range.
    """
    theory = Theory.causal() if theory is None else checked_theory(theory)
    check_limit("time_limit", "seconds", time_limit)
    if theory.jumped:
        raise TheoryError(
            "jumped: expected 0 to find the front (the fewest dstates for each number of faults), "
            "which allows no wrong displacements; leave jumped out (--set jumped=0)"
        )
    if theory.level != "causal":
        raise TheoryError(
            "theory: expected a causal theory, as the front (the fewest dstates for each number of "
            "faults) has no places, got a topological one; take Theory.causal() (--theory causal)"
        )
    if theory.rules or theory.without or theory.prefer not in (("dstates",), ("auto",)):
        raise TheoryError(
            "theory: expected the causal axioms alone, fewest dstates first, to find the front "
            "(the fewest dstates for each number of faults); leave out the rules and the settings "
            "without and prefer"
        )
    if not is_whole(most) or not 0 <= most <= 1000:
        raise TheoryError(
            f"front: expected a number of faults from 0 to 1000, got {brief(most)}"
            "; take one in this range"
        )
    theory.check_steps(checked_trace(trace))
    problem = settle(trace, theory if theory.has_faults else theory.replace(**KINDS))
    watch = Watch(time_limit)
    watch.start()
    points = tuple(each_heeding(watch.check, _points(Task.of(problem, watch), most)))
    return Front(points, stopped=any(not point.proven for point in points))


def _points(task: Task, most: int) -> Iterator[Point]:
    """Yield the points for 0 to `most` faults. The first point that is not proven ends them."""
    from ssh_abduction.solver.sources.exact.faulty import FaultyEngine  # loads numpy

    before: SSHMap | None = None
    for faults in range(most + 1):
        engine = FaultyEngine(task, faults)
        best: Found | None = None
        try:
            engine.grow(len(task.trace))
            for found in engine.improving_maps():
                best = found
        except (LimitError, KeyboardInterrupt):
            yield Point(
                faults,
                -(-(engine.bound or 10) // 10),
                None if best is None else best.map,
                proven=False,
            )
            return
        if best is None:  # the assertions allow no map with so few faults
            continue
        if before is None or len(best.map.dstates) < len(before.dstates):
            before = best.map  # repeats a map that needs fewer faults
        yield Point(faults, len(before.dstates), before, proven=True)
