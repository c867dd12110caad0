"""Joins that rest on minimality alone, against all consistent maps of tiny traces."""

from __future__ import annotations

import json
import re
import time
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import pytest
from brute_force import Key, consistent_maps, key
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from strategies import theories, traces

from ssh_abduction import Solution, Theory, Trace, compare, solve
from ssh_abduction.cli import main
from ssh_abduction.cli.mapping import MapQuestion
from ssh_abduction.data import MapError, SSHMap
from ssh_abduction.page.content import content_of
from ssh_abduction.rivals import Listing
from ssh_abduction.robot_logs import log_report
from ssh_abduction.solution.weighed import Rival, Weighed
from ssh_abduction.theory.joins import Join, joins_by_minimality, joins_in_words
from ssh_abduction.theory.settle import settle

Pair = tuple[int, int]
ACTIONS = {"T": "travel", "R": "right", "L": "left", "A": "around"}
EXAMPLES = Path(__file__).parent.parent / "examples"


def read(views: str, actions: str, **more: object) -> Trace:
    """A trace of views and actions of one letter each."""
    return Trace.from_steps(views, [ACTIONS.get(letter, letter) for letter in actions], **more)


def joined(one: Key) -> tuple[set[Pair], set[Pair]]:
    """The pairs of steps at one dstate, and those at one place."""
    labels, places, _ = one
    pairs = list(combinations(range(len(labels)), 2))
    at = [places[label] for label in labels]
    return (
        {(i, j) for i, j in pairs if labels[i] == labels[j]},
        {(i, j) for i, j in pairs if at[i] == at[j] is not None},
    )


def agree(trace: Trace, theory: Theory, ssh_map: SSHMap) -> tuple[Join, ...]:
    """The listed joins imply all joins of the map, and none follows from those before it."""
    joins = joins_by_minimality(trace, ssh_map, theory)
    every = [joined(one) for one, _ in consistent_maps(trace, theory)]
    dstates, places = joined(key(ssh_map))
    listed = [(join.first, join.second) for join in joins]

    def has(other: tuple[set[Pair], set[Pair]], pairs: list[Pair]) -> bool:
        return all(pair in other[0 if pair in dstates else 1] for pair in pairs)

    for k, pair in enumerate(listed):
        assert any(has(other, listed[:k]) and not has(other, [pair]) for other in every)
    # A join of places says how the robot faces there, but the brute force has no headings.
    if theory.star == "frame" and not dstates.issuperset(listed):
        return joins
    for other in every:
        if has(other, listed):
            assert dstates <= other[0]
            assert places <= other[1]
    return joins


@pytest.mark.slow
@settings(max_examples=6)
@given(st.data())
def test_named_joins_are_a_minimal_set_that_implies_all_others(data: st.DataObject) -> None:
    trace = data.draw(traces(max_steps=6))
    fixed = ("rules", "weigh", "next_place", "planar")
    theory = settle(trace, data.draw(theories(trace, fixed)).replace(weigh="count")).theory
    solution = solve(trace, theory, max_maps=3)
    assume(solution.maps)
    for ssh_map in solution.maps:
        agree(trace, theory, ssh_map)


CAUSAL = Theory.causal()
CROSSING = (1, 1, 1, 1)
# Views, actions, the theory, and the joins that are expected: two steps, and an asterisk if the
# join makes them one place.
CASES = {
    "the same action leads to the same dstate": ("abab", "ooo", CAUSAL, "0-2"),
    "unless the axiom is left out": (
        *("abab", "ooo"),
        CAUSAL.replace(without=("deterministic",)),
        "0-2 1-3",
    ),
    "an asserted join is no guess": ("abab", "ooo", CAUSAL.replace(same=[(0, 2)]), ""),
    "there and back": ("abcda", "TATA", Theory(), "0-4*"),
    "a place is entered in a new direction, and left": ("abcde", "TATL", Theory(), "0-3*"),
    "a turn around, where the path is known by travels": (
        "pqrsuops",
        "TATTATA",
        Theory(),
        "0-3* 0-6*",
    ),
    "a turn around, where the path is known by a join": ("spwpsy", "ARLAT", Theory(), "1-3"),
    "two turns around, along no path": ("abcb", "RAA", Theory(), "1-3"),
    "four turns right without stars": ("abcda", "RRRR", Theory(), "0-4"),
    "four turns right with stars": ("abcda", "RRRR", Theory(star="frame"), ""),
    "an asserted join says where the visit is": (
        *("nwepqwn", "LATATR"),
        Theory(star="frame", same=[(0, 6)]),
        "",
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_joins_of_small_worlds_equal_hand_results(name: str) -> None:
    views, actions, theory, expected = CASES[name]
    stars = [CROSSING] * len(views) if theory.star == "frame" else None
    trace = read(views, actions, stars=stars)
    theory = settle(trace, theory).theory
    joins = agree(trace, theory, solve(trace, theory).maps[0])
    told = " ".join(f"{j.first}-{j.second}{'*' if j.at_place else ''}" for j in joins)
    assert told == expected


def test_slipped_action_forces_no_join() -> None:
    solution = solve(read("abcabcacabc", "oooooooooo"), CAUSAL.replace(slipped=0.5))
    assert [fault.step for fault in solution.maps[0].faults] == [6]
    assert [(join.first, join.second) for join in solution.by_minimality] == [(0, 3), (5, 7)]


def test_sentence_names_at_most_five_joins() -> None:
    joins = [Join(i, i + 9, at_place=True) for i in range(7)]
    assert joins_in_words([], minimal=True) == ""
    assert joins_in_words(joins, minimal=True) == (
        "minimal; nothing observed separates these places: steps 0 and 9, 1 and 10, 2 and 11, "
        "3 and 12, 4 and 13, and 2 more joins"
    )
    assert joins_in_words([*joins[:1], Join(3, 4, at_place=False)], 2) == (
        "in map 1 nothing observed separates these places: steps 0 and 9; nor these dstates: "
        "steps 3 and 4"
    )


TOLD = "minimal; nothing observed separates these places: steps 0 and 8"


def test_commands_print_joins_that_rest_on_minimality(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    trace, maps = str(EXAMPLES / "notched-rectangle.jsonl"), str(tmp_path / "maps.json")
    assert main(["solve", trace]) == 0
    verdict, _, told = capsys.readouterr().out.splitlines()[:3]
    assert verdict == "4 places, 1 join by minimality alone. Proven minimal, the only such map."
    assert told == TOLD
    assert main(["solve", trace, "--json"]) == 0
    out = capsys.readouterr().out
    Path(maps).write_text(out)
    written = json.loads(out)
    assert written["by_minimality"] == [{"steps": [0, 8], "of": "place"}]
    assert "confidence" not in out
    for command in (["compare", maps], ["next", maps, trace]):
        assert main(command) == 0
        assert capsys.readouterr().out.splitlines()[-1] == TOLD
    assert main(["compare", maps, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["by_minimality"] == written["by_minimality"]


def test_solution_file_keeps_the_joins() -> None:
    solution = solve(Trace.load(EXAMPLES / "notched-rectangle.jsonl"))
    read_again = Solution.from_dict(solution.to_dict())
    assert read_again.by_minimality == solution.by_minimality == (Join(0, 8, at_place=True),)
    assert read_again.sureness == solution.sureness == Listing.of(solution).sureness == TOLD
    assert compare(solution).minimal == 1
    for wrong in ([{"steps": [0]}], [{"steps": [8, 0]}], [{"steps": [0, 8], "of": "path"}], 3):
        with pytest.raises(MapError, match="by_minimality"):
            Solution.from_dict({**solution.to_dict(), "by_minimality": wrong})


def test_weighed_maps_have_probabilities_of_joins() -> None:
    square = [(10, 0, 0), (0, 0, 1.5708)] * 4
    trace = read("ababababa", "TLTLTLTL", displacements=square)
    weighed = solve(trace)
    assert weighed.by_minimality == ()
    stopped = replace(weighed, support=replace(weighed.support, weighed=None))
    assert stopped.by_minimality == ()  # displacements may force its joins
    assert "probability" in weighed.sureness
    assert compare(weighed).sentence == "1 map of least cost"
    counted = solve(trace, Theory(weigh="count"))
    assert "probability" not in counted.sureness
    assert counted.sureness.startswith("minimal; nothing observed separates")


def test_page_lists_doubtful_joins() -> None:
    solution = solve(Trace.load(EXAMPLES / "notched-rectangle.jsonl"))
    content = content_of(solution)
    assert content["sureness"] == TOLD
    assert content["joins"] == [(0, 8, None)]
    assert content["verdict"] == solution.verdict
    costs = [0.0, 1.0, 9.0]
    rivals = [(0, 1, 0, 1, 0), (0, 1, 0, 1, 2), (0, 1, 2, 3, 4)]
    weighed = Weighed(0.0, 5.0, tuple(Rival(*rival) for rival in zip(costs, rivals, strict=True)))
    one = solve(read("ababa", "oooo"), CAUSAL).maps[0]
    content = content_of(Listing((one,), weighed=weighed))
    assert content["joins"] == [(2, 4, "0.73")]
    assert content["sureness"] == weighed.sentence


def test_maps_of_logs_name_doubtful_joins() -> None:
    solution = solve(Trace.load(EXAMPLES / "notched-rectangle.jsonl"))
    run = {"log": {"scans": 9, "metres": 5.0}, "visits": 3, "steps": 401}
    assert TOLD in log_report._summary(solution, run)
    imported = SimpleNamespace(visits=(), track=SimpleNamespace(way=[5.0]))
    log = MagicMock(warnings=(), __len__=lambda _: 9)
    files = {"run.json": b'{"log": {}}'}
    done = MagicMock(
        solution=solution,
        imported=imported,
        log=log,
        seconds={"track": 3.0},  # processor time
        notes=(),
        joined="",
        files=lambda: dict(files),
    )
    question = MapQuestion(None, {}, {}, 0.5, None, 0)
    line = question._answer(0, ["a.log"], done, None, time.monotonic() - 60).line
    assert line.startswith(f"a.log: {solution.verdict}\n  optimal: ")
    assert TOLD in line
    assert re.search(r"; 6\d\.\d s$", line)
    # Neither the second part of x nor the log that is named like one confuses their sources.
    drives = [{"name": name} for name in ("x", "x part 3", "x part 2")]
    files["run.json"] = json.dumps({"log": {}, "drives": drives}).encode()
    answer = question._answer(0, ["x.log", "x part 2.log"], done, None, time.monotonic())
    run = json.loads(dict(answer.files)["run.json"])
    assert [drive["source"] for drive in run["drives"]] == ["x.log", "x.log", "x part 2.log"]
