"""What a picture shows, as a value: marks in the coordinates of the map, with x right and y up.

`svg` and `plotting` draw any scene. `map_scene` makes the scene of a map, and
`robot_logs/log_picture.py` that of a log. Sizes of marks, such as the width of a line, are in units
of the page, which are a pixel each.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from html import escape
from typing import TypeAlias

from ssh_abduction.data.errors import xml_text

Point: TypeAlias = tuple[float, float]

# The colours of paths and of drives, in turn. The first six are of the palette of Okabe & Ito,
# which people with colour blindness can distinguish.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7f7f7f", "#8c564b")
ALARM = "#b00020"  # the colour of faults


@dataclass(frozen=True, slots=True)
class Line:
    """Chains of points. A chain of one point is a dot as wide as the line.

    Attributes:
        chains: The points of each chain.
        colour: The colour of the line.
        width: Its width.
        opacity: From 0, invisible, to 1.
        dashes: Lengths of dashes and gaps, such as "4 3"; empty for a solid line.
        fill: The colour inside; "none" for an open line.
    """

    chains: tuple[tuple[Point, ...], ...]
    colour: str
    width: float = 2.0
    opacity: float = 1.0
    dashes: str = ""
    fill: str = "none"


@dataclass(frozen=True, slots=True)
class Disc:
    """A circle or an ellipse.

    Attributes:
        at: The middle.
        radii: The half axes.
        fill: The colour inside.
        outline: The colour of the outline; "none" for no outline.
        width: The width of the outline.
        angle: The direction of the first axis, in radians counterclockwise from x.
        fill_opacity: The opacity of the inside, from 0 to 1.
        dashes: As in `Line`, of the outline.
    """

    at: Point
    radii: Point
    fill: str
    outline: str = "none"
    width: float = 2.0
    angle: float = 0.0
    fill_opacity: float = 1.0
    dashes: str = ""


@dataclass(frozen=True, slots=True)
class Label:
    """A text that is centred at a point."""

    at: Point
    text: str
    colour: str = "#222"
    size: float = 12.0
    is_bold: bool = False


@dataclass(frozen=True, slots=True)
class Titled:
    """Marks with a title, which browsers show under the pointer, and a class for programs."""

    title: str
    marks: tuple[Mark, ...]
    kind: str = ""


Mark: TypeAlias = Line | Disc | Label | Titled


@dataclass(frozen=True, slots=True)
class Scene:
    """A picture that is not yet drawn.

    Attributes:
        marks: The marks, the lowest first.
        scale: How many units of the page a unit of the map has.
        metric: Whether coordinates are metres.
    """

    marks: tuple[Mark, ...]
    scale: float
    metric: bool = True


def colour_of(number: int) -> str:
    """Return the colour of a path or a drive, by its number."""
    return COLOURS[number % len(COLOURS)]


def escaped(text: str) -> str:
    """Escape text for XML, and replace characters that XML cannot hold."""
    return escape(xml_text(text))


def half_size(label: str, size: float) -> Point:
    """Estimate half the width and half the height of a label of this font size."""
    return 0.31 * size * len(label) + 1, 0.55 * size


def bounds(marks: Iterable[Mark], scale: float) -> tuple[float, float, float, float]:
    """Find the box (left, lowest, right, highest) around all marks; around (0, 0) without marks."""
    xs, ys = zip(*[*_corners(marks, scale)] or [(0.0, 0.0)], strict=True)
    return min(xs), min(ys), max(xs), max(ys)


def _corners(marks: Iterable[Mark], scale: float) -> Iterator[Point]:
    """Yield points whose box includes the marks."""
    for mark in marks:
        if isinstance(mark, Titled):
            yield from _corners(mark.marks, scale)
            continue
        if isinstance(mark, Line):
            spots, wide = [p for chain in mark.chains for p in chain], (mark.width / 2,) * 2
        elif isinstance(mark, Disc):
            spots, wide = [mark.at], (max(mark.radii),) * 2
        else:
            spots, wide = [mark.at], half_size(mark.text, mark.size)
        for x, y in spots:
            yield x - wide[0] / scale, y - wide[1] / scale
            yield x + wide[0] / scale, y + wide[1] / scale
