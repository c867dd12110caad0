"""ssh-abduction compare and next: where rival maps differ, and what distinguishes them."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ssh_abduction.cli.guard import Guard
from ssh_abduction.cli.options import (
    MAPS_SAID,
    add_limits,
    add_maps,
    add_theory,
    add_trace,
    maps_path,
    solved_trace,
    theory_of,
    written_theory,
)
from ssh_abduction.cli.outcome import on_ctrl_c, warn
from ssh_abduction.cli.parsing import Verbs
from ssh_abduction.cli.text import compared, counted, depending, table
from ssh_abduction.data.errors import brief, named, printable
from ssh_abduction.data.files import json_line
from ssh_abduction.data.map_file import read_json
from ssh_abduction.data.schema import attributes_of
from ssh_abduction.data.words import noun_of
from ssh_abduction.runtime.program import interrupted_code
from ssh_abduction.solver import Watch, check_limit, stretches
from ssh_abduction.theory.theory import Theory

if TYPE_CHECKING:
    from ssh_abduction.rivals.comparison import Comparison
    from ssh_abduction.rivals.differences import SharedSides
    from ssh_abduction.rivals.explore import Experiment, ExperimentPlan, Untried
    from ssh_abduction.rivals.listing import DrivePair, Listing
    from ssh_abduction.rivals.machines import Consequence

# Values in run.json that differ between runs even if all settings and results are the same.
UNSTEADY = ("seconds", "limit", "ladder", "drove", "log.source")


def add_compare(verbs: Verbs) -> None:
    parser = verbs.add(
        "compare",
        run_compare,
        "show what rival maps share, and where they differ",
        "Compare the minimal maps of a trace. Reports what all of them share, where they "
        "differ, and which questions about steps decide between them.",
        "The questions that decide between the maps are chosen greedily. None can be left "
        "out, but a shorter list may exist. docs/reference/formats.md describes the JSON.",
    )
    parser.add("maps", MAPS_SAID)
    parser.add(
        "other",
        "other maps of the same trace; shows which maps are in both files, and how the first "
        "maps of the files differ",
        nargs="?",
    )
    parser.add(
        "--diff",
        "only describe how maps I and J differ. Give each by its number, from 1, or its id. With "
        "OTHER, map J is in that file",
        nargs=2,
        metavar=("I", "J"),
    )
    parser.add("--json", "print the answer as JSON")


def run_compare(options: argparse.Namespace) -> int:
    from ssh_abduction.cli.outcome import warn  # loads clingo
    from ssh_abduction.rivals.comparison import compare  # loads numpy
    from ssh_abduction.rivals.differences import difference, shared_sides
    from ssh_abduction.rivals.listing import Listing, joins_of_drives

    maps = maps_path(options.maps)
    others = None if options.other is None else maps_path(options.other)
    record: dict[str, Any] = {}  # the output of --json
    if maps != options.maps and others != options.other:
        record["runs"] = differences(options.maps, options.other)
        if not options.json:
            print("\n".join(_runs(record["runs"], options.maps, options.other)))
        # Maps of different traces have nothing else to compare.
        runs = (options.maps, options.other)
        if len({(Path(run) / "trace.jsonl").read_bytes() for run in runs}) > 1:
            if options.json:
                print(json_line(record))
            return 0
    listing = Listing.load(maps)
    other = Listing.load(others) if others is not None else None
    if options.diff:
        there = other or listing
        listing.check_same_trace(there)
        i, j = listing.number(options.diff[0]), there.number(options.diff[1])
        names = f"map {i + 1}", f"map {j + 1}" + (f" of {printable(other.source)}" if other else "")
        between = difference(listing.maps[i], there.maps[j], names, drives=listing.drives)
        print(json_line({**record, **between.to_dict()}) if options.json else between)
        return 0
    found, drives, sides = compare(listing, other), joins_of_drives(listing), shared_sides(listing)
    if options.json:
        print(json_line({**record, **_record(listing, drives, sides), **found.to_dict()}))
        return 0
    lines = [*_lines(found), *_faults(listing)]
    lines += [f"  {listing.joined}"] if listing.joined else []
    lines += [f"  {sides}"] if sides is not None and sides.possible else []
    print("\n".join([*lines, *map(str, drives)]))
    if listing.sureness:
        print(listing.sureness)
    warn(map(printable, listing.warnings))
    return 0


def _record(
    listing: Listing, drives: Sequence[DrivePair], sides: SharedSides | None
) -> dict[str, Any]:
    """Return what is known of the maps of a listing, as plain data for --json."""
    weighed = listing.weighed
    record = attributes_of(listing, "by_minimality", "faults", "warnings")
    record["drives"] = [pair.to_dict() for pair in drives]
    record["sides"] = None if sides is None else sides.to_dict()
    first = {}
    if weighed is not None:
        first = attributes_of(weighed, "confidence", "place_confidence")
        del record["by_minimality"]
    return first | {name: value for name, value in record.items() if value}


def differences(first: str, other: str) -> dict[str, tuple[Any, Any]]:
    """Find the settings and results that differ between two runs of the verb `map`."""
    here, there = (_flat(read_json(Path(folder) / "run.json")) for folder in (first, other))
    return {
        name: (a, b)
        for name in {**here, **there}
        if (a := here.get(name)) != (b := there.get(name)) and not name.startswith(UNSTEADY)
    }


def _runs(differing: dict[str, tuple[Any, Any]], first: str, other: str) -> Iterator[str]:
    """Yield a line for each setting and result that differs between two runs."""
    for name, (a, b) in differing.items():
        yield f"{name}: {brief(a)} in {named(first)}, {brief(b)} in {named(other)}"
    if not differing:
        yield "the two runs have the same settings, and found the same"


def _flat(value: Any, name: str = "") -> dict[str, Any]:
    """Flatten nested dicts: return a dict from keys, joined with dots, to values."""
    if not isinstance(value, dict):
        return {name: value}
    return {
        key: v
        for part in value
        for key, v in _flat(value[part], f"{name}.{part}".lstrip(".")).items()
    }


def _faults(listing: Listing) -> Iterator[str]:
    """Yield a line for each fault that all listed maps have."""
    where = "all maps" if listing.complete else "all maps listed"
    where = "the map" if len(listing.maps) == 1 else where
    yield from (f"  in {where}, {printable(str(fault))}" for fault in listing.faults)


def _lines(found: Comparison) -> Iterator[str]:
    """Yield the lines that describe a comparison to people."""
    yield found.sentence
    if len(found.ids) > 1:
        if found.complete is False:
            yield f"of the {counted(len(found.ids), 'maps')} listed: {found.listed.sentence}"
        yield from compared(found)
    if len(found.sizes) > 1:
        yield from (
            f"  {counted(count, 'maps')} with {counted(dstates, 'dstates')}, "
            f"{counted(places, 'places')}" + (f", {counted(paths, 'paths')}" if paths else "")
            for (dstates, places, paths), count in found.sizes
        )
    if found.fits and found.fits[0] != found.fits[1]:
        least, most = found.fits
        yield f"  their misfit to the displacements is a chi-square of {least:.1f} to {most:.1f}"
    if found.unlisted:
        yield f"  only in maps that are not listed: {depending(found.unlisted)}"
    if found.others:
        yield found.others.sentence
        best = found.others.best
        if best.lines:
            yield f"the first maps of both {'are the same, except' if best.same else 'differ'}:"
            yield from (f"  {line}" for line in best.lines)


# The largest number of columns of a table, and of lines of a plan, that are printed. --json prints
# all.
SHOWN_COLUMNS, SHOWN_LINES = 6, 40
# Exit codes if a limit ended the search: with a plan that may not be the best, or without a plan.
EXIT_CUT_SHORT, EXIT_NOTHING = 10, 30


def add_next(verbs: Verbs) -> None:
    parser = verbs.add(
        "next",
        run_next,
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


def run_next(options: argparse.Namespace) -> int:
    from ssh_abduction.rivals.explore import next_experiment  # loads numpy
    from ssh_abduction.rivals.listing import Listing

    check_limit("--time-limit", "seconds", options.time_limit)
    check_limit("--memory-limit", "MiB", options.memory_limit)
    trace = solved_trace(options)
    data = read_json(options.maps)
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
    with on_ctrl_c(interrupt), guard:
        experiment = next_experiment(listing, trace, theory=theory, complete=complete, watch=watch)
    if options.json:
        print(json_line(experiment.to_dict()))
    else:
        print("\n".join(_plan_lines(experiment)))
        if listing.sureness:
            print(listing.sureness)
        weighed = listing.weighed if len(listing.maps) == 1 else None
        if weighed and weighed.proven and not all(r.estimated for r in weighed.rivals[1:]):
            print("to tell it from maps that cost little more, list them: solve --set within=5")
    if experiment.warning:
        warn([experiment.warning])
    if experiment.stopped == "interrupted":
        return interrupted_code()
    if not experiment.stopped:
        return 0
    return EXIT_CUT_SHORT if experiment.plan.branches else EXIT_NOTHING


def _plan_lines(experiment: Experiment) -> Iterator[str]:
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
