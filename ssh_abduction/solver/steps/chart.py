"""What the steps of a trace are to an engine that settles dstates by themselves: nodes, the links between them, and which nodes are apart.

To the causal theory each step is a node, and each action a link to the next. In a theory where places have frames (star=frame), a turn
rotates by known quarters: so the steps between two travels, a *visit*, are at one place, and those of a visit that face the same way are
one node, linked by rotations both ways. Nodes are apart if that follows from what was seen and done, as in `steps/apart.py`.

>>> from ssh_abduction import Theory, Trace
>>> from ssh_abduction.solver.steps.chart import Chart
>>> from ssh_abduction.solver.steps.log import Log
>>> star = [0, 0, 1, 0], [1, 0, 0, 0]
>>> trace = Trace.from_steps(["a", "b", "a"], ["around", "around"], stars=[star[0], star[1], star[0]])
>>> chart = Chart.framed(trace, Log(trace, Theory(star="frame")))
>>> chart.node_of, chart.links
((0, 1, 0), ((0, -2, 1), (1, -2, 0)))
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, TypeAlias

from ssh_abduction.data.trace import Trace, TurnDirection
from ssh_abduction.solver.steps.log import Log
from ssh_abduction.theory.pairs import Earlier

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from ssh_abduction.solver.steps.apart import Continuations

Link: TypeAlias = tuple[int, int, int]  # node, action, node
QUARTERS: dict[TurnDirection | None, int] = {"right": 1, "around": 2, "left": 3}


@dataclass(frozen=True)
class Chart:
    """Nodes, numbered by the first step at them, and links.

    seen      the observation at each node
    links     node, action, node. A rotation by J quarters is the action -J
    node_of   the node of each step
    excluded  pairs of nodes that are not one dstate, as evidence says
    """

    seen: tuple[int, ...]
    links: tuple[Link, ...]
    node_of: Sequence[int]
    excluded: frozenset[tuple[int, int]] = field(default=frozenset(), kw_only=True)

    @staticmethod
    def of_steps(log: Log, size: int) -> Chart:
        """The chart of the first steps, each a node."""
        links = tuple((t, log.actions[t], t + 1) for t in range(size - 1))
        return Chart(
            tuple(log.seen[:size]),
            links,
            range(size),
            excluded=frozenset(_pairs_within(log.pairs.apart, size)),
        )

    def apart(self) -> NDArray[np.bool_]:
        """Which pairs of nodes are apart: nodes x nodes."""
        return self.continuations.apart()

    @cached_property
    def continuations(self) -> Continuations:
        """How the trace goes on from each node."""
        from ssh_abduction.solver.steps.apart import Continuations  # loads numpy

        return Continuations(self.seen, [action for _, action, _ in self.links], self.excluded)

    def is_map(self, labels: Sequence[int]) -> bool:
        """Whether the labels of all nodes are those of a map: each dstate shows one view, and each action leads to one dstate.

        Nor is any pair of nodes one dstate that evidence excludes.
        """
        view: dict[int, int] = {}
        leads: dict[tuple[int, int], int] = {}
        return (
            min(labels) >= 0
            and all(
                view.setdefault(label, seen) == seen
                for label, seen in zip(labels, self.seen, strict=True)
            )
            and all(
                leads.setdefault((labels[t], action), labels[u]) == labels[u]
                for t, action, u in self.links
            )
            and all(labels[i] != labels[j] for i, j in self.excluded)
        )

    @staticmethod
    def turned(trace: Trace, log: Log, size: int) -> FramedChart | None:
        """The chart of the first steps, as if places had frames. What is seen ahead, right, back and left takes the place of stars.

        This is a guess, as the causal theory does not say that turns rotate. None where some action is neither turn nor travel, or where
        what is seen after a turn does not follow from what was seen before.
        """
        around = Chart.around(trace, log, size)
        return None if around is None else Chart.framed(trace, log, size, around)

    @staticmethod
    def around(trace: Trace, log: Log, size: int) -> dict[int, list[int]] | None:
        """For each observation, what is seen ahead, right, back and left of where it is seen ahead, as turns show. None as `turned` says."""
        after: dict[
            tuple[int, int], int
        ] = {}  # what is seen after a turn, by what was seen before it and the quarters to the right
        for action, before, then in zip(
            trace.actions[: size - 1], log.seen, log.seen[1:], strict=False
        ):
            if action.kind is None:
                return None
            if action.turn:
                quarters = QUARTERS[action.turn]
                if (
                    after.setdefault((before, quarters), then) != then
                    or after.setdefault((then, 4 - quarters), before) != before
                ):
                    return None
        found: dict[int, list[int]] = {}
        for seen in dict.fromkeys(log.seen[:size]):
            views = _views_around(seen, after)
            if views is None:
                return None
            found[seen] = views
        return found

    @staticmethod
    def framed(
        trace: Trace,
        log: Log,
        size: int | None = None,
        around: Mapping[int, Sequence[int]] | None = None,
    ) -> FramedChart | None:
        """The chart of the first steps (default all), where places have frames. None where some visit fits no frame: then there is no map.

        around  in the place of stars: for each observation, what is seen ahead, right, back and left of where it is seen ahead
        """
        size = len(trace) if size is None else size
        node: dict[tuple[int, int], int] = {}
        seen: list[int] = []
        node_of: list[int] = []
        stars: list[
            tuple[int, ...]
        ] = []  # of each visit, in a frame whose slot 0 the robot faces as it arrives
        travels: list[tuple[int, int, int]] = []
        visit = slot = 0
        for t in range(size):
            if (
                t and (action := trace.actions[t - 1]).kind != "turn"
            ):  # a travel, or nothing is known of where it led
                visit, slot = visit + 1, 0
            elif t:
                slot = (slot + QUARTERS[action.turn]) % 4
            openings = (trace.steps[t].openings if around is None else around[log.seen[t]]) or ()
            star = tuple(int(openings[(k - slot) % 4]) for k in range(4))
            if visit == len(stars):
                stars.append(star)
            if (here := node.setdefault((visit, slot), len(seen))) == len(seen):
                seen.append(log.seen[t])
            if seen[here] != log.seen[t] or stars[visit] != star:
                return None
            node_of.append(here)
            if t and action.kind != "turn":
                travels.append((node_of[-2], log.actions[t - 1], here))
        rotations = [
            (s, -((k - j) % 4), x)
            for (v, j), s in node.items()
            for k in range(4)
            if k != j and (x := node.get((v, k))) is not None
        ]
        links = sorted([*travels, *rotations], key=lambda link: max(link[0], link[2]))
        facing = tuple(node)
        away = {(node_of[i], node_of[j]) for i, j in _pairs_within(log.pairs.elsewhere, size)}
        excluded = {
            (node_of[i], node_of[j]) for i, j in _pairs_within(log.pairs.apart, size)
        } - away
        if any(i == j for i, j in excluded) or any(facing[i][0] == facing[j][0] for i, j in away):
            return None
        return FramedChart(
            tuple(seen),
            tuple(links),
            tuple(node_of),
            facing,
            tuple(stars),
            tuple(travels),
            frozenset(away),
            frozenset(away),
            excluded=frozenset(excluded),
        )


@dataclass(frozen=True)
class FramedChart(Chart):
    """A chart of visits.

    facing     the visit and the slot of each node; a slot counts quarters clockwise from how the robot faced as it arrived
    stars      what is open at each visit, by slot; or what is seen there, by slot
    travels    the links that are travels, in order: travel V leads from visit V to visit V + 1. An action that slipped stands among them, as one that is done once
    elsewhere  pairs of nodes known to be at different places
    away       those of these pairs that evidence names
    """

    facing: tuple[tuple[int, int], ...]
    stars: tuple[tuple[int, ...], ...]
    travels: tuple[Link, ...]
    elsewhere: frozenset[tuple[int, int]] = frozenset()
    away: frozenset[tuple[int, int]] = frozenset()

    def with_elsewhere(self, more: Iterable[tuple[int, int]]) -> FramedChart:
        """The same chart, where these nodes, too, are known to be at different places."""
        return replace(self, elsewhere=self.elsewhere | frozenset(more))

    def __getstate__(self) -> dict[str, object]:
        """What is sent to another process: the fields, without the large arrays that are computed from them."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def apart(
        self, most: int | None = None, others: Sequence[int] | None = None
    ) -> NDArray[np.bool_]:
        """Which pairs of nodes are apart: nodes x others. Two nodes are apart if their visits misfit when turned so that the two nodes face one slot.

        most    only the first so many nodes (default all)
        others  the nodes that they are compared with (default the same ones)
        """
        import numpy as np

        facing = np.asarray(self.facing[:most])
        visits, slots = facing.T
        other_visits, other_slots = (facing if others is None else facing[list(others)]).T
        apart = np.empty((len(visits), len(other_visits)), dtype=bool)
        for slot in range(4):
            rows = np.flatnonzero(slots == slot)
            for other_slot in range(4):
                columns = np.flatnonzero(other_slots == other_slot)
                apart[np.ix_(rows, columns)] = self.misfits[(other_slot - slot) % 4][
                    np.ix_(visits[rows], other_visits[columns])
                ]
        apart |= (visits[:, None] == other_visits) & (slots[:, None] != other_slots)
        return apart

    @cached_property
    def leaves(self) -> dict[int, tuple[int, int]]:
        """For each visit but the last, the slot that it ends at, and the action there, which leads to the next visit."""
        return {
            visit: (self.facing[node][1], action)
            for visit, (node, action, _) in enumerate(self.travels)
        }

    def turns(self, trace: Trace) -> list[tuple[int, str, int]]:
        """The turns of the trace from node to node, as (node, direction, node), each once, in the order of the trace."""
        steps = zip(pairwise(self.node_of), trace.actions, strict=False)
        return list(dict.fromkeys((s, action.turn, x) for (s, x), action in steps if action.turn))

    def beginning(self, visits: int) -> FramedChart:
        """The chart of the first so many visits."""
        nodes = next(
            (node for node, (visit, _) in enumerate(self.facing) if visit == visits),
            len(self.facing),
        )
        steps = next(
            (step for step, node in enumerate(self.node_of) if node >= nodes), len(self.node_of)
        )
        links = tuple(link for link in self.links if max(link[0], link[2]) < nodes)
        elsewhere, away, excluded = (
            frozenset(pair for pair in pairs if max(pair) < nodes)
            for pairs in (self.elsewhere, self.away, self.excluded)
        )
        return FramedChart(
            self.seen[:nodes],
            links,
            self.node_of[:steps],
            self.facing[:nodes],
            self.stars[:visits],
            self.travels[: visits - 1],
            elsewhere,
            away,
            excluded=excluded,
        )

    def visits_with(self, pairs: int) -> int:
        """The most visits, from the first on, among which at most so many pairs may be at one place."""
        import numpy as np

        return int(np.searchsorted(self.fitting, pairs, side="right")) - 1

    @cached_property
    def fitting(self) -> NDArray[np.int_]:
        """For each number of visits, from 0 to all: how many pairs `fits` would list of that many first visits. There may be too many to list them."""
        import numpy as np

        return np.cumsum([0, *np.count_nonzero(np.triu(~self.misfits, 1), axis=(0, 1))])

    def fits(self, visits: Sequence[int]) -> list[tuple[int, int, int]]:
        """The pairs of these visits that may be at one place, as (I, J, R) with I < J: slot 0 of visit I is then slot R of visit J.

        visits  in order
        """
        import numpy as np

        some = np.asarray(visits)
        turns, first, second = np.nonzero(np.triu(~self.misfits[:, some[:, None], some], 1))
        return list(zip(some[first].tolist(), some[second].tolist(), turns.tolist(), strict=True))

    @cached_property
    def misfits(self) -> NDArray[np.bool_]:
        """R x I x J, for R in 0 to 3 and visits I and J: whether they cannot be at one place so that slot 0 of I is slot R of J.

        Two visits misfit where they show different things, where evidence says so, or where the same action, done facing the same way, leads to visits that
        misfit as they arrive. So this is worked out from the last visit to the first.
        """
        import numpy as np

        visits = len(self.stars)
        views = np.full((visits, 4), -1)
        for (visit, slot), seen in zip(self.facing, self.seen, strict=True):
            views[visit, slot] = seen
        number: dict[tuple[int, ...], int] = {}
        # stars[r] numbers the star of each visit as it looks from slot r of the visit
        stars = [
            np.array([number.setdefault(star[r:] + star[:r], len(number)) for star in self.stars])
            for r in range(4)
        ]
        leaves = np.full(visits, -1)  # the slot that a visit ends at, none for the last
        action = np.full(visits, -1)
        for visit, (slot, done) in self.leaves.items():
            leaves[visit], action[visit] = slot, done
        misfits = np.zeros((4, visits, visits), dtype=bool)
        for s, x in self.elsewhere:
            misfits[:, self.facing[s][0], self.facing[x][0]] = misfits[
                :, self.facing[x][0], self.facing[s][0]
            ] = True
        for s, x in self.excluded:
            (i, faced), (j, other) = self.facing[s], self.facing[x]
            if i != j:
                misfits[(other - faced) % 4, i, j] = misfits[(faced - other) % 4, j, i] = True
        for i in range(visits - 1, -1, -1):
            for r in range(4):
                row = misfits[r, i]
                row |= stars[r] != stars[0][i]
                for slot in np.flatnonzero(views[i] >= 0).tolist():
                    there = views[:, (slot + r) % 4]
                    row |= (there >= 0) & (there != views[i, slot])
                if i < visits - 1:
                    alike = ((leaves[i] + r) % 4 == leaves) & (action == action[i])
                    row[:-1] |= alike[:-1] & misfits[0, i + 1, 1:]
        return misfits


def _pairs_within(earlier: Earlier, size: int) -> list[tuple[int, int]]:
    """The pairs both steps of which are among the first `size`, the earlier step first."""
    return [(i, t) for t, others in earlier.items() if t < size for i in others]


def numbered(labels: Iterable[Hashable]) -> list[int]:
    """Labels, numbered by the first step at each."""
    number: dict[Hashable, int] = {}
    return [number.setdefault(label, len(number)) for label in labels]


def _views_around(seen: int, after: Mapping[tuple[int, int], int]) -> list[int] | None:
    """What is seen ahead, right, back and left of where this is seen ahead. None where turns do not tell, or contradict each other.

    after  what is seen after a turn, by what was seen before it and by how many quarters to the right it turned
    """
    views = {0: seen}
    waiting = [0]
    while waiting:
        here = waiting.pop()
        for quarters in QUARTERS.values():
            there = (here + quarters) % 4
            if (then := after.get((views[here], quarters))) is None:
                continue
            if there not in views:
                waiting.append(there)
            if views.setdefault(there, then) != then:
                return None
    return [views[slot] for slot in range(4)] if len(views) == 4 else None
