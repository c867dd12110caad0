"""Draw a map as an SVG picture: paths through places, and marks for the dstates at each place.

A dstate (distinctive state) is a place and a heading. A map with poses is drawn to scale
(`metric_picture`). A map without poses is drawn with straight paths (`layout`).
"""

from __future__ import annotations

import math

from ssh_abduction.data.maps import DState, MapPath, SSHMap, checked_map
from ssh_abduction.data.trace import Trace
from ssh_abduction.output.drawing import (
    COLOURS,
    RADIUS,
    Point,
    at,
    circle,
    colour_of,
    element,
    fault_mark,
    faults_in_words,
    floor_marks,
    line,
    link_names,
    page,
    placed,
    svg_text,
    titled,
)
from ssh_abduction.output.headings import Turns, degrees_of
from ssh_abduction.output.layout import Layout, drawable_poses, layout, travelled, untravelled
from ssh_abduction.output.metric_picture import metric_svg
from ssh_abduction.output.region_marks import place_title, region_marks

# Distances in units of the page. SPACING is between neighbouring places. DSTATE is from the centre
# of a place to the name of a dstate, and NAME to the name that a person gave it. LANE is from the
# line of a path to the marks of its dstates.
SPACING, DSTATE, LANE, NAME = 130.0, 38.0, 9.0, 22.0
# The largest number of characters of a view below a dstate. A longer view is cut at the beginning,
# because long names often begin alike.
LONGEST_LABEL = 20


def to_svg(ssh_map: SSHMap, turns: Trace | Turns | None = None) -> str:
    """Draw a map as SVG text: to scale if it has poses, else with straight paths.

    Args:
        ssh_map: The map.
        turns: How actions turn, for a map without poses: the trace that was mapped; or a dict from
            the name of an action to "right", "left", "around" or degrees clockwise. Actions that
            are themselves named right, left or around need no entry.

    Raises:
        MapError: `ssh_map` is not a map, or `turns` has a value that is no turn.
    """
    checked_map(ssh_map)
    degrees_of(turns)
    if (poses := drawable_poses(ssh_map)) is not None:
        return metric_svg(ssh_map, poses)
    found = layout(ssh_map, turns)
    marks, points = (_topological if ssh_map.places else _causal)(ssh_map, found)
    floors, named = floor_marks(ssh_map, [_on_page(x, y) for x, y, _ in found.dstates])
    return page([*floors, *marks], [*points, *named])


def _on_page(x: float, y: float) -> Point:
    return x * SPACING + 0.0, -y * SPACING + 0.0  # + 0.0 turns -0.0 into 0.0


def _topological(ssh_map: SSHMap, found: Layout) -> tuple[list[str], list[Point]]:
    """Draw a map with places. Return the marks, and the points that the page has to include."""
    spots = {place: _on_page(*spot) for place, spot in found.places.items()}
    lines: list[str] = []
    marks: list[str] = []
    for path in ssh_map.paths:
        lines += _path(ssh_map, path, spots)
        marks += _path_name(ssh_map, path, spots)
    for place, (x, y) in spots.items():
        number = svg_text(x, y, str(place), "#222", size=15, weight="bold")
        dot = circle(x, y, RADIUS, "white", "#222")
        marks.append(titled(place_title(ssh_map, place), dot, number))
        if (name := ssh_map.name_of("place", place)) is not None:
            marks.append(svg_text(x, y + NAME, name, "#222", size=12, weight="bold"))
        marks += _dstates(ssh_map, place, (x, y), found)
    bands, points = region_marks(ssh_map, spots, 3 * RADIUS)
    return bands + lines + marks, [*spots.values(), *points]


def _path(ssh_map: SSHMap, path: MapPath, spots: dict[int, Point]) -> list[str]:
    """Draw a path: broad lines where the robot travelled, dotted ones between other neighbours."""
    colour, streets = colour_of(path.id), travelled(ssh_map, path)
    dotted = {"stroke_width": 2, "stroke_dasharray": "2 6", "opacity": 0.7}
    broad = {"stroke_width": 9, "stroke_linecap": "round", "opacity": 0.55}
    return [
        element("path", d=line(spots[p], spots[q]), stroke=colour, **style)
        for pairs, style in ((untravelled(ssh_map, path), dotted), (streets, broad))
        for p, q in pairs
    ]


def _path_name(ssh_map: SSHMap, path: MapPath, spots: dict[int, Point]) -> list[str]:
    """Draw the name of a path beside its first street, and there an arrow in direction +1."""
    if len(path.order) < 2:
        return []
    index = {place: i for i, place in enumerate(path.order)}
    p, q, *_ = min(
        (sorted(ends, key=lambda p: index.get(p, 0)) for ends in travelled(ssh_map, path)),
        key=lambda ends: index.get(ends[0], 0),
        default=path.order,
    )
    (ax, ay), (bx, by) = a, b = spots[p], spots[q]
    mx, my, angle = (ax + bx) / 2, (ay + by) / 2, math.degrees(math.atan2(by - ay, bx - ax))
    far = 26 / (math.dist(a, b) or 1.0)
    colour, name = colour_of(path.id), ssh_map.called("path", path.id)
    return [
        element("path", d="M-7,-6 L7,0 L-7,6 Z", fill=colour, transform=placed((mx, my), angle)),
        svg_text(mx - (by - ay) * far, my + (bx - ax) * far, name, colour, halo=True),
    ]


def _dstates(ssh_map: SSHMap, place: int, spot: Point, found: Layout) -> list[str]:
    """Draw each dstate on the side of its place that it faces, or where there is most room."""
    x, y = spot
    taken: list[float] = []
    marks = []
    faults = faults_in_words(ssh_map)
    facing: list[tuple[DState, float | None]] = [
        (s, found.dstates[s.id][2]) for s in ssh_map.dstates if s.place == place
    ]
    for s, heading in sorted(facing, key=lambda pair: pair[1] is None):
        bearing = _freest(taken) if heading is None else -heading
        taken.append(bearing)
        dx, dy = math.cos(bearing), math.sin(bearing)
        # Draw the arrow to the right of the line of the path.
        aside = (0.0, 0.0) if s.path is None else (-dy * LANE, dx * LANE)
        colour = "#555" if s.path is None else colour_of(s.path)
        tip = x + dx * (RADIUS + 6) + aside[0], y + dy * (RADIUS + 6) + aside[1]
        turned = placed(tip, math.degrees(bearing))
        arrow = element("path", d="M-5,-5 L5,0 L-5,5 Z", fill=colour, transform=turned)
        marks.append(titled(f"dstate {s.id}: {s.shown}", arrow))
        lx, ly = x + dx * DSTATE + aside[0] * 1.5, y + dy * DSTATE + aside[1] * 1.5
        marks.append(svg_text(lx, ly, f"x{s.id}", "#222", halo=True))
        if s.id in faults:
            marks.append(fault_mark(lx + dx * 14, ly + dy * 14, faults[s.id]))
    return marks


def _freest(taken: list[float]) -> float:
    """Choose the one of 16 bearings that is farthest from those taken, in radians."""

    def room(bearing: float) -> float:
        return min((abs(math.remainder(bearing - t, math.tau)) for t in taken), default=0.0)

    return max((k * math.pi / 8 for k in range(16)), key=room)


def _causal(ssh_map: SSHMap, found: Layout) -> tuple[list[str], list[Point]]:
    """Draw dstates, and links as arrows; return the marks, and points to include."""
    spots = [_on_page(x, y) for x, y, _ in found.dstates]
    faults = faults_in_words(ssh_map)
    marks = []
    for (source, target), names in link_names(ssh_map).items():
        (ax, ay), (bx, by) = spots[source], spots[target]
        far = math.hypot(bx - ax, by - ay) or 1.0
        ux, uy = (bx - ax) / far, (by - ay) / far
        # Bend the curve to the left of the straight line, so that opposite links do not overlap.
        mx, my = (ax + bx) / 2 - uy * 24, (ay + by) / 2 + ux * 24
        end = bx - ux * (RADIUS + 4), by - uy * (RADIUS + 4)
        curve = f"M{at((ax, ay))} Q{at((mx, my))} {at(end)}"
        marks.append(element("path", d=curve, fill="none", stroke="#888", stroke_width=1.5))
        head = placed(end, math.degrees(math.atan2(end[1] - my, end[0] - mx)))
        marks.append(element("path", d="M-8,-4 L0,0 L-8,4 Z", fill="#888", transform=head))
        marks.append(svg_text(mx - ux * 12, my - uy * 12, names, "#555", halo=True))
    for s in ssh_map.dstates:
        x, y = spots[s.id]
        marks.append(circle(x, y, RADIUS, "white", COLOURS[0]))
        marks.append(svg_text(x, y, f"x{s.id}", "#222", weight="bold"))
        view = str(s.shown)
        label = view if len(view) <= LONGEST_LABEL else f"…{view[1 - LONGEST_LABEL :]}"
        below = svg_text(x, y + RADIUS + 12, label, "#222", halo=True)
        marks.append(titled(f"dstate {s.id}: {view}", below))
        if s.id in faults:
            marks.append(fault_mark(x + RADIUS, y - RADIUS, faults[s.id]))
    return marks, spots
