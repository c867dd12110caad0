"""The ladder: the effect of each kind of evidence. Each rung has one more."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
import truth

from ssh_abduction import Theory, Trace
from ssh_abduction.cli import main
from ssh_abduction.data import Odometry
from ssh_abduction.evaluation.rungs import UnderWay, ladder

SQUARE = Trace.from_steps(
    "ab" * 4 + "a", ["travel", "right"] * 4, displacements=[(10, 0, 0), (0, 0, -1.5708)] * 4
)


@cache
def aces3() -> truth.Known:
    (known,) = truth.aces3([3], truth.Noise(Odometry(**truth.NOISE)))
    return known


@pytest.mark.slow
def test_ladder_finds_the_true_map_of_aces3_with_displacements() -> None:
    rungs = {rung.name: rung for rung in ladder(aces3().trace)}
    assert list(rungs) == ["views", "+ star", "+ pairs", "+ geometry", "+ planarity"]
    assert [rung.solution.cost.dstates for rung in rungs.values() if rung.solution.cost] == [
        19,
        19,
        22,
        22,
        22,
    ]
    assert [rung.rank for rung in rungs.values()] == [None, None, 1, 1, 1]
    assert [rung.solution.count for rung in rungs.values()][2:] == [1, 1, 1]
    assert [rung.solution.theory.star for rung in rungs.values()] == ["none", *["frame"] * 4]


def test_ladder_omits_rungs_without_evidence() -> None:
    trace = aces3().trace.prefix(8)
    assert [rung.name for rung in ladder(trace.without_displacements(), max_maps=1)] == [
        "views",
        "+ star",
        "+ planarity",
    ]
    causal = {
        rung.name: rung.solution.theory.star for rung in ladder(trace, Theory.causal(), max_maps=1)
    }
    assert causal == {
        "views": "none",
        "+ star": "alike",
        "+ pairs": "alike",
        "+ geometry": "alike",
    }  # planarity is about places


def test_interrupted_ladder_returns_the_rungs_so_far() -> None:
    under_way = UnderWay()
    names = []
    for rung in ladder(SQUARE, under_way=under_way):
        names.append(rung.name)
        if len(names) == 2:
            under_way.interrupt()
    assert names == ["views", "+ pairs"]
    (only,) = ladder(SQUARE, under_way=under_way)
    assert (only.name, only.solution.stopped, only.evaluation) == ("views", "interrupted", None)


def test_ladder_omits_planarity_if_faults_are_allowed() -> None:
    trace = Trace.from_steps("aba", ["travel", "travel"])
    assert [rung.name for rung in ladder(trace, Theory.topological().replace(misread=1.5))] == [
        "views"
    ]


def test_ladder_prints_a_row_for_each_rung(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "route.jsonl"
    corners = [{"dstate": i % 8, "place": (i + 1) // 2 % 4} for i in range(len(SQUARE))]
    told = zip(SQUARE.steps, corners, strict=True)
    replace(SQUARE, steps=tuple(replace(step, truth=truth) for step, truth in told)).save(path)
    assert main(["ladder", str(path)]) == 0
    head, *rows = capsys.readouterr().out.splitlines()
    assert head.split()[:2] == ["minimal", "maps"]
    assert rows[0].split()[:6] == ["views", "1", "6", "3", "3", "none"]
    assert rows[2].split()[:8] == ["+", "geometry", "1", "8", "4", "4", "map", "1"]
    assert main(["ladder", str(path), "--json", "--theory", "causal", "-n", "1"]) == 0
    assert [json.loads(line)["name"] for line in capsys.readouterr().out.splitlines()] == [
        "views",
        "+ pairs",
        "+ geometry",
    ]
