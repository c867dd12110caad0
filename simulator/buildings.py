"""Makes a world with walls from a floor plan, in which a robot with a body can drive.

A plan draws each room as a polygon and each door as a point on its outline. So the walls are the
outlines of all rooms. A door is an opening of DOOR metres in the outlines of both of its rooms. If
a corner would narrow the opening, it is moved along the wall. If the outlines of the two rooms are
apart, because the wall is thick, the sides of the opening (its jambs) are walls, too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from simulator.errors import SimulatorError
from simulator.plans import Door, Plan, Room
from simulator.world import World, distances_to

Array = NDArray[np.float64]
# Width of a door, and its smallest distance from the corners of its rooms, in metres.
DOOR, OFF = 1.0, 0.1
# Walls within this many metres before and behind a door are removed, since they would close it.
DEPTH = 0.25


@dataclass(frozen=True)
class Opening:
    """A door as an opening in a wall."""

    middle: tuple[float, float]  # (x, y) in metres
    along: float  # direction of the wall in radians
    width: float  # width of the opening in metres
    depth: float  # thickness of the wall: metres from the outline of one room to that of the other

    def frame(self, points: Array) -> Array:
        """Convert points, (n, 2) in metres, to metres along and across the wall, from the middle.

        Across counts to the left.
        """
        cos, sin = math.cos(self.along), math.sin(self.along)
        off = points - np.array(self.middle)
        return np.column_stack(
            [cos * off[:, 0] + sin * off[:, 1], cos * off[:, 1] - sin * off[:, 0]]
        )

    def point(self, along: float, across: float) -> tuple[float, float]:
        """Compute the point (x, y) at a distance in metres along the wall, and across it.

        Along counts from the middle, and across to the left of the direction of the wall.
        """
        cos, sin = math.cos(self.along), math.sin(self.along)
        x, y = self.middle
        return x + cos * along - sin * across, y + sin * along + cos * across

    @property
    def threshold(self) -> Array:
        """The segment across the opening, from side to side: (1, 4), metres."""
        return np.array([[*self.point(-self.width / 2, 0.0), *self.point(self.width / 2, 0.0)]])


@dataclass(frozen=True)
class Building:
    """A plan with walls and openings."""

    plan: Plan
    segments: Array = field(repr=False)  # (n, 4) walls in metres
    # The opening of each door, in the order of the plan.
    openings: tuple[Opening, ...] = field(repr=False)

    @classmethod
    def of(cls, plan: Plan) -> Building:
        """Make the building of a plan. Raises SimulatorError if a room has no outline."""
        for number, room in enumerate(plan.rooms):
            if (corners := len(set(room.polygon))) < 3:
                raise SimulatorError(
                    f"{plan.name}: room {number}: expected a bounding_polygon of three points "
                    f"or more, got {corners}; draw its outline"
                )
        walls = np.vstack([_outline(room) for room in plan.rooms])
        openings = tuple(_opening(plan, door) for door in plan.doors)
        for opening in openings:
            walls = _cut(walls, opening)
        return cls(plan, np.vstack([walls, *[_jambs(opening) for opening in openings]]), openings)

    def world(self) -> World:
        """Make a world with the walls of the building."""
        return World(self.plan.name, self.segments, angles="any")


def _outline(room: Room) -> Array:
    """The walls of a room: (n, 4), metres."""
    corners = np.array(room.polygon)
    walls = np.hstack([corners, np.roll(corners, -1, axis=0)])
    return np.asarray(walls[np.hypot(*(walls[:, 2:] - walls[:, :2]).T) > 1e-6])


def _opening(plan: Plan, door: Door) -> Opening:
    """Make the opening of a door in the nearest walls of its two rooms."""
    outlines = [_outline(plan.rooms[room]) for room in door.rooms]
    walls = [walls[int(distances_to(walls, door.position).argmin())] for walls in outlines]
    longest = max(walls, key=lambda wall: float(np.hypot(*(wall[2:] - wall[:2]))))
    way = longest[2:] - longest[:2]
    flat = Opening(door.position, math.atan2(way[1], way[0]), DOOR, 0.0)
    # Shift the door along the wall into the span that both rooms share, and narrow it if necessary.
    spans = [_span(flat, walls) for walls in outlines]
    low, high = max(low for low, _ in spans) + OFF, min(high for _, high in spans) - OFF
    width = min(DOOR, high - low) if high > low else DOOR
    shift = float(np.clip(0.0, low + width / 2, high - width / 2)) if high > low else 0.0
    one, other = (_across(flat, wall, shift) for wall in walls)
    return Opening(flat.point(shift, (one + other) / 2), flat.along, width, abs(one - other))


def _span(flat: Opening, walls: Array) -> tuple[float, float]:
    """Find where a straight wall with a door begins and ends, in metres from the door."""
    # (n, 2 ends, along and across)
    ends = np.stack([flat.frame(walls[:, :2]), flat.frame(walls[:, 2:])], axis=1)
    way = ends[:, 1] - ends[:, 0]
    level = (np.abs(ends[:, :, 1]) < DEPTH).all(1) & (np.abs(way[:, 1]) < np.abs(way[:, 0]))
    stretches: list[tuple[float, float]] = []
    for wall in sorted((float(min(wall)), float(max(wall))) for wall in ends[level, :, 0]):
        if stretches and wall[0] <= stretches[-1][1] + OFF:
            stretches[-1] = stretches[-1][0], max(stretches[-1][1], wall[1])
        else:
            stretches.append(wall)
    return min(stretches, key=lambda stretch: max(stretch[0], -stretch[1]), default=(0.0, 0.0))


def _across(flat: Opening, wall: Array, along: float) -> float:
    """Measure how far left of a door's axis a wall is, `along` metres from the door's middle."""
    ends = flat.frame(wall.reshape(2, 2))
    return float(np.interp(along, *ends[np.argsort(ends[:, 0])].T))


def _cut(walls: Array, opening: Opening) -> Array:
    """Remove the parts of walls within the rectangle of an opening (Liang and Barsky)."""
    starts, ends = opening.frame(walls[:, :2]), opening.frame(walls[:, 2:])
    half = np.array([opening.width / 2, opening.depth / 2 + DEPTH])
    way = ends - starts
    # For each axis: the shares of a wall's length at which it enters and leaves the rectangle.
    with np.errstate(divide="ignore", invalid="ignore"):
        one, other = (-half - starts) / way, (half - starts) / way
    still = way == 0
    inside = np.abs(starts) <= half
    enter = (
        np.where(still, np.where(inside, -np.inf, np.inf), np.minimum(one, other)).max(1).clip(0, 1)
    )
    leave = (
        np.where(still, np.where(inside, np.inf, -np.inf), np.maximum(one, other)).min(1).clip(0, 1)
    )
    hit = enter < leave
    way = walls[:, 2:] - walls[:, :2]
    before = np.hstack([walls[:, :2], walls[:, :2] + enter[:, None] * way])[hit & (enter > 0)]
    after = np.hstack([walls[:, :2] + leave[:, None] * way, walls[:, 2:]])[hit & (leave < 1)]
    return np.vstack([walls[~hit], before, after])


def _jambs(opening: Opening) -> Array:
    """The two sides of an opening in a thick wall, (2, 4); none, (0, 4), in a thin wall."""
    if opening.depth < 0.02:
        return np.empty((0, 4))
    half, deep = opening.width / 2, opening.depth / 2
    return np.array(
        [[*opening.point(side, -deep), *opening.point(side, deep)] for side in (-half, half)]
    )
