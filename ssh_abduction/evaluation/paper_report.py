"""Write a reproduction of the paper into a folder: figures, a page, data, and the configuration."""

from __future__ import annotations

import json
import platform
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from html import escape
from importlib.metadata import version
from pathlib import Path
from typing import Any

from joblib import Parallel, delayed
from joblib.externals.loky.process_executor import TerminatedWorkerError

from perception.images import images_of
from simulator.driver import STILL, Tolerance
from simulator.robot import Body, Laser
from simulator.tours import simulate
from simulator.world import World
from ssh_abduction.data.checks import one_of
from ssh_abduction.data.errors import AbductionError
from ssh_abduction.data.files import filled, write_file
from ssh_abduction.evaluation import figures
from ssh_abduction.evaluation.paper_experiments import (
    EXPERIMENTS,
    VIEWS_ALONE,
    WITH_STARS,
    NotchOutcome,
    SeedRun,
    measure,
    outcome,
    summary,
    true_dstates,
)
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
    name: str,
    seeds: Sequence[int],
    folder: Path,
    jobs: int = 2,
    outcomes: bool = True,
    on_done: Callable[[str], None] = lambda _: None,
    on_table: Callable[[list[dict[str, Any]]], None] = lambda _: None,
) -> list[dict[str, Any]]:
    """Run an experiment for all seeds, and write everything into a folder.

    Args:
        name: The experiment: "notched-rectangle" or "taylor-hall".
        seeds: The seeds of all noise.
        folder: The folder to write into. It is made if it does not exist.
        jobs: The number of processes that work at once; -1 for one per processor.
        outcomes: Whether to also run other notches and other spreads of poses. This is only for the
            notched rectangle.
        on_done: Called with a sentence after each part of the work. The function `steps` returns
            the number of parts.
        on_table: Called with the table once all data is written, before anything is drawn. So no
            data is lost if a figure fails.

    Raises:
        AbductionError: There is no such experiment, no seed, or no matplotlib, or a process died.
    """
    one_of("experiment", name, EXPERIMENTS, AbductionError)
    if not seeds:
        raise AbductionError("seeds: expected at least one, got none; write 0-19")
    figures.require_matplotlib()  # now, and not after hours of work
    folder.mkdir(parents=True, exist_ok=True)
    runs: list[SeedRun] = []
    for run in _each(measure, [(name, seed) for seed in seeds], jobs):
        runs.append(run)
        on_done(f"seed {run.seed}")
    # The data comes first, the pictures last.
    table = summary(name, runs)
    _dump(folder / "claims.json", table)
    _dump(folder / "runs.json", [asdict(run) for run in runs])
    _dump(folder / "configuration.json", _configuration(name, seeds, outcomes))
    found: list[NotchOutcome] = []
    if outcomes and name == "notched-rectangle":
        grid = [(notch, scale) for notch in NOTCHES for scale in SCALES]
        for o in _each(outcome, grid, jobs):
            found.append(o)
            on_done(f"notch {100 * o.notch:g} cm, spread {1000 * o.spread:.1f} mm")
        _dump(folder / "outcomes.json", [asdict(o) for o in found])
    write_file(folder / "report.html", _page(name, runs, table, folder).encode())
    on_table(table)
    _draw(name, runs[0], folder, on_done)
    if found:
        depth = -float(World.named(name).segments[:, 1::2].min())
        figures.draw_outcomes(folder / "outcomes.png", found, (depth, 1.0))
    write_file(folder / "report.html", _page(name, runs, table, folder).encode())
    return table


def _each(work: Callable[..., Any], tasks: Sequence[tuple[Any, ...]], jobs: int) -> Iterator[Any]:
    """Yield the results of `work` for these tasks, in their order, from `jobs` processes."""
    try:
        yield from Parallel(jobs, return_as="generator")(delayed(work)(*task) for task in tasks)
    except TerminatedWorkerError:
        raise AbductionError(
            "process: expected an answer, got a killed process (when memory runs out); "
            "take fewer --jobs"
        ) from None


def steps(name: str, seeds: Sequence[int], outcomes: bool) -> int:
    """Count how often `reproduce` will call `on_done` with these arguments, for a progress bar."""
    has_outcomes = outcomes and name == "notched-rectangle"
    return len(seeds) + 1 + (len(NOTCHES) * len(SCALES) if has_outcomes else 0)


def _draw(name: str, run: SeedRun, folder: Path, on_done: Callable[[str], None]) -> None:
    """Draw the figures of one run, and write its trace."""
    world = World.named(name)
    trace = simulate(world, EXPERIMENTS[name].tours, run.seed)
    trace.save(folder / "run.jsonl")
    learner = BootstrapLearner(VIEWS_ALONE).fit(trace)
    figures.draw_world(folder / "world.png", world, [step.truth["pose"] for step in trace.steps])
    figures.draw_views(folder / "views.png", images_of(trace), learner.views_, true_dstates(trace))
    figures.draw_quality(folder / "quality.png", run.quality, run.uncertainty, run.k)
    figures.draw_learning(folder / "learning.png", {"labels from the map": run.curve})
    figures.draw_spread(folder / "spread.png", run.spread)
    # The map from the views alone, and with the openings seen.
    starred = BootstrapLearner(WITH_STARS).fit(trace)
    for file, ssh_map in (("map", learner.map_), ("map-with-openings", starred.map_)):
        write_file(folder / f"{file}.svg", f"{to_svg(ssh_map)}\n".encode())
        figures.draw_map(folder / f"{file}.png", ssh_map)
    on_done("figures")


def _configuration(name: str, seeds: Sequence[int], outcomes: bool) -> dict[str, Any]:
    """List everything that is needed to repeat the reproduction: command, settings, versions."""
    packages = ("ssh-abduction", "clingo", "numpy", "scipy", "scikit-learn", "networkx")
    return {
        "experiment": name,
        "command": f"ssh-abduction reproduce {name} --seeds {','.join(map(str, seeds))}"
        f"{'' if outcomes else ' --set outcomes=false'}",
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
    write_file(path, f"{json.dumps(value, indent=1, ensure_ascii=False)}\n".encode())


def _page(name: str, runs: Sequence[SeedRun], table: Sequence[dict[str, Any]], folder: Path) -> str:
    """Write the HTML page, with the figures that are already in the folder."""
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
        Path(__file__).parent / "paper_report.html",
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
