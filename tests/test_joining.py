"""Maps of single drives are joined to one map."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from unittest.mock import patch

import changes
import numpy as np
import pytest
import truth
from together import of_mazes
from turns import guessed

from ssh_abduction import SSHMap, Theory, Trace, solve
from ssh_abduction.checker.checker import violations
from ssh_abduction.checker.cost_claims import false_costs
from ssh_abduction.data import Action, Closure, Odometry, Step, together
from ssh_abduction.data.drives import drive_of_steps
from ssh_abduction.data.star import Gateway, Star
from ssh_abduction.solver.costs import beams
from ssh_abduction.solver.costs.estimating import groups_of_drives, may_join_more, rival_of
from ssh_abduction.solver.costs.misfit import Misfit
from ssh_abduction.solver.search import Search
from ssh_abduction.solver.sources.metric.hypothesis import conditioned
from ssh_abduction.solver.sources.metric.joint_drives import Joining
from ssh_abduction.solver.sources.metric.overlay import KeptApart
from ssh_abduction.solver.sources.metric.sights import Sights
from ssh_abduction.solver.steps.log import Log
from ssh_abduction.theory import prior
from ssh_abduction.theory.settle import Problem, settle

NOISE = truth.Noise(Odometry(**truth.NOISE))
# Joining was developed on seeds below 100.
MAZES = [*of_mazes(4, 40, range(310, 312), NOISE)]


def joined(problem: Problem) -> list[SSHMap]:
    return [*Joining(problem, Log(problem.trace, problem.theory, problem.pairs)).maps()]


def along(*drives: str) -> Trace:
    """Drives along a line that see some views."""
    way = (5.0, 0.0, 0.0)
    counts = [len(views) - 1 for views in drives]
    return together(
        Trace.from_steps(views, ["travel"] * count, displacements=[way] * count)
        for views, count in zip(drives, counts, strict=True)
    )


def street_tour(route: str, at: Mapping[str, tuple[float, float]], streets: set[str]) -> Trace:
    """A drive along straight streets, with all streets of each place as its star.

    `at` has the position of each place in metres. All dead ends have the view "end".
    """

    def bearing(here: str, there: str) -> float:
        return math.degrees(math.atan2(at[there][1] - at[here][1], at[there][0] - at[here][0]))

    def seen(place: str, heading: float) -> Step:
        ways = [name for name in at if name + place in streets or place + name in streets]
        bearings = sorted((heading - bearing(place, way)) % 360 for way in ways)
        star = tuple(Gateway(b, 0.75) for b in bearings)
        return Step("end" if len(ways) == 1 else place, star=star)

    heading = bearing(*route[:2])
    steps = [seen(route[0], heading)]
    for here, there in pairwise(route):
        turn = math.remainder(bearing(here, there) - heading, 360)
        if turn:
            kind = "around" if abs(turn) == 180 else "left" if turn > 0 else "right"
            steps[-1] = replace(steps[-1], action=Action(f"{kind} {turn:.0f}", "turn", kind))
            heading += turn
            steps.append(replace(seen(here, heading), displacement=(0, 0, math.radians(turn))))
        steps[-1] = replace(steps[-1], action=Action("travel", "travel"))
        steps.append(
            replace(seen(there, heading), displacement=(math.dist(at[here], at[there]), 0, 0))
        )
    return Trace(tuple(steps))


@pytest.mark.parametrize(
    "stars",
    [True, pytest.param(False, marks=pytest.mark.slow)],
    ids=["stars", "no stars"],
)
@pytest.mark.parametrize("known", [MAZES[0], pytest.param(MAZES[1], marks=pytest.mark.slow)])
def test_joined_map_costs_at_most_as_much_as_the_true_one(known: truth.Known, stars: bool) -> None:
    problem = settle(known.trace, Theory(star="auto" if stars else "none"))
    misfit = Misfit(problem)

    def nats(dstates: tuple[int, ...], places: tuple[int, ...]) -> float:
        counts = len(set(dstates)) + len(set(places))
        return 8 * counts + misfit.of_course(dstates, places) / 2

    apart, *others, best = joined(problem)
    assert len(apart.pieces) == 3
    for ssh_map in (apart, *others, best):
        assert not [*violations(problem.trace, ssh_map, problem.theory)]
    places = [best.dstates[label].place for label in best.dstate_at]
    found = nats(best.dstate_at, truth.partition(places))
    assert found <= nats(truth.partition(known.dstates), truth.partition(known.places)) + 1e-6


@pytest.mark.slow
def test_joined_map_names_the_gateways_that_changed() -> None:
    case = changes.case(4, 60, 513, 3, 8)
    problem = settle(case.known.trace, Theory(changed=1.2, star="frame"))
    *_, best = joined(problem)
    assert truth.is_true(best, case.known)
    assert case.changed
    assert {*changes.named(best, case.known)} == case.changed
    assert not [*violations(problem.trace, best, problem.theory)]


def test_gateway_that_closes_and_opens_again_costs_two_changes() -> None:
    end = [(1, 0, 1, 0)]
    drives = [
        Trace.from_steps(
            "abcdefg"[:length],
            ["travel"] * (length - 1),
            displacements=[(5.0, 0.0, 0.0)] * (length - 1),
            stars=[(1, is_open, 1, 0)] + end * (length - 1),
        )
        for is_open, length in ((1, 7), (0, 7), (1, 6))
    ]
    problem = settle(together(drives), Theory(changed=0.9))
    *_, ssh_map = joined(problem)
    assert ssh_map.dstate_at == (*range(7), *range(7), *range(6))
    assert [(fault.step, fault.place, fault.gateway) for fault in ssh_map.faults] == [
        (7, 0, 1),
        (14, 0, 1),
    ]
    *_, ssh_map = joined(settle(together(drives), Theory()))
    assert len(ssh_map.dstates) == 8  # without changes, the first place is two


@pytest.mark.parametrize(
    ("bearings", "changed", "is_one"),
    [
        ((0.4, 5.3, 90.0), 0.0, True),
        ((355.0, 0.0, 85.0), 1.2, False),  # turned to the next gateway
        ((0.4, 90.3), 0.0, False),
        ((0.4, 90.3), 1.2, True),  # a gateway is closed
        ((0.4, 90.3, 200.0), 1.2, True),  # and another one is open
        ((0.4, 90.3, 200.0, 300.0), 1.2, False),  # too many changes
    ],
)
def test_sights_compare_gateways_by_bearing(
    bearings: tuple[float, ...], changed: float, is_one: bool
) -> None:
    stars = [Star(tuple(Gateway(b, 0.75) for b in seen)) for seen in ((0.0, 5.0, 90.0), bearings)]
    trace = together([Trace((Step("a", star=star.gateways),)) for star in stars])
    settled = settle(trace, Theory(changed=changed, star="gateways", boundary="none")).theory
    sights = Sights(trace, settled)
    assert sights.are_alike(*sights.shown) == is_one


def test_near_rooms_whose_doors_face_other_ways_stay_two() -> None:
    """Two dead ends are 1 m apart, and the ways into them are at right angles."""
    at = {"a": (0, 0), "b": (5, 0), "c": (12, 0), "d": (17, 0), "x": (8, 3), "y": (9, 3)}
    streets = {"ab", "bc", "cd", "bx", "cy"}
    drives = street_tour("abxbcd", at, streets), street_tour("abcycd", at, streets)
    *_, best = joined(settle(together(drives), Theory(boundary="none")))
    assert len(best.pieces) == 1
    assert len(best.places) == 6


def test_near_places_between_which_the_robot_travels_stay_two_in_a_joint_map() -> None:
    views, travel = "abcddefg", Action("travel", "travel")
    spread = ((0.2, 0, 0), (0, 0.2, 0), (0, 0, 0.01))
    moved = [Step(v, travel, displacement=(5.0, 0, 0), covariance=spread) for v in views]
    moved[4] = replace(moved[4], displacement=(0.5, 0, 0))
    moved[0] = Step(views[0], travel)
    moved[-1] = replace(moved[-1], action=None)
    shorter = [Step(views[1], travel), *moved[2:]]
    trace = together([Trace(tuple(moved)), Trace(tuple(shorter))])
    *_, best = joined(settle(trace, Theory(boundary="none")))
    assert best.labels == (0, 1, 2, 3, 4, 5, 6, 7, 1, 2, 3, 4, 5, 6, 7)


def test_kept_apart_holds_for_all_that_is_merged() -> None:
    apart = KeptApart({0: 0, 1: 1, 2: 2, 4: 3}, [(0, 2), (0, 3)])  # step 3 has no number
    assert apart.includes([0, 1, 1, 3], 0, 1)
    assert apart.includes([0, 1, 1, 3], 1, 0)
    assert not apart.includes([0, 1, 1, 3], 0, 3)


def test_drives_without_common_views_are_not_joined() -> None:
    monday = Trace.from_steps("abc", ["travel"] * 2, displacements=[(5.0, 0.0, 0.0)] * 2)
    tuesday = Trace.from_steps("xyz", ["travel"] * 2, displacements=[(5.0, 0.0, 0.0)] * 2)
    with pytest.warns(UserWarning, match="no view in common"):
        joint = together([monday, tuesday])
    *_, apart = joined(settle(joint, Theory()))
    assert [len(piece) for piece in apart.pieces] == [3, 3]


def test_causal_drives_that_cannot_share_a_dstate_stay_apart_for_sure() -> None:
    """Their first views are the same. Only stars may tell the dstates apart."""
    drives = [
        Trace.from_steps(
            views,
            ["travel"] * 3,
            displacements=[(5.0, 0.0, 0.0)] * 3,
            stars=[[ahead, 90, 180], [180], [180], [180]],
        )
        for views, ahead in (("abcd", 0), ("aefg", 40))
    ]
    for star, may_join in (("alike", False), ("none", True)):
        problem = settle(together(drives), Theory.causal().replace(star=star))
        rivals = [rival_of(ssh_map, 0.0) for ssh_map in joined(problem)]
        assert len({*groups_of_drives(rivals[-1].dstates, [0] * 4 + [1] * 4)}) == 2
        assert may_join_more(problem, rivals[-1:]) == may_join
        sights = Sights(problem.trace, problem.theory)
        assert sights.are_alike(sights.shown[0], sights.shown[4]) == may_join


@pytest.mark.parametrize("apart", [4.0, 9.0])
def test_crossing_drives_share_places(apart: float) -> None:
    """One drive leads east to a dead end, through a crossing. The other drive crosses it twice."""
    ahead, left = (4.0, 0.0, 0.0), (0.0, 0.0, math.pi / 2)
    east = Trace.from_steps(
        "abc",
        ["travel"] * 2,
        displacements=[ahead] * 2,
        stars=[(1, 0, 0, 0), (1, 1, 1, 1), (0, 1, 1, 1)],
    )
    corner = [(0, 0, 1, 1), (1, 0, 0, 1)]  # as seen before and after the turn
    south_and_north = Trace.from_steps(
        "defghijk",
        ["travel", "travel", "left", "travel", "left", "travel", "travel"],
        displacements=[ahead, ahead, left, (apart, 0.0, 0.0), left, ahead, ahead],
        stars=[(1, 0, 0, 0), (1, 1, 1, 1), *corner, *corner, (1, 0, 1, 1), (0, 0, 1, 0)],
    )
    with pytest.warns(UserWarning, match="no view in common"):
        trace = together([east, south_and_north])
    with (
        patch.object(prior, "FEWEST", 1.0),
        patch.object(prior, "UNSEEN", math.inf),
    ):  # two places may coincide by chance
        problem = settle(trace, Theory(star="frame"))
        *_, ssh_map = joined(problem)
    assert len(ssh_map.dstates) == len(trace)
    places = [s.place for s in ssh_map.dstates]
    crossings = [(1, 4), (2, 9)] if apart == 4.0 else []
    assert [(t, u) for t in range(3) for u in range(3, 11) if places[t] == places[u]] == crossings
    assert not [*violations(problem.trace, ssh_map, problem.theory)]


def test_drive_is_joined_where_later_steps_agree() -> None:
    """Both drives begin with "abc", and then see other things."""
    problem = settle(along("abcdabc", "abcx"), Theory())
    *_, ssh_map = joined(problem)
    assert ssh_map.dstate_at == (*range(7), 4, 5, 6, 7)
    assert not [*violations(problem.trace, ssh_map, problem.theory)]


def test_map_that_keeps_drives_apart_is_not_sure_if_they_may_share_a_dstate() -> None:
    apart = solve(along("abc", "a"))
    assert apart.weighed is not None
    assert 0.1 < apart.probability(0, 3) < 0.5
    assert len(apart.weighed.rivals) > 1


def test_drives_with_one_common_view_are_joined_only_by_a_closure() -> None:
    """One place may look like another by chance. A closure between them says that they are one."""
    joint = along("abcda", "ax")
    problem = settle(joint, Theory())
    rival, apart = sorted(joined(problem), key=lambda ssh_map: len(ssh_map.pieces))
    assert (len(rival.pieces), len(apart.pieces)) == (1, 2)
    assert Misfit(problem).nats_of(rival) > Misfit(problem).nats_of(apart)
    found = solve(joint, work_limit=0.3).maps[0]
    assert len(found.pieces) == 2
    exact = ((1e-4, 0.0, 0.0), (0.0, 1e-4, 0.0), (0.0, 0.0, 1e-4))
    closure = Closure(4, 5, (0.0, 0.0, 0.0), exact)
    found = solve(replace(joint, closures=(closure,)), work_limit=0.3).maps[0]
    assert found.dstate_at == (*range(5), 4, 5)


def test_closures_say_how_drives_lie_on_each_other() -> None:
    """All places look alike. By closures, the second drive comes the other way."""
    exact = ((0.01, 0.0, 0.0), (0.0, 0.01, 0.0), (0.0, 0.0, 0.001))
    closures = tuple(Closure(5 + k, 19 - k, (0.1, 0.0, math.pi), exact) for k in range(5))
    trace = replace(along("a" * 10, "a" * 11), closures=closures)
    *_, ssh_map = joined(settle(trace, Theory(star="none", boundary="none")))
    places = [ssh_map.place_of(t) for t in range(21)]
    assert len(set(places)) == 15  # six are shared
    assert all(places[closure.first] == places[closure.last] for closure in closures)


@pytest.mark.parametrize("seed", [312, pytest.param(313, marks=pytest.mark.slow)])
def test_joined_map_has_a_probability_without_a_broad_beam(seed: int) -> None:
    (known,) = of_mazes(3, 20, [seed], NOISE, drives=2)
    with patch.object(beams, "WIDTHS", (1,)):
        weighed = guessed(Search(known.trace)).weighed()
    assert weighed is not None
    assert weighed.searched
    assert weighed.broken == 0
    drives = drive_of_steps(weighed.drives)
    groups = {len({*groups_of_drives(rival.places, drives)}) for rival in weighed.rivals}
    assert 1 in groups
    assert 0 < weighed.confidence < 1


def test_all_ways_to_join_drives_are_rivals() -> None:
    """A short drive may be along the first or the second half of a corridor."""
    drives = [
        Trace.from_steps(
            views, ["travel"] * (len(views) - 1), displacements=[(5.0, 0, 0)] * (len(views) - 1)
        )
        for views in ("abcdxabcd", "abcd")
    ]
    first, second = drives
    for found in (
        solve(together(drives), work_limit=1.0),
        solve(second, onto=solve(first, work_limit=1.0), work_limit=1.0),
    ):
        assert found.weighed
        assert {0, 5} <= {rival.dstates[9] for rival in found.weighed.rivals}


@pytest.mark.parametrize(
    ("hides", "steps", "drives"), [(4, 40, 2), pytest.param(0, 60, 6, marks=pytest.mark.slow)]
)
def test_search_joins_drives_even_if_some_views_are_unknown(
    hides: int, steps: int, drives: int
) -> None:
    (known,) = of_mazes(4, steps, [315], NOISE, drives=drives)
    views = [None if hides and t % hides == 1 else v for t, v in enumerate(known.trace.views)]
    candidates = Search(known.trace.with_views(views)).parts.candidates
    joining = candidates.joining()
    assert joining is not None
    *_, ssh_map = candidates.accepted(joining.maps())
    assert truth.is_true(ssh_map, known)


def test_unknown_view_does_not_join_two_known_ones() -> None:
    trace = Trace.from_steps(["a", None, "b"], ["travel", "travel"])
    sights = Sights(trace, settle(trace, Theory(star="none")).theory)
    a, unknown, b = (dict.fromkeys([number], math.inf) for number in sights.seen)
    assert sights.merging(a, unknown) == 0.0
    assert sights.merging(a | unknown, a) == 0.0
    assert sights.merging(a | unknown, b | unknown) == math.inf
    assert sights.right({min(unknown): 3.0, min(b): 1.0, min(a): 2.0}) == min(a)


@pytest.mark.parametrize(("views", "is_sure"), [("abcdef", True), ("a" * 12, False)])
def test_joint_drives_are_not_sure_where_most_steps_look_alike(views: str, is_sure: bool) -> None:
    trace, theory = along(views, views[:4]), Theory(boundary="none")
    free, joint = (
        solve(trace, theory.replace(same=pairs), work_limit=1.0)
        for pairs in ((), ((0, len(views)),))
    )
    assert ((free.confidence or 0.0) > 0.95) == is_sure
    assert len(joint.maps[0].pieces) == 1
    answer = joint.to_dict()
    assert [*false_costs(trace, answer, joint.maps, joint.theory)] == []
    answer["weighed"]["nats"] -= 1.0
    assert [*false_costs(trace, answer, joint.maps, joint.theory)] != []


def test_conditioning_survives_the_rounding_of_large_variances() -> None:
    """Of variances of 1e9, the rounding leaves a difference with a negative variance."""
    mean = np.array([0.0, 0.0, 1.0, 0.0])
    covariance = np.diag([0.01, -0.001, 0.0, 0.0])
    moved, less, square, _ = conditioned(mean, covariance, [0, 1], [2, 3], np.full(3, 1e-6))
    assert np.isfinite(moved).all()
    assert np.isfinite(less).all()
    assert square > 0
