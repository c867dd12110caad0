"""ssh-abduction solve TRACE TRACE …: many traces, here or on a Dask cluster, one result a line.

Results come as they are ready and are printed in the order of the traces. An error is the result of
its trace, and the others go on.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import gc
import logging
import re
import sys
import time
import warnings
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import CancelledError
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, TypeAlias

from ssh_abduction.cli import EXIT_ERROR
from ssh_abduction.cli.guard import Guard
from ssh_abduction.cli.options import theory_of
from ssh_abduction.cli.outcome import (
    Given,
    all_given,
    dump,
    ending,
    exit_code,
    explained,
    given_by,
    on_ctrl_c,
    opening,
    told,
    warn,
    warnings_of,
)
from ssh_abduction.cli.text import headline
from ssh_abduction.data.errors import AbductionError, SolverError, brief, named, printable
from ssh_abduction.data.trace import Trace
from ssh_abduction.explain.no_map import Explanation
from ssh_abduction.runtime.program import SIGNALLED, interrupted_code
from ssh_abduction.solver import POLL, Backbone, Search, Solution, Start, workers
from ssh_abduction.solver import Stop as SearchStop
from ssh_abduction.theory.speedups import Speedups
from ssh_abduction.theory.theory import Theory

if TYPE_CHECKING:
    from distributed import Client, Future

Task: TypeAlias = tuple[int, str]  # the number of a trace, and its path

PATIENCE = 10  # seconds for a Dask scheduler, and for its first worker, to answer
KILLED = (
    "process: expected an answer, got killed, as happens when memory runs out; set "
    "--memory-limit, or solve fewer traces at a time"
)
LOOK = 1.0  # seconds between two looks at whether the cluster still has a worker
# times the time limit, and seconds beyond that, or after Ctrl-C, after which a process has no
# answer: its own guard ends it before
GUARDED, OVERDUE = (
    1.2,
    3.0,
)
LATE = (
    "process: expected an answer in time, got none, as happens when memory is swapped; set "
    "--memory-limit, or solve fewer traces at a time"
)
LOST = (
    "scheduler: expected an answer, got disconnected; see whether it still runs, and solve this "
    "trace again"
)


class Answer(NamedTuple):
    """The result of one trace: the number of the trace, the line to print, the exit code, and what is to be said on stderr."""

    number: int
    line: str
    code: int
    warnings: tuple[str, ...] = ()


class Stop:
    """Whether all is to stop.

    A handler of signals may say so at any time, which an Event of `threading` does not allow.
    """

    def __init__(self) -> None:
        self._is_set = False

    def set(self) -> None:
        self._is_set = True

    def is_set(self) -> bool:
        return self._is_set


def in_a_line(error: Exception) -> str:
    """What went wrong, in one line."""
    return printable(
        " ".join(
            (
                str(error)
                if isinstance(error, AbductionError)
                else f"{type(error).__name__}: {error}"
            ).split()
        )
    )


class Asked(Protocol):
    """What is asked about each of many files.

    Plain data, as it travels to other processes and machines; so are its answers, which have the
    number of their file.
    """

    @property
    def overdue(self) -> float | None:
        """Seconds after which a process that was to answer is taken for lost."""

    @property
    def has_limits(self) -> bool:
        """Whether it takes a process of its own to answer, as that may have to be ended."""

    @property
    def limit(self) -> float | None:
        """Seconds for the search of each file, or None."""

    @property
    def patience(self) -> float:
        """Seconds that an answer may take once all is to stop."""

    def load(self, path: str) -> Any:
        """What goes along to a worker. Whatever it raises is the answer."""

    def answer(self, number: int, path: str, content: Any, given_up: Callable[[], bool]) -> Any:
        """The answer for a file, read here if its content did not come along."""

    def lost(self, lost: workers.Lost, path: str) -> Any:
        """The answer for a file whose process ended without one."""

    def failed(self, number: int, path: str, error: Exception) -> Any:
        """The answer for a file with which something went wrong."""


@dataclass(frozen=True, slots=True)
class Question:
    """What is asked about each trace: limit, maps, within, memory and speedups as of Search.

    Plain data, as it travels to other processes and machines.
    """

    theory: Theory
    limit: float | None
    maps: int
    memory: int | None
    speedups: Speedups
    json: bool
    within: int = 0

    @property
    def has_limits(self) -> bool:
        """Whether it takes a process of its own to answer, as that may have to be ended."""
        return self.limit is not None or self.memory is not None

    def load(self, path: str) -> Trace:
        """What goes along to a worker: the trace, so that workers need not share the disk."""
        return Trace.load(path)

    def answer(
        self,
        number: int,
        path: str,
        trace: Trace | None = None,
        given_up: Callable[[], bool] = lambda: False,
    ) -> Answer:
        """Solve a trace, read from its file if it did not come along.

        Whatever goes wrong is the answer. Stops when it is given up.
        """
        try:
            return self._solved(number, path, trace or Trace.load(path), given_up)
        except (
            Exception
        ) as error:  # of any kind, such as no memory left: the other traces must not suffer
            return self.failed(number, path, error)

    def _solved(self, number: int, path: str, trace: Trace, given_up: Callable[[], bool]) -> Answer:
        self.theory.check_steps(trace)
        if self.memory is not None:
            _forget_memory()

        def on_progress(_: object) -> None:
            if given_up():
                search.interrupt()

        search = Search(
            trace,
            self.theory,
            time_limit=self.limit,
            max_maps=self.maps or None,
            within=self.within,
            _start=Start(reasons=self.json),
            memory_limit=self.memory,
            speedups=self.speedups,
            on_progress=on_progress,
        )
        maps: list[Given] = []
        with self._guarded(number, path, search, maps, given_up):
            for ssh_map in search:
                maps += [given_by(search, ssh_map)] if self.json else []
            explanation = explained(search)
            solution = search.solution(tuple(ssh_map for ssh_map, _ in maps))
            return self._told(
                number, path, search, solution, all_given(solution), explanation, search.backbone
            )

    def _guarded(
        self,
        number: int,
        path: str,
        search: Search,
        maps: list[Given],
        given_up: Callable[[], bool],
    ) -> contextlib.AbstractContextManager[object]:
        """What answers in time, in a process that does nothing else, where the search cannot be ended."""

        def last_words(why: SearchStop) -> tuple[Answer, int]:
            solution = search.snapshot(why)
            found = [*maps] or ([(ssh_map, None) for ssh_map in solution.maps] if self.json else [])
            return self._told(
                number, path, search, solution, found, None, None
            ), EXIT_ERROR  # of the process, which nobody reads

        if not workers.serves():
            return contextlib.nullcontext()
        return Guard(
            search.interrupt,
            last_words,
            self.limit,
            self.memory,
            given_up=given_up,
            print_last=workers.reply,
        )

    def _told(
        self,
        number: int,
        path: str,
        search: Search,
        solution: Solution,
        maps: Sequence[Given],
        explanation: Explanation | None,
        backbone: Backbone | None,
    ) -> Answer:
        if self.json:
            count = len(maps)
            maps_told = list(map(told, maps))
            line = dump(
                {
                    "trace": path,
                    **opening(search),
                    "maps": maps_told,
                    **ending(search, solution, explanation, count, backbone),
                }
            )
        else:
            line = f"{named(path)}: {headline(solution, search.count, explanation)}"
        warnings = tuple(f"{named(path)}: {warning}" for warning in warnings_of(search, solution))
        return Answer(number, line, exit_code(solution), warnings)

    @property
    def overdue(self) -> float | None:
        """Seconds after which a process that was to answer is taken for lost."""
        return None if self.limit is None else GUARDED * self.limit + OVERDUE

    @property
    def patience(self) -> float:
        """Seconds that an answer may take once all is to stop."""
        return OVERDUE

    def lost(self, lost: workers.Lost, path: str) -> Answer:
        """The answer for a trace whose process ended without one."""
        return self.failed(lost.number, path, SolverError(LATE if lost.late else KILLED))

    def failed(self, number: int, path: str, error: Exception) -> Answer:
        """The answer for a trace that was not solved."""
        message = in_a_line(error)
        line = (
            dump({"trace": path, "status": "error", "error": message})
            if self.json
            else f"{named(path)}: error: {message}"
        )
        return Answer(number, line, EXIT_ERROR)


def run(options: argparse.Namespace) -> int:
    paths: list[str] = options.traces
    if "-" in paths:
        raise AbductionError(
            "-: expected files where there are several traces, --jobs or --scheduler, got "
            "standard input; save it to a file"
        )
    if options.jobs == 0:
        raise AbductionError(
            "--jobs: expected how many traces to solve at a time, or -1 for one a core, got 0; "
            "leave it out for 1"
        )
    speedups = Speedups.without(options.without_speedups)
    if options.scheduler or options.jobs not in (None, 1):
        speedups = replace(speedups, threads=False)  # the processors have other traces to solve
    question = Question(
        theory_of(options),
        options.time_limit,
        options.maps,
        options.memory_limit,
        speedups,
        options.json,
        options.within,
    )
    stop = Stop()
    if options.scheduler is None:
        answers = here(question, paths, options.jobs or 1, stop)
    else:
        answers = on_cluster(question, paths, options.scheduler, options.jobs, stop)
    codes = _printed(answers, len(paths), stop)
    if stop.is_set():
        missing = len(paths) - sum(code <= SIGNALLED for code in codes)
        print(
            f"ssh-abduction: interrupted: {missing} of {len(paths)} traces not finished",
            file=sys.stderr,
        )
        return interrupted_code()
    if errors := codes.count(EXIT_ERROR):
        print(
            f"ssh-abduction: errors in {errors} of {len(paths)} traces, on their lines",
            file=sys.stderr,
        )
        return EXIT_ERROR
    return max(codes)


def _printed(answers: Generator[Answer], total: int, stop: Stop) -> list[int]:
    """Print the lines of all answers in the order of the traces.

    Returns the codes of those that came.
    """
    lines: dict[int, str] = {}  # of answers whose turn has not come
    codes: list[int] = []
    turn = 0
    with _progress(total) as (say, advance), contextlib.closing(answers):
        try:
            for answer in answers:
                with on_ctrl_c(stop.set):  # so that no line is lost or cut in two
                    lines[answer.number] = answer.line
                    warn(answer.warnings)
                    codes.append(answer.code)
                    advance()
                    while turn in lines:
                        say(lines.pop(turn))
                        turn += 1
                if answer.code > SIGNALLED:
                    stop.set()
        except KeyboardInterrupt:
            stop.set()
        for number in sorted(lines):  # where some did not come
            say(lines[number])
    return codes


def _solved_in_worker(number: int, path: str, question: Asked, given_up: Callable[[], bool]) -> Any:
    return question.answer(number, path, None, given_up)


def here(question: Asked, paths: Sequence[str], jobs: int, stop: Stop) -> Generator[Any]:
    """Answers from processes of this machine.

    Once it is to stop, those of traces under way, as far as these are.

    A process that is killed loses its trace alone. These processes do not hear Ctrl-C themselves:
    they are told of it.
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
            elif not stop.is_set():  # one that is given up has no answer, and that is no error
                yield question.lost(answer, paths[answer.number])


def on_cluster(
    question: Asked, paths: Sequence[str], address: str, jobs: int | None, stop: Stop
) -> Generator[Any]:
    """Answers from the workers of a Dask scheduler."""
    try:
        from distributed import Client
    except ImportError:
        raise AbductionError(
            "--scheduler: expected the package distributed, got none; pip install "
            "'ssh-abduction[cluster]'"
        ) from None
    if not re.search(r"^inproc:|:\d+$", address):
        raise AbductionError(
            "--scheduler: expected an address with a port, such as tcp://host:8786, got "
            f"{brief(address)}"
        )
    logging.getLogger("distributed.client").setLevel(
        logging.CRITICAL
    )  # what goes wrong is in the answers
    warnings.filterwarnings(
        "ignore", "Sending large graph"
    )  # a long trace goes to one worker, once
    try:
        client = Client(address, timeout=PATIENCE, set_as_default=False)
    except Exception as error:  # whatever else listens there may answer anything
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
        for answer in _answers(
            question, paths, partial(_on_workers, question, client, most, absence)
        ):
            yield answer
            if stop.is_set():
                return


def _answers(
    question: Asked,
    paths: Sequence[str],
    attempt: Callable[[list[Task], list[Task]], Iterator[Any]],
) -> Iterator[Any]:
    """Answers as they are ready, in any order.

    `attempt` yields the answers for some traces, and puts those under way while a process was
    killed into its second list. Which of them was to blame is not known, so each is solved again,
    alone: it is the one whose process is killed again.
    """
    suspects: list[Task] = []
    yield from attempt([*enumerate(paths)], suspects)
    for task in suspects:
        again: list[Task] = []
        yield from attempt([task], again)
        for _ in again:
            yield question.lost(workers.Lost(task[0], late=False), task[1])


class Absence:
    """How long a cluster has had no worker. Dask itself waits without a word.

    After PATIENCE seconds a warning says so. Where there is a time limit, the wait is too long
    after so many seconds, or PATIENCE, if that is more.

    Args:
        workers: Tells how many workers there are.
        limit: Seconds, or None.
        address: The address of the scheduler, which the sentences name.
        clock: Tells the time in seconds.
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
        """What is said of it."""
        seconds = self._clock() - self._last_seen
        return (
            f"scheduler: expected a worker, got none for {seconds:.0f} s; start one with: dask "
            f"worker {self._address}"
        )

    def is_too_long(self) -> bool:
        """Look, now and then, whether there is a worker, and warn once if there is none.

        Returns whether nobody should wait any longer.
        """
        now = self._clock()
        if now >= self._looks_at:
            self._looks_at = now + LOOK
            with contextlib.suppress(Exception):  # of a scheduler that is gone
                if self._workers():
                    self._last_seen, self._warned = now, False
        absent = now - self._last_seen
        if absent >= PATIENCE and not self._warned:
            self._warned = True
            warn([f"{self.sentence}, or end this with Ctrl-C"])
        return self._limit is not None and absent >= max(PATIENCE, self._limit)


def _on_workers(
    question: Asked,
    client: Client,
    most: int,
    absence: Absence,
    tasks: list[Task],
    killed: list[Task],
) -> Iterator[Any]:
    """An attempt on Dask, with so many traces at most sent at a time.

    They are read here: workers need not share the disk.

    This is Dask's own interface, as joblib's backend for Dask waits for ever when a worker is
    killed.
    """
    from distributed import KilledWorker, as_completed

    sent: dict[Future[Any], Task] = {}
    ready = as_completed(loop=client.loop)

    def received(left: int) -> Iterator[Any]:
        """Answers, until no more than `left` traces are under way."""
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
            try:
                yield future.result()
            except KilledWorker:
                killed.append(task)
            except CancelledError:
                yield question.failed(*task, SolverError(LOST))
            except Exception as error:  # of the cluster, as `answer` catches those of the trace
                mend = "install the same ssh-abduction where the scheduler and its workers run"
                yield question.failed(
                    *task,
                    SolverError(
                        f"cluster: expected an answer, got {type(error).__name__}: {error}; {mend}"
                    ),
                )

    for number, path in tasks:
        try:
            if client.status != "running":
                raise SolverError(LOST)
            if absence.is_too_long():
                raise SolverError(absence.sentence)
            future = client.submit(
                _on_worker, question, number, path, question.load(path), pure=False
            )
        except Exception as error:
            yield question.failed(number, path, error)
            continue
        sent[future] = number, path
        ready.add(future)
        yield from received(most - 1)
    yield from received(0)
    for task in sent.values():  # Dask says nothing about these once the scheduler is gone
        yield question.failed(*task, SolverError(LOST))


def _on_worker(question: Asked, number: int, path: str, content: Any) -> Any:
    """The answer, on a Dask worker.

    A worker runs on when its client has gone, so the search looks now and then whether it has.
    """
    from distributed import get_worker

    worker = get_worker()
    task = worker.state.tasks[worker.get_current_task()]

    def given_up() -> bool:
        return bool(task.state == "cancelled")

    if not question.has_limits:
        return question.answer(number, path, content, given_up)
    # Other traces may be under way in this process, which cannot be ended with one that does not
    # heed its limits.
    work = [(number, path, question, content)]
    answer: Any = next(
        workers.answers(_solved_for_cluster, work, 1, given_up, question.overdue, question.patience)
    )
    return question.lost(answer, path) if isinstance(answer, workers.Lost) else answer


def _solved_for_cluster(
    number: int, path: str, question: Asked, content: Any, given_up: Callable[[], bool]
) -> Any:
    return question.answer(number, path, content, given_up)


def _forget_memory() -> None:
    """Count the peak of memory anew, after what earlier traces left is given back.

    Where this is not Linux, the peak stays.
    """
    gc.collect()
    with contextlib.suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


@contextlib.contextmanager
def _progress(total: int) -> Iterator[tuple[Callable[[str], None], Callable[[], None]]]:
    """How to print a line, and how to move the bar, which is on stderr if that is a terminal."""
    if not sys.stderr.isatty():
        yield partial(print, flush=True), lambda: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=console, redirect_stdout=False) as progress:
        task = progress.add_task("traces", total=total)

        def say(line: str) -> None:
            """Print a line as it is where the bar was, which moves below it: rich would fit it to the width of the terminal."""
            progress.live.transient = True
            progress.stop()
            print(line, flush=True)
            progress.live.transient = False
            progress.start()

        yield (
            (say if sys.stdout.isatty() else partial(print, flush=True)),
            partial(progress.advance, task),
        )
