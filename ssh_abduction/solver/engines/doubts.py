"""Asks for maps in which other steps are one than in those that are known.

What known maps share is in doubt: things that are one in all of them need not be one in all maps, and things that are one in none may be one in another. A
*doubt* is one such pair. Clingo is told what it takes for a doubt to hold, once, and is then asked for an answer in which any of those that are still open does.
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
# That two steps, or two dstates of some labels, are one after all (True), or are not (False): as to their dstate, place, path, or course.
Doubt: TypeAlias = tuple[Sort, int, int, bool]


class Doubts:
    """The doubts that one control was told of.

    condition  what it takes for two steps, or two dstates, to be one: the body of a rule; None where they never are
    """

    def __init__(
        self,
        asker: Asker,
        control: clingo.Control,
        condition: Callable[[Sort, int, int], str | None],
    ) -> None:
        self._asker, self._control, self._condition = asker, control, condition
        self._told: dict[Doubt, int] = {}  # all that clingo knows, by their numbers
        self._open: set[Doubt] = set()
        self._parts = 0

    def answer(
        self, doubts: Collection[Doubt], read: Callable[[clingo.Model], Answer], mode: str
    ) -> Answer | None:
        """An answer in which any of these doubts holds; None where there is none."""
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
    """The best maps of some labels, where places and paths are sought for dstates that are settled.

    control  for these places and paths
    mode     how clingo is asked for the best of them
    map_of   makes a map of an answer
    """

    def __init__(
        self,
        asker: Asker,
        control: clingo.Control,
        mode: str,
        reader: path_reader.PathReader,
        map_of: Callable[[path_reader.PathAnswer], SSHMap],
    ) -> None:
        self._asker, self._control, self._mode, self._reader, self._map_of = (
            asker,
            control,
            mode,
            reader,
            map_of,
        )
        self._doubts = Doubts(asker, control, reader.condition)
        self._any: SSHMap | None = None

    def has_map(self) -> bool:
        """Whether there is one."""
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
        """A map in which any of these doubts about its dstates holds; None where there is none."""
        answer = self._doubts.answer(doubts, self._reader.read, self._mode)
        return None if answer is None else self._map_of(answer)
