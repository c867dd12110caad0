"""The course of a trace through a map: the parts of the map that displacements depend on."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import NamedTuple

from ssh_abduction.theory.evidence.protocol import Equality


class Course(NamedTuple):
    """The parts of a map that displacements depend on: labels of steps, and places of dstates."""

    labels: tuple[int, ...]
    places: tuple[int | None, ...]

    @staticmethod
    def of(labels: tuple[int, ...], places: tuple[int | None, ...]) -> Course:
        """Make a course of some labels. Places of dstates with larger numbers are left out."""
        return Course(labels, places[: max(labels, default=-1) + 1])


def hold(
    equalities: Collection[Equality], labels: Sequence[int], places: Sequence[int | None]
) -> bool:
    """Whether all these equalities hold in a map.

    Args:
        equalities: Equalities of two steps, the earlier one first.
        labels: The dstate of each step.
        places: The place of each dstate.
    """
    return all(
        equality.second < len(labels)
        and (
            labels[equality.first] == labels[equality.second]
            if equality.of == "dstate"
            else places[labels[equality.first]] == places[labels[equality.second]] is not None
        )
        for equality in equalities
    )
