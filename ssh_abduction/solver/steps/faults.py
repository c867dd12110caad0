"""Finds the faults and links of a map, from the dstate of each step and from a mended trace."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

from ssh_abduction.data.drives import drives_of, starts_of
from ssh_abduction.data.gateways import changes_in
from ssh_abduction.data.maps import Fault, SSHMap
from ssh_abduction.data.odometry import in_words
from ssh_abduction.data.trace import Trace, View
from ssh_abduction.theory.theory import Theory

COMPASS = ("east", "north", "west", "south")  # counterclockwise; in pictures east is to the right


def faults_of(
    faults: Iterable[tuple[int, str]],
    labels: Mapping[int, int],
    views: Mapping[int, View | None],
    trace: Trace,
    theory: Theory,
) -> tuple[Fault, ...]:
    """Make the faults of a map from pairs of a step and a kind, with the costs of the theory."""
    found = []
    for t, kind in sorted(faults):
        cost = theory.fault_tenths(kind, trace.steps[t]) / 10
        if kind == "misread":
            found.append(Fault(t, "misread", view_at(trace, t), views[labels[t]], cost))
        elif kind == "slipped":
            found.append(Fault(t, "slipped", trace.actions[t].name, cost=cost))
        elif kind == "jumped":
            moved = trace.steps[t].displacement or (0.0, 0.0, 0.0)
            found.append(Fault(t, "jumped", in_words(moved), cost=cost))
        else:
            found.append(Fault(t, "misseen", cost=cost))
    return tuple(found)


def links_of(
    labels: Sequence[int], trace: Trace, faults: Iterable[tuple[int, str]] = ()
) -> tuple[tuple[int, str, int], ...]:
    """List the distinct links (dstate, action, dstate) that labels make, sorted.

    An action that slipped makes no link, nor does the start of a drive. `labels` has the dstate of
    each step. `faults` are pairs of a step and a kind.
    """
    none = {t for t, kind in faults if kind == "slipped"}
    none |= {t for t, action in enumerate(trace.actions) if action.starts}
    links = enumerate(zip(pairwise(labels), trace.actions, strict=False))
    return tuple(sorted({(s, action.name, x) for t, ((s, x), action) in links if t not in none}))


def view_at(trace: Trace, step: int) -> str | int:
    """Return the view at a step that is known to have one."""
    view = trace.steps[step].view
    assert view is not None
    return view


def with_more_faults(ssh_map: SSHMap, faults: Iterable[Fault]) -> SSHMap:
    """Add faults to a map, in the order of their steps."""
    both = sorted((*ssh_map.faults, *faults), key=lambda fault: (fault.step, fault.kind))
    return replace(ssh_map, faults=tuple(both))


def with_changes(ssh_map: SSHMap, trace: Trace, theory: Theory) -> SSHMap | None:
    """Add a fault of kind "changed" to a map for each gateway that differs between drives.

    The map, of the first steps, has the heading of each dstate as a slot. It is returned as it is
    if the theory allows no changes. Returns None if a gateway differs within a drive.
    """
    if not theory.changed:
        return ssh_map
    if theory.star == "gateways":
        return _with_changed_bearings(ssh_map, trace, theory)
    begins = starts_of(trace)
    names = [drive.name for drive in drives_of(trace)]
    last: dict[int | None, tuple[int, tuple[bool, ...]]] = {}  # what was last seen at each place
    faults = []
    for t, label in enumerate(ssh_map.dstate_at):
        drive, s = bisect_right(begins, t), ssh_map.dstates[label]
        openings = trace.steps[t].openings or ()  # ahead, right, back and left
        seen = tuple(openings[(slot - (s.heading or 0)) % 4] for slot in range(len(openings)))
        before, known = last.setdefault(s.place, (drive, seen))
        if seen != known and before == drive:
            return None
        for slot, (was, is_open) in enumerate(zip(known, seen, strict=True)):
            if was != is_open:
                said = [
                    f"{'open' if x else 'closed'} on {names[n]}"
                    for x, n in ((was, before), (is_open, drive))
                ]
                cost = theory.fault_tenths("changed", trace.steps[t]) / 10
                faults.append(Fault(t, "changed", said[1], said[0], cost, s.place, slot))
        last[s.place] = drive, seen
    return replace(ssh_map, faults=tuple(faults))


def _with_changed_bearings(ssh_map: SSHMap, trace: Trace, theory: Theory) -> SSHMap:
    """Add changed gateways as `with_changes` does, for bearings and headings in degrees."""
    names = [drive.name for drive in drives_of(trace)]
    faults = []
    for found in changes_in(trace, ssh_map, theory.axioms):
        was, now = (
            f"{'open' if is_open else 'closed'} on {names[drive]}"
            for drive, is_open in zip(found.drives, (not found.is_open, found.is_open), strict=True)
        )
        cost = theory.fault_tenths("changed", trace.steps[found.step]) / 10
        at = found.place, None, None, found.bearing
        faults.append(Fault(found.step, "changed", now, was, cost, *at))
    return replace(
        ssh_map, faults=tuple(sorted(faults, key=lambda fault: (fault.step, fault.bearing or 0)))
    )


def with_compass(ssh_map: SSHMap) -> SSHMap:
    """Add the compass direction of the gateway to each "changed" fault, if the map has poses.

    A map of several pieces, which have no common frame, is returned as it is.
    """
    if not any(fault.kind == "changed" for fault in ssh_map.faults) or len(ssh_map.pieces) > 1:
        return ssh_map
    poses = ssh_map.fit.poses if ssh_map.fit else ()
    first = {s.place: s for s in reversed(ssh_map.dstates) if poses}
    faults = []
    for fault in ssh_map.faults:
        towards = None
        if fault.gateway is not None and (s := first.get(fault.place)) is not None:
            clockwise = (fault.gateway or 0) - (s.heading or 0)
            quarters = round(poses[s.id].heading / (math.pi / 2)) - clockwise
            towards = COMPASS[quarters % 4]
        faults.append(replace(fault, towards=towards))
    return replace(ssh_map, faults=tuple(faults))


def with_faults(ssh_map: SSHMap, trace: Trace, mended: Trace, theory: Theory) -> SSHMap:
    """Turn a map of a mended trace into a map of the trace itself.

    Each dstate gets the view that most of its steps have, weighted by the cost of a wrong view. It
    is None if all these views are unknown.
    The steps at which the map differs from the trace become its faults.
    """
    votes: dict[int, Counter[View]] = {s.id: Counter() for s in ssh_map.dstates}
    for label, step in zip(ssh_map.dstate_at, trace.steps, strict=True):
        if step.view is not None:
            votes[label][step.view] += theory.fault_tenths("misread", step) or 1
    shows = {
        label: max(counts, key=counts.__getitem__, default=None) for label, counts in votes.items()
    }
    # What the mended trace changed, and views that lost the vote, are faults.
    faults: list[tuple[int, str]] = []
    for t, (step, other) in enumerate(zip(trace.steps, mended.steps, strict=True)):
        if step.view not in (None, shows[ssh_map.dstate_at[t]]):
            faults.append((t, "misread"))
        if theory.star in ("pattern", "frame") and step.openings != other.openings:
            faults.append((t, "misseen"))
        if step.action != other.action:
            faults.append((t, "slipped"))
        if step.displacement != other.displacement:
            faults.append((t, "jumped"))
    named = faults_of(faults, dict(enumerate(ssh_map.dstate_at)), shows, trace, theory)
    dstates = tuple(replace(s, view=shows[s.id]) for s in ssh_map.dstates)
    return replace(
        ssh_map, dstates=dstates, links=links_of(ssh_map.dstate_at, trace, faults), faults=named
    )
