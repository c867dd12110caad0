"""Keep arithmetic on small arrays to one thread.

The threads of libraries would mostly wait for each other, longer than they work.
"""

from __future__ import annotations

from contextlib import AbstractContextManager
from functools import cache
from typing import Any


def one_thread(user_api: str | None = None) -> AbstractContextManager[Any]:
    """Return a context in which libraries of arithmetic use one thread.

    Args:
        user_api: "blas" for matrix products alone; None for all libraries. The libraries must be
            loaded before the first call with this value.
    """
    context: AbstractContextManager[Any] = _controller(user_api).limit(limits=1, user_api=user_api)
    return context


@cache
def _controller(user_api: str | None) -> Any:
    """Find the libraries that this process has loaded, once, since that takes milliseconds.

    Args:
        user_api: What the controller is for. Libraries of other kinds may be loaded later.
    """
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()
