"""`map --add`: a further drive keeps the numbers and the names of a map."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from ssh_abduction.cli import main
from ssh_abduction.cli.jobs import FileAnswer
from ssh_abduction.cli.mapping import _numbers_kept, _with_corrections
from ssh_abduction.data.corrections import load_corrections
from ssh_abduction.data.errors import MapError
from ssh_abduction.data.maps import DState, SSHMap


def mapped(places: list[int]) -> SSHMap:
    """A map with a dstate for each place, and a step at each of these places."""
    states = tuple(DState(p, "v", p) for p in range(max(places) + 1))
    return SSHMap(tuple(places), states, (), tuple(range(max(places) + 1)))


@pytest.mark.parametrize(
    ("new", "said"),
    [
        ([0, 1, 2, 1, 1, 3], "3 of 3 places keep their visits and their number; 1 place is new"),
        # Place 1 is split.
        ([0, 1, 2, 3, 4, 0], "2 of 3 places keep"),
        ([0, 1, 1, 1], "1 of 3 places keep their visits and their number; 0 places are new"),
    ],
)
def test_places_that_keep_their_number_are_counted(new: list[int], said: str) -> None:
    assert _numbers_kept(mapped([0, 1, 2, 1]), mapped(new)).startswith(said)


def folder_of(tmp_path: Path) -> Path:
    (tmp_path / "run.json").write_text('{"log": {"source": "gone.log"}}')
    (tmp_path / "maps.json").write_text("{}")
    (tmp_path / "trace.jsonl").write_text('{}\n{"scan": 0}\n{"scan": 9}\n')
    (tmp_path / "corrections.yaml").write_text(
        "format: ssh-corrections\nversion: 1\ndrives: {monday: aa}\n"
        "names: [{name: kitchen, place: 'monday:1'}]\n"
    )
    return tmp_path


def answer(scans: list[int]) -> FileAnswer:
    drives = [{"name": name, "fingerprint": name[:2]} for name in ("monday", "tuesday")]
    trace = "{}\n" + "".join(f'{{"scan": {scan}}}\n' for scan in scans)
    files = ("maps.json", json.dumps({"drives": drives})), ("trace.jsonl", trace)
    return FileAnswer(0, "", 0, files=tuple((name, text.encode()) for name, text in files))


def test_corrections_follow_the_old_drive_if_its_steps_stay(tmp_path: Path) -> None:
    folder = folder_of(tmp_path)
    name, data = _with_corrections(answer([0, 9, 20]), folder).files[-1]
    assert name == "corrections.yaml"
    (folder / name).write_bytes(data)
    said = load_corrections(folder / name)
    assert dict(said.drives) == {"monday": "mo", "tuesday": "tu"}
    assert said.names[0].step == "monday:1"
    with pytest.raises(MapError, match="expected drives whose steps are where they were"):
        _with_corrections(answer([0, 8, 20]), folder)


@pytest.mark.parametrize("made", [True, False])
def test_a_folder_without_its_log_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], made: bool
) -> None:
    folder = folder_of(tmp_path) if made else tmp_path
    before = sorted(folder.iterdir())
    assert main(["map", "--add", "tuesday.log", "-o", str(folder)]) == 1
    said = "gone.log: expected the log of the map" if made else "expected a folder with the map"
    assert said in capsys.readouterr().err
    assert sorted(folder.iterdir()) == before


@pytest.mark.slow
def test_a_second_drive_keeps_names_and_numbers(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    logs = [str(tmp_path / f"{day}.log") for day in ("monday", "tuesday")]
    for seed, log in enumerate(logs, 1):
        main(["simulate", "doors", "-o", log, "--set", "every=0.5", "--seed", str(seed)])
    house = str(tmp_path / "house")
    assert main(["map", logs[0], "-o", house, "--work-limit", "2"]) == 0
    assert main(["name", house, "p3", "kitchen"]) == 0
    capsys.readouterr()
    assert main(["map", "--add", logs[1], "-o", house, "--work-limit", "3"]) == 0
    assert "keep their visits and their number" in capsys.readouterr().out
    assert main(["route", house, "--to", "kitchen"]) == 0  # the corrections are still obeyed
