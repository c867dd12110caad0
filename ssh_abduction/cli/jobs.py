"""Answer the same question about many files, in processes of this machine.

`cluster_jobs.py` does so on a Dask cluster. Both yield each answer as soon as it is ready.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

from ssh_abduction.cli import EXIT_ERROR
from ssh_abduction.cli.outcome import StopFlag, on_ctrl_c
from ssh_abduction.cli.text import counted
from ssh_abduction.data.errors import AbductionError, SolverError, printable
from ssh_abduction.runtime.program import SIGNALLED, interrupted_code
from ssh_abduction.solver import workers


def in_a_line(error: Exception) -> str:
    """Write an error on one line. An unexpected error also gets its type."""
    is_ours = isinstance(error, AbductionError)
    message = str(error) if is_ours else f"{type(error).__name__}: {error}"
    return printable(" ".join(message.split()))


@dataclass(frozen=True, slots=True)
class FileAnswer:
    """The answer for one file, as plain data."""

    number: int  # the number of the file in the command line, from 0
    line: str  # the line to print
    code: int  # the exit code
    warnings: tuple[str, ...] = ()  # the warnings to print
    files: tuple[tuple[str, bytes], ...] = ()  # names and contents of the files to write


class FileQuestion(Protocol):
    """A question to be answered for each of many files.

    Questions and answers are plain data, because they are sent to other processes and machines.
    """

    __slots__ = ()
    limit: float | None  # the seconds for each file; None for no limit
    patience: ClassVar[float]  # the seconds to wait for unfinished answers after Ctrl-C
    killed: ClassVar[str]  # the message for a file whose process was killed
    late: ClassVar[str] = ""  # the message for a file whose process was given up

    @property
    def overdue(self) -> float | None:
        """The seconds after which a process without an answer is given up; None for no limit."""
        return None

    @property
    def has_limits(self) -> bool:
        """Whether each answer needs its own process, which can be killed at a limit."""
        return True

    def load(self, path: str) -> Any:
        """Read a file here, because a worker may not be able to read it."""

    def answer(self, number: int, path: str, content: Any, given_up: Callable[[], bool]) -> Any:
        """Answer the question for one file.

        Args:
            number: The index of the file, which the answer repeats.
            path: The path of the file.
            content: The result of `load`; None to read the file here.
            given_up: Returns whether the answer is not needed any more.
        """

    def lost(self, lost: workers.Lost, path: str) -> Any:
        """Make the answer for a file whose process ended without an answer."""
        return self.failed(lost.number, path, SolverError(self.late if lost.late else self.killed))

    def failed(self, number: int, path: str, error: Exception) -> Any:
        """Make the answer for a file that raised an error."""


def answers_here(
    question: FileQuestion, paths: Sequence[str], jobs: int, stop: StopFlag
) -> Generator[Any]:
    """Yield answers from processes of this machine, in the order in which they are ready.

    `jobs` is the number of processes; -1 for one per core. If a process is killed, only its own
    file is lost. Ctrl-C sets `stop`, which the processes watch. Unfinished files then still
    yield what is known. A second Ctrl-C raises KeyboardInterrupt.
    """

    from joblib import effective_n_jobs

    tasks = [(number, path, None) for number, path in enumerate(paths)]
    processes = min(effective_n_jobs(jobs), len(paths))
    with on_ctrl_c(stop.ask):
        for answer in workers.answers(
            question.answer, tasks, processes, stop.is_set, question.overdue, question.patience
        ):
            if not isinstance(answer, workers.Lost):
                yield answer
            elif not stop.is_set():  # a process that was stopped without an answer is no error
                yield question.lost(answer, paths[answer.number])


def final_code(codes: Sequence[int], asked: int, stop: StopFlag, files: str) -> int:
    """Compute the exit code for many files, and report interruptions and errors on stderr.

    `asked` is the number of files, and `files` the word for them in messages, such as "traces".
    """
    if stop.is_set():
        missing = f"{asked - sum(code <= SIGNALLED for code in codes)} of {counted(asked, files)}"
        print(f"ssh-abduction: interrupted: {missing} not finished", file=sys.stderr)
        return interrupted_code()
    if errors := codes.count(EXIT_ERROR):
        where = f"{errors} of {counted(asked, files)}, on their lines"
        print(f"ssh-abduction: errors in {where}", file=sys.stderr)
        return EXIT_ERROR
    return max(codes, default=0)
