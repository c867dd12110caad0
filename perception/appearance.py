"""Makes features of panoramas in which the light hardly shows: how bright each patch is by how bright the patches beside it and below it are.

>>> import numpy as np
>>> day = np.random.default_rng(0).uniform(40, 200, (2, 24 * 180 * 3))
>>> evening = (day.reshape(2, -1, 3) * [0.5, 0.4, 0.25]).reshape(2, -1)  # darker, and redder
>>> made = PanoramaTransformer((24, 180, 3), floor=0).fit(day)
>>> bool(np.allclose(made.transform(day), made.transform(evening))), made.transform(day).shape
(True, (2, 2025))
"""

from __future__ import annotations

from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator, TransformerMixin
from sklearn.utils.validation import check_is_fitted, validate_data

from perception.errors import PerceptionError, equal_length
from perception.reciprocal import ReciprocalTransformer
from ssh_abduction.data.errors import brief, is_finite, is_whole
from ssh_abduction.data.trace import Trace

Shape = tuple[int, int, int]
# The field of a trace's header that says what shape its panoramas have.
FIELD = "panorama"


class PanoramaTransformer(TransformerMixin, BaseEstimator):  # type: ignore[misc]
    """Makes differences of log brightness of panoramas, (n, rows * columns * colours) values of 0 or more, row by row.

    Patches of neighbouring pixels are averaged, and the logarithm of each patch is compared with those of the patch on its right and of the one below, colour by colour. What multiplies
    the light of a colour drops out where it is the same in both patches: the brightness of the hour, its colour, and the exposure. A sun from one side is left only at corners,
    where walls that face it differently meet. This is the first step of Retinex (Land and McCann 1971). Distances between panoramas are Euclidean on these.

    shape  rows, columns and colours; None for one row of grey pixels. The columns go all around: the last one is beside the first
    patch  rows and columns of pixels that are averaged; where they do not divide a panorama, the last patches are smaller
    floor  is added to each value before the logarithm, so that noise in the dark counts little; 5 suits values of 0 to 255

    Raises PerceptionError for settings that are out of range or do not fit the images, and ValueError for images that are no finite (n, d) table of values of 0 or more.
    """

    def __init__(
        self, shape: Shape | None = None, patch: tuple[int, int] = (3, 4), floor: float = 5.0
    ) -> None:
        self.shape, self.patch, self.floor = shape, patch, floor

    def fit(self, X: ArrayLike, y: Any = None) -> Self:
        """Learn the shape, and nothing else."""
        images = _bright(validate_data(self, equal_length(X), dtype=np.float64))
        self.shape_ = (
            (1, images.shape[1], 1) if self.shape is None else _numbers("shape", self.shape, 3)
        )
        _numbers("patch", self.patch, 2)
        if not is_finite(self.floor) or self.floor < 0:
            raise PerceptionError(
                f"floor: expected a number of 0 or more, got {brief(self.floor)}; change it"
            )
        if np.prod(self.shape_) != images.shape[1]:
            rows, columns, colours = self.shape_
            raise PerceptionError(
                f"images: expected {rows} x {columns} x {colours} values each, got {images.shape[1]}; give the shape that they have"
            )
        return self

    def transform(self, X: ArrayLike) -> NDArray[np.float64]:
        """The differences, (n, f): to the right for all patches, then downwards for all but the lowest."""
        check_is_fitted(self)
        images = _bright(validate_data(self, equal_length(X), dtype=np.float64, reset=False))
        patches = images.reshape(-1, *self.shape_)
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
    """What makes features of the images of a trace, not fitted yet: of panoramas if its header has their shape, as `"panorama": [24, 180, 3]`, else of ranges. Raises PerceptionError."""
    shape = trace.extra.get(FIELD)
    if shape is None:
        return ReciprocalTransformer()
    try:
        rows, columns, colours = _numbers(FIELD, shape, 3)
    except PerceptionError as error:
        raise PerceptionError(f"{trace.source or 'trace'}: {error}") from None
    return PanoramaTransformer((rows, columns, colours))


def _bright(images: Any) -> NDArray[np.float64]:
    if (images < 0).any():
        raise PerceptionError(
            f"images: expected values of 0 or more, got {images.min():g} (Negative values in data); give brightness as it is"
        )
    return np.asarray(images)


def _numbers(name: str, given: Any, count: int) -> tuple[int, ...]:
    if (
        not isinstance(given, list | tuple)
        or len(given) != count
        or not all(is_whole(number) and number >= 1 for number in given)
    ):
        raise PerceptionError(
            f"{name}: expected {count} whole numbers of at least 1, got {brief(given)}; give rows and columns of pixels first"
        )
    return tuple(int(number) for number in given)
