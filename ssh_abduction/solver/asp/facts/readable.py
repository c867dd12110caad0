"""Write a theory and the steps of a trace as facts for the readable encodings (`encodings/*.lp`).

Facts and rules are text in the language of clingo.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Iterator
from itertools import product

from clingo import Function, Symbol

from ssh_abduction.data.drives import starts_of
from ssh_abduction.data.floors import stretches_of
from ssh_abduction.data.trace import Action, Trace
from ssh_abduction.solver.asp.facts.atoms import constant, number_symbols
from ssh_abduction.solver.steps import frames
from ssh_abduction.theory import encodings
from ssh_abduction.theory.fields import EXCUSED
from ssh_abduction.theory.settle import Problem
from ssh_abduction.theory.speedups import TRAVELS_AND_TURNS
from ssh_abduction.theory.theory import Theory


def encoding_names(theory: Theory) -> tuple[str, ...]:
    """Return the names of the encodings that a theory needs, in the order to load them."""
    return (*encodings.needed_by(vars(theory)), "preference", "show")


def theory_facts(theory: Theory, paths: int) -> str:
    """Return the facts for a theory: axioms, preference, and this many names for paths."""
    facts = [f"axiom({name})." for name in theory.axioms]
    facts += [f"path(1..{paths})."] if theory.level == "topological" else []
    facts += preferred(theory)
    facts += ["defeasible."] if theory.boundary == "defeasible" else []
    facts += [f"allowed({kind})." for kind in EXCUSED if getattr(theory, kind)]
    return "\n".join(facts)


def preferred(theory: Theory) -> list[str]:
    """Return the clingo facts that say which counts to minimise.

    The first count of `prefer` gets the highest priority.
    """
    return [
        f"prefer({count},{len(theory.priorities) - i})."
        for i, count in enumerate(theory.priorities)
    ]


def own_rules(theory: Theory) -> str:
    """Return the text of all rules that the user added to the theory, in clingo's language."""
    return "\n".join(rules.text for rules in theory.rules)


def run_by_steps() -> Symbol:
    """Return the external atom that allows answers. Set it when the parts of steps are ground."""
    return Function("run_by_steps")


def most_paths(trace: Trace, theory: Theory, steps: int) -> int:
    """Return the greatest number of paths that a map of the first steps can have.

    A path can begin only at the first step of a drive, and where a turn right or left, a lift, or
    an action that slipped ends. If the theory lacks some axioms, there may be a path for each step.
    """
    if TRAVELS_AND_TURNS & theory.given_up:
        return steps
    return 1 + sum(
        action.turn in ("right", "left") or action.leaves_paths
        for action in trace.actions[: steps - 1]
    )


def trace_facts(problem: Problem, start: int, stop: int, evidence: bool = True) -> str:
    """Return the facts for steps `start` to `stop - 1`, and for the actions that lead to them.

    Facts about pairs of steps are many. Without `evidence`, they are left out.
    """
    trace, theory = problem.trace, problem.theory
    facts = []
    for t in range(start, stop):
        step = trace.steps[t]
        facts.append(f"unknown({t})." if step.view is None else f"view({t},{constant(step.view)}).")
        if theory.star in ("pattern", "frame"):
            facts += [
                f"open({t},{slot})." for slot, is_open in enumerate(step.openings or ()) if is_open
            ]
    led = {t: trace.actions[t] for t in range(max(start - 1, 0), stop - 1)}
    facts += [f"starts({t + 1})." for t, action in led.items() if action.starts]
    done = {t: action for t, action in led.items() if not action.starts}
    facts += [f"act({t},{constant(action.name)})." for t, action in done.items()]
    facts += [f"unlinked({t})." for t, action in done.items() if action.slipped]
    facts += _fault_facts(problem, start, stop, done)
    if theory.lifts or theory.several_drives:
        stretches = stretches_of(trace)
        facts += [f"stretch({t},{stretches[t]})." for t in range(start, stop)]
        facts += [f"lifted({t + 1})." for t, action in done.items() if action.changes_floor]
    if theory.level == "topological":
        facts += [
            _kind_fact(action) for action in dict.fromkeys(done.values()) if action.kind is not None
        ]
    if theory.star == "gateways":
        facts += _gateway_facts(trace, start, stop, changes=bool(theory.changed))
    if evidence:
        facts += _evidence_facts(problem, start, stop)
    return "\n".join(facts)


def _fault_facts(problem: Problem, start: int, stop: int, done: Iterable[int]) -> Iterator[str]:
    """Yield the prices of the faults that the theory allows. `done` has the steps with actions."""
    trace, theory = problem.trace, problem.theory
    at: dict[str, Iterable[int]] = {
        "misread": range(start, stop),
        "jumped": [
            t for t in range(max(start, 1), stop) if trace.steps[t].displacement is not None
        ],
        "changed": range(start, stop),
        "slipped": done,
    }
    for kind, steps in at.items():
        for t in steps if getattr(theory, kind) else ():
            yield f"price({kind},{t},{theory.fault_tenths(kind, trace.steps[t])})."
    if theory.jumped:
        yield from (f"moved({t})." for t in at["jumped"])
    if theory.changed:
        starts = starts_of(trace)
        yield from (f"drive({t},{bisect_right(starts, t)})." for t in range(start, stop))


def _gateway_facts(trace: Trace, start: int, stop: int, *, changes: bool) -> Iterator[str]:
    """Yield facts for gateways.lp: the stars of steps, and how they fit those of earlier steps."""
    found = frames.Frames(trace, stop, changes=changes)
    known = len(frames.Frames(trace, start, changes=changes).frames)
    yield from (f"star({t},{found.stars[t]})." for t in range(start, stop))
    yield from (
        f"looks({star},{x})."
        for star in dict.fromkeys(found.stars[start:])
        for x in found.looks[star]
    )
    for x, frame in enumerate(found.frames[known:], known):
        yield f"slots({x},{max(frame.slots, 1)})."
        yield from (f"closed({x},{k})." for k in range(frame.slots) if frame.is_closed(k))
        yield from (f"ends({x},{way})." for way in frames.ends(frame))
    # Pairs of two known frames were given with earlier steps.
    for x, y in product(range(len(found.frames)), repeat=2):
        for shift in found.fits(x, y) if max(x, y) >= known else ():
            yield f"fits({x},{y},{shift})."
            yield from (
                f"may({x},{y},{shift},{way})."
                for way in frames.may_face(found.frames[x], found.frames[y], shift)
            )
            yield from (
                f"must({x},{y},{shift},{way})."
                for way in frames.must_face(found.frames[x], found.frames[y], shift)
            )
    turns = {
        (trace.actions[t - 1], found.stars[t - 1], found.stars[t]): None
        for t in range(max(start, 1), stop)
    }
    for action, a, b in turns:
        for x, y in product(found.looks[a], found.looks[b]) if action.turn else ():
            fitting = (
                c
                for c in found.fits(x, y)
                if frames.may_turn(action, found.frames[x], found.frames[y], c)
            )
            yield from (f"rotates({constant(action.name)},{x},{y},{shift})." for shift in fitting)


def _evidence_facts(problem: Problem, start: int, stop: int) -> Iterator[str]:
    """Yield facts for the evidence about steps, and about their pairs with earlier steps."""
    trace, theory = problem.trace, problem.theory
    for evidence in problem.evidence:
        pairs = evidence.pairs(trace)
        for t in range(start, stop) if pairs else ():
            yield from (f"excluded({evidence.axiom},{i},{t})." for i in pairs.apart.get(t, ()))
            if theory.level == "topological":
                yield from (
                    f"elsewhere({evidence.axiom},{i},{t})." for i in pairs.elsewhere.get(t, ())
                )
            yield from (f"one({i},{t})." for i in pairs.one.get(t, ()))
        yield evidence.facts(trace, start, stop)


def program(problem: Problem) -> str:
    """Return a file that `encodings/run.py` solves: the facts of a trace and its theory."""
    trace, theory = problem.trace, problem.theory
    files = " ".join(f"{name}.lp" for name in encoding_names(theory))
    return "\n".join(
        [
            f"% {len(trace)} steps{f' of {trace.name!r}' if trace.name else ''}. "
            f"In {encodings.folder()}, run",
            f"%   python run.py --project=project --opt-mode=optN -n 0 THIS_FILE {files}",
            theory_facts(theory, most_paths(trace, theory, len(trace))),
            trace_facts(problem, 0, len(trace)),
            own_rules(theory),
            "",
        ]
    )


def query(t: int) -> Symbol:
    """Return the external atom that says that step t is the last step."""
    return Function("query", number_symbols(t))


def _kind_fact(action: Action) -> str:
    """Return the fact that says that an action is a lift, a travel or a turn."""
    name = constant(action.name)
    if action.changes_floor:
        return f"kind({name},lift)."
    return f"kind({name},travel)." if action.kind == "travel" else f"turns({name},{action.turn})."
