"""Explain why a trace has no map.

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

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from ssh_abduction.data.checks import a_whole_number
from ssh_abduction.data.errors import TheoryError, TraceError
from ssh_abduction.data.groups import gathered
from ssh_abduction.data.trace import Trace
from ssh_abduction.data.words import PlainData, noun_of
from ssh_abduction.explain.axioms import Axioms
from ssh_abduction.explain.piece import Piece
from ssh_abduction.solver import check_rules
from ssh_abduction.theory.settle import displacement_of, settle
from ssh_abduction.theory.theory import Theory

# Stretches of this many steps are tried first. They overlap by a step, so that each action is in
# one. A stretch takes about 30 ms. Shorter ones take 13 ms, and 16 steps take 120 ms.
STRETCH = 8


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
