"""The claims of the paper about its two experiments, each with a test on our runs.

M measures how well clusters of images are separated. U measures how well the dstate determines the
view: it is 1 if all images of a dstate have one view.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ssh_abduction.evaluation.paper.experiments import EXPERIMENTS, FoundMaps, SeedRun


@dataclass(frozen=True)
class Claim:
    """A claim about an experiment."""

    text: str  # the claim
    paper: str  # the value in the paper
    here: Callable[[SeedRun], str]  # a function that writes the value of a run as text
    holds: Callable[[SeedRun], bool]  # a function that tells whether the claim holds in a run
    # Whether the claim is not in the paper. Then it follows from the argument of the paper, or it
    # is about this robot alone.
    ours: bool = False


def claims(name: str) -> list[Claim]:
    """List the claims of the paper about "notched-rectangle" or "taylor-hall", and our own."""
    e = EXPERIMENTS[name]
    triple = f"{e.dstates}, {e.places}, {e.paths}"
    counts = {"dstates": e.dstates, "places": e.places, "paths": e.paths}
    right = FoundMaps(counts, maps=1)
    if name == "notched-rectangle":
        largest = Claim(
            "largest k with U = 1",
            "the same k",
            lambda r: str(r.clustering.largest_k),
            lambda r: r.clustering.largest_k == r.clustering.k,
        )
    else:
        higher = "higher k would still have been free of variability: largest k with U = 1"
        largest = Claim(
            higher,
            f"above {e.views}",
            lambda r: str(r.clustering.largest_k),
            lambda r: r.clustering.largest_k > r.clustering.k,
        )
    return [
        Claim(
            f"k chosen by M, {'400' if e.views == 4 else '240'} images",
            str(e.views),
            lambda r: str(r.clustering.k),
            lambda r: r.clustering.k == e.views,
        ),
        Claim(
            "U at that k",
            "1",
            lambda r: f"{_uncertainty(r):.3f}",
            lambda r: _uncertainty(r) > 1 - 1e-9,
        ),
        largest,
        Claim(
            "dstates, places, paths, from the views alone",
            triple,
            lambda r: _triple(r.by_views),
            lambda r: r.by_views == right,
        ),
        Claim(
            "the same, with the openings seen at each place",
            triple,
            lambda r: _triple(r.by_stars),
            lambda r: r.by_stars == right,
            ours=True,
        ),
        Claim(
            "labels from the views alone are the true dstates",
            "yes",
            lambda r: "yes" if r.labelling.right else "no",
            lambda r: r.labelling.right,
        ),
        Claim(
            "dstates that share a view are told apart",
            "yes",
            lambda r: f"{r.labelling.told_apart} of {r.labelling.aliased} pairs",
            lambda r: r.labelling.told_apart == r.labelling.aliased > 0,
        ),
        Claim(
            "nearest neighbour on abduced labels, all images",
            "100 %",
            lambda r: f"{100 * r.curve.mean[-1]:.1f} %",
            lambda r: r.curve.mean[-1] > 0.9999,
        ),
        Claim(
            "clustering alone, k = number of dstates: U < 1 or dstates share views",
            "yes",
            lambda r: (
                f"U {r.contrast.alone_uncertainty:.3f}, {r.contrast.alone_distinct} of {e.dstates} "
                f"distinct; M {r.clustering.quality[e.dstates]:.1f} against {_quality(r):.1f}"
            ),
            lambda r: (
                r.contrast.alone_uncertainty < 1 - 1e-9 or r.contrast.alone_distinct < e.dstates
            ),
            ours=True,
        ),
        Claim(
            "images at even distances, same k: M and U drop",
            "yes",
            lambda r: (
                f"M {_quality(r):.1f} to {r.contrast.even_quality:.2f}, "
                f"U to {r.contrast.even_uncertainty:.2f}"
            ),
            lambda r: (
                r.contrast.even_quality < _quality(r)
                and r.contrast.even_uncertainty < _uncertainty(r) - 1e-9
            ),
            ours=True,
        ),
        Claim(
            "recognition by clusters, by map, by truth: first below, the others equal",
            "yes",
            lambda r: (
                ", ".join(
                    f"{100 * r.rates[kind]:.1f}" for kind in ("clustering alone", "map", "truth")
                )
                + " %"
            ),
            lambda r: (
                r.rates["clustering alone"] < r.rates["map"] - 0.02
                and abs(r.rates["map"] - r.rates["truth"]) < 0.01
            ),
            ours=True,
        ),
        Claim(
            "errors do not add up: largest offset from a dstate, last tour against first",
            "no growth",
            lambda r: (
                f"{1000 * max(r.spread[-1][:2]):.0f} mm "
                f"against {1000 * max(r.spread[0][:2]):.0f} mm"
            ),
            lambda r: _trend(r) < 0.5,
            ours=True,
        ),
    ]


def _quality(run: SeedRun) -> float:
    """Return M at the chosen number of views."""
    return run.clustering.quality[run.clustering.k]


def _uncertainty(run: SeedRun) -> float:
    """Return U at the chosen number of views."""
    return run.clustering.uncertainty[run.clustering.k]


def _triple(found: FoundMaps) -> str:
    """Write the numbers of dstates, places and paths, and the number of maps if it is not 1."""
    cost = found.cost
    if cost is None:
        return "no map"
    several = "" if found.maps == 1 else f" (#{found.maps})"
    return f"{cost['dstates']}, {cost['places']}, {cost['paths']}{several}"


def _trend(run: SeedRun) -> float:
    """The growth of the largest offset over a run, as a share of its mean, by a linear fit."""
    largest = np.array([max(row[:2]) for row in run.spread])
    slope = np.polyfit(np.arange(len(largest)), largest, 1)[0]
    return float(slope * len(largest) / largest.mean())


def summary(name: str, runs: Sequence[SeedRun]) -> list[dict[str, Any]]:
    """Make a table of the claims about an experiment from its runs, one for each seed.

    A row has the value in the paper, the value for each seed, and the number of runs in which
    the claim holds.
    """
    return [
        {
            "claim": claim.text,
            "ours": claim.ours,
            "paper": claim.paper,
            "here": {str(run.seed): claim.here(run) for run in runs},
            "holds": sum(claim.holds(run) for run in runs),
            "seeds": len(runs),
        }
        for claim in claims(name)
    ]
