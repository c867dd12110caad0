"""Make the content of the page as plain data: maps, what they share, drawings, steps of the trace.

A labeling gives each step its dstate (distinctive state: a place and a heading). Maps of one
trace have much in common. Therefore each labeling, set of places and order of paths is listed once,
and maps refer to it by number. Only some maps have their own drawing. In all others, a place or
dstate is drawn where its steps are in the first map, so that the reader sees what stays the same.

The overview has everything that any map has, and in how many maps it occurs. A street is a line
between two neighbours. Dstates, places and streets of two maps count as the same if they have the
same steps.

The replays are the steps of traces, with images and a localised robot's beliefs. A belief gives the
probability that the robot is at each dstate of a map. Images are laser ranges, all on one scale.
Each number becomes one character, which compresses better than digits. The alphabet has no
character that HTML or JSON would escape.
"""

from __future__ import annotations

import math
import time
import warnings
from collections import Counter, defaultdict
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import count, pairwise
from statistics import fmean
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from perception.errors import PerceptionError
from perception.images import images_held
from ssh_abduction.data.errors import MapError, TraceError, brief, is_finite, named
from ssh_abduction.data.groups import gathered
from ssh_abduction.data.maps import SSHMap, check_of_trace
from ssh_abduction.data.schema import attributes_of
from ssh_abduction.data.trace import Step, Trace
from ssh_abduction.data.words import counted
from ssh_abduction.output.layout import Layout, drawable_poses, layout
from ssh_abduction.output.map_frames import has_frame
from ssh_abduction.output.roads import undecided_places
from ssh_abduction.output.scene import axes
from ssh_abduction.rivals.comparison import Choice, compare
from ssh_abduction.rivals.listing import DrivePair, Listing, Maps, joins_of_drives
from ssh_abduction.solution import probability_in_words

DRAWING = 3.0  # processor seconds for the drawings of all maps except the first
DRAWN = 10_000  # dstates of all drawings together; more would make the page too large
JOINS = 20  # at most this many joins are listed
CUT = 0.5  # the largest standard deviation of an ellipse, as a share of the extent of the map
Steps: TypeAlias = tuple[int, ...]
Spot: TypeAlias = tuple[float, float, float | None]
Pair: TypeAlias = frozenset[Steps]
BELIEVING = 5.0  # processor seconds for beliefs in all maps except the first
# The largest number of dstates of a belief that are shown, and their least probability.
BELIEVED, LEAST = 12, 0.01
ALPHABET = "".join(chr(c) for c in range(35, 127) if chr(c) not in "&<>\\")
LOST = "!"  # a beam that measured nothing
MOST = 100_000  # characters of all images of a page
# The most beams of an image. If FEWEST beams per image are too many for the page, all images are
# left out.
BEAMS, FEWEST = 181, 24
# The longest range that is drawn, as a percentile of all ranges. The longest of all may be that of
# a corridor, which would make all rooms small.
FAR = 95
HALF = 180.0


@dataclass(frozen=True, slots=True)
class Called:
    """File names and flags for the commands that the page shows."""

    maps: str = "maps.json"  # the name of the file of maps
    trace: str = "TRACE"  # the name of the file of the trace
    flags: str = ""  # the flags that choose the theory


@dataclass(frozen=True, slots=True)
class Section:
    """A part of the page below the map, folded at first: sentences, and a table."""

    title: str
    lines: Sequence[str] = field(default=(), repr=False)
    table: Sequence[Sequence[object]] = field(default=(), repr=False)  # the rows, the head first


@dataclass(frozen=True, slots=True)
class Ground:
    """What is known of the log of a map: what the laser saw, and a report."""

    # What `robot_logs.log_ground.ground_of` makes.
    seen: Mapping[str, Any] | None = field(default=None, repr=False)
    sections: Sequence[Section] = field(default=(), repr=False)


def content_of(
    source: Maps,
    trace: Trace | None = None,
    run: Run | None = None,
    called: Called | None = None,
    ground: Ground | None = None,
) -> dict[str, Any]:
    """Make the content of the page as a dict for JSON.

    Actions and images come from the trace, if it is known. `run` is a run of a robot that was
    localised in the maps, to be replayed. `called` has file names and flags for the commands that
    the page shows; None for placeholders. On a `ground`, all maps are drawn over the walls that
    the laser saw: a place is where its visits were. Raises MapError if the maps are not of one
    trace, or not of this one, and TraceError if the header of the trace describes its images
    wrongly.
    """
    listing = Listing.of(source)
    called = called or Called()
    if trace is not None:
        check_of_trace(listing.maps, trace, listing.source, views=False)
        check_of_trace(listing.maps[:1], trace, listing.source)
    found = compare(listing)
    maps = [ssh_map.renumbered() for ssh_map in listing.maps]
    # List what maps share once, and let each map refer to it by number, in the order of first use.
    shared = _SharedParts()
    entries = [_entry(ssh_map, name, shared) for ssh_map, name in zip(maps, found.ids, strict=True)]
    ground = ground or Ground()
    if ground.seen:
        drawings, spots = [], [(x, y, heading) for x, y, heading in ground.seen["spots"]]
    else:
        layouts = _layouts(maps, entries, trace)
        drawings = [_numbers(drawn, maps[i]) for i, drawn in layouts]
        spots = _spots(maps[0], layouts[0][1])
    return {
        **attributes_of(found, "sentence", "minimal", "complete"),
        **attributes_of(listing, "verdict", "sureness", "warnings"),
        "name": listing.drives[0].name if listing.drives else "",
        "joins": _joins(listing),
        **_drives(listing),
        "file": called.maps,
        **attributes_of(called, "trace", "flags"),
        "shared": _shared(listing),
        "choices": [_choice(choice) for choice in found.choices],
        "replays": replays(maps, [one["labeling"] for one in entries], trace, run),
        "maps": entries,
        "labelings": [{"labels": labels, "views": views} for labels, views in shared.labelings],
        "places": list(shared.places),
        "orders": list(shared.orders),
        "faults": list(shared.faults),
        "regions": list(shared.regions),
        "layouts": drawings,
        "spots": [
            [round(x, 3), round(y, 3), None if h is None else round(h, 3)] for x, y, h in spots
        ],
        "overview": overview(maps, spots),
        "ground": ground.seen,
        "indoors": _indoors(maps[0]) if ground.seen else {},
        "has_frame": has_frame(maps[0]),
        "report": [asdict(section) for section in ground.sections],
    }


def _indoors(first: SSHMap) -> dict[str, Any]:
    """The corridors, doors and rooms of the first map, with names, and ellipses of its places."""
    if not drawable_poses(first):
        return {}
    found = layout(first)
    return {
        "corridors": [
            {**_named(first, "corridor", c.id), "path": c.path, "line": c.line}
            for c in first.corridors
        ],
        "rooms": [
            {
                **_named(first, "room", room.id),
                "line": room.outline,
                "places": room.places,
                "bears": bool(room.corridors),
            }
            for room in first.rooms
        ],
        "doors": [{"title": first.called("door", d.id), "at": d.at} for d in first.doors],
        "ellipses": _ellipses(found, first, 1.0),
    }


def _named(first: SSHMap, kind: str, number: int) -> dict[str, Any]:
    """The title of a room or corridor, and whether a person has named it."""
    return {
        "title": first.called(kind, number),
        "named": first.name_of(kind, number) is not None,
    }


class _SharedParts:
    """What maps have in common, each with the number by which maps refer to it."""

    def __init__(self) -> None:
        self.labelings, self.places, self.orders, self.faults, self.regions = (
            defaultdict[Any, int](count().__next__) for _ in range(5)
        )


def _entry(ssh_map: SSHMap, name: str, shared: _SharedParts) -> dict[str, Any]:
    """Make the entry of a map, which refers to what it shares with other maps."""
    views = tuple(str(s.shown) for s in ssh_map.dstates)
    entry: dict[str, Any] = {
        "id": name,
        "labeling": shared.labelings[ssh_map.dstate_at, views],
        "places": shared.places[tuple((s.place, s.path, s.direction) for s in ssh_map.dstates)],
        "orders": shared.orders[tuple((path.id, path.order) for path in ssh_map.theory_paths)],
    }
    if leaps := _leaps(ssh_map):
        entry["leaps"] = leaps
    if passed := undecided_places(ssh_map):
        entry["passed"] = sorted(passed)  # the robot only passed them
    if ssh_map.regions:
        regions = tuple((r.places, r.bounds, r.door) for r in ssh_map.regions)
        entry["regions"] = shared.regions[regions]
    if ssh_map.names:
        entry["names"] = {f"{n.kind} {n.id}": n.text for n in reversed(ssh_map.names)}
    if ssh_map.fit:
        entry["chi2"] = round(ssh_map.fit.chi2, 1)
    if ssh_map.faults:
        entry["faults"] = [shared.faults[f.step, str(f), f.kind] for f in ssh_map.faults]
        entry["cost"] = round(sum(fault.cost for fault in ssh_map.faults), 1)
    return entry


def _leaps(ssh_map: SSHMap) -> list[int]:
    """List the steps that no street leads to: after a slip or a lift, or where a drive starts."""
    floor = [s.floor for s in ssh_map.dstates]
    linked = {(s, x) for s, _, x in ssh_map.links if floor[s] == floor[x]}
    return [t for t, pair in enumerate(pairwise(ssh_map.dstate_at), 1) if pair not in linked]


def _shared(listing: Listing) -> dict[str, Any] | None:
    """The pairs of steps that are proven to be one dstate in all, or in some, minimal maps.

    None if all minimal maps are listed, as the page then finds these pairs itself; and None if
    nothing is proven, or if there are too many pairs.
    """
    if listing.complete or listing.backbone is None or not listing.backbone.proven:
        return None
    dstates = listing.backbone.dstates
    return None if dstates.untold else {"always": dstates.always, "sometimes": dstates.sometimes}


def _joins(listing: Listing) -> list[tuple[int, int, str | None]]:
    """List the joins of the first map that a reader may doubt, the most doubtful ones first.

    Each has two steps and the probability of their join. If probabilities are unknown, the joins
    are those that no axiom and no observation forces, each with None.
    """
    doubtful = listing.weighed.doubtful if listing.weighed else None
    if doubtful is None:
        return [(join.first, join.second, None) for join in listing.by_minimality[:JOINS]]
    return [(i, j, probability_in_words(share)) for i, j, share in doubtful[:JOINS]]


def _drives(listing: Listing) -> dict[str, Any]:
    """The drives of a joint trace, which of them the first map joins, and their common places."""
    first = {drive.name: drive.first for drive in listing.drives}
    return {
        "drives": [asdict(drive) for drive in listing.drives] if len(listing.drives) > 1 else [],
        "joined": listing.joined,
        "between": [
            {
                "sentence": f"{pair.first} and {pair.second}: {_shared_by(pair)}",
                "joins": [
                    (first[pair.first] + j.first, first[pair.second] + j.second, pair.how_sure(j))
                    for j in (*pair.forced, *pair.possible)[:JOINS]
                ],
            }
            for pair in joins_of_drives(listing)
        ],
    }


def _shared_by(pair: DrivePair) -> str:
    """Say how many places two drives share."""
    parts = []
    if pair.forced:
        parts.append(f"{counted(len(pair.forced), f'{pair.of}s')} in common in all maps")
    if pair.possible:
        parts.append(pair.not_forced)
    return "; ".join(parts) or f"no {pair.of} in common in any map"


def _choice(choice: Choice) -> dict[str, Any]:
    """Make a dict of the sentences of a choice's questions, and of its options."""
    options = [attributes_of(option, "answers", "maps") for option in choice.options]
    return {"questions": [str(question) for question in choice.questions], "options": options}


def _layouts(
    maps: Sequence[SSHMap], entries: Sequence[dict[str, Any]], trace: Trace | None
) -> list[tuple[int, Layout]]:
    """Draw the first map and, if time and size allow, the maps with other dstates or places.

    `entries` has a dict for each map. Return a list of drawings, each with the index of its map.
    If a map has a drawing, its entry gets the key `layout`, the index of the drawing in this list.
    """
    layouts: list[tuple[int, Layout]] = []
    drawn: dict[Hashable, int] = {}
    end, room = time.process_time() + DRAWING, DRAWN
    for i, (ssh_map, one) in enumerate(zip(maps, entries, strict=True)):
        key = (one["labeling"], one["places"], one["id"] if ssh_map.fit else None)
        can = (
            time.process_time() < end
            and len(ssh_map.dstates) <= room
            and (ssh_map.places or not maps[0].places)
        )
        if key not in drawn and (not layouts or can):
            drawn[key] = len(layouts)
            room -= len(ssh_map.dstates)
            layouts.append((i, layout(ssh_map, trace)))
        if key in drawn:
            one["layout"] = drawn[key]
    return layouts


def _unit(found: Layout) -> float:
    """Compute the median distance from places, or dstates, to the nearest one."""
    points = {*found.places.values()} or {(x, y) for x, y, _ in found.dstates}
    if len(points) < 2:
        return 1.0
    return float(np.median(cKDTree([*points]).query([*points], 2)[0][:, 1]))


def _numbers(found: Layout, ssh_map: SSHMap) -> dict[str, Any]:
    """Make a dict of a drawing. Positions are in units of the distance between neighbours."""
    unit = _unit(found)

    def at(*numbers: float) -> list[float]:
        return [round(number / unit, 2) for number in numbers]

    drawing: dict[str, Any] = {
        "metric": found.metric,
        "unit": round(unit, 3),
        "places": [[p, *at(*spot)] for p, spot in found.places.items()],
        "dstates": [[*at(x, y), None if h is None else round(h, 2)] for x, y, h in found.dstates],
    }
    if ssh_map.floors:
        # The name of a floor is at its upper left corner.
        xs, ys, _ = zip(*found.dstates, strict=True)
        drawing["floors"] = [
            at(min(xs[s] for s in floor), max(ys[s] for s in floor)) for floor in ssh_map.floors
        ]
        drawing["lifts"] = [
            [*at(*found.places[p], *found.places[q]), ", ".join(sorted(names))]
            for (p, q), names in sorted(_lifts(ssh_map).items())
        ]
    if found.metric:
        drawing["ellipses"] = _ellipses(found, ssh_map, unit)
    return drawing


def _lifts(ssh_map: SSHMap) -> dict[tuple[int, int], set[str]]:
    """Find the names of the actions of the lifts between each two places."""
    actions: dict[tuple[int, int], set[str]] = {}
    for source, action, target in ssh_map.links:
        one, other = ssh_map.dstates[source], ssh_map.dstates[target]
        if one.place is not None and other.place is not None and one.floor != other.floor:
            ends = min(one.place, other.place), max(one.place, other.place)
            actions.setdefault(ends, set()).add(action)
    return actions


def _ellipses(found: Layout, ssh_map: SSHMap, unit: float) -> list[list[float]]:
    """The ellipses of uncertain positions: of the first dstate of each place.

    Each has the position, two standard deviations, and the angle of the first axis in radians
    counterclockwise.
    """
    extent = max(
        max(numbers) - min(numbers)
        for numbers in zip(*((x, y) for x, y, _ in found.dstates), strict=True)
    )
    seen: set[int | None] = set()
    ellipses: list[list[float]] = []
    for s in ssh_map.dstates:
        if s.place is not None and s.place in seen:
            continue
        seen.add(s.place)
        (major, minor), angle = axes(found.spreads[s.id])
        if 0 < major <= CUT * extent and math.isfinite(angle):
            x, y, _ = found.dstates[s.id]
            numbers = x / unit, y / unit, major / unit, minor / unit, angle
            ellipses.append([round(number, 3) for number in numbers])
    return ellipses


def _spots(first: SSHMap, found: Layout) -> list[Spot]:
    """Where each step is drawn: x, y and heading (radians) of its place, or of its dstate."""
    unit = _unit(found)
    spots: list[Spot] = []
    for label in first.dstate_at:
        x, y, heading = found.dstates[label]
        place = first.dstates[label].place
        if place is not None and place in found.places:
            x, y = found.places[place]
        spots.append((x / unit, y / unit, heading))
    return spots


def overview(maps: Sequence[SSHMap], spots: Sequence[Spot]) -> dict[str, Any]:
    """Collect all dstates, places and travelled streets that any map has, for JSON.

    `spots` has the position and heading of each step. In the result, `nodes` are places, or dstates
    if there are no places. `dstates` is empty if there are no places. Each node and dstate has its
    `steps`, position and heading, and `maps`, the number of maps with it. `path` of a dstate is the
    largest number of maps that agree on all steps along its path. `streets` are lists [node, node,
    maps, path].
    """
    # Count the maps that have each dstate, place and street, given by its steps; and those in which
    # a dstate or street is on a path with certain steps.
    dstates, places, streets = Counter[Steps](), Counter[Steps](), Counter[Pair]()
    along = Counter[tuple[Steps | Pair, Steps]]()
    for ssh_map in maps:
        at = [ssh_map.dstates[label] for label in ssh_map.dstate_at]
        of_dstate, of_place, of_path = (
            _members(names)
            for names in (ssh_map.dstate_at, [s.place for s in at], [s.path for s in at])
        )
        dstates.update(of_dstate.values())
        places.update(of_place.values())
        on_path = ((steps, at[steps[0]].path) for steps in of_dstate.values())
        along.update((steps, of_path[h]) for steps, h in on_path if h is not None)
        travelled = _streets(ssh_map, of_place if ssh_map.places else of_dstate)
        streets.update(travelled.keys())
        along.update((pair, of_path[h]) for pair, h in travelled.items() if h is not None)
    agreed: dict[Any, int] = {}
    for (thing, _), maps_with in along.items():
        agreed[thing] = max(maps_with, agreed.get(thing, 0))
    nodes = places or dstates
    number = {steps: i for i, steps in enumerate(nodes)}
    return {
        "nodes": [{"steps": s, "maps": n, **_middle(s, spots)} for s, n in nodes.items()],
        "dstates": [
            {"steps": s, "maps": count, "path": agreed.get(s, count), **_middle(s, spots)}
            for s, count in dstates.items()
            if places
        ],
        "streets": [
            [*sorted(number[steps] for steps in pair), count, agreed.get(pair, count)]
            for pair, count in streets.items()
            if len(pair) == 2
        ],
    }


def _streets(ssh_map: SSHMap, steps_of: Mapping[int | None, Steps]) -> dict[Pair, int | None]:
    """Find the streets that the robot travelled, each with its path; None if there is none.

    It went between two places along one path or, in a map without paths, by any action. In a map
    without places, each link is a street. The order of other places on a path is one of many.
    """
    streets: dict[Pair, int | None] = {}
    for s, _, x in ssh_map.links:
        a, b = ssh_map.dstates[s], ssh_map.dstates[x]
        ends = (a.place, b.place) if ssh_map.places else (s, x)
        is_one_way = not ssh_map.places or (a.path == b.path and a.floor == b.floor)
        if is_one_way and ends[0] != ends[1] and steps_of.keys() >= {*ends}:
            pair = frozenset((steps_of[ends[0]], steps_of[ends[1]]))
            streets[pair] = a.path if ssh_map.places else None
    return streets


def _members(names: Sequence[int | None]) -> dict[int | None, Steps]:
    """For each number, list the steps that have it. Steps with None are left out."""
    found = gathered((name, t) for t, name in enumerate(names) if name is not None)
    return {name: tuple(steps) for name, steps in found.items()}


def _middle(steps: Steps, spots: Sequence[Spot]) -> dict[str, Any]:
    """Compute the mean position of steps as `x` and `y`, with the `heading` of the first step."""
    at = list(dict.fromkeys(spots[t][:2] for t in steps))
    return {
        "x": round(fmean(x for x, _ in at), 3),
        "y": round(fmean(y for _, y in at), 3),
        "heading": spots[steps[0]][2],
    }


@dataclass(frozen=True, slots=True)
class Run:
    """The trace of a robot that is localised in the maps, to be replayed with its beliefs."""

    # The trace of the robot. It may be the trace that was mapped.
    trace: Trace
    # A function that takes a map and returns the belief at each step, as Belief objects. It
    # returns None for a map in which the robot was not localised.
    beliefs: Callable[[SSHMap], Iterable[Any] | None] = field(repr=False)


def replays(
    maps: Sequence[SSHMap], labelings: Sequence[int], trace: Trace | None, run: Run | None
) -> list[dict[str, Any]]:
    """Make the replays for the slider of the page, a dict for each.

    The last one is the trace that was mapped, if known. If `run`, which is localised in the
    maps, has another trace, it comes first. `labelings` has, for each map, the number of its
    labeling (the dstates of all steps).
    """
    first = maps[0]
    name = "the trace that was mapped"
    views = [str(first.dstates[label].shown) for label in first.dstate_at]
    if trace is None:  # nothing but views is known
        mapped = {"name": name, "steps": [{"view": view, "action": None} for view in views]}
    else:
        mapped = _replay(trace, name, views)
    if run is None:
        return [mapped]
    beliefs = _beliefs(maps, labelings, run)
    if run.trace == trace:
        return [{**mapped, "beliefs": beliefs}]
    unknown = ["not known"] * len(run.trace)
    other = _replay(run.trace, f"localised: {run.trace.name or 'another run'}", unknown)
    return [{**other, "beliefs": beliefs, "other": True}, mapped]


def _replay(trace: Trace, name: str, views: Sequence[str]) -> dict[str, Any]:
    """Make the replay of a trace."""
    replay: dict[str, Any] = {
        "name": name,
        "steps": [_step(step, view) for step, view in zip(trace.steps, views, strict=True)],
    }
    images = drawn_images(trace)
    return replay if images is None else {**replay, "images": images}


def _step(step: Step, view: str) -> dict[str, Any]:
    """Make a dict of what was observed at a step, and of the next action."""
    record: dict[str, Any] = {
        "view": view if step.view is None else str(step.view),
        "action": step.action.name if step.action else None,
    }
    if step.displacement is not None:
        record["moved"] = [round(number, 3) for number in step.displacement]
    if step.confidence is not None:
        record["confidence"] = round(step.confidence, 3)
    if step.gateways is not None:
        record["star"] = [
            [round(gateway.bearing, 1), gateway.open] for gateway in step.gateways.gateways
        ]
    return record


def _beliefs(maps: Sequence[SSHMap], labelings: Sequence[int], run: Run) -> dict[str, Any]:
    """Compute the beliefs of a run in the maps, by labeling, as far as there is time.

    Maps with the same labeling have the same links, and therefore the same beliefs. Raises MapError
    if there is not one for each step.
    """
    found: dict[str, Any] = {}
    end = time.process_time() + BELIEVING
    tried: set[int] = set()
    for ssh_map, labeling in zip(maps, labelings, strict=True):
        if labeling in tried or (tried and time.process_time() > end):
            continue
        tried.add(labeling)
        beliefs = run.beliefs(ssh_map)
        if beliefs is None:
            continue
        found[str(labeling)] = listed = [*map(_belief, beliefs)]
        if len(listed) != len(run.trace):
            raise MapError(
                f"beliefs: expected {len(run.trace)}, one for each step of the run, "
                f"got {len(listed)}; localise this run"
            )
    return found


def _belief(belief: Any) -> list[Any]:
    """Shorten a belief to [verdict, nowhere, [[dstate, probability], …]]."""
    shown = [[s, round(p, 3)] for s, p in belief.above(LEAST)[:BELIEVED]]
    return [belief.verdict.value, round(belief.nowhere, 3), shown]


def beams_of(trace: Trace, count: int) -> tuple[float, float]:
    """Find the bearings of a number of laser beams of a trace.

    Return the bearing of the first beam in degrees counterclockwise from straight ahead, and
    the degrees from each beam to the next. The field `beams` of the trace's header gives them;
    TraceError if it is wrong. Without it, the beams cover the half circle ahead from right to
    left, as most scanners do. The first of an odd number of beams points straight to the right.
    The first of an even number is half a beam further to the left.
    """
    beams = trace.extra.get("beams")
    if beams is None:
        usual = HALF / (count - 1) if count % 2 and count > 1 else HALF / count
        return -usual * (count - 1) / 2, usual
    given = beams if isinstance(beams, dict) else {}
    first, step = given.get("first"), given.get("step")
    if not (is_finite(first) and is_finite(step) and step != 0) or (
        abs(step) * (count - 1) > 360 + 1e-6
    ):
        raise TraceError(
            f'{named(trace.source or "trace")}: beams: expected {{"first": degrees, "step": '
            f"degrees}}, counterclockwise from straight ahead, with which {count} beams go round "
            f"once at most, got {brief(beams)}; mend the header, or leave it out"
        )
    return float(first), float(step)


def drawn_images(trace: Trace) -> dict[str, Any] | None:
    """Encode the laser images of a trace.

    Returns:
        A dict with `images`, which has a text or None for each step; `first` and `step` (degrees
        counterclockwise); and `reach` (the metres that the last character of the alphabet means).
        None if the trace has no laser images that can be read, or too many for a page.
    """
    try:
        held = images_held(trace)
    except PerceptionError as error:
        warnings.warn(f"{error}; the page is made without images", stacklevel=2)
        return None
    known = [image for image in held if image is not None]
    if not known or "panorama" in trace.extra:
        return None
    most = max(len(image) for image in known)
    first, step = beams_of(trace, most)
    # Leave out beams until all images fit. If too few would remain, leave out the images.
    every = max(-(-most // BEAMS), -(-most * len(known) // MOST))
    if -(-most // every) < min(FEWEST, most):
        warnings.warn(
            f"{len(known)} images are more than a page holds; the page is made without images",
            stacklevel=2,
        )
        return None
    ranges = np.concatenate([image[np.isfinite(image) & (image > 0)] for image in known])
    reach = float(np.percentile(ranges, FAR)) if len(ranges) else 1.0
    return {
        "first": round(first, 3),
        "step": round(step * every, 4),
        "reach": round(reach, 2),
        "images": [None if image is None else encoded(image[::every] / reach) for image in held],
    }


def encoded(shares: NDArray[np.float64]) -> str:
    """Encode numbers from 0 to 1 as characters. A larger number counts as 1, NaN becomes LOST."""
    last = len(ALPHABET) - 1
    return "".join(
        LOST if math.isnan(x) else ALPHABET[round(last * min(max(x, 0.0), 1.0))]
        for x in shares.tolist()
    )
