"""Choose the engine for a theory and a trace."""

from __future__ import annotations

from collections.abc import Sequence

from ssh_abduction.solver.asp import facts
from ssh_abduction.solver.sources.exact import prefixes
from ssh_abduction.solver.sources.exact.engine import AT_ONCE, Engine, Task
from ssh_abduction.solver.sources.exact.readable import StepEngine
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
