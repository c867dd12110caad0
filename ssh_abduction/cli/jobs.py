"""Answer a question about many files, in processes of this machine.

`cluster_jobs.py` does the same on a Dask cluster. Both yield answers as soon as they are ready.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Generator, Sequence
from typing import Any, Protocol

from ssh_abduction.cli import EXIT_ERROR
from ssh_abduction.cli.outcome import on_ctrl_c
from ssh_abduction.data.errors import AbductionError, printable
from ssh_abduction.runtime.program import SIGNALLED, interrupted_code
from ssh_abduction.solver import workers


class StopFlag:
    """Whether all work is to stop. Signal handlers may set it, unlike a `threading.Event`."""

    def __init__(self) -> None:
        self._is_set = False

    def set(self) -> None:
        self._is_set = True

    def is_set(self) -> bool:
        return self._is_set


def in_a_line(error: Exception) -> str:
    """The message of an error on one line."""
    is_ours = isinstance(error, AbductionError)
    message = str(error) if is_ours else f"{type(error).__name__}: {error}"
    return printable(" ".join(message.split()))


class Asked(Protocol):
    """A question about each of many files.

    Questions and answers are plain data: they are sent to other processes and machines.
    """

    @property
    def overdue(self) -> float | None:
        """Seconds after which a process without an answer counts as lost; None waits for ever."""

    @property
    def has_limits(self) -> bool:
        """Whether each answer needs a process of its own, which can be killed."""

    @property
    def limit(self) -> float | None:
        """Seconds for each file; None for no limit."""

    @property
    def patience(self) -> float:
        """Seconds to wait for the answers under way when all work is to stop."""

    def load(self, path: str) -> Any:
        """Read what a worker without this disk needs. An error becomes the answer."""

    def answer(self, number: int, path: str, content: Any, given_up: Callable[[], bool]) -> Any:
        """Answer for one file.

        Args:
            number: The number of the file, which the answer repeats.
            path: The file.
            content: What `load` returned; None to read the file here.
            given_up: Whether nobody wants the answer any more.
        """

    def lost(self, lost: workers.Lost, path: str) -> Any:
        """The answer for a file whose process ended without an answer."""

    def failed(self, number: int, path: str, error: Exception) -> Any:
        """The answer for a file that raised an error."""


def answers_here(
    question: Asked, paths: Sequence[str], jobs: int, stop: StopFlag
) -> Generator[Any]:
    """Yield answers from processes of this machine, as they are ready.

    If a process is killed, only its own file is lost. The processes do not receive Ctrl-C; `stop`
    says so to them. After that, unfinished files still yield what is known.

    Args:
        question: The question.
        paths: The files.
        jobs: The number of processes; -1 for one a core.
        stop: Set by Ctrl-C, or by the caller to stop early.
    """

    def end() -> None:
        if stop.is_set():  # Ctrl-C once more
            raise KeyboardInterrupt
        stop.set()

    from joblib import effective_n_jobs

    tasks = [(number, path, question) for number, path in enumerate(paths)]
    processes = min(effective_n_jobs(jobs), len(paths))
    with on_ctrl_c(end):
        for answer in workers.answers(
            _solved_in_worker, tasks, processes, stop.is_set, question.overdue, question.patience
        ):
            if not isinstance(answer, workers.Lost):
                yield answer
            elif not stop.is_set():  # a process that was stopped without an answer is no error
                yield question.lost(answer, paths[answer.number])


def final_code(codes: Sequence[int], asked: int, stop: StopFlag, files: str) -> int:
    """The exit code after many files. Reports interruptions and errors on stderr.

    Args:
        codes: The exit codes of the answers.
        asked: The number of files.
        stop: Set if Ctrl-C was pressed.
        files: What messages call the files, such as "traces".
    """
    if stop.is_set():
        missing = asked - sum(code <= SIGNALLED for code in codes)
        print(
            f"ssh-abduction: interrupted: {missing} of {asked} {files} not finished",
            file=sys.stderr,
        )
        return interrupted_code()
    if errors := codes.count(EXIT_ERROR):
        print(
            f"ssh-abduction: errors in {errors} of {asked} {files}, on their lines",
            file=sys.stderr,
        )
        return EXIT_ERROR
    return max(codes, default=0)


def _solved_in_worker(number: int, path: str, question: Asked, given_up: Callable[[], bool]) -> Any:
    return question.answer(number, path, None, given_up)
