"""Bootstrap learning: make views of images, a map of views, and a recogniser of its dstates.

A view is a cluster of images that look alike. A dstate (distinctive state) is a place and the
direction that the robot faces there. The map labels each image with its dstate.

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
from sklearn.base import BaseEstimator
from sklearn.neighbors import NearestNeighbors

from perception.quality import NOISE, warn_of_doubts
from perception.recognition import cloned, recogniser
from perception.views import ISOLATED, ViewClusterer, as_view_clusterer
from ssh_abduction.data.checks import a_whole_number
from ssh_abduction.data.drives import Drive, drives_of, joined_drives, pieces_in_words
from ssh_abduction.data.errors import AbductionError
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.data.words import counted
from ssh_abduction.learning.runner_up import RunnerUpWarning, second_map
from ssh_abduction.learning.traces import Traces
from ssh_abduction.runtime.loggers import log_of
from ssh_abduction.solution import Solution, Status
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
    """A scikit-learn estimator that learns to recognise dstates from images and actions.

    A dstate (distinctive state) is a place and a heading. The learner needs no names of places.
    Given several traces of one building, it clusters the images of all traces into views, and finds
    a joint map of the traces. This map gives each image its label.

    If several joint maps are minimal and `choose` is None, the images decide. The learner pairs
    each image with the most similar image of another trace, and keeps the maps that put most of
    these pairs at one dstate.

    Args:
        theory: The axioms; Theory.topological() by default.
        clusterer: A ViewClusterer or a clusterer of scikit-learn, which groups images into views.
            It is cloned. The default is ViewClusterer(random_state=0). If the theory allows
            misread views, the default also has `isolated=10`: an image that is like no other one
            gets no view, and treating it as misread costs little.
        choose: Index, from 0, of the minimal map to take. None takes the first map, but learns only
            from the labels on which all minimal maps agree.
        time_limit: Seconds for finding the map; None for no limit.
        features: A transformer of scikit-learn that makes vectors of images. It is cloned. The
            default makes reciprocals of ranges, or is a PanoramaTransformer for panoramas.

    Attributes:
        features_: The fitted transformer.
        clusterer_: The fitted clusterer.
        views_: The number of the view of each step, (n,); -1 for an image without a view. n counts
            the steps of all traces, one after the other.
        confidence_: The confidence in each view, (n,), from 0 to 1.
        solution_: The minimal maps; for several traces, their joint maps.
        map_: The map that the labels come from.
        second_map_: A SecondMap, if another number of views separates the images about as well and
            gives another map; else None.
        labels_: The id of the dstate of each step, (n,); -1 if it is unknown: the maps disagree, or
            the image has no view.
        recogniser_: The recogniser, trained on images with a label. Images that the map treats as
            misread are left out.

    Reference:
        Kuipers & Beeson 2002, "Bootstrap Learning for Place Recognition", Figure 1.
    """

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
        """Cluster images, find a map, and train the recogniser on it. Return this learner.

        Args:
            X: A trace with images, or traces of one world.
            y: Ignored. scikit-learn passes it.

        Raises:
            LearnerError: There is no map, or no label is left to learn from.
            PerceptionError: The images cannot be clustered.
            TraceError: A trace lacks what the theory needs, or the traces differ in what they
                record, such as stars.
        """
        traces, theory = Traces.of(X), checked_theory(self.theory)

        # 1. Views: cluster the images.
        features = traces.features
        if self.features is not None:
            features = cloned("features", self.features, "transform")
        self.features_ = features.fit(traces.images)
        vectors = self.features_.transform(traces.images)
        clusterer = ViewClusterer(random_state=0, isolated=ISOLATED if theory.misread else None)
        if self.clusterer is not None:
            clusterer = as_view_clusterer(cloned("clusterer", self.clusterer))
        self.clusterer_ = clusterer.fit(vectors)
        self.views_, self.confidence_ = self.clusterer_.labels_, self.clusterer_.confidence_
        warn_of_doubts(self.views_, self.confidence_, self.clusterer_.quality_[self.clusterer_.k_])
        _log.info("%d images, %d views", len(traces.images), self.clusterer_.k_)

        # 2. Map: find the minimal maps of the trace, or the joint maps of the traces.
        second_views = self.clusterer_.runner_up_labels_
        seen = traces.with_views(vectors, self.views_, second_views, self.confidence_).joint
        self.solution_ = solve(seen, theory, time_limit=self.time_limit)
        self.map_, labels = map_of(self.solution_, vectors, self.choose)
        warn_of_pieces(seen, self.map_)
        self.second_map_ = second_map(seen, self.solution_.maps, theory, self.time_limit)
        if self.second_map_:
            warnings.warn(self.second_map_.sentence, RunnerUpWarning, stacklevel=2)
        _log.info("a map of %d dstates", len(self.map_.dstates))

        # 3. Labels: the map gives the dstate of each image that has a view.
        self.labels_ = np.where(self.views_ == NOISE, -1, labels)

        # 4. Recogniser: learn from the images whose label is sure.
        misread = [fault.step for fault in self.map_.faults if fault.kind == "misread"]
        is_sure = self.labels_ >= 0
        is_sure[np.asarray(misread, np.intp)] = False
        self.recogniser_ = recogniser(features=self.features_).fit(
            traces.images[is_sure], self.labels_[is_sure]
        )
        _log.info("a recogniser of %d images", is_sure.sum())
        return self

    def predict(self, X: Trace | Sequence[Trace] | ArrayLike) -> NDArray[np.intp]:
        """Recognise where images were taken. Return the ids of dstates in `map_`, (m,).

        Args:
            X: Images, (m, d), or traces with m steps in all.

        Raises:
            LearnerError: `fit` was not called yet.
        """
        if not hasattr(self, "recogniser_"):
            raise LearnerError(
                "learner: expected a fitted one, got a new one; call fit with a trace first"
            )
        images = Traces.of(X).images if Traces.are(X) else X
        return np.asarray(self.recogniser_.predict(images), np.intp)

    def score(self, X: Trace | Sequence[Trace] | ArrayLike, y: ArrayLike | None = None) -> float:
        """Compute the share of images that are recognised correctly, from 0 to 1.

        Args:
            X: Images, (m, d), or traces with m steps in all.
            y: The true dstates, (m,), as ids in `map_`. Images with a negative one do not count.
                None estimates the true dstates: it follows each trace on the map from each dstate,
                and takes the walk that no view contradicts and that fits most images.

        Raises:
            LearnerError: `fit` was not called yet, images are given without `y`, no dstate is
                known, or `y` has another shape.
        """
        found = self.predict(X)
        if y is None and not Traces.are(X):
            raise LearnerError(
                "y: expected the dstates of the images, got none; "
                "give them, or traces, which are followed on the map"
            )
        if y is None:
            traces = Traces.of(X)
            views = self.clusterer_.predict(self.features_.transform(traces.images))
            y = labels_on(self.map_, traces, views, found)
        true = np.asarray(y)
        if true.shape != found.shape:
            raise LearnerError(
                f"y: expected {len(found)} dstates, one per image, "
                f"got an array of shape {true.shape}; give one label for each image"
            )
        if not (true >= 0).any():
            raise LearnerError(
                "traces: expected steps whose dstate follows from the map, got none; "
                "give traces of the building that was mapped"
            )
        return float(np.mean(found[true >= 0] == true[true >= 0]))


class LearnerError(AbductionError, ValueError):
    """The learner has nothing to learn from or to score by, or `fit` was not called yet.

    For example, there is no map, or the maps agree on no label.
    """


class AmbiguousMapWarning(UserWarning):
    """The labels may be wrong or incomplete.

    The reason is one of these: several minimal maps remain, the map is not proven minimal, or it
    is in pieces that share no place.
    """


def labels_of(
    maps: Sequence[SSHMap], choose: int | None = None, complete: bool = True, proven: bool = True
) -> NDArray[np.intp]:
    """Label each step with the id of its dstate, (n,).

    With `choose`, labels come from that map. Without it, they are the ids of the first map, and
    -1 for each step on which the maps disagree. Maps agree on a step if the first step at the
    dstate of this step is the same in all maps.

    Without `choose`, issue an AmbiguousMapWarning if the maps disagree on a step, if `complete` is
    false, or if `proven` is false.

    Args:
        maps: The minimal maps of one trace.
        choose: Index of the map to take, from 0; None takes the labels on which all maps agree.
        complete: Whether `maps` are all minimal maps.
        proven: Whether `maps` are proven minimal.

    Raises:
        LearnerError: There is no map, `choose` is no index of a map, the maps have different
            numbers of steps, or they agree on no label.
    """
    if not maps:
        raise LearnerError(
            "maps: expected at least one to take labels from, got none; see the solution's status"
        )
    if choose is not None:
        mend = "give the index of a map of the solution"
        a_whole_number("map", choose, LearnerError, 0, len(maps) - 1, what="an index", mend=mend)
    labels = np.array(maps[choose or 0].dstate_at, np.intp)
    if choose is not None:
        return labels
    for i, ssh_map in enumerate(maps):
        if len(ssh_map.dstate_at) != len(labels):
            raise LearnerError(
                f"maps: expected maps of one trace, {len(labels)} labels each, "
                f"got {len(ssh_map.dstate_at)} in map {i + 1}; solve one trace"
            )
    # Maps number their dstates differently. So compare dstates by the first step at each.
    first = [_first_steps(ssh_map) for ssh_map in maps]
    agreed = np.all([f == first[0] for f in first], axis=0)
    if not proven:
        warnings.warn(
            f"the map of {len(maps[0].dstates)} dstates is the best that was found, and not proven "
            "minimal: its labels may be wrong; give more time, or look for bad views",
            AmbiguousMapWarning,
            stacklevel=2,
        )
    elif not agreed.all() or not complete:
        one = len(maps) == 1
        number = f"{'' if complete else 'at least '}{counted(len(maps), 'minimal maps')}"
        warnings.warn(
            f"{number} remain{'s' if one else ''}, and agree on {agreed.sum()} of {len(agreed)} "
            "labels: only these are learnt from; choose a map, or explore more",
            AmbiguousMapWarning,
            stacklevel=2,
        )
    if not agreed.any():
        raise LearnerError(
            "labels: expected labels on which all maps agree, got none; choose a map"
        )
    return np.where(agreed, labels, -1)


def map_of(
    solution: Solution, vectors: NDArray[np.float64], choose: int | None = None
) -> tuple[SSHMap, NDArray[np.intp]]:
    """Return the map to learn from, and the labels of its n steps, (n,), as `labels_of` makes them.

    `vectors` has the vector of each image, (n, d). Views say little about how drives relate. So
    if there are several joint maps, only those that fit the images best are kept.
    """
    maps: Sequence[SSHMap] = solution.maps
    if choose is None and len(maps) > 1 and len(solution.drives) > 1:
        maps = fitting_best(maps, solution.drives, vectors)
    labels = labels_of(maps, choose, solution.complete, solution.status is Status.OPTIMAL)
    return maps[choose or 0], labels


def fitting_best(
    maps: Sequence[SSHMap], drives: Sequence[Drive], vectors: NDArray[np.float64]
) -> list[SSHMap]:
    """Choose the joint maps that put most images at the same dstate as their most similar image.

    The most similar image is one of another drive. `vectors` has the vector of each image, (n, d).
    """
    nearest = np.zeros(len(vectors), np.intp)
    steps = np.arange(len(vectors))
    for drive in drives:
        own = (steps >= drive.first) & (steps < drive.stop)
        found = NearestNeighbors(n_neighbors=1).fit(vectors[~own]).kneighbors(vectors[own])[1]
        nearest[own] = steps[~own][found[:, 0]]
    labels = np.array([ssh_map.dstate_at for ssh_map in maps])
    fits = (labels == labels[:, nearest]).sum(axis=1)
    return [ssh_map for ssh_map, count in zip(maps, fits, strict=True) if count == fits.max()]


def warn_of_pieces(trace: Trace, ssh_map: SSHMap) -> None:
    """Issue an AmbiguousMapWarning if a map leaves drives of a trace in pieces.

    Then one dstate may have two labels: one in each piece.
    """
    drives = drives_of(trace)
    if len(joined_drives(drives, ssh_map)) > 1:
        warnings.warn(
            f"{pieces_in_words(drives, ssh_map)}: a dstate that is in several pieces gets several "
            "labels; let each drive pass places of another drive",
            AmbiguousMapWarning,
            stacklevel=3,
        )


def labels_on(
    ssh_map: SSHMap, traces: Traces, views: NDArray[np.intp], looks: NDArray[np.intp]
) -> NDArray[np.intp]:
    """Follow traces on a map. Return the dstate of each step, (n,), or -1 if it is unknown.

    `views` has the number of the view of each step, (n,), or -1, and `looks` the dstate that
    its image looks like. A dstate that no image looks like counts as unknown.
    """
    parts = zip(traces.each, traces.parts(views), traces.parts(looks), strict=True)
    found = np.concatenate(
        [_followed(ssh_map, trace, seen.tolist(), like) for trace, seen, like in parts]
    )
    return np.where(np.isin(found, looks), found, -1)


def _followed(
    ssh_map: SSHMap, trace: Trace, views: Sequence[int], looks: NDArray[np.intp]
) -> NDArray[np.intp]:
    """Follow a trace that may begin at any dstate. Return the dstate of each step, (m,).

    `views` and `looks` are as in `labels_on`. Try each dstate as the first one. Drop the dstates
    that a later view contradicts. Take the dstate for which most images look like their dstates.
    After an action for which the map has no link, dstates are unknown (-1) and contradict no view.
    All steps get -1 if two first dstates fit equally many images, or if the best one fits fewer
    than half of the steps with a known dstate.
    """
    leads = {(here, action): there for here, action, there in ssh_map.links}
    ways = [[start] for start in range(len(ssh_map.dstates))]
    for way in ways:
        for action in trace.actions:
            way.append(leads.get((way[-1], action.name), -1))
    at, seen = np.array(ways), np.array(views, object)
    expected = np.array([*(s.view for s in ssh_map.dstates), None], object)[at]
    contradicted = (at >= 0) & (seen != NOISE) & (expected != seen)
    fits = np.where(contradicted.any(axis=1), 0, (at == looks).sum(axis=1))
    # Take the way that fits most images, unless there is a tie.
    best = int(fits.argmax())
    others = np.delete(fits, best)
    sure = fits[best] >= (at[best] >= 0).sum() / 2 and fits[best] > others.max(initial=0)
    return at[best] if sure else np.full(len(views), -1, np.intp)


def _first_steps(ssh_map: SSHMap) -> NDArray[np.intp]:
    """For each step, find the first step that is at the same dstate, (n,)."""
    _, first, dstates = np.unique(ssh_map.dstate_at, return_index=True, return_inverse=True)
    return np.asarray(first[dstates], np.intp)
