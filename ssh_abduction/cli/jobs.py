"""Answer the same question about many files, in processes of this machine.

`cluster_jobs.py` does so on a Dask cluster. Both yield each answer as soon as it is ready.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Protocol, TypeAlias

from ssh_abduction.cli import EXIT_ERROR
from ssh_abduction.cli.outcome import StopFlag, on_ctrl_c
from ssh_abduction.cli.text import counted
from ssh_abduction.data.errors import AbductionError, SolverError, printable
from ssh_abduction.runtime.program import SIGNALLED, interrupted_code
from ssh_abduction.solver import workers

# The number of a file, its path, and its content; None to read it in the process.
Task: TypeAlias = tuple[int, str, Any]


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

    def why_lost(self, lost: workers.Lost) -> str:
        """Say why a process ended without an answer."""
        return self.late if lost.late else self.killed

    def warning_of(self, lost: workers.Lost) -> str:
        """Say why the map of a file is only the best one until its process ended."""
        return f"{self.why_lost(lost)}; its map is the best one until then"

    def rescued(self, lost: workers.Lost, path: str, *, stopped: bool) -> Any:
        """Make an answer of what a process handed over before it ended; None if that is too little.

        `stopped` says whether a person ended it.
        """
        return None

    def hurried(self, known: Any) -> FileQuestion:
        """Return the question whose answer is some map that is found soon.

        `known` is what a process handed over before it ended; None if it handed nothing over.
        """
        return self

    def warned(self, answer: Any, path: str, warning: str) -> Any:
        """Return an answer with one more warning."""
        return replace(answer, warnings=(*answer.warnings, warning))

    def lost(self, lost: workers.Lost, path: str) -> Any:
        """Make the answer for a file whose process ended without an answer."""
        return self.failed(lost.number, path, SolverError(self.why_lost(lost)))

    def failed(self, number: int, path: str, error: Exception) -> Any:
        """Make the answer for a file that raised an error."""


def answers_here(
    question: FileQuestion, paths: Sequence[str], jobs: int, stop: StopFlag
) -> Generator[Any]:
    """Yield answers from processes of this machine, in the order in which they are ready.

    `jobs` is the number of processes; -1 for one per core. Ctrl-C sets `stop`, which the processes
    watch. Unfinished files then still yield what is known. A second Ctrl-C raises
    KeyboardInterrupt.
    """

    from joblib import effective_n_jobs

    tasks = [(number, path, None) for number, path in enumerate(paths)]
    processes = min(effective_n_jobs(jobs), len(paths))
    with on_ctrl_c(stop.ask):
        yield from answers_of_processes(question, tasks, processes, stop.is_set)


def answers_of_processes(
    question: FileQuestion,
    tasks: Sequence[Task],
    processes: int,
    stopped: Callable[[], bool],
) -> Iterator[Any]:
    """Yield the answers for some files from processes of this machine.

    If a process is killed or late, the last map that it handed over is its answer. If it had none,
    another process makes some map soon. Only if that is killed, too, the answer is an error.
    `stopped` returns whether to end early.
    """
    losses: list[workers.Lost] = []
    by_number = {task[0]: task for task in tasks}
    limits = question.overdue, question.patience
    for answer in workers.answers(question.answer, tasks, processes, stopped, *limits):
        if not isinstance(answer, workers.Lost):
            yield answer
            continue
        rescued = question.rescued(answer, by_number[answer.number][1], stopped=stopped())
        if rescued is not None:
            yield rescued
        elif not stopped():  # a process that was stopped without an answer is no error
            losses.append(answer)
    for lost in losses:
        yield from hurried_answer(question, by_number[lost.number], lost, stopped)


def hurried_answer(
    question: FileQuestion, task: Task, lost: workers.Lost, stopped: Callable[[], bool]
) -> Iterator[Any]:
    """Yield some map from another process, after the process of a task ended without one."""
    hurried, path = question.hurried(lost.known), task[1]
    limits = hurried.overdue, hurried.patience
    for answer in workers.answers(hurried.answer, [task], 1, stopped, *limits):
        if not isinstance(answer, workers.Lost):
            yield question.warned(answer, path, question.warning_of(lost))
        elif not stopped():
            yield question.lost(lost, path)


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
