"""Localisation in a known map: kidnapped robots, robots outside the map, images, and speed.

    python benchmarks/localisation.py [--part kidnapped|nowhere|images|speed] [--seeds 20]
                                      [--first 200] [--plot PNG]

The script prints tables for benchmarks/localisation.md. With --plot, it draws a figure of
that page instead: a robot in a maze of 5 x 5 cells that is put into another maze and back. Maps are
the true maps of walks, so only localisation is measured. Robots walk at random along the links of
the map:

    kidnapped  At step 40 of 80, the robot is carried to another dstate, to which its action does
               not lead. Some views are replaced by other views of the map.
    nowhere    From step 40 to step 69 of 110, the robot is in another world. Then it is put back.
               The other world has the same views, or a third of its dstates show new views.
    images     A simulated robot learns from some tours and drives three others. In one image in
               twenty, a person is in front of the laser. Then the robot is carried to another
               place, and then to another building.
    speed      CPU seconds for many steps, including entropy, verdict and dstate of each step.
"""

from __future__ import annotations

import argparse
import random
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from instances import Walk, maze, moore
from numpy.typing import NDArray

from perception.errors import ImageWarning
from perception.images import images_of
from perception.recognition import ImageLikelihood, recogniser
from simulator.tours import simulate
from simulator.world import World
from ssh_abduction import Localiser, SSHMap, Trace
from ssh_abduction.data import Step
from ssh_abduction.data.maps import DState
from ssh_abduction.evaluation.figures import draw_beliefs
from ssh_abduction.online import Belief
from ssh_abduction.online.localiser import BeliefVerdict

FAMILIES: dict[str, Callable[[int], Walk]] = {
    "machines of 20 states, 6 views": lambda seed: moore(20, 6, steps=1000, seed=seed),
    "machines of 100 states, 10 views": lambda seed: moore(100, 10, steps=5000, seed=seed),
    "mazes 5 x 5": lambda seed: maze(5, 5, steps=2000, seed=seed),
    "mazes 10 x 10": lambda seed: maze(10, 10, steps=8000, seed=seed),
}
KIDNAPPED, DRIVEN = 40, 80
LEFT, BACK, ENDED = 40, 70, 110
STEPS = 10_000


@dataclass(frozen=True)
class Drive:
    """What a robot saw and did.

    Attributes:
        trace: The trace.
        at: True dstate of each step, as in the map; None outside the map.
    """

    trace: Trace
    at: tuple[int | None, ...]


def true_map(walk: Walk) -> SSHMap:
    """Make the true map of a walk: its states are the dstates."""
    number: dict[object, int] = {}
    labels = tuple(number.setdefault(x, len(number)) for x in walk.truth)
    views = {label: step.view for label, step in zip(labels, walk.trace, strict=True)}
    links = {
        (x, a.name, y) for x, a, y in zip(labels, walk.trace.actions, labels[1:], strict=False)
    }
    return SSHMap(
        labels, tuple(DState(i, views[i] or "") for i in range(len(number))), tuple(sorted(links))
    )


class Robot:
    """A robot that walks at random along the links of a map."""

    def __init__(self, ssh_map: SSHMap, chance: random.Random) -> None:
        self.ssh_map, self.chance = ssh_map, chance
        self.leads: dict[int, list[tuple[str, int]]] = {}
        for x, action, y in ssh_map.links:
            self.leads.setdefault(x, []).append((action, y))
        self.at = self.anywhere()

    @property
    def view(self) -> object:
        return self.ssh_map.dstates[self.at].view

    def anywhere(self) -> int:
        return self.chance.choice(sorted(self.leads))

    def act(self) -> str:
        action, there = self.chance.choice(self.leads[self.at])
        self.at = there if there in self.leads else self.anywhere()
        return action


def kidnapped(ssh_map: SSHMap, seed: int, misread: float) -> Drive:
    """Draw a drive in which the robot is carried to another dstate at step KIDNAPPED.

    Args:
        ssh_map: The map.
        seed: Seed of the drive.
        misread: Probability of a wrong view.
    """
    chance = random.Random(seed)
    robot = Robot(ssh_map, chance)
    names = sorted({s.view for s in ssh_map.dstates}, key=str)
    at, actions = [robot.at], []
    for step in range(1, DRIVEN):
        actions.append(robot.act())
        led = robot.at
        while step == KIDNAPPED and robot.at == led:
            robot.at = robot.anywhere()
        at.append(robot.at)
    # Replace a share of the views by others.
    views = [ssh_map.dstates[x].view for x in at]
    views = [
        chance.choice([v for v in names if v != view]) if chance.random() < misread else view
        for view in views
    ]
    return Drive(Trace.from_steps(views, actions), tuple(at))


def elsewhere(ssh_map: SSHMap, other: SSHMap, seed: int, new: float) -> Drive:
    """Draw a drive in which the robot is in another world from step LEFT to step BACK - 1.

    Args:
        ssh_map: The map.
        other: Map of the other world.
        seed: Seed of the drive.
        new: Probability that a dstate of the other world shows a new view.
    """
    chance = random.Random(seed)
    robot, stranger = Robot(ssh_map, chance), Robot(other, chance)
    unseen = {s.id for s in other.dstates if chance.random() < new}
    at: list[int | None] = [robot.at]
    views, actions = [robot.view], []
    for step in range(1, ENDED):
        away = LEFT <= step < BACK
        actions.append((stranger if away else robot).act())
        at.append(None if away else robot.at)
        views.append(
            f"new {stranger.at}"
            if away and stranger.at in unseen
            else (stranger if away else robot).view
        )
    return Drive(Trace.from_steps(views, actions), tuple(at))  # type: ignore[arg-type]


def median(values: Sequence[float]) -> str:
    return f"{np.median(values):g}" if values else "–"


def share(part: float, whole: float) -> str:
    return f"{part / whole:.3f}" if whole else "–"


def located(belief: Belief, at: int | None) -> bool:
    return belief.verdict is BeliefVerdict.LOCATED and belief.dstate == at


def first(condition: Sequence[bool]) -> int | None:
    return next((i for i, holds in enumerate(condition) if holds), None)


def part_kidnapped(seeds: range) -> None:
    """Print the table of kidnapped robots."""
    print(
        "| map | dstates | wrong views | located after | noticed after | found after | "
        "found | right | of those located, wrong | false alarms |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|")
    for name, make in FAMILIES.items():
        maps = [true_map(make(seed)) for seed in seeds]
        for misread in (0.0, 0.01, 0.05):
            began, noticed, found, sizes = [], [], [], []
            right = steps = sure = wrong = vain = 0
            # Collect from each drive the steps until the robot is located, until the move is
            # noticed, and until the robot is located again.
            for seed, ssh_map in zip(seeds, maps, strict=True):
                drive = kidnapped(ssh_map, seed, misread)
                beliefs = list(Localiser(ssh_map).beliefs(drive.trace))
                here = [located(b, x) for b, x in zip(beliefs, drive.at, strict=True)]
                sizes.append(len(ssh_map.dstates))
                if (start := first(here[:KIDNAPPED])) is not None:
                    began.append(start)
                if (collapse := first([b.collapsed for b in beliefs[KIDNAPPED:]])) is not None:
                    noticed.append(collapse)
                if (again := first(here[KIDNAPPED:])) is not None:
                    found.append(again)
                right += sum(b.dstate == x for b, x in zip(beliefs, drive.at, strict=True))
                steps += len(beliefs)
                sure += sum(b.verdict is BeliefVerdict.LOCATED for b in beliefs)
                wrong += sum(
                    b.verdict is BeliefVerdict.LOCATED and b.dstate != x
                    for b, x in zip(beliefs, drive.at, strict=True)
                )
                vain += sum(
                    b.collapsed and step.view == ssh_map.dstates[x or 0].view
                    for b, step, x in zip(beliefs[:KIDNAPPED], drive.trace, drive.at, strict=False)
                )
            print(
                f"| {name} | {median(sizes)} | {misread:.0%} | {median(began)} | "
                f"{median(noticed)} | {median(found)} | {len(found)} of {len(maps)} | "
                f"{share(right, steps)} | {share(wrong, sure)} | {vain} of {KIDNAPPED * len(maps)} "
                "|",
                flush=True,
            )


def part_nowhere(seeds: range) -> None:
    """Print the table of robots that leave the map."""
    print(
        "| map | new views there | nowhere after | said so there | said so at home | "
        "found after | found |"
    )
    print("|---|---|---|---|---|---|---|")
    for name, make in FAMILIES.items():
        maps = [(true_map(make(seed)), true_map(make(1000 + seed))) for seed in seeds]
        for new in (0.0, 1 / 3):
            said, found = [], []
            there = home = at_home = 0
            for seed, (ssh_map, other) in zip(seeds, maps, strict=True):
                drive = elsewhere(ssh_map, other, seed, new)
                beliefs = list(Localiser(ssh_map).beliefs(drive.trace))
                nowhere = [b.verdict is BeliefVerdict.NOWHERE for b in beliefs]
                # Collect the steps outside the map until the localiser notices it, and the steps
                # after that until the robot is located.
                if (when := first(nowhere[LEFT:BACK])) is not None:
                    said.append(when)
                there += sum(nowhere[LEFT:BACK])
                home += sum(nowhere[:LEFT])
                at_home += LEFT
                if (
                    again := first(
                        [
                            located(b, x)
                            for b, x in zip(beliefs[BACK:], drive.at[BACK:], strict=True)
                        ]
                    )
                ) is not None:
                    found.append(again)
            print(
                f"| {name} | {new:.0%} | {median(said)} | "
                f"{share(there, (BACK - LEFT) * len(maps))} | {share(home, at_home)} | "
                f"{median(found)} | {len(found)} of {len(maps)} |",
                flush=True,
            )


def walked(trace: Trace) -> Walk:
    return Walk(trace.with_views(["?"] * len(trace)), tuple(step.truth["dstate"] for step in trace))


def part_images(seeds: range) -> None:
    """Print the table of robots that are located by images."""
    warnings.simplefilter("ignore", ImageWarning)
    print(
        "| world | tours learnt | right: nearest neighbour | localiser | with somebody "
        "in front: nearest neighbour | localiser | found after being carried | found | "
        "other building is nowhere: one image | localiser | own images are nowhere |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|---|")
    for name, foreign in (
        ("notched-rectangle", "taylor-hall"),
        ("taylor-hall", "notched-rectangle"),
    ):
        for tours in (3, 10):
            right: dict[str, list[bool]] = {}
            found = []
            for seed in seeds:
                learnt = walked(simulate(World.named(name), tours=tours, seed=seed))
                ssh_map = true_map(learnt)
                number = dict(zip(learnt.truth, ssh_map.labels, strict=True))
                known = recogniser().fit(images_of(learnt.trace), ssh_map.labels)
                own = simulate(World.named(name), tours=3, seed=1000 + seed)
                more = simulate(World.named(name), tours=2, seed=2000 + seed)
                other = simulate(World.named(foreign), tours=1, seed=3000 + seed)
                # The robot is carried to its position after a third of the second drive.
                skipped = len(more) // 3
                images = np.concatenate(
                    [images_of(own), images_of(more)[skipped:], images_of(other)]
                )
                at = [
                    number.get(step.truth["dstate"]) for step in (*own.steps, *more.steps[skipped:])
                ] + [None] * len(other)
                front = in_front(images[: len(own)], np.random.default_rng(seed))
                beliefs = list(
                    Localiser(ssh_map, known).beliefs(
                        spliced([own.steps, more.steps[skipped:], other.steps], images)
                    )
                )
                nearest, alone = known.predict(images), ImageLikelihood.of(known).labels(images)
                for i in range(len(own)):
                    which = " in front" if front[i] else ""
                    right.setdefault(f"nearest{which}", []).append(nearest[i] == at[i])
                    right.setdefault(f"belief{which}", []).append(beliefs[i].dstate == at[i])
                    if not front[i]:
                        right.setdefault("own", []).append(alone[i] is None)
                for i in range(len(images) - len(other), len(images)):
                    right.setdefault("alone", []).append(alone[i] is None)
                    right.setdefault("nowhere", []).append(beliefs[i].dstate is None)
                carried = range(len(own), len(images) - len(other))
                if (again := first([located(beliefs[i], at[i]) for i in carried])) is not None:
                    found.append(again)
            shares = [
                f"{np.mean(right[kind]):.3f}"
                for kind in (
                    "nearest",
                    "belief",
                    "nearest in front",
                    "belief in front",
                    "alone",
                    "nowhere",
                    "own",
                )
            ]
            cells = [*shares[:4], median(found), f"{len(found)} of {len(seeds)}", *shares[4:]]
            print(f"| {name} | {tours} | {' | '.join(cells)} |", flush=True)


def in_front(
    images: NDArray[np.float64], rng: np.random.Generator, share: float = 0.05
) -> NDArray[np.bool_]:
    """Put a person in front of the laser in some images. The images are changed in place.

    The person is 0.4 to 0.8 m away and covers a sixth of the beams.

    Args:
        images: (n, 180) metres.
        rng: Source of random choices.
        share: Probability that an image is changed.

    Returns:
        (n,) mask of the changed images.
    """
    front = rng.random(len(images)) < share
    width = images.shape[1] // 6
    for image in (images[i] for i in np.flatnonzero(front)):
        begin = rng.integers(0, len(image) - width)
        image[begin : begin + width] = np.minimum(
            image[begin : begin + width], rng.uniform(0.4, 0.8)
        )
    return front


def spliced(drives: Sequence[Sequence[Step]], images: NDArray[np.float64]) -> Trace:
    """Join drives to one trace with images.

    The robot is carried from one drive to the next. The trace has the action of its first travel
    there.

    Args:
        drives: Steps of each drive.
        images: (n, 180) images of all steps in metres.
    """
    carried = next(
        step.action for step in drives[0] if step.action and step.action.kind == "travel"
    )
    actions = [step.action or carried for drive in drives for step in drive][:-1]
    steps = zip(images, [*actions, None], strict=True)
    return Trace(tuple(Step(image=tuple(image.tolist()), action=action) for image, action in steps))


def part_speed(seeds: range) -> None:
    """Print the table of localising speed, in steps per second."""
    print("| dstates | views | steps | CPU seconds | steps per second | made in, CPU seconds |")
    print("|---|---|---|---|---|---|")
    for dstates, views in ((100, 10), (1_000, 10), (10_000, 10), (10_000, 1_000), (10_000, 10_000)):
        chance = random.Random(seeds[0])
        links = tuple(
            (x, action, chance.randrange(dstates)) for x in range(dstates) for action in "abc"
        )
        ssh_map = SSHMap(
            (0,), tuple(DState(i, f"v{chance.randrange(views)}") for i in range(dstates)), links
        )
        robot = Robot(ssh_map, chance)
        seen, actions = [robot.view], []
        for _ in range(STEPS - 1):
            actions.append(robot.act())
            seen.append(robot.view)
        # Time the making of the localiser and the steps separately.
        trace = Trace.from_steps(seen, actions)  # type: ignore[arg-type]
        began = time.process_time()
        localiser = Localiser(ssh_map)
        made = time.process_time()
        for belief in localiser.beliefs(trace):
            _ = belief.entropy, belief.verdict, belief.dstate
        seconds = time.process_time() - made
        print(
            f"| {dstates:,} | {views:,} | {STEPS:,} | {seconds:.2f} | {STEPS / seconds:,.0f} "
            f"| {made - began:.2f} |",
            flush=True,
        )


PARTS = {
    "kidnapped": part_kidnapped,
    "nowhere": part_nowhere,
    "images": part_images,
    "speed": part_speed,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--part", choices=PARTS, action="append", help="measure only this part")
    parser.add_argument("--seeds", type=int, default=20, help="runs of each row (default 20)")
    parser.add_argument("--first", type=int, default=200, help="the first seed (default 200)")
    parser.add_argument("--plot", metavar="PNG", help="draw the belief of one robot instead")
    options = parser.parse_args()
    if options.plot:
        make = FAMILIES["mazes 5 x 5"]
        drive = elsewhere(
            true_map(make(options.first)),
            true_map(make(1000 + options.first)),
            options.first,
            1 / 3,
        )
        beliefs = Localiser(true_map(make(options.first))).beliefs(drive.trace)
        draw_beliefs(options.plot, [belief.to_dict() for belief in beliefs])
        return
    for name in options.part or PARTS:
        print(f"\n{name}\n")
        PARTS[name](range(options.first, options.first + options.seeds))


if __name__ == "__main__":
    main()
