"""Read the JSON of a solution field by field. An error names the field that is wrong.

Each function takes a `FieldReader`, which checks fields and knows the name of the file.
"""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from ssh_abduction.data.drives import Drive, named_steps
from ssh_abduction.data.errors import MapError, TheoryError
from ssh_abduction.data.schema import FieldReader
from ssh_abduction.data.trace import Trace, read_trace
from ssh_abduction.solution.certificate import Basis, Certificate
from ssh_abduction.solution.values import Bound, Cost, Effort, Grounding, Level, Seconds
from ssh_abduction.solution.weighed import Weighed
from ssh_abduction.theory.fields import COUNTS
from ssh_abduction.theory.joins import Join
from ssh_abduction.theory.theory import Theory


@dataclass(frozen=True, slots=True)
class Support:
    """The data behind a solution's certificate and its warnings.

    Attributes:
        basis: The data for the certificate. None if the theory lacks an axiom that the
            certificate needs, or if the solution was read from a file.
        warnings: Sentences that warn of wrong odometry, that say why maps were compared by counts
            instead of costs, and that a corrected gateway keeps drives apart or a name is not used.
        weighed: The costs in nats and the rival maps, if maps were compared by cost; else None.
        onto: The names of the old drives whose map had to be kept; empty if there are none.
        proof: The certificate of the file, if the solution was read from one that has it.
        joins: The joins (pairs of steps at one place or dstate) of the first map that rest on
            minimality alone, as in the file; None if the solution was not read from one.
        drives: The drives of the trace, as in the file.
        explanation: Why there is no map, as in the file; None if it does not say so.
    """

    basis: Basis | None = None
    warnings: tuple[str, ...] = ()
    weighed: Weighed | None = None
    onto: tuple[str, ...] = ()
    proof: Certificate | None = None
    joins: tuple[Join, ...] | None = None
    drives: tuple[Drive, ...] = ()
    explanation: Mapping[str, Any] | None = field(default=None, hash=False)

    @classmethod
    def of_file(cls, read: FieldReader, record: Mapping[str, Any], steps: int) -> Support:
        """Read these data from the record of a solution. Raises MapError if a field is wrong."""
        drives, weighed = drives_in(read, record, steps), record.get("weighed")
        proof, why = (
            None if record.get(name) is None else read.mapping(record[name], name)
            for name in ("certificate", "explanation")
        )
        return cls(
            warnings=read.each(record, "warnings", read.text_called("a sentence"), True),
            weighed=Weighed.from_dict(read, weighed, steps, drives) if weighed else None,
            onto=read.each(record, "onto", read.text, True),
            proof=None if proof is None else _certificate(read, proof, steps),
            joins=_joins(read, record, steps, drives),
            drives=drives,
            explanation=why,
        )

    @property
    def certificate(self) -> Certificate | None:
        """The proof that no map has fewer dstates, computed at first use; None if there is none."""
        return self.basis.certificate if self.basis else self.proof

    def warning_of(self, *warnings: str | None) -> Support:
        """Return the same data with more warnings. A warning that is None is left out."""
        return replace(self, warnings=(*self.warnings, *filter(None, warnings)))


def trace_in(record: Mapping[str, Any], where: str) -> Trace | None:
    """Read the trace that was solved; None if the file has none. Raises TraceError."""
    if not isinstance(record.get("trace"), list):
        return None
    lines = "".join(f"{json.dumps(line)}\n" for line in record["trace"])
    return Trace(**read_trace(io.BytesIO(lines.encode()), f"{where}: trace"))


def drives_in(read: FieldReader, record: Mapping[str, Any], steps: int) -> tuple[Drive, ...]:
    """Read the drives, which divide the steps of the trace. Raises MapError."""

    def drive(value: Any, name: str) -> Drive:
        shapes = {"name": read.text, "fingerprint": read.maybe(read.text)}
        bounds = {"first": read.integer, "stop": read.integer}
        return read.record(Drive, value, name, **shapes, **bounds)

    found = read.each(record, "drives", drive, optional=True)
    bounds = [0, *(drive.stop for drive in found)]
    if found and ([d.first for d in found] != bounds[:-1] or bounds != sorted({*bounds, steps})):
        raise read.wrong("drives", f"drives that follow each other up to step {steps}", bounds)
    return found


def _joins(
    read: FieldReader, record: Mapping[str, Any], steps: int, drives: tuple[Drive, ...]
) -> tuple[Join, ...]:
    """Read the joins of the first map that rest on minimality alone. Raises MapError."""
    names = named_steps(drives, steps)

    def join(value: Any, name: str) -> Join:
        written = read.mapping(value, name)
        two_steps = read.several(read.integer, "two steps", 2)
        first, second = two_steps(written.get("steps"), f"{name}.steps")
        if not 0 <= first < second < steps:
            expected = f"two steps from 0 to {steps - 1}"
            raise read.wrong(f"{name}.steps", expected, written["steps"])
        of = read.one_of(("place", "dstate"))(written.get("of"), f"{name}.of")
        return Join(names[first], names[second], of == "place")

    return read.each(record, "by_minimality", join, optional=True)


def _certificate(read: FieldReader, written: Mapping[str, Any], steps: int) -> Certificate:
    """Read a certificate. Raises MapError."""
    steps_shown = {"clique": read.integers, "refuted": read.integers}
    found = read.record(Certificate, written, "certificate", **steps_shown)
    clique, first = found.clique, len(found.clique)
    if len(set(clique)) < len(clique) or not all(0 <= step < steps for step in clique):
        expected = f"different steps from 0 to {steps - 1}"
        raise read.wrong("certificate.clique", expected, list(clique))
    if found.refuted != tuple(range(first, first + len(found.refuted))):
        expected = f"the numbers of dstates from {first} on"
        raise read.wrong("certificate.refuted", expected, list(found.refuted))
    return found


def theory_in(value: Any, where: str) -> Theory:
    """Read the theory of a solution. Raises MapError if it is not one."""
    try:
        return Theory.from_dict(value)
    except TheoryError as error:
        raise MapError(f"{where}: theory: {error}") from None


def cost_in(read: FieldReader, value: Any, name: str) -> Cost:
    """Read the cost of a map from the field `name`. Raises MapError."""
    counts, faults = _counts(read, value, name, "faults")
    return Cost(**(dict.fromkeys(COUNTS, 0) | counts), faults=faults or 0.0)


def bound_in(read: FieldReader, value: Any) -> Bound:
    """Read the proven lower bounds. Raises MapError."""
    counts, cost = _counts(read, value, "bound", "cost")
    return Bound(**counts, tenths=None if cost is None else round(10 * cost))


def _counts(
    read: FieldReader, value: Any, name: str, other: str
) -> tuple[dict[str, int], float | None]:
    """Read some counts of a map by name, and one other number. Raises MapError."""
    record = read.mapping(value, name)
    if unknown := set(record) - {*COUNTS, other}:
        expected = f"numbers of {', '.join(COUNTS)} and {other}"
        raise read.wrong(name, expected, sorted(map(str, unknown)))
    counts: dict[str, int] = {
        k: read.whole(record[k], f"{name}.{k}") for k in COUNTS if k in record
    }
    return counts, read.maybe(read.not_negative)(record.get(other), f"{name}.{other}")


def effort_in(read: FieldReader, record: Mapping[str, Any]) -> Effort:
    """Read what the search did: prefix, times, grounding and evidence. Raises MapError."""
    times = dict.fromkeys(("total", "ground", "solve"), read.maybe(read.not_negative, 0.0))
    sizes = dict.fromkeys(("rules", "atoms"), read.maybe(read.whole, 0))
    counts = read.values(read.values(read.whole))
    return Effort(
        prefix=read.integer(record.get("prefix", 0), "prefix"),
        seconds=read.record(Seconds, record.get("seconds", {}), "seconds", **times),
        grounding=read.record(Grounding, record.get("grounding", {}), "grounding", **sizes),
        evidence=counts(record.get("evidence", {}), "evidence"),
        work=read.maybe(read.not_negative, None)(record.get("work"), "work"),
    )


def levels_in(read: FieldReader, record: Mapping[str, Any], maps: int) -> tuple[Level, ...]:
    """Read the levels: how many of the maps have which cost.

    If the file has no levels, all maps are one level. Raises MapError if a field is wrong, or the
    levels do not add up to this number of maps.
    """
    complete = record.get("minimal_listed", record.get("complete")) is True
    if "levels" not in record:
        if not maps or record.get("cost") is None:
            return ()
        return (Level(cost_in(read, record["cost"], "cost"), maps, complete),)

    def level(value: Any, name: str) -> Level:
        found = read.record(Level, value, name, cost=partial(cost_in, read), count=read.whole)
        return replace(found, complete=complete)

    found = read.each(record, "levels", level)
    counts = [level.count for level in found]
    if sum(counts) != maps:
        raise read.wrong("levels", f"{maps} maps in all, the number of listed maps", counts)
    return found
