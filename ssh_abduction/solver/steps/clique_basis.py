"""The data of a search from which a certificate of its bound is made."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from ssh_abduction.solution.certificate import Certificate


@dataclass(frozen=True)
class CliqueBasis:
    """The data for a certificate, which is made when it is first used.

    Making a certificate takes as long as solving a short trace.

    Attributes:
        views: The view of each of the first steps of the trace, as a number.
        actions: The action after each of these steps but the last, as a number.
        bound: The proven lower bound on dstates; 0 if none is proven.
    """

    views: tuple[int, ...]
    actions: tuple[int, ...]
    bound: int

    @cached_property
    def certificate(self) -> Certificate:
        """The certificate."""
        # Imported here, as loading numpy takes longer than solving a short trace.
        from ssh_abduction.solver.steps.apart import Continuations

        clique = tuple(Continuations(self.views, self.actions).clique())
        return Certificate(clique, tuple(range(len(clique), self.bound)))
