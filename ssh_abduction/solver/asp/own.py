"""Check whether a map satisfies a user's own rules.

The checker does not know such rules. So clingo checks them: it grounds them with the content of the
map as facts. If the rules read only what a map shows, clingo has no choices except those in the
rules themselves. So the check takes hardly longer than grounding.

>>> from ssh_abduction import Theory, Trace, solve
>>> from ssh_abduction.solver.asp.own import keeps_own_rules
>>> from ssh_abduction.theory.settle import settle
>>> from ssh_abduction.theory.rules import Rules
>>> trace = Trace.from_steps("aba", ["go", "go"])
>>> ssh_map = solve(trace, Theory.causal())[0]
>>> rules = [Rules("own.lp", f"#program step(t). :- same(I,t), t-I > {n}.") for n in (1, 2)]
>>> theories = [Theory.causal().replace(rules=rule) for rule in rules]
>>> [keeps_own_rules(settle(trace, theory), ssh_map) for theory in theories]
[False, True]
"""

from __future__ import annotations

from collections.abc import Iterator

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.runtime.clock import look_at_clock
from ssh_abduction.solver.asp.control import Control
from ssh_abduction.solver.asp.facts import readable
from ssh_abduction.solver.asp.facts.atoms import number_symbols
from ssh_abduction.solver.asp.limits import POLL
from ssh_abduction.solver.asp.rule_checks import read_by
from ssh_abduction.theory.settle import Problem
from ssh_abduction.theory.theory import Theory

# The predicates that rules may read. SHOWN are those of a map, OF_TRACE those of a trace and its
# theory.
SHOWN = {"is", "same", "at", "same_place", "along", "same_course", "on_some_path", "on", "before"}
SHOWN |= {"travel", "turn"}
OF_TRACE = frozenset({"view", "act", "kind", "turns", "open", "axiom", "path", "prefer", "query"})
FRAME = """
#defined query/1. #defined violation/2. #defined is/2. #defined same/2. #defined at/2.
#defined same_place/2.
#defined along/3.
#defined same_course/2. #defined on_some_path/1. #defined on/2. #defined before/3.
#defined travel/1.
#defined turn/2. #defined kind/2. #defined turns/2. #defined open/2.
#defined act/2. #defined prefer/2. #defined path/1.
#program step(t).
:- violation(N,t), axiom(N).
#program check(t).
:- violation(N,t), axiom(N).
"""


def can_be_asked(theory: Theory) -> bool:
    """Whether `keeps_own_rules` can check the rules of a theory in which no field is "auto".

    It can if the rules read only what a map and a trace show. Maps with partial orders of paths do
    not show all that rules may read.
    """
    if not theory.rules:
        return True
    settled = theory.level == "causal" or theory.path_order == "total"
    return settled and all(
        read_by(rules, theory.rules) <= SHOWN | OF_TRACE for rules in theory.rules
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
    control.add("base", [], readable.theory_facts(theory, len(ssh_map.paths)))
    control.add("base", [], readable.trace_facts(problem, 0, len(trace), evidence=False))
    control.add("base", [], "\n".join(f"{fact}." for fact in _shown(trace, ssh_map)))
    control.add("base", [], f"query({len(trace) - 1}).\n{FRAME}")
    control.add("base", [], readable.own_rules(theory))
    control.ground([("base", [])])
    for t in steps:
        look_at_clock()
        control.ground([("step", number_symbols(t))])
    control.ground([("check", number_symbols(len(trace) - 1))])
    with control.searching() as handle:
        while not handle.wait(POLL):
            look_at_clock()
        return bool(handle.get().satisfiable)


def _shown(trace: Trace, ssh_map: SSHMap) -> Iterator[str]:
    """Yield the atoms that describe a map. The first step at a dstate or place is its name."""
    first: dict[int, int] = {}
    place: dict[int, int] = {}
    # For each path, its number, and the direction that the first step along it faces.
    path: dict[int, tuple[int, int]] = {}
    # The steps so far at each dstate, at each place, and along each course.
    before: dict[int, list[int]] = {}
    here: dict[int, list[int]] = {}
    along: dict[tuple[int, int], list[int]] = {}
    for t, label in enumerate(ssh_map.dstate_at):
        s = ssh_map.dstates[label]
        yield f"is({t},{first.setdefault(label, t)})"
        yield from (f"same({i},{t})" for i in before.setdefault(label, []))
        before[label].append(t)
        if s.place is not None:
            yield f"at({t},{place.setdefault(s.place, t)})"
            yield from (f"same_place({i},{t})" for i in here.setdefault(s.place, []))
            here[s.place].append(t)
        if s.path is not None and s.direction is not None:
            number, faced = path.setdefault(s.path, (len(path) + 1, s.direction))
            yield f"along({t},{number},{'pos' if s.direction == faced else 'neg'})"
            yield f"on_some_path({t})"
            yield from (
                f"same_course({i},{t})" for i in along.setdefault((s.path, s.direction), [])
            )
            along[s.path, s.direction].append(t)
    for h in ssh_map.paths:
        number, faced = path[h.id]
        order = [place[p] for p in h.order[::faced]]
        yield from (f"on({number},{p})" for p in order)
        yield from (
            f"before({number},{p},{q})" for i, p in enumerate(order) for q in order[i + 1 :]
        )
    slipped = {fault.step for fault in ssh_map.faults if fault.kind == "slipped"}
    for t, action in enumerate(trace.actions):
        if action.slipped or t in slipped:
            continue
        if action.kind == "travel":
            yield f"travel({t})"
        elif action.turn is not None:
            yield f"turn({t},{action.turn})"
