"""Explain why a trace has no map, and answer questions about a trace within limits.

>>> from ssh_abduction import Theory, Trace
>>> from ssh_abduction.explain.no_map import explain
>>> trace = Trace.from_steps(views=["a", "b", "c", "d"], actions=["travel", "around", "around"])
>>> explanation = explain(trace, Theory.topological())
>>> explanation.first, explanation.last, explanation.axioms[0]
(0, 3, 'functional_view')

The explanation is a stretch of the trace (consecutive steps) that has no map, and a minimal set of
pairs (axiom, step) that no map of the stretch satisfies. With fewer steps at either end, the
stretch has a map.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import chain, count, groupby
from operator import itemgetter
from typing import Any, Generic, TypedDict, TypeVar

from ssh_abduction.data.checks import a_whole_number, check_limit
from ssh_abduction.data.corrections import ASSERTIONS
from ssh_abduction.data.drives import drives_of, named_steps
from ssh_abduction.data.errors import AbductionError, TheoryError, TraceError
from ssh_abduction.data.groups import gathered
from ssh_abduction.data.maps import SSHMap, check_of_trace, checked_maps
from ssh_abduction.data.schema import PlainData, attributes_of
from ssh_abduction.data.trace import STANDARD_ACTIONS, Action, Step, Trace
from ssh_abduction.data.words import noun_of
from ssh_abduction.explain.axioms import Axioms, Interrupted, Piece
from ssh_abduction.runtime.limits import LimitError, Watch
from ssh_abduction.solution import Progress, Status, Stop
from ssh_abduction.solver import Search, Start, check_rules
from ssh_abduction.theory.settle import displacement_of, settle
from ssh_abduction.theory.theory import Theory, checked_theory

# Stretches of this many steps are tried first. They overlap by a step, so that each action is in
# one. A stretch takes about 30 ms. Shorter ones take 13 ms, and 16 steps take 120 ms.
STRETCH = 8
NEW_VIEW = "a view never seen"
# Share of the remaining time that each search of the whole trace may take.
SHARE = 0.45
SHORTEST = 0.05  # the least time limit of a search in seconds
_Answer = TypeVar("_Answer")


@dataclass(frozen=True, slots=True)
class ClashingAxiom(PlainData):
    """An axiom that cannot hold at all these steps together with the other axioms of a clash."""

    axiom: str  # the name of the axiom
    # The steps. If the axiom is about several steps at once, the last one is listed.
    steps: tuple[int, ...]


def steps_listed(steps: Sequence[int]) -> str:
    """List steps in words: "steps 3, 4"."""
    return f"{noun_of('step', steps)} {', '.join(map(str, steps))}"


def clashes_of(links: Iterable[tuple[str, int]]) -> tuple[ClashingAxiom, ...]:
    """Group links (pairs of an axiom and a step) by axiom, in the order of first links."""
    steps = gathered(links)
    return tuple(ClashingAxiom(axiom, tuple(sorted({*some}))) for axiom, some in steps.items())


@dataclass(frozen=True, slots=True)
class Explanation(PlainData):
    """A stretch of the trace without a map, and a minimal set of axioms that clash there.

    The set is minimal: if one axiom is dropped at only one step, a map satisfies the rest.

    Attributes:
        first: The first step of the stretch.
        last: The last step of the stretch.
        clashes: The axioms that clash, each with its steps. Empty if the time was too short to find
            them.
        sentences: If displacements take part in the clash (axiom `one_pose`), sentences about the
            returns (two steps at one place or dstate) that displacements reject. At most three
            for each last step of a return, the clearest first. Otherwise empty.
    """

    first: int
    last: int
    clashes: tuple[ClashingAxiom, ...]
    sentences: tuple[str, ...] = ()

    @property
    def axioms(self) -> tuple[str, ...]:
        """The names of the axioms that clash."""
        return tuple(clash.axiom for clash in self.clashes)

    def __str__(self) -> str:
        parts = [f"{clash.axiom} ({steps_listed(clash.steps)})" for clash in self.clashes]
        many = f"steps {self.first} to {self.last}"
        where = f"step {self.last}" if self.first == self.last else many
        clash = f"these clash: {', '.join(parts)}" if parts else "some clash"
        return f"no map satisfies the axioms: in {where} {clash}"


def explain(
    trace: Trace,
    theory: Theory | None = None,
    stop: Callable[[], bool] = lambda: False,
    near: range | None = None,
) -> Explanation | None:
    """Explain why a trace has no map; None if it has one.

    First find a stretch of steps without a map. Try the steps `near`, then short stretches, then
    the whole trace. Then drop steps from the end and from the start, as long as the other steps
    have no map. Then drop axioms one by one, until each axiom that is left is needed for the clash.
    `stop` is called now and then. If it returns True, Interrupted is raised. Raises TraceError
    and TheoryError as `solve` does, and if the theory allows wrong displacements (`jumped`).
    """
    problem = settle(trace, theory)
    theory = problem.theory
    if theory.jumped:
        raise TheoryError(
            f"jumped: expected 0, as an explanation treats no displacement as wrong, got "
            f"{theory.jumped:g}; leave it out (--set jumped=0)"
        )
    theory.check_steps(trace)
    check_rules(theory)

    def has_no_map(first: int, end: int) -> bool:
        return not Axioms(Piece.of(problem, range(first, end)), stop).consistent()

    begins = range(0, max(len(trace) - 1, 1), STRETCH - 1)
    stretches = [(begin, min(begin + STRETCH, len(trace))) for begin in begins]
    stretches[:0] = [(near.start, near.stop)] if near else []
    begin, before = next((s for s in stretches if has_no_map(*s)), (0, len(trace)))
    # Drop steps from the end, then from the start.
    length = shortest(before - begin, lambda n: has_no_map(begin, begin + n))
    if length is None:
        return None
    end = begin + length
    first = end - (shortest(length, lambda n: has_no_map(end - n, end)) or length)
    last = end - 1
    piece = Piece.of(problem, range(first, last + 1))
    axioms = Axioms(piece, stop, relaxed=True)
    clash = axioms.smallest_clash()
    in_order = sorted(clash, key=lambda pair: theory.axioms.index(pair[0]))
    found = clashes_of((axiom, piece.steps[step]) for axiom, step in in_order)
    return Explanation(piece.steps[0], piece.steps[-1], found, axioms.sentences(clash))


def why_apart(trace: Trace, first: int, second: int, theory: Theory | None = None) -> str | None:
    """Say why displacements rule out that two steps are one dstate, or at one place.

    Args:
        trace: The trace, with displacements.
        first: A step, counted from 0.
        second: Another step.
        theory: The theory; Theory.topological() if None.

    Returns:
        A sentence. None if displacements allow that the steps are one dstate, or if the theory does
        not use displacements.

    Raises:
        TraceError: The trace has no such step, or both steps are the same.
    """
    problem = settle(trace, theory)
    check_two_steps(trace, first, second)
    displacement = displacement_of(problem)
    if displacement is None:
        return None
    return displacement.returns_of(trace).why_apart(min(first, second), max(first, second))


def check_two_steps(trace: Trace, first: object, second: object) -> None:
    """Raise TraceError if these are not two different steps of a trace."""
    for step in (first, second):
        mend = "steps are counted from 0"
        a_whole_number("step", step, TraceError, 0, len(trace) - 1, what="a step", mend=mend)
    if first == second:
        raise TraceError(f"step: expected two steps, got {first} twice; take another one")


def shortest(longest: int, has_no_map: Callable[[int], bool]) -> int | None:
    """Find the least number of steps without a map, by doubling and bisection.

    This is exact, because a longer stretch has no map if a shorter one has none. None if even the
    longest stretch has a map.
    """
    short, long = 0, 1
    while not has_no_map(long):
        if long == longest:
            return None
        short, long = long, min(2 * long, longest)
    while long - short > 1:
        middle = (short + long) // 2
        short, long = (short, middle) if has_no_map(middle) else (middle, long)
    return long


def explain_trace(
    trace: Trace,
    theory: Theory | None = None,
    *,
    time_limit: float | None = None,
    memory_limit: int | None = None,
) -> TraceExplanation:
    """Explain why a trace has no map, and find single observations whose change gives it a map.

    An observation is a view, a star (openings), an action, a displacement, or an asserted pair.
    First the shortest stretch of the trace without a map is found. Each observation in this stretch
    is then replaced by other values from the trace, or dropped. Such a change is a mend if it gives
    the whole trace a map.

    Args:
        trace: The trace, with views.
        theory: The theory; Theory.topological() if None.
        time_limit: Seconds; None for no limit. At the limit the answer says what is known by then.
        memory_limit: MiB; None for no limit.

    Returns:
        Whether the trace has a map. If it has none, also the reason and the mends.
    """
    return TraceQuestion(
        trace, checked_theory(theory), time_limit=time_limit, memory_limit=memory_limit
    ).answer()


@dataclass(frozen=True, slots=True)
class Mend:
    """An observation whose change gives a trace a map."""

    step: int  # the step of the observation; the later step of an asserted pair
    # "view", "star", "action" or "displacement"; "same", "different", "elsewhere" or "same_place"
    # for an asserted pair.
    kind: str
    seen: str  # the value in the trace, in words
    # A value, in words, with which there is a map; None if the observation is dropped.
    instead: str | None
    # Whether the whole changed trace is known to have a map, not only the stretch that had none.
    proven: bool

    def __str__(self) -> str:
        if self.kind in ASSERTIONS:
            what = f"without the assertion about steps {self.seen} ({self.kind})"
        elif self.instead is None:
            what = f"if the {self.kind} at step {self.step}, {self.seen}, were wrong"
        else:
            what = f"if the {self.kind} at step {self.step} were {self.instead}, not {self.seen}"
        return f"{what}, {'the trace' if self.proven else 'at least that stretch'} would have a map"

    def to_dict(self) -> dict[str, Any]:
        """Return the mend as plain data, as `explain --json` prints it."""
        return attributes_of(self, "step", "kind", "seen", "instead", "proven") | {
            "sentence": str(self)
        }


@dataclass(frozen=True, slots=True)
class TraceExplanation:
    """The reason why a trace has no map, and the single observations whose change gives it one.

    Attributes:
        possible: Whether the trace has a map; None if a limit ended the search before this was
            known.
        clash: A stretch of the trace without a map, and a minimal set of axioms that clash there.
            None if the trace has a map, or if a limit ended the search before.
        mends: The observations whose change gives the trace a map, sorted by step.
        complete: Whether all observations of the stretch were tried.
        stopped: The limit that ended the search; None if it ended by itself.
    """

    possible: bool | None
    clash: Explanation | None
    mends: tuple[Mend, ...]
    complete: bool
    stopped: Stop | None

    @property
    def sentences(self) -> tuple[str, ...]:
        """The answer in words, a tuple of sentences."""
        if self.possible:
            return ("the trace has a map; name two steps to ask whether they are one dstate",)
        if self.clash is None:
            return (f"it is unknown whether the trace has a map ({self.stopped or 'no proof'})",)
        mends = tuple(map(str, self.mends))
        if not mends and self.complete:
            mends = ("no change of a single observation in that stretch leaves a map",)
        elif not self.complete:
            mends += (f"not all observations were tried ({self.stopped})",)
        return (str(self.clash), *self.clash.sentences, *mends)

    def __str__(self) -> str:
        return "\n".join(self.sentences)

    def to_dict(self) -> dict[str, Any]:
        """Return the answer as plain data, as `explain --json` prints it."""
        own = attributes_of(self, "possible", "sentences", "clash", "mends", "complete")
        return own | ({"stopped": self.stopped} if self.stopped else {})


class QuestionLimits(TypedDict, total=False):
    """The limits of a question, and known maps of its trace, as in `LimitedQuestion`."""

    time_limit: float | None
    memory_limit: int | None
    known: Iterable[SSHMap]


class LimitedQuestion(ABC, Generic[_Answer]):
    """A question about a trace under limits of time and memory.

    `answer` may be called once. `known` may be called from any thread while `answer` runs.
    Parameters as in `explain_pair`.
    """

    def __init__(
        self,
        trace: Trace,
        theory: Theory | None,
        time_limit: float | None = None,
        memory_limit: int | None = None,
        known: Iterable[SSHMap] = (),
    ) -> None:
        check_limit("time_limit (--time-limit)", "seconds", time_limit)
        check_limit("memory_limit (--memory-limit)", "MiB", memory_limit)
        self.problem = settle(trace, theory)
        self.trace, self.theory = trace, self.problem.theory
        self.theory.check_steps(trace)
        check_rules(self.theory)
        self.limit, self.memory = time_limit, memory_limit
        self._known_maps = [*checked_maps(known)]
        check_of_trace(self._known_maps, trace, "known", views=False)
        self.stopped: Stop | None = None
        self._watch = Watch(time_limit, memory_limit)
        self._search: Search | None = None

    def answer(self) -> _Answer:
        """Find the answer. At a limit or Ctrl-C, return what is known by then."""
        self._watch.start()
        with suppress(Interrupted, KeyboardInterrupt, LimitError):
            try:
                self._find_out()
            except KeyboardInterrupt:
                self.stopped = "interrupted"
                raise
        return self.known()

    @abstractmethod
    def known(self, why: Stop | None = None) -> _Answer:
        """Return what is known so far. `why` is the limit that is about to end the search."""

    @abstractmethod
    def _find_out(self) -> None:
        """Find the answer and store it in attributes. At a limit, raise an exception."""

    def interrupt(self) -> None:
        """Make `answer` return soon. Call this from another thread or a signal handler."""
        self._watch.interrupted = True
        if self._search is not None:
            self._search.interrupt()

    def _over(self) -> bool:
        """Tell whether a limit has been reached, and store it in `stopped`."""
        try:
            self._watch.check()
        except LimitError as limit:
            self.stopped = limit.reason
        return self.stopped is not None

    def _solved(self, trace: Trace, theory: Theory, maps: int | None, seconds: float) -> Search:
        """Make a search for maps that ends at the limits of this question."""

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
            _start=Start(known=tuple(self._known_maps)),
        )
        return search

    def _ended(self, search: Search) -> None:
        """Store in `stopped` why a search ended early, if a limit of this question was reached."""
        self._search = None
        if search.stopped in ("interrupted", "memory limit"):
            self.stopped = search.stopped
        self._over()


class TraceQuestion(LimitedQuestion[TraceExplanation]):
    """The search for the answer of `explain_trace`, with the same parameters."""

    _possible: bool | None = None
    _clash: Explanation | None = None
    _mends: tuple[Mend, ...] = ()
    _complete: bool = False

    def known(self, why: Stop | None = None) -> TraceExplanation:
        """Return what is known so far. `why` is the limit that is about to end the search."""
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
        for (step, kind, seen), changed in groupby(self._changes(stretch), key=itemgetter(0)):
            for _, instead, trace, theory in changed:
                if self._over():
                    return
                try:
                    settle(trace, theory)
                except AbductionError:  # the changed trace lacks what the theory needs
                    continue
                # the stretch is checked first, as it is much faster than the whole trace
                piece = Piece.of(self.problem.changed(trace, theory), stretch)
                if not Axioms(piece, self._over).consistent():
                    continue
                found = self._has_map(trace, theory)
                if found is not False:
                    self._mends += (Mend(step, kind, seen, instead, bool(found)),)
                    break
        self._complete = True

    def _has_map(self, trace: Trace, theory: Theory) -> bool | None:
        """Tell whether a whole trace has a map; None if there is no answer in time."""
        search = self._solved(trace, theory, 1, self._watch.left() * SHARE)
        found = next(iter(search), None)
        self._ended(search)
        if found is not None:
            return True
        return False if search.status is Status.UNSATISFIABLE else None

    def _changes(
        self, stretch: range
    ) -> Iterator[tuple[tuple[int, str, str], str | None, Trace, Theory]]:
        """Yield changes of single observations of a stretch.

        Each has the step, kind and value of the observation, the other value in words (None if the
        observation is dropped), the changed trace, and the changed theory. A view may be another
        one or a new one, a star another one of the trace. An action may be another one, or unknown.
        """
        trace, theory = self.trace, self.theory
        names = named_steps(drives_of(trace), len(trace))
        views = [view for view in dict.fromkeys(trace.views) if view is not None]
        new_views = chain(["new view"], (f"new view {number}" for number in count(2)))
        new = next(name for name in new_views if name not in views)
        stars = [s for s in dict.fromkeys(step.star for step in trace.steps) if s is not None]
        for t in names[stretch.start : stretch.stop]:
            step = trace.steps[t]
            # The kind, the value, and for each other value its words and the changed step.
            others: dict[tuple[str, str], list[tuple[str | None, Step]]] = {}
            others["view", repr(step.view)] = [
                *((repr(v), replace(step, view=v)) for v in views if v != step.view),
                (NEW_VIEW, replace(step, view=new)),
            ]
            if step.star is not None and theory.star != "none":
                starred = [replace(step, star=star) for star in stars if star != step.star]
                others["star", _star(step)] = [(_star(other), other) for other in starred]
            if t < stretch[-1] and step.action is not None and not step.action.starts:
                others["action", repr(step.action.name)] = [
                    *((repr(a.name), replace(step, action=a)) for a in self._other_actions(t)),
                    (None, replace(step, action=Action.that_slipped(t))),
                ]
            for (kind, seen), listed in others.items():
                for instead, other in listed:
                    steps = (*trace.steps[:t], other, *trace.steps[t + 1 :])
                    yield (t, kind, seen), instead, replace(trace, steps=steps), theory
            if t > stretch[0] and step.displacement is not None and theory.displacement == "use":
                moved = str(tuple(round(x, 3) for x in step.displacement))
                unknown = trace.without_displacements_at([t])
                yield (t, "displacement", moved), None, unknown, theory
        for name in ASSERTIONS:
            pairs = getattr(theory, name)
            for pair in pairs:
                if set(pair) <= set(stretch):
                    left = theory.replace(**{name: tuple(p for p in pairs if p != pair)})
                    first, second = (names[t] for t in pair)
                    yield (second, name, f"{first} and {second}"), None, trace, left

    def _other_actions(self, t: int) -> list[Action]:
        """List other actions of the trace and, with paths, one of each standard kind.

        A lift is no alternative if the next step has a displacement: a lift has none.
        """
        moves = self.trace.steps[t + 1].displacement is not None
        known = {action.name: action for action in self.trace.actions if not action.starts}
        if self.theory.level == "topological":
            kinds = {(action.kind, action.turn) for action in known.values()}
            standard = (a for a in STANDARD_ACTIONS.values() if (a.kind, a.turn) not in kinds)
            known |= {a.name: a for a in standard if a.name not in known}
        done = self.trace.steps[t].action
        return [a for a in known.values() if a != done and not (moves and a.breaks_frame)]


def _star(step: Step) -> str:
    """Return the star of a step in words."""
    return str(step.to_json()["star"])
