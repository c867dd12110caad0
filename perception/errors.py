"""Errors and warnings of perception."""

from __future__ import annotations

from typing import Any

from ssh_abduction.data.errors import AbductionError


class PerceptionError(AbductionError, ValueError):
    """Images, labels, settings or a stored recogniser are invalid.

    It is also a ValueError, which scikit-learn expects.
    """


class LogError(AbductionError, ValueError):
    """A robot's log, or its content, cannot be read or written.

    The text says what was expected, what was found, and how to correct it.
    """


class ImageWarning(UserWarning):
    """Images were poor but usable. The text says how much was replaced, or what was assumed."""


def equal_length(images: Any) -> Any:
    """Return images unchanged, or raise PerceptionError if two differ in length.

    numpy would also reject unequal lengths, but with a message that is hard to understand.
    """
    if isinstance(images, list | tuple):
        lengths = [len(image) if hasattr(image, "__len__") else 0 for image in images]
        for i, length in enumerate(lengths):
            if length != lengths[0]:
                raise PerceptionError(
                    f"image {i}: expected {lengths[0]} ranges, as image 0 has, got {length}; "
                    "give every image the same number of beams"
                )
    return images
