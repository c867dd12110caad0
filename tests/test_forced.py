"""Joins that every cheap map has, and the bound that follows (solver/costs/forced.py)."""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import islice
from typing import NamedTuple
from unittest.mock import patch

import numpy as np
import pytest
import together
import truth
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from strategies import traces
from test_weighing import cheapest_with_faults
from truth import partition

from ssh_abduction import Solution, Theory, Trace, solve
from ssh_abduction.data import Odometry
from ssh_abduction.data.groups import indices_of
from ssh_abduction.data.map_parts import DState
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.solution.weighed import Weighed
from ssh_abduction.solver.costs import beams
from ssh_abduction.solver.costs.forced import Forcing
from ssh_abduction.solver.costs.joined import Gains, Joined, Visits
from ssh_abduction.solver.costs.misfit import Misfit
from ssh_abduction.solver.geometry import poses as poses_module
from ssh_abduction.solver.geometry.poses import conditional, framed, may_be_joined
from ssh_abduction.solver.steps.log import Log
from ssh_abduction.theory.settle import settle

EQUAL = 1e-6
ROUGH = {**truth.NOISE, "along": 0.3, "across": 0.1, "heading": 0.02, "scale": 0.05, "bend": 0.0035}
FINE = {**truth.NOISE, "scale": 0.05, "bend": 0.0035}
STRAIGHT = {**ROUGH, "bend": 0.0}
THEORIES = {
    "frames": Theory.topological(),
    "joint": Theory.topological(),
    "causal": Theory.causal(),
    "bare": Theory.topological().replace(star="none"),
}


class Case(NamedTuple):
    """A trace, its theory, its cheapest maps, and their cost."""

    trace: Trace
    theory: Theory
    solution: Solution
    weighed: Weighed


def forcing_of(trace: Trace, theory: Theory, ssh_map: SSHMap) -> Forcing:
    problem = settle(trace, theory)
    assert Forcing.holds_for(problem)
    log = Log(problem.trace, problem.theory, evidence=problem.evidence)
    return Forcing(problem, log, Misfit(problem), ssh_map)


@contextmanager
def without_forcing() -> Iterator[None]:
    with patch.object(Forcing, "holds_for", lambda _: False):
        yield


def case_of(kind: str, seed: int, noises: Sequence[dict[str, float]] = (ROUGH, FINE)) -> Case:
    draw = random.Random(seed)
    noise = truth.Noise(Odometry(**draw.choice(noises)))
    if kind == "joint":
        (known,) = together.of_mazes(3, draw.randint(3, 5), [seed], noise, 2)
    else:
        known = truth.random_walk(3, draw.randint(5, 9), seed, noise)
    theory = THEORIES[kind].replace(weigh="cost")
    with without_forcing():
        return solved(known.trace, theory)


def solved(trace: Trace, theory: Theory) -> Case:
    with patch.object(beams, "WIDTHS", (1,)):  # the proof needs no better guess
        solution = solve(trace, theory)
    assert solution.status.value == "optimal"
    assert solution.weighed is not None
    return Case(trace, theory, solution, solution.weighed)


@pytest.mark.filterwarnings("ignore:views")
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", THEORIES)
def test_all_cheap_maps_have_the_forced_joins_and_are_found(kind: str, seed: int) -> None:
    trace, theory, solution, weighed = case_of(kind, seed)
    most = weighed.nats + (1e-3, 4.0)[seed % 2]
    cheap = [rival for rival in weighed.rivals if rival.nats < most and not rival.estimated]
    for ssh_map in {solution.maps[0], solution.maps[-1]}:
        forcing = forcing_of(trace, theory, ssh_map)
        # Two drives have too many maps.
        assert max(islice(forcing.bounds(most), 40)) <= weighed.nats + EQUAL
        for rival in cheap:
            for join in forcing.returns(most):
                names = rival.dstates if join.of == "dstate" or not rival.places else rival.places
                assert names[join.first] == names[join.second]
        courses = {(partition(dstates), partition(places)) for dstates, places in forcing.found}
        assert not forcing.is_complete or courses >= {
            (partition(one.dstates), partition(one.places or [0] * len(trace))) for one in cheap
        }


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["frames", "causal", "bare"])
def test_no_map_has_two_steps_at_one_place_that_are_apart(kind: str) -> None:
    known = truth.random_walk(3, 12, 0, truth.Noise(Odometry(**FINE)))
    problem = settle(known.trace, THEORIES[kind])
    log = Log(problem.trace, problem.theory, evidence=problem.evidence)
    visits = Visits.of(problem, log, true_map(known))
    one = indices_of(known.dstates)
    met = replace(visits, met=(next((at[0], at[-1]) for at in one.values() if len(at) > 1),))
    for some, fails in ((met, False), (met.parted(met.met), True)):
        classes = Joined(some, np.arange(len(some.place)), Misfit(problem).visit, kind == "causal")
        assert classes.fails == fails


@pytest.mark.slow
def test_forced_joins_prove_a_maze_of_sixty_steps() -> None:
    known = truth.random_walk(4, 60, 3001, truth.Noise(Odometry(**FINE)))
    trace, theory, solution, weighed = solved(known.trace, Theory.topological())
    forcing = forcing_of(trace, theory, solution.maps[0])
    *_, low = forcing.bounds(weighed.nats + 1)
    assert weighed.nats - 2 < low <= weighed.nats + EQUAL
    assert [weighed.rivals[0].dstates, weighed.rivals[0].places] in map(list, forcing.found)


@pytest.mark.parametrize("off", [0.0, 0.05])
def test_slopes_of_the_spreads_are_those_by_differences(off: float) -> None:
    noise = truth.Noise(Odometry(**{**ROUGH, "offset": off, "facing": off / 2}))
    problem = settle(truth.random_walk(3, 8, 5, noise).trace)
    misfit = Misfit(problem)
    steps, entries = range(len(problem.trace)), [2, 3, 4, 5, 2 * len({*misfit.visit}) + 3]
    ((poses, _),) = misfit.bounding(steps, misfit.visit)
    best = poses.best[0]
    products = conditional(poses, entries)[1]

    def spreads(unknown: NDArray[np.float64]) -> NDArray[np.float64]:
        vars(poses)["best"] = unknown, 0.0
        return conditional(poses, entries)[0]

    origin = [0, 1, 2 * poses._positions + poses._origin]
    jacobian = poses._jacobian(best, of_world=True)
    free = np.setdiff1d(range(len(best)), origin)
    tiny = 1e-5 * np.identity(len(best))[free]
    slopes = np.array([spreads(best + d) - spreads(best - d) for d in tiny]) / 2e-5
    spread = np.linalg.inv((jacobian.T @ jacobian)[np.ix_(free, free)])
    most = products[1:, 1:].max()
    assert most > 1e-5
    assert np.allclose(products[1:, 1:], slopes.T @ spread @ slopes, rtol=0, atol=0.01 * most)


@pytest.mark.parametrize("level", ["topological", "causal"])
@pytest.mark.parametrize("seed", [0, 1, 5, 18])
def test_moves_of_joined_steps_bound_what_moves_of_each_map_cost(seed: int, level: str) -> None:
    """Some joins of the true map are known. The bound holds for it, at its poses and at others."""
    known = truth.random_walk(3, 30, seed, truth.Noise(Odometry(**ROUGH)))
    theory, random = getattr(Theory, level)(), np.random.default_rng(seed)
    problem = settle(known.trace, theory)
    labels = partition(known.dstates)
    places = partition(known.places) if level == "topological" else labels
    misfit = Misfit(problem)
    ((poses, _),) = misfit.bounding(labels, places)
    at, frame = framed(poses)
    if seed:
        at = at * [0.2, 0.2, 0.5]  # a move may lead to many things
    # Visits to some places are not joined yet.
    open_place = random.random(max(places) + 1) < min(seed / 8, 0.5)
    visit = [v if open_place[p] else -1 for v, p in zip(misfit.visit, places, strict=True)]
    of, of_places = (partition([*zip(some, visit, strict=True)]) for some in (labels, places))
    true, true_place = (
        np.array([some[names.index(k)] for k in range(max(names) + 1)])
        for some, names in ((labels, of), (places, of_places))
    )
    # Some of what is apart is known to be apart.
    apart = (true[:, None] != true, true_place[:, None] != true_place)
    hidden = [np.triu(random.random(some.shape) < seed / 8) for some in apart]
    apart = apart[0] & ~(hidden[0] | hidden[0].T), apart[1] & ~(hidden[1] | hidden[1].T)
    frames = np.zeros(len(true), dtype=int)
    nats, saved, pulls = problem.prior.least_chosen(of, of_places, (at[true], frames), apart)
    later = [[*some].index(k) < i for some in (true, true_place) for i, k in enumerate(some)]
    low = nats - float(np.concatenate(saved) @ later)
    joined = np.flatnonzero(later[: len(true)]).tolist()
    assert nats > 0
    assert len(pulls.first)

    def off(laid: NDArray[np.float64], joined: Sequence[int] = ()) -> float:
        (x, y, facing), moved = laid[pulls.first].T, pulls.moved.T
        gone = (moved[0] + 1j * moved[1]) * np.exp(1j * facing) + x + 1j * y
        gone -= laid[pulls.last, 0] + 1j * laid[pulls.last, 1]
        turn = facing + moved[2] - laid[pulls.last, 2]
        turn -= np.round(turn / (2 * np.pi)) * 2 * np.pi
        square = np.stack([gone.real, gone.imag, turn], 1) ** 2 * pulls.weight
        return float(square[~np.isin(pulls.of, joined)].sum() / 2)

    for wide in (0.0, 0.3, 1.0, 3.0):
        there = random.normal(size=(max(places) + 1, 2))[[places[labels.index(s)] for s in true]]
        other = at[true] + wide * np.column_stack([there, random.normal(size=len(at))[true] / 5])
        more = off(other) - off(at[true])
        assert problem.prior.chosen(of, of_places, (other, frames)) >= nats + more - EQUAL
        of_map = problem.prior.chosen(
            labels, places, (other[[of[labels.index(s)] for s in range(len(at))]], frame)
        )
        assert of_map >= low + off(other, joined) - off(at[true], joined) - EQUAL
    if not seed:  # dstates are those of the poses
        unknown = poses.best[0]
        slope, _ = poses_module._pulled(poses, unknown, pulls)

        def cost(unknown: NDArray[np.float64]) -> float:
            there = unknown[: 2 * poses._positions].reshape(-1, 2)[poses._place]
            facing = unknown[2 * poses._positions : poses._known]
            return off(np.column_stack([there, facing]))

        tiny = 1e-5 * np.identity(len(unknown))
        by_differences = [(cost(unknown + d) - cost(unknown - d)) / 2e-5 for d in tiny]
        assert slope.sum(axis=1) == pytest.approx(by_differences, abs=1e-4)


def test_without_a_displacement_the_bound_knows_no_covariance() -> None:
    trace = truth.random_walk(3, 6, 5, truth.Noise(Odometry(**ROUGH))).trace
    last = [step for step in range(len(trace)) if trace.steps[step].displacement][-1]
    for one, holds in ((trace, True), (trace.without_displacements_at([last]), False)):
        misfit = Misfit(settle(one))
        ((poses, _),) = misfit.bounding(range(len(one)), misfit.visit)
        assert may_be_joined(poses) is holds


def true_map(known: truth.Known) -> SSHMap:
    """The map of a maze by its truth, without paths. Dstates are (x, y, heading)."""
    labels, places = truth.partition(known.dstates), truth.partition(known.places)
    dstates = dict[int, DState]()
    for step, label, place, true in zip(
        known.trace.steps, labels, places, known.dstates, strict=True
    ):
        assert isinstance(true, tuple)
        dstates[label] = DState(label, step.view, place, heading=true[2])
    return SSHMap(labels, tuple(dstates.values()), (), ())


@pytest.mark.slow
def test_halving_the_maps_raises_the_bound() -> None:
    known = truth.random_walk(6, 150, 3002, truth.Noise(Odometry(**FINE)))
    ssh_map, problem = true_map(known), settle(known.trace)
    cost = Misfit(problem).nats_of(ssh_map)
    lows = [*islice(forcing_of(known.trace, Theory.topological(), ssh_map).bounds(cost), 20)]
    assert lows == sorted(lows)
    assert lows[0] + 1 < lows[-1] <= cost


def test_forced_bound_is_off_if_faults_other_than_views_are_allowed() -> None:
    known = truth.random_walk(3, 8, 0, truth.Noise(Odometry(**FINE)))
    assert Forcing.holds_for(settle(known.trace))
    assert not Forcing.holds_for(settle(known.trace, Theory(misread=2.0)))
    assert Forcing.holds_for(settle(known.trace, Theory(misread=2.0, star="none")))
    assert not Forcing.holds_for(settle(known.trace, Theory(slipped=2.0, star="none")))


@settings(max_examples=6)
@given(st.data())
def test_forced_bound_holds_if_views_may_be_misread(data: st.DataObject) -> None:
    given = traces(max_steps=3).filter(lambda trace: trace.has_displacements)
    trace = data.draw(given, label="trace")
    theory = Theory(
        level=data.draw(st.sampled_from(["causal", "topological"]), label="level"),
        misread=data.draw(st.sampled_from([0.2, 0.6, 1.0]), label="misread"),
        boundary="none",
        star="none",
        reject=1e-300,
        weigh="cost",
    )
    if not Forcing.holds_for(settle(trace, theory)):
        return
    nats, _ = cheapest_with_faults(trace, theory)
    solution = solve(trace, theory, time_limit=100)
    for ssh_map in solution.maps[:1]:
        assert solution.weighed is not None
        assert nats == pytest.approx(solution.weighed.nats, abs=1e-5)
        forcing = forcing_of(trace, theory, ssh_map)
        assert max(islice(forcing.bounds(nats + 1e-3), 20)) <= nats + EQUAL
        assert max(islice(forcing.bounds(2 * nats), 20)) <= nats + EQUAL


def test_a_view_that_is_misread_twice_costs_twice() -> None:
    visits = Visits(
        visit=np.arange(6),
        direction=np.zeros(6, dtype=int),
        seen=np.array([0, 1, 0, 2, 0, 3]),
        place=np.arange(6),
        links=np.zeros((5, 3), dtype=int),
        apart=np.zeros((1, 6, 6), dtype=bool),
        away=np.zeros((6, 6), dtype=bool),
        at=range(6),
        price=np.full(6, 2.0),
    )
    classes = Joined(visits, np.array([0, 1, 0, 2, 0, 3]), range(6), is_causal=True)
    # Three classes of a visit each, and one of three visits. Joins gain 9 nats each.
    assert classes.excused.tolist() == [0.0, 2.0, 4.0, 6.0, 12.0]
    way = Gains(100.0, np.full(4, 9.0), np.zeros(4))
    assert classes.low([[way]]) == 100 - 3 * 9 + 3 * 2  # one dstate, and three views misread
    mixed = Joined(visits, np.array([0, 0, 0, 1, 0, 2]), range(6), is_causal=True)
    assert mixed.spoilt == 2.0  # of four views of the first dstate, one differs
