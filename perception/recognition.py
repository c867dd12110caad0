"""Recognises places in images, once the map has labelled images: the nearest image seen before tells where the robot is.

>>> recogniser().fit([[1.0, 4.0], [3.0, 3.0]], ["corner", "hall"]).predict([[1.1, 4.2]]).tolist()
['corner']
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.distance import cdist
from sklearn.base import BaseEstimator, ClassifierMixin, clone
from sklearn.neighbors import KNeighborsClassifier
from sklearn.pipeline import Pipeline
from sklearn.utils import check_random_state
from sklearn.utils.multiclass import check_classification_targets
from sklearn.utils.validation import check_is_fitted, validate_data

from perception.errors import ImageWarning, PerceptionError, equal_length
from perception.reciprocal import ReciprocalTransformer
from ssh_abduction.data.errors import brief


class PlaceRecogniser(ClassifierMixin, BaseEstimator):  # type: ignore[misc]
    """The label of the nearest image, or the commonest among the `n_neighbors` nearest (Euclidean distance).

    Attributes: classes_, (c,); neighbours_, the fitted KNeighborsClassifier. Raises PerceptionError for a number of neighbours that is
    not in 1 … n, and ValueError for images that are not a finite (n, d) table or labels that are not classes.
    """

    def __init__(self, n_neighbors: int = 1) -> None:
        self.n_neighbors = n_neighbors

    def fit(self, X: ArrayLike, y: ArrayLike) -> Self:
        """Remember images, (n, d), and their labels, (n,)."""
        images, labels = validate_data(self, equal_length(X), y, dtype=np.float64)
        number = self.n_neighbors
        if (
            not isinstance(number, int | np.integer)
            or isinstance(number, bool)
            or not 1 <= number <= len(images)
        ):
            raise PerceptionError(
                f"n_neighbors: expected a whole number from 1 to the {len(images)} images, got {number!r}"
            )
        with warnings.catch_warnings():  # scikit-learn takes labels for numbers to regress on where many of them occur once or twice
            warnings.filterwarnings("ignore", "The number of unique classes")
            check_classification_targets(labels)
            # A tree of images does not help in 180 dimensions, and a plain table of images is safer to store.
            self.neighbours_ = KNeighborsClassifier(number, algorithm="brute").fit(images, labels)
        self.classes_ = self.neighbours_.classes_
        return self

    def predict(self, X: ArrayLike) -> NDArray[Any]:
        """Labels, (n,)."""
        return np.asarray(self._neighbours().predict(self._images(X)))

    def predict_proba(self, X: ArrayLike) -> NDArray[np.float64]:
        """Share of the neighbours that have each of `classes_`, (n, c)."""
        return np.asarray(self._neighbours().predict_proba(self._images(X)), np.float64)

    def distances(self, X: ArrayLike) -> NDArray[np.float64]:
        """Euclidean distance from each image to the nearest remembered one of each of `classes_`, (n, c)."""
        remembered, labels = self.remembered()
        found = cdist(self._images(X), remembered)
        return np.column_stack([found[:, labels == label].min(axis=1) for label in self.classes_])

    def remembered(self) -> tuple[NDArray[np.float64], NDArray[Any]]:
        """The images that were learnt, (m, d), and their labels, (m,)."""
        held = self._neighbours()
        return np.asarray(held._fit_X), np.asarray(self.classes_)[np.asarray(held._y)]

    def learnt_again(self) -> PlaceRecogniser:
        """A recogniser that learns from scratch the images and labels that this one remembers, and so answers the same.

        scikit-learn's compiled search trusts its tables, and tables that were damaged in a file can end the whole process. What is learnt
        again has been checked again. Raises PerceptionError, ValueError or another error of numpy's where the tables are not sound.
        """
        return PlaceRecogniser(self.n_neighbors).fit(*self.remembered())

    def _neighbours(self) -> Any:
        check_is_fitted(self)
        return self.neighbours_

    def _images(self, X: ArrayLike) -> Any:
        return validate_data(self, equal_length(X), dtype=np.float64, reset=False)


def recogniser(floor: float = 0.05, n_neighbors: int = 1, features: Any = None) -> Pipeline:
    """From images, (n, d), to labels: features, then the nearest neighbour. Not fitted yet.

    floor     of the reciprocals of ranges in metres, which are the features where no others are given
    features  a transformer of scikit-learn's kind for other images, such as a PanoramaTransformer. It is cloned
    """
    made = (
        ("reciprocal", ReciprocalTransformer(floor))
        if features is None
        else ("features", cloned("features", features, "transform"))
    )
    return Pipeline([made, ("nearest", PlaceRecogniser(n_neighbors))])


def cloned(name: str, estimator: Any, *methods: str) -> Any:
    """A clone of an estimator of scikit-learn's kind, which has `fit` and these methods. Raises PerceptionError for anything else."""
    wanted = ("fit", "get_params", *methods)
    if isinstance(estimator, type) or not all(hasattr(estimator, method) for method in wanted):
        raise PerceptionError(
            f"{name}: expected an estimator with {', '.join(wanted)}, got {brief(estimator)}; make one of scikit-learn's"
        )
    return clone(estimator)


@dataclass(frozen=True)
class LearningCurve:
    """The recognition rate by the number of images seen.

    sizes      (s,) how many images, from the first on, had been seen
    mean, lowest, highest  (s,) the share of images recognised, in [0, 1], over the folds
    folds      how many folds there were
    untested   classes with a single image. They are never tested, as nothing is known of them once that image is left out
    """

    sizes: tuple[int, ...]
    mean: tuple[float, ...]
    lowest: tuple[float, ...]
    highest: tuple[float, ...]
    folds: int
    untested: tuple[Any, ...] = ()


def learning_curve(
    X: ArrayLike,
    y: ArrayLike,
    sizes: Iterable[int],
    folds: int = 10,
    random_state: int | np.random.RandomState | None = None,
    estimator: Any = None,
) -> LearningCurve:
    """The recognition rate, by cross-validation, for growing numbers of images (Kuipers and Beeson 2002, the learning curves).

    The n images, (n, d), in the order in which they were seen, are dealt into `folds` parts, each class spread evenly. For each size m and
    each fold, a clone of `estimator` (default: `recogniser()`, so images are ranges in metres) learns from those of the first m images
    that are not in the fold, and is tested on the whole fold. So all sizes are tested on the same images; those of places that are not among the first m
    images count as errors. A clone that has no image to learn from recognises nothing.

    Raises PerceptionError for sizes outside 1 … n, fewer than 2 folds, or fewer images to test than folds.
    """
    estimator = recogniser() if estimator is None else estimator
    images, labels = np.asarray(equal_length(X)), np.asarray(y)
    clone(estimator).fit(
        images, labels
    )  # so that warnings and errors about the images come once, and not for each fold
    wanted = tuple(int(size) for size in sizes)
    for size in wanted:
        if not 1 <= size <= len(images):
            raise PerceptionError(
                f"sizes: expected numbers from 1 to the {len(images)} images, got {size}"
            )
    fold, untested = _deal(labels, folds, random_state)
    rates = np.zeros((len(wanted), folds))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ImageWarning)
        for f in range(folds):
            test = fold == f
            for s, size in enumerate(wanted):
                train = np.flatnonzero(~test[:size])
                if len(train):
                    rates[s, f] = np.mean(
                        clone(estimator).fit(images[train], labels[train]).predict(images[test])
                        == labels[test]
                    )
    mean, lowest, highest = (
        tuple(part.tolist()) for part in (rates.mean(axis=1), rates.min(axis=1), rates.max(axis=1))
    )
    return LearningCurve(wanted, mean, lowest, highest, folds, untested)


def _deal(
    labels: NDArray[Any], folds: int, random_state: Any
) -> tuple[NDArray[np.intp], tuple[Any, ...]]:
    """The fold of each image, -1 for those never tested, and the classes that are never tested.

    Images are dealt round like cards, one class after the other. So the sizes of folds differ by at most one image, in all and within each class.
    """
    if folds < 2:
        raise PerceptionError(f"folds: expected at least 2, got {folds}")
    classes, of, counts = np.unique(labels, return_inverse=True, return_counts=True)
    shuffled = check_random_state(random_state).permutation(len(labels))
    cards = shuffled[np.argsort(of[shuffled], kind="stable")]
    cards = cards[counts[of[cards]] > 1]
    if len(cards) < folds:
        raise PerceptionError(
            f"folds: expected at most {len(cards)}, the images of places seen more than once, got {folds}"
        )
    fold = np.full(len(labels), -1, np.intp)
    fold[cards] = np.arange(len(cards)) % folds
    return fold, tuple(classes[counts == 1].tolist())


PlaceRecognizer = PlaceRecogniser  # its name of version 0.1.0, which files of recognisers hold
