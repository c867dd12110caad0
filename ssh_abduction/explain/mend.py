"""Explain why a trace has no map, and find single observations whose change gives it a map."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import chain, count
from typing import Any, Unpack

from ssh_abduction.data.corrections import ASSERTIONS
from ssh_abduction.data.drives import drives_of, named_steps
from ssh_abduction.data.errors import AbductionError
from ssh_abduction.data.trace import STANDARD_ACTIONS, Action, Step, Trace
from ssh_abduction.data.words import attributes_of
from ssh_abduction.explain.axioms import Axioms
from ssh_abduction.explain.no_map import Explanation, explain
from ssh_abduction.explain.piece import Piece
from ssh_abduction.explain.question import LimitedQuestion, QuestionLimits
from ssh_abduction.solver import Status, Stop
from ssh_abduction.theory.settle import settle
from ssh_abduction.theory.theory import Theory, checked_theory

NEW_VIEW = "a view never seen"
# Share of the remaining time that each search of the whole trace may take.
SHARE = 0.45


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


class TraceQuestion(LimitedQuestion[TraceExplanation]):
    """The search for the answer of `explain_trace`, with the same parameters."""

    def __init__(
        self, trace: Trace, theory: Theory | None = None, **limits: Unpack[QuestionLimits]
    ) -> None:
        super().__init__(trace, theory, **limits)
        self._possible: bool | None = None
        self._clash: Explanation | None = None
        self._mends: list[Mend] = []
        self._complete = False

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
        for step, kind, seen, changes in self._observations(stretch):
            for instead, trace, theory in changes:
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
                    self._mends.append(Mend(step, kind, seen, instead, proven=bool(found)))
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

    def _observations(
        self, stretch: range
    ) -> Iterator[tuple[int, str, str, Iterable[tuple[str | None, Trace, Theory]]]]:
        """Yield the step, kind, value and alternatives of each observation of a stretch.

        An alternative is the other value in words (None if the observation is dropped), the changed
        trace, and the changed theory.
        """
        trace, theory = self.trace, self.theory
        names = named_steps(drives_of(trace), len(trace))
        for t in names[stretch.start : stretch.stop]:
            step = trace.steps[t]
            yield t, "view", repr(step.view), self._with_views(t)
            if step.star is not None and theory.star != "none":
                yield t, "star", _star(step), self._with_stars(t)
            if t < stretch[-1] and step.action is not None and not step.action.starts:
                yield t, "action", repr(step.action.name), self._with_actions(t)
            if t > stretch[0] and step.displacement is not None and theory.displacement == "use":
                unknown = trace.without_displacements_at([t])
                moved = tuple(round(x, 3) for x in step.displacement)
                yield t, "displacement", str(moved), [(None, unknown, theory)]
        for name in ASSERTIONS:
            pairs = getattr(theory, name)
            for pair in pairs:
                if set(pair) <= set(stretch):
                    left = theory.replace(**{name: tuple(p for p in pairs if p != pair)})
                    first, second = (names[t] for t in pair)
                    yield second, name, f"{first} and {second}", [(None, trace, left)]

    def _with_views(self, t: int) -> Iterator[tuple[str, Trace, Theory]]:
        """Yield alternatives to the view of a step: all other views, and a new one."""
        views = dict.fromkeys(self.trace.views, "")
        others = [view for view in views if view not in (None, self.trace.steps[t].view)]
        names = chain(["new view"], (f"new view {number}" for number in count(2)))
        for view in others:
            yield repr(view), self._changed(t, view=view), self.theory
        new = next(name for name in names if name not in views)
        yield NEW_VIEW, self._changed(t, view=new), self.theory

    def _with_stars(self, t: int) -> Iterator[tuple[str, Trace, Theory]]:
        """Yield alternatives to the star of a step: all other stars of the trace."""
        for star in dict.fromkeys(step.star for step in self.trace.steps):
            if star is not None and star != self.trace.steps[t].star:
                changed = self._changed(t, star=star)
                yield _star(changed.steps[t]), changed, self.theory

    def _with_actions(self, t: int) -> Iterator[tuple[str | None, Trace, Theory]]:
        """Yield alternatives to the action of a step: other actions, and an unknown one.

        A lift is no alternative if the next step has a displacement: a lift has none.
        """
        step = self.trace.steps[t]
        moves = self.trace.steps[t + 1].displacement is not None
        known = {action.name: action for action in self.trace.actions if not action.starts}
        if self.theory.level == "topological":
            kinds = {(action.kind, action.turn) for action in known.values()}
            known |= {
                a.name: a
                for a in STANDARD_ACTIONS.values()
                if (a.kind, a.turn) not in kinds and a.name not in known
            }
        for action in known.values():
            is_other = step.action is not None and action.name != step.action.name
            if is_other and not (moves and action.breaks_frame):
                yield repr(action.name), self._changed(t, action=action), self.theory
        yield None, self._changed(t, action=Action.that_slipped(t)), self.theory

    def _changed(self, t: int, **fields: Any) -> Trace:
        """Return the trace with other fields at step t."""
        steps = self.trace.steps
        step = replace(steps[t], **fields)
        return replace(self.trace, steps=(*steps[:t], step, *steps[t + 1 :]))


def _star(step: Step) -> str:
    """Return the star of a step in words."""
    return str(step.to_json()["star"])
