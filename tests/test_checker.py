"""Checker: accepts maps made by hand, names broken axioms, and counts the maps of tiny traces."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import permutations, product

import numpy as np
import pytest
from axiom_files import of_each
from brute_force import partitions
from hypothesis import given, settings
from hypothesis import strategies as st
from worlds import written

from ssh_abduction.checker.checker import AXIOMS, COHERENCE, Violation, check
from ssh_abduction.data.maps import DState, MapPath, SSHMap
from ssh_abduction.data.odometry import Closure
from ssh_abduction.data.trace import Trace
from ssh_abduction.theory import encodings
from ssh_abduction.theory.settle import settle
from ssh_abduction.theory.theory import Theory

ALL_OPEN = (1, 1, 1, 1)
TOPOLOGICAL = Theory.topological()
NO_SIDES = TOPOLOGICAL.replace(boundary="none")
GATEWAYS = TOPOLOGICAL.replace(star="gateways")
ONE_SIDE = TOPOLOGICAL.replace(symmetric_sides=False)


def links(trace: Trace, labels: tuple[int, ...]) -> tuple[tuple[int, str, int], ...]:
    names = [a.name for a in trace.actions]
    return tuple(dict.fromkeys(zip(labels, names, labels[1:], strict=False)))


def chart(
    trace: Trace,
    labels: str,
    states: str,
    orders: str = "",
    excused: tuple[tuple[int, int], ...] = (),
) -> SSHMap:
    """A map from its labels, a word for each dstate, and a word for each path.

    The word of a dstate is `place[:path±][^heading]`. The word of a path is its places, or `-` if
    it lists none.
    """
    steps = tuple(map(int, labels.split()))
    dstates = []
    for i, word in enumerate(states.split()):
        rest, _, heading = word.partition("^")
        place, _, course = rest.partition(":")
        dstates.append(
            DState(
                i,
                trace.views[steps.index(i)],
                None if place == "." else int(place),
                int(course[:-1]) if course else None,
                {"+": 1, "-": -1, "?": None}[course[-1]] if course else None,
                int(heading) if heading else None,
            )
        )
    places = tuple(range(1 + max((s.place for s in dstates if s.place is not None), default=-1)))
    paths = tuple(
        MapPath(i, () if word == "-" else tuple(map(int, word)))
        for i, word in enumerate(orders.split())
    )
    return SSHMap(steps, tuple(dstates), links(trace, steps), places, paths, excused)


def names(violations: tuple[Violation, ...]) -> set[str]:
    return {v.axiom for v in violations}


@dataclass(frozen=True)
class Case:
    """A map of a trace. `also` names axioms that break together with that of the case."""

    theory: Theory
    trace: Trace
    map: SSHMap
    also: frozenset[str] = frozenset()

    def check(self, theory: Theory | None = None) -> tuple[Violation, ...]:
        return check(self.trace, self.map, theory or self.theory)


def case(theory: Theory, trace: Trace, *spec: str, also: str = "") -> Case:
    return Case(theory, trace, chart(trace, *spec), frozenset(also.split()))


# A closed notched rectangle: path 0 is the side that leads back to the first corner, for dstate 0
# faces along it.
NOTCHED = written("v0 R v1 T v2 R v3 T " * 2 + "v0")
NOTCHED_TWICE = written("v0 R v1 T v2 R v3 T " * 4 + "v0")
RECTANGLE = ("0:0+ 0:1+ 1:1+ 1:2+ 2:2+ 2:3+ 3:3+ 3:0+", "30 01 12 23")
CORRIDOR = written("a T b A c T d A a")
STARRED = written(
    "a T b A c T d A a", [(1, 0, 0, 0), (0, 0, 1, 0), (1, 0, 0, 0), (0, 0, 1, 0), (1, 0, 0, 0)]
)
HALF = written("v0 R v1 T v2 R v3 T v0")
LENS = ("0 1 2 3 4", "0 0:0+ 1:0+ 1:1+ 0:1+", "01 10")
FORK = written("a T b A c T d")

CORRECT = {
    "notched rectangle, one circuit": case(TOPOLOGICAL, NOTCHED, "0 1 2 3 4 5 6 7 0", *RECTANGLE),
    "notched rectangle, two circuits": case(
        TOPOLOGICAL, NOTCHED_TWICE, "0 1 2 3 4 5 6 7 0 1 2 3 4 5 6 7 0", *RECTANGLE
    ),
    "notched rectangle, next place": case(
        TOPOLOGICAL.replace(next_place=True), NOTCHED, "0 1 2 3 4 5 6 7 0", *RECTANGLE
    ),
    "notched rectangle, all on paths": case(
        TOPOLOGICAL.replace(all_on_paths=True), NOTCHED, "0 1 2 3 4 5 6 7 0", *RECTANGLE
    ),
    "notched rectangle, never closed": case(
        TOPOLOGICAL,
        NOTCHED,
        "0 1 2 3 4 5 6 7 8",
        "0 0:0+ 1:0+ 1:1+ 2:1+ 2:2+ 3:2+ 3:3+ 4:3+",
        "01 12 23 34",
    ),
    "notched rectangle, fourth side taken for the first": case(
        TOPOLOGICAL,
        NOTCHED,
        "0 1 2 3 4 5 6 7 8",
        "0 0:0+ 1:0+ 1:1+ 2:1+ 2:2+ 3:2+ 3:0+ 4:0+",
        "3401 12 23",
    ),
    "notched rectangle without sides": case(
        NO_SIDES, HALF, "0 1 2 3 0", "0:0+ 0:1+ 1:1+ 1:0+", "10 01"
    ),
    "corridor out and back": case(TOPOLOGICAL, CORRIDOR, "0 1 2 3 0", "0:0+ 1:0+ 1:0- 0:0-", "01"),
    "corridor with frames": case(
        TOPOLOGICAL, STARRED, "0 1 2 3 0", "0:0+^0 1:0+^0 1:0-^2 0:0-^2", "01"
    ),
    "corridor with patterns": case(
        TOPOLOGICAL.replace(star="pattern"), STARRED, "0 1 2 3 0", "0:0+ 1:0+ 1:0- 0:0-", "01"
    ),
    "corridor, stars not looked at": case(
        TOPOLOGICAL.replace(star="none"), STARRED, "0 1 2 3 0", "0:0+ 1:0+ 1:0- 0:0-", "01"
    ),
    "causal": case(Theory.causal(), CORRIDOR, "0 1 2 3 0", ". . . ."),
    "causal, aliased": case(Theory.causal(), HALF, "0 1 2 3 0", ". . . ."),
    "spin": case(TOPOLOGICAL, written("a R b R c R d R a"), "0 1 2 3 0", "0 0 0 0"),
    "spin with frame": case(
        TOPOLOGICAL, written("a R b R c R d R a", [ALL_OPEN] * 5), "0 1 2 3 0", "0^0 0^1 0^2 0^3"
    ),
    "fork, partial": case(
        TOPOLOGICAL.replace(path_order="partial"), FORK, "0 1 2 3", "0:0+ 1:0+ 1:0- 2:0-", "021"
    ),
    "fork, partial, other list": case(
        TOPOLOGICAL.replace(path_order="partial"), FORK, "0 1 2 3", "0:0+ 1:0+ 1:0- 2:0-", "201"
    ),
    "fork, partial, nothing between": case(
        TOPOLOGICAL.replace(path_order="partial", next_place=True),
        FORK,
        "0 1 2 3",
        "0:0+ 1:0+ 1:0- 2:0-",
        "021",
    ),
    "lens, excused": Case(
        TOPOLOGICAL.replace(boundary="defeasible"), HALF, chart(HALF, *LENS, excused=((0, 1),))
    ),
    "lens, excused the other way round": Case(
        TOPOLOGICAL.replace(boundary="defeasible"), HALF, chart(HALF, *LENS, excused=((1, 0),))
    ),
    "one step": case(TOPOLOGICAL, written("a"), "0", "0"),
}

SPUN = replace(
    written("a R a"),
    steps=tuple(
        replace(s, displacement=(0, 0, -1.5) if t else None) for t, s in enumerate(written("a R a"))
    ),
)
SHIFTED = replace(
    written("a R a"), closures=(Closure(0, 1, (2, 0, 0), tuple(map(tuple, np.eye(3) * 0.01))),)
)
BROKEN = {
    "one_pose": case(TOPOLOGICAL, SPUN, "0 0", "0"),
    "closure": case(TOPOLOGICAL, SHIFTED, "0 0", "0"),
    "other_floor": case(TOPOLOGICAL, written("a U b"), "0 1", "0 0"),
    "one_landing": case(
        TOPOLOGICAL, written("a U b T f S a R c U f"), "0 1 2 0 3 2", "0 1:0+ 2:0+ 0", "12"
    ),
    "path_in_one_piece": case(
        TOPOLOGICAL, written("a T b U c T d"), "0 1 2 3", "0:0+ 1:0+ 2:0+ 3:0+", "0123"
    ),
    "one_star": case(
        Theory.causal().replace(star="alike"), written("a R a", [(0, 90), (0, 120)]), "0 0", "."
    ),
    "asserted": case(TOPOLOGICAL.replace(different=[(0, 2)]), written("a R a R a"), "0 0 0", "0"),
    # After turning back, past the place before.
    "planar": case(
        TOPOLOGICAL.replace(planar=True),
        written("a T b T c A d T e"),
        "0 1 2 3 4",
        "0:0+ 1:0+ 2:0+ 2:0- 0:0-",
        "012",
    ),
    "functional_view": case(TOPOLOGICAL, written("a R b"), "0 0", "0"),
    "deterministic": case(TOPOLOGICAL, written("a R b R a R c"), "0 1 0 2", "0 0 0"),
    "one_place": case(TOPOLOGICAL, written("a"), "0", "."),
    "turn_stays": case(TOPOLOGICAL, written("a R b"), "0 1", "0 1"),
    "travel_leaves": case(TOPOLOGICAL, written("a T a"), "0 0", "0:0+", "0"),
    "travel_follows_path": case(TOPOLOGICAL, written("a T b"), "0 1", "0 1:0+", "1"),
    "one_course": case(TOPOLOGICAL, written("a"), "0", "0:0?", "-"),
    "turn_around_reverses": case(TOPOLOGICAL, written("a T b A c"), "0 1 2", "0:0+ 1:0+ 1", "01"),
    "turn_changes_path": case(
        NO_SIDES, written("a T b R c T d"), "0 1 2 3", "0:0+ 1:0+ 1:0- 2:0-", "021"
    ),
    "one_dstate_per_course": case(
        TOPOLOGICAL, written("a T b A c A d"), "0 1 2 3", "0:0+ 1:0+ 1:0- 1:0+", "01"
    ),
    "on_path": case(NO_SIDES, written("a T b R c T d"), "0 1 2 3", "0:0+ 1:0+ 1:1+ 2:1+", "012 12"),
    "travel_orders": case(TOPOLOGICAL, written("a T b"), "0 1", "0:0+ 1:0+", "10"),
    "order_asymmetric": case(
        TOPOLOGICAL, written("a T b T a"), "0 1 0", "0:0+ 1:0+", "01", also="travel_orders"
    ),
    "order_transitive": case(
        TOPOLOGICAL,
        written("a T b T c T a"),
        "0 1 2 0",
        "0:0+ 1:0+ 2:0+",
        "012",
        also="travel_orders order_asymmetric",
    ),
    "path_order_total": case(
        TOPOLOGICAL, FORK, "0 1 2 3", "0:0+ 1:0+ 1:0- 2:0-", "01", also="on_path"
    ),
    "next_place": case(
        TOPOLOGICAL.replace(next_place=True), FORK, "0 1 2 3", "0:0+ 1:0+ 1:0- 2:0-", "021"
    ),
    "all_on_paths": case(TOPOLOGICAL.replace(all_on_paths=True), written("a"), "0", "0"),
    "course_needs_travel": case(TOPOLOGICAL, written("a"), "0", "0:0+", "0"),
    "branch_side": case(ONE_SIDE, HALF, *LENS, also="side_of_branch path_between_sides"),
    "side_of_branch": case(ONE_SIDE, HALF, *LENS, also="branch_side path_between_sides"),
    "path_between_sides": case(ONE_SIDE, HALF, *LENS, also="branch_side side_of_branch"),
    # Back through the crossing, to a place that is behind on both paths.
    "symmetric_sides": case(
        TOPOLOGICAL,
        written("a T b R c T d A e T f T g"),
        "0 1 2 3 4 5 6",
        "0:0+ 1:0+ 1:1+ 2:1+ 2:1- 1:1- 0:1-",
        "01 012",
        also="branch_side side_of_branch path_between_sides",
    ),
    # Place 2 is reached by leaving path 0 to the right at place 1, and to the left at place 3.
    "sides_disjoint": case(
        ONE_SIDE,
        written("a T b R c T d A e T f R b T g L h T i"),
        "0 1 2 3 4 5 1 6 7 8",
        "0:0+ 1:0+ 1:1+ 2:1+ 2:1- 1:1- 3:0+ 3:2+ 2:2+",
        "013 12 32",
        also="branch_side side_of_branch",
    ),
    "star_pattern": case(
        TOPOLOGICAL.replace(star="pattern"),
        written("a R b", [(1, 0, 0, 0), (1, 1, 0, 0)]),
        "0 1",
        "0 0",
    ),
    "star_frame": case(
        TOPOLOGICAL, written("a R b", [(1, 0, 0, 0), (1, 0, 0, 0)]), "0 1", "0^0 0^1"
    ),
    "one_heading": case(TOPOLOGICAL, written("a", [ALL_OPEN]), "0", "0"),
    "turn_rotates": case(TOPOLOGICAL, written("a R b", [ALL_OPEN] * 2), "0 1", "0^0 0^2"),
    "one_dstate_per_heading": case(
        TOPOLOGICAL,
        written("a R b R c R d R e", [ALL_OPEN] * 5),
        "0 1 2 3 4",
        "0^0 0^1 0^2 0^3 0^0",
    ),
    # Two right turns, but the way back is taken for another path.
    "path_goes_straight": case(
        TOPOLOGICAL,
        written("a T b R c R d T e", [ALL_OPEN] * 5),
        "0 1 2 3 4",
        "0:0+^0 1:0+^0 1^1 1:1+^2 2:1+^0",
        "01 12",
    ),
    # Round a triangle: place 0 has a gateway less when it is seen again.
    "gateway_frame": case(
        GATEWAYS,
        written(
            "a T b R c T d R e T f", [(0, 60), (180, 120), (0, 60), (180, 120), (0, 60), (180,)]
        ),
        "0 1 2 3 4 5",
        "0:0+^0 1:0+^0 1:1+^120 2:1+^0 2:2+^120 0:2+^240",
        "01 12 20",
    ),
    "gateway_heading": case(GATEWAYS, written("a", [(0, 120)]), "0", "0"),
    "gateway_turn": case(GATEWAYS, written("a L b", [(0, 120), (0, 240)]), "0 1", "0^0 0^120"),
    "gateway_dstate": case(
        GATEWAYS,
        written("a R b L c", [(0, 120), (0, 240), (0, 120)]),
        "0 1 2",
        "0^0 0^120 0^0",
        also="gateway_frame",
    ),
    "gateway_path": case(
        GATEWAYS,
        written("a T b R c R d T e", [(0,), (70, 180), (0, 110), (0, 250), (180,)]),
        "0 1 2 3 4",
        "0:0+^0 1:0+^0 1^70 1:1+^180 2:1+^0",
        "01 12",
        also="gateway_frame",
    ),
    "gateway_end": case(
        GATEWAYS,
        written("a T b T c", [(0,), (180,), (180,)]),
        "0 1 2",
        "0:0+^0 1:0+^0 2:0+^0",
        "012",
    ),
    **{
        name: case(theory, written(text), *spec)
        for name, (theory, text, *spec) in of_each("BROKEN").items()
    },
}
HIDDEN = (
    "branch_side",
    "symmetric_sides",
    "side_of_branch",
    "order_asymmetric",
    "order_transitive",
)
AXIOM_NAMES = [a.name for a in encodings.axioms()]


@pytest.mark.parametrize("name", CORRECT)
def test_correct_maps_satisfy_every_axiom(name: str) -> None:
    assert CORRECT[name].check() == ()


def test_topological_is_the_default_theory() -> None:
    closed = CORRECT["notched rectangle, one circuit"]
    assert check(closed.trace, closed.map) == ()
    assert names(check(HALF, chart(HALF, *LENS))) == {
        "branch_side",
        "symmetric_sides",
        "side_of_branch",
        "path_between_sides",
    }


def test_every_axiom_has_a_check() -> None:
    assert list(AXIOMS) == AXIOM_NAMES


def test_verdict_on_a_map_does_not_depend_on_earlier_maps() -> None:
    """Dstates that differ only in their heading are equal, but fit other gateways."""
    of_gateways = [name for name in AXIOM_NAMES if name.startswith("gateway")]
    for name in (*of_gateways, *reversed(of_gateways)):
        assert names(BROKEN[name].check()) == {name} | BROKEN[name].also


@pytest.mark.parametrize("name", AXIOM_NAMES)
def test_checker_names_the_axiom_that_a_map_breaks(name: str) -> None:
    broken = BROKEN[name]
    found = broken.check()
    assert names(found) == {name} | broken.also
    for violation in found:
        assert violation.message.endswith(".")
        assert violation.steps == tuple(sorted(set(violation.steps)))
        assert set(violation.steps) <= set(range(len(broken.trace)))
    assert any(v.steps for v in found)


@pytest.mark.parametrize("name", AXIOM_NAMES)
def test_checker_ignores_an_axiom_that_is_left_out(name: str) -> None:
    broken = BROKEN[name]
    found = broken.check(broken.theory.replace(without=(name,)))
    assert names(found) <= broken.also
    if not broken.also or name in HIDDEN:
        assert found == ()


@pytest.mark.parametrize("left_out", ["travel_orders", "order_asymmetric", "order_transitive"])
def test_circular_path_is_allowed_without_one_order_axiom(left_out: str) -> None:
    assert BROKEN["order_transitive"].check(TOPOLOGICAL.replace(without=(left_out,))) == ()


@pytest.mark.parametrize("order", ["partial", "total"])
def test_circular_path_is_refused_in_total_and_partial_order(order: str) -> None:
    found = BROKEN["order_transitive"].check(TOPOLOGICAL.replace(path_order=order))
    assert names(found) == {"travel_orders", "order_asymmetric", "order_transitive"}
    assert {v.steps for v in found if v.axiom == "order_transitive"} == {(0, 1, 2, 3)}


def test_checker_message_names_the_witness_steps() -> None:
    (violation,) = BROKEN["deterministic"].check()
    message = "'right' in dstate 0 leads to dstate 1 at step 0, and to dstate 2 at step 2."
    assert violation == Violation("deterministic", (0, 1, 2, 3), message)


@pytest.mark.parametrize("listed", ["021", "201"])
@pytest.mark.parametrize("order", ["partial", "total"])
def test_partial_order_follows_from_travels_only(order: str, listed: str) -> None:
    """A turn at place 2 leads onto path 0 in direction -.

    Place 0 is ahead there only if the list decides, and not a travel.
    """
    trace = written("a T b A c T d R e T f A g T h T i A j T e T f A g T h R d")
    states = "0:0+ 1:0+ 1:0- 2:0- 2:1+ 3:1+ 3:1- 2:1- 0:1- 0:1+"
    forked = case(
        ONE_SIDE.replace(path_order=order),
        trace,
        "0 1 2 3 4 5 6 7 8 9 4 5 6 7 3",
        states,
        f"{listed} 023",
    )
    broken = {"branch_side", "side_of_branch", "path_between_sides"}
    assert names(forked.check()) == (broken if (order, listed) == ("total", "021") else set())


def test_partial_order_against_a_travel_is_refused() -> None:
    assert names(BROKEN["travel_orders"].check(TOPOLOGICAL.replace(path_order="partial"))) == {
        "travel_orders"
    }


def test_only_defeasible_sides_are_excused() -> None:
    excused = CORRECT["lens, excused"]
    bare = replace(excused.map, excused=())
    assert {"side_of_branch", "path_between_sides"} <= names(check(HALF, bare, excused.theory))
    assert {COHERENCE, "path_between_sides"} <= names(excused.check(TOPOLOGICAL))
    assert names(excused.check(NO_SIDES)) == {COHERENCE}


# Mutations


def relabel(m: SSHMap, i: int, j: int) -> SSHMap:
    labels = list(m.dstate_at)
    labels[i], labels[j] = labels[j], labels[i]
    return replace(m, dstate_at=tuple(labels))


def change(m: SSHMap, dstate: int, **fields: object) -> SSHMap:
    return replace(
        m, dstates=tuple(replace(s, **fields) if s.id == dstate else s for s in m.dstates)
    )


ONCE = CORRECT["notched rectangle, one circuit"]
FRAMED = CORRECT["corridor with frames"]
CAUSAL = CORRECT["causal"]
MUTATIONS = {
    "labels swapped": (ONCE, relabel(ONCE.map, 2, 6), COHERENCE),
    "labels of two views swapped": (ONCE, relabel(ONCE.map, 2, 3), COHERENCE),
    "a label too few": (ONCE, replace(ONCE.map, dstate_at=ONCE.map.dstate_at[:-1]), COHERENCE),
    "a label too many": (ONCE, replace(ONCE.map, dstate_at=(*ONCE.map.dstate_at, 0)), COHERENCE),
    "a label out of range": (
        ONCE,
        replace(ONCE.map, dstate_at=(*ONCE.map.dstate_at[:-1], 99)),
        COHERENCE,
    ),
    "no label": (ONCE, replace(ONCE.map, dstate_at=()), COHERENCE),
    "a link dropped": (ONCE, replace(ONCE.map, links=ONCE.map.links[1:]), COHERENCE),
    "a link twice": (
        ONCE,
        replace(ONCE.map, links=(*ONCE.map.links, ONCE.map.links[0])),
        COHERENCE,
    ),
    "a link made up": (
        ONCE,
        replace(ONCE.map, links=(*ONCE.map.links, (0, "travel", 1))),
        COHERENCE,
    ),
    "an order turned": (
        ONCE,
        replace(ONCE.map, paths=(MapPath(0, (0, 3)), *ONCE.map.paths[1:])),
        "travel_orders",
    ),
    "an order lists a place twice": (
        ONCE,
        replace(ONCE.map, paths=(MapPath(0, (3, 0, 3)), *ONCE.map.paths[1:])),
        COHERENCE,
    ),
    "an order lists no place": (
        ONCE,
        replace(ONCE.map, paths=(MapPath(0, ()), *ONCE.map.paths[1:])),
        "on_path",
    ),
    "an order lists None": (
        ONCE,
        replace(ONCE.map, paths=(MapPath(0, (3, None, 0)), *ONCE.map.paths[1:])),
        COHERENCE,
    ),
    "an order lists an unknown place": (
        ONCE,
        replace(ONCE.map, paths=(MapPath(0, (3, 0, 9)), *ONCE.map.paths[1:])),
        COHERENCE,
    ),
    "places merged": (ONCE, change(change(ONCE.map, 4, place=0), 5, place=0), "path_between_sides"),
    "a place not used": (ONCE, replace(ONCE.map, places=(0, 1, 2, 3, 4)), COHERENCE),
    "a place not listed": (ONCE, replace(ONCE.map, places=(0, 1, 2)), COHERENCE),
    "no place": (ONCE, change(ONCE.map, 4, place=None), "one_place"),
    "a place out of range": (ONCE, change(ONCE.map, 4, place=9), COHERENCE),
    "a path not used": (
        ONCE,
        replace(ONCE.map, paths=(*ONCE.map.paths, MapPath(4, ()))),
        COHERENCE,
    ),
    "a path not listed": (ONCE, replace(ONCE.map, paths=ONCE.map.paths[:-1]), COHERENCE),
    "a path twice": (
        ONCE,
        replace(ONCE.map, paths=(*ONCE.map.paths, ONCE.map.paths[0])),
        COHERENCE,
    ),
    "a path out of range": (ONCE, change(ONCE.map, 4, path=9), COHERENCE),
    "a path turned": (ONCE, change(change(ONCE.map, 1, direction=-1), 2, direction=-1), COHERENCE),
    "a direction out of range": (ONCE, change(ONCE.map, 4, direction=2), "one_course"),
    "a course dropped": (
        ONCE,
        change(ONCE.map, 4, path=None, direction=None),
        "travel_follows_path",
    ),
    "a view changed": (ONCE, change(ONCE.map, 4, view="v1"), COHERENCE),
    "an id out of range": (ONCE, change(ONCE.map, 4, id=99), COHERENCE),
    "an id of None": (ONCE, change(ONCE.map, 4, id=None), COHERENCE),
    "two dstates of one id, two places": (ONCE, change(ONCE.map, 7, id=0), "one_place"),
    "two dstates of one id, two courses": (ONCE, change(ONCE.map, 1, id=0), "one_course"),
    "a dstate not visited": (
        ONCE,
        replace(ONCE.map, dstates=(*ONCE.map.dstates, DState(8, "v0", 0))),
        COHERENCE,
    ),
    "no dstates": (ONCE, replace(ONCE.map, dstates=()), COHERENCE),
    "excused for nothing": (ONCE, replace(ONCE.map, excused=((0, 1),)), COHERENCE),
    "a heading too many": (ONCE, change(ONCE.map, 4, heading=0), COHERENCE),
    "a heading changed": (FRAMED, change(FRAMED.map, 1, heading=1), "turn_rotates"),
    "a heading out of range": (FRAMED, change(FRAMED.map, 1, heading=4), "one_heading"),
    "no heading": (FRAMED, change(FRAMED.map, 1, heading=None), "one_heading"),
    "two dstates of one id, two headings": (FRAMED, change(FRAMED.map, 3, id=0), "one_heading"),
    "headings from another slot": (
        FRAMED,
        change(change(FRAMED.map, 0, heading=1), 3, heading=3),
        COHERENCE,
    ),
    "places numbered otherwise": (
        FRAMED,
        replace(
            FRAMED.map,
            dstates=tuple(replace(s, place=1 - s.place) for s in FRAMED.map.dstates),
            paths=(MapPath(0, (1, 0)),),
        ),
        COHERENCE,
    ),
    "places at the causal level": (CAUSAL, replace(CAUSAL.map, places=(0,)), COHERENCE),
    "a course at the causal level": (CAUSAL, change(CAUSAL.map, 0, path=0, direction=1), COHERENCE),
    "no places at the topological level": (
        CORRECT["corridor out and back"],
        CAUSAL.map,
        "one_place",
    ),
}


@pytest.mark.parametrize("name", MUTATIONS)
def test_checker_refuses_each_mutated_map(name: str) -> None:
    original, mutant, expected = MUTATIONS[name]
    found = check(original.trace, mutant, original.theory)
    assert expected in names(found)


@pytest.mark.parametrize(
    "name",
    [
        "a link dropped",
        "a link made up",
        "a path turned",
        "places numbered otherwise",
        "a view changed",
    ],
)
def test_incoherent_map_breaks_coherence_without_axioms(name: str) -> None:
    original, mutant, _ = MUTATIONS[name]
    bare = original.theory.replace(without=tuple(AXIOM_NAMES))
    assert names(check(original.trace, mutant, bare)) == {COHERENCE}


@pytest.mark.parametrize("excused", [(0, 1), ((0,),), ((0, 9),), ((None, None),), (None,)])
def test_checker_refuses_malformed_excuses(excused: tuple[object, ...]) -> None:
    original = CORRECT["lens, excused"]
    assert COHERENCE in names(check(HALF, replace(original.map, excused=excused), original.theory))


NUMBERS = st.one_of(st.none(), st.integers(-1, 5))
FIELDS = st.sampled_from(["id", "view", "place", "path", "direction", "heading"])
THEORIES = st.builds(
    TOPOLOGICAL.replace,
    boundary=st.sampled_from(["none", "strict", "defeasible"]),
    symmetric_sides=st.booleans(),
    path_order=st.sampled_from(["partial", "total"]),
    next_place=st.booleans(),
    all_on_paths=st.booleans(),
    planar=st.booleans(),
    without=st.lists(st.sampled_from(AXIOM_NAMES), unique=True, max_size=4).map(tuple),
)
GROUNDS = [*CORRECT.values(), *BROKEN.values()]


@st.composite
def mutants(draw: st.DrawFn) -> tuple[Case, SSHMap]:
    """A map made by hand with numbers replaced, or parts dropped, repeated or shuffled."""
    original = draw(st.sampled_from(GROUNDS))
    m = original.map
    for _ in range(draw(st.integers(0, 5))):
        part = draw(
            st.sampled_from(
                [
                    "dstate_at",
                    "dstates",
                    "links",
                    "places",
                    "paths",
                    "order",
                    "excused",
                    "field",
                    "field",
                    "label",
                ]
            )
        )
        if part == "field":
            m = change(
                m, draw(st.integers(0, max(len(m.dstates) - 1, 0))), **{draw(FIELDS): draw(NUMBERS)}
            )
        elif part == "label" and m.dstate_at:
            i = draw(st.integers(0, len(m.dstate_at) - 1))
            m = replace(m, dstate_at=(*m.dstate_at[:i], draw(NUMBERS), *m.dstate_at[i + 1 :]))
        elif part == "order" and m.paths:
            i = draw(st.integers(0, len(m.paths) - 1))
            m = replace(
                m,
                paths=(
                    *m.paths[:i],
                    MapPath(draw(NUMBERS), tuple(draw(st.lists(NUMBERS, max_size=4)))),
                    *m.paths[i + 1 :],
                ),
            )
        elif part == "excused":
            m = replace(m, excused=tuple(draw(st.lists(st.tuples(NUMBERS, NUMBERS), max_size=2))))
        elif part not in ("label", "order") and getattr(m, part):
            m = replace(
                m,
                **{
                    part: tuple(
                        draw(
                            st.lists(
                                st.sampled_from(getattr(m, part)),
                                max_size=len(getattr(m, part)) + 1,
                            )
                        )
                    )
                },
            )
    return original, m


@settings(max_examples=35)
@given(mutants(), THEORIES | st.none())
def test_checker_never_raises_on_a_mutated_map(
    mutant: tuple[Case, SSHMap], theory: Theory | None
) -> None:
    original, m = mutant
    theory = theory or original.theory
    for violation in check(original.trace, m, theory):
        assert violation.axiom in {COHERENCE, *settle(original.trace, theory).theory.axioms}
        assert set(violation.steps) <= set(range(len(original.trace)))
        assert str(violation.message)


# All maps of tiny traces, against the numbers in docs/explanation/theory.md


def courses_of(
    supported: list[bool], edges: list[tuple[int, int, int]]
) -> Iterator[tuple[tuple[int, int] | None, ...]]:
    """Courses of dstates: along a path if supported, and consistent along each edge.

    An edge is a dstate, a dstate, and +1 or -1.
    """

    def grow(
        head: tuple[tuple[int, int] | None, ...],
    ) -> Iterator[tuple[tuple[int, int] | None, ...]]:
        if len(head) == len(supported):
            yield head
            return
        new = 1 + max((c[0] for c in head if c), default=-1)
        choices = (
            [(h, d) for h in range(new) for d in (1, -1)] + [(new, 1)]
            if supported[len(head)]
            else [None]
        )
        for choice in choices:
            here = (*head, choice)
            if all(
                max(a, b) >= len(here) or here[b] == (here[a][0], here[a][1] * sign)
                for a, b, sign in edges
            ):
                yield from grow(here)

    return grow(())


def all_maps(trace: Trace) -> Iterator[list[SSHMap]]:
    """All maps of a trace whose places and courses fit the turns and travels, with every order."""
    kinds = [a.turn or a.kind for a in trace.actions]
    for labels in partitions(len(trace)):
        views = [trace.views[labels.index(i)] for i in range(max(labels) + 1)]
        if [views[i] for i in labels] != list(trace.views) or len(
            {(a, k) for a, k in zip(labels, kinds, strict=False)}
        ) < len(links(trace, labels)):
            continue
        moves = set(zip(labels, kinds, labels[1:], strict=False))
        supported = [
            any(k == "travel" and i in (a, b) for a, k, b in moves) for i in range(len(views))
        ]
        edges = [(a, b, 1) for a, k, b in moves if k == "travel"]
        for places in partitions(len(views)):
            if any((places[a] == places[b]) == (k == "travel") for a, k, b in moves):
                continue
            for courses in courses_of(supported, edges):
                yield [*listings(trace, labels, views, places, courses)]


def listings(trace, labels, views, places, courses) -> Iterator[SSHMap]:
    dstates = tuple(
        DState(i, v, p, *(c or (None, None)))
        for i, (v, p, c) in enumerate(zip(views, places, courses, strict=True))
    )
    on: dict[int, set[int]] = {}
    for s in dstates:
        if s.path is not None:
            on.setdefault(s.path, set()).add(s.place)
    for orders in product(*(permutations(sorted(on[h])) for h in sorted(on))):
        paths = tuple(MapPath(h, order) for h, order in enumerate(orders))
        yield SSHMap(labels, dstates, links(trace, labels), tuple(range(max(places) + 1)), paths)


@pytest.mark.parametrize(
    ("theory", "numbers"),
    [
        (TOPOLOGICAL, [1, 1, 1, 1, 1, 1, 2]),
        (NO_SIDES.replace(path_order="partial"), [1, 1, 1, 1, 3, 4, 13]),
    ],
    ids=["sides and total order", "neither"],
)
def test_checker_counts_the_maps_of_the_notched_rectangle(
    theory: Theory, numbers: list[int]
) -> None:
    counts = [
        sum(
            any(not check(NOTCHED.prefix(n + 1), m, theory) for m in maps)
            for maps in all_maps(NOTCHED.prefix(n + 1))
        )
        for n in range(len(numbers))
    ]
    assert counts == numbers


def test_checker_reads_a_long_trace_once() -> None:
    """The checker never walks a corridor of 3,000 places once for each step or pair of places."""
    circuits = 400
    trace = written("v0 R v1 T v2 R v3 T " * (2 * circuits) + "v0")
    labels = " ".join(map(str, [*range(8)] * circuits + [0]))
    assert check(trace, chart(trace, labels, *RECTANGLE)) == ()
    long = 3000
    corridor = Trace.from_steps(["v"] * long, ["travel"] * (long - 1))
    steps = tuple(range(long))
    states = tuple(DState(i, "v", i, 0, 1) for i in steps)
    whole = SSHMap(steps, states, links(corridor, steps), steps, (MapPath(0, steps),))
    for order in ("partial", "total"):
        assert check(corridor, whole, TOPOLOGICAL.replace(next_place=True, path_order=order)) == ()
