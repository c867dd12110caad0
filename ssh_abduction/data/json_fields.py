"""Read the fields of JSON objects in files. Errors name the field."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, ClassVar, TypeVar

from ssh_abduction.data.checks import a_text
from ssh_abduction.data.errors import AbductionError, MapError, brief, is_finite, is_writable
from ssh_abduction.data.observation import View

T = TypeVar("T")


class FieldReader:
    """Reads and checks fields of a JSON object from a file of maps.

    Most methods return the checked value or raise an error. Their argument `name` is the name of
    the field in error messages, and `where` the name of the file. Readers of other files are
    subclasses.
    """

    error: ClassVar[type[AbductionError]] = MapError  # the class of the errors that are raised
    mend: ClassVar = "write the file with solve --json"  # what messages advise the user to do

    def __init__(self, where: str) -> None:
        self.where = a_text("where", where, self.error)

    def wrong(self, name: str, expected: str, value: Any) -> AbductionError:
        """Return the error for a field with a wrong value."""
        what = f"{self.where}: {name or 'map'}: expected {expected}"
        return self.error(f"{what}, got {brief(value)}; {self.mend}")

    def mapping(self, value: Any, name: str) -> Mapping[str, Any]:
        if not isinstance(value, Mapping):
            raise self.wrong(name, "an object", value)
        return value

    def list(self, record: Mapping[str, Any], name: str, optional: bool = False) -> list[Any]:
        """Return the list in a field of a record; an empty list if an optional field is missing."""
        value = record.get(name, [] if optional else None)
        if not isinstance(value, list):
            raise self.wrong(name, "a list", value)
        return value

    def each(
        self,
        record: Mapping[str, Any],
        name: str,
        read: Callable[[Any, str], T],
        optional: bool = False,
    ) -> tuple[T, ...]:
        """Return the members of the list in a field, each converted by `read`.

        `read` takes a member and its name in messages.
        """
        members = self.list(record, name, optional)
        return tuple(read(value, f"{name}[{i}]") for i, value in enumerate(members))

    def integer(self, value: Any, name: str) -> int:
        if isinstance(value, bool) or not isinstance(value, int):
            raise self.wrong(name, "an integer", value)
        return value

    def integers(self, value: Any, name: str) -> tuple[int, ...]:
        if not isinstance(value, list):
            raise self.wrong(name, "a list of integers", value)
        return tuple(self.integer(x, f"{name}[{i}]") for i, x in enumerate(value))

    def whole(self, value: Any, name: str) -> int:
        if self.integer(value, name) < 0:
            raise self.wrong(name, "a whole number, 0 or more", value)
        return int(value)

    def optional(self, value: Any, name: str) -> int | None:
        return None if value is None else self.integer(value, name)

    def number(self, value: Any, name: str) -> float:
        if not is_finite(value):
            raise self.wrong(name, "a finite number", value)
        return float(value)

    def not_negative(self, value: Any, name: str) -> float:
        if self.number(value, name) < 0:
            raise self.wrong(name, "a number, 0 or more", value)
        return float(value)

    def numbers(self, value: Any, name: str) -> tuple[float, float, float]:
        if not isinstance(value, list) or len(value) != 3:
            raise self.wrong(name, "three numbers", value)
        x, y, z = (self.number(number, name) for number in value)
        return x, y, z

    def view(self, value: Any, name: str, expected: str) -> View | None:
        """Return a view (a text or an integer), or None for an unknown one."""
        is_view = isinstance(value, str | int | None) and not isinstance(value, bool)
        if not is_view or (isinstance(value, str) and not is_writable(value)):
            raise self.wrong(name, expected, value)
        view: View | None = value
        return view
