"""ssh-abduction import LOG: make a trace from a robot's log. Manage the folders of mapped logs.

A folder belongs to the log whose digest is in its run.json. The log is done if this file does not
say that the run was interrupted.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import sys
import tempfile
import unicodedata
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from ssh_abduction.cli.outcome import EXIT_CODES, StopFlag, on_ctrl_c, unwritten, warn
from ssh_abduction.cli.parsing import MAPS, RUN, TRACE, rows_of, verb
from ssh_abduction.cli.shared import check_ending, check_output, write_trace
from ssh_abduction.cli.text import counted
from ssh_abduction.data.errors import AbductionError, named
from ssh_abduction.data.files import write_file
from ssh_abduction.runtime import program
from ssh_abduction.runtime.loggers import stages

if TYPE_CHECKING:
    from perception.places.distinctive import Visit
    from perception.places.importing import Imported
    from perception.readers.scans import RobotLog


Item = TypeVar("Item")

# Repeats perception.places.distinctive.
WIDTH = 0.5
# Endings of file names: first those of compression, then those of formats.
ENDINGS = (
    ("gz", "bz2", "xz", "zst", "zstd", "lz4"),
    ("log", "clf", "carmen", "txt", "g2o", "graph", "toro", "bag", "mcap", "db3"),
)


def metres(text: str) -> float:
    """Convert text to metres, from 0.1 to 50. Raise ArgumentTypeError for anything else."""
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not 0.1 <= value <= 50:
        raise argparse.ArgumentTypeError(
            f"expected metres, from 0.1 to 50, got {text!r}; give the width of the robot"
        )
    return value


def _laser_value(field: str, text: str) -> Any:
    """Convert numbers separated by commas to the value of a field of `LaserOptions`; check it."""
    from perception.readers.echoes import LaserOptions

    try:
        numbers = tuple(map(float, text.split(":" if field == "blind" else ",")))
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"expected numbers, got {text!r}; separate them by "
            f"{'a colon' if field == 'blind' else 'commas'}"
        ) from None
    value = numbers if field in ("mount", "blind") or len(numbers) != 1 else numbers[0]
    given: dict[str, Any] = {field: value}
    try:
        LaserOptions(**given)
    except AbductionError as error:
        raise argparse.ArgumentTypeError(str(error).partition(": ")[2]) from None
    return value


# How to read a log, and how wide the robot is.
READING = rows_of(
    "READING",
    {
        "--width": {"type": metres},
        **{
            name: {"type": partial(_laser_value, name)}
            for name in ("fov", "mount", "no_return", "nearest", "blind")
        },
    },
)

# The options that are fields of perception.readers.echoes.LaserOptions.
LASER = ("fov", "mount", "no_return", "zero_is", "nearest", "blind")


def read(path: str, options: argparse.Namespace) -> RobotLog:
    """Read the log at `path` as the options say. Raises AbductionError."""
    from perception.readers.logs import read_log

    return read_log(path, **reading_of(options))


def reading_of(options: argparse.Namespace) -> dict[str, Any]:
    """Collect the options that are arguments of `read_log`, by name."""
    return {name: getattr(options, name) for name in ("format", "scan_topic", "odom_topic", *LASER)}


@verb(READING=READING)
def run_import(options: argparse.Namespace) -> int:
    """Make a trace from a robot's log.

    Read a robot's log of laser scans and odometry, find the distinctive places that it passed, and
    write a trace with views, stars, displacements and actions. Corrected poses in the log become
    the truth, which only the command 'evaluate' uses.
    """
    check_output(options.output, "the trace")
    check_ending(options.output, ".jsonl")
    with stages("log", "track", "places", "trace", "views"):
        log, done = (_live if options.log == "-" else _whole)(options, lambda note: warn([note]))
    said = (
        f"{counted(len(log), 'scans')}, {done.track.way[-1]:.0f} m: "
        f"{counted(len(done.visits), 'visits')} to distinctive places; "
        f"{counted(len(done.trace), 'steps')}"
    )
    write_trace(done.trace, options.output, said)
    return 0


def _whole(options: argparse.Namespace, tell: Callable[[str], None]) -> tuple[RobotLog, Imported]:
    """Import the log in a file."""
    log = read(options.log, options)
    for warning in log.warnings:
        tell(warning)
    # Imported late, so that a log that cannot be read is refused at once.
    from perception.places.importing import import_log

    return log, import_log(log, options.width or WIDTH, named_after(options.log), tell)


def _live(options: argparse.Namespace, tell: Callable[[str], None]) -> tuple[RobotLog, Imported]:
    """Import the log on standard input as it arrives, and print each visit once it is final.

    Ctrl-C ends the log: the trace is that of the drive so far.
    """
    from perception.places.live import import_live
    from perception.readers.echoes import LaserOptions
    from perception.readers.logs import live_log

    if options.format not in (None, "carmen") or options.scan_topic or options.odom_topic:
        raise AbductionError(
            "-: expected lines of CARMEN on standard input, got another format or a topic; save "
            "the log to a file, and name that"
        )
    if sys.stdin is None:
        raise AbductionError("standard input: expected a log, got a closed stream; name a file")
    asked = LaserOptions(**{name: getattr(options, name) for name in LASER})
    items = live_log(sys.stdin.buffer, options=asked, tell=tell)
    numbers, output = count(), sys.stderr if options.output == "-" else sys.stdout

    def show(visit: Visit) -> None:
        x, y = visit.middle
        where = f"({x:.1f}, {y:.1f}) m with {counted(len(visit.ways), 'ways')}"
        scans = f"scans {visit.begin} to {visit.end}"
        print(f"visit {next(numbers)}, {scans}: a place at {where}", file=output, flush=True)

    with until_ctrl_c(items, StopFlag()) as some:
        log, done = import_live(some, options.width or WIDTH, None, tell, show, "-")
    if more := len(done.visits) - next(numbers):
        ways = f"{counted(more, 'more visits')} where stretches of it diverge"
        print(f"at the end of the drive: {ways}", file=output)
    for warning in log.warnings:
        tell(warning)
    return log, done


@contextmanager
def until_ctrl_c(items: Iterator[Item], stop: StopFlag) -> Iterator[Iterator[Item]]:
    """Yield an iterator over items that ends at Ctrl-C, which sets `stop`."""
    waits = False

    def end() -> None:
        is_first = not stop.is_set()
        stop.ask()
        if is_first and waits:  # else the item that came last is still in use
            raise KeyboardInterrupt

    def some() -> Iterator[Item]:
        nonlocal waits
        while not stop.is_set():
            try:
                waits = True
                item = next(items)
                waits = False
            except (StopIteration, KeyboardInterrupt):
                break
            yield item
        if stop.is_set():
            program.raised.append(program.heard[-1])  # for the exit code
            print("ssh-abduction: interrupted: the log ends here", file=sys.stderr)

    with on_ctrl_c(end):
        yield some()


def named_after(path: str) -> str:
    """Return the name of a log file without its endings, to name its trace and its run's folder."""
    name = Path(path).name
    if not name.strip("."):
        name = Path(path).resolve().name
    for endings in ENDINGS if not Path(path).is_dir() else ():
        stem, _, ending = name.rpartition(".")
        if ending.lower() in endings and stem.strip("."):
            name = stem
    return name if name.strip(".") else "log"


# RUN is written last: it marks a run as finished.
FILES = (TRACE, MAPS, "page.html", RUN)
OURS = (MAPS, RUN)  # the files whose content says that map wrote the folder
LONGEST = 255  # the most bytes of the name of a folder
DIGITS = 8  # of a log's digest, appended to its name if another log has the same name


class UnwrittenError(AbductionError):
    """The files of a run cannot be written."""


def write_run(folder: Path, files: Sequence[tuple[str, bytes]]) -> None:
    """Write the files of a run into its folder, and make the folder if it is missing.

    run.json is removed first and written last, so it never lies beside files of another run.
    Raises UnwrittenError, which names the file.
    """
    if not files:
        return
    given, file = dict(files), folder
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name in (RUN, *(name for name in FILES if name not in given)):
            (folder / name).unlink(missing_ok=True)
        for name in sorted(given, key=lambda name: name == RUN):
            file = folder / name
            write_file(file, given[name])
    except OSError as error:
        error.filename = str(file)  # the error may name the draft, or no file
        raise UnwrittenError(unwritten(error, file)) from None


def check_folder(folder: Path) -> None:
    """Raise AbductionError before long work if a folder cannot be made and written."""
    there = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    if not there.is_dir():
        raise AbductionError(
            f"{named(folder)}: expected a folder to write, got a file: {named(there)}; "
            "name another one"
        )
    try:
        with tempfile.TemporaryDirectory(dir=there):
            pass
    except OSError as error:
        raise AbductionError(
            f"{named(folder)}: expected a folder that can be written, got {error.strerror} in "
            f"{named(there)}; name another one"
        ) from None


def check_run_folder(folder: Path) -> None:
    """Raise AbductionError before long work if a folder cannot take the files of a run.

    A file of another program that has the name of such a file is kept.
    """
    check_folder(folder)
    there = [folder / name for name in FILES if os.path.lexists(folder / name)]
    is_ours = any(str(_record(folder / name).get("format")).startswith("ssh-") for name in OURS)
    wrong = [file for file in there if not file.is_file() or not is_ours]
    if wrong:
        raise AbductionError(
            f"{named(folder)}: expected a new folder, or one that map wrote, got "
            f"{wrong[0].name}, which is not of map; name another folder"
        )


def folders_of(logs: Sequence[str], folder: Path) -> tuple[dict[str, Path], dict[str, str]]:
    """Choose a folder for each log, and find logs with the same content.

    - A log that already has a run in `folder` keeps the folder of that run.
    - A single new log gets `folder` itself. Each of several logs gets a folder in it, named after
      the log.
    - If that folder holds the run of another log, or if two logs have the same name, a part of the
      log's digest is appended to the name.

    So the order of the logs does not matter.

    Returns:
        The folder of each log. And for each log that is left out, another log with the same
        content.
    """
    contents = {path: _content([path]) for path in dict.fromkeys(logs)}
    runs = _runs_in(folder)
    owners = {_key(place) for places in runs.values() for place in places}
    new = {
        (_key(folder / named_after(path)), content)
        for path, content in contents.items()
        if content and content not in runs
    }
    # A log that cannot be read, or only once, does not count: the other logs get the plain names.
    named_so = Counter(key for key, _ in new)
    found: dict[str, Path] = {}
    same: dict[str, str] = {}
    for path in sorted(contents, key=lambda path: (named_after(path), path)):
        content, plain = contents[path], folder / named_after(path)
        wished = folder if len(contents) == 1 else plain
        if content in runs:
            place = wished if wished in runs[content] else runs[content][0]
        else:
            digits = content or hashlib.sha256(os.fsencode(os.path.abspath(path))).hexdigest()
            is_plain = content and named_so[_key(plain)] == 1
            choices = [*([folder] if wished == folder else []), *([plain] if is_plain else [])]
            place = next(
                (one for one in choices if _key(one) not in owners),
                folder / f"{_cut(plain.name)}-{digits[:DIGITS]}",
            )
            if place != wished and content:
                is_taken = _key(wished) in owners
                why = "has the map of another log" if is_taken else "is the name of several logs"
                where = f"its folder is {named(place)}, as {named(wished)} {why}"
                warn([f"{named(path)}: {where}"])
        other = next((one for one, taken in found.items() if _key(taken) == _key(place)), None)
        if other is None:
            found[path] = place
        else:
            same[path] = other
    return {path: found[path] for path in contents if path in found}, same


def distinct(logs: Sequence[str]) -> tuple[list[str], list[tuple[str, str]]]:
    """Return the logs without copies; and pairs of each copy and the log with the same content."""
    first: dict[str, str] = {}  # by content; a log that cannot be read is like no other one
    owners = [(log, first.setdefault(_content([log]) or log, log)) for log in logs]
    copies = [pair for i, pair in enumerate(owners) if pair[0] != pair[1] or pair in owners[:i]]
    return [*first.values()], copies


def code_of_done(folder: Path, logs: Sequence[str], settings: dict[str, Any]) -> int | None:
    """The exit code of the finished run of these logs with the same `MapQuestion.settings`.

    None if the folder holds no such run.
    """
    run = _run_in(folder)
    content = run.get("digest")
    is_same = run.get("settings") == json.loads(json.dumps(settings)) and content is not None
    if not is_same or run.get("interrupted") or content != _content(logs):
        return None
    return next((n for of, n in EXIT_CODES.items() if of.value == run.get("status")), 0)


def logs_in(folder: Path) -> list[str]:
    """Return the logs of the map in a folder, in their order. Raises AbductionError without one."""
    run = _run_in(folder)
    sources = [drive.get("source") for drive in run.get("drives", ())] or [
        run.get("log", {}).get("source")
    ]
    if not all(isinstance(source, str) for source in sources):
        raise AbductionError(
            f"{named(folder)}: expected a folder with the map of a log, got none; map a log first"
        )
    return [*dict.fromkeys(sources)]


def digest(logs: Sequence[str]) -> str | None:
    """Compute the SHA-256 digest of the unpacked content of logs, as hexadecimal text.

    For a folder, it is the digest of the names and contents of its files. For several logs, it
    is the digest of the digests and the names of the drives. The result is None for a pipe, which
    can be read only once. Raises LogError.
    """
    if len(logs) == 1:
        return _digest_of(logs[0])
    digests = [_digest_of(path) for path in logs]
    lines = [f"{named_after(path)} {found}" for path, found in zip(logs, digests, strict=True)]
    return None if None in digests else hashlib.sha256("\n".join(lines).encode()).hexdigest()


def _digest_of(path: str) -> str | None:
    """Compute the digest of one log, as `digest` does. Raises LogError."""
    from perception.readers.lines import rereadable

    whole = hashlib.sha256()
    file = Path(path)
    if file.is_dir():
        for part in sorted(file.rglob("*")):
            whole.update(os.fsencode(f"{part.relative_to(file)}\0"))
            if part.is_file():
                with part.open("rb") as content:
                    whole.update(hashlib.file_digest(content, "sha256").digest())
    elif file.is_file() or not file.exists():
        with rereadable(path) as content:
            for block in iter(partial(content.read, 2**20), b""):
                whole.update(block)
    else:
        return None
    return whole.hexdigest()


def _runs_in(folder: Path) -> dict[str, list[Path]]:
    """Find the folders of runs in and below `folder`. Return them for each digest of a log."""
    found: dict[str, list[Path]] = {}
    with suppress(OSError):
        for place in (folder, *sorted(one for one in folder.iterdir() if one.is_dir())):
            content = _run_in(place).get("digest")
            if isinstance(content, str):
                found.setdefault(content, []).append(place)
    return found


def _run_in(folder: Path) -> dict[str, Any]:
    """Read run.json in a folder; an empty dict if it is missing or cannot be read."""
    return _record(folder / RUN)


def _record(file: Path) -> dict[str, Any]:
    """Read an object from a file of JSON; an empty dict if it is missing or cannot be read."""
    with suppress(OSError, ValueError, RecursionError):
        record = json.loads(file.read_text(encoding="utf-8"))
        return record if isinstance(record, dict) else {}
    return {}


def _content(logs: Sequence[str]) -> str | None:
    """Compute the digest of logs; None if a log cannot be read, or can be read only once."""
    with suppress(OSError, AbductionError):
        return digest(logs)
    return None


def _key(folder: Path) -> str:
    """Make a key that is equal for folders whose names some file systems do not distinguish."""
    return unicodedata.normalize("NFC", os.path.abspath(folder)).casefold()


def _cut(name: str) -> str:
    """Shorten a name, so that there is room to append a part of a digest."""
    room, encoded = LONGEST - DIGITS - 1, os.fsencode(name)
    return os.fsdecode(encoded[:room]) if len(encoded) > room else name
