"""Estimate rivals of the best map, and a lower bound on the number of places.

The search for maps of least cost (`weighing.py`) finds few rivals of a long trace. So this module
adds estimated rivals. They are like the best map, but some visits to one of its places are visits
to a new place. They fit the displacements, and may break axioms.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import replace
from itertools import chain
from typing import TYPE_CHECKING, TypeAlias

from ssh_abduction.data.drives import Drive, drives_of, step_name
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.runtime.clock import heeding, look_at_clock
from ssh_abduction.solver.asp.limits import LimitError, Watch
from ssh_abduction.solver.guesses.completing import completed
from ssh_abduction.solver.solution.weighed import CHANCE, Rival
from ssh_abduction.solver.steps.chart import numbered
from ssh_abduction.solver.values import Cost, nats_of
from ssh_abduction.theory.evidence.displacement import jumped
from ssh_abduction.theory.settle import Problem

if TYPE_CHECKING:
    from ssh_abduction.solver.costs.misfit import Misfit  # loads numpy

# The dstate and the place of each step, numbered by first visit.
Course: TypeAlias = tuple[tuple[int, ...], tuple[int, ...]]
# Computes the cost in nats of a map with these dstates and places.
CostOf: TypeAlias = Callable[[Sequence[int], Sequence[int]], float]
# Leave out rivals that cost CERTAIN nats more than the best map. Even a million of them together
# have a probability of only 0.005.
CERTAIN = 19.0
# Estimating rivals takes at most this many seconds.
ESTIMATING = 0.5


def rivals_of(
    problem: Problem, misfit: Misfit, best: SSHMap, seconds: float, kept_steps: int = 0
) -> Iterator[Rival]:
    """Yield estimated rivals that cost little more than the best map, each once.

    `seconds` is the time that this may take. The first `kept_steps` steps keep their dstates and
    places. `estimated` says what the rivals are. Drives that closures connect to others do not
    overlap by chance. They stay connected.
    """
    dstate, place, _ = problem.theory.prices
    rival = rival_of(best, misfit.nats_of(best))
    kept_labels = rival.dstates[:kept_steps], rival.places[:kept_steps]
    kept = nats_of(replace(Cost.of(best), dstates=0, places=0), problem.theory)
    drives = drives_of(problem.trace)
    free = [drive for i, drive in enumerate(drives) if not problem.overlap.is_tied(i)]

    def cost_of(dstates: Sequence[int], places: Sequence[int]) -> float:
        if (dstates[:kept_steps], places[:kept_steps]) != kept_labels:
            return math.inf
        nats: float = kept + misfit.nats_of_course(dstates, places or dstates, jumped(best))
        return nats + dstate * len(set(dstates)) + place * len(set(places))

    return estimated(rival, misfit.visit, free, cost_of, seconds)


def doubt_of(problem: Problem, best: SSHMap) -> str | None:
    """Say why the costs of maps cannot be trusted; None if there is no such reason.

    Two places cannot be at one position. If two drives have such places, they overlap by chance.
    """
    overlap = problem.overlap
    if not overlap.near or not overlap.of_map(best):
        return None
    from ssh_abduction.solver.geometry.fit import Poses  # loads scipy

    places = [dstate.place for dstate in best.dstates]
    at = Poses.of_map(problem.trace, best).placed()[1].tolist()
    for *steps, _ in overlap.crowded(dict(enumerate(best.dstate_at)), places, at):
        names = (step_name(drives_of(problem.trace), step) for step in steps)
        return f"{' and '.join(names)} are at one position, but at two places"
    return None


def maps_apart(
    problem: Problem, misfit: Misfit, best: SSHMap, pair: tuple[int, int], seconds: float
) -> Iterator[SSHMap]:
    """Yield maps like `best` in which two steps are different dstates, the cheapest first.

    They are estimated rivals, so they may break axioms. `seconds` is the time that estimating them
    may take.
    """
    at = [best.dstates[label] for label in best.dstate_at]
    rivals = rivals_of(problem, misfit, best, seconds)
    apart = [rival for rival in rivals if len({rival.dstates[step] for step in pair}) > 1]
    for rival in sorted(apart, key=lambda rival: rival.nats):
        like = dict(zip(rival.dstates, at, strict=True))
        place = dict(zip(rival.dstates, rival.places or rival.dstates, strict=True))
        places = [place[label] for label in range(len(place))]
        facing = [-math.pi / 2 * (like[label].heading or 0) for label in range(len(like))]
        found = completed(problem.trace, problem.theory, rival.dstates, places, facing)
        if found is not None:
            yield found


def estimated(
    best: Rival, visit: Sequence[int], drives: Sequence[Drive], cost_of: CostOf, seconds: float
) -> Iterator[Rival]:
    """Yield rivals that cost little more than the best map, each once.

    In each rival, some visits to a place of the best map are visits to a new place instead: a
    single visit, or a visit and all later ones. Or one of `drives` shares no dstate and no place
    with the others. `visit` has, for each step, the first step of its visit. `seconds` is the time
    that this may take.
    """
    watch = Watch().part(seconds)
    tried: set[Course] = {(best.dstates, best.places)}
    apart = ((_apart(best, drive), CHANCE * CERTAIN) for drive in drives)
    for course, most in chain(apart, ((moved, CERTAIN) for moved in _all_moved(best, visit))):
        if course in tried:
            continue
        tried.add(course)
        try:
            with heeding(watch.check):
                look_at_clock()
                nats = cost_of(*course)
        except LimitError:
            return
        if nats < best.nats + most:
            yield Rival(nats, *course, True, best.faults)


def _apart(best: Rival, drive: Drive) -> Course:
    """Return the dstates and places of a map after a drive gets dstates and places of its own."""
    more = len(best.dstates)
    dstates, places = (
        tuple(numbered(name + more * (drive.first <= t < drive.stop) for t, name in enumerate(of)))
        for of in (best.dstates, best.places)
    )
    return dstates, places


def _all_moved(best: Rival, visit: Sequence[int]) -> Iterator[Course]:
    """Yield the dstates and places of each map in which some visits to a place get a new place."""
    at = best.places or best.dstates
    visits: dict[int, list[int]] = {}  # the first steps of the visits to each place
    for step, begin in enumerate(_begins(at, visit)):
        if begin == step:
            visits.setdefault(at[step], []).append(step)
    for name, begins in visits.items():
        singly = [{begin} for begin in begins[1:]]
        from_then_on = [set(begins[i:]) for i in range(1, len(begins) - 1)]
        for moved in (*singly, *from_then_on) if len(begins) > 1 else ():
            yield _moved(best, visit, name, moved)


def _moved(best: Rival, visit: Sequence[int], place: int, moved: Collection[int]) -> Course:
    """Return the dstates and places of a map after some visits to a place get a new place."""
    at = best.places or best.dstates
    begins = _begins(at, visit)
    new = [name == place and begin in moved for name, begin in zip(at, begins, strict=True)]
    more = len(at)
    dstates = [name + more * is_new for name, is_new in zip(best.dstates, new, strict=True)]
    places = [name + more * is_new for name, is_new in zip(best.places, new, strict=False)]
    return tuple(numbered(dstates)), tuple(numbered(places))


def _begins(at: Sequence[int], visit: Sequence[int]) -> list[int]:
    """For each step, find the first step of its visit. A visit also begins where the place changes.

    `at` has the place of each step; without places, the dstate. `visit` has the first step of each
    step's visit, as the trace alone divides the steps into visits.
    """
    begins: list[int] = []
    for step, name in enumerate(at):
        is_first = not step or at[step - 1] != name or visit[step] == step
        begins.append(step if is_first else begins[-1])
    return begins


def dstates_and_places(ssh_map: SSHMap) -> Course:
    """Return the dstate and the place of each step, numbered by first visit."""
    places = [ssh_map.dstates[label].place for label in ssh_map.dstate_at]
    return tuple(numbered(ssh_map.dstate_at)), tuple(numbered(places))


def rival_of(ssh_map: SSHMap, nats: float) -> Rival:
    """Make a rival of a map and its cost in nats."""
    dstates, places = dstates_and_places(ssh_map)
    faults = tuple((fault.kind, fault.step) for fault in ssh_map.faults)
    return Rival(nats, dstates, places if ssh_map.places else (), faults=faults)


def least_places(problem: Problem) -> int:
    """Return a lower bound on the places: the size of a set of steps at different places."""
    if problem.theory.level == "causal":
        return 0
    import numpy as np

    from ssh_abduction.solver.steps.apart import large_clique

    elsewhere = problem.pairs.elsewhere
    steps = sorted({0, *elsewhere, *(i for others in elsewhere.values() for i in others)})
    number = {step: i for i, step in enumerate(steps)}
    apart = np.zeros((len(steps), len(steps)), dtype=bool)
    for j, others in elsewhere.items():
        for i in others:
            apart[number[i], number[j]] = apart[number[j], number[i]] = True
    return len(large_clique(apart))
