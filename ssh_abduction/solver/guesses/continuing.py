"""Localise the steps of a long trace in a map of its first steps, and add links that it lacks.

>>> from ssh_abduction import Theory, Trace
>>> from ssh_abduction.solver.guesses.continuing import labels_continued
>>> from ssh_abduction.solver.steps.log import Log
>>> actions = ["go"] * 6 + ["back"] + ["go"] * 11
>>> trace = Trace.from_steps("abcabca" + "cab" * 4, actions)
>>> labels_continued(Log(trace, Theory.causal()), [0, 1, 2, 0])
[0, 1, 2, 0, 1, 2, 0, 2, 0, 1, 2, 0, 1, 2, 0, 1, 2, 0, 1]

A *walk* follows the trace along the links of the map. If an action has no link, it must lead to a
dstate with the next observation. Each such dstate predicts some of the following steps. The walk
takes the dstate that predicts clearly more steps than the others, if its prediction does not end in
a contradiction. If there is none, the robot is lost until some dstate predicts enough steps. The
map grows with each walk, so the next walk may find links that this one did not find. In the end,
the remaining unknown links lead to new dstates.

A link that a walk adds may be wrong, and so may the given map. Then the trace contradicts it sooner
or later. The walk forgets the dstate where this happens. If that does not help, it also forgets
dstates before it. The result may have dstates that could be one. `guesses/merging.py` merges them.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TypeAlias

from ssh_abduction.runtime.clock import look_at_clock
from ssh_abduction.solver.steps.log import Log

# The most steps to predict from a dstate, to find out whether the robot is there.
LOOKED = 300
# The fewest steps that a dstate has to predict to become the end of a link.
SETTLED = 10
# The fewest steps that a dstate has to predict if the robot is lost. This is more than for a link,
# as it is unknown where the robot comes from.
FOUND = 20
# In both cases it has to predict this many steps more than any other dstate.
AHEAD = 2
# Give the map up after this many walks. After half of them, unknown links lead to new dstates.
WALKS = 100
# Also give the map up when the number of dstates has grown by this factor.
MANY = 10

_Link: TypeAlias = tuple[int, int]  # dstate, action


def labels_continued(log: Log, labels: Sequence[int]) -> list[int] | None:
    """Label all steps of a trace by extending, and if need be correcting, a map of its first steps.

    `labels` has the dstate of each of the first steps, numbered from 0. Returns None if there are
    still contradictions after WALKS walks, or the map has become too large.
    """
    known = _Map(log, labels)
    may_be_lost, furthest, back = True, 0, 1
    for walk in range(WALKS):
        links = len(known.leads)
        found = known.walked(may_be_lost=may_be_lost)
        if known.is_too_large:
            return None
        if len(found) < len(log.seen):
            # Forget twice as many dstates if forgetting the last ones did not help.
            furthest, back = max(furthest, len(found)), 2 * back if len(found) <= furthest else 1
            known.forget(found[-back:])
        elif -1 not in found:
            return found
        elif len(known.leads) == links or walk > WALKS // 2:
            may_be_lost = False
    return None


class _Map:
    """A causal map, to which walks along the trace add links and dstates.

    Attributes:
        leads: For each (dstate, action) with a link, the dstate that it leads to.
    """

    def __init__(self, log: Log, labels: Sequence[int]) -> None:
        self._seen, self._actions = log.seen, log.actions
        self._shows = dict(zip(labels, log.seen, strict=False))  # the observation of each dstate
        self.leads = {(labels[t], log.actions[t]): labels[t + 1] for t in range(len(labels) - 1)}
        self._start: int | None = labels[0]
        self._most = MANY * len(self._shows)
        self._like: dict[int, list[int]] = {}  # the dstates that have each observation
        for dstate, seen in self._shows.items():
            self._like.setdefault(seen, []).append(dstate)

    @property
    def is_too_large(self) -> bool:
        return len(self._shows) > self._most

    def walked(self, *, may_be_lost: bool) -> list[int]:
        """Follow the trace along the map, add links that are found, and return labels.

        The labels end before the first step that contradicts the map. If it is unclear where the
        robot is, label the step -1 if `may_be_lost`; otherwise add a new dstate to the map.
        """
        labels: list[int] = []
        for t, seen in enumerate(self._seen):
            link = (labels[-1], self._actions[t - 1]) if t and labels[-1] >= 0 else None
            # Follow a known link; else look for the dstate that predicts the next steps.
            there = self.leads.get(link) if link else None if t else self._start
            if there is None:
                there = self._predicting(t, SETTLED if link else FOUND, link)
                if there is None and not may_be_lost:
                    there = self._new(seen)
                if link and there is not None:
                    self.leads[link] = there
            elif self._shows[there] != seen:
                break
            if self.is_too_large:
                break
            labels.append(-1 if there is None else there)
        return labels

    def forget(self, dstates: Iterable[int]) -> None:
        """Remove these dstates, and all links to and from them."""
        forgotten = {dstate for dstate in dstates if dstate >= 0}
        for dstate in forgotten:
            self._like[self._shows[dstate]].remove(dstate)
        self.leads = {
            link: there
            for link, there in self.leads.items()
            if forgotten.isdisjoint((link[0], there))
        }
        if self._start in forgotten:
            self._start = None

    def _new(self, seen: int) -> int:
        """Add a dstate with an observation, and return it."""
        dstate = len(self._shows)
        self._shows[dstate] = seen
        self._like.setdefault(seen, []).append(dstate)
        return dstate

    def _predicting(self, step: int, least: int, link: _Link | None = None) -> int | None:
        """Find the dstate at a step that predicts the most of the following steps.

        Each try assumes that the unknown `link` to this step leads to the dstate. Returns None if
        the dstate predicts fewer than `least` steps, or not AHEAD steps more than any other, or if
        a contradiction ends its prediction.
        """
        look_at_clock()
        # Keep the two longest predictions, to compare them in the end.
        best, most, next_most = None, 0, 0
        for dstate in self._like.get(self._seen[step], ()):
            if link:
                self.leads[link] = dstate
            steps, contradicted = self._predicted(dstate, step)
            if steps > most:
                best, most, next_most = None if contradicted else dstate, steps, most
            else:
                next_most = max(next_most, steps)
        if link:
            self.leads.pop(link, None)
        return (
            best
            if most >= min(least, len(self._seen) - step) and most >= next_most + AHEAD
            else None
        )

    def _predicted(self, dstate: int, step: int) -> tuple[int, bool]:
        """Return how many steps a dstate predicts, and whether it ends in a contradiction.

        It predicts at most LOOKED steps. Without a contradiction, an unknown link or the end of the
        trace ends it.
        """
        for t in range(step + 1, min(step + LOOKED, len(self._seen))):
            there = self.leads.get((dstate, self._actions[t - 1]))
            if there is None:
                return t - step, False
            if self._shows[there] != self._seen[t]:
                return t - step, True
            dstate = there
        return min(LOOKED, len(self._seen) - step), False
