"""The examples run, and print the stored output."""

from __future__ import annotations

import ast
import contextlib
import io
import json
import runpy
import sys
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest

from ssh_abduction import Theory, Trace, solve
from ssh_abduction.checker.checker import check
from ssh_abduction.solution import Status

EXAMPLES = Path(__file__).parent.parent / "examples"


def run(name: str, *words: str) -> str:
    """The output of an example that runs as a program in this process."""
    path = str(EXAMPLES / name)
    with (
        patch.object(sys, "argv", [path, *words]),
        contextlib.redirect_stdout(io.StringIO()) as said,
    ):
        runpy.run_path(path, run_name="__main__")
    return said.getvalue()


@pytest.mark.parametrize(
    ("name", "theory", "counts", "maps"),
    [
        ("aces3-route", Theory.topological(), (19, 10, 4), 4),
        ("notched-rectangle", Theory.topological(), (8, 4, 4), 1),
        ("notched-rectangle", Theory.causal(), (4, 0, 0), 1),
        ("adventure", Theory.causal(), (6, 0, 0), 1),
    ],
)
def test_example_traces_have_the_documented_maps(
    name: str, theory: Theory, counts: tuple[int, int, int], maps: int
) -> None:
    trace = Trace.load(EXAMPLES / f"{name}.jsonl")
    solution = solve(trace, theory)
    assert solution.status is Status.OPTIMAL
    assert solution.complete
    assert solution.cost is not None
    assert ((solution.cost.dstates, solution.cost.places, solution.cost.paths), solution.count) == (
        counts,
        maps,
    )
    for ssh_map in solution.maps:
        assert check(trace, ssh_map, theory) == ()


def test_every_example_trace_is_tested() -> None:
    assert {path.stem for path in EXAMPLES.glob("*.jsonl")} == {
        "aces3-route",
        "notched-rectangle",
        "adventure",
    }


def test_notched_rectangle_separates_x0_and_x4_with_one_view() -> None:
    trace = Trace.load(EXAMPLES / "notched-rectangle.jsonl")
    (ssh_map,) = solve(trace).maps
    assert len(trace) == 400
    assert trace.views[0] == trace.views[4]
    assert ssh_map.labels[:16] == (0, 1, 2, 3, 4, 5, 6, 7) * 2


@pytest.mark.slow
def test_demo_prints_maps_and_writes_a_report(tmp_path: Path) -> None:
    out = run("demo.py", str(tmp_path))
    assert "fewest: 19 dstates, 10 places, 4 paths; 4 minimal maps" in out
    assert out.count("satisfies every axiom") == 4
    assert "what tells them apart" in out
    assert "11 places. 5 pairs of visits joined, none doubtful." in out
    assert (tmp_path / "house" / "page.html").exists()
    assert (tmp_path / "aces3-map.svg").read_text().startswith("<svg ")


def test_adventure_maps_the_maze_and_writes_its_trace(tmp_path: Path) -> None:
    assert run("adventure.py").endswith("6 rooms, 1 minimal map(s)\nthe map is the maze\n")
    run("adventure.py", "--play", str(tmp_path / "again.jsonl"))
    assert (tmp_path / "again.jsonl").read_text() == (EXAMPLES / "adventure.jsonl").read_text()


@pytest.mark.slow
def test_notebook_cells_print_their_stored_output(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each cell prints and returns what is stored beside it. Drawings are not compared."""
    cells = json.loads((EXAMPLES / "story.ipynb").read_text(encoding="utf-8"))["cells"]
    assert len(cells) == 20
    monkeypatch.chdir(EXAMPLES)
    space: dict[str, Any] = {}
    for cell in cells:
        if cell["cell_type"] == "code":
            said, value = executed("".join(cell["source"]), space)
            stored = {output["output_type"]: output for output in cell["outputs"]}
            assert said == "".join(stored.get("stream", {}).get("text", ()))
            shown = stored.get("execute_result")
            assert (None if value is None else repr(value)) == (
                shown and "".join(shown["data"]["text/plain"])
            )


def executed(text: str, space: dict[str, Any]) -> tuple[str, object]:
    """What a cell prints, and the value of its last line, as notebooks have it."""
    tree = ast.parse(text)
    last = ast.Expression(tree.body.pop().value) if isinstance(tree.body[-1], ast.Expr) else None
    with contextlib.redirect_stdout(io.StringIO()) as said:
        exec(compile(tree, "cell", "exec"), space)
        value = eval(compile(last, "cell", "eval"), space) if last else None
    return said.getvalue(), value
