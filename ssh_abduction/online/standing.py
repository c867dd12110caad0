"""Say how sure a mapper is of its map if faults are allowed, and which explanations are possible.

A fault is a step that a map treats as wrong: a misread view, or an action that slipped.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.online.belief import Belief
from ssh_abduction.online.chances import Chances
from ssh_abduction.online.hypotheses import ExtendedMap
from ssh_abduction.online.localiser import Localiser
from ssh_abduction.online.rival_maps import RARE, RivalMaps
from ssh_abduction.theory.theory import Theory

# A map can be certain only if it has at least this probability among its rivals.
CERTAIN = 0.99
# At most this many hypotheses are reported. If there are more, the last one is for all others.
LISTED = 10
# Localisation begins at most this many steps before the last one.
REPLAYED = 200


@dataclass(frozen=True, slots=True)
class PossibleMap:
    """One possible explanation of the steps so far, with its probability.

    Attributes:
        weight: The probability. The weights of all hypotheses sum to 1.
        map: A map of all steps so far, with its faults; None if this entry is for all remaining
            hypotheses together, or if no map is known.
        said: Text that names the new faults since the mapper was last certain, and the dstate where
            the robot is.
    """

    weight: float
    map: SSHMap | None
    said: str

    def __str__(self) -> str:
        return f"{self.weight:.3f}  {self.said}"


@dataclass(frozen=True, slots=True)
class Standing:
    """How sure the mapper is of its map, and which explanations are possible.

    Attributes:
        certain: Whether the first map of the solution is proven minimal, and nearly all hypotheses
            predict the same from here on. They may still differ in the past: which step to treat as
            wrong.
        broke: A sentence for each step that contradicted the best map since the mapper was last
            certain. They are still listed at the step at which the mapper becomes certain again.
        hypotheses: The possible explanations, the most probable first.
        where: The belief about where the robot is in the first map, by Markov localisation that
            begins just before the first step in `broke`; None if `broke` is empty.
    """

    certain: bool
    broke: tuple[str, ...]
    hypotheses: tuple[PossibleMap, ...]
    where: Belief | None = None

    def __str__(self) -> str:
        if self.certain:
            return f"certain: {self.hypotheses[0].said}"
        return "; ".join([f"uncertain, most likely: {self.hypotheses[0].said}", *self.broke[-1:]])


def chances_of(theory: Theory) -> Chances:
    """Convert the prices of faults in a theory to probabilities for localisation.

    A fault that costs twice as much as another kind is as rare as two faults of that kind. If the
    theory allows only one kind of fault, the other kind gets twice its price. Otherwise
    localisation would explain every error by the one kind that is allowed.
    """
    cheapest = min(price for price in (theory.misread, theory.slipped) if price)
    misread, slipped = (
        RARE ** min(2.0, (price or 2 * cheapest) / cheapest)
        for price in (theory.misread, theory.slipped)
    )
    return Chances(misread=misread, slipped=slipped)


@dataclass(frozen=True, slots=True)
class _LocatedBelief:
    """The belief in a map after the first steps, and the localiser that continues it."""

    map_key: object
    localiser: Localiser
    belief: Belief
    steps: int


class Confidence:
    """Computes how sure the mapper is after each step, for a theory that allows faults."""

    def __init__(self, theory: Theory) -> None:
        # The last map that was certain. If none was certain yet, the best map of the first answer.
        self.known: SSHMap | None = None
        self._chances = chances_of(theory)
        self._broke: list[tuple[int, str]] = []  # step and sentence, since the map was certain
        self._located: _LocatedBelief | None = None

    def note(self, step: int, broke: str | None) -> None:
        """Record that a step contradicted the best map, if `broke` has a sentence on it."""
        if broke:
            self._broke.append((step, broke))

    def standing(self, maps: RivalMaps, trace: Trace, listed: Sequence[SSHMap]) -> Standing:
        """Compute how sure the mapper is now, by the rivals and the maps listed, best first."""
        broke = tuple(sentence for _, sentence in self._broke)
        lead = maps.lead
        if lead is None:
            said = "no map of these steps is known yet"
            if maps.is_impossible:
                said = "no map satisfies the axioms"
            return Standing(False, broke, (PossibleMap(1.0, None, said),))
        rivals, shares = maps.undecided()
        where = self._locate(lead, trace) if self._broke else None
        certain = _is_decided(maps, rivals, shares) and (
            where is None or self._has_recovered(where, lead, trace)
        )
        standing = Standing(certain, broke, self._hypotheses(rivals, shares), where)
        # From here on only later faults are reported.
        if certain:
            self.known, self._located = listed[0], None
            self._broke.clear()
        return standing

    def _has_recovered(self, where: Belief, lead: ExtendedMap, trace: Trace) -> bool:
        """Whether the mapper has recovered from the last step that contradicted the best map.

        This needs a later step, and localisation has to agree with the best map: it gives more than
        half of the probability to the dstate where this map has the robot.
        """
        is_later = self._broke[-1][0] < len(trace) - 1
        return is_later and where.likeliest == lead.here and where.probability > 0.5

    def _hypotheses(
        self, rivals: Sequence[ExtendedMap], shares: Sequence[float]
    ) -> tuple[PossibleMap, ...]:
        """Make hypotheses from the most probable rivals, and one from all others together."""
        order = sorted(range(len(shares)), key=lambda i: -shares[i])
        first = order if len(order) <= LISTED else order[: LISTED - 1]
        listed = [
            PossibleMap(shares[i], rivals[i].explained(), self._said(rivals[i])) for i in first
        ]
        if rest := order[len(first) :]:
            others = "the one other" if len(rest) == 1 else f"one of {len(rest)} others"
            listed.append(PossibleMap(sum(shares[i] for i in rest), None, others))
        return tuple(listed)

    def _said(self, rival: ExtendedMap) -> str:
        """Describe a rival: its new faults since the mapper was certain, and the robot's dstate."""
        excused = set(self.known.faults) if self.known else set()
        new = sorted(set(rival.faults) - excused, key=lambda fault: fault.step)
        faults = ", ".join(str(fault) for fault in new) or "nothing new is taken as wrong"
        return f"{faults}; the robot is at dstate {rival.here} of {len(rival.shows)}"

    def _locate(self, lead: ExtendedMap, trace: Trace) -> Belief:
        """Locate the robot in the best map.

        Begin where this map has the robot just before the first step that contradicted the best
        map since the mapper was certain, but at most REPLAYED steps back.
        """
        t = len(trace) - 1
        key = (lead.shows, frozenset(lead.links.items()))
        if self._located is not None and self._located.map_key == key:
            localiser, belief = self._located.localiser, self._located.belief
            after = self._located.steps
        else:  # another map than at the last step
            localiser = Localiser(lead.explained(), chances=self._chances)
            after = max(self._broke[0][0] - 1, t - REPLAYED, 0)
            there = np.zeros(len(lead.shows))
            there[lead.labels[after]] = 1.0
            belief = Belief(there, 0.0)
        for i in range(after, t):
            done = trace.steps[i].action
            assert done
            belief = localiser.update(belief, done, trace.steps[i + 1].view)
        self._located = _LocatedBelief(key, localiser, belief, t)
        return belief


def _is_decided(maps: RivalMaps, rivals: Sequence[ExtendedMap], shares: Sequence[float]) -> bool:
    """Whether the future is decided, whatever the past.

    All minimal maps must be known and predict the same from here on. Rivals that predict this too
    must have at least the probability CERTAIN, together with the minimal maps.
    """
    if not maps.is_complete:
        return False
    future = maps.rivals[0].future()
    if any(rival.future() != future for rival in maps.minimal[1:]):
        return False
    agreeing = sum(
        share
        for rival, share in zip(rivals, shares, strict=True)
        if maps.is_minimal(rival) or rival.future() == future
    )
    return agreeing >= CERTAIN
