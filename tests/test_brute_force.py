"""The brute force reproduces the tables of docs/explanation/theory.md that are small enough for
it."""

from __future__ import annotations

import pytest
from brute_force import consistent_maps, key, minimal_maps
from worlds import rectangle, written

from ssh_abduction.data.maps import DState, MapPath, SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.theory.theory import Theory

PATHS_FIRST = ("paths", "places", "dstates")
P0 = Theory.causal()
P1 = Theory(boundary="none", path_order="partial", prefer=PATHS_FIRST)
P2 = Theory(prefer=PATHS_FIRST)
P3 = Theory(prefer=("dstates", "paths", "places"))
PLACES_FIRST = Theory(prefer=("places", "paths", "dstates"))


def triple(trace: Trace, theory: Theory) -> tuple[int, int, int, int]:
    """Dstates, places, paths, and the number of minimal maps."""
    counts, keys = minimal_maps(trace, theory)
    assert counts is not None
    return counts.dstates, counts.places, counts.paths, len(keys)


@pytest.mark.parametrize(("actions", "expected"), list(enumerate((1, 1, 1, 1, 1, 1, 2, 2, 7))))
def test_numbers_of_consistent_maps(actions: int, expected: int) -> None:
    assert len(list(consistent_maps(rectangle(actions), P3))) == expected


@pytest.mark.parametrize(("actions", "expected"), list(enumerate((1, 1, 1, 1, 3, 4, 13, 16, 119))))
def test_numbers_of_consistent_maps_without_boundary(actions: int, expected: int) -> None:
    theory = Theory(boundary="none", path_order="partial")
    assert len(list(consistent_maps(rectangle(actions), theory))) == expected


TABLE = {
    "A": ("a T a T a", (1, 1), (3, 3, 1, 1), (3, 3, 1, 1), (3, 3, 1, 1)),
    "B": ("a T b A c T d A a", (4, 1), (4, 2, 1, 1), (4, 2, 1, 1), (4, 2, 1, 1)),
    "C": ("o T e A o T e A o", (2, 1), (4, 2, 1, 1), (4, 2, 1, 1), (4, 2, 1, 1)),
    "E4": ("a R b T a R b T a", (2, 1), (4, 2, 2, 1), (5, 3, 2, 1), (5, 3, 2, 1)),
    "E6": ("a R b T a R b T a R b T a", (2, 1), (4, 2, 2, 1), (6, 3, 3, 1), (6, 3, 3, 1)),
    "I": ("v0 T v1 T v2 T v0 T v1", (3, 1), (5, 5, 1, 1), (5, 5, 1, 1), (5, 5, 1, 1)),
    "J": ("a R b R c R d R a", (4, 1), (4, 1, 0, 1), (4, 1, 0, 1), (4, 1, 0, 1)),
    "J2": ("a R a R a R a R a", (1, 1), (1, 1, 0, 1), (1, 1, 0, 1), (1, 1, 0, 1)),
    "K": ("a Tm b Tk a Tk a Tm c", (4, 2), (5, 5, 1, 1), (5, 5, 1, 1), (5, 5, 1, 1)),
    "G1": ("b T a T b A b T b", None, None, (5, 3, 1, 2), (5, 3, 1, 2)),
    "G2": ("b T a A a T b T a", None, None, (5, 3, 1, 2), (5, 3, 1, 2)),
}


@pytest.mark.parametrize("name", TABLE)
def test_small_worlds(name: str) -> None:
    text, causal, *others = TABLE[name]
    trace = written(text)
    if causal is not None:
        dstates, _, _, number = triple(trace, P0)
        assert (dstates, number) == causal
    for theory, expected in zip((P1, P2, P3), others, strict=True):
        if expected is not None:
            assert triple(trace, theory) == expected


@pytest.mark.parametrize("name", ["G1", "G2"])
def test_next_place_makes_the_map_unique(name: str) -> None:
    assert triple(written(TABLE[name][0]), P2.replace(next_place=True)) == (5, 3, 1, 1)


@pytest.mark.parametrize(
    ("theory", "at_four", "at_six"),
    [
        (P1, (4, 2, 2), (4, 2, 2)),
        (P2, (5, 3, 2), (7, 3, 3)),
        (P3, (5, 3, 2), (7, 3, 3)),
        (PLACES_FIRST, (5, 3, 2), (7, 3, 3)),
        (P2.replace(all_on_paths=True), (5, 3, 3), (7, 4, 3)),
        (P2.replace(path_order="partial"), (5, 3, 2), (7, 3, 3)),
        (P2.replace(symmetric_sides=False), (5, 3, 2), None),
        (P3.replace(path_order="partial"), (5, 3, 2), (7, 3, 3)),
        (P3.replace(symmetric_sides=False), (5, 3, 2), (7, 3, 3)),
        (P2.replace(boundary="defeasible"), (5, 3, 2), (7, 3, 3)),
        (P2.replace(boundary="defeasible", prefer=(*PATHS_FIRST, "excuses")), (4, 2, 2), (4, 2, 2)),
    ],
)
def test_notched_rectangle(
    theory: Theory, at_four: tuple[int, ...], at_six: tuple[int, ...] | None
) -> None:
    assert triple(rectangle(4), theory) == (*at_four, 1)
    if at_six is not None:
        assert triple(rectangle(6), theory) == (*at_six, 1)


def test_stars_tell_places_apart_that_views_do_not() -> None:
    """The ends of two travels look alike; their stars have one opening and two."""
    stars = [(1, 0, 0, 0), (0, 0, 1, 0), (1, 0, 0, 0), (0, 1, 1, 0), (1, 1, 0, 0)]
    trace = Trace.from_steps("aaaaa", ["travel", "around", "travel", "right"], stars=stars)
    assert triple(trace, Theory(star="none")) == (5, 2, 1, 1)
    assert (
        triple(trace, Theory(star="pattern")) == triple(trace, Theory(star="frame")) == (5, 3, 1, 1)
    )


def test_frames_tell_headings_apart() -> None:
    """After a turn right the opening ahead is on the left. The pattern is the same, and fits no
    other heading."""
    ahead, left, back, right = (1, 0, 0, 0), (0, 0, 0, 1), (0, 0, 1, 0), (0, 1, 0, 0)
    for seen, pattern, frame in (
        ((ahead, left), 1, 2),
        ((ahead, ahead), 1, 0),
        ((ahead, right), 1, 0),
        ((ahead, back), 1, 0),
    ):
        trace = Trace.from_steps("aa", ["right"], stars=seen)
        for star, expected in (("pattern", pattern), ("frame", frame)):
            counts, _ = minimal_maps(trace, Theory(star=star))
            assert (counts.dstates if counts else 0) == expected


@pytest.mark.parametrize(
    "theory", [P1, P2, P2.replace(all_on_paths=True), P2.replace(boundary="defeasible")]
)
def test_every_map_is_listed_once(theory: Theory) -> None:
    for text, *_ in TABLE.values():
        keys = [found for found, _ in consistent_maps(written(text), theory)]
        assert len(keys) == len(set(keys))


def test_key_numbers_dstates_by_first_visit() -> None:
    dstates = (
        DState(0, "b", 5, 8, -1),
        DState(1, "a", 9, 8, -1),
        DState(2, "c", 5, None, None),
        DState(3, "d", 9, 8, 1),
    )
    ssh_map = SSHMap((1, 0, 2, 3), dstates, (), (5, 9), (MapPath(8, (5, 9)),))
    assert key(ssh_map) == ((0, 1, 2, 3), (0, 1, 1, 0), ((0, 1), (0, 1), None, (0, -1)))
