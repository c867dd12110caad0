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
from sklearn.metrics import confusion_matrix, rand_score
from sklearn.model_selection import StratifiedKFold

from perception.appearance import ReciprocalTransformer
from perception.errors import ImageWarning
from perception.images import images_of
from perception.quality import uncertainty_coefficient
from perception.recognition import recogniser
from perception.views import ViewClusterer
from simulator.driver import STILL
from simulator.robot import Laser
from simulator.tours import simulate
from simulator.world import World
from ssh_abduction.data.trace import Trace
from ssh_abduction.learning.learner import BootstrapLearner
from ssh_abduction.solution import Solution
from ssh_abduction.solver import solve
from ssh_abduction.theory.theory import Theory

# The paper's robot has no odometry that would distinguish places.
VIEWS_ALONE = Theory.topological().replace(star="none", displacement="none")
WITH_STARS = Theory.topological().replace(displacement="none")
# U is at most 1. It counts as 1 above this, as it is rounded.
SURE = 1 - 1e-9
# How claims write the numbers of dstates, places and paths, and that errors do not grow.
COUNTS, NONE = "{0.dstates}, {0.places}, {0.paths}", "no growth"


class LearningCurve(NamedTuple):
    """The recognition rate as a function of the number of images seen."""

    sizes: Sequence[int]  # (s,) numbers of images to learn from
    mean: NDArray[np.float64]  # (s,) mean share of recognised images over the folds, in [0, 1]
    lowest: NDArray[np.float64]  # (s,) lowest share over the folds
    highest: NDArray[np.float64]  # (s,) highest share over the folds


@dataclass(frozen=True)
class PaperExperiment:
    """One of the paper's experiments, in the world of the same name."""

    tours: int  # the number of tours that the robot drives
    k_max: int  # the largest number of views (clusters of images) that is tried
    images: int  # the number of images in the paper
    views: int  # the number of views in the paper
    dstates: int  # the number of dstates in the paper
    places: int  # the number of places in the paper
    paths: int  # the number of paths in the paper
    # The claim about the largest k with U = 1, and its value: it is the chosen k, or above it.
    largest: tuple[str, str]


HIGHER = "higher k would still have been free of variability: largest k with U = 1"
EXPERIMENTS = {
    "notched-rectangle": PaperExperiment(
        tours=50,
        k_max=12,
        images=400,
        views=4,
        dstates=8,
        places=4,
        paths=4,
        largest=("largest k with U = 1", "the same k"),
    ),
    "taylor-hall": PaperExperiment(
        tours=10,
        k_max=24,
        images=240,
        views=10,
        dstates=20,
        places=7,
        paths=4,
        largest=(HIGHER, "above 10"),
    ),
}


@dataclass(frozen=True)
class SeedRun:
    """The results of an experiment for one seed.

    Two parts of the paper's method are left out, one at a time. `alone`: images are clustered into
    as many views as there are dstates, without a map. `even`: images are taken at equal distances,
    not at dstates.
    """

    seed: int  # the seed of all noise
    images: int  # the number of images
    k: int  # the chosen number of views (clusters of images)
    quality: dict[int, float]  # M for each number of views that was tried
    uncertainty: dict[int, float]  # U for each number of views that was tried
    largest_k: int  # the largest number of views with U = 1
    # The numbers of dstates, places and paths of the minimal map from the views alone, and with the
    # openings that the robot saw. If there are several minimal maps, their number follows.
    by_views: str
    by_stars: str
    labels_right: bool  # whether labels from the views alone are the true dstates, one to one
    aliased: int  # the number of pairs of true dstates that share a view
    told_apart: int  # the number of these pairs that share no label
    curve: LearningCurve  # the learning curve on these labels
    # The rates, 0 to 1, at which the true dstate of an image is recognised after learning labels.
    # The keys are the sources of the labels: "clustering alone", "map", "truth".
    rates: dict[str, float]
    alone_uncertainty: float  # U if there is one cluster per dstate
    alone_distinct: int  # the number of dstates that then share no cluster with another dstate
    # M and U at the chosen number of views, for images taken at equal distances.
    even: tuple[float, float]
    # For each tour, the largest offset of a pose from the mean pose of its dstate, in x and y
    # (metres) and heading (radians). Shape (tours, 3).
    spread: list[list[float]]


def measure(name: str, seed: int) -> SeedRun:
    """Run "notched-rectangle" or "taylor-hall" from simulation to recognition rates."""
    warnings.simplefilter("ignore", ImageWarning)
    e, world = EXPERIMENTS[name], World.named(name)

    # The bootstrap loop, from the views alone.
    trace = simulate(world, e.tours, seed)
    truth, ranges = true_dstates(trace), images_of(trace)
    clusterer = ViewClusterer(k_max=e.k_max, random_state=seed)
    learner = BootstrapLearner(VIEWS_ALONE, clusterer, time_limit=60).fit(trace)
    found, labels = learner.clusterer_, learner.labels_
    uncertainty = {k: uncertainty_coefficient(of, truth) for k, of in found.labels_by_k_.items()}
    aliased = _aliased(learner.views_, truth)

    # The maps, with the openings that the robot saw.
    starred = solve(trace.with_views(learner.views_.tolist()), WITH_STARS, time_limit=60)

    # Without a map, with as many clusters as dstates.
    alone = found.labels_by_k_[e.dstates]
    shared = {name for pair in _aliased(alone, truth) for name in pair}

    # Images at even distances: |dx| + |dy| per step on average, in metres.
    poses = np.array([step.truth["pose"][:2] for step in trace.steps])
    every = round(float(np.abs(np.diff(poses, axis=0)).sum() / len(poses)), 2)
    even = simulate(world, e.tours, seed, every=every)
    of_even = ViewClusterer(k=found.k_, random_state=seed).fit(
        ReciprocalTransformer().fit_transform(images_of(even))
    )
    even_u = uncertainty_coefficient(of_even.labels_, true_dstates(even))

    # Recognition by labels of the map, compared with clusters alone and with the truth.
    codes = np.unique(truth, return_inverse=True)[1]
    kinds = {"clustering alone": alone, "map": labels, "truth": codes}
    shares = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0)
    sizes = sorted({max(2, round(len(trace) * share)) for share in shares})
    offsets = np.abs(_means_and_offsets(trace, truth)[1])
    return SeedRun(
        seed=seed,
        images=len(trace),
        k=found.k_,
        quality=found.quality_,
        uncertainty=uncertainty,
        largest_k=max((k for k, u in uncertainty.items() if u > SURE), default=1),
        by_views=_counts(learner.solution_),
        by_stars=_counts(starred),
        labels_right=one_to_one(labels, truth),
        aliased=len(aliased),
        told_apart=len(aliased) - len({*aliased} & {*_aliased(labels, truth)}),
        curve=learning_curve(ranges, labels, sizes, seed),
        rates={kind: rate(ranges, of, truth, seed) for kind, of in kinds.items()},
        alone_uncertainty=uncertainty_coefficient(alone, truth),
        alone_distinct=e.dstates - len(shared),
        even=(of_even.quality_[of_even.k_], even_u),
        spread=[part.max(axis=0).tolist() for part in np.array_split(offsets, e.tours)],
    )


def learning_curve(
    images: NDArray[np.float64],
    labels: NDArray[Any],
    sizes: Sequence[int],
    seed: int,
    folds: int = 10,
) -> LearningCurve:
    """Cross-validate the recognition rate for growing numbers of images.

    The images are dealt into folds, one label after the other. For each size m and each fold, a
    recogniser learns from the first m images without those of the fold, and is tested on the whole
    fold. An image whose label was not learnt counts as an error. Labels with one image are not
    tested.

    Args:
        images: (n, d) images in the order in which they were seen.
        labels: (n,) label of each image.
        sizes: Numbers of images to learn from, each from 1 to n.
        seed: Seed of the division into folds.
        folds: Number of folds, at least 2.
    """
    _, of, counts = np.unique(labels, return_inverse=True, return_counts=True)
    shuffled = np.random.RandomState(seed).permutation(len(labels))
    cards = shuffled[np.argsort(of[shuffled], kind="stable")]
    cards = cards[counts[of[cards]] > 1]
    fold = np.full(len(labels), -1)
    fold[cards] = np.arange(len(cards)) % folds
    rates = np.zeros((len(sizes), folds))
    for s, size in enumerate(sizes):
        for f in range(folds):
            test, train = fold == f, np.flatnonzero(fold[:size] != f)
            if len(train):
                known = recogniser().fit(images[train], labels[train])
                rates[s, f] = np.mean(known.predict(images[test]) == labels[test])
    return LearningCurve(sizes, rates.mean(axis=1), rates.min(axis=1), rates.max(axis=1))


def true_dstates(trace: Trace) -> NDArray[Any]:
    """Read the name of the true dstate of each step. This is for evaluation only."""
    return np.array([step.truth["dstate"] for step in trace.steps])


def one_to_one(labels: NDArray[Any], truth: NDArray[Any]) -> bool:
    """Tell whether the labels of n steps and their true dstates are equal up to renaming."""
    return bool((labels >= 0).all()) and rand_score(truth, labels) == 1


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


def _counts(solution: Solution) -> str:
    """Write the numbers of dstates, places and paths, and the number of maps if it is not 1."""
    cost = solution.cost
    if cost is None:
        return "no map"
    several = "" if solution.count == 1 else f" (#{solution.count})"
    return f"{cost.dstates}, {cost.places}, {cost.paths}{several}"


def _means_and_offsets(
    trace: Trace, truth: NDArray[Any]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Compute the mean pose at the true dstate of each of n steps, and the offset from it: (n, 3).

    `truth` has the name of the dstate of each step.
    """
    poses = np.array([step.truth["pose"] for step in trace.steps])
    means = np.empty_like(poses)
    for name in set(truth):
        here = truth == name
        poses[here, 2] = np.unwrap(poses[here, 2])
        means[here] = poses[here].mean(0)
    return means, poses - means


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
    trace = _driven(notch)
    truth = true_dstates(trace)
    means, offsets = _means_and_offsets(trace, truth)
    rng, laser = np.random.default_rng(0), Laser()
    scans = [laser.scan(world, means + scale * offsets, rng) for _ in range(STILL)]
    ranges = np.median(scans, axis=0)
    images = ReciprocalTransformer().fit_transform(ranges)
    clusterer = ViewClusterer(k_max=10, n_init=4, random_state=0).fit(images)
    solution = solve(trace.with_views(clusterer.labels_.tolist()), VIEWS_ALONE, time_limit=5)
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
def _driven(notch: float) -> Trace:
    """Simulate all tours in the rectangle with this notch."""
    return simulate(notched(notch), EXPERIMENTS["notched-rectangle"].tours, 0)


# The claims about an experiment: what is claimed, the value in the paper, and whether the claim is
# ours. Such a claim follows from the argument of the paper, or it is about this robot alone.
CLAIMS = (
    ("k chosen by M, {0.images} images", "{0.views}", False),
    ("U at that k", "1", False),
    ("{0.largest[0]}", "{0.largest[1]}", False),
    ("dstates, places, paths, from the views alone", COUNTS, False),
    ("the same, with the openings seen at each place", COUNTS, True),
    ("labels from the views alone are the true dstates", "yes", False),
    ("dstates that share a view are told apart", "yes", False),
    ("nearest neighbour on abduced labels, all images", "100 %", False),
    ("clustering alone, k = number of dstates: U < 1 or dstates share views", "yes", True),
    ("images at even distances, same k: M and U drop", "yes", True),
    ("recognition by clusters, by map, by truth: first below, the others equal", "yes", True),
    ("errors do not add up: largest offset from a dstate, last tour against first", NONE, True),
)


class Claim(NamedTuple):
    """A claim about an experiment, and what came out in one run."""

    text: str  # the claim
    paper: str  # the value in the paper
    ours: bool  # whether the claim is not in the paper
    here: str  # the value of the run
    holds: bool  # whether the claim holds in the run


def claims(name: str, run: SeedRun) -> list[Claim]:
    """List the claims of the paper about "notched-rectangle" or "taylor-hall", and our own."""
    e, k = EXPERIMENTS[name], run.k
    quality, uncertainty, counts = run.quality[k], run.uncertainty[k], COUNTS.format(e)
    has_largest = run.largest_k == k if name == "notched-rectangle" else run.largest_k > k
    alone, (even_m, even_u) = run.alone_uncertainty, run.even
    rates = [run.rates[kind] for kind in ("clustering alone", "map", "truth")]
    largest = 1000 * np.array(run.spread)[:, :2].max(axis=1)
    # The growth of the largest offset over a run, as a share of its mean, by a linear fit.
    slope = np.polyfit(np.arange(len(largest)), largest, 1)[0]
    growth = float(slope * len(largest) / largest.mean())
    # For each claim, the value of the run, and whether the claim holds.
    found = (
        (f"{k}", k == e.views),
        (f"{uncertainty:.3f}", uncertainty > SURE),
        (f"{run.largest_k}", has_largest),
        (run.by_views, run.by_views == counts),
        (run.by_stars, run.by_stars == counts),
        ("yes" if run.labels_right else "no", run.labels_right),
        (f"{run.told_apart} of {run.aliased} pairs", run.told_apart == run.aliased > 0),
        (f"{100 * run.curve.mean[-1]:.1f} %", run.curve.mean[-1] > 0.9999),
        (
            f"U {alone:.3f}, {run.alone_distinct} of {e.dstates} distinct; "
            f"M {run.quality[e.dstates]:.1f} against {quality:.1f}",
            alone < SURE or run.alone_distinct < e.dstates,
        ),
        (
            f"M {quality:.1f} to {even_m:.2f}, U to {even_u:.2f}",
            even_m < quality and even_u < uncertainty * SURE,
        ),
        (
            ", ".join(f"{100 * rate:.1f}" for rate in rates) + " %",
            rates[0] < rates[1] - 0.02 and abs(rates[1] - rates[2]) < 0.01,
        ),
        (f"{largest[-1]:.0f} mm against {largest[0]:.0f} mm", growth < 0.5),
    )
    return [
        Claim(text.format(e), paper.format(e), ours, here, bool(holds))
        for (text, paper, ours), (here, holds) in zip(CLAIMS, found, strict=True)
    ]


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
