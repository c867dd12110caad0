"""From a robot's log to the map of a building, for simulated logs and for real ones if present."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from coarse import every_second_beam
from coarse import hall as drive_through_hall
from scipy.spatial import cKDTree
from test_plans import DOORS, MIDDLES, plan_of, xml
from visited import Truth

from perception.errors import LogError
from perception.places.following import follow
from perception.places.importing import Imported, import_log
from perception.places.track import Track
from perception.readers.logs import read_log
from perception.readers.scans import LaserScanner, RobotLog, Scan
from perception.readers.writers import write_carmen
from perception.store import load
from simulator.rounds import record_plan
from ssh_abduction import AbductionError, Theory
from ssh_abduction.cli import main
from ssh_abduction.cli.jobs import answers_here
from ssh_abduction.cli.mapping import MapQuestion
from ssh_abduction.cli.outcome import StopFlag
from ssh_abduction.cli.simulate import scans_of
from ssh_abduction.data.odometry import displacement_between
from ssh_abduction.data.trace import Trace
from ssh_abduction.evaluation import evaluate_visits
from ssh_abduction.page.html import CONTENT
from ssh_abduction.robot_logs import log_maps
from ssh_abduction.robot_logs.log_maps import (
    SPEED,
    LogMap,
    LogMapping,
    how_it_ended,
    map_log,
    seconds_driven,
    work_for,
)
from ssh_abduction.runtime import workers
from ssh_abduction.solution import Solution, Status
from ssh_abduction.solution.recorded import Support
from ssh_abduction.solver import solve

SCANS = 110
REAL = Path(__file__).parents[2] / "shared" / "data" / "logs"


@pytest.fixture(scope="module")
def hall(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Most of a tour through the hallway, as a CARMEN log: into and out of both side hallways."""
    path = tmp_path_factory.mktemp("logs") / "hall.log"
    write_carmen(path, drive_through_hall()[:SCANS])
    return path


@pytest.fixture(scope="module")
def imported_hall(hall: Path) -> Imported:
    return import_log(read_log(hall))


@pytest.fixture(scope="module")
def runs(hall: Path, in_this_process: Callable[[], AbstractContextManager[object]]) -> Path:
    """The output of `map` for it, and for a log that cannot be read."""
    bad = hall.with_name("bad.log")
    bad.write_text("nothing\n")
    words = ["-o", str(hall.parent / "runs"), "--time-limit", "1000"]
    with in_this_process():
        assert main(["map", str(hall), str(bad), *words]) == 1
    return hall.parent / "runs"


def test_log_without_a_map_has_a_page_of_its_drive(map_of_round: LogMap) -> None:
    none = {"status": Status.UNSATISFIABLE, "maps": (), "cost": None, "shared": None}
    solution = replace(map_of_round.solution, **none, support=Support(), levels=())
    found = replace(map_of_round, solution=solution).files()
    assert "recogniser.skops" not in found
    page = found["page.html"].decode()
    assert "No map. The drive is shown alone." in page
    content = CONTENT.search(page)
    assert content is not None
    ground = json.loads(content[1])["ground"]
    assert len(ground["spots"]) == len(map_of_round.imported.trace)
    assert ground["scans"]["images"]


def test_scan_matching_corrects_the_odometry(hall: Path) -> None:
    log = read_log(hall)
    track = follow(log)
    true = [scan.corrected for scan in log.scans]

    def off(poses: object, i: int, j: int) -> float:
        went = displacement_between(
            displacement_between(true[i], true[j]),
            displacement_between(tuple(poses[i]), tuple(poses[j])),
        )  # type: ignore[index, arg-type]
        return math.hypot(*went[:2])

    last = len(log) - 1
    assert off(track.poses, 0, last) < 0.3 * off([scan.odometry for scan in log.scans], 0, last)
    closing = np.array([track.covariances[i] for i in range(1, len(log))])
    assert np.allclose(closing, closing.swapaxes(1, 2))
    assert (np.linalg.eigvalsh(closing) > 0).all()


@pytest.mark.parametrize(
    "words",
    [
        "check",
        "compare",
        "explain FOLDER 0 1",
        pytest.param("explain FILE 0 1", marks=pytest.mark.slow),
        "view -o PAGE",
        "localise",
    ],
)
def test_verbs_accept_the_folder_of_a_map(
    runs: Path, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    verb, *others = words.replace("PAGE", str(tmp_path / "page.html")).split()
    hall = runs / "hall"
    maps, trace = str(hall / "maps.json"), str(hall / "trace.jsonl")
    if verb == "explain":
        short = ["explain", str(hall) if others[0] == "FOLDER" else maps, "0", "1"]
        full = ["explain", trace, "0", "1", "--theory", maps]
    elif verb == "localise":
        short, full = [verb, str(hall), str(hall)], [verb, maps, trace]
    else:
        traces = [] if verb in ("show", "compare") else [trace]
        short, full = [verb, str(hall), *others], [verb, maps, *traces, *others]
    code = main(short)
    said = capsys.readouterr()
    assert main(full) == code
    assert capsys.readouterr().out == said.out
    assert said.out


@pytest.mark.slow
def test_explain_prints_the_probability_of_a_join(
    runs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The listed maps, and nothing else, say how probable it is that the steps are at one place."""
    weighed = Solution.load(runs / "hall" / "maps.json").weighed
    assert weighed is not None
    first, second, probability = weighed.joins[0]
    for i, j, is_one in ((first, second, True), (0, second, weighed.rivals[0].places[second] == 0)):
        assert main(["explain", str(runs / "hall"), str(i), str(j), "--json"]) == 0
        told = json.loads(capsys.readouterr().out)["map"]
        assert told["same_place"] == is_one
        assert told["probability"] == pytest.approx(weighed.probability(i, j, "place"))
        if (i, j) == (first, second):
            assert told["probability"] == pytest.approx(probability)
    main(["explain", str(runs / "hall"), str(first), str(second)])
    assert capsys.readouterr().out.startswith("in map 1, the steps are at one place, place ")


def test_check_asks_for_a_trace_if_none_is_beside_the_maps(
    runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    alone = tmp_path / "maps.json"
    alone.write_bytes((runs / "hall" / "maps.json").read_bytes())
    assert main(["check", str(alone)]) == 1
    assert "trace: expected the trace of" in capsys.readouterr().err


def test_import_makes_a_trace_of_the_places_passed(runs: Path) -> None:
    trace = Trace.load(runs / "hall" / "trace.jsonl")
    # Each visit has one step or two: the robot goes on straight, or it turns.
    visits = [step.extra["visit"] for step in trace]
    assert visits == sorted(visits)
    assert max(visits.count(visit) for visit in set(visits)) == 2
    for i, action in enumerate(trace.actions):
        assert (action.kind == "turn") == (visits[i] == visits[i + 1])
    # The trajectory agrees with the truth, within a few standard deviations of the displacement.
    for i, (before, after) in enumerate(zip(trace.steps[:-1], trace.steps[1:], strict=True)):
        error = np.array(
            displacement_between(
                displacement_between(before.truth["pose"], after.truth["pose"]), after.displacement
            )
        )
        covariance = np.array(trace.covariance(i + 1))
        assert error @ np.linalg.solve(covariance, error) < 30


def test_map_of_a_drive_has_perfect_place_precision(runs: Path) -> None:
    folder = runs / "hall"
    assert {path.name for path in folder.iterdir()} == {
        "trace.jsonl",
        "maps.json",
        "page.html",
        "recogniser.skops",
        "run.json",
    }
    (judged,) = evaluate_visits(
        Solution.load(folder / "maps.json").maps[:1], Trace.load(folder / "trace.jsonl")
    ).maps
    assert (judged.places.precision, judged.places.recall) == (1.0, 1.0)
    run = json.loads((folder / "run.json").read_text())
    assert set(run["seconds"]) >= {"track", "places", "trace", "views", "maps"}
    report = (folder / "page.html").read_text()
    assert "path_order=total; star=none; " in report
    assert "prefer=dstates,places,paths; " in report


def test_stored_recogniser_recognises_another_drive(
    runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    trace = Trace.load(runs / "hall" / "trace.jsonl")
    labels = Solution.load(runs / "hall" / "maps.json").maps[0].labels
    stored = load(runs / "hall" / "recogniser.skops")
    assert stored.predict([step.image for step in trace]).tolist() == list(labels)
    # On another drive the laser has other noise, and the first steps are missing.
    noise = np.random.default_rng(1)
    steps = [
        replace(step, image=tuple(np.abs(step.image + noise.normal(0, 0.02, len(step.image)))))
        for step in trace.steps[3:]
    ]
    assert np.mean(stored.predict([s.image for s in steps]) == labels[3:]) > 0.8
    other = replace(trace, steps=tuple(steps))
    other.save(tmp_path / "other.jsonl")
    call = ["localise", str(runs / "hall" / "maps.json"), str(tmp_path / "other.jsonl")]
    assert main([*call, "--recogniser", str(runs / "hall" / "recogniser.skops")]) == 0
    assert "located at steps" in capsys.readouterr().out


def test_import_does_not_read_corrected_poses(hall: Path) -> None:
    log = RobotLog(every_second_beam(read_log(hall).scans[:40]), source="x")
    blind = tuple(
        Scan(scan.ranges, scan.laser, scan.odometry, None, scan.time, scan.line)
        for scan in log.scans
    )
    seen, unseen = (import_log(RobotLog(scans, source="x")).trace for scans in (log.scans, blind))
    assert [(s.view, s.star, s.displacement, s.action) for s in seen] == [
        (s.view, s.star, s.displacement, s.action) for s in unseen
    ]
    assert not any(step.truth for step in unseen)


def test_log_without_motion_or_walls_or_width_is_refused() -> None:
    laser = LaserScanner(-math.pi / 2, math.radians(1), 181, 30.0)
    corridor = np.minimum(1.0 / np.maximum(np.abs(np.sin(laser.bearings)), 1e-9), 30.0)
    still = [Scan(corridor, laser, (0.0, 0.0, 0.0))] * 3
    with pytest.raises(LogError, match="expected a robot that drives"):
        import_log(RobotLog(tuple(still), source="still.log"))
    blind = [
        replace(scan, ranges=np.full(181, value))
        for scan, value in zip(still, (0.0, 30.0, np.nan), strict=True)
    ]
    with pytest.raises(
        LogError, match="expected scans that meet walls, got 3 in which no beam meets anything"
    ):
        import_log(RobotLog(tuple(blind), source="blind.log"))
    onward = [
        Scan(np.where(corridor >= 30, np.inf, corridor), laser, (0.5 * i, 0.0, 0.0))
        for i in range(5)
    ]
    with pytest.raises(LogError, match="expected a way past junctions or turning points"):
        import_log(RobotLog(tuple(onward), source="corridor.log"))
    with pytest.raises(LogError, match="width: expected metres above 0, got nan; give the width"):
        import_log(RobotLog(tuple(onward), source="corridor.log"), math.nan)
    with pytest.raises(LogError, match=r"got 'a\.log'; read one with read_log"):
        map_log("a.log")  # type: ignore[arg-type]


def test_recording_has_the_scans_on_the_walls(runs: Path, tmp_path: Path) -> None:
    reader = pytest.importorskip("rerun.chunk").RrdReader
    file = tmp_path / "hall.rrd"
    assert main(["export", str(runs / "hall"), "--to", "rerun", "-o", str(file)]) == 0
    points: dict[str, list[Any]] = {}
    for chunk in reader(file).store().stream():
        batch = chunk.to_record_batch()
        for name in {"Points3D:positions", "Arrows3D:origins"} & {*batch.schema.names}:
            points.setdefault(chunk.entity_path, []).extend(batch.column(name).to_pylist())
    steps = len(Trace.load(runs / "hall" / "trace.jsonl"))
    assert (len(points["/robot"]), len(points["/scan"])) == (steps, steps)
    walls, seen = (
        np.array([p[:2] for row in points[name] for p in row]) for name in ("/walls", "/scan")
    )
    away = cKDTree(walls).query(seen)[0]
    assert np.quantile(away, 0.9) < 0.3


def test_recording_needs_a_file_and_the_folder_of_a_log(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    maps = str(tmp_path / "maps.json")
    assert main(["solve", "examples/notched-rectangle.jsonl", "-o", maps]) == 0
    for words, said in ((["-o", str(tmp_path / "x.rrd")], "expected the folder"), ([], "name a")):
        assert main(["export", maps, "--to", "rerun", *words]) == 1
        assert said in capsys.readouterr().err


@pytest.mark.usefixtures("without_processes")
def test_finished_run_is_skipped_and_bad_logs_do_not_stop_others(
    hall: Path, runs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bad = hall.with_name("bad.log")
    assert main(f"map {hall} {bad} -o {runs} --time-limit 1000".split()) == 1
    told = capsys.readouterr()
    assert f"{hall}: done already, in {runs / 'hall'}" in told.out
    assert f"{bad}: expected a robot's log" in told.out
    assert "errors in 1 of 2 logs" in told.err


@pytest.mark.parametrize(
    ("flags", "star", "boundary"),
    [
        ([], "none", "none"),
        (["--theory", "topological"], "auto", "strict"),
        (["--set", "star=auto", "--set", "boundary=strict"], "auto", "strict"),
        (["--set", "star=auto"], "auto", "none"),
        (["--set", "misread=1.5"], "none", "none"),
        (["--theory", "topological", "--set", "star=none"], "none", "strict"),
        (["--set", "level=causal"], "none", "none"),
    ],
)
def test_flags_override_the_theory_for_logs(
    hall: Path,
    flags: list[str],
    star: str,
    boundary: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    trace = Trace.from_steps("ab", ["travel"])

    def solve(_: log_maps.LogMapping, __: Trace, theory: Theory, **___: object) -> None:
        raise AbductionError(f"star={theory.star}, boundary={theory.boundary}")

    monkeypatch.setattr(
        log_maps,
        "import_log",
        lambda *_: SimpleNamespace(
            trace=trace, track=SimpleNamespace(way=[1.0]), visits=(), seconds={}, notes=()
        ),
    )
    monkeypatch.setattr(log_maps.LogMapping, "solve", solve)
    small = hall.with_name("first.log")
    small.write_text("\n".join(hall.read_text().splitlines()[:20]) + "\n")
    assert main(["map", str(small), "-o", str(hall.with_name("never")), *flags]) == 1
    assert f"star={star}, boundary={boundary}" in capsys.readouterr().err


def test_default_work_limit_is_a_fortieth_of_the_drive() -> None:
    laser = LaserScanner(-1.0, 1.0, 3, 30.0)
    timed = tuple(Scan(np.ones(3), laser, (0.1 * i, 0.0, 0.0), time=2.0 * i) for i in range(51))
    track = Track(np.array([scan.odometry for scan in timed]), np.zeros((51, 3, 3)))
    imported = Imported(
        Trace.from_steps("aa", ["travel"]),
        track,
        0.5,
        (),
        {"track": 0.5, "places": 1.0},
    )
    assert work_for(RobotLog(timed, source="timed.log"), imported) == pytest.approx(100 / 40)
    # A clock that once goes back by a second is used; one that often goes back is not.
    long = tuple(Scan(np.ones(3), laser, (0.0, 0.0, 0.0), time=2.0 * i) for i in range(201))
    for back, drove in ((1, 401.0), (5, None)):
        times = {k: 2.0 * k - 3.0 for k in range(10, 10 + 10 * back, 10)}
        clocked = tuple(replace(scan, time=times.get(i, scan.time)) for i, scan in enumerate(long))
        assert seconds_driven(RobotLog(clocked, source="back.log")) == drove
    # Without a clock, or with one that counts milliseconds, the length of the drive decides.
    for unit in (None, 1000.0):
        untimed = tuple(replace(scan, time=unit and unit * scan.time) for scan in timed)
        left = work_for(RobotLog(untimed, source="untimed.log"), imported)
        assert left == pytest.approx(5.0 / SPEED / 40)


@pytest.mark.slow
def test_map_on_an_unreliable_track_has_no_probability(
    hall: Path, runs: Path, imported_hall: Imported, monkeypatch: pytest.MonkeyPatch
) -> None:
    track = replace(imported_hall.track, is_reliable=False)
    imported = replace(imported_hall, track=track)
    monkeypatch.setattr(log_maps, "import_log", lambda *_: imported)
    doubtful = map_log(read_log(hall), time_limit=1, max_maps=1).solution
    reliable = Solution.load(runs / "hall" / "maps.json")
    for solution, is_reliable in ((doubtful, False), (reliable, True)):
        said = "no probability is given, as the track is unreliable" in solution.sureness
        assert (solution.confidence is None, said) == (not is_reliable, not is_reliable)


def test_map_has_poses_if_the_search_left_no_time_to_fit_them(
    hall: Path, runs: Path, imported_hall: Imported, monkeypatch: pytest.MonkeyPatch
) -> None:
    known = Solution.load(runs / "hall" / "maps.json", imported_hall.trace)
    without = replace(known, maps=tuple(replace(one, fit=None) for one in known.maps))
    monkeypatch.setattr(log_maps, "import_log", lambda *_: imported_hall)
    monkeypatch.setattr(log_maps.LogMapping, "solve", lambda *_, **__: without)
    found, expected = map_log(read_log(hall)).solution.maps[0], known.maps[0]
    assert found.fit
    assert expected.fit
    for pose, other in zip(found.fit.poses, expected.fit.poses, strict=True):
        assert (pose.x, pose.y) == pytest.approx((other.x, other.y), abs=0.01)


@pytest.mark.parametrize(("limit", "searches"), [(None, 3), (5.0, 1)])
def test_search_without_a_limit_continues_until_it_has_a_map(
    hall: Path,
    runs: Path,
    imported_hall: Imported,
    monkeypatch: pytest.MonkeyPatch,
    limit: float | None,
    searches: int,
) -> None:
    monkeypatch.setattr(log_maps, "import_log", lambda *_: imported_hall)
    asked: list[float] = []
    found = Solution.load(runs / "hall" / "maps.json")

    def late(self: LogMapping, trace: Trace, theory: Theory, **given: Any) -> Solution:
        asked.append(given["work_limit"])
        if len(asked) == 3:
            return found
        return replace(found, status=Status.UNKNOWN, maps=(), cost=None, stopped="work limit")

    monkeypatch.setattr(LogMapping, "solve", late)
    told: list[str] = []
    done = map_log(read_log(hall), work_limit=limit, tell=told.append)
    assert asked == [asked[0] * 4**k for k in range(searches)]
    if limit is None:
        assert done.solution.maps
        assert (done.limit, done.notes) == (asked[-1], ())
        assert told[-1] == (
            f"No map was found yet. The search goes on for up to {asked[-1]:.0f} units of work."
        )
    else:
        assert done.notes[-1] == (
            "The search ended after 5 units of work without a map. To search longer, give a "
            "limit: --work-limit 20."
        )


def test_report_says_why_there_is_no_map_or_proof() -> None:
    solution = solve(Trace.from_steps([0, 1], ["travel"]))
    assert how_it_ended(solution, 5.0) is None
    assert how_it_ended(replace(solution, stopped="time limit"), 5.0) is None  # of the listing
    stopped = replace(solution, status=Status.FEASIBLE, stopped="time limit")
    assert "without a proof" in str(how_it_ended(stopped, 5.0))
    nothing = replace(solution, status=Status.UNSATISFIABLE, maps=())
    assert "or ask why: ssh-abduction explain FOLDER" in str(how_it_ended(nothing, 5.0))


@pytest.mark.parametrize(
    ("choices", "advised"),
    [({}, True), ({"boundary": "defeasible"}, False), ({"misread": 4}, False)],
)
def test_misread_is_advised_only_if_the_theory_may_allow_it(
    choices: dict[str, Any], advised: bool
) -> None:
    theory = Theory.topological().replace(**choices)
    nothing = replace(
        solve(Trace.from_steps([0, 1], ["travel"]), theory), status=Status.UNSATISFIABLE, maps=()
    )
    assert ("misread" in str(how_it_ended(nothing, 5.0))) == advised


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["-o", "{file}"], "expected another file to write than the one to read"),
        (["-o", "{file}/x"], "expected a folder to write, got a file"),
        (["-o", "x", "--time-limit", "-1"], "--time-limit: expected a number of seconds above 0"),
        (["-o", "x", "--maps", "-1"], "--maps: expected a number of minimal maps to list"),
        (["-o", "x", "--same", "a:1,b:2"], "call ssh-abduction correct x --same a:1,b:2, and map"),
    ],
)
def test_map_refuses_wrong_options_before_reading_a_log(
    tmp_path: Path, flags: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "no.log"
    file.write_text("no log")
    assert main(["map", str(file), *(flag.format(file=file) for flag in flags)]) == 1
    assert said in capsys.readouterr().err


def test_compare_reads_two_runs(
    runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, other = runs / "hall", tmp_path / "other"
    shutil.copytree(folder, other)
    assert main(["compare", str(folder), str(other)]) == 0
    assert "the two runs have the same settings" in capsys.readouterr().out
    run = json.loads((other / "run.json").read_text())
    run["width"] = 0.9
    (other / "run.json").write_text(json.dumps(run))
    (other / "trace.jsonl").write_text("")
    assert main(["compare", str(folder), str(other)]) == 0
    assert "width: " in capsys.readouterr().out
    assert main(["compare", str(folder), str(other), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told == {"runs": {"width": [0.5, 0.9]}}  # And no more, as their traces differ.
    assert main(["compare", str(folder), str(folder), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["runs"] == {}
    assert told["count"] == len(told["others"]["both"])


@pytest.mark.slow
def test_log_is_mapped_in_its_own_process(hall: Path, tmp_path: Path) -> None:
    question = MapQuestion(None, {}, {}, 0.5, 1000.0, 1)
    small = tmp_path / "small.log"
    small.write_text("\n".join(hall.read_text().splitlines()[:80]) + "\n")
    (answer,) = answers_here(question, [str(small)], 2, StopFlag())
    assert answer.code in (0, 10)
    assert dict(answer.files)["run.json"]


def test_error_of_a_log_names_it_once(tmp_path: Path) -> None:
    answer = MapQuestion(None, {}, {}, 0.5, 1.0, 1).answer(0, f"{tmp_path}/")
    assert answer.line.startswith(f"{tmp_path}: expected a folder of ROS 2")


def test_killed_process_loses_only_its_log(hall: Path) -> None:
    question = MapQuestion(None, {}, {}, 0.5, 1000.0, 1)
    lost = question.lost(workers.Lost(0, late=False), str(hall))
    assert (lost.code, "got a killed process" in lost.line) == (1, True)


@pytest.mark.slow
@pytest.mark.skipif(not REAL.exists(), reason="real logs are not part of the project")
def test_import_finds_all_visits_to_crossings_in_aces() -> None:
    log = read_log(REAL / "aces-corrected.log.gz")
    truth = Truth.of_aces(np.array([scan.corrected for scan in log.scans]))
    scans = [int(step.extra["scan"]) for step in import_log(log).trace]
    assert {visit for visit in truth.matched(scans) if visit is not None} == {*range(15)}


@pytest.mark.slow
def test_map_of_four_rooms_has_perfect_place_precision(tmp_path: Path) -> None:
    """A robot drives around four rooms in a ring, and the map has a place in each of them."""
    middles = {room: middle for room, middle in MIDDLES.items() if room != "closet"}
    drive = record_plan(
        plan_of(tmp_path, xml(DOORS[:4], middles=middles)), seed=1, metres=36, every=0.5
    )
    log = RobotLog(tuple(scans_of(drive)), source="ring")
    done = map_log(log, max_maps=1, time_limit=60)
    (judged,) = evaluate_visits(done.solution.maps[:1], done.imported.trace).maps
    assert judged.places.precision == 1.0
