"""Random tiny traces, and random theories that suit them, for hypothesis."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from dataclasses import dataclass, fields, replace
from typing import Any

from brute_force import Key
from hypothesis import strategies as st

from ssh_abduction.data.odometry import Closure, Covariance, Odometry, displacement_between
from ssh_abduction.data.odometry import moved as moved_pose
from ssh_abduction.data.trace import STANDARD_ACTIONS, Action, Trace
from ssh_abduction.theory import encodings
from ssh_abduction.theory.encodings import Rules
from ssh_abduction.theory.fields import COUNTS, Count
from ssh_abduction.theory.theory import Theory

ACTIONS = (*STANDARD_ACTIONS.values(), Action("creep", "travel"), Action("veer", "turn", "right"))
# Few openings, so that stars often agree: all alike, a straight street, a corner, a dead end, a
# tee.
ODOMETRY = (
    {},
    {"scale": 0.0, "bend": 0.0},
    {"along": 0.2, "heading": 0.02, "bend": 0.0},
    {"bend": 0.02, "position": 0.5},
    {"offset": 0.8, "facing": 0.1},
)
STARS = ((1, 1, 1, 1), (1, 0, 1, 0), (1, 1, 0, 0), (1, 0, 0, 0), (1, 1, 1, 0))


FOREIGN = ("without", "rules")  # axioms that the checker cannot judge
PAIRS = ("same", "different", "elsewhere", "same_place")
# Axioms that may be left out. The others give each dstate one place and one course, and a map
# cannot show more.
LEFT_OUT = sorted(
    {axiom.name for axiom in encodings.axioms()}
    - {"one_place", "one_course", "one_heading", "turn_rotates", "star_frame", "asserted"}
)


@dataclass(frozen=True)
class Toy:
    """An axiom that no speed-up and no checker knows: as rules, and as a test of a map of the brute
    force."""

    rules: Rules
    allows: Callable[[Key], bool]
    causal: bool = True


def _toy(
    name: str, part: str, text: str, allows: Callable[[Key], bool], *, causal: bool = True
) -> Toy:
    return Toy(
        Rules(f"{name}.lp", f"% @axiom({name}) A toy.\n#program {part}(t).\n{text}"), allows, causal
    )


def _seen_at_most_twice(key: Key) -> bool:
    return all(key[0].count(label) <= 2 for label in key[0])


def _near(key: Key) -> bool:
    return all(j - i <= 2 for j, label in enumerate(key[0]) for i in range(j) if key[0][i] == label)


def _short_paths(key: Key) -> bool:
    _, places, courses = key
    paths = {course[0] for course in courses if course}
    return all(
        len({p for p, course in zip(places, courses, strict=True) if course and course[0] == h})
        <= 2
        for h in paths
    )


def _even(key: Key) -> bool:
    return len(set(key[0])) % 2 == 0


TOYS = (
    _toy("near", "step", "violation(near,t) :- same(I,t), t-I > 2.", _near),
    _toy(
        "seldom",
        "step",
        "violation(seldom,t) :- is(t,S), 3 #count { I : is(I,S) }.",
        _seen_at_most_twice,
    ),
    _toy(
        "short",
        "step",
        "stands(H,P,t) :- at(t,P), along(t,H,D).\nviolation(short,t) :- path(H), 3 #count { P : "
        "stands(H,P,T) }.",
        _short_paths,
        causal=False,
    ),
    _toy(
        "even",
        "check",
        "violation(even,t) :- query(t), N = #count { S : is(S,S) }, N \\ 2 = 1.",
        _even,
    ),
)


@st.composite
def traces(
    draw: st.DrawFn, max_steps: int = 7, closures: bool = False, metric: bool = False
) -> Trace:
    """One to `max_steps` observations of two or three views, any actions in between, with or
    without stars. With `metric`, all have displacements. With `closures`, some traces with
    displacements have closures, too."""
    steps = draw(st.integers(1, max_steps) | st.just(max_steps))
    views = draw(st.sampled_from(["ab", "abc"]))
    seen = draw(st.lists(st.sampled_from(views), min_size=steps, max_size=steps))
    few = draw(
        st.lists(st.sampled_from(ACTIONS), min_size=1, max_size=4, unique_by=lambda a: a.name)
    )  # few are repeated more often
    actions = draw(st.lists(st.sampled_from(few), min_size=steps - 1, max_size=steps - 1))
    stars = None
    if draw(st.booleans()):
        patterns = draw(st.lists(st.sampled_from(STARS), min_size=1, max_size=2))
        rotations = [star[k:] + star[:k] for star in patterns for k in range(4)]
        stars = draw(st.lists(st.sampled_from(rotations), min_size=steps, max_size=steps))
    moved = noise = None
    if metric or draw(st.integers(0, 3)) == 0:
        wrong = st.tuples(
            st.sampled_from([-3.0, 0.0, 0.0, 3.0]),
            st.sampled_from([-3.0, 0.0, 3.0]),
            st.sampled_from([-0.3, 0.0, 0.3]),
        )
        moved = [
            tuple(map(sum, zip(_usual(action), draw(wrong), strict=True)))
            if draw(st.integers(0, 9))
            else None
            for action in actions
        ]
        noise = Odometry(**draw(st.sampled_from(ODOMETRY)))
    trace = Trace.from_steps(seen, actions, stars=stars, displacements=moved, odometry=noise)
    if not closures or moved is None or steps < 2 or not draw(st.booleans()):
        return trace
    return replace(trace, closures=tuple(draw(_closures(trace))))


def _closures(trace: Trace) -> st.SearchStrategy[list[Closure]]:
    """One to three closures that say nearly what the displacements say.

    Maps with a closure that contradicts the displacements have misfits with several minima.
    """
    poses = [(0.0, 0.0, 0.0)]
    for step in trace.steps[1:]:
        poses.append(moved_pose(poses[-1], step.displacement or (0.0, 0.0, 0.0)))
    pairs = st.sampled_from([(i, j) for j in range(len(poses)) for i in range(j)])
    wrong = st.tuples(*(st.sampled_from([0.0, wrong]) for wrong in (0.4, -0.2, 0.05)))
    noise = st.sampled_from([0.1, 0.5]).map(
        lambda s: ((s**2, 0.0, 0.0), (0.0, s**2, 0.001), (0.0, 0.001, 0.02))
    )

    def closure(pair: tuple[int, int], off: tuple[float, ...], spread: Covariance) -> Closure:
        x, y, turned = map(
            sum, zip(displacement_between(poses[pair[0]], poses[pair[1]]), off, strict=True)
        )
        return Closure(*pair, (x, y, turned), spread)

    found = st.builds(closure, pairs, wrong, noise)
    return st.lists(found, min_size=1, max_size=3, unique_by=lambda c: (c.first, c.last))


def _usual(action: Action) -> tuple[float, float, float]:
    """The effect of an action in a world of squares that are 10 metres wide."""
    return (
        (10.0, 0.0, 0.0)
        if action.kind != "turn"
        else (
            0.0,
            0.0,
            {"right": -math.pi / 2, "left": math.pi / 2}.get(action.turn or "", math.pi),
        )
    )


def _seldom(values: st.SearchStrategy[Any]) -> st.SearchStrategy[Any]:
    """An empty tuple in three of four cases."""
    return st.integers(0, 3).flatmap(lambda n: values if n == 3 else st.just(()))


def _mostly_default(default: int) -> st.SearchStrategy[int]:
    """The default of a field that an encoding declares in half of the cases, or 1 to 4."""
    return st.just(default) | st.integers(1, 4)


def step_pairs(steps: int) -> st.SearchStrategy[list[tuple[int, int]]]:
    """Few pairs of steps, mostly none."""
    pairs = [(i, j) for j in range(steps) for i in range(j)]
    return st.just([]) | (st.lists(st.sampled_from(pairs), max_size=2) if pairs else st.just([]))


def choices_of(field: str, trace: Trace) -> st.SearchStrategy[Any]:
    """Values of a field of Theory that suit a topological theory of this trace.

    A field of the class that is missing here fails every test that draws theories. Fields that
    encodings declare are drawn without an entry.
    """
    declared: dict[str, st.SearchStrategy[Any]] = {
        f.name: st.booleans() if isinstance(f.default, bool) else _mostly_default(f.default)
        for f in encodings.declared()
    }
    choices = {
        "level": st.just("topological"),
        "boundary": st.sampled_from(["none", "strict", "defeasible"]),
        "symmetric_sides": st.booleans(),
        "path_order": st.sampled_from(["partial", "total"]),
        "next_place": st.booleans(),
        "all_on_paths": st.booleans(),
        "planar": st.booleans(),
        "star": st.sampled_from(
            ["auto", "none", "alike", "pattern", "frame"] if trace.has_stars else ["auto", "none"]
        ),
        "displacement": st.sampled_from(
            ["auto", "none", "use"] if trace.has_displacements else ["auto", "none"]
        ),
        "reject": st.sampled_from([0.001, 0.3]),
        "joint": st.sampled_from([1, 2]),
        "returns": st.just(0),
        "prefer": st.permutations(COUNTS).flatmap(
            lambda order: st.integers(0, len(order)).map(lambda length: order[:length])
        ),
        "without": _seldom(st.sampled_from(LEFT_OUT).map(lambda name: (name,))),
        "rules": _seldom(st.sampled_from(TOYS).map(lambda toy: (toy.rules,))),
        "misread": st.just(0.0),  # tests/test_faults.py has tests of its own
        "slipped": st.just(0.0),
        "jumped": st.just(0.0),
        "changed": st.just(0.0),  # tests/test_changes.py has tests of its own
        "weigh": st.just("auto"),  # tests/test_weighing.py has tests of its own
        "unknown_views": st.just(False),  # the trace says it
        "several_drives": st.just(False),
        "lifts": st.just(False),
        "same": _seldom(step_pairs(len(trace))),
        "different": step_pairs(len(trace)),
        "elsewhere": step_pairs(len(trace)),
        "same_place": _seldom(step_pairs(len(trace))),
    }
    return (choices | declared)[field]


@st.composite
def theories(draw: st.DrawFn, trace: Trace, fixed: Collection[str] = ()) -> Theory:
    """Any choice of axioms and preference that a theory of this trace may have.

    Without a preference every consistent map is minimal.

    Args:
        draw: Draws from a strategy.
        trace: The trace.
        fixed: Fields that are left as they are in a new Theory.
    """
    choices: dict[str, Any] = {
        f.name: draw(choices_of(f.name, trace), label=f.name)
        for f in fields(Theory)
        if f.name not in fixed
    }
    if draw(st.integers(0, 9)) == 9:
        causal = {
            "level": "causal",
            "boundary": "none",
            "star": draw(st.sampled_from(["none", "alike"] if trace.has_stars else ["none"])),
            "prefer": draw(st.sampled_from([("dstates",), ()])),
            "same_place": (),
        }
        rules = [
            rules
            for rules in choices.get("rules", ())
            if next(toy for toy in TOYS if toy.rules == rules).causal
        ]
        return Theory(**{**choices, **causal, "rules": rules})
    prefer: tuple[Count, ...] = tuple(
        name
        for name in choices["prefer"]
        if name != "excuses" or choices["boundary"] == "defeasible"
    )
    return Theory(**{**choices, "prefer": prefer})
