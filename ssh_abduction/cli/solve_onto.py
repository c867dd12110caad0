"""ssh-abduction solve TRACE --onto MAPS: add a drive to an existing map, which keeps its places."""

from __future__ import annotations

import argparse

from ssh_abduction.cli.obeyed_corrections import corrections_of, keep_corrections, say_obeyed
from ssh_abduction.cli.options import number_steps, theory_of
from ssh_abduction.cli.outcome import exit_code, save_solution, warn
from ssh_abduction.cli.text import findings, first_map, headline, told_apart
from ssh_abduction.data.drives import together
from ssh_abduction.data.errors import AbductionError
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
    said = corrections_of(options)
    # Steps of options such as --same are named by the drives of the old and the new traces.
    if existing.trace is not None:
        number_steps(options, together([existing.trace, trace]))
    solution = solve(
        trace,
        theory_of(options, existing.theory.replace(returns=0)),
        onto=existing,
        time_limit=options.time_limit,
        work_limit=options.work_limit,
        max_maps=options.maps or None,
        within=options.within,
        memory_limit=options.memory_limit,
        speedups=Speedups.without(options.without_speedups),
        corrections=said,
    )
    if said is not None and solution.trace is not None:
        say_obeyed(said, solution.trace)
    warn(solution.warnings)
    save_solution(solution, options.output)
    keep_corrections(said, options.output)
    if options.json:
        print(json_line(solution.to_dict()))
        return exit_code(solution)
    count = len(solution.maps)
    print(headline(solution, count, None))
    lines = (
        *findings(solution, existing.maps[0]),
        first_map(solution, count),
        *told_apart(solution, count),
    )
    print("\n".join(lines))
    return exit_code(solution)
