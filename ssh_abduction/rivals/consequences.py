"""Predict with a map where an action leads, and what is seen there.

If the action was tried at a dstate, its link is known. Otherwise the axioms, or the order of a
path, may still tell where the action leads:

- A turn, if places have frames (four directions, the slots 0 to 3): it leads to the slot one, two
  or three quarters further clockwise (axiom turn_rotates). At most one dstate has that slot as its
  heading (one_dstate_per_heading). If the map has none, the star there is still known: the star of
  another dstate at the place, rotated by the turns between the two.
- A turn around at a dstate along a path: it leads back along the path (turn_around_reverses), and
  at most one dstate is there (one_dstate_per_course).
- A travel along a path: it leads to the next place in the order of the path. This is only expected,
  because the order of a map is one of several, and an unseen place may lie between.

A star is all openings or gateways that are seen at a step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

from ssh_abduction.data.action import QUARTERS
from ssh_abduction.data.maps import DState, SSHMap
from ssh_abduction.data.star import Star
from ssh_abduction.data.trace import Action
from ssh_abduction.rivals.machines import Seen
from ssh_abduction.theory.theory import Theory

How: TypeAlias = Literal["link", "implied", "expected", "open"]
OF_FRAMES = frozenset({"turn_rotates", "one_dstate_per_heading", "one_heading"})
_OF_COURSES = frozenset({"turn_around_reverses", "one_dstate_per_course"})


@dataclass(frozen=True, slots=True)
class Consequence:
    """The prediction of a map for an action at a dstate."""

    # "link" if the action was tried; "implied" if the axioms imply where it leads; "expected" if
    # the order of a path suggests it; "open" if nothing is known.
    how: How
    dstate: int | None = None  # the dstate that the action leads to; None if unknown
    # The view and star there, as far as they are known; None if nothing is known.
    seen: Seen | None = None

    @property
    def is_sure(self) -> bool:
        """Whether any other outcome of the action refutes the map."""
        return self.how in ("link", "implied")

    def clashes(self, other: Consequence) -> bool:
        """Tell whether every outcome refutes at least one of the two predicting maps."""
        if not (self.is_sure and other.is_sure and self.seen and other.seen):
            return False
        one, two = self.seen, other.seen
        both = ((one.view, two.view), (one.star, two.star))
        return any(None not in pair and pair[0] != pair[1] for pair in both)

    def to_dict(self) -> dict[str, Any]:
        """Return the prediction as plain data, as `next --json` prints it."""
        return {"how": self.how, "dstate": self.dstate} | (
            self.seen.to_dict() if self.seen else {"view": None}
        )


OPEN = Consequence("open")


class Consequences:
    """The predictions of one map.

    Args:
        links: For each dstate, a dict from each action tried there to the dstate it leads to.
        looks: The view and star of each dstate.
        theory: The theory, whose axioms may imply where actions lead; None to use all axioms.
    """

    def __init__(
        self,
        ssh_map: SSHMap,
        links: dict[int, dict[str, int]],
        looks: Sequence[Seen],
        theory: Theory | None,
    ) -> None:
        self._dstates, self._links, self._looks = ssh_map.dstates, links, looks
        headed = [s for s in ssh_map.dstates if s.heading is not None and s.place is not None]
        has_frames = all((s.heading or 0) < 4 for s in headed)
        if theory is not None:
            has_frames = theory.star == "frame" and theory.hard >= OF_FRAMES
        self._framed = {(s.place, s.heading): s.id for s in headed} if has_frames else {}
        self._seen_at = {s.place: s for s in headed} if has_frames else {}  # a dstate at each place
        self._at: dict[tuple[int | None, int | None, int | None], int] = {
            (s.place, s.path, s.direction): s.id
            for s in ssh_map.dstates
            if s.path is not None and s.place is not None
        }
        self._turns_back = theory is None or theory.hard >= _OF_COURSES
        self._orders = {path.id: path.order for path in ssh_map.paths}

    def of(self, dstate: int, action: Action) -> Consequence:
        """Predict where an action leads from a dstate, and what is seen there."""
        there = self._links[dstate].get(action.name)
        if there is not None:
            return self._to(there, "link")
        s = self._dstates[dstate]
        if action.kind == "turn" and action.turn is not None:
            return self._turned(s, action)
        if action.kind == "travel" and s.path is not None:
            return self._travelled(s)
        return OPEN

    def sure_ends(self, actions: Sequence[Action]) -> tuple[tuple[int, str, int], ...]:
        """List the untried turns whose end the axioms imply: (dstate, action, dstate reached)."""
        turns = [action for action in actions if action.kind == "turn"]
        if not (self._framed or (self._turns_back and self._at)):
            return ()
        found = (
            (s.id, action.name, self._turned(s, action))
            for s in self._dstates
            for action in turns
            if action.name not in self._links[s.id]
        )
        return tuple(
            (s, action, says.dstate) for s, action, says in found if says.dstate is not None
        )

    def _turned(self, s: DState, action: Action) -> Consequence:
        """Predict where a turn leads from a dstate that has no link for it."""
        assert action.turn is not None
        if s.place in self._seen_at and s.heading is not None and action.in_quarters:
            slot = (s.heading + QUARTERS[action.turn]) % 4
            if (faced := self._framed.get((s.place, slot))) is not None:
                return self._to(faced, "implied")
            known = self._seen_at[s.place]
            if not _is_four(self._looks[known.id]):
                return OPEN
            openings = self._looks[known.id].star or ()
            turned = (slot - (known.heading or 0)) % 4
            return Consequence("implied", None, Seen(None, openings[turned:] + openings[:turned]))
        if action.turn == "around" and s.path is not None and self._turns_back:
            back = self._at.get((s.place, s.path, -(s.direction or 0)))
            if back is not None:
                return self._to(back, "implied")
        return OPEN

    def _travelled(self, s: DState) -> Consequence:
        """Predict a travel from a dstate that has no link for it: to the next place of its path."""
        order = self._orders.get(s.path or 0, ())
        if s.place not in order:
            return OPEN
        next_one = order.index(s.place) + (s.direction or 0)
        if not 0 <= next_one < len(order):
            return OPEN
        there = self._at.get((order[next_one], s.path, s.direction))
        return OPEN if there is None else self._to(there, "expected")

    def _to(self, dstate: int, how: How) -> Consequence:
        """Predict that an action leads to this dstate."""
        return Consequence(how, dstate, self._looks[dstate])


def _is_four(seen: Seen) -> bool:
    """Tell whether a star is given as four openings: ahead, right, back and left."""
    return (
        seen.star is not None
        and len(seen.star) == 4
        and all(isinstance(entry, bool) for entry in seen.star)
    )


def is_possible(action: Action, seen: Seen) -> bool:
    """Tell whether a star (the openings seen at a place) allows an action; None allows any.

    A travel needs an opening ahead. A turn to a numbered gateway needs that gateway.
    """
    if seen.star is None:
        return True
    if _is_four(seen):
        return action.kind != "travel" or bool(seen.star[0])
    frames = Star.of(seen.star).frames
    if action.kind == "travel":
        return any(frame.faces(slot) for frame in frames for slot in range(frame.slots))
    if action.gateway is not None:
        return any(frame.nth(action.turn, action.gateway) is not None for frame in frames)
    return True
