"""ssh-abduction solve TRACE: the minimal maps of a trace. Many traces go to batch.py."""

from __future__ import annotations

import argparse
import contextlib
import json
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import asdict
from itertools import islice
from typing import Any

from ssh_abduction.cli.options import Verbs, add_theory, theory_of
from ssh_abduction.cli.text import describe, differences, headline
from ssh_abduction.explain import Explanation, Interrupted, explain
from ssh_abduction.maps import SSHMap
from ssh_abduction.solver.search import Progress, Search, Solution, Status
from ssh_abduction.theory.speedups import SPEEDUPS, Speedups
from ssh_abduction.trace import Trace

EXIT_CODES = {Status.OPTIMAL: 0, Status.FEASIBLE: 10, Status.UNSATISFIABLE: 20, Status.UNKNOWN: 30}
SHOWN = 4  # maps compared on the terminal; --json has all


def add_parser(verbs: Verbs) -> None:
    text = "Find the minimal maps of a trace, or of many: then the result of each is one line."
    parser = verbs.add_parser("solve", help="find the minimal maps of a trace, or of many", description=text)
    parser.add_argument("traces", nargs="+", metavar="trace", help="trace file (JSON Lines), or - for standard input")
    parser.add_argument("-n", "--maps", type=int, default=100, metavar="K", help="stop after K maps; 0 for all (default: 100)")
    parser.add_argument(
        "--json", action="store_true", help="print the solution as JSON, map by map as they are found; of many traces, a line each"
    )
    parser.add_argument("--time-limit", type=float, metavar="S", help="stop after S seconds with the best answer so far")
    parser.add_argument(
        "--without-speedups", default="", metavar="NAMES", help=f"leave these out, of {', '.join(SPEEDUPS)}; commas between"
    )
    parser.add_argument("--memory-limit", type=int, metavar="MIB", help="stop when the process has used so much memory")
    many = parser.add_argument_group(
        "many traces",
        "With several traces, or one of these, each result is a line, in the order of the traces. What goes wrong with a trace is on its line, "
        "and the others go on. The exit code is 1 if anything went wrong, else the highest of the traces' codes. Limits are for each trace, but "
        "memory is that of the process: what other threads of a Dask worker use counts too, and, except on Linux, what traces before used.",
    )
    jobs = "solve N traces at a time, each in a process; -1 for one a core (default: 1; with --scheduler, as many as its workers can)"
    many.add_argument("--jobs", type=int, metavar="N", help=jobs)
    many.add_argument("--scheduler", metavar="ADDRESS", help="solve on the workers of the Dask scheduler at this address, tcp://host:port")
    add_theory(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    if len(options.traces) > 1 or options.jobs is not None or options.scheduler is not None:
        from ssh_abduction.cli import batch

        return batch.run(options)
    trace = Trace.load(options.traces[0])
    with contextlib.ExitStack() as until_printed:
        with _progress(trace) as on_progress:
            search = Search(
                trace,
                theory_of(options),
                limit=options.time_limit,
                maps=options.maps,
                memory=options.memory_limit,
                speedups=Speedups.without(options.without_speedups),
                on_progress=on_progress,
            )
            until_printed.enter_context(on_ctrl_c(search.interrupt))  # half of what is printed would be worth nothing
            kept = _print_json(search) if options.json else list(_first(search, SHOWN))
            explanation = explained(search)
        solution = search.solution(tuple(kept))
        if options.json:
            _print_end(search, solution, explanation)
        else:
            _print_text(search, solution, explanation)
    return exit_code(solution)


def exit_code(solution: Solution) -> int:
    """What the shell is told of a solution."""
    return 130 if solution.stopped == "interrupted" else EXIT_CODES[solution.status]


def explained(search: Search) -> Explanation | None:
    """Why there is no map, if that is so and there is time to find out."""
    if search.status is not Status.UNSATISFIABLE:
        return None
    try:
        return explain(search.trace, search.theory, search.over)
    except Interrupted:
        return None


def _first(search: Search, most: int) -> Iterator[SSHMap]:
    """The first maps; the others are counted and let go."""
    maps = iter(search)
    yield from islice(maps, most)
    for _ in maps:
        pass


def _print_json(search: Search) -> list[SSHMap]:
    """The maps, one a line, as they come; none is kept."""
    sys.stdout.write(dump(opening(search))[:-1] + ', "maps": [')
    for i, ssh_map in enumerate(search):
        sys.stdout.write(("," if i else "") + "\n" + dump(ssh_map.to_dict()))
    sys.stdout.write("\n]")
    return []


def _print_end(search: Search, solution: Solution, explanation: Explanation | None) -> None:
    print("," + dump(ending(search, solution, explanation))[1:])


def opening(search: Search) -> dict[str, Any]:
    """What the JSON of a solution says before its maps."""
    return {"theory": search.theory.to_dict(), "steps": len(search.trace)}


def ending(search: Search, solution: Solution, explanation: Explanation | None) -> dict[str, Any]:
    """What the JSON of a solution says after its maps."""
    end: dict[str, Any] = {
        "status": solution.status.value,
        "complete": solution.complete,
        "count": search.count,
        "cost": solution.cost.to_dict() if solution.cost else None,
        "bound": solution.bound.to_dict(),
        "prefix": solution.prefix,
        "grounding": asdict(search.grounding),
        "seconds": {k: round(getattr(solution.seconds, k), 6) for k in ("total", "ground", "solve")},
    }
    if solution.certificate:
        end["certificate"] = solution.certificate.to_dict(search.trace)
    if solution.stopped:
        end["stopped"] = solution.stopped
    if solution.partial:
        end["partial"] = solution.partial.to_dict()
    if explanation:
        end["explanation"] = explanation.to_dict()
    return end


def dump(value: dict[str, Any]) -> str:
    """JSON on one line."""
    return json.dumps(value, ensure_ascii=False, allow_nan=False)


def _print_text(search: Search, solution: Solution, explanation: Explanation | None) -> None:
    print(headline(solution, search.count, explanation))
    if solution.status is Status.UNSATISFIABLE:
        if explanation:
            first, last = search.trace.at(explanation.first), search.trace.at(explanation.last)
            print(f"look at what was seen and done from {first} to {last}, or leave one of these axioms out: --without NAME")
        return
    if solution.cost is None:
        if solution.partial:
            print(f"\nbest map of the first {len(solution.partial.labels)} steps\n{describe(solution.partial)}")
        return
    print(f"\n{'map 1' if search.count > 1 else 'map'}\n{describe(solution.maps[0])}")
    if len(solution.maps) > 1:
        some = "" if search.count <= SHOWN else f" (the first {SHOWN}; --json lists all)"
        print(f"\nwhat tells the maps apart{some}\n{differences(solution.maps, search.trace)}")


@contextlib.contextmanager
def on_ctrl_c(action: Callable[[], None] | None) -> Iterator[None]:
    """Ctrl-C does this, rather than stop the program wherever it is: what was found is still printed. None: nothing, nor in processes that begin."""
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread may handle signals
        return
    before = signal.signal(signal.SIGINT, (lambda *_: action()) if action else signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextlib.contextmanager
def _progress(trace: Trace) -> Iterator[Any]:
    """A line on stderr, while solving, if stderr is a terminal."""
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console

    with Console(stderr=True).status("solving") as status:

        def show(p: Progress) -> None:
            best = f"best {p.cost.dstates} dstates, {p.cost.places} places, {p.cost.paths} paths" if p.cost else "no map yet"
            bound = ", ".join(f"{k} ≥ {v}" for k, v in p.bound.to_dict().items()) or "no bound yet"
            status.update(f"prefix {p.prefix} of {len(trace)} steps; {best}; {bound}; {p.maps} maps; {p.seconds:.1f} s")

        yield show
