"""What the solver may use at each step while a robot drives."""

from __future__ import annotations

from dataclasses import dataclass

from ssh_abduction.theory.speedups import Speedups


@dataclass(frozen=True, slots=True)
class StepOptions:
    """What the solver may use at each step.

    Attributes:
        time_limit: Seconds that a step may take, about; None waits for the exact answer.
        max_maps: Keep at most this many minimal maps; None keeps all.
        speedups: Which speed-ups are on.
    """

    time_limit: float | None
    max_maps: int | None
    speedups: Speedups
