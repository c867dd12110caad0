"""The map of the runner-up: whether the map would be another one, had the images been clustered into the second best number of views.

The number of views is chosen by how well they separate the images, and no map tells whether that was right: with too few views a small, proven and wrong map
comes out. So where a second number of views is nearly as good, its views are kept beside the chosen ones, as the field `runner_up` of each step, and the
map that they give is looked at, too.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from ssh_abduction.data.errors import TraceError
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace, View
from ssh_abduction.solver import Solution, Status, solve
from ssh_abduction.theory.theory import Theory

FIELD = "runner_up"
# Seconds that may be spent on the second map, where nothing else limits them: it is a warning, and not what was asked for.
SECONDS = 5.0


class RunnerUpWarning(UserWarning):
    """Another number of views is nearly as good, and gives another map."""


@dataclass(frozen=True)
class SecondMap:
    """What the views of the runner-up give, where it is not the map that the chosen views give.

    views, other_views  how many there are of the chosen views, and of those of the runner-up
    dstates             of the map that the chosen views give; None where they give none
    solution            for the views of the runner-up
    """

    views: int
    other_views: int
    dstates: int | None
    solution: Solution

    @property
    def sentence(self) -> str:
        """What is doubtful, and what to do about it."""
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
        return (
            f"{self.views} views may be too {'few' if self.views < self.other_views else 'many'}: {self.other_views} also separate the images well, "
            f"and {other}; cluster the images into {self.other_views} views to see it (cluster --k {self.other_views}), or log more images"
        )


def with_runner_up(trace: Trace, views: Iterable[View] | None) -> Trace:
    """The trace with the views of the runner-up at its steps, or, for None, without any that it may have had. Raises TraceError."""
    if views is None:
        return replace(
            trace,
            steps=tuple(
                replace(s, extra={k: v for k, v in s.extra.items() if k != FIELD})
                for s in trace.steps
            ),
        )
    seen = trace.with_views(views).views
    return replace(
        trace,
        steps=tuple(
            replace(s, extra={**s.extra, FIELD: v}) for s, v in zip(trace.steps, seen, strict=True)
        ),
    )


def runner_up(trace: Trace) -> Trace | None:
    """The trace with the views of the runner-up as its views; None where it has no runner-up. Raises TraceError where only some steps have one."""
    if not any(FIELD in step.extra for step in trace.steps):
        return None
    for i, step in enumerate(trace.steps):
        if FIELD not in step.extra:
            raise TraceError(
                f"{trace.at(i)}: {FIELD}: expected a view, as other steps have one, got none; cluster the images again"
            )
    try:
        return trace.with_views(step.extra[FIELD] for step in trace.steps)
    except TraceError as error:
        raise TraceError(f"{trace.source or 'trace'}: {FIELD}: {error}") from None


def second_map(
    trace: Trace,
    maps: Sequence[SSHMap],
    theory: Theory | None = None,
    limit: float | None = None,
    memory: int | None = None,
) -> SecondMap | None:
    """The map of the runner-up, where it is none of `maps`, which the views of the trace give; None where there is no runner-up, or it gives one of these.

    limit   seconds; SECONDS where that is less, or where it is None
    memory  MiB, as in `solve`
    Raises TraceError where the views of the runner-up are malformed.
    """
    other = runner_up(trace)
    if other is None:
        return None
    solution = solve(
        other,
        theory,
        time_limit=SECONDS if limit is None else min(limit, SECONDS),
        memory_limit=memory,
    )
    if {partition(m) for m in maps} & {partition(m) for m in solution.maps}:
        return None
    return SecondMap(
        len(set(trace.views)),
        len(set(other.views)),
        len(maps[0].dstates) if maps else None,
        solution,
    )


def warn_of_second_map(
    trace: Trace, maps: Sequence[SSHMap], theory: Theory | None, limit: float | None
) -> SecondMap | None:
    """The same, with a RunnerUpWarning where there is one."""
    found = second_map(trace, maps, theory, limit)
    if found:
        warnings.warn(found.sentence, RunnerUpWarning, stacklevel=3)
    return found


def partition(ssh_map: SSHMap) -> tuple[tuple[int, ...], tuple[int | None, ...]]:
    """What a map says of the steps: which are one dstate, and which are at one place. Both are numbered by first visit."""
    return tuple(ssh_map.labels), tuple(ssh_map.dstates[label].place for label in ssh_map.labels)
