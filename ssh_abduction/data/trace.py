"""Traces: what a robot observed and did, step by step.

>>> from ssh_abduction import Trace
>>> trace = Trace.from_steps(views=["a", "b", "a"], actions=["travel", "around"])
>>> len(trace), trace.views, [a.kind for a in trace.actions]
(3, ('a', 'b', 'a'), ['travel', 'turn'])

A trace file has JSON lines: a header, and then one line for each step, with what was observed and
the action taken next. See docs/reference/formats.md.

A sidecar file beside it may hold the images as one table.
"""

from __future__ import annotations

import codecs
import hashlib
import os
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, BinaryIO, overload

from ssh_abduction.data import checks
from ssh_abduction.data.checks import View
from ssh_abduction.data.errors import RangeError, TraceError, brief, checked_index, named, said_of
from ssh_abduction.data.files import (
    LINE_OF_A_LOG,
    BadJson,
    json_line,
    opened_file,
    parse_json,
    save_file,
    source_of,
)
from ssh_abduction.data.odometry import (
    Closure,
    Covariance,
    Odometry,
    checked_closures,
    closures_among,
    parse_closures,
)
from ssh_abduction.data.schema import set_checked
from ssh_abduction.data.star import Star
from ssh_abduction.data.step import (
    STANDARD_ACTIONS,
    Action,
    Kind,
    Step,
    TurnDirection,
    as_list,
    one_each,
    parse_action,
)
from ssh_abduction.data.words import counted
from ssh_abduction.runtime.lazy import card_of

# Other modules import the parts of traces from here, too.
__all__ = ["STANDARD_ACTIONS", "Action", "Kind", "Step", "Trace", "TurnDirection", "View"]

_USUAL = Odometry()  # used if the trace has no odometry
FORMAT, VERSION = "ssh-trace", 1
# The most bytes of a line. An image of 100,000 numbers fits into a line. A file without line ends
# is rejected before it fills the memory.
LONGEST_LINE = 16 * 2**20
# How files of maps and robots' logs begin. Users sometimes give these files instead of a trace.
_MAPS = (b'{"format": "ssh-solution"', b'{"format": "ssh-map"')
_LOG = re.compile(rb"\x1f\x8b|#ROSBAG V|SQLite format 3\0|\x89MCAP0|# message formats defined")
_STEP_FIELDS = tuple(f.name for f in fields(Step) if f.name not in ("extra", "gateways"))
_HEADER_FIELDS = ("format", "version", "name", "images", "odometry", "drive", "closures")


@dataclass(frozen=True)
class Trace:
    """A sequence of steps: n + 1 observations with n actions between them.

    A trace is immutable. Make one with `load` or `from_steps`.

    Attributes:
        steps: The steps.
        name: The name of the trace.
        images: The path of the sidecar file. If the image of a step is a number, it is an index
            into this file.
        odometry: The noise of displacements without a covariance; None for the defaults.
        extra: Fields of the file's header that this package does not know.
        source: The file that the trace was read from.
        drive: The name of the first drive, in a trace of several drives (`data/drives.py`).
        closures: How pairs of steps lie relative to each other, from matches of their local maps.
            They count as displacements.
    """

    steps: tuple[Step, ...]
    name: str | None = None
    images: str | None = None
    odometry: Odometry | None = None
    extra: Mapping[str, Any] = field(default_factory=dict, hash=False)
    source: str | None = field(default=None, compare=False)
    drive: str | None = None
    closures: tuple[Closure, ...] = ()

    def __post_init__(self) -> None:
        if not isinstance(self.steps, tuple) or not all(
            isinstance(step, Step) for step in self.steps
        ):
            raise TraceError(
                f"steps: expected a tuple of Step, got {brief(self.steps)}; "
                f"take Trace.from_steps for views and actions"
            )
        if not self.steps:
            raise TraceError(
                f"{named(self.source or 'trace')}: expected at least one step, got none; "
                f"add what the robot saw first"
            )
        set_checked(self, name=_text, images=_text, source=_text, drive=_text)
        if self.odometry is not None:
            mend = "make one with Odometry.of, or leave it out"
            checks.an_instance("odometry", self.odometry, Odometry, TraceError, mend=mend)
        checks.an_object("extra", self.extra, TraceError)
        closures = checked_closures(self.closures, len(self.steps), self.source)
        object.__setattr__(self, "closures", closures)
        self._check_actions()

    def _check_actions(self) -> None:
        """Check that all steps but the last have an action, and that equal names are one action."""
        last = len(self.steps) - 1
        types: dict[str, tuple[int, Action]] = {}
        for i, step in enumerate(self.steps):
            action = step.action
            if action is None:
                if i < last:
                    raise TraceError(
                        f"{self.at(i)}: action: expected one, as another step follows; "
                        f"name the action that led to it"
                    )
                continue
            if i == last:
                raise TraceError(
                    f"{self.at(i)}: action: expected none on the last step, "
                    f"got {brief(action.name)}; remove it, or add the step that it led to"
                )
            if action.starts:
                _check_start(self, i, action.name, types)
            if action.breaks_frame:
                _check_frame(self, i, action)
            first, known = types.setdefault(action.name, (i, action))
            if known != action:
                raise TraceError(
                    f"{self.at(i)}: action: {brief(action.name)} has kind {action.kind}, "
                    f"turn {action.turn} here but kind {known.kind}, turn {known.turn} "
                    f"on {self.at(first)}; give the two different names, or the same kind"
                )

    def __len__(self) -> int:
        """The number of steps, which is one more than the number of actions."""
        return len(self.steps)

    def __iter__(self) -> Iterator[Step]:
        return iter(self.steps)

    @overload
    def __getitem__(self, index: int) -> Step: ...

    @overload
    def __getitem__(self, index: slice) -> Trace: ...

    def __getitem__(self, index: int | slice) -> Step | Trace:
        """Return a step, such as trace[3], or a trace of consecutive steps, such as trace[:20].

        The first step of a slice loses its displacement, and the last one loses its action.
        Negative indices, and slices that reach beyond the trace, work as for a list.

        Raises:
            RangeError: If there is no such step, or the slice is empty.
            TraceError: If the stride of the slice is not 1.
        """
        if not isinstance(index, slice):
            return self.steps[checked_index(index, len(self), "steps")]
        start, stop, stride = index.indices(len(self))
        if stride != 1:
            raise TraceError(
                f"steps: expected steps in a row, as each action leads to the next one, "
                f"got a stride of {stride}; leave the stride out"
            )
        if start >= stop:
            raise RangeError(
                f"steps: expected a slice that holds some of 0 to {len(self) - 1}, "
                f"got {start}:{stop}; a trace has one step at least"
            )
        if not start:
            return self.prefix(stop)
        here = self.prefix(stop).steps[start:]
        # Drop the source: messages would otherwise name wrong lines of the file.
        return replace(
            self,
            steps=(replace(here[0], displacement=None, covariance=None), *here[1:]),
            source=None,
            drive=next((a.name for a in self.actions[start - 1 :: -1] if a.starts), self.drive),
            closures=closures_among(self.closures, range(start, stop)),
        )

    def __repr__(self) -> str:
        name = f" {brief(self.name, 40)}" if self.name else ""
        actions = len({action.name for action in self.actions})
        views = {view for view in self.views if view is not None}
        parts = [
            counted(len(self), "steps"),
            *([counted(len(views), "views")] if views else []),
            counted(actions, "actions"),
        ]
        there = {
            "images": any(step.image is not None for step in self),
            "stars": self.has_stars,
            "displacements": any(step.displacement is not None for step in self),
            "closures": bool(self.closures),
        }
        more = "".join(f"; {what}" for what, is_there in there.items() if is_there)
        return f"<Trace{name}: {', '.join(parts)}{more}>"

    def _repr_html_(self) -> str:
        """Return the first steps as HTML for notebooks."""
        return card_of(self)

    @property
    def views(self) -> tuple[View | None, ...]:
        """The view of each step; None if it is unknown."""
        return tuple(step.view for step in self.steps)

    @cached_property
    def actions(self) -> tuple[Action, ...]:
        """The actions of all steps but the last, in order."""
        return tuple(step.action for step in self.steps if step.action is not None)

    @property
    def has_stars(self) -> bool:
        """Whether any step has a star."""
        return any(step.star is not None for step in self.steps)

    @cached_property
    def _starts(self) -> list[tuple[int, str]]:
        """The first step and the name of each drive but the first."""
        return [(t, action.name) for t, action in enumerate(self.actions, 1) if action.starts]

    @cached_property
    def in_quarters(self) -> bool:
        """Whether right angles describe all stars (openings seen) and turns.

        If so, each star is four openings: ahead, right, back and left.
        """
        stars = {tuple(step.star) for step in self.steps if step.star is not None}
        return all(Star.of(star).openings is not None for star in stars) and all(
            action.in_quarters for action in set(self.actions)
        )

    @property
    def has_displacements(self) -> bool:
        """Whether any step has a displacement, or there are closures."""
        return bool(self.closures) or any(step.displacement is not None for step in self.steps)

    def covariance(self, step: int) -> Covariance | None:
        """Return the covariance of a step's displacement, 3 x 3; None without a displacement.

        If the step gives no covariance, it is computed from the odometry.

        Raises:
            RangeError: If there is no such step.
        """
        here = self.steps[checks.a_whole_number("step", step, RangeError, 0, len(self) - 1)]
        if here.displacement is None or here.covariance is not None:
            return here.covariance
        return (self.odometry or _USUAL).covariance(here.displacement)

    def at(self, step: int) -> str:
        """Return the name of a step in messages: file and line, or the number of the step."""
        checks.a_whole_number("step", step, TraceError)
        if self.source:
            return f"{named(self.source)}:{step + 2}"
        if not self._starts:
            return f"step {step}"
        drives = [(0, self.drive or self.name or "drive 1"), *self._starts]
        first, drive = next(found for found in reversed(drives) if found[0] <= step)
        return f"step {drive}:{step - first}"

    @classmethod
    def from_steps(
        cls,
        views: Iterable[View | None],
        actions: Iterable[Action | str | Mapping[str, Any]],
        *,
        stars: Iterable[Sequence[Any] | None] | None = None,
        displacements: Iterable[Sequence[float] | None] | None = None,
        covariances: Iterable[Sequence[Sequence[float]] | None] | None = None,
        odometry: Odometry | Mapping[str, Any] | None = None,
        name: str | None = None,
    ) -> Trace:
        """Make a trace from n + 1 views and the n actions between them.

        Args:
            views: The view of each step; None if it is unknown.
            actions: The actions, as `Action.of` takes them.
            stars: The openings seen at each step, as in `Step.star`; None if none were recorded.
            displacements: [dx, dy, dtheta] during each action, in metres and radians; None if it is
                unknown.
            covariances: The covariance of each displacement, 3 x 3; None to use the odometry.
            odometry: The noise of displacements without a covariance.
            name: The name of the trace.

        Raises:
            TraceError: If a value is wrong, or there are too few or too many.
        """
        if isinstance(actions, str):
            raise TraceError(
                f"actions: expected a list, got {brief(actions)}; "
                f"give the name of one action after another, as in ['travel']"
            )
        seen = as_list(views, "views")
        done = [Action.of(a) for a in as_list(actions, "actions")]
        if len(seen) != len(done) + 1:
            raise TraceError(
                f"trace: expected one view more than actions, got {len(seen)} views and "
                f"{len(done)} actions; each action leads from one view to the next"
            )
        # A step has its star. The displacement of an action belongs to the step after the action.
        openings = one_each(stars, "stars", len(seen))
        moved = [None, *one_each(displacements, "displacements", len(done), "action")]
        noise = [None, *one_each(covariances, "covariances", len(done), "action")]
        steps = tuple(
            Step.of(view, star, f"step {i}", action, displacement, covariance)
            for i, (view, star, action, displacement, covariance) in enumerate(
                zip(seen, openings, [*done, None], moved, noise, strict=True)
            )
        )
        return cls(steps, name=name, odometry=None if odometry is None else Odometry.of(odometry))

    def without_stars(self) -> Trace:
        """Return the same trace without stars (openings seen)."""
        return replace(self, steps=tuple(replace(step, star=None) for step in self.steps))

    def without_displacements(self) -> Trace:
        """Return the same trace without displacements, closures and odometry."""
        return replace(
            self,
            steps=tuple(replace(step, displacement=None, covariance=None) for step in self.steps),
            odometry=None,
            closures=(),
        )

    def without_displacements_at(self, steps: Collection[int]) -> Trace:
        """Return the same trace without the displacements that lead to these steps."""
        unknown = {
            checks.a_whole_number(f"steps[{i}]", step, TraceError)
            for i, step in enumerate(checks.a_list("steps", steps, TraceError))
        }
        if not unknown:
            return self
        kept = [
            replace(step, displacement=None, covariance=None) if t in unknown else step
            for t, step in enumerate(self.steps)
        ]
        return replace(self, steps=tuple(kept))

    def with_views(
        self, views: Iterable[View | None], confidences: Iterable[float | None] | None = None
    ) -> Trace:
        """Return the same trace with other views and confidences.

        Args:
            views: The view of each step; None if it is unknown.
            confidences: The probability that each view is right; None if it is unknown.

        Raises:
            TraceError: If a value is wrong, or there is not one for each step.
        """
        seen = one_each(as_list(views, "views"), "views", len(self))
        sure = one_each(confidences, "confidences", len(self))
        steps = []
        for i, (step, v, c) in enumerate(zip(self.steps, seen, sure, strict=True)):
            view = None if v is None else checks.checked_view(v, f"views[{i}]")
            share = None if c is None else checks.checked_probability(c, f"confidences[{i}]")
            steps.append(replace(step, view=view, confidence=share))
        return replace(self, steps=tuple(steps))

    def prefix(self, steps: int) -> Trace:
        """Return the trace of the first `steps` steps, or the whole trace if it has fewer."""
        head = self.steps[: checks.a_whole_number("steps", steps, TraceError, 1)]
        if head:
            head = (*head[:-1], replace(head[-1], action=None))
        return replace(self, steps=head, closures=closures_among(self.closures, range(len(head))))

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Trace:
        """Read a trace from a file; "-" means standard input.

        Raises:
            TraceError: If the file cannot be read or is not a trace. The error names the file, the
                line and the field.
        """
        path = checks.a_path("path", path, TraceError)
        with opened_file(path, "a readable trace file", TraceError) as file:
            read = read_trace(file, source_of(path))
        return cls(**read, source="standard input" if path == "-" else path)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the trace into a file. The file appears whole or not at all.

        Raises:
            TraceError: If the file cannot be written, or a value of the trace has no form in JSON.
        """
        path = checks.a_path("path", path, TraceError)
        lines = "".join(line + "\n" for line in self.to_lines())
        try:
            data, _ = lines.encode("utf-8"), os.fsencode(path)
        except UnicodeEncodeError as error:
            half = f"half a character, \\u{ord(error.object[error.start]):04x}"
            raise TraceError(
                f"trace: expected texts and file names in UTF-8, got {half}; rename it"
            ) from None
        save_file(path, data, "trace", TraceError)

    @property
    def digest(self) -> str:
        """A digest of the trace's file, 16 hexadecimal digits. Reports name the trace by it."""
        whole = "\n".join(self.to_lines()).encode("utf-8", "backslashreplace")
        return hashlib.sha256(whole).hexdigest()[:16]

    def to_lines(self) -> Iterator[str]:
        """Yield the lines of the trace as a file: the header, then one line for each step."""
        named_by = {name: getattr(self, name) for name in ("name", "images", "drive")}
        header = {"format": FORMAT, "version": VERSION, **named_by}
        more: dict[str, Any] = {}
        if self.odometry is not None:
            more["odometry"] = self.odometry.to_json()
        if self.closures:
            more["closures"] = [closure.to_json() for closure in self.closures]
        yield _dump({**{k: v for k, v in header.items() if v is not None}, **more, **self.extra})
        for step in self.steps:
            yield _dump(step.to_json())


def _text(value: object, name: str) -> str:
    return checks.plain_text(
        checks.a_text(name, value, TraceError, mend="give a text, or leave it out")
    )


def _check_start(trace: Trace, i: int, name: str, known: Collection[str]) -> None:
    """Check the start of the drive `name` after step i. `known` has earlier names."""
    if name in known or name == trace.drive:
        raise TraceError(
            f"{trace.at(i)}: action: expected a new name for this drive, got {brief(name)}, the "
            "name of an earlier drive or action; rename it"
        )


def _check_frame(trace: Trace, i: int, action: Action) -> None:
    """Check that no displacement leads from step i to a step with a frame of its own."""
    if (moved := trace.steps[i + 1].displacement) is not None:
        where = "the first step of a drive" if action.starts else "the first step of a floor"
        raise TraceError(
            f"{trace.at(i + 1)}: displacement: expected none on {where}, got "
            f"{brief(moved)}; leave it out"
        )


def checked_trace(value: object) -> Trace:
    """Return a value if it is a trace, or raise TraceError."""
    mend = "make one with Trace.load or Trace.from_steps"
    return checks.an_instance("trace", value, Trace, TraceError, mend=mend)


def _dump(value: Mapping[str, Any]) -> str:
    """Return an object as a line of a trace file."""
    try:
        return json_line(value)
    except (TypeError, ValueError, RecursionError) as error:
        raise TraceError(
            f"trace: expected values that JSON can hold, got {brief(dict(value))} ({error}); "
            f"mend the field"
        ) from None


def images_file(trace: Trace) -> Path | None:
    """Return the path of the sidecar file; None if the trace names none.

    A trace names it relative to its own file, or to the working folder if it has no file.
    """
    return Path(trace.source or ".").parent / trace.images if trace.images else None


def with_images_named_from(trace: Trace, folder: str | os.PathLike[str]) -> Trace:
    """Copy a trace that will be saved in another folder, so that it still names its images."""
    path = images_file(trace)
    return trace if path is None else replace(trace, images=os.path.relpath(path, folder))


def read_trace(file: BinaryIO, source: str) -> dict[str, Any]:
    """Return the arguments of Trace, by name, from a trace file.

    Raises TraceError, which names the file, the line and the field.
    """
    header: dict[str, Any] | None = None
    steps: list[Step] = []
    actions: dict[str, Action] = {}
    empty_line = number = 0
    while raw := file.readline(LONGEST_LINE + 1):
        number += 1
        where = f"{source}:{number}"
        if len(raw) > LONGEST_LINE:
            raise TraceError(
                f"{where}: line: expected at most {LONGEST_LINE // 2**20} MiB, got more; "
                f"write one step per line, and big images to a sidecar file"
            )
        if not raw.strip():  # empty lines are allowed at the end only
            empty_line = empty_line or number
            continue
        if empty_line:
            raise TraceError(
                f"{source}:{empty_line}: line: expected a step, got an empty line; remove it"
            )
        record = _record(raw, where)
        if header is None:
            header = _header(record, where)
        else:
            steps.append(_step(record, where, actions))
    if header is None:
        raise TraceError(
            f'{source}:1: header: expected {{"format": "{FORMAT}", "version": {VERSION}}}, '
            f"got an empty file; write the header, then a line per step"
        )
    return {
        "steps": tuple(steps),
        **{name: header.get(name) for name in ("name", "images", "odometry", "drive")},
        "closures": header["closures"],
        "extra": {k: v for k, v in header.items() if k not in _HEADER_FIELDS},
    }


def _record(raw: bytes, where: str) -> dict[str, Any]:
    """Parse a line and return its object. The first line may begin with a byte order mark."""
    if where.endswith(":1"):
        _refuse_other_files(raw, where)
        raw = raw.removeprefix(codecs.BOM_UTF8)
    try:
        record = parse_json(raw.rstrip())
    except BadJson as error:
        what = f"{where}: {error.field or 'line'}: expected {error.expected}, got {error}"
        raise TraceError(f"{what}; {error.mend or 'correct this line'}") from None
    if not isinstance(record, dict):
        raise TraceError(
            f"{where}: line: expected a JSON object in braces, got {brief(record)}; "
            f"write one step per line"
        )
    return record


def _refuse_other_files(raw: bytes, where: str) -> None:
    """Raise TraceError if the first line is that of a robot's log or of a file of maps."""
    if _LOG.match(raw) or LINE_OF_A_LOG.match(raw):
        raise TraceError(
            f"{where}: header: expected a trace, got a robot's log; "
            f"make a trace of it with ssh-abduction import LOG -o trace.jsonl"
        )
    if raw.startswith(_MAPS):
        raise TraceError(
            f"{where}: header: expected a trace, got maps, as solve prints them; "
            f"name the two files in the other order, or solve's trace"
        )


def _header(record: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Check the header and return it as a dict, its odometry and closures as objects."""
    if record.get("format") != FORMAT:
        came = f"a line without it: {brief(dict(record))}"
        came = brief(record["format"]) if "format" in record else came
        raise TraceError(
            f'{where}: format: expected "{FORMAT}" in a header, got {came}; '
            f'put {{"format": "{FORMAT}", "version": {VERSION}}} on the first line'
        )
    version = record.get("version")  # True equals 1, so also check the type
    if version != VERSION or isinstance(version, bool):
        raise TraceError(
            f"{where}: version: expected {VERSION}, got {brief(version)}; "
            f"convert the file, or take a newer ssh-abduction"
        )
    odometry = record.get("odometry")
    with said_of(where):
        for key in ("name", "images", "drive"):
            if record.get(key) is not None:
                checks.a_text(key, record[key], TraceError, mend="quote it or leave it out")
        return {
            **record,
            "odometry": None if odometry is None else Odometry.of(odometry),
            "closures": parse_closures(record.get("closures")),
        }


def _step(record: Mapping[str, Any], where: str, actions: dict[str, Action]) -> Step:
    """Make a step from the object on a line. Equal actions become one object, kept in `actions`."""
    given = {name: record.get(name) for name in _STEP_FIELDS}
    if given["image"] is None and "view" not in record:
        raise TraceError(
            f"{where}: view: expected a text or an integer (or an image to make one from), "
            f"got none; say what the robot saw, or null where that was not logged"
        )
    if given["action"] is not None:
        action = parse_action(given["action"], f"{where}: action")
        known = action if action.extra else actions.setdefault(action.name, action)
        given["action"] = known if known == action else action
    with said_of(where):
        return Step(**given, extra={k: v for k, v in record.items() if k not in _STEP_FIELDS})
