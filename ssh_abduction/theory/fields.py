"""The values that the fields of a theory may have, and their checks."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import fields
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from ssh_abduction.data.checks import a_flag, a_whole_number, one_of
from ssh_abduction.data.corrections import ASSERTIONS
from ssh_abduction.data.errors import TheoryError, brief, is_finite
from ssh_abduction.theory import encodings
from ssh_abduction.theory.rules import Rules

if TYPE_CHECKING:
    from ssh_abduction.theory.theory import Theory

Count: TypeAlias = Literal["dstates", "paths", "places", "excuses", "auto", "tenths"]
Pair: TypeAlias = tuple[int, int]  # two steps
CHOICES: dict[str, tuple[str, ...]] = {
    "level": ("causal", "topological"),
    "boundary": ("none", "strict", "defeasible"),
    "path_order": ("partial", "total"),
    "star": ("auto", "none", "alike", "pattern", "frame", "gateways"),
    "displacement": ("auto", "none", "use"),
    "weigh": ("auto", "cost", "count"),
}
# Values of `star` for which gateways match if their directions agree within their spreads.
IN_TOLERANCE = ("alike", "gateways")
COUNTS: tuple[Count, ...] = ("dstates", "paths", "places", "excuses")
# What is minimised by default. Displacements show that places differ, so a map with the fewest
# places seldom has too few. Without displacements, it is better to minimise paths before places
# (docs/measurements/truth.md).
AUTO: tuple[Count, ...] = ("auto",)
PREFERRED: tuple[Count, ...] = ("dstates", "paths", "places")
WITH_DISPLACEMENTS: tuple[Count, ...] = ("dstates", "places", "paths")
# The default prices of a dstate, a place and a path, in nats (docs/measurements/truth.md says how
# they were chosen), and the highest price.
PRICES = (8.0, 8.0, 0.0)
# Laying a drive on others costs as much as LAID dstates and their places, because that many may
# look alike by chance. With star=alike, which compares bearings, it costs as much as one dstate and
# its place (docs/measurements/truth.md).
LAID = 2
# Without stars, only views tell places apart. If steps of two drives look alike with probability q,
# each step tells log(1/q) nats. If these are fewer than TOLD, laying costs TOLD / log(1/q) times as
# much. So that few steps do not mislead, q counts UNLIKE more pairs that differ
# (docs/measurements/truth.md).
TOLD, UNLIKE = 3.0, 400
DEAREST_PRICE = 1e6
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
    "prices",
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
MOST_JOINT = 2  # the most returns that may be tested together
MOST_STEPS = 2**31  # the numbers of steps are below this: clingo's numbers have 32 bits
CAUSAL = "Theory.causal() (--theory causal)"  # for error messages


def normalise(theory: Theory) -> None:
    """Check all fields of a new theory, and convert each to its standard form.

    Raises TheoryError if a field is wrong, or two contradict each other.
    """
    for name, values in CHOICES.items():
        one_of(name, getattr(theory, name), values, TheoryError)
    for field in fields(theory):
        if isinstance(field.default, bool):
            flag = a_flag(field.name, getattr(theory, field.name), TheoryError)
            object.__setattr__(theory, field.name, flag)
    _check_numbers(theory)
    _check_prices(theory)
    _set_names(theory, "prefer", (*COUNTS, *AUTO))
    _set_names(theory, "without", [a.name for a in encodings.axioms()])
    object.__setattr__(theory, "rules", Rules.all_of(theory.rules))
    for name in ASSERTIONS:
        object.__setattr__(theory, name, _pairs(name, getattr(theory, name)))
    _check_rules(theory)
    if theory.level == "causal":
        _check_causal(theory)
    if "auto" in theory.prefer and theory.prefer != AUTO:
        raise TheoryError(
            f"prefer: expected auto without other counts, got {', '.join(theory.prefer)}; name "
            "the counts, or leave it out"
        )
    if theory.has_faults:
        _check_faults(theory)
    if theory.weigh == "cost":
        _check_weigh(theory)
    if "excuses" in theory.prefer and theory.boundary != "defeasible":
        raise TheoryError(
            f"prefer: expected boundary=defeasible with excuses, got {theory.boundary}; take "
            f"{choice('boundary', 'defeasible')}"
        )


def choice(name: str, value: str) -> str:
    """Say how to set a field in Python and in the shell, such as "star=none (--set star=none)"."""
    return f"{name}={value} (--set {name}={value})"


def _check_causal(theory: Theory) -> None:
    """Check that the other fields suit a causal theory. Raises TheoryError."""
    for name, values in (("boundary", ("none",)), ("star", ("none", "alike"))):
        if getattr(theory, name) not in values:
            raise TheoryError(
                f"{name}: expected {' or '.join(values)} with level=causal, got "
                f"{getattr(theory, name)}; leave {name} out, and take {CAUSAL}"
            )
    if set(theory.prefer) - {"dstates", *AUTO}:
        raise TheoryError(
            f"prefer: expected dstates with level=causal, got {', '.join(theory.prefer)}; "
            f"leave prefer out, and take {CAUSAL}"
        )
    if theory.same_place:
        raise TheoryError(
            "same_place: expected a topological theory, as causal maps have no places, got "
            "level=causal; say which steps are one dstate (same, --same)"
        )


def _check_weigh(theory: Theory) -> None:
    """Check that maps can be compared by cost. Raises TheoryError."""
    if not _prefers_dstates(theory):
        raise TheoryError(
            "prefer: expected dstates first where maps are weighed, got "
            f"{', '.join(theory.prefer) or 'nothing'}; leave it out, or take "
            f"{choice('weigh', 'count')}"
        )
    if theory.boundary == "defeasible":
        raise TheoryError(
            "weigh: expected count where excuses are allowed, as the price of an excuse in nats "
            f"is not known, got cost; take {choice('weigh', 'count')}"
        )


def can_weigh(theory: Theory) -> bool:
    """Whether the maps of a theory can be compared by their cost in nats."""
    return _prefers_dstates(theory) and theory.boundary != "defeasible"


def _prefers_dstates(theory: Theory) -> bool:
    """Whether a theory minimises dstates first, or what fits the trace."""
    return theory.prefer == AUTO or theory.prefer[:1] == ("dstates",)


def _check_faults(theory: Theory) -> None:
    """Check that the other fields allow faults. Raises TheoryError."""
    if not _prefers_dstates(theory):
        raise TheoryError(
            "prefer: expected dstates first where faults are allowed, got "
            f"{', '.join(theory.prefer) or 'nothing'}; faults cost dstates"
        )
    others = [kind for kind in EXCUSED if kind != "changed" and getattr(theory, kind)]
    if theory.star == "gateways" and others:
        raise TheoryError(
            f"star: expected another value where {', '.join(others)} is allowed, got gateways; "
            f"take {choice('star', 'alike')}"
        )
    if theory.boundary == "defeasible":
        raise TheoryError(
            "boundary: expected no excuses where faults are allowed, got defeasible; take "
            f"{choice('boundary', 'strict')}"
        )
    if theory.jumped and theory.displacement == "none":
        raise TheoryError(
            "jumped: expected displacements to be used, which may be wrong, got "
            f"displacement=none; leave it out, or take {choice('displacement', 'auto')}"
        )
    if theory.changed and (others or theory.level == "causal"):
        raise TheoryError(
            "changed: expected a topological theory without other faults, as gateways of places "
            f"change, got {', '.join(others) or 'level=causal'}; leave one out"
        )
    if theory.planar:
        raise TheoryError(
            "planar: expected no planarity where faults are allowed; leave it out (--set "
            "planar=false)"
        )


def _check_numbers(theory: Theory) -> None:
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


def _check_prices(theory: Theory) -> None:
    """Convert the prices to three floats. Raises TheoryError."""
    given: Any = theory.prices
    try:
        if isinstance(given, str):
            given = map(float, given.split(","))
        prices = tuple(float(price) for price in given if not isinstance(price, bool | str))
    except (TypeError, ValueError):
        prices = ()
    if len(prices) != 3 or not all(0 <= price <= DEAREST_PRICE for price in prices):
        raise TheoryError(
            f"prices: expected three numbers from 0 to {DEAREST_PRICE:g}, the nats that a dstate, "
            f"a place and a path cost, got {brief(theory.prices)}; write prices=(8, 8, 0) "
            "(--set prices=8,8,0)"
        )
    if prices[0] == 0:
        raise TheoryError(
            f"prices: expected a dstate to cost more than 0 nats, got {brief(theory.prices)}; "
            "free dstates explain every trace; write prices=(8, 8, 0)"
        )
    object.__setattr__(theory, "prices", prices)


def _check_rules(theory: Theory) -> None:
    """Check that the user's axioms have names of their own. Raises TheoryError."""
    taken = {axiom.name for axiom in encodings.axioms()}
    for rules in theory.rules:
        for axiom in rules.axioms:
            if axiom.name in taken:
                raise TheoryError(
                    f"{rules.name}: @axiom({axiom.name}): expected a name that no other axiom "
                    "has; rename this axiom"
                )
            taken.add(axiom.name)


def _set_names(theory: Theory, field: str, allowed: Iterable[str]) -> None:
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
    if not isinstance(value, Iterable) or isinstance(value, Mapping | bytes):
        raise TheoryError(f"{field}: expected pairs of steps, got {brief(value)}; {mend}")
    found: dict[Pair, None] = {}
    for given in value:
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
