"""What all minimal maps share, with and without the list of all maps."""

from __future__ import annotations

import json
import pickle
import random
from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from itertools import combinations, combinations_with_replacement
from pathlib import Path
from unittest.mock import patch

import aces
import pytest
from brute_force import Key, minimal_maps
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import TOYS, theories, traces
from turns import STEPWISE, stepwise
from worlds import HEADINGS, QUARTERS, TWO_BLOCKS, Streets, drive, rectangle, written

from benchmarks.instances import maze
from ssh_abduction import OnlineMapper, Theory, Trace, solve
from ssh_abduction.cli import main
from ssh_abduction.data import MapError, Odometry, SolverError
from ssh_abduction.rivals import difference
from ssh_abduction.solution import Solution, Status
from ssh_abduction.solution.result import summary_of
from ssh_abduction.solution.sharing import Backbone, Shared
from ssh_abduction.solver import Search, Start, find_backbone
from ssh_abduction.solver import search as search_module
from ssh_abduction.solver.sources.exact import choosing, prefixes
from ssh_abduction.solver.sources.exact.labels_first import LabelsFirst
from ssh_abduction.solver.sources.exact.readable import StepEngine

ACES3 = "examples/aces3-route.jsonl"
LIMIT = 100  # seconds: a search that does not end is a failure, not a hang


def expected_pairs(
    keys: set[Key], one: Callable[[Key, int, int], bool], steps: int
) -> dict[tuple[int, int], str]:
    """For each pair of steps, whether they are one in all, some, or none of the maps."""
    said = {1: "all", 0: "none"}
    shares = {
        (i, j): sum(one(key, i, j) for key in keys) / len(keys)
        for i, j in combinations_with_replacement(range(steps), 2)
    }
    return {pair: said.get(share, "some") for pair, share in shares.items()}


def one_dstate(key: Key, i: int, j: int) -> bool:
    return key[0][i] == key[0][j]


def at_one_place(key: Key, i: int, j: int) -> bool:
    return key[1][key[0][i]] == key[1][key[0][j]]


def along_one_path(key: Key, i: int, j: int) -> bool:
    here, there = key[2][key[0][i]], key[2][key[0][j]]
    return here is not None and there is not None and here[0] == there[0]


def along_one_course(key: Key, i: int, j: int) -> bool:
    here, there = key[2][key[0][i]], key[2][key[0][j]]
    return here is not None and here == there


SORTS = {
    "dstates": one_dstate,
    "places": at_one_place,
    "paths": along_one_path,
    "courses": along_one_course,
}


def agrees(backbone: Backbone, keys: set[Key], steps: int) -> None:
    """The backbone says of each pair of steps what the maps of the brute force say."""
    for sort, shared in backbone.sorts.items():
        for (i, j), said in expected_pairs(keys, SORTS[sort], steps).items():
            if i != j and (sort == "dstates" or backbone.dstates.one_in(i, j) != "all"):
                assert shared.one_in(i, j) == said, (sort, i, j)
            elif sort == "paths":  # a step with itself: whether it is along a path
                first = shared.always.index(shared.always[i])
                assert ((first, first) in shared.sometimes) == (said == "some"), i


@settings(max_examples=6)
@given(st.data())
def test_backbone_equals_the_brute_force(data: st.DataObject) -> None:
    """The backbone comes from a complete list, or from one map of a list that was cut off. The
    first prefixes are too short."""
    trace = data.draw(traces(max_steps=6), label="trace")
    theory = data.draw(theories(trace), label="theory")
    toys = [toy for toy in TOYS if toy.rules in theory.rules]
    counts, keys = minimal_maps(trace, theory, lambda key: all(toy.allows(key) for toy in toys))
    first_prefix = data.draw(st.sampled_from([1, prefixes.FIRST_PREFIX]), label="first prefix")
    # By default engines that settle dstates first are used for longer traces, and those for places
    # without frames only if clingo is slow.
    few_steps = data.draw(st.sampled_from([0, choosing.FEW_STEPS]), label="few steps")
    frame_after = data.draw(st.sampled_from([0.0, STEPWISE]), label="frame after")
    with (
        patch.object(prefixes, "FIRST_PREFIX", first_prefix),
        patch.object(choosing, "FEW_STEPS", few_steps),
        stepwise(frame_after),
        patch.multiple(search_module, ONE_MORE=0.0, ONE_MORE_SHARE=0.0),
    ):
        every = solve(trace, theory, max_maps=None, time_limit=LIMIT)
        first = solve(trace, theory, max_maps=1, time_limit=LIMIT)
        search = Search(trace, theory, max_maps=1, time_limit=LIMIT, _start=Start(reasons=True))
        reasoned = search.solution(tuple(search)).backbone
        found = find_backbone(first, time_limit=LIMIT)
    if counts is None:
        assert every.backbone is first.backbone is reasoned is found is None
        assert every.summary == "no map satisfies the axioms"
        return
    for backbone in (every.backbone, reasoned, found):
        assert backbone is not None
        assert backbone.proven
        agrees(backbone, keys, len(trace))
    assert every.summary.startswith(f"{len(keys)} minimal map")


SHARED = (
    "the same dstates; the places of steps 15–18 and 21 differ; the paths of steps 18–22 differ"
)


@pytest.mark.slow
def test_backbone_from_one_map_equals_that_of_all_maps() -> None:
    every, first = aces.solution(), aces.solution(max_maps=1)
    assert every.summary == f"4 minimal maps: {SHARED}"
    backbone = find_backbone(first)
    assert backbone == every.backbone
    assert (
        summary_of(first, 1, backbone)
        == f"at least 1 minimal map (listing was stopped by the maps limit): {SHARED}"
    )


def walk(world: Streets, place: str, steps: int, seed: int) -> Trace:
    """A random walk that begins facing east."""
    chance, start, facing = random.Random(seed), place, HEADINGS.index("E")
    actions = []
    for _ in range(steps):
        ahead = world[place].get(HEADINGS[facing])
        actions.append(chance.choice(["R", "L", *(["T"] * 3 if ahead else [])]))
        if actions[-1] == "T" and ahead:
            place = ahead
        else:
            facing = (facing + QUARTERS[actions[-1]]) % 4
    return drive(world, start, "E", actions)


@pytest.mark.parametrize(
    ("frame_after", "engine"),
    [pytest.param(60.0, StepEngine, marks=pytest.mark.slow), (0.0, LabelsFirst)],
)
def test_each_engine_can_prove_the_backbone_from_one_map(frame_after: float, engine: type) -> None:
    """32 maps that also differ in dstates. A prefix of the readable encodings lists them, or the
    engine that finds dstates first."""
    trace, theory = walk(TWO_BLOCKS, "a1", 50, 1), Theory(boundary="none", prefer=("dstates",))
    with stepwise(frame_after):
        every, first = solve(trace, theory, max_maps=None), solve(trace, theory, max_maps=1)
        search = Search(trace, theory, max_maps=1, _start=Start(reasons=True))
        reasoned = search.solution(tuple(search))
    assert type(search.parts.prefixes.engine) is engine
    assert every.count == 32
    assert find_backbone(first) == reasoned.backbone == every.backbone
    assert every.backbone is not None
    assert len(every.backbone.dstates.always) == len(trace)
    assert every.backbone.dstates.differing
    assert (first.effort.prefix < len(trace)) == (engine is StepEngine)


@pytest.mark.slow
def test_backbone_of_a_maze_with_stars_comes_from_its_labels() -> None:
    """Seven maps in three labellings."""
    trace = maze(5, 5, steps=100, seed=1, stars=True).trace
    every, search = (
        solve(trace, max_maps=None),
        Search(trace, max_maps=1, _start=Start(reasons=True)),
    )
    first = search.solution(tuple(search))
    assert every.count == 7
    assert type(search.parts.prefixes.engine) is LabelsFirst
    assert find_backbone(first) == first.backbone == every.backbone
    assert find_backbone(solve(trace, max_maps=1)) == every.backbone
    assert "7 minimal maps: the dstates of steps 80, 83–84, 97 and 99–100 differ" in every.summary


def test_interrupted_list_leaves_the_backbone_unproven() -> None:
    trace = Trace.load(ACES3)
    search = Search(trace, Theory(star="none"), max_maps=2, _start=Start(reasons=True))
    found = []
    for ssh_map in search:
        found.append(ssh_map)
        search.interrupt()
    solution = search.solution(tuple(found))
    assert solution.backbone is not None
    assert not solution.backbone.proven
    assert solution.summary.startswith(
        "at least 1 minimal map (listing was interrupted): the same dstates, places and paths, as "
        "far as"
    )


def test_solution_is_a_plain_value(tmp_path: Path) -> None:
    """A solution survives pickle, copies and files, and finds a backbone only if asked."""
    solution = solve(aces.route(16), max_maps=1)
    solution.save(tmp_path / "maps.json")
    loaded = Solution.load(tmp_path / "maps.json", solution.trace)
    copies = [pickle.loads(pickle.dumps(solution)), deepcopy(solution), replace(solution), loaded]
    for same in copies:
        assert same == solution
        assert hash(same) == hash(solution)
        assert same.to_dict() == solution.to_dict()
        assert same.backbone == solution.backbone
        assert same.backbone is not None
        assert not same.backbone.proven
    backbone = find_backbone(loaded)
    assert backbone is not None
    assert backbone.proven
    assert find_backbone(replace(loaded, shared=backbone)) is backbone


def test_find_backbone_without_time_returns_the_unproven_backbone() -> None:
    solution = aces.solution(max_maps=1)
    assert find_backbone(solution, time_limit=1e-9) == solution.backbone


def test_a_backbone_needs_the_trace(tmp_path: Path) -> None:
    data = solve(aces.route(16), max_maps=1).to_dict()
    (tmp_path / "maps.json").write_text(json.dumps({**data, "trace": None}))
    loaded = Solution.load(tmp_path / "maps.json")
    with pytest.raises(SolverError, match="trace: expected the trace that was solved, got none"):
        find_backbone(loaded)
    with pytest.raises(MapError):
        find_backbone(loaded, rectangle(14))
    assert find_backbone(loaded, aces.route(16)) is not None


def test_online_backbone_is_that_of_the_listed_maps() -> None:
    mapper = OnlineMapper("end", time_limit=None)
    for action, view in [
        ("travel", "hall"),
        ("travel", "end"),
        ("around", "end"),
        ("travel", "hall"),
    ]:
        mapper.observe(action, view)
    assert (
        mapper.solution.summary
        == "2 minimal maps: the same dstates and paths; the place of step 4 differs"
    )


@pytest.mark.parametrize(
    ("theory", "summary"),
    [(Theory.causal(), "1 minimal map"), (Theory(same=[(0, 1)]), "no map satisfies the axioms")],
)
def test_the_summary_is_a_sentence(theory: Theory, summary: str) -> None:
    assert aces.solution(theory).summary == summary


def test_no_backbone_without_a_proven_minimal_map() -> None:
    solution = solve(Trace.load(ACES3), time_limit=1e-9)
    assert solution.status is Status.FEASIBLE
    assert solution.backbone is None
    assert solution.summary == "a map that is not proven minimal"


def test_solve_prints_the_backbone_of_a_cut_list(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = str(tmp_path / "trace.jsonl")
    written("end T hall T end A end T hall").save(path)
    shared = "the same dstates and paths; the place of step 4 differs"
    told = {}
    for words in (("-n", "1"), ("-n", "0")):
        assert main(["solve", path, *words]) == 0
        text = capsys.readouterr().out
        assert main(["solve", path, *words, "--json"]) == 0
        told[words[1]] = (text, json.loads(capsys.readouterr().out))
    (cut_text, cut), (every_text, every) = told["1"], told["0"]
    assert cut["summary"] == (
        f"at least 1 minimal map (listing was stopped by the maps limit): {shared}"
    )
    assert f"\n{cut['summary']}\n" in cut_text
    assert "steps at one dstate in all minimal maps" in cut_text
    assert "at one place in some of them: the steps 0 and 4, 1 and 4" in cut_text
    assert every["summary"] == f"2 minimal maps: {shared}"
    assert f"\n{every['summary']}\n" in every_text
    assert "steps at one dstate" not in every_text
    assert cut["backbone"] == every["backbone"]
    assert cut["backbone"]["proven"]
    assert cut["backbone"]["dstates"] == {"always": every["maps"][0]["labels"], "sometimes": []}
    assert len(cut["backbone"]["places"]["always"]) == every["cost"]["dstates"]
    assert cut["backbone"]["places"]["sometimes"] == [[0, 4], [1, 4]]


def test_backbone_writes_1000_pairs_and_counts_all() -> None:
    pairs = tuple((0, t) for t in range(1, 1501))
    told = Shared((*range(1501),), pairs).to_dict([0, 1])
    assert (told["always"], len(told["sometimes"]), told["pairs"]) == ([0, 1], 1000, 1500)


def test_difference_finds_maps_that_differ_only_in_directions() -> None:
    trace = maze(3, 3, steps=40, seed=4242, stars=True, follow=True, odometry=Odometry()).trace
    solution = solve(trace, Theory(weigh="count"), max_maps=None)
    pairs = [
        (m, n)
        for m, n in combinations(solution.maps, 2)
        if [s.path for s in m.dstates] == [s.path for s in n.dstates]
    ]
    assert pairs
    for one, other in pairs:
        found = difference(one, other)
        told = {
            t for change in found.changes for group in (*change.first, *change.other) for t in group
        }
        assert {change.sort for change in found.changes} == {"courses"}
        assert {
            t
            for t, (s, x) in enumerate(zip(one.labels, other.labels, strict=True))
            if one.dstates[s] != other.dstates[x]
        } <= told
        line, *sides = found.lines
        assert line.startswith("directions along paths: the first map groups steps ")
        assert all(side.startswith("sides: only ") for side in sides)
