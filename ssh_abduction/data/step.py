"""Steps of a trace: what a robot observed at one moment, and the action that it took next."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from ssh_abduction.data.action import Action
from ssh_abduction.data.checks import (
    View,
    a_text,
    an_instance,
    an_object,
    checked_probability,
    checked_view,
    frozen_image,
)
from ssh_abduction.data.errors import TraceError, brief, said_of
from ssh_abduction.data.odometry import (
    Covariance,
    Displacement,
    checked_covariance,
    checked_displacement,
)
from ssh_abduction.data.schema import set_checked
from ssh_abduction.data.star import Entry, Openings, Star, is_four, parse_star, star_to_json
from ssh_abduction.data.words import counted, that_differ

SEEN = "star_seen"  # the field of a step that keeps the star before a person corrected it


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

    view: View | None = None
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
            view=checked_view,
            action=_an_action,
            extra=lambda extra, name: an_object(name, extra, TraceError),
            image=frozen_image,
            confidence=checked_probability,
            star=parse_star,
            displacement=lambda displacement, _: checked_displacement(displacement),
            covariance=lambda covariance, _: checked_covariance(covariance),
        )
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
        view: View | None,
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
        a_text("where", where, TraceError)
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
        """Return the step as a dict, as a line of a trace file has it."""
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
    return an_instance(name, value, Action, TraceError, mend='make one with Action.of("travel")')


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
