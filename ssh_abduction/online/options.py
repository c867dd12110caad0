"""The limits and speed-ups for each step while a robot drives."""

from __future__ import annotations

from dataclasses import dataclass

from ssh_abduction.theory.speedups import Speedups


@dataclass(frozen=True, slots=True)
class StepOptions:
    """The limits and speed-ups for solving at each step.

    Attributes:
        time_limit: Seconds for each step. A step may take a little longer. None waits for the exact
            answer.
        max_maps: Keep at most this many minimal maps; None keeps all.
        speedups: The speed-ups that are on.
    """

    time_limit: float | None
    max_maps: int | None
    speedups: Speedups
