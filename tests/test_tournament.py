"""The benchmark of repeated wings: its drives, its judgement, and the pose graphs of gtsam."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pose_graphs
import pytest
import tournament
from instances import CELL
from pose_graphs import Fitted
from tournament import THEORY, Judged, judged_graph, judged_map
from truth import partition
from wings import NOISE, WEAK, WingDrive, wings

from ssh_abduction import Theory, solve
from ssh_abduction.checker.cost_claims import cost_of
from ssh_abduction.data.odometry import displacement_between
from ssh_abduction.solver.costs.misfit import Misfit
from ssh_abduction.theory.settle import settle

EXACT = replace(WEAK, along=0.001, across=0.001, heading=0.0001, turning=0.0001)
EXACT = replace(EXACT, position=0.001, angle=0.001)


@pytest.mark.parametrize(("seed", "ratio", "false"), [(0, 0.5, 4), (1, 1.0, 8)])
def test_false_closures_say_that_the_two_wings_are_one(seed: int, ratio: float, false: int) -> None:
    drive = wings(seed, ratio)
    assert drive.trace == wings(seed, ratio).trace
    assert len(drive.trace.closures) - len(drive.false) == 8
    assert len(drive.false) == false
    for i, closure in enumerate(drive.trace.closures):
        ends = closure.first, closure.last
        here, there = (drive.poses[t] for t in ends)
        apart = abs(there[0] - here[0])
        assert here[1] == there[1]
        assert apart == (drive.shift if i in drive.false else 0)
        if i in drive.false:
            assert {drive.wing_of(t) for t in ends} == {1, 2}
        # The closure is that of a robot at one place, up to its noise.
        _, _, turned = displacement_between(here, there)
        dx, dy, told = closure.displacement
        assert math.hypot(dx, dy) < 5 * NOISE[0]
        assert abs(math.remainder(told - turned, math.tau)) < 5 * NOISE[2]


def test_wings_look_alike() -> None:
    drive = wings(3)
    seen = {
        (x, y, heading): view
        for (x, y, heading), view in zip(drive.known.dstates, drive.trace.views, strict=True)
    }
    shift = round(drive.shift / CELL)
    pairs = [
        (view, seen[x + shift, y, heading])
        for (x, y, heading), view in seen.items()
        if y and (x + shift, y, heading) in seen
    ]
    assert pairs
    assert all(view == other for view, other in pairs)


def graph(drive: WingDrive, believed: set[int]) -> Fitted:
    weights = tuple(float(i in believed) for i in range(len(drive.trace.closures)))
    return Fitted(drive.poses, weights, None, 1.0)


def test_pose_graph_is_judged_by_the_closures_that_it_believes() -> None:
    drive = wings(0)
    true = {*range(len(drive.trace.closures))} - drive.false
    for believed, right, wrong in (
        (true, True, False),
        (true - {min(true)}, False, False),
        (true | {min(drive.false)}, False, True),
    ):
        judged = judged_graph(drive, graph(drive, believed), sure=True)
        assert (judged.right, judged.wrong) == (right, wrong)


def test_map_is_judged_by_its_dstates_and_places() -> None:
    drive = wings(0, odometry=EXACT)
    solution = solve(replace(drive.trace, closures=()), THEORY, work_limit=0.5)
    judged = judged_map(drive, solution)
    assert (judged.right, judged.wrong, judged.true, judged.listed) == (True, False, True, True)
    names = {name: number for number, name in enumerate(dict.fromkeys(drive.known.dstates))}
    elsewhere = replace(drive, known=replace(drive.known, places=tuple(range(len(drive.trace)))))
    assert len(names) == len(solution.maps[0].dstates)
    judged = judged_map(elsewhere, solution)
    assert (judged.right, judged.wrong, judged.true, judged.listed) == (True, False, False, False)


@pytest.mark.parametrize("fitted", [pose_graphs.graduated, pose_graphs.hybrid])
def test_pose_graph_with_good_odometry_believes_the_true_closures(fitted) -> None:  # type: ignore[no-untyped-def]
    pytest.importorskip("gtsam")
    drive = wings(0, 0.5, EXACT)
    found = fitted(drive.trace)
    assert judged_graph(drive, found, sure=True).right
    assert found.p > 0.001


def test_table_counts_what_was_judged() -> None:
    wrong = Judged(right=False, wrong=True, sure=True, seconds=0.2)
    right = Judged(right=True, wrong=False, sure=False, seconds=0.4)
    maps = [replace(wrong, true=False, listed=True), replace(right, true=True, listed=True)]
    rows = tournament.table({"peer": [wrong, right, right], "ours": maps}).splitlines()[-2:]
    assert rows == [
        "| peer | 2 | 1 | 1 | – | – | – | 0.4 |",
        "| ours | 1 | 1 | 1 | 1 | 1 | 2 | 0.3 |",
    ]


def test_saved_answers_are_not_computed_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = []

    def peer(drive: WingDrive, work: float) -> dict[str, Judged]:
        asked.append(drive.known.name)
        return {"peer": Judged(right=True, wrong=False, sure=True)}

    monkeypatch.setattr(tournament, "programs_of", lambda: [peer])
    for seeds in ("4-5", "4-6"):
        found = str(tmp_path / "found.jsonl")
        monkeypatch.setattr("sys.argv", ["tournament", "--seeds", seeds, "--save", found])
        tournament.main()
    assert asked == [wings(seed).known.name for seed in (4, 5, 6)]
    assert capsys.readouterr().out.splitlines()[-1].startswith("| peer | 3 | 0 | 0 |")


def test_repeated_wing_predicts_its_views() -> None:
    """If the second wing looks otherwise, the true map has to pay for its views."""
    drive = wings(0)
    courses = partition(drive.known.dstates), partition(drive.known.places)
    views = drive.trace.views
    other = [f"{view}'" if drive.wing_of(t) == 2 else view for t, view in enumerate(views)]
    nats = []
    for trace in (drive.trace, drive.trace.with_views(other)):
        problem = settle(trace, Theory.topological())
        misfit = Misfit(problem)
        nats.append(misfit.nats_of_course(*courses))
        aliases = misfit.aliases_of(*courses)
        assert {i for i, alias in enumerate(aliases) if alias} == drive.false
        checked, _ = cost_of(trace, problem.theory, *courses, (), aliases)
        assert nats[-1] == pytest.approx(checked, abs=0.01)
    assert nats[1] > nats[0] + 10
