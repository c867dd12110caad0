"""Change the schedule of searches in a test."""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import replace
from typing import Any
from unittest.mock import patch

from ssh_abduction.solver import Search, schedule
from ssh_abduction.solver.costs.weighing import Weighing

STEPWISE = schedule.turn("prefixes").most


def turn_with(name: str, **changes: Any) -> AbstractContextManager[Any]:
    """Change a turn inside a `with` block."""
    return patch.dict(schedule.TURNS, {name: replace(schedule.TURNS[name], **changes)})


def stepwise(most: float) -> AbstractContextManager[Any]:
    """Let searches go step by step for at most this many units of work inside a `with` block."""
    turn = schedule.turn("prefixes")
    return turn_with("prefixes", most=min(most, turn.most))


def guessed(search: Search) -> Weighing:
    """Run the guesses of a search, and return what they know about costs."""
    weighing = search._weighing
    assert weighing is not None
    search._run(weighing.beams.sources(lambda: False), weighing)
    return weighing
