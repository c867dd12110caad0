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
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from ssh_abduction.data.checks import a_path, a_whole_number, an_instance, an_object, one_of
from ssh_abduction.data.corrections import ASSERTIONS
from ssh_abduction.data.errors import TheoryError, TraceError, brief, named, said_of
from ssh_abduction.data.files import read_at_most
from ssh_abduction.data.map_parts import FAULTS
from ssh_abduction.data.trace import Step, Trace, checked_trace
from ssh_abduction.data.words import shortly
from ssh_abduction.theory import encodings
from ssh_abduction.theory.fields import (
    AUTO,
    CAUSAL,
    EXCUSED,
    PATHS,
    PREFERRED,
    SPOKEN_FOR,
    WITH_DISPLACEMENTS,
    Choices,
    Count,
    choice,
)
from ssh_abduction.theory.pairs import Pairs

# Treating a view or a star as wrong costs LEAST_SURE to MOST_SURE times the price: even a very
# confident view may be wrong.
LEAST_SURE, MOST_SURE = 0.1, 5.0
LARGEST_TOML = 2**20  # bytes
# The fields that the trace decides, not the user.
SETTLED = ("returns", "unknown_views", "several_drives", "lifts")


@dataclass(frozen=True, repr=False)
@encodings.with_declared_fields
class Theory(Choices):
    """An immutable choice of axioms and of what to minimise.

    Take a preset such as `causal`, change it with `replace`, or set the fields by name.
    docs/explanation/theory.md explains the axioms and their sources. `ssh-abduction theory` prints
    them. Encodings may declare further fields for their axioms (`declared`).

    Attributes:
        level: The maps to find: causal ones (dstates only), or topological ones (dstates, places
            and paths).
        boundary: Whether the axioms about left and right of a path hold. none: they do not. strict:
            without exception. defeasible: with exceptions for pairs of paths, each at a cost.
        symmetric_sides: Whether two paths cross wherever the robot turns from one onto the other,
            so that each has parts on both sides of the other.
        path_order: Order of the places of a path. partial: some pairs may stay unordered. total:
            every two places are ordered.
        next_place: Whether a travel leads to the next place of its path, with no place between.
        all_on_paths: Whether every dstate is on a path, even one where no travel starts or ends.
        star: How to use stars (the gateways seen at a place). none: not at all. alike: a dstate has
            one star, within a tolerance. pattern: a place has one star, up to rotation. frame: a
            place has one star, rotated by the robot's heading; gateways are at right angles, and
            paths go straight on. gateways: like frame, but with gateways at any angles, within a
            tolerance. auto: frame if the trace has stars, else none; frame becomes gateways if
            stars or turns do not fit right angles.
        displacement: Whether displacements are evidence; auto uses them if the trace has any.
        reject: Significance level: the largest probability of rejecting the true map because of
            its displacements.
        joint: How many returns (two steps that a map puts at one place or dstate) are tested
            together. 1: each return alone. 2: also pairs of returns.
        returns: Number of possible returns. Each return is tested at the significance level
            `reject` divided by this number. 0 counts the possible returns of the trace.
        misread: Cost of treating a view or a star (the gateways seen at a place) as wrong, in
            dstates, with one decimal: 1.5 costs as much as 1.5 dstates; 0 forbids it.
        slipped: Cost in dstates of an action that did not do what its name says; 0 forbids it.
        jumped: Cost in dstates of ignoring a displacement, for example because the robot was
            carried; 0 forbids it.
        changed: Cost in dstates of a gateway that differs between two drives; 0 forbids it.
        planar: Whether paths meet only at places. Then the map can be drawn in the plane without a
            crossing, with the gateways around each place in their order.
        prefer: What to minimise, most important first, out of dstates, paths, places and excuses
            (exceptions of boundary=defeasible). Counts that are not named are not minimised. auto
            is dstates,places,paths if displacements are used, else dstates,paths,places.
        without: Names of axioms to leave out, to see what they do.
        rules: Your own rules: paths of files that use the predicates of the encodings, or Rules.
        unknown_views: Whether the view of some step is unknown. It is set from the trace.
        several_drives: Whether the trace has several drives. It is set from the trace.
        lifts: Whether the trace has actions that lead to other floors. It is set from the trace.
        same: Pairs of steps known to be one dstate.
        different: Pairs of steps known to be different dstates.
        elsewhere: Pairs of steps known to be at different places.
        same_place: Pairs of steps known to be at one place.
        weigh: How to compare maps. count: by the counts in `prefer`. cost: by their cost in nats,
            which is minus the logarithm of their marginal likelihood; each fault adds 5 nats times
            its `misread`, `slipped`, `jumped` or `changed`. auto: cost if displacements are used,
            dstates come first in `prefer`, and there are no excuses.
    """

    def __repr__(self) -> str:
        return shortly(self)

    @classmethod
    def causal(cls) -> Theory:
        """Return the preset with the causal axioms only.

        Its maps are the smallest Moore machines that explain the trace; with displacements, those
        of least cost.
        """
        return cls(level="causal", boundary="none", star="none")

    @classmethod
    def topological(cls) -> Theory:
        """Return the default preset: causal and topological axioms, fewest dstates first.

        It is based on Kuipers & Beeson (2002).
        """
        return cls()

    @classmethod
    def circumscriptive(cls) -> Theory:
        """Return the preset with causal and topological axioms, and fewest paths first.

        After the paths, it minimises places, then dstates, as in Remolina & Kuipers (2004).
        """
        return cls(prefer=("paths", "places", "dstates"))

    def replace(self, **choices: Any) -> Theory:
        """Return this theory with other values of some fields.

        Raises:
            TheoryError: A field is unknown or has a wrong value.
        """
        unknown = set(choices) - {f.name for f in fields(self)}
        if unknown:
            raise TheoryError(
                f"theory: expected fields out of {', '.join(f.name for f in fields(self))}, got "
                f"{brief(min(unknown))}; take some of these"
            )
        return replace(self, **choices)

    @property
    def priorities(self) -> tuple[Count, ...]:
        """The names of the counts to minimise, most important first.

        With boundary=defeasible, they include "excuses". With faults, "tenths" comes first: the
        cost in tenths of a dstate. With displacement=auto, the order is as for a trace without
        displacements.
        """
        prefer = self.prefer
        if self.has_faults:
            return (
                "tenths",
                *(count for count in self.without_faults().priorities if count != "dstates"),
            )
        if prefer == AUTO:
            prefer = WITH_DISPLACEMENTS if self.displacement == "use" else PREFERRED
            prefer = ("dstates",) if self.level == "causal" else prefer
        if self.boundary == "defeasible" and "excuses" not in prefer:
            return ("excuses", *prefer)
        return prefer

    def without_faults(self) -> Theory:
        """Return this theory without faults: a map may treat nothing as wrong."""
        return replace(self, **dict.fromkeys(EXCUSED, 0.0))  # type: ignore[arg-type]

    def fault_tenths(self, kind: str, step: Step) -> int:
        """Return the cost of a fault at a step, in tenths of a dstate; 0 if the theory forbids it.

        The cost of a wrong view or star grows with the log odds of the step's confidence. If the
        confidence is 0.99 or None, the cost is the field `misread`.

        Args:
            kind: misread (the view is wrong), misseen (the star), slipped (the action done there),
                jumped (the displacement that led there), or changed (one gateway).
            step: The step that has the fault.
        """
        one_of("kind", kind, FAULTS, TheoryError)
        _checked_step(step)
        is_seen = kind in ("misread", "misseen")
        price = 10 * (self.misread if is_seen else getattr(self, kind))
        if not price or not is_seen or step.confidence is None:
            return round(price)
        c = min(step.confidence, 1 - 1e-12)
        odds = math.log(c / (1 - c)) / math.log(99) if c > 0 else 0.0
        return max(1, round(price * min(max(odds, LEAST_SURE), MOST_SURE)))

    @cached_property
    def declared(self) -> Mapping[str, int]:
        """The values of the fields that encodings declare, by name."""
        return {field.name: getattr(self, field.name) for field in encodings.declared()}

    @cached_property
    def axioms(self) -> tuple[str, ...]:
        """The names of the axioms of this theory. Those of the user's own rules come last.

        With star=auto, axioms about stars are left out; with displacement=auto, those about
        displacements.
        """
        own = [axiom.name for rules in self.rules for axiom in rules.axioms]
        left = (a for a in encodings.axioms() if a.name not in self.without)
        return (*(a.name for a in left if a.holds_in(vars(self))), *own)

    @cached_property
    def hard(self) -> frozenset[str]:
        """The names of the axioms that no excuse and no fault may break."""
        excused = set().union(*(axioms for name, axioms in EXCUSED.items() if getattr(self, name)))
        return (
            frozenset(self.axioms)
            - ({"side_of_branch"} if self.boundary == "defeasible" else set())
            - excused
        )

    @cached_property
    def has_paths(self) -> bool:
        """Whether maps have paths: some axiom, or a rule of the user, says which there are."""
        says = {*PATHS, "next_place", "all_on_paths"}
        return self.level == "topological" and bool(self.rules or says & {*self.axioms})

    @cached_property
    def given_up(self) -> frozenset[str]:
        """The names of axioms relevant to this theory that it does not enforce.

        They are not chosen, are left out, or may be excused.
        """
        return (
            frozenset(a.name for a in encodings.axioms() if a.has_subject_in(vars(self)))
            - self.hard
        )

    @cached_property
    def demands(self) -> frozenset[str]:
        """The names of all that a speed-up must respect.

        A hard axiom has its own name, and each other axiom "NAME, excusable". Steps that are said
        to be one dstate give "asserted same", and the user's rules "the rules of FILE". A changed
        field that no axiom covers gives "the field NAME".
        """
        excusable = {f"{name}, excusable" for name in set(self.axioms) - self.hard}
        asserted = {"asserted same"} if self.same else set()
        rules = {f"the rules of {rules.name}" for rules in self.rules}
        # A declared field that decides whether an axiom holds is covered by this axiom.
        decide = {condition for axiom in encodings.axioms() for condition in axiom.conditions}
        spoken_for = SPOKEN_FOR | (decide & self.declared.keys())
        others = {
            f"the field {f.name}"
            for f in fields(self)
            if f.name not in spoken_for and getattr(self, f.name) != f.default
        }
        return self.hard | excusable | asserted | rules | others

    @cached_property
    def asserted(self) -> Pairs:
        """Pairs of steps that the user asserts to be one dstate, different dstates or places."""
        return Pairs.of(self.different, self.elsewhere, self.same)

    def with_frames(self) -> Theory:
        """Return a stricter theory with star=frame, for a theory with star=pattern.

        It prefers the fewest dstates, gives paths a total order, and allows no excuses. Stars that
        agree in a frame are also one pattern. So its maps, without headings, are maps of this
        theory.
        """
        boundary = "none" if self.boundary == "none" else "strict"
        rest = [count for count in self.priorities if count in ("paths", "places")]
        return self.replace(
            star="frame", path_order="total", boundary=boundary, prefer=("dstates", *rest)
        )

    def lack_of(self, step: Step) -> str | None:
        """Say what a step lacks that the axioms need, and how to mend it; None if nothing.

        `star` must not be auto. A step may lack a star, or the kind of its action.
        """
        _checked_step(step)
        if (
            self.level == "topological"
            and step.action is not None
            and step.action.kind is None
            and not step.action.unlinked
        ):
            return (
                'action.kind: expected "travel" or "turn" in a topological theory, got '
                f"none for {brief(step.action.name)}; "
                f'write {{"name": …, "kind": "travel"}} or {{"name": …, "kind": "turn", "turn": '
                f'"right"}}, or take {CAUSAL}'
            )
        if self.star == "none":
            return None
        if step.star is None:
            return (
                "star: expected one, as other steps have stars; add it, or take "
                f"{choice('star', 'none')}"
            )
        if self.star == "gateways" and step.gateways and (near := step.gateways.too_near):
            return (
                f"star: expected gateways that their spreads tell apart, got {near[0]:g} and "
                f"{near[1]:g} degrees; give smaller spreads, or merge the two"
            )
        if self.star in ("alike", "gateways"):
            return None
        try:
            _ = step.openings
        except TraceError as error:
            return f"{error}, or take {choice('star', 'none')}"
        return None

    def check_steps(self, trace: Trace) -> None:
        """Check that the trace has all steps of the user's assertions.

        Raises:
            TheoryError: A step is missing.
        """
        checked_trace(trace)
        for name in ASSERTIONS:
            for pair in getattr(self, name):
                if max(pair) >= len(trace):
                    flag = f"--{name.replace('_', '-')}"
                    raise TheoryError(
                        f"{name} ({flag}): expected steps from 0 to {len(trace) - 1}, got "
                        f"{pair[0]},{pair[1]}; take two steps of the trace"
                    )

    def of_steps(self, first: int, length: int) -> Theory:
        """Return this theory for a part of the trace.

        The pairs of steps that the user asserts are renumbered. Pairs with a step
        outside of the part are dropped.

        Args:
            first: The first step of the part, which becomes step 0.
            length: The number of steps of the part.
        """
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
        """Return the fields as a dict of plain data.

        Fields that encodings declare are left out if they have their defaults. So files do not
        change when an axiom is added.
        """
        unused = {f.name for f in encodings.declared() if getattr(self, f.name) == f.default}
        return {
            k: [list(e) if isinstance(e, tuple) else e for e in v] if isinstance(v, tuple) else v
            for k, v in asdict(self).items()
            if k not in unused
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Theory:
        """Make a theory from the data that `to_dict` wrote.

        Missing fields get their values in the preset: `causal` if level is causal, else
        `topological`.

        Raises:
            TheoryError: A field is wrong.
        """
        an_object("theory", data, TheoryError, mend="take one that to_dict made")
        preset = cls.causal() if data.get("level") == "causal" else cls()
        return preset.replace(
            **{k: tuple(v) if isinstance(v, list) else v for k, v in data.items()}
        )

    @classmethod
    def from_toml(cls, path: str | os.PathLike[str]) -> Theory:
        """Read a theory from a TOML file with one field per line, such as `star = "frame"`.

        Args:
            path: The file. A line such as `preset = "causal"` names the preset that the other
                fields change. Paths in the field `rules` are relative to the folder of this file.

        Raises:
            TheoryError: The file cannot be read, or a field is wrong.
        """
        a_path("path", path, TheoryError)
        data = _read_toml(path)
        preset = data.pop("preset", "causal" if data.get("level") == "causal" else "topological")
        preset = one_of(f"{named(path)}: preset", preset, PRESETS, TheoryError)
        if isinstance(rules := data.get("rules"), list):
            beside = Path(path).parent
            data["rules"] = [
                str(beside / file) if isinstance(file, str) else file for file in rules
            ]
        with said_of(named(path)):
            return PRESETS[preset]().replace(
                **{k: tuple(v) if isinstance(v, list) else v for k, v in data.items()}
            )


def _read_toml(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Return the fields in a TOML file as a dict, or raise TheoryError."""
    try:
        return tomllib.loads(read_at_most(path, LARGEST_TOML).decode("utf-8"))
    except OSError as error:
        why, mend = error.strerror or str(error), "name a .toml file"
    except (UnicodeDecodeError, tomllib.TOMLDecodeError, ValueError) as error:
        why, mend = str(error), 'write lines such as star = "frame"'
    raise TheoryError(f"{named(path)}: expected a theory in TOML, got {why}; {mend}")


def _checked_step(value: object) -> Step:
    return an_instance("step", value, Step, TraceError, mend="take one of trace.steps")


PRESETS: dict[str, Callable[[], Theory]] = {
    "causal": Theory.causal,
    "topological": Theory.topological,
    "circumscriptive": Theory.circumscriptive,
}


def checked_theory(value: object) -> Theory:
    """Return a theory; Theory.topological() for None. Raise TheoryError for other values."""
    if value is None:
        return Theory.topological()
    mend = "take Theory.topological(), Theory.causal() or Theory(…)"
    return an_instance("theory", value, Theory, TheoryError, mend=mend)
