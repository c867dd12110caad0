"""Draw the regions of a map: bands along the streets of a region behind one place, and titles.

Regions beside paths overlap each other. So they are only named in the titles of places, which
browsers show under the pointer.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.regions import Region, course_named, list_in_words
from ssh_abduction.data.words import noun_of
from ssh_abduction.output.drawing import Point, element, line, svg_text, titled

# The colour and the opacity of bands. Each band around another one is wider by WIDER times the
# width of the innermost band.
BAND, OPACITY, WIDER = "#8a6d00", 0.13, 0.5


def region_marks(
    ssh_map: SSHMap, spots: Mapping[int, Point], width: float
) -> tuple[list[str], list[Point]]:
    """Draw a band around the places of each region behind one place, with its name beside it.

    `spots` has the point of each place on the page. Return the marks, and the points that the
    page has to include.
    """
    bands: list[str] = []
    names: list[str] = []
    points: list[Point] = []
    for region, broad in (pairs := banded(ssh_map, width)):
        inside = [spots[p] for p in region.places]
        ways = [line(p, p) for p in inside]
        ways += [line(spots[p], spots[q]) for p, q in streets_in(ssh_map, region)]
        bands.append(band(region, ways, broad))
        points += [(x + k * broad / 2, y + k * broad / 2) for x, y in inside for k in (-1, 1)]
        # The name is at the lowest place that is in no inner region. Dstates are rarely named on
        # its lower left.
        inner = _within(region, [r for r, _ in pairs])
        own = {*region.places}.difference(*(r.places for r in inner))
        x, y = max((spots[p] for p in own or region.places), key=lambda spot: (spot[1], -spot[0]))
        beside = x - 0.6 * broad, y + 0.5 * broad + 4
        names.append(svg_text(*beside, ssh_map.called("region", region.id), BAND, 11, halo=True))
        points.append((beside[0] - 30, beside[1]))
    return [*bands, *names], points


def banded(ssh_map: SSHMap, width: float) -> list[tuple[Region, float]]:
    """List the regions behind one place, the largest first, each with the width of its band."""
    regions = [r for r in ssh_map.regions or () if r.door is not None]
    return [(r, width * (1 + WIDER * _depth(r, regions))) for r in regions]


def band(region: Region, ways: Sequence[str], width: float) -> str:
    """Draw one band along these ways (data of SVG paths), with the region as its title."""
    style = {"stroke_width": f"{width:.1f}", "stroke_linecap": "round", "stroke_linejoin": "round"}
    mark = element("path", d=" ".join(ways), fill="none", stroke=BAND, **style)
    return titled(str(region), mark, class_="region", opacity=OPACITY)


def streets_in(ssh_map: SSHMap, region: Region) -> list[tuple[int, int]]:
    """Find the pairs of neighbouring places of a region: by links, and along paths."""
    place = [s.place for s in ssh_map.dstates]
    pairs = [(place[s], place[x]) for s, _, x in ssh_map.links]
    pairs += [ends for path in ssh_map.paths for ends in pairwise(path.order)]
    inside = {
        (min(p, q), max(p, q))
        for p, q in pairs
        if p in region.places and q in region.places and p is not None and q is not None and p != q
    }
    return sorted(inside)


def place_title(ssh_map: SSHMap, place: int) -> str:
    """Say where a place lies: "place 2, right of path 0+, in regions 1 and 3"."""
    regions = [r for r in ssh_map.regions or () if place in r.places]
    bounds = sorted({course for region in regions for course in region.bounds})
    beside = f", right of {list_in_words(map(course_named, bounds))}" if bounds else ""
    around = [ssh_map.numbered("region", region.id) for region in regions]
    within = f", in {noun_of('region', around)} {list_in_words(around)}" if around else ""
    return f"{ssh_map.called('place', place)}{beside}{within}"


def _depth(region: Region, regions: Sequence[Region]) -> int:
    """Count how deep regions are nested inside this one; 0 if no region is inside it."""
    inner = _within(region, regions)
    return 1 + max(_depth(r, regions) for r in inner) if inner else 0


def _within(region: Region, regions: Sequence[Region]) -> list[Region]:
    """List the regions that lie inside a region."""
    return [r for r in regions if {*r.places} < {*region.places}]
