"""Say why the costs of maps cannot be trusted, so that no probability is given."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

from ssh_abduction.data.drives import drives_of, starts_of, step_name
from ssh_abduction.data.groups import NodeClasses, gathered
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.theory.evidence.displacement import jumped
from ssh_abduction.theory.overlap import pairs_of_parts
from ssh_abduction.theory.settle import Problem

# The views do not say where the robot is if more than this share of the pairs of steps look alike.
# In 11 simulated logs with jumps of the odometry, 0.44 to 0.94 of the pairs do.
ALIKE = 1 / 3


def doubt_of(problem: Problem, best: SSHMap) -> str | None:
    """Say why the costs of maps cannot be trusted; None if there is no such reason.

    Two places cannot be at one position. If two drives have such places, they overlap by chance. If
    views look alike nearly everywhere, drives that stay apart may share places all the same, and
    after a missing displacement the robot may be at many places. The first join across a missing
    displacement is not tested by any loop.
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


def _unknown_step(problem: Problem) -> int | None:
    """Return the first step whose displacement is missing, if only views say where it is.

    If most views look alike, there are many places where they fit. Closures or stars help.
    """
    trace = problem.trace
    part = _measured_parts(problem)
    gaps = [
        t
        for t in sorted({*range(1, len(trace))} - {*starts_of(trace)})
        if trace.steps[t].displacement is None and not part.are_one(t - 1, t)
    ]
    if not gaps or problem.theory.star != "none":
        return None
    views = gathered((part.of(t), view) for t, view in enumerate(trace.views))
    pairs, alike = pairs_of_parts(views.values())
    return gaps[0] if alike > ALIKE * pairs else None


def _unconfirmed_join(problem: Problem, best: SSHMap) -> str | None:
    """Name two steps that the best map joins, and that nothing but one such join connects.

    *Parts* of the trace are steps that displacements connect. In the graph of parts and places, a
    bridge is a join that no loop tests.
    """
    trace = problem.trace
    part = _parts(problem, best)
    if len({part.of(t) for t in range(len(trace))}) == 1:
        return None
    import networkx as nx

    at = [best.place_of(t) for t in range(len(trace))]
    at = list(best.dstate_at) if None in at else at
    visits = gathered((place, t) for t, place in enumerate(at))
    graph = nx.Graph()
    for place, steps in visits.items():
        parts = {part.of(t) for t in steps}
        graph.add_edges_from((t, ("at", place)) for t in parts if len(parts) > 1)
    for edge in nx.bridges(graph):
        (_, place), of = sorted(edge, key=lambda node: isinstance(node, int))
        steps = visits[place]
        here = next(t for t in steps if part.of(t) == of)
        there = next(t for t in steps if part.of(t) != of)
        return (
            f"the best map joins steps {min(here, there)} and {max(here, there)} across a missing "
            "displacement, and no other join confirms this"
        )
    return None


def _measured_parts(problem: Problem, wrong: Collection[int] = frozenset()) -> NodeClasses[int]:
    """Group the steps that displacements, closures, lifts and turns connect.

    `wrong` has the steps whose displacement is wrong.
    """
    trace, has_places = problem.trace, problem.theory.level == "topological"
    part = NodeClasses[int]()
    for t, action in enumerate(trace.actions, 1):
        is_measured = trace.steps[t].displacement is not None and t not in wrong
        if is_measured or action.kind in ("lift", "stairs") or (has_places and action.turn):
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
