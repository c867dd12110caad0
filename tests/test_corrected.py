"""Unknown actions, and maps with faults found by mending the trace, against the plain encodings and
the brute force."""

from __future__ import annotations

from unittest.mock import patch

from brute_force import key, minimal_maps
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import STARS

from ssh_abduction import Theory, Trace
from ssh_abduction.checker.checker import check
from ssh_abduction.data.trace import Action
from ssh_abduction.solver import Search, mending
from ssh_abduction.solver.sources.exact import choosing
from ssh_abduction.theory import Speedups
from ssh_abduction.theory.speedups import SPEEDUPS

PLAIN = Speedups.without(SPEEDUPS)


@st.composite
def broken_traces(draw: st.DrawFn, most_steps: int = 6) -> Trace:
    """Traces in which some actions slipped. Their names are unknown."""
    steps = draw(st.integers(2, most_steps))
    names = draw(
        st.lists(
            st.sampled_from(["travel", "travel", "right", "around"]),
            min_size=steps - 1,
            max_size=steps - 1,
        )
    )
    slipped = draw(st.sets(st.integers(0, steps - 2), min_size=1, max_size=2))
    actions = [Action.that_slipped(t) if t in slipped else name for t, name in enumerate(names)]
    seen = draw(st.lists(st.sampled_from("ab"), min_size=steps, max_size=steps))
    stars = draw(st.sampled_from([None, [STARS[0]] * steps, [(1, 1, 1, 1)] * steps]))
    return Trace.from_steps(seen, actions, stars=stars)


def maps_of(trace: Trace, theory: Theory, speedups: Speedups) -> set[object]:
    with patch.object(choosing, "FEW_STEPS", 0):
        found = Search(trace, theory, max_maps=None, speedups=speedups)
        maps = list(found)
    assert found.complete
    assert all(check(trace, ssh_map, theory) == () for ssh_map in maps)
    return {key(ssh_map) for ssh_map in maps}


@settings(max_examples=6)
@given(broken_traces(), st.sampled_from(["none", "strict"]), st.booleans())
def test_maps_of_traces_with_slipped_actions_equal_the_brute_force(
    trace: Trace, boundary: str, framed: bool
) -> None:
    theory = Theory(boundary=boundary, star="frame" if framed and trace.has_stars else "none")  # type: ignore[arg-type]
    _, expected = minimal_maps(trace, theory)
    assert maps_of(trace, theory, PLAIN) == set(expected)
    assert maps_of(trace, theory, Speedups()) == set(expected)


@settings(max_examples=6)
@given(st.data())
def test_maps_of_corrected_traces_equal_those_of_plain_encodings(data: st.DataObject) -> None:
    """If everything is proven, the maps are the same.

    Stars may be misread, and actions may slip.
    """
    trace = data.draw(small_traces())
    slipped = data.draw(st.sampled_from([0.0, 1.2]))
    theory = Theory(
        boundary="none",
        misread=data.draw(st.sampled_from([0.4, 1.5])),
        slipped=slipped,
        star="frame" if trace.has_stars else "none",
    )
    plain = Search(trace, theory, max_maps=None, speedups=PLAIN)
    expected = {(*key(ssh_map), ssh_map.faults) for ssh_map in plain}
    assert plain.complete
    with patch.object(choosing, "FEW_STEPS", 0), patch.object(mending, "MOST_CAUSAL", 500):
        mended = Search(trace, theory, max_maps=None)
        maps = list(mended)
    assert {(*key(ssh_map), ssh_map.faults) for ssh_map in maps} == expected
    assert mended.complete
    assert all(check(trace, ssh_map, theory) == () for ssh_map in maps)


@st.composite
def small_traces(draw: st.DrawFn) -> Trace:
    """Out and back along a corridor, with a view or a star that may be wrong."""
    steps = draw(st.integers(3, 6))
    actions = draw(
        st.lists(st.sampled_from(["travel", "around"]), min_size=steps - 1, max_size=steps - 1)
    )
    seen = draw(st.lists(st.sampled_from("ab"), min_size=steps, max_size=steps))
    if draw(st.booleans()):
        return Trace.from_steps(seen, actions)
    stars = draw(
        st.lists(
            st.sampled_from([(1, 0, 1, 0), (1, 0, 1, 0), (1, 1, 1, 0)]),
            min_size=steps,
            max_size=steps,
        )
    )
    return Trace.from_steps(seen, actions, stars=stars)
