"""Maps that cost more than the least: for each number of dstates up to so many more, the best of the maps that have just so many.

The proof in `solver/prefixes.py`, that a prefix may stand for the trace, speaks of minimal maps
alone: cut down to a prefix, a map with one dstate more than the least may well be minimal. So these
maps are asked of the readable encodings for the whole trace, where one rule says how many dstates
there are.

Where the theory prefers few paths or places first, it is these that are counted. Excuses are not,
as they are witnesses: what some excuses make consistent, more of them do, too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.solver import prefixes
from ssh_abduction.solver.asp.control import Asker
from ssh_abduction.solver.asp.facts import readable
from ssh_abduction.solver.engines.base import Task
from ssh_abduction.solver.engines.stepwise import StepEngine
from ssh_abduction.solver.judging import Judging
from ssh_abduction.solver.known import Known
from ssh_abduction.solver.prefixes import Prefixes
from ssh_abduction.solver.values import Status
from ssh_abduction.theory.fields import Count
from ssh_abduction.theory.theory import Theory


class NearMinimal:
    """Lists the maps of a trace that cost more than the least.

    engine  holds the axioms for the whole trace
    """

    def __init__(
        self, task: Task, judging: Judging, most: int, report: Callable[[], None], before: Asker
    ) -> None:
        """Nothing is asked yet.

        task    of the search for the minimal maps
        most    maps that are asked for; 0 for all
        report  is called now and then
        before  what the minimal maps were asked of: the seconds that it took count on
        """
        self._task = replace(task, speedups=replace(task.speedups, prefixes=False))
        self._judging, self._most, self._report = judging, most, report
        names = readable.most_paths(task.trace, task.theory, len(task.trace))
        self.engine = StepEngine(
            self._task, min(prefixes.FIRST_PATHS, names) if task.speedups.path_names else names
        )
        self.engine.asker.ground_seconds, self.engine.asker.solve_seconds = (
            before.ground_seconds,
            before.solve_seconds,
        )

    def maps(
        self, minimal: tuple[int, ...], within: int
    ) -> Iterator[tuple[SSHMap, tuple[int, ...]]]:
        """The maps, and what they cost: the preferred counts, first to last.

        minimal  what minimal maps cost
        within   how many dstates they have more than these, at most
        """
        count = counted_first(self._task.theory)
        assert count is not None
        least = minimal[self._task.theory.priorities.index(count)]
        self.engine.grow(len(self._task.trace))
        # There are no more of anything than there are steps.
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
    """Of what near-minimal maps may have more: what the theory prefers first, excuses aside; None where it prefers nothing else."""
    return next((name for name in theory.priorities if name != "excuses"), None)
