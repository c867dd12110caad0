"""Check that clingo can ground a user's own rules, and whether a map obeys them.

The checker does not know such rules. So clingo checks a map: it grounds the rules with the content
of the map as facts. If the rules read only what a map shows, clingo has no choices except those in
the rules themselves. So the check takes hardly longer than grounding.

>>> from ssh_abduction import Theory, Trace, solve
>>> from ssh_abduction.solver.asp.kept_rules import keeps_own_rules
>>> from ssh_abduction.theory.settle import settle
>>> from ssh_abduction.theory.encodings import Rules
>>> trace = Trace.from_steps("aba", ["go", "go"])
>>> ssh_map = solve(trace, Theory.causal())[0]
>>> rules = [Rules("own.lp", f"#program step(t). :- same(I,t), t-I > {n}.") for n in (1, 2)]
>>> theories = [Theory.causal().replace(rules=rule) for rule in rules]
>>> [keeps_own_rules(settle(trace, theory), ssh_map) for theory in theories]
[False, True]
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from functools import lru_cache
from itertools import combinations

from clingo import Function, ast

from ssh_abduction.data.errors import TheoryError
from ssh_abduction.data.groups import first_index_of, indices_of
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.runtime.clock import POLL, look_at_clock
from ssh_abduction.solver.asp import facts
from ssh_abduction.solver.asp.control import Control
from ssh_abduction.solver.asp.facts import number_symbols
from ssh_abduction.theory.encodings import Rules
from ssh_abduction.theory.own_rules import READABLE, check_statements, clingo_said, statements
from ssh_abduction.theory.settle import Problem
from ssh_abduction.theory.theory import Theory

# The predicates that rules may read if a map is to be checked: those of a map, and those of a trace
# and its theory.
SHOWN = {"is", "same", "at", "same_place", "along", "same_course", "on_some_path", "on", "before"}
SHOWN |= {"travel", "turn"}
OF_TRACE = {"view", "act", "kind", "turns", "open", "axiom", "path", "prefer", "query"}
FORBIDDEN = """
#program step(t).
:- violation(N,t), axiom(N).
#program check(t).
:- violation(N,t), axiom(N).
"""


def check_rules(theory: Theory) -> None:
    """Check the user's own rules in a settled theory. Raises TheoryError if one is not allowed."""
    check_statements(theory)
    for rules in theory.rules:
        _check_safety(rules)
    if len(theory.rules) > 1:
        _check_safety(*theory.rules)  # together, as only one file may define a constant


@lru_cache(maxsize=64)
def _check_safety(*files: Rules) -> None:
    """Let clingo find unsafe variables, without grounding. Raises TheoryError if there are some."""
    messages: list[str] = []
    control = Control(logger=lambda _, message: messages.append(message))
    try:
        for rules in files:
            control.add("base", [], rules.text)
        control.ground([])
    except RuntimeError:
        errors = [message for message in messages if "error" in message]
        raise TheoryError(clingo_said(files[-1], errors or messages)) from None


def can_be_asked(theory: Theory) -> bool:
    """Whether `keeps_own_rules` can check the rules of a theory in which no field is "auto".

    It can if the rules read only what a map and a trace show. Maps with partial orders of paths do
    not show all that rules may read.
    """
    every = [statement for rules in theory.rules for statement in statements(rules)]
    known = SHOWN.union(OF_TRACE, *(statement.heads for statement in every))
    return not every or (
        (theory.level == "causal" or theory.path_order == "total")
        and all(atom.name in known for statement in every for atom, _ in statement.read)
    )


def keeps_own_rules(problem: Problem, ssh_map: SSHMap) -> bool:
    """Whether a map of all steps, which satisfies all other axioms, obeys the user's own rules.

    Call this only if `can_be_asked` is True.
    """
    trace, theory = problem.trace, problem.theory
    if not theory.rules:
        return True
    control = Control(check=look_at_clock)
    steps = range(len(trace))
    control.add("base", [], facts.theory_facts(theory, len(ssh_map.theory_paths)))
    control.add("base", [], facts.trace_facts(problem, 0, len(trace), evidence=False))
    control.add("base", [], "\n".join(f"{fact}." for fact in _shown(trace, ssh_map)))
    control.add("base", [], f"query({len(trace) - 1}).\n{FORBIDDEN}")
    control.add("base", [], facts.own_rules(theory))
    control.ground([("base", [])])
    for t in steps:
        look_at_clock()
        control.ground([("step", number_symbols(t))])
    control.ground([("check", number_symbols(len(trace) - 1))])
    with control.searching() as handle:
        while not handle.wait(POLL):
            look_at_clock()
        return bool(handle.get().satisfiable)


def never_true(problem: Problem) -> Iterator[str]:
    """Yield a warning for each atom in a user's rules that no fact of the trace matches.

    A rule with such an atom has no effect. Facts of a trace are known before the search, so clingo
    only has to ground a rule with this atom alone. The parameter of a part stands for any step.
    """
    trace, theory = problem.trace, problem.theory
    if not theory.rules:
        return
    control = Control(check=look_at_clock, logger=lambda *_: None)
    control.add("base", [], facts.trace_facts(problem, 0, len(trace)))
    control.ground([("base", [])])
    for rules in theory.rules:
        for statement in statements(rules):
            for atom in (atom for atom, positive in statement.read if positive):
                if atom.name not in OF_TRACE - READABLE - {"query"}:
                    continue
                some_step = rf"\b{statement.parameter}\b" if statement.parameter else "(?!)"
                alone, line = re.sub(some_step, "Step__", str(atom)), atom.location.begin.line
                name = f"holds_{len(rules.name)}_{line}_{atom.location.begin.column}"
                with suppress(RuntimeError):  # clingo cannot bind a step that is computed
                    control.add(name, [], f"{name} :- {alone}.")
                    control.ground([(name, [])])
                    if control.symbolic_atoms[Function(name)] is None:
                        hint = _as_text(atom, trace)
                        yield f"{rules.name}:{line}: {atom} holds at no step of this trace{hint}"


def _as_text(atom: ast.AST, trace: Trace) -> str:
    """Make a hint if a constant in an atom is a view or an action of the trace without quotes."""
    given = {str(part) for part in atom.arguments}
    names = {*map(str, trace.views), *(action.name for action in trace.actions)}
    some = next((f'; write "{name}" in quotes' for name in sorted(given & names)), "")
    return f", so its rule has no effect{some}"


def _shown(trace: Trace, ssh_map: SSHMap) -> Iterator[str]:
    """Yield the atoms that describe a map. The first step at a dstate or place is its name."""
    at = [ssh_map.dstates[label] for label in ssh_map.dstate_at]
    places = [s.place for s in at]
    courses = [None if s.path is None else (s.path, s.direction) for s in at]
    first, place = first_index_of(ssh_map.dstate_at), first_index_of(places)
    # For each path, its number, and the direction that the first step along it faces.
    path: dict[int, tuple[int, int]] = {}
    for t, s in enumerate(at):
        yield f"is({t},{first[s.id]})"
        if s.place is not None:
            yield f"at({t},{place[s.place]})"
        if s.path is not None and s.direction is not None:
            number, faced = path.setdefault(s.path, (len(path) + 1, s.direction))
            yield f"along({t},{number},{'pos' if s.direction == faced else 'neg'})"
            yield f"on_some_path({t})"
    of_steps: Iterable[tuple[str, Sequence[object]]] = (
        ("same", ssh_map.dstate_at),
        ("same_place", places),
        ("same_course", courses),
    )
    for name, things in of_steps:
        for thing, steps in indices_of(things).items():
            pairs = combinations(steps, 2) if thing is not None else ()
            yield from (f"{name}({i},{t})" for i, t in pairs)
    for h in ssh_map.theory_paths:
        number, faced = path[h.id]
        order = [place[p] for p in h.order[::faced]]
        yield from (f"on({number},{p})" for p in order)
        yield from (f"before({number},{p},{q})" for p, q in combinations(order, 2))
    slipped = {fault.step for fault in ssh_map.faults if fault.kind == "slipped"}
    for t, action in enumerate(trace.actions):
        if action.slipped or t in slipped:
            continue
        if action.kind == "travel":
            yield f"travel({t})"
        elif action.turn is not None:
            yield f"turn({t},{action.turn})"
