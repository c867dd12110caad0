"""Check time limits and Ctrl-C in code that has no access to the search that called it.

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

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TypeVar

Item = TypeVar("Item")

_check: ContextVar[Callable[[], None] | None] = ContextVar("check", default=None)


def look_at_clock() -> None:
    """Call the checks of the surrounding `heeding` blocks. They raise if the work has to end."""
    check = _check.get()
    if check is not None:
        check()


def each_looking(items: Iterable[Item]) -> Iterator[Item]:
    """Yield the items, and call `look_at_clock` before each."""
    for item in items:
        look_at_clock()
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
    while True:
        with heeding(check):
            try:
                item = next(items)
            except StopIteration:
                return
        yield item
