"""Advice names only options of the verb that prints it."""

from __future__ import annotations

import ast
import inspect
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from modules import parsed

from ssh_abduction import cli
from ssh_abduction.cli import parser
from ssh_abduction.cli.shared import helps
from ssh_abduction.theory.theory import Theory

ROOT = Path(cli.__file__).parents[2]
VERBS = {
    name: {*verb.names, *(f"--set {setting}" for setting in verb.settings)}
    for name, verb in parser().verbs.items()
}
WITH_THEORY = tuple(name for name, options in VERBS.items() if "--theory" in options)
WITH_MAPS = tuple(name for name, options in VERBS.items() if "--maps" in options)
WITH_MAP = tuple(name for name, options in VERBS.items() if "--map" in options)
# The verbs that print what a module says, where that is not one verb of the module's name. All of
# them have each option that is named without a verb. A sentence that other verbs print too names
# the verb: "write it with solve --json".
SAID_BY = {
    "perception/places": ("import", "map"),
    "perception/readers": ("import", "map"),
    "simulator": ("simulate",),
    "ssh_abduction/data/checks.py": WITH_MAPS,
    "ssh_abduction/cli/batch.py": ("solve",),
    "ssh_abduction/cli/jobs.py": ("solve", "map"),
    "ssh_abduction/cli/import_log.py": ("import", "map"),
    "ssh_abduction/cli/solve.py": ("solve",),
    "ssh_abduction/cli/mapping.py": ("map",),
    "ssh_abduction/cli/shared.py": (*WITH_MAP, *WITH_THEORY),
    "ssh_abduction/cli/text.py": ("solve",),
    "ssh_abduction/evaluation": ("evaluate",),
    "ssh_abduction/solution/corrected.py": ("correct",),
    "ssh_abduction/solver/entry.py": ("solve",),
    "ssh_abduction/robot_logs/log_maps.py": ("map",),
    "ssh_abduction/robot_logs/log_report.py": ("map",),
    "ssh_abduction/explain/pair_reasons.py": ("explain",),
    "ssh_abduction/page/server.py": ("view",),
    "ssh_abduction/online/routes.py": ("route",),
    "ssh_abduction/solver/search.py": ("solve",),
    "ssh_abduction/building/directions.py": ("route",),
    "ssh_abduction/cli/live_map.py": ("live",),
    "ssh_abduction/robot_logs/live_page.py": ("live",),
    "ssh_abduction/robot_logs/ros_node.py": ("live",),
    "ssh_abduction/solver/parts.py": ("solve",),
    "ssh_abduction/theory": WITH_THEORY,
}
# The verbs of modules whose verbs have different options. Each has some of the options that the
# module names without a verb.
SEVERAL = {
    "ssh_abduction/explain/no_map.py": WITH_THEORY,
    "ssh_abduction/cli/__init__.py": ("solve", "map", "next"),
    "ssh_abduction/cli/shared.py": SAID_BY["ssh_abduction/cli/shared.py"],
    "ssh_abduction/cli/about.py": ("theory", "facts", "completion"),
    "ssh_abduction/cli/compare.py": ("compare", "next", "evaluate"),
    "ssh_abduction/cli/correct.py": ("correct", "name", "solve"),
    "ssh_abduction/cli/judge.py": ("check", "explain"),
    "ssh_abduction/cli/learn.py": ("cluster", "train", "recognise"),
    "ssh_abduction/cli/use.py": ("localise", "route", "show", "export", "view"),
    "ssh_abduction/cli/simulate.py": ("simulate", "examples", "show"),
}
OPTION = re.compile(r"(?:(?<![\w-])(\w[\w-]*) (?:with )?)?(?<![\w-])(--set [a-z_]+|--[a-z][a-z-]*)")
FOREIGN = re.compile(
    r"--\S+|%.*|[^{}]*\{.*", re.DOTALL
)  # an option of clingo's, a comment of an encoding, a style sheet


def texts(path: Path) -> Iterator[str]:
    """The texts of a module, apart from its docstrings."""
    tree = parsed(path)
    told = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if (
            isinstance(node, ast.Constant)
            and isinstance(node.value, str)
            and id(node) not in told
            and not FOREIGN.fullmatch(node.value)
        ):
            yield node.value


def said_by(path: str) -> tuple[str, ...]:
    """The verbs that print the texts of a module; all verbs if that is unknown."""
    for start, verbs in (SEVERAL | SAID_BY).items():
        if path.startswith(start):
            return verbs
    verb = Path(path).stem
    is_verb = path.startswith("ssh_abduction/cli/") and verb in VERBS
    return (verb,) if is_verb else tuple(VERBS)


def wrong(path: str, text: str) -> list[str]:
    """The options that a text names, but that no verb that prints the text has."""
    found = []
    for verb, option in OPTION.findall(text):
        asked = (verb,) if verb in VERBS else said_by(path)
        has = [option in VERBS[one] for one in asked]
        if (
            not (any(has) if path in SEVERAL else all(has))
            and path != "ssh_abduction/cli/parsing.py"
        ):
            found.append(option)
    return found


@pytest.mark.parametrize("folder", ["ssh_abduction", "perception", "simulator"])
def test_advice_names_options_that_the_verb_has(folder: str) -> None:
    modules = {
        path.relative_to(ROOT).as_posix(): path for path in sorted((ROOT / folder).rglob("*.py"))
    }
    assert [
        (name, text, bad)
        for name, path in modules.items()
        for text in texts(path)
        if (bad := wrong(name, text))
    ] == []


def without_advice(tree: ast.AST) -> list[str]:
    """The errors of a module that say what is wrong, but not what to do: no text after `;`."""
    raised = [node.exc for node in ast.walk(tree) if isinstance(node, ast.Raise)]
    found = []
    for call in raised:
        parts = [node.value for node in ast.walk(call or ast.Pass()) if is_text(node)]
        text = "".join(parts)
        # argparse adds how an option is used. Callers add what to do to the other two.
        has_caller = isinstance(call, ast.Call) and ast.unparse(call.func).startswith(
            ("argparse.", "ValueError", "Damaged")
        )
        is_mended = ";" in text or "{mend}" in ast.unparse(call or ast.Pass())
        if re.search("expected .*, got ", text, re.DOTALL) and not is_mended and not has_caller:
            found.append(text)
    return found


def is_text(node: ast.AST) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, str)


@pytest.mark.parametrize("folder", ["ssh_abduction", "perception", "simulator"])
def test_errors_say_what_to_do(folder: str) -> None:
    assert [
        (path.name, text)
        for path in sorted((ROOT / folder).rglob("*.py"))
        for text in without_advice(parsed(path))
    ] == []


def test_an_error_without_advice_is_found() -> None:
    without = ast.parse('raise MapError(f"{name}: expected a map, got {x}")')
    assert without_advice(without) == [": expected a map, got "]
    assert without_advice(ast.parse('raise MapError("expected a map, got none; take one")')) == []


@pytest.mark.parametrize(
    ("path", "text", "bad"),
    [
        ("ssh_abduction/cli/mapping.py", "set --memory-limit, or map fewer", ["--memory-limit"]),
        ("ssh_abduction/cli/batch.py", "set --memory-limit, or solve fewer", []),
        ("ssh_abduction/data/maps.py", "write it with solve --json", []),
        ("ssh_abduction/data/maps.py", "list fewer (map --within)", ["--within"]),
        ("ssh_abduction/data/maps.py", "list fewer (--maps)", ["--maps"]),
        (
            "ssh_abduction/cli/use.py",
            "solve with --theory topological, or take --by metres",
            [],
        ),
    ],
)
def test_wrong_finds_options_that_the_verb_lacks(path: str, text: str, bad: list[str]) -> None:
    assert wrong(path, text) == bad


def test_help_reads_docstrings_without_indentation(monkeypatch: pytest.MonkeyPatch) -> None:
    """Python 3.13 removes the indentation of docstrings, and python -OO the docstrings."""
    indented = helps()
    assert indented["level"]
    monkeypatch.setattr(Theory, "__doc__", inspect.cleandoc(Theory.__doc__ or ""))
    assert helps() == indented
    monkeypatch.setattr(Theory, "__doc__", None)
    assert {*parser().verbs} == {*VERBS}
