"""A map drawn with matplotlib, where that is installed: as `picture` draws it, into axes that may hold more."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

from ssh_abduction.data.errors import MapError, brief
from ssh_abduction.data.maps import SSHMap, checked_map
from ssh_abduction.data.trace import Trace
from ssh_abduction.output.drawing import ALARM, COLOURS
from ssh_abduction.output.layout import layout, travelled
from ssh_abduction.output.turns import Turns

# Inches between neighbouring places; and as shares of the way between the two nearest: where the mark of a dstate is, and how far beside the line of its path.
APART, AHEAD, LANE = 0.9, 0.27, 0.07


def plot(ssh_map: SSHMap, ax: Any = None, turns: Trace | Turns | None = None) -> Any:
    """Draw a map with matplotlib, x to the right and y up; in metres if it has poses.

    Args:
        ssh_map: The map.
        ax: The axes to draw into; None for new ones. `ax.figure` shows and saves them.
        turns: How actions turn, as in `to_svg`.

    Returns:
        The axes.

    Raises:
        MapError: If an argument is none of these, or matplotlib is not installed.
    """
    checked_map(ssh_map)
    if ax is not None and not hasattr(ax, "annotate"):
        raise MapError(
            f"ax: expected axes of matplotlib, got {brief(ax)}; make some with matplotlib.pyplot.subplots, or leave them out"
        )
    found = layout(ssh_map, turns)
    spots = list(found.places.values()) or [(x, y) for x, y, _ in found.dstates]
    unit = _nearest(spots)
    axes = _new_axes(spots, unit) if ax is None else ax
    for path in ssh_map.paths:
        colour, streets = COLOURS[path.id % len(COLOURS)], travelled(ssh_map, path)
        for p, q in pairwise(path.order):
            if (min(p, q), max(p, q)) not in streets:
                axes.plot(
                    *zip(found.places[p], found.places[q], strict=True),
                    color=colour,
                    linewidth=1,
                    linestyle=":",
                    alpha=0.7,
                )
        for p, q in streets:
            axes.plot(
                *zip(found.places[p], found.places[q], strict=True),
                color=colour,
                linewidth=6,
                alpha=0.55,
                solid_capstyle="round",
            )
    if not ssh_map.places:
        for source, _, target in ssh_map.links:
            axes.annotate(
                "",
                found.dstates[target][:2],
                found.dstates[source][:2],
                arrowprops={"arrowstyle": "-|>", "color": "#888", "shrinkA": 9, "shrinkB": 9},
            )
    for place, spot in found.places.items():
        axes.plot(*spot, "o", color="white", markeredgecolor="black", markersize=14)
        axes.text(*spot, str(place), ha="center", va="center", fontsize=8, fontweight="bold")
    doubted = {ssh_map.labels[fault.step] for fault in ssh_map.faults}
    for s in ssh_map.dstates:
        x, y, heading = found.dstates[s.id]
        if s.place is not None and heading is not None:
            dx, dy = math.cos(heading) * unit, math.sin(heading) * unit
            mark = (x + AHEAD * dx + LANE * dy, y + AHEAD * dy - LANE * dx)
            colour = "#555" if s.path is None else COLOURS[s.path % len(COLOURS)]
            axes.plot(
                *mark,
                marker=(3, 0, math.degrees(heading) - 90),
                color=colour,
                markersize=6,
                linestyle="none",
            )
            axes.text(
                mark[0] + 0.09 * dx,
                mark[1] + 0.09 * dy,
                f"x{s.id}",
                fontsize=5,
                ha="center",
                va="center",
            )
        else:
            mark = (x, y)
            axes.text(
                x,
                y,
                f"x{s.id}",
                fontsize=7,
                ha="center",
                va="center",
                bbox={"boxstyle": "circle", "facecolor": "white"},
            )
        if s.id in doubted:
            axes.plot(
                *mark,
                marker="D",
                color=ALARM,
                markersize=9,
                markerfacecolor="none",
                linestyle="none",
            )
    axes.set_aspect("equal")
    axes.axis("on" if found.metric else "off")
    if found.metric:
        axes.set(xlabel="x [m]", ylabel="y [m]")
    return axes


def _nearest(spots: list[tuple[float, float]]) -> float:
    """How far the two nearest spots that are not one are apart; 1 where there are no two."""
    return min(
        (far for i, p in enumerate(spots) for q in spots[:i] if (far := math.dist(p, q)) > 1e-6),
        default=1.0,
    )


def _new_axes(spots: list[tuple[float, float]], unit: float) -> Any:
    try:
        from matplotlib import pyplot
    except ImportError:
        raise MapError(
            "plot: expected matplotlib, got none; install 'ssh-abduction[plot]'"
        ) from None
    width, height = (
        min(20.0, (max(numbers) - min(numbers)) / unit * APART + 2)
        for numbers in zip(*spots, strict=True)
    )
    return pyplot.subplots(figsize=(width, height), layout="constrained")[1]
