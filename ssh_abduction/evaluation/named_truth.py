"""The accuracy of maps, if the steps of a trace name their true dstates, places and paths.

>>> from dataclasses import replace
>>> from ssh_abduction import Theory, Trace, evaluate, solve
>>> seen = Trace.from_steps("abab", ["on", "on", "on"])
>>> rooms = ["hall", "nook", "yard", "nook"]
>>> steps = [replace(step, truth=room) for step, room in zip(seen.steps, rooms)]
>>> trace = replace(seen, steps=tuple(steps))
>>> found = evaluate(solve(trace, Theory.causal()).maps, trace)
>>> found.rank, found.true_dstates, found.maps[0].dstates, found.maps[0].accuracy
(None, 3, 2, 0.75)

The minimal map takes the yard for the hall, which looks the same: three of four steps have the
right label.

Only steps with truth are counted; for places, only steps whose true place is known. A value is None
if it cannot be said: a share of nothing, or a sort of thing (dstates, places, paths) that the truth
or the map does not have. Maps of causal theories have no places, for example.
docs/reference/formats.md says in which forms a trace has its truth. Nothing that infers maps may
import this module.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from itertools import combinations
from math import comb
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from ssh_abduction.data.errors import MapError, TraceError, brief, named
from ssh_abduction.data.maps import SSHMap, checked_maps
from ssh_abduction.data.trace import Trace, View, checked_trace
from ssh_abduction.data.words import counted


@dataclass(frozen=True, slots=True)
class MapEvaluation:
    """The accuracy of one map. Shares are from 0 to 1; an unknown value is None.

    An edge joins the places at both ends of a travel, in either direction. Edges are counted for
    travels that were driven, from one step to the next: the edges of TOPO-Bench (Wang et al., arXiv
    2510.04100) with a budget of one hop. A link is a dstate, an action, and the dstate that it
    leads to.

    Attributes:
        dstates_right: Whether the labels are the true dstates up to renaming: two steps have one
            label exactly if they are at one true dstate.
        places_right: The same for places.
        paths_right: The same for paths, and for courses (a path and a direction) if the truth has
            directions. The order of places on a path is no part of the truth.
        accuracy: Localisation accuracy: the share of steps with the right label, under the best
            one-to-one assignment of dstates to true dstates.
        place_precision: Of the pairs of steps at one place in the map, the share that truly is.
        place_recall: Of the pairs of steps that truly are at one place, the share in the map.
        edge_precision: Of the map's edges, the share that is true, under the best one-to-one
            assignment of places to true places.
        edge_recall: Of the true edges, the share that the map has.
        link_precision: Of the map's links, the share that is true, under the assignment of dstates.
        link_recall: Of the true links, the share that the map has.
        dstates: How many dstates the map has at the counted steps.
        places: Number of places.
        paths: Number of paths.
    """

    dstates_right: bool | None
    places_right: bool | None
    paths_right: bool | None
    accuracy: float | None
    place_precision: float | None
    place_recall: float | None
    edge_precision: float | None
    edge_recall: float | None
    link_precision: float | None
    link_recall: float | None
    dstates: int | None
    places: int | None
    paths: int | None

    @property
    def isomorphic(self) -> bool | None:
        """Whether the map is the true one up to renaming.

        Its dstates are right, and its places and paths as far as they are known.
        """
        if False in (self.dstates_right, self.places_right, self.paths_right):
            return False
        return self.dstates_right

    def to_dict(self) -> dict[str, Any]:
        """The values under their names, as `evaluate --json` prints them."""
        return {"isomorphic": self.isomorphic, **asdict(self)}


@dataclass(frozen=True, slots=True)
class Evaluation:
    """The accuracy of maps of one trace.

    Attributes:
        maps: Each map, in the order given.
        steps: How many steps have truth.
        true_dstates: How many different dstates the truth names; None if it names none.
        true_places: Number of distinct places.
        true_paths: Number of distinct paths.
        ambiguity: Of the pairs of different true dstates, the share that shares a view.
    """

    maps: tuple[MapEvaluation, ...]
    steps: int
    true_dstates: int | None
    true_places: int | None
    true_paths: int | None
    ambiguity: float | None

    def __repr__(self) -> str:
        which = (
            "no map is the true one" if self.rank is None else f"map {self.rank} is the true one"
        )
        maps, steps = counted(len(self.maps), "maps"), counted(self.steps, "steps")
        return f"<Evaluation: {which}, of {maps}; the truth is told at {steps}>"

    @property
    def rank(self) -> int | None:
        """The number of the first map that is isomorphic to the truth, from 1; None if none is."""
        return next((i for i, found in enumerate(self.maps, 1) if found.isomorphic), None)

    def to_dict(self) -> dict[str, Any]:
        """The values under their names, as `evaluate --json` prints them."""
        own = {
            name: getattr(self, name)
            for name in ("rank", "steps", "true_dstates", "true_places", "true_paths", "ambiguity")
        }
        return {"count": len(self.maps), **own, "maps": [found.to_dict() for found in self.maps]}


def evaluate(maps: Iterable[SSHMap], trace: Trace) -> Evaluation:
    """The accuracy of maps of a trace.

    Args:
        maps: Maps of the trace.
        trace: A trace whose steps name what is true.

    Raises:
        TraceError: No step has truth, or the truth contradicts itself.
        MapError: A map is of other steps.
    """
    maps = checked_maps(maps)
    truth = _Truth(checked_trace(trace))
    return Evaluation(
        maps=tuple(
            _evaluated(checked_map(ssh_map, f"maps[{i}]", trace), truth)
            for i, ssh_map in enumerate(maps)
        ),
        steps=sum(any(told) for told in zip(truth.dstates, truth.places, truth.paths, strict=True)),
        true_dstates=_different(truth.dstates),
        true_places=_different(truth.places),
        true_paths=_different(truth.paths),
        ambiguity=_ambiguity(trace.views, truth.dstates),
    )


def tells_names(trace: Trace) -> bool:
    """Whether the truth of some step names a dstate, a place or a path.

    Raises TraceError for what cannot be a name.
    """
    return any(
        name
        for t, step in enumerate(trace.steps)
        for name in _told(step.truth, trace.at(t)).values()
    )


class _Truth:
    """The true names of dstates, places, paths and courses, one a step; None if unknown.

    Raises TraceError if no step has a name, or one dstate has two places, paths or courses.
    """

    def __init__(self, trace: Trace) -> None:
        self.trace = trace
        told = [_told(step.truth, trace.at(t)) for t, step in enumerate(trace.steps)]
        self.dstates, self.places, self.paths, self.courses = (
            [step.get(sort) for step in told] for sort in _SORTS
        )
        if not any((*self.dstates, *self.places, *self.paths)):
            raise TraceError(
                f"{named(trace.source or 'trace')}: truth: expected the true dstate or place of "
                'some step, got none; write "truth": {"dstate": …, "place": …} on the steps, '
                'or {"pose": [x, y, heading]}'
            )
        # The first step at each dstate that names its place, path or course.
        first: dict[tuple[Hashable, str], tuple[int, Hashable]] = {}
        for t, step in enumerate(told):
            dstate = step.get("dstate")
            for sort in ("place", "path", "course"):
                name = step.get(sort)
                if dstate is None or name is None:
                    continue
                before, known = first.setdefault((dstate, sort), (t, name))
                if known != name:
                    field = "direction" if sort == "course" else sort
                    expected, got = (brief(trace.steps[i].truth[field]) for i in (before, t))
                    raise TraceError(
                        f"{trace.at(t)}: truth.{field}: expected {expected}, as {trace.at(before)} "
                        f"says of the same dstate, got {got}; "
                        f"name another dstate, or mend the {field}"
                    )

    def dstate_hops(self) -> list[int]:
        """The steps with a true dstate at this and the next step."""
        return _hops(self.dstates)

    def place_hops(self) -> list[int]:
        """The steps before a travel with a true place at this and the next step."""
        return [t for t in _hops(self.places) if self.trace.actions[t].kind == "travel"]


_SORTS = ("dstate", "place", "path", "course")


def _told(value: Any, where: str) -> dict[str, Hashable]:
    """The true names of a step, by sort.

    Names become JSON texts, so that lists and objects can also be names. Raises TraceError for what
    JSON cannot hold.
    """

    def name(value: Any) -> str | None:
        try:
            return None if value is None else json.dumps(value, sort_keys=True, allow_nan=False)
        except (TypeError, ValueError, RecursionError):
            raise TraceError(
                f"{where}: truth: expected what JSON can hold, got {brief(value)}; "
                "name dstates by texts or numbers"
            ) from None

    if not isinstance(value, Mapping):
        return {} if value is None else {"dstate": name(value)}
    told: dict[str, Hashable] = {
        sort: name(value.get(sort)) for sort in ("dstate", "place", "path")
    }
    heading, direction = name(value.get("heading")), name(value.get("direction"))
    if told["dstate"] is None and None not in (told["place"], heading):
        told["dstate"] = told["place"], heading  # a distinctive state is a position and a heading
    if None not in (told["path"], direction):
        told["course"] = told["path"], direction
    return told


def _hops(names: Sequence[Hashable]) -> list[int]:
    return [t for t in range(len(names) - 1) if names[t] is not None and names[t + 1] is not None]


def checked_map(ssh_map: object, where: str, trace: Trace) -> SSHMap:
    """A map that has a label for each step of the trace. Raises MapError for anything else."""
    if not isinstance(ssh_map, SSHMap):
        raise MapError(
            f"{where}: expected an SSHMap, got {brief(ssh_map)}; "
            "take the maps of a solution, or SSHMap.load"
        )
    if len(ssh_map.labels) != len(trace):
        raise MapError(
            f"{where}: labels: expected {len(trace)}, one for each step of the trace, "
            f"got {len(ssh_map.labels)}; solve this trace"
        )
    if strange := set(ssh_map.labels) - set(range(len(ssh_map.dstates))):
        raise MapError(
            f"{where}: labels: expected 0 to {len(ssh_map.dstates) - 1}, the dstates of the map, "
            f"got {brief(min(strange))}; mend it"
        )
    return ssh_map


def _evaluated(ssh_map: SSHMap, truth: _Truth) -> MapEvaluation:
    """The accuracy of a map."""
    at = [ssh_map.dstates[label] for label in ssh_map.labels]
    dstates = _Sort([s.id for s in at], truth.dstates)
    places = _Sort([s.place for s in at], truth.places)
    paths = _Sort([s.path for s in at], truth.paths)
    courses = _Sort([None if s.path is None else (s.path, s.direction) for s in at], truth.courses)
    actions = truth.trace.actions
    # An edge joins two places either way; a link has an action and a direction.
    place_precision, place_recall = places.pairs()
    edge_precision, edge_recall = places.edges(
        truth.place_hops(), lambda _, here, there: frozenset((here, there))
    )
    link_precision, link_recall = dstates.edges(
        truth.dstate_hops(), lambda t, here, there: (here, actions[t].name, there)
    )
    return MapEvaluation(
        dstates_right=dstates.right,
        places_right=places.right,
        paths_right=False if courses.right is False else paths.right,
        accuracy=dstates.accuracy,
        place_precision=place_precision,
        place_recall=place_recall,
        edge_precision=edge_precision,
        edge_recall=edge_recall,
        link_precision=link_precision,
        link_recall=link_recall,
        dstates=dstates.count,
        places=places.count,
        paths=paths.count,
    )


class _Sort:
    """One sort of thing, such as places, in a map and in the truth.

    Args:
        said: What the map says each step is at; None for nothing.
        true: What each step truly is at; None if unknown.
    """

    def __init__(self, said: Sequence[Hashable], true: Sequence[Hashable]) -> None:
        self.said, self.true = said, true
        # How many steps are at x in the map and truly at y. They are in the order of the trace, so
        # that names make no difference.
        self.steps = Counter((x, y) for x, y in zip(said, true, strict=True) if y is not None)
        self.of_map = list(dict.fromkeys(x for x, _ in self.steps if x is not None))
        self.of_truth = list(dict.fromkeys(y for _, y in self.steps))

    @property
    def right(self) -> bool | None:
        """Whether map and truth distinguish the same steps; None if either says nothing."""
        if not self.of_map:
            return None
        # A step that is at nothing in the map makes a pair too many.
        return len(self.steps) == len(self.of_map) == len(self.of_truth)

    @property
    def count(self) -> int | None:
        """How many things the map has at the counted steps."""
        return len(self.of_map) or None

    @cached_property
    def assignment(self) -> dict[Hashable, Hashable]:
        """The one-to-one assignment of the map's things to true ones that suits most steps."""
        rows, columns = (
            {name: i for i, name in enumerate(names)} for names in (self.of_map, self.of_truth)
        )
        table = np.zeros((len(rows), len(columns)))
        for (x, y), steps in self.steps.items():
            if x is not None:
                table[rows[x], columns[y]] = steps
        return {
            self.of_map[i]: self.of_truth[j]
            for i, j in zip(*linear_sum_assignment(table, maximize=True), strict=True)
        }

    @property
    def accuracy(self) -> float | None:
        """The share of steps that are right under the assignment."""
        if not self.of_map:
            return None
        return _share(sum(self.steps[pair] for pair in self.assignment.items()), self.steps.total())

    def pairs(self) -> tuple[float | None, float | None]:
        """Precision and recall of pairs of steps at one thing."""
        if not self.of_map:
            return None, None
        said, true = Counter[Hashable](), Counter[Hashable]()
        for (x, y), steps in self.steps.items():
            said[x] += steps
            true[y] += steps
        del said[None]
        both = sum(comb(steps, 2) for (x, _), steps in self.steps.items() if x is not None)
        of_map, of_truth = (sum(comb(n, 2) for n in found.values()) for found in (said, true))
        return _share(both, of_map), _share(both, of_truth)

    def edges(
        self, hops: Iterable[int], edge: Callable[[int, Hashable, Hashable], Hashable]
    ) -> tuple[float | None, float | None]:
        """Precision and recall of edges, under the assignment.

        Args:
            hops: The steps before an edge.
            edge: Makes an edge of a step and the things at its ends. Equal edges count once.
        """
        if not self.of_map:
            return None, None
        said: dict[Hashable, Hashable] = {}  # an edge of the map: the edge that it is assigned to
        true = set()
        for t in hops:
            here, there = self.said[t], self.said[t + 1]
            said[edge(t, here, there)] = edge(
                t, self.assignment.get(here), self.assignment.get(there)
            )
            true.add(edge(t, self.true[t], self.true[t + 1]))
        right = sum(assigned in true for assigned in said.values())
        return _share(right, len(said)), _share(right, len(true))


def _different(names: Iterable[Hashable]) -> int | None:
    return len(set(names) - {None}) or None


def _share(part: int, whole: int) -> float | None:
    return part / whole if whole else None


def _ambiguity(views: Sequence[View | None], dstates: Sequence[Hashable]) -> float | None:
    """The share of pairs of visited dstates that have the same view."""
    seen: dict[Hashable, set[View]] = {}
    for view, dstate in zip(views, dstates, strict=True):
        if view is not None and dstate is not None:
            seen.setdefault(dstate, set()).add(view)
    # Most dstates have one view, so there are few different sets of views.
    alike = Counter(frozenset(own) for own in seen.values())
    shared = sum(comb(n, 2) for n in alike.values()) + sum(
        n * m for (a, n), (b, m) in combinations(alike.items(), 2) if a & b
    )
    return _share(shared, comb(len(seen), 2))
