"""Every error that a user can cause or mend: one root, one subclass a layer.

What bad input causes is a ValueError, too, so that programs which know nothing of this package catch it. What bad input does not cause is none: a defect of
this program (`InternalError` of `solver/judging.py`), and what is missing on a machine, which is an AbductionError alone. Limits that are over are no errors: `Solution.stopped` says so.
"""

from __future__ import annotations

import math
import numbers
import re
from typing import TypeGuard


class AbductionError(Exception):
    """Root of the package's errors. Its text is one line: what was expected, what came, how to mend it."""

    def __str__(self) -> str:
        return printable(super().__str__())  # names of files and views may hold anything


class TraceError(AbductionError, ValueError):
    """A trace, or a file of one, is malformed."""


class TheoryError(AbductionError, ValueError):
    """The choices of a theory contradict each other, or the trace lacks what they need."""


class MapError(AbductionError, ValueError):
    """A map, or a file of maps, is malformed."""


class LocaliserError(AbductionError, ValueError):
    """What a localiser is made of, or is asked, does not fit."""


class SolverError(AbductionError, ValueError):
    """The solver cannot do what was asked."""


class RangeError(AbductionError, ValueError, IndexError):
    """A step or a map that there is not. The text names the range."""


def named(source: object) -> str:
    """A file's name as an error message shows it: on one line."""
    text = str(source)
    return text if text.isprintable() else repr(text)


def brief(value: object, width: int = 60) -> str:
    """`value` as an error message shows it: on one line, cut to `width` characters."""
    try:
        text = repr(value)
    except (RecursionError, ValueError):  # nested without end, or a number of thousands of digits
        text = f"a value of type {type(value).__name__}"
    return text if len(text) <= width else text[: width - 1] + "…"


def printable(text: str) -> str:
    """A text on one line, in which characters that would steer a terminal, or that nobody sees, are escaped."""
    return (
        text
        if text.isprintable()
        else "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)
    )


def xml_text(text: str) -> str:
    """A text without the characters that XML cannot hold, or that would steer a terminal, each replaced by U+FFFD."""
    return re.sub("[^\t\n -~\u00a0-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]", "\ufffd", text)


def checked_index(index: object, count: int, what: str) -> int:
    """An index into `count` things, from 0; a negative one counts from the end. Raises RangeError that names the range, and TypeError where it is no whole number.

    what  the things, as messages call them: steps, maps
    """
    if not is_whole(index):
        raise TypeError(f"{what}: expected a whole number or a slice, got {brief(index)}")
    found = int(index)
    if not -count <= found < count:
        there = (
            f"0 to {count - 1}, or {-count} to -1 from the end"
            if count
            else "none, as there are none"
        )
        raise RangeError(f"{what}: expected {there}, got {brief(found)}")
    return found % count


def is_finite(value: object) -> TypeGuard[float]:
    """Whether a value is a number (numpy's, too; true and false are none) that a floating-point number can hold."""
    try:
        return (
            isinstance(value, numbers.Real) and not isinstance(value, bool) and math.isfinite(value)
        )
    except OverflowError:  # a whole number of more than 308 digits
        return False


def is_whole(value: object) -> TypeGuard[int]:
    """Whether a value is a whole number (numpy's, too; true and false are none)."""
    return isinstance(value, numbers.Integral) and not isinstance(value, bool)


def is_writable(text: str) -> bool:
    """Whether UTF-8 can hold a text: half of a surrogate pair cannot be written."""
    try:
        text.encode("utf-8")
    except UnicodeEncodeError:
        return False
    return True
