"""Make a short trace that the solver gets instead of old drives: each link of their map once.

Axioms are about links and observations. So each map of this *digest* and a new drive gives a map
of all drives.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from ssh_abduction.data.action import Action
from ssh_abduction.data.groups import first_index_of
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.step import Step
from ssh_abduction.data.trace import Trace


@dataclass(frozen=True)
class Digest:
    """A short trace that the solver gets instead of the old drives.

    Attributes:
        trace: The short trace.
        labels: For each step, its dstate in the existing map.
        kept: For each dstate, the part of the existing map that must be kept; empty if the whole
            map must be kept.
    """

    trace: Trace
    labels: tuple[int, ...]
    kept: Mapping[int, int] = field(default_factory=dict)

    @classmethod
    def of(cls, trace: Trace, ssh_map: SSHMap, *, short: bool) -> Digest:
        """Make a digest of the drives of a map. If it is `short`, each link occurs only once."""
        if not short:
            return cls(trace, ssh_map.dstate_at)
        shown = _observations(trace, ssh_map)
        actions = {action.name: action for action in trace.actions}
        steps: list[Step] = []
        labels: list[int] = []
        for trail in _trails(ssh_map):
            if steps:
                steps[-1] = replace(steps[-1], action=Action(f"standing {len(steps)}", "start"))
            for s, action in trail:
                done = None if action is None else actions[action]
                steps.append(replace(shown[s][0], action=done))
                labels.append(s)
        for s, seen in shown.items():
            for step in seen[1:]:
                steps[-1] = replace(steps[-1], action=Action(f"standing {len(steps)}", "start"))
                steps.append(replace(step, action=None))
                labels.append(s)
        return cls(Trace(tuple(steps), drive="standing"), tuple(labels))

    def must_differ(self, dstate: int, other: int) -> bool:
        """Whether two dstates of the existing map must stay two, and their places as they are."""
        return dstate != other and self.kept.get(dstate) == self.kept.get(other)

    def moved(
        self, pairs: Iterable[tuple[int, int]], labels: Sequence[int]
    ) -> list[tuple[int, int]]:
        """Move pairs of steps of all drives to the trace of this digest and the new drives.

        `labels` has the dstate of each step of the old drives. A pair of such steps at one dstate
        is left out.
        """
        first, shift = first_index_of(self.labels), len(self.labels) - len(labels)
        steps = (
            tuple(first[labels[t]] if t < len(labels) else t + shift for t in pair)
            for pair in pairs
        )
        return [(i, j) for i, j in steps if i != j]

    def labels_of_all(self, found: SSHMap, ssh_map: SSHMap) -> tuple[int, ...]:
        """Return the dstate of each step of all drives in the map `found`."""
        number = dict(zip(self.labels, found.dstate_at, strict=False))
        new = found.dstate_at[len(self.labels) :]
        return (*(number[s] for s in ssh_map.dstate_at), *new)


def _observations(trace: Trace, ssh_map: SSHMap) -> dict[int, list[Step]]:
    """For each dstate, list the different observations made there, those with a view first."""
    shown: dict[int, dict[object, Step]] = {s.id: {} for s in ssh_map.dstates}
    for step, label in zip(trace.steps, ssh_map.dstate_at, strict=True):
        shown[label].setdefault((step.view, step.star), step)
    return {
        s: sorted(
            (Step(view=step.view, star=step.star) for step in seen.values()),
            key=lambda step: step.view is None,
        )
        for s, seen in shown.items()
    }


def _trails(ssh_map: SSHMap) -> list[list[tuple[int, str | None]]]:
    """Cover the links of a map by few trails, so that each link is in one trail.

    A trail has pairs of a dstate and the action that leads to the next dstate, None at the end. A
    dstate without links is a trail of its own.
    """
    leaving: dict[int, list[tuple[str, int]]] = {s.id: [] for s in ssh_map.dstates}
    excess = dict.fromkeys(leaving, 0)
    for s, action, x in sorted(ssh_map.links, reverse=True):
        leaving[s].append((action, x))
        excess[s] += 1
        excess[x] -= 1
    trails: list[list[tuple[int, str | None]]] = []
    # First start trails at dstates that more links leave than reach: a trail must start there.
    for start in sorted(leaving, key=lambda s: -excess[s]):
        while leaving[start]:
            trail: list[tuple[int, str | None]] = []
            here = start
            while leaving[here]:
                action, there = leaving[here].pop()
                trail.append((here, action))
                here = there
            trails.append([*trail, (here, None)])
    visited = {s for trail in trails for s, _ in trail}
    return trails + [[(s, None)] for s in leaving if s not in visited]
