"""Visits are found while the robot drives: the same as in a whole log, soon, and in flat memory."""

from __future__ import annotations

import math
import tracemalloc
from collections.abc import Iterable, Iterator
from functools import cache

import numpy as np
import pytest
from test_distinctive import BEARINGS, FORK, log_of

from perception.errors import LogError
from perception.places.distinctive import DELAY, Visit, find_visits
from perception.places.following import follow
from perception.places.live import LiveLog, import_live, watched
from perception.places.track import Track
from perception.readers.scans import LaserScanner, RobotLog, Scan
from simulator.robot import meetings

# A room of 6 by 5 m with a door, in which a robot drives round and round.
ROOM = [(0, 0, 6, 0), (0, 0, 0, 5), (0, 5, 2.4, 5), (3.6, 5, 6, 5), (6, 0, 6, 5)]
ROOM += [(2.4, 5, 2.4, 12), (3.6, 5, 3.6, 12), (2.4, 12, 3.6, 12)]
ROUND = [(1, 1), (5, 1), (5, 4), (1, 4)]
DRIVES = {
    "fork": (FORK, [(1, 0), (18, 0), (10, 0), (10, 8), (10, 0), (1, 0)]),
    "rounds in a room": (ROOM, [*ROUND * 3, (3, 4), (3, 11), (3, 4), (5, 1)]),
}


@cache
def drive(name: str) -> tuple[RobotLog, Track]:
    """A log, and its track."""
    log = log_of(*DRIVES[name])[0]  # type: ignore[arg-type]
    return log, follow(log)


def stream_visits(scans: Iterable[Scan]) -> Iterator[Visit]:
    """The visits of a drive, as soon as they are final."""
    live = LiveLog()
    for scan in watched(scans, live.tell):
        yield from live.add(scan)[1]
    yield from live.expected()


def fields(visits: list[Visit]) -> list[tuple[object, ...]]:
    return [
        (
            visit.scan,
            tuple(visit.middle),
            (visit.begin, visit.end, visit.radius, visit.support),
            (visit.ways, visit.arrived, visit.left),
            visit.patch.free.tobytes() if visit.patch else None,
        )
        for visit in visits
    ]


@pytest.mark.parametrize("name", ["fork", pytest.param("rounds in a room", marks=pytest.mark.slow)])
def test_streamed_visits_equal_those_of_the_whole_log(name: str) -> None:
    log, track = drive(name)
    streamed = list(stream_visits(iter(log.scans)))
    assert len(streamed) >= 3
    assert all(visit.patch is not None for visit in streamed)
    assert fields(streamed) == fields(list(find_visits(log, track)))


@pytest.mark.slow
def test_visit_is_final_within_the_promised_distance() -> None:
    (log, track), fed = drive("fork"), 0

    def scans() -> Iterator[Scan]:
        nonlocal fed
        for fed, scan in enumerate(log.scans):  # noqa: B007
            yield scan
        fed = 0

    way = track.way
    late = [way[fed] - way[visit.end] for visit in stream_visits(scans()) if fed]
    assert len(late) >= 3
    assert max(late) <= DELAY


def corridor(metres: float) -> Iterator[Scan]:
    """Scans, 0.5 m apart, of a straight corridor with a side corridor to the left every 10 m."""
    bearings = BEARINGS[::2]
    laser = LaserScanner(float(bearings[0]), math.radians(4), len(bearings), 20.0)
    walls = [(x + 1.2, 1, x + 8.8, 1) for x in range(-25, 30, 10)]
    walls += [(x, y, x, 9.0) for x in np.arange(-26.2, 30, 10) for y in (1.0,)]
    walls += [(x, 1.0, x, 9.0) for x in np.arange(-23.8, 30, 10)]
    walls += [(-60, -1, 60, -1)]
    poses = np.array([(x, 0.0, 0.0) for x in np.arange(0, 10, 0.5)])
    ranges = meetings(np.array(walls, float), poses, bearings).min(axis=2)
    for i in range(int(metres / 0.5)):
        yield Scan(ranges[i % len(poses)], laser, (0.5 * i, 0.0, 0.0))


def peak(metres: float) -> tuple[int, int]:
    """The visits on a drive along the corridor, and the peak of memory in bytes."""
    tracemalloc.start()
    try:
        return sum(1 for _ in stream_visits(corridor(metres))), tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.slow
def test_memory_does_not_grow_with_the_drive() -> None:
    list(stream_visits(corridor(20)))  # imports
    (visits, short), (more, long) = peak(80), peak(320)
    assert more >= 3 * visits >= 18
    assert long < 1.1 * short


@pytest.mark.parametrize("width", [0, -1, math.nan, math.inf, "0.5"])
def test_a_width_is_a_positive_number(width: object) -> None:
    with pytest.raises(LogError, match="width: expected metres above 0"):
        import_live([], width)  # type: ignore[arg-type]


def test_items_are_scans() -> None:
    with pytest.raises(LogError, match="expected scans, got 3 as item 0"):
        import_live([3])  # type: ignore[list-item]
