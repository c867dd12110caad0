"""Maps of theories that do not ask for frames, found as if places had them.

Where places have frames, dstates are all but settled before any place or path is (`engines/framed.py`): traces of thousands of steps have
good maps in seconds. In other theories clingo is given all axioms for each step, and comes to a few dozen steps of a world that keeps
looking new. But each map of `Theory.with_frames` is one of theirs, so where the world has frames, its map is found, or one about as small;
and it is minimal where it costs no more than what is proven of a prefix.

Where a trace has no stars, what is seen all around follows from what turns showed, if it does; that takes the place of stars.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.solver.asp.limits import Watch
from ssh_abduction.solver.engines.base import Task
from ssh_abduction.solver.engines.framed import FramedEngine
from ssh_abduction.solver.steps.chart import Chart
from ssh_abduction.solver.steps.log import Log
from ssh_abduction.theory.settle import Problem
from ssh_abduction.theory.speedups import Speedups


def maps_with_frames(problem: Problem, watch: Watch, speedups: Speedups) -> Iterator[SSHMap]:
    """Maps of a trace, each with fewer dstates than the one before, or as many and better paths, and the last one the best in which places have frames.

    theory  what it asks for, with star settled; none where it has no theory with frames
    """
    trace, theory = problem.trace, problem.theory
    around: Mapping[int, Sequence[int]] | None = None
    framed = theory.with_frames()
    if framed is None:
        return
    if theory.star == "none":
        trace = trace.without_stars()
        around = _around(trace, Log(trace, theory))
    task = Task.of(problem.changed(trace, framed), watch, speedups)
    engine = FramedEngine(task, around, soon=0.0)
    try:
        engine.grow(len(trace))
        for found in engine.improving_maps():
            yield found.map if theory.star == "frame" else found.map.without_headings()
    finally:
        engine.settle()


def _around(trace: Trace, log: Log) -> Mapping[int, Sequence[int]]:
    """What is seen all around where something is seen ahead; the same everywhere, if turns do not tell."""
    return Chart.around(trace, log, len(trace)) or dict.fromkeys(log.seen, (0, 0, 0, 0))
