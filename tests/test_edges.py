"""Travels between two places are on one edge of a map if their courses lie close together."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
from courses import edges_of, frechet

from perception.places.passages import resampled
from ssh_abduction import Trace
from ssh_abduction.data import Action, DState, Step
from ssh_abduction.data.map_parts import Fit, Pose
from ssh_abduction.data.maps import SSHMap

Points = Sequence[tuple[float, float]]
AHEAD = [(8.0, 0.0)]


def shuttle(courses: Sequence[Points], turns: Sequence[float] | None = None) -> list[int]:
    """The edges of a robot that shuttles between a place at (0, 0) and one at (8, 0).

    Args:
        courses: Its courses. Each begins at (0, 0) of the axes of its step, which look to the other
            place.
        turns: The error of the heading at each dstate, in radians.
    """
    count = len(courses)
    steps = [
        Step(str(t), Action.of("travel"), extra={"course": [[*point] for point in course]})
        for t, course in enumerate(courses)
    ]
    trace = Trace((*steps, Step(str(count))))
    states = tuple(DState(t, str(t), t % 2, None, None) for t in range(count + 1))
    poses = tuple(
        Pose(8.0 * (t % 2), 0.0, math.pi * (t % 2) + (turns[t] if turns else 0.0), (1, 0, 1))
        for t in range(count + 1)
    )
    fit = Fit(0.0, 0, 1.0, poses=poses)
    found = edges_of(trace, SSHMap(tuple(range(count + 1)), states, (), (0, 1), fit=fit))
    assert list(found) == list(range(count))
    return list(found.values())


@pytest.mark.parametrize(
    ("courses", "edges"),
    [
        pytest.param([AHEAD, AHEAD, AHEAD], [0, 0, 0], id="there and back"),
        pytest.param([AHEAD, [(4, 1), (8, 0)]], [0, 0], id="a bow"),
        pytest.param([AHEAD, [(4, 4), (8, 0)]], [0, 1], id="around something"),
        pytest.param([[(4, 2), (8, 0)], [(4, 2), (8, 0)]], [0, 1], id="on both sides"),
        pytest.param([[(4, 2), (8, 0)], [(4, -2), (8, 0)]], [0, 0], id="the same side, back"),
        # The two ways leave the first place within 30 degrees of each other.
        pytest.param([[(4, 1), (8, 0)], AHEAD, [(4, -1), (8, 0)]], [0, 0, 1], id="a wide corridor"),
        # The two ways leave the first place in opposite directions.
        pytest.param([[(-1, 0), (-1, 1), (8, 0)], AHEAD], [0, 0], id="another gateway"),
        pytest.param([[], []], [0, 0], id="unknown courses"),
    ],
)
def test_travels_with_near_courses_share_an_edge(
    courses: Sequence[Points], edges: list[int]
) -> None:
    assert shuttle(courses) == edges


def test_edges_tolerate_small_errors_of_heading_and_length() -> None:
    long = [(4.0, 0.5), (8.6, 0.3)]
    assert shuttle([AHEAD, long, AHEAD], [0.3, -0.3, 0.2, 0.0]) == [0, 0, 0]


def test_the_frechet_distance_respects_the_order_of_points() -> None:
    way = resampled(np.array([(0.0, 0.0), (6.0, 0.0)]), 0.25)
    back = resampled(np.array([(0.0, 0.0), (5.0, 0.0), (1.0, 0.0), (6.0, 0.0)]), 0.25)
    assert frechet(way, way + np.array([0.0, 1.0])) == pytest.approx(1.0)
    assert frechet(way, back) == pytest.approx(2.0)
    assert frechet(way, way[::-1]) == pytest.approx(6.0)
