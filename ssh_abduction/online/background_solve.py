"""Solves a trace with faults in a process of its own, while the robot drives and the trace grows."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.online.background import Beside
from ssh_abduction.solver import Bound, Status, Stop, Watch, has_processors, in_process, solve
from ssh_abduction.theory.speedups import Speedups
from ssh_abduction.theory.theory import Theory

MEANWHILE = (
    60.0  # For so many seconds a trace is solved; what it has grown to since is more worth it then.
)


@dataclass(frozen=True, slots=True)
class Solved:
    """What solving a trace of so many steps has found, as in Solution: that much can be sent from a process to another."""

    steps: int
    status: Status
    maps: tuple[SSHMap, ...]
    bound: Bound
    complete: bool
    stopped: Stop | None


def solved(
    trace: Trace,
    theory: Theory,
    limit: float | None,
    maps: int | None,
    speedups: Speedups,
    watch: Watch | None = None,
) -> Solved:
    """What `solve` finds for the steps so far."""
    found = solve(
        trace, theory.of_steps(0, len(trace)), time_limit=limit, max_maps=maps, speedups=speedups
    )
    return Solved(len(trace), found.status, found.maps, found.bound, found.complete, found.stopped)


class Meanwhile(Beside[Solved]):
    """Solves the steps so far in a process of its own."""

    def __init__(self, trace: Trace, theory: Theory, maps: int | None, speedups: Speedups) -> None:
        super().__init__(partial(_solve, trace, theory, maps, speedups))

    @staticmethod
    def begun(
        trace: Trace, theory: Theory, maps: int | None, speedups: Speedups
    ) -> Meanwhile | None:
        """None where there is no second processor, or processes are not wanted."""
        return (
            Meanwhile(trace, theory, maps, speedups)
            if speedups.processes and has_processors(speedups)
            else None
        )


def _solve(
    trace: Trace, theory: Theory, maps: int | None, speedups: Speedups, watch: Watch
) -> Solved:
    return in_process(solved, trace, theory, MEANWHILE, maps, speedups, watch=watch)
