"""Call functions of `ssh_abduction.output` from values of this package, for notebooks.

Notebooks call the method `_repr_html_` of traces and maps. The HTML is made in
`ssh_abduction.output`, which imports this package. To avoid a cycle of imports, this module loads
`ssh_abduction.output` only when HTML is asked for. No other module of `data` imports from packages
above it.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any


def in_output(name: str) -> Callable[..., Any]:
    """Load and return the function with this name in `ssh_abduction.output`."""
    function: Callable[..., Any] = getattr(import_module("ssh_abduction.output"), name)
    return function
