"""The engine that grounds the readable encodings step by step.

This engine works for every theory, and finds all minimal maps of the prefix. The other engines are
faster, but each of them is for certain theories only.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import Any

import clingo

from ssh_abduction.solution.values import Found
from ssh_abduction.solver.asp import facts
from ssh_abduction.solver.asp.control import Asker
from ssh_abduction.solver.asp.facts import number_symbols
from ssh_abduction.solver.sources.exact.engine import Task, in_fixed_order
from ssh_abduction.theory import encodings
from ssh_abduction.theory.evidence import Equality
from ssh_abduction.theory.fields import Count

# A prefix grows by at least this factor, so that few prefixes are tried.
GROWTH = 1.25
# Ground AT_FIRST steps per call until the prefix has FIRST_STEPS, and then one step per call. For a
# short prefix, the overhead of a call is larger than the time for a step.
AT_FIRST, FIRST_STEPS = 8, 32
# Later steps take longer, and clingo cannot be stopped during a call. So a call is for one step if
# the time left is less than SLOWER times the time for AT_FIRST steps like the last ones.
SLOWER = 4
# The first call is for one step, too, if there are more names for paths than this.
FEW_PATHS = 8


class StepEngine:
    """The engine that grounds the readable encodings. A dstate is named by its first step."""

    grows = True

    def __init__(self, task: Task, paths: int) -> None:
        self.asker = Asker(task.watch)
        self.bound: int | None = None
        self.size = 0
        self.paths = paths
        self._task = task
        self._asked: int | None = None  # the step that clingo takes as the last one
        self._forbidden: list[Collection[Equality]] = []
        # The exact number of dstates, places or paths that maps must have, if one is set.
        self._number: tuple[int, Count] | None = None
        # The seconds and MiB for each step that the last call grounded. The next step takes about
        # as much, and clingo cannot be stopped meanwhile.
        self._last_step = 0.0, 0.0
        control = self.asker.control
        for name in facts.encoding_names(task.theory):
            control.load(encodings.path(name))
        control.add("base", [], facts.theory_facts(task.theory, paths))
        control.add("base", [], facts.own_rules(task.theory))

    def with_paths(self, paths: int) -> StepEngine:
        """Make a new engine with this many names for paths. Its prefix is empty."""
        engine = StepEngine(self._task, paths)
        engine.asker.ground_seconds = self.asker.ground_seconds
        engine.asker.solve_seconds = self.asker.solve_seconds
        engine._forbidden, engine._number = list(self._forbidden), self._number
        return engine

    def over(self, task: Task) -> StepEngine:
        self._task, self.asker.watch = task, task.watch
        self.asker.ground_seconds = self.asker.solve_seconds = 0.0
        return self

    def next_size(self, failed: int) -> int:
        return min(len(self._task.trace), max(failed + 1, int(self.size * GROWTH)))

    def grow(self, size: int) -> None:
        is_new = not self.size
        with self.asker.grounding_timed():
            while self.size < size:
                seconds = SLOWER * AT_FIRST * self._last_step[0]
                is_short = self.size < FIRST_STEPS if self.size else self.paths <= FEW_PATHS
                many = is_short and self.asker.watch.allows(seconds)
                self._ground_steps(min(size, self.size + (AT_FIRST if many else 1)))
            self._let_end_with(size - 1)
            if is_new:
                for equalities in self._forbidden:
                    self.asker.control.tell(facts.forbidden_equalities(equalities))
                self._tell_number()

    def _ground_steps(self, stop: int) -> None:
        """Ground the steps up to, but not including, `stop`."""
        control, start = self.asker.control, self.size
        steps = stop - start
        self.asker.watch.check(*(steps * each for each in self._last_step))
        part = f"steps_from_{start}"
        control.add(part, [], facts.trace_facts(self._task.problem, start, stop))
        before = control.seconds, control.mebibytes
        base: list[tuple[str, list[clingo.Symbol]]] = [] if start else [("base", [])]
        control.ground(
            [*base, (part, []), *(("step", number_symbols(t)) for t in range(start, stop))]
        )
        if base:
            control.assign_external(facts.run_by_steps(), True)
        spent = control.seconds - before[0], control.mebibytes - before[1]
        self._last_step = spent[0] / steps, spent[1] / steps
        self.size = stop

    def _let_end_with(self, last: int) -> None:
        """Make `last` the last step of the prefix for clingo."""
        if self._asked == last:
            return
        control = self.asker.control
        control.ground([("check", number_symbols(last))])
        if self._asked is not None:
            control.release_external(facts.query(self._asked))
        control.assign_external(facts.query(last), True)
        self._asked = last

    def improving_maps(self, most: tuple[int, ...] = ()) -> Iterator[Found]:
        if most:
            configuration: Any = self.asker.control.configuration
            # A good map is known already, so clingo only has to raise the bound.
            configuration.solver.opt_strategy = "usc"
        if self._task.theory.priorities:
            return self.asker.answers(self._read, ",".join(["opt", *map(str, most)]), 0)
        return self.asker.answers(self._read, "ignore", 1)

    def maps_of_cost(self, cost: tuple[int, ...], enough: int) -> Iterator[Found]:
        bound = ",".join(map(str, cost))
        return self.asker.answers(self._read, f"enum,{bound}" if bound else "ignore", 0)

    def forbid(self, equalities: Collection[Equality]) -> bool:
        equalities = in_fixed_order(equalities)
        self._forbidden.append(equalities)
        self.asker.control.tell(facts.forbidden_equalities(equalities))
        return True

    def ask_for(self, number: int, count: Count) -> None:
        """From now on, ask only for maps with this `number` of `count`. Add no more steps."""
        if self._number is not None:
            self.asker.control.release_external(facts.of_number(*self._number))
        self._number = number, count
        self._tell_number()

    def _tell_number(self) -> None:
        """Give clingo the rule that fixes a count to the number asked for, if there is one."""
        if self._number is None:
            return
        self.asker.control.tell(facts.exactly(*self._number))
        self.asker.control.assign_external(facts.of_number(*self._number), True)

    def _read(self, model: clingo.Model) -> Found:
        return Found(facts.read_map(model, self._task.trace, self._task.theory), tuple(model.cost))


def paths_needed(task: Task, size: int, cost: tuple[int, ...] | None) -> int:
    """Return how many names for paths are enough to prove a cost, and to list all maps with it."""
    theory = task.theory
    segments = facts.most_paths(task.trace, theory, size)
    first = theory.priorities[0] if theory.priorities else None
    if theory.level == "causal":
        return 0
    if cost is None or not task.speedups.path_names or first not in ("paths", "dstates"):
        return segments
    if first == "paths":
        return cost[0]
    return min(segments, cost[0] // (1 if "course_needs_travel" in theory.given_up else 2))
