"""The argument why two steps are different dstates in every map, or one dstate in every map."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from ssh_abduction.checker.checker import Violation
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.explain.no_map import Clash

# More reasons than this get a line each.
IN_A_LINE, INDENT = 2, " " * 7
# A summary of more parts than this is not printed.
BRIEF = 3


@dataclass(frozen=True, slots=True)
class Link:
    """An axiom at one step that an argument needs.

    Attributes:
        axiom: The name of the axiom.
        step: The step. If the axiom is about several steps at once, the last one is named.
        without: A map of the piece in which the other links hold but the conclusion does not.
        violations: The axioms of the argument that this map breaks, by the checker.
    """

    axiom: str
    step: int
    without: SSHMap
    violations: tuple[Violation, ...]


@dataclass(frozen=True, slots=True)
class Inference:
    """One line of an argument.

    Attributes:
        says: The conclusions, in words.
        because: The axioms that they follow from, in words.
        links: These axioms, with their steps.
        premises: The other lines that they follow from, counted from 0.
        supposed: Whether the line holds only under the supposition that leads to a contradiction.
    """

    says: tuple[str, ...]
    because: tuple[str, ...]
    links: tuple[Clash, ...]
    premises: tuple[int, ...]
    supposed: bool

    def to_dict(self) -> dict[str, Any]:
        """Plain data, as `explain --json` prints it."""
        return {
            "says": list(self.says),
            "because": list(self.because),
            "links": [{"axiom": link.axiom, "steps": list(link.steps)} for link in self.links],
            "premises": list(self.premises),
            "supposed": self.supposed,
        }


@dataclass(frozen=True, slots=True)
class Derivation:
    """Why two steps are different dstates in every consistent map, or one dstate in every map.

    Attributes:
        steps: The steps of the trace that suffice for the argument.
        first: The earlier step of the pair.
        second: The later step.
        one: Whether the steps are one dstate.
        links: A minimal set of axioms and steps.
        inferences: The argument, line by line.
        supposition: What the lines that say so suppose; None if none does.
        summary: The last inference of the argument in one sentence.
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
        return clashes_of((link.axiom, link.step) for link in self.links)

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
            lines += _lines_of(inference, number)
        parts = self.summary.split("; ")
        # a summary of many parts only repeats the lines
        return "\n".join([*lines, f"in short: {self.summary}"] if len(parts) <= BRIEF else lines)

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


def clashes_of(links: Iterable[tuple[str, int]]) -> tuple[Clash, ...]:
    """Axioms in the order of their first links, each with its steps."""
    steps: dict[str, set[int]] = {}
    for axiom, step in links:
        steps.setdefault(axiom, set()).add(step)
    return tuple(Clash(axiom, tuple(sorted(of_axiom))) for axiom, of_axiom in steps.items())


def _lines_of(inference: Inference, number: int) -> Iterator[str]:
    """The lines that print an inference: its conclusions, premises, axioms and their steps."""
    lines = ", ".join(str(premise + 1) for premise in inference.premises)
    by = f" (from {'line' if len(inference.premises) == 1 else 'lines'} {lines})" if lines else ""
    names = "; ".join(f"{link.axiom}, {_steps(link.steps)}" for link in inference.links)
    says = f"{number:3}. {'; '.join(inference.says)}{by}:"
    named = [f"[{names}]"] if names else []
    if len(inference.because) > IN_A_LINE:
        yield says
        yield from (f"{INDENT}{line}" for line in (*inference.because, *named))
    else:
        yield " ".join([says, "; ".join(inference.because), *named])


def _steps(steps: Sequence[int]) -> str:
    return f"step{'' if len(steps) == 1 else 's'} {', '.join(map(str, steps))}"
