"""Regions: what each axiom gives, the checker and the brute force against the encoding, files."""

from __future__ import annotations

import math
import random
import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import brute_regions
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from worlds import written

from ssh_abduction import SSHMap, Theory, Trace, check, solve
from ssh_abduction.data import Action, MapError
from ssh_abduction.data.map_parts import Region, right_of
from ssh_abduction.robot_logs.log_maps import BARE
from ssh_abduction.solver import find_regions, with_regions
from ssh_abduction.solver.derived_regions import UNITS, axioms_for_regions, derived
from ssh_abduction.theory import encodings
from ssh_abduction.theory.settle import settle

PLAIN = Theory.topological()
LOG = BARE.replace(weigh="count")
# Three streets with a turn right and a turn left, and once round a block.
BLOCK = "a R b T c R d T e R f T g R h T a R b T c"
CORNER = "a T b R c T d L e T f"
# A corridor of three places along x, with a room beside each and one behind the second room.
ROOMS = {
    "a": (0, 0),
    "b": (9, 0),
    "c": (18, 0),
    "A": (0, 9),
    "B": (9, 9),
    "C": (18, 9),
    "D": (9, 18),
}
TOUR = "aAabBDBbcCc"
TURNS = ("right", "left", "around")

# For each axiom about regions, and each axiom of the theory that regions rest on: a theory, a
# trace, and the regions with the axiom and without it, as places, bounds and door.
CASES: dict[str, tuple[Theory, str, str, str]] = {
    "region_beside": (
        PLAIN,
        CORNER,
        "0 1+ behind1/1 2-/2 0+/3 1- behind2",
        "0 behind1/1/2/3 behind2",
    ),
    "region_between": (
        PLAIN,
        BLOCK,
        "0 2+ 3+/0,1 3+/0,3 2+/1 0+ 3+/1,2 0+/2 0+ 1+/2,3 1+/3 1+ 2+",
        "0,1 3+/0,3 2+/1,2 0+/2,3 1+",
    ),
    "region_behind": (
        PLAIN,
        CORNER,
        "0 1+ behind1/1 2-/2 0+/3 1- behind2",
        "0 1+/1 2-/2 0+/3 1-",
    ),
    "path_holds_together": (
        PLAIN,
        CORNER,
        "0 1+ behind1/1 2-/2 0+/3 1- behind2",
        "0 1+/1 2-/2 0+/3 1-",
    ),
    "travel_links": (
        LOG,
        TOUR,
        "0,1 behind2/1 behind0/3,4 behind2/4 behind3/5,6 behind2/6 behind5",
        "",
    ),
    "branch_side": (
        PLAIN,
        CORNER,
        "0 1+ behind1/1 2-/2 0+/3 1- behind2",
        "0 behind1/3 behind2",
    ),
    "symmetric_sides": (
        PLAIN,
        CORNER,
        "0 1+ behind1/1 2-/2 0+/3 1- behind2",
        "0 behind1/2 0+/3 1- behind2",
    ),
    "side_of_branch": (
        PLAIN,
        CORNER,
        "0 1+ behind1/1 2-/2 0+/3 1- behind2",
        "0 behind1/3 behind2",
    ),
    "travel_orders": (
        PLAIN,
        CORNER,
        "0 1+ behind1/1 2-/2 0+/3 1- behind2",
        "0 behind1/3 behind2",
    ),
    "order_transitive": (PLAIN, "a T b R c T d T e", "0 1+ behind1/2,3 0+", "0 behind1/2 0+"),
    # The first and the last street are one path of the map, which is bent.
    "sides_need_order": (
        PLAIN,
        "a T b R c T d L e T f R g T h",
        "0 1+/1 2-/3 1-/4 2+",
        "0 1+/1 2-/2 0+/3 1-/4 2+",
    ),
}


def trace_of(text: str) -> Trace:
    """The trace of a text in the notation of `worlds`, or of a tour of the rooms."""
    return written(text) if " " in text else toured(text)


def toured(tour: str) -> Trace:
    """A robot that turns towards each next room and travels there, with exact displacements."""
    views, actions, moved = [], [], []
    facing = 0.0
    for here, there in pairwise(tour):
        (x, y), (u, v) = ROOMS[here], ROOMS[there]
        towards = math.atan2(v - y, u - x)
        turn = math.remainder(towards - facing, math.tau)
        if abs(turn) > 0.1:
            views.append(f"{here}{facing:.1f}")
            actions.append("around" if abs(turn) > 3 else "left" if turn > 0 else "right")
            moved.append((0.0, 0.0, turn))
        facing = math.remainder(towards, math.tau)
        facing = abs(facing) if abs(facing) > 3 else facing
        views.append(f"{here}{facing:.1f}")
        actions.append("travel")
        moved.append((math.dist(ROOMS[here], ROOMS[there]), 0.0, 0.0))
    return Trace.from_steps([*views, f"{tour[-1]}{facing:.1f}"], actions, displacements=moved)


def in_words(regions: tuple[Region, ...]) -> str:
    """The regions in short: places, bounds and door, in the order of their places."""
    parts = [
        " ".join(
            [
                ",".join(map(str, region.places)),
                *(f"{h}{'+' if d == 1 else '-'}" for h, d in region.bounds),
                *([] if region.door is None else [f"behind{region.door}"]),
            ]
        )
        for region in sorted(regions, key=lambda region: region.places)
    ]
    return "/".join(parts)


def first_map(trace: Trace, theory: Theory) -> SSHMap:
    return solve(trace, theory, max_maps=1, time_limit=60)[0]


def test_every_axiom_about_regions_has_a_case() -> None:
    names = {axiom.name for axiom in encodings.region_axioms()}
    text = Path(encodings.path("regions")).read_text()
    assert set(CASES) == set(re.findall(r"axiom\((\w+)\)[,.]", text)) > names


def test_search_does_not_use_the_axioms_about_regions() -> None:
    assert not {axiom.name for axiom in encodings.region_axioms()} & {*PLAIN.axioms}


@pytest.mark.parametrize("axiom", CASES)
def test_leaving_out_one_axiom_changes_the_regions(axiom: str) -> None:
    theory, text, with_it, without_it = CASES[axiom]
    trace = trace_of(text)
    ssh_map = first_map(trace, theory)
    axioms = axioms_for_regions(settle(trace, theory).theory)
    assert in_words(derived(ssh_map, trace, axioms)) == with_it
    assert in_words(derived(ssh_map, trace, axioms - {axiom})) == without_it


def walk(seed: int, steps: int, side: int = 3) -> Trace:
    """A random walk over the crossings of a square city, each facing with a view of its own."""
    rng = random.Random(seed)
    x = y = facing = 0
    views, actions = [], []
    for _ in range(steps):
        views.append(f"{x},{y},{facing}")
        u, v = (x + (0, 1, 0, -1)[facing], y + (1, 0, -1, 0)[facing])
        is_open = 0 <= u < side and 0 <= v < side
        action = rng.choice(("travel", "travel", "right", "left") if is_open else TURNS)
        actions.append(action)
        if action == "travel":
            x, y = u, v
        else:
            facing = (facing + {"right": 1, "around": 2, "left": 3}[action]) % 4
    return Trace.from_steps([*views, f"{x},{y},{facing}"], actions)


def as_set(ssh_map: SSHMap) -> set[brute_regions.Found]:
    assert ssh_map.regions is not None
    return {(frozenset(r.places), frozenset(r.bounds), r.door) for r in ssh_map.regions}


@settings(max_examples=8, deadline=None)
@given(
    trace=st.builds(walk, st.integers(0, 10_000), st.integers(2, 16)),
    boundary=st.sampled_from(("strict", "defeasible", "none")),
    symmetric=st.booleans(),
)
def test_encoding_checker_and_brute_force_agree_on_streets(
    trace: Trace, boundary: str, symmetric: bool
) -> None:
    theory = PLAIN.replace(boundary=boundary, symmetric_sides=symmetric and boundary != "none")
    theory = settle(trace, theory).theory
    for ssh_map in solve(trace, theory, max_maps=3, time_limit=60):
        assert not check(trace, ssh_map, theory)
        assert as_set(ssh_map) == brute_regions.regions(ssh_map, trace, axioms_for_regions(theory))


@settings(max_examples=8, deadline=None)
@given(st.lists(st.sampled_from(sorted(ROOMS)), min_size=2, max_size=7))
def test_encoding_checker_and_brute_force_agree_on_rooms(rooms: list[str]) -> None:
    tour = "".join(room for i, room in enumerate(rooms) if i == 0 or room != rooms[i - 1])
    trace = toured(tour if len(tour) > 1 else "aA")
    theory = settle(trace, LOG).theory
    ssh_map = first_map(trace, theory)
    assert not check(trace, ssh_map, theory)
    assert as_set(ssh_map) == brute_regions.regions(ssh_map, trace, axioms_for_regions(theory))


def test_floor_is_a_region_behind_its_lift() -> None:
    up = Action("up", "lift")
    trace = Trace.from_steps(
        ["a", "b", "c", "lift", "up", "hall"], ["travel", "travel", "travel", up, "travel"]
    )
    theory = settle(trace, PLAIN).theory
    ssh_map = first_map(trace, theory)
    assert not check(trace, ssh_map, theory)
    assert "4,5 behind3" in in_words(ssh_map.regions or ()).split("/")
    assert as_set(ssh_map) == brute_regions.regions(ssh_map, trace, axioms_for_regions(theory))


@pytest.mark.parametrize(
    ("change", "axiom"),
    [
        (lambda regions: regions[1:], "region_beside"),
        (lambda regions: regions[:4] + regions[5:], "region_between"),
        (lambda regions: (replace(regions[0], door=3), *regions[1:]), "region_behind"),
        (lambda regions: (replace(regions[0], bounds=()), *regions[1:]), "region_beside"),
        (lambda regions: (*regions, Region(8, (0, 2))), "region_beside"),
        (lambda regions: (*regions[:-1], replace(regions[-1], inside=())), "region_beside"),
    ],
)
def test_checker_finds_wrong_regions(change, axiom: str) -> None:  # type: ignore[no-untyped-def]
    trace = trace_of(BLOCK)
    ssh_map = first_map(trace, PLAIN)
    assert not check(trace, ssh_map, PLAIN)
    assert ssh_map.regions is not None
    wrong = replace(ssh_map, regions=change(ssh_map.regions))
    assert axiom in {violation.axiom for violation in check(trace, wrong, PLAIN)}


def test_checker_finds_a_missing_part_behind_a_place() -> None:
    trace = trace_of(TOUR)
    ssh_map = first_map(trace, LOG)
    wrong = replace(ssh_map, regions=(ssh_map.regions or ())[:-1])
    (first,) = check(trace, wrong, settle(trace, LOG).theory)
    assert first.axiom == "region_behind"
    assert "All links to them lead through place 5." in first.message


def test_places_right_and_left_of_a_path() -> None:
    ssh_map = first_map(trace_of(BLOCK), PLAIN)
    assert ssh_map.right_of(0, 1) == (1, 2)
    assert ssh_map.right_of(0, -1) == ()
    with pytest.raises(MapError, match="path, direction: expected the id of a path"):
        ssh_map.right_of(9, 1)
    with pytest.raises(MapError, match="expected a map with regions, got one without"):
        replace(ssh_map, regions=None).right_of(0, 1)


def test_regions_survive_a_round_trip_and_renumbering(tmp_path: Path) -> None:
    ssh_map = first_map(trace_of(BLOCK), PLAIN)
    ssh_map.save(tmp_path / "map.json")
    assert SSHMap.load(tmp_path / "map.json").regions == ssh_map.regions
    assert ssh_map.renumbered().regions == ssh_map.regions
    turned = replace(
        ssh_map,
        places=(3, 2, 1, 0),
        dstates=tuple(
            replace(s, place=3 - s.place, direction=-s.direction)  # type: ignore[operator]
            for s in ssh_map.dstates
        ),
        paths=tuple(
            replace(p, order=tuple(3 - q for q in reversed(p.order))) for p in ssh_map.paths
        ),
    )
    turned = with_regions(turned, trace_of(BLOCK))
    assert right_of(turned.regions or (), 0, -1) == (1, 2)
    assert turned.renumbered().regions == ssh_map.regions


def test_maps_without_regions_are_read() -> None:
    data = first_map(trace_of(BLOCK), PLAIN).to_dict()
    del data["regions"]
    assert SSHMap.from_dict(data).regions is None
    assert "regions" not in SSHMap.from_dict(data).to_dict()


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("id", 4, "regions: expected the ids 0, 1, 2"),
        ("places", [7], r"places: expected some places of the map"),
        ("bounds", [[0, 2]], r"bounds: expected pairs of a path of the map and 1 or -1"),
        ("inside", [0], r"inside: expected numbers of earlier regions"),
        ("door", 9, r"places: expected some places of the map"),
    ],
)
def test_malformed_regions_are_refused(field: str, value: object, message: str) -> None:
    data = first_map(trace_of(BLOCK), PLAIN).to_dict()
    data["regions"][0][field] = value
    with pytest.raises(MapError, match=message):
        SSHMap.from_dict(data)


def test_causal_map_has_no_regions() -> None:
    trace = trace_of(CORNER)
    (ssh_map,) = solve(trace, Theory.causal())
    assert ssh_map.regions is None
    assert find_regions(ssh_map, trace, Theory.causal()) == ()


@pytest.mark.slow
def test_time_for_regions_is_shared_among_maps(monkeypatch: pytest.MonkeyPatch) -> None:
    trace = Trace.load(Path(__file__).parent.parent / "examples" / "aces3-route.jsonl")
    assert all(m.regions for m in solve(trace))
    monkeypatch.setattr("ssh_abduction.solver.derived_regions.UNITS", UNITS // 40)
    have = [m.regions is not None for m in solve(trace)]
    assert 0 < sum(have) < len(have) == 4
