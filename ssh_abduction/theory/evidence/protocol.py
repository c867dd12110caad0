"""What a kind of evidence has to offer."""

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
    """That two steps are at one dstate, or at one place; or that they are not."""

    first: int
    second: int
    of: str = "dstate"
    holds: bool = True


class Evidence(Protocol):
    """A kind of evidence. encodings/NAME.lp holds its axiom, and says with `if` for which theories it holds."""

    name: ClassVar[str]
    axiom: ClassVar[str]

    @classmethod
    def of(cls, theory: Theory) -> Evidence:
        """What takes part in a theory."""
        ...

    def remembering(self, known: Any) -> Evidence:
        """This evidence with what `known`, of the same kind, worked out about traces."""
        return self

    def pairs(self, trace: Trace) -> Pairs:
        """What is known of pairs of steps before the search.

        A map of the trace, cut down to some first steps, keeps what is said of these.
        """
        ...

    def facts(self, trace: Trace, start: int, stop: int) -> str:
        """What else its encoding reads, of steps `start` to `stop - 1`."""
        ...

    def refuse(self, trace: Trace, ssh_map: SSHMap, since: int = 0) -> frozenset[Equality] | None:
        """A small set of equalities of a map of the first steps, and of what is not equal (`holds` is False), that cannot all hold, whatever the map; None if there is none.

        since  the map of the steps before this one is known to be a map of these that is not
        refused, so that it need not be asked about again
        """
        ...
