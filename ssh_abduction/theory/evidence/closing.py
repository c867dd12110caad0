"""The error at the end of a loop of the trace, in numbers and in words."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Closing:
    """The error at the end of a loop, in metres and radians, with standard deviations.

    Attributes:
        way: Metres driven from its first step to its last one.
        size: The distance between its ends.
        size_sigma: The standard deviation of that distance.
        turned: The difference of heading.
        turned_sigma: The standard deviation of that difference.
        square_of_position: The chi-square of the position, with two degrees of freedom.
    """

    way: float
    size: float
    size_sigma: float
    turned: float
    turned_sigma: float
    square_of_position: float

    @property
    def square_of_heading(self) -> float:
        """The chi-square of the heading, with one degree of freedom."""
        return (self.turned / self.turned_sigma) ** 2

    @property
    def metres(self) -> str:
        """The distance in words, such as "11.2 ± 1.4 m"."""
        return f"{self.size:.1f} ± {self.size_sigma:.1f} m"

    @property
    def degrees(self) -> str:
        """The difference of heading in words, such as "90 ± 3 degrees"."""
        return (
            f"{abs(math.degrees(self.turned)):.0f} ± {math.degrees(self.turned_sigma):.0f} degrees"
        )
