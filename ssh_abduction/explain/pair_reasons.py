"""Explain whether two steps of a trace are one dstate, and why.

>>> from ssh_abduction import Trace
>>> actions = ["right", "travel", "right", "travel"]
>>> trace = Trace.from_steps(views=["v0", "v1", "v2", "v3", "v0"], actions=actions)
>>> explanation = explain_pair(trace, 0, 4)
>>> explanation.verdict.value, explanation.derivation.axioms[-1]
('different', 'path_between_sides')

A pair has two sides: the maps in which the steps are one dstate, and the maps in which they differ.
First only a few steps around the pair are searched. If these steps have no map of a side, the whole
trace has none, because more steps only add constraints. So a pair in a long trace may take no
longer than a pair in a short one. If both sides stay possible, the whole trace is searched for its
minimal maps, and for the best map of each side.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import cached_property
from itertools import islice
from typing import Unpack

from ssh_abduction.data.checks import a_count_of_maps
from ssh_abduction.data.drives import drives_of, named_steps
from ssh_abduction.data.errors import SolverError
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.odometry import match_in_words
from ssh_abduction.data.trace import Trace
from ssh_abduction.explain.argument import Argument
from ssh_abduction.explain.axioms import Axioms, Piece
from ssh_abduction.explain.no_map import (
    SHARE,
    Explanation,
    LimitedQuestion,
    QuestionLimits,
    check_two_steps,
    explain,
)
from ssh_abduction.explain.place_reasons import changes_in_words
from ssh_abduction.explain.verdict import Derivation, PairExplanation, Side, Verdict
from ssh_abduction.solution import EQUAL, Cost, Status, Stop
from ssh_abduction.solver import Judging, facts
from ssh_abduction.theory.fields import EXCUSED
from ssh_abduction.theory.settle import Problem, displacement_of
from ssh_abduction.theory.theory import Theory, checked_theory

# Try pieces of at most this many steps before the whole trace. That takes less than a second.
SMALL = 14
# Try pieces of at most this many steps for the argument. Larger ones take minutes to ground.
LARGE = 40
# For some theories pieces are of no use: a map of the trace, cut to a piece, may break an axiom.
# Then try the whole trace if it has at most this many steps.
UNCUT = 24
# If a few steps decide the verdict, a search only confirms that the trace has a map. It may take
# this many seconds, or a tenth of the time limit if that is more.
CONFIRMING = 5.0
# Estimating maps of the other side, which are like the best known map, may take this many seconds.
ESTIMATING = 0.5


def explain_pair(
    trace: Trace,
    first: int,
    second: int,
    theory: Theory | None = None,
    *,
    time_limit: float | None = None,
    memory_limit: int | None = None,
    max_maps: int | None = 100,
    known: Iterable[SSHMap] = (),
) -> PairExplanation:
    """Explain whether two steps of a trace are one dstate, and why.

    Args:
        trace: The trace, with views.
        first: A step, counted from 0.
        second: Another step.
        theory: The theory; Theory.topological() if None.
        time_limit: Seconds, as for `solve`. When a limit or Ctrl-C ends the search, the answer says
            what is known by then.
        memory_limit: MiB, as for `solve`.
        max_maps: List at most this many minimal maps, and count those in which the steps are one
            dstate; None for all.
        known: Maps of the trace that are known already, such as those of a solution. Searches begin
            with the known maps that satisfy the theory, and never end with a worse map.

    Returns:
        The verdict. If it holds in every map, also an argument for it.

    Raises:
        TraceError: The trace has no such step, or both steps are the same; and as `solve` does.
        TheoryError: As `solve` does.
        MapError: A known map is of another trace.

    Reference:
        Kuipers & Beeson 2002, section 4.2: why x0 and x4 of the rectangle differ.
    """
    a_count_of_maps(max_maps, SolverError)
    theory = checked_theory(theory)
    limits = QuestionLimits(time_limit=time_limit, memory_limit=memory_limit, known=known)
    return PairQuestion(trace, first, second, theory, max_maps=max_maps, **limits).answer()


class PairQuestion(LimitedQuestion[PairExplanation]):
    """The search for whether two steps are one dstate, and why. Parameters as in `explain_pair`.

    A side of the pair is True for the maps in which the steps are one dstate, and False for the
    maps in which they differ.
    """

    def __init__(
        self,
        trace: Trace,
        first: int,
        second: int,
        theory: Theory | None = None,
        *,
        max_maps: int | None = 100,
        **limits: Unpack[QuestionLimits],
    ) -> None:
        super().__init__(trace, theory, **limits)
        check_two_steps(trace, first, second)
        names = named_steps(drives_of(trace), len(trace))
        self.first, self.second = names[min(first, second)], names[max(first, second)]
        self._maps = max_maps
        self._sides = {True: Side(), False: Side()}
        self._listed = False
        self._derivation: Derivation | None = None
        self._clash: Explanation | None = None
        self._best: tuple[SSHMap, Side] | None = None  # the best map that was found
        self._ruling_out: dict[bool, Piece] = {}  # a piece of the trace without a map of the side

    def known(self, why: Stop | None = None) -> PairExplanation:
        """Return what is known so far. `why` is the limit that is about to end the search."""
        changes: tuple[str, ...] = ()
        if self._best:
            places = [self._best[0].place_of(step) for step in (self.first, self.second)]
            changes = changes_in_words(self._best[0], places)
        return PairExplanation(
            self.first,
            self.second,
            self._verdict(),
            same=self._sides[True],
            different=self._sides[False],
            listed=self._listed,
            derivation=self._derivation,
            clash=self._clash,
            stopped=why or self.stopped,
            theory=self.theory,
            loop=self._loop(),
            matches=self._matches(),
            changes=changes,
        )

    def _loop(self) -> str | None:
        """Put the closing error of the loop between the steps into words; None if unknown.

        It is unknown if the theory uses no displacements, or if one is missing in the loop: where
        a drive starts, or after a lift.
        """
        evidence = displacement_of(self.problem)
        way = self.trace.steps[self.first + 1 : self.second + 1]
        if evidence is None or any(step.displacement is None for step in way):
            return None
        closing = evidence.returns_of(self.trace).closing(self.first, self.second)
        if closing.way >= 0.5:
            return f"the loop of {closing.way:.0f} m closes {closing.size:.1f} m off"
        off = abs(math.degrees(closing.turned))  # the robot only turned
        return f"by the odometry their headings are {off:.1f} degrees apart"

    def _matches(self) -> tuple[str, ...]:
        """Put the closures between the visits of the two steps into words."""
        visits = [0]  # for each step, the first step of its visit: where the robot turns, it stays
        for t, action in enumerate(self.trace.actions, 1):
            visits.append(visits[-1] if action.kind == "turn" else t)
        pair = visits[self.first], visits[self.second]
        return tuple(
            match_in_words(closure, closure.first, closure.last)
            for closure in self.trace.closures
            if (visits[closure.first], visits[closure.last]) == pair
        )

    def _verdict(self) -> Verdict:
        """Return the verdict, by what is known about both sides so far."""
        one, two = self._sides[True], self._sides[False]
        if one.possible is False or two.possible is False:
            if one.possible is two.possible:
                return Verdict.NO_MAP
            return Verdict.SAME if two.possible is False else Verdict.DIFFERENT
        minimal = {True: self._is_minimal(one, two), False: self._is_minimal(two, one)}
        if all(minimal.values()):
            return Verdict.DISAGREE
        for here, verdict in (
            (True, Verdict.SAME_IN_MINIMAL),
            (False, Verdict.DIFFERENT_IN_MINIMAL),
        ):
            lost = self._sides[not here]
            if minimal[here] and self._listed:
                return verdict
            if lost.proven and self._is_cheaper(self._sides[here], lost):
                return verdict
        return Verdict.UNKNOWN

    def _is_minimal(self, side: Side, other: Side) -> bool:
        """Tell whether a side has a minimal map: one was listed, or both best maps are proven."""
        return side.maps > 0 or (
            side.proven and other.proven and not self._is_cheaper(other, side) and bool(side.cost)
        )

    def _find_out(self) -> None:
        self._begin_with_known_maps()
        # if a few steps around the pair have no map of a side, the whole trace has none
        for one in (True, False):
            self._ask_pieces(one, SMALL)
            if self._sides[one].possible is False:
                break
        settled = False in (self._sides[True].possible, self._sides[False].possible)
        if not (settled and self._best):  # a known map shows that the trace has one
            self._list_minimal_maps(settled)
        if not settled and self._verdict() not in (Verdict.NO_MAP, Verdict.DISAGREE):
            for one in (True, False):
                if not self._sides[one].maps and not self._over():
                    self._find_best(one)
        if self._verdict() is Verdict.NO_MAP:
            self._clash = explain(self.trace, self.theory, self._over)
        elif self._verdict() in (Verdict.DIFFERENT, Verdict.SAME):
            one = self._verdict() is Verdict.DIFFERENT
            if one not in self._ruling_out:
                self._ask_pieces(one, LARGE)
            if one in self._ruling_out:
                piece, pair = self._shrunk(self._ruling_out[one], one), (self.first, self.second)
                argument = Argument(piece, self.trace, pair, one=not one, stop=self._over)
                self._derivation = argument.derivation()

    def _begin_with_known_maps(self) -> None:
        """Take over the known maps that satisfy the theory, with their costs.

        If maps are weighed and the best one has the steps at one dstate, also take a map like it
        that has them at different dstates.
        """
        if not self._known_maps:
            return
        from ssh_abduction.solver import Misfit, maps_apart  # loads numpy

        judging = Judging(self.problem)
        misfit = Misfit(self.problem) if self.theory.weigh == "cost" else None

        def keep(ssh_map: SSHMap) -> None:
            self._keep(ssh_map, Cost.of(ssh_map), misfit.nats_of(ssh_map) if misfit else None)

        for ssh_map in filter(judging.accepts, self._known_maps):
            keep(ssh_map)
        if self._best and misfit and self._best[1] is self._sides[True]:
            pair = self.first, self.second
            apart = maps_apart(self.problem, misfit, self._best[0], pair, ESTIMATING)
            for ssh_map in islice(filter(judging.accepts, apart), 1):
                self._known_maps.append(ssh_map)
                keep(ssh_map)

    def _keep(
        self, ssh_map: SSHMap, cost: Cost | None, nats: float | None, *, proven: bool = False
    ) -> None:
        """Keep the cost of a map if the map is the best one so far, of its side or of all.

        `proven` says whether this is proven to be the least cost of a map of its side.
        """
        one = ssh_map.dstate_at[self.first] == ssh_map.dstate_at[self.second]
        before = self._sides[one]
        side = replace(before, possible=True, cost=cost, nats=nats, proven=proven)
        if proven or before.cost is None or self._is_cheaper(side, before):
            self._sides[one] = side
        if self._best is None or self._is_cheaper(side, self._best[1]):
            self._best = ssh_map, side

    def _is_cheaper(self, side: Side, other: Side) -> bool:
        """Tell whether the map of a side costs less than the map of another."""
        if side.nats is not None and other.nats is not None:
            return side.nats < other.nats - EQUAL
        if side.nats is not None or other.nats is not None:  # a limit came before the price
            return side.nats is not None
        here, there = side.dearness(self.theory), other.dearness(self.theory)
        return here is not None and there is not None and here < there

    # Few steps around the pair

    @cached_property
    def _sure(self) -> Problem:
        """The problem without the axioms that faults may excuse. It has all maps of the trace."""
        theory = self.problem.theory
        kinds = [kind for kind in EXCUSED if getattr(theory, kind)]
        excused = {axiom for kind in kinds for axiom in EXCUSED[kind]} - {*theory.without}
        without = (*theory.without, *sorted(excused))
        sure = theory.replace(**dict.fromkeys(kinds, 0), without=without)
        return Problem.of(self.problem.trace, sure)

    def _ask_pieces(self, one: bool, most: int) -> None:
        """Find at most `most` steps around the pair that have no map of the side `one`."""
        for steps in self._pieces(most):
            piece = Piece.of(self._sure, steps)
            if not self._has_map(piece, one):
                self._sides[one] = replace(self._sides[one], possible=False)
                self._ruling_out[one] = piece
                return

    def _pieces(self, most: int) -> Iterator[list[int]]:
        """Yield lists of steps around the pair, from few to at most `most`.

        A map of the trace, restricted to fewer steps, is a map of these steps. This may be false if
        the theory has rules of the user. Then only the whole trace is yielded, if short.
        """
        whole = range(len(self.trace))
        if self.theory.rules:
            if len(self.trace) <= UNCUT:
                yield list(whole)
            return
        before: list[int] = []
        width = 0
        while True:
            near = {
                t
                for middle in (self.first, self.second)
                for t in range(middle - width, middle + width + 1)
                if t in whole
            }
            # all steps between the pair are useful if they are few
            if self.second - self.first <= most // 2:
                near |= set(range(self.first, self.second + 1))
            steps = sorted(near)
            if len(steps) > most or steps == before:
                return
            yield steps
            before = steps
            width += 1 + width // 2

    def _has_map(self, piece: Piece, one: bool) -> bool:
        """Tell whether a piece has a map of the side `one` of the pair."""
        pair = piece.steps.index(self.first), piece.steps.index(self.second)
        return Axioms(piece, self._over).consistent(assumed=[(facts.are_one(*pair), one)])

    def _shrunk(self, piece: Piece, one: bool) -> Piece:
        """Drop steps at the ends of a piece while the rest has no map of the side `one`."""
        if self.theory.rules:
            return piece
        for t in (*piece.steps, *reversed(piece.steps)):
            if t in (self.first, self.second) or t not in piece.steps:
                continue
            ends = [k for k in piece.steps if k - 1 not in piece.steps or k + 1 not in piece.steps]
            if t not in ends:
                continue
            fewer = Piece.of(self._sure, [k for k in piece.steps if k != t])
            if not self._has_map(fewer, one):
                piece = fewer
        return piece

    # The whole trace

    def _list_minimal_maps(self, settled: bool) -> None:
        """List minimal maps, or one if `settled`. Count those in which the steps are one dstate."""
        seconds = self._watch.left() * SHARE
        if settled:
            seconds = min(self._watch.left(), max(CONFIRMING, (self.limit or 0.0) / 10))
        search = self._solved(self.trace, self.theory, 1 if settled else self._maps, seconds)
        for found in search:
            is_minimal = search.status is Status.OPTIMAL
            self._keep(found, search.cost, search.nats, proven=is_minimal)
            if is_minimal:
                one = found.dstate_at[self.first] == found.dstate_at[self.second]
                self._sides[one] = replace(self._sides[one], maps=self._sides[one].maps + 1)
        if search.status is Status.UNSATISFIABLE:
            self._sides = {True: Side(possible=False), False: Side(possible=False)}
        self._listed = search.complete and not settled
        self._ended(search)

    def _find_best(self, one: bool) -> None:
        """Find the best map of the side `one`."""
        name = "same" if one else "different"
        pairs = (*getattr(self.theory, name), (self.first, self.second))
        is_last = any(side.maps for side in self._sides.values())
        seconds = self._watch.left() * (2 * SHARE if is_last else SHARE)
        search = self._solved(self.trace, self.theory.replace(**{name: pairs}), 1, seconds)
        for found in search:
            proven = search.status is Status.OPTIMAL
            self._keep(found, search.cost, search.nats, proven=proven)
        if search.status is Status.UNSATISFIABLE:
            self._sides[one] = Side(possible=False)
        for side, other in ((True, False), (False, True)):
            if self._is_minimal(self._sides[side], self._sides[other]):
                maps = max(1, self._sides[side].maps)
                self._sides[side] = replace(self._sides[side], maps=maps)
        self._ended(search)
