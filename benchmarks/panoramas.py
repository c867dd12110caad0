"""Bootstrap learning on simulated panoramas: which features and which clusterings suit them.

    python benchmarks/panoramas.py [--seeds 300-302]
    python benchmarks/panoramas.py --figure docs/figures/panoramas.png

The script makes the tables and the figure of benchmarks/panoramas.md. The images of a drive
are clustered into at most 24 views, whose number is chosen by M (`perception.quality`). The drive
is mapped from the views alone, in at most two seconds. Its recogniser is tested on a second drive
at other hours. Each seed has its own drive, noise and textures.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import warnings
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import networkx as nx
import numpy as np
import streets
from arguments import seeds_from
from numpy.typing import NDArray
from panorama_camera import Camera, Paint
from paper_experiments import VIEWS_ALONE, one_to_one, true_dstates
from scipy.optimize import linear_sum_assignment
from sklearn.base import BaseEstimator, TransformerMixin
from sklearn.cluster import HDBSCAN, AgglomerativeClustering, SpectralClustering
from sklearn.mixture import GaussianMixture
from sklearn.preprocessing import FunctionTransformer
from threadpoolctl import threadpool_limits

from perception.appearance import PanoramaTransformer
from perception.errors import ImageWarning, PerceptionError
from perception.images import images_of
from perception.quality import uncertainty_coefficient
from perception.recognition import PlaceRecogniser
from perception.views import ViewClusterer
from simulator.tours import simulate
from simulator.world import World
from ssh_abduction.data.trace import Trace
from ssh_abduction.learning.learner import (
    AmbiguousMapWarning,
    BootstrapLearner,
    LearnerError,
    RunnerUpWarning,
)

Pixels = NDArray[np.float64]
SECONDS, MOST_VIEWS = 2.0, 24
DOUBTS = (ImageWarning, RunnerUpWarning, AmbiguousMapWarning)
# The first and last hour of the drive to learn from, and of the drive to recognise.
LIGHTS = {"lamps": ((20.0, 20.0), (20.0, 20.0)), "a day": ((7.0, 19.0), (18.0, 8.0))}
TEXTURES = {"unique": False, "repeated": True}
TOURS = {"notched rectangle": 8, "Taylor Hall": 4, "maze": 4}


@cache
def world(name: str) -> World:
    if name != "maze":
        return World.named(name.lower().replace(" ", "-"))
    graph = nx.Graph()
    graph.add_nodes_from(
        ((x, y), {"at": complex(5 * x, 5 * y)}) for x in range(3) for y in range(2)
    )
    graph.add_edges_from(
        [
            ((0, 0), (1, 0)),
            ((1, 0), (2, 0)),
            ((2, 0), (2, 1)),
            ((2, 1), (1, 1)),
            ((1, 1), (1, 0)),
            ((0, 1), (1, 1)),
        ]
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "maze.json"
        path.write_text(json.dumps(streets.drawn(graph, 0.8, ((0, 0), (1, 0)), name="maze")))
        return World.load(path)


def of_each_image(pixels: Pixels) -> Pixels:
    """Standardise each colour of each image to mean 0 and standard deviation 1."""
    images = pixels.reshape(len(pixels), -1, 3)
    made = (images - images.mean(axis=1, keepdims=True)) / images.std(axis=1, keepdims=True)
    return made.reshape(len(pixels), -1)


def gradients(pixels: Pixels) -> Pixels:
    """Compute histograms of oriented gradients (Dalal and Triggs 2005) of grey panoramas.

    A histogram has 8 directions. There is one for each cell of 6 x 12 pixels, normalised.
    """
    grey = pixels.reshape(-1, 24, 180, 3).mean(axis=3)
    up, along = (
        np.gradient(grey, axis=1),
        (np.roll(grey, -1, axis=2) - np.roll(grey, 1, axis=2)) / 2,
    )
    strength, direction = np.hypot(along, up), np.arctan2(up, along) / np.pi * 4 % 8
    low, share = np.floor(direction).astype(int) % 8, direction % 1
    histograms = sum(
        np.where(np.arange(8) == (part % 8)[..., None], (strength * weight)[..., None], 0)
        for part, weight in ((low, 1 - share), (low + 1, share))
    )
    cells = np.asarray(histograms).reshape(-1, 4, 6, 15, 12, 8).mean(axis=(2, 4))
    cells /= np.linalg.norm(cells, axis=3, keepdims=True) + 1
    return cells.reshape(len(pixels), -1)


class Whitened(TransformerMixin, BaseEstimator):  # type: ignore[misc]
    """Whitens raw pixels: projects them on the principal components with 95 % of the variance."""

    def fit(self, X: Pixels, y: Any = None) -> Whitened:
        self.mean_ = X.mean(axis=0)
        _, spread, axes = np.linalg.svd(X - self.mean_, full_matrices=False)
        held = int(np.searchsorted(np.cumsum(spread**2) / (spread**2).sum(), 0.95)) + 1
        self.axes_ = axes[:held] / spread[:held, None] * np.sqrt(len(X))
        return self

    def transform(self, X: Pixels) -> Pixels:
        return np.asarray((X - self.mean_) @ self.axes_.T)


FEATURES: dict[str, Any] = {
    "raw pixels": FunctionTransformer(),
    "raw pixels, whitened": Whitened(),
    "each image normalised": FunctionTransformer(of_each_image),
    "oriented gradients": FunctionTransformer(gradients),
    "PanoramaTransformer": PanoramaTransformer((24, 180, 3)),
}
CLUSTERERS: dict[str, Any] = {
    "k-means": None,
    "agglomerative, average": AgglomerativeClustering(2, linkage="average"),
    "Ward": AgglomerativeClustering(2),
    "Gaussian mixture, spherical": GaussianMixture(2, covariance_type="spherical", n_init=3),
    "spectral, 5 neighbours": SpectralClustering(2, affinity="nearest_neighbors", n_neighbors=5),
    "HDBSCAN, 3 or more": HDBSCAN(min_cluster_size=3),
}


@dataclass(frozen=True)
class Found:
    """The result of one drive.

    Attributes:
        k: Number of views.
        quality: M of the views.
        purity: U of the views, which is 1 if each true dstate has one view.
        distinct: Number of views divided by that of true dstates. Below 1, some dstates share a
            view; above 1, some have several.
        right: Whether the map has the true dstates.
        said: Whether there was a warning, or no map.
        doubted: Whether a warning said that images are doubtful, views overlap, or another number
            of views gives another map. Warnings about unproven maps do not count, as they depend
            on the machine.
        recognised: Share of images of the second drive whose nearest image of the first drive has
            the same true dstate. It measures the features, and does not depend on the map.
        by_map: Share of images of the second drive that the learnt recogniser labels correctly,
            with labels and true dstates matched one to one; 0 without a map.
    """

    k: int
    quality: float
    purity: float
    distinct: float
    right: bool
    said: bool
    doubted: bool
    recognised: float
    by_map: float


class Rotated(TransformerMixin, BaseEstimator):  # type: ignore[misc]
    """Features in the space that the fitted images span, which has at most one dimension per image.

    Distances between the fitted images stay the same, and k-means is about ten times as fast.
    """

    def __init__(self, features: Any = None) -> None:
        self.features = features

    def fit(self, X: Pixels, y: Any = None) -> Rotated:
        made = self.features.fit_transform(X)
        self.mean_ = made.mean(axis=0)
        self.axes_ = np.linalg.svd(made - self.mean_, full_matrices=False)[2]
        return self

    def transform(self, X: Pixels) -> Pixels:
        """Project images onto the space of the fitted images.

        The part of an image outside this space adds the same to the squares of all its distances
        from fitted images. So that part can be dropped.
        """
        return np.asarray((self.features.transform(X) - self.mean_) @ self.axes_.T)


def drives(name: str, light: str, texture: str, seed: int) -> tuple[Trace, Trace]:
    """Simulate a drive to learn from, and a drive to recognise.

    Args:
        name: Name of the world.
        light: Key of LIGHTS.
        texture: Key of TEXTURES.
        seed: Seed of drives, noise and textures.
    """
    camera = Camera(paint=Paint(seed, TEXTURES[texture]))
    first, second = (replace(camera, hours=hours) for hours in LIGHTS[light])
    return simulate(world(name), TOURS[name], seed, camera=first), simulate(
        world(name), 1, 10_000 + seed, camera=second
    )


def found(learnt: Trace, asked: Trace, features: str, clusterer: str) -> Found:
    """Learn from one drive, recognise the images of another, and compare both with the truth.

    Args:
        learnt: The drive to learn from.
        asked: The drive to recognise.
        features: Key of FEATURES.
        clusterer: Key of CLUSTERERS.
    """
    truth, asked_truth = true_dstates(learnt), true_dstates(asked)
    made = Rotated(FEATURES[features])
    learner = BootstrapLearner(
        VIEWS_ALONE,
        ViewClusterer(k_max=MOST_VIEWS, clusterer=CLUSTERERS[clusterer], random_state=0),
        time_limit=SECONDS,
        features=made,
    )
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        with suppress(LearnerError, PerceptionError):
            learner.fit(learnt)
    said = not hasattr(learner, "labels_") or any(issubclass(w.category, DOUBTS) for w in caught)
    doubted = any(
        w.category is ImageWarning or "give another map" in str(w.message) for w in caught
    )
    views, first = learner.views_, learner.features_.transform(images_of(learnt))
    second = learner.features_.transform(images_of(asked))
    mapped = by_map = 0.0
    if hasattr(learner, "labels_"):
        mapped = one_to_one(learner.labels_, truth)
        names = named(learner.labels_, truth)
        by_map = float(
            np.mean(
                [
                    names.get(label) == name
                    for label, name in zip(learner.predict(asked), asked_truth, strict=True)
                ]
            )
        )
    return Found(
        k=learner.clusterer_.k_,
        quality=learner.clusterer_.quality_[learner.clusterer_.k_],
        purity=uncertainty_coefficient(views, truth),
        distinct=len(set(views.tolist())) / len(set(truth.tolist())),
        right=bool(mapped),
        said=said,
        doubted=doubted,
        recognised=float(
            np.mean(PlaceRecogniser().fit(first, truth).predict(second) == asked_truth)
        ),
        by_map=by_map,
    )


def named(labels: NDArray[np.intp], truth: NDArray[Any]) -> dict[int, str]:
    """Match labels with true dstates one to one, so that most images have the right label.

    Returns:
        Dict from label to the name of the true dstate.
    """
    of_label, of_name = np.unique(labels), np.unique(truth)
    counts = np.array(
        [[np.sum((labels == label) & (truth == name)) for name in of_name] for label in of_label]
    )
    return {
        int(of_label[i]): str(of_name[j])
        for i, j in zip(*linear_sum_assignment(-counts), strict=True)
    }


def measured(job: tuple[str, str, str, int], pairs: list[tuple[str, str]]) -> list[Found]:
    with threadpool_limits(1):
        learnt, asked = drives(*job)
        return [found(learnt, asked, features, clusterer) for features, clusterer in pairs]


def cells(results: list[Found]) -> str:
    """Make the cells of a row of a table, from the results of its drives."""
    ks = sorted({r.k for r in results})
    qualities = [r.quality for r in results]
    wrong_silently = sum(not r.right and not r.said for r in results)
    right_doubted = sum(r.right and r.doubted for r in results)
    return " | ".join(
        [
            f"{ks[0]}" if len(ks) == 1 else f"{ks[0]}–{ks[-1]}",
            f"{min(qualities):.2f}–{max(qualities):.2f}",
            f"{np.mean([r.purity for r in results]):.2f}",
            f"{np.mean([r.distinct for r in results]):.2f}",
            f"{sum(r.right for r in results)} of {len(results)}",
            str(wrong_silently),
            str(right_doubted),
            f"{100 * np.mean([r.recognised for r in results]):.1f} %",
            f"{100 * np.mean([r.by_map for r in results]):.1f} %",
        ]
    )


HEAD = (
    "k by M | M | U | views by dstates | map right | wrong, and nothing said | right, and "
    "doubted | recognised, by truth | by the map"
)


def tables(seeds: list[int], workers: int) -> Iterator[str]:
    """Measure, and yield the lines of the two tables.

    The first table compares features in all worlds, the second one clusterings over a day.

    Args:
        seeds: Seeds of the drives.
        workers: Number of processes.
    """
    by_k_means = [(features, "k-means") for features in FEATURES]
    others = [
        ("PanoramaTransformer", clusterer) for clusterer in CLUSTERERS if clusterer != "k-means"
    ]
    others += [
        ("raw pixels", clusterer) for clusterer in ("agglomerative, average", "HDBSCAN, 3 or more")
    ]
    rows: dict[tuple[str, str], list[Found]] = {}
    yield (
        f"| world | light | textures | features | {HEAD} "
        "|\n|---|---|---|---|---|---|---|---|---|---|---|---|---|"
    )
    with ProcessPoolExecutor(workers) as pool:
        for group in [
            (name, light, texture) for name in TOURS for light in LIGHTS for texture in TEXTURES
        ]:
            pairs = by_k_means + (others if group[1] == "a day" else [])
            results = list(
                pool.map(partial(measured, pairs=pairs), [(*group, seed) for seed in seeds])
            )
            for i, pair in enumerate(pairs):
                of_pair = [result[i] for result in results]
                if group[1] == "a day":
                    rows.setdefault(pair, []).extend(of_pair)
                if pair in by_k_means:
                    yield f"| {' | '.join(group)} | {pair[0]} | {cells(of_pair)} |"
    yield (f"\n| features | clustering | {HEAD} |\n|---|---|---|---|---|---|---|---|---|---|---|")
    for pair in sorted(
        rows, key=lambda pair: (list(FEATURES).index(pair[0]), list(CLUSTERERS).index(pair[1]))
    ):
        if pair[0] in ("raw pixels", "PanoramaTransformer"):
            yield f"| {' | '.join(pair)} | {cells(rows[pair])} |"


def figure(path: Path, seed: int = 1) -> None:
    """Draw some panoramas into a file."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    room, hall, rng = world("notched rectangle"), world("Taylor Hall"), np.random.default_rng(0)
    corner, opposite = room.dstates[1].pose, room.dstates[5].pose
    shots = [
        ("notched rectangle, a corner, lamps, unique textures", room, corner, False, 20.0),
        ("the opposite corner", room, opposite, False, 20.0),
        ("the first corner, lamps, repeated textures", room, corner, True, 20.0),
        ("the opposite corner", room, opposite, True, 20.0),
        ("the same, at 7 o'clock", room, opposite, True, 7.0),
        ("the same, at 12 o'clock", room, opposite, True, 12.0),
        ("Taylor Hall, unique textures, 12 o'clock", hall, hall.dstates[0].pose, False, 12.0),
        ("the same, at 18 o'clock", hall, hall.dstates[0].pose, False, 18.0),
    ]
    _, axes = plt.subplots(4, 2, figsize=(9, 3.6))
    for ax, (title, place, pose, repeated, hour) in zip(axes.flat, shots, strict=True):
        ax.imshow(
            Camera(paint=Paint(seed, repeated)).shot(place, pose, rng, hour),
            interpolation="nearest",
        )
        ax.set_title(title, fontsize=7, pad=2)
        ax.axis("off")
    plt.tight_layout(pad=0.4)
    plt.savefig(path, dpi=100)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seeds", default="300-302", help="first and last seed")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--figure", type=Path, metavar="PNG", help="draw some panoramas instead")
    options = parser.parse_args()
    if options.figure:
        figure(options.figure)
        return
    for line in tables(seeds_from(options.seeds), options.workers):
        print(line, flush=True)


if __name__ == "__main__":
    main()
