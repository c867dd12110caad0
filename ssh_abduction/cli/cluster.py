"""ssh-abduction cluster TRACE: images to views."""

from __future__ import annotations

import argparse
import math
import os
import sys
from dataclasses import replace
from pathlib import Path

from ssh_abduction.cli.options import Verbs, add_output, check_picture, picture_file, seed, write
from ssh_abduction.cli.text import counted, table
from ssh_abduction.errors import SSHError
from ssh_abduction.trace import Trace


def add_parser(verbs: Verbs) -> None:
    text = "Cluster the images of a trace into views, as many as separate best (k by M), and write the trace with its views."
    parser = verbs.add_parser("cluster", help="cluster images into views", description=text)
    parser.add_argument("trace", help="trace file with images, or - for standard input")
    add_output(parser)
    parser.add_argument("--k", type=int, help="number of views (default: the one with the largest M)")
    parser.add_argument("--k-max", type=int, metavar="K", help="largest number of views to try (default: 20)")
    parser.add_argument("--seed", type=seed, default=0, help="seed of k-means (default: 0)")
    parser.add_argument("--plot", type=picture_file, metavar="PNG", help="draw M, and U where the truth is known, against k")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    from perception.images import images_of
    from perception.quality import uncertainty_coefficient
    from perception.reciprocal import ReciprocalTransformer
    from perception.views import ViewClusterer, labels_by_k

    check_picture(options.plot)
    trace = Trace.load(options.trace)
    images = ReciprocalTransformer().fit_transform(images_of(trace))
    try:
        clusterer = ViewClusterer(k=options.k, k_max=options.k_max, random_state=options.seed).fit(images)
    except SSHError as error:
        raise SSHError(f"{options.trace}: {error}") from None
    except ValueError as error:  # scikit-learn's own words for what cannot be clustered
        raise SSHError(f"{options.trace}: images: {error}; log more images, or others") from None
    truth = true_dstates(trace)
    uncertainty: dict[int, float] = {}
    if truth is not None:
        uncertainty = {k: uncertainty_coefficient(labels, truth) for k, labels in labels_by_k(clusterer, images).items()}
    beside = trace.images and os.path.relpath(Path(trace.source or ".").parent / trace.images, Path(options.output).parent)
    clustered = replace(trace.with_views(clusterer.labels_.tolist()), images=beside)
    rows = [
        [
            k,
            "–" if math.isnan(m) else f"{m:.3f}",
            *([f"{uncertainty[k]:.3f}"] if uncertainty else []),
            "chosen" if k == clusterer.k_ else "",
        ]
        for k, m in clusterer.quality_.items()
    ]
    chosen = table(["k", "M", *(["U"] if uncertainty else []), ""], rows)
    write(clustered, options.output, f"{chosen}\n{counted(clusterer.k_, 'views')} of {counted(len(images), 'images')}")
    if options.plot:
        sys.stdout.flush()  # a picture that fails loses nothing of this
        from ssh_abduction.reproduce.figures import draw_quality

        draw_quality(options.plot, clusterer.quality_, uncertainty, clusterer.k_)
    return 0


def true_dstates(trace: Trace) -> list[str] | None:
    """The true dstates, where every step tells one."""
    found = [step.truth.get("dstate") if isinstance(step.truth, dict) else None for step in trace.steps]
    return [str(name) for name in found] if all(name is not None for name in found) else None
