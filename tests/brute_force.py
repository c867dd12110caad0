"""Find every map of a tiny trace (up to seven observations) by trying all. This is slow, plain, and
independent of the encodings and the checker.

>>> from ssh_abduction import Theory, Trace
>>> trace = Trace.from_steps("aaa", ["travel", "travel"])
>>> counts, keys = minimal_maps(trace, Theory.topological())
>>> counts
Counts(dstates=3, paths=1, places=3, excuses=0)
>>> keys
{((0, 1, 2), (0, 1, 2), ((0, 1), (0, 1), (0, 1)))}

A map is an equality of the steps, a place of every dstate, and a course (path and direction), or
none, of every dstate. Orders, sides, headings and excused pairs of paths are witnesses: they have
to exist, but do not tell two maps apart. A trace has to have views; a topological theory also needs
the kinds of the actions. `one_place` and `one_course` always hold, even if the theory leaves them
out.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import combinations, pairwise, permutations, product
from typing import NamedTuple, TypeAlias

import numpy as np
from axiom_files import predicates
from brute_geometry import Geometry
from scipy.special import chdtri

from ssh_abduction.data.drives import drives_of
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.odometry import Odometry
from ssh_abduction.data.star import Gateway, Openings, Star
from ssh_abduction.data.trace import Action, Step, Trace
from ssh_abduction.theory.settle import settle
from ssh_abduction.theory.theory import Theory

Labels: TypeAlias = tuple[int, ...]
Places: TypeAlias = tuple[int | None, ...]
Course: TypeAlias = tuple[int, int]
Courses: TypeAlias = tuple[Course | None, ...]
Key: TypeAlias = tuple[Labels, Places, Courses]
Link: TypeAlias = tuple[int, Action, int]
Order: TypeAlias = frozenset[tuple[int, int]]  # (p, q): p comes before q in direction +1
Branch: TypeAlias = tuple[
    int, int, int, int, int
]  # (p, h, d, h', d'): at p, (h', d') leaves to the right of (h, d)
Axioms: TypeAlias = frozenset[str]
Named: TypeAlias = tuple[
    int, float, float
]  # a gateway: its number in the star, its bearing and its spread, in degrees
LITTLE = 1e-6  # the error of sums of bearings, in degrees
WHOLE = 1 - LITTLE  # angles that differ by less than this are possible in whole degrees

SLOTS = (0, 1, 2, 3)
QUARTERS = {"right": 1, "around": 2, "left": 3}


class Counts(NamedTuple):
    """The numbers that a theory may minimise."""

    dstates: int
    paths: int
    places: int
    excuses: int


def partitions(size: int) -> Iterator[Labels]:
    """All ways to divide things into groups: the group of each, numbered by first member."""
    if size == 0:
        yield ()
        return
    for labels in partitions(size - 1):
        for last in range(max(labels, default=-1) + 2):
            yield (*labels, last)


def divisions(size: int) -> Iterator[list[list[int]]]:
    """All ways to divide things into groups: the members of each group."""
    for labels in partitions(size):
        groups = range(max(labels, default=-1) + 1)
        yield [[i for i, label in enumerate(labels) if label == group] for group in groups]


def key(ssh_map: SSHMap) -> Key:
    """A map without its witnesses. Dstates, places and paths are numbered by first visit. At its
    first step a path is faced in direction +1."""
    by_id = {s.id: s for s in ssh_map.dstates}
    visited = [by_id[s] for s in dict.fromkeys(ssh_map.dstate_at)]
    labels = {s.id: i for i, s in enumerate(visited)}
    places: dict[int, int] = {}
    paths: dict[int, Course] = {}
    for s in visited:
        if s.place is not None:
            places.setdefault(s.place, len(places))
        if s.path is not None and s.direction is not None:
            paths.setdefault(s.path, (len(paths), s.direction))
    return (
        tuple(labels[s] for s in ssh_map.dstate_at),
        tuple(None if s.place is None else places[s.place] for s in visited),
        tuple(
            None
            if s.path is None or s.direction is None
            else (paths[s.path][0], s.direction * paths[s.path][1])
            for s in visited
        ),
    )


def minimal_maps(
    trace: Trace, theory: Theory, allows: Callable[[Key], bool] = lambda _: True
) -> tuple[Counts | None, set[Key]]:
    """The counts and the keys of the minimal maps by `theory.priorities`; (None, empty) if there is
    no map.

    `allows` tells whether a map satisfies an axiom that the brute force does not know.

    The maps agree in the counts that the theory minimises. The other counts are those of one of
    them.
    """
    best: tuple[int, ...] | None = None
    counts: Counts | None = None
    keys: set[Key] = set()
    for found, its_counts in consistent_maps(trace, theory):
        if not allows(found):
            continue
        cost = tuple(getattr(its_counts, name) for name in theory.priorities)
        if best is None or cost < best:
            best, counts, keys = cost, its_counts, set()
        if cost == best:
            keys.add(found)
    return counts, keys


def near_minimal_maps(
    trace: Trace, theory: Theory, within: int, allows: Callable[[Key], bool] = lambda _: True
) -> dict[tuple[int, ...], set[Key]]:
    """The best maps for each number of dstates, by cost. `theory.priorities` says which are best.

    A map may have up to `within` dstates more than minimal maps. If the theory prefers few paths or
    places first, these are counted instead of dstates. If it prefers none of these, the number is
    the same for all maps.
    """
    counted = next((name for name in theory.priorities if name != "excuses"), None)
    best: dict[int, tuple[tuple[int, ...], set[Key]]] = {}  # by that number
    for found, its_counts in consistent_maps(trace, theory):
        if allows(found):
            cost = tuple(getattr(its_counts, name) for name in theory.priorities)
            number = getattr(its_counts, counted) if counted else 0
            known = best.setdefault(number, (cost, set()))
            if cost < known[0]:
                best[number] = known = cost, set()
            if cost == known[0]:
                known[1].add(found)
    least = min(((cost, number) for number, (cost, _) in best.items()), default=((), 0))[1]
    return {
        cost: keys
        for number, (cost, keys) in sorted(best.items())
        if least <= number <= least + within
    }


def consistent_maps(trace: Trace, theory: Theory) -> Iterator[tuple[Key, Counts]]:
    """Yield every map that satisfies the axioms, once, with its counts. Of excuses it has the
    fewest that make it consistent."""
    theory = settle(trace, theory).theory
    on = frozenset(theory.axioms)
    defeasible = theory.boundary == "defeasible"
    stars = tuple(step.openings if theory.star in ("pattern", "frame") else None for step in trace)
    geometry = Geometry(trace, theory) if "one_pose" in on else None
    further = [allows for name, allows in predicates().items() if name in on]
    for labels in _labellings(trace, on):
        if "asserted" in on and not _as_asserted(labels, None, theory):
            continue
        if geometry and not geometry.allows(labels, None):
            continue
        if "one_star" in on and not _stars_alike(trace, labels):
            continue
        if "closure" in on and not _closures_agree(trace, theory, labels, 3):
            continue
        if "other_floor" in on and not _lifts_lead_away(trace, labels, labels):
            continue
        dstates = max(labels) + 1
        if theory.level == "causal":
            found: Key = (labels, (None,) * dstates, (None,) * dstates)
            if all(allows(trace, theory, found) for allows in further):
                yield found, Counts(dstates, 0, 0, 0)
            continue
        links = frozenset(
            (s, action, x)
            for s, action, x in zip(labels, trace.actions, labels[1:], strict=False)
            if action.kind != "start"  # nothing links two drives
        )
        for places in _placings(labels, links, stars, on):
            if "asserted" in on and not _as_asserted(labels, places, theory):
                continue
            if geometry and not geometry.allows(labels, places):
                continue
            where = [places[label] for label in labels]
            if "closure" in on and not _closures_agree(trace, theory, where, 2):
                continue
            if "other_floor" in on and not _lifts_lead_away(trace, labels, where):
                continue
            if "one_landing" in on and not _lifts_land_once(trace, where):
                continue
            headings = (
                list(_headings(labels, places, trace.actions, stars, on))
                if theory.star == "frame"
                else []
            )
            if theory.star == "frame" and not headings:
                continue
            if "planar" in on and not _is_planar(labels, places, links, headings, theory):
                continue
            for courses in _courses(places, links, on):
                if "path_in_one_piece" in on and not _paths_stay(trace, labels, places, courses):
                    continue
                if not all(allows(trace, theory, (labels, places, courses)) for allows in further):
                    continue
                if headings and not any(
                    _goes_straight(labels, places, courses, h, on) for h in headings
                ):
                    continue
                if theory.star == "gateways" and not _gateways_agree(
                    trace, labels, places, courses, on
                ):
                    continue
                ends = (
                    partial(_gateways_agree, trace, labels, places, courses, on)
                    if "gateway_end" in on
                    else None
                )
                excuses = _least_excuses(places, courses, links, on, defeasible, ends)
                if excuses is not None:
                    paths = len({course[0] for course in courses if course})
                    yield (
                        (labels, places, courses),
                        Counts(dstates, paths, len(set(places)), excuses),
                    )


def _as_asserted(labels: Labels, places: tuple[int, ...] | None, theory: Theory) -> bool:
    """Whether dstates and places (if given) agree with the theory's assertions on steps."""
    there = [
        [(i, j) for i, j in pairs if j < len(labels)]
        for pairs in (theory.same, theory.different, theory.elsewhere, theory.same_place)
    ]
    same, different, elsewhere, same_place = there
    return (
        all(labels[i] == labels[j] for i, j in same)
        and all(labels[i] != labels[j] for i, j in different + elsewhere)
        and (places is None or all(places[labels[i]] != places[labels[j]] for i, j in elsewhere))
        and (places is None or all(places[labels[i]] == places[labels[j]] for i, j in same_place))
    )


def _lifts_lead_away(trace: Trace, labels: Labels, where: Sequence[int]) -> bool:
    """Whether the floors of the steps differ at each lift."""
    floor = _floors(trace, labels, where)
    lifts = [t for t, action in enumerate(trace.actions) if action.kind in ("lift", "stairs")]
    return all(floor[t] != floor[t + 1] for t in lifts)


def _lifts_land_once(trace: Trace, where: Sequence[int]) -> bool:
    """Whether each lift leads from one place to one place."""
    lifts = [t for t, action in enumerate(trace.actions) if action.kind in ("lift", "stairs")]
    landings = {(where[t], trace.actions[t].name, where[t + 1]) for t in lifts}
    return len({(place, name) for place, name, _ in landings}) == len(landings)


def _paths_stay(trace: Trace, labels: Labels, places: tuple[int, ...], courses: Courses) -> bool:
    """Whether all steps along a path are on one floor."""
    floor = _floors(trace, labels, [places[label] for label in labels])
    along = [courses[label] for label in labels]
    return all(
        floor[i] == floor[j]
        for i, one in enumerate(along)
        for j, other in enumerate(along)
        if one and other and one[0] == other[0]
    )


def _floors(trace: Trace, labels: Labels, where: Sequence[int]) -> list[int]:
    """The floor of each step: steps are merged until nothing changes."""
    floor = list(range(len(labels)))
    pairs = [(i, j) for j in range(len(labels)) for i in range(j)]
    joined = [(i, j) for i, j in pairs if labels[i] == labels[j] or where[i] == where[j]]
    joined += [
        (t, t + 1)
        for t, action in enumerate(trace.actions)
        if action.kind not in ("lift", "stairs", "start")
    ]
    for _ in floor:
        for i, j in joined:
            floor[i] = floor[j] = min(floor[i], floor[j])
    return floor


def _stars_alike(trace: Trace, labels: Labels) -> bool:
    """Whether the stars of each dstate show the same gateways, by trying all ways to pair them."""

    def alike(one: tuple[Gateway, ...], other: tuple[Gateway, ...]) -> bool:
        if not one:
            return not any(gateway.open for gateway in other)
        first, *rest = one
        near = [
            k
            for k, g in enumerate(other)
            if _off(first.bearing, g.bearing) <= first.spread + g.spread
        ]
        paired = any(alike(tuple(rest), other[:k] + other[k + 1 :]) for k in near)
        return paired or (not first.open and alike(tuple(rest), other))

    stars = [step.gateways.gateways if step.gateways else () for step in trace.steps]
    return all(
        alike(stars[i], stars[t])
        for t in range(len(labels))
        for i in range(t)
        if labels[i] == labels[t]
    )


# --- dstates: which steps are equal


def _labellings(trace: Trace, on: Axioms) -> Iterator[Labels]:
    """The equalities of the steps: the dstate of each step, numbered by first visit."""
    views, actions = trace.views, [a.name for a in trace.actions]
    starts = {t for t, action in enumerate(trace.actions, 1) if action.kind == "start"}

    def allowed(labels: Labels) -> bool:
        last = len(labels) - 1
        for i in range(last):
            # C1: a dstate has one view. An unknown view may be any view.
            if (
                "functional_view" in on
                and labels[i] == labels[last]
                and len({views[i], views[last]} - {None}) > 1
            ):
                return False
            # C2: the same action done in the same dstate leads to the same dstate.
            same_start = (
                i > 0
                and labels[i - 1] == labels[last - 1]
                and actions[i - 1] == actions[last - 1]
                and not {i, last} & starts
            )
            if "deterministic" in on and same_start and labels[i] != labels[last]:
                return False
        return True

    def extend(labels: Labels) -> Iterator[Labels]:
        if len(labels) == len(trace):
            yield labels
            return
        for label in range(max(labels, default=-1) + 2):
            if allowed((*labels, label)):
                yield from extend((*labels, label))

    return extend(())


# --- places: which dstates are at the same place


def _placings(
    labels: Labels, links: frozenset[Link], stars: tuple[Openings | None, ...], on: Axioms
) -> Iterator[tuple[int, ...]]:
    """The place of each dstate, numbered by first visit."""
    dstates = max(labels) + 1

    def allowed(places: tuple[int, ...]) -> bool:
        for s, action, t in links:
            if max(s, t) == len(places) - 1:
                # T2: a turn stays.
                if "turn_stays" in on and action.kind == "turn" and places[s] != places[t]:
                    return False
                # T3: a travel leaves.
                if "travel_leaves" in on and action.kind == "travel" and places[s] == places[t]:
                    return False
        # Stars seen at a place are rotations of each other.
        seen = {
            star
            for label, star in zip(labels, stars, strict=True)
            if star and label < len(places) and places[label] == places[-1]
        }
        return "star_pattern" not in on or all(_rotated(a, b) for a, b in combinations(seen, 2))

    def extend(places: tuple[int, ...]) -> Iterator[tuple[int, ...]]:
        if len(places) == dstates:
            yield places
            return
        for place in range(max(places, default=-1) + 2):
            if allowed((*places, place)):
                yield from extend((*places, place))

    return extend(())


def _rotated(a: Openings, b: Openings) -> bool:
    return any(a[k:] + a[:k] == b for k in SLOTS)


# --- headings: the slot of the place's frame that is faced at each step


def _headings(
    labels: Labels,
    places: tuple[int, ...],
    actions: tuple[Action, ...],
    stars: tuple[Openings | None, ...],
    on: Axioms,
) -> Iterator[tuple[int, ...]]:
    """The headings that fit turns and stars.

    At the first step at a place it is 0: this chooses the place's frame.
    """
    at = [places[label] for label in labels]

    def slots(step: int, heading: int) -> set[int]:
        """The open slots of the place by the star of a step. Opening j from ahead is slot heading +
        j."""
        star = stars[step]
        assert star is not None
        return {(heading + j) % 4 for j in SLOTS if star[j]}

    def allowed(headings: tuple[int, ...]) -> bool:
        last = len(headings) - 1
        turn = actions[last - 1].turn if last else None
        # Headings at two places are in two frames: without turn_stays a turn may lead from one to
        # the other.
        stays = last and at[last - 1] == at[last]
        if (
            "turn_rotates" in on
            and turn
            and stays
            and headings[last] != (headings[last - 1] + QUARTERS[turn]) % 4
        ):
            return False
        for i in range(last):
            if "one_heading" in on and labels[i] == labels[last] and headings[i] != headings[last]:
                return False
            if at[i] != at[last]:
                continue
            if (
                "one_dstate_per_heading" in on
                and headings[i] == headings[last]
                and labels[i] != labels[last]
            ):
                return False
            if "star_frame" in on and slots(i, headings[i]) != slots(last, headings[last]):
                return False
        return True

    def extend(headings: tuple[int, ...]) -> Iterator[tuple[int, ...]]:
        if len(headings) == len(labels):
            yield headings
            return
        for heading in SLOTS if at[len(headings)] in at[: len(headings)] else (0,):
            if allowed((*headings, heading)):
                yield from extend((*headings, heading))

    return extend(())


def _goes_straight(
    labels: Labels, places: tuple[int, ...], courses: Courses, headings: tuple[int, ...], on: Axioms
) -> bool:
    """A path leaves a place by two opposite slots. A slot belongs to one path and direction."""
    if "path_goes_straight" not in on:
        return True
    through: dict[tuple[int, int], set[Course]] = defaultdict(set)
    slots: dict[tuple[int, Course], set[int]] = defaultdict(set)
    for label, heading in zip(labels, headings, strict=True):
        if course := courses[label]:
            path, direction = course
            for slot, leaving in (
                (heading, (path, direction)),
                ((heading + 2) % 4, (path, -direction)),
            ):
                through[places[label], slot].add(leaving)
                slots[places[label], leaving].add(slot)
    return all(len(x) == 1 for x in through.values()) and all(len(x) == 1 for x in slots.values())


# --- gateways: places with any number of them, in any directions, by trying every rotation


def _gateways_agree(
    trace: Trace,
    labels: Labels,
    places: tuple[int, ...],
    courses: Courses,
    on: Axioms,
    orders: dict[int, Order] | None = None,
) -> bool:
    """Whether the gateways at each place can be named so that all stars agree after a rotation by
    whole degrees, and that paths lead on through them in these orders."""
    at = [places[label] for label in labels]
    onward: list[set[int]] = [set() for _ in labels]
    for t, label in enumerate(labels):
        if orders and (course := courses[label]):
            path, direction = course
            later, sooner = (
                any(a == at[t] for a, _ in orders[path]),
                any(b == at[t] for _, b in orders[path]),
            )
            ahead, behind = (later, sooner) if direction == 1 else (sooner, later)
            onward[t] = {way for way, goes_on in ((0, ahead), (180, behind)) if goes_on}
    return all(
        _named(
            [t for t in range(len(labels)) if at[t] == place], trace, labels, courses, on, onward
        )
        for place in set(at)
    )


def _named(
    steps: list[int],
    trace: Trace,
    labels: Labels,
    courses: Courses,
    on: Axioms,
    onward: list[set[int]],
) -> bool:
    """Whether the stars of some steps at one place have readings with one clockwise order of
    gateways. A reading gives the bearing of each gateway of the place."""

    def extend(chosen: dict[int, tuple[Named, ...]]) -> bool:
        if len(chosen) == len(steps):
            return True
        step = steps[len(chosen)]
        for reading in _readings(trace.steps[step]):
            bent = _way_on(reading, Star.of(trace.steps[step].star or ()).gateways)
            if not bent and not all(
                any(_off(b, way) <= 2 * d + LITTLE for _, b, d in reading) for way in onward[step]
            ):
                continue
            for k in range(max(len(reading), 1)) if chosen else (0,):
                turned = reading[k:] + reading[:k]
                if all(
                    _agree(i, before, step, turned, trace, labels, courses, on)
                    for i, before in chosen.items()
                ) and extend({**chosen, step: turned}):
                    return True
        return False

    return extend({})


def fewest_gateway_changes(
    trace: Trace, labels: Labels, places: tuple[int, ...], courses: Courses, on: Axioms
) -> int | None:
    """The fewest gateways that differ between drives, over all readings; None if there are none.

    At most two differ between two drives at a place. Paths may end anywhere.
    """
    at = [places[label] for label in labels]
    total = 0
    for place in set(at):
        steps = [t for t in range(len(labels)) if at[t] == place]
        counts = list(_counts_of_changes(steps, trace, labels, courses, on))
        if not counts:
            return None
        total += min(counts)
    return total


def _counts_of_changes(
    steps: list[int], trace: Trace, labels: Labels, courses: Courses, on: Axioms
) -> Iterator[int]:
    """Yield the number of changes at a place for each reading of its steps."""
    drive = {t: k for k, d in enumerate(drives_of(trace)) for t in range(d.first, d.stop)}

    def extend(chosen: dict[int, tuple[Named, ...]]) -> Iterator[int]:
        shut = {drive[i]: {k for k, g in enumerate(seen) if g[0] < 0} for i, seen in chosen.items()}
        if len(chosen) == len(steps):
            counts = [len(a ^ b) for a, b in pairwise(shut[d] for d in sorted(shut))]
            if max(counts, default=0) <= 2:
                yield sum(counts)
            return
        step = steps[len(chosen)]
        for reading in {r for plain in _readings(trace.steps[step]) for r in _with_closed(plain)}:
            for k in range(max(len(reading), 1)) if chosen else (0,):
                turned = reading[k:] + reading[:k]
                here = {j for j, g in enumerate(turned) if g[0] < 0}
                if shut.get(drive[step], here) == here and all(
                    _agree(
                        i, seen, step, turned, trace, labels, courses, on, drive[i] == drive[step]
                    )
                    for i, seen in chosen.items()
                ):
                    yield from extend({**chosen, step: turned})

    return extend({})


def _with_closed(reading: tuple[Named, ...]) -> Iterator[tuple[Named, ...]]:
    """A reading with up to two closed gateways, in any direction, anywhere between the others."""
    closed: Named = (-1, 0, 180)
    yield reading
    for k in range(max(len(reading), 1)):
        one = (*reading[: k + 1], closed, *reading[k + 1 :])
        yield one
        for j in range(max(len(reading), 1)):
            yield (*one[: j + 1], closed, *one[j + 1 :])


def _readings(step: Step) -> list[tuple[Named, ...]]:
    """The possible gateways of a star, clockwise from ahead: (number in the star, bearing, spread).

    A gateway that was not observed may exist or not."""
    star = step.gateways
    gateways = star.gateways if star else ()
    found = []
    for seen in product(*[(True,) if g.open else (True, False) for g in gateways]):
        kept = [
            (k, g.bearing % 360, g.spread)
            for k, (g, there) in enumerate(zip(gateways, seen, strict=True))
            if there
        ]
        found.append(
            tuple(
                sorted(kept, key=lambda g: (gateways[g[0]].bearing + gateways[g[0]].spread) % 360)
            )
        )
    return found


def _off(a: float, b: float) -> float:
    return abs((a - b + 180) % 360 - 180)


def _agree(
    i: int,
    seen_i: tuple[Named, ...],
    t: int,
    seen_t: tuple[Named, ...],
    trace: Trace,
    labels: Labels,
    courses: Courses,
    on: Axioms,
    one_drive: bool = True,
) -> bool:
    """Whether these readings of steps i < t fit one place. Closed gateways have the number -1."""
    stars = [Star.of(trace.steps[step].star or ()).gateways for step in (i, t)]
    rotations: set[int] = set()
    if len(seen_i) == len(seen_t):
        rotations = {
            r
            for r in range(360)
            if all(
                _off(b, c + r) < d + e + WHOLE
                for (_, b, d), (_, c, e) in zip(seen_i, seen_t, strict=True)
            )
        }
        both = [(a[0], b[0]) for a, b in zip(seen_i, seen_t, strict=True)]
        pairs = {(j, k) for j, k in both if j >= 0 and k >= 0}
        for j, k in pairs:
            there = [(stars[0][j].opposite, stars[1][k].opposite)]
            known = [
                (a, b)
                for a, b in there
                if a in {g[0] for g in seen_i} and b in {g[0] for g in seen_t}
            ]
            if any(pair not in pairs for pair in known):
                rotations = set()
    if "gateway_frame" in on and not rotations:
        return False
    alike, both_i, both_t = seen_i == seen_t, seen_i, seen_t
    seen_i, seen_t = (tuple(g for g in seen if g[0] >= 0) for seen in (seen_i, seen_t))
    if (
        "gateway_turn" in on
        and t == i + 1
        and trace.actions[i].kind == "turn"
        and not rotations & _turn(trace.actions[i], seen_i, stars[0])
    ):
        return False
    facing = {}
    for way, degrees in (("same", 0), ("reverse", 180)):
        ways = [_way_on(seen, star) for seen, star in zip((seen_i, seen_t), stars, strict=True)]
        declared = False
        if rotations and ways[0] and ways[1]:
            now = ways[1][0] if way == "same" else ways[1][1]
            declared = (ways[0][0], now) in pairs and (
                way == "same" or (ways[0][0], ways[1][0]) not in pairs
            )
        fits = bool(rotations) and all(
            _off(b, c + degrees) <= d + e + LITTLE
            for (_, b, d), (_, c, e) in zip(both_i, both_t, strict=True)
        )
        facing[way] = fits or declared, (fits and not rotations & {90, 270}) or declared
    one = labels[i] == labels[t]
    if "gateway_heading" in on and one:
        if not facing["same"][0]:
            return False
        if one_drive and stars[0] == stars[1] and not alike:
            return False
    if "gateway_dstate" in on and facing["same"][1] and not one:
        return False
    a, b = courses[labels[i]], courses[labels[t]]
    if "gateway_path" not in on or a is None or b is None:
        return True
    same, reverse = a == b, b == (a[0], -a[1])
    must = (same or not facing["same"][1]) and (reverse or not facing["reverse"][1])
    return must and (facing["same"][0] or not same) and (facing["reverse"][0] or not reverse)


def _turn(action: Action, seen: tuple[Named, ...], star: tuple[Gateway, ...]) -> set[int]:
    """The rotations that a turn may be."""
    if action.bearing is not None:
        return {r for r in range(360) if _off(r, round(action.bearing)) <= 10}
    if action.gateway is not None:
        beside = sorted((b, d) for _, b, d in seen if _off(b, 0) > d + LITTLE)
        if action.turn == "left":
            beside.reverse()
        if action.gateway > len(beside):
            return set()
        bearing, spread = beside[action.gateway - 1]
        return {r for r in range(360) if _off(r, bearing) < spread + WHOLE}
    by_number = {k: (b, d) for k, b, d in seen}
    behind: set[int] = set()
    if action.turn == "around":
        faced = [k for k, b, d in seen if _off(b, 0) <= d + LITTLE][:1]
        behind = {
            r
            for k in faced
            if star[k].opposite in by_number
            for b, d in [by_number[star[k].opposite]]
            for r in range(360)
            if _off(r, b) < d + WHOLE
        }
    return {"around": {180} | behind, "right": set(range(21, 160)), "left": set(range(201, 340))}[
        str(action.turn)
    ]


def _way_on(seen: tuple[Named, ...], star: tuple[Gateway, ...]) -> tuple[int, int] | None:
    """The gateways ahead and behind, by their numbers in the star, where a path bends through
    gateways that are declared opposite."""
    by_number = {k: (b, d) for k, b, d in seen}
    for k, bearing, spread in sorted(
        seen, key=lambda g: (star[g[0]].bearing + star[g[0]].spread) % 360
    ):
        other = star[k].opposite
        if other in by_number and (
            _off(bearing, 0) <= spread + LITTLE
            or _off(by_number[other][0], 180) <= by_number[other][1] + LITTLE
        ):
            return k, other
    return None


# --- courses: which dstates are along which path, and which way


def _courses(places: tuple[int, ...], links: frozenset[Link], on: Axioms) -> Iterator[Courses]:
    """The course of each dstate.

    None, or a path and a direction, numbered by first visit and +1 there.
    """
    supported = _supported(links)

    def allowed(courses: Courses) -> bool:
        last = len(courses) - 1
        course = courses[last]
        # T5tot: every dstate is along a path.
        if "all_on_paths" in on and course is None:
            return False
        # T5: a course comes from a travel.
        if "course_needs_travel" in on and course is not None and last not in supported:
            return False
        # T8: one dstate for each place, path and direction.
        if (
            "one_dstate_per_course" in on
            and course is not None
            and (places[last], course) in zip(places[:last], courses[:last], strict=True)
        ):
            return False
        return all(
            _link_allowed(courses[s], action, courses[t], on)
            for s, action, t in links
            if max(s, t) == last
        )

    def extend(courses: Courses) -> Iterator[Courses]:
        if len(courses) == len(places):
            yield courses
            return
        paths = len({course[0] for course in courses if course})
        for course in (None, *product(range(paths), (1, -1)), (paths, 1)):
            if allowed((*courses, course)):
                yield from extend((*courses, course))

    return extend(())


def _link_allowed(start: Course | None, action: Action, end: Course | None, on: Axioms) -> bool:
    # T4: a travel follows one path in one direction.
    if "travel_follows_path" in on and action.kind == "travel" and (start is None or start != end):
        return False
    # T6: a turn around keeps the path and reverses the direction.
    reversed_end = None if end is None else (end[0], -end[1])
    if "turn_around_reverses" in on and action.turn == "around" and start != reversed_end:
        return False
    # T7: a turn right or left changes the path, where both ends are along paths.
    changes = action.turn in ("right", "left")
    return not (
        "turn_changes_path" in on
        and changes
        and start is not None
        and end is not None
        and start[0] == end[0]
    )


def _supported(links: frozenset[Link]) -> set[int]:
    """The dstates at which a travel starts or ends, and those that turns around link to them."""
    found = {
        s for source, action, target in links if action.kind == "travel" for s in (source, target)
    }
    around = [{source, target} for source, action, target in links if action.turn == "around"]
    while more := {s for pair in around if pair & found for s in pair} - found:
        found |= more
    return found


# --- orders and sides: whether there are witnesses


def _least_excuses(
    places: tuple[int, ...],
    courses: Courses,
    links: frozenset[Link],
    on: Axioms,
    defeasible: bool,
    ends: Callable[[dict[int, Order]], bool] | None,
) -> int | None:
    """The fewest pairs of paths to excuse from B2, over all orders of the paths that `ends` allows;
    None if no order is consistent."""
    paths = sorted({course[0] for course in courses if course})
    on_path = {
        h: {p for p, c in zip(places, courses, strict=True) if c and c[0] == h}
        if "on_path" in on
        else set()
        for h in paths
    }
    travels = [  # (p, q, h, d): a travel led from p to q along path h in direction d
        (places[s], places[t], *course)
        for s, action, t in links
        if action.kind == "travel"
        and (course := courses[s])
        and course == courses[t]
        and places[s] != places[t]
    ]
    branches = _branches(places, courses, links, on)
    before: dict[int, set[tuple[int, int]]] = {h: set() for h in paths}
    if "travel_orders" in on:
        for p, q, h, d in travels:
            before[h].add((p, q) if d == 1 else (q, p))
    choices = []
    for h in paths:
        own = [travel for travel in travels if travel[2] == h]
        choices.append(
            [
                o
                for o in _orders(on_path[h], frozenset(before[h]), on)
                if "next_place" not in on or _goes_to_next(own, o)
            ]
        )
    pairs = (
        {frozenset((h, h1)) for _, h, _, h1, _ in branches}
        if defeasible and "side_of_branch" in on
        else set()
    )
    for excuses in range(len(pairs) + 1):
        for orders in product(*choices):
            for excused in combinations(pairs, excuses):
                order = dict(zip(paths, orders, strict=True))
                if _sides_allowed(branches, order, on_path, excused, on) and (
                    ends is None or ends(order)
                ):
                    return excuses
    return None


def _orders(places: set[int], before: Order, on: Axioms) -> Iterator[Order]:
    """The least order that contains `before`; with path_order_total, every total order.

    Fewer pairs never break an axiom.
    """
    if "order_transitive" in on:
        while more := {(p, r) for p, q in before for q1, r in before if q == q1} - before:
            before |= more
    if "order_asymmetric" in on and any((q, p) in before for p, q in before):
        return
    if "path_order_total" in on:
        for p, q in combinations(sorted(places), 2):
            if (p, q) not in before and (q, p) not in before:
                yield from _orders(places, before | {(p, q)}, on)
                yield from _orders(places, before | {(q, p)}, on)
                return
    yield before


def _goes_to_next(travels: list[tuple[int, int, int, int]], order: Order) -> bool:
    """ADJ: no place lies strictly between the ends of a travel."""
    for p, q, _, d in travels:
        first, last = (p, q) if d == 1 else (q, p)
        if any(
            (first, r) in order and (r, last) in order
            for r in {place for pair in order for place in pair} - {p, q}
        ):
            return False
    return True


def _branches(
    places: tuple[int, ...], courses: Courses, links: frozenset[Link], on: Axioms
) -> set[Branch]:
    """B1: each branch of a path to the right or left of another path."""
    if "branch_side" not in on:
        return set()
    found: set[Branch] = set()
    for s, action, t in links:
        start, end = courses[s], courses[t]
        if start is None or end is None or action.turn not in ("right", "left"):
            continue
        if (
            start[0] == end[0]
        ):  # a branch is another path; without turn_changes_path a turn may lead to the same one
            continue
        (h, d), (h1, d1) = start, end
        branch = (places[s], h, d if action.turn == "right" else -d, h1, d1)
        found.add(branch)
        if "symmetric_sides" in on:
            p, h, d, h1, d1 = branch
            found |= {(p, h, -d, h1, -d1), (p, h1, d1, h, -d), (p, h1, -d1, h, d)}
    return found


def _sides_allowed(
    branches: set[Branch],
    orders: dict[int, Order],
    on_path: dict[int, set[int]],
    excused: tuple[frozenset[int], ...],
    on: Axioms,
) -> bool:
    right: set[tuple[int, int, int]] = set()  # (q, h, d): q lies to the right of (h, d)
    for p, h, d, h1, d1 in branches:
        # B2: the places ahead on a branch to the right lie to the right.
        if "side_of_branch" in on and frozenset((h, h1)) not in excused:
            ahead = (
                {b for a, b in orders[h1] if a == p}
                if d1 == 1
                else {a for a, b in orders[h1] if b == p}
            )
            right |= {(q, h, d) for q in ahead}
    for q, h, d in right:
        # B3: right and left are disjoint; left of (h, d) is right of (h, -d).
        if "sides_disjoint" in on and (q, h, -d) in right:
            return False
        # B4: no place on a path lies to its right or left.
        if "path_between_sides" in on and q in on_path[h]:
            return False
    return True


# --- closures: whether none of them is far off between steps at one dstate, or at one place


def _closures_agree(
    trace: Trace, theory: Theory, labels: Sequence[int | None], freedom: int
) -> bool:
    """freedom  3 where the labels are dstates, 2 where they are places"""
    odometry = trace.odometry or Odometry()
    most = chdtri(freedom, theory.reject / max(theory.returns, 1))
    for closure in trace.closures:
        if labels[closure.first] != labels[closure.last]:
            continue
        x, y, turned = closure.displacement
        off = np.array([x, y, math.remainder(turned, 2 * math.pi)])
        noise = np.array(closure.covariance)
        for k, spread in enumerate((odometry.offset, odometry.offset, odometry.facing)):
            noise[k, k] += 2 * spread**2
        one = slice(0, freedom)
        if off[one] @ np.linalg.solve(noise[one, one], off[one]) > most:
            return False
    return True


# --- planarity: whether some orders of the edges around the places make a drawing without crossings

Edge: TypeAlias = frozenset[
    tuple[int, object]
]  # the gateways at its ends: a place, and a slot or an arm; one where it comes back to its gateway


def _is_planar(
    labels: Labels,
    places: tuple[int, ...],
    links: frozenset[Link],
    headings: list[tuple[int, ...]],
    theory: Theory,
) -> bool:
    """Whether the edges that travels lead along can be drawn.

    By headings if places have frames; otherwise by sides.
    """
    travels = {(s, t) for s, action, t in links if action.kind == "travel"}
    if theory.star == "frame":
        for heading in headings:
            facing = dict(zip(labels, heading, strict=True))
            edges = {
                frozenset({(places[s], facing[s]), (places[t], (facing[t] + 2) % 4)})
                for s, t in travels
            }
            if _is_drawing(edges, dict.fromkeys(places, SLOTS)):
                return True
        return False
    supported = _supported(
        frozenset(
            link for link in links if link[1].kind == "travel" or places[link[0]] == places[link[2]]
        )
    )
    arms = {(s, side): (s, side) for s in supported for side in (1, -1)}

    def merge(one: tuple[int, int], other: tuple[int, int]) -> None:
        """Make two arms one, and also the arms opposite to them."""
        for turned in (1, -1):
            old, new = arms[one[0], turned * one[1]], arms[other[0], turned * other[1]]
            arms.update({arm: new for arm, of in arms.items() if of == old})

    for s, action, t in links:
        if action.turn == "around" and s in supported and places[s] == places[t]:
            merge((s, 1), (t, -1))
    beyond = [pair for s, t in travels for pair in (((s, 1), (t, -1)), ((t, -1), (s, 1)))]
    for _ in arms:  # gateways that one gateway leads to are one
        for (one, other), (here, there) in product(beyond, repeat=2):
            if arms[one] == arms[here]:
                if places[other[0]] != places[there[0]]:
                    return False
                merge(other, there)
    edges = {frozenset({(places[s], arms[s, 1]), (places[t], arms[t, -1])}) for s, t in travels}
    rounds: list[set[tuple[object, ...]]] = []
    for p in sorted(set(places)):
        told: list[list[tuple[int, int]]] = []  # arms one after another, clockwise
        for s, action, t in links:
            if (
                action.turn in ("right", "left")
                and places[s] == places[t] == p
                and {s, t} <= supported
            ):
                right, left = ((t, 1), (t, -1)) if action.turn == "right" else ((t, -1), (t, 1))
                ends = [(s, 1), right, (s, -1), left]
                told.append([arms[end] for end in ends if theory.symmetric_sides or end != (t, -1)])
        here = sorted({arms[s, side] for s in supported if places[s] == p for side in (1, -1)})
        used = {arm for edge in edges for q, arm in edge if q == p}
        good = [
            order
            for order in permutations(here)
            if order[:1] == tuple(here[:1]) and all(_clockwise(order, ends) for ends in told)
        ]
        rounds.append({tuple(arm for arm in order if arm in used) for order in good})
    return any(
        _is_drawing(edges, dict(zip(sorted(set(places)), choice, strict=True)))
        for choice in product(*rounds)
    )


def _clockwise(order: tuple[object, ...], ends: list[tuple[int, int]]) -> bool:
    """Whether these arms are different and follow each other within one round."""
    start = order.index(ends[0])
    turned = [(order.index(end) - start) % len(order) for end in ends]
    return len(set(turned)) == len(ends) and turned == sorted(turned)


def _is_drawing(edges: set[Edge], rounds: dict[int, tuple[object, ...]]) -> bool:
    """Whether each gateway has one edge, and V - E + F = 2 for each connected part.

    `rounds` has the gateways around each place, clockwise.
    """
    numbered = [sorted(edge, key=repr) for edge in edges]
    ends = {(i, k): edge[k % len(edge)] for i, edge in enumerate(numbered) for k in (0, 1)}
    if any(
        edges_there > 1
        for edges_there in Counter(gateway for edge in edges for gateway in edge).values()
    ):
        return False
    places = {p for p, _ in ends.values()}
    after: dict[tuple[int, int], tuple[int, int]] = {}
    for p in places:
        around = [end for g in rounds[p] for end in ends if ends[end] == (p, g)]
        after.update(zip(around, around[1:] + around[:1], strict=True))
    assert set(after) == set(ends)
    faces = _orbits({end: after[end[0], 1 - end[1]] for end in ends})
    part = {p: p for p in places}
    for i in range(len(numbered)):
        one, other = part[ends[i, 0][0]], part[ends[i, 1][0]]
        part = {p: other if q == one else q for p, q in part.items()}
    return len(places) - len(numbered) + faces == 2 * len(set(part.values()))


def _orbits(following: dict[tuple[int, int], tuple[int, int]]) -> int:
    orbits = set()
    for end in following:
        orbit = [end]
        while following[orbit[-1]] != end:
            orbit.append(following[orbit[-1]])
        orbits.add(frozenset(orbit))
    return len(orbits)
