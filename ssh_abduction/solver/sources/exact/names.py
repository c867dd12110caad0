"""Finds labels with the fewest dstates, for theories without frames.

A label is the number of the dstate of a step. This module finds labels of the first steps with the
fewest dstates, proves that none have fewer, and lists all labels with that number of dstates.

The search works with names. Clingo assigns a name, which is a dstate, to each step. Pairwise
distinct steps, a clique (`steps/apart.py`), are *pinned*: each gets a name of its own. Their number
is a lower bound on the dstates. Pinning leaves only one way to name these dstates. Any other step
may have the name of a pinned step that it can share a dstate with, or a *spare* name of its view. A
spare name costs one dstate. Each view also has a *rest*, one name that all its other dstates share.
If there are several largest cliques, pin the one with which the other steps have the fewest names
to choose from.

*Claim.* An answer of minimal cost that uses no rest is a minimal map.
*Proof.* Name the dstates of any map. The pinned steps have their names. The other dstates get spare
names of their view, while there are any, and then the rest. These names satisfy each rule of
names.lp, as the rules say nothing about steps that are named by a rest. They use no more spare
names than the map has dstates beyond the clique. So the minimal cost of answers is a lower bound on
the cost of maps. An answer without a rest is a map of the trace with its cost. ∎
If a minimal answer uses a rest, its view gets one more spare name, and clingo is asked again.

Not every step is needed. Clingo starts with the links of the pinned steps. Each answer is followed
along the trace, and the links that it does not explain are added, until it explains all links
(`name_program.py`). If clingo does not answer soon, it gets all links, or some at a time if the
trace is long. A very long trace is charted only up to a step at which the clique is as large as the
clique of all steps.

Clasp raises the lower bound by one for each core. A core is a set of spare names, and at least one
of them is needed. Cores are small at first, as views share no names. If that takes long in the
causal theory, small maps are also looked for in other ways: first steps are merged, later dstates
are guessed. The search ends as soon as some map has as few dstates as the bound.

While a map is made from one answer, clingo searches for the next.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Generator, Iterable, Iterator, Sequence
from itertools import islice

from ssh_abduction.data.groups import numbered
from ssh_abduction.solver.asp.control import Asker
from ssh_abduction.solver.asp.limits import LimitError
from ssh_abduction.solver.sources.exact.engine import AT_ONCE, Task
from ssh_abduction.solver.sources.exact.fitting import Member
from ssh_abduction.solver.sources.exact.name_program import (
    NameProgram,
    Pinned,
    forbidden_links,
    read_names,
)
from ssh_abduction.solver.sources.symbolic.merging import dstates_merged, merged
from ssh_abduction.solver.sources.symbolic.state_merging import machine_labels
from ssh_abduction.solver.steps.apart import Continuations
from ssh_abduction.solver.steps.chart import Chart, Link
from ssh_abduction.theory.evidence import Equality
from ssh_abduction.theory.pairs import pairs_in

# Before clingo has all links, any answer may show that a link is missing. So hold back the maps of
# a list until it is complete. If it has this many maps, give clingo all links instead, and then
# yield each map at once.
HELD_BACK = 100
# A view has this many spare names at first: one to use, and one to show that no more are needed.
SPARES = 2
# Of a long trace whose clique grows, take at most this many steps at once. The clique of more steps
# would take minutes.
WHOLE = 100_000
# Stop after this many guesses, even if none of them is a map. Guesses are slow, and later ones are
# rarely better.
GUESSES = 10


class NamedLabels:
    """Finds labels (dstates of steps) with the fewest dstates, for the first `size` steps."""

    def __init__(
        self,
        task: Task,
        asker: Asker,
        given_map: Sequence[int] = (),
    ) -> None:
        """Begin without any steps.

        `given_map` has the dstate of each step in a map with few dstates; empty if none is known.
        """
        self.size = 0
        self.task, self._asker, self._given_map = task, asker, given_map
        self._incumbent = Incumbent()
        # Sets of pairs of steps. A map must not have the steps of each pair of a set at one dstate.
        self._forbidden: list[list[tuple[int, int]]] = []
        self._pinned: Pinned | None = None
        self._program: NameProgram | None = None
        self._search: NameSearch | None = None

    @property
    def bound(self) -> int | None:
        """A proven lower bound on the number of dstates; None if none is known."""
        return self._incumbent.bound

    @property
    def clique(self) -> Sequence[int]:
        """The pinned steps, which are pairwise distinct; empty before `grow`."""
        return self._pinned.clique if self._pinned else []

    @property
    def program(self) -> NameProgram:
        """The control that assigns names of dstates to steps."""
        assert self._program is not None  # `grow` comes first
        return self._program

    @property
    def chart(self) -> Chart:
        """The first steps and the links between them."""
        return self.program.chart

    def large_enough(self, size: int) -> int:
        """Return how many steps of the trace to take: at least `size`.

        In a long trace this is enough for a clique as large as the clique of the whole trace.
        """
        most = min(len(self.task.trace), WHOLE)
        if AT_ONCE <= size < most and self.task.speedups.clique:
            largest = self._clique_size(most)
            while size < most and self._clique_size(size) < largest:
                size = min(2 * size, most)
        return size

    def _clique_size(self, steps: int) -> int:
        """Return the size of a largest clique of the first steps."""
        log = self.task.log
        return len(Continuations(log.seen[:steps], log.actions[: steps - 1]).clique())

    def grow(self, size: int) -> bool:
        """Make the first `size` steps the prefix. Return True, as there are always labels."""
        try:
            self._take(size)
        except BaseException:
            self.size = 0  # an error may have left this prefix incomplete
            raise
        return True

    def _take(self, size: int) -> None:
        """Chart the first steps, pin a clique of them, and make a new control."""
        self.size = size
        speedups, known = self.task.speedups, self._incumbent
        with self._asker.grounding_timed():
            pinned = Pinned.of_steps(self.task.log, size, largest=speedups.clique)
        self._pinned = pinned
        known.labels = numbered(self._given_map[:size]) or None
        known.raise_bound(len(pinned.clique))
        self._asker.watch.check()
        self._program = NameProgram(
            self.task,
            self._asker,
            pinned,
            self._first_spares(pinned),
            self._forbidden,
        )
        self._search = NameSearch(self.task, self._asker, self._program, known)
        links: Iterable[Link] = pinned.chart.links
        if speedups.lazy:
            # Only links that begin at the first step or at a pinned one, and those at steps that
            # the user says are one dstate.
            first = {0, *pinned.clique}
            said = {t for pair in pairs_in(self.task.log.pairs.one) for t in pair}
            links = [link for link in links if link[0] in first or not said.isdisjoint(link[::2])]
        self._program.give_links(links)

    def _first_spares(self, pinned: Pinned) -> dict[int, int]:
        """Return the numbers of spare names: SPARES, or one more than the given map needs."""
        seen = pinned.chart.seen
        found = Counter(dict(zip(self._given_map, seen, strict=False)).values())
        taken = Counter(seen[node] for node in pinned.clique)
        return {
            view: max(SPARES, found[view] - taken[view] + 1) if self._given_map else SPARES
            for view in dict.fromkeys(seen)
        }

    def improving(self) -> Iterator[list[int]]:
        """Yield labels of the first steps, with ever fewer dstates. The last have the fewest."""
        assert self._search is not None  # `grow` comes first
        return self._search.improving()

    def take_back(self, labels: Sequence[int]) -> bool:
        """Forget labels that turned out to have no map. Return whether they came from clingo.

        Evidence about places may refuse the places of a given map.
        """
        known = self._incumbent
        given, self._given_map = numbered(self._given_map[: self.size]), ()
        if known.labels == list(labels):
            known.labels = None
        return list(labels) != given

    def give_sides(
        self, labels: Sequence[int], contrary: Sequence[int], twice: Sequence[int]
    ) -> bool:
        """Give clingo the axioms of paths that labels contradict. Return whether any are new."""
        return self.program.give_sides(contrary)

    def forbid(self, labels: Sequence[int], clashes: Iterable[Sequence[Member]]) -> None:
        """Exclude all labels with the links of some clash, and with these labels of its steps."""
        for clash in clashes:
            placed = {step for member in clash if not member.link for step in member.steps}
            links = [member.link for member in clash if member.link]
            self.program.add_links_at(placed)
            self._asker.control.tell(
                forbidden_links(links, [(step, labels[step]) for step in sorted(placed)])
            )

    def forbid_together(self, equalities: Collection[Equality]) -> None:
        """Exclude labels in which both steps of each of these equalities are at one dstate.

        Steps at one dstate are also at one place.
        """
        self._forbidden.append([(one.first, one.second) for one in equalities])
        known = self._incumbent
        if known.labels and not self.program.is_allowed(known.labels):
            known.labels = None
        self.program.give_forbidden(len(self._forbidden) - 1)

    def all_of(self, dstates: int, enough: int) -> Generator[list[int], None, None]:
        """Yield each labelling with this number of dstates once. A known labelling comes first.

        Clingo is asked for at most `enough` labellings; 0 for all. It is not asked if `enough` is 1
        and a labelling is known.
        """
        known = self._incumbent.labels
        if known and len(set(known)) != dstates:
            known = None
        if known:
            yield known
        if not known or enough != 1:
            first = numbered(known or ())
            yield from (
                labels for labels in self._listed(dstates, enough) if numbered(labels) != first
            )

    def _listed(self, dstates: int, enough: int) -> Iterator[list[int]]:
        """Yield labels with this many dstates, in the order in which clingo lists them."""
        program, spares = self.program, dstates - len(self.clique)
        if spares < 0:
            return
        if not program.chart.links:
            yield [0]
            return
        while True:
            # Ask this again after nodes were added, as their names may be rests.
            while not enough and self._needs_rest(spares):
                pass
            held: list[list[int]] = []
            failed: Iterable[Link] = ()
            lazy = not program.has_all_links
            try:
                for answer in self._answers_of(spares):
                    labels, failed = program.follow(answer)
                    if failed:
                        break
                    held.append(labels)
                    if enough:
                        if len(held) == enough:
                            yield from held
                            return
                    elif not lazy:
                        yield held.pop()
                    elif len(held) == HELD_BACK:
                        failed = program.chart.links
                        break
            except LimitError:
                yield from held  # these are minimal, and explain all links
                raise
            if failed:
                program.add(failed)
            elif not enough or not self._needs_rest(spares):
                yield from held
                return

    def _needs_rest(self, spares: int) -> bool:
        """Look for an answer of this cost that uses a rest. If found, add names to its views."""
        answers = self._asker.answers(
            read_names,
            f"enum,{spares},{spares}",
            1,
            assumptions=[self.program.resting(True)],
        )
        answer = next(answers, None)
        views = self.program.rests(answer) if answer else set()
        if views:
            self.program.name_more(views)
        return bool(views)

    def _answers_of(self, spares: int) -> Iterator[dict[int, int]]:
        """Yield all answers without rests that use this many spare names."""
        resting, mode = self.program.resting(False), f"enum,{spares},0"
        return self._asker.answers(read_names, mode, 0, assumptions=[resting], ahead=True)


# If clingo has not ended after this many conflicts, give it more links. If it lacks links that
# matter, this mostly shows sooner.
PATIENCE = 2000
# After this many conflicts with all links, guess a map. Then clingo continues without a limit.
CORES = 10_000


class Incumbent:
    """The best known labels of all steps, and a lower bound on the number of dstates.

    Both are None while unknown.
    """

    def __init__(self) -> None:
        """Begin with no known labels (dstates of steps) and no bound."""
        self.bound: int | None = None
        self.labels: list[int] | None = None

    def raise_bound(self, bound: int) -> None:
        """Take over a bound if it is higher than the known one."""
        self.bound = max(self.bound or 0, bound)

    def is_settled(self) -> bool:
        """Whether the known labels have as few dstates as the lower bound."""
        return self.labels is not None and len(set(self.labels)) <= (self.bound or 0)


class NameSearch:
    """The search for labels of the nodes of one chart with the fewest dstates."""

    def __init__(
        self,
        task: Task,
        asker: Asker,
        program: NameProgram,
        incumbent: Incumbent,
    ) -> None:
        """Prepare a search that improves the incumbent."""
        self._task, self._asker, self._program = task, asker, program
        self._incumbent = incumbent
        self._hard = False  # whether clingo once did not end after few conflicts
        self._had_all_help = False  # whether maps near a guess were sought already

    def improving(self) -> Iterator[list[int]]:
        """Yield labels of all steps, with ever fewer dstates. The last have the fewest."""
        known = self._incumbent
        if not self._program.chart.links:
            yield [0]
            return
        try:
            for labels in self._searched():
                if self._program.is_allowed(labels):
                    known.labels = labels
                    yield labels
        except (LimitError, KeyboardInterrupt) as end:
            if known.labels:
                yield known.labels
            if isinstance(end, KeyboardInterrupt) or not known.is_settled():
                raise

    def _searched(self) -> Iterator[list[int]]:
        """Yield labels as `improving` does. End early if a known map has the fewest dstates."""
        labels = None
        while labels is None and (names := (yield from self._cheapest_answer())) is not None:
            labels = self._labels_by(names)
        if best := labels or self._incumbent.labels:
            yield best

    def _cheapest_answer(self) -> Generator[list[int], None, dict[int, int] | None]:
        """Find the cheapest answer for the links that clingo has; None if a known map is as good.

        If the search takes long, labels that were found in other ways are yielded.
        """
        while True:
            names, proven = self._cheapest(self._patience)
            if proven:
                return names  # None if what the user says contradicts the trace
            yield from self._helped()
            if self._incumbent.is_settled():
                return None
            self._program.add(self._program.more_links())

    def _cheapest(self, conflicts: int) -> tuple[dict[int, int] | None, bool]:
        """Find the best answer within a number of conflicts, and whether it is proven the best."""
        pinned = len(self._program.pinned.clique)
        answer = None
        answers = self._asker.answers(
            read_names,
            "opt",
            0,
            conflicts=conflicts,
            on_bound=lambda costs: self._incumbent.raise_bound(pinned + costs[0]),
            until=self._incumbent.is_settled,
        )
        while True:
            try:
                answer = next(answers)
            except StopIteration as end:
                return answer, bool(end.value)

    def _labels_by(self, names: dict[int, int]) -> list[int] | None:
        """Return labels from an answer. If they are no map, give clingo the missing links."""
        program = self._program
        if views := program.rests(names):
            program.name_more(views)
            return None
        pinned = len(program.pinned.clique)
        spares = sum(name >= pinned for name in set(names.values()))
        self._incumbent.raise_bound(pinned + spares)
        labels, failed = program.follow(names)
        if failed:
            program.add(failed)
            return None
        return labels

    @property
    def _patience(self) -> int:
        """The number of conflicts after which to interrupt clingo; -1 for never."""
        if not self._program.has_all_links:
            return PATIENCE
        return -1 if self._had_all_help or not self._may_help else CORES

    @property
    def _may_help(self) -> bool:
        """Whether to look for small maps in other ways. These obey the causal axioms only."""
        speedups = self._task.speedups
        return self._task.theory.level == "causal" and (speedups.greedy or speedups.guessed)

    def _helped(self) -> Iterator[list[int]]:
        """Look for small maps in other ways, as clingo takes long. Yield the dstates of steps."""
        pinned, greedy = self._program.pinned, self._task.speedups.greedy
        if self._may_help and greedy and not self._hard and not pinned.is_long:
            yield merged(pinned.chart, pinned.clique)
        self._hard = True
        # It takes long until clingo has all links of a long trace, so guess before.
        is_time = self._program.has_all_links or pinned.is_long
        if is_time and self._may_help and not self._had_all_help:
            self._had_all_help = True
            yield from self._near_a_guess()

    def _near_a_guess(self) -> Iterator[list[int]]:
        """Guess dstates. Yield the labels of a map near each guess, with ever fewer dstates.

        The first guess that is itself a map is the last one. There is no guess if that takes too
        much memory, of a long trace, and where a robot travels and turns: there merging does as
        well in less time.
        """
        steps, known = self._program.chart, self._incumbent.labels
        drives = all(action.kind for action in self._task.trace.actions)
        if not self._task.speedups.guessed or drives or self._program.pinned.is_long:
            return
        actions = [action for _, action, _ in steps.links]
        for guessed in islice(machine_labels(steps.seen, actions), GUESSES):
            guess = mended(guessed, steps)
            labels = dstates_merged(steps, merged(steps, guess=guess))
            if known is None or len(set(labels)) < len(set(known)):
                known = labels
                yield labels
            if self._incumbent.is_settled() or steps.is_map(guess):
                return


def mended(guess: Sequence[int], chart: Chart) -> list[int]:
    """Correct a guess: let each action at a dstate lead to the dstate that it mostly leads to.

    Take the dstate of a node in the guess, and the action after the node. The next node gets the
    dstate to which this action mostly leads from there, unless its view contradicts this. If only a
    few dstates were wrong, all dstates after a right one become right. In the guess, -1 is an
    unknown dstate.
    """
    keys = [
        None if label < 0 else (view, label) for view, label in zip(chart.seen, guess, strict=True)
    ]
    leads: dict[tuple[tuple[int, int], int], Counter[tuple[int, int]]] = {}
    for t, action, u in chart.links:
        if (here := keys[t]) is not None and (there := keys[u]) is not None:
            leads.setdefault((here, action), Counter())[there] += 1
    most = {key: counts.most_common(1)[0][0] for key, counts in leads.items()}
    for t, action, u in chart.links:
        if (
            (here := keys[t]) is not None
            and (likely := most.get((here, action))) is not None
            and likely[0] == chart.seen[u]
        ):
            keys[u] = likely
    return [-1 if key is None else key[1] for key in keys]
