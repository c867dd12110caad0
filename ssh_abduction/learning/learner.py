"""The bootstrap loop: images, views, map, labels, recogniser.

Reference: Kuipers & Beeson 2002, "Bootstrap Learning for Place Recognition", Figure 1.

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
from ssh_abduction.runtime.deprecated import renamed_parameters
from ssh_abduction.runtime.logs import log_of
from ssh_abduction.solver import solve
from ssh_abduction.theory.theory import Theory, checked_theory

__all__ = [
    "AmbiguousMapWarning",
    "BootstrapLearner",
    "LearnerError",
    "RunnerUpWarning",
    "labels_of",
]

_log = log_of(__name__)


class BootstrapLearner(BaseEstimator):  # type: ignore[misc]
    """Learns to recognise places from images and actions, without knowing any place.

    It is an estimator, as scikit-learn has them. Of several traces, all images make the views, the
    longest trace makes the map, and the others are followed on it.

    Args:
        theory: The axioms; Theory.topological() by default.
        clusterer: Makes views of images: a ViewClusterer, or a clusterer of scikit-learn. It is
            cloned. By default ViewClusterer(random_state=0). If the theory allows misread views
            it has `isolated=10`: then images that are like no others have no view, and
            ignoring them costs little.
        choose: Index of the map to take if several are minimal; None takes the labels on which all
            of them agree.
        time_limit: Seconds for finding the map; None for no limit.
        features: Makes of images what is clustered and compared: a transformer of scikit-learn. It
            is cloned. By default reciprocals of ranges, or a PanoramaTransformer for panoramas.

    Attributes:
        features_: The fitted features.
        clusterer_: The fitted clusterer.
        views_: The view of each step, (n,); -1 for an image without a view. n counts the steps of
            all traces, one after the other.
        confidence_: How sure each view is, (n,), from 0 to 1.
        solution_: The minimal maps of the longest trace.
        map_: The map that is learnt from.
        second_map_: The map of the runner-up, if another number of views is about as good and gives
            another map; else None.
        labels_: The dstate of each step, (n,); -1 if the maps disagree or the image has no view.
        recogniser_: The recogniser. It learns from no image that the map says is misread.

    Reference:
        Kuipers & Beeson 2002, "Bootstrap Learning for Place Recognition", Figure 1.
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
        self.theory, self.clusterer, self.features = theory, clusterer, features
        self.choose, self.time_limit = choose, time_limit

    def fit(self, X: Trace | Sequence[Trace], y: Any = None) -> BootstrapLearner:
        """Run the loop on a trace, or on several.

        Raises:
            LearnerError: There is no map, or no label is left to learn from.
            PerceptionError: The images cannot be clustered.
            TraceError: A trace lacks what the theory needs.
        """
        traces, theory = Traces.of(X), checked_theory(self.theory)

        # 1. Views: cluster the images.
        self.features_ = self._new_features(traces).fit(traces.images)
        vectors = self.features_.transform(traces.images)
        self.clusterer_ = self._new_clusterer(theory).fit(vectors)
        self.views_, self.confidence_ = self.clusterer_.labels_, self.clusterer_.confidence_
        warn_of_doubts(self.views_, self.confidence_, self.clusterer_.quality_[self.clusterer_.k_])
        _log.info("%d images, %d views", len(traces.images), self.clusterer_.k_)

        # 2. Map: find the minimal maps of the longest trace.
        second_views = self.clusterer_.runner_up_labels_
        seen = traces.with_views(vectors, self.views_, second_views, self.confidence_)
        longest = seen.each[seen.longest]
        self.solution_ = solve(longest, theory, time_limit=self.time_limit)
        self.map_, own_labels = map_of(self.solution_, self.choose)
        self.second_map_ = warn_of_second_map(longest, self.solution_.maps, theory, self.time_limit)
        _log.info("a map of %d dstates", len(self.map_.dstates))

        # 3. Labels: the map gives the dstate of each image.
        self.labels_ = labels_of_all(self.map_, own_labels, seen, self.views_, self.features_)

        # 4. Recogniser: learn from the images whose label is sure.
        misread = [fault.step for fault in self.map_.faults if fault.kind == "misread"]
        is_sure = self.labels_ >= 0
        is_sure[traces.at_longest(misread)] = False
        self.recogniser_ = recogniser(features=self.features_).fit(
            traces.images[is_sure], self.labels_[is_sure]
        )
        _log.info("a recogniser of %d images", is_sure.sum())
        return self

    def predict(self, X: Trace | Sequence[Trace] | ArrayLike) -> NDArray[np.intp]:
        """The dstates, as ids of `map_`, at which images were taken, (m,).

        Args:
            X: Images, (m, d), or traces with m steps in all.

        Raises:
            LearnerError: The learner has not learnt yet.
        """
        if not hasattr(self, "recogniser_"):
            raise LearnerError(
                "learner: expected one that has learnt, got a new one; call fit with a trace first"
            )
        images = Traces.of(X).images if Traces.are(X) else X
        return np.asarray(self.recogniser_.predict(images), np.intp)

    def score(self, X: Trace | Sequence[Trace] | ArrayLike, y: ArrayLike | None = None) -> float:
        """The share of images that are recognised.

        Args:
            X: Images, (m, d), or traces with m steps in all.
            y: The true dstates, (m,). Without them each trace is followed on the map: of the ways
                that no view contradicts, the one that fits most images gives the dstates. Steps
                without a dstate do not count.

        Raises:
            LearnerError: The dstate of no step is known, or `y` has another shape.
        """
        found = self.predict(X)
        if y is None and not Traces.are(X):
            raise LearnerError(
                "y: expected the dstates of the images, got none; "
                "give them, or traces, which are followed on the map"
            )
        true = np.asarray(self._followed(Traces.of(X), found) if y is None else y)
        if true.shape != found.shape:
            raise LearnerError(
                f"y: expected {len(found)} dstates, one an image, "
                f"got an array of shape {true.shape}"
            )
        if not (true >= 0).any():
            raise LearnerError(
                "traces: expected some steps whose dstate the map tells, got none; "
                "score a trace of the same world"
            )
        return float(np.mean(found[true >= 0] == true[true >= 0]))

    def _new_features(self, traces: Traces) -> Any:
        """What makes features of images, not fitted yet."""
        if self.features is None:
            return traces.features
        return cloned("features", self.features, "transform")

    def _new_clusterer(self, theory: Theory) -> ViewClusterer:
        """The clusterer, not fitted yet."""
        if self.clusterer is not None:
            return as_view_clusterer(cloned("clusterer", self.clusterer))
        return ViewClusterer(random_state=0, isolated=ISOLATED if theory.misread else None)

    def _followed(self, traces: Traces, looks: NDArray[np.intp]) -> NDArray[np.intp]:
        """The dstate of each step by the map, (m,); -1 if unknown.

        Args:
            traces: Traces with m steps in all.
            looks: The dstates that the images look like, (m,).
        """
        views = self.clusterer_.predict(self.features_.transform(traces.images))
        return labels_on(self.map_, traces, views, looks)
