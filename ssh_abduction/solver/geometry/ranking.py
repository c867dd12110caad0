"""Rank equally minimal maps by how well their poses agree with the displacements of the trace.

A map *closes* well if the displacements (how the robot moved, by its odometry) along each loop of
the map nearly add up to zero. `fit.py` measures this by a chi-square.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import chain, islice, pairwise
from typing import TypeAlias

from ssh_abduction.data.maps import Fit, SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.runtime.clock import heeding, look_at_clock
from ssh_abduction.runtime.limits import LimitError, Watch
from ssh_abduction.solver.steps.faults import with_compass
from ssh_abduction.theory.evidence.displacement import jumped

# Rank at most this many maps, so that memory stays constant. Later maps keep their order.
RANKED = 1000
# Warn about the noise of the odometry only if the chi-square of the best map is so high, or so low,
# that its probability is at most this.
DOUBTED = 1e-3
# Moreover, warn only if the standard deviations are too small by at least the first factor, or too
# large by at least the second one. Smaller errors change no answer.
TOO_SMALL, TOO_LARGE = 1.5, 2.0
# With a displacement of at most this many standard deviations, the robot may have stood still.
STANDING = 2.0
NEVER_LESS = 0.01  # the least factor to name, as it would be 0 if displacements agree exactly

_Key: TypeAlias = tuple[tuple[int, ...], tuple[int | None, ...], tuple[int, ...]]


class Ranking:
    """Computes how well the maps of one trace agree with its displacements.

    Maps that differ only in paths agree equally well, so their fit is computed only once.
    """

    def __init__(self, trace: Trace) -> None:
        self._trace = trace
        self._known: dict[_Key, Fit] = {}

    def fitted(self, ssh_map: SSHMap) -> SSHMap:
        """Return the same map with its field `fit`: the poses, and how well they agree."""
        from ssh_abduction.solver.geometry.fit import fit  # loads scipy

        key = ssh_map.dstate_at, tuple(s.place for s in ssh_map.dstates), jumped(ssh_map)
        if key not in self._known:
            self._known[key] = fit(self._trace.without_displacements_at(jumped(ssh_map)), ssh_map)
        return with_compass(replace(ssh_map, fit=self._known[key]))

    def ranked(
        self, maps: Iterator[SSHMap], over: Callable[[], bool], overtime: Callable[[], float]
    ) -> Iterator[SSHMap]:
        """Yield the same maps with their fit, the one with the least chi-square first.

        Only the first RANKED maps are sorted. Once `over` says that a limit is reached, maps get no
        fit and keep their order. Only the fit of the first map may then take `overtime` seconds.
        """
        late: Watch | None = None

        def look(first: bool) -> None:
            nonlocal late
            if over():
                if not first:
                    raise LimitError("time limit")
                late = late or Watch().part(overtime())
                late.check()

        def fitted(ssh_map: SSHMap, first: bool = False) -> SSHMap:
            try:
                with heeding(lambda: look(first)):
                    look_at_clock()
                    return self.fitted(ssh_map)
            except LimitError:
                return ssh_map

        held = [fitted(ssh_map, first=not i) for i, ssh_map in enumerate(islice(maps, RANKED))]
        yield from sorted(held, key=lambda m: m.fit.chi2 if m.fit else math.inf)
        yield from map(fitted, maps)


def in_order(maps: Sequence[SSHMap], counts: Iterable[int]) -> tuple[SSHMap, ...]:
    """Sort maps into an order that is the same in each run.

    Maps with the least chi-square come first. Maps with the same chi-square are sorted by labels,
    then by places, paths, directions and faults. Each level (the maps of one cost) is sorted by
    itself. `counts` has the numbers of maps of levels. Maps after the last level keep their order.
    """
    left = iter(maps)
    levels = [sorted(islice(left, count), key=_order) for count in counts]
    return tuple(chain(*levels, left))


def _order(ssh_map: SSHMap) -> tuple[object, ...]:
    """Return the key by which `in_order` sorts a map."""
    dstates = ssh_map.dstates
    numbers = [
        [-1 if n is None else n for n in of]
        for of in zip(*((s.place, s.path) for s in dstates), strict=True)
    ]
    faults = [(f.step, f.kind, str(f.seen), str(f.expected)) for f in ssh_map.faults]
    return (
        ssh_map.fit.chi2 if ssh_map.fit else math.inf,
        ssh_map.dstate_at,
        *numbers,
        [s.direction or 0 for s in dstates],
        faults,
    )


def noise_warning(ssh_map: SSHMap, trace: Trace) -> str | None:
    """Return a warning if the best map contradicts the noise model of the odometry; else None."""
    fit = ssh_map.fit
    if fit is None or fit.dof < 1 or min(fit.p, 1 - fit.p) > DOUBTED / 2:
        return None
    factor = max(math.sqrt(fit.chi2 / fit.dof), NEVER_LESS)
    if 1 / TOO_LARGE < factor < TOO_SMALL:
        return None
    if factor < 1 and ((trace.odometry and trace.odometry.offset) or not _comes_back(ssh_map)):
        # A small chi-square says nothing if no visit comes back, as turns on the spot always fit.
        # Nor does it with an offset, as the fit adds the error of a dstate's pose to each
        # displacement there, which is too much.
        return None
    how, noise = ("smaller", "tight") if factor > 1 else ("larger", "loose")
    mend = f"multiply them by {factor:.2g}"
    if trace.closures:  # of a log, whose covariances no user has set
        mend = "the track or some joins of the map may be wrong"
    return (
        f"the noise model of the odometry is too {noise}: the best map fits with a chi-square of "
        f"{fit.chi2:.0f}, where {fit.dof} is expected. "
        f"So its standard deviations are {_times(factor)} {how} than the errors; {mend}"
    )


def _comes_back(ssh_map: SSHMap) -> bool:
    """Whether the robot came back to a place, or in a causal map to a dstate."""
    at = [ssh_map.place_of(t) for t in range(len(ssh_map.dstate_at))]
    at = list(ssh_map.dstate_at) if None in at else at
    visits = [here for before, here in pairwise([None, *at]) if before != here]
    return len(set(visits)) < len(visits)


def units_warning(trace: Trace) -> str | None:
    """Return a warning if all displacements of travels are as small as their noise; else None.

    This happens if displacements are in kilometres instead of metres.
    """
    found: list[tuple[float, float]] = []  # the way and its noise
    for t, action in enumerate(trace.actions, 1):
        displacement, covariance = trace.steps[t].displacement, trace.covariance(t)
        if action.kind != "travel" or displacement is None or covariance is None:
            continue
        dx, dy, _ = displacement
        way = math.hypot(dx, dy)
        x, y = (dx / way, dy / way) if way else (1.0, 0.0)
        (xx, xy, _), (_, yy, _), _ = covariance
        sigma = math.sqrt(x * x * xx + 2 * x * y * xy + y * y * yy)
        if way > STANDING * sigma:
            return None
        found.append((way, sigma))
    if not found:
        return None
    way, sigma = map(max, zip(*found, strict=True))
    return (
        "the odometry cannot tell a travel from standing still: the longest travel is "
        f"{way:.3g} m, and its noise about {sigma:.2g} m; "
        "give metres and not kilometres, or correct the noise of the odometry"
    )


def _times(factor: float) -> str:
    """Say a factor, or its inverse if that is larger, in words."""
    if factor == NEVER_LESS:
        return f"at least {1 / factor:g} times"
    return f"{max(factor, 1 / factor):.1f} times"
