"""Explain a trace by the dstates and links of a map, with the cheapest faults.

A Viterbi pass (Viterbi 1967) finds the labels with the cheapest faults. Actions without a link get
one to where the labels go most often, and the pass is repeated.

>>> seen = [t % 4 for t in range(60)]
>>> seen[30] = 0
>>> explainer = Explainer(seen, [0] * 59, {"misread": [15] * 60})
>>> found = explainer.completed(PartialMachine([0, 1, 2, 3], {(0, 0): 1, (1, 0): 2, (2, 0): 3}))
>>> found.machine.goes[3, 0], found.misread, found.slips, found.tenths
(0, (30,), (), 55)
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.runtime.clock import look_at_clock

NEVER = 1_000_000  # the cost of a forbidden fault
UNKNOWN = 0.5  # the cost of an unknown link, in tenths of dstates: less than any fault


@dataclass(frozen=True)
class PartialMachine:
    """Dstates with their views, and links. An action at a dstate need not have a link.

    Attributes:
        shows: The view of each dstate.
        goes: For each (dstate, action) with a link, the dstate that it leads to.
    """

    shows: Sequence[int]
    goes: Mapping[tuple[int, int], int]


@dataclass(frozen=True)
class Explained:
    """An explanation of a trace by a machine: labels, and the faults that they imply.

    Attributes:
        misread: The steps whose views are treated as wrong.
        slips: The steps whose actions are treated as wrong.
        unknown: The steps whose actions have no link in the machine.
        tenths: The cost of dstates and faults, in tenths of dstates.
    """

    machine: PartialMachine
    labels: Sequence[int]
    misread: Sequence[int]
    slips: Sequence[int]
    unknown: Sequence[int]
    tenths: int

    @property
    def faults(self) -> Sequence[int]:
        return (*self.misread, *self.slips)


@dataclass(frozen=True)
class Explainer:
    """Explains a trace by machines with the cheapest faults, and improves machines.

    Attributes:
        seen: The view of each step, numbered from 0.
        actions: The action after each step but the last, numbered from 0.
        price: For each allowed kind of fault ("misread", "slipped"), its cost at each step, in
            tenths of dstates.
    """

    seen: Sequence[int]
    actions: Sequence[int]
    price: Mapping[str, Sequence[int]]

    def explained(self, machine: PartialMachine) -> Explained:
        """Find the labels with the cheapest faults for a machine, by a Viterbi pass.

        An action without a link may lead to any dstate.
        """
        steps, count = len(self.seen), len(machine.shows)
        slip, misread = (
            np.array(self.price.get(kind, [NEVER] * steps), dtype=float)
            for kind in ("slipped", "misread")
        )
        known = np.zeros((max(self.actions, default=0) + 1, count), dtype=bool)
        target = np.zeros(known.shape, dtype=int)
        for (s, action), x in machine.goes.items():
            known[action, s], target[action, s] = True, x
        wrong = np.array(machine.shows)[None, :] != np.arange(max(self.seen) + 1)[:, None]
        free = [np.flatnonzero(~row) for row in known]
        led = [np.flatnonzero(row) for row in known]
        spent = wrong[self.seen[0]] * misread[0]
        came = np.zeros((steps, count), dtype=np.int32)
        for t in range(1, steps):
            if t % 500 == 0:
                look_at_clock()
            action = self.actions[t - 1]
            # There are three ways to reach a dstate: by a slip from the cheapest dstate, from the
            # cheapest dstate without a link for this action, or by a link.
            cheapest = int(spent.argmin())
            now = np.full(count, spent[cheapest] + slip[t - 1])
            came[t] = cheapest
            if len(free[action]):
                begin = int(free[action][spent[free[action]].argmin()])
                better = spent[begin] + UNKNOWN < now
                came[t][better], now[better] = begin, spent[begin] + UNKNOWN
            # If several links lead to one dstate, the cheapest one is written last.
            order = led[action][np.argsort(-spent[led[action]], kind="stable")]
            best = np.full(count, np.inf)
            source = np.zeros(count, dtype=np.int32)
            best[target[action, order]], source[target[action, order]] = spent[order], order
            better = best <= now
            came[t][better], now[better] = source[better], best[better]
            spent = now + wrong[self.seen[t]] * misread[t]
        return self._explained(machine, _traced_back(int(spent.argmin()), came))

    def completed(self, machine: PartialMachine) -> Explained:
        """Add links to a machine until no step of the trace lacks one, and explain the trace by it.

        An action without a link gets one to the dstate that follows most often in the labels.
        """
        explained = self.explained(machine)
        while explained.unknown:
            votes: dict[tuple[int, int], Counter[int]] = {}
            for t in explained.unknown:
                votes.setdefault((explained.labels[t], self.actions[t]), Counter())[
                    explained.labels[t + 1]
                ] += 1
            led = {key: counts.most_common(1)[0][0] for key, counts in votes.items()}
            machine = PartialMachine(machine.shows, {**machine.goes, **led})
            explained = self.explained(machine)
        return explained

    def _explained(self, machine: PartialMachine, labels: Sequence[int]) -> Explained:
        """Make an explanation of given labels: find their faults, and add up the cost."""
        # A step is at fault if its view, or where its action leads, differs from the machine.
        misread = [t for t, s in enumerate(labels) if machine.shows[s] != self.seen[t]]
        leads = [
            machine.goes.get((s, action)) for s, action in zip(labels, self.actions, strict=False)
        ]
        unknown = [t for t, x in enumerate(leads) if x is None]
        slips = [t for t, x in enumerate(leads) if x is not None and x != labels[t + 1]]
        paid = sum(self._cost("misread", t) for t in misread) + sum(
            self._cost("slipped", t) for t in slips
        )
        return Explained(
            machine,
            labels,
            tuple(misread),
            tuple(slips),
            tuple(unknown),
            10 * len(set(labels)) + paid,
        )

    def _cost(self, kind: str, step: int) -> int:
        """Return the cost of a fault in tenths of dstates; `NEVER` if the kind is not allowed."""
        return self.price[kind][step] if kind in self.price else NEVER


def _traced_back(last: int, came: NDArray[np.int32]) -> list[int]:
    """List the states of all steps. `came` has the state before each state, (steps, states)."""
    states = [last]
    for before in came[:0:-1]:
        states.append(int(before[states[-1]]))
    return states[::-1]
