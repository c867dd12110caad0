"""Functions that tests run in other processes. Each of these processes loads this module."""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from ssh_abduction.runtime import workers
from ssh_abduction.runtime.limits import Watch


def modules_from(folder: str) -> list[str]:
    """The modules that this process loaded from a folder."""
    return sorted(
        name
        for name, module in list(sys.modules.items())
        if (getattr(module, "__file__", None) or "").startswith(f"{folder}{os.sep}")
    )


def from_here(folder: str, _: Watch) -> list[str]:
    import csv  # noqa: F401 - nothing else has loaded it

    return modules_from(folder)


def from_there(number: int, folder: str, _: Callable[[], bool]) -> list[str]:
    import csv  # noqa: F401 - nothing else has loaded it

    return modules_from(folder)


def leave_a_temporary_file(number: int, there: str, given_up: Callable[[], bool]) -> None:
    """Print the folder of this process's temporary files, and wait."""
    folder = tempfile.mkdtemp()
    Path(there).write_text(folder)
    while not given_up():
        time.sleep(0.05)


def until(condition: Callable[[], bool]) -> None:
    """Wait until a condition holds."""
    ends = time.monotonic() + 100
    while not condition():
        assert time.monotonic() < ends
        time.sleep(0.02)


def sleep(number: int, seconds: float, given_up: Callable[[], bool]) -> int:
    """Return the number after some seconds, or when the task is given up."""
    ends = time.monotonic() + seconds
    while time.monotonic() < ends and not given_up():
        time.sleep(0.01)
    return number


def vanish(_: int, path: str, __: Callable[[], bool]) -> None:
    """Write the id of this process, and end without an answer."""
    Path(path).write_text(str(os.getpid()))
    os._exit(3)


def stay(_: int, path: str, __: Callable[[], bool]) -> None:
    """Write the id of this process, and ignore all signals."""
    Path(path).write_text(str(os.getpid()))
    time.sleep(1000)


def hand_over_and_vanish(number: int, path: str, _: Callable[[], bool]) -> None:
    """Hand two things over, and end without an answer."""
    workers.hand_over("first")
    workers.hand_over("second")
    vanish(number, path, _)


def hand_over_and_stay(number: int, path: str, _: Callable[[], bool]) -> None:
    """Hand something over, and ignore all signals."""
    workers.hand_over("first")
    stay(number, path, _)


def answer_and_end(number: int, seconds: float, _: Callable[[], bool]) -> None:
    """Answer, and end this process some seconds later, as a guard does at a limit."""
    workers.reply(number)
    time.sleep(seconds)
    os._exit(1)
