"""Clusters images into views and chooses the number of views.

>>> import numpy as np
>>> images = np.concatenate([np.random.default_rng(0).normal(c, 0.1, (20, 3)) for c in (0, 2, 5)])
>>> ViewClusterer(random_state=0).fit(images).k_
3
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.distance import cdist
from sklearn.base import BaseEstimator, ClusterMixin, clone
from sklearn.cluster import KMeans
from sklearn.exceptions import ConvergenceWarning
from sklearn.mixture import BayesianGaussianMixture, GaussianMixture
from sklearn.neighbors import KNeighborsClassifier, NearestNeighbors
from sklearn.utils import check_random_state
from sklearn.utils.validation import check_is_fitted, validate_data

from perception import quality
from perception.errors import ImageWarning, PerceptionError, equal_length
from perception.quality import NOISE, Floats, Integers
from ssh_abduction.data.checks import a_number, a_whole_number, one_of
from ssh_abduction.data.errors import brief
from ssh_abduction.runtime.threads import one_thread

# There is a runner-up if trimmed M of the chosen k is below this multiple of the largest trimmed M
# of the others. benchmarks/reproduction.md has measurements.
NEAR = 1.5
# A larger k is also a runner-up if its trimmed M is at least this, because each of a few distant
# views can hide several well-separated ones.
APART = 2.3
# Values of trimmed M within this factor of the largest count as equal, and the smallest k wins.
EQUAL = 0.95
# The distance of an image to its third nearest neighbour decides whether it is isolated. So two or
# three images of one unusual object are isolated, too.
NEIGHBOURS = 3
# Up to this many images, k-means makes all of its starts on all images. Of more images, it makes
# the starts on a random sample of this size, to limit the time.
MANY = 5_000
# The largest number of rounds of k-means for more than MANY images: once on the sample, and once on
# all images from the best centres of the sample.
ROUNDS = 30
# More starts of k-means than this are an error, since each takes as long as the first.
MOST_STARTS = 10_000
# The value of `isolated` that `BootstrapLearner` uses when the theory allows wrong views.
# benchmarks/reproduction.md has measurements.
ISOLATED = 10.0


@dataclass(frozen=True)
class Predictor:
    """Gives views to new images."""

    model: Any  # the fitted clusterer, or a classifier if the clusterer cannot predict
    # (m, d) the fitted images that are not isolated; empty if the settings isolate none.
    inside: Floats
    # An image is isolated if its third nearest neighbour is farther than this.
    reach: float = math.inf

    def views(self, images: Floats) -> Integers:
        """Predict the view of each image, (n,); -1 for an isolated image."""
        views = np.asarray(self.model.predict(images), np.intp)
        if 0 < self.reach < math.inf:
            views[to_neighbour(images, self.inside, 0) > self.reach] = NOISE
        return views


def smallest_good(worth: dict[int, float]) -> int:
    """The smallest k whose trimmed M (`worth`) is at least EQUAL times the largest."""
    return min(k for k in worth if not worth[k] < EQUAL * max(worth.values()))


def cluster_labels(fitted: Any, images: Floats) -> Integers:
    """The cluster of each fitted image, (n,). Mixtures have no labels_ and predict instead."""
    return np.asarray(
        fitted.labels_ if hasattr(fitted, "labels_") else fitted.predict(images), np.intp
    )


def to_neighbour(images: Floats, among: Floats, itself: int) -> Floats:
    """The distance from each image, (n, d), to its third nearest neighbour `among` (m, d): (n,).

    With fewer neighbours it is the distance to the farthest one. `itself` is 1 if `among`
    contains the images themselves, otherwise 0.
    """
    number = min(NEIGHBOURS + itself, len(among))
    distances, _ = (
        NearestNeighbors(n_neighbors=number, algorithm="brute").fit(among).kneighbors(images)
    )
    return np.asarray(distances[:, -1])


class ViewClusterer(ClusterMixin, BaseEstimator):  # type: ignore[misc]
    """Clusters images into k views.

    A view is a cluster of images that look alike. If k is not given, the k in [k_min, k_max] with
    the largest M is chosen (`perception.quality`; eq. 5 of the paper); ties go to the smallest k. M
    depends on two distances only, so a single lost beam can change it. Each k therefore also has a
    trimmed M, which uses quantiles. Another k with a large trimmed M may make a better map; see
    `runner_up_`. If all images are equal, there is one view, and an ImageWarning.

    Args:
        k: Number of views; None chooses it by M.
        k_min: Smallest k that is tried.
        k_max: Largest k that is tried, at most the number of different images. None means the
            smaller of 20 and n - 1.
        clusterer: None for k-means, or a scikit-learn clusterer or mixture. It is cloned, and its
            `n_clusters` or `n_components` is set to k. A clusterer that finds k itself (DBSCAN,
            HDBSCAN, or AgglomerativeClustering with n_clusters=None) is used as it is.
        n_init: Number of starts of k-means. For more than 5,000 images, the starts use a random
            sample of 5,000 images, and the best start is refined on all images. Both take at most
            30 rounds. A view that is too rare for the sample may be missed.
        random_state: Seed, RandomState or None. A seed of the clusterer takes precedence.
        by: "M", or "trimmed" for the smallest k whose trimmed M is at least 0.95 times the largest.
        trim: Share of distances that trimmed M ignores at each end, in [0, 0.5].
        isolated: A factor greater than 1. An image is isolated if the distance to its third nearest
            neighbour exceeds this factor times the median of these distances. So up to three images
            of one unusual object are isolated if most views have more images. None isolates no
            image.

    Attributes:
        labels_: (n,) view of each fitted image; -1 for noise, which is an isolated image or one
            that the clusterer calls noise.
        confidence_: (n,) how surely each image belongs to its view, in [0, 1]; 0 for noise
            (`perception.quality`).
        clusterer_: The fitted clusterer.
        k_: Number of views without noise.
        quality_: For each number of views k that was tried, M (`cluster_quality`), without noise.
            It has one entry if k is given or if the clusterer finds k itself.
        trimmed_: The same, but M is computed with medians (`trimmed_quality`). M is the gap between
            clusters divided by their width. Larger is better.
        labels_by_k_: For each number of views k that was tried, the view of each image, (n,).
        predictor_: Gives views to new images.
    """

    def __init__(
        self,
        k: int | None = None,
        k_min: int = 2,
        k_max: int | None = None,
        clusterer: Any = None,
        n_init: int = 10,
        random_state: int | np.random.RandomState | None = None,
        by: str = "M",
        trim: float = 0.5,
        isolated: float | None = None,
    ) -> None:
        self.k, self.k_min, self.k_max = k, k_min, k_max
        self.clusterer, self.n_init, self.random_state = clusterer, n_init, random_state
        self.by, self.trim, self.isolated = by, trim, isolated

    def fit(self, X: ArrayLike, y: Any = None) -> Self:
        """Cluster images.

        Args:
            X: (n, d) images, finite, n >= 2.
            y: Ignored.

        Raises:
            PerceptionError: The settings contradict each other or the images.
            ValueError: The images are not a finite table of at least two rows.
        """
        self._check()
        images = validate_data(self, equal_length(X), dtype=np.float64, ensure_min_samples=2)
        inside, reach = np.ones(len(images), bool), math.inf
        if self.isolated is not None:
            far = to_neighbour(images, images, 1)
            reach = self.isolated * float(np.median(far))
            inside = (far <= reach) | (reach == 0)
            # If all images that are left are equal, nothing distinguishes them. Isolate none.
            if (images[inside] == images[inside][0]).all():
                inside[:] = True
        self.quality_, self.trimmed_ = dict[int, float](), dict[int, float]()
        self.labels_by_k_ = dict[int, Integers]()
        self.clusterer_, self.k_ = self._fitted(images[inside])
        for k, found in self.labels_by_k_.items():
            self.labels_by_k_[k] = np.full(len(images), NOISE, np.intp)
            self.labels_by_k_[k][inside] = found
        self.labels_ = self.labels_by_k_[self.k_]
        self.confidence_ = quality.confidence(images, self.labels_)
        # A clusterer that cannot predict is replaced by a classifier.
        model = self.clusterer_
        if not hasattr(model, "predict"):
            model = KNeighborsClassifier(1, algorithm="brute")
            model.fit(images[inside], self.labels_[inside])
        self.predictor_ = Predictor(model, images[inside] if self.isolated else images[:0], reach)
        return self

    def _fitted(self, images: Floats) -> tuple[Any, int]:
        """Return the fitted clusterer, and its number of views. Keep the clusterings tried."""
        if (images == images[0]).all():
            warnings.warn(
                f"all {len(images)} images are equal: they are taken as one view",
                ImageWarning,
                stacklevel=3,
            )
            return self._single(KMeans(1, n_init=1, random_state=0).fit(images), images)
        seed = int(check_random_state(self.random_state).randint(2**31 - 1))
        if self.k is None and (
            self.clusterer is None or _count_parameter(self.clusterer) is not None
        ):
            return self._search(images, seed)
        if self.k is not None and self.k > 1:
            _check_distinct(self.k, images)
        return self._single(self._cluster(images, self.k, seed), images)

    def _single(self, fitted: Any, images: Floats) -> tuple[Any, int]:
        """Measure the only clustering."""
        labels = cluster_labels(fitted, images)
        inside = labels != NOISE
        some, k = (images[inside], labels[inside]), len(set(labels[inside].tolist()))
        self.labels_by_k_[k] = labels
        self.quality_[k] = quality.cluster_quality(*some) if k else math.nan
        self.trimmed_[k] = quality.trimmed_quality(*some, self.trim) if k else math.nan
        return fitted, k

    def predict(self, X: ArrayLike) -> Integers:
        """Predict the views of images.

        If the clusterer can predict, it does so (k-means: the view with the nearest centre).
        Otherwise an image gets the view of the nearest fitted image.

        Args:
            X: (n, d) images, finite.

        Returns:
            (n,) views; -1 for an image that is isolated from the fitted images.
        """
        check_is_fitted(self, "predictor_")
        return self.predictor_.views(
            validate_data(self, equal_length(X), dtype=np.float64, reset=False)
        )

    def score(self, X: ArrayLike, y: Any = None) -> float:
        """Compute M of the views that are predicted for images, without noise.

        Args:
            X: (n, d) images, finite.
            y: Ignored.

        Returns:
            M; larger is better. NaN for one view, or if all images are noise.
        """
        views, images = self.predict(X), np.asarray(X, float)
        seen = views != NOISE
        return quality.cluster_quality(images[seen], views[seen]) if seen.any() else math.nan

    @property
    def runner_up_(self) -> int | None:
        """Another number of views k that may give a better map; None if there is none.

        Let T be the largest trimmed M of the other k. If the trimmed M of k_ is below 1.5 T, the
        runner-up is the smallest other k with a trimmed M of at least 0.95 T. Otherwise it is the k
        above k_ with the largest trimmed M, if that is at least 2.3.
        """
        others = {k: worth for k, worth in self.trimmed_.items() if k != self.k_}
        if others and self.trimmed_[self.k_] < NEAR * max(others.values()):
            return smallest_good(others)
        finer = {k: worth for k, worth in others.items() if k > self.k_ and worth >= APART}
        return max(finer, key=finer.__getitem__, default=None)

    @property
    def runner_up_labels_(self) -> Integers | None:
        """The view of each image for `runner_up_` views, (n,); None without a runner-up."""
        return None if self.runner_up_ is None else self.labels_by_k_[self.runner_up_]

    @property
    def cluster_centers_(self) -> Floats:
        """(k, d) centres of the views, if the clusterer has them."""
        return np.asarray(self.clusterer_.cluster_centers_)

    def _search(self, images: Floats, seed: int) -> tuple[Any, int]:
        """Try each k. Return the clusterer of the best k, and this k."""
        tree, chosen = quality.spanning_tree(images), quality.sample_indices(len(images))
        distances = cdist(images[chosen], images[chosen])
        most = min(20, len(images) - 1) if self.k_max is None else self.k_max
        most = min(max(most, self.k_min), tree.distinct)
        _check_distinct(self.k_min, images, tree.distinct)
        fitted: dict[int, Any] = {}
        for k in range(self.k_min, most + 1):
            tried = self._cluster(images, k, seed)
            labels = cluster_labels(tried, images)
            if fitted and len(set(labels.tolist())) < k:
                continue  # A mixture left some of its components empty.
            fitted[k], self.labels_by_k_[k] = tried, labels
            self.quality_[k] = quality.cluster_quality(images, labels, tree)
            some = images[chosen], labels[chosen]
            self.trimmed_[k] = quality.trimmed_quality(*some, self.trim, distances)
        best = max(self.quality_, key=self.quality_.__getitem__)
        best = smallest_good(self.trimmed_) if self.by == "trimmed" else best
        return fitted[best], best

    def _cluster(self, images: Floats, k: int | None, seed: int) -> Any:
        """Fit a clusterer with k views. If k is None, the clusterer chooses the number."""
        if self.clusterer is None:
            return self._k_means(images, k, seed)
        chosen = clone(self.clusterer)
        settings = chosen.get_params()
        if k is not None:
            chosen.set_params(**{str(_count_parameter(chosen)): k})
        if settings.get("random_state", seed) is None and self.random_state is not None:
            chosen.set_params(random_state=seed)
        return chosen.fit(images)

    def _k_means(self, images: Floats, k: int | None, seed: int) -> Any:
        """Fit k-means to all images, from the best of several starts."""
        # Rounds are short: on shared cores, two threads would wait for each other longer than they
        # work.
        with one_thread():
            if len(images) > MANY:
                sample = np.random.default_rng(seed).choice(len(images), MANY, replace=False)
                # The sample may have fewer different images than k while all images have enough.
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore", ConvergenceWarning)
                    start = KMeans(k, n_init=self.n_init, max_iter=ROUNDS, random_state=seed)
                    centres = start.fit(images[sample]).cluster_centers_
                model = KMeans(k, init=centres, n_init=1, max_iter=ROUNDS, random_state=seed)
                return model.fit(images)
            return KMeans(k, n_init=self.n_init, random_state=seed).fit(images)

    def _check(self) -> None:
        """Raise PerceptionError if a setting is invalid or contradicts another."""
        for name in ("k", "k_min", "k_max", "n_init"):
            value, least = getattr(self, name), 2 if name == "k_min" else 1
            if value is None and name in ("k", "k_max"):
                continue
            a_whole_number(name, value, PerceptionError, least, mend="take a larger one")
        if self.n_init > MOST_STARTS:
            raise PerceptionError(
                f"n_init: expected at most {MOST_STARTS} starts, got {brief(self.n_init)}; a "
                "few dozen are enough"
            )
        # scikit-learn takes seeds of 32 bits.
        seed, mend = self.random_state, "give a seed, a RandomState or None"
        if not isinstance(seed, np.random.RandomState | None):
            a_whole_number(
                "random_state", seed, PerceptionError, 0, 2**32 - 1, what="a seed", mend=mend
            )
        one_of("by", self.by, ("M", "trimmed"), PerceptionError)
        if self.isolated is not None:
            mend = "give one such as 3, or None"
            a_number("isolated", self.isolated, PerceptionError, above=1, mend=mend)
        if self.k is None and self.k_max is not None and self.k_max < self.k_min:
            raise PerceptionError(
                f"k_max: expected at least k_min = {self.k_min}, got {self.k_max}; raise it"
            )
        if self.clusterer is not None:
            self._check_clusterer()

    def _check_clusterer(self) -> None:
        """Raise PerceptionError if the clusterer is none, or finds `k` itself."""
        if not (hasattr(self.clusterer, "fit") and hasattr(self.clusterer, "get_params")):
            raise PerceptionError(
                "clusterer: expected a scikit-learn clusterer, such as DBSCAN(), got "
                f"{self.clusterer!r}; pass an object with fit and get_params"
            )
        if self.k is not None and _count_parameter(self.clusterer) is None:
            raise PerceptionError(
                f"k: {type(self.clusterer).__name__} finds the number of clusters itself; "
                "leave k out"
            )


def as_view_clusterer(clusterer: Any) -> ViewClusterer:
    """Wrap a scikit-learn clusterer in a ViewClusterer, unless it is one already.

    Its k is the number of clusters that the clusterer is set to. Raises PerceptionError.
    """
    if isinstance(clusterer, ViewClusterer):
        return clusterer
    checked = ViewClusterer(clusterer=clusterer)
    checked._check()
    size = _count_parameter(clusterer)
    return checked if size is None else checked.set_params(k=clusterer.get_params()[size])


def _check_distinct(k: int, images: Floats, distinct: int | None = None) -> None:
    """Raise PerceptionError if there are fewer different images than views."""
    found = len(np.unique(images, axis=0)) if distinct is None else distinct
    if found < k:
        raise PerceptionError(
            f"k: expected at most {found}, as there are {found} different images among "
            f"{len(images)}, got {k}; take fewer views"
        )


def _count_parameter(clusterer: Any) -> str | None:
    """The name of the setting for the number of clusters; None if the clusterer chooses it."""
    if clusterer.get_params().get("n_clusters") is not None:
        return "n_clusters"
    return (
        "n_components" if isinstance(clusterer, GaussianMixture | BayesianGaussianMixture) else None
    )
