"""Draw the figures of the paper's experiments (benchmarks/reproduce.py) with matplotlib."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from paper_experiments import LearningCurve, NotchOutcome

from simulator.robot import BEARINGS
from simulator.world import World
from ssh_abduction.evaluation.figures import (
    BLUE,
    GREEN,
    ORANGE,
    load_pyplot,
    right_axis,
    save_figure,
)

# The corners of the frame around a cell: x and y from its middle.
FRAME = 0.47 * np.array([[-1, 1, 1, -1, -1], [-1, -1, 1, 1, -1]])


def draw_world(path: str | Path, world: World, poses: Sequence[Sequence[float]]) -> None:
    """Draw the walls, the clutter, the true dstates, and the poses, in metres, of images."""
    figure, axes = load_pyplot().subplots(figsize=(7, 4))
    for x1, y1, x2, y2 in world.segments:
        axes.plot([x1, x2], [y1, y2], color="black", linewidth=1.5)
    for item in world.clutter:
        for x1, y1, x2, y2 in item.segments:
            axes.plot([x1, x2], [y1, y2], color=ORANGE, linewidth=1)
    at = np.array(poses)
    axes.plot(at[:, 0], at[:, 1], ".", color=BLUE, markersize=3, alpha=0.5)
    # Each dstate has an arrow. Up to eight dstates are named at the tips. If there are more, only
    # places are named.
    size = 0.05 * max(world.bounds[2] - world.bounds[0], world.bounds[3] - world.bounds[1])
    for s in world.dstates:
        x, y, heading = s.pose
        dx, dy = size * math.cos(heading), size * math.sin(heading)
        arrow = {"arrowstyle": "->", "color": GREEN}
        axes.annotate("", (x + dx, y + dy), (x, y), arrowprops=arrow)
        if len(world.dstates) <= 8:
            axes.text(x + 1.35 * dx, y + 1.35 * dy, s.name, ha="center", va="center")
    if len(world.dstates) > 8:
        for place in sorted({s.place for s in world.dstates}):
            x, y, _ = next(s.pose for s in world.dstates if s.place == place)
            axes.text(x + 0.9 * size, y + 0.75 * size, place, ha="center")
    axes.set(aspect="equal", xlabel="x, metres", ylabel="y, metres")
    save_figure(figure, path)


def draw_views(
    path: str | Path, images: NDArray[np.float64], views: NDArray[Any], truth: NDArray[Any]
) -> None:
    """Draw the images of each view on top of each other, as the robot sees them.

    Images are ranges in metres, of shape (n, d). Titles name the true dstates.
    """
    names = sorted(set(views.tolist()))
    columns = min(5, len(names))
    rows = math.ceil(len(names) / columns)
    figure, grid = load_pyplot().subplots(
        rows, columns, figsize=(2.1 * columns, 2.0 * rows), squeeze=False
    )
    for axes in grid.flat:
        axes.axis("off")
    # All panels have the same scale, at which a few outliers are cut off.
    far = min(8.4, 1.05 * float(np.percentile(images, 98)))
    for axes, name in zip(grid.flat, names, strict=False):
        for image in images[views == name][:60]:
            axes.plot(*ends_of_beams(image, BEARINGS), color=BLUE, linewidth=0.4, alpha=0.3)
        axes.plot(0, 0, "^", color=ORANGE, markersize=5)
        axes.set(aspect="equal", xlim=(-far, far), ylim=(-0.06 * far, far))
        dstates = sorted(set(truth[views == name].tolist()))
        shown = ", ".join(dstates) if len(dstates) < 3 else f"{dstates[0]}, … ({len(dstates)})"
        axes.set_title(f"view {name}: {shown}", fontsize=7)
    save_figure(figure, path)


def draw_spread(path: str | Path, spread: Sequence[Sequence[float]]) -> None:
    """Draw the largest offset of a pose from the mean pose of its dstate, tour by tour.

    Offsets are in x and y (metres) and heading (radians).
    """
    table = np.array(spread)
    tours, largest = np.arange(1, len(table) + 1), 1000 * table[:, :2].max(1)
    figure, axes = load_pyplot().subplots(figsize=(5.5, 2.8))
    axes.plot(tours, largest, "o-", color=BLUE, markersize=3, label="position")
    axes.set(xlabel="tour", ylabel="largest offset, mm", ylim=(0, None))
    right = right_axis(axes, tours.tolist(), np.degrees(table[:, 2]).tolist(), "heading")
    right.set(ylabel="largest offset, degrees", ylim=(0, None))
    figure.legend(frameon=False, loc="upper right", ncols=2)
    save_figure(figure, path)


def draw_outcomes(
    path: str | Path, outcomes: Sequence[NotchOutcome], here: tuple[float, float]
) -> None:
    """Draw the outcomes for several depths of the notch and several spreads of poses.

    There is a panel each for k, U, whether the map is right, and the recognition rate. Results as
    in the paper get a frame. A cross marks the notch and the scale of the experiment.
    """
    notches, scales = sorted({o.notch for o in outcomes}), sorted({o.scale for o in outcomes})
    by_both = {(o.notch, o.scale): o for o in outcomes}
    cells = [[by_both[notch, scale] for scale in scales] for notch in notches]
    spreads = np.mean([[1000 * o.spread for o in row] for row in cells], axis=0)
    figure, grid = load_pyplot().subplots(2, 2, figsize=(9, 6.4))
    # Each panel has a title, the value of a cell and its text, and the lowest value of its colours.
    panels: list[tuple[str, Callable[[NotchOutcome], float], Callable[[float], str], float]] = [
        ("k chosen by M", lambda o: o.k, "{:.0f}".format, 2),
        ("U at that k", lambda o: o.uncertainty, "{:.2f}".format, 0.7),
        ("map right", lambda o: o.right, lambda right: "yes" if right else "no", 0),
        ("recognition rate (true labels)", lambda o: o.rate, "{:.2f}".format, 0.4),
    ]
    for axes, (title, value, text, lowest) in zip(grid.flat, panels, strict=True):
        table = np.round([[float(value(o)) for o in row] for row in cells], 3)
        axes.imshow(table, origin="lower", cmap="Blues", aspect="auto", vmin=lowest)
        for (i, j), shown in np.ndenumerate(table):
            dark = "white" if shown > (lowest + table.max()) / 2 else "black"
            axes.text(j, i, text(shown), ha="center", va="center", fontsize=8, color=dark)
            o = cells[i][j]
            if o.k == 4 and o.uncertainty > 1 - 1e-9 and o.right and o.rate > 0.999:
                axes.plot(j + FRAME[0], i + FRAME[1], color=ORANGE, linewidth=2)
        x = np.interp(here[1], scales, range(len(scales)))
        y = np.interp(here[0], notches, range(len(notches)))
        axes.plot(x, y, "x", color="red", markersize=10, markeredgewidth=2.5)
        axes.set_xticks(range(len(scales)), [f"{spread:.1f}" for spread in spreads])
        axes.set_yticks(range(len(notches)), [f"{100 * n:g}" for n in notches])
        axes.set(
            title=title, xlabel="spread of positions (rms), mm", ylabel="depth of the notch, cm"
        )
    figure.tight_layout()
    save_figure(figure, path)


def draw_learning(path: str | Path, curve: LearningCurve) -> None:
    """Draw a learning curve: a line for the mean over the folds, and a band for their range."""
    figure, axes = load_pyplot().subplots(figsize=(5.5, 3.2))
    axes.fill_between(curve.sizes, curve.lowest, curve.highest, color=BLUE, alpha=0.2, linewidth=0)
    axes.plot(curve.sizes, curve.mean, "o-", color=BLUE, label="labels from the map")
    axes.set(xlabel="images seen", ylabel="recognition rate", ylim=(0, 1.03))
    axes.legend(frameon=False, loc="lower right")
    save_figure(figure, path)


def ends_of_beams(
    ranges: NDArray[np.float64], bearings: NDArray[np.float64]
) -> list[NDArray[np.float64]]:
    """Compute where beams end on a page on which the robot faces up: x and y in metres."""
    return [-ranges * np.sin(bearings), ranges * np.cos(bearings)]
