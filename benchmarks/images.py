"""Images: simulation rate, time of clustering with the search for k by M, and rate of queries.

    python benchmarks/images.py [SIZE ...]

The script prints time and peak memory. Each measurement is a single run in its own process. Images
are of the notched rectangle. They are from poses near its eight dstates, which are places with
headings ("dstates"), or from uniformly drawn poses ("anywhere"). Images from anywhere have no
clusters, which is the slowest case.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import time

import numpy as np
from numpy.typing import NDArray

from perception.appearance import ReciprocalTransformer
from perception.recognition import PlaceRecogniser
from perception.views import ViewClusterer
from simulator.robot import Laser
from simulator.tours import simulate
from simulator.world import World

SIZES = (400, 4_000, 40_000)
MOST_VIEWS = 40
WORLD = World.named("notched-rectangle")


def ranges(kind: str, count: int, seed: int = 0) -> NDArray[np.float64]:
    """Simulate images: (count, 180), metres.

    Args:
        kind: "dstates" for poses near dstates, or "anywhere".
        count: Number of images.
        seed: Seed of poses and noise.
    """
    rng = np.random.default_rng(seed)
    if kind == "dstates":
        ideal = np.array([s.pose for s in WORLD.dstates])
        poses = ideal[np.arange(count) % len(ideal)] + rng.normal(
            0, [0.005, 0.005, 0.005], (count, 3)
        )
    else:
        poses = rng.uniform([0.3, 0.3, -np.pi], [3.7, 1.7, np.pi], (count, 3))
    return Laser().scan(WORLD, poses, rng)


def simulated(world: str) -> None:
    """Simulate scans from many poses at once, and a drive; print two lines of the table."""
    room, rng = World.named(world), np.random.default_rng(0)
    poses = np.repeat([s.pose for s in room.dstates], 20_000 // len(room.dstates), axis=0)
    began = time.perf_counter()
    Laser().scan(room, poses, rng)
    print(
        f"{world:18} {len(poses) / (time.perf_counter() - began):9,.0f} images a "
        "second, all poses at once",
        flush=True,
    )
    began = time.perf_counter()
    steps = len(simulate(room, tours=5))
    print(
        f"{world:18} {steps / (time.perf_counter() - began):9,.0f} dstates per second, driving",
        flush=True,
    )


def search(kind: str, count: int) -> None:
    """Search for k, the number of views; print a line of the table."""
    images = ReciprocalTransformer().fit_transform(ranges(kind, count))
    began = time.perf_counter()
    views = ViewClusterer(k_max=MOST_VIEWS, random_state=0).fit(images)
    seconds = time.perf_counter() - began
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10
    print(
        f"{kind:9} {count:7,} images, k = 2 … {MOST_VIEWS}: {seconds:7.1f} s, peak "
        f"{peak:6.0f} MB, k = {views.k_}",
        flush=True,
    )


def queries(kind: str, count: int) -> None:
    """Query the nearest of `count` images; print a line of the table."""
    images = ReciprocalTransformer().fit_transform(ranges(kind, count + 2_000))
    recogniser = PlaceRecogniser().fit(images[:count], np.arange(count) % 8)
    began = time.perf_counter()
    recogniser.predict(images[count:])
    seconds = time.perf_counter() - began
    print(
        f"{kind:9} {count:7,} images known: {2_000 / seconds:9,.0f} queries per second", flush=True
    )


def main() -> None:
    # Each measurement runs this script again, so that its peak memory is its own.
    if sys.argv[1:2] in (["search"], ["queries"]):
        (search if sys.argv[1] == "search" else queries)(sys.argv[2], int(sys.argv[3]))
        return
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument(
        "sizes", nargs="*", type=int, default=SIZES, metavar="SIZE", help="numbers of images"
    )
    sizes = parser.parse_args().sizes
    for world in ("notched-rectangle", "taylor-hall"):
        simulated(world)
    for job in ("search", "queries"):
        for kind in ("dstates", "anywhere"):
            for count in sizes:
                subprocess.run([sys.executable, __file__, job, kind, str(count)], check=True)


if __name__ == "__main__":
    main()
