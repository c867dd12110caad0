"""Find maps with more dstates than the minimum: for each number of dstates, the best such maps.

Solving a prefix of the trace is enough only for minimal maps (`prefixes.py`). A map with one dstate
more may become minimal when it is cut to a prefix. So here the readable encodings
(`encodings/*.lp`) get the whole trace, and a rule that fixes the number of dstates.

If the theory minimises paths or places first, their number is fixed instead. The number of excuses
(pairs of paths to which an axiom is not applied) is never fixed: adding an excuse never makes a map
inconsistent.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.solver.asp.control import Asker
from ssh_abduction.solver.board import Judging, Known
from ssh_abduction.solver.sources.exact.choosing import step_engine
from ssh_abduction.solver.sources.exact.engine import Task
from ssh_abduction.solver.sources.exact.prefixes import Prefixes
from ssh_abduction.solver.sources.exact.readable import StepEngine
from ssh_abduction.solver.values import Status
from ssh_abduction.theory.fields import Count
from ssh_abduction.theory.theory import Theory


class NearMinimal:
    """Lists the maps that cost more than the minimum, with an engine for the whole trace."""

    def __init__(
        self, task: Task, judging: Judging, most: int, report: Callable[[], None], before: Asker
    ) -> None:
        """Prepare an engine for `most` maps (0: all). Its clocks go on from those of `before`."""
        self._task = replace(task, speedups=replace(task.speedups, prefixes=False))
        self._judging, self._most, self._report = judging, most, report
        self.engine = step_engine(self._task)
        self.engine.asker.ground_seconds = before.ground_seconds
        self.engine.asker.solve_seconds = before.solve_seconds

    def maps(
        self, minimal: tuple[int, ...], within: int
    ) -> Iterator[tuple[SSHMap, tuple[int, ...]]]:
        """Yield the maps with their preferred counts, the most important one first.

        `minimal` has the preferred counts of minimal maps. The first count that is not excuses may
        be larger by up to `within`.
        """
        count = counted_first(self._task.theory)
        assert count is not None
        least = minimal[self._task.theory.priorities.index(count)]
        self.engine.grow(len(self._task.trace))
        # No count exceeds the number of steps.
        for number in range(least + 1, min(least + within, len(self._task.trace)) + 1):
            self.engine.ask_for(number, count)
            known = Known(self._task.theory)
            found = Prefixes(
                self._task, known, self._judging, self.engine, self._most, self._report
            )
            found.find_minimum()
            if known.status is Status.OPTIMAL:
                yield from ((ssh_map, known.cost) for ssh_map in found.minimal_maps())
            assert isinstance(found.engine, StepEngine)
            self.engine = found.engine


def counted_first(theory: Theory) -> Count | None:
    """Return the first count that a theory minimises, apart from excuses; None if there is none."""
    return next((name for name in theory.priorities if name != "excuses"), None)
