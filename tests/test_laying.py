"""A drive with displacements is laid on the map of old drives."""

from __future__ import annotations

import warnings
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from unittest.mock import patch

import pytest
import truth
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from onto import walks

from ssh_abduction import Solution, Theory, Trace, check, solve
from ssh_abduction.cli import main
from ssh_abduction.data import Action
from ssh_abduction.solution import Status
from ssh_abduction.solver import onto as added_drives


def without_views(trace: Trace) -> Trace:
    return trace.with_views([v if t % 4 else None for t, v in enumerate(trace.views)])


@pytest.mark.slow
@pytest.mark.parametrize("hidden", [False, True])
def test_onto_lays_drives_on_the_map_one_by_one(hidden: bool) -> None:
    """The method was developed on seed 0. With `hidden`, every fourth view is unknown."""
    known = list(walks(6, 100, 4, seed=300))
    if hidden:
        known = [replace(walk, trace=without_views(walk.trace)) for walk in known]
    solution: Solution | None = None
    for number, walk in enumerate(known, 1):
        before = solution
        seconds = 8 if before is None else 1e-6  # laying goes on after the limit for some time
        solution = solve(walk.trace, onto=solution, max_maps=1, time_limit=seconds)
        if before is None:
            continue
        found, trace = solution[0], solution.trace
        assert trace is not None
        assert check(trace, found, solution.theory) == ()
        old = before[0].dstate_at
        assert found.dstate_at[: len(old)] == old
        assert (solution.status, solution.stopped) == (Status.FEASIBLE, "no proof")
        assert solution.effort.prefix == 0  # clingo got no step
        assert solution.support.onto == tuple(drive.name for drive in before.drives)
        states = [state for drive in known[:number] for state in drive.dstates]
        assert truth.partition(found.dstate_at) == truth.partition(states)
        assert solution.weighed is not None
        assert 0 < solution.weighed.bound < solution.weighed.nats
        assert solution.weighed.searched
        assert solution.confidence > 0.99


@pytest.fixture(autouse=True)
def lay_long_drives(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lay drives if there are more than ten steps in all. Fewer steps get a search."""
    monkeypatch.setattr(added_drives, "READABLE", 10)


def along(first: int, stop: int, name: str) -> Trace:
    """Make a drive past the places first … stop - 1 of one street."""
    gone = [(8.0 + i % 3, 0, 0) for i in range(first, stop - 1)]
    views = [str(i) for i in range(first, stop)]
    return Trace.from_steps(views, ["travel"] * len(gone), displacements=gone, name=name)


@pytest.mark.parametrize("places", [pytest.param(4, marks=pytest.mark.slow), 12])
def test_drive_joins_the_pieces_of_the_existing_map(places: int) -> None:
    """The first two drives have no place in common."""
    middle = places // 2
    begin, end = along(0, middle, "begin"), along(middle, places, "end")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # no common view
        pieces = solve(end, onto=solve(begin))
    assert len(pieces[0].pieces) == 2
    solution = solve(along(0, places, "all"), onto=pieces, work_limit=60)
    assert len(solution[0].dstates) == len(solution[0].places) == places
    assert len(solution[0].pieces) == 1
    assert solution.trace is not None
    assert check(solution.trace, solution[0], solution.theory) == ()
    assert solution.weighed is not None
    assert solution.weighed.proven is (places == 4)
    assert solution.weighed.bound <= solution.weighed.nats


@pytest.mark.filterwarnings("ignore:views. trace")
def test_laid_drive_keeps_two_places_apart_that_a_person_denies() -> None:
    """They are of two pieces of the existing map, and the drive saw both as one place."""
    begin = solve(along(0, 7, "begin"))
    denied = begin.theory.replace(returns=0, elsewhere=[(6, 7)], several_drives=True)
    pieces = solve(along(6, 12, "end"), denied, onto=begin)
    solution = solve(along(0, 12, "all"), denied, onto=pieces)
    assert (len(solution[0].dstates), len(solution[0].pieces)) == (13, 1)


@pytest.mark.filterwarnings("ignore:views. trace")
@pytest.mark.parametrize("kind", ["different", "elsewhere"])
def test_laid_drive_is_joined_beyond_a_place_that_a_person_denies(kind: str) -> None:
    """One travel leads to the denied place from the place before it. So that one is apart, too."""
    existing = solve(along(0, 26, "monday"))
    denied = existing.theory.replace(returns=0, **{kind: [(3, 27)]})
    solution = solve(along(2, 24, "tuesday"), denied, onto=existing)
    assert (len(solution[0].dstates), len(solution[0].pieces)) == (28, 1)


@pytest.mark.filterwarnings("ignore:.*no view in common")
@pytest.mark.parametrize("places", [4, 12])
def test_person_joins_the_pieces_of_the_existing_map(places: int) -> None:
    middle = places // 2
    begin, end = along(0, middle, "begin"), along(middle - 1, places, "end")
    first = solve(begin, work_limit=1)
    apart = first.theory.replace(returns=0, different=[(middle - 1, middle)])
    pieces = solve(end, apart, onto=first, work_limit=1)
    assert len(pieces[0].pieces) == 2
    said = pieces.theory.replace(returns=0, different=(), same=[(middle - 1, middle)])
    solution = solve(along(middle, places, "all"), said, onto=pieces, work_limit=1)
    assert (len(solution[0].dstates), len(solution[0].pieces)) == (places, 1)


def test_piece_that_displacements_do_not_connect_is_kept() -> None:
    """The displacement of the action "lost" is missing. Views of both parts look alike."""
    views = [*range(6), *range(3, 9)]
    old = Trace.from_steps(
        map(str, views),
        [Action("travel" if x == s + 1 else "lost", "travel") for s, x in pairwise(views)],
        displacements=[(5, 0, 0) if x == s + 1 else None for s, x in pairwise(views)],
    )
    all_seen = Trace.from_steps("012345678", ["travel"] * 8, displacements=[(5, 0, 0)] * 8)
    apart = [(3, 6), (4, 7), (5, 8)]
    before = solve(old, Theory.causal().replace(different=apart))
    solution = solve(all_seen, Theory.causal(), onto=before)
    assert len(before[0].pieces) == 1
    assert solution[0].dstate_at[: len(old)] == before[0].dstate_at
    assert solution.weighed is not None
    assert solution.weighed.bound <= solution.weighed.nats


ROOM = "abcd"  # what a robot sees at the corners of a square room, facing along the wall ahead


def around_the_room(first: int, corners: int, name: str, errors: list[float]) -> Trace:
    """Make a drive along the walls of a square room of 5 m, from corner to corner.

    Args:
        first: The corner where the drive begins.
        corners: How many further corners the robot comes to.
        name: The name of the drive.
        errors: The error of each travel, in metres.
    """
    views = [f"{ROOM[(first + (i + 1) // 2) % 4]}{i % 2}" for i in range(2 * corners + 1)]
    moves = [
        move for error in errors[:corners] for move in ((5.0 + error, 0.0, 0.0), (0.0, 0.0, 1.5708))
    ]
    return Trace.from_steps(views, ["travel", "left"] * corners, displacements=moves, name=name)


ERRORS = st.lists(st.floats(-0.2, 0.2), min_size=3, max_size=3)


@pytest.mark.filterwarnings("ignore:traces 1 and 2 have the same steps")
@pytest.mark.filterwarnings("ignore:views. trace")
@pytest.mark.filterwarnings("ignore:.*no view in common")
@settings(max_examples=4)
@given(
    st.tuples(st.integers(0, 3), st.integers(1, 3), ERRORS),
    st.tuples(st.integers(0, 3), st.integers(1, 3), ERRORS),
)
@pytest.mark.slow
def test_onto_costs_as_much_as_solving_all_drives(
    monday: tuple[int, int, list[float]], tuesday: tuple[int, int, list[float]]
) -> None:
    """This holds if the best joint map contains the map of the old drives."""
    old = around_the_room(monday[0], monday[1], "monday", monday[2])
    new = around_the_room(tuesday[0], tuesday[1], "tuesday", tuesday[2])
    existing = solve(old)
    assume(existing.status is Status.OPTIMAL)
    all_together = solve([old, new])
    assert all_together.weighed is not None
    labels = all_together[0].dstate_at[: len(old)]
    assume(all_together.weighed.proven and labels == existing[0].dstate_at)
    with patch.object(added_drives, "READABLE", 0):
        laid = solve(new, onto=existing)
    assert laid.weighed is not None
    assert laid.stopped == "no proof"
    assert laid.weighed.nats == pytest.approx(all_together.weighed.nats, abs=1e-4)
    assert laid.weighed.bound <= all_together.weighed.nats


def test_interrupted_onto_gives_the_new_drive_its_own_dstates(tmp_path: Path) -> None:
    monday, tuesday = (
        around_the_room(0, corners, name, [0.0] * corners)
        for corners, name in ((4, "monday"), (30, "tuesday"))
    )
    before = solve(monday)
    with patch.object(added_drives, "laid", side_effect=KeyboardInterrupt):
        solution = solve(tuesday, onto=before)
    solution.save(tmp_path / "maps.json")
    assert main(["check", str(tmp_path / "maps.json")]) == 0  # with the claims of the file
    assert (solution.status, solution.stopped) == (Status.FEASIBLE, "interrupted")
    (found,) = solution
    assert found.dstate_at[: len(monday)] == before[0].dstate_at
    assert solution.trace is not None
    assert check(solution.trace, found, solution.theory) == ()
