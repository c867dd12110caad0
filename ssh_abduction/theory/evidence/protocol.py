"""The interface of a kind of evidence."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, TypeVar

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.theory.pairs import NO_PAIRS, Pairs

if TYPE_CHECKING:
    from ssh_abduction.theory.theory import Theory

Key = TypeVar("Key")
KEPT = 8  # how many traces are remembered, with what evidence says of them


@dataclass(frozen=True)
class Equality:
    """The statement that two steps are one dstate or at one place, or that they are not.

    It may also say that the displacement from one step to the next is right.

    Attributes:
        first: One step.
        second: The other step.
        of: "dstate", "place" or "displacement".
        holds: False for the statement that they are not one.
    """

    first: int
    second: int
    of: str = "dstate"
    holds: bool = True


class Evidence(Protocol):
    """A kind of evidence: what is known besides views and actions. By default, it says nothing.

    encodings/NAME.lp declares its axiom. The `if` after the axiom says for which theories it holds.

    Attributes:
        name: The name of the kind and of its encoding.
        axiom: The name of its axiom.
    """

    name: ClassVar[str]
    axiom: ClassVar[str]

    @classmethod
    def of(cls, theory: Theory) -> Evidence:
        """Make the evidence for a theory, by default from none of its fields."""
        return cls()

    def remembering(self, known: Any) -> Evidence:
        """Return this evidence, with the results that earlier evidence of its kind computed."""
        return self

    def pairs(self, trace: Trace) -> Pairs:
        """Return the pairs of steps that are known, before the search, to be equal or different.

        The pairs must also be true in each map of the first steps of the trace.
        """
        return NO_PAIRS

    def facts(self, trace: Trace, start: int, stop: int) -> str:
        """Return further facts about the steps from `start` to before `stop`, as clingo text."""
        return ""

    def refuse(self, trace: Trace, ssh_map: SSHMap, since: int = 0) -> frozenset[Equality] | None:
        """Return a small set of (in)equalities of steps of a map that no map satisfies together.

        None if there is none. The map may be of the first steps of the trace only. Its first
        `since` steps are known to have no such set, so only later steps need to be checked.
        """
        return None


def remembered(known: dict[Key, Pairs], key: Key, find: Callable[[Key], Pairs]) -> Pairs:
    """Return what `find` gives for a key. `known` has the results for the last KEPT keys."""
    if (found := known.get(key)) is None:
        found = known[key] = find(key)
        for old in list(known)[:-KEPT]:
            known.pop(old, None)  # another thread may have removed it
    return found
