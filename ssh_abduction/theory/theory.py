"""Which axioms a map has to satisfy, and which of the consistent maps are preferred.

>>> from ssh_abduction import Theory
>>> Theory.topological().priorities
('dstates', 'paths', 'places')
>>> Theory.causal().axioms
('functional_view', 'deterministic')
"""

from __future__ import annotations

import math
import os
import tomllib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, TypeAlias

from ssh_abduction.data.checks import a_path, a_text, a_whole_number, an_instance, one_of
from ssh_abduction.data.errors import TheoryError, TraceError, brief, is_finite, is_whole, named
from ssh_abduction.data.files import read_at_most
from ssh_abduction.data.trace import Step, Trace, checked_trace
from ssh_abduction.data.words import shortly
from ssh_abduction.theory import encodings
from ssh_abduction.theory.pairs import Pairs
from ssh_abduction.theory.rules import Rules

Count: TypeAlias = Literal["dstates", "paths", "places", "excuses", "auto", "tenths"]
Pair: TypeAlias = tuple[int, int]  # of steps

CHOICES: dict[str, tuple[str, ...]] = {
    "level": ("causal", "topological"),
    "boundary": ("none", "strict", "defeasible"),
    "path_order": ("partial", "total"),
    "star": ("auto", "none", "alike", "pattern", "frame", "gateways"),
    "displacement": ("auto", "none", "use"),
}
# The readings of stars that take each gateway to be in its direction as far as its spread says.
IN_TOLERANCE = ("alike", "gateways")
COUNTS: tuple[Count, ...] = ("dstates", "paths", "places", "excuses")
# What is preferred unless a user says so. Displacements tell places apart, so that fewest places
# are seldom too few; without them it is the other way round (docs/measurements/truth.md).
AUTO: tuple[Count, ...] = ("auto",)
PREFERRED: tuple[Count, ...] = ("dstates", "paths", "places")
WITH_DISPLACEMENTS: tuple[Count, ...] = ("dstates", "places", "paths")
# What a fault of a kind takes away from the axioms: they may be broken where there is one, so
# nothing may rely on them.
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
}
# A step of little confidence costs so many times the price, and one that is all sure so many times:
# no view is so sure that nothing else could be wrong instead.
LEAST_SURE, MOST_SURE = 0.1, 5.0
LARGEST_TOML = 2**20  # bytes
DEAREST = 1000.0  # a fault costs so many dstates at most
# So many returns, at most, may be tested together.
MOST_JOINT = 2
# Every trace has fewer steps than this: clingo's numbers have 32 bits, so a pair with a greater
# step could not even be written as a fact.
MOST_STEPS = 2**31
ASSERTIONS = ("same", "different", "elsewhere")
# The fields that some axiom reads, or that `prefer` stands for. Any other field, such as one that
# somebody adds, is demanded of speed-ups under its own name.
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
    *ASSERTIONS,
}
FAULTS = ("misread", "misseen", "slipped", "jumped")
# The fields that a trace settles, and nobody chooses.
SETTLED = ("returns", "unknown_views")
CAUSAL = "Theory.causal() (--theory causal)"  # in error messages


@dataclass(frozen=True)
class Theory:
    """A frozen choice of axioms and of what is minimised: a preset, `replace`, or field by field.

    docs/explanation/theory.md has the axioms and their sources; `ssh-abduction theory` prints them.

    Attributes:
        level: Which maps are sought: causal ones (dstates only), or topological ones (dstates,
            places and paths).
        boundary: How the axioms of left and right of a path hold: not at all, strictly, or by
            default, so that pairs of paths may be excused at a cost.
        symmetric_sides: Whether paths cross, so that a turn tells four relations of sides, not one.
        path_order: Whether the places of a path have a partial or a total order.
        next_place: Whether a travel leads to the next place of its path.
        all_on_paths: Whether every dstate is on a path, even one where no travel starts or ends.
        star: How to read the gateways seen at a place. none: not at all. alike: a dstate has one
            star, within tolerance. pattern: stars of a place agree up to a rotation. frame: they
            agree when turned by the heading, and paths go straight on. gateways: like frame, in
            any directions within tolerance. auto: frame if the trace has stars, else none. frame
            becomes gateways if stars or turns do not fit right angles.
        displacement: Whether displacements are evidence; auto uses them if the trace has any.
        reject: The probability that displacements refuse a true map of the trace, at most.
        joint: How many returns to a place are tested together, at most: 1 or 2.
        returns: How many returns of the trace may be true, among which `reject` is shared; 0 counts
            them in the trace.
        misread: Cost in dstates of disbelieving a view or star, in tenths; 0 forbids it.
        slipped: Cost in dstates of an action that did not do what its name says; 0 forbids it.
        jumped: Cost in dstates of disbelieving a displacement, as when the robot was carried away;
            0 forbids it.
        planar: Whether paths meet at places only: the map can be drawn in the plane without a
            crossing, with right turns to the right.
        prefer: What to minimise, first to last, out of dstates, paths, places and excuses. Counts
            that are not named are not minimised. auto is dstates,places,paths where displacements
            are used, else dstates,paths,places.
        without: Names of axioms to leave out, to see what they do.
        rules: Your own rules: paths of files over the predicates of the encodings, or Rules.
        unknown_views: Whether the view of some step is unknown. The trace decides it.
        same: Pairs of steps known to be one dstate.
        different: Pairs of steps known to be different dstates.
        elsewhere: Pairs of steps known to be at different places.
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
    misread: float = 0.0
    slipped: float = 0.0
    jumped: float = 0.0
    unknown_views: bool = False

    def __post_init__(self) -> None:
        for name, values in CHOICES.items():
            if not isinstance(getattr(self, name), str) or getattr(self, name) not in values:
                raise TheoryError(
                    f"{name}: expected one of {', '.join(values)}, got {brief(getattr(self, name))}"
                )
        for field in fields(self):
            if isinstance(field.default, bool) and not isinstance(getattr(self, field.name), bool):
                raise TheoryError(
                    f"{field.name}: expected true or false, got {brief(getattr(self, field.name))}"
                )
        self._check_numbers()
        self._set_names("prefer", (*COUNTS, *AUTO))
        self._set_names("without", [a.name for a in encodings.axioms()])
        object.__setattr__(self, "rules", Rules.all_of(self.rules))
        for name in ASSERTIONS:
            object.__setattr__(self, name, _pairs(name, getattr(self, name)))
        self._check_rules()
        if self.level == "causal":
            for name, values in (("boundary", ("none",)), ("star", ("none", "alike"))):
                if getattr(self, name) not in values:
                    raise TheoryError(
                        f"{name}: expected {' or '.join(values)} with level=causal, got "
                        f"{getattr(self, name)}; take {CAUSAL}"
                    )
            if set(self.prefer) - {"dstates", *AUTO}:
                raise TheoryError(
                    f"prefer: expected dstates with level=causal, got {', '.join(self.prefer)}; "
                    f"take {CAUSAL}"
                )
        if "auto" in self.prefer and self.prefer != AUTO:
            raise TheoryError(
                f"prefer: expected auto alone, got {', '.join(self.prefer)}; name the counts, or "
                "leave it out"
            )
        if self.has_faults:
            self._check_faults()
        if "excuses" in self.prefer and self.boundary != "defeasible":
            raise TheoryError(
                f"prefer: expected no excuses with boundary={self.boundary}; take "
                f"{choice('boundary', 'defeasible')}"
            )

    def __repr__(self) -> str:
        return shortly(self)

    def _check_faults(self) -> None:
        if self.prefer != AUTO and self.prefer[:1] != ("dstates",):
            raise TheoryError(
                "prefer: expected dstates first where faults are allowed, got "
                f"{', '.join(self.prefer) or 'nothing'}; faults cost dstates"
            )
        if self.star == "gateways":
            raise TheoryError(
                "star: expected no stars of any gateways where faults are allowed, got gateways; "
                f"take {choice('star', 'alike')}"
            )
        if self.boundary == "defeasible":
            raise TheoryError(
                "boundary: expected no excuses where faults are allowed, got defeasible; take "
                f"{choice('boundary', 'strict')}"
            )
        if self.jumped and self.displacement == "none":
            raise TheoryError(
                "jumped: expected displacements to be used, which may be wrong, got "
                f"displacement=none; leave it out, or take {choice('displacement', 'auto')}"
            )
        if self.planar:
            raise TheoryError(
                "planar: expected no planarity where faults are allowed; leave it out (--set "
                "planar=false)"
            )

    def _check_numbers(self) -> None:
        for name in EXCUSED:
            price = getattr(self, name)
            if not is_finite(price) or not (price == 0 or 0.1 <= price <= DEAREST):
                raise TheoryError(
                    f"{name}: expected a number of dstates from 0.1 to {DEAREST:g}, or 0 for no "
                    f"such faults, got {brief(price)}"
                )
            object.__setattr__(self, name, round(float(price), 1))
        if not is_finite(self.reject) or not 0 < self.reject < 1:
            raise TheoryError(
                f"reject: expected a probability above 0 and below 1, got {brief(self.reject)}; "
                "take 0.001, or another small one"
            )
        for name, least, most in (("joint", 1, MOST_JOINT), ("returns", 0, MOST_STEPS)):
            value = getattr(self, name)
            if not is_whole(value) or not least <= value <= most:
                raise TheoryError(
                    f"{name}: expected a whole number from {least} to {most}, got {brief(value)}"
                )
            object.__setattr__(self, name, int(value))
        object.__setattr__(self, "reject", float(self.reject))

    def _check_rules(self) -> None:
        taken = {axiom.name for axiom in encodings.axioms()}
        for rules in self.rules:
            for axiom in rules.axioms:
                if axiom.name in taken:
                    raise TheoryError(
                        f"{rules.name}: @axiom({axiom.name}): expected a name that no other axiom "
                        "has; give it one of its own"
                    )
                taken.add(axiom.name)

    def _set_names(self, field: str, allowed: Iterable[str]) -> None:
        value = getattr(self, field)
        if not isinstance(value, str | list | tuple):
            raise TheoryError(f"{field}: expected a list of names, got {brief(value)}")
        names = (
            tuple(name.strip() for name in value.split(","))
            if isinstance(value, str)
            else tuple(value)
        )
        known = list(allowed)
        for i, name in enumerate(names):
            if name not in known:
                raise TheoryError(
                    f"{field}: expected names out of {', '.join(known)}, got {brief(name)}"
                )
            if name in names[:i]:
                raise TheoryError(f"{field}: expected each name once, got {brief(name)} twice")
        object.__setattr__(self, field, names)

    @classmethod
    def causal(cls) -> Theory:
        """The causal axioms alone, fewest dstates: the smallest Moore machine that explains the trace."""
        return cls(level="causal", boundary="none", star="none", prefer=("dstates",))

    @classmethod
    def topological(cls) -> Theory:
        """All levels, fewest dstates first: closest to the words of Kuipers & Beeson (2002).

        The default.
        """
        return cls()

    @classmethod
    def circumscriptive(cls) -> Theory:
        """All levels, fewest paths first, then places, as Remolina & Kuipers (2004) prefer, and then dstates."""
        return cls(prefer=("paths", "places", "dstates"))

    def replace(self, **choices: Any) -> Theory:
        """This theory with other choices. Raises TheoryError."""
        unknown = set(choices) - {f.name for f in fields(self)}
        if unknown:
            raise TheoryError(
                f"theory: expected fields out of {', '.join(f.name for f in fields(self))}, got "
                f"{brief(min(unknown))}"
            )
        return replace(self, **choices)

    @property
    def priorities(self) -> tuple[Count, ...]:
        """What is minimised, first to last, with the excuses of boundary=defeasible in their place.

        With displacement=auto, that of a trace without displacements.
        """
        prefer = self.prefer
        if self.has_faults:
            return (
                "tenths",
                *(count for count in self.without_faults().priorities if count != "dstates"),
            )
        if prefer == AUTO:
            prefer = (
                ("dstates",)
                if self.level == "causal"
                else WITH_DISPLACEMENTS
                if self.displacement == "use"
                else PREFERRED
            )
        if self.boundary == "defeasible" and "excuses" not in prefer:
            return ("excuses", *prefer)
        return prefer

    @property
    def has_faults(self) -> bool:
        """Whether a map may disbelieve what the trace says of some steps."""
        return any(getattr(self, kind) > 0 for kind in EXCUSED)

    def without_faults(self) -> Theory:
        """This theory, where nothing of the trace may be disbelieved."""
        return replace(self, **dict.fromkeys(EXCUSED, 0.0))  # type: ignore[arg-type]

    def fault_tenths(self, kind: str, step: Step) -> int:
        """What it costs to disbelieve a step, in tenths of dstates; 0 where the theory allows no such fault.

        What is seen costs less where the step's confidence is small, as log odds: that of 0.99,
        which is also that of a step without one, costs the whole price.

        kind  misread (the view), misseen (the star), slipped (the action done there), or jumped
        (the displacement that led there)
        """
        if not isinstance(kind, str) or kind not in FAULTS:
            one_of("kind", kind, FAULTS, TheoryError)
        _checked_step(step)
        price = 10 * (getattr(self, kind) if kind in ("slipped", "jumped") else self.misread)
        if not price or kind in ("slipped", "jumped") or step.confidence is None:
            return round(price)
        c = min(step.confidence, 1 - 1e-12)
        odds = math.log(c / (1 - c)) / math.log(99) if c > 0 else 0.0
        return max(1, round(price * min(max(odds, LEAST_SURE), MOST_SURE)))

    @cached_property
    def axioms(self) -> tuple[str, ...]:
        """The names of the axioms that hold, those of the user's own rules last.

        With star=auto and displacement=auto, those of a trace that has neither.
        """
        own = [axiom.name for rules in self.rules for axiom in rules.axioms]
        return (
            *(
                a.name
                for a in encodings.axioms()
                if a.name not in self.without and a.holds_in(vars(self))
            ),
            *own,
        )

    @cached_property
    def hard(self) -> frozenset[str]:
        """The axioms that nothing may break: all but the one that boundary=defeasible lets pairs of paths be excused from, and those that faults may break."""
        excused = set().union(*(axioms for name, axioms in EXCUSED.items() if getattr(self, name)))
        return (
            frozenset(self.axioms)
            - ({"side_of_branch"} if self.boundary == "defeasible" else set())
            - excused
        )

    @cached_property
    def given_up(self) -> frozenset[str]:
        """The axioms that are about something that the theory speaks of, but need not hold: they are not chosen, are left out, or may be excused."""
        return (
            frozenset(a.name for a in encodings.axioms() if a.has_subject_in(vars(self)))
            - self.hard
        )

    @cached_property
    def demands(self) -> frozenset[str]:
        """All that a speed-up has to keep: the hard axioms, and under names of their own an axiom that may be excused, assertions that steps are one, the
        user's own rules, and fields that no axiom speaks for.
        """
        excusable = {f"{name}, excusable" for name in set(self.axioms) - self.hard}
        asserted = {"asserted same"} if self.same else set()
        rules = {f"the rules of {rules.name}" for rules in self.rules}
        others = {
            f"the field {f.name}"
            for f in fields(self)
            if f.name not in SPOKEN_FOR and getattr(self, f.name) != f.default
        }
        return self.hard | excusable | asserted | rules | others

    @cached_property
    def asserted(self) -> Pairs:
        """What somebody asserts of pairs of steps.

        It is computed once for a theory, as there may be many pairs.
        """
        return Pairs.of(self.different, self.elsewhere, self.same)

    def require(self, step: Step, where: str) -> None:
        """Raises TraceError, which says where, if a step lacks what the axioms need.

        Star has to be settled.
        """
        a_text("where", where, TraceError)
        _checked_step(step)
        if (
            self.level == "topological"
            and step.action is not None
            and step.action.kind is None
            and not step.action.slipped
        ):
            raise TraceError(
                f'{where}: action.kind: expected "travel" or "turn" in a topological theory, got '
                f"none for {brief(step.action.name)}; "
                f'write {{"name": …, "kind": "travel"}} or {{"name": …, "kind": "turn", "turn": '
                f'"right"}}, or take {CAUSAL}'
            )
        if self.star == "none":
            return
        if step.star is None:
            raise TraceError(
                f"{where}: star: expected one, as other steps have stars; add it, or take "
                f"{choice('star', 'none')}"
            )
        if self.star == "alike":
            return
        if self.star == "gateways":
            if step.gateways and (near := step.gateways.too_near):
                raise TraceError(
                    f"{where}: star: expected gateways that their spreads tell apart, got "
                    f"{near[0]:g} and {near[1]:g} degrees; "
                    f"give smaller spreads, or merge the two"
                )
            return
        try:
            _ = step.openings
        except TraceError as error:
            raise TraceError(f"{where}: {error}, or take {choice('star', 'none')}") from None

    def check_steps(self, trace: Trace) -> None:
        """Raises TheoryError where a pair names a step that the trace does not have."""
        checked_trace(trace)
        for name in ASSERTIONS:
            for pair in getattr(self, name):
                if max(pair) >= len(trace):
                    raise TheoryError(
                        f"{name} (--{name}): expected steps from 0 to {len(trace) - 1}, got "
                        f"{pair[0]},{pair[1]}"
                    )

    def of_steps(self, first: int, length: int) -> Theory:
        """The theory of so many steps from the first one on, numbered from 0: pairs with other steps are dropped."""
        first, length = (
            a_whole_number(name, value, TheoryError)
            for name, value in (("first", first), ("length", length))
        )
        kept = {
            name: tuple(
                (i - first, j - first)
                for i, j in getattr(self, name)
                if first <= min(i, j) and max(i, j) < first + length
            )
            for name in ASSERTIONS
        }
        return replace(self, **kept)  # type: ignore[arg-type]

    def to_dict(self) -> dict[str, Any]:
        """The theory as plain data."""
        return {
            k: [list(e) if isinstance(e, tuple) else e for e in v] if isinstance(v, tuple) else v
            for k, v in asdict(self).items()
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Theory:
        """The theory that `to_dict` wrote; fields that are missing are those of the level's preset.

        Raises TheoryError.
        """
        if not isinstance(data, Mapping):
            raise TheoryError(f"theory: expected an object, got {brief(data)}")
        preset = cls.causal() if data.get("level") == "causal" else cls()
        return preset.replace(
            **{str(k): tuple(v) if isinstance(v, list) else v for k, v in data.items()}
        )

    @classmethod
    def from_toml(cls, path: str | os.PathLike[str]) -> Theory:
        """Read a theory from a TOML file with one field a line, such as `star = "frame"`.

        Args:
            path: The file. `preset = "causal"` in it names the preset that the other fields are
                laid over. Files of `rules` are looked for beside it.

        Raises:
            TheoryError: The file cannot be read, or a field is wrong.
        """
        a_path("path", path, TheoryError)
        data = _read_toml(path)
        preset = data.pop("preset", "causal" if data.get("level") == "causal" else "topological")
        if not isinstance(preset, str) or preset not in PRESETS:
            raise TheoryError(
                f"{named(path)}: preset: expected one of {', '.join(PRESETS)}, got {brief(preset)}"
            )
        if isinstance(rules := data.get("rules"), list):
            beside = Path(path).parent
            data["rules"] = [
                str(beside / file) if isinstance(file, str) else file for file in rules
            ]
        try:
            return PRESETS[preset]().replace(
                **{k: tuple(v) if isinstance(v, list) else v for k, v in data.items()}
            )
        except TheoryError as error:
            raise TheoryError(f"{named(path)}: {error}") from None


def _read_toml(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The fields in a TOML file. Raises TheoryError."""
    try:
        return tomllib.loads(read_at_most(path, LARGEST_TOML).decode("utf-8"))
    except OSError as error:
        why, mend = error.strerror or str(error), "name a .toml file"
    except (UnicodeDecodeError, tomllib.TOMLDecodeError, ValueError) as error:
        why, mend = str(error), 'write lines such as star = "frame"'
    raise TheoryError(f"{named(path)}: expected a theory in TOML, got {why}; {mend}")


def _checked_step(value: object) -> Step:
    return an_instance("step", value, Step, TraceError, mend="take one of trace.steps")


class _Checked(tuple[Pair, ...]):
    """Pairs that were checked already.

    There may be many, and theories are often made from another one, which need not check them
    again.
    """


def _pairs(field: str, value: Any) -> tuple[Pair, ...]:
    """Pairs of steps, the earlier step first and each pair once, from pairs or from text such as 3,12. Raises TheoryError."""
    if isinstance(value, _Checked):
        return value
    mend = f"write {field}=[(3, 12)] (--{field} 3,12)"
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


def choice(name: str, value: str) -> str:
    """A choice as an error message names it: in Python, and in the shell."""
    flag = f"--{name} {value}" if name == "star" else f"--set {name}={value}"
    return f"{name}={value} ({flag})"


PRESETS: dict[str, Callable[[], Theory]] = {
    "causal": Theory.causal,
    "topological": Theory.topological,
    "circumscriptive": Theory.circumscriptive,
}


def checked_theory(value: object) -> Theory:
    """The theory that a caller gives, or Theory.topological() where that is None.

    Raises TheoryError.
    """
    if not isinstance(value, Theory | None):
        raise TheoryError(
            f"theory: expected a Theory, got {brief(value)}; take Theory.topological(), "
            "Theory.causal() or Theory(…)"
        )
    return value or Theory.topological()
