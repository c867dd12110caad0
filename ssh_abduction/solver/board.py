"""The board of a search: what is known about the maps of a trace, and the judge of its maps.

Only here does a map become an answer. A map is reduced to what the theory speaks of, and judged by
the checker, which shares no code with the encodings. Checking every map of a long list would take
longer than finding the maps. So checks get only a share of the search time. The first maps are
always checked. Later maps are checked if the share is not used up.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

from ssh_abduction.checker.checker import AXIOMS, Violation, check, unchecked, violations
from ssh_abduction.data.errors import AbductionError
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.runtime.clock import now
from ssh_abduction.runtime.limits import Stop
from ssh_abduction.solution.values import Bound, Cost, Found, Status, cost_as_counted
from ssh_abduction.solver.asp.kept_rules import can_be_asked, keeps_own_rules
from ssh_abduction.theory.evidence import Equality
from ssh_abduction.theory.settle import Problem
from ssh_abduction.theory.theory import Theory

# Optional checks take at most SHARE of the search time plus BEYOND seconds.
SHARE = 0.1
BEYOND = 0.01
ALWAYS = 3  # this many maps are always checked
A_STEP = 5e-6  # seconds that the checker takes for a step, until the first check measures it
# Without these axioms a dstate may have several places, courses or headings, but a map shows only
# one. So the checker cannot judge it.
UNSHOWN = frozenset({"one_place", "one_course", "one_heading", "gateway_heading"})


class Known:
    """What is known about the maps of a trace.

    Attributes:
        best: The best map of the whole trace; None if there is none.
        cost: The preferred counts of the best map, the most important one first; () without one.
        bound: Proven lower bounds on the counts of any map.
        lower: A lower bound on the preferred counts of every map, proven on a prefix; None if there
            is none.
        partial: The map of a prefix that was found last; None before that.
        complete: Whether all maps were given: all minimal ones and, with `within`, all others that
            it asks for.
        count: The number of maps given to the caller.
        refused: For each kind of evidence, by name, how many sets of equalities it rejected.
    """

    def __init__(self, theory: Theory) -> None:
        self.status = Status.UNKNOWN
        self.best: SSHMap | None = None
        self.cost: tuple[int, ...] = ()
        self.bound = Bound()
        self.lower: tuple[int, ...] | None = None
        self.partial: SSHMap | None = None
        self.complete = False
        self.count = 0
        self.refused: dict[str, int] = {}
        self._stopped: Stop | None = None
        self._theory = theory

    @property
    def stopped(self) -> Stop | None:
        """Why the search ended before all maps were given; None if they were."""
        return None if self.complete else self._stopped

    @stopped.setter
    def stopped(self, why: Stop | None) -> None:
        self._stopped = why

    def is_better(self, found: Found) -> bool:
        """Whether a map of the trace, or of a prefix, costs less than the best map so far."""
        return self.best is None or found.cost < self.cost

    def keep(self, found: Found, labels: tuple[int, ...]) -> None:
        """Make a map, perhaps of the first steps, the best one. `labels` is for the whole trace."""
        self.best, self.cost = replace(found.map, dstate_at=labels), found.cost

    def raise_bound(self, proven: int | None) -> None:
        """Raise the lower bound on the count that is minimised first, if `proven` is larger."""
        first = self._theory.priorities[0] if self._theory.priorities else None
        if first and proven is not None and proven > (getattr(self.bound, first) or 0):
            self.bound = replace(self.bound, **{first: proven})

    def raise_lower(self, cost: tuple[int, ...]) -> None:
        """Raise the lower bound on the cost of all maps to the least cost for the first steps."""
        self.raise_bound(cost[0] if cost else None)
        if self.lower is None or cost > self.lower:
            self.lower = cost

    @property
    def best_cost(self) -> Cost | None:
        """The counts of the best map; None if there is no map."""
        return None if self.best is None else cost_as_counted(self.best, self.cost, self._theory)


class InternalError(AbductionError):
    """A map that was found breaks an axiom. This is a defect of this program, not of the trace."""


class Judging:
    """Judges the maps of one search: by the evidence, and by the checker.

    Attributes:
        broken: The first axiom that the map breaks which was judged last; None if it breaks none.
    """

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        self._trace = problem.trace
        theory = self._theory = problem.theory
        self._evidence = problem.evidence
        self.broken: Violation | None = None
        self._accepted: SSHMap | None = None  # the map that the checker accepted last
        self._judged = 0
        self._seconds = 0.0  # spent on checking so far
        self._a_step = A_STEP  # seconds for a step in the last check
        self._shown = not UNSHOWN & theory.given_up

    @property
    def may_refuse(self) -> bool:
        """Whether the theory uses evidence that may reject whole maps, such as displacements."""
        return bool(self._evidence)

    def why_refused(self, ssh_map: SSHMap) -> frozenset[Equality] | None:
        """Find equalities of a map that contradict some evidence; None if there are none."""
        refusal = self.refusal(ssh_map)
        return refusal[1] if refusal else None

    def refusal(self, ssh_map: SSHMap) -> tuple[str, frozenset[Equality]] | None:
        """Name the first evidence that rejects a map, with equalities that contradict it."""
        for evidence in self._evidence:
            if found := evidence.refuse(self._trace, ssh_map):
                return evidence.name, found
        return None

    def allows_grown(self, trace: Trace, ssh_map: SSHMap, since: int) -> bool:
        """Whether no evidence rejects a map of a longer trace. Later checks use this trace."""
        self._trace = trace
        return not any(evidence.refuse(trace, ssh_map, since) for evidence in self._evidence)

    @cached_property
    def can_accept(self) -> bool:
        """Whether the checker, or clingo for a user's own rules, can check all axioms."""
        own = {axiom.name for rules in self._theory.rules for axiom in rules.axioms} | {
            rules.name for rules in self._theory.rules
        }
        others = unchecked(self._theory.replace(rules=()))
        return not others and own.isdisjoint(AXIOMS) and can_be_asked(self._theory)

    def accepts(self, ssh_map: SSHMap, since: int = 0) -> bool:
        """Whether a map of the whole trace satisfies all axioms and agrees with all evidence.

        The evidence accepted its first `since` steps already.
        """
        if not self.can_accept:
            return False
        self.broken = next(violations(self._trace, ssh_map, self._theory, since), None)
        accepted = (
            self.broken is None
            and self.allows_grown(self._trace, ssh_map, since)
            and keeps_own_rules(self._problem, ssh_map)
        )
        self._accepted = ssh_map if accepted else self._accepted
        return accepted

    def pass_map(self, ssh_map: SSHMap, elapsed: float) -> None:
        """Check a map of the whole trace before it is given, as far as there is time.

        The search took `elapsed` seconds so far. Raises InternalError if the map breaks an axiom.
        """
        if not self._shown or ssh_map == self._accepted:
            return
        if self._judged < ALWAYS or self.has_time_for(len(self._trace), elapsed):
            self.pass_grown_map(self._trace, ssh_map)
        self._judged += 1

    def has_time_for(self, steps: int, elapsed: float) -> bool:
        """Whether checking this many steps fits into the share of the time for checking."""
        return self._shown and self._a_step * steps <= BEYOND + SHARE * elapsed - self._seconds

    def pass_grown_map(self, trace: Trace, ssh_map: SSHMap) -> None:
        """Check a map of a longer trace, and measure the time. Later checks use this trace.

        Raises InternalError if the map breaks an axiom.
        """
        self._trace = trace
        began = now()
        broken = check(trace, ssh_map, self._theory.of_steps(0, len(trace)))
        spent = now() - began
        self._seconds += spent
        self._a_step = spent / len(trace)
        for violation in broken:
            where = f" at step {violation.steps[-1]}" if violation.steps else ""
            raise InternalError(
                f"internal error: a map that was found breaks {violation.axiom}{where} (trace "
                f"{trace.digest}): {violation.message} "
                "This is a defect of ssh-abduction, not of the trace; please report it with the "
                "trace, and try solve --set without_speedups=prefixes,names,ways"
            )


def projected(ssh_map: SSHMap, theory: Theory) -> SSHMap:
    """Return the map without paths if no axiom of the theory says which paths there are."""
    if theory.has_paths or not any(s.path is not None for s in ssh_map.dstates):
        return ssh_map
    dstates = tuple(replace(s, path=None, direction=None) for s in ssh_map.dstates)
    return replace(ssh_map, dstates=dstates, paths=(), excused=())
