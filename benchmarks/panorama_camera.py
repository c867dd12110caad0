"""A panoramic camera in a world with painted walls, in the light of any hour of the day.

A panorama is computed like a laser scan, with rays in each column. The distance of the wall in a
column determines at which height each pixel meets the wall. The image is a cylinder around the
robot: columns are bearings, rows are slopes.

>>> from simulator.world import World
>>> world = World.named("notched-rectangle")
>>> Camera().shot(world, world.start, np.random.default_rng(0)).shape
(24, 180, 3)
"""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from simulator.errors import SimulatorError
from simulator.robot import meetings
from simulator.world import Array, World, checked_segments, pose_of
from ssh_abduction.data.checks import a_flag, a_list, a_number, a_whole_number, an_instance
from ssh_abduction.data.errors import brief
from ssh_abduction.data.odometry import Pose

# Heights of the camera and of the ceiling, in metres.
EYE, CEILING = 1.2, 2.5
# Steepest visible slope, up and down: 45 degrees.
STEEPEST = 1.0
# Each pixel is the mean of this many points across and down.
ACROSS, DOWN = 3, 2
FLOOR, WHITE = np.array([0.30, 0.27, 0.24]), np.array([0.62, 0.62, 0.60])
# Share of artificial light relative to noon, and its colour (red, green, blue).
LAMPS, LAMPLIGHT = 0.3, np.array([1.15, 1.0, 0.7])
# Colours of the sun at noon, and at sunrise.
DAYLIGHT, SUNRISE = np.array([0.95, 1.0, 1.1]), np.array([1.3, 0.95, 0.6])
# Share by which a wall is brighter facing the sun at noon, and darker facing away.
SIDEWAYS = 0.35
# Pixel value of a wall of albedo 1 at noon, if the camera does not adapt. Mean pixel value to which
# a camera adapts: that of a grey wall at noon.
WHITE_VALUE, GREY_VALUE = 330.0, 120.0
# Number of waves in the pattern of a texture.
WAVES = 6


@dataclass(frozen=True)
class Light:
    """The light at an hour of the day.

    Attributes:
        colour: Brightness of red, green and blue, (3,).
        azimuth: Direction of the sun in the world, in radians.
        share: Share by which a wall that faces the sun is brighter, and one that faces away darker.
    """

    colour: Array = field(repr=False)
    azimuth: float = -math.pi / 2
    share: float = 0.0

    @classmethod
    def at(cls, hour: float) -> Self:
        """Make the light at an hour, 0 to 24. Lamps are always on.

        The sun rises in the east (+x) at 6, is in the south at 12, and sets in the west at 18.
        """
        height = max(0.0, math.sin(math.pi * (hour - 6) / 12))
        sun = height * (SUNRISE + (DAYLIGHT - SUNRISE) * height)
        return cls(
            LAMPS * LAMPLIGHT + (1 - LAMPS) * sun, -math.pi * (hour - 6) / 12, SIDEWAYS * height
        )

    def on(self, normals: Array) -> Array:
        """Compute the relative brightness of walls from the directions that they face, in radians.

        It is 1 for a wall that faces at a right angle to the direction of the sun.
        """
        return 1 + self.share * np.cos(normals - self.azimuth)


@dataclass(frozen=True)
class Paint:
    """Paint of the walls.

    Each texture is random: a colour, stripes, a skirting board, and a pattern of waves. Clutter has
    one texture for each shape.

    Attributes:
        seed: Seed of all textures.
        repeated: Whether parallel walls share a texture, so that places look alike. Otherwise, only
            walls on one line share a texture.
    """

    seed: int = 0
    repeated: bool = False

    def __post_init__(self) -> None:
        a_whole_number("paint.seed", self.seed, SimulatorError)
        a_flag("paint.repeated", self.repeated, SimulatorError)

    def keys(self, segments: Array, walls: int) -> list[tuple[Any, ...]]:
        """Name the texture of each segment.

        Args:
            segments: (n, 4) metres, walls before clutter.
            walls: Number of segments that are walls. The others are clutter, which moves.

        Returns:
            A key for `texture` for each segment. Segments with equal keys share a texture.
        """
        checked_segments("segments", segments)
        a_whole_number("walls", walls, SimulatorError)
        _, lengths, lines = _lines(segments)
        sizes = zip(lengths.tolist(), lines.tolist(), strict=True)
        found: list[tuple[Any, ...]] = []
        for i, (length, (degree, offset)) in enumerate(sizes):
            # Clutter moves, so its texture must not depend on its position.
            if i >= walls:
                found.append(("clutter", degree % 180, round(100 * length)))
            else:
                found.append(("wall", degree % 180) if self.repeated else ("wall", degree, offset))
        return found

    def texture(self, key: tuple[Any, ...]) -> Array:
        """Draw the random numbers of a texture.

        Args:
            key: Name of the texture, from `keys`.

        Returns:
            (13 + 6 WAVES,): three colours, four numbers for stripes and skirting board, and waves.
        """
        an_instance("key", key, tuple, SimulatorError, mend="take one of Paint.keys")
        # A checksum of the key as seed gives the same texture in each process.
        rng = np.random.default_rng([self.seed, zlib.crc32(repr(key).encode())])
        # Three colours; then period, share and phase of stripes, and height of the skirting board.
        colours = [rng.uniform(*span, 3) for span in ((0.25, 0.75), (0.15, 0.85), (0.1, 0.4))]
        stripes = [rng.uniform(*span) for span in ((0.5, 1.2), (0.2, 0.5), (0, 1), (0.1, 0.3))]
        waves = [
            rng.normal(0, 3.0, (2, WAVES)),
            rng.uniform(0, math.tau, (1, WAVES)),
            rng.normal(0, 0.04, (3, WAVES)),
        ]
        return np.concatenate([*colours, stripes, np.vstack(waves).ravel()])


@dataclass(frozen=True)
class Camera:
    """A panoramic camera. The defaults give 24 rows, 180 columns and 3 colours.

    Attributes:
        rows: Number of rows of a panorama.
        columns: Number of columns of a panorama. The first column is behind the robot on the left,
            the middle one ahead.
        paint: The paint, which gives each wall a texture.
        hours: Hours of the day, from 0 to 24, at which a drive begins and ends.
        noise: Standard deviation of the noise of a pixel; pixels have values from 0 to 255.
        exposure: How much of a change of brightness the camera compensates, from 0 (nothing) to 1
            (all).

    Raises:
        SimulatorError: A number is out of range.
    """

    rows: int = 24
    columns: int = 180
    paint: Paint = Paint()
    hours: tuple[float, float] = (12.0, 12.0)
    noise: float = 2.0
    exposure: float = 0.5

    def __post_init__(self) -> None:
        for name in ("rows", "columns"):
            a_whole_number(f"camera.{name}", getattr(self, name), SimulatorError, 1, 1000)
        an_instance("camera.paint", self.paint, Paint, SimulatorError, mend="make one with Paint()")
        what = "the hours at which a run begins and ends"
        hours = tuple(a_list("camera.hours", self.hours, SimulatorError, what=what))
        if len(hours) != 2:
            raise SimulatorError(
                "camera.hours: expected two, at which a run begins and ends, got "
                f"{brief(self.hours)}; give both"
            )
        # The class is frozen; hours may have come as a list.
        object.__setattr__(self, "hours", hours)
        for name, value, most in (
            ("hours", hours[0], 24.0),
            ("hours", hours[1], 24.0),
            ("noise", self.noise, 255.0),
            ("exposure", self.exposure, 1.0),
        ):
            a_number(f"camera.{name}", value, SimulatorError, 0, most)

    @property
    def shape(self) -> tuple[int, int, int]:
        """The numbers of rows, columns and colours of a panorama."""
        return self.rows, self.columns, 3

    def hour(self, share: float) -> float:
        """Compute the hour of the day when a share of the drive, from 0 to 1, is over."""
        a_number("share", share, SimulatorError, 0, 1, what="a share")
        return self.hours[0] + share * (self.hours[1] - self.hours[0])

    def shot(
        self,
        world: World,
        pose: Pose,
        rng: np.random.Generator,
        hour: float = 12.0,
        walls: int | None = None,
    ) -> NDArray[np.uint8]:
        """Take a panorama.

        Args:
            world: The world whose walls the camera sees.
            pose: Pose of the robot: x and y in metres, heading in radians.
            rng: Source of noise.
            hour: Hour of the day, from 0 to 24.
            walls: Number of segments of the world that are walls. Those after them are clutter.
                None means that all are walls.

        Returns:
            (rows, columns, 3) pixels with values from 0 to 255.
        """
        an_instance(
            "rng", rng, np.random.Generator, SimulatorError, mend="take numpy.random.default_rng(0)"
        )
        light = Light.at(a_number("hour", hour, SimulatorError, 0, 24))
        points = self.scene(world, pose, light, walls)
        scene = points.reshape(self.rows, DOWN, self.columns, ACROSS, 3).mean(axis=(1, 3))
        values = WHITE_VALUE * scene * (GREY_VALUE / (WHITE_VALUE * scene.mean())) ** self.exposure
        noisy = values + rng.normal(0, self.noise, values.shape) if self.noise else values
        return np.asarray(np.clip(np.round(noisy), 0, 255).astype(np.uint8))

    def scene(self, world: World, pose: Pose, light: Light, walls: int | None = None) -> Array:
        """Compute the light that reaches the camera, before exposure and noise.

        Arguments are those of `shot`.

        Returns:
            (DOWN * rows, ACROSS * columns, 3) brightness; a pixel is the mean of DOWN x ACROSS
            points.
        """
        an_instance("world", world, World, SimulatorError, mend="take World.named or World.load")
        an_instance("light", light, Light, SimulatorError, mend="take Light.at(12)")
        pose = pose_of("pose", pose)
        segments = world.segments
        columns = ACROSS * self.columns
        bearings = math.pi - (np.arange(columns) + 0.5) * math.tau / columns
        far = meetings(segments, np.array([pose]), bearings)[0]
        hit = far.argmin(axis=1)
        distance = np.minimum(far[np.arange(len(hit)), hit], 1e6)
        slopes = STEEPEST * (1 - 2 * (np.arange(DOWN * self.rows) + 0.5) / (DOWN * self.rows))
        height = EYE + slopes[:, None] * distance
        points = np.array(pose[:2]) + distance[:, None] * np.column_stack(
            [np.cos(pose[2] + bearings), np.sin(pose[2] + bearings)]
        )
        ways = segments[:, 2:] - segments[:, :2]
        angles = np.arctan2(ways[:, 1], ways[:, 0])
        directions = np.column_stack([np.cos(angles), np.sin(angles)])
        along = (points * directions[hit]).sum(axis=1) - _beginnings(segments)[hit]
        keys = self.paint.keys(segments, len(segments) if walls is None else walls)
        textures = np.array([self.paint.texture(key) for key in keys])
        # The visible face of a wall is on the side of the robot.
        to_robot = np.angle(np.exp(1j * (pose[2] + bearings + math.pi - angles[hit]))) > 0
        faces = angles[hit] + np.where(to_robot, math.pi / 2, -math.pi / 2)
        wall = _albedo(textures[hit], along, height) * light.on(faces)[None, :, None]
        above_floor = np.where((height > CEILING)[..., None], WHITE, wall)
        return np.where((height < 0)[..., None], FLOOR, above_floor) * light.colour


def _lines(segments: Array) -> tuple[Array, Array, NDArray[np.intp]]:
    """The unit vectors, (n, 2), and lengths, (n,), of segments, and the lines that they are on.

    A line, (n, 2), is its direction in degrees, and its distance from the origin in centimetres.
    """
    ways = segments[:, 2:] - segments[:, :2]
    lengths = np.maximum(np.hypot(*ways.T), 1e-9)
    degrees = np.round(np.degrees(np.arctan2(ways[:, 1], ways[:, 0]))) % 360
    offsets = 100 * (ways[:, 0] * segments[:, 1] - ways[:, 1] * segments[:, 0]) / lengths
    lines = np.column_stack([degrees, np.round(offsets)]).astype(np.intp)
    return ways / lengths[:, None], lengths, lines


def _beginnings(segments: Array) -> Array:
    """The position at which textures of segments begin, in metres along their direction, (n,).

    Segments on one line have the same position, so that a texture continues behind a gap in a wall.
    """
    ways, _, lines = _lines(segments)
    numbers = np.unique(lines, axis=0, return_inverse=True)[1].ravel()
    first = np.full(numbers.max() + 1, np.inf)
    np.minimum.at(first, numbers, (segments[:, :2] * ways).sum(axis=1))
    return np.asarray(first[numbers])


def _albedo(textures: Array, along: Array, height: Array) -> Array:
    """The share of light that walls reflect at each pixel, (r, c, 3). A column has one wall."""
    base, stripe, skirting, stripes, waves = np.split(textures, [3, 6, 9, 13], axis=1)
    period, share, phase, board = stripes.T
    striped = ((along / period + phase) % 1 < share)[None, :, None] & (height < 0.75 * CEILING)[
        ..., None
    ]
    colour = np.where(striped, stripe[None], base[None])
    across, up, begins, *by_colour = waves.reshape(-1, 6, WAVES).transpose(1, 0, 2)
    swing = np.sin(across * along[:, None] + up * np.clip(height, 0, CEILING)[..., None] + begins)
    colour = colour + np.stack([(swing * amplitude).sum(axis=2) for amplitude in by_colour], axis=2)
    return np.clip(np.where((height < board)[..., None], skirting[None], colour), 0.02, 0.98)
