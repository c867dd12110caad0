"""Measure the accuracy of maps of a trace whose steps name their true dstates, places and paths.

>>> from dataclasses import replace
>>> from ssh_abduction import Theory, Trace, evaluate, solve
>>> seen = Trace.from_steps("abab", ["on", "on", "on"])
>>> rooms = ["hall", "nook", "yard", "nook"]
>>> steps = [replace(step, truth=room) for step, room in zip(seen.steps, rooms)]
>>> trace = replace(seen, steps=tuple(steps))
>>> found = evaluate(solve(trace, Theory.causal()).maps, trace)
>>> found.rank, found.true_dstates, found.maps[0].dstates, found.maps[0].accuracy
(None, 3, 2, 0.75)

In this example the yard looks like the hall, and the minimal map makes them one dstate. Three of
four steps have the right label.

Only steps with truth are counted. For places, these are the steps whose true place is known. A
value is None if it is not defined: a share of nothing, or a value about dstates, places or paths
that the truth or the map does not have. For example, maps of causal theories have no places.
docs/reference/formats.md describes how a trace stores its truth. Code that infers maps must not
import this module.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import combinations
from math import comb
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from ssh_abduction.data.errors import MapError, TraceError, brief, named
from ssh_abduction.data.maps import SSHMap, check_labels, checked_map, checked_maps
from ssh_abduction.data.schema import attributes_of
from ssh_abduction.data.trace import Trace, View, checked_trace
from ssh_abduction.data.words import counted

_SORTS = ("dstate", "place", "path", "course")


@dataclass(frozen=True, slots=True)
class MapEvaluation:
    """The accuracy of one map. Shares are from 0 to 1. A value that is not defined is None.

    An edge joins the places at both ends of a travel, in either direction. Edges are counted only
    for travels that the robot did, from one step to the next. These are the edges of TOPO-Bench
    (Wang et al., arXiv 2510.04100) with a budget of one hop. A link is a dstate, an action, and the
    dstate that the action leads to.

    Attributes:
        dstates_right: Whether the labels are the true dstates up to renaming: two steps have the
            same label if and only if they are at one true dstate.
        places_right: Whether the places are the true places, up to renaming.
        paths_right: Whether the paths are the true paths, up to renaming. If the truth has
            directions, the directions also have to be right. The order of the places along a path
            is not judged.
        accuracy: Localisation accuracy: the share of steps with the right label, under the best
            one-to-one assignment of dstates to true dstates.
        place_precision: The share of pairs of steps at one place of the map that are truly at one
            place.
        place_recall: The share of pairs of steps truly at one place that the map has at one place.
        edge_precision: The share of edges of the map that are true, under the best one-to-one
            assignment of places to true places.
        edge_recall: The share of true edges that the map has.
        link_precision: The share of links of the map that are true, under the assignment of
            dstates to true dstates.
        link_recall: The share of true links that the map has.
        dstates: The number of dstates that the map has at the counted steps.
        places: The number of places at the counted steps.
        paths: The number of paths at the counted steps.
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
        """Whether the map is the true one up to renaming; None if the true dstates are unknown.

        The dstates have to be right, and also the places and paths if their truth is known. The
        value is False if any of these is wrong.
        """
        if False in (self.dstates_right, self.places_right, self.paths_right):
            return False
        return self.dstates_right

    def to_dict(self) -> dict[str, Any]:
        """Return a dict from names to values, as `evaluate --json` prints it."""
        return {"isomorphic": self.isomorphic, **asdict(self)}


@dataclass(frozen=True, slots=True)
class Evaluation:
    """The accuracy of maps of one trace.

    Attributes:
        maps: The accuracy of each map, in the given order.
        steps: The number of steps that have truth.
        true_dstates: The number of different dstates in the truth; None if it has none.
        true_places: The number of different places in the truth; None if it has none.
        true_paths: The number of different paths in the truth; None if it has none.
        ambiguity: The share of pairs of different true dstates that have a view in common; None if
            there are no such pairs.
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
        return f"<Evaluation: {which}, of {maps}; the truth is known at {steps}>"

    @property
    def rank(self) -> int | None:
        """The number of the first map that is isomorphic to the truth, from 1; None if none is."""
        return next((i for i, found in enumerate(self.maps, 1) if found.isomorphic), None)

    def to_dict(self) -> dict[str, Any]:
        """Return a dict from names to values, as `evaluate --json` prints it."""
        truth = ("true_dstates", "true_places", "true_paths", "ambiguity")
        return {"count": len(self.maps), **attributes_of(self, "rank", "steps", *truth, "maps")}


def evaluate(maps: Iterable[SSHMap], trace: Trace) -> Evaluation:
    """Measure the accuracy of maps of a trace, by the true dstates, places and paths of its steps.

    Args:
        maps: Maps of the trace.
        trace: A trace with `truth` at some of its steps.

    Returns:
        The accuracy of each map, and counts of the truth.

    Raises:
        TraceError: No step has truth, or the truth contradicts itself.
        MapError: A map is not of the steps of this trace.
    """
    maps = checked_maps(maps)
    truth = _Truth(checked_trace(trace))
    return Evaluation(
        maps=tuple(
            _evaluated(map_of_trace(ssh_map, f"maps[{i}]", trace), truth)
            for i, ssh_map in enumerate(maps)
        ),
        steps=sum(
            any(names) for names in zip(truth.dstates, truth.places, truth.paths, strict=True)
        ),
        true_dstates=_different(truth.dstates),
        true_places=_different(truth.places),
        true_paths=_different(truth.paths),
        ambiguity=_ambiguity(trace.views, truth.dstates),
    )


def tells_names(trace: Trace) -> bool:
    """Tell whether the truth of some step names a dstate, place or path. Raises TraceError."""
    return any(
        name
        for t, step in enumerate(trace.steps)
        for name in _names_in(step.truth, trace.at(t)).values()
    )


class _Truth:
    """The true names of the dstate, place, path and course of each step; None for unknown ones.

    Raises TraceError if no step has a name, or a dstate has two places, paths or courses.
    """

    def __init__(self, trace: Trace) -> None:
        self.trace = trace
        names = [_names_in(step.truth, trace.at(t)) for t, step in enumerate(trace.steps)]
        self.dstates, self.places, self.paths, self.courses = (
            [step.get(sort) for step in names] for sort in _SORTS
        )
        if not any((*self.dstates, *self.places, *self.paths)):
            raise TraceError(
                f"{named(trace.source or 'trace')}: truth: expected the true dstate or place of "
                'some step, got none; write "truth": {"dstate": …, "place": …} on the steps, '
                'or {"pose": [x, y, heading]}'
            )
        # For each dstate, the first step there that names its place, path or course.
        first: dict[tuple[Hashable, str], int] = {}
        for t, step in enumerate(names):
            for sort in ("place", "path", "course"):
                if step.get("dstate") is None or step.get(sort) is None:
                    continue
                before = first.setdefault((step["dstate"], sort), t)
                if names[before][sort] != step[sort]:
                    field = "direction" if sort == "course" else sort
                    expected, got = (brief(trace.steps[i].truth[field]) for i in (before, t))
                    raise TraceError(
                        f"{trace.at(t)}: truth.{field}: expected {expected}, as {trace.at(before)} "
                        f"says of the same dstate, got {got}; "
                        f"name another dstate, or mend the {field}"
                    )


def _names_in(value: Any, where: str) -> dict[str, Hashable]:
    """Return the true names of a step by sort (dstate, place, path, course). Raises TraceError.

    Names are converted to JSON texts, so that lists and objects can also be names. Unknown
    names are None or missing.
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
    names: dict[str, Hashable] = {
        sort: name(value.get(sort)) for sort in ("dstate", "place", "path")
    }
    heading, direction = name(value.get("heading")), name(value.get("direction"))
    if names["dstate"] is None and None not in (names["place"], heading):
        names["dstate"] = names["place"], heading  # a distinctive state is a position and a heading
    if None not in (names["path"], direction):
        names["course"] = names["path"], direction
    return names


def _hops(names: Sequence[Hashable]) -> list[int]:
    return [t for t in range(len(names) - 1) if names[t] is not None and names[t + 1] is not None]


def map_of_trace(ssh_map: object, where: str, trace: Trace) -> SSHMap:
    """Return a value if it is a map with a valid label for each step of the trace.

    Raises MapError, which names the map `where`.
    """
    ssh_map = checked_map(ssh_map, where)
    check_labels(ssh_map, trace, where)
    if strange := set(ssh_map.dstate_at) - set(range(len(ssh_map.dstates))):
        raise MapError(
            f"{where}: labels: expected 0 to {len(ssh_map.dstates) - 1}, the dstates of the map, "
            f"got {brief(min(strange))}; mend it"
        )
    return ssh_map


def _evaluated(ssh_map: SSHMap, truth: _Truth) -> MapEvaluation:
    """Measure the accuracy of a map by the true names of the steps."""
    at = [ssh_map.dstates[label] for label in ssh_map.dstate_at]
    dstates = _Sort([s.id for s in at], truth.dstates)
    places = _Sort([s.place for s in at], truth.places)
    paths = _Sort([s.path for s in at], truth.paths)
    courses = _Sort([None if s.path is None else (s.path, s.direction) for s in at], truth.courses)
    actions = truth.trace.actions
    # An edge joins two places either way; a link has an action and a direction.
    travels = [t for t in _hops(truth.places) if actions[t].kind == "travel"]
    moves = [t for t in _hops(truth.dstates) if not actions[t].starts]
    return MapEvaluation(
        dstates.right,
        places.right,
        False if courses.right is False else paths.right,
        dstates.accuracy,
        *places.pairs(),
        *places.edges(travels, lambda _, here, there: frozenset((here, there))),
        *dstates.edges(moves, lambda t, here, there: (here, actions[t].name, there)),
        dstates.count,
        places.count,
        paths.count,
    )


class _Sort:
    """One sort of thing (dstates, places, paths or courses) in a map and in the truth, by step."""

    def __init__(self, said: Sequence[Hashable], true: Sequence[Hashable]) -> None:
        self.said, self.true = said, true
        judged = [(x, y) for x, y in zip(said, true, strict=True) if y is not None]
        # Things are numbered by their first step, so that results do not depend on names.
        self.of_map = list(dict.fromkeys(x for x, _ in judged if x is not None))
        self.of_truth = list(dict.fromkeys(y for _, y in judged))
        # The number of steps that are at thing i of the map and truly at thing j. The last row
        # has the steps at which the map has nothing.
        rows = {name: i for i, name in enumerate([*self.of_map, None])}
        columns = {name: j for j, name in enumerate(self.of_truth)}
        self.table = np.zeros((len(rows), len(columns)), int)
        for x, y in judged:
            self.table[rows[x], columns[y]] += 1
        self.best = linear_sum_assignment(self.table[:-1], maximize=True)

    @property
    def right(self) -> bool | None:
        """Whether map and truth distinguish the same steps; None if the map has no such thing."""
        if not self.of_map:
            return None
        cells = np.count_nonzero(self.table[:-1])
        return bool(cells == len(self.of_map) == len(self.of_truth) and not self.table[-1].any())

    @property
    def count(self) -> int | None:
        """How many different things the map has at the judged steps; None if it has none."""
        return len(self.of_map) or None

    @property
    def accuracy(self) -> float | None:
        """The share of steps that are right under the assignment; None if the map has no things.

        It is the one-to-one assignment of things to true things under which most steps are right.
        """
        if not self.of_map:
            return None
        return _share(int(self.table[self.best].sum()), int(self.table.sum()))

    def pairs(self) -> tuple[float | None, float | None]:
        """Compute the precision and recall of pairs of steps at the same thing."""
        if not self.of_map:
            return None, None
        known, true = self.table[:-1], self.table.sum(axis=0)
        both, of_map, of_truth = (
            int((n * (n - 1)).sum()) for n in (known, known.sum(axis=1), true)
        )
        return _share(both, of_map), _share(both, of_truth)

    def edges(
        self, hops: Iterable[int], edge: Callable[[int, Hashable, Hashable], Hashable]
    ) -> tuple[float | None, float | None]:
        """Compute the precision and recall of edges. Equal edges count once.

        `hops` are the steps t that have an edge to step t + 1. `edge` makes the edge of t from the
        things at both of its ends.
        """
        if not self.of_map:
            return None, None
        meant = {self.of_map[i]: self.of_truth[j] for i, j in zip(*self.best, strict=True)}
        # from each edge of the map to the edge between the assigned true things
        said: dict[Hashable, Hashable] = {}
        true = set()
        for t in hops:
            here, there = self.said[t], self.said[t + 1]
            said[edge(t, here, there)] = edge(t, meant.get(here), meant.get(there))
            true.add(edge(t, self.true[t], self.true[t + 1]))
        right = sum(assigned in true for assigned in said.values())
        return _share(right, len(said)), _share(right, len(true))


def _different(names: Iterable[Hashable]) -> int | None:
    return len(set(names) - {None}) or None


def _share(part: int, whole: int) -> float | None:
    return part / whole if whole else None


def _ambiguity(views: Sequence[View | None], dstates: Sequence[Hashable]) -> float | None:
    """Compute the share of pairs of visited true dstates that have a view in common."""
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
