"""Write facts for `fast/visits.lp`, and read its answers.

That encoding finds which visits are at one place. A *slot* of a visit is one of its four
directions. Slots are numbered clockwise from the heading on arrival. A *pair* of visits is a triple
(I, J, R) with I < J. It means that I and J are at one place, and slot 0 of I is slot R of J.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import lru_cache
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
    together: Iterable[tuple[int, int]] = (),
) -> str:
    """Return the facts for one batch.

    Each node (the steps of a visit that face one slot) has its number, visit and slot. `leaves` has
    each visit that ends, with the slot that it leaves through, and the action. Triples (I, J, R)
    stand for pairs of visits: `fits` may be at one place, `unfit` of earlier batches are now known
    not to be, and `joined` are at one place, as the user says. So are the pairs (I, J) of
    `together`, with any rotation.
    """
    new: dict[str, Iterable[tuple[int, ...]]] = {
        "node": nodes,
        "leaves": leaves,
        "fits": fits,
        "unfit": unfit,
        "joined": joined,
        "together": together,
    }
    return "\n".join(
        f"{name}({batch},{','.join(map(str, args))})."
        for name, rows in new.items()
        for args in rows
    )


@lru_cache(maxsize=2**16)
def read_same(atom: Symbol) -> tuple[int, int, int]:
    """Read the pair of visits (I, J, R) from an atom of `same`. Answers share most atoms."""
    first, second, turned = (argument.number for argument in atom.arguments)
    return first, second, turned


def listing_atom(batch: int) -> Symbol:
    """Return the external atom that is true while answers up to this batch are listed."""
    return Function("listed", number_symbols(batch))


def first(place: int) -> Symbol:
    """Return the atom: the node at index `place` of the order is the first one at its dstate."""
    return Function("first", number_symbols(place))


def three_facts(batch: int, threes: Iterable[tuple[int, ...]]) -> str:
    """Return the facts for triples of visits for which "is at one place" has to be transitive.

    Each call has a new `batch`. In a triple (I, J, J2, R, Q), the pairs (I, J, R) and (J, J2, Q)
    imply that I and J2 are at one place.
    """
    return "\n".join(f"via({batch},{','.join(map(str, three))})." for three in threes)


def forbidden_pairs(
    pairs: Iterable[tuple[int, int, int]],
    different: Iterable[tuple[int, int, int]] = (),
    listed: int | None = None,
) -> str:
    """Return the rule against answers with all of `pairs` and none of `different` at one place.

    Triples (I, J, R) stand for pairs of visits. The rule applies only while answers up to the batch
    `listed` are listed; None for always.
    """
    body = [
        *(f"same({i},{j},{r})" for i, j, r in pairs),
        *(f"not same({i},{j},{r})" for i, j, r in different),
    ]
    return f":- {', '.join(['#true', *body] if listed is None else [f'listed({listed})', *body])}."


def forbidden_places(equalities: Sequence[Sequence[tuple[int, int, int]]]) -> str:
    """Return the rules that some equalities do not all hold.

    Each equality has pairs of visits (I, J, R), and holds if one of them is at one place.
    """
    return "\n".join(forbidden_pairs(pairs) for pairs in product(*equalities))
