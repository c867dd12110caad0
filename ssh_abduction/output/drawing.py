"""Make the parts of SVG pictures of maps: elements, labels, marks of faults, and the page.

Units are those of the page, with x to the right and y down. Functions return SVG text.
"""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import TypeAlias

from ssh_abduction.data.errors import xml_text
from ssh_abduction.data.groups import gathered
from ssh_abduction.data.maps import SSHMap

Point: TypeAlias = tuple[float, float]

# In units of the page: the margin around the picture, and the radius of a place.
MARGIN, RADIUS = 80.0, 17.0
FLOOR = 52.0  # in the same units, how far the name of a floor is above its dstates
# The colours of paths, in turn. The first six are of the palette of Okabe & Ito, which people with
# colour blindness can distinguish.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7f7f7f", "#8c564b")
ALARM = "#b00020"  # of faults


def colour_of(number: int) -> str:
    """Return the colour of a path or a drive, by its number."""
    return COLOURS[number % len(COLOURS)]


def element(tag: str, content: str = "", /, **attributes: object) -> str:
    """Make an SVG element with content of SVG.

    Underscores in the names of attributes become hyphens. Underscores at the end are removed,
    so that `class_` is possible.
    """
    written = "".join(
        f' {name.rstrip("_").replace("_", "-")}="{value}"' for name, value in attributes.items()
    )
    return f"<{tag}{written}>{content}</{tag}>" if content else f"<{tag}{written}/>"


def titled(title: str, /, *marks: str, **attributes: object) -> str:
    """Group marks of SVG and give them a title, which browsers show under the pointer.

    Attributes are as in `element`.
    """
    return element("g", f"<title>{escaped(title)}</title>{''.join(marks)}", **attributes)


def at(point: Point) -> str:
    """Write a point as "x,y", for the data of an SVG path."""
    return f"{point[0]:.1f},{point[1]:.1f}"


def line(a: Point, b: Point) -> str:
    """Write a straight line as the data of an SVG path."""
    return f"M{at(a)} L{at(b)}"


def placed(point: Point, degrees: float) -> str:
    """Write the SVG transform that turns a mark by degrees clockwise and moves it to a point."""
    return f"translate({at(point)}) rotate({degrees:.1f})"


def svg_text(
    x: float,
    y: float,
    label: str,
    colour: str,
    size: float = 12,
    weight: str = "normal",
    halo: bool = False,
) -> str:
    """Make a label that is centred at a point. A white halo makes it readable on top of lines."""
    style = {"x": f"{x:.1f}", "y": f"{y:.1f}", "font_size": f"{size:g}", "font_weight": weight}
    outline = {"stroke": "white", "stroke_width": 3, "paint_order": "stroke"} if halo else {}
    centred = {"text_anchor": "middle", "dominant_baseline": "central"}
    return element("text", escaped(label), **style, fill=colour, **outline, **centred)


def circle(x: float, y: float, radius: float, fill: str, stroke: str, width: object = 2) -> str:
    """Draw a filled circle with an outline of a colour and width."""
    spot = {"cx": f"{x:.1f}", "cy": f"{y:.1f}", "r": f"{radius:.1f}"}
    return element("circle", **spot, fill=fill, stroke=stroke, stroke_width=width)


def fault_mark(x: float, y: float, title: str, size: float = 1.0) -> str:
    """Make a red diamond with an exclamation mark and a title, which shows a fault of a map.

    At size 1 it is 16 units across.
    """
    u = 8 * size
    way = f"M{x:.1f},{y - u:.1f} l{u:.1f},{u:.1f} l{-u:.1f},{u:.1f} l{-u:.1f},{-u:.1f} Z"
    diamond = element("path", d=way, fill=ALARM, stroke="white", stroke_width=1.5)
    return titled(title, diamond, svg_text(x, y, "!", "white", 11 * size, "bold"), class_="fault")


def faults_in_words(ssh_map: SSHMap) -> dict[int, str]:
    """For each dstate with a fault of the map at one of its steps, say the faults in words."""
    faults = gathered((ssh_map.dstate_at[fault.step], str(fault)) for fault in ssh_map.faults)
    return {s: "; ".join(said) for s, said in faults.items()}


def link_names(ssh_map: SSHMap) -> dict[tuple[int, int], str]:
    """Return the names of the actions, joined by commas, for each pair (start, end) of dstates."""
    actions = gathered(
        ((source, target), action) for source, action, target in ssh_map.links if source != target
    )
    return {ends: ", ".join(names) for ends, names in actions.items()}


def floor_marks(ssh_map: SSHMap, at: Sequence[Point]) -> tuple[list[str], list[Point]]:
    """Draw the names of floors and, in a map with places, lifts as dashed lines.

    `at` has the point of each dstate on the page. Return the marks, and the points that the
    page has to include. Both are empty without floors.
    """
    marks, points = [], []
    floor = [s.floor for s in ssh_map.dstates]
    for source, action, target in ssh_map.links:
        if ssh_map.places and floor[source] != floor[target]:
            dashed = {"stroke_dasharray": "6 5", "opacity": 0.8}
            mark = element("path", d=line(at[source], at[target]), stroke="#999", **dashed)
            marks.append(titled(action, mark))
    for i, members in enumerate(ssh_map.floors):
        x, y = min(at[s][0] for s in members), min(at[s][1] for s in members) - FLOOR
        points.append((x, y))
        marks.append(svg_text(x, y, f"floor {i}", "#222", size=16, weight="bold", halo=True))
    return marks, points


def escaped(label: str) -> str:
    """Escape text for XML, and replace characters that XML cannot hold."""
    return escape(xml_text(label))


def page(marks: Sequence[str], points: Sequence[Point], margin: float = MARGIN) -> str:
    """Make the text of an SVG file from marks, with a margin around the points."""
    xs, ys = [x for x, _ in points] or [0.0], [y for _, y in points] or [0.0]
    left, top = min(xs) - margin, min(ys) - margin
    width, height = max(xs) + margin - left, max(ys) + margin - top
    x, y, w, h = (f"{number:.0f}" for number in (left, top, width, height))
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{x} {y} {w} {h}" '
        f'width="{w}" height="{h}" font-family="Helvetica, Arial, sans-serif">'
    )
    background = element("rect", x=x, y=y, width=w, height=h, fill="white")
    return "\n".join([head, background, *marks, "</svg>"])
