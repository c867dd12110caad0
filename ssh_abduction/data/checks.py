"""Check the arguments of public functions. Each check returns the value or raises an error.

>>> from ssh_abduction.data.checks import a_number, one_of
>>> from ssh_abduction.data.errors import MapError, SolverError
>>> a_number("near", 2, SolverError, above=0, what="metres")
2.0
>>> a_number("near", -1, SolverError, above=0, what="metres")
Traceback (most recent call last):
ssh_abduction.data.errors.SolverError: near: expected metres above 0, got -1; change it
>>> one_of("level", "all", ("places", "dstates"), MapError)
Traceback (most recent call last):
ssh_abduction.data.errors.MapError: level: expected places or dstates, got 'all'; take one of these

Most checks take the name of the argument for error messages, its value, and the class of the error
to raise. Numbers of numpy are accepted as numbers; booleans are not. A path is a text, or an
os.PathLike that gives a text. Bytes are not accepted as a path: decode them with os.fsdecode.

The last functions check what a step observes: views, images and probabilities.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, TypeAlias, TypeVar

from ssh_abduction.data.errors import (
    AbductionError,
    SolverError,
    TraceError,
    brief,
    is_finite,
    is_whole,
    is_writable,
)

T = TypeVar("T")
Kind: TypeAlias = type[AbductionError]


@contextmanager
def needed(what: str, package: str, install: str, error: Kind = AbductionError) -> Iterator[None]:
    """Make a context in which a failed import raises `error`, which says what to install."""
    try:
        yield
    except ImportError:
        raise error(
            f"{what}: expected the package {package}, got none; pip install {install}"
        ) from None


@contextmanager
def free_port(name: str, port: int, error: Kind) -> Iterator[None]:
    """Make a context in which a server that cannot listen at a port raises `error`."""
    try:
        yield
    except (OSError, OverflowError) as wrong:
        raise error(
            f"{name}: expected a free port, got {port} "
            f"({getattr(wrong, 'strerror', wrong)}); name another one, or 0 for any"
        ) from None


def a_number(
    name: str,
    value: object,
    error: Kind,
    low: float = -math.inf,
    high: float = math.inf,
    *,
    above: float = -math.inf,
    what: str = "a number",
    mend: str = "change it",
) -> float:
    """Return a value as a float if it is a finite number within bounds, or raise `error`.

    Args:
        name: The name of the argument in messages.
        value: The value to check.
        error: The class of the error to raise.
        low: The least number allowed.
        high: The greatest number allowed.
        above: A number that the value must exceed.
        what: The kind of number in messages, with its unit, such as "metres".
        mend: What messages advise the caller to do.
    """
    if is_finite(value) and low <= value <= high and value > above:
        return float(value)
    raise error(f"{name}: expected {what}{_between(low, high, above)}, got {brief(value)}; {mend}")


def a_whole_number(
    name: str,
    value: object,
    error: Kind,
    low: int = 0,
    high: float = math.inf,
    *,
    what: str = "a whole number",
    mend: str = "change it",
) -> int:
    """Return a value as an int if it is a whole number from `low` to `high`, or raise `error`.

    The arguments are those of `a_number`.
    """
    if is_whole(value) and low <= value <= high:
        return int(value)
    raise error(f"{name}: expected {what}{_between(low, high)}, got {brief(value)}; {mend}")


def a_count_of_maps(value: object, error: Kind) -> int | None:
    """Return the largest number of maps to list: 1 or more, or None for all. Or raise `error`."""
    if value is None:
        return None
    return a_whole_number("max_maps (--maps)", value, error, 1, mend="None (--maps 0) lists all")


def numbers(
    name: str, value: object, error: Kind, length: int, what: str, mend: str = "change it"
) -> tuple[float, ...]:
    """Return a list, tuple or array of `length` finite numbers as floats, or raise `error`."""
    listed = value.tolist() if hasattr(value, "tolist") else value
    if (
        isinstance(listed, Sequence)
        and not isinstance(listed, str | bytes)
        and len(listed) == length
        and all(map(is_finite, listed))
    ):
        return tuple(float(number) for number in listed)
    raise error(f"{name}: expected {what}, got {brief(value)}; {mend}")


def a_flag(name: str, value: object, error: Kind) -> bool:
    """Return a value as a bool if it is one, perhaps of numpy, or raise `error`."""
    if isinstance(value, bool) or type(value).__name__ == "bool":  # numpy's, without loading numpy
        return bool(value)
    raise error(f"{name}: expected true or false, got {brief(value)}; take one of these")


def a_text(name: str, value: object, error: Kind, *, mend: str = "give a text") -> str:
    """Return a value if it is a text, which may be empty, or raise `error`."""
    if isinstance(value, str):
        return value
    raise error(f"{name}: expected a text, got {brief(value)}; {mend}")


def check_limit(name: str, unit: str, limit: object) -> None:
    """Raise SolverError if a limit is neither None nor a number above 0. Name it and its unit."""
    if (
        limit is not None
        and not (is_finite(limit) and limit > 0)
        and not (isinstance(limit, float) and limit == math.inf)
    ):
        raise SolverError(
            f"{name}: expected a number of {unit} above 0, got {brief(limit)}; "
            "leave it out for no limit"
        )


def one_of(
    name: str,
    value: object,
    choices: Iterable[str],
    error: Kind,
    *,
    mend: str = "take one of these",
) -> str:
    """Return a value if it is one of the texts `choices`, or raise `error`."""
    known = list(choices)
    if isinstance(value, str) and value in known:
        return value
    listed = " or ".join(filter(None, (", ".join(known[:-1]), known[-1])))
    raise error(f"{name}: expected {listed}, got {brief(value)}; {mend}")


def an_instance(name: str, value: object, kind: type[T], error: Kind, *, mend: str) -> T:
    """Return a value if it is an instance of the class `kind`, or raise `error`."""
    if isinstance(value, kind):
        return value
    thing = kind.__name__
    if not thing.endswith("s"):
        thing = f"{'an' if thing.startswith(('A', 'E', 'I', 'O', 'SSH')) else 'a'} {thing}"
    raise error(f"{name}: expected {thing}, got {brief(value)}; {mend}")


def all_instances(
    name: str, values: object, kind: type[T], error: Kind, *, mend: str
) -> tuple[T, ...]:
    """Return an iterable as a tuple if all its members are of class `kind`, or raise `error`.

    Messages name the first member that is wrong.
    """
    return tuple(
        an_instance(f"{name}[{i}]", value, kind, error, mend=mend)
        for i, value in enumerate(a_list(name, values, error, mend=mend))
    )


def a_list(
    name: str, value: object, error: Kind, *, what: str = "a list", mend: str = "give a list"
) -> list[Any]:
    """Return the members of an iterable as a list. Raise `error` for a text, bytes or a mapping."""
    if isinstance(value, Iterable) and not isinstance(value, str | bytes | Mapping):
        return list(value)
    raise error(f"{name}: expected {what}, got {brief(value)}; {mend}")


def an_object(
    name: str, value: object, error: Kind, *, mend: str = 'write {"name": value}'
) -> Mapping[str, Any]:
    """Return a value if it is a mapping whose keys are texts, or raise `error`."""
    if isinstance(value, Mapping) and all(isinstance(key, str) for key in value):
        return value
    raise error(f"{name}: expected an object, got {brief(value)}; {mend}")


def a_function(name: str, value: object, error: Kind, *, what: str) -> Callable[..., Any]:
    """Return a value if it can be called, or raise `error`."""
    if callable(value):
        return value
    raise error(f"{name}: expected {what}, got {brief(value)}; give a function")


def a_path(name: str, value: object, error: Kind) -> str:
    """Return the path of a file as a text, or raise `error`. The file need not exist."""
    path = os.fspath(value) if isinstance(value, str | os.PathLike) else None
    if isinstance(path, str):
        return path
    raise error(
        f"{name}: expected the path of a file, as a text or a pathlib.Path, got {brief(value)}; "
        f"name a file"
    )


def _between(low: float, high: float, above: float = -math.inf) -> str:
    """Say in words which numbers are allowed."""

    def text(number: float) -> str:
        return f"{number:,.0f}" if number == round(number) else f"{number:g}"

    has_low, has_high = math.isfinite(low), math.isfinite(high)
    if math.isfinite(above):
        return f" above {text(above)}" + (f" and at most {text(high)}" if has_high else "")
    if has_low:
        return f" from {text(low)} to {text(high)}" if has_high else f", {text(low)} or more"
    return f", {text(high)} or less" if has_high else ""


View: TypeAlias = str | int


def checked_view(value: Any, where: str) -> View:
    """Return a view if it is a text or an integer of 32 bits, perhaps of numpy. Else TraceError."""
    if is_whole(value):
        value = int(value)
    is_text = isinstance(value, str)
    is_number = isinstance(value, int) and not isinstance(value, bool)
    rename = "rename the view"
    for is_wrong, expected, mend in (
        (not (is_text or is_number), "a text or an integer", "name the view"),
        # clingo's integers
        (is_number and abs(value) >= 2**31, "an integer of 32 bits", "write it as a text"),
        (is_text and "\0" in value, "a text without null characters", rename),
        (is_text and not is_writable(value), "a text that UTF-8 can hold", rename),
    ):
        if is_wrong:
            raise TraceError(f"{where}: expected {expected}, got {brief(value)}; {mend}")
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
    """Return an image, finite numbers or an index into the sidecar file, or raise TraceError.

    Of a tuple, only the first number is checked: traces are copied often, and images are long.
    """
    if isinstance(value, tuple) and (not value or is_finite(value[0])):
        return value
    value = value.tolist() if hasattr(value, "tolist") else value
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


def plain_number(x: float) -> float:
    """Return a number as Python's own int or float. JSON cannot store numbers of numpy."""
    return x if type(x) in (int, float) else int(x) if is_whole(x) else float(x)


def plain_text(text: str) -> str:
    """Return a text as Python's own str. YAML cannot store texts of numpy."""
    return text if type(text) is str else str.__str__(text)
