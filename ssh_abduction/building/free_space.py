"""Draw the free space along the edges of a plan: what lies between the walls on both sides."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from perception.places.passages import WIDE, directions
from ssh_abduction.building.edges import PlanEdge, walls_beside
from ssh_abduction.building.travels import Array

GRID = 0.1  # metres: a cell in which free space is drawn
# A person keeps BODY metres from walls, where the robot itself did.
BODY = 0.3


def strips_of(edge: PlanEdge, begin: int, stop: int) -> Iterator[Array]:
    """Yield the corners, (4, 2) metres, of the free space between any two points of a course."""
    ahead = directions(edge.course)
    left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
    wide = ndimage.median_filter(edge.widths, (3, 1))
    sides = edge.course + wide[:, [0]] * left, edge.course - wide[:, [1]] * left
    for k in range(begin, stop):
        corners = np.array([sides[0][k], sides[0][k + 1], sides[1][k + 1], sides[1][k]])
        if np.isfinite(corners).all():
            yield corners


def drawn(strips: Sequence[Array], *more: Array) -> tuple[NDArray[np.bool_], Array]:
    """Draw strips: which cells of GRID metres are free, and the position of the first cell.

    There are cells for more points, (n, 2) metres, too.
    """
    from skimage.draw import polygon

    points = np.concatenate([*strips, *more])
    corner = points.min(axis=0) - 2 * GRID
    free = np.zeros(np.ceil((points.max(axis=0) - corner) / GRID).astype(int) + 3, dtype=bool)
    for strip in strips:
        free[polygon(*((strip - corner) / GRID).T, free.shape)] = True
    return free, corner


@dataclass(frozen=True, eq=False)
class RoomSpace:
    """The free space of a room: which cells are free, and the position of the first cell."""

    free: NDArray[np.bool_]
    corner: Array

    def beside(self, course: Array) -> Array:
        """How far the free space reaches left and right of a course, (n, 2) metres."""
        ahead = directions(course)
        left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
        off = np.arange(1, round(2 * WIDE / GRID) + 1)[:, None, None] * GRID * left
        reach = []
        for sign in (1, -1):
            cells = np.rint((course + sign * off - self.corner) / GRID).astype(int)
            inside = np.all((cells >= 0) & (cells < self.free.shape), axis=2)
            x, y = np.where(inside[..., None], cells, 0).transpose(2, 0, 1)
            reach.append(np.logical_and.accumulate(inside & self.free[x, y]).sum(axis=0) * GRID)
        return np.stack(reach, axis=1)


class FreeView:
    """Which points of a route see each other: all that is between them is free."""

    def __init__(self, edges: Sequence[PlanEdge]) -> None:
        strips = [s for edge in edges for s in strips_of(edge, 0, len(edge.course) - 1)]
        course = np.concatenate([edge.course for edge in edges])
        walls = np.concatenate([walls_beside(edge) for edge in edges])
        self._free, self._corner = drawn(strips, course, walls)
        blocked = ~ndimage.binary_erosion(self._free, iterations=round(BODY / GRID))
        blocked |= ndimage.binary_dilation(self._marked(walls), iterations=round(BODY / GRID))
        self._free = ~blocked | ndimage.binary_dilation(self._marked(course), iterations=2)

    def _marked(self, points: Array) -> NDArray[np.bool_]:
        """The cells that have a point."""
        found = np.zeros_like(self._free)
        found[tuple(self._cells(points).T)] = True
        return found

    def _cells(self, points: Array) -> NDArray[np.int64]:
        return np.rint((points - self._corner) / GRID).astype(int)

    def from_point(self, point: Array, others: Array) -> NDArray[np.bool_]:
        """Whether each of the others, (n, 2), is seen from a point."""
        far = float(np.hypot(*(others - point).T).max(initial=GRID))
        share = np.linspace(0, 1, int(np.ceil(far / GRID)) + 1)[:, None, None]
        cells = self._cells(point + share * (others - point))
        return np.asarray(self._free[cells[..., 0], cells[..., 1]].all(axis=0))
