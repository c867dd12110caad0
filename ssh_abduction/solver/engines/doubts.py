"""Searches for a map that contradicts something on which all known maps agree.

Every engine uses this. Two steps may share a dstate, place, path or course (a path in one
direction) in all known maps, but not in some unknown map. Or they may share it in no known map, but
in some unknown map. Either possibility is a *doubt*. Clingo is asked for an answer in which at
least one doubt of a set holds.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from contextlib import closing
from typing import TypeAlias, TypeVar

import clingo

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.solver.asp.control import Asker, Control
from ssh_abduction.solver.asp.facts import further_rules, path_reader
from ssh_abduction.solver.solution.sharing import Sort

Answer = TypeVar("Answer")
# A sort of thing (such as "places"), two steps or dstates, and a claim: they share a thing of this
# sort (True), or they do not (False).
Doubt: TypeAlias = tuple[Sort, int, int, bool]


class Doubts:
    """Asks one control of clingo whether a map contradicts what all known maps share."""

    def __init__(
        self, asker: Asker, control: Control, condition: Callable[[Sort, int, int], str | None]
    ) -> None:
        """Begin without any doubt.

        `condition` takes a sort (such as dstate or place) and two steps or dstates. It returns the
        body of a rule that is true if both are at one thing of this sort; None if they never are.
        """
        self._asker, self._control, self._condition = asker, control, condition
        # The number of each pair of things that clingo has, and the number of questions so far.
        self._number_of: dict[tuple[Sort, int, int], int] = {}
        self._questions = 0

    def answer(
        self, doubts: Collection[Doubt], read: Callable[[clingo.Model], Answer], mode: str
    ) -> Answer | None:
        """Return what `read` makes of an answer that confirms a doubt; None if none does."""
        if not doubts:
            return None
        rules: list[str] = []
        for sort, i, j, _ in doubts:
            if (sort, i, j) not in self._number_of:
                number = self._number_of[sort, i, j] = len(self._number_of)
                rules.append(further_rules.one_in_doubt(number, self._condition(sort, i, j)))
        numbers = [(self._number_of[sort, i, j], one) for sort, i, j, one in doubts]
        rules.append(further_rules.some_doubt(self._questions, numbers))
        asked = further_rules.asked(self._questions)
        self._questions += 1
        with self._asker.grounding_timed():
            self._control.tell("\n".join(rules))
        self._control.assign_external(asked, True)
        try:
            with closing(self._asker.answers(read, mode, 1, control=self._control)) as answers:
                return next(answers, None)
        finally:
            self._control.release_external(asked)


class Settled:
    """Answers questions about the best maps with given dstates, after the dstates are found."""

    def __init__(self, asker: Asker, reader: path_reader.PathReader, mode: str) -> None:
        """Prepare the questions for a reader of places and paths. `mode` is clingo's opt-mode."""
        self._asker, self._reader, self._mode = asker, reader, mode
        self._doubts = Doubts(asker, reader.control, reader.condition)
        self._any: SSHMap | None = None

    def any_map(self) -> SSHMap | None:
        """Return some map, always the same one; None if there is none."""
        if self._any is None:
            reader = self._reader
            answers = self._asker.answers(reader.read, self._mode, 1, control=reader.control)
            with closing(answers):
                self._any = next(map(reader.map_of, answers), None)
        return self._any

    def map_with(self, doubts: Collection[Doubt]) -> SSHMap | None:
        """Find a map in which at least one of these doubts about dstates holds; else None."""
        answer = self._doubts.answer(doubts, self._reader.read, self._mode)
        return None if answer is None else self._reader.map_of(answer)
