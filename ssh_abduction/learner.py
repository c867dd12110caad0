"""The bootstrap loop of Kuipers & Beeson (2002), Figure 1: images, views, map, labels, recogniser.

>>> from simulator.tours import simulate
>>> from simulator.world import World
>>> learner = BootstrapLearner().fit(simulate(World.named("notched-rectangle"), tours=3, seed=1))
>>> learner.clusterer_.k_, learner.solution_.cost.dstates
(4, 8)
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from perception.images import images_of
from perception.reciprocal import ReciprocalTransformer
from perception.recognition import recogniser
from perception.views import ViewClusterer
from ssh_abduction.labels import AmbiguousMapWarning, LearnerError, labels_of
from ssh_abduction.runner_up import RunnerUpWarning, SecondMap, second_map, with_runner_up
from ssh_abduction.solver.result import Status
from ssh_abduction.solver.search import solve
from ssh_abduction.theory.theory import Theory, checked_theory
from ssh_abduction.trace import Trace, checked_trace

__all__ = ["AmbiguousMapWarning", "BootstrapLearner", "LearnerError", "RunnerUpWarning", "labels_of"]


class BootstrapLearner:
    """Learns to recognise places from a trace of images and actions, without being told any place.

    theory     the axioms; Theory.topological() by default
    clusterer  makes views of images; ViewClusterer(random_state=0) by default
    choose     the index of the map to take where several remain; None takes the labels on which all of them agree
    limit      seconds for finding the map

    After `fit` there are clusterer_, views_ (n,), solution_, map_, labels_ (n,) with -1 where the maps disagree,
    recogniser_, and second_map_, the map of the runner-up, where another number of views is about as good and gives another map.
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
        seen = with_runner_up(trace.with_views(self.views_.tolist()), self._second_views())
        self.solution_ = solve(seen, theory, limit=self.limit)
        self.labels_ = labels_of(self.solution_.maps, self.choose, self.solution_.complete, self.solution_.status is Status.OPTIMAL)
        self.map_ = self.solution_.maps[self.choose or 0]
        self.second_map_ = self._second_map(seen, theory)
        sure = self.labels_ >= 0
        self.recogniser_ = recogniser().fit(images[sure], self.labels_[sure])
        return self

    def predict(self, images: ArrayLike) -> NDArray[np.intp]:
        """The dstates, ids of `map_`, at which images (m, d) were taken. Raises LearnerError before `fit`."""
        if not hasattr(self, "recogniser_"):
            raise LearnerError("learner: expected one that has learnt, got a new one; call fit with a trace first")
        return np.asarray(self.recogniser_.predict(images), np.intp)

    def _second_map(self, seen: Trace, theory: Theory) -> SecondMap | None:
        """The map of the runner-up, where it is another one, with a warning."""
        found = second_map(seen, self.solution_.maps, theory, self.limit)
        if found:
            warnings.warn(found.sentence, RunnerUpWarning, stacklevel=3)
        return found

    def _second_views(self) -> list[int] | None:
        """The views of the runner-up, where the clusterer has one."""
        other = getattr(self.clusterer_, "runner_up_", None)
        return None if other is None else self.clusterer_.labels_by_k_[other].tolist()
