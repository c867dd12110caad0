"""Mend maps of a growing trace, at once or in another process.

To *mend* a map that later steps contradict, keep as many of its dstates (distinctive states: a
place and a heading) as possible, and add new dstates for what does not fit. The result satisfies
the axioms of the theory (`solver/engines/framed.py`), but need not be minimal. This needs a theory
that numbers the directions at each place (a frame).
"""

from __future__ import annotations

from functools import partial

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.online.background import BackgroundTask
from ssh_abduction.solver import FramedEngine, Task, Watch, has_processors, in_process
from ssh_abduction.theory.settle import Problem
from ssh_abduction.theory.speedups import Speedups
from ssh_abduction.theory.theory import Theory


def mended_map(
    trace: Trace, theory: Theory, known: SSHMap, speedups: Speedups, watch: Watch | None = None
) -> SSHMap | None:
    """Mend a map of the first steps of a trace that the later steps contradict.

    Args:
        trace: The whole trace.
        theory: The theory, in which no field is "auto".
        known: The map of the first steps.
        speedups: The speed-ups that are on.
        watch: Limits the work, and can interrupt it; None for no limit.

    Returns:
        A map of the whole trace, with new dstates for whatever does not fit; None if none is found.
    """
    watch = watch or Watch()
    found = FramedEngine(Task.of(Problem.of(trace, theory), watch, speedups)).map_mended_from(
        known.dstate_at
    )
    return found.map if found else None


class MapMending(BackgroundTask[SSHMap]):
    """A background task that mends a map in another process.

    Args:
        trace: The steps so far.
        theory: The theory, in which no field is "auto".
        speedups: The speed-ups that are on.
        known: A map of the first steps.
    """

    def __init__(self, trace: Trace, theory: Theory, speedups: Speedups, known: SSHMap) -> None:
        super().__init__(partial(_mended, trace, theory, speedups, known))

    @staticmethod
    def begun(trace: Trace, theory: Theory, speedups: Speedups, known: SSHMap) -> MapMending | None:
        """Start and return the task; None with only one processor, or without `processes`."""
        can_begin = speedups.processes and has_processors()
        return MapMending(trace, theory, speedups, known) if can_begin else None


def _mended(
    trace: Trace, theory: Theory, speedups: Speedups, known: SSHMap, watch: Watch
) -> SSHMap | None:
    return in_process(mended_map, trace, theory, known, speedups, watch=watch)
