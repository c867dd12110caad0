"""Guesses and mends maps while the robot drives, if clingo finds no minimal map in time."""

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
    """Makes maps of a growing trace: from guesses, and by mending contradicted maps.

    A map is mended at once if a step has time for that, and else in another process, where also
    one guess after another becomes a map.

    Args:
        trace: The steps so far.
        options: What a step may use.
    """

    def __init__(self, trace: Trace, options: StepOptions) -> None:
        self.options = options
        self.guess: MapGuess | None = None  # under way in another process
        self._steps = list(trace.steps)  # a guess under way sees the steps that are appended
        self._next_guess = GUESSED  # no guess before the trace has this many steps
        self._mending = MENDING

    def follow(self, trace: Trace) -> None:
        """Take in the last step of a trace."""
        self._steps[-1:] = trace.steps[-2:]

    def finished(self) -> SSHMap | None:
        """The map of the guess under way, if it is done. It may lack the last steps."""
        if self.guess and self.guess.done():
            guess, self.guess = self.guess, None
            return guess.result()
        return None

    def suits(self, theory: Theory) -> bool:
        """Whether maps can be guessed for a theory, and the steps are few enough for that."""
        return (
            self.options.time_limit is not None
            and row("visits").holds_for(theory)
            and len(self._steps) <= AT_ONCE
        )

    def mend_or_guess(
        self, trace: Trace, theory: Theory, contradicted: SSHMap | None, began: float
    ) -> SSHMap | None:
        """Mend a contradicted map if this step has time for it; else begin a guess, if one is due.

        Args:
            trace: The steps so far.
            theory: The theory without `auto`.
            contradicted: The best map so far, if the last step contradicts it.
            began: When the step began, by `time.perf_counter`.

        Returns:
            The mended map of all steps, if there is one.
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
        """Begin to guess a map, or to mend a known one, in another process."""
        from ssh_abduction.online.background_guess import MapGuess  # loads numpy

        if not known:
            self._next_guess = int(GUESS_AGAIN * len(trace))
        self.guess = MapGuess.begun(
            self._steps, trace.odometry, theory, self.options.speedups, known
        )
