"""What a step observes: the checks of views, images and probabilities."""

from __future__ import annotations

from typing import Any, TypeAlias

from ssh_abduction.data.errors import TraceError, brief, is_finite, is_whole, is_writable

View: TypeAlias = str | int


def checked_view(value: Any, where: str) -> View:
    """A view that a caller gives.

    Args:
        value: The view; numpy's whole numbers are fine.
        where: Its name in messages.
    """
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
    return value


def view_or_unknown(value: Any, where: str) -> View | None:
    """A view, or None for an unknown one."""
    return None if value is None else checked_view(value, where)


def checked_probability(value: Any, where: str) -> float:
    """A probability that a caller gives."""
    if not is_finite(value) or not 0 <= value <= 1:
        raise TraceError(
            f"{where}: expected a probability from 0 to 1, got {brief(value)}; "
            f"leave it out where none is known"
        )
    return float(value)


def checked_image(value: Any, where: str) -> tuple[float, ...] | int:
    """An image: a list of finite numbers, or an index into the sidecar file."""
    if is_whole(value):
        if value < 0:
            raise TraceError(
                f"{where}: expected an index of 0 or more into the sidecar file, got {value}; "
                f"count from 0"
            )
        return value
    if not isinstance(value, list | tuple):
        raise TraceError(
            f"{where}: expected a list of numbers, got {brief(value)}; write [1, 2, …]"
        )
    for i, x in enumerate(value):
        if not is_finite(x):
            raise TraceError(
                f"{where}[{i}]: expected a finite number, got {brief(x)}; "
                f"replace it, or leave the field out"
            )
    return tuple(plain_number(x) for x in value)


def frozen_image(value: Any) -> tuple[float, ...] | int:
    """An image as a step holds it.

    Only the first number of a tuple is checked, as traces are copied often and panoramas are long.
    """
    if isinstance(value, tuple) and (not value or is_finite(value[0])):
        return value
    return checked_image(value.tolist() if hasattr(value, "tolist") else value, "image")


def plain_number(x: float) -> float:
    """A number as Python's own int or float, as JSON cannot hold those of numpy."""
    return x if type(x) in (int, float) else int(x) if is_whole(x) else float(x)
