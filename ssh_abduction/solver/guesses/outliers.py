"""Which displacements of a trace are wrong altogether, by labels that are nearly right.

Where a robot comes back to a dstate or to a place, the displacements since should take it there, as far as their covariance says. Each such return votes on all the
displacements between, by how much likelier it is if one of them is wrong than if none is: the logarithm of the ratio of the two densities of what the loop closes off by, where a
displacement that is wrong moves the robot by about FAR metres and turns it anyhow. The displacement with most votes is taken to be wrong, the returns across it vote no more, and so on
while any has votes left.

It is a guess: labels that are wrong vote, too, so that each vote is bounded, and a map has to pay for what it disbelieves.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from ssh_abduction.data.trace import Trace
from ssh_abduction.theory.evidence.loops import Loops, Reckoning, chi_squares

# A displacement that is wrong takes the robot so many metres away, about, as the standard deviation in each direction; and it turns it anyhow, for which that many radians stand.
FAR, ANYHOW = 15.0, math.pi / math.sqrt(3)
# A return for which none of the displacements can be right votes for a wrong one by so much at most: it may be that its labels are wrong.
MOST_VOTES = 15.0
# Votes below this are chance: e to this is how much likelier the returns have to be.
FEWEST_VOTES = 3.0


def wrong_displacements(
    trace: Trace, labels: Sequence[int], places: Sequence[int | None]
) -> tuple[int, ...]:
    """The steps to which displacements lead that are wrong, those first that have most votes.

    labels  the dstate of each step, nearly right
    places  the place of each step; None where none is known
    """
    loops = Reckoning(trace).loops_of_unknown_drift()
    voters: list[tuple[int, int, float]] = []
    for with_heading, pairs in ((True, _returns(labels)), (False, _returns(places))):
        known = [
            (i, j)
            for i, j in pairs
            if loops.part[i] == loops.part[j] and (with_heading or labels[i] != labels[j])
        ]
        voters += [
            (i, j, votes)
            for (i, j), votes in zip(known, _votes(loops, known, with_heading), strict=True)
        ]
    found: list[int] = []
    while True:
        votes = np.zeros(len(trace) + 1)
        for i, j, count in voters:
            votes[i + 1] += count
            votes[j + 1 :][:1] -= count
        votes = np.cumsum(votes)[:-1]
        votes[[t for t, step in enumerate(trace.steps) if step.displacement is None]] = -np.inf
        step = int(votes.argmax())
        if votes[step] < FEWEST_VOTES:
            return tuple(found)
        found.append(step)
        voters = [(i, j, count) for i, j, count in voters if not i < step <= j]


def _returns(sites: Sequence[int | None]) -> Iterator[tuple[int, int]]:
    """Pairs of steps at one site between which the robot is at others."""
    last: dict[int, int] = {}
    for t, site in enumerate(sites):
        if site is None:
            continue
        if site in last and last[site] < t - 1:
            yield last[site], t
        last[site] = t


def _votes(loops: Loops, pairs: Sequence[tuple[int, int]], with_heading: bool) -> list[float]:
    """How much likelier each return is if one of its displacements is wrong than if none is, as a logarithm."""
    if not pairs:
        return []
    closing, covariance = loops.closings([i for i, _ in pairs], [j for _, j in pairs])
    size = 3 if with_heading else 2
    wrong = np.diag([FAR**2, FAR**2, ANYHOW**2])
    likely = [
        chi_squares(closing, spread)[int(with_heading)]
        + np.linalg.slogdet(spread[:, :size, :size])[1]
        for spread in (covariance, covariance + wrong)
    ]
    votes: list[float] = np.minimum((likely[0] - likely[1]) / 2, MOST_VOTES).tolist()
    return votes
