"""Sides of paths: why a place lies right or left of a path, and what rival maps know of it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from test_regions import BLOCK, CORNER, LOG, TOUR, trace_of
from worlds import written

from ssh_abduction import SSHMap, Theory, Trace, export_map, solve
from ssh_abduction.cli import main
from ssh_abduction.data import MapError, together
from ssh_abduction.data.map_parts import Region
from ssh_abduction.explain import explain_place
from ssh_abduction.rivals import Listing, difference, shared_sides

ACES3 = Path(__file__).parent.parent / "examples" / "aces3-route.jsonl"


SHARED = "all maps know in 5 cases on which side of a path a place lies, and some maps in 11 more"


@pytest.mark.parametrize(
    ("text", "place", "path", "said"),
    [
        (
            CORNER,
            2,
            0,
            "place 2 lies right of path 0+: step 1 turned right from path 0+ onto path 1+ at place "
            "1, and place 2 is ahead on path 1+",
        ),
        (
            CORNER,
            3,
            1,
            "place 3 lies left of path 1+: step 3 turned left from path 1+ onto path 2+ at place "
            "2, and place 3 is ahead on path 2+",
        ),
        (
            CORNER,
            0,
            1,
            "place 0 lies right of path 1+: step 1 turned right from path 0+ onto path 1+ at place "
            "1, so path 0- leaves path 1+ on the right there, and place 0 is ahead on path 0-",
        ),
        (CORNER, 1, 0, "place 1 is on path 0"),
        (
            CORNER,
            3,
            0,
            "no turn shows on which side of path 0 place 3 lies: no path that leaves path 0 by a "
            "turn is known to have place 3 ahead",
        ),
    ],
)
def test_explain_place_says_why_a_place_is_on_a_side(
    text: str, place: int, path: int, said: str
) -> None:
    assert str(explain_place(written(text), place, path)) == said


def test_explain_place_lists_sides_and_regions() -> None:
    told = explain_place(written(BLOCK), 0).sentences
    assert [sentence.partition(":")[0] for sentence in told] == [
        "place 0 lies right of path 2+",
        "place 0 lies right of path 3+",
        "place 0 lies in region 0",
        "place 0 lies in region 1",
        "place 0 lies in region 4",
    ]
    told = explain_place(trace_of(TOUR), 1, theory=LOG).sentences
    assert told[-1].endswith("behind place 0, in region 0: all links to it lead through place 0")


@pytest.mark.slow
def test_explain_place_counts_maps_with_a_side() -> None:
    trace = Trace.load(ACES3)
    maps = solve(trace).maps
    for place in maps[0].places[::4]:
        for found in explain_place(trace, place).sides:
            step = next(t for t, s in enumerate(maps[0].labels) if maps[0].place_of(t) == place)
            along = next(
                t for t, s in enumerate(maps[0].labels) if maps[0].dstates[s].path == found.path
            )
            agree = 0
            for m in maps:
                s = m.dstates[m.labels[along]]
                assert s.path is not None
                assert s.direction is not None
                way = s.direction if found.side == "right" else -s.direction
                agree += m.place_of(step) in m.right_of(s.path, way)
            assert found.agree == agree


def test_explain_place_of_an_impossible_trace_says_so() -> None:
    found = explain_place(written("a T b A c A d"), 0)
    assert str(found) == "the trace has no map, so nothing is known about place 0"


@pytest.mark.filterwarnings("ignore:traces 1 and 2 have the same steps")
def test_explain_place_is_about_the_known_maps() -> None:
    """The minimal map has one place."""
    joint = together([Trace.from_steps("a", [])] * 2)
    known = solve(joint, Theory(elsewhere=[(0, 1)])).maps
    assert explain_place(joint, 1, known=known).maps == 1


def test_explain_place_refuses_unknown_places_and_paths() -> None:
    with pytest.raises(MapError, match="place: expected a place of the first minimal map, got 9"):
        explain_place(written(CORNER), 9)
    with pytest.raises(MapError, match=r"path: .* got 7; the map has paths 0, 1 and 2"):
        explain_place(written(CORNER), 0, 7)


def test_explain_prints_sides_of_a_place(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    written(CORNER).save("corner.jsonl")
    assert main(["explain", "corner.jsonl", "p2", "path0"]) == 0
    assert capsys.readouterr().out.startswith("place 2 lies right of path 0+: step 1 turned right")
    assert main(["explain", "corner.jsonl", "p2", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["sides"][0]["steps"] == [1, 2]
    assert main(["explain", "corner.jsonl", "p9"]) == 1
    assert "expected a place of the first minimal map, got 9" in capsys.readouterr().err
    written("a T b A c A d").save("none.jsonl")
    assert main(["explain", "none.jsonl", "p0"]) == 20
    for words in (["p2", "path0", "path1"], ["region0"]):
        assert main(["explain", "corner.jsonl", *words]) == 1
        told = capsys.readouterr().err
        assert "in which regions it is, or a place and a path, as in p7 path2" in told


def test_show_lists_regions(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    solve(written(CORNER)).save(tmp_path / "maps.json")
    assert main(["show", str(tmp_path / "maps.json")]) == 0
    assert "\n  region 0: place 0, right of path 1+, behind place 1\n" in capsys.readouterr().out


def test_shared_sides_separate_certain_from_possible_sides() -> None:
    found = shared_sides(Listing.of(solve(Trace.load(ACES3))))
    assert found is not None
    assert found.proven
    assert {side.share for side in found.possible} == {0.5}
    assert f"{SHARED}: " in str(found)
    # A single map is certain of all its sides.
    single = shared_sides(Listing.of(solve(written(BLOCK))))
    assert single is not None
    assert [(side.step, side.along, side.side) for side in single.forced][:2] == [
        (0, 3, "right"),
        (0, 5, "right"),
    ]
    assert not single.possible
    assert shared_sides(Listing.of(solve(written(BLOCK), Theory.causal()))) is None


def test_difference_finds_maps_that_differ_only_in_sides() -> None:
    ssh_map = solve(written(CORNER))[0]
    blind = replace(ssh_map, regions=())
    found = difference(ssh_map, blind)
    assert found.same
    assert [str(side) for side in found.sides[0]][:1] == [
        "the place of step 0 lies right of the path of step 2"
    ]
    assert found.sides[1] == ()
    assert "only the first map knows that the place of step 0 lies right" in str(found)
    assert not difference(ssh_map, replace(ssh_map, regions=None)).lines


def test_compare_names_sides_in_some_maps(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    trace = Trace.load(ACES3)
    solve(trace).save("maps.json")
    assert main(["compare", "maps.json"]) == 0
    assert f"  {SHARED}: " in capsys.readouterr().out
    assert main(["compare", "maps.json", "--json"]) == 0
    sides = json.loads(capsys.readouterr().out)["sides"]
    assert (len(sides["forced"]), len(sides["possible"]), sides["proven"]) == (5, 11, True)


def test_compare_prints_maps_that_differ_only_in_sides(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    solution = solve(written(CORNER))
    solution.save("maps.json")
    replace(solution, maps=(replace(solution[0], regions=()),)).save("blind.json")
    assert main(["compare", "maps.json", "blind.json"]) == 0
    out = capsys.readouterr().out
    assert "the map is the same in both" in out
    assert "the first maps of both are the same, except:" in out


def test_name_of_a_region_is_shown_by_all_verbs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    written(CORNER).save("corner.jsonl")
    assert main(["solve", "corner.jsonl", "-o", "maps.json"]) == 0
    assert main(["name", "maps.json", "region3", "east ward"]) == 0
    assert main(["solve", "corner.jsonl", "-o", "maps.json"]) == 0
    ssh_map = SSHMap.from_dict(json.loads(Path("maps.json").read_text())["maps"][0])
    assert ssh_map.name_of("region", 3) == "east ward"
    assert ssh_map.renumbered().names == ssh_map.names
    capsys.readouterr()
    assert main(["show", "maps.json"]) == 0
    assert "  region 3 (east ward): place 3, right of path 1-" in capsys.readouterr().out
    assert main(["route", "maps.json", "--from", "p0", "--to", "p3", "--by", "places"]) == 0
    assert "enter region 3 (east ward) through place 2" in capsys.readouterr().out
    for to in ("svg", "dot"):
        assert "region 3 (east ward)" in export_map(ssh_map, to)
    assert main(["name", "maps.json", "region9", "nowhere"]) == 1
    assert "expected a region of the map" in capsys.readouterr().err
    wide = Region(0, (0, 3), (), None, ())
    inner = [Region(i, (p,), (), None, (0,)) for i, p in ((1, 0), (2, 3))]
    solution, nested = solve(written(CORNER)), replace(ssh_map, regions=(wide, *inner), names=())
    Path("nested").mkdir()
    replace(solution, maps=(nested,)).save("nested/maps.json")
    assert main(["name", "nested", "region0", "wing"]) == 1
    assert "whose places all belong to regions that are smaller" in capsys.readouterr().err


@pytest.mark.slow
def test_explain_place_without_time_uses_known_maps() -> None:
    """There is no time for a search. Without the known maps, the answer is about a larger map."""
    trace = Trace.load(ACES3)
    known = solve(trace).maps
    searched, told, anew = (
        [side.sentence for side in explain_place(trace, 0, **more).sides]
        for more in ({}, {"time_limit": 1e-9, "known": known}, {"time_limit": 1e-9})
    )
    assert anew != told == searched
