"""What a served page asks of the solver. It is asked in a process of its own, which begins sooner as nothing is imported here that draws."""

from __future__ import annotations

from ssh_abduction.data.trace import Trace
from ssh_abduction.explain.pairs import explain_pair
from ssh_abduction.explain.verdict import PairExplanation
from ssh_abduction.solver import Solution, Watch, solve
from ssh_abduction.theory.theory import Theory


def explained(
    trace: Trace, first: int, second: int, theory: Theory, limit: float | None, watch: Watch
) -> PairExplanation:
    """Why two steps are one dstate or not. The watch is not needed, as the process is ended from outside."""
    return explain_pair(trace, first, second, theory, time_limit=limit)


def solved(trace: Trace, theory: Theory, maps: int, limit: float | None, watch: Watch) -> Solution:
    """The minimal maps under a theory that holds what is assumed. The watch is not needed, as the process is ended from outside."""
    return solve(trace, theory, max_maps=maps, time_limit=limit)
