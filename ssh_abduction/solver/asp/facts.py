"""Turn a trace into facts for clingo, and an answer set of clingo into a map.

This module knows the predicates of the readable encodings (`encodings/*.lp`). An engine with an
encoding of its own (`encodings/fast/*.lp`) writes the facts for it.

The fast encodings have a step as an argument of a fact. So one call grounds the rules for many
steps. The readable encodings have a program part for each step. Grounding them takes about thirty
times as long, but mostly they are grounded only for short prefixes of a trace.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache, lru_cache
from itertools import product

from clingo import Function, Model, Number, String, Symbol, SymbolType

from ssh_abduction.data.drives import starts_of, stretches_of
from ssh_abduction.data.groups import numbered
from ssh_abduction.data.maps import FAULTS, DState, MapPath, SSHMap
from ssh_abduction.data.trace import Action, Trace, View
from ssh_abduction.solver.steps import frames
from ssh_abduction.solver.steps.faults import faults_of, links_of, with_changes
from ssh_abduction.theory import encodings
from ssh_abduction.theory.evidence import Equality
from ssh_abduction.theory.fields import EXCUSED, Count
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
    facts += [f"field({name},{int(value)})." for name, value in theory.declared.items() if value]
    return "\n".join(facts)


def preferred(theory: Theory) -> list[str]:
    """Return the clingo facts that say which counts to minimise.

    The first count of `prefer` gets the highest priority.
    """
    return [
        f"prefer({count},{len(theory.priorities) - i})."
        for i, count in enumerate(theory.priorities)
    ]


def sides(theory: Theory) -> list[str]:
    """Return the facts that say which axioms about the sides of paths a theory has."""
    found = ["sided."] if theory.boundary != "none" else []
    return found + (["symmetric."] if theory.symmetric_sides else [])


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
    if not theory.has_paths:
        return 0
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


CAUSAL = Theory.causal()


def read_map(model: Model, trace: Trace, theory: Theory) -> SSHMap:
    """Make a map from an answer set of the readable encodings, perhaps of the first steps only."""
    # 1. Read the atoms. They name dstates and places by steps.
    found: dict[str, list[tuple[int, ...]]] = {}
    faults: list[tuple[int, str]] = []
    for name, args in map(read_atom, model.symbols(shown=True)):
        found.setdefault(name, []).append(args)
        if name in FAULTS:
            faults.append((args[0], name))
    is_at, place, heading, shape = (
        {args[0]: args[1] for args in found.get(name, ())}
        for name in ("is", "at", "heading", "shape")
    )
    course = {t: (path, direction) for t, path, direction in found.get("along", ())}
    if theory.star == "gateways":
        seen = frames.Frames(trace, len(is_at), changes=bool(theory.changed)).frames
        heading = {
            t: frames.heading(seen[shape[p]], seen[shape[t]], heading[t]) for t, p in place.items()
        }
    # 2. Number dstates, places and paths from 0, in the order of these names.
    views = views_of(is_at, trace, faults)
    names = sorted(set(is_at.values()))
    dstate_of, place_of, path_of = (
        {name: i for i, name in enumerate(sorted(set(some)))}
        for some in (
            names,
            (place[s] for s in names if s in place),
            (course[s][0] for s in names if s in course),
        )
    )
    dstates = tuple(
        DState(
            id=dstate_of[s],
            view=views[s],
            place=place_of[place[s]] if s in place else None,
            path=path_of[course[s][0]] if s in course else None,
            direction=course[s][1] if s in course else None,
            heading=heading.get(s),
        )
        for s in names
    )
    labels = tuple(dstate_of[is_at[t]] for t in range(len(is_at)))
    # 3. Sort the places of each path.
    on: list[set[int]] = [set() for _ in path_of]
    for dstate in dstates:
        if dstate.path is not None and dstate.place is not None:
            on[dstate.path].add(dstate.place)
    before: list[list[tuple[int, int]]] = [[] for _ in path_of]
    for h, p, q in found.get("before", ()):
        pair = place_of.get(p, -1), place_of.get(q, -1)
        if h in path_of and on[path_of[h]].issuperset(pair):
            before[path_of[h]].append(pair)
    excused = ((path_of.get(h, -1), path_of.get(g, -1)) for h, g in found.get("excused", ()))
    ssh_map = SSHMap(
        dstate_at=labels,
        dstates=dstates,
        links=links_of(labels, trace, faults),
        places=tuple(place_of.values()),
        paths=tuple(
            MapPath(path, tuple(places_in_order(some, before[path])))
            for path, some in enumerate(on)
        ),
        excused=tuple(sorted(pair for pair in excused if min(pair) >= 0)),
        faults=faults_of(faults, is_at, views, trace, theory),
    )
    return with_changes(ssh_map, trace, theory) or ssh_map


def views_of(
    labels: Mapping[int, int], trace: Trace, faults: Iterable[tuple[int, str]] = ()
) -> dict[int, View | None]:
    """Return the view of each dstate: the first view there that is known and not treated as wrong.

    `faults` are steps and kinds. The view is None if a dstate has no such view.
    """
    misread = {t for t, kind in faults if kind == "misread"}
    views: dict[int, View | None] = dict.fromkeys(labels.values())
    for t in sorted(labels):
        if t not in misread and views[labels[t]] is None:
            views[labels[t]] = trace.steps[t].view
    return views


def causal_map(
    labels: Sequence[int],
    trace: Trace,
    faults: Sequence[tuple[int, str]] = (),
    theory: Theory = CAUSAL,
) -> SSHMap:
    """Make a causal map (no places) from the dstates of steps, perhaps with faults.

    The dstates are numbered by first visit. A fault is a step and a kind. The theory has its cost.
    """
    found = tuple(numbered(labels))
    is_at = dict(enumerate(found))
    views = views_of(is_at, trace, faults)
    return SSHMap(
        found,
        tuple(DState(i, view) for i, view in views.items()),
        links_of(found, trace, faults),
        faults=faults_of(faults, is_at, views, trace, theory),
    )


def places_in_order(places: Iterable[int], before: Iterable[tuple[int, int]]) -> list[int]:
    """Sort places by a strict order: `before` has all pairs of places, the earlier one first."""
    behind = dict.fromkeys(places, 0)
    for _, q in before:
        behind[q] += 1
    return sorted(behind, key=lambda p: (behind[p], p))


def are_one(first: int, second: int) -> Symbol:
    """Return the atom that says that two steps are one dstate. The first is the earlier step."""
    return Function("same", number_symbols(first, second))


def forbidden_equalities(equalities: Iterable[Equality], where: Symbol | None = None) -> str:
    """Return the rule that some equality of these does not hold. It may depend on atom `where`."""
    atoms = [str(where)] if where else []
    for e in equalities:
        if e.of == "displacement":
            atoms.append(f"not jumped({e.second})")
            continue
        sign, of = "" if e.holds else "not ", "same" if e.of == "dstate" else "same_place"
        atoms.append(f"{sign}{of}({min(e.first, e.second)},{max(e.first, e.second)})")
    return f":- {', '.join(atoms)}."


def exactly(number: int, count: Count) -> str:
    """Return the rule that a map has this many dstates, places or paths, if `of_number` is true."""
    counted = {
        "dstates": "T : is(T,T)",
        "places": "T : at(T,T)",
        "paths": "(T,H) : first_along(T,H)",
    }[count]
    atom = of_number(number, count)
    return f"#external {atom}.\n:- {atom}, #count {{ {counted} }} != {number}."


def of_number(number: int, count: Count) -> Symbol:
    """Return the external atom that switches the rule of `exactly` on."""
    return Function("of_number", [Function(count), *number_symbols(number)])


COURSE = {"pos": 1, "neg": -1}


def constant(value: str | int) -> str:
    """Return a number or a text as a constant of clingo."""
    return str(Number(value) if isinstance(value, int) else String(value))


@lru_cache(maxsize=2**14)
def read_atom(symbol: Symbol) -> tuple[str, tuple[int, ...]]:
    """Return the name of an atom and its arguments as numbers; pos is 1 and neg is -1."""
    return symbol.name, tuple(
        arg.number if arg.type is SymbolType.Number else COURSE[arg.name]
        for arg in symbol.arguments
    )


_number = cache(Number)  # takes half the time of making a new number


def number_symbols(*arguments: int) -> list[Symbol]:
    """Return numbers as clingo's symbols, for the arguments of a program part or of an atom."""
    return [_number(argument) for argument in arguments]
