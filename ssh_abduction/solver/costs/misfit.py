"""The misfit of a map to the displacements, and small sets of returns that cause a misfit.

A *return* is two steps that a map puts at one place or dstate. Two steps at one dstate have one
pose, and two steps at one place have one position. The misfit of a set of returns is the least
chi-square of the displacements and closures that these allow (`solver/geometry/fit.py`). More
returns leave less freedom. So a set of returns never has a smaller misfit than a part of the set,
and a map never has a smaller misfit than a set of its returns.

The cost of a complete map is -log of its marginal likelihood: half of its misfit, and the *volume*,
which says how well the map predicts the displacements. A map with more returns predicts them
better, and leaves fewer poses free. So the volume is only known for complete maps. It is never less
than what the new dstates and places of the map cost (`theory/prior.py`).

A visit to a place has several steps, as turns stay at their place. So these steps have one position
in each topological map, also without a return. But if displacements may be wrong, the
displacement of a turn may be wrong, too. Then each step is a visit of its own, and a turn is a
return, too.

Closures may be false (`solver/geometry.fit.py`). The misfit of a complete map is that of the
best explanation of its closures. A set of returns has a lower bound: either all closures are true,
or one at least is of an alias, and then the misfit is at least that without closures.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Hashable, Iterable, Iterator, Sequence
from typing import TypeAlias

import numpy as np

from ssh_abduction.data.groups import NodeClasses, first_index_of, minimal_part, numbered
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.solution.values import Cost
from ssh_abduction.solver.geometry.equations import Aliases, Equations, visits_by_turns
from ssh_abduction.solver.geometry.fit import Explaining
from ssh_abduction.solver.geometry.poses import Poses, framed
from ssh_abduction.theory.evidence import Equality
from ssh_abduction.theory.evidence.displacement import jumped
from ssh_abduction.theory.fields import FAULT
from ssh_abduction.theory.prior import AIM, UNKNOWN, Array, Flags, Ints
from ssh_abduction.theory.settle import Problem

# The heading of each step and the position of each step, numbered in the order of first steps, such
# that steps with equal numbers share them; and the steps whose displacements are ignored.
_Groups: TypeAlias = tuple[tuple[int, ...], tuple[int, ...], tuple[int, ...]]


class Misfit:
    """Computes the misfit (a chi-square) of sets of returns of one trace, and keeps each result.

    Attributes:
        visit: For each step, the first step of its visit. Without places, each step is a visit.
    """

    def __init__(self, problem: Problem) -> None:
        """Find the visits of the trace. No misfit is computed yet."""
        self.trace, self._prior = problem.trace, problem.prior
        self.visit = visits_by_turns(self.trace, problem.theory)
        self._equations = Equations.of(self.trace)
        self._known: dict[_Groups, float] = {}
        self._likelihood: dict[_Groups, tuple[float, float, Aliases]] = {}

    def of_returns(self, returns: Iterable[Equality], wrong: Collection[int] = ()) -> float:
        """Return a lower bound on the misfit of maps with returns, ignoring `wrong` moves.

        It includes what aliases cost. Without closures, it is the misfit (a chi-square).
        """
        headings, visits = NodeClasses[int](), NodeClasses[int]()
        for found in returns:
            if found.of == "dstate":
                headings.merge(found.first, found.second)
            visits.merge(self.visit[found.first], self.visit[found.second])
        steps = range(len(self.visit))
        return self.of_course([*map(headings.of, steps)], [*map(visits.of, self.visit)], wrong)

    def of_course(
        self, dstates: Sequence[int], places: Sequence[Hashable], wrong: Collection[int] = ()
    ) -> float:
        """Return what `of_returns` does if steps are at these dstates and places."""
        groups = _groups_of(dstates, places, wrong)
        if groups not in self._known:
            self._known[groups] = self._explaining(groups).least()
        return self._known[groups]

    def bounding(
        self, dstates: Sequence[int], places: Sequence[Hashable]
    ) -> tuple[tuple[Poses, float], ...]:
        """Return poses for lower bounds, as `Explaining.bounding`.

        If there may be an alias, what dstates and places show may cost nothing.
        """
        return self._explaining(_groups_of(dstates, places, ())).bounding()

    def of_closing(self, ssh_map: SSHMap) -> float:
        """Compute by how much the returns of a map of the whole trace raise its misfit."""
        dstates, places, wrong = _course_of(ssh_map)
        square, _, aliases = self._explained(dstates, places, wrong)
        apart = self._explaining(_groups_of(range(len(dstates)), self.visit, wrong))
        return square - apart.misfit(aliases)

    def nats_of(self, ssh_map: SSHMap) -> float:
        """Compute the cost of a map of the whole trace in nats."""
        return FAULT * Cost.of(ssh_map).faults + self.nats_of_course(*_course_of(ssh_map))

    def nats_of_course(
        self,
        dstates: Sequence[int],
        places: Sequence[Hashable],
        wrong: Collection[int] = (),
        aliases: Aliases | None = None,
    ) -> float:
        """Return -log of the marginal likelihood if steps are at these dstates and places.

        With `aliases`, this is an upper bound: closures are explained so, instead of best.
        """
        prior = self._prior
        if aliases is None:
            _, nats, aliases = self._explained(dstates, places, wrong)
        else:
            of_map = self._explaining(_groups_of(dstates, places, wrong))
            _, nats, _, poses = of_map.likelihood(aliases)
            nats += prior.chosen(dstates, places, framed(poses), wrong)
        nats += float(prior.base[-1]) + prior.lost(wrong) + prior.shown(dstates, places)
        return nats - self._repeated(dstates, places, wrong, aliases)

    def _repeated(
        self,
        dstates: Sequence[int],
        places: Sequence[Hashable],
        wrong: Collection[int],
        aliases: Aliases,
    ) -> float:
        """Return the nats that views and stars save where aliases lay a part on another part."""
        if not any(aliases):
            return 0.0
        of_map = self._explaining(_groups_of(dstates, places, wrong))
        pairs = of_map.repeats(aliases, self._prior.near)
        named = enumerate((numbered(dstates), numbered(places)))
        return sum(self._prior.repeated(of, x, pairs[of]) for of, x in named)

    def aliases_of(
        self, dstates: Sequence[int], places: Sequence[Hashable], wrong: Collection[int] = ()
    ) -> Aliases:
        """Return the alias of each closure in the best explanation; 0 if it is true."""
        return self._explained(dstates, places, wrong)[2]

    def nearness(
        self, dstates: Sequence[int], places: Sequence[int]
    ) -> tuple[tuple[Array, float], tuple[Array, float]]:
        """Tell how near each two places are, and each two dstates of a place, from 0 to 1.

        That is the Gaussian of `Prior.chosen`. With it comes the sum over all pairs to expect if
        poses were independent, and the square of a usual travel belonged to each place.
        """
        of, first, (i, j), off = self._between(dstates, places)
        both, same = first[i] & first[j], of[i] == of[j]
        turn = (off[same, 2] + math.pi) % math.tau - math.pi
        far = (off[both, :2] ** 2).sum(axis=1) / self._prior.near**2
        of_places, of_dstates = np.exp(-far / 2), np.exp(-(turn**2) / AIM**2 / 2)
        expected = len(far) * math.pi / 2 / first.sum(), len(turn) * float(UNKNOWN[1])
        return (of_places, expected[0]), (of_dstates, expected[1])

    def near_places(self, dstates: Sequence[int], places: Sequence[int]) -> list[tuple[int, int]]:
        """List the places that are near each other, as `Prior.near` says: each pair both ways."""
        of, first, (i, j), off = self._between(dstates, places)
        near = first[i] & first[j] & (np.hypot(*off[:, :2].T) < self._prior.near)
        pairs = [(p, q) for p, q in np.stack([of[i], of[j]], 1)[near].tolist()]
        return [*pairs, *((q, p) for p, q in pairs)]

    def _between(
        self, dstates: Sequence[int], places: Sequence[int]
    ) -> tuple[Ints, Flags, tuple[Ints, Ints], Array]:
        """Return how each two dstates in one frame lie to each other, (pairs, 3).

        The place of each dstate, whether it is the first one there, and the pairs come first.
        """
        of = np.array(_of_headings(numbered(dstates), numbered(places)))
        first = np.isin(range(len(of)), [*first_index_of(of.tolist()).values()])
        poses, frame = framed(self.poses(dstates, places))
        i, j = np.nonzero(np.triu(np.equal.outer(frame, frame), 1))
        return of, first, (i, j), poses[i] - poses[j]

    def beginning(self, ssh_map: SSHMap) -> tuple[list[int], list[int], Poses]:
        """Return the dstates and places of a map for `smoothed`, and their equations."""
        return self.beginning_at(*_course_of(ssh_map))

    def beginning_at(
        self, dstates: Sequence[int], places: Sequence[Hashable], wrong: Collection[int] = ()
    ) -> tuple[list[int], list[int], Poses]:
        """Return what `beginning` does if steps are at these dstates and places."""
        of_dstate = _of_headings(numbered(dstates), numbered(places))
        return numbered(dstates), of_dstate, self.poses(dstates, places, wrong)

    def explained(self) -> Iterator[tuple[Aliases, tuple[list[int], list[int], Poses]]]:
        """Yield explanations of the closures, with equations that keep all visits apart."""
        steps, places = [*range(len(self.visit))], numbered(self.visit)
        for aliases in self._explaining(_groups_of(steps, places, ())).explanations():
            yield aliases, (steps, places, self.poses(steps, places, aliases=aliases))

    def poses(
        self,
        dstates: Sequence[int],
        places: Sequence[Hashable],
        wrong: Collection[int] = (),
        aliases: Aliases | None = None,
    ) -> Poses:
        """Collect the equations with these aliases of closures, or with the best explanation."""
        if aliases is None:
            aliases = self._explained(dstates, places, wrong)[2]
        return self._explaining(_groups_of(dstates, places, wrong)).poses(aliases)

    def _explained(
        self, dstates: Sequence[int], places: Sequence[Hashable], wrong: Collection[int]
    ) -> tuple[float, float, Aliases]:
        """Return the misfit, the nats, and the aliases of the best explanation of the closures."""
        groups = _groups_of(dstates, places, wrong)
        if groups not in self._likelihood:
            square, nats, aliases, poses = self._explaining(groups).best()
            nats += self._prior.chosen(dstates, places, framed(poses), wrong)
            self._likelihood[groups] = found = square, nats, aliases
            if not self.trace.closures:
                self._known[groups] = found[0]
        return self._likelihood[groups]

    def returns_of(self, ssh_map: SSHMap) -> list[Equality]:
        """List the returns of a map: each step with the last step at its dstate or place."""
        found: list[Equality] = []
        at_dstate: dict[int, int] = {}
        at_place: dict[int, int] = {}
        for t, label in enumerate(ssh_map.dstate_at):
            place = ssh_map.dstates[label].place
            if label in at_dstate:
                found.append(Equality(at_dstate[label], t))
            elif place in at_place and self.visit[at_place[place]] != self.visit[t]:
                found.append(Equality(at_place[place], t, "place"))
            at_dstate[label] = t
            if place is not None:
                at_place[place] = t
        return found

    def core(
        self, returns: Sequence[Equality], least: float, wrong: Collection[int] = ()
    ) -> list[Equality]:
        """Find a minimal subset of returns whose misfit is a chi-square of at least `least`.

        The displacements to `wrong` steps are ignored. Returns all returns if even their misfit is
        less, and an empty list if the misfit without any return is that large.
        """
        if self.of_returns(returns, wrong) < least:
            return list(returns)

        def suffices(some: Sequence[Equality]) -> bool:
            return self.of_returns(some, wrong) >= least

        return [] if suffices([]) else minimal_part(suffices, list(returns))

    def _explaining(self, groups: _Groups) -> Explaining:
        """Collect the equations for the poses that steps share."""
        headings, positions, wrong = groups
        said = self._equations
        if wrong:
            said = Equations.of(self.trace.without_displacements_at(wrong))
        return Explaining(said, headings, _of_headings(headings, positions), self._prior.wide)


def _course_of(ssh_map: SSHMap) -> tuple[Sequence[int], Sequence[Hashable], tuple[int, ...]]:
    """Return the dstates and places of steps, and the steps with wrong displacements."""
    places = [ssh_map.dstates[label].place for label in ssh_map.dstate_at]
    names = places if None not in places else ssh_map.dstate_at
    return ssh_map.dstate_at, names, jumped(ssh_map)


def _groups_of(
    dstates: Sequence[int], places: Sequence[Hashable], wrong: Collection[int]
) -> _Groups:
    """Number the dstates and the places of steps in the order of first steps."""
    return tuple(numbered(dstates)), tuple(numbered(places)), tuple(sorted(wrong))


def _of_headings(headings: Sequence[int], positions: Sequence[int]) -> list[int]:
    """Return the position of each heading."""
    return [*dict(zip(headings, positions, strict=True)).values()]
