"""ssh-abduction cluster, train and recognise: learn from images."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ssh_abduction.cli import shared
from ssh_abduction.cli.import_log import check_folder
from ssh_abduction.cli.outcome import warn
from ssh_abduction.cli.parsing import verb
from ssh_abduction.cli.text import counted, table
from ssh_abduction.data.errors import AbductionError, named, said_of
from ssh_abduction.data.maps import check_labels
from ssh_abduction.data.trace import Trace, with_images_named_from
from ssh_abduction.learning.runner_up import SECONDS, runner_up, second_map
from ssh_abduction.solver import solve
from ssh_abduction.theory.theory import Theory

if TYPE_CHECKING:
    from perception.views import ViewClusterer
    from ssh_abduction.learning.traces import Traces

IMAGES = "images.npz"  # the common sidecar file of traces that are clustered together


@verb({"traces": {"type": str}})
def run_cluster(options: argparse.Namespace) -> int:
    """Cluster images into views.

    Cluster the images of a trace into views, and write the trace with its views. With --together,
    cluster the images of several traces as one table, so that a view means the same in all of them.

    The number of views k is chosen by M, the smallest distance between clusters divided by the
    largest distance within a cluster: the largest M wins. If another number of views is about as
    good, the trace also keeps those views, and a warning says whether they give another map.
    """
    from perception.quality import uncertainty_coefficient, warn_of_doubts
    from perception.views import ViewClusterer
    from ssh_abduction.learning.traces import Traces

    shared.check_picture(options.plot)
    files = _files(options)
    traces = Traces(tuple(Trace.load(file) for file in files))
    sources = ", ".join(named(file) for file in files)
    logged, features = traces.images, traces.features
    how: dict[str, Any] = {"k": options.k, "k_max": options.k_max, "by": options.by}
    try:
        images = features.fit_transform(logged)
        clusterer = ViewClusterer(**how, random_state=options.seed).fit(images)
    except AbductionError as error:
        raise AbductionError(f"{sources}: {error}") from None
    except ValueError as error:  # the message of scikit-learn says why it cannot cluster them
        raise AbductionError(
            f"{sources}: images: {error}; log more images, or different ones"
        ) from None
    truth = true_dstate_names(traces.each)
    by_k = {} if truth is None else clusterer.labels_by_k_
    uncertainty = {k: uncertainty_coefficient(labels, truth or ()) for k, labels in by_k.items()}
    clustered = traces.with_views(
        images, clusterer.labels_, clusterer.runner_up_labels_, clusterer.confidence_
    )
    said = f"{counted(clusterer.k_, 'views')} of {counted(len(images), 'images')}"
    _write(clustered, files, options, f"{_choice_of_k(clusterer, uncertainty)}\n{said}")
    warn_of_doubts(clusterer.labels_, clusterer.confidence_, clusterer.quality_[clusterer.k_])
    warn(runner_up_doubts(clustered))
    shared.draw_plot(options, "draw_quality", clusterer.quality_, uncertainty, clusterer.k_)
    return 0


def _choice_of_k(clusterer: ViewClusterer, uncertainty: dict[int, float]) -> str:
    """Return a table of the measures by which k was chosen."""
    columns = {"M": clusterer.quality_, "trimmed": clusterer.trimmed_}
    columns |= {"U": uncertainty} if uncertainty else {}
    words = {clusterer.k_: "chosen", clusterer.runner_up_: "runner-up"}
    rows = []
    for k in clusterer.quality_:
        measures = [column[k] for column in columns.values()]
        cells = ("–" if math.isnan(m) else f"{m:.3f}" for m in measures)
        rows.append([k, *cells, words.get(k, "")])
    return table(["k", *columns, ""], rows)


def _files(options: argparse.Namespace) -> dict[str, str]:
    """Return the file to write for each file to read. Raise AbductionError if two are the same."""
    if not options.together:
        if len(options.traces) > 1:
            raise AbductionError(
                "traces: expected one trace, or --together, got several; add --together if their "
                "views shall have the same meaning, or cluster each alone"
            )
        return {options.traces[0]: options.output}
    if "-" in [*options.traces, options.output]:
        raise AbductionError(
            "--together: expected files to read and a folder to write, got -; name them"
        )
    folder = Path(options.output)
    check_folder(folder)
    files: dict[str, str] = {}
    for file in options.traces:
        target = str(folder / Path(file).name)
        if target in files.values():
            raise AbductionError(
                f"{named(file)}: expected traces with different file names, as each is written to "
                f"{named(options.output)} under its name, got two; rename one of them"
            )
        files[file] = target
    return files


def _write(traces: Traces, files: dict[str, str], options: argparse.Namespace, said: str) -> None:
    """Write each trace to its file, and print a message.

    With --together, images in sidecar files go to one file, so that the traces can be joined.
    """
    if not options.together:
        (trace,) = traces.each
        shared.write_trace(
            with_images_named_from(trace, Path(options.output).parent), options.output, said
        )
        return
    from perception.images import save_images

    folder = Path(options.output)
    folder.mkdir(parents=True, exist_ok=True)
    if any(trace.images for trace in traces.each):
        save_images(folder / IMAGES, traces.images)
        traces = traces.with_images_in(IMAGES)
    for trace, target in zip(traces.each, files.values(), strict=True):
        trace.save(target)
    print(f"{said} in {named(options.output)}")


def runner_up_doubts(traces: Traces) -> list[str]:
    """Return a warning if the second best number of views (the runner-up) gives another map.

    The theory is the topological one, or the causal one if some action is of unknown kind.
    Without a reason to warn, the list is empty.
    """
    found = None
    with suppress(AbductionError):  # the traces lack what the theory needs; `solve` reports that
        trace = traces.joint
        known = all(action.kind for action in trace.actions)
        theory = Theory.topological() if known else Theory.causal()
        if runner_up(trace):
            found = second_map(trace, solve(trace, theory, time_limit=SECONDS).maps, theory)
    return [found.sentence] if found else []


def true_dstate_names(traces: Sequence[Trace]) -> list[str] | None:
    """The name of the true dstate of each step; None if some step has none."""
    found = [
        step.truth.get("dstate") if isinstance(step.truth, dict) else None
        for trace in traces
        for step in trace.steps
    ]
    return [str(name) for name in found] if all(name is not None for name in found) else None


@verb()
def run_train(options: argparse.Namespace) -> int:
    """Train a recogniser on the labels of a map.

    Train a nearest-neighbour recogniser on the images of a trace. The label of an image is its
    dstate in a map.
    """
    from perception.appearance import features_of
    from perception.images import images_of
    from perception.recognition import recogniser
    from perception.store import save
    from ssh_abduction.learning.learner import labels_of

    options.trace = shared.trace_of(options)
    trace = Trace.load(options.trace)
    listing = shared.listing_of(options.maps)
    number = None if options.map is None else listing.number(options.map)
    is_proven = listing.minimal is not None or listing.complete is None
    labels = labels_of(listing.maps, number, listing.complete is not False, is_proven)
    check_labels(listing.maps[number or 0], trace, named(options.maps))
    sure = labels >= 0
    images = images_of(trace)[sure]
    save(recogniser(features=features_of(trace)).fit(images, labels[sure]), options.output)
    print(
        f"{counted(len(set(labels[sure].tolist())), 'dstates')} learnt from "
        f"{counted(len(images), 'images')} in {named(options.output)}"
    )
    return 0


@verb()
def run_recognise(options: argparse.Namespace) -> int:
    """Recognise dstates from images.

    Find the dstate at which each image of a trace was taken, or nowhere if the image looks like no
    dstate that the recogniser knows.
    """
    from perception.errors import PerceptionError
    from perception.images import images_of
    from perception.recognition import ImageLikelihood
    from perception.store import load

    stored = load(options.recogniser)
    images = images_of(Trace.load(options.trace))
    with said_of(options.recogniser, PerceptionError):
        labels = ImageLikelihood.of(stored).labels(images)
    if options.json:
        print(json.dumps(labels))
    else:
        shown = ["nowhere" if label is None else label for label in labels]
        print(table(["step", "dstate"], [*enumerate(shown)]))
    return 0
