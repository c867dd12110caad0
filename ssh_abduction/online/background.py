"""Work that goes on in a process of its own while the robot drives."""

from __future__ import annotations

import threading
import weakref
from collections.abc import Callable
from concurrent.futures import Future
from typing import Generic, TypeVar

from ssh_abduction.solver import LimitError, Watch

Result = TypeVar("Result")


class Beside(Generic[Result]):
    """Work beside the robot's own, which ends when this is no longer referred to, and with the program.

    work  is given a watch that ends it, and does in a process of its own what takes long
    """

    def __init__(self, work: Callable[[Watch], Result | None]) -> None:
        self._found: Future[Result | None] = Future()
        watch = Watch()
        thread = threading.Thread(target=_do, args=(work, watch, self._found), daemon=True)
        weakref.finalize(self, _end, watch, thread)
        thread.start()

    def done(self) -> bool:
        return self._found.done()

    def result(self) -> Result | None:
        """What was found; None where there was nothing to find, or the work was ended. Waits until that is known."""
        return self._found.result()


def _do(work: Callable[[Watch], Result | None], watch: Watch, found: Future[Result | None]) -> None:
    try:
        found.set_result(work(watch))
    except LimitError:
        found.set_result(None)
    except BaseException as error:
        found.set_exception(error)


def _end(watch: Watch, thread: threading.Thread) -> None:
    watch.interrupted = True
    thread.join()
