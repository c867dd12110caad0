"""Measures how well clusters separate images.

M and trimmed M compare distances between images. U compares the clusters with the true states.

>>> import numpy as np
>>> images = np.array([[0.0], [1.0], [5.0], [6.0]])
>>> float(cluster_quality(images, [0, 0, 1, 1]))
4.0

M needs the smallest distance between two images of different clusters. For any labeling, this is
the length of the shortest edge of a minimum spanning tree whose ends have different labels. So for
many labelings of the same n images, `spanning_tree` finds the tree once, and
`SpanningTree.separation` looks for that edge among its n - 1 edges.

    Proof. Let (a, b) be a closest pair with different labels, and S the images with the label of a.
    The path of the tree from a to b leaves S by an edge e, whose ends have different labels.
    Hence |e| >= |ab|. If |e| > |ab|, replacing e by (a, b) would give a shorter spanning tree:
    a contradiction. So |e| = |ab|, and no edge between different labels is shorter.

Distances are exact up to rounding. Matrix products are fast but less exact. They only exclude pairs
that cannot matter, with a rigorous bound of their rounding error. The distances of the remaining
pairs are computed from differences in float64. Only one block of pairs is in memory at a time.

References: Kuipers and Beeson, "Bootstrap Learning for Place Recognition", AAAI 2002, eq. 5 (M),
and "Clustering" (U).
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
from sklearn.metrics import homogeneity_score
from sklearn.utils import check_array

from perception.errors import PerceptionError, equal_length
from ssh_abduction.data.checks import a_number
from ssh_abduction.runtime.threads import one_thread

Floats = NDArray[np.float64]
Integers = NDArray[np.intp]

# Largest number of images in a cell. Smaller cells let the search skip more far pairs; larger ones
# make the matrix products faster.
CELL = 256
# Number of pairs of cells to compare before skipping more of the remaining pairs.
BATCH = 64
# Images on each side of a block when a cluster is compared with itself. A float32 block of
# distances takes 16 MB.
BLOCK = 2048
# Quantiles of distances are estimated on at most this many images (32 MB of distances).
SAMPLE = 2_000
# If the median cluster has at least SEEN images, trimmed M ignores the width of clusters of at most
# FEW images, because clusterers often put two unusual images that differ into one cluster.
SEEN, FEW = 6, 2
# Number of pairs of images recomputed from differences at once; 12 MB for 180 ranges per image.
GATHERED = 8192


@dataclass(frozen=True)
class SpanningTree:
    """A minimum spanning tree of n images under Euclidean distance.

    Attributes:
        edges: (n - 1, 2) indices of the two images at the ends of each edge, the shortest edge
            first.
        lengths: (n - 1,) length of each edge, ascending; 0 between equal images.
    """

    edges: Integers
    lengths: Floats

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
    if tree is not None:
        between = tree.separation(clusters)
    else:  # one round of Borůvka's algorithm, with clusters as components
        between = math.sqrt(float(_Cells(images).shortest_leaving(clusters)[0].min()))
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
    gaps = [
        np.quantile(distances[np.ix_(m, other)], trim)
        for i, m in enumerate(members)
        for other in members[:i]
    ]
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
    """Find a minimum spanning tree of images, (n, d), with Borůvka's algorithm on blocks of pairs.

    The search needs O(n) memory besides the images. It begins with each image as a component. In
    each round, every component picks its shortest edge to another component. The picks are added
    from short to long. A pick that would close a cycle is skipped, so that the result is a minimum
    spanning tree even if several edges are equally long.
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
        # Components for the next round.
        links = coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(count, count))
        components = connected_components(links, directed=False)[1].astype(np.intp)
    order = np.argsort(lengths, kind="stable")
    return SpanningTree(edges[order], lengths[order])


def cluster_spread(X: ArrayLike, labels: ArrayLike) -> float:
    """Find the largest distance between two images, (n, d), of one cluster, (n,).

    By the triangle inequality, the distance of two images is at most the sum of their distances
    from the centre. Pairs that cannot exceed the largest distance so far are skipped.
    """
    images = check_array(equal_length(X), dtype=np.float64)
    clusters = _numbered(labels, len(images))
    order = np.argsort(clusters, kind="stable")
    members = np.split(order, np.flatnonzero(np.diff(clusters[order])) + 1)
    best = max(_two_sweeps(images[m]) for m in members)
    for m in members:
        best = max(best, _wider(images[m], best))
    return best


class _Cells:
    """Images grouped into cells of near images, with a lower bound for each pair of cells.

    It is a lower bound of the squared distance between an image of one cell and an image of the
    other, if they belong to different components. Components only merge. So fewer pairs count in
    later rounds, and the bound stays valid.
    """

    def __init__(self, images: Floats) -> None:
        parts = list(_halves(images, np.arange(len(images))))
        self.order = np.concatenate(parts)
        self.images = images[self.order]
        # Centred images have small norms, which keeps rounding errors small.
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
        # Bound: distance of the centres minus both radii; 0 within a cell.
        apart = np.concatenate(
            [np.sqrt(_squares(centres[i:] - centres[i])) for i in range(len(parts))]
        )
        gap = apart - radii[self.first] - radii[self.second] - 1e-12 * (apart + self.reach.max())
        gap[self.first == self.second] = 0
        self.bounds = np.maximum(gap, 0) ** 2

    def shortest_leaving(self, components: Integers) -> tuple[Floats, Integers]:
        """The squared length, (c,), and images, (c, 2), of each component's shortest edge."""
        search = _ShortestEdges(self.images, components[self.order])
        pairs = np.argsort(self.bounds, kind="stable")
        # The products are small: threads would wait for each other longer than they work.
        with one_thread("blas"):
            while len(pairs):
                # Skip a pair of cells if its bound is not below the best edge of any component with
                # images in these cells.
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

    def _compare(self, a: int, b: int, search: _ShortestEdges) -> float:
        """Compare all images of two cells (groups), a and b; return the new bound for them."""
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


class _ShortestEdges:
    """The shortest edge found so far from each component to another one."""

    def __init__(self, images: Floats, components: Integers) -> None:
        self.images, self.components = images, components
        self.best = np.full(components.max() + 1, np.inf)
        self.ends = np.zeros((len(self.best), 2), np.intp)

    def improve(self, lower: Floats, slack: float, row: int, column: int) -> None:
        """Search a block of pairs for shorter edges.

        `lower` has lower bounds of the squared distances of the pairs. The first pair of the block
        is (`row`, `column`).
        """
        components, least = self.components[row : row + len(lower)], lower.min(axis=1)
        hot = np.flatnonzero(least < self.best[components])
        if not len(hot):
            return
        # Offer the pair with the smallest bound of each row first. Then hardly any other pair is
        # below the limit.
        self._offer(row + hot, column + lower[hot].argmin(axis=1))
        limits = self.best[components[hot]]
        hot = hot[(least[hot] < limits) & (limits > 0)]
        near, far = np.nonzero(lower[hot] < self.best[components[hot], None])
        for k in range(0, len(near), GATHERED):
            self._offer(row + hot[near[k : k + GATHERED]], column + far[k : k + GATHERED])

    def _offer(self, i: Integers, j: Integers) -> None:
        """For each component of images i, keep the shortest pair (i, j) if it beats the best."""
        squares, components = _squares(self.images[i] - self.images[j]), self.components[i]
        order = np.lexsort((squares, components))
        order = order[np.flatnonzero(np.diff(components[order], prepend=-1))]
        order = order[squares[order] < self.best[components[order]]]
        self.best[components[order]] = squares[order]
        self.ends[components[order]] = np.column_stack([i[order], j[order]])


def _halves(images: Floats, members: Integers) -> Iterator[Integers]:
    """Split images into cells of at most CELL, recursively at the median of a long axis."""
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
    """A lower bound on the largest distance: the one from the image farthest from the centre."""
    start = images[_squares(images - images.mean(axis=0)).argmax()]
    return math.sqrt(_squares(images - start).max())


def _wider(images: Floats, best: float) -> float:
    """The largest distance between two images if it exceeds `best`; otherwise at most `best`."""
    centred = images - images.mean(axis=0)
    radii = np.sqrt(_squares(centred))
    margin = 1 + 1e-12  # Radii are also rounded.
    kept = np.flatnonzero((radii + radii.max()) * margin > best)
    if len(kept) < 2:
        return 0.0
    kept = kept[np.argsort(-radii[kept], kind="stable")]
    radii = radii[kept]
    scale = radii[0]
    if scale == 0:
        return 0.0
    # Float32 products show which pairs may exceed the best. Images are sorted by falling radius, so
    # the inner loop can stop early.
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
    """A bound on the rounding error of |a|² + |b|² - 2ab for vectors with |a| + |b| <= reach."""
    return float((beams + 16) * np.finfo(dtype).eps * reach**2)


def _numbered(labels: ArrayLike, count: int | None = None) -> Integers:
    """Number the labels 0, 1, …. Raises PerceptionError unless they are a row of this length."""
    of = np.asarray(labels)
    if of.ndim != 1 or not len(of) or (count is not None and len(of) != count):
        raise PerceptionError(
            f"labels: expected a row of {'labels' if count is None else f'{count} labels'}, "
            f"got an array of shape {of.shape}; give one label for each image"
        )
    return np.unique(of, return_inverse=True)[1].astype(np.intp)
