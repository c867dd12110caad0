"""Notebook cards of values are well-formed, escaped and small, for every kind of answer."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path
from typing import Any

import aces
import pytest
from worlds import rectangle

from ssh_abduction import SSHMap, Theory, Trace, solve
from ssh_abduction.data import DState
from ssh_abduction.output.cards import DRAWN, ROWS
from ssh_abduction.solver.search import Search

ACES = Trace.load(Path(__file__).parent.parent / "examples" / "aces3-route.jsonl")
SVG = "{http://www.w3.org/2000/svg}"
SCRIPT = "<script>alert(1)</script>"


def shown(value: Any) -> tuple[ET.Element, str]:
    """The HTML of a value, which is XML, too, and its text."""
    html = value._repr_html_()
    tree = ET.fromstring(html)
    return tree, "".join(tree.itertext())


def rows(tree: ET.Element) -> list[list[str]]:
    return [["".join(cell.itertext()) for cell in row] for row in tree.iter("tr")]


def test_card_of_a_solution_shows_its_first_map_and_backbone() -> None:
    solution = aces.solution()
    tree, text = shown(solution)
    assert "optimal: 19 dstates, 10 places, 4 paths; 4 minimal maps" in text
    assert solution.summary in text
    assert len(list(tree.iter(f"{SVG}svg"))) == 1
    assert "4 maps; the first is shown below" in text
    assert len(solution._repr_html_()) < 60_000


def test_card_of_a_map_lists_its_dstates() -> None:
    (ssh_map,) = solve(rectangle(20)).maps
    tree, text = shown(ssh_map)
    assert text.startswith("SSHMap: 8 dstates, 4 places, 4 paths; 21 steps")
    assert rows(tree)[0] == ["dstate", "view", "place", "path", "links"]
    assert rows(tree)[1] == ["0", "v0", "0", "0+", "right → 1"]
    assert len(rows(tree)) == 9


def test_card_of_a_trace_lists_its_first_steps() -> None:
    tree, text = shown(ACES)
    assert rows(tree)[0] == ["step", "view", "star", "action"]
    assert rows(tree)[1] == ["0", "open-ahead-right-back", "1, 1, 1, 0", "travel"]
    assert len(rows(tree)) == 11
    assert text.endswith("and 13 more steps")
    metric = Trace.from_steps("ab", ["travel"], displacements=[(1, 0.004, 0)])
    assert rows(shown(metric)[0]) == [
        ["step", "view", "displacement", "action"],
        ["0", "a", "", "travel"],
        ["1", "b", "1.00, 0.00, 0.00", ""],
    ]


@pytest.mark.parametrize(
    ("trace", "choices", "said", "drawn"),
    [
        (
            Trace.from_steps("abcd", ["travel", "around", "around"]),
            {},
            "unsatisfiable: no map of 4 steps satisfies the axioms",
            0,
        ),
        (ACES, {"time_limit": 1e-9}, "feasible (time limit): 23 dstates", 1),
        (rectangle(20), {"theory": Theory.causal().replace(misread=1.5)}, "optimal: 4 dstates", 1),
    ],
)
def test_every_kind_of_answer_has_a_card(
    trace: Trace, choices: dict[str, Any], said: str, drawn: int
) -> None:
    solution = solve(trace, **choices)
    tree, text = shown(solution)
    assert text.startswith(said)
    assert len(list(tree.iter(f"{SVG}svg"))) == drawn


def test_card_of_an_unknown_answer_shows_the_map_of_a_prefix() -> None:
    search = Search(ACES)
    search.parts.known.partial = solve(ACES[:10])[0]
    text = shown(search.solution())[1]
    assert text.startswith("unknown: no map of all 23 steps yet")
    assert "the best map of the first 10 steps:" in text
    unknown = Search(ACES).solution()
    for stopped, said in ((None, "unknown:"), ("time limit", "unknown (time limit):")):
        tree, text = shown(replace(unknown, stopped=stopped))
        assert text.startswith(f"{said} no map of all 23 steps yet")
        assert not list(tree.iter(f"{SVG}svg"))


def test_card_of_a_solution_starts_no_search(monkeypatch: pytest.MonkeyPatch) -> None:
    solution = aces.solution(max_maps=2)
    monkeypatch.setattr(
        "ssh_abduction.solver.sources.exact.prefixes.prove_backbone",
        lambda *_: pytest.fail("it searched"),
    )
    assert "at least 2 minimal maps" in shown(solution)[1]


def test_cards_show_faults_and_displacements() -> None:
    seen = [f"v{t % 4}" if t != 9 else "v0" for t in range(25)]
    trace = Trace.from_steps(seen, ["right", "travel"] * 12)
    assert (
        "the view at step 9 is misread: v0, expected v1"
        in shown(solve(trace, Theory.causal().replace(misread=1.5)))[1]
    )
    square = Trace.from_steps(
        "cwcwcwcwc", ["travel", "left"] * 4, displacements=[(10, 0, 0), (0, 0, 1.5708)] * 4
    )
    assert re.search(
        r"chi-square \d+\.\d for \d+ degrees of freedom",
        shown(solve(square, Theory.causal())[0])[1],
    )


def test_cards_escape_html_in_texts_of_a_trace() -> None:
    trace = Trace.from_steps(
        [SCRIPT, "b", SCRIPT],
        [{"name": SCRIPT, "kind": "travel"}, "around"],
        name=f"{SCRIPT}\x1b[2J",
    )
    solution = solve(trace)
    for value in (trace, solution, solution[0]):
        html = value._repr_html_()
        assert "<script" not in html
        assert html.isprintable() or "\x1b" not in html
        tree, text = shown(value)
        assert SCRIPT in text or value is solution
        assert not list(tree.iter("script"))


def test_card_of_a_large_map_has_no_drawing_and_a_cut_table() -> None:
    dstates = tuple(DState(i, f"v{i}") for i in range(DRAWN + 1))
    large = SSHMap(
        tuple(range(DRAWN + 1)), dstates, tuple((i, "travel", i + 1) for i in range(DRAWN))
    )
    tree, text = shown(large)
    assert not list(tree.iter(f"{SVG}svg"))
    assert f"not drawn, as it has more than {DRAWN} dstates" in text
    assert len(rows(tree)) == ROWS + 1
    assert f"and {DRAWN + 1 - ROWS} more dstates" in text
