"""Settings of all tests: how fast the machine is, and whether somebody watches it, decides
nothing."""

import contextlib
import gc
import math
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
from hypothesis import HealthCheck, settings
from threadpoolctl import threadpool_limits
from worlds import rectangle

from ssh_abduction.cli import jobs, verbosity, view

# No example takes too long, nor does it take too long to draw one. And the examples are the same in
# each run: of traces at random, some take clingo a hundred times as long as others.
settings.register_profile(
    "the same everywhere",
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("the same everywhere")

# No line of progress comes where a command takes long; tests of these lines say when they come.
verbosity.EVERY = math.inf

# A page may spend three seconds on what assumptions cost. Tests of these costs ask for them.
view.ASSUMING = 0.1

# Programs that are begun in the background do not hear Ctrl-C, nor do those that they begin. Tests
# do, from any thread that is the main one.
with contextlib.suppress(ValueError):
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_finish() -> None:
    """Each core runs tests of its own, so one thread is enough for arithmetic; and what was
    imported is not looked through for garbage again and again."""
    threadpool_limits(1)
    gc.freeze()
    gc.set_threshold(50_000, 20, 50)


def _answers(
    work: Callable[..., Any],
    tasks: Sequence[tuple[Any, ...]],
    processes: int,
    stopped: Callable[[], bool],
    *_: object,
) -> Iterator[Any]:
    """`workers.answers` without processes."""
    for task in tasks:
        if not stopped():
            yield work(*task, lambda: False)


@pytest.fixture(scope="session")
def in_this_process() -> Callable[[], AbstractContextManager[object]]:
    """A context in which many files are answered here: to begin a process takes a second.

    Tests of processes do without it, and one of them compares the answers.
    """
    return lambda: patch.object(jobs.workers, "answers", _answers)


@pytest.fixture
def without_processes(
    in_this_process: Callable[[], AbstractContextManager[object]],
) -> Iterator[None]:
    """The same for a whole test."""
    with in_this_process():
        yield


@pytest.fixture
def room(tmp_path: Path) -> str:
    """The path of a short trace that has one minimal map, of 8 dstates.

    Tests of what surrounds a search take this one: the route of ACES3 takes ten times as long.
    """
    path = tmp_path / "room.jsonl"
    rectangle(8).save(path)
    return str(path)
