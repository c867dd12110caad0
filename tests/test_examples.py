"""The examples run, and show what they say."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from ssh_abduction import Status, Theory, Trace, solve
from ssh_abduction.judge.checker import check

EXAMPLES = Path(__file__).parent.parent / "examples"


def run(*words: str) -> str:
    return subprocess.run([sys.executable, *words], capture_output=True, text=True, check=True).stdout


@pytest.mark.parametrize(
    ("name", "theory", "counts", "maps"),
    [
        ("aces3-route", Theory.topological(), (19, 10, 4), 4),
        ("notched-rectangle", Theory.topological(), (8, 4, 4), 1),
        ("notched-rectangle", Theory.circumscriptive(), (8, 4, 4), 1),
        ("notched-rectangle", Theory.causal(), (4, 0, 0), 1),
        ("adventure", Theory.causal(), (6, 0, 0), 1),
    ],
)
def test_example_traces(name: str, theory: Theory, counts: tuple[int, int, int], maps: int) -> None:
    trace = Trace.load(EXAMPLES / f"{name}.jsonl")
    solution = solve(trace, theory)
    assert solution.status is Status.OPTIMAL
    assert solution.complete
    assert solution.cost is not None
    assert ((solution.cost.dstates, solution.cost.places, solution.cost.paths), solution.count) == (counts, maps)
    for ssh_map in solution.maps:
        assert check(trace, ssh_map, theory) == ()


def test_every_example_trace_is_tested() -> None:
    assert {path.stem for path in EXAMPLES.glob("*.jsonl")} == {"aces3-route", "notched-rectangle", "adventure"}


def test_x0_and_x4_share_a_view_and_are_told_apart() -> None:
    trace = Trace.load(EXAMPLES / "notched-rectangle.jsonl")
    (ssh_map,) = solve(trace).maps
    assert len(trace) == 400
    assert trace.views[0] == trace.views[4]
    assert ssh_map.labels[:16] == (0, 1, 2, 3, 4, 5, 6, 7) * 2


def test_demo(tmp_path: Path) -> None:
    out = run(str(EXAMPLES / "demo.py"), str(tmp_path))
    assert "fewest: 19 dstates, 10 places, 4 paths; 4 minimal maps" in out
    assert out.count("satisfies every axiom") == 4
    assert "what tells them apart" in out
    assert (tmp_path / "aces3-map.svg").read_text().startswith("<svg ")


def test_adventure(tmp_path: Path) -> None:
    assert run(str(EXAMPLES / "adventure.py")).endswith("6 rooms, 1 minimal map(s)\nthe map is the maze\n")
    run(str(EXAMPLES / "adventure.py"), "--play", str(tmp_path / "again.jsonl"))
    assert (tmp_path / "again.jsonl").read_text() == (EXAMPLES / "adventure.jsonl").read_text()
