"""Guess small maps of the causal theory with faults, without a search or a proof.

A hidden Markov model is trained on the trace by EM (Baum, Petrie, Soules, Weiss 1970). Each state
shows one view, and several states show the same view (cloned hidden Markov models: George et al.
2021). There are small probabilities that a view is misread and that an action slips. The most
probable state of each step is its first label, that is, its dstate.

A map is then read off the labels: a dstate shows the majority view of its steps, and an action
leads where it leads most often. A Viterbi pass (Viterbi 1967) finds new labels with the cheapest
faults for this map. These two steps are repeated while the cost falls.

>>> seen = [t % 4 for t in range(60)]
>>> seen[30] = 0
>>> explainer = Explainer(seen, [0] * 59, {"misread": [15] * 60})
>>> guess = next(filter(None, robust_maps(explainer)))
>>> len(set(guess.labels)), guess.misread, guess.slips, guess.tenths
(4, (30,), (), 55)
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.data.groups import numbered
from ssh_abduction.runtime.clock import look_at_clock

# The number of states of each view, for each start of EM. With more states than needed, EM finds
# better optima.
CLONES = (4, 10, 16, 10, 16, 10, 16, 10)
AGREE = 2  # stop after this many starts that reach the cheapest map
ROUNDS = 100  # the most EM steps of a start
ENOUGH = 1e-4  # stop EM below this gain in log-likelihood per step of the trace
PSEUDOCOUNT = 2e-3  # added to all counts, as by George et al.
MISREAD, SLIPPED = 0.01, 0.01  # probabilities of faults in the model
# While a map is refined, a fault that is forbidden costs this many times as much as an allowed one.
# The last pass can replace a few of them by allowed faults.
DEARER = 4 / 3
NEVER = 1_000_000  # the cost of a forbidden fault in the final Viterbi pass
UNKNOWN = 0.5  # the cost of an unknown link, in tenths of dstates: less than any fault

Floats = NDArray[np.float64]


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

    def read_off(self, labels: Sequence[int]) -> PartialMachine:
        """Make a machine from labels.

        A dstate gets the view that is most expensive to treat as misread. An action leads where it
        leads most often.
        """
        labels = numbered(labels)
        views: list[Counter[int]] = [Counter() for _ in range(max(labels) + 1)]
        ends: dict[tuple[int, int], Counter[int]] = {}
        trust = self.price.get("misread")
        for t, label in enumerate(labels):
            views[label][self.seen[t]] += trust[t] if trust else 1
        for t, action in enumerate(self.actions):
            ends.setdefault((labels[t], action), Counter())[labels[t + 1]] += 1
        return PartialMachine(
            [found.most_common(1)[0][0] for found in views],
            {key: found.most_common(1)[0][0] for key, found in ends.items()},
        )

    def refined(self, labels: Sequence[int]) -> Explained:
        """Find a cheap explanation near these labels, by local search.

        Make a machine from the labels, explain the trace by it, and repeat this while the cost
        falls.
        """
        best = self.completed(self.read_off(labels))
        while (better := self.completed(self.read_off(best.labels))).tenths < best.tenths:
            best = better
        return best

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


def robust_maps(explainer: Explainer) -> Iterator[Explained | None]:
    """Yield an explanation for each start of EM; None if it costs no less than earlier ones."""
    rng = np.random.default_rng(0)
    dearer = [round(DEARER * max(found)) for found in zip(*explainer.price.values(), strict=True)]
    soft = replace(explainer, price={"misread": dearer, "slipped": dearer, **explainer.price})
    best, agreed = NEVER, 0
    for clones in CLONES:
        guess = explainer.completed(soft.refined(_Model(soft, clones, rng).labels()).machine)
        agreed = (
            agreed + 1
            if guess.tenths == best
            else agreed * (guess.tenths > best) + (guess.tenths < best)
        )
        yield guess if guess.tenths < best else None
        best = min(best, guess.tenths)
        if agreed == AGREE:
            return


class _Model:
    """A cloned hidden Markov model of a trace. Its arrays are (actions, states, next states)."""

    def __init__(self, explainer: Explainer, clones: int, rng: np.random.Generator) -> None:
        self._explainer = explainer
        seen, views = np.array(explainer.seen), max(explainer.seen) + 1
        self._shows = np.repeat(np.arange(views), clones)
        self._sees = np.where(
            self._shows == np.arange(views)[:, None], 1 - MISREAD, MISREAD / max(views - 1, 1)
        )[seen]
        self._actions = np.array(explainer.actions, dtype=int)
        self._chances = self._normal(
            rng.random((self._actions.max(initial=0) + 1, len(self._shows), len(self._shows)))
        )

    def labels(self) -> list[int]:
        """Train the model, and return the most probable state of each step."""
        before = -np.inf
        for _ in range(ROUNDS):
            likelihood = self._train()
            if likelihood - before < ENOUGH * len(self._sees):
                break
            before = likelihood
        return self._most_probable()

    def _train(self) -> float:
        """Do one step of EM, and return the log-likelihood of the trace before it."""
        steps, states = self._sees.shape
        ahead = np.ones((steps, states)) / states
        behind = np.ones((steps, states))
        scale = np.ones(steps)
        matrices = list(self._chances)
        # Forward and backward messages, each scaled by the probability of its observation.
        for t in range(steps):
            message = (
                ahead[t - 1] @ matrices[self._actions[t - 1]] if t else ahead[0]
            ) * self._sees[t]
            scale[t] = message.sum()
            ahead[t] = message / scale[t]
            if t % 500 == 0:
                look_at_clock()
        for t in range(steps - 2, -1, -1):
            behind[t] = (
                matrices[self._actions[t]] @ (behind[t + 1] * self._sees[t + 1]) / scale[t + 1]
            )
            if t % 500 == 0:
                look_at_clock()
        then = behind[1:] * self._sees[1:] / scale[1:, None]
        taken = [
            self._chances[a] * (ahead[:-1][self._actions == a].T @ then[self._actions == a])
            for a in range(len(matrices))
        ]
        self._chances = self._normal(np.array(taken) + PSEUDOCOUNT)
        return float(np.log(scale).sum())

    def _most_probable(self) -> list[int]:
        """Find the most probable state of each step, by a Viterbi pass."""
        with np.errstate(divide="ignore"):
            matrices, sees = list(np.log(self._chances)), np.log(self._sees)
        spent = sees[0]
        came = np.zeros(self._sees.shape, dtype=np.int32)
        for t in range(1, len(sees)):
            ways = spent[:, None] + matrices[self._actions[t - 1]]
            came[t] = ways.argmax(axis=0)
            spent = ways[came[t], np.arange(len(spent))] + sees[t]
        return _traced_back(int(spent.argmax()), came)

    def _normal(self, counts: Floats) -> Floats:
        """Turn counts into transition probabilities. Slips lead to each state equally often."""
        chances: Floats = counts / counts.sum(axis=2, keepdims=True)
        slipping: Floats = (1 - SLIPPED) * chances + SLIPPED / counts.shape[2]
        return slipping


def _traced_back(last: int, came: NDArray[np.int32]) -> list[int]:
    """List the states of all steps. `came` has the state before each state, (steps, states)."""
    states = [last]
    for before in came[:0:-1]:
        states.append(int(before[states[-1]]))
    return states[::-1]
