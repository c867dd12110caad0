"""The error at the end of a loop of the trace: by odometry, the robot is not back where it was.

Displacements test only a part of a map: the labels of steps, and the places of dstates.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from ssh_abduction.theory.evidence.protocol import Equality


@dataclass(frozen=True)
class Closing:
    """The error at the end of a loop, in metres and radians, with standard deviations.

    A loop is the way between two steps that may be one dstate or at one place.

    Attributes:
        way: The metres driven from the first step of the loop to its last step.
        size: The distance between the ends of the loop.
        size_sigma: The standard deviation of `size`.
        turned: The difference between the headings at the ends of the loop.
        turned_sigma: The standard deviation of `turned`.
        square_of_position: The chi-square of the position, with two degrees of freedom.
    """

    way: float
    size: float
    size_sigma: float
    turned: float
    turned_sigma: float
    square_of_position: float

    @property
    def metres(self) -> str:
        """The distance between the ends in words, such as "11.2 ± 1.4 m"."""
        return f"{self.size:.1f} ± {self.size_sigma:.1f} m"

    @property
    def degrees(self) -> str:
        """The difference between the headings in words, such as "90 ± 3 degrees"."""
        return (
            f"{abs(math.degrees(self.turned)):.0f} ± {math.degrees(self.turned_sigma):.0f} degrees"
        )


class PlacedLabels(NamedTuple):
    """The part of a map that displacements test: labels of steps, and places of dstates."""

    labels: tuple[int, ...]
    places: tuple[int | None, ...]

    @staticmethod
    def of(labels: tuple[int, ...], places: tuple[int | None, ...]) -> PlacedLabels:
        """Combine labels with places. Places of dstates above the largest label are dropped."""
        return PlacedLabels(labels, places[: max(labels, default=-1) + 1])


def hold(
    equalities: Collection[Equality], labels: Sequence[int], places: Sequence[int | None]
) -> bool:
    """Whether all these equalities, the earlier step first, hold in a map.

    `labels` has the dstate of each step, and `places` the place of each dstate.
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
