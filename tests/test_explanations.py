"""Explanations of traces whose odometry contradicts what was seen."""

from __future__ import annotations

import json
import math
import re
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from brute_geometry import Geometry
from test_displacement import WHITE, circuit

from ssh_abduction import Theory, Trace, solve
from ssh_abduction.checker.checker import check
from ssh_abduction.cli import main
from ssh_abduction.data import Odometry, TraceError
from ssh_abduction.explain.no_map import explain, why_apart
from ssh_abduction.robot_logs.log_maps import BARE
from ssh_abduction.solution import Status
from ssh_abduction.theory.evidence import evidence_of, pairs_of
from ssh_abduction.theory.pairs import pairs_in
from ssh_abduction.theory.settle import settle

TURNS = Trace.from_steps(
    "abcda",
    ["right"] * 4,
    stars=[[1, 1, 1, 1]] * 5,
    displacements=[(0.0, 0.0, -math.pi / 3)] * 4,
    odometry=WHITE,
)


def uneven() -> Trace:
    """Two circuits of a square, whose second side is too long once and too short once.

    Each corner alone may be the same as before, but two corners may not.
    """
    trace = circuit(4, 6)
    moved = [step.displacement for step in trace.steps[1:]]
    moved[2], moved[10] = (13.5, 0.0, 0.0), (6.5, 0.0, 0.0)
    return Trace.from_steps(trace.views, trace.actions, displacements=moved, odometry=WHITE)


def test_explanation_names_turns_that_odometry_contradicts() -> None:
    """Four right turns make steps 0 and 4 one dstate, but the odometry says 60 degrees each."""
    explanation = explain(TURNS)
    assert explanation
    assert {"one_pose", "turn_rotates", "one_dstate_per_heading"} <= set(explanation.axioms)
    sigma = math.degrees(math.sqrt(sum(TURNS.covariance(t)[2][2] for t in range(1, 5)) + 1e-6))  # type: ignore[index]
    expected = (
        f"steps 0 and 4 are not one dstate: by the odometry their headings are 120 ± {sigma:.0f} "
        "degrees apart"
    )
    assert explanation.sentences == (expected,)
    assert why_apart(TURNS, 4, 0) == expected
    assert (
        why_apart(TURNS, 0, 2) is None
    )  # different views, and no movement: displacements need not tell them apart
    assert explain(TURNS, Theory(displacement="none")) is None


@pytest.mark.slow
def test_solver_refuses_two_returns_that_misfit_together() -> None:
    """Two asserted returns are refused together, but not alone.

    The refusal comes from a map, because the solver finds no pair in advance.
    """
    trace, theory = uneven(), Theory(same=[(1, 9), (3, 11)])
    geometry = Geometry(trace, settle(trace, theory).theory)
    assert not geometry.refuses(((1, 9, 3),))
    assert not geometry.refuses(((3, 11, 3),))
    assert geometry.refuses(((1, 9, 3), (3, 11, 3)))
    assert solve(trace, theory).status is Status.UNSATISFIABLE
    explanation = explain(trace, theory)
    assert explanation
    assert {clash.axiom: clash.steps for clash in explanation.clashes} == {
        "asserted": (9, 11),
        "one_pose": (11,),
    }
    said = (
        "steps 1 and 9, and steps 3 and 11 cannot both be returns: the loops of 44 m and 36 m "
        "close 3.5 m and 3.5 m off"
    )
    assert explanation.sentences == (said,)
    assert explanation.to_dict()["sentences"] == [said]
    assert explain(trace, theory.replace(joint=1)) is None


@pytest.mark.slow
def test_weighed_maps_pay_for_two_returns_that_misfit_together() -> None:
    """Weighed maps pay for misfits instead, because errors of logs have heavy tails."""
    trace, theory = uneven(), BARE.replace(same_place=[(1, 9), (3, 11)])
    assert solve(trace, theory.replace(joint=2)).status is Status.UNSATISFIABLE
    ssh_map = solve(trace, theory, work_limit=0.3).maps[0]
    assert ssh_map.place_of(1) == ssh_map.place_of(9)
    assert ssh_map.place_of(3) == ssh_map.place_of(11)


def test_explanation_of_refused_returns_names_a_minimal_set() -> None:
    """One return is asserted, the axioms imply another, and only both axioms are named."""
    trace, theory = uneven(), Theory.causal().replace(same=[(1, 9)])
    explanation = explain(trace, theory)
    assert explanation
    assert set(explanation.axioms) == {"deterministic", "asserted", "one_pose"}
    stretch = explanation.first, explanation.last
    assert stretch == (1, 11)
    for axiom in ("deterministic", "one_pose"):
        left = (
            theory.replace(without=(axiom,))
            if axiom != "one_pose"
            else theory.replace(displacement="none")
        )
        assert explain(trace.prefix(12), left) is None


def test_explanation_names_streets_that_would_cross() -> None:
    """A street that is travelled back and forth leads back to its start, or it cannot be drawn.

    Only maps show that, and the explanation names it.
    """
    trace = Trace.from_steps("aaaaa", ["travel", "around", "travel", "around"])
    drawn, crossed = (
        Theory(planar=True, same=[(0, 4)]),
        Theory(planar=True, different=[(0, 4)], elsewhere=[(0, 3)]),
    )
    assert solve(trace, drawn).status is Status.OPTIMAL
    assert explain(trace, drawn) is None
    assert solve(trace, crossed).status is Status.UNSATISFIABLE
    explanation = explain(trace, crossed)
    assert explanation
    assert {"asserted", "planar"} <= set(explanation.axioms)
    assert explanation.sentences == ()


def test_explanation_states_the_distance_by_dead_reckoning() -> None:
    """The sentence of a pair has its distance, and the uncertainty in that direction."""
    trace = circuit(5, 7, 1.0, odometry=Odometry(bend=0.001))
    theory = settle(trace, Theory()).theory
    pairs = pairs_of(trace, theory)
    geometry = Geometry(trace, theory)
    geometry.drift = geometry.odometry.bend
    compared = 0
    for i, j in combinations(range(len(trace)), 2):
        said = why_apart(trace, i, j, theory)
        if said is None:
            assert i not in pairs.apart.get(j, ())
            continue
        found = re.search(
            r"(?:by the odometry|and) (?:they|steps (\d+) and (\d+), where their visits begin,) "
            r"are ([\d.]+) ± ([\d.]+) m apart",
            said,
        )
        if found is None:
            assert "degrees apart" in said
            continue
        compared += 1
        begin, end = (int(found[1]), int(found[2])) if found[1] else (i, j)
        assert (begin, end) == (i - (i % 2 == 0 < i), j - (j % 2 == 0))
        off, moves, added, _ = geometry.loop(begin, end, 0.0)
        covariance = moves @ geometry.noise() @ moves.T + added
        along = off[:2] / np.hypot(*off[:2])
        assert float(found[3]) == pytest.approx(np.hypot(*off[:2]), abs=0.06)
        assert float(found[4]) == pytest.approx(
            math.sqrt(along @ covariance[:2, :2] @ along), abs=0.06
        )
    assert compared > 50


def test_returns_refused_in_a_stretch_are_refused_in_the_trace() -> None:
    """What is refused in a stretch that begins with a visit is refused in the whole trace.

    The theory has counted the returns of the whole trace.
    """
    trace = circuit(4, 9, 1.0)
    theory = settle(trace, Theory()).theory
    whole = pairs_of(trace, theory)
    for first in (1, 3, 7):
        stretch = Trace(trace.steps[first:], odometry=trace.odometry)
        part = pairs_of(stretch, theory)
        for of in ("apart", "elsewhere"):
            kept = {(i - first, j - first) for i, j in pairs_in(getattr(whole, of)) if i >= first}
            assert set(pairs_in(getattr(part, of))) == kept
            assert kept


def test_solve_prints_what_the_odometry_contradicts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "turns.jsonl"
    TURNS.save(path)
    said = (
        "steps 0 and 4 are not one dstate: by the odometry their headings are 120 ± 3 degrees apart"
    )
    assert main(["solve", str(path)]) == 20
    assert said in capsys.readouterr().out.splitlines()
    assert main(["solve", str(path), "--json"]) == 20
    assert json.loads(capsys.readouterr().out)["explanation"]["sentences"] == [said]


def test_checker_states_misfits_in_metres() -> None:
    trace = circuit(4, 9, 1.0)
    wrong = solve(trace, Theory(displacement="none")).maps[0]
    theory = Theory(displacement="use", prefer=())
    said = next(v.message for v in check(trace, wrong, theory) if v.axiom == "one_pose")
    found = re.search(
        r"steps (\d+) and (\d+) are at one (place|dstate): they are ([\d.]+ ± [\d.]+ m)", said
    )
    assert found
    (displacement,) = (
        evidence
        for evidence in evidence_of(settle(trace, theory).theory)
        if evidence.name == "displacement"
    )
    assert displacement.returns_of(trace).closing(int(found[1]), int(found[2])).metres == found[4]  # type: ignore[attr-defined]


@pytest.mark.parametrize(("first", "second"), [(0, 5), (-1, 2), (2, 2), (True, 2)])
def test_why_apart_refuses_unknown_steps(first: int, second: int) -> None:
    with pytest.raises(TraceError, match="step: expected"):
        why_apart(TURNS, first, second)
