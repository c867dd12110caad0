"""Run tasks in several processes. Each process does one task after another.

The processes are started, not forked, as a process that is forked while a thread grounds may hang.
When the parent process exits, the stdin of each process closes, and then the process exits, too. A
process that is killed loses only its current task. All temporary files of the processes lie in one
folder, which is deleted at the end.
"""

from __future__ import annotations

import os
import pickle
import queue
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from typing import Any, BinaryIO, NamedTuple

from ssh_abduction.runtime.clock import POLL, STARVED
from ssh_abduction.runtime.program import command, search_path

# A process may take this many seconds to start.
STARTING = 10.0
DYING = 1.0  # seconds to wait for the end of a process that was killed

_BEGIN = b"\0ssh-abduction answers\n"  # whatever Python prints before this is no answer
_under_way: set[subprocess.Popen[bytes]] = set()
# The folders for temporary files of the processes under way.
_folders: set[tempfile.TemporaryDirectory[str]] = set()


class Lost(NamedTuple):
    """Stands for a missing answer, as the process of a task ended, or was killed for being late.

    `known` is what the process handed over last; None if it handed nothing over.
    """

    number: int
    late: bool
    known: Any = None


class Worker:
    """A process that does one task at a time until `end`. A task is late after `deadline`."""

    def __init__(self, folder: str) -> None:
        """Start a process that makes its temporary files in a folder."""
        self.deadline: float | None = None
        self._longer = 0.0  # seconds after the deadline for a task that has handed nothing over
        self._known: bytes | None = None  # what the current task handed over last, pickled
        self._late = False
        self.process = subprocess.Popen(
            command(__name__),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        )
        _under_way.add(self.process)
        self._send(search_path())
        self._send(folder)
        self._begun = False

    def end(self) -> None:
        """Kill the process, and close its pipes."""
        self.kill()
        self.process.wait()
        _under_way.discard(self.process)
        for end in (self.process.stdin, self.process.stdout):
            with suppress(OSError):  # unread output
                assert end
                end.close()

    def allow(self, seconds: float | None, *, starving: bool) -> None:
        """Let the current task be late after some seconds; None for never.

        `starving` gives it longer on a busy machine, until it hands something over.
        """
        if seconds is not None:
            self._longer = (STARVED - 1) * seconds if starving else 0.0
            self.deadline = time.monotonic() + seconds

    def done(self, number: int, work: Callable[..., Any], arguments: tuple[object, ...]) -> Any:
        """Let the process call `work`. Return the result of `work`, or Lost if the process ends.

        `number` is the number of the task, for Lost. `work` must be picklable. After `arguments`,
        it gets a function that returns whether to stop early. `work` may call `hand_over`.
        """
        self._known = None
        self._send((work, arguments))
        output = self.process.stdout
        assert output
        try:
            while not self._begun:
                line = output.readline()
                self._begun = line.endswith(_BEGIN)
                if not line:
                    return self._lost(number)
            while True:
                kind, answer = pickle.load(output)
                if kind == _KNOWN:
                    self._known = answer
                    continue
                if kind == _LAST:  # it must not get another task while it ends
                    self.process.wait()
                return answer
        except (EOFError, pickle.UnpicklingError):
            return self._lost(number)
        finally:
            self.deadline = None

    def _lost(self, number: int) -> Lost:
        """Wait for the end of the process, and return Lost for a task."""
        self.process.kill()
        self.process.wait()
        known = None if self._known is None else pickle.loads(self._known)
        return Lost(number, self._late, known)

    def give_up(self) -> None:
        """Ask the process to end its current task soon. Do not give it another task."""
        self._send(None)

    def end_if_late(self) -> None:
        """Kill the process if its deadline has passed."""
        longer = self._longer if self._known is None else 0.0
        if self.deadline is not None and time.monotonic() > self.deadline + longer:
            self._late = True
            self.kill()

    def kill(self) -> None:
        """Kill the process."""
        self.process.kill()

    def _send(self, message: object) -> None:
        assert self.process.stdin
        with suppress(OSError, ValueError):  # it has ended
            pickle.dump(message, self.process.stdin)
            self.process.stdin.flush()


def answers(
    work: Callable[..., Any],
    tasks: Sequence[tuple[Any, ...]],
    processes: int,
    stopped: Callable[[], bool],
    seconds: float | None,
    patience: float,
) -> Iterator[Any]:
    """Yield what `work` returns for each task, as soon as it is ready; Lost if it has no answer.

    `work` is as in `Worker.done`. A task is a tuple of arguments; the first is its number.
    Once `stopped` returns True, no further task begins, and running tasks may take `patience`
    seconds more. `seconds` is the time for a task, after which its process is killed; None for no
    limit. On a busy machine, the first thing to `hand_over` may take STARVED times as long.
    """
    waiting = queue.SimpleQueue[tuple[Any, ...]]()
    for task in tasks:
        waiting.put(task)
    # Answers, and None for each thread that ends. A SimpleQueue would wait forever if the handler
    # of a signal took longer than the rest of POLL.
    ready = queue.Queue[Any]()
    workers: list[Worker | None] = [None] * processes
    over = threading.Event()  # set when the caller wants no more answers
    folder = tempfile.TemporaryDirectory(prefix="ssh-abduction-", ignore_cleanup_errors=True)
    _folders.add(folder)

    def run(place: int) -> None:
        try:
            while not (stopped() or over.is_set()):
                task = waiting.get_nowait()
                before = workers[place]
                worker = workers[place] = _living(before, folder.name)
                if over.is_set():  # perhaps the other workers have been ended already
                    worker.end()
                    break
                starting = 0.0 if worker is before else STARTING
                worker.allow(seconds and seconds + starting, starving=True)
                ready.put(worker.done(task[0], work, task))
        except queue.Empty:
            pass
        except BaseException as error:
            ready.put(error)
        finally:
            ready.put(None)

    threads = [
        threading.Thread(target=run, args=(place,), daemon=True) for place in range(processes)
    ]
    for thread in threads:
        thread.start()
    running, asked = processes, set[Worker]()
    try:
        while running:
            for worker in filter(None, workers):
                worker.end_if_late()
            for worker in {*filter(None, workers)} - asked if stopped() else ():
                asked.add(worker)
                worker.give_up()
                worker.allow(patience, starving=False)
            with suppress(queue.Empty):
                answer = ready.get(timeout=POLL)
                if answer is None:
                    running -= 1
                elif isinstance(answer, BaseException):
                    raise answer
                else:
                    yield answer
    finally:
        over.set()
        _end([*filter(None, workers)], threads)
        _delete(folder)


def end_all() -> None:
    """Kill all processes started here, and delete their files. Call this before exiting."""
    killed = list(_under_way)
    for process in killed:
        process.kill()
    for process in killed:
        with suppress(subprocess.TimeoutExpired):
            process.wait(DYING)
    for folder in list(_folders):
        _delete(folder)


def _delete(folder: tempfile.TemporaryDirectory[str]) -> None:
    folder.cleanup()
    _folders.discard(folder)


def _living(worker: Worker | None, folder: str) -> Worker:
    """Return this worker if its process still runs, else start a new one."""
    if worker is not None:
        if worker.process.poll() is None:
            return worker
        worker.end()
    return Worker(folder)


def _end(workers: Sequence[Worker], threads: Sequence[threading.Thread]) -> None:
    """Kill processes, and close their pipes once the threads that read from them have ended."""
    for worker in workers:
        worker.kill()
    for thread in threads:
        thread.join()
    for worker in workers:
        worker.end()


class _Work:
    """Receives the tasks of a worker process. When stdin closes, deletes the folder and exits."""

    def __init__(self, folder: str) -> None:
        self._folder = folder
        self.given_up = threading.Event()  # set if the current task should end soon
        self.waiting = queue.SimpleQueue[tuple[Callable[..., Any], tuple[object, ...]]]()
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        try:
            while True:
                message = pickle.load(sys.stdin.buffer)
                if message is None:
                    self.given_up.set()
                else:
                    self.waiting.put(message)
        finally:  # the parent process has exited
            shutil.rmtree(self._folder, ignore_errors=True)
            os._exit(1)


_outputs: list[BinaryIO] = []  # the stream for answers, in a worker process
_sending = threading.Lock()
# The kinds of messages to the parent process: what is known so far, an answer, and an answer after
# which the process ends.
_KNOWN, _ANSWER, _LAST = range(3)


def reply(answer: object) -> None:
    """Send the answer of a task that cannot return, and then end this process."""
    _send(_LAST, answer)


def hand_over(known: object) -> None:
    """Send what is known of the answer so far, in case this process ends without an answer."""
    _send(_KNOWN, pickle.dumps(known))


def _send(kind: int, answer: object) -> None:
    """Send a message to the parent process."""
    with _sending:
        pickle.dump((kind, answer), _outputs[0])
        _outputs[0].flush()


def serves() -> bool:
    """Whether this process is a worker."""
    return bool(_outputs)


def serve() -> None:
    """Run in a worker process: do the tasks that stdin brings, and write the answers to stdout."""
    # The parent process handles these signals, and decides when this process ends.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    output = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what the work prints goes to stderr
    output.write(_BEGIN)
    output.flush()
    _outputs.append(output)
    tempfile.tempdir = pickle.load(sys.stdin.buffer)
    pieces = _Work(tempfile.tempdir)
    while True:
        work, arguments = pieces.waiting.get()
        _send(_ANSWER, work(*arguments, pieces.given_up.is_set))
