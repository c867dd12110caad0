"""Maps as finite-state machines: what each map predicts, from the current dstate on.

A star is all openings or gateways that are seen at a step. Rivals are minimal maps of one trace.
Rivals with equal machines predict the same for all actions, so they share one machine. For example,
780 rivals that differ only in paths have one machine.

A robot that follows links of all rivals is at one dstate in each of them. These dstates are a
*joint state*: a row of numbers, one for each machine.

If the action was tried at a dstate, its link is known. Otherwise the axioms, or the order of a
path, may still tell where the action leads:

- A turn, if places have frames (four directions, the slots 0 to 3): it leads to the slot one, two
  or three quarters further clockwise (axiom turn_rotates). At most one dstate has that slot as its
  heading (one_dstate_per_heading). If the map has none, the star there is still known: the star of
  another dstate at the place, rotated by the turns between the two.
- A turn around at a dstate along a path: it leads back along the path (turn_around_reverses), and
  at most one dstate is there (one_dstate_per_course).
- A travel along a path: it leads to the next place in the order of the path. This is only expected,
  because the order of a map is one of several, and an unseen place may lie between.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, compress
from typing import Any, Literal, NamedTuple, TypeAlias

import networkx as nx
import numpy as np
from numpy.typing import NDArray

from ssh_abduction.data.errors import MapError, brief
from ssh_abduction.data.groups import firsts, reached
from ssh_abduction.data.maps import DState, SSHMap
from ssh_abduction.data.star import Star, star_to_json
from ssh_abduction.data.step import QUARTERS
from ssh_abduction.data.trace import Action, Trace, View
from ssh_abduction.data.words import counted
from ssh_abduction.runtime.limits import Watch
from ssh_abduction.solver import observation
from ssh_abduction.theory.evidence.of_steps import are_alike
from ssh_abduction.theory.fields import IN_TOLERANCE
from ssh_abduction.theory.settle import settle
from ssh_abduction.theory.theory import Theory

Array: TypeAlias = NDArray[np.int32]
Row: TypeAlias = tuple[int, ...]
UNKNOWN = -1  # the state after an action for which a machine has no link
# A function from a step to a key of its star, and to the star. Stars that cannot be distinguished
# share a key.
_Reading: TypeAlias = Callable[[int], tuple[object, tuple[Any, ...] | None]]
How: TypeAlias = Literal["link", "implied", "expected", "open"]
OF_FRAMES = frozenset({"turn_rotates", "one_dstate_per_heading", "one_heading"})
_OF_COURSES = frozenset({"turn_around_reverses", "one_dstate_per_course"})


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


def _reading(maps: Sequence[SSHMap], trace: Trace | None, theory: Theory | None) -> _Reading | None:
    """Make the function that reads stars; None if stars are not used."""
    if trace is None or not trace.has_stars:
        return None
    if theory is not None:
        settled = settle(trace, theory).theory
        return None if settled.star == "none" else _reading_by(settled, maps, trace)
    # without a theory, stars are used if each dstate has one star in each map
    read = _reading_by(Theory(star="frame" if trace.in_quarters else "alike"), maps, trace)
    stars = [step.gateways or Star(()) for step in trace.steps]
    for ssh_map in maps:
        first = _first_steps(ssh_map)
        for t, label in _sound(ssh_map):
            one, other = first[label], t
            is_same = (
                read(one)[0] == read(other)[0]
                if trace.in_quarters
                else are_alike(stars[one], stars[other])
            )
            if not is_same:
                return None
    return read


def _reading_by(theory: Theory, maps: Sequence[SSHMap], trace: Trace) -> _Reading:
    """Make the function that reads stars as a theory compares them."""
    if theory.star in IN_TOLERANCE:
        steps = sorted({t for ssh_map in maps for t in _first_steps(ssh_map).values()})
        classes = _classes(trace, steps)
        return lambda t: (classes[t], trace.steps[t].star)
    return lambda t: (observation(trace.steps[t], theory)[1], trace.steps[t].openings)


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
    seen = [(t, trace.steps[t].view, trace.steps[t].gateways or Star(())) for t in steps]
    alike: nx.Graph[int] = nx.Graph()
    alike.add_nodes_from(steps)
    alike.add_edges_from(
        (i, j)
        for (i, view, star), (j, other_view, other) in combinations(seen, 2)
        if view == other_view and are_alike(star, other)
    )
    return {t: min(group) for group in nx.connected_components(alike) for t in group}


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


class JointState(NamedTuple):
    """A state of each of m machines, and where each of the n actions leads from there.

    On the way to this joint state all machines predict the same observations.
    """

    way: tuple[int, ...]  # the indices of the actions that lead here from the start
    states: tuple[int, ...]  # the state of each machine
    ends: Array  # the states after each action, (n, m); UNKNOWN where a machine has no link
    seen: Array  # the numbers of what is seen there, (n, m)


class MachineTable:
    """Machines as arrays, so that an action is followed in all of them at once.

    >>> blind = Machine((0, 0), ((("a", 1),), (("a", 0),)))
    >>> walk = MachineTable([blind, blind], ["a"]).walk([0, 1], (0, 0), Watch())
    >>> [(joint.states, joint.way) for joint in walk]
    [((0, 0), ()), ((1, 1), (0,))]
    """

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

    def walk(self, group: Sequence[int], start: Row, watch: Watch) -> Iterator[JointState]:
        """Yield the joint states that links of all machines reach, the nearest first.

        Links are followed as long as all machines predict the same observations. `group` has the
        indices of the machines, and `start` the state in which each of them begins.
        """
        waiting: dict[Row, tuple[int, ...]] = {start: ()}
        queue = deque(waiting)
        while queue:
            watch.check()
            states = queue.popleft()
            ends = self.ends[group, states].T
            seen = np.where(ends < 0, UNKNOWN, self.sights[group, ends])
            yield JointState(waiting[states], states, ends, seen)
            alike = (ends >= 0).all(axis=1) & (seen == seen[:, :1]).all(axis=1)
            for action in np.flatnonzero(alike).tolist():
                there = tuple(ends[action].tolist())
                if there not in waiting:
                    waiting[there] = (*waiting[states], action)
                    queue.append(there)


@dataclass(frozen=True, slots=True)
class Consequence:
    """The prediction of a map for an action at a dstate."""

    # "link" if the action was tried; "implied" if the axioms imply where it leads; "expected" if
    # the order of a path suggests it; "open" if nothing is known.
    how: How
    dstate: int | None = None  # the dstate that the action leads to; None if unknown
    # The view and star there, as far as they are known; None if nothing is known.
    seen: Seen | None = None

    @property
    def is_sure(self) -> bool:
        """Whether any other outcome of the action refutes the map."""
        return self.how in ("link", "implied")

    def clashes(self, other: Consequence) -> bool:
        """Tell whether every outcome refutes at least one of the two predicting maps."""
        if not (self.is_sure and other.is_sure and self.seen and other.seen):
            return False
        one, two = self.seen, other.seen
        both = ((one.view, two.view), (one.star, two.star))
        return any(None not in pair and pair[0] != pair[1] for pair in both)

    def to_dict(self) -> dict[str, Any]:
        """Return the prediction as plain data, as `next --json` prints it."""
        return {"how": self.how, "dstate": self.dstate} | (
            self.seen.to_dict() if self.seen else {"view": None}
        )


OPEN = Consequence("open")


class Consequences:
    """The predictions of one map.

    Args:
        links: For each dstate, a dict from each action tried there to the dstate it leads to.
        looks: The view and star of each dstate.
        theory: The theory, whose axioms may imply where actions lead; None to use all axioms.
    """

    def __init__(
        self,
        ssh_map: SSHMap,
        links: dict[int, dict[str, int]],
        looks: Sequence[Seen],
        theory: Theory | None,
    ) -> None:
        self._dstates, self._links, self._looks = ssh_map.dstates, links, looks
        headed = [s for s in ssh_map.dstates if s.heading is not None and s.place is not None]
        has_frames = all((s.heading or 0) < 4 for s in headed)
        if theory is not None:
            has_frames = theory.star == "frame" and theory.hard >= OF_FRAMES
        self._framed = {(s.place, s.heading): s.id for s in headed} if has_frames else {}
        self._seen_at = {s.place: s for s in headed} if has_frames else {}  # a dstate at each place
        self._at: dict[tuple[int | None, int | None, int | None], int] = {
            (s.place, s.path, s.direction): s.id
            for s in ssh_map.dstates
            if s.path is not None and s.place is not None
        }
        self._turns_back = theory is None or theory.hard >= _OF_COURSES
        self._orders = {path.id: path.order for path in ssh_map.theory_paths}

    def of(self, dstate: int, action: Action) -> Consequence:
        """Predict where an action leads from a dstate, and what is seen there."""
        there = self._links[dstate].get(action.name)
        if there is not None:
            return self._to(there, "link")
        s = self._dstates[dstate]
        if action.kind == "turn" and action.turn is not None:
            return self._turned(s, action)
        if action.kind == "travel" and s.path is not None:
            return self._travelled(s)
        return OPEN

    def sure_ends(self, actions: Sequence[Action]) -> tuple[tuple[int, str, int], ...]:
        """List the untried turns whose end the axioms imply: (dstate, action, dstate reached)."""
        turns = [action for action in actions if action.kind == "turn"]
        if not (self._framed or (self._turns_back and self._at)):
            return ()
        found = (
            (s.id, action.name, self._turned(s, action))
            for s in self._dstates
            for action in turns
            if action.name not in self._links[s.id]
        )
        return tuple(
            (s, action, says.dstate) for s, action, says in found if says.dstate is not None
        )

    def _turned(self, s: DState, action: Action) -> Consequence:
        """Predict where a turn leads from a dstate that has no link for it."""
        assert action.turn is not None
        if s.place in self._seen_at and s.heading is not None and action.in_quarters:
            slot = (s.heading + QUARTERS[action.turn]) % 4
            if (faced := self._framed.get((s.place, slot))) is not None:
                return self._to(faced, "implied")
            known = self._seen_at[s.place]
            if not _is_four(self._looks[known.id]):
                return OPEN
            openings = self._looks[known.id].star or ()
            turned = (slot - (known.heading or 0)) % 4
            return Consequence("implied", None, Seen(None, openings[turned:] + openings[:turned]))
        if action.turn == "around" and s.path is not None and self._turns_back:
            back = self._at.get((s.place, s.path, -(s.direction or 0)))
            if back is not None:
                return self._to(back, "implied")
        return OPEN

    def _travelled(self, s: DState) -> Consequence:
        """Predict a travel from a dstate that has no link for it: to the next place of its path."""
        order = self._orders.get(s.path or 0, ())
        if s.place not in order:
            return OPEN
        next_one = order.index(s.place) + (s.direction or 0)
        if not 0 <= next_one < len(order):
            return OPEN
        there = self._at.get((order[next_one], s.path, s.direction))
        return OPEN if there is None else self._to(there, "expected")

    def _to(self, dstate: int, how: How) -> Consequence:
        """Predict that an action leads to this dstate."""
        return Consequence(how, dstate, self._looks[dstate])


def _is_four(seen: Seen) -> bool:
    """Tell whether a star is given as four openings: ahead, right, back and left."""
    return (
        seen.star is not None
        and len(seen.star) == 4
        and all(isinstance(entry, bool) for entry in seen.star)
    )


def is_possible(action: Action, seen: Seen) -> bool:
    """Tell whether a star (the openings seen at a place) allows an action; None allows any.

    A travel needs an opening ahead. A turn to a numbered gateway needs that gateway.
    """
    if seen.star is None:
        return True
    if _is_four(seen):
        return action.kind != "travel" or bool(seen.star[0])
    frames = Star.of(seen.star).frames
    if action.kind == "travel":
        return any(frame.faces(slot) for frame in frames for slot in range(frame.slots))
    if action.gateway is not None:
        return any(frame.nth(action.turn, action.gateway) is not None for frame in frames)
    return True
