"""Do arithmetic on small arrays in one thread.

Several threads of a library would wait for each other longer than they work.
"""

from __future__ import annotations

from contextlib import AbstractContextManager
from functools import cache
from typing import Any


def one_thread(user_api: str | None = None) -> AbstractContextManager[Any]:
    """Return a context in which libraries such as BLAS and OpenMP use one thread.

    Args:
        user_api: "blas" for matrix products alone; None for all libraries. The libraries must be
            loaded before the first call with this value.
    """
    context: AbstractContextManager[Any] = _controller(user_api).limit(limits=1, user_api=user_api)
    return context


@cache
def _controller(user_api: str | None) -> Any:
    """Find the libraries that are loaded, once for each kind, as it takes milliseconds."""
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()
