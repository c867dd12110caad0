"""Localisation over dstates beside localisation over all poses of an occupancy grid.

    python benchmarks/grid_localisation.py [--part aliasing|clutter|growing] [--seeds 10]
                                           [--first 600] [--save JSON] [--plot PNG] [--maps]
    python benchmarks/grid_localisation.py --from JSON [--plot PNG]

The script compares memory, time per step, steps until the robot is localised, and accuracy, on the
same drives. It prints tables for benchmarks/localisation.md and draws the figure of that
page, for which all parts are needed. With --from, it prints and draws stored results. In each
drive, a simulated robot drives at random for 30 steps. Then it is carried to another dstate (a
place and a heading), and drives for 30 more.

    dstates by image, by view
        The bootstrap loop has mapped the world from one exploration run, which tries each action
        at each dstate at least twice. Localiser follows the robot in this map by its images, or by
        the views that the images are clustered into. It reads neither odometry nor stars. If the
        world has changed, it is also measured with the knowledge that the robot is in the map,
        which grid and particles always have ("never nowhere").
    grid
        A histogram filter over cells and headings of an occupancy grid, with a beam model
        (grid_filter.py).
    particles
        Monte Carlo localisation in the same grid, with the same beam model.

Grid and particles are given the true metric map, odometry, and the noise of that odometry. All
methods see the same images, which were taken at dstates. Nothing was tuned on the seeds of the
table.
"""

from __future__ import annotations

import argparse
import json
import math
import pickle
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from time import process_time

import numpy as np
from grid_filter import BeamModel, Filter, Grid, Histogram, Particles
from grid_worlds import Scene, boxes, comb, maze, rectangle, ring, taylor_hall
from localisation import first, in_front, spliced
from numpy.typing import NDArray
from paper_experiments import one_to_one

from perception.appearance import ReciprocalTransformer
from perception.images import images_of
from perception.views import ViewClusterer
from simulator.world import World
from ssh_abduction import Localiser, Trace
from ssh_abduction.learning.learner import BootstrapLearner
from ssh_abduction.online.localiser import LOCATED, Chances

STEPS = 30  # steps of each of the two drives of a run
EXPLORED = 2  # exploration tours
# A pose counts as at a dstate within this many metres and radians of it.
NEAR, FACING = 0.5, math.radians(45)
# The robot is localised once the belief is certain and right for this many steps in a row.
STAYS = 5
SECONDS = 60.0  # time limit for a map
COARSE, FINE = "grid of 10 cm, 5°", "grid of 2.5 cm, 2.5°"


@dataclass(frozen=True)
class Case:
    """A row of a table.

    Attributes:
        name: Name of the row.
        scene: Makes the scene from a seed.
        change: Changes the world after it was mapped; None for no change.
        people: Share of images with a person in front of the laser.
        explored: Number of exploration tours.
        fine: Whether to measure also a fine grid, whose beam model expects less noise.
    """

    name: str
    scene: Callable[[int], Scene]
    change: Callable[[World, np.random.Generator], World] | None = None
    people: float = 0.0
    explored: int = EXPLORED
    fine: bool = False


@dataclass(frozen=True)
class Judged:
    """How well a method followed one drive.

    Attributes:
        method: Name of the method.
        right: For each step, whether the most probable place is the true one.
        sure: For each step, whether some place is certain.
        map_bytes: Size of the map.
        belief_bytes: Largest size of the belief.
        making: CPU seconds to make the map.
        following: CPU seconds for all steps.
    """

    method: str
    right: tuple[bool, ...]
    sure: tuple[bool, ...]
    map_bytes: int
    belief_bytes: int
    making: float
    following: float

    def localised(self, start: int, stop: int) -> int | None:
        """Count the steps from `start` until the belief is certain and right.

        The belief must stay so for STAYS steps. None if this does not happen before `stop`.
        """
        good = [r and s for r, s in zip(self.right, self.sure, strict=True)][start:stop]
        return first(
            [all(good[i : i + STAYS]) and i + STAYS <= len(good) for i in range(len(good))]
        )


@dataclass(frozen=True)
class Drive:
    """What a robot does and sees, and its true dstate and pose at each step.

    Attributes:
        trace: The trace, with images.
        odometry: Displacement to each step but the first, and its covariance. When the robot is
            carried, its odometry reports the displacement of its first action.
        at: Name of the true dstate of each step.
        poses: True pose of each step.
    """

    trace: Trace
    odometry: list[tuple[tuple[float, float, float], NDArray[np.float64]]]
    at: list[str]
    poses: list[tuple[float, float, float]]

    @classmethod
    def of(cls, scene: Scene, case: Case, seed: int) -> Drive:
        """Simulate two drives at random, and join them."""
        parts = [scene.driven(STEPS, 10 * seed + i, case.change) for i in range(2)]
        images = np.concatenate([images_of(part) for part in parts])
        in_front(images, np.random.default_rng(seed), case.people)
        steps = [step for part in parts for step in part.steps]
        noise = parts[0].odometry
        assert noise is not None
        told = [
            step.displacement or parts[0].steps[1].displacement or (0.0, 0.0, 0.0)
            for step in steps[1:]
        ]
        return cls(
            spliced([part.steps for part in parts], images),
            [(displacement, np.array(noise.covariance(displacement))) for displacement in told],
            [str(step.truth["dstate"]) for step in steps],
            [tuple(step.truth["pose"]) for step in steps],
        )


@dataclass(frozen=True)
class Learnt:
    """What the bootstrap loop learnt from an exploration run.

    Attributes:
        learner: The fitted learner.
        truth: Name of the true dstate of each step of the run.
        seconds: CPU seconds for learning.
    """

    learner: BootstrapLearner
    truth: list[str]
    seconds: float

    @classmethod
    def of(cls, scene: Scene, case: Case, seed: int) -> Learnt:
        explored = scene.explored(case.explored, seed)
        learner = BootstrapLearner(None, ViewClusterer(random_state=0), time_limit=SECONDS)
        began = process_time()
        learner.fit(explored)
        return cls(
            learner, [str(step.truth["dstate"]) for step in explored], process_time() - began
        )


BY_IMAGE, SOMEWHERE, BY_VIEW = (
    "dstates by image",
    "dstates by image, never nowhere",
    "dstates by view",
)


def by_dstates(drive: Drive, learnt: Learnt, method: str) -> Judged:
    """Follow a drive with Localiser in the learnt map, by one of its three methods.

    A dstate of the map counts as the true dstate that most of its images show.
    """
    images = method != BY_VIEW
    learner, named = learnt.learner, {}
    for x in range(len(learner.map_.dstates)):
        here = Counter(
            name for name, label in zip(learnt.truth, learner.labels_, strict=True) if label == x
        )
        named[x] = here.most_common(1)[0][0] if here else None
    chances = Chances(unmapped=0.0) if method == SOMEWHERE else Chances()
    localiser = Localiser(learner.map_, learner.recogniser_ if images else None, chances=chances)
    centres = 0 if images else learner.clusterer_.cluster_centers_.nbytes
    began = process_time()
    trace = drive.trace
    if not images:
        seen = learner.clusterer_.predict(ReciprocalTransformer().fit_transform(images_of(trace)))
        trace = trace.with_views(seen.tolist())
    beliefs = list(localiser.beliefs(trace))
    following = process_time() - began
    return Judged(
        method,
        tuple(
            b.dstate is not None and named[b.dstate] == at
            for b, at in zip(beliefs, drive.at, strict=True)
        ),
        tuple(b.probability >= LOCATED for b in beliefs),
        len(pickle.dumps(localiser)) + centres,
        beliefs[0].probabilities.nbytes,
        learnt.seconds,
        following,
    )


def by_poses(drive: Drive, belief: Filter, method: str, grid: Grid, making: float) -> Judged:
    """Follow a drive with a filter over poses.

    Args:
        drive: The drive.
        belief: The filter.
        method: Name of the method.
        grid: Grid of the filter.
        making: CPU seconds to make the grid.
    """
    right, sure, following, most = [], [], 0.0, 0
    for i, (image, pose) in enumerate(zip(images_of(drive.trace), drive.poses, strict=True)):
        began = process_time()
        if i:
            belief.moved(*drive.odometry[i - 1])
        belief.seen(image)
        best = belief.best()
        following += process_time() - began
        most = max(most, belief.bytes)
        off = math.hypot(best[0] - pose[0], best[1] - pose[1])
        right.append(off <= NEAR and abs(math.remainder(best[2] - pose[2], math.tau)) <= FACING)
        sure.append(belief.mass(best, NEAR, FACING) >= LOCATED)
    return Judged(
        method,
        tuple(right),
        tuple(sure),
        grid.ranges.nbytes + grid.occupied.nbytes + grid.free.nbytes,
        most,
        making,
        following,
    )


def run(case: Case, seed: int) -> Iterator[Judged]:
    """Measure all methods on one drive."""
    scene = case.scene(seed)
    drive = Drive.of(scene, case, seed)
    learnt = Learnt.of(scene, case, seed)
    for method in (
        (BY_IMAGE, SOMEWHERE, BY_VIEW) if case.change or case.people else (BY_IMAGE, BY_VIEW)
    ):
        yield by_dstates(drive, learnt, method)
    for method, resolution, headings, sigma in ((COARSE, 0.1, 72, 0.2), (FINE, 0.025, 144, 0.05))[
        : 1 + case.fine
    ]:
        began = process_time()
        grid = Grid.of(scene.world, resolution, headings)
        making = process_time() - began
        model = BeamModel(sigma=sigma)
        yield by_poses(drive, Histogram(grid, model), method, grid, making)
        yield by_poses(
            drive,
            Particles(grid, model, seed=seed),
            method.replace("grid", "particles, grid"),
            grid,
            making,
        )


PARTS: dict[str, list[Case]] = {
    "aliasing": [
        Case("rectangle, no notch", lambda _: rectangle(0.0), explored=10, fine=True),
        Case("rectangle, notch of 3 cm", lambda _: rectangle(0.03), explored=10, fine=True),
        Case("Taylor Hall", lambda _: taylor_hall()),
        Case("six side hallways, all alike", lambda _: comb(6)),
        Case("ring, four sides alike", lambda _: ring(False)),
        Case("ring, one side hallway missing", lambda _: ring(True)),
    ],
    "clutter": [
        *(
            Case(f"Taylor Hall, {n} boxes added", lambda _: taylor_hall(), boxes(n))
            for n in (10, 30)
        ),
        *(
            Case(
                f"Taylor Hall, somebody in front in {p:.0%} of images",
                lambda _: taylor_hall(),
                people=p,
            )
            for p in (0.2, 0.5)
        ),
        Case("Taylor Hall, 30 boxes, somebody in 20%", lambda _: taylor_hall(), boxes(30), 0.2),
    ],
    "growing": [Case(f"maze, {n} x {n}", lambda seed, n=n: maze(n, seed)) for n in (2, 3, 4, 5)],  # type: ignore[misc]
}

Saved = dict[str, dict[str, list[list[Judged]]]]  # by part and case: of each seed, each method


HEAD = (
    "\n{}\n\n| world | belief over | localised after | in | found after being carried | in | right "
    "| sure and wrong | map, kB | belief, kB | CPU ms per step | map made in, CPU s |\n"
    "|---|---|---|---|---|---|---|---|---|---|---|---|"
)


def measured(parts: Sequence[str], seeds: range, save: str | None) -> Saved:
    found: Saved = {}
    for part in parts:
        print(HEAD.format(part), flush=True)
        for case in PARTS[part]:
            found.setdefault(part, {})[case.name] = [list(run(case, seed)) for seed in seeds]
            show(case.name, found[part][case.name])
            if save:
                Path(save).write_text(json.dumps(found, default=asdict))
    return found


def maps(parts: Sequence[str], seeds: range) -> None:
    """Run only the bootstrap loop, and print a table with the number of true maps."""
    print("| world | dstates | steps explored | maps that are the true one |\n|---|---|---|---|")
    for case in (case for part in parts for case in PARTS[part] if part != "clutter"):
        learnt = [Learnt.of(case.scene(seed), case, seed) for seed in seeds]
        right = sum(one_to_one(one.learner.labels_, np.array(one.truth)) for one in learnt)
        sizes = [
            spread([float(size) for size in some], "{:g}")
            for some in ([len(set(x.truth)) for x in learnt], [len(x.truth) for x in learnt])
        ]
        print(f"| {case.name} | {' | '.join(sizes)} | {right} of {len(learnt)} |", flush=True)


def loaded(path: str) -> Saved:
    data = json.loads(Path(path).read_text())
    return {
        part: {
            case: [
                [
                    Judged(
                        **{**judged, "right": tuple(judged["right"]), "sure": tuple(judged["sure"])}
                    )
                    for judged in one
                ]
                for one in runs
            ]
            for case, runs in cases.items()
        }
        for part, cases in data.items()
    }


def show(case: str, runs: Sequence[Sequence[Judged]]) -> None:
    for same in zip(*runs, strict=True):
        print(f"| {case} | {same[0].method} | {' | '.join(cells(same))} |", flush=True)


def cells(runs: Sequence[Judged]) -> list[str]:
    here = [judged.localised(0, STEPS) for judged in runs]
    there = [judged.localised(STEPS, 2 * STEPS) for judged in runs]
    wrong = [
        np.mean([s and not r for r, s in zip(judged.right, judged.sure, strict=True)])
        for judged in runs
    ]
    kilobytes = "{:,.3g}" if runs[0].belief_bytes < 1e5 else "{:,.0f}"
    return [
        *(cell for steps in (here, there) for cell in reached(steps)),
        spread([float(np.mean(judged.right)) for judged in runs], "{:.2f}"),
        spread([float(w) for w in wrong], "{:.2f}"),
        spread([judged.map_bytes / 1000 for judged in runs], "{:,.0f}", False),
        spread([judged.belief_bytes / 1000 for judged in runs], kilobytes, False),
        spread([1000 * judged.following / len(judged.right) for judged in runs], "{:.3g}", False),
        spread([judged.making for judged in runs], "{:.1f}", False),
    ]


def reached(steps: Sequence[int | None]) -> tuple[str, str]:
    """Make two cells: steps until robots were localised, and how many robots were localised."""
    known = [s for s in steps if s is not None]
    return spread([float(s) for s in known], "{:g}"), f"{len(known)} of {len(steps)}"


def spread(values: Sequence[float], form: str, ranged: bool = True) -> str:
    """Format the median of values; if `ranged`, with their range, unless all are equal."""
    if not values:
        return "–"
    told = [form.format(v) for v in (float(np.median(values)), min(values), max(values))]
    return told[0] if not ranged or told[1] == told[2] else f"{told[0]} ({told[1]} to {told[2]})"


COLOURS = {
    BY_IMAGE: "#0072b2",
    SOMEWHERE: "#56b4e9",
    BY_VIEW: "#009e73",
    COARSE: "#d55e00",
    COARSE.replace("grid", "particles, grid"): "#cc79a7",
}
LOCATING = (
    ("aliasing", "six side hallways, all alike"),
    ("clutter", "Taylor Hall, 30 boxes added"),
)


def draw(path: str, found: Saved) -> None:
    """Draw the figure of the page.

    Above is the share of located robots at each step, below are memory and time by the size of a
    maze.
    """
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot

    pyplot.rcParams.update(
        {"font.size": 9, "axes.spines.top": False, "axes.spines.right": False, "figure.dpi": 110}
    )
    figure, (above, below) = pyplot.subplots(2, 2, figsize=(9, 6), layout="constrained")
    for axes, (part, name) in zip(above, LOCATING, strict=True):
        for same in zip(*found[part][name], strict=True):
            located = np.mean(
                [np.logical_and(judged.right, judged.sure) for judged in same], axis=0
            )
            axes.plot(
                range(2 * STEPS),
                located,
                drawstyle="steps-mid",
                color=COLOURS[same[0].method],
                label=same[0].method,
            )
        axes.axvline(STEPS - 0.5, color="#888888", linestyle=":")
        axes.text(STEPS, 1.04, "carried", color="#888888")
        axes.set(title=name, xlabel="step", ylabel="share of runs located", ylim=(0, 1.1))
    sizes = [int(name.split()[-1]) for name in found["growing"]]
    numbers: tuple[tuple[str, Callable[[Judged], float]], ...] = (
        (
            "memory of map and belief, kB",
            lambda judged: (judged.map_bytes + judged.belief_bytes) / 1000,
        ),
        ("CPU time a step, ms", lambda judged: 1000 * judged.following / len(judged.right)),
    )
    for axes, (label, number) in zip(below, numbers, strict=True):
        methods = [list(zip(*runs, strict=True)) for runs in found["growing"].values()]
        for same in zip(*methods, strict=True):
            values = np.array([[number(judged) for judged in seeds] for seeds in same])
            axes.plot(
                sizes,
                np.median(values, axis=1),
                "o-",
                color=COLOURS[same[0][0].method],
                markersize=4,
            )
            axes.fill_between(
                sizes,
                values.min(axis=1),
                values.max(axis=1),
                color=COLOURS[same[0][0].method],
                alpha=0.2,
                linewidth=0,
            )
        axes.set(xlabel="cells along a side of a maze", ylabel=label, yscale="log", xticks=sizes)
    figure.legend(
        *above[1].get_legend_handles_labels(), frameon=False, loc="outside upper center", ncols=3
    )
    figure.savefig(path)
    pyplot.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--part", choices=PARTS, action="append")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first", type=int, default=600)
    parser.add_argument(
        "--maps",
        action="store_true",
        help="only count how many learnt maps are true",
    )
    parser.add_argument("--save", metavar="JSON")
    parser.add_argument("--from", dest="source", metavar="JSON", nargs="+")
    parser.add_argument("--plot", metavar="PNG")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    parts, seeds = options.part or list(PARTS), range(options.first, options.first + options.seeds)
    if options.maps:
        maps(parts, seeds)
        return
    found: Saved = {}
    if options.source:
        for path in options.source:
            for part, cases in loaded(path).items():
                found.setdefault(part, {}).update(cases)
        for part, cases in found.items():
            print(HEAD.format(part))
            for case, runs in cases.items():
                show(case, runs)
    else:
        found = measured(parts, seeds, options.save)
    if options.plot:
        if set(found) != set(PARTS):
            parser.error(
                f"--plot: expected {', '.join(PARTS)}, got {', '.join(found)} only; "
                "measure the others, too"
            )
        draw(options.plot, found)


if __name__ == "__main__":
    main()
