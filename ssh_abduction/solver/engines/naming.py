"""Labels with the fewest dstates for theories without frames: the dstates have names.

This serves the causal engine and the frameless one. It finds labels of the first steps with the
fewest dstates, proves that none have fewer, and lists all that have as few.

Pairwise distinct steps (`steps/apart.py`) are pinned to names of their own. Their number is a
lower bound on the dstates. Pinning leaves only one way to name these dstates. Every other step
chooses among the names of steps that it is not apart from. A view has a few spare names, at the
cost of one dstate each, and a *rest*, which stands for all other dstates of the view. Of several
largest cliques, the one whose steps are apart from most others is pinned. That leaves the other
steps the fewest names.

*Claim.* A map of minimal cost that uses no rest is a minimal map, and its cost is the minimum.
*Proof.* Name the dstates of any map: those of the pinned steps as pinned, the others by spare
names of their view as far as these reach, then by the rest. This keeps every rule of names.lp, as
a rest asks nothing of the steps at it, and costs at most as many spare names as the map has
dstates beyond the clique. So the cost found is a lower bound; a map without a rest is a map of
the trace, and reaches it. ∎
If a minimal answer does use a rest, its view gets one more spare name, and clingo is asked again.

Not every step is needed. Clingo starts with the links of the pinned steps. An answer is followed
along the trace, and the links at which it fails are added, until one holds everywhere
(`engines/name_program.py`). If clingo does not answer soon, it is given all links, or of a long
trace some at a time. A very long trace is charted only up to a step at which the clique is as large
as that of all steps.

The search for the fewest dstates is in `engines/name_search.py`. Which minimal maps come first may
differ from run to run, as the search may use threads; the set of minimal maps is the same.

Python reads an answer more slowly than clingo finds it. So only the atoms that say where actions
lead are read. The labels of all steps follow from them. While a map is made of one answer, clingo
searches for the next.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Generator, Iterable, Iterator, Sequence

from ssh_abduction.solver.asp.control import Asker
from ssh_abduction.solver.asp.facts import names_lp
from ssh_abduction.solver.asp.limits import LimitError
from ssh_abduction.solver.engines.base import AT_ONCE, Task
from ssh_abduction.solver.engines.name_program import Fitting, NameProgram
from ssh_abduction.solver.engines.name_search import Incumbent, NameSearch
from ssh_abduction.solver.engines.pinned import Pinned
from ssh_abduction.solver.steps.apart import Continuations
from ssh_abduction.solver.steps.chart import Chart, Link, numbered

# Hold back this many maps until clingo has all links; then they stream. Until then any answer may
# show that clingo lacks a link.
HELD_BACK = 100
# A view begins with this many spare names: one to use, and one to show that no more are needed.
SPARES = 2
# Take at most this many steps of a long trace at once, if its clique still grows: the clique of
# more takes minutes.
WHOLE = 100_000


class NamedLabels:
    """Labels of the first steps of a trace with the fewest dstates.

    Attributes:
        size: The number of these steps.
    """

    def __init__(
        self,
        task: Task,
        asker: Asker,
        given_map: Sequence[int] = (),
        fitting: Fitting | None = None,
    ) -> None:
        """Labels of no steps yet.

        Args:
            task: The trace and the speed-ups that are on.
            asker: It asks clingo.
            given_map: Labels of all steps in a map with few dstates, if known.
            fitting: Further demands on labels; None in the causal theory.
        """
        self.size = 0
        self._task, self._asker, self._given_map, self._fitting = task, asker, given_map, fitting
        self._incumbent = Incumbent(asker, self.is_allowed)
        # Sets of pairs of steps. In each set, some pair is not one dstate.
        self._forbidden: list[list[tuple[int, int]]] = []
        self._pinned: Pinned | None = None
        self._program: NameProgram | None = None
        self._search: NameSearch | None = None

    @property
    def bound(self) -> int | None:
        """A lower bound on the dstates; None if unknown."""
        return self._incumbent.bound

    @property
    def clique(self) -> Sequence[int]:
        """Pairwise distinct steps, which have names of their own."""
        return self._pinned.clique if self._pinned else []

    @property
    def program(self) -> NameProgram:
        """The control that names dstates."""
        assert self._program is not None  # `grow` comes first
        return self._program

    @property
    def chart(self) -> Chart:
        """The first steps and the links between them."""
        return self.program.chart

    def large_enough(self, size: int) -> int:
        """The number of steps to take of a long trace; at least `size`.

        More steps do not have a larger clique.
        """
        most = min(len(self._task.trace), WHOLE)
        if AT_ONCE <= size < most and self._task.speedups.clique:
            largest = self._clique_size(most)
            while size < most and self._clique_size(size) < largest:
                size = min(2 * size, most)
        return size

    def _clique_size(self, steps: int) -> int:
        log = self._task.log
        return len(Continuations(log.seen[:steps], log.actions[: steps - 1]).clique())

    def grow(self, size: int) -> None:
        """Take the first `size` steps."""
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
            check_ahead=known.check_ahead,
        )
        self._search = NameSearch(self._task, self._asker, self._program, known, self._fitting)
        links: Iterable[Link] = pinned.chart.links
        if speedups.lazy:  # only those that begin at the first step or at one of the clique
            first = {0, *pinned.clique}
            links = [link for link in links if link[0] in first]
        self._program.tell_all(links)

    def _first_spares(self, pinned: Pinned) -> dict[int, int]:
        """How many spare names each view has at first.

        As many as the given map needs and one more, or a few if there is no such map.
        """
        seen = pinned.chart.seen
        found = Counter(dict(zip(self._given_map, seen, strict=False)).values())
        taken = Counter(seen[node] for node in pinned.clique)
        return {
            view: max(SPARES, found[view] - taken[view] + 1) if self._given_map else SPARES
            for view in dict.fromkeys(seen)
        }

    def improving(self) -> Iterator[list[int]]:
        """Labels of all steps; the last ones have the fewest dstates.

        If the search takes long, other labels with few dstates come first.
        """
        assert self._search is not None  # `grow` comes first
        return self._search.improving()

    def is_allowed(self, labels: Sequence[int]) -> bool:
        """Whether labels of a map agree with evidence about pairs of steps."""
        return self.program.is_allowed(labels)

    def forbid_together(self, pairs: Collection[tuple[int, int]]) -> None:
        """Forbid that these pairs of steps are all one dstate."""
        self._forbidden.append(list(pairs))
        known = self._incumbent
        if known.labels and not self.is_allowed(known.labels):
            known.labels = None
        self.program.tell_forbidden(len(self._forbidden) - 1)

    def settle(self) -> None:
        """End the search in the other thread."""
        self._incumbent.end_beside()

    def all_of(self, dstates: int, enough: int) -> Generator[list[int], None, None]:
        """All labels with this many dstates. Labels that are known come first.

        Args:
            dstates: The number of dstates.
            enough: Stop after this many labels; 0 for all.
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
        """As `all_of`, in the order in which clingo lists them."""
        program, spares = self.program, dstates - len(self.clique)
        if spares < 0:
            return
        if not program.chart.links:
            yield [0]
            return
        while True:
            # Ask again when nodes were added, as they may be at a rest.
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
                yield from held  # they cost what the bound is, and fit all links
                raise
            if failed:
                program.add(failed)
            elif not enough or not self._needs_rest(spares):
                yield from held
                return

    def _needs_rest(self, spares: int) -> bool:
        """Add spare names if some answer of this cost uses a rest.

        Returns:
            Whether some answer did.
        """
        assert self._search is not None  # `grow` comes first
        answers = self._asker.answers(
            names_lp.read_names,
            f"enum,{spares},{spares}",
            1,
            assumptions=[self.program.resting(True)],
        )
        answer = next(answers, None)
        views = self.program.rests(answer) if answer else set()
        if views:
            self._search.name_more(views)
        return bool(views)

    def _answers_of(self, spares: int) -> Iterator[dict[int, int]]:
        """All answers that cost this many spare names and use no rest."""
        program = self.program
        read = program.reader().read if program.has_all_links else names_lp.read_names
        return self._asker.answers(
            read, f"enum,{spares},0", 0, assumptions=[program.resting(False)], ahead=True
        )
