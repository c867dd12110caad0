"""Repairs of graphs that contradict themselves: against brute force, and with bad input."""

from __future__ import annotations

import json
import random
from functools import cache
from itertools import combinations
from pathlib import Path

import networkx as nx
import pytest

from ssh_abduction.cli import main
from ssh_abduction.data import MapError
from ssh_abduction.explain.graph_repair import (
    GraphMove,
    Repairs,
    axiom_names,
    read_moves,
    repair,
)
from ssh_abduction.runtime.limits import Watch

OPPOSITE = {"north": "south", "east": "west", "up": "down", "southwest": "northeast"}
OPPOSITE |= {b: a for a, b in OPPOSITE.items()}
HEADS = {"north": "n", "east": "e", "up": "u", "northeast": "ne"}
# Each axiom alone: edges that it forbids, and no other axiom does.
CASES = {
    "deterministic": "a enter b; a enter c",
    "reversible": "a in b; b out c",
    "ordered": "a north b; b north c; a south c",
}


def moves(text: str) -> list[GraphMove]:
    return [GraphMove(*edge.split()) for edge in text.split("; ")]


def holds(edges: tuple[GraphMove, ...]) -> bool:
    """The axioms in plain Python."""
    for e, f in combinations(edges, 2):
        if (e.source, e.action) == (f.source, f.action) and e.target != f.target:
            return False
    for e in edges:
        for f in edges:
            if f.source == e.target and f.action == OPPOSITE.get(e.action) and f.target != e.source:
                return False
            arrive_alike = (e.target, e.action) == (f.target, f.action) and e.action in OPPOSITE
            if arrive_alike and e.source != f.source:
                return False
    for direction in "neu":
        graph = nx.DiGraph()
        for e in edges:
            if direction in HEADS.get(e.action, ""):
                graph.add_edge(e.source, e.target)
            if direction in HEADS.get(OPPOSITE.get(e.action, ""), ""):
                graph.add_edge(e.target, e.source)
        if not nx.is_directed_acyclic_graph(graph):
            return False
    return True


def smallest(edges: tuple[GraphMove, ...]) -> set[tuple[int, ...]]:
    """The smallest sets of edges without which the axioms hold."""
    for size in range(len(edges) + 1):
        found = {
            wrong
            for wrong in combinations(range(len(edges)), size)
            if holds(tuple(e for i, e in enumerate(edges) if i not in wrong))
        }
        if found:
            return found
    raise AssertionError


@pytest.mark.parametrize("seed", range(40))
def test_repairs_equal_those_of_brute_force(seed: int) -> None:
    chance = random.Random(seed)
    actions = chance.sample(["north", "south", "east", "west", "northeast", "southwest", "go"], 4)
    places = "abcd"[: chance.randint(2, 4)]
    drawn = {
        GraphMove(*chance.sample(places, 2)[:1], chance.choice(actions), "?")._replace(
            target=target
        )
        for _ in range(chance.randint(2, 8))
        for target in chance.sample(places, 1)
    }
    edges = tuple(sorted(edge for edge in drawn if edge.source != edge.target))
    expected = smallest(edges)
    found = repair(edges, most=1000)
    assert set(found.repairs) == expected
    assert found.complete
    assert set(found.blamed) == set.intersection(*map(set, expected))
    few = repair(edges, most=1)
    assert few.complete == (len(expected) == 1)
    assert few.blamed == found.blamed
    assert len(found.clashes) <= found.fewest
    used = [edge for clash, _ in found.clashes for edge in clash]
    assert len(used) == len(set(used))
    for clash, _ in found.clashes:
        assert not holds(tuple(edges[e] for e in clash))
    for wrong, turns in zip(found.repairs, found.turns, strict=True):
        kept = tuple(e for i, e in enumerate(edges) if i not in wrong)
        for edge, right in zip(wrong, turns, strict=True):
            others = {e.action for e in edges} - {edges[edge].action}
            held = {a for a in others if holds((*kept, edges[edge]._replace(action=a)))}
            assert set(right) == held


@pytest.mark.parametrize("axiom", axiom_names())
def test_each_axiom_alone_forbids_something(axiom: str) -> None:
    edges = moves(CASES[axiom])
    assert repair(edges).fewest == 1
    assert repair(edges).clashes[0][1] == (axiom,)
    assert repair(edges, without=[axiom]).fewest == 0
    with pytest.raises(MapError, match=f"did you mean {axiom}"):
        repair(edges, without=[axiom[:-1]])


def test_verb_says_who_is_blamed_and_why(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "graph.json"
    edges = moves("hall east kitchen; hall east pantry; kitchen west hall")
    file.write_text(json.dumps([edge._asdict() for edge in edges]))
    assert main(["repair", str(file)]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "3 edges: at least 1 wrong; 1 smallest repair",
        "  these clash (deterministic): edge 1 (hall –east→ kitchen); edge 2 (hall –east→ pantry)",
        "  no edge is in two of these, so at least 1 are wrong",
        "blamed in every smallest repair: edge 2 (hall –east→ pantry)",
        "repair 1",
        "  drop edge 2 (hall –east→ pantry), or turn it to west",
    ]
    assert main(["repair", str(file), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["blamed"] == [{"edge": 2, **edges[1]._asdict()}]
    assert main(["repair", str(file), "--set", "without=deterministic,reversible"]) == 0
    assert capsys.readouterr().out == "3 edges: no contradiction\n"


def tangle(places: int) -> list[GraphMove]:
    """Drawn edges of which most are wrong."""
    chance = random.Random(places)
    pairs = [chance.sample(range(places), 2) for _ in range(2 * places)]
    return [GraphMove(f"p{a}", chance.choice([*OPPOSITE]), f"p{b}") for a, b in pairs]


@cache
def repaired() -> Repairs:
    """What `repair` finds without a limit."""
    return repair(tangle(30), most=3)


@pytest.mark.parametrize("work", [0.001, 0.02, 0.05, 0.1, 0.2, 0.4])
def test_a_limit_leaves_the_best_answer_so_far(work: float) -> None:
    edges, whole = tangle(30), repaired()
    found = repair(edges, most=3, watch=Watch(work=work))
    assert found.stopped == "work limit"
    assert found.least <= whole.fewest <= found.fewest
    assert not found.complete
    assert found.blamed in (None, whole.blamed)
    assert {*found.clashes} <= {*whole.clashes}
    for wrong in found.repairs:
        kept = [e for i, e in enumerate(found.moves) if i not in wrong]
        assert repair(kept).fewest == 0


def test_verb_tells_what_a_limit_left_unknown(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "graph.json"
    file.write_text(json.dumps([edge._asdict() for edge in tangle(30)]))
    limited = ["repair", str(file), "--work-limit", "0.001"]
    assert main([*limited, "--strict"]) == 10
    first, blamed, *_, last = capsys.readouterr().out.splitlines()
    assert first == (
        "59 edges: at least 0 wrong; the smallest repair found drops 59, and smaller ones may "
        "exist (search stopped: work limit)"
    )
    assert blamed == "blamed in every smallest repair: unknown, as the search was stopped"
    assert last.endswith("mends an edge is unknown, as the search was stopped")
    assert main([*limited, "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert (record["blamed"], record["complete"]) == (None, False)
    assert record["repairs"][0][0]["or_action"] is None
    assert main(["repair", str(file), "--work-limit", "0"]) == 1
    assert "--work-limit: expected a number of units of work" in capsys.readouterr().err


def test_an_interrupt_leaves_the_best_answer_so_far() -> None:
    watch = Watch()
    watch.interrupted = True
    found = repair(tangle(30), watch=watch)
    assert (found.stopped, found.blamed) == ("interrupted", None)


def test_graphml_and_node_link_json_are_read(tmp_path: Path) -> None:
    graph = nx.MultiDiGraph()
    graph.add_edge("hall", "kitchen", action="East")
    graph.add_edge("hall", "kitchen", action="enter")
    nx.write_graphml(graph, tmp_path / "g.graphml")
    (tmp_path / "g.json").write_text(json.dumps(nx.node_link_data(graph, edges="links")))
    expected = moves("hall east kitchen; hall enter kitchen")
    assert [*read_moves(str(tmp_path / "g.graphml"))] == expected
    assert [*read_moves(str(tmp_path / "g.json"))] == expected


EDGE = {"source": "a", "action": "east", "target": "b"}


@pytest.mark.parametrize(
    ("graph", "said"),
    [
        (None, "expected JSON, got an empty file; write JSON"),
        ([], "expected a graph with edges, got []"),
        ({"nodes": []}, "expected a graph with edges"),
        (["a"], "edge 1: expected an object such as"),
        ([{**EDGE, "target": "a"}], "edge 1: expected two places, got a move from 'a' to itself"),
        ([EDGE, {"source": "a", "target": "b"}], "edge 2: action: expected a name, got ''"),
        ([{**EDGE, "source": ""}], "edge 1: source: expected a name, got ''"),
        ({"nodes": ["a", "b", "a"], "edges": [EDGE]}, "node 3: expected another name than node 1"),
        ({"nodes": [{"id": ""}], "edges": [EDGE]}, "node 1: expected a name, got ''; give it one"),
        ({"nodes": [{}], "edges": [EDGE]}, "node 1: expected a name, got None; give it one"),
        ({"nodes": ["a", "bb"], "edges": [EDGE]}, "edge 1: expected a listed node, got 'b'"),
    ],
)
def test_bad_graphs_get_one_clear_line(
    graph: object, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "graph.json"
    file.write_text("" if graph is None else json.dumps(graph))
    assert main(["repair", str(file)]) == 1
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1


def test_broken_graphml_is_a_clear_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "g.graphml").write_text("<a")
    assert main(["repair", str(tmp_path / "g.graphml")]) == 1
    assert "expected GraphML, got ParseError" in capsys.readouterr().err


def test_a_name_twice_in_graphml_is_a_clear_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    graph = nx.MultiDiGraph([("hall", "pantry", {"action": "east"})])
    text = "\n".join(nx.generate_graphml(graph))
    twice = text.replace('<node id="pantry" />', '<node id="pantry" /><node id="hall" />')
    assert twice != text
    (tmp_path / "g.graphml").write_text(twice)
    assert main(["repair", str(tmp_path / "g.graphml")]) == 1
    error = capsys.readouterr().err
    assert "node 3: expected another name than node 1, got 'hall' twice; rename one" in error
    assert error.count("\n") == 1
