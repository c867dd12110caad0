"""Displacements as evidence: a dstate has one pose, and a place one position.

A *return* is two steps that a map puts at one place or dstate. For a place, they are the first
steps of two visits. The displacements between the two steps make a loop. By these displacements,
the end of the loop is some distance from its beginning, and the covariance says how likely that is
(`loops.py`).
The axiom `one_pose` demands that no set of at most `joint` returns is rejected.

*One return* can be tested before the search. If it is rejected, its steps are at different places,
or are different dstates. Such pairs of steps prune the domains of all engines.

*Two returns* are tested together if both are between first steps of visits, and their loops share
displacements. This is tested on each map that clingo finds.

*How often a true map is rejected.* A true map has many returns, and each is tested. So half of
`reject` is divided among all returns that may be true, and the other half among all sets of two.
Then a true map is rejected with probability `reject` at most. Half of the true returns have a
p-value above one half (Storey 2002, "A direct approach to false discovery rates"). So the returns
with such a p-value are counted, and about twice their number may be true. This number is rounded up
to a power of two, so that it seldom changes while a robot drives.
"""

from __future__ import annotations

from collections.abc import Collection
from contextlib import suppress
from dataclasses import dataclass, field, replace
from operator import is_
from typing import TYPE_CHECKING, ClassVar

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.theory.evidence.protocol import KEPT, Equality, Evidence
from ssh_abduction.theory.evidence.returns import Returns
from ssh_abduction.theory.pairs import Pairs

if TYPE_CHECKING:
    from ssh_abduction.theory.theory import Theory


@dataclass(frozen=True)
class Displacement(Evidence):
    """Evidence from displacements, with the fields `reject`, `joint` and `returns` of a theory.

    Attributes:
        reject: The largest probability of rejecting the true map.
        joint: The most returns that are tested together: 1 or 2.
        returns: How many returns may be true.
        has_places: Whether maps have places.
        turns_stay: Whether turns stay at their place. Then two visits are at one place only if
            their first steps are.
        has_one_view: Whether a dstate has only one view.
        may_be_wrong: Whether a map may treat displacements as wrong.
        known: The tested returns of the last few traces, for reuse.
    """

    name: ClassVar[str] = "displacement"
    axiom: ClassVar[str] = "one_pose"
    reject: float
    joint: int
    returns: int
    has_places: bool
    turns_stay: bool
    has_one_view: bool
    may_be_wrong: bool
    known: list[Returns] = field(default_factory=list, compare=False, repr=False)

    @classmethod
    def of(cls, theory: Theory) -> Displacement:
        topological, hard = theory.level == "topological", theory.hard
        # If displacements may be wrong, a wrong displacement between two steps excuses the pair. So
        # the pair says nothing about other steps of the same visits.
        turns_stay = "turn_stays" in hard and not theory.jumped
        return cls(
            theory.reject,
            theory.joint,
            theory.returns,
            topological,
            turns_stay,
            "functional_view" in hard and not theory.unknown_views,
            theory.jumped > 0,
        )

    def pairs(self, trace: Trace) -> Pairs:
        return self.returns_of(trace).pairs

    def refuse(self, trace: Trace, ssh_map: SSHMap, since: int = 0) -> frozenset[Equality] | None:
        if self.joint <= 1:
            return None
        wrong = jumped(ssh_map)
        refused = self.returns_of(trace.without_displacements_at(wrong)).refused_together(
            ssh_map, since
        )
        return frozenset(refused | self.believed(trace, refused, wrong)) if refused else None

    def believed(
        self, trace: Trace, returns: Collection[Equality], wrong: Collection[int]
    ) -> frozenset[Equality]:
        """Find the displacements in the loops of `returns` that a map does not treat as wrong.

        If the trace has closures, all its displacements count as in loops. The result is empty if
        the theory allows no wrong displacement.

        Args:
            trace: The trace that was mapped.
            returns: Returns that contradict the displacements.
            wrong: The steps whose displacements the map treats as wrong.
        """
        if not self.may_be_wrong:
            return frozenset()
        loops = [range(found.first + 1, found.second + 1) for found in returns]
        inside = {*range(1, len(trace))} if trace.closures else set[int]().union(*loops)
        return frozenset(Equality(t - 1, t, "displacement") for t in inside - set(wrong))

    def remembering(self, known: Displacement) -> Displacement:
        return replace(self, known=known.known)

    def count_returns(self, trace: Trace) -> int:
        """Return the number of returns that may be true, rounded up to a power of two."""
        return replace(self, returns=0).returns_of(trace).count()

    def returns_of(self, trace: Trace) -> Returns:
        """Test the returns of a trace, or return the earlier result for this trace.

        The last few traces are remembered, because several parts of a search need them. If a trace
        has grown, the results about its first steps are reused.
        """
        kept = list(self.known)
        for known in kept:
            if known.trace is trace and known.evidence == self:
                return known
        before = next(
            (k for k in reversed(kept) if k.evidence == self and _has_grown(k.trace, trace)), None
        )
        reckoning = next((known.reckoning for known in kept if known.trace is trace), None)
        found = Returns(self, trace, before, reckoning)
        with suppress(ValueError):  # another thread may have removed it
            if before is not None:
                self.known.remove(before)
            elif len(kept) >= KEPT:
                self.known.remove(kept[0])
        self.known.append(found)
        return found


def jumped(ssh_map: SSHMap) -> tuple[int, ...]:
    """Return the steps whose displacements a map treats as wrong."""
    return tuple(fault.step for fault in ssh_map.faults if fault.kind == "jumped")


def _has_grown(before: Trace, trace: Trace) -> bool:
    """Whether a trace is the same as an earlier one, perhaps with more steps."""
    last = len(before) - 1
    if last >= len(trace) or before.odometry != trace.odometry:
        return False
    old, new = before.steps[last], trace.steps[last]
    if (old.view, old.displacement, old.covariance) != (new.view, new.displacement, new.covariance):
        return False
    return all(map(is_, before.steps[:last], trace.steps[:last]))
