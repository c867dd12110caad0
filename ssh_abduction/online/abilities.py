"""What a robot can do, by what it sees."""

from __future__ import annotations

from collections.abc import Collection

from ssh_abduction.data.trace import Action, Step
from ssh_abduction.rivals.machines import Seen


class Abilities:
    """What a robot can do here, and wherever it sees something.

    Attributes:
        here: The actions that the robot can do now, by name.
        ever: All actions that it could ever do, by name.
    """

    def __init__(self) -> None:
        self.here: dict[str, Action] = {}
        self.ever: dict[str, Action] = {}
        # By view and star, and by view alone.
        self._names: dict[tuple[object, object], set[str]] = {}

    def note(self, seen: Step, can: Collection[Action | str]) -> None:
        """Note what the robot can do at the current step."""
        self.here = {action.name: action for action in map(Action.of, can)}
        self.ever |= self.here
        for star in {seen.star, None}:
            names = self._names.setdefault((seen.view, star), set(self.here))
            names.intersection_update(self.here)

    def names(self, seen: Seen) -> set[str]:
        """The names of the actions that the robot can do wherever it sees this."""
        names = self._names.get((seen.view, seen.star))
        return names or self._names.get((seen.view, None), set())
