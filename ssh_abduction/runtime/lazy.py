"""Load each name that a package exports, and each maker of notebook cards, at its first use.

When this module is loaded, it imports only `sys`, as `ssh_abduction/__init__.py` does.
"""

import sys

TYPE_CHECKING = False  # as in typing, which takes longer to load than this whole module

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Any


def lazy_names(package: str) -> "tuple[Callable[[str], Any], Callable[[], list[str]]]":
    """Make the `__getattr__` and `__dir__` of a package that loads each name when it is first used.

    The package exports the names that its source imports by `as`, below `if TYPE_CHECKING`. They
    are its `__all__`.

    Returns:
        The function `__getattr__`, which loads and returns the value of a name, and the function
        `__dir__`, which lists all names.
    """
    where: dict[str, tuple[str, str]] = {}  # the module of each name, and its name there

    def exported() -> "list[str]":
        if not where:
            where.update(_exports_of(package))
        return sorted(where)

    def load(name: str) -> "Any":
        from importlib import import_module

        if name == "__all__":
            return exported()
        if name not in exported():
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module, there = where[name]
        loaded = import_module(module)
        value = (
            getattr(loaded, there) if hasattr(loaded, there) else import_module(f"{module}.{there}")
        )
        setattr(sys.modules[package], name, value)
        return value

    def names() -> "list[str]":
        return sorted({*vars(sys.modules[package]), *exported()})

    return load, names


# The function that makes the notebook card of each class of values: its module and its name.
CARDS: "dict[str, tuple[str, str]]" = {}


def card_of(value: "Any") -> str:
    """Make the HTML of a value for notebooks, with the function that CARDS names for its class."""
    from importlib import import_module

    kind = next(kind.__name__ for kind in type(value).__mro__ if kind.__name__ in CARDS)
    module, name = CARDS[kind]
    html: str = getattr(import_module(module), name)(value)
    return html


def _exports_of(package: str) -> "dict[str, tuple[str, str]]":
    """Read the names that a package imports by `as`, each with its module and its name there."""
    import ast

    spec: Any = sys.modules[package].__spec__
    return {
        alias.asname: (node.module, alias.name)
        for node in ast.walk(ast.parse(spec.loader.get_source(package)))
        if isinstance(node, ast.ImportFrom) and node.module is not None
        for alias in node.names
        if alias.asname is not None
    }
