"""Find the next experiment: actions that distinguish rival maps.

>>> from ssh_abduction import Trace, next_experiment, solve
>>> actions = ["travel", "travel", "around", "travel"]
>>> corridor = Trace.from_steps(["end", "hall", "end", "end", "hall"], actions)
>>> untried = next_experiment(solve(corridor), corridor).plan.untried
>>> untried.action, untried.worst
('around', 1)
>>> [(expected.rivals, str(expected.says.seen)) for expected in untried.expects]
[((1,), 'end'), ((2,), 'hall')]

Kuipers & Beeson (2002): "it may be necessary to search actively for the relevant experience, using
homing sequences (Rivest & Schapire 1989) or the rehearsal procedure (Kuipers & Byun 1991)". Here
each rival says where the robot is: at the dstate of the last step. So if the maps are read as
finite-state machines, their current states are known. The task is to find a distinguishing
sequence, not a homing sequence.

Known links
-----------
Each map predicts what is seen along its links. With the option `implied`, it also predicts along
links that the axioms imply: if places have frames, four right turns lead back
(`rivals/machines.py`). A sequence of actions is followed while all rivals that are left have
each link. Once their predictions differ, the observation refutes some of them.

*Two rivals.* The robot is at one dstate in each map. The two dstates are a joint state. A
breadth-first search over joint states finds the fewest actions after which the predictions differ,
or proves that they never differ.

*Many rivals.* Finding the experiment that leaves the fewest rivals in the worst case is
PSPACE-complete (Lee & Yannakakis 1994, "Testing finite-state machines: state identification and
verification"). So the plan is greedy. Each sequence of actions up to a first difference has a gain:
log(n / m) if it leaves m of n rivals in the worst case. The plan takes the sequence with the
greatest gain per action. Then it plans for the rivals that are left after each observation. So it
may leave more rivals than the best plan.

Untried actions
---------------
Some rivals predict the same along all links that they have in common, for example rivals that
differ only in paths. An action that some of them have not tried may distinguish them: if two rivals
are sure of different outcomes, one is refuted. The most informative action leaves the fewest rivals
in the worst case. Ties go to the action for which most pairs of rivals expect different outcomes,
then to the nearest action.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.data.checks import a_flag, a_function, a_list, an_instance, check_limit
from ssh_abduction.data.errors import MapError, printable
from ssh_abduction.data.groups import gathered, indices_of
from ssh_abduction.data.maps import SSHMap, check_of_trace
from ssh_abduction.data.schema import PlainData, attributes_of
from ssh_abduction.data.trace import Action, Trace, checked_trace
from ssh_abduction.data.words import counted
from ssh_abduction.rivals.listing import Listing, Maps
from ssh_abduction.rivals.machines import (
    UNKNOWN,
    Can,
    Consequence,
    Consequences,
    Machine,
    MachineTable,
    Observations,
    Row,
    Seen,
    is_possible,
    leads_of,
    machine_of,
    with_ends,
)
from ssh_abduction.runtime.limits import LimitError, Watch
from ssh_abduction.solution import Solution, Stop
from ssh_abduction.theory.settle import settle
from ssh_abduction.theory.theory import Theory, checked_theory


@dataclass(frozen=True, slots=True)
class Expectation:
    """The prediction of some rivals for an untried action."""

    rivals: tuple[int, ...]  # the rivals with this prediction, numbered from 1
    says: Consequence  # the prediction

    def to_dict(self) -> dict[str, Any]:
        """Return the prediction as plain data, as `next --json` prints it."""
        return {"rivals": list(self.rivals), **self.says.to_dict()}


@dataclass(frozen=True, slots=True)
class Untried(PlainData):
    """An action for which at least one rival has no link, and the way to it."""

    way: tuple[str, ...]  # the actions that lead there, along links that all rivals have
    action: str  # the untried action, to be done after these
    expects: tuple[Expectation, ...]  # the different predictions of the rivals
    # The number of rivals that are left in the worst case. All others are refuted.
    worst: int
    pairs: int  # the number of pairs of rivals with different predictions


@dataclass(frozen=True, slots=True)
class Branch:
    """The rest of a plan after an observation."""

    seen: Seen  # the observation
    plan: ExperimentPlan  # the plan for the rivals that predict this observation

    def to_dict(self) -> dict[str, Any]:
        """Return the branch as plain data, as `next --json` prints it."""
        return {"seen": self.seen.to_dict(), **self.plan.to_dict()}


@dataclass(frozen=True, slots=True)
class ExperimentPlan:
    """An experiment as a tree: actions, and a further plan for each observation after them."""

    rivals: tuple[int, ...]  # the rivals that are left, numbered from 1
    # Actions along links that all these rivals have. Empty if no such links distinguish the rivals.
    actions: tuple[str, ...] = ()
    # For each predicted observation after the last action, the plan for the rivals that are then
    # left.
    branches: tuple[Branch, ...] = ()
    # The most informative untried action. Only at the ends of the tree, where one rival is left or
    # known links do not distinguish the rivals. None if there is no such action.
    untried: Untried | None = None

    @property
    def worst(self) -> int:
        """The number of rivals that the whole plan leaves in the worst case."""
        return max((branch.plan.worst for branch in self.branches), default=len(self.rivals))

    @property
    def longest(self) -> int:
        """The greatest number of actions along any branch of the plan, without untried actions."""
        return len(self.actions) + max((branch.plan.longest for branch in self.branches), default=0)

    def to_dict(self) -> dict[str, Any]:
        """Return the plan as plain data, as `next --json` prints it."""
        own = attributes_of(self, "rivals")
        if self.branches:
            own |= attributes_of(self, "actions", "branches")
        return own | (attributes_of(self, "untried") if self.untried else {})


@dataclass(frozen=True, slots=True)
class Prediction(PlainData):
    """The predictions of some rivals for the actions of an experiment."""

    rivals: tuple[int, ...]  # the rivals with these predictions, numbered from 1
    seen: tuple[Seen, ...]  # the predicted observation after each action


@dataclass(frozen=True, slots=True)
class Experiment:
    """A plan of actions to find out which of some rival maps is true. Rivals have numbers from 1.

    Attributes:
        count: The number of rivals.
        alike: Groups of rivals. All rivals of a group predict the same along all their links.
        predictions: The different predictions of the rivals after each of `plan.actions`.
        plan: The experiment as a tree.
        sharing: What all rivals share: "dstates and places", "dstates", or "".
        complete: Whether the rivals are all minimal maps.
        stopped: The limit that ended the search; None if it ended by itself. After a limit there
            may be a better plan.
    """

    count: int
    alike: tuple[tuple[int, ...], ...]
    predictions: tuple[Prediction, ...]
    plan: ExperimentPlan
    sharing: str = ""
    complete: bool = True
    stopped: Stop | None = None

    @property
    def actions(self) -> tuple[str, ...]:
        """The actions to do next, up to the first difference in predictions.

        If no known link distinguishes the rivals, the actions lead to an untried action, which is
        the last of them. Empty if there is nothing to do.
        """
        untried = self.plan.untried
        return self.plan.actions or ((*untried.way, untried.action) if untried else ())

    @property
    def worst(self) -> int:
        """The number of rivals that the plan leaves in the worst case."""
        return self.plan.worst

    @property
    def sentence(self) -> str:
        """A sentence that describes the experiment and how many rivals it leaves."""
        plan, count = self.plan, self.count
        if count == 1:
            return f"1 map: there is nothing to tell apart; {_untried_in_words(plan.untried)}"
        if plan.branches:
            left = "leaves one of them"
            if plan.worst != 1:
                left = (
                    f"leaves {plan.worst} of them in the worst case, as known links do not tell "
                    "them apart"
                )
            whole = "this"
            if any(branch.plan.branches for branch in plan.branches):
                whole = f"the whole plan takes {counted(plan.longest, 'actions')} at most and"
            text = f"{count} maps: after {_acts(plan.actions)} their predictions differ; "
            is_greedy = len(self.alike) != 2
            more = " (another plan may be shorter or leave fewer)" if is_greedy else ""
            return f"{text}{whole} {left}{more}"
        if self.stopped:
            return f"{count} maps: no experiment was found in time"
        links = "all links" if len(self.alike) == 1 else "all links that all of them know"
        why = {
            "dstates and places": ", as they have the same dstates and places and differ only in "
            "paths",
            "dstates": ", as they have the same dstates",
        }.get(self.sharing, "")
        untried = _untried_in_words(plan.untried)
        return f"{count} maps predict the same along {links}{why}; {untried}"

    @property
    def warning(self) -> str | None:
        """A warning if there may be more maps, or if a limit ended the search; otherwise None."""
        parts = []
        if not self.complete:
            parts.append(
                "there may be other maps that are as good or better, and the experiment ignores "
                "them; let solve list all (-n 0), and search longer if a time limit stopped it"
            )
        if self.stopped:
            parts.append(
                f"the search for the experiment was stopped ({self.stopped}); there may be a "
                "better one"
            )
        return "; ".join(parts) or None

    def to_dict(self) -> dict[str, Any]:
        """Return plain data, as `next --json` prints it (docs/reference/formats.md)."""
        return {
            **attributes_of(self, "count", "complete"),
            "summary": self.sentence,
            **attributes_of(self, "sharing", "alike", "actions", "worst"),
            "longest": self.plan.longest,
            **attributes_of(self, "predictions", "plan", *(["stopped"] if self.stopped else [])),
        }


def _untried_in_words(untried: Untried | None) -> str:
    """Put an untried action and the way to it into words."""
    if untried is None:
        return "known links lead to no untried action"
    way = f", after {_acts(untried.way)}" if untried.way else ""
    if untried.pairs:
        return f"the most informative untried action is '{printable(untried.action)}'{way}"
    several = sum(len(expectation.rivals) for expectation in untried.expects) > 1
    none = "they expect the same of every untried action; " if several else ""
    return f"{none}the nearest untried action is '{printable(untried.action)}'{way}"


def _acts(actions: Sequence[str]) -> str:
    """Join the names of actions with commas."""
    return printable(", ".join(actions))


def next_experiment(
    maps: Maps,
    trace: Trace | None = None,
    *,
    theory: Theory | None = None,
    complete: bool = True,
    actions: Iterable[Action | str] = (),
    can: Can | None = None,
    implied: bool = False,
    time_limit: float | None = None,
    memory_limit: float | None = None,
    watch: Watch | None = None,
) -> Experiment:
    """Find the actions after which rival maps predict different observations.

    Args:
        maps: A Solution, a Listing, or maps of one trace. A Solution also gives `theory` and
            `complete`.
        trace: The trace of the maps. If given, stars (the openings or gateways seen) are predicted
            in addition to views, and the kinds of actions are read from it.
        theory: The theory of the maps. It sets how stars are compared, and which axioms imply where
            untried actions lead. If None, stars are used unless a map has a dstate with two stars.
        complete: Whether these are all minimal maps.
        actions: Actions that the robot can do, in addition to the actions of links of the maps.
        can: A function from what the robot sees to the names of the actions that it can do there.
            If None, the robot can do any action that the star allows.
        implied: Whether the experiment may use links that the axioms imply, but no rival has.
        time_limit: Seconds; None for no limit. At a limit the answer is the plan so far.
        memory_limit: MiB that the process may use; None for no limit.
        watch: Limits to use instead of `time_limit` and `memory_limit`. The caller can interrupt
            the search with it.

    Returns:
        The experiment.

    Raises:
        MapError: The maps are not maps of one trace, or not of this trace.
    """
    check_limit("time_limit", "seconds", time_limit)
    check_limit("memory_limit", "MiB", memory_limit)
    a_flag("complete", complete, MapError)
    a_flag("implied", implied, MapError)
    if theory is not None:
        checked_theory(theory)
    if trace is not None:
        checked_trace(trace)
    if can is not None:
        a_function("can", can, MapError, what="a function of what is seen")
    if watch is not None:
        mend = "leave it out, and give time_limit and memory_limit"
        an_instance("watch", watch, Watch, MapError, mend=mend)
    extra = [Action.of(action) for action in a_list("actions", actions, MapError)]
    if isinstance(maps, Solution):
        theory, complete = theory or maps.theory, maps.complete
    listing = Listing.of(maps)
    rivals = listing.maps
    if trace is not None:
        check_of_trace(rivals, trace, listing.source, views=listing.one_view)
    watch = watch or Watch(time_limit, memory_limit)
    watch.start()
    laboratory = Laboratory(rivals, trace, theory, extra, can, implied, watch)
    plan = laboratory.plan()
    watch.stop()
    predictions, shared = laboratory.predictions(plan.actions), _sharing(rivals)
    stopped = laboratory.stopped
    return Experiment(len(rivals), laboratory.alike, predictions, plan, shared, complete, stopped)


class Laboratory:
    """The search for a plan that distinguishes some rivals.

    A machine is a map as seen from the current dstate (`rivals/machines.py`). Rivals with equal
    machines are one group. A group and its machine have the same number, from 0. Parameters as in
    `next_experiment`.
    """

    def __init__(
        self,
        rivals: Sequence[SSHMap],
        trace: Trace | None,
        theory: Theory | None,
        actions: Sequence[Action],
        can: Can | None,
        implied: bool,
        watch: Watch,
    ) -> None:
        settled = theory if theory is None or trace is None else settle(trace, theory).theory
        self._can, self._watch = can, watch
        self._sights = Observations(rivals, trace, theory)
        self._links = [
            _to_known_views(leads_of(ssh_map, i), ssh_map) for i, ssh_map in enumerate(rivals)
        ]
        self.stopped: Stop | None = None
        done = [action for action in (trace.actions if trace else ()) if not action.starts]
        known = {action.name: action for action in (*actions, *done)}
        names = sorted(
            {action for ssh_map in rivals for _, action, _ in ssh_map.links}
            | {action.name for action in actions}
        )
        self._actions = [known.get(name) or Action.of(name) for name in names]
        self._consequences = [
            Consequences(
                ssh_map, self._links[i], [self._sights.seen[k] for k in self._sights.of[i]], settled
            )
            for i, ssh_map in enumerate(rivals)
        ]
        self._said: dict[tuple[int, int, int], Consequence] = {}
        found: dict[Machine, list[int]] = {}
        # for each rival, the dstate of each state of its machine
        self._reached: list[tuple[int, ...]] = []
        # many rivals differ only in paths and have one machine
        same: dict[object, tuple[Machine, tuple[int, ...]]] = {}
        for i, ssh_map in enumerate(rivals):
            known_ends = self._consequences[i].sure_ends(self._actions) if implied else ()
            key = (ssh_map.dstate_at[-1], ssh_map.links, known_ends, tuple(self._sights.of[i]))
            if key not in same:
                links = with_ends(self._links[i], known_ends)
                same[key] = machine_of(ssh_map.dstate_at[-1], links, self._sights.of[i])
            machine, reached = same[key]
            found.setdefault(machine, []).append(i)
            self._reached.append(reached)
        self._groups = list(found.values())
        self._table = MachineTable(list(found), names)

    @property
    def alike(self) -> tuple[tuple[int, ...], ...]:
        """The groups of rivals with equal machines. Rivals are numbered from 1."""
        return tuple(_numbers(group) for group in self._groups)

    def plan(self) -> ExperimentPlan:
        """Find the whole plan, greedily."""
        everything = list(range(len(self._groups)))
        return self._plan_for(everything, (0,) * len(everything))

    def predictions(self, actions: Sequence[str]) -> tuple[Prediction, ...]:
        """List a prediction for each group of rivals that predict the same after these actions.

        All rivals must have links for the actions. Without actions, there are no predictions.
        """
        if not actions:
            return ()
        names = [action.name for action in self._actions]
        found: dict[tuple[int, ...], list[int]] = {}
        for machine, group in enumerate(self._groups):
            state, seen = 0, []
            for name in actions:
                state = int(self._table.ends[machine, state, names.index(name)])
                seen.append(int(self._table.sights[machine, state]))
            found.setdefault(tuple(seen), []).extend(group)
        looks = self._sights.seen
        return tuple(
            Prediction(_numbers(group), tuple(looks[k] for k in seen))
            for seen, group in found.items()
        )

    def _plan_for(self, machines: Sequence[int], start: Row) -> ExperimentPlan:
        """Find the plan for some machines, each in the state that `start` has for it."""
        rivals = _numbers(i for m in machines for i in self._groups[m])
        try:
            split = self._split(machines, start) if len(machines) > 1 else None
            if split is None:
                return ExperimentPlan(rivals, untried=self._untried(machines, start))
        except LimitError as limit:
            self.stopped = limit.reason
            return ExperimentPlan(rivals)
        actions, parts = split
        looks = self._sights.seen
        branches = tuple(
            Branch(looks[seen], self._plan_for([machines[k] for k in part], tuple(states)))
            for seen, (part, states) in sorted(parts.items())
        )
        return ExperimentPlan(rivals, tuple(self._actions[a].name for a in actions), branches)

    def _split(
        self, machines: Sequence[int], start: Row
    ) -> tuple[list[int], dict[int, tuple[list[int], list[int]]]] | None:
        """Find the sequence of actions up to a difference with the greatest gain per action.

        The gain is log(n / m) if m of n rivals are left in the worst case. Returns the actions, and
        a dict from each observation after them to the machines that predict it, as indices of
        `machines`, and the states of these machines. None if no known links distinguish them.
        """
        weights = np.array([len(self._groups[m]) for m in machines])
        total, least = int(weights.sum()), int(weights.max())
        best: tuple[float, list[int], NDArray[np.int32], NDArray[np.int32]] | None = None
        for joint in self._table.walk(machines, start, self._watch):
            length = len(joint.way) + 1
            if best and math.log(total / least) / length <= best[0]:
                break  # longer sequences gain less per action
            differ = (joint.ends >= 0).all(axis=1) & (joint.seen != joint.seen[:, :1]).any(axis=1)
            for action in np.flatnonzero(differ).tolist():
                worst = int(np.bincount(joint.seen[action], weights).max())
                gain = math.log(total / worst) / length
                if best is None or gain > best[0]:
                    best = gain, [*joint.way, action], joint.ends[action], joint.seen[action]
        if best is None:
            return None
        _, actions, ends, seen = best
        parts: dict[int, tuple[list[int], list[int]]] = {}
        for sight, which in indices_of(seen.tolist()).items():
            parts[sight] = which, ends[which].tolist()
        return actions, parts

    def _untried(self, machines: Sequence[int], start: Row) -> Untried | None:
        """Find the most informative action for which some machine (map) has no link, if any."""
        best: Untried | None = None
        for joint in self._table.walk(machines, start, self._watch):
            for action in np.flatnonzero((joint.ends == UNKNOWN).any(axis=1)).tolist():
                said = self._say(machines, joint.states, action)
                if said is None:
                    continue
                worst, pairs = _informs(said)
                if best is None or (worst, -pairs) < (best.worst, -best.pairs):
                    expects = (Expectation(_numbers(some), says) for says, some in said.items())
                    way = tuple(self._actions[a].name for a in joint.way)
                    name = self._actions[action].name
                    best = Untried(way, name, tuple(expects), worst, pairs)
        return best

    def _say(
        self, machines: Sequence[int], states: Sequence[int], action: int
    ) -> dict[Consequence, list[int]] | None:
        """Find what rivals predict for an action at a joint state (a state of each machine).

        None if the action is impossible there, or if all rivals are sure of the same outcome.
        """
        here = int(self._table.sights[machines[0], states[0]])
        done = self._actions[action]
        if not is_possible(done, self._sights.seen[here]) or (
            self._can is not None and done.name not in self._can(self._sights.seen[here])
        ):
            return None
        said = gathered(
            (self._consequence(rival, self._reached[rival][state], action), rival)
            for machine, state in zip(machines, states, strict=True)
            for rival in self._groups[machine]
        )
        all_sure = all(c.is_sure and c.dstate is not None for c in said)
        return None if all_sure and len({c.seen for c in said}) == 1 else said

    def _consequence(self, rival: int, dstate: int, action: int) -> Consequence:
        """Return the prediction of a rival for an action at a dstate of its map."""
        key = rival, dstate, action
        if key not in self._said:
            self._said[key] = self._consequences[rival].of(dstate, self._actions[action])
        return self._said[key]


def _informs(said: dict[Consequence, list[int]]) -> tuple[int, int]:
    """Count how many rivals are left in the worst case, and the pairs that expect other outcomes.

    The most informative action leaves the fewest rivals. Ties go to the most pairs.
    """
    counts = {consequence: len(group) for consequence, group in said.items()}
    worst = max(sum(n for other, n in counts.items() if not one.clashes(other)) for one in counts)
    # outcomes are compared by what is seen, as rivals may number a dstate differently
    seen = Counter[object]()
    for consequence, n in counts.items():
        seen[consequence.is_sure, consequence.seen] += n
    return worst, math.comb(seen.total(), 2) - sum(math.comb(n, 2) for n in seen.values())


def _numbers(rivals: Iterable[int]) -> tuple[int, ...]:
    """Convert indices of rivals, from 0, to sorted numbers, from 1."""
    return tuple(sorted(i + 1 for i in rivals))


def _to_known_views(
    links: Mapping[int, Mapping[str, int]], ssh_map: SSHMap
) -> dict[int, dict[str, int]]:
    """Keep the links to dstates with known views, as a map predicts nothing about the others."""
    return {
        s: {action: x for action, x in tried.items() if ssh_map.dstates[x].view is not None}
        for s, tried in links.items()
    }


def _sharing(maps: Sequence[SSHMap]) -> str:
    """Tell what all maps share: "dstates and places", "dstates", or "" for neither."""
    if len({(ssh_map.dstate_at, ssh_map.links) for ssh_map in maps}) > 1:
        return ""
    places = {tuple(s.place for s in ssh_map.dstates) for ssh_map in maps}
    return "dstates and places" if maps[0].places and len(places) == 1 else "dstates"
