"""Recovers from faults while the robot drives: where inference is contradicted it falls back to a belief, until evidence restores the map.

>>> from ssh_abduction import OnlineMapper, Theory
>>> mapper = OnlineMapper("v0", Theory.causal().replace(misread=1.5, slipped=3))
>>> for t in range(1, 20):
...     _ = mapper.observe(("right", "travel")[(t - 1) % 2], f"v{t % 4}" if t != 17 else "v3")
...     if t >= 16:
...         print(t, mapper.standing)
16 certain: nothing else is disbelieved; the robot is at dstate 0 of 4
17 uncertain, most likely: the view at step 17 is misread: v3, expected v1; the robot is at dstate 1 of 4; step 17: seen v3, expected v1 at dstate 1: misread, slipped, or the map is wrong
18 certain: the view at step 17 is misread: v3, expected v1; the robot is at dstate 2 of 4
19 certain: nothing else is disbelieved; the robot is at dstate 3 of 4

The paper's own future work is "robust error-recovery during exploration, by falling back from logical inference to Markov localisation when low-probability events violate the abstraction, until
the logical representation can be restored" (Kuipers & Beeson 2002). Here these are three things:

* **Minimal maps**, proven, with their faults. While some of them predict what is seen they stay minimal, by the claim in `mapper.py`: it holds with faults, too. For a minimal map of the longer trace
  that disbelieves the last step would, without that step, be a map that costs less than the least. And of the causal theory no minimal map is lost where an action was never tried: a link to each dstate
  that looks right is all that costs nothing. Only where none goes on is the trace solved anew, in the time that a step has, and else in a process of its own while the robot drives.
* **Rivals** (`rivals.py`): beside the minimal maps all explanations that cost more, but not much more, each with its probability.
* **Where the robot is**, by Markov localisation (`localiser.py`) in the map that is best now, from the dstate before the one at which it broke: or nowhere that this map knows.

The mapper is certain where one map is minimal, proven, has the probability CERTAIN among its rivals, and, after something broke, is also where localisation has the robot located.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from ssh_abduction.checker.checker import check
from ssh_abduction.data.maps import Fault, SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.online.background_solve import Meanwhile, Solved, solved
from ssh_abduction.online.hypotheses import Rival, Scale
from ssh_abduction.online.localiser import Belief, Chances, Localiser
from ssh_abduction.solver import (
    Bound,
    Judging,
    Seconds,
    Solution,
    Status,
    cost_as_counted,
    observation,
)
from ssh_abduction.theory.evidence import evidence_of, pairs_of
from ssh_abduction.theory.speedups import Speedups, row
from ssh_abduction.theory.theory import Theory

RARE = Chances().misread  # How probable a fault of the cheapest kind is, at each step.
CERTAIN = 0.99  # A map that has this probability among its rivals may be certain.
RIVALS = 50  # So many rivals, at most, that cost more than the least.
LEAST_SHARE = 1e-3  # Rivals are given up that are less probable than the best one times this.
TOLD = 10  # So many hypotheses are told one by one; the last of them stands for all others.
# After a search that proved nothing, or did not list all, the trace grows by this factor, and by so many steps at least, before the next one.
RETRY = 1.05
PAUSE = 2
OVERRUN = 2  # So many times the limit is much longer than a step may take.
REPLAYED = 200  # Localisation begins so many steps ago at most.


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """What may be true.

    weight  its probability; those of all hypotheses sum to 1
    map     a map of all steps so far, with its faults; None for what is left
    said    what it disbelieves since the mapper was last certain, and where the robot is then
    """

    weight: float
    map: SSHMap | None
    said: str

    def __str__(self) -> str:
        return f"{self.weight:.3f}  {self.said}"


@dataclass(frozen=True, slots=True)
class Standing:
    """How sure the mapper is of its map.

    certain     whether the first map of the solution is proven minimal, and evidence leaves no other from here on. What was need not be certain: two hypotheses may have
                the same map and the robot in the same dstate, and differ in the step at which something was disbelieved
    broke       a sentence for each step since the mapper was last certain at which the best map expected something else; also where the mapper is certain again by this step
    hypotheses  what may be true, the most probable one first
    where       where the robot is in the first map, or nowhere, by Markov localisation since something broke; None where nothing broke
    """

    certain: bool
    broke: tuple[str, ...]
    hypotheses: tuple[Hypothesis, ...]
    where: Belief | None = None

    def __str__(self) -> str:
        if self.certain:
            return f"certain: {self.hypotheses[0].said}"
        return "; ".join([f"uncertain, most likely: {self.hypotheses[0].said}", *self.broke[-1:]])


def chances_of(theory: Theory) -> Chances:
    """How likely it is that a map does not hold, by what faults cost: those of a kind that costs twice as much are as rare as two of the other. A kind that a theory does not
    know costs twice as much here: localisation would take any error to be of the only kind that it knows."""
    cheapest = min(price for price in (theory.misread, theory.slipped) if price)
    misread, slipped = (
        RARE ** min(2.0, (price or 2 * cheapest) / cheapest)
        for price in (theory.misread, theory.slipped)
    )
    return Chances(misread=misread, slipped=slipped)


class Recovery:
    """The maps with faults of a trace that grows, and how sure they are. `solution` and `standing` are the answers for the steps so far.

    trace   its first step
    theory  with faults, settled
    The others are those of OnlineMapper.
    """

    def __init__(
        self,
        trace: Trace,
        theory: Theory,
        *,
        time_limit: float | None,
        max_maps: int | None,
        speedups: Speedups,
    ) -> None:
        self.searches = 0  # how often the trace was solved anew, in a step
        self._limit, self._most, self._speedups = time_limit, max_maps, speedups
        self._views = {trace.steps[0].view}
        self._known: SSHMap | None = None  # the map that was certain last, or best before
        self._broke: list[tuple[int, str]] = []  # since then
        self._localiser: tuple[object, Localiser, Belief, int] | None = (
            None  # of which map, and the belief after so many steps
        )
        self._began = time.perf_counter()
        self._spent = 0.0  # seconds that all steps took since the maps were sought anew
        self._trace = trace
        self._begin_with(theory)
        self._solve()
        self.solution = self._answer()
        self.standing = self._stand()

    def _begin_with(self, theory: Theory) -> None:
        """Begin anew, with nothing proven."""
        self._theory = theory
        without_faults = theory.replace(misread=0, slipped=0)
        self._replays = row("prefixes").holds_for(without_faults)
        self._evidence = evidence_of(theory)
        # Which links are free to be assumed is known where nothing but the two causal axioms holds.
        self._lists_links = (
            theory.level == "causal"
            and not self._evidence
            and not theory.rules
            and not theory.without
        )
        self._chances = chances_of(theory)
        self._judging = Judging(self._trace, theory)
        self._rivals: list[Rival] = []
        self._least: tuple[int, ...] = ()  # what minimal maps cost, while proven
        self._proven = self._complete = self._impossible = False
        self._bound = Bound()
        self._next_search = 0
        self._is_slow = (
            False  # whether clingo could not be stopped in time: it cannot while it grounds a step
        )
        self._meanwhile: Meanwhile | None = None

    def take(self, trace: Trace, theory: Theory, began: float) -> None:
        """Take in the last step of a trace that is one step longer.

        theory  as the trace settles it; where that is another one, maps are sought anew
        """
        self._trace, self._began = trace, began
        self._views.add(trace.steps[-1].view)
        if theory == self._theory:
            self._advance()
        else:
            self._begin_with(theory)
        if not self._settled() and len(trace) >= self._next_search:
            self._solve()
        self._absorb_meanwhile()
        self.solution = self._answer()
        self.standing = self._stand()

    def _settled(self) -> bool:
        """Whether solving anew could add nothing."""
        return self._impossible or (
            self._proven and (self._complete or len(self._minimal()) == self._most)
        )

    def _minimal(self) -> list[Rival]:
        """The rivals that are proven minimal."""
        return (
            [rival for rival in self._rivals if rival.cost == self._least] if self._proven else []
        )

    def _advance(self) -> None:
        """Let the rivals go on with the last step."""
        if self._impossible and self._replays:
            return
        t = len(self._trace) - 1
        done, step = self._trace.steps[t - 1].action, self._trace.steps[t]
        assert done
        seen = observation(step, self._theory)
        lead = self._rivals[0] if self._rivals else None
        contradicted = lead.contradiction(done.name, seen) if lead else None
        if lead and self._known is None:
            self._known = lead.explained()
        before, unknown = (
            self._rivals,
            any(rival.is_unknown(done.name) for rival in self._minimal()),
        )
        self._rivals = self._gone_on(before, t)
        if not self._replays:  # what a map of fewer steps says of more is not known
            self._rivals, self._proven, self._complete = [], False, False
        if self._proven and self._complete and unknown and not self._lists_links:
            self._complete, self._next_search = False, 0
        if self._proven and not self._minimal():
            self._proven = self._complete = False
            self._next_search = 0  # the cost was proven, so the next one may be
        if (
            lead
            and contradicted is not None
            and self._replays
            and all(rival.cost > lead.cost for rival in self._rivals)
        ):
            self._note_break(t, lead, contradicted, seen)

    def _gone_on(self, rivals: Iterable[Rival], t: int) -> list[Rival]:
        """The rivals of the steps before t, as they go on with step t: those that are probable enough, the best one first."""
        done, step = self._trace.steps[t - 1].action, self._trace.steps[t]
        assert done
        seen = observation(step, self._theory)
        new = [
            way for rival in rivals for way in rival.ways_on(done.name, step, seen, self._theory)
        ]
        if self._evidence:
            trace = self._trace.prefix(t + 1)
            pairs = pairs_of(trace, self._theory.of_steps(0, t + 1))
            new = [
                rival
                for rival in new
                if pairs.allow(t, rival.labels, rival.places)
                and self._judging.allows_grown(trace, rival.explained(), t)
            ]
        return self._ranked(new)

    def _ranked(self, rivals: list[Rival]) -> list[Rival]:
        """Those that are probable enough, the best one first: of those that cost least all, or as many as maps are listed."""
        if not rivals:
            return []
        least = min(rival.cost for rival in rivals)
        shares = self._scale(rivals).shares(rivals)
        order = sorted(range(len(rivals)), key=lambda i: (rivals[i].cost != least, -shares[i]))
        ranked = [
            rivals[i]
            for i in order
            if rivals[i].cost == least or shares[i] >= LEAST_SHARE * max(shares)
        ]
        ties = sum(rival.cost == least for rival in ranked)
        if self._most and ties > self._most:
            ranked = ranked[: self._most] + ranked[ties:]
            self._complete, ties = False, self._most
        return ranked[: ties + RIVALS]

    def _scale(self, rivals: Iterable[Rival]) -> Scale:
        dstates = len(min(rivals, key=lambda rival: rival.cost).shows)
        return Scale.of(self._theory, RARE, dstates, len(self._views))

    def _note_break(self, t: int, lead: Rival, there: int, seen: tuple[object, object]) -> None:
        """Note what broke at a step, which the best map took to be at another dstate."""
        kinds = [kind for kind in ("misread", "slipped") if getattr(self._theory, kind)]
        expected = lead.shows[there]
        what = (
            f"seen {seen[0]}, expected {expected[0]}"
            if seen[0] != expected[0]
            else "seen another star than expected"
        )
        self._broke.append(
            (t, f"step {t}: {what} at dstate {there}: {', '.join(kinds)}, or the map is wrong")
        )

    def _solve(self) -> None:
        """Solve the trace in the time that a step has, and else while the robot drives; only then, if a step took much longer than it may, and there is a map."""
        steps = len(self._trace)
        self._next_search = max(steps + PAUSE, int(RETRY * steps)) if self._limit is not None else 0
        if self._is_slow and self._rivals and self._begin_meanwhile():
            return
        self.searches += 1
        began = time.perf_counter()
        found = solved(self._trace, self._theory, self._limit, self._most, self._speedups)
        self._absorb(found)
        if not self._settled() and found.stopped == "time limit":
            assert self._limit is not None
            self._is_slow = time.perf_counter() - began > OVERRUN * self._limit
            self._begin_meanwhile()

    def _begin_meanwhile(self) -> bool:
        """Solve the trace in another process, if there can be one, unless that is under way."""
        self._meanwhile = self._meanwhile or Meanwhile.begun(
            self._trace, self._theory, self._most, self._speedups
        )
        return self._meanwhile is not None

    def _excused(self) -> set[Fault]:
        """What was disbelieved when the mapper was last certain."""
        return set(self._known.faults) if self._known else set()

    def _absorb_meanwhile(self) -> None:
        """Take what was solved in the pauses, and let its maps go on with the steps since."""
        if self._meanwhile and self._meanwhile.done():
            found, self._meanwhile = self._meanwhile.result(), None
            if found and not self._settled() and not (self._proven and self._is_outgrown(found)):
                self._absorb(found)

    def _is_outgrown(self, found: Solved) -> bool:
        """Whether maps of the first steps cost less than what is proven since."""
        return (
            not found.maps or Rival.of(found.maps[0], self._trace, self._theory).cost < self._least
        )

    def _absorb(self, found: Solved) -> None:
        """Take the answer for the steps so far, or for the first of them."""
        steps, self._solved = len(self._trace), found
        if (found.bound.tenths or 0) >= (self._bound.tenths or 0):
            self._bound = found.bound
        if found.status is Status.UNSATISFIABLE:
            self._impossible, self._rivals = self._replays or found.steps == steps, []
            return
        rivals = [Rival.of(ssh_map, self._trace, self._theory) for ssh_map in found.maps]
        optimal = found.status is Status.OPTIMAL and bool(rivals)
        if optimal:
            self._proven, self._complete, self._least = True, found.complete, rivals[0].cost
        for t in range(found.steps, steps):
            unknown = any(
                rival.is_unknown(self._trace.actions[t - 1].name)
                for rival in rivals
                if rival.cost == self._least
            )
            rivals = self._gone_on(rivals, t)
            self._complete = self._complete and (self._lists_links or not unknown)
        if optimal and not any(rival.cost == self._least for rival in rivals):
            self._proven = self._complete = False
        told = {(rival.labels, rival.faults) for rival in rivals}
        others = [
            rival
            for rival in self._rivals
            if (rival.labels, rival.faults) not in told
            and not (self._complete and rival.cost <= self._least)
        ]
        self._rivals = self._ranked([*rivals, *others])

    def _answer(self) -> Solution:
        """The answer for the steps so far."""
        self._drop_inconsistent()
        lead = self._rivals[0] if self._rivals else None
        maps = tuple(rival.explained() for rival in self._minimal()) or (
            (lead.explained(),) if lead else ()
        )
        status = (
            Status.OPTIMAL
            if self._proven
            else Status.FEASIBLE
            if maps
            else Status.UNSATISFIABLE
            if self._impossible
            else Status.UNKNOWN
        )
        self._spent += time.perf_counter() - self._began
        if maps and self._judging.has_time_for(len(self._trace), self._spent):
            self._judging.pass_grown_map(self._trace, maps[0])
        return Solution(
            status=status,
            maps=maps,
            cost=cost_as_counted(maps[0], lead.cost, self._theory) if lead else None,
            bound=self._bound,
            complete=self._complete or status is Status.UNSATISFIABLE,
            theory=self._theory,
            steps=len(self._trace),
            prefix=self._solved.steps,
            seconds=Seconds(time.perf_counter() - self._began, 0.0, 0.0),
            stopped=None if self._complete or self._impossible else self._solved.stopped,
            partial=None if maps else self._known,
        )

    def _drop_inconsistent(self) -> None:
        """Where nothing is proven, and there are places and paths, the best rival is one that the checker finds consistent."""
        if self._proven or self._lists_links:
            return
        theory = self._theory.of_steps(0, len(self._trace))
        while self._rivals and check(self._trace, self._rivals[0].explained(), theory):
            del self._rivals[0]

    def _stand(self) -> Standing:
        """How sure the mapper is now."""
        if not self._rivals:
            said = (
                "no map satisfies the axioms"
                if self._impossible
                else "no map of these steps is known yet"
            )
            return Standing(
                False, tuple(what for _, what in self._broke), (Hypothesis(1.0, None, said),)
            )
        lead, rivals = self._rivals[0], self._undecided()
        shares = self._scale(rivals).shares(rivals)
        where = self._located(lead) if self._broke else None
        certain = self._is_decided(rivals, shares) and (
            where is None or self._has_recovered(where, lead)
        )
        standing = Standing(
            certain, tuple(said for _, said in self._broke), self._hypotheses(rivals, shares), where
        )
        if certain:
            self._known, self._localiser = self.solution.maps[0], None
            self._broke.clear()
        return standing

    def _has_recovered(self, where: Belief, lead: Rival) -> bool:
        """Whether something was predicted since the last step that broke, and localisation, too, has the robot where the best map has it, more likely than not."""
        return (
            self._broke[-1][0] < len(self._trace) - 1
            and where.likeliest == lead.here
            and where.probability > 0.5
        )

    def _is_decided(self, rivals: Sequence[Rival], shares: Sequence[float]) -> bool:
        """Whether all minimal maps are known, and they and nearly all that may be true agree on what is from here on, though perhaps not on what was."""
        if not self._complete:
            return False
        lead, minimal = self._rivals[0].future(), self._minimal()
        if any(rival.future() != lead for rival in minimal[1:]):
            return False
        return (
            sum(
                share
                for rival, share in zip(rivals, shares, strict=True)
                if rival.cost == self._least or rival.future() == lead
            )
            >= CERTAIN
        )

    def _hypotheses(
        self, rivals: Sequence[Rival], shares: Sequence[float]
    ) -> tuple[Hypothesis, ...]:
        """The most probable ones, and what is left."""
        order = sorted(range(len(shares)), key=lambda i: -shares[i])
        first = order if len(order) <= TOLD else order[: TOLD - 1]
        told = [Hypothesis(shares[i], rivals[i].explained(), self._said(rivals[i])) for i in first]
        if rest := order[len(first) :]:
            told.append(
                Hypothesis(sum(shares[i] for i in rest), None, f"one of {len(rest)} others")
            )
        return tuple(told)

    def _undecided(self) -> list[Rival]:
        """The rivals that evidence has to decide between. Between those that disbelieve the same the preference of the theory does, as it does where nothing is disbelieved:
        a dstate more than are needed is never refuted."""
        least: dict[frozenset[Fault], tuple[int, ...]] = {}
        for rival in self._rivals:
            faults = frozenset(rival.faults)
            least[faults] = min(least.get(faults, rival.cost), rival.cost)
        return [rival for rival in self._rivals if rival.cost == least[frozenset(rival.faults)]]

    def _said(self, rival: Rival) -> str:
        """What a rival disbelieves that was not disbelieved when the mapper was certain, and where the robot is."""
        new = sorted(set(rival.faults) - self._excused(), key=lambda fault: fault.step)
        faults = ", ".join(str(fault) for fault in new) or "nothing else is disbelieved"
        return f"{faults}; the robot is at dstate {rival.here} of {len(rival.shows)}"

    def _located(self, lead: Rival) -> Belief:
        """Where the robot is in the best map, if it was where this says just before something broke."""
        t = len(self._trace) - 1
        key = (lead.shows, frozenset(lead.links.items()))
        if self._localiser is not None and self._localiser[0] == key:
            _, localiser, belief, after = self._localiser
        else:
            localiser = Localiser(lead.explained(), chances=self._chances)
            after = max(self._broke[0][0] - 1, t - REPLAYED, 0)
            there = np.zeros(len(lead.shows))
            there[lead.labels[after]] = 1.0
            belief = Belief(there, 0.0)
        for i in range(after, t):
            done = self._trace.steps[i].action
            assert done
            belief = localiser.update(belief, done, self._trace.steps[i + 1].view)
        self._localiser = (key, localiser, belief, t)
        return belief
