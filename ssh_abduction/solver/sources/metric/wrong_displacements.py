"""Find wrong displacements, from labels that are nearly right or by a local search.

*Votes.* A displacement is how the robot moved between two steps, by its odometry. When the robot
comes back to a dstate or a place, the displacements in between have to add up to zero, within their
covariance. Each such return gives a vote to all displacements in between. The vote is the log
likelihood ratio of two hypotheses, given the residual of the loop: that one of these displacements
is wrong, against that none is. A wrong displacement is off by about FAR metres and has an arbitrary
turn.

The displacement with the most votes is taken to be wrong. The returns that gave it votes are then
dropped. This is repeated while some displacement has enough votes.

The result is a guess. Returns by wrong labels also vote, so each vote is limited. A map has to pay
for each displacement that it treats as wrong.

*Search.* After a wrong displacement the pose is unknown, so a beam of hypotheses may drop the best
map there. If it is given which displacements are wrong, even a narrow beam mostly finds the best
map. So this is a local search over sets of wrong displacements. It begins with those of the best
known map. One more or one less makes a neighbour, and the neighbours of the cheapest set come
first.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Sequence

import numpy as np

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.solution.weighed import EQUAL
from ssh_abduction.theory.evidence.displacement import jumped
from ssh_abduction.theory.evidence.loops import Loops, Reckoning, chi_squares

# Standard deviations of a wrong displacement: metres along each axis, and the radians of a heading
# that is uniformly distributed.
FAR, ANYHOW = 15.0, math.pi / math.sqrt(3)
# The largest vote of a return. It is limited as the labels may be wrong instead.
MOST_VOTES = 15.0
# Fewer votes than this may be chance. With 3 votes, a wrong displacement makes the residuals of the
# returns e**3 times likelier.
FEWEST_VOTES = 3.0
# End after the neighbours of this many sets in turn had no map that costs less than the best one.
IN_VAIN = 3
# Give up a set as soon as its map costs this many nats more than the best one.
BEYOND = 20.0


def wrong_displacements(
    trace: Trace, labels: Sequence[int], places: Sequence[int | None]
) -> tuple[int, ...]:
    """Find the displacements that are outliers.

    `labels` and `places` are those of the steps in a map that is nearly right; a place may be
    None. Returns the steps that wrong displacements lead to, those with the most votes first.
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
    # Greedily remove the displacement with the most votes, and the returns that it explains.
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
    """Yield the returns: two steps at one place or dstate, with no step there in between."""
    last: dict[int, int] = {}
    for t, site in enumerate(sites):
        if site is None:
            continue
        if site in last and last[site] < t - 1:
            yield last[site], t
        last[site] = t


def _votes(loops: Loops, pairs: Sequence[tuple[int, int]], with_heading: bool) -> list[float]:
    """Return the vote in nats of each return, at most `MOST_VOTES`.

    A vote is the log likelihood ratio that one displacement of the loop is wrong. A return has a
    first and a last step. With `with_heading`, the robot comes back to a dstate, so that headings
    have to agree; otherwise it comes back to a place.
    """
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


def search_jumps(
    trace: Trace,
    map_without: Callable[[Collection[int], float], SSHMap | None],
    best: SSHMap,
    add: Callable[[SSHMap], float],
) -> None:
    """Try sets of wrong displacements near those of a map, the cheapest first.

    `map_without` returns a map in which the displacements to some steps are wrong, or None if it
    costs more than some nats.
    `add` keeps a map, and returns its cost in nats. Raises LimitError if the time is over.
    """
    steps = [t for t, step in enumerate(trace.steps) if step.displacement is not None]
    steps.sort(key=lambda t: trace.actions[t - 1].kind != "travel")  # most errors are of travels
    nats = {frozenset(jumped(best)): add(best)}
    opened, in_vain = set[frozenset[int]](), 0
    while in_vain < IN_VAIN and (closed := nats.keys() - opened):
        before, near = min(nats.values()), min(closed, key=lambda wrong: nats[wrong])
        opened.add(near)
        for wrong in (near ^ {t} for t in steps):
            if wrong not in nats:
                found = map_without(wrong, min(nats.values()) + BEYOND)
                nats[wrong] = math.inf if found is None else add(found)
        in_vain = 0 if min(nats.values()) < before - EQUAL else in_vain + 1
