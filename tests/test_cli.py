"""The command line: every verb and every exit code. No bad input shows a traceback."""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import re
import signal
import subprocess
import sys
import time
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import patch

import aces
import networkx as nx
import pytest
from aces import ACES
from worlds import ENDLESS, TOURS, drive, rectangle

from ssh_abduction import SSHMap, Theory, Trace, solve
from ssh_abduction.cli import main, parser
from ssh_abduction.theory import encodings


@pytest.fixture
def solved(tmp_path: Path) -> Path:
    """The minimal maps of the ACES3 route, as solve --json prints them."""
    path = tmp_path / "maps.json"
    path.write_text(aces.answer())
    return path


def saved(trace: Trace, folder: Path) -> str:
    path = folder / "trace.jsonl"
    trace.save(path)
    return str(path)


def test_solve_prints_the_maps_and_their_differences(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["solve", ACES]) == 0
    out = capsys.readouterr().out
    verdict, headline = out.splitlines()[:2]
    assert verdict == "10 places, 3 joins by minimality alone. Proven minimal, one of 4 such maps."
    assert headline.startswith("optimal: 19 dstates, 10 places, 4 paths; 4 minimal maps;")
    assert "what tells the maps apart\n" in out
    assert "path 0: places" in out


def test_json_of_solve_has_the_documented_fields(solved: Path) -> None:
    data = json.loads(solved.read_text())
    assert (data["status"], data["complete"], data["count"], data["steps"]) == (
        "optimal",
        True,
        4,
        23,
    )
    assert data["cost"] == {"dstates": 19, "places": 10, "paths": 4}
    assert data["bound"] == {"dstates": 19}
    assert data["theory"]["star"] == "frame"
    assert set(data["seconds"]) == {"total", "ground", "solve"}
    first = data["maps"][0]
    assert len(first["labels"]) == 23
    assert first["labels"][0] == 0
    assert set(first["dstates"][0]) == {"id", "view", "place", "path", "direction", "heading"}
    assert first["links"][0] == [0, "travel", 1]
    assert first["places"] == list(range(10))
    assert set(first["paths"][0]) == {"id", "order"}
    assert [SSHMap.from_dict(m).to_dict() for m in data["maps"]] == data["maps"]


def test_max_maps_cuts_the_list(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    route = saved(drive(*TOURS["comb"]), tmp_path)
    prefer = "--set=prefer=paths,places,dstates"
    assert main(["solve", route, *ENDLESS, prefer, "-n", "5", "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert (data["count"], len(data["maps"]), data["complete"]) == (5, 5, False)


def test_set_accepts_every_field_of_a_theory(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fields = (
        "boundary=defeasible symmetric_sides=false path_order=partial next_place=true planar=true "
        "all_on_paths=false star=pattern prefer=places,excuses without=on_path level=topological "
        "displacement=none reject=0.01 joint=1 weigh=count"
    )
    flags = ["--theory", "circumscriptive", *(f"--set={field}" for field in fields.split())]
    route = saved(drive(*TOURS["square"], stars=True), tmp_path)
    assert main(["solve", route, "-n", "1", "--json", *flags]) == 0
    expected = Theory(
        boundary="defeasible",
        symmetric_sides=False,
        path_order="partial",
        next_place=True,
        planar=True,
        star="pattern",
        prefer=("places", "excuses"),
        without=("on_path",),
        displacement="none",
        reject=0.01,
        joint=1,
        weigh="count",
    )
    assert Theory.from_dict(json.loads(capsys.readouterr().out)["theory"]) == expected


def test_solve_names_the_clashing_axioms_and_steps(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    trace = Trace.from_steps("xyabcd", ["right", "travel", "travel", "around", "around"])
    path = saved(Trace.from_steps("xyabcde", [*trace.actions, "travel"]), tmp_path)
    assert main(["solve", path]) == 20
    out = capsys.readouterr().out
    assert out.startswith(
        "unsatisfiable: no map satisfies the axioms: in steps 2 to 5 these clash: functional_view "
        "(step 5)"
    )
    assert "turn_around_reverses (steps 4, 5)" in out
    assert f"from {path}:4 to {path}:7" in out
    assert main(["solve", path, "--json"]) == 20
    data = json.loads(capsys.readouterr().out)
    assert (data["status"], data["count"], data["cost"], data["complete"]) == (
        "unsatisfiable",
        0,
        None,
        True,
    )
    assert data["explanation"]["first"] == 2
    assert {"axiom": "functional_view", "steps": [5]} in data["explanation"]["clashes"]


def test_solve_without_time_prints_a_sketch_or_unknown(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = saved(drive(*TOURS["comb"]), tmp_path)
    assert main(["solve", path, "--time-limit", "1e-9"]) == 0
    capsys.readouterr()
    assert main(["solve", path, "--time-limit", "1e-9", "--strict"]) == 10
    verdict, headline = capsys.readouterr().out.splitlines()[:2]
    assert verdict.endswith(" Not proven minimal.")
    assert headline.startswith("feasible (time limit): ")
    no_time = ["solve", path, "--time-limit", "1e-9", "--set", "without_speedups=greedy"]
    assert main(no_time) == 30
    assert capsys.readouterr().out.startswith("unknown (time limit): no map of all 22 steps yet")
    assert main([*no_time, "--json"]) == 30
    assert json.loads(capsys.readouterr().out)["status"] == "unknown"
    assert main([*no_time, "--set", "without=functional_view"]) == 30
    assert "; no bound is proven; " in capsys.readouterr().out


def test_solve_prints_a_map_without_proof(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from test_solver import too_hard

    path = saved(too_hard(), tmp_path)
    assert main(["solve", path, "--theory", "causal", "--time-limit", "0.5", "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert (data["status"], data["stopped"], data["count"], data["complete"]) == (
        "feasible",
        "time limit",
        1,
        False,
    )


@pytest.mark.skipif(sys.platform == "win32", reason="signals")
def test_ctrl_c_prints_the_maps_found_so_far(tmp_path: Path) -> None:
    path = saved(rectangle(12), tmp_path)
    command = [sys.executable, "-m", "ssh_abduction", "solve", path, *ENDLESS, "--json", "-q"]
    with (
        (tmp_path / "out.json").open("w") as out,
        subprocess.Popen(command, stdout=out, stderr=subprocess.PIPE, text=True) as process,
    ):
        deadline = time.monotonic() + 100
        while (tmp_path / "out.json").stat().st_size < 1_000 and time.monotonic() < deadline:
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        assert process.wait(100) == 130
        assert process.stderr is not None
        assert process.stderr.read() == ""
    data = json.loads((tmp_path / "out.json").read_text())
    assert (data["stopped"], data["complete"], data["status"]) == ("interrupted", False, "optimal")
    assert data["count"] == len(data["maps"]) > 0


def test_ctrl_c_during_output_leaves_it_complete(
    room: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from ssh_abduction.cli import outcome

    def ending(*args: Any) -> dict[str, Any]:
        signal.raise_signal(signal.SIGINT)
        return end(*args)

    end = outcome.answer_ending
    monkeypatch.setattr(outcome, "answer_ending", ending)
    assert main(["solve", room, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["complete"]


def test_check_accepts_the_maps_of_solve(solved: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(solved), ACES]) == 0
    assert capsys.readouterr() == ("4 of 4 maps satisfy the 27 axioms\n", "")


def test_check_warns_of_another_trace(
    solved: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["check", str(solved), saved(rectangle(8), tmp_path)]) == 1
    assert "was made of other steps than those of" in capsys.readouterr().err


def test_check_names_the_broken_axiom(solved: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = json.loads(solved.read_text())
    data["maps"][1]["dstates"][3]["place"] = 0
    solved.write_text(json.dumps(data))
    assert main(["check", str(solved), ACES]) == 20
    out = capsys.readouterr().out
    assert re.search(r"^map 2: \w+: steps? ", out, re.MULTILINE)
    assert out.endswith("3 of 4 maps satisfy the 27 axioms\n")


def test_check_judges_under_another_theory(
    solved: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert (
        main(["check", str(solved), ACES, "--theory", "topological", "--set", "next_place=true"])
        == 20
    )
    assert "next_place" in capsys.readouterr().out


def test_flags_override_the_theory_of_the_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    route = saved(drive(*TOURS["tee"]), tmp_path)
    assert main(["solve", route, "--json", "--set", "boundary=none"]) == 0
    loose = tmp_path / "loose.json"
    loose.write_text(capsys.readouterr().out)
    assert main(["check", str(loose), route]) == 0
    assert main(["check", str(loose), route, "--set", "boundary=strict"]) == 20
    assert "0 of 2 maps satisfy the 21 axioms" in capsys.readouterr().out
    data = json.loads(loose.read_text())
    for theory, message in (
        (5, "theory: expected an object"),
        ({"prefer": None}, "prefer: expected a list"),
    ):
        loose.write_text(json.dumps({**data, "theory": theory}))
        assert main(["check", str(loose), route]) == 1
        assert message in capsys.readouterr().err


def test_count_of_one_has_a_singular_noun(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = saved(Trace.from_steps("a", []), tmp_path)
    assert main(["solve", path, "--theory", "topological"]) == 0
    assert capsys.readouterr().out.startswith(
        "1 place. Proven minimal, the only such map.\n"
        "optimal: 1 dstate, 1 place, 0 paths; 1 minimal map; "
    )
    assert main(["solve", path, "--json"]) == 0
    maps = tmp_path / "maps.json"
    maps.write_text(capsys.readouterr().out)
    assert main(["check", "--bound", str(maps), path]) == 0
    assert "at least 1 dstate: no two of 1 step" in capsys.readouterr().out


def test_check_bound_accepts_an_answer_without_maps(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], solved: Path
) -> None:
    bare = tmp_path / "bare.json"
    none = {
        "maps": [],
        "count": 0,
        "cost": None,
        "status": "unknown",
        "complete": False,
        "summary": "no map was found",
        "backbone": None,
    }
    bare.write_text(json.dumps({**json.loads(solved.read_text()), **none}))
    assert main(["check", "--bound", str(bare), ACES]) == 0
    assert "at least 19 dstates, if clingo is right" in capsys.readouterr().out


def test_check_reads_one_saved_map(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    trace = rectangle(8)
    (ssh_map,) = solve(trace).maps
    ssh_map.save(tmp_path / "map.json")
    assert SSHMap.load(tmp_path / "map.json") == ssh_map
    assert main(["check", str(tmp_path / "map.json"), saved(trace, tmp_path)]) == 0
    assert "1 of 1 map satisfies the 21 axioms" in capsys.readouterr().out


def test_show_draws_and_exports_a_map(solved: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["show", str(solved)]) == 0
    assert capsys.readouterr().out.count("path 0: places") == 4
    assert main(["show", str(solved), "--map", "2"]) == 0
    assert capsys.readouterr().out.count("path 0: places") == 1
    assert main(["export", str(solved), "--to", "dot"]) == 0
    dot = capsys.readouterr().out
    assert dot.startswith("digraph map {")
    assert dot.count("subgraph cluster_") == 10
    assert dot.count(" -> ") == len(json.loads(solved.read_text())["maps"][0]["links"])
    assert main(["export", str(solved), "--to", "graphml"]) == 0
    graph = nx.parse_graphml(capsys.readouterr().out)
    assert len(graph) == 19
    assert main(["export", str(solved), "--to", "svg"]) == 0
    assert capsys.readouterr().out.startswith("<svg ")
    assert main(["show", str(solved), "--map", "9"]) == 1
    assert "expected the number of a map, 1 to 4, or its id, got '9'" in capsys.readouterr().err


def test_facts_run_in_plain_clingo(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["facts", ACES]) == 0
    facts = capsys.readouterr().out
    (tmp_path / "trace.lp").write_text(facts)
    command = next(line for line in facts.splitlines() if "python run.py" in line).lstrip("% ")
    words = [
        str(tmp_path / "trace.lp") if word == "THIS_FILE" else word for word in command.split()[1:]
    ]
    done = subprocess.run(
        [sys.executable, *words],
        cwd=encodings.folder(),
        capture_output=True,
        text=True,
        check=False,
    )
    assert "OPTIMUM FOUND" in done.stdout
    assert "Optimization : 19 4 10" in done.stdout
    assert re.search(r"Optimal +: 4\n", done.stdout)


def test_theory_lists_every_axiom(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["theory"]) == 0
    out = capsys.readouterr().out
    for axiom in encodings.axioms():
        line = next(line for line in out.splitlines() if line.startswith(f"  {axiom.name} "))
        assert axiom.sentence in line
        assert axiom.source in line
        assert ("on" in line.split()[2:3]) == (axiom.name in Theory.topological().axioms)


BAD_INPUT = {
    "empty file": b"",
    "binary": bytes(range(256)),
    "broken": b'{"format": "ssh-trace", "version": 1}\n{"view": }\n',
    "no view anywhere": b'{"format": "ssh-trace", "version": 1}\n{"image": [1, 2]}\n',
    "no kind": b'{"format": "ssh-trace", "version": 1}\n{"view": "a", "action": "jump"}\n'
    b'{"view": "b"}\n',
}


@pytest.mark.parametrize("case", BAD_INPUT)
@pytest.mark.parametrize("verb", ["solve", "facts"])
def test_bad_trace_is_a_one_line_error(
    verb: str, case: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "t.jsonl"
    path.write_bytes(BAD_INPUT[case])
    assert main([verb, str(path)]) == 1
    captured = capsys.readouterr()
    assert captured.out == ""
    assert re.fullmatch(rf"ssh-abduction: {re.escape(str(path))}:\d+: [^\n]+\n", captured.err)


@pytest.mark.parametrize(
    "text",
    [
        "9" * 5000,
        '{"labels": [0], "dstates": [{"id": 0, "view": "\\ud800"}], "links": []}',
        "",
        "[]",
        '{"maps": 3}',
        '{"labels": [0], "dstates": 3}',
        "{",
        '{"maps": [{}]}',
    ],
)
@pytest.mark.parametrize("verb", ["show", "check"])
def test_bad_maps_file_is_a_one_line_error(
    verb: str, text: str, tmp_path: Path, refuses: Callable[..., None]
) -> None:
    path = tmp_path / "maps.json"
    path.write_text(text)
    refuses([verb, str(path), *([ACES] if verb == "check" else [])], f"ssh-abduction: {path}")


def test_contradicting_options_are_a_one_line_error(refuses: Callable[..., None]) -> None:
    command = ["solve", ACES, "--theory", "causal", "--set", "boundary=strict"]
    refuses(command, "ssh-abduction: boundary: expected none with level=causal")


def test_setting_level_causal_gives_the_causal_preset(
    room: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["solve", room, "--set", "level=causal"]) == 0
    alone = capsys.readouterr().out
    assert re.search(r"\noptimal: \d+ dstates?; 1 minimal map;", alone)  # no places and paths
    assert main(["solve", room, "--theory", "causal"]) == 0
    assert re.sub(r"\d\.\d\d s", "", alone) == re.sub(r"\d\.\d\d s", "", capsys.readouterr().out)


def test_wrong_usage_ends_with_exit_code_2(capsys: pytest.CaptureFixture[str]) -> None:
    for words in ([], ["solve"], ["dance"], ["solve", ACES, "--set", "boundary=soft"]):
        with pytest.raises(SystemExit) as stop:
            main(words)
        assert stop.value.code == 2
    capsys.readouterr()


def test_control_characters_in_names_are_escaped(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "two\nlines"
    path.write_text("{}")
    assert main(["solve", str(path)]) == 1
    assert capsys.readouterr().err.count("\n") == 1
    trace = saved(Trace.from_steps(["a\nb\x1b[31m", "\x01\ufffe"], ["travel"]), tmp_path)
    assert main(["solve", trace]) == 0
    assert "a\\nb\\x1b[31m" in capsys.readouterr().out
    assert main(["solve", trace, "--json"]) == 0
    (tmp_path / "maps.json").write_text(capsys.readouterr().out)
    for form in ("svg", "graphml", "dot"):
        assert main(["export", str(tmp_path / "maps.json"), "--to", form]) == 0
        if form != "dot":
            ET.fromstring(capsys.readouterr().out)


@pytest.mark.slow
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
def test_output_that_cannot_be_written_is_a_one_line_error(room: str) -> None:
    for target in ("> /dev/full", ">&-"):
        done = subprocess.run(
            f"{sys.executable} -m ssh_abduction solve {room} -q --json {target}",
            shell=True,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 1
        assert done.stderr.count("\n") == 1
    done = subprocess.run(
        f"{sys.executable} -m ssh_abduction solve - -q <&-",
        shell=True,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)


def printed_in(letters: str, *words: str, given: bytes = b"") -> bytes:
    """The output of a command if standard input and output have only this encoding."""
    out = io.TextIOWrapper(io.BytesIO(), letters)
    with (
        patch.object(sys, "stdin", io.TextIOWrapper(io.BytesIO(given), letters)),
        patch.object(sys, "stdout", out),
    ):
        assert main(words) == 0
    out.flush()
    return out.buffer.getvalue()  # type: ignore[attr-defined, no-any-return]


def test_unprintable_characters_are_replaced_on_the_terminal(room: str) -> None:
    assert b"right ? 1" in printed_in("ascii", "solve", room)


def test_verbs_read_standard_input_and_survive_a_closed_pipe(room: str) -> None:
    trace = Path(room).read_bytes()
    command = [sys.executable, "-m", "ssh_abduction", "solve", "-", "-q"]
    done = subprocess.run(command, input=trace, capture_output=True, check=True)
    assert b"\noptimal: 8 dstates" in done.stdout
    assert done.stderr == b""
    shown = printed_in("utf-8", "show", "-", given=aces.answer().encode())
    assert shown.count(b"path 0: places") == 4
    pipe = subprocess.run(
        f"{sys.executable} -m ssh_abduction facts {room} | head -1",
        shell=True,
        capture_output=True,
        check=True,
    )
    assert pipe.stderr == b""


@pytest.mark.skipif(sys.platform == "win32", reason="terminals")
def test_progress_shows_on_a_terminal(tmp_path: Path) -> None:
    import pty

    from test_solver import too_hard

    path = saved(too_hard(), tmp_path)
    master, slave = pty.openpty()
    command = [sys.executable, "-m", "ssh_abduction", "solve", path]
    command += ["--theory", "causal", "--time-limit", "100"]
    environment = {**os.environ, "TERM": "xterm", "COLUMNS": "160"}
    parts = [b"1 of 2, search: ", b"best", "dstates ≥".encode(), b" s)", b"\r\x1b[2K"]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=slave, env=environment
    ) as process:
        os.close(slave)
        shown = b""
        with contextlib.suppress(OSError):  # the terminal is gone when the program is
            while not all(part in shown for part in parts):
                shown += os.read(master, 4096)
        process.send_signal(signal.SIGINT)
        with contextlib.suppress(OSError):
            while os.read(master, 4096):
                pass
        assert process.wait(100) == 130
    os.close(master)
    assert all(part in shown for part in parts)


def test_machine_output_is_utf_8_on_every_terminal(tmp_path: Path) -> None:
    """In another encoding, different views would look equal."""
    path = saved(Trace.from_steps(["日本", "中国", "Küche"], ["travel", "travel"]), tmp_path)

    def printed(*words: str, given: bytes = b"") -> str:
        return printed_in("cp1252", *words, given=given).decode("utf-8")

    maps = printed("solve", path, "--json")
    assert [s["view"] for s in json.loads(maps)["maps"][0]["dstates"]] == ["日本", "中国", "Küche"]
    assert 'view(1,"中国").' in printed("facts", path)
    for form in ("svg", "graphml"):
        drawn = ET.fromstring(printed("export", "-", "--to", form, given=maps.encode()))
        assert "日本" in "".join(drawn.itertext())


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["simulate", "notched-rectangle", "--seed", "-1", "-o", "x"],
            "--seed: expected a whole number from 0 to",
        ),
        (["cluster", "x", "-o", "y", "--seed", "1e3"], "--seed: expected a whole number from 0 to"),
        (
            ["cluster", "x", "-o", "y", "--plot", "z.foo"],
            "--plot: expected a name that ends in .png, .pdf or .svg",
        ),
        (["solve", "x", "--time-limit", "10s"], "--time-limit: expected a number, got '10s'"),
        (["map", "x", "-o", "y", "-n", "1.5"], "-n/--maps: expected a whole number, got '1.5'"),
    ],
)
def test_wrong_usage_names_the_wrong_option(
    words: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(words)
    assert message in capsys.readouterr().err


def test_error_messages_say_how_to_mend_the_input(
    tmp_path: Path, refuses: Callable[..., None], solved: Path
) -> None:
    many, none = tmp_path / "many.jsonl", tmp_path / "none.json"
    many.write_text("{}\n{}\n")
    none.write_text('{"maps": []}')
    for words, message in [
        (
            ["show", str(many)],
            "many.jsonl:2: expected one JSON value, got more after it; solve prints a line for "
            "each of several traces",
        ),
        (["show", str(none), "--map", "1"], "none.json: expected maps, got none"),
        (["check", str(none), ACES], "maps: expected one to check, got none"),
        (["check", str(tmp_path / "no.json")], "no.json: expected a readable file of maps"),
        (["next", ACES], "expected a file of maps, got a trace; name the maps first"),
        (["solve", ACES, "-n", "-1"], "1 or more, got -1; None (--maps 0) lists all"),
        (
            ["train", str(solved), ACES, "--map", "5", "-o", "x"],
            "expected the number of a map, 1 to 4, or its id, got '5'",
        ),
    ]:
        refuses(words, message)


def test_closed_standard_error_does_not_stop_the_answer(
    room: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Messages are dropped if stderr is closed. The answer is printed."""
    for words, code in ((["solve", room], 0), (["solve", "nosuch"], 1)):
        monkeypatch.setattr(sys, "stderr", None)
        assert main(words) == code
        sys.stderr.close()
    out = capsys.readouterr().out
    assert "\noptimal: 8 dstates" in out
    assert "nosuch" not in out


def test_failed_solve_keeps_the_maps_of_the_old_file(
    room: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    clash = Trace.from_steps("xyabcd", ["right", "travel", "travel", "around", "around"])
    wrong, maps = saved(clash, tmp_path), tmp_path / "maps.json"
    assert main(["solve", wrong, "-o", str(maps)]) == 20
    assert json.loads(maps.read_text())["maps"] == []
    assert main(["solve", room, "-o", str(maps)]) == 0
    good = maps.read_text()
    capsys.readouterr()
    for words in ([], ["--json"]):
        assert main(["solve", wrong, "-o", str(maps), *words]) == 20
        assert "maps.json: keeps the maps that it had" in capsys.readouterr().err
        assert maps.read_text() == good


def test_error_is_printed_as_json(
    room: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for words in (["solve", "nosuch"], ["check", "nosuch", room], ["solve", room, "-n", "-1"]):
        assert main([*words, "--json"]) == 1
        out, err = capsys.readouterr()
        data = json.loads(out)
        assert list(data) == ["status", "error"]
        assert (data["status"], err) == ("error", f"ssh-abduction: {data['error']}\n")
    ring = tmp_path / "ring"  # only writing it shows that it is no file
    ring.symlink_to(ring)
    assert main(["solve", room, "--json", "-o", str(ring)]) == 1
    assert json.loads(capsys.readouterr().out)["status"] == "optimal"  # no error follows it


def test_check_prints_violations_as_json(solved: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["check", str(solved), ACES, "--bound", "--json"]
    assert main(words) == 0
    data = json.loads(capsys.readouterr().out)
    assert (data["holds"], data["maps"], data["violations"]) == (True, 4, [])
    assert data["sentences"][-1] == "the maps have 19: no map has fewer"
    broken = json.loads(solved.read_text())
    ends = broken["maps"][1]["paths"][0]["order"]
    ends.reverse()
    solved.write_text(json.dumps(broken))
    assert main(words[:3]) == 20
    lines = capsys.readouterr().out.splitlines()
    assert main([*words[:3], "--json"]) == 20
    data = json.loads(capsys.readouterr().out)
    assert (data["holds"], {v["map"] for v in data["violations"]}) == (False, {2})
    first = data["violations"][0]
    assert first["axiom"] in lines[0]
    assert first["message"] in lines[0]


def test_shell_has_at_most_56_flags() -> None:
    flags = {
        name
        for each in (parser(), *parser().verbs.values())
        for action in each._actions
        if action.help != argparse.SUPPRESS
        for name in action.option_strings
        if name.startswith("--")
    }
    assert len(flags) <= 56, sorted(flags)


def test_a_theory_is_read_from_a_file(
    tmp_path: Path, room: str, capsys: pytest.CaptureFixture[str]
) -> None:
    toml = tmp_path / "mine.toml"
    toml.write_text('preset = "topological"\nboundary = "none"\nprefer = ["dstates", "paths"]\n')
    assert Theory.from_toml(toml) == Theory(boundary="none", prefer=("dstates", "paths"))
    assert main(["solve", room, "--theory", str(toml)]) == 0
    by_file = capsys.readouterr().out.splitlines()[2:]
    flags = ["--set", "boundary=none", "--set", "prefer=dstates,paths"]
    assert main(["solve", room, *flags]) == 0
    assert capsys.readouterr().out.splitlines()[2:] == by_file
    toml.write_text("boundary = 3\n")
    assert main(["solve", room, "--theory", str(toml)]) == 1
    assert "mine.toml: boundary: expected none, strict or defeasible" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "hint"),
    [
        (["map", "x.log", "-o", "x", "--set", "widht=0.4"], "did you mean --width?"),
        (["map", "x.log", "-o", "x", "--set", "misraed=4"], "did you mean --set misread=VALUE?"),
        (["map", "x.log", "-o", "x", "--misraed=4"], "did you mean --set misread=VALUE?"),
        (["solve", "x", "--strcit"], "did you mean --strict?"),
        (
            ["export", "x", "--to", "svg", "--set", "hide=1"],
            "did you mean --set hide_undecided=VALUE?",
        ),
    ],
)
def test_misspelt_option_gets_the_way_to_write_it(
    words: list[str], hint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        main(words)
    assert f"; {hint} (options: ssh-abduction {words[0]} --help)" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("simulate triangle -o x.svg", ".jsonl"),
        ("simulate triangle --format carmen -o x.bag", ".log or .clf"),
        ("export {maps} --to nav2 -o x.svg", ".geojson"),
        ("view {maps} -o x.svg", ".html or .htm"),
        ("solve {trace} -o x.jsonl", ".json"),
    ],
)
def test_ending_of_another_format_is_refused(
    words: str, expected: str, solved: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words.format(maps=solved, trace=ACES).split()) == 1
    assert f"expected a name that ends in {expected}, " in capsys.readouterr().err
    assert not Path("x.svg").exists()


def test_simulate_writes_the_format_that_the_name_says(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["simulate", "triangle", "-o", str(tmp_path / "x.log")]) == 0
    assert "scans along" in capsys.readouterr().out
    assert (tmp_path / "x.log").read_text().count("\nROBOTLASER1 ") > 10


@pytest.mark.parametrize("name", ["run.json", "page.html"])
def test_map_keeps_the_files_of_another_program(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / name).write_text("mine")
    assert main(["map", "missing.log", "-o", str(tmp_path)]) == 1
    assert f"got {name}, which is not of map; name another folder" in capsys.readouterr().err
    assert (tmp_path / name).read_text() == "mine"


def test_map_asks_whether_it_can_write_before_it_reads(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["map", "missing.log", "-o", "/proc/there"]) == 1
    assert "expected a folder that can be written, got " in capsys.readouterr().err
