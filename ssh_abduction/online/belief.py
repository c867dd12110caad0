"""A belief: where a robot may be in a map, and how sure that is."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.data.checks import a_number
from ssh_abduction.data.errors import LocaliserError

# The robot is located if one dstate has this probability.
LOCATED = 0.9
# A belief has collapsed if an observation is so much less probable than at a place of which nothing
# is known: evidence of ten to one against the belief, which Jeffreys calls strong.
COLLAPSED = 0.1
# The share of unknown places that are akin to those of the map, before anything is seen of them.
AKIN = 0.5
# A lost robot is found again if the entropy of its belief is at most this many bits higher than
# before it was lost.
AS_SURE = 0.1
# Smaller probabilities are left out of JSON: of 10,000 dstates nearly all have next to none.
LEAST_TOLD = 0.001
# Keeps logarithms finite.
TINY = np.finfo(float).tiny


class Verdict(Enum):
    """A belief in one word.

    Attributes:
        LOCATED: One dstate has at least the probability LOCATED.
        UNSURE: Several dstates are possible, as when localisation begins.
        LOST: A belief collapsed, and the robot is not found again yet.
        NOWHERE: More likely than not, the robot is at no dstate of the map.
    """

    LOCATED = "located"
    UNSURE = "unsure"
    LOST = "lost"
    NOWHERE = "nowhere"


@dataclass(frozen=True, eq=False, slots=True)
class Observation:
    """What a robot observes, as far as it distinguishes dstates. `localiser.py` has f and q.

    Attributes:
        where: Some dstates.
        ratio: f(o|x) / q(o) of each of these dstates; 0 for all others.
        novel: Probability that the place looks like none of the dstates, given this observation.
            Before it, to look like any dstate or like none was equally likely.
    """

    where: NDArray[np.intp] | slice
    ratio: NDArray[np.float64]
    novel: float


NOVEL = Observation(np.empty(0, np.intp), np.empty(0), 1.0)


@dataclass(frozen=True, eq=False)
class Belief:
    """Where a robot may be, once it has observed something.

    Attributes:
        probabilities: The probability of each dstate, (N,), read-only. With `nowhere` they sum
            to 1.
        nowhere: Probability that the robot is at no dstate of the map.
        normaliser: Probability of the observation by the belief before it, divided by its
            probability at an unknown place: 1 / (α q(o)) of equation 2 of
            `localiser.py`. Below COLLAPSED the belief has collapsed.
        sure: Entropy in bits of the belief before the one that collapsed; None if the robot is not
            lost.
        akin: Probability that places are akin to those of the map, if the robot is nowhere.
        seen: The observation; None if there was none. It says what to expect next among akin
            places.
    """

    probabilities: NDArray[np.float64]
    nowhere: float
    normaliser: float = 1.0
    sure: float | None = None
    akin: float = AKIN
    seen: Observation | None = None

    def __str__(self) -> str:
        dstate = f"dstate {self.likeliest} with probability {self.probability:.3f}"
        verdict, nowhere = self.verdict.value, f"nowhere {self.nowhere:.3f}"
        return f"{verdict}: {dstate}; {nowhere}; entropy {self.entropy:.1f} bits"

    def __repr__(self) -> str:
        return f"<Belief {self}>"

    @cached_property
    def likeliest(self) -> int:
        """The most probable dstate, the first of several. The robot may be likelier nowhere."""
        return int(self.probabilities.argmax())

    @property
    def probability(self) -> float:
        """The probability of the most probable dstate."""
        return float(self.probabilities[self.likeliest])

    @cached_property
    def entropy(self) -> float:
        """The entropy in bits: 0 if the robot is at one dstate, or nowhere, for certain."""
        p = self.probabilities
        inside = p @ np.log2(np.maximum(p, TINY))
        return max(0.0, -float(inside + self.nowhere * np.log2(max(self.nowhere, TINY))))

    @property
    def collapsed(self) -> bool:
        """Whether the observation was far less probable by the belief before it than anywhere.

        Then the earlier belief was wrong.
        """
        return self.normaliser < COLLAPSED

    @property
    def lost(self) -> bool:
        """Whether a belief collapsed, and the robot has not been found since.

        It is found if it is located, or if the belief is as sure as it was before. The second
        matters if nothing that a robot sees and does distinguishes some dstates.
        """
        return self.sure is not None

    @property
    def verdict(self) -> Verdict:
        """The belief in one word."""
        if self.nowhere > 0.5:
            return Verdict.NOWHERE
        if self.probability >= LOCATED:
            return Verdict.LOCATED
        return Verdict.LOST if self.lost else Verdict.UNSURE

    @property
    def dstate(self) -> int | None:
        """The dstate that the robot most probably is at; None for nowhere in the map."""
        return None if self.verdict is Verdict.NOWHERE else self.likeliest

    def found_again(self, sure: float) -> bool:
        """Whether a robot that was lost is found again.

        Args:
            sure: Entropy in bits of the belief before it was lost.
        """
        a_number("sure", sure, LocaliserError, 0, what="bits of entropy")
        return self.nowhere <= 0.5 and (
            self.probability >= LOCATED or self.entropy <= sure + AS_SURE
        )

    def above(self, least: float) -> tuple[tuple[int, float], ...]:
        """The dstates of at least this probability, with it, the most probable first."""
        a_number("least", least, LocaliserError, 0, 1, what="a probability")
        found = np.flatnonzero(self.probabilities >= least)
        found = found[np.argsort(-self.probabilities[found], kind="stable")]
        return tuple((int(s), float(self.probabilities[s])) for s in found)

    def to_dict(self) -> dict[str, Any]:
        """The belief as `localise --json` prints it (docs/reference/formats.md)."""
        return {
            "verdict": self.verdict.value,
            "dstate": self.dstate,
            "probability": _rounded(self.probability),
            "nowhere": _rounded(self.nowhere),
            "entropy": _rounded(self.entropy),
            "normaliser": _rounded(self.normaliser),
            "collapsed": self.collapsed,
            "lost": self.lost,
            "probabilities": [[s, _rounded(p)] for s, p in self.above(LEAST_TOLD)],
        }


def _rounded(value: float) -> float:
    """Round to six significant digits, as more of them say nothing."""
    return float(f"{value:.6g}")
