"""ssh-abduction map LOG …: map many logs, here or on a Dask cluster, each into a folder.

A log that is already mapped with the same settings is skipped. So to go on after an interruption,
give the same command again.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from ssh_abduction.cli import import_log, jobs, shared
from ssh_abduction.cli.correct import say_obeyed
from ssh_abduction.cli.outcome import (
    EXIT_ERROR,
    EXIT_UNPROVEN,
    Guard,
    StopFlag,
    exit_code,
    on_ctrl_c,
    warn,
)
from ssh_abduction.cli.parsing import verb
from ssh_abduction.cli.text import counted
from ssh_abduction.data.checks import check_limit
from ssh_abduction.data.corrections import (
    ASSERTIONS,
    Corrections,
    beside,
    load_corrections,
    to_yaml,
)
from ssh_abduction.data.errors import AbductionError, MapError, brief, named
from ssh_abduction.data.groups import gathered
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.schema import attributes_of
from ssh_abduction.runtime import workers
from ssh_abduction.runtime.loggers import begin_stage, stages
from ssh_abduction.runtime.program import interrupted_code
from ssh_abduction.solution import Solution, Stop
from ssh_abduction.theory.theory import Theory

if TYPE_CHECKING:
    from ssh_abduction.robot_logs.log_maps import LogMap, LogMapping


GIVEN_UP = "expected time to map this log, got an interruption; map it again"
HURRY = 0.5  # seconds for the search, after the process that mapped the log was killed
KEPT = 64  # the copy of a log for a worker keeps this many last characters of its name


@dataclass(frozen=True, slots=True)
class MapQuestion(jobs.FileQuestion):
    """The settings for mapping each of many logs."""

    theory: Theory | None  # the theory; None to choose it for each log
    choices: dict[str, Any]  # the fields of the theory that the user set, by name
    reading: dict[str, Any]  # the arguments of `read_log`, by name
    width: float  # the width of the robot, in metres
    limit: float | None  # seconds after which the search ends in any case; None for no limit
    maps: int  # the largest number of maps to list; 0 for all
    # Names and corrections of a person, to be obeyed; None for none.
    corrections: Corrections | None = None
    # The best maps of a process that mapped the log and was killed; None if none was killed.
    known: tuple[SSHMap, ...] | None = None
    # Units of work for the search for minimal maps; None for the default of `map_log`.
    work: float | None = None
    # Whether logs are added to those of the map in the folder. Views are clustered anew, so the
    # fingerprints of the old drives change, and are not compared.
    adding: bool = False

    patience: ClassVar = 10.0
    killed: ClassVar = (
        "process: expected an answer, got a killed process, as when memory runs out; map fewer "
        "logs at a time (--jobs)"
    )

    def hurried(self, known: SSHMap | None) -> MapQuestion:
        """Implement `FileQuestion.hurried`: go on from the best map, and give the search no time.

        The run counts as interrupted, so that the next call maps the log again.
        """
        maps = () if known is None else (known,)
        return replace(self, limit=HURRY, work=HURRY, known=maps)

    def obeying(self, folder: Path) -> MapQuestion:
        """Return this question with the corrections in a folder, if any. Raises MapError."""
        if (file := beside(folder / "maps.json")) is None:
            return self
        said = load_corrections(file)
        return replace(self, corrections=replace(said, drives={}) if self.adding else said)

    @property
    def settings(self) -> dict[str, Any]:
        """All settings that a run depends on, as a dict for JSON, to recognise finished runs."""
        laid_over = (self.theory or Theory.topological()).replace(**self.choices).to_dict()
        return {
            "theory": self.theory.to_dict() if self.theory else None,
            "choices": {name: laid_over[name] for name in self.choices},
            **attributes_of(self, "reading", "width", "limit", "work", "maps"),
            **({} if self.corrections is None else {"corrections": to_yaml(self.corrections)}),
        }

    def load(self, path: str) -> bytes | None:
        """Read a log, as a worker may not be able to read the file; None if it is a folder."""
        file = Path(path)
        return file.read_bytes() if file.is_file() else None

    def answer(
        self,
        number: int,
        path: str,
        content: bytes | None = None,
        given_up: Callable[[], bool] = lambda: False,
    ) -> jobs.FileAnswer:
        """Implement `FileQuestion.answer`: map one log. If that fails, the answer says why."""
        try:
            if given_up():
                return self._given_up(number, path)
            if content is None or (Path(path).is_file() and Path(path).read_bytes() == content):
                return self.mapped(number, [path], given_up=given_up)
            with tempfile.TemporaryDirectory() as folder:
                here = Path(folder) / Path(path).name[-KEPT:]
                here.write_bytes(content)
                return self.mapped(number, [path], [str(here)], given_up)
        except Exception as error:  # one bad log must not stop the others
            return self.failed(number, path, error)

    def mapped(
        self,
        number: int,
        paths: Sequence[str],
        copies: Sequence[str] = (),
        given_up: Callable[[], bool] = lambda: False,
        keep: Callable[[jobs.FileAnswer], None] | None = None,
        tell: Callable[[str], None] = lambda note: None,
    ) -> jobs.FileAnswer:
        """Map one log, or several drives through one building together. Raises AbductionError.

        Args:
            number: The number of the answer.
            paths: The logs.
            copies: Files with the same content, to be read instead.
            given_up: Returns whether the answer is not needed any more.
            keep: Writes the answer; None in a worker process.
            tell: Takes each warning about a log as soon as it is known.
        """
        files = copies or paths
        # If a log changes after this, the next call sees another digest, and maps it again.
        content = import_log.digest(files)
        started = time.monotonic()
        begun: list[LogMapping] = []  # one entry, once the logs are read
        names = [import_log.named_after(path) for path in paths]

        def interrupt() -> None:
            for mapping in begun:
                mapping.interrupt()

        def end() -> None:
            if not begun or begun[0].search is None:  # nothing is known yet
                raise KeyboardInterrupt
            interrupt()

        def last_words(_: Stop) -> tuple[str, int, Callable[[], None]]:
            answer = self._given_up(number, paths[0])
            if begun and begun[0].search is not None:
                answer = self._answer(number, paths, begun[0].known(), content, started)
            return "", interrupted_code(), partial(keep or workers.reply, answer)

        def best() -> tuple[SSHMap] | None:
            search = begun[0].search if begun else None
            return (search.best,) if search and search.best else None

        def hand_over() -> None:
            if workers.serves() and (found := best()):
                workers.hand_over(found[0])

        guard = Guard(interrupt, last_words, given_up=given_up, known=best, hand_over=hand_over)
        # A worker process does not handle Ctrl-C: its parent stops it.
        imports = ("track", "places", "trace", "views") if len(files) == 1 else ("imports",)
        planned = stages("log", *imports, "search", "page")
        with contextlib.nullcontext() if workers.serves() else on_ctrl_c(end), guard, planned:
            from perception.readers.logs import read_log
            from ssh_abduction.robot_logs.log_maps import INTERRUPTED, LogMapping, map_log

            logs = [read_log(file, **self.reading) for file in files]
            begin_stage("imports")
            begun.append(LogMapping(self.known or ()))
            for log, name in zip(logs, names, strict=True):
                for warning in log.warnings:
                    tell(warning if len(logs) == 1 else f"{name}: {warning}")
            done = map_log(
                logs if len(logs) > 1 else logs[0],
                self.theory,
                choices=self.choices,
                width=self.width,
                name=names if len(logs) > 1 else names[0],
                time_limit=self.limit,
                work_limit=self.work,
                max_maps=self.maps or None,
                corrections=self.corrections,
                mapping=begun[0],
                tell=tell,
            )
            if self.corrections:
                say_obeyed(self.corrections, done.imported.trace)
            if self.known is not None:
                done = replace(done, interrupted=True, notes=(*done.notes, INTERRUPTED))
            answer = self._answer(number, paths, done, content, started)
            if keep:
                guard.finish(answer.code, save=partial(keep, answer))
        return answer

    def _answer(
        self, number: int, paths: Sequence[str], done: LogMap, content: str | None, started: float
    ) -> jobs.FileAnswer:
        """Make the answer for a log that was mapped, or for several that were mapped together.

        `started` is the time at which reading the logs began.
        """
        files, log = done.files(), done.log
        run = json.loads(files["run.json"])
        run["log"]["source"] = " + ".join(paths)
        run["settings"], run["digest"] = self.settings, content
        sources, path = {import_log.named_after(path): path for path in paths}, paths[0]
        for drive in run.get("drives", ()):
            # A part of a log after a jump of the odometer has another name than any log.
            drive["source"] = path = sources.get(drive["name"], path)
        files["run.json"] = (json.dumps(run, indent=2, ensure_ascii=False) + "\n").encode()

        solution = done.solution
        visits = counted(len(done.imported.visits), "visits")
        way = f"{counted(len(log), 'scans')}, {done.imported.track.way[-1]:.0f} m"
        seconds = f"{time.monotonic() - started:.1f} s"
        parts = [solution.headline, solution.sureness, solution.joined]
        detail = "; ".join(filter(None, [*parts, f"{visits} in {way}", seconds]))
        line = f"{' + '.join(map(named, paths))}: {solution.verdict}\n  {detail}"
        is_ended = done.interrupted and self.known is None  # by a person
        code = interrupted_code() if is_ended else exit_code(solution)
        notes = (*log.warnings, *done.notes, *solution.warnings)
        return jobs.FileAnswer(number, line, code, notes, tuple(files.items()))

    def _given_up(self, number: int, path: str) -> jobs.FileAnswer:
        """Make the answer for a log that was interrupted before anything was known."""
        return jobs.FileAnswer(number, f"{named(path)}: {GIVEN_UP}", interrupted_code())

    def failed(self, number: int, path: str, error: Exception) -> jobs.FileAnswer:
        message = jobs.in_a_line(error)
        if not message.startswith((named(path), named(Path(path)))):
            message = f"{named(path)}: error: {message}"
        return jobs.FileAnswer(
            number,
            message,
            EXIT_ERROR,
            tuple(getattr(error, "__notes__", ())),  # the warnings that may say why
        )


@verb(
    READING=import_log.READING,
    theory_rows=shared.theory_rows(
        "topological, but without the axioms of stars, sides and paths, as logs do not show "
        "these reliably"
    ),
)
def run_map(options: argparse.Namespace) -> int:
    """Map a building from a robot's log.

    Find the minimal maps of a building. Writes trace.jsonl, maps.json, page.html and
    run.json into a folder. With several logs, each gets its own folder, and its result is
    a verdict with a line of details.
    Logs that are already mapped with the same settings are skipped. With --together, the logs are
    drives through one building, and get one map.
    """
    shared.check_jobs(options.jobs, "logs to map at a time")
    if "-" in options.logs:
        raise AbductionError(
            "-: expected the files of logs, got standard input; save the log to a file"
        )
    if options.maps < 0:
        raise AbductionError(
            f"--maps: expected a number of minimal maps to list, 0 for all, got {options.maps}"
            "; leave it out for 300"
        )
    check_limit("--time-limit", "seconds", options.time_limit)
    check_limit("--work-limit", "units of work", options.work_limit)
    import_log.check_folder(Path(options.output))
    question = MapQuestion(
        *_theory(options),
        reading=import_log.reading_of(options),
        width=options.width or import_log.WIDTH,
        limit=options.time_limit,
        work=options.work_limit,
        maps=options.maps,
    )
    if options.add:
        return _added(replace(question, adding=True), options)
    if options.together:
        return _together(question, options)
    folders, same = import_log.folders_of(options.logs, Path(options.output))
    for path, other in same.items():
        print(f"{named(path)}: the same log as {named(other)}, in {named(folders[other])}")
    # Skip the logs that are done, and those with a folder that cannot be written.
    left, codes = dict(folders), list[int]()
    for path, folder in () if options.again else folders.items():
        code = import_log.code_of_done(folder, [path], question.obeying(folder).settings)
        if code is not None:
            print(f"{named(path)}: done already, in {named(left.pop(path))}")
            codes.append(code)
    if len(options.logs) == 1 and options.jobs is None and options.scheduler is None:
        return max([*codes, *(_here(question, [path], folder) for path, folder in left.items())])
    return _many(question, options, left, codes)


def _many(
    question: MapQuestion, options: argparse.Namespace, folders: dict[str, Path], codes: list[int]
) -> int:
    """Map each of many logs into its folder, and return the exit code.

    `codes` has those of the logs that are done already.
    """
    asked, left = len(codes) + len(folders), [*folders]
    for path, folder in folders.items():
        try:
            import_log.check_run_folder(folder)
            _check_alone(path, folder)
        except AbductionError as error:
            print(f"{named(path)}: error: {error}", flush=True)
            left.remove(path)
            codes.append(EXIT_ERROR)
    stop = StopFlag()
    if left:
        codes += _kept(jobs.answers_of(question, left, options, stop), left, folders)
    return jobs.final_code(codes, asked, stop, "logs")


def _together(question: MapQuestion, options: argparse.Namespace) -> int:
    """Map all logs together, and return the exit code."""
    shared.refuse(options, "--together", "jobs", "scheduler")
    logs, same = import_log.distinct(options.logs)
    warn([f"{named(log)}: the same log as {named(other)}; it is left out" for log, other in same])
    names: dict[str, str] = {}
    for log in logs:
        if (other := names.setdefault(import_log.named_after(log), log)) != log:
            raise AbductionError(
                f"{named(log)}: expected a name different from {named(other)}, as each drive gets "
                "the name of its log; rename one of them"
            )
    folder = Path(options.output)
    code = import_log.code_of_done(folder, logs, question.obeying(folder).settings)
    if code is not None and not options.again:
        print(f"{counted(len(logs), 'logs')}: done already, in {named(folder)}")
        return code
    return _here(question, logs, folder)


def _added(question: MapQuestion, options: argparse.Namespace) -> int:
    """Map the logs of the map in the folder and further ones together. Return the exit code."""
    folder = Path(options.output)
    before = import_log.logs_in(folder)
    for log in before:
        if not Path(log).exists():
            raise AbductionError(
                f"{named(log)}: expected the log of the map in {named(folder)}, got no such file; "
                "call this where the map was made, or put the log there"
            )
    old = Solution.load(folder / "maps.json").maps
    options.logs = [*before, *(log for log in options.logs if log not in before)]
    code = _together(question, options)
    new = Solution.load(folder / "maps.json").maps
    if old and new and code in (0, EXIT_UNPROVEN):
        print(_numbers_kept(old[0], new[0]))
    return code


def _with_corrections(answer: jobs.FileAnswer, folder: Path) -> jobs.FileAnswer:
    """Add the corrections in a folder to an answer of more drives, with the new fingerprints.

    Raises MapError if the steps of the old drives are at other scans, as corrections name steps.
    """
    files, file = dict(answer.files), beside(folder / "maps.json")
    if file is None or not files:
        return answer
    scans = [
        [json.loads(line).get("scan") for line in data.splitlines()[1:]]
        for data in ((folder / "trace.jsonl").read_bytes(), files["trace.jsonl"])
    ]
    if scans[0] != scans[1][: len(scans[0])]:
        raise MapError(
            f"{named(file)}: expected drives whose steps are where they were, got other steps when "
            "the logs were imported together; nothing was written: map them into another folder"
        )
    marks = {d["name"]: d["fingerprint"] for d in json.loads(files["maps.json"])["drives"]}
    said = to_yaml(replace(load_corrections(file), drives=marks))
    return replace(answer, files=(*answer.files, (file.name, said.encode())))


def _numbers_kept(old: SSHMap, new: SSHMap) -> str:
    """Say how many places of a map are in another one, whose first steps are those of the map."""
    at = [
        [m.dstates[label].place for label in m.dstate_at[: len(old.dstate_at)]] for m in (old, new)
    ]
    steps = [gathered((place, t) for t, place in enumerate(some)) for some in at]
    kept = sum(steps[1].get(place) == some for place, some in steps[0].items())
    more = len({s.place for s in new.dstates} - {*at[1]})
    return (
        f"{kept} of {counted(len(steps[0]), 'places')} keep their visits and their number; "
        f"{counted(more, 'places')} {'is' if more == 1 else 'are'} new"
    )


def _check_alone(path: str, folder: Path) -> None:
    """Raise MapError if a log that is mapped among others has corrections in its folder."""
    if (file := beside(folder / "maps.json")) is not None:
        raise MapError(
            f"{named(path)}: expected no corrections, got {named(file)}, which a call for many "
            f"logs does not obey; map this log alone, with -o {named(folder)}"
        )


def _here(question: MapQuestion, logs: Sequence[str], folder: Path) -> int:
    """Map a log, or several together, in this process, and return the exit code."""
    printed: set[str] = set()  # warnings that were printed while the logs were mapped

    def tell(warning: str) -> None:
        printed.add(warning)
        warn([warning])

    def keep(answer: jobs.FileAnswer) -> None:
        _keep(_with_corrections(answer, folder) if question.adding else answer, folder)
        warn([warning for warning in answer.warnings if warning not in printed])

    import_log.check_run_folder(folder)
    question = question.obeying(folder)
    try:
        return question.mapped(0, logs, keep=keep, tell=tell).code
    except Exception as error:
        if len(logs) > 1 or isinstance(error, import_log.UnwrittenError):
            raise
        raise AbductionError(question.failed(0, logs[0], error).line) from None


def _kept(
    answers: Iterator[jobs.FileAnswer], paths: list[str], folders: dict[str, Path]
) -> Iterator[int]:
    """Write the files of each answer and print its line, as they come. Yield the exit codes."""
    for answer in answers:
        path, code = paths[answer.number], answer.code
        try:
            _keep(answer, folders[path])
        except import_log.UnwrittenError as error:  # one full disk must not stop the other logs
            print(f"{named(path)}: error: {error}", flush=True)
            code = EXIT_ERROR
        jobs.warn_of(answer, path)
        yield code


def _keep(answer: jobs.FileAnswer, folder: Path) -> None:
    """Write the files of an answer, and print its line. Raises UnwrittenError."""
    import_log.write_run(folder, answer.files)
    where = f" → {named(folder)}" if answer.files else ""
    print(f"{answer.line}{where}", flush=True)


def _theory(options: argparse.Namespace) -> tuple[Theory | None, dict[str, Any]]:
    """Find the theory that the user names, if any, or else the fields that the user set."""
    for name in ASSERTIONS:
        flag = f"--{name.replace('_', '-')}"
        for pair in getattr(options, name) or []:
            if ":" in pair:
                raise AbductionError(
                    f"{flag}: expected numbers of steps, as no drive is read yet, got "
                    f"{brief(pair)}; map without it, then call ssh-abduction correct "
                    f"{named(options.output)} {flag} {named(pair)}, and map again"
                )
    asked = shared.theory_of(options)
    choices = {name: getattr(asked, name) for name in shared.choices_of(options)}
    return (asked, {}) if options.theory or asked.level == "causal" else (None, choices)
