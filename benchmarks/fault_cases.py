"""Families of traces with known faults, and the cost of an explanation of a trace by labels.

>>> case = FAMILIES["rectangle n=400, 4 wrong views"].make(500)
>>> len(case.walk.trace), len(case.wrong), len(case.jumps)
(401, 4, 0)
"""

from __future__ import annotations

import random
from collections import Counter, defaultdict
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

import numpy as np
from instances import Walk, faulty_machine, maze
from suite import taylor_hall
from truth import partition

from ssh_abduction import Theory, Trace
from ssh_abduction.data import Odometry

PRICE = 1.5  # Cost of a fault of any kind, in dstates.
MARGIN = 5  # The first and last steps have no faults, as nothing could reveal them there.
RARE = 4  # A dstate with at most this many visits may be noise.
NOISE = Odometry(
    along=0.05, across=0.005, heading=0.002
)  # The odometry of the mazes with displacements, as in truth.py.

Faults = frozenset[tuple[int, str]]  # step and kind


@dataclass(frozen=True)
class Case:
    """A walk whose trace has faults.

    Attributes:
        walk: The trace, and the true states.
        wrong: Steps with a wrong view.
        jumps: Steps whose action jumped, which means that it led to another state than usual.
        misseen: Steps with a wrong star.
    """

    walk: Walk
    wrong: tuple[int, ...] = ()
    jumps: tuple[int, ...] = ()
    misseen: tuple[int, ...] = ()

    @property
    def faults(self) -> Faults:
        kinds = {"misread": self.wrong, "slipped": self.jumps, "misseen": self.misseen}
        return frozenset((step, kind) for kind, steps in kinds.items() for step in steps)

    @property
    def states(self) -> int:
        """The number of true states that the walk visits."""
        return len(set(self.walk.truth))


@dataclass(frozen=True)
class Family:
    """Cases of one kind.

    Attributes:
        make: Makes a case from a seed.
        theory: Theory to solve the cases under.
        optional: Whether the family is measured only if it is asked for.
    """

    make: Callable[[int], Case]
    theory: Theory
    optional: bool = False


@dataclass(frozen=True)
class Explanation:
    """An explanation of a trace.

    Attributes:
        labels: Label of the dstate of each step.
        faults: The fewest faults that the labels need: steps with their kind of fault.
        tenths: Cost of dstates and faults, in tenths of a dstate.
    """

    labels: tuple[Hashable, ...]
    faults: Faults
    tenths: int

    @classmethod
    def of(cls, trace: Trace, labels: Sequence[Hashable]) -> Explanation:
        """Make the explanation with these labels under the causal theory.

        A dstate shows its most frequent view, and an action leads to its most frequent end. All
        other views and ends are faults.
        """
        shows, leads = _read_off(trace, labels)
        misread = {
            (t, "misread")
            for t, (s, view) in enumerate(zip(labels, trace.views, strict=True))
            if shows[s] != view
        }
        slipped = {
            (t, "slipped")
            for t, ((s, x), a) in enumerate(zip(pairwise(labels), trace.actions, strict=True))
            if leads[s, a.name] != x
        }
        return cls(
            tuple(labels),
            frozenset(misread | slipped),
            10 * len(shows) + round(10 * PRICE) * len(misread | slipped),
        )

    def is_true(self, case: Case) -> bool:
        return is_true(self.labels, self.faults, case)


def is_true(labels: Sequence[Hashable], faults: Faults, case: Case) -> bool:
    """Check whether labels and faults are the true ones.

    Labels are compared up to renaming. Labels of steps with a wrong view are not compared.
    """
    kept = [t for t in range(len(labels)) if t not in case.wrong]
    return faults == case.faults and partition([labels[t] for t in kept]) == partition(
        [case.walk.truth[t] for t in kept]
    )


def _read_off(
    trace: Trace, labels: Sequence[Hashable]
) -> tuple[dict[Hashable, object], dict[tuple[Hashable, str], Hashable]]:
    views: defaultdict[Hashable, Counter[object]] = defaultdict(Counter)
    ends: defaultdict[tuple[Hashable, str], Counter[Hashable]] = defaultdict(Counter)
    for s, view in zip(labels, trace.views, strict=True):
        views[s][view] += 1
    for (s, x), a in zip(pairwise(labels), trace.actions, strict=True):
        ends[s, a.name][x] += 1
    return {s: n.most_common(1)[0][0] for s, n in views.items()}, {
        key: n.most_common(1)[0][0] for key, n in ends.items()
    }


def refined(trace: Trace, labels: Sequence[Hashable]) -> Explanation:
    """Improve labels to a cheaper explanation.

    Read the map off the labels, and give the steps the labels that need the fewest faults in that
    map. Also try the map without each of its rarely visited dstates. Repeat while the cost falls.
    """
    best = Explanation.of(trace, labels)
    while True:
        shows, leads = _read_off(trace, best.labels)
        rare = [s for s, visits in Counter(best.labels).items() if visits <= RARE]
        # Try the map as it is, then without each of its rare dstates.
        tried = (
            Explanation.of(
                trace, _laid_over(trace, {s: v for s, v in shows.items() if s != out}, leads)
            )
            for out in [None, *rare]
            if len(shows) > 1
        )
        better = next(
            (explanation for explanation in tried if explanation.tenths < best.tenths), None
        )
        if better is None:
            return best
        best = better


def _laid_over(
    trace: Trace, shows: dict[Hashable, object], leads: dict[tuple[Hashable, str], Hashable]
) -> list[Hashable]:
    """The labels of the steps of a trace with the fewest faults in a map (Viterbi 1967).

    Args:
        trace: The trace.
        shows: View of each dstate of the map.
        leads: Dstate that each action leads to, by dstate and name of the action.
    """
    names = list(shows)
    number = {s: i for i, s in enumerate(names)}
    seen = {
        view: np.array([PRICE * (shows[s] != view) for s in names]) for view in set(trace.views)
    }
    moves = {a: np.full((len(names), len(names)), PRICE) for a in {a.name for a in trace.actions}}
    for (s, a), x in leads.items():
        if s in number and x in number:
            moves[a][number[s], number[x]] = 0
    spent = seen[trace.views[0]]
    came = []
    for action, view in zip(trace.actions, trace.views[1:], strict=True):
        ways = spent[:, None] + moves[action.name]
        came.append(ways.argmin(axis=0))
        spent = ways.min(axis=0) + seen[view]
    labels = [int(spent.argmin())]
    for before in reversed(came):
        labels.append(int(before[labels[-1]]))
    return [names[i] for i in reversed(labels)]


def misread(walk: Walk, wrong: int, seed: int) -> Case:
    """Give a walk wrong views: at `wrong` of its steps, another view of the trace."""
    chance = random.Random(f"misread {seed}")
    steps = tuple(sorted(chance.sample(range(MARGIN, len(walk.trace) - MARGIN), wrong)))
    seen, views = list(walk.trace.views), sorted(set(walk.trace.views), key=str)
    for t in steps:
        seen[t] = chance.choice([view for view in views if view != seen[t]])
    return Case(replace(walk, trace=walk.trace.with_views(seen)), wrong=steps)


def machine(seed: int, *, jumps: bool) -> Case:
    """Make a walk of 200 steps in a random machine of 5 to 12 states and 4 to 9 views.

    It has 1 or 2 faults: jumps, or else wrong views.
    """
    chance = random.Random(f"size {seed}")
    states = chance.randint(5, 12)
    views, faults = chance.randint(4, min(9, states)), chance.randint(1, 2)
    return (
        sized(seed, states, views, 200, jumps=faults)
        if jumps
        else sized(seed, states, views, 200, wrong=faults)
    )


def sized(
    seed: int, states: int, views: int, steps: int, *, wrong: int = 0, jumps: int = 0
) -> Case:
    return Case(*faulty_machine(states, views, steps=steps, seed=seed, wrong=wrong, jumps=jumps))


def rectangle_of_five(seed: int, *, steps: int, wrong: int = 0, jumps: int = 0) -> Case:
    """Make circuits of a notched rectangle whose eight states show five views.

    Opposite corners look alike, except that one shows the notch before the turn. The actions
    alternate between right and travel. An action that jumps leads two states too far or two states
    back. A jump by half a circuit would not be visible until the notch is missing.

    Args:
        seed: Seed of the faults.
        steps: Number of actions.
        wrong: Number of wrong views.
        jumps: Number of jumps.
    """
    chance = random.Random(f"rectangle {seed}")
    jumped = tuple(sorted(chance.sample(range(MARGIN, steps - MARGIN), jumps)))
    truth = [0]
    for t in range(steps):
        truth.append((truth[-1] + 1 + (chance.choice((2, 6)) if t in jumped else 0)) % 8)
    views = ["v4" if s == 4 else f"v{s % 4}" for s in truth]
    trace = Trace.from_steps(
        views, [("right", "travel")[t % 2] for t in range(steps)], name=f"rectangle, seed {seed}"
    )
    return replace(misread(Walk(trace, tuple(truth)), wrong, seed), jumps=jumped)


def left_out(walk: Walk, chance: random.Random) -> tuple[Walk, int]:
    """Leave out a random step of a walk, as if an action had been done twice.

    Returns:
        The walk without the step, and the index of the step whose action now jumps.
    """
    t = chance.randrange(MARGIN, len(walk.trace) - MARGIN)
    steps = (*walk.trace.steps[:t], *walk.trace.steps[t + 1 :])
    return Walk(replace(walk.trace, steps=steps), (*walk.truth[:t], *walk.truth[t + 1 :])), t - 1


def star_turned(walk: Walk, steps: Iterable[int], chance: random.Random) -> Walk:
    """Give a walk wrong stars at some steps. One gateway of each star is added or removed."""
    changed = list(walk.trace.steps)
    for t in steps:
        openings = list(changed[t].openings or ())
        gateway = chance.randrange(len(openings))
        openings[gateway] = 1 - openings[gateway]
        changed[t] = replace(changed[t], star=tuple(openings))
    return replace(walk, trace=replace(walk.trace, steps=tuple(changed)))


def tour_of_taylor_hall(seed: int) -> Case:
    """Make a drive in Taylor Hall of about 240 images, with one fault of each kind.

    The faults are a wrong view, a wrong star, and an action that was done twice.
    """
    chance = random.Random(f"taylor hall {seed}")
    walk, jumped = left_out(taylor_hall(seed), chance)
    case = misread(walk, 1, seed)
    near = {jumped - 1, jumped, jumped + 1, *case.wrong}
    misseen = chance.choice([t for t in range(MARGIN, len(walk.trace) - MARGIN) if t not in near])
    return Case(star_turned(case.walk, [misseen], chance), case.wrong, (jumped,), (misseen,))


def large_maze(seed: int, share: float) -> Case:
    """Make a walk of 400 steps with stars and displacements in a maze of 6 x 6 cells.

    Args:
        seed: Seed of the maze, the walk and the faults.
        share: Share of the steps that have a fault. Half of the faults are wrong views, and half
            are wrong stars.
    """
    chance = random.Random(f"large {seed}")
    walk = maze(6, 6, steps=400, seed=seed, stars=True, follow=True, odometry=NOISE)
    faults = round(share * 400)
    case = misread(walk, faults - faults // 2, seed)
    misseen = tuple(
        sorted(
            chance.sample(
                [t for t in range(MARGIN, 400 - MARGIN) if t not in case.wrong], faults // 2
            )
        )
    )
    return replace(case, walk=star_turned(case.walk, misseen, chance), misseen=misseen)


CAUSAL = Theory.causal().replace(misread=PRICE, slipped=PRICE)
TOPOLOGICAL = Theory.topological().replace(misread=PRICE, slipped=PRICE)

FAMILIES = {
    "machines 5–12, 1 or 2 wrong views": Family(partial(machine, jumps=False), CAUSAL),
    "machines 5–12, 1 or 2 jumps": Family(partial(machine, jumps=True), CAUSAL),
    "rectangle n=400, 4 wrong views": Family(
        partial(rectangle_of_five, steps=400, wrong=4), CAUSAL
    ),
    "rectangle n=400, 4 jumps": Family(partial(rectangle_of_five, steps=400, jumps=4), CAUSAL),
    "rectangle n=4000, 40 wrong views": Family(
        partial(rectangle_of_five, steps=4000, wrong=40), CAUSAL
    ),
    "rectangle n=4000, 40 jumps": Family(partial(rectangle_of_five, steps=4000, jumps=40), CAUSAL),
    "machines 20/10 n=400, 4 wrong views": Family(
        partial(sized, states=20, views=10, steps=400, wrong=4), CAUSAL
    ),
    "machines 30/10 n=800, 8 wrong views": Family(
        partial(sized, states=30, views=10, steps=800, wrong=8), CAUSAL
    ),
    "mazes 3x3 n=600, 6 wrong views": Family(
        lambda seed: misread(maze(3, 3, steps=600, seed=seed), 6, seed), CAUSAL
    ),
    "Taylor Hall, 3 mixed faults": Family(tour_of_taylor_hall, TOPOLOGICAL, optional=True),
    "mazes 6x6 with stars and displacements, 1 % faults": Family(
        partial(large_maze, share=0.01), TOPOLOGICAL, optional=True
    ),
    "mazes 6x6 with stars and displacements, 5 % faults": Family(
        partial(large_maze, share=0.05), TOPOLOGICAL, optional=True
    ),
}
