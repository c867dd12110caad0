"""Find the answers to questions of the page, which a server or the verb `view` asks.

A served page asks each question in its own process. The searches begin with the maps that the page
shows, so an answer is never worse than these. This module imports nothing that draws, so that the
process starts sooner.
"""

from __future__ import annotations

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.explain.pair_reasons import explain_pair
from ssh_abduction.explain.verdict import PairExplanation
from ssh_abduction.runtime.limits import Watch
from ssh_abduction.solution import Solution
from ssh_abduction.solver import Search, Start
from ssh_abduction.theory.theory import Theory

Pair = tuple[int, int]


def pair_explained(
    trace: Trace,
    first: int,
    second: int,
    theory: Theory,
    known: tuple[SSHMap, ...],
    limit: float | None,
    watch: Watch,
) -> PairExplanation:
    """Explain in `limit` seconds why two steps are one dstate (place and heading), or not.

    `known` are the maps that the page shows. `watch` is not used, as the server ends the process
    itself. It is a parameter because `in_process` passes a watch to each function that it runs.
    """
    return explain_pair(trace, first, second, theory, time_limit=limit, known=known)


def solved_with(
    trace: Trace,
    theory: Theory,
    known: tuple[SSHMap, ...],
    maps: int | None,
    limit: float | None,
    watch: Watch,
) -> Solution:
    """Find the minimal maps by a theory with assumptions about pairs of steps.

    At most `maps` are listed; None lists all. `known`, `limit` and `watch` are as in
    `pair_explained`.
    """
    search = Search(trace, theory, max_maps=maps, time_limit=limit, _start=Start(known=known))
    return search.solution(tuple(search))
