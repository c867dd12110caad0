"""Keep the minimal maps of a growing trace with faults, and rivals that cost a little more.

A fault is a step that a map treats as wrong. A rival is one map of all steps so far.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from ssh_abduction.checker.checker import check
from ssh_abduction.data.maps import Fault
from ssh_abduction.data.trace import Trace
from ssh_abduction.online.chances import Chances
from ssh_abduction.online.hypotheses import ExtendedMap, Seen, shares_of_rivals
from ssh_abduction.solver import Bound, Judging, Solution, Status, observation
from ssh_abduction.theory.settle import Problem
from ssh_abduction.theory.speedups import row
from ssh_abduction.theory.theory import Theory

# Probability of a fault of the cheapest kind, at each step.
RARE = Chances().misread
# At most this many rivals cost more than the minimal maps.
RIVALS = 50
# Rivals that are less probable than this share of the most probable one are dropped.
LEAST_SHARE = 1e-3


@dataclass(frozen=True, slots=True)
class StepEffect:
    """The effect of one more step on the rivals."""

    # Whether the maps are not proven minimal any more, or further minimal maps may exist.
    lost_proof: bool = False
    # A sentence about what the best map expected instead; None if it predicted the step.
    broke: str | None = None


class RivalMaps:
    """The rivals of the steps so far, with how much is proven about them.

    The theory of `problem` allows faults, and no field is "auto". At most `max_maps` of the
    cheapest rivals are kept; None keeps all.
    """

    def __init__(self, problem: Problem, max_maps: int | None, judging: Judging) -> None:
        trace, theory = problem.trace, problem.theory
        self.rivals: list[ExtendedMap] = []  # the cheapest first, then others by probability
        self.solved: Solution | None = None  # the last result of the solver
        self.bound = Bound()  # the best lower bound of the cost so far
        # Whether it is proven that the cheapest rivals are minimal, that all minimal maps are
        # listed, and that no map satisfies the axioms.
        self.is_proven = self.is_complete = self.is_impossible = False
        self._problem, self._max_maps, self._judging = problem, max_maps, judging
        self._views = {step.view for step in trace.steps}
        self._least: tuple[int, ...] = ()  # what a minimal map costs, while proven
        self._replays = row("prefixes").holds_for(theory.replace(misread=0, slipped=0))
        self._has_evidence = bool(problem.evidence)
        # Under the two causal axioms alone, `ExtendedMap.ways_on` lists all possible links.
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
    def lead(self) -> ExtendedMap | None:
        """The best rival; None if there is none."""
        return self.rivals[0] if self.rivals else None

    @property
    def minimal(self) -> list[ExtendedMap]:
        """The rivals that are proven minimal; empty without a proof."""
        if not self.is_proven:
            return []
        return [rival for rival in self.rivals if rival.cost == self._least]

    @property
    def is_settled(self) -> bool:
        """Whether solving again would add nothing."""
        return self.is_impossible or (
            self.is_proven and (self.is_complete or len(self.minimal) == self._max_maps)
        )

    def is_minimal(self, rival: ExtendedMap) -> bool:
        """Whether a rival has the cost that was last proven minimal."""
        return rival.cost == self._least

    def follow(self, problem: Problem) -> StepEffect:
        """Extend the rivals by the last step of `problem`, which has all steps and the theory."""
        self._problem, trace = problem, problem.trace
        t = len(trace) - 1
        self._views.add(trace.steps[t].view)
        if self.is_impossible and self._replays:
            return StepEffect()
        done = trace.steps[t - 1].action
        assert done
        seen = observation(trace.steps[t], self._theory)
        lead = self.lead
        contradicted = lead.contradiction(done.name, seen) if lead else None
        has_unknown = any(rival.is_unknown(done.name) for rival in self.minimal)
        self.rivals = self._gone_on(self.rivals, t)
        if not self._replays:  # the answer for fewer steps says nothing about more steps
            self.rivals, self.bound = [], Bound()
            self.is_proven = self.is_complete = self.is_impossible = False
            return StepEffect(lost_proof=True)
        lost_proof = False
        if self.is_proven and self.is_complete and has_unknown and not self._lists_links:
            self.is_complete, lost_proof = False, True
        if self.is_proven and not self.minimal:
            self.is_proven, self.is_complete, lost_proof = False, False, True
        if lead and contradicted is not None and all(r.cost > lead.cost for r in self.rivals):
            return StepEffect(lost_proof, self._sentence(t, lead, contradicted, seen))
        return StepEffect(lost_proof)

    def absorb(self, found: Solution) -> None:
        """Add the maps of a solution of all steps to the rivals, and record what is proven."""
        self.solved = found
        if (found.bound.tenths or 0) >= (self.bound.tenths or 0):
            self.bound = found.bound
        if found.status is Status.UNSATISFIABLE:
            self.is_impossible, self.rivals = True, []
            return
        rivals = [ExtendedMap.of(ssh_map, self._trace, self._theory) for ssh_map in found.maps]
        if found.status is Status.OPTIMAL and rivals:
            self.is_proven, self.is_complete, self._least = True, found.complete, rivals[0].cost
        # Keep the other rivals. But if all minimal maps are listed, no other rival can be as cheap.
        known = {(rival.labels, rival.faults) for rival in rivals}
        others = [
            rival
            for rival in self.rivals
            if (rival.labels, rival.faults) not in known
            and not (self.is_complete and rival.cost <= self._least)
        ]
        self.rivals = self._ranked([*rivals, *others])

    def drop_inconsistent(self) -> None:
        """Drop the best rival until the checker accepts the best one that is left.

        This is not needed if the maps are proven, or if the theory has only the causal axioms.
        """
        if self.is_proven or self._lists_links:
            return
        theory = self._theory.of_steps(0, len(self._trace))
        while self.rivals and check(self._trace, self.rivals[0].explained(), theory):
            del self.rivals[0]

    def undecided(self) -> tuple[list[ExtendedMap], list[float]]:
        """List the rivals that later steps have to decide between, and their probabilities.

        Among rivals with the same faults, only the cheapest ones by the theory count,
        because no evidence ever refutes a superfluous dstate.
        """
        least: dict[frozenset[Fault], tuple[int, ...]] = {}
        for rival in self.rivals:
            faults = frozenset(rival.faults)
            least[faults] = min(least.get(faults, rival.cost), rival.cost)
        rivals = [r for r in self.rivals if r.cost == least[frozenset(r.faults)]]
        return rivals, self._shares(rivals)

    def _gone_on(self, rivals: Iterable[ExtendedMap], t: int) -> list[ExtendedMap]:
        """Extend rivals of the steps before `t` by step `t`, and rank the results."""
        done, step = self._trace.steps[t - 1].action, self._trace.steps[t]
        assert done
        seen = observation(step, self._theory)
        new = [
            way for rival in rivals for way in rival.ways_on(done.name, step, seen, self._theory)
        ]
        # Evidence tests only the new step, as it has already tested the earlier ones.
        if self._has_evidence:
            trace = self._trace.prefix(t + 1)
            pairs = self._problem.changed(trace, self._theory.of_steps(0, t + 1)).pairs
            new = [rival for rival in new if rival.is_allowed(trace, pairs, self._judging)]
        return self._ranked(new)

    def _ranked(self, rivals: list[ExtendedMap]) -> list[ExtendedMap]:
        """Sort rivals, the best first, and drop the improbable ones.

        The cheapest rivals come first, and at most `max_maps` of them stay. Then come up to RIVALS
        others that are probable enough, by probability.
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

    def _shares(self, rivals: list[ExtendedMap]) -> list[float]:
        """Compute the probability of each rival. They sum to 1."""
        dstates = len(min(rivals, key=lambda rival: rival.cost).shows)
        return shares_of_rivals(rivals, self._theory, RARE, dstates, len(self._views))

    def _sentence(self, t: int, lead: ExtendedMap, there: int, seen: Seen) -> str:
        """Describe step t, which contradicts the best map: the map expected dstate `there`."""
        kinds = [kind for kind in ("misread", "slipped") if getattr(self._theory, kind)]
        expected = lead.shows[there]
        what = (
            f"seen {seen[0]}, expected {expected[0]}"
            if seen[0] != expected[0]
            else "seen another star than expected"
        )
        return f"step {t}: {what} at dstate {there}: {', '.join(kinds)}, or the map is wrong"
