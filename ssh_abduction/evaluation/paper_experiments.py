"""Run the two experiments of Kuipers & Beeson (2002): simulate, cluster, find maps, learn.

Worlds, robot and laser are fixed in `simulator/`. Runs differ only in the seed of all noise. M
measures how well clusters of images are separated. U measures how well the dstate determines the
view: it is 1 if all images of a dstate have one view.

The notched rectangle is a room with a notch in one wall. Runs with other depths of the notch, and
other spreads of poses, show how deep the notch must be, and how small the spread, for the method to
work.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from sklearn.metrics import confusion_matrix
from sklearn.model_selection import StratifiedKFold

from perception.appearance import ReciprocalTransformer
from perception.errors import ImageWarning
from perception.images import images_of
from perception.quality import uncertainty_coefficient
from perception.recognition import LearningCurve, learning_curve, recogniser
from perception.views import ViewClusterer
from simulator.driver import STILL
from simulator.robot import Laser
from simulator.tours import simulate
from simulator.world import World
from ssh_abduction.data.trace import Trace
from ssh_abduction.learning.learner import BootstrapLearner
from ssh_abduction.solver import Solution, solve
from ssh_abduction.theory.theory import Theory

# The paper's robot has no odometry that would distinguish places.
VIEWS_ALONE = Theory.topological().replace(star="none", displacement="none")
WITH_STARS = Theory.topological().replace(displacement="none")


@dataclass(frozen=True)
class PaperExperiment:
    """One of the paper's experiments."""

    world: str  # the name of the world
    tours: int  # the number of tours that the robot drives
    k_max: int  # the largest number of views (clusters of images) that is tried
    views: int  # the number of views in the paper
    dstates: int  # the number of dstates in the paper
    places: int  # the number of places in the paper
    paths: int  # the number of paths in the paper


EXPERIMENTS = {
    "notched-rectangle": PaperExperiment(
        "notched-rectangle", tours=50, k_max=12, views=4, dstates=8, places=4, paths=4
    ),
    "taylor-hall": PaperExperiment(
        "taylor-hall", tours=10, k_max=24, views=10, dstates=20, places=7, paths=4
    ),
}


@dataclass(frozen=True)
class Clustering:
    """The views (clusters of images) of one seed."""

    k: int  # the chosen number of views
    quality: dict[int, float]  # M for each number of views that was tried
    uncertainty: dict[int, float]  # U for each number of views that was tried
    largest_k: int  # the largest number of views with U = 1


@dataclass(frozen=True)
class FoundMaps:
    """The minimal maps of one seed."""

    # The numbers of dstates, places and paths of a minimal map; None if no map was found.
    cost: dict[str, int] | None
    maps: int  # the number of minimal maps

    @classmethod
    def of(cls, solution: Solution) -> FoundMaps:
        """Read the counts of a solution."""
        cost = solution.cost
        if cost is None:
            return cls(None, solution.count)
        counts = {"dstates": cost.dstates, "places": cost.places, "paths": cost.paths}
        return cls(counts, solution.count)


@dataclass(frozen=True)
class Labelling:
    """The labels of steps that follow from the views alone, compared with the true dstates."""

    right: bool  # whether the labels are the true dstates, one to one
    aliased: int  # the number of pairs of true dstates that share a view
    told_apart: int  # the number of these pairs that share no label


@dataclass(frozen=True)
class Contrast:
    """Results without a part of the paper's method.

    Two parts are left out, one at a time. First there are no maps: images are clustered into as
    many views as there are dstates. Second, images are taken at equal distances, not at dstates.
    """

    alone_uncertainty: float  # U if there is one cluster per dstate
    alone_distinct: int  # the number of dstates that then share no cluster with another dstate
    even_quality: float  # M at the chosen number of views, for images taken at equal distances
    even_uncertainty: float  # U at the chosen number of views, for the same images


@dataclass(frozen=True)
class SeedRun:
    """The results of an experiment for one seed."""

    seed: int  # the seed of all noise
    images: int  # the number of images
    clustering: Clustering  # the views
    by_views: FoundMaps  # the minimal maps from the views alone
    by_stars: FoundMaps  # the minimal maps from the views and the openings that the robot saw
    labelling: Labelling  # the labels of steps that follow from the views alone
    curve: LearningCurve  # the learning curve on these labels
    # The rates, 0 to 1, at which the true dstate of an image is recognised after learning labels.
    # The keys are the sources of the labels: "clustering alone", "map", "truth".
    rates: dict[str, float]
    contrast: Contrast  # results without a part of the method
    # For each tour, the largest offset of a pose from the mean pose of its dstate, in x and y
    # (metres) and heading (radians). Shape (tours, 3).
    spread: list[list[float]]


def measure(name: str, seed: int) -> SeedRun:
    """Run "notched-rectangle" or "taylor-hall" from simulation to recognition rates."""
    warnings.simplefilter("ignore", ImageWarning)
    e = EXPERIMENTS[name]

    # The bootstrap loop, from the views alone.
    trace = simulate(World.named(e.world), e.tours, seed)
    truth, ranges = true_dstates(trace), images_of(trace)
    clusterer = ViewClusterer(k_max=e.k_max, random_state=seed)
    learner = BootstrapLearner(VIEWS_ALONE, clusterer, time_limit=60).fit(trace)

    # The maps, with the openings that the robot saw.
    starred = solve(trace.with_views(learner.views_.tolist()), WITH_STARS, time_limit=60)

    # Recognition by labels of the map, compared with clusters alone and with the truth.
    alone = learner.clusterer_.labels_by_k_[e.dstates]
    kinds = {
        "clustering alone": alone,
        "map": learner.labels_,
        "truth": np.unique(truth, return_inverse=True)[1],
    }
    shares = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0)
    sizes = sorted({max(2, round(len(trace) * share)) for share in shares})
    return SeedRun(
        seed=seed,
        images=len(trace),
        clustering=_clustering(learner, truth),
        by_views=FoundMaps.of(learner.solution_),
        by_stars=FoundMaps.of(starred),
        labelling=_labelling(learner, truth),
        curve=learning_curve(ranges, learner.labels_, sizes, random_state=seed),
        rates={kind: rate(ranges, labels, truth, seed) for kind, labels in kinds.items()},
        contrast=_contrast(e, seed, trace, alone, learner.clusterer_.k_),
        spread=_spread(trace, truth, e.tours),
    )


def true_dstates(trace: Trace) -> NDArray[Any]:
    """Read the name of the true dstate of each step. This is for evaluation only."""
    return np.array([step.truth["dstate"] for step in trace.steps])


def one_to_one(labels: NDArray[Any], truth: NDArray[Any]) -> bool:
    """Tell whether the labels of n steps and their true dstates are equal up to renaming."""
    return bool((labels >= 0).all()) and len(set(zip(labels, truth, strict=True))) == len(
        set(labels)
    ) == len(set(truth))


def rate(
    ranges: NDArray[np.float64], labels: NDArray[Any], truth: NDArray[Any], seed: int
) -> float:
    """Measure how often a recogniser that learns labels recognises the true dstate.

    The rate is cross-validated in ten folds. A recognised label counts as the true dstate that
    has this label most often in the training part. `ranges`, of shape (n, d), are in metres;
    `labels` and `truth` are of shape (n,).
    """
    found = []
    for train, test in StratifiedKFold(10, shuffle=True, random_state=seed).split(ranges, truth):
        names, codes = np.unique(labels[train], return_inverse=True)
        dstates, of = np.unique(truth[train], return_inverse=True)
        size = max(len(names), len(dstates))
        meaning = confusion_matrix(codes, of, labels=range(size)).argmax(axis=1)
        model = recogniser().fit(ranges[train], codes)
        found.append(np.mean(dstates[meaning[model.predict(ranges[test])]] == truth[test]))
    return float(np.mean(found))


def _aliased(views: NDArray[Any], truth: NDArray[Any]) -> list[tuple[str, str]]:
    """List the pairs of true dstates that share a view."""
    names = sorted(set(truth))
    seen = {name: set(views[truth == name]) for name in names}
    return [(a, b) for i, a in enumerate(names) for b in names[i + 1 :] if seen[a] & seen[b]]


def _clustering(learner: BootstrapLearner, truth: NDArray[Any]) -> Clustering:
    """Measure the views of a learner for each number of views that was tried."""
    clusterer = learner.clusterer_
    uncertainty = {
        k: uncertainty_coefficient(labels, truth) for k, labels in clusterer.labels_by_k_.items()
    }
    largest = max((k for k, u in uncertainty.items() if u > 1 - 1e-9), default=1)
    return Clustering(clusterer.k_, clusterer.quality_, uncertainty, largest)


def _labelling(learner: BootstrapLearner, truth: NDArray[Any]) -> Labelling:
    """Compare the labels of a learner with the true dstates."""
    labels = learner.labels_
    pairs = _aliased(learner.views_, truth)
    told_apart = sum(not set(labels[truth == a]) & set(labels[truth == b]) for a, b in pairs)
    return Labelling(one_to_one(labels, truth), len(pairs), told_apart)


def _contrast(e: PaperExperiment, seed: int, trace: Trace, alone: NDArray[Any], k: int) -> Contrast:
    """Measure the results without a part of the method.

    `alone` has the cluster of each image, with as many clusters as dstates. `k` is the chosen
    number of views, also of images at equal distances.
    """
    truth = true_dstates(trace)
    shared = {name for pair in _aliased(alone, truth) for name in pair}
    even = simulate(World.named(e.world), e.tours, seed, every=_step(trace))
    clusterer = ViewClusterer(k=k, random_state=seed).fit(
        ReciprocalTransformer().fit_transform(images_of(even))
    )
    return Contrast(
        alone_uncertainty=uncertainty_coefficient(alone, truth),
        alone_distinct=e.dstates - len(shared),
        even_quality=clusterer.quality_[clusterer.k_],
        even_uncertainty=uncertainty_coefficient(clusterer.labels_, true_dstates(even)),
    )


def _step(trace: Trace) -> float:
    """The distance at which to take images evenly: |dx| + |dy| per step on average, in metres."""
    poses = np.array([step.truth["pose"][:2] for step in trace.steps])
    return round(float(np.abs(np.diff(poses, axis=0)).sum() / len(poses)), 2)


def _spread(trace: Trace, truth: NDArray[Any], tours: int) -> list[list[float]]:
    """Compute `SeedRun.spread`: the largest offset of a pose from its dstate's mean, by tour."""
    poses = np.array([step.truth["pose"] for step in trace.steps])
    off = np.zeros_like(poses)
    for name in set(truth):
        here = truth == name
        turned = np.angle(np.exp(1j * (poses[here, 2] - poses[here, 2][0])))
        off[here] = np.column_stack(
            [poses[here, :2] - poses[here, :2].mean(0), turned - turned.mean()]
        )
    return [[float(v) for v in np.abs(part).max(0)] for part in np.array_split(off, tours)]


@dataclass(frozen=True)
class NotchOutcome:
    """The result of the method for one notch and one spread of poses.

    The offset of a pose is its difference from the mean pose at its dstate.
    """

    notch: float  # the depth of the notch in metres
    scale: float  # the factor by which the offsets that the robot left are multiplied
    spread: float  # the root mean square of the multiplied offsets of positions in metres
    k: int  # the chosen number of views
    uncertainty: float  # U at that number of views (1 if all images of a dstate have one view)
    # Whether there is only one minimal map, and its labels are the true dstates, one to one.
    right: bool
    # The rate, 0 to 1, at which the true dstate is recognised after learning true labels.
    rate: float


def outcome(notch: float, scale: float) -> NotchOutcome:
    """Take images in the notched rectangle with another notch, and run the method on them.

    The notch is in metres. `scale` is the factor for the offsets of the robot's poses from the
    mean pose at their dstate.
    """
    warnings.simplefilter("ignore", ImageWarning)
    # Scan at the poses that the robot drove to, with their offsets scaled.
    world = notched(notch)
    means, offsets, truth = _driven(notch)
    rng, laser = np.random.default_rng(0), Laser()
    scans = [laser.scan(world, means + scale * offsets, rng) for _ in range(STILL)]
    ranges = np.median(scans, axis=0)
    images = ReciprocalTransformer().fit_transform(ranges)
    clusterer = ViewClusterer(k_max=10, n_init=4, random_state=0).fit(images)
    actions = [world.route[i % len(world.route)] for i in range(len(means) - 1)]
    solution = solve(
        Trace.from_steps(clusterer.labels_.tolist(), actions), VIEWS_ALONE, time_limit=5
    )
    is_only = solution.complete and solution.count == 1
    return NotchOutcome(
        notch=notch,
        scale=scale,
        spread=scale * float(np.sqrt((offsets[:, :2] ** 2).sum(1).mean())),
        k=clusterer.k_,
        uncertainty=uncertainty_coefficient(clusterer.labels_, truth),
        right=is_only and one_to_one(np.array(solution.maps[0].dstate_at), truth),
        rate=rate(ranges, np.unique(truth, return_inverse=True)[1], truth, 0),
    )


def notched(depth: float) -> World:
    """Make the notched rectangle with a notch of this depth in metres."""
    world = World.named("notched-rectangle")
    segments = world.segments.copy()
    segments[:, 1::2] = np.where(segments[:, 1::2] < 0, -depth, segments[:, 1::2])
    return replace(world, segments=segments)


@cache
def _driven(notch: float) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[Any]]:
    """Simulate all tours in the rectangle with this notch.

    Return three arrays with a row for each of n steps: the mean pose at its true dstate, of shape
    (n, 3); the offset of its own pose from this mean, of shape (n, 3); and the name of the dstate.
    """
    trace = simulate(notched(notch), EXPERIMENTS["notched-rectangle"].tours, 0)
    truth = true_dstates(trace)
    poses = np.array([step.truth["pose"] for step in trace.steps])
    means = np.empty_like(poses)
    for name in set(truth):
        here = truth == name
        poses[here, 2] = np.unwrap(poses[here, 2])
        means[here] = poses[here].mean(0)
    return means, poses - means, truth


class Claim(NamedTuple):
    """A claim about an experiment, and what came out in one run."""

    text: str  # the claim
    paper: str  # the value in the paper
    here: str  # the value of the run
    holds: bool  # whether the claim holds in the run
    # Whether the claim is not in the paper. Then it follows from the argument of the paper, or it
    # is about this robot alone.
    ours: bool = False


def claims(name: str, run: SeedRun) -> list[Claim]:
    """List the claims of the paper about "notched-rectangle" or "taylor-hall", and our own."""
    e, views, labels, without = EXPERIMENTS[name], run.clustering, run.labelling, run.contrast
    quality, uncertainty = views.quality[views.k], views.uncertainty[views.k]
    is_determined = uncertainty > 1 - 1e-9
    counts = f"{e.dstates}, {e.places}, {e.paths}"
    right = FoundMaps({"dstates": e.dstates, "places": e.places, "paths": e.paths}, maps=1)
    if name == "notched-rectangle":
        largest = "largest k with U = 1", "the same k"
        is_largest = views.largest_k == views.k
    else:
        higher = "higher k would still have been free of variability: largest k with U = 1"
        largest = higher, f"above {e.views}"
        is_largest = views.largest_k > views.k
    alone, even = without.alone_uncertainty, without.even_uncertainty
    rates = [run.rates[kind] for kind in ("clustering alone", "map", "truth")]
    first, last = (1000 * max(run.spread[tour][:2]) for tour in (0, -1))
    return [
        Claim(
            f"k chosen by M, {'400' if e.views == 4 else '240'} images",
            str(e.views),
            str(views.k),
            views.k == e.views,
        ),
        Claim("U at that k", "1", f"{uncertainty:.3f}", is_determined),
        Claim(*largest, str(views.largest_k), is_largest),
        Claim(
            "dstates, places, paths, from the views alone",
            counts,
            _counts(run.by_views),
            run.by_views == right,
        ),
        Claim(
            "the same, with the openings seen at each place",
            counts,
            _counts(run.by_stars),
            run.by_stars == right,
            ours=True,
        ),
        Claim(
            "labels from the views alone are the true dstates",
            "yes",
            "yes" if labels.right else "no",
            labels.right,
        ),
        Claim(
            "dstates that share a view are told apart",
            "yes",
            f"{labels.told_apart} of {labels.aliased} pairs",
            labels.told_apart == labels.aliased > 0,
        ),
        Claim(
            "nearest neighbour on abduced labels, all images",
            "100 %",
            f"{100 * run.curve.mean[-1]:.1f} %",
            run.curve.mean[-1] > 0.9999,
        ),
        Claim(
            "clustering alone, k = number of dstates: U < 1 or dstates share views",
            "yes",
            f"U {alone:.3f}, {without.alone_distinct} of {e.dstates} distinct; "
            f"M {views.quality[e.dstates]:.1f} against {quality:.1f}",
            alone < 1 - 1e-9 or without.alone_distinct < e.dstates,
            ours=True,
        ),
        Claim(
            "images at even distances, same k: M and U drop",
            "yes",
            f"M {quality:.1f} to {without.even_quality:.2f}, U to {even:.2f}",
            without.even_quality < quality and even < uncertainty - 1e-9,
            ours=True,
        ),
        Claim(
            "recognition by clusters, by map, by truth: first below, the others equal",
            "yes",
            ", ".join(f"{100 * rate:.1f}" for rate in rates) + " %",
            rates[0] < rates[1] - 0.02 and abs(rates[1] - rates[2]) < 0.01,
            ours=True,
        ),
        Claim(
            "errors do not add up: largest offset from a dstate, last tour against first",
            "no growth",
            f"{last:.0f} mm against {first:.0f} mm",
            _trend(run) < 0.5,
            ours=True,
        ),
    ]


def _counts(found: FoundMaps) -> str:
    """Write the numbers of dstates, places and paths, and the number of maps if it is not 1."""
    cost = found.cost
    if cost is None:
        return "no map"
    several = "" if found.maps == 1 else f" (#{found.maps})"
    return f"{cost['dstates']}, {cost['places']}, {cost['paths']}{several}"


def _trend(run: SeedRun) -> float:
    """The growth of the largest offset over a run, as a share of its mean, by a linear fit."""
    largest = np.array([max(row[:2]) for row in run.spread])
    slope = np.polyfit(np.arange(len(largest)), largest, 1)[0]
    return float(slope * len(largest) / largest.mean())


def summary(name: str, runs: Sequence[SeedRun]) -> list[dict[str, Any]]:
    """Make a table of the claims about an experiment from its runs, one for each seed.

    A row has the value in the paper, the value for each seed, and the number of runs in which
    the claim holds.
    """
    seeds = [str(run.seed) for run in runs]
    return [
        {
            "claim": same[0].text,
            "ours": same[0].ours,
            "paper": same[0].paper,
            "here": dict(zip(seeds, (claim.here for claim in same), strict=True)),
            "holds": sum(claim.holds for claim in same),
            "seeds": len(runs),
        }
        for same in zip(*(claims(name, run) for run in runs), strict=True)
    ]
