"""The plain values of a solution: counts, bounds, statuses and times. Nothing here needs clingo."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from enum import Enum
from typing import Any

from ssh_abduction.data.maps import SSHMap, checked_map
from ssh_abduction.data.words import counted, shortly
from ssh_abduction.theory.theory import Theory, checked_theory


class Status(Enum):
    """What a search has proven about its trace.

    Attributes:
        OPTIMAL: Maps are proven to be minimal.
        FEASIBLE: There is a map of the whole trace, and no proof that it is minimal.
        UNSATISFIABLE: It is proven that no map satisfies the axioms.
        UNKNOWN: The search was stopped before it found any map of the whole trace.
    """

    OPTIMAL = "optimal"
    FEASIBLE = "feasible"
    UNSATISFIABLE = "unsatisfiable"
    UNKNOWN = "unknown"


@dataclass(frozen=True, slots=True)
class Cost:
    """The counts by which maps are compared.

    Attributes:
        dstates: Number of dstates.
        places: Number of places.
        paths: Number of paths.
        excuses: Number of pairs of paths that the axiom `side_of_branch` is not applied to.
        faults: The cost of all faults together, in dstates.
    """

    dstates: int
    places: int
    paths: int
    excuses: int = 0
    faults: float = 0.0

    @staticmethod
    def of(ssh_map: SSHMap) -> Cost:
        """Count the dstates, places, paths, excuses and faults of a map."""
        checked_map(ssh_map)
        faults = sum(round(10 * fault.cost) for fault in ssh_map.faults) / 10
        kinds = (ssh_map.dstates, ssh_map.places, ssh_map.theory_paths, ssh_map.excused)
        dstates, places, paths, excuses = map(len, kinds)
        return Cost(dstates, places, paths, excuses, faults)

    @property
    def tenths(self) -> int:
        """The cost of dstates and faults together, in tenths of a dstate."""
        return 10 * self.dstates + round(10 * self.faults)

    def preferred_by(self, theory: Theory) -> tuple[int, ...]:
        """Return the counts that the theory minimises, the most important one first."""
        return tuple(getattr(self, name) for name in checked_theory(theory).priorities)

    def to_dict(self) -> dict[str, float]:
        """Return the counts by name. Excuses and faults are left out if there are none."""
        counts: dict[str, float] = asdict(self)
        return {k: v for k, v in counts.items() if v or k not in ("excuses", "faults")}


@dataclass(frozen=True, slots=True)
class Found:
    """A map of a prefix, with the counts that the theory minimises, the most important first."""

    map: SSHMap
    cost: tuple[int, ...]

    @staticmethod
    def of(ssh_map: SSHMap, theory: Theory) -> Found:
        """Return a map with its cost: the counts that the theory minimises."""
        return Found(ssh_map, Cost.of(ssh_map).preferred_by(theory))


def cost_as_counted(ssh_map: SSHMap, cost: tuple[int, ...], theory: Theory) -> Cost:
    """Return the cost of a map, with the counts that the theory minimises taken from clingo.

    Without some axioms, a dstate may have several places or paths, but a map shows only one. Then
    clingo counts more than the map shows. If maps are compared by their cost in nats, maps of one
    cost may have different counts. Then the result has the counts of the map.

    Args:
        ssh_map: A map that clingo found.
        cost: The counts that clingo minimised, the most important one first.
        theory: The theory that minimises them.
    """
    if theory.weigh == "cost":
        return Cost.of(ssh_map)
    counts = {
        name: count for name, count in zip(theory.priorities, cost, strict=True) if name != "tenths"
    }
    return replace(Cost.of(ssh_map), **counts)


@dataclass(frozen=True, slots=True)
class Bound:
    """Proven lower bounds on the counts of every map of a trace.

    A search proves a bound on the count that the theory minimises first. It proves no bound on the
    other counts, as a map that is not minimal may have fewer places or paths. An attribute is None
    if nothing is proven.

    Attributes:
        dstates: Lower bound on the dstates. For a search that was stopped, it is at least the
            number of steps that are pairwise distinct.
        places: Lower bound on the places.
        paths: Lower bound on the paths.
        excuses: Lower bound on the pairs of paths that `side_of_branch` is not applied to.
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
        """Return the bounds that are proven, by name. "cost" is `tenths` in dstates."""
        known = {name: bound for name, bound in asdict(self).items() if bound is not None}
        tenths = known.pop("tenths", None)
        return known if tenths is None else {**known, "cost": tenths / 10}


@dataclass(frozen=True, slots=True)
class Seconds:
    """Wall-clock seconds of a search: in all, for grounding, and for solving."""

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
        prefix: The number of first steps of the trace that were given to clingo.
        seconds: The time that the search took.
        grounding: The size of the ground program that clingo solved last.
        evidence: For each kind of evidence, by name, two numbers: "pairs" of steps that it
            excluded, and sets of equalities that it rejected ("refused").
        work: The units of work that the search did; None if it had no work limit.
    """

    prefix: int
    seconds: Seconds = field(compare=False)
    grounding: Grounding = field(default=Grounding(0, 0), compare=False)
    evidence: Mapping[str, Mapping[str, int]] = field(default_factory=dict, hash=False)
    work: float | None = field(default=None, compare=False)


@dataclass(frozen=True, slots=True)
class Level:
    """How many listed maps have one cost.

    It is the minimal cost or, with `within`, the least cost for some greater number of dstates.

    Attributes:
        cost: The cost of the first of these maps. All of them share the counts that the theory
            minimises.
        count: The number of these maps.
        complete: Whether no further map is minimal. All levels of a solution have the same value.
    """

    cost: Cost
    count: int
    complete: bool = field(default=False, compare=False)

    def to_dict(self) -> dict[str, Any]:
        """Return the cost and the count as plain data."""
        return {"cost": self.cost.to_dict(), "count": self.count}


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a search is.

    Attributes:
        prefix: The number of first steps of the trace that clingo has.
        steps: The number of steps of the trace.
        cost: The cost of the best map so far; None before there is one.
        bound: The proven lower bounds so far.
        maps: The number of maps given to the caller so far.
        seconds: The seconds since the search began.
        work: The units of work done and left; None without a limit of work.
    """

    prefix: int
    steps: int
    cost: Cost | None
    bound: Bound
    maps: int
    seconds: float
    work: tuple[float, float] | None = None

    @property
    def sentence(self) -> str:
        """The progress on one line, in words."""
        far = ""
        if self.work is not None:
            far = f"{self.work[0]:.0f} of {counted(round(sum(self.work)), 'units')}, "
        counts = ((getattr(self.cost, k), k) for k in ("places", "dstates", "paths") if self.cost)
        best = ", ".join(counted(number, k) for number, k in counts if number)
        bound = "".join(f", {k} ≥ {v}" for k, v in self.bound.to_dict().items())
        listed = f", {counted(self.maps, 'maps')} listed" if self.maps else ""
        return f"{far}{f'best {best}' if best else 'no map yet'}{bound}{listed}"
