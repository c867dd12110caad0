"""Ranks equally minimal maps by how well they close, where the trace has displacements."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import chain, islice
from typing import TypeAlias

from ssh_abduction.data.maps import Fit, SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.runtime.clock import heeding, look_at_clock
from ssh_abduction.solver.asp.limits import LimitError, Watch
from ssh_abduction.theory.evidence.displacement import jumped

# So many maps are ranked, at most; of a longer list those that come later stay in the order in
# which they are found, so that memory stays constant.
RANKED = 1000
# The noise of the odometry is said to be wrong where a chi-square like that of the best map is as
# unlikely as this, in either direction,
DOUBTED = 1e-3
# and the standard deviations are too small by this factor at least, or too large by that one: less
# changes no answer, and too large ones only exclude less.
TOO_SMALL, TOO_LARGE = 1.5, 2.0
# A displacement of so many standard deviations may be that of a robot which stands still.
STANDING = 2.0
# Displacements that agree to the last digit would make it 0.
NEVER_LESS = 0.01

# So many seconds beyond the limit it may take to tell how well the first map closes.
OVERTIME = 0.3

_Key: TypeAlias = tuple[tuple[int, ...], tuple[int | None, ...], tuple[int, ...]]


class Ranking:
    """Says of maps of one trace how well they close.

    Maps that differ in paths alone close alike, so that is worked out once.
    """

    def __init__(self, trace: Trace) -> None:
        self._trace = trace
        self._known: dict[_Key, Fit] = {}

    def fitted(self, ssh_map: SSHMap) -> SSHMap:
        """The same map, with how well it closes."""
        from ssh_abduction.solver.fit import fit  # loads scipy

        key = ssh_map.labels, tuple(s.place for s in ssh_map.dstates), jumped(ssh_map)
        if key not in self._known:
            self._known[key] = fit(self._trace.without_displacements_at(jumped(ssh_map)), ssh_map)
        return replace(ssh_map, fit=self._known[key])

    def ranked(self, maps: Iterator[SSHMap], over: Callable[[], bool]) -> Iterator[SSHMap]:
        """The same maps, the one that closes best first.

        Args:
            maps: As they are found.
            over: Whether the limits are over. Then maps come as they are found, without how well
                they close; for the first one OVERTIME more may be used.
        """
        overtime = Watch(OVERTIME)

        def look(first: bool) -> None:
            if over():
                if not first:
                    raise LimitError("time limit")
                if not overtime.running:
                    overtime.start()
                overtime.check()

        def fitted(ssh_map: SSHMap, first: bool = False) -> SSHMap:
            try:
                with heeding(lambda: look(first)):
                    look_at_clock()
                    return self.fitted(ssh_map)
            except LimitError:
                return ssh_map

        held: list[SSHMap] = []
        for ssh_map in maps:
            held.append(fitted(ssh_map, first=not held))
            if len(held) == RANKED:
                break
        yield from sorted(held, key=lambda m: m.fit.chi2 if m.fit else math.inf)
        yield from map(fitted, maps)


def in_order(maps: Sequence[SSHMap], counts: Iterable[int]) -> tuple[SSHMap, ...]:
    """Maps in an order that is the same in each run, whatever order they are found in: those that close best first, and of equal ones by their labels, then by their
    places, then by their courses, each as numbered by first visit.

    counts  how many maps there are of each level; each level is put in order by itself, and what is
    beyond stays as it is
    """
    left = iter(maps)
    levels = [sorted(islice(left, count), key=_order) for count in counts]
    return tuple(chain(*levels, left))


def _order(ssh_map: SSHMap) -> tuple[object, ...]:
    dstates = ssh_map.dstates
    places, paths = (
        [-1 if number is None else number for number in numbers]
        for numbers in zip(*((s.place, s.path) for s in dstates), strict=True)
    )
    faults = [(f.step, f.kind, str(f.seen), str(f.expected)) for f in ssh_map.faults]
    return (
        ssh_map.fit.chi2 if ssh_map.fit else math.inf,
        ssh_map.labels,
        places,
        paths,
        [s.direction or 0 for s in dstates],
        faults,
    )


def weights(maps: Sequence[SSHMap]) -> tuple[float, ...]:
    """How likely rival maps are, as displacements alone say, among these: exp(-chi2/2), normalised.

    Empty unless all of them have a fit.
    """
    squares = [ssh_map.fit.chi2 for ssh_map in maps if ssh_map.fit]
    if not squares or len(squares) < len(maps):
        return ()
    likely = [math.exp((min(squares) - square) / 2) for square in squares]
    return tuple(weight / sum(likely) for weight in likely)


def noise_warning(fit: Fit | None, trace: Trace) -> str | None:
    """What is wrong with the noise that the odometry claims, by how well the best map closes; None where nothing is."""
    if fit is None or fit.dof < 1 or min(fit.p, 1 - fit.p) > DOUBTED / 2:
        return None
    factor = max(math.sqrt(fit.chi2 / fit.dof), NEVER_LESS)
    if 1 / TOO_LARGE < factor < TOO_SMALL:
        return None
    if factor < 1 and trace.odometry and trace.odometry.offset:
        # How far off dstates are taken to be counts at each displacement there, which is more than
        # there is.
        return None
    how, told = ("smaller", "tight") if factor > 1 else ("larger", "loose")
    return (
        f"the noise model of the odometry is too {told}: the best map closes with a chi-square of "
        f"{fit.chi2:.0f} where {fit.dof} is expected, "
        f"so its standard deviations are {_times(factor)} {how} than the errors; multiply them by "
        f"{factor:.2g}"
    )


def units_warning(trace: Trace) -> str | None:
    """That displacements do not tell any travel from standing still, as where they are in kilometres; None where they do, or no travel has one."""
    ways: list[float] = []
    sigmas: list[float] = []
    for action, step, t in zip(trace.actions, trace.steps[1:], range(1, len(trace)), strict=True):
        covariance = trace.covariance(t)
        if action.kind != "travel" or step.displacement is None or covariance is None:
            continue
        dx, dy, _ = step.displacement
        way = math.hypot(dx, dy)
        x, y = (dx / way, dy / way) if way else (1.0, 0.0)
        sigma = math.sqrt(
            x * x * covariance[0][0] + 2 * x * y * covariance[0][1] + y * y * covariance[1][1]
        )
        if way > STANDING * sigma:
            return None
        ways.append(way)
        sigmas.append(sigma)
    if not ways:
        return None
    return (
        "the odometry tells no travel from standing still: the longest displacement of one is "
        f"{max(ways):.3g} m, and its noise about {max(sigmas):.2g} m; "
        "give metres and not kilometres, or the noise that the odometry has"
    )


def _times(factor: float) -> str:
    return f"{max(factor, 1 / factor):.1f} times"
