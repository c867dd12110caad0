"""A robot that explores: it does what tells its rival maps apart, until one map is left, nothing in it is untried, and no return in it is in doubt.

    see  ->  minimal maps of all that was seen  ->  next experiment  ->  do its actions  ->  see …

The maps are kept by `OnlineMapper`. A new experiment is sought when the last one is done, and when clingo was asked or rivals were refuted:

1. Where known links tell minimal maps apart, the actions that do (explore.py).
2. Else the shortest tour through all that is untried in the first of them (tour.py), which looks around where it comes back to and not at once.
3. Else what minimal maps say something different of.
4. Else what tells the map from one in which a return is none.

When it is done
---------------
1. *Unique.* All minimal maps have the same dstates and the same places; they differ in paths at most.
2. *Closed.* At each dstate that it can get to, each action that the robot can do there was tried, or the axioms imply its end.
3. *Beyond doubt.* A minimal map may still have too few dstates, as it takes for one whatever may be one. So each return of the map is doubted: the best map in which the two visits are not at one place, or,
   by the causal theory, the two steps are not one dstate, is a rival too if it has up to `margin` dstates more. An experiment tells it from the minimal map, and then the doubt is weighed again. What such a map
   costs at least can only grow with the trace, so a doubt that was dispelled stays so until the minimal maps themselves have more dstates.

Where no experiment tells such a rival from the minimal map, either both are the same map from here on, and differ in where the robot was at first: that is no doubt. Or the rival is another map, as closed as the minimal
one, which predicts the same for ever: a symmetric world has such maps. Then the exploration ends as `inseparable`, and not as `done`.

That is no proof that the map is true, as nothing is: a world may hide more dstates than `margin`, and of the rivals that deny a return only the best is looked at. How often it is true is measured (docs/exploring.md).
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal, Protocol, TypeAlias

from ssh_abduction.data.checks import a_function
from ssh_abduction.data.deprecated import renamed_parameters
from ssh_abduction.data.errors import TheoryError, TraceError, brief, is_whole
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Action, Step, Trace
from ssh_abduction.data.words import counted
from ssh_abduction.evaluation import evaluate
from ssh_abduction.online.mapper import OnlineMapper
from ssh_abduction.rivals.explore import Experiment, next_experiment
from ssh_abduction.rivals.machines import Seen
from ssh_abduction.rivals.tour import next_tour
from ssh_abduction.solver import Solution, Status, check_limit, solve
from ssh_abduction.theory.theory import Theory, checked_theory

# Where nothing is left to do, but the map is not proven minimal, so many times the limit of a step are spent on it.
LONGER = 5

# Dstates that a place may show, and still be another one than the map takes it for, as a robot drives on: as many as places with four sides have.
DOUBTED = 4

Doubt: TypeAlias = tuple[int, int]  # two steps, which are at one place in the map, or at one dstate
Ending: TypeAlias = Literal["done", "inseparable", "steps", "time", "contradicted"]
_ENDINGS: dict[Ending, str] = {
    "done": "one map is left, nothing in it is untried, and no return in it is in doubt",
    "inseparable": "several maps are left, and nothing that the robot can do tells them apart",
    "steps": "its steps are spent",
    "time": "there was no time to prove which maps are minimal, or to weigh a doubt",
    "contradicted": "no map explains what was seen",
}


class Robot(Protocol):
    """What an explorer drives."""

    def look(self) -> Step:
        """What is seen here: a view, and perhaps a star, the displacement since the last look, and, in simulation, the truth, which the explorer does not go by."""

    def can(self) -> Collection[Action | str]:
        """What the robot can do here. Places that look alike are expected to let it do the same."""

    def do(self, action: Action) -> None:
        """Do this."""


@dataclass(frozen=True, slots=True)
class Exploration:
    """What an explorer has found out.

    steps      how many actions were done
    ending     why it ended. done: one map is left, nothing in it is untried, and no return is in doubt; inseparable: nothing that the robot can do tells the rivals apart that are left, or the minimal map from `rival`; steps: the steps that it
               was given are spent; time: there was no time to prove which maps are minimal, or to weigh a doubt; contradicted: no map explains what was seen
    is_unique  whether all minimal maps have the same dstates, and the same places: they differ in paths at most
    is_true    whether it is unique and true, as far as it was driven: its dstates and places are those that the robot's looks tell as truth. None where they tell none
    solution   the minimal maps of all that was seen
    rival      a map with more dstates that explains all, too, is closed, and predicts the same for ever, if one was found: then the minimal map may be unique, and the world a larger one
    """

    steps: int
    ending: Ending
    is_unique: bool
    is_true: bool | None
    solution: Solution
    rival: SSHMap | None = None

    @property
    def sentence(self) -> str:
        """What came of it, in a few words."""
        truth = (
            {None: "", True: ", and true", False: ", and not true"}[self.is_true]
            if self.is_unique
            else ""
        )
        why = _ENDINGS[self.ending]
        if self.is_unique and self.rival:
            more = len(self.rival.dstates) - len(self.solution.maps[0].dstates)
            why = f"a map with {counted(more, 'dstates')} more explains all, too, and nothing that the robot can do tells them apart"
        return f"after {counted(self.steps, 'steps')} the map is {'' if self.is_unique else 'not '}unique{truth}: {why}"

    def to_dict(self) -> dict[str, Any]:
        told = {name: getattr(self, name) for name in ("steps", "ending", "is_unique", "is_true")}
        told["rival"] = self.rival.to_dict() if self.rival else None
        return {**told, "summary": self.sentence, "solution": self.solution.to_dict()}


class Explorer:
    """Drives a robot until its minimal map is unique, closed, and beyond doubt.

    robot   what it drives
    theory  which axioms and which preference; Theory.topological() by default
    margin  a return is in doubt while some map without it has up to so many dstates more; 0 doubts nothing
    limit   seconds that a step, and the weighing of one doubt, may take, about; None waits for exact answers
    maps    keep at most so many maps

    Raises TraceError where the robot's looks do not fit the theory, TheoryError for a theory with faults.

    >>> from ssh_abduction import Explorer, Theory
    >>> from ssh_abduction.data import Step
    >>> class Ring:
    ...     at = 0
    ...     def look(self):
    ...         return Step(["door", "wall", "wall", "lamp"][self.at], truth=self.at)
    ...     def can(self):
    ...         return ["on"]
    ...     def do(self, action):
    ...         self.at = (self.at + 1) % 4
    >>> print(Explorer(Ring(), Theory.causal()).explore(100).sentence)
    after 7 steps the map is unique, and true: one map is left, nothing in it is untried, and no return in it is in doubt
    """

    @renamed_parameters("limit", "maps")
    def __init__(
        self,
        robot: Robot,
        theory: Theory | None = None,
        *,
        margin: int = 2,
        time_limit: float | None = 2.0,
        max_maps: int | None = 100,
    ) -> None:
        if not is_whole(margin) or margin < 0:
            raise TraceError(
                f"margin: expected a number of dstates, 0 or more, got {brief(margin)}"
            )
        check_limit("time_limit", "seconds", time_limit)
        for name in ("look", "can", "do"):
            a_function(
                f"robot.{name}",
                getattr(robot, name, None),
                TraceError,
                what="a method of the robot",
            )
        if theory is not None and checked_theory(theory).has_faults:
            raise TheoryError(
                "theory: expected one without faults, as what contradicts all maps ends an exploration, got misread or slipped; leave them out"
            )
        self._robot, self._margin, self._limit, self._most = robot, margin, time_limit, max_maps
        first = self._look()
        assert first.view is not None
        self.mapper = OnlineMapper(
            first.view,
            theory,
            star=first.star,  # type: ignore[arg-type]
            time_limit=time_limit,
            max_maps=max_maps,
        )
        self._truths = [first.truth]
        self._actions: dict[str, Action] = {}  # all that it was ever able to do
        self._abilities: dict[
            tuple[object, object], set[str]
        ] = {}  # what it can do wherever it sees this
        self._longer: Solution | None = (
            None  # the answer for all steps, where the mapper had too little time for it
        )
        self._plan: list[str] = []
        self._least: dict[
            Doubt, int
        ] = {}  # how many dstates a map has at least in which two steps are not where the map says
        self._undecided: set[Doubt] = set()  # doubts of which nothing was found out in time
        self._twins: dict[
            Doubt, SSHMap
        ] = {}  # rivals with few dstates more that nothing tells apart from the minimal map
        self._stuck = False  # nothing was left to do when it was last asked
        self._note(first)

    def __repr__(self) -> str:
        return f"<Explorer: {counted(len(self.trace) - 1, 'steps')}, {counted(self.solution.count, 'maps')}>"

    @property
    def trace(self) -> Trace:
        """All that was seen and done, with the truth that the robot's looks tell."""
        trace = self.mapper.trace
        return replace(
            trace,
            steps=tuple(
                replace(step, truth=truth)
                for step, truth in zip(trace.steps, self._truths, strict=True)
            ),
        )

    @property
    def solution(self) -> Solution:
        """The minimal maps of all that was seen; or the best map, where there was no time for more."""
        return self._longer or self.mapper.solution

    def explore(self, steps: int) -> Exploration:
        """Do so many actions at most, and say what was found out."""
        if not is_whole(steps) or steps < 0:
            raise TraceError(f"steps: expected a number of actions, 0 or more, got {brief(steps)}")
        while steps > 0 and self.step():
            steps -= 1
        if steps == 0 and not self._stuck:
            self._stuck = not self._planned()
        return self.result

    def step(self) -> bool:
        """Do one action. False where nothing is left to do, or there is no map to go by."""
        self._stuck = not self._planned()
        if self._stuck:
            return False
        action = self._able[self._plan.pop(0)]
        asked, known = self.mapper.searches, self.mapper.solution.count
        self._robot.do(action)
        seen = self._look()
        assert seen.view is not None
        self.mapper.observe(
            action,
            seen.view,
            star=seen.star,  # type: ignore[arg-type]
            displacement=seen.displacement,
            covariance=seen.covariance,
        )
        self._truths.append(seen.truth)
        self._note(seen)
        if self.mapper.searches > asked or self.mapper.solution.count != known:
            self._plan = []
            for doubt in (*self._twins, *self._undecided):
                self._least.pop(doubt, None)
            self._twins, self._undecided = {}, set()
        self._longer = None
        return True

    @property
    def result(self) -> Exploration:
        """What was found out so far."""
        solution = self.solution
        unique = _is_unique(solution)
        rival = next(iter(self._twins.values()), None)
        return Exploration(
            len(self.trace) - 1,
            self._ending(unique),
            unique,
            self._is_true(unique),
            solution,
            rival,
        )

    def _ending(self, unique: bool) -> Ending:
        if self.solution.status is Status.UNSATISFIABLE:
            return "contradicted"
        if not self._stuck:
            return "steps"
        if self.solution.status is not Status.OPTIMAL or self._undecided:
            return "time"
        if self._twins:
            return "inseparable"
        return "done" if unique else "inseparable" if self.solution.complete else "time"

    def _is_true(self, unique: bool) -> bool | None:
        if all(truth is None for truth in self._truths):
            return None
        if not unique:
            return False
        found = evaluate(self.solution.maps, self.trace).maps
        return all(
            said.dstates_right is not False and said.places_right is not False for said in found
        )

    def _look(self) -> Step:
        seen = self._robot.look()
        if not isinstance(seen, Step) or seen.view is None:
            raise TraceError(
                f"look: expected a Step with a view, got {brief(seen)}; let the robot say what it sees, as in Step('hall')"
            )
        return seen

    def _note(self, seen: Step) -> None:
        """Note what the robot can do here."""
        self._able = {action.name: action for action in map(Action.of, self._robot.can())}
        self._actions |= self._able
        for star in {seen.star, None}:
            self._abilities.setdefault((seen.view, star), set(self._able)).intersection_update(
                self._able
            )

    def _can(self, seen: Seen) -> set[str]:
        return self._abilities.get((seen.view, seen.star)) or self._abilities.get(
            (seen.view, None), set()
        )

    def _planned(self) -> bool:
        """Whether there is a next action, which is the first one of the plan then."""
        if self._plan and self._plan[0] not in self._able:
            self._plan = []
        if not self._plan and self.solution.maps:
            self._plan = list(self._next_plan())
        return bool(self._plan) and self._plan[0] in self._able

    def _next_plan(self) -> tuple[str, ...]:
        """The actions of the next experiment: between minimal maps, or with what is untried; else with a return that is in doubt."""
        maps = list(self.solution.maps)
        found = self._experiment(maps)
        if not found.plan.branches and (tour := self._tour(maps[0])):
            return tour
        if not found.actions and not (
            self.solution.status is Status.OPTIMAL and self.solution.complete
        ):
            longer = None if self._limit is None else LONGER * self._limit
            self._longer = solve(
                self.mapper.trace, self.mapper.theory, time_limit=longer, max_maps=self._most
            )
            if self._longer.maps:
                found = self._experiment(list(self._longer.maps))
        if found.actions or not self._margin or not self.solution.maps:
            return found.actions
        best = self.solution.maps[0]
        for doubt in self._doubts(best):
            for rival in self._without(doubt, len(best.dstates)):
                experiment = self._experiment([best, rival])
                if experiment.actions:
                    return experiment.actions
                if len(experiment.alike) > 1:
                    self._twins[doubt] = rival
                self._least[doubt] = (
                    len(best.dstates) + self._margin + 1
                )  # from here on the two are one map, which differ in the past, or nothing tells them apart
        return ()

    def _experiment(self, maps: list[SSHMap]) -> Experiment:
        return next_experiment(
            maps,
            self.mapper.trace,
            theory=self.mapper.theory,
            actions=self._actions.values(),
            can=self._can,
            implied=True,
        )

    def _tour(self, ssh_map: SSHMap) -> tuple[str, ...]:
        """The actions that lead soonest through all that is untried in a map."""
        return next_tour(
            ssh_map,
            self.mapper.trace,
            theory=self.mapper.theory,
            actions=self._actions.values(),
            can=self._can,
            margin=DOUBTED,
        )

    def _doubts(self, ssh_map: SSHMap) -> Iterator[Doubt]:
        """The returns of a map that are still in doubt, the latest first, as least is known of these."""
        at = [ssh_map.dstates[label].place if ssh_map.places else label for label in ssh_map.labels]
        comes = [
            0,
            *(
                t
                for t, action in enumerate(self.mapper.trace.actions, 1)
                if not ssh_map.places or action.kind == "travel"
            ),
        ]
        first: dict[int | None, int] = {}
        for t in comes:
            first.setdefault(at[t], t)
        enough = len(ssh_map.dstates) + self._margin
        yield from (
            (first[at[t]], t)
            for t in reversed(comes)
            if first[at[t]] != t and self._least.get((first[at[t]], t), 0) <= enough
        )

    def _without(self, doubt: Doubt, dstates: int) -> Iterator[SSHMap]:
        """The best map in which two steps are not where the minimal maps say, if it has few dstates more."""
        theory = self.mapper.theory
        kind = "different" if theory.level == "causal" else "elsewhere"
        found = solve(
            self.mapper.trace,
            theory.replace(**{kind: (*getattr(theory, kind), doubt)}),
            max_maps=1,
            time_limit=self._limit,
        )
        if found.maps and len(found.maps[0].dstates) <= dstates + self._margin:
            yield found.maps[0]
            return
        proven = not found.stopped or found.stopped == "maps limit"
        if not proven and (found.bound.dstates or 0) <= dstates + self._margin:
            self._undecided.add(doubt)
        self._least[doubt] = dstates + self._margin + 1


def _is_unique(solution: Solution) -> bool:
    """Whether all minimal maps have the same dstates, and the same places."""
    if solution.status is not Status.OPTIMAL or not solution.maps:
        return False
    maps = solution.maps
    if (
        len({ssh_map.labels for ssh_map in maps}) > 1
        or len({tuple(s.place for s in ssh_map.dstates) for ssh_map in maps}) > 1
    ):
        return False
    if solution.complete:
        return True
    shared = solution.backbone
    return (
        shared is not None
        and shared.proven
        and not shared.dstates.sometimes
        and not (shared.places and shared.places.sometimes)
    )
