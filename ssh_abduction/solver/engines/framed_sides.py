"""Adds the axioms of order and sides to the search for visits. The engine with frames uses it.

sides_framed.lp has the axioms about the order of places on a path, and about its sides. They are
added only for paths that an answer contradicts; `engines/framed.py` says why.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from ssh_abduction.solver.asp.control import Asker
from ssh_abduction.solver.asp.facts import sides_lp
from ssh_abduction.solver.asp.facts.atoms import number_symbols
from ssh_abduction.theory import encodings
from ssh_abduction.theory.theory import Theory


class FramedSides:
    """Adds the axioms of order and sides, path by path, to the control that decides on visits."""

    def __init__(self, theory: Theory, asker: Asker) -> None:
        self._theory, self._asker = theory, asker
        # The grounded program parts of sides_framed.lp, with their arguments.
        self._said: dict[tuple[str, tuple[int, ...]], None] = {}
        self._batch = -1

    def begin(self) -> None:
        """Forget which axioms were added, as there is a new control."""
        self._said = {}
        self._batch = -1

    def extend(self, batch: int) -> None:
        """Ground the axioms of all paths added so far for a new batch: the visits of one call."""
        self._batch = batch
        if self._said:
            paths = [
                (part, number_symbols(*arguments, batch))
                for part, arguments in self._said
                if part == "path"
            ]
            self._asker.control.ground([("paths", number_symbols(batch)), *paths])

    def say_of_path(
        self, contrary: Iterable[int], twice: Iterable[int], standing: Mapping[int, tuple[int, int]]
    ) -> bool:
        """Add the axioms of a path that labels contradict, and return whether there was one.

        `contrary` has a dstate of each path that contradicts the axioms. `twice` has the dstates
        where two paths cross that meet again. `standing` has, for each dstate that has a node in
        clingo, the visit and the slot (direction) of such a node.
        """
        if any(self._say_once("path", *standing[dstate]) for dstate in contrary):
            return True
        for visit in (standing[dstate][0] for dstate in twice):
            said = [
                self._say_once("path", visit, 0),
                self._say_once("path", visit, 1),
                self._say_once("crossing", visit, self._batch),
            ]
            if any(said):
                return True
        return False

    def _say_once(self, part: str, *arguments: int) -> bool:
        """Ground a part of sides_framed.lp for these arguments once. Return whether it was new."""
        if (part, arguments) in self._said:
            return False
        control, batches = self._asker.control, range(self._batch + 1)
        with self._asker.grounding_timed():
            if not self._said:
                control.load(encodings.path("sides_framed"))
                control.add("sides", [], sides_lp.sides_framed_facts(self._theory))
                control.ground(
                    [("sides", []), *(("paths", number_symbols(batch)) for batch in batches)]
                )
            self._said[part, arguments] = None
            if part == "path":
                control.ground([(part, number_symbols(*arguments, batch)) for batch in batches])
            else:
                control.ground([(part, number_symbols(*arguments))])
        return True
