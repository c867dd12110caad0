"""Faults: misread views and stars, and actions that slipped, against brute force, the checker, and
machines with known faults."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from dataclasses import replace
from itertools import accumulate, pairwise, product
from pathlib import Path
from unittest.mock import patch

import pytest
from brute_force import key, minimal_maps, partitions
from hypothesis import given, settings
from hypothesis import strategies as st
from instances import faulty_machine

from ssh_abduction import Theory, Trace, solve
from ssh_abduction.checker.checker import check
from ssh_abduction.cli import main
from ssh_abduction.data import Step
from ssh_abduction.data.errors import MapError, TheoryError
from ssh_abduction.data.maps import Fault, SSHMap
from ssh_abduction.solution import Status
from ssh_abduction.solver.sources.exact import choosing, faulty
from ssh_abduction.solver.sources.exact.engine import Task
from ssh_abduction.theory import Speedups
from ssh_abduction.theory.settle import Problem

Told = tuple[
    tuple[int, ...], frozenset[tuple[int, str, object]]
]  # the labels of the steps, and the faults


@st.composite
def small_traces(draw: st.DrawFn, max_steps: int = 6) -> Trace:
    steps = draw(st.integers(1, max_steps))
    seen = draw(st.lists(st.sampled_from("ab"), min_size=steps, max_size=steps))
    trace = Trace.from_steps(
        seen,
        draw(
            st.lists(st.sampled_from(["travel", "right"]), min_size=steps - 1, max_size=steps - 1)
        ),
    )
    return trace.with_views(
        seen,
        draw(st.lists(st.sampled_from([None, None, 0.9, 0.4]), min_size=steps, max_size=steps)),
    )


# By the confidence of a view: the share of the price of a fault. For 0.9 it is log(0.9 / 0.1) /
# log 99, and for 0.4 the least share.
SHARE = {None: 1.0, 0.9: 0.478, 0.4: 0.1}


def price_of(misread: int, step: Step) -> int:
    return max(round(misread * SHARE[step.confidence]), 1)


def votes(
    trace: Trace, labels: tuple[int, ...]
) -> tuple[dict[int, Counter[object]], dict[tuple[int, str], Counter[int]]]:
    """Count the views at each dstate, and the ends of each action there."""
    views, ends = defaultdict(Counter), defaultdict(Counter)
    for label, view in zip(labels, trace.views, strict=True):
        views[label][view] += 1
    for (s, x), action in zip(pairwise(labels), trace.actions, strict=False):
        ends[s, action.name][x] += 1
    return views, ends


def cheapest(trace: Trace, misread: int, slipped: int) -> tuple[int | None, set[Told]]:
    """The least cost in tenths, and all causal maps with it. All labels, views of dstates and ends
    of actions are tried."""
    best: int | None = None
    maps: set[Told] = set()
    for labels in partitions(len(trace)):
        views, ends = votes(trace, labels)
        for shows in product(*(list(views[s]) for s in sorted(views))):
            for targets in product(*(list(counts) for counts in ends.values())):
                goes = dict(zip(ends, targets, strict=True))
                wrong = frozenset(
                    (t, "misread", shows[s])
                    for t, s in enumerate(labels)
                    if trace.views[t] != shows[s]
                )
                slips = frozenset(
                    (t, "slipped", None)
                    for t, a in enumerate(trace.actions)
                    if goes[labels[t], a.name] != labels[t + 1]
                )
                if (wrong and not misread) or (slips and not slipped):
                    continue
                cost = (
                    10 * len(views)
                    + sum(price_of(misread, trace.steps[t]) for t, _, _ in wrong)
                    + slipped * len(slips)
                )
                if best is None or cost < best:
                    best, maps = cost, set()
                if cost == best:
                    maps.add((labels, wrong | slips))
    return best, maps


def labels_and_faults(ssh_map: SSHMap) -> Told:
    return ssh_map.labels, frozenset(
        (fault.step, fault.kind, fault.expected) for fault in ssh_map.faults
    )


@settings(max_examples=15)
@given(
    small_traces(),
    st.sampled_from([0.0, 0.4, 1.0]),
    st.sampled_from([0.0, 0.3, 1.0]),
    st.booleans(),
)
def test_causal_maps_with_faults_equal_the_brute_force(
    trace: Trace, misread: float, slipped: float, names: bool
) -> None:
    """The solver uses names, or the readable encoding. Costs of whole dstates make ties."""
    theory = Theory.causal().replace(misread=misread, slipped=slipped)
    solution = solve(
        trace, theory, max_maps=None, speedups=Speedups() if names else Speedups.without("names")
    )
    cost, expected = cheapest(trace, round(10 * misread), round(10 * slipped))
    assert solution.complete
    assert solution.cost is not None
    assert solution.cost.tenths == cost
    assert {labels_and_faults(ssh_map) for ssh_map in solution.maps} == expected
    assert len(solution.maps) == len(expected)
    assert all(check(trace, ssh_map, theory) == () for ssh_map in solution.maps)


@settings(max_examples=5)
@given(st.data())
def test_few_names_and_short_prefixes_do_not_change_answers(data: st.DataObject) -> None:
    trace = data.draw(small_traces(max_steps=7))
    theory = Theory.causal().replace(
        misread=data.draw(st.sampled_from([0.0, 0.4, 1.0])),
        slipped=data.draw(st.sampled_from([0.3, 1.0])),
    )
    with (
        patch.multiple(
            faulty,
            FIRST=data.draw(st.sampled_from([1, 2, 10])),
            LONG=data.draw(st.sampled_from([2, 3, 10])),
            PATIENCE=data.draw(st.sampled_from([1, 1000])),
        ),
        patch.multiple(faulty, PLACES=1, AROUND=0, NAMES=1, MORE_NAMES=1),
        patch.object(choosing, "FEW_STEPS", 0),
    ):
        solution = solve(trace, theory, max_maps=None)
    cost, expected = cheapest(trace, round(10 * theory.misread), round(10 * theory.slipped))
    assert solution.cost is not None
    assert solution.cost.tenths == cost
    assert {labels_and_faults(ssh_map) for ssh_map in solution.maps} == expected


@settings(max_examples=5)
@given(small_traces(max_steps=4), st.sampled_from([0.4, 1.0]))
def test_topological_maps_with_faults_equal_the_brute_force(trace: Trace, misread: float) -> None:
    """Try every correction of views. The brute force, which has no faults, maps the corrected
    traces."""
    theory = Theory(boundary="none", star="none")
    best: tuple[int, ...] | None = None
    expected: set[object] = set()
    for views in product("ab", repeat=len(trace)):
        wrong = sum(
            price_of(round(10 * misread), step)
            for a, step in zip(views, trace.steps, strict=True)
            if a != step.view
        )
        corrected = replace(
            trace,
            steps=tuple(
                replace(step, view=view) for step, view in zip(trace.steps, views, strict=True)
            ),
        )
        counts, maps = minimal_maps(corrected, theory)
        if counts is None:
            continue
        cost = 10 * counts.dstates + wrong, counts.paths, counts.places
        seen = {
            (k, views)
            for k in maps
            if all(
                any(x == s and views[t] == trace.views[t] for t, x in enumerate(k[0])) for s in k[0]
            )
        }
        if seen and (best is None or cost < best):
            best, expected = cost, set()
        if cost == best:
            expected |= seen
    faulty = theory.replace(misread=misread)
    solution = solve(trace, faulty, max_maps=None)
    found = {(key(m), tuple(m.dstates[s].view for s in m.labels)) for m in solution.maps}
    assert solution.complete
    assert (solution.cost is None) == (best is None)
    assert found == expected
    assert all(check(trace, m, faulty) == () for m in solution.maps)


@pytest.mark.parametrize("seed", range(4))
def test_solve_finds_the_faults_of_machines(seed: int) -> None:
    walk, wrong, jumps = faulty_machine(
        6, 5, steps=200, seed=910 + seed, wrong=seed % 2, jumps=1 - seed % 2
    )
    theory = Theory.causal().replace(misread=1.5 if wrong else 0.0, slipped=1.5 if jumps else 0.0)
    solution = solve(walk.trace, theory)
    assert solution.status is Status.OPTIMAL
    assert solution.cost is not None
    assert (solution.cost.dstates, solution.cost.faults) == (6, 1.5)
    assert any(
        [fault.step for fault in ssh_map.faults] == [*wrong, *jumps] for ssh_map in solution.maps
    )


@settings(max_examples=10)
@given(st.data())
def test_bounds_by_blocks_do_not_exceed_the_minimum(data: st.DataObject) -> None:
    trace = data.draw(small_traces(max_steps=7))
    theory = Theory.causal().replace(
        misread=data.draw(st.sampled_from([0.4, 1.0])),
        slipped=data.draw(st.sampled_from([0.3, 1.0])),
    )
    task = Task.of(Problem.of(trace, theory))
    price = {
        kind: [theory.fault_tenths(kind, step) for step in trace.steps]
        for kind in ("misread", "slipped")
    }
    blocks = faulty.Blocks(task.log.seen, task.log.actions, price, task.watch)
    cost, _ = cheapest(trace, round(10 * theory.misread), round(10 * theory.slipped))
    assert cost is not None
    assert blocks.bound(cost + data.draw(st.integers(0, 20))) <= cost
    assert blocks.bound(cost - 1) <= cost - 1
    assert blocks.least_faults(len(trace)) == 0


@pytest.mark.parametrize("kind", ["misread", pytest.param("slipped", marks=pytest.mark.slow)])
def test_solve_proves_many_faults_of_a_long_trace(kind: str) -> None:
    """A rectangle of eight dstates and five views, 1,200 steps and twelve faults. The bounds of
    disjoint blocks add up to the cost of the map."""
    wrong = range(60, 1200, 100)
    at = list(
        accumulate(
            (3 if kind == "slipped" and t in wrong else 1 for t in range(1, 1200)), initial=0
        )
    )
    seen = ["v4" if s % 8 == 4 else f"v{s % 4}" for s in at]
    for t in wrong if kind == "misread" else ():
        seen[t] = "v3" if seen[t] != "v3" else "v2"
    trace = Trace.from_steps(seen, ["right", "travel"] * 599 + ["right"])
    solution = solve(trace, Theory.causal().replace(**{kind: 1.5}), max_maps=1)
    assert solution.status is Status.OPTIMAL
    assert solution.cost is not None
    assert (solution.cost.dstates, len(solution.maps[0].faults)) == (8, 12)


def test_solve_finds_a_misread_star() -> None:
    """Out and back along a corridor. At one end the robot sees one opening too many."""
    ends = [(1, 0, 0, 0), (0, 0, 1, 0)]
    stars = [*ends * 4, ends[0]]
    stars[4] = (1, 1, 0, 0)
    trace = Trace.from_steps("abcdabcda", ["travel", "around"] * 4, stars=stars)
    solution = solve(trace, Theory(misread=1.5, star="frame"))
    assert solution.cost is not None
    assert (solution.cost.dstates, solution.cost.places, solution.cost.faults) == (4, 2, 1.5)
    assert solution.maps[0].faults == (Fault(4, "misseen"),)
    assert check(trace, solution.maps[0], Theory(misread=1.5)) == ()
    assert {
        v.axiom for v in check(trace, replace(solution.maps[0], faults=()), Theory(misread=1.5))
    } == {"star_frame", "star_pattern"}


RECTANGLE = Trace.from_steps(
    [f"v{t % 4}" if t != 9 else "v0" for t in range(25)], ["right", "travel"] * 12
)


def test_checker_recomputes_faults() -> None:
    theory = Theory.causal().replace(misread=1.5)
    ssh_map = solve(RECTANGLE, theory).maps[0]
    assert [str(fault) for fault in ssh_map.faults] == [
        "the view at step 9 is misread: v0, expected v1"
    ]
    assert SSHMap.from_dict(ssh_map.to_dict()) == ssh_map
    assert {v.axiom for v in check(RECTANGLE, ssh_map, Theory.causal())} == {"map_explains_trace"}
    for faults in (
        (),
        (Fault(9, "misread", "v0", "v2"),),
        (*ssh_map.faults, *ssh_map.faults),
        (*ssh_map.faults, Fault(3, "slipped", "travel")),
        (*ssh_map.faults, Fault(99, "misread", "v0", "v1")),
        (replace(ssh_map.faults[0], cost=0.1),),
    ):
        assert check(RECTANGLE, replace(ssh_map, faults=faults), theory)
    with pytest.raises(MapError, match=r"faults\[0\].kind: expected misread or misseen or slipped"):
        SSHMap.from_dict({**ssh_map.to_dict(), "faults": [{"step": 9, "kind": "wrong"}]})


@pytest.mark.parametrize(
    ("choices", "said"),
    [
        ({"misread": -1.0}, "misread: expected a number of dstates from 0.1"),
        ({"slipped": float("nan")}, "slipped: expected a number"),
        ({"misread": 1.5, "prefer": ("paths",)}, "prefer: expected dstates first"),
        ({"misread": 1.5, "star": "gateways"}, "star: expected another value where misread"),
        ({"misread": 1.5, "boundary": "defeasible"}, "boundary: expected no excuses"),
        ({"misread": 1.5, "planar": True}, "planar: expected no planarity"),
    ],
)
def test_theories_that_exclude_faults_are_refused(choices: dict[str, object], said: str) -> None:
    with pytest.raises(TheoryError, match=said):
        Theory(**choices)  # type: ignore[arg-type]


def test_solve_prints_faults(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    RECTANGLE.save("trace.jsonl")
    command = ["solve", "trace.jsonl", "--theory", "causal", "--set", "misread=1.5"]
    assert main([*command, "--set", "slipped=3"]) == 0
    said = capsys.readouterr().out
    assert "4 dstates, and the view at step 9 is misread: v0, expected v1" in said
    assert main([*command, "--json"]) == 0
    text = capsys.readouterr().out
    Path("maps.json").write_text(text)
    answer = json.loads(text)
    assert answer["maps"][0]["faults"] == [
        {"step": 9, "kind": "misread", "seen": "v0", "expected": "v1", "cost": 1.5}
    ]
    assert answer["cost"]["faults"] == 1.5
    assert main(["check", "maps.json", "trace.jsonl"]) == 0
    assert main(["check", "--bound", "maps.json", "trace.jsonl"]) == 0
    assert "that no better map exists is not checked" in capsys.readouterr().out


def test_confidence_of_a_view_scales_the_cost_of_a_fault() -> None:
    """A confidence of 0.99 costs the whole price, as does a step without a confidence. For others
    the share is by the log odds, between a tenth and five times."""
    shares = {None: 15, 0.99: 15, 0.9: 7, 0.6: 2, 0.5: 2, 0.0: 2, 0.999: 23, 1.0: 75}
    assert {
        c: Theory(misread=1.5).fault_tenths("misread", Step("a", confidence=c)) for c in shares
    } == shares
    assert Theory(slipped=3).fault_tenths("slipped", Step("a", confidence=0.5)) == 30
    assert Theory().fault_tenths("misread", Step("a", confidence=0.5)) == 0
    doubtful = RECTANGLE.with_views(RECTANGLE.views, [0.6 if t == 9 else None for t in range(25)])
    theory = Theory.causal().replace(misread=9.3)
    assert solve(RECTANGLE, theory).cost.faults == 0  # type: ignore[union-attr]
    solution = solve(doubtful, theory)
    assert [(fault.step, fault.cost) for fault in solution.maps[0].faults] == [(9, 0.9)]
    assert solution.cost is not None
    assert solution.cost.faults == 0.9


def test_solve_with_faults_at_a_time_limit_gives_map_and_bound() -> None:
    walk, _, _ = faulty_machine(20, 8, steps=300, seed=1, wrong=3)
    solution = solve(walk.trace, Theory.causal().replace(misread=1.5), time_limit=0.3)
    assert solution.status in (Status.FEASIBLE, Status.OPTIMAL)
    assert solution.cost is not None
    assert (solution.bound.tenths or 0) <= solution.cost.tenths
    assert check(walk.trace, solution.maps[0], Theory.causal().replace(misread=1.5)) == ()
