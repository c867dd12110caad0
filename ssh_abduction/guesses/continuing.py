"""Where the steps of a long trace are, by a map of its beginning: also where that map lacks links.

>>> from ssh_abduction import Theory, Trace
>>> from ssh_abduction.guesses.continuing import followed
>>> from ssh_abduction.steps.log import Log
>>> trace = Trace.from_steps("abcabca" + "cab" * 4, ["go"] * 6 + ["back"] + ["go"] * 11)
>>> followed(Log(trace, Theory.causal()), [0, 1, 2, 0])
[0, 1, 2, 0, 1, 2, 0, 2, 0, 1, 2, 0, 1, 2, 0, 1, 2, 0, 1]

The trace is walked along the links of the map. Where the map does not say where an action leads, that is one of the dstates that show what is seen then: the
one that predicts the steps from there on longest, if it is ahead of all others and not contradicted soon. Where that is not clear the robot is lost, until
what it sees and does tells where it is: Markov localisation, with beliefs that are all or nothing. What one walk does not settle the next one may, as more of the map is known by
then. In the end a link that none has settled leads to a new dstate.

So a link may be wrong, and so may be the map. Then the trace contradicts it sooner or later, and the dstate where it does is forgotten, or more of those before it where
that does not help. What comes of that has more dstates than it needs, some of which are one (`guesses/merging.py`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TypeAlias

from ssh_abduction.steps.log import Log

LOOKED = 300  # steps ahead, at most, that are looked at to tell where the robot is
SETTLED = 10  # steps that a dstate has to predict for a link to lead there,
FOUND = 20  # and where the robot is lost for it to be there,
AHEAD = 2  # and so many more than any other
WALKS = 100  # after which the map is given up; after half of them the robot is lost no more: what is not settled by then is new
MANY = 10  # times as many dstates as it had, with which it is given up, too

_Link: TypeAlias = tuple[int, int]  # dstate, action


def followed(log: Log, labels: Sequence[int], check: Callable[[], None] = lambda: None) -> list[int] | None:
    """Labels of all steps of a trace, of a map near that of its first steps; None where too much of that is contradicted.

    labels  of a map of the first steps, numbered from 0
    check   called now and then; may raise
    """
    known = _Map(log, labels, check)
    patient, furthest, back = True, 0, 1
    for walk in range(WALKS):
        links = len(known.leads)
        found = known.walked(lost=patient)
        if known.is_too_large:
            return None
        if len(found) < len(log.seen):
            furthest, back = max(furthest, len(found)), 2 * back if len(found) <= furthest else 1
            known.forget(found[-back:])
        elif -1 not in found:
            return found
        elif len(known.leads) == links or walk > WALKS // 2:
            patient = False
    return None


class _Map:
    """A map of the first steps, to which links are added, and dstates.

    leads  where actions lead, by dstate and action
    """

    def __init__(self, log: Log, labels: Sequence[int], check: Callable[[], None]) -> None:
        self._check = check
        self._seen, self._actions = log.seen, log.actions
        self._shows = dict(zip(labels, log.seen, strict=False))  # what is seen at each dstate
        self.leads = {(labels[t], log.actions[t]): labels[t + 1] for t in range(len(labels) - 1)}
        self._start: int | None = labels[0]
        self._most = MANY * len(self._shows)
        self._like: dict[int, list[int]] = {}  # the dstates where something is seen
        for dstate, seen in self._shows.items():
            self._like.setdefault(seen, []).append(dstate)

    @property
    def is_too_large(self) -> bool:
        return len(self._shows) > self._most

    def walked(self, *, lost: bool) -> list[int]:
        """Labels of the steps, -1 where the robot is lost, if it may be; those before the first one that contradicts the map. Links that are clear on the way are added."""
        labels: list[int] = []
        for t, seen in enumerate(self._seen):
            link = (labels[-1], self._actions[t - 1]) if t and labels[-1] >= 0 else None
            there = self.leads.get(link) if link else None if t else self._start
            if there is None:
                there = self._predicting(t, SETTLED if link else FOUND, link)
                if there is None and not lost:
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
        """Let the map know nothing of these dstates."""
        forgotten = {dstate for dstate in dstates if dstate >= 0}
        for dstate in forgotten:
            self._like[self._shows[dstate]].remove(dstate)
        self.leads = {link: there for link, there in self.leads.items() if forgotten.isdisjoint((link[0], there))}
        if self._start in forgotten:
            self._start = None

    def _new(self, seen: int) -> int:
        """A new dstate that shows this."""
        dstate = len(self._shows)
        self._shows[dstate] = seen
        self._like.setdefault(seen, []).append(dstate)
        return dstate

    def _predicting(self, step: int, least: int, link: _Link | None = None) -> int | None:
        """The dstate of a step that predicts at least so many steps from there on, and clearly more than any other; None where there is no such.

        link  is taken to lead to each dstate that is tried
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
        return best if most >= min(least, len(self._seen) - step) and most >= next_most + AHEAD else None

    def _predicted(self, dstate: int, step: int) -> tuple[int, bool]:
        """How many steps a dstate predicts from this one on, itself among them, and whether what comes then contradicts it."""
        for t in range(step + 1, min(step + LOOKED, len(self._seen))):
            there = self.leads.get((dstate, self._actions[t - 1]))
            if there is None:
                return t - step, False
            if self._shows[there] != self._seen[t]:
                return t - step, True
            dstate = there
        return min(LOOKED, len(self._seen) - step), False
