"""Computes how probable an image is at each known place, and at none of them.

>>> from perception.recognition import PlaceRecogniser
>>> images = [[1.0, 4.0], [1.2, 4.0], [3.0, 3.0], [3.0, 3.1]]
>>> known = PlaceRecogniser().fit(images, ["corner", "corner", "hall", "hall"])
>>> likelihood = ImageLikelihood.of(known)
>>> likelihood.labels([[1.1, 4.0], [3.0, 3.2], [9.0, 0.0]])
['corner', 'hall', None]

A nearest neighbour recogniser always answers, even for an unknown place. This module turns its
distances into densities:

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
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.distance import cdist
from scipy.special import logsumexp
from sklearn.exceptions import NotFittedError
from sklearn.pipeline import Pipeline

from perception.errors import ImageWarning, PerceptionError, equal_length
from perception.recognition import PlaceRecogniser
from ssh_abduction.data.errors import brief

# The spread within a place is at least this share of the spread of all images. Otherwise, images
# without noise, as in a test, would give infinite certainty.
LEAST_SPREAD = 1e-6
# Number of images to compare with all remembered ones at once.
AT_ONCE = 256
# Prior probability that an image is of no known place. RTAB-Map (Labbé and Michaud 2013) also uses
# 0.1.
UNMAPPED = 0.1


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
            known, novel = self._of_features(some)
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

    def _of_features(
        self, features: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Log densities of features at each place, (n, c), and at an unknown one, (n,)."""
        known = self._log_density(_nearest(self.recogniser).distances(features) ** 2, self.within)
        return known, self._log_density(np.sum((features - self.centre) ** 2, axis=1), self.spread)

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
