"""Probabilities of errors that the localiser allows for: misread views, slipped actions, …"""

from __future__ import annotations

from dataclasses import dataclass, fields

from ssh_abduction.data.checks import a_number
from ssh_abduction.data.errors import LocaliserError


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
