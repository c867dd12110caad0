"""Turns images into features that can be compared: reciprocals of ranges, differences of light.

Near things matter most in reciprocals, and "nothing seen" is 0. Features of panoramas hardly
depend on the light. Each one compares the brightness of a patch with that of its neighbours on the
right and below.

>>> import numpy as np
>>> day = np.random.default_rng(0).uniform(40, 200, (2, 24 * 180 * 3))
>>> evening = (day.reshape(2, -1, 3) * [0.5, 0.4, 0.25]).reshape(2, -1)  # darker, and redder
>>> made = PanoramaTransformer((24, 180, 3), floor=0).fit(day)
>>> bool(np.allclose(made.transform(day), made.transform(evening))), made.transform(day).shape
(True, (2, 2025))

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
from ssh_abduction.data.errors import brief, is_whole, said_of
from ssh_abduction.data.trace import Trace


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


Shape = tuple[int, int, int]
# The field of a trace's header with the shape of its panoramas.
FIELD = "panorama"


class PanoramaTransformer(TransformerMixin, BaseEstimator):  # type: ignore[misc]
    """Turns panoramas into differences of log brightness between neighbouring patches.

    The pixels of each patch are averaged. The logarithm of each patch is compared with those of the
    patch on its right and the patch below, for each colour. A factor that multiplies a colour in
    both patches cancels out. So time of day, tint of the light and exposure hardly matter. Light
    from one side changes the features only at corners, where walls face different ways. The
    distance between two panoramas is the Euclidean distance of their features.

    Args:
        shape: Rows, columns and colours; None means one row of grey pixels. The last column is
            beside the first.
        patch: Rows and columns of pixels to average. The last patches are smaller if these do not
            divide the panorama.
        floor: Number added to each value before the logarithm, which damps noise in the dark; 5
            suits values of 0 to 255.

    Reference:
        The first step of Retinex (Land and McCann 1971).
    """

    def __init__(
        self, shape: Shape | None = None, patch: tuple[int, int] = (3, 4), floor: float = 5.0
    ) -> None:
        self.shape, self.patch, self.floor = shape, patch, floor

    def fit(self, X: ArrayLike, y: Any = None) -> Self:
        """Learn the shape of the images and check the settings.

        Args:
            X: (n, rows * columns * colours) values of 0 or more, row by row.
            y: Ignored.

        Raises:
            PerceptionError: A setting is out of range or does not fit the images, or a value is
                negative.
            ValueError: The images are not a finite table.
        """
        images = _bright(validate_data(self, equal_length(X), dtype=np.float64))
        self.shape_ = (
            (1, images.shape[1], 1) if self.shape is None else _numbers("shape", self.shape, 3)
        )
        _numbers("patch", self.patch, 2)
        a_number("floor", self.floor, PerceptionError, 0)
        # The shape comes from the user, the images from a file: they may not fit.
        if np.prod(self.shape_) != images.shape[1]:
            rows, columns, colours = self.shape_
            raise PerceptionError(
                f"images: expected {rows} x {columns} x {colours} values each, got "
                f"{images.shape[1]}; give the shape that they have"
            )
        return self

    def transform(self, X: ArrayLike) -> NDArray[np.float64]:
        """Compute the features of panoramas: differences of log brightness between patches.

        Args:
            X: (n, rows * columns * colours) values of 0 or more, row by row.

        Returns:
            (n, f) differences. For each patch: its right neighbour minus the patch. Then for each
            patch above another: the lower patch minus the upper one.
        """
        check_is_fitted(self)
        images = _bright(validate_data(self, equal_length(X), dtype=np.float64, reset=False))
        patches = images.reshape(-1, *self.shape_)
        # Average patches along rows, then along columns.
        for axis, pixels in ((1, self.patch[0]), (2, self.patch[1])):
            begins = np.arange(0, patches.shape[axis], pixels)
            size = np.diff([*begins, patches.shape[axis]]).reshape(
                [-1 if i == axis else 1 for i in range(4)]
            )
            patches = np.add.reduceat(patches, begins, axis=axis) / size
        logs = np.log(np.maximum(patches + self.floor, np.finfo(float).tiny))
        right, down = np.roll(logs, -1, axis=2) - logs, np.diff(logs, axis=1)
        return np.hstack([right.reshape(len(logs), -1), down.reshape(len(logs), -1)])

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.input_tags.positive_only = True
        return tags


def features_of(trace: Trace) -> ReciprocalTransformer | PanoramaTransformer:
    """Make the transformer for the images of a trace; it is not fitted yet.

    Images are panoramas if the header gives their shape, as `"panorama": [24, 180, 3]`, and
    else ranges. Raises PerceptionError if the shape is not three whole numbers of at least 1.
    """
    shape = trace.extra.get(FIELD)
    if shape is None:
        return ReciprocalTransformer()
    with said_of(trace.source or "trace"):
        rows, columns, colours = _numbers(FIELD, shape, 3)
    return PanoramaTransformer((rows, columns, colours))


def _bright(images: Any) -> NDArray[np.float64]:
    """Check that no value of some images is negative. Raises PerceptionError."""
    if (images < 0).any():
        raise PerceptionError(
            f"images: expected values of 0 or more, got {images.min():g} (Negative values in "
            "data); give brightness as it is"
        )
    return np.asarray(images)


def _numbers(name: str, given: Any, count: int) -> tuple[int, ...]:
    """Check that a setting is `count` whole numbers of at least 1. Raises PerceptionError."""
    if (
        not isinstance(given, list | tuple)
        or len(given) != count
        or not all(is_whole(number) and number >= 1 for number in given)
    ):
        raise PerceptionError(
            f"{name}: expected {count} whole numbers of at least 1, got {brief(given)}; give "
            "rows and columns of pixels first"
        )
    return tuple(int(number) for number in given)
