"""What a person asserts: that two steps are one dstate, different dstates, or different places."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.theory.evidence.protocol import Equality
from ssh_abduction.theory.pairs import Pairs

if TYPE_CHECKING:
    from ssh_abduction.theory.theory import Theory


@dataclass(frozen=True)
class Asserted:
    """Evidence from the fields `same`, `different` and `elsewhere` of a theory.

    Pairs with a step that the trace does not have yet are ignored.
    """

    name: ClassVar[str] = "asserted"
    axiom: ClassVar[str] = "asserted"
    said: Pairs

    @classmethod
    def of(cls, theory: Theory) -> Asserted:
        return cls(theory.asserted)

    def remembering(self, known: Asserted) -> Asserted:
        return self

    def pairs(self, trace: Trace) -> Pairs:
        return self.said

    def facts(self, trace: Trace, start: int, stop: int) -> str:
        return ""

    def refuse(self, trace: Trace, ssh_map: SSHMap, since: int = 0) -> frozenset[Equality] | None:
        return None
