"""Draw a map with matplotlib, into new axes or into axes with other content."""

from __future__ import annotations

import math
from typing import Any

from ssh_abduction.data.checks import needed
from ssh_abduction.data.errors import MapError, brief
from ssh_abduction.data.maps import SSHMap, checked_map
from ssh_abduction.data.trace import Trace
from ssh_abduction.output.headings import Turns
from ssh_abduction.output.map_scene import scene_of
from ssh_abduction.output.scene import Disc, Label, Mark, Scene, Titled, bounds

PIXELS, LARGEST = 96.0, 20.0  # units of the page in an inch, and inches of new axes at most
POINTS = 72 / PIXELS  # points in a unit of the page


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
    scene = scene_of(ssh_map, turns)
    left, lowest, right, highest = bounds(scene.marks, scene.scale)
    with needed("plot", "matplotlib", "'ssh-abduction[plot]'", MapError):
        from matplotlib import pyplot
    # Texts and lines shrink with the axes, if the whole map would be too large.
    size = [(far * scene.scale / PIXELS + 1) for far in (right - left, highest - lowest)]
    share = min(1.0, LARGEST / max(size))
    if ax is None:
        ax = pyplot.subplots(figsize=[share * inches for inches in size], layout="constrained")[1]
    _draw(ax, scene, share)
    ax.update_datalim([(left, lowest), (right, highest)])
    ax.autoscale_view()
    ax.set_aspect("equal")
    ax.axis("on" if scene.metric else "off")
    if scene.metric:
        ax.set(xlabel="x [m]", ylabel="y [m]")
    return ax


def _draw(axes: Any, scene: Scene, share: float) -> None:
    """Draw the marks of a scene. `share` is the factor for the widths of lines, and for texts."""
    from matplotlib.colors import to_rgba
    from matplotlib.patches import Ellipse
    from matplotlib.patheffects import withStroke

    def draw(mark: Mark) -> None:
        if isinstance(mark, Titled):
            for part in mark.marks:
                draw(part)
        elif isinstance(mark, Label):
            style: dict[str, Any] = {"color": mark.colour, "fontsize": mark.size * POINTS * share}
            halo = [withStroke(linewidth=1.5, foreground="white")]
            style |= {} if mark.colour == "white" else {"path_effects": halo}
            weight = "bold" if mark.is_bold else "normal"
            axes.text(*mark.at, mark.text, ha="center", va="center", fontweight=weight, **style)
        elif isinstance(mark, Disc):
            across = (2 * radius / scene.scale for radius in mark.radii)
            style = {"edgecolor": mark.outline, "linewidth": mark.width * POINTS * share}
            style |= {"facecolor": to_rgba(mark.fill, mark.fill_opacity), "zorder": 2}
            style |= {"linestyle": "--" if mark.dashes else "-"}
            axes.add_patch(Ellipse(mark.at, *across, angle=math.degrees(mark.angle), **style))
        else:
            style = {"color": mark.colour, "alpha": mark.opacity, "zorder": 2}
            style |= {"linestyle": ":"} if mark.dashes else {"solid_capstyle": "round"}
            for chain in mark.chains:
                xs, ys = zip(*chain, strict=True)
                if mark.fill != "none":
                    axes.fill(xs, ys, color=mark.fill, zorder=2)
                axes.plot(xs, ys, linewidth=mark.width * POINTS * share, **style)

    for mark in scene.marks:
        draw(mark)
