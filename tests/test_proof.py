"""Certificates of lower bounds: those of the solver hold, and each change in one is found."""

from __future__ import annotations

import json
import pickle
import subprocess
import sys
import textwrap
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from test_solver import wandering
from test_speedups import machines
from worlds import rectangle

from ssh_abduction import OnlineMapper, Theory, Trace, solve
from ssh_abduction.checker.claims import check_bound
from ssh_abduction.cli import main
from ssh_abduction.data import MapError
from ssh_abduction.solution.recorded import Support
from ssh_abduction.solver import Search
from ssh_abduction.solver.steps.apart import Continuations
from ssh_abduction.solver.steps.log import Log


@settings(max_examples=10)
@given(machines(most_steps=30))
def test_checker_accepts_the_certificates_of_solve(trace: Trace) -> None:
    for theory in (
        (Theory.causal(), Theory.topological().replace(star="none"))
        if len(trace) < 12
        else (Theory.causal(),)
    ):
        solution = solve(trace, theory, max_maps=1)
        assert solution.certificate is not None
        bound = check_bound(trace, solution.certificate.to_dict())
        assert bound.faults == ()
        if solution.cost is not None:  # boundary axioms leave some random traces without any map
            proven = bound.dstates + len(bound.refuted)
            assert proven == solution.certificate.bound <= solution.cost.dstates
            # The cheapest map may have more dstates than the smallest one.
            assert solution.weighed is not None or proven == solution.cost.dstates


@pytest.mark.parametrize("length", [12, 120])
def test_certificate_is_computed_on_demand(length: int) -> None:
    """The certificate is written once, for the prefix that clingo was given.

    This is so whether or not the search itself needed steps that are apart.
    """
    trace = wandering(2, rooms=5, length=length, views=3)
    search = Search(trace, Theory.causal(), max_maps=1)
    solution = search.solution(tuple(search))
    assert solution.support.basis is not None
    assert "certificate" not in vars(solution.support.basis)
    log = Log(trace, search.theory)
    certificate = solution.certificate
    assert certificate is not None
    assert certificate.clique == tuple(
        Continuations(
            log.seen[: solution.effort.prefix], log.actions[: solution.effort.prefix - 1]
        ).clique()
    )
    assert solution.cost is not None
    assert certificate.bound == solution.cost.dstates
    assert solution.certificate is certificate


@pytest.mark.parametrize("asked", [False, True])
def test_pickled_solution_keeps_its_certificate(asked: bool) -> None:
    trace = wandering(2, rooms=5, length=12, views=3)
    solution = solve(trace, Theory.causal())
    if asked:
        assert solution.certificate is not None
    copy = pickle.loads(pickle.dumps(solution))
    assert copy == solution
    assert hash(copy.support.basis) == hash(solution.support.basis)
    assert copy.certificate == solution.certificate
    assert (
        replace(solution, effort=replace(solution.effort, prefix=0)).certificate
        == solution.certificate
    )
    assert replace(solution, support=Support()).certificate is None
    assert replace(solution, support=Support()).certificate is None


def test_no_certificate_without_the_axiom_deterministic() -> None:
    trace = wandering(2, rooms=5, length=5, views=3)
    solution = solve(trace, Theory.causal().replace(without=("deterministic",)))
    assert (solution.support.basis, solution.certificate) == (None, None)


def test_online_mapper_gives_a_certificate() -> None:
    mapper = OnlineMapper("a", Theory.causal(), time_limit=None)
    for view in "bab":
        mapper.observe("travel", view)
    assert mapper.solution.certificate is not None
    assert mapper.solution.certificate.bound == 2


def test_short_trace_is_solved_without_numpy() -> None:
    """numpy takes longer to load than all the rest."""
    program = textwrap.dedent("""
        import sys
        from ssh_abduction import Trace, cli, solve
        solution = solve(Trace.from_steps("aba", ["travel", "travel"]))
        print("numpy" in sys.modules)
        print(solution.certificate.clique, "numpy" in sys.modules)
    """)
    shown = subprocess.run(
        [sys.executable, "-c", program], stdout=subprocess.PIPE, text=True, check=True
    ).stdout
    assert shown.splitlines() == ["False", "(0, 1) True"]


@cache
def certified() -> tuple[Trace, dict[str, Any]]:
    trace = wandering(1, rooms=12, length=300, views=3)
    certificate = solve(trace, Theory.causal(), max_maps=1).certificate
    assert certificate is not None
    return trace, certificate.to_dict()


def test_check_bound_refuses_a_clique_with_one_more_step() -> None:
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
        ({"clique": None}, "different steps"),
        ({"refuted": [3]}, "without a gap"),
    ],
)
def test_malformed_certificates_are_errors(change: dict[str, Any], word: str) -> None:
    trace, data = certified()
    with pytest.raises(MapError, match=word):
        check_bound(trace, {**data, **change})


def test_check_bound_refuses_a_certificate_without_clique() -> None:
    with pytest.raises(MapError, match="clique: expected a clique"):
        check_bound(certified()[0], {})


def test_check_bound_prints_the_bound(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    trace, maps = tmp_path / "trace.jsonl", tmp_path / "maps.json"
    wandering(1, rooms=12, length=300, views=3).save(trace)
    assert main(["solve", str(trace), "--theory", "causal", "--json"]) == 0
    maps.write_text(capsys.readouterr().out)
    assert main(["check", "--bound", str(maps), str(trace)]) == 0
    shown = capsys.readouterr().out
    data = json.loads(maps.read_text())
    assert f"at least {len(data['certificate']['clique'])} dstates: no two of " in shown
    assert f"the maps have {data['cost']['dstates']}: no map has fewer" in shown
    data["certificate"]["refuted"] = list(
        range(len(data["certificate"]["clique"]), data["cost"]["dstates"] + 1)
    )
    maps.write_text(json.dumps(data))
    assert main(["check", "--bound", str(maps), str(trace)]) == 20
    assert "fewer than that, so this bound or a map is wrong" in capsys.readouterr().out
    clique = data["certificate"]["clique"]
    clique.append(
        next(step for step in range(301) if step not in clique)
    )  # as it is a largest one, this step is not apart from all of it
    data["certificate"]["refuted"] = list(range(len(clique), data["cost"]["dstates"]))
    maps.write_text(json.dumps(data))
    assert main(["check", "--bound", str(maps), str(trace)]) == 20
    assert "bound: steps " in capsys.readouterr().out
    del data["certificate"]
    maps.write_text(json.dumps(data))
    assert main(["check", "--bound", str(maps), str(trace)]) == 1
    assert (
        "certificate: expected one in the file of maps, got none; leave out --bound"
        in capsys.readouterr().err
    )
    assert main(["check", "--bound", "--set", "without=deterministic", str(maps), str(trace)]) == 0
    assert "its proof rests on axioms that are left out" in capsys.readouterr().out


def test_check_bound_refuses_refutations_of_another_theory(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Without sides the rectangle has four dstates, so refutations under sides do not count."""
    trace, maps = tmp_path / "trace.jsonl", tmp_path / "maps.json"
    rectangle(400).save(trace)
    assert main(["solve", str(trace), "--json"]) == 0
    solved = capsys.readouterr().out
    maps.write_text(solved)
    assert main(["check", "--bound", "--set", "prefer=dstates", str(maps), str(trace)]) == 0
    assert "the maps have 8: no map has fewer" in capsys.readouterr().out
    assert main(["check", "--bound", "--set", "boundary=none", str(maps), str(trace)]) == 0
    shown = capsys.readouterr().out
    assert "regions are not checked: the file is of another theory" in shown
    assert (
        "clingo's verdict on 4 dstates and more is left out: the file is of another theory" in shown
    )
    assert "the maps have 8, 4 more than proven" in shown
    data = json.loads(maps.read_text())
    data["maps"][0]["regions"][0]["bounds"] = []
    maps.write_text(json.dumps(data))
    assert main(["check", str(maps), str(trace)]) == 20
    assert "map 1: region_beside" in capsys.readouterr().out
    assert main(["check", "--set", "boundary=none", str(maps), str(trace)]) == 0
    data = json.loads(solved)
    del data["theory"]
    maps.write_text(json.dumps(data))
    assert main(["check", "--bound", str(maps), str(trace)]) == 0
    assert "left out: the file names no theory" in capsys.readouterr().out
    rectangle(400, turn="L").save(trace)
    assert main(["check", "--bound", str(maps), str(trace)]) == 20
    assert "no map has fewer" not in capsys.readouterr().out
