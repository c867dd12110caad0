"""Recognises places: an image gets the label of the most similar image that was learnt.

The labels to learn come from a map, which gives the dstate of each image (a position and a
heading).

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
from ssh_abduction.data.checks import a_whole_number
from ssh_abduction.data.errors import brief


class PlaceRecogniser(ClassifierMixin, BaseEstimator):  # type: ignore[misc]
    """Gives an image the commonest label among its nearest learnt images (Euclidean distance).

    Args:
        n_neighbors: Number of nearest images that vote, from 1 to the number of learnt images.

    Attributes:
        classes_: (c,) learnt labels, sorted.
        neighbours_: The fitted KNeighborsClassifier.
    """

    def __init__(self, n_neighbors: int = 1) -> None:
        self.n_neighbors = n_neighbors

    def fit(self, X: ArrayLike, y: ArrayLike) -> Self:
        """Remember images and their labels.

        Args:
            X: (n, d) images, finite.
            y: (n,) labels.

        Raises:
            PerceptionError: The number of neighbours is not in 1 … n.
            ValueError: The images are not a finite table, or the labels are not classes.
        """
        images, labels = validate_data(self, equal_length(X), y, dtype=np.float64)
        mend = "give a smaller number, or more images"
        number = a_whole_number(
            "n_neighbors", self.n_neighbors, PerceptionError, 1, len(images), mend=mend
        )
        # If many labels are rare, scikit-learn warns that labels might be numbers.
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "The number of unique classes")
            check_classification_targets(labels)
            # A tree does not help in 180 dimensions, and a plain table of images is safer to store.
            self.neighbours_ = KNeighborsClassifier(number, algorithm="brute").fit(images, labels)
        self.classes_ = self.neighbours_.classes_
        return self

    def predict(self, X: ArrayLike) -> NDArray[Any]:
        """Predict the label of each image, (n,)."""
        return np.asarray(self._neighbours().predict(self._images(X)))

    def predict_proba(self, X: ArrayLike) -> NDArray[np.float64]:
        """Compute which share of an image's nearest neighbours has each of `classes_`, (n, c)."""
        return np.asarray(self._neighbours().predict_proba(self._images(X)), np.float64)

    def distances(self, X: ArrayLike) -> NDArray[np.float64]:
        """Measure how far the nearest learnt image of each class is from each image.

        Images are (n, d), finite. Distances are (n, c), Euclidean, a column for each of `classes_`.
        """
        remembered, labels = self.remembered()
        found = cdist(self._images(X), remembered)
        return np.column_stack([found[:, labels == label].min(axis=1) for label in self.classes_])

    def remembered(self) -> tuple[NDArray[np.float64], NDArray[Any]]:
        """The learnt images, (m, d), and their labels, (m,)."""
        held = self._neighbours()
        return np.asarray(held._fit_X), np.asarray(self.classes_)[np.asarray(held._y)]

    def learnt_again(self) -> PlaceRecogniser:
        """Make a new recogniser from the remembered images and labels. It gives the same answers.

        This checks the remembered tables. scikit-learn's compiled search trusts its tables,
        so a table that was damaged in a file could crash the process. Damage raises
        PerceptionError, ValueError, or other errors of numpy.
        """
        return PlaceRecogniser(self.n_neighbors).fit(*self.remembered())

    def _neighbours(self) -> Any:
        check_is_fitted(self)
        return self.neighbours_

    def _images(self, X: ArrayLike) -> Any:
        return validate_data(self, equal_length(X), dtype=np.float64, reset=False)


def recogniser(floor: float = 0.05, n_neighbors: int = 1, features: Any = None) -> Pipeline:
    """Make a pipeline that predicts labels of images, (n, d), by the nearest neighbour.

    The pipeline first turns images into features. It is not fitted yet.

    Args:
        floor: Smallest range in metres, if the features are reciprocals of ranges (the default).
        n_neighbors: Number of neighbours that vote.
        features: A scikit-learn transformer for other images, such as a PanoramaTransformer. It is
            cloned.
    """
    made = (
        ("reciprocal", ReciprocalTransformer(floor))
        if features is None
        else ("features", cloned("features", features, "transform"))
    )
    return Pipeline([made, ("nearest", PlaceRecogniser(n_neighbors))])


def cloned(name: str, estimator: Any, *methods: str) -> Any:
    """Clone the scikit-learn estimator of the setting `name`, or raise PerceptionError.

    It must have `fit`, `get_params` and the other methods.
    """
    wanted = ("fit", "get_params", *methods)
    if isinstance(estimator, type) or not all(hasattr(estimator, method) for method in wanted):
        raise PerceptionError(
            f"{name}: expected an estimator with {', '.join(wanted)}, got {brief(estimator)}; "
            "give an estimator of scikit-learn"
        )
    return clone(estimator)


@dataclass(frozen=True)
class LearningCurve:
    """The recognition rate as a function of the number of images seen."""

    sizes: tuple[int, ...]  # (s,) numbers of images to learn from
    mean: tuple[float, ...]  # (s,) mean share of recognised images over the folds, in [0, 1]
    lowest: tuple[float, ...]  # (s,) lowest share over the folds
    highest: tuple[float, ...]  # (s,) highest share over the folds
    folds: int  # number of folds
    # Labels with a single image. They are not tested, since no image to learn from is left if that
    # image is tested.
    untested: tuple[Any, ...] = ()


def learning_curve(
    X: ArrayLike,
    y: ArrayLike,
    sizes: Iterable[int],
    folds: int = 10,
    random_state: int | np.random.RandomState | None = None,
    estimator: Any = None,
) -> LearningCurve:
    """Cross-validate the recognition rate for growing numbers of images.

    The images are divided into folds, so that each label is spread evenly over them. For each size
    m and each fold, a clone of the estimator learns from the first m images, without those of the
    fold. It is tested on the whole fold, so all sizes are tested on the same images. An image with
    a label that was not learnt counts as an error. A clone without images to learn from recognises
    nothing.

    Args:
        X: (n, d) images in the order in which they were seen.
        y: (n,) label of each image.
        sizes: Numbers of images to learn from, each from 1 to n.
        folds: Number of folds, at least 2.
        random_state: Seed of the division into folds.
        estimator: A scikit-learn classifier; None means `recogniser()`, for ranges in metres.

    Returns:
        The share of recognised images for each size.

    Raises:
        PerceptionError: A size or the number of folds is out of range, or there are fewer images to
            test than folds.

    Reference:
        Kuipers and Beeson 2002, the learning curves.
    """
    estimator = recogniser() if estimator is None else estimator
    images, labels = np.asarray(equal_length(X)), np.asarray(y)
    # Fit once to all images, so that warnings and errors about the images appear once, and not for
    # each fold.
    clone(estimator).fit(images, labels)
    wanted = tuple(int(size) for size in sizes)
    for size in wanted:
        if not 1 <= size <= len(images):
            raise PerceptionError(
                f"sizes: expected numbers from 1 to the {len(images)} images, got {size}; leave it "
                "out"
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
    """Divide the images into folds, one class after the other, as cards are dealt.

    The sizes of two folds differ by at most one image, in total and within each class. An image
    that is never tested, as it is the only one of its class, has fold -1. These classes are
    returned, too.
    """
    if folds < 2:
        raise PerceptionError(f"folds: expected at least 2, got {folds}; take 2 or more")
    classes, of, counts = np.unique(labels, return_inverse=True, return_counts=True)
    shuffled = check_random_state(random_state).permutation(len(labels))
    cards = shuffled[np.argsort(of[shuffled], kind="stable")]
    cards = cards[counts[of[cards]] > 1]
    if len(cards) < folds:
        mend = f"take fewer (learning-curve --set folds={len(cards)})"
        raise PerceptionError(
            f"folds: expected at most {len(cards)}, the number of images of places that were seen "
            f"more than once, got {folds}; {mend if len(cards) > 1 else 'record a longer drive'}"
        )
    fold = np.full(len(labels), -1, np.intp)
    fold[cards] = np.arange(len(cards)) % folds
    return fold, tuple(classes[counts == 1].tolist())
