"""The answers of a served page, each found in a process of its own.

This module imports nothing that draws, so that the process starts sooner.
"""

from __future__ import annotations

from ssh_abduction.data.trace import Trace
from ssh_abduction.explain.pairs import explain_pair
from ssh_abduction.explain.verdict import PairExplanation
from ssh_abduction.solver import Solution, Watch, solve
from ssh_abduction.theory.theory import Theory


def explained(
    trace: Trace, first: int, second: int, theory: Theory, limit: float | None, watch: Watch
) -> PairExplanation:
    """Why two steps are one dstate or not. The server ends the process, so `watch` is not used."""
    return explain_pair(trace, first, second, theory, time_limit=limit)


def solved(trace: Trace, theory: Theory, maps: int, limit: float | None, watch: Watch) -> Solution:
    """The minimal maps under a theory with assumptions. `watch` is not used here either."""
    return solve(trace, theory, max_maps=maps, time_limit=limit)
