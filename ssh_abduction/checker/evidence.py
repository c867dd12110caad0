"""Checks of the axioms about stars, pairs of steps, poses and planar drawings.

A star is the gateways seen at a step. Users may assert that two steps are the same or different.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from ssh_abduction.checker.crossings import Edges
from ssh_abduction.checker.reading import Found, MapLink, Reading, heading_of
from ssh_abduction.checker.stars import stars_of
from ssh_abduction.data.groups import minimal_part, parts
from ssh_abduction.data.odometry import Closure, Odometry, match_in_words
from ssh_abduction.data.star import Star

_LIFTS = ("lift", "stairs")


def floors_of(m: Reading) -> dict[int, int]:
    """For each dstate, find the first dstate on its floor.

    The dstates of a floor are connected by common places, and by links that are not lifts.
    """
    beside: dict[int, set[int]] = {s: set() for s in m.states}
    pairs = [(t.source.id, t.target.id) for t in m.moves if t.action.kind not in _LIFTS]
    for s in m.states.values():
        pairs += [
            (s.id, x.id) for x in m.states.values() if s.place is not None and s.place == x.place
        ]
    for one, other in pairs:
        beside[one].add(other)
        beside[other].add(one)
    in_order = sorted(beside, key=lambda label: m.first.get(label, len(m.trace)))
    floors = parts(in_order, beside.__getitem__)
    return {label: next(iter(floor)) for floor in floors for label in floor}


def other_floor(m: Reading) -> Found:
    """Check that the two ends of a lift are on different floors."""
    floor = m.once(floors_of)
    for t in m.moves:
        if t.action.kind in _LIFTS and floor[t.source.id] == floor[t.target.id]:
            yield (
                t.steps,
                f"{t} leads to another floor, but other links or places join both dstates.",
            )


def one_landing(m: Reading) -> Found:
    """Check that a lift leads from one place to one place."""
    landings: dict[tuple[int, str], MapLink] = {}
    for t in m.moves:
        if t.action.kind in _LIFTS and t.source.place is not None:
            other = landings.setdefault((t.source.place, t.action.name), t)
            if other.target.place != t.target.place:
                yield (
                    sorted({*other.steps, *t.steps}),
                    f"{other} and {t} lead from one place to places {other.target.place} and "
                    f"{t.target.place}.",
                )


def path_in_one_piece(m: Reading) -> Found:
    """Check that each path is on one floor, and in one piece of the map."""
    floor = m.once(floors_of)
    for h, there in m.along.items():
        first, *others = there.values()
        for s in others:
            if floor[s] != floor[first]:
                yield (
                    m.steps_of(first, s),
                    f"Dstates {first} and {s} are along path {h}, but no places and no links "
                    "without lifts connect them.",
                )
                break


def floors_are_listed(m: Reading) -> Found:
    """Check that a map lists the floors of all dstates, numbered by first visit, or of none."""
    listed = {s.id: s.floor for s in m.map.dstates}
    if not m.theory.lifts:
        if any(floor is not None for floor in listed.values()):
            yield [], "The map lists floors, but the trace has no lifts."
        return
    if all(floor is None for floor in listed.values()):
        return
    number: dict[int, int] = {}
    for i, s in m.visited:
        floor = number.setdefault(m.once(floors_of)[s.id], len(number))
        if listed.get(s.id) != floor:
            yield (
                [i],
                f"Dstate {s.id} is on floor {listed.get(s.id)} in the map, but its links and "
                f"places say floor {floor}.",
            )


def one_star(m: Reading) -> Found:
    """Check that all stars seen at a dstate show the same gateways, in the same directions."""
    seen: dict[int, dict[Star, int]] = {}
    for t, label, step in zip(m.steps, m.map.dstate_at, m.trace.steps, strict=False):
        stars, star = seen.setdefault(label, {}), step.gateways or Star(())
        for other, i in stars.items() if star not in stars else ():
            if not _may_show_the_same(other, star):
                yield (
                    [i, t],
                    f"Steps {i} and {t} are one dstate, {label}, but the gateways seen there are "
                    "not in the same directions.",
                )
        stars.setdefault(star, t)


def asserted(m: Reading) -> Found:
    """Check that the map satisfies each assertion of the theory about a pair of steps."""
    labels, theory = m.map.dstate_at, m.theory
    claims = [
        ("one dstate", theory.same),
        ("different dstates", theory.different),
        ("at different places", theory.elsewhere),
        ("at one place", theory.same_place),
    ]
    for said, (i, j) in (
        (said, [m.steps[t] for t in pair])
        for said, pairs in claims
        for pair in pairs
        if max(pair) < len(labels)
    ):
        # only steps that the map labels are compared
        here, there = labels[i], labels[j]
        places = {m.states[label].place for label in (here, there) if label in m.states}
        if said == "one dstate" and here != there:
            yield (
                [i, j],
                f"Steps {i} and {j} are dstates {here} and {there}, but are said to be one dstate.",
            )
        elif said == "at one place" and (len(places) > 1 or None in places):
            yield (
                [i, j],
                f"Steps {i} and {j} are at places {m.states[here].place} and "
                f"{m.states[there].place}, but are said to be {said}.",
            )
        elif said in ("different dstates", "at different places") and here == there:
            yield [i, j], f"Steps {i} and {j} are one dstate, {here}, but are said to be {said}."
        elif said == "at different places" and len(places) == 1 and None not in places:
            yield (
                [i, j],
                f"Steps {i} and {j} are at one place, {min(places, key=str)}, but are said to be "
                f"{said}.",
            )


def one_pose(m: Reading) -> Found:
    """Check that displacements agree with one pose per dstate and one position per place."""
    from ssh_abduction.checker.displacements import refused_returns  # loads numpy

    trusted = m.trace.without_displacements_at(
        [fault.step for fault in m.map.faults if fault.kind == "jumped"]
    )
    for refused in refused_returns(trusted, m.map, m.theory, m.since):
        said = " and ".join(
            f"steps {m.steps[i]} and {m.steps[j]} are at one "
            f"{'place' if freedom == 2 else 'dstate'}"
            for i, j, freedom in refused.returns
        )
        steps = [t for i, j, _ in refused.returns for t in (i, j)]
        yield (
            steps,
            f"By the displacements it cannot be that {said}: {refused} (chi-square "
            f"{refused.square:.0f}, and at most {refused.most:.0f} is allowed).",
        )


def closure(m: Reading) -> Found:
    """Check that closures agree with one pose per dstate and one position per place.

    A closure is a measured displacement between two steps of the trace.
    """
    labels, odometry = m.map.dstate_at, m.trace.odometry or Odometry()
    for match in m.trace.closures:
        i, j = match.first, match.last
        if j >= len(labels):
            continue
        named = m.steps[i], m.steps[j]
        here, there = (m.states.get(labels[step]) for step in (i, j))
        for freedom, kind, is_one in (
            (3, "dstate", labels[i] == labels[j]),
            (2, "place", here and there and here.place is not None and here.place == there.place),
        ):
            if is_one and _p_value(match, odometry, freedom) < m.theory.reject / max(
                m.theory.returns, 1
            ):
                yield (
                    [i, j],
                    f"Steps {named[0]} and {named[1]} are at one {kind}, but "
                    f"{match_in_words(match, *named)} and a turn of "
                    f"{math.degrees(match.displacement[2]):.0f} degrees.",
                )


def _p_value(match: Closure, odometry: Odometry, freedom: int) -> float:
    """Compute the p-value of a closure if its two steps have equal poses, or equal positions.

    `freedom` is 3 for poses and 2 for positions.
    """
    import numpy as np
    from scipy.special import chdtrc  # scipy.stats has the same, and loads for half a second

    spreads = np.array([odometry.offset, odometry.offset, odometry.facing])
    total = np.array(match.covariance) + np.diag(2 * spreads * spreads)
    x, y, turned = match.displacement
    off = np.array([x, y, math.remainder(turned, math.tau)])[:freedom]
    square = off @ np.linalg.inv(total[:freedom, :freedom]) @ off
    return float(chdtrc(freedom, square))


def planar(m: Reading) -> Found:
    """Check that the map can be drawn in the plane without a crossing.

    In the drawing, right turns must lead to the right.
    """
    place_of = {s.id: s.place for s in m.states.values() if s.place is not None}
    headings = {s: heading for s in place_of if (heading := heading_of(m.states[s])) is not None}
    turns = [
        (t.source.id, t.action.turn, t.target.id)
        for t in m.turns
        if t.action.turn and {t.source.id, t.target.id} <= place_of.keys()
    ]
    stars = (
        {s: [star for state, star, _ in stars_of(m) if state.id == s] for s in place_of}
        if "star_frame" in m.axioms
        else {}
    )

    def cross(travels: Sequence[MapLink]) -> bool:
        edges = Edges([(t.source.id, t.target.id) for t in travels], turns, place_of)
        if m.theory.star != "frame":
            return not edges.can_be_drawn(crossing=m.theory.symmetric_sides)
        if headings.keys() == place_of.keys() and edges.can_be_drawn_by(headings):
            return False
        turned = {"turn_rotates", "one_heading"} <= m.axioms
        distinct = "one_dstate_per_heading" in m.axioms
        return not edges.can_be_drawn_in_frames(stars, turned=turned, distinct=distinct)

    kept = [t for t in m.travels if {t.source.id, t.target.id} <= place_of.keys()]
    if not cross(kept):
        return
    # report only travels that are needed for the crossing
    kept = [] if cross([]) else minimal_part(cross, kept)
    ways = ", ".join(f"{t.source.place} to {t.target.place} (step {t.step})" for t in kept)
    yield (
        [step for t in kept for step in t.steps],
        "In every drawing, paths cross where there is no place. These travels follow the paths: "
        f"from place {ways}.",
    )


def _may_show_the_same(one: Star, other: Star) -> bool:
    """Tell whether two stars may show the same gateways, seen by a robot that has not turned.

    To test this, pair gateways of one star with gateways of the other. The bearings of a pair may
    differ by at most the sum of their spreads. Each gateway that is seen open must be in a pair.
    """
    import numpy as np
    from scipy.optimize import linear_sum_assignment

    bearings, spreads, seen = (
        [np.array([getattr(g, name) for g in star.gateways], dtype=float) for star in (one, other)]
        for name in ("bearing", "spread", "open")
    )
    seen = [np.nan_to_num(row) for row in seen]  # not observed (None) becomes 0
    off = np.abs((bearings[0][:, None] - bearings[1] + 180) % 360 - 180)
    near = off <= spreads[0][:, None] + spreads[1]
    taken_in = np.where(near, seen[0][:, None] + seen[1], 0)
    return bool(
        taken_in[linear_sum_assignment(taken_in, maximize=True)].sum()
        == sum(row.sum() for row in seen)
    )
