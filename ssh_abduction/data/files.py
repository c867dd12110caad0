"""Parse JSON that may be malformed, write files atomically, and read files of the package."""

from __future__ import annotations

import errno
import json
import math
import os
import re
import stat
import sys
import threading
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from functools import cache
from itertools import count
from pathlib import Path
from string import Template
from typing import Any, BinaryIO

from ssh_abduction.data.errors import AbductionError, brief, named

# Levels of nested objects and lists. Python's own functions fail at thousands of levels.
DEEPEST = 100
# Digits of a whole number. A much longer one is no floating-point number.
LONGEST_NUMBER = 100
# How a line of a log of CARMEN, g2o or TORO begins.
LINE_OF_A_LOG = re.compile(
    rb"^[ \t]*(FLASER|RLASER|ROBOTLASER\d|RAWLASER\d|ODOM|PARAM|SYNC|TRUEPOS|NEFF"
    rb"|VERTEX2|VERTEX_SE2|EDGE2|EDGE_SE2)\s",
    re.MULTILINE,
)
_BINARY = "save it as UTF-8, or is this a binary file?"
_LONG_NUMBER = re.compile(rf"\d{{{LONGEST_NUMBER + 1}}}")
_SURROGATE = re.compile(r"\\u[dD][89a-fA-F]|[\ud800-\udfff]")
# Control characters that JSON need not escape, and that steer a terminal.
_UNSEEN = re.compile("[\x7f-\x9f\u2028\u2029]")
# What to do if a file cannot be written, by the number of the error.
_MENDS = {
    errno.ENOENT: "make the folder first",
    **dict.fromkeys((errno.EACCES, errno.EPERM, errno.EROFS), "take a place that you may write to"),
    **dict.fromkeys((errno.ENOSPC, errno.EDQUOT), "make room"),
    errno.EFBIG: "allow larger files (ulimit -f), or take another disk",
    errno.ENAMETOOLONG: "take a shorter name",
    **dict.fromkeys((errno.EEXIST, errno.EISDIR, errno.ENOTDIR), "take another name"),
}


class BadJson(ValueError):  # noqa: N818 - part of an error message, which the caller completes
    """A text is not JSON as `parse_json` accepts it. The text of this error says what was found.

    Attributes:
        expected: What the text should be, or the value of the field.
        mend: What to do; "" if only the caller knows.
        field: The path of the wrong value, such as "a.b[2]"; "" if it is unknown.
        line: The number of the wrong line; None if it is unknown.
    """

    def __init__(
        self,
        found: str,
        mend: str = "",
        expected: str = "JSON",
        field: str = "",
        line: int | None = None,
    ) -> None:
        super().__init__(found)
        self.expected, self.mend, self.field, self.line = expected, mend, field, line


def parse_json(data: bytes) -> Any:
    """Parse JSON in UTF-8, more strictly than Python's `json` does.

    An object may not have two fields with the same name. Numbers must be finite and have at most
    LONGEST_NUMBER digits. It must be possible to write all texts again. Objects and lists may be
    nested at most DEEPEST times.

    Raises:
        BadJson: If the JSON is broken, or holds something that is not allowed.
    """
    not_finite: list[str] = []

    def constant(name: str) -> float:
        not_finite.append(name)
        return math.nan

    try:
        text = data.decode("utf-8")
        numbers = {"parse_int": _integer} if _LONG_NUMBER.search(text) else {}
        value = json.loads(text, object_pairs_hook=_object, parse_constant=constant, **numbers)  # type: ignore[arg-type]
        if text.count("[") + text.count("{") > DEEPEST and _depth(value) > DEEPEST:
            raise RecursionError
    except UnicodeDecodeError as error:
        byte = f"the byte 0x{data[error.start]:02x} at column {error.start + 1}"
        raise BadJson(byte, _BINARY, "text in UTF-8") from None
    except json.JSONDecodeError as error:
        found = f"broken JSON at column {error.colno} ({error.msg})"
        raise BadJson(found, _BINARY if b"\0" in data else "", line=error.lineno) from None
    except RecursionError:
        raise BadJson("one nested too deeply", "flatten it") from None
    if not_finite:
        mend = "replace it, or leave the field out"
        raise BadJson(not_finite[0], mend, "a finite number", _where_nan(value))
    if _SURROGATE.search(text):
        try:
            json.dumps(value, ensure_ascii=False).encode("utf-8")
        except UnicodeEncodeError as error:
            half = f"half a character, \\u{ord(error.object[error.start]):04x}"
            raise BadJson(half, "replace it", "text") from None
    return value


def json_line(value: Any) -> str:
    """Return a value as JSON on one line, with the control characters escaped.

    Raises TypeError or ValueError if JSON cannot hold the value.
    """
    return _UNSEEN.sub(
        lambda found: f"\\u{ord(found[0]):04x}",
        json.dumps(value, ensure_ascii=False, allow_nan=False),
    )


@cache
def shipped(name: str) -> Path:
    """Return the path of a folder that ships with the package.

    It is inside of the package or, in a checkout, beside it.
    """
    package = Path(__file__).resolve().parent.parent
    packaged = package / name
    return packaged if packaged.is_dir() else package.parent / name


def filled(template: Path, **values: str) -> str:
    """Return the text of a template of the package, with a value in the place of each $name."""
    return Template(template.read_text(encoding="utf-8")).substitute(values)


def read_at_most(path: str | os.PathLike[str], most: int) -> bytes:
    """Return the bytes of a file, which may be a device that never ends.

    Raises OSError if it cannot be read, and ValueError if it has more than `most` bytes.
    """
    with Path(path).open("rb") as file:
        data = file.read(most + 1)
    if len(data) > most:
        raise ValueError(f"expected at most {most // 2**20} MiB, got more")
    return data


def source_of(path: str) -> str:
    """Return the name of a file for messages; "-" is standard input."""
    return "standard input" if path == "-" else named(path)


@contextmanager
def opened_file(path: str, what: str, error: type[AbductionError]) -> Iterator[BinaryIO]:
    """Open a file to read its bytes; "-" is standard input.

    If it cannot be opened, or read in the block, raise `error`, which names `what`.
    """
    try:
        if path == "-" and sys.stdin is None:
            raise error(f"{source_of(path)}: expected {what}, got a closed stream; name a file")
        with nullcontext(sys.stdin.buffer) if path == "-" else Path(path).open("rb") as file:
            yield file
    except AbductionError:
        raise
    except (OSError, ValueError) as found:
        why = getattr(found, "strerror", None) or found
        raise error(f"{source_of(path)}: expected {what}: {why}; {_mend(path)}") from None


def read_file(
    path: str | os.PathLike[str], most: int, what: str, error: type[AbductionError]
) -> bytes:
    """Read a file as `read_at_most`. If it cannot be read, raise `error`, which names `what`."""
    try:
        return read_at_most(path, most)
    except (OSError, ValueError) as found:
        why = getattr(found, "strerror", None) or found
        raise error(f"{named(path)}: expected {what}: {why}; {_mend(path)}") from None


def _mend(path: str | os.PathLike[str]) -> str:
    """Say what to do if a file cannot be read: perhaps its folder is not one that map wrote."""
    folder, name = Path(path).parent, Path(path).name
    if name in ("maps.json", "trace.jsonl", "run.json") and folder.is_dir():
        inner = [f"; did you mean {named(p.parent)}?" for p in sorted(folder.glob(f"*/{name}"))]
        return f"name a folder that the command map wrote, or a file{''.join(inner[:1])}"
    return "check the path"


def parse_yaml(data: str | bytes) -> Any:
    """Parse YAML in which each scalar is a text: a step such as 1:30 is no number of seconds.

    Raises ValueError if the YAML is broken, nested too deeply, or has a field twice.
    """
    import yaml  # loads slowly

    try:
        _check_keys(yaml.compose(data, Loader=yaml.BaseLoader))
        return yaml.load(data, Loader=yaml.BaseLoader)
    except yaml.YAMLError as error:
        raise ValueError(" ".join(str(error).split())) from None
    except RecursionError:
        raise ValueError("one nested too deeply; flatten it") from None


def write_file(path: str | os.PathLike[str], data: bytes) -> None:
    """Write a file so that it appears whole or not at all.

    A regular file is replaced and keeps its permissions. If the path is a symbolic link, its
    target is written. If it is a device or a pipe, the bytes are written to it. Raises an
    OSError that names this file, or ValueError if the text is not a path.
    """
    if not os.fspath(path):
        raise ValueError("expected the name of a file, got an empty text")
    try:
        mode: int | None = os.stat(path).st_mode
    except FileNotFoundError:
        mode = None
    target = Path(os.path.realpath(path))
    if mode is not None and not (stat.S_ISREG(mode) and target.exists() and target.samefile(path)):
        try:
            Path(path).write_bytes(data)
        except OSError as error:
            raise OSError(error.errno, error.strerror, os.fspath(path)) from None
        return
    # A short name, as the target's name may be as long as names can be.
    draft = target.with_name(f".{os.getpid()}-{threading.get_ident():x}.part")
    try:
        draft.write_bytes(data)
        if mode is not None:
            draft.chmod(stat.S_IMODE(mode))
        draft.replace(target)
    except OSError as error:
        raise OSError(error.errno, error.strerror, os.fspath(path)) from None
    finally:
        with suppress(OSError):  # if the folder does not exist, or is a file
            draft.unlink(missing_ok=True)


def retire(folder: Path | None) -> None:
    """Move the files of a folder into a new folder `before-N` in it. Raises OSError."""
    if folder and (files := [file for file in folder.glob("*") if file.is_file()]):
        aside = next(p for n in count(1) if not (p := folder / f"before-{n}").exists())
        aside.mkdir()
        for file in files:
            file.rename(aside / file.name)


def mend_of(error: OSError) -> str:
    """Say what to do if a file cannot be written."""
    return _MENDS.get(error.errno or 0, "check the path")


def save_file(
    path: str | os.PathLike[str], data: bytes, what: str, error: type[AbductionError]
) -> None:
    """Write a file as `write_file`. If it cannot be written, raise `error`, which names `what`."""
    try:
        write_file(path, data)
    except OSError as found:
        why = f"{found.strerror or found}; {mend_of(found)}"
        raise error(f"{named(path)}: cannot write the {what}: {why}") from None
    except ValueError as found:
        where = brief(str(path))
        raise error(f"{where}: cannot write the {what}: {found}; name a file") from None


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Make a JSON object from pairs. Raise BadJson if a field is given twice."""
    fields = dict(pairs)
    if len(fields) < len(pairs):
        (twice, _), *_ = Counter(name for name, _ in pairs).most_common(1)
        raise BadJson(f"the field {twice[:60]!r} twice", "keep one of them")
    return fields


def _check_keys(node: Any) -> None:
    """Raise ValueError if an object has a field twice. YAML would keep only the last one."""
    if isinstance(getattr(node, "value", None), list):
        for child in node.value:
            pair = child if isinstance(child, tuple) else (child,)
            for part in pair:
                _check_keys(part)
        keys = [child[0].value for child in node.value if isinstance(child, tuple)]
        for child in node.value:
            if isinstance(child, tuple) and keys.count(child[0].value) > 1:
                raise ValueError(
                    f"{brief(child[0].value)} twice, first in line {child[0].start_mark.line + 1}"
                )


def _integer(text: str) -> int:
    """Make an int from the digits in JSON. Raise BadJson if it is too long."""
    if len(text) > LONGEST_NUMBER:
        raise BadJson(f"a number of more than {LONGEST_NUMBER} digits", "shorten it")
    return int(text)


def _depth(value: Any) -> int:
    """Count how deep objects and lists are nested. May raise RecursionError."""
    inside = value.values() if isinstance(value, dict) else value
    return 1 + max(map(_depth, inside), default=0) if isinstance(value, dict | list) else 0


def _where_nan(value: Any, path: str = "") -> str:
    """Return the path of the first NaN in a value, such as "a.b[2]"; "" if there is none."""
    is_list = isinstance(value, list)
    inside: Iterable[tuple[Any, Any]] = (
        enumerate(value) if is_list else value.items() if isinstance(value, dict) else ()
    )
    for key, item in inside:
        here = f"{path}[{key}]" if is_list else f"{path}.{key}" if path else str(key)
        if isinstance(item, float) and math.isnan(item):
            return here
        if isinstance(item, dict | list) and (deeper := _where_nan(item, here)):
            return deeper
    return ""
