"""Occupancy maps as ROS stores them: a YAML file that names a PGM image. Its walls become segments between cells."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from simulator.errors import SimulatorError
from ssh_abduction.errors import brief

_FIELD = re.compile(r"^\s*(\w+)\s*:\s*(.+?)\s*(?:#.*)?$")


def read_occupancy(path: Path) -> tuple[str, NDArray[np.float64]]:
    """The name and the wall segments, (n, 4) in metres, of an occupancy map. Raises SimulatorError."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise SimulatorError(f"{path}: expected the YAML file of an occupancy map: {error}; check the path") from None
    fields = {match[1]: match[2].strip("\"'") for match in map(_FIELD.match, lines) if match}
    try:
        resolution = float(fields["resolution"])
        origin = [float(x) for x in fields["origin"].strip("[] ").split(",")]
        threshold = float(fields.get("occupied_thresh", "0.65"))
        negate = int(fields.get("negate", "0"))
        image = path.parent / fields["image"]
    except (KeyError, ValueError) as error:
        raise SimulatorError(
            f"{path}: expected image, resolution and origin: [x, y, yaw], got none or no numbers ({error}); add them"
        ) from None
    if not resolution > 0 or len(origin) < 2:
        raise SimulatorError(f"{path}: expected a resolution above 0 and an origin [x, y, yaw], got {brief(fields)}; mend them")
    grey = read_pgm(image)
    occupied = (grey if negate else 1 - grey) > threshold
    return path.stem, _edges(occupied[::-1], resolution, (origin[0], origin[1]), path)


def read_pgm(path: Path) -> NDArray[np.float64]:
    """A PGM image, text or binary, as (rows, columns) of 0 (black) to 1 (white). Raises SimulatorError."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise SimulatorError(f"{path}: expected a PGM image: {error.strerror or error}; check the path in the YAML file") from None
    head = re.match(rb"(P[25])(?:\s|#[^\n]*\n)+(\d+)(?:\s|#[^\n]*\n)+(\d+)(?:\s|#[^\n]*\n)+(\d+)\s", data)
    if not head:
        raise SimulatorError(f"{path}: expected a PGM image (P2 or P5), got {brief(data[:20])}; convert it")
    columns, rows, white = (int(head[i]) for i in (2, 3, 4))
    body = data[head.end() :]
    try:
        if head[1] == b"P2":
            values = np.array(body.split(), dtype=float)
        else:
            values = np.frombuffer(body, dtype=np.uint8 if white < 256 else ">u2").astype(float)
        table = values[: rows * columns].reshape(rows, columns)
    except ValueError:
        raise SimulatorError(f"{path}: expected {rows} x {columns} pixels, got fewer; the file was cut, or is no PGM") from None
    return table / white


def _edges(occupied: NDArray[np.bool_], resolution: float, origin: tuple[float, float], path: Path) -> NDArray[np.float64]:
    """Borders between occupied and other cells, joined into long segments; row 0 is at the bottom."""
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
