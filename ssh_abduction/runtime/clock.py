"""Limits of time and Ctrl-C for code that does not know the search that it works for.

A search names the function that checks its limits (`heeding`). The checker, evidence and guesses
call `look_at_clock` in loops that may take long. Without a search that does nothing.

>>> def over():
...     raise TimeoutError("the time is over")
>>> look_at_clock()
>>> with heeding(over):
...     look_at_clock()
Traceback (most recent call last):
TimeoutError: the time is over
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TypeVar

Item = TypeVar("Item")

_check: ContextVar[Callable[[], None] | None] = ContextVar("check", default=None)


def look_at_clock() -> None:
    """Check the limits of the search in this thread. It raises if the work has to end."""
    check = _check.get()
    if check is not None:
        check()


def each_looking(items: Iterable[Item]) -> Iterator[Item]:
    """The same items, with a look at the clock before each."""
    for item in items:
        look_at_clock()
        yield item


@contextmanager
def heeding(check: Callable[[], None]) -> Iterator[None]:
    """Let `look_at_clock` call a function in this context, after those of the contexts around it.

    Args:
        check: Raises if the work has to end. It is called often, so it should take microseconds.
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
    """The same items, each made within `heeding(check)` and used outside of it."""
    while True:
        with heeding(check):
            try:
                item = next(items)
            except StopIteration:
                return
        yield item
