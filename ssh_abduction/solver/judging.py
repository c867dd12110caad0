"""The second net: maps pass the checker, which shares nothing with the encodings, before they are answers.

To check each step of a long replay, or each map of a long list, would take longer than to find
them. So checking has a tenth of the time of the search, and a hundredth of a second more: the first
maps are checked always, by the steps that clingo was given at least; of what comes after, as many
as that share allows.
"""

from __future__ import annotations

import random
import time
from functools import cached_property

from ssh_abduction.checker.checker import AXIOMS, Violation, check, unchecked, violations
from ssh_abduction.data.errors import AbductionError
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.solver.asp.own import can_be_asked, keeps_own_rules
from ssh_abduction.theory.evidence import Equality
from ssh_abduction.theory.settle import Problem

# At most such a share of the time of the search, and so many seconds more, are spent on checking
# what is not checked always.
SHARE = 0.1
BEYOND = 0.01
# So many maps are checked however long that takes, by the steps that clingo was given at least.
ALWAYS = 3
# So many steps beyond these are looked at where there is no time for all of them.
SAMPLE = 1000
# So many seconds the checker takes for a step, about, before the first check has shown it.
A_STEP = 5e-6
# Without these axioms a map shows one of several places, courses or headings of a dstate, so that
# the checker cannot judge it.
UNSHOWN = frozenset({"one_place", "one_course", "one_heading", "gateway_heading"})


class InternalError(AbductionError):
    """A map that was found breaks an axiom: a defect of this program, and not of the trace."""


class Judging:
    """Passes the maps of one search through the checker.

    trace   the whole trace
    theory  with star settled
    """

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        self._trace = problem.trace
        theory = self._theory = problem.theory
        self._evidence = problem.evidence
        self._accepted: SSHMap | None = (
            None  # the last map that passed the checker before it was kept
        )
        self._judged = 0
        self._seconds = 0.0  # spent so far
        self._a_step = A_STEP  # seconds that a step takes, by the last check
        self._shown = not UNSHOWN & theory.given_up

    @property
    def may_refuse(self) -> bool:
        """Whether there is evidence that may find out of a map that it is none."""
        return bool(self._evidence)

    def why_refused(self, ssh_map: SSHMap) -> frozenset[Equality] | None:
        """Equalities of a map, of the trace or a prefix, that some evidence finds out cannot all hold; None where it refuses none."""
        refusal = self.refusal(ssh_map)
        return refusal[1] if refusal else None

    def refusal(self, ssh_map: SSHMap) -> tuple[str, frozenset[Equality]] | None:
        """The same, with the name of the first kind of evidence that refuses the map."""
        for evidence in self._evidence:
            if found := evidence.refuse(self._trace, ssh_map):
                return evidence.name, found
        return None

    def allows_grown(self, trace: Trace, ssh_map: SSHMap, since: int) -> bool:
        """Whether no evidence refuses a map of a trace that has grown.

        since  the map of so many first steps was refused by none
        """
        self._trace = trace
        return not any(evidence.refuse(trace, ssh_map, since) for evidence in self._evidence)

    @cached_property
    def can_accept(self) -> bool:
        """Whether all that the theory asks for can be judged of a map: by the checker, and for own rules by clingo, which grounds them with the map."""
        own = {axiom.name for rules in self._theory.rules for axiom in rules.axioms} | {
            rules.name for rules in self._theory.rules
        }
        others = unchecked(self._theory.replace(rules=()))
        return not others and own.isdisjoint(AXIOMS) and can_be_asked(self._theory)

    def accepts(self, ssh_map: SSHMap) -> bool:
        """Whether a map of the whole trace that nothing proves yet is known to satisfy all axioms."""
        accepted = (
            self.can_accept
            and next(violations(self._trace, ssh_map, self._theory), None) is None
            and not self.why_refused(ssh_map)
            and keeps_own_rules(self._problem, ssh_map)
        )
        self._accepted = ssh_map if accepted else self._accepted
        return accepted

    def pass_map(self, ssh_map: SSHMap, prefix: int, elapsed: float) -> None:
        """Raise InternalError where a map of the whole trace breaks an axiom, as far as there is time to look.

        prefix   how many of the first steps clingo was given
        elapsed  seconds that the search took so far
        """
        if not self._shown or ssh_map == self._accepted:
            return
        steps = len(self._trace)
        shows_all = prefix < steps and len(set(ssh_map.labels[:prefix])) == len(ssh_map.dstates)
        if self.has_time_for(steps, elapsed) or (self._judged < ALWAYS and not shows_all):
            self._check(ssh_map, steps)
        elif self._judged < ALWAYS:
            self._check(_of_first_steps(ssh_map, prefix), prefix)
            self._look_at_sample(ssh_map, prefix)
        self._judged += 1

    def has_time_for(self, steps: int, elapsed: float) -> bool:
        """Whether a map of so many steps can be checked within the share of the time so far.

        The first short ones always can.
        """
        return self._shown and self._a_step * steps <= BEYOND + SHARE * elapsed - self._seconds

    def pass_grown_map(self, trace: Trace, ssh_map: SSHMap) -> None:
        """Raise InternalError where a map breaks an axiom, that was replayed along a trace which has grown."""
        self._trace = trace
        self._check(ssh_map, len(trace))

    def _check(self, ssh_map: SSHMap, steps: int) -> None:
        began = time.perf_counter()
        violations = check(self._trace.prefix(steps), ssh_map, self._theory.of_steps(0, steps))
        spent = time.perf_counter() - began
        self._seconds += spent
        self._a_step = spent / steps
        if violations:
            self._fail(violations[0])

    def _look_at_sample(self, ssh_map: SSHMap, prefix: int) -> None:
        """Look at some links and views beyond the prefix."""
        links = set(ssh_map.links)
        beyond = range(prefix, len(self._trace))
        for t in random.Random(0).sample(beyond, min(SAMPLE, len(beyond))):
            here, there = ssh_map.labels[t - 1], ssh_map.labels[t]
            action = self._trace.steps[t - 1].action
            if (
                action is None
                or (here, action.name, there) not in links
                or self._trace.steps[t].view not in (None, ssh_map.dstates[there].view)
            ):
                self._fail(
                    Violation(
                        "map_explains_trace", (t - 1, t), f"Step {t} is not where the map says."
                    )
                )

    def _fail(self, violation: Violation) -> None:
        where = f" at step {violation.steps[-1]}" if violation.steps else ""
        raise InternalError(
            f"internal error: a map that was found breaks {violation.axiom}{where} (trace "
            f"{self._trace.digest}): {violation.message} "
            "This is a defect of ssh-abduction, not of the trace; please report it with the "
            "trace, and try solve --set without_speedups=prefixes,names,ways"
        )


def _of_first_steps(ssh_map: SSHMap, steps: int) -> SSHMap:
    """A map of the whole trace whose dstates and links the first steps show all, as a map of these."""
    return SSHMap(
        ssh_map.labels[:steps],
        ssh_map.dstates,
        ssh_map.links,
        ssh_map.places,
        ssh_map.paths,
        ssh_map.excused,
    )
