"""The program runs no file of the current folder, and signals end it."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
from aces import ACES
from coarse import hall
from in_processes import from_here, from_there, until
from worlds import TOURS, drive

from perception.readers.writers import write_carmen
from ssh_abduction import Solution
from ssh_abduction.cli import main
from ssh_abduction.robot_logs.log_maps import LogMapping
from ssh_abduction.runtime import program, workers
from ssh_abduction.runtime.limits import Watch, in_process

POSIX = pytest.mark.skipif(os.name != "posix", reason="sends signals, which Windows has none of")
SOON = 60  # seconds, enough on a slow and busy machine
MODULES = """
    argparse collections copy csv dataclasses enum functools inspect json logging math pickle queue
    random re shutil signal socket string struct subprocess tempfile threading typing
""".split()  # noqa: SIM905 - one a line would take a page


@pytest.fixture
def hostile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a file named after each of these modules, which leaves a mark if it is run."""
    for name in MODULES:
        (tmp_path / f"{name}.py").write_text(
            f"open({str(tmp_path / 'mark')!r}, 'a').write({name!r})"
        )
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_python_imports_modules_of_the_current_folder(hostile: Path) -> None:
    """Without the protection, the modules in the folder are run."""
    subprocess.run([sys.executable, "-c", "import csv"], check=True)
    assert "csv" in (hostile / "mark").read_text()


def test_workers_import_no_module_of_the_current_folder(
    hostile: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "path", ["", str(hostile), *sys.path])
    assert in_process(from_here, str(hostile), watch=Watch()) == []
    assert list(workers.answers(from_there, [(0, str(hostile))], 1, lambda: False, None, 1.0)) == [
        []
    ]
    assert not (hostile / "mark").exists()


@pytest.mark.slow
def test_program_imports_no_module_of_the_current_folder(hostile: Path, room: str) -> None:
    words = "solve ROOM ROOM --jobs 2 --time-limit 50"
    done = subprocess.run(
        [sys.executable, "-P", "-m", "ssh_abduction", *words.replace("ROOM", room).split()],
        check=False,
        capture_output=True,
        text=True,
    )
    assert (done.returncode, (hostile / "mark").exists()) == (0, False), done.stderr


def test_program_without_p_searches_the_current_folder_last(tmp_path: Path) -> None:
    """Python has loaded some other modules by then. runpy does not load these ones."""
    for name in ("csv", "signal", "json", "argparse", "numpy", "clingo"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit(99)")
    # Two maps are compared, which takes numpy.
    drive(*TOURS["tee"]).save(tmp_path / "tee.jsonl")
    done = subprocess.run(
        [sys.executable, "-m", "ssh_abduction", "solve", "tee.jsonl", "--set", "boundary=none"],
        cwd=tmp_path,
        check=False,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr


def test_current_folder_moves_to_the_end_of_the_module_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with patch.object(sys, "path", ["", "/other", str(tmp_path), "/lib"]):
        assert program.search_path() == ["/other", "/lib", "", str(tmp_path)]
    monkeypatch.chdir(Path(program.__file__).parents[2])  # as in a checkout
    with patch.object(sys, "path", ["", "/lib"]):
        assert program.search_path() == ["", "/lib"]


# A verb that waits in clingo, which ignores signals.
DEAF = """
import sys, clingo
from ssh_abduction import __main__
from ssh_abduction.cli import outcome, parser
outcome.DEAF = 0.2
def run(options):
    print("ready", flush=True)
    control = clingo.Control()
    control.add("p(0). p(X+1) :- p(X), X < 1000000000.")
    control.ground()
parser().verbs["facts"].set_defaults(act=run)
__main__.run()
"""


@POSIX
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_verb_without_handler_ends_with_the_exit_code_of_the_signal(number: int, code: int) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", DEAF, "facts", ACES], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout
        assert process.stdout.readline() == "ready\n"
        process.send_signal(number)
        assert process.wait(SOON) == code


@pytest.fixture
def forgotten_signals(monkeypatch: pytest.MonkeyPatch) -> None:
    """Forget the signals that other tests sent, and those of this test."""
    for name in ("heard", "raised"):
        monkeypatch.setattr(program, name, [])


@pytest.mark.slow
@POSIX
def test_interrupted_map_run_is_repeated_by_the_next_call(
    tmp_path: Path,
    forgotten_signals: None,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    log, runs = tmp_path / "drive.log", tmp_path / "runs"
    write_carmen(log, hall()[:80])
    solve = LogMapping.solve

    def solve_until_a_signal(mapping: LogMapping, *trace: Any, **limits: Any) -> Solution:
        solution = solve(mapping, *trace, **limits)
        os.kill(os.getpid(), signal.SIGTERM)
        return solution

    with monkeypatch.context() as patched:
        patched.setattr(LogMapping, "solve", solve_until_a_signal)
        assert main(["map", str(log), "-o", str(runs)]) == 143
    assert "The run was interrupted" in capsys.readouterr().err
    run = json.loads((runs / "run.json").read_text())
    assert (run["interrupted"], run["status"]) == (True, "optimal")
    assert "The run was interrupted" in (runs / "page.html").read_text()
    assert Solution.load(runs / "maps.json").maps
    assert main(["map", str(log), "-o", str(runs)]) == 0
    assert json.loads((runs / "run.json").read_text())["interrupted"] is False
    assert main(["map", str(log), "-o", str(runs)]) == 0
    assert "done already" in capsys.readouterr().out


@POSIX
def test_temporary_files_of_workers_are_removed(tmp_path: Path) -> None:
    """They are removed even if the parent of the workers is killed."""
    told = tmp_path / "told"
    script = f"""
from ssh_abduction.runtime import workers
from in_processes import leave_a_temporary_file
list(workers.answers(leave_a_temporary_file, [(0, {str(told)!r})], 1, lambda: False, None, 1.0))
"""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "TMPDIR": str(tmp_path)}
    with subprocess.Popen([sys.executable, "-c", script], env=environment) as parent:
        until(lambda: told.exists() and bool(told.read_text()))
        assert Path(told.read_text()).is_relative_to(tmp_path)
        parent.kill()
    until(lambda: not Path(told.read_text()).exists())
    until(lambda: list(tmp_path.iterdir()) == [told])
