"""Solve, count and check the minimal maps in the tables of docs/explanation/theory.md."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import pytest
from worlds import TOURS, drive, rectangle, written

from ssh_abduction import Theory, Trace, solve
from ssh_abduction.checker.checker import check
from ssh_abduction.solution import Solution, Status

P0 = Theory.causal()
P1 = Theory(
    boundary="none", path_order="partial", star="none", prefer=("paths", "places", "dstates")
)
P2 = Theory.circumscriptive().replace(star="none")
P3 = Theory.topological().replace(star="none")
PLACES_FIRST = P2.replace(prefer=("places", "paths", "dstates"))
ALL_ON_PATHS = P2.replace(all_on_paths=True)
PARTIAL = P2.replace(path_order="partial")
ONE_SIDE = P2.replace(symmetric_sides=False)
PARTIAL_ONE_SIDE = PARTIAL.replace(symmetric_sides=False)
SOFT = P2.replace(boundary="defeasible")
SOFT_LAST = SOFT.replace(prefer=("paths", "places", "excuses", "dstates"))
SOFT_DSTATES = P3.replace(boundary="defeasible", prefer=("dstates", "excuses", "paths", "places"))
FRAME = P2.replace(star="frame")

C = "o T e A o T e A o"
Expected = int | tuple[int, ...]


@cache
def solved(trace: Trace, theory: Theory) -> Solution:
    """All minimal maps; several tables need them."""
    return solve(trace, theory, max_maps=None)


def answer(trace: Trace, theory: Theory, expected: Expected) -> tuple[Expected, int | None]:
    """The counts of the minimal maps in the table's form, and how many maps there are; each map is
    checked."""
    solution = solved(trace, theory)
    assert solution.status is Status.OPTIMAL
    assert solution.complete
    assert solution.cost is not None
    assert len(set(solution.maps)) == solution.count
    for ssh_map in solution.maps:
        assert check(trace, ssh_map, theory) == ()
    counts = (solution.cost.dstates, solution.cost.places, solution.cost.paths)
    return (counts[0] if isinstance(expected, int) else counts[: len(expected)]), solution.count


@pytest.mark.parametrize(
    ("trace", "theory", "expected", "count"),
    [
        pytest.param(written(text), theory, row[0], row[1], id=f"{name}-{policy}")
        for name, text, rows in [
            (
                "A corridor, one view",
                "a T a T a",
                [(1, 1), ((3, 3, 1), 1), ((3, 3, 1), 1), ((3, 3, 1), 1)],
            ),
            (
                "B out and back",
                "a T b A c T d A a",
                [(4, 1), ((4, 2, 1), 1), ((4, 2, 1), 1), ((4, 2, 1), 1)],
            ),
            ("C aliased ends", C, [(2, 1), ((4, 2, 1), 1), ((4, 2, 1), 1), ((4, 2, 1), 1)]),
            ("C2 twice round", C + C[1:], [(2, 1), ((4, 2, 1), 1), ((4, 2, 1), 1), ((4, 2, 1), 1)]),
            (
                "D tee, three dead ends",
                "o T jr R jo T e A o T jw R jr T e A o T jl T e A o",
                [(9, 2), ((10, 3, 2), 2), ((10, 4, 2), 1), ((10, 4, 2), 1)],
            ),
            (
                "E square, 4 actions",
                "a R b T a R b T a",
                [(2, 1), ((4, 2, 2), 1), ((5, 3, 2), 1), ((5, 3, 2), 1)],
            ),
            *[
                (
                    f"E square, {2 * k} actions",
                    "a" + " R b T a" * k,
                    [(2, 1), ((4, 2, 2), 1), ((6, 3, 3), 1), ((6, 3, 3), 1)],
                )
                for k in (3, 6)
            ],
            (
                "I ring corridor",
                "v0 T v1 T v2 T v0 T v1",
                [(3, 1), ((5, 5, 1), 1), ((5, 5, 1), 1), ((5, 5, 1), 1)],
            ),
            (
                "J spin, 4 views",
                "a R b R c R d R a",
                [(4, 1), ((4, 1, 0), 1), ((4, 1, 0), 1), ((4, 1, 0), 1)],
            ),
            (
                "J2 spin, 1 view",
                "a R a R a R a R a",
                [(1, 1), ((1, 1, 0), 1), ((1, 1, 0), 1), ((1, 1, 0), 1)],
            ),
            (
                "K two causal maps",
                "a Tm b Tk a Tk a Tm c",
                [(4, 2), ((5, 5, 1), 1), ((5, 5, 1), 1), ((5, 5, 1), 1)],
            ),
            (
                "G1 two minimal maps",
                "b T a T b A b T b",
                [None, None, ((5, 3, 1), 2), ((5, 3, 1), 2)],
            ),
            (
                "G2 two minimal maps",
                "b T a A a T b T a",
                [None, None, ((5, 3, 1), 2), ((5, 3, 1), 2)],
            ),
        ]
        for policy, theory, row in zip(
            ("P0", "P1", "P2", "P3"), (P0, P1, P2, P3), rows, strict=True
        )
        if row is not None
    ],
)
def test_small_traces_have_the_known_numbers_of_maps(
    trace: Trace, theory: Theory, expected: Expected, count: int
) -> None:
    assert answer(trace, theory, expected) == (expected, count)


@pytest.mark.parametrize("text", ["b T a T b A b T b", "b T a A a T b T a"])
@pytest.mark.parametrize("theory", [P2, P3])
def test_next_place_leaves_one_map(text: str, theory: Theory) -> None:
    assert answer(written(text), theory.replace(next_place=True), (5, 3, 1)) == ((5, 3, 1), 1)


@pytest.mark.parametrize(
    ("actions", "theory", "expected", "count"),
    [
        (8, P0, 8, 1),
        (8, P1, (8, 3, 2), 2),
        (8, P2, (9, 5, 3), 1),
        (8, P3, (8, 4, 4), 1),
        *[
            (n, theory, expected, count)
            for n in (10, 16)
            for theory, expected, count in [
                (P0, 8, 1),
                (P1, (8, 3, 2), 2),
                (P2, (8, 4, 4), 1),
                (P3, (8, 4, 4), 1),
            ]
        ],
    ],
)
def test_rectangle_with_eight_views_has_the_known_maps(
    actions: int, theory: Theory, expected: Expected, count: int
) -> None:
    assert answer(rectangle(actions, views=8), theory, expected) == (expected, count)


LENGTHS = (4, 6, 8, 9, 10, 16)
NOTCHED: list[tuple[Theory, list[Expected | None], list[int]]] = [
    (P0, [4] * 6, [1] * 6),
    (P1, [(4, 2, 2)] * 6, [1] * 6),
    (
        P3,
        [(5, 3, 2), (7, 3, 3), (8, 4, 4), (8, 4, 4), (8, 4, 4), (8, 4, 4)],
        [1] * 6,
    ),
    (
        P2,
        [(5, 3, 2), (7, 3, 3), (9, 5, 3), (10, 5, 3), (8, 4, 4), (8, 4, 4)],
        [1] * 6,
    ),
    (
        ALL_ON_PATHS,
        [(5, 3, 3), (7, 4, 3), (8, 4, 4), (8, 4, 4), (8, 4, 4), (8, 4, 4)],
        [1] * 6,
    ),
    (
        PARTIAL,
        [(5, 3, 2), (7, 3, 3), (9, 5, 3), (10, 5, 3), (11, 6, 3), (12, 6, 3)],
        [1] * 6,
    ),
    (
        ONE_SIDE,
        [(5, 3, 2), (7, 3, 3), (9, 4, 3), (10, 4, 3), (11, 5, 3), (12, 6, 3)],
        [1, 1, 3, 3, 3, 1],
    ),
    (
        PARTIAL_ONE_SIDE,
        [None, None, (9, 4, 3), None, (11, 5, 3), (12, 6, 3)],
        [0, 0, 3, 0, 5, 8],
    ),
    (
        PLACES_FIRST,
        [(5, 3, 2), (7, 3, 3), (9, 3, 4), (10, 3, 4), (11, 3, 5), (12, 3, 6)],
        [1] * 6,
    ),
    (
        SOFT,
        [(5, 3, 2), (7, 3, 3), (9, 5, 3), (10, 5, 3), (8, 4, 4), (8, 4, 4)],
        [1] * 6,
    ),
    (
        SOFT_LAST,
        [(4, 2, 2), (4, 2, 2), (4, 2, 2), (4, 2, 2), (4, 2, 2), (4, 2, 2)],
        [1] * 6,
    ),
    (
        SOFT_DSTATES,
        [(4, 2, 2), (4, 2, 2), (4, 2, 2), (4, 2, 2), (4, 2, 2), (4, 2, 2)],
        [1] * 6,
    ),
    (
        FRAME,
        [(5, 3, 2), (7, 4, 3), (9, 5, 3), (10, 5, 3), (8, 4, 4), None],
        [1] * 6,
    ),
    (
        P3.replace(star="frame"),
        [(5, 3, 2), (7, 4, 3), (8, 4, 4), (8, 4, 4), (8, 4, 4), None],
        [1] * 6,
    ),
    (
        PLACES_FIRST.replace(star="frame"),
        [(5, 3, 2), (7, 4, 3), (8, 4, 4), (8, 4, 4), (8, 4, 4), None],
        [1] * 6,
    ),
]
NOTCHED += [
    (
        P3.replace(**choices),
        [(5, 3, 2), (7, 3, 3), (8, 4, 4), (8, 4, 4), (8, 4, 4), None],
        [1] * 6,
    )
    for choices in (
        {"path_order": "partial"},
        {"symmetric_sides": False},
        {"path_order": "partial", "symmetric_sides": False},
    )
]


def cornered(trace: Trace) -> Trace:
    """The notched rectangle with the stars of its corners. The way is open ahead after a turn, and
    to the right before it."""
    stars = [(0, 1, 1, 0), (1, 1, 0, 0)]
    return Trace.from_steps(
        trace.views, trace.actions, stars=[stars[i % 2] for i in range(len(trace))]
    )  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("theory", "actions", "expected", "count"),
    [
        pytest.param(theory, n, expected, count, id=f"row{row}-{n}")
        for row, (theory, cells, counts) in enumerate(NOTCHED)
        for n, expected, count in zip(LENGTHS, cells, counts, strict=True)
        if expected is not None
    ],
)
def test_notched_rectangle_has_the_known_numbers_of_maps(
    theory: Theory, actions: int, expected: Expected, count: int
) -> None:
    trace = rectangle(actions)
    if theory.star == "frame":
        trace = cornered(trace)
    assert answer(trace, theory, expected) == (expected, count)


@pytest.mark.parametrize("theory", [P0, P1, P2, P3])
@pytest.mark.parametrize("actions", [6, 9])
def test_mirrored_trace_has_equal_maps(theory: Theory, actions: int) -> None:
    clockwise, anticlockwise = (solved(rectangle(actions, turn=turn), theory) for turn in "RL")
    assert {m.labels for m in clockwise.maps} == {m.labels for m in anticlockwise.maps}
    assert {m.dstates for m in clockwise.maps} == {m.dstates for m in anticlockwise.maps}


@pytest.mark.parametrize(
    ("theory", "counts"),
    [
        (P2.replace(prefer=()), [1, 1, 1, 1, 1, 1, 2, 2, 7, 8]),
        (
            PARTIAL.replace(boundary="none", prefer=()),
            [1, 1, 1, 1, 3, 4, 13, 16, 119],
        ),
    ],
)
def test_numbers_of_all_consistent_maps(theory: Theory, counts: list[int]) -> None:
    assert [solve(rectangle(n), theory, max_maps=None).count for n in range(len(counts))] == counts


STARRED = {"pattern": P2.replace(star="pattern"), "frame": FRAME}
ENVIRONMENTS: list[tuple[str, Theory, Expected, int]] = [
    ("two blocks", P0, 5, 1),
    ("two blocks", P1, (5, 3, 2), 1),
    ("two blocks", P2, (9, 6, 3), 1),
    ("two blocks", FRAME, (9, 6, 3), 1),
    ("two blocks", P2.replace(next_place=True), (11, 7, 3), 1),
    ("two blocks, further", P0, 7, 1),
    ("two blocks, further", P1, (9, 3, 2), 2),
    ("two blocks, further", P2, (17, 9, 4), 1),
    ("two blocks, further", P3, (12, 6, 5), 1),
    ("two blocks, further", FRAME, (12, 6, 5), 1),
    ("two blocks, further", P2.replace(next_place=True), (12, 6, 5), 1),
    ("square", P0, 2, 1),
    ("square", P1, (4, 2, 2), 1),
    ("square", P2, (6, 3, 3), 1),
    ("square", FRAME, (6, 3, 3), 1),
    ("tee", P0, 9, 2),
    ("tee", P1, (10, 3, 2), 2),
    ("tee", P2, (10, 4, 2), 1),
    ("tee", P3, (10, 4, 2), 1),
    ("tee", FRAME, (10, 4, 2), 1),
    ("plus", P0, 3, 1),
    ("plus", P1, (8, 2, 2), 1),
    ("plus", P2, (12, 5, 2), 1),
    ("plus", FRAME, (12, 5, 2), 1),
    ("comb", P0, 19, 2),
    ("comb", P1, (19, 6, 2), 308),
    ("comb", P2, (20, 5, 4), 1),
    ("comb", P3, (19, 10, 4), 2),
    ("comb", PLACES_FIRST.replace(star="frame"), (20, 7, 4), 1),
]


@pytest.mark.parametrize(("tour", "theory", "expected", "count"), ENVIRONMENTS)
def test_simulated_environments_have_the_known_maps(
    tour: str, theory: Theory, expected: Expected, count: int
) -> None:
    assert answer(drive(*TOURS[tour], stars=theory.star != "none"), theory, expected) == (
        expected,
        count,
    )


@pytest.mark.parametrize(
    ("theory", "expected", "count"),
    [
        (P0, 6, 1),
        (P2, (19, 9, 4), 38),
        (STARRED["pattern"], (19, 9, 4), 2),
        (FRAME, (19, 10, 4), 4),
    ],
)
def test_aces3_route_has_the_known_maps(theory: Theory, expected: Expected, count: int) -> None:
    route = Trace.load(Path(__file__).parent.parent / "examples" / "aces3-route.jsonl")
    assert answer(route, theory, expected) == (expected, count)


@pytest.mark.parametrize(
    ("first", "second", "actions"), [(0, 4, 4), (1, 5, 5), (2, 6, 6), (3, 7, 7)]
)
def test_steps_of_half_a_circuit_differ_in_all_maps(first: int, second: int, actions: int) -> None:
    """Section 6.2: with 4 to 7 actions no two steps of one view are equal in any consistent map."""
    for ssh_map in solve(rectangle(actions), P2.replace(prefer=()), max_maps=None).maps:
        assert ssh_map.labels[first] != ssh_map.labels[second]


@pytest.mark.parametrize(
    ("actions", "equal"), [(8, {(0, 8)}), (9, {(0, 8), (1, 9)}), (10, {(0, 8), (1, 9), (2, 10)})]
)
def test_possible_equalities_of_a_circuit_equal_the_table(
    actions: int, equal: set[tuple[int, int]]
) -> None:
    """Section 6.2: sentences that hold in at least one consistent map."""
    maps = solve(rectangle(actions), P2.replace(prefer=()), max_maps=None).maps
    assert {
        (i, j)
        for m in maps
        for j in range(actions + 1)
        for i in range(j)
        if m.labels[i] == m.labels[j]
    } == equal
