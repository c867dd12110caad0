"""Maps of a theory with star=pattern, found as if places had frames.

If places have frames, dstates are nearly known before places and paths (engines/framed.py). So
traces of thousands of steps have good maps in seconds. With star=pattern clingo gets all axioms for
each step, and manages only a few dozen steps. But each map of `Theory.with_frames` is also a map of
this theory. So if the world has frames, its map or one about as small is found.
"""

from __future__ import annotations

from collections.abc import Iterator

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.solver.asp.limits import Watch
from ssh_abduction.solver.engines.base import Task
from ssh_abduction.solver.engines.framed import FramedEngine
from ssh_abduction.theory.settle import Problem
from ssh_abduction.theory.speedups import Speedups


def maps_with_frames(problem: Problem, watch: Watch, speedups: Speedups) -> Iterator[SSHMap]:
    """Improve a map in which places have frames.

    Args:
        problem: The trace and a settled theory with star=pattern.
        watch: The limits.
        speedups: The speed-ups that are on.

    Yields:
        Maps of the trace. Each has fewer dstates than the one before, or as many and better paths.
        The last one is the best in which places have frames.
    """
    task = Task.of(problem.changed(theory=problem.theory.with_frames()), watch, speedups)
    engine = FramedEngine(task, soon=0.0)
    try:
        engine.grow(len(problem.trace))
        for found in engine.improving_maps():
            yield found.map.without_headings()
    finally:
        engine.settle()
