"""Kinds of evidence: what is known besides views and actions.

Each kind of evidence is a module of this folder, with an encoding of the same name.

>>> from ssh_abduction import Theory, Trace
>>> from ssh_abduction.theory.evidence import pairs_of
>>> trace = Trace.from_steps("aaa", ["travel", "travel"])
>>> pairs_of(trace, Theory(different=[(0, 2)])).apart
{2: frozenset({0})}

`KINDS` lists the kinds. A kind gives pairs of steps that are known to be equal or different
(`pairs`). These pairs prune the domains of all engines, which ask clingo for maps. So evidence
makes solving faster. Some knowledge is about whole maps only. Then a kind checks each map that
clingo finds (`refuse`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

from ssh_abduction.data.trace import Trace
from ssh_abduction.theory.evidence.displacement import Displacement
from ssh_abduction.theory.evidence.of_steps import Alike, Asserted, Closures, Floors, Landings
from ssh_abduction.theory.evidence.planar import Planar
from ssh_abduction.theory.evidence.protocol import Equality, Evidence
from ssh_abduction.theory.pairs import Pairs

if TYPE_CHECKING:
    from ssh_abduction.theory.theory import Theory

KINDS: tuple[type[Evidence], ...] = (
    Asserted,
    Alike,
    Displacement,
    Closures,
    Floors,
    Landings,
    Planar,
)

__all__ = ["Displacement", "Equality", "Evidence", "Planar", "evidence_of", "pairs_of", "said_by"]


def evidence_of(theory: Theory, known: Iterable[Evidence] = ()) -> tuple[Evidence, ...]:
    """Make an object for each kind of evidence that a theory uses.

    In the theory no field is "auto". The results of evidence that is `known` are reused.
    """
    made = [kind.of(theory) for kind in KINDS if kind.axiom in theory.axioms]
    before = {type(evidence): evidence for evidence in known}
    return tuple(e.remembering(before[type(e)]) if type(e) in before else e for e in made)


def said_by(
    kinds: Iterable[Evidence], trace: Trace, theory: Theory, refused: Mapping[str, int]
) -> dict[str, dict[str, int]]:
    """For each kind of evidence, count the pairs of steps and sets of equalities that it excluded.

    For each name of a kind, "pairs" is the number of pairs of steps that are different dstates,
    and "refused" is the number of rejected sets, which is taken from `refused`. As in `pairs_of`,
    evidence that may be wrong excludes no pair.
    """
    return {
        kind.name: {
            "pairs": sum(map(len, pairs_of(trace, theory, [kind]).apart.values())),
            "refused": refused.get(kind.name, 0),
        }
        for kind in kinds
    }


def pairs_of(trace: Trace, theory: Theory, evidence: Iterable[Evidence] | None = None) -> Pairs:
    """Return which pairs of steps the evidence of a theory shows to be equal or different.

    In the theory no field is "auto". Evidence that may be wrong, because the theory allows faults
    of this kind, is left out.
    """
    kinds = evidence_of(theory) if evidence is None else evidence
    return Pairs.joined([e.pairs(trace) for e in kinds if e.axiom in theory.hard])
