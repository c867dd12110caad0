"""Run work in another process while the robot drives."""

from __future__ import annotations

import threading
import weakref
from collections.abc import Callable
from concurrent.futures import Future
from typing import Generic, TypeVar

from ssh_abduction.solver import LimitError, Watch, has_processors, in_process
from ssh_abduction.theory.speedups import Speedups

Result = TypeVar("Result")


class BackgroundTask(Generic[Result]):
    """A function that runs in another process, until this object is garbage collected.

    Args:
        function: The function. It also gets a `watch`, and should stop when this is interrupted.
        arguments: Its other arguments.
    """

    def __init__(self, function: Callable[..., Result | None], *arguments: object) -> None:
        self._found: Future[Result | None] = Future()
        watch = Watch()
        thread = threading.Thread(
            target=_do, args=(function, arguments, watch, self._found), daemon=True
        )
        weakref.finalize(self, _end, watch, thread)
        thread.start()

    @classmethod
    def begun(
        cls, speedups: Speedups, function: Callable[..., Result | None], *arguments: object
    ) -> BackgroundTask[Result] | None:
        """Start and return a task; None with only one processor, or without `processes`."""
        can_begin = speedups.processes and has_processors()
        return cls(function, *arguments) if can_begin else None

    def done(self) -> bool:
        """Whether the work has ended."""
        return self._found.done()

    def result(self) -> Result | None:
        """Wait for the result, and return it; None if there is none or the work was stopped."""
        return self._found.result()


def _do(
    function: Callable[..., Result | None],
    arguments: tuple[object, ...],
    watch: Watch,
    found: Future[Result | None],
) -> None:
    """Do the work, and store its result or its exception in `found`."""
    try:
        found.set_result(in_process(function, *arguments, watch=watch))
    except LimitError:
        found.set_result(None)
    except BaseException as error:
        found.set_exception(error)


def _end(watch: Watch, thread: threading.Thread) -> None:
    """Interrupt the work of a thread, and wait until it has ended."""
    watch.interrupted = True
    thread.join()
