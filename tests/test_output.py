"""Writing files: only regular files are replaced, and results come before pictures."""

from __future__ import annotations

import builtins
import json
import os
import re
import shlex
import stat
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from worlds import rectangle

from perception import store
from perception.recognition import recogniser
from ssh_abduction import SSHMap, Trace, solve
from ssh_abduction.cli import main
from ssh_abduction.data.errors import TraceError
from ssh_abduction.data.files import write_file

EXAMPLES = Path(__file__).parent.parent / "examples"
ACES = str(EXAMPLES / "aces3-route.jsonl")
TRACE = rectangle(8)
WRITERS: dict[str, Callable[[Path], object]] = {
    "trace": TRACE.save,
    "map": solve(TRACE).maps[0].save,
    "recogniser": lambda path: store.save(
        recogniser().fit(np.array([[1.0, 2.0], [2.0, 1.0]]), [0, 1]), path
    ),
}
READERS: dict[str, Callable[[Path], object]] = {
    "trace": Trace.load,
    "map": SSHMap.load,
    "recogniser": store.load,
}

each_writer = pytest.mark.parametrize("kind", WRITERS)


@each_writer
def test_writers_write_into_a_pipe(kind: str, tmp_path: Path) -> None:
    pipe, copy = tmp_path / "pipe", tmp_path / "copy"
    os.mkfifo(pipe)
    reader = threading.Thread(target=lambda: copy.write_bytes(pipe.read_bytes()))
    reader.start()
    WRITERS[kind](pipe)
    reader.join(10)
    assert stat.S_ISFIFO(pipe.stat().st_mode)
    READERS[kind](copy)


@each_writer
def test_writers_write_into_a_device(kind: str, tmp_path: Path) -> None:
    device = tmp_path / "null"
    try:
        os.mknod(device, stat.S_IFCHR | 0o600, os.makedev(1, 3))
        device.write_bytes(b"")
    except PermissionError:
        pytest.skip("only root may make a device, and not everywhere use it")
    WRITERS[kind](device)
    assert stat.S_ISCHR(device.stat().st_mode)
    assert [path.name for path in tmp_path.iterdir()] == ["null"]


@each_writer
@pytest.mark.parametrize("exists", [True, False])
def test_writers_follow_a_symbolic_link(kind: str, exists: bool, tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    target, second, link = tmp_path / "there" / "target", tmp_path / "second", tmp_path / "link"
    if exists:
        target.write_text("old")
    second.symlink_to(target)
    link.symlink_to("second")
    WRITERS[kind](link)
    assert link.is_symlink()
    assert second.is_symlink()
    assert not target.is_symlink()
    READERS[kind](target)


@each_writer
def test_written_file_is_replaced_whole_and_keeps_permissions(kind: str, tmp_path: Path) -> None:
    path, other = tmp_path / "out", tmp_path / "other"
    path.write_text("old")
    path.chmod(0o640)
    os.link(path, other)
    WRITERS[kind](path)
    READERS[kind](path)
    assert stat.S_IMODE(path.stat().st_mode) == 0o640
    assert other.read_text() == "old"
    assert len(list(tmp_path.iterdir())) == 2  # no draft is left behind


def test_failed_write_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    path = tmp_path / ("n" * 255)  # as long as a name can be
    write_file(path, b"old")
    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(OSError, match="No space left"):
        write_file(path, b"new")
    assert [other.read_bytes() for other in tmp_path.iterdir()] == [b"old"]


def test_closed_pipe_and_circular_link_are_errors(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a").symlink_to("b")
    (tmp_path / "b").symlink_to("a")
    for place in (tmp_path / "a", tmp_path, tmp_path / "none" / "x"):
        assert (
            main(["simulate", "notched-rectangle", "--route", "around,around", "-o", str(place)])
            == 1
        )
        err = capsys.readouterr().err
        assert err.startswith(f"ssh-abduction: {place}: cannot write the trace: ")
        assert err.count("\n") == 1


@pytest.mark.parametrize(
    "words", ["simulate notched-rectangle", "cluster x", "train x y", "cluster x -o y --plot"]
)
def test_empty_file_name_is_refused(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main([*words.split(), *([] if words.endswith("--plot") else ["-o"]), ""])
    assert (
        "expected the name of a file or folder, got ''" in capsys.readouterr().err
        or words.endswith("--plot")
    )


@pytest.mark.parametrize(
    "words",
    [
        "train x y -o=--",
        "cluster x -o y --set k_max=--",
        "show x --map=--",
        "solve x --set=rules=--",
        "check x y --set prefer=--",
    ],
)
def test_double_dash_as_a_value_is_refused(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(words.split())
    assert "expected a value, got '--'" in capsys.readouterr().err


def test_every_writing_verb_writes_into_a_pipe(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run.jsonl"
    assert main(f"simulate notched-rectangle --tours 2 --set stars=false -o {run}".split()) == 0
    views = tmp_path / "views.jsonl"
    assert main(["cluster", str(run), "--k", "4", "-o", str(views)]) == 0
    capsys.readouterr()
    assert main(["solve", str(views), "--theory", "causal", "--json"]) == 0
    maps = tmp_path / "maps.json"
    maps.write_text(capsys.readouterr().out)
    for words in (
        ["simulate", "notched-rectangle", "--route", "around,around", "-o"],
        ["cluster", str(run), "--k", "4", "-o"],
        ["train", str(maps), str(views), "-o"],
        ["cluster", str(run), "--k", "4", "-o", str(tmp_path / "again.jsonl"), "--plot"],
    ):
        pipe, got = tmp_path / ("pipe.png" if "--plot" in words else "pipe"), []
        os.mkfifo(pipe)
        reader = threading.Thread(target=lambda pipe=pipe, got=got: got.append(pipe.read_bytes()))
        reader.start()
        assert main([*words, str(pipe)]) == 0
        reader.join(10)
        assert stat.S_ISFIFO(pipe.stat().st_mode)
        assert len(got[0]) > 100
        pipe.unlink()
    capsys.readouterr()


@pytest.fixture
def imaged(tmp_path: Path) -> str:
    """The file of a small trace with images."""
    lines = [{"format": "ssh-trace", "version": 1}]
    lines += [
        {"view": "ab"[i % 2], "image": [1.0 + i % 2, 2.0 + i / 100], "action": "travel"}
        for i in range(8)
    ]
    del lines[-1]["action"]
    (tmp_path / "t.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return str(tmp_path / "t.jsonl")


def test_missing_matplotlib_is_an_error_before_the_work(
    tmp_path: Path, imaged: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    load = builtins.__import__

    def without(name: str, *rest: Any) -> Any:
        if name.startswith("matplotlib"):
            raise ImportError(name)
        return load(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    for name in [name for name in sys.modules if name.startswith("matplotlib")]:
        monkeypatch.setitem(sys.modules, name, None)
    never = tmp_path / "never"
    words = ["cluster", imaged, "--k", "2", "-o", str(never)]
    assert main([*words, "--plot", str(never / "x.png")]) == 1
    captured = capsys.readouterr()
    assert captured.out == ""
    assert (
        captured.err == "ssh-abduction: plot: expected the package matplotlib, got none; "
        "pip install '.[plot]' in your clone\n"
    )
    assert not never.exists()
    assert main(words) == 0


def test_failed_picture_loses_no_other_output(
    tmp_path: Path, imaged: str, capsys: pytest.CaptureFixture[str]
) -> None:
    clustered = tmp_path / "views.jsonl"
    plot = ["--plot", str(tmp_path / "none" / "x.png")]
    assert main(["cluster", imaged, "--k", "2", "-o", str(clustered), *plot]) == 1
    assert Trace.load(clustered)
    assert "chosen" in capsys.readouterr().out


@pytest.mark.skipif(sys.platform == "win32", reason="terminals")
def test_json_output_is_separate_from_progress_on_a_terminal(room: str, tmp_path: Path) -> None:
    import pty

    ours, theirs = pty.openpty()
    with (tmp_path / "maps.json").open("wb") as file:
        command = [sys.executable, "-m", "ssh_abduction", "solve", room, "--json"]
        done = subprocess.run(
            command, stdout=file, stderr=theirs, env={**os.environ, "TERM": "xterm"}, check=False
        )
    os.close(theirs)
    os.close(ours)
    assert done.returncode == 0
    assert len(json.loads((tmp_path / "maps.json").read_text())["maps"]) == 1


@pytest.mark.skipif(sys.platform == "win32", reason="terminals")
@pytest.mark.parametrize("traces", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_json_is_not_wrapped_on_a_narrow_terminal(traces: int, room: str) -> None:
    """All output goes to stdout. Rich redirects stdout while it shows progress."""
    import pty
    import termios

    ours, theirs = pty.openpty()
    attributes = termios.tcgetattr(theirs)
    attributes[1] &= ~termios.OPOST  # output is unchanged
    termios.tcsetattr(theirs, termios.TCSANOW, attributes)
    wrong, their_wrong = pty.openpty()
    command = [sys.executable, "-m", "ssh_abduction", "solve", *[room] * traces, "--json"]
    environment = {**os.environ, "TERM": "xterm", "COLUMNS": "30"}
    printed = {ours: b"", wrong: b""}

    def read(end: int) -> None:
        try:
            while chunk := os.read(end, 65536):
                printed[end] += chunk
        except OSError:  # the terminal is gone when the program is
            pass

    with subprocess.Popen(command, stdout=theirs, stderr=their_wrong, env=environment) as process:
        os.close(theirs)
        os.close(their_wrong)
        readers = [threading.Thread(target=read, args=(end,)) for end in printed]
        for reader in readers:
            reader.start()
        assert process.wait(60) == 0
        for reader in readers:
            reader.join(10)
    lines = printed[ours].decode().splitlines()
    if traces > 1:
        assert [json.loads(line)["count"] for line in lines] == [1, 1]
    else:
        assert len(json.loads("".join(lines))["maps"]) == 1
        assert len(lines) == 3


CTRL_C_AT = """
import os, signal, sys

class Interrupting:
    def find_spec(self, name, path=None, target=None):
        if name == {module!r}:
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Interrupting())
"""


SCRIPT = "-c import~sys;from~ssh_abduction.__main__~import~run;sys.exit(run())"


@pytest.mark.skipif(sys.platform == "win32", reason="signals")
@pytest.mark.parametrize(
    ("program", "module"),
    [
        *(
            ("-m ssh_abduction", module)
            for module in ("ssh_abduction.cli", "numpy.linalg", "sklearn.base")
        ),
        *((SCRIPT, module) for module in ("ssh_abduction.cli", "numpy")),
    ],
)
def test_ctrl_c_while_modules_load_prints_no_traceback(
    program: str, module: str, tmp_path: Path
) -> None:
    (tmp_path / "sitecustomize.py").write_text(CTRL_C_AT.format(module=module))
    path = os.pathsep.join([str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])])
    words = [word.replace("~", " ") for word in program.split(" ")]
    command = [sys.executable, *words, "simulate", "notched-rectangle", "--route", "around,around"]
    command += ["-o", str(tmp_path / "out")]
    if module.startswith("sklearn"):
        command[-6:] = ["recognise", str(tmp_path / "none"), ACES]
    done = subprocess.run(
        command, env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")


def test_terminal_control_characters_are_escaped(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    strange = "\x1b[31m\x9bred\u202e"
    trace, maps = tmp_path / f"{strange}.jsonl", tmp_path / "maps.json"
    go = {"name": f"go{strange}", "kind": "travel"}
    Trace.from_steps([f"a{strange}", "b", "a", "c"], [go] * 3).save(trace)
    assert "\x9b" not in trace.read_text()
    assert main(["solve", str(trace), "--json"]) == 0
    maps.write_text(capsys.readouterr().out)
    missing = tmp_path / f"none{strange}"
    for words in (
        *(
            ["solve", str(trace)],
            ["solve", str(trace), str(trace)],
            ["check", str(maps), str(trace)],
            ["check", str(maps), ACES],
        ),
        *(
            ["show", str(maps)],
            ["export", str(maps), "--to", "dot"],
            ["export", str(maps), "--to", "svg"],
            ["export", str(maps), "--to", "graphml"],
        ),
        *(
            ["solve", str(missing)],
            ["show", str(missing)],
            ["recognise", str(missing), ACES],
            ["simulate", f"{missing}.json", "-o", "x"],
        ),
        *(
            ["cluster", str(trace), "-o", str(missing)],
            ["simulate", "notched-rectangle", "--route", "around,around", "-o", str(missing)],
        ),
    ):
        main(words)
        captured = capsys.readouterr()
        for text in (captured.out, captured.err):
            assert not set(strange[0] + strange[5] + strange[-1]) & set(
                text.replace("\u202e", "") if words[0] in ("show", "export") else text
            ), words
    for words in (["solve", ACES, f"--{strange}"], [strange]):
        with pytest.raises(SystemExit):
            main(words)
        assert "\x1b" not in capsys.readouterr().err


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is full")
def test_full_standard_output_is_an_error(tmp_path: Path) -> None:
    Trace.from_steps("aba", ["travel"] * 2).save(tmp_path / "trace.jsonl")
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "ssh_abduction", "solve", str(tmp_path / "trace.jsonl")],
            stdout=full,
            stderr=subprocess.PIPE,
            check=False,
        )
    assert done.returncode == 1
    assert done.stderr.decode().endswith(
        "standard output: cannot be written: No space left on device; make room\n"
    )


@pytest.mark.skipif(sys.platform == "win32", reason="needs limits on the size of files")
def test_old_answer_stays_if_the_new_one_is_too_large(tmp_path: Path) -> None:
    """The answer is still printed, and no draft is left."""
    trace, answer = tmp_path / "trace.jsonl", tmp_path / "answer.json"
    Trace.from_steps(range(300), ["travel"] * 299).save(trace)
    answer.write_text("old", encoding="utf-8")
    solving = (
        f"{shlex.quote(sys.executable)} -m ssh_abduction solve {trace} --theory causal -o {answer}"
    )
    done = subprocess.run(
        ["bash", "-c", f"ulimit -f 4; exec {solving}"], capture_output=True, check=False
    )
    assert done.returncode == 1
    assert b"dstates" in done.stdout
    assert done.stderr.decode().endswith(
        f"{answer}: cannot write the solution: File too large; allow larger files (ulimit -f), or "
        "take another disk\n"
    )
    assert answer.read_text(encoding="utf-8") == "old"
    assert {path.name for path in tmp_path.iterdir()} == {"trace.jsonl", "answer.json"}


@pytest.mark.parametrize("words", ["solve -", "import - -o trace.jsonl", "check - -"])
def test_closed_standard_input_is_an_error(
    words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """tests/test_cli.py closes the standard input of a process."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "stdin", None)
    assert main(words.split()) == 1
    err = capsys.readouterr().err
    assert err.startswith("ssh-abduction: standard input: expected a ")
    assert err.endswith(" got a closed stream; name a file\n")
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize("name", ["", "a\0b"])
def test_save_refuses_a_name_that_is_not_a_file(name: str) -> None:
    with pytest.raises(TraceError, match=r"cannot write the trace: .*; name a file") as error:
        Trace.from_steps("aba", ["travel"] * 2).save(name)
    assert not str(error.value).startswith("output")


@pytest.mark.parametrize("target", ["nowhere/file", "file/under", "folder"])
def test_write_error_names_the_target_file(target: str, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "folder").mkdir()
    path = tmp_path / target
    with pytest.raises(OSError, match=re.escape(f"'{path}'") + "$"):
        write_file(path, b"x")


@pytest.mark.parametrize(
    ("target", "why"),
    [
        ("none/maps.json", "its folder is not there; make it first"),
        ("", "it is a folder; name a file in it"),
        ("sealed/maps.json", "its folder may not be written; name another one"),
    ],
)
def test_unwritable_file_is_an_error_before_the_work(
    target: str,
    why: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (tmp_path / "sealed").mkdir()
    sealed = tmp_path / "sealed"  # the mode of a folder does not stop root
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != sealed)
    trace, file = tmp_path / "a.jsonl", tmp_path / target
    Trace.from_steps("aba", ["travel"] * 2).save(trace)
    for verb, what in (("solve", "the solution"), ("import", "the trace")):
        assert main([verb, str(trace), "-o", str(file)]) == 1
        captured = capsys.readouterr()
        assert captured.out == ""
        assert captured.err == f"ssh-abduction: {file}: cannot write {what}: {why}\n"


@pytest.mark.parametrize(
    "words",
    [
        "solve {0} -o {0}",
        "solve {0} {1} --together -o {1}",
        "solve {0} {1} --together --set joint_trace={1}",
        "export {2} --to dot -o {2}",
        "import {0} -o {0}",
    ],
)
def test_verb_does_not_write_over_a_file_that_it_reads(
    words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = [str(tmp_path / name) for name in ("a.jsonl", "b.jsonl", "maps.json")]
    for name in files[:2]:
        Trace.from_steps("ab", ["travel"], name=name).save(name)
    solve(Trace.load(files[0])).save(files[2])
    before = [Path(file).read_bytes() for file in files]
    assert main(words.format(*files).split()) == 1
    assert "expected another file to write than the one to read" in capsys.readouterr().err
    assert [Path(file).read_bytes() for file in files] == before
    assert main(["solve", files[0], "--theory", files[2], "-o", files[2]]) == 0
