"""Doubt the returns of a map: is the robot really back at the place that the map says?

A return is two steps that a map puts at one place or dstate.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TypeAlias

from ssh_abduction.data.groups import firsts
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.solver import solve
from ssh_abduction.theory.theory import Theory

# Two steps that the map has at one place, or by the causal theory at one dstate (distinctive
# state: a place and a heading).
Doubt: TypeAlias = tuple[int, int]


class ReturnDoubts:
    """Keeps track of the returns of minimal maps that are in doubt.

    A return is in doubt while some map without it has at most `margin` dstates more than the
    minimal maps; 0 doubts no return. `time_limit` is in seconds, for finding a map without one
    return; None waits for the exact answer.
    """

    def __init__(self, margin: int, time_limit: float | None) -> None:
        self.undecided: set[Doubt] = set()  # returns for which there was too little time to decide
        # The returns that no experiment can test, each with a map without the return that always
        # predicts the same as the minimal map. The caller adds them.
        self.twins: dict[Doubt, SSHMap] = {}
        self._margin, self._time_limit = margin, time_limit
        self._least: dict[Doubt, int] = {}  # lower bound of the dstates of a map without the return

    def in_doubt(self, ssh_map: SSHMap, trace: Trace) -> Iterator[Doubt]:
        """Yield the doubtful returns of a minimal map, the latest first."""
        if not self._margin:
            return
        at = [
            ssh_map.dstates[label].place if ssh_map.places else label for label in ssh_map.dstate_at
        ]
        # A travel brings the robot to a place. Any action brings it to a dstate.
        moves = [
            t
            for t, action in enumerate(trace.actions, 1)
            if not ssh_map.places or action.kind == "travel"
        ]
        comes = [0, *moves]
        first = firsts((at[t], t) for t in comes)
        enough = len(ssh_map.dstates) + self._margin
        for t in reversed(comes):
            doubt = (first[at[t]], t)
            if first[at[t]] != t and self._least.get(doubt, 0) <= enough:
                yield doubt

    def rival(self, doubt: Doubt, trace: Trace, theory: Theory, dstates: int) -> SSHMap | None:
        """Find the best map without a return. Stop doubting the return if there is none.

        `dstates` is the number of dstates of a minimal map. A map counts if it has at most `margin`
        dstates more, and is found in time. Otherwise return None. In the theory no field is "auto".
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
        """Stop doubting a return as long as the minimal maps have at most `dstates` dstates."""
        self._least[doubt] = dstates + self._margin + 1

    def reopen(self) -> None:
        """Doubt all returns in `undecided` and `twins` again, because the robot has seen more."""
        for doubt in (*self.twins, *self.undecided):
            self._least.pop(doubt, None)
        self.undecided, self.twins = set(), {}
