"""The picture of the map of a log: edges along their courses, hidden places, doubtful joins."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from unittest.mock import patch

import numpy as np
import pytest
from coarse import every_second_beam

from perception.places.passages import STEP, resampled
from perception.readers.scans import RobotLog
from simulator.tours import record
from simulator.world import World
from ssh_abduction import solve
from ssh_abduction.cli.simulate import scans_of
from ssh_abduction.data.map_parts import Name
from ssh_abduction.data.maps import DState, SSHMap
from ssh_abduction.data.odometry import displacement_between, moved
from ssh_abduction.output.roads import place_of_steps, undecided_places
from ssh_abduction.output.scene import ALARM
from ssh_abduction.robot_logs.log_maps import LogMap, map_log
from ssh_abduction.robot_logs.log_picture import BESIDE, EDGE, drawn_once, figure
from ssh_abduction.robot_logs.log_report import report
from ssh_abduction.solver import Status, Weighed


@pytest.fixture(scope="module")
def house() -> LogMap:
    """The map of most of a drive through a house of six rooms and a hall.

    The limit is of processor time, so that other processes do not shorten the search.
    """
    scans = every_second_beam(scans_of(record(World.named("doors"), every=1.0)))
    scans = scans[: len(scans) * 7 // 10]
    with patch.object(time, "perf_counter", time.process_time):
        return map_log(RobotLog(scans, source="house"), time_limit=1)


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


def test_picture_draws_undecided_places_as_dots(house: LogMap) -> None:
    ssh_map = house.solution.maps[0]
    hidden = undecided_places(ssh_map)
    picture = figure(house.log, house.imported, house.solution)
    assert 0 < len(hidden) < len(ssh_map.places)
    for place in ssh_map.places:
        assert (f">{place}</text>" in picture) == (place not in hidden)
        assert (f"<title>place {place}</title>" in picture) == (place in hidden)


def test_picture_shows_names_of_places(house: LogMap) -> None:
    best = house.solution.maps[0]
    hidden = min(undecided_places(best))
    shown = min(set(best.places) - undecided_places(best))
    names = (Name("place", shown, "Küche <1>"), Name("place", hidden, "corner"))
    named = replace(house.solution, maps=(replace(best, names=names),))
    picture = figure(house.log, house.imported, named)
    assert ">Küche &lt;1&gt;</text>" in picture
    assert ">corner</text>" in picture
    assert f"<title>place {hidden} (corner)</title>" in picture


def test_picture_draws_each_edge_once_along_the_drive(house: LogMap) -> None:
    picture = figure(house.log, house.imported, house.solution)
    courses = [mark for mark in picture.split("<path ") if 'stroke-width="4"' in mark]
    places = place_of_steps(house.solution.maps[0])
    travels = [
        frozenset(places[t : t + 2])
        for t, action in enumerate(house.imported.trace.actions)
        if action.kind == "travel"
    ]
    assert len(set(travels)) <= len(courses) < len(travels)
    assert max(mark.count("L") for mark in courses) > 5


def test_edges_that_run_together_are_drawn_once() -> None:
    short = [np.array(ends, float) for ends in ([(0, 0), (5, 0)], [(5, 0), (10, 0)])]
    bow = np.array([(0, 0.3), (2, 0.3), (5, 3), (8, 0.3), (10, 0.3)])
    lines = list(drawn_once([bow, *short, *short, short[0][::-1] + 0.2]))
    assert [line[[0, -1]].tolist() for line in lines[:2]] == [one.tolist() for one in short]
    (left,) = lines[2:]
    assert left[:, 1].max() == pytest.approx(3, abs=STEP)
    # It begins and ends on the short edges, where it is beside them no longer.
    assert left[[0, -1], 1].tolist() == [0, 0]
    assert (left[1:-1, 1] > BESIDE).all()


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


def test_report_shows_paths_only_if_the_theory_has_axioms_on_them(house: LogMap) -> None:
    solution = house.solution
    with_paths = solution.theory.replace(without=("one_dstate_per_course",), weigh="auto")
    planar = solve(house.imported.trace, with_paths, time_limit=20)
    planar = replace(planar, theory=with_paths.replace(planar=True))
    for one, shows in ((solution, False), (planar, True)):
        page = report(house.log, house.imported, one, house.to_dict())
        assert ("Colours are paths" in page) == shows
        assert one.cost is not None
        assert (f"places, {one.cost.paths} paths, " in page) == shows
    assert figure(house.log, house.imported, planar).count(f'stroke="{EDGE}"') < figure(
        house.log, house.imported, solution
    ).count(f'stroke="{EDGE}"')


def test_report_names_rival_maps_only_if_they_were_sought(house: LogMap) -> None:
    for status, sought in ((Status.OPTIMAL, True), (Status.FEASIBLE, False)):
        solution = replace(house.solution, status=status)
        page = report(house.log, house.imported, solution, house.to_dict())
        assert ("<h2>Rival maps</h2>" in page) == sought


def test_report_calls_no_join_sure_if_the_search_ended_early(house: LogMap) -> None:
    weighed = house.solution.weighed
    assert weighed is not None
    for searched, told in ((True, "None: "), (False, "Unknown: a map that costs less")):
        found = replace(weighed, bound=0.0, searched=searched)
        solution = replace(house.solution, support=replace(house.solution.support, weighed=found))
        page = report(house.log, house.imported, solution, house.to_dict())
        assert f"<h2>Doubtful joins</h2><p>{told}" in page


def test_picture_shows_probabilities_of_doubtful_joins(
    house: LogMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert ALARM not in figure(house.log, house.imported, house.solution)
    monkeypatch.setattr(
        Weighed, "doubtful", property(lambda found: found.joins)
    )  # all joins are doubtful
    places = place_of_steps(house.solution.maps[0])
    joined = {places[second] for _, second, _ in house.solution.weighed.joins}
    picture = figure(house.log, house.imported, house.solution)
    assert picture.count("<title>a join at place") == len(joined) > 0
    page = report(house.log, house.imported, house.solution, house.to_dict())
    assert "<h2>Doubtful joins</h2><table>" in page


def test_picture_draws_regions_as_bands(house: LogMap) -> None:
    regions = house.solution.maps[0].regions or ()
    picture = figure(house.log, house.imported, house.solution)
    assert regions
    assert picture.count('class="region"') == len(regions)
    for region in regions:
        assert region.door is not None
        assert not region.bounds  # nothing in a log says which travels are one path
        assert f"<title>{region}</title>" in picture
