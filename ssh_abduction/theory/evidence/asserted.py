"""What a person asserts of two steps: that they are one dstate or place, or different ones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from ssh_abduction.data.trace import Trace
from ssh_abduction.theory.evidence.protocol import Evidence
from ssh_abduction.theory.pairs import Pairs

if TYPE_CHECKING:
    from ssh_abduction.theory.theory import Theory


@dataclass(frozen=True)
class Asserted(Evidence):
    """Evidence from the fields `same`, `different`, `elsewhere` and `same_place` of a theory.

    Pairs with a step that the trace does not have yet are ignored.
    """

    name: ClassVar[str] = "asserted"
    axiom: ClassVar[str] = "asserted"
    said: Pairs
    together: tuple[tuple[int, int], ...] = ()

    @classmethod
    def of(cls, theory: Theory) -> Asserted:
        return cls(theory.asserted, theory.same_place)

    def pairs(self, trace: Trace) -> Pairs:
        return self.said

    def facts(self, trace: Trace, start: int, stop: int) -> str:
        said = [(i, t) for i, t in self.together if start <= t < stop]
        return "\n".join(f"together({i},{t})." for i, t in said)
