"""The pieces of a hypothesis about several drives, and how they are turned when they are joined.

A *piece* is a part of a hypothesis whose poses are in one frame. Each drive begins a new piece, and
so does each stretch after a lift. If the robot comes to a dstate of another piece, the heading
there fixes the two frames to each other. If the two pieces have only a place in common, this place
is a *hinge*: the new piece can still turn around it. The next place that the two pieces have in
common decides by how much it is turned.

The equations of a hypothesis are linear only near the means (`reckoning.py`). So before two pieces
are joined, the means of one are turned until they agree with the other.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import islice, product
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from ssh_abduction.solver.guesses.reckoning import Hypothesis

Array: TypeAlias = NDArray[np.float64]

# The direction from one position to another is too uncertain to use if they are closer than this
# many metres.
NEAR = 1.0
# Try at most this many ways to turn the pieces with hinges: all ways for two pieces.
TURNS = 16


@dataclass(frozen=True, slots=True)
class Pieces:
    """Which poses of a hypothesis are in one frame. Pieces are named by their first steps.

    Attributes:
        here: The piece that the robot is in.
        of_place: The piece of each place.
        of_heading: The piece of the heading of each dstate.
        hinges: For each piece that has only a place in common with others: this place.
        joins: How pieces were joined: triples of a piece, and the place and dstate of another piece
            that the robot came to. The dstate is None if only the place was known.
    """

    here: int = 0
    of_place: tuple[int, ...] = (0,)
    of_heading: tuple[int, ...] = (0,)
    hinges: Mapping[int, int] = field(default_factory=dict)
    joins: tuple[tuple[int, int, int | None], ...] = ()

    @property
    def is_loose(self) -> bool:
        """Whether the piece that the robot is in is not joined to any other piece yet."""
        return self.here > 0 and all(piece != self.here for piece, _, _ in self.joins)

    def grown(self, place: bool, dstate: bool) -> Pieces:
        """Add a new place, or a new dstate, or both, to the piece of the robot."""
        return replace(
            self,
            of_place=self.of_place + (self.here,) * place,
            of_heading=self.of_heading + (self.here,) * dstate,
        )

    def merged(self, other: int) -> Pieces:
        """Make the piece of the robot a part of another piece."""
        of_place = tuple(other if piece == self.here else piece for piece in self.of_place)
        of_heading = tuple(other if piece == self.here else piece for piece in self.of_heading)
        hinges = {
            piece: place
            for piece, place in self.hinges.items()
            if piece not in (self.here, of_place[place])
        }
        return replace(self, here=other, of_place=of_place, of_heading=of_heading, hinges=hinges)


def fitted(found: Hypothesis, place: int, dstate: int | None = None) -> Hypothesis:
    """Turn the piece of the robot, so that its last pose fits a place or dstate of another piece.

    The last three entries of the means are the pose. Nothing changes if the place is in the piece
    of the robot already. Without a dstate, only the position is fitted: the first place becomes the
    hinge, and the second one decides by how much to turn. Once the piece is turned, it becomes a
    part of the other one.
    """
    pieces = found.pieces
    other = pieces.of_place[place] if dstate is None else pieces.of_heading[dstate]
    if other == pieces.here:
        return found
    joined = replace(pieces, joins=(*pieces.joins, (pieces.here, place, dstate)))
    mean, n = found.mean, len(found.mean) - 3
    hinge = pieces.hinges.get(pieces.here)
    if dstate is not None:
        angle = mean[found.heading[dstate]] - mean[n + 2]
    elif hinge is None:
        return replace(found, pieces=replace(joined, hinges={**pieces.hinges, pieces.here: place}))
    else:
        at = found.position[hinge]
        ways = [mean[[x, x + 1]] - mean[[at, at + 1]] for x in (n, found.position[place])]
        if min(math.hypot(*way) for way in ways) < NEAR:
            return found
        angle = math.atan2(*ways[1][::-1]) - math.atan2(*ways[0][::-1])
    return replace(_turned(found, float(angle)), pieces=joined.merged(other))


def headings_by_turn(found: Hypothesis) -> Iterator[list[float]]:
    """Yield the headings of the dstates in radians, for each way to turn the pieces with hinges.

    At a place with four slots, frames differ by quarter turns. Where only a place joins a piece to
    others, the piece is first turned by up to an eighth, so that its headings there fit the slots.
    Then each quarter turn is possible.
    """
    pieces, facing = found.pieces, found.mean[found.heading]
    for piece, hinge in pieces.hinges.items():
        there = [s for s, place in enumerate(found.places) if place == hinge]
        own = next(s for s in there if pieces.of_heading[s] == piece)
        other = next(s for s in there if pieces.of_heading[s] != piece)
        facing[np.equal(pieces.of_heading, piece)] += math.remainder(
            facing[other] - facing[own], math.pi / 2
        )
    for quarters in islice(product(range(4), repeat=len(pieces.hinges)), TURNS):
        turn = dict(zip(pieces.hinges, quarters, strict=True))
        turns = [turn.get(piece, 0) * math.pi / 2 for piece in pieces.of_heading]
        yield (facing + turns).tolist()


def closed(found: Hypothesis, dstate: int, turn: float) -> Hypothesis:
    """Turn the piece of the robot, and join it to the piece of the earlier dstate of a closure.

    This comes before the update by the closure, which is linear in the heading of the piece and so
    needs a heading that is nearly right. If the dstate is in the piece of the robot, nothing
    changes. `turn` is by how many radians the robot is turned to the left of this dstate.
    """
    pieces, n = found.pieces, len(found.mean) - 3
    other = pieces.of_heading[dstate]
    if other == pieces.here:
        return found
    angle = found.mean[found.heading[dstate]] + turn - found.mean[n + 2]
    joins = (*pieces.joins, (pieces.here, found.places[dstate], dstate))
    return replace(_turned(found, float(angle)), pieces=replace(pieces, joins=joins).merged(other))


def _turned(found: Hypothesis, angle: float) -> Hypothesis:
    """Turn all poses of the robot's piece by radians, about its hinge or else about the robot."""
    n, pieces = len(found.mean) - 3, found.pieces
    hinge = pieces.hinges.get(pieces.here)
    centre = n if hinge is None else found.position[hinge]
    places = zip(found.position, pieces.of_place, strict=True)
    headings = zip(found.heading, pieces.of_heading, strict=True)
    x = np.array([n, *(at for at, piece in places if piece == pieces.here)])
    facing = np.array([n + 2, *(at for at, piece in headings if piece == pieces.here)])
    mean, covariance = poses_turned(found.mean, found.covariance, x, facing, centre, angle)
    return replace(found, mean=mean, covariance=covariance)


def poses_turned(
    mean: Array,
    covariance: Array,
    x: NDArray[np.int_],
    headings: NDArray[np.int_],
    centre: int,
    angle: float,
) -> tuple[Array, Array]:
    """Turn some poses of a Gaussian distribution about one position.

    Args:
        mean: The means.
        covariance: Their covariance.
        x: The indices of the x of the positions to turn. That of y comes next.
        headings: The indices of the headings to turn.
        centre: The index of the x of the position to turn about.
        angle: The angle in radians, counterclockwise.
    """
    cos, sin = math.cos(angle), math.sin(angle)
    mean, covariance = mean.copy(), covariance.copy()
    dx, dy = mean[x] - mean[centre], mean[x + 1] - mean[centre + 1]
    mean[x] += cos * dx - sin * dy - dx
    mean[x + 1] += sin * dx + cos * dy - dy
    mean[headings] += angle
    for half in (covariance, covariance.T):  # the rows, and then the columns
        half[x], half[x + 1] = (
            cos * half[x] - sin * half[x + 1],
            sin * half[x] + cos * half[x + 1],
        )
    return mean, covariance
