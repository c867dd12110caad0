"""The fields of a theory that all theories have, and the checks of their values."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields
from typing import Any, Literal, TypeAlias, get_args, get_origin, get_type_hints

from ssh_abduction.data.checks import a_flag, a_list, a_whole_number, one_of
from ssh_abduction.data.corrections import ASSERTIONS
from ssh_abduction.data.errors import TheoryError, brief, is_finite
from ssh_abduction.theory import encodings
from ssh_abduction.theory.encodings import Rules

Count: TypeAlias = Literal["dstates", "paths", "places", "excuses", "auto", "tenths"]
Pair: TypeAlias = tuple[int, int]  # two steps
# Values of `star` for which gateways match if their directions agree within their spreads.
IN_TOLERANCE = ("alike", "gateways")
COUNTS: tuple[Count, ...] = ("dstates", "paths", "places", "excuses")
# What is minimised by default. Displacements show that places differ, so a map with the fewest
# places seldom has too few. Without displacements, it is better to minimise paths before places
# (benchmarks/truth.md).
AUTO: tuple[Count, ...] = ("auto",)
PREFERRED: tuple[Count, ...] = ("dstates", "paths", "places")
WITH_DISPLACEMENTS: tuple[Count, ...] = ("dstates", "places", "paths")
# A fault that costs as much as one dstate has the probability exp(-FAULT), if maps are compared by
# cost in nats.
FAULT = 5.0
# A view that the theory trusts is misread with the probability exp(-MISREAD): one in 33. As often,
# a part of the building that repeats another part shows something else.
MISREAD = 3.5
# Two dstates of a place face one way if their headings differ by less than this many radians.
ONE_WAY = 0.4
# The axioms that a fault of each kind may break. Speed-ups cannot rely on them.
EXCUSED = {
    "misread": {"functional_view", "star_pattern", "star_frame"},
    "slipped": {
        "deterministic",
        "turn_stays",
        "travel_leaves",
        "travel_follows_path",
        "turn_around_reverses",
        "turn_changes_path",
        "travel_orders",
        "next_place",
        "course_needs_travel",
        "turn_rotates",
    },
    "jumped": {"one_pose"},
    "changed": {"star_pattern", "star_frame", "gateway_frame"},
}
DEAREST = 1000.0  # the most dstates that a fault may cost
MOST_JOINT = 2  # the most returns that may be tested together
MOST_STEPS = 2**31  # the numbers of steps are below this: clingo's numbers have 32 bits
CAUSAL = "Theory.causal() (--theory causal)"  # for error messages


@dataclass(frozen=True)
class Choices:
    """The fields that every theory has. `Theory` explains each field.

    A field of a new object is checked, and converted to its standard form. TheoryError is raised if
    a field is wrong, or two contradict each other.
    """

    level: Literal["causal", "topological"] = "topological"
    boundary: Literal["none", "strict", "defeasible"] = "strict"
    symmetric_sides: bool = True
    path_order: Literal["partial", "total"] = "total"
    next_place: bool = False
    all_on_paths: bool = False
    star: Literal["auto", "none", "alike", "pattern", "frame", "gateways"] = "auto"
    displacement: Literal["auto", "none", "use"] = "auto"
    reject: float = 0.001
    joint: int = 2
    returns: int = 0
    prefer: tuple[Count, ...] = AUTO
    without: tuple[str, ...] = ()
    rules: tuple[Rules, ...] = ()
    planar: bool = False
    same: tuple[Pair, ...] = ()
    different: tuple[Pair, ...] = ()
    elsewhere: tuple[Pair, ...] = ()
    same_place: tuple[Pair, ...] = ()
    misread: float = 0.0
    slipped: float = 0.0
    jumped: float = 0.0
    changed: float = 0.0
    unknown_views: bool = False
    several_drives: bool = False
    lifts: bool = False
    weigh: Literal["auto", "cost", "count"] = "auto"

    def __post_init__(self) -> None:
        for name, values in CHOICES.items():
            one_of(name, getattr(self, name), values, TheoryError)
        for field in fields(self):
            if isinstance(field.default, bool):
                flag = a_flag(field.name, getattr(self, field.name), TheoryError)
                object.__setattr__(self, field.name, flag)
        _check_numbers(self)
        _set_names(self, "prefer", (*COUNTS, *AUTO))
        _set_names(self, "without", [a.name for a in encodings.axioms()])
        object.__setattr__(self, "rules", Rules.all_of(self.rules))
        for name in ASSERTIONS:
            object.__setattr__(self, name, _pairs(name, getattr(self, name)))
        for wrong in _contradictions(self):
            raise TheoryError(wrong)

    @property
    def has_faults(self) -> bool:
        """Whether a map may treat parts of the trace as wrong, at a cost."""
        return any(getattr(self, kind) > 0 for kind in EXCUSED)


# The values of the fields that have a few named ones.
CHOICES: dict[str, tuple[str, ...]] = {
    name: get_args(kind)
    for name, kind in get_type_hints(Choices).items()
    if get_origin(kind) is Literal
}

# The fields that are covered by the axioms of a theory. Speed-ups must name any other field that
# they respect, such as one that is added later.
SPOKEN_FOR = {
    "level",
    *CHOICES,
    "symmetric_sides",
    "next_place",
    "all_on_paths",
    "planar",
    "prefer",
    "without",
    "rules",
    "reject",
    "joint",
    "returns",
    "weigh",
    "same",
    "different",
    "elsewhere",
}
# The axioms that say which paths there are. Without them nothing tells which travels go straight
# on, so maps have no paths. Other axioms only restrict paths.
PATHS = (
    "one_dstate_per_course",
    "travel_follows_path",
    "one_course",
    "turn_around_reverses",
    "turn_changes_path",
    "on_path",
    "travel_orders",
    "order_asymmetric",
    "order_transitive",
    "path_order_total",
    "course_needs_travel",
)


def choice(name: str, value: str) -> str:
    """Say how to set a field in Python and in the shell, such as "star=none (--set star=none)"."""
    return f"{name}={value} (--set {name}={value})"


def can_weigh(theory: Choices) -> bool:
    """Whether the maps of a theory can be compared by their cost in nats."""
    return _prefers_dstates(theory) and theory.boundary != "defeasible"


def _prefers_dstates(theory: Choices) -> bool:
    """Whether a theory minimises dstates first, or what fits the trace."""
    return theory.prefer == AUTO or theory.prefer[:1] == ("dstates",)


def _contradictions(theory: Choices) -> Iterator[str]:
    """Yield a sentence for each contradiction between two fields."""
    taken = {axiom.name for axiom in encodings.axioms()}
    for rules in theory.rules:
        for axiom in rules.axioms:
            if axiom.name in taken:
                yield (
                    f"{rules.name}: @axiom({axiom.name}): expected a name that no other axiom "
                    "has; rename this axiom"
                )
            taken.add(axiom.name)
    if theory.level == "causal":
        yield from _not_causal(theory)
    preferred = ", ".join(theory.prefer) or "nothing"
    if "auto" in theory.prefer and theory.prefer != AUTO:
        yield (
            f"prefer: expected auto without other counts, got {preferred}; name the counts, or "
            "leave it out"
        )
    if theory.has_faults:
        yield from _not_with_faults(theory)
    if theory.weigh == "cost" and not _prefers_dstates(theory):
        yield (
            f"prefer: expected dstates first where maps are weighed, got {preferred}; leave it "
            f"out, or take {choice('weigh', 'count')}"
        )
    if theory.weigh == "cost" and theory.boundary == "defeasible":
        yield (
            "weigh: expected count where excuses are allowed, as the price of an excuse in nats "
            f"is not known, got cost; take {choice('weigh', 'count')}"
        )
    if "excuses" in theory.prefer and theory.boundary != "defeasible":
        yield (
            f"prefer: expected boundary=defeasible with excuses, got {theory.boundary}; take "
            f"{choice('boundary', 'defeasible')}"
        )


def _not_causal(theory: Choices) -> Iterator[str]:
    """Yield what does not suit a causal theory."""
    for name, values in (("boundary", ("none",)), ("star", ("none", "alike"))):
        if getattr(theory, name) not in values:
            yield (
                f"{name}: expected {' or '.join(values)} with level=causal, got "
                f"{getattr(theory, name)}; leave {name} out, and take {CAUSAL}"
            )
    if set(theory.prefer) - {"dstates", *AUTO}:
        yield (
            f"prefer: expected dstates with level=causal, got {', '.join(theory.prefer)}; "
            f"leave prefer out, and take {CAUSAL}"
        )
    if theory.same_place:
        yield (
            "same_place: expected a topological theory, as causal maps have no places, got "
            "level=causal; say which steps are one dstate (same, --same)"
        )


def _not_with_faults(theory: Choices) -> Iterator[str]:
    """Yield what does not suit a theory that allows faults."""
    if not _prefers_dstates(theory):
        yield (
            "prefer: expected dstates first where faults are allowed, got "
            f"{', '.join(theory.prefer) or 'nothing'}; faults cost dstates"
        )
    others = [kind for kind in EXCUSED if kind != "changed" and getattr(theory, kind)]
    if theory.star == "gateways" and others:
        yield (
            f"star: expected another value where {', '.join(others)} is allowed, got gateways; "
            f"take {choice('star', 'alike')}"
        )
    if theory.boundary == "defeasible":
        yield (
            "boundary: expected no excuses where faults are allowed, got defeasible; take "
            f"{choice('boundary', 'strict')}"
        )
    if theory.jumped and theory.displacement == "none":
        yield (
            "jumped: expected displacements to be used, which may be wrong, got "
            f"displacement=none; leave it out, or take {choice('displacement', 'auto')}"
        )
    if theory.changed and (others or theory.level == "causal"):
        yield (
            "changed: expected a topological theory without other faults, as gateways of places "
            f"change, got {', '.join(others) or 'level=causal'}; leave one out"
        )
    if theory.planar:
        yield (
            "planar: expected no planarity where faults are allowed; leave it out (--set "
            "planar=false)"
        )


def _check_numbers(theory: Choices) -> None:
    """Check the fields that are numbers, and round the prices of faults. Raises TheoryError."""
    for name in EXCUSED:
        price = getattr(theory, name)
        if not is_finite(price) or not (price == 0 or 0.1 <= price <= DEAREST):
            raise TheoryError(
                f"{name}: expected a number of dstates from 0.1 to {DEAREST:g}, or 0 for no such "
                f"faults, got {brief(price)}; take one in this range"
            )
        object.__setattr__(theory, name, round(float(price), 1))
    if not is_finite(theory.reject) or not 0 < theory.reject < 1:
        raise TheoryError(
            f"reject: expected a probability above 0 and below 1, got {brief(theory.reject)}; "
            "take 0.001, or another small one"
        )
    declared = [field.name for field in encodings.declared() if not isinstance(field.default, bool)]
    for name, least, most in (
        ("joint", 1, MOST_JOINT),
        ("returns", 0, MOST_STEPS),
        *((name, 0, MOST_STEPS - 1) for name in declared),
    ):
        value, mend = getattr(theory, name), "take one in this range"
        value = a_whole_number(name, value, TheoryError, least, most, mend=mend)
        object.__setattr__(theory, name, value)
    object.__setattr__(theory, "reject", float(theory.reject))


def _set_names(theory: Choices, field: str, allowed: Iterable[str]) -> None:
    """Convert a field to a tuple of different names out of those allowed. Raises TheoryError."""
    value = getattr(theory, field)
    if not isinstance(value, str | list | tuple):
        raise TheoryError(f"{field}: expected a list of names, got {brief(value)}; write a list")
    names = (
        tuple(name.strip() for name in value.split(",")) if isinstance(value, str) else tuple(value)
    )
    known = list(allowed)
    for i, name in enumerate(names):
        one_of(field, name, known, TheoryError, mend="take some of these")
        if name in names[:i]:
            raise TheoryError(
                f"{field}: expected each name once, got {brief(name)} twice; leave one out"
            )
    object.__setattr__(theory, field, names)


class _Checked(tuple[Pair, ...]):
    """Pairs that were checked. If a theory is made from another one, they are not checked again."""


def _pairs(field: str, value: Any) -> tuple[Pair, ...]:
    """Check pairs of steps, numbers or texts such as "3,12", and return each once, sorted."""
    if isinstance(value, _Checked):
        return value
    mend = f"write {field}=[(3, 12)] (--{field.replace('_', '-')} 3,12)"
    if isinstance(value, str):
        value = [value]
    found: dict[Pair, None] = {}
    for given in a_list(field, value, TheoryError, what="pairs of steps", mend=mend):
        pair = given.split(",") if isinstance(given, str) else given
        try:
            steps = [int(step) if isinstance(step, str) else step.__index__() for step in pair]
        except (AttributeError, TypeError, ValueError):
            steps = []
        if (
            len(steps) != 2
            or min(steps) < 0
            or max(steps) >= MOST_STEPS
            or any(isinstance(step, bool) for step in pair)
        ):
            raise TheoryError(
                f"{field}: expected pairs of steps, counted from 0, got {brief(given)}; {mend}"
            )
        if steps[0] == steps[1]:
            raise TheoryError(f"{field}: expected two steps, got {steps[0]} twice; {mend}")
        found[min(steps), max(steps)] = None
    return _Checked(found)
