"""What a robot saw and did: the one type that crosses every border of the package.

>>> from ssh_abduction import Trace
>>> trace = Trace.from_steps(views=["a", "b", "a"], actions=["travel", "around"])
>>> len(trace), trace.views, [a.kind for a in trace.actions]
(3, ('a', 'b', 'a'), ['travel', 'turn'])

A file holds JSON lines: a header, and then for each step a line with what was seen and the action taken next. See docs/formats.md.
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, BinaryIO, Literal, TypeAlias, overload

from ssh_abduction.data.checks import a_list, a_path, a_text, a_whole_number, an_instance, an_object
from ssh_abduction.data.errors import (
    RangeError,
    TraceError,
    brief,
    checked_index,
    is_finite,
    is_whole,
    is_writable,
    named,
)
from ssh_abduction.data.files import (
    LINE_OF_A_LOG,
    HalfCharacter,
    NotFinite,
    json_line,
    parse_json,
    write_file,
)
from ssh_abduction.data.notebook import in_output
from ssh_abduction.data.odometry import (
    Covariance,
    Displacement,
    Odometry,
    checked_covariance,
    checked_displacement,
)
from ssh_abduction.data.star import (
    SPREAD,
    Entry,
    Gateway,
    Openings,
    Star,
    is_four,
    near_quarter,
    parse_star,
)
from ssh_abduction.data.words import counted, that_differ

View: TypeAlias = str | int
Kind: TypeAlias = Literal["travel", "turn"]
TurnDirection: TypeAlias = Literal["right", "left", "around"]

FORMAT, VERSION = "ssh-trace", 1
# Bytes that a line of a file may have. A step with a panorama of 100,000 numbers fits; a file that has no line ends is refused before it fills the memory.
LONGEST_LINE = 16 * 2**20
_KINDS = ("travel", "turn")
_TURNS = ("right", "left", "around")
_MAPS = (b'{"format": "ssh-solution"', b'{"format": "ssh-map"')  # what files of maps begin with
# How files begin that are robots' logs, and no traces.
_LOGS = {
    b"\x1f\x8b": "gzipped data",
    b"#ROSBAG V": "a bag of ROS 1",
    b"SQLite format 3\0": "a bag of ROS 2",
    b"\x89MCAP0": "MCAP",
    b"# message formats defined": "a log of CARMEN",
}
_STEP_FIELDS = (
    "view",
    "image",
    "action",
    "star",
    "displacement",
    "covariance",
    "truth",
    "confidence",
)
_ACTION_FIELDS = ("name", "kind", "turn", "gateway", "bearing")
_QUARTERS = (None, "right", "around", "left")
_USUAL = Odometry()  # what odometry is worth where the trace does not say


@dataclass(frozen=True, slots=True)
class Action:
    """A sequence of control laws that takes the robot from one distinctive state to another.

    The topological axioms read `kind` and `turn`; the causal axioms read the name alone. Of a turn, a star of any number of gateways may be told more:

    gateway  it ends facing this gateway, counted from 1 to the side that it turns to; one that the robot faces before is not counted
    bearing  degrees that it turns by, clockwise
    """

    name: str
    kind: Kind | None = None
    turn: TurnDirection | None = None
    extra: Mapping[str, Any] = field(default_factory=dict, compare=False, repr=False)
    gateway: int | None = None
    bearing: float | None = None

    def __post_init__(self) -> None:
        name, kind, turn = self.name, self.kind, self.turn
        if not isinstance(name, str) or not name or "\0" in name or not is_writable(name):
            raise TraceError(f"action.name: expected a text, got {brief(name)}; name the action")
        if not isinstance(kind, str | None) or kind not in (None, *_KINDS):
            raise TraceError(
                f'action.kind: expected "travel" or "turn", got {brief(kind)}; leave it out for other actions'
            )
        if not isinstance(turn, str | None) or turn not in (None, *_TURNS):
            raise TraceError(
                f'action.turn: expected "right", "left" or "around", got {brief(turn)}; choose the nearest'
            )
        if turn is not None and kind != "turn":
            raise TraceError(
                f'action.kind: expected "turn", as the action has a turn, got {brief(kind)}; set the kind or drop the turn'
            )
        an_object("action.extra", self.extra, TraceError)
        if self.bearing is not None:
            turn = self._turn_of_bearing()
            object.__setattr__(self, "turn", turn)
        if kind == "turn" and turn is None:
            raise TraceError(
                'action.turn: expected "right", "left" or "around" for a turn, got none; say which way it goes'
            )
        if self.gateway is not None and (
            not is_whole(self.gateway) or self.gateway < 1 or turn not in ("right", "left")
        ):
            raise TraceError(
                f"action.gateway: expected 1 or more, for a turn right or left, got {brief(self.gateway)}; count the gateways to that side"
            )

    def _turn_of_bearing(self) -> TurnDirection:
        """Which way a turn by the bearing goes. Raises TraceError."""
        if self.kind != "turn" or not is_finite(self.bearing):
            raise TraceError(
                f"action.bearing: expected degrees clockwise, for a turn, got {brief(self.bearing)}; leave it out elsewhere"
            )
        assert self.bearing is not None
        degrees = self.bearing % 360
        turn: TurnDirection = (
            "around" if abs(degrees - 180) <= SPREAD else "right" if degrees < 180 else "left"
        )
        if min(degrees, 360 - degrees) <= SPREAD or self.turn not in (None, turn):
            went = "no turn" if min(degrees, 360 - degrees) <= SPREAD else turn
            raise TraceError(
                f"action.bearing: expected degrees of a turn {self.turn or ''}, got {brief(self.bearing)}, which is {went}; mend it"
            )
        return turn

    @staticmethod
    def that_slipped(step: int) -> Action:
        """What stands for the action of a step that did not do what its name says: nothing is known of it, and it is like no other action."""
        return Action(
            f"slipped at step {a_whole_number('step', step, TraceError)}", extra={"slipped": True}
        )

    @property
    def slipped(self) -> bool:
        """Whether this stands for an action that did not do what its name says."""
        return self.kind is None and self.extra.get("slipped") is True

    @property
    def in_quarters(self) -> bool:
        """Whether all that is said of a turn is that it goes right, left or around, by quarters."""
        quarter = self.bearing is None or (
            (slot := near_quarter(self.bearing)) is not None and _QUARTERS[slot] == self.turn
        )
        return quarter and self.gateway is None

    @staticmethod
    def of(value: Action | str | Mapping[str, Any]) -> Action:
        """An action from its name, or from an object with `name`, `kind`, `turn`, `gateway` and `bearing`. Raises TraceError."""
        if isinstance(value, Action):
            return value
        return _action(value, "action")

    def to_json(self) -> Any:
        if self == STANDARD_ACTIONS.get(self.name, Action(self.name)) and not self.extra:
            return self.name
        known = {
            "name": self.name,
            "kind": self.kind,
            "turn": self.turn,
            "gateway": self.gateway,
            "bearing": self.bearing,
        }
        return {**{k: v for k, v in known.items() if v is not None}, **self.extra}


STANDARD_ACTIONS: dict[str, Action] = {
    "travel": Action("travel", "travel"),
    "right": Action("right", "turn", "right"),
    "left": Action("left", "turn", "left"),
    "around": Action("around", "turn", "around"),
}


@dataclass(frozen=True, slots=True)
class Step:
    """What was seen at one moment, and the action taken next (None on the last step of a trace).

    view          name or number of the view; None where it is unknown, or while only an image is there
    star          the openings ahead, right, back and left as four 0/1, None where not observed; or their bearings in degrees, clockwise from ahead; or Gateways
    displacement  (dx, dy, dtheta) from the last step, in metres and radians, in the frame that the robot had there: x ahead, y left, counterclockwise;
                  that of the first step, which no step comes before, says nothing
    covariance    of the displacement, (3, 3); where it is missing, the trace's odometry tells it
    image         ranges in metres, or an index into the header's sidecar file
    truth         for evaluation only; nothing that infers reads it
    confidence    how probable it is that the view, and the star, are right, from 0 to 1; where faults are allowed, it scales what it costs to disbelieve them
    """

    view: View | None = None
    action: Action | None = None
    star: tuple[Entry, ...] | None = None
    displacement: Displacement | None = None
    covariance: Covariance | None = None
    image: tuple[float, ...] | int | None = None
    truth: Any = field(default=None, hash=False)
    extra: Mapping[str, Any] = field(default_factory=dict, hash=False)
    confidence: float | None = None

    def __post_init__(self) -> None:
        if self.view is not None:
            object.__setattr__(self, "view", _view(self.view, "view"))
        if self.action is not None:
            an_instance(
                "action", self.action, Action, TraceError, mend='make one with Action.of("travel")'
            )
        an_object("extra", self.extra, TraceError)
        if self.image is not None:
            object.__setattr__(self, "image", _frozen_image(self.image))
        if self.confidence is not None:
            object.__setattr__(self, "confidence", _probability(self.confidence, "confidence"))
        if self.star is not None:
            object.__setattr__(self, "star", parse_star(self.star, "star"))
        if self.displacement is not None:
            object.__setattr__(
                self, "displacement", checked_displacement(self.displacement, "displacement")
            )
        if self.covariance is not None:
            if self.displacement is None:
                raise TraceError(
                    "covariance: expected a displacement that it belongs to, got none; add it, or leave the covariance out"
                )
            object.__setattr__(
                self, "covariance", checked_covariance(self.covariance, "covariance")
            )

    def __repr__(self) -> str:
        told = that_differ(self)
        if self.action is not None:
            told["action"] = repr(self.action.name)
        if isinstance(self.image, tuple):
            told["image"] = f"<{counted(len(self.image), 'numbers')}>"
        return f"Step({', '.join(f'{name}={text}' for name, text in told.items())})"

    @staticmethod
    def of(
        view: View | None,
        star: Sequence[Any] | None = None,
        where: str = "step",
        action: Action | None = None,
        displacement: Sequence[float] | None = None,
        covariance: Sequence[Sequence[float]] | None = None,
    ) -> Step:
        """A step from a view, or None where it is unknown, and perhaps a star and a displacement. Raises TraceError that says where."""
        a_text("where", where, TraceError)
        seen, openings = (
            _view_or_unknown(view, f"{where}: view"),
            None if star is None else parse_star(star, f"{where}: star"),
        )
        try:
            return Step(seen, action, openings, displacement, covariance)  # type: ignore[arg-type]
        except TraceError as error:
            raise TraceError(f"{where}: {error}") from None

    @property
    def gateways(self) -> Star | None:
        """The star as gateways with bearings."""
        return None if self.star is None else Star.of(self.star)

    @property
    def openings(self) -> Openings | None:
        """The star as (ahead, right, back, left). Raises TraceError where a gateway is in none of these directions, two share one, or one was not observed."""
        star = self.star
        if star is None:
            return None
        if is_four(star) and None not in star:
            return bool(star[0]), bool(star[1]), bool(star[2]), bool(star[3])
        openings = Star.of(star).openings
        if openings is None:
            raise TraceError(
                f"star: expected bearings that fall into different quarters (ahead, right, back, left), each near its middle and observed, "
                f"got {brief(star_to_json(star))}; merge the openings that share a quarter, or take star=gateways (solve --star gateways)"
            )
        return openings

    def to_json(self) -> dict[str, Any]:
        known: dict[str, Any] = {
            "view": self.view,
            "image": list(self.image) if isinstance(self.image, tuple) else self.image,
            "action": self.action.to_json() if self.action else None,
            "star": star_to_json(self.star) if self.star is not None else None,
            "displacement": list(self.displacement) if self.displacement is not None else None,
            "covariance": [list(row) for row in self.covariance]
            if self.covariance is not None
            else None,
            "truth": self.truth,
            "confidence": self.confidence,
        }
        unknown = {"view": None} if self.view is None and self.image is None else {}
        return {**unknown, **{k: v for k, v in known.items() if v is not None}, **self.extra}


@dataclass(frozen=True)
class Trace:
    """A sequence of steps: n + 1 observations with n actions between them. It is immutable, and made by `load` or `from_steps`.

    odometry  how far displacements that come without a covariance may be off; None for the defaults
    """

    steps: tuple[Step, ...]
    name: str | None = None
    images: str | None = None
    odometry: Odometry | None = None
    extra: Mapping[str, Any] = field(default_factory=dict, hash=False)
    source: str | None = field(default=None, compare=False)

    def __post_init__(self) -> None:
        if not isinstance(self.steps, tuple) or not all(
            isinstance(step, Step) for step in self.steps
        ):
            raise TraceError(
                f"steps: expected a tuple of Step, got {brief(self.steps)}; take Trace.from_steps for views and actions"
            )
        if not self.steps:
            raise TraceError(
                f"{named(self.source or 'trace')}: expected at least one step, got none; add what the robot saw first"
            )
        for name in ("name", "images", "source"):
            if getattr(self, name) is not None:
                a_text(name, getattr(self, name), TraceError, mend="give a text, or leave it out")
        if self.odometry is not None:
            an_instance(
                "odometry",
                self.odometry,
                Odometry,
                TraceError,
                mend="make one with Odometry.of, or leave it out",
            )
        an_object("extra", self.extra, TraceError)
        last = len(self.steps) - 1
        types: dict[str, tuple[int, Action]] = {}
        for i, step in enumerate(self.steps):
            action = step.action
            if action is None:
                if i < last:
                    raise TraceError(
                        f"{self.at(i)}: action: expected one, as another step follows; name the action that led to it"
                    )
                continue
            if i == last:
                raise TraceError(
                    f"{self.at(i)}: action: expected none on the last step, got {brief(action.name)}; "
                    f"remove it, or add the step that it led to"
                )
            first, known = types.setdefault(action.name, (i, action))
            if known != action:
                raise TraceError(
                    f"{self.at(i)}: action: {brief(action.name)} has kind {action.kind}, turn {action.turn} here but "
                    f"kind {known.kind}, turn {known.turn} on {self.at(first)}; give the two different names, or the same kind"
                )

    def __len__(self) -> int:
        """Number of steps: one more than there are actions."""
        return len(self.steps)

    def __iter__(self) -> Iterator[Step]:
        return iter(self.steps)

    @overload
    def __getitem__(self, index: int) -> Step: ...

    @overload
    def __getitem__(self, index: slice) -> Trace: ...

    def __getitem__(self, index: int | slice) -> Step | Trace:
        """trace[3] is a step, and trace[:20] a trace: steps in a row, the last without the action that led on, the first without the displacement that led there.

        Negative numbers count from the end, and a slice that reaches beyond the steps is cut, as of a list. Raises RangeError, which names the range, for a step
        that there is not and for a slice without any; TraceError for a slice that leaves steps out.
        """
        if not isinstance(index, slice):
            return self.steps[checked_index(index, len(self), "steps")]
        start, stop, stride = index.indices(len(self))
        if stride != 1:
            raise TraceError(
                f"steps: expected steps in a row, as each action leads to the next one, got a stride of {stride}; leave the stride out"
            )
        if start >= stop:
            raise RangeError(
                f"steps: expected a slice that holds some of 0 to {len(self) - 1}, got {start}:{stop}; a trace has one step at least"
            )
        if not start:
            return self.prefix(stop)
        here = self.prefix(stop).steps[start:]
        # What an error message says of a step is its line in the file, which would be another one.
        return replace(
            self,
            steps=(replace(here[0], displacement=None, covariance=None), *here[1:]),
            source=None,
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
            "displacements": self.has_displacements,
        }
        return f"<Trace{name}: {', '.join(parts)}{''.join(f'; {what}' for what, is_there in there.items() if is_there)}>"

    def _repr_html_(self) -> str:
        """The trace for notebooks: its first steps."""
        card: str = in_output("trace_card")(self)
        return card

    @property
    def views(self) -> tuple[View | None, ...]:
        return tuple(step.view for step in self.steps)

    @cached_property
    def actions(self) -> tuple[Action, ...]:
        return tuple(step.action for step in self.steps if step.action is not None)

    @property
    def has_stars(self) -> bool:
        """Whether any step carries a star."""
        return any(step.star is not None for step in self.steps)

    @cached_property
    def in_quarters(self) -> bool:
        """Whether all stars and turns fit right angles: then a star is four openings."""
        stars = {tuple(step.star) for step in self.steps if step.star is not None}
        return all(Star.of(star).openings is not None for star in stars) and all(
            action.in_quarters for action in set(self.actions)
        )

    @property
    def has_displacements(self) -> bool:
        """Whether any step carries a displacement."""
        return any(step.displacement is not None for step in self.steps)

    def covariance(self, step: int) -> Covariance | None:
        """The covariance of a step's displacement: the one that it came with, or else by the odometry. None where the step has no displacement."""
        here = self.steps[a_whole_number("step", step, RangeError, 0, len(self) - 1)]
        if here.displacement is None or here.covariance is not None:
            return here.covariance
        return (self.odometry or _USUAL).covariance(here.displacement)

    def at(self, step: int) -> str:
        """Where a step is, as an error message says it: file and line, or the number of the step."""
        a_whole_number("step", step, TraceError)
        return f"{named(self.source)}:{step + 2}" if self.source else f"step {step}"

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
        """A trace from n + 1 views (None where a view is unknown), the n actions between them, perhaps n + 1 stars, and perhaps n displacements. Raises TraceError.

        stars          the openings seen at each step, as in Step
        displacements  [dx, dy, dtheta] of each action, in metres and radians; None where one is not known
        covariances    of the displacements, (3, 3) each; None where the odometry tells it
        odometry       how far displacements without a covariance may be off
        """
        if isinstance(actions, str):
            raise TraceError(
                f"actions: expected a list, got {brief(actions)}; give the name of one action after another, as in ['travel']"
            )
        seen, done = _listed(views, "views"), [Action.of(a) for a in _listed(actions, "actions")]
        if len(seen) != len(done) + 1:
            raise TraceError(
                f"trace: expected one view more than actions, got {len(seen)} views and {len(done)} actions; "
                f"each action leads from one view to the next"
            )
        openings = [None] * len(seen) if stars is None else _listed(stars, "stars")
        if len(openings) != len(seen):
            raise TraceError(
                f"trace: expected a star a view, got {len(openings)} stars and {len(seen)} views; give None where none was seen"
            )
        moved, noise = (
            _of_actions(values, what, len(done))
            for values, what in ((displacements, "displacements"), (covariances, "covariances"))
        )
        steps = tuple(
            Step.of(view, star, f"step {i}", done[i] if i < len(done) else None, moved[i], noise[i])
            for i, (view, star) in enumerate(zip(seen, openings, strict=True))
        )
        return cls(steps, name=name, odometry=None if odometry is None else Odometry.of(odometry))

    def without_stars(self) -> Trace:
        """The same trace, as if no openings had been seen."""
        return replace(self, steps=tuple(replace(step, star=None) for step in self.steps))

    def without_displacements(self) -> Trace:
        """The same trace, as if the robot had no odometry."""
        return replace(
            self,
            steps=tuple(replace(step, displacement=None, covariance=None) for step in self.steps),
            odometry=None,
        )

    def without_displacements_at(self, steps: Collection[int]) -> Trace:
        """The same trace, as if the displacements that lead to these steps were not known."""
        unknown = {
            a_whole_number(f"steps[{i}]", step, TraceError)
            for i, step in enumerate(a_list("steps", steps, TraceError))
        }
        if not unknown:
            return self
        return replace(
            self,
            steps=tuple(
                replace(step, displacement=None, covariance=None) if t in unknown else step
                for t, step in enumerate(self.steps)
            ),
        )

    def with_views(
        self, views: Iterable[View | None], confidences: Iterable[float | None] | None = None
    ) -> Trace:
        """This trace with these views, None where one is unknown, and perhaps how probable it is that each is right, one for each step. Raises TraceError."""
        seen = _listed(views, "views")
        sure = [None] * len(seen) if confidences is None else _listed(confidences, "confidences")
        for name, values in (("views", seen), ("confidences", sure)):
            if len(values) != len(self):
                raise TraceError(f"{name}: expected {len(self)}, one a step, got {len(values)}")
        checked = [
            (
                _view_or_unknown(view, f"views[{i}]"),
                None if c is None else _probability(c, f"confidences[{i}]"),
            )
            for i, (view, c) in enumerate(zip(seen, sure, strict=True))
        ]
        return replace(
            self,
            steps=tuple(
                replace(step, view=view, confidence=c)
                for step, (view, c) in zip(self.steps, checked, strict=True)
            ),
        )

    def prefix(self, steps: int) -> Trace:
        """The first `steps` steps of this trace."""
        head = self.steps[: a_whole_number("steps", steps, TraceError, 1)]
        if head:
            head = (*head[:-1], replace(head[-1], action=None))
        return replace(self, steps=head)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Trace:
        """The trace in a JSON Lines file, or on standard input for "-". Raises TraceError with file, line and field."""
        path = a_path("path", path, TraceError)
        source = "standard input" if path == "-" else named(path)
        try:
            if path == "-":
                if sys.stdin is None:
                    raise TraceError(
                        "standard input: expected a trace, got a closed stream; name a file"
                    )
                return _parse(sys.stdin.buffer, source, source)
            with Path(path).open("rb") as file:
                return _parse(file, source, path)
        except TraceError:
            raise
        except OSError as error:
            raise TraceError(
                f"{source}: expected a readable trace file: {error.strerror or error}; check the path"
            ) from None
        except ValueError as error:  # a null character in the path
            raise TraceError(f"{source}: expected the path of a trace file: {error}") from None

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the trace as JSON Lines. A file appears whole or not at all; a device or a pipe is written into. Raises TraceError."""
        path = a_path("path", path, TraceError)
        lines = "".join(line + "\n" for line in self.to_lines())
        try:
            write_file(path, lines.encode("utf-8"))
        except UnicodeEncodeError as error:
            half = f"half a character, \\u{ord(error.object[error.start]):04x}"
            raise TraceError(
                f"trace: expected texts and file names in UTF-8, got {half}; rename it"
            ) from None
        except OSError as error:
            raise TraceError(
                f"{named(path)}: cannot write the trace: {error.strerror or error}; check the folder"
            ) from None
        except ValueError as error:
            raise TraceError(
                f"{brief(str(path))}: cannot write the trace: {error}; name a file"
            ) from None

    @property
    def digest(self) -> str:
        """A short digest of the trace's file, by which a report can name the trace."""
        return hashlib.sha256(
            "\n".join(self.to_lines()).encode("utf-8", "backslashreplace")
        ).hexdigest()[:16]

    def to_lines(self) -> Iterator[str]:
        """The lines of the trace's file: the header, and then a line for each step."""
        header = {"format": FORMAT, "version": VERSION, "name": self.name, "images": self.images}
        odometry = {} if self.odometry is None else {"odometry": self.odometry.to_json()}
        yield _dump(
            {**{k: v for k, v in header.items() if v is not None}, **odometry, **self.extra}
        )
        for step in self.steps:
            yield _dump(step.to_json())


def checked_trace(value: object) -> Trace:
    """The trace that a caller gives. Raises TraceError."""
    if not isinstance(value, Trace):
        raise TraceError(
            f"trace: expected a Trace, got {brief(value)}; make one with Trace.load or Trace.from_steps"
        )
    return value


def _dump(value: Mapping[str, Any]) -> str:
    try:
        return json_line(value)
    except (TypeError, ValueError, RecursionError) as error:
        raise TraceError(
            f"trace: expected what JSON can hold, got {brief(dict(value))} ({error}); mend the field"
        ) from None


def _parse(file: BinaryIO, source: str, path: str) -> Trace:
    """The trace in a file.

    source  what messages call the file
    path    what the trace remembers as its source
    """
    header: dict[str, Any] | None = None
    steps: list[Step] = []
    actions: dict[str, Action] = {}
    empty_line = 0
    number = 0
    while raw := file.readline(LONGEST_LINE + 1):
        number += 1
        where = f"{source}:{number}"
        if len(raw) > LONGEST_LINE:
            raise TraceError(
                f"{where}: line: expected at most {LONGEST_LINE // 2**20} MiB, got more; write one step a line, and big images to a sidecar file"
            )
        if not raw.strip():
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
            f'{source}:1: header: expected {{"format": "{FORMAT}", "version": {VERSION}}}, got an empty file; write the header, then a line a step'
        )
    if not steps:
        raise TraceError(
            f"{source}:2: step: expected at least one after the header, got none; add what the robot saw first"
        )
    extra = {
        k: v
        for k, v in header.items()
        if k not in ("format", "version", "name", "images", "odometry")
    }
    odometry = header.get("odometry")
    return Trace(
        tuple(steps), header.get("name"), header.get("images"), odometry, extra=extra, source=path
    )


def _kind_of_log(raw: bytes) -> str:
    """What a file is that begins with a line, if it is a robot's log, and not a trace; else an empty text."""
    kind = next((kind for magic, kind in _LOGS.items() if raw.startswith(magic)), "")
    return kind or ("lines of CARMEN or g2o" if LINE_OF_A_LOG.match(raw) else "")


def _record(raw: bytes, where: str) -> dict[str, Any]:
    if where.endswith(":1") and (log := _kind_of_log(raw)):
        raise TraceError(
            f"{where}: header: expected a trace, got {log}, as robots' logs are; make a trace of it with ssh-abduction import LOG -o trace.jsonl"
        )
    if where.endswith(":1") and raw.startswith(_MAPS):
        raise TraceError(
            f"{where}: header: expected a trace, got maps, as solve prints them; name the two files in the other order, or solve's trace"
        )
    if b"\0" in raw:
        raise TraceError(
            f"{where}: line: expected text in UTF-8, got a null byte at column {raw.index(0) + 1}; is this a binary file?"
        )
    try:
        record = parse_json(raw.rstrip().decode("utf-8-sig" if where.endswith(":1") else "utf-8"))
    except UnicodeDecodeError as error:
        raise TraceError(
            f"{where}: line: expected text in UTF-8, got the byte 0x{raw[error.start]:02x} at column {error.start + 1}; is this a binary file?"
        ) from None
    except json.JSONDecodeError as error:
        raise TraceError(
            f"{where}: line: expected one JSON object, got broken JSON at column {error.colno} ({error.msg}); mend it there"
        ) from None
    except NotFinite as error:
        raise TraceError(
            f"{where}: {error.field}: expected a finite number, got {error.text}; replace it, or leave the field out"
        ) from None
    except HalfCharacter as error:
        raise TraceError(f"{where}: line: expected text, got {error}") from None
    except ValueError as error:
        raise TraceError(f"{where}: line: expected one JSON object, got {error}") from None
    if not isinstance(record, dict):
        raise TraceError(
            f"{where}: line: expected a JSON object in braces, got {brief(record)}; write one step a line"
        )
    return record


def _header(record: Mapping[str, Any], where: str) -> dict[str, Any]:
    if record.get("format") != FORMAT:
        came = (
            brief(record["format"])
            if "format" in record
            else f"a line without it: {brief(dict(record))}"
        )
        raise TraceError(
            f'{where}: format: expected "{FORMAT}" in a header, got {came}; put {{"format": "{FORMAT}", "version": {VERSION}}} on the first line'
        )
    version = record.get("version")
    if version != VERSION or isinstance(version, bool):
        raise TraceError(
            f"{where}: version: expected {VERSION}, got {brief(version)}; convert the file, or take a newer ssh-abduction"
        )
    for key in ("name", "images"):
        if not isinstance(record.get(key), str | None):
            raise TraceError(
                f"{where}: {key}: expected a text, got {brief(record[key])}; quote it or leave it out"
            )
    if record.get("odometry") is None:
        return dict(record)
    try:
        return {**record, "odometry": Odometry.of(record["odometry"])}
    except TraceError as error:
        raise TraceError(f"{where}: {error}") from None


def _step(record: Mapping[str, Any], where: str, actions: dict[str, Action]) -> Step:
    view = _view(record["view"], f"{where}: view") if record.get("view") is not None else None
    image = _image(record["image"], f"{where}: image") if record.get("image") is not None else None
    if view is None and image is None and "view" not in record:
        raise TraceError(
            f"{where}: view: expected a text or an integer (or an image to make one from), got none; say what the robot saw, or null where that was not logged"
        )
    action = None
    if (raw := record.get("action")) is not None:
        action = _action(raw, f"{where}: action")
        if not action.extra:
            action = (
                actions.setdefault(action.name, action)
                if actions.get(action.name, action) == action
                else action
            )
    star = parse_star(record["star"], f"{where}: star") if record.get("star") is not None else None
    extra = {k: v for k, v in record.items() if k not in _STEP_FIELDS}
    try:
        return Step(
            view,
            action,
            star,
            record.get("displacement"),
            record.get("covariance"),
            image,
            record.get("truth"),
            extra,
            record.get("confidence"),
        )
    except TraceError as error:
        raise TraceError(f"{where}: {error}") from None


def _of_actions(values: Iterable[Any] | None, name: str, actions: int) -> list[Any]:
    """For each step, what belongs to the action that led to it, from one value for each action."""
    listed = [None] * actions if values is None else _listed(values, name)
    if len(listed) != actions:
        raise TraceError(
            f"trace: expected one of {name} for each action, got {len(listed)} and {actions} actions; give None where one is not known"
        )
    return [None, *listed]


def _listed(values: Any, name: str) -> list[Any]:
    if not isinstance(values, Iterable) or isinstance(values, bytes | Mapping):
        raise TraceError(f"{name}: expected a list, got {brief(values)}; give one value a step")
    return list(values)


def _view_or_unknown(value: Any, where: str) -> View | None:
    return None if value is None else _view(value, where)


def _view(value: Any, where: str) -> View:
    if is_whole(value):
        value = int(value)  # numpy's, too
    if isinstance(value, bool) or not isinstance(value, str | int):
        raise TraceError(
            f"{where}: expected a text or an integer, got {brief(value)}; name the view"
        )
    if isinstance(value, int) and not -(2**31) < value < 2**31:
        raise TraceError(
            f"{where}: expected an integer of 32 bits, got {brief(value)}; write it as a text"
        )
    if isinstance(value, str) and "\0" in value:
        raise TraceError(
            f"{where}: expected a text without null characters, got {brief(value)}; rename the view"
        )
    if isinstance(value, str) and not is_writable(value):
        raise TraceError(
            f"{where}: expected a text that UTF-8 can hold, got half a character in {brief(value)}; rename the view"
        )
    return value


def _probability(value: Any, where: str) -> float:
    if not is_finite(value) or not 0 <= value <= 1:
        raise TraceError(
            f"{where}: expected a probability from 0 to 1, got {brief(value)}; leave it out where none is known"
        )
    return float(value)


def _action(value: Any, where: str) -> Action:
    if isinstance(value, str):
        value = {"name": value}
    if not isinstance(value, Mapping):
        raise TraceError(
            f'{where}: expected a name or {{"name": …, "kind": …}}, got {brief(value)}; name the action'
        )
    name, kind, turn, gateway, bearing = (value.get(key) for key in _ACTION_FIELDS)
    standard = STANDARD_ACTIONS.get(name) if isinstance(name, str) else None
    if (
        kind is None
        and turn is None
        and gateway is None
        and bearing is None
        and standard is not None
    ):
        kind, turn = standard.kind, standard.turn
    if kind == "turn" and turn is None and bearing is None and name in _TURNS:
        turn = name
    try:
        extra = {k: v for k, v in value.items() if k not in _ACTION_FIELDS}
        return Action(name, kind, turn, extra, gateway, bearing)  # type: ignore[arg-type]
    except TraceError as error:  # the message of the action names the field, and the file and line are put before it
        raise TraceError(f"{where.removesuffix('action')}{error}") from None


def _numbers(value: Any, where: str) -> list[float]:
    if not isinstance(value, list | tuple):
        raise TraceError(
            f"{where}: expected a list of numbers, got {brief(value)}; write [1, 2, …]"
        )
    for i, x in enumerate(value):
        if not is_finite(x):
            raise TraceError(
                f"{where}[{i}]: expected a finite number, got {brief(x)}; replace it, or leave the field out"
            )
    return [
        x if type(x) in (int, float) else int(x) if is_whole(x) else float(x) for x in value
    ]  # numpy's numbers are no JSON


def _image(value: Any, where: str) -> tuple[float, ...] | int:
    if is_whole(value):
        if value < 0:
            raise TraceError(
                f"{where}: expected an index of 0 or more into the sidecar file, got {value}; count from 0"
            )
        return value
    return tuple(_numbers(value, where))


def _frozen_image(value: Any) -> tuple[float, ...] | int:
    """An image as a step holds it. Of a tuple, as readers make them, the first number alone is looked at: traces are copied often, and panoramas are long."""
    if isinstance(value, tuple) and (not value or is_finite(value[0])):
        return value
    return _image(value.tolist() if hasattr(value, "tolist") else value, "image")


def star_to_json(star: Sequence[Entry]) -> list[Any]:
    return [entry.to_json() if isinstance(entry, Gateway) else entry for entry in star]
