"""A bound for long traces with faults, by disjoint blocks of steps.

Let a map of the whole trace have N dstates. Cut down to a block of steps it is a map of that block, with N dstates at most. So what faults it has in a block cost at least as
much as the block takes with N dstates, and blocks that share no step add up:

    cost  >=  least over N of  (10 N + sum over blocks of the least faults with N dstates)

The blocks may be other ones for each N. With few dstates short blocks take a fault, and there are many of them; with many dstates a block has to be long to take one, but then
the dstates alone cost much. That one block takes a fault is shown by steps that are pairwise apart if it had none: a clique of more than N (`steps/apart.py`). Where faults of a
known map are so near to each other that no clique tells them apart, clingo is asked whether the block has a cheaper map of N dstates.
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

MARGIN = 3  # Such a block begins and ends so many times as many steps from the faults as there may be dstates, if there is room.
COARSE = 5  # The shortest block is sought to a step, and to one more for each so many dstates that are asked for beyond those of the known map.
MOST_STEPS = 200  # Clingo is asked of blocks up to this length,
MOST_NAMES = 80  # and only with so few names for dstates, those of all views together.
CONFLICTS = 20_000  # After so many conflicts a question is left open.


@dataclass
class Blocks:
    """Bounds of a trace, by what a known map says of it.

    seen, actions  as integers
    price          tenths of dstates for each kind of fault that may be, at each step
    faults         the steps of the faults of the known map, by kind
    dstates        how many dstates it has
    """

    seen: Sequence[int]
    actions: Sequence[int]
    price: Mapping[str, Sequence[int]]
    faults: Mapping[str, Sequence[int]]
    dstates: int
    watch: Watch
    _proven: dict[tuple[int, int], tuple[int, int]] = field(
        default_factory=dict
    )  # of blocks, with how many dstates which cost is proven

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
            most = (
                min(most, -(-(bound - least) // 10)) - 1
            )  # the same blocks do for all numbers in between
        return bound

    def least_faults(self, most: int) -> int:
        """What faults cost, at least, in maps of so many dstates at most: the sum of blocks, from the left, each as short as it takes."""
        total = begin = 0
        steps, places = (
            len(self.seen),
            sorted(step for found in self.faults.values() for step in found),
        )
        reach = 0  # how far behind a fault the last block ended
        while begin < steps:
            following = begin
            if most >= self.dstates:  # the known map shows that there is none before its next fault
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
        """The end of the shortest block from here that takes a fault; None where all steps that are left do not."""
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
        """Whether without a fault these steps take more dstates than so many."""
        self.watch.check()
        return (
            end - begin > most
            and len(Continuations(self.seen[begin:end], self.actions[begin : end - 1]).clique())
            > most
        )

    def _wider(
        self, begin: int, end: int, places: Sequence[int], most: int
    ) -> tuple[int, int] | None:
        """The end of a wider block, where faults of the known map are too near to each other for blocks of their own, and what these cost; None where that is not proven."""
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
        """Whether these steps have no map of so many dstates whose faults cost no more than this. With one name more for each view than there may be dstates, none of them is the rest."""
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
        """What the known map's faults cost among these steps, and the links between them."""
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
