"""Clashes: steps that have no map by themselves, found after a limit."""

from __future__ import annotations

from pathlib import Path
from unittest.mock import Mock, patch

import pytest

from ssh_abduction import SSHMap, Theory, Trace, solve
from ssh_abduction.cli import main, outcome
from ssh_abduction.explain.axioms import Interrupted
from ssh_abduction.solution import Status
from ssh_abduction.solver import Search, candidates
from ssh_abduction.solver.search import clash_in
from ssh_abduction.theory.settle import settle


def test_clash_of_a_whole_visit_is_found_after_the_limit(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A travel puts many turns around on one path, but they saw different things."""
    turns = ["right", *["around"] * 16]
    done = [*["travel"] * 40, *turns, "travel", *["travel"] * 40]
    views = [*range(41), *("ab" * 8), "c", *range(50, 91)]
    trace = Trace.from_steps(views, done)
    found = solve(trace, Theory(star="none"), work_limit=0.1, max_maps=1)
    assert found.status is Status.UNSATISFIABLE
    trace.save(tmp_path / "trace.jsonl")
    words = ["solve", str(tmp_path / "trace.jsonl"), "--set", "star=none", "--work-limit", "0.1"]
    monkeypatch.setattr(outcome, "EXPLAINING", 0.0)
    assert main(words) == 20
    told = capsys.readouterr().out
    assert told.startswith("unsatisfiable: no map satisfies the axioms: in steps ")
    assert " some clash\nlook at what was seen and done from " in told


def test_clash_of_two_drives_is_not_blamed_on_the_evidence(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """No stretch of consecutive steps clashes, and there is no time to find the axioms."""
    for name in ("monday", "tuesday"):
        Trace.from_steps("abc", ["travel"] * 2, name=name).save(tmp_path / f"{name}.jsonl")
    drives = [str(tmp_path / f"{name}.jsonl") for name in ("monday", "tuesday")]
    monkeypatch.setattr(outcome, "explain", Mock(side_effect=Interrupted))
    assert main(["solve", *drives, "--together", "--same", "monday:0,tuesday:2"]) == 20
    why = "no map of 6 steps satisfies the axioms; to find out why: ssh-abduction explain"
    assert capsys.readouterr().out.startswith(f"unsatisfiable: {why}\n")


def wrong_turn() -> Trace:
    """Right, then left: the same heading by the axioms, and 0.8 rad off by the odometry."""
    turned = [(0, 0, -1.57), (0, 0, -1.57), (0, 0, 0.8)]
    done = ["right", "right", "left"]
    return Trace.from_steps("abcb", done, displacements=turned, stars=[(1, 1, 1, 1)] * 4)


def test_clash_of_turns_within_a_visit_uses_displacements() -> None:
    trace, within = wrong_turn(), range(1, 4)

    def maps_of(trace: Trace, theory: Theory) -> tuple[tuple[SSHMap, ...], bool]:
        solution = solve(trace, theory)
        return solution.maps, solution.status is not Status.FEASIBLE

    assert clash_in(trace, settle(trace, None).theory, [within], maps_of) == within


@pytest.mark.parametrize(("kind", "steps"), [("same", (4, 12)), ("same_place", (30, 9))])
def test_asserted_pair_that_displacements_exclude_is_the_clash(
    kind: str, steps: tuple[int, int]
) -> None:
    """With misread views and more than 60 steps, no source proves that there is no map."""
    moved = [(2.0, 0.0, 0.0)] * 69
    trace = Trace.from_steps(["hall"] * 70, ["travel"] * 69, displacements=moved)
    theory = Theory(misread=0.9, weigh="cost", star="none").replace(**{kind: (steps,)})
    search = Search(trace, theory, work_limit=0.3)
    assert not [*search]
    assert search.status is Status.UNSATISFIABLE
    assert search.clash == range(min(steps), max(steps) + 1)


def test_steps_at_which_a_refused_map_breaks_axioms_come_from_one_check() -> None:
    search = Search(wrong_turn())
    with patch.object(candidates, "violations", side_effect=AssertionError):
        search.parts.candidates.sketch()
    assert search.parts.candidates.contradicting == {3: None}
