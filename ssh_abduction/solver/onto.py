"""Add a drive to the map of old drives, in about the time that solving the new drive takes.

The map of the old drives is the *existing map*: the joint map must keep its dstates and places. The
solver does not get the old drives. It gets a *digest*: a short trace in which each link of their
map occurs once. Axioms are about links and observations. So each map of the digest and a new drive
gives a map of all drives. Assertions about the steps of the digest say that those at one dstate or
place of the existing map are at one, and others are not. The search begins with the existing map,
to which a sketch adds the new drives.

With displacements, a long drive is laid on the existing map. No search of all drives follows, so it
is not proven that the joint map has the least cost. If that fails, or if the drives are short, the
solver gets all old steps.

>>> from ssh_abduction import Trace, solve
>>> monday = Trace.from_steps("abcd", ["travel", "around", "travel"], name="monday")
>>> tuesday = Trace.from_steps("bcd", ["around", "travel"], name="tuesday")
>>> solution = solve(tuesday, onto=solve(monday))
>>> solution[0].labels
((0, 1, 2, 3), (1, 2, 3))
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import TYPE_CHECKING

from ssh_abduction.data.checks import an_instance
from ssh_abduction.data.corrections import ASSERTIONS
from ssh_abduction.data.drives import drives_of, starts_of, step_name, together
from ssh_abduction.data.errors import SolverError
from ssh_abduction.data.gateways import with_allowed_headings
from ssh_abduction.data.groups import first_index_of, firsts, numbered
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.step import Action, Step
from ssh_abduction.data.trace import Trace
from ssh_abduction.runtime.clock import heeding
from ssh_abduction.runtime.limits import EARLY, LimitError, Stop, Watch
from ssh_abduction.solution.recorded import Support
from ssh_abduction.solution.result import Solution
from ssh_abduction.solution.values import Bound, Cost, Effort, Level, Seconds, Status
from ssh_abduction.solution.weighed import IMPROBABLE, Rival, Weighed
from ssh_abduction.solver.board import Judging
from ssh_abduction.solver.costs.estimating import crowded, may_join_more, rival_of, rivals_of
from ssh_abduction.solver.derived_regions import Deriving
from ssh_abduction.solver.geometry.ranking import Ranking, noise_warning, units_warning
from ssh_abduction.solver.schedule import turn
from ssh_abduction.solver.sources.exact.choosing import READABLE
from ssh_abduction.solver.sources.metric.completing import completed
from ssh_abduction.solver.sources.symbolic.sketch import first_contradiction, sketch_beyond
from ssh_abduction.theory.settle import Problem, settle
from ssh_abduction.theory.speedups import Speedups
from ssh_abduction.theory.theory import Theory, checked_theory

if TYPE_CHECKING:
    from ssh_abduction.solver.sources.metric.joint_drives import ExistingMap

# New drives may be laid on a map for this many seconds of processor time, even if the time limit is
# over. That is enough for a drive of some hundred steps. Without it, a busy machine would leave the
# drive apart, and all later ones, too.
LAYING = 5.0
# The fields of a theory that say which returns displacements reject.
_JUDGES = ("level", "displacement", "reject", "joint", "without")
_LIMITS = (*EARLY, "memory limit")  # what ends a search early


@dataclass(frozen=True)
class Solving:
    """How to solve a trace: a function, the speed-ups, and the clock and limits of all solving.

    The function gets a trace, a theory, and maps to begin with.
    """

    solve: Callable[[Trace, Theory, Sequence[SSHMap]], Solution]
    speedups: Speedups
    watch: Watch


def joint_with(
    trace: Trace, existing: Solution, theory: Theory | None
) -> tuple[Trace, Theory, SSHMap]:
    """Return the joint trace of old and new drives, its theory, and the map to keep.

    The existing solution has the trace of the old drives, and its first map is the one to keep.
    Misread views of this map are corrected. Its theory, without faults, is the default. Raises
    SolverError without a map or trace, or with other faults.
    """
    mend = "take what solve returned, or Solution.load"
    solution = an_instance("onto", existing, Solution, SolverError, mend=mend)
    if not solution.maps or solution.trace is None:
        raise SolverError(
            "onto: expected a solution with a map and its trace, got one without; read a file that "
            "solve -o wrote"
        )
    theory = checked_theory(theory or solution.theory.replace(returns=0, misread=0.0))
    ssh_map, known = solution.maps[0], solution.trace
    faults = theory.has_faults or solution.theory.replace(misread=0.0).has_faults
    if faults or any(fault.kind != "misread" for fault in ssh_map.faults):
        raise SolverError(
            "onto: expected a map without faults, got a theory that allows them; solve all drives "
            "together"
        )
    if theory.level == "causal" and solution.theory.level != "causal":
        raise SolverError(
            "onto: expected a topological theory, as the existing map has places, got "
            "level=causal; take Theory.topological() (solve --theory topological)"
        )
    steps = list(known.steps)
    for fault in ssh_map.faults:
        steps[fault.step] = replace(steps[fault.step], view=fault.expected)
    known = replace(known, steps=tuple(steps))
    return together([known, trace]), theory, replace(ssh_map, faults=())


def solve_onto(
    joint: Trace, existing: Solution, theory: Theory, ssh_map: SSHMap, solving: Solving
) -> Solution:
    """Find the minimal joint maps of new and old drives that keep the map of the old drives.

    The trace, the theory and the map are what `joint_with` returns, perhaps with corrections of a
    person. With displacements, new drives may join pieces of the map. Raises SolverError if the new
    drive contradicts the map.
    """
    # 1. The joint problem, of old and new drives.
    old, trace = joint[: len(ssh_map.dstate_at)], joint[len(ssh_map.dstate_at) :]
    says_joined = _check_assertions(theory, old, ssh_map)
    problem = settle(joint, theory)
    in_use = problem.theory

    # 2. Long drives: map the new ones alone, and lay their maps on the old map.
    can_lay = in_use.weigh == "cost" and not (in_use.has_faults or in_use.lifts)
    if solving.speedups.greedy and len(joint) > READABLE and can_lay:
        judged = all(getattr(in_use, f) == getattr(existing.theory, f) for f in _JUDGES)
        on_map = _laid_in_time(old, ssh_map, trace, problem, len(old) if judged else 0, solving)
        if on_map is not None:
            return on_map

    # 3. A short trace that stands for the old map (its digest), and the new drive.
    short = solving.speedups.that_hold_for(in_use).digest and in_use.displacement == "none"
    digest = Digest.of(old, ssh_map, short=short)
    # Pieces may join. Without displacements, the smallest map joins all that looks alike.
    if in_use.weigh == "cost" or says_joined:
        digest = replace(digest, kept=ssh_map.piece_of)
    with warnings.catch_warnings():  # ignore that a digest may equal the new drive
        warnings.simplefilter("ignore")
        part = together([digest.trace, trace.without_displacements() if short else trace])

    # 4. The minimal maps of this trace that keep the old map.
    pinned = _pinned(theory, digest, ssh_map)
    found = solving.solve(part, pinned, tuple(_sketched(digest, ssh_map, part, in_use)))

    # 5. Their labels for all steps of all drives.
    labelled = (replace(m, dstate_at=digest.labels_of_all(m, ssh_map)) for m in found.maps)
    maps = tuple(_begun(m, joint, in_use) for m in labelled)
    if not maps and found.stopped in _LIMITS and (grown := _grown(ssh_map, old, problem)):
        found, maps = replace(found, status=Status.FEASIBLE, cost=Cost.of(grown)), (grown,)
    if not maps:
        raise _contradiction(trace, found)
    assert found.cost is not None
    return replace(
        found,
        maps=maps,
        # The theory for the digest has assertions about its steps.
        theory=found.theory.replace(**{kind: getattr(theory, kind) for kind in ASSERTIONS}),
        steps=len(joint),
        effort=replace(
            found.effort,
            prefix=min(found.effort.prefix, len(joint)),  # a digest may have more steps
            seconds=replace(found.effort.seconds, total=solving.watch.seconds()),
        ),
        levels=(Level(found.cost, len(maps), found.complete),) if found.within else (),
        shared=None,
        trace=joint,
        support=Support(
            warnings=found.support.warnings,
            weighed=None if short or not found.maps else _weighed(found, pinned),
            onto=tuple(drive.name for drive in drives_of(old)),
        ),
    )


def _begun(found: SSHMap, joint: Trace, theory: Theory) -> SSHMap:
    """Number the dstates and headings of a map in the order in which a trace visits them.

    The first dstate that the robot visits at a place has heading 0.
    """
    labels, whole = found.dstate_at, replace(found, starts=starts_of(joint), names=())
    if theory.star == "gateways":
        whole = with_allowed_headings(joint, whole, theory.axioms) or whole
    elif theory.star == "frame":
        visited = (whole.dstates[label] for label in dict.fromkeys(labels))
        back = firsts((s.place, s.heading or 0) for s in visited)
        turned = (replace(s, heading=((s.heading or 0) - back[s.place]) % 4) for s in whole.dstates)
        whole = replace(whole, dstates=tuple(turned))
    return whole.renumbered()


def _laid_in_time(
    old: Trace, ssh_map: SSHMap, trace: Trace, problem: Problem, since: int, solving: Solving
) -> Solution | None:
    """Make a solution of the map that `laid` finds; None if there is none, or it takes too long.

    After Ctrl-C, give the new drives new places.
    """
    joint, found, weighed = problem.trace, None, None
    stopped: Stop = "no proof"
    try:
        with suppress(LimitError), heeding(solving.watch.later(LAYING)):
            found, weighed = laid(old, ssh_map, trace, problem, since) or (None, None)
    except KeyboardInterrupt:
        stopped, found = "interrupted", _grown(ssh_map, old, problem)
        if found is None:
            raise
    if found is None:
        return None
    support = Support(weighed=weighed, onto=tuple(drive.name for drive in drives_of(old)))
    return Solution(
        status=Status.FEASIBLE,
        maps=(found,),
        cost=Cost.of(found),
        bound=Bound(max(cost.dstates for cost in _costs(ssh_map))),
        complete=False,
        theory=problem.theory,
        steps=len(joint),
        effort=Effort(0, Seconds(solving.watch.seconds(), 0.0, 0.0)),
        stopped=stopped,
        trace=joint,
        support=support.warning_of(units_warning(joint) or noise_warning(found, joint)),
    )


def _grown(ssh_map: SSHMap, old: Trace, problem: Problem) -> SSHMap | None:
    """Add new places for a new drive to a map, without a search; None if that breaks an axiom."""
    sketch = sketch_beyond(ssh_map, old, problem.theory, homing=False)
    if first_contradiction(sketch, problem.trace) is not None:
        return None
    grown = replace(sketch.map(), starts=starts_of(problem.trace), names=())
    return grown if Judging(problem).accepts(grown) else None


def _sketched(digest: Digest, ssh_map: SSHMap, part: Trace, theory: Theory) -> Iterator[SSHMap]:
    """Add new places for a new drive to the existing map, without a search.

    The search begins with these maps of the digest and the drive, if they break no axiom. So its
    best map has at most one dstate more for each new step, also at a limit.
    """
    standing = replace(ssh_map, dstate_at=digest.labels)
    for homing in (True, False):
        sketch = sketch_beyond(standing, digest.trace, theory, homing)
        if first_contradiction(sketch, part) is None:
            yield _begun(sketch.map(), part, theory)


def _check_assertions(theory: Theory, old: Trace, ssh_map: SSHMap) -> bool:
    """Raise SolverError if the existing map contradicts what a theory asserts of the old steps.

    Return whether the theory joins pieces of the map, which is no contradiction.
    """
    dstates, piece_of, joins = ssh_map.dstate_at, ssh_map.piece_of, False
    places = [ssh_map.dstates[s].place for s in dstates]
    for kind in ASSERTIONS:
        ids = dstates if kind in ("same", "different") else places
        for i, j in getattr(theory, kind):
            known = max(i, j) < len(old) and ids[i] is not None
            if not known or (ids[i] == ids[j]) == kind.startswith("same"):
                continue
            if piece_of[dstates[i]] != piece_of[dstates[j]]:
                joins = True
            else:
                steps = ", ".join(step_name(drives_of(old), t) for t in (i, j))
                raise SolverError(
                    f"onto: expected a map that obeys '{kind}: {steps}', got one that "
                    "does not; map the old drives again, or solve all drives together"
                )
    return joins


def _pinned(theory: Theory, digest: Digest, ssh_map: SSHMap) -> Theory:
    """Return the theory for a digest and a new drive, with assertions that keep the existing map.

    They say that steps at one dstate or place of the existing map are at one, and that steps at
    different dstates or places of a piece are different. Assertions of the theory about old steps
    are moved to steps of the digest.
    """
    first, labels = first_index_of(digest.labels), ssh_map.dstate_at
    place = {s: ssh_map.dstates[s].place for s in first}
    moved = {kind: digest.moved(getattr(theory, kind), labels) for kind in ASSERTIONS}
    for (s, i), (x, j) in combinations(first.items(), 2):
        if digest.must_differ(s, x):
            moved["different" if place[s] == place[x] else "elsewhere"].append((i, j))
    moved["same"] += [(first[s], t) for t, s in enumerate(digest.labels) if first[s] != t]
    first_at = first_index_of(place[s] for s in digest.labels)
    moved["same_place"] += [
        (t, i) for s, i in first.items() if place[s] is not None and (t := first_at[place[s]]) != i
    ]
    return theory.replace(**moved)


def _weighed(found: Solution, pinned: Theory) -> Weighed | None:
    """Return the costs of the maps found, with the rivals that satisfy all assertions."""
    if found.weighed is None:
        return None
    rivals = tuple(rival for rival in found.weighed.rivals if _obeys(rival, pinned))
    return replace(found.weighed, rivals=rivals) if rivals else None


def _obeys(rival: Rival, theory: Theory) -> bool:
    """Whether a rival, which may be estimated, satisfies what a theory asserts."""
    return all(
        (at[i] == at[j]) == kind.startswith("same")
        for kind in ASSERTIONS
        for at in [rival.dstates if kind in ("same", "different") else rival.at]
        for i, j in getattr(theory, kind)
        if max(i, j) < len(at)
    )


def _contradiction(trace: Trace, found: Solution) -> SolverError:
    """Make the error that says that new drives contradict the existing map, and what to do."""
    new = ", ".join(drive.name for drive in drives_of(trace))
    if found.stopped in _LIMITS:
        return SolverError(
            f"onto: expected a map that keeps the existing one, found none for {new} before the "
            f"search ended ({found.stopped}); give it more time or memory"
        )
    return SolverError(
        f"onto: expected a drive that agrees with the existing map, got {new}: no map keeps the "
        "existing map; solve all drives together (solve --together)"
    )


def laid(
    old: Trace, ssh_map: SSHMap, trace: Trace, problem: Problem, since: int
) -> tuple[SSHMap, Weighed] | None:
    """Find a joint map of little cost that keeps each piece of the map of the old drives.

    `trace` has the new drives, and the problem all drives. The result is the cheapest of a few
    maps, with its costs: in one the new drives are pieces of their own, and in the others they are
    joined to the old ones. Pieces of the old map may be joined, too. None if no such map satisfies
    the axioms. The displacements of the first `since` steps are known to agree with the map.
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
    others = [replace(rival, estimated=True) for rival in known[1:]]
    moved = rivals_of(problem, misfit, best, turn("estimated rivals").most, len(old))
    at_least = problem.prior.at_least
    weighed = Weighed(
        bound=max(at_least({"dstates": c.dstates, "places": c.places}) for c in _costs(ssh_map))
        + kept.chi2 / 2,
        within=0.0,
        rivals=crowded(problem, misfit, [known[0], *others, *moved]),
        searched=best.fit.p >= IMPROBABLE and not may_join_more(problem, known),
        broken=existing.broken,
        drives=drives_of(joint),
    )
    return best, weighed


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
