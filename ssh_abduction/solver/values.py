"""Counts, bounds and statuses: the plain values of a solution. Nothing here needs clingo."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any

from ssh_abduction.data.maps import SSHMap, checked_map
from ssh_abduction.data.words import shortly
from ssh_abduction.theory.theory import Theory, checked_theory


class Status(Enum):
    """What a search has proven about its trace."""

    OPTIMAL = "optimal"  # minimal maps, proven
    FEASIBLE = "feasible"  # a map of the whole trace and a bound, but no proof that it is minimal
    UNSATISFIABLE = "unsatisfiable"  # no map satisfies the axioms, proven
    UNKNOWN = "unknown"  # stopped before any map of the whole trace was found


@dataclass(frozen=True, slots=True)
class Cost:
    """The counts that maps are compared by.

    Attributes:
        dstates: Number of dstates.
        places: Number of places.
        paths: Number of paths.
        excuses: Number of excused pairs of paths.
        faults: The cost of all faults together, in dstates.
    """

    dstates: int
    places: int
    paths: int
    excuses: int = 0
    faults: float = 0.0

    @staticmethod
    def of(ssh_map: SSHMap) -> Cost:
        """Count what a map has."""
        checked_map(ssh_map)
        faults = sum(round(10 * fault.cost) for fault in ssh_map.faults) / 10
        return Cost(
            len(ssh_map.dstates),
            len(ssh_map.places),
            len(ssh_map.paths),
            len(ssh_map.excused),
            faults,
        )

    @property
    def tenths(self) -> int:
        """The cost of dstates and faults together, in tenths of a dstate."""
        return 10 * self.dstates + round(10 * self.faults)

    def preferred_by(self, theory: Theory) -> tuple[int, ...]:
        """The counts that a theory minimises, the most important one first."""
        return tuple(getattr(self, name) for name in checked_theory(theory).priorities)

    def to_dict(self) -> dict[str, float]:
        """The counts by name; excuses and faults only if there are any."""
        counts: dict[str, float] = {
            "dstates": self.dstates,
            "places": self.places,
            "paths": self.paths,
        }
        counts |= {"excuses": self.excuses} if self.excuses else {}
        return {**counts, "faults": self.faults} if self.faults else counts


def cost_as_counted(ssh_map: SSHMap, cost: tuple[int, ...], theory: Theory) -> Cost:
    """The cost of a map, with the preferred counts as clingo counted them.

    If axioms are left out, clingo may count more than the map can show.

    Args:
        ssh_map: The map.
        cost: Its preferred counts by clingo, the most important one first.
        theory: The theory that prefers them.
    """
    counted = {
        name: count for name, count in zip(theory.priorities, cost, strict=True) if name != "tenths"
    }
    return replace(Cost.of(ssh_map), **counted)


@dataclass(frozen=True, slots=True)
class Bound:
    """Proven lower bounds on the counts of every map of the trace; None if nothing is proven.

    A search proves a bound on the count that the theory prefers first. The other counts are
    bounded among the minimal maps only; see `Solution.cost` once the status is optimal.

    Attributes:
        dstates: Lower bound on the dstates. A search that was stopped also takes it from the
            steps that are pairwise distinct.
        places: Lower bound on the places.
        paths: Lower bound on the paths.
        excuses: Lower bound on the excused pairs of paths.
        tenths: If faults are allowed, lower bound on the cost of dstates and faults together, in
            tenths of a dstate.
    """

    dstates: int | None = None
    places: int | None = None
    paths: int | None = None
    excuses: int | None = None
    tenths: int | None = None

    def __repr__(self) -> str:
        return shortly(self)

    def to_dict(self) -> dict[str, float]:
        """The bounds that are proven, by name."""
        counts: dict[str, float | None] = {
            "dstates": self.dstates,
            "places": self.places,
            "paths": self.paths,
            "excuses": self.excuses,
        }
        counts["cost"] = None if self.tenths is None else self.tenths / 10
        return {k: v for k, v in counts.items() if v is not None}


@dataclass(frozen=True, slots=True)
class Seconds:
    """Wall-clock time: in all, for grounding, and for solving."""

    total: float
    ground: float
    solve: float


@dataclass(frozen=True, slots=True)
class Grounding:
    """The size of a ground program: its rules and atoms."""

    rules: int
    atoms: int


@dataclass(frozen=True, slots=True)
class Effort:
    """What a search did to find its answer.

    Attributes:
        prefix: The number of first steps given to clingo.
        seconds: The time it took.
        grounding: The ground program that clingo solved last.
        evidence: For each kind of evidence, the numbers of pairs of steps that it excluded and of
            sets of equalities that it rejected.
    """

    prefix: int
    seconds: Seconds = field(compare=False)
    grounding: Grounding = field(default=Grounding(0, 0), compare=False)
    evidence: Mapping[str, Mapping[str, int]] = field(default_factory=dict, hash=False)


@dataclass(frozen=True, slots=True)
class Level:
    """The best maps with one number of dstates (of paths or places if these come first).

    Attributes:
        cost: The cost of the first map. All share the counts that the theory prefers.
        count: The number of maps.
        complete: Whether the level has no further map.
    """

    cost: Cost
    count: int
    complete: bool = field(default=False, compare=False)

    def to_dict(self) -> dict[str, Any]:
        """The cost and the count."""
        return {"cost": self.cost.to_dict(), "count": self.count}


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a search is.

    Attributes:
        prefix: The number of first steps that it works on.
        steps: The number of steps of the trace.
        cost: The cost of the best map so far; None before there is one.
        bound: The proven lower bounds so far.
        maps: The number of maps given so far.
        seconds: The time since the search began.
    """

    prefix: int
    steps: int
    cost: Cost | None
    bound: Bound
    maps: int
    seconds: float

    @property
    def sentence(self) -> str:
        """All of it on one line."""
        best = (
            f"best {self.cost.dstates} dstates, {self.cost.places} places, {self.cost.paths} paths"
            if self.cost
            else "no map yet"
        )
        bound = ", ".join(f"{k} ≥ {v}" for k, v in self.bound.to_dict().items()) or "no bound yet"
        return (
            f"prefix {self.prefix} of {self.steps} steps; {best}; {bound}; {self.maps} maps; "
            f"{self.seconds:.1f} s"
        )
