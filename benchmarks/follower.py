"""Whether a person who follows the words of `route --words` through a floor plan arrives.

The follower knows the walls and doors of the plan, where it stands and where it looks. It knows
nothing of the map: neither its places nor its paths. It reads the sentences one after the other,
walks straight on through free space, and turns into doors and side ways that it sees. Usage:

    python benchmarks/follower.py SEED ROUTES PLAN.xml LOG.log MAPS [PLAN.xml LOG.log MAPS ...]

The files are as for `indoors.py`. For each map, ROUTES pairs of places are drawn. The follower
starts at the true position of the first place and looks along the first edge. It arrives if it
stops within 3 m of the true position of the goal, on its way through free space, or in the room of
the goal.
"""

from __future__ import annotations

import copy
import json
import math
import re
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage
from skimage.draw import line
from skimage.graph import MCP_Geometric

from simulator.plans import Plan
from simulator.rounds import Building, holds
from ssh_abduction import Trace
from ssh_abduction.building.derive import with_building
from ssh_abduction.building.directions import Guide
from ssh_abduction.output.roads import place_of_steps
from ssh_abduction.solution import Solution

CELL, STRIDE = 0.1, 0.2  # metres of a cell of the plan, and of a stride
BODY = 0.2  # metres: half the width of the follower
VIEW = 6.0  # metres that the follower looks along its way and to the sides
ARRIVED = 3.0  # metres from the goal
ASLANT = 0.5  # the sine of the least angle to its wall at which a door is seen as one
NTH = ("first", "second", "third", "fourth", "fifth", "sixth", "seventh", "eighth")


class World:
    """The free space of a floor plan, as the follower sees it."""

    def __init__(self, building: Building) -> None:
        self.building = building
        walls = building.segments.reshape(-1, 2)
        self.corner = walls.min(axis=0) - 1
        self.blocked = np.zeros(np.ceil((np.ptp(walls, axis=0) + 2) / CELL).astype(int), bool)
        self._block(building.segments)
        self.shut = copy.deepcopy(self)  # with shut doors
        self.shut._block([opening.threshold for opening in building.openings])

    def _block(self, segments: Any) -> None:
        for a, b in np.array(segments).reshape(-1, 2, 2):
            self.blocked[line(*self.cell(a), *self.cell(b))] = True
        self.clear = ndimage.distance_transform_edt(~self.blocked) * CELL

    def cell(self, point: Any) -> tuple[int, int]:
        """The cell of a point."""
        x, y = np.rint((np.asarray(point) - self.corner) / CELL).astype(int)
        return int(x), int(y)

    def free(self, point: Any, radius: float = BODY) -> bool:
        """Whether the follower fits at a point."""
        x, y = self.cell(point)
        inside = 0 <= x < self.clear.shape[0] and 0 <= y < self.clear.shape[1]
        return inside and self.clear[x, y] > radius

    def ray(self, point: Any, bearing: float, most: float = VIEW, radius: float = BODY) -> float:
        """How far the follower can go straight on in a direction, at most `most` metres."""
        ahead = np.array([math.cos(bearing), math.sin(bearing)])
        for k in range(1, round(most / CELL) + 1):
            if not self.free(point + k * CELL * ahead, radius):
                return (k - 1) * CELL
        return most

    def sees(self, point: Any, other: Any) -> bool:
        """Whether neither a wall nor a shut door is between two points."""
        off = np.asarray(other) - point
        far = float(np.hypot(*off))
        return self.shut.ray(point, math.atan2(off[1], off[0]), far, 0.0) > far - 0.3

    def metres(self, point: Any, other: Any) -> float:
        """The length of the shortest way between two points."""
        costs = np.where(self.clear > BODY, CELL, 100.0)
        found, _ = MCP_Geometric(costs).find_costs([self.cell(point)], [self.cell(other)])
        return float(found[self.cell(other)])


class Follower:
    """A person in a floor plan who follows words."""

    def __init__(self, world: World, at: Any, bearing: float) -> None:
        self.world, self.at, self.bearing = world, np.array(at, float), bearing
        self.trail, self.looked = [self.at.copy()], [bearing]  # of this leg

    def follow(self, sentences: Any) -> None:
        """Follow the sentences of a route."""
        for said, onward in zip(sentences, [*sentences[1:], ""], strict=True):
            if said.startswith("turn around"):
                self.bearing += math.pi
            elif turn := re.match(r"turn (slightly |half |sharp )?(left|right)", said):
                degrees = {None: 90, "slightly ": 25, "half ": 45, "sharp ": 135}[turn[1]]
                go = re.match(r"go (\d+) m .*through", onward)
                self.turn(degrees, turn[2], go and float(go[1]))
            elif said.startswith("go "):
                self.walk(said)

    def walk(self, said: str) -> None:
        """Go as far as a sentence says."""
        metres, nth = 0.0, re.search(r"to the (?:(\w+) )?opening on the (left|right)", said)
        for part in said.split(", "):
            if far := re.match(r"(?:go )?(\d+) m", part):
                metres = float(far[1])
            elif doors := re.match(r"through (the|\d+) door", part):
                self.go_through(metres, 1 if doors[1] == "the" else int(doors[1]))
                metres = 0.0
        if metres:
            self.go(metres, nth and (nth[1], nth[2]))

    def go_through(self, metres: float, doors: int) -> None:
        """Go on for some metres and through some doors."""
        gone, self.trail, self.looked = 0.0, [self.at.copy()], [self.bearing]
        passed: set[int] = set()
        while len(passed) < doors:
            if (door := self.door_ahead(passed, metres - gone)) is not None:
                gone += self.pass_door(door)
                passed.add(door)
            elif gone > metres + VIEW or not (self.stride() or self.look_around()):
                break
            else:
                gone += STRIDE

    def go(self, metres: float, nth: Any) -> None:
        """Go on for some metres, and to the nth opening on one side."""
        gone, self.trail, self.looked = 0.0, [self.at.copy()], [self.bearing]
        look_out = 2.0 if nth else 0.0  # The distance is rounded, so an opening may come later.
        while gone < metres + look_out:
            if self.stride(shut=True) or (gone <= metres - 2.0 and self.stride()):
                gone += math.dist(*self.trail[-2:])
            elif gone > metres - 2.0 or not self.look_around():
                break  # This is far enough, or there is no other way.
        if nth:  # Go back to the opening.
            back = self.opening(metres, *nth)
            self.at, self.bearing = self.trail[back].copy(), self.looked[back]

    def stride(self, shut: bool = False) -> bool:
        """Make one stride ahead, in the middle of the way. False if there is a wall.

        Words tell of each door on the way. So the follower takes a door for shut at first.
        """
        world, turns = self.world.shut if shut else self.world, np.radians(np.arange(-40, 41, 10))
        score = [world.ray(self.at, self.bearing + turn, 3.0) - 1.5 * abs(turn) for turn in turns]
        turn = float(turns[int(np.argmax(score))])
        ahead = np.array([math.cos(self.bearing + turn), math.sin(self.bearing + turn)])
        left = np.array([-ahead[1], ahead[0]])
        options = [self.at + STRIDE * ahead + off * left for off in (0.0, -0.1, 0.1)]
        options = [p for p in options if world.free(p)]
        if not options or max(score) < STRIDE:
            return False
        clear = [min(world.clear[world.cell(p)], 1.2) for p in options]
        self.at = options[int(np.argmax(clear))]
        self.bearing += 0.25 * turn
        self.trail.append(self.at.copy())
        self.looked.append(self.bearing)
        return True

    def look_around(self) -> bool:
        """Turn to the longest free way within 90 degrees. False if there is none."""
        turns = np.radians(np.arange(-90, 91, 10))
        rays = [self.world.ray(self.at, self.bearing + turn) for turn in turns]
        self.bearing += float(turns[int(np.argmax(rays))])
        return max(rays) > 1.0

    def door_ahead(self, passed: set[int], metres: float) -> int | None:
        """The door nearest to straight ahead that is near, in sight, and not passed yet."""
        found = []
        for k, opening in enumerate(self.world.building.openings):
            off = np.array(opening.middle) - self.at
            far, bend = float(np.hypot(*off)), self.bend(off)
            aslant = abs(math.sin(opening.along - self.bearing)) < ASLANT
            fits = metres - max(2.0, 0.25 * metres) < far < max(metres + 1, VIEW)
            ahead = fits and abs(bend) < math.radians(60) and not aslant
            if k not in passed and ahead and self.world.sees(self.at, opening.middle):
                found.append((abs(bend) + 0.1 * abs(far - max(metres, 0.0)), k))
        return min(found)[1] if found else None

    def pass_door(self, door: int) -> float:
        """Go through a door, and 0.6 m on. Returns the metres gone."""
        opening = self.world.building.openings[door]
        across = complex(0, 1) * complex(math.cos(opening.along), math.sin(opening.along))
        off = np.array(opening.middle) - self.at
        normal = np.array([across.real, across.imag])
        normal = normal if off @ normal > 0 else -normal
        end = np.array(opening.middle) + (0.6 + opening.depth / 2) * normal
        gone = float(np.hypot(*off)) + 0.6
        self.at, self.bearing = end, math.atan2(normal[1], normal[0])
        self.trail += [np.array(opening.middle), end]
        self.looked += [self.bearing] * 2
        return gone

    def bend(self, off: Any) -> float:
        """The turn from the direction of the follower to an offset, in radians."""
        return (math.atan2(off[1], off[0]) - self.bearing + math.pi) % math.tau - math.pi

    def opening(self, metres: float, nth: str | None, side: str) -> int:
        """The index of the point of the trail beside the nth opening on a side.

        The follower weighs its count and its distance: it may have counted one too many, or the
        distance is rounded.
        """
        trail = np.array(self.trail)
        far = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(trail, axis=0).T))])
        found = self.openings(trail, far, 1 if side == "left" else -1)
        fits = max(1.5, 0.1 * metres)
        likely = [(abs(s - metres) / fits, s) for s in found]
        if nth:
            number = NTH.index(nth) if nth in NTH else int(re.sub(r"\D", "", nth)) - 1
            likely = [(abs(k - number) + error, s) for k, (error, s) in enumerate(likely)]
        stop = min([*likely, (2.0, min(metres, far[-1]))])[1]
        return int(np.abs(far - stop).argmin())

    def openings(self, trail: Any, far: Any, side: int) -> list[float]:
        """List how far along the trail the openings on one side are: doors, and other ways."""
        ahead = np.gradient(trail, axis=0) if len(trail) > 1 else np.zeros_like(trail)
        way = np.arctan2(ahead[:, 1], ahead[:, 0])
        seen: list[float] = []
        for opening in self.world.building.openings:
            off = np.array(opening.middle) - trail
            k = int(np.hypot(*off.T).argmin())
            across = float(np.sin(math.atan2(off[k, 1], off[k, 0]) - way[k]) * np.hypot(*off[k]))
            if 0.2 < side * across < VIEW and self.world.sees(trail[k], opening.middle):
                seen.append(float(far[k]))
        depth = np.array(
            [self.world.ray(p, b + side * math.pi / 2) for p, b in zip(trail, way, strict=True)]
        )
        ways = []
        usual = ndimage.median_filter(depth, 31, mode="nearest")
        parts, count = ndimage.label(depth > usual + 1.0)
        for part in range(1, count + 1):
            inside = far[parts == part]
            if not any(inside[0] - 1 < door < inside[-1] + 1 for door in seen):
                ways.append(float(inside.mean()))
        # What is beside the beginning is not passed.
        return sorted(s for s in [*seen, *ways] if s > 1.0)

    def turn(self, degrees: float, side: str, to_door: float | None) -> None:
        """Turn to one side: to the door that is in sight there, or else along the free way.

        If words tell of a door next, it is about `to_door` metres away.
        """
        sign, most = 1 if side == "left" else -1, math.radians(45)
        doors = []
        for opening in self.world.building.openings:
            off = np.array(opening.middle) - self.at
            far, error = float(np.hypot(*off)), sign * self.bend(off) - math.radians(degrees)
            aslant = abs(math.sin(opening.along - math.atan2(off[1], off[0]))) < ASLANT
            metres = to_door or 0.0
            fits = metres - max(2.0, 0.25 * metres) < far < metres + VIEW
            # The follower may stand a metre aside, so the turn to a near door may differ.
            wrong = max(0.0, abs(error) - (math.atan2(1.0, far) if to_door else 0.0))
            near = fits and wrong < most and not (aslant and (far > 2.0 or not to_door))
            if near and self.world.sees(self.at, opening.middle):
                doors.append((wrong + 0.1 * abs(far - metres), error))
        errors = np.radians(np.arange(-30, 31, 10))
        ways = self.bearing + sign * (math.radians(degrees) + errors)
        rays = [self.world.ray(self.at, way, 4.0) for way in ways]
        error = float(errors[int(np.argmax(np.array(rays) - np.abs(errors)))])
        error = min(doors)[1] if doors and (to_door or max(rays) < 3.0) else error
        self.bearing += sign * (math.radians(degrees) + error)


def routes(plan: Path, log: Path, folder: Path, count: int, chance: Any) -> Counter[str]:
    """Let the follower follow routes through one map, and count those that arrive."""
    world = World(Building.of(Plan.load(plan)))
    trace = Trace.load(folder / "trace.jsonl")
    ssh_map = with_building(Solution.load(folder / "maps.json").maps[0], trace)
    assert ssh_map.fit is not None
    guide, places, counts = Guide(ssh_map, trace), place_of_steps(ssh_map), Counter[str]()
    told = json.loads(log.with_suffix(".truth.json").read_text())["scans"]
    true: dict[int, list[Any]] = {}
    for t, (step, place) in enumerate(zip(trace.steps, places, strict=True)):
        if place is not None and (t == 0 or trace.actions[t - 1].kind != "turn"):
            true.setdefault(place, []).append((t, np.array(step.truth["pose"])))
    where = {p: np.mean([pose[:2] for _, pose in seen], axis=0) for p, seen in true.items()}
    rooms = {
        p: Counter(told[int(trace.steps[t].extra["scan"])] for t, _ in seen)
        for p, seen in true.items()
    }
    pairs = [(p, q) for p in where for q in where if guide.plan.name[p] != guide.plan.name[q]]
    for k in chance.permutation(len(pairs))[:count]:
        start, goal = pairs[k]
        ends = guide.ends_to([start], [goal])
        t, pose = true[start][0]
        turn = pose[2] - ssh_map.fit.poses[ssh_map.dstate_at[t]].heading
        person = Follower(world, where[start], guide.route(ends).bearing + turn)
        said = list(guide.told(ends))
        person.follow(said)
        name = rooms[goal].most_common(1)[0][0]
        room = world.building.plan.rooms[int(name.split()[1])] if name else None
        inside = room is not None and holds(room.polygon, tuple(person.at))
        arrived = inside or world.metres(person.at, where[goal]) <= ARRIVED
        counts += Counter(routes=1, arrived=int(arrived))
        counts[f"{len(said) // 2 + 1} legs"] += 1
        counts[f"{len(said) // 2 + 1} legs, arrived"] += arrived
        if "-v" in sys.argv and not arrived:
            print(folder.name, start, goal, where[start], where[goal], person.at, "; ".join(said))
    return counts


def main(arguments: list[str]) -> None:
    """Print a line for each map, and one for all."""
    seed, count, *files = [a for a in arguments if a != "-v"]
    chance, total = np.random.default_rng(int(seed)), Counter[str]()
    for plan, log, folder in zip(*(iter(files),) * 3, strict=True):
        counts = routes(Path(plan), Path(log), Path(folder), int(count), chance)
        total += counts
        print(folder, dict(sorted(counts.items())), flush=True)
    print("all", dict(sorted(total.items())), f"{total['arrived'] / total['routes']:.2f}")


if __name__ == "__main__":
    main(sys.argv[1:])
