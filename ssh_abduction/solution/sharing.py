"""Find what maps of one trace share: which steps are one in all, in some, or in none of them.

There are four *sorts* of things that two steps may share: a dstate, a place, a path, or a course (a
path in one direction). Each sort is compared by itself. Two steps that share a thing of the sort
are *one*.

>>> from ssh_abduction.data.maps import DState, SSHMap
>>> a, b = DState(0, "hall"), DState(1, "hall")
>>> shared = Sharing()
>>> shared.absorb(SSHMap((0, 0, 1), (a, b), ()))
>>> shared.absorb(SSHMap((0, 1, 1), (a, b), ()))
>>> backbone = shared.backbone(proven=True)
>>> backbone
<Backbone: the dstates of steps 1–2 differ>
>>> backbone.dstates.always, backbone.dstates.sometimes
((0, 1, 2), ((0, 1), (1, 2)))
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Any, Literal, TypeAlias

from ssh_abduction.data.checks import a_whole_number
from ssh_abduction.data.drives import Drive, DriveStep, named_steps
from ssh_abduction.data.errors import MapError, brief
from ssh_abduction.data.groups import first_index_of, indices_of, numbered
from ssh_abduction.data.map_parts import list_in_words
from ssh_abduction.data.maps import DState, SSHMap
from ssh_abduction.data.schema import FieldReader
from ssh_abduction.data.words import counted, noun_of

Pair: TypeAlias = tuple[int, int]
Sort: TypeAlias = Literal["dstates", "places", "paths", "courses"]

SORTS: tuple[Sort, ...] = ("dstates", "places", "paths", "courses")
# What two steps that share a thing of each sort are; and the thing of one step, and of several.
WORDS: dict[Sort, tuple[str, str, str]] = {
    "dstates": ("one dstate", "dstate", "dstates"),
    "places": ("at one place", "place", "places"),
    "paths": ("along one path", "path", "paths"),
    "courses": (
        "along one path in one direction",
        "direction along the path",
        "directions along paths",
    ),
}
PRINTED = 1000  # write at most this many pairs of steps to a file
NAMED = 6  # name at most this many stretches of steps in a sentence
REMEMBERED = 10_000  # remember this many assignments of names to classes, to compare each only once


@dataclass(frozen=True, slots=True)
class Shared:
    """Which steps are one dstate (or one place, path or course) in all, some or none of the maps.

    Two steps with the same number are one in all maps. Two steps with different numbers are one in
    some maps if `sometimes` has a pair of steps with these numbers, else in none. A dstate that is
    along no path has a number of its own for paths. A pair of a step with itself means that the
    step is along a path in some maps, and along none in others.

    Attributes:
        always: A number for each step of the trace, counted from 0 in the order of first steps.
        sometimes: Pairs of steps that are one in some maps only. Each of the two steps is the first
            one with its number.
        untold: The steps in which the maps differ, if `sometimes` was read from a file that does
            not have all pairs.
    """

    always: tuple[int, ...]
    sometimes: tuple[Pair, ...]
    untold: tuple[int, ...] = field(default=(), repr=False)

    def __repr__(self) -> str:
        pairs = (
            f"; {counted(len(self.sometimes), 'pairs')} of steps differ" if self.sometimes else ""
        )
        return (
            f"<Shared: {len(set(self.always))} among {counted(len(self.always), 'steps')}{pairs}>"
        )

    def one_in(self, i: int, j: int) -> Literal["all", "some", "none"]:
        """Say whether steps i and j are one in "all" maps, in "some", or in "none"."""
        if self.always[i] == self.always[j]:
            return "all"
        pair = tuple(sorted((self.always.index(self.always[i]), self.always.index(self.always[j]))))
        return "some" if pair in self.sometimes else "none"

    @property
    def differing(self) -> tuple[int, ...]:
        """The steps in which the maps differ, in order.

        Such a step is one with an earlier step in some maps only, or it has the same number as such
        a step.
        """
        if self.untold:
            return self.untold
        numbers = {self.always[later] for _, later in self.sometimes}
        return tuple(t for t, number in enumerate(self.always) if number in numbers)

    def to_dict(self, steps: Iterable[int]) -> dict[str, Any]:
        """Return the numbers of some steps, and the pairs, as plain data.

        If there are more than PRINTED pairs, the data have only the first PRINTED, the number of
        all pairs, and the steps in which the maps differ.

        Args:
            steps: The steps whose numbers are wanted.
        """
        more = (
            {"pairs": len(self.sometimes), "differing": list(self.differing)}
            if len(self.sometimes) > PRINTED
            else {}
        )
        return {
            "always": [self.always[t] for t in steps],
            "sometimes": [list(pair) for pair in self.sometimes[:PRINTED]],
            **more,
        }


@dataclass(frozen=True, slots=True)
class Backbone:
    """What all minimal maps of a trace share.

    Attributes:
        dstates: Which steps are one dstate, in all maps or in some.
        places: Which steps are at one place; None if the theory has no places.
        paths: Which steps are along one path; None if the theory has no paths.
        courses: Which steps are along one course (a path in one direction); None if the theory has
            no paths.
        proven: Whether this holds for all minimal maps. If not, it holds only for the known ones,
            and further maps may differ more.
        drives: The drives of the trace, to call a step "monday:12"; empty if they are unknown.
    """

    dstates: Shared
    places: Shared | None
    paths: Shared | None
    courses: Shared | None
    proven: bool
    drives: tuple[Drive, ...] = field(default=(), compare=False)

    def __repr__(self) -> str:
        return f"<Backbone{'' if self.proven else ' (not proven)'}: {self.sentence}>"

    @property
    def sorts(self) -> dict[Sort, Shared]:
        """What the maps share, by sort: "dstates", and with places "places", "paths", "courses"."""
        return {sort: shared for sort in SORTS if (shared := getattr(self, sort)) is not None}

    @property
    def sentence(self) -> str:
        """A sentence that says what the maps share, and in which steps they differ."""
        differing = {sort: shared for sort, shared in self.sorts.items() if shared.sometimes}
        if "paths" in differing:  # a step along another path is along another course
            differing.pop("courses", None)
        same = [sort for sort in self.sorts if sort not in differing and sort != "courses"]
        parts = [f"the same {list_in_words(same)}"] if same else []
        steps = named_steps(self.drives, len(self.dstates.always))
        return "; ".join(
            parts + [_differing_in_words(sort, shared, steps) for sort, shared in differing.items()]
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the backbone as plain data, as `solve --json` prints it (reference/formats.md).

        There is a number for each step in "dstates". To save space, the other sorts have a number
        for each dstate only.
        """
        labels = self.dstates.always
        by_dstate = [t for _, t in sorted(first_index_of(labels).items())]
        record: dict[str, Any] = {
            sort: shared.to_dict(range(len(labels)) if sort == "dstates" else by_dstate)
            for sort, shared in self.sorts.items()
        }
        return {"proven": self.proven, **record}

    @classmethod
    def from_dict(cls, data: Any, steps: int, where: str = "backbone") -> Backbone:
        """Make a backbone from the plain data that `to_dict` returns.

        Args:
            data: What `to_dict` returned, perhaps read from JSON.
            steps: The number of steps of the trace.
            where: The name of the data in error messages.

        Raises:
            MapError: A field is wrong. The message names it.
        """
        a_whole_number("steps", steps, MapError, 1)
        read = FieldReader(where)
        record = data if isinstance(data, Mapping) else {}
        if not isinstance(proven := record.get("proven"), bool) or "dstates" not in record:
            raise MapError(
                f"{where}: expected an object with proven and dstates, got {brief(data)}; write "
                "it with solve --json"
            )
        dstates = _read_shared(read, record, "dstates", steps)
        rest = {
            sort: _read_shared(read, record, sort, steps, dstates.always)
            for sort in SORTS[1:]
            if sort in record
        }
        return cls(dstates, rest.get("places"), rest.get("paths"), rest.get("courses"), proven)


class Sharing:
    """Collects what maps of one trace share, in constant memory. The maps are added one by one.

    Steps that are one dstate in all maps so far form a *class*. In each of these maps, the steps of
    a class are at one place and along one course. So it is enough to compare the places and courses
    of classes.

    Attributes:
        maps: The number of maps so far.
        classes: The number of the class of each step.
    """

    def __init__(self, maps: Iterable[SSHMap] = ()) -> None:
        self.maps = 0
        self.classes: tuple[int, ...] = ()
        self._labels: tuple[int, ...] = ()  # the labels of the last map
        self._label_of: list[int] = []  # the label of each class in the last map
        self._kept: dict[Sort, Kept] = {}
        for ssh_map in maps:
            self.absorb(ssh_map)

    def absorb(self, ssh_map: SSHMap) -> None:
        """Add a map: keep only what it shares with all earlier maps."""
        self.maps += 1
        if ssh_map.dstate_at != self._labels:
            self._split_by(ssh_map.dstate_at)
        if not self._kept:  # the first map decides whether there are places and paths
            sorts = sorts_of([ssh_map])
            self._kept = {sort: Kept(len(self._label_of)) for sort in sorts}
        for sort, kept in self._kept.items():
            names = tuple(key_of(ssh_map.dstates[label], sort) for label in self._label_of)
            kept.absorb(names)

    def _split_by(self, labels: tuple[int, ...]) -> None:
        """Split classes so that all steps of a class have the same label in this map, too."""
        both = list(zip(self.classes or [0] * len(labels), labels, strict=True))
        number = {pair: i for i, pair in enumerate(dict.fromkeys(both))}
        self.classes = tuple(map(number.__getitem__, both))
        self._labels, self._label_of = labels, [label for _, label in number]
        for kept in self._kept.values():
            kept.split([before for before, _ in number])

    def backbone(self, *, proven: bool) -> Backbone:
        """Make the backbone of the maps so far. `proven`: it holds for all minimal maps."""
        found = {sort: self._shared(kept) for sort, kept in self._kept.items()}
        return Backbone(
            found["dstates"], found.get("places"), found.get("paths"), found.get("courses"), proven
        )

    def _shared(self, kept: Kept) -> Shared:
        """Turn what is kept about classes into what steps share."""
        always = [kept.always[c] for c in self.classes]
        first = first_index_of(always)
        pairs = {
            (first[kept.always[i]], first[kept.always[j]])
            for i, j in kept.together
            if kept.always[i] != kept.always[j] or (i == j and i in kept.unnamed)
        }
        in_order = sorted({(min(pair), max(pair)) for pair in pairs})
        return Shared(tuple(numbered(always)), tuple(in_order))


class Kept:
    """For one sort, which classes of steps are one in all maps so far, and which in some.

    In each map, a class has a *name*: the number of its dstate, place or path, or its course.
    Classes with the same name are one. A class along no path has no name.

    Attributes:
        always: A number for each class. Classes with the same number are one in all maps.
        together: Pairs of classes that are one in some map, the smaller class first. A pair of a
            class with itself means that the class has a name in some map.
        unnamed: The classes that have no name in some map.
    """

    def __init__(self, classes: int) -> None:
        self.always: list[int] = [0] * classes
        self.together: set[Pair] = set()
        self.unnamed: set[int] = set()
        self._seen: set[tuple[Hashable, ...]] = set()

    def split(self, before: Sequence[int]) -> None:
        """Replace the classes by parts of them. `before` has the old class of each new class."""
        parts = indices_of(before)
        self.always = [self.always[old] for old in before]
        self.together = set(_split(self.together, parts))
        self.unnamed = {part for old in self.unnamed for part in parts[old]}
        self._seen.clear()

    def absorb(self, names: tuple[Hashable, ...]) -> None:
        """Add a map. `names` has the name of each class in this map; None if it has no name."""
        if names in self._seen:
            return
        if len(self._seen) == REMEMBERED:
            self._seen.clear()
        self._seen.add(names)
        both = [
            (number, ("none", i) if name is None else name)
            for i, (number, name) in enumerate(zip(self.always, names, strict=True))
        ]
        self.always = numbered(both)
        members = indices_of(names)
        self.unnamed.update(members.pop(None, ()))
        for some in members.values():
            self.together.update((i, i) for i in some)
            self.together.update(combinations(some, 2))


def _read_shared(
    read: FieldReader, data: Mapping[str, Any], sort: Sort, steps: int, of_step: Sequence[int] = ()
) -> Shared:
    """Read what all maps share of their dstates, places, paths or courses. Raises MapError.

    The file has one number for each step or, if `of_step` is given, for each dstate. `of_step` has
    the number of the dstate of each step.
    """
    step = read.within(0, steps - 1, f"a step from 0 to {steps - 1}")
    pairs = f"pairs of steps from 0 to {steps - 1}"
    count = len(set(of_step)) or steps
    record = read.mapping(data.get(sort), sort)
    shared = read.record(
        Shared,
        record,
        sort,
        always=read.several(read.whole, f"{count} numbers", count),
        sometimes=read.several(read.several(step, pairs, 2), pairs),
    )
    differing = read.several(step, f"a list of steps from 0 to {steps - 1}")
    return replace(
        shared,
        always=tuple(shared.always[number] for number in of_step) or shared.always,
        untold=differing(record.get("differing", []), f"{sort}.differing"),
    )


def _split(together: Iterable[Pair], parts: Mapping[int, Sequence[int]]) -> Iterator[Pair]:
    """Replace each pair of old classes by all pairs of their parts, the lower number first."""
    for i, j in together:
        for a in parts[i]:
            for b in parts[j]:
                yield (a, b) if a <= b else (b, a)


def sorts_of(maps: Iterable[SSHMap]) -> tuple[Sort, ...]:
    """Return what maps have: dstates, places if all have some, and paths if any has some."""
    dstates = [ssh_map.dstates for ssh_map in maps]
    if not all(any(s.place is not None for s in of_map) for of_map in dstates):
        return SORTS[:1]
    return SORTS if any(s.path is not None for of_map in dstates for s in of_map) else SORTS[:2]


def key_of(dstate: DState, sort: Sort) -> Hashable:
    """Return a key of a dstate, or of its place, path or course; None if it has none."""
    if sort == "dstates":
        return dstate.id
    if sort == "places":
        return dstate.place
    if sort == "paths":
        return dstate.path
    return None if dstate.path is None else (dstate.path, dstate.direction)


def _differing_in_words(sort: Sort, shared: Shared, steps: Sequence[int]) -> str:
    """Say at which steps maps differ in dstates, places or another sort. `steps` has the names."""
    one, whose, several = WORDS[sort]
    if len(shared.differing) == len(shared.sometimes) == 1:
        first, later = (steps[t] for t in shared.sometimes[0])
        return f"steps {first} and {later} are {one} in some of them"
    if len(shared.differing) == 1:
        return f"the {whose} of step {steps[shared.differing[0]]} differs"
    return f"the {several} of steps {stretches([steps[t] for t in shared.differing])} differ"


def stretches(steps: Sequence[int]) -> str:
    """Name steps in words, such as "12–15 and 40".

    A stretch is consecutive steps of one drive. If the drive has a name, it is "tuesday:12–15".
    Name at most NAMED stretches, and only count the steps of the others.
    """
    runs: list[list[int]] = []
    for step in steps:
        begins_drive = isinstance(step, DriveStep) and step == step.first
        if runs and step == runs[-1][-1] + 1 and not begins_drive:
            runs[-1].append(step)
        else:
            runs.append([step])
    parts = []
    for first, *_, last in ([*run, run[-1]] for run in runs[:NAMED]):
        in_drive = last - last.first if isinstance(last, DriveStep) else last
        parts.append(str(first) if first == last else f"{first}–{in_drive}")
    more = sum(map(len, runs[NAMED:]))
    return list_in_words([*parts, f"{more} more"] if more else parts)


def steps_in_words(steps: Sequence[int]) -> str:
    """Write step numbers in words, such as "step 40" or "steps 12–15 and 40"."""
    return f"{noun_of('step', steps)} {stretches(steps)}"
