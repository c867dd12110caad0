"""Estimate what dstates show and where actions lead: equations 3 and 4 of `localiser.py`.

A dstate (distinctive state) is a place and the direction that the robot faces there.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace, View
from ssh_abduction.online.belief import Observation


@dataclass(frozen=True)
class Links:
    """Where one action a leads from each of the N dstates.

    Attributes:
        leads: The probabilities p(x'|x,a), (N, N). Row x' is the end, column x the start. The
            column of a dstate sums to 1, or is 0 if it is unknown where a leads from there.
        missing: 1 for each dstate from which it is unknown where a leads, else 0, (N,).
    """

    leads: sparse.csr_array
    missing: NDArray[np.float64]


def view_ratios(ssh_map: SSHMap, trace: Trace | None) -> dict[View, Observation]:
    """For each view v, find the dstates x that show it, and the ratios f(v|x) / q(v).

    Args:
        ssh_map: The map. It says what a dstate shows if no step of the trace is at this dstate
            (equation 4).
        trace: The trace that was mapped, to estimate f by counting (equation 3); None takes all
            views from the map.

    Returns:
        The observation for each view. A view that no dstate shows is missing.
    """
    # Count the steps at each dstate that show each view.
    counts = Counter[tuple[int, View]]()
    if trace is not None:
        counts.update(
            (x, step.view)
            for x, step in zip(ssh_map.labels, trace, strict=True)
            if step.view is not None
        )
    seen = {x for x, _ in counts}
    counts.update(
        (s.id, s.view) for s in ssh_map.dstates if s.id not in seen and s.view is not None
    )
    visits = Counter[int]()
    for (x, _), n in counts.items():
        visits[x] += n
    shown: dict[View, list[tuple[int, float]]] = {}
    for (x, view), n in sorted(counts.items(), key=lambda item: item[0][0]):
        shown.setdefault(view, []).append((x, n / visits[x]))
    number = len(ssh_map.dstates)
    ratios: dict[View, Observation] = {}
    for view, pairs in shown.items():
        f = np.array([p for _, p in pairs])
        ratios[view] = Observation(
            np.array([x for x, _ in pairs], np.intp), f * ((number + 1) / f.sum()), 0.0
        )
    return ratios


def transitions(ssh_map: SSHMap, trace: Trace | None) -> dict[str, Links]:
    """Find where each action leads, by its name.

    Args:
        ssh_map: The map. Its links say where an action leads from a dstate if the trace does not
            have that action there (equation 4).
        trace: The trace that was mapped, to estimate probabilities by counting (equation 3); None
            takes all links from the map.
    """
    # Count how often each action led from one dstate to another.
    counts = Counter[tuple[int, str, int]]()
    labels = ssh_map.labels
    if trace is not None:
        counts.update(
            (x, action.name, y)
            for x, action, y in zip(labels, trace.actions, labels[1:], strict=False)
            if not action.starts
        )
    tried = {(x, action) for x, action, _ in counts}
    counts.update({link for link in ssh_map.links if link[:2] not in tried})
    trials = Counter[tuple[int, str]]()
    for (x, action, _), n in counts.items():
        trials[x, action] += n
    entries: dict[str, list[tuple[int, int, float]]] = {}
    for (x, action, y), n in counts.items():
        entries.setdefault(action, []).append((x, y, n / trials[x, action]))
    number = len(ssh_map.dstates)
    links: dict[str, Links] = {}
    for action, listed in entries.items():
        sources, targets, p = (np.array(column) for column in zip(*listed, strict=True))
        missing = np.ones(number)
        missing[sources] = 0.0
        links[action] = Links(
            sparse.csr_array((p, (targets, sources)), shape=(number, number)),
            missing,
        )
    return links
