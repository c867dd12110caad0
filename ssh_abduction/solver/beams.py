"""Guess maps of little cost by beams of hypotheses, narrow beams first (`guesses/beam.py`)."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.solver.asp.limits import StageTimeError
from ssh_abduction.solver.candidates import SKETCH_SHARE
from ssh_abduction.solver.guesses.beam import Beam
from ssh_abduction.solver.parts import Parts
from ssh_abduction.solver.weighed import EQUAL

# The widths of the beams, and the share of the time after which each of them ends. The beam without
# axioms ends at the share BREAKING.
WIDTHS, BREAKING = {1: 0.7, 4: 0.6, 16: 0.7}, 0.8
# A further beam of WIDER hypotheses takes about LONGER times as long as the widest of these. Search
# it only if all beams then take at most the share QUICK of the time, and MOST_SECONDS.
WIDER, QUICK, MOST_SECONDS, LONGER = 64, 0.3, 60.0, 5.0
# A beam of this width or more nearly always ends with the map of least cost.
BROAD = 4


class Beams:
    """The beams of one search, and what they say about the best map.

    Attributes:
        broken: By how many nats the best map that breaks axioms costs less than the best map, as in
            `Weighed`; 0 if it does not cost less, -inf if none was sought.
    """

    def __init__(
        self, parts: Parts, add: Callable[[SSHMap], float], keep_best: Callable[[], None]
    ) -> None:
        """Prepare the search by beams.

        Args:
            parts: The parts of the search.
            add: Computes the cost of a map in nats, and keeps the map if the cost is small.
            keep_best: Makes the map of least cost the best one of the search.
        """
        self._parts, self._add, self._keep_best = parts, add, keep_best
        # The cost of the best map of the last broad beam, and the estimate of it by the beam.
        self._best = math.inf, math.inf
        self.broken = -math.inf

    def found(self, nats: float) -> bool:
        """Whether a broad beam ended with a map of this cost, and `broken` is known.

        Args:
            nats: The cost of the best map.
        """
        return self._best[0] <= nats + EQUAL and math.isfinite(self.broken)

    def search(self, clashes: Callable[[], bool]) -> bool:
        """Search by beams of growing width, as far as there is time.

        Args:
            clashes: Called if the first beam finds no map: returns whether a short proof shows that
                the trace has none.

        Returns:
            Whether the trace may have a map.
        """
        parts, watch = self._parts, self._parts.watch
        begun, left = watch.elapsed(), watch.left()
        if left > 0:
            parts.candidates.sketch(SKETCH_SHARE * left, beams=False)
            self._keep_best()
        # With several drives or floors, a broad beam keeps as many hypotheses as a wider one.
        several = parts.task.theory.several_drives or parts.task.theory.lifts
        widths = {w: share for w, share in WIDTHS.items() if w <= BROAD or not several}
        # The greatest width, the width of the last beam that ended, and the seconds that the first
        # and the last beam took.
        widest, ended, first, last = max(widths), 0, math.inf, math.inf
        for width, share in widths.items():
            began = watch.elapsed()
            if width < widest and widest * first < widths[widest] * left - (began - begun):
                continue  # there is time for the widest beam, so leave this one out
            watch.end_stage_after(begun + share * left)
            if (beam := parts.candidates.beam(width)) is None:
                break
            if self._ends(beam, width):
                ended = width
            elif not ended:
                parts.candidates.go_on(beam)
            self._keep_best()
            parts.report()
            if first == math.inf and parts.known.best is None and clashes():
                watch.end_stage_after(math.inf)
                return False
            last = watch.elapsed() - began
            first = min(first, last)
        if ended == max(WIDTHS):
            self._search_wider(begun, min(QUICK * left, MOST_SECONDS), LONGER * last)
        watch.end_stage_after(begun + BREAKING * left)
        with suppress(StageTimeError):
            is_open = self._best[1] < math.inf and math.isinf(self.broken)
            if is_open and (beam := parts.candidates.beam(ended)):
                self.broken = self._best[1] - beam.nats_without_axioms()
        watch.end_stage_after(math.inf)
        return True

    def _search_wider(self, begun: float, seconds: float, needed: float) -> None:
        """Search by a beam of WIDER hypotheses, if there is time.

        Args:
            begun: The seconds on the clock when the first beam began.
            seconds: The time that all beams together may take.
            needed: The seconds that the beam probably takes.
        """
        watch = self._parts.watch
        if watch.elapsed() - begun + needed > seconds:
            return
        watch.end_stage_after(begun + seconds)
        if beam := self._parts.candidates.beam(WIDER):
            self._ends(beam, WIDER)
            self._keep_best()
            self._parts.report()

    def _ends(self, beam: Beam, width: int) -> bool:
        """Keep the maps that a beam ends with. Return whether it ended in time."""
        try:
            nats = [self._add(ssh_map) for ssh_map in self._parts.candidates.maps_of(beam)]
        except StageTimeError:
            return False
        if width >= BROAD:
            self._best = min(nats, default=math.inf), beam.nats
            # A beam without axioms would be the same if the checker refused nothing.
            self.broken = -math.inf if beam.refuses else 0.0
        return True
