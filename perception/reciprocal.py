"""Turns ranges into reciprocals: near things matter most, and "nothing seen" is 0.

>>> ReciprocalTransformer().fit_transform([[0.5, 2.0, 100.0]])
array([[2.  , 0.5 , 0.01]])
"""

from __future__ import annotations

import warnings
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator, OneToOneFeatureMixin, TransformerMixin
from sklearn.utils.validation import check_is_fitted, validate_data

from perception.errors import ImageWarning, PerceptionError, equal_length
from ssh_abduction.data.checks import a_number


class ReciprocalTransformer(OneToOneFeatureMixin, TransformerMixin, BaseEstimator):  # type: ignore[misc]
    """Turns ranges r in metres, (n, d), into 1 / max(r, floor).

    The distance between two images is the Euclidean distance of their reciprocals (Kuipers and
    Beeson 2002). Lasers report "nothing seen" as +inf, and some report a lost beam as NaN. The
    reciprocal of both is 0. Ranges of zero or less are invalid and are replaced by the floor.
    `transform` counts these replacements in one ImageWarning. Ranges between 0 and the floor are
    replaced by the floor without a warning.

    Args:
        floor: Smallest range in metres, greater than 0. Smaller ranges are replaced by it.
    """

    def __init__(self, floor: float = 0.05) -> None:
        self.floor = floor

    def fit(self, X: ArrayLike, y: Any = None) -> Self:
        """Learn the number of beams.

        Args:
            X: (n, d) ranges in metres.
            y: Ignored.

        Raises:
            PerceptionError: The floor is not a positive number.
            ValueError: The images are not a table.
        """
        mend = "give a number such as 0.1"
        a_number("floor", self.floor, PerceptionError, above=0, what="metres", mend=mend)
        validate_data(self, equal_length(X), dtype=np.float64, ensure_all_finite=False)
        return self

    def transform(self, X: ArrayLike) -> NDArray[np.float64]:
        """Compute the reciprocals, (n, d) in 1/m within [0, 1 / floor], of ranges in metres.

        A range that is +inf or NaN means "nothing seen".
        """
        check_is_fitted(self)
        ranges = validate_data(
            self, equal_length(X), dtype=np.float64, ensure_all_finite=False, reset=False
        )
        infinite, missing, without = np.isposinf(ranges), np.isnan(ranges), ranges <= 0
        counts = [int(np.count_nonzero(part)) for part in (infinite, missing, without)]
        if any(counts):
            warnings.warn(
                f"{sum(counts)} of {ranges.size} ranges were replaced: {counts[0]} infinite and "
                f"{counts[1]} missing (NaN) "
                f"are taken as nothing seen, {counts[2]} of zero or less as {self.floor} m",
                ImageWarning,
                stacklevel=2,
            )
        return np.where(infinite | missing, 0.0, 1 / np.maximum(ranges, self.floor))

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.input_tags.allow_nan = True
        return tags
