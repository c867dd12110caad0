"""Put arguments into words: conclusions and axioms as English clauses."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

import clingo

from ssh_abduction.data.closure import match_in_words
from ssh_abduction.data.corrections import ASSERTED, ASSERTIONS
from ssh_abduction.data.trace import Trace
from ssh_abduction.explain.no_map import why_apart
from ssh_abduction.explain.piece import Piece
from ssh_abduction.solver import facts
from ssh_abduction.theory import encodings
from ssh_abduction.theory.fields import EXCUSED

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
            for name, steps in map(facts.read_conclusion, conclusions)
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
