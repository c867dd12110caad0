"""Maps as finite-state machines: the predictions of each map from the current dstate on.

Rivals are minimal maps of one trace. Rivals with equal machines predict the same for all actions,
so they share one machine. For example, 780 rivals that differ only in paths have one machine.

A robot that follows links of all rivals is at one dstate in each of them. These dstates are a
*joint state*: a row of numbers, one for each machine. numpy moves many rows at once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import compress
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.data.errors import MapError, brief
from ssh_abduction.data.groups import firsts, reached
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.star import Star, star_to_json
from ssh_abduction.data.trace import Trace, View
from ssh_abduction.data.words import counted
from ssh_abduction.solver import Watch, observation
from ssh_abduction.theory.evidence.of_steps import are_alike
from ssh_abduction.theory.fields import IN_TOLERANCE
from ssh_abduction.theory.settle import settle
from ssh_abduction.theory.theory import Theory

Array: TypeAlias = NDArray[np.int32]
Row: TypeAlias = tuple[int, ...]
UNKNOWN = -1  # the state after an action for which a machine has no link
# The greatest number of entries in the rows that are moved at once. They take about ten megabytes.
CHUNK = 2**21


@dataclass(frozen=True, slots=True)
class Seen:
    """The observation at a dstate."""

    view: View | None  # the view; None if unknown
    # All openings that are seen there, in the format of the trace; None if stars are not used.
    star: tuple[Any, ...] | None = None

    def __str__(self) -> str:
        view = "any view" if self.view is None else str(self.view)
        return view if self.star is None else f"{view} {_star_text(self.star)}"

    def to_dict(self) -> dict[str, Any]:
        """Return the observation as plain data, as `next --json` prints it."""
        return {"view": self.view} | (
            {} if self.star is None else {"star": [_entry(entry) for entry in self.star]}
        )


# A function from what a robot sees to the names of the actions that it can do there.
Can: TypeAlias = Callable[[Seen], Iterable[str]]


def _entry(entry: Any) -> Any:
    """Convert an entry of a star for JSON. An open opening becomes 1, a closed one 0."""
    return int(entry) if isinstance(entry, bool) else star_to_json([entry])[0]


def _star_text(star: Sequence[Any]) -> str:
    """Put a star into words: its open directions, or the number of its gateways."""
    if all(isinstance(entry, bool) for entry in star):
        ways = compress(("ahead", "right", "back", "left"), star)
        return f"(open: {', '.join(ways) or 'nothing'})"
    return f"({counted(len(star), 'gateways')})"


class Observations:
    """The observations at the dstates of rival maps, numbered.

    Two dstates have the same number if and only if the robot cannot distinguish them by what it
    sees there. Without a trace only views count. With a trace stars (the openings seen) count, too.
    The theory sets how they are compared: as four openings, up to rotation, or with a tolerance of
    angles. With a tolerance, stars that could be equal, directly or through other stars, count as
    equal. So the robot can see each predicted difference. Without a theory, stars are used unless a
    map has a dstate with two different stars.
    """

    def __init__(self, maps: Sequence[SSHMap], trace: Trace | None, theory: Theory | None) -> None:
        reading = _reading(maps, trace, theory)
        found: dict[object, Seen] = {}
        keys: list[list[object]] = []
        for ssh_map in maps:
            shown = _first_steps(ssh_map) if reading else {}
            keys.append([])
            for s in ssh_map.dstates:
                key, star = reading(shown[s.id]) if reading and s.id in shown else (None, None)
                found.setdefault((s.view, key), Seen(s.view, star))
                keys[-1].append((s.view, key))
        number = {key: i for i, key in enumerate(found)}
        self.seen = list(found.values())  # the observation of each number
        # For each map, the number of the observation at each dstate.
        self.of = [[number[key] for key in of_map] for of_map in keys]


class _StarReader:
    """Reads the star of a step, with a key that stars share if they cannot be distinguished."""

    def __init__(self, trace: Trace, theory: Theory, steps: Sequence[int] = ()) -> None:
        self._trace, self._theory = trace, theory
        self._classes = _classes(trace, steps) if theory.star in IN_TOLERANCE else {}

    def __call__(self, step: int) -> tuple[object, tuple[Any, ...] | None]:
        """Return a key of the star of a step, and the star."""
        if self._theory.star in IN_TOLERANCE:
            return self._classes[step], self._trace.steps[step].star
        _, key = observation(self._trace.steps[step], self._theory)
        return key, self._trace.steps[step].openings


def _reading(
    maps: Sequence[SSHMap], trace: Trace | None, theory: Theory | None
) -> _StarReader | None:
    """Make the function that reads stars; None if stars are not used."""
    if trace is None or not trace.has_stars:
        return None
    steps = sorted({t for ssh_map in maps for t in _first_steps(ssh_map).values()})
    if theory is not None:
        settled = settle(trace, theory).theory
        if settled.star == "none":
            return None
        return _StarReader(trace, settled, steps)
    # without a theory, stars are read as frames if each dstate has one star in each map
    if trace.in_quarters:
        reading = _StarReader(trace, Theory(star="frame"))
        looks = [reading(t)[0] for t in range(len(trace))]
        is_read = all(
            len({(label, looks[t]) for t, label in _sound(m)})
            == len({label for _, label in _sound(m)})
            for m in maps
        )
        return reading if is_read else None
    stars = [step.gateways or Star(()) for step in trace.steps]
    if any(
        not are_alike(stars[_first_steps(m)[label]], stars[t])
        for m in maps
        for t, label in _sound(m)
    ):
        return None
    return _StarReader(trace, Theory(star="alike"), steps)


def _sound(ssh_map: SSHMap) -> list[tuple[int, int]]:
    """List the steps whose observation the map does not treat as wrong, each with its dstate."""
    wrong = {fault.step for fault in ssh_map.faults if fault.kind != "slipped"}
    return [(t, label) for t, label in enumerate(ssh_map.dstate_at) if t not in wrong]


def _first_steps(ssh_map: SSHMap) -> dict[int, int]:
    """For each dstate, find the first step whose observation the map does not treat as wrong."""
    return firsts((label, t) for t, label in _sound(ssh_map))


def _classes(trace: Trace, steps: Sequence[int]) -> dict[int, int]:
    """Group these steps by what is seen, and name each group by one of its steps.

    Steps with the same view are in one group if their stars could be equal, directly or through the
    stars of other steps.
    """
    stars = {t: trace.steps[t].gateways or Star(()) for t in steps}
    groups: dict[object, list[list[int]]] = {}  # for each view
    for t in steps:
        known = groups.setdefault(trace.steps[t].view, [])
        near = [
            group for group in known if any(are_alike(stars[t], stars[other]) for other in group)
        ]
        joined = [other for group in near for other in group]
        known[:] = [*(group for group in known if group not in near), [*joined, t]]
    return {t: group[0] for known in groups.values() for group in known for t in group}


@dataclass(frozen=True, slots=True)
class Machine:
    """The predictions of a map from the current dstate on, as a finite-state machine.

    States are the dstates that links reach, numbered breadth first. The current dstate is 0.
    """

    # For each state, the number that `Observations` gives to what is seen there.
    sights: tuple[int, ...]
    # For each state, pairs of an action and the state that it leads to.
    ends: tuple[tuple[tuple[str, int], ...], ...]


def leads_of(ssh_map: SSHMap, number: int) -> dict[int, dict[str, int]]:
    """For each dstate, return the actions that were tried there and where they lead.

    Raises MapError, which gives the number of the map, if an action leads to two dstates.
    """
    found: dict[int, dict[str, int]] = {s.id: {} for s in ssh_map.dstates}
    for source, action, target in sorted(ssh_map.links):
        if found[source].setdefault(action, target) != target:
            raise MapError(
                f"maps[{number}]: links: expected that {brief(action)} leads from dstate {source} "
                f"to one dstate, got dstates {found[source][action]} and {target}; solve the trace "
                "with the axiom deterministic"
            )
    return found


def with_ends(
    links: Mapping[int, Mapping[str, int]], ends: Sequence[tuple[int, str, int]]
) -> dict[int, dict[str, int]]:
    """Copy links, and add `ends`: (dstate, action, end). Actions are sorted by name."""
    found: dict[int, dict[str, int]] = {s: dict(tried) for s, tried in links.items()}
    for source, action, target in ends:
        found[source][action] = target
    return {s: dict(sorted(tried.items())) for s, tried in found.items()}


def machine_of(
    start: int, links: Mapping[int, Mapping[str, int]], sights: Sequence[int]
) -> tuple[Machine, tuple[int, ...]]:
    """Make the machine of a map. Also return the dstate of each state of the machine.

    For each dstate, `links` has the actions and where they lead, and `sights` the number of
    what is seen there.
    """
    number = {s: i for i, s in enumerate(reached([start], lambda s: links[s].values()))}
    ends = (tuple((action, number[x]) for action, x in links[s].items()) for s in number)
    return Machine(tuple(sights[s] for s in number), tuple(ends)), tuple(number)


class MachineTable:
    """Machines as arrays, so that an action is followed in all of them at once."""

    def __init__(self, machines: Sequence[Machine], actions: Sequence[str]) -> None:
        column = {action: i for i, action in enumerate(actions)}
        most = max(len(machine.sights) for machine in machines)
        # The state that an action leads to, or UNKNOWN. Shape (machines, states, actions).
        self.ends: Array = np.full((len(machines), most, len(actions)), UNKNOWN, np.int32)
        # The number of what is seen in a state. Shape (machines, states).
        self.sights: Array = np.full((len(machines), most), UNKNOWN, np.int32)
        for i, machine in enumerate(machines):
            self.sights[i, : len(machine.sights)] = machine.sights
            for s, ends in enumerate(machine.ends):
                for action, target in ends:
                    self.ends[i, s, column[action]] = target

    def follow(self, group: Array, rows: Array, action: int) -> tuple[Array, Array]:
        """Follow an action from joint states. Return the joint states after it, and what is seen.

        `group` has the indices of the machines, (m,), and `rows` the state of each, (n, m).
        Both results are (n, m). Entries are UNKNOWN if the machine lacks the link.
        """
        there = self.ends[group, rows, action]
        return there, np.where(there < 0, UNKNOWN, self.sights[group, there])


@dataclass(frozen=True, slots=True)
class Layer:
    """The joint states that are reached first after `depth` actions.

    On the way there all machines predict the same observations.
    """

    depth: int  # the number of actions
    first: int  # the number of the first row, counted over all layers
    rows: Array  # the joint states, shape (n, m): the state of each machine


class Walk:
    """A breadth-first search over joint states.

    It follows links that all machines have, as long as all predict the same observations. `group`
    has the indices of the machines to follow, and `start` the state in which each of them begins.

    >>> blind = Machine((0, 0), ((("a", 1),), (("a", 0),)))
    >>> walk = Walk(MachineTable([blind, blind], ["a"]), [0, 1], (0, 0), Watch())
    >>> [layer.rows.tolist() for layer in walk.layers()], walk.way(1)
    ([[[0, 0]], [[1, 1]]], [0])
    """

    def __init__(self, table: MachineTable, group: Sequence[int], start: Row, watch: Watch) -> None:
        self.table, self.group, self._watch = table, np.array(group, np.int32), watch
        self._start = start
        # for each row, the row before it and the action between them
        self._came: list[tuple[int, int]] = [(0, 0)]

    def layers(self) -> Iterator[Layer]:
        """Yield the joint states layer by layer, the nearest first."""
        known = {np.array(self._start, np.int32).tobytes()}
        layer = Layer(0, 0, np.array([self._start], np.int32))
        while len(layer.rows):
            yield layer
            rows: list[Array] = []
            for numbers, action, there, seen in self.moves(layer):
                alike = (there >= 0).all(axis=1) & (seen == seen[:, :1]).all(axis=1)
                for i in np.flatnonzero(alike).tolist():
                    key = there[i].tobytes()
                    if key not in known:
                        known.add(key)
                        rows.append(there[i])
                        self._came.append((numbers + i, action))
            width = len(self.group)
            layer = Layer(
                layer.depth + 1,
                layer.first + len(layer.rows),
                np.array(rows, np.int32).reshape(len(rows), width),
            )

    def moves(self, layer: Layer) -> Iterator[tuple[int, int, Array, Array]]:
        """Follow each action from the joint states of a layer, some rows at a time.

        Yield four values for each part of the layer and each action: the number of the first row
        of the part; the index of the action; the joint states after it; and the numbers of what is
        seen there.
        """
        size = max(CHUNK // len(self.group), 1)
        for start in range(0, len(layer.rows), size):
            part = layer.rows[start : start + size]
            for action in range(self.table.ends.shape[2]):
                self._watch.check()
                yield layer.first + start, action, *self.table.follow(self.group, part, action)

    def way(self, row: int) -> list[int]:
        """List the indices of the actions that lead from the start to the row with this number."""
        found: list[int] = []
        while row:
            row, action = self._came[row]
            found.append(action)
        return found[::-1]
