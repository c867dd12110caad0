"""With frames, dstates are found before places and paths. The maps are those of the plain encoding
of the axioms."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import combinations
from unittest.mock import patch

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from instances import maze
from strategies import STARS, step_pairs

from ssh_abduction import OnlineMapper, Theory, Trace, solve
from ssh_abduction.checker.checker import check
from ssh_abduction.checker.claims import check_bound
from ssh_abduction.data.groups import gathered
from ssh_abduction.data.step import QUARTERS, Action
from ssh_abduction.online.keeper import MapKeeper
from ssh_abduction.runtime.limits import LimitError, Watch
from ssh_abduction.solution import Status
from ssh_abduction.solver import Search, Start
from ssh_abduction.solver.asp import facts
from ssh_abduction.solver.asp.control import Control
from ssh_abduction.solver.asp.facts import number_symbols
from ssh_abduction.solver.sources.exact import choosing, engine, fitting, labels_first
from ssh_abduction.solver.sources.exact import visit_labels as same
from ssh_abduction.solver.sources.exact.fitting import Fitting
from ssh_abduction.solver.sources.exact.labels_first import LabelsFirst
from ssh_abduction.solver.sources.exact.prefixes import Prefixes
from ssh_abduction.solver.sources.exact.visit_labels import VisitLabels, VisitProgram, batch_facts
from ssh_abduction.solver.sources.symbolic.merging import merged
from ssh_abduction.solver.steps.chart import Chart, FramedChart
from ssh_abduction.solver.steps.log import Log
from ssh_abduction.theory import Speedups, encodings
from ssh_abduction.theory.fields import Count
from ssh_abduction.theory.settle import Problem, settle
from ssh_abduction.theory.speedups import SPEEDUPS

PLAIN = Speedups.without(SPEEDUPS)


@st.composite
def framed_traces(draw: st.DrawFn, most_steps: int = 9) -> Trace:
    """Walks on a torus of few cells with any stars, so views mislead. Some stars fit no frame."""
    steps = draw(st.integers(1, most_steps))
    few = draw(
        st.sampled_from(
            [
                ["travel", "right"],
                ["travel", "right", "left", "around"],
                ["travel", "travel", "right", "around"],
            ]
        )
    )
    actions = draw(st.lists(st.sampled_from(few), min_size=steps - 1, max_size=steps - 1))
    width, height = draw(st.integers(1, 3)), draw(st.integers(1, 3))
    star_of = draw(
        st.lists(st.sampled_from(STARS), min_size=width * height, max_size=width * height)
    )
    views = draw(st.sampled_from(["a", "ab"]))
    x = y = heading = 0
    seen, stars = [], []
    for action in ["", *actions]:
        if action == "travel":
            x, y = (x + (0, 1, 0, -1)[heading]) % width, (y + (1, 0, -1, 0)[heading]) % height
        elif action:
            heading = (heading + QUARTERS[action]) % 4
        star = star_of[x + width * y]
        stars.append(star[heading:] + star[:heading])
        seen.append(views[(x + y + heading) % len(views)])
    if draw(st.integers(0, 4)) == 0:
        stars[draw(st.integers(0, steps - 1))] = (1, 1, 0, 1)
    return Trace.from_steps(seen, actions, stars=stars)


@st.composite
def framed_theories(draw: st.DrawFn) -> Theory:
    """All theories that the engine accepts."""
    rest = draw(st.sampled_from([(), ("paths",), ("paths", "places"), ("places", "paths")]))
    return Theory(
        star="frame",
        boundary=draw(st.sampled_from(["strict", "none"])),
        symmetric_sides=draw(st.booleans()),
        prefer=("dstates", *rest),
    )


@settings(max_examples=7)
@given(framed_traces(), framed_theories(), st.sets(st.sampled_from(SPEEDUPS)), st.data())
def test_framed_maps_equal_those_of_the_plain_encoding(
    trace: Trace, theory: Theory, off: set[str], data: st.DataObject
) -> None:
    """Prefixes, cores and batches are so small that short traces use them all. Any speed-ups may be
    off."""
    said = {kind: data.draw(step_pairs(len(trace)), label=kind) for kind in ("same", "same_place")}
    theory = theory.replace(**said)
    expected = solve(trace, theory, max_maps=None, speedups=PLAIN)
    first = data.draw(st.sampled_from([2, labels_first.FIRST_PREFIXES]), label="first prefixes")
    at_a_time = data.draw(st.sampled_from([1, same.AT_A_TIME]), label="at a time")
    cores = {
        "FIRST_PAIRS": data.draw(
            st.sampled_from([0, 2, 10, same.FIRST_PAIRS]), label="first pairs"
        ),
    }
    fitted = {
        "BETTERING": data.draw(st.sampled_from([0, fitting.BETTERING]), label="bettering"),
    }
    many_pairs = data.draw(st.sampled_from([5, same.MANY_PAIRS]), label="many pairs")
    off = off - {"names"}
    prefixes = patch.object(labels_first, "FIRST_PREFIXES", first)
    with (
        patch.object(choosing, "FEW_STEPS", 0),
        prefixes,
        patch.multiple(same, MANY_PAIRS=many_pairs, **cores),
        patch.object(same, "AT_A_TIME", at_a_time),
        patch.multiple(fitting, **fitted),
    ):
        search = Search(trace, theory, max_maps=None, speedups=Speedups.without(off))
        maps = tuple(search)
    found = search.solution(maps)
    assert isinstance(search.parts.prefixes.engine, LabelsFirst)
    assert found.status is expected.status
    assert set(maps) == set(expected.maps)
    assert len(set(maps)) == len(maps)
    assert found.complete
    if found.cost and expected.cost:
        assert found.bound.dstates == found.cost.dstates
        assert [getattr(found.cost, name) for name in theory.prefer] == [
            getattr(expected.cost, name) for name in theory.prefer
        ]
    for ssh_map in maps[:3]:
        assert check(trace, ssh_map, theory) == ()


@pytest.mark.parametrize("prefer", [("dstates",), ("dstates", "paths", "places")])
@pytest.mark.parametrize("said", [(1, 5), (0, 7)])
def test_framed_maps_join_places_that_a_person_joins(
    prefer: tuple[Count, ...], said: tuple[int, int]
) -> None:
    """Two drives cross at right angles, or touch. No dstate and no turn shows that."""
    trace = Trace.from_steps(
        "abcdefgh",
        ["travel", "travel", "around", Action("other", "start"), "travel", "travel", "around"],
        stars=[(1, 1, 1, 1)] * 8,
    )
    theory = Theory(star="frame", prefer=prefer, same_place=[said])
    expected = solve(trace, theory, max_maps=None, speedups=PLAIN)
    with patch.object(choosing, "FEW_STEPS", 0):
        search = Search(trace, theory, max_maps=None)
        assert set(search) == set(expected.maps)
    assert isinstance(search.parts.prefixes.engine, LabelsFirst)


@settings(max_examples=5)
@given(framed_traces(most_steps=7), framed_theories(), st.data())
def test_framed_maps_of_a_growing_trace_equal_the_plain_encoding(
    trace: Trace, theory: Theory, data: st.DataObject
) -> None:
    """Clingo gets only the new steps, or all steps again. Both give the same maps."""
    grown = data.draw(st.sampled_from([1, 1.5, 100]), label="grown")
    first, *rest = trace.steps
    with (
        patch.object(choosing, "FEW_STEPS", 0),
        patch.multiple(
            same,
            GROWN=grown,
            FIRST_PAIRS=data.draw(st.sampled_from([0, 5, same.FIRST_PAIRS]), label="first pairs"),
        ),
    ):
        mapper = OnlineMapper(
            first.view or "", theory, star=first.star, time_limit=None, max_maps=None
        )
        for i, (action, step) in enumerate(zip(trace.actions, rest, strict=True)):
            answer = mapper.observe(action, step.view or "", star=step.star)
            expected = solve(
                trace.prefix(i + 2), theory.of_steps(0, i + 2), max_maps=None, speedups=PLAIN
            )
            assert answer.status is expected.status
            assert set(answer.maps) == set(expected.maps)
            assert answer.count == expected.count


@pytest.mark.slow
def test_framed_mapper_maps_a_maze_step_by_step() -> None:
    """The trace is long enough for cores, transitivity rules of visits, and paths. The longer trace
    keeps them all."""
    trace = maze(3, 3, steps=27, seed=0, stars=True).trace
    first, *rest = trace.steps
    paths = set()
    with (
        patch.object(same, "GROWN", 100),
        patch.object(same, "AT_A_TIME", 5),
        patch.object(choosing, "FEW_STEPS", 10),
    ):
        mapper = OnlineMapper(first.view or "", star=first.star, time_limit=None, max_maps=None)
        for i, (action, step) in enumerate(zip(trace.actions, rest, strict=True)):
            answer = mapper.observe(action, step.view or "", star=step.star)
            if i % 10 == 5 or i == len(rest) - 1:
                expected = solve(
                    trace.prefix(i + 2), max_maps=None, speedups=Speedups.without("sides")
                )
                assert (answer.cost, answer.bound.dstates, answer.complete) == (
                    expected.cost,
                    expected.bound.dstates,
                    True,
                )
                assert set(answer.maps) == set(expected.maps)
            assert isinstance(mapper._keeper, MapKeeper)
            search = mapper._keeper.search
            engine = search and search.parts.prefixes.engine
            if isinstance(engine, LabelsFirst):
                paths.add((engine._labels.program.batch, len(engine._labels.program._paths)))
    assert max(paths)[0] > 5
    assert any(told for _, told in paths)


@pytest.mark.slow
def test_framed_maps_are_equal_without_each_speedup() -> None:
    """The walks are long enough for cores, transitivity rules of visits, and maps near a guess."""
    trace = maze(2, 2, steps=36, seed=0, stars=True).trace
    expected = solve(trace, Theory.topological(), max_maps=None, speedups=Speedups.without("names"))
    for off in ("", "clique", "core_guided", "sides"):
        with patch.object(same, "AT_A_TIME", 5):
            found = solve(
                trace, Theory.topological(), max_maps=None, speedups=Speedups.without(off)
            )
        assert set(found.maps) == set(expected.maps), off
        assert found.cost == expected.cost, off
        assert found.bound.dstates == expected.bound.dstates, off


def test_apart_nodes_are_different_true_dstates() -> None:
    """In a world that satisfies the theory, steps that the trace alone distinguishes are truly
    different."""
    for seed in range(6):
        walk = maze(3, 3, steps=200, seed=seed, stars=True)
        search = Search(walk.trace, Theory.topological())
        chart = Chart.framed(walk.trace, Log(walk.trace, search.theory))
        assert chart
        truth = dict(zip(chart.node_of, walk.truth, strict=True))
        assert len(truth) == len(chart.seen)
        apart = chart.apart()
        assert (apart == apart.T).all()
        assert not any(truth[i] == truth[j] for i, j in zip(*apart.nonzero(), strict=True))


def test_too_many_pairs_of_visits_are_not_listed() -> None:
    """Pairs are counted before they are listed, because ten million would take gigabytes."""
    trace = maze(3, 3, steps=120, seed=1, stars=True).trace
    chart = Chart.framed(trace, Log(trace, Theory(star="frame")))
    assert chart.fitting[-1] == len(chart.fits(range(len(chart.stars)))) > 50
    with (
        patch.object(same, "SECONDS_A_PAIR", 1000.0),
        patch.object(FramedChart, "fits", side_effect=AssertionError),
    ):
        solution = solve(trace, time_limit=100)
    assert (solution.status, solution.stopped) == (Status.FEASIBLE, "time limit")
    assert check(trace, solution.maps[0], solution.theory) == ()


def test_nodes_with_a_common_frame_are_not_apart() -> None:
    """A node for each visit and heading. Rotations (both ways) and travels link them."""
    star = [(0, 0, 1, 0), (1, 0, 0, 0), (1, 0, 1, 0), (1, 0, 1, 0)]
    trace = Trace.from_steps(
        "aabbbb",
        ["around", "travel", "around", "right", "right"],
        stars=[*star[:2], *star[2:], (0, 1, 0, 1), (1, 0, 1, 0)],
    )
    chart = Chart.framed(trace, Log(trace, Theory(star="frame")))
    assert chart.node_of == (0, 1, 2, 3, 4, 2)
    assert {(s, a, x) for s, a, x in chart.links if a < 0} == {
        (0, -2, 1),
        (1, -2, 0),
        (2, -2, 3),
        (3, -2, 2),
        (2, -3, 4),
        (4, -1, 2),
        (3, -1, 4),
        (4, -3, 3),
    }
    assert [(s, x) for s, _, x in chart.travels] == [(1, 2)]
    apart = chart.apart()
    assert not apart[2, 2]
    assert apart[2, 3]  # they see the same, but face different slots of one place


def test_visit_that_fits_no_frame_is_unsatisfiable() -> None:
    stars = [(1, 0, 0, 0), (0, 0, 0, 1), (0, 0, 1, 0), (0, 1, 0, 0), (1, 1, 0, 0)]
    trace = Trace.from_steps("aaaaa" * 6, ["right"] * 29, stars=stars * 6)
    assert Chart.framed(trace, Log(trace, Theory(star="frame"))) is None
    solution = solve(trace, Theory.topological())
    assert solution.status is Status.UNSATISFIABLE
    assert solution.complete


@pytest.mark.parametrize(("seed", "counts"), [(0, (32, 8, 4)), (3, (16, 4, 2))])
def test_mazes_with_stars_have_true_maps(seed: int, counts: tuple[int, int, int]) -> None:
    """3 x 3 cells. The robot sees some of them.

    Order and sides in the trace alone show that the dstates of the last two steps differ.
    """
    walk = maze(3, 3, steps=200, seed=seed, stars=True)
    search = Search(walk.trace, Theory.topological())
    maps = tuple(search)
    solution = search.solution(maps)
    assert solution.status is Status.OPTIMAL
    assert solution.complete
    assert solution.cost
    assert (solution.cost.dstates, solution.cost.places, solution.cost.paths) == counts
    assert solution.bound.dstates == counts[0] <= len(set(walk.truth))
    assert solution.certificate
    proven = check_bound(
        walk.trace, solution.certificate.to_dict()
    )  # by actions and views alone, of steps rather than nodes
    assert not proven.faults
    assert proven.dstates + len(proven.refuted) == counts[0]
    for ssh_map in maps:
        assert check(walk.trace, ssh_map, Theory.topological()) == ()


@pytest.mark.slow
def test_pinning_segments_keeps_all_maps() -> None:
    trace = maze(4, 4, steps=100, seed=41, stars=True).trace
    given: list[tuple[list[int], Sequence[int]]] = []

    def rivals(
        among: Sequence[int],
        pairs: Sequence[tuple[int, int]],
        sought: Callable[..., list[int]] = fitting.pairwise_distinct,
    ) -> list[int]:
        found = sought(among, pairs)
        assert set(combinations(found, 2)) <= set(pairs)
        given.append((found, among))
        return found

    with patch.object(fitting, "pairwise_distinct", rivals):
        maps = solve(trace, max_maps=None).maps
    assert any((len(found), len(among)) == (3, 5) for found, among in given)
    assert len(maps) > 1
    assert set(maps) == set(solve(trace, max_maps=None, speedups=Speedups.without("clique")).maps)


def test_lazy_rules_for_order_and_sides_give_the_same_maps() -> None:
    """Every answer is refused until clingo has the rules for order and sides. The maps are the
    same."""
    walk = maze(2, 2, steps=60, seed=1, stars=True)
    expected = solve(walk.trace, Theory.topological(), max_maps=None)
    for off, kind, asked in (
        ("", VisitProgram, "give_sides"),
        ("sides", Fitting, "clash"),
    ):
        finding = patch.object(kind, asked, autospec=True, side_effect=getattr(kind, asked))
        with finding as found:
            maps = solve(
                walk.trace, Theory.topological(), max_maps=None, speedups=Speedups.without(off)
            ).maps
        assert found.called
        assert set(maps) == set(expected.maps)


def test_refused_path_becomes_a_rule_for_clingo() -> None:
    """Otherwise the maps would be the same, but each answer without paths would be forbidden
    separately."""
    trace = maze(3, 3, steps=60, seed=0, stars=True).trace
    asked = Search(trace, Theory(star="frame")).parts.prefixes.engine
    assert isinstance(asked, LabelsFirst)
    asked.grow(len(trace))
    assert isinstance(asked._labels, VisitLabels)
    assert asked._fitting
    labels = next(asked._labels.improving(), None)
    assert isinstance(labels, list)
    contrary = asked._fitting.contrary(labels)
    program = asked._labels.program
    standing = {labels[node]: program.chart.facing[node] for node in program.place_of}
    assert contrary
    assert asked._labels.give_sides(labels, contrary)
    (told,) = asked._labels.program._paths
    assert told in {standing[dstate] for dstate in contrary}


@pytest.mark.parametrize(
    "theory",
    [
        Theory(star="frame"),
        Theory(star="frame", symmetric_sides=False),
        Theory(star="frame", boundary="none"),
    ],
)
def test_sides_and_paths_refuse_the_same_labels(theory: Theory) -> None:
    """Compare sides_framed.lp (one path and visits) with paths.lp (all paths and fixed dstates)."""
    contradicted = 0
    for seed in (0, 2):
        trace = maze(3, 3, steps=45, seed=seed, stars=True).trace
        engine = Search(trace, theory).parts.prefixes.engine
        assert isinstance(engine, LabelsFirst)
        engine.grow(len(trace))
        assert isinstance(engine._labels, VisitLabels)
        assert engine._fitting
        labels = next(engine._labels.improving(), None)
        assert labels
        chart = engine._labels.chart
        control = engine._fitting._base(labels, engine._fitting._members(labels))
        contrary = engine._fitting.contrary(labels)
        contradicted += len(contrary)

        def atoms(name: str, arity: int, control: Control = control) -> set[tuple[int, ...]]:
            return {
                tuple(x.number for x in atom.symbol.arguments)
                for atom in control.symbolic_atoms.by_signature(name, arity)
            }

        nodes = [
            (node, label, visit, slot)
            for node, (label, (visit, slot)) in enumerate(zip(labels, chart.facing, strict=True))
        ]
        beside, segments = atoms("beside", 3), atoms("on_segment", 3)
        pairs = {
            (i, j, (t - s - k) % 4)
            for _, x, i, s in nodes
            for _, y, j, t in nodes
            if i < j
            for k in range(4)
            if (x, y, k) in beside
        }
        for (dstate,) in atoms("along", 1):
            control = Control()
            control.load(encodings.path("visits"))
            control.load(encodings.path("sides_framed"))
            given = [(node, visit, slot) for node, _, visit, slot in nodes]
            leaves = [(visit, *how) for visit, how in chart.leaves.items()]
            news = {"node": given, "leaves": leaves, "fits": pairs}
            control.add("visits", [], batch_facts(0, news))
            visits = [(visit,) for visit in range(len(chart.stars))]
            turns = gathered((kind, tuple(slots)) for kind, *slots in chart.turns(trace))
            control.add("visits", [], batch_facts(0, {"visit": visits, **turns}))
            control.add("visits", [], "\n".join(facts.sides(theory)))
            control.add("visits", [], "\n".join(f":- not same({i},{j},{r})." for i, j, r in pairs))
            street = ("path", number_symbols(*chart.facing[labels.index(dstate)], 0))
            control.ground(
                [
                    ("visits", []),
                    ("more", number_symbols(0)),
                    ("sides", []),
                    ("paths", number_symbols(0)),
                    street,
                ]
            )
            allowed = next(
                engine.asker.answers(lambda _: True, "ignore", 1, control=control), False
            )
            assert not (allowed and dstate in contrary)
            assert allowed or {y for x, y, _ in segments if x == dstate} & set(contrary)
    assert contradicted > 3


def test_framed_search_at_the_time_limit_gives_map_and_bound() -> None:
    """Stop the search for paths, and the search for the fewest dstates."""
    walk = maze(3, 3, steps=200, seed=1, stars=True)
    with (
        patch.object(LabelsFirst, "_all_that_fit", side_effect=KeyboardInterrupt),
        patch.object(labels_first, "FIRST_PREFIXES", 300),
    ):
        search = Search(walk.trace, Theory.topological())
        search.parts.prefixes.start = 201
        solution = search.solution(tuple(search))
    assert solution.status is Status.FEASIBLE
    assert solution.cost
    assert solution.cost.dstates == solution.bound.dstates == 36
    assert check(walk.trace, solution.maps[0], Theory.topological()) == ()
    with patch.object(VisitLabels, "improving", side_effect=KeyboardInterrupt):
        solution = solve(walk.trace, Theory.topological())
    assert solution.status is Status.FEASIBLE
    assert check(walk.trace, solution.maps[0], Theory.topological()) == ()


@pytest.mark.slow
def test_half_explored_maze_is_mapped() -> None:
    """Few views distinguish little, so order and sides matter."""
    trace = maze(10, 10, steps=4000, seed=2, stars=True).trace.prefix(145)
    solution = solve(trace, Theory.topological(), max_maps=3)
    assert solution.status is Status.OPTIMAL
    assert solution.cost
    assert (solution.cost.dstates, solution.cost.paths) == (50, 7)
    for ssh_map in solution.maps:
        assert check(trace, ssh_map, Theory.topological()) == ()


def test_framed_engine_continues_after_a_limit() -> None:
    """The search may stop anywhere. It proves the same in the last part of the time."""
    trace = maze(10, 10, steps=150, seed=0, stars=True).trace
    fewest: set[int] = set()
    stopped = 0
    for stop in range(4, 25, 5):
        engine = Search(trace, Theory.topological()).parts.prefixes.engine
        assert isinstance(engine, LabelsFirst)
        engine.grow(len(trace))
        checks = iter(range(1, 10**6))

        def check_once(
            ahead: float = 0.0, stop: int = stop, checks: Iterator[int] = checks
        ) -> None:
            if next(checks) == stop:
                raise LimitError("time limit")

        with patch.object(engine.asker.watch, "check", check_once):
            try:
                labels = next(engine._labels.improving(), None)
            except LimitError:
                stopped += 1
                labels = next(engine._labels.improving(), None)
        assert labels is not None
        assert len(set(labels)) == engine.bound
        fewest.add(len(set(labels)))
    assert len(fewest) == 1
    assert stopped > 2


def test_framed_engine_interrupted_in_preparation_is_prepared_again() -> None:
    """Otherwise the time reserved for any map would go to the engine of a shorter prefix, whose map
    would be taken for one of the whole trace."""
    walk = maze(3, 3, steps=120, seed=1, stars=True)
    search = Search(walk.trace, Theory.topological(), time_limit=100)
    engine = search.parts.prefixes.engine
    engine.grow(40)
    with (
        patch.object(Chart, "framed", side_effect=KeyboardInterrupt),
        pytest.raises(KeyboardInterrupt),
    ):
        engine.grow(121)
    assert engine.size == 40
    search.parts.prefixes.start = 121
    maps = tuple(search)
    assert search.status is Status.OPTIMAL
    for ssh_map in maps:
        assert check(walk.trace, ssh_map, Theory.topological()) == ()


def test_ctrl_c_discards_the_engine() -> None:
    """Clingo may have got half of a core. Then its answer for the longer trace may be wrong."""
    trace = maze(3, 3, steps=80, seed=1, stars=True).trace
    search = Search(trace.prefix(70), Theory.topological(), time_limit=100)
    with patch.object(Prefixes, "minimise", side_effect=KeyboardInterrupt):
        assert [check(search.trace, ssh_map, search.theory) for ssh_map in search] == [()]
    assert search.stopped == "interrupted"
    later = Search(trace, Theory.topological(), max_maps=None, _start=Start(after=search.parts))
    assert later.parts.prefixes.engine is not search.parts.prefixes.engine
    assert set(later) == set(solve(trace, max_maps=None).maps)


def test_error_discards_the_engine() -> None:
    trace = maze(3, 3, steps=80, seed=1, stars=True).trace
    first = Search(trace.prefix(60), Theory.topological())
    list(first)
    second = Search(trace.prefix(70), Theory.topological(), _start=Start(after=first.parts))
    assert second.parts.prefixes.engine is first.parts.prefixes.engine
    with (
        patch.object(VisitLabels, "_best_answer", side_effect=MemoryError),
        pytest.raises(MemoryError),
    ):
        list(second)
    assert (
        Search(trace, Theory.topological(), _start=Start(after=first.parts)).parts.prefixes.engine
        is not first.parts.prefixes.engine
    )


def test_search_with_a_known_cost_lists_maps_of_the_whole_trace() -> None:
    """A shorter prefix has maps with fewer dstates, and only those would be listed."""
    trace = maze(3, 3, steps=70, seed=44, stars=True).trace
    first = Search(trace, Theory.topological(), max_maps=1)
    known = next(iter(first))
    first.parts.known.stopped = "interrupted"
    again = Search(
        trace, Theory.topological(), max_maps=None, _start=Start(after=first.parts, minimal=known)
    )
    assert not again.parts.engine.size
    assert set(again) == set(solve(trace, max_maps=None).maps)
    assert again.parts.engine.size == len(trace)


def framed_engine(trace: Trace, theory: Theory) -> LabelsFirst:
    resolved = settle(trace, theory).theory
    watch = Watch()
    watch.start()
    found = LabelsFirst(engine.Task.of(Problem.of(trace, resolved), watch))
    chart = Chart.framed(trace, found._task.log)
    if chart is not None:
        found._labels._program = VisitProgram(found._task, found.asker, chart)
    return found


@settings(max_examples=10)
@given(framed_traces(), framed_theories())
def test_merging_gives_a_map(trace: Trace, theory: Theory) -> None:
    """Only the causal axioms count."""
    asked = framed_engine(trace, theory)
    if asked._labels._program is None:
        return  # the trace fits no frame
    chart = asked._labels.chart
    apart = chart.apart()
    labels = merged(chart)
    assert chart.is_map(labels)
    assert not any(
        apart[i, j] for i in range(len(labels)) for j in range(i) if labels[i] == labels[j]
    )
