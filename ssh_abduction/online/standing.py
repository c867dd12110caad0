"""How sure a mapper is of its map if faults are allowed, and what may be true."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.online.belief import Belief
from ssh_abduction.online.chances import Chances
from ssh_abduction.online.hypotheses import Rival
from ssh_abduction.online.localiser import Localiser
from ssh_abduction.online.rival_maps import RARE, RivalMaps
from ssh_abduction.theory.theory import Theory

# A map may be certain if it has this probability among its rivals.
CERTAIN = 0.99
# At most this many hypotheses are reported; the last of them stands for all others.
TOLD = 10
# Localisation begins at most this many steps ago.
REPLAYED = 200


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """What may be true.

    Attributes:
        weight: Its probability. The weights of all hypotheses sum to 1.
        map: A map of all steps so far, with its faults; None for all other hypotheses together.
        said: What it ignores since the mapper was last certain, and where the robot is.
    """

    weight: float
    map: SSHMap | None
    said: str

    def __str__(self) -> str:
        return f"{self.weight:.3f}  {self.said}"


@dataclass(frozen=True, slots=True)
class Standing:
    """How sure the mapper is of its map.

    Attributes:
        certain: Whether the first map of the solution is proven minimal, and evidence leaves no
            other from here on. The past need not be certain: two hypotheses may have the same map
            and the robot in the same dstate, and differ in the step that they ignore.
        broke: A sentence for each step at which the best map expected something else, since the
            mapper was last certain. If this step makes it certain again, they are still listed.
        hypotheses: What may be true, the most probable first.
        where: Where the robot is in the first map, or nowhere, by Markov localisation since
            something broke; None if nothing broke.
    """

    certain: bool
    broke: tuple[str, ...]
    hypotheses: tuple[Hypothesis, ...]
    where: Belief | None = None

    def __str__(self) -> str:
        if self.certain:
            return f"certain: {self.hypotheses[0].said}"
        return "; ".join([f"uncertain, most likely: {self.hypotheses[0].said}", *self.broke[-1:]])


def chances_of(theory: Theory) -> Chances:
    """The chances of localisation that correspond to the prices of faults.

    A fault that costs twice as much as another is as rare as two of the other. A kind of fault
    that the theory does not allow counts as twice the price here. Otherwise localisation would
    take every error for the only kind that it knows.
    """
    cheapest = min(price for price in (theory.misread, theory.slipped) if price)
    misread, slipped = (
        RARE ** min(2.0, (price or 2 * cheapest) / cheapest)
        for price in (theory.misread, theory.slipped)
    )
    return Chances(misread=misread, slipped=slipped)


@dataclass(frozen=True, slots=True)
class _Located:
    """A belief in one map after some steps, with the localiser to go on with."""

    map_key: object  # its dstates and links
    localiser: Localiser
    belief: Belief
    steps: int


class Confidence:
    """Says how sure the mapper is, from step to step.

    Args:
        theory: The theory without `auto`, with faults.

    Attributes:
        known: The map that was certain last, or else the best before anything broke.
    """

    def __init__(self, theory: Theory) -> None:
        self.known: SSHMap | None = None
        self._chances = chances_of(theory)
        self._broke: list[tuple[int, str]] = []  # step and sentence, since the map was certain
        self._located: _Located | None = None

    def note(self, step: int, broke: str | None) -> None:
        """Note what broke at a step, if something did."""
        if broke:
            self._broke.append((step, broke))

    def standing(self, maps: RivalMaps, trace: Trace, listed: Sequence[SSHMap]) -> Standing:
        """How sure the mapper is now.

        Args:
            maps: The rivals of the steps so far.
            trace: The steps so far.
            listed: The maps of the solution.
        """
        broke = tuple(sentence for _, sentence in self._broke)
        lead = maps.lead
        if lead is None:
            said = "no map of these steps is known yet"
            if maps.is_impossible:
                said = "no map satisfies the axioms"
            return Standing(False, broke, (Hypothesis(1.0, None, said),))
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

    def _has_recovered(self, where: Belief, lead: Rival, trace: Trace) -> bool:
        """Whether a step was predicted since something broke, and localisation agrees.

        It agrees if it has the robot at the dstate of the best map, more likely than not.
        """
        return (
            self._broke[-1][0] < len(trace) - 1
            and where.likeliest == lead.here
            and where.probability > 0.5
        )

    def _hypotheses(
        self, rivals: Sequence[Rival], shares: Sequence[float]
    ) -> tuple[Hypothesis, ...]:
        """The most probable rivals as hypotheses, and one for all others."""
        order = sorted(range(len(shares)), key=lambda i: -shares[i])
        first = order if len(order) <= TOLD else order[: TOLD - 1]
        told = [Hypothesis(shares[i], rivals[i].explained(), self._said(rivals[i])) for i in first]
        if rest := order[len(first) :]:
            others = f"one of {len(rest)} others"
            told.append(Hypothesis(sum(shares[i] for i in rest), None, others))
        return tuple(told)

    def _said(self, rival: Rival) -> str:
        """What a rival ignores since the mapper was certain, and where the robot is."""
        excused = set(self.known.faults) if self.known else set()
        new = sorted(set(rival.faults) - excused, key=lambda fault: fault.step)
        faults = ", ".join(str(fault) for fault in new) or "nothing else is disbelieved"
        return f"{faults}; the robot is at dstate {rival.here} of {len(rival.shows)}"

    def _locate(self, lead: Rival, trace: Trace) -> Belief:
        """Locate the robot in the best map, from where it was just before something broke."""
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
        self._located = _Located(key, localiser, belief, t)
        return belief


def _is_decided(maps: RivalMaps, rivals: Sequence[Rival], shares: Sequence[float]) -> bool:
    """Whether the minimal maps are all known and agree on the future, with nearly all rivals.

    They may disagree on the past.
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
