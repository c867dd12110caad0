"""Steps of a trace: what a robot observed at one moment, and the action that it took next.

An action takes the robot from one distinctive state (a place and a heading) to another.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, TypeAlias

from ssh_abduction.data import checks
from ssh_abduction.data.errors import TraceError, brief, is_finite, is_whole, is_writable, said_of
from ssh_abduction.data.odometry import (
    Covariance,
    Displacement,
    checked_covariance,
    checked_displacement,
)
from ssh_abduction.data.schema import set_checked
from ssh_abduction.data.star import (
    SPREAD,
    Entry,
    Openings,
    Star,
    is_four,
    near_quarter,
    parse_star,
    star_to_json,
)
from ssh_abduction.data.words import counted, that_differ

Kind: TypeAlias = Literal["travel", "turn", "lift", "stairs", "start"]
TurnDirection: TypeAlias = Literal["right", "left", "around"]

_KINDS = ("travel", "turn", "lift", "stairs", "start")
_TURNS = ("right", "left", "around")
_FIELDS = ("name", "kind", "turn", "gateway", "bearing")
# The right angles clockwise of the turns that have standard names, and the degrees.
QUARTERS: dict[str | None, int] = {"right": 1, "around": 2, "left": 3}
TURN_DEGREES = {"right": 90.0, "around": 180.0, "left": 270.0}
SEEN = "star_seen"  # the field of a step that keeps the star before a person corrected it


@dataclass(frozen=True, slots=True)
class Action:
    """A sequence of control laws that takes the robot from one distinctive state to another.

    The causal axioms read the name only. The topological axioms read `kind` and `turn`.

    Attributes:
        name: The name. Actions of a trace with the same name must be equal.
        kind: "travel", "turn", or None for other actions. A "lift" or "stairs" leads to another
            floor. "start" is no action of the robot: the next step begins another drive, and may be
            anywhere. The name of the action is then the name of this drive.
        turn: The direction of a turn: "right", "left" or "around".
        extra: Fields of the trace file that this package does not know.
        gateway: For a turn right or left, the number of the gateway (way out of a place) that it
            ends at. Gateways are counted from 1 in the direction of the turn. One straight ahead is
            not counted.
        bearing: The angle of a turn in degrees, clockwise. If it is given, it sets `turn`.
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
        if kind is not None:
            checks.one_of(
                "action.kind", kind, _KINDS, TraceError, mend="leave it out for other actions"
            )
        if turn is not None:
            checks.one_of("action.turn", turn, _TURNS, TraceError, mend="choose the nearest")
        if turn is not None and kind != "turn":
            raise TraceError(
                f'action.kind: expected "turn", as the action has a turn, got {brief(kind)}; '
                f"set the kind or drop the turn"
            )
        checks.an_object("action.extra", self.extra, TraceError)
        if self.bearing is not None:  # says which way the turn goes
            turn = self._turn_of_bearing()
            object.__setattr__(self, "turn", turn)
        if kind == "turn" and turn is None:
            raise TraceError(
                'action.turn: expected "right", "left" or "around" for a turn, got none; '
                "say which way it goes"
            )
        if self.gateway is not None and (
            not is_whole(self.gateway) or self.gateway < 1 or turn not in ("right", "left")
        ):
            raise TraceError(
                f"action.gateway: expected 1 or more, for a turn right or left, "
                f"got {brief(self.gateway)}; give the number of the gateway on that side, from 1 on"
            )
        # Replace texts and numbers of numpy by Python's own.
        for name in _FIELDS:
            if (value := getattr(self, name)) is not None:
                plain = (
                    checks.plain_text(value)
                    if isinstance(value, str)
                    else checks.plain_number(value)
                )
                object.__setattr__(self, name, plain)

    def _turn_of_bearing(self) -> TurnDirection:
        """Return the direction of a turn by `bearing` degrees, or raise TraceError."""
        if self.kind != "turn" or not is_finite(self.bearing):
            raise TraceError(
                "action.bearing: expected degrees clockwise, and only for a turn, "
                f"got {brief(self.bearing)}; leave it out elsewhere"
            )
        assert self.bearing is not None
        degrees = self.bearing % 360
        turn: TurnDirection = "right" if degrees < 180 else "left"
        if abs(degrees - 180) <= SPREAD:
            turn = "around"
        is_no_turn = min(degrees, 360 - degrees) <= SPREAD
        if is_no_turn or self.turn not in (None, turn):
            raise TraceError(
                f"action.bearing: expected degrees of a turn {self.turn or ''}, "
                f"got {brief(self.bearing)}, which is {'no turn' if is_no_turn else turn}; mend it"
            )
        return turn

    @staticmethod
    def that_slipped(step: int) -> Action:
        """Make the action that takes the place of one that did not do what its name says.

        Args:
            step: The step where the action was done. Its number is in the name of the new action,
                so that the new actions of two steps differ.
        """
        number = checks.a_whole_number("step", step, TraceError)
        return Action(f"slipped at step {number}", extra={"slipped": True})

    @property
    def slipped(self) -> bool:
        """Whether this action was made by `that_slipped`."""
        return self.kind is None and self.extra.get("slipped") is True

    @property
    def starts(self) -> bool:
        """Whether the next step begins another drive."""
        return self.kind == "start"

    @property
    def changes_floor(self) -> bool:
        """Whether the next step is on another floor."""
        return self.kind in ("lift", "stairs")

    @property
    def breaks_frame(self) -> bool:
        """Whether the next step has a frame of its own: on another floor, or of another drive."""
        return self.starts or self.changes_floor

    @property
    def unlinked(self) -> bool:
        """Whether nothing is known of how the next step relates to this one.

        This holds if the action slipped, or if the next step begins another drive.
        """
        return self.starts or self.slipped

    @property
    def leaves_paths(self) -> bool:
        """Whether this action leads off all paths: the next step may be at any place.

        This holds for a lift, an action that slipped, and the start of another drive.
        """
        return self.unlinked or self.changes_floor

    @property
    def in_quarters(self) -> bool:
        """Whether right angles describe this action.

        True unless it names a gateway, or its bearing is not near the right angle of its turn.
        """
        if self.gateway is not None:
            return False
        if self.bearing is None:
            return True
        slot = near_quarter(self.bearing)
        return slot is not None and QUARTERS.get(self.turn, 0) == slot

    @staticmethod
    def of(value: Action | str | Mapping[str, Any]) -> Action:
        """Make an action from its name, or from a mapping with some of its fields.

        The names travel, right, left and around also set `kind` and `turn`.

        Raises:
            TraceError: If a field is wrong.
        """
        return value if isinstance(value, Action) else parse_action(value, "action")

    def to_json(self) -> Any:
        """Return the name, or a dict with the fields if the name does not say everything."""
        if self == STANDARD_ACTIONS.get(self.name, Action(self.name)) and not self.extra:
            return self.name
        known = {name: getattr(self, name) for name in _FIELDS}
        return {**{k: v for k, v in known.items() if v is not None}, **self.extra}


# Actions whose names determine their kinds and turns.
STANDARD_ACTIONS: dict[str, Action] = {
    "travel": Action("travel", "travel"),
    "right": Action("right", "turn", "right"),
    "left": Action("left", "turn", "left"),
    "around": Action("around", "turn", "around"),
}


def parse_action(value: Any, where: str) -> Action:
    """Make an action from its name, or from an object with its fields. Raises TraceError.

    `where` has file, line and field, for messages.
    """
    if isinstance(value, str):
        value = {"name": value}
    if not isinstance(value, Mapping):
        raise TraceError(
            f'{where}: expected a name or {{"name": …, "kind": …}}, got {brief(value)}; '
            f"name the action"
        )
    name, kind, turn, gateway, bearing = (value.get(key) for key in _FIELDS)
    # The name of a standard action sets kind and turn, if no other field is given.
    standard = STANDARD_ACTIONS.get(name) if isinstance(name, str) else None
    if standard is not None and kind is turn is gateway is bearing is None:
        kind, turn = standard.kind, standard.turn
    if kind == "turn" and turn is None and bearing is None and name in _TURNS:
        turn = name
    try:
        extra = {k: v for k, v in value.items() if k not in _FIELDS}
        return Action(name, kind, turn, extra, gateway, bearing)  # type: ignore[arg-type]
    except TraceError as error:  # its message begins with the field: "action.kind: …"
        raise TraceError(f"{where.removesuffix('action')}{error}") from None


@dataclass(frozen=True, slots=True)
class Step:
    """What was observed at one moment, and the action taken next.

    Attributes:
        view: The name or number of the view; None if it is unknown, or only an image is known.
        action: The action taken next; None on the last step of a trace.
        star: The openings seen. Either four of 0, 1 or None: ahead, right, back and left, None if
            not observed. Or one entry for each opening: its bearing in degrees, clockwise from
            ahead, or a Gateway. None if no openings were recorded.
        displacement: (dx, dy, dtheta) since the step before, in metres and radians, in the frame
            of the robot at that step: x ahead, y left, dtheta counterclockwise. It has no meaning
            on the first step.
        covariance: The covariance of the displacement, 3 x 3. If it is None, the odometry of the
            trace gives one.
        image: Ranges in metres, or an index into the sidecar file that the header names.
        truth: What is really the case, such as the true place; for evaluation only. No inference
            reads it.
        extra: Fields of the trace file that this package does not know.
        confidence: The probability, from 0 to 1, that the view and the star are right. If faults
            are allowed, it scales the cost of ignoring them.
    """

    view: checks.View | None = None
    action: Action | None = None
    star: tuple[Entry, ...] | None = None
    displacement: Displacement | None = None
    covariance: Covariance | None = None
    image: tuple[float, ...] | int | None = None
    truth: Any = field(default=None, hash=False)
    extra: Mapping[str, Any] = field(default_factory=dict, hash=False)
    confidence: float | None = None
    gateways: Star | None = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        set_checked(
            self,
            view=checks.checked_view,
            action=_an_action,
            image=checks.checked_image,
            confidence=checks.checked_probability,
            star=parse_star,
            displacement=lambda displacement, _: checked_displacement(displacement),
            covariance=lambda covariance, _: checked_covariance(covariance),
        )
        checks.an_object("extra", self.extra, TraceError)
        object.__setattr__(self, "gateways", None if self.star is None else Star.of(self.star))
        if self.covariance is not None and self.displacement is None:
            raise TraceError(
                "covariance: expected a displacement at the same step, got none; add the "
                "displacement, or leave the covariance out"
            )

    def __repr__(self) -> str:
        texts = that_differ(self)
        if self.action is not None:
            texts["action"] = repr(self.action.name)
        if isinstance(self.image, tuple):
            texts["image"] = f"<{counted(len(self.image), 'numbers')}>"
        return f"Step({', '.join(f'{name}={text}' for name, text in texts.items())})"

    def as_seen(self) -> Step:
        """Return the step with the star that the robot saw, before a person corrected it."""
        if SEEN not in self.extra:
            return self
        extra = {name: value for name, value in self.extra.items() if name != SEEN}
        return replace(self, star=parse_star(self.extra[SEEN], SEEN), extra=extra)

    @staticmethod
    def of(
        view: checks.View | None,
        star: Sequence[Any] | None = None,
        where: str = "step",
        action: Action | None = None,
        displacement: Sequence[float] | None = None,
        covariance: Sequence[Sequence[float]] | None = None,
    ) -> Step:
        """Make a step from some of its fields.

        Args:
            view: The view; None if it is unknown.
            star: The openings seen, as in Step.
            where: The name of the step in error messages.
            action: The action taken next.
            displacement: (dx, dy, dtheta) since the step before, in metres and radians.
            covariance: The covariance of the displacement, 3 x 3.

        Raises:
            TraceError: If a field is wrong.
        """
        checks.a_text("where", where, TraceError)
        with said_of(where):
            return Step(view, action, star, displacement, covariance)  # type: ignore[arg-type]

    @property
    def openings(self) -> Openings | None:
        """Four flags: is there an opening ahead, right, back and left? None if there is no star.

        Raises:
            TraceError: If a gateway was not observed or is near none of these directions, or if two
                gateways are near the same one.
        """
        star = self.star
        if star is None:
            return None
        if is_four(star) and None not in star:
            return bool(star[0]), bool(star[1]), bool(star[2]), bool(star[3])
        openings = Star.of(star).openings
        if openings is None:
            raise TraceError(
                f"star: expected bearings that fall into different quarters (ahead, right, back, "
                f"left), each near its middle and observed, got {brief(star_to_json(star))}; merge "
                "the openings that share a quarter, or take star=gateways (solve --set "
                "star=gateways)"
            )
        return openings

    def to_json(self) -> dict[str, Any]:
        """Return the step as a dict with the fields of a line of a trace file."""
        known: dict[str, Any] = {
            "view": self.view,
            "image": list(self.image) if isinstance(self.image, tuple) else self.image,
            "action": self.action and self.action.to_json(),
            "star": None if self.star is None else star_to_json(self.star),
            "displacement": self.displacement and list(self.displacement),
            "covariance": self.covariance and [list(row) for row in self.covariance],
            "truth": self.truth,
            "confidence": self.confidence,
        }
        unknown = {"view": None} if self.view is None and self.image is None else {}
        return {**unknown, **{k: v for k, v in known.items() if v is not None}, **self.extra}


def _an_action(value: object, name: str) -> Action:
    return checks.an_instance(
        name, value, Action, TraceError, mend='make one with Action.of("travel")'
    )


def one_each(values: Iterable[Any] | None, name: str, count: int, each: str = "step") -> list[Any]:
    """Return a list of one value for each step or action; of None if no values are given."""
    found = [None] * count if values is None else as_list(values, name)
    if len(found) != count:
        raise TraceError(
            f"{name}: expected one per {each}, {count}, got {len(found)}; give None where one is "
            "not known"
        )
    return found


def as_list(values: Any, name: str) -> list[Any]:
    """Return an iterable as a list. A text becomes a list of its letters, which are views."""
    if not isinstance(values, Iterable) or isinstance(values, bytes | Mapping):
        raise TraceError(f"{name}: expected a list, got {brief(values)}; give one value per step")
    return list(values)
