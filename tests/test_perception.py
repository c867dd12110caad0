"""From images to views and a recogniser.

Compared with independent computations and scikit-learn's checks; with poor images and hostile
files.
"""

from __future__ import annotations

import functools
import math
import os
import pickle
import tracemalloc
import warnings
import zipfile
from pathlib import Path
from typing import Any

import images as benchmark
import numpy as np
import pytest
import skops.io
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse.csgraph import minimum_spanning_tree
from scipy.spatial.distance import pdist, squareform
from sklearn.base import clone
from sklearn.cluster import DBSCAN, HDBSCAN, AgglomerativeClustering, KMeans, MeanShift
from sklearn.metrics import adjusted_rand_score, mutual_info_score
from sklearn.mixture import BayesianGaussianMixture, GaussianMixture
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import FunctionTransformer
from sklearn.utils.estimator_checks import parametrize_with_checks

from perception import quality, store, views
from perception.appearance import PanoramaTransformer, ReciprocalTransformer
from perception.errors import ImageWarning, PerceptionError
from perception.quality import (
    cluster_quality,
    cluster_spread,
    confidence,
    nearest_views,
    spanning_tree,
    trimmed_quality,
    uncertainty_coefficient,
    warn_of_doubts,
)
from perception.recognition import (
    PlaceRecogniser,
    recogniser,
)
from perception.views import ViewClusterer, as_view_clusterer
from ssh_abduction.data.errors import AbductionError

Images = np.ndarray[Any, Any]


def blobs(
    clusters: int, each: int, beams: int = 8, spread: float = 0.1, seed: int = 0
) -> tuple[Images, Images]:
    """Images around well-separated centres, and the index of the centre of each."""
    rng = np.random.default_rng(seed)
    centres = 3 * np.eye(max(beams, clusters))[:clusters, :beams] + np.arange(clusters)[:, None]
    truth = np.arange(clusters * each) % clusters
    return centres[truth] + rng.normal(0, spread, (len(truth), beams)), truth


def plain_quality(images: Images, labels: Images) -> float:
    """M computed from all pairs at once."""
    distances, same = squareform(pdist(images)), labels[:, None] == labels
    return float(distances[~same].min() / distances[same].max())


@parametrize_with_checks(
    [
        ReciprocalTransformer(),
        PanoramaTransformer(),
        PlaceRecogniser(),
        ViewClusterer(n_init=1, k_max=6),
        ViewClusterer(clusterer=AgglomerativeClustering(), k_max=6),
        ViewClusterer(clusterer=DBSCAN(eps=1.0)),
    ]
)
@pytest.mark.filterwarnings("ignore")
def test_estimators_keep_the_rules_of_scikit_learn(estimator: Any, check: Any) -> None:
    check(estimator)


# reciprocals


def test_reciprocal_ranges_are_clipped_at_the_floor() -> None:
    assert ReciprocalTransformer(0.1).fit_transform([[0.5, 0.05, 4.0]]).tolist() == [[2, 10, 0.25]]


def test_invalid_ranges_are_replaced_with_one_warning() -> None:
    images = [[np.inf, np.nan, np.inf], [0.0, -1.0, -np.inf]]
    transformer = ReciprocalTransformer(0.5).fit(images)
    with pytest.warns(
        ImageWarning,
        match=r"6 of 6 ranges were replaced: 2 infinite and 1 missing.*3 of zero or less",
    ) as caught:
        assert transformer.transform(images).tolist() == [[0, 0, 0], [2, 2, 2]]
    assert len(caught) == 1


@pytest.mark.parametrize("floor", [0, -1, np.inf, np.nan, "near"])
def test_a_floor_is_a_positive_number(floor: Any) -> None:
    with pytest.raises(PerceptionError, match="floor: expected metres above 0"):
        ReciprocalTransformer(floor).fit([[1.0]])


@pytest.mark.parametrize("estimator", [ReciprocalTransformer(), ViewClusterer()])
def test_images_of_unequal_length_are_named(estimator: Any) -> None:
    with pytest.raises(PerceptionError, match="image 2: expected 2 ranges, as image 0 has, got 3"):
        estimator.fit([[1.0, 2.0], [1.0, 3.0], [1.0, 2.0, 3.0]])


def test_perception_errors_are_errors_of_the_package() -> None:
    assert issubclass(PerceptionError, AbductionError)


# M


@settings(max_examples=20)
@given(
    st.integers(0, 2**32 - 1),
    st.integers(2, 60),
    st.integers(1, 6),
    st.integers(2, 5),
    st.sampled_from(["normal", "grid", "offset"]),
)
def test_cluster_quality_equals_the_ratio_over_all_pairs(
    seed: int, count: int, beams: int, clusters: int, kind: str
) -> None:
    rng = np.random.default_rng(seed)
    images = (
        rng.normal(size=(count, beams))
        if kind != "grid"
        else rng.integers(0, 4, (count, beams)).astype(float)
    )
    images = images + 1e5 if kind == "offset" else images
    labels = rng.integers(clusters, size=count)
    distances, same = squareform(pdist(images)), labels[:, None] == labels
    if same.all():
        expected = math.nan
    elif distances[~same].min() == 0:
        expected = 0.0
    else:
        expected = (
            distances[~same].min() / distances[same].max()
            if distances[same].max() > 0
            else math.inf
        )
    assert cluster_quality(images, labels) == pytest.approx(expected, rel=1e-9, nan_ok=True)
    assert cluster_quality(images, labels, spanning_tree(images)) == pytest.approx(
        expected, rel=1e-9, nan_ok=True
    )


@pytest.mark.parametrize("block", [3, 16, quality.BLOCK])
@pytest.mark.parametrize("scale", [1e-120, 1.0, 1e120])
def test_quality_does_not_depend_on_blocks(
    monkeypatch: pytest.MonkeyPatch, block: int, scale: float
) -> None:
    monkeypatch.setattr(quality, "BLOCK", block)
    images = blobs(5, 60, beams=20, spread=0.5)[0] * scale
    tree, labels = spanning_tree(images), np.random.default_rng(1).integers(4, size=300)
    shortest = minimum_spanning_tree(
        squareform(pdist(images / scale))
    ).sum()  # scipy reads tiny lengths as missing edges.
    assert tree.lengths.sum() == pytest.approx(scale * shortest, rel=1e-12, abs=0)
    assert cluster_quality(images, labels) == pytest.approx(
        plain_quality(images, labels), rel=1e-12, abs=0
    )
    assert cluster_quality(images, labels, tree) == pytest.approx(
        plain_quality(images, labels), rel=1e-12, abs=0
    )


def test_spanning_tree_of_near_images_is_exact() -> None:
    # Squared distances of 1e-14 next to norms of 1e6 are lost in the rounding of |a|² + |b|² - 2ab.
    rng = np.random.default_rng(0)
    images = np.concatenate(
        [1e3 + 1e-7 * rng.normal(size=(40, 12)), -1e3 + 1e-7 * rng.normal(size=(40, 12))]
    )
    tree, labels = spanning_tree(images), rng.integers(3, size=80)
    assert np.allclose(
        tree.lengths,
        np.sort(minimum_spanning_tree(squareform(pdist(images))).data),
        rtol=1e-9,
        atol=0,
    )
    assert tree.separation(labels) == pytest.approx(
        squareform(pdist(images))[labels[:, None] != labels].min(), rel=1e-9, abs=0
    )
    assert cluster_spread(images, np.arange(80) // 40) == pytest.approx(
        max(pdist(images[:40]).max(), pdist(images[40:]).max()), rel=1e-9, abs=0
    )


def test_spanning_tree_serves_every_labelling() -> None:
    images = np.random.default_rng(0).normal(size=(700, 9))
    tree = spanning_tree(images)
    for k in (2, 5, 30):
        labels = KMeans(k, n_init=1, random_state=0).fit(images).labels_
        assert cluster_quality(images, labels, tree) == pytest.approx(
            plain_quality(images, labels), rel=1e-12, abs=0
        )


def test_cluster_quality_of_degenerate_input() -> None:
    images = np.array([[0.0], [0.0], [1.0]])
    assert math.isnan(cluster_quality(images, [0, 0, 0]))
    assert cluster_quality(images, [0, 0, 1]) == math.inf
    assert cluster_quality(images, [0, 1, 1]) == 0
    assert cluster_quality(np.ones((4, 3)), [0, 1, 0, 1]) == 0
    assert cluster_quality(images, ["a", "a", "b"]) == math.inf
    assert spanning_tree(images).distinct == 2
    assert spanning_tree([[1.0, 2.0]]).distinct == 1


def test_many_equal_images_are_clustered_quickly() -> None:
    images = np.repeat(np.random.default_rng(0).normal(size=(3, 5)), 1_000, axis=0)
    assert spanning_tree(images).distinct == 3
    assert cluster_quality(images, np.arange(3_000) // 1_000) == math.inf


@pytest.mark.parametrize("labels", [[0, 1], [[0], [1], [1]], []])
def test_cluster_quality_refuses_a_wrong_number_of_labels(labels: Any) -> None:
    with pytest.raises(PerceptionError, match="labels: expected a row of 3 labels"):
        cluster_quality([[0.0], [1.0], [2.0]], labels)


def test_cluster_quality_refuses_images_that_are_not_finite() -> None:
    with pytest.raises(ValueError, match="infinity"):
        cluster_quality([[0.0], [np.inf]], [0, 1])


def test_cluster_quality_needs_memory_for_blocks_only() -> None:
    images = np.random.default_rng(0).normal(size=(6_000, 4)) + 10 * (np.arange(6_000) % 2)[:, None]
    tracemalloc.start()
    cluster_quality(images, np.arange(6_000) % 2)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 100 * 2**20 < 6_000**2 * 8


# M, trimmed


def test_trimmed_quality_equals_the_ratio_of_quantiles() -> None:
    images, truth = blobs(4, 10, spread=0.4, seed=3)
    distances = squareform(pdist(images))
    for trim in (0.0, 0.1, 0.5):
        gaps = [
            np.quantile(distances[truth == a][:, truth == b], trim)
            for a in range(4)
            for b in range(a)
        ]
        widths = [np.quantile(pdist(images[truth == a]), 1 - trim) for a in range(4)]
        assert trimmed_quality(images, truth, trim) == pytest.approx(min(gaps) / max(widths))
    assert trimmed_quality(images, truth, 0) == pytest.approx(cluster_quality(images, truth))
    with pytest.raises(PerceptionError, match=r"trim: expected a share from 0 to 0\.5, got 0\.6"):
        trimmed_quality(images, truth, 0.6)
    with pytest.raises(PerceptionError, match="labels: expected a row of 40 labels"):
        trimmed_quality(images, truth[1:])


def test_trimmed_quality_of_degenerate_input(monkeypatch: pytest.MonkeyPatch) -> None:
    images = np.array([[0.0], [0.0], [1.0], [3.0]])
    assert math.isnan(trimmed_quality(images, [0, 0, 0, 0]))
    assert trimmed_quality(images, [0, 1, 2, 3]) == 0
    assert trimmed_quality(images, [0, 0, 1, 2]) == math.inf
    many, truth = blobs(3, 100)
    monkeypatch.setattr(quality, "SAMPLE", 60)
    assert trimmed_quality(many, truth) == pytest.approx(
        trimmed_quality(*blobs(3, 20)), rel=0.3
    )  # of a sample
    assert (
        trimmed_quality(many, ~np.isin(np.arange(300), quality.sample_indices(300))) == 0
    )  # a cluster without an image in the sample


def test_one_lost_beam_changes_quality_but_not_trimmed_quality() -> None:
    images, truth = blobs(4, 20)
    spoilt = images.copy()
    spoilt[0, 0] += 2.5  # almost as far as the next cluster
    assert cluster_quality(spoilt, truth) < 0.4 * cluster_quality(images, truth)
    assert trimmed_quality(spoilt, truth) == pytest.approx(trimmed_quality(images, truth), rel=0.05)


# U


@given(st.lists(st.tuples(st.integers(0, 3), st.sampled_from("abcd")), min_size=1, max_size=40))
def test_uncertainty_coefficient_is_information_over_entropy(pairs: list[tuple[int, str]]) -> None:
    seen, truth = zip(*pairs, strict=True)
    shares = np.unique(seen, return_counts=True)[1] / len(seen)
    entropy = -(shares * np.log(shares)).sum()
    expected = mutual_info_score(seen, truth) / entropy if len(shares) > 1 else 1.0
    assert uncertainty_coefficient(seen, truth) == pytest.approx(expected, abs=1e-9)


def test_uncertainty_coefficient_tolerates_aliasing_only() -> None:
    assert uncertainty_coefficient([0, 0, 1, 1], ["a", "b", "c", "c"]) == pytest.approx(1)
    assert uncertainty_coefficient([0, 1, 0, 1], ["a", "a", "b", "b"]) == pytest.approx(0)
    with pytest.raises(PerceptionError, match="truth: expected 2 states, one for each entry"):
        uncertainty_coefficient([0, 1], ["a"])


# views


def test_clusterer_chooses_k_with_the_best_quality() -> None:
    images, truth = blobs(5, 20)
    found = ViewClusterer(random_state=0).fit(images)
    assert found.k_ == 5
    assert adjusted_rand_score(truth, found.labels_) == 1
    assert list(found.quality_) == list(range(2, 21))
    assert (
        found.quality_[5]
        == max(found.quality_.values())
        == pytest.approx(plain_quality(images, found.labels_))
    )
    assert found.cluster_centers_.shape == (5, 8)
    assert (found.predict(images) == found.labels_).all()
    nearest = np.linalg.norm(images[:, None] - found.cluster_centers_, axis=2).argmin(axis=1)
    assert (found.predict(images) == nearest).all()


def test_runner_up_has_nearly_the_best_trimmed_quality() -> None:
    """Two pairs of near clusters: the farther the pairs, the less reason for four."""
    rng = np.random.default_rng(0)
    found = {}
    for gap in (0.3, 0.5, 1.1, 4.0):
        images = np.concatenate([rng.normal(c, 0.1, (15, 6)) for c in (0, gap, 8, 8 + gap)])
        found[gap] = ViewClusterer(k_max=6, random_state=0).fit(images)
    assert [(f.k_, f.runner_up_) for f in found.values()] == [(2, None), (2, 4), (2, 4), (4, None)]
    assert (
        found[0.5].trimmed_[2] > 3 * found[0.5].trimmed_[4] > 3 * 2.3
    )  # Four are also well separated, but two are much farther apart.
    assert found[1.1].runner_up_labels_ is found[1.1].labels_by_k_[4]
    assert (
        found[1.1].labels_by_k_.keys() == found[1.1].trimmed_.keys() == found[1.1].quality_.keys()
    )
    spoilt = images.copy()
    spoilt[0, 0] += (
        # One beam of one image is off by the distance to the next cluster, so M gives the image a
        # view.
        4
    )
    by = {
        by: ViewClusterer(k_max=6, by=by, random_state=0).fit(spoilt).k_ for by in ("M", "trimmed")
    }
    assert by == {"M": 5, "trimmed": 4}
    assert (
        ViewClusterer(k=3).fit(images).runner_up_,
        ViewClusterer(clusterer=DBSCAN(eps=1.0)).fit(images).runner_up_,
    ) == (None, None)
    with pytest.raises(PerceptionError, match="by: expected M or trimmed, got 'U'"):
        ViewClusterer(by="U").fit(images)


def test_many_images_are_clustered_from_a_sample(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(views, "MANY", 60)
    images, truth = blobs(5, 100)
    found = ViewClusterer(k_max=8, random_state=0).fit(images)
    assert found.k_ == 5
    assert adjusted_rand_score(truth, found.labels_) == 1


def test_equal_seeds_give_equal_views() -> None:
    images = np.random.default_rng(0).normal(size=(80, 4))
    first, second = (ViewClusterer(random_state=3).fit(images) for _ in range(2))
    assert first.quality_ == second.quality_
    assert (first.labels_ == second.labels_).all()


@pytest.mark.parametrize("clusterer", [AgglomerativeClustering(), KMeans(n_init=2)])
def test_clusterers_with_k_are_tried_for_every_k(clusterer: Any) -> None:
    images, truth = blobs(4, 15)
    before = clusterer.get_params()
    found = ViewClusterer(clusterer=clusterer, k_max=7, random_state=0).fit(images)
    assert (found.k_, sorted(found.quality_)) == (4, [2, 3, 4, 5, 6, 7])
    assert clusterer.get_params() == before
    assert (found.predict(images) == found.labels_).all()
    assert adjusted_rand_score(truth, found.predict(images + 0.01)) == 1


@pytest.mark.parametrize("clusterer", [DBSCAN(eps=1.0, min_samples=3), MeanShift(bandwidth=1.5)])
def test_clusterers_without_k_are_fitted_once(clusterer: Any) -> None:
    images, truth = blobs(4, 15)
    found = ViewClusterer(clusterer=clusterer).fit(images)
    assert found.k_ == 4
    assert list(found.quality_) == [4]
    assert adjusted_rand_score(truth, found.predict(images)) == 1
    assert hasattr(found, "cluster_centers_") == isinstance(clusterer, MeanShift)


def test_noise_gets_no_view() -> None:
    images = np.concatenate([blobs(3, 15)[0], np.full((1, 8), 50.0)])
    found = ViewClusterer(clusterer=DBSCAN(eps=1.0)).fit(images)
    assert found.k_ == 3
    assert found.labels_[-1] == -1
    assert found.predict(images[-1:]).tolist() == [-1]
    assert found.quality_[3] == pytest.approx(plain_quality(images[:-1], found.labels_[:-1]))
    assert found.confidence_[-1] == 0
    assert found.confidence_[:-1].min() > 0.9
    assert math.isnan(found.score(images[-1:]))


@pytest.mark.parametrize(
    ("clusterer", "tried"),
    [
        (GaussianMixture(covariance_type="diag", random_state=0), [2, 3, 4, 5, 6]),
        (AgglomerativeClustering(n_clusters=None, distance_threshold=8.0), [4]),
        (HDBSCAN(min_cluster_size=5, copy=True), [4]),
    ],
)
def test_mixtures_and_thresholds_can_be_clusterers(clusterer: Any, tried: list[int]) -> None:
    images, truth = blobs(4, 15)
    found = ViewClusterer(clusterer=clusterer, k_max=6, random_state=0).fit(images)
    assert (found.k_, list(found.quality_)) == (4, tried)
    assert (
        adjusted_rand_score(truth, found.labels_)
        == adjusted_rand_score(truth, found.predict(images + 0.01))
        == 1
    )
    assert found.score(images) == pytest.approx(plain_quality(images, truth))
    assert found.score(
        images + 0.3 * np.random.default_rng(0).normal(size=images.shape)
    ) < found.score(images)
    assert not hasattr(clusterer, "labels_")
    assert not hasattr(clusterer, "means_")


def test_any_clusterer_becomes_a_view_clusterer() -> None:
    images = blobs(4, 15)[0]
    assert as_view_clusterer(GaussianMixture(3, random_state=0)).fit(images).k_ == 3
    assert as_view_clusterer(DBSCAN(eps=1.0)).fit(images).k_ == 4
    same = ViewClusterer(k=2)
    assert as_view_clusterer(same) is same
    with pytest.raises(
        PerceptionError, match="clusterer: expected a scikit-learn clusterer, such as DBSCAN"
    ):
        as_view_clusterer("k-means")
    with pytest.raises(
        PerceptionError, match="k: AgglomerativeClustering finds the number of clusters itself"
    ):
        ViewClusterer(
            k=3, clusterer=AgglomerativeClustering(n_clusters=None, distance_threshold=1.0)
        ).fit(images)


def test_empty_components_of_a_mixture_give_no_views() -> None:
    images = np.repeat(np.arange(6.0)[:, None] // 2 * 5, 10, axis=0) + np.random.default_rng(
        0
    ).normal(0, 0.1, (60, 2))
    found = ViewClusterer(
        clusterer=BayesianGaussianMixture(
            random_state=0, weight_concentration_prior=1e-3, covariance_type="spherical"
        ),
        k_max=5,
    ).fit(images)
    assert found.k_ == 3
    assert all(len(set(labels.tolist())) == k for k, labels in found.labels_by_k_.items())


# confidence


def test_confidence_compares_the_two_nearest_centres() -> None:
    images, truth = blobs(3, 12)
    sure = confidence(images, truth)
    for i in (0, 7, 35):
        others = [images[(truth == c) & (np.arange(36) != i)].mean(axis=0) for c in range(3)]
        far = [float(np.linalg.norm(images[i] - centre)) for centre in others]
        own, next_ = far[truth[i]], min(far[c] for c in range(3) if c != truth[i])
        assert sure[i] == pytest.approx(next_**2 / (own**2 + next_**2))
    assert sure.min() > 0.98
    between = np.vstack(
        [images, (images[truth == 0].mean(axis=0) + images[truth == 1].mean(axis=0)) / 2]
    )
    assert confidence(between, [*truth, 0])[-1] == pytest.approx(0.5, abs=0.03)
    assert ViewClusterer(k=3, random_state=0).fit(images).confidence_.tolist() == sure.tolist()


def test_confidence_of_degenerate_input() -> None:
    images, truth = blobs(3, 12)
    alone = np.vstack([images, np.full((1, 8), 40.0)])
    assert confidence(alone, [*truth, 3])[-1] == 0.5
    assert confidence(alone, [*truth, -1])[-1] == 0
    assert nearest_views(alone, [*truth, -1]).tolist() == [*truth, 2]
    assert confidence(alone, [0] * 36 + [-1]).tolist() == [1] * 36 + [0]
    assert confidence(np.ones((4, 2)), [0, 0, 1, 1]).tolist() == [0.5] * 4  # all images are equal
    with pytest.raises(PerceptionError, match="expected 36 whole numbers, one per image"):
        confidence(images, truth[1:])
    with pytest.raises(
        PerceptionError, match="expected some that are in a cluster, got 36 that are noise"
    ):
        nearest_views(images, [-1] * 36)


def test_warning_names_doubtful_images_and_views() -> None:
    truth, sure = np.arange(60) % 3, np.full(60, 0.99)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_doubts(truth, sure, 3.0)
    for index, label, certain in ((7, 9, 0.99), (8, 1, 0.6), (9, -1, 0.0)):
        labels, trust = truth.copy(), sure.copy()
        labels[index], trust[index] = label, certain
        with pytest.warns(ImageWarning, match=rf"1 of 60 images fit no view.*\(image {index}\)"):
            warn_of_doubts(labels, trust, 3.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_doubts(
            [0, 1, 2, 2, 0, 3], [0.99, 0.5, 0.99, 0.99, 0.99, 0.5], 3.0
        )  # Nearly all of them were seen once.
    with pytest.warns(ImageWarning, match=r"views overlap \(M is 0\.40, below 1\)"):
        warn_of_doubts(truth, sure, 0.4)


def test_equal_images_give_one_view() -> None:
    with pytest.warns(ImageWarning, match="all 6 images are equal: they are taken as one view"):
        found = ViewClusterer().fit(np.ones((6, 3)))
    assert found.k_ == 1
    assert found.labels_.tolist() == [0] * 6
    assert math.isnan(found.quality_[1])
    assert found.predict([[2.0, 2.0, 2.0]]).tolist() == [0]


def test_k_is_at_most_the_number_of_different_images() -> None:
    images = np.repeat(np.eye(3), 5, axis=0)
    found = ViewClusterer(random_state=0).fit(images)
    assert (found.k_, found.quality_[3], max(found.quality_)) == (3, math.inf, 3)
    assert ViewClusterer().fit([[0.0], [1.0]]).k_ == 2


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"k": 0}, "k: expected a whole number, 1 or more, got 0"),
        ({"k": 2.5}, "k: expected a whole number"),
        ({"k": 4}, "k: expected at most 3, as there are 3 different images among 6, got 4"),
        ({"k_min": 1}, "k_min: expected a whole number, 2 or more"),
        ({"k_min": 5}, "k: expected at most 3"),
        ({"k_min": 5, "k_max": 4}, "k_max: expected at least k_min = 5, got 4"),
        ({"n_init": 0}, "n_init: expected"),
        ({"clusterer": "k-means"}, "clusterer: expected a scikit-learn clusterer"),
        ({"clusterer": DBSCAN(), "k": 2}, "k: DBSCAN finds the number of clusters itself"),
    ],
)
def test_contradicting_clusterer_settings_are_refused(
    settings: dict[str, Any], message: str
) -> None:
    with pytest.raises(PerceptionError, match=message):
        ViewClusterer(**settings).fit(np.repeat(np.eye(3), 2, axis=0))


def test_one_image_cannot_be_clustered() -> None:
    with pytest.raises(ValueError, match=r"1 sample\(s\).*minimum of 2"):
        ViewClusterer().fit([[1.0, 2.0]])


def test_transformer_makes_infinite_ranges_usable() -> None:
    images = 1 / (0.3 + np.abs(blobs(3, 10)[0]))
    images[::7, 0] = np.inf
    with pytest.raises(ValueError, match="infinity"):
        ViewClusterer().fit(images)
    with pytest.warns(ImageWarning, match="5 of 240"):
        labels = make_pipeline(ReciprocalTransformer(), ViewClusterer(random_state=0)).fit_predict(
            images
        )
    assert len(labels) == 30


# recognition


def test_recogniser_returns_the_place_of_the_nearest_image() -> None:
    images, truth = blobs(4, 10)
    places = np.array(["north", "east", "south", "west"])[truth]
    model = PlaceRecogniser().fit(images, places)
    assert model.predict(images + 0.01).tolist() == places.tolist()
    assert model.classes_.tolist() == sorted(set(places))
    assert (model.predict_proba(images).sum(axis=1) == 1).all()
    with pytest.raises(
        PerceptionError,
        match="n_neighbors: expected a whole number from 1 to 40, got 41",
    ):
        PlaceRecogniser(41).fit(images, places)


# files


def fitted() -> Any:
    images, truth = blobs(3, 10)
    return recogniser().fit(1 / (1 + np.abs(images)), np.array(["a", "b", "c"])[truth])


@pytest.mark.parametrize(
    "model",
    [
        ReciprocalTransformer(),
        ViewClusterer(random_state=0),
        ViewClusterer(clusterer=DBSCAN(eps=1.0)),
    ],
)
def test_fitted_estimators_can_be_pickled_and_cloned(model: Any) -> None:
    images = np.abs(blobs(3, 10)[0]) + 1
    model.fit(images)
    again = pickle.loads(pickle.dumps(model))
    method = "predict" if hasattr(model, "predict") else "transform"
    assert (getattr(again, method)(images) == getattr(model, method)(images)).all()
    assert repr(clone(model)) == repr(model)


def test_recogniser_survives_a_round_trip(tmp_path: Path) -> None:
    model, path = fitted(), tmp_path / "a.skops"
    store.save(model, path)
    held = store.load(path)
    images = np.random.default_rng(1).uniform(0.1, 2, (20, 8))
    assert (held.predict(images) == model.predict(images)).all()
    assert held.classes_.tolist() == ["a", "b", "c"]
    assert os.listdir(tmp_path) == ["a.skops"]


@pytest.mark.parametrize("clusterer", [None, AgglomerativeClustering()])
def test_view_clusterer_survives_a_round_trip(tmp_path: Path, clusterer: Any) -> None:
    images = blobs(3, 10)[0]
    model = make_pipeline(
        ReciprocalTransformer(0.5), ViewClusterer(clusterer=clusterer, random_state=0)
    ).fit(np.abs(images) + 1)
    store.save(model, tmp_path / "a.skops")
    held = store.load(tmp_path / "a.skops")
    assert (held.predict(np.abs(images) + 1) == model.predict(np.abs(images) + 1)).all()


class Trap:
    """Makes a file when it is unpickled."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> Any:
        return os.mkdir, (str(self.mark),)


def test_hostile_recogniser_files_run_no_code(tmp_path: Path) -> None:
    mark, good = tmp_path / "mark", tmp_path / "good.skops"
    store.save(fitted(), good)
    whole = good.read_bytes()
    schema = zipfile.ZipFile(good).read("schema.json").decode()
    hostile: dict[str, bytes] = {
        "pickle": pickle.dumps(Trap(mark)),
        "partial": skops.io.dumps(
            {"format": store.FORMAT, "model": functools.partial(os.mkdir, str(mark))}
        ),
        "function": skops.io.dumps(
            {"format": store.FORMAT, "model": FunctionTransformer(os.mkdir)}
        ),
        "cut": whole[: len(whole) // 2],
        "empty": b"",
        "text": b"{}",
        "another object": skops.io.dumps([1, 2]),
        "no classes": skops.io.dumps(
            {"format": store.FORMAT, "version": 1, "model": PlaceRecogniser()}
        ),
        "no model": skops.io.dumps(
            {"format": store.FORMAT, "version": 1, "model": "os", "classes": [], "versions": {}}
        ),
        "another version": skops.io.dumps(
            {"format": store.FORMAT, "version": 99, "model": PlaceRecogniser()}
        ),
    }
    for name, changed in (
        ("no schema", None),
        ("broken schema", "{"),
        (
            "another type",
            schema.replace("PlaceRecogniser", "Popen").replace(
                "perception.recognition", "subprocess"
            ),
        ),
        ("another loader", schema.replace('"ObjectNode"', '"ReduceNode"')),
    ):
        path = tmp_path / "made"
        with zipfile.ZipFile(good) as old, zipfile.ZipFile(path, "w") as new:
            for part in old.namelist():
                if part != "schema.json":
                    new.writestr(part, old.read(part))
            if changed is not None:
                new.writestr("schema.json", changed)
        hostile[name] = path.read_bytes()
    for name, data in hostile.items():
        path = tmp_path / "hostile.skops"
        path.write_bytes(data)
        with pytest.raises(PerceptionError, match="hostile"):
            store.load(path)
        assert not mark.exists(), name


def test_recogniser_file_that_unpacks_too_large_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store.save(fitted(), tmp_path / "a.skops")
    monkeypatch.setattr("perception.images.LARGEST", 100)
    with pytest.raises(PerceptionError, match="expected at most 100 bytes once unpacked"):
        store.load(tmp_path / "a.skops")


def test_missing_recogniser_files_are_errors(tmp_path: Path) -> None:
    with pytest.raises(PerceptionError, match="expected a readable recogniser: No such file"):
        store.load(tmp_path / "none.skops")
    with pytest.raises(PerceptionError, match="cannot write the recogniser: No such file"):
        store.save(fitted(), tmp_path / "none" / "a.skops")


def test_save_refuses_a_model_that_load_would_reject(tmp_path: Path) -> None:
    with pytest.raises(PerceptionError, match="expected a model of types that can be read back"):
        store.save(
            make_pipeline(FunctionTransformer(functools.partial(os.mkdir, "x"))),
            tmp_path / "a.skops",
        )
    assert not os.listdir(tmp_path)


# the benchmark and the docstrings


@pytest.mark.slow
def test_recognition_benchmark_runs(capsys: pytest.CaptureFixture[str]) -> None:
    benchmark.search("dstates", 60)
    assert "60 images" in capsys.readouterr().out
