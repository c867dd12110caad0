"""Add a drive to the map of old drives, in about the time that solving the new drive takes.

The map of the old drives is the *existing map*: the joint map must keep its dstates and places. The
solver does not get the old drives. It gets a digest of them (`laying.py`), and assertions about its
steps: those at one dstate or place of the existing map are at one, and others are not. The search
begins with the existing map, to which a sketch adds the new drives.

With displacements, a long drive is laid on the existing map (`laying.py`). If that fails, or if the
drives are short, the solver gets all old steps.

>>> from ssh_abduction import Trace, solve
>>> monday = Trace.from_steps("abcd", ["travel", "around", "travel"], name="monday")
>>> tuesday = Trace.from_steps("bcd", ["around", "travel"], name="tuesday")
>>> solution = solve(tuesday, onto=solve(monday))
>>> solution[0].labels
((0, 1, 2, 3), (1, 2, 3))
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import combinations

from ssh_abduction.data.checks import an_instance
from ssh_abduction.data.corrections import ASSERTIONS, Corrections
from ssh_abduction.data.drives import drives_of, starts_of, step_name, together
from ssh_abduction.data.errors import SolverError
from ssh_abduction.data.gateways import with_allowed_headings
from ssh_abduction.data.groups import first_index_of, firsts
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.data.words import counted
from ssh_abduction.runtime.clock import heeding
from ssh_abduction.solver.asp.limits import EARLY, LimitError, Watch
from ssh_abduction.solver.board import Judging
from ssh_abduction.solver.laying import Digest, can_lay, laid, unproven
from ssh_abduction.solver.obeying import obeyed, with_names
from ssh_abduction.solver.solution.recorded import Support
from ssh_abduction.solver.solution.result import Solution
from ssh_abduction.solver.solution.weighed import Weighed
from ssh_abduction.solver.sources.exact.choosing import READABLE
from ssh_abduction.solver.sources.symbolic.sketch import sketch_beyond
from ssh_abduction.solver.sources.symbolic.sketched import first_contradiction
from ssh_abduction.solver.values import Cost, Level, Status
from ssh_abduction.theory.settle import Problem, settle
from ssh_abduction.theory.speedups import Speedups
from ssh_abduction.theory.theory import Theory, checked_theory

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


def solve_onto(
    trace: Trace,
    existing: Solution,
    theory: Theory | None,
    corrections: Corrections | None,
    solving: Solving,
) -> Solution:
    """Find the minimal joint maps of new and old drives that keep the map of the old drives.

    The existing solution has the trace of the old drives, and its first map is the one to keep. Its
    theory is the default; steps in a theory are steps of the joint trace. With displacements, new
    drives may join pieces of that map. Corrections of a person are obeyed. Raises SolverError
    without a map or trace, or if the new drive contradicts the map.
    """
    # 1. The joint problem, of old and new drives.
    old, ssh_map = _existing(existing)
    theory = checked_theory(theory or existing.theory.replace(returns=0))
    _check_theory(theory, existing)
    joint = together([old, trace])
    theory.check_steps(joint)
    if corrections is not None:
        joint, theory = obeyed(corrections, joint, theory)
        old, trace = joint[: len(old)], joint[len(old) :]
    says_joined = _check_assertions(theory, old, ssh_map)
    problem = settle(joint, theory)
    in_use = problem.theory

    # 2. Long drives: map the new ones alone, and lay their maps on the old map.
    if solving.speedups.greedy and len(joint) > READABLE and can_lay(in_use):
        judged = all(getattr(in_use, f) == getattr(existing.theory, f) for f in _JUDGES)
        since = len(old) if judged else 0
        on_map = _laid_in_time(old, ssh_map, trace, problem, solving.watch, since)
        if on_map is not None:
            return _named(on_map, ssh_map, corrections)

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
    kept = [m for m in found.maps if not any(_broken(m.dstate_at, _places_in(m), digest, ssh_map))]

    # 5. Their labels for all steps of all drives.
    labelled = (replace(m, dstate_at=digest.labels_of_all(m, ssh_map)) for m in kept)
    maps = tuple(_begun(m, joint, in_use) for m in labelled)
    if not maps and found.stopped in _LIMITS and (grown := _grown(ssh_map, old, problem)):
        found, maps = replace(found, status=Status.FEASIBLE, cost=Cost.of(grown)), (grown,)
    if not maps:
        raise _contradiction(old, trace, ssh_map, digest, found)
    solution = _of_joint_trace(found, maps, theory, joint, solving.watch)
    support = Support(
        odometry_warning=found.support.odometry_warning,
        weigh_warning=found.support.weigh_warning,
        weighed=None if short or not kept else _weighed(found, digest, ssh_map),
        onto=tuple(drive.name for drive in drives_of(old)),
    )
    return _named(replace(solution, support=support), ssh_map, corrections)


def _of_joint_trace(
    found: Solution, maps: tuple[SSHMap, ...], theory: Theory, joint: Trace, watch: Watch
) -> Solution:
    """Turn the solution for a digest and a new drive into one for all drives, with these maps."""
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
            seconds=replace(found.seconds, total=watch.seconds()),
        ),
        levels=(Level(found.cost, len(maps), found.complete),) if found.within else (),
        shared=None,
        trace=joint,
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
    old: Trace, ssh_map: SSHMap, trace: Trace, problem: Problem, watch: Watch, since: int
) -> Solution | None:
    """Call `laid`; None if it takes too long. After Ctrl-C, give the new drives new places."""
    try:
        with suppress(LimitError), heeding(watch.later(LAYING)):
            return laid(old, ssh_map, trace, problem, watch, since)
    except KeyboardInterrupt:
        if (grown := _grown(ssh_map, old, problem)) is None:
            raise
        return unproven(grown, ssh_map, old, problem, watch, "interrupted")
    return None


def _named(solution: Solution, ssh_map: SSHMap, corrections: Corrections | None) -> Solution:
    """Give the maps the names that a person gave or, without corrections, those of the old map."""
    assert solution.trace is not None
    said = Corrections.of_names(ssh_map, solution.drives) if corrections is None else corrections
    return with_names(said, solution, solution.trace)


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


def _existing(existing: object) -> tuple[Trace, SSHMap]:
    """Return the trace of a solution and its first map. Raises SolverError if one is missing."""
    mend = "take what solve returned, or Solution.load"
    solution = an_instance("onto", existing, Solution, SolverError, mend=mend)
    if not solution.maps or solution.trace is None:
        raise SolverError(
            "onto: expected a solution with a map and its trace, got one without; read a file that "
            "solve -o wrote"
        )
    return solution.trace, solution.maps[0]


def _check_theory(theory: Theory, existing: Solution) -> None:
    """Raise SolverError if a theory allows faults, or lacks the places of the existing map."""
    if theory.has_faults or existing.theory.has_faults or existing.maps[0].faults:
        raise SolverError(
            "onto: expected a map without faults, got a theory that allows them; solve all drives "
            "together"
        )
    if theory.level == "causal" and existing.theory.level != "causal":
        raise SolverError(
            "onto: expected a topological theory, as the existing map has places, got "
            "level=causal; take Theory.topological() (solve --theory topological)"
        )


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


def _places_in(found: SSHMap) -> list[int | None]:
    """Return the place of each step of a map."""
    return [found.dstates[s].place for s in found.dstate_at]


def _broken(
    dstates: Sequence[int], places: Sequence[int | None], digest: Digest, ssh_map: SSHMap
) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
    """Find what a map of a digest and a new drive changes in the existing map.

    The map is given by the dstate and the place of each step. Returns pairs of dstates of the
    existing map that are merged, and pairs of dstates whose places are merged or split. A dstate
    that is split is paired with itself.
    """
    number: dict[int, int] = {}
    place: dict[int, int | None] = {}
    split = set[tuple[int, int]]()
    for s, x, p in zip(digest.labels, dstates, places, strict=False):
        place.setdefault(s, p)
        if number.setdefault(s, x) != x:
            split.add((s, s))
    pairs = [pair for pair in combinations(number, 2) if digest.must_differ(*pair)]
    merged = {(s, x) for s, x in pairs if number[s] == number[x]}
    moved = {
        (s, x)
        for s, x in pairs
        if (ssh_map.dstates[s].place == ssh_map.dstates[x].place) != (place[s] == place[x])
        and ssh_map.dstates[s].place is not None
    }
    return sorted(split | merged), sorted(moved)


def _weighed(found: Solution, digest: Digest, ssh_map: SSHMap) -> Weighed | None:
    """Return the costs of the maps found, with the rivals that keep the existing map."""
    if found.weighed is None:
        return None
    rivals = tuple(
        rival
        for rival in found.weighed.rivals
        if not any(_broken(rival.dstates, rival.places or rival.dstates, digest, ssh_map))
    )
    return replace(found.weighed, rivals=rivals) if rivals else None


def _contradiction(
    old: Trace, trace: Trace, ssh_map: SSHMap, digest: Digest, found: Solution
) -> SolverError:
    """Make the error that says what contradicts the existing map, and what to do."""
    reason, drives = "no map keeps the existing map", drives_of(old)
    if found.maps:
        best = found.maps[0]
        dstates, places = _broken(best.dstate_at, _places_in(best), digest, ssh_map)
        first = first_index_of(ssh_map.dstate_at)
        pairs = [
            f"{step_name(drives, first[s])} and {step_name(drives, first[x])}" for s, x in places
        ]
        parts = [counted(len(dstates), "dstates")] if dstates else []
        parts += [f"the places of {', '.join(pairs[:3])}"] if pairs else []
        reason = (
            f"the best map found, of {counted(len(best.dstates), 'dstates')}, changes "
            f"{' and '.join(parts)}"
        )
    new = ", ".join(drive.name for drive in drives_of(trace))
    if found.stopped in _LIMITS:
        return SolverError(
            f"onto: expected a map that keeps the existing one, found none for {new} before the "
            f"search ended ({found.stopped}); give it more time or memory"
        )
    return SolverError(
        f"onto: expected a drive that agrees with the existing map, got {new}: {reason}; solve all "
        "drives together (solve --together)"
    )
