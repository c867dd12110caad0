"""Benchmarks check answers and keep limits, and the pages show stored runs."""

from __future__ import annotations

import json
import math
import random
import re
from pathlib import Path
from typing import Any

import bench
import indoors
import pruning
import pytest
import readme
import table
from instances import moore
from peers import PEERS, Machine, Words
from suite import INSTANCES, SUITE

from ssh_abduction import Theory, Trace, solve
from ssh_abduction.theory.speedups import SPEEDUPS

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parent.parent
# All but the lists of corridors that a person drew.
STORED = sorted({*(ROOT / "benchmarks/results").glob("*.json")} - {indoors.DRAWN})
ALWAYS = {"instance", "theory", "tool", "seed", "status", "reason"}
MEASURED = {"images", "true_dstates", "seconds", "cpu", "memory"}
ELSEWHERE = {"digest"}  # measured by benchmarks/onto.py
OURS = {"dstates", "bound", "proven", "prefix", "ground", "solve", "rules", "atoms"}


def fewest(trace: Trace) -> int:
    cost = solve(trace, Theory.causal(), max_maps=1).cost
    assert cost
    return cost.dstates


def tiny(seed: int) -> Trace:
    chance = random.Random(seed)
    states = chance.randint(1, 4)
    return moore(
        states,
        chance.randint(1, states),
        steps=chance.randint(0, 14),
        seed=seed,
        actions=chance.randint(1, 3),
    ).trace


@pytest.mark.parametrize("name", PEERS)
def test_each_peer_finds_as_few_states_as_it_promises(name: str) -> None:
    peer = PEERS[name]
    if not peer.installed:
        pytest.skip(f"{name} is not installed")
    for seed in range(12):
        trace = tiny(seed)
        states = peer.find(trace).states(trace)
        assert states is not None, seed
        assert states == fewest(trace) if peer.proves else states >= fewest(trace), seed


def test_the_plain_encoding_agrees_with_the_solver() -> None:
    for seed in range(100, 140):
        assert PEERS["plain.lp"].find(tiny(seed)).states(tiny(seed)) == fewest(tiny(seed)), seed


def test_states_refuses_a_machine_with_other_views() -> None:
    trace = Trace.from_steps(["a", "b", "a"], ["travel", "travel"])
    right = Machine(0, lambda state, _: 1 - state, lambda state: "ab"[state])
    wrong = Machine(0, lambda state, _: min(state + 1, 1), lambda state: "ab"[state])
    assert (right.states(trace), wrong.states(trace)) == (2, None)


def test_peer_words_ask_for_a_view_bit_by_bit() -> None:
    words = Words(Trace.from_steps(["a", "b", "c", "b"], ["travel", "right", "travel"]))
    assert [list(words.at(t)) for t in (0, 2)] == [
        [([], False), (["2"], False)],
        [(["0", "1"], False), (["0", "1", "2"], True)],
    ]


def test_benchmark_cell_has_all_fields() -> None:
    ours = bench.run("ssh-abduction", SUITE["full aces3"], 0, 100, 4096)
    assert ours.keys() == ALWAYS | MEASURED | OURS
    assert (ours["status"], ours["dstates"], ours["proven"], ours["images"], ours["theory"]) == (
        "ok",
        19,
        True,
        23,
        "full",
    )
    theirs = bench.run("plain.lp", SUITE["rectangle n=400"], 0, 100, 4096)
    assert theirs.keys() == ALWAYS | MEASURED | {"dstates", "proven"}
    assert (theirs["status"], theirs["dstates"], theirs["true_dstates"]) == ("ok", 4, 8)


def test_benchmark_cell_ends_at_its_limit() -> None:
    late = bench.run("plain.lp", SUITE["maze 5x5 n=1600"], 0, 0.5, 4096)
    assert (late["status"], late["seconds"]) == ("timeout", 0.5)
    assert 0 < late["cpu"] < 1
    assert bench.run("plain.lp", SUITE["full aces3"], 0, 0.5, 4096)["status"] == "not applicable"


def cell(tool: str, status: str = "ok", seed: int = 0, **fields: Any) -> dict[str, Any]:
    return {
        "instance": "x",
        "tool": tool,
        "seed": seed,
        "status": status,
        "reason": "",
        "images": 9,
        **fields,
    }


def results(*cells: dict[str, Any]) -> dict[str, Any]:
    return {"limit": 10, "cells": list(cells)}


@pytest.mark.parametrize(
    ("ours", "theirs", "row"),
    [
        ({"seconds": 2}, {"seconds": 5}, "| 4 | 2.0 s | 7 | 5.0 s, 8 MB |"),
        (
            {"seconds": 2},
            {"status": "timeout", "seconds": 10, "proven": False},
            "| 4 | 2.0 s | 7 | > 10 s, 8 MB |",
        ),
        (
            {"status": "timeout", "seconds": 10, "proven": False, "bound": 3, "dstates": 6},
            {"status": "timeout", "seconds": 10, "proven": False},
            "| 3 – 4 | > 10 s | 7 | > 10 s, 8 MB |",
        ),
        (
            {"status": "timeout", "seconds": 10, "proven": False},
            {"seconds": 5},
            "| 4 | > 10 s | 7 | 5.0 s, 8 MB |",
        ),
        (
            {"seconds": 2},
            {"seconds": 1, "proven": False, "dstates": 9},
            "| 4 | 2.0 s | 7 | 1.0 s, 8 MB, 9 states |",
        ),
        (
            {"seconds": 2},
            {"status": "error", "seconds": 1, "reason": "it broke", "proven": False},
            "| 4 | 2.0 s | 7 | error¹, 8 MB |",
        ),
    ],
)
def test_benchmark_table_row_shows_its_cells(
    ours: dict[str, Any], theirs: dict[str, Any], row: str
) -> None:
    found = table.times(
        results(
            cell("ssh-abduction", **{"memory": 7, "dstates": 4, "proven": True, **ours}),
            cell("p", **{"memory": 8, "dstates": 4, "proven": True, **theirs}),
        )
    )
    assert row in re.sub(" +", " ", found)


def test_table_shows_the_median_and_number_solved_of_many_seeds() -> None:
    seconds = (1, 3, 10)
    cells = [
        cell(
            "ssh-abduction",
            "ok" if s < 10 else "timeout",
            seed,
            seconds=s,
            memory=5,
            proven=s < 10,
            dstates=4,
        )
        for seed, s in enumerate(seconds)
    ]
    assert "3.0 s (2 of 3)" in table.times(results(*cells))


def test_contradicting_benchmark_answers_are_named() -> None:
    proven, fewer, bound = (
        cell("a", dstates=4, proven=True),
        cell("b", dstates=3, proven=False),
        cell("c", "timeout", bound=5),
    )
    assert table.contradictions(results(proven, cell("b", dstates=5, proven=False))) == []
    assert table.contradictions(results(proven, fewer)) == [
        "x, seed 0: a proved 4 states, b found 3"
    ]
    assert table.contradictions(results(proven, bound)) == [
        "x, seed 0: c proved 5 states, a found 4"
    ]
    assert table.contradictions(results(proven, {**fewer, "seed": 1})) == []
    assert table.contradictions(results(cell("a", "wrong", reason="no"))) == ["x, seed 0: a: no"]


@pytest.mark.parametrize("path", STORED, ids=lambda path: path.name)
def test_stored_run_has_all_fields_and_no_contradiction(path: Path) -> None:
    run = json.loads(path.read_text())
    assert run.keys() == {"date", "limit", "memory", "seeds", "machine", "packages", "cells"}
    assert run["machine"].keys() == {"cpu", "cores", "memory", "system", "python"}
    for cell in run["cells"]:
        assert cell.keys() >= ALWAYS
        assert cell.keys() >= MEASURED or cell["status"] in (
            "not applicable",
            "not installed",
            "error",
        )
        assert cell["status"] != "ok" or cell.keys() >= {"dstates", "proven"} | (
            OURS if cell["tool"] == "ssh-abduction" else set()
        )
    assert table.contradictions(run) == []


def stored(page: str, name: str) -> Path:
    """The stored run that a table of a page names as its source."""
    found = re.search(
        rf"<!-- bench:begin {name} -->.*\((results/[\w.-]+\.json)\).*<!-- bench:end {name} -->",
        page,
        re.DOTALL,
    )
    assert found
    return ROOT / "benchmarks" / found[1]


@pytest.mark.parametrize("name", readme.PAGES)
def test_each_table_in_docs_equals_its_stored_run(name: str) -> None:
    text = readme.PAGES[name].read_text()
    run = json.loads(stored(text, name).read_text())
    assert readme.rewritten(text, name, run, stored(text, name)) == text
    assert readme.block(name, run, stored(text, name)) in text


@pytest.mark.parametrize(
    ("measure", "base", "without", "ratio"),
    [
        ("seconds", {"status": "ok", "seconds": 2}, {"status": "ok", "seconds": 3}, 1.5),
        ("seconds", {"status": "ok", "seconds": 2}, {"status": "timeout", "seconds": 11}, 5),
        ("seconds", {"status": "memory", "seconds": 1}, {"status": "ok", "seconds": 5}, 0.5),
        ("seconds", {"status": "timeout", "seconds": 10}, {"status": "timeout", "seconds": 10}, 1),
        ("dstates", {"dstates": 20}, {"dstates": 50}, 2.5),
        ("dstates", {"dstates": 20}, {"dstates": None}, math.inf),
        ("dstates", {}, {"dstates": None}, 1),
    ],
)
def test_pruning_ratio_of_a_speedup(
    measure: str, base: dict[str, Any], without: dict[str, Any], ratio: float
) -> None:
    assert pruning.ratio(measure, 10, base, without) == ratio


def test_speedup_stays_if_it_gains_on_two_families() -> None:
    assert pruning.verdict([[1, 1.5, 9], [1, 1, 1], [math.inf, 2, 0]]) == "stays"
    assert pruning.verdict([[1, 1.4, 9], [1, 1, 1], [math.inf, 2, 0]]) == "**goes**"
    assert pruning.verdict([[1, 1.4, 9], [1, 1, 1]]) == "not measured yet"


def test_each_speedup_is_tried_on_three_families() -> None:
    for name in {*SPEEDUPS} - ELSEWHERE:
        assert (
            len({trial.family for trial in pruning.TRIALS if trial.switch == name})
            >= pruning.FAMILIES
        ), name
    assert {trial.family for trial in pruning.TRIALS} <= set(INSTANCES)


def test_benchmark_limit_counts_processor_time() -> None:
    late = bench.run("ssh-abduction", SUITE["maze 8x8 n=4000"], 0, 0.5, 4096, "cpu")
    assert late["status"] == "timeout"
    assert late["seconds"] == pytest.approx(late["cpu"], abs=0.1)
    assert 0.3 < late["seconds"] < 5


def test_growth_picture_is_drawn_from_the_stored_run(tmp_path: Path) -> None:
    picture = tmp_path / "growth.png"
    import plot  # loads matplotlib

    plot.draw(json.loads(stored(readme.PAGES["peers"].read_text(), "peers").read_text()), picture)
    assert picture.stat().st_size > 10_000
