"""A belief: the probabilities that a robot is at each dstate of a map, or at none of them.

A dstate (distinctive state) is a place and the direction that the robot faces there.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from enum import Enum
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.data.checks import a_number
from ssh_abduction.data.errors import LocaliserError
from ssh_abduction.online.estimates import Away, Observation

# The robot is located if one dstate has at least this probability.
LOCATED = 0.9
# A belief has collapsed if by this belief the observation is less than this many times as probable
# as at an unknown place. This is evidence of ten to one, which Jeffreys calls strong.
COLLAPSED = 0.1
# The probability that unknown places are akin to those of the map, before anything is seen there.
AKIN = 0.5
# A lost robot is found again if the entropy of its belief is at most this many bits higher than
# before it was lost.
AS_SURE = 0.1
# Smaller probabilities are left out of JSON, as nearly all of 10,000 dstates have about 0.
LEAST_LISTED = 0.001
# Keeps logarithms finite.
TINY = np.finfo(float).tiny


class BeliefVerdict(Enum):
    """A belief summed up in one word.

    If several words apply, NOWHERE is preferred to LOCATED, and LOCATED to LOST.
    """

    LOCATED = "located"  # one dstate has at least a probability of 0.9
    UNSURE = "unsure"  # no dstate is that probable, as when localisation begins
    # An observation was very improbable by an earlier belief, and the robot has not been found
    # again since.
    LOST = "lost"
    NOWHERE = "nowhere"  # the robot is at no dstate of the map, with a probability above 0.5


@dataclass(frozen=True, eq=False)
class Belief:
    """The probabilities that a robot is at each dstate of a map, or nowhere in it.

    Attributes:
        probabilities: The probability of each dstate by id, of shape (N,), read-only. Together with
            `nowhere` they sum to 1.
        nowhere: Probability that the robot is at no dstate of the map.
        normaliser: Probability of the last observation by the belief before it, divided by its
            probability at an unknown place: 1 / (α q(o)) of equation 2 in `localiser.py`. Below 0.1
            the belief has collapsed.
        sure: Entropy in bits of the last belief before the collapse; None if the robot is not lost.
        akin: If the robot is nowhere, the probability that the places there are *akin* to the map:
            views follow each other there as in the map (`localiser.py`).
        seen: The last observation; None if there was none.
        away: The parts of `nowhere` for which dead reckoning knows how the robot moved since it was
            at a dstate. There are such parts if the map has poses and the robot has odometry.
    """

    probabilities: NDArray[np.float64]
    nowhere: float
    normaliser: float = 1.0
    sure: float | None = None
    akin: float = AKIN
    seen: Observation | None = None
    away: tuple[Away, ...] = ()

    def __str__(self) -> str:
        dstate = f"dstate {self.likeliest} with probability {self.probability:.3f}"
        verdict, nowhere = self.verdict.value, f"nowhere {self.nowhere:.3f}"
        return f"{verdict}: {dstate}; {nowhere}; entropy {self.entropy:.1f} bits"

    def __repr__(self) -> str:
        return f"<Belief {self}>"

    @cached_property
    def likeliest(self) -> int:
        """The id of the most probable dstate, even if `nowhere` is more probable."""
        return int(self.probabilities.argmax())

    @property
    def probability(self) -> float:
        """The probability of the most probable dstate."""
        return float(self.probabilities[self.likeliest])

    @cached_property
    def entropy(self) -> float:
        """The entropy in bits. It is 0 if one dstate, or `nowhere`, has the probability 1."""
        p = self.probabilities
        inside = p @ np.log2(np.maximum(p, TINY))
        return max(0.0, -float(inside + self.nowhere * np.log2(max(self.nowhere, TINY))))

    @property
    def collapsed(self) -> bool:
        """Whether `normaliser` is below 0.1: the observation shows that the last belief was wrong.

        The observation is then more than ten times as probable at an unknown place as by that
        belief.
        """
        return bool(self.normaliser < COLLAPSED)  # numpy's bool is not one of JSON

    @property
    def lost(self) -> bool:
        """Whether a belief collapsed (see `collapsed`) and the robot was not found again since.

        The robot is found again if one dstate has a probability of at least 0.9, or if the entropy
        is about as low as before the collapse. The second condition is for maps with dstates that
        no observation distinguishes.
        """
        return self.sure is not None

    @property
    def verdict(self) -> BeliefVerdict:
        """The belief summed up in one word: located, unsure, lost or nowhere."""
        if self.nowhere > 0.5:
            return BeliefVerdict.NOWHERE
        if self.probability >= LOCATED:
            return BeliefVerdict.LOCATED
        return BeliefVerdict.LOST if self.lost else BeliefVerdict.UNSURE

    @property
    def dstate(self) -> int | None:
        """The id of the most probable dstate; None if `nowhere` is above 0.5."""
        return None if self.verdict is BeliefVerdict.NOWHERE else self.likeliest

    def found_again(self, sure: float) -> bool:
        """Whether this belief finds a lost robot again. See `lost` for the conditions.

        Args:
            sure: Entropy in bits of the last belief before the collapse.

        Raises:
            LocaliserError: `sure` is negative or no number.
        """
        a_number("sure", sure, LocaliserError, 0, what="bits of entropy")
        return self.nowhere <= 0.5 and (
            self.probability >= LOCATED or self.entropy <= sure + AS_SURE
        )

    def above(self, least: float) -> tuple[tuple[int, float], ...]:
        """List pairs (dstate, probability), the most probable first.

        Args:
            least: Leave out dstates with a smaller probability.

        Raises:
            LocaliserError: `least` is no probability.
        """
        a_number("least", least, LocaliserError, 0, 1, what="a probability")
        found = np.flatnonzero(self.probabilities >= least)
        found = found[np.argsort(-self.probabilities[found], kind="stable")]
        return tuple((int(s), float(self.probabilities[s])) for s in found)

    def to_dict(self) -> dict[str, Any]:
        """Return the belief as a dict for JSON, as `localise --json` prints it.

        The keys are names of attributes; docs/reference/formats.md has the exceptions.
        """
        return {
            "verdict": self.verdict.value,
            "dstate": self.dstate,
            "probability": _rounded(self.probability),
            "nowhere": _rounded(self.nowhere),
            "entropy": _rounded(self.entropy),
            "normaliser": _rounded(self.normaliser),
            "collapsed": self.collapsed,
            "lost": self.lost,
            "probabilities": [[s, _rounded(p)] for s, p in self.above(LEAST_LISTED)],
        }


def _rounded(value: float) -> float:
    """Round to six significant digits."""
    return float(f"{value:.6g}")


@dataclass(frozen=True, slots=True)
class Chances:
    """The probabilities, for each step, that the robot and the map disagree.

    The defaults are those of other localisers. `misread` and `slipped` are 0.01, as openFABMAP
    leaves 0.01 (1 - sFactor) to what its model does not explain. `unmapped` and `reentered` are
    0.1, as in RTAB-Map (Labbé and Michaud 2013): Bayes/PredictionLC for a robot that comes to an
    unknown place, and 1 - Bayes/VirtualPlacePriorThr for a robot that comes back.

    Attributes:
        misread: Probability that the observation does not fit the dstate where the robot is. For
            example, a person stands in front of the laser, or an image got the wrong view.
        slipped: Probability that the action does not lead where the link of the map says: it
            failed, or the robot was kidnapped.
        unmapped: Probability that the robot is at no dstate of the map if its position is unknown:
            at the start, after a slip, and after an action that has no link.
        reentered: Probability that a robot at no dstate of the map is at one after its next action.
    """

    misread: float = 0.01
    slipped: float = 0.01
    unmapped: float = 0.1
    reentered: float = 0.1

    def __post_init__(self) -> None:
        for chance in fields(self):
            value, mend = getattr(self, chance.name), "take 0 for what never happens"
            a_number(chance.name, value, LocaliserError, 0, 1, what="a probability", mend=mend)

    @classmethod
    def none(cls) -> Chances:
        """Make chances for a map that holds without exception (equation 4 of `localiser.py`).

        Localisation then restarts at an observation that the map does not allow.
        """
        return cls(misread=0.0, slipped=0.0, unmapped=0.0, reentered=1.0)
