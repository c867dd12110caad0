"""What one fault does to a driving robot: steps until its map is certain again, and right.

    python benchmarks/recovery.py [--only PATTERN] [--seeds 20] [--first 800] [--limit 0.5]
                                  [--out RESULTS.jsonl]

Each run has one fault, at a random step that is not among the first or last five. Steps are counted
from the step at which the fault becomes visible: the step with the wrong view, or the first step
after the jump.

*Noticed* is the first step at which the mapper says that something broke. *Certain again* is the
first step from there on at which the mapper is certain. A map is right if it has the true dstates
and links that can be reached from the robot, and the robot's true dstate. The fault is *found* if a
map has exactly the true fault and the true labels, except the label of the step with a wrong view
(fault_cases.py). It may be found in the first map, or in another minimal map. Often nothing shows
which of two consecutive actions slipped.

"Truth dearer" counts the runs in which the truth costs more than the minimum. CPU milliseconds are
those of `observe`.
"""

from __future__ import annotations

import argparse
import json
import random
import re
import statistics
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from arguments import add_number, add_pattern
from fault_cases import (
    CAUSAL,
    MARGIN,
    TOPOLOGICAL,
    Case,
    is_true,
    rectangle_of_five,
    sized,
    star_turned,
)
from instances import Walk

from ssh_abduction import OnlineMapper, SSHMap, Theory, Trace
from ssh_abduction.online.keeper import ExtendedMap
from ssh_abduction.solution import Cost
from ssh_abduction.solver.asp import facts

COLUMNS = (
    "noticed",
    "after steps: median, range",
    "certain before",
    "of these certain again",
    "after steps: median, range",
    "others certain again",
    "after steps: median, range",
    "map right when certain again",
    "map right in the end",
    "fault found: first map, any",
    "truth dearer",
    "CPU ms per step: median, mean, most",
)
Record = dict[str, Any]


def machine(seed: int, *, wrong: int = 0, jumps: int = 0) -> Case:
    """Make a walk of 200 steps in a random machine of 5 to 12 states and 4 to 9 views.

    Args:
        seed: Seed of machine, walk and faults.
        wrong: Number of wrong views.
        jumps: Number of jumps.
    """
    chance = random.Random(f"recovery {seed}")
    states = chance.randint(5, 12)
    return sized(seed, states, chance.randint(4, min(9, states)), 200, wrong=wrong, jumps=jumps)


def corridor(seed: int, steps: int = 30) -> Case:
    """Make a walk up and down a corridor of four places with stars. One star is wrong."""
    chance = random.Random(f"corridor {seed}")
    openings = [(1, 0, 0, 0), (1, 0, 1, 0), (1, 0, 1, 0), (0, 0, 1, 0)] * 2
    actions = ["travel", "travel", "travel", "around"] * 2
    truth = [t % 8 for t in range(steps + 1)]
    views = ["abbacbbc"[s] for s in truth]
    trace = Trace.from_steps(
        views,
        [actions[s] for s in truth[:-1]],
        stars=[openings[s] for s in truth],
        name=f"corridor, seed {seed}",
    )
    wrong = chance.randrange(MARGIN, steps - MARGIN)
    return Case(star_turned(Walk(trace, tuple(truth)), [wrong], chance), misseen=(wrong,))


DEARER = CAUSAL.replace(slipped=3)
FAMILIES: dict[str, tuple[Callable[[int], Case], Theory]] = {
    "machine, a wrong view": (partial(machine, wrong=1), CAUSAL),
    "machine, a jump": (partial(machine, jumps=1), CAUSAL),
    "rectangle of 5 views, a wrong view": (partial(rectangle_of_five, steps=200, wrong=1), CAUSAL),
    "rectangle of 5 views, a jump": (partial(rectangle_of_five, steps=200, jumps=1), CAUSAL),
    "rectangle of 5 views, a wrong view, slipped 3": (
        partial(rectangle_of_five, steps=200, wrong=1),
        DEARER,
    ),
    "rectangle of 5 views, a jump, slipped 3": (
        partial(rectangle_of_five, steps=200, jumps=1),
        DEARER,
    ),
    "corridor with stars, a wrong star": (corridor, TOPOLOGICAL.replace(slipped=0)),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    add_pattern(parser, "--only", "families")
    add_number(parser, "--seeds", "N", 20, "runs of each family")
    add_number(parser, "--first", "SEED", 800, "the first seed")
    add_number(parser, "--limit", "S", 0.5, "seconds that a step may take")
    parser.add_argument(
        "--out", type=Path, metavar="RESULTS.jsonl", help="file for the result of each run"
    )
    options = parser.parse_args()
    print(f"| {' | '.join(('trace', *COLUMNS))} |\n{'|---' * (len(COLUMNS) + 1)}|")
    for name, (make, theory) in FAMILIES.items():
        if re.search(options.only, name):
            records = [
                run(make(seed), theory, options.limit, seed)
                for seed in range(options.first, options.first + options.seeds)
            ]
            print(f"| {name} | {' | '.join(cells(records))} |", flush=True)
            if options.out:
                with options.out.open("a") as file:
                    file.writelines(
                        json.dumps({"family": name, **record}) + "\n" for record in records
                    )


def run(case: Case, theory: Theory, limit: float, seed: int = 0) -> Record:
    """Give a trace with one fault to a mapper, step by step.

    Args:
        case: The trace.
        theory: The theory.
        limit: Seconds that a step may take.
        seed: Seed of the case, for the record.

    Returns:
        A dict with the step at which the fault shows, the steps until the mapper noticed it and was
        certain again, whether its maps were right, and the CPU milliseconds of each step.
    """
    trace = case.walk.trace
    shown = min([*case.wrong, *case.misseen, *(t + 1 for t in case.jumps)])
    mapper = OnlineMapper(trace.views[0], theory, star=trace.steps[0].star, time_limit=limit)
    noticed = again = None
    right_again = False
    milliseconds = []
    for t, (action, step) in enumerate(zip(trace.actions, trace.steps[1:], strict=True), 1):
        began = time.process_time()
        solution = mapper.observe(action, trace.views[t], star=step.star)
        milliseconds.append(1000 * (time.process_time() - began))
        if t == shown - 1:
            certain_before = mapper.standing.certain
        if (
            t >= shown
            and noticed is None
            and any(said.startswith(f"step {t}:") for said in mapper.standing.broke)
        ):
            noticed = t
        if noticed is not None and again is None and mapper.standing.certain:
            again, right_again = t, is_right(case, mapper.theory, solution.maps[0])
    cost = solution.cost
    return {
        "seed": seed,
        "shown": shown,
        "certain_before": certain_before,
        "noticed": None if noticed is None else noticed - shown,
        "again": None if again is None else again - shown,
        "right_again": right_again,
        "certain_in_the_end": mapper.standing.certain,
        "right": bool(solution.maps) and is_right(case, mapper.theory, solution.maps[0]),
        "found": [
            is_true(m.labels, frozenset((fault.step, fault.kind) for fault in m.faults), case)
            for m in solution.maps
        ],
        "dearer": cost is not None
        and Cost.of(true_map(case, mapper.theory, len(trace))).tenths > cost.tenths,
        "searches": mapper.searches,
        "milliseconds": [round(spent, 3) for spent in milliseconds],
    }


def is_right(case: Case, theory: Theory, ssh_map: SSHMap) -> bool:
    """Check whether a map of the first steps makes the same predictions as the true map."""
    truth = true_map(case, theory, len(ssh_map.labels))
    return (
        ExtendedMap.of(ssh_map, case.walk.trace, theory).future()
        == ExtendedMap.of(truth, case.walk.trace, theory).future()
    )


def true_map(case: Case, theory: Theory, steps: int) -> SSHMap:
    """Make the true map of the first `steps` steps, with its faults."""
    trace = case.walk.trace
    faults = [(t, kind) for t, kind in case.faults if t + (kind == "slipped") < steps]
    return facts.causal_map(case.walk.truth[:steps], trace.prefix(steps), faults, theory)


def cells(records: Sequence[Record]) -> list[str]:
    """Make the cells of a row of the table, from the records of a family."""
    sure, others = (
        [r for r in records if r["certain_before"] is before] for before in (True, False)
    )
    noticed, again, others_again = (
        [r[key] for r in some if r[key] is not None]
        for some, key in ((records, "noticed"), (sure, "again"), (others, "again"))
    )
    spent = [ms for record in records for ms in record["milliseconds"]]
    return [
        f"{len(noticed)} of {len(records)}",
        steps_of(noticed),
        f"{len(sure)}",
        f"{len(again)} of {len(sure)}",
        steps_of(again),
        f"{len(others_again)} of {len(others)}",
        steps_of(others_again),
        f"{sum(record['right_again'] for record in records)} of {len(again) + len(others_again)}",
        f"{sum(record['right'] for record in records)} of {len(records)}",
        f"{sum(record['found'][:1] == [True] for record in records)}, "
        f"{sum(any(record['found']) for record in records)}",
        str(sum(record["dearer"] for record in records)),
        f"{statistics.median(spent):.2f}, {statistics.mean(spent):.1f}, {max(spent):.0f}",
    ]


def steps_of(steps: Sequence[int]) -> str:
    return f"{statistics.median(steps):g}, {min(steps)} to {max(steps)}" if steps else "–"


if __name__ == "__main__":
    main()
