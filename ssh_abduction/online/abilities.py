"""Learn which actions a robot can do, and relate them to what it sees."""

from __future__ import annotations

from collections.abc import Collection

from ssh_abduction.data.trace import Action, Step
from ssh_abduction.rivals.machines import Seen


class Abilities:
    """The actions that a robot can do: now, ever, and wherever it sees a view and a star.

    Attributes:
        here: The actions that the robot can do now, by name.
        ever: All actions that the robot could do at some step so far, by name.
    """

    def __init__(self) -> None:
        self.here: dict[str, Action] = {}
        self.ever: dict[str, Action] = {}
        # The names of actions by view and star, and by view alone.
        self._names: dict[tuple[object, object], set[str]] = {}

    def note(self, seen: Step, can: Collection[Action | str]) -> None:
        """Record the actions that the robot can do at the current step.

        Args:
            seen: What the robot sees at this step.
            can: The actions, as objects or names.
        """
        self.here = {action.name: action for action in map(Action.of, can)}
        self.ever |= self.here
        for star in {seen.star, None}:
            names = self._names.setdefault((seen.view, star), set(self.here))
            names.intersection_update(self.here)

    def names(self, seen: Seen) -> set[str]:
        """Return the names of the actions that the robot could do at every step with what is seen.

        The star is the set of openings that are seen. If the robot never saw this star with this
        view, the view alone decides.

        Args:
            seen: A view and a star.
        """
        names = self._names.get((seen.view, seen.star))
        return names or self._names.get((seen.view, None), set())
