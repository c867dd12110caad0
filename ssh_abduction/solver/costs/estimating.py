"""Estimate rivals of the best map, and a lower bound on the number of places.

The search for maps of least cost (`weighing.py`) finds few rivals of a long trace. So this module
adds estimated rivals. They are like the best map, but some visits to one of its places are visits
to a new place. They fit the displacements, and may break axioms. In a causal map, the visits that
one action leads to from one dstate stay together, because actions are deterministic.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import chain, combinations
from typing import TYPE_CHECKING, TypeAlias

from ssh_abduction.data.drives import Drive, drive_of_steps, drives_of
from ssh_abduction.data.groups import NodeClasses, gathered, indices_of, numbered
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.runtime.clock import heeding, look_at_clock
from ssh_abduction.runtime.limits import LimitError, Watch
from ssh_abduction.solution.values import Cost
from ssh_abduction.solution.weighed import Rival
from ssh_abduction.solver.sources.metric.completing import completed
from ssh_abduction.solver.steps.faults import with_faults
from ssh_abduction.theory.evidence.displacement import jumped
from ssh_abduction.theory.fields import FAULT, MISREAD, ONE_WAY
from ssh_abduction.theory.pairs import pairs_in
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


def rivals_of(
    problem: Problem, misfit: Misfit, best: SSHMap, seconds: float, kept_steps: int = 0
) -> Iterator[Rival]:
    """Yield estimated rivals that cost little more than the best map, each once.

    `seconds` is the time that this may take. The first `kept_steps` steps keep their dstates and
    places. `estimated` says what the rivals are. Steps that the user says are at one dstate or
    place stay so.
    """
    theory = problem.theory
    same, same_place = (theory.same, theory.same_place) if "asserted" in theory.axioms else ((), ())
    rival = rival_of(best, misfit.nats_of(best))
    kept_labels = rival.dstates[:kept_steps], rival.places[:kept_steps]
    kept, drives = FAULT * Cost.of(best).faults, drives_of(problem.trace)

    def cost_of(dstates: Sequence[int], places: Sequence[int]) -> float:
        if (
            (dstates[:kept_steps], places[:kept_steps]) != kept_labels
            or any(dstates[i] != dstates[j] for i, j in same)
            or any(places[i] != places[j] for i, j in same_place)
        ):
            return math.inf
        return kept + misfit.nats_of_course(dstates, places or dstates, jumped(best))

    # For each step, the first step of its visit. Where the place changes, a visit begins, too. In a
    # causal map, the steps to which one action leads from one dstate are one visit.
    begins = [0]
    first: dict[tuple[int, str], int] = {}
    for t, action in enumerate(problem.trace.actions, 1):
        if rival.places:
            stays = rival.places[t - 1] == rival.places[t] and misfit.visit[t] != t
            begins.append(begins[-1] if stays else t)
        else:
            before = rival.dstates[t - 1], action.name
            begins.append(t if action.starts else first.setdefault(before, t))
    return estimated(rival, begins, drives, cost_of, seconds)


def rivals_with_misread_views(
    problem: Problem, misfit: Misfit, best: SSHMap, seconds: float
) -> list[Rival]:
    """List rivals in which some views are misread, although the theory forbids that.

    Two dstates of one place that face one way are a sign of a misread view: in a rival, they are
    one. One rival joins all such dstates, and one for each pair joins only this pair. A misread
    view costs MISREAD nats, and those of what it shows. `seconds` is the time that this may take.
    """
    found: list[Rival] = []
    if problem.theory.misread or not best.places:
        return found
    from ssh_abduction.solver.geometry.fit import fit  # loads scipy

    trace, wrong, known = problem.trace, jumped(best), rival_of(best, 0.0)
    with suppress(LimitError), heeding(Watch().part(seconds).check):
        poses = fit(trace.without_displacements_at(wrong), best).poses
        pairs = [
            (s.id, x.id)
            for s, x in combinations(best.dstates, 2)
            if s.place == x.place
            and None not in (s.view, x.view)
            and s.view != x.view
            and abs(math.remainder(poses[s.id].heading - poses[x.id].heading, math.tau)) < ONE_WAY
        ]
        for some in ([pairs] if pairs else []) + [[pair] for pair in pairs if len(pairs) > 1]:
            dstates = _joined(best, some)
            if len({*zip(dstates, known.places, strict=True)}) > len({*dstates}):
                continue  # a dstate would be at two places
            shown = [*zip(dstates, trace.views, strict=True)]
            views = gathered((s, view) for s, view in shown if view is not None)
            right = {s: Counter(seen).most_common(1)[0][0] for s, seen in views.items()}
            misread = [t for t, (s, view) in enumerate(shown) if view not in (None, right.get(s))]
            nats = misfit.nats_of_course(dstates, known.places, wrong)
            # A misread view may be any view, as probable as at a new dstate.
            nats += MISREAD * len(misread) + float(problem.prior.seen[misread, 0].sum())
            nats += FAULT * Cost.of(best).faults
            faults = (*known.faults, *(("misread", t) for t in misread))
            found.append(Rival(nats, dstates, known.places, True, faults))
    return found


def crowded(problem: Problem, misfit: Misfit, rivals: Sequence[Rival]) -> tuple[Rival, ...]:
    """Make rivals less probable that have more near places, or dstates of a place, than the best.

    The cost takes poses to be independent, but the places of most buildings keep apart. How well
    they do is learnt from the best map: the sum of its nearness as a share of the sum to expect.
    The places of a log have a size, and floors lie above each other. There, nothing is changed.
    """
    from ssh_abduction.theory.prior import spreads_of  # loads numpy

    theory, best = problem.theory, rivals[0]
    if not best.places or theory.lifts or theory.jumped or spreads_of(problem.trace).any():
        return tuple(rivals)
    near = [misfit.nearness(rival.dstates, rival.places) for rival in rivals]
    less = [(some.sum() + 1) / (expected + 1) - 1 for some, expected in near[0]]
    nats = [
        -sum(
            math.log1p(k * x) for (some, _), x in zip(of, less, strict=True) for k in some.tolist()
        )
        for of in near
    ]
    return tuple(replace(r, crowded=float(x - nats[0])) for r, x in zip(rivals, nats, strict=True))


def _joined(ssh_map: SSHMap, pairs: Iterable[tuple[int, int]]) -> tuple[int, ...]:
    """Join pairs of dstates, and what one action leads to from both. Return that of each step."""
    merged = NodeClasses[int]()
    merged.merge_with_links(pairs, ssh_map.links)
    return tuple(numbered(map(merged.of, ssh_map.dstate_at)))


def may_join_more(problem: Problem, rivals: Sequence[Rival]) -> bool:
    """Whether the first rival keeps drives apart that may share dstates, and no other joins more.

    Without places, drives share no dstate if all their views or stars differ.
    """
    of_drive = drive_of_steps(drives_of(problem.trace))
    group, *others = (groups_of_drives(rival.at, of_drive) for rival in rivals)
    fewest = min((len({*other}) for other in others), default=math.inf)
    if len({*group}) == 1 or fewest < len({*group}):
        return False
    theory = problem.theory
    if theory.level != "causal" or theory.misread or theory.unknown_views:
        return True
    apart = problem.pairs.apart
    alike = indices_of(problem.trace.views).values()
    pairs = chain.from_iterable(combinations(steps, 2) for steps in alike)
    return any(group[i] != group[j] and i not in apart.get(j, ()) for i, j in pairs)


def maps_apart(
    problem: Problem, misfit: Misfit, best: SSHMap, pair: tuple[int, int], seconds: float
) -> Iterator[SSHMap]:
    """Yield maps like `best` in which two steps are different dstates, the cheapest first.

    They are estimated rivals, so they may break axioms. `seconds` is the time that estimating them
    may take.
    """
    rivals = rivals_of(problem, misfit, best, seconds)
    apart = [rival for rival in rivals if len({rival.dstates[step] for step in pair}) > 1]
    for rival in sorted(apart, key=lambda rival: rival.nats):
        if (found := course_completed(problem, misfit, rival.dstates, rival.at)) is not None:
            yield found


def course_completed(
    problem: Problem, misfit: Misfit, dstates: Sequence[int], places: Sequence[int]
) -> SSHMap | None:
    """Make a map of the dstate and place of each step; None if no axioms allow it."""
    of_dstate = [*dict(zip(dstates, places, strict=True)).values()]
    facing = misfit.poses(dstates, places).gaussian()[1][-len(of_dstate) :]
    found = completed(problem.trace, problem.theory, dstates, of_dstate, facing.tolist())
    if found is not None and problem.theory.misread:
        found = with_faults(found, problem.trace, problem.trace, problem.theory)
    return found


def estimated(
    best: Rival, begins: Sequence[int], drives: Sequence[Drive], cost_of: CostOf, seconds: float
) -> Iterator[Rival]:
    """Yield rivals that cost little more than the best map, each once.

    In each rival, some visits to a place of the best map are visits to a new place instead: a
    single visit, or a visit and all later ones. Or one of `drives` shares no dstate and no place
    with the others. `begins` has, for each step, the first step of its visit. Steps with the same
    one stay together. `seconds` is the time that this may take.
    """
    watch = Watch().part(seconds)
    tried: set[Course] = {(best.dstates, best.places)}
    for moved in _moves(best, begins, drives):
        dstates, places = (zip(of, moved, strict=False) for of in (best.dstates, best.places))
        course = tuple(numbered(dstates)), tuple(numbered(places))
        if course in tried:
            continue
        tried.add(course)
        try:
            with heeding(watch.check):
                look_at_clock()
                nats = cost_of(*course)
        except LimitError:
            return
        if nats < best.nats + CERTAIN:
            yield Rival(nats, *course, True, best.faults)


def _moves(best: Rival, begins: Sequence[int], drives: Sequence[Drive]) -> Iterator[list[bool]]:
    """Yield for each rival which steps get a new place."""
    for drive in drives:
        yield [drive.first <= t < drive.stop for t in range(len(begins))]
    visits = gathered((best.at[step], step) for step, begin in enumerate(begins) if begin == step)
    for firsts in visits.values():
        singly = [{begin} for begin in firsts[1:]]
        from_then_on = [set(firsts[i:]) for i in range(1, len(firsts) - 1)]
        for moved in (*singly, *from_then_on):
            yield [begin in moved for begin in begins]


def moved_visits(problem: Problem, misfit: Misfit, best: SSHMap) -> Iterator[Course]:
    """Yield courses like that of a map, but with one visit at another place near its own.

    The steps of this visit are at new dstates. So are the steps before it at which an action would
    lead from one dstate to two.
    """
    dstates, places = dstates_and_places(best)
    steps = gathered((begin, t) for t, begin in enumerate(misfit.visit))
    visits = gathered((places[begin], begin) for begin in steps)
    actions = [action.name for action in problem.trace.actions]
    for here, there in misfit.near_places(dstates, places):
        for begin in visits[here]:
            at, names, waiting = [*places], [*dstates], [*steps[begin]]
            for t in steps[begin]:
                at[t] = there
            while waiting:
                t = waiting.pop()
                names[t] = len(names) + t
                links = [*zip(names, actions, strict=False)]
                if t and (names[t - 1], actions[t - 1]) in (*links[: t - 1], *links[t:]):
                    waiting.append(t - 1)
            yield tuple(numbered(names)), tuple(numbered(at))


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
    from ssh_abduction.solver.steps.apart import pairwise_distinct  # loads numpy

    pairs = pairs_in(problem.pairs.elsewhere)
    return len(pairwise_distinct(sorted({0, *chain(*pairs)}), pairs))


def groups_of_drives(at: Sequence[int], drive: Sequence[int]) -> list[int]:
    """Return a number for each step. Drives with different numbers share no place (`at`)."""
    group = NodeClasses[tuple[str, int]]()
    for place, number in zip(at, drive, strict=True):
        group.merge(("place", place), ("drive", number))
    return numbered(group.of(("drive", number)) for number in drive)
