"""Measure how much each kind of evidence helps to find the true map of a trace.

The ladder is a list of theories, its rungs. The first rung uses views alone. Each further rung adds
one kind of evidence: "+ star" adds stars (the openings seen), "+ pairs" adds displacements, each
pair of steps tested alone, "+ geometry" tests two such pairs together, and "+ planarity" demands
that the map can be drawn without a crossing.

>>> from ssh_abduction import Theory, Trace
>>> from ssh_abduction.evaluation.rungs import ladder
>>> square = [(10, 0, 0), (0, 0, -1.5708)] * 4
>>> trace = Trace.from_steps("ab" * 4 + "a", ["travel", "right"] * 4, displacements=square)
>>> [(rung.name, rung.solution.cost.places, rung.solution.count) for rung in ladder(trace)]
[('views', 3, 1), ('+ pairs', 4, 1), ('+ geometry', 4, 1), ('+ planarity', 4, 1)]

In this example the robot drives around a square whose corners look alike. Views alone give a
triangle as the minimal map. With displacements the map is the square. Each rung is solved from
scratch.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from ssh_abduction.data.checks import a_count_of_maps, a_flag, an_instance
from ssh_abduction.data.errors import SolverError, TheoryError
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace, checked_trace
from ssh_abduction.evaluation import Evaluation, evaluate, tells_names
from ssh_abduction.solver import Search, Solution, Start, check_limit
from ssh_abduction.theory.theory import Theory, checked_theory


@dataclass(frozen=True, slots=True)
class Rung:
    """The result of one rung of the ladder: a theory with one more kind of evidence.

    Attributes:
        name: "views", "+ star", "+ pairs", "+ geometry" or "+ planarity".
        solution: The minimal maps by the evidence of this rung and all rungs before.
        evaluation: The accuracy of these maps; None if the trace has no truth, if there is no map,
            or if the ladder was interrupted.
    """

    name: str
    solution: Solution
    evaluation: Evaluation | None

    @property
    def rank(self) -> int | None:
        """The number of the true map, from 1; None if no map is true or the truth is unknown."""
        return self.evaluation.rank if self.evaluation else None

    def to_dict(self) -> dict[str, Any]:
        """Return the rung as plain data, as `ladder --json` prints it."""
        solution = self.solution
        best = self.evaluation.maps[0] if self.evaluation else None
        return {
            "name": self.name,
            "status": solution.status.value,
            "complete": solution.complete,
            "count": solution.count,
            "cost": solution.cost.to_dict() if solution.cost else None,
            "rank": self.rank,
            "accuracy": best.accuracy if best else None,
            "seconds": round(solution.seconds.total, 3),
        }


class UnderWay:
    """A series of searches that can be ended together.

    A signal handler or another thread can end the current search and all later ones. Each search
    begins with the `known` maps that the checker accepts.
    """

    def __init__(self, known: tuple[SSHMap, ...] = ()) -> None:
        self._start = Start(known=known)
        self.search: Search | None = None  # the current or last search; None before the first one
        self.interrupted = False  # whether `interrupt` was called, or Ctrl-C ended a search

    def interrupt(self) -> None:
        """End the current search soon, with its best answer so far. End later searches, too."""
        self.interrupted = True
        if self.search is not None:
            self.search.interrupt()

    def snapshot(self) -> Solution:
        """Return what the current search knows so far.

        This is for a search in another thread that cannot be stopped. The search cannot be used
        afterwards.
        """
        assert self.search
        return self.search.snapshot("interrupted")

    def solve(
        self,
        trace: Trace,
        theory: Theory,
        *,
        time_limit: float | None,
        max_maps: int | None,
        work_limit: float | None = None,
    ) -> Solution:
        """Solve a trace as `ssh_abduction.solve` does. Ctrl-C ends this and all later searches."""
        theory.check_steps(trace)
        self.search = Search(
            trace,
            theory,
            time_limit=time_limit,
            work_limit=work_limit,
            max_maps=max_maps,
            _start=self._start,
        )
        if self.interrupted:  # perhaps before there was a search
            self.search.interrupt()
        solution = self.search.solution(tuple(self.search))
        self.interrupted |= solution.stopped == "interrupted"
        return solution


def rungs(trace: Trace, theory: Theory, stars: bool = True) -> Iterator[tuple[str, Theory]]:
    """List the theories of the ladder. Each one adds a kind of evidence that the trace has.

    Yield the name and the theory of each rung. They replace what `theory` says about stars,
    displacements and planarity. `stars` says whether there is a rung for stars, if the trace has
    some.
    """
    jumped = theory.jumped
    theory = theory.replace(star="none", displacement="none", planar=False, jumped=0)
    yield "views", theory
    topological = theory.level == "topological"
    if trace.has_stars and stars:
        theory = theory.replace(star="auto" if topological else "alike")
        yield "+ star", theory
    if trace.has_displacements:
        theory = theory.replace(displacement="use", joint=1, jumped=jumped)
        yield "+ pairs", theory
        theory = theory.replace(joint=2)
        yield "+ geometry", theory
    if topological and not theory.has_faults:  # a theory cannot have both
        yield "+ planarity", theory.replace(planar=True)


def ladder(
    trace: Trace,
    theory: Theory | None = None,
    *,
    time_limit: float | None = None,
    work_limit: float | None = None,
    max_maps: int | None = 100,
    stars: bool = True,
    under_way: UnderWay | None = None,
) -> Iterator[Rung]:
    """Solve a trace with one theory after the other, each with one more kind of evidence.

    Args:
        trace: The trace. Its truth, if it has one, is used to evaluate the maps.
        theory: The theory to start from; Theory.topological() by default. The ladder replaces what
            it says about stars, displacements and planarity.
        time_limit: Seconds for each rung; None for no limit.
        work_limit: Units of work for each rung, as in `solve`; None for no limit.
        max_maps: List and evaluate at most this many minimal maps on each rung; None for all.
        stars: Whether there is a rung for stars, if the trace has some.
        under_way: An object with which a signal handler or another thread can interrupt the ladder.
            Ctrl-C works without it.

    Returns:
        An iterator over the rungs. Each one is solved when it is asked for. An interrupted rung is
        the last one.
    """
    checked_trace(trace)
    start = checked_theory(theory)
    check_limit("time_limit", "seconds", time_limit)
    check_limit("work_limit", "units of work", work_limit)
    a_count_of_maps(max_maps, SolverError)
    a_flag("stars", stars, TheoryError)
    if under_way is not None:
        mend = "give an UnderWay, or leave it out"
        an_instance("under_way", under_way, UnderWay, SolverError, mend=mend)
    work = under_way or UnderWay()

    def climbed() -> Iterator[Rung]:
        has_truth = tells_names(trace)
        for name, chosen in rungs(trace, start, stars):
            solution = work.solve(
                trace,
                chosen,
                time_limit=time_limit,
                work_limit=work_limit,
                max_maps=max_maps,
            )
            is_judged = has_truth and solution.maps and not work.interrupted
            yield Rung(name, solution, evaluate(solution.maps, trace) if is_judged else None)
            if work.interrupted:
                return

    return climbed()  # the arguments are checked before the first rung is asked for
