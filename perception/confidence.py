"""Measures how surely each image belongs to its view, which is a cluster of similar images.

An image belongs surely if it is near its own cluster and far from the next one.

>>> confidence([[0.0], [0.2], [4.0], [4.2], [1.9]], [0, 0, 1, 1, 0]).round(2).tolist()
[0.94, 0.96, 1.0, 1.0, 0.6]
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.distance import cdist
from sklearn.utils import check_array

from perception.errors import ImageWarning, PerceptionError, equal_length
from ssh_abduction.data.words import first_few

NOISE = -1  # The label that clusterers give to an image in no cluster.
# An image with less confidence is doubtful. Good images of the paper's worlds have 0.93 or more,
# images with a person before the laser 0.5.
SURE = 0.8
# If the median view has at least SEEN images, a view with at most FEW images, or at most RARE times
# the median number, is doubtful. While a robot explores, views seen once are normal.
FEW, RARE, SEEN = 2, 0.1, 6
# Largest number of images to name in a warning.
NAMED = 8


def confidence(X: ArrayLike, labels: ArrayLike) -> NDArray[np.float64]:
    """Compute how surely each image belongs to its view.

    Let `own` be the distance from an image to the centre of the other images of its view, and
    `next` its distance to the nearest centre of another view. The confidence is next² / (own² +
    next²): 1 at its own centre, 0.5 half way. This is the membership of fuzzy c-means with two
    centres (Bezdek 1981). An image alone in its view has 0.5. Noise (an image in no view) has 0. If
    there is only one view, all its images have 1.

    Args:
        X: (n, d) images, finite.
        labels: (n,) view of each image; -1 for noise.

    Returns:
        (n,) confidence of each image, in [0, 1].

    Raises:
        PerceptionError: The labels have another length.
    """
    images, of = _checked(X, labels)
    views, number, counts = np.unique(of[of != NOISE], return_inverse=True, return_counts=True)
    sure = np.zeros(len(images))
    if len(views) < 2:
        sure[of != NOISE] = 1.0
        return sure
    inside = images[of != NOISE]
    distances = cdist(inside, _centres(inside, number, len(views)))
    here, size = np.arange(len(inside)), counts[number]
    # Measure the distance to the centre of the other images. It is larger than that to the centre
    # of all images by this factor.
    own = distances[here, number] * size / np.maximum(size - 1, 1)
    distances[here, number] = np.inf
    next_ = distances.min(axis=1)
    own[size == 1] = next_[size == 1]
    total = own**2 + next_**2
    sure[of != NOISE] = np.divide(next_**2, total, out=np.full(len(inside), 0.5), where=total > 0)
    return sure


def nearest_views(X: ArrayLike, labels: ArrayLike) -> NDArray[np.intp]:
    """Give each image without a view the view with the nearest centre.

    Args:
        X: (n, d) images, finite.
        labels: (n,) view of each image; -1 for noise, which is an image without a view.

    Returns:
        (n,) view of each image, without -1.

    Raises:
        PerceptionError: All images are noise, or the labels have another length.
    """
    images, of = _checked(X, labels)
    noise = of == NOISE
    if noise.all():
        raise PerceptionError(
            f"images: expected some that are in a cluster, got {len(of)} that are noise; let "
            "clusters be smaller, or wider"
        )
    if not noise.any():
        return of
    views, number = np.unique(of[~noise], return_inverse=True)
    found = of.copy()
    found[noise] = views[
        cdist(images[noise], _centres(images[~noise], number, len(views))).argmin(axis=1)
    ]
    return found


def warn_of_doubts(labels: ArrayLike, sure: ArrayLike, quality: float) -> None:
    """Warn of images that are noise, uncertain or nearly alone, and of overlapping views.

    Args:
        labels: (n,) view of each image; -1 for noise, which is an image in no view.
        sure: (n,) confidence of the view of each image, in [0, 1].
        quality: M of the views (`perception.quality.cluster_quality`). Views overlap if M is below
            1.
    """
    of, certain = np.asarray(labels), np.asarray(sure)
    number, counts = np.unique(of, return_inverse=True, return_counts=True)[1:]
    size = counts[number]
    usual = float(np.median(size[of != NOISE])) if (of != NOISE).any() else 0.0
    # Rare views are doubtful only if the median view was seen often.
    rare = size <= (max(RARE * usual, FEW) if usual >= SEEN else 0)
    doubtful = np.flatnonzero((of == NOISE) | rare | ((certain < SURE) & (size > 1)))
    if len(doubtful):
        named = first_few(doubtful.tolist(), NAMED)
        text = (
            f"{len(doubtful)} of {len(of)} images fit no view, or a view that "
            f"was rarely seen (image {named})"
        )
        text += ": their views may be wrong, and so may the map; check whether something stood in "
        warnings.warn(text + "front of the laser", ImageWarning, 2)
    if quality < 1:
        text = (
            f"views overlap (M is {quality:.2f}, below 1): some images of two views are nearer to "
            "each other than some of one view"
        )
        warnings.warn(
            f"{text}; log images where the robot stands still, at places that it comes back to",
            ImageWarning,
            2,
        )


def _centres(
    images: NDArray[np.float64], number: NDArray[np.intp], views: int
) -> NDArray[np.float64]:
    """The mean image of each view, (views, d)."""
    return np.array([images[number == view].mean(axis=0) for view in range(views)])


def _checked(X: ArrayLike, labels: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    images: Any = check_array(equal_length(X), dtype=np.float64)
    of = np.asarray(labels)
    if of.shape != (len(images),) or not np.issubdtype(of.dtype, np.integer):
        raise PerceptionError(
            f"labels: expected {len(images)} whole numbers, one per image, got an array of "
            f"shape {of.shape}; give one label for each image"
        )
    return images, of.astype(np.intp)
