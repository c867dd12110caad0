"""The next experiment: shortest sequences and plans against brute force, and the shell."""

from __future__ import annotations

import json
import math
import random
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from instances import maze, moore, rectangle

from ssh_abduction import SSHMap, Theory, Trace, next_experiment, solve
from ssh_abduction.cli import main
from ssh_abduction.data import DState, MapError, MapPath, Odometry, SolverError
from ssh_abduction.rivals.explore import Experiment, ExperimentPlan
from ssh_abduction.rivals.machines import Consequences, Seen, leads_of
from ssh_abduction.runtime.limits import Watch

ROOT = Path(__file__).parent.parent
ACES = str(ROOT / "examples" / "aces3-route.jsonl")
ACTIONS = ("a", "b", "c")


def machine(
    chance: random.Random,
    states: int,
    views: int,
    known: float = 0.8,
    actions: int = 2,
    rare: bool = False,
) -> SSHMap:
    """A map of one step with random links, some unknown. If `rare`, one dstate looks different."""
    shown = [
        int(s == states - 1) if rare else chance.randrange(views) if s else 0 for s in range(states)
    ]
    dstates = tuple(DState(s, f"v{view}") for s, view in enumerate(shown))
    links = tuple(
        (s, action, chance.randrange(states))
        for s in range(states)
        for action in ACTIONS[:actions]
        if chance.random() < known
    )
    return SSHMap((0,), dstates, links)


def views_after(ssh_map: SSHMap, words: Sequence[str]) -> list[object] | None:
    """What a map predicts after each action; None for an unknown link."""
    ends, here, seen = {(s, a): x for s, a, x in ssh_map.links}, ssh_map.labels[-1], []
    for action in words:
        if (here, action) not in ends:
            return None
        here = ends[here, action]
        seen.append(ssh_map.dstates[here].view)
    return seen


def shortest(maps: Sequence[SSHMap], longest: int, actions: Sequence[str] = ACTIONS) -> int | None:
    """The fewest actions after which maps that know all links on the way predict differently.

    All sequences of possible actions are tried.
    """
    words: list[tuple[str, ...]] = [()]
    for length in range(1, longest + 1):
        longer = [(*word, action) for word in words for action in actions]
        words = []
        for word in longer:
            seen = [views_after(m, word) for m in maps]
            if any(said is None for said in seen):
                continue
            if any(said != seen[0] for said in seen):
                return length
            words.append(word)
    return None


def test_plan_for_two_rivals_has_the_fewest_actions() -> None:
    lengths = []
    for seed in range(200):
        chance = random.Random(seed)
        actions, states = chance.choice([(1, 5), (2, 3)])
        one, other = (
            machine(chance, states, 2, chance.choice([0.8, 1.0]), actions, rare=True)
            for _ in range(2)
        )
        expected = shortest([one, other], states**2)  # a longer sequence repeats a pair of dstates
        experiment = next_experiment([one, other])
        lengths.append(expected or 0)
        if expected is None:
            assert not experiment.plan.branches
            assert experiment.worst == 2
            continue
        assert len(experiment.plan.actions) == expected
        assert experiment.worst == 1
        first, second = (views_after(m, experiment.actions) for m in (one, other))
        assert first is not None
        assert second is not None
        assert first[:-1] == second[:-1]
        assert first[-1] != second[-1]
        assert [[seen.view for seen in said.seen] for said in experiment.predictions] == [
            first,
            second,
        ]
    assert lengths.count(0) > 20
    assert max(lengths) == 4


def walk(plan: ExperimentPlan, truth: SSHMap) -> ExperimentPlan:
    """The end of a plan if this map is true."""
    words: list[str] = []
    while plan.branches:
        words += plan.actions
        seen = views_after(truth, words)
        assert seen is not None
        (plan,) = (branch.plan for branch in plan.branches if branch.seen.view == seen[-1])
    return plan


def ends_of(plan: ExperimentPlan) -> list[ExperimentPlan]:
    """The plans without branches at the ends of the tree."""
    return [end for branch in plan.branches for end in ends_of(branch.plan)] or [plan]


def path(plan: ExperimentPlan, end: ExperimentPlan) -> Iterator[tuple[str, ...]]:
    """The actions that lead to the end of a plan."""
    while plan is not end:
        yield plan.actions
        (plan,) = (
            branch.plan for branch in plan.branches if set(end.rivals) <= set(branch.plan.rivals)
        )


def moved(ssh_map: SSHMap, words: Sequence[str]) -> SSHMap:
    """A map whose robot is where these actions lead."""
    ends, here = {(s, a): x for s, a, x in ssh_map.links}, ssh_map.labels[-1]
    for action in words:
        here = ends[here, action]
    return replace(ssh_map, dstate_at=(here,))


def least_worst(maps: Sequence[SSHMap]) -> int:
    """The number of rivals that the best plan leaves in the worst case.

    It is computed for growing lengths from the rivals at these dstates.
    """
    ends = [{(s, a): x for s, a, x in m.links} for m in maps]
    known: dict[tuple[frozenset[tuple[int, int]], int], int] = {}

    def least(left: frozenset[tuple[int, int]], length: int) -> int:
        if len(left) == 1 or length == 0:
            return len(left)
        if (left, length) not in known:
            best = len(left)
            for action in ACTIONS:
                if all((here, action) in ends[i] for i, here in left):
                    parts: dict[object, set[tuple[int, int]]] = {}
                    for i, here in left:
                        there = ends[i][here, action]
                        parts.setdefault(maps[i].dstates[there].view, set()).add((i, there))
                    best = min(
                        best, max(least(frozenset(part), length - 1) for part in parts.values())
                    )
            known[left, length] = best
        return known[left, length]

    return least(frozenset((i, m.labels[-1]) for i, m in enumerate(maps)), 20)


def test_plan_for_many_rivals_leaves_only_inseparable_ones() -> None:
    as_good = 0
    for seed in range(60):
        chance = random.Random(f"many {seed}")
        maps = [machine(chance, chance.randint(2, 4), 2, 0.85) for _ in range(5)]
        plan = next_experiment(maps).plan
        for i, truth in enumerate(maps, 1):
            end = walk(plan, truth)
            assert i in end.rivals
            words = tuple(action for step in path(plan, end) for action in step)
            assert shortest([moved(maps[k - 1], words) for k in end.rivals], 6, ACTIONS[:2]) is None
        left = sorted(i for leaf in ends_of(plan) for i in leaf.rivals)
        assert left == [1, 2, 3, 4, 5]
        assert plan.worst >= least_worst(maps)
        as_good += plan.worst == least_worst(maps)
    assert as_good >= 54


def test_rivals_with_equal_predictions_are_merged() -> None:
    one = machine(random.Random(1), 4, 2, 1.0)
    renamed = replace(one, dstates=one.dstates)
    other = next(
        m
        for m in (machine(random.Random(k), 4, 2, 1.0) for k in range(2, 50))
        if shortest([one, m], 6)
    )
    experiment = next_experiment([one, renamed, other])
    assert experiment.alike == ((1, 2), (3,))
    assert experiment.worst == 2
    assert next_experiment([one, renamed]).actions == ()
    assert next_experiment([one, renamed]).actions == ()


def with_paths(courses: Sequence[int]) -> SSHMap:
    """A corridor of three places, each on one of these paths."""
    dstates = tuple(DState(s, "abc"[s], s, courses[s], 1) for s in range(3))
    orders = tuple(
        MapPath(h, tuple(s for s in range(3) if courses[s] == h)) for h in dict.fromkeys(courses)
    )
    return SSHMap((0, 1, 2), dstates, ((0, "travel", 1), (1, "travel", 2)), (0, 1, 2), orders)


def test_sentence_says_that_rivals_differ_only_in_paths() -> None:
    experiment = next_experiment([with_paths([0, 0, 0]), with_paths([0, 0, 1])])
    assert experiment.plan.branches == ()
    assert experiment.worst == 2
    assert (
        "2 maps predict the same along all links, as they have the same dstates and places and "
        "differ only in paths" in experiment.sentence
    )


def test_many_rivals_with_equal_labels_are_merged() -> None:
    ssh_map = solve(maze(3, 3, steps=60, seed=0, stars=True, follow=True).trace, max_maps=1).maps[0]
    maps = [replace(ssh_map, paths=ssh_map.paths[: 1 + i % len(ssh_map.paths)]) for i in range(780)]
    assert next_experiment(maps).alike == (tuple(range(1, 781)),)


def test_stars_are_predicted_beside_views() -> None:
    views, actions = ["v", "v", "v"], ["travel", "travel"]
    stars = [(1, 0, 0, 0), (1, 0, 1, 0), (0, 0, 1, 0)]
    trace = Trace.from_steps(views, actions, stars=stars)
    dstates = tuple(DState(s, "v", s, 0, 1) for s in range(3))
    links = ((0, "travel", 1), (1, "travel", 2), (2, "around", 0))
    maps = [
        SSHMap((0, 1, 2), dstates, links, (0, 1, 2)),
        SSHMap((0, 1, 2), dstates, (*links[:2], (2, "around", 1)), (0, 1, 2)),
    ]
    assert next_experiment(maps, trace).actions == ("around",)
    assert [str(said.seen[0]) for said in next_experiment(maps, trace).predictions] == [
        "v (open: ahead)",
        "v (open: ahead, back)",
    ]
    without = next_experiment(maps, trace, theory=Theory(star="none"))
    assert without.plan.actions == ("around", "travel", "travel") or without.worst == 2


def test_stars_within_their_spreads_do_not_separate_rivals() -> None:
    def stars(bearing: float) -> list[list[float]]:
        return [[0.0], [0.0, 60.0], [0.0, bearing]]

    dstates = tuple(DState(s, "v") for s in range(3))
    links = ((0, "go", 1), (1, "go", 2))
    maps = [SSHMap((0, 1, 2), dstates, (*links, (2, "back", end))) for end in (1, 2)]
    for bearing, differs in ((75.0, False), (100.0, True)):
        trace = Trace.from_steps("vvv", [{"name": "go"}] * 2, stars=stars(bearing))
        for theory in (Theory.causal().replace(star="alike"), None):
            assert (
                next_experiment(maps, trace, theory=theory).plan.actions == ("back",)
            ) == differs


def framed(headings: Sequence[int]) -> tuple[SSHMap, list[Seen]]:
    """Dstates at one place, each with its heading, and its star turned to it."""
    openings = (True, False, False, True)
    dstates = tuple(
        DState(i, f"v{heading}", 0, None, None, heading) for i, heading in enumerate(headings)
    )
    looks = [Seen(s.view, openings[s.heading or 0 :] + openings[: s.heading or 0]) for s in dstates]
    return SSHMap(tuple(range(len(headings))), dstates, (), (0,)), looks


def test_frame_predicts_the_result_of_turns() -> None:
    ssh_map, looks = framed([0, 1])
    says = Consequences(ssh_map, leads_of(ssh_map, 0), looks, None)
    turn = {
        action.name: action
        for action in Trace.from_steps("aaaa", ["right", "around", "left"]).actions
    }
    assert (says.of(0, turn["right"]).how, says.of(0, turn["right"]).dstate) == ("implied", 1)
    assert says.of(1, turn["left"]).dstate == 0
    assert says.of(0, turn["around"]).seen == Seen(None, (False, True, True, False))
    assert not says.of(1, turn["right"]).clashes(
        says.of(0, turn["around"])
    )  # both know where they would face
    assert says.of(0, turn["right"]).clashes(says.of(0, turn["around"]))
    weak = Consequences(
        ssh_map, leads_of(ssh_map, 0), looks, Theory(star="frame", without=("turn_rotates",))
    )
    assert weak.of(0, turn["right"]).how == "open"


def test_path_predicts_the_next_dstate() -> None:
    ssh_map = with_paths([0, 0, 0])
    bare = replace(ssh_map, links=())
    looks = [Seen(s.view) for s in bare.dstates]
    says = Consequences(bare, leads_of(bare, 0), looks, None)
    (travel,) = Trace.from_steps("ab", ["travel"]).actions
    assert [(says.of(s, travel).how, says.of(s, travel).dstate) for s in range(3)] == [
        ("expected", 1),
        ("expected", 2),
        ("open", None),
    ]
    assert not says.of(0, travel).clashes(says.of(1, travel))  # expectations refute nobody


def test_plan_names_the_most_informative_untried_action() -> None:
    # Both maps go a from 0 to 1 and back; one has tried b in dstate 1, where it leads to x. None
    # has tried b in dstate 0.
    dstates = (DState(0, "v"), DState(1, "w"), DState(2, "x"))
    links = ((0, "a", 1), (1, "a", 0), (2, "a", 0))
    one = SSHMap((0,), dstates, (*links, (1, "b", 2)))
    other = SSHMap((0,), dstates, (*links, (2, "b", 2)))
    untried = next_experiment([one, other]).plan.untried
    assert untried is not None
    assert (untried.way, untried.action, untried.pairs, untried.worst) == (("a",), "b", 1, 2)
    assert [said.says.how for said in untried.expects] == ["link", "open"]
    nothing = next_experiment([one, other], can=lambda seen: ["a"]).plan.untried
    assert nothing is None


@pytest.mark.parametrize("seen", ["end", "hall"])
def test_outcome_of_an_untried_action_keeps_the_rivals_that_predicted_it(seen: str) -> None:
    views, actions = ["end", "hall", "end", "end", "hall"], ["travel", "travel", "around", "travel"]
    trace = Trace.from_steps(views, actions)
    solution = solve(trace)
    untried = next_experiment(solution, trace).plan.untried
    assert untried is not None
    (kept,) = (said.rivals for said in untried.expects if said.says.seen == Seen(seen))
    after = solve(Trace.from_steps([*views, seen], [*actions, *untried.way, untried.action]))
    assert [m.labels[:5] for m in after.maps] == [solution.maps[rival - 1].labels for rival in kept]
    assert [[s.place for s in m.dstates] for m in after.maps] == [
        [s.place for s in solution.maps[rival - 1].dstates] for rival in kept
    ]


def test_plan_for_one_map_names_the_nearest_untried_action() -> None:
    trace = rectangle(1).trace
    (ssh_map,) = solve(trace).maps
    experiment = next_experiment(ssh_map, trace)
    assert experiment.plan.untried is not None
    assert experiment.plan.untried.way == ()
    assert (experiment.count, experiment.worst) == (1, 1)


def rivals() -> Iterator[tuple[Trace, Theory]]:
    for seed in range(8):
        yield moore(6, 3, steps=25, seed=seed).trace, Theory.causal()


def test_plans_separate_rivals_of_real_traces() -> None:
    told = 0
    for trace, theory in rivals():
        solution = solve(trace, theory, max_maps=None)
        experiment = next_experiment(solution, trace)
        assert experiment.complete == solution.complete
        if len(experiment.alike) == 2 and experiment.plan.branches:
            apart = [solution.maps[group[0] - 1] for group in experiment.alike]
            assert len(experiment.plan.actions) == shortest(apart, 12, ("a0", "a1"))
            told += 1
        for i, truth in enumerate(solution.maps, 1):
            assert i in walk(experiment.plan, truth).rivals
    assert told


def test_interrupted_plan_names_its_limit() -> None:
    chance = random.Random(3)
    maps = [machine(chance, 5, 2, 1.0) for _ in range(2)]
    watch = Watch()
    watch.interrupted = True
    experiment = next_experiment(maps, watch=watch)
    assert experiment.stopped == "interrupted"
    assert experiment.plan == ExperimentPlan((1, 2))
    assert experiment.warning is not None
    assert next_experiment(maps, time_limit=1e-9).stopped == "time limit"
    with pytest.raises(SolverError, match="limit: expected a number of seconds above 0"):
        next_experiment(maps, time_limit=-1)


@pytest.mark.parametrize(
    ("maps", "message"),
    [
        ([], "maps: expected maps, got none"),
        (["no map"], r"maps\[0\]: expected an SSHMap, got 'no map'"),
        (
            [
                SSHMap((0,), (DState(0, "v"),), ()),
                SSHMap((0, 0), (DState(0, "v"),), ((0, "a", 0),)),
            ],
            r"maps\[1\]: expected 1 steps",
        ),
        (
            [SSHMap((0, 0), (DState(0, "v"),), ((0, "a", 0),))],
            r"maps\[0\]: labels: expected 1, one for each step of the trace",
        ),
        ([SSHMap((0,), (DState(0, "w"),), ())], r"maps\[0\]: expected view 'v' at step 0"),
        (
            [SSHMap((0,), (DState(0, "v"), DState(1, "v")), ((0, "a", 0), (0, "a", 1)))],
            r"links: expected that 'a' leads from dstate",
        ),
    ],
)
def test_next_experiment_refuses_maps_of_other_traces(maps: list[SSHMap], message: str) -> None:
    with pytest.raises(MapError, match=message):
        next_experiment(maps, Trace.from_steps("v", []))


@pytest.fixture
def machines(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> tuple[str, str]:
    """A trace with rivals that known links tell apart, and its maps as JSON."""
    trace = tmp_path / "trace.jsonl"
    moore(8, 3, steps=40, seed=1).trace.save(trace)
    assert main(["solve", str(trace), "--theory", "causal", "-n", "0", "--json"]) == 0
    maps = tmp_path / "maps.json"
    maps.write_text(capsys.readouterr().out)
    return str(maps), str(trace)


def test_next_prints_the_result_of_python(
    machines: tuple[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["next", *machines, "--json"]) == 0
    trace = Trace.load(machines[1])
    solution = solve(trace, Theory.causal(), max_maps=None)
    expected: Experiment = next_experiment(solution, trace)
    assert json.loads(capsys.readouterr().out) == expected.to_dict()
    assert main(["next", *machines]) == 0
    out = capsys.readouterr().out
    assert out.startswith(f"{solution.verdict}\n{expected.sentence}\n")
    first = expected.plan.branches[0].seen
    assert f"\n  {', '.join(expected.plan.actions)}\n    {first}: map" in out


@pytest.mark.parametrize("off", [0.0, 5.0])
def test_next_says_how_to_list_maps_that_cost_little_more(
    off: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A square closes exactly, or some metres off. Its last corner must be a new dstate."""
    moved = [(10, 0, 0), (0, 0, math.pi / 2)] * 3 + [(10 + off, 0, 0), (0, 0, math.pi / 2)]
    odometry = Odometry(along=0.001, position=0.001, scale=0.001) if off else Odometry()
    trace = Trace.from_steps(
        "abcdefgha", ["travel", "left"] * 4, displacements=moved, odometry=odometry
    )
    maps = tmp_path / "maps.json"
    solve(trace, Theory(different=((0, 8),))).save(maps)
    assert main(["next", str(maps)]) == 0
    assert ("solve --set within=5" in capsys.readouterr().out) is not bool(off)


def test_next_warns_that_maps_may_be_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["solve", ACES, "-n", "2", "--json"]) == 0
    (tmp_path / "maps.json").write_text(capsys.readouterr().out)
    assert main(["next", str(tmp_path / "maps.json"), ACES]) == 0
    said = capsys.readouterr()
    assert "there may be other maps that are as good or better" in said.err
    verdict, sentence = said.out.splitlines()[:2]
    assert verdict.endswith("Proven minimal, one of 2 or more such maps.")
    assert sentence.startswith(
        "2 maps predict the same along all links, as they have the same dstates"
    )


def test_next_errors_are_one_line(
    machines: tuple[str, str], tmp_path: Path, refuses: Callable[..., None]
) -> None:
    maps, trace = machines
    none = tmp_path / "none.json"
    none.write_text('{"maps": []}')
    for words, message in [
        (
            [maps, ACES],
            f"{maps}: maps[0]: labels: expected 23, one for each step of the trace, got 41; solve "
            "this trace",
        ),
        ([maps, maps], f"{maps}:1: header: expected a trace, got maps"),
        ([trace, trace], f"{trace}: expected maps, got a trace"),
        ([str(none), trace], f"{none}: expected maps, got none"),
        (
            [maps, trace, "--time-limit", "0"],
            "--time-limit: expected a number of seconds above 0, got 0.0",
        ),
    ]:
        refuses(["next", *words], message)
