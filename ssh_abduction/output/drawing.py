"""The parts of pictures of maps as SVG: elements, labels, marks of faults, and the page."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import TypeAlias

from ssh_abduction.data.errors import xml_text
from ssh_abduction.data.maps import SSHMap

Point: TypeAlias = tuple[float, float]

# In units of the page: the margin around the picture, and the radius of a place.
MARGIN, RADIUS = 80.0, 17.0
# The colours of paths, in turn. The first six are of the palette of Okabe & Ito, which people with
# colour blindness can distinguish.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7f7f7f", "#8c564b")
ALARM = "#b00020"  # of faults


def element(tag: str, content: str = "", /, **attributes: object) -> str:
    """An SVG element.

    Args:
        tag: Its tag.
        content: What is inside of it, as SVG.
        attributes: Its attributes. An underscore in a name stands for a hyphen, and one at the end
            of a name for nothing.
    """
    written = "".join(
        f' {name.rstrip("_").replace("_", "-")}="{value}"' for name, value in attributes.items()
    )
    return f"<{tag}{written}>{content}</{tag}>" if content else f"<{tag}{written}/>"


def titled(title: str, /, *marks: str, **attributes: object) -> str:
    """Marks with a title, which browsers show under the pointer."""
    return element("g", f"<title>{escaped(title)}</title>{''.join(marks)}", **attributes)


def at(point: Point) -> str:
    """A point as the data of an SVG path has it."""
    return f"{point[0]:.1f},{point[1]:.1f}"


def line(a: Point, b: Point) -> str:
    """A line as the data of an SVG path has it."""
    return f"M{at(a)} L{at(b)}"


def placed(point: Point, degrees: float) -> str:
    """The transform that turns a mark clockwise and moves it to a point."""
    return f"translate({at(point)}) rotate({degrees:.1f})"


def text(
    x: float,
    y: float,
    label: str,
    colour: str,
    size: float = 12,
    weight: str = "normal",
    halo: bool = False,
) -> str:
    """A label whose middle is at a point, perhaps with a white halo."""
    return element(
        "text",
        escaped(label),
        x=f"{x:.1f}",
        y=f"{y:.1f}",
        font_size=f"{size:g}",
        font_weight=weight,
        fill=colour,
        **({"stroke": "white", "stroke_width": 3, "paint_order": "stroke"} if halo else {}),
        text_anchor="middle",
        dominant_baseline="central",
    )


def fault_mark(x: float, y: float, title: str, size: float = 1.0) -> str:
    """A red diamond with an exclamation mark, for what a map ignores."""
    u = 8 * size
    diamond = element(
        "path",
        d=f"M{x:.1f},{y - u:.1f} l{u:.1f},{u:.1f} l{-u:.1f},{u:.1f} l{-u:.1f},{-u:.1f} Z",
        fill=ALARM,
        stroke="white",
        stroke_width=1.5,
    )
    return titled(title, diamond, text(x, y, "!", "white", 11 * size, "bold"), class_="fault")


def faults_of(ssh_map: SSHMap) -> dict[int, str]:
    """What a map ignores, by the dstate of the step."""
    faults: dict[int, list[str]] = {}
    for fault in ssh_map.faults:
        faults.setdefault(ssh_map.labels[fault.step], []).append(str(fault))
    return {s: "; ".join(said) for s, said in faults.items()}


def links_of(ssh_map: SSHMap) -> dict[tuple[int, int], str]:
    """The names of the actions that lead from one dstate to another."""
    actions: dict[tuple[int, int], list[str]] = {}
    for source, action, target in ssh_map.links:
        if source != target:
            actions.setdefault((source, target), []).append(action)
    return {ends: ", ".join(names) for ends, names in actions.items()}


def escaped(label: str) -> str:
    """A text as XML can hold it."""
    return escape(xml_text(label))


def page(marks: Sequence[str], points: Sequence[Point], margin: float = MARGIN) -> str:
    """An SVG file of these marks, large enough for the points and a margin around them."""
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
