"""Where M chooses too few or too many views, whether a warning says so, and trimmed M beside it.

    python benchmarks/doubts.py [--seeds 200-204] [--tours 10]
    python benchmarks/doubts.py --tolerances      # spread of poses and k by the tolerance

The script makes the table of benchmarks/reproduction.md. M and trimmed M measure how well
views separate images (`perception.quality`). Each row is the notched rectangle with one change: the
size of the room, the notch, the noise, single scans instead of medians of nine, or images that show
a person. The map is solved from the views alone, in at most two seconds.
"""

from __future__ import annotations

import argparse
import re
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from arguments import seeds_from
from numpy.typing import NDArray
from paper_experiments import (
    VIEWS_ALONE,
    notched,
    one_to_one,
    true_dstates,
)

from perception.appearance import ReciprocalTransformer
from perception.errors import ImageWarning, PerceptionError
from perception.images import images_of
from perception.views import ViewClusterer
from simulator.driver import Tolerance
from simulator.robot import Laser
from simulator.tours import simulate
from simulator.world import World
from ssh_abduction.data.trace import Trace
from ssh_abduction.learning.learner import (
    AmbiguousMapWarning,
    BootstrapLearner,
    LearnerError,
    RunnerUpWarning,
)
from ssh_abduction.solver import solve

WORLD = World.named("notched-rectangle")
SECONDS = 2.0
DOUBTS = (ImageWarning, RunnerUpWarning, AmbiguousMapWarning)


@dataclass(frozen=True)
class Case:
    """A row of the table.

    Attributes:
        name: Name of the row.
        world: The world.
        noise: Standard deviation of a range, in metres.
        single: Whether images are single scans, in which some beams are lost.
        bad: What is wrong with some images, and the number of these images.
    """

    name: str
    world: World = WORLD
    noise: float = 0.005
    single: bool = False
    bad: tuple[str, int] = ("", 0)


def cases() -> Iterator[Case]:
    yield Case("as above")
    for larger in (1.05, 1.1, 1.2, 1.5):
        yield Case(f"room {100 * larger - 100:.0f} % longer and wider", room(larger))
    yield Case("notch 6 cm deep", notched(0.06))
    yield Case("single scans, 0.1 % of beams lost", single=True)
    for side in (0.05, 0.1, 0.2, 0.3, 0.4):
        yield Case(f"notch in a corner, {100 * side:.0f} cm", corner(side))
    for times in (2, 4):
        yield Case(f"noise x {times}", noise=0.005 * times)
    for kind in ("person in front", "person at the side", "random image"):
        for count in (1, 2, 3, 4):
            yield Case(f"{kind}, {count} of the images", bad=(kind, count))


def room(times: float) -> World:
    """Enlarge the notched rectangle by a factor; the notch keeps its size."""
    walls = WORLD.segments.copy()
    walls[walls > 0] *= times
    x, y = 4 * times - 0.6, 2 * times - 0.6

    def moved(at: Sequence[float]) -> tuple[float, float]:
        return x if at[0] > 2 else 0.6, y if at[1] > 1 else 0.6

    return replace(
        WORLD,
        segments=walls,
        start=(x, y, 0.0),
        dstates=tuple(replace(s, pose=(*moved(s.pose), s.pose[2])) for s in WORLD.dstates),
        places={name: moved(at) for name, at in WORLD.places.items()},
    )


def corner(side: float) -> World:
    """Make a rectangle in which a square is cut off at one corner; its side is in metres."""
    points = np.array([[0, 0], [4 - side, 0], [4 - side, side], [4, side], [4, 2], [0, 2]])
    return replace(WORLD, segments=np.hstack([points, np.roll(points, -1, axis=0)]))


def spoilt(
    images: NDArray[np.float64], kind: str, count: int, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Copy images, and make some of them bad.

    Args:
        images: (n, 180) metres.
        kind: "person in front", "person at the side", or "random image".
        count: Number of bad images.
        rng: Source of random choices.

    Returns:
        The copy, and the indices of the bad images.
    """
    images, which = images.copy(), rng.choice(len(images), count, replace=False)
    for i in which:
        if kind == "random image":
            images[i] = rng.uniform(0.1, 8, images.shape[1])
        else:
            first, last, far = (70, 110, 0.4) if kind == "person in front" else (5, 40, 0.35)
            images[i, first:last] = np.minimum(
                images[i, first:last], far + rng.normal(0, 0.01, last - first)
            )
    return images, which


def with_images(trace: Trace, images: NDArray[np.float64]) -> Trace:
    """Replace the images of a trace."""
    seen = [tuple(image) for image in images.tolist()]
    steps = (replace(s, image=image) for s, image in zip(trace.steps, seen, strict=True))
    return replace(trace, steps=tuple(steps))


def driven(case: Case, tours: int, seed: int) -> tuple[Trace, NDArray[np.intp]]:
    """Simulate a drive. Return its trace with images, and the indices of the bad images."""
    laser, rng = Laser(noise=case.noise), np.random.default_rng(seed)
    trace = simulate(case.world, tours, seed, laser=laser)
    images = images_of(trace)
    if case.single:
        images = laser.scan(case.world, np.array([step.truth["pose"] for step in trace.steps]), rng)
    images, bad = spoilt(images, *case.bad, rng)
    return with_images(trace, images), bad


@dataclass(frozen=True)
class Found:
    """The result of clustering and mapping one drive.

    Attributes:
        k: Number of views.
        right: Whether the map is the true one.
        mended: Whether the map is the true one if the images that a warning names get the right
            views.
        said: Whether there was a warning, or no map.
    """

    k: int
    right: bool
    mended: bool
    said: bool


def found(trace: Trace, by: str) -> Found:
    """Cluster the images of a trace, solve the map, and compare it with the truth.

    Args:
        trace: The trace.
        by: Criterion for the number of views: "M" or "trimmed".
    """
    truth = true_dstates(trace)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        learner = BootstrapLearner(
            VIEWS_ALONE, ViewClusterer(by=by, random_state=0), time_limit=SECONDS
        )
        try:
            learner.fit(trace)
        except (LearnerError, PerceptionError):
            return Found(learner.clusterer_.k_, False, False, True)
    said = [w for w in caught if issubclass(w.category, DOUBTS)]
    right = one_to_one(learner.labels_, truth)
    told = next(
        (
            re.search(r"\((?:image) ([\d, ]+)", str(w.message))
            for w in said
            if "fit no view" in str(w.message)
        ),
        None,
    )
    doubtful = [int(i) for i in told.group(1).strip(", ").split(", ")] if told else []
    return Found(
        learner.clusterer_.k_,
        right,
        right or _mended(trace, learner.views_.copy(), truth, doubtful),
        bool(said),
    )


def _mended(
    trace: Trace, views: NDArray[np.intp], truth: NDArray[np.str_], doubtful: list[int]
) -> bool:
    sure = np.setdiff1d(np.arange(len(views)), doubtful)
    for i in doubtful:
        alike = views[sure[truth[sure] == truth[i]]]
        views[i] = np.bincount(alike).argmax() if len(alike) else views[i]
    solution = solve(trace.with_views(views.tolist()), VIEWS_ALONE, time_limit=SECONDS)
    return bool(solution.maps) and one_to_one(np.array(solution.maps[0].dstate_at), truth)


def rows(seeds: list[int], tours: int) -> Iterator[str]:
    """Make the table, line by line."""
    yield (
        "| the notched rectangle, but | k by M | map right | wrong, and nothing said | "
        "right, and doubted | k by trimmed M | map right | with doubtful images mended |"
    )
    yield "|---|---|---|---|---|---|---|---|"
    for case in cases():
        runs = [driven(case, tours, seed)[0] for seed in seeds]
        by = {name: [found(trace, name) for trace in runs] for name in ("M", "trimmed")}
        cells = []
        for name, results in by.items():
            ks = sorted({r.k for r in results})
            cells += [
                str(ks[0]) if len(ks) == 1 else f"{ks[0]}–{ks[-1]}",
                str(sum(r.right for r in results)),
            ]
            if name == "M":
                cells += [
                    str(sum(not r.right and not r.said for r in results)),
                    str(sum(r.right and r.said for r in results)),
                ]
        yield f"| {case.name} | {' | '.join(cells)} | {sum(r.mended for r in by['trimmed'])} |"


def tolerances(seeds: list[int], tours: int) -> Iterator[str]:
    """Make a table of tolerances of hill-climbing, which are the errors with which the robot stops.

    Yields:
        The head, and a row for each tolerance: the root mean square distance of positions from the
        mean of their dstate in millimetres, and the number of views chosen by M.
    """
    usual = Tolerance()
    yield "| tolerance | spread, mm | k by M |"
    yield "|---|---|---|"
    for times in (0.25, 0.5, 1, 1.5, 2, 3, 4):
        tolerance = Tolerance(times * usual.close, times * usual.straight, times * usual.aside)
        spreads, ks = [], []
        for seed in seeds:
            trace = simulate(WORLD, tours, seed, tolerance=tolerance)
            truth, at = (
                true_dstates(trace),
                np.array([step.truth["pose"][:2] for step in trace.steps]),
            )
            off = np.concatenate(
                [at[truth == name] - at[truth == name].mean(axis=0) for name in set(truth)]
            )
            spreads.append(1000 * float(np.sqrt((off**2).sum(axis=1).mean())))
            ks.append(
                ViewClusterer(k_max=10, random_state=0)
                .fit(ReciprocalTransformer().fit_transform(images_of(trace)))
                .k_
            )
        yield f"| x {times:g} | {np.mean(spreads):.1f} | {', '.join(map(str, ks))} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seeds", default="200-204", help="first and last seed")
    parser.add_argument("--tours", type=int, default=10)
    parser.add_argument(
        "--tolerances",
        action="store_true",
        help="print the spread of poses for each tolerance of hill-climbing instead",
    )
    options = parser.parse_args()
    seeds = seeds_from(options.seeds)
    for line in (tolerances if options.tolerances else rows)(seeds, options.tours):
        print(line, flush=True)


if __name__ == "__main__":
    main()
