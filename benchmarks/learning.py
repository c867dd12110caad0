"""Does a recogniser learn more from three drives, labelled by their joint map, than from one?

    python benchmarks/learning.py [WORLD …] [--seeds 5] [--tours 1] [--ranges 0.01]

Four robots drive tours of a world. Each starts at a step of its own. BootstrapLearner learns from
the first drive alone, and from three drives. Both recognisers are asked for the images of the
fourth drive. A recognised dstate stands for the true dstate of most of its images. For comparison,
recognisers are trained on the true dstates, too.
"""

from __future__ import annotations

import argparse
import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from perception.images import images_of
from perception.recognition import recogniser
from simulator.robot import Laser
from simulator.tours import simulate
from simulator.world import World
from ssh_abduction import BootstrapLearner, Theory, Trace
from ssh_abduction.learning.learner import LearnerError

WORLDS = ("notched-rectangle", "taylor-hall", "three-ways", "five-ways", "triangle")
DRIVES = 4


def drives(world: World, tours: int, seed: int, laser: Laser) -> list[Trace]:
    """Simulate four drives, each with a start of its own and as many steps as `tours` have."""
    chance = np.random.default_rng(seed)
    found = []
    for k in range(DRIVES):
        trace = simulate(world, tours + 1, DRIVES * seed + k, laser=laser)
        steps = len(trace) * tours // (tours + 1)
        first = int(chance.integers(len(trace) - steps))
        found.append(replace(trace[first : first + steps], name=f"drive {k + 1}"))
    return found


def names_of(traces: Sequence[Trace]) -> NDArray[np.object_]:
    """The true dstate of each step."""
    return np.array([step.truth["dstate"] for trace in traces for step in trace.steps], object)


def shares(learnt: Sequence[Trace], asked: Trace, theory: Theory) -> tuple[float, float, int]:
    """Train on some drives, and recognise the images of another.

    Returns:
        The share of images that are recognised correctly: by labels of the map, and by true labels.
        And the number of dstates of the map.
    """
    names, true = names_of(learnt), names_of([asked])
    images = images_of(asked)
    by_truth = recogniser().fit(np.concatenate([images_of(t) for t in learnt]), names)
    upper = float(np.mean(by_truth.predict(images) == true))
    try:
        learner = BootstrapLearner(theory).fit(learnt)
    except LearnerError:
        return 0.0, upper, 0
    meaning = {
        label: Counter(names[learner.labels_ == label]).most_common(1)[0][0]
        for label in set(learner.labels_.tolist())
        if label >= 0
    }
    found = [meaning[label] for label in learner.predict(images).tolist()]
    return float(np.mean(np.array(found, object) == true)), upper, len(learner.map_.dstates)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("worlds", nargs="*", default=WORLDS, metavar="WORLD")
    parser.add_argument("--seeds", type=int, default=5, metavar="N", help="seeds of each world")
    parser.add_argument("--first", type=int, default=0, metavar="SEED", help="the first seed")
    parser.add_argument("--tours", type=int, default=1, metavar="N", help="tours of a drive")
    parser.add_argument(
        "--displacement", choices=("auto", "none"), default="none", help="none ignores odometry"
    )
    options = parser.parse_args()
    theory = Theory(displacement=options.displacement)
    warnings.simplefilter("ignore")
    print(
        "| world | dstates of the maps: one drive, three | one drive: map, truth | "
        "three drives: map, truth |\n|---|---|---|---|"
    )
    for name in options.worlds:
        world, rows = World.named(name), []
        for seed in range(options.first, options.first + options.seeds):
            *learnt, asked = drives(world, options.tours, seed, Laser())
            rows.append((shares(learnt[:1], asked, theory), shares(learnt, asked, theory)))
        (one, one_true, small), (three, three_true, large) = np.mean(rows, axis=0)
        print(
            f"| {name} | {small:.1f}, {large:.1f} | {one:.3f}, {one_true:.3f} | "
            f"{three:.3f}, {three_true:.3f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
