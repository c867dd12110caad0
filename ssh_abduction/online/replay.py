"""Keep minimal maps by replaying them, as long as they predict what the robot sees.

To replay a map is to follow its links along the steps of the trace.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Action, Trace
from ssh_abduction.solver import Cost, Judging, Outcome, Status, observation
from ssh_abduction.theory.pairs import Pairs
from ssh_abduction.theory.speedups import row
from ssh_abduction.theory.theory import Theory


class ReplayedMap:
    """A map that is extended by each new step that it predicts.

    Args:
        ssh_map: A map of all steps so far.
        seen: What each of these steps shows, as `observation` returns it.
    """

    def __init__(self, ssh_map: SSHMap, seen: Sequence[object]) -> None:
        self._map = ssh_map
        self._place_of = [s.place for s in ssh_map.dstates]
        self._labels = list(ssh_map.dstate_at)
        self._links = {(s, action): x for s, action, x in ssh_map.links}
        self._sights = dict(zip(self._labels, seen, strict=True))

    def follow(self, action: str, seen: object, pairs: Pairs) -> Outcome:
        """Extend the map by one step if it predicts what the step shows (an `observation`).

        Return whether it predicts that, contradicts it, or has no link for the action.
        """
        there = self._links.get((self._labels[-1], action))
        if there is None:
            return Outcome.UNKNOWN
        if self._sights[there] != seen:
            return Outcome.CONTRADICTED
        self._labels.append(there)
        if not pairs.allow(len(self._labels) - 1, self._labels, self._place_of):
            self._labels.pop()
            return Outcome.CONTRADICTED
        return Outcome.PREDICTED

    def map(self) -> SSHMap:
        """Make the map of all steps so far."""
        if len(self._map.dstate_at) < len(self._labels):
            self._map = replace(self._map, dstate_at=tuple(self._labels))
        return self._map


class MinimalMaps:
    """The minimal maps of the steps so far, with how much is proven about them.

    Args:
        trace: The steps so far.
        theory: The theory, in which no field is "auto".
        judging: Judges maps by the evidence and the checker, for this theory.

    Attributes:
        maps: The minimal maps. If `replays` is false, the maps that clingo found last, which may
            not be proven minimal.
        status: UNKNOWN until clingo has proven which maps are minimal.
        complete: Whether `maps` are all minimal maps.
        cost: The counts of a minimal map; None if they are unknown.
        replays: Whether the claim in `mapper.py` holds for the theory, so that maps are replayed.
    """

    def __init__(self, trace: Trace, theory: Theory, judging: Judging) -> None:
        self.maps: list[ReplayedMap] = []
        self.status = Status.UNKNOWN
        self.complete = False
        self.cost: Cost | None = None
        self.replays = row("prefixes").holds_for(theory)
        self._theory, self._judging = theory, judging
        self._seen: list[object] = [observation(step, theory) for step in trace.steps]

    def follow(self, action: Action, trace: Trace, pairs: Pairs) -> list[ReplayedMap]:
        """Keep the maps that predict the last step. If none does, reset the status to UNKNOWN.

        `trace` has this step, and `action` led to it. If no map is kept, return the maps
        that have no link for the action, else an empty list.
        """
        self._seen.append(observation(trace.steps[-1], self._theory))
        outcomes = [(m, self._outcome(m, trace, action.name, pairs)) for m in self.maps]
        untried = [m for m, outcome in outcomes if outcome is Outcome.UNKNOWN]
        self.maps = [m for m, outcome in outcomes if outcome is Outcome.PREDICTED]
        # A map without a link for the action may be extended to further minimal maps.
        self.complete = self.complete and not untried
        if not self.replays:
            self.maps = []
        if self.maps:
            return []
        self.status, self.complete = Status.UNKNOWN, False
        return untried

    def _outcome(self, replayed: ReplayedMap, trace: Trace, action: str, pairs: Pairs) -> Outcome:
        """Extend a map by the last step if both the map and the evidence allow it."""
        outcome = replayed.follow(action, self._seen[-1], pairs)
        if outcome is Outcome.PREDICTED and not self._judging.allows_grown(
            trace, replayed.map(), len(trace) - 1
        ):
            return Outcome.CONTRADICTED
        return outcome

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
            self.maps = [ReplayedMap(m, self._seen) for m in maps]

    def is_settled(self, max_maps: int | None) -> bool:
        """Whether another search would find nothing new, if at most `max_maps` are kept."""
        return self.status is Status.OPTIMAL and (self.complete or len(self.maps) == max_maps)

    @property
    def is_impossible(self) -> bool:
        """Whether it is proven that these steps have no map, however the trace goes on."""
        return self.status is Status.UNSATISFIABLE and self.replays
