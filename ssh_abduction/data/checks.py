"""Checks of the arguments of public functions. Each returns the value or raises an error.

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

All checks take what messages call the argument, its value, and the error to raise. Numbers of
numpy are numbers; truth values are not. A path is a text, or an os.PathLike that stands for a text.
Bytes are not a path: decode them with os.fsdecode.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, TypeAlias, TypeVar

from ssh_abduction.data.errors import AbductionError, brief, is_finite, is_whole

T = TypeVar("T")
Kind: TypeAlias = type[AbductionError]


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
    """A finite number from `low` to `high` that is greater than `above`.

    Args:
        name: What messages call the argument.
        value: What the caller gave.
        error: The error to raise.
        low: The least number allowed.
        high: The greatest number allowed.
        above: A bound that is not allowed itself.
        what: What messages call such numbers, with their unit.
        mend: What the caller should do.
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
    """A whole number from `low` to `high`. The arguments are those of `a_number`."""
    if is_whole(value) and low <= value <= high:
        return int(value)
    raise error(f"{name}: expected {what}{_between(low, high)}, got {brief(value)}; {mend}")


def a_count_of_maps(value: object, error: Kind) -> int | None:
    """The most maps to list, 1 or more; None for all."""
    mend = "None lists all (--maps 0)"
    return (
        None if value is None else a_whole_number("max_maps (--maps)", value, error, 1, mend=mend)
    )


def numbers(
    name: str, value: object, error: Kind, length: int, what: str, mend: str = "change it"
) -> tuple[float, ...]:
    """A given number of finite numbers, from a list, a tuple or an array."""
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
    """True or false, perhaps of numpy."""
    if isinstance(value, bool) or type(value).__name__ == "bool":  # numpy's, without loading numpy
        return bool(value)
    raise error(f"{name}: expected true or false, got {brief(value)}; take one of these")


def a_text(name: str, value: object, error: Kind, *, mend: str = "give a text") -> str:
    """A text, which may be empty."""
    if isinstance(value, str):
        return value
    raise error(f"{name}: expected a text, got {brief(value)}; {mend}")


def one_of(
    name: str,
    value: object,
    choices: Iterable[str],
    error: Kind,
    *,
    mend: str = "take one of these",
) -> str:
    """One of several texts."""
    known = list(choices)
    if isinstance(value, str) and value in known:
        return value
    told = " or ".join(filter(None, (", ".join(known[:-1]), known[-1])))
    raise error(f"{name}: expected {told}, got {brief(value)}; {mend}")


def an_instance(name: str, value: object, kind: type[T], error: Kind, *, mend: str) -> T:
    """A value of a class."""
    if isinstance(value, kind):
        return value
    article = "an" if kind.__name__.startswith(("A", "E", "I", "O", "SSH")) else "a"
    raise error(f"{name}: expected {article} {kind.__name__}, got {brief(value)}; {mend}")


def all_instances(
    name: str, values: object, kind: type[T], error: Kind, *, mend: str
) -> tuple[T, ...]:
    """Values of a class, from any iterable. Messages name the first one that is wrong."""
    return tuple(
        an_instance(f"{name}[{i}]", value, kind, error, mend=mend)
        for i, value in enumerate(a_list(name, values, error))
    )


def a_list(
    name: str, value: object, error: Kind, *, what: str = "a list", mend: str = "give a list"
) -> list[Any]:
    """The members of an iterable that is not a text, bytes or a mapping."""
    if isinstance(value, Iterable) and not isinstance(value, str | bytes | Mapping):
        return list(value)
    raise error(f"{name}: expected {what}, got {brief(value)}; {mend}")


def an_object(name: str, value: object, error: Kind) -> Mapping[str, Any]:
    """A mapping from names to values."""
    if isinstance(value, Mapping) and all(isinstance(key, str) for key in value):
        return value
    raise error(f'{name}: expected an object, got {brief(value)}; write {{"name": value}}')


def a_function(name: str, value: object, error: Kind, *, what: str) -> Callable[..., Any]:
    """A function, or anything else that can be called."""
    if callable(value):
        return value
    raise error(f"{name}: expected {what}, got {brief(value)}; give a function")


def a_path(name: str, value: object, error: Kind) -> str:
    """The path of a file, as a text. Whether it is possible shows when the file is opened."""
    path = os.fspath(value) if isinstance(value, str | os.PathLike) else None
    if isinstance(path, str):
        return path
    raise error(
        f"{name}: expected the path of a file, as a text or a pathlib.Path, got {brief(value)}; "
        f"name a file"
    )


def _between(low: float, high: float, above: float = -math.inf) -> str:
    """The range of a number, in words."""

    def told(number: float) -> str:
        return f"{number:,.0f}" if number == round(number) else f"{number:g}"

    has_low, has_high = math.isfinite(low), math.isfinite(high)
    if math.isfinite(above):
        return f" above {told(above)}" + (f" and at most {told(high)}" if has_high else "")
    if has_low:
        return f" from {told(low)} to {told(high)}" if has_high else f", {told(low)} or more"
    return f", {told(high)} or less" if has_high else ""
