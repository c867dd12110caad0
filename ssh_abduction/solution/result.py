"""The answer for one trace: a frozen value that needs no solver.

Importing this module does not load clingo.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from ssh_abduction.checker.claims import false_claims
from ssh_abduction.data.checks import a_whole_number, one_of
from ssh_abduction.data.drives import (
    Drive,
    MapSequence,
    drives_of,
    with_fingerprints,
    with_named_faults,
)
from ssh_abduction.data.errors import MapError, SolverError, brief, named
from ssh_abduction.data.files import json_line
from ssh_abduction.data.map_parts import (
    SOLUTION_FORMAT,
    VERSION,
    check_format,
    read_json,
    write_map,
)
from ssh_abduction.data.maps import SSHMap, check_of_trace, maps_of
from ssh_abduction.data.schema import FieldReader, plain
from ssh_abduction.data.trace import Trace, checked_trace
from ssh_abduction.data.words import counted
from ssh_abduction.output import cards
from ssh_abduction.runtime.limits import Stop
from ssh_abduction.solution.certificate import Certificate
from ssh_abduction.solution.recorded import (
    Support,
    bound_in,
    cost_in,
    effort_in,
    levels_in,
    theory_in,
    trace_in,
)
from ssh_abduction.solution.sharing import Backbone, Sharing
from ssh_abduction.solution.values import (
    Bound,
    Cost,
    Effort,
    Level,
    Seconds,
    Status,
    cost_as_counted,
)
from ssh_abduction.solution.weighed import Weighed
from ssh_abduction.theory.joins import Join, joins_by_minimality, joins_in_words
from ssh_abduction.theory.theory import Theory


@dataclass(frozen=True, slots=True)
class Solution(MapSequence):
    """The answer for one trace.

    A solution is a sequence of its maps: `len(solution)`, `solution[0]`, and
    `for ssh_map in solution`. Two solutions are equal if they say the same about the trace,
    whatever time they took.

    Attributes:
        status: What is proven: maps are minimal (OPTIMAL), a map exists (FEASIBLE), none exists
            (UNSATISFIABLE), or nothing (UNKNOWN).
        maps: The minimal maps (status optimal), or the best map found (feasible). With `within`,
            maps with more dstates follow.
        cost: The counts of the first map; None if there is no map. All minimal maps share the
            counts that the theory minimises.
        bound: Proven lower bounds on the counts of any map.
        complete: Whether all maps are listed: all minimal maps and, with `within`, all others that
            it asks for.
        theory: The theory. Each "auto" in it is replaced by the value that was used.
        steps: The number of steps of the trace.
        effort: Figures about the search: its time, the size of the grounding, how many first steps
            clingo was given, and what evidence was used.
        stopped: Why the search ended before it was complete; None if it did not.
        partial: A map of the first steps, if no map of the whole trace was found; else None.
        within: The number of dstates above the minimum that a listed map may have.
        levels: The cost and the number of the minimal maps. With `within`, the same for each
            greater number of dstates.
        shared: What all minimal maps share (the backbone). It may rest on maps that are not in
            `maps`. None: it is computed from `maps`.
        trace: The trace; None in a solution that was read from a file without its trace.
        support: The data behind the certificate and the warnings.
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

    def __repr__(self) -> str:
        short = self.headline.split("; ")[:2]  # without levels
        return f"<Solution {'; '.join(short)}>"

    def _repr_html_(self) -> str:
        """Return the HTML for notebooks: how the search ended, the summary, and the first map."""
        sentences = [] if self.status is Status.UNSATISFIABLE else [self.summary]
        sentences += [self.joined] if self.joined else []
        if self.stopped != "interrupted":
            sentences += [f"warning: {warning}" for warning in self.warnings]
        parts = [cards.paragraph(sentence) for sentence in sentences]
        if self.count > 1:
            parts.append(cards.paragraph(f"{self.count} maps; the first is shown below"))
        if self.maps:
            parts.append(cards.map_card(self.maps[0]))
        elif self.partial is not None:
            steps = counted(len(self.partial.dstate_at), "steps")
            parts += [cards.paragraph(f"the best map of the first {steps}:")]
            parts += [cards.map_card(self.partial)]
        given = f"{self.effort.prefix} of {counted(self.steps, 'steps')} given to clingo"
        took = cards.paragraph(f"{self.seconds.total:.2f} s, {given}")
        return cards.card(self.headline, *parts, took)

    @property
    def drives(self) -> tuple[Drive, ...]:
        """The drives of the trace; empty if they are unknown."""
        return self.support.drives if self.trace is None else drives_of(self.trace)

    @property
    def headline(self) -> str:
        """A line with the status, the cost, and the number of minimal maps or the bound."""
        why = f" ({self.stopped})" if self.stopped else ""
        steps, weighed = counted(self.steps, "steps"), self.weighed
        if self.status is Status.UNSATISFIABLE:
            return f"unsatisfiable: no map of {steps} satisfies the axioms"
        bounds = [
            f"a cost of at least {v:g} dstates" if k == "cost" else f"at least {counted(v, k)}"
            for k, v in self.bound.to_dict().items()
        ]
        proven = f"any map has {', '.join(bounds)}" if bounds else "no bound is proven"
        if self.cost is None:
            return f"{self.status.value}{why}: no map of all {steps} yet; {proven}"
        counts = self._counts_of(self.cost)
        least = counted(self.levels[0].count if self.levels else self.count, "minimal maps")
        claim = "not proven minimal"
        if weighed is not None:
            counts += f", {weighed.nats:.1f} nats"
            least = least.replace("minimal ", "") + " of least cost"
            claim = "not proven to cost least"
            proven = f"any map has {weighed.bound:.1f} nats or more"
        if self.status is Status.FEASIBLE:
            return f"feasible{why}: {counts}, {claim}; {proven}"
        further = [f"{x.count} with {self._counts_of(x.cost)}" for x in self.levels[1:]]
        perhaps = "" if self.complete else f", and there may be more{why}"
        return f"optimal: {'; '.join([counts, least, *further])}{perhaps}"

    def _counts_of(self, cost: Cost) -> str:
        """Put the counts of a cost into words, of what maps by the theory have."""
        has = {"places": self.theory.level != "causal", "paths": self.theory.has_paths}
        return ", ".join(
            f"faults that cost {v:g} dstates" if k == "faults" else counted(v, k)
            for k, v in cost.to_dict().items()
            if has.get(k, True)
        )

    @property
    def weighed(self) -> Weighed | None:
        """The costs in nats and the rival maps, if maps were compared by cost; else None."""
        return self.support.weighed

    @property
    def confidence(self) -> float | None:
        """The probability that the best map has the true dstates and places.

        None if maps were counted, as then nothing observed says how probable they are. See also
        `weighed.place_confidence`, which is for the places alone.
        """
        return None if self.weighed is None else self.weighed.confidence

    @property
    def by_minimality(self) -> tuple[Join, ...]:
        """The joins of the first map that rest on minimality alone.

        A join is two steps at one place or one dstate (`ssh_abduction.theory.joins`). Joins that
        follow from those listed are left out. Empty if maps are compared by cost, as then
        `probability` says how sure a join is, unless the search was stopped before.
        """
        if self.support.joins is not None:
            return self.support.joins
        if self.theory.weigh == "cost" or self.trace is None or not self.maps:
            return ()
        return joins_by_minimality(self.trace, self.maps[0], self.theory)

    @property
    def verdict(self) -> str:
        """What was found and how sure it is, in a few words: the first line of each answer."""
        if self.cost is None:
            is_none = self.status is Status.UNSATISFIABLE
            return "No map satisfies the axioms." if is_none else "No map was found."
        minimal = self.levels[0].count if self.levels else self.count
        return verdict_of(
            self.cost.places or self.cost.dstates,
            self.cost.places > 0,
            self.weighed,
            minimal if self.status is Status.OPTIMAL else 0,
            listed=self.minimal_listed,
            unforced=len(self.by_minimality),
        )

    @property
    def sureness(self) -> str:
        """How sure the first map is, in words; an empty text if there is nothing to say.

        If maps were weighed, the text gives its probability and its least sure join. If they
        were counted, it gives the joins that rest on minimality alone.
        """
        if self.weighed is not None:
            return self.weighed.sentence
        minimal = self.status is Status.OPTIMAL
        return joins_in_words(self.by_minimality, self.count, minimal=minimal)

    def probability(self, first: int, second: int, of: str = "dstate") -> float:
        """Return the probability that two steps are at one dstate, or at one place.

        Args:
            first: The number of a step, from 0.
            second: The number of another step.
            of: What the steps may share: "dstate" or "place".

        Returns:
            A number from 0 to 1. It sums the weights of the rival maps that say so.

        Raises:
            SolverError: A step does not exist, maps were counted and not weighed, or their costs
                cannot be trusted.
        """
        if self.weighed is None:
            raise SolverError(
                "probability: expected a trace with displacements, whose maps are compared by "
                "cost, got one whose maps are counted; nothing observed says how probable they are"
            )
        if self.weighed.doubt is not None:
            raise SolverError(
                f"probability: expected costs that can be trusted, got doubts, as "
                f"{self.weighed.doubt}; mend the trace or its noise model"
            )
        one_of("of", of, ("dstate", "place"), SolverError)
        mend = f"the trace has steps 0 to {self.steps - 1}"
        first, second = (
            a_whole_number(name, step, SolverError, 0, self.steps - 1, mend=mend)
            for name, step in (("first", first), ("second", second))
        )
        return self.weighed.probability(first, second, of)

    @property
    def costs(self) -> tuple[Cost, ...]:
        """The cost of each map in `maps`."""
        levels = self.levels or ((Level(self.cost, self.count),) if self.cost else ())
        cost_of = (level.cost for level in levels for _ in range(level.count))
        return tuple(
            cost_as_counted(m, cost.preferred_by(self.theory), self.theory)
            for m, cost in zip(self.maps, cost_of, strict=False)
        )

    @property
    def minimal_maps(self) -> tuple[SSHMap, ...]:
        """The maps that are proven to be minimal; empty unless the status is optimal."""
        if self.status is not Status.OPTIMAL:
            return ()
        return self.maps[: self.levels[0].count] if self.levels else self.maps

    @property
    def minimal_listed(self) -> bool:
        """Whether the search gave all minimal maps. Maps that `within` adds do not count."""
        return self.complete or (bool(self.levels) and self.levels[0].complete)

    @property
    def backbone(self) -> Backbone | None:
        """The backbone: what the known minimal maps share; None if no minimal map is known.

        If not all minimal maps were listed, the backbone need not hold for all of them. Then it is
        not `proven`, and `find_backbone` can prove it.
        """
        shared = self.shared
        if shared is None:
            sharing = Sharing(self.minimal_maps)
            if not sharing.maps:
                return None
            shared = sharing.backbone(proven=self.minimal_listed)
        return shared if shared.drives == self.drives else replace(shared, drives=self.drives)

    @property
    def summary(self) -> str:
        """A sentence that says how many minimal maps there are, and in which steps they differ."""
        return summary_of(self, self.count, self.backbone)

    @property
    def certificate(self) -> Certificate | None:
        """The proof that no map has fewer dstates; None if the theory lacks an axiom for it.

        It is computed at the first use. A solution from a file has the certificate of the file.
        """
        return self.support.certificate

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences about what is suspicious in the trace, or in corrections of a person.

        They are about the noise or the units of the odometry, about drives that a corrected gateway
        keeps apart, and about names that are not used.
        """
        return self.support.warnings

    @property
    def count(self) -> int:
        """The number of maps in this solution."""
        return len(self.maps)

    @property
    def seconds(self) -> Seconds:
        """The wall-clock time of the search: `total`, `ground` and `solve`, in seconds."""
        return self.effort.seconds

    def to_dict(self) -> dict[str, Any]:
        """Return the answer as plain data, as `solve --json` prints it (docs/reference/formats.md).

        Two fields of `solve --json` are missing, as each needs another search: why there is no map,
        and the runner-up.

        Raises:
            MapError: The maps are not those that the search gave.
        """
        given = sum(level.count for level in self.levels)
        if (self.cost is not None or given) and (not self.maps or given not in (0, len(self.maps))):
            raise MapError(
                f"maps: expected all {max(given, 1)} that the search found, got {len(self.maps)}; "
                "give all of them to Search.solution"
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
        """Write the answer as `solve --json` does, with a line for each map, and the trace.

        Raises:
            MapError: The file cannot be written, or the maps are not those that the search gave.
        """
        data = self.to_dict()
        maps = data.pop("maps")
        head = opening(self.theory, self.steps, self.within)
        end = {name: value for name, value in data.items() if name not in head}
        end |= {} if self.trace is None else written_trace(self.trace)
        lines = ",\n".join(json_line(m) for m in maps)
        write_map(
            path, f'{json_line(head)[:-1]}, "maps": [\n{lines}\n],{json_line(end)[1:]}', "solution"
        )

    @classmethod
    def load(cls, path: str | os.PathLike[str], trace: Trace | None = None) -> Solution:
        """Read an answer that `save` or `solve --json` wrote.

        Args:
            path: The file; "-" for standard input.
            trace: The trace that was solved; None for the one in the file, if it has one. The maps
                are checked against it, and the solution keeps it.

        Raises:
            MapError: The file has another version, or contradicts itself or the trace.
        """
        return cls.from_dict(read_json(path), named(path), trace)

    @classmethod
    def from_dict(cls, data: Any, where: str = "solution", trace: Trace | None = None) -> Solution:
        """Make a solution from the plain data that `to_dict` returns.

        Args:
            data: What `to_dict` returned, perhaps read from JSON.
            where: The name of the data in error messages.
            trace: The trace that was solved. If it is given, the maps are checked against it, and
                the solution keeps it.

        Raises:
            MapError: The data have another version, or contradict themselves or the trace.
        """
        read = FieldReader(where)
        record = _checked_record(read, data)
        maps = tuple(maps_of(record, where))
        steps = read.integer(record["steps"], "steps")
        trace = trace_in(record, where) if trace is None else trace
        theory = theory_in(record["theory"], where)
        for false in false_claims(record, maps, steps, theory, None):
            raise MapError(f"{where}: {false}; it was changed by hand, or cut")
        _check_steps(where, maps, steps, theory, trace)
        support = Support.of_file(read, record, steps)
        maps = tuple(with_named_faults(ssh_map, support.drives) for ssh_map in maps)
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
            shared=None
            if record.get("backbone") is None
            else Backbone.from_dict(record["backbone"], steps, f"{where}: backbone"),
            trace=trace,
            support=support,
        )


def _checked_record(read: FieldReader, data: Any) -> Mapping[str, Any]:
    """Check that data are a solution of a known version, or raise MapError; return its fields."""
    record, where = read.mapping(data, ""), read.where
    if "maps" not in record and "labels" in record:
        raise MapError(f"{where}: maps: expected a solution, got one map; take SSHMap.load")
    if record.get("status") == "error":
        raise MapError(
            f"{where}: status: expected a solution, got the error that solve ended with: "
            f"{brief(record.get('error'))}"
            "; mend that, and solve again"
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
    """Raise MapError if a map does not have this many steps, or is not of the trace (if given)."""
    for i, ssh_map in enumerate(maps):
        if len(ssh_map.dstate_at) != steps:
            raise MapError(
                f"{where}: maps[{i}].labels: expected {steps}, one per step, got "
                f"{len(ssh_map.dstate_at)}; it was changed by hand"
            )
    if trace is not None:
        check_of_trace(maps, checked_trace(trace), where, views="functional_view" in theory.hard)
        if steps != len(trace):
            raise MapError(
                f"{where}: steps: expected maps of a trace of {len(trace)} steps, got {steps}; "
                "give the trace from which these maps were made"
            )


def verdict_of(
    size: int,
    has_places: bool,
    weighed: Weighed | None,
    minimal: int | None,
    *,
    listed: bool | None,
    unforced: int,
) -> str:
    """Say in a few words what was found, and how sure it is.

    Args:
        size: The number of places of the best map, or of its dstates if it has no places.
        has_places: Whether it has places.
        weighed: The costs of maps, if they were compared by cost.
        minimal: The number of minimal maps found; 0 if none is proven minimal; None if unknown.
        listed: Whether these are all minimal maps.
        unforced: The number of joins that rest on minimality alone.
    """
    found = counted(size, "places" if has_places else "dstates")
    if weighed is not None:
        return f"{found}. {weighed.verdict}"
    found += f", {counted(unforced, 'joins')} by minimality alone" * (unforced > 0)
    if not minimal:
        return f"{found}." if minimal is None else f"{found}. Not proven minimal."
    which = f"one of {minimal}{'' if listed else ' or more'} such maps"
    which = "the only such map" if listed and minimal == 1 else which
    return f"{found}. Proven minimal, {which}."


def summary_of(solution: Solution, count: int, backbone: Backbone | None) -> str:
    """Say in one sentence how many minimal maps there are, and in which steps they differ.

    `count` maps were found. They need not be in the solution.
    """
    if solution.status is Status.UNSATISFIABLE:
        return "no map satisfies the axioms"
    if backbone is None:
        return "a map that is not proven minimal" if solution.cost else "no map was found"
    minimal = solution.levels[0].count if solution.levels else count
    listed = solution.minimal_listed
    kind = "minimal map" if solution.weighed is None else "map"
    text = f"{'' if listed else 'at least '}{minimal} {kind}{'' if minimal == 1 else 's'}"
    text += "" if solution.weighed is None else " of least cost"
    if not listed:
        text += (
            f" (listing was stopped by the {solution.stopped})"
            if solution.stopped != "interrupted"
            else " (listing was interrupted)"
        )
    # A single map differs from no other one.
    if not (listed and minimal == 1):
        text += f": {replace(backbone, drives=solution.drives).sentence}" + (
            "" if backbone.proven else ", as far as is known: other maps may differ in more"
        )
    more = sum(level.count for level in solution.levels[1:])
    unit = "nats " if solution.weighed else ""
    text += f"; and {more} with up to {solution.within} {unit}more" if more else ""
    return text + (f"; {solution.weighed.sentence}" if solution.weighed else "")


def opening(theory: Theory, steps: int, within: int) -> dict[str, Any]:
    """Return the fields of a solution's JSON that come before the maps."""
    head = {
        "format": SOLUTION_FORMAT,
        "version": VERSION,
        "theory": theory.to_dict(),
        "steps": steps,
    }
    return {**head, **({"within": within} if within else {})}


def written_map(ssh_map: SSHMap, cost: Cost | None = None) -> dict[str, Any]:
    """Return a map as plain data, as it is in a solution's JSON, perhaps with a cost."""
    return ssh_map.to_dict() | ({"cost": cost.to_dict()} if cost else {})


def written_trace(trace: Trace) -> dict[str, Any]:
    """Return the lines of a trace file without images, for the file of a solution."""
    steps = tuple(replace(step, image=None, truth=None) for step in trace.steps)
    bare = replace(trace, steps=steps, images=None, drive=drives_of(trace)[0].name)
    return {"trace": [json.loads(line) for line in bare.to_lines()]}


def ending(solution: Solution, count: int, backbone: Backbone | None) -> dict[str, Any]:
    """Return the fields of a solution's JSON that come after the maps.

    `count` maps were written. The solution need not hold them.
    """
    support, effort, trace = solution.support, solution.effort, solution.trace
    drives = support.drives
    if support.joins is None:  # not from a file
        drives = () if trace is None else with_fingerprints(trace)
    listed = solution.minimal_listed
    end: dict[str, Any] = {
        "status": solution.status.value,
        "complete": solution.complete,
        "count": count,
        "cost": solution.cost,
        "bound": solution.bound,
        "prefix": effort.prefix,
        "grounding": asdict(effort.grounding),
        "seconds": {k: round(seconds, 6) for k, seconds in asdict(effort.seconds).items()},
        **({} if effort.work is None else {"work": round(effort.work, 6)}),
        "summary": summary_of(solution, count, backbone),
    }
    # These fields are left out if they would say nothing.
    more: dict[str, Any] = {
        "onto": support.onto,
        "drives": drives,
        "backbone": None if listed and count == 1 else backbone,
        "levels": solution.within and [*solution.levels],
        "minimal_listed": bool(solution.within) and listed and not solution.complete,
        "certificate": solution.certificate,
        "weighed": solution.weighed,
        "by_minimality": solution.by_minimality,
        "stopped": solution.stopped,
        "partial": solution.partial,
        "evidence": effort.evidence,
        "warnings": solution.warnings,
        "explanation": support.explanation,
    }
    # The levels of an answer without maps are an empty list.
    said = {name: value for name, value in more.items() if value or value == []}
    plain_data: dict[str, Any] = plain(end | said)
    return plain_data
