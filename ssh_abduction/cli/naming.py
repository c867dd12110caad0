"""ssh-abduction name MAPS WHAT NAME: name a place, path or region of an existing map."""

from __future__ import annotations

import argparse

from ssh_abduction.cli.options import add_map, add_maps
from ssh_abduction.cli.parsing import Verbs
from ssh_abduction.cli.saved_map import SavedMap
from ssh_abduction.data.errors import named, printable


def add_parser(verbs: Verbs) -> None:
    parser = verbs.add(
        "name",
        run,
        "name a place, path or region",
        "Name a place, a path or a region of a map. The name is written to corrections.yaml beside "
        "the map, for a step at this place. Solving again may renumber the places, but the name "
        "stays with the place of that step.",
    )
    add_maps(parser)
    parser.add(
        "what",
        "a place such as p4, a path such as path2, a region such as region3, or its name so far; "
        "or a step such as monday:12, for its place",
    )
    parser.add("name", 'the name, such as "kitchen"; write -- before a name that begins with -')
    add_map(parser)


def run(options: argparse.Namespace) -> int:
    saved = SavedMap.load(options.maps, options.map)
    kind, step = saved.thing_to_name(options.what)
    file = saved.save(saved.corrections.with_name(options.name, kind, step))
    print(printable(f"the {kind} of {step} is {options.name.strip()!r}, in {named(file)}"))
    return 0
