"""Between Python and clingo: a trace becomes facts, an answer set becomes a map. No other module knows a predicate's name.

In the fast encodings a step is an argument of a fact, so that one call grounds the rules for many steps. A program part for each step would make the
same rules take about thirty times as long to ground. Only the readable encodings, which are mostly grounded for short prefixes, have such parts.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from itertools import groupby, pairwise, permutations, product
from operator import itemgetter
from typing import TypeAlias

from clingo import Control, Function, Model, Number, String, Symbol, SymbolType

from ssh_abduction.data.maps import FAULTS, DState, Fault, MapPath, SSHMap
from ssh_abduction.data.odometry import in_words
from ssh_abduction.data.trace import Action, Trace, View
from ssh_abduction.solver.steps import frames
from ssh_abduction.solver.steps.chart import Chart, FramedChart
from ssh_abduction.theory import encodings
from ssh_abduction.theory.evidence import Equality, Pairs
from ssh_abduction.theory.settle import Problem
from ssh_abduction.theory.speedups import TRAVELS_AND_TURNS
from ssh_abduction.theory.theory import EXCUSED, Count, Theory

_COURSE = {"pos": 1, "neg": -1}

_Ahead: TypeAlias = tuple[
    int, int, int
]  # a path, and two places of which the first comes before the second on it


def encoding_names(theory: Theory) -> tuple[str, ...]:
    """The encodings that a theory needs, in the order to load them."""
    return (*encodings.needed_by(vars(theory)), "preference", "show")


def theory_facts(theory: Theory, paths: int) -> str:
    """The axioms and the preference of a theory, and names for so many paths, as facts."""
    facts = [f"axiom({name})." for name in theory.axioms]
    facts += [f"path(1..{paths})."] if theory.level == "topological" else []
    facts += _preferred(theory)
    facts += ["defeasible."] if theory.boundary == "defeasible" else []
    facts += [f"allowed({kind})." for kind in EXCUSED if getattr(theory, kind)]
    return "\n".join(facts)


def _preferred(theory: Theory) -> list[str]:
    """Which counts a theory prefers to be small, the first one at the highest level."""
    return [
        f"prefer({count},{len(theory.priorities) - i})."
        for i, count in enumerate(theory.priorities)
    ]


def own_rules(theory: Theory) -> str:
    """The user's own rules. Their axioms hold like those of the encodings."""
    return "\n".join(rules.text for rules in theory.rules)


def run_by_steps() -> Symbol:
    """The external atom that says that the program parts of steps are grounded: without it the encodings have no answer."""
    return Function("run_by_steps")


def most_paths(trace: Trace, theory: Theory, steps: int) -> int:
    """The most paths that a map of the first steps can have: a path begins at the start, or where a turn right or left ends."""
    if TRAVELS_AND_TURNS & theory.given_up:
        return steps
    return 1 + sum(
        action.turn in ("right", "left") or action.slipped for action in trace.actions[: steps - 1]
    )


def trace_facts(problem: Problem, start: int, stop: int) -> str:
    """What happened in steps `start` to `stop - 1`, and the links between them and from the step before, as facts."""
    trace, theory = problem.trace, problem.theory
    facts = []
    for t in range(start, stop):
        step = trace.steps[t]
        facts.append(
            f"unknown({t})." if step.view is None else f"view({t},{_constant(step.view)})."
        )
        if theory.star in ("pattern", "frame"):
            facts += [
                f"open({t},{slot})." for slot, is_open in enumerate(step.openings or ()) if is_open
            ]
    done = {t: trace.actions[t] for t in range(max(start - 1, 0), stop - 1)}
    facts += [f"act({t},{_constant(action.name)})." for t, action in done.items()]
    facts += [f"unlinked({t})." for t, action in done.items() if action.slipped]
    if theory.misread:
        facts += [
            f"price(misread,{t},{theory.fault_tenths('misread', trace.steps[t])})."
            for t in range(start, stop)
        ]
    if theory.jumped:
        moved = [t for t in range(max(start, 1), stop) if trace.steps[t].displacement is not None]
        facts += [
            f"moved({t}). price(jumped,{t},{theory.fault_tenths('jumped', trace.steps[t])})."
            for t in moved
        ]
    if theory.slipped:
        facts += [
            f"price(slipped,{t},{theory.fault_tenths('slipped', trace.steps[t])})." for t in done
        ]
    if theory.level == "topological":
        facts += [
            _kind_fact(action) for action in dict.fromkeys(done.values()) if action.kind is not None
        ]
    if theory.star == "gateways":
        facts += _gateway_facts(trace, start, stop)
    return "\n".join([*facts, *_evidence_facts(problem, start, stop)])


def _gateway_facts(trace: Trace, start: int, stop: int) -> Iterator[str]:
    """What these steps see of gateways, and how that fits what earlier steps see, as facts for gateways.lp."""
    found = frames.Frames(trace, stop)
    known = len(frames.Frames(trace, start).frames)
    yield from (f"star({t},{found.stars[t]})." for t in range(start, stop))
    yield from (
        f"looks({star},{x})."
        for star in dict.fromkeys(found.stars[start:])
        for x in found.looks[star]
    )
    yield from (
        f"slots({x},{max(frame.slots, 1)})." for x, frame in enumerate(found.frames) if x >= known
    )
    yield from (
        f"ends({x},{way})."
        for x, frame in enumerate(found.frames)
        if x >= known
        for way in frames.ends(frame)
    )
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
            yield from (f"rotates({_constant(action.name)},{x},{y},{shift})." for shift in fitting)


def _evidence_facts(problem: Problem, start: int, stop: int) -> Iterator[str]:
    """What evidence says of these steps, and of pairs of them with earlier ones."""
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
    """A trace and its settled theory as the facts that `encodings/run.py` solves."""
    trace, theory = problem.trace, problem.theory
    files = " ".join(f"{name}.lp" for name in encoding_names(theory))
    return "\n".join(
        [
            f"% {len(trace)} steps{f' of {trace.name!r}' if trace.name else ''}. In {encodings.folder()}, run",
            f"%   python run.py --project=project --opt-mode=optN -n 0 THIS_FILE {files}",
            theory_facts(theory, most_paths(trace, theory, len(trace))),
            trace_facts(problem, 0, len(trace)),
            own_rules(theory),
            "",
        ]
    )


def query(t: int) -> Symbol:
    """The external atom that makes t the last step."""
    return Function("query", numbers(t))


def active(axiom: str, t: int) -> Symbol:
    """The atom of an explanation that makes an axiom hold at step t."""
    return Function("active", [Function(axiom), *numbers(t)])


def told_of(steps: Iterable[int]) -> str:
    """The steps that conclusions are about (derivation.lp), as facts."""
    return " ".join(f"told_of({t})." for t in sorted(set(steps)))


def conclusion(name: str, *steps: int) -> Symbol:
    """A conclusion of derivation.lp."""
    return Function("so", [Function(name, numbers(*steps))])


def read_conclusion(symbol: Symbol) -> tuple[str, tuple[int, ...]]:
    """The name of such a conclusion, and its steps."""
    said = symbol.arguments[0]
    return said.name, tuple(argument.number for argument in said.arguments)


def conclusions_of(control: Control) -> list[Symbol]:
    """All conclusions that some answer may have."""
    return [atom.symbol for atom in control.symbolic_atoms.by_signature("so", 1)]


def read_argument(model: Model) -> tuple[frozenset[Symbol], frozenset[Symbol], frozenset[Symbol]]:
    """Of an answer: the conclusions that hold, what would make the axioms active that are broken, and the atoms of steps that are one dstate."""
    conclusions, broken, one = set[Symbol](), set[Symbol](), set[Symbol]()
    for symbol in model.symbols(atoms=True):
        if symbol.name == "so":
            conclusions.add(symbol)
        elif symbol.name == "violation":
            broken.add(Function("active", symbol.arguments))
        elif symbol.name == "same":
            one.add(symbol)
    return frozenset(conclusions), frozenset(broken), frozenset(one)


def picked(symbol: Symbol) -> Symbol:
    """The external atom that a conclusion is among those of which some are to fail."""
    return Function("picked", [symbol])


def some_fail() -> Symbol:
    """The atom that some picked conclusion does not hold."""
    return Function("some_fail")


def may_fail(conclusions: Iterable[Symbol]) -> str:
    """The rules that say so."""
    return "\n".join(
        f"#external {picked(c)}. {some_fail()} :- {picked(c)}, not {c}. #heuristic {c} : {picked(c)}. [1,false]"
        for c in conclusions
    )


def are_one(first: int, second: int) -> Symbol:
    """The atom of the readable encodings that two steps, the earlier one first, are one dstate."""
    return Function("same", numbers(first, second))


def _constant(value: str | int) -> str:
    return str(Number(value) if isinstance(value, int) else String(value))


def _kind_fact(action: Action) -> str:
    return (
        f"kind({_constant(action.name)},travel)."
        if action.kind == "travel"
        else f"turns({_constant(action.name)},{action.turn})."
    )


@lru_cache(maxsize=2**14)
def _atom(symbol: Symbol) -> tuple[str, tuple[int, ...]]:
    """The name and the arguments of an atom of a map. They are cached, as maps have most atoms in common and each part takes a call to clingo."""
    return symbol.name, tuple(
        arg.number if arg.type is SymbolType.Number else _COURSE[arg.name]
        for arg in symbol.arguments
    )


def read_map(model: Model, trace: Trace, theory: Theory) -> SSHMap:
    """The map that an answer set describes, for the steps it speaks of."""
    is_at: dict[int, int] = {}
    place: dict[int, int] = {}
    course: dict[int, tuple[int, int]] = {}
    heading: dict[int, int] = {}
    shape: dict[int, int] = {}
    before: list[tuple[int, int, int]] = []
    excused: list[tuple[int, int]] = []
    faults: list[tuple[int, str]] = []
    for name, args in map(_atom, model.symbols(shown=True)):
        if name == "is":
            is_at[args[0]] = args[1]
        elif name == "at":
            place[args[0]] = args[1]
        elif name == "along":
            course[args[0]] = (args[1], args[2])
        elif name == "before":
            before.append((args[0], args[1], args[2]))
        elif name == "heading":
            heading[args[0]] = args[1]
        elif name == "shape":
            shape[args[0]] = args[1]
        elif name == "excused":
            excused.append((args[0], args[1]))
        elif name in FAULTS:
            faults.append((args[0], name))
    if theory.star == "gateways":
        found = frames.Frames(trace, len(is_at)).frames
        heading = {
            t: frames.heading(found[shape[p]], found[shape[t]], heading[t])
            for t, p in place.items()
        }
    return _map(trace, is_at, place, course, heading, before, excused, faults, theory)


def read_steps(model: Model) -> tuple[tuple[int, ...], tuple[int | None, ...]]:
    """The dstate and the place of each step in an answer set, which may break axioms; in a causal theory no step has a place."""
    found: dict[str, dict[int, int]] = {"is": {}, "at": {}}
    for name, args in map(_atom, model.symbols(shown=True)):
        if name in found:
            found[name][args[0]] = args[1]
    steps = range(len(found["is"]))
    return tuple(found["is"][t] for t in steps), tuple(found["at"].get(t) for t in steps)


def _map(
    trace: Trace,
    is_at: Mapping[int, int],
    place: Mapping[int, int],
    course: Mapping[int, tuple[int, int]],
    heading: Mapping[int, int],
    before: Iterable[tuple[int, int, int]],
    excused: Iterable[tuple[int, int]] = (),
    faults: Sequence[tuple[int, str]] = (),
    theory: Theory | None = None,
) -> SSHMap:
    """The map of these dstates, places, courses and headings of steps; dstates and places are named by the first step at them."""
    views = views_of(is_at, trace, faults)
    names = sorted(set(is_at.values()))
    dstate_of = {name: i for i, name in enumerate(names)}
    place_of = {name: i for i, name in enumerate(sorted({place[s] for s in names if s in place}))}
    path_of = {
        name: i for i, name in enumerate(sorted({course[s][0] for s in names if s in course}))
    }
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
    pairs = [
        (path_of[h], place_of[p], place_of[q])
        for h, p, q in before
        if h in path_of and p in place_of and q in place_of
    ]
    return SSHMap(
        labels=labels,
        dstates=dstates,
        links=links_of(labels, trace, faults),
        places=tuple(place_of.values()),
        paths=_paths(len(path_of), dstates, pairs),
        excused=tuple(
            sorted((path_of[h], path_of[g]) for h, g in excused if h in path_of and g in path_of)
        ),
        faults=() if theory is None else faults_of(faults, is_at, views, trace, theory),
    )


def views_of(
    labels: Mapping[int, int], trace: Trace, faults: Iterable[tuple[int, str]] = ()
) -> dict[int, View | None]:
    """The view of each dstate: that of its first step at which it is known and not misread; None where there is no such step.

    labels  the dstate of each step
    faults  steps and kinds of faults
    """
    misread = {t for t, kind in faults if kind == "misread"}
    views: dict[int, View | None] = dict.fromkeys(labels.values())
    for t in sorted(labels):
        if t not in misread and views[labels[t]] is None:
            views[labels[t]] = trace.steps[t].view
    return views


def faults_of(
    faults: Iterable[tuple[int, str]],
    labels: Mapping[int, int],
    views: Mapping[int, View | None],
    trace: Trace,
    theory: Theory,
) -> tuple[Fault, ...]:
    """The faults as a map tells them."""
    found = []
    for t, kind in sorted(faults):
        cost = theory.fault_tenths(kind, trace.steps[t]) / 10
        if kind == "misread":
            found.append(Fault(t, "misread", _view(trace, t), views[labels[t]], cost))
        elif kind == "slipped":
            found.append(Fault(t, "slipped", trace.actions[t].name, cost=cost))
        elif kind == "jumped":
            found.append(
                Fault(
                    t, "jumped", in_words(trace.steps[t].displacement or (0.0, 0.0, 0.0)), cost=cost
                )
            )
        else:
            found.append(Fault(t, "misseen", cost=cost))
    return tuple(found)


def name_facts(
    names: Iterable[tuple[int, int]],
    spares: Collection[Sequence[int]],
    links: Iterable[tuple[int, int, int]],
    choices: Sequence[Sequence[int]],
    ordered: bool = True,
) -> str:
    """The facts of names.lp that hold for all batches.

    names    each with its view
    spares   for each view its spare names; the last one is the rest
    links    of the nodes, with their actions
    choices  for each node, the names that it can be at
    ordered  whether steps have to be at spare names in the order of the names; if not, that may be assumed in a question
    """
    view_of = dict(names)
    rests = {spare[-1] for spare in spares}
    leads = {
        (s, action, x)
        for t, action, u in links
        for s in choices[t]
        if s not in rests
        for x in choices[u]
    }
    facts = [f"view({name},{view})." for name, view in view_of.items()]
    for spare in spares:
        facts += (
            [f"spare({name})." for name in spare]
            + [f"after({r},{s})." for r, s in pairwise(spare)]
            + [f"rest({spare[-1]})."]
        )
    facts += [f"leads({s},{action},{x})." for s, action, x in leads]
    facts += [
        f"shows({s},{action},{view})."
        for s, action, view in {(s, action, view_of[x]) for s, action, x in leads}
    ]
    facts += ["ordered." if ordered else "{ ordered }."]
    return "\n".join(facts)


def batch_facts(
    batch: int,
    nodes: Iterable[tuple[int, int, Sequence[int], int | None]],
    links: Iterable[tuple[int, int, int]],
    apart: Iterable[tuple[int, int]],
) -> str:
    """The facts of names.lp for one batch.

    nodes  each with its view, the names that it can be at, and the node of that view that was given before it
    links  with their actions
    apart  pairs of nodes
    """
    facts = []
    for t, view, names, before in nodes:
        facts.append(f"node({batch},{t},{view}).")
        facts += [f"may_be({t},{name})." for name in names]
        facts += [f"follows({before},{t})."] if before is not None and len(names) > 1 else []
    facts += [f"link({batch},{t},{action},{u})." for t, action, u in links]
    facts += [f"apart({batch},{t},{u})." for t, u in apart]
    return "\n".join(facts)


def resting(batch: int) -> Symbol:
    """The atom that some step of the batches up to this one is at the rest of its view. It is assumed, or assumed false, in a question."""
    return Function("resting", numbers(batch))


def ordered() -> Symbol:
    """The atom that steps are at spare names in the order of the names."""
    return Function("ordered")


def named(t: int, name: int) -> Symbol:
    """The atom that step t is at the dstate of that name."""
    return Function("is", numbers(t, name))


def used(name: int) -> Symbol:
    """The atom that a spare name is used."""
    return Function("used", numbers(name))


def read_names(model: Model) -> dict[int, int]:
    """The name of each step that an answer set of names.lp speaks of."""
    return dict(map(_named, model.symbols(shown=True)))


@lru_cache(maxsize=2**16)
def _named(symbol: Symbol) -> tuple[int, int]:
    """A step and its name. They are cached, as successive answers have most atoms in common and each part takes a call to clingo."""
    step, name = symbol.arguments
    return step.number, name.number


class NameReader:
    """Reads answers of names.lp that was given all links of a trace. The name of each step then follows from where actions lead, which takes fewer questions.

    actions  after each step but the last, as numbers
    choices  for each step, the names that it can be at
    """

    def __init__(self, actions: Sequence[int], choices: Sequence[Sequence[int]]) -> None:
        self._actions = actions
        self._choices = choices
        # Where an action at a name led in the last answer, and the literal that says so.
        self._last: dict[tuple[int, int], tuple[int, int]] = {}

    def read(self, model: Model) -> dict[int, int]:
        """The name of each step, in an answer that uses no rest."""
        atoms = model.context.symbolic_atoms
        leads: dict[tuple[int, int], int] = {}
        name = next(
            s
            for s in self._choices[0]
            if (atom := atoms[named(0, s)]) and model.is_true(atom.literal)
        )
        names = {0: name}
        for t, action in enumerate(self._actions, 1):
            key = name, action
            if key not in leads:
                there, literal = self._last.get(key, (-1, 0))
                if not literal or not model.is_true(literal):
                    asked = (
                        (x, atoms[Function("goes", numbers(*key, x))]) for x in self._choices[t]
                    )
                    there, literal = next(
                        (x, atom.literal)
                        for x, atom in asked
                        if atom and model.is_true(atom.literal)
                    )
                    self._last[key] = there, literal
                leads[key] = there
            names[t] = name = leads[key]
        return names


def visit_facts(
    batch: int,
    nodes: Iterable[tuple[int, int, int]],
    leaves: Iterable[tuple[int, int, int]],
    fits: Iterable[tuple[int, int, int]],
    unfit: Iterable[tuple[int, int, int]] = (),
) -> str:
    """The facts of visits.lp for one batch: what is new of visits.

    nodes   number, visit and slot of each
    leaves  visits that end: the visit, the slot and the action
    fits    pairs of visits that may be at one place, and how turned
    unfit   such pairs of earlier batches that may no longer be
    """
    new = {"node": nodes, "leaves": leaves, "fits": fits, "unfit": unfit}
    return "\n".join(
        f"{name}({batch},{','.join(map(str, args))})."
        for name, rows in new.items()
        for args in rows
    )


def same(pair: tuple[int, int, int]) -> Symbol:
    """The atom that two visits are at one place, and how they are turned to each other."""
    return Function("same", numbers(*pair))


def read_same(atom: Symbol) -> tuple[int, int, int]:
    """The two visits of such an atom, and how they are turned to each other."""
    first, second, turned = (argument.number for argument in atom.arguments)
    return first, second, turned


def listed(batch: int) -> Symbol:
    """The external atom that is true while answers for the batches up to this one are listed."""
    return Function("listed", numbers(batch))


def first(place: int) -> Symbol:
    """The atom that the node at this position of the order is the first at its dstate."""
    return Function("first", numbers(place))


def over(core: int, count: int) -> Symbol:
    """The atom that at least so many members of a core are true."""
    return Function("over", numbers(core, count))


def read_over(member: Symbol) -> tuple[int, int] | None:
    """The core and the count of such an atom; None for another atom."""
    return (
        (member.arguments[0].number, member.arguments[1].number) if member.name == "over" else None
    )


def core_facts(core: int, members: Iterable[Symbol]) -> str:
    """The members of a core."""
    return "\n".join(f"member({core},{member})." for member in members)


def three_facts(batch: int, threes: Iterable[tuple[int, ...]]) -> str:
    """Threes of visits for which clingo is to keep that to be at one place is transitive."""
    return "\n".join(f"via({batch},{','.join(map(str, three))})." for three in threes)


def forbidden_pairs(
    pairs: Iterable[tuple[int, int, int]],
    different: Iterable[tuple[int, int, int]] = (),
    listed: int | None = None,
) -> str:
    """The rule that not all of these pairs of visits are at one place while all those `different` ones are not.

    listed  the rule holds only while answers up to this batch are listed (default always)
    """
    body = [
        *(f"same({i},{j},{r})" for i, j, r in pairs),
        *(f"not same({i},{j},{r})" for i, j, r in different),
    ]
    return f":- {', '.join(['#true', *body] if listed is None else [f'listed({listed})', *body])}."


def forbidden_places(equalities: Sequence[Sequence[tuple[int, int, int]]]) -> str:
    """The rules that not all of these equalities hold, each of which is that one of some pairs of visits is one place, however turned."""
    return "\n".join(forbidden_pairs(pairs) for pairs in product(*equalities))


def forbidden_equalities(
    equalities: Iterable[Equality], where: Symbol | None = None, excusable: bool = False
) -> str:
    """The rule that these equalities of steps do not all hold; where an atom is given, only if that holds.

    excusable  what refuses them are displacements, and says nothing where one of these, between two of the steps, is disbelieved
    """
    atoms = [str(where)] if where else []
    if excusable:
        atoms += [f"not jumped_since({e.first},{e.second})" for e in equalities]
    atoms += [
        f"{'' if e.holds else 'not '}same{'' if e.of == 'dstate' else '_place'}({min(e.first, e.second)},{max(e.first, e.second)})"
        for e in equalities
    ]
    return f":- {', '.join(atoms)}."


def rests_on(axiom: str, t: int, other: str) -> str:
    """The rule that where an axiom is active at step t, another one holds at every step."""
    return f":- {active(axiom, t)}, violation({other},T)."


def doubt(number: int, part: int, condition: str | None, *, one: bool) -> str:
    """The rules that say: some doubt holds where this one is open, and two things are one (or are not); the condition of that is None where they never are."""
    rules = [f"#external {open_doubt(number)}."]
    rules += (
        [f"one_in_doubt({number}) :- {condition}."]
        if condition
        else [f"#external one_in_doubt({number})."]
    )
    return "\n".join(
        [
            *rules,
            f"{some_doubt(part)} :- {open_doubt(number)}, {'' if one else 'not '}one_in_doubt({number}).",
        ]
    )


def doubts_before(part: int) -> str:
    """The rule that some doubt holds where some doubt of an earlier part does."""
    return (
        f"{some_doubt(part)} :- {some_doubt(part - 1)}."
        if part > 1
        else f"#external {some_doubt(0)}."
    )


def steps_are_one(sort: str, i: int, j: int) -> str:
    """The condition that two steps, the earlier one first, are one in the readable encodings: as to dstate, place, path or course. A step with itself: that it is along a path."""
    return {
        "dstates": f"same({i},{j})",
        "places": f"same_place({i},{j})",
        "paths": f"along({i},H,_), along({j},H,_)",
        "courses": f"same_course({i},{j})",
    }[sort]


def open_doubt(number: int) -> Symbol:
    """The external atom that a doubt is open."""
    return Function("open_doubt", numbers(number))


def some_doubt(part: int) -> Symbol:
    """The atom that some open doubt of this part of a program or of an earlier one holds."""
    return Function("some_doubt", numbers(part))


def exactly(number: int, count: Count) -> str:
    """The rule that a map has just so many dstates, places or paths, while `of_number` is true."""
    counted = {
        "dstates": "T : is(T,T)",
        "places": "T : at(T,T)",
        "paths": "(T,H) : first_along(T,H)",
    }[count]
    return f"#external {of_number(number, count)}.\n:- {of_number(number, count)}, #count {{ {counted} }} != {number}."


def of_number(number: int, count: Count) -> Symbol:
    """The external atom that says that maps have just so many dstates, places or paths."""
    return Function("of_number", [Function(count), *numbers(number)])


def not_together(number: int, pairs: Sequence[tuple[int, int]]) -> str:
    """The rule that these pairs of steps with names are not all one dstate. At a rest steps need not be one.

    number  another one for each such rule
    """
    together = [
        f"together({number},{k}) :- is({i},S), is({j},S), not rest(S)."
        for k, (i, j) in enumerate(pairs)
    ]
    return "\n".join(
        [*together, f":- {', '.join(f'together({number},{k})' for k in range(len(pairs)))}."]
    )


_number = cache(Number)  # takes half the time of making a number anew, where there are many


def numbers(*arguments: int) -> list[Symbol]:
    """Numbers as the arguments of a program part, or of an atom."""
    return [_number(argument) for argument in arguments]


def causal_map(labels: Sequence[int], trace: Trace) -> SSHMap:
    """The map of the causal level that these labels of the first steps make, dstates numbered by first visit."""
    number: dict[int, int] = {}
    first: list[int] = []
    for t, label in enumerate(labels):
        if number.setdefault(label, len(number)) == len(first):
            first.append(t)
    found = tuple(number[label] for label in labels)
    return SSHMap(
        found,
        tuple(DState(i, _view(trace, t)) for i, t in enumerate(first)),
        links_of(found, trace),
    )


def faulty_map(
    labels: Sequence[int], trace: Trace, faults: Sequence[tuple[int, str]], theory: Theory
) -> SSHMap:
    """The map of the causal level that these labels make, where some steps are disbelieved; dstates are numbered by first visit."""
    number: dict[int, int] = {}
    found = tuple(number.setdefault(label, len(number)) for label in labels)
    is_at = dict(enumerate(found))
    views = views_of(is_at, trace, faults)
    dstates = tuple(DState(i, views[i]) for i in range(len(number)))
    return SSHMap(
        found,
        dstates,
        links_of(found, trace, faults),
        faults=faults_of(faults, is_at, views, trace, theory),
    )


def faulty_names(names: Mapping[int, int]) -> Iterator[tuple[int, int]]:
    """The names of dstates for faulty.lp, and the view of each: for each view so many, and one more, which is the rest of the view."""
    first = 0
    for view, count in names.items():
        yield from ((name, view) for name in range(first, first + count + 1))
        first += count + 1


def faulty_rests(names: Mapping[int, int]) -> Iterator[tuple[int, int]]:
    """The rest of each view, and the view."""
    named = dict(names)
    last = {view: name for name, view in faulty_names(named)}
    return ((name, view) for view, name in last.items())


def at_most_faults(most: int) -> str:
    """That the steps given so far have so many faults at most, as a rule for faulty.lp."""
    return f":- #count {{ T,misread : misreads(T); T,slipped : slips(T) }} > {most}."


def dstates_and_faults_up_to(dstates: int, tenths: int) -> str:
    """That there are so many dstates at most, and that their faults cost no more than this, as rules for faulty.lp."""
    faults = (
        "W,T,misread : misreads(T), price(misread,T,W); W,T,slipped : slips(T), price(slipped,T,W)"
    )
    return f"#program more(b).\n:- #sum {{ {faults} }} > {tenths}.\n:- #count {{ S : used(S) }} > {dstates}."


def faulty_base(actions: Iterable[int], names: Mapping[int, int], kinds: Iterable[str]) -> str:
    """The names of dstates, the actions, and the kinds of faults that may be, as facts for faulty.lp.

    names  how many names each view has, beside the rest
    """
    found = [f"action({action})." for action in sorted(set(actions))]
    found += [f"allowed({kind})." for kind in kinds]
    for view, some in groupby(faulty_names(names), key=itemgetter(1)):
        of_view = [name for name, _ in some]
        found += [f"view({name},{view})." for name in of_view]
        found += [f"after({before},{name})." for before, name in pairwise(of_view)]
        found.append(f"rest({of_view[-1]}).")
    return "\n".join(found)


def faulty_batch(
    batch: int,
    seen: Sequence[int],
    actions: Sequence[int],
    steps: Sequence[int],
    known: Sequence[int],
    pairs: Pairs,
    price: Mapping[str, Sequence[int]],
    full: Collection[int] = (),
) -> str:
    """These steps of a trace as a batch of facts for faulty.lp.

    full   steps of which it is asked where they are, also where their views are misread
    price  tenths of dstates for each kind of fault that may be, at each step
    steps  in the order in which they are given
    known  those that were given before, in that order
    """
    given = {*known, *steps}
    new = set(steps)
    found = [f"node({batch},{t},{seen[t]})." for t in steps]
    found += [f"full({t})." for t in steps if t in full]
    found += [f"next({batch},{t},{u})." for t, u in pairwise([*known[-1:], *steps])]
    links = sorted({t for step in steps for t in (step - 1, step) if t in given and t + 1 in given})
    found += [f"link({batch},{t},{actions[t]},{t + 1})." for t in links]
    found += [
        f"price({kind},{t},{tenths[t]})."
        for kind, tenths in price.items()
        for t in (steps if kind == "misread" else links)
    ]
    for t in given:
        found += [
            f"excluded({batch},{i},{t})."
            for i in pairs.apart.get(t, ())
            if i in given and (i in new or t in new)
        ]
        found += [
            f"one({batch},{i},{t})."
            for i in pairs.one.get(t, ())
            if i in given and (i in new or t in new)
        ]
    return "\n".join(found)


def not_all_one(equalities: Collection[Equality]) -> str:
    """That these equalities of given steps do not all hold, as a rule for faulty.lp."""
    return f":- {', '.join(f'is({e.first},S{k}), is({e.second},S{k})' for k, e in enumerate(equalities))}."


def read_faulty(model: Model) -> tuple[dict[int, int], frozenset[int], frozenset[int]]:
    """Where each given step is, by the names of faulty.lp; the steps whose actions slipped; and those that are lost, as nobody asks where they are."""
    where: dict[int, int] = {}
    steps: dict[str, set[int]] = {"slips": set(), "lost": set()}
    for name, args in map(_atom, model.symbols(shown=True)):
        if name == "is":
            where[args[0]] = args[1]
        else:
            steps[name].add(args[0])
    return where, frozenset(steps["slips"]), frozenset(steps["lost"])


def paths_framed_facts(
    trace: Trace, theory: Theory, chart: FramedChart, forbidden: Sequence[Collection[Equality]] = ()
) -> str:
    """What happened at the nodes of a chart, as facts for paths_framed.lp.

    forbidden  sets of equalities of steps that do not all hold
    """
    slipped = {
        chart.node_of[t]
        for t, action in enumerate(trace.actions[: len(chart.node_of) - 1])
        if action.slipped
    }
    facts = [f"rotated({s},{x},{-action})." for s, action, x in chart.links if action < 0]
    facts += [f"travelled({s},{x})." for s, _, x in chart.travels if s not in slipped]
    facts += [f"turned({s},{turn},{x})." for s, turn, x in chart.turns(trace)]
    facts += [f"excluded({s},{x})." for s, x in chart.excluded]
    visits = {(chart.facing[s][0], chart.facing[x][0]): (s, x) for s, x in chart.away}
    facts += [f"far_nodes({s},{x})." for s, x in visits.values()]
    steps = len(chart.node_of)
    for number, equalities in enumerate(forbidden):
        if all(max(equality.first, equality.second) < steps for equality in equalities):
            nodes = [
                (chart.node_of[equality.first], chart.node_of[equality.second], equality.of)
                for equality in equalities
            ]
            facts += [f"part({number},{k},{s},{x},{of})." for k, (s, x, of) in enumerate(nodes)]
    return "\n".join([*facts, sides_framed_facts(theory)])


def sides_framed_facts(theory: Theory) -> str:
    """Which axioms of the sides of paths hold in a theory, as facts."""
    facts = ["sided."] if theory.boundary != "none" else []
    facts += ["symmetric."] if theory.symmetric_sides else []
    return "\n".join(facts)


def sides_frameless_facts(theory: Theory, actions: Mapping[int, Action]) -> str:
    """Which numbered actions are travels and turns, and which axioms of sides hold, as facts for sides_frameless.lp."""
    kinds = [
        f"turns({a},{action.turn})." if action.turn else f"travels({a})."
        for a, action in actions.items()
        if action.kind
    ]
    return "\n".join([*kinds, sides_framed_facts(theory)])


def paths_frameless_facts(
    theory: Theory,
    dstates: Iterable[int],
    links: Iterable[tuple[int, int, int]],
    actions: Mapping[int, Action],
    far: Iterable[Collection[tuple[int, int]]] = (),
    *,
    single: bool = False,
) -> str:
    """Dstates, the numbered actions that link them, and what is preferred, as facts for paths_frameless.lp.

    far     sets of pairs of dstates: evidence says that in each set there is a pair that is not at one place. Most sets are a single pair
    single  ask only for places and paths in which no two places and no two segments are one, unless they have to be
    """
    facts = [
        sides_framed_facts(theory),
        *(["total."] if theory.path_order == "total" else []),
        *(["single."] if single else []),
    ]
    facts += [f"is({x})." for x in dstates]
    for number, pairs in enumerate(far):
        facts += [
            f"far({x},{y})." if len(pairs) == 1 else f"far({number},{x},{y})." for x, y in pairs
        ]
    done = [(s, actions[a], x) for s, a, x in links]
    facts += [
        f"turn({s},{action.turn},{x})." if action.turn else f"travel({s},{x})."
        for s, action, x in done
        if action.kind
    ]
    return "\n".join([*facts, *_preferred(theory)])


def turn_facts(
    batch: int, chart: FramedChart, visits: Iterable[int], turns: Iterable[tuple[int, str, int]]
) -> str:
    """New visits, and new turns on a visit, from slot to slot, as facts for sides_framed.lp."""
    facts = [f"visit({batch},{visit})." for visit in visits]
    for s, turn, x in turns:
        (visit, slot), (_, faced) = chart.facing[s], chart.facing[x]
        facts.append(f"{'about' if turn == 'around' else 'turns'}({batch},{visit},{slot},{faced}).")
    return "\n".join(facts)


def read_contrary(model: Model) -> tuple[list[int], list[int]]:
    """Dstates whose segments show that there are no places and paths, those of short segments first; and dstates where paths cross that seem to meet again."""
    atoms = list(map(_atom, model.symbols(shown=True)))
    contrary = sorted((args[1], args[0]) for name, args in atoms if name == "contrary")
    return [dstate for _, dstate in contrary], sorted(
        args[0] for name, args in atoms if name == "twice"
    )


def settled_facts(
    theory: Theory,
    chart: FramedChart,
    labels: Sequence[int],
    nodes: Iterable[int],
    *,
    single: bool = False,
) -> str:
    """The dstates of these nodes, what is open from each dstate, and what is preferred, as facts for the fewest places and paths (paths_framed.lp).

    single  ask only for places and paths in which no two places and no two segments are one, unless they have to be
    """
    facts = [
        settled_labels((node, labels[node]) for node in nodes),
        *(["single."] if single else []),
    ]
    for label, node in {
        label: node for node, label in enumerate(labels)
    }.items():  # all nodes of a dstate see one star, so any of them will do
        visit, slot = chart.facing[node]
        star = chart.stars[visit]
        facts += [f"open({label},{k})." for k in range(4) if star[(slot + k) % 4]]
    return "\n".join([*facts, *_preferred(theory)])


def read_rivals(control: Control) -> tuple[list[int], list[tuple[int, int]]]:
    """The segments of a control, and the pairs of them that cannot be one path in either direction."""
    segments = sorted(
        _atom(atom.symbol)[1][0] for atom in control.symbolic_atoms.by_signature("segment", 1)
    )
    distinct = {
        tuple(_atom(atom.symbol)[1]) for atom in control.symbolic_atoms.by_signature("distinct", 3)
    }
    return segments, [
        (g, h) for g, h, direction in distinct if direction == 1 and (g, h, -1) in distinct
    ]


@dataclass(frozen=True)
class Segments:
    """What paths_frameless.lp says of segments and places before any two of them are one.

    Attributes:
        places: The places that turns tell apart.
        elsewhere: Pairs of places that are not one.
        travels: A segment, and two places that a travel along it leads between, in its direction.
        segments: All segments.
        distinct: Pairs of segments that are not one path.
    """

    places: list[int]
    elsewhere: list[tuple[int, int]]
    travels: list[tuple[int, int, int]]
    segments: list[int]
    distinct: list[tuple[int, int]]

    @classmethod
    def read(cls, control: Control) -> Segments:
        """What a control says in which the parts base and segments are grounded."""
        symbols = control.symbolic_atoms

        def atoms(name: str, arity: int) -> list[tuple[int, ...]]:
            return [tuple(_atom(atom.symbol)[1]) for atom in symbols.by_signature(name, arity)]

        places = sorted(place for (place,) in atoms("visited", 1))
        elsewhere, travels = (
            [(c, p) for c, p in atoms("elsewhere", 2)],
            [(g, c, b) for g, c, b in atoms("travel_on", 3)],
        )
        return cls(places, elsewhere, travels, *read_rivals(control))


def tight_facts(homes: Mapping[int, Iterable[int]]) -> str:
    """For each place the fixed places that it may be, as facts for paths_frameless.lp."""
    return "tight.\n" + "\n".join(
        f"fixed({place},{home})." for place, found in homes.items() for home in found
    )


def pinned_facts(segments: Iterable[int]) -> str:
    """Segments no two of which can be one path, as facts for paths_framed.lp."""
    return " ".join(f"pinned({segment})." for segment in segments)


def read_told(model: Model) -> tuple[bool, list[tuple[int, int]], list[tuple[int, int]]]:
    """Whether the labels of nodes have no places and paths; and if not so, which pairs of dstates are at different places, and which are one."""
    found: dict[str, list[tuple[int, int]]] = {"elsewhere": [], "one": []}
    for name, args in map(_atom, model.symbols(shown=True)):
        if name == "violated":
            return True, [], []
        found[name].append((args[0], args[1]))
    return False, found["elsewhere"], found["one"]


def is_violated(control: Control) -> bool:
    """Whether no places and paths fit the labels of nodes, as far as that can be seen without a choice."""
    return control.symbolic_atoms[Function("violated")] is not None


def loose(labels: Iterable[int]) -> str:
    """Dstates that may turn out to be others, as facts."""
    return "\n".join(f"loose({label})." for label in labels)


def settled_labels(labels: Iterable[tuple[int, int]]) -> str:
    """Nodes and their dstates, as facts."""
    return "\n".join(f"is({node},{label})." for node, label in labels)


def open_labels(labels: Sequence[int]) -> str:
    """The dstate of each node, for clingo to take or to leave out, so that what it takes has no places and paths."""
    return "\n".join(
        [
            *(f"{{ is({node},{label}) }}." for node, label in enumerate(labels)),
            ":- not violated.",
            "#show is/2.",
        ]
    )


def read_contraries(model: Model) -> list[int]:
    """Dstates whose paths show that there are no places and paths for them."""
    return sorted(
        args[0] for name, args in map(_atom, model.symbols(shown=True)) if name == "contrary"
    )


def forbidden_links(
    links: Iterable[tuple[int, int, int]], placed: Iterable[tuple[int, int]] = ()
) -> str:
    """The rule that these links of named dstates do not all hold while these steps are at these dstates."""
    return f":- {', '.join([*(f'goes({s},{a},{x})' for s, a, x in links), *(f'is({t},{s})' for t, s in placed)])}."


@dataclass(frozen=True, slots=True)
class PathAnswer:
    """An answer of paths_framed.lp or paths_frameless.lp.

    at     for each place that the turns tell, the place that it is at, and how it is turned to it
    part   for each segment, the path that it is part of, and in which direction
    order  for each path, its places in order
    """

    at: dict[int, tuple[int, int]]
    part: dict[int, tuple[int, int]]
    order: dict[int, list[int]]


class PathReader:
    """Reads maps from answers of paths_framed.lp or paths_frameless.lp, for one labelling of the nodes. What the labels alone tell is worked out once.

    Instead of reading all atoms of an answer, this asks it for the atoms that can be in it, beginning with those of the answer before. That takes a third of
    the time.
    """

    def __init__(
        self, control: Control, trace: Trace, theory: Theory, chart: Chart, labels: Sequence[int]
    ) -> None:
        stands, runs = (
            {a: (b, c) for a, b, c in _literals(control, name)} for name in ("stands", "runs")
        )
        first: dict[int, int] = {}  # for each label, the first step at its dstate
        for t, node in enumerate(chart.node_of):
            first.setdefault(labels[node], t)
        number = {label: i for i, label in enumerate(first)}
        self._labels = tuple(number[labels[node]] for node in chart.node_of)
        self._links = links_of(self._labels, trace)
        self._dstates = [(_view(trace, t), *stands[label]) for label, t in first.items()]
        self._runs: dict[
            int, list[tuple[int, int]]
        ] = {}  # for each segment, the dstates on it, and whether they face its direction
        for i, label in enumerate(first):
            if label in runs:
                segment, direction = runs[label]
                self._runs.setdefault(segment, []).append((i, direction))
        self._passes = {
            (segment, self._dstates[i][1]): None
            for segment, members in self._runs.items()
            for i, _ in members
        }
        self._at, self._part = _Choices(control, "at"), _Choices(control, "course")
        self._total = theory.path_order == "total"
        self._before: dict[_Ahead, int] = {}  # the literal that says so, 0 for what is never so
        self._order: dict[
            int, list[int]
        ] = {}  # for each path, its places in the answer that was read last
        self._placed: _Placed | None = (
            None  # what the places of the last map tell, as they are mostly the same in the next
        )
        self._made: dict[
            tuple[object, ...], DState
        ] = {}  # dstates made so far, as most of them are in most maps

    def condition(self, sort: str, i: int, j: int) -> str | None:
        """The condition that two dstates of a map are one in the answer: as to place, path or course. None where they never are."""
        if sort == "places":
            return f"at({self._dstates[i][1]},P,_), at({self._dstates[j][1]},P,_)"
        runs = {
            dstate: (segment, direction)
            for segment, members in self._runs.items()
            for dstate, direction in members
        }
        if i not in runs or j not in runs:
            return None
        (g, d), (h, e) = runs[i], runs[j]
        same_way = f", {d} * D == {e} * E" if sort == "courses" else ""
        return f"course({g},H,D), course({h},H,E){same_way}"

    def read(self, model: Model) -> PathAnswer:
        """The values that map_of needs of an answer."""
        at, part = self._at.made_in(model), self._part.made_in(model)
        on: dict[int, dict[int, None]] = {}  # for each path, the places on it
        for segment, component in self._passes:
            on.setdefault(part[segment][0], {})[at[component][0]] = None
        return PathAnswer(
            at, part, {path: self._ordered(model, path, places) for path, places in on.items()}
        )

    def _ordered(self, model: Model, path: int, places: Collection[int]) -> list[int]:
        """The places of a path in order. This begins with their order in the last answer, which is mostly nearly the same."""
        order = list(
            dict.fromkeys([*(p for p in self._order.get(path, ()) if p in places), *places])
        )
        if self._total:
            for i, place in enumerate(
                order
            ):  # insertion sort takes few questions where places are nearly in order
                to = i
                while to and not self._is_before(model, (path, order[to - 1], place)):
                    to -= 1
                order.insert(to, order.pop(i))
        else:
            order = _in_order(
                places,
                (pair for pair in permutations(places, 2) if self._is_before(model, (path, *pair))),
            )
        self._order[path] = order
        return order

    def _is_before(self, model: Model, ahead: _Ahead) -> bool:
        literal = self._before.get(ahead)
        if literal is None:
            atom = model.context.symbolic_atoms[Function("before", numbers(*ahead))]
            literal = self._before[ahead] = atom.literal if atom else 0
        return literal != 0 and model.is_true(literal)

    def map_of(self, answer: PathAnswer) -> SSHMap:
        """The map that an answer describes."""
        placed = self._placed
        if placed is None or placed.at != answer.at:
            placed = self._placed = self._placed_at(answer.at)
        faced: dict[
            int, tuple[int, int]
        ] = {}  # for each path, its number in the map, and the direction that is faced first
        dstates = list(placed.dstates)
        for segment, members in self._runs.items():
            h, ahead = answer.part[segment]
            path, first = faced.setdefault(h, (len(faced), ahead * members[0][1]))
            key = segment, path, ahead * first
            along = placed.along.get(key)
            if along is None:
                along = placed.along[key] = [
                    (i, self._dstate(dstates[i], path, key[2] * direction))
                    for i, direction in members
                ]
            for i, dstate in along:
                dstates[i] = dstate
        orders = (
            (path, [placed.number[p] for p in answer.order[h][::first]])
            for h, (path, first) in faced.items()
        )
        paths = tuple(MapPath(path, tuple(order)) for path, order in orders)
        return SSHMap(
            self._labels, tuple(dstates), self._links, tuple(range(len(placed.number))), paths
        )

    def _placed_at(self, at: dict[int, tuple[int, int]]) -> _Placed:
        """What the places of an answer tell of a map."""
        arrived: dict[
            int, tuple[int, int]
        ] = {}  # for each place, its number in the map, and the slot that is faced first
        dstates: list[DState] = []
        for view, component, slot in self._dstates:
            p, turned = at[component]
            place, facing = arrived.setdefault(p, (len(arrived), (slot + turned) % 4))
            dstates.append(DState(len(dstates), view, place, heading=(slot + turned - facing) % 4))
        return _Placed(at, {p: number for p, (number, _) in arrived.items()}, dstates, {})

    def _dstate(self, placed: DState, path: int, direction: int) -> DState:
        """A dstate, with its path and direction."""
        key = placed.id, placed.place, placed.heading, path, direction
        if key not in self._made:
            self._made[key] = replace(placed, path=path, direction=direction)
        return self._made[key]


@dataclass(frozen=True, slots=True)
class _Placed:
    """What the places of an answer tell of a map.

    at       as in PathAnswer
    number   for each place, its number in the map
    dstates  the dstates of the map, without paths
    along    the dstates of a segment with their paths, by the segment, the path that it is part of, and in which direction
    """

    at: dict[int, tuple[int, int]]
    number: dict[int, int]
    dstates: list[DState]
    along: dict[tuple[int, int, int], list[tuple[int, DState]]]


class _Choices:
    """The atoms of a predicate with three arguments of which an answer has exactly one for each first argument."""

    def __init__(self, control: Control, name: str) -> None:
        self._among: dict[
            int, list[tuple[int, tuple[int, int]]]
        ] = {}  # for each first argument, the literals of its atoms, and their other arguments
        for (a, b, c), literal in _literals(control, name).items():
            self._among.setdefault(a, []).append((literal, (b, c)))

    def made_in(self, model: Model) -> dict[int, tuple[int, int]]:
        """The other two arguments that an answer chooses for each first argument."""
        made = {}
        for a, among in self._among.items():  # what the last answer chose is asked for first
            if len(among) > 1 and not model.is_true(among[0][0]):
                taken = next(i for i, (literal, _) in enumerate(among) if model.is_true(literal))
                among.insert(0, among.pop(taken))
            made[a] = among[0][1]
        return made


def _literals(control: Control, name: str) -> dict[tuple[int, int, int], int]:
    """The literals of the atoms of a predicate with three arguments, by these."""
    found = {}
    for atom in control.symbolic_atoms.by_signature(name, 3):
        a, b, c = _atom(atom.symbol)[1]
        found[a, b, c] = atom.literal
    return found


def links_of(
    labels: Sequence[int], trace: Trace, faults: Iterable[tuple[int, str]] = ()
) -> tuple[tuple[int, str, int], ...]:
    """The distinct links that a labelling of the trace's first steps makes, sorted; without those of actions that slipped."""
    slipped = {t for t, kind in faults if kind == "slipped"}
    links = enumerate(zip(pairwise(labels), trace.actions, strict=False))
    return tuple(sorted({(s, action.name, x) for t, ((s, x), action) in links if t not in slipped}))


def _view(trace: Trace, step: int) -> str | int:
    view = trace.steps[step].view
    assert view is not None
    return view


def _paths(
    count: int, dstates: Iterable[DState], before: Iterable[tuple[int, int, int]]
) -> tuple[MapPath, ...]:
    """Paths with their places in order."""
    on: list[set[int]] = [set() for _ in range(count)]
    for s in dstates:
        if s.path is not None and s.place is not None:
            on[s.path].add(s.place)
    pairs: list[list[tuple[int, int]]] = [[] for _ in range(count)]
    for path, p, q in before:
        if p in on[path] and q in on[path]:
            pairs[path].append((p, q))
    return tuple(
        MapPath(path, tuple(_in_order(found, pairs[path]))) for path, found in enumerate(on)
    )


def _in_order(places: Iterable[int], before: Iterable[tuple[int, int]]) -> list[int]:
    """Places in an order in which each comes behind all that are before it. In a strict order, a place has more places before it than each of these has."""
    behind = dict.fromkeys(places, 0)
    for _, q in before:
        behind[q] += 1
    return sorted(behind, key=lambda p: (behind[p], p))
