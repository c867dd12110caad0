"""Signals at bad moments: they lose no answer, repeat none, and let no process wait forever."""

from __future__ import annotations

import io
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import FrameType, SimpleNamespace
from typing import Any

import pytest
from coarse import hall
from in_processes import sleep, until

from perception.readers.writers import write_carmen
from ssh_abduction import Trace, solve
from ssh_abduction.cli import main, outcome
from ssh_abduction.cli.import_log import until_ctrl_c
from ssh_abduction.cli.jobs import FileAnswer
from ssh_abduction.cli.mapping import MapQuestion
from ssh_abduction.cli.outcome import StopFlag, on_ctrl_c
from ssh_abduction.robot_logs import log_maps
from ssh_abduction.robot_logs.log_maps import LogMapping
from ssh_abduction.runtime import limits, program, workers
from ssh_abduction.solver import Search
from ssh_abduction.solver.asp import control

pytestmark = pytest.mark.skipif(os.name != "posix", reason="signals")
SOON = 60  # seconds, enough on a slow and busy machine

# The program with a shorter time, and with a change that is its first argument.
PROGRAM = """
import sys, time
from ssh_abduction import __main__
from ssh_abduction.cli import jobs, judge, outcome, solve
outcome.DEAF, outcome.FIRST = 0.2, 1e9
exec(sys.argv.pop(1))
__main__.run()
"""


def started(change: str, *words: str, **pipes: Any) -> subprocess.Popen[bytes]:
    """Start the program with a change to it."""
    command = [sys.executable, "-c", PROGRAM, change, *words]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, **pipes)


@pytest.fixture
def interrupting(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Raise KeyboardInterrupt at SIGTERM, as the program does, and forget all signals."""
    monkeypatch.setattr(program, "raised", [])
    monkeypatch.setattr(program, "heard", [])

    def handle(number: int, frame: FrameType | None) -> None:
        program.raised.append(number)
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, handle)
    yield
    signal.signal(signal.SIGTERM, before)


def send(number: int = signal.SIGTERM) -> None:
    os.kill(os.getpid(), number)


@pytest.mark.parametrize(
    "change",
    [
        "waits = iter([0, 0, 100])  # the last call may follow a long search\n"
        "outcome.warn = lambda _: next(waits) and (print(file=sys.stderr) or time.sleep(100))",
        "outcome.save_solution = lambda *_: print(file=sys.stderr) or time.sleep(0.6)",
    ],
    ids=["warnings", "saving"],
)
def test_ctrl_c_after_the_answer_does_not_repeat_it(change: str, room: str) -> None:
    with started(change, "solve", room, "--json") as process:
        assert process.stderr
        assert process.stderr.readline() == b"\n"
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=SOON)
    assert (json.loads(out)["status"], process.returncode, err) == ("optimal", 0, b"")


def test_ctrl_c_ends_a_program_that_writes_into_an_unread_pipe(room: str, tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with started("outcome.SAVING = 0.2", "solve", room, "-o", str(pipe)) as process:
        assert process.stdout
        assert b"Proven minimal" in process.stdout.readline()
        process.send_signal(signal.SIGTERM)
        assert process.wait(SOON) == 143


LONG = "lambda *_: iter([jobs.FileAnswer(0, 'much' * 10**5, 0)])"


def test_ctrl_c_ends_many_solutions_that_nobody_reads(room: str) -> None:
    with started(f"jobs.answers_here = {LONG}", "solve", room, room) as process:
        assert process.stdout
        assert process.stdout.read(4) == b"much"
        process.send_signal(signal.SIGTERM)
        assert process.wait(SOON) == 143


def test_ctrl_c_ends_a_program_whose_last_words_nobody_reads(room: str) -> None:
    """The search hears no signal, and its last words fill the pipe."""
    change = """
class Stuck(solve._Text):
    searched = lambda *_: print("ready", file=sys.stderr) or time.sleep(100)
    last_words = lambda *_: "much" * 10**5
solve._Text = Stuck
"""
    with started(change, "solve", room) as process:
        assert process.stdout
        assert process.stderr
        assert process.stderr.readline() == b"ready\n"
        process.send_signal(signal.SIGTERM)
        assert process.stdout.read(4) == b"much"
        assert process.wait(SOON) == 143


def test_ctrl_c_while_the_files_of_a_map_are_made_keeps_the_map(
    interrupting: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The signal comes after the search for maps."""
    log, runs = tmp_path / "drive.log", tmp_path / "runs"
    write_carmen(log, hall()[:9])

    def mapped(*_: object, mapping: LogMapping, **__: object) -> None:
        mapping.search = Search(Trace.from_steps("a", []))

    def answer(*_: object) -> FileAnswer:
        send()
        return FileAnswer(0, "done", 0, (), (("run.json", b"{}"),))

    monkeypatch.setattr(log_maps, "map_log", mapped)
    monkeypatch.setattr(MapQuestion, "_answer", answer)
    assert main(["map", str(log), "-o", str(runs)]) == 0
    assert (runs / "run.json").read_bytes() == b"{}"


def test_second_signal_soon_after_the_first_raises_nothing(
    interrupting: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    from ssh_abduction.__main__ import _interrupt

    program.forget()
    with pytest.raises(KeyboardInterrupt):
        _interrupt(signal.SIGINT, None)
    _interrupt(signal.SIGTERM, None)
    assert program.interrupted_code() == 143
    monkeypatch.setattr(program, "AGAIN", 0.0)
    with pytest.raises(KeyboardInterrupt):
        _interrupt(signal.SIGINT, None)
    program.forget()


def test_second_ctrl_c_soon_after_the_first_waits_for_answers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stop = StopFlag()
    stop.ask()
    stop.ask()
    assert stop.is_set()
    monkeypatch.setattr(program, "AGAIN", -1.0)
    with pytest.raises(KeyboardInterrupt):
        stop.ask()


@pytest.mark.parametrize(
    ("last_words", "used", "waited", "is_deaf"),
    [
        (None, 0.4, 1.6, False),
        (None, 1.6, 1.6, True),
        (None, 0.4, 6.1, True),
        (lambda _: ("", 0), 0.4, 1.6, True),
    ],
)
def test_code_without_last_words_has_more_time_on_a_busy_machine(
    last_words: Any, used: float, waited: float, is_deaf: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    guarding = outcome.Guard(lambda: None, last_words, given_up=lambda: True)
    passed = SimpleNamespace(used=0.0, waited=0.0)
    monkeypatch.setattr(time, "process_time", lambda: passed.used)
    monkeypatch.setattr(limits, "now", lambda: passed.waited)
    assert guarding._is_called()
    passed.used, passed.waited = used, waited
    assert guarding._is_deaf() == is_deaf


def test_ignored_signal_is_ignored_during_a_search() -> None:
    before = signal.signal(signal.SIGTERM, signal.SIG_IGN)
    asked: list[int] = []
    try:
        with on_ctrl_c(lambda: asked.append(1)):
            send()
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGTERM, before)
    assert asked == []


def test_action_of_ctrl_c_raises_nothing_while_a_module_loads(tmp_path: Path) -> None:
    (tmp_path / "loading.py").write_text("import os, signal\nos.kill(os.getpid(), signal.SIGINT)\n")
    script = """
from ssh_abduction.cli.outcome import on_ctrl_c
def end(): raise KeyboardInterrupt
with on_ctrl_c(end):
    import loading
"""
    path = os.pathsep.join([str(tmp_path), *sys.path])
    done = subprocess.run(
        [sys.executable, "-c", script],
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (130, b"")


def test_end_of_all_processes_deletes_their_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    found = workers.answers(sleep, [(0, 100.0)], 1, lambda: False, None, 1.0)
    other = threading.Thread(target=lambda: list(found))
    other.start()
    until(lambda: bool(workers._under_way) and any(tmp_path.iterdir()))
    workers.end_all()
    assert list(tmp_path.iterdir()) == []
    other.join()


def test_ctrl_c_as_grounding_begins_blocks_no_later_search(
    monkeypatch: pytest.MonkeyPatch, room: str
) -> None:
    """A KeyboardInterrupt comes right after the lock for grounding was acquired."""
    lock = control._grounding

    def interrupted(timeout: float) -> bool:
        lock.acquire(timeout=timeout)
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(control, "_grounding", SimpleNamespace(acquire=interrupted))
        with pytest.raises(KeyboardInterrupt):
            control.Control().add("base", [], "a.")
    try:
        assert solve(Trace.load(room), time_limit=SOON).status.value == "optimal"
    finally:
        lock.release()


class Recording(io.BytesIO):
    """A log of a robot that records. The user presses Ctrl-C when no more lines come."""

    def readline(self, size: int | None = -1, /) -> bytes:
        if line := super().readline(size):
            return line
        send()
        time.sleep(SOON)
        return b""


@pytest.mark.slow
def test_ctrl_c_ends_a_log_on_standard_input(
    interrupting: None,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    log, trace = tmp_path / "drive.log", tmp_path / "drive.jsonl"
    write_carmen(log, hall()[:230])
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(Recording(log.read_bytes())))
    assert main(["import", "-", "-o", str(trace)]) == 143
    assert len(Trace.load(trace)) > 5
    assert "the log ends here" in capsys.readouterr().err


def test_ctrl_c_loses_no_scan_that_is_in_use(interrupting: None) -> None:
    stop = StopFlag()
    with until_ctrl_c(iter(range(9)), stop) as some:
        assert next(some) == 0
        send()  # while the first item is in use
        assert list(some) == []
    assert stop.is_set()
