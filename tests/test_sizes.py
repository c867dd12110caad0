"""Modules and classes stay small, and `__init__` names all attributes of an object."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

MOST_LINES, MOST_METHODS, MOST_ATTRIBUTES = 720, 28, 17
# The fields of a theory are the choices that a user has, each with a name of its own.
MANY_FIELDS = {"Theory", "Choices"}
ROOT = Path(__file__).parent.parent
MODULES = [
    path
    for name in ("ssh_abduction", "perception", "simulator")
    for path in ROOT.glob(f"{name}/**/*.py")
]
FIRST = {"__init__", "__new__", "__post_init__"}


def faults_of(text: str) -> Iterator[str]:
    """The limits that a module breaks."""
    if (lines := text.count("\n")) > MOST_LINES:
        yield f"{lines} lines"
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.ClassDef):
            yield from (f"{node.name}: {fault}" for fault in faults_of_class(node))


def faults_of_class(node: ast.ClassDef) -> Iterator[str]:
    methods: dict[str, list[ast.FunctionDef]] = {}
    fields: set[str] = set()
    for part in flat(node.body):
        if isinstance(part, ast.FunctionDef):
            methods.setdefault(part.name, []).append(part)
        elif isinstance(part, ast.AnnAssign) and isinstance(part.target, ast.Name):
            fields.add(part.target.id)
    if len(methods) > MOST_METHODS:
        yield f"{len(methods)} methods"
    made = {
        name: {attribute for method in some for attribute in made_in(method)}
        for name, some in methods.items()
    }
    attributes = fields.union(*made.values())
    if len(attributes) > MOST_ATTRIBUTES and node.name not in MANY_FIELDS:
        yield f"{len(attributes)} attributes"
    early = fields.union(*(made[name] for name in FIRST & made.keys()))
    for name in sorted(made.keys() - FIRST):
        # In scikit-learn, `fit` makes the attributes whose names end in an underscore.
        fitted = {a for a in made[name] if a.endswith("_")} if name == "fit" else set()
        if late := made[name] - early - fitted:
            yield f"{name} makes {', '.join(sorted(late))}"


def flat(body: list[ast.stmt]) -> Iterator[ast.stmt]:
    """The statements of a class, those under `if TYPE_CHECKING` too."""
    for part in body:
        yield from flat([*part.body, *part.orelse]) if isinstance(part, ast.If) else [part]


def made_in(method: ast.FunctionDef) -> Iterator[str]:
    """The attributes of its object that a method assigns."""
    arguments = [*method.args.posonlyargs, *method.args.args]
    for node in ast.walk(method):
        if (
            arguments
            and isinstance(node, ast.Attribute)
            and isinstance(node.ctx, ast.Store)
            and isinstance(node.value, ast.Name)
            and node.value.id == arguments[0].arg
        ):
            yield node.attr


def test_modules_and_classes_are_small() -> None:
    assert len(MODULES) > 200
    found = {
        str(path.relative_to(ROOT)): faults
        for path in MODULES
        if (faults := [*faults_of(path.read_text(encoding="utf-8"))])
    }
    assert not found


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("\n" * 721, "721 lines"),
        ("class A:\n" + "".join(f"    def f{i}(self): ...\n" for i in range(29)), "A: 29 methods"),
        ("class A:\n" + "".join(f"    f{i}: int\n" for i in range(18)), "A: 18 attributes"),
        ("class A:\n    def f(self):\n        self.x, self.z = self.y, 2", "A: f makes x, z"),
        ("class A:\n    def fit(self):\n        self.x = self.y_ = 1", "A: fit makes x"),
    ],
)
def test_faults_of_finds_modules_and_classes_that_are_too_large(text: str, fault: str) -> None:
    assert [*faults_of(text)] == [fault]
