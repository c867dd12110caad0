"""Read and write files of names and corrections, in YAML. See docs/reference/formats.md."""

from __future__ import annotations

import json
import math
import os
import warnings
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from ssh_abduction.data.checks import a_path
from ssh_abduction.data.corrections import (
    ASSERTIONS,
    DIRECTIONS,
    FORMAT,
    VERSION,
    Corrections,
    Naming,
    Passage,
    Said,
    checked_corrections,
    direction_in_words,
)
from ssh_abduction.data.drives import Drive
from ssh_abduction.data.errors import MapError, brief, named
from ssh_abduction.data.files import json_line, parse_yaml, read_file, save_file
from ssh_abduction.data.map_parts import NAMED
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.schema import FieldReader

FILE = "corrections.yaml"  # the name of the file beside a map
LARGEST = 2**24  # bytes
HEAD = """\
# Names and corrections of a person. You can edit this file, or use `ssh-abduction name` and
# `ssh-abduction correct`, which write it anew: they keep each `note:`, but not comments like this.
"""
T = TypeVar("T")


def load_corrections(path: str | os.PathLike[str]) -> Corrections:
    """Read a file of names and corrections.

    Args:
        path: The file; or a folder, for the file `corrections.yaml` in it.

    Raises:
        MapError: The file cannot be read or is malformed. The error names the field.
    """
    file = file_in(path)
    data = read_file(file, LARGEST, "a file of corrections", MapError)
    return from_yaml(data, str(file))


def save_corrections(corrections: Corrections, path: str | os.PathLike[str]) -> None:
    """Write names and corrections into a file.

    Args:
        corrections: The names and corrections.
        path: The file; or a folder, for the file `corrections.yaml` in it.

    Raises:
        MapError: The file cannot be written.
    """
    file = file_in(path)
    data = (HEAD + to_yaml(checked_corrections(corrections))).encode()
    save_file(str(file), data, "corrections", MapError)


def file_in(path: str | os.PathLike[str]) -> Path:
    """Return the file of corrections that a path names: itself, or the one in a folder."""
    file = Path(a_path("path", path, MapError) or FILE)
    return file / FILE if file.is_dir() else file


def beside(maps: str | os.PathLike[str] | None) -> Path | None:
    """Return the file of corrections beside a file of maps; None if there is none.

    Raises MapError if a folder has its name.
    """
    if maps is None or str(maps) == "-":
        return None
    file = Path(a_path("maps", maps, MapError)).parent / FILE
    if file.is_dir():
        raise MapError(
            f"{named(file)}: expected a file of corrections, got a folder; give it another name"
        )
    return file if file.exists() else None


def named_beside(
    maps: Iterable[SSHMap], drives: Sequence[Drive], path: str | os.PathLike[str] | None
) -> tuple[SSHMap, ...]:
    """Return maps with the names in the file of corrections beside their file, if there is one.

    `drives` are the drives of the trace of the maps, with fingerprints; empty if unknown. If the
    file of corrections is of other drives, a warning says so. Raises MapError if it is malformed.
    """
    file = beside(path)
    if file is None or not drives:
        return tuple(maps)
    said = load_corrections(file)
    try:
        said.check_drives({drive.name: drive.fingerprint for drive in drives})
    except MapError as error:
        warnings.warn(f"{error}; its names are not used", stacklevel=3)
        return tuple(maps)
    return tuple(said.named(ssh_map, drives) for ssh_map in maps)


def to_yaml(corrections: Corrections) -> str:
    """Write names and corrections as YAML. `from_yaml` reads them."""
    import yaml  # loads slowly

    data: dict[str, Any] = {
        "format": FORMAT,
        "version": VERSION,
        "drives": dict(corrections.drives),
        "names": [{"name": n.name, n.kind: n.step, **_note(n)} for n in corrections.names],
    }
    for kind in ASSERTIONS:
        data[kind] = [
            {"steps": [*said.steps], "note": said.note} if said.note else [*said.steps]
            for said in corrections.pairs
            if said.kind == kind
        ]
    data["gateways"] = []
    for gateway in corrections.gateways:
        seen = {step: direction_in_words(way) for step, way in gateway.seen}
        data["gateways"].append({"open" if gateway.is_open else "closed": seen, **_note(gateway)})
    kept = {name: value for name, value in data.items() if value or name == "drives"}
    kept = json.loads(json_line(kept))  # YAML knows no texts of numpy
    how: dict[str, Any] = {"sort_keys": False, "allow_unicode": True, "default_flow_style": None}
    return str(yaml.safe_dump(kept, width=100, **how))


def _note(said: Naming | Passage) -> dict[str, str]:
    return {"note": said.note} if said.note else {}


def from_yaml(text: str | bytes, source: str = "corrections") -> Corrections:
    """Read names and corrections from YAML. Raises MapError, which names source and field."""
    try:
        data = parse_yaml(text)
    except ValueError as error:
        raise MapError(f"{source}: expected YAML, got {error}; mend it there") from None
    return _CorrectionsReader(named(source)).corrections(data, source)


class _CorrectionsReader(FieldReader):
    """Checks the fields of a file of corrections. Errors name the file and the field."""

    mend = "mend it there"

    def corrections(self, data: object, source: str) -> Corrections:
        """Convert the data of a file."""
        fields = ("format", "version", "drives", "names", *ASSERTIONS, "gateways")
        record = self._object(data, "file", fields)
        if record.get("format") != FORMAT:
            raise self.wrong("format", f'"{FORMAT}"', record.get("format"))
        if record.get("version") != str(VERSION):
            expected = f"{VERSION} (another one is of another ssh-abduction)"
            raise self.wrong("version", expected, record.get("version"))
        record = {name: value for name, value in record.items() if value}  # others say nothing
        drives = self._object(record.get("drives", {}), "drives")
        return Corrections(
            {name: self._text(mark, f"drives.{name}") for name, mark in drives.items()},
            self.each(record, "names", self._naming, optional=True),
            tuple(
                said
                for kind in ASSERTIONS
                for said in self.each(record, kind, partial(self._said, kind), optional=True)
            ),
            self.each(record, "gateways", self._passage, optional=True),
            source,
        )

    def _naming(self, value: object, where: str) -> Naming:
        record = self._object(value, where, ("name", *NAMED, "note"))
        kinds = [kind for kind in NAMED if kind in record]
        if len(kinds) != 1:
            raise self.wrong(where, f"one of {', '.join(NAMED)}", value)
        name = self._text(record.get("name"), f"{where}.name").strip()
        step = self._step(record[kinds[0]], f"{where}.{kinds[0]}")
        return Naming(name, kinds[0], step, self._note(record, where))

    def _said(self, kind: str, value: object, where: str) -> Said:
        note, steps = None, value
        if isinstance(value, Mapping):
            record = self._object(value, where, ("steps", "note"))
            note, steps = self._note(record, where), record.get("steps")
        if not isinstance(steps, list) or len(steps) != 2:
            raise self.wrong(where, "two steps, such as [monday:12, tuesday:3]", value)
        first, second = (self._step(step, f"{where}[{i}]") for i, step in enumerate(steps))
        if first == second:
            raise self.wrong(where, "two different steps", value)
        return Said(kind, (first, second), note)

    def _passage(self, value: object, where: str) -> Passage:
        record = self._object(value, where, ("open", "closed", "note"))
        if ("open" in record) == ("closed" in record):
            raise self.wrong(where, "one of open, closed", value)
        state = "open" if "open" in record else "closed"
        field, seen = f"{where}.{state}", record[state]
        if not seen or not isinstance(seen, Mapping):
            raise self.wrong(field, "steps and directions, such as monday:12: left", seen)
        ways = ((self._step(s, field), self._way(w, f"{field}.{s}")) for s, w in seen.items())
        return Passage(state == "open", tuple(ways), self._note(record, where))

    def _way(self, value: object, where: str) -> float:
        text = self._text(value, where)
        try:
            return direction(text)
        except MapError:
            raise self.wrong(where, f"{', '.join(DIRECTIONS)}, or degrees", value) from None

    def _step(self, value: object, where: str) -> str:
        drive, colon, number = self._text(value, where).rpartition(":")
        if not (drive and colon and number.isascii() and number.isdecimal()):
            raise self.wrong(where, "a drive, a colon and a step, such as monday:12", value)
        return f"{drive}:{int(number)}"

    def _note(self, record: Mapping[str, object], where: str) -> str | None:
        return self._text(record["note"], f"{where}.note") if record.get("note") else None

    def _text(self, value: object, where: str) -> str:
        if not isinstance(value, str) or not value.strip() or not value.isprintable():
            raise self.wrong(where, "a text on one line", value)
        return value

    def _object(
        self, value: object, where: str, fields: Sequence[str] | None = None
    ) -> Mapping[str, Any]:
        if not isinstance(value, Mapping) or not all(isinstance(key, str) for key in value):
            expected = "fields such as name: kitchen" if fields is None else ", ".join(fields)
            raise self.wrong(where, expected, value)
        if fields is not None and (unknown := set(value) - set(fields)):
            raise self.wrong(where, f"only {', '.join(fields)}", min(unknown))
        return value


def direction(text: str) -> float:
    """Read a direction: ahead, right, back, left, or degrees clockwise. Raises MapError."""
    with suppress(ValueError):
        degrees = DIRECTIONS[text] if text in DIRECTIONS else float(text)
        if math.isfinite(degrees):
            return degrees % 360
    raise MapError(
        f"direction: expected {', '.join(DIRECTIONS)}, or degrees clockwise from ahead, got "
        f"{brief(text)}; take one"
    )
