"""Makes the `Solution` of a search from the maps that it gave and from what it has proven."""

from __future__ import annotations

from dataclasses import replace

from ssh_abduction.data.groups import numbered
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.solver.geometry.ranking import in_order, noise_warning, units_warning
from ssh_abduction.solver.parts import Parts
from ssh_abduction.solver.solution.recorded import Support
from ssh_abduction.solver.solution.result import Solution
from ssh_abduction.solver.steps.certificate import Basis
from ssh_abduction.solver.values import Cost, Effort, Grounding, Level, Seconds, cost_as_counted
from ssh_abduction.theory.evidence import said_by
from ssh_abduction.theory.speedups import row


class Answer:
    """Collects what a `Solution` says about the maps that a search gave: levels, cost, bound."""

    def __init__(self, parts: Parts) -> None:
        self._parts = parts
        self._levels: list[Level] = []
        self._first: SSHMap | None = None
        self._last: tuple[SSHMap, tuple[int, ...]] | None = None
        # The data for a certificate of the whole trace, if the search was stopped.
        self._basis: Basis | None = None

    @property
    def cost(self) -> Cost | None:
        """The cost of the last map given; None before the first one."""
        return None if self._last is None else cost_as_counted(*self._last, self._parts.task.theory)

    def take_down(self, ssh_map: SSHMap, cost: tuple[int, ...]) -> None:
        """Add a map that the caller got to its level (the maps of one cost, in counts)."""
        if self._last is None or self._last[1] != cost:
            self._levels.append(Level(cost_as_counted(ssh_map, cost, self._parts.task.theory), 0))
        self._first, self._last = self._first or ssh_map, (ssh_map, cost)
        self._levels[-1] = replace(self._levels[-1], count=self._levels[-1].count + 1)

    def count_apart(self) -> None:
        """Raise the lower bound on dstates to the size of a set of pairwise distinct steps."""
        known = self._parts.known
        self._basis = self._basis_of(len(self._parts.task.trace))
        if self._basis:
            apart = len(self._basis.certificate.clique)
            known.bound = replace(known.bound, dstates=max(apart, known.bound.dstates or 0))

    def solution(self, maps: tuple[SSHMap, ...], grounding: Grounding | None = None) -> Solution:
        """Make the solution that lists these maps, which the caller kept, in this order.

        `grounding` is the size of the ground program; None to ask clingo for it.
        """
        parts, known, task = self._parts, self._parts.known, self._parts.task
        levels = tuple(replace(level, complete=parts.rivals.listed) for level in self._levels)
        asker = parts.engine.asker
        seconds = Seconds(parts.watch.seconds(), asker.ground_seconds, asker.solve_seconds)
        # If a limit came before the pairs of steps were compared, the evidence said nothing yet.
        is_said = task.log.has_pairs or known.stopped is None
        kinds = task.problem.evidence if is_said else ()
        return Solution(
            status=known.status,
            maps=maps,
            cost=levels[0].cost if levels else known.best_cost,
            bound=known.bound,
            complete=known.complete,
            theory=task.theory,
            steps=len(task.trace),
            effort=Effort(
                parts.engine.size,
                seconds,
                asker.grounding if grounding is None else grounding,
                said_by(kinds, task.trace, task.theory, known.refused),
                parts.watch.elapsed() if parts.watch.counts_work else None,
            ),
            stopped=known.stopped,
            partial=None if known.best else known.partial,
            within=parts.limits.within,
            levels=levels,
            shared=parts.rivals.backbone,
            trace=task.trace,
            support=self._support(),
        )

    def _support(self) -> Support:
        """Collect the data for the certificate, and the warning about the odometry."""
        parts, trace = self._parts, self._parts.task.trace
        # A search that reached a limit may have ended while clingo grounded the prefix. Then prove
        # the bound from all steps.
        ran_out = parts.known.stopped not in (None, "maps limit")
        size = len(trace) if ran_out else parts.prefixes.engine.size
        warning = None
        if self._first and self._first.fit:
            warning = units_warning(trace) or noise_warning(self._first, trace)
        return Support(self._basis or self._basis_of(size), warning)

    def in_order(self, maps: tuple[SSHMap, ...]) -> tuple[SSHMap, ...]:
        """Sort the maps of each level into an order that is the same in each run.

        Return the maps unsorted if the caller did not keep all of them, or if the list of minimal
        maps is incomplete. Maps of a level may differ in counts that the theory does not minimise.
        So each level then gets the cost of its new first map.
        """
        parts, theory = self._parts, self._parts.task.theory
        is_all = parts.known.complete or parts.rivals.listed
        if not is_all or not maps or len(maps) < sum(level.count for level in self._levels):
            return maps
        ordered = in_order(maps, [level.count for level in self._levels])
        begin = 0
        for i, level in enumerate(self._levels):
            cost = level.cost.preferred_by(theory)
            self._levels[i] = replace(level, cost=cost_as_counted(ordered[begin], cost, theory))
            begin += level.count
        return ordered

    def _basis_of(self, size: int) -> Basis | None:
        """Collect the data for a certificate; None if the theory lacks an axiom that it needs."""
        task = self._parts.task
        if not row("clique").holds_for(task.theory):
            return None
        views = tuple(numbered(task.trace.views[: max(size, 1)]))
        actions = tuple(task.log.actions[: len(views) - 1])
        return Basis(views, actions, self._parts.known.bound.dstates or 0)
