"""Manage the folders of mapped logs: which folder belongs to a log, and which logs are done.

A run is done if its folder has a run.json that does not say that the run was interrupted.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
import unicodedata
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from ssh_abduction.cli.import_log import named_after
from ssh_abduction.cli.options import MAPS, RUN, TRACE
from ssh_abduction.cli.outcome import warn
from ssh_abduction.data.errors import AbductionError, named
from ssh_abduction.data.files import write_file

# RUN is written last: it marks a run as finished.
FILES = (TRACE, MAPS, "page.html", "report.html", RUN)
LONGEST = 255  # the most bytes of the name of a folder
DIGITS = 8  # of a log's digest, appended to its name if another log has the same name


def write_run(folder: Path, files: Sequence[tuple[str, bytes]]) -> None:
    """Write the files of a run into its folder, and make the folder if it is missing.

    run.json is removed first and written last, so it never lies beside files of another run.
    Raises an OSError that names the file.
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
            error.filename = str(folder / name)  # the error may name the draft, or no file
            raise


def written_elsewhere(files: Sequence[tuple[str, bytes]]) -> str:
    """Write the files of a run into a temporary folder, as its own has no room. Say in words where.

    Returns "" if they cannot be written there, either.
    """
    with suppress(OSError):
        spare = tempfile.mkdtemp(prefix="ssh-abduction-")
        try:
            write_run(Path(spare), files)
        except OSError:
            shutil.rmtree(spare, ignore_errors=True)
        else:
            return f"; until then the files of this run are in {named(spare)}"
    return ""


def check_folder(folder: Path) -> None:
    """Raise AbductionError before long work if a folder cannot be made and written."""
    there = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    if not there.is_dir():
        raise AbductionError(
            f"{named(folder)}: expected a folder to write, got a file: {named(there)}; "
            "name another one"
        )
    if not os.access(there, os.W_OK):
        raise AbductionError(
            f"{named(folder)}: expected a folder that can be written, got no permission in "
            f"{named(there)}; name another one"
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
            places = runs[content]
            place = wished if wished in places else places[0]
        else:
            digits = content or hashlib.sha256(os.fsencode(os.path.abspath(path))).hexdigest()
            choices = [
                *([folder] if wished == folder else []),
                *([plain] if content and named_so[_key(plain)] == 1 else []),
                folder / f"{_cut(plain.name)}-{digits[:DIGITS]}",
            ]
            place = next((one for one in choices if _key(one) not in owners), folder / digits)
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


def is_done(folder: Path, logs: Sequence[str], settings: dict[str, Any]) -> bool:
    """Whether a folder holds a finished run of these logs with the same `MapQuestion.settings`."""
    run = _run_in(folder)
    content = run.get("digest")
    is_same = run.get("settings") == json.loads(json.dumps(settings)) and content is not None
    return is_same and not run.get("interrupted") and bool(content == _content(logs))


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
    with suppress(OSError, ValueError, RecursionError):
        run = json.loads((folder / RUN).read_text(encoding="utf-8"))
        return run if isinstance(run, dict) else {}
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
