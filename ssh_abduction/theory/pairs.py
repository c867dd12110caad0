"""Which pairs of steps are known, before the search, to be equal or different."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TypeAlias

# For each step, the earlier steps of its pairs.
Earlier: TypeAlias = Mapping[int, frozenset[int]]


@dataclass(frozen=True)
class Pairs:
    """What is known about pairs of steps before the search.

    Each attribute is a dict from a step to the set of earlier steps with which it forms a pair.

    Attributes:
        apart: Pairs of steps at different dstates (distinctive states: a place and a heading).
            All pairs of `elsewhere` are included.
        elsewhere: Pairs of steps at different places.
        one: Pairs of steps at one dstate.
    """

    apart: Earlier = field(default_factory=dict)
    elsewhere: Earlier = field(default_factory=dict)
    one: Earlier = field(default_factory=dict)

    @staticmethod
    def of(
        apart: Iterable[tuple[int, int]] = (),
        elsewhere: Iterable[tuple[int, int]] = (),
        one: Iterable[tuple[int, int]] = (),
    ) -> Pairs:
        """Make Pairs from pairs of steps in any order. Those of `elsewhere` are apart, too."""
        away = list(elsewhere)
        return Pairs(_earlier([*apart, *away]), _earlier(away), _earlier(one))

    @staticmethod
    def joined(several: Sequence[Pairs]) -> Pairs:
        """Return the union of several Pairs."""
        if len(several) <= 1:
            return several[0] if several else NO_PAIRS
        return Pairs(
            *(
                _united([getattr(pairs, name) for pairs in several])
                for name in ("apart", "elsewhere", "one")
            )
        )

    def __bool__(self) -> bool:
        return bool(self.apart or self.one)

    @cached_property
    def asked_for(self) -> frozenset[int]:
        """The later steps of all pairs."""
        return frozenset((*self.apart, *self.one))

    def allow(
        self, step: int, labels: Sequence[int], place_of: Sequence[int | None] | None = None
    ) -> bool:
        """Whether what is known about a step and earlier steps allows the label of the step.

        `labels` has the dstate of each step, and `place_of` the place of each dstate, if known.
        Without `place_of`, steps of `elsewhere` are only tested for different dstates.
        """
        if step not in self.asked_for:
            return True
        here = labels[step]
        if any(labels[other] == here for other in self.apart.get(step, ())):
            return False
        if any(labels[other] != here for other in self.one.get(step, ())):
            return False
        if not place_of or place_of[here] is None:
            return True
        return all(
            place_of[labels[other]] != place_of[here] for other in self.elsewhere.get(step, ())
        )

    def broken_by(self, labels: Sequence[int]) -> list[tuple[int, int]]:
        """List the pairs, the earlier step first, that contradict the labels of the first steps."""
        size = len(labels)
        wrong = [(i, t) for i, t in pairs_in(self.apart) if t < size and labels[i] == labels[t]]
        return wrong + [
            (i, t) for i, t in pairs_in(self.one) if t < size and labels[i] != labels[t]
        ]


def pairs_in(earlier: Earlier) -> list[tuple[int, int]]:
    """List the pairs of a dict such as `Pairs.one`, as (earlier step, later step)."""
    return [(i, t) for t, others in earlier.items() for i in others]


def _united(several: Sequence[Earlier]) -> Earlier:
    """Return the union of several dicts from steps to sets of earlier steps."""
    first, *rest = several
    united = dict(first)
    for earlier in rest:
        for t, others in earlier.items():
            united[t] = united[t] | others if t in united else others
    return united


def _earlier(pairs: Iterable[tuple[int, int]]) -> dict[int, frozenset[int]]:
    """Return a dict from the later step of the pairs to the set of its earlier steps."""
    found: dict[int, set[int]] = {}
    for i, j in pairs:
        found.setdefault(max(i, j), set()).add(min(i, j))
    return {t: frozenset(others) for t, others in found.items()}


NO_PAIRS = Pairs()
