"""1,000 damaged files of every kind, read by every verb that takes them, end as documented and
without a traceback.

Each is a small valid file with a few changes: bytes, numbers, texts, types, branches of JSON,
members of archives. The result is a proper answer, or one line on stderr without control
characters. The files are the same in every run.
"""

from __future__ import annotations

import contextlib
import io
import json
import random
import re
import shutil
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from worlds import SQUARE, drive

from ssh_abduction.cli import main

FILES = 150
BATCHES = 5  # tests, so that several processes can share the work
CODES = {0, 1, 2, 10, 20, 30}
CONTROL = re.compile("[\x00-\x09\x0b-\x1f\x7f-\x9f]")
# Verbs that print no program text.
ANSWER = {
    "solve",
    "check",
    "show",
    "theory",
    "cluster",
    "train",
    "evaluate",
    "recognise",
    "simulate",
    "localise",
}

WORLD = {
    "format": "ssh-world",
    "version": 1,
    "name": "room",
    "polygons": [[[0, 0], [4, 0], [4, 2], [0, 2]]],
    "segments": [[2, 0, 2, 0.3]],
    "clutter": [{"polygon": [[1, 1], [1.1, 1], [1.1, 1.1]], "moves": [0.2, 0], "present": 0.5}],
    "start": [3.4, 1.4, 0],
    "reach": 0.6,
    "route": ["right"],
    "dstates": [
        {"name": "x0", "place": "A", "path": "north", "direction": 1, "pose": [3.4, 1.4, 0]}
    ],
}
YAML = (
    "image: map.pgm\nresolution: 0.5\norigin: [-0.5, -0.5, 0.0]\noccupied_thresh: 0.65\nnegate: 0\n"
)

# The commands that read each kind of file. FILE is the damaged file. The others are intact.
COMMANDS: dict[str, list[str]] = {
    "trace.jsonl": [
        "solve FILE --time-limit 0.3 --memory-limit 4000",
        "solve FILE --time-limit 0.3 --json --theory causal",
        "solve FILE trace.jsonl --time-limit 0.3",
        "facts FILE",
        "check FILE maps.json",
        "check FILE maps.json --bound",
        "localise maps.json FILE",
    ],
    "imaged.jsonl": [
        "cluster FILE -o out --k 2",
        "evaluate imaged-maps.json FILE",
        "train FILE imaged-maps.json -o out",
        "recognise recogniser.skops FILE",
        "localise imaged-maps.json FILE --recogniser recogniser.skops",
    ],
    "indexed.jsonl": ["recognise recogniser.skops FILE", "cluster FILE -o - --k 2"],
    "images.npz": [
        "recognise recogniser.skops indexed.jsonl",
        "cluster indexed.jsonl -o out --k 2",
    ],
    "images.npy": [
        "recognise recogniser.skops npy.jsonl",
        "train imaged-maps.json npy.jsonl -o out",
    ],
    "maps.json": [
        "show FILE",
        "show FILE --map 1",
        "export FILE --to dot",
        "show FILE --svg",
        "export FILE --to graphml",
    ]
    + 2
    * [
        "check FILE trace.jsonl",
        "check FILE trace.jsonl --bound",
        "localise FILE trace.jsonl --trace trace.jsonl --json",
    ],
    "imaged-maps.json": [
        "train imaged.jsonl FILE -o out",
        "evaluate FILE imaged.jsonl --json",
        "train imaged.jsonl FILE -o out --map 1",
    ],
    "world.json": ["simulate FILE -o out --set stars=false"],
    "map.yaml": [
        "simulate FILE -o out --set start=1.5,1.5,0 --route right --set reach=0.6 --set stars=false"
    ],
    "map.pgm": [
        "simulate map.yaml -o out --set start=1.5,1.5,0 --route right --set reach=0.6 --set "
        "stars=false"
    ],
    "recogniser.skops": 2
    * [
        "recognise FILE imaged.jsonl",
        "recognise FILE imaged.jsonl --json",
        "localise imaged-maps.json imaged.jsonl --recogniser FILE --json",
    ],
}

TOKENS = [
    *(
        "NaN",
        "-Infinity",
        "1e999",
        "-1",
        "0",
        "1e308",
        "2147483648",
        "1" + "0" * 400,
        "9" * 5000,
        "null",
        "true",
        "{}",
        "[]",
        '""',
        "[[[]]]",
    ),
    *(
        '"\\ud800"',
        '"\\u0000"',
        '"\\u001b[31mred"',
        '"\\u009b2J\\u2028"',
        '"a\\nb\\rc"',
        "[" * 3000,
        '{"a":' * 3000,
        "\0",
        "\ufeff",
        "\u202e",
    ),
]
BYTES = [
    *(token.encode() for token in TOKENS),
    b"\xff\xfe",
    b"\xc3\x28",
    b"\xed\xa0\x80",
    b"\n",
    b"\n\n",
    b"\r",
    b",",
    b"}",
    b"]",
    b":",
    b"#",
]
VALUES: list[Any] = [
    *(
        None,
        True,
        False,
        0,
        -1,
        1,
        2,
        3,
        7,
        1.5,
        10**9,
        10**30,
        10**400,
        -(10**400),
        1e300,
        -1e-300,
        "",
        "a",
        "\0",
        "\x1b[2J",
        "\x9b31m",
        "\ud800",
    ),
    *(
        "9" * 500,
        "á\u2028b",
        "right",
        "travel",
        "frame",
        "causal",
        [],
        [None],
        [[]],
        [1, 2],
        ["a"],
        {},
        {"a": 1},
        [0] * 50,
        float("nan"),
        float("inf"),
    ),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a sound file of each kind."""
    folder = tmp_path_factory.mktemp("sound")
    drive(SQUARE, "a", "E", "TRTRTRTR", stars=True).save(folder / "trace.jsonl")
    views = "abababab"
    rows = np.array(
        [[1.0, 2.0, 3.0 + (view == "b"), 4.0 + 0.01 * i] for i, view in enumerate(views)]
    )
    for name, images in (("imaged", None), ("indexed", "images.npz"), ("npy", "images.npy")):
        header = {"format": "ssh-trace", "version": 1, "name": name} | (
            {"images": images} if images else {}
        )
        steps = [
            {
                "view": view,
                "image": i if images else rows[i].tolist(),
                "action": "travel",
                "truth": {"dstate": view},
            }
            for i, view in enumerate(views)
        ]
        del steps[-1]["action"]
        (folder / f"{name}.jsonl").write_text(
            "".join(json.dumps(line) + "\n" for line in [header, *steps])
        )
    np.savez_compressed(folder / "images.npz", images=rows)
    np.save(folder / "images.npy", rows)
    (folder / "world.json").write_text(json.dumps(WORLD))
    (folder / "map.yaml").write_text(YAML)
    pixels = np.pad(np.full((6, 8), 254, np.uint8), 1)
    (folder / "map.pgm").write_bytes(
        b"P5\n# made for a test\n%d %d\n255\n" % pixels.shape[::-1] + pixels.tobytes()
    )
    with contextlib.chdir(folder):
        for trace, maps, choice in (
            ("trace", "maps", ""),
            ("imaged", "imaged-maps", "--theory causal"),
        ):
            code, out, _ = run(f"solve {trace}.jsonl --json {choice}")
            assert code == 0
            Path(f"{maps}.json").write_text(out)
        assert run("train imaged-maps.json imaged.jsonl -o recogniser.skops")[0] == 0
    return folder


def run(command: str) -> tuple[int, str, str]:
    """The exit code of a command, and what it printed on stdout and stderr."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = main(command.split())
        except SystemExit as stop:  # wrong usage
            code = int(stop.code or 0)
    return code, out.getvalue(), err.getvalue()


def damaged(data: bytes, kind: str, rng: random.Random) -> bytes:
    """A file of this kind with something changed."""
    if zipfile.is_zipfile(io.BytesIO(data)) and rng.random() < 0.8:
        return _archive(data, rng)
    if kind.endswith(("json", "jsonl")) and rng.random() < 0.6:
        lines = data.decode().splitlines() if kind.endswith("jsonl") else [data.decode()]
        for _ in range(rng.choice((1, 1, 2))):
            i = rng.randrange(len(lines))
            with contextlib.suppress(
                ValueError, RecursionError
            ):  # the first damage broke it already
                lines[i] = _json(json.loads(lines[i]), rng)
        return "\n".join(lines).encode("utf-8", "surrogatepass")
    for _ in range(rng.choice((1, 1, 2, 5))):
        data = rng.choice(CHANGES)(data, rng)
    return data


def _json(value: Any, rng: random.Random) -> str:
    """A JSON value with one of its parts replaced, dropped, doubled, or under another name."""
    spots = list(_spots(value))
    if not spots:
        return rng.choice(TOKENS)
    inside, key = rng.choice(spots)
    change = rng.randrange(7)
    if change > 4 and isinstance(inside[key], int | float):
        inside[key] = rng.choice(
            (inside[key] + 1, inside[key] - 1, -inside[key], 1000 * inside[key], inside[key] / 7)
        )
    elif change == 0:
        del inside[key]
    elif change == 1 and isinstance(inside, list):
        inside.insert(key, inside[key])
    elif change == 2 and isinstance(inside, dict):
        inside[rng.choice(("x", "\x1b", *inside))] = inside.pop(key)
    elif change == 3:
        inside[key] = rng.choice(rng.choice(spots)[0:1] if rng.random() < 0.1 else VALUES)
    else:
        other, there = rng.choice(spots)
        inside[key] = other[there]
    try:
        return json.dumps(value)
    except ValueError:  # a value within itself, or a number without end
        return rng.choice(TOKENS)


def _spots(value: Any) -> Iterator[tuple[Any, Any]]:
    """Each list or object of a JSON value, with each of its indices or keys."""
    for key, item in list(
        value.items()
        if isinstance(value, dict)
        else enumerate(value)
        if isinstance(value, list)
        else ()
    ):
        yield value, key
        yield from _spots(item)


def _archive(data: bytes, rng: random.Random) -> bytes:
    """An archive with one damaged member."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = rng.choice(list(members))
    members[name] = damaged(members[name], name, rng)
    if rng.random() < 0.1:
        members[rng.choice(("x.npy", "../up", "schema.json"))] = members.pop(name)
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w") as archive:
        for member, content in members.items():
            archive.writestr(member, content)
    return made.getvalue()


def _flip(data: bytes, rng: random.Random) -> bytes:
    i = rng.randrange(len(data) + 1)
    return data[:i] + bytes([rng.randrange(256)]) + data[i + 1 :]


def _cut(data: bytes, rng: random.Random) -> bytes:
    return data[: rng.randrange(len(data) + 1)]


def _drop(data: bytes, rng: random.Random) -> bytes:
    i, j = sorted(rng.randrange(len(data) + 1) for _ in range(2))
    return data[:i] + data[j:]


def _double(data: bytes, rng: random.Random) -> bytes:
    i, j = sorted(rng.randrange(len(data) + 1) for _ in range(2))
    return data[:j] + data[i:]


def _insert(data: bytes, rng: random.Random) -> bytes:
    i = rng.randrange(len(data) + 1)
    return data[:i] + rng.choice(BYTES) + data[i:]


def _renumber(data: bytes, rng: random.Random) -> bytes:
    """Another number or text in place of one."""
    found = list(re.finditer(rb'-?[\d.]+|"[^"]*"|\w+', data))
    if not found:
        return rng.choice(BYTES)
    spot = rng.choice(found)
    return data[: spot.start()] + rng.choice(BYTES) + data[spot.end() :]


CHANGES: list[Callable[[bytes, random.Random], bytes]] = [
    _flip,
    _cut,
    _drop,
    _double,
    _insert,
    _renumber,
    _renumber,
]


def cases(batch: int) -> Iterator[tuple[str, str, random.Random]]:
    """The kind of file, the command, and the chance of each damage."""
    for number in range(batch, FILES, BATCHES):
        rng = random.Random(number)
        kind = list(COMMANDS)[number // BATCHES % len(COMMANDS)]
        yield kind, rng.choice(COMMANDS[kind]), rng


@pytest.mark.filterwarnings("ignore")  # the command line prints warnings
@pytest.mark.parametrize("batch", range(BATCHES))
def test_damaged_files_end_with_documented_errors(
    batch: int, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    for kind, command, rng in cases(batch):
        sound = (folder / kind).read_bytes()
        Path(kind).write_bytes(damaged(sound, kind, rng))
        try:
            outcome = run(command.replace("FILE", kind))
        except BaseException as error:
            error.add_note(f"{command} of {kind} {rng}")
            raise
        finally:
            Path(kind).write_bytes(sound)
        assert problem(command, *outcome) is None, (command, kind, outcome)


def problem(command: str, code: int, out: str, err: str) -> str | None:
    """Describe what is wrong with the end of a command; None if nothing is wrong."""
    lines = [line for line in err.splitlines() if not line.startswith("ssh-abduction: warning: ")]
    if code not in CODES:
        return "the exit code is not documented"
    if code == 1 and (len(lines) != 1 or not lines[0].startswith("ssh-abduction: ")):
        return "an error is not one line"
    if CONTROL.search(err) or (command.split(maxsplit=1)[0] in ANSWER and CONTROL.search(out)):
        return "control characters are printed"
    return None
