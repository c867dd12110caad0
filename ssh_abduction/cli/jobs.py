"""Answer the same question about many files, in processes here or on a Dask cluster.

Each answer comes as soon as it is ready.
"""

from __future__ import annotations

import argparse
import contextlib
import logging
import re
import sys
import time
import warnings
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import CancelledError
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, TypeAlias

from ssh_abduction.cli.outcome import EXIT_ERROR, StopFlag, on_ctrl_c, warn
from ssh_abduction.cli.text import counted
from ssh_abduction.data.checks import needed
from ssh_abduction.data.errors import AbductionError, SolverError, brief, named, printable
from ssh_abduction.runtime import workers
from ssh_abduction.runtime.clock import POLL
from ssh_abduction.runtime.program import SIGNALLED, interrupted_code

if TYPE_CHECKING:
    from distributed import Client, Future

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


def warn_of(answer: FileAnswer, path: str) -> None:
    """Print the warnings of an answer, each with the name of its file."""
    warn(f"{named(path)}: {text}" for text in answer.warnings)


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

    def warned(self, answer: Any, lost: workers.Lost) -> Any:
        """Return an answer with a warning: its map is only the best one until a process ended."""
        warning = f"{self.why_lost(lost)}; its map is the best one until then"
        return replace(answer, warnings=(*answer.warnings, warning))

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
    question: FileQuestion, tasks: Sequence[Task], processes: int, stopped: Callable[[], bool]
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
            yield question.warned(answer, lost)
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


File: TypeAlias = tuple[int, str]  # the number of a file, and its path
PATIENCE = 10  # seconds to wait for a Dask scheduler, and for its first worker
LOOK = 1.0  # seconds between two checks that the cluster still has a worker
LOST = (
    "scheduler: expected an answer, got a lost connection; see whether it runs, and solve this "
    "trace again"
)


def answers_of(
    question: FileQuestion, paths: Sequence[str], options: argparse.Namespace, stop: StopFlag
) -> Generator[Any]:
    """Yield answers from processes here, or from the scheduler that the options name."""
    if options.scheduler is None:
        return answers_here(question, paths, options.jobs or 1, stop)
    return answers_on_cluster(question, paths, options.scheduler, options.jobs, stop)


def answers_on_cluster(
    question: FileQuestion, paths: Sequence[str], address: str, jobs: int | None, stop: StopFlag
) -> Generator[Any]:
    """Yield answers from the workers of a Dask scheduler, in the order in which they are ready.

    At most `jobs` files are on the cluster at a time; None or -1 takes twice the number of its
    cores. The work ends early when `stop` is set. Raises AbductionError if the package
    `distributed`, the scheduler or its workers are missing.
    """
    with needed("--scheduler", "distributed", "'.[cluster]' in your clone"):
        from distributed import Client
    if not re.search(r"^inproc:|:\d+$", address):
        raise AbductionError(
            "--scheduler: expected an address with a port, such as tcp://host:8786, got "
            f"{brief(address)}; take the one that dask scheduler prints"
        )
    # The answers report errors. The warning about large graphs does not apply: each file is sent
    # to one worker, once.
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
    warnings.filterwarnings("ignore", "Sending large graph")
    try:
        client = Client(address, timeout=PATIENCE, set_as_default=False)
    except Exception as error:  # another program at this address may answer anything
        raise AbductionError(
            f"--scheduler: expected a Dask scheduler at {address}, got none ({error}); start one "
            "with: dask scheduler"
        ) from None
    with client:
        try:
            client.wait_for_workers(1, timeout=PATIENCE)
        except TimeoutError:
            raise AbductionError(
                f"--scheduler: expected a worker, got none in {PATIENCE} s; start one with: dask "
                f"worker {address}"
            ) from None
        most = jobs if jobs is not None and jobs > 0 else max(1, 2 * sum(client.ncores().values()))
        absence = Absence(lambda: len(client.ncores()), question.limit, address)
        for answer in _on_workers(question, client, most, absence, paths, stop):
            yield answer
            if stop.is_set():
                return


class Absence:
    """Measures how long a cluster has had no worker, because Dask itself would wait for ever.

    It warns after PATIENCE seconds. If there is a time limit in seconds, waiting should end after
    this limit, but not before PATIENCE seconds. `workers` returns the number of workers.
    """

    def __init__(
        self,
        workers: Callable[[], int],
        limit: float | None,
        address: str,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._workers, self._limit, self._clock, self._address = workers, limit, clock, address
        self._looks_at = self._last_seen = clock()
        self._warned = False

    @property
    def sentence(self) -> str:
        """A message that says for how long there was no worker, and what to do."""
        seconds = self._clock() - self._last_seen
        return (
            f"scheduler: expected a worker, got none for {seconds:.0f} s; start one with: dask "
            f"worker {self._address}"
        )

    def is_too_long(self) -> bool:
        """Check for workers, at most once in LOOK seconds. Return whether to stop waiting."""
        now = self._clock()
        if now >= self._looks_at:
            self._looks_at = now + LOOK
            with contextlib.suppress(Exception):  # the scheduler may be gone
                if self._workers():
                    self._last_seen, self._warned = now, False
        absent = now - self._last_seen
        if absent >= PATIENCE and not self._warned:
            self._warned = True
            warn([f"{self.sentence}, or end this with Ctrl-C"])
        return self._limit is not None and absent >= max(PATIENCE, self._limit)


def _on_workers(
    question: FileQuestion,
    client: Client,
    most: int,
    absence: Absence,
    paths: Sequence[str],
    stop: StopFlag,
) -> Iterator[Any]:
    """Yield the answers for some files from the workers of a cluster, at most `most` at a time.

    Files are read here, so that workers need not share the disk. This uses Dask directly, because
    joblib's backend for Dask hangs when a worker is killed.
    """
    from distributed import as_completed

    sent: dict[Future[Any], File] = {}
    ready = as_completed(loop=client.loop)

    def received(left: int) -> Iterator[Any]:
        """Yield answers until at most `left` files are on the cluster."""
        while len(sent) > left:
            if ready.is_empty():  # the scheduler is gone
                return
            if not ready.has_ready():
                if not absence.is_too_long():
                    time.sleep(POLL)
                    continue
                for future, task in sent.items():
                    future.cancel()
                    yield question.failed(*task, SolverError(absence.sentence))
                sent.clear()
                return
            future = next(ready)
            task = sent.pop(future)
            yield from _result(question, future, task, stop)

    for number, path in enumerate(paths):
        try:
            if client.status != "running":
                raise SolverError(LOST)
            if absence.is_too_long():
                raise SolverError(absence.sentence)
            work = question, number, path, question.load(path)
            future = client.submit(_on_worker, *work, pure=False)
        except Exception as error:
            yield question.failed(number, path, error)
            continue
        sent[future] = number, path
        ready.add(future)
        yield from received(most - 1)
    yield from received(0)
    for task in sent.values():  # tasks that were under way when the scheduler was lost
        yield question.failed(*task, SolverError(LOST))


def _result(
    question: FileQuestion, future: Future[Any], task: File, stop: StopFlag
) -> Iterator[Any]:
    """Yield the answer of a task that is done.

    If its workers were killed, a process here makes some map.
    """
    from distributed import KilledWorker

    try:
        yield future.result()
    except KilledWorker:
        lost = workers.Lost(task[0], late=False)
        yield from hurried_answer(question, (*task, None), lost, stop.is_set)
    except CancelledError:
        yield question.failed(*task, SolverError(LOST))
    except Exception as error:  # an error of the cluster: `answer` catches all others
        mend = "install the same ssh-abduction where the scheduler and its workers run"
        said = f"cluster: expected an answer, got {type(error).__name__}: {error}; {mend}"
        yield question.failed(*task, SolverError(said))


def _on_worker(question: FileQuestion, number: int, path: str, content: Any) -> Any:
    """Answer the question about one file on a Dask worker. Stop if the client disconnects."""
    from distributed import get_worker

    worker = get_worker()
    task = worker.state.tasks[worker.get_current_task()]

    def given_up() -> bool:
        return bool(task.state == "cancelled")

    # A task that exceeds its limits is killed together with its process. So each task gets its own
    # process, as other tasks may run in this one.
    return next(answers_of_processes(question, [(number, path, content)], 1, given_up), None)
