"""A certificate that proves a lower bound on the number of dstates.

`checker/claims.py` checks certificates without a solver.

>>> from ssh_abduction import Trace, solve
>>> trace = Trace.from_steps(["a", "b", "a", "c"], ["travel", "travel", "travel"])
>>> solve(trace).certificate.clique
(0, 1, 2, 3)
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

from ssh_abduction.data.words import counted
from ssh_abduction.theory.speedups import CAUSAL

# Steps that are apart (the same actions lead from them to different views) are different dstates
# by these axioms.
RESTS_ON = CAUSAL


@dataclass(frozen=True, slots=True)
class Certificate:
    """A certificate that no map has fewer than `bound` dstates.

    Attributes:
        clique: Steps that are pairwise distinct, so each is a dstate of its own.
        refuted: The numbers of dstates for which clingo has proven that there is no map. They begin
            at the size of the clique and have no gap.
    """

    clique: tuple[int, ...]
    refuted: tuple[int, ...] = ()

    def __repr__(self) -> str:
        refuted = (
            f", and clingo refuted {counted(len(self.refuted), 'sizes')}" if self.refuted else ""
        )
        bound, steps = counted(self.bound, "dstates"), counted(len(self.clique), "steps")
        return f"<Certificate: at least {bound}; {steps} are pairwise apart{refuted}>"

    @property
    def bound(self) -> int:
        """The proven lower bound on the number of dstates of a map."""
        return len(self.clique) + len(self.refuted)

    def to_dict(self) -> dict[str, Any]:
        """Return the certificate as plain data."""
        return {"clique": list(self.clique), "refuted": list(self.refuted)}


class Basis(Protocol):
    """What a solver keeps to make a certificate when it is first used."""

    @property
    def certificate(self) -> Certificate: ...
