"""Closures as evidence.

A *closure* is the relative pose of two steps, measured by matching what the robot saw around them.
The local maps of two visits may match with an offset that is far from zero, by the covariance of
the match and of the middles of places. Then the visits are not at one place. The axiom `closure`
demands this for each closure alone. Closures together with displacements count in the misfit
(`solver/geometry/fit.py`).

*How often a true map is rejected.* The probability `reject` is divided among the returns that may
be true, as for displacements.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from ssh_abduction.data.closure import Closure
from ssh_abduction.data.odometry import Odometry
from ssh_abduction.data.trace import Trace
from ssh_abduction.theory.evidence.protocol import Evidence
from ssh_abduction.theory.pairs import Pairs

if TYPE_CHECKING:
    from ssh_abduction.theory.theory import Theory


@dataclass(frozen=True)
class Closures(Evidence):
    """Evidence from closures, with the fields `reject` and `returns` of a theory.

    Attributes:
        reject: The largest probability of rejecting the true map.
        returns: How many returns may be true.
        has_places: Whether maps have places.
    """

    name: ClassVar[str] = "closure"
    axiom: ClassVar[str] = "closure"
    reject: float
    returns: int
    has_places: bool

    @classmethod
    def of(cls, theory: Theory) -> Closures:
        return cls(theory.reject, theory.returns, theory.level == "topological")

    def pairs(self, trace: Trace) -> Pairs:
        return Pairs.of(self._refused(trace, False), self._refused(trace, True))

    def _refused(self, trace: Trace, places: bool) -> Iterator[tuple[int, int]]:
        """Yield the steps of the closures that rule out one place (`places`), or one dstate."""
        if not trace.closures or (places and not self.has_places):
            return
        from scipy.special import gammainccinv

        most = 2 * gammainccinv((2 if places else 3) / 2, self.reject / max(self.returns, 1))
        odometry = trace.odometry or Odometry()
        for match in trace.closures:
            if _square(match, odometry, places) > most:
                yield match.first, match.last


def _square(match: Closure, odometry: Odometry, places: bool) -> float:
    """The chi-square of a closure if its two steps have one position (`places`), or one pose."""
    import numpy as np

    kept = 2 if places else 3
    ends = 2 * np.diag([odometry.offset, odometry.offset, odometry.facing]) ** 2
    noise = (np.array(match.covariance) + ends)[:kept, :kept]
    off = np.array(match.displacement)
    off[2] = math.remainder(off[2], math.tau)
    return float(off[:kept] @ np.linalg.solve(noise, off[:kept]))
