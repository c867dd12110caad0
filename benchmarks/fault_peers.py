"""Other programs that explain a trace with faults: functions from a case to labels of its steps.

Each function gets a case and a limit in CPU seconds. It reads the trace. It reads only those parts
of the truth that its docstring names. Dstates, links and faults are derived from the labels in the
same way for all programs (`Explanation`): a dstate shows its most frequent view, and other views
are faults.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from itertools import combinations, product
from typing import Any

import numpy as np
from fault_cases import Case, Explanation, refined
from numpy.typing import NDArray

from ssh_abduction import Trace

NOISY = 10  # An observation that is not the most frequent one costs this many merged states.
LEAST = 10  # The smallest score of a merge.
CLONES = (2, 3, 4, 6)  # The numbers of clones of a view that are tried; see `cloned`.
RESTARTS = 5  # Random starts of EM for each number of clones, as EM finds local optima.
ROUNDS = 200  # The most EM steps from each start.
ENOUGH = 1e-4  # EM ends when log-likelihood per step of the trace grows by less than this.
PSEUDOCOUNT = 2e-3  # Added to all counts, as by George et al.


@dataclass(frozen=True)
class Peer:
    """A program.

    Attributes:
        explain: Function from a case and a limit in CPU seconds to an explanation.
        modules: Modules that the function imports.
        package: Package to install.
        proves: Whether the program proves that no explanation has fewer faults.
    """

    explain: Callable[[Case, float], Explanation]
    modules: tuple[str, ...]
    package: str
    proves: bool = False

    @property
    def installed(self) -> bool:
        return all(find_spec(module.partition(".")[0]) for module in self.modules)


def maxsat(case: Case, seconds: float) -> Explanation:
    """Explain a trace by MaxSAT: RC2 (Ignatiev, Morgado & Marques-Silva 2019) in python-sat.

    RC2 reads the true number of states and the true kinds of faults. The variables say that step t
    is at state s, that action a leads from s to x, and that state s shows view v. Each of these is
    a function. If views may be wrong, links are hard constraints, and a soft clause for each step
    makes the state show the view. If actions may jump, views are hard and links soft. States are
    ordered by the views that they show, to break the symmetry of their names. RC2 proves that no
    machine of this size has fewer faults.
    """
    from pysat.examples.rc2 import RC2
    from pysat.formula import WCNF, IDPool

    trace, states = case.walk.trace, range(case.states)
    views = list(dict.fromkeys(trace.views))
    names, formula = IDPool(), WCNF()

    def one_of(literals: Sequence[int]) -> None:
        formula.append(list(literals))
        formula.extend([[-a, -b] for a, b in combinations(literals, 2)])

    def at(t: int, s: int) -> int:
        return int(names.id(("at", t, s)))

    def leads(s: int, action: str, x: int) -> int:
        return int(names.id(("leads", s, action, x)))

    def shows(s: int, v: int) -> int:
        return int(names.id(("shows", s, v)))

    for t in range(len(trace)):
        one_of([at(t, s) for s in states])
    for s in states:
        one_of([shows(s, v) for v in range(len(views))])
        for action in dict.fromkeys(a.name for a in trace.actions):
            one_of([leads(s, action, x) for x in states])
    # Order the states by their views.
    for s, (w, v) in product(states[1:], combinations(range(len(views)), 2)):
        formula.append([-shows(s - 1, v), -shows(s, w)])
    for t, view in enumerate(trace.views):
        excuse = [int(names.id(("misread", t)))] if case.wrong else []
        formula.extend([[-at(t, s), shows(s, views.index(view)), *excuse] for s in states])
        formula.extend([[-literal] for literal in excuse], weights=[1] * len(excuse))
    for t, action in enumerate(a.name for a in trace.actions):
        excuse = [int(names.id(("jumped", t)))] if case.jumps else []
        formula.extend(
            [
                [-at(t, s), -leads(s, action, x), at(t + 1, x), *excuse]
                for s in states
                for x in states
            ]
        )
        formula.extend([[-literal] for literal in excuse], weights=[1] * len(excuse))
    with RC2(formula, solver="g4", adapt=True, exhaust=True, minz=True) as solver:
        model = set(solver.compute() or ())
    return Explanation.of(
        trace, [next(s for s in states if at(t, s) in model) for t in range(len(trace))]
    )


def merged(case: Case, seconds: float) -> Explanation:
    """Explain a trace by AALpy's general state merging, with a score that tolerates noise.

    Users of AALpy can write a score. This score of a merge adds one for each state that the merge
    saves, as in evidence-driven state merging. It subtracts NOISY for each observation that is not
    the most frequent one after its action. States may have several outcomes of an action. Of the
    scores that were tried on other seeds (AALpy's AIC, its Hoeffding bound, and NOISY of 3, 5, 10
    and 20), this one came nearest to the truth. The machine is followed along the trace, and the
    labels are refined.
    """
    from aalpy.learning_algs import run_GSM
    from aalpy.learning_algs.general_passive.DataHandler import CountDataHandler
    from aalpy.learning_algs.general_passive.ScoreFunctionsGSM import (
        SimpleScoreCalculation,
        lower_threshold,
    )

    def noise(node: Any) -> int:
        return sum(
            sum(counts.values()) - max(counts.values())
            for counts in node.data.transition_count.values()
        )

    def score(part: dict[Any, Any]) -> Any:
        new = set(part.values())
        return lower_threshold(
            len(part) - len(new) - NOISY * (sum(map(noise, new)) - sum(map(noise, part))), LEAST
        )

    trace = case.walk.trace
    # AALpy reads a first output, then pairs of input and output.
    walk = [
        trace.views[0],
        *((action.name, view) for action, view in zip(trace.actions, trace.views[1:], strict=True)),
    ]
    node: Any = run_GSM(
        [walk],
        transition_behavior="stochastic",
        score_calc=SimpleScoreCalculation(None, score),
        data_handler=CountDataHandler(),
        data_format="io_traces",
        convert=False,
    )
    labels: list[Hashable] = [id(node)]
    for action, view in zip(trace.actions, trace.views[1:], strict=True):
        node = node.transitions[action.name][view]
        labels.append(id(node))
    return refined(trace, labels)


def cloned(case: Case, seconds: float) -> Explanation:
    """Explain a trace by a cloned hidden Markov model (George et al. 2021).

    The model is written from the equations of the paper. Each view has the same number of clones,
    and a clone always shows its view. The probabilities of the links between clones are learnt by
    EM, then by Viterbi training. The most probable clones are the labels. A wrong view also has a
    clone, so the labels are refined. The result is the cheapest explanation over all numbers of
    clones and random starts. No start begins in the second half of the time.
    """
    trace = case.walk.trace
    explanations = []
    began = time.process_time()
    for seed, clones in product(range(RESTARTS), reversed(CLONES)):
        model = Clones(trace, clones)
        chances = model.trained(np.random.default_rng(seed))
        explanations.append(refined(trace, model.labels(chances)))
        if time.process_time() - began > seconds / 2:
            break
    return min(explanations, key=lambda explanation: explanation.tenths)


class Clones:
    """A cloned hidden Markov model of one trace, with the same number of clones for each view.

    The probabilities of links have the shape (actions, views from, views to, clones from, clones
    to).
    """

    def __init__(self, trace: Trace, clones: int) -> None:
        views = {view: i for i, view in enumerate(dict.fromkeys(trace.views))}
        actions = {name: i for i, name in enumerate(dict.fromkeys(a.name for a in trace.actions))}
        self.clones, self.shape = (
            clones,
            (max(len(actions), 1), len(views), len(views), clones, clones),
        )
        self.seen = [views[view] for view in trace.views]
        self.links = [actions[a.name] for a in trace.actions], self.seen[:-1], self.seen[1:]

    def trained(self, rng: np.random.Generator) -> NDArray[np.float64]:
        """Learn the probabilities of links by EM from a random start, then by Viterbi training."""
        chances = _normal(rng.random(self.shape))
        before = -np.inf
        for _ in range(ROUNDS):
            counts, likelihood = self.expected(chances)
            chances = _normal(counts + PSEUDOCOUNT)
            if likelihood - before < ENOUGH * len(self.seen):
                break
            before = likelihood
        # Viterbi training: count only the links of the most probable clones.
        labels: list[tuple[int, int]] = []
        while labels != (labels := self.labels(chances)):
            counts = np.full(self.shape, 1e-9)
            for a, (v, i), (w, j) in zip(self.links[0], labels, labels[1:], strict=False):
                counts[a, v, w, i, j] += 1
            chances = _normal(counts)
        return chances

    def expected(self, chances: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
        """Compute the expected counts of links, and the log-likelihood of the trace.

        Counts have the shape of the probabilities. They come from forward and backward messages.
        """
        blocks = chances[self.links]
        ahead, behind = np.ones((2, len(self.seen), self.clones)) / self.clones
        likelihood = 0.0
        for t, block in enumerate(blocks):
            message = ahead[t] @ block
            likelihood += float(np.log(message.sum()))
            ahead[t + 1] = message / message.sum()
        for t in range(len(blocks) - 1, -1, -1):
            message = blocks[t] @ behind[t + 1]
            behind[t] = message / message.sum()
        taken = ahead[:-1, :, None] * blocks * behind[1:, None, :]
        counts = np.zeros(self.shape)
        np.add.at(counts, self.links, taken / taken.sum(axis=(1, 2), keepdims=True))
        return counts, likelihood

    def labels(self, chances: NDArray[np.float64]) -> list[tuple[int, int]]:
        """Find the most probable clone of each step: its view and its number, both as indices."""
        blocks = np.log(chances)[self.links]
        spent, came = np.zeros(self.clones), []
        for block in blocks:
            ways = spent[:, None] + block
            came.append(ways.argmax(axis=0))
            spent = ways.max(axis=0)
        path = [int(spent.argmax())]
        for before in reversed(came):
            path.append(int(before[path[-1]]))
        return list(zip(self.seen, reversed(path), strict=True))


def _normal(counts: NDArray[np.float64]) -> NDArray[np.float64]:
    """Normalise counts of links to probabilities of where an action leads."""
    return counts / counts.sum(axis=(2, 4), keepdims=True)


PEERS = {
    "RC2": Peer(maxsat, ("pysat.examples.rc2",), "python-sat", proves=True),
    "AALpy": Peer(merged, ("aalpy.learning_algs",), "aalpy"),
    "cloned HMM": Peer(cloned, (), "numpy"),
}
