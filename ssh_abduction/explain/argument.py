"""Find an argument why two steps are different dstates in every map, or one dstate in every map.

`explain_pair` returns such an argument as `PairExplanation.derivation`.

The argument uses a minimal set of links. A link is an axiom at one step. Each line of the argument
adds a link, and clingo finds the conclusions that hold in all maps that satisfy the links so far.
So each line follows from the lines before it and its link.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import clingo

from ssh_abduction.data.corrections import ASSERTED, ASSERTIONS
from ssh_abduction.data.odometry import match_in_words
from ssh_abduction.data.trace import Trace
from ssh_abduction.explain.axioms import (
    Assumption,
    Axioms,
    Piece,
    active_at,
    conclusion_of,
    read_conclusion,
)
from ssh_abduction.explain.no_map import clashes_of, why_apart
from ssh_abduction.explain.verdict import Derivation, Inference, Link
from ssh_abduction.solver import facts
from ssh_abduction.theory import encodings
from ssh_abduction.theory.fields import EXCUSED

# In a piece of at most this many steps, an argument may mention all steps. In a longer piece it
# mentions only the steps of its links, to keep the number of conclusions small.
FEW_STEPS = 14
# If one of several conclusions suffices as a premise, conclusions earlier in this list are
# preferred.
_PREFERRED = (
    "on",
    "right",
    "left",
    "one_dstate",
    "two_dstates",
    "one_place",
    "two_places",
    "one_course",
    "opposite",
    "ahead",
    "branch_right",
    "branch_left",
)


# Axioms about actions. Their violation at a step is caused by the action before the step.
OF_ACTIONS = EXCUSED["slipped"] | {"branch_side"}
_WORDS = {
    "one_dstate": "steps {0} and {1} {are} one dstate",
    "two_dstates": "steps {0} and {1} {are} different dstates",
    "one_place": "steps {0} and {1} {are} at one place",
    "two_places": "steps {0} and {1} {are} at different places",
    "along": "step {0} {is} along a path",
    "along_none": "step {0} {is} along no path",
    "one_course": "steps {0} and {1} {are} along one path in the same direction",
    "opposite": "steps {0} and {1} {are} along one path in opposite directions",
    "two_paths": "steps {0} and {1} {are} along different paths",
    "on": "step {0} {is} at a place on {path1}",
    "ahead": "the place of step {1} {is} ahead of the place of step {0} on {path2}",
    "branch_right": "{path1} {leaves} to the right of {path0}",
    "branch_left": "{path1} {leaves} to the left of {path0}",
    "right": "step {0} {is} at a place to the right of {path1}",
    "left": "step {0} {is} at a place to the left of {path1}",
    "turned": "steps {0} and {1} {are} at one place, and step {1} {faces} {turn} step {0}",
}
# Conclusions about two steps that read the same in either order.
_SYMMETRIC = frozenset(
    ("one_dstate", "two_dstates", "one_place", "two_places", "one_course", "opposite", "two_paths")
)
# How a step faces relative to another step, if it is turned 0, 1, 2 or 3 quarters clockwise.
_TURNED = (
    "the same way as",
    "a quarter to the right of",
    "the opposite way of",
    "a quarter to the left of",
)


@dataclass(frozen=True)
class _Inferred:
    """A line of an argument: the conclusions that follow from its links and the lines before it.

    `group` has the links. A line without conclusions is the contradiction. A line that is
    `supposed` holds only if the opposite of what is to be shown is supposed.
    """

    group: tuple[tuple[str, int], ...]
    conclusions: frozenset[clingo.Symbol]
    supposed: bool


class Argument:
    """The search for an argument that two steps are one dstate in all maps, or else in none.

    Inside this class steps have their numbers in the piece. Sentences give their numbers in the
    whole trace.
    """

    def __init__(
        self,
        piece: Piece,
        trace: Trace,
        pair: tuple[int, int],
        *,
        one: bool,
        stop: Callable[[], bool],
    ) -> None:
        """Find the links of the argument. `derivation` finds its lines.

        Args:
            piece: A piece whose steps suffice for the proof. The caller must have proved that.
            trace: The whole trace. The argument may cite its displacements.
            pair: The two steps.
            one: Whether they are one dstate in all maps; False if in none.
            stop: Called now and then. If it returns True, Interrupted is raised.
        """
        self._piece, self._trace, self._one = piece, trace, one
        first, second = pair
        self._pair = piece.steps.index(first), piece.steps.index(second)
        self._axioms = Axioms(piece, stop, relaxed=True)
        self._goal = conclusion_of("one_dstate" if one else "two_dstates", *self._pair)
        self._supposed: Assumption = (facts.are_one(*self._pair), not one)
        order = piece.theory.axioms
        clash = self._axioms.smallest_clash([self._supposed])
        self._links = sorted(clash, key=lambda link: (order.index(link[0]), link[1]))
        self._axioms.tell_of(self._named_steps())
        self._lines: list[_Inferred] = []
        self._born: dict[clingo.Symbol, int] = {}  # the first line of each conclusion
        self._words = Words(piece, trace)

    def _named_steps(self) -> Iterable[int]:
        """List the steps that conclusions may mention, by their numbers in the piece."""
        size = len(self._piece.steps)
        if size <= FEW_STEPS or self._piece.theory.level == "causal":
            return range(size)
        first, second = self._pair
        named = {t for _, step in self._links for t in (step - 1, step, step - second + first)}
        return [t for t in named | {first, second} if 0 <= t < size]

    def derivation(self) -> Derivation:
        """Find the argument and put it into words."""
        self._draw_all()
        inferences, summary = self._written()
        first, second = (self._piece.steps[k] for k in self._pair)
        supposition = None
        if any(inference.supposed for inference in inferences):
            what = "different dstates" if self._one else "one dstate"
            supposition = f"steps {first} and {second} are {what}"
        drawn = [link for line in self._lines for link in line.group]
        links = tuple(
            Link(axiom, self._piece.steps[t]) for axiom, t in dict.fromkeys([*drawn, *self._links])
        )
        return Derivation(
            self._piece.steps, first, second, self._one, links, inferences, supposition, summary
        )

    # Which conclusions follow from the links, in which order

    def _draw_all(self) -> None:
        """Make the lines: add links one by one, such that each gives a new conclusion.

        First draw the conclusions that hold in every map. If they do not decide the pair, or if
        only several links at once decide it, suppose the opposite, and go on until there is a
        contradiction.
        """
        left = list(self._links)
        for supposed in (False, True):
            assumed = [self._supposed] if supposed else []
            placed = [link for link in self._links if link not in left]
            known = self._axioms.consequences(_active(placed), assumed, self._born)
            self._add((), known, supposed)
            while left:
                group = self._next(placed, left, assumed, known) or (
                    tuple(left) if supposed else None
                )
                if group is None:
                    break
                placed += group
                left = [link for link in left if link not in group]
                if supposed and not self._axioms.consistent(_active(placed), assumed):
                    self._lines.append(_Inferred(group, frozenset(), supposed))
                    return
                known = self._axioms.consequences(_active(placed), assumed, known)
                self._add(group, known, supposed)
                if self._goal in self._born:
                    if len(self._support(self._goal)[1]) == len(group):
                        return
                    # Several links at once decide the pair. The supposition gives smaller steps.
                    self._lines, self._born, left = [], {}, list(self._links)
                    break

    def _next(
        self,
        placed: Sequence[tuple[str, int]],
        left: Sequence[tuple[str, int]],
        assumed: Sequence[Assumption],
        known: frozenset[clingo.Symbol],
    ) -> tuple[tuple[str, int], ...] | None:
        """Find the first link of `left` that alone gives a new conclusion or a contradiction."""
        for link in left:
            active = _active([*placed, link])
            if assumed and not self._axioms.consistent(active, assumed):
                return (link,)
            if self._axioms.consequences(active, assumed, known) - known:
                return (link,)
        return None

    def _add(
        self, group: tuple[tuple[str, int], ...], known: frozenset[clingo.Symbol], supposed: bool
    ) -> None:
        """Add a line if some of the `known` conclusions are in no line yet."""
        new = known - self._born.keys()
        if new:
            self._born.update(dict.fromkeys(new, len(self._lines)))
            self._lines.append(_Inferred(group, new, supposed))

    # Which conclusions the argument needs

    def _written(self) -> tuple[tuple[Inference, ...], str]:
        """Put the lines that are needed into words, each after its premises."""
        goal = self._goal if self._lines[-1].conclusions else None
        order: list[clingo.Symbol | None] = []
        premises: dict[clingo.Symbol | None, list[clingo.Symbol]] = {}
        links: dict[clingo.Symbol | None, tuple[tuple[str, int], ...]] = {}

        def visit(conclusion: clingo.Symbol | None) -> None:
            if conclusion in premises:
                return
            premises[conclusion], links[conclusion] = self._support(conclusion)
            for premise in sorted(premises[conclusion], key=lambda p: read_conclusion(p)[1]):
                visit(premise)
            order.append(conclusion)

        visit(goal)
        # what holds in every map comes first
        order.sort(key=lambda conclusion: self._line_of(conclusion).supposed)
        # conclusions from the same links and premises share a line
        numbers: dict[clingo.Symbol | None, int] = {}
        lines: list[
            tuple[list[clingo.Symbol | None], tuple[int, ...], tuple[tuple[str, int], ...]]
        ] = []
        for conclusion in order:
            before = tuple(sorted({numbers[p] for p in premises[conclusion] if p in numbers}))
            if (
                lines
                and lines[-1][1:] == (before, links[conclusion])
                and self._line_of(lines[-1][0][0]) is self._line_of(conclusion)
            ):
                lines[-1][0].append(conclusion)
            else:
                lines.append(([conclusion], before, links[conclusion]))
            numbers[conclusion] = len(lines) - 1
        inferences = tuple(self._inference(*line) for line in lines)
        return inferences, self._summary(goal, premises, links)

    def _line_of(self, conclusion: clingo.Symbol | None) -> _Inferred:
        """Return the line that draws a conclusion; None is the contradiction at the end."""
        return self._lines[-1 if conclusion is None else self._born[conclusion]]

    def _support(
        self, conclusion: clingo.Symbol | None
    ) -> tuple[list[clingo.Symbol], tuple[tuple[str, int], ...]]:
        """Find the premises of a conclusion: a minimal set of earlier conclusions, and the links.

        The links come from the line of the conclusion, and from earlier lines if the conclusions of
        these lines do not suffice. The conclusion None is the contradiction.
        """
        line = self._line_of(conclusion)
        number = len(self._lines) - 1 if conclusion is None else self._born[conclusion]
        known = [
            (symbol, True)
            for symbol, born in self._born.items()
            if born < number and (line.supposed or not self._lines[born].supposed)
        ]
        known.sort(key=lambda assumption: self._rank(assumption[0]))
        earlier = [link for before in self._lines[:number] for link in before.group]
        given = [
            *([(conclusion, False)] if conclusion is not None else []),
            *([self._supposed] if line.supposed else []),
            *known,
        ]
        core = self._axioms.core(_active(line.group), given)
        # the conclusions of earlier links may not suffice; then the links themselves do
        if core is None:
            given += ((symbol, True) for symbol in _active(earlier))
            core = self._axioms.core(_active(line.group), given)
        needed = [symbol for symbol, _ in core or ()]
        again = tuple(link for link in earlier if active_at(*link) in needed)
        premises = [symbol for symbol in needed if symbol in self._born and symbol != conclusion]
        return premises, again + line.group

    def _rank(self, symbol: clingo.Symbol) -> tuple[bool, bool, int, int, tuple[int, ...]]:
        """Compute a sort key of premises. Premises with lower keys are preferred.

        A premise should be about a step of the pair. Under the supposition, it should be about the
        second step or about both, not about the first step alone.
        """
        name, steps = read_conclusion(symbol)
        supposed = self._lines[self._born[symbol]].supposed
        preferred = _PREFERRED.index(name) if name in _PREFERRED else len(_PREFERRED)
        return (
            supposed and self._pair[0] in steps and steps != self._pair,
            set(steps).isdisjoint(self._pair),
            preferred,
            self._born[symbol],
            steps,
        )

    # Words

    def _inference(
        self,
        conclusions: Sequence[clingo.Symbol | None],
        premises: tuple[int, ...],
        needed: Sequence[tuple[str, int]],
    ) -> Inference:
        """Put a line into words. `premises` are the indices of the lines that it follows from."""
        line = self._line_of(conclusions[0])
        known = [symbol for symbol, born in self._born.items() if born <= self._lines.index(line)]
        self._words.know(known)
        said = [read_conclusion(c) for c in conclusions if c is not None]
        says = tuple(dict.fromkeys(self._words.of(c, would=line.supposed) for c in said)) or (
            "this is a contradiction",
        )
        because = tuple(
            dict.fromkeys(self._words.reason(axiom, t, said, self._pair) for axiom, t in needed)
        )
        links = clashes_of((axiom, self._piece.steps[t]) for axiom, t in needed)
        because = because or ("by the supposition" if line.supposed else "by the trace alone",)
        return Inference(says, because, links, premises, line.supposed)

    def _summary(
        self,
        goal: clingo.Symbol | None,
        premises: dict[clingo.Symbol | None, list[clingo.Symbol]],
        links: dict[clingo.Symbol | None, tuple[tuple[str, int], ...]],
    ) -> str:
        """Summarise the argument by the last line with several premises."""
        conclusion = goal
        while len(premises[conclusion]) == 1:
            conclusion = premises[conclusion][0]
        self._words.know(self._born)
        if not premises[conclusion]:
            conclusion = goal
        found = [(self._line_of(p).supposed, read_conclusion(p)) for p in premises[conclusion]]
        found.sort(key=lambda premise: (premise[0], premise[1][1]))
        # these conclusions about the pair only repeat the supposition
        obvious = [(name, self._pair) for name in ("one_place", "one_dstate", "two_dstates")]
        clauses = [self._words.of(p, would=supposed) for supposed, p in found if p not in obvious]
        said = [] if conclusion is None else [read_conclusion(conclusion)]
        reasons = [
            self._words.reason(axiom, t, said, self._pair, short=True)
            for axiom, t in links[conclusion]
        ]
        return that_path("; ".join(dict.fromkeys([*clauses, *reasons])))


def _active(links: Iterable[tuple[str, int]]) -> list[clingo.Symbol]:
    """Return the atoms that switch on these links."""
    return [active_at(axiom, t) for axiom, t in links]


class Words:
    """Writes English clauses for conclusions and axioms, about a piece of a whole trace."""

    def __init__(self, piece: Piece, trace: Trace) -> None:
        self._piece, self._trace = piece, trace
        own = {axiom.name: axiom.sentence for rules in piece.theory.rules for axiom in rules.axioms}
        self._sentences = {axiom.name: axiom.sentence for axiom in encodings.axioms()} | own
        self._courses: set[tuple[int, int]] = set()

    def know(self, conclusions: Iterable[clingo.Symbol]) -> None:
        """Read which pairs of steps are along one course (path and direction), to name paths."""
        self._courses = {
            (steps[0], steps[1])
            for name, steps in map(read_conclusion, conclusions)
            if name == "one_course"
        }

    def of(self, conclusion: tuple[str, tuple[int, ...]], *, would: bool) -> str:
        """Put a conclusion into a clause.

        A conclusion is a name and steps, numbered as in the piece. With `would`, the clause says
        "would be" instead of "is", for a conclusion that is only supposed.
        """
        name, steps = conclusion
        if name in _SYMMETRIC:
            steps = tuple(sorted(steps))
        turn = ""
        if name == "turned":
            steps, turn = steps[:2], _TURNED[steps[2]]
        shown = [str(self._piece.steps[t]) for t in steps]
        paths = {f"path{k}": self._path(t) for k, t in enumerate(steps)}
        verbs = {"is": "be", "are": "be", "leaves": "leave", "faces": "face"}
        said = {verb: f"would {bare}" if would else verb for verb, bare in verbs.items()}
        return _WORDS[name].format(*shown, turn=turn, **paths, **said)

    def _path(self, t: int) -> str:
        """Name the path of step t of the piece, by a known travel along it if there is one."""
        pairs = sorted(
            (j - i, abs(i - t), i, j) for i, j in self._courses if t in (i, j) and j == i + 1
        )
        if not pairs:
            return f"the path of step {self._piece.steps[t]}"
        _, _, i, j = pairs[0]
        return f"the path that steps {self._piece.steps[i]} and {self._piece.steps[j]} define"

    def reason(
        self,
        axiom: str,
        t: int,
        said: Sequence[tuple[str, tuple[int, ...]]],
        pair: tuple[int, int],
        *,
        short: bool = False,
    ) -> str:
        """Write a clause that says why an axiom at a step implies some conclusions.

        Steps have their numbers in the piece. The argument is about the steps of `pair`. If
        `short`, write only the sentence of the axiom, without what was seen or done.
        """
        steps, sentence = self._piece.steps, self._sentences.get(axiom, axiom).rstrip(".")
        sentence = sentence[:1].lower() + sentence[1:]
        if axiom == "functional_view" and None not in self._piece.trace.views:
            sentence = sentence.partition(".")[0]  # the rest is about unknown views
        if axiom == "asserted":
            sentence = "; ".join(self._asserted(t, tuple(sorted(pair)))) or sentence
        if short:
            return sentence
        if axiom in OF_ACTIONS and t and (action := self._piece.trace.steps[t - 1].action):
            return f"{sentence}, and the action of step {steps[t - 1]} is {action.name!r}"
        # the pair that the conclusions are about, or the pair of the argument
        pairs = [
            s
            for name, s in said
            if name in ("one_dstate", "two_dstates", "two_places", "one_place")
        ] or [tuple(sorted(pair))]
        i, j = next((s for s in pairs if t in s), pairs[0])[:2]
        if axiom == "functional_view":
            seen = self._piece.trace.views
            named = (i, j) if t in (i, j) and seen[i] != seen[j] else (t,)
            sights = ", ".join(f"step {steps[k]} sees {seen[k]!r}" for k in named)
            return f"{sentence}, and {sights}"
        if axiom == "closure":
            ends = steps[i], steps[j]
            found = [c for c in self._trace.closures if (c.first, c.last) == ends]
            return "; ".join([sentence, *(match_in_words(match, *ends) for match in found)])
        if axiom == "one_pose":
            theory = self._piece.theory.replace(**dict.fromkeys(ASSERTIONS, ()))
            if apart := why_apart(self._trace, steps[i], steps[j], theory):
                return f"{sentence}; {apart}"
        return sentence

    def _asserted(self, t: int, pair: tuple[int, ...]) -> list[str]:
        """List what the user says of a pair of steps or, if nothing, of step t and earlier ones."""
        said = [
            (tuple(sorted(steps)), words)
            for kind, words in ASSERTED.items()
            for steps in getattr(self._piece.theory, kind)
            if t == max(steps)
        ]
        said = [one for one in said if one[0] == pair] or said
        names = self._piece.steps
        return [
            f"the user says that steps {names[i]} and {names[j]} {words}" for (i, j), words in said
        ]


def that_path(sentence: str) -> str:
    """Replace later mentions of a path by `that path`, until another path is mentioned."""
    seen = set[str]()

    def name(match: re.Match[str]) -> str:
        again = match[0] in seen
        seen.add(match[0])
        return "that path" if again and len(seen) == 1 else match[0]

    return re.sub(r"the path that steps .+? and .+? define", name, sentence)
