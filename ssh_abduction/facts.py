"""Between Python and clingo: a trace becomes facts, an answer set becomes a map. No other module knows a predicate's name."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise

from clingo import Function, Model, Number, String, Symbol

from ssh_abduction.maps import DState, Path, SSHMap
from ssh_abduction.theory import Theory
from ssh_abduction.trace import Action, Trace

_COURSE = {"pos": 1, "neg": -1}


def encoding_names(theory: Theory) -> tuple[str, ...]:
    """The encodings that a theory needs, in the order to load them."""
    names = ["causal"]
    if theory.level == "topological":
        names += ["topological"]
        names += ["boundary"] if theory.boundary != "none" else []
        names += ["star"] if theory.star in ("pattern", "frame") else []
    return (*names, "preference", "show")


def theory_facts(theory: Theory, paths: int) -> str:
    """The axioms and the preference of a theory, and names for so many paths, as facts."""
    facts = [f"axiom({name})." for name in theory.axioms]
    facts += [f"path(1..{paths})."] if theory.level == "topological" else []
    facts += [f"prefer({count},{len(theory.priorities) - i})." for i, count in enumerate(theory.priorities)]
    facts += ["defeasible."] if theory.boundary == "defeasible" else []
    return "\n".join(facts)


def most_paths(trace: Trace, theory: Theory, steps: int) -> int:
    """The most paths that a map of the first steps can have: a path begins at the start, or where a turn right or left ends."""
    if theory.without:
        return steps
    return 1 + sum(action.turn in ("right", "left") for action in trace.actions[: steps - 1])


def trace_facts(trace: Trace, theory: Theory, start: int, stop: int) -> str:
    """What happened in steps `start` to `stop - 1`, and the links between them and from the step before, as facts."""
    facts = []
    for t in range(start, stop):
        step = trace.steps[t]
        assert step.view is not None
        facts.append(f"view({t},{_constant(step.view)}).")
        if theory.star in ("pattern", "frame"):
            facts += [f"open({t},{slot})." for slot, is_open in enumerate(step.openings or ()) if is_open]
    done = {t: trace.actions[t] for t in range(max(start - 1, 0), stop - 1)}
    facts += [f"act({t},{_constant(action.name)})." for t, action in done.items()]
    if theory.level == "topological":
        facts += [_kind_fact(action) for action in dict.fromkeys(done.values()) if action.kind is not None]
    return "\n".join(facts)


def program(trace: Trace, theory: Theory) -> str:
    """A trace and a resolved theory as the facts that `encodings/run.py` solves."""
    files = " ".join(f"{name}.lp" for name in encoding_names(theory))
    return "\n".join(
        [
            f"% {len(trace)} steps{f' of {trace.name!r}' if trace.name else ''}. In the folder of the encodings, run",
            f"%   python run.py --project=project --opt-mode=optN -n 0 THIS_FILE {files}",
            theory_facts(theory, most_paths(trace, theory, len(trace))),
            trace_facts(trace, theory, 0, len(trace)),
            "",
        ]
    )


def step_number(t: int) -> list[Symbol]:
    """The argument of the program parts of step t."""
    return [Number(t)]


def query(t: int) -> Symbol:
    """The external atom that makes t the last step."""
    return Function("query", [Number(t)])


def active(axiom: str, t: int) -> Symbol:
    """The atom of an explanation that makes an axiom hold at step t."""
    return Function("active", [Function(axiom), Number(t)])


def _constant(value: str | int) -> str:
    return str(Number(value) if isinstance(value, int) else String(value))


def _kind_fact(action: Action) -> str:
    return f"kind({_constant(action.name)},travel)." if action.kind == "travel" else f"turns({_constant(action.name)},{action.turn})."


def read_map(model: Model, trace: Trace, theory: Theory) -> SSHMap:
    """The map that an answer set describes, for the steps it speaks of."""
    is_at: dict[int, int] = {}
    place: dict[int, int] = {}
    course: dict[int, tuple[int, int]] = {}
    heading: dict[int, int] = {}
    before: list[tuple[int, int, int]] = []
    excused: list[tuple[int, int]] = []
    for symbol in model.symbols(shown=True):
        name, args = symbol.name, symbol.arguments
        if name == "is":
            is_at[args[0].number] = args[1].number
        elif name == "at":
            place[args[0].number] = args[1].number
        elif name == "along":
            course[args[0].number] = (args[1].number, _COURSE[args[2].name])
        elif name == "before":
            before.append((args[0].number, args[1].number, args[2].number))
        elif name == "heading":
            heading[args[0].number] = args[1].number
        elif name == "excused":
            excused.append((args[0].number, args[1].number))
    names = sorted(set(is_at.values()))
    dstate_of = {name: i for i, name in enumerate(names)}
    place_of = {name: i for i, name in enumerate(sorted({place[s] for s in names if s in place}))}
    path_of = {name: i for i, name in enumerate(sorted({course[s][0] for s in names if s in course}))}
    dstates = tuple(
        DState(
            id=dstate_of[s],
            view=_view(trace, s),
            place=place_of[place[s]] if s in place else None,
            path=path_of[course[s][0]] if s in course else None,
            direction=course[s][1] if s in course else None,
            heading=heading.get(s),
        )
        for s in names
    )
    labels = tuple(dstate_of[is_at[t]] for t in range(len(is_at)))
    pairs = [(path_of[h], place_of[p], place_of[q]) for h, p, q in before if h in path_of and p in place_of and q in place_of]
    return SSHMap(
        labels=labels,
        dstates=dstates,
        links=links_of(labels, trace),
        places=tuple(place_of.values()),
        paths=tuple(Path(h, _in_order(h, dstates, pairs)) for h in path_of.values()),
        excused=tuple(sorted((path_of[h], path_of[g]) for h, g in excused if h in path_of and g in path_of)),
    )


def name_facts(names: Iterable[tuple[int, int]], spares: Iterable[Sequence[int]], leads: Iterable[tuple[int, int, int]]) -> str:
    """Names with their views; for each view its spare names, the last for the rest; and where an action at a name can lead."""
    view_of = dict(names)
    leads = list(leads)
    facts = [f"view({name},{view})." for name, view in view_of.items()]
    for spare in spares:
        facts += [f"spare({name})." for name in spare] + [f"after({r},{s})." for r, s in pairwise(spare)] + [f"rest({spare[-1]})."]
    facts += [f"leads({s},{action},{x})." for s, action, x in leads]
    facts += [f"shows({s},{action},{view})." for s, action, view in {(s, action, view_of[x]) for s, action, x in leads}]
    return "\n".join(facts)


def batch_facts(
    batch: int,
    steps: Iterable[tuple[int, int, Sequence[int], int | None]],
    links: Iterable[tuple[int, int]],
    apart: Iterable[tuple[int, int]],
) -> str:
    """Steps, each with its view, the names it can be at, and the step of that view before it; links with their actions; and pairs that are apart."""
    facts = []
    for t, view, names, before in steps:
        facts.append(f"node({batch},{t},{view}).")
        facts += [f"may_be({t},{name})." for name in names]
        facts += [f"follows({before},{t})."] if before is not None and len(names) > 1 else []
    facts += [f"link({batch},{t},{action})." for t, action in links]
    facts += [f"apart({batch},{t},{u})." for t, u in apart]
    return "\n".join(facts)


def resting(batch: int) -> Symbol:
    """The atom that holds if a step of the batches up to this one is at the rest of its view. Assumed by who asks for such a map."""
    return Function("resting", [Number(batch)])


def read_names(model: Model) -> dict[int, int]:
    """The name of each step that an answer set of names.lp speaks of."""
    return {s.arguments[0].number: s.arguments[1].number for s in model.symbols(shown=True)}


def causal_map(labels: Sequence[int], trace: Trace) -> SSHMap:
    """The map of the causal level that these labels of the first steps make, dstates numbered by first visit."""
    number: dict[int, int] = {}
    first: list[int] = []
    for t, label in enumerate(labels):
        if number.setdefault(label, len(number)) == len(first):
            first.append(t)
    found = tuple(number[label] for label in labels)
    return SSHMap(found, tuple(DState(i, _view(trace, t)) for i, t in enumerate(first)), links_of(found, trace))


def links_of(labels: Sequence[int], trace: Trace) -> tuple[tuple[int, str, int], ...]:
    """The distinct links that a labelling of the trace's first steps makes, sorted."""
    return tuple(sorted({(s, action.name, x) for (s, x), action in zip(pairwise(labels), trace.actions, strict=False)}))


def _view(trace: Trace, step: int) -> str | int:
    view = trace.steps[step].view
    assert view is not None
    return view


def _in_order(path: int, dstates: Sequence[DState], before: Sequence[tuple[int, int, int]]) -> tuple[int, ...]:
    """The places on a path, each behind the ones that are before it: in a strict order it has more of those than they have."""
    on_path = {s.place for s in dstates if s.path == path and s.place is not None}
    behind = {p: sum(h == path and q == p and o in on_path for h, o, q in before) for p in on_path}
    return tuple(sorted(on_path, key=lambda p: (behind[p], p)))
