"""Why a trace has no map: the shortest stretch of it that has none, and a smallest set of axioms and steps that clash there.

>>> from ssh_abduction import Theory, Trace
>>> from ssh_abduction.explain import explain
>>> trace = Trace.from_steps(views=["a", "b", "c", "d"], actions=["travel", "around", "around"])
>>> explanation = explain(trace, Theory.topological())
>>> explanation.first, explanation.last, explanation.axioms[0]
(0, 3, 'functional_view')
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import clingo

from ssh_abduction.asp import facts
from ssh_abduction.asp.rules import check_rules
from ssh_abduction.theory import encodings
from ssh_abduction.theory.theory import Theory, checked_theory
from ssh_abduction.trace import Trace, checked_trace

# Seconds between two questions whether to stop, while clingo is busy: as in asp/limits.py.
POLL = 0.05
# Steps that are grounded between two such questions: eight take a moment, and more calls would take longer.
AT_A_TIME = 8


@dataclass(frozen=True, slots=True)
class Clash:
    """An axiom that, together with the other clashes, cannot hold at all of these steps. Of the steps that an axiom is about at once, the last one is named."""

    axiom: str
    steps: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Explanation:
    """Steps `first` to `last` alone have no map. If any one clash is dropped, even at one of its steps only, they have one."""

    first: int
    last: int
    clashes: tuple[Clash, ...]

    @property
    def axioms(self) -> tuple[str, ...]:
        """The names of the axioms that clash."""
        return tuple(clash.axiom for clash in self.clashes)

    def __str__(self) -> str:
        parts = [f"{c.axiom} ({'step' if len(c.steps) == 1 else 'steps'} {', '.join(map(str, c.steps))})" for c in self.clashes]
        return f"no map satisfies the axioms: in steps {self.first} to {self.last} these clash: {', '.join(parts)}"

    def to_dict(self) -> dict[str, object]:
        return {"first": self.first, "last": self.last, "clashes": [{"axiom": c.axiom, "steps": list(c.steps)} for c in self.clashes]}


class Interrupted(Exception):  # noqa: N818 - not an error
    """The caller's `stop` returned True."""


def explain(trace: Trace, theory: Theory | None = None, stop: Callable[[], bool] = lambda: False) -> Explanation | None:
    """Why the trace has no map under a theory (default Theory.topological()), or None if it has one.

    The stretch is found by dropping steps from the end and then from the start, the clashes by dropping axioms one by one.

    stop  asked now and then; when it returns True, Interrupted is raised
    """
    theory = checked_theory(theory).resolve(checked_trace(trace))
    theory.check_steps(trace)
    check_rules(theory)
    whole = len(trace)
    length = _shortest(whole, lambda n: not _Axioms(trace, theory, stop, 0, n).consistent())
    if length is None:
        return None
    last = length - 1
    length = _shortest(length, lambda n: not _Axioms(trace, theory, stop, last + 1 - n, n).consistent()) or length
    first = last + 1 - length
    clashes: dict[str, list[int]] = {}
    for axiom, step in _Axioms(trace, theory, stop, first, length, relaxed=True).smallest_clash():
        clashes.setdefault(axiom, []).append(first + step)
    order = theory.axioms
    found = tuple(Clash(name, tuple(sorted(clashes[name]))) for name in sorted(clashes, key=order.index))
    return Explanation(first, last, found)


def _stretch(trace: Trace, first: int, length: int) -> Trace:
    """So many steps of a trace, as if they were all of it."""
    head = trace.prefix(first + length)
    return replace(head, steps=head.steps[first:])


def _shortest(longest: int, has_no_map: Callable[[int], bool]) -> int | None:
    """The least length that has no map; None if even the longest has one. It is found by bisection, as more steps never bring a map back."""
    short, long = 0, 1
    while not has_no_map(long):
        if long == longest:
            return None
        short, long = long, min(2 * long, longest)
    while long - short > 1:
        middle = (short + long) // 2
        short, long = (short, middle) if has_no_map(middle) else (middle, long)
    return long


class _Axioms:
    """The axioms of some steps of a trace, in clingo, as if these steps were all of it. Where `relaxed`, each axiom can be switched on or off at each step."""

    def __init__(self, trace: Trace, theory: Theory, stop: Callable[[], bool], first: int, length: int, *, relaxed: bool = False) -> None:
        trace, theory = _stretch(trace, first, length), theory.of_steps(first, length)
        self._stop = stop
        self._control = clingo.Control(["--warn=none"])
        names = [name for name in facts.encoding_names(theory) if name not in ("preference", "show")]
        for name in [*names, "explain"] if relaxed else names:
            self._control.load(encodings.path(name))
        last = len(trace) - 1
        self._control.add(
            "base",
            [],
            facts.theory_facts(theory, len(trace) if relaxed else facts.most_paths(trace, theory, len(trace)))
            + facts.trace_facts(trace, theory, 0, len(trace)),
        )
        self._control.add("base", [], facts.own_rules(theory))
        parts = [("base", list[clingo.Symbol]()), *(("step", facts.numbers(t)) for t in range(len(trace))), ("check", facts.numbers(last))]
        for start in range(0, len(parts), AT_A_TIME):
            if stop():
                raise Interrupted
            self._control.ground(parts[start : start + AT_A_TIME])
        self._control.assign_external(facts.query(last), True)
        self._control.assign_external(facts.run_by_steps(), True)
        self._pairs = {facts.active(axiom, t): (axiom, t) for axiom in theory.axioms for t in range(len(trace))} if relaxed else {}

    def consistent(self, active: Sequence[clingo.Symbol] = ()) -> bool:
        """Whether there is a map. Where the axioms are relaxed, only the active ones have to hold."""
        with self._control.solve(assumptions=[(symbol, True) for symbol in active], async_=True) as handle:
            while not handle.wait(POLL):
                if self._stop():
                    handle.cancel()
                    raise Interrupted
            return bool(handle.get().satisfiable)

    def smallest_clash(self) -> list[tuple[str, int]]:
        """Pairs of axiom and step that leave no map, while any proper subset of them leaves one.

        There are many such sets. To get one that is short to read, whole axioms are dropped before single steps, once in the order of the axioms and once
        in reverse, and the smaller result is returned.
        """
        found = [self._shrunk(list(order)) for order in (self._pairs, reversed(self._pairs))]
        shortest = min(found, key=lambda pairs: (len({self._pairs[p][0] for p in pairs}), len(pairs)))
        return [self._pairs[symbol] for symbol in shortest]

    def _shrunk(self, kept: list[clingo.Symbol]) -> list[clingo.Symbol]:
        """Pairs that still leave no map after all that can be dropped were dropped, in their order."""
        for axiom in dict.fromkeys(self._pairs[symbol][0] for symbol in kept):
            fewer = [symbol for symbol in kept if self._pairs[symbol][0] != axiom]
            if not self.consistent(fewer):
                kept = fewer
        for symbol in tuple(kept):
            fewer = [other for other in kept if other != symbol]
            if not self.consistent(fewer):
                kept = fewer
        return kept
