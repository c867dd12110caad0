"""Explanations of pairs: verdicts against the brute force, and mends against the solver."""

from __future__ import annotations

import json
import re
from functools import cache
from pathlib import Path

import pytest
from brute_force import Key, consistent_maps, key, minimal_maps
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from strategies import TOYS, theories, traces

from ssh_abduction import SSHMap, Theory, Trace, check, solve
from ssh_abduction.cli import main
from ssh_abduction.data import MapError, Odometry, TraceError
from ssh_abduction.explain.axioms import Axioms, Piece, active_at
from ssh_abduction.explain.no_map import explain_trace
from ssh_abduction.explain.pair_reasons import explain_pair
from ssh_abduction.explain.verdict import Derivation, Link, PairExplanation, Side, Verdict
from ssh_abduction.rivals import Listing
from ssh_abduction.rivals.listing import PairInMap
from ssh_abduction.solution import Cost, Solution, Status
from ssh_abduction.solver import Search, Start
from ssh_abduction.solver.asp import facts
from ssh_abduction.theory.encodings import axioms
from ssh_abduction.theory.settle import settle

RECTANGLE = Trace.load(Path(__file__).parent.parent / "examples" / "notched-rectangle.jsonl")
IMPOSSIBLE = Trace.from_steps(views="abcd", actions=["travel", "around", "around"])


def never() -> bool:
    return False


def with_axioms(theory: Theory, names: set[str]) -> Theory:
    """The theory with these axioms and no others."""
    rules = {axiom.name for each in theory.rules for axiom in each.axioms}
    return theory.replace(
        without=[axiom.name for axiom in axioms() if axiom.name not in names | rules]
    )


def map_with(
    derivation: Derivation, trace: Trace, theory: Theory, links: list[Link]
) -> SSHMap | None:
    """A map in which the pair is otherwise, if only these axioms hold at these steps."""
    piece = Piece.of(settle(trace, theory), derivation.steps)
    pair = piece.steps.index(derivation.first), piece.steps.index(derivation.second)
    active = [active_at(axiom, piece.steps.index(step)) for axiom, step in links]
    return Axioms(piece, never, relaxed=True).map_with(
        active, [(facts.are_one(*pair), not derivation.one)]
    )


def maps_without_a_link(derivation: Derivation, trace: Trace, theory: Theory) -> list[SSHMap]:
    """A map for each link in which all other links hold, but not the conclusion."""
    links = [*derivation.links]
    found = [
        map_with(derivation, trace, theory, [other for other in links if other != link])
        for link in links
    ]
    assert None not in found
    return [ssh_map for ssh_map in found if ssh_map]


def check_derivation(derivation: Derivation, trace: Trace, theory: Theory) -> None:
    """The links suffice and are minimal, and the lines name all."""
    links = [*derivation.links]
    assert map_with(derivation, trace, theory, links) is None
    first, second = (
        derivation.steps.index(derivation.first),
        derivation.steps.index(derivation.second),
    )
    for ssh_map in maps_without_a_link(derivation, trace, theory):
        assert (ssh_map.labels[first] == ssh_map.labels[second]) != derivation.one
    told = {
        (clash.axiom, step)
        for line in derivation.inferences
        for clash in line.links
        for step in clash.steps
    }
    assert told == set(links)
    for number, line in enumerate(derivation.inferences):
        assert line.says
        assert all(premise < number for premise in line.premises)


@cache
def argument() -> PairExplanation:
    """Why steps 0 and 4 of the rectangle are different dstates."""
    return explain_pair(RECTANGLE, 4, 0)


def test_explain_pair_gives_the_argument_of_the_paper() -> None:
    """Steps 0 and 4 differ by the argument of Kuipers & Beeson 2002, section 4.2.

    x0 is at a place on the path that x1 and x2 define. x4 is at a place to the right of that path.
    No place on a path is to its right.
    """
    explanation = argument()
    assert (explanation.first, explanation.second, explanation.verdict) == (0, 4, Verdict.DIFFERENT)
    derivation = explanation.derivation
    assert derivation is not None
    assert derivation.steps == (0, 1, 2, 3, 4)
    assert derivation.summary == (
        "step 0 is at a place on the path that steps 1 and 2 define; step 4 would be at a place "
        "to the right of that path; "
        "no place on a path lies right or left of it"
    )
    assert {"on_path", "branch_side", "side_of_branch", "path_between_sides"} <= set(
        derivation.axioms
    )
    check_derivation(derivation, RECTANGLE, Theory())
    piece = Piece.of(settle(RECTANGLE, Theory()), derivation.steps)
    of_argument = with_axioms(piece.theory, {*derivation.axioms})
    for ssh_map in maps_without_a_link(derivation, RECTANGLE, Theory()):
        assert check(piece.trace, ssh_map, of_argument)


def test_each_axiom_of_the_argument_is_needed() -> None:
    """The solver finds a map with step 0 = step 4 once any axiom of the argument is left out."""
    derivation = argument().derivation
    assert derivation is not None
    for dropped in (None, *derivation.axioms):
        theory = with_axioms(Theory(same=[(0, 4)]), {*derivation.axioms, "asserted"} - {dropped})
        solution = solve(RECTANGLE.prefix(5), theory, time_limit=100, max_maps=1)
        assert solution.status is (Status.UNSATISFIABLE if dropped is None else Status.OPTIMAL)


@settings(max_examples=5)
@given(st.data())
def test_verdicts_equal_the_brute_force(data: st.DataObject) -> None:
    trace = data.draw(traces(max_steps=5, closures=True), label="trace")
    assume(len(trace) > 1)
    theory = data.draw(theories(trace), label="theory")
    first = data.draw(st.integers(0, len(trace) - 2), label="first")
    second = data.draw(st.integers(first + 1, len(trace) - 1), label="second")
    compare(trace, theory, first, second)


def compare(trace: Trace, theory: Theory, first: int, second: int) -> PairExplanation:
    """Check the verdict, counts and costs against all maps, and the derivation."""
    toys = [toy for toy in TOYS if toy.rules in theory.rules]

    def allows(found: Key) -> bool:
        return all(toy.allows(found) for toy in toys)

    consistent = [
        labels[first] == labels[second]
        for (labels, *rest), _ in consistent_maps(trace, theory)
        if allows((labels, *rest))
    ]  # type: ignore[arg-type]
    _, minimal = minimal_maps(trace, theory, allows)
    ones = [labels[first] == labels[second] for labels, *_ in minimal]
    explanation = explain_pair(trace, first, second, theory, time_limit=100, max_maps=None)
    if not consistent:
        assert explanation.verdict is Verdict.NO_MAP
    elif len(set(consistent)) == 1:
        assert explanation.verdict is (Verdict.SAME if consistent[0] else Verdict.DIFFERENT)
        assert explanation.derivation is not None
        check_derivation(explanation.derivation, trace, theory)
    elif len(set(ones)) == 1:
        assert explanation.verdict is (
            Verdict.SAME_IN_MINIMAL if ones[0] else Verdict.DIFFERENT_IN_MINIMAL
        )
        lost = explanation.different if ones[0] else explanation.same
        best, _ = minimal_maps(
            trace,
            theory,
            lambda found: allows(found) and (found[0][first] == found[0][second]) != ones[0],
        )
        assert best is not None
        assert lost.cost is not None
        assert lost.proven
        assert lost.cost.preferred_by(explanation.theory) == tuple(
            getattr(best, name) for name in explanation.theory.priorities
        )
    else:
        assert explanation.verdict is Verdict.DISAGREE
        assert (explanation.same.maps, explanation.different.maps) == (
            sum(ones),
            len(ones) - sum(ones),
        )
        assert explanation.listed
    return explanation


def test_derivation_names_the_links_that_planarity_needs() -> None:
    """A derivation names the links that planarity needs.

    While axioms are left out, a dstate may be at two places and there is nothing to draw. Then
    planarity must not depend on earlier questions.
    """
    trace = Trace.from_steps("aaaa", ["travel"] * 3, stars=[(1, 1, 1, 1)] * 4)
    (even,) = (toy.rules for toy in TOYS if toy.rules.name == "even.lp")
    theory = Theory(
        boundary="defeasible",
        all_on_paths=True,
        star="pattern",
        prefer=(),
        planar=True,
        rules=(even,),
    )
    derivation = compare(trace, theory, 0, 3).derivation
    assert derivation is not None
    assert "planar" in derivation.axioms


def test_derivation_names_repeated_links() -> None:
    """The axiom at step 5 alone implies nothing about steps 0 and 3 without earlier links."""
    trace = Trace.from_steps("baabab", ["left"] * 5)
    derivation = explain_pair(trace, 0, 3, Theory.causal()).derivation
    assert derivation is not None
    check_derivation(derivation, trace, Theory.causal())
    assert derivation.supposition == "steps 0 and 3 are one dstate"


def test_derivation_in_a_long_trace_names_two_steps() -> None:
    far = explain_pair(RECTANGLE, 3, 396)
    assert far.derivation is not None
    assert far.derivation.steps == (3, 396)
    assert far.derivation.axioms == ("functional_view",)


def test_explanation_states_the_cost_of_the_rival_in_dstates() -> None:
    explanation = explain_pair(RECTANGLE, 0, 8)
    assert explanation.sentences == (
        "steps 0 and 8 are one dstate in every minimal map",
        "the best map with step 0 ≠ step 8 has 9 dstates, not 8",
        "nothing observed decides this: it rests on minimality alone",
    )
    other = solve(RECTANGLE, Theory(different=[(0, 8)]), max_maps=1)
    assert other.cost == explanation.different.cost


def test_explanation_states_the_cost_of_a_join_in_nats() -> None:
    """A square whose loop closes some metres off."""
    told = []
    for off in (3, 6):
        moved = [(10, 0, 0), (0, 0, 1.5708)] * 3 + [(10 - off, 0, 0), (0, 0, 1.5708)]
        trace = Trace.from_steps("abcdefgha", ["travel", "left"] * 4, displacements=moved)
        told.append(explain_pair(trace, 0, 8, Theory(reject=1e-12)).sentences)
    (same, near), (different, far) = told
    assert same == "steps 0 and 8 are one dstate in every map of least cost"
    assert near.startswith("making steps 0 and 8 different dstates costs ")
    assert near.endswith("1 dstate more and 1 place more: the loop of 37 m closes 3.0 m off")
    assert different == "steps 0 and 8 are different dstates in every map of least cost"
    assert far.startswith("joining steps 0 and 8 costs ")
    assert far.endswith("1 dstate less and 1 place less: the loop of 34 m closes 6.0 m off")


def test_explanation_says_how_far_turns_alone_are_off() -> None:
    turned = [(0, 0, 1.5708), (0, 0, -1.4)]
    trace = Trace.from_steps("aba", ["left", "right"], displacements=turned)
    assert str(explain_pair(trace, 0, 2)).endswith(
        "1 dstate less: by the odometry their headings are 9.8 degrees apart"
    )


def test_explanation_of_equal_counts_names_no_price() -> None:
    moved = [(10, 0, 0), (10, 0, 0), (-5, 0, 0), (-4, 0, 0)]
    trace = Trace.from_steps(
        "abaca", ["travel"] * 4, displacements=moved, odometry=Odometry(along=1.0)
    )
    said = str(explain_pair(trace, 2, 4, Theory.causal()))
    assert re.search(r"different dstates costs \d\.\d nats: the loop of 9 m closes 9", said)


# A square whose loop closes 3 m off, and a second round.
SQUARE = Trace.from_steps(
    "abcdefghabcdefgha",
    ["travel", "left"] * 8,
    displacements=[*[(10, 0, 0), (0, 0, 1.5708)] * 3, (7, 0, 0), (0, 0, 1.5708)] * 2,
)


@cache
def square_maps() -> Solution:
    """The maps of least cost of `SQUARE`."""
    return solve(SQUARE)


@pytest.mark.parametrize(("trace", "within"), [(SQUARE, 16)])
def test_explain_pair_without_time_uses_known_maps(trace: Trace, within: int) -> None:
    """No time is left for any search, but the known maps are still there."""
    solution = square_maps()
    known = solve(trace, within=within).maps
    first, second = next(
        (i, j)
        for j in range(len(trace))
        for i in range(j)
        if {m.dstate_at[i] == m.dstate_at[j] for m in known} == {False, True}
    )
    none = explain_pair(trace, first, second, time_limit=1e-9)
    assert (none.same.cost, none.different.cost) == (None, None)
    some = explain_pair(trace, first, second, time_limit=1e-9, known=known)
    costs = [side.cost for side in (some.same, some.different)]
    assert some.verdict is Verdict.UNKNOWN
    assert solution.cost in costs
    assert None not in costs
    if solution.weighed:
        nats = [side.nats for side in (some.same, some.different) if side.nats is not None]
        assert min(nats) == pytest.approx(solution.weighed.nats)
        assert len(nats) == 2
    search = Search(trace, time_limit=1e-9, _start=Start(known=known))
    assert [*search] == [solution.maps[0]]
    assert (search.status, search.cost) == (Status.FEASIBLE, solution.cost)


@pytest.mark.slow
@pytest.mark.parametrize(("trace", "within"), [(SQUARE, 8)])
def test_known_maps_do_not_change_proven_answers(trace: Trace, within: int) -> None:
    anew, known = Search(trace, within=within), solve(trace, within=within + 1).maps
    search = Search(trace, within=within, _start=Start(known=known))
    assert {*search} == {*anew}
    assert (search.count, search.cost, search.status) == (anew.count, anew.cost, anew.status)
    pair = 0, len(trace) - 1
    assert explain_pair(trace, *pair, known=known) == explain_pair(trace, *pair)


def test_explain_pair_without_time_finds_a_map_for_the_other_answer() -> None:
    """There is no time for a search. But moving a visit to a new place makes a consistent map."""
    solution = square_maps()
    assert solution.weighed
    best, *others = solution.weighed.rivals
    assert best.places[0] == best.places[8]
    rival = min((r for r in others if r.places[0] != r.places[8]), key=lambda r: r.nats)
    explanation = explain_pair(SQUARE, 0, 8, time_limit=1e-9, known=solution.maps)
    assert explanation.different.nats == pytest.approx(rival.nats)
    more = rival.nats - solution.weighed.nats
    assert explanation.assuming["different"] == f"costs at most {more:.1f} nats more"
    assert str(explanation).endswith(f", 4 paths, and costs {rival.nats:.1f} nats")
    # The estimate is not told a second time, as the checker may refuse it.
    in_map = PairInMap.of(Listing.of(solution), 0, 8)
    assert in_map
    assert "nats" not in f"{in_map} {in_map.to_dict()}"


def test_known_maps_that_break_the_theory_are_ignored() -> None:
    known = square_maps().maps
    theory = Theory(different=[(0, 8)])
    assert known[0].dstate_at[0] == known[0].dstate_at[8]
    search = Search(SQUARE, theory, time_limit=1e-9, _start=Start(known=known))
    assert all(ssh_map.dstate_at[0] != ssh_map.dstate_at[8] for ssh_map in search)
    with pytest.raises(MapError, match="one for each step of the trace, got"):
        explain_pair(SQUARE.prefix(9), 0, 8, known=known)


def test_explanation_counts_rivals_that_disagree() -> None:
    """Turned back, travel may stop at the place before, or skip it (G1 of
    docs/explanation/theory.md)."""
    trace = Trace.from_steps(
        "batbbb".replace("t", "b"), ["travel", "travel", "around", "travel", "travel"]
    )
    maps = solve(trace, max_maps=None).maps
    pairs = [
        (i, j)
        for j in range(len(trace))
        for i in range(j)
        if len({m.labels[i] == m.labels[j] for m in maps}) == 2
    ]
    for i, j in pairs:
        explanation = explain_pair(trace, i, j)
        assert explanation.verdict is Verdict.DISAGREE
        assert explanation.same.maps == sum(m.labels[i] == m.labels[j] for m in maps)


def test_explain_pair_proves_steps_one_dstate_in_every_map() -> None:
    """A turn around, twice, leads back to where a travel came to."""
    trace = Trace.from_steps("aabab", ["travel", "around", "around", "travel"])
    explanation = explain_pair(trace, 1, 3, Theory(without=["functional_view"]))
    assert explanation.verdict is Verdict.SAME
    derivation = explanation.derivation
    assert derivation is not None
    assert {"turn_stays", "turn_around_reverses", "one_dstate_per_course"} <= set(derivation.axioms)
    check_derivation(derivation, trace, Theory(without=("functional_view",)))


@pytest.mark.parametrize("trace", [IMPOSSIBLE, Trace.from_steps("aab", ["x", "x"], stars=None)])
def test_mends_equal_the_changes_after_which_solve_finds_a_map(trace: Trace) -> None:
    theory = Theory.causal() if trace is not IMPOSSIBLE else Theory()
    theory = theory if trace is IMPOSSIBLE else theory.replace(same=[(0, 1)])
    explanation = explain_trace(trace, theory)
    assert explanation.possible is False
    assert explanation.complete
    assert explanation.mends
    views = dict.fromkeys([*trace.views, "unseen"])
    mended = set()
    for t, step in enumerate(trace.steps):
        for view in views:
            seen = [view if k == t else v for k, v in enumerate(trace.views)]
            changed = Trace.from_steps(seen, list(trace.actions))  # type: ignore[arg-type]
            if view != step.view and solve(changed, theory).status is Status.OPTIMAL:
                mended.add(t)
    assert {mend.step for mend in explanation.mends if mend.kind == "view"} == mended
    if theory.same:
        assert "same" in {mend.kind for mend in explanation.mends}


def test_explain_pair_of_an_impossible_trace_names_the_clash() -> None:
    explanation = explain_pair(IMPOSSIBLE, 0, 2)
    assert explanation.verdict is Verdict.NO_MAP
    assert explanation.clash == explain_trace(IMPOSSIBLE).clash
    assert "the trace has a map" in explain_trace(RECTANGLE.prefix(9)).sentences[0]


def test_explain_pair_at_a_time_limit_is_unknown() -> None:
    explanation = explain_pair(RECTANGLE, 3, 399, time_limit=0.001)
    assert explanation.verdict is Verdict.UNKNOWN
    assert explanation.stopped == "time limit"
    assert not explanation.proven


def test_explain_prints_that_the_time_limit_ended_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "trace.jsonl"
    RECTANGLE.save(path)
    assert main(["explain", str(path), "3", "399", "--time-limit", "0.05"]) == 30
    assert "undecided within 0.05 s; --time-limit gives it more time" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        main(["explain", "--help"])
    assert "inf for no limit (default: 60)" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize(
    ("first", "second", "said"),
    [
        (0, 400, "from 0 to 399, got 400"),
        (-1, 3, "got -1"),
        (3, 3, "3 twice"),
        (True, 3, "got True"),
    ],
)
def test_explain_refuses_wrong_steps(first: int, second: int, said: str) -> None:
    with pytest.raises(TraceError, match=said):
        explain_pair(RECTANGLE, first, second)


@pytest.mark.slow
def test_explain_prints_the_argument(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    impossible, rectangle = tmp_path / "impossible.jsonl", tmp_path / "rectangle.jsonl"
    IMPOSSIBLE.save(impossible)
    RECTANGLE.prefix(5).save(rectangle)
    assert main(["explain", str(rectangle), "0", "2", "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert data == json.loads(json.dumps(explain_pair(RECTANGLE.prefix(5), 0, 2).to_dict()))
    assert main(["explain", str(rectangle), "0", "1", "--theory", "causal"]) == 0
    assert "functional_view" in capsys.readouterr().out
    assert main(["explain", str(impossible)]) == 20
    assert "if the view at step 3 were 'b'" in capsys.readouterr().out
    assert main(["explain", str(impossible), "--json"]) == 20
    assert json.loads(capsys.readouterr().out)["mends"][-1]["instead"] == "'b'"
    assert main(["explain", str(impossible), "0", "2"]) == 20
    assert main(["explain", str(rectangle), "0"]) == 1
    assert main(["explain", str(rectangle), "0", "5"]) == 1
    assert "expected 0 to 4" in capsys.readouterr().err
    assert main(["explain", str(rectangle)]) == 0


def test_explain_uses_the_theory_of_the_maps(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    trace, maps = str(tmp_path / "impossible.jsonl"), tmp_path / "maps.json"
    IMPOSSIBLE.save(trace)
    solve(IMPOSSIBLE, Theory.causal()).save(maps)
    assert main(["explain", trace, "0", "1"]) == 20
    assert main(["explain", trace, "0", "1", "--theory", str(maps)]) == 0
    assert "functional_view" in capsys.readouterr().out
    told = tmp_path / "causal.toml"
    told.write_text('level = "causal"')
    assert main(["explain", trace, "0", "1", "--theory", str(told)]) == 0
    assert "functional_view" in capsys.readouterr().out
    maps.write_text(json.dumps({"maps": []}))
    assert main(["explain", trace, "0", "1", "--theory", str(maps)]) == 1
    assert "expected the theory that the maps were made with" in capsys.readouterr().err


def test_keys_begin_with_labels() -> None:
    """`compare` reads labels out of the keys of the brute force."""
    (ssh_map,) = solve(RECTANGLE.prefix(5)).maps
    assert key(ssh_map)[0] == ssh_map.labels


def test_interrupted_explanation_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The verdict is known by then, and the axioms are not."""

    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("ssh_abduction.explain.pair_reasons.Argument", interrupted)
    RECTANGLE.prefix(5).save(tmp_path / "rectangle.jsonl")
    assert main(["explain", str(tmp_path / "rectangle.jsonl"), "0", "4"]) == 130
    assert capsys.readouterr().out.endswith(
        "different dstates in every map\nno argument was found (interrupted)\n"
    )


def test_explanation_counts_faults() -> None:
    one = Side(True, Cost(8, 4, 4, faults=1.0), proven=True, nats=105.0)
    two = Side(True, Cost(10, 4, 5), proven=True, nats=114.0)
    explanation = PairExplanation(
        0, 8, Verdict.SAME_IN_MINIMAL, one, two, True, None, None, None, Theory(misread=1.0)
    )
    assert explanation.sentences[1] == (
        "making steps 0 and 8 different dstates costs 9.0 nats, with 2 dstates more and "
        "faults for 1 dstate less"
    )


def test_explanation_says_what_the_user_said() -> None:
    trace = Trace.from_steps("abab", ["travel"] * 3)
    for field, said in (
        ("different", "the user says that steps 0 and 2 are different dstates"),
        ("elsewhere", "the user says that steps 0 and 2 are at different places"),
    ):
        explanation = explain_pair(trace, 0, 2, Theory().replace(**{field: [(0, 2)]}))
        assert f"in short: {said}" in str(explanation)
    known = str(explain_pair(trace, 0, 1))
    assert "a dstate has one view, and step 0 sees 'a', step 1 sees 'b'" in known


@pytest.mark.parametrize(
    ("kind", "axiom"), [("misread", "one_pose"), ("slipped", "functional_view")]
)
def test_argument_uses_no_axiom_that_a_fault_may_excuse(kind: str, axiom: str) -> None:
    """It needs only a few steps of a long trace, also where some steps may be wrong."""
    gone = [(8.0, 0.0, 0.0)] * 15
    trace = Trace.from_steps("ab" * 8, ["travel"] * 15, displacements=gone)
    known = solve(trace, Theory.causal()).maps
    found = explain_pair(trace, 3, 4, Theory.causal().replace(**{kind: 1.5}), known=known)
    assert found.verdict is Verdict.DIFFERENT
    assert found.derivation is not None
    assert {link.axiom for link in found.derivation.links} == {axiom}
