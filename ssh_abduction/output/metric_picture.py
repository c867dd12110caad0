"""Draw a map with poses as an SVG picture, to scale. The first dstate faces right on the page.

A dstate (distinctive state) is a place and a heading. Around each place, an ellipse of two
standard deviations shows how uncertain its position relative to the first dstate is. Labels without
room are left out. Browsers show the same text as a title when the pointer is on a dstate's arrow.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from statistics import median

from ssh_abduction.data.groups import gathered
from ssh_abduction.data.maps import DState, Pose, SSHMap
from ssh_abduction.output.drawing import (
    COLOURS,
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
from ssh_abduction.output.layout import travelled, untravelled
from ssh_abduction.output.region_marks import place_title, region_marks

# In units of the page. NEAREST is the distance of the two nearest places, if the limits allow it.
# APART limits the median distance of a place from the nearest one, LARGEST the size of the map.
NEAREST, APART, LARGEST = 110.0, 240.0, 1600.0
# In units of the page, if there is room: the radius of the dot of a place, and the distances from
# its centre at which the arrow of a dstate begins and ends.
DOT, BEGIN, END = 4.5, 8.0, 27.0
MARGIN = 24.0
SMALLEST = 0.6  # the least factor for the size of marks, if places are near each other
WIDEST = LARGEST / 4  # the largest half axis of an ellipse; a larger one would fill the page
DEVIATIONS = 2.0  # the half axes of ellipses, in standard deviations
# In a map without places, dstates nearer than this share of the longest link are drawn as if the
# robot only turned between them.
TURNS = 0.1


def metric_svg(ssh_map: SSHMap, poses: Sequence[Pose]) -> str:
    """Draw a map as SVG text, with each dstate at its pose."""
    return _Picture.of(ssh_map, poses).svg()


@dataclass
class _Picture:
    """The page while it is drawn.

    Points of the page have x to the right and y down. Sites are those of `DState.site`.
    """

    map: SSHMap
    poses: Sequence[Pose]  # the pose of each dstate
    scale: float  # units of the page for each metre
    # A factor for the size of all marks, at most 1. It is smaller if there is little room.
    unit: float
    points: list[Point] = field(default_factory=list)  # points that the page has to include
    # Boxes (left, top, right, bottom) that labels must not overlap.
    boxes: list[tuple[float, float, float, float]] = field(default_factory=list)

    @classmethod
    def of(cls, ssh_map: SSHMap, poses: Sequence[Pose]) -> _Picture:
        """Make an empty page of the right scale for a map."""
        nearest = NEAREST if ssh_map.places else 1.4 * NEAREST
        return cls(ssh_map, poses, *_scale(_spots(ssh_map, poses), nearest))

    def svg(self) -> str:
        """Draw the map, and return the text of an SVG file."""
        sites = _sites(self.map)
        spots = {site: self.on_page(self.poses[members[0].id]) for site, members in sites.items()}
        dot = DOT * self.unit
        for x, y in spots.values():
            self.keep_clear(x - dot, y - dot, x + dot, y + dot)
        ellipses = [
            mark
            for site, members in sites.items()
            for mark in self.ellipse(spots[site], self.poses[members[0].id].spread)
        ]
        arrows = [self.arrow(s) for s in self.map.dstates]
        lines = self.links() if not self.map.places else self.paths(spots) or self.edges(spots)
        bands, around = region_marks(self.map, spots, 2 * END * self.unit)
        self.points += around
        # Draw the first place last, on top of the others.
        first = self.map.dstates[self.map.dstate_at[0]].site
        dots = [
            self.dot(*spots[site], site) for site in sorted(spots, key=lambda site: site == first)
        ]
        labels = self.place_labels(spots) + self.dstate_labels()
        labels += self.path_labels(spots) if self.map.places else self.link_labels()
        floors, named = floor_marks(self.map, [self.on_page(pose) for pose in self.poses])
        self.points += named
        faults = [
            fault_mark(*self.along(self.map.dstates[s], END), said, self.unit)
            for s, said in faults_in_words(self.map).items()
        ]
        marks = bands + lines + ellipses + arrows + dots + labels + floors + faults
        return page([*marks, *self.scale_bar()], self.points, MARGIN)

    def on_page(self, pose: Pose) -> Point:
        """Convert the position of a pose to a point of the page."""
        return pose.x * self.scale, -pose.y * self.scale

    def along(self, s: DState, ahead: float, left: float = 0.0) -> Point:
        """The point `ahead` and `left` of a dstate, in units of the page times `unit`."""
        pose, u = self.poses[s.id], self.unit
        x, y = self.on_page(pose)
        cos, sin = math.cos(pose.heading) * u, math.sin(pose.heading) * u
        return x + ahead * cos - left * sin, y - ahead * sin - left * cos

    def keep_clear(self, left: float, top: float, right: float, bottom: float) -> None:
        """Keep labels from overlapping this box."""
        self.boxes.append((left, top, right, bottom))
        self.points += [(left, top), (right, bottom)]

    def dot(self, x: float, y: float, site: int) -> str:
        """Draw the dot of a site at a point. The robot's first site is white, others are black."""
        is_first = site == self.map.dstates[self.map.dstate_at[0]].site
        fill, width = "white" if is_first else "#222", f"{1.8 * self.unit:.1f}"
        title = place_title(self.map, site) if site >= 0 else f"dstate {-1 - site}"
        return titled(title, circle(x, y, DOT * self.unit, fill, "#222", width))

    def ellipse(self, spot: Point, spread: tuple[float, float, float]) -> list[str]:
        """Draw the ellipse of a covariance (xx, xy, yy) in m²; nothing if too small or large."""
        (major, minor), angle = axes(spread)
        rx, ry = DEVIATIONS * major * self.scale, DEVIATIONS * minor * self.scale
        if rx < 0.5 or rx > WIDEST:
            return []
        across = math.hypot(rx * math.cos(angle), ry * math.sin(angle))
        upright = math.hypot(rx * math.sin(angle), ry * math.cos(angle))
        x, y = spot
        self.points += [(x - across, y - upright), (x + across, y + upright)]
        shape = {"cx": f"{x:.1f}", "cy": f"{y:.1f}", "rx": f"{rx:.2f}", "ry": f"{ry:.2f}"}
        turned = f"rotate({-math.degrees(angle):.2f} {x:.1f} {y:.1f})"
        style = {"fill": "#000", "fill_opacity": 0.04, "stroke": "#777", "stroke_width": 1}
        return [element("ellipse", **shape, transform=turned, **style, stroke_dasharray="4 3")]

    def arrow(self, s: DState) -> str:
        """Draw the arrow of a dstate along its heading. That of the first dstate is black."""
        pose, colour = self.poses[s.id], "#000" if s.id == self.map.dstate_at[0] else _colour(s)
        u = self.unit
        (ax, ay), (bx, by) = self.along(s, BEGIN), self.along(s, END)
        for share in (0.0, 0.5, 1.0):
            x, y = ax + (bx - ax) * share, ay + (by - ay) * share
            self.keep_clear(x - 4 * u, y - 4 * u, x + 4 * u, y + 4 * u)
        degrees = math.degrees(pose.heading)
        shaft = f"M{BEGIN * u:.1f},0 H{END * u - 6 * u:.1f}"
        head = f"M{END * u:.1f},0 l{-9 * u:.1f},{-5 * u:.1f} v{10 * u:.1f} Z"
        style = {"fill": colour, "stroke": colour, "stroke_width": f"{2.2 * u:.1f}"}
        turned = placed(self.on_page(pose), -degrees)
        style |= {"stroke_linejoin": "round", "transform": turned}
        mark = element("path", d=f"{shaft} {head}", **style)
        where = f"at {pose.x:.1f}, {pose.y:.1f} m, heading {degrees:.0f}°"
        return titled(f"dstate {s.id}: {s.shown}, {where}", mark)

    def paths(self, spots: Mapping[int, Point]) -> list[str]:
        """Draw paths: broad lines where the robot travelled, dotted ones between other neighbours.

        In the world, a dotted part of a path need not be straight. The order of places may be one
        of several that fit, as the robot may have passed places without noticing them.
        """
        orders, travels, u = [], [], self.unit
        for path in self.map.paths:
            colour = colour_of(path.id)
            for p, q in untravelled(self.map, path):
                dotted = {"stroke_dasharray": "2 5", "opacity": 0.7}
                orders.append(_line(spots[p], spots[q], colour, 2 * u, **dotted))
            for p, q in travelled(self.map, path):
                travels.append(self.broad(spots[p], spots[q], colour))
        return orders + travels

    def edges(self, spots: Mapping[int, Point]) -> list[str]:
        """Draw a line between two places if an action leads from one to the other."""
        pairs = {
            tuple(sorted(self.map.dstates[s].site for s in ends)) for ends in link_names(self.map)
        }
        return [self.broad(spots[p], spots[q], COLOURS[0]) for p, q in sorted(pairs) if p != q]

    def broad(self, start: Point, end: Point, colour: str) -> str:
        """Draw a broad line where the robot travelled."""
        return _line(start, end, colour, 8 * self.unit, stroke_linecap="round", opacity=0.4)

    def curves(self) -> list[tuple[Point, Point, Point, str]]:
        """Find the curve (start, bend, end, actions) of each link, for a map without places."""
        curves = []
        for (source, target), names in link_names(self.map).items():
            a, b = self.map.dstates[source], self.map.dstates[target]
            x, y = self.on_page(self.poses[source])
            turned = math.dist((x, y), self.on_page(self.poses[target])) < 2 * END * self.unit
            start, end = self.along(a, END + 2), self.along(b, END + 2 if turned else -BEGIN)
            bend = math.dist(start, end) * (0.35 if turned else 0.08)
            mx, my = (start[0] + end[0]) / 2, (start[1] + end[1]) / 2
            # Bend a turn away from the dstate, and two opposite links away from each other.
            away = (mx - x, my - y) if turned else (start[1] - end[1], end[0] - start[0])
            far = math.hypot(*away) or 1.0
            middle = (mx + away[0] / far * bend, my + away[1] / far * bend)
            curves.append((start, middle, end, names))
        return curves

    def links(self) -> list[str]:
        """Draw the links of a map without places as arrows."""
        marks = []
        for start, bend, end, _ in self.curves():
            u = self.unit
            self.points += [bend, start, end]
            curve = f"M{at(start)} Q{at(bend)} {at(end)}"
            width = f"{1.4 * u:.1f}"
            marks.append(element("path", d=curve, fill="none", stroke="#999", stroke_width=width))
            head = f"M0,0 l{-8 * u:.1f},{-3.5 * u:.1f} v{7 * u:.1f} Z"
            turned = placed(end, math.degrees(math.atan2(end[1] - bend[1], end[0] - bend[0])))
            marks.append(element("path", d=head, fill="#999", transform=turned))
        return marks

    def label(
        self,
        label: str,
        spots: Sequence[Point],
        colour: str,
        size: float,
        weight: str = "normal",
        *,
        always: bool = False,
    ) -> list[str]:
        """Draw a label at the first point where it overlaps nothing, if there is one.

        Otherwise, draw it at the last point if it must be drawn `always`.
        """
        w, h = self.half(label, size)
        for x, y in spots:
            if (always and (x, y) == spots[-1]) or all(
                x + w <= left or right <= x - w or y + h <= top or bottom <= y - h
                for left, top, right, bottom in self.boxes
            ):
                self.keep_clear(x - w, y - h, x + w, y + h)
                return [svg_text(x, y, label, colour, self.size(size), weight, halo=True)]
        return []

    def size(self, size: float) -> float:
        """Reduce a font size if there is little room, but not below 9."""
        return max(size * self.unit, 9.0)

    def half(self, label: str, size: float) -> tuple[float, float]:
        """Estimate half the width and half the height of a label, in units of the page."""
        return 0.31 * self.size(size) * len(label) + 1, 0.55 * self.size(size)

    def place_labels(self, spots: Mapping[int, Point]) -> list[str]:
        """Draw the numbers of places beside their dots, where there is room, and names always."""
        marks = []
        bearings = [k * math.pi / 4 for k in (-1, 1, 3, 5, 0, 2, 4, 6)]
        ways = [(far * self.unit, bearing) for far in (17, 22, 30) for bearing in bearings]
        for place in self.map.places:
            x, y = spots[place]
            name = self.map.name_of("place", place)
            label = str(place) if name is None else f"{place} {name}"
            wide = 0.0 if name is None else self.half(f" {name}", 15)[0]
            around = [
                (x + (far + wide) * math.cos(angle), y + far * math.sin(angle))
                for far, angle in ways
            ]
            marks += self.label(label, around, "#000", 15, "bold", always=name is not None)
        return marks

    def dstate_labels(self) -> list[str]:
        """Draw the numbers of dstates beside or ahead of their arrows, the first dstate first."""
        marks = []
        u = self.unit
        for s in sorted(self.map.dstates, key=lambda s: s.id != self.map.dstate_at[0]):
            is_first = s.id == self.map.dstate_at[0]
            label = f"x{s.id} start" if is_first else f"x{s.id}"
            w, h = self.half(label, 11)
            heading = self.poses[s.id].heading
            sin, cos = abs(math.sin(heading)), abs(math.cos(heading))
            aside, beyond = 4.5 + (w * sin + h * cos) / u, END + 5 + (w * cos + h * sin) / u
            sides = [(far, side * aside) for far in (20.0, 27.0, 34.0) for side in (-1, 1)]
            ahead = [(beyond, side * h / u) for side in (0, -1, 1)]
            order = sides + ahead if self.map.places else ahead + sides
            spots = [self.along(s, *spot) for spot in order]
            style = ("#000", 11, "bold") if is_first else ("#444", 11, "normal")
            marks += self.label(label, spots, *style)
        return marks

    def path_labels(self, spots: Mapping[int, Point]) -> list[str]:
        """Draw the names of paths beside their longest travelled streets, where there is room."""
        marks = []
        for path in self.map.paths:
            streets = sorted(
                ((spots[p], spots[q]) for p, q in travelled(self.map, path)),
                key=lambda ends: -math.dist(*ends),
            )
            beside = []
            for (ax, ay), (bx, by) in streets:
                far = math.dist((ax, ay), (bx, by)) or 1.0
                ux, uy = (bx - ax) / far, (by - ay) / far
                for share in (0.5, 0.6, 0.4):
                    x, y = ax + (bx - ax) * share, ay + (by - ay) * share
                    for side in (1, -1):
                        away = side * (12 + 18 * abs(uy)) * self.unit
                        beside.append((x - uy * away, y + ux * away))
            name, colour = self.map.called("path", path.id), colour_of(path.id)
            marks += self.label(name, beside, colour, 12)
        return marks

    def link_labels(self) -> list[str]:
        """Draw the actions of links at the middle of their curves, where there is room."""
        marks = []
        for (ax, ay), (mx, my), (bx, by), names in self.curves():
            middle = (ax + 2 * mx + bx) / 4, (ay + 2 * my + by) / 4
            marks += self.label(names, [middle], "#777", 10)
        return marks

    def scale_bar(self) -> list[str]:
        """Draw a scale bar of 1, 2 or 5 times a power of ten metres, below the map on the left."""
        left, below = min(x for x, _ in self.points), max(y for _, y in self.points) + 24
        metres = _round_length(120 / self.scale)
        right = left + metres * self.scale
        self.points += [(left, below - 6), (max(right, left + 60), below + 20)]
        bar = f"M{left:.1f},{below - 5:.1f} v10 m0,-5 H{right:.1f} m0,-5 v10"
        return [
            element("path", d=bar, fill="none", stroke="#222", stroke_width=1.5),
            svg_text((left + right) / 2, below + 14, f"{metres:g} m", "#222"),
        ]


def axes(spread: tuple[float, float, float]) -> tuple[tuple[float, float], float]:
    """Find the principal axes of a covariance (xx, xy, yy).

    Return the standard deviations along both axes, the larger one first, and the angle of the
    first axis in radians counterclockwise from x.
    """
    xx, xy, yy = spread
    mean, half = (xx + yy) / 2, math.hypot((xx - yy) / 2, xy)
    angle = math.atan2(2 * xy, xx - yy) / 2
    return (math.sqrt(max(0.0, mean + half)), math.sqrt(max(0.0, mean - half))), angle


def _line(a: Point, b: Point, colour: str, width: float, **style: object) -> str:
    return element("path", d=line(a, b), stroke=colour, stroke_width=f"{width:.1f}", **style)


def _sites(ssh_map: SSHMap) -> dict[int, list[DState]]:
    return gathered((s.site, s) for s in ssh_map.dstates)


def _colour(s: DState) -> str:
    if s.path is not None:
        return colour_of(s.path)
    return COLOURS[0] if s.place is None else "#555"


def _spots(ssh_map: SSHMap, poses: Sequence[Pose]) -> list[Point]:
    """Find the positions of places, or else of dstates that are not near an earlier one."""
    spots = [
        (poses[members[0].id].x, poses[members[0].id].y) for members in _sites(ssh_map).values()
    ]
    if ssh_map.places:
        return spots
    near = TURNS * max((math.dist(spots[s], spots[x]) for s, _, x in ssh_map.links), default=0.0)
    apart: list[Point] = []
    for spot in spots:
        if all(math.dist(spot, other) > near for other in apart):
            apart.append(spot)
    return apart


def _scale(spots: Sequence[Point], nearest: float) -> tuple[float, float]:
    """The units of the page for each metre, and the factor for the size of marks, at most 1.

    The two nearest places are `nearest` units apart. The scale is smaller if neighbours would
    usually be more than APART units apart, or the map larger than LARGEST units.
    """
    extent = max((max(numbers) - min(numbers) for numbers in zip(*spots, strict=True)), default=0.0)
    if extent < 1e-3:  # one place, or all in one spot
        return nearest, 1.0
    gaps = [
        min(math.dist(spot, other) for other in [*spots[:i], *spots[i + 1 :]])
        for i, spot in enumerate(spots)
    ]
    usual = max(median(gaps), extent / LARGEST)
    scale = min(nearest / max(min(gaps), 1e-9), APART / usual, LARGEST / extent)
    return scale, min(1.0, max(SMALLEST, usual * scale / NEAREST))


def _round_length(metres: float) -> float:
    """Round down to a number of the series …, 0.1, 0.2, 0.5, 1, 2, 5, 10, …"""
    ten = 10.0 ** math.floor(math.log10(metres))
    return max(ten * k for k in (1, 2, 5) if ten * k <= metres * (1 + 1e-9))
