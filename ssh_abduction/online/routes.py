"""Routes: which actions lead from one dstate or place of a map to another, and which views to expect on the way.

>>> from ssh_abduction import Theory, Trace, route, solve
>>> loop = Trace.from_steps(["a", "b", "c", "a", "b"], ["east", "east", "west", "east"])
>>> found = route(solve(loop, Theory.causal()), 0, 2)
>>> found.actions, found.views
(('east', 'east'), ('a', 'b', 'c'))
>>> print(found.sentence)
from dstate 0 to dstate 2: 2 actions

The Spatial Semantic Hierarchy knows two levels to plan at (Kuipers 2000, "The Spatial Semantic Hierarchy"). At the *causal* level a route is a chain of links: each of its actions was
taken there before. At the *topological* level it is a chain of places and paths: a path leads both ways, and at a place the robot can turn to each path of it. So a route by places may lead
where no chain of links does, as back along a street that was driven one way alone. What it then asks for was not tried: such moves are marked, and a turn that the map has no action for is left open.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NoReturn, TypeAlias

import networkx as nx

from ssh_abduction.data.checks import a_list
from ssh_abduction.data.errors import MapError, brief, is_whole, printable
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import View
from ssh_abduction.data.words import counted
from ssh_abduction.output.layout import located
from ssh_abduction.rivals.listing import Listing, Maps

if TYPE_CHECKING:
    from ssh_abduction.data.maps import DState, Pose

BY = ("actions", "places", "metres")
# A dstate by its number, or a course of a place that no dstate of the map faces: (place, path, direction).
Node: TypeAlias = "int | tuple[int, int, int]"
# What is added to a move of a route by places so that fewer actions win among routes of equally many places, and known moves among equally many actions.
KNOWN_MOVE, UNTRIED_MOVE, OPEN_TURN = 1.0, 1.5, 2.5
MICROMETRE = 1e-6  # what an action counts in a route by metres: so that of equally long routes the one with the fewest actions is taken


@dataclass(frozen=True, slots=True)
class Move:
    """One move of a route, and where it ends.

    action     what to do; None where the robot has to turn to another path, and the map has no action for that turn
    known      whether the robot did this before, as a link of the map says; else the paths of the map imply it
    dstate     where the move ends; None where the robot was never there facing that way
    view       the view to expect there; None where the map does not know it
    place, path, direction  where that is, and which way the robot faces then; None where the map has none
    metres     how far the move leads in a straight line; None where the map has no poses
    """

    action: str | None
    known: bool
    dstate: int | None
    view: View | None
    place: int | None
    path: int | None
    direction: int | None
    metres: float | None = None

    def to_dict(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in self.__slots__ if name != "metres"} | (
            {} if self.metres is None else {"metres": round(self.metres, 4)}
        )


@dataclass(frozen=True, slots=True)
class Route:
    """The shortest route through a map.

    map     the number of the map, from 1
    by      what the route has the fewest of: actions, places, or metres
    start   the dstate that it begins at
    goal    the dstate or the place that it leads to, in words
    view, place  what is seen at the start, and where that is; the place is None where the map has none
    moves   what to do, and what is seen after it
    agree   numbers of the listed maps in which these actions, begun where the robot was at `start`, lead along links to the same views; empty for a route with a
            move that was never tried, as no links tell what comes then
    maps    how many maps are listed
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

    @property
    def actions(self) -> tuple[str | None, ...]:
        """The actions, in their order; None for a turn that the map has no action for."""
        return tuple(move.action for move in self.moves)

    @property
    def views(self) -> tuple[View | None, ...]:
        """The views to expect: at the start, and after each move."""
        return (self.view, *(move.view for move in self.moves))

    @property
    def dstates(self) -> tuple[int | None, ...]:
        """The dstates on the way, the start first."""
        return (self.start, *(move.dstate for move in self.moves))

    @property
    def places(self) -> tuple[int | None, ...]:
        """The places on the way, that of the start first."""
        return (self.place, *(move.place for move in self.moves))

    @property
    def metres(self) -> float | None:
        """The length of the route; None where the map has no poses."""
        lengths = [move.metres for move in self.moves]
        return math.fsum(x for x in lengths if x is not None) if None not in lengths else None

    @property
    def is_known(self) -> bool:
        """Whether the robot has done each of these moves before."""
        return all(move.known for move in self.moves)

    @property
    def sentence(self) -> str:
        """The route in one sentence."""
        parts = [counted(len(self.moves), "actions")]
        if self.metres is not None and self.moves:
            parts.append(f"{self.metres:.1f} m")
        if untried := sum(not move.known for move in self.moves):
            parts.append(f"{untried} of them never tried, but implied by the paths of the map")
        elif self.maps > 1:
            parts.append(f"{len(self.agree)} of {self.maps} maps expect the same views")
        if not self.moves:
            return (
                f"dstate {self.start} is {self.goal}: there is nothing to do"
                if self.goal == f"dstate {self.start}"
                else f"dstate {self.start} is at {self.goal}"
            )
        return f"from dstate {self.start} to {self.goal}: {', '.join(parts)}"

    def to_dict(self) -> dict[str, Any]:
        """The route as plain data, as `route --json` prints it (docs/formats.md)."""
        length = self.metres
        return {
            "map": self.map,
            "by": self.by,
            "from": self.start,
            "to": self.goal,
            "summary": self.sentence,
            "actions": list(self.actions),
            "views": list(self.views),
            "dstates": list(self.dstates),
            "places": list(self.places),
            **({} if length is None else {"metres": round(length, 4)}),
            "known": self.is_known,
            "moves": [move.to_dict() for move in self.moves],
            "agree": list(self.agree),
            "maps": self.maps,
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
    """The shortest route from one dstate or place to another.

    maps   a solution, maps of one trace, or one map
    start  the number of a dstate, or a place as "p3"; None for where the robot was at its last step
    goal   the number of a dstate, or a place as "p3": any dstate there
    by     "actions" or "metres": through links, so that each move was made before. "places": the fewest travels along the paths of the map, whether they were driven that way or not
    avoid  dstates and places that the route may not touch; places as "p3"
    map    which map: its number, from 1, or its id

    Raises MapError where there is no such dstate, place or map, where no route exists, and where metres are asked of a map without poses.
    """
    if not isinstance(by, str) or by not in BY:
        raise MapError(
            f"by: expected {', '.join(BY[:-1])} or {BY[-1]}, got {brief(by)}; say what the route shall have the fewest of"
        )
    listing = Listing.of(maps)
    number = listing.number(str(map))
    return _Roads(listing.maps[number], by).route(start, goal, avoid, number, listing.maps)


class _Roads:
    """One map as a graph of moves."""

    def __init__(self, ssh_map: SSHMap, by: str) -> None:
        self.map, self.by = ssh_map, by
        self.poses = located(ssh_map)
        if by == "metres" and self.poses is None:
            raise MapError(
                "by: expected actions or places, got metres: the map has no poses; solve a trace with displacements, or take --by actions"
            )
        if by == "places" and not ssh_map.paths:
            raise MapError(
                "by: expected actions or metres, got places: the map has no paths; solve with --theory topological, or take --by actions"
            )
        self.travel, self.around = self._only_action(onward=True), self._only_action(onward=False)
        self.graph = self._graph()

    def route(
        self,
        start: int | str | None,
        goal: int | str,
        avoid: Iterable[int | str],
        number: int,
        maps: Sequence[SSHMap],
    ) -> Route:
        here, _ = self._nodes(self.map.labels[-1] if start is None else start, "from")
        there, told = self._nodes(goal, "to")
        if told.startswith("place"):
            wanted = {self._place(node) for node in there}
            there = {node for node in self.graph if self._place(node) in wanted}
        closed: set[Node] = set()
        for i, name in enumerate(
            [avoid]
            if isinstance(avoid, str | int)
            else a_list("avoid", avoid, MapError, what="dstates and places")
        ):
            closed |= self._nodes(name, f"avoid[{i}]")[0]
        for nodes, name in ((here, "from"), (there, "to")):
            if nodes <= closed:
                raise MapError(
                    f"avoid: expected other dstates and places than those of {name}, got the same; take it out of what is avoided"
                )
        way = self._shortest(here - closed, there - closed, closed)
        if way is None:
            self._raise_no_route(here, there, closed, told)
        moves = tuple(self._move(a, b) for a, b in pairwise(way))
        first = way[0]
        assert isinstance(first, int)  # routes begin at dstates
        agree = self._agreeing(first, moves, maps) if all(move.known for move in moves) else ()
        return Route(
            number + 1,
            self.by,
            first,
            told,
            self.map.dstates[first].view,
            self.map.dstates[first].place,
            moves,
            agree,
            len(maps),
        )

    def _graph(self) -> nx.DiGraph[Any]:
        graph: nx.DiGraph[Any] = nx.DiGraph()
        graph.add_nodes_from(s.id for s in self.map.dstates)
        for source, action, target in sorted(
            self.map.links, reverse=True
        ):  # of several actions between two dstates the first by name stays
            if source != target:
                graph.add_edge(
                    source, target, action=action, cost=self._cost(source, target, KNOWN_MOVE)
                )
        if self.by == "places":
            self._add_implied(graph)
        return graph

    def _add_implied(self, graph: nx.DiGraph[Any]) -> None:
        """What the paths of the map imply: paths lead both ways, and at a place the robot can turn to each path."""
        facing: dict[Node, Node] = {}
        for s in reversed(self.map.dstates):
            if s.place is not None and s.path is not None and s.direction is not None:
                facing[s.place, s.path, s.direction] = s.id
        at: dict[int, set[Node]] = {}
        for s in self.map.dstates:
            if s.place is not None:
                at.setdefault(s.place, set()).add(s.id)
        for path in self.map.paths:
            for place in path.order:
                at.setdefault(place, set()).update(
                    facing.get((place, path.id, way), (place, path.id, way)) for way in (1, -1)
                )
            for p, q in pairwise(path.order):
                for a, b, way in ((p, q, 1), (q, p, -1)):
                    self._imply(
                        graph,
                        facing.get((a, path.id, way), (a, path.id, way)),
                        facing.get((b, path.id, way), (b, path.id, way)),
                        self.travel,
                    )
        for courses in at.values():
            for course in courses:
                for other in courses - {course}:
                    self._imply(
                        graph,
                        course,
                        other,
                        self.around if self._is_around(course, other) else None,
                    )

    def _imply(
        self, graph: nx.DiGraph[Any], source: Node, target: Node, action: str | None
    ) -> None:
        if not graph.has_edge(source, target):
            graph.add_edge(
                source,
                target,
                action=action,
                implied=True,
                cost=self._cost(source, target, UNTRIED_MOVE if action else OPEN_TURN),
            )

    def _is_around(self, source: Node, target: Node) -> bool:
        """Whether two courses of one place are the two ways along one path."""
        (_, path, way), (_, other, other_way) = self._course(source), self._course(target)
        return path is not None and path == other and way != other_way

    def _cost(self, source: Node, target: Node, move: float) -> float:
        if self.by == "actions":
            return 1.0
        if self.by == "metres":
            return (self._metres(source, target) or 0.0) + MICROMETRE
        # A route has no more moves than there are courses, so that one travel costs more than all turns that it might spare.
        return move + (
            OPEN_TURN
            * (len(self.map.dstates) + 2 * sum(len(path.order) for path in self.map.paths))
            if self._place(source) != self._place(target)
            else 0.0
        )

    def _only_action(self, *, onward: bool) -> str | None:
        """The action that moves onward along paths from place to place, or the one that turns around on a path, if there is one alone."""
        ends = [
            (self.map.dstates[s], action, self.map.dstates[x]) for s, action, x in self.map.links
        ]
        names = {
            action
            for s, action, x in ends
            if s.path is not None
            and s.path == x.path
            and (s.place != x.place if onward else s.direction != x.direction)
        }
        return names.pop() if len(names) == 1 else None

    def _nodes(self, name: int | str, field: str) -> tuple[set[Node], str]:
        """The dstates that are meant, and how to call them. Raises MapError that names the range."""
        count = len(self.map.dstates)
        text = str(name)
        if isinstance(name, str) and text[:1] == "p" and _is_number(text[1:]):
            place = int(text[1:])
            members: set[Node] = {s.id for s in self.map.dstates if s.place == place}
            if not members:
                known = sorted({s.place for s in self.map.dstates if s.place is not None})
                there = (
                    f"p{known[0]} to p{known[-1]}"
                    if known
                    else "a dstate, as the map has no places"
                )
                raise MapError(
                    f"{field}: expected {there}, got {brief(text)}; ssh-abduction show lists them"
                )
            return members, f"place {place}"
        if (is_whole(name) or (isinstance(name, str) and _is_number(text))) and 0 <= int(
            text
        ) < count:
            return {int(text)}, f"dstate {int(text)}"
        places = f", or a place as p{self.map.places[0]}" if self.map.places else ""
        raise MapError(
            f"{field}: expected a dstate, 0 to {count - 1}{places}, got {brief(name)}; ssh-abduction show lists them"
        )

    def _shortest(self, here: set[Node], there: set[Node], closed: set[Node]) -> list[Node] | None:
        places = {
            self._place(node)
            for node in closed
            if all(s.id in closed for s in self.map.dstates if s.place == self._place(node))
        }
        graph = self.graph.subgraph(
            [
                node
                for node in self.graph
                if node not in closed and not (isinstance(node, tuple) and node[0] in places)
            ]
        )
        cost, way = nx.multi_source_dijkstra(graph, here, weight="cost")
        found = min(((cost[node], str(node), node) for node in there if node in cost), default=None)
        return None if found is None else way[found[2]]

    def _raise_no_route(
        self, here: set[Node], there: set[Node], closed: set[Node], told: str
    ) -> NoReturn:
        if closed and self._shortest(here, there, set()) is not None:
            raise MapError(
                f"avoid: expected a way round what is avoided, got none to {told}; avoid less"
            )
        mend = (
            "take --by places, which may lead where the robot has not driven, or drive on"
            if self.by != "places" and self.map.paths
            else "drive on: next says what to try"
        )
        reached = len({node for node in self._reached(here) if isinstance(node, int)})
        raise MapError(
            f"to: expected one of the {counted(reached, 'dstates')} that known links lead to, got {told}; {mend}"
        )

    def _reached(self, here: set[Node]) -> set[Node]:
        return set(nx.multi_source_dijkstra_path_length(self.graph, here))

    def _move(self, source: Node, target: Node) -> Move:
        edge = self.graph.edges[source, target]
        known = "implied" not in edge
        place, path, direction = self._course(target)
        if isinstance(target, tuple):
            return Move(
                edge["action"],
                known,
                None,
                None,
                place,
                path,
                direction,
                self._metres(source, target),
            )
        return Move(
            edge["action"],
            known,
            target,
            self.map.dstates[target].view,
            place,
            path,
            direction,
            self._metres(source, target),
        )

    def _course(self, node: Node) -> tuple[int | None, int | None, int | None]:
        if isinstance(node, tuple):
            return node
        s = self.map.dstates[node]
        return s.place, s.path, s.direction

    def _place(self, node: Node) -> int:
        """The place of a node; of a dstate without one, a number of its own."""
        place = self._course(node)[0]
        return -1 - int(node) if place is None and isinstance(node, int) else int(place or 0)

    def _metres(self, source: Node, target: Node) -> float | None:
        if self.poses is None:
            return None
        a, b = (self._pose(node, self.poses) for node in (source, target))
        return math.hypot(a.x - b.x, a.y - b.y)

    def _pose(self, node: Node, poses: Sequence[Pose]) -> Pose:
        if isinstance(node, int):
            return poses[node]
        return poses[next(s.id for s in self.map.dstates if s.place == node[0])]

    def _agreeing(
        self, start: int, moves: Sequence[Move], maps: Sequence[SSHMap]
    ) -> tuple[int, ...]:
        """The numbers of the maps in which the moves, from wherever the robot was when this map has it at the start, lead to the same views."""
        steps = [t for t, label in enumerate(self.map.labels) if label == start]
        agree = []
        for i, rival in enumerate(maps):
            leads = {(source, action): target for source, action, target in rival.links}
            if all(
                _leads_to(leads, rival.dstates, label, moves)
                for label in {rival.labels[t] for t in steps}
            ):
                agree.append(i + 1)
        return tuple(agree)


def _leads_to(
    leads: dict[tuple[int, str], int], dstates: Sequence[DState], dstate: int, moves: Sequence[Move]
) -> bool:
    """Whether the links of a map lead from a dstate along these moves, to the views that they expect."""
    for move in moves:
        target = leads.get((dstate, move.action or ""))
        if target is None or dstates[target].view != move.view:
            return False
        dstate = target
    return True


def _is_number(text: str) -> bool:
    return text.isascii() and text.isdecimal() and len(text) < 10


def told_action(move: Move) -> str:
    """What to do, in words: the action, or the path to turn to."""
    if move.action is not None:
        return printable(move.action)
    if move.path is None:
        return "(turn)"
    return f"(turn to path {move.path}{'+' if move.direction == 1 else '-'})"
