"""Minimal maps that are replayed while they predict what the robot sees."""

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
    """A map, with the labels of the steps that it has predicted since it was found.

    Args:
        ssh_map: A map of all steps so far.
        seen: What each of these steps shows, as `observation` gives it.
    """

    def __init__(self, ssh_map: SSHMap, seen: Sequence[object]) -> None:
        self._map = ssh_map
        self._place_of = [s.place for s in ssh_map.dstates]
        self._labels = list(ssh_map.labels)
        self._links = {(s, action): x for s, action, x in ssh_map.links}
        self._sights = dict(zip(self._labels, seen, strict=True))

    def follow(self, action: str, seen: object, pairs: Pairs) -> Outcome:
        """Follow the map over one more step, and say whether it predicted the step.

        Args:
            action: The name of the action before the step.
            seen: What the step shows.
            pairs: What evidence says of pairs of steps.
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
        """The map of all steps so far."""
        if len(self._map.labels) < len(self._labels):
            self._map = replace(self._map, labels=tuple(self._labels))
        return self._map


class MinimalMaps:
    """The minimal maps of the steps so far, and whether they are proven and all.

    Args:
        trace: The steps so far.
        theory: The theory without `auto`.
        judging: Evidence and the checker, for this theory.

    Attributes:
        maps: The minimal maps; those that clingo found, if each step is solved again.
        status: UNKNOWN until clingo has proven which maps are minimal.
        complete: Whether `maps` are all minimal maps.
        cost: What a minimal map costs.
        replays: Whether minimal maps may be replayed, by the claim in `mapper.py`.
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
        """Keep the maps that predict the last step. If none does, nothing is proven any more.

        Args:
            action: The action before the last step.
            trace: The steps so far, one more than before.
            pairs: What evidence says of pairs of these steps.

        Returns:
            The maps in which the last action was never tried, if no map is kept.
        """
        self._seen.append(observation(trace.steps[-1], self._theory))
        outcomes = [(m, self._outcome(m, trace, action.name, pairs)) for m in self.maps]
        untried = [m for m, outcome in outcomes if outcome is Outcome.UNKNOWN]
        self.maps = [m for m, outcome in outcomes if outcome is Outcome.PREDICTED]
        # A map in which the action was never tried may go on to other minimal maps.
        self.complete = self.complete and not untried
        if not self.replays:
            self.maps = []
        if self.maps:
            return []
        self.status, self.complete = Status.UNKNOWN, False
        return untried

    def _outcome(self, replayed: ReplayedMap, trace: Trace, action: str, pairs: Pairs) -> Outcome:
        """What a map and evidence say of the last step."""
        outcome = replayed.follow(action, self._seen[-1], pairs)
        if outcome is Outcome.PREDICTED and not self._judging.allows_grown(
            trace, replayed.map(), len(trace) - 1
        ):
            return Outcome.CONTRADICTED
        return outcome

    def replace(
        self, found: Iterable[SSHMap], status: Status, complete: bool, cost: Cost | None
    ) -> None:
        """Take what clingo proved. Known minimal maps stay if clingo listed fewer in time."""
        maps, was_proven = list(found), self.status is Status.OPTIMAL
        self.status, self.complete, self.cost = status, complete, cost
        if len(maps) >= len(self.maps) or not was_proven:
            self.maps = [ReplayedMap(m, self._seen) for m in maps]

    def is_settled(self, max_maps: int | None) -> bool:
        """Whether clingo could add nothing."""
        return self.status is Status.OPTIMAL and (self.complete or len(self.maps) == max_maps)

    @property
    def is_impossible(self) -> bool:
        """Whether no map of these steps, nor of more, satisfies the axioms."""
        return self.status is Status.UNSATISFIABLE and self.replays
