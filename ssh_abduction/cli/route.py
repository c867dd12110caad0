"""ssh-abduction route MAPS --from A --to B: the shortest route through a map."""

from __future__ import annotations

import argparse
from collections.abc import Collection
from typing import Any

from ssh_abduction.cli.options import add_map, add_maps
from ssh_abduction.cli.parsing import Verbs
from ssh_abduction.cli.text import table
from ssh_abduction.data.errors import MapError, printable, said_of
from ssh_abduction.data.files import json_line


def add_parser(verbs: Verbs) -> None:
    parser = verbs.add(
        "route",
        run,
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


def run(options: argparse.Namespace) -> int:
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
