"""The interface of a kind of evidence."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.theory.pairs import Pairs

if TYPE_CHECKING:
    from ssh_abduction.theory.theory import Theory


@dataclass(frozen=True)
class Equality:
    """Two steps are one dstate, or at one place; or they are not, if `holds` is False."""

    first: int
    second: int
    of: str = "dstate"
    holds: bool = True


class Evidence(Protocol):
    """A kind of evidence.

    encodings/NAME.lp holds its axiom. The `if` behind the axiom says for which theories it holds.
    """

    name: ClassVar[str]
    axiom: ClassVar[str]

    @classmethod
    def of(cls, theory: Theory) -> Evidence:
        """The evidence that a theory uses."""
        ...

    def remembering(self, known: Any) -> Evidence:
        """This evidence, with what `known` of the same kind computed about traces."""
        return self

    def pairs(self, trace: Trace) -> Pairs:
        """What is known about pairs of steps before the search.

        It must also hold for the first steps of a map, when a map is cut.
        """
        ...

    def facts(self, trace: Trace, start: int, stop: int) -> str:
        """Further facts for its encoding, about steps `start` to `stop - 1`."""
        ...

    def refuse(self, trace: Trace, ssh_map: SSHMap, since: int = 0) -> frozenset[Equality] | None:
        """A small set of equalities and inequalities that cannot all hold, in any map.

        Args:
            trace: The trace.
            ssh_map: A map of its first steps.
            since: The map of the steps before this one is known not to be rejected. So only later
                steps need to be checked.

        Returns:
            The set, which holds in the map; None if there is none.
        """
        ...
