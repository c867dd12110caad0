"""Do limits of time and memory hold? The worst overshoot on traces with flaws.

    python benchmarks/limits.py --cases 40 --seed 0 [--python]
    python benchmarks/limits.py --logs TRACE ... --seconds 0.5 2 --rows FILE

With flaws, most places look new. The package promises three things: at most 1.2 times the time
limit plus 1 s, including the start; at most 1.2 times the memory limit plus 200 MiB; and valid JSON
as output. Each case runs in its own process. By default, the process is the command line, which has
a guard that ends it in time whatever clingo does. With --python, it is `solve` of the Python
interface, which has no guard. The same seed gives the same cases. Their times depend on the load of
the machine.

With --logs, traces that `import` made of logs are solved by the theory of `map` in this process.
The libraries are loaded before. The limit and the times are CPU seconds, so other work on the
machine matters little. Rows that are in the file of --rows are not measured again.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import random
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

from instances import maze, moore, rectangle

from ssh_abduction import Trace, solve
from ssh_abduction.robot_logs.log_maps import BARE, MAPS
from ssh_abduction.runtime import limits
from ssh_abduction.solver import search

TIME, MEMORY = (
    (1.2, 1.0),
    (1.2, 200.0),
)  # the promise: a factor of the limit, and seconds or MiB on top
PYTHON = """
import json, sys
from ssh_abduction import Trace, solve
from ssh_abduction.theory.theory import PRESETS
path, theory, limit, memory = sys.argv[1:]
solution = solve(
    Trace.load(path), PRESETS[theory](), time_limit=float(limit), memory_limit=int(memory) or None
)
print(json.dumps({"status": solution.status.value}))
sys.exit({"optimal": 0, "feasible": 10, "unsatisfiable": 20, "unknown": 30}[solution.status.value])
"""
GIVEN_UP = 30.0  # kill a process this many seconds after the promised time
CODES = {"optimal": 0, "feasible": 10, "unsatisfiable": 20, "unknown": 30}


def aces(circuits: int, seed: int) -> Trace:
    """Make a drive like that in the ACES building: circuits of corridors with many views."""
    chance = random.Random(seed)
    corridor = [f"v{chance.randrange(12)}" for _ in range(23)]
    done = [chance.choice(["travel", "travel", "right", "around"]) for _ in corridor]
    return Trace.from_steps(corridor * circuits + corridor[:1], done * circuits)


FAMILIES: dict[str, tuple[str, Callable[[int, int], Trace]]] = {
    "rectangle": ("topological", lambda steps, _: rectangle(max(steps // 8, 3)).trace),
    "rectangle, causal": ("causal", lambda steps, _: rectangle(max(steps // 8, 3)).trace),
    "like ACES": ("topological", lambda steps, seed: aces(max(steps // 23, 1), seed)),
    "maze": ("topological", lambda steps, seed: maze(6, 6, steps=steps, seed=seed).trace),
    "maze with stars": (
        "topological",
        lambda steps, seed: maze(6, 6, steps=steps, seed=seed, stars=True).trace,
    ),
    "random machine, causal": (
        "causal",
        lambda steps, seed: moore(60, 4, steps=steps, seed=seed).trace,
    ),
}


def flawed(trace: Trace, flaws: int, chance: random.Random) -> Trace:
    """Copy a trace, with random flaws.

    A flaw is a wrong view and star, a missing or doubled step, or a wrong action.
    """
    # Draw the kind of each flaw, then its step.
    steps = list(trace.steps)
    for _ in range(flaws):
        t = chance.randrange(1, len(steps) - 1)
        flaw = chance.choice(["view", "dropped", "doubled", "action", "last view"])
        if flaw in ("view", "last view"):
            t = len(steps) - 1 if flaw == "last view" else t
            other = chance.choice([step for step in steps if step.view != steps[t].view])
            steps[t] = replace(steps[t], view=other.view, star=other.star)
        elif flaw == "action":
            steps[t] = replace(
                steps[t], action=chance.choice([step.action for step in steps if step.action])
            )
        elif flaw == "dropped":
            del steps[t]
        else:
            steps.insert(t, steps[t])
    return Trace(tuple(steps), name=trace.name)


@dataclass(frozen=True)
class Case:
    """A trace to solve.

    Attributes:
        family: Name of the family.
        trace: The trace.
        seconds: Time limit.
        mebibytes: Memory limit in MiB; None for no limit.
    """

    family: str
    trace: Trace
    seconds: float
    mebibytes: int | None

    def command(self, path: Path, *, python: bool) -> list[str]:
        """Make the command line of the process that solves the case.

        Args:
            path: File of the trace.
            python: Whether to use the Python interface.
        """
        if python:
            return [
                sys.executable,
                "-c",
                PYTHON,
                str(path),
                FAMILIES[self.family][0],
                str(self.seconds),
                str(self.mebibytes or 0),
            ]
        limits = [
            f"--time-limit={self.seconds}",
            *([f"--memory-limit={self.mebibytes}"] if self.mebibytes else []),
        ]
        return [
            sys.executable,
            "-m",
            "ssh_abduction",
            "solve",
            "--strict",
            str(path),
            "--json",
            f"--theory={FAMILIES[self.family][0]}",
            *limits,
        ]


@dataclass(frozen=True)
class Outcome:
    """The result of a case.

    Attributes:
        case: The case.
        seconds: Time of the process, as a share of the promised time.
        mebibytes: Peak memory of the process, as a share of the promised memory.
        status: The printed status, or a text that says what was wrong with the output.
    """

    case: Case
    seconds: float
    mebibytes: float
    status: str


def cases(
    count: int, seed: int, longest: int = 2000, seconds: Sequence[float] = (0.5, 1, 2, 5, 10)
) -> Iterator[Case]:
    """Draw cases from each family in turn.

    Args:
        count: Number of cases.
        seed: Seed of the cases.
        longest: Steps of the longest traces.
        seconds: Time limits to draw from.
    """
    chance = random.Random(seed)
    families = list(FAMILIES)
    for number in range(count):
        family = families[number % len(families)]
        steps = round(20 * (longest / 20) ** chance.random())
        trace = flawed(
            FAMILIES[family][1](steps, chance.randrange(1000)),
            chance.choice([0, 1, 1, 1, 3]),
            chance,
        )
        yield Case(
            family, trace, chance.choice(seconds), chance.choice([None, None, 300, 600, 1500])
        )


def outcome(case: Case, folder: Path, *, python: bool = False) -> Outcome:
    """Solve a case in a process of its own, and measure the process.

    Args:
        case: The case.
        folder: Folder for the files of the trace and the solution.
        python: Whether to use the Python interface.
    """
    path, output = folder / "trace.jsonl", folder / "solution.json"
    case.trace.save(path)
    command = case.command(path, python=python)
    promised = TIME[0] * case.seconds + TIME[1]
    began = time.monotonic()
    with (
        output.open("wb") as written,
        subprocess.Popen(command, stdout=written, stderr=subprocess.PIPE) as process,
    ):
        # Poll instead of wait, to sample the memory and to kill a process that hangs.
        ended, peak = False, 0.0
        while not ended:
            peak = max(peak, _peak(process.pid))
            number, status, usage = os.wait4(process.pid, os.WNOHANG)
            if number:
                ended, peak = True, peak or usage.ru_maxrss / 2**10
            else:
                time.sleep(0.01)
                if time.monotonic() - began > promised + GIVEN_UP:
                    process.kill()
        taken = time.monotonic() - began
        process.returncode = os.waitstatus_to_exitcode(status)
    most = MEMORY[0] * case.mebibytes + MEMORY[1] if case.mebibytes else float("inf")
    return Outcome(case, taken / promised, peak / most, _status(output, process.returncode))


def _peak(process: int) -> float:
    """The peak MiB of a running process; 0 if the system does not say.

    The peak that the system reports at the end of a process cannot be used, as it includes this
    parent process.
    """
    with suppress(OSError, StopIteration), open(f"/proc/{process}/status", "rb") as status:
        return next(int(line.split()[1]) for line in status if line.startswith(b"VmHWM:")) / 2**10
    return 0.0


def _status(output: Path, code: int) -> str:
    try:
        printed = json.loads(output.read_text())
    except ValueError:
        return f"no JSON, exit code {code}"
    status = str(printed["status"])
    return status if CODES[status] == code else f"{status}, exit code {code}"


def table(outcomes: Sequence[Outcome]) -> str:
    """Make a table in Markdown, with a row for each family."""
    rows = [
        f"| traces | cases | {' | '.join(CODES)} | other | time, worst share of what is "
        "promised | memory, the same |",
        f"|{'---|' * (len(CODES) + 5)}",
    ]
    for family in FAMILIES:
        of_family = [found for found in outcomes if found.case.family == family]
        if not of_family:
            continue
        counts = [sum(found.status == status for found in of_family) for status in CODES]
        worst = (
            max(found.seconds for found in of_family),
            max(found.mebibytes for found in of_family),
        )
        cells = [
            family,
            len(of_family),
            *counts,
            len(of_family) - sum(counts),
            *(f"{share:.0%}" for share in worst),
        ]
        rows.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(rows)


def cpu_seconds() -> float:
    """The CPU seconds of this process and of its children that ended."""
    return sum(os.times()[:4])


def of_logs(paths: Sequence[Path], seconds: Sequence[float], rows: Path) -> list[dict[str, Any]]:
    """Solve traces of logs with limits in CPU seconds. Return a row for each trace and limit.

    Args:
        paths: Files of the traces.
        seconds: Limits, each for all traces.
        rows: File of the rows, one JSON object a line. Each new row is appended.
    """
    limits.now = search.now = time.process_time  # type: ignore[attr-defined]
    solve(Trace.load(paths[0]), BARE, time_limit=1, max_maps=MAPS)  # loads the libraries
    found = [json.loads(line) for line in rows.read_text().splitlines()] if rows.exists() else []
    measured = {(row["trace"], row["limit"]) for row in found}
    for limit, path in product(seconds, paths):
        if (path.stem, limit) in measured:
            continue
        row = {"trace": path.stem, "limit": limit, **_solved(Trace.load(path), limit)}
        found.append(row)
        with rows.open("a") as file:
            print(json.dumps(row), file=file)
        print(*row.values(), file=sys.stderr, flush=True)
    return found


def _solved(trace: Trace, limit: float) -> dict[str, Any]:
    """Solve a trace, and tell what was found and what it took. The peak memory starts anew."""
    gc.collect()
    Path("/proc/self/clear_refs").write_text("5")
    began = cpu_seconds()
    solution = solve(trace, BARE, time_limit=limit, max_maps=MAPS)
    taken = cpu_seconds() - began
    fit = solution.maps[0].fit if solution.maps else None
    rivals = solution.weighed.rivals if solution.weighed else ()
    return {
        "steps": len(trace),
        "status": solution.status.value,
        "map": bool(solution.maps),
        "nats": round(rivals[0].nats, 1) if rivals else None,
        "poses": bool(fit and fit.poses),
        "seconds": round(taken, 2),
        "mebibytes": round(_peak(os.getpid())),
    }


def table_of_logs(rows: Sequence[dict[str, Any]]) -> str:
    """Make a table in Markdown, with a row for each limit."""
    lines = [
        "| limit, CPU s | promised | traces | with a map, cost and poses | proven | median CPU s "
        "| most CPU s | over | most MiB |",
        f"|{'--:|' * 9}",
    ]
    for limit in sorted({row["limit"] for row in rows}):
        of_limit = [row for row in rows if row["limit"] == limit]
        taken, promised = [row["seconds"] for row in of_limit], TIME[0] * limit + TIME[1]
        cells = [
            f"{limit:g}",
            f"{promised:.1f}",
            len(of_limit),
            sum(row["map"] and row["poses"] and row["nats"] is not None for row in of_limit),
            sum(row["status"] == "optimal" for row in of_limit),
            f"{statistics.median(taken):.2f}",
            f"{max(taken):.2f}",
            sum(one > promised for one in taken),
            max(row["mebibytes"] for row in of_limit),
        ]
        lines.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--longest", type=int, default=2000, help="steps of the longest traces")
    parser.add_argument(
        "--python", action="store_true", help="use the Python interface, not the command line"
    )
    parser.add_argument("--logs", type=Path, nargs="+", metavar="TRACE", help="traces of logs")
    parser.add_argument("--seconds", type=float, nargs="+", default=[0.5], help="limits of --logs")
    parser.add_argument("--rows", type=Path, default=Path("limits.jsonl"), help="rows of --logs")
    options = parser.parse_args()
    if options.logs:
        print(table_of_logs(of_logs(options.logs, options.seconds, options.rows)))
        return
    outcomes = []
    with tempfile.TemporaryDirectory() as folder:
        for case in cases(options.cases, options.seed, options.longest):
            found = outcome(case, Path(folder), python=options.python)
            outcomes.append(found)
            limits = f"{case.seconds} s, {case.mebibytes or 'any'} MiB"
            told = (
                f"{case.family}, {len(case.trace)} steps, {limits}: {found.status}, "
                f"{found.seconds:.0%} of the time, {found.mebibytes:.0%} of the memory"
            )
            print(told, file=sys.stderr, flush=True)
            if max(found.seconds, found.mebibytes) > 1:
                case.trace.save(
                    Path(tempfile.gettempdir()) / f"over-{options.seed}-{len(outcomes)}.jsonl"
                )
    print(table(outcomes))


if __name__ == "__main__":
    main()
