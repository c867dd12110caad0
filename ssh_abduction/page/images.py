"""The images of a trace for the page: ranges around the robot, or panoramas, all on one scale.

Each number is one character, which compresses better than digits. The alphabet has no character
that HTML or JSON would escape.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from perception.errors import PerceptionError
from perception.images import images_held
from ssh_abduction.data.errors import TraceError, brief, is_finite, named
from ssh_abduction.data.trace import Trace

ALPHABET = "".join(chr(c) for c in range(35, 127) if chr(c) not in "&<>\\")
LOST = "!"  # a beam that measured nothing
MOST = 100_000  # characters of all images of a page
BEAMS, FEWEST = 181, 24  # the most beams of an image, and the fewest before images are left out
PIXELS = (12, 90)  # the most rows and columns of a panorama
# The percentile of all ranges that is the longest one drawn. The longest range of all may be a look
# down a corridor, which would make all rooms small.
FAR = 95
HALF = 180.0


def beams_of(trace: Trace, count: int) -> tuple[float, float]:
    """The bearings of the beams of a trace.

    The header's `beams` gives them. By default the beams cover the half circle ahead from the right
    to the left, as those of most scanners. An odd number of beams begins straight to the right, an
    even one half a beam from there.

    Args:
        trace: The trace.
        count: The number of beams.

    Returns:
        The bearing of the first beam and the angle between beams, in degrees counterclockwise from
        straight ahead.

    Raises:
        TraceError: If the header is wrong.
    """
    told = trace.extra.get("beams")
    if told is None:
        usual = HALF / (count - 1) if count % 2 and count > 1 else HALF / count
        return -usual * (count - 1) / 2, usual
    first = told.get("first") if isinstance(told, dict) else None
    step = told.get("step") if isinstance(told, dict) else None
    if (
        not is_finite(first)
        or not is_finite(step)
        or step == 0
        or abs(step) * (count - 1) > 360 + 1e-6
    ):
        raise TraceError(
            f'{named(trace.source or "trace")}: beams: expected {{"first": degrees, "step": '
            f"degrees}}, counterclockwise from straight ahead, with which {count} beams go round "
            f"once at most, got {brief(told)}; mend the header, or leave it out"
        )
    return float(first), float(step)


def drawn_images(trace: Trace) -> dict[str, Any] | None:
    """The images of a trace; None if there are none, or too many for a page.

    Returns:
        `images`, a text or None for each step, and `kind`. The kind "ranges" has `first` and `step`
        (degrees counterclockwise) and `reach` (the metres of the last character of the alphabet).
        The kind "panorama" has `rows`, `columns` and `colours`.
    """
    try:
        held = images_held(trace)
    except PerceptionError as error:
        warnings.warn(f"{error}; the page is made without images", stacklevel=2)
        return None
    known = [image for image in held if image is not None]
    if not known:
        return None
    panorama = trace.extra.get("panorama")
    if panorama is not None:
        return _panoramas(held, panorama, MOST // len(known))
    most = max(len(image) for image in known)
    first, step = beams_of(trace, most)
    # Leave out beams until all images fit, but no more than an image can spare.
    every = max(-(-most // BEAMS), -(-most * len(known) // MOST))
    if -(-most // every) < min(FEWEST, most):
        _warn_of_too_many(len(known))
        return None
    finite = [image[np.isfinite(image) & (image > 0)] for image in known]
    ranges = np.concatenate(finite)
    reach = float(np.percentile(ranges, FAR)) if len(ranges) else 1.0
    return {
        "kind": "ranges",
        "first": round(first, 3),
        "step": round(step * every, 4),
        "reach": round(reach, 2),
        "images": [None if image is None else _text(image[::every] / reach) for image in held],
    }


def _text(shares: NDArray[np.float64]) -> str:
    """Numbers from 0 to 1 as characters. A larger number counts as 1, and NaN is LOST."""
    last = len(ALPHABET) - 1
    return "".join(
        LOST if math.isnan(x) else ALPHABET[round(last * min(max(x, 0.0), 1.0))]
        for x in shares.tolist()
    )


def _panoramas(
    held: Sequence[NDArray[np.float64] | None], shape: Any, each: int
) -> dict[str, Any] | None:
    """Panoramas with fewer rows and columns, so that each has at most a number of characters.

    Args:
        held: The image of each step.
        shape: The rows, columns and colours, as the header has them.
        each: The most characters of an image.

    Returns:
        The images; None if the header has another shape than they.
    """
    if (
        not isinstance(shape, list)
        or len(shape) != 3
        or any(not isinstance(n, int) or n < 1 for n in shape)
    ):
        return None
    if any(image is not None and len(image) != math.prod(shape) for image in held):
        return None
    # Halve the rows and columns until an image is short enough.
    rows, columns = min(PIXELS[0], shape[0]), min(PIXELS[1], shape[1])
    while rows * columns * shape[2] > each:
        if rows * columns == 1:
            _warn_of_too_many(sum(image is not None for image in held))
            return None
        rows, columns = max(1, rows // 2), max(1, columns // 2)
    row, column = (
        np.linspace(0, n - 1, k).round().astype(int)
        for n, k in ((shape[0], rows), (shape[1], columns))
    )
    return {
        "kind": "panorama",
        "rows": rows,
        "columns": columns,
        "colours": shape[2],
        "images": [
            None if image is None else _text(image.reshape(shape)[row][:, column].ravel() / 255)
            for image in held
        ],
    }


def _warn_of_too_many(count: int) -> None:
    warnings.warn(
        f"{count} images are more than a page holds; the page is made without images", stacklevel=3
    )
