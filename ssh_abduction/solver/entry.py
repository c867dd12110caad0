"""The functions that users call, and the names and corrections of a person that they obey.

>>> from ssh_abduction import Theory, Trace, solve
>>> trace = Trace.from_steps(views=["end", "end", "end"], actions=["travel", "around"])
>>> solution = solve(trace, Theory.topological())
>>> solution.status.value, solution.cost.dstates, solution.complete
('optimal', 3, True)
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

from ssh_abduction.data.checks import an_instance
from ssh_abduction.data.corrections import (
    Corrections,
    checked_corrections,
    direction_in_words,
)
from ssh_abduction.data.drives import (
    Drive,
    drives_of,
    fingerprints_of,
    joined_drives,
    step_name,
    step_of,
    together,
)
from ssh_abduction.data.errors import SolverError, brief, named
from ssh_abduction.data.maps import SSHMap, check_of_trace
from ssh_abduction.data.parts_of_dstates import number_at
from ssh_abduction.data.star import with_gateway
from ssh_abduction.data.step import Step
from ssh_abduction.data.trace import Trace, checked_trace
from ssh_abduction.data.words import noun_of
from ssh_abduction.runtime.clock import counting
from ssh_abduction.runtime.loggers import log_of
from ssh_abduction.solution.result import Solution
from ssh_abduction.solution.sharing import Backbone
from ssh_abduction.solution.values import Progress
from ssh_abduction.solver.asp.limits import Watch
from ssh_abduction.solver.onto import Solving, joint_with, solve_onto
from ssh_abduction.solver.parts import Limits, Start
from ssh_abduction.solver.search import Search
from ssh_abduction.theory.evidence.of_steps import are_alike
from ssh_abduction.theory.speedups import ALL, Speedups
from ssh_abduction.theory.theory import Theory, checked_theory

_log = log_of(__name__)
# If the time limit is over, a search gets this many seconds to find any map.
LEAST_SECONDS = 1e-9


def solve(
    trace: Trace | Sequence[Trace] | Iterator[Trace],
    theory: Theory | None = None,
    *,
    time_limit: float | None = None,
    max_maps: int | None = 100,
    within: int = 0,
    memory_limit: int | None = None,
    work_limit: float | None = None,
    speedups: Speedups = ALL,
    on_progress: Callable[[Progress], None] | None = None,
    corrections: Corrections | None = None,
    onto: Solution | None = None,
) -> Solution:
    """Find the minimal maps of a trace.

    Ctrl-C ends the search like a limit does. To get maps one by one, use `Search`. If the best map
    joins only some of several drives, the log has a warning (`logging`).

    Args:
        trace: The trace; or several traces of one building, for their joint maps
            (`data.together`). `ssh_map.labels` has one sequence of labels for each trace.
        theory: The axioms and the preference; Theory.topological() by default.
        time_limit: Seconds of wall-clock time. At this limit the best answer so far is returned.
        work_limit: Units of work, at which the best answer so far is returned. A unit is about a
            second of a quiet core. One trace, theory and work limit give one answer, on each
            machine and under each load, unless the time limit comes first.
        max_maps: List at most this many maps; None lists all. After the last map, the search goes
            on for a second, or for a tenth of the time so far if that is more. The answer is
            `complete` only if this proves that no further map exists.
        within: Also list maps with up to this many dstates more than the minimum: for each number
            of dstates, the best maps with that number. If the theory prefers few paths or places
            first, paths or places are counted instead. If maps are compared by cost, `within` is in
            nats: all maps that cost up to this many nats more are listed.
        memory_limit: MiB of memory. The search stops when the process reaches this peak.
        speedups: The speed-ups that are on. None of them changes the answer.
        on_progress: A function that is called now and then with a `Progress`.
        corrections: Names and corrections of a person, to be obeyed.
        onto: The solution of earlier drives, with their trace. The new drive is added to its first
            map: all maps found have the dstates and places of that map. The new drive may join its
            pieces. This takes about as long as solving the new drive.

    Returns:
        The maps, their cost, and what is proven about them.

    Raises:
        TraceError: A view, a star or the kind of an action that the theory needs is missing.
        TheoryError: The theory needs stars or displacements, but the trace has none; or the theory
            names steps that the trace does not have.
        SolverError: A limit, `max_maps` or `within` is out of range; or the trace contradicts the
            map of `onto`.
        MapError: The corrections are of other drives, or contradict the trace.

    Reference:
        Kuipers & Beeson 2002, "Bootstrap Learning for Place Recognition", step 2.
    """
    joint = together(trace) if isinstance(trace, list | tuple | Iterator) else checked_trace(trace)
    Limits(time_limit, memory_limit, work_limit=work_limit)  # checks them
    watch = Watch(time_limit, memory_limit, work=work_limit)
    watch.start()

    def find(trace: Trace, theory: Theory, known: Sequence[SSHMap] = ()) -> Solution:
        search = Search(
            trace,
            theory,
            time_limit=None if time_limit is None else max(watch.seconds_left(), LEAST_SECONDS),
            work_limit=None if work_limit is None else max(watch.left(), LEAST_SECONDS),
            max_maps=max_maps,
            within=within,
            memory_limit=memory_limit,
            speedups=speedups,
            on_progress=on_progress,
            _start=Start(known=tuple(known)),
        )
        return search.solution(tuple(search))

    if onto is not None:
        joint, theory, standing = joint_with(joint, onto, theory)
    theory = checked_theory(theory)
    theory.check_steps(joint)
    names = corrections
    if corrections is not None:
        joint, theory = obeyed(corrections, joint, theory)
    if onto is None:
        solution = find(joint, theory)
    else:
        with counting(watch.counts_work):
            solving = Solving(find, speedups, watch)
            solution = solve_onto(joint, onto, theory, standing, solving)
        if names is None:
            names = Corrections.of_names(standing, solution.drives)
    if names is not None:
        solution = with_names(names, solution, joint)
    return _with_warnings(solution, corrections)


def _with_warnings(solution: Solution, corrections: Corrections | None) -> Solution:
    """Add warnings about corrections, and log them, and which drives share no place."""
    said = len(solution.support.warnings)
    if corrections is not None:
        solution = with_correction_warnings(corrections, solution)
    if solution.maps and len(joined_drives(solution.drives, solution.maps[0])) > 1:
        _log.warning("%s", solution.joined)
    for warning in solution.support.warnings[said:]:
        _log.warning("%s", warning)
    return solution


def find_backbone(
    solution: Solution,
    trace: Trace | None = None,
    *,
    time_limit: float | None = None,
    memory_limit: int | None = None,
    work_limit: float | None = None,
) -> Backbone | None:
    """Find the backbone: what all minimal maps share, also those that the solution does not list.

    Solve the trace again. Then let clingo look for a minimal map that contradicts what all known
    ones share, until it proves that there is none. If the solution already has a proven backbone,
    or has no minimal map, return its backbone at once.

    >>> from ssh_abduction import Theory, Trace, solve
    >>> solution = solve(Trace.load("examples/aces3-route.jsonl")[:16], max_maps=1)
    >>> solution.backbone.proven, find_backbone(solution).proven
    (False, True)

    Args:
        solution: The answer of `solve` whose minimal maps are compared.
        trace: The trace that was solved. Only needed if the solution was read from a file without
            its trace.
        time_limit: Seconds of wall-clock time; None for no limit.
        memory_limit: MiB of memory that the process may use at its peak; None for no limit.
        work_limit: Units of work, as in `solve`; None for no limit.

    Returns:
        The backbone; None if no minimal map is known. It is not `proven` if a limit or Ctrl-C
        came before the proof, or if the theory allows no proof.

    Raises:
        SolverError: The solution has no trace, and none is given.
        MapError: The maps are not of the given trace.
    """
    an_instance("solution", solution, Solution, SolverError, mend="take what solve returned")
    Limits(time_limit, memory_limit, work_limit=work_limit)  # checks them
    trace = solution.trace if trace is None else checked_trace(trace)
    minimal, known = solution.minimal_maps, solution.backbone
    if known is None or known.proven or not minimal or solution.theory.weigh == "cost":
        return known
    if trace is None:
        raise SolverError("trace: expected the trace that was solved, got none; give it")
    views = "functional_view" in solution.theory.hard
    check_of_trace(minimal, trace, "solution", views=views)
    search = Search(
        trace,
        solution.theory,
        time_limit=time_limit,
        memory_limit=memory_limit,
        work_limit=work_limit,
        max_maps=1,
        _start=Start(reasons=True, known=minimal),
    )
    cost = solution.costs[0].preferred_by(solution.theory)
    for ssh_map in minimal:
        search.parts.rivals.add(ssh_map, cost)
    found = search.solution(tuple(search.unranked())).backbone
    return found and replace(found, drives=known.drives)


def obeyed(corrections: Corrections, trace: Trace, theory: Theory) -> tuple[Trace, Theory]:
    """Return the trace and the theory that obey the corrections of a person.

    Pairs of steps are added to the fields same, different, elsewhere and same_place of the theory.
    Sentences about gateways that are open or closed change the stars of their steps.

    Args:
        corrections: The corrections. Sentences about drives that the trace lacks have no effect.
        trace: The trace of the drives that the corrections are about.
        theory: The theory to which the pairs of steps are added.

    Raises:
        MapError: The corrections are of other drives, or contradict the trace.
    """
    checked_corrections(corrections).check_drives(dict(fingerprints_of(checked_trace(trace))))
    said = corrections.assertions(trace)
    pairs = {
        kind: tuple(dict.fromkeys((*getattr(checked_theory(theory), kind), *found)))
        for kind, found in said.items()
    }
    return corrections.corrected(trace), theory.replace(**pairs)


def with_names(corrections: Corrections, solution: Solution, trace: Trace) -> Solution:
    """Return a solution whose maps have the names that a person gave."""
    drives = drives_of(trace)
    maps = tuple(corrections.named(ssh_map, drives) for ssh_map in solution.maps)
    return replace(solution, maps=maps)


def with_correction_warnings(corrections: Corrections, solution: Solution) -> Solution:
    """Add warnings about drives that contradict a corrected gateway, and about unused names.

    A correction changes only the stars of the steps that it names. If another drive saw the gateway
    as it was before, its steps cannot be at the place any more. Without stars, they can be there.

    Args:
        corrections: The corrections that the solution obeys.
        solution: The solution, with its trace.
    """
    if not solution.maps or solution.trace is None:
        return solution
    drives = drives_of(solution.trace)
    known = corrections.known_in(drives)
    named_maps = corrections.named(solution.maps[0], drives)
    said = (
        *_unused_names(known, named_maps, drives),
        *_contradictions(known, solution.trace, drives),
    )
    return replace(solution, support=solution.support.warning_of(*said))


def _unused_names(said: Corrections, ssh_map: SSHMap, drives: Sequence[Drive]) -> Iterator[str]:
    """Yield a warning for each name that a map does not have."""
    for naming in said.names:
        label = ssh_map.dstate_at[step_of(drives, naming.step)]
        used = ssh_map.name_of(naming.kind, number_at(ssh_map, naming.kind, label))
        if used != naming.name:
            why = (
                f"this step has no {naming.kind}; name another step"
                if used is None
                else f"this {naming.kind} is also {brief(used)}; rename or remove one of them"
            )
            yield (
                f"{named(said.source or 'corrections')}: {naming}: it is not shown: in the "
                f"first map, {why}"
            )


def _contradictions(said: Corrections, trace: Trace, drives: Sequence[Drive]) -> Iterator[str]:
    """Yield a warning for each other drive that saw what a corrected step saw before."""
    for passage in said.gateways:
        about = {step.rpartition(":")[0] for step, _ in passage.seen}
        before = [(trace.steps[step_of(drives, step)].as_seen(), way) for step, way in passage.seen]
        for drive in drives:
            ways = {
                step_name(drives, t): way
                for t in range(drive.first, drive.stop if drive.name not in about else 0)
                for seen, way in before
                if _looks_like(trace.steps[t], seen)
                and seen.star
                and with_gateway(seen.star, way, is_open=passage.is_open) != seen.star
            }
            if ways:
                step, way = next(iter(ways.items()))
                option = "--open" if passage.is_open else "--closed"
                yield (
                    f"{named(said.source or 'corrections')}: {passage}: it contradicts what "
                    f"{drive.name} saw at {noun_of('step', ways)} {', '.join(ways)}; say the same "
                    f"of {step} (correct {option} '{step} {direction_in_words(way)}'), or remove it"
                )


def _looks_like(step: Step, seen: Step) -> bool:
    """Whether two steps have one view, and stars that may show the same gateways."""
    if step.view is None or step.view != seen.view or not (step.gateways and seen.gateways):
        return False
    return are_alike(step.gateways, seen.gateways)
