"""Is the confidence right? Many small traces, how sure each answer is, and whether it is true.

    python benchmarks/calibration.py [--first 0] [--seeds 20] [--work 1] [--plans FOLDER]

The traces are walks in mazes, tours of plans (with --plans) and the ACES3 route, from views and
from stars. The odometry has the noise that it declares, which is the default: scale and drift are
drawn, too. The script prints the answers, and then a row for each bin of confidences. With --save,
each answer is a line of FILE.
"""

from __future__ import annotations

import argparse
import json
import statistics
from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path

from arguments import add_number
from truth import Known, aces3, is_true, mazes, noise_of, partition, plans

from ssh_abduction import Theory, solve
from ssh_abduction.data import Odometry

# The lower ends of the bins of confidences.
BINS = (0.0, 0.5, 0.8, 0.9, 0.95, 0.99)
THEORIES = {"views": Theory.topological().replace(star="none"), "stars": Theory.topological()}
HEAD = "| confidence | answers | mean | true | true map listed |\n|---|---|---|---|---|"


def traces(seeds: Sequence[int], folder: Path | None) -> Iterator[Known]:
    """Yield the traces of each seed."""
    for seed in seeds:
        noise = noise_of(Odometry(), seed)
        yield from chain(mazes(3, 24, [seed], noise), mazes(4, 30, [seed], noise))
        if folder:
            every = [*plans(folder, 24, [seed], noise)] if seed % 8 == 0 else []
            yield from every
        if seed % 4 == 0:
            yield from aces3([seed], noise)


def row(name: str, found: Sequence[tuple[float, bool, bool]]) -> str:
    """Sum up answers of similar confidences."""
    mean = f"{statistics.mean(confidence for confidence, _, _ in found):.3f}"
    true, listed = (sum(of) / len(found) for of in list(zip(*found, strict=True))[1:])
    return f"| {name} | {len(found)} | {mean} | {true:.3f} | {listed:.3f} |"


def table(found: Sequence[tuple[float, bool, bool]]) -> str:
    """Sum up all answers in bins of confidences. No confidence counts as 0."""
    rows = [HEAD]
    for low, high in zip(BINS, [*BINS[1:], 2.0], strict=True):
        if some := [one for one in found if low <= one[0] < high]:
            rows.append(row(f"{low:g} to {min(high, 1):g}", some))
    return "\n".join(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    add_number(parser, "--first", "SEED", 0, "the first seed")
    add_number(parser, "--seeds", "N", 20, "seeds")
    add_number(parser, "--work", "W", 1.0, "units of work for each map")
    parser.add_argument("--plans", type=Path, metavar="FOLDER", help="a folder of floor plans")
    parser.add_argument("--save", type=Path, metavar="FILE", help="add the answers to this file")
    options = parser.parse_args()
    found = []
    for known in traces(range(options.first, options.first + options.seeds), options.plans):
        for kind, theory in THEORIES.items():
            solution = solve(known.trace, theory, work_limit=options.work)
            truth = partition(known.dstates), partition(known.places)
            rivals = solution.weighed.rivals if solution.weighed else ()
            true = bool(solution.maps) and is_true(solution.maps[0], known)
            listed = true or truth in [(rival.dstates, rival.places) for rival in rivals]
            found.append((solution.confidence or 0.0, true, listed))
            record = json.dumps([known.name, kind, *found[-1]])
            print(record, flush=True)
            if options.save:
                with options.save.open("a", encoding="utf-8") as file:
                    file.write(f"{record}\n")
    print(f"\n{table(found)}")


if __name__ == "__main__":
    main()
