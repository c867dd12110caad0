"""Traces to measure: random walks in mazes and in random Moore machines, repeatable by seed.

>>> walk = maze(5, 5, steps=1600, seed=0)
>>> len(walk.trace), len(set(walk.truth))
(1601, 100)
"""

from __future__ import annotations

import math
import random
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from simulator.robot import DIGITS
from ssh_abduction import Trace
from ssh_abduction.data import Odometry
from ssh_abduction.data.odometry import Displacement, Pose, displacement_between

HEADINGS = ((0, 1), (1, 0), (0, -1), (-1, 0))  # north, east, south, west
TURNS = {"right": 1, "around": 2, "left": 3}
# The distance between neighbouring cells of a maze, in metres.
CELL = 10.0


@dataclass(frozen=True)
class Walk:
    """A trace, and the true state at each of its steps; no states if they are unknown."""

    trace: Trace
    truth: tuple[object, ...]


def reported(
    displacement: Displacement,
    odometry: Odometry,
    rng: np.random.Generator,
    *,
    scale: float = 0.0,
    bend: float = 0.0,
) -> Displacement:
    """Add systematic errors and random noise to a displacement, as odometry reports it, rounded.

    A displacement is metres ahead and to the left, and radians turned. The noise is drawn with
    the covariance of the odometry. Reported distances are too long by the share `scale`. The
    reported heading drifts to the left by `bend` radians per metre.
    """
    dx, dy, turned = displacement
    drift = bend * math.hypot(dx, dy)
    # On average, the direction of motion is off by half of the drift.
    cos, sin = ((1 + scale) * math.cos(drift / 2), (1 + scale) * math.sin(drift / 2))
    noise = np.linalg.cholesky(np.array(odometry.covariance(displacement))) @ rng.normal(size=3)
    x, y, heading = np.array([cos * dx - sin * dy, sin * dx + cos * dy, turned + drift]) + noise
    return round(float(x), DIGITS), round(float(y), DIGITS), round(float(heading), DIGITS)


def displaced(
    trace: Trace,
    poses: Sequence[Pose],
    odometry: Odometry,
    seed: int,
    *,
    scale: float = 0.0,
    bend: float = 0.0,
) -> Trace:
    """Copy a trace, with displacements between the true poses as an odometer reports them.

    Args:
        trace: The trace.
        poses: True pose of each step.
        odometry: Model of the noise, which the copy also states.
        seed: Seed of the noise.
        scale: Share by which reported distances are too long.
        bend: Radians a metre by which the reported heading drifts to the left.
    """
    rng = np.random.default_rng(seed)
    moved = [
        reported(displacement_between(a, b), odometry, rng, scale=scale, bend=bend)
        for a, b in pairwise(poses)
    ]
    apart = {t for t, action in enumerate(trace.actions, 1) if action.breaks_frame}
    steps = (
        replace(step, displacement=None if t in apart else displacement)
        for t, (step, displacement) in enumerate(zip(trace.steps, [None, *moved], strict=True))
    )
    return replace(trace, steps=tuple(steps), odometry=odometry)


Cell = tuple[int, int]
Door = tuple[Cell, Cell]


def doors_of(
    width: int, height: int, chance: random.Random, loops: float = 0.1
) -> set[tuple[Cell, Cell]]:
    """Draw the corridors of a maze: pairs of neighbouring cells, each in both directions.

    The corridors are a random spanning tree of the grid. Each other wall is open with probability
    `loops`.
    """
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
    drive: int | None = None,
    doors: Collection[Door] | None = None,
) -> Walk:
    """Make a random walk in a maze of corridors.

    A state is a cell and a heading. A view is the openings ahead, right, back and left. If the way
    ahead is open, the robot travels with probability 1/2; otherwise it turns right or left. If the
    way ahead is closed, it turns right, left or around.

    Args:
        width: Number of cells from west to east.
        height: Number of cells from south to north.
        steps: Number of actions.
        seed: Seed of the maze and the walk.
        loops: Probability that a wall that the spanning tree leaves closed is open.
        stars: Whether the trace has stars, which are the openings as evidence.
        follow: Whether the robot follows corridors. Then it travels with probability 2/3 if the way
            ahead is open, and otherwise turns right or left. If the way ahead is closed, it turns
            to an opening on its right or left, and around only in a dead end.
        odometry: Noise of the displacements of the trace; None for a trace without displacements.
            It does not change the walk.
        cell: Metres from one cell to the next.
        scale: Share by which reported distances are too long.
        bend: Radians a metre by which the reported heading drifts to the left.
        drive: The number of the walk, for several walks in one maze; None for a single one.
        doors: The pairs of cells between which the way is open; None to draw them by the seed.
    """
    chance = random.Random(seed)
    if doors is None:
        doors = doors_of(width, height, chance, loops)
    if drive is not None:
        chance = random.Random(f"{seed}, {drive}")
        seed = chance.randrange(2**32)

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
    """Make a random walk in a random Moore machine.

    Links and views are drawn uniformly. Each view occurs, and a random walk can visit all states.

    Args:
        states: Number of states.
        views: Number of views.
        steps: Number of actions of the walk.
        seed: Seed of the machine and the walk.
        actions: Number of different actions.
    """
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
    """Make a random walk in a random Moore machine, with wrong views and jumps.

    A jump is an action that leads to a wrong state, from which the walk goes on. The first and last
    five steps have no faults.

    Args:
        states: Number of states.
        views: Number of views.
        steps: Number of actions of the walk.
        seed: Seed of machine, walk and faults.
        wrong: Number of wrong views.
        jumps: Number of jumps.
        actions: Number of different actions.

    Returns:
        The walk, the steps with a wrong view, and the steps whose action jumped.
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
        if t in jumped or there is None:  # the walk without faults never tried this action
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
    """Make circuits of the notched rectangle of Kuipers & Beeson (2002).

    It has eight states, which show four views.
    """
    steps = 8 * circuits
    trace = Trace.from_steps(
        [f"v{i % 4}" for i in range(steps + 1)], [("right", "travel")[i % 2] for i in range(steps)]
    )
    return Walk(trace, tuple(i % 8 for i in range(steps + 1)))


def circuits(width: int, height: int, *, rounds: int, seed: int, views: int = 4) -> Walk:
    """Make circuits of a block: the robot travels along each side, and turns right at the corners.

    The view of each state is drawn uniformly.

    Args:
        width: Number of travels along two of the sides.
        height: Number of travels along the two other sides.
        rounds: Number of circuits.
        seed: Seed of the views.
        views: Number of views.
    """
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
