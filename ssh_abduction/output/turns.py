"""Find how far each action turns, from the trace or from what the caller says."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeAlias

from ssh_abduction.data.checks import an_object
from ssh_abduction.data.errors import MapError, brief, is_finite
from ssh_abduction.data.trace import Trace

Turns: TypeAlias = Mapping[str, "str | float"]

# Degrees clockwise that are assumed for turns of which only the side is known.
SIDES = {"right": 90.0, "around": 180.0, "left": 270.0}
# The weights of a turn with known degrees, and of a turn of which only the side is known.
SURE, GUESSED = 1.0, 0.2


def degrees_of(turns: Trace | Turns | None) -> dict[str, tuple[float, float]]:
    """Find by how many degrees each action turns.

    Args:
        turns: The trace that was mapped; or a dict that gives for names of actions "right", "left",
            "around" or degrees clockwise. Actions that are themselves named right, left or around
            need no entry.

    Returns:
        For each action's name, the degrees clockwise, and their weight: SURE if the degrees are
        known, GUESSED if only the side is known.

    Raises:
        MapError: A value of `turns` is none of these.
    """
    known: dict[str, str | float] = {name: name for name in SIDES}
    if isinstance(turns, Trace):
        known |= {
            action.name: (action.turn or "") if action.bearing is None else action.bearing
            for action in turns.actions
            if action.turn is not None
        }
    elif turns is not None:
        known |= an_object("turns", turns, MapError)
    degrees = {}
    for name, turn in known.items():
        if isinstance(turn, str) and turn in SIDES:
            degrees[name] = (SIDES[turn], GUESSED)
        elif is_finite(turn):
            degrees[name] = (float(turn), SURE)
        else:
            raise MapError(
                f'turns[{brief(name)}]: expected "right", "left", "around" or degrees clockwise, '
                f"got {brief(turn)}; say which"
            )
    return degrees
