"""Try local changes of the best map: some visits at another place, and what follows from it.

A beam goes through the trace once and drops hypotheses, so it may miss a cheaper map that differs
little from the best one. A change takes some visits away from their place: none, one, or one and
all later ones at that place. The poses of the map without these visits say how far they are from
each other place. Each place that the displacements do not exclude is joined with theirs, or they
stay at a new place. A join changes the poses and what the map shows, so other joins may save nats
now. They follow at once (`Overlay.merge_all`). So one change may reassign a whole loop.

The closures of a changed map are first explained as those of the best map. Only if it costs little
more, the best explanation is sought, which takes longer.

Reference:
    Shaw 1998, "Using constraint programming and local search methods to solve vehicle routing
    problems" (large neighbourhoods).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import chain, groupby

from ssh_abduction.data.groups import gathered, numbered
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.runtime.clock import look_at_clock
from ssh_abduction.solver.costs.estimating import Course, dstates_and_places
from ssh_abduction.solver.costs.misfit import Misfit
from ssh_abduction.solver.geometry.equations import Aliases
from ssh_abduction.solver.sources.metric.hypothesis import Hypothesis, parts_of
from ssh_abduction.solver.sources.metric.overlay import Overlay
from ssh_abduction.solver.sources.metric.sights import Sights
from ssh_abduction.solver.steps.log import Log
from ssh_abduction.theory.settle import Problem


class Changing:
    """Changes a map until no change is cheaper."""

    def __init__(
        self,
        problem: Problem,
        log: Log,
        misfit: Misfit,
        add: Callable[[SSHMap], float],
        within: float,
    ) -> None:
        """Prepare the search.

        `add` keeps a map if it obeys the axioms, and returns its cost in nats; infinite if it
        breaks them. Maps that cost at least `within` nats more than the best one are not tried.
        """
        self._problem, self._log, self._misfit = problem, log, misfit
        self._add, self._within = add, within
        self._bare = problem.theory.replace(displacement="none", weigh="count")
        self._sights = Sights(problem.trace, self._bare)
        self._tried = set[Course]()

    def improve(self, best: SSHMap) -> None:
        """Change a map, and then the cheapest map found, until no change is cheaper."""
        todo = _groups(best)
        while todo:
            steps, *todo = todo
            look_at_clock()
            if (cheaper := self._cheaper(best, steps)) is not None:
                best = cheaper
                # Go on behind the visits that were changed.
                todo = sorted(_groups(best), key=lambda others: others[:1] <= steps[:1])

    def _cheaper(self, best: SSHMap, steps: Sequence[int]) -> SSHMap | None:
        """Find a cheaper map that differs from a map where some steps are; None if there is none.

        Without steps, places of the map are joined.
        """
        misfit, nats, course = self._misfit, self._misfit.nats_of(best), _course_of(best)
        aliases = misfit.aliases_of(*course)
        self._tried.add(course)
        for found in self._changed(course, steps, aliases):
            if (changed := _course_of(found)) in self._tried:
                continue
            self._tried.add(changed)
            look_at_clock()
            if misfit.nats_of_course(*changed, aliases=aliases) < nats + self._within:
                ssh_map = found.ssh_map(self._problem.trace, self._bare, self._sights)
                if ssh_map is not None and self._add(ssh_map) < nats:
                    return ssh_map
        return None

    def _changed(
        self, course: Course, steps: Sequence[int], aliases: Aliases
    ) -> Iterator[Hypothesis]:
        """Yield the changes of a map if some steps are elsewhere, those of nearby places first.

        The aliases explain the closures.
        """
        of, prior = set(steps), self._problem.prior
        labels, places = (numbered((x, t in of) for t, x in enumerate(names)) for names in course)
        of_dstate = [*dict(zip(labels, places, strict=True)).values()]
        fitted = self._misfit.poses(labels, places, aliases=aliases).gaussian()
        parts = parts_of(fitted, labels, of_dstate, self._log, self._sights)
        for part in parts:
            if not of <= part.labels.keys():
                continue
            rest = [other for other in parts if other is not part]
            overlay = Overlay(part, None, self._problem, self._sights)
            here = part.places[part.labels[steps[0]]] if steps else None
            if steps:
                yield _beside([part, *rest])
            for pair in overlay.near(here, max(map(prior.predicted, steps or part.labels))):
                if overlay.join(pair):
                    yield _beside([overlay.part(), *rest])


def _groups(best: SSHMap) -> list[list[int]]:
    """List the steps of visits that a change takes away from their place: at first none."""
    _, places = _course_of(best)
    visits = [[*of] for _, of in groupby(range(len(places)), key=places.__getitem__)]
    at = gathered((places[visit[0]], visit) for visit in visits)
    later = [[*chain(*of[i:])] for of in at.values() for i in range(1, len(of) - 1)]
    return [[], *visits, *later]


def _beside(parts: Sequence[Hypothesis]) -> Hypothesis:
    """Put hypotheses about different steps beside each other."""
    whole, *others = parts
    for part in others:
        whole = whole.beside(part)
    return whole


def _course_of(found: SSHMap | Hypothesis) -> Course:
    """Return the dstate and the place of each step, numbered by first visit."""
    if isinstance(found, SSHMap):
        dstates, places = dstates_and_places(found)
        return dstates, places if found.places else dstates
    labels = [found.labels[t] for t in sorted(found.labels)]
    return tuple(numbered(labels)), tuple(numbered(map(found.places.__getitem__, labels)))
