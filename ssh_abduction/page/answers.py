"""Find the answers to questions of the page, which a server or the verb `view` asks.

A served page asks each question in its own process. The searches begin with the maps that the page
shows, so an answer is never worse than these. This module imports nothing that draws, so that the
process starts sooner.

A page without a server shows what was computed in advance: what it costs to assume that two steps
are one dstate (a place and a heading), or different ones.

>>> from ssh_abduction import Trace, solve
>>> views = ["end", "hall", "end", "end", "hall", "end", "end"]
>>> trace = Trace.from_steps(views, ["travel", "travel", "around"] * 2)
>>> known = assumptions(Listing.of(solve(trace)), trace, Theory(), seconds=10)
>>> known[0, 6]["different"], known[0, 1]["same"]
('7 dstates, not 6', 'no map satisfies the axioms')
"""

from __future__ import annotations

import time
from collections.abc import Iterator

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.explain.axioms import Axioms, Interrupted, Piece
from ssh_abduction.explain.pair_reasons import SMALL, UNCUT, explain_pair
from ssh_abduction.explain.verdict import PairExplanation, Side, Verdict
from ssh_abduction.rivals.listing import Listing
from ssh_abduction.solver import Cost, Search, Solution, Start, Status, Watch, facts, solve
from ssh_abduction.theory.settle import settle
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


def assumptions(
    listing: Listing, trace: Trace, theory: Theory, seconds: float
) -> dict[Pair, dict[str, str]]:
    """Say what "same" and "different" cost for pairs of steps on which all minimal maps agree.

    The words are those of `PairExplanation.assuming`. Pairs for which the seconds run out are
    missing in the result.
    """
    end = time.monotonic() + seconds
    problem = settle(trace, theory)
    theory = problem.theory
    axioms_survive_cuts = not (theory.rules or theory.has_faults)
    if not listing.minimal or theory.without or (len(trace) > UNCUT and not axioms_survive_cuts):
        return {}
    minimal = listing.maps[: listing.minimal]
    best = Cost.of(minimal[0])
    known: dict[Pair, dict[str, str]] = {}
    left: list[tuple[Pair, bool]] = []

    def tell(pair: Pair, one: bool, lost: Side) -> None:
        """Record the costs for a pair.

        `one` says whether its steps are one dstate in all minimal maps. `lost` says what is known
        about the maps that contradict this.
        """
        won = Side(possible=True, cost=best, proven=True)
        same, different = (won, lost) if one else (lost, won)
        verdict = Verdict.SAME_IN_MINIMAL if one else Verdict.DIFFERENT_IN_MINIMAL
        explanation = PairExplanation(
            *pair, verdict, same, different, bool(listing.complete), None, None, None, theory
        )
        known[pair] = explanation.assuming

    # First find the pairs for which the opposite is possible at all. All share one grounding.
    piece = Piece.of(problem, range(len(trace) if len(trace) <= UNCUT else SMALL))
    try:
        axioms = Axioms(piece, lambda: time.monotonic() > end)
        for pair, one in _agreed([ssh_map.dstate_at for ssh_map in minimal], len(piece.steps)):
            if axioms.consistent(assumed=[(facts.are_one(*pair), not one)]):
                left.append((pair, one))
            else:
                tell(pair, one, Side(possible=False))
    except Interrupted:
        return known
    # Then find, pair by pair, the cost of the best map that has the opposite.
    for pair, one in left:
        rest = end - time.monotonic()
        if rest > 0 and (lost := _with_opposite(trace, theory, pair, one, rest)):
            tell(pair, one, lost)
    return known


def _with_opposite(
    trace: Trace, theory: Theory, pair: Pair, one: bool, seconds: float
) -> Side | None:
    """Find the cost of the maps in which a pair is not `one` dstate, or is; None if not in time."""
    field = "different" if one else "same"
    asserted = theory.replace(**{field: (*getattr(theory, field), pair)})
    found = solve(trace, asserted, time_limit=seconds, max_maps=1)
    if found.status is Status.OPTIMAL:
        return Side(possible=True, cost=found.cost, proven=True)
    return Side(possible=False) if found.status is Status.UNSATISFIABLE else None


def _agreed(labels: list[tuple[int, ...]], steps: int) -> Iterator[tuple[Pair, bool]]:
    """Yield the pairs of steps on which all maps agree, and whether both are one dstate."""
    for later in range(steps):
        for earlier in range(later):
            said = {of_map[earlier] == of_map[later] for of_map in labels}
            if len(said) == 1:
                yield (earlier, later), said.pop()
