"""Growing and shrinking masks, against the filters of scipy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from perception.places.masks import box_of, grown, near, shrunk

EIGHT = np.ones((3, 3), bool)
MASKS = [
    np.random.default_rng(seed).random((rows, columns)) < share
    for seed, (rows, columns, share) in enumerate(
        [(20, 30, 0.05), (30, 20, 0.6), (15, 15, 0.9), (1, 9, 0.3), (12, 1, 0.3)]
    )
]


@pytest.mark.parametrize("mask", MASKS)
def test_masks_grow_and_shrink_by_one_cell(mask: np.ndarray) -> None:
    assert (grown(mask) == ndimage.binary_dilation(mask, EIGHT)).all()
    assert (shrunk(mask) == ndimage.binary_erosion(mask, EIGHT)).all()
    kept = ndimage.binary_erosion(mask, EIGHT, border_value=1)
    assert (shrunk(mask, outside=True) == kept).all()


@pytest.mark.parametrize("far", [0.05, 0.25, 0.3, 1.2, 9.0])
@pytest.mark.parametrize("mask", MASKS)
def test_near_equals_a_distance_transform(mask: np.ndarray, far: float) -> None:
    distance = ndimage.distance_transform_edt(~mask) * 0.1
    assert (near(mask, far, 0.1) == (distance < far)).all()


def test_box_contains_all_cells_and_a_margin() -> None:
    mask = np.zeros((9, 8), bool)
    assert not mask[box_of(mask)].size
    mask[3, 2] = mask[5, 7] = True
    assert box_of(mask) == (slice(2, 7), slice(1, 9))
