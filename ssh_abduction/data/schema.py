"""The schema of values in JSON: write values as plain data, and read and check the fields of files.

A *shape* reads one value: it takes the value and the name of its field, and returns the checked
value, or raises an error that names the field. Shapes are methods of a `FieldReader`, or are made
by one. A record is read by the shapes of its fields:

>>> from ssh_abduction.data.map_parts import MapPath
>>> read = FieldReader("maps.json")
>>> shapes = {"id": read.integer, "order": read.integers}
>>> read.record(MapPath, {"id": 0, "order": [2, 3]}, "paths[0]", **shapes)
MapPath(id=0, order=(2, 3))
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import MISSING, fields
from typing import Any, ClassVar, TypeAlias, TypeVar

from ssh_abduction.data.checks import View, a_text
from ssh_abduction.data.errors import AbductionError, MapError, brief, is_finite, is_writable

T = TypeVar("T")
Shape: TypeAlias = Callable[[Any, str], T]


def set_checked(value: Any, **checks: Callable[[Any, str], Any]) -> None:
    """Replace fields of a frozen dataclass by their checked values. None stays.

    Each check gets the value and the name of the field, and returns the value or raises an error.
    """
    for name, check in checks.items():
        if (given := getattr(value, name)) is not None:
            object.__setattr__(value, name, check(given, name))


class PlainData:
    """The base class of dataclasses whose plain data for JSON is all of their fields."""

    __slots__ = ()

    def to_dict(self) -> dict[str, Any]:
        """Return all fields as plain data, as the commands print it with --json."""
        value: Any = self
        return attributes_of(value, *(field.name for field in fields(value)))


class SparseData(PlainData):
    """The base class of dataclasses whose plain data leaves out fields that are None or empty.

    A list that has no default is written even if it is empty.
    """

    __slots__ = ()

    def to_dict(self) -> dict[str, Any]:
        """Return the fields as plain data, without those that are None or empty."""
        data, needed = PlainData.to_dict(self), _without_default(type(self))
        return {
            name: value
            for name, value in data.items()
            if value is not None and (value != [] or name in needed)
        }


def _without_default(kind: Any) -> set[str]:
    """The names of the fields of a dataclass that have no default."""
    return {f.name for f in fields(kind) if f.default is f.default_factory is MISSING}


def attributes_of(value: Any, *names: str) -> dict[str, Any]:
    """Return attributes of a value by name, as plain data for JSON."""
    return {name: plain(getattr(value, name)) for name in names}


def plain(value: Any) -> Any:
    """Return plain data: tuples become lists, and values that have a `to_dict` become dicts."""
    if hasattr(value, "to_dict"):
        return value.to_dict()
    if isinstance(value, Mapping):
        return {key: plain(part) for key, part in value.items()}
    return [plain(part) for part in value] if isinstance(value, tuple | list) else value


def only_known(**fields: Any) -> dict[str, Any]:
    """Return the fields that are not None.

    >>> only_known(floor=2, name=None)
    {'floor': 2}
    """
    return {name: value for name, value in fields.items() if value is not None}


class FieldReader:
    """Reads and checks fields of a JSON object from a file of maps.

    Errors name the field by `name`, and the file by `where`. Readers of other files are subclasses.
    """

    error: ClassVar[type[AbductionError]] = MapError  # the class of the errors that are raised
    mend: str = "write the file with solve --json"  # what messages advise the user to do

    def __init__(self, where: str) -> None:
        self.where = a_text("where", where, self.error)
        is_object = "an object", lambda value: isinstance(value, Mapping)
        self.mapping: Shape[Mapping[str, Any]] = self.that(*is_object)
        self.integer: Shape[int] = self.that("an integer", _is_integer)
        self.integers: Shape[tuple[int, ...]] = self.several(self.integer, "a list of integers")
        self.whole: Shape[int] = self.within(0, math.inf, "a whole number, 0 or more")
        self.text: Shape[str] = self.text_called("a text")

    def wrong(self, name: str, expected: str, value: Any) -> AbductionError:
        """Return the error for a field with a wrong value."""
        what = f"{self.where}: {name or 'map'}: expected {expected}"
        return self.error(f"{what}, got {brief(value)}; {self.mend}")

    def record(self, kind: type[T], value: Any, name: str, /, **shapes: Shape[Any]) -> T:
        """Read an object as an instance of a dataclass, from the shape of each field.

        A field that is missing keeps its default. If it has none, its shape reads None.
        """
        given, path = self.mapping(value, name), f"{name}." if name else ""
        needed = _without_default(kind)
        return kind(
            **{
                key: read(given.get(key), path + key)
                for key, read in shapes.items()
                if key in given or key in needed
            }
        )

    def each(
        self, record: Mapping[str, Any], name: str, read: Shape[T], optional: bool = False
    ) -> tuple[T, ...]:
        """Read the members of the list in a field; none if an optional field is missing."""
        members = self.list(record, name, optional)
        return tuple(read(value, f"{name}[{i}]") for i, value in enumerate(members))

    def list(self, record: Mapping[str, Any], name: str, optional: bool = False) -> list[Any]:
        """Return the list in a field of a record; an empty list if an optional field is missing."""
        value = record.get(name, [] if optional else None)
        if not isinstance(value, list):
            raise self.wrong(name, "a list", value)
        return value

    def number(self, value: Any, name: str) -> float:
        if not is_finite(value):
            raise self.wrong(name, "a finite number", value)
        return float(value)

    def not_negative(self, value: Any, name: str) -> float:
        if self.number(value, name) < 0:
            raise self.wrong(name, "a number, 0 or more", value)
        return float(value)

    def that(self, expected: str, is_good: Callable[[Any], bool]) -> Shape[Any]:
        """Make the shape of a value that passes a test. Messages call it `expected`."""

        def read(value: Any, name: str) -> Any:
            if not is_good(value):
                raise self.wrong(name, expected, value)
            return value

        return read

    def text_called(self, expected: str) -> Shape[str]:
        """Make the shape of a text, which messages call `expected`."""
        return self.that(expected, lambda value: isinstance(value, str))

    def values(self, read: Shape[T]) -> Shape[dict[str, T]]:
        """Make the shape of an object whose values all have one shape."""
        return lambda value, name: {
            key: read(part, f"{name}.{key}") for key, part in self.mapping(value, name).items()
        }

    def within(self, low: int, high: float, expected: str) -> Shape[int]:
        """Make the shape of an integer from `low` to `high`, which messages call `expected`."""
        return self.that(expected, lambda value: _is_integer(value) and low <= value <= high)

    def maybe(self, read: Shape[T], default: Any = None) -> Shape[T | Any]:
        """Make the shape of a value that may be null, which becomes the default."""
        return lambda value, name: default if value is None else read(value, name)

    def one_of(self, choices: Collection[str]) -> Shape[Any]:
        """Make the shape of a text that is one of these."""
        return self.that(
            " or ".join(choices), lambda value: isinstance(value, str) and value in choices
        )

    def several(
        self, read: Shape[T], expected: str, count: int | None = None
    ) -> Shape[tuple[T, ...]]:
        """Make the shape of a list, of `count` values if given, which messages call `expected`."""

        def read_all(value: Any, name: str) -> tuple[T, ...]:
            if not isinstance(value, list) or count not in (None, len(value)):
                raise self.wrong(name, expected, value)
            return tuple(read(part, f"{name}[{i}]") for i, part in enumerate(value))

        return read_all

    def view(self, expected: str) -> Shape[View | None]:
        """Make the shape of a view: a text or an integer, or None for an unknown one."""

        def is_view(value: Any) -> bool:
            if isinstance(value, str):
                return is_writable(value)
            return value is None or _is_integer(value)

        return self.that(expected, is_view)


def _is_integer(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)
