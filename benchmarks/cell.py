"""One tool on one trace, in a process of its own. It prints a line when the clock starts, and a line with what came of it.

    python benchmarks/cell.py TOOL INSTANCE SEED SECONDS MIB [CLOCK]

TOOL is a peer, ssh-abduction, or "ssh-abduction without" and the names of speed-ups, commas between. `following` is not one that a user can
switch off: here the guesses at the beginning of a long causal trace, which are followed along the rest, are left out. CLOCK is wall, or cpu: then
seconds are those that the processors worked for this process, and limits are of these.

The process is ended by a signal when its time is over. The clock does not run while programs are loaded, the trace is made, or the
answer is checked: a map by the checker, a peer's machine by running it along the trace.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import json
import resource
import signal
import sys
import time
from dataclasses import asdict
from types import SimpleNamespace
from typing import Any

import numpy  # noqa: F401 - the search loads it when it first needs it: rather before the clock starts
from peers import PEERS, Machine, NotApplicableError
from suite import INSTANCES
from table import OURS, WITHOUT

from ssh_abduction import Solution, Theory, Trace
from ssh_abduction.checker.checker import check
from ssh_abduction.solver import Search, Status
from ssh_abduction.solver.asp import limits
from ssh_abduction.solver.asp.limits import peak_memory
from ssh_abduction.theory import Speedups

AROUND = 300  # seconds for all that the clock does not count
MARGIN = 0.1  # how much later than its own limit a solver of ours is ended: time to hand over what it has
SHARE = 0.8  # of the memory is its own limit, for the same reason


def main() -> None:
    tool, name, seed, seconds, memory, *clock = sys.argv[1:]
    now, timer = time.perf_counter, signal.ITIMER_REAL
    if clock == ["cpu"]:
        now, timer = cpu_seconds, signal.ITIMER_PROF
        vars(limits)["time"] = SimpleNamespace(
            perf_counter=cpu_seconds
        )  # the clock that a search looks at
    instance, limit, space = INSTANCES[name], float(seconds), int(memory)
    end_after(AROUND)
    for module in PEERS[tool].modules if tool in PEERS else ():
        importlib.import_module(module)
    walk = instance.walk(int(seed))
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
                speedups = all_but(tool.removeprefix(OURS).removeprefix(WITHOUT))
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
    except Exception as error:  # whatever a program raises is what came of it
        outcome = {
            "status": "memory" if _of_memory(error) else "error",
            "reason": f"{type(error).__name__}: {error}"[:200],
        }
    spent = {"seconds": now() - began, "cpu": cpu_seconds() - cpu, "memory": peak_memory()}
    end_after(0, timer)
    end_after(AROUND)
    if not outcome:
        outcome = (
            {**of_solution(answer, trace, theory), **asdict(search.grounding)}
            if tool.startswith(OURS)
            else of_machine(answer, trace, PEERS[tool].proves)
        )
    if outcome["status"] == "ok" and spent["seconds"] > limit:
        outcome["status"] = "timeout"
    say(**outcome, **{name: round(value, 5) for name, value in spent.items()})


def of_solution(solution: Solution, trace: Trace, theory: Theory) -> dict[str, Any]:
    """What came of our solver: a map that the checker finds right, the bound, and where the time went."""
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
        "prefix": solution.prefix,
        "ground": round(solution.seconds.ground, 5),
        "solve": round(solution.seconds.solve, 5),
    }


def of_machine(machine: Machine, trace: Trace, proven: bool) -> dict[str, Any]:
    """What came of a peer: a machine that shows the views of the trace."""
    states = machine.states(trace)
    if states is None:
        return {"status": "wrong", "reason": "the machine does not show the views of the trace"}
    return {"status": "ok", "reason": "", "dstates": states, "proven": proven}


def all_but(names: str) -> Speedups:
    """All speed-ups but these."""
    off = names.split(",")
    if "following" in off:
        off.remove("following")
        small = importlib.import_module("ssh_abduction.solver.engines.small_maps")
        small.SmallMaps.from_beginning = lambda *_: iter(())
    return Speedups.without(off)


def cpu_seconds() -> float:
    """What the processors worked for this process, all its threads, and the processes that it waited for."""
    return sum(
        used.ru_utime + used.ru_stime
        for used in map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    )


def end_after(seconds: float, timer: int = signal.ITIMER_REAL) -> None:
    """From now on the process has so long, by this timer; then the system ends it, whatever it is doing. 0: no longer."""
    signal.setitimer(timer, seconds)


def say(**record: Any) -> None:
    print(json.dumps(record), flush=True)


def _of_memory(error: Exception) -> bool:
    return isinstance(error, MemoryError) or any(
        sign in str(error).lower() for sign in ("out of memory", "bad_alloc")
    )


if __name__ == "__main__":
    main()
