"""Run work in the background while the robot drives."""

from __future__ import annotations

import threading
import weakref
from collections.abc import Callable
from concurrent.futures import Future
from typing import Generic, TypeVar

from ssh_abduction.solver import LimitError, Watch

Result = TypeVar("Result")


class BackgroundTask(Generic[Result]):
    """Work that runs in a thread. It is stopped when this object is garbage collected.

    Args:
        work: The function that does the work and returns its result. It gets a watch, and should
            stop when the watch is interrupted. It should start a process for long work.
    """

    def __init__(self, work: Callable[[Watch], Result | None]) -> None:
        self._found: Future[Result | None] = Future()
        watch = Watch()
        thread = threading.Thread(target=_do, args=(work, watch, self._found), daemon=True)
        weakref.finalize(self, _end, watch, thread)
        thread.start()

    def done(self) -> bool:
        """Whether the work has ended."""
        return self._found.done()

    def result(self) -> Result | None:
        """Wait for the result, and return it; None if there is none or the work was stopped."""
        return self._found.result()


def _do(work: Callable[[Watch], Result | None], watch: Watch, found: Future[Result | None]) -> None:
    """Do the work, and store its result or its exception in `found`."""
    try:
        found.set_result(work(watch))
    except LimitError:
        found.set_result(None)
    except BaseException as error:
        found.set_exception(error)


def _end(watch: Watch, thread: threading.Thread) -> None:
    """Interrupt the work of a thread, and wait until it has ended."""
    watch.interrupted = True
    thread.join()
