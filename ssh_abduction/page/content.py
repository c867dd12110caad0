"""What the page shows, as plain data: the maps, what they share, where they are drawn, and the steps of the trace.

Maps of one trace share most of what they say. So labelings, places and orders of paths are listed once each, and maps name them by their numbers. Where all maps were
laid out one by one, the reader could not see what stays. So a place or dstate of which the map has no drawing of its own is put where its steps are in the first map.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from statistics import fmean, median
from typing import Any, TypeAlias

from ssh_abduction.data.errors import MapError
from ssh_abduction.data.maps import SSHMap, check_of_trace
from ssh_abduction.data.trace import Step, Trace
from ssh_abduction.output.layout import Layout, layout
from ssh_abduction.output.metric_picture import axes
from ssh_abduction.page.images import drawn_images
from ssh_abduction.rivals.comparison import compare
from ssh_abduction.rivals.listing import Listing, Maps

Steps: TypeAlias = tuple[int, ...]
Spot: TypeAlias = tuple[float, float, float | None]

DRAWING = (
    3.0  # seconds of the processor that drawings of other maps than the first may take together
)
DRAWN = (
    10_000  # dstates that all drawings may have together: with more of them the page would be large
)
BELIEVING = (
    5.0  # seconds of the processor that beliefs in other maps than the first may take together
)
BELIEVED = 12  # dstates of a belief that are shown at most
LEAST = 0.01  # of this probability at least
CUT = 0.5  # ellipses of uncertainty with a half axis longer than this share of the map's extent are not drawn: the page would hold little else


@dataclass(frozen=True, slots=True)
class Called:
    """How the commands on the page call what it shows: the file of maps, that of the trace, and the flags of the theory."""

    maps: str = "maps.json"
    trace: str = "TRACE"
    flags: str = ""


@dataclass(frozen=True, slots=True)
class Run:
    """What is replayed with a belief at each step: a run of a robot that is localised in the maps.

    trace    what the robot saw and did; it may be the trace that was mapped
    beliefs  gives for a map the beliefs over its dstates, one for each step of the trace, as `Localiser.beliefs` does, or as dicts of `Belief.to_dict`; None for a map
             in which the robot was not localised
    """

    trace: Trace
    beliefs: Callable[[SSHMap], Iterable[Any] | None] = field(repr=False)


def content_of(
    source: Maps, trace: Trace | None = None, run: Run | None = None, called: Called | None = None
) -> dict[str, Any]:
    """All that the page shows.

    trace   the trace that was mapped: it tells the actions and the images
    run     a run of a robot that is localised in the maps
    called  how the commands on the page call the files

    Raises MapError for maps of several traces, or of another one than this; TraceError for a header that is wrong of the images.
    """
    listing = Listing.of(source)
    called = called or Called()
    if trace is not None:
        check_of_trace(listing.maps, trace, listing.source, views=False)
        check_of_trace(listing.maps[:1], trace, listing.source)
    found = compare(listing)
    maps = [ssh_map.renumbered() for ssh_map in listing.maps]
    labelings, places, orders, faults = _Pool(), _Pool(), _Pool(), _Pool()
    told: list[dict[str, Any]] = []
    for ssh_map, name in zip(maps, found.ids, strict=True):
        one: dict[str, Any] = {
            "id": name,
            "labeling": labelings.number(
                (ssh_map.labels, tuple(str(s.shown) for s in ssh_map.dstates))
            ),
            "places": places.number(tuple((s.place, s.path, s.direction) for s in ssh_map.dstates)),
            "orders": orders.number(tuple((path.id, path.order) for path in ssh_map.paths)),
        }
        if ssh_map.fit:
            one["chi2"] = round(ssh_map.fit.chi2, 1)
        if ssh_map.faults:
            one["faults"] = [faults.number((fault.step, str(fault))) for fault in ssh_map.faults]
            one["cost"] = round(sum(fault.cost for fault in ssh_map.faults), 1)
        told.append(one)
    layouts = _layouts(maps, told, trace)
    drawings = [_numbers(drawn, maps[i]) for i, drawn in layouts]
    spots = _spots(maps[0], layouts[0][1])
    return {
        "sentence": found.sentence,
        "file": called.maps,
        "trace": called.trace,
        "flags": called.flags,
        "minimal": found.minimal,
        "complete": found.complete,
        "shared": _shared(listing),
        "choices": [_choice(choice.to_dict()) for choice in found.choices],
        "replays": _replays(maps, told, trace, run),
        "maps": told,
        "labelings": [{"labels": labels, "views": views} for labels, views in labelings.items],
        "places": _differences(places.items),
        "orders": orders.items,
        "faults": faults.items,
        "layouts": drawings,
        "spots": [
            [round(x, 3), round(y, 3), None if h is None else round(h, 3)] for x, y, h in spots
        ],
        "overview": _overview(maps, spots),
    }


def _shared(listing: Listing) -> dict[str, Any] | None:
    """What is proven of the dstates of all minimal maps, where not all of them are listed."""
    if listing.complete or listing.backbone is None or not listing.backbone.proven:
        return None
    dstates = listing.backbone.dstates
    return None if dstates.untold else {"always": dstates.always, "sometimes": dstates.sometimes}


class _Pool:
    """Different values, in the order in which they were first seen."""

    def __init__(self) -> None:
        self._numbers: dict[Hashable, int] = {}

    def number(self, item: Hashable) -> int:
        return self._numbers.setdefault(item, len(self._numbers))

    @property
    def items(self) -> list[Any]:
        return list(self._numbers)


def _choice(data: dict[str, Any]) -> dict[str, Any]:
    """A choice with the sentences of its questions, and for each option its answers and its maps."""
    return {
        "questions": [question["sentence"] for question in data["questions"]],
        "options": [
            {"answers": option["answers"], "maps": option["maps"]} for option in data["options"]
        ],
    }


def _differences(items: Sequence[Sequence[tuple[Any, Any, Any]]]) -> list[Any]:
    """The place, path and direction of each dstate in each map; after the first one what differs from it alone, as {index: value}, where that is shorter.

    As paths are numbered by first visit, one street more or less gives others another number: `paths` tells what the paths of the first map are mostly called, where that is another name.
    """
    first = items[0]
    told: list[Any] = [first]
    for item in items[1:]:
        called: dict[Any, Counter[Any]] = {}
        for (_, before, _), (_, now, _) in zip(first, item, strict=False):
            called.setdefault(before, Counter())[now] += 1
        names = {
            before: counts.most_common(1)[0][0]
            for before, counts in called.items()
            if before is not None
        }
        expected = [(place, names.get(path, path), direction) for place, path, direction in first]
        differing: dict[str, Any] = {
            str(i): value
            for i, (value, other) in enumerate(zip(item, expected, strict=False))
            if value != other
        }
        if len(item) == len(first) and 2 * len(differing) < len(item):
            renamed = {str(before): now for before, now in names.items() if before != now}
            told.append({**differing, **({"paths": renamed} if renamed else {})})
        else:
            told.append(item)
    return told


def _replays(
    maps: Sequence[SSHMap], told: Sequence[dict[str, Any]], trace: Trace | None, run: Run | None
) -> list[dict[str, Any]]:
    """What the slider replays: the trace that was mapped and, where another one is localised in the maps, that one."""
    first = maps[0]
    if trace is None:
        mapped = {"name": "the trace that was mapped", "steps": _steps_of_map(first)}
    else:
        mapped = _replay(
            trace,
            "the trace that was mapped",
            [str(first.dstates[label].shown) for label in first.labels],
        )
    if run is None:
        return [mapped]
    beliefs = _beliefs(maps, told, run)
    if run.trace == trace:
        return [{**mapped, "beliefs": beliefs}]
    views = ["not known"] * len(run.trace)
    return [
        {
            **_replay(run.trace, f"localised: {run.trace.name or 'another run'}", views),
            "beliefs": beliefs,
            "other": True,
        },
        mapped,
    ]


def _replay(trace: Trace, name: str, views: Sequence[str]) -> dict[str, Any]:
    """The steps of a trace, and its images; the views are those of steps that have none of their own."""
    replay: dict[str, Any] = {
        "name": name,
        "steps": [_step(step, view) for step, view in zip(trace.steps, views, strict=True)],
    }
    images = drawn_images(trace)
    return replay if images is None else {**replay, "images": images}


def _step(step: Step, view: str) -> dict[str, Any]:
    """What was seen at a step, and done next."""
    told: dict[str, Any] = {
        "view": view if step.view is None else str(step.view),
        "action": step.action.name if step.action else None,
    }
    if step.displacement is not None:
        told["moved"] = [round(number, 3) for number in step.displacement]
    if step.confidence is not None:
        told["confidence"] = round(step.confidence, 3)
    if step.gateways is not None:
        told["star"] = [
            [round(gateway.bearing, 1), gateway.open] for gateway in step.gateways.gateways
        ]
    return told


def _steps_of_map(first: SSHMap) -> list[dict[str, Any]]:
    """What was seen at each step, and done next, as far as a map tells it."""
    actions: dict[tuple[int, int], list[str]] = {}
    for s, action, x in first.links:
        actions.setdefault((s, x), []).append(action)
    done = [actions.get(pair, []) for pair in pairwise(first.labels)]
    names = [some[0] if len(some) == 1 else None for some in done]
    views: list[Any] = [first.dstates[label].shown for label in first.labels]
    for fault in first.faults:
        if fault.kind == "misread" and fault.seen is not None:
            views[fault.step] = fault.seen
    return [
        {"view": str(view), "action": action}
        for view, action in zip(views, [*names, None], strict=True)
    ]


def _beliefs(maps: Sequence[SSHMap], told: Sequence[dict[str, Any]], run: Run) -> dict[str, Any]:
    """The beliefs of a run by the number of the labeling: maps that have the same dstates have the same links, and so the same beliefs."""
    found: dict[str, Any] = {}
    end = time.process_time() + BELIEVING
    tried: set[int] = set()
    for ssh_map, one in zip(maps, told, strict=True):
        if one["labeling"] in tried or (tried and time.process_time() > end):
            continue
        tried.add(one["labeling"])
        beliefs = run.beliefs(ssh_map)
        if beliefs is None:
            continue
        listed = [belief if isinstance(belief, dict) else belief.to_dict() for belief in beliefs]
        if len(listed) != len(run.trace):
            raise MapError(
                f"beliefs: expected {len(run.trace)}, one for each step of the run, got {len(listed)}; localise this run"
            )
        found[str(one["labeling"])] = [_belief(belief, len(ssh_map.dstates)) for belief in listed]
    return found


def _belief(belief: dict[str, Any], count: int) -> list[Any]:
    """What a belief comes to, the probability of being nowhere, and the dstates that are most probable. Raises MapError."""
    try:
        likely = sorted(
            ((int(s), float(p)) for s, p in belief["probabilities"]), key=lambda pair: -pair[1]
        )
        verdict, nowhere = str(belief["verdict"]), float(belief["nowhere"])
        if not all(0 <= s < count and 0 <= p <= 1 for s, p in likely) or not 0 <= nowhere <= 1:
            raise ValueError
    except (KeyError, TypeError, ValueError):
        raise MapError(
            f"beliefs: expected verdict, nowhere and probabilities of dstates 0 to {count - 1}, as localise --json prints them, got something else; "
            "localise in these maps again"
        ) from None
    return [
        verdict,
        round(nowhere, 3),
        [[s, round(p, 3)] for s, p in likely[:BELIEVED] if p >= LEAST],
    ]


def _layouts(
    maps: Sequence[SSHMap], told: Sequence[dict[str, Any]], trace: Trace | None
) -> list[tuple[int, Layout]]:
    """The drawings of the first map and, as long as there are time and room, of others that have other dstates or places, each with the number of its map. Maps are told
    the numbers of theirs."""
    layouts: list[tuple[int, Layout]] = []
    drawn: dict[Hashable, int] = {}
    end, room = time.process_time() + DRAWING, DRAWN
    for i, (ssh_map, one) in enumerate(zip(maps, told, strict=True)):
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
    """How far places, or dstates without places, are from the nearest other one, in the middle."""
    points = list(found.places.values()) or [(x, y) for x, y, _ in found.dstates]
    nearest = [
        min((abs(x - u) + abs(y - v) for u, v in points if (u, v) != (x, y)), default=0.0)
        for x, y in points[:200]
    ]
    return median([d for d in nearest if d > 0] or [1.0])


def _numbers(found: Layout, ssh_map: SSHMap) -> dict[str, Any]:
    """A drawing in units of the distance between neighbours."""
    unit = _unit(found)
    return {
        "metric": found.metric,
        "unit": round(unit, 3),
        "places": [
            [p, round(x / unit, 2), round(y / unit, 2)] for p, (x, y) in found.places.items()
        ],
        "dstates": [
            [round(x / unit, 2), round(y / unit, 2), None if h is None else round(h, 2)]
            for x, y, h in found.dstates
        ],
        **({"ellipses": _ellipses(found, ssh_map, unit)} if found.metric else {}),
    }


def _ellipses(found: Layout, ssh_map: SSHMap, unit: float) -> list[list[float]]:
    """How uncertain positions are: for a dstate of each place, or for each dstate without places, its number, the standard deviations along two axes, and the angle of the
    first axis, in radians counterclockwise."""
    assert ssh_map.fit is not None
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
        (major, minor), angle = axes(ssh_map.fit.poses[s.id].spread)
        if 0 < major <= CUT * extent and math.isfinite(angle):
            ellipses.append([s.id, round(major / unit, 3), round(minor / unit, 3), round(angle, 3)])
    return ellipses


def _spots(first: SSHMap, found: Layout) -> list[Spot]:
    """Where each step is drawn: at the place that it is at in the first map, or at its dstate."""
    unit = _unit(found)
    spots: list[Spot] = []
    for label in first.labels:
        x, y, heading = found.dstates[label]
        place = first.dstates[label].place
        if place is not None and place in found.places:
            x, y = found.places[place]
        spots.append((x / unit, y / unit, heading))
    return spots


def _overview(maps: Sequence[SSHMap], spots: Sequence[Spot]) -> dict[str, Any]:
    """All dstates, places and streets that some map has, each with the number of maps that have it. They are the same in two maps where they have the same steps.

    Streets are those that the robot travelled. `path` is how many maps agree, at most, on what is along the path of a dstate or street. Orders of paths where nobody travelled are
    witnesses only, and there may be thousands.
    """
    counts: Counter[tuple[int, int]] = (
        Counter()
    )  # maps that are the same in what is counted here are counted at once
    example: dict[tuple[int, int], SSHMap] = {}
    labelings, placings = _Pool(), _Pool()
    for ssh_map in maps:
        key = (
            labelings.number(ssh_map.labels),
            placings.number(tuple((s.place, s.path) for s in ssh_map.dstates)),
        )
        counts[key] += 1
        example[key] = ssh_map
    dstates: Counter[Steps] = Counter()
    places: Counter[Steps] = Counter()
    streets: Counter[frozenset[Steps]] = Counter()
    along: Counter[tuple[Any, int]] = (
        Counter()
    )  # a dstate or street, and which steps are along its path, by their number
    together = _Pool()
    for key, count in counts.items():
        ssh_map = example[key]
        of_dstate, of_place = (
            _members(ssh_map.labels),
            _members([ssh_map.dstates[label].place for label in ssh_map.labels]),
        )
        of_path = {
            h: together.number(steps)
            for h, steps in _members(
                [ssh_map.dstates[label].path for label in ssh_map.labels]
            ).items()
        }
        for steps in of_dstate.values():
            dstates[steps] += count
            if (h := ssh_map.dstates[ssh_map.labels[steps[0]]].path) is not None:
                along[steps, of_path[h]] += count
        for steps in of_place.values():
            places[steps] += count
        pairs: dict[frozenset[Steps], int | None] = {}
        for a, b in (
            (ssh_map.dstates[s], ssh_map.dstates[x]) for s, x in set(pairwise(ssh_map.labels))
        ):
            if (
                a.place is not None
                and b.place is not None
                and a.place != b.place
                and a.path is not None
                and a.path == b.path
            ):
                pairs[frozenset((of_place[a.place], of_place[b.place]))] = of_path[a.path]
        if not ssh_map.places:
            pairs = {
                frozenset((of_dstate[s], of_dstate[x])): None
                for s, _, x in ssh_map.links
                if s != x and s in of_dstate and x in of_dstate
            }
        for pair, path in pairs.items():
            streets[pair] += count
            if path is not None:
                along[pair, path] += count
    agreed: dict[Any, int] = {}
    for (thing, _), count in along.items():
        agreed[thing] = max(count, agreed.get(thing, 0))
    nodes = list(places) or list(dstates)
    number = {steps: i for i, steps in enumerate(nodes)}
    return {
        "nodes": [
            {"steps": steps, "maps": (places or dstates)[steps], **_middle(steps, spots)}
            for steps in nodes
        ],
        "dstates": [
            {
                "steps": steps,
                "maps": count,
                "path": agreed.get(steps, count),
                **_middle(steps, spots),
            }
            for steps, count in dstates.items()
        ]
        if places
        else [],
        "streets": [
            [*sorted(number[steps] for steps in pair), count, agreed.get(pair, count)]
            for pair, count in streets.items()
            if len(pair) == 2
        ],
    }


def _members(names: Sequence[int | None]) -> dict[int | None, Steps]:
    found: dict[int | None, list[int]] = {}
    for t, name in enumerate(names):
        if name is not None:
            found.setdefault(name, []).append(t)
    return {name: tuple(steps) for name, steps in found.items()}


def _middle(steps: Steps, spots: Sequence[Spot]) -> dict[str, Any]:
    at = list(dict.fromkeys(spots[t][:2] for t in steps))
    return {
        "x": round(fmean(x for x, _ in at), 3),
        "y": round(fmean(y for _, y in at), 3),
        "heading": spots[steps[0]][2],
    }
