"""What perception cannot do, and what it did in spite of poor images."""

from __future__ import annotations

from typing import Any

from ssh_abduction.errors import SSHError


class PerceptionError(SSHError, ValueError):
    """Images, labels, settings or a stored recogniser are not what was asked for. A ValueError too, as scikit-learn expects."""


class ImageWarning(UserWarning):
    """Images were poor but usable; the text counts what was replaced, or says what was assumed."""


def equal_length(images: Any) -> Any:
    """The images, as they came. Raises PerceptionError where they are a list of unequal lengths, which numpy reports obscurely."""
    if isinstance(images, list | tuple):
        lengths = [len(image) if hasattr(image, "__len__") else 0 for image in images]
        for i, length in enumerate(lengths):
            if length != lengths[0]:
                raise PerceptionError(
                    f"image {i}: expected {lengths[0]} ranges, as image 0 has, got {length}; give every image the same number of beams"
                )
    return images
