"""Traces to measure on: random walks in grid mazes and in random Moore machines. The same seed gives the same trace.

>>> walk = maze(5, 5, steps=1600, seed=0)
>>> len(walk.trace), len(set(walk.truth))
(1601, 100)
"""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from simulator.motion import Pose, between, reported
from ssh_abduction import Trace
from ssh_abduction.data import Odometry

HEADINGS = ((0, 1), (1, 0), (0, -1), (-1, 0))  # north, east, south, west
TURNS = {"right": 1, "around": 2, "left": 3}
# Metres that the cells of a maze are apart.
CELL = 10.0


@dataclass(frozen=True)
class Walk:
    """A trace, and the true state at each of its steps."""

    trace: Trace
    truth: tuple[object, ...]


def displaced(
    trace: Trace,
    poses: Sequence[Pose],
    odometry: Odometry,
    seed: int,
    *,
    scale: float = 0.0,
    bend: float = 0.0,
) -> Trace:
    """A trace with the displacements between the true poses of its steps, as an odometry reports them; see simulator.motion.reported."""
    rng = np.random.default_rng(seed)
    moved = [
        reported(between(a, b), odometry, rng, scale=scale, bend=bend) for a, b in pairwise(poses)
    ]
    steps = (
        replace(step, displacement=displacement)
        for step, displacement in zip(trace.steps, [None, *moved], strict=True)
    )
    return replace(trace, steps=tuple(steps), odometry=odometry)


Cell = tuple[int, int]


def doors_of(
    width: int, height: int, chance: random.Random, loops: float = 0.1
) -> set[tuple[Cell, Cell]]:
    """The corridors of a maze, from cell to cell, each in both directions: a random spanning tree of the grid, and each further wall open by chance."""
    walls = [
        ((x, y), (x + dx, y + dy))
        for x in range(width)
        for y in range(height)
        for dx, dy in ((1, 0), (0, 1))
    ]
    walls = [(a, b) for a, b in walls if b[0] < width and b[1] < height]
    chance.shuffle(walls)
    root = {(x, y): (x, y) for x in range(width) for y in range(height)}

    def found(cell: Cell) -> Cell:
        while root[cell] != cell:
            cell = root[cell]
        return cell

    doors: set[tuple[Cell, Cell]] = set()
    for a, b in walls:
        if found(a) != found(b) or chance.random() < loops:
            root[found(a)] = found(b)
            doors |= {(a, b), (b, a)}
    return doors


def maze(
    width: int,
    height: int,
    *,
    steps: int,
    seed: int,
    loops: float = 0.1,
    stars: bool = False,
    follow: bool = False,
    odometry: Odometry | None = None,
    cell: float = CELL,
    scale: float = 0.0,
    bend: float = 0.0,
) -> Walk:
    """A random walk of so many actions in a maze of corridors: a random spanning tree of the grid, and each further wall open by chance.

    A state is a cell and a heading, a view the openings ahead, right, back and left. Where the way ahead is open the robot
    travels half of the time; else it turns. It turns around only where it cannot travel. One that follows corridors travels in four of six cases
    where it can; else it turns to where the way is open to its right or left, and around only in a dead end.

    odometry     if given, the trace has displacements with this noise; the walk is the same
    cell         metres from one cell to the next
    scale, bend  errors of the odometry that repeat, as a share and in radians a metre
    """
    chance = random.Random(seed)
    doors = doors_of(width, height, chance, loops)

    def ahead(x: int, y: int, heading: int) -> tuple[int, int]:
        return x + HEADINGS[heading % 4][0], y + HEADINGS[heading % 4][1]

    x, y = chance.randrange(width), chance.randrange(height)
    heading = chance.randrange(4)
    seen: list[list[int]] = []
    truth: list[object] = []
    poses: list[Pose] = []
    done: list[str] = []
    for step in range(steps + 1):
        seen.append([int(((x, y), ahead(x, y, heading + k)) in doors) for k in range(4)])
        truth.append((x, y, heading))
        poses.append((cell * x, cell * y, math.pi / 2 * (1 - heading)))
        if step == steps:
            break
        ahead_open, right_open, _, left_open = seen[-1]
        if not follow:
            action = chance.choice(
                ["travel", "travel", "right", "left"] if ahead_open else ["right", "left", "around"]
            )
        elif ahead_open:
            action = chance.choice(["travel"] * 4 + ["right", "left"])
        else:
            action = chance.choice(["right"] * right_open + ["left"] * left_open or ["around"])
        if action == "travel":
            x, y = ahead(x, y, heading)
        else:
            heading = (heading + TURNS[action]) % 4
        done.append(action)
    views = ["".join(map(str, openings)) for openings in seen]
    trace = Trace.from_steps(
        views, done, stars=seen if stars else None, name=f"maze {width} x {height}, seed {seed}"
    )
    if odometry is not None:
        trace = displaced(trace, poses, odometry, seed, scale=scale, bend=bend)
    return Walk(trace, tuple(truth))


def moore(states: int, views: int, *, steps: int, seed: int, actions: int = 2) -> Walk:
    """A random walk in a random Moore machine: links and views drawn evenly, save that each view is there and a random tour of all states is possible."""
    chance = random.Random(seed)
    shown = [*range(views), *(chance.randrange(views) for _ in range(states - views))]
    chance.shuffle(shown)
    follow = [[chance.randrange(states) for _ in range(actions)] for _ in range(states)]
    tour = chance.sample(range(states), states)
    for here, there in zip(tour, [*tour[1:], tour[0]], strict=True):
        follow[here][chance.randrange(actions)] = there
    state, truth, done = 0, [0], []
    for _ in range(steps):
        action = chance.randrange(actions)
        state = follow[state][action]
        done.append({"name": f"a{action}"})
        truth.append(state)
    return Walk(
        Trace.from_steps(
            [f"v{shown[s]}" for s in truth], done, name=f"moore {states}/{views}, seed {seed}"
        ),
        tuple(truth),
    )


def faulty_machine(
    states: int,
    views: int,
    *,
    steps: int,
    seed: int,
    wrong: int = 0,
    jumps: int = 0,
    actions: int = 3,
) -> tuple[Walk, tuple[int, ...], tuple[int, ...]]:
    """A random walk in a random Moore machine, at whose steps some views are wrong; and some actions end anywhere else, and what follows goes on from there.

    Returns the walk, the steps with a wrong view, and those whose action jumped. None of these are the first or last five steps.
    """
    walk = moore(states, views, steps=steps, seed=seed, actions=actions)
    chance = random.Random(f"faults {seed}")
    links = {
        (s, a.name): x for (s, x), a in zip(pairwise(walk.truth), walk.trace.actions, strict=True)
    }
    shown = dict(zip(walk.truth, walk.trace.views, strict=True))
    jumped = sorted(chance.sample(range(5, steps - 5), jumps))
    truth = [walk.truth[0]]
    for t, action in enumerate(walk.trace.actions):
        there = links.get((truth[-1], action.name))
        if t in jumped or there is None:  # what the walk never tried leads nowhere new
            there = chance.choice([s for s in shown if s != there])
            links.setdefault((truth[-1], action.name), there)
        truth.append(there)
    seen = [shown[s] for s in truth]
    misread = sorted(chance.sample(range(5, steps - 5), wrong))
    for t in misread:
        seen[t] = chance.choice(
            [view for view in sorted(set(shown.values()), key=str) if view != seen[t]]
        )
    trace = Trace.from_steps(
        seen, list(walk.trace.actions), name=f"{walk.trace.name}, {wrong} wrong, {jumps} jumps"
    )
    return Walk(trace, tuple(truth)), tuple(misread), tuple(jumped)


def rectangle(circuits: int) -> Walk:
    """The notched rectangle of Kuipers & Beeson (2002), so many times round: eight states, four views."""
    steps = 8 * circuits
    trace = Trace.from_steps(
        [f"v{i % 4}" for i in range(steps + 1)], [("right", "travel")[i % 2] for i in range(steps)]
    )
    return Walk(trace, tuple(i % 8 for i in range(steps + 1)))


def circuits(width: int, height: int, *, rounds: int, seed: int, views: int = 4) -> Walk:
    """So many times round a block: along each side from place to place, and right at the corners. What is seen is drawn evenly for each state."""
    chance = random.Random(seed)
    once = [
        action
        for side in (width, height, width, height)
        for action in ["travel"] * side + ["right"]
    ]
    shown = [f"v{chance.randrange(views)}" for _ in once]
    steps = rounds * len(once)
    trace = Trace.from_steps(
        [shown[i % len(once)] for i in range(steps + 1)],
        [once[i % len(once)] for i in range(steps)],
    )
    return Walk(trace, tuple(i % len(once) for i in range(steps + 1)))
