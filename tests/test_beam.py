"""Maps that a beam of hypotheses about the displacements finds (sources/metric/beam.py)."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import floors
import pytest
import truth
from hypothesis import given, settings
from hypothesis import strategies as st
from plan_tours import tour
from strategies import theories, traces
from test_plans import plan_of, xml
from turns import guessed

from ssh_abduction import Theory, Trace, solve
from ssh_abduction.checker.checker import check
from ssh_abduction.data import Odometry
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.explain.no_map import explain
from ssh_abduction.runtime.clock import heeding
from ssh_abduction.solution import Status
from ssh_abduction.solver import Search
from ssh_abduction.solver.costs.misfit import Misfit
from ssh_abduction.solver.sources.metric.beam import Beam
from ssh_abduction.solver.sources.metric.completing import completed
from ssh_abduction.solver.steps.log import Log
from ssh_abduction.theory.fields import PATHS
from ssh_abduction.theory.settle import settle

DRIFTING = truth.Noise(Odometry(**{**truth.NOISE, "scale": 0.05, "bend": 0.0035}))


def maps_of(trace: Trace, theory: Theory, width: int) -> list[SSHMap]:
    problem = settle(trace, theory)
    return list(Beam(problem, Log(trace, problem.theory, problem.pairs), width).maps())


@pytest.mark.parametrize("seed", range(700, 703))
def test_the_first_map_of_a_maze_is_true(seed: int) -> None:
    (known,) = truth.mazes(5, 120, [seed], DRIFTING)
    assert truth.is_true(maps_of(known.trace, Theory.topological(), 1)[0], known)


@pytest.mark.parametrize("stars", [True, False])
def test_beam_finds_the_true_map_of_aces3(stars: bool) -> None:
    (known,) = truth.aces3([700], DRIFTING)
    theory = Theory.topological() if stars else Theory(star="none")
    assert any(truth.is_true(ssh_map, known) for ssh_map in maps_of(known.trace, theory, 16))


@pytest.mark.parametrize("misread", [0.0, pytest.param(1.5, marks=pytest.mark.slow)])
def test_beam_joins_steps_of_unknown_view_with_known_ones(misread: float) -> None:
    known = truth.random_walk(4, 40, 16302, DRIFTING)
    trace = known.trace.with_views([v if t % 4 else None for t, v in enumerate(known.trace.views)])
    (found, *_) = maps_of(trace, Theory(misread=misread), 4)
    assert truth.is_true(found, known)
    assert solve(trace, Theory(misread=misread), work_limit=1.5).maps[0].labels == found.labels


def test_beam_finds_the_true_causal_map() -> None:
    (known,) = truth.mazes(3, 40, [700], DRIFTING)
    assert truth.is_true(maps_of(known.trace, Theory.causal(), 4)[0], known)


def test_beam_finds_the_true_map_with_gateways_at_any_angles(tmp_path: Path) -> None:
    """A room with one gateway ends a path, so the axioms force some returns."""
    plan = plan_of(tmp_path, xml())
    known = truth.with_truth("ring", tour(plan, 60, 5, DRIFTING.odometry))
    assert truth.is_true(maps_of(known.trace, Theory.topological(), 4)[0], known)


@pytest.mark.parametrize("looks", [150, 400])
def test_interrupted_beam_gives_a_map_with_new_dstates_for_the_rest(looks: int) -> None:
    """The steps that the beam reached are joined, and all others are new."""
    (known,) = truth.mazes(5, 120, [700], DRIFTING)
    search = Search(known.trace, Theory(star="none"))
    candidates, left = search.parts.candidates, iter(range(looks))
    candidates.sketch(0.0)
    trivial = search.best
    beam = candidates.beam(1)
    assert beam
    assert trivial

    def over() -> None:
        if next(left, None) is None:
            raise TimeoutError

    with pytest.raises(TimeoutError), heeding(over):
        list(beam.maps())
    candidates.go_on(beam)
    assert search.best
    assert len(search.best.dstates) < len(trivial.dstates)
    assert check(known.trace, search.best, search.theory) == ()


def test_narrow_beam_tells_dstates_at_one_place_apart() -> None:
    """The robot drives along a corridor twice, and stops halfway at the second time only.

    Both times it begins at one place, and nothing but the next displacement shows that it begins at
    another dstate there. A beam of one hypothesis finds this without going back.
    """
    actions = ["travel", "around", "travel", "around", "travel", "travel"]
    metres = [10.0, 0.0, 10.0, 0.0, 5.0, 5.0]
    moves = [(far, 0.0, 0.0 if far else math.pi) for far in metres]
    noise = Odometry(offset=0.2, facing=0.1)
    trace = Trace.from_steps([0] * 7, actions, displacements=moves, odometry=noise)
    with patch.object(Beam, "_checked", side_effect=AssertionError):
        best = maps_of(trace, Theory.topological().replace(star="none", without=PATHS), 1)[0]
    places = [best.dstates[d].place for d in best.dstate_at]
    assert places == [0, 1, 1, 0, 0, 2, 1]


def test_beam_keeps_hypotheses_with_other_places() -> None:
    """Beside the cheapest hypotheses there are others, which differ in places from all these."""
    (known,) = truth.mazes(3, 40, [700], DRIFTING)
    problem, width, others = settle(known.trace, Theory(star="none")), 8, 0
    beam = Beam(problem, Log(known.trace, problem.theory, problem.pairs), width)
    kept = [beam._extending.first()]
    for t in range(1, len(known.trace)):
        options = beam._extending.options_of(kept, t, joins=True)
        kept = list(beam._best(options, t, width))
        assert [found.nats for found in kept[:width]] == [o.nats for o in options[:width]]
        at = [[found.places[s] for s in found.labels.values()] for found in kept]
        assert all(at[k] not in at[:k] for k in range(width, len(at)))
        others += len(at) > width
    assert others


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "seed"), [("misread", 702), ("jumped", 701), ("slipped", 701)])
def test_a_beam_finds_faults(kind: str, seed: int) -> None:
    (known,) = truth.mazes(5, 120, [seed], DRIFTING)
    steps, wrong = list(known.trace.steps), [41, 55, 77]
    for t in wrong:
        step, other = steps[t], steps[t + 1]
        x, y, turned = step.displacement or (0.0, 0.0, 0.0)
        faulty = {
            "misread": {"view": other.view},
            "jumped": {"displacement": (x + 2, y - 3, turned)},
            "slipped": {"action": other.action},
        }
        steps[t] = replace(step, **faulty[kind])
    wrong = [t for t in wrong if steps[t] != known.trace.steps[t]]
    trace = replace(known.trace, steps=tuple(steps))
    theory = Theory(**{kind: 3.0})
    best = maps_of(trace, theory, 4)[0]
    assert truth.is_true(best, replace(known, trace=trace))
    assert [(fault.kind, fault.step) for fault in best.faults] == [(kind, t) for t in wrong]
    assert check(trace, best, theory) == ()


@settings(max_examples=8)
@given(data=st.data())
def test_all_maps_of_a_beam_satisfy_the_axioms(data: st.DataObject) -> None:
    trace = data.draw(traces(closures=True).filter(lambda trace: trace.has_displacements))
    faults = st.sampled_from([0.0, 1.0]) if data.draw(st.booleans()) else st.just(0.0)
    theory = data.draw(theories(trace, fixed=("misread", "slipped", "jumped")))
    theory = theory.replace(displacement="use", weigh="auto")
    if theory.boundary != "defeasible" and not theory.planar and theory.prefer[:1] == ("dstates",):
        theory = theory.replace(
            **{kind: data.draw(faults) for kind in ("misread", "slipped", "jumped")}
        )
    for ssh_map in maps_of(trace, theory, data.draw(st.sampled_from([1, 3]))):
        assert check(trace, ssh_map, theory) == ()


def test_stopped_search_returns_the_true_map_of_the_beam() -> None:
    """Without the beam, the best map after this time has more places.

    The limit is of processor time, so that other processes do not shorten the search.
    """
    (known,) = truth.mazes(6, 80, [700], DRIFTING)
    with patch.object(time, "perf_counter", time.process_time):
        solution = solve(known.trace, time_limit=1)
    assert solution.stopped == "time limit"
    assert truth.is_true(solution.maps[0], known)


def test_broad_beam_and_small_misfit_raise_confidence() -> None:
    (known,) = truth.mazes(3, 30, [701], DRIFTING)
    weighed = guessed(Search(known.trace)).weighed()
    assert weighed is not None
    assert weighed.searched
    assert not weighed.proven
    assert weighed.broken == pytest.approx(0.0, abs=0.01)
    assert weighed.confidence > 0.95
    assert weighed.verdict.endswith(", none doubtful. Not proven best.")
    nearer = replace(weighed, bound=0.885 * weighed.nats)
    assert nearer.verdict.endswith(" Not proven best: no map costs less than 88 % of it.")
    assert replace(nearer, searched=False).verdict.count("which are doubtful is unknown") == 1
    assert replace(nearer, bound=weighed.nats).verdict.endswith(" Proven best.")


def test_cheaper_map_that_breaks_axioms_lowers_confidence() -> None:
    """Travels lead around a ring without a turn, and a path is no circle."""
    ring = Trace.from_steps("abcdabcd", ["travel"] * 7, displacements=[(10, 0, math.pi / 2)] * 7)
    weighed = solve(ring, time_limit=5).weighed
    assert weighed is not None
    assert weighed.broken > 16
    assert weighed.confidence < 0.05
    assert "a map that breaks axioms costs" in weighed.sentence


def test_completion_refuses_an_action_that_leads_to_two_dstates() -> None:
    trace = Trace.from_steps("abab", ["travel", "around", "travel"])
    theory = settle(trace, Theory(boundary="none")).theory
    assert completed(trace, theory, [0, 1, 0, 2], [0, 1, 1], [0.0, 0.0, math.pi]) is None


@pytest.mark.slow
@pytest.mark.parametrize("seed", [203])
def test_beam_cost_with_floors_equals_the_cost_of_the_map(seed: int) -> None:
    """The headings err by degrees. So equations that stay linear would miss by many nats."""
    (known,) = floors.towers(2, 60, [seed])
    problem = settle(known.trace, Theory())
    beam = Beam(problem, Log(known.trace, problem.theory, problem.pairs), 1)
    maps = list(beam.maps())
    misfit = Misfit(problem)
    nats = [misfit.nats_of(m) for m in maps]
    assert nats[0] == pytest.approx(beam.hypotheses[0].nats, abs=0.1)


@pytest.mark.parametrize(
    ("stars", "facing", "fits"),
    [
        ("1000 0100", [0.0, math.pi / 2], True),
        ("1000 0100", [0.0, -math.pi / 2], False),
        ("1000 0100", [0.0, 0.0], False),
        ("1111 1111", [0.0, 0.0], False),
    ],
)
def test_stars_and_headings_at_a_place_fit(stars: str, facing: list[float], fits: bool) -> None:
    seen = [[int(k) for k in star] for star in stars.split()]
    trace = Trace.from_steps("ab", ["left"], stars=seen)
    theory = settle(trace, Theory(star="frame", boundary="none")).theory
    assert (completed(trace, theory, [0, 1], [0, 0], facing) is not None) == fits


def test_completion_refuses_a_circular_path() -> None:
    trace = Trace.from_steps("abca", ["travel", "travel", "travel"])
    theory = settle(trace, Theory(boundary="none", star="none")).theory
    assert completed(trace, theory, [0, 1, 2, 0], [0, 1, 2], [0.0] * 3) is None
    assert completed(trace, theory, [0, 1, 2, 3], [0, 1, 2, 3], [0.0] * 4) is not None


def test_beam_stops_at_once_if_two_steps_clash() -> None:
    """After the turn at step 1, the place has other openings."""
    cross, three = [0.0, 90.0, 180.0, 270.0], [0.0, 120.0, 240.0]
    go, left = (5.0, 0.0, 0.0), (0.0, 0.0, math.pi / 2)
    trace = Trace.from_steps(
        "aabb",
        ["travel", "left", "travel"],
        stars=[cross, cross, three, cross],
        displacements=[go, left, go],
    )
    theory = Theory.topological().replace(star="gateways")
    solution = solve(trace, theory)
    assert solution.status is Status.UNSATISFIABLE
    assert solution.effort.prefix == 0  # clingo was not given any prefix
    explanation = explain(trace, theory)
    assert explanation is not None
    assert (explanation.first, explanation.last) == (1, 2)
