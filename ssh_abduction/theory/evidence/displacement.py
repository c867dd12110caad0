"""Displacements as evidence: a dstate has one pose, and a place one position.

A *return* is a pair of visits that a map takes for one place, or a pair of steps that it takes for
one dstate. The displacements between the two steps make a loop. The loop fails to close by some
distance, and the covariance says how likely that is (`loops.py`). The axiom `one_pose` demands that
no set of at most `joint` returns is rejected.

*One return* does not depend on others. So the search knows the rejected returns beforehand:
pairs of steps at different places, or of different dstates. They prune the domains of all engines.

*Two returns* are tested together if both are between first steps of visits, and their loops share
displacements. Each answer is checked for rejected sets.

*How often a true map is rejected.* A true map has many returns, and each is tested. So half of
`reject` is shared among all returns that may be true, and the other half among all sets of two.
Then a true map is rejected with probability `reject` at most. Half of the true returns have a
p-value above one half (Storey 2002, "A direct approach to false discovery rates"), so about twice
that number of returns may be true. The number is rounded up to a power of two, so that it seldom
changes while a robot drives.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field, replace
from operator import is_
from typing import TYPE_CHECKING, ClassVar

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.theory.evidence.protocol import Equality
from ssh_abduction.theory.evidence.returns import Returns
from ssh_abduction.theory.pairs import Pairs

if TYPE_CHECKING:
    from ssh_abduction.theory.theory import Theory


KEPT = 8  # traces whose returns are remembered


@dataclass(frozen=True)
class Displacement:
    """The fields `reject` and `joint` of a theory."""

    name: ClassVar[str] = "displacement"
    axiom: ClassVar[str] = "one_pose"
    reject: float
    joint: int
    returns: int
    has_places: bool
    turns_stay: bool
    has_one_view: bool
    known: list[Returns] = field(default_factory=list, compare=False, repr=False)

    @classmethod
    def of(cls, theory: Theory) -> Displacement:
        topological, hard = theory.level == "topological", theory.hard
        # If displacements may be wrong, a pair is excused by a wrong displacement between its own
        # steps. So it says nothing about other steps of the same visits.
        turns_stay = "turn_stays" in hard and not theory.jumped
        return cls(
            theory.reject,
            theory.joint,
            theory.returns,
            topological,
            turns_stay,
            "functional_view" in hard and not theory.unknown_views,
        )

    def pairs(self, trace: Trace) -> Pairs:
        return self.returns_of(trace).pairs

    def facts(self, trace: Trace, start: int, stop: int) -> str:
        return ""

    def refuse(self, trace: Trace, ssh_map: SSHMap, since: int = 0) -> frozenset[Equality] | None:
        if self.joint <= 1:
            return None
        return self.returns_of(trace.without_displacements_at(jumped(ssh_map))).refused_together(
            ssh_map, since
        )

    def remembering(self, known: Displacement) -> Displacement:
        return replace(self, known=known.known)

    def count_returns(self, trace: Trace) -> int:
        """The number of returns that may be true, rounded up to a power of two.

        The length of the trace does not limit it.
        """
        return replace(self, returns=0).returns_of(trace).count()

    def returns_of(self, trace: Trace) -> Returns:
        """The returns of a trace, made when they are first needed.

        The last few traces are remembered, because several parts of a search need them. If a trace
        has grown, the returns of its first steps are kept.
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
    """The steps whose displacements a map ignores."""
    return tuple(fault.step for fault in ssh_map.faults if fault.kind == "jumped")


def _has_grown(before: Trace, trace: Trace) -> bool:
    """Whether a trace is an earlier one, perhaps with more steps."""
    last = len(before) - 1
    if last >= len(trace) or before.odometry != trace.odometry:
        return False
    old, new = before.steps[last], trace.steps[last]
    if (old.view, old.displacement, old.covariance) != (new.view, new.displacement, new.covariance):
        return False
    return all(map(is_, before.steps[:last], trace.steps[:last]))
