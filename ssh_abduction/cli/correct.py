"""ssh-abduction correct MAPS: say what is wrong in an existing map."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path

from ssh_abduction.cli.obeyed_corrections import clash_alone, misreading, seen_at
from ssh_abduction.cli.options import add_map, add_maps, at_comma, trace_beside
from ssh_abduction.cli.outcome import warn
from ssh_abduction.cli.parsing import Verbs
from ssh_abduction.cli.saved_map import SavedMap, sentences_of
from ssh_abduction.data.corrections import ASSERTIONS, Corrections, Said
from ssh_abduction.data.errors import MapError, brief, named, printable
from ssh_abduction.data.words import counted
from ssh_abduction.theory.theory import Theory

HELPS = {
    "same": "steps I and J, such as monday:12,tuesday:3, are one dstate",
    "different": "steps I and J are different dstates",
    "elsewhere": (
        "steps I and J are at different places; I and J may also be places, such as p4 or kitchen"
    ),
    "same_place": "steps I and J are at one place; I and J may also be places, as with --elsewhere",
    "open": (
        "a gateway is open: a place and a direction on the drawn map, such as 'kitchen north', or "
        "a step and a direction from the robot, such as 'monday:12 left'"
    ),
    "closed": "a gateway, named as with --open, is closed",
}


def add_parser(verbs: Verbs) -> None:
    parser = verbs.add(
        "correct",
        run,
        "say what is wrong in a map",
        "Correct a map. The corrections are saved in corrections.yaml beside the map. solve obeys "
        "them if it writes into that folder (solve --output) or is given the file "
        "(solve --corrections).",
        "Each option may be given several times. Without any, print the corrections so far.",
    )
    add_maps(parser)
    for name, words in HELPS.items():
        metavar = "I,J" if name in ASSERTIONS else "GATEWAY"
        parser.add(f"--{name.replace('_', '-')}", words, action=_InOrder, metavar=metavar)
    said = "name or rename a place, path or region (p4, path2, kitchen), or the place of a step"
    parser.add("--name", said, action=_InOrder, nargs=2, metavar=("WHAT", "NAME"))
    parser.set_defaults(said=())
    add_map(parser)


class _InOrder(argparse.Action):
    """Appends an option and its value to `said`. So a later option can replace an earlier one."""

    def __call__(
        self,
        _parser: argparse.ArgumentParser,
        options: argparse.Namespace,
        value: object,
        _option: str | None = None,
    ) -> None:
        options.said = (*options.said, (self.dest, value))


def run(options: argparse.Namespace) -> int:
    saved = SavedMap.load(options.maps, options.map)
    before = said = saved.corrections
    for kind, value in options.said:
        if kind in ASSERTIONS:
            said = said.with_pair(kind, *_pair(saved, kind, value))
        elif kind == "name":
            what, name = value
            said = said.with_name(name, *saved.thing_to_name(what))
            saved = saved.named(said)
        else:
            said = said.with_gateway(kind == "open", saved.gateway(value))
    if said == before and options.said:
        print("nothing changed: this was said before")
        return 0
    if said == before:
        print("\n".join(map(printable, sentences_of(said))) or "nothing was said")
        return 0
    file = saved.save(said)
    warn(_unlike(saved, said, [pair for pair in said.pairs if pair not in before.pairs]))
    if saved.theory.get("star") == "none" and {"open", "closed"} & {
        kind for kind, _ in options.said
    }:
        without = "this map was made without stars, so a gateway that is open or closed changes no"
        warn([f"{without} map; to use stars, set star=auto when you map or solve again"])
    sentences = counted(sum(1 for _ in sentences_of(said)), "corrections")
    print(printable(f"{named(file)}: {sentences}; {_how_to_obey(saved.file)}"))
    return 0


def _how_to_obey(maps: Path) -> str:
    """Write the command that solves again and obeys the corrections beside a file of maps."""
    if trace_beside(str(maps)) is None:
        return f"solve again with -o {shlex.quote(str(maps))}"
    folder = shlex.quote(str(maps.parent))
    return f"to obey: ssh-abduction solve --theory {folder} {folder} -o {shlex.quote(str(maps))}"


def _unlike(saved: SavedMap, corrections: Corrections, new: Sequence[Said]) -> Iterator[str]:
    """Yield a warning for each two steps that are newly said to be one, but do not look alike."""
    if saved.trace is None or not (new and saved.theory):
        return
    trace, theory = corrections.corrected(saved.trace), Theory.from_dict(saved.theory)
    for said in new:
        if not clash_alone(said, trace, theory.without_faults()):
            continue
        opposite = "different" if said.kind == "same" else "elsewhere"
        back = f"if they are not one, say --{opposite} {shlex.quote(','.join(said.steps))}"
        follows = f"so each map will treat one of them as misread (misread={theory.misread:g})"
        if clash_alone(said, trace, theory):
            lenient = misreading(theory)
            follows = "so there will be no map"
            if lenient is not None and not clash_alone(said, trace, lenient):
                follows += " unless one of them may be misread: solve with --set misread=4"
        yield f"{said}: the steps do not look alike{seen_at(said, trace)}, {follows}; {back}"


def _pair(saved: SavedMap, kind: str, pair: str) -> tuple[str, str]:
    """Read a pair of steps, such as "monday:12,tuesday:3", or raise MapError.

    Sentences about places also take places, such as "kitchen,p7".
    """
    about_places = kind in ("elsewhere", "same_place")
    flag = f"--{kind.replace('_', '-')}"
    try:
        steps = at_comma(pair, saved.step_at_place if about_places else saved.step)
    except MapError as error:
        hint = "" if about_places else "; places are for --elsewhere and --same-place"
        raise MapError(f"{flag}: {error}{hint}") from None
    if len(steps) != 2 or steps[0] == steps[1]:
        places, others = "places, such as kitchen,p7", "steps, such as monday:12,tuesday:3"
        what = places if about_places else others
        raise MapError(f"{flag}: expected two different {what}, got {brief(pair)}; name two")
    return steps[0], steps[1]
