"""Repair a graph of places and moves that contradicts itself: abduction under faults.

Somebody or something else made the graph, such as a language model that read a text adventure. An
edge is a move: an action leads from one place to another. `encodings/graphs/repair.lp` has the
axioms. The repairs are all smallest sets of edges without which the axioms hold.

>>> moves = [GraphMove("hall", "east", "kitchen"), GraphMove("hall", "east", "pantry")]
>>> found = repair([*moves, GraphMove("kitchen", "west", "hall")])
>>> found.fewest, [[str(found.moves[e]) for e in wrong] for wrong in found.repairs]
(1, [['hall –east→ pantry']])
"""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import clingo

from ssh_abduction.data.errors import MapError, brief, named
from ssh_abduction.data.groups import minimal_part
from ssh_abduction.data.map_parts import read_json
from ssh_abduction.data.words import meant
from ssh_abduction.runtime.clock import counting
from ssh_abduction.runtime.limits import LimitError, Watch
from ssh_abduction.solution import Stop
from ssh_abduction.solver import Asker, Control
from ssh_abduction.theory import encodings

ENCODING = "repair"
# The names of the ends and the action of an edge, in node-link JSON, GraphML and MANGO.
ENDS = (
    ("source", "from", "src_node"),
    ("target", "to", "dst_node"),
    ("action", "label", "direction"),
)


class GraphMove(NamedTuple):
    """An edge: an action that leads from one place to another."""

    source: str
    action: str
    target: str

    def __str__(self) -> str:
        return f"{self.source} –{self.action}→ {self.target}"


@dataclass(frozen=True)
class Repairs:
    """The smallest repairs of a graph.

    Attributes:
        moves: The edges of the graph. Other attributes name them by their index.
        fewest: The number of edges in each listed repair.
        repairs: The listed repairs, each as the indices of the wrong edges, ascending. If the
            search was stopped before it proved that no repair is smaller, the smallest one found.
        complete: Whether all smallest repairs are listed.
        blamed: The edges that are wrong in every smallest repair, also in those not listed; None
            if unknown, as the search was stopped.
        turns: For each listed repair and each of its edges, the actions that make this edge right
            if the other edges of the repair are dropped. None for a repair whose actions are
            unknown.
        clashes: Sets of edges that have no edge in common, and of which each contradicts the
            axioms. So at least as many edges are wrong. Each has the names of its axioms.
        least: At least so many edges are wrong: `fewest`, unless the search was stopped.
        stopped: The limit that stopped the search, or "interrupted"; None if it was not stopped.
    """

    moves: tuple[GraphMove, ...]
    fewest: int
    repairs: tuple[tuple[int, ...], ...]
    complete: bool
    blamed: tuple[int, ...] | None
    turns: tuple[tuple[tuple[str, ...], ...] | None, ...]
    clashes: tuple[tuple[tuple[int, ...], tuple[str, ...]], ...]
    least: int
    stopped: Stop | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return the repairs as plain data, with the number of each edge from 1."""
        number = [move._asdict() | {"edge": e} for e, move in enumerate(self.moves, 1)]
        return {
            "fewest": self.fewest,
            "at_least": self.least,
            "complete": self.complete,
            "stopped": self.stopped,
            "blamed": None if self.blamed is None else [number[e] for e in self.blamed],
            "repairs": [
                [
                    number[e] | {"or_action": None if turned is None else list(turned[i])}
                    for i, e in enumerate(wrong)
                ]
                for wrong, turned in zip(self.repairs, self.turns, strict=True)
            ],
            "clashes": [
                {"edges": [number[e] for e in edges], "axioms": list(axioms)}
                for edges, axioms in self.clashes
            ],
        }


def axiom_names() -> tuple[str, ...]:
    """Return the names of the axioms of graphs."""
    text = Path(encodings.path(ENCODING)).read_text(encoding="utf-8")
    return tuple(re.findall(r"^% @axiom\((\w+)\)", text, re.MULTILINE))


def repair(
    moves: Iterable[GraphMove],
    *,
    without: Collection[str] = (),
    most: int = 20,
    watch: Watch | None = None,
) -> Repairs:
    """Find all smallest sets of edges without which the axioms hold.

    Args:
        moves: The edges.
        without: Names of axioms to leave out.
        most: List at most this many repairs.
        watch: The limits of the search. At a limit, the answer is the best one so far.

    Raises:
        MapError: There is no such axiom.
    """
    for name in without:
        if name not in axiom_names():
            known = ", ".join(axiom_names())
            hint = meant(name, axiom_names())
            raise MapError(f"axiom: expected {known}, got {brief(name)}; name one of these{hint}")
    moves, watch = tuple(dict.fromkeys(moves)), watch or Watch()
    # To drop all edges is a repair, too.
    found = Repairs(moves, len(moves), (tuple(range(len(moves))),), False, None, (None,), (), 0)
    with counting(watch.counts_work):
        watch.start()
        question = _GraphAxioms(moves, [*set(axiom_names()).difference(without)], watch)
        try:
            for better in question.improved(found, most):
                found = better
        except LimitError as limit:
            least = max(found.least, *question.bounds)
            return replace(found, least=least, stopped=limit.reason)
    return found


def _wrong_in(model: clingo.Model) -> tuple[int, ...]:
    return tuple(sorted(symbol.arguments[0].number for symbol in model.symbols(shown=True)))


def _turned_in(model: clingo.Model) -> str:
    """The action of the only edge that is turned."""
    return next(s.arguments[1].string for s in model.symbols(atoms=True) if s.name == "turned")


class _GraphAxioms:
    """A graph in clingo.

    Attributes:
        bounds: Lower bounds on the number of wrong edges, as clingo has proved them.
    """

    def __init__(self, moves: tuple[GraphMove, ...], axioms: Sequence[str], watch: Watch) -> None:
        self.moves, self.bounds, self._axioms = moves, [0], axioms
        self._asker = Asker(watch)
        self._asker.control = control = Control(["--opt-strategy=usc", "--project=project"])
        for name in axioms:
            control.add("base", [], f"axiom({name}).")
        for e, move in enumerate(moves):
            source, action, target = map(json.dumps, move)
            control.add("base", [], f"edge({e},{source},{action},{target}). label({action}).")
        control.add("base", [], Path(encodings.path(ENCODING)).read_text(encoding="utf-8"))
        control.ground([("base", [])])

    def improved(self, found: Repairs, most: int) -> Iterator[Repairs]:
        """Yield better and better answers, from the first one on. Raises LimitError."""
        if self._mends([]):
            yield replace(found, fewest=0, repairs=((),), complete=True, blamed=(), turns=((),))
            return
        as_they_are = [(_mended(e), False) for e in range(len(self.moves))]
        for wrong in self._asker.answers(_wrong_in, "ignore", 1, assumptions=as_they_are):
            yield (found := replace(found, fewest=len(wrong), repairs=(wrong,)))
        wrong = tuple(sorted(minimal_part(self._mends, [*found.repairs[0]])))
        yield (found := replace(found, fewest=len(wrong), repairs=(wrong,)))
        smallest: set[tuple[int, ...]] = set()
        for wrong, is_smallest in self._asker.answers(
            lambda model: (_wrong_in(model), model.optimality_proven),
            "optN",
            0,
            assumptions=as_they_are,
            on_bound=lambda bound: self.bounds.append(bound[0]),
        ):
            smallest |= {wrong} if is_smallest else set()
            if smallest or len(wrong) < found.fewest:
                repairs = tuple(sorted(smallest)[:most]) or (wrong,)
                least = len(wrong) if smallest else found.least
                found = replace(found, fewest=len(wrong), repairs=repairs, least=least)
                found = replace(found, turns=(None,) * len(repairs))
                yield found
            if len(smallest) > most:
                break
        blamed = set.intersection(*map(set, smallest))
        if len(smallest) > most:
            mode = f"enum,{found.fewest}"
            blamed = {e for e in blamed if not self._holds([(_wrong(e), False)], mode)}
        found = replace(found, complete=len(smallest) <= most, blamed=tuple(sorted(blamed)))
        yield found
        # Find clashes without a common edge, until the edges that are in none do not clash.
        left = list(range(len(self.moves)))
        while self._clash(left):
            edges = minimal_part(self._clash, left)
            clash = tuple(sorted(edges)), self._axioms_of(edges)
            yield (found := replace(found, clashes=(*found.clashes, clash)))
            left = [e for e in left if e not in edges]
        for i, wrong in enumerate(found.repairs):
            turns = (*found.turns[:i], self._turns(wrong), *found.turns[i + 1 :])
            yield (found := replace(found, turns=turns))

    def _turns(self, wrong: tuple[int, ...]) -> tuple[tuple[str, ...], ...]:
        """For each edge of a repair, find the actions with which it is right."""
        kept = [(_wrong(e), e in wrong) for e in range(len(self.moves))]
        found = (
            self._asker.answers(
                _turned_in,
                "ignore",
                0,
                assumptions=[*kept, *((_mended(e), e == edge) for e in wrong)],
            )
            for edge in wrong
        )
        return tuple(tuple(sorted(each)) for each in found)

    def _clash(self, edges: Collection[int]) -> bool:
        """Whether these edges cannot all be right."""
        return not self._holds([(_wrong(e), False) for e in edges])

    def _mends(self, edges: Collection[int]) -> bool:
        """Whether the axioms hold if these edges alone may be wrong."""
        return not self._clash([e for e in range(len(self.moves)) if e not in edges])

    def _axioms_of(self, edges: Sequence[int]) -> tuple[str, ...]:
        """Name the axioms that these edges break."""
        some = tuple(self.moves[e] for e in edges)
        alone = (_GraphAxioms(some, [name], self._asker.watch) for name in sorted(self._axioms))
        found = zip(sorted(self._axioms), alone, strict=True)
        return tuple(name for name, one in found if one._clash(range(len(some))))

    def _holds(self, assumptions: list[tuple[clingo.Symbol, bool]], mode: str = "ignore") -> bool:
        answers = self._asker.answers(_wrong_in, mode, 1, assumptions=assumptions)
        return next(answers, None) is not None


def _wrong(edge: int) -> clingo.Symbol:
    return clingo.Function("wrong", [clingo.Number(edge)])


def _mended(edge: int) -> clingo.Symbol:
    return clingo.Function("mended", [clingo.Number(edge)])


def read_moves(file: str) -> tuple[GraphMove, ...]:
    """Read the edges of a graph from GraphML, node-link JSON, or a JSON list of edges.

    Raises MapError if the file is no such graph, an edge has no action, a node has no name or the
    name of another one, or an edge leads from a node to itself.
    """
    where = named(file)
    if Path(file).suffix.lower() in (".graphml", ".xml"):
        data = _of_graphml(file)
    else:
        data = read_json(file, "graph")
    edges: Any = data
    if isinstance(data, dict):
        edges = next((data[key] for key in ("edges", "links", "moves") if key in data), None)
        _check_nodes(data.get("nodes"), edges, where)
    if not isinstance(edges, list) or not edges:
        raise MapError(
            f"{where}: expected a graph with edges, got {brief(data)}; write node-link JSON, "
            'GraphML, or a list of edges such as {"source": "hall", "action": "east", "target": '
            '"kitchen"}'
        )
    return tuple(_move(edge, f"{where}: edge {i}") for i, edge in enumerate(edges, 1))


def _of_graphml(file: str) -> dict[str, Any]:
    """Read GraphML as node-link data. Raises MapError."""
    import networkx as nx

    try:
        graph = nx.read_graphml(file, force_multigraph=True)
    except Exception as error:  # the parser raises errors of several packages
        raise MapError(
            f"{named(file)}: expected GraphML, got {type(error).__name__}: {error}; write it with "
            "a graph library"
        ) from None
    # Networkx makes one node of two with one name.
    nodes = [node.get("id") for node in ElementTree.parse(file).findall(".//{*}node")]
    return {**nx.node_link_data(graph, edges="edges"), "nodes": nodes}


def _check_nodes(nodes: Any, edges: Any, where: str) -> None:
    """Raise MapError if a listed node has no name or a name twice, or an edge has another node."""
    if nodes is None:
        return
    names = [node.get("id") if isinstance(node, dict) else node for node in nodes or ()]
    for i, name in enumerate(names, 1):
        if name in (None, ""):
            raise MapError(f"{where}: node {i}: expected a name, got {brief(name)}; give it one")
        if name in names[: i - 1]:
            raise MapError(
                f"{where}: node {i}: expected another name than node {names.index(name) + 1}, got "
                f"{brief(name)} twice; rename one, or make them one node"
            )
    for i, edge in enumerate(edges if isinstance(edges, list) else (), 1):
        for end in ENDS[:2] if isinstance(edge, dict) else ():
            name = next((edge[key] for key in end if key in edge), names[0] if names else None)
            if name not in names:
                hint = meant(name, map(str, names))
                raise MapError(
                    f"{where}: edge {i}: expected a listed node, got {brief(name)}; list it{hint}"
                )


def _move(edge: Any, where: str) -> GraphMove:
    """Read an edge. Raises MapError."""
    if not isinstance(edge, dict):
        raise MapError(
            f'{where}: expected an object such as {{"source": "hall", "action": "east", "target": '
            f'"kitchen"}}, got {brief(edge)}; write one'
        )
    record: dict[str, Any] = edge
    found = [next((record[key] for key in keys if key in record), "") for keys in ENDS]
    for keys, value in zip(ENDS, found, strict=True):
        if not isinstance(value, str | int) or value == "":
            raise MapError(
                f"{where}: {keys[0]}: expected a name, got {brief(value)}; name the source, the "
                "action and the target of each edge"
            )
    source, target, action = map(str, found)
    if source == target:
        raise MapError(
            f"{where}: expected two places, got a move from {brief(source)} to itself; leave it "
            "out, or name the place where it leads"
        )
    return GraphMove(source, " ".join(action.lower().split()), target)
