"""The search: prefixes and replay against solving at once, limits, streams, and scale."""

from __future__ import annotations

import itertools
import os
import random
import re
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
from hypothesis import given, settings
from strategies import theories, traces
from worlds import TOURS, drive, rectangle, written

from benchmarks.instances import maze
from ssh_abduction import OnlineMapper, SSHMap, Theory, Trace, solve
from ssh_abduction.checker.checker import check
from ssh_abduction.data import SolverError, TheoryError, TraceError
from ssh_abduction.data.errors import AbductionError
from ssh_abduction.explain.axioms import Interrupted
from ssh_abduction.explain.no_map import explain
from ssh_abduction.learning.learner import BootstrapLearner
from ssh_abduction.runtime.limits import LimitError, Watch
from ssh_abduction.solution import Progress, Status
from ssh_abduction.solution.values import Found
from ssh_abduction.solver import Search
from ssh_abduction.solver import search as search_module
from ssh_abduction.solver.sources.exact import labels_first, prefixes, readable
from ssh_abduction.solver.sources.exact.engine import Task
from ssh_abduction.solver.sources.exact.labels_first import LabelsFirst
from ssh_abduction.solver.sources.exact.readable import StepEngine
from ssh_abduction.solver.steps.faults import links_of
from ssh_abduction.solver.steps.log import Log
from ssh_abduction.theory import Speedups
from ssh_abduction.theory.settle import Problem, settle

TRACE = rectangle(8)
MAP = solve(TRACE).maps[0]
THEORIES = {
    "causal": Theory.causal(),
    "topological": Theory.topological(),
    "circumscriptive": Theory.circumscriptive(),
}


def wandering(seed: int, rooms: int, length: int, views: int) -> Trace:
    """A random walk in a random Moore machine."""
    choose = random.Random(seed)
    exits = [[choose.randrange(rooms) for _ in "ab"] for _ in range(rooms)]
    room, seen, done = 0, [], []
    for _ in range(length):
        seen.append(room % views)
        done.append(choose.choice("ab"))
        room = exits[room]["ab".index(done[-1])]
    return Trace.from_steps([*seen, room % views], done)


def too_hard() -> Trace:
    """Two views and sixty rooms, too many for a proof in seconds."""
    return wandering(3, rooms=60, length=1500, views=2)


@contextmanager
def clock() -> Iterator[Callable[[float], None]]:
    """A clock that the test advances by some seconds, to avoid waiting."""
    now, ahead = time.perf_counter, [0.0]
    with patch.object(time, "perf_counter", lambda: now() + sum(ahead)):
        yield ahead.append


@pytest.mark.parametrize("theory", THEORIES.values(), ids=THEORIES)
@pytest.mark.parametrize("tour", ["square", "comb"])
def test_maps_by_prefixes_equal_those_of_the_whole_trace(tour: str, theory: Theory) -> None:
    world, place, heading, actions = TOURS[tour]
    trace = drive(world, place, heading, actions, stars=theory.level == "topological")
    by_prefix, at_once = (
        solve(trace, theory, max_maps=None),
        solve(trace, theory, max_maps=None, speedups=Speedups(prefixes=False)),
    )
    assert set(by_prefix.maps) == set(at_once.maps)
    assert (by_prefix.cost, by_prefix.bound, by_prefix.complete) == (
        at_once.cost,
        at_once.bound,
        True,
    )
    assert at_once.effort.prefix == len(trace)


@pytest.mark.parametrize("seed", range(6))
def test_maps_by_prefixes_of_random_machines_equal_whole_traces(seed: int) -> None:
    trace = wandering(seed, rooms=4, length=40, views=3)
    by_prefix, at_once = (
        solve(trace, Theory.causal(), max_maps=None, speedups=Speedups(prefixes=p))
        for p in (True, False)
    )
    assert set(by_prefix.maps) == set(at_once.maps)
    assert len(set(by_prefix.maps)) == by_prefix.count


@settings(max_examples=5)
@given(
    traces(max_steps=8).flatmap(lambda trace: theories(trace).map(lambda theory: (trace, theory)))
)
def test_maps_by_prefixes_from_one_step_equal_whole_traces(case: tuple[Trace, Theory]) -> None:
    """Try every prefix, from the shortest on, so that replay fails if it can."""
    trace, theory = case
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(prefixes, "FIRST_PREFIX", 1)
        patch.setattr(readable, "GROWTH", 1.0)
        patch.setattr(prefixes, "FIRST_PATHS", 1)
        by_prefix = solve(trace, theory, max_maps=None)
    at_once = solve(trace, theory, max_maps=None, speedups=Speedups(prefixes=False))
    assert set(by_prefix.maps) == set(at_once.maps)
    assert by_prefix.count == len(set(by_prefix.maps)) == at_once.count
    assert by_prefix.status == at_once.status


@pytest.mark.parametrize("seed", range(4))
def test_streamed_maps_are_complete_and_unique(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Maps stream from a prefix that is too short for others."""
    trace = wandering(seed, rooms=5, length=30, views=3)
    at_once = solve(trace, Theory.causal(), max_maps=None, speedups=Speedups(prefixes=False))
    monkeypatch.setattr(prefixes, "FIRST_PREFIX", 2)
    streamed = solve(trace, Theory.causal(), max_maps=None)
    assert streamed.count == len(set(streamed.maps))
    assert set(streamed.maps) == set(at_once.maps)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([1, 2],), "expected a Trace"),
        ((rectangle(8), "causal"), "theory: expected a Theory, got 'causal'"),
    ],
)
def test_functions_refuse_arguments_of_wrong_types(
    arguments: tuple[Any, ...], message: str
) -> None:
    for function in (
        solve,
        Search,
        explain,
        lambda *rest: check(rest[0], MAP, *rest[1:]),
        lambda *rest: BootstrapLearner(*rest[1:]).fit(rest[0]),
    ):
        with pytest.raises(AbductionError, match=re.escape(message)):
            function(*arguments)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: OnlineMapper("a", "causal"), "theory: expected a Theory, got 'causal'"),
        (
            lambda: OnlineMapper("a", time_limit="5"),
            "limit: expected a number of seconds above 0, got '5'",
        ),
        (lambda: OnlineMapper("a", speedups=None), "speedups: expected Speedups, got None"),
        (
            lambda: BootstrapLearner().fit(None),
            "traces: expected a Trace, or a list of them, got None",
        ),
        (lambda: check(TRACE, None), "map: expected an SSHMap, got None"),
        (
            lambda: solve(TRACE, memory_limit=float("nan")),
            "memory_limit (--memory-limit): expected a number of MiB above 0, got nan",
        ),
        (
            lambda: solve(TRACE, time_limit=10**400),
            "time_limit (--time-limit): expected a number of seconds above 0, got 1000",
        ),
        (lambda: solve(TRACE, speedups="none"), "speedups: expected Speedups, got 'none'"),
        (
            lambda: solve(TRACE, on_progress=3),
            "on_progress: expected a function of one Progress, got 3",
        ),
        (lambda: Speedups.without(3), "speedups: expected names out of "),
        (lambda: Speedups(prefixes="no"), "speedups: prefixes: expected true or false, got 'no'"),
        (lambda: Trace.from_steps(["a"], [], stars=[{}]), "star"),
    ],
)
def test_wrong_types_raise_errors_of_the_package(call: Callable[[], Any], message: str) -> None:
    with pytest.raises(AbductionError, match=re.escape(message)):
        call()


@pytest.mark.parametrize("theory", THEORIES.values(), ids=THEORIES)
def test_fifty_circuits_need_the_prefix_of_two(theory: Theory) -> None:
    two, fifty = solve(rectangle(16), theory), solve(rectangle(400), theory)
    assert fifty.effort.prefix == two.effort.prefix < 16
    assert fifty.cost == two.cost
    assert len(fifty.maps[0].labels) == 401
    assert check(rectangle(400), fifty.maps[0], theory) == ()


@pytest.mark.parametrize("theory", THEORIES.values(), ids=THEORIES)
def test_hundreds_of_circuits_need_a_short_prefix(theory: Theory) -> None:
    trace = rectangle(2_000)
    solution = solve(trace, theory)
    assert solution.status is Status.OPTIMAL
    assert solution.complete
    assert solution.effort.prefix < 16
    assert check(trace, solution.maps[0], theory) == ()


def test_new_view_after_many_circuits_gets_a_dstate() -> None:
    """50 circuits and then another view. The closed map is wrong, and the answer has a dstate for
    the new view."""
    circuits = rectangle(48)
    surprised = Trace.from_steps([*circuits.views[:-1], "surprise"], circuits.actions)  # type: ignore[list-item]
    solution = solve(surprised, Theory.causal(), max_maps=None)
    assert solution.effort.prefix == len(surprised)
    assert solution.status is Status.OPTIMAL
    for ssh_map in solution.maps:
        assert check(surprised, ssh_map, Theory.causal()) == ()
    assert solution.cost is not None
    assert (
        solution.cost.dstates == 49
    )  # after a loop of four the view is v0, so no loop may be closed: 48 dstates + 1


def test_solve_lists_at_most_max_maps() -> None:
    world, place, heading, actions = TOURS["comb"]
    trace = drive(world, place, heading, actions[:14])
    theory = Theory(boundary="none", path_order="partial", prefer=("paths", "places", "dstates"))
    some, everything = solve(trace, theory, max_maps=5), solve(trace, theory, max_maps=None)
    assert (some.count, some.complete, some.stopped, some.status) == (
        5,
        False,
        "maps limit",
        Status.OPTIMAL,
    )
    assert (everything.count, everything.complete, everything.stopped) == (30, True, None)
    assert set(some.maps) <= set(everything.maps)
    exactly = solve(trace, theory, max_maps=30)
    assert (exactly.count, exactly.complete, exactly.stopped) == (30, True, None)


@pytest.mark.slow
def test_first_of_millions_of_maps_comes_at_once() -> None:
    """One and a half circuits have 20,289 consistent maps without sides. Two and a half circuits
    have far too many to list."""
    theory = Theory(boundary="none", path_order="partial", prefer=())
    search = Search(rectangle(20), theory, max_maps=None)
    first = list(itertools.islice(search, 100))
    assert len(set(first)) == 100
    assert search.count == 100


def test_empty_prefer_lists_all_consistent_maps() -> None:
    trace = written("a T a T a")
    theory = Theory.causal().replace(prefer=())
    assert (
        solve(trace, theory).count == 4
    )  # of the partitions of three steps, {0,1}{2} alone breaks determinism


def test_time_limit_returns_the_best_map_and_bound() -> None:
    trace = too_hard()
    solution = solve(trace, Theory.causal(), time_limit=0.5)
    assert solution.stopped == "time limit"
    assert solution.status is Status.FEASIBLE
    assert solution.count == 1
    assert not solution.complete
    assert solution.cost is not None
    assert solution.bound.dstates is not None
    assert solution.bound.dstates <= solution.cost.dstates
    assert check(trace, solution.maps[0], Theory.causal()) == ()


def test_solve_without_time_and_greedy_is_unknown() -> None:
    solution = solve(drive(*TOURS["comb"]), time_limit=1e-9, speedups=Speedups.without("greedy"))
    assert (solution.status, solution.stopped, solution.maps, solution.cost) == (
        Status.UNKNOWN,
        "time limit",
        (),
        None,
    )


@pytest.mark.parametrize("theory", THEORIES.values(), ids=THEORIES)
def test_solve_without_time_has_a_map_and_bound(theory: Theory) -> None:
    trace = drive(*TOURS["comb"])
    solution, best = solve(trace, theory, time_limit=1e-9), solve(trace, theory, max_maps=1)
    assert (solution.status, solution.stopped, solution.count) == (Status.FEASIBLE, "time limit", 1)
    assert check(trace, solution.maps[0], theory) == ()
    assert solution.certificate is not None
    assert best.cost is not None
    assert (
        1 < len(solution.certificate.clique) <= (solution.bound.dstates or 0) <= best.cost.dstates
    )


def test_time_limit_while_listing_keeps_the_proof() -> None:
    theory = Theory(boundary="none", path_order="partial", prefer=())
    search = Search(rectangle(20), theory, time_limit=1000, max_maps=None)
    maps = []
    for ssh_map in search:
        maps.append(ssh_map)
        search.parts.watch._spent += 500  # so that the time is over after two maps
    solution = search.solution(tuple(maps))
    assert (solution.status, solution.complete, solution.stopped) == (
        Status.OPTIMAL,
        False,
        "time limit",
    )
    assert solution.count == 2


def test_memory_limit_stops_the_search() -> None:
    solution = solve(drive(*TOURS["comb"]), memory_limit=1, speedups=Speedups.without("greedy"))
    assert (solution.status, solution.stopped) == (Status.UNKNOWN, "memory limit")


@pytest.mark.skipif(sys.platform == "win32", reason="signals")
def test_ctrl_c_returns_the_best_map(tmp_path: Path) -> None:
    program = textwrap.dedent("""
        import signal, sys
        # Ctrl-C is ignored if the tests run in the background.
        signal.signal(signal.SIGINT, signal.default_int_handler)
        from ssh_abduction import Theory, Trace, solve
        trace = Trace.load(sys.argv[1])
        solution = solve(
            trace, Theory.causal(), on_progress=lambda _: print("searching", flush=True)
        )
        print(solution.stopped, solution.status.value, solution.bound.dstates is not None)
    """)
    too_hard().save(tmp_path / "trace.jsonl")
    with subprocess.Popen(
        [sys.executable, "-c", program, str(tmp_path / "trace.jsonl")],
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "searching\n"
        process.send_signal(signal.SIGINT)
        assert process.stdout.read().splitlines()[-1].startswith("interrupted ")
        assert process.wait(100) == 0


def test_unfinished_stream_does_not_abort_python() -> None:
    """A search of clingo still runs in a thread when Python ends."""
    program = textwrap.dedent("""
        import sys
        from ssh_abduction import Trace
        from ssh_abduction.solver import Search
        maps = iter(Search(Trace.load(sys.argv[1]).without_stars(), max_maps=1))
        print(len(next(maps).labels))
    """)
    trace = os.path.join(os.path.dirname(__file__), "..", "examples", "aces3-route.jsonl")
    done = subprocess.run(
        [sys.executable, "-c", program, trace], check=False, capture_output=True, text=True
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "23\n", "")


def test_progress_is_reported() -> None:
    reports: list[Progress] = []
    solve(drive(*TOURS["comb"]), on_progress=reports.append)
    prefixes = [r.prefix for r in reports]
    bounds = [r.bound.dstates for r in reports if r.bound.dstates is not None]
    assert prefixes == sorted(prefixes)
    assert bounds == sorted(bounds)
    assert reports[-1].maps == 2


@pytest.mark.parametrize(
    ("choices", "name"),
    [
        ({"time_limit": "5"}, "time_limit (--time-limit)"),
        ({"time_limit": 0}, "time_limit (--time-limit)"),
        *(({"max_maps": number}, "max_maps (--maps)") for number in (-1, 0, 1.5, True)),
        ({"memory_limit": 0}, "memory_limit (--memory-limit)"),
    ],
)
def test_solve_refuses_wrong_limits(choices: dict[str, Any], name: str) -> None:
    with pytest.raises(SolverError, match=f"^{re.escape(name)}: expected"):
        solve(rectangle(4), **choices)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("choices", "message"),
    [
        ({"boundary": "soft"}, "boundary: expected none, strict or defeasible, got 'soft'"),
        (
            {"prefer": ("dstates", "streets")},
            "prefer: expected dstates, paths, places, excuses or auto, got 'streets'",
        ),
        ({"prefer": ("dstates", "dstates")}, "prefer: expected each name once"),
        ({"prefer": ("excuses",)}, "prefer: expected boundary=defeasible with excuses, got strict"),
        ({"without": ("gravity",)}, "without: expected functional_view, deterministic, "),
        (
            {"level": "causal"},
            "boundary: expected none with level=causal, got strict; leave boundary out, and take "
            "Theory.causal() (--theory causal)",
        ),
        ({"next_place": 1}, "next_place: expected true or false"),
        ({"colour": "red"}, "theory: expected fields out of"),
        ({"prefer": 5}, "prefer: expected a list of names, got 5"),
    ],
)
def test_theory_refuses_wrong_fields(choices: dict[str, object], message: str) -> None:
    with pytest.raises(TheoryError) as error:
        Theory.topological().replace(**choices)
    assert str(error.value).startswith(message)


def test_theories_survive_a_round_trip() -> None:
    assert Theory.from_dict({"level": "causal"}) == Theory.causal()
    with pytest.raises(TheoryError, match="theory: expected an object, got 5"):
        Theory.from_dict(5)  # type: ignore[arg-type]
    for theory in (
        *THEORIES.values(),
        Theory(boundary="defeasible", prefer=("paths", "excuses"), without=("on_path",)),
    ):
        assert Theory.from_dict(theory.to_dict()) == theory


def test_solve_refuses_traces_that_lack_what_the_theory_needs() -> None:
    unkinded = Trace.from_steps(["a", "b"], ["jump"])
    with pytest.raises(TraceError, match=r"step 0: action\.kind: expected"):
        solve(unkinded)
    assert solve(unkinded, Theory.causal()).cost is not None
    with pytest.raises(TheoryError, match="star: expected a trace with stars"):
        solve(rectangle(4), Theory(star="frame"))
    some = Trace.from_steps(["a", "b"], ["travel"], stars=[(1, 0, 0, 0), None])
    with pytest.raises(TraceError, match="step 1: star: expected one"):
        solve(some)
    assert solve(some, Theory(star="none")).cost is not None


@cache
def maps_of_all_tours() -> list[tuple[Trace, Theory, SSHMap]]:
    return [
        (trace, theory, ssh_map)
        for trace in (drive(*tour) for tour in TOURS.values())
        for theory in THEORIES.values()
        for ssh_map in solve(trace, theory, max_maps=1).maps
    ]


@pytest.mark.slow
def test_replay_of_a_map_predicts_its_trace() -> None:
    for trace, theory, ssh_map in maps_of_all_tours():
        replayed = Log(trace, settle(trace, theory).theory).replay(ssh_map.labels)
        assert replayed == ssh_map.labels
        assert links_of(ssh_map.labels, trace) == ssh_map.links


def test_replay_stops_at_an_unknown_or_contradicted_step() -> None:
    trace = written("a T b A b T a T c")
    log = Log(trace, Theory.causal())
    assert log.replay((0, 1, 2)) == (0, 1, 2)  # the second b has no T yet
    assert log.replay((0, 1, 2, 0)) == (0, 1, 2, 0)  # a T leads to b, but c was seen
    right = Log(written("a T b A b T a T b"), Theory.causal())
    assert right.replay((0, 1, 2, 0)) == (0, 1, 2, 0, 1)


def test_checker_refuses_mutated_maps() -> None:
    """In any map, swapped labels, a dropped link or a reversed order is a violation."""
    mutants = 0
    for trace, theory, ssh_map in maps_of_all_tours():
        assert check(trace, ssh_map, theory) == ()
        labels = list(ssh_map.labels)
        i, j = next((i, j) for i in range(len(labels)) for j in range(i) if labels[i] != labels[j])
        labels[i], labels[j] = labels[j], labels[i]
        wrong = [
            replace(ssh_map, dstate_at=tuple(labels)),
            replace(ssh_map, links=ssh_map.links[1:]),
        ]
        for k, path in enumerate(ssh_map.paths):
            if len(path.order) > 1:
                turned = replace(path, order=path.order[::-1])
                wrong.append(
                    replace(ssh_map, paths=(*ssh_map.paths[:k], turned, *ssh_map.paths[k + 1 :]))
                )
        for mutant in wrong:
            assert check(trace, mutant, theory)
            mutants += 1
    assert mutants > 50


def test_shuffled_truth_changes_no_answer() -> None:
    route = Trace.load(Path(__file__).parent.parent / "examples" / "aces3-route.jsonl")[:16]
    truths = [step.truth for step in route.steps]
    assert any(truths)
    random.Random(0).shuffle(truths)
    shuffled = replace(
        route,
        steps=tuple(
            replace(step, truth=truth) for step, truth in zip(route.steps, truths, strict=True)
        ),
    )
    bare = replace(route, steps=tuple(replace(step, truth=None) for step in route.steps))
    assert solve(shuffled).maps == solve(bare).maps == solve(route).maps


@pytest.mark.slow
def test_growth_continues_after_a_limit_with_the_same_maps() -> None:
    """After a limit has stopped the growth, growing on has the same result as growing at once."""
    trace = drive(*TOURS["comb"])
    theory = settle(trace).theory

    class Impatient(Watch):
        checks = 100

        def check(self, ahead: float = 0.0, mebibytes: float = 0.0) -> None:
            self.checks -= 1
            if not self.checks:
                raise LimitError("time limit")

    watch = Impatient(None, None, lambda: None)
    engine = StepEngine(Task.of(Problem.of(trace, theory), watch), paths=10)
    engine.grow(4)
    watch.checks = 2
    with pytest.raises(LimitError):
        engine.grow(len(trace))
    assert 4 < engine.size < len(trace)
    engine.grow(len(trace))
    minimal = list(engine.improving_maps())[-1]
    assert {found.map for found in engine.maps_of_cost(minimal.cost, 0)} == set(
        solve(trace, theory, max_maps=None, speedups=Speedups(prefixes=False)).maps
    )


@pytest.mark.slow
def test_interrupt_releases_maps_that_were_held_back(monkeypatch: pytest.MonkeyPatch) -> None:
    theory = Theory(boundary="none", path_order="partial", prefer=("paths", "places", "dstates"))
    search = Search(drive(*TOURS["comb"]), theory, max_maps=None)
    honest = search.parts.prefixes.engine.maps_of_cost

    def interrupted(cost: tuple[int, ...], enough: int) -> Iterator[object]:
        for number, found in enumerate(honest(cost, enough)):
            if number == 200:
                raise LimitError("interrupted")
            yield found

    monkeypatch.setattr(search.parts.prefixes.engine, "maps_of_cost", interrupted)
    maps = tuple(search)
    solution = search.solution(maps)
    assert (solution.count, len(set(maps)), solution.complete, solution.stopped) == (
        200,
        200,
        False,
        "interrupted",
    )
    assert solution.status is Status.OPTIMAL


def test_interrupt_during_growth_returns_replayed_maps(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(prefixes, "FIRST_PREFIX", 2)
    given = []
    for seed in (1, 4, 6):
        trace = wandering(seed, rooms=4, length=14, views=2)
        every = set(solve(trace, Theory.causal(), max_maps=None).maps)
        search = Search(trace, Theory.causal(), max_maps=None)
        grow = search.parts.prefixes.engine.grow

        def stopped(size: int, search: Search = search, grow: Callable[[int], None] = grow) -> None:
            if search.status is Status.OPTIMAL:
                raise LimitError("time limit")
            grow(size)

        monkeypatch.setattr(search.parts.prefixes.engine, "grow", stopped)
        maps = set(search)
        assert maps <= every
        assert search.stopped == "time limit"
        given.append(len(maps))
    assert max(given) > 1  # one is always known


def test_search_can_be_iterated_once() -> None:
    search = Search(rectangle(4))
    assert len(list(search)) == 1
    with pytest.raises(SolverError, match="iterated once"):
        list(search)


def test_cost_counts_places_that_a_map_cannot_show() -> None:
    """Without one_place a dstate may be at many places. The map shows the first one, and the cost
    counts all."""
    solution = solve(
        Trace.from_steps("aaaaa", ["travel"] * 4),
        Theory(prefer=("places",), without=("one_place",)),
        max_maps=None,
    )
    assert solution.cost is not None
    assert (solution.cost.places, solution.bound.places, solution.count) == (5, 5, 11)


def test_time_of_the_caller_does_not_count() -> None:
    theory = Theory(boundary="none", path_order="partial", prefer=("paths", "places", "dstates"))
    search = Search(drive(*TOURS["comb"]), theory, max_maps=5, time_limit=1000)
    with clock() as later:
        for _ in search:
            later(500)
    assert (search.count, search.stopped) == (5, "maps limit")


def test_time_limit_includes_the_explanation() -> None:
    search = Search(Trace.from_steps("abcd", ["travel", "around", "around"]), time_limit=1000)
    with clock() as later:
        assert list(search) == []
        assert search.status is Status.UNSATISFIABLE
        assert not search.over()
        later(1001)
        assert search.over()
    assert search.stopped is None  # the answer was complete before


def test_explanation_can_be_interrupted() -> None:
    trace = Trace.from_steps("abcd", ["travel", "around", "around"])
    with pytest.raises(Interrupted):
        explain(trace, stop=lambda: True)
    asked = itertools.count()
    assert explain(trace, stop=lambda: next(asked) > 10**6) == explain(trace)


def test_searches_in_threads_give_the_same_answers() -> None:
    """In threads of their own, where no signal arrives."""
    with ThreadPoolExecutor(2) as pool:
        answers = list(pool.map(lambda n: solve(rectangle(n)).cost, [8, 16, 8, 16, 24, 32]))
    assert answers[1:] == answers[:-1]


# Symmetry: names in a trace do not matter.


def shape(ssh_map: SSHMap) -> tuple[object, ...]:
    """Remove the names of views and actions from a map."""
    return ssh_map.labels, tuple((s.place, s.path, s.direction) for s in ssh_map.dstates)


@settings(max_examples=5)
@given(
    traces(max_steps=8).flatmap(lambda trace: theories(trace).map(lambda theory: (trace, theory)))
)
def test_renaming_and_mirroring_do_not_change_maps(case: tuple[Trace, Theory]) -> None:
    trace, theory = case
    shapes = {shape(m) for m in solve(trace, theory, max_maps=None).maps}
    stars = [step.star for step in trace.steps] if trace.has_stars else None
    views = [f"seen {v}" for v in trace.views]
    moved = [step.displacement for step in trace.steps[1:]] if trace.has_displacements else None
    renamed = [{"name": f"do {a.name}", "kind": a.kind, "turn": a.turn} for a in trace.actions]
    again = Trace.from_steps(
        views, renamed, stars=stars, displacements=moved, odometry=trace.odometry
    )
    assert {shape(m) for m in solve(again, theory, max_maps=None).maps} == shapes
    flip = {"right": "left", "left": "right", "around": "around", None: None}
    mirrored = [{"name": a.name, "kind": a.kind, "turn": flip[a.turn]} for a in trace.actions]
    turned = [None if s is None else (s[0], s[3], s[2], s[1]) for s in stars] if stars else None
    mirrored_moves = [None if d is None else (d[0], -d[1], -d[2]) for d in moved] if moved else None
    mirror = Trace.from_steps(
        views, mirrored, stars=turned, displacements=mirrored_moves, odometry=trace.odometry
    )
    assert {shape(m) for m in solve(mirror, theory, max_maps=None).maps} == shapes


@pytest.mark.slow
def test_map_of_a_prefix_is_extended_at_the_time_limit() -> None:
    """Unknown steps get new dstates. There are far fewer than if only a short prefix was mapped."""
    trace = maze(4, 4, steps=500, seed=0, loops=0.5, stars=True).trace
    grow = LabelsFirst.grow
    found = {}
    for most in (8, 250):

        def interrupted(self: LabelsFirst, size: int, most: int = most) -> None:
            if size > most:
                raise KeyboardInterrupt
            grow(self, size)

        with (
            patch.object(labels_first, "AT_ONCE", 250),
            patch.object(LabelsFirst, "grow", interrupted),
            patch.object(search_module, "INTERRUPTED", 100.0),
        ):
            found[most] = solve(trace)
        assert found[most].stopped == "interrupted"
        assert check(trace, found[most].maps[0], found[most].theory) == ()
    assert len(found[250].maps[0].dstates) < 0.5 * len(found[8].maps[0].dstates)


def test_search_ends_after_the_last_requested_map() -> None:
    """The search ends after the last map asked for, although the next one would take long."""
    trace = maze(2, 2, steps=200, seed=0).trace
    every = solve(trace, Theory.causal(), max_maps=None)
    assert (every.complete, every.stopped) == (True, None)
    listed = LabelsFirst.maps_of_cost

    def slow(self: LabelsFirst, cost: tuple[int, ...], enough: int) -> Iterator[Found]:
        yield from listed(self, cost, enough)
        while True:
            self.asker.watch.check()

    with (
        patch.object(LabelsFirst, "maps_of_cost", slow),
        patch.object(search_module, "ONE_MORE", 0.01),
    ):
        search = Search(trace, Theory.causal(), max_maps=every.count, time_limit=100.0)
        asked_for = search.solution(tuple(search))
    assert set(asked_for.maps) == set(every.maps)
    assert (asked_for.status, asked_for.complete, asked_for.stopped) == (
        Status.OPTIMAL,
        False,
        "maps limit",
    )
    assert not search.over()
