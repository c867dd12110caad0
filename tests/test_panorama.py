"""Panoramas: the camera, features that hardly depend on light, and the bootstrap loop on them."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from panorama_camera import CEILING, EYE, STEEPEST, Camera, Light, Paint
from paper_experiments import VIEWS_ALONE, one_to_one, true_dstates
from sklearn.cluster import AgglomerativeClustering
from sklearn.preprocessing import FunctionTransformer

from perception.appearance import PanoramaTransformer, features_of
from perception.errors import PerceptionError
from perception.images import images_of
from perception.quality import uncertainty_coefficient
from perception.recognition import recogniser
from perception.store import load, save
from perception.views import ViewClusterer
from simulator.errors import SimulatorError
from simulator.robot import BEARINGS, Laser
from simulator.tours import simulate
from simulator.world import World
from ssh_abduction.data.trace import Trace
from ssh_abduction.learning.learner import BootstrapLearner

ROOM = World.named("notched-rectangle")
SMALL = Camera(rows=12, columns=60, paint=Paint(5, repeated=True), hours=(7.0, 19.0))


@pytest.fixture(scope="module")
def run() -> Trace:
    return simulate(ROOM, tours=5, seed=500, camera=SMALL)


def test_wall_heights_in_a_panorama_fit_laser_ranges(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(Paint, "texture", lambda self, key: np.array([0.9] * 13 + [0.0] * 36))
    monkeypatch.setattr("panorama_camera.ACROSS", 1)
    world, pose = World.named("taylor-hall"), (13.0, 0.2, 0.3)
    camera = Camera(rows=2000 // 4, columns=360, noise=0, exposure=0)
    bright = camera.scene(world, pose, Light(np.ones(3)))[..., 0] > 0.7
    bearings = math.pi - (np.arange(360) + 0.5) * math.tau / 360
    ahead = np.abs(bearings) < math.pi / 2
    assert np.allclose(bearings[ahead][::-1], BEARINGS)
    ranges = Laser(reach=1e6).exact(world, np.array([pose]))[0][::-1]
    height = bright[:, ahead].mean(axis=0) * 2 * STEEPEST
    expected = np.minimum((CEILING - EYE) / ranges, STEEPEST) + np.minimum(EYE / ranges, STEEPEST)
    assert ranges.min() < 1.3
    assert ranges.max() > 10
    assert np.abs(height - expected).max() < 0.005


def test_turning_the_robot_shifts_the_panorama() -> None:
    camera = Camera(noise=0, hours=(20.0, 20.0))
    rng = np.random.default_rng(0)
    first, turned = (
        camera.shot(ROOM, (3.0, 0.8, math.radians(degrees)), rng, 20.0) for degrees in (10.0, 50.0)
    )
    differences = np.abs(np.roll(first, 20, axis=1).astype(int) - turned)
    assert (differences > 1).mean() < 0.01  # Rays at the edge of a stripe.
    assert np.abs(first.astype(int) - turned).mean() > 5


def test_middle_of_a_panorama_is_straight_ahead() -> None:
    """Facing the near wall of a room, the robot sees it higher in the middle than behind itself."""
    image = Camera(noise=0).shot(ROOM, (3.8, 1.0, 0.0), np.random.default_rng(0)).astype(int)
    floor = np.abs(image[-1] - image[-1, 0]).max(axis=1) > 3
    assert floor[90]
    assert not floor[:3].any()


def test_only_repeated_textures_make_opposite_corners_look_alike() -> None:
    rectangle = replace(
        ROOM, segments=np.array([[0, 0, 4, 0], [4, 0, 4, 2], [4, 2, 0, 2], [0, 2, 0, 0]], float)
    )
    rng, poses = np.random.default_rng(0), ((3.4, 1.4, -math.pi / 2), (0.6, 0.6, math.pi / 2))
    for repeated in (True, False):
        a, b = (
            Camera(paint=Paint(2, repeated), noise=0).shot(rectangle, pose, rng, 20.0).astype(int)
            for pose in poses
        )
        assert (np.abs(a - b).max() <= 1) == repeated
    a, b = (
        Camera(paint=Paint(2, repeated=True), noise=0).shot(rectangle, pose, rng, 12.0).astype(int)
        for pose in poses
    )
    assert np.abs(a - b).mean() > 5  # The sun is at one side.


def test_moved_clutter_keeps_its_texture() -> None:
    paint = Paint(1)
    box = np.array([[1.0, 1, 2, 1], [2, 1, 2, 2], [2, 2, 1, 2], [1, 2, 1, 1]])
    before = paint.keys(np.vstack([ROOM.segments, box]), len(ROOM.segments))
    after = paint.keys(np.vstack([ROOM.segments, box + 0.37]), len(ROOM.segments))
    assert before == after
    assert paint.keys(box, 4) != paint.keys(box + 0.37, 4)


def test_light_is_brightest_at_noon_and_reddest_in_the_morning() -> None:
    noon, morning, night = Light.at(12), Light.at(7), Light.at(23)
    assert noon.colour.sum() > morning.colour.sum() > night.colour.sum() > 0
    assert morning.colour[0] / morning.colour[2] > noon.colour[0] / noon.colour[2]
    assert noon.on(np.array([-math.pi / 2]))[0] > 1 > noon.on(np.array([math.pi / 2]))[0]
    assert night.on(np.array([0.0, 1.0, 2.0])).tolist() == [1, 1, 1]


def test_exposure_compensates_for_brightness() -> None:
    rng = np.random.default_rng(0)
    by = {
        exposure: [
            float(Camera(exposure=exposure, noise=0).shot(ROOM, ROOM.start, rng, hour).mean())
            for hour in (9.0, 23.0)
        ]
        for exposure in (0.0, 0.5, 1.0)
    }
    ratios = [day / night for day, night in by.values()]
    assert ratios[0] > 2 > ratios[1] > 1.3 > ratios[2]
    assert ratios[2] == pytest.approx(1, abs=0.06)  # Bright patches are cut off at 255.


def test_features_do_not_change_with_the_light() -> None:
    """Brightness and colour do not change features; the hour does less than the place."""
    rng = np.random.default_rng(0)
    images = rng.uniform(5, 250, (4, 12 * 60 * 3))
    made = PanoramaTransformer(SMALL.shape, floor=0).fit(images)
    assert np.allclose(
        made.transform(images),
        made.transform((images.reshape(4, -1, 3) * [0.9, 0.5, 0.2]).reshape(4, -1)),
    )
    poses = [s.pose for s in ROOM.dstates]
    hours = (7.0, 10.0, 13.0, 16.0, 19.0)
    camera = replace(SMALL, paint=Paint(5))
    table = np.array(
        [camera.shot(ROOM, pose, rng, hour).ravel() for pose in poses for hour in hours], float
    )
    of = np.repeat(np.arange(len(poses)), len(hours))
    for features, parted in (
        (PanoramaTransformer(SMALL.shape), True),
        (FunctionTransformer(), False),
    ):
        x = features.fit_transform(table)
        distances = np.linalg.norm(x[:, None] - x, axis=2)
        same = of[:, None] == of
        assert (distances[same].max() < distances[~same].min()) == parted


def test_last_patches_of_a_panorama_may_be_smaller() -> None:
    image = np.arange(5 * 7, dtype=float).reshape(1, -1)
    made = PanoramaTransformer((5, 7, 1), patch=(3, 4), floor=1.0).fit_transform(image)
    table = image.reshape(5, 7)
    means = np.array(
        [[table[:3, :4].mean(), table[:3, 4:].mean()], [table[3:, :4].mean(), table[3:, 4:].mean()]]
    )
    logs = np.log(means + 1)
    assert np.allclose(
        made, [[*(logs[0, ::-1] - logs[0]), *(logs[1, ::-1] - logs[1]), *(logs[1] - logs[0])]]
    )


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"shape": (2, 5, 3)}, "images: expected 2 x 5 x 3 values each, got 12"),
        ({"shape": (2, 6)}, r"shape: expected 3 whole numbers of at least 1, got \(2, 6\)"),
        ({"patch": (0, 1)}, "patch: expected 2 whole numbers of at least 1"),
        ({"floor": -1.0}, "floor: expected a number, 0 or more, got -1.0"),
    ],
)
def test_wrong_transformer_settings_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(PerceptionError, match=message):
        PanoramaTransformer(**settings).fit(np.ones((3, 12)))


def test_wrong_images_and_headers_are_refused(run: Trace) -> None:
    with pytest.raises(PerceptionError, match="images: expected values of 0 or more, got -3"):
        PanoramaTransformer().fit([[1.0, 2.0]]).transform([[1.0, -3.0]])
    with pytest.raises(
        PerceptionError, match=r"panorama: expected 3 whole numbers of at least 1, got \[24, 180\]"
    ):
        features_of(replace(run, extra={"panorama": [24, 180]}))
    with pytest.raises(
        PerceptionError, match="trace 1: image: expected one of the kind that trace 0 has"
    ):
        BootstrapLearner(VIEWS_ALONE).fit([run, replace(run, extra={})])


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"rows": 0}, "camera.rows: expected a whole number from 1 to 1,000, got 0"),
        ({"hours": (7.0, 25.0)}, "camera.hours: expected a number from 0 to 24, got 25.0"),
        ({"exposure": math.nan}, "camera.exposure: expected a number from 0 to 1"),
        ({"noise": -1.0}, "camera.noise: expected a number from 0 to 255, got -1.0"),
    ],
)
def test_wrong_camera_settings_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(SimulatorError, match=message):
        Camera(**settings)


def test_camera_does_not_change_the_drive(run: Trace) -> None:
    blind = simulate(ROOM, tours=5, seed=500)
    assert [(s.action, s.star, s.displacement, s.truth) for s in blind.steps] == [
        (s.action, s.star, s.displacement, s.truth) for s in run.steps
    ]
    assert images_of(run).shape == (40, 12 * 60 * 3)
    first, last = (images_of(run)[i].reshape(-1, 3).mean(axis=0) for i in (0, 16))
    assert last.sum() > 1.05 * first.sum()  # From seven o'clock to noon.


@pytest.mark.filterwarnings("ignore::perception.errors.ImageWarning")
def test_learner_finds_the_true_map_from_panoramas_over_a_day(run: Trace) -> None:
    clusterer = ViewClusterer(k_max=12, n_init=3, random_state=0)
    learner = BootstrapLearner(VIEWS_ALONE, clusterer).fit(run)
    assert one_to_one(learner.labels_, true_dstates(run))
    assert (len(learner.map_.dstates), len(learner.map_.places), len(learner.map_.paths)) == (
        8,
        4,
        4,
    )
    later = simulate(ROOM, tours=2, seed=501, camera=replace(SMALL, hours=(19.0, 8.0)))
    assert learner.score(later) == 1
    raw = clusterer.fit(images_of(run) / 255)
    assert (
        uncertainty_coefficient(raw.labels_, true_dstates(run)) < 0.9
    )  # Dstates have several views, so no map of these is the true one.


@pytest.mark.filterwarnings("ignore::perception.errors.ImageWarning")
def test_learner_of_panoramas_accepts_any_clusterer(run: Trace) -> None:
    part = replace(run, steps=(*run.steps[8:23], replace(run.steps[23], action=None)))
    learner = BootstrapLearner(VIEWS_ALONE, AgglomerativeClustering(4, linkage="average")).fit(
        [run, part]
    )
    assert one_to_one(learner.labels_, np.concatenate([true_dstates(run), true_dstates(run)[8:24]]))


def test_recogniser_of_panoramas_survives_a_round_trip(run: Trace, tmp_path: Path) -> None:
    images, labels = images_of(run), np.arange(len(run)) % 8
    save(recogniser(features=features_of(run)).fit(images, labels), tmp_path / "r.skops")
    assert load(tmp_path / "r.skops").predict(images).tolist() == labels.tolist()
