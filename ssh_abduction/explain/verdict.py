"""The answer to whether two steps of a trace are one dstate, and why."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, NamedTuple

from ssh_abduction.data.schema import PlainData, attributes_of
from ssh_abduction.data.words import noun_of
from ssh_abduction.explain.no_map import ClashingAxiom, Explanation, clashes_of, steps_listed
from ssh_abduction.solution import Cost, Stop
from ssh_abduction.theory.theory import Theory

# If an inference has more reasons than IN_A_LINE, each gets a line of its own.
IN_A_LINE, INDENT = 2, " " * 7
# A summary with more parts than this is not printed.
BRIEF = 3


class Verdict(Enum):
    """The relation of two steps in the maps of a trace: one dstate, or different dstates."""

    # different dstates, or one dstate, in every consistent map
    DIFFERENT = "different"
    SAME = "same"
    # in every minimal map, but not known to hold in every map
    DIFFERENT_IN_MINIMAL = "different in every minimal map"
    SAME_IN_MINIMAL = "same in every minimal map"
    # one dstate in some minimal maps, different dstates in others
    DISAGREE = "rivals disagree"
    # the trace has no map
    NO_MAP = "no map"
    # a limit ended the search
    UNKNOWN = "unknown"


@dataclass(frozen=True, slots=True)
class Side:
    """What is known about one side of a pair of steps.

    A side is all maps in which the steps are one dstate, or all maps in which they differ.
    """

    possible: bool | None = None  # whether this side has a map; None if unknown
    cost: Cost | None = None  # the cost of the best known map of this side; None if no map is known
    proven: bool = False  # whether it is proven that no map of this side costs less
    maps: int = 0  # the number of listed minimal maps that are on this side
    # The cost of the best known map in nats, if maps are weighed; else None.
    nats: float | None = None

    def dearness(self, theory: Theory) -> tuple[float, ...] | None:
        """Return a sort key of the cost of the best map; None without a map. Lower is better."""
        if self.nats is not None:
            return (self.nats,)
        return None if self.cost is None else self.cost.preferred_by(theory)

    def to_dict(self) -> dict[str, Any]:
        """Return the side as plain data, as `explain --json` prints it."""
        own = attributes_of(self, "possible", "cost", "proven", "maps")
        return own | ({} if self.nats is None else {"nats": round(self.nats, 6)})


@dataclass(frozen=True, slots=True)
class PairExplanation:
    """The answer to whether two steps are one dstate, and why.

    Attributes:
        first: The earlier step.
        second: The later step.
        verdict: The relation of the two steps in the maps of the trace.
        same: What is known about the maps in which the steps are one dstate.
        different: What is known about the maps in which the steps are different dstates.
        listed: Whether all minimal maps were listed, so that `same.maps` and `different.maps` count
            all of them.
        derivation: The argument, if the verdict holds in every map. None otherwise, or if no
            argument was found in time.
        clash: Why the trace has no map; None if it has one, or if the reason is not known.
        stopped: The limit that ended the search; None if it ended by itself.
        theory: The theory, with each "auto" replaced by the value that was used.
        loop: The closing error of the loop between the steps, in words; None if unknown.
        matches: Sentences about the closures between the visits of the two steps.
        changes: Sentences about the gateways at the places of the steps that changed between drives
            in the best map.
    """

    first: int
    second: int
    verdict: Verdict
    same: Side
    different: Side
    listed: bool
    derivation: Derivation | None
    clash: Explanation | None
    stopped: Stop | None
    theory: Theory = field(repr=False)
    loop: str | None = None
    matches: tuple[str, ...] = ()
    changes: tuple[str, ...] = ()

    @property
    def proven(self) -> bool:
        """Whether the verdict is proven, that is, anything but UNKNOWN."""
        return self.verdict is not Verdict.UNKNOWN

    @property
    def sentences(self) -> tuple[str, ...]:
        """The verdict in words, and the cost of the best map that contradicts it, as sentences."""
        pair = f"steps {self.first} and {self.second}"
        weighed = any(side.nats is not None for side in (self.same, self.different))
        best = "map of least cost" if weighed else "minimal map"
        verdict = {
            Verdict.DIFFERENT: f"{pair} are different dstates in every map",
            Verdict.SAME: f"{pair} are one dstate in every map",
            Verdict.DIFFERENT_IN_MINIMAL: f"{pair} are different dstates in every {best}",
            Verdict.SAME_IN_MINIMAL: f"{pair} are one dstate in every {best}",
            Verdict.DISAGREE: f"{pair} are one dstate in some minimal maps, and different dstates "
            "in others",
            Verdict.NO_MAP: f"no map satisfies the axioms, so nothing is known about {pair}",
            Verdict.UNKNOWN: f"it is unknown whether {pair} are one dstate "
            f"({self.stopped or 'no proof'})",
        }[self.verdict]
        argued = str(self.derivation)  # may name a match, too
        matches = [match for match in self.matches if match not in argued]
        return (verdict, *self._of_maps(), *self._of_costs(), *matches, *self.changes)

    def _of_maps(self) -> Iterator[str]:
        """Yield sentences: the number of maps of each side, or why the trace has no map."""
        maps = self.same.maps + self.different.maps
        if self.verdict is Verdict.DISAGREE and maps > 1:
            of = f"{'the' if self.listed else 'the first'} {maps} minimal maps"
            numbers = f"one dstate in {self.same.maps}, different in {self.different.maps}"
            yield f"of {of}, the steps are {numbers}"
        if self.verdict is Verdict.NO_MAP and self.clash:
            yield str(self.clash)
        if self.verdict is Verdict.UNKNOWN:
            for side, equal in ((self.same, "="), (self.different, "≠")):
                if side.cost:
                    cost = _in_words(side.cost, self.theory.priorities)
                    cost += "" if side.nats is None else f", and costs {side.nats:.1f} nats"
                    yield f"a map with step {self.first} {equal} step {self.second} has {cost}"

    def _of_costs(self) -> Iterator[str]:
        """Yield a sentence about the cost of the best map that contradicts the verdict."""
        if self.verdict is Verdict.DIFFERENT_IN_MINIMAL:
            lost, won, equal = self.same, self.different, "="
        elif self.verdict is Verdict.SAME_IN_MINIMAL:
            lost, won, equal = self.different, self.same, "≠"
        else:
            return
        rival = f"with step {self.first} {equal} step {self.second}"
        if lost.possible is False:
            yield f"no map {rival} satisfies the axioms"
        elif lost.cost is None or won.cost is None:
            yield f"it is unknown whether there is a map {rival}"
        elif lost.nats is not None and won.nats is not None:
            yield self._weighed(lost, won)
        else:
            known = "the best map" if lost.proven else "the best map found"
            yield f"{known} {rival} has {_difference(lost.cost, won.cost, self.theory)}"
            if not self.theory.has_faults:  # with faults, a step treated as wrong may decide
                yield "nothing observed decides this: it rests on minimality alone"

    def _weighed(self, lost: Side, won: Side) -> str:
        """Say in nats why the maps of one side cost more than the maps of the other side."""
        assert lost.nats is not None and won.nats is not None  # noqa: PT018
        assert lost.cost is not None and won.cost is not None  # noqa: PT018
        joining = self.verdict is Verdict.DIFFERENT_IN_MINIMAL
        pair = f"steps {self.first} and {self.second}"
        names = ("dstates", "places", "faults")
        more = {name: getattr(lost.cost, name) - getattr(won.cost, name) for name in names}
        what = f"joining {pair}" if joining else f"making {pair} different dstates"
        changed = [
            f"{_counted(abs(number), name)} {'more' if number > 0 else 'less'}"
            for name, number in more.items()
            if number
        ]
        counts = f", with {' and '.join(changed)}" if changed else ""
        loop = f": {self.loop}" if self.loop else ""
        nats = lost.nats - won.nats
        effect = f"costs {nats:.1f} nats" if nats >= 0 else f"saves {-nats:.1f} nats"
        return f"{what} {effect}{counts}{loop}"

    @property
    def assuming(self) -> dict[str, str]:
        """What it costs to assume that the steps are one dstate, or that they are not, in words.

        The keys of the dict are `same` (the steps are one dstate) and `different` (they are not).
        """
        sides = {"same": self.same, "different": self.different}
        known_sides = [side for side in sides.values() if side.cost]
        best = min(known_sides, key=lambda side: side.dearness(self.theory) or (), default=None)
        costs = {}
        for name, side in sides.items():
            other = self.different if side is self.same else self.same
            if side.possible is False:
                costs[name] = "no map satisfies the axioms"
            elif other.possible is False:
                costs[name] = "costs nothing, as it holds in every map"
            elif side.cost is None or best is None or best.cost is None:
                costs[name] = "its cost is unknown"
            elif side.nats is not None and best.nats is not None and side is not best:
                known = "" if side.proven else "at most "
                costs[name] = f"costs {known}{side.nats - best.nats:.1f} nats more"
            elif side is best or side.dearness(self.theory) == best.dearness(self.theory):
                known = "costs nothing" if side.proven else "no map is known that costs less"
                costs[name] = f"{known}: {_in_words(side.cost, self.theory.priorities)}"
            else:
                known = "" if side.proven else "at most, "
                costs[name] = f"{known}{_difference(side.cost, best.cost, self.theory)}"
        return costs

    def __str__(self) -> str:
        lines = list(self.sentences)
        if self.derivation:
            lines.append(str(self.derivation))
        elif self.verdict in (Verdict.DIFFERENT, Verdict.SAME):
            why = self.stopped or "it takes too many steps"
            lines.append(f"no argument was found ({why})")
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Return the answer as plain data, as `explain --json` prints it."""
        names = ("sentences", "same", "different", "listed", "derivation", "clash")
        return {
            "steps": [self.first, self.second],
            "verdict": self.verdict.value,
            **attributes_of(self, *names),
            **({"stopped": self.stopped} if self.stopped else {}),
        }


def _counts(cost: Cost, names: Iterable[str]) -> Iterator[tuple[str, float]]:
    """Yield the name and number of each count. Tenths of dstates are converted to dstates."""
    for name in names:
        yield ("tenths", cost.tenths / 10) if name == "tenths" else (name, getattr(cost, name))


def _in_words(cost: Cost, names: Iterable[str]) -> str:
    """Put the counts with these names into words."""
    counts = [f"{number:g} {_noun(name, number)}" for name, number in _counts(cost, names)]
    return ", ".join(counts) or "no count is preferred"


def _noun(name: str, number: float) -> str:
    """Return the word for a count, in the singular or plural."""
    noun = "dstates with its faults" if name == "tenths" else name
    return noun.removesuffix("s") if number == 1 and name != "tenths" else noun


def _counted(number: float, name: str) -> str:
    """Put a count into words. Faults are counted by what they cost in dstates."""
    if name == "faults":
        return f"faults for {number:g} {_noun('dstates', number)}"
    return f"{number:g} {_noun(name, number)}"


def _difference(lost: Cost, won: Cost, theory: Theory) -> str:
    """Compare two costs in words: the first count that differs, and the equal counts before it."""
    same: list[str] = []
    counts = (_counts(cost, theory.priorities) for cost in (lost, won))
    for (name, one), (_, other) in zip(*counts, strict=True):
        said = f"{one:g} {_noun(name, one)}"
        if one != other:
            return f"{said}, not {other:g}" + (f", with {' and '.join(same)}" if same else "")
        same.append(said)
    return f"{_in_words(lost, theory.priorities)}, as many as the minimal maps"


class Link(NamedTuple):
    """An axiom at one step that an argument needs.

    There is a map of the steps of the argument in which all other links hold, but not the
    conclusion.
    """

    axiom: str  # the name of the axiom
    # The step. If the axiom is about several steps at once, this is the last of them.
    step: int


@dataclass(frozen=True, slots=True)
class Inference(PlainData):
    """One line of an argument."""

    says: tuple[str, ...]  # the conclusions, each as a clause
    because: tuple[str, ...]  # the axioms that the conclusions follow from, each as a clause
    links: tuple[ClashingAxiom, ...]  # the same axioms by name, each with its steps
    # The indices (from 0) of the earlier lines that the conclusions follow from.
    premises: tuple[int, ...]
    # Whether the line holds only under the supposition that leads to a contradiction.
    supposed: bool


@dataclass(frozen=True, slots=True)
class Derivation:
    """An argument why two steps are different dstates in every map, or one dstate in every map.

    Attributes:
        steps: The steps of the trace that suffice for the argument.
        first: The earlier step of the pair.
        second: The later step of the pair.
        one: True if the steps are one dstate in every map, False if they differ in every map.
        links: The axioms, each at one step, that the argument needs. None can be left out.
        inferences: The argument, line by line.
        supposition: The supposition of the lines with `supposed`, as a clause; None if there is no
            such line.
        summary: The last line with several premises, in one sentence.
    """

    steps: tuple[int, ...]
    first: int
    second: int
    one: bool
    links: tuple[Link, ...]
    inferences: tuple[Inference, ...]
    supposition: str | None
    summary: str

    @property
    def clashes(self) -> tuple[ClashingAxiom, ...]:
        """The axioms of the links in the order of the argument, each with all its steps."""
        return clashes_of(self.links)

    @property
    def axioms(self) -> tuple[str, ...]:
        """The names of the axioms in `clashes`, in the order of the argument."""
        return tuple(clash.axiom for clash in self.clashes)

    def __str__(self) -> str:
        lines, supposed = [], False
        for number, inference in enumerate(self.inferences, 1):
            if inference.supposed and not supposed:
                lines.append(f"suppose that {self.supposition}; then")
                supposed = True
            lines += _lines_of(inference, number)
        parts = self.summary.split("; ")
        # a summary of many parts only repeats the lines
        return "\n".join([*lines, f"in short: {self.summary}"] if len(parts) <= BRIEF else lines)

    def to_dict(self) -> dict[str, Any]:
        """Return the argument as plain data, as `explain --json` prints it."""
        return attributes_of(self, "steps", "clashes", "supposition", "inferences", "summary")


def _lines_of(inference: Inference, number: int) -> Iterator[str]:
    """Yield the lines that print an inference: conclusions, premises, axioms and their steps."""
    lines = ", ".join(str(premise + 1) for premise in inference.premises)
    by = f" (from {noun_of('line', inference.premises)} {lines})" if lines else ""
    names = "; ".join(f"{link.axiom}, {steps_listed(link.steps)}" for link in inference.links)
    says = f"{number:3}. {'; '.join(inference.says)}{by}:"
    named = [f"[{names}]"] if names else []
    if len(inference.because) > IN_A_LINE:
        yield says
        yield from (f"{INDENT}{line}" for line in (*inference.because, *named))
    else:
        yield " ".join([says, "; ".join(inference.because), *named])
