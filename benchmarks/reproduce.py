"""Repeat an experiment of Kuipers & Beeson (2002): simulate, cluster, abduce, learn.

    python benchmarks/reproduce.py notched-rectangle|taylor-hall [--seeds 0-19] [--jobs 2]
                                   [--no-outcomes] [-o out/EXPERIMENT]

The script writes a folder: a page with the table of claims and figures, each claim by seed, all
measurements, and the configuration. For the notched rectangle, it also tries other depths of the
notch and other spreads of the robot's poses, unless --no-outcomes is given.
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from html import escape
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import paper_figures
from arguments import seeds_from
from joblib import Parallel, delayed
from paper_experiments import (
    EXPERIMENTS,
    VIEWS_ALONE,
    WITH_STARS,
    SeedRun,
    measure,
    outcome,
    summary,
    true_dstates,
)

from perception.images import images_of
from simulator.driver import STILL, Tolerance
from simulator.robot import Body, Laser
from simulator.tours import simulate
from simulator.world import World
from ssh_abduction.cli.text import table as text_table
from ssh_abduction.data.files import filled
from ssh_abduction.evaluation import figures
from ssh_abduction.learning.learner import BootstrapLearner
from ssh_abduction.output import to_svg

# Depths of the notch in metres.
NOTCHES = (0.0, 0.01, 0.02, 0.03, 0.05, 0.1, 0.2)
# Factors for the spread of poses that the robot leaves.
SCALES = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)

# The numbers of the paper's figures: of the world, of M and U, and of the learning curve.
NUMBERS = {"notched-rectangle": ("2", "3", "4"), "taylor-hall": ("5", "6, left", "6, right")}
# The figures of a page that are in its folder. Captions have the numbers in place of {0} to {2}.
FIGURES = {
    "world.png": "Figure {0}: the world. Walls, clutter (orange), true dstates (arrows) and where "
    "images were taken.",
    "views.png": "Ours: the views. Images of each cluster on top of each other, the robot at the "
    "triangle, facing up.",
    "quality.png": "Figure {1}: M and U against the number of clusters.",
    "map.svg": "Ours: the minimal map, from the views alone.",
    "map-with-openings.svg": "Ours: the minimal map with the openings that the robot saw, too.",
    "learning.png": "Figure {2}: recognition rate on the map's labels, mean and range over ten "
    "folds.",
    "spread.png": "Ours: errors do not add up. The largest offset from a dstate's mean pose, tour "
    "by tour.",
    "outcomes.png": "Ours: where the method works. Frames: all as in the paper (4 views, U = 1, "
    "right map, full recognition). Cross: this robot.",
}


def reproduce(
    name: str, seeds: Sequence[int], folder: Path, jobs: int = 2, outcomes: bool = True
) -> list[dict[str, Any]]:
    """Run an experiment for all seeds, write everything into a folder, and return the table.

    Args:
        name: The experiment: "notched-rectangle" or "taylor-hall".
        seeds: The seeds of all noise.
        folder: The folder to write into. It is made if it does not exist.
        jobs: The number of processes that work at once; -1 for one per processor.
        outcomes: Whether to also run other notches and other spreads of poses. This is only for the
            notched rectangle.
    """
    folder.mkdir(parents=True, exist_ok=True)
    workers = Parallel(jobs, verbose=1)
    runs = workers(delayed(measure)(name, seed) for seed in seeds)
    # The data comes first, the pictures last.
    table = summary(name, runs)
    _dump(folder / "claims.json", table)
    _dump(folder / "runs.json", [asdict(run) for run in runs])
    _dump(folder / "configuration.json", _configuration(name, seeds, outcomes))
    if outcomes and name == "notched-rectangle":
        found = workers(delayed(outcome)(notch, scale) for notch in NOTCHES for scale in SCALES)
        _dump(folder / "outcomes.json", [asdict(o) for o in found])
        depth = -float(World.named(name).segments[:, 1::2].min())
        paper_figures.draw_outcomes(folder / "outcomes.png", found, (depth, 1.0))
    _draw(name, runs[0], folder)
    (folder / "report.html").write_text(_page(name, runs, table, folder), encoding="utf-8")
    return table


def _draw(name: str, run: SeedRun, folder: Path) -> None:
    """Draw the figures of one run, and write its trace."""
    world = World.named(name)
    trace = simulate(world, EXPERIMENTS[name].tours, run.seed)
    trace.save(folder / "run.jsonl")
    learner = BootstrapLearner(VIEWS_ALONE).fit(trace)
    paper_figures.draw_world(
        folder / "world.png", world, [step.truth["pose"] for step in trace.steps]
    )
    paper_figures.draw_views(
        folder / "views.png", images_of(trace), learner.views_, true_dstates(trace)
    )
    figures.draw_quality(folder / "quality.png", run.quality, run.uncertainty, run.k)
    paper_figures.draw_learning(folder / "learning.png", run.curve)
    paper_figures.draw_spread(folder / "spread.png", run.spread)
    # The map from the views alone, and with the openings seen.
    starred = BootstrapLearner(WITH_STARS).fit(trace)
    for file, ssh_map in (("map", learner.map_), ("map-with-openings", starred.map_)):
        (folder / f"{file}.svg").write_text(f"{to_svg(ssh_map)}\n", encoding="utf-8")


def _configuration(name: str, seeds: Sequence[int], outcomes: bool) -> dict[str, Any]:
    """List everything that is needed to repeat the reproduction: command, settings, versions."""
    packages = ("ssh-abduction", "clingo", "numpy", "scipy", "scikit-learn", "networkx")
    return {
        "experiment": name,
        "command": f"benchmarks/reproduce.py {name} --seeds {seeds[0]}-{seeds[-1]}"
        f"{'' if outcomes else ' --no-outcomes'}",
        **asdict(EXPERIMENTS[name]),
        "seeds": list(seeds),
        "laser": asdict(Laser()),
        "robot": asdict(Body()),
        "hill-climbing": {**asdict(Tolerance()), "images at rest": STILL},
        "theory": {"views alone": VIEWS_ALONE.to_dict(), "with openings": WITH_STARS.to_dict()},
        "versions": {"python": platform.python_version(), **{p: version(p) for p in packages}},
        "platform": sys.platform,
    }


def _dump(path: Path, value: Any) -> None:
    text = json.dumps(value, indent=1, ensure_ascii=False, default=np.ndarray.tolist)
    path.write_text(f"{text}\n", encoding="utf-8")


def _page(name: str, runs: Sequence[SeedRun], table: Sequence[dict[str, Any]], folder: Path) -> str:
    """Make the HTML page, with the figures that are already in the folder."""
    rows = "\n".join(
        f"<tr class='{'ours' if row['ours'] else 'paper'}'><td>{escape(claimed(row))}</td>"
        f"<td>{escape(row['paper'])}</td><td>{escape(spread_of(row))}</td>"
        f"<td>{row['holds']} of {row['seeds']}</td></tr>"
        for row in table
    )
    shown = "\n".join(
        f'<figure><img src="{file}" alt="{(said := escape(text.format(*NUMBERS[name])))}">'
        f"<figcaption>{said}</figcaption></figure>"
        for file, text in FIGURES.items()
        if (folder / file).exists()
    )
    return filled(
        Path(__file__).parent / "reproduce.html",
        title=escape(World.named(name).name),
        seeds=str(len(runs)),
        first=str(runs[0].seed),
        rows=rows,
        shown=shown,
    )


def claimed(row: dict[str, Any]) -> str:
    """Return the text of a claim, marked if it is not in the paper."""
    return f"ours: {row['claim']}" if row["ours"] else str(row["claim"])


def spread_of(row: dict[str, Any]) -> str:
    """Write the values of all seeds: one text if they agree, else the three most frequent ones."""
    found = Counter(row["here"].values()).most_common()
    if len(found) == 1:
        return str(found[0][0])
    said = "; ".join(f"{value} (x{seeds})" for value, seeds in found[:3])
    return said + ("; …" if len(found) > 3 else "")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("experiment", choices=EXPERIMENTS)
    parser.add_argument("--seeds", type=seeds_from, default=seeds_from("0-19"), metavar="A-B")
    parser.add_argument("--jobs", type=int, default=2, metavar="N")
    parser.add_argument("--no-outcomes", action="store_true")
    parser.add_argument("-o", "--output", type=Path, metavar="FOLDER")
    options = parser.parse_args()
    name, folder = options.experiment, options.output or Path("out", options.experiment)
    rows = reproduce(name, options.seeds, folder, options.jobs, not options.no_outcomes)
    cells = [[claimed(r), r["paper"], spread_of(r), f"{r['holds']} of {r['seeds']}"] for r in rows]
    print(text_table(["claim", "paper", "here", "holds"], cells))
    print(f"\nThe page with the figures is {folder / 'report.html'}")


if __name__ == "__main__":
    main()
