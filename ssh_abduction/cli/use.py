"""ssh-abduction localise, route, show, export and view: use a known map.

Follow a robot in the map, find its way, and show the map here, in other programs or in the browser.
"""

from __future__ import annotations

import argparse
import shlex
import signal
import sys
import tempfile
import webbrowser
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ssh_abduction.cli import shared
from ssh_abduction.cli.correct import as_corrected, correct_pair
from ssh_abduction.cli.outcome import warn
from ssh_abduction.cli.parsing import pose, trace_path, verb
from ssh_abduction.cli.text import describe, table
from ssh_abduction.data.corrections import CORRECTED, beside, named_beside
from ssh_abduction.data.drives import Drive, drives_of
from ssh_abduction.data.errors import (
    AbductionError,
    LocaliserError,
    MapError,
    named,
    printable,
    said_of,
)
from ssh_abduction.data.files import json_line
from ssh_abduction.data.groups import gathered
from ssh_abduction.data.map_parts import described, read_json, write_map
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.schema import only_known
from ssh_abduction.data.trace import Trace
from ssh_abduction.rivals.listing import Listing
from ssh_abduction.runtime import program
from ssh_abduction.runtime.workers import end_all
from ssh_abduction.solution import steps_in_words
from ssh_abduction.theory.theory import Theory

if TYPE_CHECKING:
    from ssh_abduction.online.localiser import Localiser
    from ssh_abduction.page.content import Called, Ground, Run


HEAD = ("step", "action", "seen", "", "dstate")
NUMBERS = ("probability", "nowhere", "entropy", "normaliser")
CHANCES = ("misread", "slipped", "unmapped", "reentered")
NOWHERE = "–"


@verb({"other": {"type": trace_path}})
def run_localise(options: argparse.Namespace) -> int:
    """Follow a robot in a known map.

    Find where in a known map the robot was at each step of another trace. Markov localisation
    computes a belief over dstates after each step. The robot may start anywhere, be kidnapped, or
    leave the map.
    """
    shared.check_picture(options.plot)
    localiser, trace = _localiser(options)
    beliefs = [belief.to_dict() for belief in localiser.beliefs(trace)]
    if options.json:
        head = {"map": options.map, "dstates": len(localiser.ssh_map.dstates)}
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
    shared.draw_plot(options, "draw_beliefs", beliefs)
    return 0


def _localiser(options: argparse.Namespace) -> tuple[Localiser, Trace]:
    """Make the localiser that the options ask for, and load the trace that it follows.

    Raises AbductionError, which names the file.
    """
    from ssh_abduction.online.localiser import Chances, Localiser

    listing = shared.listing_of(options.maps)
    if options.map is None and len(listing.maps) > 1:
        first = f"the first of {len(listing.maps)} maps is taken; choose one with --map"
        warn([f"{named(options.maps)}: {first}"])
    options.map = listing.number(options.map or "1") + 1
    given = only_known(**{name: getattr(options, name) for name in CHANCES})
    chances = replace(Chances.none() if options.zero_one else Chances(), **given)
    ssh_map = listing.maps[options.map - 1]
    mapped = shared.mapped_trace(options.maps, options.trace)
    other = Trace.load(options.other)
    recogniser = _recogniser(options, ssh_map, mapped, other)
    of_recogniser = said_of(named(options.recogniser or options.maps), LocaliserError)
    with said_of(named(options.maps), MapError), of_recogniser:
        return Localiser(ssh_map, recogniser, trace=mapped, chances=chances), other


def _recogniser(
    options: argparse.Namespace, ssh_map: SSHMap, mapped: Trace | None, other: Trace
) -> Any:
    """Return the named recogniser, or train one if a log was mapped and both traces have images."""
    if options.recogniser:
        from perception.store import load

        return load(options.recogniser)
    is_log = options.trace is None and shared.trace_beside(options.maps) is not None
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


@verb({"--from": {"dest": "start"}, "--to": {"dest": "goal"}})
def run_route(options: argparse.Namespace) -> int:
    """Find the actions that lead to a place.

    Find the shortest route through a map: the actions from one dstate or place to another, and the
    views to expect on the way. If the map lists regions, say first which regions the route leaves
    and enters, and which paths it passes.

    ssh-abduction show lists the dstates and places of a map. docs/reference/formats.md describes
    the JSON.
    """
    from ssh_abduction.online.routes import action_in_words, route  # loads networkx

    listing = Listing.load(options.maps)
    given = {name.text for ssh_map in listing.maps for name in ssh_map.names}
    avoid = _names(options.avoid, given)
    if options.words:
        return _tell_way(options, listing)
    with said_of(listing.source, MapError):
        how: dict[str, Any] = {"by": options.by, "map": options.map}
        found = route(listing, options.start, options.goal, avoid=avoid, **how)
    if options.json:
        print(json_line(found.to_dict()))
        return 0
    if options.by is None and found.by == "places":
        print("no moves that the robot has made lead there, so this route is by places:")
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


def _tell_way(options: argparse.Namespace, listing: Listing) -> int:
    """Print a route in words."""
    if options.avoid or options.by:
        flag = "--avoid" if options.avoid else "--by"
        raise MapError(f"{flag}: expected none with --words, which tells the shortest way; drop it")
    ssh_map = _built(options, listing, listing.maps[listing.number(options.map)])
    trace = shared.mapped_trace(options.maps, options.trace)
    if trace is None:
        raise MapError(
            f"{named(options.maps)}: --words: expected the trace of the map, got none; name it "
            "with --trace"
        )
    with said_of(listing.source, MapError):
        start, goal, told = way_in_words(
            ssh_map, trace, listing.drives, options.start, options.goal
        )
    if options.json:
        print(json_line({"from": start, "to": goal, "words": list(told)}))
    else:
        print(printable(f"from {start} to {goal}: {'; '.join(told)}"))
    return 0


def way_in_words(
    ssh_map: SSHMap, trace: Trace, drives: Sequence[Drive], start: str | None, goal: str
) -> tuple[str, str, tuple[str, ...]]:
    """Tell the shortest way: words for its start and for its goal, and its sentences.

    `start` and `goal` are as for the verb route; None for the last dstate of the robot. Raises
    MapError.
    """
    from ssh_abduction.building.directions import directions_to
    from ssh_abduction.online.routes import MoveGraph

    graph = MoveGraph(ssh_map, "actions", drives)
    last = f"d{ssh_map.dstate_at[-1]}"
    ends = graph.nodes(start or last, "from"), graph.nodes(goal, "to")
    here, there = (
        [p for node in nodes if (p := graph.course(node)[0]) is not None] for nodes, _ in ends
    )
    return ends[0][1], ends[1][1], directions_to(ssh_map, trace, here, there)


def _names(words: list[str] | None, given: Collection[str]) -> list[str]:
    """Split words at commas, to list what to avoid. Names that a person gave may have commas."""
    parts = ([word] if word in given else word.split(",") for word in words or ())
    return [*filter(None, chain.from_iterable(parts))]


@verb()
def run_show(options: argparse.Namespace) -> int:
    """Print the dstates, places, paths and links of maps.

    Regions are also printed.
    """
    listing = shared.listing_of(options.maps)
    if options.paths:
        from ssh_abduction.building.derive import buildings_of  # loads numpy
        from ssh_abduction.building.telling import told

        ssh_map = _built(options, listing, listing.maps[listing.number(options.map or "1")])
        lines = [*told(ssh_map)]
        print("\n".join(map(printable, lines)))
        trace = shared.mapped_trace(options.maps, options.trace)
        for other in [*buildings_of(ssh_map, trace, OTHERS)][1:] if trace else ():
            print("  or, equally good:")
            print("\n".join(printable(line) for line in told(other) if line not in lines))
        return 0
    if options.map is not None:
        print(_with_regions(listing.maps[listing.number(options.map)]))
        return 0
    print("\n\n".join(f"map {i}\n{_with_regions(m)}" for i, m in enumerate(listing.maps, 1)))
    return 0


def _built(options: argparse.Namespace, listing: Listing, ssh_map: SSHMap) -> SSHMap:
    """Return a map with its paths, corridors, doors and rooms, derived if it has none."""
    if ssh_map.building is not None:
        return ssh_map
    from ssh_abduction.building.derive import with_building  # loads numpy

    trace = shared.mapped_trace(options.maps, options.trace)
    if trace is None:
        raise MapError(
            f"{named(options.maps)}: expected maps with paths, or their trace, got neither; name "
            "the trace that was mapped with --trace"
        )
    with said_of(named(options.maps), MapError):
        return named_beside([with_building(ssh_map, trace)], listing.drives, options.maps)[0]


def _with_regions(ssh_map: SSHMap) -> str:
    """Describe a map and its regions: sets of places beside paths, or behind one place."""
    regions = [f"  {described(region, ssh_map.called)}" for region in ssh_map.regions or ()]
    return "\n".join([describe(ssh_map), *regions])


# The most buildings that `show --paths` lists.
OTHERS = 10
# The formats of ssh_abduction.output.export, whose import of networkx would delay all verbs, with
# the endings of their files.
FORMATS = {
    "nav2": (".geojson",),
    "tmap2": (".yaml", ".yml"),
    "osm": (".osm",),
    "graphml": (".graphml",),
    "dot": (".dot", ".gv"),
    "svg": (".svg",),
    "networkx-json": (".json",),
    "rerun": (".rrd",),
}


@verb({"-o": {"default": "-"}, "--origin": {"type": pose}})
def run_export(options: argparse.Namespace) -> int:
    """Write a map for Nav2, tmap2, OpenStreetMap, GraphML, DOT, networkx or rerun.

    Write a map in the format of another program: a route graph for Nav2 (GeoJSON), a topological
    map for LCAS's topological_navigation (tmap2, YAML), an area graph of rooms and doors (osm,
    OpenStreetMap XML), GraphML, Graphviz DOT, SVG, JSON for networkx, or a recording of the walls,
    the track, the scans and the map for the viewer of rerun.

    Positions are in metres from the first dstate if the map has poses. Otherwise they come from a
    layout, and a warning says so. docs/reference/formats.md describes each format.
    """
    from ssh_abduction.output.export import export_doubts, export_map  # loads networkx

    shared.check_ending(options.output, *FORMATS[options.to])
    listing = Listing.load(options.maps)
    chosen = listing.maps[listing.number(options.map)]
    if options.to == "osm":
        chosen = _built(options, listing, chosen)
    if options.to == "rerun":
        return _recorded(options, chosen)
    if options.frame_of is not None or options.origin is not None:
        chosen = _framed(options, listing, chosen)
    how: dict[str, Any] = {"level": options.level, "hide_undecided": options.hide_undecided}
    how["turns"] = None if options.trace is None else Trace.load(options.trace)
    with said_of(listing.source, MapError):
        text = export_map(chosen, options.to, name=options.name, frame=options.frame, **how)
    if options.output == "-":
        print(text.removesuffix("\n"))
    else:
        write_map(options.output, text.removesuffix("\n"))
    warn(export_doubts(chosen, options.to, **how))
    return 0


def _recorded(options: argparse.Namespace, ssh_map: SSHMap) -> int:
    """Write a recording for the viewer of rerun."""
    from ssh_abduction.page.recording import save_recording

    if options.output == "-":
        raise AbductionError("-o: expected a file for rerun, got standard output; name a .rrd file")
    trace = shared.mapped_trace(options.maps, options.trace)
    ground = _ground(options, trace)
    if trace is None or ground is None or not ground.seen:
        raise AbductionError(
            f"{named(options.maps)}: expected the folder that map wrote for a log, got maps "
            "without its page.html, which has the walls; map the log, and name its folder"
        )
    for name in ("frame_of", "origin"):
        if getattr(options, name) is not None:
            flag = f"--{name.replace('_', '-')}"
            raise AbductionError(f"{flag}: expected none with rerun; leave it out")
    save_recording(options.output, trace.name or "ssh-abduction", ssh_map, trace, ground)
    return 0


def _framed(options: argparse.Namespace, listing: Listing, ssh_map: SSHMap) -> SSHMap:
    """Move a map into the frame that the options name, and print the residuals."""
    from ssh_abduction.output.map_frames import MapFrame, frame_of_file

    if options.frame_of is None:
        return MapFrame.of_origin(*options.origin).moved(ssh_map)
    if options.origin is not None:
        raise AbductionError("--origin: expected none with --frame-of; leave out one of the two")
    trace = shared.mapped_trace(options.maps, options.trace)
    drives = listing.drives or (drives_of(trace) if trace else ())
    frame = frame_of_file(options.frame_of, ssh_map, trace, drives)
    print(printable(f"{named(options.frame_of)}: {frame.sentence}"), file=sys.stderr)
    return frame.moved(ssh_map)


def write_frame(maps: str, points: Sequence[Sequence[float]]) -> str:
    """Write points that are known in two maps beside a file of maps, and say how to use them.

    Each point has its position in the map and that in the other map, in metres. Raises MapError.
    """
    from ssh_abduction.output.map_frames import write_points

    file = Path(maps).parent / "frame.csv"
    sentence = write_points(file, points)
    folder = maps if shared.trace_beside(maps) is None else str(Path(maps).parent)
    named_files = f"{shlex.quote(folder)} --to nav2 --frame-of {shlex.quote(str(file))}"
    return (
        f"{sentence}\nwritten to {named(file)}; to use it: ssh-abduction export {named_files} "
        "-o graph.geojson"
    )


@verb({"port": {"default": "0"}})
def run_view(options: argparse.Namespace) -> int:
    """See rival maps in the browser.

    Show maps on one page: what all maps share, where they differ, each map alone, two maps side by
    side, and what happened at each step.

    The page is one file that works without a network. Without --serve, it cannot ask the solver. It
    shows the commands for that.
    """
    from ssh_abduction.page.content import Called, content_of  # loads numpy
    from ssh_abduction.page.html import Page

    options.trace = options.trace or shared.trace_beside(options.maps)
    trace = shared.mapped_trace(options.maps, options.trace)
    data = read_json(options.maps)
    source = "standard input" if options.maps == "-" else options.maps
    listing = Listing.from_dict(data, source).named_beside(options.maps)
    _check(options, trace)
    theory = shared.written_theory(data)
    maps = "maps.json" if options.maps == "-" else options.maps
    flags = [] if theory is None else ["--theory", maps]
    if trace is not None and theory is not None:
        recorded = trace, theory
        trace, theory = as_corrected(trace, theory, options.maps)
        if (trace, theory) != recorded:
            flags += ["--corrections", str(beside(maps))]
            listing = replace(listing, warnings=(*listing.warnings, CORRECTED))
    called = Called(
        shlex.quote(maps),
        shlex.quote(options.trace) if options.trace else "TRACE",
        "".join(f" {shlex.quote(flag)}" for flag in flags),
    )
    localised = _run(options, trace)
    if options.serve:
        assert trace is not None
        return _serve(options, listing, trace, theory, localised, called)
    page = Page(content_of(listing, trace, localised, called, _ground(options, trace)))
    file = options.output or str(Path(tempfile.mkdtemp(prefix="ssh-abduction-")) / "maps.html")
    page.save(file)
    print(file)
    if not options.output and options.open:
        webbrowser.open(Path(file).absolute().as_uri())
    return 0


def _ground(options: argparse.Namespace, trace: Trace | None) -> Ground | None:
    """Read the walls and the report from the page that `map` wrote beside the maps, if any."""
    from ssh_abduction.page.html import ground_in

    beside_maps = Path(options.maps).parent / "page.html"
    return None if trace is None or options.maps == "-" else ground_in(beside_maps, len(trace))


def _check(options: argparse.Namespace, trace: Trace | None) -> None:
    """Raise AbductionError if the options contradict each other."""
    if options.serve and trace is None:
        raise AbductionError(
            "--serve: expected the trace that was mapped, got none; give it after the maps"
        )
    if options.output:
        shared.check_ending(options.output, ".html", ".htm")
    if options.serve and options.output:
        raise AbductionError(
            "--output: expected none with --serve, which writes no file; leave out one of the two"
        )
    if not 0 <= options.port <= 65535:
        raise AbductionError(f"port: expected 0 to 65535, got {options.port}; name a free port")


def _run(options: argparse.Namespace, trace: Trace | None) -> Run | None:
    """Make the localised run that the options ask for; None if they ask for none."""
    if options.run is None:
        return None
    from ssh_abduction.online.localiser import Localiser
    from ssh_abduction.page.content import Run

    followed = Trace.load(options.run)
    return Run(followed, lambda ssh_map: Localiser(ssh_map, trace=trace).beliefs(followed))


def _serve(
    options: argparse.Namespace,
    listing: Listing,
    trace: Trace,
    theory: Theory | None,
    localised: Run | None,
    called: Called,
) -> int:

    from ssh_abduction.page.server import PageServer

    server = PageServer(
        listing,
        trace,
        theory,
        run=localised,
        called=called,
        port=options.port,
        time_limit=options.time_limit,
        ground=_ground(options, trace),
        correct=None if options.maps == "-" else partial(correct_pair, options.maps),
        frame=None if options.maps == "-" else partial(write_frame, options.maps),
    )
    with server:
        print(server.url, flush=True)
        if options.open:
            webbrowser.open(server.url)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            if program.heard[-1:] != [signal.SIGTERM]:
                program.raised.clear()  # Ctrl-C is the normal way to end the server
        finally:
            end_all()
    return 0
