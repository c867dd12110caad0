"""Maps: distinctive states, the links between them, places, and paths with an order of places.

A map is an immutable value. A dstate (distinctive state) is a place and a heading. In maps that
this package finds, dstates, places and paths are numbered by first visit, and direction +1 of a
path is the one that the robot first faced. So two maps of a trace are equal exactly if they are the
same up to renaming.

Equality compares the dstates with their places and paths, the links, and the faults. It does not
compare the orders of paths, the headings, and the excused pairs: these only show that the map is
consistent, and one map may have several of them. Nor does equality compare the fit and the regions,
which follow from the rest and the trace.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

from ssh_abduction.data.building import Corridor, Indoors, MapDoor, MapRoom
from ssh_abduction.data.checks import a_list, a_whole_number, all_instances, an_instance, one_of
from ssh_abduction.data.errors import MapError, brief, is_whole, named
from ssh_abduction.data.files import json_line
from ssh_abduction.data.groups import firsts, gathered, parts
from ssh_abduction.data.map_parts import (
    FAULTS,
    MAP_FORMAT,
    NAMED,
    SOLUTION_FORMAT,
    VERSION,
    DState,
    Fault,
    Fit,
    MapPath,
    Name,
    Pose,
    Region,
    check_format,
    map_fields,
    read_json,
    renumbered,
    right_of,
    write_map,
)
from ssh_abduction.data.schema import attributes_of
from ssh_abduction.data.trace import Trace
from ssh_abduction.data.words import counted
from ssh_abduction.runtime.lazy import card_of

# Other modules import the parts of maps from here, too.
__all__ = ["FAULTS", "DState", "Fault", "Fit", "MapPath", "Name", "Pose", "SSHMap"]

# Hexadecimal digits of a map's id. Among a million maps the chance of two equal ids is 1 in 500.
ID_LENGTH = 12


@dataclass(frozen=True, slots=True)
class SSHMap:
    """A map: one explanation of a trace.

    Attributes:
        dstate_at: The id of the dstate of each step of the trace.
        dstates: The dstates. The index is the id.
        links: For each action tried at a dstate: the id of the dstate, the name of the action, and
            the id of the dstate that the action leads to.
        places: The ids of the places.
        paths: The paths, each with an order of its places.
        excused: The pairs of paths, by id, to which the axiom side_of_branch is not applied. Only
            a theory with boundary=defeasible allows any.
        fit: How well the map agrees with the displacements; None if none were used.
        faults: The parts of the trace that the map treats as wrong, sorted by step.
        regions: Sets of places that directed paths bound, or that one place cuts off; the largest
            first. None if they were not derived (`ssh_abduction.solver.find_regions`).
        names: The names that a person gave to places, paths and regions.
        starts: The steps, besides step 0, at which a drive starts.
        building: The corridors, rooms, doors and junctions of the map of a log; None if they were
            not derived (`ssh_abduction.building.derive.with_building`).
    """

    dstate_at: tuple[int, ...]
    dstates: tuple[DState, ...]
    links: tuple[tuple[int, str, int], ...]
    places: tuple[int, ...] = ()
    paths: tuple[MapPath, ...] = field(default=(), compare=False)
    excused: tuple[tuple[int, int], ...] = field(default=(), compare=False)
    fit: Fit | None = field(default=None, compare=False)
    faults: tuple[Fault, ...] = ()
    regions: tuple[Region, ...] | None = field(default=None, compare=False, repr=False)
    names: tuple[Name, ...] = field(default=(), compare=False)
    starts: tuple[int, ...] = field(default=(), compare=False)
    building: Indoors | None = field(default=None, compare=False, repr=False)

    def __repr__(self) -> str:
        parts = [counted(len(self.dstates), "dstates")]
        if self.places:
            parts.append(counted(len(self.places), "places"))
        if self.paths:
            parts.append(counted(len(self.paths), "paths"))
        if self.faults:
            parts.append(counted(len(self.faults), "faults"))
        return f"<SSHMap: {', '.join(parts)}; {counted(len(self.dstate_at), 'steps')}>"

    @property
    def theory_paths(self) -> tuple[MapPath, ...]:
        """The paths of the theory, without those that were derived from the finished map."""
        return tuple(path for path in self.paths if path.sure is None)

    @property
    def corridors(self) -> tuple[Corridor, ...]:
        """The corridors; empty if none were derived."""
        return self.building.corridors if self.building else ()

    @property
    def rooms(self) -> tuple[MapRoom, ...]:
        """The rooms; empty if none were derived."""
        return self.building.rooms if self.building else ()

    @property
    def doors(self) -> tuple[MapDoor, ...]:
        """The doors; empty if none were derived."""
        return self.building.doors if self.building else ()

    def things(self) -> dict[str, dict[int, tuple[int, ...]]]:
        """The places of all that can be named, by kind and number, without kinds that it lacks."""
        found: dict[str, dict[int, tuple[int, ...]]] = {
            "place": {p: (p,) for p in self.places},
            "path": {path.id: path.order for path in self.paths},
            "region": {region.id: region.places for region in self.regions or ()},
            "corridor": {corridor.id: corridor.order for corridor in self.corridors},
            "room": {room.id: room.places for room in self.rooms},
            "door": {door.id: door.places for door in self.doors},
        }
        return {kind: some for kind, some in found.items() if some}

    @property
    def labels(self) -> tuple[Any, ...]:
        """The id of the dstate of each step: one sequence for each drive if there are several.

        The map of one drive has one flat sequence, which is `dstate_at`.
        """
        if not self.starts:
            return self.dstate_at
        bounds = pairwise([0, *self.starts, len(self.dstate_at)])
        return tuple(self.dstate_at[first:stop] for first, stop in bounds)

    @property
    def id(self) -> str:
        """The id: twelve hexadecimal digits, a digest of all that equality compares.

        Maps that are the same up to renaming have the same id, in every run.
        """
        whole = self.renumbered()
        dstates = [(s.view, s.place, s.path, s.direction) for s in whole.dstates]
        faults = [
            (fault.step, fault.kind, fault.seen, fault.expected, *_changed(fault))
            for fault in whole.faults
        ]
        compared = [whole.dstate_at, dstates, whole.links, whole.places, faults]
        text = json.dumps(compared, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()[:ID_LENGTH]

    def _repr_html_(self) -> str:
        """Return the map as HTML for notebooks: picture, fit, faults and dstates."""
        return card_of(self)

    def place_of(self, step: int) -> int | None:
        """Return the id of the place of a step; None if the map has no places.

        Raises:
            MapError: If the trace has no such step.
        """
        last, mend = len(self.dstate_at) - 1, "name a step of the trace that was mapped"
        a_whole_number("step", step, MapError, 0, last, what="a step", mend=mend)
        return self.dstates[self.dstate_at[step]].place

    def right_of(self, path: int, direction: int) -> tuple[int, ...]:
        """Return the places that are known to lie right of a path in a direction.

        Args:
            path: The id of the path.
            direction: +1 or -1. The places left of the path in +1 lie right of it in -1.

        Raises:
            MapError: The map has no such path or direction, or no regions.
        """
        known = [p.id for p in self.paths]
        if not (is_whole(path) and path in known and is_whole(direction) and abs(direction) == 1):
            raise MapError(
                f"path, direction: expected the id of a path and 1 or -1, got {brief(path)} and "
                f"{brief(direction)}; the map has the paths {brief(known)}"
            )
        if self.regions is None:
            raise MapError(
                "regions: expected a map with regions, got one without; "
                "take ssh_abduction.solver.with_regions(map, trace)"
            )
        return right_of(self.regions, path, direction)

    def name_of(self, kind: str, number: int | None) -> str | None:
        """Return the name that a person gave to a place, path or region; None if it has none.

        Args:
            kind: "place", "path" or "region".
            number: Its number, or None, for which the result is None.

        Raises:
            MapError: `kind` is none of these.
        """
        one_of("kind", kind, NAMED, MapError)
        if number is None:
            return None
        a_whole_number("number", number, MapError, 0)
        return next((n.text for n in self.names if (n.kind, n.id) == (kind, number)), None)

    def called(self, kind: str, number: int) -> str:
        """Return the kind, number and name of a place, path or region: "place 4 (kitchen)".

        Raises:
            MapError: `kind` is not "place", "path" or "region", or `number` is no whole number.
        """
        return f"{kind} {self.numbered(kind, number)}"

    def numbered(self, kind: str, number: int) -> str:
        """Return the number and name of a place, path or region, such as "4 (kitchen)".

        Raises:
            MapError: `kind` is not "place", "path" or "region", or `number` is no whole number.
        """
        name = self.name_of(kind, a_whole_number("number", number, MapError))
        return str(number) if name is None else f"{number} ({name})"

    @property
    def pieces(self) -> tuple[tuple[int, ...], ...]:
        """The ids of the dstates of each piece, in order of first visit.

        Links and common places connect the dstates of a piece. The map of one drive has one piece,
        unless an action slipped. A joint map may have one for each drive.
        """
        at: dict[int, int] = {}  # the first dstate at each place
        pairs = [(s, x) for s, _, x in self.links]
        pairs += [(at.setdefault(s.place, s.id), s.id) for s in self.dstates if s.place is not None]
        ids = sorted(s.id for s in self.dstates)
        return tuple(tuple(sorted(piece)) for piece in parts(ids, pairs))

    @property
    def piece_of(self) -> dict[int, int]:
        """The number of the piece of each dstate."""
        return {s: number for number, piece in enumerate(self.pieces) for s in piece}

    @property
    def floors(self) -> tuple[tuple[int, ...], ...]:
        """The ids of the dstates on each floor, in order of first visit; empty without lifts.

        Travels, turns and common places connect the dstates of a floor. If two drives, or two
        visits by different lifts, share no place of a floor, the map has two floors for it.
        """
        found = gathered((s.floor, s.id) for s in self.dstates if s.floor is not None)
        return tuple(tuple(found[floor]) for floor in sorted(found))

    def without_headings(self) -> SSHMap:
        """Return the same map without headings, for a theory in which places have no frames."""
        return replace(self, dstates=tuple(replace(s, heading=None) for s in self.dstates))

    def renumbered(self) -> SSHMap:
        """Return the same map with dstates, places and paths numbered by first visit.

        Direction +1 of a path becomes the direction that the robot faced when it was first there.
        """
        order = dict.fromkeys([*self.dstate_at, *range(len(self.dstates))])
        visited = [self.dstates[s] for s in order]
        number = {s.id: i for i, s in enumerate(visited)}
        place = _numbered([*(s.place for s in visited), *self.places])
        path = _numbered([*(s.path for s in visited), *(p.id for p in self.paths)])
        floor = _numbered(s.floor for s in visited)
        # the direction in which each path was first faced
        faced = firsts((s.path, s.direction) for s in visited)
        flipped = {h for h, d in faced.items() if d == -1}
        dstates = tuple(
            replace(
                s,
                id=i,
                place=place.get(s.place),
                path=path.get(s.path),
                direction=s.direction and (1 if s.direction == faced[s.path] else -1),
                floor=floor.get(s.floor),
            )
            for i, s in enumerate(visited)
        )
        paths = [_renumbered_path(p, path[p.id], place, p.id in flipped) for p in self.paths]
        fit = self.fit
        if fit and fit.poses:
            fit = replace(fit, poses=tuple(fit.poses[s.id] for s in visited))
        regions, region = renumbered(self.regions or (), place, path, flipped)
        new: dict[str, dict[int | None, int]] = {"place": place, "path": path, "region": region}
        return SSHMap(
            dstate_at=tuple(number[s] for s in self.dstate_at),
            dstates=dstates,
            links=tuple(sorted({(number[s], action, number[x]) for s, action, x in self.links})),
            places=tuple(sorted(place.values())),
            paths=tuple(sorted(paths, key=lambda p: p.id)),
            excused=tuple((path.get(h, h), path.get(g, g)) for h, g in self.excused),
            fit=fit,
            faults=tuple(replace(fault, place=place.get(fault.place)) for fault in self.faults),
            regions=None if self.regions is None else regions,
            names=tuple(replace(n, id=new.get(n.kind, {}).get(n.id, n.id)) for n in self.names),
            starts=self.starts,
            building=self.building and self.building.renumbered(place, path, number),
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the map as plain data, as `solve --json` prints it (docs/reference/formats.md)."""
        names, optional = DState.__slots__, ("heading", "floor")
        dstates = [
            {n: x for n in names if (x := getattr(s, n)) is not None or n not in optional}
            for s in self.dstates
        ]
        data: dict[str, Any] = {
            "id": self.id,
            "labels": list(self.dstate_at),
            "dstates": dstates,
            **attributes_of(self, "links", "places", "paths"),
        }
        # Fields that most maps lack are written only if they are there.
        more = attributes_of(self, "starts", "pieces", "names", "excused", "faults")
        if len(more["pieces"]) == 1:
            del more["pieces"]
        data |= {name: value for name, value in more.items() if value}
        if self.regions is not None:
            data |= attributes_of(self, "regions")
        if self.building is not None:
            data |= attributes_of(self, "building")
        if self.fit:
            data |= {"fit": self.fit.to_dict()}
            poses = self.fit.poses
            data["poses"] = [[round(x, 4) for x in (p.x, p.y, p.heading)] for p in poses]
            data["spreads"] = [[round(x, 4) for x in p.spread] for p in poses]
        return data

    @classmethod
    def from_dict(cls, data: Any, where: str = "map") -> SSHMap:
        """Make a map from the plain data of `to_dict`.

        Args:
            data: The plain data.
            where: The name of the data in messages.

        Raises:
            MapError: If a field is wrong. The error names the field.
        """
        return cls(**map_fields(data, where))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the map as JSON.

        Raises:
            MapError: If the file cannot be written.
        """
        write_map(path, json_line({"format": MAP_FORMAT, "version": VERSION, **self.to_dict()}))

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> SSHMap:
        """Read a map from a file that `save` wrote.

        Raises:
            MapError: If the file cannot be read or holds something else.
        """
        data = read_json(path)
        if isinstance(data, Mapping) and "maps" in data:
            raise MapError(f"{named(path)}: expected one map, got a solution; take Solution.load")
        (ssh_map,) = maps_of(data, named(path))
        return ssh_map


def _renumbered_path(
    path: MapPath, number: int, place: Mapping[int | None, int], flipped: bool
) -> MapPath:
    """Return a path with new numbers; in the other direction if it is flipped."""
    way = -1 if flipped else 1
    sides = [tuple(sorted(place[q] for q in side)) for side in (path.left, path.right, path.around)]
    order, line = tuple(place[q] for q in path.order[::way]), path.line[::way]
    left, right = sides[:2][::way]
    return replace(path, id=number, order=order, line=line, left=left, right=right, around=sides[2])


def _changed(fault: Fault) -> tuple[int | None, ...]:
    """Return the place and gateway of a fault "changed", as one step may have several such faults.

    Empty for other faults.
    """
    if fault.kind != "changed":
        return ()
    return (fault.place, fault.gateway if fault.bearing is None else fault.bearing)


def _numbered(ids: Iterable[int | None]) -> dict[int | None, int]:
    """Return a dict from ids to the numbers 0, 1, 2, … in order of occurrence. None is left out."""
    return {number: i for i, number in enumerate(dict.fromkeys(x for x in ids if x is not None))}


def checked_map(value: object, name: str = "map") -> SSHMap:
    """Return a value if it is a map, or raise MapError."""
    mend = "take one of solution.maps, or SSHMap.load"
    return an_instance(name, value, SSHMap, MapError, mend=mend)


def checked_maps(values: object) -> tuple[SSHMap, ...]:
    """Return the values of an iterable if all are maps, or raise MapError."""
    mend = "take the maps of a solution, or SSHMap.load"
    return all_instances("maps", values, SSHMap, MapError, mend=mend)


def maps_of(data: Any, where: str) -> list[SSHMap]:
    """Make maps from the JSON of `solve --json` (several maps) or of `SSHMap.save` (one map).

    Raises MapError, which names the field.
    """
    if isinstance(data, Mapping) and "maps" in data:
        check_format(data, SOLUTION_FORMAT, where)
        maps = a_list(f"{where}: maps", data["maps"], MapError, mend="write it with solve --json")
        return [SSHMap.from_dict(m, f"{where}: maps[{i}]") for i, m in enumerate(maps)]
    if isinstance(data, Mapping):
        check_format(data, MAP_FORMAT, where)
    return [SSHMap.from_dict(data, where)]


def check_labels(ssh_map: SSHMap, trace: Trace, where: str) -> None:
    """Raise MapError unless a map, named `where`, has a label for each step of a trace."""
    if len(ssh_map.dstate_at) != len(trace):
        mend = "solve this trace"
        if len(ssh_map.starts) > sum(action.starts for action in trace.actions):
            mend = (
                f"the map is of {len(ssh_map.starts) + 1} drives, so give their joint trace, which "
                "solve --set joint_trace=FILE writes"
            )
        raise MapError(
            f"{where}: labels: expected {len(trace)}, one for each step of the trace, got "
            f"{len(ssh_map.dstate_at)}; {mend}"
        )


def check_of_trace(maps: Iterable[SSHMap], trace: Trace, where: str, *, views: bool = True) -> None:
    """Raise MapError if the dstate of a step has another view than the step.

    Steps with an unknown view or a fault are not checked. Without `views`, no view is compared,
    as some theories let a dstate have several. `where` is the source of the maps.
    """
    for i, ssh_map in enumerate(maps):
        check_labels(ssh_map, trace, f"{where}: maps[{i}]")
        misread = {fault.step for fault in ssh_map.faults}
        for t, (step, label) in enumerate(zip(trace.steps, ssh_map.dstate_at, strict=True)):
            seen, there = step.view, ssh_map.dstates[label].view
            if views and seen is not None and seen != there and t not in misread:
                raise MapError(
                    f"{where}: maps[{i}]: expected view {brief(seen)} at step {t}, as the trace "
                    f"has it, got {brief(there)}; the maps are of another trace"
                )
