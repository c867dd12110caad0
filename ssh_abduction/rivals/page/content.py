"""What the page shows, as plain data: the maps, what they share, where they are drawn, and the steps of the trace.

Maps of one trace share most of what they say. So labelings, places and orders of paths are listed once each, and maps name them by their numbers. Where all maps were
laid out one by one, the reader could not see what stays. So a place or dstate of which the map has no drawing of its own is put where its steps are in the first map.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Hashable, Iterable, Sequence
from itertools import pairwise
from statistics import fmean, median
from typing import Any, TypeAlias

from ssh_abduction.layout import Layout, layout
from ssh_abduction.maps import SSHMap, check_of_trace
from ssh_abduction.rivals.compare import compare
from ssh_abduction.rivals.listing import Listing, Maps
from ssh_abduction.trace import Trace

Steps: TypeAlias = tuple[int, ...]
Spot: TypeAlias = tuple[float, float, float | None]

DRAWING = 3.0  # seconds that drawings of other maps than the first may take together
BEAMS = 90  # beams of an image that are shown at most
FINEST = 99  # the ranges of an image are shown in so many steps


def content_of(source: Maps, trace: Trace | None = None, *, name: str = "maps.json", trace_name: str = "TRACE") -> dict[str, Any]:
    """All that the page shows.

    trace       the trace that was mapped: it tells the actions and the laser images
    name        of the file of maps, as the commands on the page call it
    trace_name  of the file of the trace

    Raises MapError for maps of several traces, or of another one than this.
    """
    listing = Listing.of(source)
    if trace is not None:
        check_of_trace(listing.maps, trace, listing.source, views=False)
        check_of_trace(listing.maps[:1], trace, listing.source)
    found = compare(listing)
    maps = [ssh_map.renumbered() for ssh_map in listing.maps]
    labelings, places, orders = _Pool(), _Pool(), _Pool()
    told: list[dict[str, Any]] = []
    for ssh_map in maps:
        one: dict[str, Any] = {
            "id": ssh_map.id,
            "labeling": labelings.number((ssh_map.labels, tuple(str(s.view) for s in ssh_map.dstates))),
            "places": places.number(tuple((s.place, s.path, s.direction) for s in ssh_map.dstates)),
            "orders": orders.number(tuple((path.id, path.order) for path in ssh_map.paths)),
        }
        if ssh_map.fit:
            one["chi2"] = round(ssh_map.fit.chi2, 1)
        if ssh_map.faults:
            one["faults"] = [[fault.step, str(fault)] for fault in ssh_map.faults]
        told.append(one)
    layouts = _layouts(maps, told, trace)
    spots = _spots(maps[0], layouts[0])
    return {
        "sentence": found.sentence,
        "file": name,
        "trace": trace_name,
        "minimal": found.minimal,
        "complete": found.complete,
        "choices": [_choice(choice.to_dict()) for choice in found.choices],
        "steps": _steps(maps[0], trace),
        "maps": told,
        "labelings": [{"labels": labels, "views": views} for labels, views in labelings.items],
        "places": _differences(places.items),
        "orders": orders.items,
        "links": _links(maps[0]) if not maps[0].places else [],
        "layouts": [_numbers(found) for found in layouts],
        "spots": [[round(x, 3), round(y, 3), None if h is None else round(h, 3)] for x, y, h in spots],
        "overview": _overview(maps, spots),
    }


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
        "options": [{"answers": option["answers"], "maps": option["maps"]} for option in data["options"]],
    }


def _differences(items: Sequence[Sequence[Any]]) -> list[Any]:
    """Each item; after the first one what differs from it alone, as {index: value}, where it is as long and that is shorter."""
    told: list[Any] = []
    for item in items:
        differing = {str(i): value for i, (value, first) in enumerate(zip(item, items[0], strict=False)) if value != first}
        told.append(differing if told and len(item) == len(items[0]) and 2 * len(differing) < len(item) else item)
    return told


def _steps(first: SSHMap, trace: Trace | None) -> list[dict[str, Any]]:
    """What was seen at each step, and done next."""
    if trace is None:
        actions: dict[tuple[int, int], list[str]] = {}
        for s, action, x in first.links:
            actions.setdefault((s, x), []).append(action)
        done = [actions.get(pair, []) for pair in pairwise(first.labels)]
        names = [some[0] if len(some) == 1 else None for some in done]
        views: list[Any] = [first.dstates[label].view for label in first.labels]
        for fault in first.faults:
            if fault.kind == "misread" and fault.seen is not None:
                views[fault.step] = fault.seen
        return [{"view": str(view), "action": action} for view, action in zip(views, [*names, None], strict=True)]
    steps = []
    for t, step in enumerate(trace.steps):
        view = first.dstates[first.labels[t]].view if step.view is None else step.view
        one: dict[str, Any] = {"view": str(view), "action": step.action.name if step.action else None}
        if isinstance(step.image, tuple):
            one["image"] = _image(step.image)
        steps.append(one)
    return steps


def _image(ranges: Iterable[float]) -> list[int]:
    """Some of the ranges of an image, as parts of the longest one that is finite."""
    known = [float(r) for r in ranges]
    longest = max((r for r in known if 0 < r < float("inf")), default=1.0)
    every = -(-len(known) // BEAMS)
    return [min(FINEST, max(0, round(FINEST * min(r, longest) / longest))) if r == r else 0 for r in known[::every]]  # noqa: PLR0124 - NaN


def _layouts(maps: Sequence[SSHMap], told: Sequence[dict[str, Any]], trace: Trace | None) -> list[Layout]:
    """The drawings of the first map and, as long as there is time, of others that have other dstates or places. Maps are told the numbers of theirs."""
    layouts: list[Layout] = []
    drawn: dict[Hashable, int] = {}
    end = time.monotonic() + DRAWING
    for ssh_map, one in zip(maps, told, strict=True):
        key = (one["labeling"], one["places"], ssh_map.id if ssh_map.fit else None)
        if key not in drawn and (not layouts or (time.monotonic() < end and (ssh_map.places or not maps[0].places))):
            drawn[key] = len(layouts)
            layouts.append(layout(ssh_map, trace))
        if key in drawn:
            one["layout"] = drawn[key]
    return layouts


def _unit(found: Layout) -> float:
    """How far places, or dstates without places, are from the nearest other one, in the middle."""
    points = list(found.places.values()) or [(x, y) for x, y, _ in found.dstates]
    nearest = [min((abs(x - u) + abs(y - v) for u, v in points if (u, v) != (x, y)), default=0.0) for x, y in points[:200]]
    return median([d for d in nearest if d > 0] or [1.0])


def _numbers(found: Layout) -> dict[str, Any]:
    """A drawing in units of the distance between neighbours."""
    unit = _unit(found)
    return {
        "metric": found.metric,
        "unit": round(unit, 3),
        "places": [[p, round(x / unit, 3), round(y / unit, 3)] for p, (x, y) in found.places.items()],
        "dstates": [[round(x / unit, 3), round(y / unit, 3), None if h is None else round(h, 3)] for x, y, h in found.dstates],
    }


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


def _links(ssh_map: SSHMap) -> list[list[Any]]:
    return [[s, action, x] for s, action, x in ssh_map.links]


def _overview(maps: Sequence[SSHMap], spots: Sequence[Spot]) -> dict[str, Any]:
    """All dstates, places and streets that some map has, each with the number of maps that have it. They are the same in two maps where they have the same steps."""
    dstates: Counter[Steps] = Counter()
    places: Counter[Steps] = Counter()
    streets: Counter[frozenset[Steps]] = Counter()
    for ssh_map in maps:
        of_dstate, of_place = _members(ssh_map.labels), _members([ssh_map.dstates[label].place for label in ssh_map.labels])
        dstates.update(of_dstate.values())
        places.update(of_place.values())
        pairs = {
            frozenset((of_place[p], of_place[q]))
            for path in ssh_map.paths
            for p, q in pairwise(path.order)
            if p in of_place and q in of_place
        }
        if not ssh_map.places:
            pairs = {frozenset((of_dstate[s], of_dstate[x])) for s, _, x in ssh_map.links if s != x}
        streets.update(pairs)
    nodes = list(places) or list(dstates)
    number = {steps: i for i, steps in enumerate(nodes)}
    return {
        "nodes": [{"steps": steps, "maps": (places or dstates)[steps], **_middle(steps, spots)} for steps in nodes],
        "dstates": [{"steps": steps, "maps": count, **_middle(steps, spots)} for steps, count in dstates.items()] if places else [],
        "streets": [[*sorted(number[steps] for steps in pair), count] for pair, count in streets.items() if len(pair) == 2],
    }


def _members(names: Sequence[int | None]) -> dict[int | None, Steps]:
    found: dict[int | None, list[int]] = {}
    for t, name in enumerate(names):
        if name is not None:
            found.setdefault(name, []).append(t)
    return {name: tuple(steps) for name, steps in found.items()}


def _middle(steps: Steps, spots: Sequence[Spot]) -> dict[str, Any]:
    at = list(dict.fromkeys(spots[t][:2] for t in steps))
    return {"x": round(fmean(x for x, _ in at), 3), "y": round(fmean(y for _, y in at), 3), "heading": spots[steps[0]][2]}
