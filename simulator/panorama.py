"""A camera that sees all around: panoramas of a world whose walls are painted, in the light of an hour of the day.

A panorama is drawn as a laser scan is, by a ray for each column; how high the wall stands in the column follows from its distance. The picture is on a cylinder around the robot: columns are
bearings, rows are slopes.

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
from simulator.laser import meetings
from simulator.motion import Pose
from simulator.world import World, checked_segments, pose_of
from ssh_abduction.data.checks import a_flag, a_list, a_number, a_whole_number, an_instance
from ssh_abduction.data.errors import brief, is_finite, is_whole

Array = NDArray[np.float64]
# Metres above the floor: the camera, and the ceiling.
EYE, CEILING = 1.2, 2.5
# The steepest slope that is seen, up and down: 45 degrees.
STEEPEST = 1.0
# Each pixel is the mean of so many points across and down.
ACROSS, DOWN = 3, 2
FLOOR, WHITE = np.array([0.30, 0.27, 0.24]), np.array([0.62, 0.62, 0.60])
# How much light there is without the sun, as a share of that of noon, and its colour (red, green, blue); the colours of the sun at noon and where it rises.
LAMPS, LAMPLIGHT = 0.3, np.array([1.15, 1.0, 0.7])
DAYLIGHT, SUNRISE = np.array([0.95, 1.0, 1.1]), np.array([1.3, 0.95, 0.6])
# By what share a wall that faces the sun is brighter, and one that faces away is darker, at noon.
SIDEWAYS = 0.35
# With a camera that does not adapt, a wall of albedo 1 in the light of noon has this value; the mean to which a camera adapts is that of a grey wall at noon.
WHITE_VALUE, GREY_VALUE = 330.0, 120.0
# Waves that make up the pattern of a texture.
WAVES = 6


@dataclass(frozen=True)
class Light:
    """The light of an hour: its brightness and colour, (red, green, blue), and the direction in the world, in radians, from which the sun comes, with its share."""

    colour: Array = field(repr=False)
    azimuth: float = -math.pi / 2
    share: float = 0.0

    @classmethod
    def at(cls, hour: float) -> Self:
        """The light at an hour, 0 to 24: the sun rises in the east (+x) at 6, is in the south at 12, and sets in the west at 18. Lamps are always on."""
        height = max(0.0, math.sin(math.pi * (hour - 6) / 12))
        sun = height * (SUNRISE + (DAYLIGHT - SUNRISE) * height)
        return cls(
            LAMPS * LAMPLIGHT + (1 - LAMPS) * sun, -math.pi * (hour - 6) / 12, SIDEWAYS * height
        )

    def on(self, normals: Array) -> Array:
        """How bright walls are that face these directions, in radians, by how bright one is that faces neither to the sun nor away from it."""
        return 1 + self.share * np.cos(normals - self.azimuth)


@dataclass(frozen=True)
class Paint:
    """How walls are painted. Each texture is drawn at random: a colour, stripes, a skirting board, and a pattern of waves.

    seed      of all textures
    repeated  whether parallel walls have one texture, so that places look alike; else each line of walls has its own. Clutter has one texture for each shape
    """

    seed: int = 0
    repeated: bool = False

    def __post_init__(self) -> None:
        a_whole_number("paint.seed", self.seed, SimulatorError)
        a_flag("paint.repeated", self.repeated, SimulatorError)

    def keys(self, segments: Array, walls: int) -> list[tuple[Any, ...]]:
        """What names the texture of each segment, of which the first so many are walls and the others clutter, which moves."""
        checked_segments("segments", segments)
        a_whole_number("walls", walls, SimulatorError)
        ways = segments[:, 2:] - segments[:, :2]
        lengths = np.maximum(np.hypot(*ways.T), 1e-9)
        degrees = np.round(np.degrees(np.arctan2(ways[:, 1], ways[:, 0]))).astype(int) % 360
        offsets = np.round(
            100 * (ways[:, 0] * segments[:, 1] - ways[:, 1] * segments[:, 0]) / lengths
        ).astype(int)
        found: list[tuple[Any, ...]] = []
        for i, (degree, offset, length) in enumerate(
            zip(degrees.tolist(), offsets.tolist(), lengths.tolist(), strict=True)
        ):
            if i >= walls:
                found.append(("clutter", degree % 180, round(100 * length)))
            else:
                found.append(("wall", degree % 180) if self.repeated else ("wall", degree, offset))
        return found

    def texture(self, key: tuple[Any, ...]) -> Array:
        """The numbers of a texture, (13 + 6 WAVES,): see `_albedo`."""
        an_instance("key", key, tuple, SimulatorError, mend="take one of Paint.keys")
        rng = np.random.default_rng([self.seed, zlib.crc32(repr(key).encode())])
        base, stripe, skirting = (
            rng.uniform(0.25, 0.75, 3),
            rng.uniform(0.15, 0.85, 3),
            rng.uniform(0.1, 0.4, 3),
        )
        stripes = [
            rng.uniform(0.5, 1.2),
            rng.uniform(0.2, 0.5),
            rng.uniform(0, 1),
            rng.uniform(0.1, 0.3),
        ]
        waves = [
            rng.normal(0, 3.0, (2, WAVES)),
            rng.uniform(0, math.tau, (1, WAVES)),
            rng.normal(0, 0.04, (3, WAVES)),
        ]
        return np.concatenate([base, stripe, skirting, stripes, np.vstack(waves).ravel()])


@dataclass(frozen=True)
class Camera:
    """A camera that sees all around. Its defaults make panoramas of 24 rows, 180 columns and 3 colours.

    rows, columns  of a panorama; its first column is behind the robot at the left, its middle one ahead, and its first row is the highest
    paint          how the walls are painted
    hours          the hours of the day, from 0 to 24, at which a run begins and ends
    noise          standard deviation of a value, of which the largest is 255
    exposure       the share of a change of brightness that the camera makes up for, from 0 (none) to 1

    Raises SimulatorError for numbers that are out of range.
    """

    rows: int = 24
    columns: int = 180
    paint: Paint = Paint()
    hours: tuple[float, float] = (12.0, 12.0)
    noise: float = 2.0
    exposure: float = 0.5

    def __post_init__(self) -> None:
        for name in ("rows", "columns"):
            if not is_whole(getattr(self, name)) or not 1 <= getattr(self, name) <= 1000:
                raise SimulatorError(
                    f"camera.{name}: expected a whole number from 1 to 1000, got {brief(getattr(self, name))}; change it"
                )
        an_instance("camera.paint", self.paint, Paint, SimulatorError, mend="make one with Paint()")
        hours = tuple(
            a_list(
                "camera.hours",
                self.hours,
                SimulatorError,
                what="the hours at which a run begins and ends",
            )
        )
        if len(hours) != 2:
            raise SimulatorError(
                f"camera.hours: expected two, at which a run begins and ends, got {brief(self.hours)}; give both"
            )
        object.__setattr__(self, "hours", hours)
        for name, value, most in (
            ("hours", hours[0], 24.0),
            ("hours", hours[1], 24.0),
            ("noise", self.noise, 255.0),
            ("exposure", self.exposure, 1.0),
        ):
            if not is_finite(value) or not 0 <= value <= most:
                raise SimulatorError(
                    f"camera.{name}: expected a number from 0 to {most:g}, got {brief(value)}; change it"
                )

    @property
    def shape(self) -> tuple[int, int, int]:
        """Rows, columns and colours of a panorama."""
        return self.rows, self.columns, 3

    def hour(self, share: float) -> float:
        """The hour when a share of the run is over."""
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
        """The panorama from a pose, (rows, columns, 3), each value from 0 to 255.

        walls  how many segments of the world are walls, where the others are clutter; None for all of them
        """
        an_instance(
            "rng", rng, np.random.Generator, SimulatorError, mend="take numpy.random.default_rng(0)"
        )
        light = Light.at(a_number("hour", hour, SimulatorError, 0, 24))
        scene = (
            self.scene(world, pose, light, walls)
            .reshape(self.rows, DOWN, self.columns, ACROSS, 3)
            .mean(axis=(1, 3))
        )
        values = WHITE_VALUE * scene * (GREY_VALUE / (WHITE_VALUE * scene.mean())) ** self.exposure
        noisy = values + rng.normal(0, self.noise, values.shape) if self.noise else values
        pixels: NDArray[np.uint8] = np.clip(np.round(noisy), 0, 255).astype(np.uint8)
        return pixels

    def scene(self, world: World, pose: Pose, light: Light, walls: int | None = None) -> Array:
        """The light that comes from each point of the scene, (DOWN rows, ACROSS columns, 3), without exposure and noise."""
        an_instance("world", world, World, SimulatorError, mend="take World.named or World.load")
        an_instance("light", light, Light, SimulatorError, mend="take Light.at(12)")
        pose = pose_of("pose", pose)
        segments = world.segments
        bearings = math.pi - (np.arange(ACROSS * self.columns) + 0.5) * math.tau / (
            ACROSS * self.columns
        )
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
        along = (points * np.column_stack([np.cos(angles), np.sin(angles)])[hit]).sum(
            axis=1
        ) - _beginnings(segments)[hit]
        textures = np.array(
            [
                self.paint.texture(key)
                for key in self.paint.keys(segments, len(segments) if walls is None else walls)
            ]
        )
        # A wall faces the side of it on which the robot is.
        to_robot = np.angle(np.exp(1j * (pose[2] + bearings + math.pi - angles[hit]))) > 0
        faces = angles[hit] + np.where(to_robot, math.pi / 2, -math.pi / 2)
        wall = _albedo(textures[hit], along, height) * light.on(faces)[None, :, None]
        return (
            np.where(
                (height < 0)[..., None], FLOOR, np.where((height > CEILING)[..., None], WHITE, wall)
            )
            * light.colour
        )


def _beginnings(segments: Array) -> Array:
    """Where the line of each segment begins, in metres along its direction, so that a texture goes on past a gap in a wall."""
    ways = segments[:, 2:] - segments[:, :2]
    ways = ways / np.maximum(np.hypot(*ways.T), 1e-9)[:, None]
    degrees = np.round(np.degrees(np.arctan2(ways[:, 1], ways[:, 0]))) % 360
    offsets = np.round(100 * (ways[:, 0] * segments[:, 1] - ways[:, 1] * segments[:, 0]))
    lines = np.unique(np.column_stack([degrees, offsets]), axis=0, return_inverse=True)[1].ravel()
    starts = (segments[:, :2] * ways).sum(axis=1)
    first = np.full(lines.max() + 1, np.inf)
    np.minimum.at(first, lines, starts)
    found: Array = first[lines]
    return found


def _albedo(textures: Array, along: Array, height: Array) -> Array:
    """The share of light that points of walls give back, (r, c, 3).

    textures  (c, 13 + 6 WAVES), for each column that of its wall
    along     (c,) metres along the wall
    height    (r, c) metres above the floor
    """
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
