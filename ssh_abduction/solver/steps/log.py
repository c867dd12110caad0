"""Run a trace over a map in linear time: what the map predicts holds, is contradicted, or is unknown to it.

A map made for the first steps of a trace says of each action tried in a dstate where it leads, and of each dstate what was
seen there. Replay follows the rest of the trace through these links. It restates no axiom: where it meets an action never
tried in the dstate, or something never seen there, it stops and leaves the judgement to the solver.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

from ssh_abduction.data.trace import Step, Trace
from ssh_abduction.theory.evidence import pairs_of
from ssh_abduction.theory.theory import Theory

# Where the greedy map does not know an action, at most this many dstates of the view that is seen are tried as its end, those found first: so a view that is seen
# nearly everywhere does not use up all predictions at once.
TRIED = 100
# To make a greedy map at most this many steps are predicted, which takes about a second. From then on what is unknown leads to new dstates: a map that takes more
# predictions is large anyway.
STEPS_TRIED = 3_000_000
# Or this many predictions for each step of the trace, if that is more, so that a long trace is not cut short.
EACH = 20


class Outcome(Enum):
    """How a replay ended."""

    PREDICTED = "predicted"  # every step of the trace is explained
    CONTRADICTED = "contradicted"  # the dstate reached shows something else, or evidence says that the step is not there
    UNKNOWN = "unknown"  # the action was never tried in the dstate


@dataclass(frozen=True, slots=True)
class Replay:
    """The `labels` of the steps that the map explains, and the `outcome`. Where that is not PREDICTED, step len(labels) is the one that failed."""

    labels: tuple[int, ...]
    outcome: Outcome


def observation(step: Step, theory: Theory) -> tuple[object, object]:
    """What the axioms read at a step: the view, and the star where the theory uses stars. Where the theory does not say how stars are turned
    (star=pattern), all four rotations of a star are the same observation. Where stars agree in tolerance only (star=gateways), none tells two dstates apart
    by itself.

    By functional_view and the axioms of the stars, a dstate has one observation.
    """
    star = step.openings if theory.star in ("pattern", "frame") else None
    if star is None or theory.star == "frame":
        return step.view, star
    return step.view, min(star[k:] + star[:k] for k in range(4))


class Log:
    """A trace as integers, made once and replayed over many maps.

    actions   which action was done at each step
    seen      which observation was made
    pairs     what evidence says of pairs of steps
    """

    def __init__(self, trace: Trace, theory: Theory) -> None:
        self.pairs = pairs_of(trace, theory)
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

        known     how many of these steps make the links of the map (default all)
        place_of  the place of each dstate of the map, if it has places: evidence may say that two steps are at different places
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
            if t in self.pairs.asked_for and not self.pairs.allow(t, found, place_of):
                found.pop()
                outcome = Outcome.CONTRADICTED
                break
        return Replay(tuple(found), outcome)

    def merged(self) -> tuple[int, ...]:
        """Labels of a map of the whole trace, made greedily: it is consistent and found at once, but need not be minimal.

        Where the map does not know an action, each known dstate that shows what is seen is tried as its end: from there the map either predicts the trace
        until it meets another unknown action, or is contradicted before. Of those not contradicted, the one that predicts most steps is taken; if there is
        none, the action leads to a new dstate. So a link, once made, is never wrong. Once STEPS_TRIED is used up, all that is unknown leads to new dstates.
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
