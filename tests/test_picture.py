"""Pictures of maps with poses: metres, headings, ellipses of uncertainty, the size of the page."""

from __future__ import annotations

import math
import random
import re
import xml.etree.ElementTree as ET
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from test_regions import LOG, TOUR, trace_of
from worlds import TOURS, drive

from ssh_abduction import SSHMap, Theory, Trace, solve
from ssh_abduction.cli import main
from ssh_abduction.data.maps import DState, Fit, MapPath, Pose
from ssh_abduction.output import to_svg

SVG = "{http://www.w3.org/2000/svg}"
SQUARE = [(10.0, 0.3, 0.02), (0.0, 0.0, math.pi / 2)] * 4


@cache
def surveyed(theory: str = "topological") -> SSHMap:
    """The map of a square that the robot drove round once, turning left at each corner."""
    trace = Trace.from_steps("abcdefgha", ["travel", "left"] * 4, displacements=SQUARE)
    return solve(
        trace, {"topological": Theory.topological, "causal": Theory.causal}[theory]()
    ).maps[0]


def grid(side: int, apart: float = 8.0) -> SSHMap:
    """A map of side x side places with dstates to all four sides, and growing uncertainty."""
    draw, dstates, poses = random.Random(1), [], []
    for place in range(side * side):
        x, y = place % side, place // side
        at = (
            (apart * x + draw.gauss(0, 0.3), apart * y + draw.gauss(0, 0.3))
            if place
            else (0.0, 0.0)
        )
        for quarter in range(4):
            path = y if quarter % 2 == 0 else side + x
            dstates.append(
                DState(len(dstates), f"view {len(dstates)}", place, path, 1 if quarter < 2 else -1)
            )
            poses.append(
                Pose(
                    *at,
                    math.remainder(quarter * math.pi / 2, math.tau),
                    (0.01 * x, 0.002 * (x - y), 0.02 * y),
                )
            )
    rows = [MapPath(y, tuple(y * side + x for x in range(side))) for y in range(side)]
    columns = [MapPath(side + x, tuple(y * side + x for y in range(side))) for x in range(side)]
    east = [(4 * p, "travel", 4 * p + 4) for p in range(side * side) if p % side < side - 1]
    return SSHMap(
        (0,),
        tuple(dstates),
        tuple(east),
        tuple(range(side * side)),
        (*rows, *columns),
        fit=Fit(1.0, 1, 0.5, poses=tuple(poses)),
    )


def dots(picture: str) -> dict[str, tuple[float, float]]:
    """Where the dots are, by what they stand for."""
    groups = [
        group
        for group in ET.fromstring(picture).iter(f"{SVG}g")
        if group.find(f"{SVG}circle") is not None
    ]
    return {
        str(group.findtext(f"{SVG}title")).partition(",")[0]: (
            float(circle.attrib["cx"]),
            float(circle.attrib["cy"]),
        )
        for group in groups
        if (circle := group.find(f"{SVG}circle")) is not None
    }


def page(picture: str) -> tuple[float, float, float, float]:
    left, top, width, height = map(float, ET.fromstring(picture).attrib["viewBox"].split())
    return left, top, left + width, top + height


@pytest.mark.parametrize("theory", ["topological", "causal"])
def test_picture_draws_dstates_at_their_poses(theory: str) -> None:
    ssh_map = surveyed(theory)
    assert ssh_map.fit is not None
    found = dots(to_svg(ssh_map))
    names = [
        f"place {s.place}" if s.place is not None else f"dstate {s.id}" for s in ssh_map.dstates
    ]
    assert set(found) == set(names)
    metres = np.array([(pose.x, -pose.y) for pose in ssh_map.fit.poses])  # y is down on the page
    drawn = np.array([found[name] for name in names])
    scale = np.linalg.norm(drawn[2] - drawn[0]) / np.linalg.norm(metres[2] - metres[0])
    assert np.abs(drawn - drawn[0] - scale * (metres - metres[0])).max() < 0.2
    assert scale > 5


def test_picture_of_a_map_without_paths_shows_ways_between_places() -> None:
    steps = [(5.0, 0.0, 0.0)] * 2
    trace = Trace.from_steps("abc", ["travel"] * 2, displacements=steps)
    ssh_map = solve(trace, Theory(boundary="none")).maps[0]
    whole = to_svg(ssh_map)
    bare = to_svg(
        replace(
            ssh_map,
            paths=(),
            dstates=tuple(replace(s, path=None, direction=None) for s in ssh_map.dstates),
        )
    )
    assert whole.count('opacity="0.4"') == bare.count('opacity="0.4"') == 2


def test_picture_scale_bar_has_its_stated_length() -> None:
    ssh_map = grid(4, apart=8.0)
    picture = to_svg(ssh_map)
    (metres,) = (float(found) for found in re.findall(r">([0-9.]+) m<", picture))
    bar = re.findall(r"<title>scale</title><path d=\"(.*?)\"", picture)[0]
    ends = [float(x) for x in re.findall(r"([-0-9.]+),", bar)]
    left, right = min(ends), max(ends)
    at = dots(picture)
    assert ssh_map.fit is not None
    across = ssh_map.fit.poses[4 * 3].x - ssh_map.fit.poses[0].x
    assert (right - left) / metres == pytest.approx(
        (at["place 3"][0] - at["place 0"][0]) / across, rel=0.01
    )


def test_picture_arrows_point_along_the_headings() -> None:
    ssh_map = surveyed()
    assert ssh_map.fit is not None
    turned = {}
    for group in ET.fromstring(to_svg(ssh_map)).iter(f"{SVG}g"):
        if (number := re.match(r"dstate (\d+):", str(group.findtext(f"{SVG}title")))) and (
            arrow := group.find(f"{SVG}path")
        ) is not None:
            ax, ay, bx, by = map(float, re.findall(r"[-0-9.]+", arrow.attrib["d"]))
            turned[int(number[1])] = math.atan2(ay - by, bx - ax)
    assert turned.keys() == {*range(len(ssh_map.dstates))}
    for s, pose in enumerate(ssh_map.fit.poses):
        assert abs(math.remainder(turned[s] - pose.heading, math.tau)) < 0.01


def test_picture_ellipses_show_the_covariance() -> None:
    ssh_map = grid(3)
    assert ssh_map.fit is not None
    picture = to_svg(ssh_map)
    at = dots(picture)
    scale = math.dist(at["place 0"], at["place 2"]) / math.hypot(
        ssh_map.fit.poses[8].x, ssh_map.fit.poses[8].y
    )
    found = {
        (float(e.attrib["cx"]), float(e.attrib["cy"])): e.attrib
        for e in ET.fromstring(picture).iter(f"{SVG}ellipse")
    }
    assert at["place 0"] not in found
    assert len(found) == 8
    for place in range(1, 9):
        xx, xy, yy = ssh_map.fit.poses[4 * place].spread
        values, vectors = np.linalg.eigh([[xx, xy], [xy, yy]])
        drawn = found[at[f"place {place}"]]
        assert float(drawn["rx"]) == pytest.approx(2 * scale * math.sqrt(values[1]), abs=0.1)
        assert float(drawn["ry"]) == pytest.approx(
            2 * scale * math.sqrt(max(0.0, values[0])), abs=0.1
        )
        angle = math.radians(-float(re.findall(r"rotate\(([-0-9.]+) ", drawn["transform"])[0]))
        assert abs(vectors[:, 1] @ (math.cos(angle), math.sin(angle))) == pytest.approx(1, abs=1e-3)


@pytest.mark.parametrize(
    "make",
    [
        surveyed,
        lambda: surveyed("causal"),
        lambda: grid(2),
        lambda: grid(9),
        lambda: grid(3, apart=0.02),
    ],
    ids=["square", "causal", "four", "many", "near"],
)
def test_picture_marks_lie_within_the_page(make: Callable[[], SSHMap]) -> None:
    picture = to_svg(make())
    left, top, right, bottom = page(picture)
    inside = []
    for mark in ET.fromstring(picture).iter():
        if mark.tag == f"{SVG}text":
            wide = 0.35 * float(mark.attrib["font-size"]) * len(str(mark.text))
            x, y = float(mark.attrib["x"]), float(mark.attrib["y"])
            inside += [(x - wide, y), (x + wide, y)]
        elif mark.tag in (f"{SVG}circle", f"{SVG}ellipse"):
            x, y, far = (
                float(mark.attrib[name])
                for name in ("cx", "cy", "r" if mark.tag == f"{SVG}circle" else "ry")
            )
            inside += [(x - far, y - far), (x + far, y + far)]
        elif "M0,0" not in mark.attrib.get("d", "M0,0") and "transform" not in mark.attrib:
            inside += [
                (float(x), float(y))
                for x, y in re.findall(r"([-0-9.]+),([-0-9.]+)", mark.attrib["d"])
                if float(x)
            ]
    assert len(inside) > 10
    assert all(left <= x <= right and top <= y <= bottom for x, y in inside)
    assert max(right - left, bottom - top) < 2600


def test_picture_labels_do_not_overlap() -> None:
    for ssh_map in (grid(2), grid(9), grid(3, apart=0.02), surveyed("causal")):
        boxes = []
        for mark in ET.fromstring(to_svg(ssh_map)).iter(f"{SVG}text"):
            size, x, y = (float(mark.attrib[name]) for name in ("font-size", "x", "y"))
            wide = 0.3 * size * len(str(mark.text))
            boxes.append((x - wide, y - size / 2, x + wide, y + size / 2))
        for i, (left, top, right, bottom) in enumerate(boxes):
            assert all(
                right <= x or r <= left or bottom <= t or b <= top for x, t, r, b in boxes[:i]
            )


def test_picture_names_each_place_of_a_large_map() -> None:
    ssh_map = grid(9)
    named = {str(mark.text) for mark in ET.fromstring(to_svg(ssh_map)).iter(f"{SVG}text")}
    assert {str(p) for p in ssh_map.places} <= named
    assert "x0 start" in named


def test_maps_without_poses_are_drawn_by_layout() -> None:
    (without,) = solve(drive(*TOURS["tee"]), Theory.circumscriptive()).maps
    before = to_svg(without)
    poses = [Pose(0.1 * s.id, 0.0, 0.0) for s in without.dstates]
    assert to_svg(replace(without, fit=Fit(1.0, 1, 0.5))) == before
    assert to_svg(replace(without, fit=Fit(1.0, 1, 0.5, poses=tuple(poses)))) != before
    other = next(s.id for s in without.dstates if s.place != without.dstates[0].place)
    poses[other] = Pose(
        0.0, 0.0, 0.0
    )  # a part of the map which no displacement connects with the rest has poses of its own
    assert to_svg(replace(without, fit=Fit(1.0, 1, 0.5, poses=tuple(poses)))) == before
    poses[other] = Pose(1e300, 0.0, 0.0)
    assert to_svg(replace(without, fit=Fit(1.0, 1, 0.5, poses=tuple(poses)))) == before


def test_export_writes_svg_to_file_or_standard_output(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    surveyed().save(tmp_path / "maps.json")
    export = ["export", str(tmp_path / "maps.json"), "--to", "svg"]
    assert main([*export, "-o", str(tmp_path / "map.svg")]) == 0
    assert capsys.readouterr().out == ""
    assert main(export) == 0
    written = (tmp_path / "map.svg").read_text()
    assert written == capsys.readouterr().out
    assert "place 3" in written
    assert main([*export, "-o", str(tmp_path / "no" / "map.svg")]) == 1
    assert "cannot write the map" in capsys.readouterr().err


def test_picture_draws_bands_of_regions() -> None:
    ssh_map = solve(trace_of(TOUR), LOG, max_maps=1)[0]
    root = ET.fromstring(to_svg(ssh_map))
    groups = [g for g in root.iter(f"{SVG}g") if g.get("class") == "region"]
    told = [g.findtext(f"{SVG}title") for g in groups]
    assert told == [str(region) for region in ssh_map.regions or () if region.door is not None]
    paths = [g.find(f"{SVG}path") for g in groups]
    widths = [float(path.get("stroke-width", 0)) for path in paths if path is not None]
    assert widths[:3] == [widths[0]] * 3 > widths[3:] == [widths[3]] * 3
    names = [node.text for node in root.iter(f"{SVG}text")]
    assert {f"region {i}" for i in range(6)} <= {*names}
    assert "region" not in to_svg(replace(ssh_map, regions=None))


def test_picture_titles_of_places_name_their_sides() -> None:
    corner = solve(Trace.from_steps("abcd", ["travel", "right", "travel"]))[0]
    titles = [node.text for node in ET.fromstring(to_svg(corner)).iter(f"{SVG}title")]
    assert "place 2, right of path 0+, in region 1" in titles
    assert "place 1" in titles
