"""Drives through a building with a repeated wing, whose false closures agree with each other.

>>> drive = wings(0)
>>> len(drive.trace.closures), len(drive.false)
(16, 8)

A corridor (the *spine*) leads to two wings with equal rooms. So local maps in one wing match those
at the same place in the other wing. Each such match is a false closure, and all of them say that
the two wings are one. The robot drives through the first wing, the second, and the first again. Its
odometer is weak: from one end of a false closure to the other, dead reckoning is off by about half
of the distance of the wings.

Where false closures match, views and stars are equal, too. A view has the look of a place and the
ways out of it, a star only the ways.
"""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import networkx as nx
import numpy as np
from instances import CELL, HEADINGS, TURNS, Cell, displaced, doors_of
from truth import Known

from ssh_abduction import Trace
from ssh_abduction.data import Closure, Odometry
from ssh_abduction.data.odometry import Pose, displacement_between

# The columns and rows of a wing, and the least and the greatest number of columns from one wing to
# the other.
COLUMNS, ROWS = 3, 2
LEAST_SHIFT, MOST_SHIFT = 3, 4
# A place looks like one of so many kinds of places. Its view also shows the ways out of it.
LOOKS = 6
# The places that the robot is sent to in each wing, before it is sent to the other wing.
TARGETS, VISITS = 4, 3
# The number of true closures. The robot made at least this many steps between their ends.
TRUE, APART = 8, 6
# The standard deviations of a closure, in metres and radians: those of closures of real logs.
NOISE = (0.1, 0.1, math.radians(1))
# The noise of the odometer. It has no systematic error, as the peers know none.
WEAK = Odometry(
    along=0.1,
    across=0.05,
    heading=0.02,
    turning=0.05,
    position=0.1,
    angle=0.02,
    scale=0.0,
    bend=0.0,
)


@dataclass(frozen=True)
class WingDrive:
    """A drive with true and false closures.

    Attributes:
        known: The trace, and the true dstate and place of each step.
        poses: The true pose of each step, in metres and radians.
        false: The indices of the false closures of the trace.
        shift: Metres from one wing to the other.
    """

    known: Known
    poses: tuple[Pose, ...]
    false: frozenset[int]
    shift: float

    @property
    def trace(self) -> Trace:
        return self.known.trace

    def wing_of(self, step: int) -> int:
        """Return in which wing the robot is at a step: 1 or 2, or 0 on the spine."""
        x, y, _ = self.poses[step]
        return (1 + (x >= self.shift)) * (y > 0)


def wings(seed: int, ratio: float = 1.0, odometry: Odometry = WEAK) -> WingDrive:
    """Make a drive through a building with a repeated wing.

    Args:
        seed: Seed of the building, the drive and the errors.
        ratio: False closures for each true one.
        odometry: Noise of the odometer.
    """
    chance = random.Random(seed)
    shift = chance.randint(LEAST_SHIFT, MOST_SHIFT)
    building, looks = _building(chance, shift)
    cells = _drive(building, chance, shift)
    states, actions = _states(cells, chance.randrange(4))
    stars = [_openings(building, *state) for state in states]
    views = [
        f"{looks[x, y]}-{''.join(map(str, star))}"
        for (x, y, _), star in zip(states, stars, strict=True)
    ]
    poses: list[Pose] = [(CELL * x, CELL * y, math.pi / 2 * (1 - h)) for x, y, h in states]
    name = f"repeated wing, {seed}"
    seen = Trace.from_steps(views, actions, stars=stars, name=name)
    trace = displaced(seen, poses, odometry, seed)
    closures, false = _closures(states, poses, shift, ratio, seed)
    known = Known(
        name,
        replace(trace, closures=closures),
        tuple(states),
        tuple((x, y) for x, y, _ in states),
    )
    return WingDrive(known, tuple(poses), false, CELL * shift)


def _building(chance: random.Random, shift: int) -> tuple[nx.Graph, dict[Cell, int]]:
    """Draw the ways between neighbouring cells, and the look of each cell.

    Row 0 is the spine. The wings are above it, and each has one door to it.
    """
    building = nx.Graph(pairwise((x, 0) for x in range(COLUMNS + shift)))
    door, looks = chance.randrange(COLUMNS), {}
    ways = doors_of(COLUMNS, ROWS, chance, loops=0.5)
    kinds = {(x, y): chance.randrange(LOOKS) for x in range(COLUMNS) for y in range(ROWS)}
    for begin in (0, shift):
        building.add_edge((begin + door, 0), (begin + door, 1))
        building.add_edges_from(
            ((begin + ax, ay + 1), (begin + bx, by + 1)) for (ax, ay), (bx, by) in ways
        )
        looks |= {(begin + x, y + 1): kind for (x, y), kind in kinds.items()}
    looks |= {cell: chance.randrange(LOOKS) for cell in building if cell[1] == 0}
    return building, looks


def _drive(building: nx.Graph, chance: random.Random, shift: int) -> list[Cell]:
    """Send the robot to random places of one wing, then of the other wing, in turn.

    Returns:
        The cells that the robot passes.
    """
    wing = [(x, y + 1) for x in range(COLUMNS) for y in range(ROWS)]
    cells = [chance.choice(wing)]
    for visit in range(VISITS):
        for x, y in chance.sample(wing, TARGETS):
            there = (x + shift * (visit % 2), y)
            # Of several shortest ways, take any.
            way = chance.choice([*nx.all_shortest_paths(building, cells[-1], there)])
            cells += way[1:]
    return cells


def _states(cells: Sequence[Cell], heading: int) -> tuple[list[tuple[int, int, int]], list[str]]:
    """Turn and travel along cells. Return the cell and heading of each step, and the actions."""
    states, actions = [(*cells[0], heading)], []
    names = {turn: name for name, turn in TURNS.items()}
    for (x, y), there in pairwise(cells):
        wanted = HEADINGS.index((there[0] - x, there[1] - y))
        if turn := (wanted - heading) % 4:
            heading = wanted
            states.append((x, y, heading))
            actions.append(names[turn])
        states.append((*there, heading))
        actions.append("travel")
    return states, actions


def _openings(building: nx.Graph, x: int, y: int, heading: int) -> list[int]:
    """Which ways out of a cell are open: ahead, right, back and left of the robot."""
    ahead = [HEADINGS[(heading + turn) % 4] for turn in range(4)]
    return [int(building.has_edge((x, y), (x + dx, y + dy))) for dx, dy in ahead]


def _closures(
    states: Sequence[tuple[int, int, int]],
    poses: Sequence[Pose],
    shift: int,
    ratio: float,
    seed: int,
) -> tuple[tuple[Closure, ...], frozenset[int]]:
    """Draw closures of two arrivals at one place, and of two at the same place of both wings.

    Returns:
        The closures, and the indices of the false ones.
    """
    rng = np.random.default_rng([seed, 1])
    arrivals = [t for t, (a, b) in enumerate(pairwise(states), 1) if a[:2] != b[:2]]
    true, false = [], []
    for last in arrivals:
        for first in (t for t in arrivals if t + APART <= last):
            (ax, ay, _), (bx, by, _) = states[first], states[last]
            if ay == by and ax == bx:
                true.append((first, last))
            elif ay == by > 0 and abs(bx - ax) == shift:
                false.append((first, last))
    found = []
    for pairs, count in ((true, TRUE), (false, round(ratio * TRUE))):
        chosen = rng.choice(len(pairs), min(count, len(pairs)), replace=False)
        found += [(pairs[i], pairs is false) for i in chosen]
    found.sort()
    variances = np.diag(np.square(NOISE))
    closures = []
    for (first, last), aliased in found:
        x, y, heading = poses[last]
        # A false match sees the robot at the same place of the earlier wing.
        x -= aliased * math.copysign(CELL * shift, x - poses[first][0])
        dx, dy, turned = displacement_between(poses[first], (x, y, heading))
        error = rng.normal(size=3) * NOISE
        moved = (dx + error[0], dy + error[1], math.remainder(turned + error[2], math.tau))
        closures.append(Closure(first, last, moved, variances))
    return tuple(closures), frozenset(i for i, (_, aliased) in enumerate(found) if aliased)
