"""How right maps are, where the steps of the trace say what is true.

>>> from dataclasses import replace
>>> from ssh_abduction import Theory, Trace, evaluate, solve
>>> seen = Trace.from_steps("abab", ["on", "on", "on"])
>>> rooms = ["hall", "nook", "yard", "nook"]
>>> trace = replace(seen, steps=tuple(replace(step, truth=room) for step, room in zip(seen.steps, rooms)))
>>> found = evaluate(solve(trace, Theory.causal()).maps, trace)
>>> found.rank, found.true_dstates, found.maps[0].dstates, found.maps[0].accuracy
(None, 3, 2, 0.75)

The minimal map takes the yard for the hall, which looks the same: three of four steps have the right label.

Everything is counted over the steps whose truth is told: a step without truth is left out, and so is, when places are counted, a step
of which only the dstate is told. What cannot be said is None: a share of nothing, a sort of thing (dstates, places, paths) that the
truth does not tell, and one that the map does not have, as maps of causal theories have no places. docs/formats.md says in which forms
a trace tells its truth. Nothing that infers maps may import this module.
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
    """How right one map is. Shares are from 0 to 1; what cannot be said is None.

    dstates_right    whether the labels are the true dstates up to renaming: two steps have one label exactly if they are at one true dstate
    places_right     the same of places
    paths_right      the same of paths, and of courses (a path and one of its directions) where the truth tells directions. The order of
                     the places on a path is no part of the truth
    accuracy         localisation accuracy: the share of steps with the right label, under the one-to-one assignment of dstates to
                     true dstates that makes it largest
    place_precision  of the pairs of steps that the map has at one place, the share that truly is
    place_recall     of the pairs of steps that truly are at one place, the share that the map has there
    edge_precision   edges join the places at both ends of a travel, in either direction. Of the map's edges, the share that is true,
                     under the best one-to-one assignment of places to true places
    edge_recall      of the true edges, the share that the map has. Both speak of travels that were driven, from one step to the next:
                     the edges of TOPO-Bench (Wang et al., arXiv 2510.04100) with a budget of one hop
    link_precision   the same of links: a dstate, an action, and the dstate that it leads to, under the assignment of dstates
    link_recall      of the true links, the share that the map has
    dstates, places, paths  how many the map has at the steps that are counted
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
        """Whether the map is the true one up to renaming: its dstates are right, and so are its places and paths where these can be said."""
        return (
            False
            if False in (self.dstates_right, self.places_right, self.paths_right)
            else self.dstates_right
        )

    def to_dict(self) -> dict[str, Any]:
        """The values under their names, as `evaluate --json` prints them."""
        return {"isomorphic": self.isomorphic, **asdict(self)}


@dataclass(frozen=True, slots=True)
class Evaluation:
    """How right maps of one trace are.

    maps          each map, in the order given
    steps         how many steps have truth
    true_dstates, true_places, true_paths  how many different ones the truth names; None where it names none
    ambiguity     how ambiguous the trace is: of the pairs of different true dstates, the share that shares a view
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
        return f"<Evaluation: {which}, of {counted(len(self.maps), 'maps')}; the truth is told at {counted(self.steps, 'steps')}>"

    @property
    def rank(self) -> int | None:
        """Which map is the first that is isomorphic to the truth, counted from 1; None if none is."""
        return next((i for i, found in enumerate(self.maps, 1) if found.isomorphic), None)

    def to_dict(self) -> dict[str, Any]:
        """The values under their names, as `evaluate --json` prints them."""
        own = {
            name: getattr(self, name)
            for name in ("rank", "steps", "true_dstates", "true_places", "true_paths", "ambiguity")
        }
        return {"count": len(self.maps), **own, "maps": [found.to_dict() for found in self.maps]}


def evaluate(maps: Iterable[SSHMap], trace: Trace) -> Evaluation:
    """How right these maps of a trace are.

    Raises TraceError where no step has truth, or where it contradicts itself; MapError for a map of other steps.
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
    """Whether the truth of some step names a dstate, a place or a path. Raises TraceError for what cannot be a name."""
    return any(
        name
        for t, step in enumerate(trace.steps)
        for name in _told(step.truth, trace.at(t)).values()
    )


class _Truth:
    """What the steps of a trace say is true. Names of dstates, places, paths and courses, one a step; None where a step does not tell it."""

    def __init__(self, trace: Trace) -> None:
        self.trace = trace
        told = [_told(step.truth, trace.at(t)) for t, step in enumerate(trace.steps)]
        self.dstates, self.places, self.paths, self.courses = (
            [step.get(sort) for step in told] for sort in _SORTS
        )
        if not any((*self.dstates, *self.places, *self.paths)):
            raise TraceError(
                f"{named(trace.source or 'trace')}: truth: expected the true dstate or place of some step, got none; "
                f'write "truth": {{"dstate": …, "place": …}} on the steps, or {{"pose": [x, y, heading]}}'
            )
        first: dict[Hashable, dict[str, tuple[int, Hashable]]] = {}
        for t, step in enumerate(told):
            for sort in ("place", "path", "course"):
                if (name := step.get(sort)) is not None and (
                    dstate := step.get("dstate")
                ) is not None:
                    before, known = first.setdefault(dstate, {}).setdefault(sort, (t, name))
                    if known != name:
                        field = "direction" if sort == "course" else sort
                        raise TraceError(
                            f"{trace.at(t)}: truth.{field}: expected {brief(trace.steps[before].truth[field])}, as {trace.at(before)} says "
                            f"of the same dstate, got {brief(trace.steps[t].truth[field])}; name another dstate, or mend the {field}"
                        )

    def dstate_hops(self) -> list[int]:
        """The steps whose dstate is told, and that of the next step, too."""
        return _hops(self.dstates)

    def place_hops(self) -> list[int]:
        """The steps after which the robot travelled, and whose place is told, and that of the next step, too."""
        return [t for t in _hops(self.places) if self.trace.actions[t].kind == "travel"]


_SORTS = ("dstate", "place", "path", "course")


def _told(value: Any, where: str) -> dict[str, Hashable]:
    """What the truth of a step tells, by sort. Names are JSON texts, so that lists and objects can be names, too. Raises TraceError."""

    def name(value: Any) -> str | None:
        try:
            return None if value is None else json.dumps(value, sort_keys=True, allow_nan=False)
        except (TypeError, ValueError, RecursionError):
            raise TraceError(
                f"{where}: truth: expected what JSON can hold, got {brief(value)}; name dstates by texts or numbers"
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
    """A map that has a label for each step of the trace. Raises MapError."""
    if not isinstance(ssh_map, SSHMap):
        raise MapError(
            f"{where}: expected an SSHMap, got {brief(ssh_map)}; take the maps of a solution, or SSHMap.load"
        )
    if len(ssh_map.labels) != len(trace):
        raise MapError(
            f"{where}: labels: expected {len(trace)}, one for each step of the trace, got {len(ssh_map.labels)}; solve this trace"
        )
    if strange := set(ssh_map.labels) - set(range(len(ssh_map.dstates))):
        raise MapError(
            f"{where}: labels: expected 0 to {len(ssh_map.dstates) - 1}, the dstates of the map, got {brief(min(strange))}; mend it"
        )
    return ssh_map


def _evaluated(ssh_map: SSHMap, truth: _Truth) -> MapEvaluation:
    at = [ssh_map.dstates[label] for label in ssh_map.labels]
    dstates = _Sort([s.id for s in at], truth.dstates)
    places = _Sort([s.place for s in at], truth.places)
    paths = _Sort([s.path for s in at], truth.paths)
    courses = _Sort([None if s.path is None else (s.path, s.direction) for s in at], truth.courses)
    actions = truth.trace.actions
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
    """One sort of thing, such as places, as a map and as the truth have it.

    said  what the map says each step is at; None: at none
    true  what each step truly is at; None: not told
    """

    def __init__(self, said: Sequence[Hashable], true: Sequence[Hashable]) -> None:
        self.said, self.true = said, true
        # How many steps the map has at the one and are truly at the other. In the order of the trace, so that names make no difference.
        self.steps = Counter((x, y) for x, y in zip(said, true, strict=True) if y is not None)
        self.of_map = list(dict.fromkeys(x for x, _ in self.steps if x is not None))
        self.of_truth = list(dict.fromkeys(y for _, y in self.steps))

    @property
    def right(self) -> bool | None:
        """Whether both tell the same steps apart; None where one of them tells nothing. A step that the map has at none makes a pair too many."""
        if not self.of_map:
            return None
        return len(self.steps) == len(self.of_map) == len(self.of_truth)

    @property
    def count(self) -> int | None:
        """How many the map has at the steps that are counted."""
        return len(self.of_map) or None

    @cached_property
    def assignment(self) -> dict[Hashable, Hashable]:
        """What the map has, each with another one of the truth, so that as many steps as can be are at what they are assigned to."""
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
        """The share of steps that are at what is assigned to what the map says."""
        return (
            _share(sum(self.steps[pair] for pair in self.assignment.items()), self.steps.total())
            if self.of_map
            else None
        )

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
        return _share(both, sum(comb(n, 2) for n in said.values())), _share(
            both, sum(comb(n, 2) for n in true.values())
        )

    def edges(
        self, hops: Iterable[int], edge: Callable[[int, Hashable, Hashable], Hashable]
    ) -> tuple[float | None, float | None]:
        """Precision and recall of edges, each between a step and the next one, under the assignment.

        edge  what joins two things, after this step: edges that are equal count once
        """
        if not self.of_map:
            return None, None
        said: dict[
            Hashable, Hashable
        ] = {}  # each edge of the map, and the edge that it is assigned to
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
    """Of the pairs of different dstates that were seen, the share that shares a view."""
    seen: dict[Hashable, set[View]] = {}
    for view, dstate in zip(views, dstates, strict=True):
        if view is not None and dstate is not None:
            seen.setdefault(dstate, set()).add(view)
    alike = Counter(
        frozenset(own) for own in seen.values()
    )  # most dstates have one view, so there are few sets of views
    shared = sum(comb(n, 2) for n in alike.values()) + sum(
        n * m for (a, n), (b, m) in combinations(alike.items(), 2) if a & b
    )
    return _share(shared, comb(len(seen), 2))
