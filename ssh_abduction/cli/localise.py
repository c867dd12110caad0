"""ssh-abduction localise and route: follow a robot in a known map, and find its way."""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any

from ssh_abduction.cli.options import (
    add_map,
    add_maps,
    check_number,
    check_picture,
    draw_plot,
    picture_file,
    read_maps,
    some_maps,
    trace_beside,
    trace_of_maps,
    trace_path,
)
from ssh_abduction.cli.parsing import Verbs
from ssh_abduction.cli.show import named_maps
from ssh_abduction.cli.text import steps_in_words, table
from ssh_abduction.data.errors import LocaliserError, MapError, named, printable, said_of
from ssh_abduction.data.files import json_line
from ssh_abduction.data.groups import gathered
from ssh_abduction.data.schema import only_known
from ssh_abduction.data.trace import Trace

if TYPE_CHECKING:
    from ssh_abduction.data.maps import SSHMap
    from ssh_abduction.online.localiser import Localiser

HEAD = ("step", "action", "seen", "", "dstate")
NUMBERS = ("probability", "nowhere", "entropy", "normaliser")
# For each chance, what has this probability.
CHANCES = {
    "misread": "at a step, the view or image does not fit the dstate where the robot is (default: "
    "0.01)",
    "slipped": "an action fails, or the robot is kidnapped during it (default: 0.01)",
    "unmapped": "the robot is outside the map at the start, after a slip, or after an action for "
    "which the map has no link (default: 0.1)",
    "reentered": "a robot outside the map is back on it after its next action (default: 0.1)",
}
NOWHERE = "–"


def add_localise(verbs: Verbs) -> None:
    parser = verbs.add(
        "localise",
        run_localise,
        "follow a robot in a known map",
        "Find where in a known map the robot was at each step of another trace. Markov "
        "localisation computes a belief over dstates after each step. The robot may start "
        "anywhere, be kidnapped, or leave the map.",
    )
    add_maps(parser)
    parser.add(
        "other",
        "trace of a robot in the mapped world that uses the same names of views and actions; "
        "- for standard input; or a folder that the command 'map' wrote",
        type=trace_path,
    )
    parser.add("--map I", "the number of the map, from 1 (default: 1)", type=int)
    parser.add(
        "--trace TRACE",
        "the trace that was mapped; its steps tell which stars were seen at each dstate, and "
        "how reliable views and links are (default: the trace that solve -o or map wrote with "
        "the maps)",
        type=trace_path,
    )
    parser.add(
        "--recogniser FILE.skops",
        "recogniser that train wrote for this map, to use images instead of views (default: "
        "in a folder that map wrote, one for the images of its trace)",
    )
    for name, said in CHANCES.items():
        parser.add_setting(f"{name} P", f"the probability that {said}", type=float)
    parser.add_setting(
        "zero_one",
        "whether views and actions never fail: the defaults of misread, slipped and unmapped are "
        "then 0, and that of reentered is 1 (default: false)",
        default=False,
    )
    parser.add(
        "--plot PNG", "draw into this file how unsure the belief is at each step", type=picture_file
    )
    parser.add("--json", "print the answer as JSON")


def run_localise(options: argparse.Namespace) -> int:
    check_picture(options.plot)
    localiser, trace = _localiser(options)
    beliefs = [belief.to_dict() for belief in localiser.beliefs(trace)]
    if options.json:
        head = {"map": options.map or 1, "dstates": len(localiser.ssh_map.dstates)}
        head["chances"] = asdict(localiser.chances)
        lines = [json_line({"step": step, **belief}) for step, belief in enumerate(beliefs)]
        print(json_line(head)[:-1] + ', "beliefs": [\n' + ",\n".join(lines) + "\n]}")
    else:
        print(_headline(beliefs))
        seen = ["image" if localiser.reads_images else step.view for step in trace]
        done = ["", *(action.name for action in trace.actions)]
        told = zip(done, seen, beliefs, strict=True)
        rows = [
            [step, action, NOWHERE if view is None else view, *_found(belief, localiser.ssh_map)]
            for step, (action, view, belief) in enumerate(told)
        ]
        place = ("place",) if localiser.ssh_map.places else ()
        print(table((*HEAD, *place, *NUMBERS), rows))
    draw_plot(options, "draw_beliefs", beliefs)
    return 0


def _localiser(options: argparse.Namespace) -> tuple[Localiser, Trace]:
    """Make the localiser that the options ask for, and load the trace that it follows.

    Raises AbductionError, which names the file.
    """
    from ssh_abduction.online.belief import Chances
    from ssh_abduction.online.localiser import Localiser

    data = read_maps(options.maps)
    maps = named_maps(some_maps(data, options.maps, "localise in"), data, options.maps)
    check_number(options.map, maps, options.maps)
    if len(maps) > 1 and options.map is None:
        warnings.warn(
            f"{named(options.maps)}: the first of {len(maps)} maps is taken; choose one with --map",
            stacklevel=1,
        )
    given = only_known(**{name: getattr(options, name) for name in CHANCES})
    chances = replace(Chances.none() if options.zero_one else Chances(), **given)
    ssh_map = maps[(options.map or 1) - 1]
    mapped = Trace.load(options.trace) if options.trace else _mapped(options.maps)
    other = Trace.load(options.other)
    recogniser = _recogniser(options, ssh_map, mapped, other)
    of_recogniser = said_of(named(options.recogniser or options.maps), LocaliserError)
    with said_of(named(options.maps), MapError), of_recogniser:
        return Localiser(ssh_map, recogniser, trace=mapped, chances=chances), other


def _mapped(maps: str) -> Trace | None:
    """Return the trace that was mapped, if it is beside the maps or in their file."""
    beside = trace_beside(maps)
    return Trace.load(beside) if beside else trace_of_maps(maps)


def _recogniser(
    options: argparse.Namespace, ssh_map: SSHMap, mapped: Trace | None, other: Trace
) -> Any:
    """Return the named recogniser, or train one if a log was mapped and both traces have images."""
    if options.recogniser:
        from perception.store import load

        return load(options.recogniser).model
    is_log = options.trace is None and trace_beside(options.maps) is not None
    if not is_log or mapped is None or other.steps[0].image is None:
        return None
    from ssh_abduction.robot_logs.log_maps import recogniser_of

    return recogniser_of(mapped, ssh_map)


def _headline(beliefs: Sequence[Mapping[str, Any]]) -> str:
    """List the steps with each verdict, such as "located", and those where the belief collapsed."""
    steps = gathered((belief["verdict"], step) for step, belief in enumerate(beliefs))
    parts = [f"{verdict} at {steps_in_words(some)}" for verdict, some in steps.items()]
    if collapses := [step for step, belief in enumerate(beliefs) if belief["collapsed"]]:
        parts.append(f"the belief collapsed at {steps_in_words(collapses)}")
    return "; ".join(parts)


def _found(belief: Mapping[str, Any], ssh_map: SSHMap) -> list[object]:
    """Make the cells about a belief: the verdict, the dstate and its place, and numbers."""
    dstate: int | None = belief["dstate"]
    cells: list[object] = [belief["verdict"], NOWHERE if dstate is None else dstate]
    if ssh_map.places:
        place = None if dstate is None else ssh_map.dstates[dstate].place
        cells.append(NOWHERE if place is None else ssh_map.numbered("place", place))
    shares = [f"{belief[name]:.3f}" for name in ("probability", "nowhere")]
    return [*cells, *shares, f"{belief['entropy']:.2f}", f"{belief['normaliser']:.3g}"]


def add_route(verbs: Verbs) -> None:
    parser = verbs.add(
        "route",
        run_route,
        "find the actions that lead to a place",
        "Find the shortest route through a map: the actions from one dstate or place to "
        "another, and the views to expect on the way. If the map lists regions, say first which "
        "regions the route leaves and enters, and which paths it passes.",
        "ssh-abduction show lists the dstates and places of a map. docs/reference/formats.md "
        "describes the JSON.",
    )
    add_maps(parser)
    parser.add(
        "--from A",
        "start: the number of a dstate, a step such as monday:12, or a place or region by number "
        "or name, such as p3, region2 or kitchen (default: the robot's last dstate)",
        dest="start",
    )
    parser.add(
        "--to B", "goal: a dstate, place or region, named as for --from", dest="goal", required=True
    )
    said = "dstates, places and regions that the route must not visit"
    parser.add("--avoid X", said, nargs="+", action="extend")
    parser.add(
        "--by",
        "what to minimise (default: actions). With actions or metres, a route uses only moves "
        "that the robot has made. With places, it may use any move along a path of the "
        "map, and drive back where it came from",
        choices=("actions", "places", "metres"),
        default="actions",
    )
    add_map(parser)
    parser.add("--json", "print the answer as JSON")


def run_route(options: argparse.Namespace) -> int:
    from ssh_abduction.online.routes import action_in_words, route  # loads networkx
    from ssh_abduction.rivals.listing import Listing

    listing = Listing.load(options.maps)
    given = {name.text for ssh_map in listing.maps for name in ssh_map.names}
    avoid = _names(options.avoid, given)
    with said_of(listing.source, MapError):
        how: dict[str, Any] = {"by": options.by, "map": options.map}
        found = route(listing, options.start, options.goal, avoid=avoid, **how)
    if options.json:
        print(json_line(found.to_dict()))
        return 0
    print(printable(found.sentence))
    if found.legs:
        called = listing.maps[found.map - 1].called
        print(printable(f"by regions: {'; '.join(leg.in_words(called) for leg in found.legs)}"))
    if found.moves:
        chosen = listing.maps[found.map - 1]
        rows = [
            [
                action_in_words(move),
                "" if move.dstate is None else move.dstate,
                "not known" if move.view is None else move.view,
                "" if move.place is None else chosen.numbered("place", move.place),
                move.course,
                *([] if move.metres is None else [f"{move.metres:.2f}"]),
                "" if move.known else "never tried",
            ]
            for move in found.moves
        ]
        metres = [] if found.metres is None else ["metres"]
        print(table(["action", "dstate", "expect", "place", "path", *metres, ""], rows))
    return 0


def _names(words: list[str] | None, given: Collection[str]) -> list[str]:
    """Split words at commas, to list what to avoid. Names that a person gave may have commas."""
    return [
        name
        for word in words or ()
        for name in ([word] if word in given else word.split(","))
        if name
    ]
