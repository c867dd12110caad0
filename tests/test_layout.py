"""Layouts: paths are straight, turns go to their side, and nothing lies on anything else."""

from __future__ import annotations

import math
import re
import sys
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import replace
from itertools import combinations, pairwise
from pathlib import Path

import networkx as nx
import numpy as np
import pytest
from worlds import COMB, HEADINGS, PLUS, SQUARE, TEE, TOURS, TWO_BLOCKS, Streets, drive, streets

from ssh_abduction import SSHMap, Theory, Trace, solve
from ssh_abduction.data import DState, MapError, MapPath
from ssh_abduction.data.maps import Fault, Fit, Pose
from ssh_abduction.output import plot, to_networkx, to_pandas, to_svg
from ssh_abduction.output.layout import Layout, layout
from ssh_abduction.output.roads import Roads

pytestmark = pytest.mark.usefixtures("careful_drawings")
SIX = streets(
    *((f"{x}{y}", "E", f"{x + 1}{y}") for x in range(5) for y in range(6)),
    *((f"{x}{y}", "S", f"{x}{y + 1}") for x in range(6) for y in range(5)),
)


def mapped(edges: Streets) -> SSHMap:
    """The true map of streets at right angles, without solving: a path for each line of streets."""
    faced = [(place, heading) for place in edges for heading in HEADINGS]
    number = {pair: i for i, pair in enumerate(faced)}
    lines: list[list[str]] = []
    course: dict[tuple[str, str], tuple[int, int]] = {}
    for place in edges:
        for ahead, back in ("EW", "SN"):
            if back not in edges[place]:
                line = [place]
                while ahead in edges[line[-1]]:
                    line.append(edges[line[-1]][ahead])
                course |= {(p, ahead): (len(lines), 1) for p in line} | {
                    (p, back): (len(lines), -1) for p in line
                }
                lines.append(line)
    ids = {place: i for i, place in enumerate(edges)}
    dstates = tuple(DState(i, f"v{i}", ids[p], *course[p, h]) for (p, h), i in number.items())
    turns = [
        (i, name, number[p, HEADINGS[(HEADINGS.index(h) + k) % 4]])
        for (p, h), i in number.items()
        for name, k in (("right", 1), ("left", 3))
    ]
    travels = [
        (i, "travel", number[edges[p][h], h]) for (p, h), i in number.items() if h in edges[p]
    ]
    paths = tuple(MapPath(i, tuple(ids[p] for p in line)) for i, line in enumerate(lines))
    return SSHMap(tuple(range(len(faced))), dstates, (*turns, *travels), tuple(ids.values()), paths)


def spiral(turns: int) -> SSHMap:
    """Streets in a spiral of right turns."""
    places = range(turns + 1)
    edges = streets(*((f"p{i}", "ESWN"[i % 4], f"p{i + 1}") for i in places[:-1]))
    return mapped(edges)


def crossings(ssh_map: SSHMap, found: Layout) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """Pairs of streets without a common end that touch."""
    ends = [pair for path in ssh_map.paths for pair in pairwise(path.order)]
    touching = []
    for e, f in combinations(ends, 2):
        if set(e) & set(f):
            continue
        a, b, c, d = (np.array(found.places[p]) for p in (*e, *f))
        matrix = np.column_stack((b - a, c - d))
        if abs(np.linalg.det(matrix)) > 1e-9:
            s, t = np.linalg.solve(matrix, c - a)
            if -1e-9 <= s <= 1 + 1e-9 and -1e-9 <= t <= 1 + 1e-9:
                touching.append((e, f))
        elif abs(np.linalg.det(np.column_stack((b - a, c - a)))) < 1e-9:
            along = sorted((float((p - a) @ (b - a)), i < 2) for i, p in enumerate((a, b, c, d)))
            if along[0][1] != along[1][1]:
                touching.append((e, f))
    return touching


def check(ssh_map: SSHMap, found: Layout, turns: Mapping[str, float] | None = None) -> None:
    """Check that places are apart, paths straight, and turns on their side."""
    assert (
        min((math.dist(*pair) for pair in combinations(found.places.values(), 2)), default=1.0)
        > 0.9
    )
    for path in ssh_map.paths:
        points = np.array([found.places[p] for p in path.order])
        if len(points) > 1:
            ways = np.diff(points, axis=0)
            assert np.allclose(
                ways / np.linalg.norm(ways, axis=1)[:, None],
                ways[0] / np.linalg.norm(ways[0]),
                atol=1e-6,
            )
            for s in ssh_map.dstates:
                if s.path == path.id:
                    heading = found.dstates[s.id][2]
                    assert heading is not None
                    assert s.direction is not None
                    assert np.allclose(
                        (math.cos(heading), math.sin(heading)),
                        s.direction * ways[0] / np.linalg.norm(ways[0]),
                        atol=1e-6,
                    )
    known = {"right": 90.0, "left": -90.0, "around": 180.0} | dict(turns or {})
    for s, action, x in ssh_map.links:
        if action in known:
            before, after = found.dstates[s][2], found.dstates[x][2]
            assert before is not None
            assert after is not None
            assert abs(
                math.remainder(before - after - math.radians(known[action]), math.tau)
            ) < math.radians(46)


@pytest.mark.parametrize(
    "world",
    [TWO_BLOCKS, SQUARE, TEE, PLUS, COMB],
    ids=["two blocks", "square", "tee", "plus", "comb"],
)
def test_layout_of_true_maps_keeps_the_geometry(world: Streets) -> None:
    ssh_map = mapped(world)
    found = layout(ssh_map)
    check(ssh_map, found)
    assert not crossings(ssh_map, found)


@pytest.mark.parametrize("tour", ["square", "tee", "comb"])
def test_layout_has_straight_paths_and_correct_turns(tour: str) -> None:
    trace = drive(*TOURS[tour], stars=True)
    for ssh_map in solve(trace, Theory.circumscriptive()).maps:
        found = layout(ssh_map, trace)
        check(ssh_map, found)
        assert not crossings(ssh_map, found)
        assert not found.metric
        assert found == layout(ssh_map, trace) == layout(ssh_map)


def test_layout_of_six_by_six_blocks_is_a_grid() -> None:
    ssh_map = mapped(SIX)
    found = layout(ssh_map)
    check(ssh_map, found)
    places = list(SIX)
    (x0, y0) = places[0]
    for place, (x, y) in zip(places, found.places.values(), strict=True):
        assert (x, y) == pytest.approx(
            (int(y0) - int(place[1]), int(x0) - int(place[0]))
        )  # the first dstate faces north, and right on the page


@pytest.mark.parametrize("turns", [4, 6, 8])
def test_layout_of_a_spiral_does_not_overlap(turns: int) -> None:
    ssh_map = spiral(turns)
    found = layout(ssh_map)
    check(ssh_map, found)
    assert not crossings(ssh_map, found)


def test_layout_accepts_any_angles() -> None:
    """A triangle with turns of 120 degrees, first by actions and then by headings at places."""
    dstates = tuple(DState(i, f"v{i}", (i + 1) // 2 % 3, i // 2, 1) for i in range(6))
    links = tuple((i, "travel" if i % 2 == 0 else "turn", (i + 1) % 6) for i in range(6))
    triangle = SSHMap(
        tuple(range(6)),
        dstates,
        links,
        (0, 1, 2),
        tuple(MapPath(i, (i, (i + 1) % 3)) for i in range(3)),
    )
    found = layout(triangle, {"turn": 120})
    check(triangle, found, {"turn": 120})
    sides = [math.dist(*pair) for pair in combinations(found.places.values(), 2)]
    assert sides == pytest.approx([1, 1, 1])
    (ax, ay), (bx, by), (cx, cy) = (found.places[p] for p in range(3))
    assert (bx - ax) * (cy - ay) - (by - ay) * (cx - ax) < 0  # clockwise
    told = replace(
        triangle, dstates=tuple(replace(s, heading=120 * (s.id % 2 == 0)) for s in dstates)
    )
    assert np.allclose(list(layout(told).places.values()), list(found.places.values()))


def test_layout_straightens_single_streets_of_a_bent_path() -> None:
    """A map with few paths may join the north and the south side of a square to one path."""
    square = mapped(SQUARE)
    north, south = (
        next(path for path in square.paths if path.id == square.dstates[4 * place + 1].path)
        for place in (0, 3)
    )
    dstates = tuple(replace(s, path=north.id) if s.path == south.id else s for s in square.dstates)
    others = tuple(path for path in square.paths if path not in (north, south))
    ssh_map = replace(
        square, dstates=dstates, paths=(MapPath(north.id, north.order + south.order), *others)
    )
    found = layout(ssh_map)
    corners = {tuple(round(x) for x in spot) for spot in found.places.values()}
    assert len(corners) == 4
    assert [
        math.dist(found.places[p], found.places[q])
        for path in square.paths
        for p, q in pairwise(path.order)
    ] == pytest.approx([1.0] * 4)


def test_layout_uses_given_poses() -> None:
    square = mapped(SQUARE)
    poses = tuple(Pose(3.0 * (s.place or 0), 0.5, 0.1 * s.id) for s in square.dstates)
    found = layout(replace(square, fit=Fit(1.0, 1, 0.5, poses=poses)))
    assert found.metric
    assert found.places == {p: (3.0 * p, 0.5) for p in square.places}
    assert found.dstates[3] == (0.0, 0.5, pytest.approx(0.3))
    assert layout(replace(square, fit=Fit(1.0, 1, 0.5))).metric is False


def test_layout_places_unconnected_parts_below_each_other() -> None:
    square = mapped(SQUARE)
    far = [
        replace(s, id=s.id + 16, place=(s.place or 0) + 4, path=(s.path or 0) + 4)
        for s in square.dstates
    ]
    links = [(s + 16, action, x + 16) for s, action, x in square.links]
    paths = [MapPath(p.id + 4, tuple(q + 4 for q in p.order)) for p in square.paths]
    both = replace(
        square,
        dstates=(*square.dstates, *far),
        links=(*square.links, *links),
        places=tuple(range(8)),
        paths=(*square.paths, *paths),
    )
    found = layout(both)
    check(both, found)
    assert min(found.places[p][1] for p in range(4)) > max(found.places[p][1] for p in range(4, 8))


def test_layout_refuses_wrong_turns() -> None:
    with pytest.raises(MapError, match=r"turns\['veer'\]: expected"):
        layout(mapped(SQUARE), {"veer": "sideways"})
    with pytest.raises(MapError, match=r"turns\['veer'\]: expected"):
        layout(mapped(SQUARE), {"veer": math.nan})


def test_graph_of_places_has_positions_and_streets() -> None:
    ssh_map = mapped(SQUARE)
    graph = to_networkx(ssh_map, "places")
    assert nx.is_isomorphic(graph, nx.cycle_graph(4))
    assert {(frozenset((p, q)), data["path"]) for p, q, data in graph.edges(data=True)} == {
        (frozenset(path.order), path.id) for path in ssh_map.paths
    }
    assert all(
        data["travelled"] and data["order"] == 0 and "metres" not in data
        for _, _, data in graph.edges(data=True)
    )
    assert nx.get_node_attributes(graph, "pos") == layout(ssh_map).places
    assert graph.nodes[1]["dstates"] == tuple(s.id for s in ssh_map.dstates if s.place == 1)
    posed = replace(
        ssh_map,
        fit=Fit(
            1.0, 1, 0.5, poses=tuple(Pose(3.0 * (s.place or 0), 0.5, 1.0) for s in ssh_map.dstates)
        ),
    )
    metric = to_networkx(posed, "places")
    assert metric.graph["metric"] is True
    assert {data["metres"] for _, _, data in metric.edges(data=True)} == {3.0, 9.0}


def test_map_gives_the_place_of_a_step() -> None:
    trace = drive(*TOURS["square"])
    (ssh_map,) = solve(trace).maps
    assert [ssh_map.place_of(step) for step in range(len(trace))] == [
        ssh_map.dstates[label].place for label in ssh_map.labels
    ]
    for step in (-1, len(trace), 0.5, True):
        with pytest.raises(MapError, match=f"expected a step from 0 to {len(trace) - 1}, got"):
            ssh_map.place_of(step)  # type: ignore[arg-type]


def test_drawing_marks_faults_and_escapes_views() -> None:
    square = mapped(SQUARE)
    doubted = replace(square, faults=(Fault(3, "misread", "<script>alert(1)</script>", "v3"),))
    marks = [
        g
        for g in ET.fromstring(to_svg(doubted)).iter("{http://www.w3.org/2000/svg}g")
        if g.attrib.get("class") == "fault"
    ]
    assert [next(iter(g)).text for g in marks] == [
        "the view at step 3 is misread: <script>alert(1)</script>, expected v3"
    ]
    assert "<script" not in to_svg(doubted)
    assert 'class="fault"' not in to_svg(square)
    posed = replace(
        doubted,
        fit=Fit(
            1.0, 1, 0.5, poses=tuple(Pose(3.0 * (s.place or 0), 0.5, 1.0) for s in square.dstates)
        ),
    )
    assert to_svg(posed).count('class="fault"') == 1


def test_matplotlib_axes_hold_the_drawn_places_and_dstates() -> None:
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    from matplotlib import pyplot

    ssh_map = mapped(SQUARE)
    _, ax = pyplot.subplots()
    assert plot(ssh_map, ax) is ax
    assert {text.get_text() for text in ax.texts} == {
        *map(str, ssh_map.places),
        *(f"x{s.id}" if s.id else "x0 start" for s in ssh_map.dstates),
        *(f"path {path.id}" for path in ssh_map.paths),
    }
    assert plot(solve(drive(*TOURS["square"]), Theory.causal()).maps[0]).texts
    pyplot.close("all")


def test_missing_library_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("pandas", "matplotlib"):
        monkeypatch.setitem(sys.modules, module, None)
    ssh_map = mapped(SQUARE)
    with pytest.raises(MapError, match="expected the package pandas, got none; pip install pandas"):
        to_pandas(ssh_map)
    with pytest.raises(
        MapError,
        match=r"expected the package matplotlib, got none; pip install '\.\[plot\]'",
    ):
        plot(ssh_map)


def test_table_has_a_row_for_each_step() -> None:
    pytest.importorskip("pandas")
    trace = Trace.load(
        Path(__file__).parent.parent / "examples" / "notched-rectangle.jsonl"
    ).prefix(20)
    (ssh_map,) = solve(trace).maps
    table = to_pandas(ssh_map)
    assert list(table["dstate"]) == list(ssh_map.labels)
    assert list(table["view"]) == list(trace.views)
    assert table["heading"].isna().all()


def without_paths(ssh_map: SSHMap) -> SSHMap:
    """The map as by a theory that gives up all axioms on paths."""
    dstates = tuple(replace(s, path=None, direction=None) for s in ssh_map.dstates)
    return replace(ssh_map, paths=(), dstates=dstates, regions=None)


def test_map_without_paths_is_laid_out_along_its_travels() -> None:
    (ssh_map,) = solve(
        Trace.load(Path(__file__).parent.parent / "examples/notched-rectangle.jsonl")
    )
    at = layout(without_paths(ssh_map)).places
    sides = [math.dist(at[p], at[(p + 1) % 4]) for p in range(4)]
    assert sides == pytest.approx([1.0] * 4)
    assert math.dist(at[0], at[2]) == pytest.approx(math.sqrt(2))
    assert "path" not in re.sub("<path.*?>", "", to_svg(without_paths(ssh_map)))
    # Both directions of a street are roads, as of a map with paths.
    roads = [
        {(road.start, road.end) for road in Roads.of(m, "places").roads}
        for m in (ssh_map, without_paths(ssh_map))
    ]
    assert roads[0] == roads[1]
