"""Dstates first, then places and paths, where places have frames: the same maps as the plain encoding of the axioms lists."""

from __future__ import annotations

from unittest.mock import patch

from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import STARS

from ssh_abduction import Search, Speedups, Theory, Trace, solve, solver
from ssh_abduction.chart import QUARTERS
from ssh_abduction.checker import check
from ssh_abduction.framed import FramedEngine
from ssh_abduction.speedups import SPEEDUPS

PLAIN = Speedups.without(SPEEDUPS)


@st.composite
def framed_traces(draw: st.DrawFn, most_steps: int = 9) -> Trace:
    """Walks on a torus of few cells with any stars, so that views mislead; and stars that fit no frame."""
    steps = draw(st.integers(1, most_steps))
    few = draw(st.sampled_from([["travel", "right"], ["travel", "right", "left", "around"], ["travel", "travel", "right", "around"]]))
    actions = draw(st.lists(st.sampled_from(few), min_size=steps - 1, max_size=steps - 1))
    width, height = draw(st.integers(1, 3)), draw(st.integers(1, 3))
    star_of = draw(st.lists(st.sampled_from(STARS), min_size=width * height, max_size=width * height))
    views = draw(st.sampled_from(["a", "ab"]))
    x = y = heading = 0
    seen, stars = [], []
    for action in ["", *actions]:
        if action == "travel":
            x, y = (x + (0, 1, 0, -1)[heading]) % width, (y + (1, 0, -1, 0)[heading]) % height
        elif action:
            heading = (heading + QUARTERS[action]) % 4
        star = star_of[x + width * y]
        stars.append(star[heading:] + star[:heading])
        seen.append(views[(x + y + heading) % len(views)])
    if draw(st.integers(0, 4)) == 0:
        stars[draw(st.integers(0, steps - 1))] = (1, 1, 0, 1)
    return Trace.from_steps(seen, actions, stars=stars)


@st.composite
def framed_theories(draw: st.DrawFn) -> Theory:
    """All that the engine takes."""
    rest = draw(st.sampled_from([(), ("paths",), ("paths", "places"), ("places", "paths")]))
    return Theory(
        star="frame",
        boundary=draw(st.sampled_from(["strict", "none"])),
        symmetric_sides=draw(st.booleans()),
        prefer=("dstates", *rest),
    )


@settings(max_examples=250, deadline=None, derandomize=True)
@given(framed_traces(), framed_theories())
def test_lists_the_maps_of_the_plain_encoding(trace: Trace, theory: Theory) -> None:
    expected = solve(trace, theory, maps=0, speedups=PLAIN)
    with patch.object(solver, "FEW_STEPS", 0):
        search = Search(trace, theory, maps=0)
    maps = tuple(search)
    found = search.solution(maps)
    assert isinstance(search._engine, FramedEngine)
    assert found.status is expected.status
    assert set(maps) == set(expected.maps)
    assert len(set(maps)) == len(maps)
    assert found.complete
    if found.cost and expected.cost:
        assert [getattr(found.cost, name) for name in theory.prefer] == [getattr(expected.cost, name) for name in theory.prefer]
    for ssh_map in maps[:3]:
        assert check(trace, ssh_map, theory) == ()
