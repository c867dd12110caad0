"""Turn a trace into integers, and replay it over maps in linear time.

A map of the first steps of a trace says where each tried action leads, and what was seen at each
dstate. A *replay* follows the rest of the trace along these links. It stops at an action that was
not tried in a dstate, or at an observation that was not made there. It checks no axioms; the solver
does that.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from ssh_abduction.data.groups import numbered
from ssh_abduction.data.trace import Step, Trace, View
from ssh_abduction.theory.evidence import Evidence, pairs_of
from ssh_abduction.theory.pairs import Pairs
from ssh_abduction.theory.theory import Theory

# Where an unknown action may lead, try at most this many dstates, the earliest ones first. So a
# view that is seen nearly everywhere does not use up all predictions.
TRIED = 100
# For a greedy map, predict at most this many steps, which takes about a second. After that, unknown
# actions lead to new dstates: a map that needs more predictions is large anyway.
STEPS_TRIED = 3_000_000
# For a long trace, predict up to this many steps for each step of the trace, if that is more.
EACH = 20


def observation(step: Step, theory: Theory) -> tuple[View | None, object]:
    """Return the values of a step that the axioms read: its view, and its star or None.

    A star is the openings seen at a step. Two steps at one dstate have equal observations, by
    functional_view and the axioms of stars. If only the pattern of a star matters (star=pattern),
    its four rotations are one observation. The star is None if stars are not used, or if they need
    to agree only within their spread (star=alike or gateways).
    """
    star = step.openings if theory.star in ("pattern", "frame") else None
    if star is None or theory.star == "frame":
        return step.view, star
    return step.view, min(star[k:] + star[:k] for k in range(4))


class Log:
    """A trace as integers, to be replayed over many maps.

    Actions and observations are numbered from 0 in the order in which they first occur.

    Attributes:
        actions: The action after each step but the last.
        seen: The observation (view, and perhaps star) at each step.
    """

    def __init__(
        self,
        trace: Trace,
        theory: Theory,
        pairs: Pairs | None = None,
        evidence: tuple[Evidence, ...] | None = None,
    ) -> None:
        """Number the actions and observations. Without `pairs`, find these when first used."""
        self._pairs, self._find = pairs, partial(pairs_of, trace, theory, evidence)
        self.actions = numbered(action.name for action in trace.actions)
        self.seen = numbered(observation(step, theory) for step in trace.steps)

    @property
    def pairs(self) -> Pairs:
        """The evidence about pairs of steps: which cannot be, or must be, one dstate or place."""
        if self._pairs is None:
            self._pairs = self._find()
        return self._pairs

    @property
    def has_pairs(self) -> bool:
        """Whether the pairs of steps that evidence decides have already been computed."""
        return self._pairs is not None

    def replay(
        self, labels: Sequence[int], place_of: Sequence[int | None] | None = None
    ) -> tuple[int, ...]:
        """Replay the trace over the map that `labels` make of its first steps.

        `place_of` has the place of each dstate, to check the evidence about places; None if the map
        has no places. Returns the dstates of the first steps, as far as the map explains them. It
        explains all steps if there are as many dstates.
        """
        actions, seen, known = self.actions, self.seen, len(labels)
        if known == len(seen):
            return tuple(labels)
        links = {(labels[t], actions[t]): labels[t + 1] for t in range(known - 1)}
        sights = {(labels[t], seen[t]) for t in range(known)}
        found = list(labels)
        for t in range(known, len(seen)):
            following = links.get((found[-1], actions[t - 1]))
            if following is None or (following, seen[t]) not in sights:
                break
            found.append(following)
            # Evidence about pairs of steps can contradict the dstate, too.
            if t in self.pairs.asked_for and not self.pairs.allow(t, found, place_of):
                found.pop()
                break
        return tuple(found)

    def merged(self) -> tuple[int, ...]:
        """Label all steps greedily, so that the labels make a causal map. It need not be minimal.

        If an action at a dstate has no link yet, try to let it lead to each known dstate with the
        next observation. From there the map predicts the trace up to the next unknown action,
        unless a step contradicts it earlier. Let the action lead to the dstate that predicts the
        most steps without contradiction, or else to a new dstate. So no link has to be undone.
        After STEPS_TRIED predicted steps, let all unknown actions lead to new dstates.
        """
        actions, seen = self.actions, self.seen
        shows = [seen[0]]
        like = {seen[0]: [0]}  # for each observation, the first TRIED dstates that show it
        links: dict[tuple[int, int], int] = {}
        labels = [0]
        left = max(STEPS_TRIED, EACH * len(seen))  # predictions that may still be made
        while len(labels) < len(seen):
            t = len(labels)
            key = (labels[-1], actions[t - 1])
            best, most = [len(shows)], 0
            alike = like.setdefault(seen[t], [])
            for label in alike if left > 0 else ():
                links[key] = label
                found = [label]
                while (end := t + len(found)) < len(seen) and (
                    following := links.get((found[-1], actions[end - 1]))
                ) is not None:
                    if shows[following] != seen[end]:
                        break
                    found.append(following)
                else:
                    if len(found) > most:
                        best, most = found, len(found)
                left -= len(found)
            if not most:
                if len(alike) < TRIED:
                    alike.append(len(shows))
                shows.append(seen[t])
            links[key] = best[0]
            labels += best
        return tuple(labels)
