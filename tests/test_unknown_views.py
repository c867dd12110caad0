"""Steps whose views are unknown: they may be at any dstate, and each dstate still has one view."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import theories, traces
from test_property import LIMIT, agree
from worlds import TOURS, drive

from ssh_abduction import OnlineMapper, SSHMap, Theory, Trace, solve
from ssh_abduction.checker.checker import check
from ssh_abduction.checker.claims import check_bound
from ssh_abduction.cli import main
from ssh_abduction.data.errors import MapError, TraceError
from ssh_abduction.output import to_dot, to_graphml, to_svg
from ssh_abduction.rivals.comparison import compare
from ssh_abduction.rivals.explore import next_experiment
from ssh_abduction.solution import Status
from ssh_abduction.theory.settle import settle
from ssh_abduction.theory.speedups import TABLE

CORRIDOR = ["end", "hall", "end", "end", "hall", "end", "end"]
HEAD = '{"format": "ssh-trace", "version": 1}\n'
DRIVEN = ["travel", "travel", "around", "travel", "travel", "around"]
TOUR = drive(*TOURS["comb"])
# With stars, the axioms force steps 0 and 2, and 1 and 3, to be one dstate.
TURNED = Trace.from_steps("abab", ["around"] * 3, stars=[(1, 0, 0, 0), (0, 0, 1, 0)] * 2)


def hidden(trace: Trace, steps: set[int]) -> Trace:
    """The trace without the views of these steps. One view at least is kept."""
    kept = {t for t in steps if t} if len(steps) == len(trace) else steps
    return trace.with_views([None if t in kept else view for t, view in enumerate(trace.views)])


@settings(max_examples=7)
@given(st.data())
def test_maps_with_unknown_views_equal_the_brute_force(data: st.DataObject) -> None:
    trace = data.draw(traces(max_steps=6), label="trace")
    steps = data.draw(
        st.sets(st.integers(0, len(trace) - 1), min_size=1, max_size=3), label="hidden"
    )
    agree(hidden(trace, steps), data.draw(theories(trace), label="theory"))


@settings(max_examples=6)
@given(st.data())
def test_hiding_a_view_never_raises_the_cost(data: st.DataObject) -> None:
    trace = data.draw(traces(max_steps=5), label="trace")
    choices = data.draw(
        st.sampled_from([{}, {"misread": 1.5}, {"slipped": 1.0}, {"misread": 0.5, "slipped": 2.0}]),
        label="faults",
    )
    theory = data.draw(
        st.sampled_from([Theory.causal(), Theory.topological()]), label="theory"
    ).replace(**choices)
    steps = data.draw(st.sets(st.integers(0, len(trace) - 1), min_size=1), label="hidden")
    before, unknown = solve(trace, theory, time_limit=LIMIT), hidden(trace, steps)
    after = solve(unknown, theory, time_limit=LIMIT)
    for ssh_map in after.maps:
        assert check(unknown, ssh_map, theory) == ()
        assert not any(
            fault.kind == "misread" and unknown.views[fault.step] is None
            for fault in ssh_map.faults
        )
    if before.cost:
        assert after.cost
        costs = [
            solution.cost.faults + solution.cost.dstates
            for solution in (before, after)
            if solution.cost
        ]
        assert costs[1] <= costs[0]


def test_unknown_step_does_not_merge_two_views() -> None:
    """The step between could be at either dstate, but not at both."""
    trace = Trace.from_steps(["a", None, "b"], ["stay", "stay"])
    found = solve(trace, Theory.causal(), max_maps=None)
    assert {m.labels for m in found.maps} == {(0, 0, 1), (0, 1, 1)} - {
        (0, 0, 1)
    }  # after the first, the same action would lead to b
    assert [s.view for s in found.maps[0].dstates] == ["a", "b"]


def test_dstate_without_a_known_view_has_none(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    trace = Trace.from_steps([None if t == 2 else view for t, view in enumerate(CORRIDOR)], DRIVEN)
    (ssh_map,) = solve(trace, Theory.topological(), max_maps=None).maps
    assert [s.view for s in ssh_map.dstates] == ["end", "hall", None, "end", "hall", "end"]
    ssh_map.save(tmp_path / "map.json")
    assert SSHMap.load(tmp_path / "map.json") == ssh_map
    for text in (to_svg(ssh_map), to_dot(ssh_map), ssh_map._repr_html_()):
        assert "None" not in text
    assert "None" not in to_graphml(ssh_map)
    trace.save(tmp_path / "trace.jsonl")
    assert main(["solve", str(tmp_path / "trace.jsonl"), "--json"]) == 0
    (tmp_path / "maps.json").write_text(capsys.readouterr().out)
    for words in (
        ["show"],
        ["view", "-o", str(tmp_path / "page.html")],
        *(["export", "--to", to] for to in ("nav2", "tmap2", "graphml", "dot", "networkx-json")),
    ):
        assert main([words[0], str(tmp_path / "maps.json"), *words[1:]]) == 0
        assert "None" not in capsys.readouterr().out
    assert main(["check", str(tmp_path / "maps.json"), str(tmp_path / "trace.jsonl")]) == 0
    files = [str(tmp_path / name) for name in ("maps.json", "trace.jsonl")]
    assert main(["check", "--bound", *files]) == 0
    assert "a step whose view is unknown may be any dstate" in capsys.readouterr().out


def test_null_view_is_unknown_and_a_missing_view_an_error(tmp_path: Path) -> None:
    path = tmp_path / "trace.jsonl"
    path.write_text(
        HEAD + '{"view": "a", "action": "go"}\n{"view": null, "action": "go"}\n{"view": "null"}\n'
    )
    trace = Trace.load(path)
    assert trace.views == ("a", None, "null")
    trace.save(path)
    assert Trace.load(path).steps == trace.steps
    path.write_text(HEAD + '{"view": "a", "action": "go"}\n{"vew": "b"}\n')
    with pytest.raises(
        TraceError, match=r"3: view: expected a text .* or null where that was not logged"
    ):
        Trace.load(path)
    unseen = Trace.from_steps([None, None], ["go"])
    with pytest.raises(TraceError, match="view: expected one, got none in any step; give"):
        solve(unseen)
    steps = tuple(replace(step, image=(1.0, 2.0)) for step in unseen.steps)
    with pytest.raises(TraceError, match="view: expected one, got only an image; cluster"):
        solve(replace(unseen, steps=steps))


def test_solve_names_corrections_that_steps_without_views_contradict(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    trace = Trace.from_steps(["a", None, None], ["around", "travel"], name="monday")
    solution = solve(trace, Theory(same=((1, 2),)), time_limit=1e-9)
    assert (solution.status, len(solution.maps)) == (Status.UNSATISFIABLE, 0)
    file, maps = str(tmp_path / "trace.jsonl"), str(tmp_path / "maps.json")
    trace.save(file)
    assert main(["solve", file, "-o", maps]) == 0
    assert main(["correct", str(tmp_path), "--same", "monday:1,monday:2"]) == 0
    assert main(["solve", file, "-o", maps]) == 20
    assert "same: monday:1, monday:2: it contradicts the trace\n" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("theory", "driven"),
    [
        (Theory.causal(), TOUR),
        (Theory.topological(), TOUR),
        (Theory.circumscriptive(), TOUR),
        (Theory.topological(), TURNED),
        (Theory(star="gateways"), TURNED),
    ],
)
def test_unknown_views_at_the_time_limit_give_a_map(theory: Theory, driven: Trace) -> None:
    trace = hidden(driven, set(range(1, len(driven), 3)))
    found = solve(trace, theory, time_limit=1e-9)
    assert found.maps
    assert check(trace, found.maps[0], theory) == ()


def test_speedups_that_read_views_are_off() -> None:
    theory = settle(Trace.from_steps(["a", None], ["travel"])).theory
    kept = {
        "path_names",
        "sides",
        "lazy",
        "core_guided",
        "greedy",
        "digest",
    }
    assert {row.name for row in TABLE if row.holds_for(theory)} <= kept


def test_online_mapper_refuses_unknown_views() -> None:
    with pytest.raises(TraceError, match="view: expected one while a robot drives, got none"):
        OnlineMapper("a", Theory.causal()).observe("go", None)  # type: ignore[arg-type]
    with pytest.raises(TraceError, match="view: expected one while a robot drives, got none"):
        OnlineMapper(None, Theory.causal())  # type: ignore[arg-type]


def test_unknown_views_do_not_separate_rivals() -> None:
    trace = Trace.from_steps(["a", None, "a", "b", "a"], ["x", "y", "x", "y"])
    solution = solve(trace, Theory.causal().replace(prefer=()), max_maps=None)
    assert solution.count > 1
    assert json.loads(json.dumps(compare(solution).to_dict()))
    plan = next_experiment(solution, trace).to_dict()["plan"]
    assert {expected["how"] for expected in plan["untried"]["expects"]} == {"link", "open"}
    assert all(
        (expected["view"] is None) == (expected["how"] == "open")
        for expected in plan["untried"]["expects"]
    )


def test_certificate_does_not_use_unknown_views() -> None:
    trace = Trace.from_steps(["a", None, "b"], ["go", "go"])
    assert solve(trace, Theory.causal()).certificate is None
    assert check_bound(trace, {"clique": [0, 1], "refuted": []}).faults
    assert not check_bound(trace, {"clique": [0, 2], "refuted": []}).faults


def test_compare_accepts_different_views_at_unknown_steps() -> None:
    views = ["a", "a", "b", "a", None, "b", None]
    trace = Trace.from_steps(views, ["travel", "around"] * 3)
    one, other = solve(trace), solve(trace, Theory.causal())
    others = compare(one, other).others
    assert others is not None
    assert (others.here, len(others.there)) == ((1,), len(other))
    with pytest.raises(MapError, match="the view None at step 4, as the first maps have, got 'a'"):
        compare(one[0], other[0])
