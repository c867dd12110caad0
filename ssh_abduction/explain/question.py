"""The base class of questions about a trace, with limits of time and memory."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Iterable
from contextlib import suppress
from typing import Generic, TypedDict, TypeVar

from ssh_abduction.data.maps import SSHMap, check_of_trace, checked_maps
from ssh_abduction.data.trace import Trace
from ssh_abduction.explain.axioms import Interrupted
from ssh_abduction.solver import (
    LimitError,
    Progress,
    Search,
    Start,
    Stop,
    Watch,
    check_limit,
    check_rules,
)
from ssh_abduction.theory.settle import settle
from ssh_abduction.theory.theory import Theory

_Answer = TypeVar("_Answer")


SHORTEST = 0.05  # the least time limit of a search in seconds


class QuestionLimits(TypedDict, total=False):
    """The limits of a question, and known maps of its trace, as in `LimitedQuestion`."""

    time_limit: float | None
    memory_limit: int | None
    known: Iterable[SSHMap]


class LimitedQuestion(ABC, Generic[_Answer]):
    """A question about a trace under limits of time and memory.

    `answer` may be called once. `known` may be called from any thread while `answer` runs.
    Parameters as in `explain_pair`.
    """

    def __init__(
        self,
        trace: Trace,
        theory: Theory | None,
        time_limit: float | None = None,
        memory_limit: int | None = None,
        known: Iterable[SSHMap] = (),
    ) -> None:
        check_limit("time_limit (--time-limit)", "seconds", time_limit)
        check_limit("memory_limit (--memory-limit)", "MiB", memory_limit)
        self.problem = settle(trace, theory)
        self.trace, self.theory = trace, self.problem.theory
        self.theory.check_steps(trace)
        check_rules(self.theory)
        self.limit, self.memory = time_limit, memory_limit
        self._known_maps = [*checked_maps(known)]
        check_of_trace(self._known_maps, trace, "known", views=False)
        self.stopped: Stop | None = None
        self._watch = Watch(time_limit, memory_limit)
        self._search: Search | None = None

    def answer(self) -> _Answer:
        """Find the answer. At a limit or Ctrl-C, return what is known by then."""
        self._watch.start()
        with suppress(Interrupted, KeyboardInterrupt, LimitError):
            try:
                self._find_out()
            except KeyboardInterrupt:
                self.stopped = "interrupted"
                raise
        return self.known()

    @abstractmethod
    def known(self, why: Stop | None = None) -> _Answer:
        """Return what is known so far. `why` is the limit that is about to end the search."""

    @abstractmethod
    def _find_out(self) -> None:
        """Find the answer and store it in attributes. At a limit, raise an exception."""

    def interrupt(self) -> None:
        """Make `answer` return soon. Call this from another thread or a signal handler."""
        self._watch.interrupted = True
        if self._search is not None:
            self._search.interrupt()

    def _over(self) -> bool:
        """Tell whether a limit has been reached, and store it in `stopped`."""
        try:
            self._watch.check()
        except LimitError as limit:
            self.stopped = limit.reason
        return self.stopped is not None

    def _solved(self, trace: Trace, theory: Theory, maps: int | None, seconds: float) -> Search:
        """Make a search for maps that ends at the limits of this question."""

        def end_with_this(_: Progress) -> None:
            if self._over():
                search.interrupt()

        limit = None if seconds == float("inf") else max(seconds, SHORTEST)
        search = self._search = Search(
            trace,
            theory,
            time_limit=limit,
            memory_limit=self.memory,
            max_maps=maps,
            on_progress=end_with_this,
            _start=Start(known=tuple(self._known_maps)),
        )
        return search

    def _ended(self, search: Search) -> None:
        """Store in `stopped` why a search ended early, if a limit of this question was reached."""
        self._search = None
        if search.stopped in ("interrupted", "memory limit"):
            self.stopped = search.stopped
        self._over()


def changes_in_words(ssh_map: SSHMap, places: Collection[int | None]) -> tuple[str, ...]:
    """Say which gateways at these places changed between drives, and what each change costs."""
    changes = (f for f in ssh_map.faults if f.kind == "changed" and f.place in places)
    return tuple(f"{change}; this change costs {change.cost:g} dstates" for change in changes)
