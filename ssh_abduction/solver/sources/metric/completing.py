"""Complete the dstates and places of a trace to a map: find its links, headings, paths and orders.

>>> from ssh_abduction import Theory, Trace
>>> from ssh_abduction.solver.sources.metric.completing import completed
>>> from ssh_abduction.theory.settle import settle
>>> trace = Trace.from_steps("abab", ["travel", "around", "travel"])
>>> theory = settle(trace, Theory(boundary="none")).theory
>>> ssh_map = completed(trace, theory, [0, 1, 2, 3], [0, 1, 1, 0], [0.0, 0.0, 3.14, 3.14])
>>> [path.order for path in ssh_map.paths]
[(0, 1)]

Two dstates are on one path only if the axioms say so: a travel or a turn around links them, or they
face opposite ways at one place. So the map has as many paths as possible. If this map contradicts
the axioms, most other maps with these dstates and places do, too. The places of a path are sorted
by its travels.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from graphlib import CycleError, TopologicalSorter
from itertools import combinations

from ssh_abduction.checker.checker import violations
from ssh_abduction.data import gateways
from ssh_abduction.data.gateways import Facing
from ssh_abduction.data.maps import DState, MapPath, SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.solver.asp.facts import views_of
from ssh_abduction.solver.steps.faults import with_changes
from ssh_abduction.theory.theory import Theory

# A path and one of its directions, 1 or -1.
_Course = tuple[int, int]


def completed(
    trace: Trace,
    theory: Theory,
    labels: Sequence[int],
    places: Sequence[int],
    facing: Sequence[float],
) -> SSHMap | None:
    """Complete dstates and places to a map. The caller has to check it.

    `labels` has the dstate of each step, and `places` the place of each dstate, which a causal
    theory ignores. `facing` has the heading of each dstate in radians, counterclockwise, for
    star=frame. Returns None in these cases: an action leads from one dstate to two, a path would be
    a circle, a dstate would face both directions of its path, or the stars fit no frames.
    """
    links: dict[tuple[int, str], int] = {}
    for here, action, there in zip(labels, trace.actions, labels[1:], strict=False):
        if not action.starts and links.setdefault((here, action.name), there) != there:
            return None
    views = views_of(dict(enumerate(labels)), trace)
    listed = tuple((s, action, x) for (s, action), x in links.items())
    if theory.level == "causal":
        dstates = tuple(DState(s, views[s]) for s in range(len(views)))
        return SSHMap(tuple(labels), dstates, listed).renumbered()
    dstates = tuple(DState(s, views[s], place=places[s]) for s in range(len(views)))
    bare = SSHMap(tuple(labels), dstates, listed, tuple(sorted(set(places))))
    if "travel_follows_path" not in theory.axioms:
        return bare.renumbered()
    # Headings need paths. Then opposite headings may join paths, so paths are found again.
    courses = _courses(bare, trace, theory, ())
    facing_of = None if courses is None else _facing(_on(bare, courses), trace, theory, facing)
    courses = _courses(bare, trace, theory, facing_of.opposite) if facing_of else None
    orders = (
        _orders(bare, trace, courses, facing_of.ends) if facing_of and courses is not None else None
    )
    if facing_of is None or courses is None or orders is None:
        return None
    found = replace(_on(bare, courses, facing_of.headings), paths=orders)
    if theory.star == "gateways":
        turned = gateways.with_allowed_headings(trace, found, theory.axioms, bool(theory.changed))
        return None if turned is None else turned.renumbered()
    return found.renumbered()


def valid_map(
    trace: Trace,
    theory: Theory,
    labels: Sequence[int],
    places: Sequence[int],
    facing: Sequence[float],
) -> SSHMap | None:
    """Complete a map as `completed` does, with its changed gateways; None if it breaks an axiom."""
    ssh_map = completed(trace, theory, labels, places, facing)
    found = None if ssh_map is None else with_changes(ssh_map, trace, theory)
    return None if found is None or next(violations(trace, found, theory), None) else found


def _on(
    ssh_map: SSHMap, courses: Mapping[int, _Course], headings: Mapping[int, int] | None = None
) -> SSHMap:
    """Return a map in which dstates have these paths, directions and headings; others have None."""
    dstates = []
    for s in ssh_map.dstates:
        path, direction = courses.get(s.id, (None, None))
        heading = (headings or {}).get(s.id)
        dstates.append(replace(s, path=path, direction=direction, heading=heading))
    return replace(ssh_map, dstates=tuple(dstates))


def _facing(
    ssh_map: SSHMap, trace: Trace, theory: Theory, facing: Sequence[float]
) -> Facing | None:
    """Find which way each dstate faces at its place, by the stars or by its heading in radians.

    Returns the slot of each dstate (the number of its direction in the frame of its place), and the
    pairs of dstates that face opposite ways; both are empty without frames. None if no frame fits.
    """
    if theory.star == "gateways":
        return gateways.facing(trace, ssh_map, theory.axioms, bool(theory.changed))
    found = Facing({}, [], [])
    if theory.star == "frame":
        first: dict[int | None, float] = {}
        for s in ssh_map.dstates:
            back = first.setdefault(s.place, facing[s.id]) - facing[s.id]
            found.headings[s.id] = round(back / (math.pi / 2)) % 4
        if not _fits_frames(ssh_map, trace, theory, found.headings):
            return None
        found.opposite.extend(
            (s.id, x.id)
            for s, x in combinations(ssh_map.dstates, 2)
            if s.place == x.place and (found.headings[s.id] + 2) % 4 == found.headings[x.id]
        )
    return found


def _fits_frames(
    ssh_map: SSHMap, trace: Trace, theory: Theory, headings: Mapping[int, int]
) -> bool:
    """Whether the dstates of each place have different headings, and their stars agree."""
    place = {s.id: s.place for s in ssh_map.dstates}
    if "one_dstate_per_heading" in theory.axioms:
        faced = {(place[s], heading) for s, heading in headings.items()}
        if len(faced) < len(headings):
            return False
    if theory.changed or "star_frame" not in theory.axioms:
        return True
    seen: dict[int | None, tuple[bool, ...]] = {}
    for label, step in zip(ssh_map.dstate_at, trace.steps, strict=True):
        if step.star is not None:
            star, back = step.openings or (), 4 - headings[label]
            turned = star[back:] + star[:back]  # slots begin with the first one of the place
            if seen.setdefault(place[label], turned) != turned:
                return False
    return True


def _courses(
    ssh_map: SSHMap, trace: Trace, theory: Theory, opposite: Sequence[tuple[int, int]]
) -> dict[int, _Course] | None:
    """Find the paths: follow travels, turns around and opposite dstates from each dstate.

    The pairs in `opposite` face opposite ways at one place. Returns the path and direction of each
    dstate that is on a path; None if some dstate would face both directions of its path.
    """
    actions = {action.name: action for action in trace.actions}
    travels = [(s, x) for s, name, x in ssh_map.links if actions[name].kind == "travel"]
    around = [(s, x) for s, name, x in ssh_map.links if actions[name].turn == "around"]
    founded = {s for pair in travels for s in pair}
    if theory.all_on_paths:
        founded = {s.id for s in ssh_map.dstates}
    # A turn around puts both of its dstates on a path if one of them is on a path.
    grows = True
    while grows:
        more = {s for pair in around if founded & set(pair) for s in pair} - founded
        founded |= more
        grows = bool(more)
    # Neighbours of a dstate on its path, with -1 if they face the other way.
    beside: dict[int, list[tuple[int, int]]] = defaultdict(list)
    for pairs, sign in ((travels, 1), (around, -1), (opposite, -1)):
        for s, x in pairs:
            beside[s].append((x, sign))
            beside[x].append((s, sign))
    courses: dict[int, _Course] = {}
    for path, start in enumerate(sorted(founded)):
        reached = [] if start in courses else [start]
        courses.setdefault(start, (path, 1))
        while reached:
            s = reached.pop()
            on, direction = courses[s]
            for x, sign in beside[s]:
                if x in founded and x not in courses:
                    courses[x] = (on, direction * sign)
                    reached.append(x)
                elif x in founded and courses[x] != (on, direction * sign):
                    return None
    return courses


def _orders(
    ssh_map: SSHMap, trace: Trace, courses: Mapping[int, _Course], ends: Sequence[tuple[int, int]]
) -> tuple[MapPath, ...] | None:
    """Sort the places of each path by its travels; None if a path would be a circle.

    `ends` come first or last: pairs (dstate, direction) say that the path of the dstate ends ahead
    of it (0) or behind it (180).
    """
    kinds = {action.name: action.kind for action in trace.actions}
    before: dict[int, dict[int, set[int]]] = defaultdict(dict)
    for s in ssh_map.dstates:
        if s.id in courses and s.place is not None:
            before[courses[s.id][0]].setdefault(s.place, set())
    place = {s.id: s.place or 0 for s in ssh_map.dstates}
    for here, name, there in ssh_map.links:
        if kinds[name] == "travel":
            path, direction = courses[here]
            first, second = (place[here], place[there])[::direction]
            before[path][second].add(first)
    # The place at an end comes before, or after, all other places of the path.
    for here, towards in ends:
        if here in courses:
            path, direction = courses[here]
            end, others = place[here], set(before[path])
            if (direction == 1) == (towards == 0):
                before[path][end] |= others - {end}
            else:
                for other in others - {end}:
                    before[path][other].add(end)
    try:
        return tuple(
            MapPath(path, tuple(TopologicalSorter(earlier).static_order()))
            for path, earlier in before.items()
        )
    except CycleError:
        return None
