"""Measures how well clusters separate images.

M and trimmed M compare distances between images. U compares the clusters with the true states.
The confidence of an image is high if it is near its own cluster and far from the next one.

>>> import numpy as np
>>> images = np.array([[0.0], [1.0], [5.0], [6.0]])
>>> float(cluster_quality(images, [0, 0, 1, 1]))
4.0
>>> confidence([[0.0], [0.2], [4.0], [4.2], [1.9]], [0, 0, 1, 1, 0]).round(2).tolist()
[0.94, 0.96, 1.0, 1.0, 0.6]

M needs the smallest distance between two images of different clusters. For any labeling, this is
the length of the shortest edge of a minimum spanning tree whose ends have different labels. So for
many labelings of the same n images, `spanning_tree` finds the tree once, and
`SpanningTree.separation` looks for that edge among its n - 1 edges.

    Proof. Let (a, b) be a closest pair with different labels, and S the images with the label of a.
    The path of the tree from a to b leaves S by an edge e, whose ends have different labels.
    Hence |e| >= |ab|. If |e| > |ab|, replacing e by (a, b) would give a shorter spanning tree:
    a contradiction. So |e| = |ab|, and no edge between different labels is shorter.

All distances are computed from differences in float64. Only one block of pairs is in memory at a
time.

References: Kuipers and Beeson, "Bootstrap Learning for Place Recognition", AAAI 2002, eq. 5 (M),
and "Clustering" (U).
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.distance import cdist
from sklearn.metrics import homogeneity_score
from sklearn.utils import check_array

from perception.errors import ImageWarning, PerceptionError, equal_length
from ssh_abduction.data.checks import a_number
from ssh_abduction.data.words import first_few

Floats = NDArray[np.float64]
Integers = NDArray[np.intp]

# So many images are compared with all others of their cluster at once.
BLOCK = 256
# Quantiles of distances are estimated on at most this many images (32 MB of distances).
SAMPLE = 2_000
NOISE = -1  # The label that clusterers give to an image in no cluster.
# An image with less confidence is doubtful. Good images of the paper's worlds have 0.93 or more,
# images with a person before the laser 0.5.
SURE = 0.8
# If the median cluster has at least SEEN images, trimmed M ignores the width of clusters of at most
# FEW images, because clusterers often put two unusual images that differ into one cluster. A view
# with at most FEW images, or at most RARE times the median number, is doubtful then. While a robot
# explores, views seen once are normal.
FEW, RARE, SEEN = 2, 0.1, 6
# Largest number of images to name in a warning.
NAMED = 8


@dataclass(frozen=True)
class SpanningTree:
    """A minimum spanning tree of n images under Euclidean distance."""

    # (n - 1, 2) indices of the two images at the ends of each edge, the shortest edge first.
    edges: Integers
    lengths: Floats  # (n - 1,) length of each edge, ascending; 0 between equal images

    @property
    def distinct(self) -> int:
        """The number of different images."""
        return 1 + int(np.count_nonzero(self.lengths))

    def separation(self, labels: ArrayLike) -> float:
        """Find the smallest distance between two images with different labels, (n,).

        It is infinite if all labels are equal.
        """
        of = np.asarray(labels)
        crossing = of[self.edges[:, 0]] != of[self.edges[:, 1]]
        return float(self.lengths[crossing].min(initial=math.inf))


def cluster_quality(X: ArrayLike, labels: ArrayLike, tree: SpanningTree | None = None) -> float:
    """Compute M: the smallest distance between clusters over the largest within a cluster.

    Larger is better. M is eq. 5 of the paper.

    Args:
        X: (n, d) images, finite.
        labels: (n,) cluster of each image. The noise label -1 counts as a cluster.
        tree: `spanning_tree(X)`, to save time when M is computed for many labelings.

    Returns:
        M, from 0 to infinity. It is NaN for one cluster, 0 if equal images are in two clusters, and
        infinite if the images within each cluster are equal.

    Raises:
        PerceptionError: The labels have another length.
        ValueError: The images are not finite.
    """
    images = check_array(equal_length(X), dtype=np.float64)
    clusters = _numbered(labels, len(images))
    if clusters.max() == 0:
        return math.nan
    between = (tree or spanning_tree(images)).separation(clusters)
    if between == 0:
        return 0.0
    within = cluster_spread(images, clusters)
    return between / within if within > 0 else math.inf


def trimmed_quality(
    X: ArrayLike, labels: ArrayLike, trim: float = 0.5, distances: Floats | None = None
) -> float:
    """Compute trimmed M: M with quantiles instead of extremes, so that no single image decides.

    In M, the smallest distance between clusters and the largest within one each come from a single
    pair of images. Here, the gap between two clusters is the `trim`-quantile of the distances
    between their images, and the width of a cluster is the (1 - `trim`)-quantile of the distances
    within it. The result is the smallest gap divided by the largest width; larger is better. A
    cluster of one image has no width. If the median cluster has at least six images, the width of
    clusters of two images is ignored, too.

    Args:
        X: (n, d) images, finite. If n > 2,000, only a fixed random sample of 2,000 is measured.
        labels: (n,) cluster of each image.
        trim: Share of the pairs to ignore at each end, in [0, 0.5]: 0 gives M of the measured
            images, 0.5 compares medians.
        distances: (n, n) distances between all images, to save time for many labelings of the same
            few images.

    Returns:
        Trimmed M, from 0 to infinity. It is NaN for one cluster, and infinite if no cluster has a
        width and no gap is 0.

    Raises:
        PerceptionError: The labels have another length, or trim is out of range.
    """
    mend = "give a number such as 0.05"
    a_number("trim", trim, PerceptionError, 0, 0.5, what="a share", mend=mend)
    images = check_array(equal_length(X), dtype=np.float64)
    clusters = _numbered(labels, len(images))
    if clusters.max() == 0:
        return math.nan
    if distances is None:
        chosen = sample_indices(len(images))
        clusters, distances = clusters[chosen], cdist(images[chosen], images[chosen])
    members = [np.flatnonzero(clusters == c) for c in np.unique(clusters)]
    if len(members) < 2:
        return 0.0  # the sample shows no gap
    usual = float(np.median([len(m) for m in members]))
    wide = [m for m in members if len(m) > (FEW if usual >= SEEN else 1)]
    widths = [
        np.quantile(distances[np.ix_(m, m)][np.triu_indices(len(m), 1)], 1 - trim) for m in wide
    ]
    gaps = [np.quantile(distances[np.ix_(m, n)], trim) for m, n in combinations(members, 2)]
    between, within = float(min(gaps)), float(max(widths, default=0.0))
    return 0.0 if between == 0 else between / within if within > 0 else math.inf


def sample_indices(count: int) -> Integers:
    """List the images for quantiles of distances: all, or a fixed random sample of 2,000."""
    if count <= SAMPLE:
        return np.arange(count)
    return np.sort(np.random.default_rng(0).choice(count, SAMPLE, replace=False))


def uncertainty_coefficient(views: ArrayLike, truth: ArrayLike) -> float:
    """Compute U(v|x) = I(v; x) / H(v), the share of the entropy of views v that states x explain.

    U is 1 if all images of each state have one view, or if there is a single view. Several states
    may share a view (aliasing) without lowering U.

    Args:
        views: (n,) view of each image.
        truth: (n,) true state of each image.

    Returns:
        U, from 0 to 1.

    Raises:
        PerceptionError: The lengths differ or are 0.
    """
    seen, true = _numbered(views), _numbered(truth)
    if len(seen) != len(true):
        raise PerceptionError(
            f"truth: expected {len(seen)} states, one for each entry of views, got {len(true)}; "
            "give a true state for each"
        )
    return min(1.0, max(0.0, float(homogeneity_score(seen, true))))


def spanning_tree(X: ArrayLike) -> SpanningTree:
    """Find a minimum spanning tree of images, (n, d), with Prim's algorithm.

    It needs O(n) memory besides a copy of the images. The tree begins with the first image. In each
    round, it gets the image that is nearest to it.
    """
    images = check_array(equal_length(X), dtype=np.float64)
    size = len(images) - 1
    edges, lengths = np.empty((size, 2), np.intp), np.empty(size)
    # For each image that is not in the tree: its index, and its nearest image in the tree.
    left, index = images[1:].copy(), np.arange(1, size + 1)
    nearest, length = np.zeros(size, np.intp), np.full(size, math.inf)
    image, at = images[:1], 0
    for last in reversed(range(size)):
        distances = cdist(image, left[: last + 1])[0]
        nearer = np.flatnonzero(distances < length[: last + 1])
        nearest[nearer], length[nearer] = at, distances[nearer]
        new = int(length[: last + 1].argmin())
        edges[last], lengths[last] = (nearest[new], index[new]), length[new]
        image, at = left[[new]], int(index[new])
        for column in (left, index, nearest, length):
            column[new] = column[last]
    order = np.argsort(lengths, kind="stable")
    return SpanningTree(edges[order], lengths[order])


def cluster_spread(X: ArrayLike, labels: ArrayLike) -> float:
    """Find the largest distance between two images, (n, d), of one cluster, (n,).

    By the triangle inequality, the distance of two images is at most the sum of their distances
    from the centre. Pairs that cannot exceed the largest distance so far are skipped.
    """
    images = check_array(equal_length(X), dtype=np.float64)
    clusters = _numbered(labels, len(images))
    best = 0.0
    for cluster in range(clusters.max() + 1):
        members = images[clusters == cluster]
        radii = cdist(members, members.mean(axis=0)[None])[:, 0] * (1 + 1e-12)  # rounded up
        order = np.argsort(-radii)
        members, radii = members[order], radii[order]
        for start in range(0, len(members), BLOCK):
            stop = int(np.count_nonzero(radii[start] + radii > best))
            if stop <= start:
                break
            block = members[start : start + BLOCK]
            best = max(best, float(cdist(block, members[start:stop]).max()))
    return best


def _numbered(labels: ArrayLike, count: int | None = None) -> Integers:
    """Number the labels 0, 1, …. Raises PerceptionError unless they are a row of this length."""
    of = np.asarray(labels)
    if of.ndim != 1 or not len(of) or (count is not None and len(of) != count):
        raise PerceptionError(
            f"labels: expected a row of {'labels' if count is None else f'{count} labels'}, "
            f"got an array of shape {of.shape}; give one label for each image"
        )
    return np.unique(of, return_inverse=True)[1].astype(np.intp)


def confidence(X: ArrayLike, labels: ArrayLike) -> Floats:
    """Compute how surely each image belongs to its view.

    Let `own` be the distance from an image to the centre of the other images of its view, and
    `next` its distance to the nearest centre of another view. The confidence is next² / (own² +
    next²): 1 at its own centre, 0.5 half way. This is the membership of fuzzy c-means with two
    centres (Bezdek 1981). An image alone in its view has 0.5. Noise (an image in no view) has 0. If
    there is only one view, all its images have 1.

    Args:
        X: (n, d) images, finite.
        labels: (n,) view of each image; -1 for noise.

    Returns:
        (n,) confidence of each image, in [0, 1].

    Raises:
        PerceptionError: The labels have another length.
    """
    images, of = _checked(X, labels)
    views, number, counts = np.unique(of[of != NOISE], return_inverse=True, return_counts=True)
    sure = np.zeros(len(images))
    if len(views) < 2:
        sure[of != NOISE] = 1.0
        return sure
    inside = images[of != NOISE]
    distances = cdist(inside, _centres(inside, number, len(views)))
    here, size = np.arange(len(inside)), counts[number]
    # Measure the distance to the centre of the other images. It is larger than that to the centre
    # of all images by this factor.
    own = distances[here, number] * size / np.maximum(size - 1, 1)
    distances[here, number] = np.inf
    next_ = distances.min(axis=1)
    own[size == 1] = next_[size == 1]
    total = own**2 + next_**2
    sure[of != NOISE] = np.divide(next_**2, total, out=np.full(len(inside), 0.5), where=total > 0)
    return sure


def nearest_views(X: ArrayLike, labels: ArrayLike) -> Integers:
    """Give each image without a view the view with the nearest centre.

    Args:
        X: (n, d) images, finite.
        labels: (n,) view of each image; -1 for noise, which is an image without a view.

    Returns:
        (n,) view of each image, without -1.

    Raises:
        PerceptionError: All images are noise, or the labels have another length.
    """
    images, of = _checked(X, labels)
    noise = of == NOISE
    if noise.all():
        raise PerceptionError(
            f"images: expected some that are in a cluster, got {len(of)} that are noise; let "
            "clusters be smaller, or wider"
        )
    if not noise.any():
        return of
    views, number = np.unique(of[~noise], return_inverse=True)
    found = of.copy()
    found[noise] = views[
        cdist(images[noise], _centres(images[~noise], number, len(views))).argmin(axis=1)
    ]
    return found


def warn_of_doubts(labels: ArrayLike, sure: ArrayLike, quality: float) -> None:
    """Warn of images that are noise, uncertain or nearly alone, and of overlapping views.

    Args:
        labels: (n,) view of each image; -1 for noise, which is an image in no view.
        sure: (n,) confidence of the view of each image, in [0, 1].
        quality: M of the views (`perception.quality.cluster_quality`). Views overlap if M is below
            1.
    """
    of, certain = np.asarray(labels), np.asarray(sure)
    number, counts = np.unique(of, return_inverse=True, return_counts=True)[1:]
    size = counts[number]
    usual = float(np.median(size[of != NOISE])) if (of != NOISE).any() else 0.0
    # Rare views are doubtful only if the median view was seen often.
    rare = size <= (max(RARE * usual, FEW) if usual >= SEEN else 0)
    doubtful = np.flatnonzero((of == NOISE) | rare | ((certain < SURE) & (size > 1)))
    if len(doubtful):
        named = first_few(doubtful.tolist(), NAMED)
        text = (
            f"{len(doubtful)} of {len(of)} images fit no view, or a view that "
            f"was rarely seen (image {named})"
        )
        text += ": their views may be wrong, and so may the map; check whether something stood in "
        warnings.warn(text + "front of the laser", ImageWarning, 2)
    if quality < 1:
        text = (
            f"views overlap (M is {quality:.2f}, below 1): some images of two views are nearer to "
            "each other than some of one view"
        )
        warnings.warn(
            f"{text}; log images where the robot stands still, at places that it comes back to",
            ImageWarning,
            2,
        )


def _centres(images: Floats, number: Integers, views: int) -> Floats:
    """The mean image of each view, (views, d)."""
    return np.array([images[number == view].mean(axis=0) for view in range(views)])


def _checked(X: ArrayLike, labels: ArrayLike) -> tuple[Floats, Integers]:
    images: Any = check_array(equal_length(X), dtype=np.float64)
    of = np.asarray(labels)
    if of.shape != (len(images),) or not np.issubdtype(of.dtype, np.integer):
        raise PerceptionError(
            f"labels: expected {len(images)} whole numbers, one per image, got an array of "
            f"shape {of.shape}; give one label for each image"
        )
    return images, of.astype(np.intp)
