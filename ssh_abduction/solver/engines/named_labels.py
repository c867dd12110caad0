"""Finds labels with the fewest dstates, for theories without frames.

A label is the number of the dstate of a step. This module finds labels of the first steps with the
fewest dstates, proves that none have fewer, and lists all labels with that number of dstates. The
causal engine and the frameless one use it.

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
(`engines/name_program.py`). If clingo does not answer soon, it gets all links, or some at a time if
the trace is long. A very long trace is charted only up to a step at which the clique is as large as
the clique of all steps.

The search for the fewest dstates is in `engines/name_search.py`.

While a map is made from one answer, clingo searches for the next.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Generator, Iterable, Iterator, Sequence

from ssh_abduction.data.groups import numbered
from ssh_abduction.solver.asp.control import Asker
from ssh_abduction.solver.asp.facts import names_lp
from ssh_abduction.solver.asp.limits import LimitError
from ssh_abduction.solver.engines.base import AT_ONCE, Task
from ssh_abduction.solver.engines.name_program import Fitting, NameProgram
from ssh_abduction.solver.engines.name_search import Incumbent, NameSearch
from ssh_abduction.solver.engines.pinned import Pinned
from ssh_abduction.solver.steps.apart import Continuations
from ssh_abduction.solver.steps.chart import Chart, Link
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


class NamedLabels:
    """Finds labels (dstates of steps) with the fewest dstates, for the first `size` steps."""

    def __init__(
        self,
        task: Task,
        asker: Asker,
        given_map: Sequence[int] = (),
        fitting: Fitting | None = None,
    ) -> None:
        """Begin without any steps.

        `given_map` has the dstate of each step in a map with few dstates; empty if none is known.
        `fitting` has further axioms for labels; None in the causal theory.
        """
        self.size = 0
        self._task, self._asker, self._given_map, self._fitting = task, asker, given_map, fitting
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
        most = min(len(self._task.trace), WHOLE)
        if AT_ONCE <= size < most and self._task.speedups.clique:
            largest = self._clique_size(most)
            while size < most and self._clique_size(size) < largest:
                size = min(2 * size, most)
        return size

    def _clique_size(self, steps: int) -> int:
        """Return the size of a largest clique of the first steps."""
        log = self._task.log
        return len(Continuations(log.seen[:steps], log.actions[: steps - 1]).clique())

    def grow(self, size: int) -> None:
        """Make the first `size` steps the prefix."""
        if size == self.size:
            return
        try:
            self._take(size)
        except BaseException:
            self.size = 0  # an error may have left this prefix incomplete
            raise

    def _take(self, size: int) -> None:
        """Chart the first steps, pin a clique of them, and make a new control."""
        self.size = size
        speedups, known = self._task.speedups, self._incumbent
        with self._asker.grounding_timed():
            pinned = Pinned.of_steps(self._task.log, size, largest=speedups.clique)
        self._pinned = pinned
        known.labels = numbered(self._given_map[:size]) or None
        known.raise_bound(len(pinned.clique))
        self._asker.watch.check()
        self._program = NameProgram(
            self._task,
            self._asker,
            pinned,
            self._first_spares(pinned),
            self._forbidden,
            fitting=self._fitting,
        )
        self._search = NameSearch(self._task, self._asker, self._program, known, self._fitting)
        links: Iterable[Link] = pinned.chart.links
        if speedups.lazy:
            # Only links that begin at the first step or at a pinned one, and those at steps that
            # the user says are one dstate.
            first = {0, *pinned.clique}
            said = {t for pair in pairs_in(self._task.log.pairs.one) for t in pair}
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
        known = self._incumbent
        # Evidence about places may have refused the places of a known map since it was found.
        if known.labels and self._fitting and not self._fitting.fits(known.labels):
            known.labels = None
        return self._search.improving()

    def forbid_together(self, pairs: Collection[tuple[int, int]]) -> None:
        """Exclude labels in which both steps of each of these pairs are at one dstate."""
        self._forbidden.append(list(pairs))
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
            names_lp.read_names,
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
        return self._asker.answers(names_lp.read_names, mode, 0, assumptions=[resting], ahead=True)
