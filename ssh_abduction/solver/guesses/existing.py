"""Lay new drives on the map of old drives, without a search of the old steps.

The solver does not get the old drives. It gets a *digest*: a trace in which each link of their map
occurs once (`solver/drives/digest.py`). The displacements of the old drives are fitted to the map.
The fit gives the joint Gaussian distribution of the poses, and each link of the digest gets the
displacement between the poses of its ends. `joint_maps.py` then joins the pieces of the map and the
new drives.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from ssh_abduction.data.groups import numbered
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.runtime.threads import one_thread
from ssh_abduction.solver.geometry.fit import Poses
from ssh_abduction.solver.guesses.joint_maps import Joining
from ssh_abduction.solver.guesses.placed_map import Part
from ssh_abduction.solver.guesses.sights import Sights
from ssh_abduction.solver.steps.log import Log
from ssh_abduction.theory.evidence.loops import vectors_turned
from ssh_abduction.theory.settle import Problem


class ExistingMap:
    """The map of old drives, with the poses of its dstates and places.

    Attributes:
        broken: How many nats the new drives cost less if each is mapped alone, without axioms. It
            is known after `maps`.
    """

    def __init__(self, old: Trace, ssh_map: SSHMap) -> None:
        """Fit the poses to the old drives and their map."""
        self.broken = 0.0
        with one_thread("blas"):
            self._part_of, self._mean, self._covariance = Poses.of_map(old, ssh_map).gaussian()
        self._piece = ssh_map.piece_of
        self._places = numbered(-1 - s.id if s.place is None else s.place for s in ssh_map.dstates)

    def with_displacements(self, digest: Trace, labels: Sequence[int]) -> Trace:
        """Give each action of a digest the displacement between the steps before and after it.

        It stays unknown if no displacement of the old drives connects these steps.
        """
        positions = 2 * (max(self._places) + 1)
        at = self._mean[:positions].reshape(-1, 2)[self._places][list(labels)]
        facing = self._mean[positions:][list(labels)]
        gone = vectors_turned(at[1:] - at[:-1], -facing[:-1])
        turns = np.remainder(facing[1:] - facing[:-1] + np.pi, 2 * np.pi) - np.pi
        moves = zip(*gone.T.tolist(), turns.tolist(), strict=True)
        known = [
            self._part_of[s] == self._part_of[x] and not action.starts
            for (s, x), action in zip(pairwise(labels), digest.actions, strict=True)
        ]
        steps = [
            replace(step, displacement=move) if is_known else step
            for step, is_known, move in zip(digest.steps[1:], known, moves, strict=True)
        ]
        return replace(digest, steps=(digest.steps[0], *steps))

    def maps(self, problem: Problem, labels: Sequence[int]) -> Iterator[SSHMap]:
        """Yield maps of a digest and new drives. They keep the pieces of this map.

        The cheapest one is last. The caller has to check them. The trace of the problem is a digest
        of the old drives, and then the new ones. `labels` has the dstate of each step of the
        digest.
        """
        log = Log(problem.trace, problem.theory, problem.pairs)
        joining = Joining(problem, log)
        parts = dict.fromkeys(self._part_of)
        yield from joining.maps([self._part(i, labels, log, joining.sights) for i in parts])
        self.broken = joining.broken

    def _part(self, number: int, labels: Sequence[int], log: Log, sights: Sights) -> Part:
        """Make the `Part` for a part of the map that displacements connect.

        Its cost is 0, as the map must be kept.
        """
        dstates = [s for s, other in enumerate(self._part_of) if other == number]
        index = {s: i for i, s in enumerate(dstates)}
        places = list(dict.fromkeys(self._places[s] for s in dstates))
        first = 2 * (max(self._places) + 1)
        entries = [2 * p + k for p in places for k in (0, 1)] + [first + s for s in dstates]
        part = Part.of_steps(
            {t: index[s] for t, s in enumerate(labels) if s in index},
            numbered(self._places[s] for s in dstates),
            (self._mean[entries], self._covariance[np.ix_(entries, entries)]),
            0.0,
            log,
            sights,
        )
        return replace(part, kept=frozenset((i, self._piece[s]) for s, i in index.items()))
