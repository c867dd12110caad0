"""Maps of a trace that a robot is still driving: made of guesses, or mended, in no time or in a process of their own. For theories where places have frames.

Consistent by the axioms of the theory (`engines/framed.py`), but not minimal for sure. A map that the trace contradicts is mended: dstates
stay as far as they can, what does not fit is something new, and separate paths (`engines/paths.py`) say whether that is a map. Where that
takes longer than a step may, it is done in the other process, in which else one guess after another is made a map.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.odometry import Odometry
from ssh_abduction.data.trace import Step, Trace
from ssh_abduction.online.background import Beside
from ssh_abduction.solver import FramedEngine, Task, Watch, has_processors, in_process
from ssh_abduction.theory.speedups import Speedups
from ssh_abduction.theory.theory import Theory


def guessed_map(trace: Trace, theory: Theory, speedups: Speedups, watch: Watch) -> SSHMap | None:
    """A map made of a guess, if one is found soon."""
    found = FramedEngine(Task.of(trace, theory, watch, speedups)).map_of_guess()
    return found.map if found else None


def mended_map(
    trace: Trace, theory: Theory, known: SSHMap, speedups: Speedups, watch: Watch | None = None
) -> SSHMap | None:
    """A map of a trace near one of its first steps that its later steps contradict, if there is one in which all that does not fit is new."""
    watch = watch or Watch()
    found = FramedEngine(Task.of(trace, theory, watch, speedups)).map_mended_from(known.labels)
    return found.map if found else None


class MapGuess(Beside[SSHMap]):
    """A map of a trace that grows, made in a process of its own.

    A map is made of a guess, unless one is known. As the trace has grown meanwhile, and may contradict it, it is mended at the end.

    steps     those of the trace so far; more may be appended
    odometry  of the trace
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
        """None where there is no second processor, or guesses are not wanted."""
        wanted = speedups.annealed and speedups.processes and has_processors(speedups)
        return MapGuess(steps, odometry, theory, speedups, known) if wanted else None

    def map(self) -> SSHMap | None:
        """The map of the first steps, if one was found. Waits until that is known."""
        return self.result()


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
