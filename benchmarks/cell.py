"""Run one tool on one trace, in this process, and print the result as JSON.

    python benchmarks/cell.py TOOL INSTANCE SEED SECONDS MIB [CLOCK]

TOOL is another program (a peer), ssh-abduction, or "ssh-abduction without" and names of speed-ups,
separated by commas. CLOCK is wall, or cpu: then seconds and limits are CPU seconds of this process.

A first line is printed when the clock starts, and a second line with the result. A signal ends the
process when its time is over. Loading programs, making the trace and checking the answer do not
count. A map is checked by the checker, and a peer's machine by running it along the trace.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import io
import json
import resource
import signal
import time
from dataclasses import asdict
from types import SimpleNamespace
from typing import Any

import numpy  # noqa: F401 - load it before the clock starts, as the search would load it later
from peers import PEERS, Machine, NotApplicableError
from suite import INSTANCES
from table import OURS, WITHOUT

from ssh_abduction import Solution, Theory, Trace
from ssh_abduction.checker.checker import check
from ssh_abduction.runtime import clock, limits
from ssh_abduction.runtime.limits import peak_memory
from ssh_abduction.solution import Status
from ssh_abduction.solver import Search
from ssh_abduction.theory import Speedups

AROUND = 300  # seconds for what the clock does not count, before and after
MARGIN = 0.1  # share of the limit that our solver gets in addition, to return its answer
SHARE = 0.8  # share of the memory that is our solver's own limit, for the same reason


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("tool", help="a peer, or ssh-abduction")
    parser.add_argument("instance", help="name of an instance of suite.py")
    parser.add_argument("seed", type=int)
    parser.add_argument("seconds", type=float, help="time limit")
    parser.add_argument("memory", type=int, help="address space in MiB")
    parser.add_argument("clock", choices=("wall", "cpu"), nargs="?", default="wall")
    options = parser.parse_args()
    tool, limit, space = options.tool, options.seconds, options.memory
    now, timer = time.perf_counter, signal.ITIMER_REAL
    if options.clock == "cpu":
        now, timer = cpu_seconds, signal.ITIMER_PROF
        count_processor_time()
    instance = INSTANCES[options.instance]
    end_after(AROUND)
    for module in PEERS[tool].modules if tool in PEERS else ():
        importlib.import_module(module)
    walk = instance.walk(options.seed)
    trace, theory = walk.trace, instance.theory
    resource.setrlimit(resource.RLIMIT_AS, (space * 2**20, -1))
    say(images=len(trace), true_dstates=len(set(walk.truth)) or None, cpu=cpu_seconds())

    began, cpu = now(), cpu_seconds()
    answer: Any = None
    outcome: dict[str, Any] = {}
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            if tool.startswith(OURS):
                end_after(limit * (1 + MARGIN) + 1, timer)
                speedups = Speedups.without(tool.removeprefix(OURS).removeprefix(WITHOUT))
                search = Search(
                    trace,
                    theory,
                    time_limit=limit,
                    memory_limit=int(SHARE * space),
                    max_maps=1,
                    speedups=speedups,
                )
                answer = search.solution(tuple(search))
            else:
                end_after(limit, timer)
                answer = PEERS[tool].find(trace)
    except NotApplicableError as error:
        say(status="not applicable", reason=str(error))
        return
    except Exception as error:  # any error of a program is its result
        outcome = {
            "status": "memory" if _of_memory(error) else "error",
            "reason": f"{type(error).__name__}: {error}"[:200],
        }
    spent = {"seconds": now() - began, "cpu": cpu_seconds() - cpu, "memory": peak_memory()}
    end_after(0, timer)
    end_after(AROUND)
    if not outcome:
        outcome = (
            {**of_solution(answer, trace, theory), **asdict(answer.effort.grounding)}
            if tool.startswith(OURS)
            else of_machine(answer, trace, PEERS[tool].proves)
        )
    if outcome["status"] == "ok" and spent["seconds"] > limit:
        outcome["status"] = "timeout"
    say(**outcome, **{name: round(value, 5) for name, value in spent.items()})


def of_solution(solution: Solution, trace: Trace, theory: Theory) -> dict[str, Any]:
    """Check the maps of our solver, and return its result: status, dstates, bound and times."""
    wrong = [
        violation.message
        for ssh_map in solution.maps
        for violation in check(trace, ssh_map, theory)
    ]
    stopped = {"time limit": "timeout", "memory limit": "memory"}.get(
        str(solution.stopped), "error"
    )
    proven = solution.status is Status.OPTIMAL
    return {
        "status": "wrong" if wrong else "ok" if proven else stopped,
        "reason": wrong[0] if wrong else "",
        "dstates": solution.cost.dstates if solution.cost else None,
        "bound": solution.bound.dstates,
        "proven": proven,
        "prefix": solution.effort.prefix,
        "ground": round(solution.seconds.ground, 5),
        "solve": round(solution.seconds.solve, 5),
    }


def of_machine(machine: Machine, trace: Trace, proven: bool) -> dict[str, Any]:
    """Check that a peer's machine shows the views of the trace, and return its result.

    Args:
        machine: The machine.
        trace: The trace.
        proven: Whether the peer proves that its machine is minimal.
    """
    states = machine.states(trace)
    if states is None:
        return {"status": "wrong", "reason": "the machine does not show the views of the trace"}
    return {"status": "ok", "reason": "", "dstates": states, "proven": proven}


def cpu_seconds() -> float:
    """Return the CPU seconds of this process, and of the child processes that it waited for."""
    return sum(
        used.ru_utime + used.ru_stime
        for used in map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    )


def count_processor_time() -> None:
    """Let the searches of this process read processor time instead of wall-clock time."""
    read = SimpleNamespace(perf_counter=cpu_seconds, thread_time=time.thread_time)
    vars(clock)["time"] = vars(limits)["time"] = read


def end_after(seconds: float, timer: int = signal.ITIMER_REAL) -> None:
    """Let the system end this process after some seconds of a timer; 0 switches the timer off."""
    signal.setitimer(timer, seconds)


def say(**record: Any) -> None:
    print(json.dumps(record), flush=True)


def _of_memory(error: Exception) -> bool:
    return isinstance(error, MemoryError) or any(
        sign in str(error).lower() for sign in ("out of memory", "bad_alloc")
    )


if __name__ == "__main__":
    main()
