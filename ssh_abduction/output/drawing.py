"""What pictures of maps are made of: colours, text, and the page around them, as SVG."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import TypeAlias

from ssh_abduction.data.errors import xml_text

Point: TypeAlias = tuple[float, float]

# In units of the page: around the picture, and the radius of a place.
MARGIN, RADIUS = 80.0, 17.0
# The colours of the paths, in turn. The first six are of the palette of Okabe & Ito, which people who are colour-blind can tell apart.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7f7f7f", "#8c564b")

ALARM = "#b00020"  # what is disbelieved


def text(
    x: float,
    y: float,
    label: str,
    colour: str,
    size: float = 12,
    weight: str = "normal",
    halo: bool = False,
) -> str:
    """A label with its middle at a point."""
    edge = ' stroke="white" stroke-width="3" paint-order="stroke"' if halo else ""
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size:g}" font-weight="{weight}" fill="{colour}"{edge} '
        f'text-anchor="middle" dominant-baseline="central">{escaped(label)}</text>'
    )


def fault_mark(x: float, y: float, title: str, size: float = 1.0) -> str:
    """The mark of what a map disbelieves: a red diamond with an exclamation mark, and what it is under the pointer."""
    u = 8 * size
    return (
        f'<g class="fault"><title>{escaped(title)}</title><path d="M{x:.1f},{y - u:.1f} l{u:.1f},{u:.1f} l{-u:.1f},{u:.1f} l{-u:.1f},{-u:.1f} Z" fill="{ALARM}" '
        f'stroke="white" stroke-width="1.5"/>{text(x, y, "!", "white", size=11 * size, weight="bold")}</g>'
    )


def escaped(label: str) -> str:
    """A text that XML can hold."""
    return escape(xml_text(label))


def page(marks: Sequence[str], points: Sequence[Point], margin: float = MARGIN) -> str:
    """An SVG file of these marks, as large as the points and a margin around them need."""
    xs, ys = [x for x, _ in points] or [0.0], [y for _, y in points] or [0.0]
    left, top = min(xs) - margin, min(ys) - margin
    width, height = max(xs) + margin - left, max(ys) + margin - top
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{left:.0f} {top:.0f} {width:.0f} {height:.0f}" '
        f'width="{width:.0f}" height="{height:.0f}" font-family="Helvetica, Arial, sans-serif">'
    )
    background = f'<rect x="{left:.0f}" y="{top:.0f}" width="{width:.0f}" height="{height:.0f}" fill="white"/>'
    return "\n".join([head, background, *marks, "</svg>"])
