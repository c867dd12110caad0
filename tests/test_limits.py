"""Limits of time and memory, Ctrl-C and SIGTERM always hold, whatever clingo does. What is known by
then is printed."""

from __future__ import annotations

import gc
import json
import math
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import clingo
import pytest
from in_processes import (
    answer_and_end,
    hand_over_and_stay,
    hand_over_and_vanish,
    sleep,
    stay,
    vanish,
)
from limits import Case, cases, outcome
from worlds import rectangle

import ssh_abduction
from ssh_abduction import Solution, Theory, Trace, solve
from ssh_abduction.checker.claims import check_bound
from ssh_abduction.cli import outcome as ending
from ssh_abduction.explain import explain_pair, explain_trace
from ssh_abduction.explain.axioms import Axioms, Interrupted, Piece
from ssh_abduction.explain.no_map import explain
from ssh_abduction.runtime import workers
from ssh_abduction.runtime.limits import LimitError, Watch, peak_memory
from ssh_abduction.solution import Status
from ssh_abduction.solver import Search, check_rules, find_backbone
from ssh_abduction.solver.asp.control import Control
from ssh_abduction.solver.candidates import Candidates
from ssh_abduction.theory.encodings import Rules
from ssh_abduction.theory.own_rules import EXAMPLE
from ssh_abduction.theory.settle import settle

# Seconds after which a process that obeys its limit has ended, even on a slow and busy machine. One
# that ignores its limit takes longer. benchmarks/limits.py measures the seconds beyond the limit.
SOON = 100
# 64 million rules
JOINS = "p(1..400). { q(X,Y) : p(X), p(Y) }. :- p(X), 1 = @go_on(X), q(X,Y), q(Y,Z), q(Z,X)."
CLASH = Trace.from_steps("xyabcd", ["right", "travel", "travel", "around", "around"])  # has no map
POSIX = pytest.mark.skipif(sys.platform == "win32", reason="signals")

# Wait in clingo, which cannot be stopped, under a guard.
DEAF = """
import sys, clingo
from ssh_abduction.cli import outcome as patience
from ssh_abduction.cli.outcome import Guard
from ssh_abduction.cli.outcome import on_ctrl_c
patience.DEAF, patience.LATE = 0.2, (1.1, 0.1)
limit, memory = (float(word) or None for word in sys.argv[1:])
with on_ctrl_c(lambda: None), Guard(
    lambda: None, lambda why: (f"known: {why}", 10), limit, memory
) as guard:
    guard.say(lambda: "begun, ")
    print("ready", file=sys.stderr, flush=True)
    control = clingo.Control()
    control.add("p(0). p(X+1) :- p(X), X < 1000000000.")
    control.ground()
"""


@pytest.fixture
def noisy(tmp_path: Path) -> Path:
    """Circuits of a rectangle with a wrong last view. There are as many dstates as steps, and far
    too many ways to join them to paths."""
    trace = rectangle(40)
    *steps, last = trace.steps
    path = tmp_path / "noisy.jsonl"
    replace(trace, steps=(*steps, replace(last, view=steps[-2].view))).save(path)
    return path


def test_grounding_stops_at_the_time_limit() -> None:
    watch = Watch(0.2)
    watch.start()
    control = Control((), watch.check)
    control.add("base", [], JOINS)
    with pytest.raises(LimitError) as caught:
        control.ground()
    assert caught.value.reason == "time limit"


def test_error_during_grounding_is_raised_unchanged() -> None:
    error = ValueError("enough", 3)

    def check() -> None:
        raise error

    control = Control((), check)
    control.add("base", [], JOINS)
    with pytest.raises(ValueError, match="enough") as caught:
        control.ground()
    assert caught.value is error


@pytest.mark.parametrize(
    ("seconds", "mebibytes", "reason"),
    [(200.0, 0.0, "time limit"), (0.0, 200.0, "memory limit"), (0.0, 0.0, None)],
)
def test_watch_refuses_work_beyond_a_limit(
    seconds: float, mebibytes: float, reason: str | None
) -> None:
    watch = Watch(100.0, peak_memory() + 100)
    watch.start()
    stopped = None
    try:
        watch.check(seconds, mebibytes)
    except LimitError as stop:
        stopped = stop.reason
    assert stopped == reason


def test_solve_of_a_noisy_trace_ends_in_time_with_a_map(noisy: Path) -> None:
    trace = Trace.load(noisy)
    solution = solve(trace, time_limit=0.5)
    assert solution.stopped == "time limit"
    assert solution.cost is not None
    assert solution.bound.dstates == len(trace) - 1
    assert len(trace) - 1 <= solution.cost.dstates <= len(trace)


@pytest.mark.parametrize(
    "case",
    list(cases(2, seed=1, longest=300, seconds=(0.3, 0.5))),
    ids=lambda case: f"{case.family}, {len(case.trace)} steps",
)
@POSIX
def test_time_limit_holds_on_traces_with_flaws(case: Case, tmp_path: Path) -> None:
    """A process that runs half a minute too long is killed, and has no exit status."""
    found = outcome(case, tmp_path)
    assert found.status in ("optimal", "feasible", "unsatisfiable", "unknown")
    assert found.mebibytes <= 1


@pytest.mark.slow
@POSIX
def test_own_rules_with_huge_grounding_stop_at_the_limit(noisy: Path, tmp_path: Path) -> None:
    rules = tmp_path / "own.lp"
    rules.write_text(
        "n(1..400). large(X,Y,Z) :- n(X), n(Y), n(Z).\n#program step(t).\n:- same(I,t), "
        "large(I,I,I)."
    )  # 64 million atoms
    command = [sys.executable, "-m", "ssh_abduction", "solve", str(noisy), "--json"]
    command += [f"--set=rules={rules}", "--time-limit=0.3"]
    done = subprocess.run(command, capture_output=True, timeout=SOON, check=False)
    assert (done.returncode, json.loads(done.stdout)["stopped"]) == (30, "time limit")


@POSIX
def test_solve_ended_by_sigterm_prints_its_map(noisy: Path) -> None:
    """tests/test_cli.py does the same with Ctrl-C, and tests/test_batch.py with several traces."""
    command = [sys.executable, "-m", "ssh_abduction", "-v", "solve", "--json", str(noisy)]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stderr
        assert any(
            "search: best" in line for line in process.stderr
        )  # the search is under way, and will not end by itself
        process.send_signal(signal.SIGTERM)
        out, _ = process.communicate(timeout=SOON)
    assert process.returncode == 143
    printed = json.loads(out)
    assert (printed["status"], printed["stopped"], len(printed["maps"])) == (
        "feasible",
        "interrupted",
        1,
    )


@POSIX
@pytest.mark.parametrize(
    ("limit", "memory", "number", "why"),
    [
        (0.2, 0, None, "time limit"),
        (0, 50, None, "memory limit"),
        (0, 0, signal.SIGINT, "interrupted"),
    ],
)
def test_guard_reports_while_clingo_is_busy(
    limit: float, memory: float, number: int | None, why: str
) -> None:
    command = [sys.executable, "-c", DEAF, str(limit), str(memory)]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stderr
        assert process.stderr.readline() == "ready\n"
        time.sleep(0.1)
        if number is not None:
            process.send_signal(number)
        out, _ = process.communicate(timeout=SOON)
    assert (out, process.returncode) == (f"begun, known: {why}", 10)


def test_snapshot_waits_for_the_running_sketch(
    noisy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun = threading.Event()
    sketches = []
    attempts = Candidates._attempts

    def slowly(candidates: Candidates) -> list[Callable[[], None]]:
        sketches.append(candidates)
        begun.set()
        time.sleep(0.2)
        return attempts(candidates)

    monkeypatch.setattr(Candidates, "_attempts", slowly)
    search = Search(Trace.load(noisy))
    other = threading.Thread(target=search.parts.candidates.sketch)
    other.start()
    assert begun.wait(SOON)
    snapshot = search.snapshot("time limit")
    other.join()
    assert (len(sketches), snapshot.status, len(snapshot.maps)) == (1, Status.FEASIBLE, 1)


def test_snapshot_of_an_unsatisfiable_search_is_complete() -> None:
    search = Search(CLASH)
    list(search)
    snapshot = search.snapshot("time limit")
    assert (snapshot.status, snapshot.complete) == (Status.UNSATISFIABLE, True)


@POSIX
def test_sigterm_ends_a_program_whose_output_nobody_reads() -> None:
    program = DEAF[: DEAF.index("    control")].replace('"begun, "', '"much" * 10**6')
    with subprocess.Popen(
        [sys.executable, "-c", program, "0", "0"], stdout=subprocess.PIPE
    ) as process:
        assert process.stdout
        assert process.stdout.read(4) == b"much"
        time.sleep(0.5)
        process.send_signal(signal.SIGTERM)
        assert process.wait(SOON) == 143


def test_explanation_stops_during_grounding() -> None:
    trace = rectangle(40)
    asked = iter([False, False, True])
    with pytest.raises(Interrupted):
        Axioms(
            Piece.of(settle(trace), range(len(trace))),
            lambda: next(asked),
        )


def test_workers_answer_all_tasks() -> None:
    tasks = [(number, 0.0) for number in range(5)]
    assert sorted(workers.answers(sleep, tasks, 2, lambda: False, None, 1.0)) == [0, 1, 2, 3, 4]


def test_worker_that_exits_after_its_answer_loses_no_task() -> None:
    """Once, the next task was lost, and the message said that its process was killed."""
    tasks = [(number, 0.5) for number in range(3)]
    assert list(workers.answers(answer_and_end, tasks, 1, bool, None, 1.0)) == [0, 1, 2]


def test_dead_or_late_worker_loses_only_its_task(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(workers, "STARTING", 0.5)
    monkeypatch.setattr(workers, "STARVED", 1.0)
    path = str(tmp_path / "pid")
    assert list(workers.answers(vanish, [(7, path), (8, path)], 1, lambda: False, None, 1.0)) == [
        workers.Lost(7, False),
        workers.Lost(8, False),
    ]
    assert list(workers.answers(stay, [(9, path)], 1, lambda: False, 0.1, 1.0)) == [
        workers.Lost(9, True)
    ]


def test_lost_task_has_what_its_process_handed_over_last(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(workers, "STARTING", 0.5)
    monkeypatch.setattr(workers, "STARVED", math.inf)
    tasks = [(number, str(tmp_path / "pid")) for number in range(2)]
    found = workers.answers(hand_over_and_vanish, tasks, 1, lambda: False, None, 1.0)
    assert list(found) == [workers.Lost(number, False, "second") for number in range(2)]
    found = workers.answers(hand_over_and_stay, tasks[:1], 1, lambda: False, 0.1, 1.0)
    assert list(found) == [workers.Lost(0, True, "first")]


@pytest.mark.parametrize(
    ("known", "used", "is_late"),
    [
        ((), 0.0, True),
        (None, 0.9, False),
        (None, 1.1, True),
    ],
)
def test_guard_lets_a_starving_search_find_its_first_map(
    known: tuple[object, ...] | None, used: float, is_late: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The clock shows one second. The process had the processor for `used` seconds of it."""
    monkeypatch.setattr(ending, "LATE", (1.0, 0.0))
    guarding = ending.Guard(lambda: None, limit=1.0, known=lambda: known)
    guarding._began -= 1.1
    monkeypatch.setattr(guarding, "_used", lambda: used)
    assert (guarding._why() == "time limit") == is_late


def test_stopped_workers_answer_and_start_nothing() -> None:
    answers = workers.answers(
        sleep, [(0, 0.0), (1, 1000.0), (2, 0.0)], 1, lambda: bool(found), None, 20.0
    )
    found: list[object] = []
    found += [next(answers)]
    assert found + list(answers) in ([0, 1], [0])


@POSIX
def test_workers_end_if_their_parent_is_killed(tmp_path: Path) -> None:
    path = tmp_path / "pid"
    program = (
        "from ssh_abduction.runtime import workers; from in_processes import stay; "
        f"list(workers.answers(stay, [(0, {str(path)!r})], 1, bool, None, 1.0))"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program], env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    ) as parent:
        while not (path.exists() and path.read_text()):
            assert parent.poll() is None
            time.sleep(0.01)
        worker = int(path.read_text())
        os.kill(worker, 0)
        parent.kill()
    deadline = time.monotonic() + SOON
    while is_running(worker):
        assert time.monotonic() < deadline
        time.sleep(0.05)


def is_running(process: int) -> bool:
    """Whether a process runs. A process that has ended may still be listed if nobody reads its
    status."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    status = Path(f"/proc/{process}/stat")
    return not status.exists() or status.read_text().rpartition(")")[2].split()[0] != "Z"


def test_certificate_is_checked_along_the_trace() -> None:
    trace = Trace.from_steps(["a", "b", "a", "c"], ["travel", "travel", "travel"])
    certificate = solve(trace, Theory.causal()).certificate
    assert certificate is not None
    assert check_bound(trace, certificate.to_dict()).faults == ()
    assert check_bound(trace, {"clique": [0, 1], "refuted": []}).faults == ()
    assert check_bound(rectangle(8), {"clique": [0, 8], "refuted": []}).faults != ()


def test_solve_returns_a_map_long_after_the_limit(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The clock runs twenty times too fast: the limit is over before the search begins."""
    seconds = time.perf_counter
    monkeypatch.setattr(time, "perf_counter", lambda: 20 * seconds())
    trace = Trace.load(Path(__file__).parent.parent / "examples" / "aces3-route.jsonl")
    for theory in (Theory.topological(), Theory.causal()):
        solution = solve(trace, theory, time_limit=0.002, max_maps=1)
        assert solution.stopped == "time limit"
        assert len(solution.maps) == 1


def test_limit_during_ranking_leaves_the_list_complete() -> None:
    trace = Trace.from_steps("aba", ["travel"] * 2, displacements=[(5.0, 0.0, 0.0)] * 2)
    search = Search(trace, Theory(weigh="count"))
    for _ in search.unranked():
        search.parts.watch.interrupted = True  # a limit ends the work with the last map
        assert search.over()
        search.parts.watch.interrupted = False
    search.parts.watch.interrupted = True
    assert search.over()
    assert (search.complete, search.stopped) == (True, None)


@POSIX
@pytest.mark.parametrize(
    "ask",
    [
        lambda solution: solve(solution.trace),
        pytest.param(find_backbone, marks=pytest.mark.slow),
        lambda solution: explain_pair(solution.trace, 0, 8),
        pytest.param(lambda solution: explain_trace(solution.trace), marks=pytest.mark.slow),
        lambda _: explain(CLASH),
        lambda _: check_rules(Theory.causal().replace(rules=[Rules("own.lp", EXAMPLE)])),
    ],
)
def test_ctrl_c_while_clingo_deletes_a_program_is_raised_later(
    ask: Callable[[Solution], object], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Python only prints what is raised where an object is deleted."""
    solution = solve(rectangle(8), max_maps=1)
    delete, left = clingo.Control.__del__, [KeyboardInterrupt]

    def interrupted(control: clingo.Control) -> None:
        delete(control)
        if left:
            raise left.pop()

    caught: list[int] = []
    monkeypatch.setattr(clingo.Control, "__del__", interrupted)
    before = signal.signal(signal.SIGINT, lambda number, _: caught.append(number))
    try:
        ask(solution)
        gc.collect()
        assert left == []
        ends = time.monotonic() + SOON
        while not caught and time.monotonic() < ends:
            time.sleep(0.01)
    finally:
        signal.signal(signal.SIGINT, before)
    assert caught == [signal.SIGINT]


def test_all_clingo_programs_keep_ctrl_c() -> None:
    package = Path(ssh_abduction.__file__).parent
    other = re.compile(r"clingo\.Control\(|ontrol\.solve\(")
    assert [p.name for p in package.rglob("*.py") if other.search(p.read_text("utf-8"))] == []


def test_solve_ended_late_writes_the_best_map(room: str, tmp_path: Path) -> None:
    program = """
import sys, time
from ssh_abduction.cli import main, outcome
from ssh_abduction.solver import Search
outcome.LATE = (1.0, 0.0)
Search.__iter__ = lambda search: iter(lambda: time.sleep(100), 0)
main(sys.argv[1:])
"""
    maps = str(tmp_path / "maps.json")
    words = ["solve", room, "--time-limit", "0.3", "-o", maps, "--json", "-q"]
    command = [sys.executable, "-c", program, *words]
    done = subprocess.run(command, capture_output=True, timeout=SOON, check=False)
    assert (done.returncode, done.stderr) == (0, b"")
    solution = Solution.load(maps)
    assert (solution.stopped, len(solution)) == ("time limit", 1)
    assert json.loads(done.stdout)["cost"] == solution.to_dict()["cost"]


def test_first_map_has_poses_after_a_limit_on_a_busy_machine(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("ssh_abduction.solver.search.overtime", lambda _: 0.0)
    moves = [(2.0, 0.0, 0.0), (0.0, 0.0, math.pi), (2.0, 0.0, 0.0)]
    trace = Trace.from_steps("abcd", ["travel", "around", "travel"], displacements=moves)
    solution = solve(trace, time_limit=1e-9)
    assert solution.stopped == "time limit"
    assert solution[0].fit is not None


def test_late_second_opinion_does_not_cost_the_other_warnings(tmp_path: Path) -> None:
    """The guard ends a process whose second opinion ignores the time limit."""
    script = """
import sys, time
from ssh_abduction.cli import main, outcome
outcome.LATE = (1.0, 0.2)
outcome.second_map = lambda *_: time.sleep(60)
main(sys.argv[1:])
"""
    rectangle(8).save(tmp_path / "r.jsonl")
    words = ["solve", str(tmp_path / "r.jsonl"), "--set", "weigh=cost", "--time-limit", "1"]
    command = [sys.executable, "-c", script, *words]
    done = subprocess.run(command, capture_output=True, text=True, timeout=SOON, check=True)
    assert "optimal" in done.stdout
    assert "warning: weigh: maps are counted instead of weighed" in done.stderr
