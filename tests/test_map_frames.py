"""A map in the frame of another map: exports agree with the points of a file."""

from __future__ import annotations

import cmath
import json
import math
from pathlib import Path

import numpy as np
import pytest
from test_agents import house
from test_derived_paths import CROSS

from ssh_abduction.cli import main
from ssh_abduction.data.errors import MapError
from ssh_abduction.output.map_frames import MapFrame, frame_of_file
from ssh_abduction.rivals.listing import Listing

__all__ = ["house"]
TURN, SHIFT = cmath.rect(1, 0.7), 30 - 12j
# The places of the map, in the order of first visits.
AT = [complex(*CROSS[p]) for p in (0, 1, 4, 2, 5, 3)]
MOVED = [TURN * z + SHIFT for z in AT]
POINTS = [(AT[0], MOVED[0]), (AT[5], MOVED[5])]


def written(folder: Path, text: str) -> str:
    file = folder.parent / "poses.csv"
    file.write_text(text)
    return str(file)


def points_of(capsys: pytest.CaptureFixture[str], *words: str) -> list[complex]:
    assert main(["export", *words, "--to", "nav2"]) == 0
    features = json.loads(capsys.readouterr().out)["features"]
    points = [f["geometry"] for f in features if f["geometry"]["type"] == "Point"]
    return [complex(*point["coordinates"]) for point in points]


@pytest.mark.parametrize(
    "rows",
    [
        ["place,x,y", *(f"p{p},{MOVED[p].real},{MOVED[p].imag}" for p in (0, 2, 5))],
        ["map_x,map_y,x,y", *(f"{z.real},{z.imag},{w.real},{w.imag}" for z, w in POINTS)],
        ["step, x, y", *(f"{t},{MOVED[p].real},{MOVED[p].imag}" for t, p in ((0, 0), (2, 2)))],
        [
            "# a pose with a yaw says all",
            "",
            "x,y,yaw,step",
            f"{SHIFT.real},{SHIFT.imag},0.7,monday:0",
        ][2:],
    ],
)
def test_export_is_in_the_frame_of_the_points(
    house: Path, rows: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    found = points_of(capsys, str(house), "--frame-of", written(house, "\n".join(rows)))
    assert np.allclose(sorted(found, key=abs), sorted(MOVED, key=abs), atol=1e-3)


def test_origin_is_the_pose_of_the_first_dstate(
    house: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = points_of(capsys, str(house), "--origin", f"30,-12,{math.degrees(0.7)}")
    assert np.allclose(sorted(found, key=abs), sorted(MOVED, key=abs), atol=1e-3)


def test_scale_says_how_much_longer_distances_are() -> None:
    frame = MapFrame.of_points({"a": (0j, 0j), "b": (10j, 12 + 0j)})
    assert math.isclose(frame.scale, 1.2)
    assert [metres for _, metres in frame.residuals] == pytest.approx([1, 1])


@pytest.mark.parametrize("is_mirrored", [False, True])
def test_mirrored_points_are_told(is_mirrored: bool) -> None:
    points = {name: complex(x, y) for name, x, y in (("a", 0, 0), ("b", 9, 1), ("c", 4, 7))}
    there = {
        name: (z, 3 + 1j * (z.conjugate() if is_mirrored else z)) for name, z in points.items()
    }
    sentence = MapFrame.of_points(there).sentence
    assert ("; mirrored, they fit to 0.00 m" in sentence) == is_mirrored


def test_rooms_and_doors_move_with_the_places(house: Path) -> None:
    ssh_map = Listing.load(house / "maps.json").maps[0]
    moved = MapFrame(TURN, SHIFT).moved(ssh_map)
    for old, new in zip(ssh_map.doors, moved.doors, strict=True):
        assert cmath.isclose(complex(*new.at), TURN * complex(*old.at) + SHIFT)
    assert moved.corridors[0].line != ssh_map.corridors[0].line


def test_residuals_name_the_worst_point(house: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = [f"p{p},{AT[p].real},{AT[p].imag + 0.9 * (p == 2)}" for p in range(6)]
    main(
        [
            "export",
            str(house),
            "--to",
            "nav2",
            "--frame-of",
            written(house, "\n".join(["place,x,y", *rows])),
        ]
    )
    assert "6 points; residuals" in (said := capsys.readouterr().err)
    assert "(p2, line 4)" in said


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("p0,1,2", "line 1: expected the names of columns"),
        ("place,x,y\np0,1", "line 2: y: expected a number"),
        ("place,x,y\np0,1,2\np77,1,2", "line 3: place: expected a place of the map"),
        ("step,x,y\nmonday:99,1,2", "line 2: step"),
        ("place,x,y\np0,1,2", "expected two points"),
        ("place,x,y,yaw\np0,1,2,3", "line 2: yaw: expected none for a place"),
        ("time,x,y\n1,2,3", "time: expected poses at the times of the log"),
        ("place,x,y\np0,1,2\np1,1,2", "expected two points"),
    ],
)
def test_wrong_files_are_refused(house: Path, text: str, expected: str) -> None:
    listing = Listing.load(house / "maps.json")
    with pytest.raises(MapError, match=expected):
        frame_of_file(written(house, text), listing.maps[0], drives=listing.drives)
