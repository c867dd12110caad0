"""Facts for `fast/visits.lp`, which says which visits are at one place, and its answers."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import product

from clingo import Function, Symbol

from ssh_abduction.solver.asp.facts.atoms import numbers


def visit_facts(
    batch: int,
    nodes: Iterable[tuple[int, int, int]],
    leaves: Iterable[tuple[int, int, int]],
    fits: Iterable[tuple[int, int, int]],
    unfit: Iterable[tuple[int, int, int]] = (),
) -> str:
    """The facts of visits.lp for one batch.

    Args:
        batch: The number of the batch.
        nodes: Number, visit and slot of each node.
        leaves: Visits that end: the visit, the slot and the action.
        fits: Pairs of visits that may be at one place, and how they are turned.
        unfit: Pairs of earlier batches that may no longer be.
    """
    new = {"node": nodes, "leaves": leaves, "fits": fits, "unfit": unfit}
    return "\n".join(
        f"{name}({batch},{','.join(map(str, args))})."
        for name, rows in new.items()
        for args in rows
    )


def same(pair: tuple[int, int, int]) -> Symbol:
    """The atom that two visits are at one place, and how they are turned to each other."""
    return Function("same", numbers(*pair))


def read_same(atom: Symbol) -> tuple[int, int, int]:
    """The two visits of such an atom, and how they are turned to each other."""
    first, second, turned = (argument.number for argument in atom.arguments)
    return first, second, turned


def listed(batch: int) -> Symbol:
    """The external atom that is true while answers for the batches up to this one are listed."""
    return Function("listed", numbers(batch))


def first(place: int) -> Symbol:
    """The atom that the node at this position of the order is the first at its dstate."""
    return Function("first", numbers(place))


def over(core: int, count: int) -> Symbol:
    """The atom that at least `count` members of a core are true."""
    return Function("over", numbers(core, count))


def read_over(member: Symbol) -> tuple[int, int] | None:
    """The core and the count of such an atom; None for another atom."""
    return (
        (member.arguments[0].number, member.arguments[1].number) if member.name == "over" else None
    )


def core_facts(core: int, members: Iterable[Symbol]) -> str:
    """The members of a core."""
    return "\n".join(f"member({core},{member})." for member in members)


def three_facts(batch: int, threes: Iterable[tuple[int, ...]]) -> str:
    """Threes of visits for which "is at one place" has to be transitive."""
    return "\n".join(f"via({batch},{','.join(map(str, three))})." for three in threes)


def forbidden_pairs(
    pairs: Iterable[tuple[int, int, int]],
    different: Iterable[tuple[int, int, int]] = (),
    listed: int | None = None,
) -> str:
    """The rule that not all `pairs` of visits are at one place while no `different` pair is.

    Args:
        pairs: Pairs of visits, and how they are turned.
        different: The same.
        listed: The rule holds only while answers up to this batch are listed; None for always.
    """
    body = [
        *(f"same({i},{j},{r})" for i, j, r in pairs),
        *(f"not same({i},{j},{r})" for i, j, r in different),
    ]
    return f":- {', '.join(['#true', *body] if listed is None else [f'listed({listed})', *body])}."


def forbidden_places(equalities: Sequence[Sequence[tuple[int, int, int]]]) -> str:
    """The rules that not all equalities hold. An equality is that one of its pairs is one place."""
    return "\n".join(forbidden_pairs(pairs) for pairs in product(*equalities))
