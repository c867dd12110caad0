"""Finds maps for a theory with star=pattern by assuming that places have frames.

A place has a frame if its directions are numbered, and turns rotate by known right angles. Then the
dstates hardly depend on places and paths (`engines/framed.py`), and a good map of thousands of
steps takes seconds. With star=pattern clingo gets all axioms for each step, and only manages a few
dozen steps. But each map of `Theory.with_frames` is also a map of the theory with star=pattern. So
if the world has frames, this finds the true map or one that is about as small.
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
    """Find ever cheaper maps of a trace in which places have frames.

    Args:
        problem: The trace, and a theory with star=pattern and all defaults filled in.
        watch: The limits.
        speedups: The speed-ups that are on.

    Yields:
        Maps of the trace, each cheaper than the one before. The last one is the best map in which
        places have frames.
    """
    task = Task.of(problem.changed(theory=problem.theory.with_frames()), watch, speedups)
    engine = FramedEngine(task)
    engine.grow(len(problem.trace))
    for found in engine.improving_maps():
        yield found.map.without_headings()
