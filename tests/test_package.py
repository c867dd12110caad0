"""The wheel holds the encodings, and shadows no modules of Python."""

from __future__ import annotations

import ast
import os
import re
import shlex
import subprocess
import sys
import zipfile
from importlib import import_module
from pathlib import Path

import pytest

import ssh_abduction
from ssh_abduction.cli import main
from ssh_abduction.theory import encodings

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files that the wheel puts into site-packages."""
    built, unpacked = tmp_path_factory.mktemp("built"), tmp_path_factory.mktemp("site")
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(built)],
        cwd=ROOT,
        check=True,
        capture_output=True,
    )
    (wheel,) = built.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(unpacked)
    return unpacked


@pytest.mark.slow
def test_wheel_contains_encodings_examples_and_all_packages(
    installed: Path, tmp_path: Path
) -> None:
    for folder in ("encodings", "examples"):
        assert {p.name for p in (ROOT / folder).rglob("*.*")} == {
            p.name for p in (installed / "ssh_abduction" / folder).rglob("*.*")
        }
    assert (installed / "ssh_abduction/py.typed").exists()
    assert {p.name for p in installed.iterdir() if not p.name.endswith(".dist-info")} == {
        "ssh_abduction",
        "perception",
        "simulator",
    }
    program = (
        "import sys; sys.path.insert(0, sys.argv[1]); import ssh_abduction; from ssh_abduction "
        "import *; from ssh_abduction.theory import encodings;"
        "assert ssh_abduction.__file__.startswith(sys.argv[1]) and "
        "str(encodings.folder()).startswith(sys.argv[1]);"
        "print(solve(Trace.from_steps('aba', ['travel', 'around'])).cost.dstates)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, str(installed)],
        cwd=tmp_path,
        check=True,
        capture_output=True,
        text=True,
    )
    assert done.stdout == "3\n"


@pytest.mark.slow
def test_readme_commands_run_with_the_installed_wheel(installed: Path, tmp_path: Path) -> None:
    lines, output = re.findall(
        r"```sh\n([^`]*examples/[^`]*)```\n\n```\n(.*?)```",
        (ROOT / "README.md").read_text(),
        re.DOTALL,
    )[0]
    command = re.sub(
        r"^ssh-abduction",
        f"{shlex.quote(sys.executable)} -m ssh_abduction",
        f"ssh-abduction examples -q\n{lines}",
        flags=re.MULTILINE,
    )
    environment = {**os.environ, "PYTHONPATH": str(installed)}
    done = subprocess.run(
        command,
        shell=True,
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    said, _, shown = done.stdout.partition("\n")
    assert (
        said.startswith(f"{len(list((ROOT / 'examples').glob('*.*')))} examples in examples: "),
        without_speed(shown),
    ) == (True, without_speed(output))


def without_speed(text: str) -> str:
    """Remove seconds, and the number of steps that clingo needed, from a text."""
    return re.sub(r"\d+\.\d+ s|\d+ of \d+ steps", "_", text)


def test_examples_does_not_overwrite_changed_files(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "deep" / "copies"
    assert main(["examples", "-o", str(folder)]) == main(["examples", "-o", str(folder)]) == 0
    (folder / "demo.py").write_text("mine")
    (folder / "adventure.py").unlink()
    assert main(["examples", "-o", str(folder)]) == 1
    assert (
        "demo.py: expected no file, or the example of this name, got another one; nothing was "
        "copied" in capsys.readouterr().err
    )
    assert (folder / "demo.py").read_text() == "mine"
    assert not (folder / "adventure.py").exists()


def test_encodings_folder_is_not_a_package() -> None:
    assert not (ROOT / "encodings" / "__init__.py").exists()
    assert encodings.folder().is_dir()


def test_perception_and_simulator_export_nothing() -> None:
    for wing in ("perception", "simulator"):
        (docstring,) = ast.parse((ROOT / wing / "__init__.py").read_text()).body
        assert isinstance(docstring, ast.Expr)


def test_every_exported_name_exists() -> None:
    for name in ssh_abduction.__all__:
        assert getattr(ssh_abduction, name).__name__ == name


@pytest.mark.parametrize(
    ("folder", "least"), [("ssh_abduction", 50), ("perception", 20), ("simulator", 9)]
)
def test_docstrings_run(folder: str, least: int) -> None:
    import doctest
    import importlib

    attempted = 0
    for path in sorted((ROOT / folder).rglob("*.py")):
        if ">>> " in path.read_text():
            name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
            result = doctest.testmod(importlib.import_module(name))
            assert result.failed == 0, name
            attempted += result.attempted
    assert attempted > least


def test_citation_and_changelog_have_the_package_version() -> None:
    import tomllib

    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert f"\nversion: {project['version']}\n" in (ROOT / "CITATION.cff").read_text()
    changelog = (ROOT / "CHANGELOG.md").read_text()
    assert f"\n## {project['version']} " in changelog
    assert re.search(r"^## [\d.]+ \(unreleased\)$", changelog, re.MULTILINE)


def test_import_linter_sees_all_imports_of_the_package() -> None:
    """It does not see a module that is named in a string."""
    found = [
        (path.name, name)
        for path in (ROOT / "ssh_abduction").rglob("*.py")
        for name in re.findall(r"import_module\(\"(ssh_abduction\.[^\"]+)", path.read_text())
    ]
    assert found == []


def test_package_exports_15_to_20_names() -> None:
    assert 15 <= len(ssh_abduction.__all__) <= 20


@pytest.mark.parametrize("package", ["", "data", "evaluation", "explain", "online", "rivals"])
def test_packages_load_each_name_that_they_export(package: str) -> None:
    module = import_module(f"ssh_abduction.{package}".rstrip("."))
    for name in module.__all__:
        assert getattr(module, name).__name__ == name
    with pytest.raises(AttributeError, match="has no attribute 'Sequence'"):
        module.Sequence  # noqa: B018 - an import for type checkers only
