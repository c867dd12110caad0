"""Finds closures between two drives: visits of both whose local maps match.

Nothing is known of how the frames of two drives relate. So each pair of visits is matched in all
rotations, and each reliable match says how the frames relate. Places look alike, so a match counts
only if at least VOTES visits of the second drive agree on one relation, and no other relation has
more than half as many.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from perception.places.closures import KEPT, TURN, Closing, is_reliable
from perception.places.importing import Imported
from perception.places.matching import Scene, Turned, match
from perception.places.track import Array, points_turned
from perception.places.visits import patches_of

# Two matches agree if the middle of the visit of one is where the other one says, within NEAR
# metres and DRIFT metres for each metre between the two visits, and if their rotations differ by
# less than TWIST radians.
NEAR, DRIFT, TWIST = 0.7, 0.05, math.radians(10)
VOTES = 3
TURNS = [k * TURN for k in range(round(math.tau / TURN))]


def scenes_of(part: Imported) -> list[Scene]:
    """Prepare the local map of each visit of a drive for matching."""
    patches = patches_of(part.visits)
    return [
        Scene.of(patch, visit.middle) for visit, patch in zip(part.visits, patches, strict=True)
    ]


def closures_between(
    first: Imported, last: Imported, ours: Sequence[Scene], theirs: Sequence[Scene]
) -> list[Closing]:
    """Find the closures between two drives.

    Args:
        first: The earlier drive.
        last: The later drive.
        ours: The scene of each visit of the earlier drive.
        theirs: The scene of each visit of the later drive.

    Returns:
        Closures from visits of the earlier drive to visits of the later one. Empty if too few
        matches agree.
    """
    found: list[Closing] = []
    for j, scene in enumerate(theirs):
        turned = Turned.of(scene, TURNS)
        for i, other in enumerate(ours):
            matched = match(other, turned)
            if matched is not None and is_reliable(matched):
                found.append(Closing(i, j, matched))
    agreed = _largest(found, _relations(found, first, last))
    kept: list[Closing] = []
    for j in range(len(theirs)):
        here = [closing for closing in agreed if closing.last == j]
        kept += sorted(here, key=lambda closing: -closing.match.score)[:KEPT]
    return kept


@dataclass(frozen=True, eq=False)
class _Relations:
    """What n matches say about how two frames relate.

    Attributes:
        turns: (n,) rotation of the later frame, in radians.
        here: (n, 2) middle of the later visit in the earlier frame, in metres.
        there: (n, 2) middle of the later visit in its own frame.
    """

    turns: Array
    here: Array
    there: Array

    def agreeing(self, k: int) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """Mask of the matches that agree with match k."""
        onward = self.there - self.there[k]
        expected = self.here[k] + points_turned(self.turns[k], onward)
        far = np.hypot(*(self.here - expected).T)
        twist = np.abs((self.turns - self.turns[k] + math.pi) % math.tau - math.pi)
        return np.asarray((far < NEAR + DRIFT * np.hypot(*onward.T)) & (twist < TWIST))


def _relations(found: Sequence[Closing], first: Imported, last: Imported) -> _Relations:
    """Collect what matches between the visits of two drives say about their frames."""
    here = [first.visits[one.first].middle + one.match.shift for one in found]
    there = [last.visits[one.last].middle for one in found]
    return _Relations(
        np.array([one.match.turn for one in found]),
        np.array(here).reshape(-1, 2),
        np.array(there).reshape(-1, 2),
    )


def _largest(found: Sequence[Closing], relations: _Relations) -> list[Closing]:
    """Find the relation of the frames on which most matches agree, and list these matches.

    The list is empty if too few visits agree, or if another relation has more than half as many.
    """
    sets = [relations.agreeing(k) for k in range(len(found))]
    visits = np.array([one.last for one in found], int)

    def votes(mask: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> int:
        return len(set(visits[mask].tolist()))

    if not sets:
        return []
    best = max(sets, key=votes)
    rivals = [votes(sets[k]) for k in np.flatnonzero(~best)]
    if votes(best) < VOTES or max(rivals, default=0) > votes(best) / 2:
        return []
    return [found[k] for k in np.flatnonzero(best).tolist()]
