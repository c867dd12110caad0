"""A lower bound on the cost of a long trace with faults, from disjoint blocks of its steps.

The faulty engine (`engines/faulty.py`) uses this bound. It holds for every map of the trace.

Take a map of the whole trace with N dstates. Restricted to a block of steps, it is a map of that
block with at most N dstates. So its faults in the block cost at least as much as the cheapest
faults of any map of the block with at most N dstates. Blocks that share no step add up:

    cost  >=  least over N of  (10 N + sum over blocks of the least faults with N dstates)

The blocks may differ for each N. With few dstates, short blocks already need a fault, and the trace
has many such blocks. With many dstates only long blocks need a fault, but the dstates alone cost
much.

A block needs a fault if it would otherwise contain a clique of more than N steps. A clique is a set
of steps that are pairwise different dstates (`steps/apart.py`).
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from ssh_abduction.solver.asp.limits import Watch
from ssh_abduction.solver.steps.apart import Continuations

# A block may be one step longer than the shortest one, and one more step longer for each COARSE
# dstates that it has beyond those of the known map.
COARSE = 5


@dataclass
class Blocks:
    """Lower bounds on the cost of a trace, found with the help of a known map.

    The kinds of fault are "misread" (a wrong view) and "slipped" (an action that failed).

    Attributes:
        seen: The observation at each step, as an integer.
        actions: The action after each step but the last, as an integer.
        price: For each kind of fault that is allowed, its cost at each step in tenths of dstates.
        faults: For each kind, the steps at which the known map has a fault, in order.
        dstates: The number of dstates of the known map.
    """

    seen: Sequence[int]
    actions: Sequence[int]
    price: Mapping[str, Sequence[int]]
    faults: Mapping[str, Sequence[int]]
    dstates: int
    watch: Watch

    @property
    def cost(self) -> int:
        """The cost of the known map, in tenths of dstates."""
        faults = ((kind, t) for kind, found in self.faults.items() for t in found)
        return 10 * self.dstates + sum(self.price[kind][t] for kind, t in faults)

    def bound(self) -> int:
        """Return a lower bound on the cost of all maps, in tenths; at most the known map's cost."""
        bound = self.cost
        most = -(-bound // 10) - 1  # the dstates of a larger map alone cost this bound
        while most > 0:
            least = self.least_faults(most)
            bound = min(bound, 10 * most + least)
            # With fewer dstates faults cost at least as much. So skip all numbers of dstates that,
            # with the cost of these faults, already reach the bound.
            most = min(most, -(-(bound - least) // 10)) - 1
        return bound

    def least_faults(self, most: int) -> int:
        """Return a lower bound, in tenths, on the faults of maps with at most `most` dstates.

        The trace is divided into blocks from its first step on. Each block ends as soon as it needs
        a fault. The least costs of the faults of all blocks are added up.
        """
        total = begin = 0
        steps = len(self.seen)
        places = sorted(step for found in self.faults.values() for step in found)
        reach = 0  # how many steps after a fault the last block ended
        while begin < steps:
            following = begin
            if most >= self.dstates:  # then a block in which the known map has no fault needs none
                number = bisect_left(places, begin)
                if number == len(places):
                    return total
                following = places[number]
            end = self._shortest(begin, following, reach, most)
            if end is None:
                return total
            reach = end - following
            total += min(
                min(price[begin : end - (kind == "slipped")]) for kind, price in self.price.items()
            )
            begin = end
        return total

    def _shortest(self, begin: int, fault: int, reach: int, most: int) -> int | None:
        """Return the end of a short block that begins at `begin` and needs a fault.

        The end is the step after the block. The block includes the step `fault`, and is at most a
        few steps longer than needed. The search starts at the expected end, `reach` steps after
        `fault`. Returns None if even the block to the end of the trace needs no fault.
        """
        steps = len(self.seen)
        exact = 1 + max(most - self.dstates, 0) // COARSE
        low, high, stride = max(fault, begin + most), max(fault + reach, begin + most + 1), exact
        while not self._takes_fault(begin, min(high, steps), most):
            if high >= steps:
                return None
            low, high, stride = high, high + stride, 2 * stride
        high = min(high, steps)
        if high - 2 * exact > low and not self._takes_fault(begin, high - 2 * exact, most):
            low = high - 2 * exact
        while high - low > exact:
            middle = (low + high) // 2
            if self._takes_fault(begin, middle, most):
                high = middle
            else:
                low = middle
        return high

    def _takes_fault(self, begin: int, end: int, most: int) -> bool:
        """Whether a block of steps needs a fault: more than `most` of its steps differ pairwise."""
        self.watch.check()
        return (
            end - begin > most
            and len(Continuations(self.seen[begin:end], self.actions[begin : end - 1]).clique())
            > most
        )
