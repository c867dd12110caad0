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
import re
from collections.abc import Callable, Iterable, Sequence
from collections.abc import Set as AbstractSet
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise, permutations
from typing import Any, Literal, NoReturn, TypeAlias

import networkx as nx

from ssh_abduction.data.checks import a_list, one_of
from ssh_abduction.data.drives import Drive, step_of
from ssh_abduction.data.errors import MapError, TraceError, brief, printable
from ssh_abduction.data.map_parts import (
    check_says_what,
    course_named,
    named_by_number,
    right_of,
    signed_path,
    thing_named,
)
from ssh_abduction.data.maps import DState, SSHMap
from ssh_abduction.data.schema import SparseData, attributes_of
from ssh_abduction.data.trace import View
from ssh_abduction.data.words import counted, meant
from ssh_abduction.output.layout import drawable_poses
from ssh_abduction.rivals.listing import Listing, Maps

BY = ("actions", "places", "metres")
# The number of a dstate (distinctive state: a place and a heading). Or a course (place, path,
# direction) that no dstate of the map faces. In a map without paths, the last two are None.
Node: TypeAlias = "int | tuple[int, int | None, int | None]"
# Costs of moves in a route by places. Among routes with equally many travels, the one with fewer
# actions wins. Among those with equally many actions, the one with more known moves wins.
KNOWN_MOVE, UNTRIED_MOVE, OPEN_TURN = 1.0, 1.5, 2.5
# Cost of an action in a route by metres, so that fewer actions win among routes of equal length.
MICROMETRE = 1e-6
# A dstate faces a gateway if its heading is at most this many degrees off the gateway's bearing.
FACING = 20


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
        origin: The dstate where it begins, and its place, in words.
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
    origin: str
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
            where = "the goal" if self.goal == self.origin else where
            return f"the start, {self.origin}, is {where}: there is nothing to do"
        return f"from {self.origin} to {self.goal}: {', '.join(parts)}"

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
    by: str | None = None,
    avoid: Iterable[int | str] = (),
    map: int | str = 1,
) -> Route:
    """Find the shortest route from one dstate, place or region to another.

    Args:
        maps: A solution, maps of one trace, or one map.
        start: The number of a dstate, such as 7 or "d7"; or a step such as "monday:12"; or a place,
            path, region, corridor, room or door, such as "p3", "room2" or "kitchen", which means
            any dstate there; None for the dstate of the last step.
        goal: A dstate, place and so on, named in the same way.
        by: What to minimise. "actions" and "metres" use links only: moves that the robot has made.
            "places" minimises travels. It also uses moves that the robot has not made: along the
            paths of the map or, if the map has no paths, back along each travel. None means
            "actions" if links lead to the goal, else "places".
        avoid: What the route must not visit, named in the same way. A door is not passed.
        map: The number of the map to use, from 1, or its id.

    Raises:
        MapError: There is no such dstate, place, region or map; no route exists; the map has no
            poses for "metres", or no places for "places".
    """
    chosen = "actions" if by is None else by
    one_of("by", chosen, BY, MapError, mend="say what the route minimises")
    listing = Listing.of(maps)
    number = listing.number(str(map))
    ssh_map = listing.maps[number]
    graph = MoveGraph(ssh_map, chosen, listing.drives)
    here, start_named = graph.nodes(ssh_map.dstate_at[-1] if start is None else start, "from")
    there, goal_named = graph.nodes(goal, "to")
    if not goal_named.startswith("dstate"):
        there = graph.nodes_in({graph.course(node)[0] for node in there})
    avoided = [avoid] if isinstance(avoid, str | int) else avoid
    given = a_list("avoid", avoided, MapError, what="dstates and places")
    closed = {node for i, name in enumerate(given) for node in graph.nodes(name, f"avoid[{i}]")[0]}
    for nodes, name in ((here, "from"), (there, "to")):
        if nodes <= closed:
            raise MapError(
                f"avoid: expected a dstate of '{name}' that is not avoided, got none; do not avoid "
                "the start or the goal"
            )
    way = graph.shortest(here - closed, there - closed, closed)
    if way is None:
        by_places: Route | None = None
        if by != "places" and ssh_map.places:
            with suppress(MapError):
                by_places = route(listing, start, goal, by="places", avoid=given, map=map)
        if by is None and by_places is not None:
            return by_places
        ends = start_named, goal_named
        _raise_no_route(graph, here, there, closed, ends, by_places is not None)
    moves = tuple(graph.move(a, b) for a, b in pairwise(way))
    begin, end = (graph.course(node)[0] for node in (way[0], way[-1]))
    first = way[0]
    assert isinstance(first, int)  # routes begin at dstates
    is_known = all(move.known for move in moves)
    return Route(
        map=number + 1,
        by=graph.by,
        start=first,
        origin=graph.dstate_called(first),
        goal=goal_named,
        view=ssh_map.dstates[first].view,
        place=begin,
        moves=moves,
        agree=_agreeing(ssh_map, first, moves, listing.maps) if is_known else (),
        maps=len(listing.maps),
        legs=() if begin is None or end is None else coarse_route(ssh_map, begin, end),
    )


def action_in_words(move: Move) -> str:
    """Say what to do in a move: its action or, if that is unknown, the path to turn to."""
    if move.action is not None:
        return printable(move.action)
    if move.path is None:
        return "(turn)"
    return f"(turn to path {move.course})"


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
    opened = MoveGraph(replace(graph.map, faults=()), graph.by)
    floors = [
        {graph.map.dstates[n].floor for n in ns if isinstance(n, int)} for ns in (here, there)
    ]
    mend = "the robot has not driven from here to there; drive on"
    if not any(here & {*piece} and there & {*piece} for piece in graph.map.pieces):
        mend = "it is in another piece of the map; add a drive that leads there (solve --onto)"
    elif floors[0].isdisjoint(floors[1]):
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


def _agreeing(
    ssh_map: SSHMap, start: int, moves: Sequence[Move], maps: Sequence[SSHMap]
) -> tuple[int, ...]:
    """The numbers, from 1, of the maps in which the moves of a route lead to the same views.

    In each map, the route begins at the dstates of the steps that are at `start` in `ssh_map`.
    """
    steps = [t for t, label in enumerate(ssh_map.dstate_at) if label == start]

    def leads_to_same_views(rival: SSHMap, dstate: int) -> bool:
        leads = {(source, action): target for source, action, target in rival.links}
        for move in moves:
            target = leads.get((dstate, move.action or ""))
            if target is None or rival.dstates[target].view != move.view:
                return False
            dstate = target
        return True

    return tuple(
        i
        for i, rival in enumerate(maps, 1)
        if all(leads_to_same_views(rival, label) for label in {rival.dstate_at[t] for t in steps})
    )


class MoveGraph:
    """A directed graph whose edges are the moves that are possible in a map, with costs.

    Nodes are dstates, and also courses (place, path, direction) that no dstate faces. Edges are
    links; for routes by places also moves that paths imply or, in a map without paths such as that
    of a log, the way back of each travel. No edge passes a gateway that was closed when a drive
    last saw it.

    `by` says what the shortest route minimises: "actions", "places" or "metres". The drives of the
    map's trace serve to find steps such as "monday:12". Raises MapError if the map has no poses for
    "metres", or no places for "places".
    """

    def __init__(self, ssh_map: SSHMap, by: str, drives: Sequence[Drive] = ()) -> None:
        self.map, self.by, self._drives = ssh_map, by, drives
        self._poses = drawable_poses(ssh_map)
        if by == "metres" and self._poses is None:
            raise MapError(
                "by: expected actions or places, got metres: the map has no poses; solve a trace "
                "with displacements, and without a short time limit, or take --by actions"
            )
        if by == "places" and not ssh_map.places:
            raise MapError(
                "by: expected actions or metres, got places: the map has no places; "
                "solve with --theory topological, or take --by actions"
            )
        # One travel costs more than all turns of a route together, as a route has at most as many
        # moves as there are dstates and courses.
        courses = 2 * sum(len(path.order) for path in ssh_map.theory_paths) + len(ssh_map.places)
        self._travel_cost = OPEN_TURN * (len(ssh_map.dstates) + courses)
        # The place, slot and bearing of each gateway that was last seen closed.
        changes = (fault for fault in ssh_map.faults if fault.kind == "changed")
        last = {(fault.place, fault.gateway, fault.bearing): fault for fault in changes}
        self._shut = [at for at, fault in last.items() if str(fault.seen).startswith("closed")]
        self._graph: nx.DiGraph[Any] = nx.DiGraph()
        self._graph.add_nodes_from(s.id for s in ssh_map.dstates)
        # Sort in reverse, so that the first action by name remains if several join two dstates.
        for source, action, target in sorted(ssh_map.links, reverse=True):
            if source != target:
                self._add(source, target, action, known=True)
        if by == "places":
            self._add_implied()

    def nodes(self, name: int | str, field: str) -> tuple[set[Node], str]:
        """Return the dstates that a user names, and words for them, such as "place 3".

        `name` is a dstate, place, path, region, corridor, room or door by its number, such as "d3",
        "p3" or "room2", or a name that a person gave. All but a dstate stand for all dstates there,
        and a step such as "monday:12" for its dstate. The int 3 is dstate 3. But the text "3" is
        refused if the map has places, as it may be a place, too. `field` is the name of the user's
        parameter, for messages. Raises MapError, which lists what exists.
        """
        if isinstance(name, str) and self.map.places:
            check_says_what(name, self._drives[0].name if self._drives else None)
        kind, number = thing_named(str(name), self.map.names) or (None, -1)
        if kind is None and self._drives and re.search("^step|:", str(name)):
            try:
                kind, number = "dstate", self.map.dstate_at[step_of(self._drives, str(name))]
            except TraceError as error:
                raise MapError(f"{field}: {error}") from None
        things = self.map.things()
        places = things.get(kind or "", {}).get(number, ())
        found: set[Node] = {s.id for s in self.map.dstates if s.place in places}
        if kind == "dstate":
            found = {s.id for s in self.map.dstates if s.id == number}
        elif kind == "door" and places and field.startswith("avoid"):
            found = {*self.map.doors[number].dstates}  # Travels through it begin there.
        if found and kind:
            if kind == "dstate":
                return found, self.dstate_called(number)
            return found, self.map.called(kind, number)
        known = "".join(
            f", or a {k} as {'p' if k == 'place' else k}{min(some)}" for k, some in things.items()
        )
        names = [n.text for n in self.map.names]
        known += f", or {', '.join(names)}" if names else ""
        raise MapError(
            f"{field}: expected a dstate, 0 to {len(self.map.dstates) - 1}{known}, got "
            f"{brief(name)}{meant(name, names, 3) or ';'} ssh-abduction show lists them"
        )

    def dstate_called(self, number: int) -> str:
        """Return the number of a dstate and its place: "dstate 3 at place 1 (kitchen)"."""
        place = self.map.dstates[number].place
        where = "" if place is None else f" at {self.map.called('place', place)}"
        return f"dstate {number}{where}"

    def nodes_in(self, places: AbstractSet[int | None]) -> set[Node]:
        """Find all nodes that are at these places."""
        return {node for node in self._graph if self.course(node)[0] in places}

    def shortest(
        self, here: AbstractSet[Node], there: AbstractSet[Node], closed: AbstractSet[Node]
    ) -> list[Node] | None:
        """Return the nodes of the shortest way from some nodes to others; None if there is none.

        The way includes both ends, and does not visit the nodes that are `closed`.
        """
        # If all dstates of a place are closed, close its other courses, too.
        closed_places = {
            self._place(node)
            for node in closed
            if all(s.id in closed for s in self.map.dstates if s.place == self._place(node))
        }
        graph = self._graph.subgraph(
            node
            for node in self._graph
            if node not in closed and not (isinstance(node, tuple) and node[0] in closed_places)
        )
        cost, way = nx.multi_source_dijkstra(graph, here, weight="cost")
        found = min(((cost[node], str(node), node) for node in there if node in cost), default=None)
        return None if found is None else way[found[2]]

    def dstates_from(self, here: AbstractSet[Node]) -> int:
        """Count the dstates that can be reached from the given nodes, including these."""
        reached = nx.multi_source_dijkstra_path_length(self._graph, here)
        return sum(isinstance(node, int) for node in reached)

    def move(self, source: Node, target: Node) -> Move:
        """Return the move along an edge."""
        move: Move = self._graph.edges[source, target]["move"]
        return move

    def course(self, node: Node) -> tuple[int | None, int | None, int | None]:
        """Return the place, path and direction of a node. Each is None if the node has none."""
        if isinstance(node, tuple):
            return node
        s = self.map.dstates[node]
        return s.place, s.path, s.direction

    def _metres(self, source: Node, target: Node) -> float | None:
        """Return the straight distance of a move in metres; None if the map has no poses.

        A lift has the length 0, as floors have no common frame.
        """
        if self._poses is None:
            return None
        if self._floor(source) != self._floor(target):
            return 0.0
        a, b = (self._poses[s.id] for node in (source, target) if (s := self._dstate(node)))
        return math.hypot(a.x - b.x, a.y - b.y)

    def _dstate(self, node: Node) -> DState | None:
        """Return the dstate of a node; for a course, the first dstate at its place, if any."""
        if isinstance(node, int):
            return self.map.dstates[node]
        return next((s for s in self.map.dstates if s.place == node[0]), None)

    def _floor(self, node: Node) -> int | None:
        """Return the floor of a node; None if the map has no floors."""
        here = self._dstate(node)
        return here.floor if here else None

    def _add(self, source: Node, target: Node, action: str | None, *, known: bool) -> None:
        """Add a move, unless it passes a gateway that was last seen closed."""
        if self._passes_closed(source, target):
            return
        metres = self._metres(source, target)
        travel = self._travel_cost * (self._place(source) != self._place(target))
        unit = KNOWN_MOVE if known else UNTRIED_MOVE if action else OPEN_TURN
        costs = {"actions": 1.0, "metres": (metres or 0.0) + MICROMETRE, "places": unit + travel}
        dstate = target if isinstance(target, int) else None
        view = None if dstate is None else self.map.dstates[dstate].view
        move = Move(action, known, dstate, view, *self.course(target), metres)
        self._graph.add_edge(source, target, cost=costs[self.by], move=move)

    def _imply(self, source: Node, target: Node, action: str | None) -> None:
        """Add an implied move, unless the map has a link for it or it leads to another floor."""
        is_known = self._graph.has_edge(source, target)
        if not is_known and self._floor(source) == self._floor(target):
            self._add(source, target, action, known=False)

    def _add_implied(self) -> None:
        """Add the moves that the paths of the map imply.

        A path leads both ways, so the robot can go back where it travelled. At a place it can turn
        to each path through this place. Two places next to each other in the order of a path may
        have a wall between them if no travel joins them. In a map without paths, the robot can go
        back on each travel, and turn to all directions that it faced at a place.
        """
        travel, around = self._only_action(onward=True), self._only_action(onward=False)
        facing: dict[Node, Node] = {}  # the first dstate of each course
        at: dict[int, set[Node]] = {}  # the nodes of each place
        for s in self.map.dstates:
            if s.place is not None:
                at.setdefault(s.place, set()).add(s.id)
                if s.path is not None and s.direction is not None:
                    facing.setdefault((s.place, s.path, s.direction), s.id)
        paths = self.map.theory_paths
        courses: list[tuple[int, int | None, int | None]] = [
            (place, p.id, way) for p in paths for place in p.order for way in (1, -1)
        ]
        for course in courses or [(place, None, None) for place in at]:
            at.setdefault(course[0], set()).add(facing.get(course, course))
        for source, _, target in self.map.links:
            (here, path, way), (there, other, _) = self.course(source), self.course(target)
            if here is None or there is None or here == there:
                continue
            if not paths:
                for node in at[there]:
                    self._imply(node, (here, None, None), travel)
            elif path is not None and path == other and way is not None:
                start, end = (there, path, -way), (here, path, -way)
                self._imply(facing.get(start, start), facing.get(end, end), travel)
        for nodes in at.values():
            for node, aside in permutations(nodes, 2):
                (_, path, way), (_, other, other_way) = self.course(node), self.course(aside)
                is_around = path is not None and path == other and way != other_way
                self._imply(node, aside, around if is_around else None)

    def _passes_closed(self, source: Node, target: Node) -> bool:
        """Whether a move leaves or enters a place by a gateway that was last seen closed."""
        if self._place(source) == self._place(target) or self._floor(source) != self._floor(target):
            return False
        return self._faces_closed(source, 0) or self._faces_closed(target, 180)

    def _faces_closed(self, node: Node, turned: int) -> bool:
        """Whether a robot at a node, turned by some degrees, faces a gateway last seen closed."""
        place, path, way = self.course(node)
        here = [s for s in self.map.dstates if s.place == place and s.heading is not None]
        facing = [(s.heading, turned) for s in here if s.id == node]
        if isinstance(node, tuple):  # no dstate faces this way, but one may face the other way
            facing = [
                (s.heading, turned + 180 * (s.direction != way)) for s in here if s.path == path
            ]
        for at, slot, bearing in self._shut:
            unit, gateway = (90, slot) if bearing is None else (1, bearing)
            off = [unit * ((heading or 0) - (gateway or 0)) + more for heading, more in facing]
            if at == place and any(abs((degrees + 180) % 360 - 180) <= FACING for degrees in off):
                return True
        return False

    def _only_action(self, *, onward: bool) -> str | None:
        """Return the action that goes on along paths or, if not `onward`, turns around on them.

        None if the links of the map have no such action, or several.
        """
        dstates, names = self.map.dstates, set()
        for source, action, target in self.map.links:
            s, x = dstates[source], dstates[target]
            moves = s.place != x.place if onward else s.direction != x.direction
            if s.path == x.path and moves and (s.path is not None or not self.map.theory_paths):
                names.add(action)
        return names.pop() if len(names) == 1 else None

    def _place(self, node: Node) -> int:
        """Return the place of a node, or the `DState.site` of a dstate without a place."""
        return self.map.dstates[node].site if isinstance(node, int) else node[0]


@dataclass(frozen=True, slots=True)
class Leg(SparseData):
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


def coarse_route(ssh_map: SSHMap, start: int, goal: int) -> tuple[Leg, ...]:
    """Find the regions to leave, the paths to pass and the regions to enter from place to place.

    Regions are left from the smallest on, and entered from the largest on. In a map without
    regions, the route has no legs.

    Reference:
        Kuipers 2000, "The Spatial Semantic Hierarchy": boundary relations guide the search.
    """
    with_doors = [region for region in ssh_map.regions or () if region.door is not None]
    leave, enter = (
        [r for r in with_doors if here in r.places and there not in r.places]
        for here, there in ((start, goal), (goal, start))
    )
    return (
        *(Leg("leave", r.id, r.door) for r in reversed(leave)),
        *_passed(ssh_map, start, goal),
        *(Leg("enter", r.id, r.door) for r in enter),
    )


def _passed(ssh_map: SSHMap, start: int, goal: int) -> list[Leg]:
    """List the paths that have the start on one side and the goal on the other."""
    found = []
    for path in ssh_map.theory_paths:
        right, left = (right_of(ssh_map.regions or (), path.id, way) for way in (1, -1))
        if start in right and goal in left:
            found.append(Leg("pass", path=path.id, starts="right"))
        elif start in left and goal in right:
            found.append(Leg("pass", path=path.id, starts="left"))
    return found
