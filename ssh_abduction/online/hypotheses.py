"""Rival explanations of a growing trace with faults, and the probability of each.

A *rival* is a map of all steps so far, with its *faults*: the steps that it treats as wrong. A
dstate (distinctive state) is a place and a heading. When a new step comes, a rival that predicts
it is extended in one way. Any other rival is extended in each of these ways:

    contradicted  The observation is misread, and the robot is where the link leads. Or the action
                  slipped, and the robot is at one of the dstates that look like this, or at a new
                  dstate.
    unknown       A new link leads to one of the dstates that look like this, or to a new dstate.

New links and new dstates are for the causal theory alone. In a theory with places and paths, only
the axioms say where a new link may lead.

Each rival has a weight. The theory gives the price of a fault in dstates, and the cheapest kind of
fault has the probability `Chances.misread`. A price does not count alternatives: a new link, or an
action that slipped, leads to one of N dstates, and a misread view is one of V views. Let λ be the
logarithm of the odds that correspond to the price of one dstate. Then

    weight = exp(-λ cost) N^-(links and slips) V^-(misreadings)

What happens after a fault decides between its explanations. If one explanation has to assume a link
that another one predicts, the weight of the first one falls.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from ssh_abduction.data.groups import firsts, gathered
from ssh_abduction.data.maps import DState, Fault, SSHMap
from ssh_abduction.data.trace import Step, Trace
from ssh_abduction.solver import Cost, Judging, observation
from ssh_abduction.theory.pairs import Pairs
from ssh_abduction.theory.theory import Theory

# As `observation` returns it: the view, and the star (the openings seen) or None.
Seen = tuple[object, object]
# What a dstate costs, in tenths of dstates.
DSTATE = 10


@dataclass(frozen=True, slots=True)
class ExtendedMap:
    """An explanation of all steps so far: a map, and how it was extended."""

    map: SSHMap  # the map that the solver found, of the first steps or of all
    labels: tuple[int, ...]  # the dstate of each step so far
    shows: tuple[Seen, ...]  # the view and star of each dstate
    # For each dstate and name of an action, the dstate that the action leads to.
    links: Mapping[tuple[int, str], int]
    faults: tuple[Fault, ...]  # the observations and actions that are treated as wrong
    # The counts that the theory minimises, the most important first. Dstates, with the price of
    # faults, count in tenths.
    cost: tuple[int, ...]

    @classmethod
    def of(cls, ssh_map: SSHMap, trace: Trace, theory: Theory) -> ExtendedMap:
        """Make the hypothesis that a map of the trace, or of its first steps, is true."""
        wrong = {fault.step for fault in ssh_map.faults if fault.kind != "slipped"}
        first = firsts((s, t) for t, s in enumerate(ssh_map.dstate_at) if t not in wrong)
        shows = tuple(
            observation(trace.steps[first[s.id]], theory) if s.id in first else (s.view, None)
            for s in ssh_map.dstates
        )
        links = {(s, action): x for s, action, x in ssh_map.links}
        cost = Cost.of(ssh_map).preferred_by(theory)
        return cls(ssh_map, ssh_map.dstate_at, shows, links, ssh_map.faults, cost)

    @property
    def here(self) -> int:
        """The id of the dstate where the robot is after the last step."""
        return self.labels[-1]

    @property
    def places(self) -> list[int | None]:
        """The place of each dstate; None for a dstate without a place."""
        known = self.map.dstates
        return [s.place for s in known] + [None] * (len(self.shows) - len(known))

    def explained(self) -> SSHMap:
        """Make the map of all steps so far, with its faults."""
        if len(self.map.dstate_at) == len(self.labels):
            return self.map
        known = self.map.dstates
        new = (DState(s, self.shows[s][0]) for s in range(len(known), len(self.shows)))  # type: ignore[arg-type]
        links = self.map.links
        if len(links) < len(self.links):
            links = tuple(sorted((s, action, x) for (s, action), x in self.links.items()))
        faults = tuple(sorted(self.faults, key=lambda fault: (fault.step, fault.kind)))
        labels, dstates = self.labels, (*known, *new)
        return replace(
            self.map, dstate_at=labels, dstates=dstates, links=links, faults=faults, fit=None
        )

    def contradiction(self, action: str, seen: Seen) -> int | None:
        """Return the dstate that an action leads to, if it shows something else than `seen`.

        None if it shows that, or if the map has no link for the action.
        """
        there = self.links.get((self.here, action))
        return None if there is None or self.shows[there] == seen else there

    def predicting(self, action: str, seen: Seen) -> ExtendedMap | None:
        """Extend this map by a step that it predicts; None if it does not predict the step."""
        there = self.links.get((self.here, action))
        return None if there is None or self.shows[there] != seen else self._to(there)

    def is_allowed(self, trace: Trace, pairs: Pairs, judging: Judging) -> bool:
        """Whether the evidence allows the last step of a trace, as it allowed the earlier ones."""
        t = len(trace) - 1
        return pairs.allow(t, self.labels, self.places) and judging.allows_grown(
            trace, self.explained(), t
        )

    def is_unknown(self, action: str) -> bool:
        """Whether the map has no link for an action at the dstate where the robot is."""
        return (self.here, action) not in self.links

    def future(self) -> tuple[object, ...]:
        """Summarise what the map predicts from here on, as a value that can be compared.

        Two maps have equal values if they have the same dstates, the same links, and the robot at
        the same dstate, up to renaming. The past does not count. For dstates that cannot be
        reached from here, only their number counts.
        """
        ends = gathered((s, (action, x)) for (s, action), x in self.links.items())
        # Number the dstates in the order in which a breadth-first search from here reaches them.
        number, reached = {self.here: 0}, [self.here]
        links = []
        for s in reached:
            for action, x in sorted(ends.get(s, [])):
                if x not in number:
                    number[x] = len(reached)
                    reached.append(x)
                links.append((number[s], action, number[x]))
        return tuple(self.shows[s] for s in reached), tuple(links), len(self.shows)

    def ways_on(self, action: str, step: Step, seen: Seen, theory: Theory) -> Iterator[ExtendedMap]:
        """Yield the extensions of this rival by one step. Those without extra cost come first.

        `action` is the name of the action before the step. In the theory no field is "auto".
        """
        t, there = len(self.labels), self.links.get((self.here, action))
        alike = [s for s, shown in enumerate(self.shows) if shown == seen]
        is_causal = theory.level == "causal"
        if there is None:
            if is_causal:
                for s in alike:
                    yield self._to(s, link=action)
                yield self._to(len(self.shows), link=action, new=seen)
            return
        if longer := self.predicting(action, seen):
            yield longer
            return
        if theory.misread:
            view, star = self.shows[there]
            tenths = theory.fault_tenths("misread", step)
            doubted = []
            if view != seen[0]:
                doubted += [Fault(t, "misread", step.view, view, tenths / 10)]  # type: ignore[arg-type]
            if star != seen[1]:
                doubted += [Fault(t, "misseen", cost=tenths / 10)]
            yield self._to(there, faults=doubted, tenths=tenths * len(doubted))
        if theory.slipped:
            tenths = theory.fault_tenths("slipped", step)
            slipped = [Fault(t - 1, "slipped", action, cost=tenths / 10)]
            for s in alike:
                yield self._to(s, faults=slipped, tenths=tenths)
            if is_causal:
                yield self._to(len(self.shows), new=seen, faults=slipped, tenths=tenths)

    def _to(
        self,
        there: int,
        *,
        link: str | None = None,
        new: Seen | None = None,
        faults: Sequence[Fault] = (),
        tenths: int = 0,
    ) -> ExtendedMap:
        """Extend this rival by a step at the dstate `there`.

        `link` names the action if the step adds a link. `new` is the view and star of a new dstate.
        `tenths` is the cost of the faults that the step adds; 10 is the cost of one dstate.
        """
        tenths += DSTATE if new else 0
        return ExtendedMap(
            self.map,
            (*self.labels, there),
            (*self.shows, new) if new else self.shows,
            {**self.links, (self.here, link): there} if link else self.links,
            (*self.faults, *faults),
            (self.cost[0] + tenths, *self.cost[1:]) if tenths else self.cost,
        )


def shares_of_rivals(
    rivals: Sequence[ExtendedMap], theory: Theory, chance: float, dstates: int, views: int
) -> list[float]:
    """Compute the probability of each rival, given that one of them is true.

    The formula is in the docstring of this module. `chance` is the probability of the cheapest kind
    of fault, at each step. The numbers of dstates, N, and of views, V, count as at least 2.
    """
    cheapest = min(round(10 * price) for price in (theory.misread, theory.slipped) if price)
    per_dstate, per_view = math.log(max(dstates, 2)), math.log(max(views, 2))
    improbable = []  # the negative logarithm of each weight
    for rival in rivals:
        kinds = Counter(fault.kind for fault in rival.faults)
        improbable.append(
            -math.log(chance) * rival.cost[0] / cheapest
            + (len(rival.links) + kinds["slipped"]) * per_dstate
            + (kinds["misread"] + kinds["misseen"]) * per_view
        )
    least = min(improbable, default=0.0)
    weights = [math.exp(least - nats) for nats in improbable]
    total = sum(weights)
    return [weight / total for weight in weights]
