"""Results of comparing the maps of a trace by cost: costs in nats, rivals, and probabilities.

The cost of a map in nats is minus the natural logarithm of its marginal likelihood. Of two maps,
one that costs 3 nats more is exp(3) = 20 times less probable.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import pairwise
from typing import Any

from ssh_abduction.data.drives import Drive, named_steps
from ssh_abduction.data.groups import gathered, indices_of
from ssh_abduction.data.map_parts import FAULTS
from ssh_abduction.data.schema import FieldReader
from ssh_abduction.data.words import counted, noun_of

EQUAL = 1e-6  # costs in nats that differ by less count as equal
# Probabilities with the same digits are equally doubtful. A file has costs with fewer digits, and
# must say the same.
TOLD = 4
# The prior probability that a building breaks axioms. Mention a map that breaks axioms only if it
# costs SAID nats less than the best map.
BREAKS, SAID = 0.005, 1.0
# A join is doubtful if it is false with more than this probability. Mention that two steps may be
# at one place, too, if that is more probable than this.
DOUBTED = 0.05
# A misfit is improbable if the true map has a larger one with less than this probability.
IMPROBABLE = 0.01
MOST = 700.0  # exp of more overflows


@dataclass(frozen=True, slots=True)
class Rival:
    """A map of the whole trace, without its paths.

    Attributes:
        places: The place of each step, numbered by first visit; empty for a causal map.
        estimated: Whether the map was made from the best one by giving visits a new place. It fits
            the displacements, but may break an axiom.
        faults: The kind and the step of each fault, such as ("jumped", 7).
        aliases: For each closure of the trace, 0 if it is true, else the number of the alias that
            it is of; negative if the alias moves the first step of the closure, not the last one.
            Empty if all closures are true.
        crowded: The nats by which the map is less probable than its cost says, beside the best
            map, as more of its places are near each other.
    """

    nats: float
    dstates: tuple[int, ...]
    places: tuple[int, ...] = ()
    estimated: bool = False
    faults: tuple[tuple[str, int], ...] = ()
    aliases: tuple[int, ...] = ()
    crowded: float = 0.0

    @property
    def at(self) -> tuple[int, ...]:
        """The place of each step; the dstate of each step for a causal map."""
        return self.places or self.dstates

    def to_dict(self) -> dict[str, Any]:
        """Return the rival as plain data."""
        written: dict[str, Any] = {"nats": round(self.nats, 6), "dstates": list(self.dstates)}
        written |= {"places": list(self.places)} if self.places else {}
        written |= {"faults": [list(fault) for fault in self.faults]} if self.faults else {}
        written |= {"aliases": list(self.aliases)} if self.aliases else {}
        written |= {"crowded": round(self.crowded, 6)} if abs(self.crowded) >= EQUAL else {}
        return written | ({"estimated": True} if self.estimated else {})


@dataclass(frozen=True)
class Weighed:
    """The costs of the maps of a trace, as far as they are known.

    Attributes:
        bound: A proven lower bound on the cost of every map, in nats.
        within: `rivals` has every map that costs more than the best one by less than this many
            nats. 0 if it is not proven which map is the best.
        rivals: The maps that cost little more than the best one, the best one first. Estimated
            maps come last.
        searched: Whether a broad beam of hypotheses ended with the best map, and its misfit is not
            improbable. For several drives it is enough that broad beams mapped each drive, and that
            the best map is the cheapest way to join their maps. If it keeps drives apart, a rival
            must join them. Such a map is seldom false, even if it is not proven to be the best.
        broken: How many nats the best map that breaks axioms costs less than the best map; 0 if it
            does not cost less, -inf if no such map was sought.
        excess: The misfit of the best map, divided by the misfit that the standard deviations
            predict. Costs are divided by it before they become probabilities.
        doubt: Why the costs cannot be trusted, such as "the track is unreliable"; None if they can.
        drives: The drives of the trace, to call a step "monday:12"; empty if they are unknown.
    """

    bound: float
    within: float
    rivals: tuple[Rival, ...]
    searched: bool = False
    broken: float = -math.inf
    excess: float = 1.0
    doubt: str | None = None
    drives: tuple[Drive, ...] = field(default=(), compare=False, repr=False)

    @property
    def nats(self) -> float:
        """The cost of the best map."""
        return self.rivals[0].nats

    @cached_property
    def weights(self) -> tuple[float, ...]:
        """The probability of each rival, assuming that there are no other maps."""
        less = [self.nats - rival.nats - rival.crowded for rival in self.rivals]
        likely = [math.exp(min(nats / self.excess, MOST)) for nats in less]
        return tuple(weight / sum(likely) for weight in likely)

    @property
    def proven(self) -> bool:
        """Whether no map costs less than the best one."""
        return self.bound >= self.nats - EQUAL

    @property
    def finished(self) -> bool:
        """Whether the best map is proven to be the best, or `searched`."""
        return self.proven or self.searched

    @property
    def confidence(self) -> float | None:
        """The probability of the best map among its rivals; None if it is unknown.

        It is unknown if the search did not finish, or if there is a `doubt`. If the best map that
        breaks axioms costs less, it is a rival, with BREAKS as its prior.
        """
        return self._confidence(self.weights[0])

    @property
    def place_confidence(self) -> float | None:
        """The probability that the places of the best map are right, even if its dstates are not.

        It is that of all rivals with the same places, computed as `confidence`. Equal to
        `confidence` for a causal map.
        """
        best, rivals = self.rivals[0], zip(self.weights, self.rivals, strict=True)
        share = math.fsum(w for w, r in rivals if r is best or r.places == best.places != ())
        return self._confidence(share)

    def _confidence(self, share: float) -> float | None:
        """Return the confidence in maps that have this share of the weights of all rivals."""
        if self.doubt is not None or not self.finished:
            return None
        broken = math.expm1(min(max(self.broken, 0.0) / self.excess, MOST))
        return share / (1 + BREAKS * self.weights[0] * broken)

    def probability(self, first: int, second: int, of: str = "dstate") -> float:
        """Return the probability, by the known rivals, that two steps are at one dstate or place.

        Args:
            first: The number of a step, from 0.
            second: The number of another step.
            of: What the steps may share: "dstate" or "place".
        """
        named = (r.dstates if of == "dstate" else r.at for r in self.rivals)
        weighed = zip(self.weights, named, strict=True)
        return math.fsum(w for w, names in weighed if names[first] == names[second])

    @cached_property
    def joins(self) -> tuple[tuple[int, int, float], ...]:
        """The joins of the best map, each with its probability, the least probable one first.

        A join is two steps at one place, with steps elsewhere in between. In a causal map the two
        steps are at one dstate. If there is a `doubt`, no join has a probability, and none is
        listed.
        """
        pairs = self._pairs([self.rivals[0].at], "place")
        joins = [pair for pair in pairs if pair[1] - pair[0] > 1]
        return tuple(sorted(joins, key=lambda join: (round(join[2], TOLD), join[1])))

    @cached_property
    def missed(self) -> tuple[int, int, float] | None:
        """Two steps at different places of the best map that are most probably at one place.

        Each step is given by its name, and the third value is the probability. None if no rival has
        such steps at one place, or if there is a `doubt`.
        """
        best = self.rivals[0].at
        pairs = self._pairs([rival.places for rival in self.rivals], "place")
        apart = [pair for pair in pairs if best[pair[0]] != best[pair[1]]]
        return max(apart, key=lambda pair: round(pair[2], TOLD), default=None)

    @cached_property
    def unsure(self) -> tuple[int, int, float] | None:
        """The two steps whose probability of being one dstate is nearest to 0.5, as in `missed`."""
        pairs = self._pairs([rival.dstates for rival in self.rivals], "dstate")
        return min(pairs, key=lambda pair: round(abs(pair[2] - 0.5), TOLD), default=None)

    def _pairs(self, maps: Iterable[Sequence[int]], of: str) -> list[tuple[int, int, float]]:
        """List successive steps at one place or dstate of a map, and the probability of that.

        `maps` has the places or dstates of the steps in each map. Steps are given by their names,
        such as "monday:12". If there is a `doubt`, the list is empty.
        """
        if self.doubt is not None:
            return []
        steps = named_steps(self.drives, len(self.rivals[0].dstates))
        found = {pair for at in maps for same in indices_of(at).values() for pair in pairwise(same)}
        return [(steps[i], steps[j], self.probability(i, j, of)) for i, j in sorted(found)]

    @property
    def doubtful(self) -> tuple[tuple[int, int, float], ...] | None:
        """The joins with a probability below 0.95, least first; None if that is unknown.

        It is unknown if the search did not finish, or if there is a `doubt`.
        """
        if self.confidence is None:
            return None
        return tuple(join for join in self.joins if join[2] < 1 - DOUBTED)

    @property
    def verdict(self) -> str:
        """How many joins the best map has and how many are doubtful, and whether it is proven."""
        joins = f"{counted(len(self.joins), 'pairs')} of visits joined"
        if self.doubt is not None:
            text = f"Which joins are doubtful is unknown, as {self.doubt}."
        elif not self.joins:
            text = "No two visits joined."
        elif self.doubtful is None:
            text = f"{joins}; which are doubtful is unknown."
        else:
            text = f"{joins}, {len(self.doubtful) or 'none'} doubtful."
        if self.proven:
            return f"{text} Proven best{' if the axioms hold' if self.broken > SAID else ''}."
        least = math.floor(100 * self.bound / self.nats) if self.bound > 0 else 0
        known = f": no map costs less than {least} % of it" if least else ""
        return f"{text} Not proven best{known}."

    @property
    def sentence(self) -> str:
        """How probable the best map is, and which of its joins is least sure, in words."""
        if self.doubt is not None:
            return f"no probability is given, as {self.doubt}"
        if self.confidence is None or self.place_confidence is None:
            text = (
                "no probability is given, as the search did not finish: a map that costs up to "
                f"{self.nats - self.bound:.1f} of {self.nats:.1f} nats less may exist, and more "
                "work may find it or exclude it"
            )
        else:
            whole, at = map(probability_in_words, (self.confidence, self.place_confidence))
            text = f"the best map has probability {whole}"
            text += f", and its places alone {at}" * (at != whole)
        given = ""
        if self.broken > SAID:
            text += f"; a map that breaks axioms costs {self.broken:.1f} nats less"
            given = " if the axioms hold"
        text += self._misread
        if aliases := self.rivals[0].aliases:
            false = sum(map(bool, aliases))
            text += f"; {false} of {len(aliases)} closures are false, as parts look alike"
        # Name one pair of steps: the one for which it is least sure whether they are one dstate.
        doubted = 1 - self.joins[0][2] if self.joins else 0.0
        if self.missed and self.missed[2] > max(doubted, DOUBTED):
            steps, sure = _told(self.missed)
            return f"{text}; {steps} may be at one place, too ({sure}{given})"
        if self.unsure and doubted <= DOUBTED <= self.unsure[2] <= 1 - DOUBTED:
            steps, sure = _told(self.unsure)
            two = "two dstates of one place" if self.rivals[0].places else "two dstates"
            return f"{text}; {steps} are one dstate with probability {sure}{given}, else {two}"
        if not self.joins:
            return f"{text}; the best map joins no two visits"
        if not self.finished:
            if len(self.rivals) == 1:
                return f"{text}; no other map was found, so it is unknown which joins are doubtful"
            given = f" among the {len(self.rivals)} maps found"
        steps, sure = _told(self.joins[0])
        return f"{text}; the least sure join, of {steps}, has probability {sure}{given}"

    @property
    def _misread(self) -> str:
        """Which steps may be misread, by the most probable rival that says so; "" if none does."""
        best, known = self.rivals[0], {*self.rivals[0].faults}
        said = [
            (weight, rival, sorted(t for kind, t in rival.faults if (kind, t) not in known))
            for weight, rival in zip(self.weights, self.rivals, strict=True)
            if rival.estimated and any(kind == "misread" for kind, _ in {*rival.faults} - known)
        ]
        weight, rival, wrong = max(said, key=lambda found: found[0], default=(0.0, best, []))
        if weight < DOUBTED:
            return ""
        names = named_steps(self.drives, len(best.dstates))
        # Of two visits, either may be misread.
        visits = gathered((dstate, t) for t, dstate in enumerate(rival.dstates))
        either = (seen if len(seen := visits[rival.dstates[t]]) == 2 else [t] for t in wrong)
        told = " and ".join(" or ".join(str(names[t]) for t in some) for some in either)
        return (
            f"; {noun_of('step', wrong)} {told} may be misread: with misread allowed the map has "
            f"{len({*rival.dstates})} dstates instead of {len({*best.dstates})}"
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the costs as plain data."""
        names = ("nats", "bound", "within", "broken", "excess", "confidence", "place_confidence")
        numbers = {name: getattr(self, name) for name in names}
        written = {
            **{name: None if x is None else round(x, 6) for name, x in numbers.items()},
            "searched": self.searched,
            "doubt": self.doubt,
            "rivals": [rival.to_dict() for rival in self.rivals],
        }
        # These fields are left out if they would say nothing.
        told = {
            "broken": math.isfinite(self.broken),
            "excess": self.excess > 1,
            "doubt": self.doubt is not None,
        }
        return {name: value for name, value in written.items() if told.get(name, True)}

    @classmethod
    def from_dict(
        cls, read: FieldReader, value: Any, steps: int, drives: tuple[Drive, ...] = ()
    ) -> Weighed:
        """Read what `to_dict` wrote.

        Args:
            read: Checks the fields, and names the wrong one in errors.
            value: What `to_dict` returned, perhaps read from JSON.
            steps: The number of steps of the trace.
            drives: The drives of the trace; empty if they are unknown.

        Raises:
            MapError: A field is wrong.
        """
        record = read.mapping(value, "weighed")
        if not record.get("rivals"):
            raise read.wrong("weighed.rivals", "a list of maps", record.get("rivals"))
        rival = partial(_rival, read, steps)
        found = read.record(
            cls,
            {**record, "searched": record.get("searched") is True},
            "weighed",
            rivals=read.several(rival, "a list of maps"),
            bound=read.number,
            within=read.number,
            broken=read.number,
            excess=read.number,
            doubt=read.maybe(read.text),
            searched=lambda value, _: value,
        )
        if found.excess < 1:
            raise read.wrong("weighed.excess", "a number of at least 1", found.excess)
        return replace(found, drives=drives)


def _told(pair: tuple[int, int, float]) -> tuple[str, str]:
    """Name two steps, and say the probability that they are one, in words."""
    return f"steps {pair[0]} and {pair[1]}", probability_in_words(pair[2])


def probability_in_words(probability: float) -> str:
    """Return a probability with two digits, but never 0 or 1, as nothing is certain."""
    if probability < 0.005:
        return "below 0.01"
    return "above 0.99" if probability >= 0.995 else f"{probability:.2f}"


def _rival(read: FieldReader, steps: int, value: Any, name: str) -> Rival:
    """Read a rival from the field `name`. Raises MapError."""

    def faults(value: Any, name: str) -> tuple[tuple[str, int], ...]:
        if not isinstance(value, list) or not all(
            isinstance(fault, list) and len(fault) == 2 and fault[0] in FAULTS for fault in value
        ):
            raise read.wrong(name, 'a list of faults such as ["jumped", 7]', value)
        return tuple((kind, read.integer(step, name)) for kind, step in value)

    rival = read.record(
        Rival,
        value,
        name,
        dstates=read.integers,
        places=read.integers,
        nats=read.number,
        crowded=read.number,
        faults=faults,
        aliases=read.integers,
        estimated=lambda value, _: bool(value),
    )
    if len(rival.dstates) != steps or len(rival.places) not in (0, steps):
        raise read.wrong(name, f"the dstates and places of {steps} steps", value)
    return rival
