"""Finds where the steps of a long trace are by a map of its first steps, even if that map lacks links.

>>> from ssh_abduction import Theory, Trace
>>> from ssh_abduction.solver.guesses.continuing import followed
>>> from ssh_abduction.solver.steps.log import Log
>>> trace = Trace.from_steps("abcabca" + "cab" * 4, ["go"] * 6 + ["back"] + ["go"] * 11)
>>> followed(Log(trace, Theory.causal()), [0, 1, 2, 0])
[0, 1, 2, 0, 1, 2, 0, 2, 0, 1, 2, 0, 1, 2, 0, 1, 2, 0, 1]

The trace is walked along the links of the map. Where the map does not say where an action leads, it must lead to a dstate that shows what is seen next. Of these
dstates, the one that predicts the following steps longest is taken, if it is clearly ahead of all others and is not contradicted at the end of its prediction. If
no dstate is, the robot is lost until what it sees and does tells where it is: Markov localisation, with beliefs that are all or nothing. A link that one walk
does not settle may be settled by the next walk, as more of the map is known by then. A link that no walk settles leads to a new dstate in the end.

So a link may be wrong, and the map that was given may be. Then the trace contradicts it sooner or later, and the dstate where it does is forgotten, or more of the
dstates before it where that does not help. The result has more dstates than it needs, as some of them could be one: `guesses/merging.py` merges them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TypeAlias

from ssh_abduction.solver.steps.log import Log

# At most this many steps are predicted from a dstate, to tell whether the robot is there.
LOOKED = 300
# A link leads to a dstate only if that predicts at least this many steps.
SETTLED = 10
# A robot that is lost is at a dstate only if that predicts at least this many steps: more than for a link, as here nothing is known of where it comes from.
FOUND = 20
# And in both cases only if it predicts this many steps more than any other dstate.
AHEAD = 2
# After this many walks the map is given up. After half of them the robot may be lost no longer: what is not settled by then is a new dstate.
WALKS = 100
# The map is also given up once it has this many times as many dstates as it had to begin with.
MANY = 10

_Link: TypeAlias = tuple[int, int]  # dstate, action


def followed(
    log: Log, labels: Sequence[int], check: Callable[[], None] = lambda: None
) -> list[int] | None:
    """Labels of all steps of a trace, which make a map near the given one; None where too much of that one is contradicted.

    labels  of a map of the first steps, numbered from 0
    check   called now and then; may raise
    """
    known = _Map(log, labels, check)
    may_be_lost, furthest, back = True, 0, 1
    for walk in range(WALKS):
        links = len(known.leads)
        found = known.walked(may_be_lost=may_be_lost)
        if known.is_too_large:
            return None
        if len(found) < len(log.seen):
            furthest, back = max(furthest, len(found)), 2 * back if len(found) <= furthest else 1
            known.forget(found[-back:])
        elif -1 not in found:
            return found
        elif len(known.leads) == links or walk > WALKS // 2:
            may_be_lost = False
    return None


class _Map:
    """A map of the first steps, to which links and dstates are added.

    leads  where actions lead, by dstate and action
    """

    def __init__(self, log: Log, labels: Sequence[int], check: Callable[[], None]) -> None:
        self._check = check
        self._seen, self._actions = log.seen, log.actions
        self._shows = dict(zip(labels, log.seen, strict=False))  # what is seen at each dstate
        self.leads = {(labels[t], log.actions[t]): labels[t + 1] for t in range(len(labels) - 1)}
        self._start: int | None = labels[0]
        self._most = MANY * len(self._shows)
        self._like: dict[int, list[int]] = {}  # for each observation, the dstates that show it
        for dstate, seen in self._shows.items():
            self._like.setdefault(seen, []).append(dstate)

    @property
    def is_too_large(self) -> bool:
        return len(self._shows) > self._most

    def walked(self, *, may_be_lost: bool) -> list[int]:
        """Labels of the steps, up to the first one that contradicts the map. Links that become clear on the way are added to the map.

        may_be_lost  where it is not clear where the robot is, the label is -1; else the robot is at a new dstate there
        """
        labels: list[int] = []
        for t, seen in enumerate(self._seen):
            link = (labels[-1], self._actions[t - 1]) if t and labels[-1] >= 0 else None
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
        """Take these dstates and all links to and from them out of the map."""
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
        """A new dstate that shows this."""
        dstate = len(self._shows)
        self._shows[dstate] = seen
        self._like.setdefault(seen, []).append(dstate)
        return dstate

    def _predicting(self, step: int, least: int, link: _Link | None = None) -> int | None:
        """The dstate that predicts at least so many steps from this one on, and AHEAD more than any other; None if there is no such dstate.

        link  is taken to lead to each dstate while that is tried
        """
        self._check()
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
        """How many steps are predicted if this one is at that dstate, this step counted, and whether the next one contradicts the map."""
        for t in range(step + 1, min(step + LOOKED, len(self._seen))):
            there = self.leads.get((dstate, self._actions[t - 1]))
            if there is None:
                return t - step, False
            if self._shows[there] != self._seen[t]:
                return t - step, True
            dstate = there
        return min(LOOKED, len(self._seen) - step), False
