"""Are the gateways found that changed between two drives?

    python benchmarks/changes.py [--cells 4] [--steps 60] [--seeds 20] [--first SEED] [--most 3]

Two robots drive through a maze with stars and noisy displacements, and start anywhere. Before the
second drive, 0 to `--most` ways between cells are closed or opened, at a cell that the first drive
saw. A view is one of `--views` looks of a cell and a heading, the same on both drives. The script
prints a row in Markdown for each number of changes: how many gateways changed at cells that both
drives saw, how many of these the first map names, and how many others it names. It names each map
that is false, and each change that is missed.

With --beam, only the beams of width 1 and of this width search, without a time limit. So the load
of the machine does not matter. Their cheapest map is judged.
"""

from __future__ import annotations

import argparse
import random
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

from instances import HEADINGS, doors_of, maze
from together import joined
from truth import NOISE, Known, is_true

from ssh_abduction import SSHMap, Theory, Trace, solve
from ssh_abduction.data import Odometry
from ssh_abduction.solver.guesses.beam import Beam
from ssh_abduction.solver.misfit import Misfit
from ssh_abduction.solver.steps.log import Log
from ssh_abduction.theory.settle import settle

Cell = tuple[int, int]
Gateway = tuple[Cell, int]  # a cell, and 0 to 3 for north, east, south, west


@dataclass(frozen=True)
class Case:
    """Two drives through a maze, and the gateways that changed where both were."""

    known: Known
    changed: frozenset[Gateway]


def case(cells: int, steps: int, seed: int, changes: int, views: int) -> Case:
    """Make two drives, between which some ways are closed or opened."""
    chance = random.Random(f"{seed}, {changes}")
    doors = set(doors_of(cells, cells, random.Random(seed), 0.1))
    looks = {state: chance.randrange(views) for state in product(*map(range, (cells, cells, 4)))}
    drives: list[Known] = []
    toggled: list[Gateway] = []
    for number in range(2):
        walk = maze(
            cells, cells, steps=steps, seed=seed, stars=True, follow=True, drive=number,
            odometry=Odometry(**NOISE), doors=doors,
        )  # fmt: skip
        trace = walk.trace.with_views([f"v{looks[state]}" for state in walk.truth])
        at = tuple(state[:2] for state in walk.truth if isinstance(state, tuple))
        drives.append(Known(f"maze {seed}, {changes} changes", trace, walk.truth, at))
        if not number:
            toggled = _toggled(cells, sorted(set(at)), chance)[:changes]
            for (x, y), way in toggled:
                ends = (x, y), (x + HEADINGS[way][0], y + HEADINGS[way][1])
                doors ^= {ends, ends[::-1]}
    both = set(drives[0].places) & set(drives[1].places)
    seen = {end for gateway in toggled for end in (gateway, _other(gateway)) if end[0] in both}
    return Case(joined(drives[0].name, drives), frozenset(seen))


def _toggled(cells: int, seen: list[Cell], chance: random.Random) -> list[Gateway]:
    """The ways at some cells that may change, in random order, each from one side."""
    inside = {(cell, way) for cell in seen for way in range(4)}
    inside = {g for g in inside if all(0 <= x < cells for x in _other(g)[0])}
    once = sorted(g for g in inside if _other(g) not in inside or g < _other(g))
    return chance.sample(once, len(once))


def _other(gateway: Gateway) -> Gateway:
    """The other end of a way."""
    (x, y), way = gateway
    return (x + HEADINGS[way][0], y + HEADINGS[way][1]), (way + 2) % 4


def named(ssh_map: SSHMap, known: Known) -> Iterator[Gateway]:
    """The gateways that a map says to have changed, by the true cell and heading of the step."""
    for fault in ssh_map.faults:
        x, y, heading = known.dstates[fault.step]
        slot = ssh_map.dstates[ssh_map.dstate_at[fault.step]].heading or 0
        yield (x, y), ((fault.gateway or 0) - slot + heading) % 4


def cheapest(trace: Trace, theory: Theory, width: int) -> SSHMap:
    """The map of least cost that beams of width 1 and of another width find."""
    problem = settle(trace, theory)
    log, misfit = Log(trace, problem.theory, problem.pairs), Misfit(problem)
    dstate, place, _ = theory.prices

    def nats(found: SSHMap) -> float:
        dstates = len(found.dstates) + sum(fault.cost for fault in found.faults)
        return dstate * dstates + place * len(found.places) + misfit.of_map(found) / 2

    return min((m for w in {1, width} for m in Beam(problem, log, w).maps()), key=nats)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--cells", type=int, default=4, metavar="N", help="mazes of N x N cells")
    parser.add_argument("--steps", type=int, default=60, metavar="N", help="actions of a drive")
    parser.add_argument("--seeds", type=int, default=20, metavar="N")
    parser.add_argument("--first", type=int, default=0, metavar="SEED", help="the first seed")
    parser.add_argument("--views", type=int, default=8, metavar="N", help="looks of dstates")
    parser.add_argument("--most", type=int, default=3, metavar="N", help="the most changes")
    parser.add_argument("--least", type=int, default=0, metavar="N", help="the fewest changes")
    parser.add_argument("--price", type=float, default=1.2, metavar="DSTATES")
    parser.add_argument("--limit", type=float, default=20, metavar="S", help="seconds for each")
    parser.add_argument("--beam", type=int, metavar="WIDTH", help="search by beams alone")
    options = parser.parse_args()
    theory = Theory(changed=options.price, star="frame")
    print("| changes | true maps | changed gateways | named | others named | maps that name none |")
    print("|---|---|---|---|---|---|")
    for changes in range(options.least, options.most + 1):
        true = changed = found = others = none = 0
        for seed in range(options.first, options.first + options.seeds):
            one = case(options.cells, options.steps, seed, changes, options.views)
            trace = one.known.trace
            best = (
                solve(trace, theory, time_limit=options.limit).maps[0]
                if options.beam is None
                else cheapest(trace, theory, options.beam)
            )
            told = set(named(best, one.known))
            if told != one.changed or not is_true(best, one.known):
                missed, more = sorted(one.changed - told), sorted(told - one.changed)
                print(f"{one.known.name}: missed {missed}, others {more}", file=sys.stderr)
            true += is_true(best, one.known)
            changed += len(one.changed)
            found += len(told & one.changed)
            others += len(told - one.changed)
            none += not told
        print(
            f"| {changes} | {true} of {options.seeds} | {changed} | {found} | {others} | {none} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
