"""Each log of a batch has its own folder, whatever the names and the order of the logs."""

from __future__ import annotations

import errno
import gzip
import itertools
import json
import os
from pathlib import Path

import pytest

from ssh_abduction.cli import import_log, jobs, main
from ssh_abduction.cli.import_log import (
    FILES,
    UnwrittenError,
    code_of_done,
    digest,
    folders_of,
    named_after,
    write_run,
)
from ssh_abduction.cli.jobs import FileAnswer
from ssh_abduction.cli.mapping import MapQuestion
from ssh_abduction.cli.parsing import RUN

QUESTION = MapQuestion(None, {}, (None, None, None), 0.5, None, 300)
LONG = "n" * 251


def log_at(path: Path, content: str) -> str:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content)
    return str(path)


def map_in(folder: Path, log: str, **more: object) -> None:
    """Write the files of a finished run of this log."""
    run = {"settings": json.loads(json.dumps(QUESTION.settings)), "digest": digest([log]), **more}
    write_run(folder, [("maps.json", b""), (RUN, json.dumps(run).encode())])


def names_of(folder: Path, logs: list[str]) -> list[str]:
    """The folders in `folder` that logs have, in the order of the logs."""
    found, same = folders_of(logs, folder)
    return [found[same.get(log, log)].relative_to(folder).as_posix() for log in logs]


@pytest.mark.parametrize(
    ("file", "name"),
    [
        ("run.1.log", "run.1"),
        ("run.1.log.gz", "run.1"),
        ("run.10.LOG", "run.10"),
        ("run", "run"),
        ("run.1", "run.1"),
        ("a b.c d.bag", "a b.c d"),
        ("тест.жук.mcap", "тест.жук"),
        (".hidden.log", ".hidden"),
        ("...", "log"),
        ("..log", "..log"),
        ("...log", "...log"),
        (".log", ".log"),
        ("log.log.log", "log.log"),
        (f"{LONG}.log", LONG),
    ],
)
def test_folder_has_the_name_of_the_log(file: str, name: str) -> None:
    assert named_after(f"some.folder/{file}") == name


def test_bag_folder_keeps_its_full_name(tmp_path: Path) -> None:
    (tmp_path / "bag.1.db3").mkdir()
    assert named_after(str(tmp_path / "bag.1.db3")) == "bag.1.db3"
    assert named_after(str(tmp_path / "bag.1.db3" / ".")) == "bag.1.db3"


@pytest.mark.parametrize(
    ("files", "names"),
    [
        (["run.1.log", "run.2.log", "run.10.log"], ["run.1", "run.2", "run.10"]),
        (["a/run.log", "b/run.log"], ["run-*", "run-*"]),
        (["a/run.log", "a/run.bag", "b/other.log"], ["run-*", "run-*", "other"]),
        (["a/Run.log", "b/run.log"], ["Run-*", "run-*"]),
        (["a/e\u0301.log", "b/\u00e9.log"], ["e\u0301-*", "\u00e9-*"]),
        (["a/..log", "b/..log"], ["..log-*", "..log-*"]),
        (["a/...", "a/log"], ["log-*", "log-*"]),
        ([f"a/{LONG}.log", f"b/{LONG}.log"], [f"{'n' * 246}-*", f"{'n' * 246}-*"]),
        ([f"a/{'ж' * 125}.log", f"b/{'ж' * 125}.log"], ["ж*-*", "ж*-*"]),
    ],
    ids=[
        "numbers",
        "folders",
        "endings",
        "case",
        "accents",
        "dots",
        "only dots",
        "long",
        "long, of two bytes",
    ],
)
def test_logs_have_different_folders_in_any_order(
    tmp_path: Path, files: list[str], names: list[str]
) -> None:
    logs = [log_at(tmp_path / file, file) for file in files]
    found = names_of(tmp_path / "runs", logs)
    assert all(Path(one).match(name) for one, name in zip(found, names, strict=True))
    assert len({one.casefold() for one in found}) == len(logs)
    assert all(len(os.fsencode(one)) <= 255 for one in found)
    for order in itertools.permutations(logs):
        assert dict(zip(order, names_of(tmp_path / "runs", list(order)), strict=True)) == dict(
            zip(logs, found, strict=True)
        )


def test_log_keeps_its_folder_if_renamed_or_packed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = tmp_path / "runs"
    first, second, third = (log_at(tmp_path / str(i) / "run.log", str(i)) for i in range(3))
    map_in(runs / "run", first)
    map_in(runs / "elsewhere", second)
    assert names_of(runs, [third, second, first])[1:] == ["elsewhere", "run"]
    assert names_of(runs, [third, first])[0].startswith("run-")
    assert f"as {runs / 'run'} has the map of another log" in capsys.readouterr().err
    moved = log_at(tmp_path / "moved.log", "0")
    packed = tmp_path / "run.log.gz"
    packed.write_bytes(gzip.compress(b"0"))
    assert names_of(runs, [moved]) == ["run"]
    assert names_of(runs, [str(packed), moved])[0].startswith("run-")


def test_single_log_uses_the_output_folder_unless_it_is_taken(
    tmp_path: Path,
) -> None:
    runs = tmp_path / "runs"
    first, second = (log_at(tmp_path / f"run.{i}.log", str(i)) for i in range(2))
    assert names_of(runs, [first]) == ["."]
    map_in(runs, first)
    assert names_of(runs, [first]) == ["."]
    assert names_of(runs, [second]) == ["run.1"]
    assert names_of(runs, [second, first]) == ["run.1", "."]


def test_copies_of_a_log_are_mapped_once(tmp_path: Path) -> None:
    copies = [log_at(tmp_path / folder / "run.log", "one") for folder in "ba"]
    found, same = folders_of(copies, tmp_path / "runs")
    assert (found, same) == ({copies[1]: tmp_path / "runs" / "run"}, {copies[0]: copies[1]})


def test_missing_log_takes_no_folder_name(tmp_path: Path) -> None:
    there = log_at(tmp_path / "b" / "run.log", "x")
    missing = str(tmp_path / "a" / "run.log")
    assert names_of(tmp_path / "runs", [missing, there])[1] == "run"
    assert len(set(names_of(tmp_path / "runs", [missing, there]))) == 2


def test_bags_with_equal_names_and_sizes_are_two_logs(tmp_path: Path) -> None:
    for name in "ab":
        log_at(tmp_path / name / "bag" / "bag_0.db3", name)
    assert digest([str(tmp_path / "a" / "bag")]) != digest([str(tmp_path / "b" / "bag")])


def test_interrupted_run_is_not_done(tmp_path: Path) -> None:
    log = log_at(tmp_path / "run.log", "x")
    map_in(tmp_path / "whole", log, interrupted=False, status="feasible")
    map_in(tmp_path / "part", log, interrupted=True)
    assert code_of_done(tmp_path / "whole", [log], QUESTION.settings) == 10
    assert code_of_done(tmp_path / "part", [log], QUESTION.settings) is None


@pytest.mark.parametrize("at", range(1, 5))
def test_run_that_cannot_be_written_is_not_done(
    tmp_path: Path, at: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk is full at the first, second, … file.

    Files of an earlier run do not remain beside new ones.
    """
    files = [
        (RUN, b"new"),
        ("trace.jsonl", b"new"),
        ("maps.json", b"new"),
        ("recogniser.skops", b"new"),
    ]
    write_run(tmp_path, [(name, b"old") for name in FILES])
    written: list[Path] = []

    def write(path: Path, data: bytes) -> None:
        written.append(path)
        if len(written) == at:
            raise OSError(errno.ENOSPC, "No space left on device")
        path.write_bytes(data)

    monkeypatch.setattr(import_log, "write_file", write)
    with pytest.raises(UnwrittenError, match="No space left on device") as error:
        write_run(tmp_path, files)
    assert str(error.value).startswith(f"{written[-1]}: cannot be written: ")
    assert not (tmp_path / RUN).exists()
    assert not (tmp_path / "page.html").exists()
    assert written[-1].name == ["trace.jsonl", "maps.json", "recogniser.skops", RUN][at - 1]


def test_run_that_cannot_be_written_does_not_stop_other_logs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of four logs, one has no folder because a file is in its place, and for another one the disk
    is full."""
    logs = [log_at(tmp_path / f"{name}.log", name) for name in ("good", "taken", "full", "fine")]
    log_at(tmp_path / "runs" / "taken", "a file")
    asked: list[str] = []

    def here(question: object, paths: list[str], *_: object) -> object:
        for number, path in enumerate(paths):
            asked.append(path)
            yield FileAnswer(
                number, f"{path}: mapped", 0, ("it is odd",), (("maps.json", b"maps"), (RUN, b"{}"))
            )

    def write(path: Path, data: bytes) -> None:
        if path.parent.name == "full":
            raise OSError(errno.ENOSPC, "No space left on device")
        path.write_bytes(data)

    monkeypatch.setattr(jobs, "answers_here", here)
    monkeypatch.setattr(import_log, "write_file", write)
    assert main(["map", *logs, "-o", str(tmp_path / "runs")]) == 1
    told = capsys.readouterr()
    runs = tmp_path / "runs"
    assert told.out.splitlines() == [
        f"{logs[1]}: error: {runs / 'taken'}: expected a folder to write, got a file: "
        f"{runs / 'taken'}; name another one",
        f"{logs[0]}: mapped → {runs / 'good'}",
        f"{logs[2]}: error: {runs / 'full' / 'maps.json'}: cannot be written: No space left on "
        "device; make room",
        f"{logs[3]}: mapped → {runs / 'fine'}",
    ]
    assert asked == [logs[0], logs[2], logs[3]]
    assert told.err.splitlines() == [
        *(f"ssh-abduction: warning: {log}: it is odd" for log in asked),
        "ssh-abduction: errors in 2 of 4 logs, on their lines",
    ]
