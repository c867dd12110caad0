"""Lay new drives on the map of old drives, in about the time that solving the new drives takes.

This needs displacements. No search of all drives follows, so it is not proven that the joint map
has the least cost.

The solver does not get the old drives, but a *digest*: a short trace in which each link of their
map occurs once. Axioms are about links and observations. So each map of the digest and a new drive
gives a map of all drives.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal

from ssh_abduction.data.drives import drives_of, starts_of, together
from ssh_abduction.data.groups import first_index_of, numbered
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.step import Action, Step
from ssh_abduction.data.trace import Trace
from ssh_abduction.solver.asp.limits import Watch
from ssh_abduction.solver.board import Judging
from ssh_abduction.solver.costs.distrust import doubt_of, gaps_of
from ssh_abduction.solver.costs.estimating import may_join_more, rival_of, rivals_of
from ssh_abduction.solver.derived_regions import Deriving
from ssh_abduction.solver.geometry.ranking import Ranking, noise_warning, units_warning
from ssh_abduction.solver.schedule import turn
from ssh_abduction.solver.solution.recorded import Support
from ssh_abduction.solver.solution.result import Solution
from ssh_abduction.solver.solution.weighed import IMPROBABLE, Weighed
from ssh_abduction.solver.sources.metric.completing import completed
from ssh_abduction.solver.values import Bound, Cost, Effort, Seconds, Status, nats_of
from ssh_abduction.theory.settle import Problem
from ssh_abduction.theory.theory import Theory

if TYPE_CHECKING:
    from ssh_abduction.solver.sources.metric.joint_drives import ExistingMap


def can_lay(theory: Theory) -> bool:
    """Whether new drives can be laid on a map by a theory in which no field is "auto"."""
    return theory.weigh == "cost" and not (theory.has_faults or theory.lifts)


def laid(
    old: Trace, ssh_map: SSHMap, trace: Trace, problem: Problem, watch: Watch, since: int
) -> Solution | None:
    """Find a joint map of little cost that keeps each piece of the map of the old drives.

    `trace` has the new drives, and the problem all drives, under a theory that `can_lay`. The
    solution has the cheapest of up to three maps: in one the new drives are pieces of their own,
    and in the others they are joined to the old ones. Pieces of the old map may be joined, too.
    None if no such map satisfies the axioms. The displacements of the first `since` steps are known
    to agree with the map.
    """
    from ssh_abduction.solver.costs.misfit import Misfit  # loads numpy
    from ssh_abduction.solver.sources.metric.joint_drives import ExistingMap

    joint, theory = problem.trace, problem.theory
    judging, existing, misfit = Judging(problem), ExistingMap(old, ssh_map), Misfit(problem)
    maps = _joint_maps(existing, old, ssh_map, trace, problem)
    found = sorted(((misfit.nats_of(m), m) for m in maps), key=lambda pair: pair[0])
    while found and not judging.accepts(
        found[0][1], since if _is_kept(ssh_map, found[0][1]) else 0
    ):
        del found[0]
    if not found:
        return None
    best = Deriving(joint, theory).mapped(Ranking(joint).fitted(found[0][1]))
    kept = (ssh_map if ssh_map.fit else Ranking(old).fitted(ssh_map)).fit
    assert kept is not None
    assert best.fit is not None
    known = [rival_of(m, nats) for nats, m in found]
    moved = rivals_of(problem, misfit, best, turn("estimated rivals").most, len(old))
    weighed = Weighed(
        bound=max(nats_of(cost, theory) for cost in _costs(ssh_map)) + kept.chi2 / 2,
        within=0.0,
        rivals=(known[0], *(replace(rival, estimated=True) for rival in known[1:]), *moved),
        searched=best.fit.p >= IMPROBABLE and not may_join_more(problem, known),
        broken=existing.broken,
        doubt=doubt_of(problem, best),
        gaps=gaps_of(problem),
        drives=drives_of(joint),
    )
    return unproven(best, ssh_map, old, problem, watch, "no proof", weighed)


def unproven(
    found: SSHMap,
    ssh_map: SSHMap,
    old: Trace,
    problem: Problem,
    watch: Watch,
    stopped: Literal["interrupted", "no proof"],
    weighed: Weighed | None = None,
) -> Solution:
    """Make a solution of a joint map that was found without a search.

    It keeps each piece of the map of the old drives. `stopped` says why there is no proof.
    `weighed` has the cost of the map and of its rivals; None if they were not computed.
    """
    joint = problem.trace
    return Solution(
        status=Status.FEASIBLE,
        maps=(found,),
        cost=Cost.of(found),
        bound=Bound(max(cost.dstates for cost in _costs(ssh_map))),
        complete=False,
        theory=problem.theory,
        steps=len(joint),
        effort=Effort(0, Seconds(watch.seconds(), 0.0, 0.0)),
        stopped=stopped,
        trace=joint,
        support=Support(
            odometry_warning=units_warning(joint) or noise_warning(found, joint),
            weighed=weighed,
            onto=tuple(drive.name for drive in drives_of(old)),
        ),
    )


def _is_kept(ssh_map: SSHMap, found: SSHMap) -> bool:
    """Whether a joint map joins no two dstates or places of a map of the first drives."""
    labels = found.dstate_at[: len(ssh_map.dstate_at)]
    places = {found.dstates[s].place for s in labels}
    return len({*labels}) == len(ssh_map.dstates) and len(places) == max(len(ssh_map.places), 1)


def _costs(ssh_map: SSHMap) -> Iterator[Cost]:
    """Yield the cost of each piece of a map, without paths."""
    for piece in ssh_map.pieces:
        places = {ssh_map.dstates[s].place for s in piece} - {None}
        yield replace(Cost.of(ssh_map), dstates=len(piece), places=len(places), paths=0)


def _joint_maps(
    existing: ExistingMap, old: Trace, ssh_map: SSHMap, trace: Trace, problem: Problem
) -> Iterator[SSHMap]:
    """Yield joint maps that keep each piece of the old map. The caller has to check them."""
    digest = Digest.of(old, ssh_map, short=True)
    short = existing.with_displacements(digest.trace, digest.labels)
    with warnings.catch_warnings():  # ignore that a digest may equal the new drives
        warnings.simplefilter("ignore")
        part = together([replace(short, odometry=old.odometry), trace])
    theory, labels = problem.theory, ssh_map.dstate_at
    # The joint map is checked against all that a user asserts.
    asserted = theory.replace(
        same=(),
        different=tuple(digest.moved(theory.different, labels)),
        elsewhere=tuple(digest.moved(theory.elsewhere, labels)),
        same_place=(),
    )
    for found in existing.maps(Problem.of(part, asserted), digest.labels):
        if whole := _of_all(found, digest.labels_of_all(found, ssh_map), problem):
            yield whole


def _of_all(found: SSHMap, labels: tuple[int, ...], problem: Problem) -> SSHMap | None:
    """Make a map of all drives from a map of a digest and labels; None if it breaks an axiom."""
    order = [found.dstates[s] for s in dict.fromkeys(labels)]
    facing = [-math.pi / 2 * (s.heading or 0) for s in order]  # only star=frame uses them
    places = numbered(s.place for s in order)
    whole = completed(problem.trace, problem.theory, numbered(labels), places, facing)
    return replace(whole, starts=starts_of(problem.trace)) if whole else None


@dataclass(frozen=True)
class Digest:
    """A short trace that the solver gets instead of the old drives.

    Attributes:
        trace: The short trace.
        labels: For each step, its dstate in the existing map.
        kept: For each dstate, the part of the existing map that must be kept; empty if the whole
            map must be kept.
    """

    trace: Trace
    labels: tuple[int, ...]
    kept: Mapping[int, int] = field(default_factory=dict)

    @classmethod
    def of(cls, trace: Trace, ssh_map: SSHMap, *, short: bool) -> Digest:
        """Make a digest of the drives of a map. If it is `short`, each link occurs only once."""
        if not short:
            return cls(trace, ssh_map.dstate_at)
        shown = _observations(trace, ssh_map)
        actions = {action.name: action for action in trace.actions}
        steps: list[Step] = []
        labels: list[int] = []
        for trail in _trails(ssh_map):
            if steps:
                steps[-1] = replace(steps[-1], action=Action(f"standing {len(steps)}", "start"))
            for s, action in trail:
                done = None if action is None else actions[action]
                steps.append(replace(shown[s][0], action=done))
                labels.append(s)
        for s, seen in shown.items():
            for step in seen[1:]:
                steps[-1] = replace(steps[-1], action=Action(f"standing {len(steps)}", "start"))
                steps.append(replace(step, action=None))
                labels.append(s)
        return cls(Trace(tuple(steps), drive="standing"), tuple(labels))

    def must_differ(self, dstate: int, other: int) -> bool:
        """Whether two dstates of the existing map must stay two, and their places as they are."""
        return dstate != other and self.kept.get(dstate) == self.kept.get(other)

    def moved(
        self, pairs: Iterable[tuple[int, int]], labels: Sequence[int]
    ) -> list[tuple[int, int]]:
        """Move pairs of steps of all drives to the trace of this digest and the new drives.

        `labels` has the dstate of each step of the old drives. A pair of such steps at one dstate
        is left out.
        """
        first, shift = first_index_of(self.labels), len(self.labels) - len(labels)
        steps = (
            tuple(first[labels[t]] if t < len(labels) else t + shift for t in pair)
            for pair in pairs
        )
        return [(i, j) for i, j in steps if i != j]

    def labels_of_all(self, found: SSHMap, ssh_map: SSHMap) -> tuple[int, ...]:
        """Return the dstate of each step of all drives in the map `found`."""
        number = dict(zip(self.labels, found.dstate_at, strict=False))
        new = found.dstate_at[len(self.labels) :]
        return (*(number[s] for s in ssh_map.dstate_at), *new)


def _observations(trace: Trace, ssh_map: SSHMap) -> dict[int, list[Step]]:
    """For each dstate, list the different observations made there, those with a view first."""
    shown: dict[int, dict[object, Step]] = {s.id: {} for s in ssh_map.dstates}
    for step, label in zip(trace.steps, ssh_map.dstate_at, strict=True):
        shown[label].setdefault((step.view, step.star), step)
    return {
        s: sorted(
            (Step(view=step.view, star=step.star) for step in seen.values()),
            key=lambda step: step.view is None,
        )
        for s, seen in shown.items()
    }


def _trails(ssh_map: SSHMap) -> list[list[tuple[int, str | None]]]:
    """Cover the links of a map by few trails, so that each link is in one trail.

    A trail has pairs of a dstate and the action that leads to the next dstate, None at the end. A
    dstate without links is a trail of its own.
    """
    leaving: dict[int, list[tuple[str, int]]] = {s.id: [] for s in ssh_map.dstates}
    excess = dict.fromkeys(leaving, 0)
    for s, action, x in sorted(ssh_map.links, reverse=True):
        leaving[s].append((action, x))
        excess[s] += 1
        excess[x] -= 1
    trails: list[list[tuple[int, str | None]]] = []
    # First start trails at dstates that more links leave than reach: a trail must start there.
    for start in sorted(leaving, key=lambda s: -excess[s]):
        while leaving[start]:
            trail: list[tuple[int, str | None]] = []
            here = start
            while leaving[here]:
                action, there = leaving[here].pop()
                trail.append((here, action))
                here = there
            trails.append([*trail, (here, None)])
    visited = {s for trail in trails for s, _ in trail}
    return trails + [[(s, None)] for s in leaving if s not in visited]
