"""How the program starts and ends: no file of the current folder is run, and signals end it with their codes, and with all that it began."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from unittest.mock import patch

import pytest
from aces import ACES

from ssh_abduction import program
from ssh_abduction.asp import process, workers
from ssh_abduction.asp.limits import Watch

POSIX = pytest.mark.skipif(os.name != "posix", reason="sends signals, which Windows has none of")
SOON = 60  # seconds in which what has to end soon has ended also on a slow machine that has much else to do
MODULES = """
    argparse collections copy csv dataclasses enum functools inspect json logging math pickle queue random re shutil signal socket string struct
    subprocess tempfile threading typing
""".split()  # noqa: SIM905 - one a line would take a page


@pytest.fixture
def hostile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder has a file named after each of these modules, which leaves a mark where it is run."""
    for name in MODULES:
        (tmp_path / f"{name}.py").write_text(f"open({str(tmp_path / 'mark')!r}, 'a').write({name!r})")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def modules_from(folder: str) -> list[str]:
    """The modules that this process loaded from a folder."""
    return sorted(
        name for name, module in list(sys.modules.items()) if (getattr(module, "__file__", None) or "").startswith(f"{folder}{os.sep}")
    )


def from_here(folder: str, _: Watch) -> list[str]:
    import csv  # noqa: F401 - nothing else has loaded it

    return modules_from(folder)


def from_there(number: int, folder: str, _: Callable[[], bool]) -> list[str]:
    import csv  # noqa: F401 - nothing else has loaded it

    return modules_from(folder)


def test_a_file_of_the_current_folder_is_run_if_nothing_is_done_about_it(hostile: Path) -> None:
    """What the other tests show is not so."""
    subprocess.run([sys.executable, "-c", "import csv"], check=True)
    assert "csv" in (hostile / "mark").read_text()


@pytest.mark.parametrize("first", ["", "{hostile}"], ids=["empty", "named"])
def test_no_process_that_is_begun_runs_a_file_of_the_current_folder(hostile: Path, first: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "path", [first.format(hostile=hostile), *sys.path])
    assert process.in_process(from_here, str(hostile), watch=Watch()) == []
    assert list(workers.answers(from_there, [(0, str(hostile))], 1, lambda: False, None, 1.0)) == [[]]
    assert not (hostile / "mark").exists()


@pytest.mark.parametrize(
    "words",
    [
        ["solve", ACES, ACES, "--jobs", "2", "--time-limit", "50"],
        ["facts", ACES],
    ],
    ids=" ".join,
)
def test_the_program_runs_no_file_of_the_current_folder(hostile: Path, words: list[str]) -> None:
    done = subprocess.run([sys.executable, "-P", "-m", "ssh_abduction", *words], check=False, capture_output=True, text=True)
    assert (done.returncode, (hostile / "mark").exists()) == (0, False), done.stderr


def test_without_p_the_program_puts_the_current_folder_behind_all_others(tmp_path: Path) -> None:
    """Python itself has loaded some modules by then, which are left out here; runpy does not load these ones."""
    for name in ("csv", "signal", "json", "argparse", "numpy", "clingo"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit(99)")
    done = subprocess.run([sys.executable, "-m", "ssh_abduction", "solve", ACES], cwd=tmp_path, check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_where_modules_are_looked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with patch.object(sys, "path", ["", "/other", str(tmp_path), "/lib"]):
        assert program.search_path() == ["/other", "/lib", "", str(tmp_path)]
    monkeypatch.chdir(Path(program.__file__).parents[1])  # as in a checkout
    with patch.object(sys, "path", ["", "/lib"]):
        assert program.search_path() == ["", "/lib"]
