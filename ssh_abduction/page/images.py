"""Encode the images of a trace for the page: laser ranges or panoramas, all on one scale.

Each number becomes one character, which compresses better than digits. The alphabet has no
character that HTML or JSON would escape.
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
# The most beams of an image. If FEWEST beams an image are too many for the page, all images are
# left out.
BEAMS, FEWEST = 181, 24
PIXELS = (12, 90)  # the most rows and columns of a panorama
# The longest range that is drawn, as a percentile of all ranges. The longest of all may be that of
# a corridor, which would make all rooms small.
FAR = 95
HALF = 180.0


def beams_of(trace: Trace, count: int) -> tuple[float, float]:
    """Find the bearings of the laser beams of a trace.

    The field `beams` of the trace's header gives them. Without it, the beams cover the half circle
    ahead from right to left, as most scanners do. The first of an odd number of beams points
    straight to the right. The first of an even number is half a beam further to the left.

    Args:
        trace: The trace.
        count: The number of beams.

    Returns:
        The bearing of the first beam in degrees counterclockwise from straight ahead, and the
        degrees from each beam to the next.

    Raises:
        TraceError: The header is wrong.
    """
    beams = trace.extra.get("beams")
    if beams is None:
        usual = HALF / (count - 1) if count % 2 and count > 1 else HALF / count
        return -usual * (count - 1) / 2, usual
    first = beams.get("first") if isinstance(beams, dict) else None
    step = beams.get("step") if isinstance(beams, dict) else None
    if (
        not is_finite(first)
        or not is_finite(step)
        or step == 0
        or abs(step) * (count - 1) > 360 + 1e-6
    ):
        raise TraceError(
            f'{named(trace.source or "trace")}: beams: expected {{"first": degrees, "step": '
            f"degrees}}, counterclockwise from straight ahead, with which {count} beams go round "
            f"once at most, got {brief(beams)}; mend the header, or leave it out"
        )
    return float(first), float(step)


def drawn_images(trace: Trace) -> dict[str, Any] | None:
    """Encode the images of a trace.

    Returns:
        A dict with `kind` and with `images`, which has a text or None for each step. The kind
        "ranges" also has `first` and `step` (degrees counterclockwise) and `reach` (the metres that
        the last character of the alphabet means). The kind "panorama" also has `rows`, `columns`
        and `colours`. None if the trace has no images that can be read, or too many for a page.
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
    # Leave out beams until all images fit. If too few would remain, leave out the images.
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
    """Encode numbers from 0 to 1 as characters. A larger number counts as 1, NaN becomes LOST."""
    last = len(ALPHABET) - 1
    return "".join(
        LOST if math.isnan(x) else ALPHABET[round(last * min(max(x, 0.0), 1.0))]
        for x in shares.tolist()
    )


def _panoramas(
    held: Sequence[NDArray[np.float64] | None], shape: Any, each: int
) -> dict[str, Any] | None:
    """Encode panoramas, with rows and columns left out so that they are short enough.

    Args:
        held: The image of each step; None for a step without one.
        each: The largest number of characters for an image.

    Returns:
        The dict that `drawn_images` returns; None if the images do not have the shape, or are too
        many.
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
