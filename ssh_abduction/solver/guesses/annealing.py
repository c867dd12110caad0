"""Guess by annealing which visits are at one place.

The guess is close to the truth if the robot came to most places often. It proves nothing.

>>> from ssh_abduction import Theory, Trace
>>> from ssh_abduction.solver.guesses.annealing import annealed
>>> from ssh_abduction.solver.steps.chart import Chart
>>> from ssh_abduction.solver.steps.log import Log
>>> views, stars = ["wall", "hall"] * 3, [[0, 0, 1, 0], [1, 0, 0, 0]] * 3
>>> actions = ["around", "travel", "around", "travel", "around"]
>>> trace = Trace.from_steps(views, actions, stars=stars)
>>> guess = annealed(Chart.framed(trace, Log(trace, Theory(star="frame"))))
>>> guess.sure.tolist()
[True, True, True]

A map is a hidden Markov model. A state of the model is a *placing* of a visit: its place, and the
slot of the place that is slot 0 of the visit. An action in a state leads to one state, so each row
of the true matrix of transitions has a single entry of 1. At first the rows are uncertain (a
Dirichlet prior of small weight) and have little influence. Their influence grows as the temperature
falls. A sweep draws new states for stretches of visits, given the visits before and after the
stretch and the transitions of the last draw. This is forward filtering, backward sampling (Scott
2002, "Bayesian methods for hidden Markov models"). A visit cannot have a state that contradicts its
star, or a pinned visit (see below) from which it is apart. No axiom says that travels are
reversible. Still, each travel is counted in both directions.

Places have names, as dstates have in `engines/named_labels.py`. Pairwise distinct visits are pinned
to places of their own. Each kind of place has spare names. There have to be many spare names: with
too few, different places are merged and do not separate again.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import cycle

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.data.groups import numbered
from ssh_abduction.solver.guesses.sampling import Sampler, States
from ssh_abduction.solver.steps.apart import clique
from ssh_abduction.solver.steps.chart import FramedChart
from ssh_abduction.solver.steps.localising import faced

# The fewest spare names of a kind of place. With four, different places of mazes were merged.
SPARES = 6
# Successive attempts multiply SPARES by these factors, in a cycle. Places with few visits need more
# names.
MORE = 1, 2, 4
# The stages of a guess: the power of probabilities in the first sweep (a high temperature), and the
# number of sweeps. The guess is taken after the first stage at which it is good enough.
STAGES = (0.6, 300), *10 * ((0.75, 150),)
# A kind of place with many visits has more spare names, so that each has about this many visits.
# Fewer names take fewer sweeps.
VISITS = 40
# A guess is good enough if at most one in this many travels contradicts the majority. The guess is
# mended afterwards anyway.
FEW = 200
# The guess is the best attempt so far after this many seconds.
SECONDS = 10.0
_Kind = tuple[int, ...]


@dataclass(frozen=True)
class Guess:
    """A guess of the place of each visit, made by annealing.

    Attributes:
        states: For each visit, 4 times the number of its place, plus the slot of the place that is
            slot 0 of the visit.
        sure: For each visit, whether the travels to and from it lead where most such travels do.
    """

    states: States
    sure: NDArray[np.bool_]

    def labels(self, chart: FramedChart) -> list[int]:
        """Return a label for each node: 4 times its place, plus the slot (direction) there.

        The label is -1 if the guess is not sure of the visit of the node.
        """
        states, sure = self.states.tolist(), self.sure.tolist()
        return [faced(states[visit], slot) if sure[visit] else -1 for visit, slot in chart.facing]


def annealed(chart: FramedChart) -> Guess:
    """Guess the states of all visits of a chart.

    A travel is bad if it leads elsewhere than most travels with the same state and action. The
    result is the first guess in which at most one in FEW travels is bad. If none comes within
    SECONDS, it is the guess with the fewest bad travels.
    """
    found: dict[int, Guess] = {}
    began = time.perf_counter()
    for failed, guess in _attempts(chart):
        found.setdefault(failed, guess)
        if failed <= len(chart.travels) // FEW or time.perf_counter() - began > SECONDS:
            return found[min(found)]
    raise AssertionError


def _attempts(chart: FramedChart) -> Iterator[tuple[int, Guess]]:
    """Yield guesses without end, each with the number of its bad travels."""
    leaves = list(chart.leaves.values())
    for attempt, more in enumerate(cycle(MORE), 1):
        options = _options(chart, SPARES * more)
        drawn = Sampler(options, leaves, np.random.default_rng(attempt))
        for first, sweeps in STAGES:
            drawn.anneal(first, sweeps)
            yield drawn.failed(), Guess(drawn.labels, drawn.sure())


def _options(chart: FramedChart, spares: int) -> States:
    """Return the possible states (place and slot) of each visit: a row each, padded with -1."""
    misfits = chart.misfits
    # turned[visit][r] is the star of the visit in a frame whose slot r is slot 0 of the visit. The
    # least of these four stars is the kind of the visit.
    turned = [
        [tuple(star[(slot - r) % 4] for slot in range(4)) for r in range(4)] for star in chart.stars
    ]
    kinds = [min(stars) for stars in turned]
    pinned = clique(np.logical_and.reduce(misfits), numbered(kinds))
    spare = _spare(kinds, pinned, spares)
    # Visits x states of pinned places.
    known = ~misfits[:, :, pinned].transpose(1, 2, 0).reshape(len(kinds), -1)
    known[pinned] = False
    known[pinned, 4 * np.arange(len(pinned))] = True
    options: list[list[int]] = [np.flatnonzero(row).tolist() for row in known]
    for visit in set(range(len(kinds))).difference(pinned):
        options[visit] += [
            4 * place + r
            for place in spare[kinds[visit]]
            for r in range(4)
            if turned[visit][r] == kinds[visit]
        ]
    return _padded(options)


def _spare(kinds: Sequence[_Kind], pinned: Sequence[int], spares: int) -> dict[_Kind, range]:
    """Return the spare names of each kind of place, at least `spares`."""
    named = Counter(kinds[visit] for visit in pinned)
    spare: dict[_Kind, range] = {}
    names = len(pinned)
    for kind, visits in Counter(kinds).items():
        spare[kind] = range(names, names + spares + max(0, visits // VISITS - named[kind]))
        names = spare[kind].stop
    return spare


def _padded(options: Sequence[Sequence[int]]) -> States:
    """Make an array of rows of different lengths, padded with -1."""
    padded = np.full((len(options), max(map(len, options))), -1)
    for visit, states in enumerate(options):
        padded[visit, : len(states)] = states
    return padded
