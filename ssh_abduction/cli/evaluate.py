"""ssh-abduction evaluate and ladder: compare maps with the truth, and kinds of evidence."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import TYPE_CHECKING

from ssh_abduction.cli.guard import Guard
from ssh_abduction.cli.options import (
    add_maps,
    add_max_maps,
    add_theory,
    add_trace,
    read_maps,
    some_maps,
    theory_of,
    trace_of,
    trace_path,
)
from ssh_abduction.cli.outcome import on_ctrl_c, warn
from ssh_abduction.cli.parsing import Verbs
from ssh_abduction.cli.text import counted, table
from ssh_abduction.data.errors import MapError, named, said_of
from ssh_abduction.data.files import json_line
from ssh_abduction.data.trace import Trace
from ssh_abduction.runtime.program import interrupted_code
from ssh_abduction.solver import Stop

if TYPE_CHECKING:
    from ssh_abduction.evaluation import Evaluation, MapEvaluation, MapPairs, VisitsEvaluation
    from ssh_abduction.evaluation.rungs import Rung

UNKNOWN = "–"
# If poses and relations agree on less than this share of the pairs of visits, they belong to
# different logs, or one of them is wrong.
ALIKE = 0.9
OF_PAIRS = ("joined", "right", "precision", "recall")
PAIRS = ("map", "places", *OF_PAIRS, "dstates", *OF_PAIRS)
THINGS = ("dstates", "places", "paths")
HEAD = ("map", "isomorphic", *THINGS, "accuracy", "same place", "edges", "links")


def add_evaluate(verbs: Verbs) -> None:
    parser = verbs.add(
        "evaluate",
        run_evaluate,
        "compare maps with the truth",
        "Compare maps with the truth in the trace. Reports which map is true, and how far the "
        "other maps are from the truth.",
        "The table gives precision and recall (shares from 0 to 1) for pairs of steps at one "
        "place, for edges (two places between which the robot travelled), and for links. If steps "
        "have true poses but no true names, as in an imported log, visits near each other count "
        "as one place. docs/reference/formats.md describes what is counted.",
    )
    add_maps(parser)
    add_trace(parser, " with truth")
    parser.add_setting(
        "near METRES",
        "judge by true poses, too: visits within this distance count as one place (if no step "
        "names its true place, this is done anyway, with 2 metres)",
        type=float,
    )
    parser.add_setting(
        "relations FILE",
        "also judge by hand-checked relative poses in this file: lines of time1 time2 x y z "
        "roll pitch yaw",
    )
    parser.add(
        "--truth FILE",
        "judge by the robot's true trajectory in this file, in TUM format: lines of timestamp "
        "tx ty tz qx qy qz qw",
    )
    parser.add("--json", "print the answer as JSON")


def run_evaluate(options: argparse.Namespace) -> int:
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

    file = trace_of(options)
    data = read_maps(options.maps)
    maps = some_maps(data, options.maps, "evaluate")
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
        may_be_more = isinstance(data, dict) and data.get("complete") is False
        print(_headline(found, may_be_more))
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
        yield _nothing_judged(found)
    if found.by_both is not None and found.by_both[1] < ALIKE * found.by_both[0]:
        agree = f"{found.by_both[1]} of {counted(found.by_both[0], 'pairs')} of visits only"
        ask = f"are {named(relations)} relations of this log?"
        yield f"relations and the poses of the trace agree on {agree}: {ask}"


def _nothing_judged(found: VisitsEvaluation) -> str:
    """Explain why no pair of visits was judged."""
    why, places = f"the trace has {counted(found.visits, 'visits')}", found.places
    if places.stayed:
        near = f"{counted(places.stayed, 'pairs')} within {found.near:g} m"
        why += f"; between the visits of {near}, the robot made no visit farther away"
    if places.unknown:
        pairs = counted(places.unknown, "pairs")
        why += f"; for {pairs}, {found.judge} do not tell how far apart the visits are"
    return (
        f"judged by {found.judge}: expected pairs of visits to judge, got none: {why}; evaluate a "
        "longer drive, or with truth at more steps"
    )


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


UNKNOWN = "–"
RUNG_HEAD = (
    "",
    "minimal maps",
    "dstates",
    "places",
    "paths",
    "the true one",
    "accuracy",
    "seconds",
)


def add_ladder(verbs: Verbs) -> None:
    parser = verbs.add(
        "ladder",
        run_ladder,
        "show how much each kind of evidence helps",
        "Solve a trace several times, to show what each kind of evidence is worth. Begin with "
        "views alone, then add one kind at a time: stars (openings seen), pairs of steps that "
        "displacements distinguish, pairs of returns (two steps at one place or dstate) that "
        "displacements exclude together, planarity (paths cross only at places). Each time (a "
        "rung of the ladder), report the number and the size of the minimal maps; and, if the "
        "trace has truth, which map is true.",
    )
    parser.add("trace", "trace file (JSON Lines), or - for standard input", type=trace_path)
    add_max_maps(parser, "maps on each rung")
    parser.add("--time-limit S", "stop each search after S seconds", type=float)
    parser.add("--json", "print one JSON object for each rung")
    add_theory(parser)


def run_ladder(options: argparse.Namespace) -> int:
    from ssh_abduction.evaluation.rungs import UnderWay, ladder  # loads scipy

    trace, theory = Trace.load(options.trace), theory_of(options)
    rungs: list[Rung] = []
    under_way = UnderWay()

    def written() -> str:
        """The table of all rungs; empty with --json, as each rung was printed when it was found."""
        return "" if options.json else f"{table(RUNG_HEAD, list(map(_rung_row, rungs)))}\n"

    def last_words(_: Stop) -> tuple[str, int]:
        return written(), interrupted_code()

    interrupt = under_way.interrupt
    with on_ctrl_c(interrupt), Guard(interrupt, last_words) as guard:
        for rung in ladder(
            trace,
            theory,
            time_limit=options.time_limit,
            max_maps=options.maps or None,
            under_way=under_way,
        ):
            rungs.append(rung)
            if options.json:
                guard.say(lambda: f"{json_line(rungs[-1].to_dict())}\n")
        code = interrupted_code() if under_way.interrupted else 0
        guard.finish(code, written)
    return code


def _rung_row(rung: Rung) -> list[object]:
    """Make the row of a rung in the table."""
    data, cost = rung.to_dict(), rung.solution.cost
    counts: Iterator[object] = (
        getattr(cost, name) if cost else UNKNOWN for name in ("dstates", "places", "paths")
    )
    more = "" if rung.solution.complete else "+"
    listed = f"{data['count']}{more}" if data["status"] == "optimal" else f"{data['status']}"
    truth = (
        UNKNOWN if rung.evaluation is None else "none" if rung.rank is None else f"map {rung.rank}"
    )
    accuracy = UNKNOWN if data["accuracy"] is None else f"{data['accuracy']:.3f}"
    return [rung.name, listed, *counts, truth, accuracy, f"{data['seconds']:.2f}"]
