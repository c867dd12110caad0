"""Reads occupancy maps of ROS, and turns them into walls.

Such a map is a YAML file and an image. The rules are those of map_server and nav2_map_server: each
pixel becomes a cell that is occupied (100), free (0), unknown (-1), or in between. Walls are the
borders of cells of 100, since costmaps and particle filters do not treat other cells as obstacles.
"""

from __future__ import annotations

import io
import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from simulator.errors import SimulatorError, SimulatorWarning
from ssh_abduction.data.errors import brief, named
from ssh_abduction.data.files import parse_yaml, read_at_most, read_file

if TYPE_CHECKING:
    from PIL import Image

Mode: TypeAlias = Literal["trinary", "scale", "raw"]
Cells: TypeAlias = NDArray[np.int8]

# Largest coordinate in metres or degrees. A larger one is a mistake, and rounding would blur the
# motions of the robot.
FARTHEST = 1e6
# Largest size of a YAML file in bytes; it has a dozen fields.
LARGEST_TEXT = 2**20
# Largest size of an image file in bytes, and number of pixels, which take 512 MiB as floating-point
# numbers.
LARGEST_IMAGE, MOST_PIXELS = 128 * 2**20, 2**26
# Kinds of images in the words of Pillow, where PPM includes PGM.
IMAGES = ("PPM", "PNG", "BMP")
MODES: tuple[Mode, ...] = ("trinary", "scale", "raw")
FIELDS = {"image", "resolution", "origin", "negate", "occupied_thresh", "free_thresh", "mode"}
# Default thresholds of mode trinary.
OCCUPIED_THRESH, FREE_THRESH = 0.65, 0.196
OCCUPIED, FREE, UNKNOWN = 100, 0, -1
# Truth values of YAML 1.1 in lower case, and the whole numbers of map_server.
TRUTHS = {
    **dict.fromkeys(("1", "true", "yes", "on", "y"), True),
    **dict.fromkeys(("0", "false", "no", "off", "n"), False),
}


@dataclass(frozen=True, slots=True)
class MapFile:
    """The fields of the YAML file of an occupancy map."""

    image: Path  # path of the image
    resolution: float  # metres a pixel
    # (x, y) of the lower left corner of the image in metres, and its counterclockwise rotation in
    # radians.
    origin: tuple[float, float, float]
    negate: bool = False  # whether white pixels are occupied, instead of black ones
    # A pixel is occupied if it is darker than this, from 0 (white) to 1 (black); with `negate`, if
    # it is brighter.
    occupied_thresh: float = OCCUPIED_THRESH
    # A pixel is free if it is brighter than this, on the same scale.
    free_thresh: float = FREE_THRESH
    mode: Mode = "trinary"  # rule that turns pixels into cells: "trinary", "scale" or "raw"


def read_occupancy(path: Path) -> tuple[str, NDArray[np.float64]]:
    """Read the name of an occupancy map (that of its file) and its walls, (n, 4) metres.

    Raises SimulatorError, which names the file and the field.
    """
    fields = read_map_file(path)
    cells = _cells(fields, path)
    if fields.resolution * max(cells.shape) > FARTHEST:
        raise SimulatorError(
            f"{named(path)}: resolution: expected a map of at most {FARTHEST:,.0f} m, got "
            f"{fields.resolution} m per pixel; mend it"
        )
    occupied = cells == OCCUPIED
    between = int(((cells > FREE) & ~occupied).sum())
    if not occupied.any():
        raise SimulatorError(
            f"{named(path)}: expected walls, got a map without occupied cells ({between:,} of "
            f"{cells.size:,} are in between, 1 to 99); check occupied_thresh, negate and mode"
        )
    if between:
        warnings.warn(
            f"{named(path)}: {between:,} of {cells.size:,} cells are between free and occupied (1 "
            "to 99): they are no walls, "
            f"as only cells of 100 are; in mode trinary occupied_thresh decides",
            SimulatorWarning,
            stacklevel=4,
        )
    # Images begin at the top, maps at the bottom.
    return path.stem, _edges(occupied[::-1], fields.resolution, fields.origin)


def read_map_file(path: Path) -> MapFile:
    """Read the YAML file of an occupancy map, but not its image, and warn of unknown fields.

    Raises SimulatorError, which names the field.
    """
    data = read_file(path, LARGEST_TEXT, "the YAML file of an occupancy map", SimulatorError)
    try:
        # Scalars stay texts, as in the parser of map_server. PyYAML reads 5e-2 as a text.
        fields = parse_yaml(data)
    except ValueError as error:
        raise SimulatorError(
            f"{named(path)}: expected the YAML file of an occupancy map, got {error}; mend it"
        ) from None
    if not isinstance(fields, dict):
        raise SimulatorError(
            f"{named(path)}: expected the YAML file of an occupancy map, got no fields in it; "
            "name another file"
        )
    if strange := sorted(set(fields) - FIELDS):
        warnings.warn(
            f"{named(path)}: expected the fields {', '.join(sorted(FIELDS))}, got others, "
            f"which are not read: {brief(', '.join(strange))}; check their spelling",
            SimulatorWarning,
            stacklevel=4,
        )
    return _checked(fields, path)


def _checked(fields: Mapping[str, Any], path: Path) -> MapFile:
    """Check the fields of a map file. Raises SimulatorError."""

    def need(name: str, is_good: bool, expected: str) -> None:
        if not is_good:
            got = brief(fields[name]) if name in fields else "none"
            raise SimulatorError(f"{named(path)}: {name}: expected {expected}, got {got}; mend it")

    mode = fields.get("mode", "trinary")
    need("mode", mode in MODES, f"{', '.join(MODES[:-1])} or {MODES[-1]}")
    negate = TRUTHS.get(str(fields.get("negate", "0")).lower())
    need("negate", negate is not None, "0 or 1")
    disagree = "0 in mode raw, where map_server and nav2_map_server disagree on what 1 means"
    need("negate", not (negate and mode == "raw"), disagree)
    # Mode scale interpolates between the thresholds, so a default would change every cell.
    shares = []
    for name, usual in (("occupied_thresh", OCCUPIED_THRESH), ("free_thresh", FREE_THRESH)):
        shares.append(_number(fields.get(name, None if mode == "scale" else usual)))
        need(name, 0 <= shares[-1] <= 1, "a threshold from 0 to 1")
    occupied, free = shares
    less = f"less than occupied_thresh ({occupied:g}) in mode scale"
    need("free_thresh", mode != "scale" or free < occupied, less)
    image = fields.get("image")
    named_image = isinstance(image, str) and image != ""
    need("image", named_image, "the path of an image, seen from the YAML file")
    resolution = _number(fields.get("resolution"))
    need("resolution", 0 < resolution <= FARTHEST, "metres per pixel, above 0")
    origin = fields.get("origin")
    place = [_number(item) for item in origin] if isinstance(origin, list) else []
    is_near = len(place) == 3 and all(abs(number) <= FARTHEST for number in place)
    need("origin", is_near, f"[x, y, yaw] in metres and radians, of at most {FARTHEST:,.0f}")
    x, y, yaw = place
    if abs(yaw) > math.tau:
        warnings.warn(
            f"{named(path)}: origin: expected a yaw in radians, got {yaw:g}, which is read as "
            "degrees; write radians",
            SimulatorWarning,
            stacklevel=5,
        )
        yaw = math.radians(yaw)
    image = path.parent / str(image)
    return MapFile(image, resolution, (x, y, yaw), bool(negate), occupied, free, mode)


def _number(value: object) -> float:
    """Convert a text to a finite number; NaN for anything else."""
    try:
        number = float(value) if isinstance(value, str | float) else math.nan
    except ValueError:
        return math.nan
    return number if math.isfinite(number) else math.nan


def _cells(fields: MapFile, path: Path) -> Cells:
    """Read the image as cells, top row first: 100 occupied, 0 free, -1 unknown, or between."""
    shade, opaque = _pixels(fields, path)
    if fields.mode == "raw":
        value = np.rint(shade * 255)
        return np.where(value <= OCCUPIED, value, UNKNOWN).astype(np.int8)
    occupancy = shade if fields.negate else 1 - shade
    free, occupied = fields.free_thresh, fields.occupied_thresh
    between: NDArray[np.float64] | int = UNKNOWN
    if fields.mode != "trinary":
        between = np.rint((occupancy - free) / (occupied - free) * OCCUPIED)
    between = np.where(occupancy < free, FREE, between)
    known = np.where(occupancy > occupied, OCCUPIED, between)
    return np.where(opaque, known, UNKNOWN).astype(np.int8)


def _pixels(fields: MapFile, path: Path) -> tuple[NDArray[np.float64], NDArray[np.bool_] | bool]:
    """Read the brightness of the pixels, and the mask of opaque ones. Raises SimulatorError."""
    from PIL import Image, UnidentifiedImageError  # Imported here because it loads slowly.

    where = f"{named(path)}: image: {named(fields.image)}"
    kinds = "a PGM, PNG or BMP image"
    try:
        data = read_at_most(fields.image, LARGEST_IMAGE)
        with (
            warnings.catch_warnings(action="error", category=Image.DecompressionBombWarning),
            Image.open(io.BytesIO(data), formats=IMAGES) as image,
        ):
            if math.prod(image.size) > MOST_PIXELS:
                raise Image.DecompressionBombError(f"got {image.width:,} x {image.height:,}")
            return _shades(image, with_alpha=fields.mode == "trinary")
    except UnidentifiedImageError:
        said = f"expected {kinds}, got {brief(data[:20])}; convert it"
    except (Image.DecompressionBombWarning, Image.DecompressionBombError) as error:
        said = f"expected at most {MOST_PIXELS:,} pixels: {error}; scale it down"
    except OSError as error:
        said = f"expected {kinds}: {error.strerror or error}; check the path and the file"
    # Damaged images and impossible paths raise these.
    except (ValueError, SyntaxError, IndexError, OverflowError) as error:
        said = f"expected {kinds}: {error}; the file is damaged, or is no image"
    raise SimulatorError(f"{where}: {said}")


def _shades(
    image: Image.Image, with_alpha: bool
) -> tuple[NDArray[np.float64], NDArray[np.bool_] | bool]:
    """Measure the brightness of the pixels, from 0 to 1, and the mask of opaque ones (or True).

    With `with_alpha`, as in mode trinary, opacity is a fourth colour, and all pixels are opaque.
    """
    if image.mode == "F":
        raise ValueError("pixels that are floating-point numbers, for which map_server has no rule")
    if image.mode.startswith("I"):  # Grey, 16 bits per pixel.
        return np.asarray(image, dtype=np.float64) / 65535, True
    has_alpha = image.has_transparency_data
    table = np.asarray(image.convert("RGBA" if has_alpha else "RGB"))
    colours = table if has_alpha and with_alpha else table[:, :, :3]
    shade = colours.sum(axis=2, dtype=np.uint16) / (255 * colours.shape[2])
    return shade, table[:, :, 3] == 255 if has_alpha and not with_alpha else True


def _edges(
    occupied: NDArray[np.bool_], resolution: float, origin: tuple[float, float, float]
) -> NDArray[np.float64]:
    """The borders between occupied and other cells, joined to long segments: (n, 4), metres.

    The bottom row of the mask, (rows, columns), comes first. The other arguments are as in
    `MapFile`.
    """
    found = []
    # Find borders between rows, then between columns by transposing.
    for cells, columns in ((occupied, [0, 1, 2, 3]), (occupied.T, [1, 0, 3, 2])):
        padded = np.pad(cells, ((1, 1), (0, 0)))
        border = np.pad(padded[1:] != padded[:-1], ((0, 0), (1, 1))).astype(np.int8)
        steps = np.diff(border, axis=1)
        (rows, first), (_, last) = np.nonzero(steps == 1), np.nonzero(steps == -1)
        found.append(np.column_stack([first, rows, last, rows])[:, columns])
    x, y, yaw = origin
    ends = np.vstack(found).reshape(-1, 2) * resolution
    turn = np.array([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]])
    return np.asarray((ends @ turn if yaw else ends) + (x, y)).reshape(-1, 4)
