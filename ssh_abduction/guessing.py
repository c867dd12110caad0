"""Maps of a trace that a robot is still driving: made of guesses, or mended, in no time or in a thread of their own. For theories where places have frames.

Consistent by the axioms of the theory (`framed.py`), but not minimal for sure.
"""

from __future__ import annotations

import threading
import weakref
from collections.abc import Sequence
from concurrent.futures import Future

from ssh_abduction.asking import Stopped, Watch, has_processors
from ssh_abduction.framed import FramedEngine
from ssh_abduction.maps import SSHMap
from ssh_abduction.replay import Log
from ssh_abduction.speedups import Speedups
from ssh_abduction.theory import Theory
from ssh_abduction.trace import Step, Trace


def mended_map(trace: Trace, theory: Theory, known: SSHMap, speedups: Speedups, watch: Watch | None = None) -> SSHMap | None:
    """A map of a trace near one of its first steps that its later steps contradict, if there is one in which all that does not fit is new."""
    watch = watch or Watch()
    found = FramedEngine(trace, theory, watch, Log(trace, theory), speedups).map_mended_from(known.labels)
    return found.map if found else None


class MapGuess:
    """A map of a trace that grows, made in a thread of its own. The thread ends when this is no longer referred to, and with the program.

    A map is made of a guess, unless one is known. As the trace has grown meanwhile, and may contradict it, it is mended at the end.

    steps    those of the trace so far; more may be appended
    may_run  to be cleared where others are in a hurry, as Python runs but one thread at a time
    """

    def __init__(self, steps: Sequence[Step], theory: Theory, speedups: Speedups, known: SSHMap | None = None) -> None:
        self.may_run = threading.Event()
        self._found: Future[SSHMap | None] = Future()
        watch = _PausedWatch(self.may_run)
        thread = threading.Thread(target=_make, args=(steps, theory, speedups, known, watch, self._found), daemon=True)
        weakref.finalize(self, _end, watch, self.may_run, thread)
        thread.start()

    @staticmethod
    def begun(steps: Sequence[Step], theory: Theory, speedups: Speedups, known: SSHMap | None = None) -> MapGuess | None:
        """None where there is no second processor, or guesses are not wanted."""
        return MapGuess(steps, theory, speedups, known) if speedups.annealed and has_processors(speedups) else None

    def done(self) -> bool:
        return self._found.done()

    def map(self) -> SSHMap | None:
        """The map of the first steps, if one was found. Waits until that is known."""
        return self._found.result()


class _PausedWatch(Watch):
    """The watch of a search that waits until it may run."""

    def __init__(self, may_run: threading.Event) -> None:
        super().__init__()
        self._may_run = may_run

    def check(self, ahead: float = 0.0) -> None:
        self._may_run.wait()
        super().check(ahead)


def _make(
    steps: Sequence[Step], theory: Theory, speedups: Speedups, known: SSHMap | None, watch: Watch, found: Future[SSHMap | None]
) -> None:
    try:
        if not known:
            trace = Trace(tuple(steps))
            guessed = FramedEngine(trace, theory, watch, Log(trace, theory), speedups).map_of_guess()
            known = guessed.map if guessed else None
        if known and len(steps) > len(known.labels):
            known = mended_map(Trace(tuple(steps)), theory, known, speedups, watch)
        found.set_result(known)
    except Stopped:
        found.set_result(None)
    except BaseException as error:
        found.set_exception(error)


def _end(watch: Watch, may_run: threading.Event, thread: threading.Thread) -> None:
    watch.interrupted = True
    may_run.set()
    thread.join()
