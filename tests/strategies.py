"""Random tiny traces, and random theories that suit them, for hypothesis."""

from __future__ import annotations

from typing import Any

from hypothesis import strategies as st

from ssh_abduction.theory.theory import COUNTS, Count, Theory
from ssh_abduction.trace import STANDARD_ACTIONS, Action, Trace

ACTIONS = (*STANDARD_ACTIONS.values(), Action("creep", "travel"), Action("veer", "turn", "right"))
# Few openings, so that stars often agree: all alike, a straight street, a corner, a dead end, a tee.
STARS = ((1, 1, 1, 1), (1, 0, 1, 0), (1, 1, 0, 0), (1, 0, 0, 0), (1, 1, 1, 0))


@st.composite
def traces(draw: st.DrawFn, max_steps: int = 7) -> Trace:
    """One to `max_steps` observations of two or three views, any actions in between, with or without stars."""
    steps = draw(st.integers(1, max_steps) | st.just(max_steps))
    views = draw(st.sampled_from(["ab", "abc"]))
    seen = draw(st.lists(st.sampled_from(views), min_size=steps, max_size=steps))
    few = draw(st.lists(st.sampled_from(ACTIONS), min_size=1, max_size=4, unique_by=lambda a: a.name))  # few are repeated more often
    actions = draw(st.lists(st.sampled_from(few), min_size=steps - 1, max_size=steps - 1))
    stars = None
    if draw(st.booleans()):
        patterns = draw(st.lists(st.sampled_from(STARS), min_size=1, max_size=2))
        rotations = [star[k:] + star[:k] for star in patterns for k in range(4)]
        stars = draw(st.lists(st.sampled_from(rotations), min_size=steps, max_size=steps))
    return Trace.from_steps(seen, actions, stars=stars)


@st.composite
def theories(draw: st.DrawFn, trace: Trace) -> Theory:
    """Any choice of axioms and preference that a theory of this trace may have. Without a preference every consistent map is minimal."""
    choices: dict[str, Any] = {
        "symmetric_sides": draw(st.booleans()),
        "path_order": draw(st.sampled_from(["partial", "total"])),
        "next_place": draw(st.booleans()),
        "all_on_paths": draw(st.booleans()),
    }
    if draw(st.integers(0, 9)) == 9:
        prefer: tuple[Count, ...] = draw(st.sampled_from([("dstates",), ()]))
        return Theory(level="causal", boundary="none", star="none", prefer=prefer, **choices)
    boundary = draw(st.sampled_from(["none", "strict", "defeasible"]))
    counts = [name for name in COUNTS if name != "excuses" or boundary == "defeasible"]
    order = draw(st.permutations(counts))
    return Theory(
        boundary=boundary,
        star=draw(st.sampled_from(["auto", "none", "pattern", "frame"] if trace.has_stars else ["auto", "none"])),
        prefer=tuple(order[: draw(st.integers(0, len(order)))]),
        **choices,
    )
