"""The bootstrap loop of Kuipers & Beeson (2002), Figure 1: images, views, map, labels, recogniser.

>>> from simulator.tours import simulate
>>> from simulator.world import World
>>> learner = BootstrapLearner().fit(simulate(World.named("notched-rectangle"), tours=3, seed=1))
>>> learner.clusterer_.k_, learner.solution_.cost.dstates
(4, 8)
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from perception.images import images_of
from perception.reciprocal import ReciprocalTransformer
from perception.recognition import recogniser
from perception.views import ViewClusterer
from ssh_abduction.errors import SSHError
from ssh_abduction.maps import SSHMap
from ssh_abduction.solver.search import solve
from ssh_abduction.theory.theory import Theory, checked_theory
from ssh_abduction.trace import Trace, checked_trace


class LearnerError(SSHError):
    """The loop cannot be closed: there is no map, or the maps agree on no label."""


class AmbiguousMapWarning(UserWarning):
    """Several minimal maps remain: only the labels that they agree on are learnt from."""


class BootstrapLearner:
    """Learns to recognise places from a trace of images and actions, without being told any place.

    theory     the axioms; Theory.topological() by default
    clusterer  makes views of images; ViewClusterer(random_state=0) by default
    choose     the index of the map to take where several remain; None takes the labels on which all of them agree
    limit      seconds for finding the map

    After `fit` there are clusterer_, views_ (n,), solution_, map_, labels_ (n,) with -1 where the maps disagree, and recogniser_.
    """

    def __init__(self, theory: Theory | None = None, clusterer: Any = None, choose: int | None = None, limit: float | None = None) -> None:
        self.theory = theory
        self.clusterer = clusterer
        self.choose = choose
        self.limit = limit

    def __repr__(self) -> str:
        return f"BootstrapLearner(theory={self.theory!r}, clusterer={self.clusterer!r}, choose={self.choose}, limit={self.limit})"

    def fit(self, trace: Trace) -> BootstrapLearner:
        """Run the loop. Raises LearnerError, PerceptionError, TraceError."""
        theory = checked_theory(self.theory)
        images = images_of(checked_trace(trace))
        self.clusterer_ = self.clusterer or ViewClusterer(random_state=0)
        self.views_ = self.clusterer_.fit(ReciprocalTransformer().fit_transform(images)).labels_
        self.solution_ = solve(trace.with_views(self.views_.tolist()), theory, limit=self.limit)
        self.labels_ = labels_of(self.solution_.maps, self.choose, self.solution_.complete)
        self.map_ = self.solution_.maps[self.choose or 0]
        sure = self.labels_ >= 0
        self.recogniser_ = recogniser().fit(images[sure], self.labels_[sure])
        return self

    def predict(self, images: ArrayLike) -> NDArray[np.intp]:
        """The dstates, ids of `map_`, at which images (m, d) were taken. Raises LearnerError before `fit`."""
        if not hasattr(self, "recogniser_"):
            raise LearnerError("learner: expected one that has learnt, got a new one; call fit with a trace first")
        return np.asarray(self.recogniser_.predict(images), np.intp)


def labels_of(maps: Sequence[SSHMap], choose: int | None = None, complete: bool = True) -> NDArray[np.intp]:
    """The label of each step, (n,): its dstate in the chosen map; or, if none is chosen, in the first map, and -1 where the maps disagree.

    Maps agree on a step if the first step at its dstate is the same in all of them. Warns if no map is chosen and they do not agree
    everywhere, or if there may be more (`complete` is false). Raises LearnerError where no map or no label is left.
    """
    if not maps:
        raise LearnerError("maps: expected at least one to take labels from, got none; see the solution's status")
    if choose is not None and not 0 <= choose < len(maps):
        raise LearnerError(f"map: expected an index from 0 to {len(maps) - 1}, got {choose}")
    labels = np.array(maps[choose or 0].labels, np.intp)
    if choose is not None:
        return labels
    for i, ssh_map in enumerate(maps):
        if len(ssh_map.labels) != len(labels):
            raise LearnerError(
                f"maps: expected maps of one trace, {len(labels)} labels each, got {len(ssh_map.labels)} in map {i + 1}; solve one trace"
            )
    first = [_first_steps(ssh_map) for ssh_map in maps]
    agreed = np.all([f == first[0] for f in first], axis=0)
    if not agreed.all() or not complete:
        unsure = f"{len(maps)} minimal maps{'' if complete else ' or more'} remain, and agree on {agreed.sum()} of {len(agreed)} labels"
        warnings.warn(f"{unsure}: only these are learnt from; choose a map, or explore more", AmbiguousMapWarning, stacklevel=2)
    if not agreed.any():
        raise LearnerError("labels: expected some that all maps agree on, got none; choose a map")
    return np.where(agreed, labels, -1)


def _first_steps(ssh_map: SSHMap) -> NDArray[np.intp]:
    """For each step, (n,), the first step at its dstate."""
    _, first, dstates = np.unique(ssh_map.labels, return_index=True, return_inverse=True)
    return np.asarray(first[dstates], np.intp)
