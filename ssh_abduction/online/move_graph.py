"""A map as a graph of moves, for planning routes: its links, and moves that its paths imply."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from collections.abc import Set as AbstractSet
from itertools import permutations
from typing import Any, TypeAlias

import networkx as nx

from ssh_abduction.data.drives import Drive, step_of
from ssh_abduction.data.errors import MapError, TraceError, brief
from ssh_abduction.data.map_parts import thing_named
from ssh_abduction.data.maps import DState, SSHMap
from ssh_abduction.data.words import meant
from ssh_abduction.output.layout import drawable_poses

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


class MoveGraph:
    """A directed graph whose edges are the moves that are possible in a map, with costs.

    Nodes are dstates, and also courses (place, path, direction) that no dstate faces. Edges are
    links; for routes by places also moves that paths imply or, in a map without paths such as that
    of a log, the way back of each travel.

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
        courses = 2 * sum(len(path.order) for path in ssh_map.paths) + len(ssh_map.places)
        self._travel_cost = OPEN_TURN * (len(ssh_map.dstates) + courses)
        self._graph = self._of_links()
        if by == "places" and ssh_map.paths:
            self._add_implied()
        elif by == "places":
            self._add_returns()
        # Place, and slot or bearing, of each gateway that was closed when a drive last saw it. No
        # edge passes them.
        self.closed = _closed_gateways(ssh_map)
        shut = [edge for edge in self._graph.edges if self._passes_closed(*edge)]
        self._graph.remove_edges_from(shut)

    def nodes(self, name: int | str, field: str) -> tuple[set[Node], str]:
        """Return the dstates that a user names, and words for them, such as "place 3".

        `name` is a dstate, place or region by its number, such as 3, "p3" or "region2", or a name
        that a person gave. A place or region stands for all dstates there, and a step such as
        "monday:12" for its dstate. `field` is the name of the user's parameter, for messages.
        Raises MapError, which lists what exists.
        """
        kind, number = thing_named(str(name), self.map.names) or (None, -1)
        if kind == "place":
            return self._dstates_at(number, field), self.map.called(kind, number)
        region = next((r for r in self.map.regions or () if r.id == number), None)
        if kind == "region" and region is not None:
            return self._dstates_in(region.places), self.map.called(kind, number)
        count = len(self.map.dstates)
        if kind is None and ":" in str(name) and self._drives:
            try:
                kind, number = "dstate", self.map.dstate_at[step_of(self._drives, str(name))]
            except TraceError as error:
                raise MapError(f"{field}: {error}") from None
        if kind == "dstate" and number < count:
            return {number}, f"dstate {number}"
        places = f", or a place as p{self.map.places[0]}" if self.map.places else ""
        places += ", or a region as region0" if self.map.regions else ""
        names = [n.text for n in self.map.names if n.kind in ("place", "region")]
        places += f", or {', '.join(names)}" if names else ""
        raise MapError(
            f"{field}: expected a dstate, 0 to {count - 1}{places}, got {brief(name)}"
            f"{meant(name, names, 3) or ';'} ssh-abduction show lists them"
        )

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

    def action(self, source: Node, target: Node) -> str | None:
        """Return the name of the action of a move; None if the map does not imply it."""
        action: str | None = self._graph.edges[source, target]["action"]
        return action

    def is_known(self, source: Node, target: Node) -> bool:
        """Whether the map has a link for this move, so that the robot did it before."""
        return not self._graph.edges[source, target]["implied"]

    def course(self, node: Node) -> tuple[int | None, int | None, int | None]:
        """Return the place, path and direction of a node. Each is None if the node has none."""
        if isinstance(node, tuple):
            return node
        s = self.map.dstates[node]
        return s.place, s.path, s.direction

    def metres(self, source: Node, target: Node) -> float | None:
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

    def _of_links(self) -> nx.DiGraph[Any]:
        """Make the graph of all dstates and the links between them."""
        graph: nx.DiGraph[Any] = nx.DiGraph()
        graph.add_nodes_from(s.id for s in self.map.dstates)
        # Sort in reverse, so that the first action by name remains if several join two dstates.
        for source, action, target in sorted(self.map.links, reverse=True):
            if source != target:
                cost = self._cost(source, target, KNOWN_MOVE)
                graph.add_edge(source, target, action=action, implied=False, cost=cost)
        return graph

    def _add_implied(self) -> None:
        """Add the moves that the paths of the map imply.

        A path leads both ways, so the robot can go back where it travelled. At a place it can turn
        to each path through this place. Two places next to each other in the order of a path may
        have a wall between them if no travel joins them.
        """
        travel, around = self._only_action(onward=True), self._only_action(onward=False)
        facing: dict[Node, Node] = {}  # the first dstate of each course
        at: dict[int, set[Node]] = {}  # the nodes of each place
        for s in self.map.dstates:
            if s.place is not None:
                at.setdefault(s.place, set()).add(s.id)
                if s.path is not None and s.direction is not None:
                    facing.setdefault((s.place, s.path, s.direction), s.id)
        for path in self.map.paths:
            for course in ((place, path.id, way) for place in path.order for way in (1, -1)):
                at.setdefault(course[0], set()).add(facing.get(course, course))
        for source, _, target in self.map.links:
            (here, path_id, way), (there, other, _) = self.course(source), self.course(target)
            if here != there and path_id is not None and path_id == other and way is not None:
                assert here is not None
                assert there is not None
                start, end = (there, path_id, -way), (here, path_id, -way)
                self._imply(facing.get(start, start), facing.get(end, end), travel)
        for courses_here in at.values():
            for node in courses_here:
                for aside in courses_here - {node}:
                    self._imply(node, aside, around if self._is_around(node, aside) else None)

    def _add_returns(self) -> None:
        """Add the way back of each travel, and turns between all dstates of a place."""
        at: dict[int, set[Node]] = {}  # the nodes of each place
        for s in self.map.dstates:
            if s.place is not None:
                at.setdefault(s.place, {(s.place, None, None)}).add(s.id)
        for here in at.values():
            for node, aside in permutations(here, 2):
                if isinstance(aside, int):
                    self._imply(node, aside, None)
        travels = []
        for source, action, target in self.map.links:
            back, there = self.course(source)[0], self.course(target)[0]
            if back is not None and there is not None and back != there:
                travels.append((action, there, back))
        actions = {action for action, _, _ in travels}
        for action, there, back in travels:
            for node in at[there]:
                self._imply(node, (back, None, None), action if len(actions) == 1 else None)

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
        for at, slot, bearing in self.closed:
            unit, gateway = (90, slot) if bearing is None else (1, bearing)
            off = [unit * ((heading or 0) - (gateway or 0)) + more for heading, more in facing]
            if at == place and any(abs((degrees + 180) % 360 - 180) <= FACING for degrees in off):
                return True
        return False

    def _imply(self, source: Node, target: Node, action: str | None) -> None:
        """Add an implied move, unless the map has a link for it or it leads to another floor."""
        is_known = self._graph.has_edge(source, target)
        if not is_known and self._floor(source) == self._floor(target):
            cost = self._cost(source, target, UNTRIED_MOVE if action else OPEN_TURN)
            self._graph.add_edge(source, target, action=action, implied=True, cost=cost)

    def _is_around(self, source: Node, target: Node) -> bool:
        """Whether two nodes at one place face the two directions of one path."""
        (_, path, way), (_, other, other_way) = self.course(source), self.course(target)
        return path is not None and path == other and way != other_way

    def _cost(self, source: Node, target: Node, move: float) -> float:
        """Compute the cost of an edge.

        For a route by places, this is `move` and, if the edge changes the place, a travel's cost.
        """
        if self.by == "actions":
            return 1.0
        if self.by == "metres":
            return (self.metres(source, target) or 0.0) + MICROMETRE
        travels = self._place(source) != self._place(target)
        return move + (self._travel_cost if travels else 0.0)

    def _only_action(self, *, onward: bool) -> str | None:
        """Return the action that goes on along paths or, if not `onward`, turns around on them.

        None if the links of the map have no such action, or several.
        """
        dstates, names = self.map.dstates, set()
        for source, action, target in self.map.links:
            s, x = dstates[source], dstates[target]
            moves = s.place != x.place if onward else s.direction != x.direction
            if s.path is not None and s.path == x.path and moves:
                names.add(action)
        return names.pop() if len(names) == 1 else None

    def _dstates_at(self, place: int, field: str) -> set[Node]:
        """Find the dstates at a place. Raise MapError, naming `field`, if there is none."""
        members = self._dstates_in({place})
        if not members:
            known = sorted({s.place for s in self.map.dstates if s.place is not None})
            there = "a dstate, as the map has no places"
            if known:
                there = f"p{known[0]} to p{known[-1]}"
            raise MapError(
                f"{field}: expected {there}, got {brief(f'p{place}')}; "
                "ssh-abduction show lists them"
            )
        return members

    def _dstates_in(self, places: Collection[int]) -> set[Node]:
        """Find the dstates at these places."""
        return {s.id for s in self.map.dstates if s.place in places}

    def _place(self, node: Node) -> int:
        """Return the place of a node, or the `DState.site` of a dstate without a place."""
        return self.map.dstates[node].site if isinstance(node, int) else node[0]


def _closed_gateways(ssh_map: SSHMap) -> list[tuple[int | None, int | None, int | None]]:
    """List the place, slot and bearing of each gateway that was last seen closed."""
    changes = (fault for fault in ssh_map.faults if fault.kind == "changed")
    last = {(fault.place, fault.gateway, fault.bearing): fault for fault in changes}
    return [at for at, fault in last.items() if str(fault.seen).startswith("closed")]
