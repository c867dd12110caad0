"""Floors: which parts of a map lifts and stairs connect.

A *stretch* is the steps of a drive between two lifts. All steps of a stretch are on one floor. Two
stretches with a dstate or a place in common are on one floor.

>>> from ssh_abduction import Trace, solve
>>> from ssh_abduction.data import Action
>>> up = Action("up", "lift")
>>> trace = Trace.from_steps("abab", ["travel", up, "travel"])
>>> stretches_of(trace)
(0, 0, 2, 2)
>>> solve(trace).maps[0].floors
((0, 1), (2, 3))
"""

from __future__ import annotations

from dataclasses import replace
from itertools import accumulate

from ssh_abduction.data.drives import frames_of
from ssh_abduction.data.groups import NodeClasses
from ssh_abduction.data.maps import SSHMap, checked_map
from ssh_abduction.data.trace import Trace, checked_trace
from ssh_abduction.data.words import counted


def stretches_of(trace: Trace) -> tuple[int, ...]:
    """Return for each step the first step of its stretch."""
    begins = set(frames_of(trace))
    return tuple(accumulate(range(len(trace)), lambda last, t: t if t in begins else last))


def floors_in_words(ssh_map: SSHMap) -> str:
    """Say how many floors a map has, and how large they are. Empty if the trace has no lifts."""
    floors = checked_map(ssh_map).floors
    at = [{ssh_map.dstates[s].place for s in floor} - {None} for floor in floors]
    what = "places" if ssh_map.places else "dstates"
    sizes = map(len, at if ssh_map.places else floors)
    listed = ", ".join(f"floor {i} with {counted(size, what)}" for i, size in enumerate(sizes))
    return f"the map has {counted(len(floors), 'floors')}: {listed}" if floors else ""


def with_floors(ssh_map: SSHMap, trace: Trace) -> SSHMap:
    """Return a map with the floor of each dstate, numbered by first visit.

    Without lifts in the trace, the map is returned as it is.
    """
    if not any(action.changes_floor for action in checked_trace(trace).actions):
        return ssh_map
    stretches = stretches_of(trace)
    floor = NodeClasses[int]()
    first: dict[tuple[str, int], int] = {}  # the first stretch at each dstate and place
    for label, stretch in zip(checked_map(ssh_map).dstate_at, stretches, strict=False):
        place = ssh_map.dstates[label].place
        for spot in (("dstate", label), *(() if place is None else (("place", place),))):
            floor.merge(first.setdefault(spot, stretch), stretch)
    number: dict[int, int] = {}
    found: dict[int, int] = {}
    for label, stretch in zip(ssh_map.dstate_at, stretches, strict=False):
        found.setdefault(label, number.setdefault(floor.of(stretch), len(number)))
    return replace(
        ssh_map, dstates=tuple(replace(s, floor=found.get(s.id)) for s in ssh_map.dstates)
    )
