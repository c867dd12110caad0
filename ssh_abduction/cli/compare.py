"""ssh-abduction compare MAPS [OTHER]: what rival maps share, and where they differ."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ssh_abduction.cli.options import MAPS_SAID, maps_path
from ssh_abduction.cli.parsing import Verbs
from ssh_abduction.cli.text import compared, counted, depending
from ssh_abduction.data.errors import brief, named, printable
from ssh_abduction.data.files import json_line
from ssh_abduction.data.map_file import read_json
from ssh_abduction.data.schema import attributes_of

if TYPE_CHECKING:
    from ssh_abduction.rivals.comparison import Comparison
    from ssh_abduction.rivals.differences import SharedSides
    from ssh_abduction.rivals.listing import DrivePair, Listing

# Values in run.json that differ between runs even if all settings and results are the same.
UNSTEADY = ("seconds", "limit", "ladder", "drove", "log.source")


def add_parser(verbs: Verbs) -> None:
    parser = verbs.add(
        "compare",
        run,
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


def run(options: argparse.Namespace) -> int:
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
