"""Draw a map with matplotlib, into new axes or into axes with other content."""

from __future__ import annotations

import math
from itertools import combinations
from typing import Any

from ssh_abduction.data.checks import needed
from ssh_abduction.data.errors import MapError, brief
from ssh_abduction.data.maps import DState, SSHMap, checked_map
from ssh_abduction.data.trace import Trace
from ssh_abduction.output.drawing import ALARM, colour_of
from ssh_abduction.output.headings import Turns
from ssh_abduction.output.layout import Layout, layout, travelled, untravelled

# APART is the number of inches between neighbouring places. AHEAD and LANE are shares of the
# distance of the two nearest places: the mark of a dstate is AHEAD of its place, and LANE beside
# the line of its path.
APART, AHEAD, LANE = 0.9, 0.27, 0.07


def plot(ssh_map: SSHMap, ax: Any = None, turns: Trace | Turns | None = None) -> Any:
    """Draw a map with matplotlib, with x to the right and y up; in metres if it has poses.

    Args:
        ssh_map: The map.
        ax: The matplotlib axes to draw into; None for new ones.
        turns: How actions turn, as in `to_svg`.

    Returns:
        The axes. Their attribute `figure` can be shown or saved.

    Raises:
        MapError: `ssh_map` is not a map, `ax` is no axes of matplotlib, `turns` has a value that is
            no turn, or matplotlib is not installed.
    """
    checked_map(ssh_map)
    if ax is not None and not hasattr(ax, "annotate"):
        raise MapError(
            f"ax: expected axes of matplotlib, got {brief(ax)}; "
            f"make some with matplotlib.pyplot.subplots, or leave them out"
        )
    found = layout(ssh_map, turns)
    spots = list(found.places.values()) or [(x, y) for x, y, _ in found.dstates]
    unit = _nearest(spots)
    axes = _new_axes(spots, unit) if ax is None else ax
    # Later marks lie on top of earlier ones.
    if ssh_map.places:
        _draw_paths(axes, ssh_map, found)
    else:
        _draw_links(axes, ssh_map, found)
    for place, spot in found.places.items():
        axes.plot(*spot, "o", color="white", markeredgecolor="black", markersize=14)
        axes.text(*spot, str(place), ha="center", va="center", fontsize=8, fontweight="bold")
    doubted = {ssh_map.dstate_at[fault.step] for fault in ssh_map.faults}
    for s in ssh_map.dstates:
        mark = _draw_dstate(axes, s, found.dstates[s.id], unit)
        if s.id in doubted:
            diamond = {"marker": "D", "markersize": 9, "markerfacecolor": "none"}
            axes.plot(*mark, color=ALARM, linestyle="none", **diamond)
    axes.set_aspect("equal")
    axes.axis("on" if found.metric else "off")
    if found.metric:
        axes.set(xlabel="x [m]", ylabel="y [m]")
    return axes


def _draw_paths(axes: Any, ssh_map: SSHMap, found: Layout) -> None:
    """Draw paths: broad lines where the robot travelled, dotted ones between other neighbours."""
    for path in ssh_map.paths:
        colour = colour_of(path.id)
        dotted = {"linewidth": 1, "linestyle": ":", "alpha": 0.7}
        broad = {"linewidth": 6, "solid_capstyle": "round", "alpha": 0.55}
        for pairs, style in ((untravelled, dotted), (travelled, broad)):
            for ends in pairs(ssh_map, path):
                xs, ys = zip(*(found.places[p] for p in ends), strict=True)
                axes.plot(xs, ys, color=colour, **style)


def _draw_links(axes: Any, ssh_map: SSHMap, found: Layout) -> None:
    """Draw each link as an arrow between two dstates, for a map that has no places."""
    style = {"arrowstyle": "-|>", "color": "#888", "shrinkA": 9, "shrinkB": 9}
    for source, _, target in ssh_map.links:
        start, end = found.dstates[source][:2], found.dstates[target][:2]
        axes.annotate("", end, start, arrowprops=style)


def _draw_dstate(
    axes: Any, s: DState, pose: tuple[float, float, float | None], unit: float
) -> tuple[float, float]:
    """Draw a dstate as a triangle ahead of its place, or as its number. Return where it is."""
    x, y, heading = pose
    middle = {"ha": "center", "va": "center"}
    if s.place is None or heading is None:
        circle = {"boxstyle": "circle", "facecolor": "white"}
        axes.text(x, y, f"x{s.id}", fontsize=7, bbox=circle, **middle)
        return x, y
    dx, dy = math.cos(heading) * unit, math.sin(heading) * unit
    mark = (x + AHEAD * dx + LANE * dy, y + AHEAD * dy - LANE * dx)
    colour = "#555" if s.path is None else colour_of(s.path)
    triangle = (3, 0, math.degrees(heading) - 90)
    axes.plot(*mark, marker=triangle, color=colour, markersize=6, linestyle="none")
    axes.text(mark[0] + 0.09 * dx, mark[1] + 0.09 * dy, f"x{s.id}", fontsize=5, **middle)
    return mark


def _nearest(spots: list[tuple[float, float]]) -> float:
    """Compute the distance of the two nearest different spots; 1 if there are no two."""
    far = (math.dist(p, q) for p, q in combinations(spots, 2))
    return min((metres for metres in far if metres > 1e-6), default=1.0)


def _new_axes(spots: list[tuple[float, float]], unit: float) -> Any:
    """Make matplotlib axes that are large enough for spots."""
    with needed("plot", "matplotlib", "'ssh-abduction[plot]'", MapError):
        from matplotlib import pyplot
    width, height = (
        min(20.0, (max(numbers) - min(numbers)) / unit * APART + 2)
        for numbers in zip(*spots, strict=True)
    )
    return pyplot.subplots(figsize=(width, height), layout="constrained")[1]
