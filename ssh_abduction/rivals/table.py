"""Maps of one trace as arrays, so that thousands of them are compared in seconds.

Steps that are one dstate in all maps are a *class*. Classes are numbered from 0 by their first
steps. Two classes are *one* in a map if they are at one dstate of it (or at one place, along one
path, or along one course, for these sorts). For each sort, map and class, the table has the first
class that is one with this class. So the numbers that maps give to their dstates, places and paths
do not matter.

>>> from ssh_abduction.data.maps import DState, SSHMap
>>> a, b = DState(0, "hall"), DState(1, "hall")
>>> table = Table([SSHMap((0, 0, 1), (a, b), ()), SSHMap((0, 1, 1), (a, b), ())])
>>> table.ones["dstates"].tolist()
[[0, 0, 2], [0, 1, 1]]
>>> [(first, later, column.tolist()) for first, later, column in table.questions("dstates")]
[(0, 1, [True, False]), (1, 2, [False, True])]
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.data.drives import Drive, named_steps
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.solver import SORTS, Sort, key_of

Ints: TypeAlias = NDArray[np.int32]
Bools: TypeAlias = NDArray[np.bool_]
NONE = -1  # no place, path or course


class Table:
    """Maps of one trace as arrays."""

    def __init__(self, maps: Sequence[SSHMap], drives: Sequence[Drive] = ()) -> None:
        labelings = dict.fromkeys(ssh_map.dstate_at for ssh_map in maps)
        by_labels = {labels: np.array(labels, dtype=np.int32) for labels in labelings}
        # The class of each step, shape (steps,), and the first step of each class, (classes,).
        self.classes = _common_classes(list(by_labels.values()))
        _, self.firsts = np.unique(self.classes, return_index=True)
        # The numbers of all steps. With several drives, a step prints with its drive's name.
        self.steps = named_steps(drives, len(self.classes))
        label_of = {labels: numbers[self.firsts].tolist() for labels, numbers in by_labels.items()}
        has_places = all(any(s.place is not None for s in ssh_map.dstates) for ssh_map in maps)
        # For each sort that all maps have, an array of shape (maps, classes): the first class that
        # is one with each class in each map; NONE if the class has no place, path or course.
        self.ones: dict[Sort, Ints] = {}
        for sort in SORTS if has_places else SORTS[:1]:
            known: dict[tuple[Hashable, ...], Ints] = {}
            rows = []
            for ssh_map in maps:
                of_dstate = [key_of(s, sort) for s in ssh_map.dstates]
                names = tuple(of_dstate[label] for label in label_of[ssh_map.dstate_at])
                if names not in known:
                    known[names] = _firsts_of(names)
                rows.append(known[names])
            self.ones[sort] = np.array(rows, dtype=np.int32)

    def __len__(self) -> int:
        """Return the number of maps."""
        return len(self.ones["dstates"])

    def steps_of(self, classes: Sequence[int]) -> tuple[int, ...]:
        """List the steps of some classes, ascending."""
        found = np.flatnonzero(np.isin(self.classes, classes)).tolist()
        return tuple(map(self.steps.__getitem__, found))

    def variants(self, sort: Sort) -> int:
        """Count the different ways in which maps group classes by this sort."""
        return len(np.unique(self.ones[sort], axis=0))

    def heads(self, sort: Sort) -> Ints:
        """For each class, return the first class that all maps treat in the same way.

        Two classes are treated in the same way if in each map they are one, or both have no
        place, path or course. The result has the shape (classes,).
        """
        _, first, inverse = np.unique(
            self.ones[sort], axis=1, return_index=True, return_inverse=True
        )
        return first[inverse.reshape(-1)].astype(np.int32)

    def questions(self, sort: Sort) -> Iterator[tuple[int, int, Bools]]:
        """Yield questions that distinguish maps: two classes, and the answer of each map.

        The answer says whether the two classes are one in the map. The earlier class comes
        first. Each class is paired only with the first class of its group in each map. Two maps
        that agree on these pairs group all classes in the same way. If a class is paired with
        itself, the answer says whether it has a place, path or course at all.
        """
        ones = self.ones[sort]
        for c in np.flatnonzero((ones != ones[0]).any(axis=0)).tolist():
            for h in np.unique(ones[:, c]).tolist():
                if h == NONE:
                    yield c, c, ones[:, c] != NONE
                elif h != c and not (same := ones[:, h] == ones[:, c]).all():
                    yield h, c, same


def _common_classes(labelings: Sequence[Ints]) -> Ints:
    """Return the class of each step, of shape (steps,): steps of a class have equal labels."""
    classes = labelings[0].astype(np.int64)
    for labels in labelings[1:]:
        _, classes = np.unique(classes * (int(labels.max()) + 1) + labels, return_inverse=True)
    return columns_numbered(classes[None]).astype(np.int32)


def columns_numbered(table: NDArray[np.generic]) -> NDArray[np.intp]:
    """Number the different columns of a table (m, n) as they first occur. Return the shape (n,)."""
    _, first, inverse = np.unique(table, axis=1, return_index=True, return_inverse=True)
    rank: NDArray[np.intp] = np.empty(len(first), dtype=np.intp)
    rank[np.argsort(first)] = np.arange(len(first))
    numbers: NDArray[np.intp] = rank[inverse.reshape(-1)]
    return numbers


def _firsts_of(names: Sequence[Hashable]) -> Ints:
    """For each name, find the index of its first occurrence; NONE if the name is None."""
    first: dict[Hashable, int] = {}
    return np.array(
        [NONE if name is None else first.setdefault(name, i) for i, name in enumerate(names)],
        dtype=np.int32,
    )
