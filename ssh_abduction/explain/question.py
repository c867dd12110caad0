"""Questions about a trace under limits of time and memory."""

from __future__ import annotations

from abc import ABC, abstractmethod
from contextlib import suppress
from typing import Generic, TypeVar

from ssh_abduction.data.trace import Trace
from ssh_abduction.explain.axioms import Interrupted
from ssh_abduction.solver import (
    LimitError,
    Progress,
    Search,
    Stop,
    Watch,
    check_limit,
    check_rules,
)
from ssh_abduction.theory.settle import settle
from ssh_abduction.theory.theory import Theory

_Answer = TypeVar("_Answer")
SHORTEST = 0.05  # seconds that a search has at least


class Question(ABC, Generic[_Answer]):
    """A question under limits.

    `answer` may be called once. `known` may be called in any thread while it runs.
    """

    def __init__(
        self,
        trace: Trace,
        theory: Theory | None,
        time_limit: float | None,
        memory_limit: int | None,
    ) -> None:
        check_limit("time_limit (--time-limit)", "seconds", time_limit)
        check_limit("memory_limit (--memory-limit)", "MiB", memory_limit)
        self.problem = settle(trace, theory)
        self.trace, self.theory = trace, self.problem.theory
        self.theory.check_steps(trace)
        check_rules(self.theory)
        self.limit, self.memory = time_limit, memory_limit
        self.stopped: Stop | None = None
        self._watch = Watch(time_limit, memory_limit)
        self._watch.use_reserve()
        self._search: Search | None = None

    def answer(self) -> _Answer:
        """Find the answer."""
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
        """What is known so far.

        Args:
            why: What is about to end the search, if something is.
        """

    @abstractmethod
    def _find_out(self) -> None:
        """Find the answer, until a limit raises an exception."""

    def interrupt(self) -> None:
        """End soon with what is known; called from another thread or a signal handler."""
        self._watch.interrupted = True
        if self._search is not None:
            self._search.interrupt()

    def _over(self) -> bool:
        """Whether a limit has been reached."""
        try:
            self._watch.check()
        except LimitError as limit:
            self.stopped = limit.reason
        return self.stopped is not None

    def _solved(self, trace: Trace, theory: Theory, maps: int | None, seconds: float) -> Search:
        """A search for maps that ends within `seconds`."""

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
        )
        return search

    def _ended(self, search: Search) -> None:
        """Note why a search ended early."""
        self._search = None
        if search.stopped in ("interrupted", "memory limit"):
            self.stopped = search.stopped
        self._over()
