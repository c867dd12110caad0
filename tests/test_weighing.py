"""Maps compared by their cost in nats: prices and misfit."""

from __future__ import annotations

import math

import pytest
from brute_force import Key, consistent_maps, key
from brute_misfit import LeastSquares
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import TOYS, theories, traces

from ssh_abduction import Theory, Trace, solve
from ssh_abduction.checker.checker import check
from ssh_abduction.data import TheoryError
from ssh_abduction.solver import Status

EQUAL = 1e-6


def cheapest(trace: Trace, theory: Theory) -> tuple[float, set[Key]]:
    """The least cost, and the maps that have it: of those with the same dstates and places, the
    ones with the fewest paths."""
    squares = LeastSquares(trace)
    found: dict[tuple[object, object], tuple[float, int, set[Key]]] = {}
    toys = [toy for toy in TOYS if toy.rules in theory.rules]
    for one, counts in consistent_maps(trace, theory):
        if not all(toy.allows(one) for toy in toys):
            continue
        labels, places, _ = one
        positions = tuple(-1 - i if place is None else place for i, place in enumerate(places))
        prices = zip(theory.prices, (counts.dstates, counts.places, counts.paths), strict=True)
        nats = sum(price * count for price, count in prices)
        nats += squares.misfit(labels, positions) / 2
        known = found.get((labels, places))
        if known is None or counts.paths < known[1]:
            known = found[labels, places] = nats, counts.paths, set()
        if counts.paths == known[1]:
            known[2].add(one)
    least = min((nats for nats, _, _ in found.values()), default=math.inf)
    return least, {one for nats, _, keys in found.values() if nats <= least + EQUAL for one in keys}


def agree(trace: Trace, theory: Theory) -> None:
    """The solver proves the least cost, and lists the maps that have it."""
    nats, expected = cheapest(trace, theory)
    solution = solve(trace, theory, max_maps=None, time_limit=100)
    assert {key(ssh_map) for ssh_map in solution.maps} == expected
    assert len(solution.maps) == len(expected)
    if not expected:
        assert solution.status is Status.UNSATISFIABLE
        return
    assert solution.status is Status.OPTIMAL
    assert solution.complete
    assert solution.weighed is not None
    assert solution.weighed.nats == pytest.approx(nats, abs=EQUAL)
    for ssh_map in solution.maps:
        assert check(trace, ssh_map, theory) == ()


def weighed(theory: Theory, prices: tuple[float, float, float]) -> Theory:
    """A theory that compares maps by cost. Excuses have no price in nats."""
    boundary = "strict" if theory.boundary == "defeasible" else theory.boundary
    return theory.replace(weigh="cost", prices=prices, prefer=("auto",), boundary=boundary)


PRICES = [(8.0, 8.0, 0.0), (1.0, 2.0, 0.5), (3.0, 0.0, 0.0)]


@settings(max_examples=8)
@given(st.data())
def test_the_cheapest_maps_are_those_of_plain_least_squares(data: st.DataObject) -> None:
    trace = data.draw(traces().filter(lambda trace: trace.has_displacements), label="trace")
    theory = data.draw(theories(trace, fixed=("displacement",)), label="theory")
    agree(trace, weighed(theory, data.draw(st.sampled_from(PRICES), label="prices")))


@pytest.mark.parametrize(
    "prices", [(-1, 8, 0), (math.nan, 8, 0), ("dear", 8, 0), (8, 8), 8, (0, 8, 0)]
)
def test_prices_are_three_numbers(prices: object) -> None:
    with pytest.raises(TheoryError, match=r"prices: expected .*, got"):
        Theory(prices=prices)  # type: ignore[arg-type]


def test_maps_are_counted_where_there_is_no_misfit_to_weigh() -> None:
    solution = solve(Trace.from_steps("aba", ["travel", "travel"]), Theory(weigh="cost"))
    assert solution.theory.weigh == "count"
    assert any("no displacements" in warning for warning in solution.warnings)
