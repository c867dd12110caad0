"""Other programs that explain a trace with faults, each as a function from a case to the labels of its steps.

Each function is given a case and CPU seconds. It looks at the trace, and of the truth only at what its docstring names. Dstates, links and faults are read off the labels in the same way for
all of them (`Explanation`): a dstate shows what is seen there most often, and what disagrees is a fault.
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

NOISY = 10  # So many merged states one observation in a minority weighs; see `merged`.
LEAST = 10  # A merge has to score so much.
CLONES = (2, 3, 4, 6)  # So many clones each view is given in turn; see `cloned`.
RESTARTS = 5  # Random beginnings of EM for each of these, as it finds the optimum that is next to where it begins.
ROUNDS = 200  # EM steps from each beginning, at most.
ENOUGH = 1e-4  # EM ends where a step gains less than this in log-likelihood, per step of the trace.
PSEUDOCOUNT = 2e-3  # What George et al. add to all counts.


@dataclass(frozen=True)
class Peer:
    """A program: what explains the trace in so many CPU seconds, the modules it needs, the package on PyPI they come from, and whether it proves its faults to be fewest."""

    explain: Callable[[Case, float], Explanation]
    modules: tuple[str, ...]
    package: str
    proves: bool = False

    @property
    def installed(self) -> bool:
        return all(find_spec(module.partition(".")[0]) for module in self.modules)


def maxsat(case: Case, seconds: float) -> Explanation:
    """RC2 (Ignatiev, Morgado & Marques-Silva 2019) in python-sat, given the number of states and the kind of the faults.

    Variables: step t is at state s, action a leads from s to x, state s shows view v; each is a function. Where views may be wrong, what a state shows and what is seen
    there agree unless a soft clause of that step is broken, and links are hard; where actions may jump, the other way round. States are numbered in the order of
    what they show, as else each machine would be there in all its namings. It proves that no machine with so many states has fewer faults.
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
    """AALpy's general state merging, with a score that tolerates noise, as AALpy lets its users write one. States may have several outcomes of one action.

    A merge scores one for each state that it saves, as in evidence-driven state merging, and loses for each observation that is not what is seen most often after that action there.
    Of the scores that were tried on other seeds (AALpy's AIC, its Hoeffding bound, and this one with 3, 5, 10 and 20) this one came nearest to the truth. Its machine is followed
    along the trace, and refined.
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
    """A cloned hidden Markov model (George et al. 2021), from its equations: EM, then Viterbi training, then the most probable clones.

    Each view has the same number of clones, and a clone shows its view for certain; what is learned is the probability that action a leads from one clone to another. A wrong
    view has a clone like any other, so the labels are refined. Of all numbers of clones and random beginnings the cheapest explanation is taken; none is begun in
    the second half of its time.
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
    """The messages of a cloned hidden Markov model along one trace. Chances have the shape (actions, views, views, clones, clones): from, and to."""

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
        chances = _normal(rng.random(self.shape))
        before = -np.inf
        for _ in range(ROUNDS):
            counts, likelihood = self.expected(chances)
            chances = _normal(counts + PSEUDOCOUNT)
            if likelihood - before < ENOUGH * len(self.seen):
                break
            before = likelihood
        labels: list[tuple[int, int]] = []
        while labels != (labels := self.labels(chances)):
            counts = np.full(self.shape, 1e-9)
            for a, (v, i), (w, j) in zip(self.links[0], labels, labels[1:], strict=False):
                counts[a, v, w, i, j] += 1
            chances = _normal(counts)
        return chances

    def expected(self, chances: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
        """How often each link is expected to be taken (forward and backward messages), and the log-likelihood of the trace."""
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
        """The most probable clones of all steps, each as a view and the number of its clone."""
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
    """Counts as probabilities of where an action leads."""
    return counts / counts.sum(axis=(2, 4), keepdims=True)


PEERS = {
    "RC2": Peer(maxsat, ("pysat.examples.rc2",), "python-sat", proves=True),
    "AALpy": Peer(merged, ("aalpy.learning_algs",), "aalpy"),
    "cloned HMM": Peer(cloned, (), "numpy"),
}
