"""A lower bound on the cost of a long trace with faults, from disjoint blocks of its steps.

The faulty engine (`faulty.py`) uses this bound. It holds for every map of the trace.

Take a map of the whole trace with N dstates. Restricted to a block of steps, it is a map of that
block with at most N dstates. So its faults in the block cost at least as much as the cheapest
faults of any map of the block with at most N dstates. Blocks that share no step add up:

    cost  >=  least over N of  (10 N + sum over blocks of the least faults with N dstates)

The blocks may differ for each N. With few dstates, short blocks already need a fault, and the trace
has many such blocks. With many dstates only long blocks need a fault, but the dstates alone cost
much.

A block needs a fault if it would otherwise contain a clique of more than N steps. A clique is a set
of steps that are pairwise different dstates (`steps/apart.py`). Several faults of the known map
may be too close for a block each. Then clingo is asked whether a block around all of them has a
cheaper map with at most N dstates.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from ssh_abduction.solver.asp.control import Asker, new_control
from ssh_abduction.solver.asp.facts import number_symbols
from ssh_abduction.solver.asp.limits import Watch
from ssh_abduction.solver.sources.exact.faulty_program import (
    dstates_and_faults_up_to,
    faulty_base,
    faulty_batch,
)
from ssh_abduction.solver.steps.apart import Continuations
from ssh_abduction.theory.evidence import Pairs

# A block for clingo extends beyond its faults by up to this many steps for each dstate of the map.
MARGIN = 3
# A block may be one step longer than the shortest one, and one more step longer for each COARSE
# dstates that it has beyond those of the known map.
COARSE = 5
# Ask clingo only about blocks up to this length, with at most this many names for dstates.
MOST_STEPS = 200
MOST_NAMES = 80
CONFLICTS = 20_000  # give up a question to clingo after this many conflicts


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
    # For each block (begin, end) that clingo refuted: limits on dstates, and on the cost of faults
    # in tenths, within which the block has no map.
    _proven: dict[tuple[int, int], tuple[int, int]] = field(default_factory=dict)

    @property
    def cost(self) -> int:
        """The cost of the known map, in tenths of dstates."""
        return 10 * self.dstates + self._known_cost(0, len(self.seen))

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
            if most >= self.dstates and (wider := self._wider(begin, end, places, most)):
                end, least = wider
            else:
                least = min(
                    min(price[begin : end - (kind == "slipped")])
                    for kind, price in self.price.items()
                )
            total += least
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

    def _wider(
        self, begin: int, end: int, places: Sequence[int], most: int
    ) -> tuple[int, int] | None:
        """Widen a block to include the next faults of the known map, if they are close together.

        Returns the end of the wider block and the cost of these faults in tenths; None if there are
        no such faults, or no proof that this cost is the least.
        """
        # Take the faults before `end`, and each that follows the last one within `most` steps.
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
        """Whether clingo proves that a block has no map within two limits.

        The limits are `most` dstates, and faults that cost `tenths`.
        """
        proven = self._proven.get((begin, end))
        if proven is None or proven[0] < most or proven[1] < tenths:
            seen, actions = self.seen[begin:end], self.actions[begin : end - 1]
            price = {kind: found[begin:end] for kind, found in self.price.items()}
            # Near guessed faults, an answer names the dstate even of a misread step.
            full = {
                t + near - begin
                for found in self.faults.values()
                for t in found
                for near in (-1, 0, 1)
            }
            batch = faulty_batch(0, seen, actions, range(len(seen)), (), Pairs(), price, full)
            base = faulty_base(actions, dict.fromkeys(sorted(set(seen)), most), self.price)
            limits = dstates_and_faults_up_to(most, tenths)
            asker = Asker(self.watch)
            asker.control = new_control(
                "faulty", "\n".join([base, batch, limits]), check=self.watch.check
            )
            asker.control.ground([("more", number_symbols(0))])
            if not _has_no_answer(asker):
                return False
            self._proven[begin, end] = most, tenths
        return True

    def _known_cost(self, begin: int, end: int) -> int:
        """Add up the cost of the known map's faults in a block, in tenths of dstates."""
        last = {"misread": end, "slipped": end - 1}
        return sum(
            sum(
                self.price[kind][t]
                for t in found[bisect_left(found, begin) : bisect_right(found, last[kind] - 1)]
            )
            for kind, found in self.faults.items()
        )


def _has_no_answer(asker: Asker) -> bool:
    """Whether clingo proves within CONFLICTS conflicts that a control has no answer."""
    answers = asker.answers(lambda _: True, "ignore", 1, conflicts=CONFLICTS)
    try:
        return not next(answers)
    except StopIteration as end:
        return bool(end.value)
