"""Draw a map, or any scene, as an SVG picture or with matplotlib."""

from __future__ import annotations

import math
from typing import Any

from ssh_abduction.data.checks import needed
from ssh_abduction.data.errors import MapError, brief
from ssh_abduction.data.maps import SSHMap, checked_map
from ssh_abduction.data.trace import Trace
from ssh_abduction.output.layout import Turns
from ssh_abduction.output.scene import (
    Disc,
    Label,
    Line,
    Mark,
    Point,
    Scene,
    Titled,
    bounds,
    escaped,
    scene_of,
)

MARGIN = 24.0  # units of the page around the picture
PIXELS, LARGEST = 96.0, 20.0  # units of the page in an inch, and inches of new axes at most
POINTS = 72 / PIXELS  # points in a unit of the page


def to_svg(ssh_map: SSHMap, turns: Trace | Turns | None = None) -> str:
    """Draw a map as SVG text: to scale if it has poses, else with straight paths.

    A dstate (distinctive state) is a place and a heading. Each is an arrow. Labels of a map with
    poses are left out where there is no room. Browsers show the same text as a title when the
    pointer is on a mark.

    Args:
        ssh_map: The map.
        turns: How actions turn, for a map without poses: the trace that was mapped; or a dict from
            the name of an action to "right", "left", "around" or degrees clockwise. Actions that
            are themselves named right, left or around need no entry.

    Raises:
        MapError: `ssh_map` is not a map, or `turns` has a value that is no turn.
    """
    return svg_of(scene_of(ssh_map, turns))


def svg_of(scene: Scene) -> str:
    """Draw a scene as the text of an SVG file."""
    scale = scene.scale
    left, lowest, right, highest = (scale * far for far in bounds(scene.marks, scale))
    box = (left - MARGIN, -highest - MARGIN, right - left + 2 * MARGIN)
    x, y, w, h = (f"{number:.0f}" for number in (*box, highest - lowest + 2 * MARGIN))
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{x} {y} {w} {h}" '
        f'width="{w}" height="{h}" font-family="Helvetica, Arial, sans-serif">'
    )
    background = _element("rect", x=x, y=y, width=w, height=h, fill="white")
    return "\n".join([head, background, *(_mark(mark, scale) for mark in scene.marks), "</svg>"])


def _mark(mark: Mark, scale: float) -> str:
    """Write one mark as SVG."""
    if isinstance(mark, Titled):
        inside = "".join(_mark(part, scale) for part in mark.marks)
        kind = {"class_": mark.kind} if mark.kind else {}
        return _element("g", f"<title>{escaped(mark.title)}</title>{inside}", **kind)
    if isinstance(mark, Line):
        return _line(mark, scale)
    # + 0.0 turns -0.0 into 0.0
    x, y = round(mark.at[0] * scale, 1) + 0.0, round(-mark.at[1] * scale, 1) + 0.0
    if isinstance(mark, Disc):
        return _disc(mark, x, y)
    return _label(mark, x, y)


def _line(line: Line, scale: float) -> str:
    """Write the chains of a line as one path. A chain of one point is a line of length 0."""
    data = " ".join(
        "M" + "L".join(_at(point, scale) for point in chain) + ("h0" if len(chain) == 1 else "")
        for chain in line.chains
    )
    ends = {"stroke_dasharray": line.dashes} if line.dashes else {"stroke_linecap": "round"}
    faint = {} if line.opacity == 1 else {"opacity": f"{line.opacity:g}"}
    shape = {"stroke": line.colour, "stroke_width": f"{line.width:.4g}", "fill": line.fill}
    return _element("path", d=data, **shape, stroke_linejoin="round", **ends, **faint)


def _disc(disc: Disc, x: float, y: float) -> str:
    """Write a circle, or an ellipse that is turned around its middle."""
    style = {"fill": disc.fill, "stroke": disc.outline, "stroke_width": f"{disc.width:.4g}"}
    style |= {} if disc.fill_opacity == 1 else {"fill_opacity": f"{disc.fill_opacity:g}"}
    style |= {"stroke_dasharray": disc.dashes} if disc.dashes else {}
    spot, (rx, ry) = {"cx": f"{x:.1f}", "cy": f"{y:.1f}"}, disc.radii
    if rx == ry:
        return _element("circle", **spot, r=f"{rx:.1f}", **style)
    turned = f"rotate({-math.degrees(disc.angle):.2f} {x:.1f} {y:.1f})"
    return _element("ellipse", **spot, rx=f"{rx:.2f}", ry=f"{ry:.2f}", transform=turned, **style)


def _label(label: Label, x: float, y: float) -> str:
    """Write a text, with a white halo that makes it readable on top of lines."""
    style = {"x": f"{x:.1f}", "y": f"{y:.1f}", "font_size": f"{label.size:g}", "fill": label.colour}
    style |= {"font_weight": "bold"} if label.is_bold else {}
    if label.colour != "white":
        style |= {"stroke": "white", "stroke_width": "3", "paint_order": "stroke"}
    centred = {"text_anchor": "middle", "dominant_baseline": "central"}
    return _element("text", escaped(label.text), **style, **centred)


def _at(point: Point, scale: float) -> str:
    """Write a point of the map as "x,y" on the page, where y points down."""
    return f"{round(point[0] * scale, 1) + 0.0:.1f},{round(-point[1] * scale, 1) + 0.0:.1f}"


def _element(tag: str, content: str = "", /, **attributes: str) -> str:
    """Make an SVG element. Underscores in attributes become hyphens, or are cut off at the end."""
    written = "".join(
        f' {name.rstrip("_").replace("_", "-")}="{value}"' for name, value in attributes.items()
    )
    return f"<{tag}{written}>{content}</{tag}>" if content else f"<{tag}{written}/>"


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
    with needed("plot", "matplotlib", "'.[plot]' in your clone", MapError):
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
