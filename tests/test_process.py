"""Work in another process has the same result as here, and ends when it is no longer needed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from unittest.mock import patch

import pytest

from ssh_abduction.runtime.clock import POLL
from ssh_abduction.runtime.limits import LimitError, Watch, in_process, peak_memory


def double_and_tell_where(values: list[int], watch: Watch) -> tuple[list[int], int]:
    print("not part of the answer")
    watch.check()
    return [2 * value for value in values], os.getpid()


def fail(message: str, _: Watch) -> None:
    raise ValueError(message)


def write_again_and_again(path: Path, watch: Watch) -> None:
    for number in range(10**9):
        watch.check()
        path.write_text(str(number))
        time.sleep(0.01)


def end_at_once(_: Watch) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def use_memory(mebibytes: int, watch: Watch) -> int:
    held = []
    for _ in range(mebibytes):
        held.append(b"x" * 2**20)
        watch.check()
    return len(held)


def is_written(path: Path) -> bool:
    before = path.stat().st_mtime_ns
    time.sleep(0.3)
    return path.stat().st_mtime_ns != before


def test_in_process_returns_the_result_of_another_process() -> None:
    values = list(range(100_000))  # more than a pipe holds
    doubled, process = in_process(double_and_tell_where, values, watch=Watch())
    assert doubled == [2 * value for value in values]
    assert process != os.getpid()


def test_output_of_a_startup_file_does_not_disturb_a_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "sitecustomize.py").write_text("print('good morning' * 1000)")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    doubled, process = in_process(double_and_tell_where, [1, 2], watch=Watch())
    assert doubled == [2, 4]
    assert process != os.getpid()


@pytest.mark.parametrize("executable", ["", None, "/usr/bin/robot", "/nowhere/python"])
def test_in_process_works_here_if_no_process_starts(executable: str | None) -> None:
    with patch.object(sys, "executable", executable):
        assert in_process(double_and_tell_where, [1, 2], watch=Watch()) == ([2, 4], os.getpid())


def test_in_process_raises_the_error_of_the_work() -> None:
    with pytest.raises(ValueError, match="twice nothing"):
        in_process(fail, "twice nothing", watch=Watch())


def test_interrupt_ends_the_process(tmp_path: Path) -> None:
    path = tmp_path / "written"
    watch = Watch()

    def interrupt() -> None:
        while not path.exists():
            time.sleep(0.01)
        watch.interrupted = True

    waiting = threading.Thread(target=interrupt)
    waiting.start()
    with pytest.raises(LimitError, match="interrupted"):
        in_process(write_again_and_again, path, watch=watch)
    waiting.join()
    assert not is_written(path)


@pytest.mark.skipif(sys.platform == "win32", reason="signals")
@pytest.mark.timeout(60)
def test_slow_signal_handler_does_not_stop_the_waiting_for_a_process(
    tmp_path: Path,
) -> None:
    """The handler takes longer than one look at the answers, which must then go on."""
    path = tmp_path / "written"
    watch = Watch()

    def handle(*_: object) -> None:
        time.sleep(2 * POLL)
        watch.interrupted = True

    def send() -> None:
        while not path.exists():
            time.sleep(0.01)
        os.kill(os.getpid(), signal.SIGUSR1)

    before = signal.signal(signal.SIGUSR1, handle)
    sender = threading.Thread(target=send)
    sender.start()
    try:
        with pytest.raises(LimitError, match="interrupted"):
            in_process(write_again_and_again, path, watch=watch)
    finally:
        sender.join()
        signal.signal(signal.SIGUSR1, before)


def test_process_ends_with_its_parent(tmp_path: Path) -> None:
    path = tmp_path / "written"
    program = f"""
from pathlib import Path
from ssh_abduction.runtime.limits import Watch
from ssh_abduction.runtime.limits import in_process
from test_process import write_again_and_again
in_process(write_again_and_again, Path({str(path)!r}), watch=Watch())
"""
    with subprocess.Popen(
        [sys.executable, "-c", program], env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    ) as waiting:
        while not path.exists():
            assert waiting.poll() is None
            time.sleep(0.01)
        assert is_written(path)
        waiting.kill()
    ends = time.monotonic() + 100
    while is_written(path):
        assert time.monotonic() < ends


def test_killed_process_is_a_limit_error() -> None:
    with pytest.raises(LimitError):
        in_process(end_at_once, watch=Watch())


def test_memory_limit_of_a_process_ignores_its_parent() -> None:
    """The memory of this process does not count."""
    held = b"x" * (150 * 2**20)
    limited = Watch(memory=peak_memory() + 100)
    assert in_process(use_memory, 10, watch=limited) == 10
    with pytest.raises(LimitError, match="memory"):
        in_process(use_memory, 200, watch=limited)
    del held
