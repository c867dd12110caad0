"""ssh-abduction train, learning-curve, tell-apart and recognise: learn dstates from images."""

from __future__ import annotations

import argparse
import json
import sys
from typing import Any

from ssh_abduction.cli.options import (
    add_maps,
    add_trace,
    check_number,
    check_picture,
    output,
    picture_file,
    seed,
    trace_of,
    trace_path,
)
from ssh_abduction.cli.parsing import Verbs
from ssh_abduction.cli.text import counted, table
from ssh_abduction.data.errors import MapError, named, said_of
from ssh_abduction.data.map_file import read_json
from ssh_abduction.data.maps import SSHMap, check_labels, maps_of
from ssh_abduction.data.schema import attributes_of
from ssh_abduction.data.trace import Trace


def add_parser(verbs: Verbs) -> None:
    train = verbs.add(
        "train",
        run_train,
        "train a recogniser on the labels of a map",
        "Train a nearest-neighbour recogniser on the images of a trace. The label of an image is "
        "its dstate in a map.",
    )
    said = "file for the trained recogniser"
    train.add("-o --output FILE.skops", said, type=output, required=True)
    curve = verbs.add(
        "learning-curve",
        run_learning_curve,
        "measure a recogniser with few and with many images",
        "Compute the share of images that are recognised, for growing numbers of training images, "
        "by cross-validation. The label of an image is its dstate in a map.",
    )
    said = "number of folds of the cross-validation (default: 10)"
    curve.add_setting("folds N", said, 10, type=int)
    said = "random seed of the division into training and test images (default: 0)"
    curve.add("--seed", said, type=seed, default=0)
    curve.add("--plot PNG", "draw the learning curve into this file", type=picture_file)
    curve.add("--json", "print the learning curve as JSON")
    apart = verbs.add(
        "tell-apart",
        run_tell_apart,
        "find the laser beams that distinguish dstates with the same view",
        "Find the laser beams that distinguish two dstates that look alike, by default for each "
        "pair of dstates with the same view.",
    )
    said = "two dstates of the map (default: each pair that shares a view)"
    apart.add("--dstates I,J", said, type=pair)
    apart.add("--plot PNG", "draw the beams over the scans, into this file", type=picture_file)
    apart.add("--json", "print how much each beam helps, by each method, as JSON")
    for parser in (train, curve, apart):
        add_maps(parser)
        add_trace(parser, " with images")
        parser.add(
            "--map I",
            "the number of the map that gives the labels, from 1 (default: use only labels on "
            "which all maps agree)",
            type=int,
        )
    recognise = verbs.add(
        "recognise",
        run_recognise,
        "recognise dstates from images",
        "Find the dstate at which each image of a trace was taken, or nowhere if the image looks "
        "like no dstate that the recogniser knows.",
    )
    recognise.add("recogniser", "file that train wrote")
    recognise.add("trace", "trace file with images", type=trace_path)
    recognise.add("--json", "print the dstates as a JSON list, null for nowhere")


def pair(text: str) -> tuple[int, int]:
    """Convert text such as "0,4" to two numbers. Raise ArgumentTypeError for anything else."""
    first, comma, second = text.partition(",")
    if not (comma and first.strip().isdecimal() and second.strip().isdecimal()):
        raise argparse.ArgumentTypeError(
            f"expected two dstates with a comma between them, such as 0,4, got {text!r}; write two"
        )
    return int(first), int(second)


def _mapped(options: argparse.Namespace) -> tuple[Any, Any, SSHMap, Any]:
    """Return the images of labelled steps, their dstates, the map, and a transformer of images."""
    from perception.appearance import features_of
    from perception.images import images_of
    from ssh_abduction.learning.learner import labels_of

    options.trace = trace_of(options)
    trace = Trace.load(options.trace)
    data = read_json(options.maps)
    maps = maps_of(data, str(options.maps))
    check_number(options.map, maps, options.maps)
    answer = data if isinstance(data, dict) else {}
    labels = labels_of(
        maps,
        None if options.map is None else options.map - 1,
        bool(answer.get("complete", True)),
        answer.get("status", "optimal") == "optimal",
    )
    chosen = maps[(options.map or 1) - 1]
    check_labels(chosen, trace, named(options.maps))
    sure = labels >= 0
    return images_of(trace)[sure], labels[sure], chosen, features_of(trace)


def run_train(options: argparse.Namespace) -> int:
    """Run the verb `train`: train a recogniser, and write it to a file."""
    from perception.recognition import recogniser
    from perception.store import save

    images, labels, _, features = _mapped(options)
    save(recogniser(features=features).fit(images, labels), options.output)
    print(
        f"{counted(len(set(labels.tolist())), 'dstates')} learnt from "
        f"{counted(len(images), 'images')} in {named(options.output)}"
    )
    return 0


def run_learning_curve(options: argparse.Namespace) -> int:
    """Run the verb `learning-curve`: print recognition rates by the number of training images."""
    from perception.recognition import learning_curve, recogniser

    check_picture(options.plot)
    images, labels, _, features = _mapped(options)
    sizes = sorted({len(images) * tenth // 10 for tenth in range(1, 11)} - {0})
    how: dict[str, Any] = {"folds": options.folds, "random_state": options.seed}
    curve = learning_curve(images, labels, sizes, estimator=recogniser(features=features), **how)
    if options.json:
        print(json.dumps(attributes_of(curve, "sizes", "mean", "lowest", "highest", "folds")))
    else:
        rows = [
            [s, f"{m:.3f}", f"{a:.3f}", f"{b:.3f}"]
            for s, m, a, b in zip(curve.sizes, curve.mean, curve.lowest, curve.highest, strict=True)
        ]
        print(table(["images", "recognised", "worst fold", "best fold"], rows))
    if options.plot:
        sys.stdout.flush()  # print first, in case drawing fails
        from ssh_abduction.evaluation.figures import draw_learning

        draw_learning(options.plot, {"map": curve})
    return 0


def run_recognise(options: argparse.Namespace) -> int:
    """Run the verb `recognise`: print the dstate of each image of a trace."""
    from perception.errors import PerceptionError
    from perception.images import images_of
    from perception.store import load

    stored = load(options.recogniser)
    images = images_of(Trace.load(options.trace))
    with said_of(options.recogniser, PerceptionError):
        labels: list[int | None] = [*stored.labels(images)]
        if (likelihood := stored.likelihood()) is not None:
            labels = likelihood.labels(images)
    if options.json:
        print(json.dumps(labels))
    else:
        shown = ["nowhere" if label is None else label for label in labels]
        print(table(["step", "dstate"], [*enumerate(shown)]))
    return 0


def run_tell_apart(options: argparse.Namespace) -> int:
    """Run the verb `tell-apart`: print the laser beams that distinguish pairs of dstates."""
    from perception.features import strongest, telling_features
    from perception.reciprocal import ReciprocalTransformer

    check_picture(options.plot)
    ranges, labels, ssh_map, features = _mapped(options)
    if not isinstance(features, ReciprocalTransformer):
        raise MapError(
            f"{options.trace}: expected a trace with ranges, as the result names laser beams, got "
            "panoramas; take a trace of a laser"
        )
    images = ReciprocalTransformer().fit_transform(ranges)
    views = {s.id: s.view for s in ssh_map.dstates if s.view is not None}
    alike = [(a, b) for a in views for b in views if a < b and views[a] == views[b]]
    seen = {label for label in set(labels.tolist()) if (labels == label).sum() > 1}
    pairs = [options.dstates] if options.dstates else [p for p in alike if seen.issuperset(p)]
    if not pairs:
        raise MapError(
            f"{options.maps}: expected dstates that share a view, with two images each, got none; "
            "name two with --dstates I,J"
        )
    found = {p: telling_features(images, labels, *p) for p in pairs}
    if options.json:
        records = []
        for p, f in found.items():
            methods = {method: shares.tolist() for method, shares in f.methods.items()}
            records.append({"dstates": p, "recognised": f.recognised, **methods})
        print(json.dumps(records))
    else:
        rows = [
            [f"{a}, {b}", f"{f.recognised:.3f}", *map(strongest, f.methods.values())]
            for (a, b), f in found.items()
        ]
        beams = [f"beams by {method}" for method in next(iter(found.values())).methods]
        print(table(["dstates", "recognised", *beams], rows))
    if options.plot:
        sys.stdout.flush()  # print first, in case drawing fails
        from ssh_abduction.evaluation.figures import draw_telling

        draw_telling(options.plot, ranges, labels, found)
    return 0
