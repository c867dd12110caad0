"""Makes maps of a growing trace from guesses, in another process. For places with frames.

The maps are consistent by the axioms of the theory (`solver/engines/framed.py`), but perhaps not
minimal. A map that the trace contradicts is *mended*: its dstates stay as far as possible, and
what does not fit becomes new. Separate paths (`solver/engines/paths.py`) then decide whether the
result is a map.
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
    """A map made of a guess, if one is found soon."""
    found = FramedEngine(Task.of(Problem.of(trace, theory), watch, speedups)).map_of_guess()
    return found.map if found else None


def mended_map(
    trace: Trace, theory: Theory, known: SSHMap, speedups: Speedups, watch: Watch | None = None
) -> SSHMap | None:
    """Mend a map of the first steps of a trace that the later steps contradict.

    Returns:
        A map of the trace with new dstates for whatever does not fit; None if there is none.
    """
    watch = watch or Watch()
    found = FramedEngine(Task.of(Problem.of(trace, theory), watch, speedups)).map_mended_from(
        known.labels
    )
    return found.map if found else None


class MapGuess(BackgroundTask[SSHMap]):
    """A map of a growing trace, made in another process from a guess, or from a known map.

    The trace grows meanwhile and may contradict the map, so the map is mended at the end.

    Args:
        steps: The steps of the trace so far. The caller may append more.
        odometry: The odometry of the trace.
        theory: The theory without `auto`.
        speedups: Which speed-ups are on.
        known: A map of the first steps to mend; None makes one from a guess.
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
        """Begin a guess; None without a second processor, or if guesses are switched off."""
        wanted = speedups.annealed and speedups.processes and has_processors(speedups)
        return MapGuess(steps, odometry, theory, speedups, known) if wanted else None


def _make(
    steps: Sequence[Step],
    odometry: Odometry | None,
    theory: Theory,
    speedups: Speedups,
    known: SSHMap | None,
    watch: Watch,
) -> SSHMap | None:
    known = known or in_process(
        guessed_map, Trace(tuple(steps), odometry=odometry), theory, speedups, watch=watch
    )
    if known and len(steps) > len(known.labels):
        known = in_process(
            mended_map, Trace(tuple(steps), odometry=odometry), theory, known, speedups, watch=watch
        )
    return known
