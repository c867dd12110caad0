"""Read and write the JSON of maps. See docs/reference/formats.md."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from ssh_abduction.data.checks import a_path
from ssh_abduction.data.errors import MapError, brief, is_writable, named
from ssh_abduction.data.files import HalfCharacter, NotFinite, parse_json, save_file
from ssh_abduction.data.json_fields import FieldReader
from ssh_abduction.data.map_parts import FAULTS, NAMED, DState, Fault, Fit, MapPath, Name, Pose
from ssh_abduction.data.regions import Region

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
    source = "standard input" if path == "-" else named(path)
    try:
        with nullcontext(sys.stdin.buffer) if path == "-" else Path(path).open("rb") as file:
            text = file.read(LARGEST + 1)
        if len(text) > LARGEST:
            raise MapError(
                f"{source}: expected at most {LARGEST // 2**20} MiB, got more; "
                f"list fewer (solve --maps)"
            )
        if not text.strip():
            raise MapError(
                f"{source}: expected JSON, got an empty file; write it with solve --json"
            )
        return parse_json(text.decode("utf-8"))
    except MapError:
        raise
    except OSError as error:
        raise MapError(
            f"{source}: expected a readable file of maps: {error.strerror or error}; check the path"
        ) from None
    except MemoryError:
        raise MapError(
            f"{source}: expected a file of maps that fits into memory, got a larger one; "
            f"list fewer (solve --maps)"
        ) from None
    except json.JSONDecodeError as error:
        raise _broken(error, text, source) from None
    except NotFinite as error:
        raise MapError(
            f"{source}: {error.field or 'value'}: expected a finite number, got {error.text}; "
            f"write it with solve --json"
        ) from None
    except HalfCharacter as error:
        raise MapError(
            f"{source}: expected text, got {error}; write it with solve --json"
        ) from None
    except (UnicodeDecodeError, AttributeError):  # text in another encoding, a closed stream
        raise MapError(
            f"{source}: expected JSON in UTF-8, got something else; write it with solve --json"
        ) from None
    except ValueError as error:
        raise MapError(
            f"{source}: expected JSON, got {error}; write it with solve --json"
        ) from None


def _broken(error: json.JSONDecodeError, text: bytes, source: str) -> MapError:
    """Return the MapError for broken JSON, or for a file that holds a trace or several values."""
    if text.startswith(b'{"format": "ssh-trace"'):
        return MapError(
            f"{source}: expected maps, got a trace; "
            f"name the two files in the other order, or solve it first"
        )
    if error.msg == "Extra data":
        return MapError(
            f"{source}:{error.lineno}: expected one JSON value, got more after it; "
            f"solve prints a line for each of several traces: take one of them"
        )
    return MapError(
        f"{source}:{error.lineno}: expected JSON, got broken JSON at column {error.colno} "
        f"({error.msg}); write it with solve --json"
    )


def check_format(data: Mapping[str, Any], expected: str, where: str) -> None:
    """Raise MapError if the field `format` or `version` of a file has another value."""
    if "format" in data and data["format"] != expected:
        raise MapError(
            f'{where}: format: expected "{expected}", got {brief(data["format"])}; '
            f"write it with solve --json"
        )
    version = data.get("version", VERSION)
    if version != VERSION or isinstance(version, bool):
        raise MapError(
            f"{where}: version: expected {VERSION}, got {brief(version)}; "
            f"read it with the ssh-abduction that wrote it, or solve again"
        )


def map_fields(data: Any, where: str) -> dict[str, Any]:
    """Convert the JSON of a map, as `SSHMap.to_dict` makes it, to the arguments of SSHMap by name.

    Raises MapError, which names the field.
    """
    read = FieldReader(where)
    record = read.mapping(data, "")
    dstates = read.each(record, "dstates", lambda s, name: _dstate(read, s, name))
    places = read.each(record, "places", read.integer, optional=True)
    paths = read.each(record, "paths", lambda p, name: _path(read, p, name), optional=True)
    # Fields refer to dstates, places and paths by their ids, so check these first.
    ids = [s.id for s in dstates]
    if ids != list(range(len(dstates))):
        raise MapError(
            f"{where}: dstates: expected the ids 0, 1, 2, … in this order, got {brief(ids)}; "
            f"renumber them"
        )
    path_ids = tuple(p.id for p in paths)
    used_places = {s.place for s in dstates} | {q for p in paths for q in p.order}
    _check_used(where, "places", places, used_places)
    _check_used(where, "paths", path_ids, {s.path for s in dstates})
    labels = read.each(record, "labels", read.integer)
    if not labels:
        raise read.wrong("labels", "the dstate of each step", [])
    names = read.each(record, "names", lambda x, name: _name(read, x, name), optional=True)
    once = {"places": places, "paths": path_ids, "names": [name.text for name in names]}
    for name, values in once.items():
        if len(set(values)) < len(values):
            raise read.wrong(name, "each once", list(values))
    for i, label in enumerate(labels):
        if not 0 <= label < len(dstates):
            raise MapError(
                f"{where}: labels[{i}]: expected the id of a dstate, got {label}; "
                f"there are {len(dstates)} dstates"
            )
    known = set(ids)
    return {
        "dstate_at": labels,
        "starts": _starts(read, record, len(labels)),
        "dstates": dstates,
        "links": read.each(record, "links", lambda x, name: _link(read, x, known, name)),
        "places": places,
        "paths": paths,
        "excused": read.each(
            record, "excused", lambda pair, name: _pair(read, pair, name), optional=True
        ),
        "faults": read.each(
            record, "faults", lambda x, name: _fault(read, x, len(labels), name), optional=True
        ),
        "fit": _fit(read, record, len(dstates)),
        "regions": _regions(read, record, {*places}, {*path_ids}),
        "names": names,
    }


def _starts(read: FieldReader, record: Mapping[str, Any], steps: int) -> tuple[int, ...]:
    """Convert and check the steps at which drives start, besides step 0."""
    starts = read.each(record, "starts", read.integer, optional=True)
    if list(starts) != sorted({*starts}) or not all(0 < t < steps for t in starts):
        raise read.wrong("starts", f"steps from 1 to {steps - 1} in order", list(starts))
    return starts


def _check_used(where: str, name: str, known: tuple[int, ...], used: set[int | None]) -> None:
    """Check that the map lists every place or path that its dstates and paths refer to."""
    if missing := used - {None, *known}:
        raise MapError(
            f"{where}: {name}: expected every id that is used, "
            f"got none for {brief(sorted(missing, key=str))}; add it"
        )


def _dstate(read: FieldReader, value: Any, name: str) -> DState:
    """Convert and check a dstate. The caller checks that its place and path exist."""
    record = read.mapping(value, name)
    expected = "a text or an integer, or null where it is unknown"
    if "view" not in record:
        raise read.wrong(f"{name}.view", expected, None)
    view = read.view(record["view"], f"{name}.view", expected)
    direction = read.optional(record.get("direction"), f"{name}.direction")
    path = read.optional(record.get("path"), f"{name}.path")
    if direction not in (None, 1, -1) or (direction is None) != (path is None):
        raise read.wrong(
            f"{name}.direction", "1 or -1 where there is a path, null elsewhere", direction
        )
    heading = read.optional(record.get("heading"), f"{name}.heading")
    if heading is not None and not 0 <= heading < 360:
        raise read.wrong(f"{name}.heading", "a slot, 0 to 3, or degrees, 0 to 359", heading)
    place = read.optional(record.get("place"), f"{name}.place")
    floor = read.optional(record.get("floor"), f"{name}.floor")
    if floor is not None and floor < 0:
        raise read.wrong(f"{name}.floor", "the number of a floor, from 0", floor)
    number = read.integer(record.get("id"), f"{name}.id")
    return DState(number, view, place, path, direction, heading, floor)


def _path(read: FieldReader, value: Any, name: str) -> MapPath:
    record = read.mapping(value, name)
    order = read.integers(record.get("order"), f"{name}.order")
    if len(set(order)) < len(order):
        raise read.wrong(f"{name}.order", "each place once", list(order))
    return MapPath(read.integer(record.get("id"), f"{name}.id"), order)


def _link(read: FieldReader, value: Any, ids: set[int], name: str) -> tuple[int, str, int]:
    """Convert and check a link. Its two dstates must be in `ids`."""
    good = (
        isinstance(value, list)
        and len(value) == 3
        and type(value[0]) is type(value[2]) is int
        and isinstance(value[1], str)
    )
    if not good or not is_writable(value[1]) or not {value[0], value[2]} <= ids:
        raise read.wrong(name, "[dstate, action name, dstate]", value)
    return value[0], value[1], value[2]


def _pair(read: FieldReader, value: Any, name: str) -> tuple[int, int]:
    if not isinstance(value, list) or len(value) != 2:
        raise read.wrong(name, "a list of two numbers", value)
    return read.integer(value[0], name), read.integer(value[1], name)


def _fault(read: FieldReader, value: Any, steps: int, name: str) -> Fault:
    """Convert and check a fault. Its step must be less than `steps`."""
    record = read.mapping(value, name)
    if record.get("kind") not in FAULTS:
        raise read.wrong(f"{name}.kind", " or ".join(FAULTS), record.get("kind"))
    step = read.integer(record.get("step"), f"{name}.step")
    if not 0 <= step < steps:
        raise read.wrong(f"{name}.step", f"a step from 0 to {steps - 1}", step)
    seen, expected = (
        read.view(record.get(part), f"{name}.{part}", "a text or an integer")
        for part in ("seen", "expected")
    )
    cost = read.number(record.get("cost", 0), f"{name}.cost")
    place, gateway, bearing = (
        read.optional(record.get(part), f"{name}.{part}")
        for part in ("place", "gateway", "bearing")
    )
    if record["kind"] == "changed":
        if bearing is None and (place is None or gateway not in (0, 1, 2, 3)):
            what = "a slot, 0 to 3, and a place, for a change"
            raise read.wrong(f"{name}.gateway", what, gateway)
        if bearing is not None and (place is None or not 0 <= bearing < 360):
            what = "degrees, 0 to 359, and a place, for a change"
            raise read.wrong(f"{name}.bearing", what, bearing)
    towards = record.get("towards")
    if not isinstance(towards, str | None):
        raise read.wrong(f"{name}.towards", "a text", towards)
    return Fault(step, record["kind"], seen, expected, cost, place, gateway, towards, bearing)


def _regions(
    read: FieldReader, record: Mapping[str, Any], places: set[int], paths: set[int]
) -> tuple[Region, ...] | None:
    """Convert and check the regions of a map; None if the file, of an early version, has none."""
    if record.get("regions") is None:
        return None
    return read.each(record, "regions", lambda r, name: _region(read, r, name, places, paths))


def _region(read: FieldReader, value: Any, name: str, places: set[int], paths: set[int]) -> Region:
    """Convert and check a region. Its places and paths must be those of the map."""
    data = read.mapping(value, name)
    number = int(name.removeprefix("regions[").removesuffix("]"))
    if data.get("id") != number:
        raise read.wrong(f"{name}.id", f"{number}, its number in the list", data.get("id"))
    inner = FieldReader(f"{read.where}: {name}")
    within = inner.each(data, "places", inner.integer)
    bounds = inner.each(data, "bounds", lambda x, part: _pair(inner, x, part), optional=True)
    inside = inner.each(data, "inside", inner.integer, optional=True)
    door = inner.optional(data.get("door"), "door")
    if not within or not {*within, *(() if door is None else (door,))} <= places:
        raise inner.wrong("places", "some places of the map", [*within, door])
    if any(h not in paths or d not in (1, -1) for h, d in bounds):
        raise inner.wrong("bounds", "pairs of a path of the map and 1 or -1", [*bounds])
    if any(not 0 <= i < number for i in inside):
        raise inner.wrong("inside", "numbers of earlier regions", [*inside])
    return Region(number, within, bounds, door, inside)


def _name(read: FieldReader, value: Any, name: str) -> Name:
    """Convert and check the name of a place, path or region."""
    record = read.mapping(value, name)
    kind = next((kind for kind in NAMED if kind in record), None)
    if kind is None or not isinstance(record.get("name"), str):
        raise read.wrong(name, f"a name, and one of {', '.join(NAMED)}", value)
    return Name(kind, read.integer(record[kind], f"{name}.{kind}"), record["name"])


def _fit(read: FieldReader, record: Mapping[str, Any], dstates: int) -> Fit | None:
    """Convert and check the fit of a map, with the poses of its dstates; None if there is none."""
    if record.get("fit") is None:
        return None
    found = read.mapping(record["fit"], "fit")
    chi2, dof, p, scale, bend = (
        read.number(found.get(name, 0), f"fit.{name}")
        for name in ("chi2", "dof", "p", "scale", "bend")
    )
    rows = read.each(record, "poses", read.numbers, optional=True)
    spreads = read.each(record, "spreads", read.numbers, optional=True)
    for name, listed in (("poses", rows), ("spreads", spreads)):
        if listed and len(listed) != dstates:
            raise read.wrong(name, f"{dstates}, one per dstate", len(listed))
    spreads = spreads or ((0.0, 0.0, 0.0),) * len(rows)
    poses = tuple(Pose(*row, spread) for row, spread in zip(rows, spreads, strict=True))
    return Fit(chi2, int(dof), p, scale, bend, poses)
