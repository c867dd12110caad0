"""Holds what a clusterer found: the clusterings that it tried, and how it names new images."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.neighbors import NearestNeighbors

from perception.quality import NOISE, cluster_quality, trimmed_quality

# There is a runner-up if trimmed M of the chosen k is below this multiple of the largest trimmed M
# of the others. docs/measurements/reproduction.md has measurements.
NEAR = 1.5
# A larger k is also a runner-up if its trimmed M is at least this, because each of a few distant
# views can hide several well-separated ones.
APART = 2.3
# Values of trimmed M within this factor of the largest count as equal, and the smallest k wins.
EQUAL = 0.95
# The distance of an image to its third nearest neighbour decides whether it is isolated. So two or
# three images of one unusual object are isolated, too.
NEIGHBOURS = 3


@dataclass(frozen=True)
class Tried:
    """The clusterings that a ViewClusterer tried, and its choice."""

    k: int  # the chosen number of views
    # For each number of views k that was tried, M: the gap between clusters divided by their width
    # (`perception.quality.cluster_quality`).
    quality: dict[int, float]
    # The same, but with quantiles instead of extremes (`trimmed_quality`).
    trimmed: dict[int, float]
    labels: dict[int, NDArray[np.intp]]  # for each k that was tried, the view of each image, (n,)

    @property
    def runner_up(self) -> int | None:
        """Another k whose views may make a better map; see `ViewClusterer.runner_up_`."""
        others = {k: worth for k, worth in self.trimmed.items() if k != self.k}
        if others and self.trimmed[self.k] < NEAR * max(others.values()):
            return smallest_good(others)
        finer = {k: worth for k, worth in others.items() if k > self.k and worth >= APART}
        return max(finer, key=finer.__getitem__, default=None)


@dataclass(frozen=True)
class Predictor:
    """Gives views to new images."""

    model: Any  # the fitted clusterer, or a classifier if the clusterer cannot predict
    # (m, d) the fitted images that are not isolated; empty if the settings isolate none.
    inside: NDArray[np.float64]
    # An image is isolated if its third nearest neighbour is farther than this.
    reach: float = math.inf

    def views(self, images: NDArray[np.float64]) -> NDArray[np.intp]:
        """Predict the view of each image, (n,); -1 for an isolated image."""
        views = np.asarray(self.model.predict(images), np.intp)
        if 0 < self.reach < math.inf:
            views[to_neighbour(images, self.inside, 0) > self.reach] = NOISE
        return views


def single(fitted: Any, images: NDArray[np.float64], trim: float) -> tuple[Any, Tried]:
    """Return a fitted clusterer, and a `Tried` that holds its clustering alone."""
    labels = cluster_labels(fitted, images)
    inside = labels != NOISE
    k = len(set(labels[inside].tolist()))
    measures = math.nan, math.nan
    if inside.any():
        some = images[inside], labels[inside]
        measures = cluster_quality(*some), trimmed_quality(*some, trim)
    return fitted, Tried(k, {k: measures[0]}, {k: measures[1]}, {k: labels})


def smallest_good(worth: dict[int, float]) -> int:
    """The smallest k whose trimmed M (`worth`) is at least EQUAL times the largest."""
    return min(k for k in worth if not worth[k] < EQUAL * max(worth.values()))


def cluster_labels(fitted: Any, images: NDArray[np.float64]) -> NDArray[np.intp]:
    """The cluster of each fitted image, (n,). Mixtures have no labels_ and predict instead."""
    return np.asarray(
        fitted.labels_ if hasattr(fitted, "labels_") else fitted.predict(images), np.intp
    )


def to_neighbour(
    images: NDArray[np.float64], among: NDArray[np.float64], itself: int
) -> NDArray[np.float64]:
    """The distance from each image, (n, d), to its third nearest neighbour `among` (m, d): (n,).

    With fewer neighbours it is the distance to the farthest one. `itself` is 1 if `among`
    contains the images themselves, otherwise 0.
    """
    number = min(NEIGHBOURS + itself, len(among))
    distances, _ = (
        NearestNeighbors(n_neighbors=number, algorithm="brute").fit(among).kneighbors(images)
    )
    return np.asarray(distances[:, -1])
