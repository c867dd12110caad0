"""The next experiment: which actions tell rival maps apart.

>>> from ssh_abduction import Trace, next_experiment, solve
>>> corridor = Trace.from_steps(["end", "hall", "end", "end", "hall"], ["travel", "travel", "around", "travel"])
>>> untried = next_experiment(solve(corridor), corridor).plan.untried
>>> untried.action, untried.worst, [(said.rivals, str(said.says.seen)) for said in untried.expects]
('around', 1, [((1,), 'end'), ((2,), 'hall')])

Source. Kuipers & Beeson (2002): "it may be necessary to search actively for the relevant experience, using homing sequences (Rivest & Schapire 1989) or the rehearsal procedure
(Kuipers & Byun 1991)". Here it is known, in each rival, where the robot is: at the dstate of the last step. So what is sought is a distinguishing sequence of machines whose first
states are known, and not a homing sequence.

Through known links
-------------------
Each map predicts what is seen along the links that it knows; with `implied` also along those that the axioms imply: where places have frames, four turns right lead back (consequences.py). A sequence of actions is followed while all rivals that are left know each link; once their predictions differ, what is seen
leaves some of them.

*Two rivals.* The two maps go from joint state to joint state. Breadth first finds the fewest actions after which the two predict something different, or that there are none: exactly, as what
they do next depends on the joint state alone.

*Many rivals.* Which experiment leaves the fewest in the worst case is PSPACE-complete (Lee & Yannakakis 1994, "Testing finite-state machines: state identification and verification"). The plan is
greedy: of all sequences up to the first difference it takes one that gains most per action, where to leave at worst m of n gains log(n / m); and then the same for each part. So what a plan leaves is an upper bound
of what the best plan leaves.

Where known links tell no more
------------------------------
Rivals that are left then see the same for ever along the links that all of them know, as rivals do which differ in paths alone. What may tell them apart is an action that not all of them have tried:
where one says what comes and another says something else, one of them is refuted. The most informative is the one that at worst leaves the fewest; of equal ones that about which most pairs of rivals say
something different, then the nearest.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from ssh_abduction.data.checks import a_flag, a_function, a_list, an_instance
from ssh_abduction.data.deprecated import renamed_parameters
from ssh_abduction.data.errors import MapError, brief, printable
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Action, Trace, checked_trace
from ssh_abduction.rivals.consequences import Consequence, Consequences, is_possible
from ssh_abduction.rivals.machines import (
    UNKNOWN,
    Machine,
    Row,
    Seen,
    Sights,
    Table,
    Walk,
    links_of,
    machine_of,
    with_ends,
)
from ssh_abduction.solver import LimitError, Solution, Stop, Watch, check_limit, stretches
from ssh_abduction.theory.theory import Theory, checked_theory

# What a robot can do where it sees this.
Can: TypeAlias = Callable[[Seen], Iterable[str]]


@dataclass(frozen=True, slots=True)
class Expectation:
    """What some rivals, by number from 1, say of an untried action."""

    rivals: tuple[int, ...]
    says: Consequence

    def to_dict(self) -> dict[str, Any]:
        return {"rivals": list(self.rivals), **self.says.to_dict()}


@dataclass(frozen=True, slots=True)
class Untried:
    """An action that not all rivals have tried, and the way to it.

    way      actions through links that all rivals know
    action   what to do then
    expects  what the rivals say of it
    worst    how many rivals it may leave: whichever of them is true, it refutes the others for sure
    pairs    how many pairs of rivals say something different of it
    """

    way: tuple[str, ...]
    action: str
    expects: tuple[Expectation, ...]
    worst: int
    pairs: int

    def to_dict(self) -> dict[str, Any]:
        expects = [expectation.to_dict() for expectation in self.expects]
        return {
            "way": list(self.way),
            "action": self.action,
            "worst": self.worst,
            "pairs": self.pairs,
            "expects": expects,
        }


@dataclass(frozen=True, slots=True)
class Branch:
    """What is done next where this is seen."""

    seen: Seen
    plan: Plan

    def to_dict(self) -> dict[str, Any]:
        return {"seen": self.seen.to_dict(), **self.plan.to_dict()}


@dataclass(frozen=True, slots=True)
class Plan:
    """An experiment as a tree: actions, and what to do next depending on what is seen after the last of them.

    rivals    those that are left, by number from 1
    actions   through links that all of these know; none where known links do not tell them apart
    branches  for each thing that some of them predict after the last action, which rivals are left, and how to go on
    untried   where known links do not tell them apart, or one is left: the most informative action that not all have tried; None where there is none
    """

    rivals: tuple[int, ...]
    actions: tuple[str, ...] = ()
    branches: tuple[Branch, ...] = ()
    untried: Untried | None = None

    @property
    def worst(self) -> int:
        """How many rivals are left in the worst case."""
        return max((branch.plan.worst for branch in self.branches), default=len(self.rivals))

    @property
    def longest(self) -> int:
        """How many actions it takes at most."""
        return len(self.actions) + max((branch.plan.longest for branch in self.branches), default=0)

    @property
    def leaves(self) -> Iterator[Plan]:
        """What is left in the end, in each case."""
        if not self.branches:
            yield self
        for branch in self.branches:
            yield from branch.plan.leaves

    def to_dict(self) -> dict[str, Any]:
        told: dict[str, Any] = {"rivals": list(self.rivals)}
        if self.branches:
            told |= {
                "actions": list(self.actions),
                "branches": [branch.to_dict() for branch in self.branches],
            }
        return told | ({"untried": self.untried.to_dict()} if self.untried else {})


@dataclass(frozen=True, slots=True)
class Prediction:
    """What some rivals, by number from 1, predict after each action of the experiment."""

    rivals: tuple[int, ...]
    seen: tuple[Seen, ...]

    def to_dict(self) -> dict[str, Any]:
        return {"rivals": list(self.rivals), "seen": [seen.to_dict() for seen in self.seen]}


@dataclass(frozen=True, slots=True)
class Experiment:
    """What to do next, to find out which of some rival maps is true.

    count        how many rivals there are
    alike        the rivals, by number from 1, in groups that predict the same along all links that they know
    predictions  what they predict after each of `plan.actions`, up to the first difference
    plan         the experiment as a tree
    sharing      what all rivals have in common: "dstates and places", where they differ in paths alone; "dstates"; or nothing
    complete     whether these are all minimal maps
    stopped      why the search for the plan was ended, else None; then there may be a better one
    """

    count: int
    alike: tuple[tuple[int, ...], ...]
    predictions: tuple[Prediction, ...]
    plan: Plan
    sharing: str = ""
    complete: bool = True
    stopped: Stop | None = None

    @property
    def actions(self) -> tuple[str, ...]:
        """The actions after which the predictions of the rivals differ first; the way to an untried one, and that, where known links do not tell them apart."""
        untried = self.plan.untried
        return self.plan.actions or ((*untried.way, untried.action) if untried else ())

    @property
    def worst(self) -> int:
        """How many rivals the plan leaves in the worst case."""
        return self.plan.worst

    @property
    def is_settled(self) -> bool:
        """Whether nothing is left to find out: no known link tells rivals apart, and no action is untried that the robot can get to."""
        return not self.actions and self.stopped is None

    @property
    def sentence(self) -> str:
        """What the experiment is, in a few words."""
        return _sentence(self)

    @property
    def warning(self) -> str | None:
        """What is to be kept in mind: that there are more maps, or that a limit ended the search."""
        told = []
        if not self.complete:
            known = (
                f"these {self.count} maps are not known to be all minimal ones"
                if self.count > 1
                else "this map is not known to be the only minimal one"
            )
            told.append(
                f"{known}, and the experiment says nothing of others; list all (solve -n 0)"
            )
        if self.stopped:
            told.append(
                f"the search for the experiment was stopped ({self.stopped}), and there may be a better one"
            )
        return "; ".join(told) or None

    def to_dict(self) -> dict[str, Any]:
        """As `ssh-abduction next --json` prints it (docs/formats.md)."""
        return {
            "count": self.count,
            "complete": self.complete,
            "summary": self.sentence,
            "sharing": self.sharing,
            "alike": [list(group) for group in self.alike],
            "actions": list(self.actions),
            "worst": self.worst,
            "longest": self.plan.longest,
            "predictions": [prediction.to_dict() for prediction in self.predictions],
            "plan": self.plan.to_dict(),
        } | ({"stopped": self.stopped} if self.stopped else {})


@renamed_parameters("limit", "memory")
def next_experiment(
    maps: Solution | SSHMap | Iterable[SSHMap],
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
    """What to do next, to find out which of rival maps is true: the actions after which they predict different observations.

    maps      maps of one trace; a Solution also says its theory, and whether it is complete
    trace     the trace that they explain: its stars are predicted beside views, and it says of which kind actions are
    theory    under which the maps were solved: it says how stars are read, and which axioms tell the ends of untried actions. Where it is missing, stars are read unless a dstate of some map shows two
    complete  whether these are all minimal maps
    actions   what else the robot can do, beside the actions that some map has a link for
    can       names of what the robot can do where this is seen; by default any of these actions, as far as the star lets it
    implied   whether it may lead through links that no rival has, but that follow from the axioms
    time_limit, memory_limit  seconds, and MiB that the process may use. When they are over, the plan so far is the answer
    watch     the limits of a caller that may interrupt, instead of these two

    Raises MapError where the maps are not of one trace, or not of this one.
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
        an_instance("watch", watch, Watch, MapError, mend="leave it out, and give limit and memory")
    extra = [Action.of(action) for action in a_list("actions", actions, MapError)]
    if isinstance(maps, Solution):
        theory, complete, maps = theory or maps.theory, maps.complete, maps.maps
    rivals = (
        [maps]
        if isinstance(maps, SSHMap)
        else a_list("maps", maps, MapError, what="a Solution or maps")
    )
    _check(rivals, trace)
    if watch is None:
        watch = Watch(time_limit, memory_limit)
    watch.use_reserve()
    watch.start()
    laboratory = _Laboratory(rivals, trace, theory, extra, can, implied, watch)
    plan = laboratory.plan()
    watch.stop()
    return Experiment(
        len(rivals),
        laboratory.alike,
        laboratory.predictions(plan.actions),
        plan,
        _sharing(rivals),
        complete,
        laboratory.stopped,
    )


class _Laboratory:
    """Makes the plan for some rivals.

    alike    the rivals whose machines are equal, by number from 1; the machines are numbered in this order
    stopped  why the search was ended, else None
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
        settled = theory if theory is None or trace is None else theory.resolve(trace)
        self._can, self._watch = can, watch
        self._sights = Sights(rivals, trace, theory)
        self._links = [
            _to_known_views(links_of(ssh_map, i), ssh_map) for i, ssh_map in enumerate(rivals)
        ]
        self.stopped: Stop | None = None
        known = {action.name: action for action in (*actions, *(trace.actions if trace else ()))}
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
        self._reached: list[
            tuple[int, ...]
        ] = []  # for each rival the dstate that each state of its machine is
        same: dict[
            object, tuple[Machine, tuple[int, ...]]
        ] = {}  # as of many rivals that differ in paths alone there is one machine
        for i, ssh_map in enumerate(rivals):
            known_ends = self._consequences[i].sure_ends(self._actions) if implied else ()
            key = (ssh_map.labels[-1], ssh_map.links, known_ends, tuple(self._sights.of[i]))
            if key not in same:
                links = with_ends(self._links[i], known_ends)
                same[key] = machine_of(ssh_map.labels[-1], links, self._sights.of[i])
            machine, reached = same[key]
            found.setdefault(machine, []).append(i)
            self._reached.append(reached)
        self._groups = list(found.values())
        self._table = Table(list(found), names)

    @property
    def alike(self) -> tuple[tuple[int, ...], ...]:
        return tuple(_numbers(group) for group in self._groups)

    def plan(self) -> Plan:
        """The whole plan, greedily."""
        everything = list(range(len(self._groups)))
        return self._plan_for(everything, (0,) * len(everything))

    def predictions(self, actions: Sequence[str]) -> tuple[Prediction, ...]:
        """What each rival predicts after each of these actions, as far as it knows their links."""
        names = [action.name for action in self._actions]
        found: dict[tuple[int, ...], list[int]] = {}
        for machine, group in enumerate(self._groups):
            state, seen = 0, []
            for name in actions:
                state = int(self._table.ends[machine, state, names.index(name)])
                seen.append(int(self._table.sights[machine, state]))
            found.setdefault(tuple(seen), []).extend(group)
        looks = self._sights.seen
        return (
            tuple(
                Prediction(_numbers(group), tuple(looks[k] for k in seen))
                for seen, group in found.items()
            )
            if actions
            else ()
        )

    def _plan_for(self, machines: Sequence[int], start: Row) -> Plan:
        """The plan for some machines, each in a state. What is still to be planned is kept in a list, as plans may be deep."""
        rivals = _numbers(i for m in machines for i in self._groups[m])
        try:
            split = self._split(machines, start) if len(machines) > 1 else None
            if split is None:
                return Plan(rivals, untried=self._untried(machines, start))
        except LimitError as limit:
            self.stopped = limit.reason
            return Plan(rivals)
        actions, parts = split
        branches = tuple(
            Branch(
                self._sights.seen[seen], self._plan_for([machines[k] for k in part], tuple(states))
            )
            for seen, (part, states) in sorted(parts.items())
        )
        return Plan(rivals, tuple(self._actions[a].name for a in actions), branches)

    def _split(
        self, machines: Sequence[int], start: Row
    ) -> tuple[list[int], dict[int, tuple[list[int], list[int]]]] | None:
        """The actions after which predictions differ, and for each prediction which machines make it, by place in the list, and their states. None where known links do not tell.

        Of all sequences up to the first difference it is one that gains most per action.
        """
        weights = np.array([len(self._groups[m]) for m in machines])
        total, least = int(weights.sum()), int(weights.max())
        walk = Walk(self._table, machines, start, self._watch)
        best: tuple[float, int, int] | None = None  # what it gains per action, the row, the action
        for layer in walk.layers():
            if best and math.log(total / least) / (layer.depth + 1) <= best[0]:
                break  # no longer sequence can gain more
            for first, action, there, seen in walk.moves(layer):
                differ = (there >= 0).all(axis=1) & (seen != seen[:, :1]).any(axis=1)
                for i in np.flatnonzero(differ).tolist():
                    worst = int(np.bincount(seen[i], weights).max())
                    gain = math.log(total / worst) / (layer.depth + 1)
                    if best is None or gain > best[0]:
                        best, end, sights = (
                            (gain, first + i, action),
                            there[i].tolist(),
                            seen[i].tolist(),
                        )
        if best is None:
            return None
        parts: dict[int, tuple[list[int], list[int]]] = {}
        for k, (state, sight) in enumerate(zip(end, sights, strict=True)):
            part, states = parts.setdefault(sight, ([], []))
            part.append(k)
            states.append(state)
        return [*walk.way(best[1]), best[2]], parts

    def _untried(self, machines: Sequence[int], start: Row) -> Untried | None:
        """The most informative action that not all of these have tried, along links that all know; None where there is none."""
        walk = Walk(self._table, machines, start, self._watch)
        best: tuple[tuple[int, int], int, int, dict[Consequence, list[int]]] | None = None
        for layer in walk.layers():
            for first, action, there, _ in walk.moves(layer):
                for i in np.flatnonzero((there == UNKNOWN).any(axis=1)).tolist():
                    said = self._say(machines, layer.rows[first - layer.first + i].tolist(), action)
                    if said is None:
                        continue
                    informs = _informs(said)
                    if best is None or informs < best[0]:
                        best = informs, first + i, action, said
        if best is None:
            return None
        (worst, pairs), row, action, said = best
        expects = tuple(
            Expectation(_numbers(group), consequence) for consequence, group in said.items()
        )
        return Untried(
            tuple(self._actions[a].name for a in walk.way(row)),
            self._actions[action].name,
            expects,
            worst,
            -pairs,
        )

    def _say(
        self, machines: Sequence[int], states: Sequence[int], action: int
    ) -> dict[Consequence, list[int]] | None:
        """What rivals say of an action at a joint state. None where it cannot be done there, or where all of them know what comes, and it is the same."""
        here = int(self._table.sights[machines[0], states[0]])
        done = self._actions[action]
        if not is_possible(done, self._sights.seen[here]) or (
            self._can is not None and done.name not in self._can(self._sights.seen[here])
        ):
            return None
        said: dict[Consequence, list[int]] = {}
        for machine, state in zip(machines, states, strict=True):
            for rival in self._groups[machine]:
                said.setdefault(
                    self._consequence(rival, self._reached[rival][state], action), []
                ).append(rival)
        if (
            all(consequence.is_sure and consequence.dstate is not None for consequence in said)
            and len({c.seen for c in said}) == 1
        ):
            return None
        return said

    def _consequence(self, rival: int, dstate: int, action: int) -> Consequence:
        key = rival, dstate, action
        if key not in self._said:
            self._said[key] = self._consequences[rival].of(dstate, self._actions[action])
        return self._said[key]


def _informs(said: dict[Consequence, list[int]]) -> tuple[int, int]:
    """How many rivals are left in the worst case, and minus the number of pairs of rivals that say something different: the less the better."""
    counts = {consequence: len(group) for consequence, group in said.items()}
    total = sum(counts.values())
    worst = max(sum(n for other, n in counts.items() if not one.clashes(other)) for one in counts)
    seen = Counter[object]()  # whatever is the same dstate by another name is no difference
    for consequence, n in counts.items():
        seen[consequence.is_sure, consequence.seen] += n
    return worst, -(total * (total - 1) - sum(n * (n - 1) for n in seen.values())) // 2


def _numbers(rivals: Iterable[int]) -> tuple[int, ...]:
    """Rivals by number from 1."""
    return tuple(sorted(i + 1 for i in rivals))


def _check(maps: Sequence[SSHMap], trace: Trace | None) -> None:
    """Whether these are maps of one trace, and of this one. Raises MapError."""
    if not maps:
        raise MapError(
            "maps: expected at least one to seek an experiment for, got none; see the status that solve gave"
        )
    for i, ssh_map in enumerate(maps):
        if not isinstance(ssh_map, SSHMap):
            raise MapError(
                f"maps[{i}]: expected an SSHMap, got {brief(ssh_map)}; take a Solution, or its maps"
            )
        labels = ssh_map.labels
        if len(labels) != len(maps[0].labels):
            raise MapError(
                f"maps[{i}]: labels: expected {len(maps[0].labels)}, as the first map has, got {len(labels)}; take the maps of one trace"
            )
        if trace is None:
            continue
        if len(labels) != len(trace):
            raise MapError(
                f"maps[{i}]: labels: expected {len(trace)}, one for each step of the trace, got {len(labels)}; solve this trace"
            )
        wrong = {(fault.step, fault.kind) for fault in ssh_map.faults}
        links = set(ssh_map.links)
        for t, step in enumerate(trace.steps):
            view = ssh_map.dstates[labels[t]].view
            if step.view is not None and step.view != view and (t, "misread") not in wrong:
                raise MapError(
                    f"maps[{i}]: dstates[{labels[t]}].view: expected {brief(step.view)}, as at {trace.at(t)}, got {brief(view)}; solve this trace"
                )
            if (
                step.action
                and (labels[t], step.action.name, labels[t + 1]) not in links
                and (t, "slipped") not in wrong
            ):
                link = [labels[t], step.action.name, labels[t + 1]]
                raise MapError(
                    f"maps[{i}]: links: expected {brief(link)}, as at {trace.at(t)}, got none; solve this trace"
                )


def _sharing(maps: Sequence[SSHMap]) -> str:
    """What the maps have in common, as far as that is worth a word."""
    if len({(ssh_map.labels, ssh_map.links) for ssh_map in maps}) > 1:
        return ""
    places = {tuple(s.place for s in ssh_map.dstates) for ssh_map in maps}
    return "dstates and places" if maps[0].places and len(places) == 1 else "dstates"


def _sentence(experiment: Experiment) -> str:
    plan, count = experiment.plan, experiment.count
    if count == 1:
        return f"1 map: there is nothing to tell apart{_told_untried(plan.untried)}"
    if plan.branches:
        after = f"after {_acts(plan.actions)} their predictions differ"
        left = (
            "which leaves one of them"
            if plan.worst == 1
            else f"which leaves {plan.worst} of them in the worst case; known links tell no more of these"
        )
        more = (
            ""
            if all(not branch.plan.branches for branch in plan.branches)
            else f", and the plan takes {plan.longest} actions at most"
        )
        greedy = (
            ""
            if len(experiment.alike) == 2
            else " (the plan is greedy: another one may leave fewer or be shorter)"
        )
        return f"{count} maps: {after}, {left}{more}{greedy}"
    if experiment.stopped:
        return f"{count} maps: no experiment was found in time"
    alike = len(experiment.alike) == 1
    why = f"predict the same {'along all links' if alike else 'along all links that all of them know'}"
    same = {
        "dstates and places": ", as they have the same dstates and places, and differ in paths alone"
    }.get(experiment.sharing, ", as they have the same dstates" if experiment.sharing else "")
    return (
        f"{count} maps {why}{same}: known links cannot tell them apart{_told_untried(plan.untried)}"
    )


def _told_untried(untried: Untried | None) -> str:
    if untried is None:
        return ", and nothing is untried that known links lead to"
    way = f", after {_acts(untried.way)}" if untried.way else ""
    if not untried.pairs:
        several = sum(len(expectation.rivals) for expectation in untried.expects) > 1
        none = (
            "; along these there is no untried action of which they say anything different"
            if several
            else ""
        )
        return f"{none}; the nearest untried action is {printable(untried.action)}{way}"
    return f"; the most informative untried action is {printable(untried.action)}{way}"


def _acts(actions: Sequence[str]) -> str:
    return printable(", ".join(actions))


def told_rivals(rivals: Sequence[int]) -> str:
    """map 1, or maps 1–3 and 7."""
    return f"{'map' if len(rivals) == 1 else 'maps'} {stretches(rivals)}"


def _to_known_views(
    links: Mapping[int, Mapping[str, int]], ssh_map: SSHMap
) -> dict[int, dict[str, int]]:
    """The links to dstates whose views are known. What is seen at the others cannot be promised, so that they tell no maps apart."""
    return {
        s: {action: x for action, x in tried.items() if ssh_map.dstates[x].view is not None}
        for s, tried in links.items()
    }
