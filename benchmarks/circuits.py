"""Repeated circuits of the notched rectangle: replaying them takes time linear in the steps.

    python benchmarks/circuits.py

The script solves traces of two to 5,000 circuits. Short traces are also solved as a whole, without
solving growing prefixes. Times are medians of three runs on this machine. Compare the ratios, not
the seconds.
"""

from __future__ import annotations

import argparse
import statistics
import time

from ssh_abduction import Theory, Trace, solve
from ssh_abduction.theory import Speedups

AT_ONCE = 48  # images; solving longer traces without prefixes takes too long


def circuits(steps: int) -> Trace:
    """Make a trace of circuits of the notched rectangle with `steps` images."""
    return Trace.from_steps(
        [f"v{i % 4}" for i in range(steps)], [("right", "travel")[i % 2] for i in range(steps - 1)]
    )


def median(trace: Trace, theory: Theory, prefixes: bool = True) -> float:
    """Solve a trace three times, and return the median time in seconds."""
    seconds = []
    for _ in range(3):
        began = time.perf_counter()
        solve(trace, theory, speedups=Speedups(prefixes=prefixes))
        seconds.append(time.perf_counter() - began)
    return statistics.median(seconds)


def main() -> None:
    argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0]).parse_args()
    print(
        f"{'theory':16} {'images':>7} {'prefix':>7} {'s':>8} "
        f"{'x 2 circuits':>13} {'at once, s':>11}"
    )
    for name, theory in (
        ("causal", Theory.causal()),
        ("topological", Theory.topological()),
        ("circumscriptive", Theory.circumscriptive()),
    ):
        base = 0.0
        for steps in (16, 48, 400, 4_000, 40_000):
            trace = circuits(steps)
            seconds = median(trace, theory)
            base = base or seconds
            whole = f"{median(trace, theory, prefixes=False):.3f}" if steps <= AT_ONCE else "–"
            print(
                f"{name:16} {steps:7} {solve(trace, theory).effort.prefix:7} {seconds:8.3f} "
                f"{seconds / base:13.1f} {whole:>11}"
            )


if __name__ == "__main__":
    main()
