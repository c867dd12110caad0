"""Make maps of a growing trace from guesses, in another process.

A guess labels each step with a dstate (distinctive state: a place and a direction), and may
contradict an axiom. Guesses are made for theories with frames, which number the directions at each
place.

The maps satisfy the axioms of the theory (`solver/engines/framed.py`), but need not be minimal. To
*mend* a map that later steps contradict, keep as many of its dstates as possible and add new
dstates for what does not fit. Then `solver/engines/paths.py` looks for paths, and so decides
whether the result is a map.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.odometry import Odometry
from ssh_abduction.data.trace import Step, Trace
from ssh_abduction.online.background import BackgroundTask
from ssh_abduction.solver import FramedEngine, Task, Watch, has_processors, in_process
from ssh_abduction.theory.settle import Problem
from ssh_abduction.theory.speedups import Speedups
from ssh_abduction.theory.theory import Theory


def guessed_map(trace: Trace, theory: Theory, speedups: Speedups, watch: Watch) -> SSHMap | None:
    """Make a map from a guess; None if none is found soon.

    Args:
        trace: The trace.
        theory: The theory, in which no field is "auto".
        speedups: The speed-ups that are on.
        watch: Limits the work, and can interrupt it.
    """
    found = FramedEngine(Task.of(Problem.of(trace, theory), watch, speedups)).map_of_guess()
    return found.map if found else None


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


class MapGuess(BackgroundTask[SSHMap]):
    """A background task that makes a map of a growing trace in another process.

    The trace grows meanwhile and may contradict the map. So the task mends the map before it ends.

    Args:
        steps: The steps of the trace so far. The caller may append more to this list.
        odometry: The noise model of the trace's displacements.
        theory: The theory, in which no field is "auto".
        speedups: The speed-ups that are on.
        known: A map of the first steps, to be mended; None makes a map from a guess first.
    """

    def __init__(
        self,
        steps: Sequence[Step],
        odometry: Odometry | None,
        theory: Theory,
        speedups: Speedups,
        known: SSHMap | None = None,
    ) -> None:
        super().__init__(partial(_make, steps, odometry, theory, speedups, known))

    @staticmethod
    def begun(
        steps: Sequence[Step],
        odometry: Odometry | None,
        theory: Theory,
        speedups: Speedups,
        known: SSHMap | None = None,
    ) -> MapGuess | None:
        """Start and return the task; None with only one processor, or without guesses."""
        wanted = speedups.annealed and speedups.processes and has_processors()
        return MapGuess(steps, odometry, theory, speedups, known) if wanted else None


def _make(
    steps: Sequence[Step],
    odometry: Odometry | None,
    theory: Theory,
    speedups: Speedups,
    known: SSHMap | None,
    watch: Watch,
) -> SSHMap | None:
    """Do the work of a `MapGuess`. Arguments are as there."""
    known = known or in_process(
        guessed_map, Trace(tuple(steps), odometry=odometry), theory, speedups, watch=watch
    )
    if known and len(steps) > len(known.dstate_at):
        known = in_process(
            mended_map, Trace(tuple(steps), odometry=odometry), theory, known, speedups, watch=watch
        )
    return known
