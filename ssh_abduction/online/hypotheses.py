"""What may be true of a trace with faults while it grows: explanations that rival each other, and how probable each is.

A rival is a map of all steps so far, with its faults. With a new step it goes on in one way where it predicts the step, and else in each way that it allows:

    contradicted  the observation is misread, and the robot is where the link leads; or the action slipped, to each dstate that looks like that, or to a new one
    unknown       there is a link to each dstate that looks like that, or to a new one

Links to known dstates and new dstates are for the causal theory alone: where there are places and paths, only the axioms say what a new link may be.

Rivals are weighed. The price of a fault says how it compares with a dstate, and the cheapest kind is as probable as `Chances` of the localiser take a fault to be. What a price does not say is
how many ways there were: a link, and an action that slipped, leads to one of N dstates, and a view that is misread is one of V. So with λ for the logarithm of the odds that a dstate is worth,

    weight = exp(-λ cost) N^-(links and slips) V^-(misreadings)

and what happens after a fault decides between its explanations: each link that one of them has to assume, where another one predicts, is evidence against it.
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

Seen = tuple[
    object, object
]  # as `observation` returns it: the view, and the star where the theory uses stars
DSTATE = 10  # What a dstate costs, in tenths of dstates.


@dataclass(frozen=True, slots=True)
class Rival:
    """An explanation of all steps so far.

    map     a map of the first steps, or of all
    labels  the dstate of each step
    shows   what each dstate looks like
    links   where actions lead
    faults  what is disbelieved
    cost    the counts that the theory prefers, first to last
    """

    map: SSHMap
    labels: tuple[int, ...]
    shows: tuple[Seen, ...]
    links: Mapping[tuple[int, str], int]
    faults: tuple[Fault, ...]
    cost: tuple[int, ...]

    @classmethod
    def of(cls, ssh_map: SSHMap, trace: Trace, theory: Theory) -> Rival:
        """A map of the trace, or of its first steps, as a rival of others."""
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
        """The place of each dstate, if it has one."""
        return [s.place for s in self.map.dstates] + [None] * (
            len(self.shows) - len(self.map.dstates)
        )

    def explained(self) -> SSHMap:
        """The map of all steps, and its faults."""
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
        """The dstate that the action leads to, where that looks different; else None."""
        there = self.links.get((self.here, action))
        return None if there is None or self.shows[there] == seen else there

    def is_unknown(self, action: str) -> bool:
        """Whether the action was never tried here."""
        return (self.here, action) not in self.links

    def future(self) -> tuple[object, ...]:
        """What the map predicts from here on. It is the same for two maps that have the same dstates and links and the robot in the same dstate, by whichever names, however they
        explain what was; and it says nothing of dstates that cannot be reached from here but how many there are."""
        ends: dict[int, list[tuple[str, int]]] = {}
        for (s, action), x in self.links.items():
            ends.setdefault(s, []).append((action, x))
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
        """The rivals of one step more that this one becomes, those that cost nothing first."""
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
            doubted = [Fault(t, "misread", step.view, view, tenths / 10)] if view != seen[0] else []  # type: ignore[arg-type]
            doubted += [Fault(t, "misseen", cost=tenths / 10)] if star != seen[1] else []
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
        """The rival whose next step is at a dstate, with a link there, or the dstate, if they are new."""
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
    """What rivals are weighed with.

    odds     of a fault of the cheapest kind, as a logarithm: how improbable it is
    price    of that, in tenths of dstates
    dstates  how many there are, N
    views    how many there are, V
    """

    odds: float
    price: int
    dstates: int
    views: int

    @classmethod
    def of(cls, theory: Theory, chance: float, dstates: int, views: int) -> Scale:
        """For a theory with faults, of which the cheapest kind has this probability at each step."""
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
        """How probable each of these is, if one of them is true. They sum to 1."""
        improbable = [self.improbability(rival) for rival in rivals]
        least = min(improbable, default=0.0)
        weights = [math.exp(least - nats) for nats in improbable]
        total = sum(weights)
        return [weight / total for weight in weights]
