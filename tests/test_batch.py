"""Many traces at once: order, errors, killed processes, Ctrl-C; the same results here, in processes
and on a Dask cluster."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from coarse import hall
from worlds import ENDLESS, TOURS, drive, rectangle

from perception.readers.writers import write_carmen
from ssh_abduction import Solution, Theory, Trace
from ssh_abduction.cli import batch, jobs, main, mapping
from ssh_abduction.cli.batch import SolveQuestion
from ssh_abduction.cli.jobs import Absence, FileAnswer, answers_here, answers_on_cluster
from ssh_abduction.cli.mapping import MapQuestion
from ssh_abduction.cli.outcome import StopFlag
from ssh_abduction.data import Odometry
from ssh_abduction.runtime import workers
from ssh_abduction.theory import Speedups

EXAMPLES = Path(__file__).parent.parent / "examples"
QUESTION = SolveQuestion(
    Theory.topological(), limit=None, maps=100, memory=None, speedups=Speedups(), json=False
)


class Deadly(SolveQuestion):
    """Kill the process that solves a trace of this name, as the system does if memory runs out."""

    def answer(self, number: int, path: str, *rest: Any) -> FileAnswer:
        if "deadly" in path:
            time.sleep(0.3)  # let other traces start
            os.kill(os.getpid(), signal.SIGKILL)
        return SolveQuestion.answer(self, number, path, *rest)


class Killed(SolveQuestion):
    """Kill the process of a search that is not hurried, once it has handed a map over.

    Traces named early are killed before that.
    """

    def answer(self, number: int, path: str, *rest: Any) -> FileAnswer:
        if self.limit is None or self.limit > batch.HURRY:
            if "early" in path:
                os.kill(os.getpid(), signal.SIGKILL)
            hand_over = workers.hand_over

            def killed(known: object) -> None:
                hand_over(known)
                os.kill(os.getpid(), signal.SIGKILL)

            workers.hand_over = killed
        return SolveQuestion.answer(self, number, path, *rest)


class KilledMapping(MapQuestion):
    """Kill the process that maps a log, once it has handed a map over."""

    def answer(self, number: int, path: str, *rest: Any) -> FileAnswer:
        if self.known is None:
            hand_over = workers.hand_over

            def killed(known: object) -> None:
                hand_over(known)
                os.kill(os.getpid(), signal.SIGKILL)

            workers.hand_over = killed
        return MapQuestion.answer(self, number, path, *rest)


class KilledOnce(MapQuestion):
    """Record that a log is mapped.

    At the first log of this name, kill the worker that maps it.
    """

    def answer(self, number: int, path: str, *rest: Any) -> FileAnswer:
        assert workers.serves()  # so the process that began this one is the worker
        begun = Path(path).with_suffix(".begun")
        with begun.open("a") as file:
            file.write("begun\n")
        if "deadly" in path and begun.read_text().count("begun") == 1:
            os.kill(os.getppid(), signal.SIGKILL)
        return MapQuestion.answer(self, number, path, *rest)


@pytest.fixture
def traces(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of traces, from here on the working directory."""
    for name, trace in {
        "quick": rectangle(8),
        "slow": rectangle(40),
        "tee": drive(*TOURS["tee"]),
        "deadly": rectangle(8),
        "impossible": Trace.from_steps(
            "xyabcde", ["right", "travel", "travel", "around", "around", "travel"]
        ),
    }.items():
        trace.save(tmp_path / f"{name}.jsonl")
    (tmp_path / "broken.jsonl").write_text('{"format": "ssh-trace", "version": 1}\n{"view": }\n')
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def cluster() -> Iterator[str]:
    """The address of a Dask scheduler with one worker of one thread in its own process. On a busy
    machine the worker may take long to come back."""
    import dask
    from distributed import LocalCluster

    with (
        dask.config.set(
            {
                "distributed.scheduler.allowed-failures": 0,
                "distributed.deploy.lost-worker-timeout": "600s",
                "distributed.worker.profile.enabled": False,  # it takes time all the while
            }
        ),
        LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=":0") as cluster,
    ):
        yield cluster.scheduler_address


@pytest.fixture
def scheduler(cluster: str, monkeypatch: pytest.MonkeyPatch) -> str:
    """The same address, for tests that wait without a limit."""
    monkeypatch.setattr(jobs, "PATIENCE", 600)
    return cluster


@pytest.fixture
def scheduler_here(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """The address of a scheduler whose only worker is a thread of this process."""
    from distributed import LocalCluster

    monkeypatch.setattr(jobs, "PATIENCE", 600)
    with LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=":0"
    ) as cluster:
        yield cluster.scheduler_address


def without_seconds(text: str) -> str:
    return re.sub(r'"seconds": {[^}]*}|\d+\.\d\d s', "_ s", text)


@pytest.mark.usefixtures("without_processes")
def test_batch_prints_one_line_a_trace_in_order(
    traces: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names = "tee", "broken", "quick", "missing", "impossible"
    assert main(["solve", *(f"{name}.jsonl" for name in names)]) == 1
    out, err = capsys.readouterr()
    tee, broken, quick, missing, impossible = out.splitlines()
    assert without_seconds(tee) == (
        "tee.jsonl: 4 places. Proven minimal, the only such map. "
        "optimal: 10 dstates, 4 places, 2 paths; 1 minimal map; _ s, 12 of 12 steps given to clingo"
    )
    assert broken.startswith(
        "broken.jsonl: error: broken.jsonl:2: line: expected JSON, got broken JSON"
    )
    assert quick.startswith("quick.jsonl: 4 places. Proven minimal, the only such map. optimal: 8 ")
    assert missing.startswith("missing.jsonl: error: missing.jsonl: expected a readable trace file")
    assert impossible.startswith(
        "impossible.jsonl: unsatisfiable: no map satisfies the axioms: in steps 2 to 5 these clash:"
    )
    assert err == "ssh-abduction: errors in 2 of 5 traces, on their lines\n"


@pytest.mark.usefixtures("without_processes")
def test_batch_line_equals_the_output_of_a_single_trace(
    traces: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # A single trace with a map has the verdict in its first line, and the rest in its second.
    for lines, words in ((1, ["impossible.jsonl"]), (2, ["slow.jsonl", "--time-limit", "1e-9"])):
        code = main(["solve", *words])
        alone = " ".join(capsys.readouterr().out.splitlines()[:lines])
        assert main(["solve", *words, "--jobs", "1"]) == code
        assert without_seconds(capsys.readouterr().out) == without_seconds(f"{words[0]}: {alone}\n")


@pytest.mark.usefixtures("without_processes")
def test_batch_json_lines_equal_single_json_objects(
    traces: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    paths = ["impossible.jsonl", "quick.jsonl"]
    alone = []
    for path in paths:
        main(["solve", path, "--json"])
        alone.append(json.loads(capsys.readouterr().out))
    assert main(["solve", *paths, "broken.jsonl", "--json"]) == 1
    *lines, broken = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [[*line] for line in lines] == [["trace", *data] for data in alone]
    for line, path, data in zip(lines, paths, alone, strict=True):
        assert {**line, "seconds": None} == {"trace": path, **data, "seconds": None}
    assert [*broken] == ["trace", "status", "error"]
    assert (broken["trace"], broken["status"]) == ("broken.jsonl", "error")
    assert broken["error"].startswith("broken.jsonl:2: line: expected JSON")
    (traces / "maps.json").write_text(json.dumps(lines[1]))
    assert main(["check", "maps.json", "quick.jsonl"]) == 0  # a line is what the other verbs read


@pytest.mark.usefixtures("without_processes", "traces")
def test_batch_warning_names_its_trace(capsys: pytest.CaptureFixture[str]) -> None:
    moved = [(0.001, 0.0, 0.0), (0.0, 0.0, 1.6)] * 2
    tiny = Trace.from_steps("ababa", ["travel", "left"] * 2, displacements=moved)
    replace(tiny, odometry=Odometry(position=0.1)).save("tiny.jsonl")
    main(["solve", "tiny.jsonl", "quick.jsonl", "--set", "weigh=count"])
    (warning,) = capsys.readouterr().err.splitlines()
    assert warning.startswith("ssh-abduction: warning: tiny.jsonl: the odometry cannot tell")


@pytest.mark.slow
def test_results_are_the_same_with_processes_and_dask(
    traces: Path, scheduler_here: str, capsys: pytest.CaptureFixture[str]
) -> None:
    paths = [f"{name}.jsonl" for name in ("broken", "impossible", "quick")]
    shown = {}
    for where in (
        (),
        ("--jobs", "2"),
        ("--scheduler", scheduler_here, "--jobs", "1"),
    ):
        assert main(["solve", *paths, "--json", *where]) == 1
        shown[where] = without_seconds(capsys.readouterr().out)
    assert shown[()].count("\n") == len(paths)
    assert len(set(shown.values())) == 1


@pytest.mark.usefixtures("without_processes")
@pytest.mark.parametrize(
    ("paths", "code"),
    [
        ("quick quick", 0),
        ("quick impossible quick", 20),
        ("slow impossible", 30),
    ],
)
def test_batch_returns_the_worst_exit_code(
    paths: str, code: int, traces: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    limit = ["--time-limit=1e-9", "--set=without_speedups=greedy"] if code == 30 else []
    assert main(["solve", *(f"{name}.jsonl" for name in paths.split()), *limit]) == code
    assert (capsys.readouterr().err == "") == (code != 1)


def test_wrong_batch_options_are_one_line_errors(
    traces: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(jobs, "PATIENCE", 0.5)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        nobody = f"tcp://127.0.0.1:{free.getsockname()[1]}"
    both = ["quick.jsonl", "tee.jsonl"]
    for words, message in (
        ([*both, "--jobs", "0"], r"--jobs: expected .* got 0; leave it out for 1"),
        (
            ["quick.jsonl", "-"],
            r"-: expected files, .* got standard input; save the trace to a file",
        ),
        (
            ["-", "--jobs", "2"],
            r"-: expected files, .* got standard input; save the trace to a file",
        ),
        (
            [*both, "--theory", "causal", "--set", "boundary=strict"],
            r"boundary: expected none with level=causal.*",
        ),
        (
            [*both, "--scheduler", nobody],
            rf"--scheduler: expected a Dask scheduler at {nobody}, got none \(.*\); start one "
            r"with: .*",
        ),
        (
            [*both, "--scheduler", "elsewhere"],
            r"--scheduler: expected an address with a port, such as tcp://host:8786, got "
            r"'elsewhere'; .*",
        ),
    ):
        assert main(["solve", *words]) == 1
        out, err = capsys.readouterr()
        assert out == ""
        assert re.fullmatch(rf"ssh-abduction: {message}\n", err)


def test_scheduler_without_workers_is_an_error(
    traces: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from distributed import LocalCluster

    monkeypatch.setattr(jobs, "PATIENCE", 2)
    with LocalCluster(n_workers=0, processes=False, dashboard_address=":0") as cluster:
        assert main(["solve", "quick.jsonl", "--scheduler", cluster.scheduler_address]) == 1
    assert re.fullmatch(
        r"ssh-abduction: --scheduler: expected a worker, got none in 2 s; start one with: .*\n",
        capsys.readouterr().err,
    )


def test_cluster_without_workers_warns_and_ends_at_the_limit(
    traces: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from distributed import Client, LocalCluster

    def there_was_one(*_: object, **__: object) -> None:
        monkeypatch.setattr(jobs, "PATIENCE", 0.1)  # from here: connecting may take longer

    monkeypatch.setattr(jobs, "LOOK", 0.0)
    monkeypatch.setattr(Client, "wait_for_workers", there_was_one)
    with LocalCluster(n_workers=0, processes=False, dashboard_address=":0") as cluster:
        address = cluster.scheduler_address
        command = f"solve quick.jsonl tee.jsonl quick.jsonl --time-limit 0.3 --scheduler {address}"
        assert main(command.split()) == 1
    out, err = capsys.readouterr()
    told = (
        rf"scheduler: expected a worker, got none for \d s; start one with: dask worker {address}"
    )
    assert all(re.fullmatch(rf"\w+.jsonl: error: {told}", line) for line in out.splitlines())
    assert len(out.splitlines()) == 3
    assert re.fullmatch(
        rf"ssh-abduction: warning: {told}, or end this with Ctrl-C", err.splitlines()[0]
    )
    assert err.count("warning") == 1


@pytest.mark.parametrize(("limit", "ends"), [(None, None), (5, 10), (25, 25)])
def test_cluster_may_lack_workers_for_the_given_time(
    limit: float | None, ends: float | None, capsys: pytest.CaptureFixture[str]
) -> None:
    """A worker is there for 40 s, and comes back once, after 100 s."""
    now = 0.0

    def workers() -> int:
        if now == 50:
            raise OSError("the scheduler does not answer")
        return int(now <= 40 or now == 100)

    absence = Absence(workers, limit, "tcp://here:1", lambda: now)
    too_long, said = [], []
    for second in range(140):
        now = float(second)
        too_long += [second] if absence.is_too_long() else []
        said += [second] if capsys.readouterr().err else []
    assert said == [50, 110]
    assert too_long == (
        [] if ends is None else [*range(40 + int(ends), 100), *range(100 + int(ends), 140)]
    )


def test_missing_dask_is_a_clear_error(
    traces: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert main(["solve", "quick.jsonl", "--scheduler", "tcp://127.0.0.1:1"]) == 1
    assert capsys.readouterr().err.endswith("; pip install '.[cluster]' in your clone\n")


def test_unexpected_error_becomes_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def load(path: str) -> Trace:
        raise MemoryError("no room for\nso many steps")

    monkeypatch.setattr(Trace, "load", load)
    assert QUESTION.answer(3, "a\nb.jsonl") == FileAnswer(
        3, r"'a\nb.jsonl': error: MemoryError: no room for so many steps", 1
    )


@pytest.mark.slow
def test_only_the_trace_whose_process_is_killed_is_lost(traces: Path, scheduler: str) -> None:
    deadly = Deadly(*(getattr(QUESTION, name) for name in SolveQuestion.__slots__))
    paths = [f"{name}.jsonl" for name in ("quick", "deadly", "quick")]
    stop = StopFlag()
    for answers in (
        answers_here(deadly, paths, 2, stop),
        answers_on_cluster(deadly, paths, scheduler, None, stop),
    ):
        lines = {answer.number: answer.line for answer in answers}
        assert sorted(lines) == [*range(len(paths))]
        for number, path in enumerate(paths):
            assert lines[number].startswith(
                f"{path}: {'error: process: expected' if 'deadly' in path else '4 places'}"
            )


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="signals")
@pytest.mark.parametrize("as_json", [False, True])
def test_killed_process_loses_no_map(as_json: bool, traces: Path, scheduler: str) -> None:
    endless = Theory.topological().replace(boundary="none", path_order="partial", prefer=())
    (traces / "early.jsonl").write_text((traces / "slow.jsonl").read_text())
    killed = Killed(endless, 1000, 0, 10**6, Speedups(), as_json)
    paths, stop = ["slow.jsonl", "early.jsonl", "slow.jsonl"], StopFlag()
    for answers in (
        answers_here(killed, paths, 2, stop),
        answers_on_cluster(killed, paths, scheduler, None, stop),
    ):
        found = {answer.number: answer for answer in answers}
        assert sorted(found) == [*range(len(paths))]
        for number, path in enumerate(paths):
            answer = found[number]
            why = "memory" if "slow" in path else "time"
            assert f"{why} limit" in answer.line
            assert answer.code in (0, 10)
            assert answer.warnings[-1].startswith("process: expected an answer, got a ")
            if as_json:
                solution = Solution.from_dict(json.loads(answer.line))
                assert (len(solution), solution.bound.dstates) > (0, 0)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="signals")
def test_killed_process_loses_no_map_of_a_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The next call maps the log again."""
    log, folder = str(tmp_path / "hall.log"), tmp_path / "runs"
    write_carmen(log, hall()[:80])
    command = ["map", log, "-o", str(folder), "--jobs", "1"]
    with monkeypatch.context() as patched:
        patched.setattr(mapping, "MapQuestion", KilledMapping)
        assert main(command) in (0, 10)
    assert "got a killed process" in capsys.readouterr().err
    assert len(Solution.load(folder / "maps.json")) > 0
    assert json.loads((folder / "run.json").read_text())["interrupted"]
    assert main(command) in (0, 10)
    assert "done already" not in capsys.readouterr().out


# Adds up numbers for about a minute on an idle processor.
BUSY = "for number in range(10**9): pass"


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="slow start of processes")
@pytest.mark.parametrize("words", [["--memory-limit", "2000"], ["--scheduler"]])
def test_no_map_is_lost_to_load(words: list[str], traces: Path, scheduler: str) -> None:
    """Eight busy processes for each processor. By hand, it was tried with forty and ten traces."""
    paths = [f"slow{number}.jsonl" for number in range(2)]
    for path in paths:
        shutil.copy("slow.jsonl", path)
    command = [sys.executable, "-m", "ssh_abduction", "solve", *paths, *ENDLESS, "--jobs", "2"]
    command += [*words, *([scheduler] if "--scheduler" in words else []), "--time-limit", "0.5"]
    busy = [sys.executable, "-c", BUSY]
    load = [subprocess.Popen(busy) for _ in range(8 * (os.cpu_count() or 1))]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    finally:
        for process in load:
            process.kill()
            process.wait()
    said = dict(line.split(": ", 1) for line in done.stdout.splitlines())
    assert said.keys() == {*paths}
    assert all(" feasible (time limit): " in one for one in said.values())


@pytest.mark.slow
def test_log_is_mapped_again_after_its_worker_was_killed(
    tmp_path: Path,
    scheduler: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    quick, deadly = str(tmp_path / "quick.log"), str(tmp_path / "deadly.log")
    monkeypatch.setattr(mapping, "MapQuestion", KilledOnce)
    write_carmen(quick, hall()[:80])
    shutil.copy(quick, deadly)
    command = ["map", quick, deadly, "-o", str(tmp_path / "runs")]
    command += ["--time-limit", "1000", "--scheduler", scheduler, "--jobs", "1"]
    capsys.readouterr()
    for done in ((), (quick,), (quick, deadly)):
        assert main(command) == 0
        verdicts = [one for one in capsys.readouterr().out.splitlines() if not one.startswith(" ")]
        for log, verdict in zip((quick, deadly), verdicts, strict=True):
            assert verdict.startswith(f"{log}: {'done already' if log in done else '4 places.'}")
    # The first call maps a log twice: after the worker died, a process here makes some map.
    assert {path.name: path.read_text().count("begun") for path in tmp_path.glob("*.begun")} == {
        "quick.begun": 1,
        "deadly.begun": 3,
    }


@pytest.mark.slow
def test_worker_stops_when_the_client_disconnects(traces: Path, scheduler_here: str) -> None:
    theory = Theory.topological().replace(boundary="none", path_order="partial", prefer=())
    endless = SolveQuestion(
        theory, limit=1000, maps=0, memory=None, speedups=Speedups(), json=False
    )
    answers = answers_on_cluster(
        endless, ["quick.jsonl", "slow.jsonl"], scheduler_here, None, StopFlag()
    )
    assert next(answers).number == 0
    time.sleep(0.2)  # the only thread of the worker is at the slow one
    answers.close()
    assert [
        answer.code
        for answer in answers_on_cluster(QUESTION, ["tee.jsonl"], scheduler_here, None, StopFlag())
    ] == [0]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="only Linux forgets the peak of memory")
def test_memory_limit_applies_to_each_trace(traces: Path) -> None:
    paths = ["quick.jsonl", "slow.jsonl", "quick.jsonl"]
    words = [sys.executable, "-m", "ssh_abduction", "solve", *paths, *ENDLESS, "--json"]
    # Run it by a shell: a process inherits the peak of the one that starts it, which is large here.
    command = f"{shlex.join(words)} --memory-limit 80; exit"
    done = subprocess.run(command, shell=True, capture_output=True, text=True, check=False)
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert [line.get("stopped") for line in lines] == [None, "memory limit", None]


def test_ctrl_c_prints_finished_answers_that_waited_for_their_turn(
    traces: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def answers(*_: object) -> Iterator[FileAnswer]:
        yield FileAnswer(0, "first", 0)
        yield FileAnswer(3, "fourth", 0)
        yield FileAnswer(2, "third", 20)
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(10)

    monkeypatch.setattr(jobs, "answers_here", answers)
    assert main(["solve", *["quick.jsonl"] * 5]) == 130
    assert capsys.readouterr() == (
        "first\nthird\nfourth\n",
        "ssh-abduction: interrupted: 2 of 5 traces not finished\n",
    )


@pytest.mark.skipif(sys.platform == "win32", reason="signals")
@pytest.mark.parametrize(
    ("jobs", "send"),
    [pytest.param("1", os.killpg, marks=pytest.mark.slow), ("2", os.kill)],
    ids=["1", "2, from another program"],
)
def test_ctrl_c_ends_the_processes_and_prints_their_maps(
    jobs: str, send: Callable[[int, int], None], traces: Path
) -> None:
    """What was found for unfinished traces is printed, whether the signal reaches all processes, as
    from a terminal, or only the first one."""
    paths = ["quick.jsonl", "slow.jsonl", "quick.jsonl", "slow.jsonl", "slow.jsonl"]
    command = [sys.executable, "-m", "ssh_abduction", "solve", *paths, *ENDLESS, "--jobs", jobs]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        assert process.stdout is not None
        first = process.stdout.readline()
        time.sleep(0.2)
        send(process.pid, signal.SIGINT)
        out, err = process.communicate(timeout=100)
    assert process.returncode == 130
    lines = [first, *out.splitlines()]
    assert first.startswith("quick.jsonl: 5 places. Proven minimal")
    unfinished = len(paths) - sum("(interrupted)" not in line for line in lines)
    assert err == f"ssh-abduction: interrupted: {unfinished} of 5 traces not finished\n"
    assert re.match(r"slow.jsonl: \w+.*\(interrupted\)", lines[1])
    if jobs == "1":
        assert unfinished == 4
    deadline = time.monotonic() + 100
    with contextlib.suppress(ProcessLookupError):
        while time.monotonic() < deadline:
            os.killpg(process.pid, 0)
            time.sleep(0.1)
        pytest.fail("processes are left")


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="terminals")
@pytest.mark.parametrize(
    "seen", [False, True], ids=["results to a pipe", "results to the terminal"]
)
def test_progress_bar_is_shown_on_a_terminal(seen: bool, traces: Path) -> None:
    import pty

    master, slave = pty.openpty()
    paths = ["quick.jsonl", "broken.jsonl", "tee.jsonl"]
    command = [sys.executable, "-m", "ssh_abduction", "solve", *paths]
    environment = {**os.environ, "TERM": "xterm", "COLUMNS": "60"}
    with subprocess.Popen(
        command, stdout=slave if seen else subprocess.PIPE, stderr=slave, env=environment, text=True
    ) as process:
        os.close(slave)
        shown = b""
        with contextlib.suppress(OSError):  # the terminal is gone when the program is
            while chunk := os.read(master, 4096):
                shown += chunk
        results = "" if process.stdout is None else process.stdout.read()
        assert process.wait(100) == 1
    os.close(master)
    text = shown.decode()
    assert "3/3" in text
    whole = (
        "quick.jsonl: 4 places. Proven minimal, the only such map. optimal: 8 dstates, 4 places, "
        "4 paths; 1 minimal map; _ s, 9 of 9 steps given to clingo"
    )
    assert (f"\x1b[2K{whole}" in without_seconds(text)) == seen  # where the bar was wiped away
    assert (whole in without_seconds(results)) == (not seen)
