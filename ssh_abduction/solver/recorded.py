"""Read a solution's JSON field by field. An error names the field that is wrong."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ssh_abduction.data.errors import MapError, TheoryError
from ssh_abduction.data.fields import FieldReader
from ssh_abduction.solver.sharing import Backbone
from ssh_abduction.solver.steps.certificate import Basis, Certificate
from ssh_abduction.solver.values import Bound, Cost, Effort, Grounding, Level, Seconds
from ssh_abduction.theory.fields import COUNTS
from ssh_abduction.theory.theory import Theory


@dataclass(frozen=True, slots=True)
class Recorded:
    """The parts of a file that only the search or the trace could compute again.

    Attributes:
        certificate: Why no map has fewer dstates.
        written_certificate: The certificate as in the file, with its words.
        warnings: What makes the trace suspicious, a sentence each.
        explanation: Why there is no map.
    """

    certificate: Certificate | None
    written_certificate: Mapping[str, Any] | None
    warnings: tuple[str, ...]
    explanation: Mapping[str, Any] | None

    @classmethod
    def of(cls, read: FieldReader, record: Mapping[str, Any], steps: int) -> Recorded:
        """Read a record of a solution for a trace of `steps` steps. Raises MapError."""
        written = (
            None
            if record.get("certificate") is None
            else read.mapping(record["certificate"], "certificate")
        )
        warnings = read.list(record, "warnings", optional=True)
        for i, warning in enumerate(warnings):
            if not isinstance(warning, str):
                raise read.wrong(f"warnings[{i}]", "a sentence", warning)
        return cls(
            certificate=None if written is None else _certificate(read, written, steps),
            written_certificate=written,
            warnings=tuple(warnings),
            explanation=None
            if record.get("explanation") is None
            else read.mapping(record["explanation"], "explanation"),
        )


@dataclass(frozen=True, slots=True)
class Support:
    """What backs a solution up: its certificate, and warnings about its trace.

    Attributes:
        basis: The data for the certificate. None if the theory lacks an axiom that the
            certificate needs.
        odometry_warning: A fault of the odometry: the best map contradicts its noise, or
            displacements do not distinguish travel from standing still.
        recorded: What the file says, in a solution that was read from one.
    """

    basis: Basis | None = None
    odometry_warning: str | None = None
    recorded: Recorded | None = None

    @property
    def certificate(self) -> Certificate | None:
        """Why no map has fewer dstates. Computed when it is first asked for."""
        if self.recorded is not None:
            return self.recorded.certificate
        return self.basis.certificate if self.basis else None


def backbone_in(read: FieldReader, record: Mapping[str, Any], steps: int) -> Backbone | None:
    """What the minimal maps share; None if the file lacks it. Raises MapError."""
    if record.get("backbone") is None:
        return None
    return Backbone.from_dict(record["backbone"], steps, f"{read.where}: backbone")


def _certificate(read: FieldReader, written: Mapping[str, Any], steps: int) -> Certificate:
    clique, refuted = (
        tuple(
            _whole(read, x, f"certificate.{k}[{i}]") for i, x in enumerate(_list(read, written, k))
        )
        for k in ("clique", "refuted")
    )
    if len(set(clique)) < len(clique) or any(step >= steps for step in clique):
        raise read.wrong(
            "certificate.clique", f"different steps from 0 to {steps - 1}", list(clique)
        )
    if refuted != tuple(range(len(clique), len(clique) + len(refuted))):
        raise read.wrong(
            "certificate.refuted", f"the numbers of dstates from {len(clique)} on", list(refuted)
        )
    return Certificate(clique, refuted)


def _list(read: FieldReader, record: Mapping[str, Any], name: str) -> Sequence[Any]:
    value = record.get(name)
    if not isinstance(value, list):
        raise read.wrong(f"certificate.{name}", "a list", value)
    return value


def _whole(read: FieldReader, value: Any, name: str) -> int:
    number = read.integer(value, name)
    if number < 0:
        raise read.wrong(name, "a whole number, 0 or more", value)
    return number


def theory_in(value: Any, where: str) -> Theory:
    """The theory of a solution. Raises MapError."""
    try:
        return Theory.from_dict(value)
    except TheoryError as error:
        raise MapError(f"{where}: theory: {error}") from None


def cost_in(read: FieldReader, value: Any, name: str) -> Cost:
    """What a map costs. Raises MapError."""
    record = read.mapping(value, name)
    if unknown := set(record) - {*COUNTS, "faults"}:
        raise read.wrong(name, f"numbers of {', '.join(COUNTS)} and faults", sorted(unknown))
    counts = {k: _whole(read, record.get(k, 0), f"{name}.{k}") for k in COUNTS}
    return Cost(**counts, faults=_positive(read, record.get("faults", 0.0), f"{name}.faults"))


def bound_in(read: FieldReader, value: Any) -> Bound:
    """The proven lower bounds. Raises MapError."""
    record = read.mapping(value, "bound")
    counts = {str(k): _whole(read, v, f"bound.{k}") for k, v in record.items() if k in COUNTS}
    if unknown := set(record) - {*counts, "cost"}:
        raise read.wrong("bound", f"numbers of {', '.join(COUNTS)}, or a cost", sorted(unknown))
    if "cost" in record:
        counts["tenths"] = round(10 * _positive(read, record["cost"], "bound.cost"))
    return Bound(**counts)


def effort_in(read: FieldReader, record: Mapping[str, Any]) -> Effort:
    """What the search did. Raises MapError."""
    prefix = read.integer(record.get("prefix", 0), "prefix")
    times = read.mapping(record.get("seconds", {}), "seconds")
    seconds = Seconds(
        *(_positive(read, times.get(k, 0.0), f"seconds.{k}") for k in ("total", "ground", "solve"))
    )
    sizes = read.mapping(record.get("grounding", {}), "grounding")
    grounding = Grounding(
        *(_whole(read, sizes.get(k, 0), f"grounding.{k}") for k in ("rules", "atoms"))
    )
    evidence = {
        kind: {
            k: _whole(read, v, f"evidence.{kind}.{k}")
            for k, v in read.mapping(said, f"evidence.{kind}").items()
        }
        for kind, said in read.mapping(record.get("evidence", {}), "evidence").items()
    }
    return Effort(prefix, seconds, grounding, evidence)


def levels_in(read: FieldReader, record: Mapping[str, Any], maps: int) -> tuple[Level, ...]:
    """The levels of the maps: one level of all maps if the file names none. Raises MapError."""
    complete = record.get("minimal_listed", record.get("complete")) is True
    if "levels" not in record:
        if not maps or record.get("cost") is None:
            return ()
        return (Level(cost_in(read, record["cost"], "cost"), maps, complete),)
    levels = [
        read.mapping(level, f"levels[{i}]") for i, level in enumerate(read.list(record, "levels"))
    ]
    found = tuple(
        Level(
            cost_in(read, level.get("cost"), f"levels[{i}].cost"),
            _whole(read, level.get("count"), f"levels[{i}].count"),
            complete,
        )
        for i, level in enumerate(levels)
    )
    counts = [level.count for level in found]
    if sum(counts) != maps:
        raise read.wrong("levels", f"{maps} maps in all, as so many are listed", counts)
    return found


def _positive(read: FieldReader, value: Any, name: str) -> float:
    number = read.number(value, name)
    if number < 0:
        raise read.wrong(name, "a number, 0 or more", value)
    return number
