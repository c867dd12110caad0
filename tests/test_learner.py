"""The bootstrap loop, from a simulated robot to a recogniser, in Python and in the shell."""

from __future__ import annotations

import contextlib
import io
import json
import math
import sys
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import paper_experiments as experiments
import pytest
import reproduce
from paper_experiments import (
    EXPERIMENTS,
    SeedRun,
    claims,
    measure,
    one_to_one,
    outcome,
    rate,
    summary,
    true_dstates,
)
from sklearn.base import clone
from sklearn.cluster import DBSCAN, AgglomerativeClustering
from sklearn.mixture import GaussianMixture
from sklearn.model_selection import cross_val_score

from perception.appearance import ReciprocalTransformer
from perception.errors import ImageWarning, PerceptionError
from perception.images import images_of
from perception.views import ViewClusterer
from simulator.tours import simulate
from simulator.world import World
from ssh_abduction import Theory, Trace, solve
from ssh_abduction.checker.checker import check
from ssh_abduction.cli import main
from ssh_abduction.data import Step, together
from ssh_abduction.data.errors import TraceError
from ssh_abduction.learning.learner import (
    AmbiguousMapWarning,
    BootstrapLearner,
    LearnerError,
    RunnerUpWarning,
    labels_of,
    warn_of_pieces,
)
from ssh_abduction.learning.runner_up import runner_up, second_map, with_runner_up

VIEWS_ALONE = Theory.topological().replace(star="none", displacement="none")
FEW_CIRCUITS = replace(EXPERIMENTS["notched-rectangle"], tours=10, k_max=8)


@pytest.fixture(scope="module")
def run() -> Trace:
    return simulate(World.named("notched-rectangle"), tours=12, seed=500)


@pytest.fixture(scope="module")
def learnt(run: Trace) -> BootstrapLearner:
    """The map learnt from the views of the run alone."""
    return BootstrapLearner(VIEWS_ALONE).fit(run)


@pytest.fixture(scope="module")
def measured() -> SeedRun:
    """The measurements of reproduce.py with seed 500 and, to be fast, few circuits."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(EXPERIMENTS, "notched-rectangle", FEW_CIRCUITS)
        patch.setattr(experiments, "learning_curve", partial(experiments.learning_curve, folds=2))
        return measure("notched-rectangle", 500)


@pytest.fixture(scope="module")
def hall() -> Trace:
    return simulate(World.named("taylor-hall"), tours=3, seed=500)


def test_learner_learns_the_notched_rectangle_from_images(
    run: Trace, learnt: BootstrapLearner
) -> None:
    learner = learnt
    assert learner.clusterer_.k_ == 4
    assert learner.views_[0] == learner.views_[4]
    assert learner.labels_[0] != learner.labels_[4]
    assert (len(learner.map_.dstates), len(learner.map_.places), len(learner.map_.paths)) == (
        8,
        4,
        4,
    )
    assert one_to_one(learner.labels_, true_dstates(run))
    assert check(run.with_views(learner.views_.tolist()), learner.map_, VIEWS_ALONE) == ()
    again = simulate(World.named("notched-rectangle"), tours=3, seed=501)
    meaning = dict(zip(true_dstates(run), learner.labels_, strict=True))
    recognised = learner.predict(images_of(again)) == [
        meaning[name] for name in true_dstates(again)
    ]
    assert recognised.mean() > 0.9


@pytest.mark.slow
def test_learner_learns_taylor_hall_with_stars(hall: Trace) -> None:
    learner = BootstrapLearner(Theory.topological().replace(displacement="none")).fit(hall)
    assert learner.clusterer_.k_ == 10
    assert (len(learner.map_.dstates), len(learner.map_.places), len(learner.map_.paths)) == (
        20,
        7,
        4,
    )
    assert one_to_one(learner.labels_, true_dstates(hall))


def test_learner_refuses_to_predict_before_fit() -> None:
    assert repr(BootstrapLearner(choose=1)) == "BootstrapLearner(choose=1)"
    with pytest.raises(LearnerError, match="call fit with a trace first"):
        BootstrapLearner().predict([[1.0, 2.0]])


def test_learner_does_not_read_the_truth(run: Trace, learnt: BootstrapLearner) -> None:
    bare = replace(run, steps=tuple(replace(step, truth=None) for step in run.steps))
    without = BootstrapLearner(VIEWS_ALONE).fit(bare)
    np.testing.assert_array_equal(learnt.labels_, without.labels_)
    assert learnt.map_ == without.map_


def test_steps_on_which_maps_disagree_get_no_label() -> None:
    trace = Trace.from_steps("abbab", ["travel", "around", "right", "right"])
    solution = solve(trace, VIEWS_ALONE, max_maps=None)
    assert solution.count > 1
    with pytest.warns(
        AmbiguousMapWarning, match=f"{solution.count} minimal maps remain, and agree on"
    ):
        labels = labels_of(solution.maps)
    assert labels.tolist() == [0, 1, 2, 3, -1]
    for t in np.flatnonzero(labels >= 0):
        assert len({m.labels.index(m.labels[t]) for m in solution.maps}) == 1
    for i, ssh_map in enumerate(solution.maps):
        assert labels_of(solution.maps, choose=i).tolist() == list(ssh_map.labels)
    with pytest.raises(LearnerError, match="expected an index from 0"):
        labels_of(solution.maps, choose=99)
    with pytest.raises(LearnerError, match="expected at least one"):
        labels_of([])


def test_learner_warns_of_an_incomplete_list_of_maps() -> None:
    maps = solve(Trace.from_steps("aba", ["travel", "travel"])).maps
    with pytest.warns(AmbiguousMapWarning, match="at least 1 minimal map remains, and agree"):
        labels_of(maps, complete=False)
    with pytest.warns(AmbiguousMapWarning) as caught:
        labels_of(maps, complete=False, proven=False)
    assert [str(w.message).split(":")[0] for w in caught] == [
        (
            f"the map of {len(maps[0].dstates)} dstates is the best that was found, and not "
            "proven minimal"
        )
    ]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        labels_of(maps)


def test_the_learner_is_an_estimator(run: Trace) -> None:
    clusterer = ViewClusterer(k_max=6, random_state=0)
    learner = BootstrapLearner(VIEWS_ALONE, clusterer, time_limit=100)
    again = clone(learner).set_params(choose=0)
    assert again.get_params()["clusterer__k_max"] == 6
    assert (again.choose, learner.choose, again.theory) == (0, None, VIEWS_ALONE)
    assert learner.fit(run) is learner
    assert not hasattr(clusterer, "k_")  # it was cloned
    assert learner.confidence_.shape == learner.labels_.shape == (len(run),)
    assert learner.score(run) == learner.score(images_of(run), learner.labels_) == 1
    other = simulate(World.named("notched-rectangle"), tours=2, seed=502)
    assert 0.9 < learner.score(other) <= 1
    np.testing.assert_array_equal(learner.predict(other), learner.predict(images_of(other)))
    with pytest.raises(LearnerError, match="y: expected the dstates of the images, got none"):
        learner.score(images_of(run))
    with pytest.raises(LearnerError, match="y: expected 96 dstates, one per image"):
        learner.score(run, [1, 2])
    broken = replace(
        other,
        steps=(
            other.steps[0],
            replace(other.steps[1], image=other.steps[3].image),
            *other.steps[2:],
        ),
    )
    with pytest.raises(
        LearnerError, match="expected steps whose dstate follows from the map, got none"
    ):
        learner.score(broken)
    with pytest.raises(TraceError, match="traces: expected a Trace, or a list of them, got"):
        BootstrapLearner().fit("run.jsonl")  # type: ignore[arg-type]
    assert (
        cross_val_score(
            BootstrapLearner(VIEWS_ALONE, ViewClusterer(k=4, random_state=0)), [run, other], cv=2
        ).min()
        > 0.85
    )


@pytest.mark.slow
def test_learner_fits_several_traces_with_one_map(run: Trace) -> None:
    short = simulate(World.named("notched-rectangle"), tours=2, seed=503)
    late = replace(short, steps=short.steps[3:])  # begins at x3
    drives = [late, run, short]
    learner = BootstrapLearner(VIEWS_ALONE, ViewClusterer(k_max=6, random_state=0)).fit(drives)
    # The room has two ends that look alike. Each drive may begin at either, by views alone.
    assert len(learner.solution_.maps) == 4
    assert one_to_one(learner.labels_, np.concatenate([true_dstates(t) for t in drives]))
    assert len(learner.map_.dstates) == 8
    assert learner.solution_.steps == len(learner.labels_) == sum(map(len, drives))
    # Without images, only labels on which all four maps agree are learnt from.
    with pytest.warns(AmbiguousMapWarning, match="4 minimal maps remain, and agree on 13 of"):
        labels_of(learner.solution_.maps)
    with pytest.warns(UserWarning, match="trace 2 has no view in common with another trace"):
        apart = together([Trace.from_steps("ab", ["travel"]), Trace.from_steps("xy", ["travel"])])
    with pytest.warns(AmbiguousMapWarning, match="the map is in 2 pieces that share no place: "):
        warn_of_pieces(apart, solve(apart, Theory.causal()).maps[0])
    narrow = replace(short, steps=tuple(replace(s, image=s.image[:90]) for s in short.steps))
    with pytest.raises(
        PerceptionError, match="trace 1: image: expected 180 ranges, as trace 0 has, got 90"
    ):
        BootstrapLearner().fit([run, narrow])


@pytest.mark.parametrize(
    "clusterer",
    [
        GaussianMixture(4, covariance_type="spherical", random_state=0),
        AgglomerativeClustering(n_clusters=None, distance_threshold=6.0),
        ViewClusterer(clusterer=AgglomerativeClustering(linkage="complete"), k_max=10),
    ],
)
def test_learner_accepts_any_clusterer(run: Trace, clusterer: Any) -> None:
    assert one_to_one(BootstrapLearner(VIEWS_ALONE, clusterer).fit(run).labels_, true_dstates(run))


def test_learner_ignores_images_that_are_noise(run: Trace) -> None:
    odd = replace(
        run,
        steps=(
            *run.steps[:-1],
            replace(run.steps[-1], image=tuple(0.7 * r for r in run.steps[-1].image)),
        ),
    )
    with pytest.warns(ImageWarning, match=r"1 of 96 images fit no view.*\(image 95\)"):
        learner = BootstrapLearner(VIEWS_ALONE, DBSCAN(eps=1.5), time_limit=100).fit(odd)
    assert (learner.views_[-1], learner.confidence_[-1], learner.labels_[-1]) == (-1, 0, -1)
    assert (learner.labels_[:-1] >= 0).all()
    assert set(learner.recogniser_.classes_) == set(learner.labels_[:-1].tolist())


# Doubts about the number of views


@pytest.fixture(scope="module")
def large_room() -> Trace:
    """Eight circuits in a room a tenth larger, where M prefers 2 views and trimmed M 4."""
    world = World.named("notched-rectangle")
    walls = world.segments.copy()
    walls[walls > 0] *= 1.1
    trace = simulate(
        replace(world, segments=walls, start=(3.8, 1.6, 0.0), dstates=()),
        tours=8,
        seed=500,
        stars=False,
    )
    return replace(
        trace.without_displacements(),
        steps=tuple(replace(s, displacement=None, covariance=None) for s in trace.steps),
    )


@pytest.mark.slow
def test_learner_warns_if_the_runner_up_gives_another_map(large_room: Trace) -> None:
    with pytest.warns(
        RunnerUpWarning,
        match=(
            "2 views may be too few: 4 also separate .* another map, of 8 dstates instead of 6; "
            "cluster"
        ),
    ):
        learner = BootstrapLearner(clusterer=ViewClusterer(k_max=6, random_state=0)).fit(large_room)
    assert (learner.clusterer_.k_, learner.clusterer_.runner_up_, len(learner.map_.dstates)) == (
        2,
        4,
        6,
    )
    with pytest.warns(RunnerUpWarning, match="4 views may be too many: 2 also separate"):
        trimmed = BootstrapLearner(
            clusterer=ViewClusterer(by="trimmed", k_max=6, random_state=0)
        ).fit(large_room)
    assert len(trimmed.map_.dstates) == 8


def test_cluster_and_solve_warn_of_the_runner_up(
    large_room: Trace, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    said = (
        "ssh-abduction: warning: 2 views may be too few: 4 also separate the images well, and "
        "give another map, of 8 dstates instead of 6"
    )
    run, views = str(tmp_path / "run.jsonl"), str(tmp_path / "views.jsonl")
    large_room.save(run)
    assert main(["cluster", run, "-o", views, "--set", "k_max=6"]) == 0
    clustered = capsys.readouterr()
    assert clustered.err.startswith(said)
    marks = [line.split()[3:] for line in clustered.out.splitlines()[1:4]]
    assert marks == [["chosen"], [], ["runner-up"]]
    assert main(["solve", views]) == 0
    assert capsys.readouterr().err.startswith(said)
    assert main(["solve", views, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["warnings"][0].startswith(
        said[len("ssh-abduction: warning: ") :]
    )
    assert main(["solve", views, "--time-limit", "0.1"]) in {0, 10}  # no time for the warning
    assert capsys.readouterr().err == ""
    assert main(["cluster", views, "-o", views, "--k", "4"]) == 0
    assert capsys.readouterr().err == ""
    assert "runner_up" not in Path(views).read_text()


def test_partial_runner_up_is_refused() -> None:
    trace = Trace.from_steps("aba", ["travel", "travel"])
    assert runner_up(trace) is None
    other = with_runner_up(trace, "abc")
    assert runner_up(other) == replace(
        trace.with_views("abc"),
        steps=tuple(replace(s, view=v) for s, v in zip(other.steps, "abc", strict=True)),
    )
    assert with_runner_up(other, None) == trace
    half = replace(trace, steps=(other.steps[0], *trace.steps[1:]))
    with pytest.raises(
        TraceError, match="step 1: runner_up: expected a view, as other steps have one"
    ):
        runner_up(half)
    wrong = replace(trace, steps=tuple(replace(s, extra={"runner_up": 1.5}) for s in trace.steps))
    with pytest.raises(
        TraceError, match=r"runner_up: views\[0\]: expected a text or an integer, got 1.5"
    ):
        runner_up(wrong)
    assert (
        second_map(with_runner_up(trace, "xyx"), solve(trace).maps) is None
    )  # other names of the same views
    found = second_map(
        with_runner_up(trace, "aaa"), solve(trace, Theory.causal()).maps, Theory.causal()
    )
    assert found is not None
    assert found.sentence.startswith(
        "2 views may be too many: 1 also separate the images well, and give another map, of 1 "
        "dstates instead of 2"
    )


# Images


def test_images_are_read_from_a_sidecar_file(run: Trace, tmp_path: Path) -> None:
    table = images_of(run)
    indexed = replace(
        run,
        images="scans.npz",
        steps=tuple(replace(step, image=i) for i, step in enumerate(run.steps)),
    )
    indexed.save(tmp_path / "run.jsonl")
    np.savez(tmp_path / "scans.npz", images=table)
    np.testing.assert_array_equal(images_of(Trace.load(tmp_path / "run.jsonl")), table)
    np.savez(tmp_path / "scans.npz", images=table[:3])
    with pytest.raises(PerceptionError, match="expected an index below 3, got 3"):
        images_of(Trace.load(tmp_path / "run.jsonl"))
    (tmp_path / "scans.npz").write_bytes(b"PK\x03\x04 cut in the middle")
    with pytest.raises(PerceptionError, match=r"scans\.npz: expected a \.npy or \.npz file"):
        images_of(Trace.load(tmp_path / "run.jsonl"))
    (tmp_path / "scans.npz").unlink()
    with pytest.raises(PerceptionError, match=r"scans\.npz: expected a \.npy or \.npz file"):
        images_of(Trace.load(tmp_path / "run.jsonl"))


def test_cluster_into_another_folder_keeps_the_images(
    run: Trace, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    np.savez(tmp_path / "scans.npz", images=images_of(run))
    indexed = replace(
        run,
        images="scans.npz",
        steps=tuple(replace(step, image=i) for i, step in enumerate(run.steps)),
    )
    indexed.save(tmp_path / "run.jsonl")
    (tmp_path / "views").mkdir()
    assert (
        main(
            (f"cluster {tmp_path / 'run.jsonl'} -o {tmp_path / 'views' / 'v.jsonl'} --k 4").split()
        )
        == 0
    )
    capsys.readouterr()
    np.testing.assert_array_equal(
        images_of(Trace.load(tmp_path / "views" / "v.jsonl")), images_of(run)
    )


def test_cluster_reports_replaced_ranges_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table = np.array([[1.0, np.inf, 2.0], [1.0, 1.0, np.nan], [3.0, 1.0, 0.0], [3.0, 1.1, 1.0]])
    np.save(tmp_path / "scans.npy", table)
    steps = [
        Step(image=i, action=Trace.from_steps("ab", ["travel"]).actions[0] if i < 3 else None)
        for i in range(4)
    ]
    Trace(tuple(steps), images="scans.npy").save(tmp_path / "run.jsonl")
    words = ["cluster", str(tmp_path / "run.jsonl"), "-o", str(tmp_path / "v.jsonl")]
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        assert main(words) == 0
    assert capsys.readouterr().err == (
        "ssh-abduction: warning: 3 of 12 ranges were replaced: 1 infinite and 1 missing (NaN) are "
        "taken as nothing seen, "
        "1 of zero or less as 0.05 m\n"
    )


def test_images_of_unequal_shape_are_refused() -> None:
    uneven = Trace((Step(image=(1.0, 2.0), action=None),))
    steps = (
        replace(uneven.steps[0], action=Trace.from_steps("ab", ["travel"]).actions[0]),
        Step(image=(1.0,)),
    )
    with pytest.raises(
        PerceptionError, match="step 1: image: expected 2 ranges, as the first has, got 1"
    ):
        images_of(Trace(steps))
    with pytest.raises(PerceptionError, match="step 0: image: expected one, got none"):
        images_of(Trace.from_steps("ab", ["travel"]))
    with pytest.raises(PerceptionError, match="expected the header to name a file"):
        images_of(Trace((Step(image=3),)))


def test_cluster_counts_or_refuses_poor_images() -> None:
    action = Trace.from_steps("ab", ["travel"]).actions[0]

    def trace_of(*images: tuple[float, ...]) -> Trace:
        return Trace(
            tuple(
                Step(image=image, action=action if i < len(images) - 1 else None)
                for i, image in enumerate(images)
            )
        )

    with pytest.warns(ImageWarning, match="2 of 12 ranges were replaced"):
        BootstrapLearner(Theory.causal()).fit(
            trace_of((1.0, 0.0, 2.0), (1.0, 1.0, 2.0), (3.0, 1.0, 0.0), (3.0, 1.1, 1.0))
        )
    with pytest.warns(ImageWarning, match="images are equal"):
        assert BootstrapLearner(Theory.causal()).fit(
            trace_of((1.0, 2.0), (1.0, 2.0), (1.0, 2.0))
        ).views_.tolist() == [0, 0, 0]
    with pytest.raises(ValueError, match="minimum of 2"):
        BootstrapLearner(Theory.causal()).fit(trace_of((1.0, 2.0)))


# Claims


@pytest.mark.slow
def test_claims_contain_the_figures_of_the_paper(measured: SeedRun) -> None:
    any_k = dict.fromkeys(range(30), 1.0)
    run = replace(measured, quality=any_k)
    for name, e in EXPERIMENTS.items():
        papers = [claim.paper for claim in claims(name, run)]
        assert str(e.views) in papers
        assert f"{e.dstates}, {e.places}, {e.paths}" in papers
        assert "100 %" in papers
    (higher,) = (
        c
        for c in claims("taylor-hall", run)
        if c.text.startswith("higher k would still have been free of variability")
    )
    assert (higher.paper, higher.ours) == ("above 10", False)


def test_recogniser_with_poor_labels_is_poor(run: Trace) -> None:
    truth = true_dstates(run)
    images = images_of(run)
    codes = np.unique(truth, return_inverse=True)[1]
    assert rate(images, codes, truth, 0) > 0.95
    assert rate(images, codes % 4, truth, 0) == pytest.approx(0.5, abs=0.1)
    assert rate(images, np.zeros_like(codes), truth, 0) == pytest.approx(1 / 8, abs=0.05)


@pytest.mark.slow
def test_outcomes_depend_on_notch_and_spread(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(
        EXPERIMENTS, "notched-rectangle", replace(EXPERIMENTS["notched-rectangle"], tours=10)
    )
    good, blurred, bare = outcome(0.03, 0.5), outcome(0.03, 8), outcome(0.0, 0.5)
    assert (good.k, good.right) == (4, True)
    assert good.rate > 0.99
    assert blurred.rate < good.rate
    assert bare.rate < 0.7  # Without a notch, nothing tells opposite corners apart.
    assert (bare.k, bare.right) == (4, True)


# The shell


def test_shell_goes_from_simulation_to_recognition(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def path(name: str) -> str:
        return str(tmp_path / name)

    assert (
        main(f"simulate notched-rectangle --tours 6 --seed 3 -o {path('run.jsonl')}".split()) == 0
    )
    assert "48 images of notched rectangle" in capsys.readouterr().out
    assert (
        main(
            (
                f"cluster {path('run.jsonl')} -o {path('views.jsonl')} --set k_max=8 "
                f"--plot {path('fig.png')}"
            ).split()
        )
        == 0
    )
    out = capsys.readouterr().out
    assert "4 views of 48 images" in out
    assert out.splitlines()[0].split() == ["k", "M", "trimmed", "U"]
    assert (tmp_path / "fig.png").read_bytes().startswith(b"\x89PNG")
    assert main(["solve", path("views.jsonl"), "--json", "--set", "displacement=none"]) == 0
    (tmp_path / "maps.json").write_text(capsys.readouterr().out)
    assert (
        main(["train", path("maps.json"), path("views.jsonl"), "-o", path("recogniser.skops")]) == 0
    )
    assert "8 dstates learnt from 48 images" in capsys.readouterr().out
    assert main(["evaluate", path("maps.json"), path("views.jsonl")]) == 0
    told = capsys.readouterr().out
    assert told.startswith(
        "1 map: map 1 is the true one\nthe truth, known at 48 of 48 steps: 8 dstates, 4 "
        "places, 4 paths; 14 % of"
    )
    assert (
        main(f"simulate notched-rectangle --tours 2 --seed 4 -o {path('other.jsonl')}".split()) == 0
    )
    capsys.readouterr()
    assert main(["recognise", path("recogniser.skops"), path("other.jsonl"), "--json"]) == 0
    labels = json.loads(capsys.readouterr().out)
    assert np.mean(np.array(labels) == [i % 8 for i in range(16)]) > 0.8
    assert main(["recognise", path("recogniser.skops"), path("other.jsonl")]) == 0
    assert capsys.readouterr().out.splitlines()[0].split() == ["step", "dstate"]


def test_simulate_and_cluster_work_through_pipes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Warnings about images go to standard error."""
    assert main(["simulate", "notched-rectangle", "--tours", "3", "--seed", "3", "-o", "-"]) == 0
    driven = capsys.readouterr()
    assert driven.err == "24 images of notched rectangle\n"
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(driven.out.encode())))
    assert main(["cluster", "-", "--k", "4", "-o", "-"]) == 0
    clustered = capsys.readouterr()
    assert clustered.err.endswith("4 views of 24 images\n")
    path = tmp_path / "views.jsonl"
    path.write_text(clustered.out)
    assert len(set(Trace.load(path).views)) == 4


def test_errors_of_learning_verbs_are_one_line(
    tmp_path: Path, refuses: Callable[..., None]
) -> None:
    trace = tmp_path / "t.jsonl"
    Trace.from_steps("ab", ["travel"]).save(trace)
    one = tmp_path / "one.jsonl"
    Trace((Step(image=(1.0, 2.0)),)).save(one)
    (tmp_path / "cut.skops").write_bytes(b"PK\x03\x04")
    (tmp_path / "maps.json").write_text(
        json.dumps(solve(Trace.from_steps("a", [])).maps[0].to_dict())
    )
    for words, message in [
        (
            ["simulate", "atlantis", "-o", str(tmp_path / "x")],
            (
                "world: expected one of cluttered, curved, doors, five-ways, notched-rectangle, "
                "six-ways, taylor-hall"
            ),
        ),
        (
            ["simulate", "notched-rectangle", "--tours", "0", "-o", str(tmp_path / "x")],
            "tours: expected a whole number from 1 to 100,000",
        ),
        (
            f"simulate notched-rectangle --route travel,travel -o {tmp_path / 'x'}".split(),
            "expected a free way ahead, got a wall",
        ),
        (["cluster", str(trace), "-o", str(tmp_path / "x")], "image: expected one, got none"),
        (["cluster", str(one), "-o", str(tmp_path / "x")], "minimum of 2 is required"),
        (
            ["train", str(tmp_path / "maps.json"), str(trace), "-o", str(tmp_path / "x")],
            "labels: expected 2, one for each step of the trace",
        ),
        (["recognise", str(tmp_path / "cut.skops"), str(trace)], "expected a .skops file"),
    ]:
        refuses(words, message)


@pytest.mark.slow
def test_reproduce_writes_the_page_and_its_data(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    measured: SeedRun,
) -> None:
    """A fast version with few circuits; reproduce.py measures the claims over 20 seeds."""
    monkeypatch.setitem(EXPERIMENTS, "notched-rectangle", FEW_CIRCUITS)
    known = {("notched-rectangle", 500): measured}
    monkeypatch.setattr(reproduce, "measure", lambda *asked: known[asked])
    words = f"x notched-rectangle --seeds 500 --jobs 1 --no-outcomes -o {tmp_path}".split()
    monkeypatch.setattr(sys, "argv", words)
    reproduce.main()
    out = capsys.readouterr().out
    assert "k chosen by M" in out
    assert "report.html" in out
    made = {p.name for p in tmp_path.iterdir()}
    assert {
        "report.html",
        "claims.json",
        "runs.json",
        "configuration.json",
        "run.jsonl",
        "world.png",
        "views.png",
        "quality.png",
    } <= made
    assert {"learning.png", "spread.png", "map.svg", "map-with-openings.svg"} <= made
    page = (tmp_path / "report.html").read_text()
    for name in ("world.png", "learning.png", "map.svg"):
        assert f'src="{name}"' in page
    assert [f"Figure {number}: " in page for number in (1, 2, 3, 4, 5)] == [
        False,
        True,
        True,
        True,
        False,
    ]
    assert "benchmarks/reproduction.md" in page
    assert "ours: errors do not add up" in out
    configuration = json.loads((tmp_path / "configuration.json").read_text())
    assert configuration["seeds"] == [500]
    assert configuration["versions"]["clingo"]
    claimed = json.loads((tmp_path / "claims.json").read_text())
    assert all(row["seeds"] == 1 for row in claimed)
    assert page.count("class='ours'") == sum(row["ours"] for row in claimed) == 5


@pytest.mark.slow
def test_summary_counts_the_seeds_in_which_a_claim_holds(measured: SeedRun) -> None:
    good = measured
    bad = replace(
        good,
        seed=1,
        k=5,
        uncertainty={**good.uncertainty, 5: 0.9},
        by_views="9, 4, 4",
        labels_right=False,
    )
    table = {row["claim"]: row for row in summary("notched-rectangle", [good, bad])}
    assert table["U at that k"]["holds"] == 1
    assert table["dstates, places, paths, from the views alone"]["here"] == {
        "500": "8, 4, 4",
        "1": "9, 4, 4",
    }
    assert table["labels from the views alone are the true dstates"]["holds"] == 1


@pytest.fixture(scope="module")
def five_circuits() -> tuple[Trace, BootstrapLearner]:
    """A run of five circuits, and the learner after it."""
    trace = simulate(World.named("notched-rectangle"), tours=5, seed=503)
    return trace, BootstrapLearner().fit(trace)


def with_images(trace: Trace, images: np.ndarray[Any, Any]) -> Trace:
    seen = zip(trace.steps, images.tolist(), strict=True)
    return replace(trace, steps=tuple(replace(step, image=tuple(image)) for step, image in seen))


@pytest.mark.slow
def test_bad_images_become_faults_if_views_may_be_misread(
    five_circuits: tuple[Trace, BootstrapLearner],
) -> None:
    trace, without = five_circuits
    images, bad = images_of(trace).copy(), [9, 30]  # one of twenty
    for i in bad:  # somebody stands before the laser
        images[i] = np.minimum(images[i], np.where(abs(np.arange(180) - 90) < 20, 0.4, np.inf))
    spoilt = with_images(trace, images)
    theory = Theory.topological().replace(misread=1.5, weigh="count")
    with pytest.warns(ImageWarning, match="2 of 40 images fit no view"):
        learner = BootstrapLearner(theory).fit(spoilt)
    assert one_to_one(np.array(learner.map_.labels), true_dstates(trace))
    assert np.flatnonzero(learner.labels_ < 0).tolist() == bad
    assert {fault.step for fault in learner.map_.faults} <= set(bad)
    other = simulate(World.named("notched-rectangle"), tours=2, seed=504)
    meaning = dict(
        zip(
            true_dstates(trace), zip(learner.map_.labels, without.labels_, strict=True), strict=True
        )
    )
    names = np.array([meaning[name] for name in true_dstates(other)])
    assert np.mean(learner.predict(other) == names[:, 0]) >= 0.98 * np.mean(
        without.predict(other) == names[:, 1]
    )
    assert learner.clusterer_.predict(ReciprocalTransformer().fit_transform(images))[
        bad
    ].tolist() == [-1, -1]


def test_warning_names_bad_images_if_no_fault_is_allowed() -> None:
    trace = simulate(World.named("notched-rectangle"), tours=4, seed=503)
    images = images_of(trace).copy()
    images[9] = np.random.default_rng(0).uniform(0.1, 8, 180)
    spoilt = with_images(trace, images)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        learner = BootstrapLearner(Theory.topological().replace(displacement="none"))
        with contextlib.suppress(LearnerError):  # With openings, there may be no map at all.
            learner.fit(spoilt)
    assert any("(image 9" in str(w.message) for w in caught)


def test_isolated_must_be_a_number_above_one(run: Trace) -> None:
    for wrong in (1, -3.0, math.nan, "far"):
        with pytest.raises(PerceptionError, match="isolated: expected a number above 1"):
            ViewClusterer(isolated=wrong).fit(images_of(run))  # type: ignore[arg-type]
