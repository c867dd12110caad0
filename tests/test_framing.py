"""With star=pattern, maps in which places have frames are candidates."""

from __future__ import annotations

from unittest.mock import patch

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from instances import maze
from strategies import theories, traces
from turns import stepwise

from ssh_abduction import Theory, check, solve
from ssh_abduction.runtime.limits import StageTimeError, Watch
from ssh_abduction.solution import Status
from ssh_abduction.solver.sources.exact import choosing
from ssh_abduction.solver.sources.exact.labels_first import maps_with_frames
from ssh_abduction.solver.sources.exact.prefixes import Prefixes
from ssh_abduction.theory import Speedups
from ssh_abduction.theory.settle import settle
from ssh_abduction.theory.speedups import SPEEDUPS, row

PATTERN = Theory(star="pattern")


@settings(max_examples=5)
@given(st.data())
def test_framed_maps_satisfy_the_theory(data: st.DataObject) -> None:
    trace = data.draw(traces(max_steps=10).filter(lambda t: t.has_stars), label="trace")
    theory = data.draw(theories(trace), label="theory")
    if theory.level != "topological" or theory.has_faults:
        return
    problem = settle(trace, theory.replace(star="pattern"))
    if not row("framing").holds_for(problem.theory):
        return
    watch = Watch()
    watch.start()
    costs = []
    for ssh_map in maps_with_frames(problem, watch, Speedups()):
        assert check(trace, ssh_map, problem.theory) == ()
        costs.append(len(ssh_map.dstates))
    assert costs == sorted(costs, reverse=True)


@settings(max_examples=5)
@given(st.data())
def test_framing_changes_no_answer(data: st.DataObject) -> None:
    trace = data.draw(traces(max_steps=6).filter(lambda t: t.has_stars), label="trace")
    expected = solve(trace, PATTERN, max_maps=None, speedups=Speedups.without(SPEEDUPS))
    with patch.object(choosing, "FEW_STEPS", 0), stepwise(-1.0):
        found = solve(trace, PATTERN, max_maps=None)
    assert (found.status, set(found.maps)) == (expected.status, set(expected.maps))


def test_framing_gives_a_small_map_before_the_proof() -> None:
    """The robot was in fewer than 40 dstates; a sketch without frames has hundreds."""
    walk = maze(3, 3, steps=200, seed=0, stars=True)
    with patch.object(Prefixes, "find_minimum", side_effect=[StageTimeError, KeyboardInterrupt]):
        solution = solve(walk.trace, PATTERN)
    assert (solution.status, solution.stopped) == (Status.FEASIBLE, "interrupted")
    assert solution.cost
    assert solution.cost.dstates <= len(set(walk.truth))
    assert check(walk.trace, solution.maps[0], solution.theory) == ()


def test_framing_is_on_only_for_star_patterns() -> None:
    trace = maze(2, 2, steps=20, seed=0, stars=True).trace
    assert row("framing").holds_for(settle(trace, PATTERN).theory)
    for theory in (Theory(), Theory(star="none"), Theory.causal()):
        assert not row("framing").holds_for(settle(trace, theory).theory)


@pytest.mark.parametrize("name", ["frame", "gateways", "alike"])
def test_framing_is_off_for_other_stars(name: str) -> None:
    assert not row("framing").holds_for(Theory(star=name))  # type: ignore[arg-type]
