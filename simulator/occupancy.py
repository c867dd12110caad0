"""Reads occupancy maps as ROS stores them: a YAML file that names an image. The borders of its occupied cells become walls.

The rules are those of map_server and nav2_map_server. An image is turned into cells that are occupied (100), free (0), unknown (-1), or in between.
Walls are the borders of cells that are 100: a costmap and a particle filter take the others for no obstacle.
"""

from __future__ import annotations

import io
import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from simulator.errors import SimulatorError, SimulatorWarning
from ssh_abduction.data.errors import brief, named
from ssh_abduction.data.files import read_at_most

if TYPE_CHECKING:
    from PIL import Image

Mode: TypeAlias = Literal["trinary", "scale", "raw"]
Cells: TypeAlias = NDArray[np.int8]

# The largest coordinate, in metres or degrees: what is farther away is a mistake, and rounding would blur the strides of the robot there.
FARTHEST = 1e6
# Bytes that a YAML file may have: it holds a dozen fields.
LARGEST_TEXT = 2**20
# Bytes that an image file may have, and its pixels: as floating-point numbers they take 512 MiB.
LARGEST_IMAGE, MOST_PIXELS = 128 * 2**20, 2**26
# The kinds of image that are read, as Pillow calls them: PPM is PGM, too.
IMAGES = ("PPM", "PNG", "BMP")
MODES: tuple[Mode, ...] = ("trinary", "scale", "raw")
FIELDS = {"image", "resolution", "origin", "negate", "occupied_thresh", "free_thresh", "mode"}
# The thresholds of a map in mode trinary that does not name them.
OCCUPIED_THRESH, FREE_THRESH = 0.65, 0.196
OCCUPIED, FREE, UNKNOWN = 100, 0, -1
# How YAML 1.1 writes truth values, in small letters, and the whole numbers that map_server wants.
TRUTHS = {
    **dict.fromkeys(("1", "true", "yes", "on", "y"), True),
    **dict.fromkeys(("0", "false", "no", "off", "n"), False),
}


@dataclass(frozen=True, slots=True)
class MapFile:
    """The fields of the YAML file of an occupancy map.

    Attributes:
        image: The path of the image.
        resolution: Metres a pixel.
        origin: x and y of the lower left corner of the image in metres, and the counterclockwise turn about it in radians.
        negate: Whether white is occupied, and not black.
        occupied_thresh: Above this a pixel is occupied, from 0 (free) to 1.
        free_thresh: Below this a pixel is free.
        mode: How pixels become cells.
    """

    image: Path
    resolution: float
    origin: tuple[float, float, float]
    negate: bool = False
    occupied_thresh: float = OCCUPIED_THRESH
    free_thresh: float = FREE_THRESH
    mode: Mode = "trinary"


def read_occupancy(path: Path) -> tuple[str, NDArray[np.float64]]:
    """Read the walls of an occupancy map.

    Args:
        path: The YAML file.

    Returns:
        The name of the map, and its walls as segments, (n, 4) in metres.

    Raises:
        SimulatorError: The map cannot be read, or has no walls. The text names the file and the field.
    """
    fields = read_map_file(path)
    cells = _cells(fields, path)
    if fields.resolution * max(cells.shape) > FARTHEST:
        raise SimulatorError(
            f"{named(path)}: resolution: expected a map of at most {FARTHEST:,.0f} m, got {fields.resolution} m a pixel; mend it"
        )
    occupied = cells == OCCUPIED
    between = int(((cells > FREE) & ~occupied).sum())
    if not occupied.any():
        raise SimulatorError(
            f"{named(path)}: expected walls, got a map without occupied cells ({between:,} of {cells.size:,} are in between, 1 to 99); "
            f"check occupied_thresh, negate and mode"
        )
    if between:
        warnings.warn(
            f"{named(path)}: {between:,} of {cells.size:,} cells are between free and occupied (1 to 99): they are no walls, "
            f"as only cells of 100 are; in mode trinary occupied_thresh decides",
            SimulatorWarning,
            stacklevel=4,
        )
    return path.stem, _edges(occupied[::-1], fields.resolution, fields.origin)


def read_map_file(path: Path) -> MapFile:
    """Read the YAML file of an occupancy map, but not its image.

    Raises:
        SimulatorError: The file is not readable, no YAML, or a field is missing or has no valid value.
    """
    try:
        fields = _fields(read_at_most(path, LARGEST_TEXT))
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise SimulatorError(
            f"{named(path)}: expected the YAML file of an occupancy map, got none: {reason}; check the path"
        ) from None
    return _Reader(fields, path).map_file()


def _fields(data: bytes) -> dict[str, str | list[str]]:
    """The fields of a YAML file: each a text, or a list of texts. Raises ValueError that says what was got.

    Scalars stay texts, as map_server's own parser has them: PyYAML would take 5e-2 for a text, and 1:30 for a number.
    """
    import yaml  # which takes a while to load

    try:
        root = yaml.compose(data, Loader=yaml.SafeLoader)
    except yaml.YAMLError as error:
        raise ValueError(" ".join(str(error).split())) from None
    except (RecursionError, ValueError) as error:
        raise ValueError(
            "nested too deeply" if isinstance(error, RecursionError) else str(error)
        ) from None
    if not isinstance(root, yaml.MappingNode):
        raise ValueError("no fields in it")
    found: dict[str, str | list[str]] = {}
    for key, value in root.value:
        name, line = (
            brief(key.value if isinstance(key, yaml.ScalarNode) else "a list or an object"),
            key.start_mark.line + 1,
        )
        if key.value in found:
            raise ValueError(f"{name} twice, again in line {line}")
        if isinstance(value, yaml.ScalarNode):
            found[key.value] = value.value
        elif isinstance(value, yaml.SequenceNode) and all(
            isinstance(item, yaml.ScalarNode) for item in value.value
        ):
            found[key.value] = [item.value for item in value.value]
        elif key.value in FIELDS:
            raise ValueError(f"an object or a nested list as {name} in line {line}")
    return found


class _Reader:
    """Checks the fields of a map file, and says which one is wrong."""

    def __init__(self, fields: Mapping[str, str | list[str]], path: Path) -> None:
        self.fields, self.path = fields, path

    def map_file(self) -> MapFile:
        if strange := sorted(set(self.fields) - FIELDS):
            warnings.warn(
                f"{named(self.path)}: expected the fields {', '.join(sorted(FIELDS))}, got others, which are not read: "
                f"{brief(', '.join(strange))}; check their spelling",
                SimulatorWarning,
                stacklevel=5,
            )
        mode = self._mode()
        negate = self._truth("negate")
        if mode == "raw" and negate:
            raise self._wrong(
                "negate",
                "0 in mode raw, where map_server and nav2_map_server disagree on what 1 means",
            )
        # Mode scale is a scale between both thresholds, so that a guess would change each cell.
        occupied = self._share("occupied_thresh", None if mode == "scale" else OCCUPIED_THRESH)
        free = self._share("free_thresh", None if mode == "scale" else FREE_THRESH)
        if mode == "scale" and free >= occupied:
            raise self._wrong(
                "free_thresh", f"less than occupied_thresh ({occupied:g}) in mode scale"
            )
        image = self._text("image")
        return MapFile(
            self.path.parent / image,
            self._resolution(),
            self._origin(),
            negate,
            occupied,
            free,
            mode,
        )

    def _wrong(self, name: str, expected: str) -> SimulatorError:
        got = brief(self.fields[name]) if name in self.fields else "none"
        return SimulatorError(
            f"{named(self.path)}: {name}: expected {expected}, got {got}; mend it"
        )

    def _text(self, name: str) -> str:
        value = self.fields.get(name)
        if not isinstance(value, str) or not value:
            raise self._wrong(
                name,
                "the path of an image, seen from the YAML file"
                if name == "image"
                else "a single value",
            )
        return value

    def _mode(self) -> Mode:
        for mode in MODES:
            if self.fields.get("mode", "trinary") == mode:
                return mode
        raise self._wrong("mode", f"{', '.join(MODES[:-1])} or {MODES[-1]}")

    def _truth(self, name: str) -> bool:
        value = self.fields.get(name, "0")
        if not isinstance(value, str) or value.lower() not in TRUTHS:
            raise self._wrong(name, "0 or 1")
        return TRUTHS[value.lower()]

    @staticmethod
    def _number(value: str | list[str] | None) -> float:
        """A finite number; NaN for anything else."""
        try:
            number = float(value) if isinstance(value, str) else math.nan
        except ValueError:
            return math.nan
        return number if math.isfinite(number) else math.nan

    def _share(self, name: str, otherwise: float | None) -> float:
        if name not in self.fields and otherwise is not None:
            return otherwise
        number = self._number(self.fields.get(name))
        if not 0 <= number <= 1:
            raise self._wrong(name, "a threshold from 0 to 1")
        return number

    def _resolution(self) -> float:
        number = self._number(self.fields.get("resolution"))
        if not 0 < number <= FARTHEST:
            raise self._wrong("resolution", "metres a pixel, above 0")
        return number

    def _origin(self) -> tuple[float, float, float]:
        value = self.fields.get("origin")
        numbers = [self._number(item) for item in value] if isinstance(value, list) else []
        if len(numbers) != 3 or not all(abs(number) <= FARTHEST for number in numbers):
            raise self._wrong(
                "origin", f"[x, y, yaw] in metres and radians, of at most {FARTHEST:,.0f}"
            )
        return numbers[0], numbers[1], numbers[2]


def _cells(fields: MapFile, path: Path) -> Cells:
    """The cells of a map, (rows, columns), the top row first: 100 occupied, 0 free, -1 unknown, or in between.

    Raises SimulatorError that names the YAML file and the image.
    """
    from PIL import Image, UnidentifiedImageError  # which takes a while to load

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
            shade, opaque = _shades(image, with_alpha=fields.mode == "trinary")
    except UnidentifiedImageError:
        raise SimulatorError(
            f"{where}: expected {kinds}, got {brief(data[:20])}; convert it"
        ) from None
    except (Image.DecompressionBombWarning, Image.DecompressionBombError) as error:
        raise SimulatorError(
            f"{where}: expected at most {MOST_PIXELS:,} pixels: {error}; scale it down"
        ) from None
    except OSError as error:
        raise SimulatorError(
            f"{where}: expected {kinds}: {error.strerror or error}; check the path and the file"
        ) from None
    except (
        ValueError,
        SyntaxError,
        IndexError,
        OverflowError,
    ) as error:  # of damaged images, and of paths that can be none
        raise SimulatorError(
            f"{where}: expected {kinds}: {error}; the file is damaged, or is none"
        ) from None
    if fields.mode == "raw":
        value = np.rint(shade * 255)
        return np.where(value <= OCCUPIED, value, UNKNOWN).astype(np.int8)
    occupancy = shade if fields.negate else 1 - shade
    if fields.mode == "trinary":
        between: NDArray[np.float64] | int = UNKNOWN
    else:
        between = np.rint(
            (occupancy - fields.free_thresh)
            / (fields.occupied_thresh - fields.free_thresh)
            * OCCUPIED
        )
    known = np.where(
        occupancy > fields.occupied_thresh,
        OCCUPIED,
        np.where(occupancy < fields.free_thresh, FREE, between),
    )
    return np.where(opaque, known, UNKNOWN).astype(np.int8)


def _shades(
    image: Image.Image, with_alpha: bool
) -> tuple[NDArray[np.float64], NDArray[np.bool_] | bool]:
    """The brightness of the pixels of an image, from 0 (black) to 1, and which of them are opaque.

    Args:
        image: In grey, colours or a palette.
        with_alpha: Whether the opacity of a pixel counts as a fourth colour, as it does in mode trinary. Then all pixels are opaque.
    """
    if image.mode == "F":
        raise ValueError("pixels that are floating-point numbers, for which map_server has no rule")
    if image.mode.startswith("I"):  # grey, 16 bits a pixel
        return np.asarray(image, dtype=np.float64) / 65535, True
    has_alpha = image.has_transparency_data
    table = np.asarray(image.convert("RGBA" if has_alpha else "RGB"))
    colours = table if has_alpha and with_alpha else table[:, :, :3]
    shade = colours.sum(axis=2, dtype=np.uint16) / (255 * colours.shape[2])
    return shade, table[:, :, 3] == 255 if has_alpha and not with_alpha else True


def _edges(
    occupied: NDArray[np.bool_], resolution: float, origin: tuple[float, float, float]
) -> NDArray[np.float64]:
    """The borders between occupied and other cells, joined into long segments, (n, 4) in metres. Row 0 of the cells is at the bottom."""
    found: list[tuple[float, float, float, float]] = []
    for flipped in (False, True):
        cells = occupied.T if flipped else occupied
        padded = np.pad(cells, ((1, 1), (0, 0)))
        border = padded[1:] != padded[:-1]
        for row in range(border.shape[0]):
            steps = np.flatnonzero(np.diff(np.concatenate([[0], border[row].astype(int), [0]])))
            for first, last in zip(steps[::2], steps[1::2], strict=True):
                found.append((row, first, row, last) if flipped else (first, row, last, row))
    x, y, yaw = origin
    ends = np.array(found, dtype=float).reshape(-1, 2) * resolution
    turn = np.array([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]])
    return np.asarray((ends @ turn if yaw else ends) + (x, y)).reshape(-1, 4)
