"""What the shell is told of a search: its JSON, its exit code, and why there is no map."""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from itertools import zip_longest
from typing import Any, TypeAlias
from weakref import WeakKeyDictionary

from ssh_abduction.data.files import json_line
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.explain.axioms import Interrupted
from ssh_abduction.explain.no_map import Explanation, explain
from ssh_abduction.learning.runner_up import second_map
from ssh_abduction.runtime import program
from ssh_abduction.solver import (
    Backbone,
    Cost,
    Search,
    Solution,
    Status,
    written_map,
)
from ssh_abduction.solver import ending as written_ending
from ssh_abduction.solver import opening as written_opening

# steps of a trace in which noise is sought after Ctrl-C, at most: in 40,000 that takes two seconds
SOON = 10_000

Given: TypeAlias = tuple[SSHMap, Cost | None]

LEAST_LEFT = 0.2  # seconds of a time limit, with less of which the runner-up is not looked at

EXIT_CODES = {Status.OPTIMAL: 0, Status.FEASIBLE: 10, Status.UNSATISFIABLE: 20, Status.UNKNOWN: 30}


def exit_code(solution: Solution) -> int:
    """What the shell is told of a solution."""
    return (
        program.interrupted_code()
        if solution.stopped == "interrupted"
        else EXIT_CODES[solution.status]
    )


def explained(search: Search) -> Explanation | None:
    """Why there is no map, if that is so and there is time to find out."""
    if search.status is not Status.UNSATISFIABLE or search.theory.jumped:
        return None
    try:
        return explain(search.trace, search.theory, search.over)
    except Interrupted:
        return None


def opening(search: Search) -> dict[str, Any]:
    """What the JSON of a solution says before its maps."""
    return written_opening(search.theory, len(search.trace), search.limits.within)


def told(given: Given) -> dict[str, Any]:
    """What the JSON of a solution says of a map: also what it costs, where not all maps cost the same."""
    ssh_map, cost = given
    return written_map(ssh_map, cost)


def given_by(search: Search, ssh_map: SSHMap) -> Given:
    """The map that a search gave last, and what it costs, where not all maps cost the same."""
    return ssh_map, search.cost if search.limits.within else None


def all_given(solution: Solution) -> list[Given]:
    """The same of all maps of a solution, in its order."""
    return list(zip_longest(solution.maps, solution.costs if solution.within else ()))


def ending(
    search: Search,
    solution: Solution,
    explanation: Explanation | None,
    maps: int,
    backbone: Backbone | None,
) -> dict[str, Any]:
    """What the JSON of a solution says after its maps, of which there were so many: with all warnings, and why there is no map.

    backbone  what the minimal maps share, as far as it is known
    """
    end = written_ending(solution, maps, backbone)
    found = warnings_of(search, solution)
    end.pop("warnings", None)
    return (
        end
        | ({"warnings": found} if found else {})
        | ({"explanation": explanation.to_dict()} if explanation else {})
    )


def warnings_of(search: Search, solution: Solution) -> list[str]:
    """What makes the trace suspicious, a sentence each."""
    if solution.stopped == "interrupted" and len(search.trace) > SOON:
        return []
    return [*solution.warnings, *_second_opinion(search, solution)]


_second_opinions: WeakKeyDictionary[Search, list[str]] = (
    WeakKeyDictionary()
)  # those sought already, as a search is asked for its warnings twice


def _second_opinion(search: Search, solution: Solution) -> list[str]:
    """What is said of the runner-up's views, where the trace has them, the search came to an end, and there is time left."""
    if search not in _second_opinions:
        limit = search.limits.time_limit
        left = None if limit is None else limit - solution.seconds.total
        if solution.stopped not in (None, "maps limit") or (left is not None and left < LEAST_LEFT):
            return []
        known = [*solution.maps, *([search.best] if search.best else [])]
        found = second_map(search.trace, known, search.theory, left, search.limits.memory_limit)
        _second_opinions[search] = [found.sentence] if found else []
    return _second_opinions[search]


def warn(warnings: Sequence[str]) -> None:
    """Say so on stderr."""
    for warning in warnings:
        print(f"ssh-abduction: warning: {warning}", file=sys.stderr)


def dump(value: dict[str, Any]) -> str:
    """JSON on one line."""
    return json_line(value)


@contextlib.contextmanager
def on_ctrl_c(action: Callable[[], None] | None) -> Iterator[None]:
    """Ctrl-C and SIGTERM do this, rather than stop the program wherever it is: what was found is still printed. None: nothing, nor in processes that begin.

    The guard of the whole program hears nothing meanwhile: who takes signals into his own hands
    needs a guard of his own if he may be deaf.
    """
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread may handle signals
        return

    def hear(number: int, _: object) -> None:
        program.heard.append(number)
        if action:
            action()

    before = {
        number: signal.signal(number, hear if action else signal.SIG_IGN)
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    told = signal.set_wakeup_fd(-1)
    try:
        yield
    finally:
        signal.set_wakeup_fd(told, warn_on_full_buffer=False)
        for number, handler in before.items():
            signal.signal(number, handler)
