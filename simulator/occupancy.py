"""Reads occupancy maps as ROS stores them: a YAML file that names a PGM image. The borders of its occupied cells become walls."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from simulator.errors import SimulatorError
from ssh_abduction.errors import brief
from ssh_abduction.files import read_at_most

# The largest coordinate, in metres or degrees: what is farther away is a mistake, and rounding would blur the strides of the robot there.
FARTHEST = 1e6
# Only lines of YAML of at most this many characters can be fields, as the time to look for a field grows with the square of the length.
LONGEST_LINE = 4096
# Bytes that a YAML file may have: it holds a dozen fields.
LARGEST_TEXT = 2**20
# Bytes that an image may have: as floating-point numbers it takes eight times as many, 1 GiB.
LARGEST_IMAGE = 128 * 2**20
_BREAK = rb"(?:\s|#[^\n]*\n)+"
_HEAD = re.compile(rb"(P[25])" + _BREAK + rb"(\d{1,9})" + _BREAK + rb"(\d{1,9})" + _BREAK + rb"(\d{1,9})\s")
_FIELD = re.compile(r"^\s*(\w+)\s*:\s*(.+?)\s*(?:#.*)?$")


def read_occupancy(path: Path) -> tuple[str, NDArray[np.float64]]:
    """The name and the wall segments, (n, 4) in metres, of an occupancy map. Raises SimulatorError."""
    try:
        lines = read_at_most(path, LARGEST_TEXT).decode("utf-8").splitlines()
    except (OSError, ValueError) as error:
        raise SimulatorError(f"{path}: expected the YAML file of an occupancy map: {error}; check the path") from None
    fields = {match[1]: match[2].strip("\"'") for line in lines if len(line) <= LONGEST_LINE and (match := _FIELD.match(line))}
    try:
        resolution = float(fields["resolution"])
        origin = [float(x) for x in fields["origin"].strip("[] ").split(",")]
        threshold = float(fields.get("occupied_thresh", "0.65"))
        negate = fields.get("negate", "0").lower()
        image = path.parent / fields["image"]
    except (KeyError, ValueError) as error:
        raise SimulatorError(
            f"{path}: expected image, resolution and origin: [x, y, yaw], got none or no numbers ({error}); add them"
        ) from None
    if not 0 < resolution <= FARTHEST or len(origin) < 2 or not all(abs(x) <= FARTHEST for x in origin) or not 0 <= threshold <= 1:
        raise SimulatorError(
            f"{path}: expected a resolution above 0, an origin [x, y, yaw] within {FARTHEST:,.0f} m, and a threshold from 0 to 1, "
            f"got {brief(fields)}; mend them"
        )
    if negate not in ("0", "1", "false", "true"):
        raise SimulatorError(f"{path}: negate: expected 0 or 1, got {brief(negate)}; mend it")
    grey = read_pgm(image)
    if resolution * max(grey.shape) > FARTHEST:
        raise SimulatorError(f"{path}: resolution: expected a map of at most {FARTHEST:,.0f} m, got {resolution} m a pixel; mend it")
    occupied = (grey if negate in ("1", "true") else 1 - grey) > threshold
    return path.stem, _edges(occupied[::-1], resolution, (origin[0], origin[1]), path)


def read_pgm(path: Path) -> NDArray[np.float64]:
    """A PGM image, text or binary, as (rows, columns) of 0 (black) to 1 (white). Raises SimulatorError."""
    try:
        data = read_at_most(path, LARGEST_IMAGE)
    except OSError as error:
        raise SimulatorError(f"{path}: expected a PGM image: {error.strerror or error}; check the path in the YAML file") from None
    except ValueError as error:  # a null character in the path, or an image without end
        raise SimulatorError(f"{path}: expected a PGM image: {error}; mend the image of the YAML file") from None
    head = _HEAD.match(data)
    if not head:
        raise SimulatorError(f"{path}: expected a PGM image (P2 or P5), got {brief(data[:20])}; convert it")
    columns, rows, white = (int(head[i]) for i in (2, 3, 4))
    if not (columns and rows and 0 < white < 2**16):
        raise SimulatorError(f"{path}: expected pixels, and white from 1 to 65535, got {columns} x {rows}, white {white}; convert it")
    body = data[head.end() :]
    try:
        if head[1] == b"P2":
            values = np.array(body.split(), dtype=float)
        else:
            values = np.frombuffer(body, dtype=np.uint8 if white < 256 else ">u2").astype(float)
        table = values[: rows * columns].reshape(rows, columns)
    except ValueError:
        raise SimulatorError(f"{path}: expected {rows} x {columns} pixels, got fewer; the file was cut, or is no PGM") from None
    if not ((table >= 0) & (table <= white)).all():
        raise SimulatorError(f"{path}: expected pixels from 0 to {white}, got others; the file is damaged, or is no PGM")
    return table / white


def _edges(occupied: NDArray[np.bool_], resolution: float, origin: tuple[float, float], path: Path) -> NDArray[np.float64]:
    """The borders between occupied and other cells, joined into long segments. Row 0 of the cells is at the bottom."""
    found: list[tuple[float, float, float, float]] = []
    for flipped in (False, True):
        cells = occupied.T if flipped else occupied
        padded = np.pad(cells, ((1, 1), (0, 0)))
        border = padded[1:] != padded[:-1]
        for row in range(border.shape[0]):
            steps = np.flatnonzero(np.diff(np.concatenate([[0], border[row].astype(int), [0]])))
            for first, last in zip(steps[::2], steps[1::2], strict=True):
                found.append((row, first, row, last) if flipped else (first, row, last, row))
    if not found:
        raise SimulatorError(f"{path}: expected walls, got a map without occupied cells; check occupied_thresh and negate")
    segments: NDArray[np.float64] = np.array(found, dtype=float) * resolution + np.array([*origin, *origin])
    return segments
