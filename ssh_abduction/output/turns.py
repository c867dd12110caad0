"""How far actions turn, as far as a trace or a caller says so."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeAlias

from ssh_abduction.data.checks import an_object
from ssh_abduction.data.errors import MapError, brief, is_finite
from ssh_abduction.data.trace import Trace

Turns: TypeAlias = Mapping[str, "str | float"]

# Degrees clockwise of turns with a known side only.
SIDES = {"right": 90.0, "around": 180.0, "left": 270.0}
# The weights of a turn with known degrees, and of one with a known side only.
SURE, GUESSED = 1.0, 0.2


def degrees_of(turns: Trace | Turns | None) -> dict[str, tuple[float, float]]:
    """By how many degrees each action turns.

    Args:
        turns: The trace that was mapped, or for each action's name "right", "left", "around" or
            degrees clockwise. Actions of these three names need none.

    Returns:
        For each action's name the degrees clockwise, and the weight of that: SURE or GUESSED.

    Raises:
        MapError: If a turn is none of these.
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
