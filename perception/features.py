"""Finds the beams that distinguish two similar dstates (a dstate is a position and a heading).

>>> images = [[1.0, 2.0, 3.0], [1.1, 2.0, 3.0], [1.0, 2.1, 3.0]]
>>> images += [[1.0, 2.0, 5.0], [1.1, 2.0, 5.1], [1.0, 2.1, 5.0]]
>>> found = telling_features(images, [4, 4, 4, 7, 7, 7], 4, 7)
>>> {method: int(shares.argmax()) for method, shares in found.methods.items()}, found.recognised
({'margin': 2, 'permutation': 2, 'linear': 2}, 1.0)

A feature of an image is the value of one beam. Kuipers and Beeson (2002) hope that back-propagation
could learn which features matter. Our recogniser is the nearest neighbour, which has no weights to
learn. So three measures are compared. Each has its own weakness:

- margin: by how much a feature makes the nearest image of the other dstate farther than the nearest
  image of its own dstate (Relief: Kira and Rendell 1992);
- permutation: how much of that margin is lost when the feature is shuffled among the images
  (scikit-learn's permutation_importance);
- linear: what a feature adds to the difference of the dstates in a logistic regression.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.distance import cdist
from sklearn.inspection import permutation_importance
from sklearn.linear_model import LogisticRegression
from sklearn.neighbors import KNeighborsClassifier
from sklearn.utils import check_array

from perception.errors import PerceptionError, equal_length

Floats = NDArray[np.float64]
# Number of times that each feature is shuffled.
SHUFFLED = 10


@dataclass(frozen=True, eq=False)
class TellingFeatures:
    """How much each feature helps to distinguish two dstates, by three methods.

    A method gives each feature a share of at least 0. The shares of a method sum to 1, or are all 0
    if no feature helps. The module describes the methods.
    """

    margin: Floats  # (d,) shares by margin
    permutation: Floats  # (d,) shares by permutation
    linear: Floats  # (d,) shares by logistic regression
    # Share of images whose nearest other image is of their own dstate, from 0 to 1. At about 0.5
    # the dstates look the same, and the shares above mean nothing.
    recognised: float

    @property
    def methods(self) -> dict[str, Floats]:
        return {"margin": self.margin, "permutation": self.permutation, "linear": self.linear}


def telling_features(
    X: ArrayLike, labels: ArrayLike, a: Any, b: Any, random_state: int = 0
) -> TellingFeatures:
    """Find the features that distinguish dstates `a` and `b`.

    Args:
        X: (n, d) images as the recogniser compares them, which are reciprocals of ranges.
        labels: (n,) dstate of each image. Images of other dstates are ignored.
        a: Label of one dstate.
        b: Label of the other dstate.
        random_state: Seed of the permutations of features.

    Returns:
        The share of each feature by three methods, and the share of images that are recognised.

    Raises:
        PerceptionError: a is b, or one of the two has fewer than two images.
    """
    images = check_array(equal_length(X), dtype=np.float64)
    of = np.asarray(labels)
    if of.shape != (len(images),):
        raise PerceptionError(
            f"labels: expected {len(images)}, one per image, got an array of shape {of.shape}; "
            "give one label for each image"
        )
    if a == b:
        raise PerceptionError(
            f"dstates: expected two different ones, got {a!r} twice; name another one"
        )
    for name in (a, b):
        if np.count_nonzero(of == name) < 2:
            seen = np.count_nonzero(of == name)
            raise PerceptionError(
                f"dstates: expected at least two images of {name!r}, got {seen}; log more, or "
                "name another one"
            )
    images, second = images[(of == a) | (of == b)], of[(of == a) | (of == b)] == b
    # Compare each image with the nearest of its own dstate and the nearest of the other one.
    hit, miss = _neighbours(images, second)
    margin = (np.abs(images - images[miss]) - np.abs(images - images[hit])).mean(axis=0)
    far = np.linalg.norm(images - images[miss], axis=1) - np.linalg.norm(
        images - images[hit], axis=1
    )
    return TellingFeatures(
        _shares(margin),
        _shares(_permuted(images, second, random_state)),
        _shares(_linear(images, second)),
        float(np.mean(far > 0)),
    )


def strongest(shares: ArrayLike, most: float = 0.5) -> str:
    """Name the fewest features whose shares, (d,), sum to the part `most` of the total, 0 to 1.

    Their indices are written as ranges, such as "3–14, 80", or "–" if all shares are 0.
    """
    weights = np.asarray(shares)
    order = np.argsort(-weights, kind="stable")
    chosen = np.sort(
        order[: int(np.searchsorted(np.cumsum(weights[order]), most * weights.sum())) + 1]
    )
    if not weights.any():
        return "–"
    parts = np.split(chosen, np.flatnonzero(np.diff(chosen) > 1) + 1)
    return ", ".join(str(part[0]) if len(part) == 1 else f"{part[0]}–{part[-1]}" for part in parts)


def _neighbours(
    images: Floats, second: NDArray[np.bool_]
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """For each image, the nearest other image of its dstate, and of the other dstate."""
    distances = cdist(images, images)
    np.fill_diagonal(distances, np.inf)
    same = second[:, None] == second
    hits = np.where(same, distances, np.inf).argmin(axis=1)
    misses = np.where(same, np.inf, distances).argmin(axis=1)
    return hits.astype(np.intp), misses.astype(np.intp)


def _permuted(images: Floats, second: NDArray[np.bool_], seed: int) -> Floats:
    """Compute how much of the margin on one half of the images is lost if a feature is shuffled."""
    order = np.argsort(second, kind="stable")
    known, asked = order[::2], order[1::2]
    model = KNeighborsClassifier(1, algorithm="brute").fit(images[known], second[known])
    found = permutation_importance(
        model, images[asked], second[asked], scoring=_margin, n_repeats=SHUFFLED, random_state=seed
    )
    return np.asarray(found.importances_mean)


def _margin(model: Any, images: Floats, second: NDArray[np.bool_]) -> float:
    """Compute the margin: how much nearer images are to their own dstate than to the other one.

    It is the mean over all images of the squared distance to the nearest image of the other dstate,
    minus that to the nearest image of their own. A feature is important if shuffling its values
    changes the margin. A useless feature adds the same to both distances, so the margin stays.
    """
    distances = cdist(images, model._fit_X, "sqeuclidean")
    same = second[:, None] == model.classes_[model._y]
    other = np.where(same, np.inf, distances).min(axis=1)
    own = np.where(same, distances, np.inf).min(axis=1)
    return float((other - own).mean())


def _linear(images: Floats, second: NDArray[np.bool_]) -> Floats:
    """Compute what each feature adds to how a logistic regression separates two dstates, (d,)."""
    model = LogisticRegression(max_iter=1000).fit(images - images.mean(axis=0), second)
    return np.asarray(model.coef_[0] * (images[second].mean(axis=0) - images[~second].mean(axis=0)))


def _shares(weights: Floats) -> Floats:
    positive = np.maximum(weights, 0)
    total = positive.sum()
    return positive / total if total > 0 else positive
