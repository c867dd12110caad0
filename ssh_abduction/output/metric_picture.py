"""A map drawn where its dstates are, in metres. The first dstate faces right on the page.

Round each place is an ellipse of uncertainty, of two standard deviations, as seen from the first dstate. Labels that would lie on other labels or on arrows are left
out where no room is found for them; what they say is also in the title of the arrow, which browsers show under the pointer.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from statistics import median
from typing import TYPE_CHECKING

from ssh_abduction.output.drawing import COLOURS, Point, escaped, fault_mark, page, text
from ssh_abduction.output.layout import travelled

if TYPE_CHECKING:
    from ssh_abduction.data.maps import DState, Pose, SSHMap

# In units of the page: the two nearest places are drawn this far apart, unless the other limits forbid it; places are at most so far from their nearest, as a rule;
# and the whole map is at most so large.
NEAREST, APART, LARGEST = 110.0, 240.0, 1600.0
# In units of the page, where there is room: the radius of the dot of a place, and how far from its middle the arrow of a dstate begins and ends.
DOT, BEGIN, END = 4.5, 8.0, 27.0
MARGIN = 24.0
SMALLEST = 0.6  # where places are near each other all marks are smaller, down to this share
WIDEST = (
    LARGEST / 4
)  # half axes of ellipses that are longer are not drawn: the page would hold little else
DEVIATIONS = 2.0  # the half axes of ellipses, in standard deviations
TURNS = 0.1  # dstates of a causal map that are nearer than this share of its longest link are drawn as if the robot only turned between them


def metric_svg(ssh_map: SSHMap, poses: Sequence[Pose]) -> str:
    """The map as SVG text, with each dstate at its pose."""
    return _Picture.of(ssh_map, poses).svg()


@dataclass
class _Picture:
    """The page while it is drawn.

    scale   units of the page a metre
    unit    the size of marks, as a share of the size where there is room
    points  what the page has to hold
    boxes   what labels keep clear of, as (left, top, right, bottom)
    """

    map: SSHMap
    poses: Sequence[Pose]
    scale: float
    unit: float
    points: list[Point] = field(default_factory=list)
    boxes: list[tuple[float, float, float, float]] = field(default_factory=list)

    @classmethod
    def of(cls, ssh_map: SSHMap, poses: Sequence[Pose]) -> _Picture:
        return cls(
            ssh_map,
            poses,
            *_scale(_spots(ssh_map, poses), NEAREST if ssh_map.places else 1.4 * NEAREST),
        )

    def svg(self) -> str:
        sites = _sites(self.map)
        at = {site: self.on_page(self.poses[members[0].id]) for site, members in sites.items()}
        for x, y in at.values():
            self.keep_clear(
                x - DOT * self.unit, y - DOT * self.unit, x + DOT * self.unit, y + DOT * self.unit
            )
        ellipses = [
            mark
            for site, members in sites.items()
            for mark in self.ellipse(at[site], self.poses[members[0].id].spread)
        ]
        arrows = [self.arrow(s) for s in self.map.dstates]
        lines = self.paths(at) if self.map.places else self.links()
        first = _site(self.map.dstates[self.map.labels[0]])
        dots = [self.dot(*at[site], site) for site in sorted(at, key=lambda site: site == first)]
        labels = (
            self.place_labels(at)
            + self.dstate_labels()
            + (self.path_labels(at) if self.map.places else self.link_labels())
        )
        return page(
            [*lines, *ellipses, *arrows, *dots, *labels, *self.faults(), *self.scale_bar()],
            self.points,
            MARGIN,
        )

    def on_page(self, pose: Pose) -> Point:
        return pose.x * self.scale, -pose.y * self.scale

    def keep_clear(self, left: float, top: float, right: float, bottom: float) -> None:
        self.boxes.append((left, top, right, bottom))
        self.points += [(left, top), (right, bottom)]

    def dot(self, x: float, y: float, site: int) -> str:
        first = self.map.dstates[self.map.labels[0]]
        colour = "white" if site == _site(first) else "#222"
        title = f"place {site}" if site >= 0 else f"dstate {-1 - site}"
        return (
            f'<g><title>{title}</title><circle cx="{x:.1f}" cy="{y:.1f}" r="{DOT * self.unit:.1f}" fill="{colour}" '
            f'stroke="#222" stroke-width="{1.8 * self.unit:.1f}"/></g>'
        )

    def ellipse(self, at: Point, spread: tuple[float, float, float]) -> list[str]:
        """Two standard deviations round a place, unless they are very large, as where hardly anything is known."""
        (major, minor), angle = axes(spread)
        rx, ry = DEVIATIONS * major * self.scale, DEVIATIONS * minor * self.scale
        if rx < 0.5 or rx > WIDEST:
            return []
        across = math.hypot(rx * math.cos(angle), ry * math.sin(angle))
        upright = math.hypot(rx * math.sin(angle), ry * math.cos(angle))
        self.points += [(at[0] - across, at[1] - upright), (at[0] + across, at[1] + upright)]
        return [
            f'<ellipse cx="{at[0]:.1f}" cy="{at[1]:.1f}" rx="{rx:.2f}" ry="{ry:.2f}" transform="rotate({-math.degrees(angle):.2f} {at[0]:.1f} {at[1]:.1f})" '
            f'fill="#000" fill-opacity="0.04" stroke="#777" stroke-width="1" stroke-dasharray="4 3"/>'
        ]

    def arrow(self, s: DState) -> str:
        """A dstate: an arrow from its place in the direction of its heading. The first dstate is black."""
        pose, colour = self.poses[s.id], "#000" if s.id == self.map.labels[0] else _colour(s)
        (ax, ay), (bx, by) = self.along(s, BEGIN), self.along(s, END)
        u = self.unit
        title = f"dstate {s.id}: {s.shown}, at {pose.x:.1f}, {pose.y:.1f} m, heading {math.degrees(pose.heading):.0f}°"
        for share in (0.0, 0.5, 1.0):
            x, y = ax + (bx - ax) * share, ay + (by - ay) * share
            self.keep_clear(x - 4 * u, y - 4 * u, x + 4 * u, y + 4 * u)
        return (
            f'<g><title>{escaped(title)}</title><path d="M{BEGIN * u:.1f},0 H{END * u - 6 * u:.1f} M{END * u:.1f},0 l{-9 * u:.1f},{-5 * u:.1f} v{10 * u:.1f} Z" fill="{colour}" '
            f'stroke="{colour}" stroke-width="{2.2 * u:.1f}" stroke-linejoin="round" '
            f'transform="translate({pose.x * self.scale:.1f},{-pose.y * self.scale:.1f}) rotate({-math.degrees(pose.heading):.1f})"/></g>'
        )

    def faults(self) -> list[str]:
        """What the map disbelieves, at the ends of the arrows of the dstates where it does."""
        faults: dict[int, list[str]] = {}
        for fault in self.map.faults:
            faults.setdefault(self.map.labels[fault.step], []).append(str(fault))
        return [
            fault_mark(*self.along(self.map.dstates[s], END), "; ".join(said), self.unit)
            for s, said in faults.items()
        ]

    def along(self, s: DState, far: float, aside: float = 0.0) -> Point:
        """A point so far ahead of a dstate, and so far to its left."""
        pose, u = self.poses[s.id], self.unit
        x, y = self.on_page(pose)
        cos, sin = math.cos(pose.heading) * u, math.sin(pose.heading) * u
        return x + far * cos - aside * sin, y - far * sin - aside * cos

    def paths(self, at: Mapping[int, Point]) -> list[str]:
        """Paths through their places in order: broad where the robot travelled, and dotted where only the order of the places leads.

        The order is a witness. A robot that does not know which places lie between two others may travel past some of them, so dotted lines need not be straight.
        """
        orders, travels = [], []
        for path in self.map.paths:
            colour, u, streets = (
                COLOURS[path.id % len(COLOURS)],
                self.unit,
                travelled(self.map, path),
            )
            for p, q in pairwise(path.order):
                if (min(p, q), max(p, q)) not in streets:
                    orders.append(
                        f'<path d="{_line(at[p], at[q])}" stroke="{colour}" stroke-width="{2 * u:.1f}" stroke-dasharray="2 5" opacity="0.7"/>'
                    )
            for p, q in streets:
                travels.append(
                    f'<path d="{_line(at[p], at[q])}" stroke="{colour}" stroke-width="{8 * u:.1f}" stroke-linecap="round" opacity="0.4"/>'
                )
        return orders + travels

    def curves(self) -> list[tuple[Point, Point, Point, str]]:
        """The links of a causal map: where each begins, bends and ends, and the actions."""
        actions: dict[tuple[int, int], list[str]] = {}
        for source, action, target in self.map.links:
            if source != target:
                actions.setdefault((source, target), []).append(action)
        curves = []
        for (source, target), names in actions.items():
            a, b = self.map.dstates[source], self.map.dstates[target]
            turned = (
                math.dist(self.on_page(self.poses[source]), self.on_page(self.poses[target]))
                < 2 * END * self.unit
            )
            start, end = self.along(a, END + 2), self.along(b, END + 2 if turned else -BEGIN)
            bend = math.dist(start, end) * (0.35 if turned else 0.08)
            mx, my = (start[0] + end[0]) / 2, (start[1] + end[1]) / 2
            if turned:  # away from where the robot turns
                x, y = self.on_page(self.poses[source])
                away = (mx - x, my - y)
            else:  # links to and fro are beside each other
                away = (start[1] - end[1], end[0] - start[0])
            far = math.hypot(*away) or 1.0
            curves.append(
                (
                    start,
                    (mx + away[0] / far * bend, my + away[1] / far * bend),
                    end,
                    ", ".join(names),
                )
            )
        return curves

    def links(self) -> list[str]:
        marks = []
        for (ax, ay), (mx, my), (bx, by), _ in self.curves():
            u, angle = self.unit, math.degrees(math.atan2(by - my, bx - mx))
            self.points += [(mx, my), (ax, ay), (bx, by)]
            marks.append(
                f'<path d="M{ax:.1f},{ay:.1f} Q{mx:.1f},{my:.1f} {bx:.1f},{by:.1f}" fill="none" stroke="#999" stroke-width="{1.4 * u:.1f}"/>'
            )
            marks.append(
                f'<path d="M0,0 l{-8 * u:.1f},{-3.5 * u:.1f} v{7 * u:.1f} Z" fill="#999" transform="translate({bx:.1f},{by:.1f}) rotate({angle:.1f})"/>'
            )
        return marks

    def label(
        self, label: str, spots: Iterable[Point], colour: str, size: float, weight: str = "normal"
    ) -> list[str]:
        """A label at the first of these spots that is clear, if any is."""
        w, h = self.half(label, size)
        for x, y in spots:
            if all(
                x + w <= left or right <= x - w or y + h <= top or bottom <= y - h
                for left, top, right, bottom in self.boxes
            ):
                self.keep_clear(x - w, y - h, x + w, y + h)
                return [text(x, y, label, colour, size=self.size(size), weight=weight, halo=True)]
        return []

    def size(self, size: float) -> float:
        """The size of text that is of this size where there is room."""
        return max(size * self.unit, 9.0)

    def half(self, label: str, size: float) -> tuple[float, float]:
        """Half the width and half the height of a label."""
        return 0.31 * self.size(size) * len(label) + 1, 0.55 * self.size(size)

    def place_labels(self, at: Mapping[int, Point]) -> list[str]:
        marks = []
        for place in self.map.places:
            x, y = at[place]
            spots = [
                (
                    x + far * self.unit * math.cos(k * math.pi / 4),
                    y + far * self.unit * math.sin(k * math.pi / 4),
                )
                for far in (17, 22, 30)
                for k in (-1, 1, 3, 5, 0, 2, 4, 6)
            ]
            marks += self.label(str(place), spots, "#000", 15, "bold")
        return marks

    def dstate_labels(self) -> list[str]:
        marks = []
        for s in sorted(self.map.dstates, key=lambda s: s.id != self.map.labels[0]):
            first = s.id == self.map.labels[0]
            label = f"x{s.id} start" if first else f"x{s.id}"
            w, h = self.half(label, 11)
            sin, cos = (
                abs(math.sin(self.poses[s.id].heading)),
                abs(math.cos(self.poses[s.id].heading)),
            )
            aside, beyond = (
                4.5 + (w * sin + h * cos) / self.unit,
                END + 5 + (w * cos + h * sin) / self.unit,
            )
            sides = [(far, side * aside) for far in (20.0, 27.0, 34.0) for side in (-1, 1)]
            ahead = [(beyond, side * h / self.unit) for side in (0, -1, 1)]
            spots = [
                self.along(s, *spot)
                for spot in (sides + ahead if self.map.places else ahead + sides)
            ]
            marks += self.label(
                label, spots, "#000" if first else "#444", 11, "bold" if first else "normal"
            )
        return marks

    def path_labels(self, at: Mapping[int, Point]) -> list[str]:
        marks = []
        for path in self.map.paths:
            stretches = sorted(
                ((at[p], at[q]) for p, q in travelled(self.map, path)),
                key=lambda ends: -math.dist(*ends),
            )
            spots = []
            for (ax, ay), (bx, by) in stretches:
                far = math.dist((ax, ay), (bx, by)) or 1.0
                ux, uy = (bx - ax) / far, (by - ay) / far
                for share in (0.5, 0.6, 0.4):
                    for side in (1, -1):
                        away = side * (12 + 18 * abs(uy)) * self.unit
                        spots.append(
                            (ax + (bx - ax) * share - uy * away, ay + (by - ay) * share + ux * away)
                        )
            marks += self.label(f"path {path.id}", spots, COLOURS[path.id % len(COLOURS)], 12)
        return marks

    def link_labels(self) -> list[str]:
        return [
            mark
            for start, bend, end, names in self.curves()
            for mark in self.label(
                names,
                [((start[0] + 2 * bend[0] + end[0]) / 4, (start[1] + 2 * bend[1] + end[1]) / 4)],
                "#777",
                10,
            )
        ]

    def scale_bar(self) -> list[str]:
        """A bar of 1, 2 or 5 metres, or tens or tenths of them, below the map on the left."""
        left, below = min(x for x, _ in self.points), max(y for _, y in self.points) + 24
        metres = _round_length(120 / self.scale)
        right = left + metres * self.scale
        self.points += [(left, below - 6), (max(right, left + 60), below + 20)]
        bar = f'<path d="M{left:.1f},{below - 5:.1f} v10 m0,-5 H{right:.1f} m0,-5 v10" fill="none" stroke="#222" stroke-width="1.5"/>'
        return [bar, text((left + right) / 2, below + 14, f"{metres:g} m", "#222")]


def axes(spread: tuple[float, float, float]) -> tuple[tuple[float, float], float]:
    """The standard deviations along the two axes of a covariance, the greater first, and the angle of the first, in radians counterclockwise from x."""
    xx, xy, yy = spread
    mean, half = (xx + yy) / 2, math.hypot((xx - yy) / 2, xy)
    return (math.sqrt(max(0.0, mean + half)), math.sqrt(max(0.0, mean - half))), math.atan2(
        2 * xy, xx - yy
    ) / 2


def _line(a: Point, b: Point) -> str:
    return f"M{a[0]:.1f},{a[1]:.1f} L{b[0]:.1f},{b[1]:.1f}"


def _site(s: DState) -> int:
    """What is drawn as one dot: a place or, without one, a dstate (as a negative number)."""
    return s.place if s.place is not None else -1 - s.id


def _sites(ssh_map: SSHMap) -> dict[int, list[DState]]:
    sites: dict[int, list[DState]] = {}
    for s in ssh_map.dstates:
        sites.setdefault(_site(s), []).append(s)
    return sites


def _colour(s: DState) -> str:
    return (
        (COLOURS[0] if s.place is None else "#555")
        if s.path is None
        else COLOURS[s.path % len(COLOURS)]
    )


def _spots(ssh_map: SSHMap, poses: Sequence[Pose]) -> list[Point]:
    """Where the places are, in metres. Dstates without places that are hardly a link apart count as one."""
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
    """How many units of the page a metre is, and how large marks are, so that the spots are apart and the page is not too large."""
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
    """The largest of 1, 2, 5, 10, 20, 50, … (or 0.1, 0.2, 0.5, …) that is no longer."""
    ten = 10.0 ** math.floor(math.log10(metres))
    return max(ten * k for k in (1, 2, 5) if ten * k <= metres * (1 + 1e-9))
