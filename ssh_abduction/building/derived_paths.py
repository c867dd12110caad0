"""Pair the ends of edges into paths, and find the sides of paths.

See encodings/derived/paths.lp and encodings/derived/sides.lp for the axioms. Both follow from a
finished map, so they cannot change which maps there are.

>>> ends = [(0, 0, 7), (1, 0, 8), (2, 1, 8), (3, 1, 9)]  # edges 0 and 1 meet at place 8
>>> best, gaps = best_pairings(ends, {(1, 2): 0.5}, ())
>>> best, gaps
((((1, 2),),), (3.5,))
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import pairwise
from typing import Any

from clingo import Function, Number

from ssh_abduction.solver import Control, new_control

# The price of an end of a path, in nats. Costs of joints are rounded to 1 / UNIT nats.
PRICE, UNIT = 4.0, 100
Pairing = tuple[tuple[int, int], ...]  # pairs of ends, sorted
End = tuple[int, int, int]  # an end, its edge and its place


def best_pairings(
    ends: Iterable[End],
    costs: Mapping[tuple[int, int], float],
    apart: Iterable[tuple[int, int]],
    most: int = 1,
) -> tuple[tuple[Pairing, ...], tuple[float, ...]]:
    """Find the best pairings of the ends of edges.

    Args:
        ends: The ends: for each, its number, the number of its edge, and its place.
        costs: The cost of pairing two ends at one place, in nats, the smaller end first.
        apart: The pairs of edges that are not on one path, the smaller edge first.
        most: How many of the best pairings to list, which have equal costs; 0 for all.

    Returns:
        The best pairings. And for each path of the first one, in the order of `chains_of`, how many
        nats worse the best pairing without this path is; infinite if there is no other.
    """
    ends = list(ends)
    facts = [f"end({e},{x},{p})." for e, x, p in ends]
    facts += [f"joint({e},{f},{round(UNIT * cost)})." for (e, f), cost in costs.items()]
    facts += [f"apart({x},{y})." for x, y in apart]
    control = new_control("derived/paths", "\n".join(facts), ["-c", f"price={round(UNIT * PRICE)}"])
    found = sorted(_least(control, most))
    least = _saved(found[0], costs)
    gaps = []
    for k, chain in enumerate(chains_of(ends, found[0])):
        inner = [(e ^ 1, f) for e, f in pairwise(chain)]
        free = [chain[0], chain[-1] ^ 1]
        own = [f"part({k},{min(pair)},{max(pair)})." for pair in inner]
        control.add(f"of{k}", [], " ".join([*own, *(f"free({k},{e})." for e in free)]))
        control.ground([(f"of{k}", []), ("other", [Number(k)])])
        asked = Function("asked", [Number(k)])
        control.assign_external(asked, True)
        others = _least(control, 1)
        control.assign_external(asked, False)
        gaps.append((_saved(others[0], costs) - least) if others else float("inf"))
    return tuple(found), tuple(gaps)


def chains_of(ends: Iterable[End], pairing: Pairing) -> list[list[int]]:
    """Return the paths of a pairing, each as the ends at which its edges begin.

    The two ends of an edge are 2 x and 2 x + 1.
    """
    onward = dict(pairing) | {f: e for e, f in pairing}
    found, done = [], set[int]()
    for e, x, _ in sorted(ends):
        if x in done or e in onward:
            continue  # Begin where nothing goes on.
        chain = [e]
        while (after := onward.get(chain[-1] ^ 1)) is not None:
            chain.append(after)
        done |= {f // 2 for f in chain}
        found.append(chain)
    return found


def sides_of(
    on: Iterable[tuple[int, int]],
    leaves: Iterable[tuple[int, int, str, int]],
    joined: Iterable[tuple[int, int]],
) -> tuple[set[tuple[int, str, int]], set[tuple[int, int]]]:
    """Find the places beside paths, and around them.

    Args:
        on: The paths, each with one of its places.
        leaves: The edges that leave paths: a path, its place, the side, and the place at the end.
        joined: The places that an edge joins.

    Returns:
        The paths, each with a side and a place there; and the paths, each with a place around it.
    """
    facts = [f"on({h},{p})." for h, p in on]
    facts += [f"leaves({h},{p},{side},{q})." for h, p, side, q in leaves]
    facts += [f"joined({p},{q})." for p, q in joined]
    control = new_control("derived/sides", "\n".join(facts))
    beside = {(h.number, side.name, q.number) for h, side, q in _facts(control, "beside", 3)}
    around = {(h.number, q.number) for h, q in _facts(control, "around", 2)}
    return beside, around


def _facts(control: Control, name: str, arity: int) -> Iterable[Any]:
    return (atom.symbol.arguments for atom in control.symbolic_atoms.by_signature(name, arity))


def _least(control: Control, most: int) -> list[Pairing]:
    """List pairings of least cost: at most this many, or all for 0. Empty if there is none."""
    configuration: Any = control.configuration.solve
    configuration.opt_mode, configuration.models = ("opt", 0) if most == 1 else ("optN", most)
    found: list[Pairing] = []
    for model in control.models():
        if most == 1 or model.optimality_proven:
            pairs = (s.arguments for s in model.symbols(shown=True))
            found.append(tuple(sorted((e.number, f.number) for e, f in pairs)))
    return found[-1:] if most == 1 else found


def _saved(pairing: Pairing, costs: Mapping[tuple[int, int], float]) -> float:
    """The cost of a pairing in nats, less the price of the ends that it saves."""
    return round(sum(round(UNIT * costs[pair]) - UNIT * PRICE for pair in pairing) / UNIT, 2)
