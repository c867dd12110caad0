"""Guess and mend maps while the robot drives, for when clingo finds no minimal map in time.

To mend a map is to change it so that it fits a step that contradicts it.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.online.options import StepOptions
from ssh_abduction.solver import AT_ONCE
from ssh_abduction.theory.speedups import row
from ssh_abduction.theory.theory import Theory

if TYPE_CHECKING:
    from ssh_abduction.online.background_guess import MapGuess

# Maps are guessed from this many steps on. Clingo solves shorter traces in time.
GUESSED = 100
# The trace grows by this factor before the next guess. A guess takes seconds, and a few more steps
# hardly improve it.
GUESS_AGAIN = 1.05
# A first estimate: mending takes this many seconds times the square of the number of steps.
MENDING = 5e-7


class Guesser:
    """Makes maps of a growing trace, from guesses and by mending maps.

    A map is mended at once if the step has time for that, and in another process otherwise. That
    process also makes maps from guesses, one after the other.

    Args:
        trace: The steps so far.
        options: The time limit and the other options of a step.
    """

    def __init__(self, trace: Trace, options: StepOptions) -> None:
        self.options = options
        self.guess: MapGuess | None = None  # under way in another process
        self._steps = list(trace.steps)  # a guess under way sees the steps that are appended
        self._next_guess = GUESSED  # no guess before the trace has this many steps
        self._mending = MENDING

    def follow(self, trace: Trace) -> None:
        """Add the last step of a trace, which has one step more than before."""
        self._steps[-1:] = trace.steps[-2:]

    def finished(self) -> SSHMap | None:
        """Take the map that the other process made; None if it is not done, or found none.

        The map may lack the last steps of the trace.
        """
        if self.guess and self.guess.done():
            guess, self.guess = self.guess, None
            return guess.result()
        return None

    def suits(self, theory: Theory) -> bool:
        """Whether to guess maps.

        Steps need a time limit, the theory has to allow guesses, and the trace may not be too long.
        """
        return (
            self.options.time_limit is not None
            and row("visits").holds_for(theory)
            and len(self._steps) <= AT_ONCE
        )

    def mend_or_guess(
        self, trace: Trace, theory: Theory, contradicted: SSHMap | None, began: float
    ) -> SSHMap | None:
        """Mend a contradicted map at once, or start a guess in another process.

        A map is mended at once if this step has time for it. Otherwise start to mend the map, or to
        make one from a guess if that is due, in another process.

        Args:
            trace: The steps so far.
            theory: The theory, in which no field is "auto".
            contradicted: The best map of the steps before the last, if the last step contradicts
                all known maps; else None.
            began: When the step began, by `time.perf_counter`.

        Returns:
            The mended map of all steps; None if none was made at once.
        """
        steps, now = len(trace), time.perf_counter()
        assert self.options.time_limit is not None
        left = self.options.time_limit - (now - began)
        if contradicted and self._mending * steps**2 <= left:
            from ssh_abduction.online.background_guess import mended_map  # loads numpy

            mended = mended_map(trace, theory, contradicted, self.options.speedups)
            self._mending = (time.perf_counter() - now) / steps**2
            return mended
        if not self.guess and (contradicted or steps >= self._next_guess):
            self._begin(trace, theory, contradicted)
        return None

    def _begin(self, trace: Trace, theory: Theory, known: SSHMap | None) -> None:
        """Start to mend `known`, or without it to guess a map, in another process."""
        from ssh_abduction.online.background_guess import MapGuess  # loads numpy

        if not known:
            self._next_guess = int(GUESS_AGAIN * len(trace))
        self.guess = MapGuess.begun(
            self._steps, trace.odometry, theory, self.options.speedups, known
        )
