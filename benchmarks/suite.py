"""The measured instances: traces by name, each with its theory.

Names that begin with "full" have the topological theory; all others have the causal one.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from instances import Walk, circuits, maze, moore, rectangle

from ssh_abduction import Theory, Trace

EXAMPLES = Path(__file__).parent.parent / "examples"


@dataclass(frozen=True)
class Instance:
    """A trace to solve.

    Attributes:
        name: Name of the instance.
        walk: Makes the trace from a seed.
        seeded: Whether the trace depends on the seed.
        star: The setting `star` of a topological theory.
    """

    name: str
    walk: Callable[[int], Walk]
    seeded: bool = True
    star: str = "auto"

    @property
    def causal(self) -> bool:
        return not self.name.startswith("full ")

    @property
    def theory(self) -> Theory:
        return Theory.causal() if self.causal else Theory.topological().replace(star=self.star)


def aces3() -> Walk:
    """Load the route of a real robot through the ACES building. Its true states are not given."""
    trace = Trace.load(EXAMPLES / "aces3-route.jsonl")
    return Walk(trace, ())


def taylor_hall(seed: int) -> Walk:
    """Simulate ten tours of a model of Taylor Hall: 240 images, clustered into views.

    This is done in another process, so that its memory is not measured.
    """
    with ProcessPoolExecutor(1, get_context("spawn")) as process:
        return process.submit(_taylor_hall, seed).result()


def _taylor_hall(seed: int) -> Walk:
    from perception.appearance import ReciprocalTransformer
    from perception.images import images_of
    from perception.views import ViewClusterer
    from simulator.tours import simulate
    from simulator.world import World

    trace = simulate(World.named("taylor-hall"), tours=10, seed=seed)
    views = (
        ViewClusterer(k_max=24, random_state=seed)
        .fit(ReciprocalTransformer().fit_transform(images_of(trace)))
        .labels_
    )
    steps = Trace.from_steps(
        views.tolist(), trace.actions, stars=[step.star for step in trace], name=trace.name
    )
    return Walk(steps, tuple(step.truth["dstate"] for step in trace if step.truth))


def _circuits(rounds: int) -> Callable[[int], Walk]:
    return lambda _: rectangle(rounds)


def _moore(states: int, views: int, steps: int) -> Instance:
    return Instance(
        f"moore {states}/{views} n={steps}",
        lambda seed: moore(states, views, steps=steps, seed=seed),
    )


def _maze(side: int, steps: int, *, full: bool = False) -> Instance:
    walk = partial(maze, side, side, steps=steps, stars=full)
    return Instance(
        f"{'full ' if full else ''}maze {side}x{side} n={steps}", lambda seed: walk(seed=seed)
    )


SUITE = {
    instance.name: instance
    for instance in (
        *(
            Instance(f"rectangle n={8 * n}", _circuits(n), seeded=False)
            for n in (50, 500, 5_000, 50_000)
        ),
        *(_moore(8, 2, steps) for steps in (800, 3200, 12_800)),
        *(_moore(states, 2, 800) for states in (12, 20)),
        _moore(30, 10, 200),
        _moore(50, 2, 3200),
        _moore(100, 10, 3200),
        *(_maze(side, 1600) for side in (2, 3, 4, 5)),
        _maze(8, 4000),
        *(_maze(side, 6400) for side in (5, 6)),
        *(Instance(f"full rectangle n={8 * n}", _circuits(n), seeded=False) for n in (50, 50_000)),
        _maze(5, 1600, full=True),
        _maze(10, 200, full=True),
        _maze(10, 4000, full=True),
        Instance("full taylor-hall", taylor_hall),
        Instance("full aces3", lambda _: aces3(), seeded=False),
    )
}
# An instance for which a map with frames is sought.
BARE = Instance(
    "full maze 3x3 n=400, loops, no stars", lambda seed: maze(3, 3, steps=400, seed=seed, loops=0.5)
)


def _block(width: int, height: int, rounds: int, *, views: int, full: bool = False) -> Instance:
    name = f"{'full ' if full else ''}circuits {width}x{height}, {rounds} rounds"
    return Instance(
        name, lambda seed: circuits(width, height, rounds=rounds, seed=seed, views=views)
    )


def _drive(name: str, side: int, steps: int, star: str = "auto", **kind: Any) -> Instance:
    return Instance(name, lambda seed: maze(side, side, steps=steps, seed=seed, **kind), star=star)


# Instances for pruning.py, which switches off one speed-up at a time, over several seeds.
PRUNED = (
    _moore(16, 2, 1600),
    _moore(16, 2, 10_000),
    _maze(5, 10_000),
    _maze(8, 10_000),
    _maze(4, 10_000),
    _maze(6, 10_000),
    _maze(6, 1600),
    _drive("maze 5x5 n=1600, corridors followed", 5, 1600, follow=True),
    _drive("maze 5x5 n=10000, corridors followed", 5, 10_000, follow=True),
    _block(60, 40, 4, views=2),
    _block(5, 3, 50, views=4, full=True),
    _block(6, 4, 20, views=4, full=True),
    _maze(4, 800, full=True),
    _maze(8, 150, full=True),
    _maze(10, 400, full=True),
    _drive("full maze 5x5 n=600, corridors followed", 5, 600, stars=True, follow=True),
    _drive("full maze 4x4 n=40, corridors followed, no stars", 4, 40, follow=True),
    _drive("full maze 3x3 n=60, stars as patterns", 3, 60, "pattern", stars=True),
    _drive("full maze 4x4 n=800, no stars", 4, 800),
    _drive("full maze 5x5 n=1600, no stars", 5, 1600),
)
INSTANCES = {**SUITE, **{instance.name: instance for instance in (BARE, *PRUNED)}}
