"""Recovery from faults: exact after each step, and certain again when the evidence suffices."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise
from typing import Any

import pytest
import recovery as bench
from fault_cases import rectangle_of_five
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import TOYS
from test_faults import cheapest, labels_and_faults, small_traces
from test_online import NO_TIME, followed

from ssh_abduction import OnlineMapper, Theory, Trace, solve
from ssh_abduction.checker.checker import check
from ssh_abduction.data import TheoryError, TraceError
from ssh_abduction.online import Belief
from ssh_abduction.online.keeper import ExtendedMap
from ssh_abduction.online.recovery import shares_of_rivals
from ssh_abduction.solution import Solution, Status
from ssh_abduction.theory.encodings import Rules

BOTH = Theory.causal().replace(misread=1.5, slipped=3)


def circuit(steps: int, wrong: int | None = None, seen: str = "v3") -> Trace:
    """A drive around a rectangle with four views. One view may be wrong."""
    return Trace.from_steps(
        [seen if t == wrong else f"v{t % 4}" for t in range(steps + 1)],
        [("right", "travel")[t % 2] for t in range(steps)],
    )


@settings(max_examples=6)
@given(
    small_traces(max_steps=7), st.sampled_from([0.0, 0.4, 1.0]), st.sampled_from([0.0, 0.3, 1.0])
)
def test_online_maps_with_faults_equal_the_brute_force(
    trace: Trace, misread: float, slipped: float
) -> None:
    if not misread and not slipped:
        return
    for mapper, solution in followed(
        trace, Theory.causal().replace(misread=misread, slipped=slipped)
    ):
        cost, expected = cheapest(
            trace.prefix(solution.steps), round(10 * misread), round(10 * slipped)
        )
        assert solution.status is Status.OPTIMAL
        assert solution.complete
        assert solution.cost is not None
        assert (solution.cost.tenths, solution.bound.tenths) == (cost, cost)
        assert {labels_and_faults(ssh_map) for ssh_map in solution.maps} == expected
        assert len(solution.maps) == len(expected)
        if mapper.standing.certain:
            futures = {
                ExtendedMap.of(ssh_map, mapper.trace, mapper.theory).future()
                for ssh_map in solution.maps
            }
            assert len(futures) == 1


@settings(max_examples=5)
@given(st.data())
def test_online_maps_with_faults_obey_assertions_and_stars(data: st.DataObject) -> None:
    """With asserted pairs of steps, or places with stars, the maps are those of solving anew."""
    trace = data.draw(small_traces(max_steps=5))
    prices = {
        "misread": data.draw(st.sampled_from([0.0, 0.4, 1.0])),
        "slipped": data.draw(st.sampled_from([0.3, 1.0])),
    }
    if data.draw(st.booleans(), label="places"):
        stars = data.draw(
            st.lists(
                st.sampled_from([(1, 0, 0, 0), (1, 1, 0, 0)]),
                min_size=len(trace),
                max_size=len(trace),
            )
        )
        trace = Trace.from_steps(
            trace.views, [action.name for action in trace.actions], stars=stars
        )
        theory = Theory(**prices, star="frame")
    else:
        pairs = [pair for pair in [(0, 2), (1, 3)] if max(pair) < len(trace)]
        theory = Theory.causal().replace(
            **prices, **{data.draw(st.sampled_from(["same", "different"])): pairs}
        )
    for _, solution in followed(trace, theory):
        anew = solve(
            trace.prefix(solution.steps), theory.of_steps(0, solution.steps), max_maps=None
        )
        assert (solution.status, solution.complete) == (anew.status, True)
        assert {(m, m.faults) for m in solution.maps} == {(m, m.faults) for m in anew.maps}
        assert len(solution.maps) == len(anew.maps)


def test_mapper_with_faults_solves_anew_without_an_axiom() -> None:
    theory = Theory.causal().replace(misread=0.4, without=("deterministic",))
    for _, solution in followed(Trace.from_steps("abaabb", ["travel"] * 5), theory):
        anew = solve(
            Trace.from_steps("abaabb", ["travel"] * 5).prefix(solution.steps), theory, max_maps=None
        )
        assert (solution.status, solution.complete) == (anew.status, True)
        assert {(m, m.faults) for m in solution.maps} == {(m, m.faults) for m in anew.maps}


# For traces of up to three steps, each step is a dstate of its own. Then anything goes.
LATE = Rules(
    "late.lp",
    "% @axiom(late) A toy.\n#program check(t).\n"
    "violation(late,t) :- query(t), t < 3, N = #count { S : is(S,S) }, N <= t.",
)
EVEN = next(toy.rules for toy in TOYS if toy.rules.name == "even.lp")


@cache
def solved(trace: Trace, theory: Theory) -> Solution:
    """The minimal maps; several tests need them."""
    return solve(trace, theory)


@pytest.mark.parametrize(
    ("choices", "limit"),
    [
        ({"rules": (EVEN,)}, None),
        ({"rules": (LATE,)}, 60.0),
        ({"same_place": ((0, 3),)}, None),
        ({"same_place": ((0, 3),)}, 60.0),
    ],
)
def test_mapper_with_faults_forgets_answers_that_later_steps_may_undo(
    choices: dict[str, Any], limit: float | None
) -> None:
    """A longer trace may have a map although a shorter one has none, or a cheaper one."""
    trace = Trace.from_steps("aaaaaa", ["around", "travel", "around", "around", "around"])
    theory = Theory(slipped=1.5, **choices)
    for steps, (_, answer) in enumerate(followed(trace, theory, limit), 1):
        expected = solved(trace.prefix(steps), theory.of_steps(0, steps))
        assert (answer.status, answer.cost) == (expected.status, expected.cost)
        assert answer.bound == expected.bound


def test_mapper_reports_and_excuses_a_wrong_view() -> None:
    for mapper, solution in followed(circuit(30, wrong=17), BOTH):
        t, standing = solution.steps - 1, mapper.standing
        assert sum(hypothesis.weight for hypothesis in standing.hypotheses) == pytest.approx(1)
        assert standing.certain == (t != 17)
        if t == 17:
            assert standing.broke == (
                "step 17: seen v3, expected v1 at dstate 1: misread, slipped, or the map is wrong",
            )
            assert [h.said for h in standing.hypotheses] == [
                "the view at step 17 is misread: v3, expected v1; the robot is at dstate 1 of 4",
                "the action at step 16 slipped: right; the robot is at dstate 3 of 4",
            ]
            assert isinstance(standing.where, Belief)
            assert str(standing).startswith(
                "uncertain, most likely: the view at step 17 is misread"
            )
        else:
            assert standing.broke == (() if t != 18 else standing.broke[:1])
    assert [str(fault) for fault in solution.maps[0].faults] == [
        "the view at step 17 is misread: v3, expected v1"
    ]
    assert mapper.searches < 6  # what is predicted is replayed


@pytest.mark.parametrize("fault", ["wrong", "jumps"])
def test_mapper_becomes_certain_and_right_after_a_fault(fault: str) -> None:
    record = bench.run(rectangle_of_five(0, steps=60, **{fault: 1}), BOTH, limit=5)
    assert (record["noticed"], record["right_again"], record["right"], record["found"]) == (
        0,
        True,
        True,
        [True],
    )


def test_mapper_reports_a_misread_star() -> None:
    stars = [(1, 0, 0, 0), (0, 0, 1, 0)] * 7
    stars[6] = (1, 1, 0, 0)
    trace = Trace.from_steps("abcd" * 3 + "ab", (["travel", "around"] * 7)[:13], stars=stars)
    certain = []
    for mapper, solution in followed(trace, Theory(misread=1.5, star="frame")):
        certain.append(mapper.standing.certain)
        if solution.steps == 7:
            assert mapper.standing.broke == (
                "step 6: seen another star than expected at dstate 2: misread, or the map is wrong",
            )
    assert certain.index(False) == 6
    assert certain[-1]
    assert [str(fault) for fault in solution.maps[0].faults] == ["the star at step 6 is misread"]


def test_mapper_with_faults_and_no_time_has_a_map_and_belief() -> None:
    """Every search is stopped at once, and only the belief continues.

    Its maps are consistent and have a bound, but they are never certain.
    """
    trace = circuit(30, wrong=17)
    for mapper, solution in followed(trace, BOTH, NO_TIME):
        assert solution.status is Status.FEASIBLE
        assert solution.cost is not None
        assert (solution.bound.tenths or 0) <= solution.cost.tenths
        assert check(mapper.trace, solution.maps[0], BOTH) == ()
        assert not mapper.standing.certain
        assert sum(hypothesis.weight for hypothesis in mapper.standing.hypotheses) == pytest.approx(
            1
        )
    assert mapper.searches == 16  # at every other step


def test_mapper_with_faults_uses_later_displacements() -> None:
    """Maps are searched anew if the trace changes the settled theory."""
    mapper = OnlineMapper(
        "corner", Theory.causal().replace(misread=1.5), odometry={"along": 0.02}, time_limit=None
    )
    mapper.observe("travel", "wall")
    for _ in range(4):
        mapper.observe("left", "corner", displacement=(0.0, 0.0, 1.5708))
        solution = mapper.observe("travel", "wall", displacement=(10.0, 0.0, 0.0))
    anew = solve(mapper.trace, mapper.theory, max_maps=None)
    assert mapper.theory.displacement == "use"
    assert solution.status is Status.OPTIMAL
    assert {(m, m.faults) for m in solution.maps} == {(m, m.faults) for m in anew.maps}


def test_certain_map_may_leave_past_faults_undecided() -> None:
    """One of two actions in a row slipped. Nothing tells which one, but the map is certain."""
    for seed in range(40):
        for mapper, solution in followed(
            bench.machine(seed, jumps=1).walk.trace.prefix(60),
            Theory.causal().replace(slipped=1.5),
            1,
            100,
        ):
            if mapper.standing.certain and len({m.faults for m in solution.maps}) > 1:
                rivals = [ExtendedMap.of(m, mapper.trace, mapper.theory) for m in solution.maps]
                assert len({rival.future() for rival in rivals}) == 1
                assert len({rival.labels for rival in rivals}) > 1
                return
    pytest.fail("expected a trace whose maps differ in the step that slipped")


def test_rivals_are_weighed_by_faults_and_assumptions() -> None:
    trace = circuit(16)
    theory = Theory.causal().replace(misread=1.5, slipped=3)
    lead = ExtendedMap.of(solve(trace, theory).maps[0], trace, theory)
    step = trace.steps[1]
    wrong, slipped, new = lead.ways_on("right", replace(step, view="v2"), ("v2", None), theory)
    assert [rival.cost[0] for rival in (lead, wrong, slipped, new)] == [40, 55, 70, 80]
    shares = shares_of_rivals([wrong, slipped, new], theory, 0.01, dstates=4, views=4)
    assert shares[1] == pytest.approx(
        0.01 * shares[0]
    )  # twice the price, and as many dstates as views
    assert sum(shares) == pytest.approx(1)
    again = next(new.ways_on("travel", step, ("v3", None), theory))
    shares = shares_of_rivals([new, again], theory, 0.01, dstates=4, views=4)
    assert shares[1] == pytest.approx(shares[0] / 4)  # a link more, to one of four dstates


def test_refused_step_leaves_a_mapper_with_faults_unchanged() -> None:
    mapper = OnlineMapper("v0", BOTH, time_limit=None)
    before = mapper.observe("right", "v1")
    with pytest.raises(TraceError, match="action"):
        mapper.observe({"name": "right", "kind": "travel"}, "v2")
    assert mapper.solution is before
    assert repr(mapper) == "<OnlineMapper: 2 steps, optimal, 2 dstates>"
    with pytest.raises(TheoryError, match="expected a theory that allows faults"):
        _ = OnlineMapper("v0", Theory.causal()).standing


def test_weights_sum_to_one_and_ties_are_named() -> None:
    """Both kinds have one price. At first it is not known which fault it was."""
    walk = [
        mapper.standing
        for mapper, _ in followed(
            circuit(18, wrong=17), Theory.causal().replace(misread=1.5, slipped=1.5)
        )
    ]
    assert all(
        first.weight >= second.weight
        for standing in walk
        for first, second in pairwise(standing.hypotheses[:-1])
    )
    assert {h.said.partition(":")[0] for h in walk[17].hypotheses} >= {
        "the view at step 17 is misread",
        "the action at step 16 slipped",
    }
    assert not walk[17].certain
