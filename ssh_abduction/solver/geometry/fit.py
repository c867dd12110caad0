"""Fit poses to the dstates of a map, and decide which closures are false.

>>> from ssh_abduction import Theory, Trace, solve
>>> from ssh_abduction.solver.geometry.fit import fit
>>> square = [(10, 0, 0), (0, 0, 1.5708)] * 4
>>> trace = Trace.from_steps("abababab" + "a", ["travel", "left"] * 4, displacements=square)
>>> ssh_map = solve(trace, Theory.causal()).maps[0]
>>> found = fit(trace, ssh_map)
>>> len(found.poses) == len(ssh_map.dstates)
True

A closure may be false. Matching local maps may lay a part of the building on another part that
looks alike. All false closures of such a pair of parts, an *alias*, are off by one unknown motion.
So a map explains each closure in one of two ways: it is true, or it is of an alias. An alias costs
as much as a fault, and its motion is uniform over the building. The cost of a map is that of the
best explanation.

*The search* for this explanation begins without closures. It assigns those closures first whose
displacement the map predicts most surely: to no alias, or to a known one, whichever agrees best. If
none agrees better than a motion that is uniform over the building, one closure begins a new alias.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Hashable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.data.maps import Fit, SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.runtime.clock import look_at_clock
from ssh_abduction.runtime.threads import one_thread
from ssh_abduction.solver.geometry.equations import Aliases, Equations
from ssh_abduction.solver.geometry.poses import Poses, laid_with_motions
from ssh_abduction.theory.evidence.loops import vectors_turned
from ssh_abduction.theory.fields import FAULT, ONE_WAY
from ssh_abduction.theory.prior import wide_of

Array: TypeAlias = NDArray[np.float64]


def fit(trace: Trace, ssh_map: SSHMap) -> Fit:
    """Find the poses of the dstates that agree best with the displacements, and the chi-square."""
    # The matrices are small: threads of BLAS would mostly wait for each other.
    with one_thread("blas"):
        return poses_of(trace, ssh_map).fit()


def poses_of(trace: Trace, ssh_map: SSHMap) -> Poses:
    """Collect the equations for the poses of a map of the whole trace, as it explains closures."""
    return Explaining.of_map(trace, ssh_map).best()[3]


@dataclass(frozen=True, eq=False)
class Explaining:
    """Explains the closures of a map, each by an alias or as true.

    Attributes:
        equations: The equations of the steps, with all closures.
        headings: As in `Poses`.
        positions: As in `Poses`.
        wide: As in `Poses.likelihood`.
    """

    equations: Equations
    headings: Sequence[int]
    positions: Sequence[Hashable]
    wide: Array

    @staticmethod
    def of_map(trace: Trace, ssh_map: SSHMap) -> Explaining:
        """Collect the equations for the poses of the dstates of a map of the whole trace."""
        places = [s.place if s.place is not None else -1 - s.id for s in ssh_map.dstates]
        return Explaining(Equations.of(trace), ssh_map.dstate_at, places, wide_of(trace))

    def least(self) -> float:
        """Return a lower bound on the chi-square and twice the cost of the aliases."""
        return min(poses.misfit() + 2 * nats for poses, nats in self.bounding())

    def bounding(self) -> tuple[tuple[Poses, float], ...]:
        """Return poses for lower bounds: all closures are true, or one at least is of an alias.

        Also return the nats that the aliases cost at least. In the second case no closure is used.
        """
        n = self._closures
        believed = self.poses((0,) * n), 0.0
        if not n:
            return (believed,)
        return believed, (self.poses((0,) * n, ()), FAULT + float(self._free(n).min()))

    def misfit(self, aliases: Aliases) -> float:
        """Return the least chi-square with these aliases."""
        return self.poses(aliases).misfit()

    def best(self) -> tuple[float, float, Aliases, Poses]:
        """Return the chi-square, the nats as in `likelihood`, the aliases, and the poses."""
        n = self._closures
        believed = (0,) * n
        poses = self.poses(believed)
        square, nats = poses.likelihood(self.wide)
        # Each true closure is expected to have a chi-square of three.
        if (
            not n
            or (square - self.poses(believed, ()).minimum(poses.best[0])[1] - 3 * n) / 2 < FAULT
        ):
            return square, nats, believed, poses
        other = self.likelihood(self._assigned(n))
        return (square, nats, believed, poses) if nats <= other[1] else other

    def likelihood(self, aliases: Aliases) -> tuple[float, float, Aliases, Poses]:
        """Return what `best` does with these aliases: the nats are those of `Poses`, and theirs."""
        poses = self.poses(aliases)
        square, nats = poses.likelihood(self.wide)
        return square, nats + FAULT * _count(aliases), aliases, poses

    def repeats(self, aliases: Aliases, near: float) -> tuple[dict[int, int], dict[int, int]]:
        """Find the dstates, and the places, that repeat earlier ones: aliases lay one on the other.

        Places then differ by less than `near` metres, and headings by less than ONE_WAY. Returns
        the number of the earlier one for the number of the later one.
        """
        at, facing, place, motions = laid_with_motions(self.poses(aliases))
        dstates, places = dict[int, int](), dict[int, int]()
        for *gone, turn in motions:
            off = np.hypot(*(vectors_turned(at, turn) + gone - at[:, None]).T)
            np.fill_diagonal(off, math.inf)
            for p, q in enumerate(off.argmin(axis=1).tolist()):
                if off[p, q] >= near:
                    continue
                places.setdefault(max(p, q), min(p, q))
                for s, x in product(np.flatnonzero(place == p), np.flatnonzero(place == q)):
                    if abs(math.remainder(facing[s] + turn - facing[x], math.tau)) < ONE_WAY:
                        dstates.setdefault(int(max(s, x)), int(min(s, x)))
        return dstates, places

    def poses(self, aliases: Sequence[int], kept: Collection[int] | None = None) -> Poses:
        """Collect the equations of a map with these aliases. None keeps all closures."""
        kept = range(len(aliases)) if kept is None else kept
        said = self.equations.doubting(tuple(aliases), kept)
        return Poses(said, self.headings, self.positions)

    @property
    def _closures(self) -> int:
        """The number of closures."""
        return int((self.equations.scaled == 0).sum())

    def explanations(self) -> Iterator[Aliases]:
        """Yield explanations of the closures. Each closure is false in one of them at least.

        If alike parts of a building are laid on each other, false closures agree with each other
        as true ones do. Then the first explanation may believe the wrong ones.
        """
        n = self._closures
        yield (found := self._assigned(n))
        doubted = {i for i in range(n) if found[i]}
        while len(doubted) < n:
            first = min({*range(n)} - doubted)
            yield (found := self._assigned(n, first))
            doubted |= {first, *(i for i in range(n) if found[i])}

    def _assigned(self, n: int, false: int | None = None) -> Aliases:
        """Assign the n closures, the most surely predicted ones first.

        The closure `false` is of the first alias, if it is given.
        """
        aliases, left = np.zeros(n, dtype=int), np.arange(n)
        if false is not None:
            aliases[false], left = 1, np.delete(left, false)
        free, before = self._free(n), None
        while len(left):
            look_at_clock()
            poses = self.poses(aliases.tolist(), np.setdiff1d(range(n), left))
            before = poses.best[0] if before is None else poses.minimum(before)[0]
            known = range(1, _count(aliases.tolist()) + 1)
            ways = np.array([0, *known, *(-k for k in known)])
            others = []
            for way in ways:
                trial = aliases.copy()
                trial[left] = way
                others.append(self.poses(trial.tolist()))
            rows = len(self.equations.first) - n + left
            squares, nats = poses.predicting(others, rows, self.wide, before)
            way = (squares / 2 + nats).argmin(axis=0)
            cost, sure = (squares / 2 + nats).min(axis=0), nats[way, np.arange(len(left))]
            agree = np.flatnonzero(cost < free[left] + FAULT)
            if len(agree):
                agree = agree[np.argsort(sure[agree])][: (len(agree) + 1) // 2]
                aliases[left[agree]] = ways[way[agree]]
            else:
                agree = np.array([sure.argmin()])
                aliases[left[agree]] = len(known) + 1
            left = np.delete(left, agree)
        return tuple(aliases.tolist())

    def _free(self, n: int) -> Array:
        """Return how many nats the uniform motion of an alias costs each closure, (n,)."""
        free: Array = np.log(self.wide).sum() - np.linalg.slogdet(self.equations.noise[-n:])[1]
        return free / 2


def _count(aliases: Sequence[int]) -> int:
    """Return the number of different aliases."""
    return max(map(abs, aliases), default=0)
