"""What a file says of a solution, read field by field: what is not as it was written is an error that names the field."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ssh_abduction.data.errors import MapError, TheoryError
from ssh_abduction.data.fields import FieldReader
from ssh_abduction.solver.asp.control import Grounding
from ssh_abduction.solver.engines.base import Cost
from ssh_abduction.solver.sharing import Backbone
from ssh_abduction.solver.steps.certificate import Certificate
from ssh_abduction.theory.theory import COUNTS, Theory


@dataclass(frozen=True, slots=True)
class Recorded:
    """What a file says of a solution that only its search, or its trace, could tell anew.

    certificate          why no map has fewer dstates
    written_certificate  the same as the file has it, with the words that show it
    backbone             what the minimal maps share; None where the file has not all of it
    listed               whether all minimal maps are listed
    warnings             what makes the trace suspicious, a sentence each
    explanation          why there is no map
    """

    certificate: Certificate | None
    written_certificate: Mapping[str, Any] | None
    backbone: Backbone | None
    listed: bool
    warnings: tuple[str, ...]
    explanation: Mapping[str, Any] | None

    @classmethod
    def of(cls, read: FieldReader, record: Mapping[str, Any], steps: int) -> Recorded:
        """What a record, of a solution for so many steps, says. Raises MapError."""
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
            backbone=None
            if record.get("backbone") is None
            else Backbone.from_dict(record["backbone"], steps, f"{read.where}: backbone"),
            listed=record.get("minimal_listed", record.get("complete")) is True,
            warnings=tuple(warnings),
            explanation=None
            if record.get("explanation") is None
            else read.mapping(record["explanation"], "explanation"),
        )


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
    """The theory that a solution is of. Raises MapError."""
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


def bound_in(read: FieldReader, value: Any) -> dict[str, int]:
    """The counts that are bounded, with their bounds. Raises MapError."""
    record = read.mapping(value, "bound")
    counts = {str(k): _whole(read, v, f"bound.{k}") for k, v in record.items() if k in COUNTS}
    if unknown := set(record) - {*counts, "cost"}:
        raise read.wrong("bound", f"numbers of {', '.join(COUNTS)}, or a cost", sorted(unknown))
    return counts | (
        {"tenths": round(10 * _positive(read, record["cost"], "bound.cost"))}
        if "cost" in record
        else {}
    )


def seconds_in(read: FieldReader, value: Any) -> tuple[float, float, float]:
    """The seconds in all, for grounding and for solving. Raises MapError."""
    record = read.mapping(value, "seconds")
    total, ground, solve = (
        _positive(read, record.get(k, 0.0), f"seconds.{k}") for k in ("total", "ground", "solve")
    )
    return total, ground, solve


def grounding_in(read: FieldReader, value: Any) -> Grounding:
    """How large the ground program was. Raises MapError."""
    record = read.mapping(value, "grounding")
    return Grounding(
        *(_whole(read, record.get(k, 0), f"grounding.{k}") for k in ("rules", "atoms"))
    )


def evidence_in(read: FieldReader, value: Any) -> dict[str, dict[str, int]]:
    """For each kind of evidence what it excluded. Raises MapError."""
    return {
        kind: {
            k: _whole(read, v, f"evidence.{kind}.{k}")
            for k, v in read.mapping(said, f"evidence.{kind}").items()
        }
        for kind, said in read.mapping(value, "evidence").items()
    }


def levels_in(read: FieldReader, record: Mapping[str, Any], maps: int) -> list[tuple[Cost, int]]:
    """What maps of each level cost, and how many there are: one level of all maps, where the file names none. Raises MapError."""
    if "levels" not in record:
        return (
            [(cost_in(read, record["cost"], "cost"), maps)]
            if maps and record.get("cost") is not None
            else []
        )
    levels = [
        read.mapping(level, f"levels[{i}]") for i, level in enumerate(read.list(record, "levels"))
    ]
    found = [
        (
            cost_in(read, level.get("cost"), f"levels[{i}].cost"),
            _whole(read, level.get("count"), f"levels[{i}].count"),
        )
        for i, level in enumerate(levels)
    ]
    if sum(count for _, count in found) != maps:
        raise read.wrong(
            "levels", f"{maps} maps in all, as so many are listed", [count for _, count in found]
        )
    return found


def _positive(read: FieldReader, value: Any, name: str) -> float:
    number = read.number(value, name)
    if number < 0:
        raise read.wrong(name, "a number, 0 or more", value)
    return number
