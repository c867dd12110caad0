"""Probabilities that what a map says does not hold."""

from __future__ import annotations

from dataclasses import dataclass, fields

from ssh_abduction.data.errors import LocaliserError, brief, is_finite


@dataclass(frozen=True, slots=True)
class Chances:
    """How likely it is, at each step, that what a map says does not hold.

    Faults are taken to be rare: one step in a hundred, as in openFABMAP, which leaves
    0.01 (1 - sFactor) to what its model does not say. 0.1 is RTAB-Map's default (Labbé and Michaud
    2013) for a robot that comes to a place that it does not know (Bayes/PredictionLC), and for one
    that comes back (1 - Bayes/VirtualPlacePriorThr).

    Attributes:
        misread: Probability that the observation is not of the dstate that the robot is at: a
            person stands in front of the laser, or a cluster is wrong.
        slipped: Probability that the action does not lead where the link says: it failed, or the
            robot was kidnapped.
        unmapped: Probability that a robot of which nothing is known is at no dstate of the map.
            It also holds for the end of an action without a link in the map.
        reentered: Probability that a robot at no dstate of the map is at one after its next action.
    """

    misread: float = 0.01
    slipped: float = 0.01
    unmapped: float = 0.1
    reentered: float = 0.1

    def __post_init__(self) -> None:
        for chance in fields(self):
            value = getattr(self, chance.name)
            if not is_finite(value) or not 0 <= value <= 1:
                raise LocaliserError(
                    f"{chance.name}: expected a probability from 0 to 1, got {brief(value)}; "
                    "take 0 for what never happens"
                )

    @classmethod
    def none(cls) -> Chances:
        """The map holds without exception (equation 4 of `localiser.py`).

        An observation that the map does not allow then restarts localisation.
        """
        return cls(misread=0.0, slipped=0.0, unmapped=0.0, reentered=1.0)
