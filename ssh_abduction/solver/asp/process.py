"""Run a Python function in a process of its own, so that it can use a second processor.

Guesses run at the same time as the main search. Both are mostly Python, and only one thread at a
time can run Python, or ground (`asp/control.py`). As two threads of one process, both would take
three times as long.
"""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import TypeVar

from ssh_abduction.runtime.program import command, search_path
from ssh_abduction.solver.asp.limits import POLL, LimitError, Watch

Result = TypeVar("Result")

_under_way: set[subprocess.Popen[bytes]] = set()


def in_process(work: Callable[..., Result], *arguments: object, watch: Watch) -> Result:
    """Call `work` in another process, or in this one if no other process can be started.

    Args:
        work: The function to call. It, its arguments, its result and its errors can be pickled.
        arguments: The first arguments of `work`.
        watch: The limits. The other process is ended at a limit. The last argument of `work` is a
            new watch with only the memory limit in the other process, and `watch` in this one.

    Returns:
        The result of `work`.

    Raises:
        LimitError: A limit is reached, or a signal ended the process.
    """
    code, answer = _run(work, arguments, watch)
    if code == 0:
        answered: tuple[Result, Exception | None] = pickle.loads(answer)
        result, error = answered
        if error is not None:
            raise error
        return result
    if code < 0:
        # A signal ended the process. Most likely the system is short of memory.
        raise LimitError("memory limit")
    return work(*arguments, watch)


def _run(
    work: Callable[..., object], arguments: tuple[object, ...], watch: Watch
) -> tuple[int, bytes]:
    """Start a child process that does the work, and return its exit code and its output.

    If this process exits first, the stdin of the child closes, and then the child exits, too.
    """
    # A program that embeds Python cannot be run as Python.
    if "python" not in os.path.basename(sys.executable or "").lower():
        return 1, b""
    with (
        suppress(OSError),
        tempfile.TemporaryFile() as answer,
        subprocess.Popen(
            command(__name__), stdin=subprocess.PIPE, stdout=answer, stderr=subprocess.DEVNULL
        ) as process,
    ):
        assert process.stdin
        _under_way.add(process)
        try:
            with suppress(BrokenPipeError):
                for sent in (search_path(), (work, arguments, watch.memory_left())):
                    pickle.dump(sent, process.stdin)
                process.stdin.flush()
            while process.poll() is None:
                watch.check()
                with suppress(subprocess.TimeoutExpired):
                    process.wait(POLL)
        finally:
            process.kill()
            _under_way.discard(process)
        answer.seek(0)
        return process.returncode, answer.read()
    return 1, b""


def end_all() -> None:
    """Kill all processes that `in_process` waits for. Call this before this process exits."""
    for process in list(_under_way):
        process.kill()


def serve() -> None:
    """Run in the child: read the work from stdin, do it, and write its result or error."""
    # The parent process handles Ctrl-C.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    work, arguments, memory = pickle.load(sys.stdin.buffer)
    threading.Thread(target=_end_with_input, daemon=True).start()
    watch = Watch(memory=memory)
    with os.fdopen(os.dup(1), "wb") as output:
        os.dup2(2, 1)  # what the work prints goes to stderr
        try:
            answer: tuple[object, Exception | None] = work(*arguments, watch), None
        except Exception as error:
            answer = None, error
        output.seek(0)
        output.truncate()  # Python may have printed something at its start
        pickle.dump(answer, output)
    os._exit(0)


def _end_with_input() -> None:
    """Exit when stdin closes, which means that the parent process has exited."""
    while os.read(0, 1):
        pass
    os._exit(1)
