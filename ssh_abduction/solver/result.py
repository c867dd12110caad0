"""How a search ended: statuses, bounds, and the solution, all frozen values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

from ssh_abduction.asp.limits import Stop
from ssh_abduction.engines.base import Cost, cost_as_counted
from ssh_abduction.maps import SSHMap
from ssh_abduction.solver.backbone import Rivals
from ssh_abduction.solver.ranking import weights
from ssh_abduction.solver.sharing import Backbone, Sharing
from ssh_abduction.steps.certificate import Basis, Certificate
from ssh_abduction.steps.noise import LEAST, Noise
from ssh_abduction.theory.theory import Theory


class Status(Enum):
    """What is known about the trace."""

    OPTIMAL = "optimal"  # minimal maps, proven
    FEASIBLE = "feasible"  # a map of the whole trace and a bound, but no proof that it is minimal
    UNSATISFIABLE = "unsatisfiable"  # no map satisfies the axioms, proven
    UNKNOWN = "unknown"  # stopped before any map of the whole trace was found


@dataclass(frozen=True, slots=True)
class Bound:
    """Lower bounds, proven, on the counts of every map of the trace; None where nothing is proven.

    The order of preference proves a bound on the count that goes first; a search that was stopped also counts the steps that cannot be one
    dstate (apart.py). The counts after the first are bounded only among the maps
    that are minimal in what goes before: those bounds are in Solution.cost once the status is optimal. Where faults are allowed, `tenths` of dstates bound what
    dstates and faults cost together.
    """

    dstates: int | None = None
    places: int | None = None
    paths: int | None = None
    excuses: int | None = None
    tenths: int | None = None

    def to_dict(self) -> dict[str, float]:
        counts: dict[str, float | None] = {"dstates": self.dstates, "places": self.places, "paths": self.paths, "excuses": self.excuses}
        counts["cost"] = None if self.tenths is None else self.tenths / 10
        return {k: v for k, v in counts.items() if v is not None}


@dataclass(frozen=True, slots=True)
class Seconds:
    """Wall-clock time: in all, for grounding, and for solving."""

    total: float
    ground: float
    solve: float


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a search is: the prefix it works on, the best cost and the bound so far, and the maps found."""

    prefix: int
    steps: int
    cost: Cost | None
    bound: Bound
    maps: int
    seconds: float


@dataclass(frozen=True, slots=True)
class Level:
    """The best maps of those with one number of dstates; of paths or places, where the theory prefers these first.

    cost   the counts of the first of them. All share the counts that the theory prefers
    count  how many there are
    """

    cost: Cost
    count: int

    def to_dict(self) -> dict[str, Any]:
        return {"cost": self.cost.to_dict(), "count": self.count}


@dataclass(frozen=True, slots=True)
class Solution:
    """The answer for one trace.

    maps       minimal maps (status optimal), or the best one found (feasible); with `within`, behind them those with more dstates
    cost       the counts of the first of these maps; None where there is none. All share the counts that the theory prefers
    bound      proven lower bounds on the counts of any map
    complete   no further minimal map exists, and with `within` no further one that is to be listed
    theory     the theory, with star settled
    steps      length of the trace
    prefix     how many of its first steps had to be given to clingo
    stopped    why the search ended before it was complete, else None
    basis      what the certificate is made from; None where the theory is without an axiom that this rests on
    partial    where no map of the whole trace was found: the best map of its first steps
    within     how many dstates more than the least a map may have to be listed
    levels     how many minimal maps were given and, with `within`, how many that have more dstates: a level for each number of them that some map has
    rivals     what the backbone is worked out from; where there is none, it is worked out from the maps listed
    evidence   for each kind of evidence that took part: how many pairs of steps it excluded, and how many sets of equalities it refused
    odometry_warning  what is wrong with the noise that the odometry claims, if the best map shows that, or that displacements tell no travel from standing still
    """

    status: Status
    maps: tuple[SSHMap, ...]
    cost: Cost | None
    bound: Bound
    complete: bool
    theory: Theory
    steps: int
    prefix: int
    seconds: Seconds
    basis: Basis | None = field(default=None, repr=False)
    stopped: Stop | None = None
    partial: SSHMap | None = None
    evidence: Mapping[str, Mapping[str, int]] = field(default_factory=dict, hash=False)
    odometry_warning: str | None = None
    within: int = 0
    levels: tuple[Level, ...] = ()
    rivals: Rivals | None = field(default=None, repr=False, compare=False)

    @property
    def costs(self) -> tuple[Cost, ...]:
        """The counts of each map, where the maps are the first ones that were given."""
        levels = self.levels or ((Level(self.cost, self.count),) if self.cost else ())
        cost_of = (level.cost for level in levels for _ in range(level.count))
        return tuple(cost_as_counted(m, cost.preferred_by(self.theory), self.theory) for m, cost in zip(self.maps, cost_of, strict=False))

    @property
    def minimal_listed(self) -> bool:
        """Whether all minimal maps were given, even if not all that `within` asks for were."""
        return self.complete or (self.rivals is not None and self.rivals.listed)

    @property
    def backbone(self) -> Backbone | None:
        """What all minimal maps share; None where no minimal map is known.

        Where not all are listed it is worked out when it is first asked for, by reasoning, which may take as long as the search was allowed to. If that is not
        enough, or Ctrl-C ends it, the backbone is not `proven`: it is then what those minimal maps share that were found.
        """
        if self.rivals is not None:
            self.rivals.reason(anew=True)
            return self.rivals.backbone
        sharing = Sharing()
        for ssh_map in self.maps if self.status is Status.OPTIMAL else ():
            sharing.absorb(ssh_map)
        return sharing.backbone(proven=self.complete) if sharing.maps else None

    @property
    def summary(self) -> str:
        """What the answer is, in one sentence: how many minimal maps there are, what all of them share, and in which steps they differ."""
        return summary_of(self, self.count, self.backbone)

    @property
    def weights(self) -> tuple[float, ...]:
        """How likely each of the maps is, among these, as displacements alone say; empty where they are not used."""
        return weights(self.maps)

    @property
    def certificate(self) -> Certificate | None:
        """Why no map has fewer dstates. Worked out when it is first asked for; None where there is nothing that it could be made from."""
        return self.basis.certificate if self.basis else None

    @property
    def noise(self) -> Noise | None:
        """The step that looks like noise, as most steps before it are dstates of their own because of it alone; None where none does.

        Worked out when it is first asked for.
        """
        few = self.cost is not None and self.cost.dstates <= LEAST
        return None if few or self.status is Status.UNSATISFIABLE or self.basis is None else self.basis.noise

    @property
    def count(self) -> int:
        """How many maps are listed."""
        return len(self.maps)


def summary_of(solution: Solution, count: int, backbone: Backbone | None) -> str:
    """One sentence on how many minimal maps there are, what all of them share, and in which steps they differ.

    count     how many maps were given, of which the solution need not hold any
    backbone  what the minimal maps share, as far as it is known
    """
    if solution.status is Status.UNSATISFIABLE:
        return "no map satisfies the axioms"
    if backbone is None:
        return "a map that is not proven minimal" if solution.cost else "no map was found"
    minimal = solution.levels[0].count if solution.levels else count
    listed = solution.minimal_listed
    told = f"{'' if listed else 'at least '}{minimal} minimal map{'' if minimal == 1 else 's'}"
    if not listed:
        told += f" (listing was stopped by the {solution.stopped})" if solution.stopped != "interrupted" else " (listing was interrupted)"
    if not (listed and minimal == 1):
        told += f": {backbone.sentence}" + ("" if backbone.proven else ", as far as was found out: others may differ in more")
    more = sum(level.count for level in solution.levels[1:])
    return told + (f"; and {more} with up to {solution.within} more" if more else "")
