"""Make the map in which steps share a dstate only if the axioms force them to.

>>> from ssh_abduction import Theory, Trace
>>> from ssh_abduction.solver.sources.symbolic.sketched import separate_map
>>> from ssh_abduction.theory.settle import settle
>>> trace = Trace.from_steps("abacd", ["around", "around", "around", "travel"])
>>> theory = settle(trace, Theory(star="none")).theory
>>> separate_map(trace, theory) is None  # the travel puts steps 1 and 3 on one path
True
>>> separate_map(trace.prefix(4), theory).dstate_at
(0, 1, 2, 3)

Two axioms force steps to share a dstate if places have no frames. By `deterministic`, the same
action leads from one dstate to one dstate. By `one_dstate_per_course`, a place has one dstate for
each direction of a path. A path may become known late: if a robot turns around several times, and
then travels, all these turns are on the path of the travel.

All travels lead to new places unless they repeat a link. So the places and paths make a tree, as in
`sketch.py`, and the axioms of order and sides hold. The claim needs axioms that are universal and
places without frames. The caller checks the map in any case.

Guess a map with faults: a step that contradicts the guess so far counts as a fault.

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
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

from ssh_abduction.checker.checker import violations
from ssh_abduction.data.groups import NodeClasses, numbered
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.step import QUARTERS
from ssh_abduction.data.trace import Action, Step, Trace
from ssh_abduction.runtime.clock import each_looking, look_at_clock
from ssh_abduction.solver.sources.metric.completing import completed
from ssh_abduction.solver.sources.symbolic.sketch import Sketch, sketches_of
from ssh_abduction.solver.steps.faults import with_faults
from ssh_abduction.solver.steps.log import observation
from ssh_abduction.theory.theory import Theory


def has_no_frames(theory: Theory) -> bool:
    """Whether maps have places, but these have no frames of numbered directions."""
    return theory.level == "topological" and theory.star not in ("frame", "gateways")


def separate_map(trace: Trace, theory: Theory) -> SSHMap | None:
    """Make a map in which steps share a dstate only if the axioms force them to.

    The caller has to check the map. Returns None if two steps that must share a dstate look
    different, or if a path would be a circle.
    """
    same = NodeClasses[int]()
    for i, j in theory.same:
        same.merge(i, j)
    while True:
        look_at_clock()
        _follow(same, trace)
        labels = numbered(map(same.of, range(len(trace))))
        if not _look_alike(labels, trace, theory):
            return None
        ssh_map = completed(trace, theory, labels, _places(labels, trace, theory), ())
        if ssh_map is None or not _join_courses(same, ssh_map):
            return ssh_map


def _follow(same: NodeClasses[int], trace: Trace) -> None:
    """Join steps to which the same action leads from one dstate."""
    grows = True
    while grows:
        grows, links = False, dict[tuple[int, str], int]()
        for t, action in enumerate(trace.actions):
            if not action.starts:
                there = links.setdefault((same.of(t), action.name), t + 1)
                grows = _joined(same, there, t + 1) or grows


def _join_courses(same: NodeClasses[int], ssh_map: SSHMap) -> bool:
    """Join steps at one place that are along one path in one direction. Return whether any were."""
    grows, along = False, dict[tuple[int | None, int, int | None], int]()
    for t, label in enumerate(ssh_map.dstate_at):
        s = ssh_map.dstates[label]
        if s.path is not None:
            first = along.setdefault((s.place, s.path, s.direction), t)
            grows = _joined(same, first, t) or grows
    return grows


def _joined(same: NodeClasses[int], i: int, j: int) -> bool:
    """Join two steps. Return whether they were apart."""
    were_apart = not same.are_one(i, j)
    same.merge(i, j)
    return were_apart


def _places(labels: Sequence[int], trace: Trace, theory: Theory) -> list[int]:
    """Number the place of each dstate: turns stay at their place, and so do asserted steps."""
    place = NodeClasses[int]()
    for i, j in theory.same_place:
        place.merge(labels[i], labels[j])
    for here, action, there in zip(labels, trace.actions, labels[1:], strict=False):
        if action.turn is not None and not action.unlinked:
            place.merge(here, there)
    return numbered(map(place.of, range(max(labels) + 1)))


def _look_alike(labels: Sequence[int], trace: Trace, theory: Theory) -> bool:
    """Whether the steps of each dstate have one view and star. An unknown view may be any view."""
    seen: dict[tuple[int, int], object] = {}
    return all(
        value is None or seen.setdefault((label, kind), value) == value
        for label, step in zip(labels, trace.steps, strict=True)
        for kind, value in enumerate(observation(step, theory))
    )


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
