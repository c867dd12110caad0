"""Whether an agent gets true answers about a building, by the tools of `ssh-abduction mcp`.

A robot drives through a simulated building. Its truth is known. The official client of the Model
Context Protocol asks about fifty questions about the map. Usage:

    python benchmarks/agent_questions.py LOG.log MAPS [LOG.log MAPS ...]

LOG.log is a log that `simulate PLAN.xml --format carmen` wrote, with its truth beside it. MAPS is
the folder that `map` wrote; names are given in a copy of it. An answer is sure if it says so, as
in "sure: probability 0.99". The questions are:

* "Is room 4 the room I saw at step 90?", for pairs of a room of the map and a step. It is true if
  most visits to the room were in the true room of the step.
* "Is place 4 the place I saw at step 90?". It is true if the step is less than 1.5 m from the
  middle of most visits to the place.
* "Which rooms are beside corridor 2, or room 3?". The true rooms are those that share a door with
  it through which the robot drove. The answer claims that the rooms which it names are beside it,
  not that they are all. So it is sure and wrong only if it names a wrong room.
* "Where is the kitchen?", after rooms got the names of their true rooms.
* "What is doubtful?". It is right if each false join of the map is listed.
"""

from __future__ import annotations

import asyncio
import json
import math
import random
import shutil
import sys
import tempfile
from collections import Counter, defaultdict
from collections.abc import AsyncIterator
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcp import Client

from ssh_abduction import Trace
from ssh_abduction.cli.agent_desk import MapDesk, server_of
from ssh_abduction.data.groups import gathered

NEAR = 1.5  # metres between two visits to one place
ROOMS, PLACES, NAMES = 24, 10, 8  # the questions of each kind


class Asked(NamedTuple):
    """A question with its answer."""

    kind: str
    question: str
    right: bool
    sure: bool


class TruthOfDrive:
    """Where the robot truly was at each step."""

    def __init__(self, log: Path, trace: Trace) -> None:
        told = json.loads(log.with_suffix(".truth.json").read_text())
        scans = [int(step.extra["scan"]) for step in trace.steps]
        self.room: list[str | None] = [told["scans"][scan] for scan in scans]
        self.at = np.array([step.truth["pose"][:2] for step in trace.steps])
        self.beside: dict[str, set[str]] = defaultdict(set)
        for one, other in [told["doors"][x["door"]]["rooms"] for x in told["crossings"]]:
            self.beside[one].add(other)
            self.beside[other].add(one)


async def asked(client: Client, truth: TruthOfDrive, seed: int) -> AsyncIterator[Asked]:
    """Ask the questions about one building."""
    chance = random.Random(seed)

    async def ask(tool: str, **given: Any) -> dict[str, Any]:
        result = await client.call_tool(tool, given)
        assert not result.is_error, (tool, given, result.content)
        return dict(result.structured_content or {})

    def is_sure(answer: dict[str, Any]) -> bool:
        return answer["how_sure"].startswith("sure")

    listed = await ask("list_rooms_and_places")
    places = {place["place"]: place for place in listed["places"]}

    def true_room(numbers: list[int]) -> str | None:
        seen = Counter(truth.room[t] for p in numbers for t in places[p]["steps"] if truth.room[t])
        return seen.most_common(1)[0][0] if seen else None

    rooms = {room["id"]: true_room(room["places"]) for room in listed["rooms"]}
    steps = [t for t, room in enumerate(truth.room) if room]
    for k in range(ROOMS):
        step = chance.choice(steps)
        known = [number for number, name in rooms.items() if name]
        alike = [number for number in known if rooms[number] == truth.room[step]]
        number = chance.choice(alike if alike and k % 2 else known)
        answer = await ask("is_same", one=f"room {number}", other=f"step {step}")
        right = answer["same"] == (rooms[number] == truth.room[step])
        yield Asked("room at step", f"room {number}, step {step}: {answer}", right, is_sure(answer))
    middles = {p: np.median(truth.at[place["steps"]], axis=0) for p, place in places.items()}
    for k in range(PLACES):
        step = chance.randrange(len(truth.at))
        near = min(places, key=lambda p: math.dist(middles[p], truth.at[step]))
        number = near if k % 2 else chance.choice([*places])
        away = math.dist(middles[number], truth.at[step])
        answer = await ask("is_same", one=f"p{number}", other=f"step {step}")
        # Places may be near each other, so a step that is near a place may be at another one.
        right = away < NEAR if answer["same"] else number != near or away > NEAR / 2
        yield Asked("place at step", f"p{number}, step {step}: {answer}", right, is_sure(answer))
    things = [(f"corridor {c['id']}", true_room(c["order"])) for c in listed["corridors"]]
    named = [(f"room {number}", name) for number, name in rooms.items() if name]
    for what, name in things + chance.sample(named, min(NAMES, len(named))):
        answer = await ask("beside", what=what)
        found = {rooms[number] for number in answer["rooms"]}
        right = found == truth.beside[name or ""]
        wanted = sorted(truth.beside[name or ""])
        said = f"{what} is {name}: {wanted} {sorted(map(str, found))} {answer}"
        sure = is_sure(answer) and not (found < truth.beside[name or ""])
        yield Asked("beside " + what.split()[0], said, right, sure)
    by_name = gathered((name, number) for number, name in rooms.items() if name)
    once = [name for name in by_name if len(by_name[name]) == 1]
    for name in chance.sample(once, min(NAMES, len(once))):
        await ask("name", what=f"room {by_name[name][0]}", name=f"the {name}")
        answer = await ask("find", what=f"the {name}")
        right = (answer["kind"], answer["number"]) == ("room", by_name[name][0])
        yield Asked("find by name", f"{name}: {answer}", right, False)
    doubts = {tuple(map(int, join["steps"])) for join in (await ask("doubts"))["joins"]}
    joins = {pair for place in places.values() for pair in pairwise(place["steps"])}
    false = {(t, u) for t, u in joins if math.dist(truth.at[t], truth.at[u]) > 2 * NEAR}
    yield Asked("doubts", f"false joins {false}, doubts {doubts}", false <= doubts, bool(false))


async def answers_for(log: Path, folder: Path, seed: int = 0) -> list[Asked]:
    """Ask the questions about a building, and return them with their answers."""
    trace = Trace.load(folder / "trace.jsonl")
    with tempfile.TemporaryDirectory() as copy:
        shutil.copytree(folder, Path(copy) / folder.name)
        desk = MapDesk([str(Path(copy) / folder.name)], write=True)
        async with Client(server_of(desk)) as client:
            return [one async for one in asked(client, TruthOfDrive(log, trace), seed)]


def main(arguments: list[str]) -> None:
    """Print the wrong answers, and a line for each building."""
    for log, folder in zip(*(iter(arguments),) * 2, strict=True):
        answers = asyncio.run(answers_for(Path(log), Path(folder)))
        kinds = gathered((one.kind, one) for one in answers)
        for one in answers:
            if not one.right:
                print("  WRONG AND SURE" if one.sure else "  wrong", one.kind, one.question)
        by_kind = ", ".join(f"{k} {sum(o.right for o in v)} of {len(v)}" for k, v in kinds.items())
        right, sure = (sum(getattr(one, name) for one in answers) for name in ("right", "sure"))
        wrong = sum(one.sure and not one.right for one in answers)
        print(f"{folder}: {right} of {len(answers)} right, {sure} sure, {wrong} sure and wrong")
        print(f"  {by_kind}")


if __name__ == "__main__":
    main(sys.argv[1:])
