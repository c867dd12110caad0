"""The README shows only what really happens."""

from __future__ import annotations

import contextlib
import io
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from ssh_abduction.cli import main
from ssh_abduction.picture import svg
from ssh_abduction.solver.search import Status, solve
from ssh_abduction.trace import Trace

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()
BLOCKS = re.findall(r"```(\w*)\n(.*?)```", README, re.DOTALL)


def without_seconds(text: str) -> str:
    return re.sub(r"\d+\.\d\d s", "_ s", text)


def test_the_python_lines_print_what_is_shown() -> None:
    indices = [i for i, (language, _) in enumerate(BLOCKS) if language == "python"]
    assert len(indices) == 3
    for index in indices:
        with contextlib.redirect_stdout(io.StringIO()) as out:
            exec(BLOCKS[index][1], {})
        assert out.getvalue() == BLOCKS[index + 1][1]


def test_the_shell_lines_print_what_is_shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    index, lines = next((i, text.splitlines()) for i, (_, text) in enumerate(BLOCKS) if text.startswith("ssh-abduction solve"))
    assert len(lines) == 3
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    monkeypatch.chdir(tmp_path)
    shown = []
    for line in lines:
        command, _, target = line.partition(" > ")
        with contextlib.redirect_stdout(io.StringIO()) as out:
            assert main(shlex.split(command)[1:]) == 0
        if target:
            (tmp_path / target).write_text(out.getvalue())
        shown.append(out.getvalue())
    assert without_seconds(shown[0]) == without_seconds(BLOCKS[index + 1][1])
    assert shown[2].strip() in README


def test_the_line_of_many_traces_prints_what_is_shown() -> None:
    index, line = next((i, text) for i, (_, text) in enumerate(BLOCKS) if text.startswith("ssh-abduction solve examples/*"))
    command = line.replace("ssh-abduction", f"{shlex.quote(sys.executable)} -m ssh_abduction", 1)
    done = subprocess.run(command, shell=True, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert without_seconds(done.stdout) == without_seconds(BLOCKS[index + 1][1])


def test_the_trace_of_the_formats_page_has_a_map(tmp_path: Path) -> None:
    written = tmp_path / "trace.jsonl"
    written.write_text((ROOT / "docs" / "formats.md").read_text().split("```")[1].lstrip())
    assert solve(Trace.load(written)).status is Status.OPTIMAL


def test_the_picture_is_the_map() -> None:
    (ssh_map,) = solve(Trace.load(ROOT / "examples" / "notched-rectangle.jsonl")).maps
    assert (ROOT / "docs" / "notched-rectangle.svg").read_text() == svg(ssh_map) + "\n"


def test_every_file_it_names_exists() -> None:
    named = re.findall(r"\]\(([^)#:]+)\)", README) + re.findall(r"(?:examples|benchmarks|docs|ssh_abduction)/[\w./-]+\w", README)
    assert len(named) > 5
    for name in named:
        assert (ROOT / name).exists(), name
