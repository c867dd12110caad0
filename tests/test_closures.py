"""Closures: relative poses of steps from matches of local maps, as evidence."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import truth
from brute_misfit import LeastSquares
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import approx_fprime
from strategies import traces
from wings import wings

from ssh_abduction import Theory, Trace, solve
from ssh_abduction.checker.cost_claims import SHARE, cost_of, false_costs, misfit
from ssh_abduction.data import Closure, TraceError, together
from ssh_abduction.data.odometry import (
    Covariance,
    Displacement,
    Odometry,
    displacement_between,
    moved,
)
from ssh_abduction.explain import explain_pair
from ssh_abduction.solver.costs.misfit import Misfit
from ssh_abduction.solver.geometry.equations import Equations
from ssh_abduction.solver.geometry.fit import Explaining, poses_of
from ssh_abduction.solver.geometry.poses import Poses
from ssh_abduction.solver.sources.metric.beam import Beam
from ssh_abduction.solver.sources.metric.overlay import smoothed_map
from ssh_abduction.solver.steps.log import Log
from ssh_abduction.theory.fields import FAULT
from ssh_abduction.theory.settle import settle

TIGHT: Covariance = ((0.01, 0.0, 0.0), (0.0, 0.01, 0.0), (0.0, 0.0, 0.001))
# A square of 10 m, driven once and a little farther.
GO, LEFT = (10.0, 0.0, 0.0), (0.0, 0.0, math.pi / 2)
# Misfits above this belong to absurd maps, whose least squares have several minima.
PLAUSIBLE = 300.0


def square(views: str = "aaaaaaaaaa") -> Trace:
    return Trace.from_steps(
        views, ["travel", "left"] * 4 + ["travel"], displacements=[GO, LEFT] * 4 + [GO]
    )


def closed(first: int, last: int, onward: Displacement, noise: Covariance = TIGHT) -> Trace:
    return replace(square(), closures=(Closure(first, last, onward, noise),))


def test_closures_are_written_and_read(tmp_path: Path) -> None:
    trace = closed(1, 9, (0.05, 0.0, 0.1))
    trace.save(tmp_path / "trace.jsonl")
    read = Trace.load(tmp_path / "trace.jsonl")
    assert read == trace
    assert read.digest != square().digest
    assert "closures" in repr(trace)
    assert not trace.without_displacements().closures


def test_slice_of_a_trace_keeps_closures_between_its_steps() -> None:
    trace = closed(1, 9, (0.05, 0.0, 0.1))
    assert not trace.prefix(9).closures
    assert trace.prefix(10) == trace
    (kept,) = trace[1:].closures
    assert (kept.first, kept.last) == (0, 8)
    assert not trace[2:].closures


@pytest.mark.parametrize(
    ("closures", "said"),
    [
        (3, r"closures: expected a list, got 3; "),
        ([7], r"closures\[0\]: expected an object with steps, displacement, covariance, got 7; "),
        ([{"steps": [0, 1]}], r"closures\[0\]: expected an object with steps"),
        ([{"steps": 4}], r"closures\[0\]: steps: expected two steps, got 4; "),
        ([{"steps": [1, 0]}], r"expected an earlier and a later step, got 1 and 0; swap them"),
        ([{"steps": [0, 0.5]}], r"closures\[0\]: steps\[1\]: expected a whole number"),
        ([{"steps": [0, 5]}], r"closures\[0\]: steps: expected steps from 0 to 1, got 5; "),
        ([{"displacement": [1, 2]}], r"closures\[0\]: displacement: expected \[dx, dy, dtheta\]"),
        ([{"covariance": [[0] * 3] * 3}], r"covariance: expected a positive definite matrix"),
        ([{}, {}], r"closures\[1\]: steps: expected each pair once, got 0 and 1 twice; "),
    ],
)
def test_malformed_closure_is_an_error(tmp_path: Path, closures: Any, said: str) -> None:
    good = {"steps": [0, 1], "displacement": [0, 0, 0], "covariance": TIGHT}
    if isinstance(closures, list):
        is_part = closures[0] == {"steps": [0, 1]}
        closures = [{**good, **c} if isinstance(c, dict) and not is_part else c for c in closures]
    header = {"format": "ssh-trace", "version": 1, "closures": closures}
    path = tmp_path / "trace.jsonl"
    path.write_text(f'{json.dumps(header)}\n{{"view": "a", "action": "travel"}}\n{{"view": "b"}}\n')
    with pytest.raises(TraceError, match=r"trace\.jsonl.*: " + said):
        Trace.load(path)


@settings(max_examples=5)
@given(st.data())
def test_misfit_with_closures_equals_plain_least_squares(data: st.DataObject) -> None:
    drawn = traces(max_steps=5, closures=True, metric=True).filter(lambda trace: trace.closures)
    trace = data.draw(drawn, label="trace")
    size = len(trace)
    labels = data.draw(st.lists(st.integers(0, 2), min_size=size, max_size=size), label="labels")
    labels = [list(dict.fromkeys(labels)).index(label) for label in labels]
    some = st.lists(st.integers(0, 2), min_size=max(labels) + 1, max_size=max(labels) + 1)
    places = data.draw(some, label="places")
    plain = LeastSquares(trace).misfit(tuple(labels), tuple(places))
    solver = Poses(trace, labels, places).misfit()
    checker = misfit(trace, labels, [places[label] for label in labels])
    if min(plain, solver, checker) < PLAUSIBLE:
        assert solver == pytest.approx(plain, rel=1e-4, abs=1e-4)
        assert checker == pytest.approx(plain, rel=SHARE, abs=1e-4)


@pytest.mark.parametrize(("offset", "costs"), [(0.0, False), (1.0, True)])
def test_joining_steps_against_a_closure_raises_the_misfit(offset: float, costs: bool) -> None:
    trace, apart = closed(1, 9, (0.0, offset, 0.0)), list(range(10))
    more = Poses(trace, [*apart[:9], 1], apart[:9]).misfit() - Poses(trace, apart, apart).misfit()
    assert (more > 30) is costs
    assert costs or more < 1


@pytest.mark.parametrize("offset", [0.0, 3.0])
def test_closure_decides_between_maps_that_odometry_allows(offset: float) -> None:
    """Odometry with 2 m of noise cannot tell whether the robot is back."""
    noise = ((4.0, 0.0, 0.0), (0.0, 4.0, 0.0), (0.0, 0.0, 0.01))
    trace = Trace.from_steps(
        "abcda", ["left", "travel", "left", "travel"], displacements=[LEFT, GO, (0, 0, -3.1), GO]
    )
    steps = [replace(step, covariance=noise) if i else step for i, step in enumerate(trace.steps)]
    turned = math.pi / 2 + math.pi / 2 - 3.1
    away = Closure(0, 4, (offset, 0.0, turned - math.pi / 2), TIGHT)
    trace = replace(trace, steps=tuple(steps), closures=(away,))
    solution = solve(trace, Theory.topological().replace(boundary="none"))
    assert solution.weighed is not None
    ssh_map = solution.maps[0]
    first, last = (ssh_map.dstates[ssh_map.labels[step]].place for step in (0, 4))
    assert (first == last) is (offset == 0.0)
    if offset:
        pinned = solve(trace, Theory.topological().replace(boundary="none", without=("closure",)))
        assert pinned.theory.without == ("closure",)


@pytest.mark.parametrize(("last", "aliases"), [(8, ()), (4, (1,))])
def test_closure_that_contradicts_the_odometry_is_false(last: int, aliases: tuple[int]) -> None:
    """A closure agrees with the odometry, or puts opposite corners of the square at one place."""
    solution = solve(closed(0, last, (0.0, 0.0, 0.0)))
    assert solution.weighed is not None
    assert solution.weighed.proven
    assert (solution.confidence or 0.0) > 0.9
    assert solution.weighed.rivals[0].aliases == aliases


@pytest.mark.parametrize(
    ("step", "seconds"),
    [(1, None), (1, 1e-9), pytest.param(2, None, marks=pytest.mark.slow)],
)
def test_explanation_names_the_closure_of_the_two_visits(step: int, seconds: float | None) -> None:
    """Also without a proof, and for another step of the same visit."""
    trace = closed(1, 9, (0.05, 0.05, 0.0))
    theory = Theory.topological().replace(star="none", boundary="none")
    explained = str(explain_pair(trace, step, 9, theory, time_limit=seconds))
    assert explained.count("the local maps of steps 1 and 9 match with an offset of 0.07 m") == 1


def test_fitted_poses_keep_the_distance_of_an_exact_closure() -> None:
    exact = tuple(tuple(row) for row in (np.eye(3) * 1e-4).tolist())
    trace = closed(1, 9, (0.0, 2.0, 0.0), exact)  # type: ignore[arg-type]
    labels = list(range(10))
    poses = Poses(trace, labels, labels).fit().poses
    assert math.dist((poses[1].x, poses[1].y), (poses[9].x, poses[9].y)) == pytest.approx(
        2.0, abs=0.1
    )


def test_explanation_cites_the_closure() -> None:
    explained = explain_pair(closed(0, 8, (0.0, 3.0, 0.0)), 0, 8, Theory.causal())
    assert explained.verdict.value == "different"
    assert "the local maps of steps 0 and 8 match with an offset of 3.00 m" in str(explained)


def test_beam_cost_with_closures_equals_the_cost_of_the_map() -> None:
    """The equations of a hypothesis are linear. So its cost is nearly that of its map."""
    (known,) = truth.mazes(4, 24, [701], truth.Noise(Odometry(**truth.NOISE)))
    steps = range(len(known.trace))
    pairs = [(i, j) for i, j in combinations(steps, 2) if 6 < j - i < 10]
    random = np.random.default_rng(0)
    poses = [(0.0, 0.0, 0.0)]
    for step in known.trace.steps[1:]:
        poses.append(moved(poses[-1], step.displacement or (0.0, 0.0, 0.0)))
    noise: Covariance = ((0.04, 0.0, 0.0), (0.0, 0.04, 0.0), (0.0, 0.0, 0.01))
    closures = []
    for i, j in pairs[::10]:
        x, y, turned = displacement_between(poses[i], poses[j])
        dx, dy = random.normal(0, 0.2, 2)
        closures.append(Closure(i, j, (x + dx, y + dy, turned), noise))
    assert len(closures) > 3
    trace = replace(known.trace, closures=tuple(closures))
    beams = [_beam(known.trace), _beam(trace)]
    maps = [next(beam.maps()) for beam in beams]
    assert maps[0] == maps[1]
    without, nats = (Misfit(settle(t, Theory())).nats_of(maps[0]) for t in (known.trace, trace))
    assert nats > without + 5
    bests = [beam.hypotheses[0].nats for beam in beams if beam.hypotheses]
    assert bests[1] - bests[0] == pytest.approx(nats - without, rel=0.02)


def _beam(trace: Trace) -> Beam:
    problem = settle(trace, Theory())
    return Beam(problem, Log(trace, problem.theory, problem.pairs), 16)


def test_joint_trace_has_the_closures_of_its_drives() -> None:
    drives = [replace(closed(1, 9, (x, 0.0, 0.0)), name=f"drive {x}") for x in (0.0, 0.1)]
    drives[1] = drives[1].with_views("b" * 10)
    with pytest.warns(UserWarning, match="no view in common"):
        joint = together(drives)
    assert [(c.first, c.last) for c in joint.closures] == [(1, 9), (11, 19)]


# False closures


@pytest.mark.parametrize("seed", [0, 1])
def test_true_map_of_a_repeated_wing_explains_the_false_closures(seed: int) -> None:
    """The false closures of the drive lay one wing on the other."""
    drive = wings(seed)
    problem = settle(drive.trace, Theory.topological())
    dstates, places = truth.partition(drive.known.dstates), truth.partition(drive.known.places)
    counted = Misfit(problem)
    aliases = counted.aliases_of(dstates, places)
    assert {i for i, alias in enumerate(aliases) if alias} == drive.false
    assert {*map(abs, aliases)} == {0, 1}
    nats = counted.nats_of_course(dstates, places)
    explained, square = cost_of(drive.trace, problem.theory, dstates, places, (), aliases)
    assert nats == pytest.approx(explained, abs=0.01)
    believed, larger = cost_of(drive.trace, problem.theory, dstates, places, ())
    assert believed > nats + 50
    # The bound holds for the best explanation, and for that in which all closures are true.
    noise = drive.trace.closures[0].covariance
    alias = FAULT + float(np.log(problem.prior.wide).sum() - np.linalg.slogdet(noise)[1]) / 2
    assert counted.of_course(dstates, places) <= min(larger, square + 2 * alias)


@pytest.mark.parametrize("seed", [0, 1])
def test_an_explanation_of_the_closures_leads_to_the_true_map(seed: int) -> None:
    """The places of visits that are apart are merged under each explanation of the closures."""
    drive = wings(seed)
    problem = settle(drive.trace, Theory.topological())
    misfit, log = Misfit(problem), Log(drive.trace, problem.theory, problem.pairs)
    doubted, costs = set[int](), [math.inf]
    for aliases, begin in misfit.explained():
        doubted |= {i for i, alias in enumerate(aliases) if alias}
        if {i for i, alias in enumerate(aliases) if alias} == drive.false:
            found = smoothed_map(problem, log, begin)
            assert found is not None
            costs.append(misfit.nats_of(found))
    assert doubted == {*range(len(drive.trace.closures))}
    dstates, places = truth.partition(drive.known.dstates), truth.partition(drive.known.places)
    assert min(costs) < misfit.nats_of_course(dstates, places) + 5


def test_jacobian_of_aliases_equals_finite_differences() -> None:
    drive = wings(2)
    places = truth.partition(drive.known.places)
    labels = truth.partition(drive.known.dstates)
    of_label = [*dict(zip(labels, places, strict=True)).values()]
    signs = [-1 if i % 2 else 1 for i in range(len(drive.trace.closures))]
    aliases = [sign * (i in drive.false) for i, sign in enumerate(signs)]
    wide = settle(drive.trace).prior.wide
    poses = Explaining(Equations.of(drive.trace), labels, of_label, wide).poses(aliases)
    unknown = poses._begun() + 0.01 * np.random.default_rng(0).normal(size=poses._size)
    numeric = approx_fprime(unknown, poses._residuals, 1e-7)
    assert poses._jacobian(unknown) == pytest.approx(numeric, abs=0.01)


def test_check_recomputes_the_cost_of_false_closures() -> None:
    """A single closure that contradicts exact displacements is false."""
    trace = closed(1, 7, (0.0, 30.0, 0.0))
    solution = solve(trace, Theory.causal().replace(reject=1e-9))
    assert solution.weighed
    assert solution.weighed.rivals[0].aliases == (1,)
    assert "1 of 1 closures are false" in solution.weighed.sentence
    assert poses_of(trace, solution.maps[0]).fit().p > 0.01
    record = solution.to_dict()
    theory = settle(trace, Theory.causal()).theory
    assert not [*false_costs(trace, record, solution.maps, theory)]
    record["weighed"]["rivals"][0]["aliases"] = [2]
    wrong = "".join(false_costs(trace, record, solution.maps, theory))
    assert "from 1 without gaps, got [2]" in wrong
