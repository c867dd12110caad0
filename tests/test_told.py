"""Messages of commands beside their answers: the log, -q and -v, progress, suggestions for wrong
names, completions."""

from __future__ import annotations

import io
import json
import logging
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from worlds import TOURS, drive, rectangle

import simulator
from ssh_abduction import Theory, Trace, solve
from ssh_abduction.cli import main, outcome, parser
from ssh_abduction.cli.about import run_completion
from ssh_abduction.cli.simulate import run_simulate
from ssh_abduction.data import Odometry
from ssh_abduction.runtime.loggers import PROGRESS, begin_stage, log_progress, stages

ACES = str(Path(__file__).parent.parent / "examples" / "aces3-route.jsonl")
VERBS = sorted(parser().verbs)
MESSAGE = re.compile(r"ssh-abduction: \d+\.\d\d s: [\w.]+: .+")


def lines(capsys: pytest.CaptureFixture[str], *words: str, code: int = 0) -> tuple[str, list[str]]:
    """The output of a command, and its lines on stderr."""
    assert main(words) == code
    captured = capsys.readouterr()
    return re.sub(r"\d+\.\d\d s", "_ s", captured.out), captured.err.splitlines()


@pytest.fixture
def tee(tmp_path: Path) -> str:
    """A short drive through a tee, with stars."""
    drive(*TOURS["tee"], stars=True).save(tmp_path / "tee.jsonl")
    return str(tmp_path / "tee.jsonl")


@pytest.fixture
def tiny(tmp_path: Path) -> str:
    """A drive whose travels are as small as the noise of the odometry, which is a warning."""
    moved = [(0.001, 0.0, 0.0), (0.0, 0.0, 1.6)] * 4
    trace = Trace.from_steps("abababab" + "a", ["travel", "left"] * 4, displacements=moved)
    replace(trace, odometry=Odometry(position=0.1)).save(tmp_path / "tiny.jsonl")
    return str(tmp_path / "tiny.jsonl")


def test_library_prints_nothing_by_default(capfd: pytest.CaptureFixture[str]) -> None:
    assert any(
        isinstance(handler, logging.NullHandler)
        for handler in logging.getLogger("ssh_abduction").handlers
    )
    solve(drive(*TOURS["comb"]))
    assert capfd.readouterr() == ("", "")


def test_log_names_found_maps_and_proofs(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.DEBUG, "ssh_abduction"):
        solution = solve(Trace.load(ACES))
    told = [record.getMessage() for record in caplog.records]
    assert {record.name.partition(".")[0] for record in caplog.records} == {"ssh_abduction"}
    assert told[0].startswith(
        "search of <Trace 'ACES3 route': 23 steps, 6 views, 4 actions; stars> under Theory("
    )
    assert told[0].endswith(", with StepEngine")
    assert "minimal maps cost 19 dstates, 10 places, 4 paths; they are listed" in told
    assert "StepEngine is given 23 of 23 steps" in told
    assert re.fullmatch(r"ended after \d+\.\d\d s: optimal, 4 maps", told[-1])
    bounds = [int(found[1]) for text in told if (found := re.search(r"dstates ≥ (\d+)", text))]
    assert bounds == sorted(bounds)
    assert solution.cost is not None
    assert bounds[-1] == solution.cost.dstates
    at_debug = {record.getMessage() for record in caplog.records if record.levelno == logging.DEBUG}
    assert "StepEngine is given 23 of 23 steps" in at_debug


def test_log_names_the_engines(caplog: pytest.LogCaptureFixture) -> None:
    circuits = rectangle(40)
    with caplog.at_level(logging.INFO, "ssh_abduction"):
        for theory in (Theory.causal(), Theory.causal().replace(misread=1.5), Theory.topological()):
            solve(circuits, theory)
    engines = re.findall(r", with (\w+)", caplog.text)
    assert engines == ["LabelsFirst", "FaultyEngine", "StepEngine"]


def test_verbose_twice_logs_more_than_once(tee: str, capsys: pytest.CaptureFixture[str]) -> None:
    plain, none = lines(capsys, "solve", tee)
    some_out, some = lines(capsys, "solve", tee, "-v")
    before_out, before = lines(capsys, "-v", "solve", tee)
    more_out, more = lines(capsys, "solve", "-vv", tee)
    assert plain == some_out == before_out == more_out
    assert none == []
    assert min(len(some), len(before)) > 5
    assert not any("prefixes: " in line for line in (*some, *before))
    assert sum("prefixes: " in line for line in more) > 3
    assert all(MESSAGE.fullmatch(line) for line in [*some, *before, *more])
    assert logging.getLogger("ssh_abduction").level == logging.NOTSET
    assert not [
        h
        for h in logging.getLogger("ssh_abduction").handlers
        if not isinstance(h, logging.NullHandler)
    ]


def test_quiet_hides_warnings_but_not_errors(tiny: str, capsys: pytest.CaptureFixture[str]) -> None:
    out, told = lines(capsys, "solve", tiny, "--set", "weigh=count", "--json")
    assert len(told) == 1
    assert "cannot tell a travel from standing still" in told[0]
    quiet, nothing = lines(capsys, "solve", tiny, "--set", "weigh=count", "--json", "-q")
    assert nothing == []
    assert json.loads(quiet)["warnings"] == json.loads(out)["warnings"]
    assert lines(capsys, "-q", "solve", tiny, "--set", "weigh=count")[1] == []
    _, wrong = lines(capsys, "-q", "solve", "no such file", code=1)
    assert wrong == [
        "ssh-abduction: no such file: expected a readable trace file: No such file or directory; "
        "check the path"
    ]


def test_quiet_with_verbose_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(["solve", "-q", "-v", ACES])
    assert "not allowed with argument -q/--quiet" in capsys.readouterr().err


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_has_quiet_and_verbose(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="0"):
        main([verb, "--help"])
    out = capsys.readouterr().out
    assert "-q, --quiet" in out
    assert "-v, --verbose" in out


def test_progress_lines_come_at_intervals(
    tee: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert lines(capsys, "solve", tee)[1] == []
    monkeypatch.setattr(outcome, "FIRST", 0.0)
    monkeypatch.setattr(outcome, "EVERY", 0.001)
    _, told = lines(capsys, "solve", tee)
    assert told
    stage = r"[12] of 2, (search|answer)(: )?"
    assert all(re.fullmatch(rf"ssh-abduction: {stage}.*\(\d+ s\)", line) for line in told)
    numbers = [line.split()[1] for line in told]
    assert numbers == sorted(numbers)  # no stage comes back
    assert lines(capsys, "solve", tee, "-q")[1] == []
    assert all(MESSAGE.fullmatch(line) for line in lines(capsys, "solve", tee, "-v")[1])


def test_stages_never_go_back(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.DEBUG, PROGRESS.name), stages("log", "track", "search"):
        begin_stage("track")
        log_progress("scan 5 of 9")
        begin_stage("log")
        begin_stage("views")
        begin_stage("search")
        log_progress("12 of 73 units, best 50 places")
    with caplog.at_level(logging.DEBUG, PROGRESS.name):
        log_progress("alone")
    assert caplog.messages == [
        "1 of 3, log",
        "2 of 3, track",
        "2 of 3, track: scan 5 of 9",
        "2 of 3, track: log",
        "2 of 3, track: views",
        "3 of 3, search",
        "3 of 3, search: 12 of 73 units, best 50 places",
        "alone",
    ]


def test_progress_of_a_search_counts_its_work(caplog: pytest.LogCaptureFixture) -> None:
    trace = Trace.from_steps("abcbabcba" * 4, ["on"] * 35)
    with caplog.at_level(logging.DEBUG, PROGRESS.name):
        solve(trace, Theory.causal(), work_limit=20)
    told = [re.match(r"(\d+) of 20 units, (no map yet|best \d+)", text) for text in caplog.messages]
    assert told
    done = [int(found[1]) for found in told if found]
    assert len(done) == len(told)
    assert done == sorted(done)


def test_a_terminal_shows_one_line_that_other_output_wipes_away(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    monkeypatch.setattr(sys, "stderr", terminal := Terminal())
    line = outcome._ProgressLine()
    with line.shown():
        line.show()
        assert terminal.getvalue() == ""
        line.emit(logging.LogRecord("", 0, "", 0, "1 of 2, search", (), None))
        line.show()
        print("a warning", file=sys.stderr)
        line.show()
    wiped = "\r\x1b[2K"
    shown = f"{wiped}ssh-abduction: 1 of 2, search (0 s)"
    assert terminal.getvalue() == f"{shown}{wiped}a warning\n{shown}{wiped}"


EAGER = (
    "import sys; from ssh_abduction.cli import main, outcome; "
    "outcome.FIRST, outcome.EVERY = 0.0, 0.001; "
    "sys.exit(main(sys.argv[1:]))"
)


@pytest.mark.parametrize(("words", "mixed"), [((), True), (("--json",), False)])
def test_progress_is_not_mixed_into_json(words: tuple[str, ...], mixed: bool, tee: str) -> None:
    command = [sys.executable, "-c", EAGER, "solve", tee, *words]
    done = subprocess.run(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=True
    )
    assert ("ssh-abduction: 1 of 2, search" in done.stdout) == mixed
    if not mixed:
        assert json.loads(done.stdout)["count"] == 1


def test_log_escapes_control_characters_of_views(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    trace = Trace.from_steps(["\x1b[2J", "b"], ["travel"], name="\x1b[31m\nname")
    trace.save(tmp_path / "trace.jsonl")
    _, told = lines(capsys, "solve", str(tmp_path / "trace.jsonl"), "-vv")
    assert told
    assert all(line.isprintable() for line in told)


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        ("slove trace.jsonl", "solve"),
        ("chek trace.jsonl maps.json", "check"),
        ("recognize r x", "recognise"),
        ("localse maps.json x", "localise"),
        ("solve trace.jsonl --tme-limit 5", "--time-limit"),
        ("solve trace.jsonl --tme-limit=5", "--time-limit"),
        ("solve trace.jsonl --set star=gateway", "gateways"),
        ("export maps.json --to grapml", "graphml"),
        ("completion bsh", "bash"),
    ],
)
def test_misspelt_word_gets_a_suggestion(
    words: str, meant: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(words.split())
    assert f"; did you mean {meant}? (options: ssh-abduction" in capsys.readouterr().err


@pytest.mark.parametrize(
    "words", ["solve a.jsonl -o maps.json b.jsonl", "explain a.jsonl --theory causal 0 9"]
)
def test_arguments_after_an_option_get_a_hint(
    words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(words.split())
    assert "; write them before the options (options: " in capsys.readouterr().err


def test_setting_without_a_value_is_an_error(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(["solve", "trace.jsonl", "--set", "level"])
    assert ", got 'level'; write level=VALUE (options: " in capsys.readouterr().err


@pytest.mark.parametrize(
    "words",
    ["frobnicate", "solve trace.jsonl --xyzzy", "solve a b --set star=\x1b[2J", "check a b c"],
)
def test_unknown_word_gets_no_suggestion(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(words.split(" "))
    err = capsys.readouterr().err
    assert "did you mean" not in err
    assert err.replace("\n", "").isprintable()


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish", "tcsh", "powershell"])
def test_completion_scripts_have_every_verb_and_option(
    shell: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert re.search(rf"\b{shell}\b", *run_completion.rows)
    out, _ = lines(capsys, "completion", shell)
    for verb in VERBS:
        assert verb in out
    assert "time-limit" in out


def test_help_names_the_shipped_worlds() -> None:
    worlds = sorted(path.stem for path in (Path(simulator.__path__[0]) / "worlds").glob("*.json"))
    assert ", ".join(worlds) in run_simulate.rows["world"]


@pytest.mark.skipif(shutil.which("bash") is None, reason="bash")
@pytest.mark.parametrize(
    ("typed", "completed"),
    [
        ("sol", ["solve"]),
        ("solve --time", ["--time-limit"]),
        ("route --by m", ["metres"]),
        ("solve exa", ["example.jsonl"]),
    ],
)
def test_bash_completion_completes_words(
    typed: str, completed: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, _ = lines(capsys, "completion", "bash")
    (tmp_path / "complete.bash").write_text(out)
    (tmp_path / "example.jsonl").write_text("")
    words = typed.split()
    program = (
        "source ./complete.bash; "
        f"COMP_WORDS=(ssh-abduction {' '.join(words)}); COMP_CWORD={len(words)}; "
        "$(complete -p ssh-abduction | sed 's/.*-F \\([^ ]*\\).*/\\1/'); printf '%s\\n' "
        '"${COMPREPLY[@]}"'
    )
    done = subprocess.run(
        ["bash", "-c", program], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.stdout.split() == completed


def test_bootstrap_learner_logs_its_stages(caplog: pytest.LogCaptureFixture) -> None:
    from simulator.tours import simulate
    from simulator.world import World
    from ssh_abduction.learning.learner import BootstrapLearner

    run = simulate(World.named("notched-rectangle"), tours=3, seed=1)
    with caplog.at_level(logging.INFO, "ssh_abduction"):
        learner = BootstrapLearner(Theory(displacement="none")).fit(run)
    told = [
        record.getMessage()
        for record in caplog.records
        if record.name == "ssh_abduction.learning.learner"
    ]
    assert told == [
        f"{len(run)} images, 4 views",
        "a map of 8 dstates",
        f"a recogniser of {len(run)} images",
    ]
    assert np.all(learner.labels_ >= 0)


@pytest.mark.slow
def test_demo_maps_a_simulated_drive_and_opens_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    monkeypatch.setattr("ssh_abduction.cli.simulate.WORLD", "triangle")
    monkeypatch.setattr("ssh_abduction.cli.simulate.WORK", 1)
    assert main(["demo", "-o", str(tmp_path)]) == 0
    page = tmp_path / "house" / "page.html"
    assert opened == [page.as_uri()]
    assert page.is_file()
    out = capsys.readouterr().out
    assert f"$ ssh-abduction map {tmp_path}/drive.log -o {tmp_path}/house" in out
