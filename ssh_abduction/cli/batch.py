"""ssh-abduction solve TRACE TRACE …: solve many traces, here or on a Dask cluster.

The result of each trace is one line. Lines are printed in the order of the traces, as soon as
possible. If a trace fails, its line says why, and the other traces are still solved.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import gc
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

from ssh_abduction.cli import jobs, outcome
from ssh_abduction.cli.outcome import Guard
from ssh_abduction.cli.shared import check_jobs, theory_of
from ssh_abduction.cli.text import headline
from ssh_abduction.data.errors import AbductionError, named
from ssh_abduction.data.files import json_line
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.explain.no_map import Explanation
from ssh_abduction.runtime import workers
from ssh_abduction.runtime.program import SIGNALLED
from ssh_abduction.solution import Solution, Stop, opening, written_map
from ssh_abduction.solver import Search, Start
from ssh_abduction.theory.speedups import Speedups
from ssh_abduction.theory.theory import Theory

# A process is lost if it has no answer after GUARDED times its time limit plus OVERDUE seconds.
# This is a last resort: a process should end itself earlier, by its `Guard`. On a busy machine the
# Guard may be several seconds late.
GUARDED, OVERDUE = 1.2, 10.0
# If a process ended without a map, another one searches for this many seconds. Then it makes a map
# without a search, however long that takes.
HURRY = 0.5


class HandedOver(NamedTuple):
    """What is known of the answer for a trace: plain data, which another process can print."""

    solution: Solution
    explanation: Explanation | None
    warnings: Sequence[str]

    @classmethod
    def of(
        cls, search: Search, solution: Solution, explanation: Explanation | None = None
    ) -> HandedOver:
        """Collect what is known from a search and its solution."""
        return cls(solution, explanation, outcome.Warnings(search).of(solution))


@dataclass(frozen=True, slots=True)
class SolveQuestion(jobs.FileQuestion):
    """The settings for solving each of many traces."""

    theory: Theory
    limit: float | None  # seconds for each trace; None for no limit
    maps: int  # the largest number of maps to list; 0 for all
    memory: int | None  # MiB that the process may use; None for no limit
    speedups: Speedups  # flags that say which speed-ups to use
    json: bool  # whether lines are JSON
    within: int = 0  # the number of dstates by which a listed map may exceed the minimum
    work: float | None = None  # units of work for each trace; None for no limit

    patience: ClassVar = 3.0
    killed: ClassVar = (
        "process: expected an answer, got a killed process, as when memory runs out; set "
        "--memory-limit, or solve fewer traces at a time"
    )
    late: ClassVar = (
        "process: expected an answer soon after --time-limit, got none, as happens when the "
        "machine is busy or memory is swapped; solve fewer traces at a time (--jobs), or set "
        "--memory-limit"
    )

    def load(self, path: str) -> Trace:
        """Load a trace here, because a worker may not be able to read the file."""
        return Trace.load(path)

    def answer(
        self,
        number: int,
        path: str,
        trace: Trace | None = None,
        given_up: Callable[[], bool] = lambda: False,
    ) -> jobs.FileAnswer:
        """Implement `FileQuestion.answer`: solve one trace. If that fails, the answer says why."""
        try:
            return self._solved(number, path, trace or Trace.load(path), given_up)
        except Exception as error:  # one bad trace must not stop the others
            return self.failed(number, path, error)

    def _solved(
        self, number: int, path: str, trace: Trace, given_up: Callable[[], bool]
    ) -> jobs.FileAnswer:
        """Solve one trace as `answer` does, but raise errors."""
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
            work_limit=self.work,
            max_maps=self.maps or None,
            within=self.within,
            _start=Start(reasons=self.json),
            memory_limit=self.memory,
            speedups=self.speedups,
            on_progress=on_progress,
        )
        kept: list[SSHMap] = []
        with self._guarded(number, path, search, kept, given_up):
            for ssh_map in search:
                kept += [ssh_map] if self.json else []
            explanation = outcome.why_no_map(search)
            known = HandedOver.of(search, search.solution(tuple(kept)), explanation)
            return self._answer(number, path, known)

    def _guarded(
        self,
        number: int,
        path: str,
        search: Search,
        kept: list[SSHMap],
        given_up: Callable[[], bool],
    ) -> contextlib.AbstractContextManager[object]:
        """Make a guard that ends a worker process at its limits; nothing in other processes."""

        def last_words(why: Stop) -> tuple[str, int, Callable[[], None]]:
            try:
                solution = search.snapshot(why)
                solution = replace(solution, maps=tuple(kept) or solution.maps)
                answer = self._answer(number, path, HandedOver.of(search, solution))
            except Exception as error:  # without an answer, the process would seem to be killed
                answer = self.failed(number, path, error)
            # Nobody reads the exit code of this process.
            return "", outcome.EXIT_ERROR, partial(workers.reply, answer)

        if not workers.serves():
            return contextlib.nullcontext()
        return Guard(
            search.interrupt,
            last_words,
            self.limit,
            self.memory,
            given_up=given_up,
            known=lambda: (search.best, search.bound) if search.best else None,
            hand_over=lambda: workers.hand_over(HandedOver.of(search, search.so_far("time limit"))),
        )

    def rescued(self, lost: workers.Lost, path: str, *, stopped: bool) -> jobs.FileAnswer | None:
        """Implement `FileQuestion.rescued`: answer with the best map so far."""
        if lost.known is None:
            return None
        known: HandedOver = lost.known
        why: Stop = "interrupted" if stopped else "time limit" if lost.late else "memory limit"
        known = known._replace(solution=replace(known.solution, stopped=why))
        answer = self._answer(lost.number, path, known)
        return answer if stopped else self.warned(answer, lost)

    def hurried(self, known: HandedOver | None) -> SolveQuestion:
        """Implement `FileQuestion.hurried`: give the search little time."""
        return replace(self, limit=min(self.limit or HURRY, HURRY), work=None)

    def _answer(self, number: int, path: str, known: HandedOver) -> jobs.FileAnswer:
        """Make the answer for a solution: its line, exit code and warnings."""
        solution, explanation, found = known
        if self.json:
            written = [written_map(*given) for given in outcome.all_given(solution)]
            head = opening(solution.theory, solution.steps, solution.within)
            end = outcome.answer_ending(solution, explanation, len(written), found)
            line = json_line({"trace": path, **head, "maps": written, **end})
        else:
            verdict = "" if solution.cost is None else f"{solution.verdict} "
            line = f"{named(path)}: {verdict}{headline(solution, explanation)}"
        return jobs.FileAnswer(number, line, outcome.exit_code(solution), tuple(found))

    @property
    def overdue(self) -> float | None:
        """The seconds after which a process without an answer is given up; None for no limit."""
        return None if self.limit is None else GUARDED * self.limit + OVERDUE

    def failed(self, number: int, path: str, error: Exception) -> jobs.FileAnswer:
        """Make the answer for a trace that could not be solved because of an error."""
        message = jobs.in_a_line(error)
        line = f"{named(path)}: error: {message}"
        if self.json:
            line = json_line({"trace": path, "status": "error", "error": message})
        return jobs.FileAnswer(number, line, outcome.EXIT_ERROR)


def run(options: argparse.Namespace) -> int:
    paths: list[str] = options.traces
    if "-" in paths:
        raise AbductionError(
            "-: expected files, as several traces, --jobs and --scheduler need them, got standard "
            "input; save the trace to a file"
        )
    check_jobs(options.jobs, "traces to solve at a time")
    question = SolveQuestion(
        theory_of(options),
        limit=options.time_limit,
        work=options.work_limit,
        maps=options.maps,
        memory=options.memory_limit,
        speedups=Speedups.without(options.without_speedups),
        json=options.json,
        within=options.within,
    )
    stop = outcome.StopFlag()
    codes = _printed(jobs.answers_of(question, paths, options, stop), paths, stop)
    return jobs.final_code(codes, len(paths), stop, "traces")


def _printed(
    answers: Generator[jobs.FileAnswer], paths: Sequence[str], stop: outcome.StopFlag
) -> list[int]:
    """Print all lines in the order of the traces, and return the exit codes of the answers."""
    lines: dict[int, str] = {}  # the lines that wait for an earlier trace
    codes: list[int] = []
    turn = 0
    with outcome.progress_bar() as progress, contextlib.closing(answers):
        task = progress.add_task("traces", total=len(paths))
        try:
            for answer in answers:
                with _whole_lines(stop, progress) as say:
                    lines[answer.number] = answer.line
                    jobs.warn_of(answer, paths[answer.number])
                    codes.append(answer.code)
                    progress.advance(task)
                    while turn in lines:
                        say(lines.pop(turn))
                        turn += 1
                if answer.code > SIGNALLED:
                    stop.set()
        except KeyboardInterrupt:
            stop.set()
        with _whole_lines(stop, progress) as say:
            for number in sorted(lines):  # lines that still wait for an answer that did not come
                say(lines[number])
    return codes


@contextlib.contextmanager
def _whole_lines(stop: outcome.StopFlag, progress: Any) -> Iterator[Callable[[str], None]]:
    """Yield a function that prints a line. Ctrl-C neither loses a line nor cuts it in two.

    The progress bar is hidden meanwhile, as rich would add line breaks to the line. If nobody
    reads the output after Ctrl-C, the process ends.
    """
    guard = Guard(stop.set, given_up=stop.is_set)

    def say(line: str) -> None:
        progress.stop()
        guard.say(lambda: f"{line}\n")
        progress.start()

    with outcome.on_ctrl_c(stop.set), guard:
        yield say


def _forget_memory() -> None:
    """Free the memory of earlier traces. On Linux, also reset the measured peak."""
    gc.collect()
    with contextlib.suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
