"""ssh-abduction solve TRACE --onto MAPS: add a drive to an existing map, which keeps its places."""

from __future__ import annotations

import argparse

from ssh_abduction.cli.obeyed_corrections import corrections_of
from ssh_abduction.cli.options import number_steps, theory_of
from ssh_abduction.cli.outcome import exit_code, save_solution, warn
from ssh_abduction.cli.text import describe, headline
from ssh_abduction.data.drives import together
from ssh_abduction.data.errors import AbductionError, printable
from ssh_abduction.data.files import json_line
from ssh_abduction.data.trace import Trace
from ssh_abduction.solver import Solution, solve
from ssh_abduction.theory.speedups import Speedups


def run(options: argparse.Namespace) -> int:
    for name in ("front", "jobs", "scheduler", "joint_trace"):
        if getattr(options, name) is not None:
            flag = f"--{name.replace('_', '-')}"
            raise AbductionError(
                f"{flag}: expected no such option when a drive is added to a map; leave it out"
            )
    existing = Solution.load(options.onto)
    trace = together([Trace.load(path) for path in options.traces])
    if existing.trace is not None:
        number_steps(options, together([existing.trace, trace]))
    solution = solve(
        trace,
        theory_of(options, existing.theory.replace(returns=0)),
        onto=existing,
        time_limit=options.time_limit,
        max_maps=options.maps or None,
        within=options.within,
        memory_limit=options.memory_limit,
        speedups=Speedups.without(options.without_speedups),
        corrections=corrections_of(options),
    )
    warn(solution.warnings)
    save_solution(solution, options.output)
    if options.json:
        print(json_line(solution.to_dict()))
        return exit_code(solution)
    kept = ", ".join(solution.support.onto)
    print(headline(solution, len(solution.maps), None))
    print(printable(f"the map of {kept} is kept; {solution.joined}"))
    print(f"\n{'map 1' if len(solution) > 1 else 'map'}\n{describe(solution[0])}")
    return exit_code(solution)
