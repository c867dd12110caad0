"""Scores of maps against named truth: compared with naive counts, and with known figures."""

from __future__ import annotations

import json
import random
import re
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import combinations, pairwise, permutations
from pathlib import Path
from typing import Any

import aces
import pytest
from aces import ACES
from worlds import TOURS, drive, rectangle

from ssh_abduction import SSHMap, Theory, Trace, evaluate, solve
from ssh_abduction.cli import main
from ssh_abduction.data import DState, MapError, TraceError
from ssh_abduction.evaluation import Evaluation, MapEvaluation

ROOT = Path(__file__).parent.parent


def with_truth(trace: Trace, truths: Sequence[Any]) -> Trace:
    """The trace with this truth, one value per step."""
    return replace(
        trace,
        steps=tuple(
            replace(step, truth=truth) for step, truth in zip(trace.steps, truths, strict=True)
        ),
    )


def walk(truths: Sequence[Any]) -> Trace:
    """A trace of travels without views, with this truth."""
    return with_truth(
        Trace.from_steps("v" * len(truths), [{"name": "go", "kind": "travel"}] * (len(truths) - 1)),
        truths,
    )


def labelled(
    labels: Sequence[int],
    places: Sequence[int | None] | None = None,
    courses: Sequence[tuple[int, int] | None] | None = None,
) -> SSHMap:
    """A map with these labels, and with the place and the course of each dstate."""
    size = max(labels) + 1
    at, along = places or [None] * size, courses or [None] * size
    dstates = tuple(DState(i, "v", at[i], *(along[i] or (None, None))) for i in range(size))
    return SSHMap(tuple(labels), dstates, (), tuple(sorted({p for p in at if p is not None})))


def evaluation_of(ssh_map: SSHMap, trace: Trace) -> MapEvaluation:
    (found,) = evaluate([ssh_map], trace).maps
    return found


def share(part: int, whole: int) -> float | None:
    return part / whole if whole else None


# Counted naively


def naive_accuracy(labels: Sequence[int], truths: Sequence[Any]) -> float | None:
    """Every one-to-one assignment is tried."""
    known = [(x, y) for x, y in zip(labels, truths, strict=True) if y is not None]
    own, true = sorted({x for x, _ in known}), sorted({y for _, y in known})
    spare = [*true, *([None] * len(own))]  # an unassigned dstate is never right
    best = max(
        sum(assigned[own.index(x)] == y for x, y in known)
        for assigned in permutations(spare, len(own))
    )
    return share(best, len(known))


def naive_edges(said: Sequence[int], true: Sequence[int]) -> set[tuple[float | None, float | None]]:
    """Precision and recall of edges under each one-to-one assignment that fits most steps."""
    own = sorted(set(said))
    spare = [*sorted(set(true)), *(-1 - x for x in own)]  # a negative place means no place
    assignments = [
        dict(zip(own, assigned, strict=True)) for assigned in permutations(spare, len(own))
    ]
    fits = [
        sum(assigned[x] == y for x, y in zip(said, true, strict=True)) for assigned in assignments
    ]
    edges = {frozenset(edge) for edge in pairwise(said)}
    true_edges = {frozenset(edge) for edge in pairwise(true)}
    found = set()
    for assigned, fit in zip(assignments, fits, strict=True):
        if fit == max(fits):
            right = len({frozenset(assigned[x] for x in edge) for edge in edges} & true_edges)
            found.add((share(right, len(edges)), share(right, len(true_edges))))
    return found


def naive_pairs(said: Sequence[int], true: Sequence[Any]) -> tuple[float | None, float | None]:
    both = of_map = of_truth = 0
    for i, j in combinations(range(len(said)), 2):
        if true[i] is not None and true[j] is not None:
            both += said[i] == said[j] and true[i] == true[j]
            of_map += said[i] == said[j]
            of_truth += true[i] == true[j]
    return share(both, of_map), share(both, of_truth)


@pytest.mark.parametrize("seed", range(40))
def test_accuracy_and_pairs_equal_naive_counts(seed: int) -> None:
    rng = random.Random(seed)
    steps = rng.randint(2, 12)
    labels = [rng.randrange(4) for _ in range(steps)]
    place = [rng.randrange(3) for _ in range(4)]
    true_place = [rng.randrange(3) for _ in range(4)]
    names = [rng.choice([0, 1, 2, 3, None]) for _ in range(steps - 1)] + [0]
    trace = walk(
        [None if d is None else {"dstate": d, "place": f"p{true_place[d]}"} for d in names]
    )
    found = evaluation_of(labelled([*labels[:-1], 3], place), trace)
    labels[-1] = 3
    assert found.accuracy == naive_accuracy(labels, names)
    true = [None if d is None else true_place[d] for d in names]
    assert (found.place_precision, found.place_recall) == naive_pairs(
        [place[x] for x in labels], true
    )
    known = [(x, y) for x, y in zip(labels, names, strict=True) if y is not None]
    assert found.dstates_right == all(
        (a == b) == (c == d) for (a, c), (b, d) in combinations(known, 2)
    )
    assert found.dstates == len({x for x, _ in known})


@pytest.mark.parametrize("seed", range(15))
def test_edge_scores_equal_the_best_assignment(seed: int) -> None:
    rng = random.Random(seed)
    said = [*(rng.randrange(4) for _ in range(10)), 3]
    true = [x if rng.random() < 0.6 else rng.randrange(4) for x in said]
    found = evaluation_of(labelled(said, range(4)), walk([{"place": place} for place in true]))
    assert (found.edge_precision, found.edge_recall) in naive_edges(said, true)


@pytest.mark.parametrize("seed", range(20))
def test_evaluation_does_not_depend_on_names(seed: int) -> None:
    rng = random.Random(seed)
    labels = [*(rng.randrange(6) for _ in range(15)), 5]
    truths = [rng.randrange(6) for _ in labels]
    place, true_place = ([rng.randrange(4) for _ in range(6)] for _ in range(2))
    course, true_course = (
        [(rng.randrange(2), rng.choice([1, -1])) for _ in range(6)] for _ in range(2)
    )

    def figures(ids: Sequence[int], names: Sequence[Any], flip: int) -> Evaluation:
        """Call dstate i ids[i] in the map and names[i] in the truth, and reverse the paths."""
        at = {ids[i]: i for i in range(6)}
        places = [ids[place[at[x]]] for x in range(6)]
        courses = [(1 - course[at[x]][0], flip * course[at[x]][1]) for x in range(6)]
        trace = walk(
            [
                {
                    "dstate": names[y],
                    "place": [names[true_place[y]]],
                    "path": names[true_course[y][0]],
                    "direction": true_course[y][1],
                }
                for y in truths
            ]
        )
        return evaluate([labelled([ids[x] for x in labels], places, courses)], trace)

    plain = figures(range(6), range(6), 1)
    assert (
        figures(rng.sample(range(6), 6), rng.sample(["a", "b", 3, [1, 2], {"x": 1}, True], 6), -1)
        == plain
    )


# Maps that are known


@pytest.mark.parametrize("tour", ["square", "tee", "plus", "comb"])
def test_a_map_is_isomorphic_to_itself_as_the_truth(tour: str) -> None:
    trace = drive(*TOURS[tour], stars=True)
    solution = solve(trace, max_maps=3)
    for ssh_map in solution.maps:
        at = [ssh_map.dstates[label] for label in ssh_map.labels]
        truths = [
            {"dstate": f"d{s.id}", "place": s.place, "path": s.path, "direction": s.direction}
            for s in at
        ]
        found = evaluate(solution.maps, with_truth(trace, truths))
        assert found.rank == 1 + solution.maps.index(ssh_map)  # minimal maps differ
        assert found.maps[found.rank - 1] == MapEvaluation(
            True,
            True,
            True,
            *[1.0] * 7,
            len(ssh_map.dstates),
            len(ssh_map.places),
            len(ssh_map.paths),
        )
        assert (found.true_dstates, found.true_places, found.true_paths) == (
            len(ssh_map.dstates),
            len(ssh_map.places),
            len(ssh_map.paths),
        )


def test_evaluation_of_the_notched_rectangle() -> None:
    names = [f"x{i % 8}" for i in range(41)]
    trace = with_truth(
        rectangle(40), [{"dstate": x, "place": "ABCD"[int(x[1]) // 2]} for x in names]
    )
    found = evaluate(solve(trace).maps, trace)
    assert (found.rank, found.true_dstates, found.true_places, found.true_paths) == (1, 8, 4, None)
    assert found.ambiguity == 4 / 28  # four pairs of opposite dstates
    causal = evaluation_of(solve(trace, Theory.causal()).maps[0], trace)
    assert (causal.dstates, causal.isomorphic, causal.accuracy) == (
        4,
        False,
        21 / 41,
    )  # opposite corners are taken for one
    assert (causal.places, causal.places_right, causal.place_precision, causal.edge_recall) == (
        None,
        None,
        None,
        None,
    )
    assert (causal.link_precision, causal.link_recall) == (3 / 4, 3 / 8)


def test_no_minimal_map_of_the_aces_route_is_true() -> None:
    trace = Trace.load(ACES)
    found = evaluate(aces.solution().maps, trace)
    assert (len(found.maps), found.rank, found.steps) == (4, None, 23)
    assert (found.true_dstates, found.true_places, found.true_paths) == (22, 9, None)
    for each in found.maps:
        assert (each.isomorphic, each.dstates, each.places, each.paths) == (False, 19, 10, None)
        assert each.accuracy == 19 / 23  # four steps are at a dstate that the map takes for another


def test_precision_and_recall_of_edges_equal_hand_counts() -> None:
    # Truth: A – B – C – A, driven once around and back to B. The map takes C for A, so that it has
    # the edges A – B and A – A.
    trace = walk([{"place": p} for p in "ABCABA"])
    found = evaluation_of(labelled([0, 1, 0, 0, 1, 0], [0, 1]), trace)
    assert (found.edge_precision, found.edge_recall) == (1 / 2, 1 / 3)
    assert found.link_precision is None  # the truth names no dstates


def test_evaluation_ignores_turns_as_edges() -> None:
    trace = with_truth(
        Trace.from_steps("vvvv", ["right", "travel", "left"]), [{"place": p} for p in "AABB"]
    )
    found = evaluation_of(labelled([0, 1, 2, 3], [0, 0, 0, 0]), trace)
    assert (found.edge_precision, found.edge_recall) == (0, 0)  # the turns alone are right


def test_steps_without_a_place_share_no_place() -> None:
    found = evaluation_of(labelled([0, 0, 1, 1], [0, None]), walk([{"place": p} for p in "AABB"]))
    assert (found.place_precision, found.place_recall, found.places_right) == (1, 1 / 2, False)


def test_evaluation_omits_links_without_truth() -> None:
    found = evaluation_of(labelled([0, 1, 2, 0, 1]), walk(["a", "b", None, "a", "b"]))
    assert (found.accuracy, found.dstates, found.link_precision, found.link_recall) == (1, 2, 1, 1)
    assert evaluation_of(labelled([0, 1, 2]), walk(["a", None, "b"])).link_recall is None


def test_evaluation_judges_dstates_places_and_paths_separately() -> None:
    truths = [{"dstate": i, "place": i // 2, "path": i % 2, "direction": 1} for i in range(4)]
    courses = [(0, 1), (1, 1), (0, 1), (1, 1)]

    def levels(ssh_map: SSHMap) -> tuple[bool | None, ...]:
        found = evaluation_of(ssh_map, walk(truths))
        return found.isomorphic, found.dstates_right, found.places_right, found.paths_right

    right = [0, 0, 1, 1]
    assert levels(labelled(range(4), right, courses)) == (True, True, True, True)
    assert levels(labelled(range(4), right, [(0, -1), (1, 1), (0, -1), (1, 1)])) == (
        True,
        True,
        True,
        True,
    )
    assert levels(labelled(range(4), right, [(0, 1), (1, 1), (0, -1), (1, 1)])) == (
        False,
        True,
        True,
        False,
    )  # another direction
    assert levels(labelled(range(4), right, [(0, 1), (1, 1), (2, 1), (1, 1)])) == (
        False,
        True,
        True,
        False,
    )  # another path
    assert levels(labelled(range(4), right, [(0, 1), (1, 1), None, (1, 1)])) == (
        False,
        True,
        True,
        False,
    )  # along no path
    assert levels(labelled(range(4), [0, 1, 2, 2], courses)) == (False, True, False, True)
    assert levels(labelled([0, 1, 0, 1], [0, 1], [(0, 1), (1, 1)])) == (False, False, False, True)
    assert levels(labelled(range(4))) == (True, True, None, None)
    truths = [{k: v for k, v in truth.items() if k != "direction"} for truth in truths]
    assert levels(labelled(range(4), right, [(0, 1), (1, 1), (0, -1), (1, 1)])) == (
        True,
        True,
        True,
        True,
    )


@pytest.mark.parametrize(
    ("truths", "counts"),
    [
        (["a", "b", "a"], (3, 2, None, None)),
        ([1, "1", True], (3, 3, None, None)),
        ([[0, 0, "E"], [0, 0, "N"], [0, 0, "E"]], (3, 2, None, None)),
        (
            [{"place": "N", "heading": "E"}, {"place": "N", "heading": "S"}, {"place": "N"}],
            (3, 2, 1, None),
        ),
        (
            [{"dstate": "x", "heading": 1}, {"dstate": "x", "heading": 2}, {"pose": [0, 0, 0]}],
            (2, 1, None, None),
        ),
        ([{"path": "main", "direction": 1}, {"dstate": "x", "place": None}, None], (2, 1, None, 1)),
    ],
)
def test_truth_is_read_in_all_its_forms(truths: list[Any], counts: tuple[int | None, ...]) -> None:
    found = evaluate([], walk(truths))
    assert (found.steps, found.true_dstates, found.true_places, found.true_paths) == counts


def test_ambiguity_counts_dstates_not_steps() -> None:
    seen = Trace.from_steps(["a", "a", "b", "c", "a", "b"], ["go"] * 5)
    assert (
        evaluate([], with_truth(seen, ["u", "v", "w", "x", "u", "x"])).ambiguity == 2 / 6
    )  # u and v by a, w and x by b
    assert evaluate([], with_truth(seen, ["u"] * 6)).ambiguity is None
    blind = replace(seen, steps=tuple(replace(step, view=None, image=0) for step in seen.steps))
    assert evaluate([], with_truth(blind, "uvwxux")).ambiguity is None


def test_to_dict_of_an_evaluation_has_its_attributes() -> None:
    found = evaluate([labelled([0, 1, 0])], walk(["a", "b", "a"]))
    assert (found.rank, len({found, replace(found)})) == (1, 1)
    data = found.to_dict()
    assert json.loads(json.dumps(data)) == data
    assert set(data) == {
        "count",
        "rank",
        "steps",
        "true_dstates",
        "true_places",
        "true_paths",
        "ambiguity",
        "maps",
    }
    text = (ROOT / "docs" / "reference" / "formats.md").read_text()
    for name in (*data, *data["maps"][0]):
        assert f"`{name}`" in text


# Errors


@pytest.mark.parametrize(
    ("truths", "message"),
    [
        ([None] * 3, "trace: truth: expected the true dstate or place of some step, got none"),
        (
            [{"pose": [1]}] * 3,
            "trace: truth: expected the true dstate or place of some step, got none",
        ),
        (["a", {1, 2}, "b"], "step 1: truth: expected what JSON can hold, got {1, 2}"),
        (
            [{"dstate": "x", "place": "A"}, "y", {"dstate": "x", "place": "B"}],
            "step 2: truth.place: expected 'A', as step 0 says of the same dstate, got 'B'",
        ),
        (
            [
                {"dstate": "x", "path": "A", "direction": 1},
                "x",
                {"dstate": "x", "path": "A", "direction": -1},
            ],
            "step 2: truth.direction: expected 1, as step 0 says of the same dstate, got -1",
        ),
    ],
)
def test_unusable_truth_is_refused(truths: list[Any], message: str) -> None:
    with pytest.raises(TraceError, match=f"^{re.escape(message)}"):
        evaluate([labelled([0, 1, 2])], walk(truths))


def test_evaluate_refuses_malformed_maps() -> None:
    trace = walk("aba")
    with pytest.raises(
        MapError,
        match=r"^maps\[1\]: labels: expected 3, one for each step of the trace, got 2; solve this",
    ):
        evaluate([labelled([0, 1, 0]), labelled([0, 1])], trace)
    with pytest.raises(
        MapError, match=r"^maps\[0\]: labels: expected 0 to 1, the dstates of the map, got 7"
    ):
        evaluate([replace(labelled([0, 1, 0]), dstate_at=(0, 1, 7))], trace)
    with pytest.raises(MapError, match=r"^maps\[0\]: expected an SSHMap, got 5"):
        evaluate([5], trace)  # type: ignore[list-item]
    with pytest.raises(TraceError, match=r"^trace: expected a Trace"):
        evaluate([], "trace.jsonl")  # type: ignore[arg-type]


def test_evaluation_does_not_import_the_solver() -> None:
    program = "import sys, ssh_abduction.evaluation; print(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, cwd=ROOT
    )
    loaded = {".".join(name.split(".")[:2]) for name in done.stdout.split()}
    assert "ssh_abduction.evaluation" in loaded
    rooms = ("learning", "online", "solver", "checker", "theory", "rivals")
    assert not loaded & {"clingo", *(f"ssh_abduction.{room}" for room in rooms)}


# The shell


@pytest.fixture
def solved(tmp_path: Path) -> str:
    """The minimal maps of the ACES3 route, as solve --json prints them."""
    (tmp_path / "maps.json").write_text(aces.answer())
    return str(tmp_path / "maps.json")


def test_evaluate_prints_a_table(solved: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", solved, ACES]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "4 maps: none is the true one"
    assert (
        lines[1] == "the truth, known at 23 of 23 steps: 22 dstates, 9 places; "
        "13 % of the pairs of dstates share a view"
    )
    assert re.sub(r"  +", "|", lines[3]).startswith("|1|no|19 wrong|10 wrong|–|0.826|")
    assert len(lines) == 3 + 4


def test_evaluate_prints_json(solved: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", solved, ACES, "--json"]) == 0
    trace = Trace.load(ACES)
    assert json.loads(capsys.readouterr().out) == evaluate(aces.solution().maps, trace).to_dict()


def test_evaluate_prints_which_map_is_true(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names = [f"x{i % 8}" for i in range(25)]
    trace = with_truth(rectangle(24), names)
    trace.save(tmp_path / "trace.jsonl")
    (ssh_map,) = solve(trace).maps
    ssh_map.save(tmp_path / "map.json")
    files = [str(tmp_path / "map.json"), str(tmp_path / "trace.jsonl")]
    assert main(["evaluate", *files]) == 0
    out = capsys.readouterr().out
    assert out.startswith(
        "1 map: map 1 is the true one\nthe truth, known at 25 of 25 steps: 8 dstates; 14 % of"
    )
    assert (
        re.sub(r" +", " ", out.splitlines()[-1]) == " 1 yes 8 right – – 1.000 – – – – 1.000 1.000"
    )
    labelled([0] * 25).save(tmp_path / "map.json")
    assert main(["evaluate", *files]) == 0
    assert capsys.readouterr().out.startswith("1 map: none is the true one\n")
    with_truth(trace, [{"place": name} for name in names]).save(tmp_path / "trace.jsonl")
    assert main(["evaluate", *files]) == 0
    assert capsys.readouterr().out.startswith(
        "1 map: unknown which is the true one, as the truth names"
    )
    solve(Trace.load(ACES), max_maps=2).save(tmp_path / "map.json")
    assert main(["evaluate", files[0], ACES]) == 0
    assert capsys.readouterr().out.startswith("2 maps, and there may be more: ")


def test_evaluate_errors_are_one_line(
    solved: str, tmp_path: Path, refuses: Callable[..., None]
) -> None:
    bare, short, none = tmp_path / "bare.jsonl", tmp_path / "short.jsonl", tmp_path / "none.json"
    with_truth(Trace.load(ACES), [None] * 23).save(bare)
    Trace.load(ACES).prefix(9).save(short)
    none.write_text('{"maps": []}')
    for words, message in [
        (
            [solved, str(bare)],
            f"{bare}: truth: expected the true dstate or place of some step, got none; write",
        ),
        (
            [solved, str(short)],
            f"{solved}: maps[0]: labels: expected 9, one for each step of the trace, got 23; "
            "solve this trace",
        ),
        ([str(none), ACES], f"{none}: expected maps, got none"),
        ([solved, solved], f"{solved}:1: header: expected a trace, got maps, as solve prints them"),
        ([str(tmp_path / "nosuch"), ACES], "nosuch: expected a readable file of maps"),
    ]:
        refuses(["evaluate", *words], message)
