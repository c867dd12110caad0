"""Whether the rooms, doors and corridors of a map are those of the floor plan.

A robot drives through a floor plan. The simulator says in which room each scan was taken, and which
doors the robot drove through. Usage:

    python benchmarks/indoors.py PLAN.xml LOG.log MAPS [PLAN.xml LOG.log MAPS ...]

LOG.log is a log that `simulate --format carmen` wrote, with its truth beside it. MAPS is the folder
that `map` wrote. A corridor of the plan counts if the robot visited three of its places or more. It
is whole if one corridor of the map, and no other, has at least two of them, and all but one. A
corridor of the map is merged if it has two places or more of each of two of them.

The order of the places of a corridor of the map is judged by Kendall's tau: it is compared with
their true positions along the line that fits them best. A place is truly left of the path of a
corridor if its shortest way through the free space of the plan leaves the path to the left. The
path is the chain of the true positions of its places.

    python benchmarks/indoors.py --drawn MAPS [MAPS ...]

judges maps of real logs by `results/corridors.json`. A person drew these corridors on pictures of
the scans, in the frame of the corrected poses of the log, before the paths were derived. A corridor
of the map is turned and moved to the corrected positions of its places. Lines within BESIDE metres
of each other are the same. A corridor of the map is false if less than PART of it is on a drawn
one.
"""

from __future__ import annotations

import json
import sys
import xml.etree.ElementTree as ET
from collections import Counter, defaultdict
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from follower import BODY, CELL, World
from scipy.spatial.distance import cdist
from skimage.graph import MCP_Geometric
from skimage.transform import EuclideanTransform

from perception.places.passages import resampled
from simulator.plans import Plan
from simulator.rounds import Building
from ssh_abduction import SSHMap, Trace
from ssh_abduction.building.derive import with_building
from ssh_abduction.output.roads import place_of_steps
from ssh_abduction.solution import Solution

DRAWN = Path(__file__).parent / "results" / "corridors.json"
BESIDE = 1.5  # metres
WHOLE, PART = 0.8, 0.4  # of a drawn corridor is on one of the map


def judged(
    ssh_map: SSHMap, trace: Trace, told: dict[str, Any], labels: list[str], world: World
) -> Counter[str]:
    """Count what is right, by the truth of the drive and the labels of the rooms of the plan."""
    places, counts = place_of_steps(ssh_map), Counter[str]()
    scans = [int(step.extra["scan"]) for step in trace.steps]
    seen: dict[int, Counter[str]] = defaultdict(Counter)
    for t, (place, scan) in enumerate(zip(places, scans, strict=True)):
        arrived = t == 0 or trace.actions[t - 1].kind != "turn"
        if arrived and place is not None and told["scans"][scan]:
            seen[place][told["scans"][scan]] += 1
    true = {p: rooms.most_common(1)[0][0] for p, rooms in seen.items()}
    room = {p: r.id for r in ssh_map.rooms for p in r.places}
    for p, q in combinations(true, 2):
        found, right = room.get(p) == room.get(q), true[p] == true[q]
        counts += Counter({"pairs found": found, "pairs true": right, "pairs": found and right})
    counts["exact"] = int(
        all((room.get(p) == room.get(q)) == (true[p] == true[q]) for p, q in combinations(true, 2))
    )
    for t, action in enumerate(trace.actions):
        if action.kind == "travel":
            passed = any(scans[t] < x["scan"] <= scans[t + 1] for x in told["crossings"])
            found = any(d["side"] == "through" for d in trace[t].extra.get("doors", ()))
            more = {"doors found": found, "doors true": passed, "doors": found and passed}
            counts += Counter(more)
    counts += ordered(ssh_map, trace, world)
    corridors = [{*c.order} for c in ssh_map.corridors]

    def label(name: str) -> str:
        return labels[int(name.split()[1])] or ""

    halls = [
        {p for p in true if true[p] == name}
        for name, count in Counter(true.values()).items()
        if count >= 3 and "CORR" in label(name)
    ]
    for own in halls:
        shared = [len(own & other) for other in corridors if len(own & other) > 1]
        counts["corridors true"] += 1
        counts["corridors whole"] += len(shared) == 1 and shared[0] >= len(own) - 1
        counts["corridors missed"] += not shared
    for other in corridors:
        counts["corridors merged"] += sum(len(own & other) > 1 for own in halls) > 1
        names = Counter(true[p] for p in other if p in true)
        counts["corridors named"] += 1
        counts["corridors false"] += not names or "CORR" not in label(names.most_common(1)[0][0])
    return counts


def ordered(ssh_map: SSHMap, trace: Trace, world: World) -> Counter[str]:
    """Count pairs of places of corridors in order and not, and places on the right side."""
    seen: dict[int, list[Any]] = defaultdict(list)
    for step, place in zip(trace.steps, place_of_steps(ssh_map), strict=True):
        if place is not None:
            seen[place].append(step.truth["pose"][:2])
    where = {place: np.mean(poses, axis=0) for place, poses in seen.items()}
    counts = Counter[str]()
    for c in ssh_map.corridors:
        at = np.array([where[p] for p in c.order])
        axis = np.linalg.svd(at - at.mean(axis=0))[2][0]
        axis = axis * np.sign((at[-1] - at[0]) @ axis)
        along = [float(x) for x in at @ axis]
        for x, y in combinations(along, 2):
            counts["in order" if x < y else "out of order"] += 1
        way = next(path.order for path in ssh_map.paths if path.id == c.path)
        left = left_of([where[p] for p in way], where, world)
        told = {**dict.fromkeys(c.left, True), **dict.fromkeys(c.right, False)}
        counts["beside"] += len(set(where) - set(c.order))
        counts["sides"] += len(told)
        counts["sides right"] += sum(left[p] == side for p, side in told.items())
    return counts


def left_of(line: Sequence[Any], where: dict[int, Any], world: World) -> dict[int, bool]:
    """Whether the shortest way from a chain of points to each place leaves it to the left."""
    share = np.linspace(0, len(line) - 1, 20 * len(line))
    chain = np.array([np.interp(share, range(len(line)), np.array(line)[:, k]) for k in (0, 1)]).T
    costs = MCP_Geometric(np.where(world.clear > BODY, CELL, 100.0))
    costs.find_costs([world.cell(point) for point in chain])
    found = {}
    for place, at in where.items():
        steps = np.array(costs.traceback(world.cell(at))) * CELL + world.corner
        off = steps[min(round(1 / CELL), len(steps) - 1)] - steps[0]
        k = int(np.hypot(*(chain - steps[0]).T).argmin())
        ahead = chain[min(k + 3, len(chain) - 1)] - chain[max(k - 3, 0)]
        found[place] = float(ahead[0] * off[1] - ahead[1] * off[0]) > 0
    return found


def drawn(folder: Path) -> Counter[str]:
    """Count the corridors of a real log that its map has whole, and print what is wrong."""
    trace, counts = Trace.load(folder / "trace.jsonl"), Counter[str]()
    ssh_map = with_building(Solution.load(folder / "maps.json").maps[0], trace)
    seen: dict[int, list[Any]] = defaultdict(list)
    for step, place in zip(trace.steps, place_of_steps(ssh_map), strict=True):
        if place is not None:
            seen[place].append(step.truth["pose"][:2])
    where = {place: np.mean(poses, axis=0) for place, poses in seen.items()}
    lines = {
        name: resampled(np.array(line, float), CELL)
        for name, line in json.loads(DRAWN.read_text())[trace.name].items()
    }
    at = {d.place: (p.x, p.y) for d, p in zip(ssh_map.dstates, ssh_map.fit.poses, strict=True)}
    found = {}
    for c in ssh_map.corridors:  # Each is turned and moved to the corrected positions.
        moved = EuclideanTransform()
        order = ssh_map.paths[c.path].order
        moved.estimate(np.array([at[p] for p in order]), np.array([where[p] for p in order]))
        found[f"{c.id} {c.order}"] = resampled(moved(np.array(c.line)), CELL)
    for name, line in lines.items():
        shares = {c: beside(line, other) for c, other in found.items()}
        best = max(shares, key=lambda c: shares[c])
        how = "whole" if shares[best] >= WHOLE else "broken" if shares[best] >= PART else "missed"
        counts[how] += 1
        print(f"  {name}: {how}, {shares[best]:.2f} of it is on corridor {best}")
    for c, line in found.items():
        if max(beside(line, other) for other in lines.values()) < PART:
            counts["false"] += 1
            print(f"  corridor {c}: false")
    return counts


def beside(line: Any, other: Any) -> float:
    """The share of the points of a line, (n, 2) metres, that are beside another line."""
    return float((cdist(line, other).min(axis=1) < BESIDE).mean())


def main(arguments: list[str]) -> None:
    """Print a line for each map, and one for all."""
    if arguments[0] == "--drawn":
        for folder in arguments[1:]:
            print(folder, dict(drawn(Path(folder))))
        return
    total, maps = Counter[str](), 0
    for plan, log, folder in zip(*(iter(arguments),) * 3, strict=True):
        spaces = ET.parse(plan).getroot().iter("space")
        labels = [space.findtext(".//labels/label") or "" for space in spaces]
        trace = Trace.load(Path(folder) / "trace.jsonl")
        ssh_map = with_building(Solution.load(Path(folder) / "maps.json").maps[0], trace)
        told = json.loads(Path(log).with_suffix(".truth.json").read_text())
        world = World(Building.of(Plan.load(plan)))
        counts = judged(ssh_map, trace, told, labels, world)
        total, maps = total + counts, maps + 1
        print(folder, dict(counts))
    pairs = total["in order"] + total["out of order"]
    tau = (total["in order"] - total["out of order"]) / pairs if pairs else None
    print(maps, "maps", dict(total), "tau", tau)


if __name__ == "__main__":
    main(sys.argv[1:])
