"""Adapt a theory to one trace: replace each "auto" by the value that fits the trace.

>>> from ssh_abduction import Theory, Trace
>>> from ssh_abduction.theory.settle import settle
>>> problem = settle(Trace.from_steps("aba", ["travel", "around"]), Theory())
>>> problem.theory.star, problem.theory.prefer
('none', ('dstates', 'paths', 'places'))
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from ssh_abduction.data.errors import TheoryError, TraceError
from ssh_abduction.data.trace import Trace, checked_trace
from ssh_abduction.theory import encodings
from ssh_abduction.theory.evidence import Displacement, Evidence, evidence_of, pairs_of
from ssh_abduction.theory.fields import AUTO, can_weigh, choice
from ssh_abduction.theory.pairs import Pairs
from ssh_abduction.theory.theory import Theory, checked_theory

if TYPE_CHECKING:
    from ssh_abduction.theory.prior import Prior

Star: TypeAlias = Literal["auto", "none", "alike", "pattern", "frame", "gateways"]


@dataclass(frozen=True)
class Problem:
    """A trace, and a theory in which no field is "auto": the input of all code for a trace.

    Attributes:
        trace: The trace.
        theory: The theory, with `star`, `displacement`, `prefer` and `returns` chosen.
        evidence: An object for each kind of evidence that this theory uses. It remembers the
            results for the trace, such as pairs of steps that cannot be one dstate.
    """

    trace: Trace
    theory: Theory
    evidence: tuple[Evidence, ...] = field(compare=False, repr=False)

    @classmethod
    def of(cls, trace: Trace, theory: Theory) -> Problem:
        """Make a problem from a trace and a theory in which no field is "auto"."""
        return cls(trace, theory, evidence_of(theory))

    @cached_property
    def pairs(self) -> Pairs:
        """Which steps are one dstate, different dstates, or at different places, by the evidence.

        Evidence that may be wrong, because the theory allows faults of this kind, is left out.
        """
        return pairs_of(self.trace, self.theory, self.evidence)

    @cached_property
    def prior(self) -> Prior:
        """The prior probabilities of the cost of maps."""
        from ssh_abduction.theory.prior import Prior  # loads numpy

        return Prior(self.trace, self.theory)

    def changed(self, trace: Trace | None = None, theory: Theory | None = None) -> Problem:
        """Return this problem with another trace or theory; None keeps the old one.

        In the theory no field is "auto". The results of the evidence, such as excluded pairs of
        steps, are reused.
        """
        theory = theory or self.theory
        return Problem(trace or self.trace, theory, evidence_of(theory, self.evidence))


def settle(trace: Trace, theory: Theory | None = None, known: Problem | None = None) -> Problem:
    """Replace each "auto" in a theory, and check that the trace has what the axioms need.

    Return the trace, the theory, and the evidence. A step whose view is unknown may be at any
    dstate. If a problem with the same trace, or with its first steps, is `known`, the results of
    its evidence are reused. Raises TraceError if all views, the kind of an action, or a star is
    missing, and TheoryError if the trace lacks the stars or displacements that the theory needs.
    """
    checked_trace(trace)
    theory = checked_theory(theory)
    star = _star_of(trace, theory)
    displacement = theory.displacement
    if displacement == "auto":
        displacement = "use" if trace.has_displacements else "none"
    # If the number of returns is given, a part of a trace may do without displacements.
    if displacement == "use" and not trace.has_displacements and not theory.returns:
        mend = f"add them to the steps, or take {choice('displacement', 'none')}"
        raise TheoryError(
            "displacement: expected a trace with displacements for displacement=use, got none; "
            f"{mend}"
        )
    views = set(trace.views)
    if views == {None} and not theory.unknown_views:  # a part of a trace may have no view
        raise _no_view(trace)
    settled = _settled(
        theory,
        encodings.axioms(),
        star=star,
        displacement=displacement,
        weigh=_weigh_of(theory, displacement),
        unknown_views=None in views,
        several_drives=any(action.starts for action in trace.actions),
        lifts=any(action.changes_floor for action in trace.actions),
    )
    for i, step in enumerate(trace.steps):
        if lack := settled.lack_of(step):
            raise TraceError(f"{trace.at(i)}: {lack}")
    problem = Problem(trace, settled, evidence_of(settled, known.evidence if known else ()))
    if displacement == "use" and not settled.returns:
        problem = problem.changed(theory=replace(settled, returns=count_returns(problem)))
    return problem


@lru_cache(maxsize=32)
def _settled(theory: Theory, axioms: tuple[encodings.Axiom, ...], **chosen: Any) -> Theory:
    """Replace fields of a theory by the chosen values, and each other "auto".

    The result is kept, as a robot that maps step by step settles one theory after each step. It is
    forgotten if the `axioms` of the encodings change.
    """
    settled = replace(theory, **chosen)
    _check_faults(settled)
    if settled.changed and settled.star == "gateways" and "gateway_end" not in settled.without:
        # A path may lead on by a gateway that is closed on a drive.
        settled = replace(settled, without=(*settled.without, "gateway_end"))
    counts = ["dstates" if count == "tenths" else count for count in settled.priorities]
    prefer = tuple(c for c in counts if c in theory.prefer or c != "excuses")
    return replace(settled, prefer=prefer)


def _check_faults(settled: Theory) -> None:
    """Check that the trace has what faults need. Raises TheoryError."""
    if settled.lifts and settled.slipped:
        raise TheoryError(
            "slipped: expected no actions that slip where a trace has lifts, as they could lead to "
            f"other floors, got {settled.slipped:g}; leave it out (--set slipped=0)"
        )
    if settled.changed and settled.star not in ("frame", "gateways"):
        raise TheoryError(
            "changed: expected a trace with stars, read by star=frame or gateways, got "
            f"star={settled.star}; leave it out (--set changed=0)"
        )


def count_returns(problem: Problem) -> int:
    """Return the number of returns that may be true, rounded up to a power of two.

    A return is two steps at one place or dstate. The number is 0 if the theory does not use
    displacements.
    """
    displacement = displacement_of(problem)
    return displacement.count_returns(problem.trace) if displacement else 0


def displacement_of(problem: Problem) -> Displacement | None:
    """Return the evidence of displacements; None if the theory does not use it."""
    return next((e for e in problem.evidence if isinstance(e, Displacement)), None)


def _no_view(trace: Trace) -> TraceError:
    got, mend = "none in any step", "give the views that are known, or one view to all steps"
    if any(step.image is not None for step in trace.steps):
        got, mend = ("only an image", "cluster the images into views first (ssh-abduction cluster)")
    return TraceError(f"{trace.at(0)}: view: expected one, got {got}; {mend}")


def _weigh_of(theory: Theory, displacement: str) -> Literal["cost", "count"]:
    """Choose how to compare maps: by their cost in nats, or by their counts.

    Without displacements there is no misfit, so maps are compared by counts. They are also compared
    by counts if `weigh` is "auto" and the user chose in `prefer` what to minimise.
    """
    chosen = theory.weigh == "cost" or (
        theory.weigh == "auto" and theory.prefer == AUTO and can_weigh(theory)
    )
    return "cost" if chosen and displacement == "use" else "count"


def _star_of(trace: Trace, theory: Theory) -> Star:
    """Return how to read the stars of a trace, or raise TheoryError."""
    star = theory.star
    if star == "auto":
        star = "frame" if trace.has_stars else "none"
    if star != "none" and not trace.has_stars:
        mend = f"add them to the steps, or take {choice('star', 'none')}"
        raise TheoryError(f"star: expected a trace with stars for star={star}, got none; {mend}")
    return "gateways" if star == "frame" and not trace.in_quarters else star
