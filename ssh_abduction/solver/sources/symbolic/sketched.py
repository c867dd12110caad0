"""Guess a map with faults: a step that contradicts the guess so far counts as a fault.

The map is a *sketch*: it is made without a search.

>>> from ssh_abduction import Theory, Trace
>>> from ssh_abduction.solver.sources.symbolic.sketched import mended_sketch
>>> from ssh_abduction.theory.settle import settle
>>> trace = Trace.from_steps("abcb", ["travel", "around", "around"])
>>> theory = settle(trace, Theory(slipped=1.0, boundary="none")).theory
>>> mended_sketch(trace, theory).map.dstate_at
(0, 1, 2, 1)
>>> wrong = mended_sketch(trace.with_views("abcd"), theory).map
>>> [(fault.step, fault.kind) for fault in wrong.faults]
[(2, 'slipped')]

After each fault the sketch is made again from the first step. It often has more faults than
necessary.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

from ssh_abduction.checker.checker import violations
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.step import QUARTERS
from ssh_abduction.data.trace import Action, Step, Trace
from ssh_abduction.runtime.clock import each_looking
from ssh_abduction.solver.sources.symbolic.sketch import Sketch, sketches_of
from ssh_abduction.solver.steps.faults import with_faults
from ssh_abduction.theory.theory import Theory


class MendedSketch(NamedTuple):
    """A map that was made without a search, and the trace with its faults corrected."""

    map: SSHMap
    trace: Trace


def mended_sketch(trace: Trace, theory: Theory) -> MendedSketch | None:
    """Make a map in which most steps are new dstates, with the faults that it needs.

    All views of the trace are known. Returns None if a step contradicts the sketch, and the theory
    allows no fault that mends it. The map may break axioms, so the caller has to check it.
    """
    mended = trace
    while True:
        sketch = sketches_of(mended.steps[0], theory)[-1]
        wrong = first_contradiction(sketch, mended)
        if wrong is not None:
            better = _mended(trace, mended, sketch, theory)
        else:
            ssh_map = with_faults(sketch.map(), trace, mended, theory)
            better = _without_jump(mended, ssh_map, trace, theory) if theory.jumped else None
            if better is None:
                return MendedSketch(ssh_map, mended)
        if better is None:
            return None
        mended = better


def first_contradiction(sketch: Sketch, trace: Trace) -> int | None:
    """Extend a map to the end of a trace, or return the step that contradicts it."""
    done = len(sketch.labels)
    later = each_looking(zip(trace.actions[done - 1 :], trace.steps[done:], strict=True))
    reaches_end = all(sketch.extend(action, step) for action, step in later)
    return None if reaches_end else len(sketch.labels)


def _mended(trace: Trace, mended: Trace, sketch: Sketch, theory: Theory) -> Trace | None:
    """Correct the step that contradicts a map: its view and star, or else the action before it."""
    t, steps = len(sketch.labels), list(mended.steps)
    action = mended.actions[t - 1]
    right = _right(mended, sketch, theory) if theory.misread else None
    if right is not None and steps[t] == trace.steps[t] != right:
        steps[t] = right
    elif theory.slipped and not action.unlinked:
        steps[t] = replace(trace.steps[t], action=steps[t].action)
        steps[t - 1] = replace(steps[t - 1], action=Action.that_slipped(t - 1))
    else:
        return None
    return replace(mended, steps=tuple(steps))


def _right(trace: Trace, sketch: Sketch, theory: Theory) -> Step | None:
    """Return the next step with the view and star that a map predicts; None if unknown."""
    t, action = len(sketch.labels), trace.actions[len(sketch.labels) - 1]
    there = sketch.leads_to(action)
    if there in sketch.labels:
        known = trace.steps[sketch.labels.index(there)]
        return replace(trace.steps[t], view=known.view, star=known.star)
    if action.turn is None or theory.star not in ("pattern", "frame"):
        return None
    seen, by = trace.steps[t - 1].openings or (), QUARTERS[action.turn]
    return replace(trace.steps[t], star=tuple(map(int, (*seen[by:], *seen[:by]))))


def _without_jump(mended: Trace, ssh_map: SSHMap, trace: Trace, theory: Theory) -> Trace | None:
    """Drop the longest displacement in the first loop that a map contradicts, if any."""
    refused = (v for v in violations(trace, ssh_map, theory) if v.axiom == "one_pose")
    found = next(refused, None)
    if found is None:
        return None
    steps = range(min(found.steps) + 1, max(found.steps) + 1)
    moved = {t: math.hypot(*d[:2]) for t in steps if (d := mended.steps[t].displacement)}
    if not moved:
        return None
    return mended.without_displacements_at([max(moved, key=moved.__getitem__)])
