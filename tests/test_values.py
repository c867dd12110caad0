"""Values in scripts and notebooks: short reprs, sequences, files, errors that are ValueErrors."""

from __future__ import annotations

import json
import pickle
import subprocess
import sys
import tomllib
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import aces
import numpy as np
import pytest
from worlds import TOURS, drive

import ssh_abduction
from simulator.errors import SimulatorError
from simulator.world import World
from ssh_abduction import (
    AbductionError,
    Localiser,
    OnlineMapper,
    Solution,
    SSHMap,
    Theory,
    Trace,
    evaluate,
    export_map,
    solve,
)
from ssh_abduction.cli.text import headline
from ssh_abduction.data import (
    Action,
    Corrections,
    MapError,
    RangeError,
    TraceError,
    load_corrections,
    maps,
    save_corrections,
)
from ssh_abduction.learning.learner import LearnerError
from ssh_abduction.robot_logs import log_report
from ssh_abduction.solution import Certificate, Progress, Status
from ssh_abduction.solver import Search
from ssh_abduction.solver.board import InternalError
from ssh_abduction.theory import Speedups

ROOT = Path(__file__).parent.parent
ACES = Trace.load(ROOT / "examples" / "aces3-route.jsonl")
RECTANGLE = Trace.load(ROOT / "examples" / "notched-rectangle.jsonl")
IMPOSSIBLE = Trace.from_steps("abcd", ["travel", "around", "around"])
LONG = 120  # characters of a repr, at most


def misread() -> tuple[Trace, Solution]:
    trace = Trace.from_steps(
        [f"v{t % 4}" if t != 9 else "v0" for t in range(25)], ["right", "travel"] * 12
    )
    return trace, solve(trace, Theory.causal().replace(misread=1.5))


def online() -> tuple[Trace, Solution]:
    mapper = OnlineMapper("v0", Theory.causal(), time_limit=None)
    for t in range(1, 10):
        mapper.observe(("right", "travel")[(t - 1) % 2], f"v{t % 4}")
    solution = mapper.observe("travel", "v2")
    return mapper.trace, solution


def in_metres() -> tuple[Trace, Solution]:
    trace = Trace.from_steps(
        "cwcwcwcwc", ["travel", "left"] * 4, displacements=[(10, 0, 0), (0, 0, 1.5708)] * 4
    )
    return trace, solve(trace, Theory.causal())


SOLVED: dict[str, Callable[[], tuple[Trace, Solution]]] = {
    "several maps": lambda: (ACES, aces.solution()),
    "one map": lambda: (RECTANGLE, solve(RECTANGLE)),
    "cut off": lambda: (ACES, aces.solution(max_maps=2)),
    "levels": lambda: (ACES[:12], solve(ACES[:12], within=3, max_maps=None)),
    "levels cut off": lambda: (ACES[:12], solve(ACES[:12], within=3, max_maps=2)),
    "stars": lambda: (
        (trace := drive(*TOURS["comb"], stars=True)),
        solve(trace, Theory.circumscriptive()),
    ),
    "poses": in_metres,
    "faults": misread,
    "online": online,
    "no proof": lambda: (ACES, solve(ACES, time_limit=1e-4)),
    "no map": lambda: (IMPOSSIBLE, solve(IMPOSSIBLE)),
    "nothing yet": lambda: (IMPOSSIBLE, solve(IMPOSSIBLE, time_limit=1e-9)),
}


@cache
def solved(kind: str) -> tuple[Trace, Solution]:
    return SOLVED[kind]()


def test_reprs_are_short() -> None:
    """A plain repr of a dataclass would have 9,976 characters here."""
    assert (
        repr(aces.solution())
        == "<Solution optimal: 19 dstates, 10 places, 4 paths; 4 minimal maps>"
    )
    assert repr(aces.solution()[0]) == "<SSHMap: 19 dstates, 10 places, 4 paths; 23 steps>"
    assert repr(ACES) == "<Trace 'ACES3 route': 23 steps, 6 views, 4 actions; stars>"
    assert repr(Trace.from_steps("ab", ["travel"])) == "<Trace: 2 steps, 2 views, 1 action>"
    assert repr(aces.solution().backbone) == (
        "<Backbone: the same dstates; the places of steps 15–18 and 21 differ; "
        "the paths of steps 18–22 differ>"
    )
    assert repr(aces.solution().bound) == "Bound(dstates=19)"
    assert repr(Theory.topological()) == "Theory()"
    assert repr(Speedups.without("sides")) == "Speedups(sides=False)"
    assert repr(RECTANGLE[0]) == "Step(view='v0', action='right')"
    assert (
        repr(solve(misread()[0], Theory.causal(), work_limit=1e-9))
        == "<Solution feasible (work limit): 13 dstates, not proven minimal; "
        "any map has at least 13 dstates>"
    )


@pytest.mark.parametrize("kind", SOLVED)
def test_reprs_have_a_limited_length(kind: str) -> None:
    trace, solution = solved(kind)
    values = [
        trace,
        trace[0],
        solution,
        *solution,
        solution.backbone,
        solution.bound,
        solution.cost,
        solution.certificate,
    ]
    values += [
        Search(trace, solution.theory),
        evaluate(solution.maps, ACES) if trace is ACES and len(solution) else None,
    ]
    values += [solution.backbone.dstates] if solution.backbone else []
    for value in values:
        assert len(repr(value)) <= LONG, value
        assert "\n" not in repr(value)


def test_reprs_cut_long_theories_and_images() -> None:
    pairs = [(t, t + 1) for t in range(1000)]
    assert len(repr(Theory.causal().replace(same=pairs))) < 2 * LONG
    assert repr(Trace.from_steps(["a" * 1000], [])) == "<Trace: 1 step, 1 view, 0 actions>"
    assert len(repr(Certificate(tuple(range(1000))))) <= LONG


def test_counts_of_one_are_singular() -> None:
    one = solve(Trace.from_steps(["a"], []))
    assert one.cost is not None
    run = {"log": {"scans": 1, "metres": 1.0}, "visits": 1, "steps": 1}
    for text, said in (
        (Progress(1, 1, one.cost, one.bound, 1, 0.0).sentence, "best 1 place, 1 dstate, "),
        (headline(one, None), "1 of 1 step given to clingo"),
        (log_report._summary(one, run), "1 scan along 1 m; 1 visit to distinctive places, 1 step."),
        (log_report._summary(one, run), " 1 place, 1 distinctive state."),
        (repr(OnlineMapper("a")), "<OnlineMapper: 1 step, optimal, 1 dstate>"),
    ):
        assert said in text


def test_solution_is_a_sequence_of_its_maps() -> None:
    assert len(aces.solution()) == aces.solution().count == 4
    assert (
        list(aces.solution())
        == [aces.solution()[i] for i in range(4)]
        == list(aces.solution().maps)
    )
    assert aces.solution()[-1] == aces.solution().maps[3]
    assert aces.solution()[1:3] == aces.solution().maps[1:3]
    assert list(reversed(aces.solution())) == list(aces.solution().maps[::-1])  # type: ignore[call-overload]
    assert aces.solution()[2] in aces.solution()
    with pytest.raises(
        RangeError,
        match=r"^maps: expected 0 to 3, or -4 to -1 from the end, got 4; take one of them$",
    ):
        aces.solution()[4]
    none = solve(IMPOSSIBLE)
    assert (len(none), list(none), bool(none)) == (0, [], True)
    with pytest.raises(RangeError, match="there are none"):
        none[0]


def test_traces_can_be_sliced() -> None:
    assert ACES[3] is ACES.steps[3]
    assert ACES[-1] is ACES.steps[22]
    assert ACES[:20] == ACES.prefix(20)
    assert ACES[:] == ACES == ACES[-100:1000]
    for start, stop in ((0, 5), (4, 9), (22, 23), (-5, None), (3, -2)):
        part = ACES[start:stop]
        assert part.views == ACES.views[start:stop]
        assert (
            part.actions
            == ACES.actions[
                slice(start, stop).indices(23)[0] : slice(start, stop).indices(23)[1] - 1
            ]
        )
        assert part.name == ACES.name
    assert solve(RECTANGLE[8:200]).cost == solve(RECTANGLE).cost


def test_slice_of_a_trace_drops_its_first_displacement() -> None:
    trace = in_metres()[0]
    part = trace[3:6]
    assert [step.displacement for step in part] == [
        None,
        trace[4].displacement,
        trace[5].displacement,
    ]
    assert [step.displacement for step in trace[:3]] == [
        step.displacement for step in trace.steps[:3]
    ]


@pytest.mark.parametrize("index", [23, -24, 10**30])
def test_wrong_step_index_names_the_range(index: int) -> None:
    with pytest.raises(
        RangeError, match=r"^steps: expected 0 to 22, or -23 to -1 from the end, got "
    ):
        ACES[index]


@pytest.mark.parametrize(
    ("wrong", "error", "said"),
    [
        (slice(5, 5), RangeError, "steps: expected a slice that holds some of 0 to 22, got 5:5"),
        (slice(23, None), RangeError, "got 23:23"),
        (slice(None, None, 2), TraceError, "steps: expected steps in a row"),
        (slice(None, None, -1), TraceError, "steps: expected steps in a row"),
        ("3", TypeError, "steps: expected a whole number or a slice, got '3'"),
        (1.0, TypeError, "whole number"),
        (True, TypeError, "whole number"),
    ],
)
def test_empty_or_stepped_slice_is_an_error(wrong: Any, error: type[Exception], said: str) -> None:
    with pytest.raises(error, match=said):
        ACES[wrong]


def test_version_equals_that_of_the_project() -> None:
    assert (
        ssh_abduction.__version__
        == tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    )
    assert "__version__" in dir(ssh_abduction)


@pytest.mark.parametrize(
    "bad",
    [
        lambda: Trace.from_steps([], []),
        lambda: Trace.load("no such file"),
        lambda: ACES[99],
        lambda: solve(ACES, max_maps=-1),
        lambda: solve(ACES, time_limit=float("nan")),
        lambda: Theory.topological().replace(star="round"),
        lambda: Speedups.without("magic"),
        lambda: SSHMap.load("no such file"),
        lambda: Solution.load("no such file"),
        lambda: Localiser(aces.solution()[0], "recogniser"),
        lambda: World.named("atlantis"),
        lambda: aces.solution()[9],
    ],
)
def test_bad_input_raises_a_value_error(bad: Callable[[], object]) -> None:
    with pytest.raises(ValueError, match="expected") as caught:
        bad()
    assert isinstance(caught.value, AbductionError)


def test_internal_errors_are_not_value_errors() -> None:
    assert not issubclass(InternalError, ValueError)
    assert not issubclass(AbductionError, ValueError)
    assert all(issubclass(error, ValueError) for error in (LearnerError, SimulatorError))


@pytest.mark.parametrize("kind", SOLVED)
def test_solution_survives_a_round_trip(kind: str, tmp_path: Path) -> None:
    trace, solution = solved(kind)
    file = tmp_path / "maps.json"
    solution.save(file)
    data = json.loads(file.read_text())
    written = data.pop("trace", None)
    assert (written is None) == (solution.trace is None)
    for loaded in (Solution.load(file), Solution.load(file, trace), Solution.from_dict(data)):
        assert loaded == solution
        assert loaded.to_dict() == data == solution.to_dict()
        assert (loaded.backbone, loaded.summary) == (solution.backbone, solution.summary)
        assert loaded.certificate == solution.certificate
        assert (loaded.warnings, loaded.costs) == (solution.warnings, solution.costs)
        assert [m.to_dict() for m in loaded] == [m.to_dict() for m in solution]
        assert repr(loaded) == repr(solution)
    assert pickle.loads(pickle.dumps(loaded)) == solution


def test_values_load_without_a_solver() -> None:
    program = (
        "import sys; from ssh_abduction import Solution, SSHMap, Theory, Trace; "
        "from ssh_abduction.solution import Backbone, Certificate, Cost, Progress, Status; "
        "print([name for name in ('clingo', 'networkx', 'numpy') if name in sys.modules])"
    )
    shown = subprocess.run(
        [sys.executable, "-c", program], stdout=subprocess.PIPE, text=True, check=True
    ).stdout
    assert shown.strip() == "[]"


def test_solve_json_equals_the_saved_solution(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from ssh_abduction.cli import main

    printed = aces.answer()
    aces.solution().save(tmp_path / "saved.json")
    saved = (tmp_path / "saved.json").read_text()
    assert len(printed.splitlines()) == len(saved.splitlines())
    data = [json.loads(text) for text in (printed, saved)]
    for each in data:
        each.pop("seconds")
        each.pop("trace", None)  # a file can hold the trace
    assert data[0] == data[1]
    (tmp_path / "printed.json").write_text(printed)
    assert Solution.load(tmp_path / "printed.json", ACES) == aces.solution()
    assert (
        main(
            [
                "check",
                str(tmp_path / "saved.json"),
                str(ROOT / "examples" / "aces3-route.jsonl"),
                "--bound",
            ]
        )
        == 0
    )
    assert capsys.readouterr().out.startswith("4 of 4 maps satisfy")


def test_saved_solution_keeps_the_explanation(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from ssh_abduction.cli import main

    IMPOSSIBLE.save(tmp_path / "trace.jsonl")
    assert main(["solve", str(tmp_path / "trace.jsonl"), "--json"]) == 20
    (tmp_path / "maps.json").write_text(capsys.readouterr().out)
    loaded = Solution.load(tmp_path / "maps.json")
    assert loaded.status is Status.UNSATISFIABLE
    assert "turn_around_reverses" in str(loaded.to_dict()["explanation"])


@cache
def saved() -> dict[str, Any]:
    return aces.solution().to_dict()


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        (
            {"version": 2},
            r"version: expected 1, got 2; read it with the ssh-abduction that wrote it",
        ),
        ({"version": True}, "version: expected 1"),
        ({"format": "ssh-trace"}, "format: expected \"ssh-solution\", got 'ssh-trace'"),
        (
            {"theory": ...},
            "theory: expected what solve --json or Solution.save writes, got none",
        ),
        ({"theory": {"level": "astral"}}, "theory: level: expected"),
        ({"status": "great"}, "status: expected one of optimal"),
        (
            {"status": "unsatisfiable"},
            "status: expected optimal or feasible, as there is a map",
        ),
        ({"complete": "yes"}, "complete: expected true or false"),
        ({"count": 5}, "count: expected 4, the number of maps listed, got 5"),
        ({"steps": 24}, r"maps\[0\].labels: expected 24, one per step, got 23"),
        ({"steps": "23"}, "steps: expected an integer"),
        ({"cost": {"dstates": 18, "places": 10, "paths": 4}}, "cost: expected 19 dstates"),
        ({"bound": {"dstates": 20}}, "bound: expected at most 19 dstates"),
        ({"bound": {"dstates": -1}}, "bound: expected numbers"),
        (lambda: {"maps": [saved()["maps"][0]] * 4}, "maps: expected each map once"),
        ({"maps": []}, "count: expected 0"),
        ({"maps": {}}, "maps: expected a list"),
        ({"seconds": {"total": "long"}}, "seconds.total: expected a finite number"),
        ({"seconds": []}, "seconds: expected an object"),
        ({"grounding": {"rules": -3, "atoms": 1}}, "grounding.rules: expected a whole number"),
        ({"stopped": "boredom"}, "stopped: expected one of"),
        ({"evidence": {"stars": 7}}, "evidence.stars: expected an object"),
        ({"partial": {}}, "partial: dstates: expected"),
        (
            {"certificate": {"clique": [0, 0], "refuted": []}},
            "certificate.clique: expected different steps from 0 to 22",
        ),
        (
            {"certificate": {"clique": [0, 23], "refuted": []}},
            "certificate.clique: expected different steps from 0 to 22",
        ),
        (
            {"certificate": {"clique": [0, 1], "refuted": [7]}},
            "certificate.refuted: expected the numbers of dstates from 2 on",
        ),
        ({"backbone": {"proven": 1}}, "backbone: expected an object with proven and dstates"),
        (
            {"backbone": {"proven": True, "dstates": {"always": [0], "sometimes": []}}},
            "backbone: dstates.always: expected 23 numbers",
        ),
        ({"warnings": [3]}, r"warnings\[0\]: expected a sentence"),
    ],
)
def test_malformed_solution_file_is_refused_with_its_field(
    fields: dict[str, Any] | Callable[[], dict[str, Any]], said: str, tmp_path: Path
) -> None:
    """`fields` replace those of a file that is right; `...` leaves one out."""
    data = {**saved(), **(fields() if callable(fields) else fields)}
    refuses({name: value for name, value in data.items() if value is not ...}, said, tmp_path)


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (
            lambda: saved()["maps"][0],
            "maps: expected a solution, got one map; take SSHMap.load",
        ),
        (
            lambda: {"trace": "x", "status": "error", "error": "x: no trace"},
            "got the error that solve ended with: 'x: no trace'",
        ),
        (list, "expected an object"),
        (lambda: None, "expected an object"),
        (dict, "maps: expected what solve --json"),
    ],
)
def test_file_without_a_solution_is_refused(
    data: Callable[[], Any], said: str, tmp_path: Path
) -> None:
    refuses(data(), said, tmp_path)


def refuses(data: object, said: str, folder: Path) -> None:
    file = folder / "maps.json"
    file.write_text(json.dumps(data))
    with pytest.raises(MapError, match=said) as caught:
        Solution.load(file)
    assert str(caught.value).startswith(str(file))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "got an empty file"),
        ("  \n", "empty file"),
        ("{", "broken JSON"),
        ("\0", "broken JSON"),
    ],
)
def test_solution_file_that_is_not_json_is_refused(text: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "maps.json").write_text(text)
    with pytest.raises(MapError, match=said):
        Solution.load(tmp_path / "maps.json")


def test_huge_solution_file_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    aces.solution().save(tmp_path / "maps.json")
    monkeypatch.setattr("ssh_abduction.data.map_parts.LARGEST", 2**20)
    assert Solution.load(tmp_path / "maps.json") == aces.solution()
    with pytest.raises(MapError, match="expected at most 1 MiB, got more"):
        Solution.load("/dev/zero")


def test_solution_of_another_trace_is_refused(tmp_path: Path) -> None:
    aces.solution().save(tmp_path / "maps.json")
    with pytest.raises(
        MapError,
        match="expected 400, one for each step of the trace, got 23; solve this trace",
    ):
        Solution.load(tmp_path / "maps.json", RECTANGLE)
    solve([ACES[:4], replace(ACES[3:8], name="b")], max_maps=1).save(tmp_path / "joint.json")
    with pytest.raises(MapError, match="got 9; the map is of 2 drives, so give their joint trace"):
        Solution.load(tmp_path / "joint.json", ACES)
    other = ACES.with_views(["hall", *ACES.views[1:]])  # type: ignore[list-item]
    with pytest.raises(
        MapError,
        match=r"maps\[0\]: expected view 'hall' at step 0, as the trace has it, got 'open-ahead",
    ):
        Solution.load(tmp_path / "maps.json", other)
    solve(IMPOSSIBLE).save(tmp_path / "none.json")
    with pytest.raises(MapError, match="steps: expected maps of a trace of 23 steps, got 4"):
        Solution.load(tmp_path / "none.json", ACES)


def test_single_map_and_solution_files_are_distinguished(tmp_path: Path) -> None:
    aces.solution().save(tmp_path / "maps.json")
    aces.solution()[0].save(tmp_path / "map.json")
    assert SSHMap.load(tmp_path / "map.json") == aces.solution()[0]
    with pytest.raises(MapError, match=r"expected one map, got a solution; take Solution.load"):
        SSHMap.load(tmp_path / "maps.json")
    data = json.loads((tmp_path / "map.json").read_text())
    (tmp_path / "map.json").write_text(json.dumps(data | {"version": 7}))
    with pytest.raises(MapError, match="version: expected 1, got 7"):
        SSHMap.load(tmp_path / "map.json")
    assert maps.maps_of(
        {k: v for k, v in data.items() if k not in ("format", "version")}, "old"
    ) == [aces.solution()[0]]


def test_incomplete_solution_is_not_saved(tmp_path: Path) -> None:
    search = Search(ACES)
    first = next(kept := iter(search))
    assert len(list(kept)) == 3
    for some in ((), (first,)):
        with pytest.raises(MapError, match="maps: expected all 4 that the search found"):
            search.solution(some).save(tmp_path / "maps.json")
    assert not list(tmp_path.iterdir())


def test_texts_of_numpy_are_kept_as_plain_text(tmp_path: Path) -> None:
    """YAML cannot store texts of numpy."""
    name = np.str_("monday")
    trace = Trace.from_steps(np.array(["a", "b"]), np.array(["travel"]), name=name)
    assert {type(text) for text in (trace.name, *trace.views, trace.actions[0].name)} == {str}
    turn = Action(np.str_("veer"), np.str_("turn"), gateway=np.int64(2), turn=np.str_("left"))
    assert repr(turn) == repr(Action("veer", "turn", "left", gateway=2))
    text = export_map(solve(trace)[0], "tmap2", name=np.str_("hall"))
    assert "name: hall" in text
    said = Corrections.for_drives(trace).with_name(np.str_("kitchen"), "place", name + ":1")
    save_corrections(said, tmp_path / "corrections.yaml")
    assert load_corrections(tmp_path / "corrections.yaml").names == said.names
