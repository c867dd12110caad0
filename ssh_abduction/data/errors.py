"""The errors that a user can cause or correct: one root, and one subclass for each layer.

Errors of bad input are also ValueErrors, so that programs without knowledge of this package can
catch them. If something is missing on the machine, the error is a plain AbductionError. A defect of
this package is an `InternalError` (`solver/board.py`). Reaching a limit of time or memory is no
error: `Solution.stopped` names the limit.
"""

from __future__ import annotations

import math
import numbers
import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TypeGuard


class AbductionError(Exception):
    """The base class of all errors of this package.

    The text is one line. It says what was expected, what was found, and how to correct the input.
    """

    def __str__(self) -> str:
        return printable(super().__str__())  # names of files and views may hold anything


class TraceError(AbductionError, ValueError):
    """A trace or a trace file is malformed."""


class TheoryError(AbductionError, ValueError):
    """The choices of a theory contradict each other, or the trace lacks what they need."""


class MapError(AbductionError, ValueError):
    """A map or a file of maps is malformed."""


class LocaliserError(AbductionError, ValueError):
    """An argument of a localiser is wrong."""


class SolverError(AbductionError, ValueError):
    """An argument of the solver is wrong, or the solver cannot do what was asked."""


class RangeError(AbductionError, ValueError, IndexError):
    """There is no step or map with the given number. The text names the range."""


@contextmanager
def said_of(where: str, kind: type[AbductionError] = AbductionError) -> Iterator[None]:
    """Put the name of a file or field before the text of an error of this kind in the block."""
    try:
        yield
    except kind as error:
        if str(error).startswith(f"{where}:"):
            raise
        raise type(error)(f"{where}: {error}") from None


def named(source: object) -> str:
    """Return the name of a file for a message, on one line."""
    text = str(source)
    return text if text.isprintable() else repr(text)


def brief(value: object, width: int = 60) -> str:
    """Return the repr of a value for a message, on one line of at most `width` characters."""
    try:
        text = repr(value)
    except (RecursionError, ValueError):  # nested without end, or a number of thousands of digits
        text = f"a value of type {type(value).__name__}"
    return text if len(text) <= width else text[: width - 1] + "…"


def printable(text: str) -> str:
    """Return a text on one line, with all unprintable characters escaped."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def xml_text(text: str) -> str:
    """Return a text for XML. Characters that XML forbids or that steer a terminal become U+FFFD."""
    return re.sub("[^\t\n -~\u00a0-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]", "\ufffd", text)


def checked_index(index: object, count: int, what: str) -> int:
    """Return an index that counts from 0; a negative one counts from the end.

    Raises RangeError if there is no thing with this index, and TypeError if it is no whole
    number. Messages call the things `what`, such as "steps".
    """
    if not is_whole(index):
        raise TypeError(f"{what}: expected a whole number or a slice, got {brief(index)}; give one")
    found = int(index)
    if not -count <= found < count:
        some = f"0 to {count - 1}, or {-count} to -1 from the end"
        there = some if count else "none, as there are none"
        raise RangeError(f"{what}: expected {there}, got {brief(found)}; take one of them")
    return found % count


def is_finite(value: object) -> TypeGuard[float]:
    """Whether a value is a real number that a finite float can hold. Booleans are not numbers."""
    try:
        return (
            isinstance(value, numbers.Real) and not isinstance(value, bool) and math.isfinite(value)
        )
    except OverflowError:  # a whole number of more than 308 digits
        return False


def is_whole(value: object) -> TypeGuard[int]:
    """Whether a value is a whole number. Booleans are not numbers."""
    return isinstance(value, numbers.Integral) and not isinstance(value, bool)


def is_writable(text: str) -> bool:
    """Whether UTF-8 can encode a text. It cannot encode half of a surrogate pair."""
    try:
        text.encode("utf-8")
    except UnicodeEncodeError:
        return False
    return True
