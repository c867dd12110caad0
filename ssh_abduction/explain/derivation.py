"""An argument why two steps are different dstates in every map, or one dstate in every map."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from ssh_abduction.checker.checker import Violation
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.words import PlainData, attributes_of, noun_of
from ssh_abduction.explain.no_map import ClashingAxiom, clashes_of, steps_listed

# If an inference has more reasons than IN_A_LINE, each gets a line of its own.
IN_A_LINE, INDENT = 2, " " * 7
# A summary with more parts than this is not printed.
BRIEF = 3


@dataclass(frozen=True, slots=True)
class Link:
    """An axiom at one step that an argument needs."""

    axiom: str  # the name of the axiom
    # The step. If the axiom is about several steps at once, this is the last of them.
    step: int
    # A map of the steps of the argument in which all other links hold, but not the conclusion.
    without: SSHMap
    # The violations of axioms of the argument that the checker finds in this map.
    violations: tuple[Violation, ...]


@dataclass(frozen=True, slots=True)
class Inference(PlainData):
    """One line of an argument."""

    says: tuple[str, ...]  # the conclusions, each as a clause
    because: tuple[str, ...]  # the axioms that the conclusions follow from, each as a clause
    links: tuple[ClashingAxiom, ...]  # the same axioms by name, each with its steps
    # The indices (from 0) of the earlier lines that the conclusions follow from.
    premises: tuple[int, ...]
    # Whether the line holds only under the supposition that leads to a contradiction.
    supposed: bool


@dataclass(frozen=True, slots=True)
class Derivation:
    """An argument why two steps are different dstates in every map, or one dstate in every map.

    Attributes:
        steps: The steps of the trace that suffice for the argument.
        first: The earlier step of the pair.
        second: The later step of the pair.
        one: True if the steps are one dstate in every map, False if they differ in every map.
        links: The axioms, each at one step, that the argument needs. None can be left out.
        inferences: The argument, line by line.
        supposition: The supposition of the lines with `supposed`, as a clause; None if there is no
            such line.
        summary: The last line with several premises, in one sentence.
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
    def clashes(self) -> tuple[ClashingAxiom, ...]:
        """The axioms of the links in the order of the argument, each with all its steps."""
        return clashes_of((link.axiom, link.step) for link in self.links)

    @property
    def axioms(self) -> tuple[str, ...]:
        """The names of the axioms in `clashes`, in the order of the argument."""
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
        """Return the argument as plain data, without the maps of the links."""
        return attributes_of(self, "steps", "clashes", "supposition", "inferences", "summary")


def _lines_of(inference: Inference, number: int) -> Iterator[str]:
    """Yield the lines that print an inference: conclusions, premises, axioms and their steps."""
    lines = ", ".join(str(premise + 1) for premise in inference.premises)
    by = f" (from {noun_of('line', inference.premises)} {lines})" if lines else ""
    names = "; ".join(f"{link.axiom}, {steps_listed(link.steps)}" for link in inference.links)
    says = f"{number:3}. {'; '.join(inference.says)}{by}:"
    named = [f"[{names}]"] if names else []
    if len(inference.because) > IN_A_LINE:
        yield says
        yield from (f"{INDENT}{line}" for line in (*inference.because, *named))
    else:
        yield " ".join([says, "; ".join(inference.because), *named])
