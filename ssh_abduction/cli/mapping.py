"""Maps of many logs, here or on a Dask cluster: a folder each, and a line on each.

A run is done once its run.json is there. What is done with the same settings is not done again, so a call that was stopped is simply made once more.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import sys
import tempfile
from collections.abc import Callable, Generator
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from ssh_abduction.asp import workers
from ssh_abduction.asp.limits import check_limit
from ssh_abduction.cli import EXIT_ERROR, batch
from ssh_abduction.cli.import_log import damage, doors_of, named_after
from ssh_abduction.cli.options import choices_of, theory_of
from ssh_abduction.cli.outcome import exit_code, warn
from ssh_abduction.cli.text import counted
from ssh_abduction.errors import SolverError, SSHError, named
from ssh_abduction.files import write_file
from ssh_abduction.program import interrupted_code
from ssh_abduction.theory.theory import Theory

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
    """What is asked about each log. Plain data, as it travels to other processes and machines; an answer brings its files along."""

    theory: Theory | None
    choices: dict[str, Any]
    reading: tuple[str | None, str | None, str | None]
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
            "reading": list(self.reading),
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

    def answer(self, number: int, path: str, content: bytes | None = None, given_up: Callable[[], bool] = lambda: False) -> MapAnswer:
        """Map a log. Whatever goes wrong is the answer."""
        try:
            if given_up():
                raise SSHError("expected time to map this log, got none, as all was stopped; map it again")
            if content is None:
                return self._mapped(number, path, path, digest(path))
            sent = hashlib.sha256(content).hexdigest()
            if Path(path).exists() and digest(path) == sent:
                return self._mapped(number, path, path, sent)
            with tempfile.TemporaryDirectory() as folder:
                here = Path(folder) / Path(path).name[-KEPT:]
                here.write_bytes(content)
                return self._mapped(number, path, str(here), sent)
        except Exception as error:  # of any kind: the other logs must not suffer
            return self.failed(number, path, error)

    def _mapped(self, number: int, path: str, here: str, content: str | None) -> MapAnswer:
        """Map the log in the file `here`. The digest of its content was made before: if the log changes meanwhile, the next call sees another digest, and maps it again."""
        from perception.readers.logs import read_log
        from ssh_abduction.log_maps import map_log

        log_format, scan_topic, odom_topic = self.reading
        log = read_log(here, log_format, scan_topic=scan_topic, odom_topic=odom_topic)
        done = map_log(
            log,
            self.theory,
            choices=self.choices,
            gateway=self.gateway,
            radius=self.radius,
            doors=self.doors,
            name=named_after(path),
            limit=self.limit,
            maps=self.maps,
            with_ladder=self.ladder,
        )
        files = done.files()
        run = json.loads(files["run.json"])
        run["log"]["source"], run["settings"], run["digest"] = path, self.settings, content
        files["run.json"] = (json.dumps(run, indent=2, ensure_ascii=False) + "\n").encode()
        cost, solution = done.solution.cost, done.solution
        found = (
            "no map"
            if cost is None
            else f"{counted(cost.places, 'places')}, {counted(cost.paths, 'paths')}, {counted(cost.dstates, 'dstates')}"
        )
        how = f"{solution.status.value}, {counted(solution.count, 'minimal maps')}{'' if solution.complete else ' or more'}"
        total = sum(done.seconds.values())
        line = f"{named(path)}: {found}; {how}; {counted(len(done.imported.visits), 'visits')} in {counted(len(log), 'scans')}, {done.imported.track.way[-1]:.0f} m; {total:.1f} s"
        return MapAnswer(number, line, exit_code(solution), (*damage(log), *done.notes, *solution.warnings), tuple(files.items()))

    @property
    def has_limits(self) -> bool:
        """What reads and maps a log has a process of its own."""
        return True

    @property
    def overdue(self) -> float | None:
        """There is no time after which a process is taken for lost: how long a log takes to read nobody knows before."""
        return None

    def lost(self, lost: workers.Lost, path: str) -> MapAnswer:
        return self.failed(lost.number, path, SolverError(batch.KILLED))

    def failed(self, number: int, path: str, error: Exception) -> MapAnswer:
        message = batch.in_a_line(error)
        return MapAnswer(number, message if message.startswith(named(path)) else f"{named(path)}: error: {message}", EXIT_ERROR)


def run(options: argparse.Namespace) -> int:
    if options.jobs == 0:
        raise SSHError("--jobs: expected how many logs to map at a time, or -1 for one a core, got 0; leave it out for 1")
    if "-" in options.logs:
        raise SSHError("-: expected the files of logs, got standard input; save it to a file")
    if options.maps < 0:
        raise SSHError(f"--maps: expected how many minimal maps to list, 0 for all, got {options.maps}")
    check_limit("--time-limit", "seconds", options.time_limit)
    _check_folder(Path(options.output))
    question = MapQuestion(
        *_theory(options),
        (options.format, options.scan_topic, options.odom_topic),
        options.gateway,
        options.radius,
        doors_of(options),
        options.time_limit,
        options.maps,
        not options.no_ladder,
    )
    folders = _folders(options.logs, Path(options.output))
    left = [path for path in folders if options.again or not is_done(folders[path], path, question)]
    for path in folders:
        if path not in left:
            print(f"{named(path)}: done already, in {named(str(folders[path]))}")
    if len(folders) == 1 and options.jobs is None and options.scheduler is None:
        answers = (question.answer(0, path) for path in left)
        return _kept(answers, left, folders, alone=True)
    with tempfile.TemporaryDirectory() as folder:
        stop = batch.Stop(Path(folder) / "stop")
        if not left:
            return 0
        if options.scheduler is None:
            found = batch.here(question, left, options.jobs or 1, stop)
        else:
            found = batch.on_cluster(question, left, options.scheduler, options.jobs, stop)
        code = _kept(found, left, folders)
        return interrupted_code() if stop.is_set() else code


def _kept(answers: Generator[MapAnswer], paths: list[str], folders: dict[str, Path], alone: bool = False) -> int:
    """Write the files of each answer as it comes, and print its line. Returns the exit code."""
    codes = [0]
    for answer in answers:
        if alone and answer.code == EXIT_ERROR:
            raise SSHError(answer.line)
        folder = folders[paths[answer.number]]
        for name, content in answer.files:
            folder.mkdir(parents=True, exist_ok=True)
            write_file(folder / name, content)
        where = f" → {named(str(folder))}" if answer.files else ""
        print(f"{answer.line}{where}", flush=True)
        warn(answer.warnings)
        codes.append(answer.code)
    if not alone and (errors := codes.count(EXIT_ERROR)):
        print(f"ssh-abduction: errors in {errors} of {len(paths)} logs, on their lines", file=sys.stderr)
        return EXIT_ERROR
    return max(codes)


def _check_folder(folder: Path) -> None:
    """Whether a folder can be made and written, before hours of work. Raises SSHError."""
    there = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    if not there.is_dir():
        raise SSHError(f"{named(str(folder))}: expected a folder to write, got a file: {named(str(there))}; name another one")
    if not os.access(there, os.W_OK):
        raise SSHError(
            f"{named(str(folder))}: expected a folder that can be written, got no permission in {named(str(there))}; name another one"
        )


def _folders(logs: list[str], folder: Path) -> dict[str, Path]:
    """The folder of each log: the one that was named, or, of several logs, one in it."""
    if len(logs) == 1:
        return {logs[0]: folder}
    folders: dict[str, Path] = {}
    for path in dict.fromkeys(logs):
        name = named_after(path) or "log"
        taken = {other.name for other in folders.values()}
        folders[path] = folder / next(one for k in range(1, len(logs) + 1) if (one := name if k == 1 else f"{name}-{k}") not in taken)
    return folders


def _theory(options: argparse.Namespace) -> tuple[Theory | None, dict[str, Any]]:
    """The theory that is named, and what is laid over it. Where none is named, it is None, as it then depends on the log. Raises TheoryError."""
    asked = theory_of(options)
    choices = {name: getattr(asked, name) for name in choices_of(options)}
    return (asked, {}) if options.theory or asked.level == "causal" else (None, choices)


def is_done(folder: Path, path: str, question: MapQuestion) -> bool:
    """Whether a folder holds the run of this log with these settings."""
    with suppress(OSError, ValueError, KeyError, TypeError):
        run = json.loads((folder / "run.json").read_text())
        settings = json.loads(json.dumps(question.settings))
        return bool(run["settings"] == settings and run["digest"] is not None and run["digest"] == digest(path))
    return False


def digest(path: str) -> str | None:
    """A digest of a log: of its content, or, of a folder, of the names and sizes of its files. None of a pipe, which can be read only once. Raises LogError."""
    from perception.readers.lines import opened

    whole = hashlib.sha256()
    file = Path(path)
    if file.is_dir():
        for part in sorted(file.rglob("*")):
            whole.update(f"{part.relative_to(file)} {part.stat().st_size}\n".encode())
    elif file.is_file() or not file.exists():
        with opened(path) as content:
            for block in iter(partial(content.read, 2**20), b""):
                whole.update(block)
    else:
        return None
    return whole.hexdigest()
