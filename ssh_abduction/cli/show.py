"""ssh-abduction show MAPS: print maps as text."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

from ssh_abduction.cli.options import add_maps, check_number
from ssh_abduction.cli.parsing import Verbs
from ssh_abduction.cli.text import describe
from ssh_abduction.data.corrections import named_beside
from ssh_abduction.data.map_file import read_json
from ssh_abduction.data.map_parts import described
from ssh_abduction.data.maps import SSHMap, maps_of
from ssh_abduction.data.schema import FieldReader
from ssh_abduction.solver import drives_in


def add_parser(verbs: Verbs) -> None:
    parser = verbs.add(
        "show",
        run,
        "print the dstates, places, paths and links of maps",
        "Print the dstates, places, paths, links and regions of maps.",
    )
    add_maps(parser)
    parser.add("--map I", "show only the map with this number, from 1 (default: all)", type=int)


def run(options: argparse.Namespace) -> int:
    data, where = read_json(options.maps), str(options.maps)
    maps = named_maps(maps_of(data, where), data, where)
    check_number(options.map, maps, options.maps)
    if not maps:
        print("no map")
        return 0
    if options.map:
        print(_with_regions(maps[options.map - 1]))
    else:
        print("\n\n".join(f"map {i + 1}\n{_with_regions(m)}" for i, m in enumerate(maps)))
    return 0


def _with_regions(ssh_map: SSHMap) -> str:
    """Describe a map and its regions: sets of places beside paths, or behind one place."""
    regions = [f"  {described(region, ssh_map.called)}" for region in ssh_map.regions or ()]
    return "\n".join([describe(ssh_map), *regions])


def named_maps(found: Sequence[SSHMap], data: Any, file: str) -> tuple[SSHMap, ...]:
    """Return the maps found in a file, with the names of corrections.yaml. Raises MapError."""
    steps = len(found[0].dstate_at) if found else 0
    drives = drives_in(FieldReader(file), data, steps) if found else ()
    return named_beside(found, drives, file)
