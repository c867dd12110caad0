"""Displacements as evidence: a dstate has one pose, and a place one position.

A *return* is two steps that a map puts at one place or dstate. For a place, they are the first
steps of two visits. The displacements between the two steps make a loop. By these displacements,
the end of the loop is some distance from its beginning, and the covariance says how likely that is
(`loops.py`).
The axiom `one_pose` demands that no set of at most `joint` returns is rejected.

*One return* can be tested before the search. If it is rejected, its steps are at different places,
or are different dstates. Such pairs of steps prune the domains of all engines.

*Two returns* are tested together if both are between first steps of visits, and their loops share
displacements. This is tested on each map that clingo finds.

*How often a true map is rejected.* A true map has many returns, and each is tested. So half of
`reject` is divided among all returns that may be true, and the other half among all sets of two.
Then a true map is rejected with probability `reject` at most. Half of the true returns have a
p-value above one half (Storey 2002, "A direct approach to false discovery rates"). So the returns
with such a p-value are counted, and about twice their number may be true. This number is rounded up
to a power of two, so that it seldom changes while a robot drives.
"""

from __future__ import annotations

import math
from bisect import bisect
from collections import defaultdict
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from operator import is_
from typing import TYPE_CHECKING, ClassVar, NamedTuple, TypeAlias

from ssh_abduction.data.drives import drives_of, named_steps
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.runtime.clock import LONG_TURN, look_at_clock
from ssh_abduction.theory.evidence.protocol import KEPT, Equality, Evidence
from ssh_abduction.theory.pairs import NO_PAIRS, Earlier, Pairs

if TYPE_CHECKING:
    from ssh_abduction.theory.evidence.loops import Reckoning, Steps
    from ssh_abduction.theory.evidence.together import Together
    from ssh_abduction.theory.theory import Theory

# The first and the last steps of returns to places (True) and to dstates (False).
_Tested: TypeAlias = "dict[bool, tuple[Steps, Steps]]"
# How many loops are computed at once. Their sums take some hundred megabytes.
AT_A_TIME = 200_000
# How many accepted maps are remembered. They may be checked again, or grow with the trace.
REMEMBERED = 64


@dataclass(frozen=True)
class Displacement(Evidence):
    """Evidence from displacements, with the fields `reject`, `joint` and `returns` of a theory.

    Attributes:
        reject: The largest probability of rejecting the true map.
        joint: The most returns that are tested together: 1 or 2.
        returns: How many returns may be true.
        has_places: Whether maps have places.
        turns_stay: Whether turns stay at their place. Then two visits are at one place only if
            their first steps are.
        has_one_view: Whether a dstate has only one view.
        may_be_wrong: Whether a map may treat displacements as wrong.
        known: The tested returns of the last few traces, for reuse.
    """

    name: ClassVar[str] = "displacement"
    axiom: ClassVar[str] = "one_pose"
    reject: float
    joint: int
    returns: int
    has_places: bool
    turns_stay: bool
    has_one_view: bool
    may_be_wrong: bool
    known: list[Returns] = field(default_factory=list, compare=False, repr=False)

    @classmethod
    def of(cls, theory: Theory) -> Displacement:
        topological, hard = theory.level == "topological", theory.hard
        # If displacements may be wrong, a wrong displacement between two steps excuses the pair. So
        # the pair says nothing about other steps of the same visits.
        turns_stay = "turn_stays" in hard and not theory.jumped
        return cls(
            theory.reject,
            theory.joint,
            theory.returns,
            topological,
            turns_stay,
            "functional_view" in hard and not theory.unknown_views,
            theory.jumped > 0,
        )

    def pairs(self, trace: Trace) -> Pairs:
        return self.returns_of(trace).pairs

    def refuse(self, trace: Trace, ssh_map: SSHMap, since: int = 0) -> frozenset[Equality] | None:
        if self.joint <= 1:
            return None
        wrong = jumped(ssh_map)
        refused = self.returns_of(trace.without_displacements_at(wrong)).refused_together(
            ssh_map, since
        )
        return frozenset(refused | self.believed(trace, refused, wrong)) if refused else None

    def believed(
        self, trace: Trace, returns: Collection[Equality], wrong: Collection[int]
    ) -> frozenset[Equality]:
        """Find the displacements in the loops of `returns` that a map does not treat as wrong.

        If the trace has closures, all its displacements count as in loops. The result is empty if
        the theory allows no wrong displacement.

        Args:
            trace: The trace that was mapped.
            returns: Returns that contradict the displacements.
            wrong: The steps whose displacements the map treats as wrong.
        """
        if not self.may_be_wrong:
            return frozenset()
        loops = [range(found.first + 1, found.second + 1) for found in returns]
        inside = {*range(1, len(trace))} if trace.closures else set[int]().union(*loops)
        return frozenset(Equality(t - 1, t, "displacement") for t in inside - set(wrong))

    def remembering(self, known: Displacement) -> Displacement:
        return replace(self, known=known.known)

    def count_returns(self, trace: Trace) -> int:
        """Return the number of returns that may be true, rounded up to a power of two."""
        return replace(self, returns=0).returns_of(trace).count()

    def returns_of(self, trace: Trace) -> Returns:
        """Test the returns of a trace, or return the earlier result for this trace.

        The last few traces are remembered, because several parts of a search need them. If a trace
        has grown, the results about its first steps are reused.
        """
        kept = list(self.known)
        for known in kept:
            if known.trace is trace and known.evidence == self:
                return known
        before = next(
            (k for k in reversed(kept) if k.evidence == self and _has_grown(k.trace, trace)), None
        )
        reckoning = next((known.reckoning for known in kept if known.trace is trace), None)
        found = Returns(self, trace, before, reckoning)
        with suppress(ValueError):  # another thread may have removed it
            if before is not None:
                self.known.remove(before)
            elif len(kept) >= KEPT:
                self.known.remove(kept[0])
        self.known.append(found)
        return found


def jumped(ssh_map: SSHMap) -> tuple[int, ...]:
    """Return the steps whose displacements a map treats as wrong."""
    return tuple(fault.step for fault in ssh_map.faults if fault.kind == "jumped")


def _has_grown(before: Trace, trace: Trace) -> bool:
    """Whether a trace is the same as an earlier one, perhaps with more steps."""
    last = len(before) - 1
    if last >= len(trace) or before.odometry != trace.odometry:
        return False
    old, new = before.steps[last], trace.steps[last]
    if (old.view, old.displacement, old.covariance) != (new.view, new.displacement, new.covariance):
        return False
    return all(map(is_, before.steps[:last], trace.steps[:last]))


@dataclass(frozen=True)
class Closing:
    """The error at the end of a loop, in metres and radians, with standard deviations.

    A loop is the way between two steps that may be one dstate or at one place.

    Attributes:
        way: The metres driven from the first step of the loop to its last step.
        size: The distance between the ends of the loop.
        size_sigma: The standard deviation of `size`.
        turned: The difference between the headings at the ends of the loop.
        turned_sigma: The standard deviation of `turned`.
        square_of_position: The chi-square of the position, with two degrees of freedom.
    """

    way: float
    size: float
    size_sigma: float
    turned: float
    turned_sigma: float
    square_of_position: float

    @property
    def metres(self) -> str:
        """The distance between the ends in words, such as "11.2 ± 1.4 m"."""
        return f"{self.size:.1f} ± {self.size_sigma:.1f} m"

    @property
    def degrees(self) -> str:
        """The difference between the headings in words, such as "90 ± 3 degrees"."""
        return (
            f"{abs(math.degrees(self.turned)):.0f} ± {math.degrees(self.turned_sigma):.0f} degrees"
        )


class PlacedLabels(NamedTuple):
    """The part of a map that displacements test: labels of steps, and places of dstates."""

    labels: tuple[int, ...]
    places: tuple[int | None, ...]

    @staticmethod
    def of(labels: tuple[int, ...], places: tuple[int | None, ...]) -> PlacedLabels:
        """Combine labels with places. Places of dstates above the largest label are dropped."""
        return PlacedLabels(labels, places[: max(labels, default=-1) + 1])


class Returns:
    """The possible returns of a trace (two steps at one place or dstate), and tests of them.

    The tests reject returns that do not agree with the displacements.
    """

    def __init__(
        self,
        evidence: Displacement,
        trace: Trace,
        before: Returns | None = None,
        reckoning: Reckoning | None = None,
    ) -> None:
        """Prepare the tests. If `before` has tested its steps, test the new steps now.

        `evidence` says how to test. `before` has the returns of the first steps, if known.
        """
        from ssh_abduction.theory.evidence.loops import Reckoning  # loads numpy

        self.evidence, self.trace = evidence, trace
        self.reckoning: Reckoning = reckoning or Reckoning(
            trace, before.reckoning if before else None
        )
        # Accepted maps, the last one last.
        self._accepted: dict[PlacedLabels, Together] = dict(before._accepted) if before else {}
        self._pairs: Pairs | None = before._pairs if before else None
        self._likely: int | None = before._likely if before else None
        if before and (self._pairs is not None or self._likely is not None):
            since = len(before.trace)
            tested = self._tested(since)
            if self._pairs is not None:
                self._pairs = Pairs.joined([self._pairs, self._pairs_of(tested, since)])
            if self._likely is not None:
                self._likely += self._likely_among(tested)

    @property
    def pairs(self) -> Pairs:
        """The pairs of steps that displacements show to be at different places or dstates."""
        if self._pairs is None:
            self._pairs = self._pairs_of(self._tested())
        return self._pairs

    def count(self) -> int:
        """Return the number of returns that may be true, rounded up to a power of two.

        It is twice the number of returns with a p-value above one half.
        """
        if self._likely is None:
            self._likely = self._likely_among(self._tested())
        return 1 << max(2 * self._likely - 1, 0).bit_length()

    @cached_property
    def arrivals(self) -> list[int]:
        """The first steps of visits; all steps if it is not known which actions are turns."""
        return [0, *(t for t, action in enumerate(self.trace.actions, 1) if action.kind != "turn")]

    def _tested(self, since: int = 0) -> _Tested:
        """The first and last steps of possible returns to places (True) and to dstates (False).

        Only returns that end at step `since` or later are included. Returns are left out if a
        displacement is missing on the way, or if the heading is lost.
        """
        views: dict[object, list[int]] = defaultdict(list)
        for t, step in enumerate(self.trace.steps):
            views[step.view if self.evidence.has_one_view else None].append(t)
        places = [self.arrivals] if self.evidence.has_places else []
        return {
            True: self._loops_within(places, since),
            False: self._loops_within(list(views.values()), since),
        }

    def _loops_within(self, groups: Sequence[Sequence[int]], since: int = 0) -> tuple[Steps, Steps]:
        """The first and last steps of loops that end at step `since` or later.

        Both ends of a loop are in the same group of steps. Groups are sorted.
        """
        import numpy as np

        begins = self.reckoning.begins
        found: list[tuple[Steps, Steps]] = []
        for group in groups:
            if group[-1] < since:
                continue
            steps = np.asarray(group)
            new = np.arange(np.searchsorted(steps, since), len(steps))
            starts = np.searchsorted(steps, begins[steps[new]])
            counts = new - starts
            last = np.repeat(new, counts)
            first = (
                np.arange(len(last))
                - np.repeat(np.cumsum(counts) - counts, counts)
                + np.repeat(starts, counts)
            )
            found.append((steps[first], steps[last]))
        empty = np.zeros(0, dtype=int)
        return np.concatenate([empty, *(i for i, _ in found)]), np.concatenate(
            [empty, *(j for _, j in found)]
        )

    def _pairs_of(self, tested: _Tested, since: int = 0) -> Pairs:
        """The pairs of steps that are different because displacements reject their return."""
        far = self._refused_among(*tested[True], True)
        known = self._pairs or NO_PAIRS
        elsewhere = Pairs.joined([known, Pairs.of(elsewhere=far)]).elsewhere
        implied = set(self._steps_of_visits(elsewhere, since))
        # Far fewer returns to dstates are left to test.
        first, last = tested[False]
        loops = zip(first.tolist(), last.tolist(), strict=True)
        is_open = [loop not in implied for loop in loops]
        other = self._refused_among(first[is_open], last[is_open], False)
        return Pairs.of([*implied, *other], far)

    def _likely_among(self, tested: _Tested) -> int:
        """Count the returns with a p-value above one half."""
        from scipy.special import gammainccinv

        from ssh_abduction.theory.evidence.loops import chi_squares

        loops, likely = self.reckoning.loops_of_unknown_drift(), 0
        for places, (first, last) in tested.items():
            half = 2 * gammainccinv((2 if places else 3) / 2, 0.5)
            for part in _parts(len(first)):
                squares = chi_squares(*loops.closings(first[part], last[part]))
                likely += int((squares[0 if places else 1] < half).sum())
        return likely

    def threshold(self, freedom: int, together: bool) -> float:
        """Return the chi-square above which a return, or a set of two (`together`), is rejected.

        A return to a place has 2 degrees of freedom, and a return to a dstate has 3. A set has the
        sum of its two returns.
        """
        from scipy.special import gammainccinv

        share = self.evidence.reject / (2 if self.evidence.joint > 1 else 1)
        returns = max(self.evidence.returns, 1)
        tests = returns * (returns - 1) / 2 if together else returns
        return float(2 * gammainccinv(freedom / 2, share / max(tests, 1)))

    def _refused_among(self, first: Steps, last: Steps, places: bool) -> list[tuple[int, int]]:
        """The returns to `places` (or to dstates) whose loops do not close for any drift."""
        import numpy as np

        from ssh_abduction.theory.evidence.loops import chi_squares

        most, which = self.threshold(2 if places else 3, together=False), 0 if places else 1
        drifts = [
            number for number, unlikely in enumerate(self.reckoning.unlikely) if unlikely <= most
        ]
        # First try no drift: it lets most true returns close. Then try all other drifts.
        for numbers in filter(None, (drifts[:1], drifts[1:])):
            refused = np.ones(len(first), dtype=bool)
            for part in _parts(len(first), AT_A_TIME // max(len(numbers), 1)):
                i, j = first[part], last[part]
                closings = self.reckoning.closings(
                    np.repeat(numbers, len(i)), np.tile(i, len(numbers)), np.tile(j, len(numbers))
                )
                squares = chi_squares(*closings)[which].reshape(len(numbers), len(i))
                unlikely = np.array([self.reckoning.unlikely[number] for number in numbers])
                refused[part] = (squares + unlikely[:, None] > most).all(0)
            first, last = first[refused], last[refused]
        return list(zip(first.tolist(), last.tolist(), strict=True))

    def _steps_of_visits(self, elsewhere: Earlier, since: int) -> Iterator[tuple[int, int]]:
        """Yield the pairs of steps with equal views, of visits that are at different places.

        If a dstate may have several views, all pairs of steps of such visits are yielded.
        """
        if not self.evidence.turns_stay:
            return
        end = dict(zip(self.arrivals, [*self.arrivals[1:], len(self.trace)], strict=True))
        views = self.trace.views if self.evidence.has_one_view else [None] * len(self.trace)
        for j, others in elsewhere.items():
            for t in range(max(j, since), end[j]):
                yield from (
                    (s, t) for i in others for s in range(i, end[i]) if views[s] == views[t]
                )

    def _returns_among(
        self, labels: Sequence[int], places: Sequence[int | None], since: int = 0
    ) -> Steps:
        """List returns: pairs of visits whose first steps are at one place or dstate.

        `labels` has the dstate of each step, and `places` the place. Each row has the first step,
        the last step, and 1 for a dstate or 0 for a place, by last step.
        """
        import numpy as np

        at_dstate: dict[int, list[int]] = defaultdict(list)
        at_place: dict[int | None, list[int]] = defaultdict(list)
        for t in self.arrivals:
            if t < len(labels):
                at_dstate[labels[t]].append(t)
                at_place[places[t]].append(t)
        at_place.pop(None, None)
        found = []
        for groups, one_dstate in ((at_dstate, True), (at_place, False)):
            first, last = self._loops_within(list(groups.values()), since)
            found.append(np.stack([first, last, np.full(len(first), one_dstate)], axis=1))
        rows = np.concatenate(found)
        ordered: Steps = rows[np.argsort(rows[:, 1], kind="stable")]
        return ordered

    def refused_together(self, ssh_map: SSHMap, since: int = 0) -> frozenset[Equality] | None:
        """Find two returns of a map that are rejected together; None if there are none.

        Return the two that are rejected most clearly. The map of the first `since` steps is known
        to be accepted, so only returns that end later are tested.
        """
        import numpy as np

        labels, places = ssh_map.dstate_at, tuple(s.place for s in ssh_map.dstates)
        tested = PlacedLabels.of(labels, places)
        if tested in self._accepted:
            return None
        before = self._accepted.pop(PlacedLabels.of(labels[:since], places), None)
        at = [places[label] for label in labels]
        rows = self._returns_among(labels, at, since if before else 0)
        if before:
            rows = np.concatenate([before.rows, rows])
        together = self._together(rows, before)
        refused = together.worst(since)
        if refused is not None:
            return refused
        self._accepted[tested] = together
        if len(self._accepted) > REMEMBERED:
            del self._accepted[next(iter(self._accepted))]
        return None

    def refused_at(
        self, labels: Sequence[int], places: Sequence[int | None], step: int
    ) -> frozenset[Equality] | None:
        """Find the two returns that are rejected most clearly together, but not one by one.

        The later return ends at `step`. `labels` has the dstate of each step, and `places`
        the place. They need not be those of a map.
        """
        alone = self.pairs
        rows = self._returns_among(labels[: step + 1], places)
        refused = [
            i in (alone.apart if one_dstate else alone.elsewhere).get(j, ())
            for i, j, one_dstate in rows.tolist()
        ]
        rows = rows[[not is_refused for is_refused in refused]]
        return self._together(rows).worst(step)

    def refused_alone_at(
        self, labels: Sequence[int], places: Sequence[int | None], step: int
    ) -> list[Equality]:
        """List the returns that end at a step and are rejected alone, by dstates and places."""
        elsewhere = [
            Equality(i, step, "place")
            for i in self.pairs.elsewhere.get(step, ())
            if places[i] == places[step] is not None
        ]
        return elsewhere + [
            Equality(i, step) for i in self.pairs.apart.get(step, ()) if labels[i] == labels[step]
        ]

    def excess(self, refused: Equality) -> float:
        """Return the chi-square of a return minus the threshold above which it is rejected."""
        import numpy as np

        from ssh_abduction.theory.evidence.loops import chi_squares

        first, last, which = refused.first, refused.second, int(refused.of == "dstate")
        squares = chi_squares(
            *self.reckoning.loops_of_unknown_drift().closings(np.array([first]), np.array([last]))
        )
        return float(squares[which][0]) - self.threshold(2 + which, together=False)

    def why_apart(self, first: int, last: int, names: Sequence[int] = ()) -> str | None:
        """Say in words why two steps are not one dstate or place; None if displacements allow it.

        `names` says what to call the steps; it is empty if this is the whole trace.
        """
        names = names or named_steps(drives_of(self.trace), len(self.trace))
        named = f"steps {names[first]} and {names[last]}"
        # Places are compared by the first steps of their visits.
        i, j = self._begin_of_visit(first), self._begin_of_visit(last)
        if i in self.pairs.elsewhere.get(j, ()):
            they = (
                "they"
                if (i, j) == (first, last)
                else f"steps {names[i]} and {names[j]}, where their visits begin,"
            )
            return (
                f"{named} are not at one place: by the odometry {they} are "
                f"{self.closing(i, j).metres} apart"
            )
        if first not in self.pairs.apart.get(last, ()):
            return None
        closing = self.closing(first, last)
        far, turned = (
            closing.square_of_position > self.threshold(2, False),
            (closing.turned / closing.turned_sigma) ** 2 > self.threshold(1, False),
        )
        if turned and not far:
            return (
                f"{named} are not one dstate: by the odometry their headings are "
                f"{closing.degrees} apart"
            )
        off = closing.metres if far else f"{closing.metres} and {closing.degrees}"
        return f"{named} are not one dstate: by the odometry they are {off} apart"

    def why_not_both(self, returns: Collection[Equality], names: Sequence[int]) -> str:
        """Say in words why two returns cannot both be true."""
        ordered = sorted(returns, key=lambda e: (e.second, e.first, e.of))
        closings = [self.closing(e.first, e.second) for e in ordered]
        named = ", and ".join(f"steps {names[e.first]} and {names[e.second]}" for e in ordered)
        ways = " and ".join(f"{closing.way:.0f} m" for closing in closings)
        sizes = " and ".join(f"{closing.size:.1f} m" for closing in closings)
        turned = [
            abs(math.degrees(closing.turned))
            for e, closing in zip(ordered, closings, strict=True)
            if e.of == "dstate"
        ]
        headings = (
            f", and {' and '.join(f'{angle:.0f}' for angle in turned)} degrees in heading"
            if any(map(round, turned))
            else ""
        )
        return f"{named} cannot both be returns: the loops of {ways} close {sizes} off{headings}"

    def closing(self, first: int, last: int) -> Closing:
        """Return the error at the end of a loop. A drift of heading counts as uncertainty."""
        import numpy as np

        from ssh_abduction.theory.evidence.loops import chi_squares

        loops = self.reckoning.loops_of_unknown_drift()
        off, covariance = loops.closings([first], [last])
        size = float(np.hypot(*off[0, :2]))
        along = off[0, :2] / size if size else np.array([1.0, 0.0])
        return Closing(
            way=float(loops.bent[last, 2] - loops.bent[first, 2]),
            size=size,
            size_sigma=math.sqrt(along @ covariance[0, :2, :2] @ along),
            turned=float(off[0, 2]),
            turned_sigma=math.sqrt(covariance[0, 2, 2]),
            square_of_position=float(chi_squares(off, covariance)[0][0]),
        )

    def _begin_of_visit(self, step: int) -> int:
        """The first step of a step's visit; the step itself if turns may leave places."""
        return self.arrivals[bisect(self.arrivals, step) - 1] if self.evidence.turns_stay else step

    def _together(self, rows: Steps, before: Together | None = None) -> Together:
        from ssh_abduction.theory.evidence.together import Together  # loads numpy

        thresholds = {freedom: self.threshold(freedom, together=True) for freedom in (4, 5, 6)}
        return Together(self.reckoning, thresholds, rows, before)


def _parts(size: int, most: int = AT_A_TIME) -> Iterator[slice]:
    """Yield slices of at most `most` loops, so that each part fits into memory."""
    for start in range(0, size, most):
        look_at_clock(LONG_TURN)
        yield slice(start, start + most)
