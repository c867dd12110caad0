"""ssh-abduction next MAPS TRACE: what the robot should do to distinguish these maps."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from ssh_abduction.cli.guard import Guard
from ssh_abduction.cli.options import (
    add_limits,
    add_maps,
    add_theory,
    add_trace,
    solved_trace,
    some_maps,
    theory_of,
    written_theory,
)
from ssh_abduction.cli.outcome import on_ctrl_c, warn
from ssh_abduction.cli.parsing import Verbs
from ssh_abduction.cli.text import counted, table
from ssh_abduction.data.errors import MapError, named, printable, said_of
from ssh_abduction.data.files import json_line
from ssh_abduction.data.map_file import read_json
from ssh_abduction.data.words import noun_of
from ssh_abduction.runtime.program import interrupted_code
from ssh_abduction.solver import Watch, check_limit, stretches
from ssh_abduction.theory.theory import Theory

if TYPE_CHECKING:
    from ssh_abduction.rivals.explore import Experiment, ExperimentPlan, Untried
    from ssh_abduction.rivals.machines import Consequence

# The largest number of columns of a table, and of lines of a plan, that are printed. --json prints
# all.
SHOWN_COLUMNS, SHOWN_LINES = 6, 40
# Exit codes if a limit ended the search: with a plan that may not be the best, or without a plan.
EXIT_CUT_SHORT, EXIT_NOTHING = 10, 30


def add_parser(verbs: Verbs) -> None:
    parser = verbs.add(
        "next",
        run,
        "find the actions after which rival maps disagree",
        "Find the fewest actions, from where the robot is now, after which two maps predict "
        "different views. If there are more than two maps, find a plan: which actions come next "
        "depends on what the robot sees. If known links cannot distinguish the maps, find the "
        "untried action that distinguishes as many of the maps as possible, and the way to it.",
        "The plan for two maps is as short as possible. The plan for more maps is greedy, "
        "because finding the best one is PSPACE-complete (Lee & Yannakakis 1994). Exit codes: "
        "0 done; 10 a limit ended the search, and a better plan may exist; 30 no plan in "
        "time. docs/reference/formats.md describes the JSON.",
    )
    add_maps(parser)
    add_trace(parser)
    add_limits(parser, "the best plan so far")
    parser.add("--json", "print the answer as JSON")
    add_theory(parser, default="the theory in the file of maps")


def run(options: argparse.Namespace) -> int:
    from ssh_abduction.rivals.explore import next_experiment  # loads numpy
    from ssh_abduction.rivals.listing import Listing

    check_limit("--time-limit", "seconds", options.time_limit)
    check_limit("--memory-limit", "MiB", options.memory_limit)
    trace = solved_trace(options)
    data = read_json(options.maps)
    maps = some_maps(data, options.maps, "seek an experiment for")
    listing = Listing.from_dict(data, named(options.maps))
    found = written_theory(data)
    theory: Theory | None = theory_of(options, found)
    if found is None and options.theory is None and theory == Theory.topological():
        theory = None  # a saved map does not contain its theory
    watch = Watch(options.time_limit, options.memory_limit)
    complete = not (isinstance(data, dict) and data.get("complete") is False)

    def interrupt() -> None:
        watch.interrupted = True

    guard = Guard(interrupt)
    with said_of(named(options.maps), MapError), on_ctrl_c(interrupt), guard:
        experiment = next_experiment(maps, trace, theory=theory, complete=complete, watch=watch)
    if options.json:
        print(json_line(experiment.to_dict()))
    else:
        print("\n".join(_lines(experiment)))
        if listing.sureness:
            print(listing.sureness)
        weighed = listing.weighed if len(maps) == 1 else None
        if weighed and weighed.proven and not all(r.estimated for r in weighed.rivals[1:]):
            print("to tell it from maps that cost little more, list them: solve --set within=5")
    if experiment.warning:
        warn([experiment.warning])
    if experiment.stopped == "interrupted":
        return interrupted_code()
    if not experiment.stopped:
        return 0
    return EXIT_CUT_SHORT if experiment.plan.branches else EXIT_NOTHING


def _lines(experiment: Experiment) -> Iterator[str]:
    """Yield the lines that describe an experiment to people."""
    yield experiment.sentence
    plan = experiment.plan
    if plan.branches:
        shown = experiment.predictions[:SHOWN_COLUMNS]
        more = len(experiment.predictions) - len(shown)
        columns = zip(*(said.seen for said in shown), strict=True)
        rows = [[act, *seen] for act, seen in zip(plan.actions, columns, strict=True)]
        heads = (
            f"{_rivals_in_words(said.rivals)} predict{'s' * (len(said.rivals) == 1)}"
            for said in shown
        )
        yield table(["action", *heads], rows)
        if more:
            yield f"  and {counted(more, 'more predictions')} (--json has all)"
        lines = list(_tree(plan, "  "))
        if any(branch.plan.branches or branch.plan.untried for branch in plan.branches):
            yield "the plan"
            yield from lines[:SHOWN_LINES]
            if len(lines) > SHOWN_LINES:
                yield f"  and {counted(len(lines) - SHOWN_LINES, 'more lines')} (--json has all)"
    elif plan.untried and experiment.count > 1:
        yield from _expected(plan.untried)


def _tree(plan: ExperimentPlan, indent: str) -> Iterator[str]:
    """Yield a plan as indented lines: actions, and for each view the maps left and their plan."""
    if plan.branches:
        yield f"{indent}{printable(', '.join(plan.actions))}"
    for branch in plan.branches:
        rest = branch.plan
        left = f"{_rivals_in_words(rest.rivals)}{_untried(rest)}"
        yield f"{indent}  {printable(str(branch.seen))}: {left}"
        yield from _tree(rest, f"{indent}    ")


def _untried(plan: ExperimentPlan) -> str:
    """Say which untried action to try if known links cannot distinguish the rivals."""
    if len(plan.rivals) == 1 or plan.branches:
        return ""
    if plan.untried is None:
        return "; nothing distinguishes them"
    actions = printable(", ".join((*plan.untried.way, plan.untried.action)))
    return f"; known links distinguish no more of them, try {actions}"


def _expected(untried: Untried) -> Iterator[str]:
    """Yield a table of what the rivals predict for an untried action."""
    shown = untried.expects[:SHOWN_LINES]
    yield table(
        ["maps", "leads to", "seen there", "how sure"],
        [[_rivals_in_words(said.rivals), *_says(said.says)] for said in shown],
    )
    if len(untried.expects) > len(shown):
        yield f"  and {len(untried.expects) - len(shown)} more (--json has all)"


def _says(says: Consequence) -> tuple[str, str, str]:
    where = "not known" if says.dstate is None else f"dstate {says.dstate}"
    how = "known" if says.how == "link" else says.how
    return where, "not known" if says.seen is None else str(says.seen), how


def _rivals_in_words(rivals: Sequence[int]) -> str:
    """Put the numbers of rivals into words: "map 1", or "maps 1–3 and 7"."""
    return f"{noun_of('map', rivals)} {stretches(rivals)}"
