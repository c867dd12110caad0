"""Recover from faults while the robot drives.

A fault is a step that a map treats as wrong: a misread view, or an action that slipped. If a step
contradicts all minimal maps, the mapper keeps several explanations with probabilities, until later
steps decide which map is right. A dstate (distinctive state) is a place and a heading.

>>> from ssh_abduction import OnlineMapper, Theory
>>> mapper = OnlineMapper("v0", Theory.causal().replace(misread=1.5, slipped=3), time_limit=10)
>>> for t in range(1, 20):
...     _ = mapper.observe(("right", "travel")[(t - 1) % 2], f"v{t % 4}" if t != 17 else "v3")
...     if t >= 16:
...         print(t, mapper.standing)  # doctest: +NORMALIZE_WHITESPACE
16 certain: nothing new is taken as wrong; the robot is at dstate 0 of 4
17 uncertain, most likely: the view at step 17 is misread: v3, expected v1; the robot is at
   dstate 1 of 4; step 17: seen v3, expected v1 at dstate 1: misread, slipped, or the map is wrong
18 certain: the view at step 17 is misread: v3, expected v1; the robot is at dstate 2 of 4
19 certain: nothing new is taken as wrong; the robot is at dstate 3 of 4

The paper's own future work is "robust error-recovery during exploration, by falling back from
logical inference to Markov localisation when low-probability events violate the abstraction, until
the logical representation can be restored" (Kuipers & Beeson 2002). This module keeps three things:

* **Minimal maps**, proven, with their faults. As long as some of them predict what is seen, these
  stay minimal by the claim in `mapper.py`. The claim also holds with faults: suppose that a minimal
  map of the longer trace treats the last step as wrong. Without that step it would cost less than
  the minimum, which is impossible. In the causal theory, the same holds for an action that was
  never tried: each map is extended by a link to each dstate that looks right. These extensions
  cost nothing, and all others cost more. If no minimal map predicts the step, the trace
  is solved again, within the time of a step.
* **Rivals**: besides the minimal maps, explanations that cost a little more,
  each with its probability (`shares_of_rivals`).
* **Where the robot is** (`Confidence`), by Markov localisation in the best map. It begins just
  before the first step that contradicted the map. The robot may be at no dstate of the map.

The mapper is certain if one map is proven minimal and has a probability of at least CERTAIN (0.99)
among its rivals. After a contradiction, two more things are needed: a later step was predicted,
and localisation finds the robot where this map has it.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ssh_abduction.checker.checker import check
from ssh_abduction.data.maps import Fault, SSHMap
from ssh_abduction.data.trace import Action, Step, Trace
from ssh_abduction.online.keeper import ExtendedMap, Keeper, Seen, StepOptions
from ssh_abduction.online.localiser import Belief, Chances, Localiser
from ssh_abduction.solution import Bound, Effort, Seconds, Solution, Stop, cost_as_counted
from ssh_abduction.solver import observation, solve
from ssh_abduction.theory.settle import Problem
from ssh_abduction.theory.theory import Theory

# A map can be certain only if it has at least this probability among its rivals.
CERTAIN = 0.99
# At most this many hypotheses are reported. If there are more, the last one is for all others.
LISTED = 10
# Localisation begins at most this many steps before the last one.
REPLAYED = 200
# Probability of a fault of the cheapest kind, at each step.
RARE = Chances().misread
# At most this many rivals cost more than the minimal maps.
RIVALS = 50
# Rivals that are less probable than this share of the most probable one are dropped.
LEAST_SHARE = 1e-3


class Recovery(Keeper):
    """Keeps the maps up to date for a theory that allows faults, and says how sure they are."""

    retry = 1.05  # each search begins anew, and takes longer than one that is continued

    def __init__(
        self, problem: Problem, options: StepOptions, before: Recovery | None = None
    ) -> None:
        super().__init__(problem, options, before)
        self._confidence: Confidence = before._confidence if before else Confidence(problem.theory)
        self.standing: Standing | None = None  # before the first answer
        self._bound = Bound()  # the best lower bound of the cost so far
        self._found: Solution | None = None  # the last result of the solver
        theory = problem.theory
        # Under the two causal axioms alone, `ExtendedMap.ways_on` lists all possible links.
        self._lists_links = (
            theory.level == "causal"
            and not problem.evidence
            and not theory.rules
            and not theory.without
        )

    def restarted(self, problem: Problem) -> Recovery:
        """Make a Recovery for a theory that changed with the last step. It has no proofs yet."""
        return Recovery(problem, self._options, before=self)

    @property
    def lead(self) -> ExtendedMap | None:
        """The best rival; None if there is none."""
        return self.maps[0] if self.maps else None

    def _follow(self, action: Action, step: Step) -> list[ExtendedMap]:
        """Extend the rivals by the last step, and note if the best one expected something else."""
        theory, lead, confidence = self._problem.theory, self.lead, self._confidence
        if lead and confidence.known is None:
            confidence.known = lead.explained()
        if not self._replays:
            self._bound = Bound()
            return []
        seen = observation(step, theory)
        t = len(self._problem.trace) - 1
        new = [way for m in self.maps for way in m.ways_on(action.name, step, seen, theory)]
        # Evidence tests only the new step, as it has already tested the earlier ones.
        if self._problem.evidence:
            trace = self._problem.trace
            pairs = self._problem.changed(trace, theory.of_steps(0, t + 1)).pairs
            new = [rival for rival in new if rival.is_allowed(trace, pairs, self._judging)]
        ranked = self._ranked(new)
        there = lead.contradiction(action.name, seen) if lead else None
        if lead and there is not None and all(r.cost > lead.cost for r in ranked):
            confidence.broke.append((t, _sentence(theory, t, there, lead.shows[there], seen)))
        return ranked

    def answer(self, began: float) -> Solution:
        """Also say how sure the maps are."""
        solution = super().answer(began)
        self.standing = self._confidence.standing(self, self._problem.trace, solution.maps)
        return solution

    def _ask(self) -> Stop | None:
        """Solve all steps, add the maps to the rivals, and record what is proven."""
        trace, theory, options = self._problem.trace, self._problem.theory, self._options
        self._found = found = solve(
            trace,
            theory.of_steps(0, len(trace)),
            time_limit=options.time_limit,
            work_limit=options.work_limit,
            max_maps=options.max_maps,
            speedups=options.speedups,
        )
        if (found.bound.tenths or 0) >= (self._bound.tenths or 0):
            self._bound = found.bound
        rivals = [ExtendedMap.of(ssh_map, trace, theory) for ssh_map in found.maps]
        self._prove(found, rivals)
        # Keep the other rivals. But if all minimal maps are listed, no other rival can be as cheap.
        known = {(rival.labels, rival.faults) for rival in rivals}
        others = [
            rival
            for rival in self.maps
            if (rival.labels, rival.faults) not in known
            and not (self.is_complete and rival.cost <= self._least)
        ]
        self._keep([] if self.is_impossible else self._ranked([*rivals, *others]))
        return found.stopped

    def _solution(self, began: float) -> Solution:
        theory, found = self._problem.theory, self._found
        self._drop_inconsistent()
        lead, status = self.lead, self._status
        assert found is not None
        # Without a proof the best rival is the answer.
        listed = tuple(rival.explained() for rival in self.minimal or self.maps[:1])
        self._judge(listed, began)
        return Solution(
            status=status,
            maps=listed,
            cost=cost_as_counted(listed[0], lead.cost, theory) if lead else None,
            bound=self._bound,
            complete=self.is_complete or self.is_impossible,
            theory=theory,
            steps=len(self._problem.trace),
            effort=Effort(found.steps, Seconds(time.perf_counter() - began, 0.0, 0.0)),
            stopped=None if self.is_complete or self.is_impossible else found.stopped,
            partial=None if listed else self._confidence.known,
        )

    def _drop_inconsistent(self) -> None:
        """Drop the best rival until the checker accepts the best one that is left.

        This is not needed if the maps are proven, or if the theory has only the causal axioms.
        """
        trace = self._problem.trace
        theory = self._problem.theory.of_steps(0, len(trace))
        while not (self.is_proven or self._lists_links) and self.maps:
            if not check(trace, self.maps[0].explained(), theory):
                break
            del self.maps[0]

    def undecided(self) -> tuple[list[ExtendedMap], list[float]]:
        """List the rivals that later steps have to decide between, and their probabilities.

        Among rivals with the same faults, only the cheapest ones by the theory count,
        because no evidence ever refutes a superfluous dstate.
        """
        least: dict[frozenset[Fault], tuple[int, ...]] = {}
        for rival in self.maps:
            faults = frozenset(rival.faults)
            least[faults] = min(least.get(faults, rival.cost), rival.cost)
        rivals = [r for r in self.maps if r.cost == least[frozenset(r.faults)]]
        return rivals, self._shares(rivals)

    def _ranked(self, rivals: list[ExtendedMap]) -> list[ExtendedMap]:
        """Sort rivals, the best first, and drop the improbable ones.

        The cheapest rivals come first. Then come up to RIVALS others that are probable enough, by
        probability.
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
        return ranked[: ties + RIVALS]

    def _shares(self, rivals: list[ExtendedMap]) -> list[float]:
        """Compute the probability of each rival. They sum to 1."""
        dstates = len(min(rivals, key=lambda rival: rival.cost).shows)
        views = len({step.view for step in self._problem.trace})
        return shares_of_rivals(rivals, self._problem.theory, RARE, dstates, views)


def _sentence(theory: Theory, t: int, there: int, expected: Seen, seen: Seen) -> str:
    """Describe step t, which contradicts the best map. It expected the dstate `there`."""
    kinds = [kind for kind in ("misread", "slipped") if getattr(theory, kind)]
    what = (
        f"seen {seen[0]}, expected {expected[0]}"
        if seen[0] != expected[0]
        else "seen another star than expected"
    )
    return f"step {t}: {what} at dstate {there}: {', '.join(kinds)}, or the map is wrong"


@dataclass(frozen=True, slots=True)
class PossibleMap:
    """One possible explanation of the steps so far, with its probability.

    Attributes:
        weight: The probability. The weights of all hypotheses sum to 1.
        map: A map of all steps so far, with its faults; None if this entry is for all remaining
            hypotheses together, or if no map is known.
        said: Text that names the new faults since the mapper was last certain, and the dstate where
            the robot is.
    """

    weight: float
    map: SSHMap | None
    said: str

    def __str__(self) -> str:
        return f"{self.weight:.3f}  {self.said}"


@dataclass(frozen=True, slots=True)
class Standing:
    """How sure the mapper is of its map, and which explanations are possible.

    Attributes:
        certain: Whether the first map of the solution is proven minimal, and nearly all hypotheses
            predict the same from here on. They may still differ in the past: which step to treat as
            wrong.
        broke: A sentence for each step that contradicted the best map since the mapper was last
            certain. They are still listed at the step at which the mapper becomes certain again.
        hypotheses: The possible explanations, the most probable first.
        where: The belief about where the robot is in the first map, by Markov localisation that
            begins just before the first step in `broke`; None if `broke` is empty.
    """

    certain: bool
    broke: tuple[str, ...]
    hypotheses: tuple[PossibleMap, ...]
    where: Belief | None = None

    def __str__(self) -> str:
        if self.certain:
            return f"certain: {self.hypotheses[0].said}"
        return "; ".join([f"uncertain, most likely: {self.hypotheses[0].said}", *self.broke[-1:]])


def chances_of(theory: Theory) -> Chances:
    """Convert the prices of faults in a theory to probabilities for localisation.

    A fault that costs twice as much as another kind is as rare as two faults of that kind. If the
    theory allows only one kind of fault, the other kind gets twice its price. Otherwise
    localisation would explain every error by the one kind that is allowed.
    """
    cheapest = min(price for price in (theory.misread, theory.slipped) if price)
    misread, slipped = (
        RARE ** min(2.0, (price or 2 * cheapest) / cheapest)
        for price in (theory.misread, theory.slipped)
    )
    return Chances(misread=misread, slipped=slipped)


class Confidence:
    """Computes how sure the mapper is after each step, for a theory that allows faults."""

    def __init__(self, theory: Theory) -> None:
        # The last map that was certain. If none was certain yet, the best map of the first answer.
        self.known: SSHMap | None = None
        self._chances = chances_of(theory)
        # Each step that contradicted the best map since it was certain, with a sentence.
        self.broke: list[tuple[int, str]] = []

    def standing(self, maps: Recovery, trace: Trace, listed: Sequence[SSHMap]) -> Standing:
        """Compute how sure the mapper is now, by the rivals and the maps listed, best first."""
        broke = tuple(sentence for _, sentence in self.broke)
        lead = maps.lead
        if lead is None:
            said = "no map of these steps is known yet"
            if maps.is_impossible:
                said = "no map satisfies the axioms"
            return Standing(False, broke, (PossibleMap(1.0, None, said),))
        rivals, shares = maps.undecided()
        where = self._locate(lead, trace) if self.broke else None
        certain = _is_decided(maps, rivals, shares) and (
            where is None or self._has_recovered(where, lead, trace)
        )
        standing = Standing(certain, broke, self._hypotheses(rivals, shares), where)
        # From here on only later faults are reported.
        if certain:
            self.known = listed[0]
            self.broke.clear()
        return standing

    def _has_recovered(self, where: Belief, lead: ExtendedMap, trace: Trace) -> bool:
        """Whether the mapper has recovered from the last step that contradicted the best map.

        This needs a later step, and localisation has to agree with the best map: it gives more than
        half of the probability to the dstate where this map has the robot.
        """
        is_later = self.broke[-1][0] < len(trace) - 1
        return is_later and where.likeliest == lead.here and where.probability > 0.5

    def _hypotheses(
        self, rivals: Sequence[ExtendedMap], shares: Sequence[float]
    ) -> tuple[PossibleMap, ...]:
        """Make hypotheses from the most probable rivals, and one from all others together."""
        order = sorted(range(len(shares)), key=lambda i: -shares[i])
        first = order if len(order) <= LISTED else order[: LISTED - 1]
        listed = [
            PossibleMap(shares[i], rivals[i].explained(), self._said(rivals[i])) for i in first
        ]
        if rest := order[len(first) :]:
            others = "the one other" if len(rest) == 1 else f"one of {len(rest)} others"
            listed.append(PossibleMap(sum(shares[i] for i in rest), None, others))
        return tuple(listed)

    def _said(self, rival: ExtendedMap) -> str:
        """Describe a rival: its new faults since the mapper was certain, and the robot's dstate."""
        excused = set(self.known.faults) if self.known else set()
        new = sorted(set(rival.faults) - excused, key=lambda fault: fault.step)
        faults = ", ".join(str(fault) for fault in new) or "nothing new is taken as wrong"
        return f"{faults}; the robot is at dstate {rival.here} of {len(rival.shows)}"

    def _locate(self, lead: ExtendedMap, trace: Trace) -> Belief:
        """Locate the robot in the best map.

        Begin where this map has the robot just before the first step that contradicted the best
        map since the mapper was certain, but at most REPLAYED steps back.
        """
        last = len(trace) - 1
        first = max(self.broke[0][0] - 1, last - REPLAYED, 0)
        localiser = Localiser(lead.explained(), chances=self._chances)
        belief = Belief(np.eye(len(lead.shows))[lead.labels[first]], 0.0)
        for before, after in pairwise(trace.steps[first:]):
            assert before.action
            belief = localiser.update(belief, before.action, after.view)
        return belief


def _is_decided(maps: Recovery, rivals: Sequence[ExtendedMap], shares: Sequence[float]) -> bool:
    """Whether the future is decided, whatever the past.

    All minimal maps must be known and predict the same from here on. Rivals that predict this too
    must have at least the probability CERTAIN, together with the minimal maps.
    """
    if not maps.is_complete:
        return False
    future = maps.maps[0].future()
    if any(rival.future() != future for rival in maps.minimal[1:]):
        return False
    agreeing = sum(
        share for rival, share in zip(rivals, shares, strict=True) if rival.future() == future
    )
    return agreeing >= CERTAIN


def shares_of_rivals(
    rivals: Sequence[ExtendedMap], theory: Theory, chance: float, dstates: int, views: int
) -> list[float]:
    """Compute the probability of each rival, given that one of them is true.

    The theory gives the price of a fault in dstates, and the cheapest kind of fault has the
    probability `chance` at each step. A price does not count alternatives: a new link, or an action
    that slipped, leads to one of N dstates, and a misread view is one of V views. Let λ be the
    logarithm of the odds that correspond to the price of one dstate. Then

        weight = exp(-λ cost) N^-(links and slips) V^-(misreadings)

    What happens after a fault decides between its explanations. If one explanation has to assume a
    link that another one predicts, the weight of the first one falls. N and V count as at least 2.
    """
    cheapest = min(round(10 * price) for price in (theory.misread, theory.slipped) if price)
    per_dstate, per_view = math.log(max(dstates, 2)), math.log(max(views, 2))
    improbable = []  # the negative logarithm of each weight
    for rival in rivals:
        kinds = Counter(fault.kind for fault in rival.faults)
        improbable.append(
            -math.log(chance) * rival.cost[0] / cheapest
            + (len(rival.links) + kinds["slipped"]) * per_dstate
            + (kinds["misread"] + kinds["misseen"]) * per_view
        )
    least = min(improbable, default=0.0)
    weights = [math.exp(least - nats) for nats in improbable]
    total = sum(weights)
    return [weight / total for weight in weights]
