"""Keep minimal maps by replaying them, as long as they predict what the robot sees.

To replay a map is to follow its links along the steps of the trace.
"""

from __future__ import annotations

from collections.abc import Iterable

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Action, Trace
from ssh_abduction.online.hypotheses import ExtendedMap
from ssh_abduction.solver import Cost, Judging, Status, observation
from ssh_abduction.theory.pairs import Pairs
from ssh_abduction.theory.speedups import row
from ssh_abduction.theory.theory import Theory


class MinimalMaps:
    """The minimal maps of the steps so far, with how much is proven about them."""

    def __init__(self, trace: Trace, theory: Theory, judging: Judging) -> None:
        # The minimal maps. If `replays` is false, the maps that clingo found last, which may not be
        # proven minimal.
        self.maps: list[ExtendedMap] = []
        self.status = Status.UNKNOWN  # UNKNOWN until clingo has proven which maps are minimal
        self.complete = False  # whether `maps` are all minimal maps
        self.cost: Cost | None = None  # the counts of a minimal map; None if they are unknown
        # Whether the claim in `mapper.py` holds for the theory, so that maps are replayed.
        self.replays = row("prefixes").holds_for(theory)
        self._trace, self._theory, self._judging = trace, theory, judging

    def follow(self, action: Action, trace: Trace, pairs: Pairs) -> list[ExtendedMap]:
        """Keep the maps that predict the last step. If none does, reset the status to UNKNOWN.

        `trace` has this step, and `action` led to it. If no map is kept, return the maps
        that have no link for the action, else an empty list.
        """
        self._trace, seen = trace, observation(trace.steps[-1], self._theory)
        untried = [m for m in self.maps if m.is_unknown(action.name)]
        longer = (m.predicting(action.name, seen) for m in self.maps)
        self.maps = [m for m in longer if m and m.is_allowed(trace, pairs, self._judging)]
        # A map without a link for the action may be extended to further minimal maps.
        self.complete = self.complete and not untried
        if not self.replays:
            self.maps = []
        if self.maps:
            return []
        self.status, self.complete = Status.UNKNOWN, False
        return untried

    def replace(
        self, found: Iterable[SSHMap], status: Status, complete: bool, cost: Cost | None
    ) -> None:
        """Take the result of a search. Keep the known minimal maps if the search listed fewer.

        `complete` says whether these are all minimal maps. `cost` has the counts of a minimal map,
        if there is one.
        """
        maps, was_proven = list(found), self.status is Status.OPTIMAL
        self.status, self.complete, self.cost = status, complete, cost
        if len(maps) >= len(self.maps) or not was_proven:
            self.maps = [ExtendedMap.of(m, self._trace, self._theory) for m in maps]

    def is_settled(self, max_maps: int | None) -> bool:
        """Whether another search would find nothing new, if at most `max_maps` are kept."""
        return self.status is Status.OPTIMAL and (self.complete or len(self.maps) == max_maps)

    @property
    def is_impossible(self) -> bool:
        """Whether it is proven that these steps have no map, however the trace goes on."""
        return self.status is Status.UNSATISFIABLE and self.replays
