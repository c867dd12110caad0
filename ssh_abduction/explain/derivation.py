"""Why two steps are different dstates in every map, or one: a smallest set of axioms and steps, as an argument whose every line follows from the lines before it.

>>> from ssh_abduction import Theory, Trace
>>> from ssh_abduction.explain.no_map import Piece
>>> trace = Trace.from_steps(views=["v0", "v1", "v2", "v3", "v0"], actions=["right", "travel", "right", "travel"])
>>> theory = Theory.topological().resolve(trace)
>>> print(derive(Piece.of(trace, theory, range(5)), trace, 0, 4, one=False).summary)
step 0 is at a place on the path that steps 1 and 2 define; step 4 would be at a place to the right of that path; no place on a path lies right or left of it

The set of axioms and steps is smallest in that none of it can be spared. What is concluded from it is found by asking clingo which conclusions hold in all maps
in which the axioms hold that were named so far: so each line is a consequence, and not only a sentence about an axiom. First all is concluded that holds in every
map; where that does not settle the pair, or only by several links at once, the opposite is supposed, and leads to a contradiction.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import clingo

from ssh_abduction.checker.checker import Violation, check, unchecked
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.explain.no_map import Assumption, Axioms, Clash, Piece, why_apart
from ssh_abduction.solver import facts
from ssh_abduction.theory import encodings
from ssh_abduction.theory.theory import EXCUSED

FEW_STEPS = 14  # An argument about so few steps may speak of all of them. In a longer piece it speaks of those that the axioms name, as conclusions are many.
IN_A_LINE, INDENT = 2, " " * 7  # More reasons than these have a line each, with this indent.
OF_ACTIONS = EXCUSED["slipped"] | {
    "branch_side"
}  # axioms that are broken at a step by the action that led to it
# What has one value for a dstate. A map shows only that value, so an axiom of these should hold in a map that the checker is to judge.
SHOWN = ("one_place", "one_course", "one_heading", "functional_view", "deterministic")

_WORDS = {
    "one_dstate": "steps {0} and {1} {are} one dstate",
    "two_dstates": "steps {0} and {1} {are} different dstates",
    "one_place": "steps {0} and {1} {are} at one place",
    "two_places": "steps {0} and {1} {are} at different places",
    "along": "step {0} {is} along a path",
    "along_none": "step {0} {is} along no path",
    "one_course": "steps {0} and {1} {are} along one path, in one direction",
    "opposite": "steps {0} and {1} {are} along one path, in opposite directions",
    "two_paths": "steps {0} and {1} {are} along different paths",
    "on": "step {0} {is} at a place on {path1}",
    "ahead": "the place of step {1} {is} ahead of that of step {0} on {path2}",
    "branch_right": "{path1} {leaves} to the right of {path0}",
    "branch_left": "{path1} {leaves} to the left of {path0}",
    "right": "step {0} {is} at a place to the right of {path1}",
    "left": "step {0} {is} at a place to the left of {path1}",
    "turned": "steps {0} and {1} {are} at one place, and step {1} {faces} {turn} step {0}",
}
# How a step faces that faces so many quarters clockwise from another one.
_TURNED = (
    "the same way as",
    "a quarter to the right of",
    "the opposite way of",
    "a quarter to the left of",
)
# Conclusions that say most are kept where one of several would do.
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


@dataclass(frozen=True, slots=True)
class Link:
    """An axiom at one step, as an argument needs it. Of the steps that the axiom is about at once, the last one is named.

    without     a map of the piece in which the other links hold and the conclusion does not: it breaks this link
    violations  what the checker finds wrong with that map, by the axioms of the argument
    """

    axiom: str
    step: int
    without: SSHMap
    violations: tuple[Violation, ...]


@dataclass(frozen=True, slots=True)
class Inference:
    """One line of an argument.

    says      what is concluded, in words
    because   the axioms that it follows from, each in words
    links     these axioms, with their steps
    premises  the lines that it also follows from, counted from 0
    supposed  whether it holds only under the supposition that is led to a contradiction
    """

    says: tuple[str, ...]
    because: tuple[str, ...]
    links: tuple[Clash, ...]
    premises: tuple[int, ...]
    supposed: bool

    def to_dict(self) -> dict[str, Any]:
        return {
            "says": list(self.says),
            "because": list(self.because),
            "links": [{"axiom": link.axiom, "steps": list(link.steps)} for link in self.links],
            "premises": list(self.premises),
            "supposed": self.supposed,
        }


@dataclass(frozen=True, slots=True)
class Derivation:
    """Why two steps are different dstates in every consistent map, or one.

    steps        the steps of the trace that show it, which need no others
    first, second, one  what is shown: that these two steps are one dstate, or are not
    links        a set of axioms and steps none of which can be spared
    inferences   the argument, line by line
    supposition  what is supposed where a line says so; None where no line does
    summary      the argument in one sentence
    """

    steps: tuple[int, ...]
    first: int
    second: int
    one: bool
    links: tuple[Link, ...]
    inferences: tuple[Inference, ...]
    supposition: str | None
    summary: str

    @property
    def clashes(self) -> tuple[Clash, ...]:
        """The axioms in the order of the argument, each with its steps."""
        return _clashes((link.axiom, link.step) for link in self.links)

    @property
    def axioms(self) -> tuple[str, ...]:
        """The names of the axioms, in the order of the argument."""
        return tuple(clash.axiom for clash in self.clashes)

    def __str__(self) -> str:
        lines, supposed = [], False
        for number, inference in enumerate(self.inferences, 1):
            if inference.supposed and not supposed:
                lines.append(f"suppose that {self.supposition}; then")
                supposed = True
            by = (
                f" (by {', '.join(str(p + 1) for p in inference.premises)})"
                if inference.premises
                else ""
            )
            names = "; ".join(f"{link.axiom}, {_steps(link.steps)}" for link in inference.links)
            says, because = f"{number:3}. {'; '.join(inference.says)}{by}:", [*inference.because]
            named = [f"[{names}]"] if names else []
            if len(because) > IN_A_LINE:
                lines += [says, *(f"{INDENT}{line}" for line in (*because, *named))]
            else:
                lines.append(" ".join([says, "; ".join(because), *named]))
        short = self.summary.split("; ")
        if len(short) > IN_A_LINE + 1:
            return "\n".join([*lines, "in short:", *(f"{INDENT}{part}" for part in short)])
        return "\n".join([*lines, f"in short: {self.summary}"])

    def to_dict(self) -> dict[str, Any]:
        """Plain data, without the maps of the links."""
        return {
            "steps": list(self.steps),
            "clashes": [
                {"axiom": clash.axiom, "steps": list(clash.steps)} for clash in self.clashes
            ],
            "supposition": self.supposition,
            "inferences": [inference.to_dict() for inference in self.inferences],
            "summary": self.summary,
        }


def derive(
    piece: Piece,
    trace: Trace,
    first: int,
    second: int,
    *,
    one: bool,
    stop: Callable[[], bool] = lambda: False,
) -> Derivation:
    """The argument that two steps are one dstate in all maps of a piece of a trace (`one`), or in none. That has to be so.

    trace  the whole trace, which displacements speak of
    stop   asked now and then; when it returns True, Interrupted is raised
    """
    return _Argument(piece, trace, first, second, one, stop).derivation()


@dataclass(frozen=True)
class _Line:
    """What follows from some links and what was known before, or, where there are no conclusions, that this is a contradiction."""

    group: tuple[tuple[str, int], ...]
    conclusions: frozenset[clingo.Symbol]
    supposed: bool


class _Argument:
    """Finds an argument. Steps are those of the piece until they are put into words."""

    def __init__(
        self,
        piece: Piece,
        trace: Trace,
        first: int,
        second: int,
        one: bool,
        stop: Callable[[], bool],
    ) -> None:
        self._piece, self._trace, self._one = piece, trace, one
        self._pair = piece.steps.index(first), piece.steps.index(second)
        self._axioms = Axioms(piece, stop, relaxed=True)
        self._supposed: Assumption = (facts.are_one(*self._pair), not one)
        order = piece.theory.axioms
        clash = self._axioms.smallest_clash([self._supposed])
        self._links = sorted(clash, key=lambda link: (order.index(link[0]), link[1]))
        self._axioms.tell_of(self._named_steps())
        self._lines: list[_Line] = []
        self._born: dict[
            clingo.Symbol, int
        ] = {}  # the line at which each conclusion is drawn first
        self._words = _Words(piece, trace)

    def _named_steps(self) -> Iterable[int]:
        """The steps that the argument speaks of."""
        size = len(self._piece.steps)
        if size <= FEW_STEPS or self._piece.theory.level == "causal":
            return range(size)
        first, second = self._pair
        named = {t for _, step in self._links for t in (step - 1, step, step - second + first)} | {
            first,
            second,
        }
        return [t for t in named if 0 <= t < size]

    def derivation(self) -> Derivation:
        self._draw_all()
        inferences, summary = self._told()
        first, second = (self._piece.steps[k] for k in self._pair)
        supposed = any(inference.supposed for inference in inferences)
        supposition = (
            f"steps {first} and {second} {'are different dstates' if self._one else 'are one dstate'}"
            if supposed
            else None
        )
        return Derivation(
            self._piece.steps,
            first,
            second,
            self._one,
            tuple(self._checked_links()),
            inferences,
            supposition,
            summary,
        )

    # Which conclusions follow from the links, in which order

    def _draw_all(self) -> None:
        """Place the links one by one, so that each, with those before it, lets something be concluded."""
        goal = facts.conclusion("one_dstate" if self._one else "two_dstates", *self._pair)
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
                    self._lines.append(_Line(group, frozenset(), supposed))
                    return
                known = self._axioms.consequences(_active(placed), assumed, known)
                self._add(group, known, supposed)
                if goal in self._born:
                    if len(self._support(goal)[1]) == len(group):
                        return
                    # Several links at once lead there: what is supposed can be followed link by link instead.
                    self._lines, self._born, left = [], {}, list(self._links)
                    break

    def _next(
        self,
        placed: Sequence[tuple[str, int]],
        left: Sequence[tuple[str, int]],
        assumed: Sequence[Assumption],
        known: frozenset[clingo.Symbol],
    ) -> tuple[tuple[str, int], ...] | None:
        """The link to place next: the first that lets something new be concluded."""
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
        new = known - self._born.keys()
        if new:
            self._born.update(dict.fromkeys(new, len(self._lines)))
            self._lines.append(_Line(group, new, supposed))

    # What of it the argument needs

    def _told(self) -> tuple[tuple[Inference, ...], str]:
        """The lines that the argument needs, premises before what follows from them, and the argument in one sentence."""
        last = self._lines[-1]
        goal = (
            None
            if not last.conclusions
            else facts.conclusion("one_dstate" if self._one else "two_dstates", *self._pair)
        )
        order: list[clingo.Symbol | None] = []
        premises: dict[clingo.Symbol | None, list[clingo.Symbol]] = {}
        links: dict[clingo.Symbol | None, tuple[tuple[str, int], ...]] = {}

        def visit(conclusion: clingo.Symbol | None) -> None:
            if conclusion in premises:
                return
            premises[conclusion], links[conclusion] = self._support(conclusion)
            for premise in sorted(
                premises[conclusion], key=lambda premise: facts.read_conclusion(premise)[1]
            ):
                visit(premise)
            order.append(conclusion)

        visit(goal)
        order.sort(
            key=lambda conclusion: self._line_of(conclusion).supposed
        )  # what holds in every map comes first
        # Conclusions that follow from the same links and premises are one line.
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
        inferences = tuple(self._inference(*told) for told in lines)
        return inferences, self._summary(goal, premises, links)

    def _line_of(self, conclusion: clingo.Symbol | None) -> _Line:
        return self._lines[-1 if conclusion is None else self._born[conclusion]]

    def _support(
        self, conclusion: clingo.Symbol | None
    ) -> tuple[list[clingo.Symbol], tuple[tuple[str, int], ...]]:
        """What a conclusion follows from: what has to be known, none of which can be spared, and links; those of its line, and earlier ones that are needed once more."""
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
        if core is None:
            core = self._axioms.core(
                _active(line.group), [*given, *((facts.active(*link), True) for link in earlier)]
            )
        needed = {symbol for symbol, _ in core or ()}
        again = tuple(link for link in earlier if facts.active(*link) in needed)
        return [
            symbol for symbol, _ in core or () if symbol in self._born and symbol != conclusion
        ], again + line.group

    def _rank(self, symbol: clingo.Symbol) -> tuple[bool, bool, int, int, tuple[int, ...]]:
        """Premises of lower rank are kept. What holds in every map is said of the first step of the pair, what is supposed of the second one."""
        name, steps = facts.read_conclusion(symbol)
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
        line = self._line_of(conclusions[0])
        known = [symbol for symbol, born in self._born.items() if born <= self._lines.index(line)]
        self._words.know(known)
        said = [facts.read_conclusion(c) for c in conclusions if c is not None]
        says = tuple(dict.fromkeys(self._words.of(c, would=line.supposed) for c in said)) or (
            "that is a contradiction",
        )
        because = tuple(
            dict.fromkeys(self._words.reason(axiom, t, said, self._pair) for axiom, t in needed)
        )
        links = _clashes((axiom, self._piece.steps[t]) for axiom, t in needed)
        return Inference(
            says,
            because or ("by what is supposed" if line.supposed else "by the trace alone",),
            links,
            premises,
            line.supposed,
        )

    def _summary(
        self,
        goal: clingo.Symbol | None,
        premises: dict[clingo.Symbol | None, list[clingo.Symbol]],
        links: dict[clingo.Symbol | None, tuple[tuple[str, int], ...]],
    ) -> str:
        """The last step of the argument that rests on two things or more, and the axiom that it rests on."""
        conclusion = goal
        while len(premises[conclusion]) == 1:
            conclusion = premises[conclusion][0]
        self._words.know(self._born)
        if not premises[conclusion]:
            conclusion = goal
        obvious = (self._pair, ("one_place", "one_dstate", "two_dstates"))  # by what is supposed
        told = [
            self._words.of(facts.read_conclusion(p), would=self._lines[self._born[p]].supposed)
            for p in sorted(
                premises[conclusion],
                key=lambda p: (self._lines[self._born[p]].supposed, facts.read_conclusion(p)[1]),
            )
            if not (
                facts.read_conclusion(p)[1] == obvious[0]
                and facts.read_conclusion(p)[0] in obvious[1]
            )
        ]
        said = [] if conclusion is None else [facts.read_conclusion(conclusion)]
        reasons = [
            self._words.reason(axiom, t, said, self._pair, short=True)
            for axiom, t in links[conclusion]
        ]
        return _that_path("; ".join(dict.fromkeys([*told, *reasons])))

    # Is each link needed?

    def _checked_links(self) -> Iterable[Link]:
        """The links in the order of the argument, each with a map that breaks it alone, as far as that can be, and what the checker says of that map."""
        theory = self._piece.theory
        names = {axiom for axiom, _ in self._links} | set(unchecked(theory))
        left_out = [axiom for axiom in theory.axioms if axiom not in names]
        own = {axiom.name for rules in theory.rules for axiom in rules.axioms}
        of_argument = theory.replace(
            without=[
                *dict.fromkeys([*theory.without, *(name for name in left_out if name not in own)])
            ]
        )
        ordered = list(dict.fromkeys(link for line in self._lines for link in line.group))
        for axiom, t in [*ordered, *(link for link in self._links if link not in ordered)]:
            found = self._map_without((axiom, t))
            yield Link(
                axiom, self._piece.steps[t], found, check(self._piece.trace, found, of_argument)
            )

    def _map_without(self, link: tuple[str, int]) -> SSHMap:
        """A map in which the other links hold, and those axioms, where they can, that say what a dstate has one of."""
        supposed = [self._supposed]
        active = _active(other for other in self._links if other != link)
        for axiom in SHOWN:
            several = [
                symbol
                for symbol in self._axioms.instances
                if str(symbol.arguments[0]) == axiom and symbol != facts.active(*link)
            ]
            for some in ([several], [[symbol] for symbol in several]):
                for more in some:
                    if not set(more) <= set(active) and self._axioms.consistent(
                        [*active, *more], supposed
                    ):
                        active += more
        found = self._axioms.map_with(active, supposed)
        assert found is not None
        return found


class _Words:
    """Puts conclusions and axioms into words."""

    def __init__(self, piece: Piece, trace: Trace) -> None:
        self._piece, self._trace = piece, trace
        own = {axiom.name: axiom.sentence for rules in piece.theory.rules for axiom in rules.axioms}
        self._sentences = {axiom.name: axiom.sentence for axiom in encodings.axioms()} | own
        self._courses: set[tuple[int, int]] = set()

    def know(self, conclusions: Iterable[clingo.Symbol]) -> None:
        """What is known by now: paths are named by two steps that are along them."""
        self._courses = {
            (steps[0], steps[1])
            for name, steps in map(facts.read_conclusion, conclusions)
            if name == "one_course"
        }

    def of(self, conclusion: tuple[str, tuple[int, ...]], *, would: bool) -> str:
        """A conclusion as a clause; `would` where it is only supposed."""
        name, steps = conclusion
        if name in (
            "one_dstate",
            "one_place",
            "two_places",
            "two_dstates",
            "one_course",
            "opposite",
            "two_paths",
        ):
            steps = tuple(sorted(steps))
        turn = ""
        if name == "turned":
            steps, turn = steps[:2], _TURNED[steps[2]]
        shown = [str(self._piece.steps[t]) for t in steps]
        paths = {f"path{k}": self._path(t) for k, t in enumerate(steps)}
        verbs = (
            {"is": "would be", "are": "would be", "leaves": "would leave", "faces": "would face"}
            if would
            else {}
        )
        return _WORDS[name].format(
            *shown,
            turn=turn,
            **paths,
            **{verb: verbs.get(verb, verb) for verb in ("is", "are", "leaves", "faces")},
        )

    def _path(self, t: int) -> str:
        """The path of a step of the piece, named by a travel along it, if one is known."""
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
        """Why an axiom at a step of the piece says so."""
        steps, sentence = self._piece.steps, self._sentences.get(axiom, axiom).rstrip(".")
        sentence = sentence[:1].lower() + sentence[1:]
        if short:
            return sentence
        if axiom in OF_ACTIONS and t and (action := self._piece.trace.steps[t - 1].action):
            return f"{sentence}, and the action of step {steps[t - 1]} is {action.name!r}"
        pairs = [
            s
            for name, s in said
            if name in ("one_dstate", "two_dstates", "two_places", "one_place")
        ] or [tuple(sorted(pair))]
        i, j = next((s for s in pairs if t in s), pairs[0])[:2]
        if axiom == "functional_view":
            seen = self._piece.trace.views
            named = (i, j) if t in (i, j) and seen[i] != seen[j] else (t,)
            return (
                f"{sentence}, and {', '.join(f'step {steps[k]} sees {seen[k]!r}' for k in named)}"
            )
        if axiom == "one_pose" and (
            apart := why_apart(
                self._trace,
                steps[i],
                steps[j],
                self._piece.theory.replace(same=(), different=(), elsewhere=()),
            )
        ):
            return f"{sentence}; {apart}"
        return sentence


def _active(links: Iterable[tuple[str, int]]) -> list[clingo.Symbol]:
    return [facts.active(axiom, t) for axiom, t in links]


def _clashes(links: Iterable[tuple[str, int]]) -> tuple[Clash, ...]:
    """Axioms in the order in which they come first, each with its steps."""
    steps: dict[str, set[int]] = {}
    for axiom, step in links:
        steps.setdefault(axiom, set()).add(step)
    return tuple(Clash(axiom, tuple(sorted(of_axiom))) for axiom, of_axiom in steps.items())


def _steps(steps: Sequence[int]) -> str:
    return f"step{'' if len(steps) == 1 else 's'} {', '.join(map(str, steps))}"


def _that_path(sentence: str) -> str:
    """A sentence in which a path is named in full once, and is `that path` where it comes next."""
    seen = set[str]()

    def name(match: re.Match[str]) -> str:
        again = match[0] in seen
        seen.add(match[0])
        return "that path" if again and len(seen) == 1 else match[0]

    return re.sub(r"the path that steps \d+ and \d+ define", name, sentence)
