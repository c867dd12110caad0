"""A lower bound for long traces with faults, by disjoint blocks of steps.

This serves the faulty engine (`engines/faulty.py`). The bound holds for each map of the trace.

Let a map of the whole trace have N dstates. Cut down to a block of steps it is a map of that block,
with N dstates at most. So its faults in the block cost at least as much as any map of the block
with N dstates needs. Blocks that share no step add up:

    cost  >=  least over N of  (10 N + sum over blocks of the least faults with N dstates)

The blocks may be other ones for each N. With few dstates short blocks take a fault, and there are
many of them. With many dstates a block has to be long to take one, but then the dstates alone cost
much. A block takes a fault if more than N of its steps would be pairwise distinct without one
(a clique, `steps/apart.py`). If faults of a known map are too near to each other for that, clingo
is asked whether the block has a cheaper map of N dstates.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from ssh_abduction.solver.asp.control import Asker, Control
from ssh_abduction.solver.asp.facts import faulty_lp
from ssh_abduction.solver.asp.facts.atoms import numbers
from ssh_abduction.solver.asp.limits import Watch
from ssh_abduction.solver.steps.apart import Continuations
from ssh_abduction.theory.evidence import Pairs

# For each possible dstate, a block for clingo begins and ends this many more steps from the faults,
# if there is room.
MARGIN = 3
# Find the length of the shortest block to within a step, and one more step for each COARSE dstates
# more than the known map has.
COARSE = 5
# Ask clingo only about blocks up to this length, with at most this many names for dstates.
MOST_STEPS = 200
MOST_NAMES = 80
CONFLICTS = 20_000  # After this many conflicts a question is left open.


@dataclass
class Blocks:
    """Lower bounds on the cost of a trace, found with the help of a known map.

    Attributes:
        seen: The observation at each step, as an integer.
        actions: The action after each step, as an integer.
        price: Tenths of dstates for each kind of fault that is allowed, at each step.
        faults: The steps of the faults of the known map, by kind.
        dstates: How many dstates the known map has.
        watch: The limits.
    """

    seen: Sequence[int]
    actions: Sequence[int]
    price: Mapping[str, Sequence[int]]
    faults: Mapping[str, Sequence[int]]
    dstates: int
    watch: Watch
    # The proven costs, by block and number of dstates.
    _proven: dict[tuple[int, int], tuple[int, int]] = field(default_factory=dict)

    @property
    def cost(self) -> int:
        """Tenths of dstates that the known map costs."""
        return 10 * self.dstates + self._known_cost(0, len(self.seen))

    def bound(self) -> int:
        """Tenths of dstates that any map costs, at least; no more than the known map does."""
        bound = self.cost
        most = -(-bound // 10) - 1  # a map of more dstates costs as much by these alone
        while most > 0:
            least = self.least_faults(most)
            bound = min(bound, 10 * most + least)
            # The same blocks serve all numbers in between.
            most = min(most, -(-(bound - least) // 10)) - 1
        return bound

    def least_faults(self, most: int) -> int:
        """What the faults cost, at least, in maps of at most this many dstates.

        This is the sum over blocks from the left, each as short as possible.
        """
        total = begin = 0
        steps, places = (
            len(self.seen),
            sorted(step for found in self.faults.values() for step in found),
        )
        reach = 0  # how far behind a fault the last block ended
        while begin < steps:
            following = begin
            if most >= self.dstates:  # the known map has no block before its next fault
                number = bisect_left(places, begin)
                if number == len(places):
                    return total
                following = places[number]
            end = self._shortest(begin, following, reach, most)
            if end is None:
                return total
            reach = end - following
            if most >= self.dstates and (wider := self._wider(begin, end, places, most)):
                end, least = wider
            else:
                least = self._least_price(begin, end)
            total += least
            begin = end
        return total

    def _shortest(self, begin: int, fault: int, reach: int, most: int) -> int | None:
        """The end of the shortest block from here that takes a fault; None if there is none."""
        steps = len(self.seen)
        exact = 1 + max(most - self.dstates, 0) // COARSE
        low, high, stride = max(fault, begin + most), max(fault + reach, begin + most + 1), exact
        while not self._takes_fault(begin, min(high, steps), most):
            if high >= steps:
                return None
            low, high, stride = high, high + stride, 2 * stride
        high = min(high, steps)
        low = max(low, high - 2 * exact) if self._fails(begin, high - 2 * exact, low, most) else low
        while high - low > exact:
            middle = (low + high) // 2
            if self._takes_fault(begin, middle, most):
                high = middle
            else:
                low = middle
        return high

    def _fails(self, begin: int, end: int, low: int, most: int) -> bool:
        """Whether a block that ends here, behind `low`, takes no fault."""
        return end > low and not self._takes_fault(begin, end, most)

    def _takes_fault(self, begin: int, end: int, most: int) -> bool:
        """Whether these steps need more dstates than `most` if they have no fault."""
        self.watch.check()
        return (
            end - begin > most
            and len(Continuations(self.seen[begin:end], self.actions[begin : end - 1]).clique())
            > most
        )

    def _wider(
        self, begin: int, end: int, places: Sequence[int], most: int
    ) -> tuple[int, int] | None:
        """A wider block, if faults of the known map are too close for blocks of their own.

        Returns:
            The end of the block, and what its faults cost; None if that is not proven.
        """
        first = behind = bisect_left(places, begin)
        while behind < len(places) and places[behind] < max(
            end, places[behind - 1] + most + 1 if behind > first else 0
        ):
            behind += 1
        if behind - first < 2:
            return None
        after = places[behind] if behind < len(places) else len(self.seen)
        end = max(
            end, min((places[behind - 1] + after + 1) // 2, places[behind - 1] + MARGIN * most)
        )
        begin = max(begin, places[first] - MARGIN * most)
        known = self._known_cost(begin, end)
        if (
            end - begin > MOST_STEPS
            or most * len(set(self.seen[begin:end])) > MOST_NAMES
            or not self._refuted(begin, end, most, known - 1)
        ):
            return None
        return end, known

    def _refuted(self, begin: int, end: int, most: int, tenths: int) -> bool:
        """Whether no map of these steps has at most these dstates and this cost of faults.

        Each view has one name more than there may be dstates, so no dstate is at the rest.

        Args:
            begin: The first step.
            end: The step after the last one.
            most: How many dstates.
            tenths: What the faults cost at most.
        """
        proven = self._proven.get((begin, end))
        if proven is None or proven[0] < most or proven[1] < tenths:
            seen, actions = self.seen[begin:end], self.actions[begin : end - 1]
            asker = Asker(self.watch)
            asker.control = Control((), self.watch.check)
            asker.control.load_encodings("faulty")
            price = {kind: found[begin:end] for kind, found in self.price.items()}
            full = {
                t + near - begin
                for found in self.faults.values()
                for t in found
                for near in (-1, 0, 1)
            }
            told = faulty_lp.faulty_batch(
                0, seen, actions, range(len(seen)), (), Pairs(), price, full
            )
            base = faulty_lp.faulty_base(
                actions, dict.fromkeys(sorted(set(seen)), most), self.price
            )
            asker.control.add(
                "base",
                [],
                "\n".join([base, told, faulty_lp.dstates_and_faults_up_to(most, tenths)]),
            )
            asker.control.ground([("base", [])])
            asker.control.ground([("more", numbers(0))])
            answer, core = asker.verdict(lambda _: True, [], CONFLICTS)
            if answer or core is None:
                return False
            self._proven[begin, end] = most, tenths
        return True

    def _known_cost(self, begin: int, end: int) -> int:
        """What the known map's faults cost at these steps and at the links between them."""
        last = {"misread": end, "slipped": end - 1}
        return sum(
            sum(
                self.price[kind][t]
                for t in found[bisect_left(found, begin) : bisect_right(found, last[kind] - 1)]
            )
            for kind, found in self.faults.items()
        )

    def _least_price(self, begin: int, end: int) -> int:
        return min(
            min(found[begin : end - (kind == "slipped")]) for kind, found in self.price.items()
        )
