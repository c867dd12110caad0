"""The bootstrap loop of Kuipers & Beeson (2002), Figure 1: images, views, map, labels, recogniser.

>>> from simulator.tours import simulate
>>> from simulator.world import World
>>> learner = BootstrapLearner().fit(simulate(World.named("notched-rectangle"), tours=3, seed=1))
>>> learner.clusterer_.k_, learner.solution_.cost.dstates
(4, 8)
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator

from perception.confidence import warn_of_doubts
from perception.recognition import cloned, recogniser
from perception.views import ISOLATED, ViewClusterer, as_view_clusterer
from ssh_abduction.data.deprecated import renamed_parameters
from ssh_abduction.data.logs import log_of
from ssh_abduction.data.trace import Trace
from ssh_abduction.learning.labels import (
    AmbiguousMapWarning,
    LearnerError,
    labels_of,
    labels_of_all,
    labels_on,
    map_of,
)
from ssh_abduction.learning.runner_up import RunnerUpWarning, warn_of_second_map
from ssh_abduction.learning.traces import Traces
from ssh_abduction.solver import solve
from ssh_abduction.theory.theory import Theory, checked_theory

__all__ = [
    "AmbiguousMapWarning",
    "BootstrapLearner",
    "LearnerError",
    "RunnerUpWarning",
    "labels_of",
]


class BootstrapLearner(BaseEstimator):  # type: ignore[misc]
    """Learns to recognise places from a trace of images and actions, without being told any place. An estimator, as scikit-learn has them.

    theory     the axioms; Theory.topological() by default
    clusterer  makes views of images: a ViewClusterer, or a clusterer of scikit-learn's. It is cloned. ViewClusterer(random_state=0) by default,
               and with `isolated=10` where the theory allows views that are misread: images that are like no others then have no view, and disbelieving them costs little
    choose     the index of the map to take where several remain; None takes the labels on which all of them agree
    time_limit seconds for finding the map
    features   makes of images what is clustered and compared: a transformer of scikit-learn's kind, cloned. None for reciprocals of ranges, and for a PanoramaTransformer of panoramas

    After `fit` there are features_, clusterer_, views_ and confidence_ (n,), solution_, map_, labels_ (n,) with -1 where the maps disagree or an image has no view,
    recogniser_, which has not learnt from images that the map says are misread, and second_map_, the map of the runner-up, where another number of views is about as good and gives another map.

    Of several traces all images make the views, the longest trace makes the map, and the others are followed on it; n counts their steps, one after the other.
    """

    @renamed_parameters("limit")
    def __init__(
        self,
        theory: Theory | None = None,
        clusterer: Any = None,
        choose: int | None = None,
        time_limit: float | None = None,
        features: Any = None,
    ) -> None:
        self.theory, self.clusterer, self.choose, self.time_limit, self.features = (
            theory,
            clusterer,
            choose,
            time_limit,
            features,
        )

    def fit(self, X: Trace | Sequence[Trace], y: Any = None) -> BootstrapLearner:
        """Run the loop on a trace, or on several. Raises LearnerError, PerceptionError, TraceError."""
        traces, theory = Traces.of(X), checked_theory(self.theory)
        seen = self._look(traces, ISOLATED if theory.misread else None)
        self.solution_ = solve(seen.each[seen.longest], theory, time_limit=self.time_limit)
        self.map_, mapped = map_of(self.solution_, self.choose)
        log_of(__name__).info("a map of %d dstates", len(self.map_.dstates))
        self.second_map_ = warn_of_second_map(
            seen.each[seen.longest], self.solution_.maps, theory, self.time_limit
        )
        self.labels_ = labels_of_all(self.map_, mapped, seen, self.views_, self.features_)
        sure = self.labels_ >= 0
        sure[
            traces.at_longest([fault.step for fault in self.map_.faults if fault.kind == "misread"])
        ] = False
        log_of(__name__).info("a recogniser of %d images", sure.sum())
        self.recogniser_ = recogniser(features=self.features_).fit(
            traces.images[sure], self.labels_[sure]
        )
        return self

    def predict(self, X: Trace | Sequence[Trace] | ArrayLike) -> NDArray[np.intp]:
        """The dstates, ids of `map_`, at which images (m, d), or those of traces, were taken. Raises LearnerError before `fit`."""
        if not hasattr(self, "recogniser_"):
            raise LearnerError(
                "learner: expected one that has learnt, got a new one; call fit with a trace first"
            )
        return np.asarray(
            self.recogniser_.predict(Traces.of(X).images if Traces.are(X) else X), np.intp
        )

    def score(self, X: Trace | Sequence[Trace] | ArrayLike, y: ArrayLike | None = None) -> float:
        """The share of images that are recognised: as the dstates `y` (m,), or, where these are not given, as those on the way of each trace on the map.

        Of the ways that no view contradicts it is the one that fits most images. Steps whose dstate it does not tell do not count; LearnerError where there are no others.
        """
        found = self.predict(X)
        if y is None and not Traces.are(X):
            raise LearnerError(
                "y: expected the dstates of the images, got none; give them, or traces, which are followed on the map"
            )
        true = np.asarray(self._followed(Traces.of(X), found) if y is None else y)
        if true.shape != found.shape:
            raise LearnerError(
                f"y: expected {len(found)} dstates, one an image, got an array of shape {true.shape}"
            )
        if not (true >= 0).any():
            raise LearnerError(
                "traces: expected some steps whose dstate the map tells, got none; score a trace of the same world"
            )
        return float(np.mean(found[true >= 0] == true[true >= 0]))

    def _look(self, traces: Traces, isolated: float | None) -> Traces:
        """The traces with their views, and, where there is one, with those of the runner-up."""
        usual = ViewClusterer(random_state=0, isolated=isolated)
        self.features_ = (
            traces.features
            if self.features is None
            else cloned("features", self.features, "transform")
        ).fit(traces.images)
        images = self.features_.transform(traces.images)
        self.clusterer_ = as_view_clusterer(
            usual if self.clusterer is None else cloned("clusterer", self.clusterer)
        ).fit(images)
        self.views_, self.confidence_ = self.clusterer_.labels_, self.clusterer_.confidence_
        log_of(__name__).info("%d images, %d views", len(traces.images), self.clusterer_.k_)
        warn_of_doubts(self.views_, self.confidence_, self.clusterer_.quality_[self.clusterer_.k_])
        return traces.with_views(
            images, self.views_, self.clusterer_.runner_up_labels_, self.confidence_
        )

    def _followed(self, traces: Traces, looks: NDArray[np.intp]) -> NDArray[np.intp]:
        """The dstate of each step, by the map: -1 where it does not tell. `looks` are the dstates that the images look like."""
        views = self.clusterer_.predict(self.features_.transform(traces.images))
        return labels_on(self.map_, traces, views, looks)
