"""Does the second best number of views (the runner-up) give another map?

A view is a cluster of images that look alike. The chosen number of views separates the images best.
No map shows whether this number is right: too few views give a map that is small, proven minimal,
and wrong. So if a second number of views is nearly as good, the field `runner_up` of each step
holds the step's view by that second number. The maps of both are then compared.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from ssh_abduction.data.errors import TraceError, said_of
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace, View
from ssh_abduction.solution import Solution, Status
from ssh_abduction.solver import solve
from ssh_abduction.theory.theory import Theory

FIELD = "runner_up"
# At most this many seconds are spent on the second map: it is only a warning.
SECONDS = 5.0


class RunnerUpWarning(UserWarning):
    """Another number of views separates the images nearly as well, and gives another map."""


@dataclass(frozen=True)
class SecondMap:
    """The result for the second best number of views (the runner-up), if it is another map."""

    views: int  # number of chosen views
    other_views: int  # number of views of the runner-up
    # Number of dstates in the map of the chosen views; None if they have no map.
    dstates: int | None
    # The solution for the views of the runner-up. It may have no map.
    solution: Solution

    @property
    def sentence(self) -> str:
        """A warning that names both numbers of views, and says what to do."""
        if self.solution.cost is not None:
            proven = "" if self.solution.status is Status.OPTIMAL else ", not proven minimal"
            instead = "" if self.dstates is None else f" instead of {self.dstates}"
            other = f"give another map, of {self.solution.cost.dstates} dstates{instead}{proven}"
        else:
            other = (
                "have no map"
                if self.solution.status is Status.UNSATISFIABLE
                else "have no map that was found in time"
            )
        amount = "few" if self.views < self.other_views else "many"
        return (
            f"{self.views} views may be too {amount}: {self.other_views} also separate the images "
            f"well, and {other}; cluster the images into {self.other_views} views to see it "
            f"(cluster --k {self.other_views}), or log more images"
        )


def with_runner_up(trace: Trace, views: Iterable[View] | None) -> Trace:
    """Copy a trace with the runner-up's view of each step in its field `runner_up`; None drops it.

    Raises TraceError if the views are malformed.
    """
    others = [{k: v for k, v in step.extra.items() if k != FIELD} for step in trace.steps]
    if views is not None:
        seen = trace.with_views(views).views
        others = [{**extra, FIELD: v} for extra, v in zip(others, seen, strict=True)]
    steps = (replace(s, extra=extra) for s, extra in zip(trace.steps, others, strict=True))
    return replace(trace, steps=tuple(steps))


def runner_up(trace: Trace) -> Trace | None:
    """Copy a trace with the runner-up's views as its views; None if no step has one.

    Raises TraceError if only some steps have such a view, or one is malformed.
    """
    if not any(FIELD in step.extra for step in trace.steps):
        return None
    for i, step in enumerate(trace.steps):
        if FIELD not in step.extra:
            raise TraceError(
                f"{trace.at(i)}: {FIELD}: expected a view, as other steps have one, got none; "
                "cluster the images again"
            )
    with said_of(f"{trace.source or 'trace'}: {FIELD}"):
        return trace.with_views(step.extra[FIELD] for step in trace.steps)


def second_map(
    trace: Trace,
    maps: Sequence[SSHMap],
    theory: Theory | None = None,
    limit: float | None = None,
    memory: int | None = None,
    work: float | None = None,
) -> SecondMap | None:
    """Solve the trace with the runner-up's views. Return the result if its maps differ.

    `maps` are the minimal maps of the chosen views. Return None if the trace has no runner-up, or
    if one of its maps puts the same steps at the same dstates and places as one of `maps`. The
    search takes `limit` seconds or, if given, `work` units of work, at most SECONDS. `memory` is in
    MiB, as in `solve`. Raises TraceError if the views of the runner-up are malformed.
    """
    other = runner_up(trace)
    if other is None:
        return None
    most = SECONDS if limit is None else min(limit, SECONDS)
    solution = solve(
        other,
        theory,
        time_limit=most if work is None else limit,
        work_limit=None if work is None else min(work, SECONDS),
        memory_limit=memory,
    )
    # The maps are the same if they put the same steps at the same dstates and places.
    if {partition(m) for m in maps} & {partition(m) for m in solution.maps}:
        return None
    dstates = len(maps[0].dstates) if maps else None
    return SecondMap(len(set(trace.views)), len(set(other.views)), dstates, solution)


def partition(ssh_map: SSHMap) -> tuple[tuple[int, ...], tuple[int | None, ...]]:
    """The dstate and the place (None if it has none) of each step, numbered by first visit."""
    return tuple(ssh_map.dstate_at), tuple(
        ssh_map.dstates[label].place for label in ssh_map.dstate_at
    )
