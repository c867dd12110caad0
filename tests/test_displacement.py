"""Displacements as evidence: loops, refused returns, fits, and sentences about them."""

from __future__ import annotations

import math
import random
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from brute_geometry import Geometry
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from instances import Walk, maze
from scipy.optimize import approx_fprime
from scipy.sparse import csr_array
from strategies import theories, traces
from test_property import agree

from ssh_abduction import Solution, SSHMap, Theory, Trace, solve
from ssh_abduction.checker.checker import check
from ssh_abduction.checker.displacements import ErrorFilter, _square_together
from ssh_abduction.data import DState, Odometry, TheoryError
from ssh_abduction.data.odometry import Closure
from ssh_abduction.runtime.clock import heeding
from ssh_abduction.solver.asp.facts import causal_map
from ssh_abduction.solver.geometry.fit import fit, poses_of
from ssh_abduction.solver.geometry.linear import inverse, least_squares, system_solved
from ssh_abduction.solver.geometry.poses import Poses
from ssh_abduction.solver.geometry.ranking import noise_warning, units_warning
from ssh_abduction.theory.evidence import pairs_of
from ssh_abduction.theory.evidence.displacement import Displacement, Returns
from ssh_abduction.theory.evidence.loops import Loops
from ssh_abduction.theory.evidence.together import joint_squares
from ssh_abduction.theory.settle import settle

ROOM = 10.0  # metres from corner to corner
WHITE = Odometry(scale=0.0, bend=0.0)


def circuit(
    corners: int,
    sides: int,
    noise: float = 0.0,
    seed: int = 0,
    odometry: Odometry = WHITE,
    scale: float = 0.0,
    bend: float = 0.0,
) -> Trace:
    """A robot that drives along some sides of a regular polygon, clockwise. All corners look alike.

    `noise` has the standard deviations of its displacements, as a share of those that the odometry
    claims. `scale` and `bend` are errors that repeat.
    """
    rng = np.random.default_rng(seed)
    moved = []
    for step in range(2 * sides):
        true = (0.0, 0.0, -math.tau / corners) if step % 2 else (ROOM, 0.0, 0.0)
        error = rng.multivariate_normal(np.zeros(3), np.array(odometry.covariance(true))) * noise
        way = math.hypot(*true[:2])
        turned = bend * way
        ahead, left = (
            (1 + scale) * way * math.cos(turned / 2),
            (1 + scale) * way * math.sin(turned / 2),
        )
        moved.append((ahead + error[0], left + error[1], true[2] + turned + error[2]))
    views = [("after", "before")[step % 2] for step in range(2 * sides + 1)]
    return Trace.from_steps(
        views, ["travel", "right"] * sides, displacements=moved, odometry=odometry
    )


@pytest.mark.slow
@settings(max_examples=5)
@given(st.data())
def test_refused_returns_equal_matrices_written_out(data: st.DataObject) -> None:
    trace = data.draw(traces().filter(lambda trace: trace.has_displacements), label="trace")
    theory = data.draw(theories(trace, fixed=("displacement",)), label="theory")
    agree(trace, theory)


@settings(max_examples=3)
@given(
    st.integers(0, 10_000),
    st.integers(3, 6),
    st.sampled_from([1.0, 2.0, 3.0]),
    st.sampled_from([0.0, 0.01]),
)
def test_refused_pairs_of_returns_equal_matrices_written_out(
    seed: int, corners: int, noise: float, bend: float
) -> None:
    """The labels need not be those of a consistent map. Every second step is at one of few dstates,
    so many returns share displacements."""
    odometry = replace(WHITE, bend=bend)
    trace = circuit(corners, 4, noise, seed, odometry)
    theory = settle(trace, Theory.causal().replace(reject=0.3)).theory
    rng = np.random.default_rng(seed)
    labels = tuple(int(2 * rng.integers(2) + step % 2) for step in range(len(trace)))
    returns, written_out = Returns(Displacement.of(theory), trace), Geometry(trace, theory)
    ssh_map = causal_map(labels, trace)
    labels = ssh_map.labels
    refused = returns.refused_together(ssh_map)
    arrivals = written_out.arrivals
    pairs = [(i, j, 3) for j in arrivals for i in arrivals if i < j and labels[i] == labels[j]]
    expected = {(a, b) for a in pairs for b in pairs if a < b and written_out.refuses((a, b))}
    assert (refused is None) == (not expected)
    if refused:
        first, second = sorted((e.first, e.second, 3) for e in refused)
        assert (first, second) in expected
    apart = {(i, j) for j, others in returns.pairs.apart.items() for i in others}
    assert apart == {
        (i, j)
        for j in range(len(labels))
        for i in range(j)
        if trace.views[i] == trace.views[j] and written_out.refuses(((i, j, 3),))
    }


def test_covariance_of_a_loop_equals_that_of_simulated_drives() -> None:
    """The noise is small, so the first order is exact enough."""
    little = Odometry(
        along=0.0005,
        across=0.0003,
        heading=0.0001,
        turning=0.0002,
        position=0.001,
        angle=0.0002,
        scale=0.0,
        bend=0.0,
    )
    true = Loops.of(circuit(5, 4, 0.0, 0, little)).poses

    def closing(poses: np.ndarray, i: int, j: int) -> np.ndarray:
        """Relative to the pose at step i."""
        off, turned = poses[j] - poses[i], true[i, 2] - poses[i, 2]
        cos, sin = math.cos(turned), math.sin(turned)
        return np.array([cos * off[0] - sin * off[1], sin * off[0] + cos * off[1], off[2]])

    drives = [Loops.of(circuit(5, 4, 1.0, drive, little)).poses for drive in range(400)]
    ends = [np.concatenate([closing(poses, 1, 8), closing(poses, 3, 6)]) for poses in drives]
    measured = np.cov(np.array(ends).T)
    loops = Loops.of(circuit(5, 4, 0.0, 0, little))
    shared = loops.shared(([1], [8]), ([3], [6]))[0]
    assert measured[:3, 3:] == pytest.approx(
        shared, abs=0.15 * np.sqrt(np.outer(measured.diagonal()[:3], measured.diagonal()[3:])).max()
    )


@cache
def square() -> Solution:
    return solve(circuit(4, 5, 1.0))


def test_displacements_tell_equal_corners_of_a_square_apart() -> None:
    alone = solve(circuit(4, 5, 1.0).without_displacements())
    assert (alone.cost.dstates, alone.cost.places) == (6, 3)  # type: ignore[union-attr]
    solution = square()
    assert (solution.cost.dstates, solution.cost.places) == (8, 4)  # type: ignore[union-attr]
    assert solution.complete
    assert solution.count == 1
    assert solution.effort.evidence["displacement"]["pairs"] > 0
    assert solution.maps[0].labels == tuple(step % 8 for step in range(11))


@pytest.mark.parametrize("corners", [3, pytest.param(6, marks=pytest.mark.slow)])
def test_displacements_tell_corners_of_polygons_apart(corners: int) -> None:
    trace = circuit(corners, 2 * corners + 1, 1.0, seed=corners)
    solution = solve(trace, Theory.causal())
    assert solution.maps[0].labels == tuple(step % (2 * corners) for step in range(len(trace)))
    assert solution.count == 1


@pytest.mark.parametrize(
    ("scale", "bend"),
    [
        (-0.1, -math.radians(0.2)),
        pytest.param(0.1, 0.0, marks=pytest.mark.slow),
        pytest.param(0.0, math.radians(0.2), marks=pytest.mark.slow),
    ],
)
def test_fit_estimates_scale_and_drift(scale: float, bend: float) -> None:
    trace = circuit(5, 16, 1.0, 1, Odometry(heading=0.001, turning=0.01, angle=0.005), scale, bend)
    solution = solve(trace, Theory.causal())
    found = solution.maps[0]
    assert found.labels == tuple(step % 10 for step in range(len(trace)))
    assert found.fit is not None
    assert found.fit.p > 0.001
    assert found.fit.bend == pytest.approx(bend, abs=0.0015)
    x, y = found.fit.poses[1].x, found.fit.poses[1].y
    assert math.hypot(x, y) == pytest.approx(
        ROOM, rel=0.12
    )  # loops that close hardly notice the scale
    stiff = solve(
        replace(trace, odometry=replace(trace.odometry or WHITE, scale=0.0, bend=0.0)),
        Theory.causal(),
    )
    if bend:
        assert stiff.maps[0].labels != found.labels or stiff.support.warnings


@settings(max_examples=5)
@given(st.data())
def test_jacobian_of_the_fit_equals_finite_differences(data: st.DataObject) -> None:
    trace = data.draw(traces().filter(lambda trace: trace.has_displacements), label="trace")
    problem = poses_of(trace, solve(trace, Theory.causal().replace(displacement="none")).maps[0])
    assume(len(problem._moved))
    rng = np.random.default_rng(0)
    unknown = problem._begun() + 0.01 * rng.normal(size=problem._size)
    numeric = approx_fprime(unknown, problem._residuals, 1e-7)
    assert problem._jacobian(unknown) == pytest.approx(numeric, abs=2e-3)


def test_long_drive_without_returns_fits_exactly() -> None:
    """Turns are a hundred times as exact as travels. That makes the equations stiff."""
    chance = random.Random(0)
    moves = [((10, 0.3, 0.05), (0, 0, chance.choice([1.6, -1.6])))[t % 2] for t in range(200)]
    odometry = Odometry(along=0.05, across=0.005, heading=0.002, turning=0, position=0, angle=0)
    trace = Trace.from_steps(
        "a" * 201, ["travel", "left"] * 100, displacements=moves, odometry=odometry
    )
    assert Poses(trace, range(201), range(201)).misfit() < 1e-9


def test_least_squares_find_the_smallest_solution() -> None:
    rng = np.random.default_rng(0)
    some, values, weights = rng.normal(size=(12, 5)), rng.normal(size=12), rng.uniform(1, 2, 12)
    some[:, 4] = some[:, 3]  # of several solutions, the smallest
    smallest = np.linalg.lstsq(some * weights[:, None], values * weights, rcond=1e-12)[0]
    assert least_squares(csr_array(some), values, weights) == pytest.approx(smallest, abs=1e-6)
    nothing = csr_array((0, 5))  # as if all displacements may be wrong
    assert (least_squares(nothing, np.zeros(0), np.zeros(0)) == 0).all()
    square, added = some.T @ some, np.full(5, 0.1)
    right = square @ np.arange(5.0) + 0.1 * np.arange(5.0)
    assert system_solved(csr_array(square), added, right) == pytest.approx(np.arange(5.0))


def test_inverse_of_separate_blocks_looks_at_the_clock_for_each() -> None:
    rng = np.random.default_rng(0)
    order, whole = rng.permutation(90), np.zeros((90, 90))
    for block in np.split(order, [20, 50]):
        some = rng.normal(size=(2 * len(block), len(block)))
        whole[np.ix_(block, block)] = some.T @ some
    rows, added = rng.permutation(90)[:40], np.full(90, 0.1)
    expected = np.linalg.inv(whole + 0.1 * np.identity(90))[np.ix_(rows, rows)]
    looks: list[None] = []
    with heeding(lambda: looks.append(None)):
        assert inverse(csr_array(whole), added, rows) == pytest.approx(expected)
    assert len(looks) == 3


def test_p_values_of_true_maps_are_plausible() -> None:
    """Of 60 true maps about half have a p-value above one half. At most very few have one below a
    thousandth."""
    chances = []
    for seed in range(60):
        trace = circuit(5, 12, 1.0, seed)
        chances.append(fit(trace, true_circuit(trace, 5)).p)
    assert 15 <= sum(p > 0.5 for p in chances) <= 45
    assert min(chances) > 1e-3


def true_circuit(trace: Trace, corners: int) -> SSHMap:
    return causal_map([step % (2 * corners) for step in range(len(trace))], trace)


def test_fitted_poses_are_near_the_true_dstates() -> None:
    trace = circuit(4, 8, 0.3, 2)
    found = fit(trace, true_circuit(trace, 4))
    at = [(pose.x, pose.y) for pose in found.poses]
    for s, corner in enumerate(
        [(0, 0), (10, 0), (10, 0), (10, -10), (10, -10), (0, -10), (0, -10), (0, 0)]
    ):
        assert at[s] == pytest.approx(corner, abs=0.8)
    assert found.poses[0].spread == (0.0, 0.0, 0.0)
    assert all(pose.spread[0] > 0 for pose in found.poses[1:7])


@pytest.mark.parametrize(("factor", "said"), [(0.3, "too loose"), (3.0, "too tight"), (1.0, None)])
def test_warning_if_the_noise_model_is_wrong(factor: float, said: str | None) -> None:
    trace = circuit(5, 30, factor, 4)
    ssh_map = true_circuit(trace, 5)
    warning = noise_warning(replace(ssh_map, fit=fit(trace, ssh_map)), trace)
    if said is None:
        assert warning is None
        return
    assert warning is not None
    assert said in warning
    assert (
        f"multiply them by {factor:.1g}"[:-1] in warning
        or abs(float(warning.rsplit(" ", 1)[1]) - factor) < 0.2 * factor
    )
    variances = ((0.01, 0.0, 0.0), (0.0, 0.01, 0.0), (0.0, 0.0, 0.01))
    matched = replace(trace, closures=(Closure(0, 1, (0.0, 0.0, 0.0), variances),))
    of_log = noise_warning(replace(ssh_map, fit=fit(trace, ssh_map)), matched)
    assert of_log is not None
    assert of_log.endswith("the track or some joins of the map may be wrong")


def test_warning_gives_a_limit_if_displacements_are_exact() -> None:
    square = [(10, 0, 0), (0, 0, math.pi / 2)] * 4
    (warning,) = solve(
        Trace.from_steps("abcdefgha", ["travel", "left"] * 4, displacements=square)
    ).warnings
    assert "its standard deviations are at least 100 times larger than the errors" in warning


def test_no_noise_warning_for_a_map_without_returns() -> None:
    """Turns on the spot fit exactly. A chi-square of 0 for them is no sign of too much noise."""
    trace = Trace.from_steps(
        "abcd", ["travel", "right", "travel"], displacements=[(5, 0, 0), (0, 0, -1.57), (5, 0, 0)]
    )
    solution = solve(trace)
    assert solution[0].fit is not None
    assert (solution[0].fit.chi2, solution[0].fit.dof) == (pytest.approx(0, abs=1e-9), 2)
    assert solution.warnings == ()


def test_warning_if_noise_exceeds_all_motion() -> None:
    """A warning comes if the noise of the odometry hides all motion, also if wheels report none. It
    does not come for a small robot with small noise."""
    trace = circuit(4, 9)

    def scaled(by: float, **noise: float) -> Trace:
        steps = (
            replace(
                s, displacement=s.displacement and (s.displacement[0] * by, 0.0, s.displacement[2])
            )
            for s in trace.steps
        )
        return replace(trace, steps=tuple(steps), odometry=replace(WHITE, **noise))

    said = (
        "the odometry cannot tell a travel from standing still: the longest travel is "
        "0.01 m, and its noise about 0.1 m; "
    )
    count = Theory(weigh="count")
    assert (solve(scaled(0.001), count).support.warnings or ("",))[0].startswith(said)
    assert "the longest travel is 0 m" in (solve(scaled(0.0), count).support.warnings or ("",))[0]
    assert units_warning(scaled(0.001, position=0.001)) is None
    assert units_warning(trace) is None
    assert units_warning(trace.without_displacements()) is None
    assert units_warning(Trace.from_steps("ab", ["right"], displacements=[(0.0, 0.0, 1.0)])) is None


def test_maps_are_sorted_by_misfit() -> None:
    trace = circuit(4, 6, 1.0)
    theory = Theory.causal().replace(prefer=(), joint=1, reject=1e-9)
    solution = solve(trace, theory, max_maps=None)
    squares = [ssh_map.fit.chi2 for ssh_map in solution.maps if ssh_map.fit]
    assert len(squares) == solution.count > 1
    assert squares == sorted(squares)


@pytest.mark.slow
def test_missing_displacement_cuts_dead_reckoning() -> None:
    trace = circuit(4, 5, 1.0)
    cut = replace(
        trace,
        steps=tuple(
            replace(s, displacement=None) if t == 7 else s for t, s in enumerate(trace.steps)
        ),
    )
    theory = settle(cut).theory
    pairs = pairs_of(cut, theory)
    assert pairs.apart
    assert all((i >= 7) == (j >= 7) for j, others in pairs.apart.items() for i in others)
    assert solve(cut).complete


def test_theory_can_ignore_or_require_displacements() -> None:
    trace = circuit(4, 9, 1.0)
    assert (
        solve(trace, Theory(displacement="none")).cost == solve(trace.without_displacements()).cost
    )
    with pytest.raises(TheoryError, match="displacement: expected a trace with displacements"):
        solve(trace.without_displacements(), Theory(displacement="use"))
    for wrong in (
        {"reject": 0.0},
        {"reject": 1.5},
        {"joint": 3},
        {"joint": 0},
        {"displacement": "some"},
        {"prefer": ("auto", "paths")},
    ):
        with pytest.raises(TheoryError, match=next(iter(wrong))):
            Theory(**wrong)  # type: ignore[arg-type]


def test_displacements_make_places_preferred_to_paths() -> None:
    trace = circuit(4, 9, 1.0)
    assert settle(trace, Theory()).theory.prefer == ("dstates", "places", "paths")
    assert settle(trace.without_displacements(), Theory()).theory.prefer == (
        "dstates",
        "paths",
        "places",
    )
    assert settle(trace, Theory.causal()).theory.prefer == ("dstates",)
    assert settle(trace, Theory.circumscriptive()).theory.prefer == ("paths", "places", "dstates")


def test_checker_names_returns_that_displacements_refuse() -> None:
    trace = circuit(4, 9, 1.0)
    wrong = solve(trace, Theory(displacement="none")).maps[0]
    said = [
        violation
        for violation in check(trace, wrong, Theory(displacement="use", prefer=()))
        if violation.axiom == "one_pose"
    ]
    assert said
    assert "By the displacements it cannot be that" in said[0].message


def test_maps_with_a_fit_survive_a_round_trip(tmp_path: Path) -> None:
    found = square().maps[0]
    found.save(tmp_path / "map.json")
    again = SSHMap.load(tmp_path / "map.json")
    assert again == found
    assert again.fit is not None
    assert found.fit is not None
    assert again.fit.chi2 == pytest.approx(found.fit.chi2, abs=1e-5)
    assert [p.x for p in again.fit.poses] == pytest.approx([p.x for p in found.fit.poses], abs=1e-3)


def test_p_values_of_true_maps_are_plausible_if_turns_have_hardly_any_noise() -> None:
    squares = freedom = 0.0
    for seed in range(400, 410):
        noise = Odometry(along=0.05, across=0.005, heading=0.002, turning=0.0, position=0.0)
        walk = maze(4, 4, steps=24, seed=seed, stars=True, follow=True, odometry=noise)
        number = {state: i for i, state in enumerate(dict.fromkeys(walk.truth))}
        labels = tuple(number[state] for state in walk.truth)
        cells = [state[:2] for state in number if isinstance(state, tuple)]
        dstates = tuple(DState(i, "", cells.index(cell)) for i, cell in enumerate(cells))
        found = fit(walk.trace, SSHMap(labels, dstates, ()))
        assert found.p > 1e-3
        squares, freedom = squares + found.chi2, freedom + found.dof
    assert squares == pytest.approx(freedom, rel=0.25)


@cache
def walks() -> list[Walk]:
    """Walks through 20 mazes."""
    return [
        maze(3, 3, steps=30, seed=seed, stars=True, follow=True, odometry=Odometry())
        for seed in range(20)
    ]


@pytest.mark.parametrize("kept", ["travels", "turns", "most", "few"])
def test_p_values_of_true_maps_are_plausible_without_turns(kept: str) -> None:
    """20 true maps without reported turns. Headings follow from places that stretches share, or
    stay unknown."""
    squares = freedom = above = 0.0
    for seed, walk in enumerate(walks()):
        rng = np.random.default_rng(seed)
        keeps = [
            {
                "travels": action.kind == "travel",
                "turns": action.kind == "turn",
                "most": rng.random() < 0.8,
                "few": rng.random() < 0.2,
            }[kept]
            for action in walk.trace.actions
        ]
        steps = (
            step if keep else replace(step, displacement=None)
            for step, keep in zip(walk.trace, [True, *keeps], strict=True)
        )
        number: dict[object, int] = {}
        labels = tuple(number.setdefault(state, len(number)) for state in walk.truth)
        places: dict[object, int] = {}
        dstates = tuple(
            DState(i, "", places.setdefault(state[:2], len(places)))
            for i, state in enumerate(number)
        )  # type: ignore[index]
        found = fit(replace(walk.trace, steps=tuple(steps)), SSHMap(labels, dstates, ()))
        assert found.p > 1e-5
        squares, freedom, above = squares + found.chi2, freedom + found.dof, above + (found.p > 0.5)
    assert squares == pytest.approx(freedom, rel=0.25)
    assert 4 <= above <= 16


@pytest.mark.parametrize(("offset", "facing"), [(0.0, 0.0), (0.3, 0.0), (0.3, 0.1)])
@pytest.mark.parametrize("rows", [[(0, 2), (0, 4)], [(0, 4), (2, 4)]])
def test_misfit_of_two_returns_with_a_common_end_equals_its_map(
    offset: float, facing: float, rows: list[tuple[int, int]]
) -> None:
    """The robot comes to one place three times. Evidence, checker and misfit judge it alike."""
    still = 1e-8
    noise = ((0.04, 0.0, 0.0), (0.0, 0.04, 0.0), (0.0, 0.0, still))
    moves = [(2.0, 0.0, 0.0), (-1.3, 0.4, 0.0), (0.0, 2.0, 0.0), (0.2, -2.9, 0.0)]
    trace = Trace.from_steps("abcde", ["travel"] * 4, displacements=moves)
    odometry = Odometry(scale=0.0, bend=0.0, offset=offset, facing=facing)
    steps = [replace(step, covariance=noise) if i else step for i, step in enumerate(trace.steps)]
    trace = replace(trace, steps=tuple(steps), odometry=odometry)
    misfit = Poses(trace, range(5), [0, 1, 0, 2, 0]).misfit()
    first, second = (np.array([[*row, 0]]) for row in rows)
    (square,) = joint_squares(Loops.of(trace), first, second)
    assert square == pytest.approx(misfit, rel=1e-3)
    both = np.array([[*row, 2] for row in rows])
    judged = ErrorFilter(trace, odometry, 0.0, 0.0)
    (square,) = _square_together(judged, both, np.array([1]), np.array([0]))
    assert square == pytest.approx(misfit, rel=1e-3)
