"""Are the minimal maps true? Families of traces with displacements and known truth.

    python benchmarks/truth.py --family mazes [--cells 4] [--steps 40] [--seeds 10] [--stars]
    python benchmarks/truth.py --family plans --folder ../shared/data/plans [--steps 100]
    python benchmarks/truth.py --family aces3 [--seeds 10] [--stars]
    python benchmarks/truth.py --family taylor-hall [--seeds 20] [--stars]
    python benchmarks/truth.py --family worlds --folder FOLDER --causal [--stars]

The script prints a table in Markdown with a row for each trace, and a summary below. A map is true
if its labels are the true dstates up to renaming, and its places are the true places. The options
for noise are the fields of Odometry. They set the noise that is drawn and the noise that the trace
states. In Taylor Hall, the robot has noise of its own. `--scale-error` and `--bend-error` add
systematic errors. With `--displacement none`, the solver ignores displacements. `--misread N` and
`--jumped N` make N views and N displacements of each trace wrong. Seeds begin at --first.
"""

from __future__ import annotations

import argparse
import math
import random
import statistics
import sys
import time
from collections.abc import Hashable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path

from arguments import add_number
from instances import displaced, maze
from plan_tours import RoomPlan, tour

from simulator.robot import Body
from ssh_abduction import Solution, Theory, Trace, solve
from ssh_abduction.data import Odometry
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.odometry import Pose
from ssh_abduction.solution import Status
from ssh_abduction.solver import find_backbone

ROOT = Path(__file__).parent.parent
# A small noise: 5 % along the way, 0.5 % across it, and 0.002 rad of heading per metre.
NOISE = {
    "along": 0.05,
    "across": 0.005,
    "heading": 0.002,
    "turning": 0.0,
    "position": 0.0,
    "angle": 0.0,
    "scale": 0.0,
    "bend": 0.0,
    "offset": 0.0,
    "facing": 0.0,
}
NOISES = {"default": Odometry(), "small": Odometry(**NOISE | {"scale": 0.05, "bend": 0.0035})}
# The layout of the ACES3 route: x and y of three columns and three rows of places, in metres.
COLUMNS, ROWS = (-20.0, -1.0, 22.5), (-0.5, -19.0, -39.0)
ACES3 = {
    name: (COLUMNS[i % 3], ROWS[i // 3])
    for i, name in enumerate(("NW", "N", "NE", "W", "C", "E", "SW", "S", "SE"))
}
# What a wrong view and a wrong displacement cost, in dstates, if there are some.
FAULTS = {"misread": 1.5, "jumped": 3.0}
SURE = 0.95  # the confidence from which a map counts as sure
COMPASS = {"E": 0.0, "N": math.pi / 2, "W": math.pi, "S": -math.pi / 2}


@dataclass(frozen=True)
class Known:
    """A trace with a name, and the true dstate and place of each step."""

    name: str
    trace: Trace
    dstates: tuple[Hashable, ...]
    places: tuple[Hashable, ...]


@dataclass(frozen=True)
class Noise:
    """Errors of odometry.

    Attributes:
        odometry: Model of the random noise.
        scale: Share by which reported distances are too long.
        bend: Radians a metre by which the reported heading drifts to the left.
    """

    odometry: Odometry
    scale: float = 0.0
    bend: float = 0.0


def noise_of(odometry: Odometry, seed: int) -> Noise:
    """Draw the errors of scale and drift by their standard deviations."""
    chance = random.Random(seed)
    return Noise(odometry, chance.gauss(0, odometry.scale), chance.gauss(0, odometry.bend))


def partition(names: Sequence[Hashable]) -> tuple[int, ...]:
    """Number names in the order in which they first occur.

    Two sequences that differ only by renaming get equal numbers.
    """
    numbers: dict[Hashable, int] = {}
    return tuple(numbers.setdefault(name, len(numbers)) for name in names)


def is_true(ssh_map: SSHMap, known: Known) -> bool:
    """Check whether the labels of a map and, if it has any, its places are true up to renaming."""
    dstates = partition(ssh_map.dstate_at) == partition(known.dstates)
    return dstates and has_true_places(ssh_map, known)


def has_true_places(ssh_map: SSHMap, known: Known) -> bool:
    """Check whether the places of the steps are true up to renaming, if the map has any."""
    places = [ssh_map.dstates[label].place for label in ssh_map.dstate_at]
    return not ssh_map.places or partition(places) == partition(known.places)


def mazes(cells: int, steps: int, seeds: Sequence[int], noise: Noise) -> Iterator[Known]:
    """Yield random walks in mazes, one for each seed."""
    return (random_walk(cells, steps, seed, noise) for seed in seeds)


def random_walk(cells: int, steps: int, seed: int, noise: Noise, drive: int | None = None) -> Known:
    """Make a random walk in a maze.

    Args:
        cells: Width and height of the maze.
        steps: Steps of the walk.
        seed: Seed of the maze, and of the walk unless `drive` is given.
        noise: Errors of the odometry.
        drive: Number of one of several walks in this maze.
    """
    walk = maze(
        cells,
        cells,
        steps=steps,
        seed=seed,
        stars=True,
        follow=True,
        odometry=noise.odometry,
        scale=noise.scale,
        bend=noise.bend,
        drive=drive,
    )
    return Known(
        f"maze {cells} x {cells}, {seed}",
        walk.trace,
        walk.truth,
        tuple(state[:2] for state in walk.truth if isinstance(state, tuple)),
    )


def with_faults(known: Known, misread: int, jumped: int, seed: int) -> Known:
    """Make some views and displacements of a trace wrong.

    A wrong view is another view of the trace. A wrong displacement is of a travel: its way is at
    most half as long, or the robot turned by 90 degrees without noticing it.

    Args:
        known: The trace.
        misread: The number of wrong views.
        jumped: The number of wrong displacements.
        seed: Seed of the steps and errors.
    """
    chance = random.Random(seed)
    steps = list(known.trace.steps)
    travels = [
        t
        for t, action in enumerate(known.trace.actions, 1)
        if action.kind == "travel" and steps[t].displacement is not None
    ]
    for t in chance.sample(travels, jumped):
        ahead, left, turned = steps[t].displacement or (0.0, 0.0, 0.0)
        wrong = chance.choice(
            [
                (ahead * chance.uniform(0, 0.5), left, turned),
                (ahead, left, turned + math.pi / 2),
                (ahead, left, turned - math.pi / 2),
            ]
        )
        steps[t] = replace(steps[t], displacement=wrong)
    views = sorted({step.view for step in steps}, key=str)
    for t in chance.sample(range(len(steps)), misread):
        other = chance.choice([view for view in views if view != steps[t].view])
        steps[t] = replace(steps[t], view=other)
    return replace(known, trace=replace(known.trace, steps=tuple(steps)))


def plans(folder: Path, steps: int, seeds: Sequence[int], noise: Noise) -> Iterator[Known]:
    for path in sorted(folder.glob("*.xml"), key=lambda path: path.stem.lower()):
        plan = RoomPlan.load(path)
        for seed in seeds:
            trace = tour(plan, steps, seed, noise.odometry, scale=noise.scale, bend=noise.bend)
            yield with_truth(f"{plan.name}, {seed}", trace)


def aces3(seeds: Sequence[int], noise: Noise) -> Iterator[Known]:
    trace = Trace.load(ROOT / "examples" / "aces3-route.jsonl")
    truth = [(step.truth["place"], step.truth["heading"]) for step in trace.steps]
    poses: list[Pose] = [(*ACES3[place], COMPASS[heading]) for place, heading in truth]
    for seed in seeds:
        driven = displaced(trace, poses, noise.odometry, seed, scale=noise.scale, bend=noise.bend)
        yield Known(f"ACES3, {seed}", driven, tuple(truth), tuple(place for place, _ in truth))


def taylor_hall(tours: int, seeds: Sequence[int], noise: Noise) -> Iterator[Known]:
    """Yield drives in Taylor Hall with the robot's own odometry, one for each seed.

    Each is simulated in another process, so that its memory is not measured.
    """
    for seed in seeds:
        with ProcessPoolExecutor(1, get_context("spawn")) as process:
            trace = process.submit(
                drive, tours, seed, Body(scale=noise.scale, bend=noise.bend)
            ).result()
        yield with_truth(f"Taylor Hall, {seed}", trace)


def drive(tours: int, seed: int, body: Body) -> Trace:
    """Simulate tours of Taylor Hall, and cluster the images into views."""
    from perception.appearance import ReciprocalTransformer
    from perception.images import images_of
    from perception.views import ViewClusterer
    from simulator.tours import simulate
    from simulator.world import World

    trace = simulate(World.named("taylor-hall"), tours, seed, body=body)
    clusterer = ViewClusterer(k_max=24, random_state=seed)
    return trace.with_views(
        clusterer.fit(ReciprocalTransformer().fit_transform(images_of(trace))).labels_.tolist()
    )


def worlds(folder: Path) -> Iterator[Known]:
    """Traces of files whose steps have their true dstate; true places are not known."""
    for path in sorted(folder.glob("*.jsonl")):
        trace = Trace.load(path)
        dstates = tuple(step.truth["dstate"] for step in trace.steps if step.truth)
        yield Known(path.stem, trace, dstates, dstates)


def with_truth(name: str, trace: Trace) -> Known:
    """Collect the truth of a trace whose steps state their true dstate and place."""
    return Known(
        name,
        trace,
        *(tuple(step.truth[kind] for step in trace.steps) for kind in ("dstate", "place")),
    )


@dataclass(frozen=True)
class Judged:
    """What came out for one trace.

    Attributes:
        right: Whether all maps that the solver calls best are true, and it has proven so.
        best: Whether the first map is true.
        confidence: The probability that the solver gives the first map; None if it counts.
        places: Whether the places of the first map are true.
        place_confidence: The probability that the solver gives these places; None if it counts.
        joins: For each join of the first map, its probability, and whether it is true.
        seconds: The time of the solver.
    """

    right: bool
    best: bool
    confidence: float | None
    places: bool
    place_confidence: float | None
    joins: tuple[tuple[float, bool], ...]
    seconds: float


def judged(known: Known, theory: Theory, work: float) -> tuple[str, Judged]:
    """Solve a trace, and return a row of the table and what came out."""
    began = time.perf_counter()
    solution = solve(known.trace, theory, work_limit=work)
    seconds = time.perf_counter() - began
    true = [is_true(ssh_map, known) for ssh_map in solution.maps]
    all_true = bool(true) and all(true) and (solution.complete or share_all(solution))
    cost = (
        f"{solution.cost.dstates}, {solution.cost.places}, {solution.cost.paths}"
        if solution.cost
        else "–"
    )
    truth = f"{len(set(known.dstates))}, {len(set(known.places))}"
    more = "" if solution.complete else " or more, all alike" if all_true else " or more"
    listed = f"{sum(true)} of {len(true)}{more}"
    sure = "–" if solution.confidence is None else f"{solution.confidence:.3f}"
    return (
        f"| {known.name} | {len(known.trace)} | {truth} | {solution.status.value} | {cost} | "
        f"{listed} | {sure} | {seconds:.2f} |",
        Judged(
            all_true,
            bool(true) and true[0],
            solution.confidence,
            any(has_true_places(ssh_map, known) for ssh_map in solution.maps[:1]),
            solution.weighed and solution.weighed.place_confidence,
            joins(solution, known),
            seconds,
        ),
    )


def joins(solution: Solution, known: Known) -> tuple[tuple[float, bool], ...]:
    """Each visit to a place where the first map has been before, joined with the visit before.

    Returns:
        For each join, the probability that the solver gives it, and whether it is true. Empty if
        maps are counted, if their costs cannot be trusted, or if a limit ended the search.
    """
    if solution.weighed is None or solution.weighed.doubt is not None:
        return ()
    ssh_map = solution.maps[0]
    at = [ssh_map.dstates[label].place for label in ssh_map.dstate_at]
    last: dict[Hashable, int] = {}
    found = []
    for step, label in enumerate(ssh_map.dstate_at):
        place = label if at[step] is None else at[step]
        if place in last and step - last[place] > 1:
            before = last[place]
            truth = known.dstates if at[step] is None else known.places
            of = "dstate" if at[step] is None else "place"
            probability = solution.probability(before, step, of)
            if probability is not None:  # a finished search
                found.append((probability, truth[before] == truth[step]))
        last[place] = step
    return tuple(found)


def binned(found: Sequence[tuple[float, bool]]) -> dict[int, list[tuple[float, bool]]]:
    """Sort predictions into ten bins by their probability: 0 for 0 to 0.1, 9 for 0.9 to 1."""
    bins: dict[int, list[tuple[float, bool]]] = {}
    for probability, true in sorted(found):
        bins.setdefault(min(int(10 * probability), 9), []).append((probability, true))
    return bins


def reliability(found: Sequence[tuple[float, bool]]) -> tuple[float, float]:
    """The expected calibration error over ten bins, and the Brier score, of predictions."""
    error = sum(
        abs(sum(p for p, _ in members) - sum(true for _, true in members))
        for members in binned(found).values()
    )
    brier = sum((p - true) ** 2 for p, true in found)
    return error / len(found), brier / len(found)


def diagram(found: Sequence[tuple[float, bool]]) -> str:
    """The reliability diagram as text: for each bin its size, mean probability and true share."""
    return ", ".join(
        f"{number / 10:.1f}: {len(members)} at {statistics.mean(p for p, _ in members):.3f}, "
        f"{statistics.mean(true for _, true in members):.3f} true"
        for number, members in binned(found).items()
    )


def share_all(solution: Solution) -> bool:
    """Check whether all minimal maps have the same dstates and places, even if not all are listed.

    Then they differ only in paths.
    """
    if solution.status is not Status.OPTIMAL:
        return False
    shared = find_backbone(solution)
    return (
        shared is not None
        and shared.proven
        and not shared.dstates.sometimes
        and not (shared.places and shared.places.sometimes)
    )


def report(traces: Iterator[Known], theory: Theory, work: float) -> str:
    """Solve each trace, print a row for each, and return the sums."""
    print(
        "| trace | steps | true dstates, places | status | dstates, places, paths | "
        "true maps | confidence | s |\n|---|---|---|---|---|---|---|---|",
        flush=True,
    )
    found = []
    for known in traces:
        text, one = judged(known, theory, work)
        print(text, flush=True)
        found.append(one)
    if not found:
        return "no traces"
    count, median = len(found), statistics.median(one.seconds for one in found)
    told = [
        f"all best maps are true, and proven: {sum(one.right for one in found)} of {count}",
        f"the first map is true: {sum(one.best for one in found)} of {count}",
    ]
    sure = [one for one in found if one.confidence is not None and one.confidence >= SURE]
    if any(one.confidence is not None for one in found):
        told += [
            f"sure: {len(sure)} of {count}",
            f"wrong and sure: {sum(not one.best for one in sure)} of {count}",
            "confidence: "
            + diagram([(one.confidence, one.best) for one in found if one.confidence is not None]),
        ]
        sure = [one for one in found if (one.place_confidence or 0.0) >= SURE]
        told.append(
            f"the places are true: {sum(one.places for one in found)} of {count}; sure of the "
            f"places: {len(sure)}; wrong and sure of them: {sum(not one.places for one in sure)}"
        )
    all_joins = [join for one in found for join in one.joins]
    if all_joins:
        error, brier = reliability(all_joins)
        wrong = sum(not true for _, true in all_joins)
        told.append(
            f"{len(all_joins)} joins, {wrong} of them false: expected calibration error "
            f"{error:.3f}, Brier score {brier:.3f} ({diagram(all_joins)})"
        )
    return "; ".join([*told, f"median {median:.2f} s"])


def arguments() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument(
        "--family", choices=("mazes", "plans", "aces3", "taylor-hall", "worlds"), required=True
    )
    parser.add_argument(
        "--seeds",
        type=int,
        metavar="N",
        help="number of traces, for plans of each plan (default 10; plans 1, taylor-hall 20)",
    )
    add_number(parser, "--first", "SEED", 0, "the first seed")
    add_number(parser, "--cells", "N", 4, "mazes of N x N cells")
    parser.add_argument(
        "--steps", type=int, metavar="N", help="actions of the robot (default: mazes 40, plans 100)"
    )
    add_number(parser, "--tours", "N", 10, "tours of Taylor Hall")
    parser.add_argument(
        "--folder",
        type=Path,
        default=ROOT.parent / "shared" / "data" / "plans",
        metavar="FOLDER",
        help="folder of the plans, or of the traces of worlds",
    )
    parser.add_argument("--noise", choices=NOISES, default="default", help="errors of odometry")
    add_number(parser, "--work", "W", 6.0, "units of work for each")
    parser.add_argument("--stars", action="store_true", help="give the solver stars, too")
    parser.add_argument(
        "--causal", action="store_true", help="use the causal theory, and judge only dstates"
    )
    for name in ("displacement", "boundary", "prefer", "weigh"):
        parser.add_argument(f"--{name}", metavar="CHOICE", help=f"the theory's field {name}")
    for name, price in FAULTS.items():
        parser.add_argument(
            f"--{name}",
            type=int,
            default=0,
            metavar="N",
            help=f"faults of this kind in each trace; each costs {price} dstates (default 0)",
        )
    return parser


def chosen(options: argparse.Namespace) -> Iterator[Known]:
    """Make the traces that the options ask for."""
    count = options.seeds or {"plans": 1, "taylor-hall": 20}.get(options.family, 10)
    if options.family == "worlds":
        yield from worlds(options.folder)
        return
    if options.family == "plans" and not options.folder.is_dir():
        sys.exit(f"--folder: expected a folder of plans, got {options.folder}; name one")
    for seed in range(options.first, options.first + count):
        noise = noise_of(NOISES[options.noise], seed)
        match options.family:
            case "mazes":
                yield from mazes(options.cells, options.steps or 40, [seed], noise)
            case "plans":
                yield from plans(options.folder, options.steps or 100, [seed], noise)
            case "aces3":
                yield from aces3([seed], noise)
            case _:
                yield from taylor_hall(options.tours, [seed], noise)


def main() -> None:
    options = arguments().parse_args()
    choices = {
        name: value
        for name in ("displacement", "boundary", "prefer", "weigh")
        if (value := getattr(options, name))
    } | {name: price for name, price in FAULTS.items() if getattr(options, name)}
    if options.causal:
        theory = Theory.causal().replace(**choices, **({"star": "alike"} if options.stars else {}))
    else:
        theory = Theory.topological().replace(
            **choices, **({} if options.stars else {"star": "none"})
        )
    traces = (
        with_faults(known, options.misread, options.jumped, options.first + i)
        for i, known in enumerate(chosen(options))
    )
    print(f"\n{report(traces, theory, options.work)}")


if __name__ == "__main__":
    main()
