"""A drive is added to a known map."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import pytest
from brute_force import Key, key, minimal_maps
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from onto import walks
from strategies import TOYS, theories
from test_framed import framed_theories, framed_traces
from test_together import joint_traces
from truth import NOISE, Noise, random_walk
from worlds import TEE, drive

from ssh_abduction import Solution, SSHMap, Theory, Trace, check, solve
from ssh_abduction.cli import main
from ssh_abduction.data import Action, Corrections, Odometry, load_corrections
from ssh_abduction.data.drives import starts_of, together
from ssh_abduction.data.errors import SolverError, TraceError
from ssh_abduction.runtime.limits import Watch
from ssh_abduction.solution import Status
from ssh_abduction.solution.values import Cost
from ssh_abduction.solver import onto as added_drives
from ssh_abduction.solver.onto import Digest
from ssh_abduction.solver.sources.exact import choosing
from ssh_abduction.theory import Speedups


def keeps(ssh_map: SSHMap) -> Callable[[Key], bool]:
    """Whether a map of the brute force has the dstates and places of an existing map."""
    labels, places, _ = key(ssh_map)

    def allows(found: Key) -> bool:
        first = dict.fromkeys(found[0][: len(labels)])
        number = {s: i for i, s in enumerate(first)}
        if tuple(number[s] for s in found[0][: len(labels)]) != labels:
            return False
        there = [found[1][s] for s in first]
        named: dict[object, int] = {}
        return all(p is None for p in places) or places == tuple(
            named.setdefault(p, len(named)) for p in there
        )

    return allows


@pytest.mark.filterwarnings("ignore:traces 1 and 2 have the same steps")
@pytest.mark.filterwarnings("ignore:action. traces 1 and 2 .*have different names")
@pytest.mark.filterwarnings("ignore:views. trace")
@settings(max_examples=6)
@given(st.data())
def test_onto_lists_minimal_maps_that_keep_the_existing_map(data: st.DataObject) -> None:
    joint = data.draw(joint_traces(), label="trace")
    theory = data.draw(theories(joint), label="theory")
    toys = [toy for toy in TOYS if toy.rules in theory.rules]
    digest = data.draw(st.booleans(), label="digest")
    start = starts_of(joint)[0]
    old, new = joint[:start], joint[start:]
    try:
        together([old, new])
    except TraceError:  # one drive has displacements, and the other one has none
        return
    assume(theory.displacement != "use" or old.has_displacements)
    standing = solve(old, theory.of_steps(0, start), max_maps=1)
    if not standing.maps:
        return
    allows = keeps(standing.maps[0])
    counts, expected = minimal_maps(
        joint, theory, lambda found: allows(found) and all(toy.allows(found) for toy in toys)
    )
    speedups = Speedups(digest=digest)
    few_steps = data.draw(st.sampled_from([0, choosing.FEW_STEPS]), label="few steps")
    with patch.object(choosing, "FEW_STEPS", few_steps):
        if counts is None:
            with pytest.raises(
                SolverError, match="expected a drive that agrees with the existing map"
            ):
                solve(new, theory, onto=standing, max_maps=None, speedups=speedups)
            return
        solution = solve(new, theory, onto=standing, max_maps=None, speedups=speedups)
    assert solution.status is Status.OPTIMAL
    assert {key(ssh_map) for ssh_map in solution.maps} == expected
    assert len(solution.maps) == len(expected)
    assert solution.trace is not None
    assert solution.trace.steps == joint.steps
    for ssh_map in solution.maps:
        assert check(joint, ssh_map, theory) == ()


@pytest.mark.filterwarnings("ignore:traces 1 and 2 have the same steps")
@pytest.mark.filterwarnings("ignore:action. traces 1 and 2 .*have different names")
@pytest.mark.filterwarnings("ignore:views. trace")
@settings(max_examples=6)
@given(framed_traces(most_steps=7), framed_traces(most_steps=4), framed_theories(), st.data())
def test_onto_with_frames_keeps_places_that_only_minimality_joins(
    old: Trace, new: Trace, theory: Theory, data: st.DataObject
) -> None:
    standing = solve(old, theory, max_maps=1)
    if not standing.maps:
        return
    allows, joint = keeps(standing.maps[0]), together([old, new])
    every = solve(joint, theory.replace(prefer=()), max_maps=None)
    kept = [ssh_map for ssh_map in every if allows(key(ssh_map))]
    few_steps = data.draw(st.sampled_from([0, choosing.FEW_STEPS]), label="few steps")
    with patch.object(choosing, "FEW_STEPS", few_steps):
        if not kept:
            with pytest.raises(SolverError, match="expected a drive that agrees"):
                solve(new, theory, onto=standing)
            return
        solution = solve(new, theory, onto=standing, max_maps=None)
    costs = {ssh_map: Cost.of(ssh_map).preferred_by(theory) for ssh_map in kept}
    least = min(costs.values())
    assert {key(m) for m in solution} == {key(m) for m, cost in costs.items() if cost == least}
    assert [check(joint, ssh_map, theory) for ssh_map in solution[:2]] == [()] * len(solution[:2])


def test_drive_keeps_a_place_that_only_minimality_joined() -> None:
    """Two ways of Monday seem to be one way there and back. Tuesday sees another view behind."""
    crossing, end = (1, 1, 1, 1), (0, 0, 1, 0)
    monday = Trace.from_steps(
        "abcdef",
        ["travel", "travel", Action("other", "start"), "travel", "travel"],
        stars=[(1, 0, 0, 0), crossing, end] * 2,
        name="monday",
    )
    standing = solve(monday)
    assert [s.place for s in standing[0].dstates] == [0, 1, 2, 2, 1, 0]
    tuesday = Trace.from_steps("bz", ["around"], stars=[crossing] * 2, name="tuesday")
    found = solve(tuesday, onto=standing)[0]
    assert [s.place for s in found.dstates] == [0, 1, 2, 2, 1, 0, 1, 1]


def test_drive_keeps_a_dstate_that_the_fewest_dstates_would_split() -> None:
    """Together, the drives have more steps than the readable encodings are used for."""
    old, new = (walk.trace for walk in walks(5, 60, 2, seed=14201, looks=8))
    standing = solve(old, Theory.causal(), max_maps=1)
    found = solve(new[:9], onto=standing, max_maps=1)[0]
    assert found.dstate_at[: len(old)] == standing[0].dstate_at
    assert len(found.dstates) <= len(standing[0].dstates) + 9


MONDAY = Trace.from_steps("abcd", ["travel", "around", "travel"], name="monday")
TUESDAY = Trace.from_steps("bcd", ["around", "travel"], name="tuesday")


@pytest.mark.filterwarnings("ignore:.*no view in common")
def test_solve_onto_says_that_a_drive_joins_pieces(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(added_drives, "READABLE", 0)  # lay all drives
    maps = str(tmp_path / "m.json")
    for name, views in (("begin", "ab"), ("end", "cde"), ("all", "abcde")):
        moves = [(9.0, 0, 0)] * (len(views) - 1)
        drive = Trace.from_steps(views, ["travel"] * len(moves), displacements=moves, name=name)
        drive.save(tmp_path / f"{name}.jsonl")
        onto = ["--onto", maps] if name != "begin" else []
        assert main(["solve", str(tmp_path / f"{name}.jsonl"), *onto, "-o", maps]) in (0, 10)
    told = capsys.readouterr().out
    assert "the map of begin is kept; the map is in 2 pieces" in told
    assert "the 2 pieces of the map of begin, end are kept, and joined to 1; the map joins" in told


@pytest.mark.filterwarnings("always:traces 1 and 2 have the same steps")
def test_solve_onto_adds_a_drive_in_the_shell(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for trace in (MONDAY, TUESDAY):
        true = tuple(replace(step, truth="x") for step in trace)  # files of maps leave it out
        replace(trace, name=None, steps=true).save(tmp_path / f"{trace.name}.jsonl")
    monday, tuesday, maps = (str(tmp_path / f) for f in ("monday.jsonl", "tuesday.jsonl", "m.json"))
    assert main(["solve", monday, "-o", maps]) == 0
    assert main(["name", maps, "p0", "kitchen"]) == 0
    capsys.readouterr()
    assert main(["solve", tuesday, "--onto", maps, "-o", maps]) == 0
    told = capsys.readouterr().out
    assert "the map of monday is kept; the map joins the 2 drives: monday, tuesday" in told
    assert "0 (kitchen)" in told
    loaded = Solution.load(maps)
    assert [drive.name for drive in loaded.drives] == ["monday", "tuesday"]
    assert loaded.maps == solve([MONDAY, TUESDAY]).maps
    assert loaded.trace is not None
    assert check(loaded.trace, loaded.maps[0], loaded.theory) == ()
    again = json.loads(Path(maps).read_text())
    assert again["onto"] == ["monday"]
    assert loaded.to_dict()["onto"] == ["monday"]
    assert main(["solve", tuesday, "--onto", maps]) == 0
    told = capsys.readouterr()
    assert "have the same steps (tuesday, tuesday); give each drive once" in told.err
    assert "joins the 3 drives: monday, tuesday, tuesday-2" in told.out


def test_onto_obeys_corrections_beside_the_map_and_keeps_its_names(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    MONDAY.save(tmp_path / "monday.jsonl")
    TUESDAY.save(tmp_path / "tuesday.jsonl")
    maps, grown = str(tmp_path / "maps.json"), str(tmp_path / "grown" / "maps.json")
    Path(grown).parent.mkdir()
    assert main(["solve", str(tmp_path / "monday.jsonl"), "-o", maps]) == 0
    assert main(["name", maps, "p1", "kitchen"]) == 0
    assert main(["correct", maps, "--elsewhere", "monday:0,monday:3"]) == 0
    adding = ["solve", str(tmp_path / "tuesday.jsonl"), "--onto", maps, "-o", grown]
    assert main(adding) == 1
    assert "a map that obeys 'elsewhere: monday:0, monday:3'" in capsys.readouterr().err
    assert main(["solve", str(tmp_path / "monday.jsonl"), "-o", maps]) == 0
    capsys.readouterr()
    assert main(adding) == 0
    told = capsys.readouterr()
    assert "obeying 2 corrections of " in told.err
    assert "nothing observed separates these places" in told.out
    assert Solution.load(grown).theory.elsewhere == ((0, 3),)
    # The corrections are kept beside the grown map.
    assert load_corrections(Path(grown).parent).pairs == load_corrections(tmp_path).pairs
    # A second name does not make the first one disappear.
    assert main(["name", grown, "p0", "porch"]) == 0
    assert main(["show", grown]) == 0
    shown = capsys.readouterr().out
    assert "1 (kitchen)" in shown
    assert "0 (porch)" in shown


def test_onto_refuses_a_drive_that_contradicts_the_map() -> None:
    """Monday saw b twice. Its minimal map makes that one dstate; Tuesday shows that it is two."""
    monday = Trace.from_steps("abcb", ["on", "on", "back"], name="monday")
    tuesday = Trace.from_steps("bcb", ["on", "back"], name="tuesday")
    theory = Theory.causal()
    standing = solve(monday, theory)
    assert standing[0].dstate_at == (0, 1, 2, 1)
    assert solve(tuesday, onto=standing)[0].dstate_at == (0, 1, 2, 1, 1, 2, 1)
    wrong = Trace.from_steps("cbd", ["back", "on"], name="tuesday")
    sure = theory.replace(same=[(2, 4)])  # the two steps that show c
    with pytest.raises(SolverError, match=r"got tuesday: .*; solve all drives together"):
        solve(wrong, sure, onto=standing)
    assert solve([monday, wrong], sure)[0].dstate_at == (0, 1, 2, 3, 2, 3, 4)


@pytest.mark.slow
def test_onto_adds_a_drive_with_displacements_by_cost() -> None:
    monday = Trace.from_steps(
        "abcd", ["travel", "around", "travel"], displacements=[(4, 0, 0), (0, 0, 3.14), (4, 0, 0)]
    )
    tuesday = Trace.from_steps("cd", ["travel"], displacements=[(4.1, 0, 0)], name="tuesday")
    standing, joint = solve(monday), solve([monday, tuesday])
    solution = solve(tuesday, onto=standing)
    assert joint.weighed is not None
    assert solution.weighed is not None
    assert solution.maps == joint.maps
    assert solution.weighed.nats == pytest.approx(joint.weighed.nats)
    assert solution.confidence == pytest.approx(joint.confidence, abs=0.05)
    assert solution.by_minimality == ()
    for rival in solution.weighed.rivals:
        assert rival.dstates[:4] == standing.maps[0].dstate_at


def test_solution_onto_a_map_is_saved_and_read(tmp_path: Path) -> None:
    """The digest of the old drive has more steps than the old drive."""
    old = Trace.from_steps("zcca", ["around", "left", "around"], name="old")
    new = Trace.from_steps("c", [], name="new")
    solution = solve(new, onto=solve(old, Theory.causal()))
    assert solution.effort.prefix <= len(old) + len(new)
    solution.save(tmp_path / "maps.json")
    assert Solution.load(tmp_path / "maps.json") == solution


def test_onto_without_time_keeps_the_existing_map() -> None:
    """The first map of a search makes every step a new dstate, so it does not keep a map."""
    around = Trace.from_steps("abababab" * 2, ["travel", "left"] * 7 + ["travel"], name="monday")
    again = Trace.from_steps("ababab", ["travel", "left"] * 2 + ["travel"], name="tuesday")
    standing = solve(around)
    assert len(standing[0].dstates) < len(around)
    solution = solve(again, onto=standing, time_limit=1e-9)
    assert (solution.status, solution.stopped) == (Status.FEASIBLE, "time limit")
    assert solution.trace is not None
    assert check(solution.trace, solution[0], solution.theory) == ()
    assert solution[0].dstate_at[: len(around)] == standing[0].dstate_at


def test_onto_corrects_misread_views_of_the_map() -> None:
    moved = [(10.0, 0.0, 0.0), (0.0, 0.0, 1.5708)] * 8
    rounds = Trace.from_steps(
        [*"abcdefgh", *"abXdefgh", "a"], ["travel", "left"] * 8, displacements=moved, name="monday"
    )
    bare = Theory(star="none", boundary="none")
    standing = solve(rounds, bare.replace(misread=0.9), work_limit=1)
    assert [(fault.kind, fault.step) for fault in standing[0].faults] == [("misread", 10)]
    tuesday = Trace.from_steps("cde", ["travel", "left"], displacements=moved[:2], name="tuesday")
    joint = solve(tuesday, onto=standing, work_limit=1)
    assert joint.trace is not None
    assert joint.trace.steps[10].view == "c"
    assert joint[0].faults == ()
    assert len(joint[0].dstates) == 8


def test_onto_refuses_a_solution_without_map_or_trace() -> None:
    standing = solve(MONDAY)
    for bad in (replace(standing, trace=None), replace(standing, maps=())):
        with pytest.raises(SolverError, match="onto: expected a solution with a map and its trace"):
            solve(TUESDAY, onto=bad)
    with pytest.raises(SolverError, match="onto: expected a Solution, got"):
        solve(TUESDAY, onto=standing[0])  # type: ignore[arg-type]
    faulty = solve(MONDAY, Theory.causal().replace(slipped=1.0))
    with pytest.raises(SolverError, match="expected a map without faults"):
        solve(TUESDAY, onto=faulty)
    with pytest.raises(SolverError, match="expected a map without faults"):
        solve(TUESDAY, Theory(misread=1.0), onto=standing)
    with pytest.raises(SolverError, match="onto: expected a topological theory, as the existing"):
        solve(TUESDAY, Theory.causal(), onto=standing)


def test_digest_has_each_link_once() -> None:
    long = Trace.from_steps("ab" * 50, ["travel"] * 99, name="long")
    standing = solve(long, Theory.causal())
    digest = Digest.of(long, standing[0], short=True)
    assert digest.trace.views == ("a", "b", "a")
    assert digest.labels == (0, 1, 0)
    short = replace(long[:7], name="short")
    assert solve(short, onto=standing)[0].dstate_at == (0, 1) * 50 + (0, 1, 0, 1, 0, 1, 0)


def test_onto_turns_frames_to_the_first_visit_of_each_place() -> None:
    """The digest of Monday begins with a dstate that Monday was at only later."""
    monday = drive(TEE, "S", "S", "RLRRTR", stars=True)
    tuesday = replace(drive(TEE, "S", "W", "RLR", stars=True), name="tuesday")
    for theory in (Theory(star="frame"), Theory(star="gateways")):
        solution = solve(tuesday, theory, onto=solve(monday, theory))
        assert solution.trace is not None
        assert [check(solution.trace, ssh_map, solution.theory) for ssh_map in solution] == [()]


@pytest.mark.filterwarnings("ignore:traces 1 and 2 have the same steps")
def test_onto_keeps_names() -> None:
    monday = Trace.from_steps("abcd", ["travel", "around", "travel"], name="monday")
    said = Corrections.for_drives(monday).with_name("kitchen", "place", "monday:1")
    said = said.with_name("corridor", "path", "monday:0")
    solution = solve(monday, corrections=said)
    for name in ("tuesday", "friday"):
        solution = solve(Trace.from_steps("xb", ["travel"], name=name), onto=solution)
        ssh_map = solution.maps[0]
        kitchen = ssh_map.dstates[ssh_map.dstate_at[1]]
        assert ssh_map.name_of("place", kitchen.place) == "kitchen"
        assert ssh_map.name_of("path", kitchen.path) == "corridor"
        assert len(ssh_map.names) == 2
    room = Trace.from_steps("abcdef", ["travel", "right", "travel", "left", "travel"], name="room")
    said = Corrections.for_drives(room).with_name("west wing", "region", "room:0")
    grown = solve(replace(room[:4], name="again"), onto=solve(room, corrections=said)).maps[0]
    assert [name.text for name in grown.names] == ["west wing"]
    unnamed = Corrections.for_drives(monday)
    last = Trace.from_steps("xb", ["travel"], name="last")
    assert solve(last, onto=solution, corrections=unnamed).maps[0].names == ()


def test_onto_counts_the_time_of_all_searches() -> None:
    """The time of all searches counts, not only that of the last one."""
    monday = Trace.from_steps("abcd", ["travel", "around", "travel"], name="monday")
    solution = solve(monday)
    with patch.object(Watch, "seconds", lambda watch: 7.0):
        added = solve(Trace.from_steps("ab", ["travel"], name="tuesday"), onto=solution)
    assert added.seconds.total == 7.0


@pytest.mark.slow
def test_onto_gives_a_long_drive_with_displacements_a_probability() -> None:
    """The drive is laid on the map without a search of all steps."""
    noise = Noise(Odometry(**NOISE))
    walks = [random_walk(3, 45, 33, noise, drive).trace for drive in (0, 1)]
    standing = solve(walks[0], max_maps=1, time_limit=5)
    solution = solve(walks[1], onto=standing, max_maps=1)
    assert solution.stopped == "no proof"
    assert solution.weighed is not None
    assert solution.weighed.searched
    assert 0.5 < solution.confidence < 1
    assert len(solution.weighed.rivals) > 1
    old = standing.maps[0].dstate_at
    assert all(rival.dstates[: len(old)] == old for rival in solution.weighed.rivals)
