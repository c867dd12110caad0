"""The minimal maps of a trace that grows, kept current step by step while the robot drives.

>>> from ssh_abduction import OnlineMapper, Theory
>>> mapper = OnlineMapper("end", Theory.topological())
>>> for action, view in [("travel", "hall"), ("travel", "end"), ("around", "end"), ("travel", "hall")]:
...     solution = mapper.observe(action, view)
>>> solution.status.value, solution.count, solution.cost.dstates, solution.complete
('optimal', 2, 5, True)

Most steps are replayed, without asking clingo
----------------------------------------------
Let M be all minimal maps of the steps so far, of cost c. A new step is PREDICTED by a map that knows the action in the dstate that the
robot is in, and shows there what is seen; CONTRADICTED, if it shows something else; UNKNOWN, if the action was never tried there.

*Claim.* If some map of M predicts the step and none finds it unknown, the ones that predict it are all minimal maps of the longer trace.

*Proof.* By (1) of the claim in `solver/search.py`, no map of the longer trace costs less than c. A map that predicts the step costs c, by
(2). Conversely let F be a minimal map of the longer trace. It costs c, and, cut by the last step, is a map R of M, by (3). R does not
contradict the step: actions are deterministic, and a dstate has one observation, by functional_view and the axioms of the stars
(`log.observation` takes the star as these read it, so another rotation of a pattern is no contradiction). So R predicts the step, and F is
the replayed R, by (3). ∎

Else clingo is asked, in the one control that is kept: for all maps of cost c if some map of M predicts the step, else for the minimum,
which is at least what was proved before. A theory for which prefixes are not exact (`theory/speedups.py`) is solved anew at each step.

*Evidence* may say of the new step that it is not where a map predicts it, or that it cannot be there together with other returns. Such a map is contradicted,
too, and the proof stays the same: what evidence says of fewer steps, it says of more. So only returns to the new step are asked about.

A theory that the trace unsettles
---------------------------------
Two things are settled by the whole trace, and so may change as it grows. Displacements are used from the first one on, and then places are preferred to
paths; and the chance to refuse a true map is shared among as many returns as may be true, a number that is rounded up to a power of two. Where that changes, minimal
maps of fewer steps need not be so any more: they are sought anew, which happens for each doubling of that number once. Then less is refused, so
maps of the steps before go on as drafts.

When time is short
------------------
A map that predicts the step is minimal even if there is no time to look for others. Once there is none, the answer is feasible: the last
bound, which holds for the longer trace by (1), and a map. That is a map of fewer steps that goes on like a sketch (`guesses/tree.py`), and
that the checker finds consistent; or a sketch of all steps. Where places have frames, a map that is
contradicted is mended: what does not fit is something new. clingo is asked again when the trace is longer by RETRY and PAUSE; it goes on
where it was stopped, and may prove a map minimal again.

Where places have frames, and there is a second processor, maps are made of guesses meanwhile (`online/background_guess.py`), one after another,
in a process of their own, and mended there where that takes longer than a step may.

Where faults are allowed
------------------------
Then `recovery.py` keeps the maps. What contradicts all of them does not end the run: it says what broke, keeps a belief over what may be true, and restores the map. `standing` says how sure it is.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any

from ssh_abduction.checker.checker import check, unchecked
from ssh_abduction.data.deprecated import renamed_parameters
from ssh_abduction.data.errors import TheoryError, TraceError, brief
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.odometry import Odometry
from ssh_abduction.data.trace import Action, Step, Trace, View
from ssh_abduction.solver import (
    AT_ONCE,
    Cost,
    Judging,
    Outcome,
    Search,
    Seconds,
    Sketch,
    Solution,
    Status,
    check_limit,
    observation,
)
from ssh_abduction.theory.evidence import NO_PAIRS, Pairs, evidence_of, pairs_of, said_by
from ssh_abduction.theory.evidence.displacement import count_returns
from ssh_abduction.theory.speedups import ALL, Speedups, checked_speedups, row
from ssh_abduction.theory.theory import Theory, checked_theory

if TYPE_CHECKING:
    from ssh_abduction.online.background_guess import MapGuess
    from ssh_abduction.online.recovery import Recovery, Standing

# After a search that was stopped the trace grows by this factor before the next one, so that few steps are slow.
RETRY = 1.01
# And it grows by so many steps at least.
PAUSE = 2
# So many maps of fewer steps go on like sketches, at most: each takes its time at every step, and mostly one of the first goes on for long.
DRAFTS = 3
# From so many steps on maps are guessed; before, clingo is in time.
GUESSED = 100
# So many seconds it takes to mend a map, about, times the square of the number of steps, before it was measured here.
MENDING = 5e-7
# The trace grows by this factor before the next guess, which takes seconds, and is not much better for few steps more.
GUESS_AGAIN = 1.05


class OnlineMapper:
    """Keeps the minimal maps current while a robot drives. `solution` is the answer for the steps so far.

    view     what is seen at first
    theory   which axioms and which preference; Theory.topological() by default. With faults (misread, slipped) `standing` says how sure the map is. The first step settles star=auto, the first displacement displacement=auto
    star     the openings seen at first, as in Step, if the theory uses stars
    confidence  how probable it is that what is seen at first is right, as in Step, where faults are allowed
    odometry  how far displacements that come without a covariance may be off, as in Trace; None for the defaults
    limit    seconds that a step may take, about: clingo cannot be stopped while it grounds a step. None waits for the exact answer
    max_maps keep at most so many maps; None keeps all
    speedups  what makes solving fast, as for Search
    """

    @renamed_parameters("limit", "maps")
    def __init__(
        self,
        view: View,
        theory: Theory | None = None,
        *,
        star: Sequence[float] | None = None,
        confidence: float | None = None,
        odometry: Odometry | Mapping[str, Any] | None = None,
        time_limit: float | None = 0.5,
        max_maps: int | None = 100,
        speedups: Speedups = ALL,
    ) -> None:
        first = replace(Step.of(_known(view, 0), star, "step 0"), confidence=confidence)
        theory = checked_theory(theory)
        if theory.jumped:
            raise TheoryError(
                "jumped: expected displacements that hold while a robot drives; leave it out, and give no displacement at a step where the odometry is lost"
            )
        check_limit("time_limit", "seconds", time_limit)
        checked_speedups(speedups)
        self._odometry = None if odometry is None else Odometry.of(odometry)
        self.trace = Trace((first,), odometry=self._odometry)  # the steps so far
        settled = theory.replace(displacement="none").resolve(
            self.trace
        )  # of displacements the first step says nothing
        self._without_stars = theory.star == "auto" and settled.star == "none"
        self._unsettled = theory.replace(star=settled.star)
        self._steps = [first]
        self._actions: dict[str, Action] = {}
        self._limit, self._most, self._speedups = time_limit, max_maps, speedups
        self._recovery: Recovery | None = None
        if theory.has_faults:
            from ssh_abduction.online.recovery import Recovery  # loads numpy

            self.theory = self._settled_theory()
            self._recovery = Recovery(
                self.trace, self.theory, time_limit=time_limit, max_maps=max_maps, speedups=speedups
            )
            self.solution = self._recovery.solution
            return
        if (
            theory.level == "causal"
        ):  # now rather than at the step that first needs it, as it takes its time
            importlib.import_module("ssh_abduction.solver.engines.causal")
        elif row("visits").holds_for(settled):
            importlib.import_module("ssh_abduction.online.background_guess")
        began = time.perf_counter()
        self._searches = 0
        self._seen = [observation(first, settled)]
        self._guess: MapGuess | None = None
        self._next_guess = GUESSED  # not before the trace has so many steps
        self._mending = MENDING  # seconds, by the square of the number of steps
        self._begin_with(self._settled_theory())
        self._ask()
        self.solution = self._answer(began)

    @property
    def searches(self) -> int:
        """How often clingo was asked."""
        return self._recovery.searches if self._recovery else self._searches

    @property
    def standing(self) -> Standing:
        """How sure the map is, what broke, and what may be true. Raises TheoryError where the theory has no faults: `solution` says all then."""
        if self._recovery is None:
            raise TheoryError(
                "theory: expected faults, as without them nothing is disbelieved, got none; take misread or slipped, or read the solution"
            )
        return self._recovery.standing

    def _begin_with(self, theory: Theory) -> None:
        """Begin anew, with nothing known of the maps of the steps so far but sketches."""
        self.theory = theory
        self._evidence = evidence_of(theory)
        # What evidence says is asked of evidence itself, as sketches grow; of all else they are certain, or the checker is asked.
        self._without_evidence = theory.replace(
            without=(*theory.without, *(kind.axiom for kind in self._evidence))
        )
        self._replays = row("prefixes").holds_for(theory)
        self._may_mend = row("visits").holds_for(theory)
        self._may_sketch = self._replays and not unchecked(theory)
        self._trusts_sketches = row("certain sketches").holds_for(self._without_evidence)
        self._pairs = NO_PAIRS
        self._status = Status.UNKNOWN
        self._complete = False
        self._cost: Cost | None = None
        self._maps: list[_Replayed] = []
        self._drafts: list[_Draft] = []  # beyond maps of fewer steps, the best first
        self._sketches = [_Draft(sketch) for sketch in Sketch.all_of(self._steps[0], theory)]
        for before, step in pairwise(self._steps):
            assert before.action
            self._sketches = [
                draft for draft in self._sketches if draft.sketch.extend(before.action, step)
            ]
        self._search: Search | None = None
        self._asked: Solution | None = None  # what it said
        self._next_search = 0  # not before the trace has so many steps
        self._judging = Judging(self.trace, theory)
        self._spent = 0.0  # seconds that all steps took since

    def _settled_theory(self) -> Theory:
        """The theory as the trace so far settles it."""
        theory = self._unsettled
        if theory.displacement == "auto":
            theory = theory.replace(displacement="use" if self.trace.has_displacements else "none")
        if theory.displacement == "use" and not theory.returns:
            theory = theory.replace(returns=count_returns(self.trace, theory))
        return theory.resolve(self.trace.prefix(1))

    def _is_settled(self) -> bool:
        """Whether the theory is still as the trace so far settles it."""
        if self.theory.displacement == "none":
            return self._unsettled.displacement == "none" or self._steps[-1].displacement is None
        return bool(self._unsettled.returns) or self.theory.returns == count_returns(
            self.trace, self.theory
        )

    def __repr__(self) -> str:
        cost = self.solution.cost
        return f"<OnlineMapper: {len(self._steps)} steps, {self.solution.status.value}, {cost.dstates if cost else 'no'} dstates>"

    def observe(
        self,
        action: Action | str | Mapping[str, Any],
        view: View,
        *,
        star: Sequence[float] | None = None,
        displacement: Sequence[float] | None = None,
        covariance: Sequence[Sequence[float]] | None = None,
        confidence: float | None = None,
    ) -> Solution:
        """Take in an action and what was seen then, and say what the minimal maps are now.

        displacement  [dx, dy, dtheta] of the action, in metres and radians, as in Step; None where it is not known
        covariance    of the displacement, (3, 3); None where the odometry tells it
        confidence    how probable it is that the view, and the star, are right, as in Step; it scales what it costs to disbelieve them

        Raises TraceError where the step does not fit theory and trace; the mapper stays as it was.
        """
        began = time.perf_counter()
        done = Action.of(action)
        step = Step.of(
            _known(view, len(self._steps)),
            star,
            f"step {len(self._steps)}",
            displacement=displacement,
            covariance=covariance,
        )
        step = replace(step, confidence=confidence)
        self._take(done, step, began)
        self.solution = self._recovery.solution if self._recovery else self._answer(began)
        return self.solution

    def _take(self, action: Action, step: Step, began: float) -> None:
        """Take in a step."""
        last = replace(self._steps[-1], action=action)
        self._check(action, last, step)
        self._actions[action.name] = action
        self._steps[-1:] = [last, step]
        self.trace = Trace(tuple(self._steps), odometry=self._odometry)
        if self._recovery:
            self.theory = self.theory if self._is_settled() else self._settled_theory()
            self._recovery.take(self.trace, self.theory, began)
            return
        self._seen.append(observation(step, self.theory))
        known = self.solution.maps[0] if self._maps or self._drafts else None
        if self._is_settled():
            if self._status is Status.UNSATISFIABLE and self._replays:
                return
            self._replay(action, step)
        else:
            self._settle_anew()
        if not self._settled() and len(self._steps) >= self._next_search:
            self._ask()
        self._absorb_guess()
        if self._may_guess():
            contradicted = known if not self._drafts else None
            mended = contradicted is not None and self._mend(contradicted, began)
            if (
                not self._guess
                and not mended
                and (contradicted or len(self._steps) >= self._next_guess)
            ):
                self._begin_guess(contradicted)

    def _settle_anew(self) -> None:
        """Begin anew, with the theory that the trace so far settles. Maps of the steps before go on as drafts, if they were judged by displacements, too."""
        uses, steps = self.theory.displacement == "use", len(self._steps) - 1
        known = [m.map() for m in self._maps[:DRAFTS]] + [
            draft.sketch.map() for draft in self._drafts
        ]
        self._begin_with(self._settled_theory())
        self._pairs = pairs_of(self.trace, self.theory)
        for ssh_map in known if uses else ():
            self._draft(ssh_map, steps)
        if not uses:
            self._guess = None

    def _check(self, action: Action, last: Step, step: Step) -> None:
        """Whether a step fits the theory and the steps before."""
        n = len(self._steps)
        known = self._actions.get(action.name, action)
        if known != action:
            raise TraceError(
                f"step {n - 1}: action: {brief(action.name)} has kind {action.kind}, turn {action.turn} here but kind {known.kind}, "
                f"turn {known.turn} before; give the two different names, or the same kind"
            )
        self.theory.require(last, f"step {n - 1}")
        self.theory.require(step, f"step {n}")
        if self._without_stars and step.star is not None:
            raise TraceError(
                f"step {n}: star: expected none, as the first step has none; give all steps stars, or take star=none"
            )

    def _replay(self, action: Action, step: Step) -> None:
        """Keep the maps that predict the step."""
        self._pairs = pairs_of(self.trace, self.theory)
        outcomes = [self._outcome(m, action) for m in self._maps]
        lost = [
            m for m, outcome in zip(self._maps, outcomes, strict=True) if outcome is Outcome.UNKNOWN
        ]
        self._maps = [
            m
            for m, outcome in zip(self._maps, outcomes, strict=True)
            if outcome is Outcome.PREDICTED
        ]
        self._drafts = [draft for draft in self._drafts if draft.sketch.extend(action, step)]
        self._sketches = [draft for draft in self._sketches if draft.sketch.extend(action, step)]
        self._complete = self._complete and Outcome.UNKNOWN not in outcomes
        if not self._replays:
            self._maps = []
        if not self._maps:
            if self._status is Status.OPTIMAL:
                self._next_search = 0  # the cost was proven, so the next one may be
            self._status, self._complete = Status.UNKNOWN, False
            for m in lost[:DRAFTS]:
                self._draft(m.map(), len(self._steps) - 1)

    def _outcome(self, replayed: _Replayed, action: Action) -> Outcome:
        """What a map and evidence say of the last step."""
        outcome = replayed.follow(action.name, self._seen[-1], self._pairs)
        if outcome is Outcome.PREDICTED and not self._judging.allows_grown(
            self.trace, replayed.map(), len(self._steps) - 1
        ):
            return Outcome.CONTRADICTED
        return outcome

    def _draft(self, ssh_map: SSHMap, steps: int) -> None:
        """Let a map of so many steps go on like a sketch, unless it contradicts the steps since."""
        if not self._may_sketch:
            return
        sketch = Sketch.beyond(ssh_map, self.trace.prefix(steps), self.theory)
        since = zip(self._steps[steps - 1 :], self._steps[steps:], strict=False)
        if all(sketch.extend(before.action, step) for before, step in since if before.action):
            self._drafts = sorted([*self._drafts, _Draft(sketch)], key=self._rank)[:DRAFTS]

    def _mend(self, ssh_map: SSHMap, began: float) -> bool:
        """Let a map of fewer steps that the last ones contradict go on, with what does not fit as something new. False where there is no time for that."""
        assert self._limit is not None
        steps, now = len(self._steps), time.perf_counter()
        if now - began + self._mending * steps**2 > self._limit:
            return False
        from ssh_abduction.online.background_guess import mended_map  # loads numpy

        mended = mended_map(self.trace, self.theory, ssh_map, self._speedups)
        self._mending = (time.perf_counter() - now) / steps**2
        if mended:
            self._draft(mended, steps)
        return True

    def _rank(self, draft: _Draft) -> tuple[int, ...]:
        return Cost.of(draft.sketch.map()).preferred_by(self.theory)

    def _may_guess(self) -> bool:
        """Whether a small map is wanted, and the steps are not too many to be compared in pairs."""
        return (
            self._status is Status.UNKNOWN
            and self._limit is not None
            and self._may_mend
            and len(self._steps) <= AT_ONCE
        )

    def _absorb_guess(self) -> None:
        """Take the map that came of a guess."""
        if self._guess and self._guess.done():
            guess, self._guess = self._guess, None
            found = guess.map()
            if found and self._status is Status.UNKNOWN:
                self._draft(found, len(found.labels))

    def _begin_guess(self, known: SSHMap | None) -> None:
        """Begin a guess where no map is known to be minimal, or let a map that is contradicted be mended."""
        from ssh_abduction.online.background_guess import MapGuess  # loads numpy

        if not known:
            self._next_guess = int(GUESS_AGAIN * len(self._steps))
        self._guess = MapGuess.begun(
            self._steps, self._odometry, self.theory, self._speedups, known
        )

    def _settled(self) -> bool:
        """Whether clingo could add nothing."""
        return self._status is Status.OPTIMAL and (self._complete or len(self._maps) == self._most)

    def _ask(self) -> None:
        """Let clingo say what the minimal maps are, or the best map it finds in time."""
        self._searches += 1
        known = self._maps[0].map() if self._status is Status.OPTIMAL else None
        search = Search(
            self.trace,
            self.theory,
            time_limit=self._limit,
            max_maps=self._most,
            speedups=self._speedups,
            after=self._search,
            minimal=known,
        )
        found = tuple(search.unranked())  # as that takes longer than a step may
        self._search = search
        steps = len(self._steps)
        self._next_search = (
            max(steps + PAUSE, int(RETRY * steps))
            if search.stopped in ("time limit", "interrupted")
            else 0
        )
        self._asked = search.solution()
        if search.status in (Status.OPTIMAL, Status.UNSATISFIABLE) or not self._replays:
            self._status, self._complete, self._cost = (
                search.status,
                search.complete,
                self._asked.cost,
            )
            self._drafts = []
            if len(found) >= len(self._maps) or known is None:
                self._maps = [_Replayed(m, self._seen) for m in found]
        elif found:
            self._draft(found[0], steps)

    def _answer(self, began: float) -> Solution:
        assert self._search is not None
        assert self._asked is not None
        status, cost, maps = self._status, self._cost, tuple(m.map() for m in self._maps)
        if status is Status.UNKNOWN and (draft := self._best_draft()):
            maps = (draft.sketch.map(),)
            status, cost = Status.FEASIBLE, Cost.of(maps[0])
        self._spent += time.perf_counter() - began
        if maps and self._judging.has_time_for(len(self._steps), self._spent):
            self._judging.pass_grown_map(self.trace, maps[0])
        last = self._asked
        asked = last.steps == len(self._steps)
        return Solution(
            status=status,
            maps=maps,
            cost=cost if maps else None,
            bound=self._search.bound,
            complete=self._complete,
            theory=self.theory,
            steps=len(self._steps),
            prefix=self._search.prefix,
            basis=last.basis,
            seconds=Seconds(
                time.perf_counter() - began,
                last.seconds.ground if asked else 0.0,
                last.seconds.solve if asked else 0.0,
            ),
            stopped=None if self._complete else self._search.stopped,
            evidence=said_by(
                self._evidence,
                self.trace,
                {name: said["refused"] for name, said in last.evidence.items()},
            ),
        )

    def _best_draft(self) -> _Draft | None:
        """The best draft that is consistent, or else a sketch of all steps, if there is one."""
        while self._drafts:
            if self._is_consistent(self._drafts[0]):
                return self._drafts[0]
            del self._drafts[0]
        return next(filter(self._is_consistent, self._sketches), None) if self._may_sketch else None

    def _is_consistent(self, draft: _Draft) -> bool:
        """Whether a draft is consistent: by evidence, and else as it is made so, or by the checker."""
        sketch, steps = draft.sketch, len(self._steps)
        if self._evidence and draft.passed < steps:
            ssh_map = sketch.map()
            place_of = [s.place for s in ssh_map.dstates]
            if not all(
                self._pairs.allow(t, sketch.labels, place_of) for t in range(draft.passed, steps)
            ):
                return False
            if not self._judging.allows_grown(self.trace, ssh_map, draft.passed):
                return False
            draft.passed = steps
        if not sketch.certain or not self._trusts_sketches:
            sketch.certain = not check(self.trace, sketch.map(), self._without_evidence)
        return sketch.certain


def _known(view: View, step: int) -> View:
    """The view of a step. Raises TraceError where it is unknown: only a whole trace may have such steps."""
    if view is None:
        raise TraceError(
            f"step {step}: view: expected one while a robot drives, got none; log the trace, and solve it as a whole"
        )
    return view


@dataclass(slots=True)
class _Draft:
    """A sketch, and how many of its first steps make a map that no evidence refuses."""

    sketch: Sketch
    passed: int = 0


class _Replayed:
    """A map, with the labels of the steps that it has predicted since."""

    def __init__(self, ssh_map: SSHMap, seen: Sequence[object]) -> None:
        self._map = ssh_map
        self._place_of = [s.place for s in ssh_map.dstates]
        self._labels = list(ssh_map.labels)
        self._links = {(s, action): x for s, action, x in ssh_map.links}
        self._sights = dict(zip(self._labels, seen, strict=True))

    def follow(self, action: str, seen: object, pairs: Pairs) -> Outcome:
        """What the map says of a step, and what evidence says of the pairs of this step with earlier ones."""
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
