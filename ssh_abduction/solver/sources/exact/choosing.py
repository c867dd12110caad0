"""Choose the engine for a theory and a trace, and find maps that cost more than the minimum.

Solving a prefix of the trace is enough only for minimal maps (`prefixes.py`). A map with one dstate
more may become minimal when it is cut to a prefix. So here the readable encodings
(`encodings/*.lp`) get the whole trace, and a rule that fixes the number of dstates.

If the theory minimises paths or places first, their number is fixed instead. The number of excuses
(pairs of paths to which an axiom is not applied) is never fixed: adding an excuse never makes a map
inconsistent.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.solution.values import Status
from ssh_abduction.solver.asp import facts
from ssh_abduction.solver.asp.control import Asker
from ssh_abduction.solver.board import Judging, Known
from ssh_abduction.solver.sources.exact import prefixes
from ssh_abduction.solver.sources.exact.engine import AT_ONCE, Engine, Task
from ssh_abduction.solver.sources.exact.readable import StepEngine
from ssh_abduction.theory.fields import Count
from ssh_abduction.theory.speedups import row
from ssh_abduction.theory.theory import Theory

# Solve traces with at most this many steps directly. This is faster than naming dstates or merging
# steps first.
FEW_STEPS = 24
# With faults and places, use the readable encodings only for traces of at most this many steps.
# Longer traces would take too much memory.
READABLE = 60


def may_name(task: Task) -> bool:
    """Whether to use an engine that gives dstates names, and finds them before places and paths."""
    return task.speedups.names and len(task.trace) > FEW_STEPS


def takes_all(task: Task) -> bool:
    """Whether the length of the trace suits an engine that takes the whole trace at once."""
    return FEW_STEPS < len(task.trace) <= AT_ONCE


def new_engine(task: Task) -> Engine:
    """Make the engine that suits the theory and the length of the trace. Its prefix is empty."""
    # Engines are imported here, one at a time, as loading them and numpy takes longer than solving
    # a short trace.
    if may_name(task) and row("named dstates with faults").holds_for(task.theory):
        from ssh_abduction.solver.sources.exact.faulty import FaultyEngine

        return FaultyEngine(task)
    if may_name(task) and not task.theory.has_faults:
        from ssh_abduction.solver.sources.exact.labels_first import LabelsFirst

        return LabelsFirst(task)
    return step_engine(task)


def preload_engine(theory: Theory) -> None:
    """Import the engine that long traces need, so that no step of a robot waits for the import."""
    if theory.level == "causal" or row("visits").holds_for(theory):
        import ssh_abduction.solver.sources.exact.labels_first  # noqa: F401


def labelling_engine(task: Task, labels: Sequence[int]) -> Engine:
    """Make the engine that finds dstates first, if it can begin with these dstates of steps."""
    engine = new_engine(task)
    if labels and isinstance(engine, StepEngine) and takes_all(task) and task.speedups.ways:
        from ssh_abduction.solver.sources.exact.labels_first import LabelsFirst

        return LabelsFirst(task, labels)
    return engine


def step_engine(task: Task) -> StepEngine:
    """Make a `StepEngine`, for any theory. With `path_names` it begins with few names for paths."""
    most = facts.most_paths(task.trace, task.theory, len(task.trace))
    names = min(prefixes.FIRST_PATHS, most) if task.speedups.path_names else most
    return StepEngine(task, names)


class NearMinimal:
    """Lists the maps that cost more than the minimum, with an engine for the whole trace."""

    def __init__(
        self, task: Task, judging: Judging, most: int, report: Callable[[], None], before: Asker
    ) -> None:
        """Prepare an engine for `most` maps (0: all). Its clocks go on from those of `before`."""
        self._task = replace(task, speedups=replace(task.speedups, prefixes=False))
        self._judging, self._most, self._report = judging, most, report
        self.engine = step_engine(self._task)
        self.engine.asker.ground_seconds = before.ground_seconds
        self.engine.asker.solve_seconds = before.solve_seconds

    def maps(
        self, minimal: tuple[int, ...], within: int
    ) -> Iterator[tuple[SSHMap, tuple[int, ...]]]:
        """Yield the maps with their preferred counts, the most important one first.

        `minimal` has the preferred counts of minimal maps. The first count that is not excuses may
        be larger by up to `within`.
        """
        count = counted_first(self._task.theory)
        assert count is not None
        least = minimal[self._task.theory.priorities.index(count)]
        self.engine.grow(len(self._task.trace))
        # No count exceeds the number of steps.
        for number in range(least + 1, min(least + within, len(self._task.trace)) + 1):
            self.engine.ask_for(number, count)
            known = Known(self._task.theory)
            found = prefixes.Prefixes(
                self._task, known, self._judging, self.engine, self._most, self._report
            )
            found.find_minimum()
            if known.status is Status.OPTIMAL:
                yield from ((ssh_map, known.cost) for ssh_map in found.minimal_maps())
            assert isinstance(found.engine, StepEngine)
            self.engine = found.engine


def counted_first(theory: Theory) -> Count | None:
    """Return the first count that a theory minimises, apart from excuses; None if there is none."""
    return next((name for name in theory.priorities if name != "excuses"), None)
