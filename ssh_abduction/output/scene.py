"""What a picture shows, as a value: marks in the coordinates of the map, with x right and y up.

`drawing` draws any scene, as SVG or with matplotlib. `scene_of` makes the scene of a map: its
places, paths, dstates, links, regions, floors and faults. Sizes of
marks, such as the width of a line, are in units of the page, which are a pixel each.

A dstate (distinctive state) is a place and a heading. A map with poses is drawn to scale, with
ellipses of two standard deviations that show how uncertain positions relative to the first dstate
are. A map without poses is drawn with straight paths (`layout`). A site is a place, or a dstate
that has none: see `DState.site`.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from html import escape
from itertools import pairwise
from statistics import median
from typing import TypeAlias

from ssh_abduction.data.errors import xml_text
from ssh_abduction.data.groups import gathered
from ssh_abduction.data.map_parts import Region, course_named, list_in_words
from ssh_abduction.data.maps import DState, MapPath, SSHMap, checked_map
from ssh_abduction.data.trace import Trace
from ssh_abduction.data.words import noun_of
from ssh_abduction.output.layout import Layout, Turns, layout, neighbours, travelled, untravelled

Point: TypeAlias = tuple[float, float]

# The colours of paths and of drives, in turn. The first six are of the palette of Okabe & Ito,
# which people with colour blindness can distinguish.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7f7f7f", "#8c564b")
ALARM = "#b00020"  # the colour of faults
# In units of the page. SPACING is the distance of neighbours in a map without poses. With poses,
# NEAREST is the distance of the two nearest places, if the limits allow it. APART limits the median
# distance of a place from the nearest one, LARGEST the size of the map.
SPACING, NEAREST, APART, LARGEST = 130.0, 110.0, 240.0, 1600.0
# In units of the page, if there is room: the radius of the dot of a place, and the distances from
# its centre at which the arrow of a dstate begins and ends. RADIUS is that of a dstate whose
# heading is unknown.
DOT, BEGIN, END, RADIUS = 4.5, 8.0, 27.0, 17.0
FLOOR = 52.0  # in the same units, how far the name of a floor is above its dstates
SMALLEST = 0.6  # the least factor for the size of marks, if places are near each other
WIDEST = LARGEST / 4  # the largest half axis of an ellipse; a larger one would fill the page
DEVIATIONS = 2.0  # the half axes of ellipses, in standard deviations
# In a map without places, dstates nearer than this share of the longest link are drawn as if the
# robot only turned between them.
TURNS = 0.1
ASIDE = 3.0  # in units of the page, how far the arrow of a link is from the line of its ends
# The largest number of characters of a view below a dstate. A longer view is cut at the beginning,
# because long names often begin alike.
LONGEST_LABEL = 20
# The colour and the opacity of bands. Each band around another one is wider by WIDER times the
# width of the innermost band.
BAND, OPACITY, WIDER = "#8a6d00", 0.13, 0.5


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


def scene_of(ssh_map: SSHMap, turns: Trace | Turns | None = None) -> Scene:
    """Make the scene of a map. `turns` says how actions turn, as in `to_svg`.

    Raises MapError if `ssh_map` is not a map, or `turns` has a value that is no turn.
    """
    checked_map(ssh_map)
    return _Drawing(ssh_map, layout(ssh_map, turns)).scene()


class _Drawing:
    """A scene while it is made. Sizes of marks are in units of the page, times `unit`."""

    def __init__(self, ssh_map: SSHMap, found: Layout) -> None:
        self.map, self.at, self.metric = ssh_map, found.dstates, found.metric
        self.spreads = found.spreads
        self.sites = gathered((s.site, s) for s in ssh_map.dstates)
        self.spots = {site: self.at[members[0].id][:2] for site, members in self.sites.items()}
        self.spots |= found.places
        self.first = ssh_map.dstate_at[0]
        # Units of the page in a unit of the map, and the factor for the sizes of marks, at most 1.
        self.scale, self.unit = SPACING, 1.0
        if found.metric:
            nearest = NEAREST if ssh_map.places else 1.4 * NEAREST
            self.scale, self.unit = _scale(self._apart(), nearest)
        # Boxes (left, lowest, right, highest) that labels must not overlap.
        self.boxes: list[tuple[float, float, float, float]] = []

    def scene(self) -> Scene:
        """Make all marks. Later ones lie on top of earlier ones."""
        has_places = bool(self.map.places)
        # 1. Marks that labels must not cover.
        dots = [self.dot(site) for site in sorted(self.spots, key=self._is_first)]
        dots = dots if has_places or self.metric else []
        dstates = [self.dstate(s) for s in self.map.dstates]
        # 2. What lies below them.
        bands, regions = self.bands()
        lines = (self.paths() or self.edges()) if has_places else self.links()
        marks: list[Mark] = [*bands, *self.lifts(), *lines, *self.ellipses(), *dstates, *dots]
        # 3. Labels, where there is room.
        marks += [*self.labels(), *regions, *self.floor_labels(), *self.faults()]
        if self.metric:
            marks += self.scale_bar(marks)
        return Scene(tuple(marks), self.scale, self.metric)

    # Geometry.

    def far(self, size: float) -> float:
        """Convert a size in units of the page, times `unit`, to units of the map."""
        return size * self.unit / self.scale

    def along(self, s: DState, ahead: float, left: float = 0.0) -> Point:
        """The point `ahead` and `left` of a dstate, in units of the page times `unit`."""
        x, y, heading = self.at[s.id]
        spot = complex(x, y) + self.far(1) * complex(ahead, left) * cmath.rect(1.0, heading or 0.0)
        return spot.real, spot.imag

    def _is_first(self, site: int) -> bool:
        """Whether the robot began at a site."""
        return site == self.map.dstates[self.first].site

    def _apart(self) -> list[Point]:
        """Find the positions of places, or else of dstates that are not near an earlier one."""
        spots, links = self.spots, self.map.links
        if self.map.places:
            return [spots[site] for site in self.sites]
        far = (math.dist(self.at[s][:2], self.at[x][:2]) for s, _, x in links)
        near = TURNS * max(far, default=0.0)
        apart: list[Point] = []
        for spot in spots.values():
            if all(math.dist(spot, other) > near for other in apart):
                apart.append(spot)
        return apart

    def keep_clear(self, at: Point, width: float, height: float) -> None:
        """Keep labels from overlapping a box of this half width and height."""
        self.boxes.append((at[0] - width, at[1] - height, at[0] + width, at[1] + height))

    # Marks.

    def dot(self, site: int) -> Mark:
        """Draw the dot of a site. The robot's first site is white, others are black."""
        title = place_title(self.map, site) if site >= 0 else f"dstate {-1 - site}"
        fill, dot = "white" if self._is_first(site) else "#222", DOT * self.unit
        self.keep_clear(self.spots[site], self.far(DOT), self.far(DOT))
        return Titled(title, (Disc(self.spots[site], (dot, dot), fill, "#222", 1.8 * self.unit),))

    def dstate(self, s: DState) -> Mark:
        """Draw the arrow of a dstate along its heading; without a heading, a circle and its view.

        The arrow of the first dstate is black.
        """
        x, y, heading = self.at[s.id]
        title = f"dstate {s.id}: {s.shown}"
        if heading is None:
            self.keep_clear((x, y), self.far(RADIUS), self.far(RADIUS))
            view = str(s.shown)
            view = view if len(view) <= LONGEST_LABEL else f"…{view[1 - LONGEST_LABEL :]}"
            name = Label((x, y), f"x{s.id}", is_bold=True)
            below = Label((x, y - self.far(RADIUS + 12)), view)
            circle = Disc((x, y), (RADIUS, RADIUS), "white", COLOURS[0])
            return Titled(title, (circle, name, below))
        if self.metric:
            title += f", at {x:.1f}, {y:.1f} m, heading {math.degrees(heading):.0f}°"
        colour = "#000" if s.id == self.first else self._colour(s)
        for ahead in (BEGIN, (BEGIN + END) / 2, END):
            self.keep_clear(self.along(s, ahead), self.far(4), self.far(4))
        shaft = Line(((self.along(s, BEGIN), self.along(s, END - 6)),), colour, 2.2 * self.unit)
        corners = (self.along(s, END), self.along(s, END - 9, 5), self.along(s, END - 9, -5))
        return Titled(title, (shaft, _filled(corners, colour, self.unit)))

    def _colour(self, s: DState) -> str:
        if s.path is not None:
            return colour_of(s.path)
        return COLOURS[0] if s.place is None else "#555"

    def ellipses(self) -> list[Mark]:
        """Draw the ellipse of each position, unless it is too small or too large."""
        marks: list[Mark] = []
        for site, members in self.sites.items() if self.spreads else ():
            (major, minor), angle = axes(self.spreads[members[0].id])
            radii = DEVIATIONS * major * self.scale, DEVIATIONS * minor * self.scale
            if 0.5 <= radii[0] <= WIDEST:
                marks.append(Disc(self.spots[site], radii, "#000", "#777", 1, angle, 0.04, "4 3"))
        return marks

    def paths(self) -> list[Mark]:
        """Draw paths: broad lines where the robot travelled, dotted ones between other neighbours.

        In the world, a dotted part of a path need not be straight. The order of places may be one
        of several that fit, as the robot may have passed places without noticing them. An arrow
        shows direction +1.
        """
        orders, travels, heads = [], [], []
        for path in self.map.theory_paths:
            colour = colour_of(path.id)
            for p, q in untravelled(self.map, path):
                ends = (self.spots[p], self.spots[q])
                orders.append(Line((ends,), colour, 2 * self.unit, 0.7, "2 5"))
            travels += [self.broad(p, q, colour) for p, q in travelled(self.map, path)]
            if streets := self.streets_along(path):
                (ax, ay), (bx, by) = (self.spots[p] for p in streets[0])
                middle, way = ((ax + bx) / 2, (ay + by) / 2), math.atan2(by - ay, bx - ax)
                heads.append(self.head(middle, way, colour, 7, 6))
                self.keep_clear(middle, self.far(6), self.far(6))
        return [*orders, *travels, *heads]

    def edges(self) -> list[Mark]:
        """Draw a line between two places if an action leads from one to the other."""
        at = self.map.dstates
        ends = [(at[s], at[x]) for s, _, x in self.map.links]
        pairs = neighbours((s.site, x.site) for s, x in ends if s.floor == x.floor)
        return [self.broad(p, q, COLOURS[0]) for p, q in pairs]

    def broad(self, p: int, q: int, colour: str) -> Line:
        """Draw a broad line between two sites, where the robot travelled."""
        return Line(((self.spots[p], self.spots[q]),), colour, 8 * self.unit, 0.4)

    def head(self, tip: Point, way: float, colour: str, ahead: float, aside: float) -> Line:
        """Draw the head of an arrow that ends `ahead` of a point, in direction `way` (radians)."""
        corners = (complex(ahead, 0.0), complex(-ahead, aside), complex(-ahead, -aside))
        unit = cmath.rect(self.far(1), way)
        return _filled(_points(complex(*tip) + unit * corner for corner in corners), colour, 0.5)

    def streets_along(self, path: MapPath) -> list[tuple[int, int]]:
        """The streets of a path in direction +1: travelled ones, the longest first.

        Without any, the first one of a map without poses.
        """
        order = {place: i for i, place in enumerate(path.order)}
        streets = [
            (p, q) if order.get(p, 0) < order.get(q, 0) else (q, p)
            for p, q in travelled(self.map, path)
        ]
        streets.sort(key=lambda ends: -math.dist(self.spots[ends[0]], self.spots[ends[1]]))
        return streets or list(pairwise(path.order))[: 0 if self.metric else 1]

    def links(self) -> list[Mark]:
        """Draw the links of a map without places as arrows."""
        marks: list[Mark] = []
        for (start, end), _ in self.arrows():
            way = math.atan2(end[1] - start[1], end[0] - start[0])
            marks.append(Line(((start, end),), "#999", 1.4 * self.unit))
            marks.append(self.head(end, way, "#999", 4, 3.5))
        return marks

    def arrows(self) -> list[tuple[tuple[Point, ...], str]]:
        """Find the ends of the arrow, and the actions, of each pair of linked dstates."""
        arrows = []
        for (source, target), names in link_names(self.map).items():
            a, b = self.map.dstates[source], self.map.dstates[target]
            here, there = complex(*self.at[source][:2]), complex(*self.at[target][:2])
            if self.at[source][2] is None:
                gap = (there - here) / (abs(there - here) or 1.0) * self.far(RADIUS + 4)
                start, end = here + gap, there - gap
            else:
                is_turn = self.metric and abs(there - here) < self.far(2 * END)
                start = complex(*self.along(a, END + 2))
                end = complex(*self.along(b, END + 2 if is_turn else -BEGIN))
            # Two opposite links are beside each other.
            aside = 1j * (start - end) / (abs(start - end) or 1.0) * self.far(ASIDE)
            arrows.append((_points([start + aside, end + aside]), names))
        return arrows

    def lifts(self) -> list[Mark]:
        """Draw lifts of a map with places as dashed lines."""
        floor = [s.floor for s in self.map.dstates]
        return [
            Titled(action, (Line(((self.at[s][:2], self.at[x][:2]),), "#999", 1, 0.8, "6 5"),))
            for s, action, x in self.map.links
            if self.map.places and floor[s] != floor[x]
        ]

    def bands(self) -> tuple[list[Mark], list[Mark]]:
        """Draw a band around the places of each region behind one place, and name it.

        Regions beside paths overlap each other. So they are only named in the titles of places.
        """
        bands: list[Mark] = []
        labels: list[Mark] = []
        for region, broad in (pairs := banded(self.map, 2 * END * self.unit)):
            chains: list[tuple[Point, ...]] = [(self.spots[p],) for p in region.places]
            chains += [(self.spots[p], self.spots[q]) for p, q in streets_in(self.map, region)]
            bands.append(band(region, chains, broad))
            # The name is at the lowest place that is in no inner region. Dstates are rarely named
            # on its lower left.
            own = {*region.places}
            own = own.difference(*(r.places for r, _ in pairs if {*r.places} < own)) or own
            y, x = min((self.spots[p][1], self.spots[p][0]) for p in own)
            beside = x - 0.6 * broad / self.scale, y - (0.5 * broad + 4) / self.scale
            labels.append(Label(beside, self.map.called("region", region.id), BAND, 11))
        return bands, labels

    def faults(self) -> list[Mark]:
        """Draw a red diamond with an exclamation mark for each dstate with faults."""
        steps = gathered((self.map.dstate_at[fault.step], str(fault)) for fault in self.map.faults)
        marks: list[Mark] = []
        for s, told in steps.items():
            is_round = self.at[s][2] is None
            x, y = self.along(self.map.dstates[s], *((RADIUS, RADIUS) if is_round else (END, 0)))
            u = self.far(8)
            diamond = _filled(((x, y + u), (x + u, y), (x, y - u), (x - u, y)), ALARM, 1.5, "white")
            sign = Label((x, y), "!", "white", 11 * self.unit, is_bold=True)
            marks.append(Titled("; ".join(told), (diamond, sign), "fault"))
        return marks

    # Labels.

    def labels(self) -> Iterator[Mark]:
        """Draw each label at the first point where it overlaps nothing, if there is one.

        Names of places and of the start are always drawn, and so are all labels of a map without
        poses. A font is smaller if there is little room, but at least 9.
        """
        for text, spots, gap, colour, size, is_bold in self._wanted():
            w, h = self.half(text, size)
            around = [
                p for spot in spots for p in (self._around(spot, w, h, gap) if gap else spots)
            ]
            free = (p for p in around if self._is_free(p, w, h))
            must = around and (not self.metric or (is_bold and not text.isdecimal()))
            if at := next(free, around[0] if must else None):
                self.keep_clear(at, w, h)
                yield Label(at, text, colour, max(size * self.unit, 9.0), is_bold)

    def _wanted(self) -> Iterator[tuple[str, list[Point], float, str, float, bool]]:
        """Yield all labels, the important ones first.

        Each has its text, the points around which it may be, the distance from these points (0 to
        be at a point), its colour, its size, and whether it is bold.
        """
        for place in self.map.places:
            name = self.map.name_of("place", place)
            text = str(place) if name is None else f"{place} {name}"
            yield text, [self.spots[place]], 9, "#000", 15, True
        for s in sorted(self.map.dstates, key=lambda s: s.id != self.first):
            if self.at[s.id][2] is not None:
                text, colour = (f"x{s.id}", "#444") if s.id != self.first else ("x0 start", "#000")
                beside = [self.along(s, ahead) for ahead in (END, 17)]
                yield text, beside, 7, colour, 11, s.id == self.first
        for path in self.map.theory_paths:
            streets = [[self.spots[p] for p in ends] for ends in self.streets_along(path)]
            beside = [
                (a[0] + (b[0] - a[0]) * share, a[1] + (b[1] - a[1]) * share)
                for a, b in streets
                for share in (0.5, 0.6, 0.4)
            ]
            yield self.map.called("path", path.id), beside, 6, colour_of(path.id), 12, False
        if not self.map.places:
            for ((x, y), (u, v)), names in self.arrows():
                yield names, [((x + u) / 2, (y + v) / 2)], 0, "#777", 10, False

    def _around(self, at: Point, w: float, h: float, gap: float) -> Iterator[Point]:
        """Yield points near a point for a label of this half width and height."""
        for far in (self.far(gap * times) for times in (1, 1.5, 2.5)):
            for x, y in ((1, 1), (1, -1), (-1, -1), (-1, 1), (0, -1), (0, 1), (1, 0), (-1, 0)):
                share = far / math.hypot(x, y)
                yield at[0] + x * (share + w), at[1] + y * (share + h)

    def _is_free(self, at: Point, w: float, h: float) -> bool:
        x, y = at
        return all(
            x + w <= left or right <= x - w or y + h <= low or high <= y - h
            for left, low, right, high in self.boxes
        )

    def half(self, text: str, size: float) -> Point:
        """Estimate half the width and height of a label, in units of the map."""
        w, h = half_size(text, max(size * self.unit, 9.0))
        return w / self.scale, h / self.scale

    def floor_labels(self) -> list[Mark]:
        """Draw the names of floors above their dstates on the left."""
        labels: list[Mark] = []
        for i, members in enumerate(self.map.floors):
            xs, ys = zip(*(self.at[s][:2] for s in members), strict=True)
            above = min(xs), max(ys) + FLOOR / self.scale
            labels.append(Label(above, f"floor {i}", size=16, is_bold=True))
        return labels

    def scale_bar(self, marks: Sequence[Mark]) -> list[Mark]:
        """Draw a scale bar of 1, 2 or 5 times a power of ten metres, below the map on the left."""
        left, lowest, _, _ = bounds(marks, self.scale)
        u, most = 1 / self.scale, 120 / self.scale
        ten = 10.0 ** math.floor(math.log10(most))
        metres = max(ten * k for k in (1, 2, 5) if ten * k <= most * (1 + 1e-9))
        y, right = lowest - 24 * u, left + metres
        bar = (((left, y - 5 * u), (left, y + 5 * u)), ((left, y), (right, y)))
        end = ((right, y - 5 * u), (right, y + 5 * u))
        text = Label(((left + right) / 2, y - 19 * u), f"{metres:g} m")
        return [Titled("scale", (Line((*bar, end), "#222", 1.5), text))]


def link_names(ssh_map: SSHMap) -> dict[tuple[int, int], str]:
    """Return the names of the actions, joined by commas, for each pair (start, end) of dstates."""
    actions = gathered(
        ((source, target), action) for source, action, target in ssh_map.links if source != target
    )
    return {ends: ", ".join(names) for ends, names in actions.items()}


def banded(ssh_map: SSHMap, width: float) -> list[tuple[Region, float]]:
    """List the regions behind one place, the largest first, each with the width of its band."""
    regions = [r for r in ssh_map.regions or () if r.door is not None]
    return [(r, width * (1 + WIDER * _depth(r, regions))) for r in regions]


def band(region: Region, chains: Sequence[tuple[Point, ...]], width: float) -> Mark:
    """Draw one band along chains of points, with the region as its title."""
    return Titled(str(region), (Line(tuple(chains), BAND, width, OPACITY),), "region")


def streets_in(ssh_map: SSHMap, region: Region) -> list[tuple[int, int]]:
    """Find the pairs of neighbouring places of a region: by links, and along paths."""
    place = [s.place for s in ssh_map.dstates]
    pairs = [(place[s], place[x]) for s, _, x in ssh_map.links]
    pairs += [ends for path in ssh_map.theory_paths for ends in pairwise(path.order)]
    return neighbours(ends for ends in pairs if {*ends} <= {*region.places})


def place_title(ssh_map: SSHMap, place: int) -> str:
    """Say where a place lies: "place 2, right of path 0+, in regions 1 and 3"."""
    regions = [r for r in ssh_map.regions or () if place in r.places]
    bounding = sorted({course for region in regions for course in region.bounds})
    beside = f", right of {list_in_words(map(course_named, bounding))}" if bounding else ""
    around = [ssh_map.numbered("region", region.id) for region in regions]
    within = f", in {noun_of('region', around)} {list_in_words(around)}" if around else ""
    return f"{ssh_map.called('place', place)}{beside}{within}"


def axes(spread: tuple[float, float, float]) -> tuple[tuple[float, float], float]:
    """Find the principal axes of a covariance (xx, xy, yy).

    Return the standard deviations along both axes, the larger one first, and the angle of the
    first axis in radians counterclockwise from x.
    """
    xx, xy, yy = spread
    mean, half = (xx + yy) / 2, math.hypot((xx - yy) / 2, xy)
    angle = math.atan2(2 * xy, xx - yy) / 2
    return (math.sqrt(max(0.0, mean + half)), math.sqrt(max(0.0, mean - half))), angle


def _depth(region: Region, regions: Sequence[Region]) -> int:
    """Count how deep regions are nested inside this one; 0 if no region is inside it."""
    inner = [r for r in regions if {*r.places} < {*region.places}]
    return 1 + max(_depth(r, regions) for r in inner) if inner else 0


def _filled(corners: Sequence[Point], colour: str, width: float, outline: str = "") -> Line:
    """Draw a polygon."""
    return Line(((*corners, corners[0]),), outline or colour, width, fill=colour)


def _points(numbers: Iterable[complex]) -> tuple[Point, ...]:
    """Convert complex numbers to points."""
    return tuple((number.real, number.imag) for number in numbers)


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
