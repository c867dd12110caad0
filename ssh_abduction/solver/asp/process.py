"""Does work in a process of its own, which can have a processor to itself: of the threads of one process only one runs Python at a time, and only one grounds.

To make guesses is mostly Python, and so is the search that goes on meanwhile: as two threads both would take three times as long. And two threads that
ground at the same time wait for each other at each symbol, so within one process one of them waits until the other has grounded (`asp/control.py`).
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
    """The result of `work`, called with these arguments and a watch, which comes last. It is called in this process if there can be no other.

    work, arguments  picklable; so are the result, and what work raises
    watch            ends the other process when a limit is over. What is left of its memory limit is the memory limit of the other process

    Raises LimitError, also where something from outside ends the process.
    """
    code, answer = _run(work, arguments, watch)
    if code == 0:
        answered: tuple[Result, Exception | None] = pickle.loads(answer)
        result, error = answered
        if error is not None:
            raise error
        return result
    if code < 0:
        raise LimitError(
            "memory limit"
        )  # a signal ended it, as the system does where memory is short
    return work(*arguments, watch)


def _run(
    work: Callable[..., object], arguments: tuple[object, ...], watch: Watch
) -> tuple[int, bytes]:
    """The exit code of a process that does this work, and what it wrote. Should this process end first, the other one's input ends, and it ends with that."""
    if (
        "python" not in os.path.basename(sys.executable or "").lower()
    ):  # this is a program that embeds Python, and cannot be run as Python
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
    """End all processes that this one waits for, as it is about to end itself."""
    for process in list(_under_way):
        process.kill()


def serve() -> None:
    """Do the work that comes in, and write its result, or what it raised, to the output."""
    signal.signal(
        signal.SIGINT, signal.SIG_IGN
    )  # Ctrl-C is meant for the process that waits for this one
    work, arguments, memory = pickle.load(sys.stdin.buffer)
    threading.Thread(target=_end_with_input, daemon=True).start()
    watch = Watch(memory=memory)
    with os.fdopen(os.dup(1), "wb") as output:
        os.dup2(2, 1)  # nothing else is written there
        try:
            answer: tuple[object, Exception | None] = work(*arguments, watch), None
        except Exception as error:
            answer = None, error
        output.seek(0)
        output.truncate()  # something may have greeted there as Python began
        pickle.dump(answer, output)
    os._exit(0)


def _end_with_input() -> None:
    """End this process as soon as its input ends, that is when the process that began it does."""
    while os.read(0, 1):
        pass
    os._exit(1)
