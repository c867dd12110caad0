"""Solver and checker agree with the brute force on random tiny traces and theories."""

from __future__ import annotations

from unittest.mock import patch

import pytest
from brute_force import consistent_maps, key, minimal_maps
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import FOREIGN, TOYS, theories, traces
from turns import STEPWISE, stepwise

from ssh_abduction import solve
from ssh_abduction.checker.checker import check
from ssh_abduction.data.trace import Trace
from ssh_abduction.solution import Status
from ssh_abduction.solver.sources.exact import choosing, prefixes
from ssh_abduction.theory.fields import Count
from ssh_abduction.theory.theory import Theory

LIMIT = 100  # seconds: a search that does not end is a failure, not a hang


def agree(trace: Trace, theory: Theory) -> None:
    """The solver lists each minimal map once, with its costs, and the checker accepts it."""
    toys = [toy for toy in TOYS if toy.rules in theory.rules]
    counts, expected = minimal_maps(trace, theory, lambda key: all(toy.allows(key) for toy in toys))
    solution = solve(trace, theory, max_maps=None, time_limit=LIMIT)
    assert solution.complete
    listed = [key(ssh_map) for ssh_map in solution.maps]
    assert len(listed) == len(set(listed))
    assert set(listed) == expected
    for ssh_map in solution.maps:
        assert check(trace, ssh_map, theory) == ()
    if counts is None:
        assert solution.status is Status.UNSATISFIABLE
        assert solution.cost is None
        return
    assert solution.status is Status.OPTIMAL
    assert solution.cost is not None
    for name in theory.priorities:
        assert getattr(solution.cost, name) == getattr(counts, name)


@settings(max_examples=12)
@given(st.data())
def test_minimal_maps_equal_the_brute_force(data: st.DataObject) -> None:
    solver_agrees(data, data.draw(traces(closures=True), label="trace"))


def solver_agrees(data: st.DataObject, trace: Trace) -> None:
    """The solver and the brute force agree under any theory, with any first prefix and engine."""
    theory = data.draw(theories(trace), label="theory")
    # The traces are shorter than the solver's first prefix: a shorter one makes it replay and
    # extend.
    first_prefix = data.draw(st.sampled_from([1, 3, prefixes.FIRST_PREFIX]), label="first prefix")
    first_paths = data.draw(st.sampled_from([1, 2, prefixes.FIRST_PATHS]), label="first paths")
    few_steps = data.draw(st.sampled_from([0, choosing.FEW_STEPS]), label="few steps")
    seconds = data.draw(st.sampled_from([-1.0, STEPWISE]), label="seconds step by step")
    with (
        patch.multiple(prefixes, FIRST_PREFIX=first_prefix, FIRST_PATHS=first_paths),
        patch.object(choosing, "FEW_STEPS", few_steps),
        stepwise(seconds),
    ):
        agree(trace, theory)


@pytest.mark.parametrize(
    "prefer", [("places",), ("paths", "places"), ("excuses", "places"), ("places", "excuses")]
)
def test_excuses_are_counted_without_excusable_paths(
    prefer: tuple[Count, ...],
) -> None:
    """The maps 0, 0 and 0, 1 are both minimal if dstates are not counted."""
    trace = Trace.from_steps("aa", ["around"])
    agree(trace, Theory(boundary="defeasible", star="none", prefer=prefer))


@pytest.mark.parametrize("prefer", [(), ("excuses",)])
def test_excuses_are_minimised_without_excusable_paths(
    prefer: tuple[Count, ...],
) -> None:
    trace = Trace.from_steps("aaaaaaa", ["travel"] * 6)
    agree(trace, Theory(boundary="defeasible", next_place=True, star="none", prefer=prefer))


@settings(max_examples=8)
@given(st.data())
def test_checker_rejects_maps_outside_the_brute_force(data: st.DataObject) -> None:
    """The maps of one theory under the axioms of another.

    If the other axioms allow a map, its witnesses may have to change.
    """
    checker_rejects_foreign_maps(data, data.draw(traces(), label="trace"))


def checker_rejects_foreign_maps(data: st.DataObject, trace: Trace) -> None:
    theory = data.draw(theories(trace, fixed=FOREIGN), label="theory of the maps")
    other = data.draw(theories(trace, fixed=FOREIGN), label="theory to check them by")
    consistent = {found for found, _ in consistent_maps(trace, other)}
    for ssh_map in solve(trace, theory, max_maps=50, time_limit=LIMIT).maps:
        if key(ssh_map) not in consistent:
            assert check(trace, ssh_map, other)
