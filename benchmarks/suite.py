"""What is measured: traces by name, each with the theory that it is solved under. "full" is the topological theory, else it is the causal one."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path

from instances import Walk, maze, moore, rectangle

from ssh_abduction import Theory, Trace

EXAMPLES = Path(__file__).parent.parent / "examples"


@dataclass(frozen=True)
class Instance:
    """A trace to solve: `walk` makes it from a seed, which `seeded` says matters."""

    name: str
    walk: Callable[[int], Walk]
    seeded: bool = True

    @property
    def causal(self) -> bool:
        return not self.name.startswith("full ")

    @property
    def theory(self) -> Theory:
        return Theory.causal() if self.causal else Theory.topological()


def aces3() -> Walk:
    """The route that a robot drove through the ACES building."""
    trace = Trace.load(EXAMPLES / "aces3-route.jsonl")
    return Walk(trace, ())


def taylor_hall(seed: int) -> Walk:
    """Ten tours of the stand-in for Taylor Hall: 240 images, clustered into views. Made in a process of its own, whose memory does not count."""
    with ProcessPoolExecutor(1, get_context("spawn")) as process:
        return process.submit(_taylor_hall, seed).result()


def _taylor_hall(seed: int) -> Walk:
    from perception.images import images_of
    from perception.reciprocal import ReciprocalTransformer
    from perception.views import ViewClusterer
    from simulator.tours import simulate
    from simulator.world import World

    trace = simulate(World.named("taylor-hall"), tours=10, seed=seed)
    views = ViewClusterer(k_max=24, random_state=seed).fit(ReciprocalTransformer().fit_transform(images_of(trace))).labels_
    steps = Trace.from_steps(views.tolist(), trace.actions, stars=[step.star for step in trace], name=trace.name)
    return Walk(steps, tuple(step.truth["dstate"] for step in trace if step.truth))


def _circuits(circuits: int) -> Callable[[int], Walk]:
    return lambda _: rectangle(circuits)


def _moore(states: int, views: int, steps: int) -> Instance:
    return Instance(f"moore {states}/{views} n={steps}", lambda seed: moore(states, views, steps=steps, seed=seed))


def _maze(side: int, steps: int, *, full: bool = False) -> Instance:
    walk = partial(maze, side, side, steps=steps, stars=full)
    return Instance(f"{'full ' if full else ''}maze {side}x{side} n={steps}", lambda seed: walk(seed=seed))


SUITE = {
    instance.name: instance
    for instance in (
        *(Instance(f"rectangle n={8 * n}", _circuits(n), seeded=False) for n in (50, 500, 5_000, 50_000)),
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
SMALL = _maze(2, 60, full=True)  # what the full theory's plain encoding can still do: for ablation.py
# Where a map with frames is sought:
BARE = Instance("full maze 3x3 n=400, loops, no stars", lambda seed: maze(3, 3, steps=400, seed=seed, loops=0.5))
INSTANCES = {**SUITE, SMALL.name: SMALL, BARE.name: BARE}
