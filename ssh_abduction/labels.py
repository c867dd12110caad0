"""The labels that maps give to the steps of a trace, for a recogniser to learn from."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.errors import SSHError
from ssh_abduction.maps import SSHMap


class LearnerError(SSHError):
    """The loop cannot be closed: there is no map, or the maps agree on no label."""


class AmbiguousMapWarning(UserWarning):
    """Several minimal maps remain, and only the labels that they agree on are learnt from; or the map is not proven minimal."""


def labels_of(maps: Sequence[SSHMap], choose: int | None = None, complete: bool = True, proven: bool = True) -> NDArray[np.intp]:
    """The label of each step, (n,): its dstate in the chosen map; or, if none is chosen, in the first map, and -1 where the maps disagree.

    Maps agree on a step if the first step at its dstate is the same in all of them. Warns if no map is chosen and they do not agree
    everywhere, if there may be more (`complete` is false), or if they are not `proven` minimal. Raises LearnerError where no map or no label is left.
    """
    if not maps:
        raise LearnerError("maps: expected at least one to take labels from, got none; see the solution's status")
    if choose is not None and not 0 <= choose < len(maps):
        raise LearnerError(f"map: expected an index from 0 to {len(maps) - 1}, got {choose}")
    labels = np.array(maps[choose or 0].labels, np.intp)
    if choose is not None:
        return labels
    for i, ssh_map in enumerate(maps):
        if len(ssh_map.labels) != len(labels):
            raise LearnerError(
                f"maps: expected maps of one trace, {len(labels)} labels each, got {len(ssh_map.labels)} in map {i + 1}; solve one trace"
            )
    first = [_first_steps(ssh_map) for ssh_map in maps]
    agreed = np.all([f == first[0] for f in first], axis=0)
    if not proven:
        unsure = f"the map of {len(maps[0].dstates)} dstates is the best that was found, and not proven minimal"
        warnings.warn(f"{unsure}: its labels may be wrong; give more time, or look for bad views", AmbiguousMapWarning, stacklevel=2)
    elif not agreed.all() or not complete:
        told = f"{'' if complete else 'at least '}{len(maps)} minimal map{'' if len(maps) == 1 else 's'}"
        unsure = f"{told} remain{'s' if len(maps) == 1 else ''}, and agree on {agreed.sum()} of {len(agreed)} labels"
        warnings.warn(f"{unsure}: only these are learnt from; choose a map, or explore more", AmbiguousMapWarning, stacklevel=2)
    if not agreed.any():
        raise LearnerError("labels: expected some that all maps agree on, got none; choose a map")
    return np.where(agreed, labels, -1)


def _first_steps(ssh_map: SSHMap) -> NDArray[np.intp]:
    """For each step, (n,), the first step at its dstate."""
    _, first, dstates = np.unique(ssh_map.labels, return_index=True, return_inverse=True)
    return np.asarray(first[dstates], np.intp)
