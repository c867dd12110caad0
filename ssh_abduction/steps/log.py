"""Run a trace over a map in linear time: what the map predicts holds, is contradicted, or is unknown to it.

A map made for the first steps of a trace says of each action tried in a dstate where it leads, and of each dstate what was
seen there. Replay follows the rest of the trace through these links. It restates no axiom: where it meets an action never
tried in the dstate, or something never seen there, it stops and leaves the judgement to the solver.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

from ssh_abduction.theory.evidence import pairs_of
from ssh_abduction.theory.theory import Theory
from ssh_abduction.trace import Step, Trace

TRIED = 100  # dstates of a view that a step may be merged with
STEPS_TRIED = 3_000_000  # steps predicted in all, about a second, after which no step is merged with any, as the map is large anyway;
EACH = 20  # or so many for each step, if that is more


class Outcome(Enum):
    """How a replay ended."""

    PREDICTED = "predicted"  # every step of the trace is explained
    CONTRADICTED = "contradicted"  # the dstate reached shows something else, or evidence says that the step is not there
    UNKNOWN = "unknown"  # the action was never tried in the dstate


@dataclass(frozen=True, slots=True)
class Replay:
    """`labels` of the steps explained, and the `outcome`. Where it is not PREDICTED, step len(labels) is the one that failed."""

    labels: tuple[int, ...]
    outcome: Outcome


def observation(step: Step, theory: Theory) -> tuple[object, object]:
    """What the axioms read at a step: the view, with the star where the theory uses stars, in one rotation of four if any will do.

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

    def replay(self, labels: Sequence[int], known: int | None = None, place_of: Sequence[int | None] | None = None) -> Replay:
        """Replay the trace over the map that `labels` make of its first steps; `known` of them make links (default all).

        place_of  the place of each dstate of the map, if it has any: what evidence says of pairs of steps may be about these
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
        """Labels of a map of the whole trace, made greedily: not minimal, but at once.

        Wherever the map does not know an action, the dstate among those that show what is seen is taken that then predicts most, if it
        is not contradicted before the map knows no more; else a new one, as all are once much was tried. So a link, once made, is never wrong.
        """
        actions, seen = self.actions, self.seen
        shows = [seen[0]]
        like = {seen[0]: [0]}  # the first dstates that show a view: as many as are tried
        links: dict[tuple[int, int], int] = {}
        labels = [0]
        left = max(STEPS_TRIED, EACH * len(seen))  # steps to be predicted
        while len(labels) < len(seen):
            t = len(labels)
            key = (labels[-1], actions[t - 1])
            best, most = [len(shows)], 0
            alike = like.setdefault(seen[t], [])
            for label in alike if left > 0 else ():
                links[key] = label
                found = [label]
                while (end := t + len(found)) < len(seen) and (following := links.get((found[-1], actions[end - 1]))) is not None:
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
