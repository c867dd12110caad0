"""A trace as integers, replayed over maps in linear time.

A map of the first steps of a trace says where each tried action leads, and what was seen at each
dstate. A replay follows the rest of the trace along these links. It checks no axioms: it stops at
an action that was not tried in a dstate, or at an observation that was not made there, and leaves
the decision to the solver.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

from ssh_abduction.data.trace import Step, Trace
from ssh_abduction.theory.evidence import pairs_of
from ssh_abduction.theory.pairs import Pairs
from ssh_abduction.theory.theory import Theory

# The most dstates to try as the end of an unknown action, first ones first. So a view that is seen
# nearly everywhere does not use up all predictions.
TRIED = 100
# The most steps to predict for a greedy map, which takes about a second. Then unknown actions lead
# to new dstates: a map that needs more predictions is large anyway.
STEPS_TRIED = 3_000_000
# For long traces, this many predictions for each step instead.
EACH = 20


class Outcome(Enum):
    """How a replay ended."""

    PREDICTED = "predicted"  # the map explains every step
    CONTRADICTED = "contradicted"  # the observation or evidence contradicts the dstate reached
    UNKNOWN = "unknown"  # the action was never tried in the dstate


@dataclass(frozen=True, slots=True)
class Replay:
    """The result of a replay.

    Attributes:
        labels: The dstates of the steps that the map explains.
        outcome: How the replay ended. Unless it is PREDICTED, step len(labels) failed.
    """

    labels: tuple[int, ...]
    outcome: Outcome


def observation(step: Step, theory: Theory) -> tuple[object, object]:
    """What the axioms read at a step: the view, and the star if the theory uses stars.

    By functional_view and the axioms of stars, a dstate has one observation. If the theory does not
    say how stars are turned (star=pattern), all four rotations of a star are one observation. If
    stars need to agree only within tolerance (star=gateways), they are left out.
    """
    star = step.openings if theory.star in ("pattern", "frame") else None
    if star is None or theory.star == "frame":
        return step.view, star
    return step.view, min(star[k:] + star[:k] for k in range(4))


class Log:
    """A trace as integers, to be replayed over many maps.

    Attributes:
        actions: The action at each step.
        seen: The observation at each step.
        pairs: Evidence about pairs of steps.
    """

    def __init__(self, trace: Trace, theory: Theory, pairs: Pairs | None = None) -> None:
        self.pairs = pairs_of(trace, theory) if pairs is None else pairs
        actions: dict[str, int] = {}
        seen: dict[object, int] = {}
        self.actions = [actions.setdefault(a.name, len(actions)) for a in trace.actions]
        self.seen = [seen.setdefault(observation(step, theory), len(seen)) for step in trace.steps]

    def replay(
        self,
        labels: Sequence[int],
        known: int | None = None,
        place_of: Sequence[int | None] | None = None,
    ) -> Replay:
        """Replay the trace over the map that `labels` make of its first steps.

        Args:
            labels: The dstate of each of the first steps.
            known: The number of these steps whose links make the map; all by default.
            place_of: The place of each dstate, if the map has places. Evidence may say that two
                steps are at different places.
        """
        actions, seen = self.actions, self.seen
        known = len(labels) if known is None else known
        if known == len(seen):
            return Replay(tuple(labels), Outcome.PREDICTED)
        links = {(labels[t], actions[t]): labels[t + 1] for t in range(known - 1)}
        sights = {(labels[t], seen[t]) for t in range(known)}
        found = list(labels[:known])
        label = found[-1]
        outcome = Outcome.PREDICTED
        for t in range(known, len(seen)):
            following = links.get((label, actions[t - 1]))
            if following is None:
                outcome = Outcome.UNKNOWN
                break
            if (following, seen[t]) not in sights:
                outcome = Outcome.CONTRADICTED
                break
            label = following
            found.append(label)
            # Evidence can contradict the dstate, too.
            if t in self.pairs.asked_for and not self.pairs.allow(t, found, place_of):
                found.pop()
                outcome = Outcome.CONTRADICTED
                break
        return Replay(tuple(found), outcome)

    def merged(self) -> tuple[int, ...]:
        """Labels of a consistent map of the whole trace, found greedily. It need not be minimal.

        If the map does not know an action, each known dstate with the next observation is tried as
        its end. The map then predicts the trace up to the next unknown action, or is contradicted
        before. The action leads to the dstate that predicts the most steps without contradiction,
        or else to a new one. So a link never has to be taken back. After STEPS_TRIED predictions,
        all unknown actions lead to new dstates.
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
