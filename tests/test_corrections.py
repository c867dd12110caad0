"""Names and corrections by a person: the file, its effect on solve, and where names are shown."""

from __future__ import annotations

import json
import math
import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from ssh_abduction import Solution, Theory, Trace, check, export_map, route, solve
from ssh_abduction.cli import main
from ssh_abduction.cli.judge import _with_steps
from ssh_abduction.data import (
    Corrections,
    MapError,
    Odometry,
    SSHMap,
    TheoryError,
    drives_of,
    load_corrections,
    save_corrections,
    together,
)
from ssh_abduction.data.corrections import from_yaml, to_yaml
from ssh_abduction.data.drives import fingerprints_of
from ssh_abduction.data.map_parts import Name, Region
from ssh_abduction.data.star import Gateway, with_gateway
from ssh_abduction.output import to_dot, to_networkx, to_svg
from ssh_abduction.output.cards import map_card
from ssh_abduction.page.content import content_of

MONDAY = Trace.from_steps("abcd", ["travel", "around", "travel"], name="monday")
TUESDAY = Trace.from_steps("bcd", ["around", "travel"], name="tuesday")
# Three corners of a triangle, as the robot sees them: it turns right at each.
CORNER, TURNED = (0, 1, 1, 0), (1, 1, 0, 0)
ROUND = Trace.from_steps(
    "ccccccc",
    ["travel", "right"] * 3,
    stars=[TURNED, CORNER, TURNED, CORNER, TURNED, CORNER, TURNED],
    name="round",
)
JOINT = together([MONDAY, TUESDAY])
MARKS = fingerprints_of(JOINT)
HEAD = f"format: ssh-corrections\nversion: 1\ndrives: {json.dumps(MARKS)}\n"


def read(text: str) -> Corrections:
    return from_yaml(HEAD + text, "c.yaml")


def seeing(name: str, first: tuple[int, ...], last: tuple[int, ...]) -> Trace:
    """A drive along a corridor and back, with the stars of its first and last step."""
    stars = [first, (0, 0, 1, 0), (1, 0, 0, 0), last]
    return Trace.from_steps("abcd", ["travel", "around", "travel"], stars=stars, name=name)


@pytest.fixture(scope="module")
def solved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with traces and their joint map, in which the b of Tuesday is that of Monday."""
    folder = tmp_path_factory.mktemp("drives")
    for trace in (MONDAY, TUESDAY, ROUND):
        trace.save(folder / f"{trace.name}.jsonl")
    (folder / "building").mkdir()
    assert main(solving(folder)) == 0
    return folder


@pytest.fixture
def folder(solved: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Path:
    """A copy of this folder that a test may change."""
    capsys.readouterr()
    return shutil.copytree(solved, tmp_path, dirs_exist_ok=True)


def solving(folder: Path, *names: str) -> list[str]:
    files = [str(folder / f"{name}.jsonl") for name in names or ("monday", "tuesday")]
    return ["solve", *files, "--together", "-o", str(folder / "building" / "maps.json")]


def test_typos_of_things_name_what_is_near(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    maps = str(folder / "building" / "maps.json")
    for words, said in (
        (["explain", maps, "p0", "p99"], "p99: expected a place of the map"),
        (["explain", maps, "p0", "pth1"], "show lists all; did you mean path1"),
        (["explain", maps, "p0", "x99y"], "step 'x99y': expected a step"),
        (["name", maps, "regoin1", "x"], "did you mean region1"),
        (["name", maps, "1", "x"], "write p1, d1 or monday:1"),
        (["name", maps, "wing0", "x"], "a wing has no name: name its corridor"),
        (["name", maps, "junction0", "x"], "a junction has no name: name one of its places"),
    ):
        assert main(words) == 1
        assert said in capsys.readouterr().err
    assert _with_steps(["p0", "monday:1"], maps) == ["monday:0", "monday:1"]
    assert _with_steps(["p0", "path0"], maps) == ["p0", "path0"]


def test_corrections_survive_a_round_trip(tmp_path: Path) -> None:
    said = (
        Corrections(MARKS)
        .with_name("Küche: 2", "place", "monday:1")
        .with_pair("same", "monday:3", "tuesday:2")
        .with_pair("different", "monday:1", "tuesday:0")
        .with_gateway(False, [("monday:1", 90.0), ("monday:2", 135.0)])
    )
    save_corrections(said, tmp_path)
    assert load_corrections(tmp_path / "corrections.yaml") == said == from_yaml(to_yaml(said))
    noted = read("same:\n- steps: [monday:3, tuesday:2]\n  note: I saw it\n")
    assert noted.pairs[0].note == "I saw it"
    assert from_yaml(to_yaml(noted)) == noted


def test_new_name_or_gateway_replaces_the_old_one() -> None:
    said = Corrections(MARKS).with_name("hall", "place", "monday:1")
    assert [n.name for n in said.with_name("kitchen", "place", "monday:1").names] == ["kitchen"]
    with pytest.raises(
        MapError, match=r"another name than 'hall', as names\[0\], the place of monday:1, has it"
    ):
        said.with_name("hall", "place", "monday:3")
    both = said.with_name("den", "place", "monday:3")  # the first name of a place counts
    renamed = both.with_name("kitchen", "place", "monday:1")
    assert [n.name for n in renamed.names] == ["kitchen", "den"]
    for kind in ("path", "region"):
        with pytest.raises(MapError, match=f"got name 'hall' of the {kind} of monday:3; rename"):
            said.with_name("hall", kind, "monday:3")
        assert len(said.with_name("long hall", kind, "monday:3").names) == 2
    closed = said.with_gateway(False, [("monday:1", 90.0)])
    assert [g.is_open for g in closed.with_gateway(True, [("monday:1", 90.0)]).gateways] == [True]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", None),
        ("names:\n- {name: a, place: monday:1}\n- {name: a, place: tuesday:1}\n", "another name"),
        ("names:\n- {name: a, place: monday:1}\n- {name: a, region: monday:1}\n", "another name"),
        ("names:\n- {name: a, place: monday:1}\n- {name: b, place: monday:1}\n", "one name for"),
        ("names:\n- {name: a}\n", r"names\[0\]: expected one of place, path, region"),
        ("names:\n- {name: a, place: p4}\n", r"names\[0\]: step: expected a drive, a colon"),
        ("names: kitchen\n", "names: expected a list"),
        ("names:\n- {name: a, place: monday:1}\nnames: []\n", "'names' twice, first in line"),
        ("same:\n- [monday:1]\n", r"same\[0\]: expected two steps"),
        ("same:\n- [monday:1, monday:01]\n", r"same\[0\]: expected two different steps"),
        ("gateways:\n- {closed: {monday:1: up}}\n", "expected ahead, right, back, left, or degr"),
        ("gateways:\n- {monday:1: left}\n", "expected only open, closed, note, got 'monday:1'"),
        ("gateways:\n- open: {}\n", r"gateways\[0\].open: expected steps and directions, such"),
        ("rooms: []\n", "file: expected only format, version"),
        ("same: [\n", "expected YAML, got"),
    ],
)
def test_malformed_corrections_are_refused(text: str, said: str | None) -> None:
    if said is None:
        assert not read(text)
        return
    with pytest.raises(MapError, match=said) as error:
        read(text)
    assert str(error.value).startswith("c.yaml: ")


def test_corrections_of_another_version_are_refused(tmp_path: Path) -> None:
    for wrong in ("version: 2", "version: true"):
        with pytest.raises(MapError, match=r"version: expected 1 .*, got"):
            from_yaml(HEAD.replace("version: 1", wrong))
    with pytest.raises(MapError, match='format: expected "ssh-corrections", got None'):
        from_yaml("version: 1")
    with pytest.raises(MapError, match="expected a file of corrections"):
        load_corrections(tmp_path)


def test_corrections_of_another_map_are_refused(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    said = Corrections(MARKS).with_name("kitchen", "place", "monday:1")
    with pytest.raises(MapError, match=r"written for, 'monday', 'tuesday', got round"):
        solve(ROUND, corrections=said)
    with pytest.raises(
        MapError, match="got other steps of monday; the file belongs to another map"
    ):
        solve(replace(TUESDAY, name="monday"), corrections=said)
    with pytest.raises(MapError, match="got friday; friday has the steps of 'monday': give"):
        solve(replace(MONDAY, name="friday"), corrections=said)
    save_corrections(said, folder / "building")
    assert main(solving(folder, "round")) == 1
    assert "the file belongs to another map" in capsys.readouterr().err
    for unknown in ("sunday:1", "monday:9"):
        with pytest.raises(MapError, match=r"sunday:1|expected 0 to 3"):
            solve(JOINT, corrections=said.with_name("den", "place", unknown))


@pytest.mark.filterwarnings("always")
def test_names_of_another_map_are_not_shown(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_corrections(
        Corrections(fingerprints_of(ROUND)).with_name("kitchen", "place", "round:1"),
        folder / "building",
    )
    assert main(["show", str(folder / "building" / "maps.json")]) == 0
    told = capsys.readouterr()
    assert "its names are not used" in told.err
    assert "kitchen" not in told.out


def test_solve_obeys_recorded_corrections(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    building = str(folder / "building")
    assert main(["name", building, "p1", "kitchen"]) == 0
    assert main(["correct", building, "--different", "monday:1,tuesday:0"]) == 0
    assert main(["correct", building]) == 0
    assert capsys.readouterr().out.splitlines()[-2:] == [
        "name 'kitchen' of the place of monday:1 [place 1 (kitchen)]",
        "different: monday:1 [place 1 (kitchen)], tuesday:0 [place 1 (kitchen)]",
    ]
    assert main(["correct", building, "--different", "monday:1,tuesday:0"]) == 0
    assert capsys.readouterr().out == "nothing changed: this was said before\n"
    assert main(solving(folder)) == 0
    told = capsys.readouterr()
    assert "obeying 2 corrections of" in told.err
    assert "optimal: 6 dstates" in told.out
    assert "(kitchen)" in told.out
    # With a third drive, all stays. Without Tuesday, what was said about Tuesday has no effect.
    replace(TUESDAY, name="again").save(folder / "again.jsonl")
    assert main([*solving(folder, "monday", "tuesday", "again")]) == 0
    assert "obeying 2 corrections of" in capsys.readouterr().err
    assert main(solving(folder, "monday")) == 0
    assert "obeying 1 correction of" in (told := capsys.readouterr()).err
    assert "1 more is about other drives" in told.err
    elsewhere = ["solve", *solving(folder)[1:4], "--corrections", building, "--json"]
    assert main(elsewhere) == 0
    assert json.loads(capsys.readouterr().out)["theory"]["different"] == [[1, 4]]


def test_corrections_of_a_drive_hold_beside_a_drive_with_other_odometry() -> None:
    monday = Trace.from_steps(
        "abc", ["travel", "around"], displacements=[(5, 0, 0), (0, 0, 3.14)], name="monday"
    )
    monday = replace(monday, odometry=Odometry(along=0.1))
    tuesday = replace(monday, odometry=Odometry(along=0.2), name="tuesday")
    said = Corrections.for_drives(monday).with_name("hall", "place", "monday:1")
    solution = solve([monday, tuesday], corrections=said)
    assert solution[0].names[0].text == "hall"
    other = replace(monday, steps=(*monday.steps[:2], replace(monday.steps[2], view="d")))
    with pytest.raises(MapError, match="got other steps of monday"):
        solve(other, corrections=said)


def test_explain_takes_the_folder_of_maps_that_solve_wrote(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["explain", str(folder / "building"), "monday:1", "tuesday:0"]) == 0
    assert "monday:1 and tuesday:0" in capsys.readouterr().out
    assert main(["explain", str(folder), "monday:1", "tuesday:0"]) == 1
    assert "expected a readable" in capsys.readouterr().err


def test_any_step_at_a_place_renames_it(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    building = str(folder / "building")
    # Monday ends at the place where it began.
    assert main(["name", building, "monday:0", "hall"]) == 0
    assert main(["name", building, "monday:3", "lobby"]) == 0
    assert "place 0, the place of monday:0, is 'lobby'" in capsys.readouterr().out
    assert [n.name for n in load_corrections(building).names] == ["lobby"]


@pytest.mark.filterwarnings("ignore:traces 1 and 2 have the same steps")
def test_corrections_take_names_and_stay_with_their_steps(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The places get other numbers when a drive comes first that sees them in another order."""
    building, maps = folder / "building", str(folder / "building" / "maps.json")
    assert main(solving(folder, "round")) == 0
    for place, name in (("p0", "north hall"), ("p1", "kitchen")):
        assert main(["name", maps, place, name]) == 0
    said = ["--open", "north hall north", "--elsewhere", "kitchen, north hall"]
    assert main(["correct", maps, *said]) == 0
    by_name = load_corrections(building)
    (building / "corrections.yaml").unlink()
    assert main(["correct", maps, "--open", "p0 north", "--elsewhere", "p1,round:0"]) == 0
    by_number = load_corrections(building)
    assert by_name.gateways == by_number.gateways
    assert by_name.pairs == by_number.pairs
    save_corrections(by_name, building)
    replace(ROUND[1:], name="first").save(folder / "first.jsonl")
    assert main(solving(folder, "first", "round")) == 0
    solution = Solution.load(maps)
    assert solution.theory.elsewhere == ((6, 7),)
    hall = solution[0].place_of(6)
    assert hall != 0
    assert solution[0].name_of("place", hall) == "north hall"
    assert main(["name", maps, "kitchen", "pantry"]) == 0
    assert [n.step for n in load_corrections(building).names] == ["round:0", "round:1"]
    capsys.readouterr()
    for verb in (["route", maps, "--to", "panty"], ["correct", maps, "--open", "panty west"]):
        assert main(verb) == 1
        assert "did you mean pantry?" in capsys.readouterr().err
    for wrong, told in (
        ("north hal", "did you mean north hall?"),
        ("path0", "got the path 'path0'"),
    ):
        assert main(["correct", maps, "--elsewhere", f"{wrong},pantry"]) == 1
        assert told in capsys.readouterr().err
    assert main(["explain", maps, "pantry", "path0"]) == 0
    assert capsys.readouterr().out.startswith("place 1 ")
    for words in (["pantri"], ["pantri", "path0"]):
        assert main(["explain", maps, *words]) == 1
        assert "did you mean pantry?" in capsys.readouterr().err


def test_two_names_of_one_place_can_both_be_changed(folder: Path) -> None:
    said = Corrections(MARKS).with_name("start", "place", "monday:0")
    save_corrections(said.with_name("end", "place", "monday:3"), folder / "building")
    assert main(["name", str(folder / "building"), "end", "exit"]) == 0
    assert main(["correct", str(folder / "building"), "--elsewhere", "start,exit"]) == 0
    found = load_corrections(folder / "building")
    assert [n.name for n in found.names] == ["start", "exit"]
    assert found.pairs[0].steps == ("monday:0", "monday:3")


def test_unknown_name_in_place_of_a_step_is_an_error_that_shows_a_step(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for option in ("--same", "--elsewhere"):
        assert main(["correct", str(folder / "building"), option, "kitchen,monday:1"]) == 1
        error = capsys.readouterr().err
        assert "step 'kitchen': expected a step such as monday:0, got 'kitchen'" in error


@pytest.mark.parametrize("name", ["5", "p4", "place 4", "path2", "region 0", "tuesday:2"])
def test_name_that_looks_like_a_number_is_refused(
    name: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["name", str(folder / "building"), "p1", name]) == 1
    assert f"give another one, such as 'room {name}'" in capsys.readouterr().err
    assert not (folder / "building" / "corrections.yaml").exists()


def test_name_follows_its_steps_if_places_are_renumbered() -> None:
    """Solved after Tuesday, the place that Monday first sees has another number."""
    said = Corrections(MARKS).with_name("start", "place", "monday:0")
    (first,) = solve(JOINT, corrections=said)
    (second,) = solve([TUESDAY, MONDAY], corrections=said)
    assert first.name_of("place", first.place_of(0)) == "start"
    assert second.name_of("place", second.place_of(3)) == "start"
    assert first.names[0].id != second.names[0].id
    both = said.with_name("end", "place", "monday:3")  # in this map, both are one place
    (third,) = solve(JOINT, corrections=both)
    assert [n.text for n in third.names] == ["start", "end"]


def test_solve_reports_corrections_that_contradict_the_trace(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    building = str(folder / "building")
    assert main(["correct", building, "--same", "monday:1,tuesday:1"]) == 0
    assert (
        "same: monday:1, tuesday:1: the steps do not look alike (monday:1 shows b, tuesday:1 shows "
        "c), so there will be no map unless one of them may be misread: solve with --set "
        "misread=4; if they are not one, say --different monday:1,tuesday:1"
    ) in capsys.readouterr().err
    assert main(["correct", building, "--same", "monday:2,tuesday:1"]) == 0
    assert "do not look alike" not in capsys.readouterr().err
    assert main(solving(folder)) == 20
    told = capsys.readouterr().out
    opposite = "say the opposite of this correction (ssh-abduction correct), or delete it"
    assert told.splitlines()[-1].startswith(opposite)
    assert (
        "same: monday:1, tuesday:1: it contradicts the trace (monday:1 shows b, tuesday:1 shows c)"
        in told
    )
    assert "same: monday:2" not in told
    assert main([*solving(folder), "--json"]) == 20
    assert "tuesday:1" in json.loads(capsys.readouterr().out)["corrections"][0]
    assert main(["correct", building, "--different", "monday:1,tuesday:1"]) == 0
    assert main(["correct", building, "--same-place", "monday:1,monday:2"]) == 0
    assert main(["correct", building, "--elsewhere", "monday:2,tuesday:1"]) == 0
    file = folder / "building" / "corrections.yaml"
    text = file.read_text().replace("same_place:\n", "same_place:\n- [monday:1, tuesday:1]\n")
    file.write_text(text)
    assert main(solving(folder)) == 1
    assert "got a contradiction of same_place: monday:1, monday:2 and" in capsys.readouterr().err


@pytest.mark.parametrize(("views", "helps"), [("abcdX", True), ("abcaX", False)])
def test_misreading_is_advised_where_it_makes_a_correction_possible(
    views: str, helps: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A travel along a path cannot lead back to a place, whatever is seen there."""
    actions = ["travel", "around"] * 2 if helps else ["travel"] * 4
    trace = Trace.from_steps(views, actions, name="monday")
    trace.save(tmp_path / "monday.jsonl")
    maps = str(tmp_path / "maps.json")
    solving = ["solve", str(tmp_path / "monday.jsonl"), "-o", maps]
    assert main(solving) == 0
    assert main(["correct", maps, "--same", "monday:0,monday:4"]) == 0
    assert main(solving) == 20
    assert ("misread: solve with --set misread=4" in capsys.readouterr().out) == helps
    assert main([*solving, "--set", "misread=4"]) == (0 if helps else 20)
    if helps:  # The map allows misread views, so the next correction needs no other settings.
        capsys.readouterr()
        assert main(["correct", maps, "--same", "monday:1,monday:2"]) == 0
        assert "as misread (misread=4)" in capsys.readouterr().err


def test_solve_names_a_contradicting_correction_without_an_explanation(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """In long traces, no stretch that clashes is found."""
    monkeypatch.setattr("ssh_abduction.cli.outcome.explain", lambda *_: None)
    building = str(folder / "building")
    assert main(["correct", building, "--same", "monday:1,tuesday:1"]) == 0
    assert main(["correct", building, "--same-place", "monday:2,tuesday:1"]) == 0
    assert main(solving(folder)) == 20
    told = capsys.readouterr()
    assert "warning: views" not in told.err
    assert "same: monday:1, tuesday:1: perhaps it contradicts the trace" in told.out
    assert "same_place: monday:2, tuesday:1: perhaps it contradicts the trace" in told.out


def test_gateways_are_opened_and_closed(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The gateway is seen from two steps at its place, in two directions."""
    assert main(solving(folder, "round")) == 0
    maps = str(folder / "building" / "maps.json")
    assert main(["correct", maps, "--open", "round:1 ahead"]) == 0
    file = folder / "building" / "corrections.yaml"
    (said,) = load_corrections(file).gateways
    assert said.seen == (("round:1", 0.0), ("round:2", 270.0))
    corrected = load_corrections(file).corrected(ROUND)
    assert corrected.steps[1].star == (1, 1, 1, 0)
    assert corrected.steps[2].star == (1, 1, 0, 1)
    assert corrected.steps[2].extra == {"star_seen": [1, 1, 0, 0]}
    assert fingerprints_of(corrected) == fingerprints_of(ROUND)
    assert main(solving(folder, "round")) == 0
    capsys.readouterr()
    # The robot came to the corner from behind: that gateway is open.
    for way in ("round:1 back", "round:2 ahead"):
        file.unlink(missing_ok=True)
        assert main(["correct", maps, "--closed", way]) == 1
        assert "it contradicts the trace: the robot" in capsys.readouterr().err
        assert not file.exists()
    # A bearing near the way of the robot is this gateway, too.
    near = Corrections.for_drives(ROUND).with_gateway(False, [("round:1", 172.0)])
    with pytest.raises(MapError, match="the robot came to round:1 through it"):
        near.corrected(ROUND)
    # A file that a person wrote is refused, too.
    save_corrections(Corrections.for_drives(ROUND).with_gateway(False, [("round:1", 180.0)]), file)
    assert main(solving(folder, "round")) == 1
    assert "it contradicts the trace: the robot" in capsys.readouterr().err


def test_contradicting_correction_is_refused_in_a_folder_that_map_wrote(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The verb map writes the trace beside the maps."""
    assert main(solving(folder, "round")) == 0
    building = folder / "building"
    data = json.loads((building / "maps.json").read_text())
    del data["trace"]
    (building / "maps.json").write_text(json.dumps(data))
    (building / "run.json").write_text("{}")
    ROUND.save(building / "trace.jsonl")
    assert main(["correct", str(building), "--closed", "round:1 back"]) == 1
    assert "it contradicts the trace: the robot" in capsys.readouterr().err
    assert main(["correct", str(building), "--open", "round:1 ahead"]) == 0


@pytest.mark.filterwarnings("ignore:traces 1 and 2 have the same steps")
@pytest.mark.parametrize("onto", [False, True])
def test_warning_if_a_later_drive_contradicts_a_gateway_correction(
    onto: bool, folder: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    """A person opens a gateway that was closed on Monday. On Tuesday it was closed, too."""
    stars = (1, 0, 0, 0), (0, 0, 1, 0)
    for name in ("monday", "tuesday"):
        seeing(name, *stars).save(folder / f"{name}.jsonl")
    seeing("other", (1, 1, 0, 0), (0, 0, 1, 1)).save(folder / "other.jsonl")
    maps = str(folder / "building" / "maps.json")
    assert main(solving(folder, "monday")) == 0
    assert main(["correct", maps, "--open", "monday:0 right"]) == 0
    capsys.readouterr()
    file = str(folder / "building" / "corrections.yaml")

    def warned(*names: str) -> str:
        last = ["solve", str(folder / f"{names[-1]}.jsonl"), "--onto", maps, "--corrections", file]
        assert main(solving(folder, "monday")) == 0
        capsys.readouterr()
        assert main([*last, "-o", maps] if onto else solving(folder, *names)) == 0
        told = capsys.readouterr().err
        assert main(["compare", maps]) == 0
        shown = capsys.readouterr()
        assert ("it contradicts" in shown.err) == ("it contradicts" in told)
        assert ("2 pieces that share no place" in shown.out) == (names[-1] != "other")
        (*_, page) = content_of(Solution.load(maps)).get("warnings", ()) or ("",)
        assert page in told
        return told

    told = warned("monday", "tuesday")
    said = "open: right at monday:0, left at monday:3: it contradicts what tuesday saw at steps"
    assert f"{said} tuesday:0, tuesday:3; say the same of" in told
    assert told.count("it contradicts") == 1
    # Python gives the same warning.
    drives = [seeing(name, *stars) for name in ("monday", "tuesday")]
    said_of = load_corrections(file)
    caplog.clear()
    solution = (
        solve(drives[1], onto=solve(drives[0], corrections=said_of), corrections=said_of)
        if onto
        else solve(drives, corrections=said_of)
    )
    assert [said in warning for warning in solution.warnings] == [True]
    assert [solution.joined, *solution.warnings] == caplog.messages
    assert solution.joined in solution._repr_html_()
    # This drive saw the gateway open.
    assert "it contradicts" not in warned("monday", "other")
    # This one was elsewhere than Monday, with or without the correction.
    strange = Trace.from_steps("ax", ["travel"], stars=[(1, 1, 1, 0), (0, 0, 1, 0)], name="strange")
    strange.save(folder / "strange.jsonl")
    assert "it contradicts" not in warned("monday", "strange")


@pytest.mark.filterwarnings("ignore:traces 1 and 2 have the same steps")
@pytest.mark.parametrize("names", [("monday", "tuesday"), ("tuesday", "monday"), ()])
def test_closed_gateway_of_a_place_holds_for_later_drives(
    names: tuple[str, ...], folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Both drives see a gateway that is not there. Only the first is in the map at first.

    Solved after Tuesday, the places of Monday have other numbers. Without names, Tuesday is added
    to the map of Monday.
    """
    for name in ("monday", "tuesday"):
        seeing(name, (1, 1, 0, 0), (0, 0, 1, 1)).save(folder / f"{name}.jsonl")
    seeing("right", (1, 0, 0, 0), (0, 0, 1, 0)).save(folder / "right.jsonl")
    maps = str(folder / "building" / "maps.json")
    file = str(folder / "building" / "corrections.yaml")
    assert main(solving(folder, "monday")) == 0
    assert main(["correct", maps, "--closed", "p0 south"]) == 0

    def added(*drives: str) -> str:
        if names:
            assert main(solving(folder, *drives)) == 0
        else:
            assert main(solving(folder, "monday")) == 0
            onto = [str(folder / f"{drives[-1]}.jsonl"), "--onto", maps, "--corrections", file]
            assert main(["solve", *onto, "-o", maps]) == 0
        told = capsys.readouterr()
        return told.out + told.err

    # A drive that sees it closed agrees, so its steps get no correction of their own.
    told = added("right", "monday") if names[:1] == ("tuesday",) else added("monday", "right")
    assert "it contradicts" not in told
    assert "share no place" not in told
    # A drive that sees it open contradicts. The warning names the steps, and how to agree.
    told = added(*(names or ("tuesday",)))
    said = "it contradicts what tuesday saw at steps tuesday:0, tuesday:3; say the"
    assert said in told
    assert "(correct --closed 'tuesday:0 right'), or remove it" in told
    assert main(["correct", maps, "--closed", "tuesday:0 right"]) == 0
    told = added(*(names or ("tuesday",)))
    assert "it contradicts" not in told
    assert "the map joins the 2 drives" in told
    assert {step.star for step in Solution.load(maps).trace or () if step.view == "a"} == {
        (1, 0, 0, 0)
    }


def test_warning_if_a_corrected_gateway_keeps_a_drive_out_of_one_place_only() -> None:
    """Both drives saw a gateway south of P. Tuesday shares another place with Monday."""
    seen = (1, 1, 1, 1)
    monday = Trace.from_steps(
        ["A east", "P east", "B east"],
        ["travel", "travel"],
        stars=[(1, 0, 0, 0), seen, (0, 0, 1, 0)],
        name="monday",
    )
    tuesday = Trace.from_steps(
        ["P east", "B east"], ["travel"], stars=[seen, (0, 0, 1, 0)], name="tuesday"
    )
    said = Corrections.for_drives(monday).with_gateway(False, [("monday:1", 90.0)])
    (warning,) = solve([monday, tuesday], corrections=said).warnings
    assert "what tuesday saw at step tuesday:0; say the same of tuesday:0" in warning
    elsewhere = replace(tuesday, steps=tuesday.steps[1:])
    assert not solve([monday, elsewhere], corrections=said).warnings


def test_drive_that_contradicts_a_correction_shares_the_place_without_stars() -> None:
    stars = (1, 1, 0, 0), (0, 0, 1, 1)
    drives = [seeing("monday", *stars), replace(seeing("tuesday", *stars)[:3], name="tuesday")]
    said = Corrections.for_drives(drives[0]).with_gateway(
        False, [("monday:0", 90.0), ("monday:3", 270.0)]
    )
    solution = solve(drives, Theory(star="none"), corrections=said)
    assert len(solution[0].pieces) == 1
    (warning,) = solution.warnings
    assert "it contradicts what tuesday saw at step tuesday:0; say the same of" in warning
    agreeing = replace(said, drives=fingerprints_of(together(drives)))
    agreeing = agreeing.with_gateway(False, [("tuesday:0", 90.0)])
    assert not solve(drives, Theory(star="none"), corrections=agreeing).warnings


def test_correct_warns_if_the_map_uses_no_stars(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    maps = str(folder / "building" / "maps.json")
    for more, warns in (["--set", "star=none"], True), ([], False):
        assert main([*solving(folder, "round"), *more]) == 0
        capsys.readouterr()
        assert main(["correct", maps, "--open", "round:1 ahead"]) == 0
        (folder / "building" / "corrections.yaml").unlink()
        assert (
            "a gateway that is open or closed changes no map" in capsys.readouterr().err
        ) is warns


@pytest.mark.slow
def test_verbs_apply_star_corrections_to_the_recorded_trace(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """On Tuesday the robot overlooked a gateway at the corner. The map of both drives has it."""
    monday = seeing("monday", (1, 1, 0, 0), (0, 0, 1, 1))
    joint = together([monday, seeing("tuesday", (1, 0, 0, 0), (0, 0, 1, 0))])
    trace, maps = str(folder / "joint.jsonl"), str(folder / "building" / "maps.json")
    joint.save(trace)
    ways = [("tuesday:0", 90.0), ("tuesday:3", 270.0)]
    file = folder / "building" / "corrections.yaml"
    save_corrections(Corrections.for_drives(joint).with_gateway(True, ways), file)
    assert main(["solve", trace, "-o", maps]) == 0
    assert "optimal: 4 dstates" in capsys.readouterr().out
    page = str(folder / "page.html")
    pair = ["explain", trace, "monday:0", "tuesday:0"]
    for words in (["check", maps, trace], ["view", maps, trace, "-o", page]):
        assert main(words) == 0
        assert "obeying 1 correction of" in capsys.readouterr().err
    assert f"--corrections {file}" in Path(page).read_text()
    for given in (["--theory", maps], ["--corrections", str(file)]):
        assert main([*pair, *given]) == 0
        assert "are one dstate in every minimal map" in capsys.readouterr().out
    assert main(pair) == 0
    assert "are different dstates in every map" in capsys.readouterr().out
    # A file of other drives is not obeyed, and an error if the user names it.
    other = Corrections.for_drives(ROUND).with_gateway(True, [("round:1", 0.0)])
    save_corrections(other, file)
    assert main(["check", maps, trace]) == 20
    assert "it is not obeyed" in capsys.readouterr().err
    assert main([*pair, "--corrections", str(file)]) == 1
    assert "the file belongs to another map" in capsys.readouterr().err


def test_check_says_that_maps_are_older_than_their_corrections(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    maps = str(folder / "building" / "maps.json")
    assert main(["correct", maps, "--different", "monday:0,monday:1"]) == 0
    assert main(["check", "--bound", maps]) == 0
    assert "the maps are older than the corrections" in capsys.readouterr().out
    assert main(["check", "--bound", maps, "--set", "boundary=none"]) == 0
    assert "the file is of another theory" in capsys.readouterr().out


def test_north_in_a_correction_is_north_of_the_drawing(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(solving(folder, "round")) == 0
    maps = str(folder / "building" / "maps.json")
    place = SSHMap.place_of(solve(ROUND)[0], 1)
    assert main(["correct", maps, "--closed", f"p{place} north", "--open", "p0 south"]) == 0
    drawn = {}
    for said in load_corrections(folder / "building").gateways:
        drawn.update(said.seen)
    # The robot first faces east; north is on its left. After a right turn, it is behind.
    assert drawn["round:1"] == 270.0
    assert drawn["round:2"] == 180.0
    for wrong, told in (
        ("p0", "expected a place and a direction"),
        ("p9 north", "expected a place of the map"),
        (
            "p0 up",
            "expected east, northeast, north, northwest, west, southwest, south, southeast after a "
            "place, got 'up'; take one",
        ),
        ("p0 left", "or name a step, such as 'round:0 left'"),
        ("round:0 up", "expected ahead, right, back, left"),
    ):
        assert main(["correct", maps, "--open", wrong]) == 1
        assert told in capsys.readouterr().err


def test_gateway_is_corrected_at_all_dstates_of_a_place_without_stars(tmp_path: Path) -> None:
    """The robot comes from the west, turns left, goes north, and comes back."""
    quarter = math.pi / 2
    moves = [(5.0, 0.0, 0.0), (0.0, 0.0, quarter), (5.0, 0.0, 0.0), (0.0, 0.0, math.pi)]
    trace = Trace.from_steps(
        "abcdef",
        ["travel", "left", "travel", "around", "travel"],
        displacements=[*moves, (5.0, 0.0, 0.0)],
        stars=[(0.0, 180.0)] * 6,
        name="round",
    )
    trace.save(tmp_path / "round.jsonl")
    maps = str(tmp_path / "maps.json")
    main(["solve", str(tmp_path / "round.jsonl"), "--set", "star=none", "-o", maps])
    assert main(["correct", maps, "--open", "round:1 90"]) == 0
    (said,) = load_corrections(tmp_path).gateways
    ssh_map = Solution.load(maps).maps[0]
    assert ssh_map.place_of(1) == ssh_map.place_of(2) == ssh_map.place_of(5)
    assert dict(said.seen) == {"round:1": 90.0, "round:2": 180.0, "round:5": 0.0}


@pytest.mark.parametrize("verb", [["name", "p0", "kitchen"], ["correct", "--open", "p0 north"]])
def test_file_of_corrections_in_place_of_maps_is_an_error(
    verb: list[str], folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(solving(folder, "round")) == 0
    building = folder / "building"
    assert main(["name", str(building), "p0", "hall"]) == 0
    file = building / "corrections.yaml"
    capsys.readouterr()
    assert main([verb[0], str(file), *verb[1:]]) == 1
    assert f"got a file of corrections; name the folder: {building}" in capsys.readouterr().err


@pytest.mark.parametrize("verb", ["show", "name", "solve"])
def test_folder_that_is_called_like_corrections_is_an_error(
    verb: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(solving(folder, "round")) == 0
    building = folder / "building"
    (building / "corrections.yaml").mkdir()
    capsys.readouterr()
    calls = {"show": ["show", str(building)], "name": ["name", str(building), "p0", "hall"]}
    assert main(calls.get(verb) or solving(folder, "round")) == 1
    assert "expected a file of corrections, got a folder" in capsys.readouterr().err


@pytest.mark.parametrize("text", [None, "places: 3\n", "format: ssh-corrections\nversion: ["])
def test_other_yaml_in_place_of_maps_is_not_called_corrections(
    text: str | None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "maps.yaml"
    if text is not None:
        file.write_text(text)
    assert main(["show", str(file)]) == 1
    assert "corrections" not in capsys.readouterr().err


def test_correction_can_leave_a_star_without_gateways() -> None:
    assert with_gateway((1, None, 0, 0), 90.0, is_open=True) == (1, 1, 0, 0)
    bearings = (0.0, Gateway(120.0, opposite=2), Gateway(240.0, opposite=1))
    assert with_gateway(bearings, 3.0, is_open=False) == (
        Gateway(120.0, opposite=1),
        Gateway(240.0, opposite=0),
    )
    assert with_gateway(bearings, 118.0, is_open=False) == (0.0, Gateway(240.0))
    assert with_gateway((0.0,), 90.0, is_open=True) == (0.0, 90.0)
    assert with_gateway((0.0,), 90.0, is_open=False) == (0.0,)
    unknown = (0.0, Gateway(90.0, open=None))
    assert with_gateway(unknown, 91.0, is_open=True) == (0.0, Gateway(90.0))


def named_map() -> SSHMap:
    said = (
        Corrections(fingerprints_of(ROUND))
        .with_name("kitchen", "place", "round:1")
        .with_name("hall", "path", "round:0")
    )
    (ssh_map,) = solve(ROUND, corrections=said)
    return ssh_map


def test_names_are_in_all_exports_of_a_map(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ssh_map = named_map()
    assert ssh_map.called("place", 1) == "place 1 (kitchen)"
    assert ssh_map.renumbered().names == ssh_map.names
    assert SSHMap.from_dict(ssh_map.to_dict()).names == ssh_map.names
    twice = ssh_map.to_dict() | {
        "names": [{"place": 1, "name": "hall"}, {"path": 0, "name": "hall"}]
    }
    with pytest.raises(MapError, match="names: expected each once, got"):
        SSHMap.from_dict(twice)
    for to in ("nav2", "tmap2", "graphml", "dot", "svg", "networkx-json"):
        text = export_map(ssh_map, to)
        assert "kitchen" in text, to
        assert "hall" in text, to
    assert 'label="place 1 (kitchen)' in to_dot(ssh_map)
    assert "kitchen" in to_svg(ssh_map)
    assert "1 (kitchen)" in map_card(ssh_map)
    assert to_networkx(ssh_map, "places").nodes[1]["name"] == "kitchen"
    assert to_networkx(ssh_map, "topological").nodes["path", 0]["name"] == "hall"
    assert content_of([ssh_map])["maps"][0]["names"] == {"path 0": "hall", "place 1": "kitchen"}
    with_region = replace(
        ssh_map,
        regions=(Region(0, (0, 1), bounds=((0, 1),)), Region(1, (2,), bounds=((0, -1),))),
        names=(Name("region", 0, "west wing"),),
    )
    for to in ("nav2", "tmap2", "graphml", "dot", "svg", "networkx-json"):
        assert "west wing" in export_map(with_region, to), to
    assert route(ssh_map, 0, "kitchen").goal == "place 1 (kitchen)"
    with pytest.raises(
        MapError, match="a path as path0, or a region as region0, or hall, kitchen, got 'den'"
    ):
        route(ssh_map, 0, "den")
    ssh_map.save(folder / "map.json")
    for verb in (["show"], ["route", "--to", "kitchen"], ["view", "-o", str(folder / "p.html")]):
        assert main([verb[0], str(folder / "map.json"), *verb[1:]]) == 0
    assert capsys.readouterr().out.count("(kitchen)") > 3


def test_corrections_of_pairs_become_fields_of_the_theory() -> None:
    """There is one mechanism: the fields of a theory."""
    said = Corrections(MARKS).with_pair("elsewhere", "tuesday:1", "monday:0")
    assert solve(JOINT, corrections=said).theory.elsewhere == ((0, 5),)
    twice = solve(JOINT, Theory(elsewhere=[(0, 5)]), corrections=said)
    assert twice.theory.elsewhere == ((0, 5),)
    assert drives_of(JOINT)[1].fingerprint is None


def test_correction_same_place_keeps_only_maps_that_agree(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    trace = Trace.from_steps("abcd", ["travel", "right", "travel"], name="walk")
    theory = Theory(boundary="none", prefer=("dstates",))
    every = solve(trace, theory, max_maps=None).maps
    together_there = [m for m in every if m.place_of(0) == m.place_of(3)]
    assert 0 < len(together_there) < len(every)
    said = Corrections(fingerprints_of(trace)).with_pair("same_place", "walk:0", "walk:3")
    found = solve(trace, theory, corrections=said, max_maps=None)
    assert found.theory.same_place == ((0, 3),)
    assert set(found.maps) == set(together_there)
    apart = next(m for m in every if m not in together_there)
    assert [v.axiom for v in check(trace, apart, found.theory)] == ["asserted"]
    with pytest.raises(TheoryError, match="same_place: expected a topological theory"):
        Theory.causal().replace(same_place=[(0, 1)])
    trace.save(tmp_path / "walk.jsonl")
    names = [str(tmp_path / name) for name in ("walk.jsonl", "maps.json")]
    solving_it = ["solve", names[0], "--set", "boundary=none", "-o", names[1]]
    assert main(solving_it) == 0
    assert main(["correct", str(tmp_path), "--same-place", "walk:0,walk:3"]) == 0
    assert main(solving_it) == 0
    assert "obeying 1 correction" in capsys.readouterr().err
    assert main([*solving_it, "--same-place", "0,3"]) == 0


@pytest.mark.parametrize(
    ("first", "then", "left"),
    [
        ("different", "same", ["same"]),
        ("elsewhere", "same", ["same"]),
        ("same", "different", ["different"]),
        ("same_place", "elsewhere", ["elsewhere"]),
        ("different", "same_place", ["different", "same_place"]),
        ("same", "same", ["same"]),
    ],
)
def test_opposite_correction_replaces_the_old_one(first: str, then: str, left: list[str]) -> None:
    said = Corrections(MARKS).with_pair(first, "monday:0", "tuesday:1")
    said = said.with_pair(first, "monday:2", "tuesday:1")
    changed = said.with_pair(then, "tuesday:1", "monday:0")
    assert [pair.kind for pair in changed.pairs if "monday:0" in pair.steps] == left
    assert said.pairs[1] in changed.pairs


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--same", "p0,p1"], "--same: step 'p0': .*; places are for --elsewhere and --same-place"),
        (
            ["--elsewhere", "p1,p1"],
            "--elsewhere: expected two different places, such as kitchen,p7",
        ),
        (["--same", "monday:1"], "--same: expected two different steps, such as monday:12,tuesday"),
    ],
)
def test_correct_says_what_a_pair_is(
    options: list[str], told: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["correct", str(folder / "building"), *options]) == 1
    assert re.search(told, capsys.readouterr().err)


@pytest.mark.parametrize("kinds", ["different same", "elsewhere same-place", "open closed"])
def test_corrections_of_one_command_agree(
    kinds: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    building, (first, second) = str(folder / "building"), kinds.split()
    about = "monday:1 back" if first == "open" else "monday:1,tuesday:0"
    assert main(["correct", building, f"--{first}", about, f"--{second}", about]) == 1
    assert re.search(f"--{second} .*: this call also says {first}: .*", capsys.readouterr().err)
    # The opposite of what was said before replaces it.
    for kind in ("same", "different"):
        assert main(["correct", building, f"--{kind}", "monday:1,tuesday:0"]) == 0
        assert [pair.kind for pair in load_corrections(building).pairs] == [kind]


def test_solve_warns_of_names_that_the_map_does_not_have(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Both names are of one place of the joint map."""
    said = Corrections(MARKS).with_name("kitchen", "place", "monday:1")
    save_corrections(said.with_name("cafe", "place", "tuesday:0"), folder / "building")
    assert main(solving(folder)) == 0
    told = capsys.readouterr()
    assert "name 'cafe' of the place of tuesday:0: it is not shown" in told.err
    assert "this place is also 'kitchen'; rename or remove one of them" in told.err
    assert len(load_corrections(folder / "building").names) == 2
    assert "name 'kitchen'" not in told.err
    assert "(kitchen)" in told.out
    for name in ("kitchen", "cafe"):  # all verbs know both
        assert main(["route", str(folder / "building"), "--from", "d0", "--to", name]) == 0
        assert "to place 1 (kitchen): " in capsys.readouterr().out


@pytest.mark.parametrize("options", [["tuesday"], ["--jobs", "1"]])
def test_corrections_of_traces_solved_alone_are_refused(
    options: list[str], folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [str(folder / f"{word}.jsonl") if word == "tuesday" else word for word in options]
    monday = str(folder / "monday.jsonl")
    assert main(["solve", monday, *words, "--corrections", str(folder)]) == 1
    assert "--corrections: expected no such option with " in capsys.readouterr().err


def test_names_of_drives_may_have_commas(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Names of simulated drives have some: "two floors, 1 tours, seed 0"."""
    files = []
    for name in ("two floors, 1", "a,b"):
        trace = Trace.from_steps("abc", ["travel", "around"], name=name)
        files.append(str(tmp_path / f"{len(files)}.jsonl"))
        trace.save(files[-1])
    maps, pair = str(tmp_path / "maps.json"), "two floors, 1:0, a,b:0"
    assert main(["solve", *files, "--together", "-o", maps, "--same", pair]) == 0
    assert Solution.load(maps).theory.same == ((0, 3),)
    assert main(["correct", str(tmp_path), "--different", "a,b:2,two floors, 1:1"]) == 0
    capsys.readouterr()
    assert main(["correct", str(tmp_path)]) == 0
    assert "different: a,b:2 [place 1], two floors, 1:1 [place 1]" in capsys.readouterr().out
    for wrong in ("a,b:0", "a,b:0,a,b:0", "a,b:0,a,b:1,a,b:2", "c,d:0,a,b:1"):
        assert main(["correct", str(tmp_path), "--same", wrong]) == 1


def test_a_route_avoids_a_place_whose_name_has_a_comma(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    maps = str(folder / "building" / "maps.json")
    assert main(["name", maps, "p1", "room 1, left"]) == 0
    capsys.readouterr()
    assert main(["route", maps, "--from", "d0", "--to", "p1", "--avoid", "room 1, left"]) == 1
    assert "avoid: expected a dstate of 'to' that is not avoided" in capsys.readouterr().err


def test_joins_of_other_steps_may_not_contradict_a_sentence() -> None:
    said = Corrections().with_pair("same_place", "a:1", "a:2").with_pair("same", "a:2", "a:3")
    chain = "got a contradiction of same_place: a:1, a:2 and same: a:2, a:3; drop one of these"
    with pytest.raises(MapError, match=chain):
        said.with_pair("elsewhere", "a:1", "a:3")
    assert said.with_pair("different", "a:1", "a:3")  # one place has several dstates
    rejected = said.with_pair("elsewhere", "a:1", "a:2")
    with pytest.raises(MapError, match="of same_place: a:3, a:1 and same: a:2, a:3"):
        rejected.with_pair("same_place", "a:3", "a:1")
    assert rejected.with_pair("same_place", "a:1", "a:2") != rejected  # replaces the opposite
