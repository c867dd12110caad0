"""The minimal maps of a trace with faults while it grows, and rivals that cost little more."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from ssh_abduction.checker.checker import check
from ssh_abduction.data.maps import Fault
from ssh_abduction.data.trace import Trace
from ssh_abduction.online.background_solve import Solved
from ssh_abduction.online.chances import Chances
from ssh_abduction.online.hypotheses import Rival, Scale, Seen
from ssh_abduction.solver import Bound, Judging, Status, observation
from ssh_abduction.theory.settle import Problem
from ssh_abduction.theory.speedups import row
from ssh_abduction.theory.theory import Theory

# Probability of a fault of the cheapest kind, at each step.
RARE = Chances().misread
# At most this many rivals cost more than the minimal maps.
RIVALS = 50
# Rivals are dropped if they are less probable than the best one times this.
LEAST_SHARE = 1e-3


@dataclass(frozen=True, slots=True)
class Change:
    """What one more step changed.

    Attributes:
        lost_proof: Whether the minimal maps are not proven any more, or perhaps not all.
        broke: A sentence, if the best map expected something else; else None.
    """

    lost_proof: bool = False
    broke: str | None = None


class RivalMaps:
    """The rivals of the steps so far, the best one first.

    Args:
        problem: The steps so far, and the theory without `auto`, with faults.
        max_maps: Keep at most this many minimal maps; None keeps all.
        judging: Evidence and the checker, for this theory.

    Attributes:
        rivals: The rivals. Those that are minimal come first.
        solved: The last answer of the solver.
        bound: The best lower bound so far.
        is_proven: Whether the cheapest rivals are proven minimal.
        is_complete: Whether these are all minimal maps.
        is_impossible: Whether no map satisfies the axioms.
    """

    def __init__(self, problem: Problem, max_maps: int | None, judging: Judging) -> None:
        trace, theory = problem.trace, problem.theory
        self.rivals: list[Rival] = []
        self.solved: Solved | None = None
        self.bound = Bound()
        self.is_proven = self.is_complete = self.is_impossible = False
        self._problem, self._max_maps, self._judging = problem, max_maps, judging
        self._views = {step.view for step in trace.steps}
        self._least: tuple[int, ...] = ()  # what a minimal map costs, while proven
        self._replays = row("prefixes").holds_for(theory.replace(misread=0, slipped=0))
        self._has_evidence = bool(problem.evidence)
        # Under the two causal axioms alone, `Rival.ways_on` lists all links that can be assumed.
        self._lists_links = (
            theory.level == "causal"
            and not self._has_evidence
            and not theory.rules
            and not theory.without
        )

    @property
    def _trace(self) -> Trace:
        return self._problem.trace

    @property
    def _theory(self) -> Theory:
        return self._problem.theory

    @property
    def lead(self) -> Rival | None:
        """The best rival."""
        return self.rivals[0] if self.rivals else None

    @property
    def minimal(self) -> list[Rival]:
        """The rivals that are proven minimal."""
        if not self.is_proven:
            return []
        return [rival for rival in self.rivals if rival.cost == self._least]

    @property
    def is_settled(self) -> bool:
        """Whether solving again would add nothing."""
        return self.is_impossible or (
            self.is_proven and (self.is_complete or len(self.minimal) == self._max_maps)
        )

    def is_minimal(self, rival: Rival) -> bool:
        """Whether a rival has the cost of a minimal map."""
        return rival.cost == self._least

    def follow(self, problem: Problem) -> Change:
        """Let the rivals go on with the last step of a trace, which is one step longer."""
        self._problem, trace = problem, problem.trace
        t = len(trace) - 1
        self._views.add(trace.steps[t].view)
        if self.is_impossible and self._replays:
            return Change()
        done = trace.steps[t - 1].action
        assert done
        seen = observation(trace.steps[t], self._theory)
        lead = self.lead
        contradicted = lead.contradiction(done.name, seen) if lead else None
        has_unknown = any(rival.is_unknown(done.name) for rival in self.minimal)
        self.rivals = self._gone_on(self.rivals, t)
        if not self._replays:  # what a map of fewer steps says of more is not known
            self.rivals, self.is_proven, self.is_complete = [], False, False
            return Change()
        lost_proof = False
        if self.is_proven and self.is_complete and has_unknown and not self._lists_links:
            self.is_complete, lost_proof = False, True
        if self.is_proven and not self.minimal:
            self.is_proven, self.is_complete, lost_proof = False, False, True
        if lead and contradicted is not None and all(r.cost > lead.cost for r in self.rivals):
            return Change(lost_proof, self._sentence(t, lead, contradicted, seen))
        return Change(lost_proof)

    def absorb(self, found: Solved) -> None:
        """Take the solver's answer for the steps so far, or for the first of them."""
        steps, self.solved = len(self._trace), found
        if (found.bound.tenths or 0) >= (self.bound.tenths or 0):
            self.bound = found.bound
        if found.status is Status.UNSATISFIABLE:
            self.is_impossible, self.rivals = self._replays or found.steps == steps, []
            return
        rivals = [Rival.of(ssh_map, self._trace, self._theory) for ssh_map in found.maps]
        optimal = found.status is Status.OPTIMAL and bool(rivals)
        if optimal:
            self.is_proven, self.is_complete, self._least = True, found.complete, rivals[0].cost
        # Let the maps go on with the steps that came since.
        for t in range(found.steps, steps):
            action = self._trace.actions[t - 1].name
            has_unknown = any(r.is_unknown(action) for r in rivals if self.is_minimal(r))
            rivals = self._gone_on(rivals, t)
            self.is_complete = self.is_complete and (self._lists_links or not has_unknown)
        if optimal and not any(self.is_minimal(rival) for rival in rivals):
            self.is_proven = self.is_complete = False
        # Keep the other rivals, but for those that complete minimal maps rule out.
        told = {(rival.labels, rival.faults) for rival in rivals}
        others = [
            rival
            for rival in self.rivals
            if (rival.labels, rival.faults) not in told
            and not (self.is_complete and rival.cost <= self._least)
        ]
        self.rivals = self._ranked([*rivals, *others])

    def is_outgrown(self, found: Solved) -> bool:
        """Whether an answer for fewer steps costs less than what is proven since."""
        if not self.is_proven:
            return False
        return (
            not found.maps or Rival.of(found.maps[0], self._trace, self._theory).cost < self._least
        )

    def drop_inconsistent(self) -> None:
        """Drop the best rival until the checker finds it consistent.

        Proven maps are consistent, and so are all rivals of the causal axioms alone.
        """
        if self.is_proven or self._lists_links:
            return
        theory = self._theory.of_steps(0, len(self._trace))
        while self.rivals and check(self._trace, self.rivals[0].explained(), theory):
            del self.rivals[0]

    def undecided(self) -> tuple[list[Rival], list[float]]:
        """The rivals that evidence has to decide between, and their probabilities.

        Among rivals with the same faults the preference of the theory decides, as it does if
        nothing is ignored: no evidence ever refutes a superfluous dstate.
        """
        least: dict[frozenset[Fault], tuple[int, ...]] = {}
        for rival in self.rivals:
            faults = frozenset(rival.faults)
            least[faults] = min(least.get(faults, rival.cost), rival.cost)
        rivals = [r for r in self.rivals if r.cost == least[frozenset(r.faults)]]
        return rivals, self._shares(rivals)

    def _gone_on(self, rivals: Iterable[Rival], t: int) -> list[Rival]:
        """Extend the rivals of the steps before `t` by step `t`, and rank the results."""
        done, step = self._trace.steps[t - 1].action, self._trace.steps[t]
        assert done
        seen = observation(step, self._theory)
        new = [
            way for rival in rivals for way in rival.ways_on(done.name, step, seen, self._theory)
        ]
        # Evidence is asked of the new step only: it rejects no more of the earlier ones.
        if self._has_evidence:
            trace = self._trace.prefix(t + 1)
            pairs = self._problem.changed(trace, self._theory.of_steps(0, t + 1)).pairs
            new = [
                rival
                for rival in new
                if pairs.allow(t, rival.labels, rival.places)
                and self._judging.allows_grown(trace, rival.explained(), t)
            ]
        return self._ranked(new)

    def _ranked(self, rivals: list[Rival]) -> list[Rival]:
        """The rivals that are probable enough, the best first.

        All of the cheapest stay, up to the limit of listed maps.
        """
        if not rivals:
            return []
        least = min(rival.cost for rival in rivals)
        shares = self._shares(rivals)
        order = sorted(range(len(rivals)), key=lambda i: (rivals[i].cost != least, -shares[i]))
        ranked = [
            rivals[i]
            for i in order
            if rivals[i].cost == least or shares[i] >= LEAST_SHARE * max(shares)
        ]
        ties = sum(rival.cost == least for rival in ranked)
        if self._max_maps and ties > self._max_maps:
            ranked = ranked[: self._max_maps] + ranked[ties:]
            self.is_complete, ties = False, self._max_maps
        return ranked[: ties + RIVALS]

    def _shares(self, rivals: list[Rival]) -> list[float]:
        """The probability of each rival."""
        dstates = len(min(rivals, key=lambda rival: rival.cost).shows)
        return Scale.of(self._theory, RARE, dstates, len(self._views)).shares(rivals)

    def _sentence(self, t: int, lead: Rival, there: int, seen: Seen) -> str:
        """Say what broke at a step that the best map expected at the dstate `there`."""
        kinds = [kind for kind in ("misread", "slipped") if getattr(self._theory, kind)]
        expected = lead.shows[there]
        what = (
            f"seen {seen[0]}, expected {expected[0]}"
            if seen[0] != expected[0]
            else "seen another star than expected"
        )
        return f"step {t}: {what} at dstate {there}: {', '.join(kinds)}, or the map is wrong"
