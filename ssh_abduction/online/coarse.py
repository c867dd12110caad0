"""Plan a coarse route by regions: which regions to leave and to enter, and which paths to pass.

A region behind a place can only be left and entered through this place, its door. So each route
from inside to outside leads through the door. If the start lies right of a path and the goal left
of it, the route passes from one side to the other (Kuipers 2000, "The Spatial Semantic Hierarchy":
boundary relations guide the search for a route).

>>> from ssh_abduction import Trace, solve
>>> trace = Trace.from_steps("abcdef", ["travel", "right", "travel", "left", "travel"])
>>> (ssh_map,) = solve(trace)
>>> print(*coarse_route(ssh_map, 0, 3), sep="; ")
leave region 0 through place 1; pass from right to left of path 1+; enter region 3 through place 2
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.regions import Region, course_named, numbered, right_of


@dataclass(frozen=True, slots=True)
class Leg:
    """A part of a coarse route.

    Attributes:
        move: "leave" or "enter" a region, or "pass" from one side of a path to the other.
        region: The id of the region; None for a path.
        door: The place through which the route leaves or enters the region; None for a path.
        path: The id of the path; None for a region.
        starts: The side of the path in direction +1 where the route starts: "right" or "left".
    """

    move: Literal["leave", "enter", "pass"]
    region: int | None = None
    door: int | None = None
    path: int | None = None
    starts: Literal["right", "left"] | None = None

    def __str__(self) -> str:
        return self.in_words(numbered)

    def in_words(self, called: Callable[[str, int], str]) -> str:
        """Say what to do.

        Args:
            called: Returns words for a kind ("place", "region") and a number, as `SSHMap.called`.
        """
        if self.region is not None and self.door is not None:
            return (
                f"{self.move} {called('region', self.region)} through {called('place', self.door)}"
            )
        assert self.path is not None
        ends = "left" if self.starts == "right" else "right"
        return f"pass from {self.starts} to {ends} of {course_named((self.path, 1))}"

    def to_dict(self) -> dict[str, Any]:
        """Return the leg as plain data, without fields that are None."""
        return {
            name: value for name in self.__slots__ if (value := getattr(self, name)) is not None
        }


def coarse_route(ssh_map: SSHMap, start: int, goal: int) -> tuple[Leg, ...]:
    """Find the regions to leave, the paths to pass and the regions to enter.

    Args:
        ssh_map: The map. Without regions, the route has no legs.
        start: The place where the route starts.
        goal: The place where it ends.

    Returns:
        The legs. Regions are left from the smallest on, and entered from the largest on.
    """
    leave, enter = (
        [r for r in _with_doors(ssh_map) if here in r.places and there not in r.places]
        for here, there in ((start, goal), (goal, start))
    )
    return (
        *(Leg("leave", r.id, r.door) for r in reversed(leave)),
        *_passed(ssh_map, start, goal),
        *(Leg("enter", r.id, r.door) for r in enter),
    )


def off_the_way(ssh_map: SSHMap, start: int, goal: int) -> set[int]:
    """Find the places in regions behind one place that hold neither the start nor the goal.

    A route that enters such a region has to come back through its door. It would be shorter to turn
    at the door. So the shortest route by places does not enter such regions.
    """
    closed = [r for r in _with_doors(ssh_map) if not {start, goal} & {*r.places}]
    return {place for region in closed for place in region.places}


def _with_doors(ssh_map: SSHMap) -> list[Region]:
    """List the regions behind one place, the largest first."""
    return [region for region in ssh_map.regions or () if region.door is not None]


def _passed(ssh_map: SSHMap, start: int, goal: int) -> list[Leg]:
    """List the paths that have the start on one side and the goal on the other."""
    found = []
    for path in ssh_map.paths:
        right, left = (right_of(ssh_map.regions or (), path.id, way) for way in (1, -1))
        if start in right and goal in left:
            found.append(Leg("pass", path=path.id, starts="right"))
        elif start in left and goal in right:
            found.append(Leg("pass", path=path.id, starts="left"))
    return found
