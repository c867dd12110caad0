"""Rival explanations of a trace with faults while it grows, and the probability of each.

A rival is a map of all steps so far, with its faults. If it predicts a new step it goes on in
one way. If it does not, it goes on in each way that it allows:

    contradicted  the observation is misread, and the robot is where the link leads; or the action
                  slipped, to each dstate that looks like this, or to a new one
    unknown       a new link leads to each dstate that looks like this, or to a new one

Links to known dstates and new dstates are for the causal theory alone. If there are places and
paths, only the axioms say what a new link may be.

Rivals are weighed. The price of a fault says how it compares with a dstate, and the cheapest kind
has the probability of a fault in `Chances` of the localiser. A price does not say how many ways
there were: a link, and an action that slipped, leads to one of N dstates, and a misread view is one
of V. Let λ be the logarithm of the odds that a dstate is worth. Then

    weight = exp(-λ cost) N^-(links and slips) V^-(misreadings)

What happens after a fault decides between its explanations: a link that one explanation has to
assume and another one predicts is evidence against the first.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from ssh_abduction.data.maps import DState, Fault, SSHMap
from ssh_abduction.data.trace import Step, Trace
from ssh_abduction.solver import Cost, observation
from ssh_abduction.theory.theory import Theory

# As `observation` returns it: the view, and the star (openings) if used.
Seen = tuple[object, object]
# What a dstate costs, in tenths of dstates.
DSTATE = 10


@dataclass(frozen=True, slots=True)
class Rival:
    """An explanation of all steps so far.

    Attributes:
        map: A map of the first steps, or of all.
        labels: The dstate of each step.
        shows: What each dstate looks like.
        links: The dstate that an action leads to, by dstate and action.
        faults: What is ignored.
        cost: The counts that the theory prefers, first to last.
    """

    map: SSHMap
    labels: tuple[int, ...]
    shows: tuple[Seen, ...]
    links: Mapping[tuple[int, str], int]
    faults: tuple[Fault, ...]
    cost: tuple[int, ...]

    @classmethod
    def of(cls, ssh_map: SSHMap, trace: Trace, theory: Theory) -> Rival:
        """A map of the trace, or of its first steps, as a rival."""
        wrong = {fault.step for fault in ssh_map.faults if fault.kind != "slipped"}
        looks: dict[int, Seen] = {}
        for t, label in enumerate(ssh_map.labels):
            if t not in wrong:
                looks.setdefault(label, observation(trace.steps[t], theory))
        shows = tuple(looks.get(s.id, (s.view, None)) for s in ssh_map.dstates)
        links = {(s, action): x for s, action, x in ssh_map.links}
        return cls(
            ssh_map,
            ssh_map.labels,
            shows,
            links,
            ssh_map.faults,
            Cost.of(ssh_map).preferred_by(theory),
        )

    @property
    def here(self) -> int:
        """The dstate that the robot is in."""
        return self.labels[-1]

    @property
    def places(self) -> list[int | None]:
        """The place of each dstate; None if it has none."""
        known = self.map.dstates
        return [s.place for s in known] + [None] * (len(self.shows) - len(known))

    def explained(self) -> SSHMap:
        """The map of all steps, with its faults."""
        if len(self.map.labels) == len(self.labels):
            return self.map
        known = self.map.dstates
        new = (DState(s, self.shows[s][0]) for s in range(len(known), len(self.shows)))  # type: ignore[arg-type]
        links = self.map.links
        if len(links) < len(self.links):
            links = tuple(sorted((s, action, x) for (s, action), x in self.links.items()))
        faults = tuple(sorted(self.faults, key=lambda fault: (fault.step, fault.kind)))
        return replace(
            self.map,
            labels=self.labels,
            dstates=(*known, *new),
            links=links,
            faults=faults,
            fit=None,
        )

    def contradiction(self, action: str, seen: Seen) -> int | None:
        """The dstate that an action leads to, if it looks different from `seen`; else None."""
        there = self.links.get((self.here, action))
        return None if there is None or self.shows[there] == seen else there

    def is_unknown(self, action: str) -> bool:
        """Whether an action was never tried at the robot's dstate."""
        return (self.here, action) not in self.links

    def future(self) -> tuple[object, ...]:
        """The predictions of the map from here on, as a value to compare two maps.

        It is equal for maps that agree on dstates, links and where the robot is, up to renaming,
        however they explain the past. Of unreachable dstates it holds only the number.
        """
        ends: dict[int, list[tuple[str, int]]] = {}
        for (s, action), x in self.links.items():
            ends.setdefault(s, []).append((action, x))
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

    def ways_on(self, action: str, step: Step, seen: Seen, theory: Theory) -> Iterator[Rival]:
        """The rivals that this one becomes with one more step; those that cost nothing come first.

        Args:
            action: The name of the action before the step.
            step: The step.
            seen: What the step shows.
            theory: The theory without `auto`.
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
        if self.shows[there] == seen:
            yield self._to(there)
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
    ) -> Rival:
        """The rival whose next step is at the dstate `there`.

        Args:
            there: The dstate of the step.
            link: The action of a new link to it, if there is one.
            new: What the dstate shows, if it is new.
            faults: What is ignored besides.
            tenths: What these faults cost, in tenths of dstates.
        """
        tenths += DSTATE if new else 0
        return Rival(
            self.map,
            (*self.labels, there),
            (*self.shows, new) if new else self.shows,
            {**self.links, (self.here, link): there} if link else self.links,
            (*self.faults, *faults),
            (self.cost[0] + tenths, *self.cost[1:]) if tenths else self.cost,
        )


@dataclass(frozen=True, slots=True)
class Scale:
    """Weighs rivals.

    Attributes:
        odds: Negative logarithm of the probability of a fault of the cheapest kind, in nats.
        price: What such a fault costs, in tenths of dstates.
        dstates: Number N of dstates.
        views: Number V of views.
    """

    odds: float
    price: int
    dstates: int
    views: int

    @classmethod
    def of(cls, theory: Theory, chance: float, dstates: int, views: int) -> Scale:
        """The scale for a theory whose cheapest fault has the probability `chance` at each step."""
        cheapest = min(round(10 * price) for price in (theory.misread, theory.slipped) if price)
        return cls(-math.log(chance), cheapest, max(dstates, 2), max(views, 2))

    def improbability(self, rival: Rival) -> float:
        """The negative logarithm of the weight, in nats."""
        kinds = Counter(fault.kind for fault in rival.faults)
        ways = (len(rival.links) + kinds["slipped"]) * math.log(self.dstates)
        return (
            self.odds * rival.cost[0] / self.price
            + ways
            + (kinds["misread"] + kinds["misseen"]) * math.log(self.views)
        )

    def shares(self, rivals: Sequence[Rival]) -> list[float]:
        """The probability of each rival, if one of them is true. They sum to 1."""
        improbable = [self.improbability(rival) for rival in rivals]
        least = min(improbable, default=0.0)
        weights = [math.exp(least - nats) for nats in improbable]
        total = sum(weights)
        return [weight / total for weight in weights]
