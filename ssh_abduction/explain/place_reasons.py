"""Explain on which side of a path a place lies, and behind which place it lies.

>>> from ssh_abduction import Trace
>>> corner = Trace.from_steps("abcd", ["travel", "right", "travel"])
>>> print(explain_place(corner, 2, 0))
place 2 lies right of path 0+: step 1 turned right from path 0+ onto path 1+ at place 1, and place 2 is ahead on path 1+

Places and paths have the numbers of the first minimal map. Other maps may have other numbers, so
places and paths are identified by steps: take the first step at the place in the first map, and
then the place of this step in the other map. Likewise for a path, by the first step along it.
"""  # noqa: E501 - one line of output

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from typing import Any, TypeAlias, Unpack

from ssh_abduction.checker.reading import Course, Reading
from ssh_abduction.checker.sides import RightBranch, known_sides
from ssh_abduction.data.checks import a_whole_number
from ssh_abduction.data.errors import MapError
from ssh_abduction.data.map_parts import course_named, list_in_words, regions_at
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.schema import PlainData
from ssh_abduction.data.trace import Trace
from ssh_abduction.explain.no_map import LimitedQuestion, QuestionLimits
from ssh_abduction.solution import Stop
from ssh_abduction.solver import Judging, with_regions
from ssh_abduction.theory.theory import Theory, checked_theory

# The side of a path on which a place is known to lie; "on" if it is on the path.
_Side: TypeAlias = str | None
LISTED = 100  # list at most this many minimal maps, to count those that agree on a side


def explain_place(
    trace: Trace,
    place: int,
    path: int | None = None,
    theory: Theory | None = None,
    *,
    time_limit: float | None = None,
    memory_limit: int | None = None,
    known: Iterable[SSHMap] = (),
) -> PlaceExplanation:
    """Explain on which side of a path a place lies, or in which regions it lies.

    Args:
        trace: The trace, with views.
        place: The id of a place in the first known map or, if none is known, in the first minimal
            map.
        path: The id of a path in that map; None to explain all paths and all regions of the place.
        theory: The theory; Theory.topological() if None.
        time_limit: Seconds; None for no limit.
        memory_limit: MiB; None for no limit.
        known: Maps of the trace, such as those of a solution. If the first one satisfies the
            theory, the answer is about the known maps that do, and none is searched for.

    Returns:
        A reason for each side that is known, and the number of minimal maps that agree.

    Raises:
        MapError: The map has no such place or path, or a known map is of another trace.
        TraceError, TheoryError: As `solve` does.
    """
    limits = QuestionLimits(time_limit=time_limit, memory_limit=memory_limit, known=known)
    return PlaceQuestion(trace, place, path, checked_theory(theory), **limits).answer()


@dataclass(frozen=True, slots=True)
class PathSide(PlainData):
    """The side of a path on which a place lies, and why."""

    path: int  # the id of the path
    # "right" or "left" of the path in direction +1; "on" if the place is on the path; None if
    # unknown.
    side: _Side
    # The step of the turn that shows the side, and the next step; empty if no turn does.
    steps: tuple[int, ...]
    sentence: str  # the side and its reason in words
    agree: int  # the number of listed minimal maps that have the same side


@dataclass(frozen=True, slots=True)
class PlaceExplanation(PlainData):
    """Where a place lies: its sides of paths, and the regions around it.

    Attributes:
        place: The id of the place.
        sides: The side of the path that was given; else the known sides of all paths.
        regions: A sentence for each region that contains the place; empty if a path was given.
        changes: Sentences about the gateways of the place that changed between drives; empty if a
            path was given.
        maps: The number of listed minimal maps; 0 if no map was found.
        possible: Whether the trace has a map; None if a limit ended the search before.
        stopped: The limit that ended the search; None if it ended by itself.
    """

    place: int
    sides: tuple[PathSide, ...]
    regions: tuple[str, ...]
    changes: tuple[str, ...]
    maps: int
    possible: bool | None
    stopped: Stop | None

    @property
    def sentences(self) -> tuple[str, ...]:
        """The answer in words, a tuple of sentences."""
        if not self.maps:
            why = "the trace has no map" if self.possible is False else "no map was found in time"
            return (f"{why}, so nothing is known about place {self.place}",)
        sentences = []
        for side in self.sides:
            few = side.agree < self.maps
            also = f"; this holds in {side.agree} of {self.maps} minimal maps" if few else ""
            sentences.append(f"{side.sentence}{also}")
        sentences += self.regions
        if not sentences:
            sentences = [f"place {self.place} lies on no known side of a path, and in no region"]
        return (*sentences, *self.changes)

    def __str__(self) -> str:
        return "\n".join(self.sentences)

    def to_dict(self) -> dict[str, Any]:
        """Return the explanation as plain data, as `explain --json` prints it."""
        return {**PlainData.to_dict(self), "sentences": list(self.sentences)}


class PlaceQuestion(LimitedQuestion[PlaceExplanation]):
    """The search for the maps of a trace and the sides of a place. See `explain_place`."""

    def __init__(
        self,
        trace: Trace,
        place: int,
        path: int | None = None,
        theory: Theory | None = None,
        **limits: Unpack[QuestionLimits],
    ) -> None:
        super().__init__(trace, theory, **limits)
        a_whole_number("place", place, MapError, 0)
        if path is not None:
            a_whole_number("path", path, MapError, 0)
        self._place, self._path = place, path
        self._maps: tuple[SSHMap, ...] = ()
        self._possible: bool | None = None

    def _find_out(self) -> None:
        accepts = Judging(self.problem).accepts
        if self._known_maps and accepts(self._known_maps[0]):
            self._maps = tuple(filter(accepts, self._known_maps))
            self._possible = True
        else:
            search = self._solved(self.trace, self.theory, LISTED, self._watch.left())
            solution = search.solution(tuple(search))
            self._ended(search)
            self._maps = solution.minimal_maps or solution.maps
            self._possible = bool(self._maps) or (None if search.stopped else False)

    def known(self, why: Stop | None = None) -> PlaceExplanation:
        """Return what is known so far. Raises MapError if the map has no such place or path."""
        sides, regions = self._sides_and_regions() if self._maps else ((), ())
        changes: tuple[str, ...] = ()
        if self._maps and self._path is None:
            changes = changes_in_words(self._maps[0], [self._place])
        found = self._place, sides, regions, changes, len(self._maps), self._possible
        return PlaceExplanation(*found, stopped=why or self.stopped)

    def _sides_and_regions(self) -> tuple[tuple[PathSide, ...], tuple[str, ...]]:
        """Find the sides and the regions of the place. Raises MapError, as `known`."""
        first = self._maps[0]
        paths = [h.id for h in first.theory_paths]
        _check("place", self._place, first.places)
        if self._path is not None:
            _check("path", self._path, paths)
        readings = [Reading(self.trace, m, self.theory) for m in self._maps]
        asked = paths if self._path is None else [self._path]
        sides = [_path_side(readings, self._place, path) for path in asked]
        if self._path is not None:
            return tuple(sides), ()
        around = regions_at(with_regions(first, self.trace, self.theory).regions or (), self._place)
        regions = tuple(
            f"place {self._place} lies in {region}"
            + ("" if region.door is None else f": all links to it lead through place {region.door}")
            for region in around
        )
        return tuple(side for side in sides if side.side in ("right", "left")), regions


def _check(name: str, number: int, known: Iterable[int]) -> None:
    """Raise MapError if the first map has no such place or path."""
    known = [*known]
    if number not in known:
        some = f"{name}s {list_in_words(known)}" if known else f"no {name}s by its axioms"
        raise MapError(
            f"{name}: expected a {name} of the first minimal map, got {number}; the map has {some}"
        )


def _path_side(readings: list[Reading], place: int, path: int) -> PathSide:
    """Find the side of a path on which a place lies in the first map, and how many maps agree."""
    first, *others = readings
    side, branch = _side_of(first, place, (path, 1))
    at = next(t for t, s in first.visited if s.place == place)
    along = next((t, s.direction) for t, s in first.visited if s.path == path)
    agree = 1
    for m in others:
        there, facing = m.map.place_of(at), m.states[m.map.dstate_at[along[0]]]
        if there is None or facing.path is None or facing.direction is None:
            continue
        course = facing.path, facing.direction * (along[1] or 1)
        agree += _side_of(m, there, course)[0] == side
    sentence = _sentence(place, path, side, branch)
    return PathSide(path, side, branch.turn.steps if branch else (), sentence, agree)


def _side_of(m: Reading, place: int, course: Course) -> tuple[_Side, RightBranch | None]:
    """Find the side of a course on which a place lies; None if unknown.

    Also return the branch (a course that leaves this one) that shows the side, if there is one.
    """
    if place in m.along.get(course[0], ()):
        return "on", None
    sides = m.once(known_sides)
    for side, way in (("right", course), ("left", (course[0], -course[1]))):
        if place in sides.get(way, {}):
            return side, sides[way][place]
    return None, None


def _sentence(place: int, path: int, side: _Side, branch: RightBranch | None) -> str:
    """Say on which side of a path in direction +1 a place lies, and why."""
    name = course_named((path, 1))
    if side == "on":
        return f"place {place} is on path {path}"
    if branch is None:
        return (
            f"no turn shows on which side of path {path} place {place} lies: no path that leaves "
            f"path {path} by a turn is known to have place {place} ahead"
        )
    turn = branch.turn
    source, target = turn.source, turn.target
    onto = [
        course_named((s.path, s.direction))
        for s in (source, target)
        if s.path is not None and s.direction is not None
    ]
    reason = (
        f"step {turn.step} turned {turn.action.turn} from {onto[0]} onto {onto[1]} "
        f"at place {branch.place}"
    )
    ahead = course_named(branch.branch)
    leaves = "" if ahead == onto[1] else f", so {ahead} leaves {name} on the {side} there"
    where = f"place {place} lies {side} of {name}"
    return f"{where}: {reason}{leaves}, and place {place} is ahead on {ahead}"


def changes_in_words(ssh_map: SSHMap, places: Collection[int | None]) -> tuple[str, ...]:
    """Say which gateways at these places changed between drives, and what each change costs."""
    changes = (f for f in ssh_map.faults if f.kind == "changed" and f.place in places)
    return tuple(f"{change}; this change costs {change.cost:g} dstates" for change in changes)
