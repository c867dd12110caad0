"""Settings of all tests. Results depend neither on the speed of the machine nor on a terminal."""

import contextlib
import gc
import math
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

import pytest
from hypothesis import HealthCheck, settings
from threadpoolctl import threadpool_limits
from worlds import rectangle

from ssh_abduction import SSHMap, Trace, solve
from ssh_abduction.cli import jobs, main, outcome

if TYPE_CHECKING:
    from ssh_abduction.robot_logs.log_maps import LogMap

# Hypothesis has no deadlines, because clingo takes a hundred times as long for some random traces
# as for others. Examples are the same in each run, unless NEW_EXAMPLES is set.
settings.register_profile(
    "the same everywhere",
    deadline=None,
    derandomize="NEW_EXAMPLES" not in os.environ,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("the same everywhere")

# Commands print no progress by default. Tests of progress set the interval.
outcome.FIRST = outcome.EVERY = math.inf

# Background processes and their children ignore Ctrl-C. Restore the handler for tests.
with contextlib.suppress(ValueError):
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_finish() -> None:
    """Each core runs its own tests, so arithmetic gets one thread. Imported objects are left out of
    garbage collection, which saves time."""
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
    """Answer many files in this process, because starting a process takes a second.

    Tests of processes do not use it. One of them compares the answers.
    """
    return lambda: patch.object(jobs.workers, "answers", _answers)


@pytest.fixture
def without_processes(
    in_this_process: Callable[[], AbstractContextManager[object]],
) -> Iterator[None]:
    """`in_this_process`, for a whole test."""
    with in_this_process():
        yield


@pytest.fixture(scope="session", autouse=True)
def care() -> Iterator[int]:
    """Draw maps with little care, which saves seconds. The value is the care that users get."""
    from ssh_abduction.output import layout

    usual = layout.WORK
    with patch.object(layout, "WORK", 0):
        yield usual


@pytest.fixture
def careful_drawings(care: int) -> Iterator[None]:
    """Draw maps with the care that users get."""
    from ssh_abduction.output import layout

    with patch.object(layout, "WORK", care):
        yield


@pytest.fixture(scope="session")
def square() -> SSHMap:
    """Four places around a square of ten metres. The robot drives round once and turns around."""
    moves = [(10, 0, 0), (0, 0, 1.5708)] * 4
    trace = Trace.from_steps("abababab" + "a", ["travel", "left"] * 4, displacements=moves)
    return solve(trace).maps[0]


@pytest.fixture
def refuses(capsys: pytest.CaptureFixture[str]) -> Callable[[Sequence[str], str], None]:
    """Check that a command prints nothing but one line on stderr, which has a message."""

    def check(words: Sequence[str], message: str) -> None:
        assert main([*words]) == 1, words
        captured = capsys.readouterr()
        assert captured.out == ""
        assert captured.err.startswith("ssh-abduction: ")
        assert message in captured.err
        assert captured.err.count("\n") == 1

    return check


@pytest.fixture
def room(tmp_path: Path) -> str:
    """The path of a short trace that has one minimal map, of 8 dstates.

    Tests that need any quick search use it. The route of ACES3 takes ten times as long.
    """
    path = tmp_path / "room.jsonl"
    rectangle(8).save(path)
    return str(path)


@pytest.fixture(scope="session")
def files_of_round(map_of_round: "LogMap") -> dict[str, bytes]:
    """The files of the map of a log."""
    return map_of_round.files()


@pytest.fixture(scope="session")
def map_of_round(tmp_path_factory: pytest.TempPathFactory) -> "LogMap":
    """The map of a log, a round through the world `triangle`. The proof needs no better guess."""
    from coarse import every_second_beam

    from perception.readers.logs import read_log
    from perception.readers.scans import RobotLog
    from ssh_abduction.robot_logs.log_maps import map_log
    from ssh_abduction.solver.costs import beams

    file = tmp_path_factory.mktemp("logs") / "round.log"
    assert main(["simulate", "triangle", "-o", str(file), "--set", "every=0.5"]) == 0
    log = read_log(file)
    with patch.object(beams, "WIDTHS", (1,)):
        coarse = RobotLog(every_second_beam(log.scans[::2]), source=log.source)
        return map_log(coarse, name="round", work_limit=3)


@pytest.fixture
def house(files_of_round: dict[str, bytes], tmp_path: Path) -> Path:
    """The folder of the map of a log."""
    for name, data in files_of_round.items():
        (tmp_path / name).write_bytes(data)
    return tmp_path
