"""A map grows while a robot drives: saved, restored, with numbers of places that last."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from http.client import HTTPConnection
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from coarse import every_second_beam, hall

from perception.errors import LogError
from perception.places import closures
from perception.places.importing import import_log
from perception.places.saved import SCANS, STATE
from perception.readers.scans import RobotLog, Scan
from perception.readers.writers import write_carmen
from simulator.tours import record
from simulator.world import World
from ssh_abduction.cli import main
from ssh_abduction.cli.simulate import scans_of
from ssh_abduction.data.errors import AbductionError, MapError, TraceError
from ssh_abduction.data.odometry import displacement_between, moved
from ssh_abduction.robot_logs import log_mapper
from ssh_abduction.robot_logs.live_page import LivePage
from ssh_abduction.robot_logs.log_mapper import (
    Event,
    FoundMap,
    LiveSession,
    MapSearch,
    OnlineLogMapper,
    RobotSeen,
    solved,
)


@pytest.fixture(scope="module")
def scans() -> tuple[Scan, ...]:
    """A drive of a tour through a hall, a scan of 90 beams every half metre."""
    return every_second_beam(hall(every=0.5)[:100])


@pytest.fixture(scope="module")
def house(scans: tuple[Scan, ...], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the state after 60 scans. Its program was killed while it wrote more."""
    folder = tmp_path_factory.mktemp("live") / "house"
    mapper = OnlineLogMapper()
    for i, scan in enumerate(scans[:60]):
        mapper.observe(scan)
        if i in (20, 59):
            mapper.save(folder)
    with (folder / SCANS).open("ab") as file:
        file.write(b"half a row")
    return folder


def test_saved_drive_goes_on_as_if_it_had_not_ended(scans: tuple[Scan, ...], house: Path) -> None:
    mapper = OnlineLogMapper.load(house)
    assert len(mapper) == 60
    for scan in scans[60:]:
        mapper.observe(scan)
    done, whole = mapper.finish(), import_log(RobotLog(scans))
    assert done.trace.steps == whole.trace.steps
    assert done.trace.closures == whole.trace.closures
    assert done.poses.tolist() == whole.poses.tolist()


def test_expected_visits_are_matched_once(house: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    live = OnlineLogMapper.load(house).live
    for scan in every_second_beam(hall(every=0.5)[60:140]):
        live.add(scan)
    first = live.grown()
    assert live._closures._matches
    monkeypatch.setattr(closures, "match", None)
    again = live.grown()
    assert [vars(one) for one in again.closings] == [vars(one) for one in first.closings]


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (
            lambda data: data.replace(b'"version": 2', b'"version": 9'),
            ": expected a state of version 2, got 9; move it away, and start anew$",
        ),
        (lambda data: b"something", ": expected a state of version 2, got another file; move it"),
        (lambda data: data[:-5], "got a damaged file"),
        (None, "No such file"),
    ],
)
def test_other_states_are_refused(
    change: object, told: str, house: Path, tmp_path: Path, scans: tuple[Scan, ...]
) -> None:
    for file in house.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    state = tmp_path / STATE
    if callable(change):
        state.write_bytes(change(state.read_bytes()))
    else:
        state.unlink()
    with pytest.raises(LogError, match=told) as caught:
        OnlineLogMapper.load(tmp_path)
    assert str(caught.value).count("expected") == 1


def test_search_gives_a_map_and_a_belief(scans: tuple[Scan, ...]) -> None:
    mapper = OnlineLogMapper()
    for scan in scans[:99]:
        assert not mapper.observe(scan).belief
    assert mapper.is_due
    made = solved(mapper.task(work=1.0))
    assert made is not None
    lines = made.files["trace.jsonl"].decode().splitlines()
    assert lines == [*mapper.finish("live").trace.to_lines()]  # with its widths and doors
    # The way of the robot, in the frame of the places, passes each of them.
    way = [moved(made.ground["frame"], (x, y, 0.0))[:2] for x, y in made.ground["way"]]
    for place in made.poses[:, :2].tolist():
        assert min(math.dist(place, point) for point in way) < 1.0
    events = mapper.accept(made)
    assert [event.kind for event in events] == ["new"] * len(events)
    assert {place["place"] for place in mapper.to_dict()["places"]} == set(range(len(events)))
    assert not mapper.is_due
    sure = mapper.to_dict()["sure"]
    assert sure["bound"] <= sure["nats"]
    # A person says that two visits far apart are at one place, and takes it back.
    places = mapper.to_dict()["places"]
    first, second = places[0]["scans"][0], places[2]["scans"][0]
    mapper.correct("same_place", first, second)
    assert mapper.is_due
    with pytest.raises(LogError, match="expected corrections that a map can obey"):
        solved(mapper.task(work=1.0))
    mapper.correct("elsewhere", second, first)
    assert mapper.accept(solved(mapper.task(work=1.0))) == []
    assert not mapper.is_due
    seen = mapper.observe(scans[99])
    assert isinstance(seen, RobotSeen)
    assert seen.on_map is not None
    assert sum(seen.belief.values()) <= 1.0


def found(*places: int, x: float = 0.0) -> FoundMap:
    """A map of visits at scans 0, 10, … to these places, with place n at (10 n + x, 0)."""
    poses = np.array([(10.0 * place + x, 0.0, 0.0) for place in places])
    scans = tuple(10 * k for k in range(len(places)))
    return FoundMap(scans, places, poses, poses[:, :2], "feasible", {})


@pytest.mark.parametrize(
    ("maps", "numbers", "events"),
    [
        # A map may number its places anew: the places keep their numbers.
        ([found(0, 1, 0), found(1, 0, 1, 2)], [0, 1, 0, 2], [Event("new", 2)]),
        # Of two places that are joined, the older number stays.
        ([found(0, 1, 1), found(5, 5, 5)], [0, 0, 0], [Event("joined", 0, 1), Event("moved", 0)]),
        # A join that is taken back: the number that rested returns.
        ([found(0, 1, 1), found(0, 0, 0), found(0, 1, 1)], [0, 1, 1], [Event("retracted", 1, 0)]),
        # The visits since a join do not take the number along.
        (
            [found(0, 1), found(0, 0, 0, 0), found(0, 1, 1, 1)],
            [0, 1, 1, 1],
            [Event("retracted", 1, 0)],
        ),
        # A number that rests is not given to another place.
        ([found(0, 1), found(0, 0), found(0, 0, 1)], [0, 0, 2], [Event("new", 2)]),
        ([found(0, 1), found(0, 1, x=3.0)], [0, 1], [Event("moved", 0), Event("moved", 1)]),
    ],
)
def test_numbers_of_places_last(
    maps: list[FoundMap], numbers: list[int], events: list[Event]
) -> None:
    mapper = OnlineLogMapper()
    for one in maps:
        said = mapper.accept(one)
    last = mapper._names.place_of
    assert [last[10 * k] for k in range(len(numbers))] == numbers
    assert [event for event in said if event in events] == events


def test_next_is_the_least_sure_join() -> None:
    mapper = OnlineLogMapper()
    assert mapper.next() == "it is not known yet which joins are doubtful"
    doubtful = [{"scans": [0, 20], "probability": 0.9}]
    rivals = [{"probability": 0.4, "joined": [[10, 30]], "apart": []}]
    mapper.accept(replace(found(0, 1, 0, 2), sure={"doubtful": doubtful, "rivals": rivals}))
    assert mapper.next().startswith("drive through place 2: the visits of scans 10 and 30")
    mapper.accept(replace(found(0, 1, 0, 2), sure={"doubtful": doubtful, "rivals": []}))
    assert mapper.next().endswith("at one place with probability 0.90")
    rivals[0]["probability"] = 0.0001
    mapper.accept(replace(found(0, 1, 0, 2), sure={"doubtful": [], "rivals": rivals}))
    assert mapper.next() == "no join is doubtful"


def test_names_are_those_of_one_place() -> None:
    mapper = OnlineLogMapper()
    mapper.accept(found(0, 1))
    assert str(mapper.name(0, " hall ")) == "place 0 was renamed"
    for place, text in ((1, "hall"), (1, ""), (1, "p0"), (1, "a\nb"), (2, "den")):
        with pytest.raises(AbductionError, match="expected"):
            mapper.name(place, text)
    assert [place["name"] for place in mapper.to_dict()["places"]] == ["hall", None]


def test_scans_without_ranges_or_odometry_are_refused(scans: tuple[Scan, ...]) -> None:
    mapper = OnlineLogMapper()
    mapper.observe(scans[0])
    bad: list[Any] = [
        replace(scans[1], ranges=np.zeros(0)),
        replace(scans[1], ranges=scans[1].ranges[:7]),
        replace(scans[1], odometry=(math.nan, 0.0, 0.0)),
        3,
    ]
    for one in bad:
        with pytest.raises(LogError, match=r"scan: expected .*, got .*; "):
            mapper.observe(one)
    mapper.observe(scans[1])  # nothing is lost
    assert len(mapper) == 2


def test_corrections_of_other_scans_are_refused() -> None:
    mapper = OnlineLogMapper()
    mapper.accept(found(0, 1, 2))
    pairs = ("elsewhere", 0, 11), ("elsewhere", 0, 0), ("same_place", "a", 0)
    bad: list[Any] = [("alike", 0, 10), *pairs]
    for kind, first, second in bad:
        with pytest.raises(LogError, match="expected"):
            mapper.correct(kind, first, second)
    assert not mapper.is_due


def test_visits_are_shown_before_there_is_a_map(scans: tuple[Scan, ...]) -> None:
    mapper = OnlineLogMapper()
    for scan in scans[:40]:
        mapper.observe(scan)
    shown = mapper.to_dict()
    assert shown["places"] == []
    assert len(shown["provisional"]) >= 2
    mapper.accept(replace(found(0, 1), scans=(0, 1000)))  # a map of all visits so far
    assert mapper.to_dict()["provisional"] == []


def test_folder_that_cannot_be_written_is_told_once(
    scans: tuple[Scan, ...], tmp_path: Path
) -> None:
    (tmp_path / "file").touch()
    said: list[str] = []
    session = LiveSession(OnlineLogMapper(), tmp_path / "file" / "house", said.append)
    for scan in scans[:3]:
        session.take(scan)
        session.save()
    (line,) = said
    assert "cannot be written" in line


def test_a_new_drive_leaves_no_file_of_the_last_one_beside_it(
    scans: tuple[Scan, ...], tmp_path: Path
) -> None:
    said: list[str] = []
    session = LiveSession(OnlineLogMapper(), tmp_path, said.append)
    session.restart(OnlineLogMapper())  # nothing was saved yet
    assert not [*tmp_path.iterdir()]
    for drive in (1, 2):
        session.page = b"old"
        (tmp_path / "page.html").write_text(f"map of drive {drive}")
        for scan in scans[: 3 * drive]:
            session.take(scan)
        session.restart(OnlineLogMapper())
        assert session.page is None
        assert not OnlineLogMapper.is_saved(tmp_path)
        aside = tmp_path / f"before-{drive}"
        assert len(OnlineLogMapper.load(aside)) == 3 * drive
        assert (aside / "page.html").read_text() == f"map of drive {drive}"
    assert {file.name for file in tmp_path.iterdir()} == {"before-1", "before-2"}
    session.take(scans[0])
    session.save()
    assert len(OnlineLogMapper.load(tmp_path)) == 1
    assert not said


def test_replay_keeps_the_folder_of_another_program(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "maps.json").write_text("{}")
    call = ["live", "--replay", str(tmp_path / "a.log"), "--save", str(tmp_path)]
    assert main(call) == 1
    assert "got maps.json, which is not of map" in capsys.readouterr().err
    assert (tmp_path / "maps.json").read_text() == "{}"
    (tmp_path / "run.json").write_text('{"format": "ssh-run"}')
    assert main(call) == 1
    assert "or one that live saved to, got one that map wrote" in capsys.readouterr().err


@pytest.mark.slow
def test_replay_keeps_a_state_that_it_cannot_read(
    scans: tuple[Scan, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Also without the names, which older versions did not save."""
    write_carmen(tmp_path / "a.log", [replace(scan, corrected=None) for scan in scans[:4]])
    (tmp_path / STATE).write_text("{}")
    main(["live", "--replay", str(tmp_path / "a.log"), "--save", str(tmp_path)])
    assert "the map is kept in memory, and not saved" in capsys.readouterr().err
    assert (tmp_path / STATE).read_text() == "{}"


@pytest.mark.slow
def test_replayed_log_is_mapped_and_goes_on(
    scans: tuple[Scan, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_carmen(tmp_path / "a.log", [replace(scan, corrected=None) for scan in scans[:50]])
    house = str(tmp_path / "house")
    call = ["live", "--replay", str(tmp_path / "a.log"), "--save", house, "--work", "0.1"]
    assert main(call) == 0
    first = capsys.readouterr().out
    assert "place 0 is new" in first
    assert "places after 50 scans" in first
    assert {"maps.json", "page.html", "trace.jsonl"} <= {
        file.name for file in Path(house).iterdir()
    }
    assert main(call) == 0
    assert "the drive goes on after 50 scans" in capsys.readouterr().out


def test_page_shows_the_robot_to_this_computer_only(scans: tuple[Scan, ...]) -> None:
    session = LiveSession(OnlineLogMapper(), None, print)
    session.mapper.accept(found(0, 1, 2))
    page = LivePage(0, session)
    port = page.server_address[1]

    def answer(path: str, host: str) -> tuple[int, bytes]:
        asked = HTTPConnection("127.0.0.1", port)
        asked.request("GET", path, headers={"Host": host})
        given = asked.getresponse()
        return given.status, given.read()

    here = f"127.0.0.1:{port}"
    assert b"<svg" in answer("/", here)[1]
    assert json.loads(answer("/state", here)[1])["robot"] is None
    session.take(scans[0])
    assert session.tick()
    state = json.loads(answer("/state", here)[1])
    assert state["robot"] == [0.0, 0.0, 0.0]
    assert state["trail"] == [[0.0, 0.0]]
    # What the laser saw, at most 15 m away.
    seen = scans[0].ends((0.0, 0.0, 0.0), 15.0)
    assert 0 < len(state["laser"]) <= len(seen)
    assert all(np.min(np.hypot(*(seen - point).T)) < 0.01 for point in state["laser"])
    assert json.loads(answer("/ground", here)[1]) == {}
    assert state["edges"] == [[0, 1], [1, 2]]
    assert answer("/page.html", here)[0] == 404
    assert answer("/state", "example.org")[0] == 404
    session.mapper.lift()
    session.take(scans[10])  # now the robot may be anywhere on the map
    assert json.loads(answer("/state", here)[1])["robot"] is None
    with pytest.raises(MapError, match="expected a free port"):
        LivePage(port, session)
    page.shutdown()
    page.server_close()


def test_error_of_a_search_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object, watch: object) -> None:
        raise TraceError("no such step")

    monkeypatch.setattr(log_mapper, "in_process", fails)
    search = MapSearch()
    search.begin(OnlineLogMapper().task())
    assert search.taken(5.0) is None
    assert search.error == "no such step"
    assert not search.is_busy
    session = LiveSession(OnlineLogMapper(), None, print)
    for _ in range(2):  # topics and the page tell it, once
        session._search.error = search.error
        session.tick()
    assert session.events == ["no new map: no such step"]


def test_lifted_robot_has_no_position_until_closures_show_it(scans: tuple[Scan, ...]) -> None:
    mapper = OnlineLogMapper()
    for scan in scans[:30]:
        mapper.observe(scan)
    mapper.accept(found(0, 1, 2))
    assert mapper.observe(scans[30]).on_map is not None
    mapper.lift()
    for located in (False, True):
        seen = mapper.observe(scans[10])  # another place, and the odometry starts there
        assert (seen.on_map, dict(seen.belief)) == (None, {})
        mapper.accept(replace(found(0, 1, 2, 0), scans=(0, 10, 20, 31), located=located))
    assert mapper.observe(scans[10]).on_map is not None
    assert mapper.live.grown().track.breaks == (31,)
    assert mapper.finish().track.breaks == (31,)


@pytest.mark.slow
def test_lifted_robot_is_located_by_what_it_sees() -> None:
    """The second drive begins elsewhere, with odometry that starts anew."""
    scans = list(scans_of(record(World.named("cluttered"), every=0.5)))[:160]
    mapper = OnlineLogMapper()
    poses = [mapper.observe(scan).pose for scan in scans]
    mapper.accept(found(0))
    mapper.lift()
    late = found(0, 0)  # a search that began before the robot was lifted
    mapper.accept(late)
    begin, way, seen = 5, 0.0, None
    for k in range(begin, len(scans)):
        way += math.dist(scans[k].odometry[:2], scans[max(k - 1, begin)].odometry[:2])
        onward = displacement_between(scans[begin].odometry, scans[k].odometry)
        seen = mapper.observe(replace(scans[k], odometry=moved((5.0, 5.0, 2.0), onward)))
        if seen.on_map is not None:
            break
    assert seen is not None
    assert seen.on_map is not None
    assert 5 < way < 15
    assert seen.on_map == pytest.approx(poses[k], abs=0.1)
