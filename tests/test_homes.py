"""The fewest places without a search: corridors with different landmarks, there and back."""

from __future__ import annotations

import random
from unittest.mock import patch

import pytest
from turns import stepwise

from ssh_abduction import Theory, Trace, solve
from ssh_abduction.solution import Status
from ssh_abduction.solver.sources.exact import choosing
from ssh_abduction.solver.steps.apart import pairwise_distinct
from ssh_abduction.theory.speedups import SPEEDUPS, Speedups

PLAIN = Speedups.without(SPEEDUPS)
ARMS = {
    "corridor": ("around",),
    "T": ("right", "around", "left"),
    "plus": ("right", "left", "around", "right"),
}


def corridor(landmarks: int, drives: int = 1, alike: int = 0, seed: int = 0) -> Trace:
    """Drives up and down a corridor with landmarks. Some of them look alike."""
    names = {(way, i): f"{way}{i}" for way in "ab" for i in range(landmarks)}
    chance = random.Random(seed)
    for key in chance.sample(list(names), alike):
        names[key] = "wall"
    seen, done = [names["a", 0]], []
    for _ in range(drives):
        for way, order in (("a", range(1, landmarks)), ("b", range(landmarks - 2, -1, -1))):
            seen += [names[way, i] for i in order]
            done += ["travel"] * (landmarks - 1)
            seen.append(names["b", landmarks - 1] if way == "a" else names["a", 0])
            done.append("around")
    return Trace.from_steps(seen, done)


def arms(kind: str, length: int) -> Trace:
    """Drives up and down arms that meet at one place. All landmarks differ."""
    seen, done = ["c0"], list[str]()
    for number, turn in enumerate(ARMS[kind]):
        for way in ("out", "back"):
            for i in range(length):
                done.append("travel")
                seen.append(
                    f"{way} {number} {i}" if way == "out" or i < length - 1 else f"c {number}"
                )
            done.append("around" if way == "out" else turn)
            seen.append(f"end {number}" if way == "out" else f"c {number} turned")
    return Trace.from_steps(seen, done)


CASES = {
    **{
        f"corridor of {n}, {drives} drives, {alike} alike": corridor(n, drives, alike)
        for n, drives, alike in ((3, 1, 0), (4, 1, 0), (3, 2, 0), (4, 1, 2), (4, 2, 3))
    },
    **{
        f"{kind} of {length}": arms(kind, length)
        for kind in ARMS
        for length in (1, 2)
        if kind != "plus" or length == 1
    },
}


@pytest.mark.parametrize(
    ("case", "prefer"),
    [
        *((case, ("dstates", "paths", "places")) for case in CASES),
        *((case, ("dstates", "places", "paths")) for case in [*CASES][1::3]),
        *((case, ("dstates", "places")) for case in [*CASES][::4]),
    ],
)
def test_maps_with_pinned_places_equal_those_of_the_plain_encoding(
    case: str, prefer: tuple[str, ...]
) -> None:
    trace, theory = CASES[case], Theory.topological().replace(prefer=prefer)
    expected = solve(trace, theory, max_maps=None, speedups=PLAIN)
    with patch.object(choosing, "FEW_STEPS", 0), stepwise(-1.0):
        found = solve(trace, theory, max_maps=None)
    assert (found.status, found.complete) == (Status.OPTIMAL, True)
    assert (found.cost, set(found.maps)) == (expected.cost, set(expected.maps))


@pytest.mark.slow
def test_long_corridor_needs_no_search_for_places() -> None:
    """The places of forty landmarks on the way there bound the number of places."""
    found = solve(corridor(40), time_limit=60)
    assert (found.status, found.complete, found.count) == (Status.OPTIMAL, True, 1)
    assert found.cost is not None
    assert (found.cost.dstates, found.cost.places, found.cost.paths) == (80, 40, 1)


def test_pairwise_distinct_ends_if_a_member_differs_from_itself() -> None:
    """Labels that break an axiom may show it. Clingo then finds no map with them."""
    assert pairwise_distinct([4, 5], [(4, 4), (4, 5), (5, 4)]) == [4, 5]
