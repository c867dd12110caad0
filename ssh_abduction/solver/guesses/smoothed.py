"""Guess the map of a drive from the poses that fit all its closures at once.

A beam goes through the trace once, so it does not know the closures of later steps. After a long
way it may join places that only the drift brings together. This guess first fits the poses of all
visits to the displacements and closures (*smoothing*), as if no two visits were to one place. Then
it merges the two places that most surely coincide, conditions the poses on this, and goes on.
"""

from __future__ import annotations

from ssh_abduction.data.drives import Drive
from ssh_abduction.data.groups import numbered
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.solver.geometry.equations import visits_by_turns
from ssh_abduction.solver.geometry.fit import Poses
from ssh_abduction.solver.guesses.completing import valid_map
from ssh_abduction.solver.guesses.overlaying import Overlay, Part
from ssh_abduction.solver.guesses.sights import Sights
from ssh_abduction.solver.steps.log import Log
from ssh_abduction.theory.settle import Problem


def smoothed_map(problem: Problem, log: Log) -> SSHMap | None:
    """Make the map of a trace of one drive by merging visits; None if it breaks an axiom."""
    trace = problem.trace
    bare = problem.theory.replace(displacement="none", weigh="count")
    sights = Sights(trace, bare, log, misreads=False)
    part = smoothed_part(problem, Drive("", 0, len(trace)), log, sights)
    found = [part.labels[t] for t in range(len(trace))]
    order = list(dict.fromkeys(found))  # of first visits
    places, facing = numbered(part.places[s] for s in order), part.poses[1][order].tolist()
    return valid_map(trace, bare, numbered(found), places, facing)


def smoothed_part(problem: Problem, drive: Drive, log: Log, sights: Sights) -> Part:
    """Make the map of one drive of a trace by merging visits. It is not checked.

    `log` and `sights` are those of the whole trace.
    """
    trace, theory = problem.trace[drive.first : drive.stop], problem.theory
    steps, places = range(len(trace)), numbered(visits_by_turns(trace, theory))
    poses = Poses(trace, steps, places)
    nats = poses.misfit() / 2 + theory.prices[0] * len(trace)
    if theory.level == "topological":
        nats += theory.prices[1] * len({*places})
    labels = {drive.first + t: t for t in steps}
    apart = Part.of_steps(labels, places, poses.gaussian()[1:], nats, log, sights)
    overlay = Overlay(apart, None, problem, sights)
    overlay.merge_all()
    return overlay.part()
