"""Time to find all minimal maps of small traces, here and in another checkout.

    python benchmarks/conformance.py [CHECKOUT]

The traces are those with known results (tests/test_tables.py). The time of a trace is the minimum
of five runs in one process, in CPU milliseconds. With a second checkout, two processes take turns
trace by trace, so that other load affects both alike. The ratio of one trace is noisy, so the
deciles of all ratios are printed.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from ssh_abduction import Theory, Trace, solve

ROOT = Path(__file__).parent.parent
RUNS = 5


def cases() -> list[tuple[Trace, Theory]]:
    """List the traces and theories of the tests: small traces, and parts of a notched rectangle."""
    sys.path.insert(0, str(ROOT / "tests"))
    import test_tables as tables

    small = [
        tuple(row.values[:2])
        for row in tables.test_small_traces_have_the_known_numbers_of_maps.pytestmark[0].args[1]
    ]
    round_about = [
        (tables.rectangle(actions), theory)
        for theory, *_ in tables.NOTCHED
        for actions in tables.LENGTHS
    ]
    return [
        (tables.cornered(trace) if theory.star == "frame" else trace, theory)
        for trace, theory in small + round_about
    ]


def milliseconds(trace: Trace, theory: Theory) -> float:
    """Find all minimal maps five times, and return the least CPU milliseconds."""
    taken = []
    for _ in range(RUNS):
        began = time.process_time()
        solve(trace, theory, max_maps=None)
        taken.append(1000 * (time.process_time() - began))
    return min(taken)


def answer() -> None:
    """Serve another process: for each input line with a trace file and a theory, print the time."""
    for line in sys.stdin:
        path, theory = json.loads(line)
        print(milliseconds(Trace.load(path), Theory.from_dict(theory)), flush=True)


def compare(other: str | None) -> None:
    """Measure this checkout and, if given, another one, and print the times."""
    checkouts = [str(ROOT), *([other] if other else [])]
    command = [sys.executable, str(Path(__file__).resolve()), "--answer"]
    children = [
        subprocess.Popen(
            command,
            env={**os.environ, "PYTHONPATH": path},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        for path in checkouts
    ]
    rows: list[list[float]] = []
    with tempfile.TemporaryDirectory() as folder:
        for number, (trace, theory) in enumerate(cases()):
            path = Path(folder) / f"{number}.jsonl"
            trace.save(path)
            rows.append([])
            for child in children:
                assert child.stdin
                assert child.stdout
                print(json.dumps([str(path), theory.to_dict()]), file=child.stdin, flush=True)
                rows[-1].append(float(child.stdout.readline()))
    for child in children:
        child.communicate()
    # Print the times of each checkout, then their ratios.
    for path, times in zip(checkouts, zip(*rows, strict=True), strict=True):
        print(
            f"{len(times)} traces, {path}: median {statistics.median(times):.1f} ms, "
            f"most {max(times):.1f} ms"
        )
    if other:
        deciles = statistics.quantiles((here / there for here, there in rows), n=10)
        print(
            f"ratio of each trace: median {deciles[4]:.2f}, for eight of ten "
            f"{deciles[0]:.2f} to {deciles[-1]:.2f}"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("checkout", nargs="?", help="another checkout to compare with")
    parser.add_argument("--answer", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    answer() if options.answer else compare(options.checkout)


if __name__ == "__main__":
    main()
