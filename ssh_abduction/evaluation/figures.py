"""Draw figures of experiments and of commands with matplotlib (the extra `plot`)."""

from __future__ import annotations

import importlib
import io
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from perception.recognition import LearningCurve, TellingFeatures
from simulator.robot import BEARINGS
from simulator.world import World
from ssh_abduction.data.checks import needed
from ssh_abduction.data.errors import AbductionError
from ssh_abduction.data.files import write_file
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.evaluation.paper_experiments import NotchOutcome
from ssh_abduction.output import plot

# The corners of the frame around a cell: x and y from its middle.
FRAME = 0.47 * np.array([[-1, 1, 1, -1, -1], [-1, -1, 1, 1, -1]])
BLUE, ORANGE, GREEN, GREY = "#0072b2", "#d55e00", "#009e73", "#888888"


def require_matplotlib() -> None:
    """Raise AbductionError if matplotlib cannot be loaded. Call this before hours of work."""
    try:
        with needed("plot", "matplotlib", "'ssh-abduction[plot]'"):
            importlib.import_module("matplotlib")
    except AbductionError:
        raise
    except Exception as error:  # matplotlib reads settings such as MPLBACKEND when it is loaded
        raise AbductionError(
            f"plot: expected matplotlib to load, got {type(error).__name__}: {error}; "
            "mend its settings"
        ) from None


def _pyplot() -> Any:
    """Load matplotlib.pyplot and set the style of all figures."""
    require_matplotlib()
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    pyplot.rcParams.update(
        {"font.size": 9, "axes.spines.top": False, "axes.spines.right": False, "figure.dpi": 110}
    )
    return pyplot


def _save(figure: Any, path: str | Path) -> None:
    drawn = io.BytesIO()
    figure.savefig(drawn, format=Path(path).suffix[1:].lower(), bbox_inches="tight")
    _pyplot().close(figure)
    write_file(path, drawn.getvalue())


def draw_quality(
    path: str | Path, quality: Mapping[int, float], uncertainty: Mapping[int, float], chosen: int
) -> None:
    """Draw M for each k (number of clusters), and U, which may be unknown. Mark the chosen k."""
    figure, axes = _pyplot().subplots(figsize=(5.5, 3.2))
    axes.plot(list(quality), list(quality.values()), "o-", color=BLUE, label="M")
    axes.axvline(chosen, color=GREY, linestyle=":", label=f"k = {chosen}")
    axes.set(xlabel="number of clusters k", ylabel="M: separation of clusters")
    if uncertainty:
        limits = min(0.7, *uncertainty.values()), 1.02
        right = _right_axis(axes, [*uncertainty], [*uncertainty.values()], "U(v|x)")
        right.set(ylabel="U: views determined by dstates", ylim=limits)
    figure.legend(frameon=False, loc="lower center", bbox_to_anchor=(0.5, 0.9), ncols=3)
    _save(figure, path)


def _right_axis(axes: Any, x: Sequence[float], y: Sequence[float], label: str) -> Any:
    """Draw a dashed curve against an axis on the right, and return the axis."""
    right = axes.twinx()
    right.plot(x, y, "s--", color=ORANGE, markersize=3, label=label)
    right.spines["right"].set_visible(True)
    return right


def draw_learning(path: str | Path, curves: Mapping[str, LearningCurve]) -> None:
    """Draw at most three learning curves: recognition rates by the number of images.

    A line is the mean over the folds, and a band the range.
    """
    figure, axes = _pyplot().subplots(figsize=(5.5, 3.2))
    for (name, curve), colour in zip(curves.items(), (BLUE, ORANGE, GREEN), strict=False):
        axes.fill_between(
            curve.sizes, curve.lowest, curve.highest, color=colour, alpha=0.2, linewidth=0
        )
        axes.plot(curve.sizes, curve.mean, "o-", color=colour, label=name)
    axes.set(xlabel="images seen", ylabel="recognition rate", ylim=(0, 1.03))
    axes.legend(frameon=False, loc="lower right")
    _save(figure, path)


def draw_beliefs(path: str | Path, beliefs: Sequence[Mapping[str, Any]]) -> None:
    """Draw the entropy of each belief, and the probability that the robot is nowhere on the map.

    Beliefs are as `Belief.to_dict` returns them. Steps at which the robot was lost or nowhere
    are shaded.
    """
    pyplot = _pyplot()
    figure, (upper, lower) = pyplot.subplots(
        2, 1, figsize=(7, 3.8), sharex=True, height_ratios=(2, 1)
    )
    # Shade the steps at which the robot was lost or nowhere, behind both curves.
    steps = np.arange(len(beliefs))
    edges = np.repeat(steps, 2) + np.tile([-0.5, 0.5], len(steps))
    for verdict, colour in (("lost", ORANGE), ("nowhere", GREY)):
        shaded = np.array([belief["verdict"] == verdict for belief in beliefs])
        label = verdict if shaded.any() else None
        style = {"color": colour, "alpha": 0.25, "linewidth": 0, "label": label}
        for axes in (upper, lower):
            style |= {"where": np.repeat(shaded, 2), "transform": axes.get_xaxis_transform()}
            axes.fill_between(edges, 0, 1, **style)
    entropy = np.array([belief["entropy"] for belief in beliefs])
    upper.plot(steps, entropy, "o-", color=BLUE, markersize=3, label="entropy")
    if any(collapsed := [belief["collapsed"] for belief in beliefs]):
        at, label = np.flatnonzero(collapsed), "the belief collapsed"
        upper.plot(at, entropy[at], "x", color="black", markersize=7, label=label)
    upper.set(ylabel="entropy, bits", ylim=(0, None))
    upper.legend(frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=4)
    lower.plot(steps, [belief["nowhere"] for belief in beliefs], color=BLUE)
    lower.set(xlabel="step", ylabel="p(nowhere)", ylim=(0, 1.03), xlim=(-0.5, len(steps) - 0.5))
    _save(figure, path)


def draw_world(path: str | Path, world: World, poses: Sequence[Sequence[float]]) -> None:
    """Draw the walls, the clutter, the true dstates, and the poses, in metres, of images."""
    figure, axes = _pyplot().subplots(figsize=(7, 4))
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
    _save(figure, path)


def draw_views(
    path: str | Path, images: NDArray[np.float64], views: NDArray[Any], truth: NDArray[Any]
) -> None:
    """Draw the images of each view on top of each other, as the robot sees them.

    Images are ranges in metres, of shape (n, d). Titles name the true dstates.
    """
    names = sorted(set(views.tolist()))
    columns = min(5, len(names))
    rows = math.ceil(len(names) / columns)
    figure, grid = _pyplot().subplots(
        rows, columns, figsize=(2.1 * columns, 2.0 * rows), squeeze=False
    )
    for axes in grid.flat:
        axes.axis("off")
    # All panels have the same scale, at which a few outliers are cut off.
    far = min(8.4, 1.05 * float(np.percentile(images, 98)))
    for axes, name in zip(grid.flat, names, strict=False):
        for image in images[views == name][:60]:
            axes.plot(*_ends(image, BEARINGS), color=BLUE, linewidth=0.4, alpha=0.3)
        axes.plot(0, 0, "^", color=ORANGE, markersize=5)
        axes.set(aspect="equal", xlim=(-far, far), ylim=(-0.06 * far, far))
        dstates = sorted(set(truth[views == name].tolist()))
        shown = ", ".join(dstates) if len(dstates) < 3 else f"{dstates[0]}, … ({len(dstates)})"
        axes.set_title(f"view {name}: {shown}", fontsize=7)
    _save(figure, path)


def draw_telling(
    path: str | Path,
    ranges: NDArray[np.float64],
    labels: NDArray[Any],
    found: Mapping[tuple[int, int], TellingFeatures],
) -> None:
    """Draw which beams of the laser distinguish pairs of dstates.

    Each panel shows the median scans of the two dstates. Each pair has a row, and each method a
    column.

    Args:
        path: The file to write.
        ranges: Ranges in metres, of shape (n, d), over the half circle ahead, the first at the
            right.
        labels: The dstate of each scan, of shape (n,).
        found: For each pair of dstates, how much each beam helps to distinguish them.
    """
    methods = list(next(iter(found.values())).methods)
    figure, grid = _pyplot().subplots(
        len(found), len(methods), figsize=(3.2 * len(methods), 2.3 * len(found)), squeeze=False
    )
    # A beam that distinguishes the two has a dot, larger if it distinguishes them better.
    bearings = np.radians((np.arange(ranges.shape[1]) + 0.5) * 180 / ranges.shape[1] - 90)
    for row, ((a, b), telling) in zip(grid, found.items(), strict=True):
        scans = [np.median(ranges[labels == name], axis=0) for name in (a, b)]
        far = 1.05 * min(8.0, max(float(np.max(scan)) for scan in scans))
        for axes, (method, shares) in zip(row, telling.methods.items(), strict=True):
            for scan, colour, dashes in zip(scans, (BLUE, GREEN), ("-", "--"), strict=True):
                axes.plot(*_ends(scan, bearings), dashes, color=colour, linewidth=0.8)
            at = np.flatnonzero(shares > 0)
            sizes = 300 * shares[at] / max(shares.max(), 0.01) * 0.5
            dots = _ends(scans[0][at], bearings[at])
            axes.scatter(*dots, s=sizes, color=ORANGE, alpha=0.6, linewidths=0)
            axes.plot(0, 0, "^", color="black", markersize=5)
            axes.set(aspect="equal", xlim=(-far, far), ylim=(-0.08 * far, far))
            axes.set_title(f"{a} or {b}: {method}", fontsize=8)
            axes.axis("off")
    _save(figure, path)


def draw_map(path: str | Path, ssh_map: SSHMap) -> None:
    """Draw the places of a map, and its paths as lines through them.

    Places are at the poses of the map if it has poses. Otherwise a layout is computed.
    """
    _pyplot()
    _save(plot(ssh_map).figure, path)


def draw_spread(path: str | Path, spread: Sequence[Sequence[float]]) -> None:
    """Draw the largest offset of a pose from the mean pose of its dstate, tour by tour.

    Offsets are in x and y (metres) and heading (radians).
    """
    table = np.array(spread)
    tours, largest = np.arange(1, len(table) + 1), 1000 * table[:, :2].max(1)
    figure, axes = _pyplot().subplots(figsize=(5.5, 2.8))
    axes.plot(tours, largest, "o-", color=BLUE, markersize=3, label="position")
    axes.set(xlabel="tour", ylabel="largest offset, mm", ylim=(0, None))
    right = _right_axis(axes, tours.tolist(), np.degrees(table[:, 2]).tolist(), "heading")
    right.set(ylabel="largest offset, degrees", ylim=(0, None))
    figure.legend(frameon=False, loc="upper right", ncols=2)
    _save(figure, path)


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
    figure, grid = _pyplot().subplots(2, 2, figsize=(9, 6.4))
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
    _save(figure, path)


def _ends(ranges: NDArray[np.float64], bearings: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Compute where beams end on a page on which the robot faces up: x and y in metres."""
    return [-ranges * np.sin(bearings), ranges * np.cos(bearings)]
