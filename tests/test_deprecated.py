"""Names of version 0.1.0 still work, with a warning that gives the new name."""

from __future__ import annotations

import argparse
from importlib import import_module
from pathlib import Path

import pytest

import ssh_abduction
from ssh_abduction import OnlineMapper, Theory, Trace, solve
from ssh_abduction.cli import main, parser

ACES = str(Path(__file__).parent.parent / "examples" / "aces3-route.jsonl")
TRACE = Trace.from_steps("aba", ["travel", "travel"])


@pytest.mark.parametrize("name", ssh_abduction._MOVED)
def test_old_names_give_the_new_objects_with_a_warning(name: str) -> None:
    with pytest.warns(DeprecationWarning, match=f"ssh_abduction.{name} is deprecated; use"):
        value = getattr(ssh_abduction, name)
    assert value.__name__ == ssh_abduction._MOVED[name].rpartition(".")[2]


def test_package_exports_15_to_20_names() -> None:
    assert 15 <= len(ssh_abduction.__all__) <= 20


@pytest.mark.parametrize("package", ["", "data", "evaluation", "explain", "online", "rivals"])
def test_packages_load_each_name_that_they_export(package: str) -> None:
    module = import_module(f"ssh_abduction.{package}".rstrip("."))
    for name in module.__all__:
        assert getattr(module, name).__name__ == name
    with pytest.raises(AttributeError, match="has no attribute 'Sequence'"):
        module.Sequence  # noqa: B018 - an import for type checkers only


def test_old_parameters_work_with_a_warning() -> None:
    with pytest.warns(DeprecationWarning, match="is deprecated; use") as caught:
        found = solve(TRACE, Theory.causal(), limit=100, maps=0, memory=10_000)  # type: ignore[call-arg]
    assert found == solve(TRACE, Theory.causal(), time_limit=100, max_maps=None)
    assert [str(warning.message) for warning in caught] == [
        "limit is deprecated; use time_limit",
        "maps is deprecated; use max_maps",
        "memory is deprecated; use memory_limit",
    ]
    with pytest.warns(DeprecationWarning, match="limit is deprecated"):
        OnlineMapper("a", Theory.causal(), limit=None)  # type: ignore[call-arg]


def test_old_modules_give_the_new_packages_with_a_warning() -> None:
    for old, new in ssh_abduction._MOVED_MODULES.items():
        with pytest.warns(DeprecationWarning, match=f"{old} is deprecated; use {new}") as caught:
            assert import_module(old) is import_module(new)
        assert caught[0].filename.endswith("importlib/__init__.py")


def test_old_choices_of_a_theory_work_with_a_warning() -> None:
    expected = solve(TRACE, Theory.causal().replace(different=[(0, 2)]))
    for theory in ({"theory": Theory.causal()}, {}):
        args = (TRACE,) if theory else (TRACE, Theory.causal())
        with pytest.warns(DeprecationWarning, match="different as an argument is deprec") as caught:
            assert solve(*args, **theory, different=[(0, 2)]) == expected  # type: ignore[call-arg]
        assert caught[0].filename == __file__


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (["solve", "--boundary", "none"], ["solve", "--set", "boundary=none"]),
        (["solve", "--no-planar"], ["solve", "--set", "planar=false"]),
        (["facts", "--path-order=partial"], ["facts", "--set", "path_order=partial"]),
    ],
)
def test_old_flags_work_with_a_warning(
    old: list[str], new: list[str], room: str, capsys: pytest.CaptureFixture[str]
) -> None:
    old, new = [old[0], room, *old[1:]], [new[0], room, *new[1:]]
    assert main(new) == 0
    expected = capsys.readouterr().out.splitlines()[1:]
    assert main(old) == 0
    said = capsys.readouterr()
    assert said.out.splitlines()[1:] == expected
    assert f"is deprecated; write {' '.join(new[2:])}" in said.err


@pytest.mark.parametrize(
    ("verb", "old", "new"),
    [
        ("solve", "--star=frame", "star=frame"),
        ("solve", "--misread 1.5", "misread=1.5"),
        ("check maps.json", "--slipped 3", "slipped=3"),
        ("facts", "--rules a.lp", "rules=a.lp"),
        ("solve", "--within 2", "within=2"),
        ("solve --together", "--joint-trace all.jsonl", "joint_trace=all.jsonl"),
        ("map -o out", "--again", "again=true"),
        ("map -o out", "--fov -180", "fov=-180"),
        ("export --to svg", "--level places", "level=places"),
        ("export --to nav2", "--hide-undecided", "hide_undecided=true"),
        ("evaluate maps.json", "--relations near.txt", "relations=near.txt"),
        ("simulate -o drive.jsonl", "--images panoramas", "images=panoramas"),
    ],
)
def test_old_flags_equal_their_settings(verb: str, old: str, new: str) -> None:
    before = parser().parse_args([*verb.split(), "file", *old.split()])
    after = parser().parse_args([*verb.split(), "file", "--set", new])
    (note,) = vars(before).pop("notes")
    assert vars(after).pop("notes") == ()
    assert before == after
    assert note.endswith(f"is deprecated; write --set {new}")


def test_shell_has_at_most_50_flags() -> None:
    flags = {
        name
        for each in (parser(), *parser().verbs.values())
        for action in each._actions
        if action.help != argparse.SUPPRESS
        for name in action.option_strings
        if name.startswith("--")
    }
    assert len(flags) <= 50, sorted(flags)


def test_maps_of_version_0_1_0_are_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The output of 0.1.0, and its order of files."""
    old = Path(__file__).parent / "files" / "maps-0.1.0.json"
    assert main(["check", str(old), ACES, "--bound"]) == 0
    assert main(["check", ACES, str(old)]) == 0
    assert "name the maps first" in capsys.readouterr().err
    picture = tmp_path / "map.svg"
    assert main(["show", str(old), "--svg", str(picture)]) == 0
    assert picture.read_text().startswith("<svg")


def test_a_theory_is_read_from_a_file(
    tmp_path: Path, room: str, capsys: pytest.CaptureFixture[str]
) -> None:
    toml = tmp_path / "mine.toml"
    toml.write_text('preset = "topological"\nboundary = "none"\nprefer = ["dstates", "paths"]\n')
    assert Theory.from_toml(toml) == Theory(boundary="none", prefer=("dstates", "paths"))
    assert main(["solve", room, "--theory", str(toml)]) == 0
    by_file = capsys.readouterr().out.splitlines()[1:]
    flags = ["--set", "boundary=none", "--set", "prefer=dstates,paths"]
    assert main(["solve", room, *flags]) == 0
    assert capsys.readouterr().out.splitlines()[1:] == by_file
    toml.write_text("boundary = 3\n")
    assert main(["solve", room, "--theory", str(toml)]) == 1
    assert "mine.toml: boundary: expected none, strict or defeasible" in capsys.readouterr().err


def test_old_names_of_search_counts_warn_and_work() -> None:
    solution = solve(TRACE)
    for name in ("prefix", "grounding", "evidence"):
        with pytest.warns(DeprecationWarning, match=f"use Solution.effort.{name}"):
            assert getattr(solution, name) == getattr(solution.effort, name)
    with pytest.warns(DeprecationWarning, match=r"use Solution\.warnings"):
        assert solution.odometry_warning is None  # type: ignore[attr-defined]
    with pytest.raises(AttributeError, match="'Solution' object has no attribute 'maze'"):
        solution.maze  # type: ignore[attr-defined]  # noqa: B018
