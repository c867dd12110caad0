"""How a search ended: statuses, bounds, and the solution, all frozen values."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from enum import Enum
from typing import Any, overload

from ssh_abduction.checker.claims import contradictions
from ssh_abduction.data.errors import MapError, brief, checked_index, named
from ssh_abduction.data.fields import FieldReader
from ssh_abduction.data.files import json_line
from ssh_abduction.data.map_file import SOLUTION_FORMAT, VERSION, check_format, read_json, write_map
from ssh_abduction.data.maps import SSHMap, check_of_trace, maps_of
from ssh_abduction.data.trace import Trace, checked_trace
from ssh_abduction.data.words import counted, shortly
from ssh_abduction.output import cards
from ssh_abduction.solver.asp.control import Grounding
from ssh_abduction.solver.asp.limits import Stop
from ssh_abduction.solver.backbone import Rivals
from ssh_abduction.solver.engines.base import Cost, cost_as_counted
from ssh_abduction.solver.ranking import weights
from ssh_abduction.solver.recorded import (
    Recorded,
    bound_in,
    cost_in,
    evidence_in,
    grounding_in,
    levels_in,
    seconds_in,
    theory_in,
)
from ssh_abduction.solver.sharing import Backbone, Sharing
from ssh_abduction.solver.steps.certificate import Basis, Certificate
from ssh_abduction.solver.steps.noise import LEAST, Noise
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

    def __repr__(self) -> str:
        return shortly(self)

    def to_dict(self) -> dict[str, float]:
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
class Progress:
    """How far a search is: the prefix it works on, the best cost and the bound so far, and the maps found."""

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
        return f"prefix {self.prefix} of {self.steps} steps; {best}; {bound}; {self.maps} maps; {self.seconds:.1f} s"


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
    """The answer for one trace. It is a sequence of its maps: `len(solution)`, `solution[0]`, `for ssh_map in solution`.

    Two solutions are equal where they say the same of the trace, however long that took and whatever it was worked out from.

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
    trace      the trace; None in a solution that was read from a file without it
    grounding  rules and atoms of the ground program that clingo solved last
    recorded   what the file says beyond that, in a solution that was read from one
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
    seconds: Seconds = field(compare=False)
    basis: Basis | None = field(default=None, repr=False, compare=False)
    stopped: Stop | None = None
    partial: SSHMap | None = None
    evidence: Mapping[str, Mapping[str, int]] = field(default_factory=dict, hash=False)
    odometry_warning: str | None = field(default=None, compare=False)
    within: int = 0
    levels: tuple[Level, ...] = field(default=(), compare=False)
    rivals: Rivals | None = field(default=None, repr=False, compare=False)
    trace: Trace | None = field(default=None, repr=False, compare=False)
    grounding: Grounding = field(default=Grounding(0, 0), compare=False)
    recorded: Recorded | None = field(default=None, repr=False, compare=False)

    def __len__(self) -> int:
        """How many maps are listed."""
        return len(self.maps)

    def __bool__(self) -> bool:
        """True, as an answer is an answer even where it has no map; ask `len` or `status` for the maps."""
        return True

    def __iter__(self) -> Iterator[SSHMap]:
        return iter(self.maps)

    @overload
    def __getitem__(self, index: int) -> SSHMap: ...

    @overload
    def __getitem__(self, index: slice) -> tuple[SSHMap, ...]: ...

    def __getitem__(self, index: int | slice) -> SSHMap | tuple[SSHMap, ...]:
        """A map, counted from 0, or maps. Raises RangeError, which names the range."""
        return (
            self.maps[index]
            if isinstance(index, slice)
            else self.maps[checked_index(index, len(self.maps), "maps")]
        )

    def __repr__(self) -> str:
        return f"<Solution {self.headline}>"

    def _repr_html_(self) -> str:
        """What notebooks show: how the search ended, what the minimal maps share as far as that is known, and the first map; of an unknown answer what is known."""
        known = self.rivals.backbone if self.rivals is not None else self.backbone
        parts = (
            []
            if self.status is Status.UNSATISFIABLE
            else [cards.paragraph(summary_of(self, self.count, known))]
        )
        parts += [
            cards.paragraph(f"warning: {warning}")
            for warning in (() if self.stopped == "interrupted" else self.warnings)
        ]
        if self.count > 1:
            parts.append(
                cards.folded(
                    f"{counted(self.count, 'maps')}, of which the first is shown",
                    self._table_of_maps(),
                )
            )
        shown = self.maps[0] if self.maps else self.partial
        if shown is not None:
            first = (
                ""
                if self.maps
                else cards.paragraph(
                    f"the best map of the first {counted(len(shown.labels), 'steps')}:"
                )
            )
            parts.append(first + cards.map_card(shown))
        return cards.card(
            self.headline,
            *parts,
            cards.paragraph(
                f"{self.seconds.total:.2f} s, {self.prefix} of {counted(self.steps, 'steps')} given to clingo"
            ),
        )

    def _table_of_maps(self) -> str:
        """A row a map: what it costs, and how well it closes."""
        costs, closes = (
            self.costs,
            [ssh_map.fit.chi2 if ssh_map.fit else None for ssh_map in self.maps],
        )
        columns: dict[str, list[object]] = {"map": [*range(1, self.count + 1)]}
        columns |= {
            name: [getattr(cost, name) for cost in costs]
            for name in ("dstates", "places", "paths", "excuses", "faults")
        }
        columns |= {"chi-square": ["" if chi2 is None else f"{chi2:.1f}" for chi2 in closes]}
        shown = {name: column for name, column in columns.items() if any(column)}
        return cards.table([*shown], zip(*shown.values(), strict=True), "maps")

    @property
    def headline(self) -> str:
        """The status, the counts of the best map, and how many maps there are or which bound is proven; in one line."""
        why = f" ({self.stopped})" if self.stopped else ""
        bound = (
            ", ".join(
                f"{'cost' if k == 'cost' else k} ≥ {v:g}" for k, v in self.bound.to_dict().items()
            )
            or "no bound"
        )
        if self.status is Status.UNSATISFIABLE:
            return f"{self.status.value}: no map of {counted(self.steps, 'steps')} satisfies the axioms"
        if self.cost is None:
            return (
                f"{self.status.value}{why}: no map of {counted(self.steps, 'steps')} yet; {bound}"
            )
        shown = {
            k: v
            for k, v in self.cost.to_dict().items()
            if self.theory.level != "causal" or k in ("dstates", "faults")
        }
        counts = ", ".join(
            counted(v, k) if k != "faults" else f"faults that cost {v:g}" for k, v in shown.items()
        )
        if self.status is Status.FEASIBLE:
            return f"{self.status.value}{why}: {counts}; {bound}"
        least = self.levels[0].count if self.levels else self.count
        more = f" and {counted(self.count - least, 'maps')} with more" if self.count > least else ""
        return f"{self.status.value}: {counts}; {counted(least, 'minimal maps')}{more}{'' if self.complete else f', perhaps more{why}'}"

    @property
    def costs(self) -> tuple[Cost, ...]:
        """The counts of each map, where the maps are the first ones that were given."""
        levels = self.levels or ((Level(self.cost, self.count),) if self.cost else ())
        cost_of = (level.cost for level in levels for _ in range(level.count))
        return tuple(
            cost_as_counted(m, cost.preferred_by(self.theory), self.theory)
            for m, cost in zip(self.maps, cost_of, strict=False)
        )

    @property
    def minimal_listed(self) -> bool:
        """Whether all minimal maps were given, even if not all that `within` asks for were."""
        known = self.recorded or self.rivals
        return self.complete or (known is not None and known.listed)

    @property
    def backbone(self) -> Backbone | None:
        """What all minimal maps share; None where no minimal map is known.

        Where not all are listed it is worked out when it is first asked for, by reasoning, which may take as long as the search was allowed to. If that is not
        enough, or Ctrl-C ends it, the backbone is not `proven`: it is then what those minimal maps share that were found.
        """
        if self.rivals is not None:
            self.rivals.reason(anew=True)
            return self.rivals.backbone
        if self.recorded is not None and self.recorded.backbone is not None:
            return self.recorded.backbone
        sharing = Sharing()
        minimal = self.maps[: self.levels[0].count] if self.levels else self.maps
        for ssh_map in minimal if self.status is Status.OPTIMAL else ():
            sharing.absorb(ssh_map)
        return sharing.backbone(proven=self.minimal_listed) if sharing.maps else None

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
        if self.recorded is not None:
            return self.recorded.certificate
        return self.basis.certificate if self.basis else None

    @property
    def warnings(self) -> tuple[str, ...]:
        """What makes the trace suspicious, a sentence each: a step that looks like noise, and odometry that claims too much or too little."""
        if self.recorded is not None:
            return self.recorded.warnings
        noise = [self.noise.sentence(self.trace)] if self.noise and self.trace else []
        return (*noise, *([self.odometry_warning] if self.odometry_warning else []))

    @property
    def noise(self) -> Noise | None:
        """The step that looks like noise, as most steps before it are dstates of their own because of it alone; None where none does.

        Worked out when it is first asked for.
        """
        few = self.cost is not None and self.cost.dstates <= LEAST
        return (
            None
            if few or self.status is Status.UNSATISFIABLE or self.basis is None
            else self.basis.noise
        )

    @property
    def count(self) -> int:
        """How many maps are listed."""
        return len(self.maps)

    def to_dict(self) -> dict[str, Any]:
        """The answer as plain data, as `solve --json` prints it (docs/formats.md), but without what costs another search: why there is no map, and the runner-up.

        The backbone is worked out, if it is not known yet. Raises MapError where the maps are not those that the search gave.
        """
        given = sum(level.count for level in self.levels)
        if (self.cost is not None or given) and (not self.maps or given not in (0, len(self.maps))):
            raise MapError(
                f"maps: expected the {max(given, 1)} that the search gave, got {len(self.maps)}; give them to Search.solution"
            )
        maps = [
            written_map(m, cost if self.within else None)
            for m, cost in zip(self.maps, self.costs, strict=True)
        ]
        return {
            **opening(self.theory, self.steps, self.within),
            "maps": maps,
            **ending(self, self.count, self.backbone),
        }

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the answer as `solve --json` does, with a line a map, for `load` and for the commands that read maps. Raises MapError."""
        data = self.to_dict()
        maps = data.pop("maps")
        head = opening(self.theory, self.steps, self.within)
        end = {name: value for name, value in data.items() if name not in head}
        lines = ",\n".join(json_line(m) for m in maps)
        write_map(
            path, f'{json_line(head)[:-1]}, "maps": [\n{lines}\n],{json_line(end)[1:]}', "solution"
        )

    @classmethod
    def load(cls, path: str | os.PathLike[str], trace: Trace | None = None) -> Solution:
        """The answer in a file that `save` or `solve --json` wrote, or on standard input for "-".

        trace  the trace that it is of, if it is at hand. Then it is checked that the maps are of this one

        Raises MapError that names the file and the field: where the file is of another version, or contradicts itself or the trace.
        """
        return cls.from_dict(read_json(path), named(path), trace)

    @classmethod
    def from_dict(cls, data: Any, where: str = "solution", trace: Trace | None = None) -> Solution:
        """The answer that `to_dict` made plain data of. `where` is how messages call that; the rest is as for `load`. Raises MapError."""
        read = FieldReader(where)
        record = read.mapping(data, "")
        if "maps" not in record and "labels" in record:
            raise MapError(f"{where}: maps: expected a solution, got one map; take SSHMap.load")
        if record.get("status") == "error":
            raise MapError(
                f"{where}: status: expected a solution, got the error that solve ended with: {brief(record.get('error'))}"
            )
        check_format(record, SOLUTION_FORMAT, where)
        for name in ("maps", "theory", "steps", "status", "complete"):
            if name not in record:
                raise MapError(
                    f"{where}: {name}: expected what solve --json or Solution.save writes, got none; solve again"
                )
        maps, steps, theory = (
            tuple(maps_of(record, where)),
            read.integer(record["steps"], "steps"),
            theory_in(record["theory"], where),
        )
        if (false := next(contradictions(record, maps, steps, theory), None)) is not None:
            raise MapError(f"{where}: {false}; it was changed by hand, or cut")
        for i, ssh_map in enumerate(maps):
            if len(ssh_map.labels) != steps:
                raise MapError(
                    f"{where}: maps[{i}].labels: expected {steps}, one a step, got {len(ssh_map.labels)}; it was changed by hand"
                )
        if trace is not None:
            check_of_trace(
                maps, checked_trace(trace), where, views="functional_view" in theory.hard
            )
            if steps != len(trace):
                raise MapError(
                    f"{where}: steps: expected those of a trace of {len(trace)} steps, got {steps}; it is of another trace"
                )
        return cls(
            status=Status(record["status"]),
            maps=maps,
            cost=None if record.get("cost") is None else cost_in(read, record["cost"], "cost"),
            bound=Bound(**bound_in(read, record.get("bound", {}))),
            complete=record["complete"],
            theory=theory,
            steps=steps,
            prefix=read.integer(record.get("prefix", 0), "prefix"),
            seconds=Seconds(*seconds_in(read, record.get("seconds", {}))),
            stopped=record.get("stopped"),
            partial=None
            if record.get("partial") is None
            else SSHMap.from_dict(record["partial"], f"{where}: partial"),
            evidence=evidence_in(read, record.get("evidence", {})),
            within=read.integer(record.get("within", 0), "within"),
            levels=tuple(Level(*level) for level in levels_in(read, record, len(maps))),
            trace=trace,
            grounding=grounding_in(read, record.get("grounding", {})),
            recorded=Recorded.of(read, record, steps),
        )


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
        told += (
            f" (listing was stopped by the {solution.stopped})"
            if solution.stopped != "interrupted"
            else " (listing was interrupted)"
        )
    if not (listed and minimal == 1):
        told += f": {backbone.sentence}" + (
            "" if backbone.proven else ", as far as was found out: others may differ in more"
        )
    more = sum(level.count for level in solution.levels[1:])
    return told + (f"; and {more} with up to {solution.within} more" if more else "")


def opening(theory: Theory, steps: int, within: int) -> dict[str, Any]:
    """What the JSON of a solution says before its maps."""
    head = {
        "format": SOLUTION_FORMAT,
        "version": VERSION,
        "theory": theory.to_dict(),
        "steps": steps,
    }
    return {**head, **({"within": within} if within else {})}


def written_map(ssh_map: SSHMap, cost: Cost | None = None) -> dict[str, Any]:
    """What the JSON of a solution says of a map: also what it costs, where that is given, as not all maps cost the same."""
    return ssh_map.to_dict() | ({"cost": cost.to_dict()} if cost else {})


def ending(solution: Solution, count: int, backbone: Backbone | None) -> dict[str, Any]:
    """What the JSON of a solution says after its maps.

    count     how many maps were written, of which the solution need not hold any
    backbone  what the minimal maps share, as far as it is known
    """
    end: dict[str, Any] = {
        "status": solution.status.value,
        "complete": solution.complete,
        "count": count,
        "cost": solution.cost.to_dict() if solution.cost else None,
        "bound": solution.bound.to_dict(),
        "prefix": solution.prefix,
        "grounding": asdict(solution.grounding),
        "seconds": {
            k: round(getattr(solution.seconds, k), 6) for k in ("total", "ground", "solve")
        },
    }
    end["summary"] = summary_of(solution, count, backbone)
    if backbone and not (solution.minimal_listed and count == 1):
        end["backbone"] = backbone.to_dict()
    if solution.within:
        end["levels"] = [level.to_dict() for level in solution.levels]
        if solution.minimal_listed and not solution.complete:
            end["minimal_listed"] = True
    recorded = solution.recorded
    if recorded is not None and recorded.written_certificate is not None:
        end["certificate"] = dict(recorded.written_certificate)
    elif solution.certificate:
        end["certificate"] = solution.certificate.to_dict(solution.trace)
    if solution.stopped:
        end["stopped"] = solution.stopped
    if solution.partial:
        end["partial"] = solution.partial.to_dict()
    if solution.evidence:
        end["evidence"] = {name: dict(said) for name, said in solution.evidence.items()}
    if solution.warnings:
        end["warnings"] = list(solution.warnings)
    if recorded is not None and recorded.explanation is not None:
        end["explanation"] = dict(recorded.explanation)
    return end
