"""Why two steps of a trace are different dstates, or one, or undecided; and what would mend a trace that has no map.

>>> from ssh_abduction import Trace
>>> trace = Trace.from_steps(views=["v0", "v1", "v2", "v3", "v0"], actions=["right", "travel", "right", "travel"])
>>> explanation = explain_pair(trace, 0, 4)
>>> explanation.verdict.value, explanation.derivation.axioms[-1]
('different', 'path_between_sides')

Whether two steps can be one dstate at all is asked of few steps around them first: what these rule out, the whole trace rules out, as more steps never bring a
map back. So an answer for a pair of a long trace may take no longer than for a short one. Only what the few steps leave open is asked of the whole trace: its
minimal maps, and the best map in which the steps are one, or are not.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any

from ssh_abduction.data.checks import a_count_of_maps
from ssh_abduction.data.deprecated import renamed_parameters
from ssh_abduction.data.errors import AbductionError, SolverError, TraceError, brief, is_whole
from ssh_abduction.data.trace import STANDARD_ACTIONS, Action, Step, Trace, View, checked_trace
from ssh_abduction.explain.derivation import Derivation, derive
from ssh_abduction.explain.no_map import Axioms, Explanation, Interrupted, Piece, explain
from ssh_abduction.solver import (
    Cost,
    LimitError,
    Progress,
    Search,
    Status,
    Stop,
    Watch,
    check_limit,
    check_rules,
    facts,
)
from ssh_abduction.theory.theory import ASSERTIONS, Theory, checked_theory

SMALL = 14  # Pieces of up to so many steps are asked before the whole trace: that takes less than a second.
LARGE = 40  # Pieces of up to so many steps are asked for the reason, once the whole trace has told that there is one. Larger ones take minutes to ground.
UNCUT = 24  # A trace whose axioms need not survive a cut is asked as a whole, if it has at most so many steps.
CONFIRMING = 5.0  # For so many seconds, or a tenth of the limit, it is sought whether the trace has any map, where the verdict does not depend on it.
SHARE = 0.45  # This share of the time that is left goes to the minimal maps, and as much of what is left then to the best map of the other kind.
SHORTEST = 0.05  # A search has so many seconds at least.
NEW_VIEW = "a view never seen"


class Verdict(Enum):
    """What the maps of a trace say of two steps."""

    DIFFERENT = "different"  # different dstates in every consistent map
    SAME = "same"  # one dstate in every consistent map
    DIFFERENT_IN_MINIMAL = "different in every minimal map"  # though there are other maps in which they are one, or none was ruled out
    SAME_IN_MINIMAL = "same in every minimal map"
    DISAGREE = "rivals disagree"  # one in some minimal maps, different in others
    NO_MAP = "no map"  # the trace has none, so that nothing can be said of its steps
    UNKNOWN = "unknown"  # a limit ended the search before


@dataclass(frozen=True, slots=True)
class Side:
    """What is known of the maps in which two steps are one dstate, or of those in which they are not.

    possible  whether there is such a map; None where that is not known
    cost      what the best one known costs; None where none is known
    proven    whether no such map costs less
    maps      how many of the minimal maps that were listed are such
    """

    possible: bool | None = None
    cost: Cost | None = None
    proven: bool = False
    maps: int = 0

    def to_dict(self) -> dict[str, Any]:
        return {
            "possible": self.possible,
            "cost": self.cost.to_dict() if self.cost else None,
            "proven": self.proven,
            "maps": self.maps,
        }


@dataclass(frozen=True, slots=True)
class PairExplanation:
    """Why two steps are different dstates, or one, or undecided.

    first, second  the steps, the earlier one first
    verdict        what the maps say
    same, different  what is known of the maps in which they are one, and in which they are not
    listed         whether all minimal maps were listed, so that the numbers of maps are those of all
    derivation     for what holds in every consistent map: why; None where that is not so, or was not found in time
    clash          for a trace without a map: why it has none
    stopped        which limit ended the search, if one did
    theory         the theory, settled for the trace
    """

    first: int
    second: int
    verdict: Verdict
    same: Side
    different: Side
    listed: bool
    derivation: Derivation | None
    clash: Explanation | None
    stopped: Stop | None
    theory: Theory = field(repr=False)

    @property
    def proven(self) -> bool:
        """Whether the verdict is final."""
        return self.verdict is not Verdict.UNKNOWN

    @property
    def sentences(self) -> tuple[str, ...]:
        """The verdict in words, and what the maps of the other kind cost."""
        pair = f"steps {self.first} and {self.second}"
        told = {
            Verdict.DIFFERENT: f"{pair} are different dstates in every map",
            Verdict.SAME: f"{pair} are one dstate in every map",
            Verdict.DIFFERENT_IN_MINIMAL: f"{pair} are different dstates in every minimal map",
            Verdict.SAME_IN_MINIMAL: f"{pair} are one dstate in every minimal map",
            Verdict.DISAGREE: f"rivals disagree: {pair} are one dstate in some minimal maps, and different ones in others",
            Verdict.NO_MAP: f"no map satisfies the axioms, so nothing can be said of {pair}",
            Verdict.UNKNOWN: f"whether {pair} are one dstate was not found out ({self.stopped or 'no proof'})",
        }[self.verdict]
        return (told, *self._of_maps(), *self._of_costs())

    def _of_maps(self) -> Iterator[str]:
        if self.verdict is Verdict.DISAGREE and self.same.maps + self.different.maps > 1:
            of = f"of {'the' if self.listed else 'the first'} {self.same.maps + self.different.maps} minimal maps"
            yield f"{of}, {self.same.maps} have them as one, and {self.different.maps} as different ones"
        if self.verdict is Verdict.NO_MAP and self.clash:
            yield str(self.clash)
        if self.verdict is Verdict.UNKNOWN:
            for side, equal in ((self.same, "="), (self.different, "≠")):
                if side.cost:
                    yield f"a map with step {self.first} {equal} step {self.second} is known: {_told(side.cost, self.theory.priorities)}"

    def _of_costs(self) -> Iterator[str]:
        """What the rival that lost costs."""
        lost, won, equal = (
            (self.same, self.different, "=")
            if self.verdict is Verdict.DIFFERENT_IN_MINIMAL
            else (self.different, self.same, "≠")
        )
        if self.verdict not in (Verdict.DIFFERENT_IN_MINIMAL, Verdict.SAME_IN_MINIMAL):
            return
        rival = f"with step {self.first} {equal} step {self.second}"
        if lost.possible is False:
            yield f"no map {rival} satisfies the axioms"
        elif lost.cost is None or won.cost is None:
            yield f"whether there is any map {rival} was not found out"
        else:
            known = (
                f"the best map {rival}" if lost.proven else f"the best map {rival} that was found"
            )
            yield f"{known} has {_difference(lost.cost, won.cost, self.theory)}"

    @property
    def assuming(self) -> dict[str, str]:
        """What it costs to assume that the steps are one dstate (`same`), and that they are not (`different`), in words."""
        sides = {"same": self.same, "different": self.different}
        best = min(
            (s.cost for s in sides.values() if s.cost),
            key=lambda cost: cost.preferred_by(self.theory),
            default=None,
        )
        told = {}
        for name, side in sides.items():
            other = self.different if side is self.same else self.same
            if side.possible is False:
                told[name] = "no map satisfies the axioms"
            elif other.possible is False:
                told[name] = "costs nothing, as it holds in every map"
            elif side.cost is None or best is None:
                told[name] = "what it costs was not found out"
            elif side.cost.preferred_by(self.theory) == best.preferred_by(self.theory):
                known = "costs nothing" if side.proven else "nothing that costs less is known"
                told[name] = f"{known}: {_told(side.cost, self.theory.priorities)}"
            else:
                told[name] = (
                    f"{'' if side.proven else 'at most, '}{_difference(side.cost, best, self.theory)}"
                )
        return told

    def __str__(self) -> str:
        lines = list(self.sentences)
        if self.derivation:
            lines.append(str(self.derivation))
        elif self.verdict in (Verdict.DIFFERENT, Verdict.SAME):
            lines.append(
                f"which axioms it takes was not found out ({self.stopped or 'it takes more steps than an argument is sought for'})"
            )
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Plain data, as `explain --json` prints it."""
        return {
            "steps": [self.first, self.second],
            "verdict": self.verdict.value,
            "sentences": list(self.sentences),
            "same": self.same.to_dict(),
            "different": self.different.to_dict(),
            "listed": self.listed,
            "derivation": self.derivation.to_dict() if self.derivation else None,
            "clash": self.clash.to_dict() if self.clash else None,
            **({"stopped": self.stopped} if self.stopped else {}),
        }


@dataclass(frozen=True, slots=True)
class Mend:
    """One observation that, if it were wrong, would leave the trace a map.

    step     the step at which it was made; of what a person said, the later one
    kind     view, star, action, displacement, or what a person said: same, different, elsewhere
    seen     what the trace says
    instead  what it could have been; None where it is enough that it is not believed
    proven   whether a map of the whole mended trace was found; else one of the clashing stretch was
    """

    step: int
    kind: str
    seen: str
    instead: str | None
    proven: bool

    def __str__(self) -> str:
        if self.kind in ASSERTIONS:
            what = f"without what is said of steps {self.seen} ({self.kind})"
        elif self.instead is None:
            what = f"if the {self.kind} at step {self.step}, {self.seen}, were wrong"
        else:
            what = (
                f"if the {self.kind} at step {self.step} were {self.instead}, and not {self.seen}"
            )
        return f"{what}, {'the trace' if self.proven else 'at least that stretch'} would have a map"

    def to_dict(self) -> dict[str, Any]:
        return {
            "step": self.step,
            "kind": self.kind,
            "seen": self.seen,
            "instead": self.instead,
            "proven": self.proven,
            "sentence": str(self),
        }


@dataclass(frozen=True, slots=True)
class TraceExplanation:
    """Why a trace has no map, and which one observation would mend it.

    possible  whether the trace has a map; None where a limit ended the search before that was known
    clash     the smallest clash; None where the trace has a map, or it is not known
    mends     single observations that would mend it if they were wrong, in the order of the steps
    complete  whether all observations of the clashing stretch were tried
    stopped   which limit ended the search, if one did
    """

    possible: bool | None
    clash: Explanation | None
    mends: tuple[Mend, ...]
    complete: bool
    stopped: Stop | None

    @property
    def sentences(self) -> tuple[str, ...]:
        if self.possible:
            return (
                "the trace has a map; name two steps to hear why they are one dstate, or are not",
            )
        if self.clash is None:
            return (
                f"whether the trace has a map was not found out ({self.stopped or 'no proof'})",
            )
        mends = tuple(map(str, self.mends))
        if not mends and self.complete:
            mends = ("no single observation of that stretch, if it were wrong, would mend it",)
        elif not self.complete:
            mends += (f"not all observations were tried ({self.stopped})",)
        return (str(self.clash), *self.clash.sentences, *mends)

    def __str__(self) -> str:
        return "\n".join(self.sentences)

    def to_dict(self) -> dict[str, Any]:
        """Plain data, as `explain --json` prints it."""
        return {
            "possible": self.possible,
            "sentences": list(self.sentences),
            "clash": self.clash.to_dict() if self.clash else None,
            "mends": [mend.to_dict() for mend in self.mends],
            "complete": self.complete,
            **({"stopped": self.stopped} if self.stopped else {}),
        }


@renamed_parameters("limit", "maps", "memory")
def explain_pair(
    trace: Trace,
    first: int,
    second: int,
    theory: Theory | None = None,
    *,
    time_limit: float | None = None,
    memory_limit: int | None = None,
    max_maps: int | None = 100,
) -> PairExplanation:
    """Why two steps of a trace are different dstates, or one, or undecided.

    first, second  steps, counted from 0
    theory         Theory.topological() by default
    limit, memory  seconds and MiB, as for solve; when one is over, or with Ctrl-C, the verdict is what is known by then
    maps           list at most so many minimal maps, to count those in which the steps are one; 0 lists all
    choices        fields of Theory, laid over it

    Raises TraceError for a step that the trace does not have, or for one step twice; and as solve does.
    Source: Kuipers & Beeson 2002, section 4.2, for why x0 and x4 of the rectangle differ.
    """
    a_count_of_maps(max_maps, SolverError)
    return PairQuestion(
        trace,
        first,
        second,
        checked_theory(theory),
        time_limit=time_limit,
        memory_limit=memory_limit,
        max_maps=max_maps,
    ).answer()


@renamed_parameters("limit", "memory")
def explain_trace(
    trace: Trace,
    theory: Theory | None = None,
    *,
    time_limit: float | None = None,
    memory_limit: int | None = None,
) -> TraceExplanation:
    """Why a trace has no map, and which one observation, if it were wrong, would mend it.

    Parameters as in `explain_pair`. An observation is a view, a star, an action, a displacement, or what a person says of steps. Each one of the clashing
    stretch is tried: it is taken for another one of the trace, or for none, and that is a mend where the whole trace then has a map.
    """
    return TraceQuestion(
        trace, checked_theory(theory), time_limit=time_limit, memory_limit=memory_limit
    ).answer()


class _Question:
    """What is asked, under limits. `answer` may be called once; `known` tells what is known so far, in any thread."""

    def __init__(
        self,
        trace: Trace,
        theory: Theory | None,
        time_limit: float | None,
        memory_limit: int | None,
    ) -> None:
        check_limit("time_limit (--time-limit)", "seconds", time_limit)
        check_limit("memory_limit (--memory-limit)", "MiB", memory_limit)
        self.trace = checked_trace(trace)
        self.theory = checked_theory(theory).resolve(trace)
        self.theory.check_steps(trace)
        check_rules(self.theory)
        self.limit, self.memory = time_limit, memory_limit
        self.stopped: Stop | None = None
        self._watch = Watch(time_limit, memory_limit)
        self._watch.use_reserve()
        self._search: Search | None = None

    def interrupt(self) -> None:
        """End soon, from another thread or a handler of signals, with what is known."""
        self._watch.interrupted = True
        if self._search is not None:
            self._search.interrupt()

    def _over(self) -> bool:
        """Whether a limit is over."""
        try:
            self._watch.check()
        except LimitError as limit:
            self.stopped = limit.reason
        return self.stopped is not None

    def _solved(self, trace: Trace, theory: Theory, maps: int | None, seconds: float) -> Search:
        """A search that has ended, after so many seconds at most. It is asked for its maps by `kept`."""

        def end_with_this(_: Progress) -> None:
            if self._over():
                search.interrupt()

        limit = None if seconds == float("inf") else max(seconds, SHORTEST)
        search = self._search = Search(
            trace,
            theory,
            time_limit=limit,
            memory_limit=self.memory,
            max_maps=maps,
            on_progress=end_with_this,
        )
        return search

    def _ended(self, search: Search) -> None:
        """Take down why a search ended early."""
        self._search = None
        if search.stopped in ("interrupted", "memory limit"):
            self.stopped = search.stopped
        self._over()


class PairQuestion(_Question):
    """Asks why two steps are different dstates, or one. Parameters as in `explain_pair`."""

    def __init__(
        self,
        trace: Trace,
        first: int,
        second: int,
        theory: Theory | None = None,
        *,
        time_limit: float | None = None,
        memory_limit: int | None = None,
        max_maps: int | None = 100,
    ) -> None:
        super().__init__(trace, theory, time_limit, memory_limit)
        for step in (first, second):
            if not is_whole(step) or not 0 <= step < len(trace):
                raise TraceError(
                    f"step: expected a step from 0 to {len(trace) - 1}, got {brief(step)}; steps are counted from 0"
                )
        if first == second:
            raise TraceError(f"step: expected two steps, got {first} twice; take another one")
        self.first, self.second = int(min(first, second)), int(max(first, second))
        self._maps = max_maps
        self._sides = {True: Side(), False: Side()}  # by whether the steps are one
        self._minimal = {True: False, False: False}  # whether a minimal map is such
        self._minimum: Cost | None = None
        self._listed = False
        self._derivation: Derivation | None = None
        self._clash: Explanation | None = None
        self._ruling_out: dict[bool, Piece] = {}  # a piece of the trace that has no such map

    def answer(self) -> PairExplanation:
        """Find out."""
        self._watch.start()
        with suppress(Interrupted, KeyboardInterrupt, LimitError):
            try:
                self._find_out()
            except KeyboardInterrupt:
                self.stopped = "interrupted"
                raise
        return self.known()

    def known(self, why: Stop | None = None) -> PairExplanation:
        """What is known so far.

        why  what is about to end the search
        """
        verdict = self._verdict()
        stopped = why or self.stopped
        return PairExplanation(
            self.first,
            self.second,
            verdict,
            self._sides[True],
            self._sides[False],
            self._listed,
            self._derivation,
            self._clash,
            stopped,
            self.theory,
        )

    def _verdict(self) -> Verdict:
        one, two = self._sides[True], self._sides[False]
        if one.possible is False or two.possible is False:
            if one.possible is two.possible:
                return Verdict.NO_MAP
            return Verdict.SAME if two.possible is False else Verdict.DIFFERENT
        if self._minimal[True] and self._minimal[False]:
            return Verdict.DISAGREE
        for here, there, verdict in (
            (True, False, Verdict.SAME_IN_MINIMAL),
            (False, True, Verdict.DIFFERENT_IN_MINIMAL),
        ):
            if self._minimal[here] and (self._listed or self._is_dearer(self._sides[there])):
                return verdict
            if self._is_beaten(self._sides[there], self._sides[here]):
                return verdict
        return Verdict.UNKNOWN

    def _is_dearer(self, side: Side) -> bool:
        """Whether all maps of a kind are known to cost more than the minimum."""
        if self._minimum is None or side.cost is None or not side.proven:
            return False
        return side.cost.preferred_by(self.theory) > self._minimum.preferred_by(self.theory)

    def _is_beaten(self, side: Side, by: Side) -> bool:
        """Whether all maps of a kind are known to cost more than one of the other kind."""
        if side.cost is None or not side.proven or by.cost is None:
            return False
        return side.cost.preferred_by(self.theory) > by.cost.preferred_by(self.theory)

    def _find_out(self) -> None:
        for one in (True, False):
            self._ask_pieces(one, SMALL)
            if self._sides[one].possible is False:
                break
        settled = False in (self._sides[True].possible, self._sides[False].possible)
        self._list_minimal_maps(settled)
        if not settled and self._verdict() not in (Verdict.NO_MAP, Verdict.DISAGREE):
            for one in (True, False):
                if not self._minimal[one] and not self._over():
                    self._find_best(one)
        if self._verdict() is Verdict.NO_MAP:
            self._clash = explain(self.trace, self.theory, self._over)
        elif self._verdict() in (Verdict.DIFFERENT, Verdict.SAME):
            one = self._verdict() is Verdict.DIFFERENT
            if one not in self._ruling_out:
                self._ask_pieces(one, LARGE)
            if one in self._ruling_out:
                piece = self._shrunk(self._ruling_out[one], one)
                self._derivation = derive(
                    piece, self.trace, self.first, self.second, one=not one, stop=self._over
                )

    # Few steps around the pair

    def _ask_pieces(self, one: bool, most: int) -> None:
        """Find a piece of the trace, of so many steps at most, that has no map in which the steps are one, or are not."""
        for steps in self._pieces(most):
            piece = Piece.of(self.trace, self.theory, steps)
            if not self._has_map(piece, one):
                self._sides[one] = replace(self._sides[one], possible=False)
                self._ruling_out[one] = piece
                return

    def _pieces(self, most: int) -> Iterator[list[int]]:
        """Steps around the pair, from few to many. Where axioms need not survive a cut, there is only the whole trace."""
        whole = range(len(self.trace))
        if self.theory.rules or self.theory.has_faults:
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
            if (
                self.second - self.first <= most // 2
            ):  # the way from one to the other is short, and says much
                near |= set(range(self.first, self.second + 1))
            steps = sorted(near)
            if len(steps) > most or steps == before:
                return
            yield steps
            before = steps
            width += 1 + width // 2

    def _has_map(self, piece: Piece, one: bool) -> bool:
        pair = piece.steps.index(self.first), piece.steps.index(self.second)
        return Axioms(piece, self._over).consistent(assumed=[(facts.are_one(*pair), one)])

    def _shrunk(self, piece: Piece, one: bool) -> Piece:
        """The piece without the steps at its ends that it does not need."""
        if self.theory.rules or self.theory.has_faults:
            return piece
        for t in (*piece.steps, *reversed(piece.steps)):
            if t in (self.first, self.second) or t not in piece.steps:
                continue
            ends = [k for k in piece.steps if k - 1 not in piece.steps or k + 1 not in piece.steps]
            if t not in ends:
                continue
            fewer = Piece.of(self.trace, self.theory, [k for k in piece.steps if k != t])
            if not self._has_map(fewer, one):
                piece = fewer
        return piece

    # The whole trace

    def _list_minimal_maps(self, settled: bool) -> None:
        """List minimal maps, and count those in which the steps are one. Where the verdict is settled, it is only asked whether there is any map."""
        left = self._watch.left()
        seconds = (
            min(left, max(CONFIRMING, 0.0 if self.limit is None else self.limit / 10))
            if settled
            else left * SHARE
        )
        search = self._solved(self.trace, self.theory, 1 if settled else self._maps, seconds)
        for found in search:
            one = found.labels[self.first] == found.labels[self.second]
            side = self._sides[one]
            if search.status is Status.OPTIMAL:
                self._minimum = search.cost
                self._minimal[one] = True
                self._sides[one] = replace(
                    side, possible=True, cost=search.cost, proven=True, maps=side.maps + 1
                )
            elif side.cost is None:
                self._sides[one] = replace(side, possible=True, cost=search.cost)
        if search.status is Status.UNSATISFIABLE:
            self._sides = {True: Side(possible=False), False: Side(possible=False)}
        self._listed = search.complete and not settled
        self._ended(search)

    def _find_best(self, one: bool) -> None:
        """Find the best map in which the steps are one, or are not."""
        name = "same" if one else "different"
        theory = self.theory.replace(
            **{name: (*getattr(self.theory, name), (self.first, self.second))}
        )
        search = self._solved(
            self.trace,
            theory,
            1,
            self._watch.left() * (SHARE if self._minimum is None else 2 * SHARE),
        )
        for _ in search:
            self._sides[one] = replace(
                self._sides[one],
                possible=True,
                cost=search.cost,
                proven=search.status is Status.OPTIMAL,
            )
        if search.status is Status.UNSATISFIABLE:
            self._sides[one] = Side(possible=False)
        elif (
            self._sides[one].cost
            and self._minimum
            and self._sides[one].proven
            and not self._is_dearer(self._sides[one])
        ):
            self._minimal[one] = True
            self._sides[one] = replace(self._sides[one], maps=max(1, self._sides[one].maps))
        elif self._minimum is None and all(
            side.proven and side.cost for side in self._sides.values()
        ):
            self._settle_minimum()
        self._ended(search)

    def _settle_minimum(self) -> None:
        """The best maps of both kinds are known: the better of them are minimal."""
        costs = {
            one: side.cost.preferred_by(self.theory)
            for one, side in self._sides.items()
            if side.cost
        }
        least = min(costs, key=lambda one: costs[one])
        self._minimum = self._sides[least].cost
        self._minimal = {one: cost == costs[least] for one, cost in costs.items()}


class TraceQuestion(_Question):
    """Asks why a trace has no map, and what would mend it. Parameters as in `explain_trace`."""

    def __init__(
        self,
        trace: Trace,
        theory: Theory | None = None,
        *,
        time_limit: float | None = None,
        memory_limit: int | None = None,
    ) -> None:
        super().__init__(trace, theory, time_limit, memory_limit)
        self._possible: bool | None = None
        self._clash: Explanation | None = None
        self._mends: list[Mend] = []
        self._complete = False

    def answer(self) -> TraceExplanation:
        """Find out."""
        self._watch.start()
        with suppress(Interrupted, KeyboardInterrupt, LimitError):
            try:
                self._find_out()
            except KeyboardInterrupt:
                self.stopped = "interrupted"
                raise
        return self.known()

    def known(self, why: Stop | None = None) -> TraceExplanation:
        """What is known so far.

        why  what is about to end the search
        """
        mends = tuple(sorted(self._mends, key=lambda mend: (mend.step, mend.kind)))
        return TraceExplanation(
            self._possible, self._clash, mends, self._complete, why or self.stopped
        )

    def _find_out(self) -> None:
        search = self._solved(self.trace, self.theory, 1, self._watch.left() * SHARE)
        for _ in search:
            self._possible = True
            break
        self._ended(search)
        if self._possible:
            return
        self._clash = explain(self.trace, self.theory, self._over)
        self._possible = self._clash is None
        if self._clash is None:
            return
        stretch = range(self._clash.first, self._clash.last + 1)
        for step, kind, seen, changes in self._observations(stretch):
            for instead, trace, theory in changes:
                if self._over():
                    return
                piece = Piece.of(trace, theory, stretch)
                if not self._suits(trace, theory) or not Axioms(piece, self._over).consistent():
                    continue
                found = self._has_map(trace, theory)
                if found is not False:
                    self._mends.append(Mend(step, kind, seen, instead, proven=bool(found)))
                    break
        self._complete = True

    def _suits(self, trace: Trace, theory: Theory) -> bool:
        """Whether the changed trace still has what the theory reads."""
        try:
            theory.resolve(trace)
        except AbductionError:
            return False
        return True

    def _has_map(self, trace: Trace, theory: Theory) -> bool | None:
        """Whether a whole trace has a map; None where that is not found out in time."""
        search = self._solved(trace, theory, 1, self._watch.left() * SHARE)
        found = next(iter(search), None)
        self._ended(search)
        return (
            True if found is not None else False if search.status is Status.UNSATISFIABLE else None
        )

    def _observations(
        self, stretch: range
    ) -> Iterator[tuple[int, str, str, Iterable[tuple[str | None, Trace, Theory]]]]:
        """Each observation of a stretch, and what it could have been: the step, its kind, what was seen, and the traces in which it is another one."""
        trace, theory = self.trace, self.theory
        for t in stretch:
            step = trace.steps[t]
            yield t, "view", repr(step.view), self._with_views(t)
            if step.star is not None and theory.star != "none":
                yield t, "star", _star(step), self._with_stars(t)
            if t < stretch[-1] and step.action is not None:
                yield t, "action", repr(step.action.name), self._with_actions(t)
            if t > stretch[0] and step.displacement is not None and theory.displacement == "use":
                unknown = _with_step(trace, t, replace(step, displacement=None, covariance=None))
                yield (
                    t,
                    "displacement",
                    str(tuple(round(x, 3) for x in step.displacement)),
                    [(None, unknown, theory)],
                )
        for name in ASSERTIONS:
            pairs = getattr(theory, name)
            for pair in pairs:
                if set(pair) <= set(stretch):
                    left = theory.replace(
                        **{name: tuple(other for other in pairs if other != pair)}
                    )
                    yield pair[1], name, f"{pair[0]} and {pair[1]}", [(None, trace, left)]

    def _with_views(self, t: int) -> Iterator[tuple[str, Trace, Theory]]:
        step = self.trace.steps[t]
        views = [
            view
            for view in dict.fromkeys(self.trace.views)
            if view is not None and view != step.view
        ]
        new: View = next(name for name in _names("new view") if name not in views)
        for view in views:
            yield repr(view), _with_step(self.trace, t, replace(step, view=view)), self.theory
        yield NEW_VIEW, _with_step(self.trace, t, replace(step, view=new)), self.theory

    def _with_stars(self, t: int) -> Iterator[tuple[str, Trace, Theory]]:
        step = self.trace.steps[t]
        for star in dict.fromkeys(
            other.star for other in self.trace.steps if other.star is not None
        ):
            if star != step.star:
                changed = replace(step, star=star)
                yield _star(changed), _with_step(self.trace, t, changed), self.theory

    def _with_actions(self, t: int) -> Iterator[tuple[str | None, Trace, Theory]]:
        step = self.trace.steps[t]
        known = {action.name: action for action in self.trace.actions}
        if self.theory.level == "topological":
            kinds = {(action.kind, action.turn) for action in known.values()}
            known |= {
                a.name: a
                for a in STANDARD_ACTIONS.values()
                if (a.kind, a.turn) not in kinds and a.name not in known
            }
        for action in known.values():
            if step.action is not None and action.name != step.action.name:
                yield (
                    repr(action.name),
                    _with_step(self.trace, t, replace(step, action=action)),
                    self.theory,
                )
        yield (
            None,
            _with_step(self.trace, t, replace(step, action=Action.that_slipped(t))),
            self.theory,
        )


def _with_step(trace: Trace, t: int, step: Step) -> Trace:
    return replace(trace, steps=(*trace.steps[:t], step, *trace.steps[t + 1 :]))


def _names(stem: str) -> Iterator[str]:
    """Names that begin so."""
    yield stem
    number = 1
    while True:
        number += 1
        yield f"{stem} {number}"


def _star(step: Step) -> str:
    return str(step.to_json()["star"])


def _counts(cost: Cost, names: Iterable[str]) -> Iterator[tuple[str, float]]:
    """The preferred counts of a cost, by name."""
    for name in names:
        yield ("tenths", cost.tenths / 10) if name == "tenths" else (name, getattr(cost, name))


def _told(cost: Cost, names: Iterable[str]) -> str:
    """The preferred counts of a cost in words."""
    return (
        ", ".join(f"{number:g} {_noun(name, number)}" for name, number in _counts(cost, names))
        or "no count is preferred"
    )


def _noun(name: str, number: float) -> str:
    noun = "dstates with its faults" if name == "tenths" else name
    return noun.removesuffix("s") if number == 1 and name != "tenths" else noun


def _difference(lost: Cost, won: Cost, theory: Theory) -> str:
    """What a rival costs that lost: the first preferred count in which it differs, and those before it, which are the same."""
    same: list[str] = []
    for (name, one), (_, other) in zip(
        _counts(lost, theory.priorities), _counts(won, theory.priorities), strict=True
    ):
        if one != other:
            return f"{one:g} {_noun(name, one)}, not {other:g}" + (
                f", with {' and '.join(same)}" if same else ""
            )
        same.append(f"{one:g} {_noun(name, one)}")
    return f"{_told(lost, theory.priorities)}, as many as the minimal maps"
