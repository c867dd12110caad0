"""Several drives through one building, as one trace.

A *joint trace* has the steps of several drives, one drive after the other. The last step of each
drive but the last has an action of kind "start", which is named after the next drive. It is no
action of the robot: nothing is known of how the first step of a drive relates to any step of
another drive.

>>> from ssh_abduction import Trace
>>> monday = Trace.from_steps("ab", ["travel"], name="monday")
>>> tuesday = Trace.from_steps("ba", ["travel"], name="tuesday")
>>> joint = together([monday, tuesday])
>>> joint.views, starts_of(joint), [drive.name for drive in drives_of(joint)]
(('a', 'b', 'b', 'a'), (2,), ['monday', 'tuesday'])

Lifts and stairs divide a drive. A *stretch* is the steps of a drive between two lifts. All steps
of a stretch are on one floor. Two stretches with a dstate or a place in common are on one floor.

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

import hashlib
import math
import os
import shlex
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import accumulate, chain, count, pairwise
from pathlib import Path
from statistics import median
from typing import overload

from ssh_abduction.data.checks import a_list, a_text, all_instances
from ssh_abduction.data.errors import TraceError, brief, checked_index
from ssh_abduction.data.files import json_line
from ssh_abduction.data.groups import NodeClasses, gathered
from ssh_abduction.data.maps import SSHMap, checked_map
from ssh_abduction.data.odometry import Odometry
from ssh_abduction.data.schema import SparseData
from ssh_abduction.data.star import is_four
from ssh_abduction.data.step import Action, Step
from ssh_abduction.data.trace import Trace, checked_trace, images_file
from ssh_abduction.data.words import counted, meant

# The fields of a step that its fingerprint covers. Covariances are left out, as `together` adds
# them if drives differ in their odometry.
_MARKED = frozenset({"view", "action", "star", "displacement", "confidence"})
# In one building, the median travels of two drives hardly differ by this factor. Millimetres and
# centimetres are 1000 and 100 to the metre.
UNITS = 30.0
ALONE = "drive 1"  # the name of the only drive of a trace without a name


@dataclass(frozen=True, slots=True)
class Drive(SparseData):
    """A drive of a trace: the steps from `first` up to, but not including, `stop`.

    Attributes:
        name: The name of the drive.
        first: Its first step.
        stop: The step after its last one.
        fingerprint: A digest of its steps, in solutions that were read from a file; else None.
    """

    name: str
    first: int
    stop: int
    fingerprint: str | None = field(default=None, compare=False)


class DriveStep(int):
    """The number of a step in a joint trace. Its text is the drive and the step of this drive.

    >>> step = DriveStep(14, "tuesday", 9)
    >>> f"step {step}", step + 1
    ('step tuesday:5', 15)
    """

    def __new__(cls, number: int, drive: str = "", first: int = 0) -> DriveStep:
        step = super().__new__(cls, number)
        step.drive, step.first = drive, first
        return step

    drive: str  # the name of the drive
    first: int  # the number of its first step

    def __str__(self) -> str:
        return f"{self.drive}:{self - self.first}"

    def __format__(self, form: str) -> str:
        return format(str(self), form)


def drive_of_steps(drives: Sequence[Drive]) -> list[int]:
    """Return, for each step of a joint trace, the index of its drive."""
    return [i for i, drive in enumerate(drives) for _ in range(drive.first, drive.stop)]


def named_steps(drives: Sequence[Drive], steps: int) -> Sequence[int]:
    """Return the numbers of all steps, or names such as "tuesday:14" for several drives."""
    if len(drives) < 2:
        return range(steps)
    return tuple(DriveStep(t, d.name, d.first) for d in drives for t in range(d.first, d.stop))


def starts_of(trace: Trace) -> tuple[int, ...]:
    """List the steps, besides step 0, at which a drive starts."""
    return tuple(t for t, action in enumerate(checked_trace(trace).actions, 1) if action.starts)


def frames_of(trace: Trace) -> tuple[int, ...]:
    """List the steps, besides step 0, at which a drive or a stretch after a lift begins.

    Each has a frame of its own.
    """
    actions = checked_trace(trace).actions
    return tuple(t for t, action in enumerate(actions, 1) if action.breaks_frame)


def drives_of(trace: Trace) -> tuple[Drive, ...]:
    """List the drives of a trace, in order. Most traces have one."""
    starts = starts_of(trace)
    names = [_name(trace) or ALONE, *(trace.actions[t - 1].name for t in starts)]
    bounds = pairwise([0, *starts, len(trace)])
    return tuple(Drive(name, *bound) for name, bound in zip(names, bounds, strict=True))


def fingerprints_of(trace: Trace) -> dict[str, str]:
    """Return a digest of the steps of each drive, 16 hexadecimal digits, by the drive's name.

    It does not depend on the other drives of a joint trace, nor on corrections of stars.
    """
    return {name: _fingerprint(steps) for name, steps in _recorded(trace)}


def with_fingerprints(trace: Trace) -> tuple[Drive, ...]:
    """List the drives of a trace, each with its fingerprint."""
    found = fingerprints_of(trace)
    return tuple(replace(drive, fingerprint=found[drive.name]) for drive in drives_of(trace))


def _fingerprint(steps: Sequence[Step]) -> str:
    """Return a digest, of 16 hexadecimal digits, of what the robot did and saw."""
    marked = ({k: v for k, v in step.to_json().items() if k in _MARKED} for step in steps)
    return hashlib.sha256("\n".join(map(json_line, marked)).encode()).hexdigest()[:16]


def step_named(trace: Trace, name: str) -> int:
    """Return the number of a step, such as "14" or "step14", or "tuesday:14" for that of a drive.

    Steps count from 0, in the trace or in the drive. Raises TraceError.
    """
    return step_of(drives_of(trace), name)


def step_of(drives: Sequence[Drive], name: str) -> int:
    """Return the number of a step of some drives, as `step_named`. Raises TraceError."""
    a_text("name", name, TraceError)
    drive_name, colon, number = name.rpartition(":")
    number = number if colon else number.removeprefix("step").strip()
    by_name = {drive.name: drive for drive in drives}
    drive = by_name.get(drive_name) if colon else Drive("", 0, drives[-1].stop)
    if drive is None:
        raise TraceError(
            f"step {brief(name)}: expected a drive out of {', '.join(by_name)}, got "
            f"{brief(drive_name)}; name one, such as {next(iter(by_name))}:0"
            f"{meant(drive_name, by_name)}"
        )
    steps = drive.stop - drive.first
    if not colon and not number.isdecimal():
        raise TraceError(
            f"step {brief(name)}: expected a step such as {typed_step(drives, 0)}, got "
            f"{brief(name)}; name a step, or a drive and a step"
        )
    if not (number.isascii() and number.isdecimal()) or int(number) >= steps:
        raise TraceError(
            f"step {brief(name)}: expected 0 to {steps - 1}, got {brief(number)}"
            "; take a step of this drive"
        )
    return drive.first + int(number)


def step_name(drives: Sequence[Drive], step: int) -> str:
    """Return the name of a step, such as "tuesday:14". This inverts `step_of`."""
    drive = next(drive for drive in drives if step < drive.stop)
    return f"{drive.name}:{step - drive.first}"


def typed_step(drives: Sequence[Drive], step: int) -> str:
    """Return a step as a person types it: "step14" if the only drive has a name to be quoted."""
    name = step_name(drives, step)
    return name if len(drives) > 1 or shlex.quote(name) == name else f"step{step}"


def with_named_faults(ssh_map: SSHMap, drives: Sequence[Drive]) -> SSHMap:
    """Return a map whose faults name steps by their drives, if there are several drives."""
    if not ssh_map.faults or len(drives) < 2:
        return ssh_map
    steps = named_steps(drives, len(ssh_map.dstate_at))
    return replace(ssh_map, faults=tuple(replace(f, step=steps[f.step]) for f in ssh_map.faults))


def joined_drives(drives: Sequence[Drive], ssh_map: SSHMap) -> tuple[tuple[str, ...], ...]:
    """Group the names of drives that a map joins: their steps are in one piece of the map."""
    piece_of = ssh_map.piece_of
    classes = NodeClasses[tuple[str, int]]()
    for k, drive in enumerate(drives):
        for label in {*ssh_map.dstate_at[drive.first : drive.stop]}:
            classes.merge(("piece", piece_of[label]), ("drive", k))
    groups = gathered((classes.of(("drive", k)), drive.name) for k, drive in enumerate(drives))
    return tuple(map(tuple, groups.values()))


def pieces_in_words(drives: Sequence[Drive], ssh_map: SSHMap) -> str:
    """Say which drives a map joins, in words. Empty for a single drive."""
    groups = joined_drives(drives, ssh_map)
    if len(drives) < 2:
        return ""
    if len(groups) == 1:
        return f"the map joins the {len(drives)} drives: {', '.join(groups[0])}"
    pieces = "; ".join(", ".join(names) + (" alone" if len(names) == 1 else "") for names in groups)
    return f"the map is in {len(groups)} pieces that share no place: {pieces}"


def together(traces: Iterable[Trace], names: Iterable[str] | None = None) -> Trace:
    """Join several traces of one building to one trace, with a drive for each.

    Args:
        traces: The traces. The drives of a joint trace stay drives.
        names: The names of the drives. By default these are the names of the traces, or of their
            files, or "drive 1", "drive 2" and so on. A name that comes again gets a number.

    Returns:
        The joint trace. Nothing is known of how its drives relate to each other.

    Raises:
        TraceError: There is no trace; two of the `names` are equal; or the traces differ in what
            they record, such as stars, displacements, the systematic errors of the odometry, or
            the kind of an action.
    """
    parts = all_instances(
        "traces", traces, Trace, TraceError, mend="make one with Trace.load or Trace.from_steps"
    )
    if not parts:
        raise TraceError("traces: expected at least one trace, got none; give the traces to join")
    called = _names(parts, names)
    _check_alike(parts, called)
    # Traces with different noise models get the covariance of each step, as a trace has one model.
    if len({model for trace in parts if (model := _odometry(trace))}) > 1:
        parts = tuple(map(_with_covariances, parts))
    drives = [trace.steps[d.first : d.stop] for trace in parts for d in drives_of(trace)]
    if len(drives) == 1:
        return parts[0]
    for doubts in (_repeats, _other_names, _other_units, _other_views):
        for doubt in doubts(parts):
            warnings.warn(doubt, stacklevel=2)
    begins = accumulate([0, *map(len, parts[:-1])])
    closures = [
        replace(closure, first=begin + closure.first, last=begin + closure.last)
        for begin, trace in zip(begins, parts, strict=True)
        for closure in trace.closures
    ]
    return Trace(
        tuple(_joined_steps(called, drives)),
        name=" + ".join(called),
        images=next((images for trace in parts if (images := _sidecar(trace))), None),
        odometry=next((trace.odometry for trace in parts if trace.odometry), None),
        drive=called[0],
        closures=tuple(closures),
        extra={k: v for k, v in parts[0].extra.items() if all(t.extra.get(k) == v for t in parts)},
    )


def _joined_steps(names: Sequence[str], drives: Sequence[Sequence[Step]]) -> list[Step]:
    """Join the steps of drives. An action with the name of a drive leads to its first step."""
    steps: list[Step] = []
    for name, drive in zip(names, drives, strict=True):
        if steps:
            steps[-1] = replace(steps[-1], action=Action(name, "start"))
        begin = len(steps)
        for step in drive:
            slipped = step.action is not None and step.action.slipped
            other = Action.that_slipped(len(steps)) if slipped else step.action
            steps.append(replace(step, action=other) if slipped else step)
        steps[begin] = replace(steps[begin], displacement=None, covariance=None)
    return steps


def _name(trace: Trace) -> str | None:
    """Return the name of the first drive of a trace; None if neither it nor its file has one."""
    return trace.drive or trace.name or (trace.source and Path(trace.source).stem)


def _names(traces: Sequence[Trace], names: Iterable[str] | None) -> list[str]:
    """Return the names of all drives, or raise TraceError if two are the same."""
    if names is None:
        found: list[str] = []
        for trace in traces:
            for name, _ in _recorded(trace):
                own = name if _name(trace) else f"drive {len(found) + 1}"
                again = (f"{own}-{number}" for number in count(2))
                found.append(next(one for one in chain([own], again) if one not in found))
    else:
        found = [
            a_text(f"names[{i}]", name, TraceError, mend="name the drive")
            for i, name in enumerate(a_list("names", names, TraceError))
        ]
        drives = sum(len(drives_of(trace)) for trace in traces)
        if len(found) != drives:
            raise TraceError(
                f"names: expected {drives}, one per drive, got {len(found)}; name each drive"
            )
    twice = next((name for name, times in Counter(found).items() if times > 1 or not name), None)
    if twice is not None:
        raise TraceError(
            f"names: expected a different name for each drive, got {brief(twice)} twice; "
            "rename a trace or its file, or give names"
        )
    return found


def _recorded(trace: Trace) -> Iterator[tuple[str, tuple[Step, ...]]]:
    """Yield the name and steps of each drive, as recorded, without truth and images of views."""
    seen = (step.as_seen() for step in trace.steps)
    bare = [replace(s, truth=None, image=s.image if s.view is None else None) for s in seen]
    for drive in drives_of(trace):
        first, *steps = bare[drive.first : drive.stop]
        *steps, last = replace(first, displacement=None, covariance=None), *steps
        yield drive.name, (*steps, replace(last, action=None))


def _names_of(traces: Sequence[Trace], *numbers: int) -> str:
    """The names of the traces with these numbers, in brackets; empty if one has no name."""
    names = [_name(traces[i]) for i in numbers]
    return f" ({', '.join(map(str, names))})" if all(names) else ""


def _repeats(traces: Sequence[Trace]) -> Iterator[str]:
    """Say if two traces have a drive with the same steps: most likely it was given twice."""
    first: dict[tuple[Step, ...], tuple[int, str]] = {}
    for i, name, steps in ((i, *drive) for i, t in enumerate(traces) for drive in _recorded(t)):
        k, other = first.setdefault(steps, (i, name))
        named = f" ({other}, {name})" if _name(traces[k]) and _name(traces[i]) else ""
        if k != i:
            yield f"traces {k + 1} and {i + 1} have the same steps{named}; give each drive once"


def _other_names(traces: Sequence[Trace]) -> Iterator[str]:
    """Say if traces have different names for travels or turns that are alike in all else.

    A trace with several such names uses them for something, such as the angles of its turns.
    """
    known: dict[Action, tuple[int, set[str]]] = {}
    for i, trace in enumerate(traces):
        named: dict[Action, set[str]] = {}
        for action in {a for a in trace.actions if a.kind in ("travel", "turn")}:
            named.setdefault(replace(action, name="?", extra={}), set()).add(action.name)
        for alike, names in named.items():
            first, others = known.setdefault(alike, (i, names))
            if not names & others and len(names) == len(others) == 1:
                pair = " and ".join(brief(min(some)) for some in (others, names))
                yield (
                    f"action: traces {first + 1} and {i + 1}{_names_of(traces, first, i)} have "
                    f"different names for one kind of action: {pair}; give both one name if they "
                    "are one action"
                )


def travels_of(trace: Trace) -> list[float]:
    """The lengths of the displacements of all travels that moved the robot."""
    return [
        length
        for action, step in zip(trace.actions, trace.steps[1:], strict=True)
        if action.kind == "travel" and step.displacement is not None
        if (length := math.hypot(*step.displacement[:2])) > 0
    ]


def _other_units(traces: Sequence[Trace]) -> Iterator[str]:
    """Say if the displacements of two traces are so different that their units must be."""
    usual = {i: median(some) for i, trace in enumerate(traces) if (some := travels_of(trace))}
    least, most = (pick(usual, key=usual.__getitem__, default=0) for pick in (min, max))
    if usual and usual[most] > UNITS * usual[least]:
        yield (
            f"displacement: the median travel of trace {least + 1} is {usual[least]:.3g} m, and "
            f"that of trace {most + 1} is {usual[most]:.3g} m{_names_of(traces, least, most)}; "
            "give both in metres"
        )


def _other_views(traces: Sequence[Trace]) -> Iterator[str]:
    """Say if two traces have no view in common: then they can have no dstate in common."""
    seen = [set(trace.views) for trace in traces]
    if len(seen) < 2 or any(None in views for views in seen):  # unknown: it may be any view
        return
    alone = [i for i, v in enumerate(seen) if v.isdisjoint(set().union(*seen[:i], *seen[i + 1 :]))]
    for i in alone[-1:] if len(seen) == 2 else alone:  # of two traces, one is enough
        yield (
            f"views: trace {i + 1}{_names_of(traces, i)} has no view in common with another "
            "trace, so no view says where the trace belongs; leave it out, or give one name to "
            "views that are one"
        )


def _check_alike(traces: Sequence[Trace], names: Sequence[str]) -> None:
    """Raise TraceError if two traces differ in what they record."""
    for what, read, mend in _RECORDED:
        values = [read(trace) for trace in traces]
        known = next((i for i, here in enumerate(values) if here is not None), 0)
        for i, here in enumerate(values):
            if here is not None and here != values[known]:
                raise TraceError(
                    f"{what}: expected the same in all traces, got {values[known]} in trace "
                    f"{known + 1} and {here} in trace {i + 1}{_names_of(traces, known, i)}; {mend}"
                )
    actions: dict[str, tuple[int, Action]] = {}
    for i, trace in enumerate(traces):
        for action in dict.fromkeys(a for a in trace.actions if not a.unlinked):
            first, other = actions.setdefault(action.name, (i, action))
            if action != other or action.name in names:
                other_use = "the name of a drive" if action.name in names else other.to_json()
                raise TraceError(
                    f"action: expected one meaning of {brief(action.name)} in all traces, got "
                    f"{brief(other_use)} in trace {first + 1} and {brief(action.to_json())} in "
                    f"trace {i + 1}{_names_of(traces, first, i)}; rename one of them"
                )


def _stars(trace: Trace) -> str:
    stars = [step.star for step in trace.steps if step.star is not None]
    if not stars:
        return "no stars"
    return "four openings" if all(is_four(star) for star in stars) else "bearings"


def _displacements(trace: Trace) -> str | None:
    if len(trace) - len(starts_of(trace)) == 1:  # a single step has no displacement
        return None
    return "displacements" if trace.has_displacements else "no displacements"


def _systematic(trace: Trace) -> dict[str, float] | None:
    """The odometry's errors of scale, drift and dstates, by name; None without displacements."""
    model = _odometry(trace)
    names = ("scale", "bend", "offset", "facing")
    return None if model is None else {name: getattr(model, name) for name in names}


def _odometry(trace: Trace) -> Odometry | None:
    return trace.odometry or (Odometry() if trace.has_displacements else None)


def _with_covariances(trace: Trace) -> Trace:
    """Copy a trace, with the covariance of each displacement at its step."""
    steps = (replace(step, covariance=trace.covariance(t)) for t, step in enumerate(trace.steps))
    return replace(trace, steps=tuple(steps))


def _header(name: str, trace: Trace) -> object:
    """Read a field about images from the header; None without images."""
    has_images = any(step.image is not None for step in trace.steps)
    return trace.extra.get(name, "none") if has_images else None


def _sidecar(trace: Trace) -> str | None:
    """The file that images are in, from the working folder, if the steps name them by numbers."""
    path = images_file(trace) if any(isinstance(s.image, int) for s in trace.steps) else None
    return None if path is None else os.path.relpath(path)


# What all traces must have alike: its name, a function that reads it (None if a trace does not
# say), and what to do.
_RECORDED: tuple[tuple[str, Callable[[Trace], object], str], ...] = (
    ("star", _stars, "record stars in one way, or leave them out (Trace.without_stars)"),
    ("displacement", _displacements, "add them, or leave them out (Trace.without_displacements)"),
    ("odometry", _systematic, "give all traces one odometry"),
    ("images", _sidecar, "put them into one file (the command 'cluster --together' does so)"),
    ("beams", partial(_header, "beams"), "take images of one laser"),
    ("panorama", partial(_header, "panorama"), "take images of one camera"),
)


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


class MapSequence:
    """Makes a value with the attributes `maps` and `drives` a sequence of its maps."""

    __slots__ = ()
    maps: tuple[SSHMap, ...]

    @property
    def drives(self) -> tuple[Drive, ...]:
        """The drives of the trace; empty if they are unknown."""
        raise NotImplementedError

    @property
    def joined(self) -> str:
        """Which drives the first map joins, in words; empty for one drive or without a map."""
        return pieces_in_words(self.drives, self.maps[0]) if self.maps else ""

    def __len__(self) -> int:
        """The number of maps."""
        return len(self.maps)

    def __bool__(self) -> bool:
        """True, even without a map. Ask `len` or `status` whether there are maps."""
        return True

    def __iter__(self) -> Iterator[SSHMap]:
        return iter(self.maps)

    @overload
    def __getitem__(self, index: int) -> SSHMap: ...

    @overload
    def __getitem__(self, index: slice) -> tuple[SSHMap, ...]: ...

    def __getitem__(self, index: int | slice) -> SSHMap | tuple[SSHMap, ...]:
        """The map at a position, or a tuple of maps for a slice. Raises RangeError."""
        if isinstance(index, slice):
            return self.maps[index]
        return self.maps[checked_index(index, len(self.maps), "maps")]
