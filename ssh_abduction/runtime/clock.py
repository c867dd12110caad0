"""Count work, and check limits and Ctrl-C in code without access to the search that called it.

Work is counted for each thread: a unit of work is about a second of a quiet core. The same search
does the same work on each machine and under each load, so a work limit always gives the same
answer. Loops count their work as they call `look_at_clock`.

A search passes a function that checks its limits to `heeding`. The checker, the evidence and the
guesses call `look_at_clock` in long loops, which calls this function. Outside of a search,
`look_at_clock` does nothing.

>>> def over():
...     raise TimeoutError("the time is over")
>>> look_at_clock()
>>> with heeding(over):
...     look_at_clock()
Traceback (most recent call last):
TimeoutError: the time is over
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from contextvars import ContextVar
from functools import partial
from typing import TypeVar

Item = TypeVar("Item")

# The work of a turn of a loop that looks at the clock, in microunits, if it names no other number;
# of a turn of a short loop over steps; and of a turn that compares all pairs of many steps.
TURN, SHORT_TURN, LONG_TURN = 800, 80, 8000
# What else weighs as work, fitted to the processor time of mazes, offices and logs of robots
# (`benchmarks/work.py` measures it again): a conflict of clasp in a small program, what the square
# of the number of atoms adds to each conflict, and an answer of clasp, in units.
CONFLICT, CONFLICT_OF_SQUARE, ANSWER = 3e-5, 6.5e-13, 2e-3
# An iteration of a least-squares fit of poses, and what each displacement adds, in microunits.
FIT, FIT_OF_ONE = 900, 8
# An atom that clingo grounds, and a call of `@go_on` by which it asks whether to go on, in
# microunits.
ATOM, ASKED = 18, 2
MICRO = 1_000_000  # microunits in a unit; whole numbers add up to the same sum in each order

# Seconds between two checks of the clock and of Ctrl-C while clingo is busy. Limits may be exceeded
# by a second, and a check takes far less time than this.
POLL = 0.05
# The work for the first map may wait this many times as long: without a map there is no answer.
STARVED = 30.0


class _Done(threading.local):
    """The work that this thread has done, in microunits."""

    micro = 0


_done = _Done()
_counting: ContextVar[bool] = ContextVar("counting", default=False)
_check: ContextVar[Callable[[], None] | None] = ContextVar("check", default=None)


def count_work(micro: int) -> None:
    """Add to the work that this thread has done, in microunits."""
    _done.micro += micro


def work_done() -> float:
    """Return the units of work that this thread has done."""
    return _done.micro / MICRO


def counts_work() -> bool:
    """Whether the surrounding search measures its time by work, not in seconds."""
    return _counting.get()


def now() -> float:
    """Return the time on the clock of the surrounding search: units of work, or seconds."""
    return work_done() if _counting.get() else time.perf_counter()


@contextmanager
def counting(is_on: bool) -> Iterator[None]:
    """Make `now` measure work inside a `with` block, or seconds if `is_on` is False."""
    before = _counting.set(is_on)
    try:
        yield
    finally:
        _counting.reset(before)


def each_counting(is_on: bool, items: Iterator[Item]) -> Iterator[Item]:
    """Yield the items of an iterator. Only its own work runs within `counting(is_on)`."""
    return _each_within(partial(counting, is_on), items)


def look_at_clock(micro: int = TURN) -> None:
    """Count work, and call the checks of the `heeding` blocks. They raise if it has to end.

    Args:
        micro: The work since the last call, in microunits.
    """
    _done.micro += micro
    check = _check.get()
    if check is not None:
        check()


def each_looking(items: Iterable[Item]) -> Iterator[Item]:
    """Yield the items, and call `look_at_clock` before each."""
    for item in items:
        look_at_clock(SHORT_TURN)
        yield item


@contextmanager
def heeding(check: Callable[[], None]) -> Iterator[None]:
    """Make `look_at_clock` call `check` inside a `with` block.

    If such blocks are nested, the checks of the outer blocks are called first. A check raises an
    error if the work has to end. It is called often, so it should take microseconds.
    """
    around = _check.get()

    def both() -> None:
        if around is not None:
            around()
        check()

    before = _check.set(both)
    try:
        yield
    finally:
        _check.reset(before)


def each_heeding(check: Callable[[], None], items: Iterator[Item]) -> Iterator[Item]:
    """Yield the items of an iterator. Only its own work runs within `heeding(check)`."""
    return _each_within(partial(heeding, check), items)


def _each_within(
    context: Callable[[], AbstractContextManager[None]], items: Iterator[Item]
) -> Iterator[Item]:
    while True:
        with context():
            try:
                item = next(items)
            except StopIteration:
                return
        yield item
