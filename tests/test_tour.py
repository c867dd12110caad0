"""Shortest tours through untried actions, and what they leave for the way back."""

from __future__ import annotations

from collections import deque

import pytest
from test_explorer import RING, TURNS, Streetwalker
from worlds import HEADINGS, Streets, streets

from ssh_abduction import Explorer, Theory, Trace, solve
from ssh_abduction.data import Action
from ssh_abduction.rivals.tour import next_tour, with_doubted_returns

ENDS = [(1, 0, 0, 0), (0, 0, 1, 0)]
TWO = streets(("a", "E", "b"))
THREE = (0, 120, 240)


def shortest(
    world: Streets, at: tuple[str, int], seen: set[object], actions: tuple[str, ...]
) -> int:
    """The fewest actions to see all dstates and do all unseen travels, by breadth-first search."""
    everything = {(place, k) for place in world for k in range(4)} | {
        (place, heading) for place, ways in world.items() for heading in ways
    }
    queue = deque([(at, frozenset(everything - seen), 0)])
    known = set()
    while True:
        (place, facing), left, steps = queue.popleft()
        if not left:
            return steps
        for action in actions:
            heading = HEADINGS[facing]
            if action != "travel":
                there = place, (facing + TURNS[action]) % 4
            elif heading in world[place]:
                there = world[place][heading], facing
            else:
                continue
            after = there, left - {there} - ({(place, heading)} if action == "travel" else set())
            if after not in known:
                known.add(after)
                queue.append((*after, steps + 1))


@pytest.mark.parametrize(
    "actions", [("right", "travel"), ("right", "left", "travel"), (*TURNS, "travel")]
)
def test_tour_is_the_shortest_if_all_ends_are_known(actions: tuple[str, ...]) -> None:
    trace = Trace.from_steps(["end", "wall"], ["travel"], stars=ENDS)
    tour = next_tour(solve(trace).maps[0], trace, actions=actions)
    assert len(tour) == shortest(TWO, ("b", 1), {("a", 1), ("b", 1), ("a", "E")}, actions)


def test_tour_travels_before_turning_at_a_place_it_revisits() -> None:
    alone = Trace.from_steps(["end"], [], stars=ENDS[:1])
    assert next_tour(solve(alone).maps[0], alone, actions=(*TURNS, "travel")) == ("travel",)


def test_tour_is_empty_if_all_was_tried() -> None:
    driven = Trace.from_steps(
        ["end", "wall", "back", "wall back", "end"],
        ["travel", "around", "travel", "around"],
        stars=[*ENDS, *ENDS, ENDS[0]],
    )
    ssh_map = solve(driven).maps[0]
    assert next_tour(ssh_map, driven) == ()
    assert next_tour(ssh_map, driven, actions=["right"]) != ()


def test_tour_plans_only_possible_actions() -> None:
    alone = Trace.from_steps(["end"], [], stars=ENDS[:1])
    assert (
        next_tour(
            solve(alone).maps[0], alone, actions=("right", "travel"), can=lambda seen: ["right"]
        )[0]
        == "right"
    )


def test_tour_knows_where_turns_to_gateways_lead() -> None:
    turns = [
        Action("right 1", "turn", "right", gateway=1),
        Action("left 1", "turn", "left", gateway=1),
    ]
    theory = Theory.causal().replace(star="alike")
    trace = Trace.from_steps(
        ["tri", "wall", "end", "back"],
        ["travel", "around", "travel"],
        stars=[THREE, (180,), (0,), (60, 180, 300)],
    )
    tour = next_tour(solve(trace, theory).maps[0], trace, theory=theory, actions=turns)
    assert tour in (
        ("left 1", "travel"),
        ("right 1", "travel"),
    )  # to a gateway that it never went through
    looked = Trace.from_steps(["tri", "one", "two", "tri"], [turns[0]] * 3, stars=[THREE] * 4)
    assert (
        next_tour(solve(looked, theory).maps[0], looked, theory=theory, actions=[turns[1]])
        == ("left 1",) * 3
    )  # the ends are expected, and still to be tried


def test_tour_tries_unknown_actions_only_if_named() -> None:
    trace = Trace.from_steps(["a", "b", "a"], ["p", "p"])
    ssh_map = solve(trace, Theory.causal()).maps[0]
    assert next_tour(ssh_map, trace, theory=Theory.causal()) == ()
    assert next_tour(ssh_map, trace, theory=Theory.causal(), actions=["q"]) == ("q",)


def test_tour_confirms_returns_by_further_steps() -> None:
    explorer = Explorer(Streetwalker(RING, "a", "E"), time_limit=None)
    doubts = 0
    for _ in range(16):
        explorer.step()
        ssh_map, trace = explorer.solution.maps[0], explorer.trace
        split = with_doubted_returns(ssh_map, trace, 4)
        pairs = {(a, b) for a, b in zip(split.labels, ssh_map.labels, strict=True)}
        assert len(pairs) == len(split.dstates)  # dstates are divided, never merged
        assert with_doubted_returns(ssh_map, trace, 0).labels == ssh_map.labels
        doubts += len(split.places) > len(ssh_map.places)
    assert doubts
