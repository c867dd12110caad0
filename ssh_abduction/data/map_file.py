"""Read and write the JSON of maps. See docs/reference/formats.md."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence, Set
from dataclasses import replace
from functools import partial
from typing import Any

from ssh_abduction.data.checks import a_path
from ssh_abduction.data.errors import MapError, is_writable
from ssh_abduction.data.files import BadJson, opened, parse_json, save_file, source_of
from ssh_abduction.data.map_parts import (
    FAULTS,
    NAMED,
    DState,
    Fault,
    Fit,
    MapPath,
    Name,
    Pose,
    Region,
)
from ssh_abduction.data.schema import FieldReader, Shape

# What files of solutions and of single maps begin with.
SOLUTION_FORMAT, MAP_FORMAT, VERSION = "ssh-solution", "ssh-map", 1
# The most bytes of a file: some hundred thousand maps. Reading needs ten times more memory.
LARGEST = 2**30


def write_map(path: str | os.PathLike[str], text: str, what: str = "map") -> None:
    """Write a map, or a picture of one, into a file, with a line end. Raises MapError."""
    save_file(a_path("path", path, MapError), f"{text}\n".encode(), what, MapError)


def read_json(path: str | os.PathLike[str]) -> Any:
    """Read the JSON value in a file of maps; "-" means standard input.

    Raises:
        MapError: If the file cannot be read or does not hold exactly one JSON value. The error
            names the file and, if JSON is broken, the line.
    """
    path = a_path("path", path, MapError)
    source = source_of(path)
    with opened(path, "a readable file of maps", MapError) as file:
        text = file.read(LARGEST + 1)
    fewer = "list fewer (solve --maps)"
    if len(text) > LARGEST:
        raise MapError(f"{source}: expected at most {LARGEST // 2**20} MiB, got more; {fewer}")
    if not text.strip():
        raise MapError(f"{source}: expected JSON, got an empty file; {FieldReader.mend}")
    try:
        return parse_json(text)
    except MemoryError:
        raise MapError(
            f"{source}: expected maps that fit into memory, got a larger file; {fewer}"
        ) from None
    except BadJson as error:
        if text.startswith(b'{"format": "ssh-trace"'):
            raise MapError(
                f"{source}: expected maps, got a trace; "
                f"name the two files in the other order, or solve it first"
            ) from None
        mend = error.mend or FieldReader.mend
        if "Extra data" in str(error):
            mend = "solve prints a line for each of several traces: take one of them"
        where = source if error.line is None else f"{source}:{error.line}"
        where += f": {error.field}" if error.field else ""
        raise MapError(f"{where}: expected {error.expected}, got {error}; {mend}") from None


def check_format(data: Mapping[str, Any], expected: str, where: str) -> None:
    """Raise MapError if the field `format` or `version` of a file has another value."""
    read = FieldReader(where)
    if data.get("format", expected) != expected:
        raise read.wrong("format", f'"{expected}"', data["format"])
    version = data.get("version", VERSION)
    if version != VERSION or isinstance(version, bool):
        read.mend = "read it with the ssh-abduction that wrote it, or solve again"
        raise read.wrong("version", str(VERSION), version)


def map_fields(data: Any, where: str) -> dict[str, Any]:
    """Convert the JSON of a map, as `SSHMap.to_dict` makes it, to the arguments of SSHMap by name.

    Raises MapError, which names the field.
    """
    return _MapReader(where).fields(data)


class _MapReader(FieldReader):
    """Reads and checks the fields of a map."""

    @property
    def pair(self) -> Shape[Any]:
        """The shape of two integers."""
        return self.exactly(2, self.integer, "a list of two numbers")

    def fields(self, data: Any) -> dict[str, Any]:
        """Return the arguments of SSHMap by name."""
        record = self.mapping(data, "")
        each, may_have = partial(self.each, record), partial(self.each, record, optional=True)
        dstates = each("dstates", self._dstate)
        places, paths = may_have("places", self.integer), may_have("paths", self._path)
        names = may_have("names", self._name)
        # Fields refer to dstates, places and paths by their ids, so check these first.
        self._check_ids(dstates, places, paths)
        labels = self._labels(record, len(dstates))
        self._check_once("names", [name.text for name in names])
        region = partial(self._region, {*places}, {path.id for path in paths})
        regions = None if record.get("regions") is None else each("regions", region)
        for number, found in enumerate(regions or ()):
            if found.id != number:
                expected = f"{number}, its number in the list"
                raise self.wrong(f"regions[{number}].id", expected, found.id)
        return {
            "dstate_at": labels,
            "starts": self._starts(record, len(labels)),
            "dstates": dstates,
            "links": each("links", partial(self._link, len(dstates))),
            "places": places,
            "paths": paths,
            "excused": may_have("excused", self.pair),
            "faults": may_have("faults", partial(self._fault, len(labels))),
            "fit": self._fit(record, len(dstates)),
            "regions": regions,
            "names": names,
        }

    def _check_ids(
        self, dstates: Sequence[DState], places: Sequence[int], paths: Sequence[MapPath]
    ) -> None:
        """Check that dstates are numbered, and places and paths listed if they are used."""
        ids = [s.id for s in dstates]
        if ids != list(range(len(dstates))):
            raise self.wrong("dstates", "the ids 0, 1, 2, … in this order", ids)
        used_places = {s.place for s in dstates} | {q for p in paths for q in p.order}
        path_ids = [p.id for p in paths]
        for name, known, used in (
            ("places", places, used_places),
            ("paths", path_ids, {s.path for s in dstates}),
        ):
            if missing := used - {None, *known}:
                expected = f"every id that is used, also {min(missing, key=str)}"
                raise self.wrong(name, expected, list(known))
            self._check_once(name, known)

    def _check_once(self, name: str, values: Sequence[object]) -> None:
        if len(set(values)) < len(values):
            raise self.wrong(name, "each once", list(values))

    def _labels(self, record: Mapping[str, Any], dstates: int) -> tuple[int, ...]:
        """Convert and check the dstate of each step."""
        labels = self.each(record, "labels", self.integer)
        if not labels:
            raise self.wrong("labels", "the dstate of each step", [])
        for i, label in enumerate(labels):
            if not 0 <= label < dstates:
                expected = f"the id of one of {dstates} dstates"
                raise self.wrong(f"labels[{i}]", expected, label)
        return labels

    def _starts(self, record: Mapping[str, Any], steps: int) -> tuple[int, ...]:
        """Convert and check the steps at which drives start, besides step 0."""
        starts = self.each(record, "starts", self.integer, optional=True)
        if list(starts) != sorted({*starts}) or not all(0 < t < steps for t in starts):
            raise self.wrong("starts", f"steps from 1 to {steps - 1} in order", list(starts))
        return starts

    def _dstate(self, value: Any, name: str) -> DState:
        """Read a dstate. The caller checks that its place and path exist."""
        expected = "a text or an integer, or null where it is unknown"
        if "view" not in self.mapping(value, name):
            raise self.wrong(f"{name}.view", expected, None)
        number = self.maybe(self.integer)
        dstate = self.record(
            DState,
            value,
            name,
            id=self.integer,
            view=self.view(expected),
            place=number,
            path=number,
            direction=number,
            heading=self.maybe(self.within(0, 359, "a slot, 0 to 3, or degrees, 0 to 359")),
            floor=self.maybe(self.within(0, math.inf, "the number of a floor, from 0")),
        )
        way = dstate.direction
        if way not in (None, 1, -1) or (way is None) != (dstate.path is None):
            raise self.wrong(
                f"{name}.direction", "1 or -1 where there is a path, null elsewhere", way
            )
        return dstate

    def _path(self, value: Any, name: str) -> MapPath:
        path = self.record(MapPath, value, name, id=self.integer, order=self.integers)
        if len(set(path.order)) < len(path.order):
            raise self.wrong(f"{name}.order", "each place once", list(path.order))
        return path

    def _link(self, dstates: int, value: Any, name: str) -> tuple[int, str, int]:
        """Read a link. Its two dstates have ids below `dstates`."""
        good = (
            isinstance(value, list)
            and len(value) == 3
            and type(value[0]) is type(value[2]) is int
            and isinstance(value[1], str)
        )
        if not good or not is_writable(value[1]) or not all(0 <= s < dstates for s in value[::2]):
            raise self.wrong(name, "[dstate, action name, dstate]", value)
        return value[0], value[1], value[2]

    def _fault(self, steps: int, value: Any, name: str) -> Fault:
        """Read a fault. Its step must be less than `steps`."""
        number, view = self.maybe(self.integer), self.view("a text or an integer")
        fault = self.record(
            Fault,
            value,
            name,
            kind=self.one_of(FAULTS),
            step=self.within(0, steps - 1, f"a step from 0 to {steps - 1}"),
            seen=view,
            expected=view,
            cost=self.number,
            place=number,
            gateway=number,
            towards=self.maybe(self.text),
            bearing=number,
        )
        if fault.kind == "changed":
            placed, bearing = fault.place is not None, fault.bearing
            if bearing is None and not (placed and fault.gateway in range(4)):
                what = "a slot, 0 to 3, and a place, for a change"
                raise self.wrong(f"{name}.gateway", what, fault.gateway)
            if bearing is not None and not (placed and 0 <= bearing < 360):
                what = "degrees, 0 to 359, and a place, for a change"
                raise self.wrong(f"{name}.bearing", what, bearing)
        return fault

    def _region(self, places: Set[int], paths: Set[int], value: Any, name: str) -> Region:
        """Read a region. Its places and paths must be those of the map."""
        reader = _MapReader(f"{self.where}: {name}")
        region = reader.record(
            Region,
            self.mapping(value, name),
            "",
            id=reader.integer,
            places=reader.integers,
            bounds=reader.several(reader.pair, "a list"),
            door=reader.maybe(reader.integer),
            inside=reader.integers,
        )
        spots = [*region.places, *(() if region.door is None else (region.door,))]
        if not region.places or not {*spots} <= places:
            raise reader.wrong("places", "some places of the map", spots)
        if any(h not in paths or d not in (1, -1) for h, d in region.bounds):
            raise reader.wrong("bounds", "pairs of a path of the map and 1 or -1", [*region.bounds])
        if any(not 0 <= i < region.id for i in region.inside):
            raise reader.wrong("inside", "numbers of earlier regions", [*region.inside])
        return region

    def _name(self, value: Any, name: str) -> Name:
        """Read the name of a place, path or region."""
        record = self.mapping(value, name)
        kind = next((kind for kind in NAMED if kind in record), None)
        if kind is None or not isinstance(record.get("name"), str):
            raise self.wrong(name, f"a name, and one of {', '.join(NAMED)}", value)
        return Name(kind, self.integer(record[kind], f"{name}.{kind}"), record["name"])

    def _fit(self, record: Mapping[str, Any], dstates: int) -> Fit | None:
        """Read the fit, with the poses of the dstates; None if there is none."""
        if record.get("fit") is None:
            return None
        numbers = dict.fromkeys(("chi2", "dof", "p", "scale", "bend"), self.number)
        fit = self.record(Fit, record["fit"], "fit", **numbers)
        three: Shape[Any] = self.exactly(3, self.number, "three numbers")
        rows, spreads = (
            self.each(record, name, three, optional=True) for name in ("poses", "spreads")
        )
        for name, listed in (("poses", rows), ("spreads", spreads)):
            if listed and len(listed) != dstates:
                raise self.wrong(name, f"{dstates}, one per dstate", len(listed))
        spreads = spreads or ((0.0, 0.0, 0.0),) * len(rows)
        poses = tuple(
            Pose(x, y, way, spread) for (x, y, way), spread in zip(rows, spreads, strict=True)
        )
        return replace(fit, dof=int(fit.dof), poses=poses)
