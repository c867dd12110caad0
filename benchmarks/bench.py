"""Time and memory of ssh-abduction and its peers from PyPI, on the same traces in the same run.

    python benchmarks/bench.py [--limit S] [--memory MIB] [--only PATTERN] [--tools PATTERN]
                               [--seeds N] [--out RESULTS.json]

Each cell of the table runs in its own process (cell.py). The results are stored as JSON after
each cell, and the tables are printed at the end. `python benchmarks/table.py RESULTS.json` prints
the tables of a stored run.
"""

from __future__ import annotations

import argparse
import contextlib
import datetime
import json
import os
import platform
import re
import signal
import subprocess
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from arguments import add_number, add_pattern
from peers import PEERS
from suite import SUITE, Instance
from table import OURS, contradictions, grounding, times

FOLDER = Path(__file__).parent
TOOLS = (OURS, *PEERS)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    add_number(parser, "--limit", "S", 60.0, "seconds per cell")
    add_number(parser, "--memory", "MIB", 4096, "address space a cell has, in MiB")
    add_pattern(parser, "--only", "instances")
    add_pattern(parser, "--tools", "tools")
    add_number(parser, "--seeds", "N", 1, "random traces of each kind")
    parser.add_argument(
        "--out",
        type=Path,
        metavar="RESULTS.json",
        help="file for the results (default benchmarks/results/DATE.json)",
    )
    options = parser.parse_args()
    today = datetime.date.today().isoformat()
    out = options.out or FOLDER / "results" / f"{today}.json"
    out.parent.mkdir(parents=True, exist_ok=True)
    results: dict[str, Any] = {
        "date": today,
        "limit": options.limit,
        "memory": options.memory,
        "seeds": options.seeds,
    }
    results |= {"machine": machine(), "packages": packages(), "cells": []}
    # Store the results after each cell, so that an interrupted run loses nothing.
    for instance in SUITE.values():
        for tool in TOOLS:
            if re.search(options.only, instance.name) and re.search(options.tools, tool):
                for seed in range(options.seeds if instance.seeded else 1):
                    cell = run(tool, instance, seed, options.limit, options.memory)
                    print(
                        f"{instance.name:24} {seed:3} {tool:14} {cell['status']:14} "
                        f"{cell.get('seconds', 0):8.2f} s",
                        file=sys.stderr,
                    )
                    results["cells"].append(cell)
                    store(results, out)
    print(f"{times(results)}\n\n{grounding(results)}")
    sys.exit("\n".join(contradictions(results)) or None)


def run(
    tool: str, instance: Instance, seed: int, limit: float, memory: int, clock: str = "wall"
) -> dict[str, Any]:
    """Measure one tool on one trace, in a process of its own.

    Returns:
        A dict: status, reason of a failure, seconds by the clock ("wall" or "cpu"), CPU seconds,
        peak MiB, number of dstates, and whether that number is proven minimal.
    """
    cell = {
        "instance": instance.name,
        "theory": "causal" if instance.causal else "full",
        "tool": tool,
        "seed": seed,
    }
    if tool in PEERS and not instance.causal:
        return {**cell, "status": "not applicable", "reason": "it knows no places and paths"}
    if tool in PEERS and not PEERS[tool].installed:
        return {
            **cell,
            "status": "not installed",
            "reason": f"{PEERS[tool].packages[0]} is not installed",
        }
    command = [
        sys.executable,
        str(FOLDER / "cell.py"),
        tool,
        instance.name,
        str(seed),
        str(limit),
        str(memory),
        clock,
    ]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as process:
        assert process.stdout
        said = [json.loads(line) for line in process.stdout]
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    start = said[0] if said else {}
    cell |= {"images": start.get("images"), "true_dstates": start.get("true_dstates")}
    # The process prints a line about the trace, then a line with the result. If the second line is
    # missing, the process was ended by its time limit, or it crashed.
    if len(said) == 2:
        return {**cell, **said[1]}
    peak = usage.ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)
    spent = {
        "seconds": limit,
        "cpu": round(usage.ru_utime + usage.ru_stime - start.get("cpu", 0), 5),
        "memory": peak,
    }
    if process.returncode in (-signal.SIGALRM, -signal.SIGPROF) and start:
        return {**cell, "status": "timeout", "reason": "", **spent}
    return {**cell, "status": "error", "reason": f"ended with code {process.returncode}"}


def store(results: dict[str, Any], path: Path) -> None:
    """Write the results as JSON, with one cell of the table on each line."""
    head, cells = (
        {k: v for k, v in results.items() if k != "cells"},
        ",\n".join(json.dumps(cell) for cell in results["cells"]),
    )
    path.write_text(
        json.dumps({**head, "cells": []}, indent=1).removesuffix("[]\n}") + f"[\n{cells}\n]}}\n",
        encoding="utf-8",
    )


def machine() -> dict[str, Any]:
    """Describe this machine without its name: processor, cores, MiB of memory, system, Python."""
    details = Path("/proc/cpuinfo")
    named = re.search(r"model name\s*: (.*)", details.read_text()) if details.exists() else None
    return {
        "cpu": named[1] if named else platform.processor(),
        "cores": os.cpu_count(),
        "memory": os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2**20,
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
    }


def packages() -> dict[str, str]:
    """Return the version of each measured package that is installed, by name."""
    found = {}
    for name in dict.fromkeys(
        [OURS, "clingo", *(package for peer in PEERS.values() for package in peer.packages)]
    ):
        with contextlib.suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


if __name__ == "__main__":
    main()
