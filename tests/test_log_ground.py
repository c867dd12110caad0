"""What the page of a log shows under and below its maps: walls, the robot's way, the report."""

from __future__ import annotations

import base64
import json
import math
import struct
import time
import zlib
from dataclasses import replace
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from coarse import every_second_beam
from scipy.spatial import cKDTree

from perception.places.passages import resampled
from perception.readers.scans import RobotLog
from simulator.tours import record
from simulator.world import World
from ssh_abduction import solve
from ssh_abduction.cli.simulate import scans_of
from ssh_abduction.data.map_parts import Name
from ssh_abduction.data.maps import DState, SSHMap
from ssh_abduction.data.odometry import displacement_between, moved
from ssh_abduction.output.roads import undecided_places
from ssh_abduction.page.content import Ground, Section, content_of
from ssh_abduction.page.html import ground_in, view_page
from ssh_abduction.robot_logs.log_ground import GRAIN, ground_of, laid_over
from ssh_abduction.robot_logs.log_maps import LogMap, map_log
from ssh_abduction.robot_logs.log_report import report
from ssh_abduction.solution import Status


@pytest.fixture(scope="module")
def house() -> LogMap:
    """The map of most of a drive through a house of six rooms and a hall.

    The limit is of processor time, so that other processes do not shorten the search.
    """
    scans = every_second_beam(scans_of(record(World.named("doors"), every=1.0)))
    scans = scans[: len(scans) * 7 // 10]
    with patch.object(time, "perf_counter", time.process_time):
        return map_log(RobotLog(scans, source="house"), time_limit=1)


def told(house: LogMap, **changes: Any) -> dict[str, Section]:
    solution = replace(house.solution, **changes)
    return {s.title: s for s in report(house.log, house.imported, solution, house.to_dict())}


def along(*places: int) -> SSHMap:
    """A map of a robot that comes past these places, with a dstate at each step."""
    states = tuple(DState(i, 0, place, 0, 1) for i, place in enumerate(places))
    links = tuple((i, "travel", i + 1) for i in range(len(places) - 1))
    return SSHMap(tuple(range(len(places))), states, links)


@pytest.mark.parametrize(
    ("places", "undecided"),
    [
        ((0, 1, 2), {1}),
        ((0, 1, 2, 2, 1, 0), {1}),  # the robot turned around at 2
        ((0, 1, 2, 1, 0), {1}),
        ((0, 1, 0, 1, 2), set()),  # it turned around at 1, and at 0
        ((0, 1, 2, 3, 1, 4), {2, 3}),
        ((0,), set()),
    ],
)
def test_undecided_places_have_one_pair_of_neighbours(
    places: tuple[int, ...], undecided: set[int]
) -> None:
    assert undecided_places(along(*places)) == undecided


def pixels(url: str) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """Read a picture as `ground_of` writes it: one bit for each point."""
    data = base64.b64decode(url.removeprefix("data:image/png;base64,"))
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    chunks, at = {}, 8
    while at < len(data):
        (size,) = struct.unpack(">I", data[at : at + 4])
        kind, body = data[at + 4 : at + 8], data[at + 8 : at + 8 + size]
        assert struct.unpack(">I", data[at + 8 + size : at + 12 + size])[0] == zlib.crc32(
            kind + body
        )
        chunks[kind], at = body, at + 12 + size
    width, height = struct.unpack(">II", chunks[b"IHDR"][:8])
    rows = np.frombuffer(zlib.decompress(chunks[b"IDAT"]), np.uint8).reshape(height, -1)
    assert not rows[:, 0].any()
    return np.unpackbits(rows[:, 1:], axis=1)[:, :width].astype(bool)


def test_walls_are_where_the_laser_saw_them(house: LogMap) -> None:
    """Each wall of the world is near points of the picture, and most points are near a wall."""
    found = ground_of(house.log, house.imported, house.solution.maps[0])
    seen = pixels(found["walls"])
    left, top, width, height = found["box"]
    assert seen.shape == (round(height / GRAIN), round(width / GRAIN))
    rows, columns = np.nonzero(seen)
    points = np.stack([left + (columns + 0.5) * GRAIN, top - (rows + 0.5) * GRAIN], axis=1)
    poses = laid_over(house.imported, house.solution.maps[0])
    nearest = []
    for scan, pose in zip(house.log.scans[::10], poses[::10], strict=True):
        for far, bearing in zip(scan.ranges[::9], scan.laser.bearings[::9], strict=True):
            if 0 < far < min(scan.laser.reach, 8):
                x, y, _ = moved(pose, (far * math.cos(bearing), far * math.sin(bearing), 0.0))
                nearest.append(np.hypot(*(points - (x, y)).T).min())
    assert np.mean(np.array(nearest) < 0.15) > 0.8
    left, lowest, right, highest = found["view"]
    assert all(left <= x <= right and lowest <= y <= highest for x, y in found["way"])


def test_scans_are_carried_to_where_the_map_has_their_steps(house: LogMap) -> None:
    """A track that bends steadily is straight on a map that is straight."""
    imported, ssh_map = house.imported, house.solution.maps[0]
    fit = ssh_map.fit
    assert fit is not None
    found = ground_of(house.log, imported, ssh_map)
    for t, (x, y, _) in enumerate(found["spots"]):
        pose = fit.poses[ssh_map.dstate_at[t]]
        assert math.dist((x, y), (pose.x, pose.y)) < 0.5
    bent = imported.track.poses.copy()
    for k in range(len(bent) - 1):  # half a degree to the left at each scan
        step = displacement_between(imported.track.poses[k], imported.track.poses[k + 1])
        bent[k + 1] = moved(moved(bent[k], step), (0.0, 0.0, math.radians(0.5)))
    crooked = replace(imported, track=replace(imported.track, poses=bent))
    off = [
        math.dist(one[:2], other[:2])
        for one, other in zip(
            laid_over(crooked, ssh_map), laid_over(imported, ssh_map), strict=True
        )
    ]
    straight = [math.dist(a[:2], b[:2]) for a, b in zip(bent, imported.track.poses, strict=True)]
    assert max(straight) > 5
    assert np.median(off) < 0.5


def test_course_of_a_travel_follows_the_robot(house: LogMap) -> None:
    trace, visits = house.imported.trace, house.imported.visits
    bows = 0
    for t, action in enumerate(trace.actions):
        step, after = trace.steps[t], trace.steps[t + 1]
        if action.kind != "travel" or after.displacement is None:
            continue
        course = np.array([(0.0, 0.0), *step.extra["course"]])
        assert course[-1] == pytest.approx(after.displacement[:2], abs=0.01)
        first, last = (visits[s.extra["visit"]] for s in (step, after))
        # The robot, seen from the middle.
        spot = displacement_between(step.extra["seen"], (0.0, 0.0, 0.0))
        track = house.imported.track.poses
        way = [
            moved(spot, displacement_between(track[first.scan], track[scan]))[:2]
            for scan in range(first.scan, last.scan + 1)
        ]
        outside = [
            point
            for point in way
            if math.dist(point, course[0]) > first.radius + 0.1
            and math.dist(point, course[-1]) > last.radius + 0.1
        ]
        fine = resampled(course, 0.05)
        assert all(np.hypot(*(fine - point).T).min() < 0.15 for point in outside)
        bows += len(course) > 2
    assert bows


def test_page_draws_all_maps_over_the_ground(house: LogMap, tmp_path: Any) -> None:
    trace, best = house.imported.trace, house.solution.maps[0]
    seen = ground_of(house.log, house.imported, best)
    named = replace(best, names=(Name("place", best.places[0], "Küche <1>"),))
    ground = Ground(seen, tuple(told(house).values()))
    content = content_of(replace(house.solution, maps=(named,)), trace, ground=ground)
    assert content["layouts"] == []  # a place is where its visits were
    assert content["spots"] == [list(map(float, spot)) for spot in seen["spots"]]
    assert content["maps"][0]["passed"] == sorted(undecided_places(best.renumbered()))
    assert len(content["indoors"]["ellipses"]) > 0
    page = view_page(house.solution, trace, ground=ground)
    page.save(tmp_path / "page.html")
    assert (tmp_path / "page.html").stat().st_size < 400_000
    again = ground_in(tmp_path / "page.html", len(trace))
    assert again is not None
    assert json.loads(json.dumps(seen)) == again.seen
    assert [section.title for section in again.sections] == [*told(house)]
    assert ground_in(tmp_path / "page.html", len(trace) + 1) is None
    assert ground_in(tmp_path / "missing.html", len(trace)) is None
    (tmp_path / "other.html").write_text("<html>another program</html>")
    assert ground_in(tmp_path / "other.html", len(trace)) is None


def test_report_counts_paths_only_if_the_theory_has_axioms_on_them(house: LogMap) -> None:
    solution = house.solution
    with_paths = solution.theory.replace(without=("one_dstate_per_course",), weigh="auto")
    planar = solve(house.imported.trace, with_paths, time_limit=20)
    planar = replace(planar, theory=with_paths.replace(planar=True, misread=0))
    for one, shows in ((solution, False), (planar, True)):
        first, *_ = report(house.log, house.imported, one, house.to_dict())
        assert one.cost is not None
        assert (f"places, {one.cost.paths} paths, " in first.lines[0]) == shows


def test_report_names_rival_maps_only_if_they_were_sought(house: LogMap) -> None:
    for status, sought in ((Status.OPTIMAL, True), (Status.FEASIBLE, False)):
        assert ("Rival maps" in told(house, status=status)) == sought


def test_report_calls_no_join_sure_if_the_search_ended_early(house: LogMap) -> None:
    weighed = house.solution.weighed
    assert weighed is not None
    for searched, said in ((True, "None: "), (False, "Unknown: a map that costs less")):
        found = replace(weighed, bound=0.0, searched=searched)
        (line,) = told(house, support=replace(house.solution.support, weighed=found))[
            "Doubtful joins"
        ].lines
        assert line.startswith(said)


def test_walls_of_a_live_map_are_those_of_its_local_maps(house: LogMap) -> None:
    """A live mapper keeps no ranges. Its walls are near those that the scans show."""
    best = house.solution.maps[0]
    with patch("ssh_abduction.robot_logs.log_ground._walls", lambda *_: np.zeros((0, 2))):
        live = ground_of(house.log, house.imported, best)
    whole = ground_of(house.log, house.imported, best)

    def points(found: dict[str, Any]) -> np.ndarray[Any, np.dtype[np.float64]]:
        rows, columns = np.nonzero(pixels(found["walls"]))
        left, top, *_ = found["box"]
        return np.stack([left + columns * GRAIN, top - rows * GRAIN], axis=1)

    apart = cKDTree(points(whole)).query(points(live))[0]
    assert len(apart) > 300
    assert np.mean(apart < 0.25) > 0.9
