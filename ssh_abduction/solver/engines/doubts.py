"""Asks for maps that contradict what the known maps share.

This serves every engine. Steps may share a dstate, place, path or course in all known maps, but not
in all maps; or in no known map, but in another. A *doubt* is one such pair. Clingo gets the rule
for a doubt once. Then it is asked for an answer in which some open doubt holds.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from contextlib import closing
from typing import TypeAlias, TypeVar

import clingo

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.solver.asp.control import Asker
from ssh_abduction.solver.asp.facts import path_reader, questions
from ssh_abduction.solver.sharing import Sort

Answer = TypeVar("Answer")
# What is compared, two steps or two dstates, and whether the doubt is that they are one.
Doubt: TypeAlias = tuple[Sort, int, int, bool]


class Doubts:
    """The doubts that one control was given."""

    def __init__(
        self,
        asker: Asker,
        control: clingo.Control,
        condition: Callable[[Sort, int, int], str | None],
    ) -> None:
        """Know no doubt yet.

        Args:
            asker: Asks clingo.
            control: The control that is asked.
            condition: The body of a rule that says when two steps, or two dstates, are one; None
                if they never are.
        """
        self._asker, self._control, self._condition = asker, control, condition
        self._told: dict[Doubt, int] = {}  # the number of each doubt that clingo has
        self._open: set[Doubt] = set()
        self._parts = 0

    def answer(
        self, doubts: Collection[Doubt], read: Callable[[clingo.Model], Answer], mode: str
    ) -> Answer | None:
        """An answer in which any of these doubts holds; None if there is none."""
        doubts = set(doubts)
        if not doubts:
            return None
        self._tell([doubt for doubt in doubts if doubt not in self._told])
        for doubt in self._open ^ doubts:
            self._control.assign_external(questions.open_doubt(self._told[doubt]), doubt in doubts)
        self._open = doubts
        assumed = [(questions.some_doubt(self._parts), True)]
        with closing(
            self._asker.answers(read, mode, 1, assumptions=assumed, control=self._control)
        ) as answers:
            return next(answers, None)

    def _tell(self, doubts: Sequence[Doubt]) -> None:
        if not doubts:
            return
        self._parts += 1
        rules = [questions.doubts_before(self._parts)]
        for sort, i, j, one in doubts:
            number = self._told[sort, i, j, one] = len(self._told)
            rules.append(questions.doubt(number, self._parts, self._condition(sort, i, j), one=one))
        part = f"doubts_{self._parts}"
        with self._asker.grounding_timed():
            self._control.add(part, [], "\n".join(rules))
            self._control.ground([(part, [])])


class Settled:
    """The best maps of some labels, for engines that find dstates before places and paths."""

    def __init__(
        self,
        asker: Asker,
        control: clingo.Control,
        mode: str,
        reader: path_reader.PathReader,
        map_of: Callable[[path_reader.PathAnswer], SSHMap],
    ) -> None:
        """Nothing is asked yet.

        Args:
            asker: Asks clingo.
            control: It has the places and paths of the labels.
            mode: Clingo's opt-mode for the best maps.
            reader: Reads the answers.
            map_of: Makes a map from an answer.
        """
        self._asker, self._control, self._mode = asker, control, mode
        self._reader, self._map_of = reader, map_of
        self._doubts = Doubts(asker, control, reader.condition)
        self._any: SSHMap | None = None

    def has_map(self) -> bool:
        """Whether a map exists."""
        return self.any_map() is not None

    def any_map(self) -> SSHMap | None:
        """Some map, if there is one."""
        if self._any is None:
            with closing(
                self._asker.answers(self._reader.read, self._mode, 1, control=self._control)
            ) as answers:
                self._any = next(map(self._map_of, answers), None)
        return self._any

    def map_with(self, doubts: Collection[Doubt]) -> SSHMap | None:
        """A map in which any of these doubts about its dstates holds; None if there is none."""
        answer = self._doubts.answer(doubts, self._reader.read, self._mode)
        return None if answer is None else self._map_of(answer)
