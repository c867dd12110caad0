"""Drive a robot by experiments until one map is left that is closed and beyond doubt.

    see  ->  minimal maps of all that was seen  ->  next experiment  ->  do its actions  ->  see …

A dstate (distinctive state) is a place and the direction that the robot faces there. A *return* is
two steps that a map puts at one place or dstate. `OnlineMapper` keeps the minimal maps of the steps
so far.

The explorer looks for a new experiment when the last one is done, when clingo has searched again,
and when the number of maps has changed. It takes the first of these that exists:

1. Known links for which the minimal maps predict different views (`rivals/explore.py`).
2. The shortest tour through all untried actions of the first map (`rivals/tour.py`). If the tour
   visits a place several times, the robot looks around there at the last visit.
3. An untried action for which the minimal maps predict different outcomes.
4. Actions that distinguish the map from a map without one of its returns (`ReturnDoubts`).

When it is done
---------------
1. *Unique.* All minimal maps have the same dstates and the same places. They may differ in paths.
2. *Closed.* At each dstate that the robot can reach, each action that it can do there was tried, or
   the axioms imply where the action leads.
3. *Beyond doubt.* A minimal map may still have too few dstates, as it merges all that can be
   merged. So the explorer doubts each return of the map. It looks for the best map in which the two
   visits are not at one place (by the causal theory: the two steps are not one dstate). This map is
   a rival if it has at most `margin` dstates more than the minimal map. After an experiment that
   distinguishes the two, the explorer examines the doubt again. As the trace grows, such a rival
   never gets cheaper. So a doubt that was dispelled stays so until the minimal maps have more
   dstates.

If no experiment distinguishes a rival from the minimal map, there are two cases. The two may be the
same map and differ only in the past of the robot. Then there is no doubt. Or the rival is another
map that is also closed and will always predict the same, as in a symmetric world. In this second
case the exploration ends as `inseparable`, and not as `done`.

This does not prove that the map is true. A world may have more than `margin` further dstates, and
only the best rival without a return is examined. benchmarks/exploring.md measures how often the
map is true.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal, Protocol, TypeAlias

from ssh_abduction.data.checks import a_function, a_whole_number, check_limit
from ssh_abduction.data.errors import TheoryError, TraceError, brief
from ssh_abduction.data.groups import firsts
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.schema import attributes_of
from ssh_abduction.data.trace import Action, Step, Trace
from ssh_abduction.data.words import counted
from ssh_abduction.evaluation import evaluate
from ssh_abduction.online.mapper import OnlineMapper
from ssh_abduction.rivals.explore import next_experiment
from ssh_abduction.rivals.machines import Seen
from ssh_abduction.rivals.tour import next_tour
from ssh_abduction.solution import Solution, Status
from ssh_abduction.solver import find_backbone, solve
from ssh_abduction.theory.theory import Theory, checked_theory

# If nothing is left to do but the map is not proven minimal, solve the trace with a time limit that
# is this many times that of a step.
LONGER = 5
# If a tour has seen at most this many dstates of a place, the map may still be wrong about which
# place this is. A place with four directions has this many dstates.
DOUBTED = 4

Ending: TypeAlias = Literal["done", "inseparable", "steps", "time", "contradicted"]
_ENDINGS: dict[Ending, str] = {
    "done": "one map is left, nothing in it is untried, and no return in it is in doubt",
    "inseparable": "several maps are left, and nothing that the robot can do tells them apart",
    "steps": "the robot did all the actions that were allowed",
    "time": "there was no time to prove which maps are minimal, or to weigh a doubt",
    "contradicted": "no map explains what was seen",
}


# Two steps that the map has at one place, or by the causal theory at one dstate (distinctive
# state: a place and a heading).
Doubt: TypeAlias = tuple[int, int]


class Robot(Protocol):
    """The robot that an explorer drives. Implement these three methods."""

    def look(self) -> Step:
        """Return what the robot sees here: a view, and what else the theory uses.

        This may be a star (the openings around the robot), and the displacement since the last
        look. A simulation may add the truth. The explorer does not use the truth to decide.
        """

    def can(self) -> Collection[Action | str]:
        """Return the actions that are possible here. They depend only on what `look` returns."""

    def do(self, action: Action) -> None:
        """Do an action, and return when it is done."""


@dataclass(frozen=True, slots=True)
class Exploration:
    """The result of an exploration.

    Attributes:
        steps: Number of actions that the robot did.
        ending: Why the exploration ended. "done": one map is left, nothing in it is untried, and no
            return is in doubt. "inseparable": nothing that the robot can do distinguishes the
            remaining minimal maps, or the minimal map from `rival`. "steps": the robot did the
            largest number of actions that was allowed. "time": there was no time to prove which
            maps are minimal, or to weigh a doubt. "contradicted": no map explains what was seen.
        is_unique: Whether all minimal maps have the same dstates and the same places.
        is_true: Whether the minimal map is unique and its dstates and places are the true ones, as
            far as the robot drove; None if what the robot saw came without the truth.
        solution: The minimal maps of all that was seen, or the best map found in time.
        rival: A map with more dstates that also explains everything, and that nothing the robot can
            do distinguishes from the minimal map; None if none was found.
    """

    steps: int
    ending: Ending
    is_unique: bool
    is_true: bool | None
    solution: Solution
    rival: SSHMap | None = None

    @property
    def sentence(self) -> str:
        """Whether the minimal map is unique, and why the exploration ended, in one sentence."""
        truth = (
            {None: "", True: ", and true", False: ", and not true"}[self.is_true]
            if self.is_unique
            else ""
        )
        why = _ENDINGS[self.ending]
        if self.is_unique and self.rival:
            more = len(self.rival.dstates) - len(self.solution.maps[0].dstates)
            why = (
                f"a map with {counted(more, 'more dstates')} also explains everything, "
                "and nothing that the robot can do tells the two apart"
            )
        unique = "" if self.is_unique else "not "
        after = f"after {counted(self.steps, 'steps')}"
        return f"{after} the minimal map is {unique}unique{truth}: {why}"

    def to_dict(self) -> dict[str, Any]:
        """Return the result as plain data."""
        record = attributes_of(self, "steps", "ending", "is_unique", "is_true", "rival")
        return record | {"summary": self.sentence, "solution": self.solution.to_dict()}


class Explorer:
    """Drives a robot until one minimal map is left, with nothing untried and no return in doubt.

    Args:
        robot: The robot, with the methods `look`, `can` and `do`.
        theory: The axioms, and what to minimise; Theory.topological() by default.
        margin: A return (two steps that the map has at one place or dstate) is in doubt while a map
            without it has at most this many dstates more. 0 doubts nothing.
        time_limit: Seconds for each step, and the same for each doubt. A step may take a little
            longer. None waits for exact answers.
        max_maps: Keep at most this many maps; None keeps all.

    Raises:
        TraceError: What the robot sees does not fit the theory, or an argument is wrong.
        TheoryError: The theory allows faults (misread, slipped).

    Attributes:
        mapper: The mapper that keeps the minimal maps.

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
    >>> found = Explorer(Ring(), Theory.causal()).explore(100)
    >>> print(found.sentence)  # doctest: +NORMALIZE_WHITESPACE
    after 7 steps the minimal map is unique, and true: one map is left, nothing in it is untried,
    and no return in it is in doubt
    """

    def __init__(
        self,
        robot: Robot,
        theory: Theory | None = None,
        *,
        margin: int = 2,
        time_limit: float | None = 2.0,
        max_maps: int | None = 100,
    ) -> None:
        what, mend = "a number of dstates", "give a whole number such as 2"
        a_whole_number("margin", margin, TraceError, what=what, mend=mend)
        check_limit("time_limit", "seconds", time_limit)
        for name in ("look", "can", "do"):
            method = getattr(robot, name, None)
            a_function(f"robot.{name}", method, TraceError, what="a method of the robot")
        if theory is not None and checked_theory(theory).has_faults:
            raise TheoryError(
                "theory: expected a theory without faults, got misread or slipped; leave them "
                "out, as an exploration ends at the first contradiction"
            )
        self._robot, self._time_limit, self._max_maps = robot, time_limit, max_maps
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
        self._abilities = Abilities()
        self._abilities.note(first, robot.can())
        self._doubts = ReturnDoubts(int(margin), time_limit)
        # The answer for all steps, if the mapper had too little time for it.
        self._longer: Solution | None = None
        self._plan: list[str] = []  # actions to do
        self._is_stuck = False  # the last plan found nothing left to do

    def __repr__(self) -> str:
        steps, maps = counted(len(self.trace) - 1, "steps"), counted(self.solution.count, "maps")
        return f"<Explorer: {steps}, {maps}>"

    @property
    def trace(self) -> Trace:
        """The steps so far: what was seen and done, with the truth if `look` returned any."""
        trace = self.mapper.trace
        told = zip(trace.steps, self._truths, strict=True)
        return replace(trace, steps=tuple(replace(step, truth=truth) for step, truth in told))

    @property
    def solution(self) -> Solution:
        """The minimal maps of the steps so far, or the best map found in time."""
        return self._longer or self.mapper.solution

    def explore(self, steps: int) -> Exploration:
        """Do actions until nothing is left to find out, and return the result.

        Args:
            steps: The largest number of actions to do.

        Raises:
            TraceError: `steps` is negative or no whole number, or what the robot sees does not fit.
        """
        what, mend = "a number of actions", "give a whole number such as 50"
        a_whole_number("steps", steps, TraceError, what=what, mend=mend)
        while steps > 0 and self.step():
            steps -= 1
        if steps == 0 and not self._is_stuck:
            self._is_stuck = not self._planned()
        return self.result

    def step(self) -> bool:
        """Do one action. Return False if nothing is left to do, or no map is known."""
        self._is_stuck = not self._planned()
        if self._is_stuck:
            return False
        action = self._abilities.here[self._plan.pop(0)]
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
        self._abilities.note(seen, self._robot.can())
        # Make a new plan if the maps changed.
        if self.mapper.searches > asked or self.mapper.solution.count != known:
            self._plan = []
            self._doubts.reopen()
        self._longer = None
        return True

    @property
    def result(self) -> Exploration:
        """The result of the exploration so far."""
        solution = self.solution
        unique = _is_unique(solution)
        rival = next(iter(self._doubts.twins.values()), None)
        ending, is_true = self._ending(unique), self._is_true(unique)
        return Exploration(len(self.trace) - 1, ending, unique, is_true, solution, rival)

    def _ending(self, unique: bool) -> Ending:
        """Say why the exploration ended, or would end now.

        `unique` says whether all minimal maps are alike.
        """
        if self.solution.status is Status.UNSATISFIABLE:
            return "contradicted"
        if not self._is_stuck:
            return "steps"
        if self.solution.status is not Status.OPTIMAL or self._doubts.undecided:
            return "time"
        if self._doubts.twins:
            return "inseparable"
        return "done" if unique else "inseparable" if self.solution.complete else "time"

    def _is_true(self, unique: bool) -> bool | None:
        """Whether the map is unique and true; None if the robot's steps have no truth."""
        if all(truth is None for truth in self._truths):
            return None
        if not unique:
            return False
        found = evaluate(self.solution.maps, self.trace).maps
        return all(
            said.dstates_right is not False and said.places_right is not False for said in found
        )

    def _look(self) -> Step:
        """Let the robot look. Raise TraceError if it returns anything but a Step with a view."""
        seen = self._robot.look()
        if not isinstance(seen, Step) or seen.view is None:
            raise TraceError(
                f"look: expected a Step with a view, got {brief(seen)}; "
                "let the robot say what it sees, as in Step('hall')"
            )
        return seen

    def _planned(self) -> bool:
        """Make a plan if none is left. Return whether the robot can do its first action."""
        able = self._abilities.here
        if self._plan and self._plan[0] not in able:
            self._plan = []
        if not self._plan and self.solution.maps:
            self._plan = list(self._next_plan())
        return bool(self._plan) and self._plan[0] in able

    def _next_plan(self) -> tuple[str, ...]:
        """Find the actions of the next experiment; empty if nothing is left to find out."""
        maps = list(self.solution.maps)
        found = next_experiment(maps, implied=True, **self._known)
        # No known links distinguish the maps: try what is untried.
        if not found.plan.branches and (tour := next_tour(maps[0], margin=DOUBTED, **self._known)):
            return tour
        # Nothing is left to do, but there may be more minimal maps: look for them longer.
        is_proven = self.solution.status is Status.OPTIMAL and self.solution.complete
        if not found.actions and not is_proven:
            self._longer = self._solve_longer()
            if self._longer.maps:
                found = next_experiment(self._longer.maps, implied=True, **self._known)
        if found.actions or not self.solution.maps:
            return found.actions
        return self._doubting_plan(self.solution.maps[0])

    def _solve_longer(self) -> Solution:
        """Solve the whole trace with LONGER times the time limit of a step."""
        limit = None if self._time_limit is None else LONGER * self._time_limit
        mapper = self.mapper
        found = solve(mapper.trace, mapper.theory, time_limit=limit, max_maps=self._max_maps)
        # Maps that are not listed may still differ from those that are.
        if _are_alike(found.maps) and not found.complete:
            found = replace(found, shared=find_backbone(found, time_limit=limit))
        return found

    def _doubting_plan(self, best: SSHMap) -> tuple[str, ...]:
        """Find actions that test whether one of the returns of the minimal map is wrong.

        A return is two steps that the map has at one place or dstate. The actions distinguish the
        map from the best map without this return. The result is empty if no doubt is left to test.
        """
        trace, theory, dstates = self.mapper.trace, self.mapper.theory, len(best.dstates)
        for doubt in self._doubts.in_doubt(best, trace):
            rival = self._doubts.rival(doubt, trace, theory, dstates)
            if rival is None:
                continue
            experiment = next_experiment([best, rival], implied=True, **self._known)
            if experiment.actions:
                return experiment.actions
            # Two groups: the maps differ, but nothing distinguishes them. One group: both are the
            # same map and differ only in the past.
            if len(experiment.alike) > 1:
                self._doubts.twins[doubt] = rival
            self._doubts.dispel(doubt, dstates)
        return ()

    @property
    def _known(self) -> dict[str, Any]:
        """The arguments of the planners besides maps: trace, theory, and what the robot can do."""
        trace, theory = self.mapper.trace, self.mapper.theory
        can = self._abilities
        return {"trace": trace, "theory": theory, "actions": can.ever.values(), "can": can.names}


def _is_unique(solution: Solution) -> bool:
    """Whether all minimal maps have the same dstates, and the same places."""
    if solution.status is not Status.OPTIMAL or not solution.maps:
        return False
    if not _are_alike(solution.maps):
        return False
    if solution.complete:
        return True
    # If not all maps are listed, the proof of what all of them share decides.
    shared = solution.backbone
    return (
        shared is not None
        and shared.proven
        and not shared.dstates.sometimes
        and not (shared.places and shared.places.sometimes)
    )


def _are_alike(maps: tuple[SSHMap, ...]) -> bool:
    """Whether all maps have the same dstates and places."""
    labels = {ssh_map.dstate_at for ssh_map in maps}
    return len(labels) <= 1 and len({tuple(s.place for s in m.dstates) for m in maps}) <= 1


class Abilities:
    """The actions that a robot can do: now, at any time, and whenever it sees a view and a star."""

    def __init__(self) -> None:
        self.here: dict[str, Action] = {}  # the actions that the robot can do now, by name
        # All actions that the robot could do at some step so far, by name.
        self.ever: dict[str, Action] = {}
        # The names of actions by view and star, and by view alone.
        self._names: dict[tuple[object, object], set[str]] = {}

    def note(self, seen: Step, can: Collection[Action | str]) -> None:
        """Record the actions, as objects or names, that the robot can do at the current step."""
        self.here = {action.name: action for action in map(Action.of, can)}
        self.ever |= self.here
        for star in {seen.star, None}:
            names = self._names.setdefault((seen.view, star), set(self.here))
            names.intersection_update(self.here)

    def names(self, seen: Seen) -> set[str]:
        """Return the names of the actions that were possible at every step with this observation.

        An observation is a view and a star (the openings seen). If the robot never saw this star
        with this view, all steps with this view count.
        """
        names = self._names.get((seen.view, seen.star))
        return names or self._names.get((seen.view, None), set())


class ReturnDoubts:
    """Keeps track of the returns of minimal maps that are in doubt.

    A return is in doubt while some map without it has at most `margin` dstates more than the
    minimal maps; 0 doubts no return. `time_limit` is in seconds, for finding a map without one
    return; None waits for the exact answer.
    """

    def __init__(self, margin: int, time_limit: float | None) -> None:
        self.undecided: set[Doubt] = set()  # returns for which there was too little time to decide
        # The returns that no experiment can test, each with a map without the return that always
        # predicts the same as the minimal map. The caller adds them.
        self.twins: dict[Doubt, SSHMap] = {}
        self._margin, self._time_limit = margin, time_limit
        self._least: dict[Doubt, int] = {}  # lower bound of the dstates of a map without the return

    def in_doubt(self, ssh_map: SSHMap, trace: Trace) -> Iterator[Doubt]:
        """Yield the doubtful returns of a minimal map, the latest first."""
        if not self._margin:
            return
        at = [
            ssh_map.dstates[label].place if ssh_map.places else label for label in ssh_map.dstate_at
        ]
        # A travel brings the robot to a place. Any action brings it to a dstate.
        moves = [
            t
            for t, action in enumerate(trace.actions, 1)
            if not ssh_map.places or action.kind == "travel"
        ]
        comes = [0, *moves]
        first = firsts((at[t], t) for t in comes)
        enough = len(ssh_map.dstates) + self._margin
        for t in reversed(comes):
            doubt = (first[at[t]], t)
            if first[at[t]] != t and self._least.get(doubt, 0) <= enough:
                yield doubt

    def rival(self, doubt: Doubt, trace: Trace, theory: Theory, dstates: int) -> SSHMap | None:
        """Find the best map without a return. Stop doubting the return if there is none.

        `dstates` is the number of dstates of a minimal map. A map counts if it has at most `margin`
        dstates more, and is found in time. Otherwise return None. In the theory no field is "auto".
        """
        kind = "different" if theory.level == "causal" else "elsewhere"
        denied = theory.replace(**{kind: (*getattr(theory, kind), doubt)})
        found = solve(trace, denied, max_maps=1, time_limit=self._time_limit)
        if found.maps and len(found.maps[0].dstates) <= dstates + self._margin:
            return found.maps[0]
        proven = not found.stopped or found.stopped == "maps limit"
        if not proven and (found.bound.dstates or 0) <= dstates + self._margin:
            self.undecided.add(doubt)
        self.dispel(doubt, dstates)
        return None

    def dispel(self, doubt: Doubt, dstates: int) -> None:
        """Stop doubting a return as long as the minimal maps have at most `dstates` dstates."""
        self._least[doubt] = dstates + self._margin + 1

    def reopen(self) -> None:
        """Doubt all returns in `undecided` and `twins` again, because the robot has seen more."""
        for doubt in (*self.twins, *self.undecided):
            self._least.pop(doubt, None)
        self.undecided, self.twins = set(), {}
