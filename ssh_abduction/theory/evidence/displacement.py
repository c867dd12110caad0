"""What odometry says: a dstate has one pose, a place one position, and the displacements of the trace agree with that within their covariance.

A *return* is a pair of visits that a map takes for one place, or a pair of steps that it takes for one dstate. By the displacements between, the loop from one
to the other closes off by something; how likely that is, its covariance says (`theory/loops.py`). The axiom `one_pose` is that no set of at most `joint` returns is refused.

*One return* says nothing of any other, so it is known before the search which ones are refused: they are pairs of steps that are not at one place, or
not one dstate, and prune the domains of every engine.

*Two returns* can be refused only together with each other if their loops share displacements. They are looked for in each answer.

*How often a true map is refused.* Each return is tested, and a true map has many. So a return is refused at a p-value that is half of `reject` shared among all
returns which may be true, and a set of two at the other half shared among all sets of two of these: then a true map is refused with a probability of `reject` at
most. A return may be true if it does not look false; of the true ones, half have a p-value above one half (Storey 2002, "A direct approach to false discovery
rates"), so there are about twice as many as have that. The number is rounded up to a power of two: while a robot drives, what is refused stays
so until there are twice as many.
"""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar, TypeAlias

from ssh_abduction.maps import SSHMap
from ssh_abduction.theory.evidence.protocol import Equality
from ssh_abduction.theory.pairs import NO_PAIRS, Pairs
from ssh_abduction.trace import Trace

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from ssh_abduction.theory.loops import Array, Loops, Steps
    from ssh_abduction.theory.theory import Theory

Return: TypeAlias = tuple[int, int, bool]  # steps I < J, and whether they are one dstate, rather than at one place only

# So many loops are worked on in one go: their sums take some hundred megabytes.
AT_A_TIME = 200_000


@dataclass(frozen=True)
class Displacement:
    """The fields `reject` and `joint` of a theory."""

    name: ClassVar[str] = "displacement"
    axiom: ClassVar[str] = "one_pose"
    reject: float
    joint: int
    returns: int
    has_places: bool
    turns_stay: bool
    has_one_view: bool

    @classmethod
    def of(cls, theory: Theory) -> Displacement:
        topological, hard = theory.level == "topological", theory.hard
        return cls(theory.reject, theory.joint, theory.returns, topological, "turn_stays" in hard, "functional_view" in hard)

    def pairs(self, trace: Trace) -> Pairs:
        return self._of(trace).pairs

    def facts(self, trace: Trace, start: int, stop: int) -> str:
        return ""

    def refuse(self, trace: Trace, ssh_map: SSHMap) -> frozenset[Equality] | None:
        return self._of(trace).refused_together(ssh_map) if self.joint > 1 else None

    def _of(self, trace: Trace) -> Returns:
        return _returns(self, trace)


_KEPT: deque[Returns] = deque(maxlen=4)  # the returns that were asked for last, as several parts of a search ask for them


def _returns(evidence: Displacement, trace: Trace) -> Returns:
    """The returns of a trace, made when they are first asked for."""
    for known in list(_KEPT):
        if known.trace is trace and known.evidence == evidence:
            return known
    _KEPT.append(found := Returns(evidence, trace))
    return found


def count_returns(trace: Trace, theory: Theory) -> int:
    """How many returns of a trace may be true, rounded up to a power of two. A trace may be as long as it likes, and have as few."""
    return Returns(Displacement.of(theory), trace).count()


class Returns:
    """The returns that a trace may have, and which of them are refused."""

    def __init__(self, evidence: Displacement, trace: Trace) -> None:
        self.evidence, self.trace = evidence, trace
        self._accepted: frozenset[Return] = frozenset()  # no two of these are refused together

    @cached_property
    def pairs(self) -> Pairs:
        """The pairs of steps that are not at one place, or not one dstate."""
        if not self.trace.has_displacements:
            return NO_PAIRS
        far = [self._refused_at(places=True), self._refused_at(places=False)]
        elsewhere = [(int(i), int(j)) for i, j in zip(*far[0], strict=True)]
        apart = [(int(i), int(j)) for i, j in zip(*far[1], strict=True)]
        return Pairs.of([*apart, *self._steps_of_visits(elsewhere)], elsewhere)

    @cached_property
    def arrivals(self) -> list[int]:
        """The first step of each visit: where the robot came to a place. Where it is not known which actions are turns, each step is a visit."""
        return [0, *(t for t, action in enumerate(self.trace.actions, 1) if action.kind != "turn")]

    @cached_property
    def tested(self) -> dict[bool, tuple[Steps, Steps]]:
        """The returns of places, and those of dstates, about which displacements say something: their first steps, and their last ones."""
        views: dict[object, list[int]] = defaultdict(list)
        for t, step in enumerate(self.trace.steps):
            views[step.view if self.evidence.has_one_view else None].append(t)
        return {
            True: self._loops_within([self.arrivals] if self.evidence.has_places else []),
            False: self._loops_within(list(views.values())),
        }

    def _loops_within(self, groups: Sequence[Sequence[int]]) -> tuple[Steps, Steps]:
        """All loops between two steps of one group about which displacements say something."""
        import numpy as np

        begins = self._widest.begins
        found: list[tuple[Steps, Steps]] = []
        for group in groups:
            steps = np.asarray(group)
            starts = np.searchsorted(steps, begins[steps])
            counts = np.arange(len(steps)) - starts
            last = np.repeat(np.arange(len(steps)), counts)
            first = np.arange(len(last)) - np.repeat(np.cumsum(counts) - counts, counts) + np.repeat(starts, counts)
            found.append((steps[first], steps[last]))
        empty = np.zeros(0, dtype=int)
        return np.concatenate([empty, *(i for i, _ in found)]), np.concatenate([empty, *(j for _, j in found)])

    @cached_property
    def _bends(self) -> list[tuple[Loops, float]]:
        from ssh_abduction.theory.loops import bends  # loads numpy

        return list(bends(self.trace))

    @property
    def _widest(self) -> Loops:
        """The loops in which the least is lost: those without a drift."""
        return self._bends[0][0]

    def count(self) -> int:
        """How many returns may be true, rounded up to a power of two; so many as have a p-value above one half, twice."""
        from scipy.special import gammainccinv

        from ssh_abduction.theory.loops import Loops, chi_squares

        loops, likely = Loops.of(self.trace), 0
        for places, (first, last) in self.tested.items():
            half = 2 * gammainccinv((2 if places else 3) / 2, 0.5)
            for part in _parts(len(first)):
                squares = chi_squares(*loops.closings(first[part], last[part]))
                likely += int((squares[0 if places else 1] < half).sum())
        return 1 << max(2 * likely - 1, 0).bit_length()

    def threshold(self, freedom: int, together: bool) -> float:
        """The chi-square above which a return, or a set of two together, is refused.

        freedom  its degrees of freedom
        """
        from scipy.special import gammainccinv

        share = self.evidence.reject / (2 if self.evidence.joint > 1 else 1)
        returns = max(self.evidence.returns, 1)
        tests = returns * (returns - 1) / 2 if together else returns
        return float(2 * gammainccinv(freedom / 2, share / max(tests, 1)))

    def _refused_at(self, places: bool) -> tuple[Steps, Steps]:
        """The returns of places, or of dstates, that are refused alone."""
        import numpy as np

        first, last = self.tested[places]
        refused = np.zeros(len(first), dtype=bool)
        for part in _parts(len(first)):
            refused[part] = self._refused(first[part], last[part], places)
        return first[refused], last[refused]

    def _refused(self, first: Steps, last: Steps, places: bool) -> NDArray[np.bool_]:
        """Which returns are refused alone: those that close badly whatever drift the heading has."""
        import numpy as np

        from ssh_abduction.theory.loops import chi_squares

        most = self.threshold(2 if places else 3, together=False)
        left = np.arange(len(first))
        for loops, unlikely in self._bends:
            if unlikely > most or not len(left):
                break
            i, j = first[left], last[left]
            squares = chi_squares(*loops.closings(i, j))[0 if places else 1] + unlikely
            left = left[(squares > most) & loops.unlost(i, j)]
        refused = np.zeros(len(first), dtype=bool)
        refused[left] = True
        return refused

    def _steps_of_visits(self, elsewhere: Sequence[tuple[int, int]]) -> Iterator[tuple[int, int]]:
        """The pairs of steps that show the same view, in visits that are not at one place. Steps that show different views are apart anyway."""
        if not self.evidence.turns_stay:
            return
        shown: dict[int, dict[object, list[int]]] = {}
        for here, there in zip(self.arrivals, [*self.arrivals[1:], len(self.trace)], strict=True):
            by_view = shown[here] = defaultdict(list)
            for t in range(here, there):
                by_view[self.trace.steps[t].view].append(t)
        for i, j in elsewhere:
            for view, steps in shown[i].items():
                if others := shown[j].get(view):
                    yield from ((s, t) for s in steps for t in others)

    def returns_of(self, ssh_map: SSHMap) -> list[Return]:
        """The returns of a map about which displacements say something: pairs of visits at one place, and pairs of steps at one dstate."""
        labels = ssh_map.labels
        arrivals = [t for t in self.arrivals if t < len(labels)]
        at_dstate: dict[int, list[int]] = defaultdict(list)
        at_place: dict[int | None, list[int]] = defaultdict(list)
        for t, label in enumerate(labels):
            at_dstate[label].append(t)
        for t in arrivals:
            at_place[ssh_map.dstates[labels[t]].place].append(t)
        at_place.pop(None, None)
        found: list[Return] = []
        for groups, one_dstate in ((at_dstate, True), (at_place, False)):
            first, last = self._loops_within(list(groups.values()))
            found += zip(first.tolist(), last.tolist(), [one_dstate] * len(first), strict=True)
        return found

    def refused_together(self, ssh_map: SSHMap) -> frozenset[Equality] | None:
        """The two returns of a map that are refused together most clearly; None where no two are."""
        if not self.trace.has_displacements:
            return None
        returns = frozenset(self.returns_of(ssh_map))
        worst = self._worst_of(sorted(returns - self._accepted), sorted(returns & self._accepted))
        if worst is None:
            self._accepted = returns
            return None
        return frozenset(Equality(i, j, "dstate" if one_dstate else "place") for i, j, one_dstate in worst)

    def _worst_of(self, new: Sequence[Return], known: Sequence[Return]) -> tuple[Return, Return] | None:
        """Of the sets of a new return and another one, new or known, the one that is refused most clearly; None where none is refused."""
        import numpy as np

        rows = np.array([*known, *new], dtype=int).reshape(-1, 3)
        if not len(new) or len(rows) < 2:
            return None
        worst, most = None, 0.0
        drawn = _Tested(self, rows)
        for a in range(len(known), len(rows)):
            partner, excess = drawn.worst_partner(a)
            if excess > most:
                worst, most = (rows[a], rows[partner]), excess
        if worst is None:
            return None
        first, second = ((int(i), int(j), bool(one)) for i, j, one in worst)
        return first, second


class _Tested:
    """Returns whose sets of two are tested, one row each: its steps, and whether it is of a dstate."""

    def __init__(self, returns: Returns, rows: Steps) -> None:
        self._returns, self._rows = returns, rows
        self._freedom = np_where_dstate(rows)
        self._known: dict[int, tuple[Array, Array]] = {}
        self._thresholds = {freedom: returns.threshold(freedom, together=True) for freedom in (4, 5, 6)}

    def worst_partner(self, a: int) -> tuple[int, float]:
        """Of the returns before row `a`, the one with which it is refused most clearly, and by how much the chi-square is above the threshold; 0 where none is."""
        import numpy as np

        rows = self._rows
        begin, end = np.maximum(rows[:a, 0], rows[a, 0]), np.minimum(rows[:a, 1], rows[a, 1])
        partners = np.flatnonzero(begin < end)  # their loops share displacements
        excess = np.full(len(partners), np.inf)
        for number, (loops, unlikely) in enumerate(self._returns._bends):
            left = np.flatnonzero(excess > 0)
            if not len(left):
                break
            excess[left] = np.minimum(excess[left], self._excess(number, loops, a, partners[left]) + unlikely)
        if not len(partners) or excess.max() <= 0:
            return 0, 0.0
        best = int(excess.argmax())
        return int(partners[best]), float(excess[best])

    def _excess(self, number: int, loops: Loops, a: int, partners: Steps) -> Array:
        """By how much the chi-square of row `a` together with each of these rows is above the threshold."""
        import numpy as np

        closing, covariance = self._closings(number, loops)
        m = len(partners)
        joint = np.empty((m, 6, 6))
        joint[:, :3, :3], joint[:, 3:, 3:] = covariance[a], covariance[partners]
        here = np.repeat(self._rows[a : a + 1], m, axis=0)
        shared = loops.shared((here[:, 0], here[:, 1]), (self._rows[partners, 0], self._rows[partners, 1]))
        if not self._rows[a, 2]:
            shared[:, 2, :] = 0.0
        shared[self._rows[partners, 2] == 0, :, 2] = 0.0
        joint[:, :3, 3:], joint[:, 3:, :3] = shared, shared.transpose(0, 2, 1)
        off = np.concatenate([np.repeat(closing[a : a + 1], m, axis=0), closing[partners]], axis=1)
        squares = np.einsum("mi,mi->m", off, np.linalg.solve(joint, off[:, :, None])[:, :, 0])
        most = np.array([self._thresholds[f] for f in (self._freedom[a] + self._freedom[partners]).tolist()])
        lost = ~loops.unlost(self._rows[partners, 0], self._rows[partners, 1])
        excess: Array = np.where(lost, -np.inf, squares - most)
        if not loops.unlost(self._rows[a, 0], self._rows[a, 1]):
            excess[:] = -np.inf
        return excess

    def _closings(self, number: int, loops: Loops) -> tuple[Array, Array]:
        """How far off the loops of all rows close, and the covariances. The heading of a return to a place says nothing, so it is cut off from the rest."""
        if number not in self._known:
            closing, covariance = loops.closings(self._rows[:, 0], self._rows[:, 1])
            places = self._rows[:, 2] == 0
            closing[places, 2] = 0.0
            covariance[places, 2, :] = covariance[places, :, 2] = 0.0
            covariance[places, 2, 2] = 1.0
            self._known[number] = closing, covariance
        return self._known[number]


def np_where_dstate(rows: Steps) -> Steps:
    """The degrees of freedom of each row: three for a dstate, two for a place."""
    freedom: Steps = 2 + rows[:, 2]
    return freedom


def _parts(size: int) -> Iterator[slice]:
    """So many loops in parts that fit into memory."""
    for start in range(0, size, AT_A_TIME):
        yield slice(start, start + AT_A_TIME)
