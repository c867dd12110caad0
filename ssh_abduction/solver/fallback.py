"""Make some map of the whole trace and prove a bound, after a search was stopped."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import zip_longest

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.runtime.clock import counts_work, each_looking, heeding
from ssh_abduction.solver.answer import Answer
from ssh_abduction.solver.asp.limits import LimitError, Watch
from ssh_abduction.solver.candidates import has_quick_map
from ssh_abduction.solver.map_list import Priced, note
from ssh_abduction.solver.parts import Parts
from ssh_abduction.solver.values import Status
from ssh_abduction.theory.theory import Theory

# If the time limit stops a search, making and checking a map may take OVERTIME seconds more, plus
# OVERTIME_SHARE of the limit.
OVERTIME, OVERTIME_SHARE = 0.5, 0.05
# After Ctrl-C, or at the memory limit, it may take this many seconds.
INTERRUPTED = 0.6
# If a stopped search has no map, it looks for a clash in stretches of this many steps, for at most
# CLASHING seconds. A short stretch takes a few hundredths of a second.
STRETCHES, CLASHING = (2, 3, 4, 6, 8, 12), 0.5
# After these, it looks in stretches of whole visits to places, of up to VISITS visits.
VISITS = 12


def fall_back(parts: Parts, answer: Answer) -> None:
    """Make some map of the whole trace if none is known, and prove a bound from distinct steps.

    If the search was not stopped, or has proven its minimum, do nothing. The map, the bound and the
    status go to `parts.known`.
    """
    known = parts.known
    if not known.stopped or known.status is Status.OPTIMAL:
        return
    parts.watch.start()  # what is done after the limit counts, too
    with suppress(KeyboardInterrupt):
        parts.candidates.sketch(overtime(parts))
    answer.count_apart()
    if known.best is not None and known.status is Status.UNKNOWN:
        known.status = Status.FEASIBLE


def clash_in(
    trace: Trace,
    theory: Theory,
    stretches: Iterable[range],
    maps_of: Callable[[Trace, Theory], tuple[Sequence[SSHMap], bool]],
) -> range | None:
    """Find a stretch of consecutive steps that has no map by itself. Then the trace has no map.

    `maps_of` solves a trace, and returns some maps and whether the answer is proven. Returns None
    if there is no such stretch, or if the theory allows faults. Also None if it has rules of the
    user, which may hold only for the whole trace.
    """
    if theory.has_faults or theory.rules:
        return None
    counting = theory.replace(weigh="count")
    bare = counting.replace(displacement="none")
    for found in each_looking(stretches):
        *steps, last = trace.steps[found.start : found.stop]
        if any(step.action and step.action.starts for step in steps):
            continue
        piece = Trace((*steps, replace(last, action=None)), odometry=trace.odometry)
        # The axiom one_pose compares the first steps of visits. So a stretch of several visits
        # must begin with a whole one.
        is_one_visit = not any(_begins_visit(trace, t) for t in found[1:])
        axioms = counting if is_one_visit or _begins_visit(trace, found.start) else bare
        part = axioms.of_steps(found.start, len(found))
        if has_quick_map(piece, part):
            continue
        maps, proven = maps_of(piece, part)
        if proven and not maps:
            return found
    return None


def _begins_visit(trace: Trace, step: int) -> bool:
    """Whether a visit to a place begins at a step."""
    return step == 0 or trace.actions[step - 1].kind != "turn"


def _stretches(trace: Trace, ends: Sequence[int]) -> Iterator[range]:
    """List stretches of steps that may clash, the shortest first. Each ends at one of `ends`."""
    for length in STRETCHES:
        yield from (range(max(t + 1 - length, 0), t + 1) for t in ends if length < len(trace))
    begins = [
        [i for i in range(t, -1, -1) if _begins_visit(trace, i)][1 : VISITS + 1] for t in ends
    ]
    # The whole trace is no stretch: its search would look for the same clash again, without end.
    for starts in zip_longest(*begins):
        yield from (
            range(i, t + 1)
            for i, t in zip(starts, ends, strict=True)
            if i is not None and t + 1 - i < len(trace)
        )


def late_clash(
    parts: Parts, maps_of: Callable[[Trace, Theory], tuple[Sequence[SSHMap], bool]]
) -> range | None:
    """Look for a short clash if a stopped search has no map.

    A clash is consecutive steps that have no map by themselves. It may end at a step that
    contradicted a sketch, or at a step that the theory asserts to be at the dstate or place of an
    earlier one. `maps_of` is as in `clash_in`. `parts.known` gets the status if there is a clash.
    """
    known, task, clash = parts.known, parts.task, None
    if known.best is not None or not known.stopped or known.status is not Status.UNKNOWN:
        return None
    # While a robot drives, the theory may already assert something about later steps.
    said = [max(pair) for pair in (*task.theory.same, *task.theory.same_place)]
    ends = dict.fromkeys((*parts.candidates.contradicting, *said))
    stretches = _stretches(task.trace, [end for end in ends if end < len(task.trace)])
    part = Watch().part(CLASHING, None if counts_work() else time.thread_time)
    with suppress(LimitError, KeyboardInterrupt), heeding(part.check):
        clash = clash_in(task.trace, task.theory, stretches, maps_of)
    if clash is not None:
        known.status, known.complete, known.stopped = Status.UNSATISFIABLE, True, None
    return clash


def best_map(parts: Parts) -> Iterator[Priced]:
    """If no map was yielded yet, check the best known map and yield it with its cost."""
    known, watch = parts.known, parts.watch
    watch.start()
    if known.status in (Status.FEASIBLE, Status.OPTIMAL) and not known.count and known.best:
        with suppress(LimitError), heeding(Watch().part(overtime(parts)).check):
            parts.judging.pass_map(known.best, parts.engine.size, watch.elapsed())
        watch.stop()
        known.count = 1
        note(parts, known.best, known.cost)
        yield known.best, known.cost
    watch.stop()


def overtime(parts: Parts) -> float:
    """Return the seconds that are left to make a map without a search, or to check one."""
    limits = parts.limits
    limit = limits.time_limit if limits.work_limit is None else limits.work_limit
    if parts.known.stopped != parts.limit_reached or limit is None:
        return INTERRUPTED
    return max(parts.watch.left() + OVERTIME_SHARE * limit + OVERTIME, 0.0)
