"""The only place where `data` loads a package above it: functions of `ssh_abduction.output`.

Notebooks call `_repr_html_` of a value, so the values of this package have that method. The HTML
is made in `ssh_abduction.output`, which imports this package. It is therefore loaded when it is
called.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any


def in_output(name: str) -> Callable[..., Any]:
    """The function of this name in `ssh_abduction.output`."""
    function: Callable[..., Any] = getattr(import_module("ssh_abduction.output"), name)
    return function
