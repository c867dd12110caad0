"""Steps: what a robot observed at one moment, and the action that it took next."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from ssh_abduction.data.action import Action
from ssh_abduction.data.checks import a_text, an_instance, an_object
from ssh_abduction.data.errors import TraceError, brief
from ssh_abduction.data.observation import (
    View,
    checked_probability,
    checked_view,
    frozen_image,
    view_or_unknown,
)
from ssh_abduction.data.odometry import (
    Covariance,
    Displacement,
    checked_covariance,
    checked_displacement,
)
from ssh_abduction.data.star import Entry, Openings, Star, is_four, parse_star, star_to_json
from ssh_abduction.data.words import counted, that_differ


@dataclass(frozen=True, slots=True)
class Step:
    """What was observed at one moment, and the action taken next.

    Attributes:
        view: The name or number of the view; None if it is unknown, or only an image is known.
        action: The action taken next; None on the last step of a trace.
        star: The openings ahead, right, back and left as four 0/1, None if not observed; or
            their bearings in degrees, clockwise from ahead; or Gateways.
        displacement: (dx, dy, dtheta) from the step before, in metres and radians, in the frame
            that the robot had there: x ahead, y left, counterclockwise. It has no meaning on the
            first step.
        covariance: Of the displacement, (3, 3). Without one the trace's odometry gives it.
        image: Ranges in metres, or an index into the header's sidecar file.
        truth: For evaluation only; nothing that infers reads it.
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

    def __post_init__(self) -> None:
        # Replace each field by its checked value. The dataclass is frozen.
        if self.view is not None:
            object.__setattr__(self, "view", checked_view(self.view, "view"))
        if self.action is not None:
            an_instance(
                "action", self.action, Action, TraceError, mend='make one with Action.of("travel")'
            )
        an_object("extra", self.extra, TraceError)
        if self.image is not None:
            object.__setattr__(self, "image", frozen_image(self.image))
        if self.confidence is not None:
            sure = checked_probability(self.confidence, "confidence")
            object.__setattr__(self, "confidence", sure)
        if self.star is not None:
            object.__setattr__(self, "star", parse_star(self.star, "star"))
        if self.displacement is not None:
            moved = checked_displacement(self.displacement, "displacement")
            object.__setattr__(self, "displacement", moved)
        if self.covariance is not None:
            if self.displacement is None:
                raise TraceError(
                    "covariance: expected a displacement that it belongs to, got none; "
                    "add it, or leave the covariance out"
                )
            noise = checked_covariance(self.covariance, "covariance")
            object.__setattr__(self, "covariance", noise)

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
        """A step. Its errors begin with `where`. The other arguments are the fields of a step.

        Raises:
            TraceError: If a field is wrong.
        """
        a_text("where", where, TraceError)
        seen = view_or_unknown(view, f"{where}: view")
        openings = None if star is None else parse_star(star, f"{where}: star")
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
        """The star as (ahead, right, back, left).

        Raises:
            TraceError: If a gateway is in none of these directions or was not observed, or two
                gateways share one.
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
                f"the openings that share a quarter, or take star=gateways (solve --star gateways)"
            )
        return openings

    def to_json(self) -> dict[str, Any]:
        """The step as plain data, as a line of a trace file holds it."""
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
