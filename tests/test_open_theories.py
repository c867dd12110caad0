"""Added axioms are obeyed everywhere, online and offline, although no speed-up and no checker knows
them."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar
from unittest.mock import patch

import pytest
from brute_force import Key, key, minimal_maps
from hypothesis import given, settings
from hypothesis import strategies as st
from instances import maze
from strategies import TOYS, Toy, traces
from turns import stepwise
from worlds import ACTIONS

from ssh_abduction import OnlineMapper, SSHMap, Theory, Trace, solve
from ssh_abduction.checker import check
from ssh_abduction.checker.checker import unchecked
from ssh_abduction.cli import main
from ssh_abduction.data import TheoryError
from ssh_abduction.explain.no_map import explain
from ssh_abduction.online.keeper import ExtendedMap
from ssh_abduction.solution import Status
from ssh_abduction.solver import Search
from ssh_abduction.solver.board import InternalError
from ssh_abduction.solver.sources.exact import choosing, prefixes
from ssh_abduction.solver.sources.exact.engine import Task
from ssh_abduction.solver.sources.exact.labels_first import LabelsFirst
from ssh_abduction.solver.sources.exact.readable import StepEngine
from ssh_abduction.theory import Speedups, encodings
from ssh_abduction.theory import settle as problems
from ssh_abduction.theory.encodings import Rules
from ssh_abduction.theory.evidence import Equality, evidence_of
from ssh_abduction.theory.pairs import NO_PAIRS, Pairs
from ssh_abduction.theory.settle import settle
from ssh_abduction.theory.speedups import SPEEDUPS, TABLE, row

EXAMPLES = Path(__file__).parent.parent / "examples"
FORGETFUL = Rules(
    "forgetful.lp",
    "% @axiom(forgetful) No dstate is seen twice more than 10 steps apart.\n#program "
    "step(t).\nviolation(forgetful,t) :- same(I,t), t-I > 10.",
)
# The brute force of these tests counts, also if a trace has displacements.
THEORIES = {
    "causal": Theory.causal().replace(weigh="count"),
    "topological": Theory.topological().replace(weigh="count"),
    "circumscriptive": Theory.circumscriptive().replace(weigh="count"),
}


def with_toy(toy: Toy, theory: Theory) -> Theory:
    return theory.replace(rules=(toy.rules,))


@pytest.mark.parametrize(
    ("name", "toy"),
    [
        pytest.param(name, toy, id=f"{name}-{toy.rules.name}")
        for name in THEORIES
        for toy in TOYS
        if toy.causal or name != "causal"
    ],
)
@settings(max_examples=1)
@given(data=st.data())
def test_own_axiom_is_obeyed_offline_and_online(name: str, toy: Toy, data: st.DataObject) -> None:
    """Solve offline and online, against the brute force. The first prefixes are so short that
    replay would overlook the axiom."""
    theory, allows = with_toy(toy, THEORIES[name]), toy.allows
    trace = data.draw(traces(max_steps=5), label="trace")
    mapper: OnlineMapper | None = None
    with patch.object(prefixes, "FIRST_PREFIX", 1), patch.object(choosing, "FEW_STEPS", 0):
        for steps in range(1, len(trace) + 1):
            prefix = trace.prefix(steps)
            counts, expected = minimal_maps(prefix, replace(theory, rules=()), allows)
            if mapper is None:
                first = trace.steps[0]
                assert first.view is not None
                mapper = OnlineMapper(
                    first.view,
                    theory,
                    star=first.star,
                    odometry=trace.odometry,
                    time_limit=None,
                    max_maps=None,
                )
                online = mapper.solution
            else:
                step, before = trace.steps[steps - 1], trace.steps[steps - 2].action
                assert step.view is not None
                assert before is not None
                online = mapper.observe(
                    before,
                    step.view,
                    star=step.star,
                    displacement=step.displacement,
                    covariance=step.covariance,
                )
            for solution in (online, solve(prefix, theory, max_maps=None)):
                assert solution.status is (Status.OPTIMAL if counts else Status.UNSATISFIABLE)
                assert {key(ssh_map) for ssh_map in solution.maps} == expected


@pytest.mark.parametrize(("steps", "dstates"), [(24, 16), (61, 53)])
def test_own_rule_about_pairs_holds_on_circuits(steps: int, dstates: int) -> None:
    trace = Trace.load(EXAMPLES / "notched-rectangle.jsonl").prefix(steps)
    solution = solve(trace, Theory.causal().replace(rules=[FORGETFUL]))
    assert solution.status is Status.OPTIMAL
    assert solution.cost
    assert solution.cost.dstates == dstates


@pytest.fixture
def own_encodings(tmp_path: Path) -> Iterator[Path]:
    """A copy of the encodings that a test may change. It replaces them."""
    folder = tmp_path / "encodings"
    shutil.copytree(encodings.folder(), folder)
    caches = (encodings.levels, encodings.axioms, encodings.paths, encodings.keeps)
    for cached in caches:
        cached.cache_clear()
    with patch.object(encodings, "folder", lambda: folder):
        yield folder
    for cached in caches:
        cached.cache_clear()


@pytest.fixture
def wider(own_encodings: Path) -> type[Theory]:
    """A folder of encodings with one more file, and a theory with one more field, as if somebody
    adds an axiom and forgets the rest."""
    (own_encodings / "forgetful.lp").write_text(
        "% Toy.\n#program step(t).\n% @axiom(forgetful) No dstate is seen twice more than 10 "
        "steps apart. [a toy] if forgetful\n"
        "violation(forgetful,t) :- axiom(forgetful), same(I,t), t-I > 10.\n"
    )

    @dataclass(frozen=True)
    class Wider(Theory):
        forgetful: bool = False

    return Wider


def test_axiom_added_to_encodings_and_theory_is_obeyed(
    wider: type[Theory],
) -> None:
    trace = Trace.load(EXAMPLES / "notched-rectangle.jsonl").prefix(24)
    causal = wider.causal().replace(forgetful=True)
    solution = solve(trace, causal)
    assert (solution.status, solution.cost and solution.cost.dstates) == (Status.OPTIMAL, 16)
    assert unchecked(causal) == ("forgetful",)
    mapper = OnlineMapper("v0", causal, time_limit=None)
    for step, before in zip(trace.steps[1:], trace.actions, strict=True):
        assert step.view is not None
        mapper.observe(before, step.view)
    assert mapper.solution.cost
    assert mapper.solution.cost.dstates == 16


@pytest.mark.parametrize(
    ("speedup", "theory"), [("visits", Theory(star="frame")), ("ways", Theory(star="none"))]
)
def test_speedups_are_off_if_a_shared_encoding_drops_an_axiom(
    own_encodings: Path, speedup: str, theory: Theory
) -> None:
    assert row(speedup).holds_for(theory)
    shared = own_encodings / "fast" / "paths.lp"
    shared.write_text(shared.read_text().replace("path_order_total ", ""))
    encodings.paths.cache_clear()
    encodings.keeps.cache_clear()
    assert not row(speedup).holds_for(theory)


def test_encodings_are_not_read_from_the_working_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """clingo's own `#include` reads them from there."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "paths.lp").write_text(":- not never.")
    (tmp_path / "fast").mkdir()
    (tmp_path / "fast" / "paths.lp").write_text(":- not never.")
    trace = maze(2, 2, steps=60, seed=1, stars=True).trace
    assert solve(trace, Theory(star="frame")).status is Status.OPTIMAL


def test_unknown_theory_field_switches_off_exact_speedups() -> None:
    @dataclass(frozen=True)
    class Wider(Theory):
        penalty: float | None = None

    causal = Wider.causal().replace(prefer=("dstates",))
    exact = [speedup for speedup in TABLE if speedup.keeps is not None and speedup.suits(causal)]
    assert {speedup.name for speedup in exact} >= {"prefixes", "named dstates"}
    assert all(speedup.holds_for(causal) for speedup in exact)
    assert not any(speedup.holds_for(causal.replace(penalty=1.5)) for speedup in exact)


def test_every_speedup_has_a_row_and_a_switch() -> None:
    assert {speedup.switch for speedup in TABLE} == set(SPEEDUPS)
    for speedup in TABLE:
        assert row(speedup.name) is speedup
        assert speedup.rests_on <= {axiom.name for axiom in encodings.axioms()}


@pytest.mark.parametrize("axiom", ["functional_view", "deterministic"])
def test_speedup_is_off_without_its_axiom(axiom: str) -> None:
    resting = [speedup for speedup in TABLE if axiom in speedup.rests_on]
    assert len(resting) > 5
    assert not any(
        speedup.holds_for(Theory.causal().replace(without=(axiom,))) for speedup in resting
    )


@dataclass(frozen=True)
class NoLongReturns:
    """A toy kind of evidence that only a whole map shows: no three steps of one dstate."""

    name: ClassVar[str] = "seldom"
    axiom: ClassVar[str] = "seldom"

    @classmethod
    def of(cls, theory: Theory) -> NoLongReturns:
        return cls()

    def pairs(self, trace: Trace) -> Pairs:
        return NO_PAIRS

    def facts(self, trace: Trace, start: int, stop: int) -> str:
        return ""

    def refuse(self, trace: Trace, ssh_map: SSHMap, since: int = 0) -> frozenset[Equality] | None:
        steps: dict[int, list[int]] = {}
        for t, label in enumerate(ssh_map.labels):
            if len(found := steps.setdefault(label, [])) == 2:
                return frozenset({Equality(found[0], found[1]), Equality(found[1], t)})
            found.append(t)
        return None


WITH_LONG_RETURNS_REFUSED = patch.object(
    problems, "evidence_of", lambda theory, known=(): (*evidence_of(theory), NoLongReturns())
)


def has_no_long_returns(found: Key) -> bool:
    return all(found[0].count(label) <= 2 for label in found[0])


@pytest.mark.parametrize("name", THEORIES)
@settings(max_examples=6)
@given(data=st.data())
def test_maps_refused_by_evidence_are_forbidden(name: str, data: st.DataObject) -> None:
    """The answer is that of the brute force, whichever maps clingo finds first."""
    trace = data.draw(traces(max_steps=5), label="trace")
    named = Rules("seldom.lp", "% @axiom(seldom) No dstate is seen three times.\n")
    theory = THEORIES[name].replace(rules=(named,))

    counts, expected = minimal_maps(trace, THEORIES[name], has_no_long_returns)
    with (
        WITH_LONG_RETURNS_REFUSED,
        patch.object(prefixes, "FIRST_PREFIX", 1),
        patch.object(choosing, "FEW_STEPS", 0),
    ):
        solution = solve(trace, theory, max_maps=None)
    assert solution.status is (Status.OPTIMAL if counts else Status.UNSATISFIABLE)
    assert {key(ssh_map) for ssh_map in solution.maps} == expected


FAST = {
    "causal": (THEORIES["causal"], LabelsFirst),
    "framed": (
        Theory(star="frame", path_order="total", boundary="none", weigh="count"),
        LabelsFirst,
    ),
    "frameless": (Theory(star="none", weigh="count"), LabelsFirst),
}


def test_frameless_engine_without_a_map_left_yields_none() -> None:
    trace = Trace.from_steps("aba", ["around", "around"])
    engine = LabelsFirst(Task.of(settle(trace, Theory(star="none", same=((0, 2),)))))
    engine.grow(len(trace))
    assert [*engine.improving_maps()]
    assert engine.forbid([Equality(0, 2)])
    assert [*engine.improving_maps()] == []


@pytest.mark.parametrize("name", FAST)
@settings(max_examples=6)
@given(data=st.data())
def test_every_engine_forbids_maps_refused_by_evidence(name: str, data: st.DataObject) -> None:
    """An engine that settles dstates first obeys it, too. Its maps are those of the brute force."""
    theory, kind = FAST[name]
    trace = data.draw(traces(max_steps=5), label="trace")
    if theory.star == "frame" and not trace.has_stars:
        return

    counts, expected = minimal_maps(trace, settle(trace, theory).theory, has_no_long_returns)
    with (
        WITH_LONG_RETURNS_REFUSED,
        patch.object(
            prefixes, "FIRST_PREFIX", data.draw(st.sampled_from([1, 8]), label="first prefix")
        ),
        patch.object(choosing, "FEW_STEPS", 0),
        stepwise(-1.0),
    ):
        asked = Search(trace, theory, max_maps=None, speedups=Speedups())
        found = tuple(asked)
    assert isinstance(asked.parts.prefixes.engine, kind) or name == "frameless"
    assert asked.status is (Status.OPTIMAL if counts else Status.UNSATISFIABLE)
    assert {key(ssh_map) for ssh_map in found} == expected


@pytest.mark.slow
def test_impossible_assertions_and_rules_are_unsatisfiable() -> None:
    trace = Trace.load(EXAMPLES / "aces3-route.jsonl")[:17]
    at_check = Rules("one.lp", "#program check(t).\n:- query(t), not same_place(5,15).")
    at_step = Rules("one.lp", "#program step(t).\n:- t = 15, not same_place(5,t).")
    for choices in ({"same": [(5, 15)]}, {"rules": [at_check]}, {"rules": [at_step]}):
        assert solve(trace, Theory(**choices)).status is Status.UNSATISFIABLE  # type: ignore[arg-type]


def test_explanation_names_assertions_and_own_axioms() -> None:
    trace = Trace.from_steps("aba", ["travel", "travel"])
    said = explain(trace, Theory.topological().replace(same=[(0, 1)]))
    assert said
    assert {"asserted", "functional_view"} == set(said.axioms)
    rules = Rules(
        "own.lp",
        "% @axiom(new) All dstates are seen again.\n#program step(t).\nviolation(new,t) :- t > 0, "
        "not same(0,t).",
    )
    said = explain(trace, Theory.topological().replace(rules=[rules]))
    assert said
    assert "new" in said.axioms


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            ":- same(I,T), T-I > 10.",
            r"own\.lp:1: same: expected this rule in a program part of .* #program step\(t\)\.",
        ),
        ("far :- act(0,A).", r"own\.lp:1: act: expected this rule in a program part of steps"),
        ("#program step(t).\n:- same(I,t) t > 3.", r"own\.lp:2:\d+-\d+: error: syntax error"),
        ("#program step(t).\n:- same(I,t), X > 3.", r"own\.lp:2.*unsafe"),
        (
            "#program step(t).\nviolation(odd,t) :- same(I,t).",
            r"own\.lp:2: violation\(odd,…\): expected a sentence for it; write % @axiom\(odd\)",
        ),
        (
            "#program step(t).\n:- sameplace(I,t).",
            r"own\.lp:2: sameplace: expected an atom that this theory has, .*same_place",
        ),
        (
            "#program step(t).\nsame(0,t) :- act(t-1,A).",
            r"own\.lp:2: expected a rule that reads same, got one that defines it",
        ),
        (
            "#program steps(t).\n:- same(I,t).",
            r"own\.lp:1: expected a program part base, step\(t\) or check\(t\)",
        ),
        (
            "#program step(t).\n:- not same_place(5,15).",
            r"own\.lp:2: not same_place\(5,15\): expected an atom with t as its last step",
        ),
        ("#minimize { 1,I : same(I,3) }.", r"own\.lp:1: expected rules, got"),
        ("#show same/2.", r"own\.lp:1: expected rules, got #show"),
        (
            "#program step(t).\n:- same(@first(1),t).",
            r"own\.lp:2: expected rules without functions of Python, got @first\(1\); write rules",
        ),
        (
            "#program step(t).\n:- same(I,t,5).",
            r"own\.lp:2: same\(I,t,5\): expected 2 arguments, got 3",
        ),
        (
            "% @axiom(odd) Mine.\n#program step(t).\nviolation(odd) :- same(0,t).",
            r"own\.lp:3: violation\(odd\): expected 2 arguments, got 1",
        ),
        (
            '#include "other.lp".\n',
            r"own\.lp: expected rules, got #include of other\.lp; give that file, too",
        ),
        ("#external own(1).", r"own\.lp:1: expected rules, got #external"),
        ("#script (python)\n#end.", r"own\.lp:1: expected rules, got #script"),
        (
            "% @axiom(deterministic) Mine.\n",
            r"own\.lp: @axiom\(deterministic\): expected a name that no other axiom has",
        ),
    ],
)
def test_unreadable_rules_are_refused_with_advice(
    text: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("own.lp").write_text(text)
    Path("other.lp").write_text("limit(3).")
    with pytest.raises(TheoryError, match=message) as error:
        solve(Trace.from_steps("aa", ["travel"]), Theory(rules=["own.lp"]))
    assert "\n" not in str(error.value)


SOUND = (
    "% @axiom(near) No step is seen again soon.\n#program step(t).\nviolation(near,t) :- "
    "same(I,t), t-I > 10.\n"
)


@pytest.mark.parametrize(
    "data",
    [
        b"\xef\xbb\xbf" + SOUND.encode(),
        SOUND.replace("\n", "\r\n").encode(),
        SOUND.replace("\n", "\r").encode(),
        SOUND.replace("soon", "bientôt, “là”").encode(),
        f'{SOUND}%* é %* nested *% “ *%\nown("é\\"”"). % é'.encode(),
    ],
)
def test_rules_with_any_line_ends_are_read(data: bytes, tmp_path: Path) -> None:
    (tmp_path / "own.lp").write_bytes(data)
    theory = Theory.causal().replace(rules=[tmp_path / "own.lp"])
    assert [axiom.name for axiom in theory.rules[0].axioms] == ["near"]
    assert len(solve(Trace.from_steps("abab", ["travel"] * 3), theory).maps[0].dstates) == 2
    apart = Trace.from_steps("a" + "b" * 11 + "a", ["travel"] * 12, displacements=[(1, 0, 0)] * 12)
    assert (
        solve(apart, theory.replace(displacement="none")).maps[0].labels[-1] != 0
    )  # so the rule is not part of a comment


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ("#program step(t).\n:- same(I,t), t-I > é.", (
            r"own\.lp:2:21: expected ASCII outside of quotes and comments, got 'é' \(U\+00E9\); "
            r"put it in quotes"
        )),
        ("%* a\n% *%\n*% é.", r"own\.lp:3:4: expected ASCII"),
        ("a(“x”).", r"own\.lp:1:3: expected ASCII .*U\+201C"),
        ("a.\u00a0b.", r"own\.lp:1:3: expected ASCII .*U\+00A0"),
        ('a("é', r"own\.lp:1:4: expected ASCII"),
        ('a("é\n").', r"own\.lp:1:4: expected ASCII"),
        ('a("\\é").', r"own\.lp:1:5: expected ASCII"),
        ("a.\ufeff", r"own\.lp:1:3: expected ASCII .*U\+FEFF"),
        ("a.\0:- b.", r"own\.lp:1:3: expected ASCII .*U\+0000\); save it as UTF-8"),
        ("% \0", r"own\.lp:1:3: expected ASCII"),
        ("#script (lua) % #end ” ", r"own\.lp:1: expected rules, got #script"),
        (SOUND.encode("utf-16"), "cannot be read: no text in UTF-8; save it as UTF-8"),
        (SOUND.encode("utf-16-le"), r"own\.lp:1:2: expected ASCII .*U\+0000"),
        ("% é".encode("latin-1"), "cannot be read: no text in UTF-8; save it as UTF-8"),
    ],
)  # fmt: skip
def test_rules_with_characters_that_abort_clingo_are_refused(
    data: str | bytes, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Such files abort clingo, or end its reading."""
    path, trace = tmp_path / "own.lp", tmp_path / "trace.jsonl"
    path.write_bytes(data.encode() if isinstance(data, str) else data)
    Trace.from_steps("aa", ["travel"]).save(trace)
    solve(Trace.from_steps("aa", ["travel"])).maps[0].save(tmp_path / "map.json")
    known = str(tmp_path / "map.json")
    for verb, *maps in (["solve"], ["explain"], ["next", known], ["check", known]):
        assert main([verb, *maps, str(trace), "--set", f"rules={path}"]) == 1
        assert re.search(message, capsys.readouterr().err)
    with pytest.raises(TheoryError, match=message):
        Theory.causal().replace(rules=[path])
    if isinstance(data, str):
        with pytest.raises(TheoryError, match=message):
            Rules("own.lp", data)


def test_malformed_rules_are_refused() -> None:
    with pytest.raises(TheoryError, match="half a character"):
        Rules("own.lp", 'a("\ud800").')
    with pytest.raises(TheoryError, match="expected a name and a text"):
        Rules("own.lp", b"a.")  # type: ignore[arg-type]
    with pytest.raises(TheoryError, match=r"a\\1\.lp:1:\d"):
        solve(Trace.from_steps("aa", ["travel"]), Theory(rules=[Rules("a\\1.lp", "a :- b(.")]))


@pytest.mark.parametrize(
    ("text", "where"),
    [("#program step(t).\n:- same(I,t), X > 3.", "b.lp:2"), ("#const n = 2.", "b.lp:1")],
)
def test_error_names_the_wrong_file_of_rules(text: str, where: str) -> None:
    rules = [Rules("a.lp", "#const n = 1."), Rules("b.lp", text)]
    for files in (rules, rules[::-1]) if "same" in text else (rules,):
        with pytest.raises(TheoryError, match=where):
            solve(Trace.from_steps("aa", ["travel"]), Theory(rules=files))


@pytest.mark.parametrize("words", ["solve T", "solve T --jobs 1", "check M T"])
def test_assertion_about_an_unknown_step_is_an_error(
    words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    trace = Trace.from_steps("aa", ["travel"])
    trace.save(tmp_path / "T")
    solve(trace).maps[0].save(tmp_path / "M")
    assert (
        main(
            [
                *(str(tmp_path / word) if word in "TM" else word for word in words.split()),
                "--same=0,2",
            ]
        )
        == 1
    )
    captured = capsys.readouterr()
    assert "same (--same): expected steps from 0 to 1, got 0,2" in captured.out + captured.err
    with pytest.raises(TheoryError, match="expected steps from 0 to 1, got 0,2"):
        solve(trace, Theory(same=[(0, 2)]))


def test_endless_file_of_rules_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ssh_abduction.theory.encodings.LARGEST", 100)
    (tmp_path / "own.lp").write_text("% long\n" * 100)
    with pytest.raises(TheoryError, match="cannot be read: expected at most"):
        Theory.causal().replace(rules=[tmp_path / "own.lp"])


def test_rules_can_define_facts_and_atoms() -> None:
    rules = Rules(
        "own.lp",
        "#const most = 1.\nlimit(most).\nfar(I,T) :- pair(I,T).\npair(0,2).\n#program "
        "step(t).\n:- far(I,t), same(I,t), limit(1).",
    )
    assert (
        solve(Trace.from_steps("aaa", ["right", "right"]), Theory(rules=[rules])).cost
        == solve(Trace.from_steps("aaa", ["right"] * 2), Theory(different=[(0, 2)])).cost
    )


def test_inconsistent_map_of_an_engine_is_an_internal_error() -> None:
    trace = Trace.from_steps("abab", [ACTIONS["T"]] * 3)
    found = StepEngine._read

    def wrong(self: StepEngine, model: object) -> object:
        right = found(self, model)  # type: ignore[arg-type]
        return replace(right, map=replace(right.map, dstate_at=(0,) * len(right.map.labels)))

    with (
        patch.object(StepEngine, "_read", wrong),
        pytest.raises(InternalError, match=rf"internal error: a map .* \(trace {trace.digest}\)"),
    ):
        solve(trace, Theory.causal())


def follow(mapper: OnlineMapper, views: str) -> None:
    for view in views:
        mapper.observe("travel", view)


def test_inconsistent_replayed_map_is_an_internal_error() -> None:
    """Replays are checked, too, as long as that takes a tenth of the time at most."""
    mapper = OnlineMapper("a", Theory.causal(), time_limit=None)
    right = ExtendedMap.explained

    def wrong(self: ExtendedMap) -> SSHMap:
        found = right(self)
        return replace(found, dstate_at=(0,) * len(found.labels))

    with (
        patch.object(ExtendedMap, "explained", wrong),
        pytest.raises(InternalError, match="internal error: a map that was found breaks"),
    ):
        follow(mapper, "bababa")


def test_assertions_enlarge_the_pinned_clique() -> None:
    """Then more steps differ, so the pinned clique is larger, and clingo need not find that out."""
    trace = Trace.from_steps("ab" * 20, ["travel"] * 39)
    cliques = []
    grow = LabelsFirst.grow

    def noted(self: LabelsFirst, size: int) -> None:
        grow(self, size)
        cliques.append(len(self._labels.program.clique))

    theory = Theory.causal().replace(different=[(0, 2), (0, 4), (2, 4)])
    with patch.object(LabelsFirst, "grow", noted):
        solution = solve(trace, theory, speedups=Speedups.without("prefixes"))
    assert (
        cliques[-1] == 5
    )  # steps 0, 2 and 4, and so 1 and 3, from which the same action leads to two of these
    assert solution.cost == solve(trace, theory, speedups=Speedups.without(SPEEDUPS)).cost
    assert check(trace, solution.maps[0], theory) == ()


def test_rule_that_can_never_fire_is_warned_of() -> None:
    """Views are texts, so view(t,v0) without quotes matches no step."""
    rules = Rules(
        "own.lp",
        "% @axiom(m) x.\n#program step(t).\nviolation(m,t) :- view(t,v0), view(t-1,_).\n"
        'violation(m,t) :- view(t,"v0"), act(t-1,stay), not view(t-1,v1), same(I,t).\n',
    )
    trace = Trace.from_steps(["v0", "v1", "v0"], ["go", "go"])
    solution = solve(trace, Theory.causal().replace(rules=[rules]))
    assert solution.warnings == (
        "own.lp:3: view(t,v0) holds at no step of this trace, so its rule has no effect; write "
        '"v0" in quotes',
        "own.lp:4: act((t-1),stay) holds at no step of this trace, so its rule has no effect",
    )


def test_rules_that_exclude_no_minimal_map_keep_the_answer_of_a_long_trace() -> None:
    trace = Trace.from_steps("abcdefgh" * 8, [*["travel", "right"] * 31, "travel"])
    harmless = Rules("own.lp", "#program step(t). :- same(I,t), t-I > 64.")
    free = solve(trace, Theory.topological(), work_limit=1)
    bound = solve(trace, Theory.topological().replace(rules=[harmless]), work_limit=1)
    assert bound.status is free.status is Status.OPTIMAL
    assert bound.complete
    assert set(bound.maps) == set(free.maps)
    # If no minimal map obeys, there is still some map, and the bound holds.
    theory = Theory.topological().replace(rules=[FORGETFUL])
    found = solve(trace, theory, work_limit=1)
    assert found.bound.dstates is not None
    assert found.bound.dstates >= len(free.maps[0].dstates)
    assert len(found.maps[0].dstates) > len(free.maps[0].dstates)
