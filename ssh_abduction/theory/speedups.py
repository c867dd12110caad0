"""The table of speed-ups: what each one does, and for which theories it holds.

A speed-up makes solving faster and changes no answer. It is made for certain axioms, but users may
add others. So each speed-up lists the axioms that it rests on: the theory must enforce them. It
also lists the axioms that it keeps: for these it is exact. A speed-up is used for a theory only if
it keeps all axioms of the theory. So an axiom that it does not know switches it off, and axioms
that users add are always obeyed.

>>> from ssh_abduction import Theory
>>> from ssh_abduction.theory.speedups import Speedups
>>> Speedups().that_hold_for(Theory(different=[(0, 2)])).prefixes
True
>>> Speedups().that_hold_for(Theory(without=["one_place"])).prefixes
False
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields, replace
from typing import Final

from ssh_abduction.data.checks import a_flag, an_instance
from ssh_abduction.data.errors import SolverError, brief
from ssh_abduction.data.words import shortly
from ssh_abduction.theory import encodings
from ssh_abduction.theory.fields import EXCUSED
from ssh_abduction.theory.theory import Theory, checked_theory


@dataclass(frozen=True, slots=True)
class Speedups:
    """Which speed-ups are on, as flags.

    No speed-up changes an answer. `TABLE` says what each one does, and for which theories it holds.
    """

    prefixes: bool = True
    path_names: bool = True
    names: bool = True
    clique: bool = True
    lazy: bool = True
    core_guided: bool = True
    sides: bool = True
    framing: bool = True
    ways: bool = True
    greedy: bool = True
    digest: bool = True

    def __post_init__(self) -> None:
        for name in SPEEDUPS:
            a_flag(f"speedups: {name}", getattr(self, name), SolverError)

    def __repr__(self) -> str:
        return shortly(self)

    @classmethod
    def without(cls, names: str | Iterable[str]) -> Speedups:
        """Return Speedups that are all on except these.

        Args:
            names: Names of fields, in a list or separated by commas.

        Raises:
            SolverError: A name is unknown.
        """
        expected = f"speedups: expected names out of {', '.join(SPEEDUPS)}, got"
        if not isinstance(names, Iterable):
            raise SolverError(f"{expected} {brief(names)}; take some of these")
        off = [name for name in (names.split(",") if isinstance(names, str) else names) if name]
        for name in off:
            if name not in SPEEDUPS:
                raise SolverError(f"{expected} {brief(name)}; take some of these")
        return cls(**dict.fromkeys(off, False))

    def that_hold_for(self, theory: Theory) -> Speedups:
        """Return these speed-ups without those that might change an answer for a theory.

        Args:
            theory: The theory. Its `star` must not be auto.
        """
        theory = checked_theory(theory)
        valid = {speedup.switch for speedup in TABLE if speedup.holds_for(theory)}
        return replace(self, **{name: False for name in SPEEDUPS if name not in valid})


def checked_speedups(value: object) -> Speedups:
    """Return a value if it is Speedups, or raise SolverError."""
    mend = "take Speedups() or Speedups.without(…)"
    return an_instance("speedups", value, Speedups, SolverError, mend=mend)


SPEEDUPS = tuple(f.name for f in fields(Speedups))
EVERY: Final = None
NOTHING: frozenset[str] = frozenset()


@dataclass(frozen=True)
class Speedup:
    """A row of the table of speed-ups.

    Attributes:
        name: The name of the row.
        switch: The field of `Speedups` that turns it on. Several rows may share a switch.
        suits: Returns whether the row is made for a theory.
        rests_on: Axioms that it needs. If an axiom is about something that a theory has, such as
            paths, the theory must enforce it.
        keeps: Returns the axioms for which it is exact: it loses no map that satisfies them, and
            finds no other map. EVERY if it is exact for all axioms, because further axioms only
            remove maps, or because every map is checked anyway.
    """

    name: str
    switch: str
    suits: Callable[[Theory], bool] = lambda theory: True
    rests_on: frozenset[str] = NOTHING
    keeps: Callable[[], frozenset[str]] | None = EVERY

    def holds_for(self, theory: Theory) -> bool:
        """Whether it changes no answer for a theory. `star` must not be auto."""
        return (
            self.suits(theory)
            and not self.rests_on & theory.given_up
            and (self.keeps is EVERY or theory.demands <= self.keeps())
        )


def _has_frames(theory: Theory) -> bool:
    return (
        theory.star == "frame"
        and theory.priorities[:1] == ("dstates",)
        and theory.path_order == "total"
    )


def _kept_by(*names: str, and_also: Iterable[str] = ()) -> Callable[[], frozenset[str]]:
    """Make a function that returns the axioms kept by fast encodings and by Python code."""
    return lambda: encodings.keeps(*names) | frozenset(and_also)


# The axioms in the files of the first theory. A further axiom has a file of its own, so that no
# speed-up knows it at first.
CAUSAL = encodings.names_in("causal")
GATEWAYS = encodings.names_in("gateways")
# A dstate has one observation, one place, and one course.
ONE_OF_EACH = CAUSAL | {"one_place", "one_course"}
# All axioms of places and paths that every theory has. Only some theories have the others.
PLACES = (CAUSAL | encodings.names_in("topological")) - {
    "path_order_total",
    "next_place",
    "all_on_paths",
}
# Without those that say what a path needs, and how its places are ordered.
TRAVELS_AND_TURNS = PLACES - {
    "course_needs_travel",
    "one_dstate_per_course",
    "on_path",
    "travel_orders",
    "order_asymmetric",
    "order_transitive",
}
FRAMES = PLACES | {"path_order_total"} | encodings.names_in("star")
# The start of a drive is an action that occurs once and is neither travel nor turn.
DRIVES = "the field several_drives"
# A lift leads to one dstate, as any action. It is neither travel nor turn.
LIFTS = "the field lifts"
# Fields that a trace sets, and that the Python code around each fast encoding knows.
OF_TRACES = (DRIVES, LIFTS)
# The axioms of evidence about steps only. Such evidence says which steps are different dstates or
# at different places, and which labels contradict each other.
PAIRS_OF_STEPS = (
    "asserted",
    "one_star",
    "one_pose",
    "closure",
    "planar",
    "other_floor",
    "one_landing",
)
# Axioms about links, observations and pairs of steps only. If a map satisfies them, so does the map
# of its first steps. Two drives may be cut apart, too, because no link joins them.
SURVIVE_A_CUT = encodings.names_in("causal", "topological", "boundary", "star") | {
    "side_of_branch, excusable",
    "asserted same",
    *PAIRS_OF_STEPS,
    *OF_TRACES,
}

TABLE = (
    # Solve for a prefix of the trace, replay its maps on the whole trace, and extend the prefix to
    # where they fail.
    Speedup(
        "prefixes",
        "prefixes",
        # Each dstate has at most one heading, if places have frames.
        lambda theory: theory.star != "frame" or "one_heading" in theory.hard,
        ONE_OF_EACH,
        lambda: SURVIVE_A_CUT,
    ),
    # The same if stars agree within a tolerance. A replayed map must fit the stars of all steps.
    Speedup(
        "prefixes in tolerance",
        "prefixes",
        lambda theory: theory.star == "gateways",
        ONE_OF_EACH | {"gateway_heading"},
        lambda: SURVIVE_A_CUT | GATEWAYS,
    ),
    # Begin with few names for paths, and add names when they are too few.
    Speedup(
        "path_names", "path_names", lambda theory: theory.level == "topological", TRAVELS_AND_TURNS
    ),
    # Causal theory: make some names. Clingo chooses one of them for each node.
    Speedup(
        "named dstates",
        "names",
        lambda theory: (
            theory.level == "causal" and theory.prefer == ("dstates",) and not theory.has_faults
        ),
        CAUSAL,
        _kept_by("names", and_also=(*PAIRS_OF_STEPS, *OF_TRACES, "asserted same")),
    ),
    # Causal theory with faults: give the dstates names, and give clingo only the steps that a map
    # does not predict.
    Speedup(
        "named dstates with faults",
        "names",
        lambda theory: (
            theory.level == "causal" and theory.has_faults and theory.prefer == ("dstates",)
        ),
        NOTHING,
        _kept_by(
            "faulty",
            and_also=(
                *(f"{axiom}, excusable" for axiom in CAUSAL),
                "the field misread",
                "the field slipped",
                "asserted same",
                *PAIRS_OF_STEPS,
                *OF_TRACES,
            ),
        ),
    ),
    # Faults, with places or with displacements that may be wrong: guess the faults, mend the trace,
    # and solve it without faults. Causal maps with faults show what is minimal.
    Speedup(
        "mending",
        "names",
        lambda theory: (
            (theory.level == "topological" or theory.jumped > 0)
            and theory.has_faults
            and not theory.without
            and not theory.changed
        ),
        NOTHING,
        lambda: (
            SURVIVE_A_CUT
            | {f"{axiom}, excusable" for axiom in SURVIVE_A_CUT}
            | {f"the field {kind}" for kind in EXCUSED}
            | {"path_in_one_piece"}
        ),
    ),
    # Places with frames: first find which visits are at one place, and so the dstates. Then find
    # places and paths.
    Speedup(
        "visits",
        "names",
        _has_frames,
        FRAMES,
        _kept_by(
            "visits",
            "sides_framed",
            "paths",
            and_also=(*PAIRS_OF_STEPS, *OF_TRACES, "asserted same", "the field same_place"),
        ),
    ),
    # Places without stars: if clingo takes long, first find the dstates, with names. Then find
    # places and paths.
    Speedup(
        "ways",
        "ways",
        lambda theory: (
            theory.level == "topological"
            and theory.star in ("none", "alike")
            and theory.priorities[:1] == ("dstates",)
        ),
        PLACES,
        _kept_by(
            "names",
            "sides_frameless",
            "paths",
            and_also=(*PAIRS_OF_STEPS, *OF_TRACES, "asserted same", "the field same_place"),
        ),
    ),
    # Find steps that are pairwise distinct, or such segments of paths. Give each its own name.
    Speedup(
        "clique", "clique", lambda theory: not theory.unknown_views and not theory.changed, CAUSAL
    ),
    # Places with frames: while dstates are sought, add what the order and the sides of paths
    # forbid, path by path.
    Speedup("sides", "sides", _has_frames, FRAMES),
    # Give clingo only some links, or visits, at first. Add others when an answer breaks them.
    Speedup("lazy", "lazy"),
    # Raise the lower bound by unsat cores, instead of improving a map step by step.
    Speedup("core_guided", "core_guided"),
    # Make a map without clingo, by sketches or by a beam of hypotheses about the displacements. The
    # checker judges this map. Without it, the confidence of a map ignores maps that break axioms.
    Speedup("greedy", "greedy"),
    # To add a drive to an existing map, give the solver each link of the map once, instead of all
    # old steps.
    Speedup(
        "digest",
        "digest",
        lambda theory: not theory.has_faults,
        ONE_OF_EACH,
        lambda: (
            (SURVIVE_A_CUT | GATEWAYS | {"path_in_one_piece", "the field unknown_views"})
            - {"one_pose", "closure"}
        ),
    ),
    # Stars as patterns: if clingo takes long, search for a map in which places have frames. The
    # checker judges this map.
    Speedup(
        "framing",
        "framing",
        lambda theory: theory.star == "pattern" and row("visits").holds_for(theory.with_frames()),
    ),
)


def row(name: str) -> Speedup:
    """Return the row of the table with this name."""
    return next(speedup for speedup in TABLE if speedup.name == name)


ALL = Speedups()
