"""Stances (places and headings where a robot may stand) and the moves between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

from ssh_abduction.data.action import QUARTERS
from ssh_abduction.data.groups import firsts, gathered
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.star import Frame, Star, angle_between
from ssh_abduction.data.trace import Action, Trace
from ssh_abduction.rivals.consequences import OF_FRAMES, is_possible
from ssh_abduction.rivals.machines import Can, Seen, leads_of
from ssh_abduction.theory.theory import Theory

How: TypeAlias = Literal["known", "implied", "expected", "unknown"]
# The cost of an unknown move in actions: go there, turn around, and come back.
THERE_AND_BACK = 3
AROUND = Action.of("around")


@dataclass(frozen=True, slots=True)
class StanceMove:
    """An action that leads from one stance to another."""

    source: int  # the number of the stance before the action
    action: Action
    # The number of the stance after the action. If `how` is "unknown", this is a guess: a travel
    # comes back through the same gateway, and any other action changes nothing.
    target: int
    # How the target is known. "known": the action was tried. "implied": the axioms imply it, for a
    # turn at a place with a frame. "expected": a turn by the angle that the star shows, or a travel
    # back the way that the robot came. "unknown": anything else.
    how: How

    @property
    def cost(self) -> int:
        """The cost as a number of actions."""
        return THERE_AND_BACK if self.how == "unknown" else 1

    @property
    def is_untried(self) -> bool:
        """Whether a tour has to make the move: it is unknown, or a travel expected to lead back."""
        return self.how == "unknown" or (self.how == "expected" and self.action.kind != "turn")


class Stances:
    """The stances of a map: places and headings where a robot may stand.

    The first stances are the dstates of the map, with the same numbers. The robot was never in the
    others: turns lead there from dstates. Parameters as in `next_tour`.
    """

    def __init__(
        self,
        ssh_map: SSHMap,
        trace: Trace,
        theory: Theory,
        actions: Sequence[Action],
        can: Can | None,
    ) -> None:
        self._links = leads_of(ssh_map, 0)
        known = (*actions, *trace.actions)
        self._actions = {action.name: action for action in known if not action.starts}
        self._can = can
        self._implies = theory.star == "frame" and theory.hard >= OF_FRAMES
        first = firsts(zip(ssh_map.dstate_at, trace.steps, strict=True))
        self._looks = [first[s.id] for s in ssh_map.dstates]
        self._stars = [
            Star.of(step.star) if step.star is not None and theory.star != "none" else None
            for step in self._looks
        ]
        self._frames = [_frame(star) for star in self._stars]
        # for each stance its room, and the heading in the room in degrees clockwise
        self._at: list[tuple[int, float]] = [
            (s.place or 0, 90.0 * (s.heading or 0)) for s in ssh_map.dstates
        ]
        if not self._implies or any(s.heading is None for s in ssh_map.dstates):
            self._at = self._rooms()
        # the stances in each room
        self._in = gathered((room, n) for n, (room, _) in enumerate(self._at))
        self._back: dict[int, int] = {}  # where a travel from a stance leads if it leads back

    def moves(self) -> list[StanceMove]:
        """List all moves from all stances (place, heading). This adds stances never seen before."""
        for source, tried in self._links.items():
            for name, target in tried.items():
                has_stars = self._frames[source] and self._frames[target]
                if self._actions[name].kind == "travel" and has_stars:
                    self._back.setdefault(self._around(target), self._around(source))
        found: list[StanceMove] = []
        for n, _ in enumerate(self._at):  # the list grows
            found += (self._move(n, action) for action in self._possible(n))
        return found

    def _rooms(self) -> list[tuple[int, float]]:
        """Return the room and the heading, in degrees clockwise, of each dstate.

        Dstates that are linked by turns are one room. Their headings differ by the angles of the
        turns. The first dstate of a room faces 0 degrees.
        """
        turns: dict[int, list[tuple[int, float]]] = {n: [] for n in self._links}
        for n, tried in self._links.items():
            for name, target in tried.items():
                action = self._actions[name]
                degrees = _degrees(action, self._frames[n]) if action.kind == "turn" else None
                if degrees is not None:
                    turns[n].append((target, degrees))
                    turns[target].append((n, -degrees))
        # each connected group of dstates is a room, in which the first one faces 0 degrees
        at: dict[int, tuple[int, float]] = {}
        for n in turns:
            if n in at:
                continue
            at[n] = n, 0.0
            queue = [n]
            for source in queue:
                for target, degrees in turns[source]:
                    if target not in at:
                        at[target] = n, (at[source][1] + degrees) % 360
                        queue.append(target)
        return [at[n] for n in sorted(at)]

    def _possible(self, n: int) -> list[Action]:
        """List the possible actions in stance n. If it was never seen, its star is predicted."""
        if n < len(self._looks):
            step = self._looks[n]
            seen = Seen(step.view, step.star if self._stars[n] else None)
            can = {*self._actions} if self._can is None else {*self._can(seen)}
            return [
                action
                for name, action in self._actions.items()
                if name in self._links[n] or (name in can and is_possible(action, seen))
            ]
        frame = self._frames[n]
        assert frame is not None
        return [
            action
            for action in self._actions.values()
            if (action.kind == "travel" and _faces(frame) is not None)
            or (action.kind == "turn" and _degrees(action, frame) is not None)
        ]

    def _move(self, n: int, action: Action) -> StanceMove:
        """Make the move for an action in stance n."""
        if n < len(self._links) and action.name in self._links[n]:
            return StanceMove(n, action, self._links[n][action.name], "known")
        frame = self._frames[n]
        if frame is not None and action.kind == "travel":
            if n in self._back:
                return StanceMove(n, action, self._back[n], "expected")
            return StanceMove(n, action, self._around(n), "unknown")
        degrees = _degrees(action, frame) if action.kind == "turn" else None
        if degrees is None:
            return StanceMove(n, action, n, "unknown")
        how: How = "implied" if self._implies and action.in_quarters else "expected"
        return StanceMove(n, action, self._turned(n, degrees), how)

    def _around(self, n: int) -> int:
        """Find the stance (place and heading) that a turn around leads to from stance n."""
        degrees = _degrees(AROUND, self._frames[n])
        assert degrees is not None
        return self._turned(n, degrees)

    def _turned(self, n: int, degrees: float) -> int:
        """Find the stance after a clockwise turn of this many degrees from stance n.

        If all stances of the room differ from that heading by more than the spread of bearings in
        the star, a new stance is added.
        """
        (room, before), star, frame = self._at[n], self._stars[n], self._frames[n]
        assert star is not None
        assert frame is not None
        goal = (before + degrees) % 360
        near = min(self._in[room], key=lambda m: angle_between(self._at[m][1], goal))
        if angle_between(self._at[near][1], goal) <= max(frame.spreads, default=0):
            return near
        self._at.append((room, goal))
        self._in[room].append(len(self._at) - 1)
        turned = Star(tuple(replace(g, bearing=(g.bearing - degrees) % 360) for g in star.gateways))
        self._stars.append(turned)
        self._frames.append(_frame(turned))
        return len(self._at) - 1


def _frame(star: Star | None) -> Frame | None:
    """Return the first frame (reading of the gateways) of a star; None without a star."""
    return None if star is None else star.frames[0]


def _faces(frame: Frame) -> int | None:
    """Find the slot (direction of a place) that the robot faces; None if it faces none."""
    return next((slot for slot in range(frame.slots) if frame.faces(slot)), None)


def _degrees(action: Action, frame: Frame | None) -> float | None:
    """Find by how many degrees clockwise a turn goes; None if the star does not show it."""
    if frame is None or action.bearing is not None:
        return action.bearing
    if action.gateway is not None:
        slot = frame.nth(action.turn, action.gateway)
        return None if slot is None else frame.bearings[slot]
    if action.turn == "around":
        faced = _faces(frame)
        opposite = None if faced is None else frame.opposite[faced]
        behind = next((slot for slot in range(frame.slots) if frame.has_behind(slot)), opposite)
        return 180.0 if behind is None else frame.bearings[behind if opposite is None else opposite]
    return 90.0 * QUARTERS[action.turn or "right"]
