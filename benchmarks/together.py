"""Are the joint maps of several drives through one building true?

    python benchmarks/together.py --family aces3 [--seeds 10] [--stars]
    python benchmarks/together.py --family mazes [--cells 4] [--steps 60] [--seeds 10] [--stars]
    python benchmarks/together.py --family plans --folder ../shared/data/plans [--steps 100]
    python benchmarks/together.py --family worlds --folder FOLDER --causal [--stars]

The script prints a table in Markdown with a row for each joint trace, and a summary below, as
benchmarks/truth.py does. ACES3 is one drive, cut into three that overlap by --overlap places. In
mazes and plans, three robots start at random. Nothing is known of where a drive starts. The noise
is NOISE of benchmarks/truth.py, or that of --noise. A trace of a world has several drives, which an
action "jump…" joins.

With --beam, only the beam searches, with this width and without a time limit. So the load of the
machine does not matter. Its cheapest map is judged. With --join, the maps of single drives are
joined, without any other search.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from itertools import chain, pairwise
from pathlib import Path

from plan_tours import RoomPlan, tour
from truth import (
    NOISE,
    NOISES,
    ROOT,
    Known,
    Noise,
    aces3,
    is_true,
    noise_of,
    random_walk,
    report,
    with_truth,
    worlds,
)

from ssh_abduction import SSHMap, Theory
from ssh_abduction.data import Odometry, together
from ssh_abduction.solver.sources.metric.beam import Beam
from ssh_abduction.solver.sources.metric.joint_drives import Joining
from ssh_abduction.solver.steps.log import Log
from ssh_abduction.theory.settle import settle

DRIVES = 3
JUMP = "jump"  # how the name of an action begins that leads from one drive to the next


def joined(name: str, drives: Sequence[Known]) -> Known:
    """Join drives through one building, whose truth has the same names."""
    names = [f"{name}, drive {i + 1}" for i in range(len(drives))]
    return Known(
        name,
        together([drive.trace for drive in drives], names),
        tuple(state for drive in drives for state in drive.dstates),
        tuple(place for drive in drives for place in drive.places),
    )


def cut(known: Known, drives: int = DRIVES, overlap: int = 2) -> Known:
    """Cut a drive into several. Each shares its last `overlap` places with the next one."""
    moved = [t for t, (p, q) in enumerate(pairwise(known.places), 1) if p != q]
    arrivals = [0, *moved, len(known.trace)]
    visits = len(arrivals) - 1
    own = (visits - overlap) / drives  # visits of each drive that it does not share with the next
    parts = []
    for i in range(drives):
        first = arrivals[round(i * own)]
        stop = arrivals[min(round((i + 1) * own) + overlap, visits)]
        parts.append(
            Known(
                "",
                known.trace[first:stop],
                known.dstates[first:stop],
                known.places[first:stop],
            )
        )
    return joined(known.name, parts)


def of_mazes(
    cells: int, steps: int, seeds: Sequence[int], noise: Noise, drives: int = DRIVES
) -> Iterator[Known]:
    """Yield joint traces of random walks in mazes, one for each seed."""
    for seed in seeds:
        walks = [random_walk(cells, steps, seed, noise, drive) for drive in range(drives)]
        yield joined(walks[0].name, walks)


def of_worlds(folder: Path) -> Iterator[Known]:
    """Yield joint traces of worlds, one for each file, cut where the robot jumped."""
    for known in worlds(folder):
        actions = [action.name for action in known.trace.actions]
        starts = [t for t, name in enumerate(actions, 1) if name.startswith(JUMP)]
        bounds = pairwise([0, *starts, len(known.trace)])
        parts = [
            Known("", known.trace[a:b], known.dstates[a:b], known.places[a:b]) for a, b in bounds
        ]
        yield joined(known.name, parts)


def false_joins(found: SSHMap | None, known: Known) -> int:
    """Count the dstates of a map that are several in truth."""
    real: dict[int, set[object]] = {}
    for dstate, true in zip(found.dstate_at if found else (), known.dstates, strict=False):
        real.setdefault(dstate, set()).add(true)
    return sum(len(names) > 1 for names in real.values())


def report_of_guesses(traces: Iterator[Known], theory: Theory, width: int | None) -> str:
    """Print a row for the map that is guessed for each trace, and return how many are true.

    Args:
        traces: The traces.
        theory: The theory.
        width: The width of a beam, whose cheapest map counts. None to join maps of single drives.
    """
    head = ("trace", "steps", "true dstates", "dstates", "false joins", "cheapest map", "CPU s")
    print(f"| {' | '.join(head)} |\n|{'---|' * len(head)}")
    right = count = 0
    for known in traces:
        begin, problem = time.process_time(), settle(known.trace, theory)
        log = Log(known.trace, problem.theory, problem.pairs)
        if width is not None:
            found = next(Beam(problem, log, width).maps(), None)
        else:
            *_, found = [None, *Joining(problem, log).maps()]  # the last one has the most joins
        true = found is not None and is_true(found, known)
        count, right = count + 1, right + true
        print(
            f"| {known.name} | {len(known.trace)} | {len(set(known.dstates))} "
            f"| {len(found.dstates) if found else '–'} | {false_joins(found, known)} "
            f"| {'true' if true else 'false' if found else 'none'} "
            f"| {time.process_time() - begin:.1f} |",
            flush=True,
        )
    return f"the cheapest map is true: {right} of {count}"


def of_plans(folder: Path, steps: int, seeds: Sequence[int], noise: Noise) -> Iterator[Known]:
    """Yield joint traces of tours of floor plans, one for each plan and seed."""
    for path in sorted(folder.glob("*.xml"), key=lambda path: path.stem.lower()):
        plan = RoomPlan.load(path)
        for seed in seeds:
            name = f"{plan.name}, {seed}"
            tours = [tour(plan, steps, DRIVES * seed + i, noise.odometry) for i in range(DRIVES)]
            yield joined(name, [with_truth("", trace) for trace in tours])


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--family", choices=("aces3", "mazes", "plans", "worlds"), required=True)
    parser.add_argument("--seeds", type=int, metavar="N", help="seeds (default 10; plans 1)")
    parser.add_argument("--first", type=int, default=0, metavar="SEED", help="the first seed")
    parser.add_argument("--cells", type=int, default=4, metavar="N", help="mazes of N x N cells")
    parser.add_argument(
        "--steps", type=int, metavar="N", help="actions of a drive (default: mazes 60, plans 100)"
    )
    parser.add_argument(
        "--folder", type=Path, default=ROOT.parent / "shared" / "data" / "plans", metavar="FOLDER"
    )
    parser.add_argument("--limit", type=float, default=60, metavar="S", help="seconds for each")
    parser.add_argument("--drives", type=int, default=DRIVES, metavar="N", help="drives of a maze")
    parser.add_argument(
        "--overlap", type=int, default=2, metavar="N", help="places that pieces of ACES3 share"
    )
    parser.add_argument(
        "--noise", choices=NOISES, help="errors of odometry, drawn for each seed (default: NOISE)"
    )
    parser.add_argument("--causal", action="store_true", help="solve by the causal theory")
    parser.add_argument("--beam", type=int, metavar="WIDTH", help="search by a beam alone")
    parser.add_argument("--join", action="store_true", help="join maps of single drives alone")
    parser.add_argument("--stars", action="store_true", help="give the solver stars, too")
    parser.add_argument(
        "--displacement", choices=("auto", "none"), default="auto", help="none ignores odometry"
    )
    parser.add_argument("--boundary", default="strict", help="the theory's field boundary")
    options = parser.parse_args()

    def noise_at(seed: int) -> Noise:
        if options.noise is None:
            return Noise(Odometry(**NOISE))
        return noise_of(NOISES[options.noise], seed)

    count = options.seeds or (1 if options.family == "plans" else 10)
    seeds = range(options.first, options.first + count)
    steps = options.steps or (60 if options.family == "mazes" else 100)
    families = {
        "aces3": lambda seed: (
            cut(known, overlap=options.overlap) for known in aces3([seed], noise_at(seed))
        ),
        "mazes": lambda seed: of_mazes(
            options.cells, steps, [seed], noise_at(seed), options.drives
        ),
        "plans": lambda seed: of_plans(options.folder, steps, [seed], noise_at(seed)),
    }
    theory = Theory(
        displacement=options.displacement,
        star="auto" if options.stars else "none",
        boundary=options.boundary,
    )
    if options.causal:
        star = "alike" if options.stars else "none"
        theory = Theory.causal().replace(displacement=options.displacement, star=star)
    if options.family == "worlds":
        traces = of_worlds(options.folder)
    else:
        traces = chain.from_iterable(map(families[options.family], seeds))
    if options.beam is None and not options.join:
        print(f"\n{report(traces, theory, options.limit)}")
    else:
        print(f"\n{report_of_guesses(traces, theory, options.beam)}")


if __name__ == "__main__":
    main()
