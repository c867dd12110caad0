"""The map of a world without robots: a maze in a text adventure.

    python examples/adventure.py            solves the logged game, and compares map and maze
    python examples/adventure.py --play F   plays the game again, and writes its trace to F

All rooms look alike, and passages twist: going north and then south does not lead back. The player
has dropped three things to distinguish rooms. The solver for maps of robots also finds the smallest
maze that explains what the player typed and read.
"""

from __future__ import annotations

import argparse
import random
from pathlib import Path

import networkx as nx

from ssh_abduction import Theory, Trace, solve
from ssh_abduction.output import to_networkx

HERE = Path(__file__).parent
COMPASS = ("north", "south", "east", "west")
ALIKE = "You are in a maze of twisty little passages, all alike."
ROOMS = {  # the thing in each room, and the rooms to the north, south, east and west
    0: ("A lantern is here.", (1, 3, 2, 0)),
    1: ("", (4, 0, 1, 5)),
    2: ("A sword is here.", (3, 5, 0, 2)),
    3: ("", (0, 2, 4, 1)),
    4: ("A bottle is here.", (5, 1, 3, 4)),
    5: ("", (2, 4, 5, 3)),
}


def play(commands: int, seed: int) -> Trace:
    """Play a game in which the player wanders at random.

    Args:
        commands: Number of commands.
        seed: Seed of the random choices.

    Returns:
        A trace whose views are the texts that were read, and whose actions are the commands.
    """
    choose = random.Random(seed)
    room, read, typed = 0, [], []
    for i in range(commands + 1):
        read.append(f"{ALIKE} {ROOMS[room][0]}".strip())
        if i < commands:
            typed.append(choose.choice(COMPASS))
            room = ROOMS[room][1][COMPASS.index(typed[-1])]
    return Trace.from_steps(read, typed, name="A maze of twisty little passages, all alike")


def maze() -> nx.MultiDiGraph:
    """Make the graph of the maze: rooms as nodes with views, passages as edges with actions."""
    graph = nx.MultiDiGraph()
    for room, (thing, exits) in ROOMS.items():
        graph.add_node(room, view=f"{ALIKE} {thing}".strip())
        for command, target in zip(COMPASS, exits, strict=True):
            graph.add_edge(room, target, key=command, action=command)
    return graph


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--play", metavar="F", help="play the game, and write its trace to F")
    options = parser.parse_args()
    if options.play:
        play(commands=100, seed=1).save(options.play)
        return
    trace = Trace.load(HERE / "adventure.jsonl")
    solution = solve(trace, Theory.causal())
    print(
        f"{len(trace)} texts read, {len(set(trace.views))} of them different: "
        f"{solution.cost.dstates} rooms, {solution.count} minimal map(s)"
    )
    for ssh_map in solution.maps:
        same = nx.is_isomorphic(
            to_networkx(ssh_map),
            maze(),
            node_match=lambda a, b: a["view"] == b["view"],
            edge_match=lambda a, b: a.keys() == b.keys(),
        )
        print("the map is the maze" if same else "the map differs from the maze")


if __name__ == "__main__":
    main()
