"""Comparisons of rival maps: against explicit lists and brute force, and malformed files."""

from __future__ import annotations

import contextlib
import io
import json
import random
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from itertools import combinations, product
from math import prod
from pathlib import Path

import aces
import numpy as np
import pytest
from brute_force import divisions
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import theories, traces
from worlds import rectangle, written

from benchmarks.instances import maze
from ssh_abduction import Solution, SSHMap, Theory, Trace, compare, solve
from ssh_abduction.cli import main
from ssh_abduction.cli import solve as solving
from ssh_abduction.cli.text import compared
from ssh_abduction.data import MapError
from ssh_abduction.data.maps import DState, Fault, Fit, MapPath
from ssh_abduction.page.content import content_of
from ssh_abduction.rivals import Comparison, Listing, difference, shared_sides
from ssh_abduction.rivals.listing import PairInMap
from ssh_abduction.rivals.questions import Matter, Question, deciding, independent
from ssh_abduction.solution.sharing import Backbone, Sharing
from ssh_abduction.solution.weighed import Rival, Weighed
from ssh_abduction.solver import find_backbone
from ssh_abduction.solver import search as searching
from ssh_abduction.solver.parts import Priced

FREE_PLACES = Theory(star="none", prefer=("dstates", "places", "paths"))


relations = st.integers(1, 5).flatmap(
    lambda n: st.lists(
        st.lists(st.booleans(), min_size=n, max_size=n), min_size=1, max_size=12, unique_by=tuple
    )
)


def _product(
    blocks: Sequence[Sequence[tuple[bool, ...]]], order: Sequence[int]
) -> list[list[bool]]:
    rows = [[x for part in parts for x in part] for parts in product(*blocks)]
    return [[row[i] for i in order] for row in rows]


products = st.lists(
    st.integers(1, 2).flatmap(
        lambda n: st.lists(st.tuples(*[st.booleans()] * n), min_size=1, max_size=3, unique=True)
    ),
    min_size=1,
    max_size=3,
).flatmap(
    lambda blocks: st.permutations(range(sum(len(block[0]) for block in blocks))).map(
        lambda order: _product(blocks, order)
    )
)


@settings(max_examples=30)
@given(relations | products)
def test_choices_equal_the_finest_division_by_brute_force(rows: list[list[bool]]) -> None:
    table = np.array(rows, dtype=bool)

    def is_product(division: list[list[int]]) -> bool:
        return prod(len({tuple(row[i] for i in part) for row in rows}) for part in division) == len(
            rows
        )

    finest = max(
        (division for division in divisions(len(rows[0])) if is_product(division)), key=len
    )
    assert {frozenset(part) for part in independent(table.T)} == {
        frozenset(part) for part in finest
    }


@settings(max_examples=50)
@given(relations)
def test_deciding_questions_are_a_minimal_set_that_separates_maps(rows: list[list[bool]]) -> None:
    table = np.array(rows, dtype=bool)
    chosen = deciding(table.T, len(rows))

    def apart(questions: Sequence[int]) -> int:
        return len({tuple(row[i] for i in questions) for row in rows})

    assert apart(chosen) == len(rows)
    assert all(apart([j for j in chosen if j != i]) < len(rows) for i in chosen)
    if (
        chosen
    ):  # the first one splits most pairs, or was made superfluous by others that split as many
        most = max(sum(a[i] != b[i] for a, b in combinations(rows, 2)) for i in range(len(rows[0])))
        first = chosen[0]
        assert (
            sum(a[first] != b[first] for a, b in combinations(rows, 2)) == most or len(chosen) > 1
        )


def is_one(ssh_map: SSHMap, sort: Matter, i: int, j: int) -> bool:
    """Whether two steps are one in a map, without arrays."""
    here, there = (ssh_map.dstates[ssh_map.labels[t]] for t in (i, j))
    if sort == "dstates":
        return here.id == there.id
    if sort == "places":
        return here.place is not None and here.place == there.place
    if sort == "paths":
        return here.path is not None and here.path == there.path
    return here.path is not None and (here.path, here.direction) == (there.path, there.direction)


def answer(ssh_map: SSHMap, question: Question) -> bool:
    return (
        question.fault in ssh_map.faults
        if question.fault
        else is_one(ssh_map, question.sort, question.first, question.later)
    )


def holds_of(found: Comparison, maps: Sequence[SSHMap]) -> None:
    """Check all claims of a comparison against the explicit list."""
    pairs = list(combinations(range(found.steps), 2))
    for i, j in random.Random(0).sample(pairs, min(len(pairs), 100)):
        for sort, shared in found.listed.sorts.items():
            in_maps = sum(is_one(m, sort, i, j) for m in maps)
            # Steps of one dstate share a number even if they are along no path.
            if sort == "dstates" or found.listed.dstates.one_in(i, j) != "all":
                said = {0: "none", len(maps): "all"}.get(in_maps, "some")
                assert shared.one_in(i, j) == said
    assert len({tuple(answer(m, q) for q in found.deciding) for m in maps}) == len(maps)
    asked = [question for choice in found.choices for question in choice.questions]
    assert sorted(map(str, asked)) == sorted(map(str, found.deciding))
    assert prod(len(choice.options) for choice in found.choices) == len(maps)
    assert len(set(product(*(range(len(choice.options)) for choice in found.choices)))) == len(maps)
    for choice in found.choices:
        assert sorted(i for option in choice.options for i in option.maps) == list(
            range(1, len(maps) + 1)
        )
        for option in choice.options:
            assert len(option.maps) * len(choice.options) == len(maps)
            assert {
                tuple(answer(maps[i - 1], q) for q in choice.questions) for i in option.maps
            } == {option.answers}
    for question in found.deciding:
        assert question.yes == sum(answer(m, question) for m in maps)
        assert 0 < question.yes < len(maps)
        if not question.fault:
            assert {
                answer(m, replace(question, first=i, later=question.later))
                for m in maps
                for i in question.here
                if i != question.later
            } <= {True, False}
            for side, step in ((question.here, question.first), (question.there, question.later)):
                assert all(
                    is_one(m, question.sort, step, t)
                    for m in maps
                    for t in side
                    if is_one(m, question.sort, step, step)
                )
    assert sorts_differing(found) == naive_differing(maps)


def sorts_differing(found: Comparison) -> dict[str, set[int]]:
    told: dict[str, set[int]] = {}
    for differing in (*(choice.differing for choice in found.choices), found.together):
        for sort, steps in differing.items():
            if sort != "faults":
                told.setdefault(sort, set()).update(steps)
    return told


def naive_differing(maps: Sequence[SSHMap]) -> dict[str, set[int]]:
    """The steps whose first equal step differs between maps."""
    steps = range(len(maps[0].labels))
    sorts: tuple[Matter, ...] = ("dstates", "places", "paths", "courses")
    found = {
        sort: {
            t
            for t in steps
            if len({next((i for i in steps if is_one(m, sort, i, t)), None) for m in maps}) > 1
        }
        for sort in sorts
    }
    return {sort: differing for sort, differing in found.items() if differing}


@settings(max_examples=7)
@given(st.data())
def test_comparison_is_true_of_the_listed_maps(data: st.DataObject) -> None:
    trace = data.draw(traces(max_steps=6), label="trace")
    maps = solve(trace, data.draw(theories(trace), label="theory"), max_maps=60, time_limit=10).maps
    if not maps:
        return
    if len(maps) > 1 and data.draw(
        st.booleans(), label="few"
    ):  # any maps of one trace are compared, not only all minimal ones
        maps = tuple(
            data.draw(
                st.lists(st.sampled_from(maps), min_size=1, max_size=7, unique=True), label="maps"
            )
        )
    holds_of(compare(maps), maps)
    for one, other in list(combinations(maps, 2))[:5]:
        regroups(one, other)


def regroups(one: SSHMap, other: SSHMap) -> None:
    """Applying the difference of two maps to the first one gives the other one."""
    found = difference(one, other)
    assert (str(found) == "the maps are the same") == found.same == (one == other)
    moved_courses = {
        t
        for change in found.changes
        if change.sort == "paths"
        for group in (*change.first, *change.other)
        for t in group
    }
    for sort in ("dstates", "places", "paths", "courses"):
        groups = [naive_groups(ssh_map, sort) for ssh_map in (one, other)]
        changes = [change for change in found.changes if change.sort == sort]
        for change in changes:
            assert set(change.first) <= groups[0]
            assert set(change.other) <= groups[1]
            assert set(change.first) != set(change.other)
        kept = [
            g - {x for c in changes for x in side(c)}
            for g, side in zip(groups, (lambda c: c.first, lambda c: c.other), strict=True)
        ]
        if sort == "courses":
            kept = [{g for g in some if moved_courses.isdisjoint(g)} for some in kept]
        assert kept[0] == kept[1]


def naive_groups(ssh_map: SSHMap, sort: Matter) -> set[tuple[int, ...]]:
    steps = range(len(ssh_map.labels))
    return {
        group for t in steps if (group := tuple(i for i in steps if is_one(ssh_map, sort, i, t)))
    }


@cache
def with_free_places() -> Solution:
    return solve(aces.route(18), FREE_PLACES, max_maps=None)


def test_compare_finds_maps_that_differ_only_in_places() -> None:
    solution = with_free_places()
    found = compare(solution)
    assert (
        found.sentence
        == solution.summary
        == "18 minimal maps: the same dstates and paths; the places of steps 14–17 differ"
    )
    assert found.variants == {"dstates": 1, "places": 18, "paths": 1, "courses": 1}
    assert {question.sort for question in found.deciding} == {"places"}
    holds_of(found, solution.maps)


def test_compare_names_segments_of_maps_that_differ_only_in_paths() -> None:
    solution = solve(maze(5, 5, steps=100, seed=1, stars=True).trace, max_maps=None)
    maps = [m for m in solution.maps if m.labels == solution.maps[0].labels]
    found = compare(maps)
    assert len(maps) == 4
    assert found.sentence.startswith("4 maps: the same dstates and places; the paths of steps ")
    assert {question.sort for question in found.deciding} == {"paths", "courses"}
    assert all(question.places for question in found.deciding)
    holds_of(found, maps)


def test_compare_splits_independent_choices_into_factors() -> None:
    solution = solve(aces.route(18), Theory(prefer=("dstates",)), max_maps=None)
    found = compare(solution)
    assert found.product == "6 = 2 x 3"
    holds_of(found, solution.maps)
    assert "  6 = 2 x 3: each combination of these choices is a map" in list(compared(found))


def of_streets(rng: random.Random, count: int, dstates: int, steps: int) -> list[SSHMap]:
    """Maps of many dstates that differ in places, paths and labels at random."""
    maps = []
    for _ in range(count):
        labels = tuple(range(dstates)) + tuple(
            rng.randrange(dstates - 3, dstates) if t % 50 == 0 else t % dstates
            for t in range(steps - dstates)
        )
        states = tuple(
            DState(
                i,
                "v",
                i // 4 if rng.random() < 0.99 else 0,
                i // 10 if rng.random() < 0.99 else 1,
                rng.choice([1, 1, 1, -1]),
            )
            for i in range(dstates)
        )
        places = tuple(sorted({s.place for s in states if s.place is not None}))
        paths = tuple(
            MapPath(h, ()) for h in sorted({s.path for s in states if s.path is not None})
        )
        maps.append(SSHMap(labels, states, (), places, paths).renumbered())
    return maps


@pytest.mark.parametrize("seed", range(3))
def test_map_ids_do_not_depend_on_numbering(seed: int) -> None:
    rng = random.Random(seed)
    maps = aces.solution().maps
    assert len({m.id for m in maps}) == len(maps)
    for ssh_map in maps:
        number, place, path = (
            rng.sample(range(n), n)
            for n in (len(ssh_map.dstates), len(ssh_map.places), len(ssh_map.paths))
        )
        way = [rng.choice([1, -1]) for _ in path]
        states = [
            replace(
                s,
                id=number[s.id],
                place=place[s.place or 0],
                path=path[s.path or 0],
                direction=(s.direction or 0) * way[s.path or 0],
            )
            if s.path is not None
            else replace(s, id=number[s.id], place=place[s.place or 0])
            for s in ssh_map.dstates
        ]
        other = replace(
            ssh_map,
            dstate_at=tuple(number[label] for label in ssh_map.labels),
            dstates=tuple(sorted(states, key=lambda s: s.id)),
            links=tuple((number[s], action, number[x]) for s, action, x in ssh_map.links),
            paths=tuple(
                MapPath(path[p.id], tuple(place[q] for q in p.order[:: way[p.id]]))
                for p in ssh_map.paths
            ),
        )
        assert other.id == ssh_map.id
        assert compare([ssh_map], [other]).others is not None
        assert difference(ssh_map, other).same
    assert replace(maps[0], faults=(Fault(3, "slipped", "travel"),)).id != maps[0].id


LISTS = """
import sys
from benchmarks.instances import maze
from ssh_abduction import Theory, Trace, solve
for trace, theory in ((Trace.load("examples/aces3-route.jsonl")[:16], None), (maze(5, 5, steps=40,
seed=3).trace, Theory.causal())):
    print([ssh_map.id for ssh_map in solve(trace, theory, max_maps=None).maps])
"""


def test_map_ids_and_their_order_are_reproducible() -> None:
    there = subprocess.run(
        [sys.executable, "-c", LISTS],
        env={"PYTHONHASHSEED": "4242", "PYTHONPATH": "."},
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    with contextlib.redirect_stdout(io.StringIO()) as here:
        exec(LISTS, {})
    assert here.getvalue() == there
    assert there.count("[") == 2


def test_maps_are_listed_in_one_order_however_they_are_found(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    usual = with_free_places()
    found = searching.Search._found

    def shuffled(search: searching.Search) -> Iterator[Priced]:
        maps = list(found(search))
        random.Random(7).shuffle(maps)
        return iter(maps)

    monkeypatch.setattr(searching.Search, "_found", shuffled)
    again = solve(aces.route(18), FREE_PLACES, max_maps=None)
    assert [m.id for m in again.maps] == [m.id for m in usual.maps]
    assert again.cost == usual.cost


def test_map_with_the_least_misfit_is_listed_first() -> None:
    trace = maze(3, 3, steps=40, seed=4242, stars=True, follow=True, odometry=None).trace
    maps = solve(trace, max_maps=None).maps
    fitted = [replace(m, fit=Fit(float(len(maps) - i), 3, 0.5)) for i, m in enumerate(maps)]
    from ssh_abduction.solver.geometry.ranking import in_order

    ordered = in_order(fitted, [len(fitted)])
    assert [m.fit and m.fit.chi2 for m in ordered] == sorted(m.fit.chi2 for m in fitted if m.fit)
    assert in_order(ordered[::-1], [len(fitted)]) == ordered


@pytest.fixture
def file_of(tmp_path: Path) -> Callable[..., Path]:
    """A file of what `solve --json` prints for the route of ACES3 or another trace."""

    def written_by(*options: str, trace: str = aces.ACES, name: str = "maps.json") -> Path:
        path = tmp_path / name
        path.write_text(aces.answer(*options, trace=trace))
        return path

    return written_by


def test_compare_in_the_shell_prints_the_result_of_python(
    file_of: Callable[..., Path], capsys: pytest.CaptureFixture[str]
) -> None:
    path = file_of()
    solution = aces.solution()
    found = compare(solution)
    assert main(["compare", str(path)]) == 0
    assert capsys.readouterr().out.startswith(
        f"{solution.verdict}\n{solution.summary}\n  4 = 2 x 2: "
    )
    assert main(["compare", str(path), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    joins = printed.pop("by_minimality")
    assert joins == [join.to_dict() for join in solution.by_minimality]
    sides = shared_sides(Listing.of(solution))
    assert sides is not None
    assert printed.pop("sides") == json.loads(json.dumps(sides.to_dict()))
    assert printed == json.loads(json.dumps(found.to_dict()))
    told = difference(solution.maps[0], solution.maps[2], ("map 1", "map 3"))
    for names in (("1", "3"), (found.ids[0], found.ids[2])):
        assert main(["compare", str(path), "--diff", *names]) == 0
        assert capsys.readouterr().out == f"{told}\n"
    assert main(["compare", str(path), "--diff", "1", "3", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["words"] == list(told.lines)
    assert main(["compare", str(path), "--diff", "2", "2"]) == 0
    assert capsys.readouterr().out == "the maps are the same\n"


@pytest.mark.slow
def test_compare_uses_the_backbone_of_a_cut_list(
    file_of: Callable[..., Path], capsys: pytest.CaptureFixture[str]
) -> None:
    cut, every = file_of("-n", "2", name="cut.json"), file_of()
    assert main(["compare", str(cut), str(every)]) == 0
    printed = capsys.readouterr().out
    verdict, sentence = printed.splitlines()[:2]
    assert verdict.endswith("Proven minimal, one of 2 or more such maps.")
    assert sentence.startswith(
        "at least 2 minimal maps (listing was stopped by the maps limit): the same dstates; the "
        "places of steps 15–18 and 21 differ; "
    )
    assert "of the 2 maps listed: " in printed
    assert "only in maps that are not listed: the " in printed
    assert "2 in both, 0 only in the first and 2 only in " in printed
    found = compare(Listing.load(cut))
    assert found.shared.proven
    assert not found.listed.proven
    assert found.shared == replace(compare(Listing.load(every)).shared, proven=True)
    assert found.unlisted
    solution = aces.solution(max_maps=2)
    python = compare(replace(solution, shared=find_backbone(solution)))
    assert python.shared == found.shared


def test_compare_says_that_a_stopped_list_may_lack_maps() -> None:
    maps = aces.solution().maps
    listing = Listing(maps[:2], minimal=2, complete=False, stopped="time limit")
    assert compare(listing).sentence.endswith("as far as is known: other maps may differ in more")
    assert compare(maps[:1]).sentence == "1 map"


def test_compare_reads_causal_maps_and_maps_with_faults() -> None:
    causal = solve(maze(5, 5, steps=60, seed=3).trace, Theory.causal(), max_maps=None)
    found = compare(causal)
    assert set(found.variants) == {"dstates"}
    holds_of(found, causal.maps)
    seen = [f"v{t % 4}" if t != 9 else "v0" for t in range(14)]
    faulty = solve(
        Trace.from_steps(seen, (["right", "travel"] * 7)[:13]),
        Theory.causal().replace(misread=0.5, slipped=0.5),
        max_maps=None,
    )
    assert len({m.faults for m in faulty.maps}) > 1
    told = compare(faulty)
    holds_of(told, faulty.maps)
    assert told.deciding[0].sort == "faults"
    assert str(told.deciding[0]).startswith(("the view at step ", "the action at step "))
    one, other = next((m, n) for m, n in combinations(faulty.maps, 2) if m.faults != n.faults)
    assert any(
        line.startswith("faults: only in the first map the ")
        for line in difference(one, other).lines
    )


def test_compare_separates_minimal_from_larger_maps(
    file_of: Callable[..., Path], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    aces.route(16).save(tmp_path / "trace.jsonl")
    path = file_of("--set", "within=3", trace=str(tmp_path / "trace.jsonl"))
    assert main(["compare", str(path)]) == 0
    printed = capsys.readouterr().out
    verdict, sentence = printed.splitlines()[:2]
    assert verdict.endswith("Proven minimal, one of 2 such maps.")
    assert sentence.startswith("2 minimal maps, and 9 larger ones: ")
    assert "  2 maps with 12 dstates, " in printed


def edited(path: Path, change: Callable[[dict[str, object]], object]) -> Path:
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))
    return path


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d["maps"][1]["labels"].__setitem__(4, 0), "maps[1]: id: expected "),
        (lambda d: d["maps"][1].update(id="no"), "maps[1]: id: expected "),
        (lambda d: d.update(maps=[]), "count: expected 0, the number of maps listed, got 4"),
        (lambda d: d.update(maps=5), "maps: expected a list, got 5"),
        (lambda d: d.update(steps=7), "prefix: expected 0 to 7, the number of steps of the trace"),
        (lambda d: d.update(complete="yes"), "complete: expected true or false, got 'yes'"),
        (
            lambda d: d.update(backbone=[]),
            "backbone: expected an object with proven and dstates, got []",
        ),
        (
            lambda d: d["backbone"]["dstates"]["always"].pop(),
            "backbone: dstates.always: expected 23 numbers",
        ),
        (
            lambda d: d["backbone"]["places"].update(sometimes=[[0, 99]]),
            "backbone: places.sometimes[0][1]: expected a step from 0 to 22",
        ),
        (
            lambda d: (d.update(complete=False), d["backbone"]["places"].update(sometimes=[])),
            "backbone: places: it contradicts the listed maps",
        ),
        (
            lambda d: (d["maps"][0]["dstates"][0].update(view="x"), d["maps"][0].pop("id")),
            "expected the view 'x' at step 0, as ",
        ),
        (lambda d: d["theory"].update(level="no"), "level"),
        (lambda d: d.update(levels=[]), "levels: expected 4 maps in all"),
    ],
)
def test_compare_refuses_edited_files(
    file_of: Callable[..., Path],
    refuses: Callable[..., None],
    change: Callable[[dict[str, object]], object],
    message: str,
) -> None:
    refuses(["compare", str(edited(file_of(), change))], message)


def test_compare_refuses_maps_of_other_traces(
    file_of: Callable[..., Path], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    path = file_of()
    rectangle(22).save(tmp_path / "other.jsonl")
    rectangle(9).save(tmp_path / "short.jsonl")
    other, short = (
        file_of(trace=str(tmp_path / "other.jsonl"), name="other.json"),
        file_of(trace=str(tmp_path / "short.jsonl"), name="short.json"),
    )
    for words, message in (
        (
            (str(path), str(other)),
            "expected the view 'open-ahead-right-back' at step 0, as the maps of ",
        ),
        ((str(path), str(short)), "expected 23 steps, as the maps of "),
        (
            (str(path), "--diff", "1", "9"),
            "expected the number of a map, 1 to 4, or its id, got '9'",
        ),
        (
            (str(path), "--diff", "0", "1"),
            "expected the number of a map, 1 to 4, or its id, got '0'",
        ),
        ((str(path), "--diff", "abcdef012345", "1"), "or its id, got 'abcdef012345'"),
    ):
        assert main(["compare", *words]) == 1
        assert message in capsys.readouterr().err
    maps, others = aces.solution().maps, solve(rectangle(9)).maps
    for wrong, said in (
        ([maps[0], others[0]], "maps[1]: expected 23 steps, as maps[0] has, got 10"),
        ([maps[0], 5], "maps[1]: expected an SSHMap, got 5"),
        (
            "maps.json",
            "maps: expected a solution or maps, got 'maps.json'; read a file with Listing.load",
        ),
        (7, "maps: expected a solution or maps, got 7"),
        ([], "maps: expected maps, got none"),
    ):
        with pytest.raises(MapError) as error:
            compare(wrong)  # type: ignore[arg-type]
        assert str(error.value).startswith(said)
    with pytest.raises(
        MapError, match="expected two of one trace, got one of 23 steps and one of 10"
    ):
        difference(maps[0], others[0])


def test_backbone_without_all_pairs_survives_a_round_trip() -> None:
    maps = of_streets(random.Random(3), 6, 60, 90)
    backbone = Sharing(maps).backbone(proven=True)
    again = Backbone.from_dict(json.loads(json.dumps(backbone.to_dict())), 90)
    assert again.sentence == backbone.sentence
    for sort, shared in backbone.sorts.items():
        assert again.sorts[sort].differing == shared.differing
        assert again.sorts[sort].always == shared.always


def test_json_streams_maps_that_exceed_memory(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    held = json.loads(aces.answer())
    monkeypatch.setattr(solving, "HELD", 2)
    streamed = json.loads(aces.answer.__wrapped__())
    assert [m["id"] for m in held["maps"]] == [m.id for m in aces.solution().maps]
    assert {m["id"] for m in streamed["maps"]} == {m["id"] for m in held["maps"]}
    assert streamed["count"] == held["count"] == len(streamed["maps"])


def test_comparison_of_one_map_is_empty() -> None:
    found = compare(solve(written("a T b")))
    assert (found.sentence, found.choices, found.deciding, found.product) == (
        "1 minimal map",
        (),
        (),
        "",
    )
    assert list(compared(found)) == []


def test_compare_accepts_dstates_along_no_path() -> None:
    """Steps of one dstate in the listed maps, but along no path, are along one path in no map."""
    trace = Trace.from_steps("bbaabaa", ["travel", "left", "left", "left", "around", "around"])
    solution = solve(trace, max_maps=2)
    cut = compare(replace(solution, shared=find_backbone(solution, time_limit=30)))
    assert cut.complete is False
    assert cut.shared.proven
    assert cut.shared.sentence == compare(solve(trace, max_maps=None)).shared.sentence


def test_unfinished_search_gives_no_probability_of_joins() -> None:
    trace = Trace.from_steps("abca", ["travel"] * 3)
    ssh_map = solve(trace).maps[0]
    at = ((0, 1, 2, 0), (0, 1, 2, 3))
    rivals = (Rival(5.0, at[0], at[0]), Rival(6.0, at[1], at[1]))
    for bound, told in ((5.0, True), (1.0, False)):
        listing = Listing((ssh_map,), weighed=Weighed(bound, 3.0, rivals))
        pair = PairInMap.of(listing, 0, 3)
        assert pair is not None
        assert (pair.probability is not None) == told
        assert ("probability" in str(pair)) == told
        content = content_of(listing)
        assert bool(content["joins"]) == told
        assert ("did not finish" in content["sureness"]) != told
