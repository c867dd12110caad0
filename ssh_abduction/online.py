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

*Proof.* By (1) of the claim in `solver.py`, no map of the longer trace costs less than c. A map that predicts the step costs c, by (2).
Conversely let F be a minimal map of the longer trace. It costs c, and, cut by the last step, is a map R of M, by (3). R does not
contradict the step: actions are deterministic, and a dstate has one observation, by functional_view and the axioms of the stars
(`replay.observation` takes the star as these read it, so another rotation of a pattern is no contradiction). So R predicts the
step, and F is the replayed R, by (3). ∎

Else clingo is asked, in the one control that is kept: for all maps of cost c if some map of M predicts the step, else for the minimum,
which is at least what was proved before. A theory `without` axioms is solved anew, as the claim does not hold.

When time is short
------------------
A map that predicts the step is minimal even if there is no time to look for others. Once there is none, the answer is feasible: a map that
was found and goes on predicting, or else the sketch (`sketch.py`), with the last bound, which holds for the longer trace by (1). clingo is
asked again when the trace is longer by RETRY and PAUSE; it goes on where it was stopped, and may prove a map minimal again.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from ssh_abduction.errors import TraceError, brief
from ssh_abduction.maps import SSHMap
from ssh_abduction.replay import Outcome, observation
from ssh_abduction.sketch import Sketch
from ssh_abduction.solver import Cost, Search, Seconds, Solution, Status
from ssh_abduction.theory import Theory
from ssh_abduction.trace import Action, Step, Trace, View

RETRY = 1.01  # after a search that was stopped, the trace grows by this factor before the next, so that few steps are slow,
PAUSE = 2  # and by so many steps at least


class OnlineMapper:
    """Keeps the minimal maps current while a robot drives. `solution` is the answer for the steps so far.

    view     what is seen at first
    theory   which axioms and which preference; Theory.topological() by default. The first step settles star=auto
    star     the openings seen at first, as in Step, if the theory uses stars
    limit    seconds that a step may take, about: clingo cannot be stopped while it grounds a step. None waits for the exact answer
    maps     keep at most so many maps; 0 keeps all
    """

    def __init__(
        self,
        view: View,
        theory: Theory | None = None,
        *,
        star: Sequence[float] | None = None,
        limit: float | None = 0.5,
        maps: int = 100,
    ) -> None:
        if theory and theory.level == "causal":
            importlib.import_module("ssh_abduction.named")  # now rather than at the step that first needs it, as it takes its time
        began = time.perf_counter()
        first = Step.of(view, star, "step 0")
        theory = theory or Theory.topological()
        self.theory = theory.resolve(Trace((first,)))
        self.searches = 0  # how often clingo was asked
        self._without_stars = theory.star == "auto" and self.theory.star == "none"
        self._limit, self._most = limit, maps
        self._steps = [first]
        self._seen = [observation(first, self.theory)]
        self._actions: dict[str, Action] = {}
        self._status = Status.UNKNOWN
        self._complete = False
        self._cost: Cost | None = None
        self._maps: list[_Replayed] = []
        self._sketches = [Sketch(first, self.theory, homing) for homing in (True, False)]
        self._search: Search | None = None
        self._asked: Solution | None = None  # what it said
        self._next_search = 0  # not before the trace has so many steps
        self._ask()
        self.solution = self._answer(began)

    @property
    def trace(self) -> Trace:
        """The steps so far."""
        return Trace(tuple(self._steps))

    def observe(self, action: Action | str | Mapping[str, Any], view: View, *, star: Sequence[float] | None = None) -> Solution:
        """Take in an action and what was seen then, and say what the minimal maps are now.

        Raises TraceError where the step does not fit theory and trace; the mapper stays as it was.
        """
        began = time.perf_counter()
        action = Action.of(action)
        step = Step.of(view, star, f"step {len(self._steps)}")
        last = replace(self._steps[-1], action=action)
        self._check(action, last, step)
        self._actions[action.name] = action
        self._steps[-1:] = [last, step]
        self._seen.append(observation(step, self.theory))
        if self._status is not Status.UNSATISFIABLE:
            self._replay(action, step)
            if not self._settled() and len(self._steps) >= self._next_search:
                self._ask()
        self.solution = self._answer(began)
        return self.solution

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
            raise TraceError(f"step {n}: star: expected none, as the first step has none; give all steps stars, or take star=none")

    def _replay(self, action: Action, step: Step) -> None:
        """Keep the maps that predict the step."""
        outcomes = [m.follow(action.name, self._seen[-1]) for m in self._maps]
        self._maps = [m for m, outcome in zip(self._maps, outcomes, strict=True) if outcome is Outcome.PREDICTED]
        self._sketches = [s for s in self._sketches if s.extend(action, step)]
        self._complete = self._complete and Outcome.UNKNOWN not in outcomes
        if self.theory.without:
            self._maps = []
        if not self._maps:
            if self._status is Status.OPTIMAL:
                self._next_search = 0  # the cost was proven, so the next one may be
            self._status, self._complete = Status.UNKNOWN, False

    def _settled(self) -> bool:
        """Whether clingo could add nothing."""
        return self._status is Status.OPTIMAL and (self._complete or len(self._maps) == self._most)

    def _ask(self) -> None:
        """Let clingo say what the minimal maps are, or the best map it finds in time."""
        self.searches += 1
        known = self._maps[0].map() if self._status is Status.OPTIMAL else None
        search = Search(self.trace, self.theory, limit=self._limit, maps=self._most, after=self._search, minimal=known)
        found = tuple(search)
        self._search = search
        steps = len(self._steps)
        self._next_search = max(steps + PAUSE, int(RETRY * steps)) if search.stopped in ("time limit", "interrupted") else 0
        self._asked = search.solution()
        cost = self._asked.cost
        if search.status in (Status.OPTIMAL, Status.UNSATISFIABLE) or self._is_better(cost):
            self._status, self._complete, self._cost = search.status, search.complete, cost
            if len(found) >= len(self._maps) or known is None:
                self._maps = [_Replayed(m, self._seen) for m in found]

    def _is_better(self, cost: Cost | None) -> bool:
        """Whether a map of this cost comes before the feasible one that we have."""
        if cost is None or not self._maps or self._cost is None:
            return cost is not None
        return next((getattr(cost, c) < x for c in self.theory.priorities if (x := getattr(self._cost, c)) != getattr(cost, c)), False)

    def _answer(self, began: float) -> Solution:
        assert self._search is not None
        assert self._asked is not None
        status, cost, maps = self._status, self._cost, tuple(m.map() for m in self._maps)
        if status is Status.UNKNOWN and self._sketches:
            maps = (self._sketches[0].map(),)
            status, cost = Status.FEASIBLE, Cost.of(maps[0])
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
            evidence=last.evidence,
            seconds=Seconds(time.perf_counter() - began, last.seconds.ground if asked else 0.0, last.seconds.solve if asked else 0.0),
            stopped=None if self._complete else self._search.stopped,
        )


class _Replayed:
    """A map, with the labels of the steps that it has predicted since."""

    def __init__(self, ssh_map: SSHMap, seen: Sequence[object]) -> None:
        self._map = ssh_map
        self._labels = list(ssh_map.labels)
        self._links = {(s, action): x for s, action, x in ssh_map.links}
        self._sights = dict(zip(self._labels, seen, strict=True))

    def follow(self, action: str, seen: object) -> Outcome:
        """What the map says of a step."""
        there = self._links.get((self._labels[-1], action))
        if there is None:
            return Outcome.UNKNOWN
        if self._sights[there] != seen:
            return Outcome.CONTRADICTED
        self._labels.append(there)
        return Outcome.PREDICTED

    def map(self) -> SSHMap:
        """The map of all steps so far."""
        return replace(self._map, labels=tuple(self._labels))
