"""A work limit gives one answer, whatever the machine and its load."""

from __future__ import annotations

import json
import math
import random
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from instances import maze

from ssh_abduction import SSHMap, Theory, Trace, solve
from ssh_abduction.cli import main
from ssh_abduction.data.errors import SolverError
from ssh_abduction.data.odometry import Odometry
from ssh_abduction.runtime.clock import CONFLICT, counting, look_at_clock, now, work_done
from ssh_abduction.runtime.limits import LimitError, StageTimeError, Watch
from ssh_abduction.solution import Progress
from ssh_abduction.solver.asp.control import Asker

ROUTE = Path(__file__).parent.parent / "examples" / "aces3-route.jsonl"
COSTS = Theory.topological().replace(weigh="cost")


def answer_by_a_random_clock(trace: Trace, theory: Theory, work: float, seed: int) -> Any:
    """Return the answer without its times while the clock of seconds runs at random."""
    jumps, shown = random.Random(seed), [0.0]

    def seconds() -> float:
        shown[0] += jumps.expovariate(1.0)
        return shown[0]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(time, "perf_counter", seconds)
        solution = solve(trace, theory, work_limit=work)
    answer = solution.to_dict()
    answer.pop("seconds")
    return solution.maps, solution.stopped, answer


@pytest.mark.parametrize("work", [0.02, 0.2, pytest.param(1.0, marks=pytest.mark.slow)])
@pytest.mark.parametrize("theory", [Theory.topological(), COSTS, Theory.causal()], ids=str)
def test_one_work_limit_gives_one_answer(work: float, theory: Theory) -> None:
    trace = Trace.load(ROUTE)
    first, other = (answer_by_a_random_clock(trace, theory, work, seed) for seed in range(2))
    assert other == first


def test_long_search_for_a_proof_ends_by_its_limit() -> None:
    """No source comes after the forced joins of a long trace with misread views."""
    trace = maze(5, 5, steps=120, seed=903, odometry=Odometry()).trace
    solution = solve(trace, COSTS.replace(misread=0.92), work_limit=2.0)
    assert (solution.complete, solution.stopped) == (False, "work limit")
    assert solution.effort.work > 2.0


@pytest.mark.parametrize(
    ("seed", "work"), [(900, 0.3), pytest.param(902, 0.6, marks=pytest.mark.slow)]
)
def test_threads_give_one_answer(seed: int, work: float) -> None:
    """Threads wait for each other while clingo grounds, so limits are reached at other times."""
    trace = maze(5, 5, steps=120, seed=seed).trace

    def answer(_: int) -> tuple[tuple[SSHMap, ...], float | None]:
        solution = solve(trace, work_limit=work)
        return solution.maps, solution.effort.work

    with ThreadPoolExecutor(4) as pool:
        first, *others = pool.map(answer, range(4))
    assert others == [first] * 3
    assert first[1] == pytest.approx(work, abs=0.3)


def test_progress_of_an_infinite_work_limit_names_no_units() -> None:
    found: list[Progress] = []
    solve(Trace.load(ROUTE)[:6], work_limit=math.inf, on_progress=found.append)
    assert found
    assert not any(progress.work or "units" in progress.sentence for progress in found)


@pytest.mark.parametrize("work", [0, -1, math.nan, "much"])
def test_work_limit_out_of_range_is_refused(work: Any) -> None:
    with pytest.raises(SolverError, match=r"^work_limit \(--work-limit\): expected a number"):
        solve(Trace.load(ROUTE), work_limit=work)


@pytest.mark.parametrize("limits", [["--work-limit", "0.05"], ["--work-limit", "0.3"]], ids=str)
def test_command_prints_one_answer_for_one_work_limit(
    limits: list[str], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """Alone, and in a batch."""
    assert main(["solve", str(ROUTE), "--json", *limits]) in (0, 10)
    alone = json.loads(capsys.readouterr().out)
    assert main(["solve", str(ROUTE), str(ROUTE), "--jobs", "2", "--json", *limits]) in (0, 10)
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    untimed = [{k: v for k, v in line.items() if k not in ("seconds", "trace")} for line in lines]
    del alone["seconds"]
    assert 0 < alone["work"] < 1
    for answer in (alone, *untimed):
        # A batch does not prove what all maps share, so it does less work.
        for name in ("work", "backbone", "summary"):
            answer.pop(name, None)
    assert untimed == [alone, alone]


def test_work_is_counted_inside_counting_only() -> None:
    with counting(is_on=True):
        begun = now()
        look_at_clock(3)
        assert now() - begun == pytest.approx(3e-6)
    assert now() != work_done()


def test_stage_ends_before_the_limit() -> None:
    watch = Watch(work=1.0)
    watch.start()
    with watch.stage(0.1):
        look_at_clock(200_000)
        with pytest.raises(StageTimeError):
            watch.check()
    watch.check()
    look_at_clock(900_000)
    with pytest.raises(LimitError) as limit:
        watch.check()
    assert limit.value.reason == "work limit"


def test_time_limit_is_a_cap_of_a_work_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    watch = Watch(5.0, work=1.0)
    watch.start()
    watch.check()
    seconds = time.perf_counter
    monkeypatch.setattr(time, "perf_counter", lambda: seconds() + 10)
    assert watch.left() == 1.0
    with pytest.raises(LimitError) as limit:
        watch.check()
    assert limit.value.reason == "time limit"


def test_part_obeys_the_watch_around_it() -> None:
    around = Watch(work=0.2)
    around.start()
    part = around.part(5.0)
    assert part.conflicts_left(1e-4) == around.conflicts_left(1e-4) > 0
    look_at_clock(300_000)
    with pytest.raises(LimitError):
        part.check()


def test_conflicts_that_use_up_the_work_are_no_proof() -> None:
    """Nine pigeons do not fit into eight holes. Clasp needs more conflicts to prove it."""
    asker = Asker(Watch(work=100 * CONFLICT))
    asker.control.add(
        "base", [], "1 { in(X,1..8) } 1 :- X = 1..9. :- in(X,H), in(Y,H), X < Y. :~ in(1,1). [1]"
    )
    asker.control.ground([("base", [])])
    with counting(is_on=True):
        asker.watch.start()
        for mode, models in (("opt", 0), ("ignore", 1)):
            with pytest.raises(LimitError):
                list(asker.answers(lambda _: True, mode, models))
