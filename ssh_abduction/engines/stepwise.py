"""The engine that grounds the readable encodings, step by step: every theory can be asked of it."""

from __future__ import annotations

import time
from collections.abc import Collection, Iterator
from typing import Any

import clingo

from ssh_abduction.asp import facts
from ssh_abduction.asp.limits import Watch
from ssh_abduction.engines.base import Engine, Found
from ssh_abduction.steps.log import Log
from ssh_abduction.theory import encodings
from ssh_abduction.theory.evidence import Equality
from ssh_abduction.theory.theory import Theory
from ssh_abduction.trace import Trace


class StepEngine(Engine):
    """The encodings of all levels: a dstate is named by the first step at it."""

    def __init__(self, trace: Trace, theory: Theory, watch: Watch, paths: int) -> None:
        super().__init__(trace, theory, watch, paths)
        self._asked: int | None = None  # the step that is the last one, as far as clingo knows
        self._forbidden: list[Collection[Equality]] = []
        # Seconds and MiB that it took to ground the last step: the next one takes about as much, and cannot be stopped.
        self._last_step = 0.0, 0.0
        for name in facts.encoding_names(theory):
            self._control.load(encodings.path(name))
        self._control.add("base", [], facts.theory_facts(theory, paths))
        self._control.add("base", [], facts.own_rules(theory))

    def with_paths(self, paths: int) -> StepEngine:
        engine = StepEngine(self._trace, self._theory, self._watch, paths)
        engine.ground_seconds, engine.solve_seconds = self.ground_seconds, self.solve_seconds
        engine._forbidden = list(self._forbidden)
        return engine

    def forbid(self, equalities: Collection[Equality]) -> None:
        self._forbidden.append(equalities)
        self._tell_forbidden(len(self._forbidden) - 1)

    def _tell_forbidden(self, number: int) -> None:
        part = f"forbidden_{number}"
        self._control.add(part, [], facts.forbidden_equalities(self._forbidden[number]))
        self._control.ground([(part, [])])

    def over(self, trace: Trace, watch: Watch, log: Log) -> StepEngine:
        self._trace, self._watch = trace, watch
        self.ground_seconds = self.solve_seconds = 0.0
        return self

    def grow(self, size: int) -> None:
        began = time.perf_counter()
        control = self._control
        base_is_new = not self.size
        try:
            base: list[tuple[str, list[clingo.Symbol]]] = [] if self.size else [("base", [])]
            while self.size < size:
                self._watch.check(*self._last_step)
                part = f"steps_from_{self.size}"
                stop = min(size, self.size + (8 if self.size < 32 else 1))
                control.add(part, [], facts.trace_facts(self._trace, self._theory, self.size, stop))
                before = control.seconds, control.mebibytes
                control.ground([*base, (part, []), *(("step", facts.numbers(t)) for t in range(self.size, stop))])
                if base:
                    control.assign_external(facts.run_by_steps(), True)
                self._last_step = control.seconds - before[0], control.mebibytes - before[1]
                self.size, base = stop, []
            if self._asked != size - 1:
                control.ground([("check", facts.numbers(size - 1))])
                if self._asked is not None:
                    control.release_external(facts.query(self._asked))
                control.assign_external(facts.query(size - 1), True)
                self._asked = size - 1
            if base_is_new:
                for number in range(len(self._forbidden)):
                    self._tell_forbidden(number)
        finally:
            self.ground_seconds += time.perf_counter() - began

    def improving_maps(self, most: tuple[int, ...] = ()) -> Iterator[Found]:
        if most:
            configuration: Any = self._control.configuration
            configuration.solver.opt_strategy = "usc"  # as a good map is known, what is missing is a bound
        return self._answers(self._read, *((",".join(["opt", *map(str, most)]), 0) if self._theory.priorities else ("ignore", 1)))

    def maps_of_cost(self, cost: tuple[int, ...], enough: int) -> Iterator[Found]:
        bound = ",".join(map(str, cost))
        return self._answers(self._read, f"enum,{bound}" if bound else "ignore", 0)

    def _read(self, model: clingo.Model) -> Found:
        return Found(facts.read_map(model, self._trace, self._theory), tuple(model.cost))
