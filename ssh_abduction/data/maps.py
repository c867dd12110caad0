"""Maps: distinctive states, the links between them, places, and paths with the order of their places.

Maps are values. Their dstates, places and paths are numbered by first visit, and the direction +1 of a path is the one in which it was
first faced. So two maps of one trace are the same map, up to renaming, exactly when they are equal. Equality compares the
dstates, their places and courses, and the links. It does not compare the orders of paths, the headings and the excused pairs: these are
witnesses, which show that the map is consistent, and others may show it as well.
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from ssh_abduction.data.checks import a_path, a_text, all_instances, an_instance
from ssh_abduction.data.errors import (
    MapError,
    brief,
    is_finite,
    is_whole,
    is_writable,
    named,
)
from ssh_abduction.data.files import HalfCharacter, NotFinite, json_line, parse_json, write_file
from ssh_abduction.data.notebook import in_output
from ssh_abduction.data.trace import Trace, View
from ssh_abduction.data.words import counted

# What files of solutions and of single maps begin with.
SOLUTION_FORMAT, MAP_FORMAT, VERSION = "ssh-solution", "ssh-map", 1
# Bytes that a file of maps may have: some hundred thousand maps. To read it takes ten times as much memory.
LARGEST = 2**30
# Methods of version 0.1.0 that are functions of `ssh_abduction.output` now.
MOVED = ("plot", "to_dot", "to_graphml", "to_networkx", "to_pandas", "to_svg")


@dataclass(frozen=True, slots=True)
class DState:
    """A distinctive state: a position and a heading that hill-climbing brings the robot to.

    view         None where the view of each step at it is unknown
    place, path  None where the theory has none, or the dstate is along no path
    direction    +1 or -1: the way that the dstate faces along its path
    heading      with star=frame the slot (0 to 3, clockwise) of the frame of its place that it faces; with star=gateways degrees (0 to 359), clockwise from the
                 heading of the first dstate at its place
    """

    id: int
    view: View | None
    place: int | None = None
    path: int | None = None
    direction: int | None = None
    heading: int | None = field(default=None, compare=False)

    @property
    def shown(self) -> View:
        """The view as people read it: ? where it is unknown."""
        return "?" if self.view is None else self.view


@dataclass(frozen=True, slots=True)
class Pose:
    """Where a dstate is, as seen from the dstate of the first step.

    x, y     metres; x ahead of the first dstate, y to its left
    heading  radians, counterclockwise
    spread   the covariance of x and y, as (xx, xy, yy), in square metres
    """

    x: float
    y: float
    heading: float
    spread: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Fit:
    """How well a map agrees with the displacements of its trace.

    chi2   sum of the squared differences, each divided by its standard deviation
    dof    degrees of freedom: what chi2 is about, where the map is true and the noise is as the odometry says
    p      the probability of so large a chi2 or a larger one
    scale  by which share the displacements are too long
    bend   by how many radians a metre the heading drifts
    poses  of the dstates, by id
    """

    chi2: float
    dof: int
    p: float
    scale: float = 0.0
    bend: float = 0.0
    poses: tuple[Pose, ...] = field(default=(), repr=False)

    def to_dict(self) -> dict[str, float]:
        return {
            name: round(getattr(self, name), 6) for name in ("chi2", "dof", "p", "scale", "bend")
        }


@dataclass(frozen=True, slots=True)
class MapPath:
    """A path: its places in the order in which direction +1 meets them. With path_order=partial this is one of the orders that the map allows."""

    id: int
    order: tuple[int, ...]


FAULTS = ("misread", "misseen", "slipped", "jumped")
# So many hexadecimal digits name a map: among a million maps two of one name have a chance of one in five hundred.
ID_LENGTH = 12


@dataclass(frozen=True, slots=True)
class Fault:
    """What a map disbelieves at a step.

    step      the step
    kind      misread: the view at this step is not that of its dstate; misseen: its star is not; slipped: the action done there did not do what its
              name says, so that nothing links this step and the next one; jumped: the displacement from the step before to this one is wrong altogether
    seen      the view, None for a star; the name of the action; or the displacement, in words
    expected  the view of the dstate; None for all else
    cost      what it costs, in dstates
    """

    step: int
    kind: Literal["misread", "misseen", "slipped", "jumped"]
    seen: View | None = None
    expected: View | None = None
    cost: float = field(default=0.0, compare=False)

    def __str__(self) -> str:
        if self.kind == "misread":
            return f"the view at step {self.step} is misread: {self.seen}, expected {self.expected}"
        if self.kind == "misseen":
            return f"the star at step {self.step} is misread"
        if self.kind == "jumped":
            return f"the displacement that leads to step {self.step} is wrong: {self.seen}"
        return f"the action at step {self.step} slipped: {self.seen}"


@dataclass(frozen=True, slots=True)
class SSHMap:
    """One explanation of a trace.

    labels   the dstate of each step
    links    (dstate, action name, dstate) for each action tried in each dstate
    excused  pairs of paths that the default side_of_branch is not applied to (boundary=defeasible only)
    fit      how well it agrees with the displacements, where the trace has some and they are used
    faults   what the map disbelieves, by step, where the theory allows faults
    """

    labels: tuple[int, ...]
    dstates: tuple[DState, ...]
    links: tuple[tuple[int, str, int], ...]
    places: tuple[int, ...] = ()
    paths: tuple[MapPath, ...] = field(default=(), compare=False)
    excused: tuple[tuple[int, int], ...] = field(default=(), compare=False)
    fit: Fit | None = field(default=None, compare=False)
    faults: tuple[Fault, ...] = ()

    def __repr__(self) -> str:
        parts = [counted(len(self.dstates), "dstates")]
        parts += (
            [counted(len(self.places), "places"), counted(len(self.paths), "paths")]
            if self.places
            else []
        )
        parts += [counted(len(self.faults), "faults")] if self.faults else []
        return f"<SSHMap: {', '.join(parts)}; {counted(len(self.labels), 'steps')}>"

    @property
    def id(self) -> str:
        """The map in twelve hexadecimal digits, the same in each run and whatever its dstates, places and paths are numbered like: a digest of what equality compares."""
        return hashlib.sha256(
            json.dumps(self._compared(), separators=(",", ":")).encode()
        ).hexdigest()[:ID_LENGTH]

    def _compared(self) -> list[Any]:
        """What equality compares, as plain data."""
        whole = self.renumbered()
        dstates = [(s.view, s.place, s.path, s.direction) for s in whole.dstates]
        faults = [(fault.step, fault.kind, fault.seen, fault.expected) for fault in whole.faults]
        return [whole.labels, dstates, whole.links, whole.places, faults]

    def _repr_html_(self) -> str:
        """The map for notebooks: picture, fit, faults and dstates."""
        card: str = in_output("map_card")(self)
        return card

    if not TYPE_CHECKING:  # so that type checkers still refuse unknown attributes

        def __getattr__(self, name):
            """Find a method of version 0.1.0 that is a function of `ssh_abduction.output` now."""
            if name not in MOVED:
                raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
            warnings.warn(
                f"SSHMap.{name} is deprecated; use ssh_abduction.output.{name}",
                DeprecationWarning,
                stacklevel=2,
            )
            return partial(in_output(name), self)

    def without_headings(self) -> SSHMap:
        """The same map for a theory in which places have no frames."""
        return replace(self, dstates=tuple(replace(s, heading=None) for s in self.dstates))

    def renumbered(self) -> SSHMap:
        """The same map with dstates, places and paths numbered by first visit, so that maps which are the same up to renaming become equal."""
        visited = [
            self.dstates[s] for s in dict.fromkeys([*self.labels, *range(len(self.dstates))])
        ]
        number = {s.id: i for i, s in enumerate(visited)}
        place = _numbered([*(s.place for s in visited), *self.places])
        path = _numbered([*(s.path for s in visited), *(p.id for p in self.paths)])
        faced: dict[int | None, int | None] = {}  # the direction in which each path was first faced
        for s in visited:
            faced.setdefault(s.path, s.direction)
        dstates = tuple(
            DState(
                number[s.id],
                s.view,
                place.get(s.place),
                path.get(s.path),
                None if s.direction is None else 1 if s.direction == faced[s.path] else -1,
                s.heading,
            )
            for s in visited
        )
        return SSHMap(
            labels=tuple(number[s] for s in self.labels),
            dstates=dstates,
            links=tuple(sorted({(number[s], action, number[x]) for s, action, x in self.links})),
            places=tuple(sorted(place.values())),
            paths=tuple(
                MapPath(
                    path[p.id],
                    tuple(
                        place[q] for q in (p.order if faced.get(p.id, 1) != -1 else p.order[::-1])
                    ),
                )
                for p in sorted(self.paths, key=lambda p: path[p.id])
            ),
            excused=tuple((path.get(h, h), path.get(g, g)) for h, g in self.excused),
            fit=self.fit
            and replace(
                self.fit,
                poses=tuple(self.fit.poses[s.id] for s in visited) if self.fit.poses else (),
            ),
            faults=self.faults,
        )

    def to_dict(self) -> dict[str, Any]:
        """The map as plain data, as `solve --json` prints it (docs/formats.md)."""
        data: dict[str, Any] = {
            "id": self.id,
            "labels": list(self.labels),
            "dstates": [
                {
                    "id": s.id,
                    "view": s.view,
                    "place": s.place,
                    "path": s.path,
                    "direction": s.direction,
                    **({} if s.heading is None else {"heading": s.heading}),
                }
                for s in self.dstates
            ],
            "links": [list(link) for link in self.links],
            "places": list(self.places),
            "paths": [{"id": p.id, "order": list(p.order)} for p in self.paths],
        }
        if self.excused:
            data["excused"] = [list(pair) for pair in self.excused]
        if self.faults:
            data["faults"] = [
                {k: v for k, v in asdict(fault).items() if v is not None} for fault in self.faults
            ]
        if self.fit:
            data["fit"] = self.fit.to_dict()
            data["poses"] = [
                [round(x, 4) for x in (pose.x, pose.y, pose.heading)] for pose in self.fit.poses
            ]
            data["spreads"] = [[round(x, 4) for x in pose.spread] for pose in self.fit.poses]
        return data

    @classmethod
    def from_dict(cls, data: Any, where: str = "map") -> SSHMap:
        """The map that `to_dict` wrote. Raises MapError with the field that is wrong."""
        read = FieldReader(where)
        record = read.mapping(data, "")
        dstates = tuple(
            read.dstate(s, f"dstates[{i}]") for i, s in enumerate(read.list(record, "dstates"))
        )
        ids = {s.id for s in dstates}
        places = tuple(
            read.integer(p, f"places[{i}]")
            for i, p in enumerate(read.list(record, "places", optional=True))
        )
        paths = tuple(
            read.path(p, f"paths[{i}]")
            for i, p in enumerate(read.list(record, "paths", optional=True))
        )
        if [s.id for s in dstates] != list(range(len(dstates))):
            raise MapError(
                f"{where}: dstates: expected the ids 0, 1, 2, … in this order, got {brief([s.id for s in dstates])}; renumber them"
            )
        for name, known, used in (
            (
                "places",
                set(places),
                {s.place for s in dstates} | {q for p in paths for q in p.order},
            ),
            ("paths", {p.id for p in paths}, {s.path for s in dstates}),
        ):
            if missing := used - known - {None}:
                raise MapError(
                    f"{where}: {name}: expected every id that is used, got none for {brief(sorted(missing, key=str))}; add it"
                )
        labels = tuple(
            read.integer(x, f"labels[{i}]") for i, x in enumerate(read.list(record, "labels"))
        )
        if not labels:
            raise read.wrong("labels", "the dstate of each step", [])
        for name, numbers in (("places", places), ("paths", tuple(p.id for p in paths))):
            if len(set(numbers)) < len(numbers):
                raise read.wrong(name, "each id once", list(numbers))
        for i, label in enumerate(labels):
            if label not in ids:
                raise MapError(
                    f"{where}: labels[{i}]: expected the id of a dstate, got {label}; there are {len(dstates)} dstates"
                )
        links = tuple(
            read.link(x, ids, f"links[{i}]") for i, x in enumerate(read.list(record, "links"))
        )
        excused = tuple(
            read.pair(x, f"excused[{i}]")
            for i, x in enumerate(read.list(record, "excused", optional=True))
        )
        faults = tuple(
            read.fault(x, len(labels), f"faults[{i}]")
            for i, x in enumerate(read.list(record, "faults", optional=True))
        )
        return cls(
            labels, dstates, links, places, paths, excused, read.fit(record, len(dstates)), faults
        )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the map as JSON. Raises MapError."""
        write_map(path, json_line({"format": MAP_FORMAT, "version": VERSION, **self.to_dict()}))

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> SSHMap:
        """The map that `save` wrote. Raises MapError."""
        data = read_json(path)
        if isinstance(data, Mapping) and "maps" in data:
            raise MapError(f"{named(path)}: expected one map, got a solution; take Solution.load")
        (ssh_map,) = maps_of(data, named(path))
        return ssh_map

    def place_of(self, step: int) -> int | None:
        """The place that the robot was at in a step; None where the map has no places. Raises MapError where the trace has no such step."""
        if not is_whole(step) or not 0 <= step < len(self.labels):
            raise MapError(
                f"step: expected 0 to {len(self.labels) - 1}, got {brief(step)}; name a step of the trace that was mapped"
            )
        return self.dstates[self.labels[step]].place


def checked_map(value: object, name: str = "map") -> SSHMap:
    """The map that a caller gives. Raises MapError."""
    return an_instance(
        name, value, SSHMap, MapError, mend="take one of solution.maps, or SSHMap.load"
    )


def checked_maps(values: object) -> tuple[SSHMap, ...]:
    """The maps that a caller gives. Raises MapError."""
    return all_instances(
        "maps", values, SSHMap, MapError, mend="take the maps of a solution, or SSHMap.load"
    )


def write_map(
    path: str | os.PathLike[str], text: str, what: str = "map", option: str = "output"
) -> None:
    """Write a map, or what is made of it, into a file. Raises MapError.

    what    is written, as messages call it
    option  by which the file was named
    """
    path = a_path("path" if option == "output" else option, path, MapError)
    try:
        write_file(path, f"{text}\n".encode())
    except OSError as error:
        raise MapError(
            f"{named(path)}: cannot write the {what}: {error.strerror or error}; check the folder"
        ) from None
    except ValueError as error:
        raise MapError(f"{option}: cannot write the {what}: {error}; name a file") from None


def _numbered(ids: Iterable[int | None]) -> dict[int | None, int]:
    """The ids with the numbers 0, 1, 2, … in the order in which they come."""
    return {number: i for i, number in enumerate(dict.fromkeys(x for x in ids if x is not None))}


def read_json(path: str | os.PathLike[str]) -> Any:
    """The JSON value in a file. Raises MapError that names the file and the line."""
    path = a_path("path", path, MapError)
    source = "standard input" if path == "-" else named(path)
    try:
        text = sys.stdin.buffer.read(LARGEST + 1) if path == "-" else _read_at_most(path, LARGEST)
        if len(text) > LARGEST:
            raise MapError(
                f"{source}: expected at most {LARGEST // 2**20} MiB, got more; list fewer (solve --maps)"
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
            f"{source}: expected a file of maps that fits into memory, got a larger one; list fewer (solve --maps)"
        ) from None
    except json.JSONDecodeError as error:
        if text.startswith(b'{"format": "ssh-trace"'):
            raise MapError(
                f"{source}: expected maps, got a trace; name the two files in the other order, or solve it first"
            ) from None
        if error.msg == "Extra data":
            mend = "solve prints a line for each of several traces: take one of them"
            raise MapError(
                f"{source}:{error.lineno}: expected one JSON value, got more after it; {mend}"
            ) from None
        raise MapError(
            f"{source}:{error.lineno}: expected JSON, got broken JSON at column {error.colno} ({error.msg}); write it with solve --json"
        ) from None
    except NotFinite as error:
        raise MapError(
            f"{source}: {error.field or 'value'}: expected a finite number, got {error.text}; write it with solve --json"
        ) from None
    except HalfCharacter as error:
        raise MapError(f"{source}: expected text, got {error}") from None
    except (UnicodeDecodeError, AttributeError):  # other text, a closed stream
        raise MapError(
            f"{source}: expected JSON in UTF-8, got something else; write it with solve --json"
        ) from None
    except ValueError as error:
        raise MapError(
            f"{source}: expected JSON, got {error}; write it with solve --json"
        ) from None


def _read_at_most(path: str | os.PathLike[str], most: int) -> bytes:
    with Path(path).open("rb") as file:
        return file.read(most + 1)


def maps_of(data: Any, where: str) -> list[SSHMap]:
    """The maps in the JSON of `solve --json`, or the one map in the JSON of `SSHMap.save`. Raises MapError."""
    if isinstance(data, Mapping) and "maps" in data:
        check_format(data, SOLUTION_FORMAT, where)
        if not isinstance(data["maps"], list):
            raise MapError(
                f"{where}: maps: expected a list, got {brief(data['maps'])}; write it with solve --json"
            )
        return [SSHMap.from_dict(m, f"{where}: maps[{i}]") for i, m in enumerate(data["maps"])]
    if isinstance(data, Mapping):
        check_format(data, MAP_FORMAT, where)
    return [SSHMap.from_dict(data, where)]


def check_format(data: Mapping[str, Any], expected: str, where: str) -> None:
    """Whether JSON is of the format and the version that this program writes; files of before these were written say neither. Raises MapError."""
    if "format" in data and data["format"] != expected:
        raise MapError(
            f'{where}: format: expected "{expected}", got {brief(data["format"])}; write it with solve --json'
        )
    version = data.get("version", VERSION)
    if version != VERSION or isinstance(version, bool):
        raise MapError(
            f"{where}: version: expected {VERSION}, got {brief(version)}; read it with the ssh-abduction that wrote it, or solve again"
        )


def check_of_trace(maps: Iterable[SSHMap], trace: Trace, where: str, *, views: bool = True) -> None:
    """Whether maps are of a trace: they label each of its steps, with a dstate of the view that was seen there, or say that it was misread. Raises MapError.

    where  how messages call what the maps are from
    views  whether views are compared: not where the theory lets dstates have several
    """
    for i, ssh_map in enumerate(maps):
        if len(ssh_map.labels) != len(trace):
            raise MapError(
                f"{where}: maps[{i}].labels: expected {len(trace)}, one for each step of the trace, got {len(ssh_map.labels)}; the maps are of another trace"
            )
        misread = {fault.step for fault in ssh_map.faults}
        for t, (step, label) in enumerate(zip(trace.steps, ssh_map.labels, strict=True)):
            seen, there = step.view, ssh_map.dstates[label].view
            if views and seen is not None and seen != there and t not in misread:
                raise MapError(
                    f"{where}: maps[{i}]: expected view {brief(seen)} at step {t}, as the trace has it, got {brief(there)}; the maps are of another trace"
                )


class FieldReader:
    """Checks the fields of what was read, and says which one is wrong."""

    def __init__(self, where: str) -> None:
        self.where = a_text("where", where, MapError)

    def wrong(self, name: str, expected: str, value: Any) -> MapError:
        return MapError(
            f"{self.where}: {name or 'map'}: expected {expected}, got {brief(value)}; write it with solve --json"
        )

    def mapping(self, value: Any, name: str) -> Mapping[str, Any]:
        if not isinstance(value, Mapping):
            raise self.wrong(name, "an object", value)
        return value

    def list(self, record: Mapping[str, Any], name: str, optional: bool = False) -> list[Any]:
        value = record.get(name, [] if optional else None)
        if not isinstance(value, list):
            raise self.wrong(name, "a list", value)
        return value

    def integer(self, value: Any, name: str) -> int:
        if isinstance(value, bool) or not isinstance(value, int):
            raise self.wrong(name, "an integer", value)
        return value

    def optional(self, value: Any, name: str) -> int | None:
        return None if value is None else self.integer(value, name)

    def dstate(self, value: Any, name: str) -> DState:
        record = self.mapping(value, name)
        view = record.get("view")
        if (
            "view" not in record
            or isinstance(view, bool)
            or not isinstance(view, str | int | None)
            or (isinstance(view, str) and not is_writable(view))
        ):
            raise self.wrong(
                f"{name}.view", "a text or an integer, or null where it is unknown", view
            )
        direction = self.optional(record.get("direction"), f"{name}.direction")
        path = self.optional(record.get("path"), f"{name}.path")
        if direction not in (None, 1, -1) or (direction is None) != (path is None):
            raise self.wrong(
                f"{name}.direction", "1 or -1 where there is a path, null elsewhere", direction
            )
        heading = self.optional(record.get("heading"), f"{name}.heading")
        if heading is not None and not 0 <= heading < 360:
            raise self.wrong(f"{name}.heading", "a slot, 0 to 3, or degrees, 0 to 359", heading)
        return DState(
            self.integer(record.get("id"), f"{name}.id"),
            view,
            self.optional(record.get("place"), f"{name}.place"),
            path,
            direction,
            heading,
        )

    def path(self, value: Any, name: str) -> MapPath:
        record = self.mapping(value, name)
        order = tuple(
            self.integer(p, f"{name}.order[{i}]") for i, p in enumerate(self.list(record, "order"))
        )
        if len(set(order)) < len(order):
            raise self.wrong(f"{name}.order", "each place once", list(order))
        return MapPath(self.integer(record.get("id"), f"{name}.id"), order)

    def link(self, value: Any, ids: set[int], name: str) -> tuple[int, str, int]:
        good = (
            isinstance(value, list)
            and len(value) == 3
            and type(value[0]) is type(value[2]) is int
            and isinstance(value[1], str)
        )
        if not good or not is_writable(value[1]) or not {value[0], value[2]} <= ids:
            raise self.wrong(name, "[dstate, action name, dstate]", value)
        return value[0], value[1], value[2]

    def fault(self, value: Any, steps: int, name: str) -> Fault:
        record = self.mapping(value, name)
        if record.get("kind") not in FAULTS:
            raise self.wrong(f"{name}.kind", " or ".join(FAULTS), record.get("kind"))
        step = self.integer(record.get("step"), f"{name}.step")
        if not 0 <= step < steps:
            raise self.wrong(f"{name}.step", f"a step from 0 to {steps - 1}", step)
        for part in ("seen", "expected"):
            view = record.get(part)
            if (
                isinstance(view, bool)
                or not isinstance(view, str | int | None)
                or (isinstance(view, str) and not is_writable(view))
            ):
                raise self.wrong(f"{name}.{part}", "a text or an integer", view)
        return Fault(
            step,
            record["kind"],
            record.get("seen"),
            record.get("expected"),
            self.number(record.get("cost", 0), f"{name}.cost"),
        )

    def fit(self, record: Mapping[str, Any], dstates: int) -> Fit | None:
        if record.get("fit") is None:
            return None
        found = self.mapping(record["fit"], "fit")
        chi2, dof, p, scale, bend = (
            self.number(found.get(name, 0), f"fit.{name}")
            for name in ("chi2", "dof", "p", "scale", "bend")
        )
        rows = [
            self.numbers(row, f"poses[{i}]")
            for i, row in enumerate(self.list(record, "poses", optional=True))
        ]
        spreads = [
            self.numbers(row, f"spreads[{i}]")
            for i, row in enumerate(self.list(record, "spreads", optional=True))
        ]
        for name, listed in (("poses", rows), ("spreads", spreads)):
            if listed and len(listed) != dstates:
                raise self.wrong(name, f"{dstates}, one a dstate", len(listed))
        poses = tuple(
            Pose(*row, spread)
            for row, spread in zip(rows, spreads or [(0.0, 0.0, 0.0)] * len(rows), strict=True)
        )
        return Fit(chi2, int(dof), p, scale, bend, poses)

    def number(self, value: Any, name: str) -> float:
        if not is_finite(value):
            raise self.wrong(name, "a finite number", value)
        return float(value)

    def numbers(self, value: Any, name: str) -> tuple[float, float, float]:
        if not isinstance(value, list) or len(value) != 3:
            raise self.wrong(name, "three numbers", value)
        x, y, z = (self.number(number, name) for number in value)
        return x, y, z

    def pair(self, value: Any, name: str) -> tuple[int, int]:
        if not (isinstance(value, list) and len(value) == 2):
            raise self.wrong(name, "a list of two numbers", value)
        return self.integer(value[0], name), self.integer(value[1], name)
