"""Makes views of images: they are clustered, into as many clusters as are separated best.

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
from perception.quality import cluster_quality, sampled, spanning_tree, trimmed_quality
from ssh_abduction.data.checks import a_whole_number
from ssh_abduction.data.errors import brief, is_finite

# Up to this many images all starts of k-means are made on all images. Where there are more, the starts are made on a sample of this many, so that the time for
# them does not grow any further.
MANY = 5_000
# Where there are more than MANY images, k-means has at most this many rounds: once over the sample, and once over all images from the best centres of the sample.
ROUNDS = 30
# Another k is a doubt where trimmed M of the chosen one is less than so many times the largest of the others. docs/reproduction.md has a table of what that finds.
NEAR = 1.5
# More views than the chosen ones are a doubt, too, where their trimmed M is at least this: few views may be far from each other, and each be several that are well apart.
APART = 2.3
# Medians of trimmed M that differ by less than a twentieth do not tell two k apart: then the smaller one is preferred.
EQUAL = 0.95
# Which image is isolated is told by its third nearest neighbour, so that two or three that show the same stranger are isolated, too.
NEIGHBOURS = 3
# More starts of k-means than this are a mistake: each takes as long as the first.
MOST_STARTS = 10_000
# For which `isolated` the loop takes images to be noise where views may be disbelieved. docs/reproduction.md has what it rests on.
ISOLATED = 10.0


class ViewClusterer(ClusterMixin, BaseEstimator):  # type: ignore[misc]
    """Clusters images, (n, d), into k views. If k is not given, it is the number in [k_min, k_max] with the largest M (eq. 5), or the smallest of several.

    M stands on two distances, and one lost beam can change these. So each k also has a trimmed M, and the number of views that this prefers, or nearly does, is
    the runner-up: a reason to look at the map that its views give, too.

    Parameters
    ----------
    k             number of views, or None to choose it by M
    k_min, k_max  the range of k that is searched; k_max None stands for the smaller of 20 and n - 1. No k is larger than the number of different images
    clusterer     None for k-means, or any scikit-learn clusterer or mixture. It is cloned, and its `n_clusters` or `n_components` is set to k. A clusterer
                  without these (DBSCAN, HDBSCAN), or one in which n_clusters is None (AgglomerativeClustering with a distance_threshold), is used as it is,
                  and finds k itself
    n_init        the number of starts of k-means. For more than 5,000 images the starts are made on a random sample of 5,000, and the best one is refined over
                  all images, both in at most 30 rounds; a view that is too rare for the sample may then be missed
    random_state  seed, RandomState or None; if the clusterer has a seed of its own, that is used instead
    by            "M", or "trimmed" for the smallest k with a trimmed M of at least 0.95 times the largest
    trim          the share of distances that trimmed M leaves out at each end, in [0, 0.5]
    isolated      an image is noise, and takes no part in the clustering, where its third nearest neighbour is more than so many times as far as that of the
                  middle image; more than 1. So a view that was seen three times or less is noise where most were seen more often. None: no image is isolated

    Attributes
    ----------
    labels_           (n,) views of the fitted images; -1 where an image is isolated, or the clusterer says that it is noise
    k_                how many views there are, noise not counted
    confidence_       (n,) how sure each view is, in [0, 1]; 0 for noise (perception.confidence)
    quality_          M for each k that was tried, noise left out; only one, where the clusterer finds k itself
    trimmed_          trimmed M for each k that was tried (perception.quality.trimmed_quality)
    labels_by_k_      the views, (n,), for each k that was tried
    runner_up_        what trimmed M chooses of the other k, where that of k_ is less than 1.5 times the largest of theirs; else the best larger k with a trimmed M of
                      2.3 or more; None where there is no such doubt
    cluster_centers_  (k, d), where the clusterer has centres
    clusterer_        the fitted clusterer; None where all images are equal

    If all images are equal, there is one view and an ImageWarning. Raises PerceptionError for settings that contradict each other or the images,
    and ValueError for images that are not a finite (n, d) table with n >= 2.
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
        self._check()
        images = validate_data(self, equal_length(X), dtype=np.float64, ensure_min_samples=2)
        if (images == images[0]).all():
            return self._one_view(images)
        return self._fit_all(images) if self.isolated is None else self._fit_together(images)

    def _fit_together(self, images: NDArray[np.float64]) -> Self:
        """Fit to the images that are not isolated. The others are noise."""
        far = _to_neighbour(images, images, 1)
        self.reach_ = float(self.isolated or math.inf) * float(np.median(far))
        inside = (far <= self.reach_) | (self.reach_ == 0)
        if (images[inside] == images[inside][0]).all():
            inside[:] = True
        self._fit_all(images[inside])
        self.labels_by_k_: dict[int, NDArray[np.intp]] = {
            k: _among(inside, labels) for k, labels in self.labels_by_k_.items()
        }
        self.labels_ = self.labels_by_k_[self.k_]
        self.confidence_, self.inside_ = confidence(images, self.labels_), images[inside]
        return self

    def _fit_all(self, images: NDArray[np.float64]) -> Self:
        """Fit to images that are not all equal."""
        seed = int(check_random_state(self.random_state).randint(2**31 - 1))
        if self.clusterer is not None and _size(self.clusterer) is None:
            best = self._cluster(images, None, seed)
            self._tell(best, images)
        elif self.k is not None:
            if self.k > 1:
                self._affordable(self.k, images)
            best = self._cluster(images, self.k, seed)
            self._tell(best, images)
        else:
            best = self._search(images, seed)
        return self._keep(best, images)

    def predict(self, X: ArrayLike) -> NDArray[np.intp]:
        """The views of images, (n,), as the clusterer predicts them (k-means: by the nearest centre). For a clusterer that does not predict, the view of the
        nearest image that was fitted. -1 for an image that is isolated among those that were fitted.
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
        """M of the views of images, (n, d), as `predict` gives them; larger is better. NaN where they have one view."""
        views, images = self.predict(X), np.asarray(X, float)
        return (
            cluster_quality(images[views != NOISE], views[views != NOISE])
            if (views != NOISE).any()
            else math.nan
        )

    @property
    def runner_up_labels_(self) -> NDArray[np.intp] | None:
        """The views of the runner-up, (n,), where there is one."""
        return None if self.runner_up_ is None else self.labels_by_k_[self.runner_up_]

    def _tell(self, best: Any, images: NDArray[np.float64]) -> None:
        """Take down a clustering that has no rival."""
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
        """A fitted clusterer for the k with the largest M. Sets what is told of each k."""
        tree, chosen = spanning_tree(images), sampled(len(images))
        distances = cdist(images[chosen], images[chosen])
        most = min(20, len(images) - 1) if self.k_max is None else self.k_max
        most = min(max(most, self.k_min), tree.distinct)
        self._affordable(self.k_min, images, tree.distinct)
        self.quality_, self.trimmed_, self.labels_by_k_ = {}, {}, {}
        fitted: dict[int, Any] = {}
        for k in range(self.k_min, most + 1):
            tried = self._cluster(images, k, seed)
            labels = _labels(tried, images)
            if fitted and len(set(labels.tolist())) < k:
                continue  # a mixture left some of its components empty
            fitted[k], self.labels_by_k_[k] = tried, labels
            self.quality_[k] = cluster_quality(images, labels, tree)
            self.trimmed_[k] = trimmed_quality(images[chosen], labels[chosen], self.trim, distances)
        self.k_ = (
            _smallest_good(self.trimmed_)
            if self.by == "trimmed"
            else max(self.quality_, key=self.quality_.__getitem__)
        )
        self.runner_up_ = self._doubted()
        return fitted[self.k_]

    def _doubted(self) -> int | None:
        """The number of views that is a reason to doubt the chosen one."""
        others = {k: worth for k, worth in self.trimmed_.items() if k != self.k_}
        if others and self.trimmed_[self.k_] < NEAR * max(others.values()):
            return _smallest_good(others)
        finer = {k: worth for k, worth in others.items() if k > self.k_ and worth >= APART}
        return max(finer, key=finer.__getitem__, default=None)

    def _cluster(self, images: NDArray[np.float64], k: int | None, seed: int) -> Any:
        """A fitted clusterer for k views."""
        if self.clusterer is None:
            return self._k_means(images, k, seed)
        chosen = clone(self.clusterer)
        settings = chosen.get_params()
        if k is not None:
            chosen.set_params(**{str(_size(chosen)): k})
        if (
            "random_state" in settings
            and settings["random_state"] is None
            and self.random_state is not None
        ):
            chosen.set_params(random_state=seed)
        return chosen.fit(images)

    def _k_means(self, images: NDArray[np.float64], k: int | None, seed: int) -> Any:
        """k-means fitted to all images, from the best of several starts."""
        with threadpool_limits(
            1
        ):  # rounds are so short that, where cores are shared, two threads wait for each other longer than they work
            if len(images) > MANY:
                sample = np.random.default_rng(seed).choice(len(images), MANY, replace=False)
                with warnings.catch_warnings():  # if the sample has fewer different images than views, all images may still have enough
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

    def _keep(self, best: Any, images: NDArray[np.float64]) -> Self:
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
                f"n_init: expected at most {MOST_STARTS} starts, got {brief(self.n_init)}; a few dozen are many"
            )
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
                f"clusterer: expected a scikit-learn clusterer, such as DBSCAN(), got {self.clusterer!r}"
            )
        if self.k is not None and self.clusterer is not None and _size(self.clusterer) is None:
            raise PerceptionError(
                f"k: {type(self.clusterer).__name__} finds the number of clusters itself; leave k out"
            )

    def _affordable(self, k: int, images: NDArray[np.float64], distinct: int | None = None) -> None:
        """Raise where there are fewer different images than views."""
        found = len(np.unique(images, axis=0)) if distinct is None else distinct
        if found < k:
            raise PerceptionError(
                f"k: expected at most {found}, as there are {found} different images among {len(images)}, got {k}"
            )


def as_view_clusterer(clusterer: Any) -> ViewClusterer:
    """A ViewClusterer for one of scikit-learn's clusterers: it makes as many views as that one is set to. A ViewClusterer, as it is."""
    if isinstance(clusterer, ViewClusterer):
        return clusterer
    checked = ViewClusterer(clusterer=clusterer)
    checked._check()
    size = _size(clusterer)
    return checked if size is None else checked.set_params(k=clusterer.get_params()[size])


def _to_neighbour(
    images: NDArray[np.float64], among: NDArray[np.float64], itself: int
) -> NDArray[np.float64]:
    """How far each image is from its third nearest neighbour among others, (n,); from the last one, where there are fewer.

    itself  1 where each image is among these, too, else 0
    """
    number = min(NEIGHBOURS + itself, len(among))
    distances, _ = (
        NearestNeighbors(n_neighbors=number, algorithm="brute").fit(among).kneighbors(images)
    )
    return np.asarray(distances[:, -1])


def _among(inside: NDArray[np.bool_], labels: NDArray[np.intp]) -> NDArray[np.intp]:
    """The labels of the images that are inside, and noise for the others."""
    every = np.full(len(inside), NOISE, np.intp)
    every[inside] = labels
    return every


def _smallest_good(worth: dict[int, float]) -> int:
    """The smallest k whose trimmed M is EQUAL times the largest, or more."""
    return min(k for k in worth if not worth[k] < EQUAL * max(worth.values()))


def _size(clusterer: Any) -> str | None:
    """The parameter of a clusterer that says how many clusters there are to be; None where it finds that out itself."""
    settings = clusterer.get_params()
    if settings.get("n_clusters") is not None:
        return "n_clusters"
    return (
        "n_components" if isinstance(clusterer, GaussianMixture | BayesianGaussianMixture) else None
    )


def _labels(fitted: Any, images: NDArray[np.float64]) -> NDArray[np.intp]:
    """The cluster of each image that was fitted, (n,). Mixtures predict it."""
    return np.asarray(
        fitted.labels_ if hasattr(fitted, "labels_") else fitted.predict(images), np.intp
    )
