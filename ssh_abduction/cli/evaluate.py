"""ssh-abduction evaluate MAPS TRACE: how right are these maps, where the trace has truth?"""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from ssh_abduction.cli.options import Verbs, read_maps
from ssh_abduction.cli.text import counted, table
from ssh_abduction.errors import MapError, named
from ssh_abduction.files import json_line
from ssh_abduction.maps import maps_of
from ssh_abduction.trace import Trace

if TYPE_CHECKING:
    from ssh_abduction.evaluation import Evaluation, MapEvaluation

UNKNOWN = "–"
HEAD = ("map", "isomorphic", "dstates", "places", "paths", "accuracy", "same place", "edges", "links")


def add_parser(verbs: Verbs) -> None:
    text = "Compare maps with the truth that the steps of the trace tell: which map is the true one, and how right are the others?"
    parser = verbs.add_parser("evaluate", help="how right are these maps?", description=text)
    parser.add_argument("maps", help="what solve --json printed for this trace, or one saved map; - for standard input")
    parser.add_argument("trace", help="trace file (JSON Lines) with truth")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.set_defaults(run=run)
    parser.epilog = (
        "Of pairs at the same place, edges and links, the two shares are precision and recall. docs/formats.md says what they are."
    )


def run(options: argparse.Namespace) -> int:
    from ssh_abduction.evaluation import evaluate  # which loads scipy

    data = read_maps(options.maps)
    maps = maps_of(data, str(options.maps))
    if not maps:
        raise MapError(f"{options.maps}: maps: expected one to evaluate, got none; see the status that solve printed")
    trace = Trace.load(options.trace)
    try:
        found = evaluate(maps, trace)
    except MapError as error:
        raise MapError(f"{named(options.maps)}: {error}") from None
    if options.json:
        print(json_line(found.to_dict()))
        return 0
    may_be_more = isinstance(data, dict) and data.get("complete") is False
    print(_headline(found, may_be_more))
    print(_truth(found, len(trace)))
    print(table(HEAD, [_row(i, one) for i, one in enumerate(found.maps, 1)]))
    return 0


def _headline(found: Evaluation, may_be_more: bool) -> str:
    of = f"of {counted(len(found.maps), 'maps')}{', and there may be more' if may_be_more else ''}"
    if found.rank is not None:
        return f"map {found.rank} is the true one, {of}"
    if all(one.isomorphic is None for one in found.maps):
        return f"unknown which map is the true one, {of}: the truth names places or paths only"
    return f"no map is the true one, {of}"


def _truth(found: Evaluation, steps: int) -> str:
    told = ((found.true_dstates, "dstates"), (found.true_places, "places"), (found.true_paths, "paths"))
    counts = ", ".join(counted(number, things) for number, things in told if number is not None)
    ambiguity = "" if found.ambiguity is None else f"; {100 * found.ambiguity:.0f} % of the pairs of dstates share a view"
    return f"the truth, told at {found.steps} of {counted(steps, 'steps')}: {counts}{ambiguity}"


def _row(number: int, one: MapEvaluation) -> list[object]:
    return [
        number,
        _word(one.isomorphic, "yes", "no"),
        *(
            UNKNOWN if count is None else f"{count} {_word(right, 'right', 'wrong')}"
            for count, right in ((one.dstates, one.dstates_right), (one.places, one.places_right), (one.paths, one.paths_right))
        ),
        _share(one.accuracy),
        f"{_share(one.place_precision)} {_share(one.place_recall)}",
        f"{_share(one.edge_precision)} {_share(one.edge_recall)}",
        f"{_share(one.link_precision)} {_share(one.link_recall)}",
    ]


def _word(value: bool | None, yes: str, no: str) -> str:
    return UNKNOWN if value is None else yes if value else no


def _share(share: float | None) -> str:
    return UNKNOWN if share is None else f"{share:.3f}"
