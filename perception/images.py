"""Collects the images of a trace in one table."""

from __future__ import annotations

import io
import os
import zipfile
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from perception.errors import PerceptionError
from ssh_abduction.data.files import save_file
from ssh_abduction.data.trace import Trace, images_file

# Limit in bytes of an unpacked file, since a small archive may unpack to more than the memory.
LARGEST = 4 * 2**30


def images_of(trace: Trace) -> NDArray[np.float64]:
    """Collect the images of all steps: (n, d) ranges in metres, one row per step.

    An image is in the trace itself or in its sidecar file. This is a .npy file, or a .npz file
    with one array or with an array named `images`. Raises PerceptionError if a step has no
    image, lengths differ, or the sidecar file cannot be read.
    """
    for i, step in enumerate(trace.steps):
        if step.image is None:
            raise PerceptionError(
                f"{trace.at(i)}: image: expected one, got none; log an image at each step"
            )
    held = images_held(trace)
    lengths = [len(image) for image in held]  # type: ignore[arg-type]  # as each step has one
    if not lengths[0]:
        raise PerceptionError(
            f"{trace.at(0)}: image: expected at least one range, got none; log what the robot saw"
        )
    # All images must have the length of the first one.
    for i, beams in enumerate(lengths):
        if beams != lengths[0]:
            mend = "give every image the same number of beams"
            raise PerceptionError(
                f"{trace.at(i)}: image: expected {lengths[0]} ranges, as the first has, got "
                f"{beams}; {mend}"
            )
    return np.array(held, dtype=float)


def images_held(trace: Trace) -> list[NDArray[np.float64] | None]:
    """Return the image of each step, (d,) ranges in metres; None if a step has none.

    Raises PerceptionError if the sidecar file cannot be read.
    """
    held = [step.image for step in trace.steps]
    if not any(isinstance(image, int) for image in held):
        return [None if image is None else np.array(image, dtype=float) for image in held]
    # A whole number is the index of a row in the sidecar file.
    table = _sidecar(trace)
    rows: list[NDArray[np.float64] | None] = []
    for i, image in enumerate(held):
        if isinstance(image, int) and image >= len(table):
            raise PerceptionError(
                f"{trace.at(i)}: image: expected an index below {len(table)}, got {image}; "
                f"{trace.images} has no more"
            )
        row = table[image] if isinstance(image, int) else np.array(image, dtype=float)
        rows.append(None if image is None else row)
    return rows


def save_images(path: Path, images: NDArray[np.float64]) -> None:
    """Write images, (n, d), to a sidecar file, an .npz archive. Raises PerceptionError.

    Whole numbers from 0 to 255, such as those of a camera, are stored as bytes.
    """
    are_bytes = bool(((images >= 0) & (images <= 255) & (images == np.floor(images))).all())
    packed = io.BytesIO()
    np.savez_compressed(packed, images=images.astype(np.uint8) if are_bytes else images)
    save_file(path, packed.getvalue(), "images", PerceptionError)


def _sidecar(trace: Trace) -> NDArray[np.float64]:
    """Read the images in the sidecar file of a trace, (m, d). Raises PerceptionError."""
    path = images_file(trace)
    if path is None:
        raise PerceptionError(
            f"{trace.at(0)}: image: expected the header to name a file of images for the "
            "indices, got none; add images"
        )
    try:
        # numpy leaves a damaged file open, so open it here.
        with path.open("rb") as file:
            if zipfile.is_zipfile(file):
                refuse_huge(file, "images", "write fewer images to each file")
            file.seek(0)
            data = np.load(file, allow_pickle=False)
            table = data
            if not isinstance(data, np.ndarray):
                table = data["images" if "images" in data else data.files[0]]
            floats, shape = table.dtype.kind in "iuf", table.shape
    except OSError as error:
        raise PerceptionError(
            f"{path}: expected a .npy or .npz file of images: {error.strerror or error}; "
            "check the field images in the header of the trace"
        ) from None
    except PerceptionError:
        raise
    # A damaged archive can raise anything: zlib.error, MemoryError, AttributeError, …
    except Exception as error:
        why = f"{type(error).__name__}: {error}"
        raise PerceptionError(
            f"{path}: expected a .npy or .npz file of images, got something else ({why}); "
            "write it again"
        ) from None
    if len(shape) != 2 or not floats:
        raise PerceptionError(
            f"{path}: expected a table of images x ranges, got {table.dtype} of shape "
            f"{shape}; store one image per row"
        )
    return np.asarray(table, float)


def refuse_huge(file: BinaryIO | str | os.PathLike[str], what: object, mend: str) -> None:
    """Raise PerceptionError if the zip archive `what` would unpack to more than LARGEST bytes."""
    with zipfile.ZipFile(file) as archive:
        unpacked = sum(part.file_size for part in archive.infolist())
    if unpacked > LARGEST:
        raise PerceptionError(
            f"{what}: expected at most {LARGEST} bytes once unpacked, got {unpacked}; {mend}"
        )
