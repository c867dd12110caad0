"""What is known about pairs of steps before the search."""

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

    Each mapping leads from a step to earlier steps.

    Attributes:
        apart: They are different dstates. This includes all pairs of `elsewhere`.
        elsewhere: They are at different places.
        one: They are one dstate.
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
        """Make a value of pairs whose steps come in any order."""
        away = list(elsewhere)
        return Pairs(_earlier([*apart, *away]), _earlier(away), _earlier(one))

    @staticmethod
    def joined(several: Sequence[Pairs]) -> Pairs:
        """The knowledge of several kinds of evidence together."""
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
        """The later step of each pair."""
        return frozenset((*self.apart, *self.one))

    def allow(
        self, step: int, labels: Sequence[int], place_of: Sequence[int | None] | None = None
    ) -> bool:
        """Whether a step may have its label, by its pairs with earlier steps.

        Args:
            step: The step.
            labels: The dstate of each step.
            place_of: The place of each dstate, if known.
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
        """The pairs of the first steps that their labels contradict."""
        size = len(labels)
        wrong = [(i, t) for i, t in pairs_in(self.apart) if t < size and labels[i] == labels[t]]
        return wrong + [
            (i, t) for i, t in pairs_in(self.one) if t < size and labels[i] != labels[t]
        ]


def pairs_in(earlier: Earlier) -> list[tuple[int, int]]:
    """The pairs of a mapping, the earlier step first."""
    return [(i, t) for t, others in earlier.items() for i in others]


def _united(several: Sequence[Earlier]) -> Earlier:
    """The union of these mappings."""
    first, *rest = several
    united = dict(first)
    for earlier in rest:
        for t, others in earlier.items():
            united[t] = united[t] | others if t in united else others
    return united


def _earlier(pairs: Iterable[tuple[int, int]]) -> dict[int, frozenset[int]]:
    """The earlier steps, by the later step of each pair."""
    found: dict[int, set[int]] = {}
    for i, j in pairs:
        found.setdefault(max(i, j), set()).add(min(i, j))
    return {t: frozenset(others) for t, others in found.items()}


NO_PAIRS = Pairs()
