"""Say why the costs of maps cannot be trusted, so that no probability is given."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Hashable, Sequence
from dataclasses import replace
from itertools import combinations

from ssh_abduction.data.drives import drives_of, starts_of, step_name
from ssh_abduction.data.groups import NodeClasses, gathered
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.theory.evidence.displacement import jumped
from ssh_abduction.theory.overlap import pairs_of_parts, price_of_laying
from ssh_abduction.theory.settle import Problem

# The views do not say where the robot is if more than this share of the pairs of steps look alike.
# In 11 simulated logs with jumps of the odometry, 0.44 to 0.94 of the pairs do.
ALIKE = 1 / 3


def doubt_of(problem: Problem, best: SSHMap) -> str | None:
    """Say why the costs of maps cannot be trusted; None if there is no such reason.

    Two places cannot be at one position. If two drives have such places, they overlap by chance. If
    views look alike nearly everywhere, drives that stay apart may share places all the same, and
    after a missing displacement the robot may be at many places. A few joins across a missing
    displacement may be false together.
    """
    overlap = problem.overlap
    if overlap.is_ambiguous and overlap.keeps_apart(best):
        return "the views of the drives are too much alike to tell whether they share places"
    if not problem.theory.several_drives and (found := _unconfirmed_join(problem, best)):
        return found
    if (lost := _unknown_step(problem)) is not None:
        drives = drives_of(problem.trace)
        return (
            "the views are too much alike to tell where the robot was after the missing "
            f"displacement at step {step_name(drives, lost) if len(drives) > 1 else lost}"
        )
    if not problem.theory.several_drives or not overlap.near or not overlap.of_map(best):
        return None
    if best.fit is None:
        from ssh_abduction.solver.geometry.fit import fit  # loads scipy

        best = replace(best, fit=fit(problem.trace, best))
    for *steps, _ in overlap.crowded_in(best):
        names = (step_name(drives_of(problem.trace), step) for step in steps)
        return f"{' and '.join(names)} are at one position, but at two places"
    return None


def misfit_of(problem: Problem, best: SSHMap) -> str | None:
    """Say that the best map contradicts the displacements, if it does; else None.

    A map that costs least may still be false: the displacements, or the axioms, may be wrong.
    """
    from ssh_abduction.solver.geometry.fit import fit  # loads scipy

    believed = problem.trace.without_displacements_at(jumped(best))
    if fit(believed, best).p >= problem.theory.reject:
        return None
    return "the best map does not fit the displacements"


def gaps_of(problem: Problem) -> tuple[int, ...]:
    """List the steps on one floor of a drive that no measurement connects to the step before."""
    part, starts = _measured_parts(problem), starts_of(problem.trace)
    same_floor = (t for t, a in enumerate(problem.trace.actions, 1) if not a.changes_floor)
    return tuple(t for t in same_floor if t not in starts and not part.are_one(t - 1, t))


def _unknown_step(problem: Problem) -> int | None:
    """Return the first step whose displacement is missing, if only views say where it is.

    If most views look alike, there are many places where they fit. Closures or stars help.
    """
    trace, part, gaps = problem.trace, _measured_parts(problem), gaps_of(problem)
    if not gaps or problem.theory.star != "none":
        return None
    views = gathered((part.of(t), view) for t, view in enumerate(trace.views))
    pairs, alike = pairs_of_parts(views.values())
    return gaps[0] if alike > ALIKE * pairs else None


def _unconfirmed_join(problem: Problem, best: SSHMap) -> str | None:
    """Name two steps that the best map joins across a missing displacement for too little reason.

    *Parts* of the trace are steps that measurements connect. A missing displacement frees the frame
    of a part, as the start of a drive does. So one common place, or less than laying a drive costs,
    may be common by chance. Without stars, only common dstates show that two places are one.
    """
    trace, theory, part = problem.trace, problem.theory, _parts(problem, best)
    at = [best.place_of(t) for t in range(len(trace))]
    at = list(best.dstate_at) if None in at else at
    views = gathered((part.of(t), view) for t, view in enumerate(trace.views)).values()
    price = price_of_laying(theory, views)
    of_dstate, of_place = theory.prices[0], theory.prices[1] * (theory.level == "topological")

    def in_common(names: Sequence[Hashable]) -> list[tuple[tuple[int, int], Hashable]]:
        """List the pairs of parts that share a name of a dstate or place, each with the place."""
        steps_of = gathered((name, t) for t, name in enumerate(names)).values()
        parts_at = ((sorted({part.of(t) for t in steps}), at[steps[0]]) for steps in steps_of)
        return [(pair, place) for parts, place in parts_at for pair in combinations(parts, 2)]

    while joined := dict(in_common(at)):
        dstates = in_common(best.dstate_at)
        shown = {*(dstates if theory.star == "none" else in_common(at))}
        places = Counter(pair for pair, _ in shown)
        nats = {pair: of_place * places[pair] for pair in joined}
        for pair, _ in dstates:
            nats[pair] += of_dstate
        # Merge the best confirmed pair of parts, and look at what the merged part shares.
        known = [pair for pair in joined if places[pair] > 1 and nats[pair] > price]
        if not known:
            weakest = max(joined, key=lambda pair: nats[pair])
            visits = [t for t, name in enumerate(at) if name == joined[weakest]]
            here, there = sorted(next(t for t in visits if part.of(t) == of) for of in weakest)
            return (
                f"the best map joins steps {here} and {there} across a missing displacement, and "
                "too few other joins confirm this"
            )
        part.merge(*max(known, key=lambda pair: nats[pair]))
    return None


def _measured_parts(problem: Problem, wrong: Collection[int] = frozenset()) -> NodeClasses[int]:
    """Group the steps that displacements, closures and turns connect.

    `wrong` has the steps whose displacement is wrong.
    """
    trace, has_places = problem.trace, problem.theory.level == "topological"
    part = NodeClasses[int]()
    for t, action in enumerate(trace.actions, 1):
        is_measured = trace.steps[t].displacement is not None and t not in wrong
        if is_measured or (has_places and action.turn):
            part.merge(t - 1, t)
    for closure in trace.closures:
        part.merge(closure.first, closure.last)
    return part


def _parts(problem: Problem, best: SSHMap) -> NodeClasses[int]:
    """Group the steps that measurements (`_measured_parts`) and known links connect."""
    trace, part = problem.trace, _measured_parts(problem, jumped(best))
    # An action leads from one dstate to one dstate. So a link that was measured once says where the
    # robot is after the same action, although this displacement is missing.
    grows = True
    while grows:
        grows, links = False, dict[tuple[int, str, int], int]()
        for t, action in enumerate(trace.actions, 1):
            once = links.setdefault((best.dstate_at[t - 1], action.name, part.of(t - 1)), t)
            grows = grows or not part.are_one(once, t)
            part.merge(once, t)
    return part
