"""Guess the map of one or more drives from the poses that fit all its closures at once.

A beam goes through the trace once, so it does not know the closures of later steps. After a long
way it may join places that only the drift brings together. This guess first fits the poses of all
visits to the displacements and closures (*smoothing*), as if no two visits were to one place. Then
it merges the two places that most surely coincide, conditions the poses on this, and goes on. It
may also begin with a map, such as one of a beam, whose places are then merged further.
"""

from __future__ import annotations

from ssh_abduction.data.groups import numbered
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.solver.geometry.equations import visits_by_turns
from ssh_abduction.solver.geometry.fit import Poses
from ssh_abduction.solver.guesses.completing import map_of_part
from ssh_abduction.solver.guesses.overlaying import Overlay
from ssh_abduction.solver.guesses.placed_map import Part
from ssh_abduction.solver.guesses.sights import Sights
from ssh_abduction.solver.steps.log import Log
from ssh_abduction.theory.settle import Problem


def smoothed_map(problem: Problem, log: Log, begin: SSHMap | None = None) -> SSHMap | None:
    """Make a map of a trace by merging visits, or the places and dstates of the map `begin`.

    None if it breaks an axiom, or if displacements and closures do not connect all visits.
    """
    trace, theory = problem.trace, problem.theory
    bare = theory.replace(displacement="none", weigh="count")
    sights = Sights(trace, bare, misreads=False)
    if begin is None:
        labels, places = [*range(len(trace))], numbered(visits_by_turns(trace, theory))
    else:
        labels = [*begin.dstate_at]
        places = numbered(-1 - s.id if s.place is None else s.place for s in begin.dstates)
    poses = Poses(trace, labels, places)
    part, mean, covariance = poses.gaussian()
    if any(part):
        return None
    nats = poses.misfit() / 2 + theory.prices[0] * len(places)
    if theory.level == "topological":
        nats += theory.prices[1] * len({*places})
    apart = Part.of_steps(dict(enumerate(labels)), places, (mean, covariance), nats, log, sights)
    overlay = Overlay(apart, None, problem, sights)
    overlay.merge_all()
    return map_of_part(trace, bare, overlay.part())
