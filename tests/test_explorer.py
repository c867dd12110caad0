"""The explorer in tiny worlds: its map against the world, and why it says that it ended."""

from __future__ import annotations

import random
from collections.abc import Collection, Mapping
from itertools import pairwise
from typing import Any

import pytest
import truth
from worlds import HEADINGS, TEE, Streets, streets

from ssh_abduction import Explorer, Theory, solve
from ssh_abduction.data import Action, Step, TheoryError, TraceError
from ssh_abduction.data.errors import AbductionError
from ssh_abduction.online import Exploration
from ssh_abduction.solution import Status

TURNS = {"right": 1, "around": 2, "left": 3}
STREET = streets(("a", "E", "b"))
CORRIDOR = streets(("a", "E", "b"), ("b", "E", "c"))
RING = streets(
    ("a", "E", "b"),
    ("b", "E", "c"),
    ("a", "S", "d"),
    ("d", "E", "e"),
    ("e", "E", "f"),
    ("c", "S", "f"),
)


class Streetwalker:
    """A robot in streets. It sees the openings around it."""

    def __init__(self, world: Streets, place: str, heading: str, told: bool = True) -> None:
        self.world, self.place, self.facing, self.told = world, place, HEADINGS.index(heading), told
        self.been = [self.truth]
        self.done: list[str] = []

    @property
    def truth(self) -> tuple[str, int]:
        return self.place, self.facing

    def look(self) -> Step:
        star = tuple(
            int(HEADINGS[(self.facing + k) % 4] in self.world[self.place]) for k in range(4)
        )
        truth = {"dstate": str(self.truth), "place": self.place} if self.told else None
        return Step("".join(map(str, star)), star=star, truth=truth)

    def can(self) -> Collection[Action | str]:
        return [*TURNS, *(["travel"] if HEADINGS[self.facing] in self.world[self.place] else [])]

    def do(self, action: Action) -> None:
        assert action.name in self.can()
        if action.name == "travel":
            self.place = self.world[self.place][HEADINGS[self.facing]]
        else:
            self.facing = (self.facing + TURNS[action.name]) % 4
        self.been.append(self.truth)
        self.done.append(action.name)


class Machine:
    """A robot in a Moore machine: views, and for each state what the actions lead to."""

    def __init__(self, views: str, ends: Mapping[int, Mapping[str, int]]) -> None:
        self.views, self.ends, self.at = views, ends, 0

    def look(self) -> Step:
        return Step(self.views[self.at], truth=self.at)

    def can(self) -> Collection[Action | str]:
        return [*self.ends[self.at]]

    def do(self, action: Action) -> None:
        self.at = self.ends[self.at][action.name]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("world", "start", "margin"),
    [(STREET, "a", 1), (TEE, "W", 0), (RING, "a", 0)],
    ids=["street", "tee", "ring"],
)
def test_explorer_ends_after_trying_all_streets(world: Streets, start: str, margin: int) -> None:
    robot = Streetwalker(world, start, "E")
    found = Explorer(robot, margin=margin, time_limit=None).explore(200)
    assert (found.ending, found.is_unique, found.is_true) == ("done", True, True)
    assert found.steps == len(robot.done)
    assert set(robot.been) == {(place, heading) for place in world for heading in range(4)}
    travels = {
        before
        for (before, _), action in zip(pairwise(robot.been), robot.done, strict=True)
        if action == "travel"
    }
    assert travels == {
        (place, HEADINGS.index(heading)) for place, ways in world.items() for heading in ways
    }
    for ssh_map in found.solution.maps:
        assert truth.partition(ssh_map.labels) == truth.partition(robot.been)


def test_explorer_is_unique_if_solve_lists_one_map() -> None:
    seen = set()
    for seed in range(6):
        chance = random.Random(seed)
        ends = {s: {action: chance.randrange(6) for action in ("p", "q")} for s in range(6)}
        robot = Machine("aabbaa", ends)
        explorer = Explorer(robot, Theory.causal(), margin=0, time_limit=None)
        been = [0]
        while explorer.step():
            been.append(robot.at)
            listed = solve(explorer.trace, Theory.causal(), max_maps=None).maps
            found = explorer.result
            assert found.is_unique == (len({m.labels for m in listed}) == 1)
            assert found.is_true == (
                [truth.partition(m.labels) for m in listed] == [truth.partition(been)]
            )
            seen.add((found.is_unique, found.is_true))
    assert seen == {(False, False), (True, False), (True, True)}


def test_explorer_says_that_its_steps_are_used_up() -> None:
    found = Explorer(Streetwalker(RING, "a", "E", told=False), time_limit=None).explore(3)
    assert (found.steps, found.ending, found.is_true) == (3, "steps", None)
    assert "the robot did all the actions that were allowed" in found.sentence


def test_explorer_says_that_rivals_are_inseparable() -> None:
    # The robot is at the last state, which may be 0 or 2: p would tell, and cannot be done there.
    one_way = {0: {"p": 1}, 1: {"n": 2}, 2: {"p": 3}, 3: {"n": 4}, 4: {}}
    explorer = Explorer(Machine("axaza", one_way), Theory.causal(), time_limit=None)
    found = explorer.explore(50)
    assert (found.steps, found.ending, found.is_unique, found.is_true) == (
        4,
        "inseparable",
        False,
        False,
    )
    assert len(solve(explorer.trace, Theory.causal(), max_maps=None)) == found.solution.count > 1
    assert "not unique" in found.sentence


def test_explorer_says_that_a_unique_map_is_not_true() -> None:
    blind = Explorer(
        Machine("aaa", {0: {"on": 1}, 1: {"on": 2}, 2: {"on": 0}}), Theory.causal(), time_limit=None
    ).explore(50)
    assert (blind.ending, blind.is_unique, blind.is_true) == ("done", True, False)
    assert "not true" in blind.sentence


def test_explorer_with_a_margin_finds_the_larger_true_map() -> None:
    found = {}
    for margin in (0, 2):
        ring = Machine("abbc", {0: {"on": 1}, 1: {"on": 2}, 2: {"on": 3}, 3: {"on": 0}})
        found[margin] = Explorer(ring, Theory.causal(), margin=margin, time_limit=None).explore(50)
    assert {margin: (said.ending, said.is_true) for margin, said in found.items()} == {
        0: ("done", False),
        2: ("done", True),
    }
    assert found[0].steps == 2  # after a, b, b it takes the last two for one
    assert found[2].steps >= 4


def test_explorer_names_an_inseparable_rival_with_more_dstates() -> None:
    found = Explorer(
        Machine("abab", {s: {"on": (s + 1) % 4} for s in range(4)}),
        Theory.causal(),
        time_limit=None,
    ).explore(50)
    assert (found.ending, found.is_unique, found.is_true) == ("inseparable", True, False)
    assert found.rival is not None
    assert (len(found.solution.maps[0].dstates), len(found.rival.dstates)) == (2, 4)
    assert "a map with 2 more dstates also explains everything" in found.sentence
    assert found.to_dict()["rival"]["labels"] == list(found.rival.labels)


class Crooked(Streetwalker):
    """What it sees does not turn with it."""

    def look(self) -> Step:
        return Step("here", star=(1, 0, 0, 0))


def test_explorer_ends_as_contradicted_without_a_map() -> None:
    explorer = Explorer(Crooked(TEE, "W", "E", told=False), time_limit=None)
    found = explorer.explore(10)
    assert (found.ending, found.is_unique, found.solution.status) == (
        "contradicted",
        False,
        Status.UNSATISFIABLE,
    )
    assert solve(explorer.trace).status is Status.UNSATISFIABLE
    assert found.steps < 10


@pytest.mark.slow
def test_explorer_continues_after_a_step_limit() -> None:
    whole, parts = (
        Explorer(Streetwalker(CORRIDOR, "a", "E"), margin=0, time_limit=None) for _ in range(2)
    )
    whole.explore(100)
    while parts.explore(1).ending == "steps":
        pass
    assert parts.trace == whole.trace
    assert parts.explore(100) == parts.result
    assert not parts.step()
    assert parts.result.to_dict()["steps"] == len(whole.trace) - 1


class Nothing(Machine):
    def look(self) -> Any:
        return None


@pytest.mark.parametrize(
    ("build", "error", "message"),
    [
        (
            lambda robot: Explorer(robot, margin=-1),
            TraceError,
            "margin: expected a number of dstates, 0 or more, got -1",
        ),
        (
            lambda robot: Explorer(robot, margin=float("nan")),
            TraceError,
            "margin: expected a number of dstates",
        ),
        (lambda robot: Explorer(robot, time_limit=float("nan")), AbductionError, "limit"),
        (
            lambda robot: Explorer(robot, Theory.causal().replace(misread=1)),
            TheoryError,
            "theory: expected a theory without faults",
        ),
        (
            lambda robot: Explorer(Nothing("a", {0: {}})),
            TraceError,
            "look: expected a Step with a view, got None",
        ),
        (
            lambda robot: Explorer(robot).explore(-1),
            TraceError,
            "steps: expected a number of actions, 0 or more, got -1",
        ),
        (
            lambda robot: Explorer(robot).explore(2.5),
            TraceError,
            "steps: expected a number of actions",
        ),
    ],
)
def test_explorer_refuses_bad_input(build: Any, error: type[AbductionError], message: str) -> None:
    with pytest.raises(error, match=message):
        build(Machine("a", {0: {}}))


def test_explorer_without_actions_is_done_at_once() -> None:
    found = Explorer(Machine("a", {0: {}}), time_limit=None).explore(10)
    assert isinstance(found, Exploration)
    assert (found.steps, found.ending, found.is_unique, found.is_true) == (0, "done", True, True)
