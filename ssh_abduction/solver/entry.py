"""The functions that users call.

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
from ssh_abduction.data.corrections import Corrections
from ssh_abduction.data.drives import joined_drives, together
from ssh_abduction.data.errors import SolverError
from ssh_abduction.data.maps import SSHMap, check_of_trace
from ssh_abduction.data.trace import Trace, checked_trace
from ssh_abduction.runtime.clock import counting
from ssh_abduction.runtime.limits import Watch
from ssh_abduction.runtime.loggers import log_of
from ssh_abduction.solution.corrected import obeyed, with_correction_warnings, with_names
from ssh_abduction.solution.result import Solution
from ssh_abduction.solution.sharing import Backbone
from ssh_abduction.solution.values import Progress
from ssh_abduction.solver.onto import Solving, joint_with, solve_onto
from ssh_abduction.solver.parts import Limits, Start
from ssh_abduction.solver.search import Search
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
