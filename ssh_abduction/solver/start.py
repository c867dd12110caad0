"""The limits of a search and its starting point: frozen values that all parts of it read."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from ssh_abduction.data.checks import a_count_of_maps, a_flag
from ssh_abduction.data.errors import SolverError, brief, is_whole
from ssh_abduction.data.maps import SSHMap, checked_map, checked_maps
from ssh_abduction.solver.asp.limits import Watch, check_limit

if TYPE_CHECKING:
    from ssh_abduction.solver.parts import Parts


@dataclass(frozen=True, slots=True)
class Limits:
    """The limits of a search.

    Attributes:
        time_limit: Seconds of wall-clock time; None for no limit.
        memory_limit: MiB that the process may use at its peak; None for no limit.
        max_maps: The number of maps to list at most; None for all.
        work_limit: Units of work, each about a second of a quiet core; None for no limit.
        within: The number of dstates above the minimum that a listed map may have.

    Raises:
        SolverError: A value is out of range.
    """

    time_limit: float | None = None
    memory_limit: int | None = None
    max_maps: int | None = None
    within: int = 0
    work_limit: float | None = None

    def __post_init__(self) -> None:
        a_count_of_maps(self.max_maps, SolverError)
        if not is_whole(self.within) or self.within < 0:
            raise SolverError(
                "within (--set within=K): expected a whole number, 0 or more, got "
                f"{brief(self.within)}; give how much more than a minimal map others may cost"
            )
        check_limit("time_limit (--time-limit)", "seconds", self.time_limit)
        check_limit("work_limit (--work-limit)", "units of work", self.work_limit)
        check_limit("memory_limit (--memory-limit)", "MiB", self.memory_limit)

    @property
    def most(self) -> int:
        """The number of maps to list at most; 0 for all."""
        return self.max_maps or 0


@dataclass(frozen=True, slots=True)
class Start:
    """The starting point of a search, and whether it proves the backbone at its end.

    Other modules need this class. Users of the package do not.

    Attributes:
        reasons: Whether to prove at the end what all minimal maps share, if not all are listed. A
            share of the time limit is kept for that.
        after: The parts of an ended search for the first steps of the trace, to take over its
            grounding and its proofs; None to begin anew.
        minimal: A map of the trace that costs what `after` proved to be minimal; None if there is
            none. With such a map, the search only lists maps.
        known: Maps of the trace that an earlier search found. The search begins with those that
            the checker accepts, so that its best map costs no more than they do.
        around: The watch of a search that this search is a part of. Its limits hold here, too.
    """

    reasons: bool = False
    after: Parts | None = None
    minimal: SSHMap | None = None
    known: tuple[SSHMap, ...] = ()
    around: Watch | None = None

    def __post_init__(self) -> None:
        a_flag("reasons", self.reasons, SolverError)
        if self.minimal is not None:
            checked_map(self.minimal, "minimal")
        checked_maps(self.known)


ANEW = Start()
