"""Makes "is at the same place as" transitive in answers of visits.lp.

If visits I and J are at one place, and J and K, then so are I and K. These rules are not grounded
beforehand, as there are millions of triples of visits. `intransitive` finds the triples that an
answer violates.
"""

from __future__ import annotations

from collections.abc import Sequence, Set
from typing import TypeAlias

from ssh_abduction.solver.steps.chart import FramedChart

# After finding this many triples of visits, stop looking for more, and give them to clingo.
# Grounding them takes longer than finding them.
AT_A_TIME = 20_000

# (I, J, R): visits I < J are at one place, and slot (direction) 0 of I is slot R of J.
Pair: TypeAlias = tuple[int, int, int]
# (I, J, K, R, Q): visits I < J < K are at one place, slot 0 of I is slot R of J, and slot 0 of J is
# slot Q of K.
Three: TypeAlias = tuple[int, int, int, int, int]
# For each visit, the other visits at its place, each with the slot there that is its own slot 0.
Turned: TypeAlias = dict[int, dict[int, int]]


def intransitive(pairs: Sequence[Pair], fits: Set[Pair], chart: FramedChart) -> list[Three]:
    """Find the triples of visits at which an answer is not transitive.

    `pairs` of visits are at one place in the answer, and `fits` are those that clingo may put at
    one place. Pairs that follow from the answer by the axioms are also checked. The chart has the
    action that ends each visit.
    """
    found: dict[Three, None] = {}
    turned: Turned = {}
    leaves = chart.leaves
    work = list(pairs)
    for pair in pairs:
        take(turned, pair)
    for i, j, r in work:
        # If two visits are at one place and end by the same action in the same direction, then the
        # next visits are also at one place.
        follows = (
            [(i + 1, j + 1, 0)]
            if i in leaves and leaves.get(j) == ((leaves[i][0] + r) % 4, leaves[i][1])
            else []
        )
        for first, (middle, half), (last, turn) in apart_yet_joined((i, j, r), turned):
            found[_in_order((first, 0), (middle, half), (last, turn))] = None
            follows.append((first, last, turn) if first < last else (last, first, -turn % 4))
        for pair in follows:
            if pair in fits and pair[1] not in turned.get(pair[0], ()):
                take(turned, pair)
                work.append(pair)
        if len(found) >= AT_A_TIME:
            break
    return list(found)


def take(turned: Turned, pair: Pair) -> None:
    """Record in `turned` that two visits are at one place, with the rotation between them."""
    i, j, r = pair
    turned.setdefault(i, {})[j] = r
    turned.setdefault(j, {})[i] = -r % 4


def apart_yet_joined(
    pair: Pair, turned: Turned
) -> list[tuple[int, tuple[int, int], tuple[int, int]]]:
    """Find triples of visits in which two pairs are at one place, but not the third pair.

    The two visits of `pair` are in each triple, and have just been put at one place. A triple is
    (first, (middle, slot), (last, slot)). The answer puts the middle visit at one place with each
    of the others. But it lacks the pair of the first and the last visit, or turns it differently.
    Each slot of a visit is the same direction at the place as slot 0 of the first visit.
    """
    i, j, r = pair
    of_i, of_j = turned[i], turned[j]
    joined = [
        (i, (j, r), (k, (r + q) % 4))
        for k, q in of_j.items()
        if k != i and of_i.get(k) != (r + q) % 4
    ]
    return joined + [
        (j, (i, -r % 4), (k, (q - r) % 4))
        for k, q in of_i.items()
        if k != j and of_j.get(k) != (q - r) % 4
    ]


def _in_order(*visits: tuple[int, int]) -> Three:
    """Sort three visits at one place, each with a slot. All slots are one direction there."""
    (i, a), (j, b), (k, c) = sorted(visits)
    return i, j, k, (b - a) % 4, (c - b) % 4
