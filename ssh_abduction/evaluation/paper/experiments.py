"""The two experiments of Kuipers & Beeson (2002), measured: simulate, cluster, abduce, learn, and compare with what the paper claims.

Worlds, robot and laser are fixed in `simulator/`; the only thing that differs from run to run is the seed of all noise.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.metrics import confusion_matrix
from sklearn.model_selection import StratifiedKFold

from perception.errors import ImageWarning
from perception.images import images_of
from perception.quality import uncertainty_coefficient
from perception.reciprocal import ReciprocalTransformer
from perception.recognition import LearningCurve, learning_curve, recogniser
from perception.views import ViewClusterer
from simulator.control import STILL
from simulator.laser import Laser
from simulator.tours import simulate
from simulator.world import World
from ssh_abduction.data.trace import Trace
from ssh_abduction.learning.learner import BootstrapLearner
from ssh_abduction.solver import Cost, solve
from ssh_abduction.theory.theory import Theory


@dataclass(frozen=True)
class Experiment:
    """One of the paper's experiments: the world, how many tours, which k are tried, and what the paper reports."""

    world: str
    tours: int
    k_max: int
    views: int
    dstates: int
    places: int
    paths: int


EXPERIMENTS = {
    "notched-rectangle": Experiment(
        "notched-rectangle", tours=50, k_max=12, views=4, dstates=8, places=4, paths=4
    ),
    "taylor-hall": Experiment(
        "taylor-hall", tours=10, k_max=24, views=10, dstates=20, places=7, paths=4
    ),
}
# The paper's robot has no odometry that would tell places apart.
VIEWS_ALONE = Theory.topological().replace(star="none", displacement="none")
WITH_STARS = Theory.topological().replace(displacement="none")


@dataclass(frozen=True)
class Run:
    """What one seed gave.

    quality, uncertainty  M and U for each k
    largest_k             the largest k with U = 1
    cost, maps            counts of the minimal maps from the views alone, and how many maps there are
    star_cost, star_maps  the same when the openings that the robot saw at each place are used too
    right                 the labels from the views alone are the true dstates, one to one
    aliased, told_apart   pairs of true dstates that share a view; how many of them have labels of their own
    curve                 learning curve on the abduced labels
    rates                 recognition of the true dstate by labels from clustering alone, from the map, from the truth
    alone_uncertainty, alone_distinct  U, and how many dstates have a view of their own, of clusters as many as there are dstates
    even_quality, even_uncertainty     M and U at the same k for images at even distances
    spread                (circuits, 3) largest distance of a pose from its dstate's mean, in x, y (metres) and heading (radians)
    """

    seed: int
    images: int
    k: int
    quality: dict[int, float]
    uncertainty: dict[int, float]
    largest_k: int
    cost: dict[str, int] | None
    maps: int
    star_cost: dict[str, int] | None
    star_maps: int
    right: bool
    aliased: int
    told_apart: int
    curve: LearningCurve
    rates: dict[str, float]
    alone_uncertainty: float
    alone_distinct: int
    even_quality: float
    even_uncertainty: float
    spread: list[list[float]]


def measure(name: str, seed: int) -> Run:
    """Run an experiment from simulation to recognition rates."""
    warnings.simplefilter("ignore", ImageWarning)
    e = EXPERIMENTS[name]
    world = World.named(e.world)
    trace = simulate(world, e.tours, seed)
    truth = true_dstates(trace)
    learner = BootstrapLearner(
        VIEWS_ALONE, ViewClusterer(k_max=e.k_max, random_state=seed), time_limit=60
    ).fit(trace)
    ranges = images_of(trace)
    quality = learner.clusterer_.quality_
    labelings = learner.clusterer_.labels_by_k_
    uncertainty = {k: uncertainty_coefficient(labels, truth) for k, labels in labelings.items()}
    starred = solve(trace.with_views(learner.views_.tolist()), WITH_STARS, time_limit=60)
    pairs = _aliased(learner.views_, truth)
    alone = labelings[e.dstates]
    even = simulate(world, e.tours, seed, every=_step(trace))
    even_clusterer = ViewClusterer(k=learner.clusterer_.k_, random_state=seed).fit(
        ReciprocalTransformer().fit_transform(images_of(even))
    )
    sizes = sorted(
        {
            max(2, round(len(trace) * share))
            for share in (0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0)
        }
    )
    return Run(
        seed=seed,
        images=len(trace),
        k=learner.clusterer_.k_,
        quality=quality,
        uncertainty=uncertainty,
        largest_k=max((k for k, u in uncertainty.items() if u > 1 - 1e-9), default=1),
        cost=_counts(learner.solution_.cost),
        maps=learner.solution_.count,
        star_cost=_counts(starred.cost),
        star_maps=starred.count,
        right=one_to_one(learner.labels_, truth),
        aliased=len(pairs),
        told_apart=sum(
            not set(learner.labels_[truth == a]) & set(learner.labels_[truth == b])
            for a, b in pairs
        ),
        curve=learning_curve(ranges, learner.labels_, sizes, random_state=seed),
        rates={
            "clustering alone": rate(ranges, alone, truth, seed),
            "map": rate(ranges, learner.labels_, truth, seed),
            "truth": rate(ranges, np.unique(truth, return_inverse=True)[1], truth, seed),
        },
        alone_uncertainty=uncertainty_coefficient(alone, truth),
        alone_distinct=e.dstates - len({name for pair in _aliased(alone, truth) for name in pair}),
        even_quality=even_clusterer.quality_[even_clusterer.k_],
        even_uncertainty=uncertainty_coefficient(even_clusterer.labels_, true_dstates(even)),
        spread=_spread(trace, truth, e.tours),
    )


def true_dstates(trace: Trace) -> NDArray[Any]:
    """The true dstate of each step, (n,): for evaluation only."""
    return np.array([step.truth["dstate"] for step in trace.steps])


def one_to_one(labels: NDArray[Any], truth: NDArray[Any]) -> bool:
    """Whether labels and true dstates are the same partition of the steps."""
    return bool((labels >= 0).all()) and len(set(zip(labels, truth, strict=True))) == len(
        set(labels)
    ) == len(set(truth))


def rate(
    ranges: NDArray[np.float64], labels: NDArray[Any], truth: NDArray[Any], seed: int
) -> float:
    """Recognition of the true dstate, 10-fold cross-validated, by a recogniser that learns other labels.

    Each label stands for the dstate that it goes with most often in the training part: the best that it can be worth.
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
    """Pairs of dstates that share a view."""
    names = sorted(set(truth))
    seen = {name: set(views[truth == name]) for name in names}
    return [(a, b) for i, a in enumerate(names) for b in names[i + 1 :] if seen[a] & seen[b]]


def _counts(cost: Cost | None) -> dict[str, int] | None:
    return (
        None
        if cost is None
        else {"dstates": cost.dstates, "places": cost.places, "paths": cost.paths}
    )


def _step(trace: Trace) -> float:
    """Metres between two dstates on average: images at even distances are as many."""
    poses = np.array([step.truth["pose"][:2] for step in trace.steps])
    return round(float(np.abs(np.diff(poses, axis=0)).sum() / len(poses)), 2)


def _spread(trace: Trace, truth: NDArray[Any], tours: int) -> list[list[float]]:
    """How far poses are from their dstate's mean, circuit by circuit."""
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
class Claim:
    """Something that the paper says, what it says it is, and how a run shows it.

    ours  the paper does not say it: it follows from its argument, or it is asked of this robot alone
    """

    text: str
    paper: str
    here: Callable[[Run], str]
    holds: Callable[[Run], bool]
    ours: bool = False


def claims(name: str) -> list[Claim]:
    """What the paper claims of an experiment, and what follows from its argument."""
    e = EXPERIMENTS[name]
    triple = f"{e.dstates}, {e.places}, {e.paths}"
    right = {"dstates": e.dstates, "places": e.places, "paths": e.paths}
    if name == "notched-rectangle":
        largest = Claim(
            "largest k with U = 1",
            "the same k",
            lambda r: str(r.largest_k),
            lambda r: r.largest_k == r.k,
        )
    else:
        higher = "higher k would still have been free of variability: largest k with U = 1"
        largest = Claim(
            higher, f"above {e.views}", lambda r: str(r.largest_k), lambda r: r.largest_k > r.k
        )
    return [
        Claim(
            f"k chosen by M, {'400' if e.views == 4 else '240'} images",
            str(e.views),
            lambda r: str(r.k),
            lambda r: r.k == e.views,
        ),
        Claim(
            "U at that k",
            "1",
            lambda r: f"{r.uncertainty[r.k]:.3f}",
            lambda r: r.uncertainty[r.k] > 1 - 1e-9,
        ),
        largest,
        Claim(
            "dstates, places, paths, from the views alone",
            triple,
            lambda r: _triple(r.cost, r.maps),
            lambda r: r.cost == right and r.maps == 1,
        ),
        Claim(
            "the same, with the openings seen at each place",
            triple,
            lambda r: _triple(r.star_cost, r.star_maps),
            lambda r: r.star_cost == right and r.star_maps == 1,
            ours=True,
        ),
        Claim(
            "labels from the views alone are the true dstates",
            "yes",
            lambda r: "yes" if r.right else "no",
            lambda r: r.right,
        ),
        Claim(
            "dstates that share a view are told apart",
            "yes",
            lambda r: f"{r.told_apart} of {r.aliased} pairs",
            lambda r: r.told_apart == r.aliased > 0,
        ),
        Claim(
            "nearest neighbour on abduced labels, all images",
            "100 %",
            lambda r: f"{100 * r.curve.mean[-1]:.1f} %",
            lambda r: r.curve.mean[-1] > 0.9999,
        ),
        Claim(
            "clustering alone, k = number of dstates: U < 1 or dstates share views",
            "yes",
            lambda r: (
                f"U {r.alone_uncertainty:.3f}, {r.alone_distinct} of {e.dstates} distinct; M {r.quality[e.dstates]:.1f} against {r.quality[r.k]:.1f}"
            ),
            lambda r: r.alone_uncertainty < 1 - 1e-9 or r.alone_distinct < e.dstates,
            ours=True,
        ),
        Claim(
            "images at even distances, same k: M and U drop",
            "yes",
            lambda r: (
                f"M {r.quality[r.k]:.1f} to {r.even_quality:.2f}, U to {r.even_uncertainty:.2f}"
            ),
            lambda r: (
                r.even_quality < r.quality[r.k] and r.even_uncertainty < r.uncertainty[r.k] - 1e-9
            ),
            ours=True,
        ),
        Claim(
            "recognition by clusters, by map, by truth: first below, the others equal",
            "yes",
            lambda r: (
                ", ".join(
                    f"{100 * r.rates[kind]:.1f}" for kind in ("clustering alone", "map", "truth")
                )
                + " %"
            ),
            lambda r: (
                r.rates["clustering alone"] < r.rates["map"] - 0.02
                and abs(r.rates["map"] - r.rates["truth"]) < 0.01
            ),
            ours=True,
        ),
        Claim(
            "errors do not add up: largest offset from a dstate, last tour against first",
            "no growth",
            lambda r: (
                f"{1000 * max(r.spread[-1][:2]):.0f} mm against {1000 * max(r.spread[0][:2]):.0f} mm"
            ),
            lambda r: _trend(r) < 0.5,
            ours=True,
        ),
    ]


def _triple(cost: dict[str, int] | None, maps: int) -> str:
    if cost is None:
        return "no map"
    return (
        f"{cost['dstates']}, {cost['places']}, {cost['paths']}{'' if maps == 1 else f' (#{maps})'}"
    )


def _trend(run: Run) -> float:
    """Growth of the offset over the whole run, as a share of its mean: the slope of a straight line, times the number of tours."""
    largest = np.array([max(row[:2]) for row in run.spread])
    slope = np.polyfit(np.arange(len(largest)), largest, 1)[0]
    return float(slope * len(largest) / largest.mean())


def summary(name: str, runs: Sequence[Run]) -> list[dict[str, Any]]:
    """Each claim: whether it is the paper's or ours, what is expected, what came out by seed, and in how many seeds it holds."""
    return [
        {
            "claim": claim.text,
            "ours": claim.ours,
            "paper": claim.paper,
            "here": {str(run.seed): claim.here(run) for run in runs},
            "holds": sum(claim.holds(run) for run in runs),
            "seeds": len(runs),
        }
        for claim in claims(name)
    ]


def to_dict(run: Run) -> dict[str, Any]:
    """A run as plain data."""
    return asdict(run)


@dataclass(frozen=True)
class Outcome:
    """What the method gives for one notch and one spread of poses.

    notch   depth, metres
    scale   the offsets of the robot's poses from their dstate's mean are so many times what hill-climbing left
    spread  root mean square of the offsets of the positions, metres
    """

    notch: float
    scale: float
    spread: float
    k: int
    uncertainty: float
    right: bool
    rate: float


def outcome(notch: float, scale: float, seed: int = 0) -> Outcome:
    """Images of the notched rectangle with another notch: from the dstates that the robot found there, with its offsets scaled."""
    warnings.simplefilter("ignore", ImageWarning)
    world = notched(notch)
    means, offsets, truth = _driven(notch, seed)
    rng, laser = np.random.default_rng(seed), Laser()
    scans = [laser.scan(world, means + scale * offsets, rng) for _ in range(STILL)]
    ranges = np.median(scans, axis=0)
    images = ReciprocalTransformer().fit_transform(ranges)
    clusterer = ViewClusterer(k_max=10, n_init=4, random_state=seed).fit(images)
    actions = [world.route[i % len(world.route)] for i in range(len(means) - 1)]
    solution = solve(
        Trace.from_steps(clusterer.labels_.tolist(), actions), VIEWS_ALONE, time_limit=5
    )
    return Outcome(
        notch,
        scale,
        scale * float(np.sqrt((offsets[:, :2] ** 2).sum(1).mean())),
        clusterer.k_,
        uncertainty_coefficient(clusterer.labels_, truth),
        solution.complete
        and solution.count == 1
        and one_to_one(np.array(solution.maps[0].labels), truth),
        rate(ranges, np.unique(truth, return_inverse=True)[1], truth, seed),
    )


def notched(depth: float) -> World:
    """The notched rectangle with a notch of another depth, in metres."""
    world = World.named("notched-rectangle")
    segments = world.segments.copy()
    segments[:, 1::2] = np.where(segments[:, 1::2] < 0, -depth, segments[:, 1::2])
    return replace(world, segments=segments)


@cache
def _driven(
    notch: float, seed: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[Any]]:
    """For each pose of 50 circuits: the mean pose at its dstate, (n, 3), how far it is off it, (n, 3), and the dstate."""
    trace = simulate(notched(notch), EXPERIMENTS["notched-rectangle"].tours, seed)
    truth = true_dstates(trace)
    poses = np.array([step.truth["pose"] for step in trace.steps])
    means = np.empty_like(poses)
    for name in set(truth):
        here = truth == name
        poses[here, 2] = np.unwrap(poses[here, 2])
        means[here] = poses[here].mean(0)
    return means, poses - means, truth
