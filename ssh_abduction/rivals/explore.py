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
each rival knows where the robot is: at the dstate of the last step. So the task is to find a
distinguishing sequence of machines with known first states, not a homing sequence.

Known links
-----------
Each map predicts what is seen along the links that it knows. With `implied` it also predicts along
links that the axioms imply: if places have frames, four right turns lead back
(`rivals/consequences.py`). A sequence of actions is followed while all rivals that are left know
each link. Once their predictions differ, the observation leaves some of them.

*Two rivals.* The two maps move from joint state to joint state. Breadth-first search finds the
fewest actions after which the predictions differ, or proves that they never do.

*Many rivals.* The experiment that leaves the fewest rivals in the worst case is PSPACE-complete
(Lee & Yannakakis 1994, "Testing finite-state machines: state identification and verification"). The
plan is greedy: it takes the sequence up to a first difference that gains most per action. Leaving
at worst m of n rivals gains log(n / m). Then it plans for each part. So it may leave more than the
best plan.

Untried actions
---------------
Rivals that known links do not distinguish see the same forever along the links that all of them
know, for example rivals that differ only in paths. An action that some of them have not tried may
distinguish them: if two rivals are sure of different outcomes, one is refuted. The most informative
action leaves the fewest rivals in the worst case. Ties go to the action for which most pairs of
rivals expect different outcomes, then to the nearest.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from ssh_abduction.data.checks import a_flag, a_function, a_list, an_instance
from ssh_abduction.data.errors import MapError, brief
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Action, Trace, checked_trace
from ssh_abduction.rivals.consequences import Consequence, Consequences, is_possible
from ssh_abduction.rivals.experiment import (
    Branch,
    Expectation,
    Experiment,
    Plan,
    Prediction,
    Untried,
)
from ssh_abduction.rivals.machines import (
    UNKNOWN,
    Can,
    Machine,
    Row,
    Sights,
    Table,
    Walk,
    links_of,
    machine_of,
    with_ends,
)
from ssh_abduction.runtime.deprecated import renamed_parameters
from ssh_abduction.solver import LimitError, Solution, Stop, Watch, check_limit
from ssh_abduction.theory.settle import settle
from ssh_abduction.theory.theory import Theory, checked_theory


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
    """Find the actions after which rival maps predict different observations.

    Args:
        maps: Maps of one trace. A Solution also says its theory, and whether it is complete.
        trace: The trace of the maps. If given, its stars are predicted beside views, and it says
            the kinds of actions.
        theory: The theory of the maps. It says how stars are read and which axioms imply the ends
            of untried actions. If None, stars are read unless some map has a dstate with two.
        complete: Whether these are all minimal maps.
        actions: Actions that the robot can do, beside those that some map has a link for.
        can: Names of the actions that the robot can do when it sees this; if None, any action that
            the star allows.
        implied: Whether the experiment may follow links that no rival has but the axioms imply.
        time_limit: Seconds. When a limit ends the search, the answer is the plan so far.
        memory_limit: MiB that the process may use.
        watch: Limits of a caller that may interrupt, instead of these two.

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
    laboratory = Laboratory(rivals, trace, theory, extra, can, implied, watch)
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


class Laboratory:
    """Makes the plan for some rivals.

    Rivals with equal machines are one group; machines are numbered in the order of the groups.
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
        # for each rival, the dstate of each state of its machine
        self._reached: list[tuple[int, ...]] = []
        # many rivals differ only in paths and have one machine
        same: dict[object, tuple[Machine, tuple[int, ...]]] = {}
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
        """The groups of rivals with equal machines, by number from 1."""
        return tuple(_numbers(group) for group in self._groups)

    def plan(self) -> Plan:
        """The whole plan, found greedily."""
        everything = list(range(len(self._groups)))
        return self._plan_for(everything, (0,) * len(everything))

    def predictions(self, actions: Sequence[str]) -> tuple[Prediction, ...]:
        """What the rivals predict after each of these actions; they know all links."""
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
        """The plan for some machines, each in a state."""
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
        """The sequence of actions up to a difference that gains most per action.

        Leaving at worst m of n rivals gains log(n / m).

        Returns:
            The actions, and for each observation after them the machines that predict it (as
            indices of `machines`) with their states; None if known links do not distinguish them.
        """
        weights = np.array([len(self._groups[m]) for m in machines])
        total, least = int(weights.sum()), int(weights.max())
        walk = Walk(self._table, machines, start, self._watch)
        best: tuple[float, int, int] | None = None  # gain per action, row, action
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
        """The most informative action that some have not tried, along links that all know."""
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
        """What rivals expect of an action at a joint state.

        None if the action is impossible there, or if all rivals are sure of the same outcome.
        """
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
    """A sort key of untried actions: the most informative has the least.

    It is the number of rivals left in the worst case, and minus the number of pairs of rivals that
    expect something different.
    """
    counts = {consequence: len(group) for consequence, group in said.items()}
    total = sum(counts.values())
    worst = max(sum(n for other, n in counts.items() if not one.clashes(other)) for one in counts)
    # outcomes are compared by what is seen, as rivals may number a dstate differently
    seen = Counter[object]()
    for consequence, n in counts.items():
        seen[consequence.is_sure, consequence.seen] += n
    return worst, -(total * (total - 1) - sum(n * (n - 1) for n in seen.values())) // 2


def _numbers(rivals: Iterable[int]) -> tuple[int, ...]:
    """Rivals by number from 1."""
    return tuple(sorted(i + 1 for i in rivals))


def _to_known_views(
    links: Mapping[int, Mapping[str, int]], ssh_map: SSHMap
) -> dict[int, dict[str, int]]:
    """The links to dstates with known views. No map predicts what is seen at the others."""
    return {
        s: {action: x for action, x in tried.items() if ssh_map.dstates[x].view is not None}
        for s, tried in links.items()
    }


def _check(maps: Sequence[SSHMap], trace: Trace | None) -> None:
    """Raise MapError unless these are maps of one trace, and of this one."""
    if not maps:
        raise MapError(
            "maps: expected at least one to seek an experiment for, got none; "
            "see the status that solve gave"
        )
    for i, ssh_map in enumerate(maps):
        if not isinstance(ssh_map, SSHMap):
            raise MapError(
                f"maps[{i}]: expected an SSHMap, got {brief(ssh_map)}; take a Solution, or its maps"
            )
        labels = ssh_map.labels
        if len(labels) != len(maps[0].labels):
            raise MapError(
                f"maps[{i}]: labels: expected {len(maps[0].labels)}, as the first map has, "
                f"got {len(labels)}; take the maps of one trace"
            )
        if trace is None:
            continue
        if len(labels) != len(trace):
            raise MapError(
                f"maps[{i}]: labels: expected {len(trace)}, one for each step of the trace, "
                f"got {len(labels)}; solve this trace"
            )
        # an ignored view or action may differ from the map
        wrong = {(fault.step, fault.kind) for fault in ssh_map.faults}
        links = set(ssh_map.links)
        for t, step in enumerate(trace.steps):
            view = ssh_map.dstates[labels[t]].view
            if step.view is not None and step.view != view and (t, "misread") not in wrong:
                raise MapError(
                    f"maps[{i}]: dstates[{labels[t]}].view: expected {brief(step.view)}, as at "
                    f"{trace.at(t)}, got {brief(view)}; solve this trace"
                )
            if (
                step.action
                and (labels[t], step.action.name, labels[t + 1]) not in links
                and (t, "slipped") not in wrong
            ):
                link = [labels[t], step.action.name, labels[t + 1]]
                raise MapError(
                    f"maps[{i}]: links: expected {brief(link)}, as at {trace.at(t)}, got none; "
                    "solve this trace"
                )


def _sharing(maps: Sequence[SSHMap]) -> str:
    """What all maps share: dstates, or dstates and places, or nothing."""
    if len({(ssh_map.labels, ssh_map.links) for ssh_map in maps}) > 1:
        return ""
    places = {tuple(s.place for s in ssh_map.dstates) for ssh_map in maps}
    return "dstates and places" if maps[0].places and len(places) == 1 else "dstates"
