"""Draw a map, or any scene, as an SVG picture."""

from __future__ import annotations

import math

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.output.headings import Turns
from ssh_abduction.output.map_scene import scene_of
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
)

MARGIN = 24.0  # units of the page around the picture


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
    x, y = mark.at[0] * scale + 0.0, -mark.at[1] * scale + 0.0  # + 0.0 turns -0.0 into 0.0
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
    return f"{point[0] * scale + 0.0:.1f},{-point[1] * scale + 0.0:.1f}"


def _element(tag: str, content: str = "", /, **attributes: str) -> str:
    """Make an SVG element. Underscores in attributes become hyphens, or are cut off at the end."""
    written = "".join(
        f' {name.rstrip("_").replace("_", "-")}="{value}"' for name, value in attributes.items()
    )
    return f"<{tag}{written}>{content}</{tag}>" if content else f"<{tag}{written}/>"
