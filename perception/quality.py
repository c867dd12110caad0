"""Measures how well a clustering separates images: without knowing the truth (M, and M trimmed), and knowing it (U).

>>> import numpy as np
>>> images = np.array([[0.0], [1.0], [5.0], [6.0]])
>>> float(cluster_quality(images, [0, 0, 1, 1]))
4.0

Where M is wanted for many labelings of the same images, the costly half of the work is done once. For *any* labeling, the smallest distance
between two images of different clusters is the length of the shortest edge of a minimum spanning tree whose ends have different labels. So
`spanning_tree` finds the tree once, and `SpanningTree.separation` then reads the distance off n - 1 edges.

    Proof. Let (a, b) be a closest pair with different labels, and S the images labelled like a. The tree joins a to b, so its path
    from a to b leaves S by an edge e, whose ends are labelled differently, hence |e| >= |ab|. If |e| > |ab|, replacing e by (a, b) would
    give a shorter spanning tree: a contradiction. So |e| = |ab|, and no edge that crosses can be shorter.

Distances here are exact to rounding. Matrix products only tell which pairs cannot matter, with a rigorous bound of their rounding error, and
the distances of the pairs that are left are computed from differences in float64. Only one block of pairs is in memory at a time.

References: Kuipers and Beeson, "Bootstrap Learning for Place Recognition", AAAI 2002, eq. 5 (M), and "Clustering" (U).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.cluster.hierarchy import DisjointSet
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import cdist
from sklearn.metrics import mutual_info_score
from sklearn.utils import check_array
from threadpoolctl import threadpool_limits

from perception.errors import PerceptionError, equal_length

Floats = NDArray[np.float64]
Integers = NDArray[np.intp]

# The most images of a cell. Small cells let more pairs of far images be skipped; large ones make the products of matrices faster.
CELL = 256
# So many pairs of cells are compared before those left are looked at again, as more of them may be skipped by then.
BATCH = 64
# When a cluster is compared with itself, blocks have this many images a side: as float32 a block of distances takes 16 MB.
BLOCK = 2048
# Quantiles of distances are estimated on this many images, where there are more: the distances between all of these take 32 MB.
SAMPLE = 2_000
# Where the middle cluster has SEEN images or more, trimmed M takes no width from clusters of FEW images or less: strange images are often put together, however unlike.
SEEN, FEW = 6, 2
# So many pairs of images are recomputed from differences at once: with 180 ranges an image, the differences take 12 MB.
GATHERED = 8192


@dataclass(frozen=True)
class SpanningTree:
    """A minimum spanning tree of n images under Euclidean distance.

    edges    (n - 1, 2) numbers of images
    lengths  (n - 1,) distances, ascending; equal images are joined by edges of length 0
    """

    edges: Integers
    lengths: Floats

    @property
    def distinct(self) -> int:
        """How many different images there are."""
        return 1 + int(np.count_nonzero(self.lengths))

    def separation(self, labels: ArrayLike) -> float:
        """The smallest distance between two images of different labels; infinite where all labels are the same."""
        of = np.asarray(labels)
        crossing = of[self.edges[:, 0]] != of[self.edges[:, 1]]
        return float(self.lengths[crossing].min(initial=math.inf))


def cluster_quality(X: ArrayLike, labels: ArrayLike, tree: SpanningTree | None = None) -> float:
    """M of eq. 5: the smallest distance between images of two clusters, divided by the largest distance within one cluster. Larger is better.

    X       (n, d) images, finite
    labels  (n,), where each value is one cluster, DBSCAN's -1 among them
    tree    `spanning_tree(X)`, to save time where M is wanted for many labelings

    Returns M in [0, inf]. In the limiting cases it is

    - NaN for one cluster, as there is no distance between clusters;
    - 0 for clusters that share an image, so also where all images are equal;
    - infinite for different clusters each of which consists of equal images (or of one image).

    Raises PerceptionError for labels of another length, ValueError for images that are not finite.
    """
    images = check_array(equal_length(X), dtype=np.float64)
    clusters = _numbered(labels, len(images))
    if clusters.max() == 0:
        return math.nan
    between = _separation(images, clusters) if tree is None else tree.separation(clusters)
    if between == 0:
        return 0.0
    within = cluster_spread(images, clusters)
    return between / within if within > 0 else math.inf


def trimmed_quality(
    X: ArrayLike, labels: ArrayLike, trim: float = 0.5, distances: Floats | None = None
) -> float:
    """M with quantiles in the place of its extremes, so that one lost beam or one strange image does not decide. Larger is better.

    In M, the smallest distance between clusters and the largest within one are each that of a single pair of images. Here two clusters are as far from each
    other as the `trim`-quantile of the distances between their images says, and a cluster is as wide as the (1 - `trim`)-quantile of the distances within it.
    The result is the smallest of the former divided by the largest of the latter. Clusters of one image have no width, and those of two are left out where others
    are large.

    X          (n, d) images, finite; of more than 2,000 a fixed random sample is measured
    labels     (n,), where each value is one cluster
    trim       share of the pairs that is left out at each end, in [0, 0.5]: 0 is M of the images measured, 0.5 compares medians
    distances  (n, n) between all images, to save time where many labelings of the same few images are measured

    Returns a number in [0, inf]: NaN for one cluster, infinite where no cluster has a width. Raises PerceptionError for labels of another length, and for
    another trim.
    """
    if not (
        isinstance(trim, int | float | np.number)
        and not isinstance(trim, bool)
        and 0 <= trim <= 0.5
    ):
        raise PerceptionError(f"trim: expected a share from 0 to 0.5, got {trim!r}")
    images = check_array(equal_length(X), dtype=np.float64)
    clusters = _numbered(labels, len(images))
    if clusters.max() == 0:
        return math.nan
    if distances is None:
        chosen = sampled(len(images))
        clusters, distances = clusters[chosen], cdist(images[chosen], images[chosen])
    members = [np.flatnonzero(clusters == c) for c in np.unique(clusters)]
    if len(members) < 2:
        return 0.0  # the sample shows no gap
    usual = float(np.median([len(m) for m in members]))
    wide = [m for m in members if len(m) > (FEW if usual >= SEEN else 1)]
    widths = [
        np.quantile(distances[np.ix_(m, m)][np.triu_indices(len(m), 1)], 1 - trim) for m in wide
    ]
    gaps = [
        np.quantile(distances[np.ix_(m, other)], trim)
        for i, m in enumerate(members)
        for other in members[:i]
    ]
    between, within = float(min(gaps)), float(max(widths, default=0.0))
    return 0.0 if between == 0 else between / within if within > 0 else math.inf


def sampled(count: int) -> Integers:
    """Which images of `count` the quantiles of distances are estimated on: all, or a fixed random sample, ascending."""
    if count <= SAMPLE:
        return np.arange(count)
    return np.sort(np.random.default_rng(0).choice(count, SAMPLE, replace=False))


def uncertainty_coefficient(views: ArrayLike, truth: ArrayLike) -> float:
    """U(v|x) = I(v; x) / H(v), in [0, 1]: which share of the uncertainty about the view v is gone once the true state x is known.

    U is 1 where the state determines the view, so that images of one state have one view. Several states may share a view, as aliasing does not
    lower U. A single view leaves no uncertainty, so that U is 1. Raises PerceptionError where the lengths differ or are 0.
    """
    seen, true = _numbered(views), _numbered(truth)
    if len(seen) != len(true):
        raise PerceptionError(f"truth: expected {len(seen)} states, one a view, got {len(true)}")
    entropy = float(mutual_info_score(seen, seen))
    if seen.max() == 0:
        return 1.0
    return min(1.0, max(0.0, float(mutual_info_score(seen, true)) / entropy))


def spanning_tree(X: ArrayLike) -> SpanningTree:
    """A minimum spanning tree of the images, (n, d), by Borůvka's rounds over blocks of pairs. It takes O(n) memory beside the images.

    In each round, every component picks its shortest edge to another component. The picks are added from short to long, but for those that would close a
    cycle; so the forest stays part of a minimum spanning tree even where lengths are equal.
    """
    images = check_array(equal_length(X), dtype=np.float64)
    cells, count = _Cells(images), len(images)
    forest, edges, lengths = DisjointSet(range(count)), np.empty((0, 2), np.intp), np.empty(0)
    components = np.arange(count)
    while components.max() > 0:
        squares, picks = cells.shortest_leaving(components)
        order = np.argsort(squares, kind="stable")
        added = [c for c in order.tolist() if forest.merge(int(picks[c, 0]), int(picks[c, 1]))]
        edges, lengths = (
            np.concatenate([edges, picks[added]]),
            np.concatenate([lengths, np.sqrt(squares[added])]),
        )
        links = coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(count, count))
        components = connected_components(links, directed=False)[1].astype(np.intp)
    order = np.argsort(lengths, kind="stable")
    return SpanningTree(edges[order], lengths[order])


def cluster_spread(X: ArrayLike, labels: ArrayLike) -> float:
    """The largest distance between two images of one cluster; 0 where the images of each cluster are equal.

    Two images are no farther apart than their distances from the centre of the cluster together. Pairs that cannot exceed the largest distance so far are
    skipped.
    """
    images = check_array(equal_length(X), dtype=np.float64)
    clusters = _numbered(labels, len(images))
    order = np.argsort(clusters, kind="stable")
    members = np.split(order, np.flatnonzero(np.diff(clusters[order])) + 1)
    best = max(_two_sweeps(images[m]) for m in members)
    for m in members:
        best = max(best, _wider(images[m], best))
    return best


def _separation(images: Floats, clusters: Integers) -> float:
    """The smallest distance between two clusters: one round of Borůvka's, in which the clusters are the components."""
    return math.sqrt(float(_Cells(images).shortest_leaving(clusters)[0].min()))


class _Cells:
    """Images, put into cells of near ones. For each pair of cells there is a lower bound of the squared distance between images of different components.

    Components only ever merge. So that distance only grows for a pair of cells, and a bound stays true in later rounds.
    """

    def __init__(self, images: Floats) -> None:
        parts = list(_halves(images, np.arange(len(images))))
        self.order = np.concatenate(parts)
        self.images = images[self.order]
        self.images -= self.images.mean(axis=0)
        self.norms = np.einsum("ij,ij->i", self.images, self.images)
        self.starts = np.cumsum([0, *(len(p) for p in parts)])
        self.slices = [slice(a, b) for a, b in zip(self.starts[:-1], self.starts[1:], strict=True)]
        self.reach = np.array([math.sqrt(self.norms[s].max()) for s in self.slices])
        centres = np.array([self.images[s].mean(axis=0) for s in self.slices])
        radii = np.array(
            [
                math.sqrt(_squares(self.images[s] - c).max())
                for s, c in zip(self.slices, centres, strict=True)
            ]
        )
        self.first, self.second = np.triu_indices(len(parts))
        apart = np.concatenate(
            [np.sqrt(_squares(centres[i:] - centres[i])) for i in range(len(parts))]
        )
        gap = apart - radii[self.first] - radii[self.second] - 1e-12 * (apart + self.reach.max())
        gap[self.first == self.second] = 0
        self.bounds = np.maximum(gap, 0) ** 2

    def shortest_leaving(self, components: Integers) -> tuple[Floats, Integers]:
        """For each component, 0 … c - 1 of `components`, the squared length (c,) and ends (c, 2) of the shortest edge that leaves it."""
        search = _Search(self.images, components[self.order])
        pairs = np.argsort(self.bounds, kind="stable")
        with threadpool_limits(
            1, user_api="blas"
        ):  # products are so small here that threads would wait for each other longer than they work
            while len(pairs):
                limits = np.maximum.reduceat(search.best[search.components], self.starts[:-1])
                pairs = pairs[
                    self.bounds[pairs]
                    < np.maximum(limits[self.first[pairs]], limits[self.second[pairs]])
                ]
                for p in pairs[:BATCH].tolist():
                    self.bounds[p] = max(
                        self.bounds[p], self._compare(self.first[p], self.second[p], search)
                    )
                pairs = pairs[BATCH:]
        return search.best, self.order[search.ends]

    def _compare(self, a: int, b: int, search: _Search) -> float:
        """Look at all pairs of two cells; return the new bound."""
        rows, columns = self.slices[a], self.slices[b]
        squares = self.images[rows] @ self.images[columns].T
        squares *= -2
        squares += self.norms[rows, None]
        squares += self.norms[columns]
        squares[search.components[rows, None] == search.components[columns]] = np.inf
        slack = _rounding(self.images.shape[1], np.float64, self.reach[a] + self.reach[b])
        squares -= slack
        search.improve(squares, slack, rows.start, columns.start)
        if a != b:
            search.improve(squares.T, slack, columns.start, rows.start)
        return float(squares.min())


class _Search:
    """The shortest edge found so far that leaves each component."""

    def __init__(self, images: Floats, components: Integers) -> None:
        self.images, self.components = images, components
        self.best = np.full(components.max() + 1, np.inf)
        self.ends = np.zeros((len(self.best), 2), np.intp)

    def improve(self, lower: Floats, slack: float, row: int, column: int) -> None:
        """Look through a block of pairs for shorter edges.

        lower   lower bounds of the squared distances of the pairs
        row     the image that the rows of the block begin with
        column  the image that its columns begin with
        """
        components, least = self.components[row : row + len(lower)], lower.min(axis=1)
        hot = np.flatnonzero(least < self.best[components])
        if not len(hot):
            return
        # The pair that is nearest by the products is offered first: after it, hardly any other pair is still below the limit.
        self._offer(row + hot, column + lower[hot].argmin(axis=1))
        limits = self.best[components[hot]]
        hot = hot[(least[hot] < limits) & (limits > 0)]
        near, far = np.nonzero(lower[hot] < self.best[components[hot], None])
        for k in range(0, len(near), GATHERED):
            self._offer(row + hot[near[k : k + GATHERED]], column + far[k : k + GATHERED])

    def _offer(self, i: Integers, j: Integers) -> None:
        squares, components = _squares(self.images[i] - self.images[j]), self.components[i]
        order = np.lexsort((squares, components))
        order = order[np.flatnonzero(np.diff(components[order], prepend=-1))]
        order = order[squares[order] < self.best[components[order]]]
        self.best[components[order]] = squares[order]
        self.ends[components[order]] = np.column_stack([i[order], j[order]])


def _halves(images: Floats, members: Integers) -> Iterator[Integers]:
    """Cells of at most CELL images: images are split at the median along the line between two far ones, again and again."""
    if len(members) <= CELL:
        yield members
        return
    inside = images[members]
    far = inside[_squares(inside - inside.mean(axis=0)).argmax()]
    along = inside @ (inside[_squares(inside - far).argmax()] - far)
    order = np.argpartition(along, len(members) // 2)
    del inside
    yield from _halves(images, members[order[: len(members) // 2]])
    yield from _halves(images, members[order[len(members) // 2 :]])


def _two_sweeps(images: Floats) -> float:
    """A distance that is often near the largest one between two of the images: from the image that is farthest from the centre to the image farthest from that."""
    start = images[_squares(images - images.mean(axis=0)).argmax()]
    return math.sqrt(_squares(images - start).max())


def _wider(images: Floats, best: float) -> float:
    """The largest distance between two of the images, if it is larger than `best`; else some number that is not larger than `best`."""
    centred = images - images.mean(axis=0)
    radii = np.sqrt(_squares(centred))
    margin = 1 + 1e-12  # the radii are rounded too
    kept = np.flatnonzero((radii + radii.max()) * margin > best)
    if len(kept) < 2:
        return 0.0
    kept = kept[np.argsort(-radii[kept], kind="stable")]
    radii = radii[kept]
    scale = radii[0]
    if scale == 0:
        return 0.0
    small = (centred[kept] / scale).astype(np.float32)
    norms = np.einsum("ij,ij->i", small, small)
    for a in range(0, len(kept), BLOCK):
        for b in range(a, len(kept), BLOCK):
            if (radii[a] + radii[b]) * margin <= best:
                break
            upper = small[a : a + BLOCK] @ small[b : b + BLOCK].T
            upper *= -2
            upper += norms[a : a + BLOCK, None]
            upper += norms[b : b + BLOCK]
            slack = _rounding(images.shape[1], np.float32, (radii[a] + radii[b]) / scale)
            if float(upper.max()) + slack <= (best / scale) ** 2:
                continue
            i, j = np.unravel_index(upper.argmax(), upper.shape)
            best = max(
                best, math.sqrt(_squares(centred[kept[[a + i]]] - centred[kept[[b + j]]])[0])
            )
            near, far = np.nonzero(upper > (best / scale) ** 2 - slack)
            for k in range(0, len(near), GATHERED):
                pairs = (
                    centred[kept[a + near[k : k + GATHERED]]]
                    - centred[kept[b + far[k : k + GATHERED]]]
                )
                best = max(best, math.sqrt(_squares(pairs).max()))
    return best


def _squares(differences: Floats) -> Floats:
    return np.einsum("ij,ij->i", differences, differences)  # type: ignore[no-any-return]


def _rounding(beams: int, dtype: type[np.floating[Any]], reach: float) -> float:
    """A bound of the rounding error of |a|² + |b|² - 2ab, where |a| + |b| <= reach: that of a dot product, and of the rounding of its inputs."""
    return float((beams + 16) * np.finfo(dtype).eps * reach**2)


def _numbered(labels: ArrayLike, count: int | None = None) -> Integers:
    """Labels as numbers 0, 1, … Raises PerceptionError where they are not a row, or are not `count`."""
    of = np.asarray(labels)
    if of.ndim != 1 or not len(of) or (count is not None and len(of) != count):
        raise PerceptionError(
            f"labels: expected a row of {'labels' if count is None else f'{count} labels'}, got an array of shape {of.shape}"
        )
    return np.unique(of, return_inverse=True)[1].astype(np.intp)
