"""The certificate of a lower bound: what the solver writes holds, and whatever is changed in it is found."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from test_solver import wandering
from test_speedups import machines

from ssh_abduction import MapError, Theory, Trace, solve
from ssh_abduction.cli import main
from ssh_abduction.proof import check_bound


@settings(deadline=None, derandomize=True)
@given(machines(most_steps=30))
def test_what_the_solver_writes_holds(trace: Trace) -> None:
    for theory in (Theory.causal(), Theory.topological().replace(star="none")) if len(trace) < 12 else (Theory.causal(),):
        solution = solve(trace, theory, maps=1)
        assert solution.certificate is not None
        bound = check_bound(trace, solution.certificate.to_dict(trace))
        assert bound.faults == ()
        if solution.cost is not None:  # boundary axioms leave some random traces without any map
            assert bound.dstates + len(bound.refuted) == solution.certificate.bound == solution.cost.dstates


def certified() -> tuple[Trace, dict[str, Any]]:
    trace = wandering(1, rooms=12, length=300, views=3)
    certificate = solve(trace, Theory.causal(), maps=1).certificate
    assert certificate is not None
    return trace, certificate.to_dict(trace)


def test_a_changed_word_is_a_fault() -> None:
    trace, data = certified()
    assert len(data["words"]) > 5
    for entry in data["words"]:
        word = entry[2]
        entry[2] = word[:-1]
        assert check_bound(trace, data).faults == (
            f"steps {entry[0]} and {entry[1]}: {' '.join(word[:-1]) or 'nothing done'} leads to the same view from both",
        )
        entry[2] = [*word[:-1], "fly"]
        assert "'fly' is not what was done at step" in check_bound(trace, data).faults[0]
        entry[2] = word


def test_a_step_that_may_be_another_is_a_fault() -> None:
    trace, data = certified()
    for step in set(range(len(trace))) - set(data["clique"]):
        data["clique"].append(step)
        data["refuted"] = []
        assert check_bound(trace, data).faults
        data["clique"].pop()


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"clique": [0, 0]}, "different steps"),
        ({"clique": [1000]}, "different steps"),
        ({"clique": "all"}, "different steps"),
        ({"refuted": [3]}, "without a gap"),
        ({"words": [[0, 1]]}, "expected \\[step, step"),
        ({"words": 7}, "expected \\[step, step"),
    ],
)
def test_malformed_certificates_are_errors(change: dict[str, Any], word: str) -> None:
    trace, data = certified()
    with pytest.raises(MapError, match=word):
        check_bound(trace, {**data, **change})


def test_check_bound_on_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    trace, maps = tmp_path / "trace.jsonl", tmp_path / "maps.json"
    wandering(1, rooms=12, length=300, views=3).save(trace)
    assert main(["solve", str(trace), "--theory", "causal", "--json"]) == 0
    maps.write_text(capsys.readouterr().out)
    assert main(["check", "--bound", str(trace), str(maps)]) == 0
    shown = capsys.readouterr().out
    data = json.loads(maps.read_text())
    assert f"at least {len(data['certificate']['clique'])} dstates: as many steps" in shown
    assert f"the maps have {data['cost']['dstates']}: no map has fewer" in shown
    data["certificate"]["clique"][0] += 1
    maps.write_text(json.dumps(data))
    assert main(["check", "--bound", str(trace), str(maps)]) == 20
    assert "bound: steps " in capsys.readouterr().out
    del data["certificate"]
    maps.write_text(json.dumps(data))
    assert main(["check", "--bound", str(trace), str(maps)]) == 1
    assert "certificate: expected one beside the maps" in capsys.readouterr().err
    assert main(["check", "--bound", "--without", "deterministic", str(trace), str(maps)]) == 1
    assert "which the proof rests on" in capsys.readouterr().err
