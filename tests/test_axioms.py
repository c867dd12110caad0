"""Each axiom alone: a trace on which leaving out this axiom changes the answer."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from typing import Any

import axiom_table
import pytest
from axiom_files import of_each
from worlds import ACTIONS

from ssh_abduction import Theory, Trace, solve
from ssh_abduction.data import Closure, TheoryError
from ssh_abduction.theory import encodings
from ssh_abduction.theory.settle import settle
from ssh_abduction.theory.speedups import TABLE

PLAIN = Theory.topological()
NO_SIDES = PLAIN.replace(boundary="none")
NEXT = NO_SIDES.replace(next_place=True)
ON_PATHS = PLAIN.replace(all_on_paths=True)
FRAME = PLAIN.replace(star="frame")
GATEWAYS = PLAIN.replace(star="gateways")
NONE = None  # no map
Answer = tuple[tuple[int, int, int] | None, int]

# For each axiom: a theory, a trace, the openings or bearings at each step, and the counts and
# number of minimal maps with and without the axiom.
CASES: dict[str, tuple[Theory, str, str, Answer, Answer]] = {
    "functional_view": (PLAIN, "b L a", "", ((2, 1, 0), 1), ((1, 1, 0), 1)),
    "deterministic": (PLAIN, "a R a R b R a", "", ((3, 1, 0), 2), ((2, 1, 0), 1)),
    "one_place": (PLAIN, "a T a", "", ((2, 2, 1), 1), ((1, 2, 1), 1)),
    "turn_stays": (FRAME, "b L a", "right right+back", (NONE, 0), ((2, 2, 0), 1)),
    "travel_leaves": (PLAIN, "a T a", "", ((2, 2, 1), 1), ((1, 1, 1), 1)),
    "travel_follows_path": (PLAIN, "a T a", "", ((2, 2, 1), 1), ((2, 2, 0), 1)),
    "one_course": (ON_PATHS, "a L a", "", ((2, 1, 2), 1), ((1, 1, 2), 1)),
    "turn_around_reverses": (ON_PATHS, "c A c", "", ((2, 1, 1), 1), ((1, 1, 1), 1)),
    "turn_changes_path": (ON_PATHS, "b L a", "", ((2, 1, 2), 1), ((2, 1, 1), 1)),
    "one_dstate_per_course": (PLAIN, "a T b A c A d", "", (NONE, 0), ((4, 2, 1), 1)),
    "on_path": (PLAIN, "a T b R b T a", "", ((4, 3, 2), 1), ((4, 2, 2), 1)),
    "travel_orders": (PLAIN, "a T a T a", "", ((3, 3, 1), 1), ((2, 2, 1), 1)),
    "order_asymmetric": (PLAIN, "a T a T a", "", ((3, 3, 1), 1), ((2, 2, 1), 1)),
    "order_transitive": (PLAIN, "a T a T a T a", "", ((4, 4, 1), 1), ((3, 3, 1), 1)),
    "path_order_total": (NEXT, "a T a A b T b A b", "", (NONE, 0), ((5, 3, 1), 1)),
    "next_place": (NEXT, "b T a T b A b T b", "", ((5, 3, 1), 1), ((5, 3, 1), 2)),
    "all_on_paths": (ON_PATHS, "b L a", "", ((2, 1, 2), 1), ((2, 1, 0), 1)),
    "course_needs_travel": (PLAIN, "b T c R c L b", "", ((4, 2, 1), 1), ((4, 2, 1), 2)),
    "branch_side": (ON_PATHS, "a T b R a L a", "", ((4, 2, 3), 1), ((4, 2, 2), 1)),
    "symmetric_sides": (ON_PATHS, "a T b R a L a", "", ((4, 2, 3), 1), ((4, 2, 2), 1)),
    "side_of_branch": (ON_PATHS, "a T b R a L a", "", ((4, 2, 3), 1), ((4, 2, 2), 1)),
    "sides_disjoint": (ON_PATHS, "a T b R a L a", "", ((4, 2, 3), 1), ((4, 2, 2), 1)),
    "path_between_sides": (PLAIN, "a T b R b T a", "", ((4, 3, 2), 1), ((4, 2, 2), 1)),
    "star_pattern": (
        PLAIN.replace(star="pattern"),
        "b L a",
        "back right+back",
        (NONE, 0),
        ((2, 1, 0), 1),
    ),
    "star_frame": (FRAME, "b R a", "ahead+right ahead+right", (NONE, 0), ((2, 1, 0), 1)),
    "one_heading": (FRAME, "c R c", "ahead left", ((2, 1, 0), 1), ((1, 1, 0), 1)),
    "turn_rotates": (FRAME, "b L a", "ahead back", (NONE, 0), ((2, 1, 0), 1)),
    "one_dstate_per_heading": (FRAME, "a R b L c", "ahead left ahead", (NONE, 0), ((3, 1, 0), 1)),
    "planar": (PLAIN.replace(planar=True), "a T a T a A a T a", "", ((5, 3, 1), 1), ((5, 3, 1), 2)),
    "asserted": (
        PLAIN.replace(different=[(0, 2)]),
        "a R a R a",
        "",
        ((2, 1, 0), 1),
        ((1, 1, 0), 1),
    ),
    "gateway_frame": (
        GATEWAYS,
        "a T b R c T d R e T f",
        "0+60 180+120 0+60 180+120 0+60 180",
        ((6, 4, 3), 1),
        ((6, 3, 3), 1),
    ),
    "gateway_heading": (GATEWAYS, "a R a", "0+120 0+240", ((2, 1, 0), 1), ((1, 1, 0), 1)),
    "gateway_turn": (GATEWAYS, "b A a", "0 120", (NONE, 0), ((2, 1, 0), 1)),
    "gateway_dstate": (GATEWAYS, "a R b L c", "0+120 0+240 0+120", (NONE, 0), ((3, 1, 0), 1)),
    "gateway_path": (
        GATEWAYS,
        "a T a A a T a",
        "0+60+240 180 0 0+180+300",
        ((4, 3, 1), 1),
        ((4, 2, 1), 1),
    ),
    "gateway_end": (GATEWAYS, "a T b T c", "0 180 180", (NONE, 0), ((3, 3, 1), 1)),
    "one_star": (
        Theory.causal().replace(star="alike"),
        "a R a",
        "0+90 0+120",
        ((2, 0, 0), 1),
        ((1, 0, 0), 1),
    ),
    "other_floor": (PLAIN, "a U a", "", ((2, 2, 0), 1), ((1, 1, 0), 1)),
    "one_landing": (PLAIN, "a U b T f S a R c U f", "", ((5, 3, 1), 1), ((4, 3, 1), 1)),
    "path_in_one_piece": (PLAIN, "a T b U c T d", "", ((4, 4, 2), 1), ((4, 4, 1), 2)),
    "one_pose": (PLAIN, "a R a", "", ((2, 1, 0), 1), ((1, 1, 0), 1)),
    "closure": (PLAIN, "a R a", "", ((2, 1, 0), 1), ((1, 1, 0), 1)),
    "path_goes_straight": (
        FRAME,
        "a T a A a T a",
        "back right left left",
        ((4, 3, 1), 1),
        ((4, 2, 1), 1),
    ),
    **of_each("CASE"),
}

MOVED = {"one_pose": [(0.0, 0.0, -math.pi / 2)]}  # displacements for axioms about them
MATCHED = {"closure": (Closure(0, 1, (0.0, 0.0, 1.5), ((1, 0, 0), (0, 1, 0), (0, 0, 0.01))),)}


def trace_of(
    text: str, openings: str, moved: list[tuple[float, float, float]] | None = None
) -> Trace:
    words = text.split()
    sides = ("ahead", "right", "back", "left")
    stars: list[list[float]] = []
    for seen in openings.split():
        words_seen = seen.split("+")
        stars.append(
            [float(word) for word in words_seen]
            if words_seen[0].isdigit()
            else [side in words_seen for side in sides]
        )
    return Trace.from_steps(
        words[0::2], [ACTIONS[a] for a in words[1::2]], stars=stars or None, displacements=moved
    )


def answer(trace: Trace, theory: Theory) -> Answer:
    solution = solve(trace, theory, max_maps=None)
    assert solution.complete
    cost = solution.cost
    return (cost and (cost.dstates, cost.places, cost.paths)), solution.count


def test_every_axiom_has_a_case() -> None:
    assert set(CASES) == {axiom.name for axiom in encodings.axioms()}


@pytest.mark.parametrize("axiom", CASES)
def test_leaving_out_one_axiom_changes_the_answer(axiom: str) -> None:
    theory, text, openings, with_it, without_it = CASES[axiom]
    theory = theory.replace(weigh="count")
    trace = replace(trace_of(text, openings, MOVED.get(axiom)), closures=MATCHED.get(axiom, ()))
    assert axiom in settle(trace, theory).theory.axioms
    assert answer(trace, theory) == with_it
    assert answer(trace, theory.replace(without=(axiom,))) == without_it


@pytest.mark.parametrize(
    "axiom", [*encodings.axioms(), *encodings.region_axioms()], ids=lambda a: a.name
)
def test_an_axiom_has_a_sentence_and_a_source(axiom: Any) -> None:
    assert re.fullmatch(r"[A-Z].*\.", axiom.sentence)
    assert axiom.source


@pytest.mark.parametrize("level", encodings.levels())
def test_every_violation_in_the_encodings_belongs_to_an_axiom(level: str) -> None:
    text = (encodings.folder() / f"{level}.lp").read_text()
    names = {axiom.name for axiom in encodings.axioms() if axiom.level == level}
    # Python checks `planar` on whole maps, and the others on pairs of steps.
    without_a_rule = {"planar", "one_star", "closure"}
    assert set(re.findall(r"violation\((\w+),t\) :-", text)) - {"N"} == names - without_a_rule
    assert set(re.findall(r"% @axiom\((\w+)\)", text)) == names


def test_a_long_axiom_comment_goes_on_in_indented_lines() -> None:
    text = (
        "% @axiom(long) A sentence that\n%   goes on.\n%   [a source; X] if star=frame\n% Not of "
        "it.\n"
    )
    (axiom,) = encodings.axioms_in(text, "own")
    assert axiom.sentence == "A sentence that goes on."
    assert axiom.source == "a source; X"
    assert axiom.conditions == ("star=frame",)


def test_page_of_the_theory_lists_the_axioms() -> None:
    text = axiom_table.PAGE.read_text(encoding="utf-8")
    assert axiom_table.page(text) == text, "run python website/axiom_table.py"


def test_an_encoding_declares_fields_of_a_theory() -> None:
    assert Theory().declared["path_places"] == 0
    theory = PLAIN.replace(path_places=2)
    assert Theory.from_dict(theory.to_dict()) == theory
    assert "path_places" not in PLAIN.to_dict()
    with pytest.raises(TheoryError, match="path_places: expected a whole number from 0"):
        PLAIN.replace(path_places=-1)


def test_speedups_that_do_not_know_a_declared_field_are_off() -> None:
    for field in encodings.declared():
        choices = {field.name: True if isinstance(field.default, bool) else field.default + 1}
        for base in (PLAIN.replace(star="none"), FRAME, GATEWAYS):
            theory = base.replace(**choices)
            new = theory.demands - base.demands
            assert new
            for speedup in TABLE:
                if speedup.keeps is not None and not new <= speedup.keeps():
                    assert not speedup.holds_for(theory), (field.name, speedup.name)


def test_lines_of_encodings_have_at_most_100_characters() -> None:
    files = list(encodings.folder().rglob("*.lp"))
    assert files
    for file in files:
        assert max(map(len, file.read_text(encoding="utf-8").splitlines())) <= 100, file
