"""ssh-abduction cluster TRACE: cluster images into views."""

from __future__ import annotations

import argparse
import math
import os
import sys
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from ssh_abduction.cli.options import add_output, check_picture, picture_file, seed, write
from ssh_abduction.cli.outcome import warn
from ssh_abduction.cli.parsing import Verbs
from ssh_abduction.cli.text import counted, table
from ssh_abduction.data.errors import AbductionError
from ssh_abduction.data.trace import Trace
from ssh_abduction.learning.runner_up import SECONDS, runner_up, second_map, with_runner_up
from ssh_abduction.solver import solve
from ssh_abduction.theory.theory import Theory


def add_parser(verbs: Verbs) -> None:
    parser = verbs.add(
        "cluster",
        run,
        "cluster images into views",
        "Cluster the images of a trace into views, and write the trace with its views. The number "
        "of views k is chosen by M, the smallest distance between clusters divided by the largest "
        "distance within a cluster: the largest M wins. If another number of views is about as "
        "good, the trace also keeps those views, and a warning says whether they give another map.",
    )
    parser.add("trace", "trace file with images, or - for standard input")
    add_output(parser)
    parser.add(
        "--k K",
        "number of views (default: the number that the measure M of the paper rates best)",
        type=int,
    )
    parser.add_setting("k_max K", "largest number of views to try (default: 20)", type=int)
    parser.add_setting(
        "by",
        "choose k by M, or by trimmed M (default: M). Trimmed M uses medians instead of the "
        "smallest and largest distances, so that no single image decides",
        "M",
        choices=("M", "trimmed"),
    )
    parser.add("--seed", "random seed of k-means (default: 0)", type=seed, default=0)
    parser.add(
        "--plot PNG",
        "draw the measure M against the number of views. If the truth is known, also draw U, "
        "which says how well the views agree with the true dstates",
        type=picture_file,
    )


def run(options: argparse.Namespace) -> int:
    from perception.appearance import features_of
    from perception.confidence import warn_of_doubts
    from perception.images import images_of
    from perception.quality import uncertainty_coefficient
    from perception.views import ViewClusterer

    check_picture(options.plot)
    trace = Trace.load(options.trace)
    logged, features = images_of(trace), features_of(trace)
    try:
        images = features.fit_transform(logged)
        clusterer = ViewClusterer(
            k=options.k, k_max=options.k_max, random_state=options.seed, by=options.by
        ).fit(images)
    except AbductionError as error:
        raise AbductionError(f"{options.trace}: {error}") from None
    except ValueError as error:  # the message of scikit-learn says why it cannot cluster them
        raise AbductionError(
            f"{options.trace}: images: {error}; log more images, or different ones"
        ) from None
    truth = true_dstate_names(trace)
    by_k = {} if truth is None else clusterer.labels_by_k_
    uncertainty = {k: uncertainty_coefficient(labels, truth or ()) for k, labels in by_k.items()}
    beside = trace.images and os.path.relpath(
        Path(trace.source or ".").parent / trace.images, Path(options.output).parent
    )
    other = clusterer.runner_up_labels_
    clustered = replace(
        trace.with_views(clusterer.labels_.tolist(), clusterer.confidence_.round(4).tolist()),
        images=beside,
    )
    clustered = with_runner_up(clustered, None if other is None else other.tolist())
    columns = {"M": clusterer.quality_, "trimmed": clusterer.trimmed_}
    columns |= {"U": uncertainty} if uncertainty else {}
    words = {clusterer.k_: "chosen", clusterer.runner_up_: "runner-up"}
    rows = [
        [
            k,
            *("–" if math.isnan(m := column[k]) else f"{m:.3f}" for column in columns.values()),
            words.get(k, ""),
        ]
        for k in clusterer.quality_
    ]
    chosen = table(["k", *columns, ""], rows)
    said = f"{counted(clusterer.k_, 'views')} of {counted(len(images), 'images')}"
    write(clustered, options.output, f"{chosen}\n{said}")
    warn_of_doubts(clusterer.labels_, clusterer.confidence_, clusterer.quality_[clusterer.k_])
    warn(runner_up_doubts(clustered))
    if options.plot:
        sys.stdout.flush()  # print first, in case drawing fails
        from ssh_abduction.evaluation.paper.figures import draw_quality

        draw_quality(options.plot, clusterer.quality_, uncertainty, clusterer.k_)
    return 0


def runner_up_doubts(trace: Trace) -> list[str]:
    """Return a warning if the second best number of views (the runner-up) gives another map.

    The theory is the topological one, or the causal one if some action is of unknown kind.
    Without a reason to warn, the list is empty.
    """
    theory = (
        Theory.topological() if all(action.kind for action in trace.actions) else Theory.causal()
    )
    found = None
    with suppress(AbductionError):  # the trace lacks what the theory needs; `solve` reports that
        if runner_up(trace):
            found = second_map(trace, solve(trace, theory, time_limit=SECONDS).maps, theory)
    return [found.sentence] if found else []


def true_dstate_names(trace: Trace) -> list[str] | None:
    """The name of the true dstate of each step; None if some step has none."""
    found = [
        step.truth.get("dstate") if isinstance(step.truth, dict) else None for step in trace.steps
    ]
    return [str(name) for name in found] if all(name is not None for name in found) else None
