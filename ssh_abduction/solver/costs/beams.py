"""Guess maps of little cost by beams of hypotheses, narrow beams first (`sources/metric/beam.py`).

Before that, places are merged at poses that fit all closures (`sources/metric/overlay.py`). After a
long way this is better than a beam, which goes through the trace once. The places of the best map
of a broad beam are merged in the same way.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.solver.asp.limits import StageTimeError
from ssh_abduction.solver.candidates import SKETCH_SHARE
from ssh_abduction.solver.costs.scatter import is_for
from ssh_abduction.solver.parts import Parts
from ssh_abduction.solver.solution.weighed import EQUAL
from ssh_abduction.solver.sources.metric.beam import Beam

# The widths of the beams, and the share of the time after which each of them ends. The beam without
# axioms ends at the share BREAKING.
WIDTHS, BREAKING = {1: 0.7, 4: 0.6, 16: 0.7}, 0.8
# If displacements may be wrong, all beams end at the share JUMPED. Then the best map is often one
# that they drop, and `wrong_displacements.py` looks for it.
JUMPED = 0.4
# In logs of robots, smoothing has mostly found the best map, and the bound needs more of the time:
# all beams end at the share BOUNDED.
BOUNDED = 0.5
# Joining the maps of drives ends after the share JOINING, and smoothing after the share SMOOTHING.
JOINING, SMOOTHING = 0.5, 0.3
# A beam of this width or more nearly always ends with the map of least cost.
BROAD = 4


@dataclass(frozen=True, slots=True)
class _Time:
    """The time limit of all beams: the clock when they began, and the seconds (or inf)."""

    begun: float
    seconds: float

    def end(self, share: float) -> float:
        """Return the clock time in seconds at which a share of the limit is used up."""
        return self.begun + share * self.seconds


class Beams:
    """The beams of one search, and what they say about the best map.

    Attributes:
        broken: How many nats the best map that breaks axioms costs less than the best map, as in
            `Weighed`; 0 if it does not cost less, -inf if no such map was sought.
    """

    def __init__(
        self, parts: Parts, add: Callable[[SSHMap], float], keep_best: Callable[[], None]
    ) -> None:
        """Prepare the beam searches.

        `add` returns the cost of a map in nats, and keeps the map if this cost is small.
        `keep_best` makes the cheapest known map the best map of the search.
        """
        self._parts, self._add, self._keep_best = parts, add, keep_best
        # The cost of the best map of smoothing or a broad beam, and the estimate of it by a beam.
        self._best = math.inf, math.inf
        self.broken = -math.inf
        self._ended = 0  # the width of the widest beam that ended

    def found(self, nats: float) -> bool:
        """Whether a broad beam ended with a map of this cost, and `broken` is known.

        Joining the maps of drives, which broad beams find, counts as a broad beam.
        If displacements may be wrong, this is False: after a wrong one the pose is unknown, so the
        beam often drops the map of least cost.
        """
        is_sound = math.isfinite(self.broken) and not self._parts.task.theory.jumped
        return is_sound and self._best[0] <= nats + EQUAL

    def search(self, clashes: Callable[[], bool]) -> bool:
        """Search by beams of growing width, as far as there is time.

        If the first beam finds no map, `clashes` returns whether a short proof shows that the trace
        has none. Returns whether the trace may have a map.
        """
        watch = self._parts.watch
        time = _Time(watch.elapsed(), watch.left())
        if time.seconds > 0:
            self._parts.candidates.sketch(SKETCH_SHARE * time.seconds)
            self._keep_best()
        may_have_map = self._search_widths(time, clashes)
        # If `broken` is unknown, find it with the widest beam that ended.
        is_open = may_have_map and self._best[1] < math.inf and math.isinf(self.broken)
        with suppress(StageTimeError), watch.stage(time.end(BREAKING)):
            if is_open and (beam := self._parts.candidates.beam(self._ended)):
                self.broken = self._best[1] - beam.nats_without_axioms()
        return may_have_map

    def _search_widths(self, time: _Time, clashes: Callable[[], bool]) -> bool:
        """Search with beams of each width in WIDTHS, while there is time. Returns as `search`."""
        parts, watch = self._parts, self._parts.watch
        # With several drives or floors, a broad beam keeps as many hypotheses as a wider one.
        theory = parts.task.theory
        several = theory.several_drives or theory.lifts
        most = JUMPED if theory.jumped else BOUNDED if is_for(parts.task.problem) else 1.0
        shares = {width: min(end, most) for width, end in WIDTHS.items()}
        widths = [width for width in WIDTHS if width <= BROAD or not several]
        with suppress(StageTimeError), watch.stage(time.end(SMOOTHING)):
            if (smoothed := parts.candidates.smoothed()) is not None:
                self._best = self._add(smoothed), math.inf
        self._keep_best()
        if several and (joining := parts.candidates.joining()) is not None:
            with suppress(StageTimeError), watch.stage(time.end(JOINING)):
                nats = min(map(self._add, parts.candidates.maps_of(joining)), default=math.inf)
                self._take(nats, -math.inf, joining.broken)
            self._keep_best()
            parts.report()
        first = math.inf  # the time of the first beam
        for width in widths:
            began, last = watch.elapsed(), widths[-1]
            # A beam of width n takes about n times as long as the first one.
            slack = time.end(shares[last]) - began - last * first
            if width < last and 0 < slack < width * first:
                continue  # there is time for the last one, but not for both
            if (beam := parts.candidates.beam(width)) is None:
                break
            if not self._ends(beam, width, time.end(shares[width])) and not self._ended:
                parts.candidates.go_on(beam)
            self._keep_best()
            parts.report()
            if first == math.inf:
                if parts.known.best is None and clashes():
                    return False
                first = watch.elapsed() - began
        return True

    def _ends(self, beam: Beam, width: int, end: float) -> bool:
        """Keep the maps that a beam ends with. Return whether it ended by `end` on the clock."""
        watch, found = self._parts.watch, dict[float, SSHMap]()
        try:
            with watch.stage(end):
                found |= {self._add(one): one for one in self._parts.candidates.maps_of(beam)}
        except StageTimeError:
            return False
        self._ended = width
        if width >= BROAD:
            with suppress(StageTimeError), watch.stage(end):
                best = found[min(found)] if found else None
                if best and (merged := self._parts.candidates.smoothed(best)) is not None:
                    found[self._add(merged)] = merged
            # A beam without axioms would be the same if the checker refused nothing.
            broken = -math.inf if beam.refuses else 0.0
            estimate = beam.hypotheses[0].nats if beam.hypotheses else math.inf
            self._take(min(found, default=math.inf), estimate, broken)
        return True

    def _take(self, nats: float, estimate: float, broken: float) -> None:
        """Keep what a broad beam, or joining the maps of drives, says about its best map."""
        if (nats, estimate) <= self._best:
            self._best, self.broken = (nats, estimate), broken
        elif nats < math.inf == self._best[1]:  # the smoothed map costs less
            saved = nats - self._best[0]
            self._best, self.broken = (self._best[0], estimate - saved), broken
