"""ssh-abduction solve TRACE: find the minimal maps of a trace. batch.py solves many traces.

With --onto, add a drive to an existing map, which keeps its places.
"""

from __future__ import annotations

import argparse
import contextlib
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path

from ssh_abduction.cli import outcome, shared
from ssh_abduction.cli.correct import Obeying, corrections_of, keep_corrections, say_obeyed
from ssh_abduction.cli.outcome import Guard
from ssh_abduction.cli.parsing import verb
from ssh_abduction.cli.text import answer_lines
from ssh_abduction.data.drives import together
from ssh_abduction.data.files import json_line
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace, with_images_named_from
from ssh_abduction.explain.no_map import Explanation
from ssh_abduction.runtime.loggers import begin_stage, stages
from ssh_abduction.solution import Solution, Status, Stop, opening, written_map
from ssh_abduction.solver import Search, Start, solve
from ssh_abduction.theory.speedups import SPEEDUPS, Speedups

# At most this many maps are kept in memory, to compare them on the terminal or to sort them for
# JSON. If there are more, only the first ones are compared, and JSON has all in the order found.
HELD = 1000
# The maps in memory have at most this many dstates together, which is about 100 MB.
HELD_DSTATES = 500_000


@verb(
    theory_rows=shared.theory_rows(),
    without_speedups={
        "--set without_speedups NAMES": (
            "speed-ups to turn off, separated by commas, to measure what they save. None of them "
            f"changes an answer: {', '.join(SPEEDUPS)}",
            {"default": ""},
        )
    },
)
def run_solve(options: argparse.Namespace) -> int:
    """Find the minimal maps of a trace, or of many.

    With several traces, the result of each is one line.
    """
    if options.output is not None:
        shared.check_output(options.output, "the solution")
        shared.check_ending(options.output, ".json")
    if options.onto is not None:
        shared.refuse(options, "--onto", "jobs", "scheduler", "joint_trace")
        return _onto(options)
    many = options.jobs is not None or options.scheduler is not None or len(options.traces) > 1
    if options.together:
        shared.refuse(options, "--together", "jobs", "scheduler")
    elif many:
        several = "several traces, --jobs or --scheduler"
        shared.refuse(options, several, "corrections", "output", "joint_trace")
    else:
        shared.refuse(options, "one trace", "joint_trace")
    if many and not options.together:
        from ssh_abduction.cli import batch

        return batch.run(options)
    trace = _joint(options.traces) if options.together else Trace.load(options.traces[0])
    if options.joint_trace is not None:
        folder = Path(options.joint_trace).parent
        with_images_named_from(trace, folder).save(options.joint_trace)
    return _solve(options, trace)


def _solve(options: argparse.Namespace, trace: Trace) -> int:
    """Search for the minimal maps of a trace, and print and save them. Return the exit code."""
    shared.number_steps(options, trace)
    theory = shared.theory_of(options)
    theory.check_steps(trace)
    obeying = Obeying.of(options, trace, theory)
    with contextlib.ExitStack() as until_printed:
        with stages("search", "answer"):
            search = Search(
                obeying.trace,
                obeying.theory,
                time_limit=options.time_limit,
                work_limit=options.work_limit,
                max_maps=options.maps or None,
                within=options.within,
                _start=Start(reasons=True),
                memory_limit=options.memory_limit,
                speedups=Speedups.without(options.without_speedups),
            )
            silent = search.parts.silent
            outcome.warn(silent)  # at once, as rules make a search slow
            # Ctrl-C must not cut the output, as half of it would be useless.
            until_printed.enter_context(outcome.on_ctrl_c(search.interrupt))
            found = outcome.Warnings(search)
            printed = _Json(search, obeying, found) if options.json else _Text(search, obeying)

            def last_words(why: Stop) -> tuple[str, int, Callable[[], None]]:
                solution = obeying.with_names(search.snapshot(why))
                outcome.warn(w for w in found.of(solution) if w not in silent)
                save = partial(outcome.save_solution, solution, options.output)
                return printed.last_words(solution), outcome.exit_code(solution), save

            limits = options.time_limit, options.memory_limit
            guard = Guard(
                search.interrupt,
                last_words,
                *limits,
                known=lambda: (search.best,) if search.best else None,
            )
            until_printed.enter_context(guard)
            explanation = printed.searched(guard.say)
            begin_stage("answer")
        solution = obeying.finished(search.solution(tuple(printed.kept)))

        def save() -> None:
            options.json = False  # the JSON is complete: a later error must not follow it
            outcome.save_solution(solution, options.output)
            # Warn here, as the guard may end the process after finish().
            outcome.warn(w for w in solution.warnings if w not in silent)

        guard.finish(outcome.exit_code(solution), printed.end(solution, explanation), save)
        outcome.warn(found.second_opinion(solution))
    return outcome.exit_code(solution)


def _joint(paths: Sequence[str]) -> Trace:
    """Load several traces and join them. Print warnings about them on stderr."""
    with warnings.catch_warnings(record=True) as odd:
        warnings.simplefilter("always")
        traces = [Trace.load(path) for path in paths]
        trace = together(traces)
        if all(step.image is not None for step in trace.steps):
            from ssh_abduction.learning.traces import Traces  # loads scikit-learn

            Traces(tuple(traces)).warn_of_unrelated_views()
    outcome.warn([str(warning.message) for warning in odd])
    return trace


class _Text:
    """Prints the result of a search as text for people. `kept` has the first maps."""

    def __init__(self, search: Search, obeying: Obeying) -> None:
        self.kept: list[SSHMap] = []
        self._search, self._obeying = search, obeying
        self._room = HELD_DSTATES

    def searched(self, _: Callable[[Callable[[], str]], None]) -> Explanation | None:
        """Run the search. Return why there is no map; None if there is one."""
        for ssh_map in self._search:
            if len(self.kept) < HELD and self._room > 0:
                self.kept.append(ssh_map)
                self._room -= len(ssh_map.dstates)
        return outcome.why_no_map(self._search)

    def end(self, solution: Solution, explanation: Explanation | None) -> Callable[[], str]:
        """Make the output now, as text. Return a function that gives this text."""
        lines = answer_lines(solution, explanation)
        blamed = self._obeying.blamed(solution, explanation)
        text = _text(chain(lines, blamed, self._obeying.how_to_mend(blamed, explanation)))
        return lambda: text

    def last_words(self, solution: Solution) -> str:
        """The text of a process that must end although its search does not stop."""
        # To compare several maps may take long.
        first = tuple(self.kept[:1])
        kept = first if solution.status is Status.OPTIMAL and first else solution.maps
        return _text(answer_lines(replace(solution, maps=kept, shared=None), None))


class _Json:
    """Prints the result of a search as JSON, with one map per line.

    Maps are kept in memory, to sort them at the end. If there are too many, they are printed in the
    order in which they are found.
    """

    def __init__(self, search: Search, obeying: Obeying, found: outcome.Warnings) -> None:
        self._search, self._obeying, self._found = search, obeying, found
        self._held: list[outcome.Given] = []
        self._room = HELD_DSTATES
        self._maps = 0  # maps that were printed
        self._begun = False

    @property
    def kept(self) -> list[SSHMap]:
        """The maps in memory: all maps, or none if they are too many."""
        return [ssh_map for ssh_map, _ in self._held]

    def searched(self, say: Callable[[Callable[[], str]], None]) -> Explanation | None:
        """Run the search, and keep or print (`say`) the maps.

        Return why there is no map, or None.
        """
        for ssh_map in self._search:
            cost = self._search.cost if self._search.limits.within else None
            given = self._obeying.named(ssh_map), cost
            if self._maps:
                say(partial(self._line, given))
                continue
            self._held.append(given)
            self._room -= len(ssh_map.dstates)
            if len(self._held) > HELD or self._room < 0:
                say(self._let_go)
        return outcome.why_no_map(self._search)

    def end(self, solution: Solution, explanation: Explanation | None) -> Callable[[], str]:
        """Return a function that makes the rest of the JSON: the maps in memory, and the fields."""
        given = outcome.all_given(solution)
        fields = self._fields(solution, explanation, len(given))
        return lambda: self._opening() + "".join(map(self._line, given)) + fields

    def _fields(self, solution: Solution, explanation: Explanation | None, more: int = 0) -> str:
        """Make the fields after the maps; `more` maps are not printed yet."""
        warnings = self._found.of(solution)
        end = outcome.answer_ending(solution, explanation, self._maps + more, warnings)
        if blamed := self._obeying.blamed(solution, explanation):
            end["corrections"] = blamed
        return f"\n],{json_line(end)[1:]}\n"

    def last_words(self, solution: Solution) -> str:
        """The rest of the JSON, if the process must end before its search."""
        words = self._let_go()
        if not self._maps and solution.maps:
            words += self._line((solution.maps[0], None))
        # The backbone is left out: another thread may be changing it.
        return words + self._fields(replace(solution, shared=None), None)

    def _opening(self) -> str:
        """Begin the JSON; "" if it is begun already."""
        if self._begun:
            return ""
        self._begun = True
        search = self._search
        head = opening(search.theory, len(search.trace), search.limits.within)
        return json_line(head)[:-1] + ', "maps": ['

    def _let_go(self) -> str:
        """Write the maps in memory in the order in which they were found, and forget them."""
        held, self._held = self._held, []
        return self._opening() + "".join(map(self._line, held))

    def _line(self, given: outcome.Given) -> str:
        self._maps += 1
        return ("," if self._maps > 1 else "") + "\n" + json_line(written_map(*given))


def _text(lines: Iterable[str]) -> str:
    return "".join(f"{line}\n" for line in lines)


def _onto(options: argparse.Namespace) -> int:
    existing = Solution.load(options.onto)
    trace = together([Trace.load(path) for path in options.traces])
    said = corrections_of(options)
    # Steps of options such as --same are named by the drives of the old and the new traces.
    if existing.trace is not None:
        shared.number_steps(options, together([existing.trace, trace]))
    solution = solve(
        trace,
        shared.theory_of(options, existing.theory.replace(returns=0)),
        onto=existing,
        time_limit=options.time_limit,
        work_limit=options.work_limit,
        max_maps=options.maps or None,
        within=options.within,
        memory_limit=options.memory_limit,
        speedups=Speedups.without(options.without_speedups),
        corrections=said,
    )
    if said is not None and solution.trace is not None:
        say_obeyed(said, solution.trace)
    outcome.warn(solution.warnings)
    outcome.save_solution(solution, options.output)
    keep_corrections(said, options.output)
    added = replace(solution, shared=None)
    print(
        json_line(solution.to_dict())
        if options.json
        else "\n".join(answer_lines(added, None, existing.maps[0]))
    )
    return outcome.exit_code(solution)
