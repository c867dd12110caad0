"""The answer for one trace: a frozen value without a solver. Importing it does not load clingo."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, overload

from ssh_abduction.checker.claims import contradictions
from ssh_abduction.data.errors import MapError, brief, checked_index, named
from ssh_abduction.data.fields import FieldReader
from ssh_abduction.data.files import json_line
from ssh_abduction.data.map_file import SOLUTION_FORMAT, check_format, read_json, write_map
from ssh_abduction.data.maps import SSHMap, check_of_trace, maps_of
from ssh_abduction.data.trace import Trace, checked_trace
from ssh_abduction.data.words import counted
from ssh_abduction.output import cards
from ssh_abduction.solver.asp.limits import Stop
from ssh_abduction.solver.ranking import weights
from ssh_abduction.solver.recorded import (
    Recorded,
    Support,
    backbone_in,
    bound_in,
    cost_in,
    effort_in,
    levels_in,
    theory_in,
)
from ssh_abduction.solver.sharing import Backbone, Sharing
from ssh_abduction.solver.steps.certificate import Certificate
from ssh_abduction.solver.steps.noise import LEAST, Noise
from ssh_abduction.solver.values import (
    Bound,
    Cost,
    Effort,
    Grounding,
    Level,
    Seconds,
    Status,
    cost_as_counted,
)
from ssh_abduction.solver.writing import ending, opening, summary_of, written_map
from ssh_abduction.theory.theory import Theory


@dataclass(frozen=True, slots=True)
class Solution:
    """The answer for one trace.

    A solution is a sequence of its maps: `len(solution)`, `solution[0]`, and
    `for ssh_map in solution`. Two solutions are equal if they say the same about the trace,
    whatever time they took.

    Attributes:
        status: What is proven.
        maps: The minimal maps (status optimal), or the best map found (feasible). With `within`,
            maps with more dstates follow.
        cost: The cost of the first map; None if there is no map. All minimal maps share the
            counts that the theory prefers.
        bound: Proven lower bounds on the counts of any map.
        complete: Whether no further map exists: no minimal one and, with `within`, none to list.
        theory: The theory, with its stars settled.
        steps: The length of the trace.
        effort: What the search did: time, grounding, prefix, and evidence.
        stopped: Why the search ended before it was complete; None if it did not.
        partial: If no map of the whole trace was found, the best map of its first steps.
        within: The number of dstates above the minimum that a listed map may have.
        levels: The minimal maps, and with `within` the maps for each greater number of dstates.
        shared: What all minimal maps share, also those not in `maps`, as the search found out.
            None if it found out no more than `maps` show.
        trace: The trace; None in a solution that was read from a file without it.
        support: The basis of the certificate and of the warnings.
    """

    status: Status
    maps: tuple[SSHMap, ...]
    cost: Cost | None
    bound: Bound
    complete: bool
    theory: Theory
    steps: int
    effort: Effort
    stopped: Stop | None = None
    partial: SSHMap | None = None
    within: int = 0
    levels: tuple[Level, ...] = field(default=(), compare=False)
    shared: Backbone | None = field(default=None, repr=False, compare=False)
    trace: Trace | None = field(default=None, repr=False, compare=False)
    support: Support = field(default=Support(), repr=False, compare=False)

    def __len__(self) -> int:
        """The number of maps."""
        return len(self.maps)

    def __bool__(self) -> bool:
        """True, even without a map. Ask `len` or `status` whether there are maps."""
        return True

    def __iter__(self) -> Iterator[SSHMap]:
        return iter(self.maps)

    @overload
    def __getitem__(self, index: int) -> SSHMap: ...

    @overload
    def __getitem__(self, index: slice) -> tuple[SSHMap, ...]: ...

    def __getitem__(self, index: int | slice) -> SSHMap | tuple[SSHMap, ...]:
        """The map at a position, or several maps for a slice. Raises RangeError."""
        return (
            self.maps[index]
            if isinstance(index, slice)
            else self.maps[checked_index(index, len(self.maps), "maps")]
        )

    def __repr__(self) -> str:
        return f"<Solution {self.headline}>"

    def _repr_html_(self) -> str:
        """The card that notebooks show: how the search ended, the backbone, and the first map."""
        parts = []
        if self.status is not Status.UNSATISFIABLE:
            parts.append(cards.paragraph(self.summary))
        warnings = () if self.stopped == "interrupted" else self.warnings
        parts += [cards.paragraph(f"warning: {warning}") for warning in warnings]
        if self.count > 1:
            title = f"{counted(self.count, 'maps')}, of which the first is shown"
            parts.append(cards.folded(title, _table_of_maps(self)))
        if self.maps:
            parts.append(cards.map_card(self.maps[0]))
        elif self.partial is not None:
            steps = counted(len(self.partial.labels), "steps")
            parts.append(
                cards.paragraph(f"the best map of the first {steps}:")
                + cards.map_card(self.partial)
            )
        took = (
            f"{self.seconds.total:.2f} s, {self.prefix} of {counted(self.steps, 'steps')} given "
            "to clingo"
        )
        return cards.card(self.headline, *parts, cards.paragraph(took))

    @property
    def headline(self) -> str:
        """One line: the status, the cost, and the number of minimal maps or the bound."""
        why = f" ({self.stopped})" if self.stopped else ""
        steps = counted(self.steps, "steps")
        bounds = [f"{k} ≥ {v:g}" for k, v in self.bound.to_dict().items()]
        bound = ", ".join(bounds) or "no bound"
        if self.status is Status.UNSATISFIABLE:
            return f"{self.status.value}: no map of {steps} satisfies the axioms"
        if self.cost is None:
            return f"{self.status.value}{why}: no map of {steps} yet; {bound}"
        # A causal map has no places and paths to count.
        counts = ", ".join(
            counted(v, k) if k != "faults" else f"faults that cost {v:g}"
            for k, v in self.cost.to_dict().items()
            if self.theory.level != "causal" or k in ("dstates", "faults")
        )
        if self.status is Status.FEASIBLE:
            return f"{self.status.value}{why}: {counts}; {bound}"
        least = self.levels[0].count if self.levels else self.count
        more = f" and {counted(self.count - least, 'maps')} with more" if self.count > least else ""
        perhaps = "" if self.complete else f", perhaps more{why}"
        return f"{self.status.value}: {counts}; {counted(least, 'minimal maps')}{more}{perhaps}"

    @property
    def costs(self) -> tuple[Cost, ...]:
        """The cost of each map."""
        levels = self.levels or ((Level(self.cost, self.count),) if self.cost else ())
        cost_of = (level.cost for level in levels for _ in range(level.count))
        return tuple(
            cost_as_counted(m, cost.preferred_by(self.theory), self.theory)
            for m, cost in zip(self.maps, cost_of, strict=False)
        )

    @property
    def minimal_maps(self) -> tuple[SSHMap, ...]:
        """The maps that are proven to be minimal."""
        if self.status is not Status.OPTIMAL:
            return ()
        return self.maps[: self.levels[0].count] if self.levels else self.maps

    @property
    def minimal_listed(self) -> bool:
        """Whether all minimal maps were given, even if not all maps `within` more were."""
        return self.complete or (bool(self.levels) and self.levels[0].complete)

    @property
    def backbone(self) -> Backbone | None:
        """What the minimal maps share, as far as it is known; None without a minimal map.

        If not all minimal maps were listed, it is proven only if the search went on to prove it.
        `find_backbone` proves it afterwards.
        """
        if self.shared is not None:
            return self.shared
        sharing = Sharing()
        for ssh_map in self.minimal_maps:
            sharing.absorb(ssh_map)
        return sharing.backbone(proven=self.minimal_listed) if sharing.maps else None

    @property
    def summary(self) -> str:
        """One sentence: how many minimal maps there are, and where they differ."""
        return summary_of(self, self.count, self.backbone)

    @property
    def weights(self) -> tuple[float, ...]:
        """The probability of each map by displacements alone; empty without displacements."""
        return weights(self.maps)

    @property
    def certificate(self) -> Certificate | None:
        """The proof that no map has fewer dstates; None if the theory lacks an axiom for it.

        It is computed at the first use.
        """
        return self.support.certificate

    @property
    def warnings(self) -> tuple[str, ...]:
        """What makes the trace suspicious: a step that looks like noise, or wrong odometry."""
        if self.support.recorded is not None:
            return self.support.recorded.warnings
        noise = [self.noise.sentence(self.trace)] if self.noise and self.trace else []
        odometry = self.support.odometry_warning
        return (*noise, *([odometry] if odometry else []))

    @property
    def noise(self) -> Noise | None:
        """The step that looks like noise; None if there is no such step.

        Because of this step alone, most steps before it are dstates of their own. The search for
        it runs at the first use.
        """
        few = self.cost is not None and self.cost.dstates <= LEAST
        basis = self.support.basis
        return None if few or self.status is Status.UNSATISFIABLE or not basis else basis.noise

    @property
    def count(self) -> int:
        """The number of maps."""
        return len(self.maps)

    @property
    def prefix(self) -> int:
        """How many of the first steps were given to clingo."""
        return self.effort.prefix

    @property
    def seconds(self) -> Seconds:
        """The time that the search took."""
        return self.effort.seconds

    @property
    def grounding(self) -> Grounding:
        """The size of the ground program that clingo solved last."""
        return self.effort.grounding

    @property
    def evidence(self) -> Mapping[str, Mapping[str, int]]:
        """For each kind of evidence, how many pairs and sets of equalities it ruled out."""
        return self.effort.evidence

    def to_dict(self) -> dict[str, Any]:
        """The answer as plain data, as `solve --json` prints it (docs/reference/formats.md).

        The reason why there is no map and the runner-up are left out, as each needs a search.

        Raises:
            MapError: The maps are not those that the search gave.
        """
        given = sum(level.count for level in self.levels)
        if (self.cost is not None or given) and (not self.maps or given not in (0, len(self.maps))):
            raise MapError(
                f"maps: expected the {max(given, 1)} that the search gave, got {len(self.maps)}; "
                "give them to Search.solution"
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
        """Write the answer to a file as `solve --json` does, with a line for each map.

        Raises:
            MapError: The file cannot be written, or the maps are not those that the search gave.
        """
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
        """Read an answer that `save` or `solve --json` wrote.

        Args:
            path: The file; "-" for standard input.
            trace: The trace that was solved. If it is given, the maps are checked against it.

        Raises:
            MapError: The file has another version, or contradicts itself or the trace.
        """
        return cls.from_dict(read_json(path), named(path), trace)

    @classmethod
    def from_dict(cls, data: Any, where: str = "solution", trace: Trace | None = None) -> Solution:
        """Read an answer that `to_dict` made plain data.

        Args:
            data: The plain data.
            where: What error messages call the data.
            trace: The trace that was solved. If it is given, the maps are checked against it.

        Raises:
            MapError: The data have another version, or contradict themselves or the trace.
        """
        read = FieldReader(where)
        record = _checked_record(read, data)
        maps = tuple(maps_of(record, where))
        steps = read.integer(record["steps"], "steps")
        theory = theory_in(record["theory"], where)
        if (false := next(contradictions(record, maps, steps, theory), None)) is not None:
            raise MapError(f"{where}: {false}; it was changed by hand, or cut")
        _check_steps(where, maps, steps, theory, trace)
        return cls(
            status=Status(record["status"]),
            maps=maps,
            cost=None if record.get("cost") is None else cost_in(read, record["cost"], "cost"),
            bound=bound_in(read, record.get("bound", {})),
            complete=record["complete"],
            theory=theory,
            steps=steps,
            effort=effort_in(read, record),
            stopped=record.get("stopped"),
            partial=None
            if record.get("partial") is None
            else SSHMap.from_dict(record["partial"], f"{where}: partial"),
            within=read.integer(record.get("within", 0), "within"),
            levels=levels_in(read, record, len(maps)),
            shared=backbone_in(read, record, steps),
            trace=trace,
            support=Support(recorded=Recorded.of(read, record, steps)),
        )


def _checked_record(read: FieldReader, data: Any) -> Mapping[str, Any]:
    """The fields of a solution, if the data are one of this version. Raises MapError."""
    record, where = read.mapping(data, ""), read.where
    if "maps" not in record and "labels" in record:
        raise MapError(f"{where}: maps: expected a solution, got one map; take SSHMap.load")
    if record.get("status") == "error":
        raise MapError(
            f"{where}: status: expected a solution, got the error that solve ended with: "
            f"{brief(record.get('error'))}"
        )
    check_format(record, SOLUTION_FORMAT, where)
    for name in ("maps", "theory", "steps", "status", "complete"):
        if name not in record:
            raise MapError(
                f"{where}: {name}: expected what solve --json or Solution.save writes, got none; "
                "solve again"
            )
    return record


def _check_steps(
    where: str, maps: tuple[SSHMap, ...], steps: int, theory: Theory, trace: Trace | None
) -> None:
    """Raise MapError if maps do not have this many steps, or are not of the trace."""
    for i, ssh_map in enumerate(maps):
        if len(ssh_map.labels) != steps:
            raise MapError(
                f"{where}: maps[{i}].labels: expected {steps}, one a step, got "
                f"{len(ssh_map.labels)}; it was changed by hand"
            )
    if trace is not None:
        check_of_trace(maps, checked_trace(trace), where, views="functional_view" in theory.hard)
        if steps != len(trace):
            raise MapError(
                f"{where}: steps: expected those of a trace of {len(trace)} steps, got {steps}; "
                "it is of another trace"
            )


def _table_of_maps(solution: Solution) -> str:
    """A table with a row for each map: its cost, and its chi-square if it has poses."""
    costs = solution.costs
    chi2 = [ssh_map.fit.chi2 if ssh_map.fit else None for ssh_map in solution.maps]
    columns: dict[str, list[object]] = {"map": [*range(1, solution.count + 1)]}
    columns |= {
        name: [getattr(cost, name) for cost in costs]
        for name in ("dstates", "places", "paths", "excuses", "faults")
    }
    columns |= {"chi-square": ["" if chi is None else f"{chi:.1f}" for chi in chi2]}
    # Columns of zeros are left out.
    shown = {name: column for name, column in columns.items() if any(column)}
    return cards.table([*shown], zip(*shown.values(), strict=True), "maps")
