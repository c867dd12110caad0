"""Write facts for `fast/visits.lp`, and read its answers.

That encoding finds which visits are at one place. A *pair* of visits is a triple (I, J, R) with
I < J. It means that I and J are at one place, and slot 0 of I is slot R of J.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import product

from clingo import Function, Symbol

from ssh_abduction.solver.asp.facts.atoms import number_symbols


def visit_facts(
    batch: int,
    nodes: Iterable[tuple[int, int, int]],
    leaves: Iterable[tuple[int, int, int]],
    fits: Iterable[tuple[int, int, int]],
    unfit: Iterable[tuple[int, int, int]] = (),
    joined: Iterable[tuple[int, int, int]] = (),
) -> str:
    """Return the facts for one batch.

    Args:
        batch: The number of the batch.
        nodes: For each node (the steps of a visit that face one slot), its number, visit and slot.
        leaves: For each visit that ends, the visit, the slot that it leaves through, and the
            action.
        fits: Pairs of visits (I, J, R) that may be at one place.
        unfit: Pairs (I, J, R) of earlier batches that are now known not to be at one place.
        joined: Pairs (I, J, R) that the user says are at one place.
    """
    new = {"node": nodes, "leaves": leaves, "fits": fits, "unfit": unfit, "joined": joined}
    return "\n".join(
        f"{name}({batch},{','.join(map(str, args))})."
        for name, rows in new.items()
        for args in rows
    )


def read_same(atom: Symbol) -> tuple[int, int, int]:
    """Read the pair of visits (I, J, R) from an atom of `same`."""
    first, second, turned = (argument.number for argument in atom.arguments)
    return first, second, turned


def listing_atom(batch: int) -> Symbol:
    """Return the external atom that is true while answers up to this batch are listed."""
    return Function("listed", number_symbols(batch))


def first(place: int) -> Symbol:
    """Return the atom that says that a node is the first at its dstate.

    Args:
        place: The number of the node, which is its position in the order of nodes.
    """
    return Function("first", number_symbols(place))


def three_facts(batch: int, threes: Iterable[tuple[int, ...]]) -> str:
    """Return the facts for triples of visits for which "is at one place" has to be transitive.

    Args:
        batch: The number of the program part. Each call has a new one.
        threes: Tuples (I, J, J2, R, Q): the pairs (I, J, R) and (J, J2, Q) imply that I and J2 are
            at one place.
    """
    return "\n".join(f"via({batch},{','.join(map(str, three))})." for three in threes)


def forbidden_pairs(
    pairs: Iterable[tuple[int, int, int]],
    different: Iterable[tuple[int, int, int]] = (),
    listed: int | None = None,
) -> str:
    """Return the rule that forbids answers with all pairs of one set and none of another set.

    Args:
        pairs: Pairs (I, J, R) that are all at one place in the forbidden answers.
        different: Pairs (I, J, R) that are not at one place in the forbidden answers.
        listed: The rule applies only while answers up to this batch are listed; None for always.
    """
    body = [
        *(f"same({i},{j},{r})" for i, j, r in pairs),
        *(f"not same({i},{j},{r})" for i, j, r in different),
    ]
    return f":- {', '.join(['#true', *body] if listed is None else [f'listed({listed})', *body])}."


def forbidden_places(equalities: Sequence[Sequence[tuple[int, int, int]]]) -> str:
    """Return the rules that some equalities do not all hold.

    Args:
        equalities: For each equality, pairs of visits (I, J, R). The equality holds if one of its
            pairs is at one place.
    """
    return "\n".join(forbidden_pairs(pairs) for pairs in product(*equalities))
