"""How probable an image is at each place that a recogniser knows, and how probable it is at none of them.

>>> from perception.recognition import PlaceRecogniser
>>> known = PlaceRecogniser().fit([[1.0, 4.0], [1.2, 4.0], [3.0, 3.0], [3.0, 3.1]], ["corner", "corner", "hall", "hall"])
>>> likelihood = ImageLikelihood.of(known)
>>> likelihood.labels([[1.1, 4.0], [3.0, 3.2], [9.0, 0.0]])
['corner', 'hall', None]

The nearest neighbour always has an answer, even for an image of nothing. Here its distances are read as densities:

p(o|x)      the squared distance from image o to the nearest image of place x is a sum of `dimensions` squares of Gaussian deviations of one variance. Mean
            and variance of that sum are those of the distances from each remembered image to the nearest other one of its own place. So `dimensions`
            says how many beams deviate independently of each other: fewer than there are (Satterthwaite 1946, moment matching)
p(o|novel)  what no known place looks like: a Gaussian about the mean of all remembered images, as wide as they all are
p(o|nowhere) = (sum over the places x of p(o|x) + p(o|novel)) / (places + 1): a place that is not known looks like one of those that are, or like none, as likely as each of
            them (FAB-MAP, Cummins & Newman 2008, takes the average place as well, there by sampling). So what is seen everywhere tells nothing
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.distance import cdist
from scipy.special import logsumexp
from sklearn.exceptions import NotFittedError
from sklearn.pipeline import Pipeline

from perception.errors import PerceptionError, equal_length
from perception.recognition import PlaceRecogniser
from ssh_abduction.data.errors import brief

# The spread of a place's images is at least this share of the spread of all images: images without any noise, such as those of a test, are not infinitely certain.
LEAST_SPREAD = 1e-6
# So many images are compared with all remembered ones in one go.
AT_ONCE = 256
# Prior probability that an image is of no place that the recogniser knows. RTAB-Map (Labbé and Michaud 2013) gives a robot 0.1 of being at a place that it does not know.
UNMAPPED = 0.1


@dataclass(frozen=True)
class ImageLikelihood:
    """What a recogniser's distances say of images.

    recogniser  the fitted estimator: a PlaceRecogniser, or a pipeline that ends with one
    classes     its places, (c,)
    within      mean squared distance from an image to the nearest other one of its place
    spread      mean squared distance from an image to the mean of all images
    centre      that mean, (d,)
    dimensions  how many squares of independent deviations a squared distance is the sum of, from 1 to d
    """

    recogniser: Any
    classes: NDArray[Any]
    within: float
    spread: float
    centre: NDArray[np.float64]
    dimensions: float

    @classmethod
    def of(cls, recogniser: Any) -> ImageLikelihood:
        """Measure the distances within a recogniser's memory. Raises PerceptionError where it is of another kind, or saw no place twice."""
        nearest = _nearest(recogniser)
        if not isinstance(nearest, PlaceRecogniser):
            raise PerceptionError(
                f"recogniser: expected a PlaceRecogniser, or a pipeline that ends with one, got a {type(nearest).__name__}; make one with recogniser()"
            )
        try:
            images, labels = nearest.remembered()
        except NotFittedError:
            raise PerceptionError(
                "recogniser: expected one that has learnt, got a new one; call fit with images and labels first"
            ) from None
        with np.errstate(over="ignore", invalid="ignore"):
            finite = np.isfinite(np.sum((images - images[:1]) ** 2))
        if not finite:
            raise PerceptionError(
                "recogniser: expected one that remembers images of finite numbers, got NaN, infinity, or numbers too large to square; train it again"
            )
        squares = np.concatenate(
            [_to_nearest_other(images[labels == label]) for label in np.unique(labels)]
        )
        if not len(squares):
            raise PerceptionError(
                "recogniser: expected two images of some place, to learn how images of one place differ, got one of each; train it on a longer trace"
            )
        centre = images.mean(axis=0)
        spread = float(np.mean(np.sum((images - centre) ** 2, axis=1))) or 1.0
        within = max(float(squares.mean()), LEAST_SPREAD * spread)
        variance = float(squares.var())
        beams = float(images.shape[1])
        dimensions = min(beams, max(1.0, 2 * within**2 / variance)) if variance else beams
        return cls(recogniser, nearest.classes_, within, max(spread, within), centre, dimensions)

    def log_likelihoods(self, images: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Logarithms of p(o|x) for each of `classes`, (n, c), and of p(o|novel), (n,), of images as the recogniser takes them, (n, d)."""
        return self._of_features(self._features(images))

    def ratios(self, images: ArrayLike) -> Iterator[NDArray[np.float64]]:
        """For each of these images, (n, d), p(o|x) / p(o|nowhere) for each of `classes`, (c,): from 0 to c + 1."""
        features = self._features(images)
        for some in np.array_split(features, max(1, math.ceil(len(features) / AT_ONCE))):
            known, novel = self._of_features(some)
            nowhere = logsumexp(np.column_stack([known, novel]), axis=1) - np.log(
                known.shape[1] + 1
            )
            yield from np.exp(known - nowhere[:, None])

    def labels(self, images: ArrayLike, unmapped: float = UNMAPPED) -> list[Any]:
        """The likeliest place of each image, (n, d), if all are equally likely before; None where it is likelier that the image is of none of them.

        unmapped  the probability, before it is seen, that an image is of none of them
        """
        found = []
        for ratios in self.ratios(images):
            known = (1 - unmapped) * ratios.mean() >= unmapped
            found.append(self.classes[ratios.argmax()].item() if known else None)
        return found

    def _features(self, images: ArrayLike) -> NDArray[np.float64]:
        """Images as the last estimator of the pipeline takes them. Raises PerceptionError."""
        try:
            table = np.asarray(equal_length(images), np.float64)
        except PerceptionError:
            raise
        except (TypeError, ValueError):
            raise PerceptionError(
                f"images: expected a table of numbers, got {brief(images)}; give a row of ranges for each image"
            ) from None
        beams = self.recogniser.n_features_in_
        if table.ndim != 2 or table.shape[1] != beams:
            raise PerceptionError(
                f"images: expected {beams} ranges each, as the recogniser learnt, got a table of shape {table.shape}; take its own images"
            )
        try:
            features = np.asarray(
                self.recogniser[:-1].transform(table)
                if isinstance(self.recogniser, Pipeline)
                else table,
                np.float64,
            )
        except (
            Exception
        ) as error:  # each part of a model that was damaged in its file fails in its own way
            raise PerceptionError(
                f"recogniser: expected one that reads images, got {type(error).__name__}: {error}; train it again"
            ) from None
        if not np.isfinite(features).all():
            raise PerceptionError(
                "images: expected finite numbers, got NaN or infinity; take recogniser(), which reads them as nothing seen"
            )
        return features

    def _of_features(
        self, features: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        known = self._log_density(_nearest(self.recogniser).distances(features) ** 2, self.within)
        return known, self._log_density(np.sum((features - self.centre) ** 2, axis=1), self.spread)

    def _log_density(self, squares: NDArray[np.float64], mean: float) -> NDArray[np.float64]:
        """Log density of an isotropic Gaussian in `dimensions` dimensions whose squared distances from its centre have this mean."""
        return np.asarray(
            -0.5 * self.dimensions * (np.log(2 * np.pi * mean / self.dimensions) + squares / mean)
        )


def _nearest(recogniser: Any) -> Any:
    return recogniser[-1] if isinstance(recogniser, Pipeline) else recogniser


def _to_nearest_other(images: NDArray[np.float64]) -> NDArray[np.float64]:
    """For each image, the squared distance to the nearest other one; empty for a single image."""
    if len(images) < 2:
        return np.empty(0)
    squares = cdist(images, images, "sqeuclidean")
    np.fill_diagonal(squares, np.inf)
    return np.asarray(squares.min(axis=1))
