"""Try local changes of the best map: one visit at another place, or two places that are one.

A beam goes through the trace once and drops hypotheses, so it may miss a cheaper map that differs
little from the best one. Each visit is moved to each other place that its displacements do not
exclude. Its dstates become those of this place that face the same way and show the same, and what
an action leads to from both becomes one, too. The poses of the map without this visit at its place
say how far the visit is from the other places.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from itertools import groupby

import numpy as np

from ssh_abduction.data.groups import NodeClasses, numbered
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.runtime.clock import look_at_clock
from ssh_abduction.solver.costs.estimating import Course
from ssh_abduction.solver.costs.misfit import Misfit
from ssh_abduction.solver.sources.metric.completing import completed
from ssh_abduction.solver.steps.faults import with_faults
from ssh_abduction.theory.fields import ONE_WAY
from ssh_abduction.theory.settle import Problem


def improved(
    problem: Problem, misfit: Misfit, best: SSHMap, add: Callable[[SSHMap], float], within: float
) -> None:
    """Change a map, and then the cheapest map found, until no change is cheaper.

    `add` keeps a map if it obeys the axioms, and returns its cost in nats; infinite if it breaks
    them. Maps that cost at least `within` nats more than the best one are not tried.
    """
    tried: set[Course] = set()
    nats, cheaper = misfit.nats_of(best), True
    while cheaper:
        cheaper = False
        for dstates, places in _changes(problem, misfit, best):
            if (dstates, places) in tried:
                continue
            tried.add((dstates, places))
            look_at_clock()
            if misfit.nats_of_course(dstates, places) >= nats + within:
                continue
            of_dstate = [*dict(zip(dstates, places, strict=True)).values()]
            facing = misfit.poses(dstates, places).gaussian()[1][-len(of_dstate) :]
            found = completed(problem.trace, problem.theory, dstates, of_dstate, facing.tolist())
            if found is not None and problem.theory.misread:
                found = with_faults(found, problem.trace, problem.trace, problem.theory)
            if found is not None and (cost := add(found)) < nats:
                best, nats, cheaper = found, cost, True
                break


def _changes(problem: Problem, misfit: Misfit, ssh_map: SSHMap) -> Iterator[Course]:
    """Yield the dstates and places of changed maps, those of nearby places first."""
    labels = ssh_map.dstate_at
    at = [s.place if s.place is not None else s.id for s in ssh_map.dstates]
    steps = range(len(labels))
    visits = [[*of] for _, of in groupby(steps, key=lambda t: at[labels[t]])]
    found: list[tuple[float, Course]] = []
    for visit in visits:
        look_at_clock()
        new = {*visit}
        dstates = numbered((labels[t], t in new) for t in steps)
        places = numbered((at[labels[t]], t in new) for t in steps)
        found += _moves(problem, misfit, (tuple(dstates), tuple(places)), visit)
    for _, course in sorted(found, key=lambda pair: pair[0]):
        yield course


def _moves(
    problem: Problem, misfit: Misfit, course: Course, visit: Sequence[int]
) -> Iterator[tuple[float, Course]]:
    """Yield where a visit that is alone at its place may be instead, with half of the chi-square.

    A visit to a new place is one of these.
    """
    dstates, places = course
    yield 0.0, course
    of_dstate = [*dict(zip(dstates, places, strict=True)).values()]
    part, mean, covariance, _ = misfit.poses(dstates, places).gaussian()
    here, facing = places[visit[0]], mean[2 * len({*places}) :]
    first = {place: s for s, place in reversed([*enumerate(of_dstate)])}
    most = problem.prior.predicted(visit[0]) + problem.prior.place[visit[0]]
    for there, s in first.items():
        if there == here or part[s] != part[dstates[visit[0]]]:
            continue
        rows = np.array([2 * here, 2 * here + 1, 2 * there, 2 * there + 1])
        off = mean[rows[:2]] - mean[rows[2:]]
        spread = covariance[np.ix_(rows, rows)].reshape(2, 2, 2, 2)
        spread = spread[0, :, 0] + spread[1, :, 1] - spread[0, :, 1] - spread[1, :, 0]
        square = float(off @ np.linalg.pinv(spread + 1e-6 * np.identity(2)) @ off)
        if square / 2 < most:
            yield square / 2, _joined(problem, course, of_dstate, facing.tolist(), (here, there))


def _joined(
    problem: Problem,
    course: Course,
    of_dstate: Sequence[int],
    facing: Sequence[float],
    pair: tuple[int, int],
) -> Course:
    """Join two places, their dstates that face one way and show the same, and what follows."""
    dstates, places = course
    views: dict[int, object] = {}
    for s, view in zip(dstates, problem.trace.views, strict=True):
        views[s] = view if views.get(s) is None else views[s]
    here, there = ([s for s, p in enumerate(of_dstate) if p == place] for place in pair)
    alike = [
        (s, x)
        for s in here
        for x in there
        if abs(math.remainder(facing[s] - facing[x], math.tau)) < ONE_WAY
        and (problem.theory.misread or views[s] == views[x] or None in (views[s], views[x]))
    ]
    links = [
        (s, action.name, x)
        for s, action, x in zip(dstates, problem.trace.actions, dstates[1:], strict=False)
        if not action.starts
    ]
    merged, at = NodeClasses[int](), NodeClasses[int]()
    merged.merge_with_links(alike, links)
    at.merge(*pair)
    for s, place in enumerate(of_dstate):
        at.merge(of_dstate[merged.of(s)], place)
    return tuple(numbered(map(merged.of, dstates))), tuple(numbered(map(at.of, places)))
