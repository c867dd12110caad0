"""Check what a step observes: views, images and probabilities."""

from __future__ import annotations

from typing import Any, TypeAlias

from ssh_abduction.data.checks import a_number
from ssh_abduction.data.errors import TraceError, brief, is_finite, is_whole, is_writable

View: TypeAlias = str | int


def checked_view(value: Any, where: str) -> View:
    """Return a view if it is a text or an integer of 32 bits, perhaps of numpy. Else TraceError."""
    if is_whole(value):
        value = int(value)
    if isinstance(value, bool) or not isinstance(value, str | int):
        raise TraceError(
            f"{where}: expected a text or an integer, got {brief(value)}; name the view"
        )
    if isinstance(value, int) and not -(2**31) < value < 2**31:  # clingo's integers
        raise TraceError(
            f"{where}: expected an integer of 32 bits, got {brief(value)}; write it as a text"
        )
    if isinstance(value, str) and "\0" in value:
        raise TraceError(
            f"{where}: expected a text without null characters, got {brief(value)}; rename the view"
        )
    if isinstance(value, str) and not is_writable(value):
        raise TraceError(
            f"{where}: expected a text that UTF-8 can hold, got half a character in "
            f"{brief(value)}; rename the view"
        )
    return plain_text(value) if isinstance(value, str) else value


def checked_probability(value: Any, where: str) -> float:
    """Return a value as a float if it is a probability from 0 to 1, or raise TraceError."""
    mend = "leave it out if the probability is unknown"
    return a_number(where, value, TraceError, 0, 1, what="a probability", mend=mend)


def finite(value: Any, where: str) -> float:
    """Return a value as a float if it is a finite number, or raise TraceError."""
    mend = "replace it, or leave the field out"
    return a_number(where, value, TraceError, what="a finite number", mend=mend)


def checked_image(value: Any, where: str) -> tuple[float, ...] | int:
    """Return an image, finite numbers or an index into the sidecar file, or raise TraceError."""
    if is_whole(value):
        if value < 0:
            raise TraceError(
                f"{where}: expected an index of 0 or more into the sidecar file, got {value}; "
                f"count from 0"
            )
        return value
    for i, x in enumerate(numbers_listed(value, where)):
        if not is_finite(x):
            finite(x, f"{where}[{i}]")  # raises
    return tuple(plain_number(x) for x in value)


def numbers_listed(value: Any, where: str) -> list[Any] | tuple[Any, ...]:
    """Return a value if it is a list or a tuple, or raise TraceError."""
    if isinstance(value, list | tuple):
        return value
    raise TraceError(f"{where}: expected a list of numbers, got {brief(value)}; write [1, 2, …]")


def frozen_image(value: Any) -> tuple[float, ...] | int:
    """Return an image as a tuple of numbers, or as an index into the sidecar file.

    Of a tuple, only the first number is checked: traces are copied often, and images are long.
    """
    if isinstance(value, tuple) and (not value or is_finite(value[0])):
        return value
    return checked_image(value.tolist() if hasattr(value, "tolist") else value, "image")


def plain_number(x: float) -> float:
    """Return a number as Python's own int or float. JSON cannot store numbers of numpy."""
    return x if type(x) in (int, float) else int(x) if is_whole(x) else float(x)


def plain_text(text: str) -> str:
    """Return a text as Python's own str. YAML cannot store texts of numpy."""
    return text if type(text) is str else str.__str__(text)
