"""Label each step of a trace with its dstate in a map, so that a recogniser can learn.

A dstate (distinctive state) is a place and the direction that the robot faces there.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from sklearn.neighbors import NearestNeighbors

from perception.confidence import NOISE
from ssh_abduction.data.checks import a_whole_number
from ssh_abduction.data.drives import Drive, drives_of, joined_drives, pieces_in_words
from ssh_abduction.data.errors import AbductionError
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.data.words import counted
from ssh_abduction.learning.traces import Traces
from ssh_abduction.solver import Solution, Status


class LearnerError(AbductionError, ValueError):
    """The learner has nothing to learn from or to score by, or `fit` was not called yet.

    For example, there is no map, or the maps agree on no label.
    """


class AmbiguousMapWarning(UserWarning):
    """The labels may be wrong or incomplete.

    The reason is one of these: several minimal maps remain, the map is not proven minimal, or it
    is in pieces that share no place.
    """


def labels_of(
    maps: Sequence[SSHMap], choose: int | None = None, complete: bool = True, proven: bool = True
) -> NDArray[np.intp]:
    """Label each step with the id of its dstate, (n,).

    With `choose`, labels come from that map. Without it, they are the ids of the first map, and
    -1 for each step on which the maps disagree. Maps agree on a step if the first step at the
    dstate of this step is the same in all maps.

    Without `choose`, issue an AmbiguousMapWarning if the maps disagree on a step, if `complete` is
    false, or if `proven` is false.

    Args:
        maps: The minimal maps of one trace.
        choose: Index of the map to take, from 0; None takes the labels on which all maps agree.
        complete: Whether `maps` are all minimal maps.
        proven: Whether `maps` are proven minimal.

    Raises:
        LearnerError: There is no map, `choose` is no index of a map, the maps have different
            numbers of steps, or they agree on no label.
    """
    if not maps:
        raise LearnerError(
            "maps: expected at least one to take labels from, got none; see the solution's status"
        )
    if choose is not None:
        mend = "give the index of a map of the solution"
        a_whole_number("map", choose, LearnerError, 0, len(maps) - 1, what="an index", mend=mend)
    labels = np.array(maps[choose or 0].dstate_at, np.intp)
    if choose is not None:
        return labels
    for i, ssh_map in enumerate(maps):
        if len(ssh_map.dstate_at) != len(labels):
            raise LearnerError(
                f"maps: expected maps of one trace, {len(labels)} labels each, "
                f"got {len(ssh_map.dstate_at)} in map {i + 1}; solve one trace"
            )
    # Maps number their dstates differently. So compare dstates by the first step at each.
    first = [_first_steps(ssh_map) for ssh_map in maps]
    agreed = np.all([f == first[0] for f in first], axis=0)
    if not proven:
        warnings.warn(
            f"the map of {len(maps[0].dstates)} dstates is the best that was found, and not proven "
            "minimal: its labels may be wrong; give more time, or look for bad views",
            AmbiguousMapWarning,
            stacklevel=2,
        )
    elif not agreed.all() or not complete:
        one = len(maps) == 1
        number = f"{'' if complete else 'at least '}{counted(len(maps), 'minimal maps')}"
        warnings.warn(
            f"{number} remain{'s' if one else ''}, and agree on {agreed.sum()} of {len(agreed)} "
            "labels: only these are learnt from; choose a map, or explore more",
            AmbiguousMapWarning,
            stacklevel=2,
        )
    if not agreed.any():
        raise LearnerError(
            "labels: expected labels on which all maps agree, got none; choose a map"
        )
    return np.where(agreed, labels, -1)


def map_of(
    solution: Solution, vectors: NDArray[np.float64], choose: int | None = None
) -> tuple[SSHMap, NDArray[np.intp]]:
    """Return the map to learn from, and the labels of its n steps, (n,), as `labels_of` makes them.

    `vectors` has the vector of each image, (n, d). Views say little about how drives relate. So
    if there are several joint maps, only those that fit the images best are kept.
    """
    maps: Sequence[SSHMap] = solution.maps
    if choose is None and len(maps) > 1 and len(solution.drives) > 1:
        maps = fitting_best(maps, solution.drives, vectors)
    labels = labels_of(maps, choose, solution.complete, solution.status is Status.OPTIMAL)
    return maps[choose or 0], labels


def fitting_best(
    maps: Sequence[SSHMap], drives: Sequence[Drive], vectors: NDArray[np.float64]
) -> list[SSHMap]:
    """Choose the joint maps that put most images at the same dstate as their most similar image.

    The most similar image is one of another drive. `vectors` has the vector of each image, (n, d).
    """
    nearest = np.zeros(len(vectors), np.intp)
    steps = np.arange(len(vectors))
    for drive in drives:
        own = (steps >= drive.first) & (steps < drive.stop)
        found = NearestNeighbors(n_neighbors=1).fit(vectors[~own]).kneighbors(vectors[own])[1]
        nearest[own] = steps[~own][found[:, 0]]
    labels = np.array([ssh_map.dstate_at for ssh_map in maps])
    fits = (labels == labels[:, nearest]).sum(axis=1)
    return [ssh_map for ssh_map, count in zip(maps, fits, strict=True) if count == fits.max()]


def warn_of_pieces(trace: Trace, ssh_map: SSHMap) -> None:
    """Issue an AmbiguousMapWarning if a map leaves drives of a trace in pieces.

    Then one dstate may have two labels: one in each piece.
    """
    drives = drives_of(trace)
    if len(joined_drives(drives, ssh_map)) > 1:
        warnings.warn(
            f"{pieces_in_words(drives, ssh_map)}: a dstate that is in several pieces gets several "
            "labels; let each drive pass places of another drive",
            AmbiguousMapWarning,
            stacklevel=3,
        )


def labels_on(
    ssh_map: SSHMap, traces: Traces, views: NDArray[np.intp], looks: NDArray[np.intp]
) -> NDArray[np.intp]:
    """Follow traces on a map. Return the dstate of each step, (n,), or -1 if it is unknown.

    `views` has the number of the view of each step, (n,), or -1, and `looks` the dstate that
    its image looks like. A dstate that no image looks like counts as unknown.
    """
    parts = zip(traces.each, traces.parts(views), traces.parts(looks), strict=True)
    found = np.concatenate(
        [_followed(ssh_map, trace, seen.tolist(), like) for trace, seen, like in parts]
    )
    return np.where(np.isin(found, looks), found, -1)


def _followed(
    ssh_map: SSHMap, trace: Trace, views: Sequence[int], looks: NDArray[np.intp]
) -> NDArray[np.intp]:
    """Follow a trace that may begin at any dstate. Return the dstate of each step, (m,).

    `views` and `looks` are as in `labels_on`. Try each dstate as the first one. Drop the dstates
    that a later view contradicts. Take the dstate for which most images look like their dstates.
    After an action for which the map has no link, dstates are unknown (-1) and contradict no view.
    All steps get -1 if two first dstates fit equally many images, or if the best one fits fewer
    than half of the steps with a known dstate.
    """
    leads = {(here, action): there for here, action, there in ssh_map.links}
    ways = []
    for start in range(len(ssh_map.dstates)):
        way: list[int] = []
        at: int | None = start
        for step, view in enumerate(views):
            if at is not None and view not in (NOISE, ssh_map.dstates[at].view):
                break
            way.append(-1 if at is None else at)
            if step < len(trace.actions):
                at = None if at is None else leads.get((at, trace.actions[step].name))
        else:
            ways.append(np.array(way, np.intp))
    # Take the way that fits most images, unless there is a tie.
    ways.sort(key=lambda way: -np.count_nonzero(way == looks))
    fits = [np.count_nonzero(way == looks) for way in ways[:2]]
    sure = (
        fits
        and fits[0] >= np.count_nonzero(ways[0] >= 0) / 2
        and fits[0] > max(fits[1:], default=0)
    )
    return ways[0] if sure else np.full(len(views), -1, np.intp)


def _first_steps(ssh_map: SSHMap) -> NDArray[np.intp]:
    """For each step, find the first step that is at the same dstate, (n,)."""
    _, first, dstates = np.unique(ssh_map.dstate_at, return_index=True, return_inverse=True)
    return np.asarray(first[dstates], np.intp)
