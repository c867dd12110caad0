"""Bootstrap learning where one image in twenty is bad: maps, images named, recogniser accuracy.

    python benchmarks/bad_images.py [--world notched-rectangle] [--tours 10] [--seeds 300-309]
                                    [--only TEXT]

A bad image shows a person in front of the laser, a person at its side, or random ranges
(benchmarks/doubts.py). The solver has ten seconds for a map. It uses the default theory, with
stars and displacements. The recogniser is tested on another drive, of three circuits without bad
images.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from arguments import seeds_from
from doubts import DOUBTS, spoilt, with_images
from numpy.typing import NDArray
from paper_experiments import one_to_one, true_dstates

from perception.errors import PerceptionError
from perception.images import images_of
from perception.quality import NOISE
from perception.views import ViewClusterer
from simulator.tours import simulate
from simulator.world import World
from ssh_abduction.data.trace import Trace
from ssh_abduction.learning.learner import BootstrapLearner, LearnerError
from ssh_abduction.learning.traces import Traces
from ssh_abduction.theory.theory import Theory

SHARE = 0.05
SECONDS = 10.0
KINDS = ("person in front", "person at the side", "random image")
PLAIN = Theory.topological()
FAULTS = PLAIN.replace(misread=1.5)


class Unsure(BootstrapLearner):
    """A learner that does not pass the confidence of views to its solver."""

    def _look(self, traces: Traces, isolated: float | None) -> Traces:
        seen = super()._look(traces, isolated)
        return Traces(
            tuple(
                replace(t, steps=tuple(replace(s, confidence=None) for s in t.steps))
                for t in seen.each
            )
        )


def learners() -> Iterator[tuple[str, BootstrapLearner]]:
    """Yield the name and the learner of each row of the table."""
    by = {name: ViewClusterer(by=name, random_state=0) for name in ("M", "trimmed")}
    yield "no faults, M", BootstrapLearner(PLAIN, by["M"], time_limit=SECONDS)
    yield "no faults, trimmed M", BootstrapLearner(PLAIN, by["trimmed"], time_limit=SECONDS)
    yield "misread=1.5, M, confidence unused", Unsure(FAULTS, by["M"], time_limit=SECONDS)
    yield "misread=1.5, M", BootstrapLearner(FAULTS, by["M"], time_limit=SECONDS)
    yield "misread=1.5, trimmed M", BootstrapLearner(FAULTS, by["trimmed"], time_limit=SECONDS)
    yield (
        "misread=1.5, isolated images are noise (default)",
        BootstrapLearner(FAULTS, time_limit=SECONDS),
    )


def with_bad_images(trace: Trace, kind: str, seed: int) -> tuple[Trace, NDArray[np.intp]]:
    """Copy a trace, with one image in twenty made bad.

    Args:
        trace: The trace.
        kind: What is wrong with the bad images, one of KINDS.
        seed: Seed of the random choices.

    Returns:
        The copy, and the indices of the bad images.
    """
    images, bad = spoilt(
        images_of(trace), kind, round(SHARE * len(trace)), np.random.default_rng(seed)
    )
    return with_images(trace, images), bad


@dataclass(frozen=True)
class Found:
    """The result of one drive.

    Attributes:
        right: Whether the map is the true one.
        said: Whether there was a warning, or no map.
        named: Number of images that have no view, or whose view the map treats as wrong.
        hits: Number of those images that are really bad.
        accuracy: Share of the images of another drive that the recogniser labels correctly.
    """

    right: bool
    said: bool
    named: int
    hits: int
    accuracy: float


def found(learner: BootstrapLearner, trace: Trace, bad: NDArray[np.intp], other: Trace) -> Found:
    """Fit a learner to a drive and compare its map, faults and recogniser with the truth."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            learner.fit(trace)
        except (LearnerError, PerceptionError):
            return Found(False, True, 0, 0, 0.0)
    truth, labels = true_dstates(trace), np.array(learner.map_.labels)
    named = {f.step for f in learner.map_.faults if f.kind == "misread"} | set(
        np.flatnonzero(learner.views_ == NOISE).tolist()
    )
    said = any(issubclass(w.category, DOUBTS) for w in caught)
    # A label means the true dstate that most of its images show.
    meant = {label: _most(truth[labels == label]) for label in set(labels.tolist())}
    hit = [
        meant.get(int(label)) == name
        for label, name in zip(learner.predict(other), true_dstates(other), strict=True)
    ]
    return Found(
        one_to_one(labels, truth),
        said,
        len(named),
        len(named & set(bad.tolist())),
        float(np.mean(hit)),
    )


def _most(names: NDArray[Any]) -> Any:
    """The most frequent name."""
    values, counts = np.unique(names, return_counts=True)
    return values[counts.argmax()]


def rows(world: str, tours: int, seeds: list[int], only: str) -> Iterator[str]:
    """Make the table of one world, line by line.

    Args:
        world: Name of the world.
        tours: Number of circuits of a drive.
        seeds: Seeds of the drives.
        only: Text that the names of the learners must contain.
    """
    yield (
        f"| {world}, {len(seeds)} drives of {tours} circuits | bad images | map right | "
        "wrong, and nothing said | precision | recall | 1-NN, relative: mean | least |"
    )
    yield "|---|---|---|---|---|---|---|---|"
    drives = [simulate(World.named(world), tours, seed) for seed in seeds]
    others = [simulate(World.named(world), 3, 1000 + seed) for seed in seeds]
    nobody = np.array([], np.intp)
    # Accuracies are relative to those of a learner that sees no bad images.
    clean = [
        found(BootstrapLearner(PLAIN, time_limit=SECONDS), drive, nobody, other).accuracy
        for drive, other in zip(drives, others, strict=True)
    ]
    for name, learner in learners():
        if only not in name:
            continue
        for kind in KINDS if "default" not in name else (*KINDS, "none"):
            spoiled = [
                with_bad_images(d, kind, seed) if kind != "none" else (d, nobody)
                for d, seed in zip(drives, seeds, strict=True)
            ]
            got = [
                found(learner, trace, bad, other)
                for (trace, bad), other in zip(spoiled, others, strict=True)
            ]
            hits, named, bad_ones = (
                sum(g.hits for g in got),
                sum(g.named for g in got),
                sum(len(bad) for _, bad in spoiled),
            )
            precision = f"{hits / named:.2f}" if named else "–"
            recall = f"{hits / bad_ones:.2f}" if bad_ones else "–"
            relative = [g.accuracy / c for g, c in zip(got, clean, strict=True)]
            silent = sum(not g.right and not g.said for g in got)
            yield (
                f"| {name} | {kind} | {sum(g.right for g in got)} | {silent} | {precision} "
                f"| {recall} | {np.mean(relative):.3f} | {min(relative):.3f} |"
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--world", default="notched-rectangle")
    parser.add_argument("--tours", type=int, default=10)
    parser.add_argument("--seeds", default="300-309", help="first and last seed")
    parser.add_argument("--only", default="", help="only the rows whose name contains this")
    options = parser.parse_args()
    for row in rows(options.world, options.tours, seeds_from(options.seeds), options.only):
        print(row, flush=True)


if __name__ == "__main__":
    main()
