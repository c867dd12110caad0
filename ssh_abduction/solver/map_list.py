"""List the maps of a search once the minimal cost is known."""

from __future__ import annotations

import math
from collections.abc import Generator, Iterator
from typing import TypeAlias

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.words import counted
from ssh_abduction.runtime.loggers import log_of
from ssh_abduction.solver.asp.limits import StageTimeError
from ssh_abduction.solver.parts import Parts
from ssh_abduction.solver.projecting import projected
from ssh_abduction.solver.schedule import turn
from ssh_abduction.solver.sources.exact.near import NearMinimal, counted_first
from ssh_abduction.solver.values import Status
from ssh_abduction.theory.theory import Theory

# After the last map asked for, look for one more for this many seconds, or for this share of the
# time so far if that is more. If clingo proves that there is none, the list is complete.
ONE_MORE = 1.0
ONE_MORE_SHARE = 0.1
_log = log_of(__name__)

Priced: TypeAlias = tuple[SSHMap, tuple[int, ...]]
"""A map and its preferred counts, the most important one first; equal in all maps of a level."""


def listed(parts: Parts, found: Iterator[Priced], *, keeps_time: bool) -> Iterator[Priced]:
    """Yield the maps asked for, each with its preferred counts, after a check.

    The clock of the search stops while the caller works with a map. `found` has the minimal maps,
    and then maps that cost more. If `keeps_time`, some time is kept for finding the backbone later.
    """
    known, watch, most = parts.known, parts.watch, parts.limits.most
    if known.status is Status.OPTIMAL:
        _log.info("minimal maps cost %s; they are listed", _cost_in_words(parts))
        kept = turn("backbone").share if keeps_time else 0.0
        ends = (1 - kept) * (watch.elapsed() + watch.left()) if kept else math.inf
        ends = ends if ends > watch.elapsed() else math.inf
        watch.stage_ends = ends
        for ssh_map, cost in _without_repeats(found, parts.task.theory):
            if most and known.count == most:
                known.stopped = "maps limit"
                return
            parts.judging.pass_map(ssh_map, parts.engine.size, watch.elapsed())
            # Take the first map as the best one. The answer gives its counts as the cost.
            known.best = known.best if known.count else ssh_map
            known.count += 1
            note(parts, ssh_map, cost)
            parts.report()
            watch.stop()
            yield ssh_map, cost
            watch.start()
            # Clasp ends its search for one more map by its limit of conflicts if work is counted.
            if known.count == most and not watch.counts_work:
                spent = watch.elapsed()
                watch.stage_ends = min(ends, spent + max(ONE_MORE, ONE_MORE_SHARE * spent))
    known.complete = True


def _without_repeats(found: Iterator[Priced], theory: Theory) -> Iterator[Priced]:
    """Yield each map once, reduced to what the theory speaks of."""
    given: set[SSHMap] = set()
    for ssh_map, cost in found:
        if theory.has_paths:
            yield ssh_map, cost
        elif (shown := projected(ssh_map, theory)) not in given:
            given.add(shown)
            yield shown, cost


def note(parts: Parts, ssh_map: SSHMap, cost: tuple[int, ...]) -> None:
    """Add a map to the known minimal maps (`parts.rivals`), if it is minimal."""
    if parts.known.status is Status.OPTIMAL and cost == parts.known.cost:
        parts.rivals.add(ssh_map, cost)


def by_count(
    parts: Parts, mended_maps: tuple[tuple[SSHMap, ...], bool] | None
) -> Generator[Priced, None, None]:
    """Yield the minimal maps, then those with up to `within` dstates more, with their counts."""
    known, limits = parts.known, parts.limits
    minimal, is_all = mended_maps or (parts.prefixes.minimal_maps(), True)
    yield from ((ssh_map, known.cost) for ssh_map in minimal)
    if not is_all:
        raise StageTimeError
    parts.rivals.listed = True  # so the backbone needs no further search
    if not limits.most or known.count < limits.most:
        parts.watch.stage_ends = math.inf
    if limits.within and counted_first(parts.task.theory):
        engine = parts.prefixes.engine
        parts.near = NearMinimal(parts.task, parts.judging, limits.most, parts.report, engine.asker)
        yield from parts.near.maps(known.cost, limits.within)


def _cost_in_words(parts: Parts) -> str:
    """Return the cost of minimal maps in words."""
    cost = parts.known.best_cost
    if cost is None:
        return "nothing that is counted"
    return ", ".join(counted(v, k) for k, v in cost.to_dict().items())
