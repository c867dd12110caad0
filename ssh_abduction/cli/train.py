"""ssh-abduction train, learning-curve, recognise: the map's labels teach a recogniser, which then knows a dstate from one image."""

from __future__ import annotations

import argparse
import json
import sys
from typing import Any

from ssh_abduction.cli.options import Verbs, check_number, check_picture, output, picture_file, seed
from ssh_abduction.cli.text import counted, table
from ssh_abduction.errors import MapError, named
from ssh_abduction.maps import maps_of, read_json
from ssh_abduction.trace import Trace


def add_parser(verbs: Verbs) -> None:
    text = "Train a nearest-neighbour recogniser on the labels that a map gives to the images of a trace."
    train = verbs.add_parser("train", help="train a recogniser on a map's labels", description=text)
    train.add_argument("-o", "--output", type=output, required=True, metavar="FILE.skops", help="file to write")
    train.set_defaults(run=run_train)
    text = "Recognition rate by 10-fold cross-validation, against the number of images, on the labels that a map gives."
    curve = verbs.add_parser("learning-curve", help="how well a recogniser does with few and many images", description=text)
    curve.add_argument("--folds", type=int, default=10, help="parts of the cross-validation (default: 10)")
    curve.add_argument("--seed", type=seed, default=0, help="seed of the folds (default: 0)")
    curve.add_argument("--plot", type=picture_file, metavar="PNG", help="draw the learning curve")
    curve.add_argument("--json", action="store_true", help="print JSON")
    curve.set_defaults(run=run_learning_curve)
    for parser in (train, curve):
        parser.add_argument("trace", help="trace file with images")
        parser.add_argument("maps", help="what solve --json printed for this trace, or one saved map")
        parser.add_argument("--map", type=int, metavar="I", help="take the I-th map, from 1 (default: the labels all maps agree on)")
    text = "Say of each image of a trace at which dstate it was taken."
    recognise = verbs.add_parser("recognise", help="recognise dstates from images", description=text)
    recognise.add_argument("recogniser", help="what train wrote")
    recognise.add_argument("trace", help="trace file with images")
    recognise.add_argument("--json", action="store_true", help="print the labels as a JSON list")
    recognise.set_defaults(run=run_recognise)


def _labelled(options: argparse.Namespace) -> tuple[Any, Any]:
    """The images of a trace and their labels, where these are sure."""
    from perception.images import images_of
    from ssh_abduction.learner import labels_of

    trace = Trace.load(options.trace)
    data = read_json(options.maps)
    maps = maps_of(data, str(options.maps))
    check_number(options.map, maps, options.maps)
    labels = labels_of(
        maps,
        None if options.map is None else options.map - 1,
        bool(data.get("complete", True)) if isinstance(data, dict) else True,
        data.get("status", "optimal") == "optimal" if isinstance(data, dict) else True,
    )
    if len(labels) != len(trace):
        raise MapError(
            f"{options.maps}: expected labels for the {len(trace)} steps of {options.trace}, got {len(labels)}; solve this trace"
        )
    sure = labels >= 0
    return images_of(trace)[sure], labels[sure]


def run_train(options: argparse.Namespace) -> int:
    from perception.recognition import recogniser
    from perception.store import save

    images, labels = _labelled(options)
    save(recogniser().fit(images, labels), options.output)
    print(f"{counted(len(set(labels.tolist())), 'dstates')} learnt from {counted(len(images), 'images')} in {named(options.output)}")
    return 0


def run_learning_curve(options: argparse.Namespace) -> int:
    from perception.recognition import learning_curve

    check_picture(options.plot)
    images, labels = _labelled(options)
    sizes = sorted({len(images) * tenth // 10 for tenth in range(1, 11)} - {0})
    curve = learning_curve(images, labels, sizes, folds=options.folds, random_state=options.seed)
    if options.json:
        print(
            json.dumps({"sizes": curve.sizes, "mean": curve.mean, "lowest": curve.lowest, "highest": curve.highest, "folds": curve.folds})
        )
    else:
        rows = [
            [s, f"{m:.3f}", f"{a:.3f}", f"{b:.3f}"] for s, m, a, b in zip(curve.sizes, curve.mean, curve.lowest, curve.highest, strict=True)
        ]
        print(table(["images", "recognised", "worst fold", "best fold"], rows))
    if options.plot:
        sys.stdout.flush()  # a picture that fails loses nothing of this
        from ssh_abduction.reproduce.figures import draw_learning

        draw_learning(options.plot, {"map": curve})
    return 0


def run_recognise(options: argparse.Namespace) -> int:
    from perception.errors import PerceptionError
    from perception.images import images_of
    from perception.store import load

    stored = load(options.recogniser)
    images = images_of(Trace.load(options.trace))
    try:
        labels = stored.labels(images)
    except PerceptionError as error:
        raise PerceptionError(f"{options.recogniser}: {error}") from None
    if options.json:
        print(json.dumps(labels))
    else:
        print(table(["step", "dstate"], list(enumerate(labels))))
    return 0
