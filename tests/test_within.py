"""Nearly minimal maps: the best ones for each value of the first preference."""

from __future__ import annotations

import contextlib
import io
import json
from typing import Any
from unittest.mock import patch

import pytest
from brute_force import key, minimal_maps, near_minimal_maps
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import TOYS, theories, traces

from ssh_abduction import Theory, Trace, solve
from ssh_abduction.checker.checker import check
from ssh_abduction.checker.claims import false_claims
from ssh_abduction.cli import main
from ssh_abduction.data import SolverError
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.solution import Cost, Status
from ssh_abduction.solver.search import Search
from ssh_abduction.solver.sources.exact import prefixes
from ssh_abduction.theory.encodings import Rules
from ssh_abduction.theory.settle import settle

ACES3, EXAMPLE = "examples/aces3-route.jsonl", "examples/notched-rectangle.jsonl"
LIMIT = 100  # seconds: a search that does not end is a failure, not a hang


def places_of_steps(ssh_map: SSHMap) -> list[int | None]:
    """The place of each step."""
    return [ssh_map.dstates[label].place for label in ssh_map.labels]


@settings(max_examples=6)
@given(st.data())
def test_near_minimal_maps_equal_the_brute_force(data: st.DataObject) -> None:
    """Each map comes once, in the order of cost, with its own cost."""
    trace = data.draw(traces(max_steps=6), label="trace")
    theory = data.draw(theories(trace), label="theory")
    within = data.draw(st.integers(0, 3), label="within")
    toys = [toy for toy in TOYS if toy.rules in theory.rules]
    expected = near_minimal_maps(
        trace, theory, within, lambda found: all(toy.allows(found) for toy in toys)
    )
    first_paths = data.draw(st.sampled_from([1, prefixes.FIRST_PATHS]), label="first paths")
    with patch.object(prefixes, "FIRST_PATHS", first_paths):
        solution = solve(trace, theory, max_maps=None, within=within, time_limit=LIMIT)
    assert solution.complete
    costs = [cost.preferred_by(theory) for cost in solution.costs]
    assert costs == [cost for cost, keys in expected.items() for _ in keys]
    listed = [key(ssh_map) for ssh_map in solution.maps]
    assert len(listed) == len(set(listed)) == sum(level.count for level in solution.levels)
    for cost, keys in expected.items():
        assert {found for found, its in zip(listed, costs, strict=True) if its == cost} == keys
    for ssh_map in solution.maps:
        assert check(trace, ssh_map, theory) == ()


def test_near_minimal_brute_force_starts_with_minimal_maps() -> None:
    trace = Trace.from_steps("abaab", ["travel", "around", "travel", "right"])
    counts, keys = minimal_maps(trace, Theory.topological())
    near = near_minimal_maps(trace, Theory.topological(), 2)
    assert counts is not None
    assert next(iter(near.items())) == ((counts.dstates, counts.paths, counts.places), keys)
    assert counts.dstates == 5
    assert near == near_minimal_maps(trace, Theory.topological(), 0)
    trace = Trace.from_steps("ababa", ["right", "right", "around", "right"])
    assert [cost[0] for cost in near_minimal_maps(trace, Theory.topological(), 1)] == [2, 3]


@pytest.mark.slow
def test_true_map_of_aces3_is_within_three_dstates() -> None:
    """With stars, and places before paths, it is one of the best twelve that have 22 dstates."""
    trace = Trace.load(ACES3)
    true = [
        (step.truth["place"], step.truth["heading"])
        for step in trace.steps
        if isinstance(step.truth, dict)
    ]
    solution = solve(trace, Theory(prefer=("dstates", "places", "paths")), max_maps=None, within=3)
    assert solution.complete
    assert [(level.cost.dstates, level.count) for level in solution.levels] == [
        (19, 6),
        (20, 6),
        (22, 12),
    ]
    assert solution.cost == solution.levels[0].cost == Cost(19, 8, 5)
    places = [place for place, _ in true]
    right = [
        all(
            len(set(zip(found, truth, strict=True))) == len(set(found)) == len(set(truth))
            for found, truth in ((m.labels, true), (places_of_steps(m), places))
        )
        for m in solution.maps
    ]
    assert right.count(True) == 1
    assert right.index(True) >= 12


def test_within_one_lists_all_maps_if_only_dstates_are_preferred() -> None:
    """Maps of one number of dstates are all equally good, so a level has all of them."""
    route = Trace.load(ACES3)[:16]
    solution = solve(route, Theory(prefer=("dstates",)), max_maps=None, within=1)
    assert [(level.cost.dstates, level.count) for level in solution.levels] == [(12, 3), (13, 4)]


@pytest.mark.parametrize(("maps", "levels"), [(7, [2, 3, 2]), (11, [2, 3, 6])])
def test_near_minimal_maps_are_ordered_by_cost_and_cut_at_max_maps(
    maps: int, levels: list[int]
) -> None:
    solution = solve(Trace.load(ACES3)[:16], max_maps=maps, within=3)
    assert [level.count for level in solution.levels] == levels
    assert solution.complete == (maps == 11)
    assert solution.stopped == (None if maps == 11 else "maps limit")
    assert solution.status is Status.OPTIMAL
    assert solution.summary.endswith(f"; and {maps - 2} with up to 3 more")


@pytest.mark.parametrize("theory", [Theory.causal(), Theory.topological().replace(star="frame")])
def test_near_minimal_maps_equal_those_under_a_rule_for_their_size(
    theory: Theory,
) -> None:
    """The minimal maps are replayed from a prefix; for the others the whole trace is asked.

    The rule is one of a user's own, which no speed-up knows.
    """
    trace = Trace.load(EXAMPLE).prefix(20)
    if theory.star == "frame":
        trace = Trace.load(ACES3)[:16]
    solution = solve(trace, theory, within=1, max_maps=None)
    assert solution.complete
    least, more = solution.levels
    text = (
        "% @axiom(number) Just so many dstates.\n#program check(t).\nviolation(number,t) :- "
        f"query(t), #count {{ S : is(S,S) }} != {more.cost.dstates}."
    )
    asked = solve(trace, theory.replace(rules=(Rules("number.lp", text),)), max_maps=None)
    assert asked.cost == more.cost
    assert set(solution.maps[least.count :]) == set(asked.maps)
    assert set(solution.maps[: least.count]) == set(solve(trace, theory, max_maps=None).maps)


def test_interrupted_list_keeps_the_maps_found() -> None:
    search = Search(Trace.load(ACES3)[:18], Theory(star="none"), max_maps=None, within=3)
    found = []
    for ssh_map in search:
        found.append(ssh_map)
        if len(found) == 40:
            search.interrupt()
    solution = search.solution(tuple(found))
    assert solution.stopped == "interrupted"
    assert not solution.complete
    assert solution.status is Status.OPTIMAL
    assert [level.cost.dstates for level in solution.levels] == [14, 15]
    assert solution.count == sum(level.count for level in solution.levels) == len(solution.costs)


def test_within_may_exceed_the_number_of_steps() -> None:
    solution = solve(Trace.from_steps("aa", ["travel"]), within=10**12)
    assert solution.complete
    assert solution.count == 1


@pytest.mark.parametrize("within", [-1, 1.5, True, "2", None])
def test_wrong_within_is_an_error(within: object) -> None:
    with pytest.raises(
        SolverError, match=r"within \(--set within=K\): expected a whole number, 0 or more, got"
    ):
        solve(Trace.from_steps("a", []), within=within)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def near() -> dict[str, Any]:
    """The output of `solve --set within=3 --json` for the real route."""
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        assert main(["solve", ACES3, "--set", "within=3", "--json"]) == 0
    return dict(json.loads(printed.getvalue()))


@pytest.mark.slow
def test_json_has_the_cost_of_each_near_minimal_map(near: dict[str, Any]) -> None:
    assert near["within"] == 3
    assert near["cost"] == {"dstates": 19, "places": 10, "paths": 4}
    assert [(level["cost"]["dstates"], level["count"]) for level in near["levels"]] == [
        (19, 4),
        (20, 1),
        (22, 6),
    ]
    assert [ssh_map["cost"] for ssh_map in near["maps"]] == [
        level["cost"] for level in near["levels"] for _ in range(level["count"])
    ]
    assert [len(ssh_map["dstates"]) for ssh_map in near["maps"]] == [
        ssh_map["cost"]["dstates"] for ssh_map in near["maps"]
    ]


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({}, None),
        ({"within": 2}, "expected 20 to 21 dstates in map 6, as within is 2, got 22"),
        ({"within": "much"}, "within: expected a whole number, 0 or more, got 'much'"),
        ({"levels": []}, "levels: expected"),
        ({"maps": [4, 0]}, "expected 20 to 23 dstates in map 2, as within is 3, got 19"),
    ],
)
def test_check_finds_false_claims_on_near_minimal_maps(
    near: dict[str, Any], change: dict[str, Any], fault: str | None
) -> None:
    """If `change` has maps, these are the numbers of the maps to list."""
    chosen = change.get("maps", range(near["count"]))
    answer = near | change | {"maps": [near["maps"][i] for i in chosen], "count": len(chosen)}
    maps = [SSHMap.from_dict(ssh_map) for ssh_map in answer["maps"]]
    trace = Trace.load(ACES3)
    false = false_claims(answer, maps, len(trace), settle(trace).theory, 19)
    assert (fault in "; ".join(false)) if fault else not false


def test_check_finds_a_map_with_a_false_cost(near: dict[str, Any]) -> None:
    maps = [SSHMap.from_dict(ssh_map) for ssh_map in near["maps"]]
    wrong = [ssh_map | {"cost": near["cost"]} for ssh_map in near["maps"]]
    trace = Trace.load(ACES3)
    false = false_claims(near | {"maps": wrong}, maps, len(trace), settle(trace).theory, 19)
    assert len(false) == 7
    assert false[0] == (
        "maps[4].cost: expected 20 dstates, 10 places, 4 paths, as the map has these, got 19 "
        "dstates, 10 places, 4 paths"
    )
