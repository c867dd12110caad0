"""ssh-abduction compare, next and evaluate: compare maps with each other and with the truth."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ssh_abduction.cli import shared
from ssh_abduction.cli.outcome import EXIT_UNPROVEN, Guard, on_ctrl_c, warn
from ssh_abduction.cli.parsing import maps_path, verb
from ssh_abduction.cli.text import compared, counted, depending, table
from ssh_abduction.data.checks import check_limit
from ssh_abduction.data.errors import MapError, brief, named, printable, said_of
from ssh_abduction.data.files import json_line
from ssh_abduction.data.map_parts import read_json
from ssh_abduction.data.schema import attributes_of
from ssh_abduction.data.trace import Trace
from ssh_abduction.data.words import noun_of
from ssh_abduction.rivals.listing import DrivePair, Listing, joins_of_drives
from ssh_abduction.runtime.limits import Watch
from ssh_abduction.runtime.program import interrupted_code
from ssh_abduction.solution import stretches
from ssh_abduction.theory.theory import Theory

if TYPE_CHECKING:
    from ssh_abduction.evaluation import Evaluation, MapEvaluation, MapPairs, VisitsEvaluation
    from ssh_abduction.rivals.comparison import Comparison
    from ssh_abduction.rivals.differences import SharedSides
    from ssh_abduction.rivals.explore import Experiment, ExperimentPlan


# Values in run.json that differ between runs even if all settings and results are the same.
UNSTEADY = ("seconds", "limit", "drove", "log.source")


@verb({"maps": {"type": str}})
def run_compare(options: argparse.Namespace) -> int:
    """Show what rival maps share, and where they differ.

    Compare the minimal maps of a trace. Reports what all of them share, where they differ, and
    which questions about steps decide between them.

    The questions that decide between the maps are chosen greedily. None can be left out, but a
    shorter list may exist. docs/reference/formats.md describes the JSON.
    """
    from ssh_abduction.rivals.comparison import compare  # loads numpy
    from ssh_abduction.rivals.differences import difference, shared_sides

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
    lines = [listing.verdict, *_lines(found), *_faults(listing)]
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


SHOWN_LINES = 40  # of a plan; --json prints all
EXIT_NOTHING = 30  # the exit code if a limit ended the search without a plan


@verb(theory_rows=shared.theory_rows("the theory in the file of maps"))
def run_next(options: argparse.Namespace) -> int:
    """Find the actions after which rival maps disagree.

    Find the fewest actions, from where the robot is now, after which two maps predict different
    views. If there are more than two maps, find a plan: which actions come next depends on what the
    robot sees. If known links cannot distinguish the maps, find the untried action that
    distinguishes as many of the maps as possible, and the way to it.

    The plan for two maps is as short as possible. The plan for more maps is greedy, because finding
    the best one is PSPACE-complete (Lee & Yannakakis 1994). docs/reference/formats.md describes the
    JSON.

    Exit codes: 0 done; 10 with --strict, if a limit ended the search and a better plan may exist;
    30 no plan in time.
    """
    from ssh_abduction.rivals.explore import next_experiment  # loads numpy

    check_limit("--time-limit", "seconds", options.time_limit)
    check_limit("--memory-limit", "MiB", options.memory_limit)
    trace = shared.solved_trace(options)
    data = read_json(options.maps)
    listing = Listing.from_dict(data, named(options.maps))
    found = shared.written_theory(data)
    theory: Theory | None = shared.theory_of(options, found)
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
        print("\n".join([listing.verdict, *_plan_lines(experiment)]))
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
    return EXIT_UNPROVEN if experiment.plan.branches else EXIT_NOTHING


def _plan_lines(experiment: Experiment) -> Iterator[str]:
    """Yield the lines that describe an experiment to people."""
    yield experiment.sentence
    lines = list(_tree(experiment.plan, "  "))
    yield from lines[:SHOWN_LINES]
    if len(lines) > SHOWN_LINES:
        yield f"  and {counted(len(lines) - SHOWN_LINES, 'more lines')} (--json has all)"


def _tree(plan: ExperimentPlan, indent: str) -> Iterator[str]:
    """Yield a plan as indented lines: actions, and what rivals expect to see after them.

    Known links lead to the branches of a plan. If they distinguish no more rivals, the actions end
    with an untried one.
    """
    untried = plan.untried
    if plan.branches:
        yield f"{indent}{printable(', '.join(plan.actions))}"
    for branch in plan.branches:
        yield f"{indent}  {printable(str(branch.seen))}: {_rivals_in_words(branch.plan.rivals)}"
        yield from _tree(branch.plan, f"{indent}    ")
    if plan.branches or len(plan.rivals) == 1:
        return
    if untried is None:
        yield f"{indent}nothing distinguishes them"
        return
    yield f"{indent}{printable(', '.join((*untried.way, untried.action)))} (untried)"
    for expected in untried.expects:
        seen = "not known" if expected.says.seen is None else printable(str(expected.says.seen))
        how = "" if expected.says.seen is None else f" ({expected.says.how})"
        yield f"{indent}  {seen}{how}: {_rivals_in_words(expected.rivals)}"


def _rivals_in_words(rivals: Sequence[int]) -> str:
    """Put the numbers of rivals into words: "map 1", or "maps 1–3 and 7"."""
    return f"{noun_of('map', rivals)} {stretches(rivals)}"


UNKNOWN = "–"
# If poses and relations agree on less than this share of the pairs of visits, they belong to
# different logs, or one of them is wrong.
ALIKE = 0.9
OF_PAIRS = ("joined", "right", "precision", "recall")
PAIRS = ("map", "places", *OF_PAIRS, "dstates", *OF_PAIRS)
THINGS = ("dstates", "places", "paths")
HEAD = ("map", "isomorphic", *THINGS, "accuracy", "same place", "edges", "links")


@verb()
def run_evaluate(options: argparse.Namespace) -> int:
    """Compare maps with the truth.

    Reports which map is true, and how far the other maps are from the truth in the trace.

    The table gives precision and recall (shares from 0 to 1) for pairs of steps at one place, for
    edges (two places between which the robot travelled), and for links. If steps have true poses
    but no true names, as in an imported log, visits near each other count as one place.
    docs/reference/formats.md describes what is counted.
    """
    # These are imported here because they load scipy.
    from ssh_abduction.evaluation import (
        Relations,
        Trajectory,
        evaluate,
        evaluate_visits,
        tells_names,
        told_poses,
    )
    from ssh_abduction.evaluation.pose_truth import NEAR

    file = shared.trace_of(options)
    listing = shared.listing_of(options.maps)
    maps = listing.maps
    trace = Trace.load(file)
    if options.truth is not None:
        trace = Trajectory.load(options.truth).told_to(trace)
    relations = None if options.relations is None else Relations.load(options.relations)
    near = NEAR if options.near is None else options.near
    named_truth = tells_names(trace)
    found, judged = None, []
    with said_of(named(options.maps), MapError):
        by_poses = options.near is not None or options.truth is not None
        if by_poses or (not named_truth and any(told_poses(trace))):
            judged.append(evaluate_visits(maps, trace, near=near))
        if relations is not None:
            judged.append(evaluate_visits(maps, trace, near=near, relations=relations))
        if named_truth or not judged:
            found = evaluate(maps, trace)
    for visits in judged:
        warn(_doubts(visits, options.relations))
    if options.json:
        record = {"count": len(maps)} if found is None else found.to_dict()
        print(json_line({**record, **{visits.judge: visits.to_dict() for visits in judged}}))
        return 0
    if found is not None:
        print(_headline(found, may_be_more=listing.complete is False))
        print(_truth(found, len(trace)))
        print(table(HEAD, [_row(i, one) for i, one in enumerate(found.maps, 1)]))
    for visits in judged:
        print(_visits_in_words(visits))
        rows = enumerate(visits.maps, 1)
        print(table(PAIRS, [[i, *_pairs(one.places), *_pairs(one.dstates)] for i, one in rows]))
    return 0


def _doubts(found: VisitsEvaluation, relations: str | None) -> Iterator[str]:
    """Yield warnings if nothing is judged, or if the relations seem to be of another log."""
    if not found.places.judged:
        yield (
            f"judged by {found.judge}: expected pairs of visits to judge, got none of "
            f"{counted(found.visits, 'visits')}; evaluate a longer drive, or with truth at more "
            "steps"
        )
    if found.by_both is not None and found.by_both[1] < ALIKE * found.by_both[0]:
        agree = f"{found.by_both[1]} of {counted(found.by_both[0], 'pairs')} of visits only"
        ask = f"are {named(relations)} relations of this log?"
        yield f"relations and the poses of the trace agree on {agree}: {ask}"


def _visits_in_words(found: VisitsEvaluation) -> str:
    """Say how many pairs of visits and of steps were judged, and how many were left out."""
    places, dstates = found.places, found.dstates
    lines = [
        f"judged by {found.judge}: {places.returns} of {counted(places.judged, 'pairs')} of visits "
        f"are returns to one place (within {found.near:g} m, and the robot was farther away in "
        f"between); {dstates.returns} of {counted(dstates.judged, 'pairs')} of steps are returns "
        f"to one dstate (headings also differ by at most {found.turned:g} degrees)"
    ]
    if places.stayed:
        stayed = "within this distance, as the robot made no visit farther away in between"
        lines.append(f"left out: {counted(places.stayed, 'pairs')} {stayed}")
    if places.unknown:
        unknown = counted(places.unknown, "pairs")
        lines.append(f"left out: {unknown}, as {found.judge} do not tell how far apart they are")
    if found.by_both:
        pairs = counted(found.by_both[0], "pairs")
        lines.append(f"poses and relations agree on {found.by_both[1]} of {pairs} of visits")
    return "\n".join(lines)


def _pairs(pairs: MapPairs | None) -> list[object]:
    """Make five cells of a row about pairs; dashes if the map has no places."""
    if pairs is None:
        return [UNKNOWN] * 5
    return [pairs.things, pairs.joined, pairs.right, _share(pairs.precision), _share(pairs.recall)]


def _headline(found: Evaluation, may_be_more: bool) -> str:
    """Say which map is the true one. `may_be_more` says if minimal maps may be missing."""
    of = f"{counted(len(found.maps), 'maps')}{', and there may be more' if may_be_more else ''}"
    if found.rank is not None:
        return f"{of}: map {found.rank} is the true one"
    if all(one.isomorphic is None for one in found.maps):
        return f"{of}: unknown which is the true one, as the truth names places or paths only"
    return f"{of}: none is the true one"


def _truth(found: Evaluation, steps: int) -> str:
    """Describe the truth of a trace with this number of steps: where it is known, and counts."""
    known = {things: getattr(found, f"true_{things}") for things in THINGS}
    counts = ", ".join(counted(n, things) for things, n in known.items() if n is not None)
    ambiguity = ""
    if found.ambiguity is not None:
        ambiguity = f"; {100 * found.ambiguity:.0f} % of the pairs of dstates share a view"
    return f"the truth, known at {found.steps} of {counted(steps, 'steps')}: {counts}{ambiguity}"


def _row(number: int, one: MapEvaluation) -> list[object]:
    """Make the table row of the map with this number."""
    counts = []
    for kind in THINGS:
        count, is_right = getattr(one, kind), getattr(one, f"{kind}_right")
        said = f"{count} {_word(is_right, 'right', 'wrong')}"
        counts.append(UNKNOWN if count is None else said)
    shares = [
        " ".join(_share(getattr(one, f"{kind}_{what}")) for what in ("precision", "recall"))
        for kind in ("place", "edge", "link")
    ]
    isomorphic = _word(one.isomorphic, "yes", "no")
    return [number, isomorphic, *counts, _share(one.accuracy), *shares]


def _word(value: bool | None, yes: str, no: str) -> str:
    return UNKNOWN if value is None else yes if value else no


def _share(share: float | None) -> str:
    return UNKNOWN if share is None else f"{share:.3f}"
