"""Are the gateways found that changed between two drives?

    python benchmarks/changes.py [--cells 4] [--steps 60] [--seeds 20] [--first SEED] [--most 3]
    python benchmarks/changes.py --plans FOLDER [--steps 60] [--seeds 1] [--first SEED] [--most 3]

Two robots drive through a maze with stars and noisy displacements, and start anywhere. Before the
second drive, 0 to `--most` ways between cells are closed or opened, at a cell that the first drive
saw. A view is one of `--views` looks of a cell and a heading, the same on both drives. The script
prints a row in Markdown for each number of changes: how many gateways changed at cells that both
drives saw, how many of these the first map names, and how many others it names. If the map keeps
the drives apart, it can name no change: these are counted, too. The script names each map that is
false, and each change that is missed.

With --plans, the robots drive through each floor plan of a folder. Stars are the bearings of open
doors. Some doors are closed on one of the two drives: on the second one if the seed is even.

With --beam, only the beams of width 1 and of this width search, without a time limit. So the load
of the machine does not matter. Their cheapest map is judged. With --join, the maps of the two
drives are joined, too.
"""

from __future__ import annotations

import argparse
import math
import random
import sys
import time
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import networkx as nx
import numpy as np
from instances import HEADINGS, doors_of, maze, reported
from plan_tours import Floor, RoomPlan, Stand
from together import joined
from truth import NOISE, Known, is_true, with_truth

from ssh_abduction import SSHMap, Theory, Trace, solve
from ssh_abduction.data import Action, Odometry, Step
from ssh_abduction.data.odometry import displacement_between
from ssh_abduction.data.star import Gateway as Sighted
from ssh_abduction.solver.costs.misfit import Misfit
from ssh_abduction.solver.sources.metric.beam import Beam
from ssh_abduction.solver.sources.metric.joint_drives import Joining
from ssh_abduction.solver.steps.log import Log
from ssh_abduction.theory.settle import settle

Cell = tuple[int, int]
# A cell, and 0 to 3 for north, east, south, west; or a room, and a door of the plan.
Gateway = tuple[Cell, int] | tuple[str, int]


@dataclass(frozen=True)
class Case:
    """Two drives through a maze, and the gateways that changed where both were."""

    known: Known
    changed: frozenset[Gateway]


def case(cells: int, steps: int, seed: int, changes: int, views: int) -> Case:
    """Make two drives, between which some ways are closed or opened."""
    chance = random.Random(f"{seed}, {changes}")
    doors = set(doors_of(cells, cells, random.Random(seed), 0.1))
    looks = {state: chance.randrange(views) for state in product(*map(range, (cells, cells, 4)))}
    drives: list[Known] = []
    toggled: list[Gateway] = []
    for number in range(2):
        walk = maze(
            cells, cells, steps=steps, seed=seed, stars=True, follow=True, drive=number,
            odometry=Odometry(**NOISE), doors=doors,
        )  # fmt: skip
        trace = walk.trace.with_views([f"v{looks[state]}" for state in walk.truth])
        at = tuple(state[:2] for state in walk.truth if isinstance(state, tuple))
        drives.append(Known(f"maze {seed}, {changes} changes", trace, walk.truth, at))
        if not number:
            toggled = _toggled(cells, sorted(set(at)), chance)[:changes]
            for (x, y), way in toggled:
                ends = (x, y), (x + HEADINGS[way][0], y + HEADINGS[way][1])
                doors ^= {ends, ends[::-1]}
    both = set(drives[0].places) & set(drives[1].places)
    seen = {end for gateway in toggled for end in (gateway, _other(gateway)) if end[0] in both}
    return Case(joined(drives[0].name, drives), frozenset(seen))


def _toggled(cells: int, seen: list[Cell], chance: random.Random) -> list[Gateway]:
    """The ways at some cells that may change, in random order, each from one side."""
    inside = {(cell, way) for cell in seen for way in range(4)}
    inside = {g for g in inside if all(0 <= x < cells for x in _other(g)[0])}
    once = sorted(g for g in inside if _other(g) not in inside or g < _other(g))
    return chance.sample(once, len(once))


def _other(gateway: Gateway) -> Gateway:
    """The other end of a way."""
    (x, y), way = gateway
    return (x + HEADINGS[way][0], y + HEADINGS[way][1]), (way + 2) % 4


def case_of_plan(plan: RoomPlan, steps: int, seed: int, changes: int, views: int) -> Case:
    """Make two drives through a plan. Some doors are closed on one of them.

    The closed doors belong to rooms that the other drive saw. The plan stays connected.
    """
    plan, chance = plan.told_apart(), random.Random(f"{plan.name}, {seed}, {changes}")
    looks: dict[str, str] = {}
    closed: list[int] = []
    drives: list[Known] = []
    for number in range(2):
        trace = _plan_drive(plan, steps, (seed, number), closed)
        states = [step.truth["dstate"] for step in trace.steps]
        for state in sorted({*states} - looks.keys()):
            looks[state] = f"v{chance.randrange(views)}"
        drives.append(with_truth("", trace.with_views([looks[state] for state in states])))
        if not number:
            closed = _closable(plan, {*drives[0].places}, changes, chance)
    both = {*drives[0].places} & {*drives[1].places}
    ends = {(f"room {room}", door) for door in closed for room in plan.doors[door].rooms}
    name = f"{plan.name}, {seed}, {changes} changes"
    known = joined(name, drives[:: 1 if seed % 2 == 0 else -1])
    return Case(known, frozenset(end for end in ends if end[0] in both))


def _closable(
    plan: RoomPlan, seen: Collection[object], count: int, chance: random.Random
) -> list[int]:
    """Choose doors of rooms that were seen, such that the plan stays connected if they are closed.

    No path leads straight on through such a door: a robot that comes to a closed door ahead would
    not know how the path bends.
    """
    bent = {g.door for found in plan.gateways for g in found if g.opposite is not None}
    doors = [
        d
        for d, door in enumerate(plan.doors)
        if d not in bent and {f"room {r}" for r in door.rooms} & {*seen}
    ]
    graph, found = nx.MultiGraph(plan.graph.subgraph(plan.connected)), list[int]()
    for door in chance.sample(doors, len(doors)):
        ends = plan.doors[door].rooms
        if len(found) < count and {*ends} <= {*graph}:
            graph.remove_edge(*ends, door)
            if nx.is_connected(graph):
                found.append(door)
            else:
                graph.add_edge(*ends, door)
    return found


def _plan_drive(
    plan: RoomPlan, steps: int, seed: tuple[int, int], closed: Collection[int]
) -> Trace:
    """Drive through a plan with some closed doors, which stars lack.

    The name of a turn has its angle, too.
    """
    floor, noise = Floor(plan), Odometry(**NOISE)
    walk, drawn, sighted = (np.random.default_rng([*seed, k]) for k in range(3))
    logged: list[Step] = []
    before = None
    for stand, action in _rounds(floor, steps, walk, closed):
        heading = _heading(plan, stand)
        pose = (
            *plan.rooms[stand.room].centre,
            math.remainder(math.radians(90 - heading), math.tau),
        )
        moved = None if before is None else displacement_between(before, pose)
        if moved is not None:
            moved = reported(moved, noise, drawn)
        truth = {
            "place": f"room {stand.room}",
            "dstate": f"room {stand.room}, {stand.gateway}, {stand.faces}",
            "heading": heading,
        }
        star = _open_gateways(floor, stand, closed, sighted)
        logged.append(Step("?", action, star, moved, truth=truth))
        before = pose
    return Trace(tuple(logged), odometry=noise)


def _heading(plan: RoomPlan, stand: Stand) -> float:
    gateway = plan.gateways[stand.room][stand.gateway]
    return (gateway.bearing + (0 if stand.faces else 180)) % 360


def _open_gateways(
    floor: Floor, stand: Stand, closed: Collection[int], chance: np.random.Generator
) -> tuple[Sighted, ...]:
    """The star of a room without its closed doors. Each bearing is off by at most the spread."""
    found, heading = floor.plan.gateways[stand.room], floor.heading(stand)
    is_open = [k for k, gateway in enumerate(found) if gateway.door not in closed]
    off = chance.uniform(-floor.spread, floor.spread, len(found)).tolist()
    bearing = {k: round(found[k].bearing - heading + off[k], 3) % 360 for k in is_open}
    order = sorted(is_open, key=lambda k: bearing[k])
    opposite = {k: found[k].opposite for k in order}
    return tuple(
        Sighted(bearing[k], floor.spread, order.index(x) if (x := opposite[k]) in order else None)
        for k in order
    )


def _rounds(
    floor: Floor, steps: int, chance: np.random.Generator, closed: Collection[int]
) -> Iterator[tuple[Stand, Action | None]]:
    """Drive to the open door that was passed least often; yield each state and the next action."""
    plan = floor.plan
    usable = [[k for k, g in enumerate(r) if g.door not in closed] for r in plan.gateways]
    room = int(chance.choice([room for room in plan.connected if usable[room]]))
    stand, came_by = Stand(room, usable[room][0]), None
    passed: Counter[int] = Counter()
    while True:
        found = plan.gateways[stand.room]
        choices = [k for k in usable[stand.room] if found[k].door != came_by]
        choices = choices or usable[stand.room]
        least = min(passed[found[k].door] for k in choices)
        goal = int(chance.choice([k for k in choices if passed[found[k].door] == least]))
        for action, after in floor.way_through(stand, goal):
            if steps == 0:
                yield stand, None
                return
            yield stand, _renamed(action, plan, stand, goal, closed)
            stand, steps = after, steps - 1
        came_by = found[goal].door
        passed[came_by] += 1


def _renamed(
    action: Action, plan: RoomPlan, stand: Stand, goal: int, closed: Collection[int]
) -> Action:
    """A turn right or left, with its number among the open doors, and its angle in its name.

    Where a door is closed, the numbers of others change. So the numbers alone would name turns to
    several doors from one dstate.
    """
    if action.turn not in ("right", "left"):
        return action
    found, heading = plan.gateways[stand.room], _heading(plan, stand)
    bearings = {k: round((g.bearing - heading) % 360, 3) % 360 for k, g in enumerate(found)}
    beside = sorted(
        (bearings[k] for k, g in enumerate(found) if bearings[k] > 0 and g.door not in closed),
        reverse=action.turn == "left",
    )
    number = beside.index(bearings[goal]) + 1
    name = f"{action.turn} by {bearings[goal]:.0f} to gateway {number}"
    return Action.of({"name": name, "kind": "turn", "turn": action.turn, "gateway": number})


def named_doors(ssh_map: SSHMap, known: Known, plan: RoomPlan) -> Iterator[Gateway]:
    """The doors that a map says to have changed, by the true room and heading of the place."""
    plan = plan.told_apart()
    for fault in ssh_map.faults:
        first = next(t for t, _ in enumerate(known.trace) if ssh_map.place_of(t) == fault.place)
        room = int(str(known.places[fault.step]).split()[1])
        heading = known.trace.steps[first].truth["heading"] + (fault.bearing or 0)
        off = [abs((g.bearing - heading + 180) % 360 - 180) for g in plan.gateways[room]]
        yield f"room {room}", plan.gateways[room][off.index(min(off))].door


def named(ssh_map: SSHMap, known: Known) -> Iterator[Gateway]:
    """The gateways that a map says to have changed, by the true cell and heading of the step."""
    for fault in ssh_map.faults:
        x, y, heading = known.dstates[fault.step]
        slot = ssh_map.dstates[ssh_map.dstate_at[fault.step]].heading or 0
        yield (x, y), ((fault.gateway or 0) - slot + heading) % 4


def cheapest(trace: Trace, theory: Theory, widths: Collection[int], joins: bool) -> SSHMap:
    """The map of least cost that beams of some widths find, and that joins the drives."""
    problem = settle(trace, theory)
    log, misfit = Log(trace, problem.theory, problem.pairs), Misfit(problem)
    found = [ssh_map for width in widths for ssh_map in Beam(problem, log, width).maps()]
    return min([*found, *(Joining(problem, log).maps() if joins else ())], key=misfit.nats_of)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--cells", type=int, default=4, metavar="N", help="mazes of N x N cells")
    parser.add_argument("--steps", type=int, default=60, metavar="N", help="actions of a drive")
    parser.add_argument("--seeds", type=int, default=20, metavar="N")
    parser.add_argument("--first", type=int, default=0, metavar="SEED", help="the first seed")
    parser.add_argument("--views", type=int, default=8, metavar="N", help="looks of dstates")
    parser.add_argument("--most", type=int, default=3, metavar="N", help="the most changes")
    parser.add_argument("--least", type=int, default=0, metavar="N", help="the fewest changes")
    parser.add_argument("--price", type=float, default=0.9, metavar="DSTATES")
    parser.add_argument("--limit", type=float, default=20, metavar="S", help="seconds for each")
    parser.add_argument("--plans", type=Path, metavar="FOLDER", help="tours of floor plans")
    parser.add_argument("--beam", type=int, metavar="WIDTH", help="search by beams alone")
    parser.add_argument("--join", action="store_true", help="join the maps of the drives")
    options = parser.parse_args()
    plans = sorted(options.plans.glob("*.xml")) if options.plans else []
    widths = {1, options.beam} if options.beam else set[int]()
    theory = Theory(changed=options.price, star="frame")
    if plans:
        theory = Theory(changed=options.price, star="gateways", boundary="none")
    head = ("changes", "true maps", "changed gateways", "of drives kept apart", "named")
    head = (*head, "others named", "maps that name none", "CPU s")
    print(f"| {' | '.join(head)} |\n|{'---|' * len(head)}")
    for changes in range(options.least, options.most + 1):
        true = changed = apart = found = others = none = 0
        began = time.process_time()
        seeds = range(options.first, options.first + options.seeds)
        rows = [*product([RoomPlan.load(path) for path in plans] or [None], seeds)]
        for plan, seed in rows:
            one = (
                case(options.cells, options.steps, seed, changes, options.views)
                if plan is None
                else case_of_plan(plan, options.steps, seed, changes, options.views)
            )
            trace = one.known.trace
            best = (
                solve(trace, theory, time_limit=options.limit).maps[0]
                if not widths and not options.join
                else cheapest(trace, theory, widths, options.join)
            )
            said = {
                *(named(best, one.known) if plan is None else named_doors(best, one.known, plan))
            }
            if said != one.changed or not is_true(best, one.known):
                missed, more = sorted(one.changed - said), sorted(said - one.changed)
                print(f"{one.known.name}: missed {missed}, others {more}", file=sys.stderr)
            true += is_true(best, one.known)
            changed += len(one.changed)
            apart += len(one.changed) * (len(best.pieces) > 1)
            found += len(said & one.changed)
            others += len(said - one.changed)
            none += not said
        print(
            f"| {changes} | {true} of {len(rows)} | {changed} | {apart} | {found} | {others} "
            f"| {none} | {time.process_time() - began:.0f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
