"""Gateways that change between drives, against a brute force and the checker."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from brute_force import (
    Key,
    Labels,
    _goes_straight,
    _headings,
    consistent_maps,
    fewest_gateway_changes,
    key,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import STARS, traces
from test_gateways import traces as bearings

from ssh_abduction import SSHMap, Theory, Trace, explain_pair, solve
from ssh_abduction.checker.checker import check
from ssh_abduction.cli import main
from ssh_abduction.data import (
    Action,
    Fault,
    MapError,
    Odometry,
    TheoryError,
    drives_of,
    together,
)
from ssh_abduction.explain import explain_place
from ssh_abduction.page.content import content_of
from ssh_abduction.robot_logs import log_report
from ssh_abduction.solver.sources.metric.beam import Beam
from ssh_abduction.solver.steps.log import Log
from ssh_abduction.theory.settle import settle

MONDAY = Trace.from_steps(
    "abcd",
    ["travel", "around", "travel"],
    stars=[(1, 1, 0, 0), (0, 0, 1, 0), (1, 0, 0, 0), (0, 0, 1, 1)],
    name="monday",
)
TUESDAY = Trace.from_steps(
    "abcd",
    ["travel", "around", "travel"],
    stars=[(1, 0, 0, 0), (0, 0, 1, 0), (1, 0, 0, 0), (0, 0, 1, 0)],
    name="tuesday",
)
SAID = "the gateway right at the first dstate of place 0 was open on monday and closed on tuesday"


@st.composite
def drives_with_stars(draw: st.DrawFn) -> Trace:
    """Tiny traces of two or three drives, with stars and few actions."""
    trace = draw(traces(max_steps=6).filter(lambda trace: len(trace) > 2))
    last = len(trace) - 1
    starts = draw(st.sets(st.integers(1, last), min_size=1, max_size=2))
    some = draw(st.lists(st.sampled_from(STARS), min_size=1, max_size=3))
    steps = list(trace.without_displacements().steps)
    for t in range(len(steps)):
        star = draw(st.sampled_from(some))
        k = draw(st.integers(0, 3))
        steps[t] = replace(steps[t], star=star[k:] + star[:k])
    for t in starts:
        steps[t - 1] = replace(steps[t - 1], action=Action(f"start at {t}", "start"))
    return Trace(tuple(steps))


def fewest_changes(trace: Trace, theory: Theory, found: Key) -> int | None:
    """The fewest changes of a map, over all headings that it may have; None if it has none."""
    labels, places, courses = found
    at: Labels = tuple(p for p in places if p is not None)
    on = frozenset(theory.axioms) - {"star_frame", "star_pattern"}
    stars = tuple(step.openings for step in trace)
    counts = [
        count
        for headings in _headings(labels, at, trace.actions, stars, on)
        if _goes_straight(labels, at, courses, headings, on)
        for count in _changes(trace, [at[label] for label in labels], headings)
    ]
    return min(counts, default=None)


def _changes(trace: Trace, at: list[int], headings: tuple[int, ...]) -> Iterator[int]:
    """Yield the number of changes; nothing if a gateway differs within a drive."""
    count = 0
    for place in set(at):
        seen = []
        for drive in drives_of(trace):
            states = {
                tuple(
                    bool((trace.steps[t].openings or ())[(k - headings[t]) % 4]) for k in range(4)
                )
                for t in range(drive.first, drive.stop)
                if at[t] == place
            }
            if len(states) > 1:
                return
            seen += states
        count += sum(
            a != b for one, other in pairwise(seen) for a, b in zip(one, other, strict=True)
        )
    yield count


def solved_as(trace: Trace, theory: Theory, costs: dict[Key, tuple[float, ...]]) -> None:
    """Assert that the answer is the cheapest of some maps, with the cost of the brute force."""
    least = min(costs.values(), default=(0.0,))
    solution = solve(trace, theory, max_maps=None, time_limit=100)
    assert solution.complete
    assert {key(m) for m in solution.maps} == {k for k, cost in costs.items() if cost == least}
    for ssh_map in solution.maps:
        assert check(trace, ssh_map, theory) == ()
        assert 10 * len(ssh_map.dstates) + sum(10 * f.cost for f in ssh_map.faults) == least[0]


@settings(max_examples=8)
@given(st.data())
def test_maps_with_changes_equal_the_brute_force(data: st.DataObject) -> None:
    trace = data.draw(drives_with_stars(), label="trace")
    price = data.draw(st.sampled_from([0.5, 1.0, 2.0]), label="price")
    boundary: Any = data.draw(st.sampled_from(["none", "strict"]), label="boundary")
    theory = Theory(changed=price, boundary=boundary, star="frame")
    bare = theory.replace(changed=0.0, without=("star_frame", "star_pattern"))
    costs: dict[Key, tuple[float, ...]] = {}
    for found, counts in consistent_maps(trace, bare):
        changes = fewest_changes(trace, settle(trace, theory).theory, found)
        if changes is not None:
            tenths = 10 * counts.dstates + round(10 * price) * changes
            costs[found] = (tenths, counts.paths, counts.places)
    solved_as(trace, theory, costs)


@st.composite
def drives_at_bearings(draw: st.DrawFn) -> Trace:
    """Tiny traces of two drives, whose stars are bearings. The second may lack a gateway."""
    trace = draw(bearings().filter(lambda trace: 2 < len(trace) < 5))
    start = draw(st.integers(1, len(trace) - 1))
    steps = list(trace.steps)
    for t in range(start, len(steps)):
        star = steps[t].star or ()
        if draw(st.booleans()) and all(getattr(g, "opposite", None) is None for g in star):
            steps[t] = replace(steps[t], star=star[: draw(st.integers(0, len(star)))])
    steps[start - 1] = replace(steps[start - 1], action=Action("tuesday", "start"))
    return Trace(tuple(steps))


@pytest.mark.slow
@settings(max_examples=6)
@given(drives_at_bearings(), st.sampled_from([0.5, 1.0, 2.0]))
def test_maps_with_changes_at_bearings_equal_the_brute_force(trace: Trace, price: float) -> None:
    theory = Theory(changed=price, star="gateways", boundary="none")
    on = frozenset(settle(trace, theory).theory.axioms)
    bare = theory.replace(changed=0.0, star="none")
    costs: dict[Key, tuple[float, ...]] = {}
    for found, counts in consistent_maps(trace, bare):
        labels, places, courses = found
        at = tuple(p for p in places if p is not None)
        changes = fewest_gateway_changes(trace, labels, at, courses, on)
        if changes is not None:
            tenths = 10 * counts.dstates + round(10 * price) * changes
            costs[found] = (tenths, counts.paths, counts.places)
    solved_as(trace, theory, costs)


def test_change_of_a_gateway_has_a_sentence_and_a_place(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    solution = solve([MONDAY, TUESDAY], Theory(changed=1.5))
    (ssh_map,) = solution.maps
    assert ssh_map.dstate_at == (0, 1, 2, 3, 0, 1, 2, 3)
    (fault,) = ssh_map.faults
    assert str(fault) == SAID
    assert (fault.step, fault.place, fault.gateway, fault.cost) == (4, 0, 1, 1.5)
    for trace in (MONDAY, TUESDAY):
        trace.save(tmp_path / f"{trace.name}.jsonl")
    files = [str(tmp_path / f"{name}.jsonl") for name in ("monday", "tuesday")]
    maps = str(tmp_path / "maps.json")
    assert main(["solve", *files, "--together", "--set", "changed=1.5", "-o", maps]) == 0
    assert SAID in capsys.readouterr().out
    assert main(["compare", maps]) == 0
    assert f"  in the map, {SAID}\n" in capsys.readouterr().out
    assert main(["compare", maps, "--json"]) == 0
    data = json.loads(Path(maps).read_text())["maps"][0]
    assert json.loads(capsys.readouterr().out)["faults"] == data["faults"]
    assert content_of(solution)["faults"] == [(4, SAID, "changed")]
    assert any(SAID in row for row in log_report._faults(solution).table)
    assert data["faults"][0]["gateway"] == 1
    assert SSHMap.from_dict(data) == ssh_map
    data["faults"][0]["gateway"] = 4
    with pytest.raises(MapError, match="gateway: expected a slot, 0 to 3"):
        SSHMap.from_dict(data)


@pytest.mark.slow
def test_explain_names_a_change_and_its_cost(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    trace, theory = together([MONDAY, TUESDAY]), Theory(changed=1.5)
    said = (f"{SAID}; this change costs 1.5 dstates",)
    assert explain_pair(trace, 0, 4, theory).changes == said
    assert explain_place(trace, 0, theory=theory).changes == said
    assert explain_pair(trace, 1, 5, theory).changes == ()
    assert explain_place(trace, 1, theory=theory).changes == ()
    assert explain_place(trace, 0, theory=theory.replace(changed=0.0)).changes == ()
    trace.save(tmp_path / "joint.jsonl")
    where = str(tmp_path / "joint.jsonl")
    for asked in (["monday:0", "tuesday:0"], ["p0"]):
        assert main(["explain", where, *asked, "--set", "changed=1.5"]) == 0
        assert "\n".join(said) in capsys.readouterr().out
    assert main(["explain", where, "p0", "--set", "changed=1.5", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["changes"] == [*said]


def test_no_changes_without_a_price() -> None:
    (ssh_map, *_) = solve([MONDAY, TUESDAY]).maps
    assert len(ssh_map.dstates) == 8
    (ssh_map,) = solve([MONDAY, TUESDAY[:1]], Theory(changed=1.5)).maps[:1]
    assert [fault.kind for fault in ssh_map.faults] in ([], ["changed"])


def test_no_changes_within_one_drive() -> None:
    """The place of step 0 has a way to the right, and that of step 3 has none."""
    trace = replace(MONDAY, steps=(*MONDAY.steps[:3], replace(MONDAY.steps[3], star=(0, 0, 1, 0))))
    for changed in (0.0, 1.5):
        (ssh_map, *_) = solve(trace, Theory(changed=changed, star="frame")).maps
        assert ssh_map.place_of(0) != ssh_map.place_of(3)
        assert ssh_map.faults == ()


@pytest.mark.parametrize(
    ("faults", "said"),
    [
        ((), "the map hides it"),
        ((Fault(4, "changed", "closed on tuesday", "open on monday", 1.5, 0, 2),), "no drives"),
        ((Fault(5, "changed", "closed on tuesday", "open on monday", 1.5, 0, 1),), "no drives"),
        ((Fault(4, "changed", "closed on tuesday", "open on monday", 2.5, 0, 1),), "by the theory"),
        ((Fault(4, "changed", "closed on tuesday", "open on monday", 1.5, 0, 1),) * 2, "twice"),
    ],
)
def test_the_checker_judges_changes(faults: tuple[Fault, ...], said: str) -> None:
    theory = Theory(changed=1.5)
    (ssh_map,) = solve([MONDAY, TUESDAY], theory).maps
    trace = together([MONDAY, TUESDAY])
    assert check(trace, ssh_map, theory) == ()
    wrong = replace(ssh_map, faults=faults)
    assert any(said in v.message for v in check(trace, wrong, theory))
    # A theory without changes does not allow them.
    assert {"star_frame", "star_pattern"} <= {v.axiom for v in check(trace, ssh_map, Theory())}


@pytest.mark.parametrize(
    ("theory", "said"),
    [
        ({"changed": 1.5, "misread": 1.5}, "without other faults, .* got misread"),
        ({"changed": -1}, "changed: expected a number of dstates"),
        ({"changed": 1.5, "star": "none"}, "read by star=frame or gateways, got"),
    ],
)
def test_changes_are_refused_for_theories_without_gateways(
    theory: dict[str, Any], said: str
) -> None:
    with pytest.raises(TheoryError, match=said):
        solve([MONDAY, TUESDAY], Theory(**theory))
    with pytest.raises(TheoryError, match="got level=causal"):
        Theory.causal().replace(changed=1.5)


@pytest.mark.slow
def test_beam_finds_changes_between_drives_with_displacements() -> None:
    """On Tuesday there is no way to the right at the first end of a corridor.

    The beam is the only engine: the trace is longer than the readable encodings take.
    """
    travels = ["travel", "travel", "around", "travel", "travel", "around"]
    moved = [(5.0, 0.0, 0.0)] * 2 + [(0.0, 0.0, math.pi)]
    looks = ["a", "b", "c", "d", "e", "f"]
    stars = [[1, 1, 0, 0], [1, 0, 1, 0], [0, 0, 1, 0], [1, 0, 0, 0], [1, 0, 1, 0], [0, 0, 1, 1]]
    closed = [[1, 0, 0, 0], *stars[1:5], [0, 0, 1, 0]]
    monday, tuesday = (
        Trace.from_steps(
            looks * 6,
            (travels * 6)[:-1],
            stars=seen * 6,
            displacements=(moved * 12)[:-1],
            odometry=Odometry(along=0.05, heading=0.01),
            name=name,
        )
        for name, seen in (("monday", stars), ("tuesday", closed))
    )
    solution = solve([monday, tuesday], Theory(changed=0.5))
    ssh_map = solution.maps[0]
    assert ssh_map.dstate_at == tuple(range(6)) * 12
    (fault,) = ssh_map.faults
    assert str(fault) == "the gateway south of place 0 was open on monday and closed on tuesday"
    assert solution.trace is not None
    assert check(solution.trace, ssh_map, Theory(changed=0.5)) == ()


def test_beam_finds_two_changes_at_the_start_of_a_drive() -> None:
    """On Tuesday the first end of a corridor looks like the other end, as two ways are closed."""
    there = ["travel", "travel", "travel", "around"]
    moved = [(5.0, 0.0, 0.0)] * 3 + [(0.0, 0.0, math.pi)]
    stars = [[1, 1, 0, 1], *[[1, 0, 1, 0]] * 2, [0, 0, 1, 0]]
    stars += [[1, 0, 0, 0], *[[1, 0, 1, 0]] * 2, [0, 1, 1, 1]]
    closed = [[1, 0, 0, 0], *stars[1:7], [0, 0, 1, 0]]
    monday, tuesday = (
        Trace.from_steps(
            list("abcaefgh") * 4,
            (there * 8)[:-1],
            stars=seen * 4,
            displacements=(moved * 8)[:-1],
            odometry=Odometry(along=0.05, heading=0.01),
            name=name,
        )
        for name, seen in (("monday", stars), ("tuesday", closed))
    )
    problem = settle(together([monday, tuesday]), Theory(changed=1.5))
    beam = Beam(problem, Log(problem.trace, problem.theory, problem.pairs), 1)
    ssh_map = next(beam.maps())
    assert ssh_map.labels == tuple(range(8)) * 8
    assert [(fault.kind, fault.place) for fault in ssh_map.faults] == [("changed", 0)] * 2


THREE = [(0, 120, 240), (180,), (0,), (60, 180, 300)]


def at_bearings(name: str, stars: list[Any]) -> Trace:
    """A drive along a corridor and back. Its stars are bearings."""
    return Trace.from_steps("abcd", ["travel", "around", "travel"], stars=stars, name=name)


def test_change_at_a_bearing_has_a_sentence_and_a_place() -> None:
    """Gateways of three drives: one closes on Tuesday, and opens again on Wednesday."""
    closed = [(0, 120.5), (180,), (0,), (180, 300)]
    names = "monday", "tuesday", "wednesday"
    again = [(0.5, 120, 240), *THREE[1:]]
    drives = [at_bearings(n, s) for n, s in zip(names, (THREE, closed, again), strict=True)]
    theory = Theory(changed=0.5)
    solution = solve(drives, theory)
    (ssh_map,) = solution.maps
    assert ssh_map.dstate_at == tuple(range(4)) * 3
    gateway = "the gateway at 240 degrees of place 0 was"
    assert [*map(str, ssh_map.faults)] == [
        f"{gateway} open on monday and closed on tuesday",
        f"{gateway} closed on tuesday and open on wednesday",
    ]
    data = json.loads(json.dumps(ssh_map.to_dict()))
    assert data["faults"][0]["bearing"] == 240
    assert SSHMap.from_dict(data) == ssh_map
    data["faults"][0]["bearing"] = 360
    with pytest.raises(MapError, match="bearing: expected degrees, 0 to 359"):
        SSHMap.from_dict(data)
    trace = together(drives)
    assert check(trace, ssh_map, theory) == ()
    for faults, said in (
        ((), "was open on monday and closed on tuesday: the map hides it"),
        ((replace(ssh_map.faults[0], bearing=120),), "but no drives show it"),
        ((*ssh_map.faults, ssh_map.faults[0]), "twice"),
    ):
        wrong = replace(ssh_map, faults=faults)
        assert any(said in v.message for v in check(trace, wrong, theory))
    assert {"gateway_frame"} <= {v.axiom for v in check(trace, ssh_map, Theory())}


def test_path_goes_through_a_gateway_that_is_closed_on_one_drive() -> None:
    """The second drive starts where the gateway ahead is closed, and comes by it later."""
    go = ["around", "travel", "travel"]
    monday = Trace.from_steps("xabc", go, stars=[(180,), (0,), (0, 180), (180,)], name="monday")
    tuesday = Trace.from_steps("b", [], stars=[(180,)], name="tuesday")
    theory = Theory(changed=0.5, star="gateways")
    (ssh_map, *_) = solve([monday, tuesday], theory).maps
    assert ssh_map.labels == ((0, 1, 2, 3), (2,))
    assert [fault.bearing for fault in ssh_map.faults] == [0]


def test_three_changes_do_not_join_two_places() -> None:
    four = at_bearings("monday", [(0, 60, 120, 240), *THREE[1:3], (60, 180, 240, 300)])
    one = at_bearings("tuesday", [(0,), *THREE[1:3], (180,)])
    (ssh_map, *_) = solve([four, one], Theory(changed=0.1, star="gateways")).maps
    assert ssh_map.place_of(0) != ssh_map.place_of(4)
