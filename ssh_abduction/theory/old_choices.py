"""Accept the fields of a theory as keywords of a function, as version 0.1.0 did."""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Callable
from dataclasses import fields
from functools import wraps
from typing import ParamSpec, TypeVar

from ssh_abduction.theory.theory import Theory, checked_theory

P = ParamSpec("P")
R = TypeVar("R")


def with_old_choices(function: Callable[P, R]) -> Callable[P, R]:
    """Decorate a function that has a parameter `theory`.

    The function then also accepts fields of a theory, and gives a DeprecationWarning for them. The
    warning is about the caller if `renamed_parameters` is the only decorator above this one.
    """
    signature = inspect.signature(function)
    old = {field.name for field in fields(Theory)} - signature.parameters.keys()

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        choices = {name: kwargs.pop(name) for name in [*kwargs] if name in old}
        if not choices:
            return function(*args, **kwargs)
        warnings.warn(
            f"{', '.join(choices)} as an argument is deprecated; give it to Theory.replace",
            DeprecationWarning,
            stacklevel=3,
        )
        bound = signature.bind_partial(*args, **kwargs)
        theory = checked_theory(bound.arguments.get("theory"))
        bound.arguments["theory"] = theory.replace(**choices)
        return function(*bound.args, **bound.kwargs)

    return call
