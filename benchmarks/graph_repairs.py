"""Repairs of graphs that a language model made of text adventures (LLM-MapRepair).

    git clone https://github.com/nitpicker55555/MapRepair
    python benchmarks/graph_repairs.py MapRepair

The graphs are `results/exp14/gpt-4.1/*_edges.json` (arXiv 2510.04195), and the truth is in
`data_fixed`. Only graphs with a truth and with conflicts count. The conflicts are those of their
`src/maprepair/conflict.py`: of directions, of ways back, and of rooms at one position if each move
is one unit long. As there, a graph has one edge from each room to another, and each edge leads
back. The script prints a table in Markdown, and a line with the sums.
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path

from ssh_abduction.explain.graph_repair import GraphMove, read_moves, repair

UNITS = {
    "north": (0, 1, 0),
    "east": (1, 0, 0),
    "northeast": (1, 1, 0),
    "northwest": (-1, 1, 0),
    "up": (0, 0, 1),
    "in": (0, 0, 0),
    "enter": (0, 0, 0),
}
OPPOSITE = {
    "north": "south",
    "east": "west",
    "northeast": "southwest",
    "northwest": "southeast",
    "up": "down",
    "in": "out",
    "enter": "exit",
}
UNITS |= {back: (-x, -y, -z) for a, back in OPPOSITE.items() for x, y, z in [UNITS[a]]}
OPPOSITE |= {back: action for action, back in OPPOSITE.items()}
POSITIONS = 4  # that their detector follows for one room
HEAD = (
    "| graph | edges | wrong | conflicts | left | of directions | edges dropped | true lost: "
    "first, best | repairs | blamed | truly wrong | turned | then right | seconds |",
    "|---|---|---|---|---|---|---|---|---|---|---|---|---|---|",
)


def loaded(moves: Iterable[GraphMove]) -> tuple[dict[tuple[str, str], str], set[GraphMove]]:
    """Load edges as they do: the action from each room to another, and the edges that were used."""
    actions: dict[tuple[str, str], str] = {}
    used = set()
    for move in moves:
        if (move.source, move.target) not in actions:
            used.add(move)
            actions[move.source, move.target] = move.action
            if move.action in OPPOSITE:
                actions.setdefault((move.target, move.source), OPPOSITE[move.action])
    return actions, used


def conflicts(actions: dict[tuple[str, str], str]) -> tuple[int, int]:
    """Count the conflicts of directions and of ways back, and the positions of several rooms."""
    to: dict[tuple[str, str], set[str]] = defaultdict(set)
    ways: dict[str, list[tuple[str, str]]] = defaultdict(list)
    for (source, target), action in actions.items():
        to[source, action].add(target)
        ways[source].append((target, action))
    found = sum(len(targets) > 1 for targets in to.values())
    for (source, target), action in actions.items():
        back = actions.get((target, source))
        found += source < target and {action, back} <= {*OPPOSITE} and back != OPPOSITE[action]
    at: dict[tuple[int, ...], set[str]] = defaultdict(set)
    left = sorted({room for pair in actions for room in pair})
    seen: dict[str, set[tuple[int, ...]]] = defaultdict(set)
    for root in left:
        if root in seen:
            continue
        frontier = [(root, (0, 0, 0))]
        seen[root].add((0, 0, 0))
        part = {root}
        while frontier:
            room, place = frontier.pop()
            for target, action in ways[room]:
                if action in UNITS and any(UNITS[action]):
                    there = tuple(a + b for a, b in zip(place, UNITS[action], strict=True))
                    if there not in seen[target] and len(seen[target]) < POSITIONS:
                        frontier.append((target, there))
                    seen[target].add(there)
                    part.add(target)
        for room in part:
            for place in seen[room]:
                at[root, *place].add(room)
    return found, sum(len(rooms) > 1 for rooms in at.values())


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("folder", type=Path, help="a clone of MapRepair")
    parser.add_argument("--without", default="", help="axioms to leave out, separated by commas")
    options = parser.parse_args()
    print("\n".join(HEAD))
    sums = [0] * 12
    for file in sorted(options.folder.glob("results/exp14/gpt-4.1/*_edges.json")):
        name = file.name.removesuffix("_edges.json")
        truth_file = options.folder / "data_fixed" / name / f"{name}.edges.json"
        if not truth_file.exists():
            continue
        truth = {*read_moves(str(truth_file))}
        truth |= {GraphMove(m.target, OPPOSITE.get(m.action, ""), m.source) for m in truth}
        moves = read_moves(str(file))
        before, used = loaded(moves)
        if not sum(conflicts(before)):
            continue
        began = time.process_time()
        without = [axiom for axiom in options.without.split(",") if axiom]
        found = repair(moves, without=without, most=1000)
        seconds = time.process_time() - began
        kept = [m for e, m in enumerate(found.moves) if e not in found.repairs[0]]
        after = loaded(kept)[0]
        # A way that is kept in one of its two directions is not lost.
        lost = [
            sum(
                m in truth and (m.source, m.target) not in now
                for m in used
                for now in [loaded(m for e, m in enumerate(found.moves) if e not in wrong)[0]]
            )
            for wrong in found.repairs
        ]
        blamed = found.blamed or ()
        # Under their own actions, an edge is turned instead if one action alone makes it right.
        turns = zip(found.repairs[0], (found.turns[0] if found.turns else None) or (), strict=False)
        turned = [found.moves[e]._replace(action=a[0]) for e, a in turns if len(a) == 1]
        numbers = [
            len(found.moves),
            sum(m not in truth for m in found.moves),
            sum(conflicts(before)),
            sum(conflicts(after)),
            conflicts(after)[0],
            found.fewest,
            lost[0],
            min(lost),
            len(blamed),
            sum(found.moves[e] not in truth for e in blamed),
            len(turned),
            sum(move in truth for move in turned),
        ]
        sums = [a + b for a, b in zip(sums, numbers, strict=True)]
        print(_row(name, numbers, str(len(found.repairs)) + "+" * (not found.complete), seconds))
    print(_row("all", sums, "", None))


def _row(name: str, n: list[int], repairs: str, seconds: float | None) -> str:
    cells = [name, *n[:6], f"{n[6]}, {n[7]}", repairs, *n[8:], "" if seconds is None else seconds]
    return "| " + " | ".join(f"{c:.2f}" if isinstance(c, float) else str(c) for c in cells) + " |"


if __name__ == "__main__":
    main()
