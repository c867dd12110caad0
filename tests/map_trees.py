"""The tree of all maps that explain a drive through streets on a grid, from stars alone. A map
joins gateways in pairs.

It is independent of the encodings. A map says which gateways are joined: `{(place, slot): (place,
slot)}`, both ways. A known gateway leads where the map says. An unknown gateway leads to a new
place, or to a free gateway of a place that looks like this one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TypeAlias

Gateway: TypeAlias = tuple[int, int]
Joined: TypeAlias = dict[Gateway, Gateway]
Star: TypeAlias = tuple[bool, ...]  # open gateways, clockwise from the one ahead

DIRECTIONS = "NESW"
Cells: TypeAlias = dict[tuple[int, int], Star]  # the open directions of each cell, from north on


def lattice(width: int, height: int) -> Cells:
    """A grid of cells within walls."""
    return {
        (x, y): (y > 0, x < width - 1, y < height - 1, x > 0)
        for x in range(width)
        for y in range(height)
    }


def stars_on(route: str, cells: Cells | None) -> list[Star]:
    """What a robot sees that starts at cell 0, 0, heading east, and makes these moves. Without
    cells all gateways are open everywhere."""
    x, y, heading = 0, 0, 1
    stars = []
    for way in ["", *route]:
        if way:
            heading = DIRECTIONS.index(way)
            x, y = x + (heading == 1) - (heading == 3), y + (heading == 2) - (heading == 0)
        around = cells[x, y] if cells else (True,) * 4
        stars.append(tuple(around[(heading + k) % 4] for k in range(4)))
    return stars


def levels(
    route: str, cells: Cells | None = None, allows: Sequence[Callable[[Joined], bool]] = ()
) -> Iterator[list[Joined]]:
    """The maps after 0, 1, … moves that all functions in `allows` accept."""
    stars = stars_on(route, cells)
    begin: tuple[Joined, list[Star], Gateway] = ({}, [_turned(stars[0], 1)], (0, 1))
    maps, heading = [begin], 1
    yield [{}]
    for way, star in zip(route, stars[1:], strict=True):
        turn, heading = DIRECTIONS.index(way) - heading, DIRECTIONS.index(way)
        maps = [after for before in maps for after in _moved(*before, turn, star, allows)]
        yield [joined for joined, *_ in maps]


def _turned(star: Star, facing: int) -> Star:
    """The open slots of a place, from the star that a robot sees when it faces a slot."""
    return tuple(star[(slot - facing) % 4] for slot in range(4))


def _moved(
    joined: Joined,
    places: list[Star],
    faced: Gateway,
    turn: int,
    star: Star,
    allows: Sequence[Callable[[Joined], bool]],
) -> Iterator[tuple[Joined, list[Star], Gateway]]:
    """The maps after a move, with the stars of their places and what the robot faces."""
    here, facing = faced
    leaving = here, (facing + turn) % 4
    if known := joined.get(leaving):
        place, slot = known
        if places[place] == _turned(star, (slot + 2) % 4):
            yield joined, places, (place, (slot + 2) % 4)
        return
    ends = [(len(places), 2)] + [
        (p, s) for p in range(len(places)) for s in range(4) if p != here and (p, s) not in joined
    ]
    for place, slot in ends:
        seen = _turned(star, (slot + 2) % 4)
        if place < len(places) and seen != places[place]:
            continue
        after = {**joined, leaving: (place, slot), (place, slot): leaving}
        if all(allowed(after) for allowed in allows):
            yield (
                after,
                [*places, seen] if place == len(places) else places,
                (place, (slot + 2) % 4),
            )


def passes_no_place_twice(joined: Joined) -> bool:
    """Whether no street, straight on from slot to opposite slot, meets a place twice."""
    for start in joined:
        met, (place, slot) = {start[0]}, joined[start]
        while True:
            if place in met:
                return False
            met.add(place)
            if (onward := joined.get((place, (slot + 2) % 4))) is None:
                break
            place, slot = onward
    return True
