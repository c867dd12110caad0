"""Plan routes: the actions that lead from one dstate or place to another, and the views on the way.

A dstate (distinctive state) is a place and the direction that the robot faces there.

>>> from ssh_abduction import Theory, Trace, route, solve
>>> loop = Trace.from_steps(["a", "b", "c", "a", "b"], ["east", "east", "west", "east"])
>>> found = route(solve(loop, Theory.causal()), 0, 2)
>>> found.actions, found.views
(('east', 'east'), ('a', 'b', 'c'))
>>> print(found.sentence)
from dstate 0 to dstate 2: 2 actions

The Spatial Semantic Hierarchy has two levels for planning (Kuipers 2000, "The Spatial Semantic
Hierarchy"). At the *causal* level, a route is a chain of links: the robot did each action there
before. At the *topological* level, a route is a chain of places and paths: a path leads both ways,
and at a place the robot can turn to each path through the place. So a route by places exists even
if there is no chain of links, for example back along a street that was driven one way only. Moves
that were never tried are marked. A turn for which the map has no action gets the action None. In a
map without paths, such as that of a log, each travel also leads back.

A coarse route names the regions to leave and to enter, and the paths to pass. A region behind a
place can only be left and entered through this place, its door. If the start lies right of a path
and the goal left of it, the route passes from one side to the other.

>>> from ssh_abduction import Trace, solve
>>> trace = Trace.from_steps("abcdef", ["travel", "right", "travel", "left", "travel"])
>>> print(*coarse_route(solve(trace)[0], 0, 3), sep="; ")
leave region 0 through place 1; pass from right to left of path 1+; enter region 3 through place 2
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from collections.abc import Set as AbstractSet
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Literal, NoReturn

from ssh_abduction.data.checks import a_list, one_of
from ssh_abduction.data.errors import MapError, printable
from ssh_abduction.data.map_parts import (
    Region,
    course_named,
    named_by_number,
    right_of,
    signed_path,
)
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.schema import attributes_of, only_known
from ssh_abduction.data.trace import View
from ssh_abduction.data.words import counted
from ssh_abduction.online.move_graph import MoveGraph, Node
from ssh_abduction.rivals.listing import Listing, Maps

BY = ("actions", "places", "metres")


@dataclass(frozen=True, slots=True)
class Move:
    """One move of a route, and where it ends.

    Attributes:
        action: The name of the action; None if the map does not know which action does this move.
        known: Whether the map has a link for the move, so that the robot did it before. Otherwise
            the places and paths of the map imply the move.
        dstate: The dstate at the end; None if the robot never faced that way there.
        view: The view to expect at the end; None if it is unknown.
        place: The place at the end; None if the dstate has no place.
        path: The path that the robot faces along at the end; None if there is none.
        direction: The direction along this path, +1 or -1; None if there is no path.
        metres: The straight length of the move; None if the map has no poses.
    """

    action: str | None
    known: bool
    dstate: int | None
    view: View | None
    place: int | None
    path: int | None
    direction: int | None
    metres: float | None = None

    @property
    def course(self) -> str:
        """The path at the end with the sign of the direction, such as "2+"; "" without a path."""
        return signed_path(self.path, self.direction)

    def to_dict(self) -> dict[str, Any]:
        """Return the move as a dict for JSON, with its attributes as keys."""
        return {name: getattr(self, name) for name in self.__slots__ if name != "metres"} | (
            {} if self.metres is None else {"metres": round(self.metres, 4)}
        )


@dataclass(frozen=True, slots=True)
class Route:
    """The shortest route through a map.

    Attributes:
        map: The number of the map, from 1.
        by: What the route minimises: "actions", "places" or "metres".
        start: The dstate where it begins.
        goal: The dstate, place or region where it ends, in words.
        view: The view at the start.
        place: The place of the start; None if the dstate has no place.
        moves: The moves, in order.
        agree: The numbers, from 1, of the maps in which the same actions lead to the same views.
            In another map, the route begins at the dstates of the steps that are at `start` in
            this map. Empty if some move was never tried.
        maps: The number of maps that were compared.
        legs: The coarse route: the regions to leave and to enter, and the paths to pass. Empty if
            the map has no regions.
    """

    map: int
    by: str
    start: int
    goal: str
    view: View | None
    place: int | None
    moves: tuple[Move, ...]
    agree: tuple[int, ...] = ()
    maps: int = 1
    legs: tuple[Leg, ...] = ()

    @property
    def actions(self) -> tuple[str | None, ...]:
        """The names of the actions in order; None for a move whose action is unknown."""
        return tuple(move.action for move in self.moves)

    @property
    def views(self) -> tuple[View | None, ...]:
        """The views to expect, at the start and after each move; None for an unknown one."""
        return (self.view, *(move.view for move in self.moves))

    @property
    def dstates(self) -> tuple[int | None, ...]:
        """The dstates at the start and after each move; None for one where the robot never was."""
        return (self.start, *(move.dstate for move in self.moves))

    @property
    def places(self) -> tuple[int | None, ...]:
        """The places at the start and after each move; None for a dstate without a place."""
        return (self.place, *(move.place for move in self.moves))

    @property
    def metres(self) -> float | None:
        """The length of the route in metres; None if the map has no poses."""
        lengths = [move.metres for move in self.moves]
        return math.fsum(x for x in lengths if x is not None) if None not in lengths else None

    @property
    def is_known(self) -> bool:
        """Whether the robot has done all moves of the route before."""
        return all(move.known for move in self.moves)

    @property
    def sentence(self) -> str:
        """One sentence with the ends of the route and its length."""
        parts = [counted(len(self.moves), "actions")]
        if self.metres is not None and self.moves:
            parts.append(f"{self.metres:.1f} m")
        if untried := sum(not move.known for move in self.moves):
            some = "" if untried == len(self.moves) else f"{untried} of them "
            parts.append(f"{some}never tried, but implied by the places of the map")
        elif self.maps > 1:
            parts.append(f"{len(self.agree)} of {self.maps} maps expect the same views")
        if not self.moves:
            where = f"in {self.goal}" if self.goal.startswith("region") else f"at {self.goal}"
            where = "the goal" if self.goal == f"dstate {self.start}" else where
            return f"the start, dstate {self.start}, is {where}: there is nothing to do"
        return f"from dstate {self.start} to {self.goal}: {', '.join(parts)}"

    def to_dict(self) -> dict[str, Any]:
        """Return the route as a dict for JSON, as `route --json` prints it.

        The keys are names of attributes; docs/reference/formats.md has the exceptions.
        """
        length = self.metres
        return {
            **attributes_of(self, "map", "by"),
            **{"from": self.start, "to": self.goal, "summary": self.sentence},
            **attributes_of(self, "actions", "views", "dstates", "places"),
            **({} if length is None else {"metres": round(length, 4)}),
            "known": self.is_known,
            **attributes_of(self, "moves", *(["legs"] if self.legs else []), "agree", "maps"),
        }


def route(
    maps: Maps,
    start: int | str | None,
    goal: int | str,
    *,
    by: str = "actions",
    avoid: Iterable[int | str] = (),
    map: int | str = 1,
) -> Route:
    """Find the shortest route from one dstate, place or region to another.

    Args:
        maps: A solution, maps of one trace, or one map.
        start: The number of a dstate, or a step of a joint trace such as "monday:12"; or a place or
            region, such as "p3", "region2" or "kitchen", which means any dstate there; None for the
            dstate of the last step.
        goal: A dstate, place or region, named in the same way.
        by: What to minimise. "actions" and "metres" use links only, so the robot did each move
            before. "places" minimises travels, and also uses moves that the paths of the map imply,
            or the ways back of all travels if there are no paths.
        avoid: Dstates, places and regions that the route must not visit, named in the same way.
        map: The number of the map to use, from 1, or its id.

    Raises:
        MapError: There is no such dstate, place, region or map; no route exists; the map has no
            poses for "metres", or no places for "places".
    """
    one_of("by", by, BY, MapError, mend="say what the route minimises")
    listing = Listing.of(maps)
    number = listing.number(str(map))
    ssh_map = listing.maps[number]
    graph = MoveGraph(ssh_map, by, listing.drives)
    here, start_named = graph.nodes(ssh_map.dstate_at[-1] if start is None else start, "from")
    there, goal_named = graph.nodes(goal, "to")
    if not goal_named.startswith("dstate"):
        there = graph.nodes_in({graph.course(node)[0] for node in there})
    closed = _closed(graph, avoid)
    for nodes, name in ((here, "from"), (there, "to")):
        if nodes <= closed:
            raise MapError(
                f"avoid: expected a dstate of '{name}' that is not avoided, got none; do not avoid "
                "the start or the goal"
            )
    start_place, goal_place = _place_of(graph, here), _place_of(graph, there)
    aside: set[Node] = set()
    if by == "places" and start_place is not None and goal_place is not None:
        # First plan the coarse route by regions, then the route itself. By links alone, a robot may
        # have to enter a region only to turn around. So close regions only for a route by places.
        aside = graph.nodes_in(off_the_way(ssh_map, start_place, goal_place))
    way = graph.shortest(here - closed, there - closed, closed | aside)
    if way is None:
        by_places = False
        if by != "places" and ssh_map.places:
            with suppress(MapError):
                by_places = bool(route(listing, start, goal, by="places", avoid=avoid, map=map))
        _raise_no_route(graph, here, there, closed, (start_named, goal_named), by_places)
    moves = tuple(_move(graph, a, b) for a, b in pairwise(way))
    begin, end = (graph.course(node)[0] for node in (way[0], way[-1]))
    first = way[0]
    assert isinstance(first, int)  # routes begin at dstates
    is_known = all(move.known for move in moves)
    return Route(
        map=number + 1,
        by=by,
        start=first,
        goal=goal_named,
        view=ssh_map.dstates[first].view,
        place=ssh_map.dstates[first].place,
        moves=moves,
        agree=_agreeing(ssh_map, first, moves, listing.maps) if is_known else (),
        maps=len(listing.maps),
        legs=() if begin is None or end is None else coarse_route(ssh_map, begin, end),
    )


def _place_of(graph: MoveGraph, nodes: AbstractSet[Node]) -> int | None:
    """Find the place of these nodes; None if they have no place, or several."""
    places = {graph.course(node)[0] for node in nodes}
    return places.pop() if len(places) == 1 else None


def action_in_words(move: Move) -> str:
    """Say what to do in a move: its action or, if that is unknown, the path to turn to."""
    if move.action is not None:
        return printable(move.action)
    if move.path is None:
        return "(turn)"
    return f"(turn to path {move.course})"


def _closed(graph: MoveGraph, avoid: Iterable[int | str]) -> set[Node]:
    """Find the nodes that a route must not visit."""
    given = [avoid] if isinstance(avoid, str | int) else avoid
    closed: set[Node] = set()
    for i, name in enumerate(a_list("avoid", given, MapError, what="dstates and places")):
        closed |= graph.nodes(name, f"avoid[{i}]")[0]
    return closed


def _move(graph: MoveGraph, source: Node, target: Node) -> Move:
    """Make the move along an edge of the graph."""
    place, path, direction = graph.course(target)
    dstate = target if isinstance(target, int) else None
    return Move(
        action=graph.action(source, target),
        known=graph.is_known(source, target),
        dstate=dstate,
        view=None if dstate is None else graph.map.dstates[dstate].view,
        place=place,
        path=path,
        direction=direction,
        metres=graph.metres(source, target),
    )


def _raise_no_route(
    graph: MoveGraph,
    here: AbstractSet[Node],
    there: AbstractSet[Node],
    closed: AbstractSet[Node],
    names: tuple[str, str],
    by_places: bool,
) -> NoReturn:
    """Raise MapError with the reason why there is no route, and what to do about it.

    `names` are words for the start and the goal. `by_places` says whether there is a route by
    places.
    """
    begin, end = names
    implied = "take --by places: the places of the map imply a way that the robot has not driven"
    if closed and graph.shortest(here, there, set()) is not None:
        mend = implied if by_places else "avoid less"
        raise MapError(f"avoid: expected a way around what is avoided, got none to {end}; {mend}")
    opened = MoveGraph(replace(graph.map, faults=()), graph.by) if graph.closed else graph
    mend = "the robot has not driven from here to there; drive on"
    if not any(here & {*piece} and there & {*piece} for piece in graph.map.pieces):
        mend = "it is in another piece of the map; add a drive that leads there (solve --onto)"
    elif _floors(graph, here).isdisjoint(_floors(graph, there)):
        mend = "the robot used no lift and no stairs that lead to its floor; drive on"
    elif by_places:
        mend = f"{implied}, or drive on"
    elif opened.shortest(here, there, closed) is not None:
        mend = "no route passes a gateway that was last seen closed; drive on if it is open again"
    moves = "known and implied moves" if graph.by == "places" else "known links"
    reached = counted(graph.dstates_from(here), "dstates")
    raise MapError(
        f"to: expected a goal that {moves} lead to from {begin} (they reach {reached}), got "
        f"{end}; {mend}"
    )


def _floors(graph: MoveGraph, nodes: AbstractSet[Node]) -> set[int | None]:
    """Find the floors of those nodes that are dstates. A map without floors has the floor None."""
    return {graph.map.dstates[node].floor for node in nodes if isinstance(node, int)}


def _agreeing(
    ssh_map: SSHMap, start: int, moves: Sequence[Move], maps: Sequence[SSHMap]
) -> tuple[int, ...]:
    """The numbers, from 1, of the maps in which the moves of a route lead to the same views.

    In each map, the route begins at the dstates of the steps that are at `start` in `ssh_map`.
    """
    steps = [t for t, label in enumerate(ssh_map.dstate_at) if label == start]
    agree = []
    for i, rival in enumerate(maps, 1):
        leads = {(source, action): target for source, action, target in rival.links}
        starts = {rival.dstate_at[t] for t in steps}
        if all(_leads_to(leads, rival, label, moves) for label in starts):
            agree.append(i)
    return tuple(agree)


def _leads_to(
    leads: dict[tuple[int, str], int], ssh_map: SSHMap, dstate: int, moves: Sequence[Move]
) -> bool:
    """Whether a map has links for the actions of these moves, and they lead to the same views."""
    for move in moves:
        target = leads.get((dstate, move.action or ""))
        if target is None or ssh_map.dstates[target].view != move.view:
            return False
        dstate = target
    return True


@dataclass(frozen=True, slots=True)
class Leg:
    """A part of a coarse route.

    Attributes:
        move: "leave" or "enter" a region, or "pass" from one side of a path to the other.
        region: The id of the region; None for a path.
        door: The place through which the route leaves or enters the region; None for a path.
        path: The id of the path; None for a region.
        starts: The side from which the route passes the path: "right" or "left" of direction +1;
            None for a region.
    """

    move: Literal["leave", "enter", "pass"]
    region: int | None = None
    door: int | None = None
    path: int | None = None
    starts: Literal["right", "left"] | None = None

    def __str__(self) -> str:
        return self.in_words(named_by_number)

    def in_words(self, called: Callable[[str, int], str]) -> str:
        """Say what to do. `called` puts a kind and a number into words, as `SSHMap.called` does."""
        if self.region is not None and self.door is not None:
            return (
                f"{self.move} {called('region', self.region)} through {called('place', self.door)}"
            )
        assert self.path is not None
        ends = "left" if self.starts == "right" else "right"
        return f"pass from {self.starts} to {ends} of {course_named((self.path, 1))}"

    def to_dict(self) -> dict[str, Any]:
        """Return the leg as plain data, without fields that are None."""
        return only_known(**{name: getattr(self, name) for name in self.__slots__})


def coarse_route(ssh_map: SSHMap, start: int, goal: int) -> tuple[Leg, ...]:
    """Find the regions to leave, the paths to pass and the regions to enter from place to place.

    Regions are left from the smallest on, and entered from the largest on. In a map without
    regions, the route has no legs.

    Reference:
        Kuipers 2000, "The Spatial Semantic Hierarchy": boundary relations guide the search.
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
    """Find the places in regions that hold neither the place `start` nor the place `goal`.

    Only regions behind one place, their door, are considered.

    A route that enters such a region has to come back through the door. It would be shorter to turn
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
