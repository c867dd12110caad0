"""Logs of several drives through one building: one map, and the drives over each other."""

from __future__ import annotations

import json
import math
import shutil
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from coarse import every_second_beam

from perception.errors import LogError
from perception.places import relations
from perception.places.closures import VisitMatch
from perception.places.importing import Imported, import_log, join_logs
from perception.places.local_map import CELL, LocalScene, Match, Patch
from perception.places.relations import DriveScenes, agreeing_matches, without_clashes
from perception.readers.scans import RobotLog
from perception.readers.writers import write_carmen
from simulator.tours import record
from simulator.world import World
from ssh_abduction.cli import main
from ssh_abduction.cli.import_log import digest, distinct
from ssh_abduction.cli.simulate import scans_of
from ssh_abduction.data import Closure, SSHMap, Trace, drives_of, together
from ssh_abduction.data.drives import starts_of
from ssh_abduction.data.odometry import Pose, displacement_between, moved
from ssh_abduction.evaluation import evaluate_visits
from ssh_abduction.output.layout import layout
from ssh_abduction.page.html import ground_in
from ssh_abduction.robot_logs import log_maps, log_report
from ssh_abduction.robot_logs.log_ground import ASIDE, laid_over
from ssh_abduction.robot_logs.log_maps import BARE, map_log
from ssh_abduction.solution import Solution
from ssh_abduction.solver import solve
from ssh_abduction.solver.sources.metric.joint_drives import Joining
from ssh_abduction.solver.steps.log import Log
from ssh_abduction.theory.settle import settle
from ssh_abduction.theory.theory import Theory

SHARED = 30  # scans that both drives have


@pytest.fixture(scope="module")
def halves() -> tuple[RobotLog, RobotLog]:
    """A drive through a house, cut into two that share a part."""
    scans = every_second_beam(scans_of(record(World.named("doors"), every=0.5)))
    middle = len(scans) // 2
    return RobotLog(scans[: middle + SHARED], source="monday"), RobotLog(
        scans[middle - SHARED :], source="tuesday"
    )


@pytest.fixture(scope="module")
def mapping(
    halves: tuple[RobotLog, RobotLog], tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, list[Imported]]:
    """The output of `map --together` for both drives, and the imports that it made."""
    parts = []

    def kept(*given: Any) -> Imported:
        parts.append(import_log(*given))
        return parts[-1]

    folder = tmp_path_factory.mktemp("logs")
    logs = []
    for log in halves:
        logs.append(str(folder / f"{log.source}.log"))
        write_carmen(Path(logs[-1]), log.scans)
    command = ["map", *logs, "--together", "-o", str(folder / "building"), "--time-limit", "2"]
    # The limit is of processor time, so that other processes do not shorten the search.
    processor = patch.object(time, "perf_counter", time.process_time)
    with processor, patch.object(log_maps, "import_log", kept):
        main([*command])
    return folder / "building", parts


@pytest.fixture(scope="module")
def folder(mapping: tuple[Path, list[Imported]]) -> Path:
    return mapping[0]


@pytest.fixture(scope="module")
def joint(
    halves: tuple[RobotLog, RobotLog], mapping: tuple[Path, list[Imported]]
) -> tuple[RobotLog, Imported, list[Imported]]:
    return *join_logs(halves, mapping[1]), mapping[1]


@pytest.mark.slow
def test_joint_logs_number_scans_and_visits_over_all_drives(
    joint: tuple[RobotLog, Imported, list[Imported]], halves: tuple[RobotLog, RobotLog]
) -> None:
    log, imported, parts = joint
    assert len(log) == sum(map(len, halves)) == len(imported.track.poses)
    assert imported.starts == (len(halves[0]),)
    assert set(imported.starts) <= set(imported.track.breaks)
    ways = [part.track.way[-1] for part in parts]
    assert imported.track.way[-1] == pytest.approx(sum(ways))
    assert [step.extra["visit"] for step in imported.trace][-1] == len(imported.visits) - 1
    for step in imported.trace:
        visit = imported.visits[step.extra["visit"]]
        robot = imported.track.poses[visit.scan]
        np.testing.assert_allclose(
            moved(tuple(robot), step.extra["seen"])[:2], visit.middle, atol=1e-3
        )
    doubted = replace(parts[0], track=replace(parts[0].track, is_reliable=False))
    assert imported.track.is_reliable
    assert not join_logs(halves, [doubted, parts[1]])[1].track.is_reliable


@pytest.fixture(scope="module")
def tours() -> list[RobotLog]:
    """Two tours through a world whose furniture makes places differ, a log for each."""
    scans = every_second_beam(scans_of(record(World.named("cluttered"), 2, every=1.0)))
    middle = len(scans) // 2
    return [RobotLog(scans[:middle], source="a"), RobotLog(scans[middle:], source="b")]


def are_right(closures: Sequence[Closure], trace: Trace) -> bool:
    """Whether closures agree with the true poses."""
    off = [
        displacement_between(
            displacement_between(*(trace[t].truth["pose"] for t in (one.first, one.last))),
            one.displacement,
        )
        for one in closures
    ]
    return all(math.hypot(x, y) < 0.5 and abs(turn) < math.radians(5) for x, y, turn in off)


@pytest.mark.slow
def test_drive_starts_where_the_odometer_does(tours: list[RobotLog]) -> None:
    """Closures connect the parts of a log, as those of two drives."""
    first, last = (log.scans for log in tours)
    anew = [
        replace(scan, odometry=displacement_between(last[0].odometry, scan.odometry))
        for scan in last
    ]
    found = import_log(RobotLog((*first, *anew), source="both"), name="both")
    (start,) = starts_of(found.trace)
    across = [c for c in found.trace.closures if c.first < start <= c.last]
    assert found.starts == (len(first),)
    assert [drive.name for drive in drives_of(found.trace)] == ["both", "both part 2"]
    assert len(across) >= 3
    assert are_right(across, found.trace)


@pytest.mark.slow
def test_closures_between_drives_match_the_truth(
    joint: tuple[RobotLog, Imported, list[Imported]],
    halves: tuple[RobotLog, RobotLog],
    tours: list[RobotLog],
) -> None:
    parts = [import_log(drive, name=drive.source) for drive in tours]
    trace = join_logs(tours, parts)[1].trace
    (start,) = starts_of(trace)
    found = [c for c in trace.closures if c.first < start <= c.last]
    assert len(found) >= 3
    assert are_right(found, trace)
    # The rooms of the house look alike, so that two relations of its halves are possible.
    assert len(joint[1].trace.closures) == sum(len(part.trace.closures) for part in joint[2])
    # Another building has no visits that agree.
    others = [parts[0], joint[2][0]]
    apart = join_logs([tours[0], halves[0]], others)[1].trace
    assert len(apart.closures) == sum(len(part.trace.closures) for part in others)


def test_relations_of_three_drives_agree() -> None:
    """Nothing else is needed of drives than the poses of their visits, here in one frame."""
    drives = [np.array([(5.0 * (k % 3), 7.0 * (k // 3), 0.0) for k in range(9)])] * 3

    def matched(off: float, *places: int) -> list[VisitMatch]:
        one: Any = SimpleNamespace(turn=0.0, shift=np.array([off, 0.0]), score=1.0)
        return [VisitMatch(k, k, one) for k in places]

    sure = {(0, 1): matched(0, *range(9)), (0, 2): matched(0, *range(6))}
    wrong, right = matched(30, 0, 3, 6), matched(0, 1, 4, 7)
    for found, expected in [(wrong, []), (wrong + right, right), (right + wrong[1:], right)]:
        assert agreeing_matches(drives, {**sure, (1, 2): found})[1, 2] == expected
    # Without the third drive, nothing says which relation is right.
    assert agreeing_matches(drives, {(1, 2): wrong}) == {(1, 2): wrong}
    assert agreeing_matches(drives, {(1, 2): wrong + right}) == {(1, 2): []}


@pytest.mark.parametrize(
    ("here", "elsewhere", "apart", "told"),
    [
        ((0.97,) * 4, (), 20.0, True),
        ((0.97,) * 3, (), 20.0, False),  # too few
        ((0.97,) * 4, (0.85,) * 4, 20.0, True),
        ((0.97,) * 4, (0.94,) * 4, 20.0, False),  # it may be there as well
        ((0.97,) * 4, (0.94,) * 4, 0.1, True),  # which is here
        ((0.97,) * 5, (0.97,) * 4, 20.0, True),  # the fifth tells
        ((0.97, 0.97, 0.97, 0.97, -0.97), (0.97,) * 4, 20.0, False),  # it is not clear itself
        ((0.85,) * 5, (0.97,) * 3, 20.0, False),  # fewer, but better
        ((-0.97, -0.97, 0.97, 0.97, 0.97, 0.97), (), 20.0, True),  # walls agree there, too
        ((-0.7, -0.7, 0.97, 0.97, 0.97, 0.97), (), 20.0, False),
    ],
)
def test_robot_is_located_where_walls_agree_best(
    here: tuple[float, ...],
    elsewhere: tuple[float, ...],
    apart: float,
    told: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A station with a negative score has no match of its own."""

    def agreement(score: float, x: float) -> Match:
        return Match(abs(score), 0.0, np.array([x, 0.0]), 1.0, 0.1)

    found = [
        VisitMatch(k, k, agreement(score, x))
        for x, scores in ((0.0, here), (20.0, elsewhere))
        for k, score in enumerate(scores)
        if score > 0
    ]
    poses = np.array([(0.0, 2.0 * k, 0.0) for k in range(len(here))])
    empty = [LocalScene(np.zeros((0, 2)), np.zeros((1, 1), np.uint16), np.zeros(2))] * len(here)
    drive = DriveScenes(empty, poses)

    def by_scores(relation: Any, *_: object) -> dict[int, Match]:
        """As if walls agreed as the scores say."""
        x, scores = (0.0, here) if relation.here[0, 0] == 0.0 else (apart, elsewhere)
        return {k: agreement(score, x) for k, score in enumerate(scores)}

    monkeypatch.setattr(relations, "_agreements", by_scores)
    agreed = relations._surest(found, drive, drive)
    assert agreed == ([one for one in found if one.match.shift[0] == 0.0] if told else [])


def test_relation_that_puts_walls_into_free_space_does_not_count() -> None:
    """Of three rooms in a row, the first two look alike, and the last one is wider."""
    poses = np.array([(8.0 * k, 0.0, 0.0) for k in range(3)])
    rooms = []
    for half in (20, 20, 30):
        rows, columns = np.indices((101, 101)) - 50
        far = np.maximum(abs(rows), abs(columns))
        corner = np.array([-50 * CELL, -50 * CELL])
        rooms.append(LocalScene.of(Patch(far < half, far == half, far < 0, corner), np.zeros(2)))

    def matched(first: int, last: int) -> VisitMatch:
        return VisitMatch(first, last, Match(1.0, 0.0, np.zeros(2), 1.0, 0.1))

    right, wrong = [matched(k, k) for k in range(3)], [matched(k + 1, k) for k in range(2)]
    drive = DriveScenes(rooms, poses)
    assert without_clashes([*wrong, *right], drive, drive) == right
    assert without_clashes(wrong, drive, drive) == []


@pytest.mark.slow
def test_join_logs_keeps_a_single_log(
    joint: tuple[RobotLog, Imported, list[Imported]], halves: tuple[RobotLog, RobotLog]
) -> None:
    part = joint[2][0]
    assert join_logs(halves[:1], [part]) == (halves[0], part)


@pytest.mark.slow
def test_places_that_fit_after_others_are_merged() -> None:
    """Some pairs of places fit only after other pairs have made the poses more certain."""
    logs = [
        RobotLog(tuple(scans_of(record(World.named("doors"), seed=seed))), source=f"tour {seed}")
        for seed in (1, 2)
    ]
    parts = [import_log(log, name=log.source) for log in logs]
    problem = settle(join_logs(logs, parts)[1].trace, BARE)
    joining = Joining(problem, Log(problem.trace, problem.theory, problem.pairs))
    *_, ssh_map = joining.maps()
    places = [
        {ssh_map.place_of(t) for t in range(drive.first, drive.stop)}
        for drive in drives_of(problem.trace)
    ]
    assert [len(some) for some in places] == [13, 13]
    assert len(places[0] & places[1]) == 11


@pytest.mark.slow
def test_map_together_joins_two_drives(folder: Path) -> None:
    run = json.loads((folder / "run.json").read_text())
    assert [drive["name"] for drive in run["drives"]] == ["monday", "tuesday"]
    assert [drive["source"][-4:] for drive in run["drives"]] == [".log"] * 2
    assert sum(drive["visits"] for drive in run["drives"]) == run["visits"]
    trace, solution = Trace.load(folder / "trace.jsonl"), Solution.load(folder / "maps.json")
    assert [drive.name for drive in drives_of(trace)] == ["monday", "tuesday"]
    assert trace.extra["beams"] == {"first": -90, "step": 1}
    (judged,) = evaluate_visits(solution.maps[:1], trace).maps
    assert judged.places.precision == 1.0
    ssh_map, (start,) = solution.maps[0], starts_of(trace)
    assert len(ssh_map.pieces) == 1
    # Steps of two drives within a metre of each other are at one place.
    near = [
        (i, j)
        for i in range(start)
        for j in range(start, len(trace))
        if math.dist(trace[i].truth["pose"][:2], trace[j].truth["pose"][:2]) < 1
    ]
    assert len(near) > 10
    assert all(ssh_map.place_of(i) == ssh_map.place_of(j) for i, j in near)


def test_report_shows_drives_and_their_joins(folder: Path) -> None:
    found = ground_in(folder / "page.html", len(Trace.load(folder / "trace.jsonl")))
    assert found is not None
    report = {section.title: section for section in found.sections}
    assert report["Drives"].lines == ["The map joins the 2 drives: monday, tuesday."]
    assert [row[0] for row in report["Drives"].table] == ["drive", "monday", "tuesday"]
    joins = report["Joins between drives"].table[1:]
    assert joins
    assert all(a.startswith("monday:") and b.startswith("tuesday:") for a, b, _ in joins)


def test_joint_run_of_the_same_logs_is_skipped(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    logs = [str(folder.parent / f"{name}.log") for name in ("monday", "tuesday")]
    command = ["map", *logs, "--together", "-o", str(folder), "--time-limit", "2"]
    assert main([*command]) == 0
    assert "2 logs: done already" in capsys.readouterr().out
    assert digest(logs) != digest(logs[::-1])


@pytest.mark.slow
def test_map_together_obeys_corrections(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A person denies a join between the drives, and names a place."""
    building = str(shutil.copytree(folder, tmp_path / "building"))
    trace, before = Trace.load(folder / "trace.jsonl"), Solution.load(folder / "maps.json").maps[0]
    start = starts_of(trace)[0]
    joined = next(
        t for t in range(start, len(trace)) if before.dstate_at[t] in before.dstate_at[:start]
    )
    first = before.dstate_at.index(before.dstate_at[joined])
    pair = f"monday:{first},tuesday:{joined - start}"
    assert main(["name", building, "monday:0", "kitchen"]) == 0
    assert main(["correct", building, "--different", pair]) == 0
    logs = [str(folder.parent / f"{name}.log") for name in ("monday", "tuesday")]
    settings = ["--together", "-o", building, "--time-limit", "5"]
    capsys.readouterr()
    main(["map", *logs, *settings])
    told = capsys.readouterr()
    assert "obeying 2 corrections of" in told.err
    assert "done already" not in told.out
    solution = Solution.load(Path(building) / "maps.json")
    assert solution.theory.different == ((first, joined),)
    ssh_map = solution.maps[0]
    assert ssh_map.dstate_at[first] != ssh_map.dstate_at[joined]
    assert ssh_map.name_of("place", ssh_map.place_of(0)) == "kitchen"
    assert main(["map", *logs, *settings]) == 0
    assert "2 logs: done already" in capsys.readouterr().out
    # A call that maps each log alone does not know of this folder's file.
    for log in logs:
        (tmp_path / Path(log).stem).mkdir()
        shutil.copy(Path(building) / "corrections.yaml", tmp_path / Path(log).stem)
    assert main(["map", *logs, "-o", str(tmp_path), "--time-limit", "5"]) == 1
    assert capsys.readouterr().out.count("expected no corrections, got") == 2


@pytest.fixture
def mapped(
    joint: tuple[RobotLog, Imported, list[Imported]], folder: Path
) -> tuple[Imported, list[Pose], SSHMap]:
    """The import of both drives, the poses of its track, and the map."""
    track = [tuple(pose) for pose in joint[1].track.poses.tolist()]
    return joint[1], track, Solution.load(folder / "maps.json").maps[0]


def test_joint_track_lays_drives_over_each_other(
    mapped: tuple[Imported, list[Pose], SSHMap],
) -> None:
    imported, track, ssh_map = mapped
    (start,) = imported.starts
    shared = range(start - 2 * SHARED, start)
    twins = [(scan, scan + 2 * SHARED) for scan in shared]  # each scan is in both drives

    def apart(poses: list[tuple[float, float, float]]) -> float:
        return max(math.dist(poses[a][:2], poses[b][:2]) for a, b in twins)

    assert apart(track) > 5
    laid = laid_over(imported, ssh_map)
    assert apart(laid) < 0.5
    # The drives nearly keep their shapes.
    for first, last in ((0, start - 1), (start, len(track) - 1)):
        np.testing.assert_allclose(
            displacement_between(laid[first], laid[last])[:2],
            displacement_between(track[first], track[last])[:2],
            atol=1,
        )
    beside = laid_over(imported, None)
    left, right = np.array(beside[:start]), np.array(beside[start:])
    assert right[:, 0].min() == pytest.approx(left[:, 0].max() + ASIDE)


def test_report_turns_drives_as_the_drawing_of_the_map_does(
    mapped: tuple[Imported, list[Pose], SSHMap],
) -> None:
    imported, track, ssh_map = mapped
    turned = np.array([moved((3.0, -7.0, 1.2), pose) for pose in track])
    laid = laid_over(imported, ssh_map)
    elsewhere = replace(imported, track=replace(imported.track, poses=turned))
    off = np.subtract(laid, laid_over(elsewhere, ssh_map))
    np.testing.assert_allclose(off[:, :2], np.broadcast_to(off[0, :2], (len(track), 2)), atol=1e-6)
    drawn = layout(ssh_map).places
    first, far = ssh_map.place_of(0), max(drawn, key=lambda p: math.dist(drawn[p], (0.0, 0.0)))
    ends = []
    for place in (first, far):
        step = next(t for t in range(len(imported.trace)) if ssh_map.place_of(t) == place)
        visit = imported.visits[imported.trace[step].extra["visit"]]
        ends.append(laid[visit.scan])
    way = np.subtract(ends[1], ends[0])[:2]
    onward = np.subtract(drawn[far], drawn[first])
    assert abs(np.angle(complex(*way) / complex(*onward))) < 0.2


def test_map_together_refuses_equal_names_and_several_jobs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for folder, text in (("a", "one"), ("b", "two")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "run.log").write_text(text)
    logs = [str(tmp_path / folder / "run.log") for folder in "ab"]
    out = ["--together", "-o", str(tmp_path / "building")]
    assert main(["map", *logs, *out]) == 1
    assert "expected a name different from" in capsys.readouterr().err
    assert main(["map", *logs, *out, "--jobs", "2"]) == 1
    assert "--jobs: expected no such option with --together" in capsys.readouterr().err
    assert distinct([logs[0], logs[1], logs[0]]) == ([*logs], [(logs[0], logs[0])])
    (tmp_path / "b" / "run.log").write_text("one")
    assert distinct(logs) == ([logs[0]], [(logs[1], logs[0])])


@pytest.mark.parametrize(
    ("given", "names", "said"),
    [
        ([], None, "log: expected at least one log, got none"),
        (["monday.log"], None, r"log\[0\]: expected a RobotLog, got 'monday.log'"),
        ([RobotLog(())], ["one", "two"], "name: expected 1, one per drive, got 2"),
    ],
)
def test_map_log_refuses_wrong_arguments(given: Any, names: Any, said: str) -> None:
    with pytest.raises(LogError, match=said):
        map_log(given, name=names)


def test_report_names_a_drive_that_shares_no_place() -> None:
    drives = [("monday", "ab"), ("tuesday", "xy")]
    with pytest.warns(UserWarning, match="no view in common"):
        joint = together([Trace.from_steps(views, ["travel"], name=name) for name, views in drives])
    run = {"drives": [{"scans": 9, "metres": 5.0, "visits": 2, "steps": 2}] * 2}
    imported: Any = SimpleNamespace(trace=joint)
    drives, joins = log_report._drives(imported, solve(joint, Theory.causal()), run)
    assert drives.lines == (
        "The map is in 2 pieces that share no place: monday alone; tuesday alone.",
    )
    assert joins.lines == ["monday and tuesday: nothing in common in any of the maps."]
    assert not joins.table
