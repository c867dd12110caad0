"""Accept old names of parameters for one more version, with a warning."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")

# The parameters of version 0.1.0 and what they are called now.
RENAMED = {"limit": "time_limit", "memory": "memory_limit", "maps": "max_maps"}


def renamed_parameters(*old: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Make a decorator for functions whose parameters had other names in version 0.1.0.

    A decorated function also accepts the old names, and gives a DeprecationWarning for each.
    `maps=0` becomes `max_maps=None`.

    Args:
        old: The old names that the function accepts, out of the keys of RENAMED.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        @wraps(function)
        def call(*args: P.args, **kwargs: P.kwargs) -> R:
            for name in old:
                if name in kwargs:
                    now = RENAMED[name]
                    warnings.warn(
                        f"{name} is deprecated; use {now}", DeprecationWarning, stacklevel=2
                    )
                    value = kwargs.pop(name)
                    kwargs[now] = (
                        None if name == "maps" and value == 0 and value is not False else value
                    )
            return function(*args, **kwargs)

        return call

    return decorate
