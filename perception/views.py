"""Clusters images into views and chooses the number of views.

A view is a cluster of images that look alike.

>>> import numpy as np
>>> images = np.concatenate([np.random.default_rng(0).normal(c, 0.1, (20, 3)) for c in (0, 2, 5)])
>>> ViewClusterer(random_state=0).fit(images).k_
3
"""

from __future__ import annotations

import math
import warnings
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.distance import cdist
from sklearn.base import BaseEstimator, ClusterMixin, clone
from sklearn.cluster import KMeans
from sklearn.exceptions import ConvergenceWarning
from sklearn.mixture import BayesianGaussianMixture, GaussianMixture
from sklearn.neighbors import KNeighborsClassifier, NearestNeighbors
from sklearn.utils import check_random_state
from sklearn.utils.validation import check_is_fitted, validate_data
from threadpoolctl import threadpool_limits

from perception.confidence import NOISE, confidence
from perception.errors import ImageWarning, PerceptionError, equal_length
from perception.quality import cluster_quality, sample_indices, spanning_tree, trimmed_quality
from ssh_abduction.data.checks import a_whole_number
from ssh_abduction.data.errors import brief, is_finite

# Up to this many images, k-means makes all of its starts on all images. Of more images, it makes
# the starts on a random sample of this size, to limit the time.
MANY = 5_000
# The largest number of rounds of k-means for more than MANY images: once on the sample, and once on
# all images from the best centres of the sample.
ROUNDS = 30
# There is a runner-up if trimmed M of the chosen k is below this multiple of the largest trimmed M
# of the others. docs/measurements/reproduction.md has measurements.
NEAR = 1.5
# A larger k is also a runner-up if its trimmed M is at least this, because each of a few distant
# views can hide several well-separated ones.
APART = 2.3
# Values of trimmed M within this factor of the largest count as equal, and the smallest k wins.
EQUAL = 0.95
# An image is isolated by its distance to this nearest neighbour, so that two or three images of one
# strange thing are isolated.
NEIGHBOURS = 3
# More starts of k-means than this are an error, since each takes as long as the first.
MOST_STARTS = 10_000
# The value of `isolated` that `BootstrapLearner` uses when the theory allows wrong views.
# docs/measurements/reproduction.md has measurements.
ISOLATED = 10.0


class ViewClusterer(ClusterMixin, BaseEstimator):  # type: ignore[misc]
    """Clusters images into k views.

    A view is a cluster of images that look alike. If k is not given, the k in [k_min, k_max] with
    the largest M is chosen (`perception.quality`; eq. 5 of the paper); ties go to the smallest k. M
    depends on two distances only, so a single lost beam can change it. Each k therefore also has a
    trimmed M, which uses quantiles. If trimmed M prefers another k, or likes it nearly as well,
    that k is the runner-up. Its views may make a better map. If all images are equal, there is one
    view, and an ImageWarning.

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
            of one strange thing are isolated if most views were seen more often. None isolates no
            image.

    Attributes:
        labels_: (n,) view of each fitted image; -1 for noise, which is an isolated image or one
            that the clusterer calls noise.
        k_: Number of views without noise.
        confidence_: (n,) how surely each image belongs to its view, in [0, 1]; 0 for noise
            (`perception.confidence`).
        quality_: Dict from each k that was tried to its M, without noise. It has one entry if k is
            given or if the clusterer finds k itself.
        trimmed_: Dict from each k that was tried to its trimmed M
            (`perception.quality.trimmed_quality`).
        labels_by_k_: Dict from each k that was tried to the view of each image, (n,).
        runner_up_: Another k whose views may make a better map. If trimmed M of k_ is below 1.5
            times the largest of the other k, it is the smallest other k that is at least 0.95 times
            as good as the best of these. Otherwise it is the larger k with the largest trimmed M,
            if that is at least 2.3. Otherwise it is None.
        cluster_centers_: (k, d) centres of the views, if the clusterer has them.
        clusterer_: The fitted clusterer; None if all images are equal.
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
        self.k = k
        self.k_min = k_min
        self.k_max = k_max
        self.clusterer = clusterer
        self.n_init = n_init
        self.random_state = random_state
        self.by = by
        self.trim = trim
        self.isolated = isolated

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
        if (images == images[0]).all():
            return self._one_view(images)
        return (
            self._fit_all(images) if self.isolated is None else self._fit_without_isolated(images)
        )

    def _fit_without_isolated(self, images: NDArray[np.float64]) -> Self:
        """Fit to the images that are not isolated. The others become noise."""
        far = _to_neighbour(images, images, 1)
        self.reach_ = float(self.isolated or math.inf) * float(np.median(far))
        inside = (far <= self.reach_) | (self.reach_ == 0)
        # If all images that are left are equal, nothing distinguishes them. Isolate none instead.
        if (images[inside] == images[inside][0]).all():
            inside[:] = True
        self._fit_all(images[inside])
        self.labels_by_k_: dict[int, NDArray[np.intp]] = {
            k: _with_noise(inside, labels) for k, labels in self.labels_by_k_.items()
        }
        self.labels_ = self.labels_by_k_[self.k_]
        self.confidence_, self.inside_ = confidence(images, self.labels_), images[inside]
        return self

    def _fit_all(self, images: NDArray[np.float64]) -> Self:
        """Fit to images that are not all equal."""
        seed = int(check_random_state(self.random_state).randint(2**31 - 1))
        if self.clusterer is not None and _count_parameter(self.clusterer) is None:
            best = self._cluster(images, None, seed)
            self._record_single(best, images)
        elif self.k is not None:
            if self.k > 1:
                self._check_distinct(self.k, images)
            best = self._cluster(images, self.k, seed)
            self._record_single(best, images)
        else:
            best = self._search(images, seed)
        return self._record_fit(best, images)

    def predict(self, X: ArrayLike) -> NDArray[np.intp]:
        """Predict the views of images.

        If the clusterer can predict, it does so (k-means: the view with the nearest centre).
        Otherwise an image gets the view of the nearest fitted image.

        Args:
            X: (n, d) images, finite.

        Returns:
            (n,) views; -1 for an image that is isolated from the fitted images.
        """
        check_is_fitted(self)
        images = validate_data(self, equal_length(X), dtype=np.float64, reset=False)
        if self.clusterer_ is None:
            return np.zeros(len(images), np.intp)
        views = np.asarray(
            (self.clusterer_ if self.nearest_ is None else self.nearest_).predict(images), np.intp
        )
        if self.isolated is not None and self.reach_ > 0:
            views[_to_neighbour(images, self.inside_, 0) > self.reach_] = NOISE
        return views

    def score(self, X: ArrayLike, y: Any = None) -> float:
        """Compute M of the views that are predicted for images, without noise.

        Args:
            X: (n, d) images, finite.
            y: Ignored.

        Returns:
            M; larger is better. NaN for one view, or if all images are noise.
        """
        views, images = self.predict(X), np.asarray(X, float)
        return (
            cluster_quality(images[views != NOISE], views[views != NOISE])
            if (views != NOISE).any()
            else math.nan
        )

    @property
    def runner_up_labels_(self) -> NDArray[np.intp] | None:
        """The view of each image for `runner_up_` views, (n,); None without a runner-up."""
        return None if self.runner_up_ is None else self.labels_by_k_[self.runner_up_]

    def _record_single(self, best: Any, images: NDArray[np.float64]) -> None:
        """Record the only clustering that was tried."""
        labels = _labels(best, images)
        inside = labels != NOISE
        self.k_ = len(set(labels[inside].tolist()))
        self.runner_up_: int | None = None
        self.quality_ = {
            self.k_: cluster_quality(images[inside], labels[inside]) if inside.any() else math.nan
        }
        self.trimmed_ = {
            self.k_: trimmed_quality(images[inside], labels[inside], self.trim)
            if inside.any()
            else math.nan
        }
        self.labels_by_k_ = {self.k_: labels}

    def _search(self, images: NDArray[np.float64], seed: int) -> Any:
        """Try each k, record the results in attributes, and return the clusterer of the best k."""
        tree, chosen = spanning_tree(images), sample_indices(len(images))
        distances = cdist(images[chosen], images[chosen])
        most = min(20, len(images) - 1) if self.k_max is None else self.k_max
        most = min(max(most, self.k_min), tree.distinct)
        self._check_distinct(self.k_min, images, tree.distinct)
        self.quality_, self.trimmed_, self.labels_by_k_ = {}, {}, {}
        fitted: dict[int, Any] = {}
        for k in range(self.k_min, most + 1):
            tried = self._cluster(images, k, seed)
            labels = _labels(tried, images)
            if fitted and len(set(labels.tolist())) < k:
                continue  # A mixture left some of its components empty.
            fitted[k], self.labels_by_k_[k] = tried, labels
            self.quality_[k] = cluster_quality(images, labels, tree)
            self.trimmed_[k] = trimmed_quality(images[chosen], labels[chosen], self.trim, distances)
        self.k_ = (
            _smallest_good(self.trimmed_)
            if self.by == "trimmed"
            else max(self.quality_, key=self.quality_.__getitem__)
        )
        self.runner_up_ = self._find_runner_up()
        return fitted[self.k_]

    def _find_runner_up(self) -> int | None:
        """The number of views that may be better than the chosen one; None if there is none."""
        others = {k: worth for k, worth in self.trimmed_.items() if k != self.k_}
        if others and self.trimmed_[self.k_] < NEAR * max(others.values()):
            return _smallest_good(others)
        finer = {k: worth for k, worth in others.items() if k > self.k_ and worth >= APART}
        return max(finer, key=finer.__getitem__, default=None)

    def _cluster(self, images: NDArray[np.float64], k: int | None, seed: int) -> Any:
        """Fit a clusterer with k views. If k is None, the clusterer chooses the number."""
        if self.clusterer is None:
            return self._k_means(images, k, seed)
        chosen = clone(self.clusterer)
        settings = chosen.get_params()
        if k is not None:
            chosen.set_params(**{str(_count_parameter(chosen)): k})
        if (
            "random_state" in settings
            and settings["random_state"] is None
            and self.random_state is not None
        ):
            chosen.set_params(random_state=seed)
        return chosen.fit(images)

    def _k_means(self, images: NDArray[np.float64], k: int | None, seed: int) -> Any:
        """Fit k-means to all images, from the best of several starts."""
        # Rounds are short: on shared cores, two threads would wait for each other longer than they
        # work.
        with threadpool_limits(1):
            if len(images) > MANY:
                sample = np.random.default_rng(seed).choice(len(images), MANY, replace=False)
                # The sample may have fewer different images than k while all images have enough.
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore", ConvergenceWarning)
                    start = (
                        KMeans(k, n_init=self.n_init, max_iter=ROUNDS, random_state=seed)
                        .fit(images[sample])
                        .cluster_centers_
                    )
                return KMeans(k, init=start, n_init=1, max_iter=ROUNDS, random_state=seed).fit(
                    images
                )
            return KMeans(k, n_init=self.n_init, random_state=seed).fit(images)

    def _record_fit(self, best: Any, images: NDArray[np.float64]) -> Self:
        """Record the fitted clusterer and its labels."""
        self.clusterer_ = best
        self.labels_ = _labels(best, images)
        self.confidence_ = confidence(images, self.labels_)
        self.nearest_ = (
            None
            if hasattr(best, "predict")
            else KNeighborsClassifier(1, algorithm="brute").fit(images, self.labels_)
        )
        if hasattr(best, "cluster_centers_"):
            self.cluster_centers_ = best.cluster_centers_
        elif hasattr(self, "cluster_centers_"):
            del self.cluster_centers_
        return self

    def _one_view(self, images: NDArray[np.float64]) -> Self:
        """Record that all images are one view."""
        warnings.warn(
            f"all {len(images)} images are equal: they are taken as one view",
            ImageWarning,
            stacklevel=3,
        )
        self.clusterer_ = self.nearest_ = None
        self.labels_, self.k_, self.runner_up_ = np.zeros(len(images), np.intp), 1, None
        self.quality_, self.trimmed_, self.labels_by_k_ = (
            {1: math.nan},
            {1: math.nan},
            {1: self.labels_},
        )
        self.cluster_centers_, self.confidence_ = images[:1].copy(), np.ones(len(images))
        return self

    def _check(self) -> None:
        """Raise PerceptionError if a setting is invalid or contradicts another."""
        for name in ("k", "k_min", "k_max", "n_init"):
            value, least = getattr(self, name), 2 if name == "k_min" else 1
            if value is None and name in ("k", "k_max"):
                continue
            if not isinstance(value, int | np.integer) or isinstance(value, bool) or value < least:
                raise PerceptionError(
                    f"{name}: expected a whole number of at least {least}, got {value!r}"
                )
        if self.n_init > MOST_STARTS:
            raise PerceptionError(
                f"n_init: expected at most {MOST_STARTS} starts, got {brief(self.n_init)}; a "
                "few dozen are many"
            )
        # scikit-learn takes seeds of 32 bits.
        if self.random_state is not None and not isinstance(
            self.random_state, np.random.RandomState
        ):
            a_whole_number(
                "random_state",
                self.random_state,
                PerceptionError,
                0,
                2**32 - 1,
                what="a seed",
                mend="give a seed, a RandomState or None",
            )
        if not isinstance(self.by, str) or self.by not in ("M", "trimmed"):
            raise PerceptionError(f'by: expected "M" or "trimmed", got {self.by!r}')
        if self.isolated is not None and not (is_finite(self.isolated) and self.isolated > 1):
            raise PerceptionError(
                f"isolated: expected a number of more than 1, or None, got {self.isolated!r}"
            )
        if self.k is None and self.k_max is not None and self.k_max < self.k_min:
            raise PerceptionError(
                f"k_max: expected at least k_min = {self.k_min}, got {self.k_max}"
            )
        if self.clusterer is not None and not (
            hasattr(self.clusterer, "fit") and hasattr(self.clusterer, "get_params")
        ):
            raise PerceptionError(
                "clusterer: expected a scikit-learn clusterer, such as DBSCAN(), got "
                f"{self.clusterer!r}"
            )
        if (
            self.k is not None
            and self.clusterer is not None
            and _count_parameter(self.clusterer) is None
        ):
            raise PerceptionError(
                f"k: {type(self.clusterer).__name__} finds the number of clusters itself; "
                "leave k out"
            )

    def _check_distinct(
        self, k: int, images: NDArray[np.float64], distinct: int | None = None
    ) -> None:
        """Raise PerceptionError if there are fewer different images than views."""
        found = len(np.unique(images, axis=0)) if distinct is None else distinct
        if found < k:
            raise PerceptionError(
                f"k: expected at most {found}, as there are {found} different images among "
                f"{len(images)}, got {k}"
            )


def as_view_clusterer(clusterer: Any) -> ViewClusterer:
    """Wrap a scikit-learn clusterer in a ViewClusterer.

    Args:
        clusterer: A scikit-learn clusterer, or a ViewClusterer.

    Returns:
        A ViewClusterer whose k is the number of clusters that the clusterer is set to. A
        ViewClusterer is returned unchanged.

    Raises:
        PerceptionError: The argument is not a clusterer.
    """
    if isinstance(clusterer, ViewClusterer):
        return clusterer
    checked = ViewClusterer(clusterer=clusterer)
    checked._check()
    size = _count_parameter(clusterer)
    return checked if size is None else checked.set_params(k=clusterer.get_params()[size])


def _to_neighbour(
    images: NDArray[np.float64], among: NDArray[np.float64], itself: int
) -> NDArray[np.float64]:
    """The distance from each image to its third nearest neighbour, (n,).

    If there are fewer neighbours, it is the distance to the farthest of them.

    Args:
        images: (n, d) images.
        among: (m, d) possible neighbours.
        itself: 1 if `among` contains the images themselves, otherwise 0.
    """
    number = min(NEIGHBOURS + itself, len(among))
    distances, _ = (
        NearestNeighbors(n_neighbors=number, algorithm="brute").fit(among).kneighbors(images)
    )
    return np.asarray(distances[:, -1])


def _with_noise(inside: NDArray[np.bool_], labels: NDArray[np.intp]) -> NDArray[np.intp]:
    """Labels for all images, (n,): `labels` where the mask `inside` is true, elsewhere noise."""
    every = np.full(len(inside), NOISE, np.intp)
    every[inside] = labels
    return every


def _smallest_good(worth: dict[int, float]) -> int:
    """The smallest k whose trimmed M is at least EQUAL times the largest.

    Args:
        worth: Trimmed M for each k.
    """
    return min(k for k in worth if not worth[k] < EQUAL * max(worth.values()))


def _count_parameter(clusterer: Any) -> str | None:
    """The name of the setting for the number of clusters; None if the clusterer chooses it."""
    settings = clusterer.get_params()
    if settings.get("n_clusters") is not None:
        return "n_clusters"
    return (
        "n_components" if isinstance(clusterer, GaussianMixture | BayesianGaussianMixture) else None
    )


def _labels(fitted: Any, images: NDArray[np.float64]) -> NDArray[np.intp]:
    """The cluster of each fitted image, (n,). Mixtures have no labels_ and predict instead."""
    return np.asarray(
        fitted.labels_ if hasattr(fitted, "labels_") else fitted.predict(images), np.intp
    )
