"""The tools of `ssh-abduction mcp`, asked by the official client in this process."""

from __future__ import annotations

import asyncio
import json
import os
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from test_derived_paths import CROSS, TOUR, drive

from ssh_abduction.building.derive import with_building
from ssh_abduction.cli import main
from ssh_abduction.data.drives import fingerprints_of
from ssh_abduction.data.errors import AbductionError
from ssh_abduction.data.trace import Trace
from ssh_abduction.theory.theory import Theory

mcp = pytest.importorskip("mcp")

from ssh_abduction.cli import agent_desk  # noqa: E402
from ssh_abduction.cli.agent_desk import KnownMap, MapDesk, server_of  # noqa: E402

# Rooms: 0 has the corridor with places 0 to 3; 1 is place 4, left of it; 2 is place 5, right of it.
DOORS = [(1, 4), (2, 5)]
# The last rival takes the return to place 1 for a new place, and has probability 0.2.
PLACES = [0, 1, 2, 1, 3, 4, 3, 5, 3, 1, 0]
OTHER = [0, 1, 2, 1, 3, 4, 3, 5, 3, 6, 7]


@pytest.fixture
def house(tmp_path: Path) -> Path:
    """A folder as `map` writes it: a corridor with a room on each side, and a doubtful return."""
    ssh_map, bare = drive(CROSS, TOUR, doors=DOORS)
    trace = Trace(bare.steps, name="monday")
    folder = tmp_path / "house"
    folder.mkdir()
    trace.save(folder / "trace.jsonl")
    mapped = with_building(ssh_map, trace).renumbered()
    rivals = [
        {"nats": nats, "dstates": list(mapped.dstate_at), "places": places}
        for nats, places in ((10.0, PLACES), (11.3862944, OTHER))
    ]
    weighed = {"nats": 10.0, "bound": 5.0, "within": 0.0, "searched": True, "rivals": rivals}
    drives = [
        {"name": name, "first": 0, "stop": len(trace), "fingerprint": mark}
        for name, mark in fingerprints_of(trace).items()
    ]
    counts = {"dstates": len(mapped.dstates), "places": len(mapped.places), "paths": 0}
    made: dict[str, Any] = {
        "format": "ssh-solution",
        "version": 1,
        "theory": Theory.topological().to_dict(),
        "steps": len(trace),
        "maps": [mapped.to_dict()],
        "status": "feasible",
        "complete": False,
        "count": 1,
        "cost": counts,
        "weighed": weighed,
        "drives": drives,
    }
    (folder / "maps.json").write_text(json.dumps(made))
    (folder / "run.json").write_text("{}")
    return folder


def ask(folder: Path | list[Path], tool: str, *, write: bool = False, **given: Any) -> Any:
    """Ask one question. Returns the answer as plain data, or the text of an error."""

    async def asked() -> Any:
        folders = [str(f) for f in (folder if isinstance(folder, list) else [folder])]
        async with mcp.Client(server_of(MapDesk(folders, write=write))) as client:
            result = await client.call_tool(tool, given)
            return result.content[0].text if result.is_error else result.structured_content

    return asyncio.run(asked())


def test_rooms_corridors_doors_and_places_are_listed(house: Path) -> None:
    listed = ask(house, "list_rooms_and_places")
    assert [len(listed[kind]) for kind in ("corridors", "rooms", "doors", "places")] == [1, 3, 2, 6]
    assert listed["places"][2] | {"x": 5.0, "y": 6.0, "steps": [2]} == listed["places"][2]
    (building,) = ask(house, "list_buildings")["buildings"]
    assert building["building"] == "house"
    assert building["said"].startswith("6 places. ")


@pytest.mark.parametrize(
    ("tool", "given", "expected"),
    [
        ("beside", {"what": "corridor 0"}, {"rooms": [1, 2], "probability": 0.8}),
        ("beside", {"what": "room1"}, {"rooms": [0], "doors": [0]}),
        ("is_same", {"one": "room 1", "other": "step 2"}, {"same": True, "probability": 1.0}),
        ("is_same", {"one": "room 1", "other": "step 5"}, {"same": False, "probability": 1.0}),
        ("is_same", {"one": "p1", "other": "monday:9"}, {"same": True, "probability": 0.8}),
        ("is_same", {"one": "step 1", "other": "step 9"}, {"same": True, "probability": 0.8}),
        ("is_same", {"one": "p2", "other": "p3"}, {"same": False, "probability": 1.0}),
        ("find", {"what": "step 2"}, {"kind": "place", "number": 2, "room": 1}),
        ("find", {"what": "room 0"}, {"places": [0, 1, 3, 5]}),
        ("route", {"goal": "room 2", "start": "room1"}, {"from": "room 1", "to": "room 2"}),
        ("doubts", {}, {}),
    ],
)
def test_questions(house: Path, tool: str, given: dict[str, str], expected: dict[str, Any]) -> None:
    answer = ask(house, tool, **given)
    if tool == "doubts":
        assert {"steps": ["3", "9"], "place": 1, "probability": 0.8} in answer["joins"]
        return
    assert answer | expected == answer
    if tool == "is_same":
        sure = "sure" if expected["probability"] > 0.9 else "doubtful"
        assert answer["how_sure"].startswith(sure)
    if tool == "route":
        assert "through the door" in answer["said"]


def test_no_answer_is_sure_of_a_room_with_a_gap_as_narrow_as_a_door(house: Path) -> None:
    known = KnownMap.load(house)
    assert known.sureness(1.0, [0])["how_sure"].startswith("sure")
    narrow = {"widths": [[0.3, 0.4]]}
    steps = [replace(step, extra={**step.extra, **narrow}) for step in known.trace.steps]
    gap = replace(known, trace=replace(known.trace, steps=tuple(steps)))
    assert gap.sureness(1.0, [0]) == {
        "probability": 1.0,
        "how_sure": "doubtful: a gap as narrow as a door may divide room 0",
    }
    assert gap.sureness(0.5, [0])["how_sure"] == "doubtful: probability 0.50"


def test_a_reason_and_an_experiment_are_said(house: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(agent_desk, "SECONDS", 1.0)
    reason = ask(house, "why", one="step 1", other="step 9")
    assert "the probability of one place is 0.8" in reason["said"]
    assert "there is nothing to tell apart" in ask(house, "next_experiment")["said"]


@pytest.mark.parametrize(
    ("tool", "given", "said"),
    [
        ("find", {"what": "room 99"}, "the map has none of this number"),
        ("find", {"what": "kitchen"}, "expected a name of this map ("),
        ("find", {"what": "4"}, "write p4, d4 or monday:4"),
        ("find", {"what": "step 99"}, "expected"),
        ("is_same", {"one": "room 1", "other": "corridor 0"}, "expected two things of one kind"),
        ("why", {"one": "step 1", "other": "step 1"}, "expected two visits"),
        ("beside", {"what": "door 0"}, "expected a place, room or corridor"),
        ("beside", {"what": "room1", "building": "../x"}, "building: expected house, got '../x'"),
        ("name", {"what": "room1", "name": "x"}, "Unknown tool"),
    ],
)
def test_bad_questions(house: Path, tool: str, given: dict[str, str], said: str) -> None:
    assert said in ask(house, tool, **given)


def test_nothing_is_written_unless_asked_for(house: Path) -> None:
    before = {file: file.read_bytes() for file in house.iterdir()}
    for tool, given in (("doubts", {}), ("find", {"what": "p1"}), ("beside", {"what": "room1"})):
        ask(house, tool, **given)
    assert {file: file.read_bytes() for file in house.iterdir()} == before
    said = ask(house, "name", write=True, what="room 1", name="kitchen")["said"]
    assert "'kitchen'" in said
    (house / "run.json").rename(house / "drive.names")  # as in a folder of live
    for text in ("kitchen", "the Kitchen"):
        assert ask(house, "find", what=text).items() >= {"kind": "room", "number": 1}.items()
    said = ask(house, "correct", write=True, one="step 1", other="step 9", same=False)["said"]
    assert "to obey: ssh-abduction solve" in said
    assert "monday:9" in (house / "corrections.yaml").read_text()


def _another(folder: Path) -> None:
    (folder / "run.json").unlink()


def _empty(folder: Path) -> None:
    for file in folder.iterdir():
        file.unlink()


def _link(folder: Path) -> None:
    (folder / "maps.json").rename(folder.parent / "maps.json")
    (folder / "maps.json").symlink_to(folder.parent / "maps.json")


@pytest.mark.parametrize("change", [_another, _empty, _link])
def test_other_folders_are_refused(
    house: Path, change: Callable[[Path], None], capsys: pytest.CaptureFixture[str]
) -> None:
    change(house)
    assert main(["mcp", str(house)]) == 1
    assert "house" in capsys.readouterr().err
    with pytest.raises(AbductionError, match="got no folder"):
        MapDesk([str(house / "missing")])


def test_one_of_several_buildings_is_named(house: Path) -> None:
    other = house.rename(house.with_name("lab"))
    house.mkdir()
    for file in other.iterdir():
        (house / file.name).write_bytes(file.read_bytes())
    assert "expected house and lab, got ''" in ask([house, other], "find", what="p1")
    assert ask([house, other], "find", what="p1", building="lab")["number"] == 1
    with pytest.raises(AbductionError, match="twice"):
        MapDesk([str(house), str(house)])


@pytest.mark.slow
def test_the_server_answers_over_pipes(house: Path) -> None:
    async def asked() -> Any:
        words = ["-m", "ssh_abduction", "mcp", str(house)]
        server = mcp.StdioServerParameters(command=sys.executable, args=words, env={**os.environ})
        async with mcp.Client(mcp.stdio_client(server)) as client:
            return await client.call_tool("find", {"what": "p1"})

    assert asyncio.run(asked()).structured_content["number"] == 1
