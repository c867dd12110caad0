"""Maps of many logs, here or on a Dask cluster: a folder each, and a line on each.

A run is done once its run.json is there and says nothing of an interruption. What is done with the
same settings is not done again, so a call that was stopped is simply made once more.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import os
import sys
import tempfile
import unicodedata
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ssh_abduction.cli import EXIT_ERROR, batch, unwritten
from ssh_abduction.cli.guard import Guard
from ssh_abduction.cli.import_log import doors_of, named_after, reading_of
from ssh_abduction.cli.options import choices_of, theory_of
from ssh_abduction.cli.outcome import exit_code, on_ctrl_c, warn
from ssh_abduction.cli.text import counted
from ssh_abduction.data.errors import AbductionError, SolverError, named
from ssh_abduction.data.files import write_file
from ssh_abduction.runtime.program import SIGNALLED, interrupted_code
from ssh_abduction.solver import Stop, check_limit, workers
from ssh_abduction.theory.theory import Theory

if TYPE_CHECKING:
    from perception.readers.scans import RobotLog
    from ssh_abduction.robot_logs.log_maps import LogMap, LogMapping

KILLED = (
    "process: expected an answer, got killed, as happens when memory runs out; map fewer logs at "
    "a time (--jobs)"
)
GIVEN_UP = "expected time to map this log, got an interruption; map it again"
# The files of a run, and the one that says that it is there.
RUN = "run.json"
FILES = ("trace.jsonl", "maps.json", "page.html", "report.html", RUN)
# Bytes that the name of a folder may have, and hexadecimal digits of a digest that tell logs of one
# name apart.
LONGEST, DIGITS = 255, 8
# Seconds that a worker has to write down what is known once all is to stop.
PATIENCE = 10.0
# The name of a log that goes to a worker keeps so much of its end.
KEPT = 64


@dataclass(frozen=True, slots=True)
class MapAnswer:
    """What became of one log: its number, the line to print, the exit code, what is to be said on stderr, and the files of its folder."""

    number: int
    line: str
    code: int
    warnings: tuple[str, ...] = ()
    files: tuple[tuple[str, bytes], ...] = ()


@dataclass(frozen=True, slots=True)
class MapQuestion:
    """What is asked about each log.

    Plain data, as it travels to other processes and machines; an answer brings its files along.
    """

    theory: Theory | None
    choices: dict[str, Any]
    reading: dict[str, Any]
    gateway: float | None
    radius: float | None
    doors: bool | None
    limit: float | None
    maps: int
    ladder: bool

    @property
    def settings(self) -> dict[str, Any]:
        """What a run depends on besides its log."""
        theory = self.theory.to_dict() if self.theory else None
        laid_over = (self.theory or Theory.topological()).replace(**self.choices).to_dict()
        return {
            "theory": theory,
            "choices": {name: laid_over[name] for name in self.choices},
            "reading": self.reading,
            "gateway": self.gateway,
            "radius": self.radius,
            "doors": self.doors,
            "limit": self.limit,
            "maps": self.maps,
            "ladder": self.ladder,
        }

    def load(self, path: str) -> bytes | None:
        """What goes along to a worker that does not share the disk: the log, if it is one file."""
        file = Path(path)
        return file.read_bytes() if file.is_file() else None

    def answer(
        self,
        number: int,
        path: str,
        content: bytes | None = None,
        given_up: Callable[[], bool] = lambda: False,
        answer_last: Callable[[MapAnswer], None] = workers.reply,
    ) -> MapAnswer:
        """Map a log. Whatever goes wrong is the answer.

        answer_last  takes the answer where clingo does not listen: the process ends then
        """
        try:
            if given_up():
                return self._given_up(number, path)
            if content is None:
                return self._mapped(number, path, path, digest(path), given_up, answer_last)
            sent = hashlib.sha256(content).hexdigest()
            if Path(path).exists() and digest(path) == sent:
                return self._mapped(number, path, path, sent, given_up, answer_last)
            with tempfile.TemporaryDirectory() as folder:
                here = Path(folder) / Path(path).name[-KEPT:]
                here.write_bytes(content)
                return self._mapped(number, path, str(here), sent, given_up, answer_last)
        except Exception as error:  # of any kind: the other logs must not suffer
            return self.failed(number, path, error)

    def _mapped(
        self,
        number: int,
        path: str,
        here: str,
        content: str | None,
        given_up: Callable[[], bool],
        answer_last: Callable[[MapAnswer], None],
    ) -> MapAnswer:
        """Map the log in the file `here`.

        The digest of its content was made before: if the log changes meanwhile, the next call sees
        another digest, and maps it again.
        """
        begun: list[tuple[RobotLog, LogMapping]] = []  # the mapping, once the log is read

        def interrupt() -> None:
            for _, mapping in begun:
                mapping.interrupt()

        def end() -> None:
            if (
                not begun or begun[0][1].search is None or begun[0][1].interrupted
            ):  # nothing is known yet, or this is Ctrl-C once more
                raise KeyboardInterrupt
            interrupt()

        def last_words(_: Stop) -> tuple[MapAnswer, int]:
            known = [
                self._told(number, path, log, mapping.known(), content)
                for log, mapping in begun
                if mapping.search is not None
            ]
            return known[0] if known else self._given_up(number, path), interrupted_code()

        guard = Guard(interrupt, last_words, None, None, given_up=given_up, print_last=answer_last)
        with (
            contextlib.nullcontext() if workers.serves() else on_ctrl_c(end)
        ):  # a worker is told what it is to do
            with guard:
                from perception.readers.logs import read_log
                from ssh_abduction.robot_logs.log_maps import LogMapping, map_log

                log = read_log(here, **self.reading)
                begun.append((log, LogMapping()))
                done = map_log(
                    log,
                    self.theory,
                    choices=self.choices,
                    gateway=self.gateway,
                    radius=self.radius,
                    doors=self.doors,
                    name=named_after(path),
                    time_limit=self.limit,
                    max_maps=self.maps or None,
                    with_ladder=self.ladder,
                    mapping=begun[0][1],
                )
            return self._told(number, path, log, done, content)

    def _told(
        self, number: int, path: str, log: RobotLog, done: LogMap, content: str | None
    ) -> MapAnswer:
        """The answer for a log that was mapped."""
        files = done.files()
        run = json.loads(files["run.json"])
        run["log"]["source"], run["settings"], run["digest"] = path, self.settings, content
        files["run.json"] = (json.dumps(run, indent=2, ensure_ascii=False) + "\n").encode()
        cost, solution = done.solution.cost, done.solution
        found = (
            "no map"
            if cost is None
            else (
                f"{counted(cost.places, 'places')}, {counted(cost.paths, 'paths')}, "
                f"{counted(cost.dstates, 'dstates')}"
            )
        )
        how = (
            f"{solution.status.value}, "
            f"{counted(solution.count, 'minimal maps')}{'' if solution.complete else ' or more'}"
        )
        total = sum(done.seconds.values())
        line = (
            f"{named(path)}: {found}; {how}; {counted(len(done.imported.visits), 'visits')} in "
            f"{counted(len(log), 'scans')}, {done.imported.track.way[-1]:.0f} m; {total:.1f} s"
        )
        code = interrupted_code() if done.interrupted else exit_code(solution)
        return MapAnswer(
            number,
            line,
            code,
            (*log.warnings, *done.notes, *solution.warnings),
            tuple(files.items()),
        )

    def _given_up(self, number: int, path: str) -> MapAnswer:
        """The answer for a log of which nothing is known when all is to stop."""
        return MapAnswer(number, f"{named(path)}: {GIVEN_UP}", interrupted_code())

    @property
    def has_limits(self) -> bool:
        """What reads and maps a log has a process of its own."""
        return True

    @property
    def overdue(self) -> float | None:
        """There is no time after which a process is taken for lost: how long a log takes to read nobody knows before."""
        return None

    @property
    def patience(self) -> float:
        """Seconds that an answer may take once all is to stop."""
        return PATIENCE

    def lost(self, lost: workers.Lost, path: str) -> MapAnswer:
        return self.failed(lost.number, path, SolverError(KILLED))

    def failed(self, number: int, path: str, error: Exception) -> MapAnswer:
        message = batch.in_a_line(error)
        return MapAnswer(
            number,
            message if message.startswith(named(path)) else f"{named(path)}: error: {message}",
            EXIT_ERROR,
        )


def run(options: argparse.Namespace) -> int:
    if options.jobs == 0:
        raise AbductionError(
            "--jobs: expected how many logs to map at a time, or -1 for one a core, got 0; leave "
            "it out for 1"
        )
    if "-" in options.logs:
        raise AbductionError("-: expected the files of logs, got standard input; save it to a file")
    if options.maps < 0:
        raise AbductionError(
            f"--maps: expected how many minimal maps to list, 0 for all, got {options.maps}"
        )
    check_limit("--time-limit", "seconds", options.time_limit)
    _check_folder(Path(options.output))
    question = MapQuestion(
        *_theory(options),
        reading_of(options),
        options.gateway,
        options.radius,
        doors_of(options),
        options.time_limit,
        options.maps,
        options.ladder,
    )
    folders, same = folders_of(options.logs, Path(options.output))
    for path, other in same.items():
        print(f"{named(path)}: the same log as {named(other)}, in {named(str(folders[other]))}")
    left = [path for path in folders if options.again or not is_done(folders[path], path, question)]
    for path in folders:
        if path not in left:
            print(f"{named(path)}: done already, in {named(str(folders[path]))}")
    if len(options.logs) == 1 and options.jobs is None and options.scheduler is None:
        return _alone(question, left, folders)
    codes: list[int] = []
    asked = len(left)
    for path in [*left]:
        try:
            _check_folder(folders[path])
        except AbductionError as error:
            print(f"{named(path)}: error: {error}", flush=True)
            left.remove(path)
            codes.append(EXIT_ERROR)
    stop = batch.Stop()
    if left and options.scheduler is None:
        codes += _kept(batch.here(question, left, options.jobs or 1, stop), left, folders)
    elif left:
        codes += _kept(
            batch.on_cluster(question, left, options.scheduler, options.jobs, stop), left, folders
        )
    if stop.is_set():
        missing = asked - sum(code <= SIGNALLED for code in codes)
        print(
            f"ssh-abduction: interrupted: {missing} of {asked} logs not finished", file=sys.stderr
        )
        return interrupted_code()
    if errors := codes.count(EXIT_ERROR):
        print(
            f"ssh-abduction: errors in {errors} of {len(codes)} logs, on their lines",
            file=sys.stderr,
        )
        return EXIT_ERROR
    return max(codes, default=0)


def _alone(question: MapQuestion, left: list[str], folders: dict[str, Path]) -> int:
    """Map the only log in this process, if it is not done already.

    Returns the exit code. Raises AbductionError.
    """

    def keep(answer: MapAnswer) -> None:
        if answer.code == EXIT_ERROR:
            raise AbductionError(answer.line)
        try:
            write_run(folders[left[0]], answer.files)
        except OSError as error:
            raise AbductionError(unwritten(error, folders[left[0]])) from None
        _say(answer, folders[left[0]])
        warn(answer.warnings)

    codes = [0]
    for path in left:
        _check_folder(folders[path])
        answer = question.answer(0, path, answer_last=keep)
        keep(answer)
        codes.append(answer.code)
    return max(codes)


def _kept(
    answers: Iterator[MapAnswer], paths: list[str], folders: dict[str, Path]
) -> Iterator[int]:
    """Write the files of each answer as it comes, and print its line. Yields the exit codes."""
    for answer in answers:
        path, code = paths[answer.number], answer.code
        try:
            write_run(folders[path], answer.files)
        except OSError as error:  # the other logs must not suffer
            print(f"{named(path)}: error: {unwritten(error, folders[path])}", flush=True)
            code = EXIT_ERROR
        else:
            _say(answer, folders[path])
        warn([f"{named(path)}: {warning}" for warning in answer.warnings])
        yield code


def _say(answer: MapAnswer, folder: Path) -> None:
    where = f" → {named(str(folder))}" if answer.files else ""
    print(f"{answer.line}{where}", flush=True)


def write_run(folder: Path, files: Sequence[tuple[str, bytes]]) -> None:
    """Write the files of a run into its folder, made if need be. run.json is removed first and written last, so it never stands beside files of another run.

    Raises:
        OSError: A file cannot be written; its name is that of the file.
    """
    if not files:
        return
    folder.mkdir(parents=True, exist_ok=True)
    given = dict(files)
    for name in (RUN, *(name for name in FILES if name not in given)):
        (folder / name).unlink(missing_ok=True)
    for name in sorted(given, key=lambda name: name == RUN):
        try:
            write_file(folder / name, given[name])
        except OSError as error:
            error.filename = str(folder / name)  # it may be that of the draft, or none
            raise


def _check_folder(folder: Path) -> None:
    """Whether a folder can be made and written, before hours of work. Raises AbductionError."""
    there = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    if not there.is_dir():
        raise AbductionError(
            f"{named(str(folder))}: expected a folder to write, got a file: {named(str(there))}; "
            "name another one"
        )
    if not os.access(there, os.W_OK):
        raise AbductionError(
            f"{named(str(folder))}: expected a folder that can be written, got no permission in "
            f"{named(str(there))}; name another one"
        )


def folders_of(logs: Sequence[str], folder: Path) -> tuple[dict[str, Path], dict[str, str]]:
    """The folder of each log, and which logs are the same as another one.

    A log that has a run in `folder` keeps that run's folder, whatever it is called now. Else one
    log alone has `folder`, and each of several logs a folder in it, named after the log. Where that
    folder has the run of another log, or several logs have one name, the name ends in a part of the
    digest of the log. So the order of the logs does not matter. A log that cannot be read, or only
    once, leaves the names to the others.
    """
    contents = {path: _content(path) for path in dict.fromkeys(logs)}
    runs = _runs_in(folder)
    owners = {_key(place) for places in runs.values() for place in places}
    new = {
        (_key(folder / named_after(path)), content)
        for path, content in contents.items()
        if content and content not in runs
    }
    named_so = Counter(key for key, _ in new)
    found: dict[str, Path] = {}
    same: dict[str, str] = {}
    for path in sorted(contents, key=lambda path: (named_after(path), path)):
        content, plain = contents[path], folder / named_after(path)
        wished = folder if len(contents) == 1 else plain
        if content in runs:
            places = runs[content]
            place = wished if wished in places else places[0]
        else:
            digits = content or hashlib.sha256(os.fsencode(os.path.abspath(path))).hexdigest()
            longer = folder / f"{_cut(plain.name)}-{digits[:DIGITS]}"
            choices = [
                *([folder] if wished == folder else []),
                *([plain] if content and named_so[_key(plain)] == 1 else []),
                longer,
            ]
            place = next((one for one in choices if _key(one) not in owners), folder / digits)
            if place != wished and content:
                why = (
                    "has the map of another log"
                    if _key(wished) in owners
                    else "is the name of several logs"
                )
                warn(
                    [
                        f"{named(path)}: its folder is {named(str(place))}, as "
                        f"{named(str(wished))} {why}"
                    ]
                )
        other = next((one for one, taken in found.items() if _key(taken) == _key(place)), None)
        if other is None:
            found[path] = place
        else:
            same[path] = other
    return {path: found[path] for path in contents if path in found}, same


def _runs_in(folder: Path) -> dict[str, list[Path]]:
    """The folders with a run, by the digest of its log: this folder, and those in it."""
    found: dict[str, list[Path]] = {}
    with suppress(OSError):
        for place in (folder, *sorted(one for one in folder.iterdir() if one.is_dir())):
            content = _run_in(place).get("digest")
            if isinstance(content, str):
                found.setdefault(content, []).append(place)
    return found


def _run_in(folder: Path) -> dict[str, Any]:
    """What run.json of a folder holds; nothing where there is none that can be read."""
    with suppress(OSError, ValueError, RecursionError):
        run = json.loads((folder / RUN).read_text(encoding="utf-8"))
        return run if isinstance(run, dict) else {}
    return {}


def _content(path: str) -> str | None:
    """The digest of a log; None where it cannot be read, or only once."""
    with suppress(OSError, AbductionError):
        return digest(path)
    return None


def _key(folder: Path) -> str:
    """A name of a folder that is the same for names which some disks take for one."""
    return unicodedata.normalize("NFC", os.path.abspath(folder)).casefold()


def _cut(name: str) -> str:
    """A name that is short enough for a part of a digest behind it."""
    return (
        os.fsdecode(os.fsencode(name)[: LONGEST - DIGITS - 1])
        if len(os.fsencode(name)) > LONGEST - DIGITS - 1
        else name
    )


def _theory(options: argparse.Namespace) -> tuple[Theory | None, dict[str, Any]]:
    """The theory that is named, and what is laid over it.

    Where none is named, it is None, as it then depends on the log. Raises TheoryError.
    """
    asked = theory_of(options)
    choices = {name: getattr(asked, name) for name in choices_of(options)}
    return (asked, {}) if options.theory or asked.level == "causal" else (None, choices)


def is_done(folder: Path, path: str, question: MapQuestion) -> bool:
    """Whether a folder holds the whole run of this log with these settings."""
    run = _run_in(folder)
    settings, content = json.loads(json.dumps(question.settings)), run.get("digest")
    return bool(
        run.get("settings") == settings
        and not run.get("interrupted")
        and content is not None
        and content == _content(path)
    )


def digest(path: str) -> str | None:
    """A digest of a log: of its content, or, of a folder, of the names and contents of its files.

    None of a pipe, which can be read only once. Raises LogError.
    """
    from perception.readers.lines import opened

    whole = hashlib.sha256()
    file = Path(path)
    if file.is_dir():
        for part in sorted(file.rglob("*")):
            whole.update(os.fsencode(f"{part.relative_to(file)}\0"))
            if part.is_file():
                with part.open("rb") as content:
                    whole.update(hashlib.file_digest(content, "sha256").digest())
    elif file.is_file() or not file.exists():
        with opened(path) as content:
            for block in iter(partial(content.read, 2**20), b""):
                whole.update(block)
    else:
        return None
    return whole.hexdigest()
