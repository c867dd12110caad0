"""Mend maps while the robot drives, for when clingo finds no minimal map in time.

To *mend* a map that later steps contradict, keep as many of its dstates (distinctive states: a
place and a heading) as possible, and add new dstates for what does not fit. The result satisfies
the axioms of the theory (`solver/engines/framed.py`), but need not be minimal. This needs a theory
that numbers the directions at each place (a frame).
"""

from __future__ import annotations

import time

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.online.background import BackgroundTask
from ssh_abduction.online.options import StepOptions
from ssh_abduction.solver import AT_ONCE, Watch
from ssh_abduction.theory.settle import Problem
from ssh_abduction.theory.speedups import Speedups, row
from ssh_abduction.theory.theory import Theory

# A first estimate: mending takes this many seconds times the square of the number of steps.
MENDING = 5e-7


class Mender:
    """Mends maps of a growing trace.

    A map is mended at once if the step has time for that, and in another process otherwise.

    Args:
        options: The time limit and the other options of a step.
    """

    def __init__(self, options: StepOptions) -> None:
        self.mending: BackgroundTask[SSHMap] | None = None  # under way in another process
        self.options = options
        self._seconds = MENDING

    def finished(self) -> SSHMap | None:
        """Take the map that the other process made; None if it is not done, or found none.

        The map may lack the last steps of the trace.
        """
        if self.mending and self.mending.done():
            mending, self.mending = self.mending, None
            return mending.result()
        return None

    def suits(self, trace: Trace, theory: Theory) -> bool:
        """Whether to mend maps.

        Steps need a time limit, the theory has to number the directions at each place, and the
        trace may not be too long.
        """
        return (
            self.options.time_limit is not None
            and row("visits").holds_for(theory)
            and len(trace) <= AT_ONCE
        )

    def mended(
        self, trace: Trace, theory: Theory, contradicted: SSHMap, began: float
    ) -> SSHMap | None:
        """Mend a map at once if this step has time for it, else in another process.

        Args:
            trace: The steps so far.
            theory: The theory, in which no field is "auto".
            contradicted: The best map of the steps before the last. The last step contradicts all
                known maps.
            began: When the step began, by `time.perf_counter`.

        Returns:
            The mended map of all steps; None if none was made at once.
        """
        steps, now, speedups = len(trace), time.perf_counter(), self.options.speedups
        assert self.options.time_limit is not None
        if self._seconds * steps**2 <= self.options.time_limit - (now - began):
            found = mended_map(trace, theory, contradicted, speedups)
            self._seconds = (time.perf_counter() - now) / steps**2
            return found
        self.mending = self.mending or BackgroundTask.begun(
            speedups, mended_map, trace, theory, contradicted, speedups
        )
        return None


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
    from ssh_abduction.solver import FramedEngine, Task  # loads numpy

    watch = watch or Watch()
    found = FramedEngine(Task.of(Problem.of(trace, theory), watch, speedups)).map_mended_from(
        known.dstate_at
    )
    return found.map if found else None
