"""Doubts about the returns of a map: may the robot be at another place than the map says?"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TypeAlias

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.solver import solve
from ssh_abduction.theory.theory import Theory

# Two steps that are at one place in the map, or by the causal theory at one dstate.
Doubt: TypeAlias = tuple[int, int]


class ReturnDoubts:
    """The returns of minimal maps that are in doubt.

    A return is in doubt while some map without it has at most `margin` dstates more than the
    minimal maps.

    Args:
        margin: See above; with 0 no return is doubted.
        time_limit: Seconds for weighing one doubt; None waits for exact answers.

    Attributes:
        undecided: Doubts that could not be weighed in time.
        twins: For some doubts, a map without the return that no experiment can tell from
            the minimal map.
    """

    def __init__(self, margin: int, time_limit: float | None) -> None:
        self.undecided: set[Doubt] = set()
        self.twins: dict[Doubt, SSHMap] = {}
        self._margin, self._time_limit = margin, time_limit
        self._least: dict[Doubt, int] = {}  # lower bound of the dstates of a map without the return

    def open(self, ssh_map: SSHMap, trace: Trace) -> Iterator[Doubt]:
        """The returns of a map that are in doubt, the latest first: least is known of these."""
        if not self._margin:
            return
        at = [ssh_map.dstates[label].place if ssh_map.places else label for label in ssh_map.labels]
        # The robot comes to a place by a travel, and to a dstate by any action.
        moves = [
            t
            for t, action in enumerate(trace.actions, 1)
            if not ssh_map.places or action.kind == "travel"
        ]
        comes = [0, *moves]
        first: dict[int | None, int] = {}
        for t in comes:
            first.setdefault(at[t], t)
        enough = len(ssh_map.dstates) + self._margin
        for t in reversed(comes):
            doubt = (first[at[t]], t)
            if first[at[t]] != t and self._least.get(doubt, 0) <= enough:
                yield doubt

    def rival(self, doubt: Doubt, trace: Trace, theory: Theory, dstates: int) -> SSHMap | None:
        """The best map without a return; None if it has too many dstates, or was not found in time.

        Args:
            doubt: The return.
            trace: The steps so far.
            theory: The theory without `auto`.
            dstates: How many dstates a minimal map has.
        """
        kind = "different" if theory.level == "causal" else "elsewhere"
        denied = theory.replace(**{kind: (*getattr(theory, kind), doubt)})
        found = solve(trace, denied, max_maps=1, time_limit=self._time_limit)
        if found.maps and len(found.maps[0].dstates) <= dstates + self._margin:
            return found.maps[0]
        proven = not found.stopped or found.stopped == "maps limit"
        if not proven and (found.bound.dstates or 0) <= dstates + self._margin:
            self.undecided.add(doubt)
        self.dispel(doubt, dstates)
        return None

    def dispel(self, doubt: Doubt, dstates: int) -> None:
        """Stop doubting a return until minimal maps have more than `dstates` dstates."""
        self._least[doubt] = dstates + self._margin + 1

    def reopen(self) -> None:
        """Weigh again what was undecided or had a twin, as more was seen."""
        for doubt in (*self.twins, *self.undecided):
            self._least.pop(doubt, None)
        self.undecided, self.twins = set(), {}
