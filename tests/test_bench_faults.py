"""The benchmark of faults recognises the truth, peers explain small traces, and a cell ends at its
limit."""

from __future__ import annotations

from itertools import product

import fault_peers
import faults
import pytest
from fault_cases import (
    FAMILIES,
    Case,
    Explanation,
    machine,
    misread,
    rectangle_of_five,
    refined,
    sized,
)
from fault_peers import PEERS
from instances import Walk

from ssh_abduction import Trace


@pytest.mark.parametrize("jumps", [False, True])
def test_true_explanation_costs_its_states_and_faults(jumps: bool) -> None:
    for make, seed in product(
        (
            lambda s: machine(s, jumps=jumps),
            lambda s: rectangle_of_five(s, steps=100, **{"jumps" if jumps else "wrong": 1}),
        ),
        range(3),
    ):
        case = make(seed)
        truth = Explanation.of(case.walk.trace, case.walk.truth)
        assert truth.faults == case.faults
        assert truth.is_true(case)
        assert truth.tenths == 10 * case.states + 15 * len(case.faults)
        assert case.states == len(set(truth.labels))
        assert not Explanation.of(case.walk.trace, range(len(case.walk.trace))).is_true(case)


def test_refined_labels_merge_mistaken_labels() -> None:
    """At first a wrong view, and a step with a mistaken label, have labels of their own."""
    case = rectangle_of_five(0, steps=100, wrong=2)
    labels = [f"odd {t}" if t in (*case.wrong, 50) else s for t, s in enumerate(case.walk.truth)]
    assert refined(case.walk.trace, labels).is_true(case)


def test_label_at_a_misread_step_is_not_judged() -> None:
    walk = Walk(Trace.from_steps("abababab", ["on"] * 7), (0, 1) * 4)
    case = misread(Walk(Trace.from_steps("ab" * 10, ["on"] * 19), (0, 1) * 10), 1, 0)
    labels = [2 if t in case.wrong else s for t, s in enumerate(case.walk.truth)]
    assert Explanation(tuple(labels), case.faults, 0).is_true(case)
    assert not Explanation(tuple(labels), frozenset(), 0).is_true(case)
    assert not Explanation((0, 1) * 3 + (0, 2), frozenset(), 0).is_true(Case(walk))


@pytest.mark.parametrize("name", PEERS)
def test_each_peer_finds_the_faults_of_a_rectangle(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not PEERS[name].installed:
        pytest.skip(f"{name} is not installed")
    monkeypatch.setattr(fault_peers, "CLONES", (3,))
    case = rectangle_of_five(1, steps=100, wrong=1)
    assert PEERS[name].explain(case, 10).is_true(case)


@pytest.mark.parametrize("case", [sized(3, 5, 4, 100, jumps=1), sized(3, 5, 4, 100, wrong=1)])
def test_maxsat_finds_at_most_as_many_faults_as_the_truth(case: Case) -> None:
    if not PEERS["RC2"].installed:
        pytest.skip("python-sat is not installed")
    explanation = PEERS["RC2"].explain(case, 10)
    assert len(explanation.faults) <= len(case.faults)
    assert len(set(explanation.labels)) <= case.states
    assert {kind for _, kind in explanation.faults} <= {kind for _, kind in case.faults}


@pytest.mark.slow
def test_benchmark_cell_has_its_result_and_ends_at_the_limit() -> None:
    found = faults.measured("rectangle n=400, 4 jumps", faults.TOLD, 500, 20, 4096)
    assert (
        found.items()
        >= {
            "status": "ok",
            "right": True,
            "proven": True,
            "found": 4,
            "named": 4,
            "tenths": 140,
            "true_tenths": 140,
        }.items()
    )
    assert 0 < found["cpu"] < 20
    late = faults.measured("rectangle n=4000, 40 wrong views", "cloned HMM", 500, 0.2, 4096)
    assert (late["status"], late["cpu"]) == ("timeout", 0.2)


def test_fault_table_row_shows_its_cells() -> None:
    family = next(iter(FAMILIES))
    common = {
        "family": family,
        "solver": faults.OURS,
        "limit": 9.0,
        "faults": 2,
        "true_tenths": 80,
        "proven": True,
        "named": 2,
        "among": True,
    }
    right = {
        **common,
        "seed": 0,
        "status": "ok",
        "cpu": 1.0,
        "right": True,
        "found": 2,
        "tenths": 80,
    }
    tie = {
        **common,
        "seed": 1,
        "status": "ok",
        "cpu": 2.0,
        "right": False,
        "found": 1,
        "tenths": 80,
    }
    cheaper = {
        **tie,
        "seed": 2,
        "status": "timeout",
        "proven": False,
        "among": False,
        "found": 0,
        "tenths": 75,
    }
    row = faults.table(
        [right, tie, cheaper, {**cheaper, "solver": "RC2", "status": "not installed"}]
    ).splitlines()[-2:]
    assert row[0] == (
        f"| {family} | ssh-abduction | 1 of 3 | 2 of 3 | 2 of 3 | 3 of 6 | 3 | 0.000 | 2.00 | "
        "> 9 | 1 cheaper, 1 as cheap |"
    )
    assert row[1].startswith(f"| {family} | RC2 | not installed | – |")
    assert faults.contradictions([right, tie, cheaper]) == []
    assert len(faults.contradictions([{**right, "tenths": 90}])) == 1
