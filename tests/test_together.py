"""Several drives through one building, as one trace."""

from __future__ import annotations

import json
import math
import pickle
from collections.abc import Hashable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import test_weighing
import truth
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import theories, traces
from test_property import checker_rejects_foreign_maps, solver_agrees
from together import cut, of_mazes, of_worlds, report_of_guesses

from ssh_abduction import (
    Localiser,
    OnlineMapper,
    Solution,
    SSHMap,
    Theory,
    Trace,
    explain_pair,
    route,
    solve,
)
from ssh_abduction.checker.checker import check
from ssh_abduction.checker.cost_claims import misfit
from ssh_abduction.cli import main
from ssh_abduction.data import Action, MapError, Odometry, TraceError, drives_of, together
from ssh_abduction.data.drives import fingerprints_of, named_steps, pieces_in_words
from ssh_abduction.data.maps import Fault
from ssh_abduction.data.odometry import Closure
from ssh_abduction.explain import explain_trace
from ssh_abduction.rivals import Listing, compare, difference, joins_of_drives
from ssh_abduction.rivals.listing import DriveJoin, DrivePair
from ssh_abduction.solver.costs.misfit import Misfit
from ssh_abduction.solver.geometry.poses import Poses
from ssh_abduction.solver.sources.metric.beam import Beam, Extending
from ssh_abduction.solver.sources.metric.hypothesis import Pieces, headings_by_turn
from ssh_abduction.solver.sources.metric.joint_drives import Joining
from ssh_abduction.solver.steps.log import Log
from ssh_abduction.theory.settle import settle


@st.composite
def joint_traces(draw: st.DrawFn, closures: bool = False) -> Trace:
    """Tiny traces of two or three drives; with `closures`, also between drives."""
    trace = draw(traces(closures=closures).filter(lambda trace: len(trace) > 1))
    last = len(trace) - 1
    starts = draw(st.sets(st.integers(1, last), min_size=1, max_size=min(2, last)))
    steps = list(trace.steps)
    for t in starts:
        steps[t - 1] = replace(steps[t - 1], action=Action(f"start at {t}", "start"))
        steps[t] = replace(steps[t], displacement=None, covariance=None)
    return replace(trace, steps=tuple(steps))


@settings(max_examples=7)
@given(st.data())
def test_joint_maps_equal_the_brute_force(data: st.DataObject) -> None:
    solver_agrees(data, data.draw(joint_traces(), label="trace"))


@pytest.mark.slow
@settings(max_examples=5)
@given(st.data())
def test_cheapest_joint_maps_equal_plain_least_squares(data: st.DataObject) -> None:
    drawn = joint_traces(closures=True).filter(lambda trace: trace.has_displacements)
    trace = data.draw(drawn, label="trace")
    theory = data.draw(theories(trace, fixed=("displacement",)), label="theory")
    test_weighing.agree(trace, test_weighing.weighed(theory))


@pytest.mark.slow
@settings(max_examples=4)
@given(st.data())
def test_checker_rejects_joint_maps_outside_the_brute_force(
    data: st.DataObject,
) -> None:
    checker_rejects_foreign_maps(data, data.draw(joint_traces(), label="trace"))


MONDAY = Trace.from_steps("abcd", ["travel", "around", "travel"], name="monday")
TUESDAY = Trace.from_steps("bcd", ["around", "travel"], name="tuesday")


def test_together_joins_and_splits_drives() -> None:
    joint = together([MONDAY, TUESDAY, MONDAY[:1]], names=["monday", "tuesday", "again"])
    assert [(d.name, d.first, d.stop) for d in drives_of(joint)] == [
        ("monday", 0, 4),
        ("tuesday", 4, 7),
        ("again", 7, 8),
    ]
    ssh_map = solve(joint).maps[0]
    assert [*map(len, ssh_map.labels)] == [4, 3, 1]
    assert sum(ssh_map.labels, ()) == ssh_map.dstate_at
    assert SSHMap.from_dict(ssh_map.to_dict()).labels == ssh_map.labels
    assert joint[5:].drive == "tuesday"
    assert [drive.name for drive in drives_of(joint[5:])] == ["tuesday", "again"]
    assert drives_of(joint.prefix(4)) == drives_of(joint)[:1]
    assert together([joint.prefix(4), joint[4:7]]).steps == joint.prefix(7).steps
    assert drives_of(MONDAY)[0].name == "monday"


def test_joint_trace_survives_a_round_trip(tmp_path: Path) -> None:
    joint = together([MONDAY, TUESDAY])
    joint.save(tmp_path / "joint.jsonl")
    read = Trace.load(tmp_path / "joint.jsonl")
    assert read == joint
    assert read.digest == joint.digest
    assert drives_of(read) == drives_of(joint)


WITH_STARS = Trace.from_steps("ab", ["travel"], stars=[(1, 0, 0, 0), (0, 0, 1, 0)])
BEARINGS = Trace.from_steps("ab", ["travel"], stars=[[0], [180]])
MOVED = Trace.from_steps("ab", ["travel"], displacements=[(1, 0, 0)])
NOISY = Trace.from_steps("ab", ["travel"], displacements=[(1, 0, 0)], odometry={"scale": 0.5})
OTHER = Trace.from_steps("ab", [{"name": "travel", "kind": "turn", "turn": "left"}])


@pytest.mark.parametrize(
    ("parts", "names", "said"),
    [
        ([], None, "traces: expected at least one trace, got none"),
        ([MONDAY, "tuesday"], None, r"traces\[1\]: expected a Trace, got 'tuesday'"),
        ([MONDAY, TUESDAY], ["one", "one"], "a different name for each drive, got 'one' twice"),
        ([MONDAY, TUESDAY], ["one"], "names: expected 2, one per drive, got 1"),
        ([MONDAY, TUESDAY], ["one", 2], r"names\[1\]: expected a text, got 2"),
        ([MONDAY, WITH_STARS], None, "star: expected the same .* no stars in trace 1 and four"),
        ([WITH_STARS, BEARINGS], None, "star: .* four openings in trace 1 and bearings in trace 2"),
        ([MONDAY, MOVED], None, "displacement: .* no displacements in trace 1 and displacements"),
        ([MOVED, NOISY], None, "odometry: expected the same in all traces"),
        ([MONDAY, OTHER], None, "action: expected one meaning of 'travel' in all traces, got"),
        ([MONDAY, TUESDAY], ["travel", "b"], "'travel' in all traces, got 'the name of a drive'"),
    ],
)
def test_together_refuses_traces_that_do_not_fit(parts: Any, names: Any, said: str) -> None:
    with pytest.raises(TraceError, match=said):
        together(parts, names)


def test_drives_keep_the_noise_of_their_own_odometry() -> None:
    precise = replace(MOVED, odometry=Odometry(along=0.001))
    joint = together([MOVED, precise], names=["monday", "tuesday"])
    assert joint.covariance(1) == MOVED.covariance(1)
    assert joint.covariance(3) == precise.covariance(1) != MOVED.covariance(1)
    assert joint.covariance(2) is None
    assert joint.odometry == precise.odometry


def test_joint_trace_keeps_common_header_fields() -> None:
    one = replace(MONDAY, extra={"site": "a", "beams": {"first": -90, "step": 1}})
    other = replace(TUESDAY, extra={"site": "b", "beams": {"first": -90, "step": 1}})
    assert together([one, other]).extra == {"beams": {"first": -90, "step": 1}}
    seen = [replace(t, steps=(replace(t[0], image=(1.0, 2.0)), *t.steps[1:])) for t in (one, other)]
    seen[1] = replace(seen[1], extra={"beams": {"first": 0, "step": 1}})
    with pytest.raises(TraceError, match="beams: expected the same in all traces"):
        together(seen)


def test_slipped_actions_are_numbered_over_all_drives() -> None:
    slipped = replace(
        MONDAY, steps=(replace(MONDAY[0], action=Action.that_slipped(0)), *MONDAY.steps[1:])
    )
    again = slipped.with_views("dcba")
    joint = together([slipped, again], names=["one", "two"])
    assert [t for t, a in enumerate(joint.actions) if a == Action.that_slipped(t)] == [0, 4]


def test_together_warns_of_equal_traces() -> None:
    with pytest.warns(UserWarning, match="traces 1 and 2 have the same steps"):
        together([MONDAY, MONDAY], names=["monday", "again"])
    with pytest.warns(UserWarning, match=r"the same steps \(monday, monday\); give"):
        joint = together([MONDAY, TUESDAY, MONDAY])
    assert [drive.name for drive in drives_of(joint)] == ["monday", "tuesday", "monday-2"]
    other = MONDAY.with_views("dcba")
    joint = together([MONDAY, other, other[:2]])
    assert [drive.name for drive in drives_of(joint)] == ["monday", "monday-2", "monday-3"]


def test_together_warns_of_other_action_names_and_units() -> None:
    go = Trace.from_steps("ab", [{"name": "go", "kind": "travel"}], name="other")
    with pytest.warns(
        UserWarning,
        match=r"traces 1 and 2 \(monday, other\) have .*'travel' and 'go'",
    ):
        together([MONDAY, go])
    # The turns of a log are named after their angles.
    turns = [Action(f"turn {angle}", "turn", turn="left") for angle in (30, 60, 90)]
    log = Trace.from_steps("aaa", turns[:2], name="log")
    together([log, Trace.from_steps("aa", turns[2:], name="other log")])  # no warning
    millimetres = Trace.from_steps("ab", ["travel"], displacements=[(1000, 0, 0)], name="mm")
    with pytest.warns(UserWarning, match="median travel of trace 1 is 1 m, and that of trace 2 is"):
        together([replace(MOVED, name="m"), millimetres])


def test_start_of_a_drive_has_a_new_name_and_no_displacement() -> None:
    start = Action("tuesday", "start")
    with pytest.raises(
        TraceError, match="step tuesday:0: displacement: expected none on the first"
    ):
        Trace.from_steps("ab", [start], displacements=[(1, 0, 0)])
    with pytest.raises(TraceError, match="step tuesday:0: action: expected a new name for"):
        Trace.from_steps("aba", [start, start])


def test_drives_with_a_common_place_get_one_map() -> None:
    """Tuesday adds nothing to the map of Monday. Nothing links the end of Monday to Tuesday."""
    solution = solve([MONDAY, TUESDAY])
    assert [ssh_map.dstate_at for ssh_map in solution.maps] == [(0, 1, 2, 3, 1, 2, 3)]
    assert solve(trace for trace in (MONDAY, TUESDAY)) == solution
    (ssh_map,) = solution.maps
    assert len(ssh_map.pieces) == 1
    assert {action for _, action, _ in ssh_map.links} == {"travel", "around"}
    assert (
        pieces_in_words(solution.drives, ssh_map) == "the map joins the 2 drives: monday, tuesday"
    )


def test_drives_without_common_views_are_pieces(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    far = Trace.from_steps("xyz", ["travel", "around"], name="far")
    with pytest.warns(UserWarning, match=r"trace 2 \(far\) has no view in common with another"):
        solution = solve([MONDAY, far, TUESDAY], Theory.causal())
    assert solution[0].pieces == ((0, 1, 2, 3), (4, 5, 6))
    assert "2 pieces that share no place: monday, tuesday; far alone" in solution.joined
    assert caplog.messages == [solution.joined]
    solution.save(tmp_path / "maps.json")
    data = json.loads((tmp_path / "maps.json").read_text())
    assert data["maps"][0]["pieces"] == [[0, 1, 2, 3], [4, 5, 6]]
    fingerprint = fingerprints_of(far)["far"]
    told = {"name": "far", "first": 4, "stop": 7, "fingerprint": fingerprint}
    assert data["drives"][1] == told
    read = Solution.load(tmp_path / "maps.json")
    assert read.drives == solution.drives
    assert read == solution
    data["drives"][1]["first"] = 5
    with pytest.raises(MapError, match="drives: expected drives that follow each other"):
        Solution.from_dict(data)


@pytest.mark.slow
def test_path_is_in_one_piece_of_the_map() -> None:
    """Two corridors that share no place are two paths, although one path would be fewer."""
    here, there = (
        Trace.from_steps(views, ["travel"], displacements=[(2, 0, 0)], name=views)
        for views in ("ab", "xy")
    )
    with pytest.warns(UserWarning, match="no view in common"):
        solutions = solve([here, there]), solve(there, onto=solve(here))
    for solution in solutions:
        assert sorted(path.order for path in solution[0].paths) == [(0, 1), (2, 3)]
    free = Theory(without=["path_in_one_piece"])
    with pytest.warns(UserWarning, match="no view in common"):
        assert len(solve([here, there], free)[0].paths) == 1


def test_solve_together_in_the_shell(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = [str(tmp_path / f"{trace.name}.jsonl") for trace in (MONDAY, TUESDAY)]
    for trace, file in zip((MONDAY, TUESDAY), files, strict=True):
        replace(trace, name=None).save(file)
    maps = str(tmp_path / "maps.json")
    assert main(["solve", *files, "--together", "-o", maps]) == 0
    assert "the map joins the 2 drives: monday, tuesday" in capsys.readouterr().out
    assert [drive.name for drive in Solution.load(maps).drives] == ["monday", "tuesday"]
    assert main(["solve", *files, "--together", "--jobs", "2"]) == 1
    assert "--jobs: expected no such option with --together" in capsys.readouterr().err
    assert main(["solve", *files, "-o", maps]) == 1
    assert "--output: expected no such option with several traces" in capsys.readouterr().err


def test_fault_at_the_start_of_a_drive_is_refused() -> None:
    """No action led to the first step of a drive, so none can have slipped there."""
    theory = Theory.causal().replace(slipped=1.0)
    solution = solve([MONDAY, TUESDAY], theory)
    (ssh_map, *_) = solution.maps
    wrong = replace(ssh_map, faults=(Fault(3, "slipped", "tuesday", cost=1.0),))
    assert solution.trace is not None
    assert any("nothing to disbelieve" in v.message for v in check(solution.trace, wrong, theory))
    linked = replace(ssh_map, links=(*ssh_map.links, (3, "tuesday", 1)))
    assert any("the trace never does" in v.message for v in check(solution.trace, linked, theory))


def test_online_mapper_refuses_a_second_drive() -> None:
    mapper = OnlineMapper("a")
    with pytest.raises(TraceError, match="got the start of a drive"):
        mapper.observe(Action("tuesday", "start"), "b")


def test_localiser_starts_anew_with_each_drive() -> None:
    solution = solve([MONDAY, TUESDAY])
    assert solution.trace is not None
    beliefs = list(Localiser(solution.maps[0]).beliefs(solution.trace))
    assert len(beliefs) == len(solution.trace)
    assert beliefs[4].probabilities == pytest.approx(
        next(iter(Localiser(solution.maps[0]).beliefs(TUESDAY))).probabilities
    )


@pytest.mark.filterwarnings("ignore:views. trace")
def test_joins_of_drives_are_certain_possible_or_excluded(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """By views alone, the b that Tuesday sees may be Monday's first b or the second one."""
    monday = Trace.from_steps("abcbd", ["travel"] * 4, name="monday")
    tuesday = Trace.from_steps("db", ["around"], name="tuesday")
    far = Trace.from_steps("xy", ["travel"], name="far")
    solution = solve([monday, tuesday, far], Theory.causal().replace(different=[(1, 3)]))
    of_tuesday, of_far, _ = joins_of_drives(Listing.of(solution))
    assert [(join.first, join.second) for join in of_tuesday.forced] == [(4, 0)]
    assert [(join.first, join.second, join.share) for join in of_tuesday.possible] == [
        (1, 1, 0.5),
        (3, 1, 0.5),
    ]
    assert [of_tuesday.how_sure(j) for j in (*of_tuesday.forced, *of_tuesday.possible)] == [
        "all maps",
        "1 of 2 maps",
        "1 of 2 maps",
    ]
    assert of_tuesday.excluded == 5 * 2 - 3
    assert (of_far.forced, of_far.possible, of_far.excluded) == ((), (), 10)
    assert "nothing in common in any of the maps" in str(of_far)
    maps = str(tmp_path / "maps.json")
    solution.save(maps)
    assert main(["compare", maps]) == 0
    said = "monday and tuesday: 1 dstate in common in all maps (monday:4 = tuesday:0); 2 possible"
    told = capsys.readouterr().out
    assert said in told
    assert "; 7 pairs of dstates joined in no map" in told
    assert route(solution, "monday:0", "tuesday:0") == route(solution, "monday:0", "monday:4")
    with pytest.raises(MapError, match="to: step 'friday:1': expected a drive out of monday, tues"):
        route(solution, "monday:0", "friday:1")
    assert main(["compare", maps, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["drives"][0]["excluded"] == 7


def test_possible_joins_have_a_probability_or_a_share_of_the_maps() -> None:
    join = DriveJoin(0, 1, 0.8)
    for of_maps, said in (
        (None, "with its probability (monday:0 = tuesday:1, 0.80)"),
        (5, "in some maps that were found (monday:0 = tuesday:1, 4 of 5 maps)"),
    ):
        pair = DrivePair("monday", "tuesday", "place", (), (join,), 1, False, of_maps)
        ending = f"1 possible join, {said}; 1 pair of places joined in no map"
        assert str(pair) == f"monday and tuesday: {ending}"


def test_shell_accepts_step_names_with_drives(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for trace in (MONDAY, TUESDAY):
        trace.save(tmp_path / f"{trace.name}.jsonl")
    files = [str(tmp_path / f"{name}.jsonl") for name in ("monday", "tuesday")]
    joint = str(tmp_path / "joint.jsonl")
    options = ["--together", f"--set=joint_trace={joint}", "--different=monday:1,tuesday:0"]
    assert main(["solve", *files, *options, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["theory"]["different"] == [[1, 4]]
    assert main(["explain", joint, "monday:1", "tuesday:0", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["steps"] == [1, 4]
    for name, said in (
        ("sunday:0", "expected a drive out of monday, tuesday, got 'sunday'"),
        ("tuesday:3", "expected 0 to 2, got '3'"),
        ("tuesday:x", "expected 0 to 2, got 'x'"),
    ):
        assert main(["explain", joint, "0", name]) == 1
        assert said in capsys.readouterr().err
    assert main(["solve", files[0], "--set", f"joint_trace={joint}"]) == 1
    assert "joint-trace: expected no such option with one trace" in capsys.readouterr().err


# The beam was developed on seeds 20 to 23, not on these mazes.
MAZES = [*of_mazes(3, 20, range(3), truth.Noise(Odometry(**truth.NOISE)))]


@pytest.mark.slow
@pytest.mark.parametrize("known", MAZES[1:], ids=[known.name for known in MAZES[1:]])
def test_narrow_beam_finds_a_joint_map_as_cheap_as_the_true_one(known: truth.Known) -> None:
    """Three drives start anywhere in a maze, with any heading."""
    problem = settle(known.trace, Theory())
    weighing = Misfit(problem)

    def nats(dstates: Sequence[Hashable], places: Sequence[Hashable]) -> float:
        names = truth.partition(dstates), truth.partition(places)
        return 8 * sum(len(set(of)) for of in names) + weighing.of_course(*names) / 2

    beam = Beam(problem, Log(problem.trace, problem.theory, problem.pairs), 1)
    found = [
        nats(m.dstate_at, [m.dstates[label].place for label in m.dstate_at]) for m in beam.maps()
    ]
    assert min(found) <= nats(known.dstates, known.places) + 1e-6


@pytest.mark.parametrize(
    ("seed", "steps"), [(405, 20), pytest.param(400, 30, marks=pytest.mark.slow)]
)
def test_beam_keeps_a_true_join_that_costs_more_at_first(seed: int, steps: int) -> None:
    """A true join may cost more than false ones for some steps."""
    (known,) = of_mazes(3, steps, [seed], truth.Noise(Odometry(**truth.NOISE)))
    problem = settle(known.trace, Theory())
    beam = Beam(problem, Log(problem.trace, problem.theory, problem.pairs), 1)
    assert truth.is_true(min(beam.maps(), key=Misfit(problem).nats_of), known)


def test_drive_that_shares_one_place_gets_four_headings() -> None:
    (known,) = of_mazes(3, 2, [0], truth.Noise(Odometry(**truth.NOISE)), drives=1)
    problem = settle(known.trace, Theory())
    first = Extending(problem, Log(problem.trace, problem.theory, problem.pairs)).first()
    pieces = Pieces(here=5, of_heading=(0, 5), hinges={5: 0})
    mean = first.mean.copy()
    mean[-1] += 0.5  # In its frame, the drive faces any way.
    heading = [*first.heading, len(mean) - 1]
    found = replace(first, places=[0, 0], heading=heading, mean=mean, pieces=pieces)
    one, other = zip(*headings_by_turn(found), strict=True)
    assert len({*one}) == 1
    assert other == pytest.approx([one[0] + k * math.pi / 2 for k in range(4)])


@pytest.mark.parametrize("known", MAZES, ids=[known.name for known in MAZES])
def test_misfit_of_joint_maps_equals_that_of_the_checker(known: truth.Known) -> None:
    """If Gauss-Newton started from wrong headings of drives, it would end in another minimum."""
    names, places = truth.partition(known.dstates), truth.partition(known.places)
    where = dict(zip(names, places, strict=True))
    poses = Poses(known.trace, names, [where[name] for name in range(len(where))])
    assert misfit(known.trace, names, places) == pytest.approx(poses.misfit(), rel=1e-5)


def test_places_of_joined_drives_are_merged_further() -> None:
    """Joining leaves two places of a building twice, which its best map has once."""
    known = cut(next(truth.aces3([97501], truth.noise_of(Odometry(), 97501))), 3, 4)
    found = solve(known.trace, Theory.topological().replace(star="none"), work_limit=4.0)
    assert truth.is_true(found.maps[0], known)


@pytest.mark.parametrize(("seed", "star"), [(160006, "none"), (124000, "auto")])
def test_drives_are_joined_with_one_other_decision(seed: int, star: str) -> None:
    """The cheapest first join is false (160006), or the map of the first drive alone (124000)."""
    known = cut(next(truth.aces3([seed], truth.noise_of(Odometry(), seed))), 3, 4)
    problem = settle(known.trace, Theory.topological().replace(star=star))
    joining = Joining(problem, Log(problem.trace, problem.theory, problem.pairs))
    assert not any(truth.is_true(found, known) for found in joining.maps())
    assert any(truth.is_true(found, known) for found in joining.others())


@pytest.mark.filterwarnings("ignore:views. trace")
def test_benchmark_worlds_are_cut_at_jumps(tmp_path: Path) -> None:
    walk = Trace.from_steps("abcd", ["travel", "jump1", "travel"])
    steps = [replace(s, truth={"dstate": k}) for k, s in enumerate(walk.steps)]
    replace(walk, steps=tuple(steps)).save(tmp_path / "mall.jsonl")
    (known,) = of_worlds(tmp_path)
    assert [(d.first, d.stop) for d in drives_of(known.trace)] == [(0, 2), (2, 4)]
    assert known.dstates == (0, 1, 2, 3)
    found = report_of_guesses(iter([known]), Theory.causal().replace(displacement="none"), 4)
    assert found == "the cheapest map is true: 1 of 1"


@pytest.mark.parametrize(("at", "ahead"), [(0, 5.0), (0, 10.0), (1, 5.0)])
def test_closure_between_drives_decides_their_common_places(at: int, ahead: float) -> None:
    """A corridor with four places that look alike, and a second drive past two of them."""
    monday = Trace.from_steps("aaaa", ["travel"] * 3, displacements=[(5.0, 0.0, 0.0)] * 3)
    tuesday = Trace.from_steps("aa", ["travel"], displacements=[(5.0, 0.0, 0.0)])
    drives = together([monday, tuesday], ["monday", "tuesday"])
    noise = ((0.01, 0, 0), (0, 0.01, 0), (0, 0, 0.001))
    closure = Closure(0, 4 + at, (ahead + 5 * at, 0.0, 0.0), noise)
    joint = replace(drives, closures=(closure,))
    first = int(ahead / 5)
    expected = [first, first + 1]
    problem = settle(joint, Theory())
    guess = next(Beam(problem, Log(joint, problem.theory, problem.pairs), 16).maps())
    for ssh_map in (guess, solve(joint).maps[0]):
        assert [ssh_map.place_of(t) for t in range(6)] == [0, 1, 2, 3, *expected]
        assert check(joint, ssh_map) == ()


# Two drives of four steps. Nothing tells whether the second one starts where the first one ends.
THERE = Trace.from_steps("abcd", ["travel", "around", "travel"], name="monday")
BACK = Trace.from_steps("dcba", ["around", "travel", "around"], name="tuesday")


@pytest.mark.slow
def test_sentences_name_steps_by_their_drives(tmp_path: Path) -> None:
    joint, solution = together([THERE, BACK]), solve([THERE, BACK])
    said = "the dstates of steps tuesday:0 and tuesday:3 differ; the places of steps tuesday:0–3"
    assert said in solution.summary
    assert solution.sureness.endswith("separates these places: steps monday:3 and tuesday:0")
    solution.save(tmp_path / "maps.json")
    loaded = Solution.load(tmp_path / "maps.json")
    assert (loaded.summary, loaded.sureness) == (solution.summary, solution.sureness)
    pair = explain_pair(joint, 1, 6)
    assert "steps monday:1 and tuesday:2 are different dstates" in str(pair)
    assert "the action of step tuesday:2 is 'around'" in str(pair)
    assert json.loads(json.dumps(pair.to_dict()))["steps"] == [1, 6]
    wrong = replace(solution.maps[0], dstate_at=(*range(4), 3, 4, 0, 6))
    assert {str(t) for v in check(joint, wrong) for t in v.steps} >= {"monday:0", "tuesday:2"}
    (seen,) = (v for v in check(joint, wrong) if v.axiom == "functional_view")
    assert seen.message.endswith("like 'a' at step monday:0 and like 'b' at step tuesday:2.")
    clash = explain_trace(joint, Theory(same=[(0, 4)]))
    assert "in steps monday:0 to tuesday:0 these clash" in str(clash)
    assert "without the assertion about steps monday:0 and tuesday:0" in str(clash)
    assert joint.at(6) == "step tuesday:2"


@pytest.mark.filterwarnings("ignore:traces 1 and 2 have the same steps")
def test_explain_pair_across_drives_has_no_loop() -> None:
    """Nothing is known of how the first step of a drive relates to those of another one."""
    there = Trace.from_steps("ab", ["travel"], displacements=[(5, 0, 0)], name="monday")
    joint = together([there, replace(there, name="tuesday")], names=["monday", "tuesday"])
    assert explain_pair(joint, 0, 2).loop is None
    assert explain_pair(joint, 2, 3).loop == "the loop of 5 m closes 5.0 m off"


def test_verbs_read_the_trace_in_a_file_of_maps(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    maps = str(tmp_path / "maps.json")
    solve([MONDAY, TUESDAY]).save(maps)
    assert main(["check", maps]) == 0
    assert "1 of 1 map satisfies" in capsys.readouterr().out
    assert main(["next", maps]) == 0
    assert main(["explain", maps, "monday:0", "tuesday:1"]) == 0
    told = capsys.readouterr().out
    assert "steps monday:0 and tuesday:1 are different dstates" in told
    assert "in map 1, the steps are at two places" in told
    for verb in ("evaluate", "train"):  # these need truth, or images
        assert main([verb, maps, *(["-o", f"{maps}.skops"] if verb == "train" else [])]) == 1
        assert "trace: expected the trace of" in capsys.readouterr().err


def test_compare_names_steps_by_their_drives() -> None:
    found = compare(solve([THERE, BACK], Theory.causal(), within=1))
    said = "step tuesday:0 is at the dstate of step monday:3"
    assert said in [str(question) for question in found.deciding]
    maps = solve([THERE, BACK]).maps
    told = difference(maps[0], maps[1], drives=drives_of(together([THERE, BACK]))).lines
    assert told[1].startswith("dstates: the first map groups steps monday:3 and tuesday:0; the")


def test_named_step_is_a_number_and_survives_pickle() -> None:
    steps = named_steps(drives_of(together([THERE, BACK])), 8)
    assert steps == tuple(range(8))
    assert [*map(str, pickle.loads(pickle.dumps(steps)))][3:5] == ["monday:3", "tuesday:0"]
    assert named_steps(drives_of(THERE), 4) == range(4)


@pytest.mark.parametrize("words", [[], ["--json"]])
def test_solve_names_differences_by_steps_of_drives(
    words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A part of the route through ACES3 is cut into two drives that share some places."""
    aces = Trace.load(Path(__file__).parent.parent / "examples" / "aces3-route.jsonl")
    files = []
    for name, drive in (("monday", aces[:12]), ("tuesday", aces[8:20])):
        files.append(str(tmp_path / f"{name}.jsonl"))
        replace(drive, name=name).save(files[-1])
    assert main(["solve", *files, "--together", "-n", "0", *words]) == 0
    out = capsys.readouterr().out
    assert "12 minimal maps: the dstates of steps tuesday:0–4 differ" in out
    if not words:
        told = out.partition("what tells the maps apart")[2]
        assert "the paths of steps tuesday:0–4 and tuesday:10–11" in told
        assert "tell all 12 maps apart, and 1 to 2 the 3 labelings" in told
