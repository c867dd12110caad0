"""Make maps from answer sets of any encoding, and from labels (the dstate of each step)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from clingo import Model

from ssh_abduction.data.groups import numbered
from ssh_abduction.data.maps import FAULTS, DState, MapPath, SSHMap
from ssh_abduction.data.trace import Trace, View
from ssh_abduction.solver.asp.facts.atoms import read_atom
from ssh_abduction.solver.steps import frames
from ssh_abduction.solver.steps.faults import faults_of, links_of, with_changes
from ssh_abduction.theory.theory import Theory

CAUSAL = Theory.causal()


def read_map(model: Model, trace: Trace, theory: Theory) -> SSHMap:
    """Make a map from an answer set of the readable encodings, perhaps of the first steps only."""
    is_at: dict[int, int] = {}
    place: dict[int, int] = {}
    course: dict[int, tuple[int, int]] = {}
    heading: dict[int, int] = {}
    shape: dict[int, int] = {}
    before: list[tuple[int, int, int]] = []
    excused: list[tuple[int, int]] = []
    faults: list[tuple[int, str]] = []
    for name, args in map(read_atom, model.symbols(shown=True)):
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
        found = frames.Frames(trace, len(is_at), changes=bool(theory.changed)).frames
        heading = {
            t: frames.heading(found[shape[p]], found[shape[t]], heading[t])
            for t, p in place.items()
        }
    read = _map(trace, is_at, place, course, heading, before, excused, faults, theory)
    return with_changes(read, trace, theory) or read


def read_steps(model: Model) -> tuple[tuple[int, ...], tuple[int | None, ...]]:
    """Read the dstate and the place (or None) of each step from an answer that may break axioms."""
    found: dict[str, dict[int, int]] = {"is": {}, "at": {}}
    for name, args in map(read_atom, model.symbols(shown=True)):
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
    excused: Iterable[tuple[int, int]],
    faults: Sequence[tuple[int, str]],
    theory: Theory,
) -> SSHMap:
    """Make a map from the atoms of an answer, which name a dstate or place by its first step.

    `course` has the path and the direction of each step that is along a path. `heading` has the
    heading of each step, if places have frames or gateways. `before` has triples of a path and two
    places on it, the earlier one first. The theory has the costs of faults.
    """
    # Atoms name things by steps. A map numbers them from 0, in the order of these names.
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
        dstate_at=labels,
        dstates=dstates,
        links=links_of(labels, trace, faults),
        places=tuple(place_of.values()),
        paths=_paths(len(path_of), dstates, pairs),
        excused=tuple(
            sorted((path_of[h], path_of[g]) for h, g in excused if h in path_of and g in path_of)
        ),
        faults=faults_of(faults, is_at, views, trace, theory),
    )


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


def _paths(
    count: int, dstates: Iterable[DState], before: Iterable[tuple[int, int, int]]
) -> tuple[MapPath, ...]:
    """Make paths from triples of a path and two of its places, the earlier place first."""
    on: list[set[int]] = [set() for _ in range(count)]
    for s in dstates:
        if s.path is not None and s.place is not None:
            on[s.path].add(s.place)
    pairs: list[list[tuple[int, int]]] = [[] for _ in range(count)]
    for path, p, q in before:
        if p in on[path] and q in on[path]:
            pairs[path].append((p, q))
    return tuple(
        MapPath(path, tuple(places_in_order(found, pairs[path]))) for path, found in enumerate(on)
    )


def places_in_order(places: Iterable[int], before: Iterable[tuple[int, int]]) -> list[int]:
    """Sort places by a strict order: `before` has all pairs of places, the earlier one first."""
    behind = dict.fromkeys(places, 0)
    for _, q in before:
        behind[q] += 1
    return sorted(behind, key=lambda p: (behind[p], p))
