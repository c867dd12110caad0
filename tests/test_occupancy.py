"""Occupancy maps are compared pixel by pixel with the rules of map_server and nav2_map_server."""

from __future__ import annotations

import math
import warnings
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from simulator.errors import SimulatorError, SimulatorWarning
from simulator.occupancy import read_occupancy
from simulator.world import World

Pixel = tuple[float, ...]
HEAD = "image: map.pgm\nresolution: 0.5\n"
TAIL = "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
ORIGIN = "origin: [-1.0, 2.0, 0.0]\n"
# Dark at the borders, and on two sides of one corner.
GREY = np.array([[0, 0, 0, 0], [0, 254, 205, 0], [0, 254, 254, 90], [0, 0, 0, 254]], np.uint8)


def cell(pixel: Pixel, alpha: float, negate: bool, occupied: float, free: float, mode: str) -> int:
    """The value of a cell by the rules of nav2_map_server.

    Channels are from 0 to 255; alpha is 255 if the pixel is opaque or has none.
    """
    mean = sum(pixel) / len(pixel)
    if mode == "raw":
        return round(mean) if round(mean) <= 100 else -1
    occupancy = mean / 255 if negate else (255 - mean) / 255
    if mode == "scale" and alpha < 255:
        return -1
    if occupancy > occupied:
        return 100
    if occupancy < free:
        return 0
    return -1 if mode == "trinary" else round(100 * (occupancy - free) / (occupied - free))


def borders(
    walls: np.ndarray[Any, Any], resolution: float, origin: tuple[float, float, float]
) -> set[frozenset[tuple[int, int]]]:
    """Walls as sides of cells: each as its two corners, counted in cells from the lower left."""
    x, y, yaw = origin
    found = set()
    for wall in walls:
        ends = [
            ((p - x) + 1j * (q - y)) * np.exp(-1j * yaw) / resolution for p, q in wall.reshape(2, 2)
        ]
        start, end = (complex(round(z.real), round(z.imag)) for z in ends)
        assert np.allclose(ends, [start, end], atol=1e-6)
        steps = round(abs(end - start))
        corners = [start + (end - start) * i / steps for i in range(steps + 1)]
        for a, b in pairwise(corners):
            found.add(frozenset((round(z.real), round(z.imag)) for z in (a, b)))
    return found


def sides(occupied: list[list[bool]]) -> set[frozenset[tuple[int, int]]]:
    """The sides of cells between occupied and other cells, from the bottom row up."""
    found: set[frozenset[tuple[int, int]]] = set()
    for i, row in enumerate(reversed(occupied)):
        for j, here in enumerate(row):
            if here:
                corners = [(j, i), (j + 1, i), (j + 1, i + 1), (j, i + 1)]
                found ^= {frozenset((corners[k - 1], corners[k])) for k in range(4)}
    return found


def saved(folder: Path, text: str | bytes, image: np.ndarray[Any, Any] | None = GREY) -> Path:
    path = folder / "map.yaml"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    if image is not None:
        Image.fromarray(image).save(folder / "map.pgm")
    return path


@pytest.mark.parametrize(
    "text",
    [
        HEAD + ORIGIN + TAIL,
        HEAD + "origin: \n  - -1.0\n  - 2.0\n  - 0.0\n" + TAIL,
        HEAD + "origin:\n- -1\n- 2   # metres\n- 0\n" + TAIL,
        HEAD + "origin: [-1.0,\n  2.0, 0.0]\n" + TAIL,
        "\ufeff" + HEAD + ORIGIN + TAIL,
        ("\ufeff" + HEAD + ORIGIN + TAIL).encode("utf-16-le"),
        (HEAD + ORIGIN + TAIL).replace("\n", "\r\n"),
        "# made by hand\n%s" % (HEAD + ORIGIN + TAIL),
        "---\n" + HEAD + ORIGIN + TAIL + "...\n",
        (
            "{image: map.pgm, resolution: 0.5, origin: [-1, 2, 0], negate: 0, occupied_thresh: "
            "0.65, free_thresh: 0.196}"
        ),
        '"image": "map.pgm"\n\'resolution\': "0.5"\n' + ORIGIN + TAIL,
        "image:    map.pgm   # a comment\nresolution: 5e-1\n"
        + ORIGIN
        + "negate: false\noccupied_thresh: .65\nfree_thresh: 1.96e-1",
        HEAD + "origin: &here [-1.0, 2.0, 0]\n" + TAIL + "mode: trinary\n",
    ],
)
def test_yaml_is_read_by_a_parser(text: str | bytes, tmp_path: Path) -> None:
    _, walls = read_occupancy(saved(tmp_path, text))
    assert borders(walls, 0.5, (-1.0, 2.0, 0.0)) == sides((GREY < 89).tolist())


@pytest.mark.parametrize(
    "name",
    ["floor #1.pgm", "floor: 1.pgm", "2020-01-01", "on", "sub/map.pgm", "étage.png", "'.bmp"],
)
def test_image_path_is_relative_to_the_yaml_file(name: str, tmp_path: Path) -> None:
    image = tmp_path / name
    image.parent.mkdir(exist_ok=True)
    Image.fromarray(GREY).save(image, {".png": "PNG", ".bmp": "BMP"}.get(image.suffix, "PPM"))
    for text in (f'image: "{name}" # the ground floor\n', f'image: "{image}"\n'):
        _, walls = read_occupancy(saved(tmp_path, text + "resolution: 0.5\n" + ORIGIN + TAIL, None))
        assert borders(walls, 0.5, (-1.0, 2.0, 0.0)) == sides((GREY < 89).tolist())


@pytest.mark.parametrize("yaw", [0.0, 3.0])
@pytest.mark.parametrize("negate", [False, True])
@pytest.mark.parametrize("mode", ["trinary", "scale", "raw"])
@pytest.mark.parametrize("kind", ["L", "1", "LA", "P", "P with alpha", "RGB", "RGBA", "I;16"])
def test_pixels_become_walls_as_in_map_server(
    kind: str, mode: str, negate: bool, yaw: float, tmp_path: Path
) -> None:
    if mode == "raw" and negate:
        with pytest.raises(
            SimulatorError,
            match="negate: expected 0 in mode raw, where map_server and nav2_map_server disagree",
        ):
            read_occupancy(
                saved(
                    tmp_path, HEAD + ORIGIN + TAIL.replace("negate: 0", "negate: 1") + "mode: raw"
                )
            )
        return
    rng = np.random.default_rng(7)
    if kind == "I;16":
        table = rng.integers(0, 256, (9, 7)).astype(np.uint16) * 257
        image = Image.fromarray(table)
        pixels = (table[:, :, None] / 257).tolist()
    else:
        base, _, clear = kind.partition(" ")
        source = Image.fromarray(
            rng.choice([0, 40, 60, 100, 140, 200, 255], (9, 7, 4)).astype(np.uint8)
        )
        image = source.convert("RGB").quantize(12) if base == "P" else source.convert(base)
        if clear:
            image.info["transparency"] = bytes([255, 128, 0, 255])
        pixels = np.asarray(
            image.convert("RGBA" if clear or base in ("LA", "RGBA") else "RGB")
        ).tolist()
    image.save(
        tmp_path / "map.png",
        **({"transparency": image.info["transparency"]} if "transparency" in image.info else {}),
    )
    path = saved(
        tmp_path,
        f"image: map.png\nresolution: 0.25\norigin: [3.0, -2.0, {yaw}]\nnegate: {int(negate)}\n"
        f"occupied_thresh: 0.7\nfree_thresh: 0.2\nmode: {mode}\n",
    )
    cells = [
        [
            cell(
                tuple(pixel) if mode == "trinary" else tuple(pixel[:3]),
                pixel[3] if len(pixel) == 4 else 255,
                negate,
                0.7,
                0.2,
                mode,
            )
            for pixel in row
        ]
        for row in pixels
    ]
    between = sum(0 < value < 100 for row in cells for value in row)
    occupied = [[value == 100 for value in row] for row in cells]
    with warnings.catch_warnings(record=True, action="always") as said:
        if not any(map(any, occupied)):
            with pytest.raises(SimulatorError, match="without occupied cells"):
                read_occupancy(path)
            return
        _, walls = read_occupancy(path)
    assert borders(walls, 0.25, (3.0, -2.0, yaw)) == sides(occupied)
    assert [
        f"{between:,} of 63 cells are between free and occupied" in str(warning.message)
        for warning in said
    ] == [True] * bool(between)


def test_yaw_turns_a_map_about_its_lower_left_corner(tmp_path: Path) -> None:
    world = World.named(str(saved(tmp_path, HEAD + f"origin: [1, 2, {math.pi / 2}]\n" + TAIL)))
    assert world.bounds == pytest.approx((-1.0, 2.0, 1.0, 4.0))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "resolution: 0.1\n" + ORIGIN + TAIL,
            "image: expected the path of an image, seen from the YAML file, got none",
        ),
        ("image:\nresolution: 0.1\n" + ORIGIN + TAIL, "image: expected the path"),
        ("image: [a, b]\nresolution: 0.1\n" + ORIGIN + TAIL, "image: expected the path"),
        (
            "image: map.pgm\n" + ORIGIN + TAIL,
            "resolution: expected metres per pixel, above 0, got none",
        ),
        (
            "image: map.pgm\nresolution: no\n" + ORIGIN + TAIL,
            "resolution: expected metres per pixel, above 0, got 'no'",
        ),
        ("image: map.pgm\nresolution: -1\n" + ORIGIN + TAIL, "resolution: expected"),
        ("image: map.pgm\nresolution: .nan\n" + ORIGIN + TAIL, "resolution: expected"),
        (
            "image: map.pgm\nresolution: 999999\n" + ORIGIN + TAIL,
            "resolution: expected a map of at most 1,000,000 m",
        ),
        (
            HEAD + TAIL,
            r"origin: expected \[x, y, yaw\] in metres and radians, of at most 1,000,000, got none",
        ),
        (HEAD + "origin: [1, 2]\n" + TAIL, r"origin: expected \[x, y, yaw\]"),
        (HEAD + "origin: [1, 2, x]\n" + TAIL, r"origin: expected \[x, y, yaw\]"),
        (HEAD + "origin: [1, 2, .inf]\n" + TAIL, r"origin: expected \[x, y, yaw\]"),
        (HEAD + "origin: 3\n" + TAIL, r"origin: expected \[x, y, yaw\]"),
        (HEAD + "origin: {x: 1, y: 2}\n" + TAIL, r"origin: expected \[x, y, yaw\].*got {'x': '1'"),
        (HEAD + "origin: [[1, 2, 3]]\n" + TAIL, r"origin: expected \[x, y, yaw\]"),
        (HEAD + ORIGIN + TAIL + "resolution: 0.1\n", "'resolution' twice, first in line 2"),
        (
            HEAD + ORIGIN + TAIL + "mode: rawest\n",
            "mode: expected trinary, scale or raw, got 'rawest'",
        ),
        (HEAD + ORIGIN + TAIL + "mode: [raw]\n", "mode: expected trinary, scale or raw"),
        (HEAD + ORIGIN + "negate: 2\n", "negate: expected 0 or 1, got '2'"),
        (
            HEAD + ORIGIN + "occupied_thresh: 65\n",
            "occupied_thresh: expected a threshold from 0 to 1, got '65'",
        ),
        (HEAD + ORIGIN + "free_thresh: -0.1\n", "free_thresh: expected a threshold from 0 to 1"),
        (
            HEAD + ORIGIN + "mode: scale\nfree_thresh: 0.1\n",
            "occupied_thresh: expected a threshold from 0 to 1, got none",
        ),
        (
            HEAD + ORIGIN + "mode: scale\nfree_thresh: 0.7\noccupied_thresh: 0.6\n",
            r"free_thresh: expected less than occupied_thresh \(0.6\)",
        ),
        (
            "image: no.pgm\nresolution: 1\n" + ORIGIN + TAIL,
            "image: .*no.pgm: expected a PGM, PNG or BMP image: No such file",
        ),
        (
            'image: "a\\0b"\nresolution: 1\n' + ORIGIN + TAIL,
            "image: .*expected a PGM, PNG or BMP image: .*null",
        ),
        (
            "image: map.yaml\nresolution: 1\n" + ORIGIN + TAIL,
            "image: .*map.yaml: expected a PGM, PNG or BMP image, got b'image",
        ),
        ("", "no fields in it"),
        ("- 1\n- 2\n", "no fields in it"),
        (
            "a: b: c\n",
            "expected the YAML file of an occupancy map, got mapping values are not allowed",
        ),
        ("image: map.pgm\n--- \nimage: map.pgm\n", "expected a single document"),
        ("[" * 5000, "expected the YAML file of an occupancy map, got"),
        (b"image: \xff\n", "expected the YAML file of an occupancy map, got"),
        (b"image: a\0b\n", "expected the YAML file of an occupancy map, got"),
    ],
)
def test_errors_of_occupancy_maps_name_the_file(
    text: str | bytes, message: str, tmp_path: Path
) -> None:
    with pytest.raises(SimulatorError, match=f"map.yaml: .*{message}"):
        read_occupancy(saved(tmp_path, text))


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (b"GIF89a", "expected a PGM, PNG or BMP image, got b'GIF89a'"),
        (b"", "expected a PGM, PNG or BMP image, got b''"),
        (b"P5 9 9 255\nshort", "truncated"),
        (b"P2 9 9 255\n1 2 3", "not enough image data"),
        (b"P2 2 2 255\n1 2 3 x", "the file is damaged"),
        (b"P2 2 2 255\n1 2 3 400", "the file is damaged"),
        (b"P5 70000 70000 255\n", "expected at most 67,108,864 pixels"),
        (b"P5 9000 9000 255\n", "expected at most 67,108,864 pixels"),
        (b"P5 99999999999 2 255\n", "the file is damaged"),
        (b"P5 2 2 70000\n", "the file is damaged"),
        (b"Pf 1 1 -1.0\n0000", "floating-point numbers"),
        (b"P5 2 2 255\n\xff\xff\xff\xff", "without occupied cells"),
        (b"\x89PNG\r\n\x1a\n" + b"\0" * 30, "image: .*map.pgm"),
    ],
)
def test_damaged_images_are_refused(image: bytes, message: str, tmp_path: Path) -> None:
    path = saved(tmp_path, HEAD + ORIGIN + TAIL, None)
    (tmp_path / "map.pgm").write_bytes(image)
    with pytest.raises(SimulatorError, match=f"map.yaml: .*{message}"):
        read_occupancy(path)


def test_misspelt_field_is_named(tmp_path: Path) -> None:
    with pytest.warns(
        SimulatorWarning,
        match="got others, which are not read: 'free_threshold, occupied_threshold'",
    ):
        read_occupancy(saved(tmp_path, HEAD + ORIGIN + TAIL.replace("thresh:", "threshold:")))


@pytest.mark.parametrize("body", ["binary", "text"])
@pytest.mark.parametrize("white", [1, 100, 255, 1000, 65535])
def test_maxval_of_a_pgm_is_white(white: int, body: str, tmp_path: Path) -> None:
    table = np.where(GREY < 89, 0, white)
    pixels = (
        " ".join(map(str, table.ravel())).encode()
        if body == "text"
        else table.astype("u1" if white < 256 else ">u2").tobytes()
    )
    path = saved(tmp_path, HEAD + ORIGIN + TAIL, None)
    (tmp_path / "map.pgm").write_bytes(
        b"P%d\n# drawn by hand\n4 4\n%d\n" % (2 if body == "text" else 5, white) + pixels
    )
    assert borders(read_occupancy(path)[1], 0.5, (-1.0, 2.0, 0.0)) == sides((GREY < 89).tolist())
