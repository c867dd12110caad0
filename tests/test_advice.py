"""Advice names only options of the verb that prints it."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from ssh_abduction import cli
from ssh_abduction.cli import parser

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
    "ssh_abduction/solver/asp/rules.py": WITH_THEORY,
    "ssh_abduction/data/checks.py": WITH_MAPS,
    "ssh_abduction/cli/batch.py": ("solve",),
    "ssh_abduction/cli/cluster_jobs.py": ("solve", "map"),
    "ssh_abduction/cli/run_folders.py": ("map",),
    "ssh_abduction/explain/question.py": ("explain",),
    "ssh_abduction/cli/import_log.py": ("import", "map"),
    "ssh_abduction/cli/front.py": ("solve",),
    "ssh_abduction/cli/mapping.py": ("map",),
    "ssh_abduction/cli/map_logs.py": ("map",),
    "ssh_abduction/cli/next_experiment.py": ("next",),
    "ssh_abduction/cli/options.py": (*WITH_MAP, *WITH_THEORY),
    "ssh_abduction/cli/text.py": ("solve", "compare"),
    "ssh_abduction/evaluation/paper": ("reproduce",),
    "ssh_abduction/evaluation": ("evaluate",),
    "ssh_abduction/explain/no_map.py": WITH_THEORY,
    "ssh_abduction/solver/front.py": ("solve",),
    "ssh_abduction/robot_logs/log_maps.py": ("map",),
    "ssh_abduction/robot_logs/log_report.py": ("map",),
    "ssh_abduction/explain/pairs.py": ("explain",),
    "ssh_abduction/page/server.py": ("view",),
    "ssh_abduction/online/move_graph.py": ("route",),
    "ssh_abduction/online/routes.py": ("route",),
    "ssh_abduction/solver/search.py": ("solve",),
    "ssh_abduction/solver/start.py": ("solve",),
    "ssh_abduction/theory": WITH_THEORY,
}
OWN = ("train", "learning-curve", "tell-apart", "recognise")  # which cli/train.py has
OPTION = re.compile(r"(?:(?<![\w-])(\w[\w-]*) (?:with )?)?(?<![\w-])(--set [a-z_]+|--[a-z][a-z-]*)")
FOREIGN = re.compile(
    r"--\S+|%.*|[^{}]*\{.*", re.DOTALL
)  # an option of clingo's, a comment of an encoding, a style sheet


def texts(path: Path) -> Iterator[str]:
    """The texts of a module, apart from its docstrings."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
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
    for start, verbs in SAID_BY.items():
        if path.startswith(start):
            return verbs
    verb = Path(path).stem
    return (
        OWN
        if verb == "train"
        else (verb,)
        if path.startswith("ssh_abduction/cli/") and verb in VERBS
        else tuple(VERBS)
    )


def wrong(path: str, text: str) -> list[str]:
    """The options that a text names, but that no verb that prints the text has."""
    found = []
    for verb, option in OPTION.findall(text):
        asked = (verb,) if verb in VERBS else said_by(path)
        shared = path.endswith(
            ("options.py", "train.py")
        )  # which serve several verbs, each with some options
        has = [option in VERBS[one] for one in asked]
        if not (any(has) if shared else all(has)) and path != "ssh_abduction/cli/parsing.py":
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


@pytest.mark.parametrize(
    ("path", "text", "bad"),
    [
        ("ssh_abduction/cli/mapping.py", "set --memory-limit, or map fewer", ["--memory-limit"]),
        ("ssh_abduction/cli/batch.py", "set --memory-limit, or solve fewer", []),
        ("ssh_abduction/data/maps.py", "write it with solve --json", []),
        ("ssh_abduction/data/maps.py", "list fewer (map --within)", ["--within"]),
        ("ssh_abduction/data/maps.py", "list fewer (--maps)", ["--maps"]),
        ("ssh_abduction/cli/route.py", "solve with --theory topological, or take --by metres", []),
    ],
)
def test_what_is_wrong_advice(path: str, text: str, bad: list[str]) -> None:
    assert wrong(path, text) == bad
