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
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, cast

import clingo

from ssh_abduction.data.errors import MapError, brief, named
from ssh_abduction.data.groups import minimal_part
from ssh_abduction.data.map_parts import read_json
from ssh_abduction.data.words import meant
from ssh_abduction.solver import Control
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
        fewest: The number of edges in each repair.
        repairs: The listed repairs, each as the indices of the wrong edges, ascending.
        complete: Whether all smallest repairs are listed.
        blamed: The edges that are wrong in every smallest repair, also in those not listed.
        turns: For each listed repair and each of its edges, the actions with which this edge is
            right, if the others of the repair are dropped.
        clashes: Sets of edges that have no edge in common, and of which each contradicts the
            axioms. So at least as many edges are wrong. Each has the names of its axioms.
    """

    moves: tuple[GraphMove, ...]
    fewest: int
    repairs: tuple[tuple[int, ...], ...]
    complete: bool
    blamed: tuple[int, ...]
    turns: tuple[tuple[tuple[str, ...], ...], ...]
    clashes: tuple[tuple[tuple[int, ...], tuple[str, ...]], ...]

    def to_dict(self) -> dict[str, Any]:
        """Return the repairs as plain data, with the number of each edge from 1."""
        number = [move._asdict() | {"edge": e} for e, move in enumerate(self.moves, 1)]
        return {
            "fewest": self.fewest,
            "complete": self.complete,
            "blamed": [number[e] for e in self.blamed],
            "repairs": [
                [number[e] | {"or_action": list(a)} for e, a in zip(wrong, turned, strict=True)]
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


def repair(moves: Iterable[GraphMove], *, without: Collection[str] = (), most: int = 20) -> Repairs:
    """Find all smallest sets of edges without which the axioms hold.

    Args:
        moves: The edges.
        without: Names of axioms to leave out.
        most: List at most this many repairs.

    Raises:
        MapError: There is no such axiom.
    """
    for name in without:
        if name not in axiom_names():
            known = ", ".join(axiom_names())
            hint = meant(name, axiom_names())
            raise MapError(f"axiom: expected {known}, got {brief(name)}; name one of these{hint}")
    question = _GraphAxioms(tuple(dict.fromkeys(moves)), [*set(axiom_names()).difference(without)])
    fewest, repairs, complete, blamed = question.smallest(most)
    return Repairs(
        question.moves,
        fewest,
        repairs,
        complete,
        blamed,
        tuple(question.turns(wrong) for wrong in repairs),
        tuple(question.clashes()),
    )


class _GraphAxioms:
    """A graph in clingo."""

    def __init__(self, moves: tuple[GraphMove, ...], axioms: Sequence[str]) -> None:
        self.moves, self._axioms = moves, axioms
        self._labels = sorted({move.action for move in moves})
        self._control = Control(["--opt-strategy=usc", "--project=project"])
        for name in axioms:
            self._control.add("base", [], f"axiom({name}).")
        for e, move in enumerate(moves):
            source, action, target = map(json.dumps, move)
            self._control.add("base", [], f"edge({e},{source},{action},{target}). label({action}).")
        text = Path(encodings.path(ENCODING)).read_text(encoding="utf-8")
        self._control.add("base", [], text)
        self._control.ground([("base", [])])
        self._config = cast(Any, self._control.configuration.solve)
        self._config.opt_mode = "ignore"

    def smallest(self, most: int) -> tuple[int, tuple[tuple[int, ...], ...], bool, tuple[int, ...]]:
        """Find the smallest repairs: their size, some, whether these are all, and who is blamed."""
        if not self.moves:
            return 0, ((),), True, ()
        config = self._config
        config.opt_mode, config.models = "optN", most + 1
        found: set[tuple[int, ...]] = set()
        fewest = 0
        for model in self._control.models():
            if model.optimality_proven:
                found.add(_wrong_in(model))
                fewest = model.cost[0]
        repairs = tuple(sorted(found)[:most])
        blamed = set.intersection(*map(set, found))
        if len(found) > most:
            config.opt_mode, config.models = f"enum,{fewest}", 0
            config.enum_mode, config.project = "cautious", "auto"
            *_, blamed = [set(_wrong_in(model)) for model in self._control.models()]
            config.enum_mode = "auto"
        config.opt_mode, config.models = "ignore", 1
        return fewest, repairs, len(found) <= most, tuple(sorted(blamed))

    def turns(self, wrong: tuple[int, ...]) -> tuple[tuple[str, ...], ...]:
        """For each edge of a repair, find the actions with which it is right."""

        def is_right(edge: int, action: str) -> bool:
            made = [(_turned(e, a), (e, a) == (edge, action)) for e in wrong for a in self._labels]
            return self._holds([*made, *((_wrong(e), e in wrong) for e in range(len(self.moves)))])

        return tuple(tuple(a for a in self._labels if is_right(e, a)) for e in wrong)

    def clashes(self) -> Iterable[tuple[tuple[int, ...], tuple[str, ...]]]:
        """Find clashes without a common edge, until the edges that are in none do not clash."""
        left = list(range(len(self.moves)))
        while self._clash(left):
            edges = minimal_part(self._clash, left)
            yield tuple(sorted(edges)), self._axioms_of(edges)
            left = [e for e in left if e not in edges]

    def _clash(self, edges: Sequence[int]) -> bool:
        """Whether these edges cannot all be right."""
        return not self._holds([(_wrong(e), False) for e in edges])

    def _axioms_of(self, edges: Sequence[int]) -> tuple[str, ...]:
        """Name the axioms that these edges break."""
        some = tuple(self.moves[e] for e in edges)
        alone = (_GraphAxioms(some, [name]) for name in sorted(self._axioms))
        found = zip(sorted(self._axioms), alone, strict=True)
        return tuple(name for name, one in found if one._clash(range(len(some))))

    def _holds(self, assumptions: list[tuple[clingo.Symbol, bool]]) -> bool:
        return any(True for _ in self._control.models(assumptions))


def _wrong(edge: int) -> clingo.Symbol:
    return clingo.Function("wrong", [clingo.Number(edge)])


def _turned(edge: int, action: str) -> clingo.Symbol:
    return clingo.Function("turned", [clingo.Number(edge), clingo.String(action)])


def _wrong_in(model: clingo.Model) -> tuple[int, ...]:
    return tuple(sorted(symbol.arguments[0].number for symbol in model.symbols(shown=True)))


def read_moves(file: str) -> tuple[GraphMove, ...]:
    """Read the edges of a graph from GraphML, node-link JSON, or a JSON list of edges.

    Raises MapError if the file is no such graph, an edge has no action, a node has no name or the
    name of another one, or an edge leads from a node to itself.
    """
    where = named(file)
    if Path(file).suffix.lower() in (".graphml", ".xml"):
        data = _of_graphml(file)
    else:
        data = read_json(file)
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
    return dict(nx.node_link_data(graph, edges="edges"))


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
    record: dict[str, Any] = edge if isinstance(edge, dict) else {}
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
