"""Choose the engine for a theory and a trace."""

from __future__ import annotations

from ssh_abduction.solver import prefixes
from ssh_abduction.solver.asp.facts import readable
from ssh_abduction.solver.engines.base import AT_ONCE, Engine, Task
from ssh_abduction.solver.engines.stepwise import StepEngine
from ssh_abduction.theory.speedups import row

# Traces with at most this many steps are solved directly, which is faster than naming dstates or
# merging steps first.
FEW_STEPS = 24
# Traces of at most this many steps are given to the readable encodings, which know places and
# faults. Longer ones would take too much memory.
READABLE = 60
# After this many seconds with the step engine, check whether the dstates are known without a
# search. The check loads numpy.
SETTLE_AFTER = 0.15
# After this many seconds with the step engine, or this share of the time left, go on with an
# engine that finds dstates first. Most traces are solved by then.
STEPWISE = 1.0
STEPWISE_SHARE = 0.4


def may_name(task: Task) -> bool:
    """Whether dstates can be found before places and paths, and the trace is long enough."""
    return task.speedups.names and len(task.trace) > FEW_STEPS


def takes_all(task: Task) -> bool:
    """Whether an engine for named dstates could take the whole trace."""
    return FEW_STEPS < len(task.trace) <= AT_ONCE


def new_engine(task: Task) -> Engine:
    """The engine for the theory and the length of the trace, still without steps."""
    if may_name(task):
        # Imported here, as loading numpy takes longer than solving a short trace.
        from ssh_abduction.solver.engines.causal import CausalEngine
        from ssh_abduction.solver.engines.faulty import FaultyEngine
        from ssh_abduction.solver.engines.framed import FramedEngine

        if row("named dstates with faults").holds_for(task.theory):
            return FaultyEngine(task)
        if not task.theory.has_faults:
            return CausalEngine(task) if task.theory.level == "causal" else FramedEngine(task)
    return step_engine(task)


def step_engine(task: Task) -> StepEngine:
    """The engine for any theory. It begins with few names for paths, if that is allowed."""
    most = readable.most_paths(task.trace, task.theory, len(task.trace))
    names = min(prefixes.FIRST_PATHS, most) if task.speedups.path_names else most
    return StepEngine(task, names)
