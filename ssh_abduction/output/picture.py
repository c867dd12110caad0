"""A map as a picture: paths through places, and at each place its dstates as marks that are headed as they face.

Where displacements say where the dstates are, they are drawn there (see `metric_picture`). Elsewhere the map says nothing of metres, and places are laid out so that
paths are straight and turns go to their side (see `layout`).
"""

from __future__ import annotations

import math
from itertools import pairwise

from ssh_abduction.data.maps import DState, SSHMap, checked_map
from ssh_abduction.data.trace import Trace
from ssh_abduction.output.drawing import COLOURS, RADIUS, Point, escaped, fault_mark, page, text
from ssh_abduction.output.layout import Layout, layout, located, travelled
from ssh_abduction.output.metric_picture import metric_svg
from ssh_abduction.output.turns import Turns, degrees_of

# In units of the page: between neighbouring places, from the middle of a place to the name of a dstate, and how far a dstate is drawn beside the line of its path.
SPACING, DSTATE, LANE = 130.0, 38.0, 9.0
# Characters of a view that are shown below a dstate: longer ones would run into the neighbours. The end is kept, as long names often begin alike.
LONGEST_LABEL = 20


def to_svg(ssh_map: SSHMap, turns: Trace | Turns | None = None) -> str:
    """A map as SVG text: in metres if it has poses, else with straight paths and turns to their side.

    Args:
        ssh_map: The map.
        turns: How actions turn: the trace that was mapped, or for each action's name "right",
            "left", "around" or degrees clockwise. Actions of these three names need none.

    Raises:
        MapError: If an argument is none of these.
    """
    checked_map(ssh_map)
    degrees_of(turns)
    if (where := located(ssh_map)) is not None:
        return metric_svg(ssh_map, where)
    found = layout(ssh_map, turns)
    return page(*(_topological(ssh_map, found) if ssh_map.places else _causal(ssh_map, found)))


def _on_page(x: float, y: float) -> Point:
    return x * SPACING + 0.0, -y * SPACING + 0.0  # no -0.0


def _topological(ssh_map: SSHMap, found: Layout) -> tuple[list[str], list[Point]]:
    """Paths: broad where the robot travelled, dotted where only the order of the places leads."""
    at = {place: _on_page(*spot) for place, spot in found.places.items()}
    lines, marks = [], []
    for path in ssh_map.paths:
        colour = COLOURS[path.id % len(COLOURS)]
        streets = travelled(ssh_map, path)
        index = {place: i for i, place in enumerate(path.order)}
        for p, q in pairwise(path.order):
            if (min(p, q), max(p, q)) not in streets:
                (ax, ay), (bx, by) = at[p], at[q]
                lines.append(
                    f'<path d="M{ax:.1f},{ay:.1f} L{bx:.1f},{by:.1f}" stroke="{colour}" stroke-width="2" stroke-dasharray="2 6" opacity="0.7"/>'
                )
        for p, q in streets:
            (ax, ay), (bx, by) = at[p], at[q]
            lines.append(
                f'<path d="M{ax:.1f},{ay:.1f} L{bx:.1f},{by:.1f}" stroke="{colour}" stroke-width="9" stroke-linecap="round" opacity="0.55"/>'
            )
        if len(path.order) > 1:
            ends = min(
                (sorted(pair, key=lambda place: index.get(place, 0)) for pair in streets),
                key=lambda pair: index.get(pair[0], 0),
                default=path.order,
            )
            marks += _path_name(f"path {path.id}", at[ends[0]], at[ends[1]], colour)
    for place in ssh_map.places:
        x, y = at[place]
        marks.append(
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{RADIUS}" fill="white" stroke="#222" stroke-width="2"/>'
        )
        marks.append(text(x, y, str(place), "#222", size=15, weight="bold"))
        marks += _dstates(ssh_map, place, at[place], found)
    return lines + marks, list(at.values())


def _path_name(name: str, a: Point, b: Point, colour: str) -> list[str]:
    """The name of a path beside a street of it, and an arrow on the street in direction +1."""
    (ax, ay), (bx, by) = a, b
    mx, my, angle = (ax + bx) / 2, (ay + by) / 2, math.degrees(math.atan2(by - ay, bx - ax))
    far = 26 / (math.dist(a, b) or 1.0)
    arrow = f'<path d="M-7,-6 L7,0 L-7,6 Z" fill="{colour}" transform="translate({mx:.1f},{my:.1f}) rotate({angle:.1f})"/>'
    return [arrow, text(mx - (by - ay) * far, my + (bx - ax) * far, name, colour, halo=True)]


def _faults(ssh_map: SSHMap) -> dict[int, str]:
    """What the map disbelieves, by the dstate where it does."""
    faults: dict[int, list[str]] = {}
    for fault in ssh_map.faults:
        faults.setdefault(ssh_map.labels[fault.step], []).append(str(fault))
    return {s: "; ".join(said) for s, said in faults.items()}


def _dstates(ssh_map: SSHMap, place: int, at: Point, found: Layout) -> list[str]:
    """The dstates at a place, each on the side that it faces. Dstates whose heading is not known are drawn where there is most room."""
    x, y = at
    taken: list[float] = []
    marks = []
    faults = _faults(ssh_map)
    facing: list[tuple[DState, float | None]] = [
        (s, found.dstates[s.id][2]) for s in ssh_map.dstates if s.place == place
    ]
    for s, heading in sorted(facing, key=lambda pair: pair[1] is None):
        bearing = _freest(taken) if heading is None else -heading
        taken.append(bearing)
        dx, dy = math.cos(bearing), math.sin(bearing)
        aside = (
            (0.0, 0.0) if s.path is None else (-dy * LANE, dx * LANE)
        )  # drawn to the right of the line of the path
        colour = "#555" if s.path is None else COLOURS[s.path % len(COLOURS)]
        title = f"dstate {s.id}: {s.shown}"
        px, py = x + dx * (RADIUS + 6) + aside[0], y + dy * (RADIUS + 6) + aside[1]
        marks.append(
            f'<g><title>{escaped(title)}</title><path d="M-5,-5 L5,0 L-5,5 Z" fill="{colour}" '
            f'transform="translate({px:.1f},{py:.1f}) rotate({math.degrees(bearing):.1f})"/></g>'
        )
        lx, ly = x + dx * DSTATE + aside[0] * 1.5, y + dy * DSTATE + aside[1] * 1.5
        marks.append(text(lx, ly, f"x{s.id}", "#222", halo=True))
        if s.id in faults:
            marks.append(fault_mark(lx + dx * 14, ly + dy * 14, faults[s.id]))
    return marks


def _freest(taken: list[float]) -> float:
    """Of 16 bearings, the one that is farthest from those taken."""
    bearings = [k * math.pi / 8 for k in range(16)]
    return max(
        bearings,
        key=lambda b: min((abs(math.remainder(b - t, math.tau)) for t in taken), default=0.0),
    )


def _causal(ssh_map: SSHMap, found: Layout) -> tuple[list[str], list[Point]]:
    at = [_on_page(x, y) for x, y, _ in found.dstates]
    faults = _faults(ssh_map)
    marks = []
    actions: dict[tuple[int, int], list[str]] = {}
    for source, action, target in ssh_map.links:
        if source != target:
            actions.setdefault((source, target), []).append(action)
    for (source, target), names in actions.items():
        (ax, ay), (bx, by) = at[source], at[target]
        far = math.hypot(bx - ax, by - ay) or 1.0
        ux, uy = (bx - ax) / far, (by - ay) / far
        mx, my = (ax + bx) / 2 - uy * 24, (ay + by) / 2 + ux * 24
        ex, ey = bx - ux * (RADIUS + 4), by - uy * (RADIUS + 4)
        marks.append(
            f'<path d="M{ax:.1f},{ay:.1f} Q{mx:.1f},{my:.1f} {ex:.1f},{ey:.1f}" fill="none" stroke="#888" stroke-width="1.5"/>'
        )
        angle = math.degrees(math.atan2(ey - my, ex - mx))
        marks.append(
            f'<path d="M-8,-4 L0,0 L-8,4 Z" fill="#888" transform="translate({ex:.1f},{ey:.1f}) rotate({angle:.1f})"/>'
        )
        marks.append(text(mx - ux * 12, my - uy * 12, ", ".join(names), "#555", halo=True))
    for s in ssh_map.dstates:
        x, y = at[s.id]
        marks.append(
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{RADIUS}" fill="white" stroke="{COLOURS[0]}" stroke-width="2"/>'
        )
        marks.append(text(x, y, f"x{s.id}", "#222", weight="bold"))
        label = (
            str(s.shown)
            if len(str(s.shown)) <= LONGEST_LABEL
            else f"…{str(s.shown)[1 - LONGEST_LABEL :]}"
        )
        marks.append(
            f"<g><title>{escaped(f'dstate {s.id}: {s.shown}')}</title>{text(x, y + RADIUS + 12, label, '#222', halo=True)}</g>"
        )
        if s.id in faults:
            marks.append(fault_mark(x + RADIUS, y - RADIUS, faults[s.id]))
    return marks, at
