"""Recognises places: an image gets the label of the most similar image that was learnt.

The labels to learn come from a map, which gives the dstate of each image (a position and a
heading).

>>> recogniser().fit([[1.0, 4.0], [3.0, 3.0]], ["corner", "hall"]).predict([[1.1, 4.2]]).tolist()
['corner']
>>> images = [[1.0, 4.0], [1.2, 4.0], [3.0, 3.0], [3.0, 3.1]]
>>> known = PlaceRecogniser().fit(images, ["corner", "corner", "hall", "hall"])
>>> likelihood = ImageLikelihood.of(known)
>>> likelihood.labels([[1.1, 4.0], [3.0, 3.2], [9.0, 0.0]])
['corner', 'hall', None]

A nearest neighbour recogniser always answers, even for an unknown place. `ImageLikelihood` turns
its distances into densities, which say how probable an image is at each known place, and at none:

- p(o|x), the density of image o at place x. The squared distance from o to the nearest image of x
  is modelled as a sum of `dimensions` squared Gaussian deviations of equal variance. Its mean and
  variance are those of the squared distances from each remembered image to the nearest other image
  of its place (moment matching, Satterthwaite 1946). If each place has one image, the nearest image
  of any place is taken. So `dimensions` is the number of beams that vary independently. It is
  smaller than the number of beams.
- p(o|novel), the density of an unknown appearance. It is a Gaussian around the mean of all
  remembered images, with their spread.
- p(o|nowhere) = (sum over places x of p(o|x) + p(o|novel)) / (places + 1), the density at an
  unknown place. An unknown place looks like one of the known places or like none of them, all with
  equal probability. So an image that is common at all places is no evidence for any of them.
  FAB-MAP (Cummins and Newman 2008) also compares with the average place, by sampling.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.distance import cdist
from scipy.special import logsumexp
from sklearn.base import BaseEstimator, ClassifierMixin, clone
from sklearn.exceptions import NotFittedError
from sklearn.neighbors import KNeighborsClassifier
from sklearn.pipeline import Pipeline
from sklearn.utils.multiclass import check_classification_targets
from sklearn.utils.validation import check_is_fitted, validate_data

from perception.appearance import ReciprocalTransformer
from perception.errors import ImageWarning, PerceptionError, equal_length
from ssh_abduction.data.checks import a_whole_number
from ssh_abduction.data.errors import brief

# The spread within a place is at least this share of the spread of all images. Otherwise, images
# without noise, as in a test, would give infinite certainty.
LEAST_SPREAD = 1e-6
# Number of images to compare with all remembered ones at once.
AT_ONCE = 256
# Prior probability that an image is of no known place. RTAB-Map (Labbé and Michaud 2013) also uses
# 0.1.
UNMAPPED = 0.1


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
class ImageLikelihood:
    """Densities of images at each known place and elsewhere, from the distances of a recogniser.

    Below, the images are the remembered images of the recogniser, in the form in which its last
    estimator compares images (by default, reciprocals of ranges).
    """

    recogniser: Any  # the fitted PlaceRecogniser, or a pipeline that ends with one
    classes: NDArray[Any]  # (c,) labels of the places
    within: float  # mean squared distance from an image to the nearest other image of its place
    spread: float  # mean squared distance from an image to the mean of all images
    centre: NDArray[np.float64]  # (d,) mean of all images
    dimensions: float  # number of beams that vary independently, from 1 to d; see the module

    @classmethod
    def of(cls, recogniser: Any) -> ImageLikelihood:
        """Measure the distances between the images that a recogniser remembers.

        Raises PerceptionError if it is of another kind, is not fitted, or has one image.
        """
        nearest = _nearest(recogniser)
        if not isinstance(nearest, PlaceRecogniser):
            raise PerceptionError(
                "recogniser: expected a PlaceRecogniser, or a pipeline that ends with one, "
                f"got a {type(nearest).__name__}; make one with recogniser()"
            )
        try:
            images, labels = nearest.remembered()
        except NotFittedError:
            raise PerceptionError(
                "recogniser: expected a fitted one, got a new one; call fit with "
                "images and labels first"
            ) from None
        with np.errstate(over="ignore", invalid="ignore"):
            finite = np.isfinite(np.sum((images - images[:1]) ** 2))
        if not finite:
            raise PerceptionError(
                "recogniser: expected one that remembers images of finite numbers, got NaN, "
                "infinity, or numbers too large to square; train it again"
            )
        squares = _within_places(images, labels)
        centre = images.mean(axis=0)
        spread = float(np.mean(np.sum((images - centre) ** 2, axis=1))) or 1.0
        within = max(float(squares.mean()), LEAST_SPREAD * spread)
        variance = float(squares.var())
        beams = float(images.shape[1])
        # Moment matching: a sum of k squares has the variance 2 mean² / k.
        dimensions = min(beams, max(1.0, 2 * within**2 / variance)) if variance else beams
        return cls(recogniser, nearest.classes_, within, max(spread, within), centre, dimensions)

    def ratios(self, images: ArrayLike) -> Iterator[NDArray[np.float64]]:
        """Compute how much likelier each image is at a known place than at an unknown one.

        Yield for each image the ratios p(o|x) / p(o|nowhere), (c,), one for each of `classes`.
        A ratio is between 0 and c + 1.
        """
        features = self._features(images)
        for some in np.array_split(features, max(1, math.ceil(len(features) / AT_ONCE))):
            distances = _nearest(self.recogniser).distances(some)
            known = self._log_density(distances**2, self.within)
            from_centre = np.sum((some - self.centre) ** 2, axis=1)
            novel = self._log_density(from_centre, self.spread)
            nowhere = logsumexp(np.column_stack([known, novel]), axis=1) - np.log(
                known.shape[1] + 1
            )
            yield from np.exp(known - nowhere[:, None])

    def labels(self, images: ArrayLike, unmapped: float = UNMAPPED) -> list[Any]:
        """Find the most probable place of each image, with equal priors for all known places.

        It is one of `classes`, or None if an unknown place, with its prior `unmapped`, is likelier.
        """
        found = []
        for ratios in self.ratios(images):
            known = (1 - unmapped) * ratios.mean() >= unmapped
            found.append(self.classes[ratios.argmax()].item() if known else None)
        return found

    def _features(self, images: ArrayLike) -> NDArray[np.float64]:
        """Compute what the last estimator compares, (n, d). Raises PerceptionError."""
        try:
            table = np.asarray(equal_length(images), np.float64)
        except PerceptionError:
            raise
        except (TypeError, ValueError):
            raise PerceptionError(
                f"images: expected a table of numbers, got {brief(images)}; give a row of "
                "ranges for each image"
            ) from None
        beams = self.recogniser.n_features_in_
        if table.ndim != 2 or table.shape[1] != beams:
            raise PerceptionError(
                f"images: expected {beams} ranges each, as the recogniser learnt, got a table "
                f"of shape {table.shape}; give images of the same laser"
            )
        try:
            if isinstance(self.recogniser, Pipeline):
                table = self.recogniser[:-1].transform(table)
            features = np.asarray(table, np.float64)
        except Exception as error:  # Each part of a model that was damaged fails in its own way.
            raise PerceptionError(
                f"recogniser: expected one that reads images, got {type(error).__name__}: "
                f"{error}; train it again"
            ) from None
        if not np.isfinite(features).all():
            raise PerceptionError(
                "images: expected finite numbers, got NaN or infinity; take recogniser(), "
                "which reads them as nothing seen"
            )
        return features

    def _log_density(self, squares: NDArray[np.float64], mean: float) -> NDArray[np.float64]:
        """Log density of an isotropic Gaussian, at squared distances. `mean` is its variance."""
        return np.asarray(
            -0.5 * self.dimensions * (np.log(2 * np.pi * mean / self.dimensions) + squares / mean)
        )


def _nearest(recogniser: Any) -> Any:
    return recogniser[-1] if isinstance(recogniser, Pipeline) else recogniser


def _within_places(images: NDArray[np.float64], labels: NDArray[Any]) -> NDArray[np.float64]:
    """Squared distance from each image to the nearest other image of its place.

    If each place has one image, it is the distance to the nearest image of another place. That
    is too large, so the densities differ less than they should, and a warning says so. Raises
    PerceptionError if there is only one image.
    """
    squares = np.concatenate(
        [_to_nearest_other(images[labels == label]) for label in np.unique(labels)]
    )
    if len(squares):
        return squares
    if len(images) < 2:
        raise PerceptionError(
            "recogniser: expected two images or more, to learn how images differ, got one; "
            "train it on a longer trace"
        )
    warnings.warn(
        "Each place has one image. How images of one place differ is estimated from images of "
        "different places. So the robot is seldom located; train the recogniser on a longer trace.",
        ImageWarning,
        stacklevel=3,
    )
    return _to_nearest_other(images)


def _to_nearest_other(images: NDArray[np.float64]) -> NDArray[np.float64]:
    """Squared distance from each image to the nearest other one; empty for a single image."""
    if len(images) < 2:
        return np.empty(0)
    squares = cdist(images, images, "sqeuclidean")
    np.fill_diagonal(squares, np.inf)
    return np.asarray(squares.min(axis=1))
