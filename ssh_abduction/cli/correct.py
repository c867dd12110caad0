"""ssh-abduction correct and name: say what is wrong in a map, and name its places.

Searches obey these corrections, and report how they did.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import os
import re
import shlex
import sys
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from operator import methodcaller
from pathlib import Path
from typing import Any

from ssh_abduction.cli import shared
from ssh_abduction.cli.outcome import keep_folder_whole, warn
from ssh_abduction.cli.parsing import maps_path, verb
from ssh_abduction.data.corrections import (
    ASSERTIONS,
    FILE,
    Corrections,
    Naming,
    Passage,
    Said,
    beside,
    direction,
    load_corrections,
    save_corrections,
)
from ssh_abduction.data.drives import (
    Drive,
    drives_of,
    fingerprints_of,
    step_name,
    step_of,
    together,
    typed_step,
)
from ssh_abduction.data.errors import MapError, TheoryError, TraceError, brief, named, printable
from ssh_abduction.data.groups import firsts
from ssh_abduction.data.map_parts import (
    NAMED,
    check_says_what,
    named_by_number,
    region_of,
    thing_named,
)
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.parts_of_dstates import number_at
from ssh_abduction.data.trace import Trace
from ssh_abduction.data.words import counted, meant
from ssh_abduction.explain.no_map import Explanation, explain
from ssh_abduction.rivals.listing import Listing
from ssh_abduction.solution import Solution, Status, obeyed, with_correction_warnings, with_names
from ssh_abduction.theory.theory import Theory


def corrections_of(options: argparse.Namespace) -> Corrections | None:
    """Read the corrections of --corrections, or beside the output or the maps of --onto, if any."""
    file = options.corrections or beside(options.output) or beside(options.onto)
    return None if file is None else load_corrections(file)


def as_corrected(
    trace: Trace, theory: Theory, maps: str | None, given: str | None = None
) -> tuple[Trace, Theory]:
    """Apply the corrections beside a file of maps to a trace and a theory, and return both.

    `given` is a file of corrections that the user names instead. The number of corrections obeyed
    is printed on stderr. If the file beside the maps is of other drives, it is ignored with a
    warning. Raises MapError if the file is malformed or contradicts the trace, or if `given` is of
    other drives.
    """
    file = given or beside(maps)
    said = Corrections() if file is None else load_corrections(file)
    if not said.pairs and not said.gateways:
        return trace, theory
    if given is None:
        try:
            said.check_drives(dict(fingerprints_of(trace)))
        except MapError as error:
            warn([f"{error}; it is not obeyed"])
            return trace, theory
    corrected = obeyed(said, trace, theory)
    say_obeyed(said, trace)
    return corrected


def say_obeyed(said: Corrections, trace: Trace) -> None:
    """Print on stderr how many corrections are about drives of this trace."""
    here = len([*sentences_of(said.known_in(drives_of(trace)))])
    more = len([*sentences_of(said)]) - here
    aside = f"; {more} more {'is' if more == 1 else 'are'} about other drives" if more else ""
    text = f"obeying {counted(here, 'corrections')} of {named(said.source)}{aside}"
    print(printable(text), file=sys.stderr)


def keep_corrections(said: Corrections | None, output: str | None) -> None:
    """Write the corrections that were obeyed beside a new file of maps, if it has none yet."""
    if said is not None and output is not None and output != "-" and beside(output) is None:
        copy = Path(output).parent / FILE
        save_corrections(said, copy)
        print(printable(f"copied {named(said.source)} to {named(copy)}"), file=sys.stderr)


@dataclass(frozen=True)
class Obeying:
    """The corrections that a search obeys."""

    corrections: Corrections
    trace: Trace  # the trace, with its stars corrected
    theory: Theory  # the theory, with the pairs of steps that a person asserts
    as_seen: Trace  # the trace as it was recorded
    without: Theory  # the theory without these pairs

    @classmethod
    def of(cls, options: argparse.Namespace, trace: Trace, theory: Theory) -> Obeying:
        """Read the corrections of --corrections, or those beside the output. Raises MapError."""
        said = corrections_of(options)
        if said is None:
            return cls(Corrections(), trace, theory, trace, theory)
        corrected = cls(said, *obeyed(said, trace, theory), trace, theory)
        say_obeyed(said, trace)
        return corrected

    def named(self, ssh_map: SSHMap) -> SSHMap:
        """Return a map with the names that a person gave."""
        return self.corrections.named(ssh_map, drives_of(self.trace))

    def with_names(self, solution: Solution) -> Solution:
        """Return a solution whose maps have the names that a person gave."""
        return with_names(self.corrections, solution, self.trace)

    def finished(self, solution: Solution) -> Solution:
        """Add names, and warn of drives that contradict a corrected gateway."""
        return with_correction_warnings(self.corrections, self.with_names(solution))

    def blamed(self, solution: Solution, explanation: Explanation | None) -> list[str]:
        """List the corrections that may be the reason why the trace has no map.

        Each correction is dropped in turn. If the steps of the explanation still have no map, this
        correction is not to blame, and it is not listed. Without an explanation, all are listed.
        """
        if solution.status is not Status.UNSATISFIABLE or not self.corrections:
            return []
        said, source = self._said, named(self.corrections.source or "corrections")
        sentences: list[Said | Passage] = [*said.pairs, *said.gateways]
        if explanation is None:
            return [f"{source}: {one}: perhaps it contradicts the trace" for one in sentences]
        wrong = self._clashing(sentences, explanation)
        others = ", or another correction that is named here" if len(wrong) > 1 else ""
        return [
            f"{source}: {sentence}: it contradicts the trace{seen_at(sentence, self.trace)}{others}"
            for sentence in wrong
        ]

    def how_to_mend(self, blamed: Sequence[str], explanation: Explanation | None) -> Iterator[str]:
        """Yield a line that says how to mend the corrections of `blamed`, if there are any."""
        if not blamed:
            return
        helps = False
        if explanation and (lenient := misreading(self.without)):
            helps = not self._has_no_map(self._said, explanation, lenient)
        them = "this correction" if len(blamed) == 1 else "one of these corrections"
        also = ", or let views and stars be misread: solve with --set misread=4" if helps else ""
        yield f"say the opposite of {them} (ssh-abduction correct), or delete it{also}"

    @property
    def _said(self) -> Corrections:
        """The corrections about drives of this trace."""
        return self.corrections.known_in(drives_of(self.trace))

    def _clashing(
        self, sentences: Sequence[Said | Passage], explanation: Explanation
    ) -> list[Said | Passage]:
        """The corrections without which the steps of an explanation would have a map."""
        kept = self._said
        if self._has_no_map(replace(kept, pairs=(), gateways=()), explanation):
            return []
        # Drop corrections one by one, as long as there is still no map. Those left clash.
        for sentence in sentences:
            fewer = kept.without(sentence)
            kept = fewer if self._has_no_map(fewer, explanation) else kept
        return [one for one in sentences if one in kept.pairs or one in kept.gateways]

    def _has_no_map(
        self, said: Corrections, explanation: Explanation, without: Theory | None = None
    ) -> bool:
        """Whether the steps of an explanation have no map that obeys these corrections."""
        trace, theory = obeyed(said, self.as_seen, without or self.without)
        first, end = explanation.first, explanation.last + 1
        # In these steps, every view may be unknown.
        part = theory.of_steps(first, end - first).replace(unknown_views=None in trace.views)
        return explain(trace[first:end], part) is not None


def misreading(theory: Theory) -> Theory | None:
    """Return the theory with misread views and stars; None if it allows or cannot allow them."""
    with contextlib.suppress(TheoryError):
        return None if theory.misread else theory.replace(misread=4)
    return None


def clash_alone(said: Said, trace: Trace, theory: Theory) -> bool:
    """Whether two steps that are said to be one dstate or place cannot be so by themselves."""
    if not said.kind.startswith("same"):
        return False
    drives = drives_of(trace)
    steps = sorted(step_of(drives, step) for step in said.steps)
    alone = [trace[t : t + 1].without_displacements() for t in steps]
    nothing: dict[str, Any] = dict.fromkeys(ASSERTIONS, ())
    theory = theory.replace(displacement="none", weigh="auto", **{**nothing, said.kind: ((0, 1),)})
    with warnings.catch_warnings():  # of drives that are equal, or have nothing in common
        warnings.simplefilter("ignore")
        return explain(together(alone, ["first", "second"]), theory) is not None


def seen_at(said: Said | Passage, trace: Trace) -> str:
    """Say what the robot saw at two steps that are said to be one dstate, if this differs."""
    if isinstance(said, Passage) or not said.kind.startswith("same"):
        return ""
    drives = drives_of(trace)
    first, second = (trace.steps[step_of(drives, step)] for step in said.steps)
    if said.kind == "same" and first.view != second.view:
        seen = ("no view" if step.view is None else step.view for step in (first, second))
        return f" ({', '.join(f'{s} shows {v}' for s, v in zip(said.steps, seen, strict=True))})"
    return " (their stars differ)" if first.star != second.star else ""


def sentences_of(corrections: Corrections) -> Iterator[str]:
    """Put corrections into words: yield one sentence for each."""
    yield from map(str, (*corrections.names, *corrections.pairs, *corrections.gateways))


class _InOrder(argparse.Action):
    """Appends an option and its value to `said`, so that errors are about the later option."""

    def __call__(
        self,
        _parser: argparse.ArgumentParser,
        options: argparse.Namespace,
        value: object,
        _option: str | None = None,
    ) -> None:
        options.said = (*getattr(options, "said", ()), (self.dest, value))


@verb(
    {
        name: {"action": _InOrder}
        for name in ("--same", "--different", "--elsewhere", "--same-place", "--open", "--closed")
    }
)
def run_correct(options: argparse.Namespace) -> int:
    """Say what is wrong in a map.

    The corrections are saved in corrections.yaml beside the map. solve obeys them if it writes into
    that folder (solve --output) or is given the file (solve --corrections).

    Each option may be given several times. Without any, print the corrections so far.
    """
    saved = SavedMap.load(options.maps, options.map)
    given = getattr(options, "said", ())
    before = said = saved.corrections
    now = replace(before, names=(), pairs=(), gateways=())  # what this call says
    for kind, value in given:
        if kind in ASSERTIONS:
            say = methodcaller("with_pair", kind, *_pair(saved, kind, value))
        else:
            say = methodcaller("with_gateway", kind == "open", saved.gateway(value))
        said, after = say(said), say(now)
        for earlier in (*now.pairs, *now.gateways):
            if earlier not in (*after.pairs, *after.gateways):
                flag = f"--{kind.replace('_', '-')} {shlex.quote(value)}"
                raise MapError(f"{flag}: this call also says {earlier}; say only one of them")
        now = after
    if said == before and given:
        print("nothing changed: this was said before")
        return 0
    if said == before:
        told: tuple[Naming | Said | Passage, ...] = (*said.names, *said.pairs, *said.gateways)
        print("\n".join(printable(saved.in_words(one)) for one in told) or "nothing was said")
        return 0
    file = saved.save(said)
    keep_folder_whole(saved.file, "corrections")
    every: tuple[Said | Passage, ...] = (*said.pairs, *said.gateways)
    for one in every:
        if one not in (*before.pairs, *before.gateways):
            print(printable(saved.in_words(one)))
    warn(_unlike(saved, said, [pair for pair in said.pairs if pair not in before.pairs]))
    about_gateways = any(kind in ("open", "closed") for kind, _ in given)
    if about_gateways and saved.theory is not None and saved.theory.star == "none":
        without = "this map was made without stars, so a gateway that is open or closed changes no"
        warn([f"{without} map; to use stars, set star=auto when you map or solve again"])
    sentences = counted(sum(1 for _ in sentences_of(said)), "corrections")
    print(printable(f"{named(file)}: {sentences}; {_how_to_obey(saved.file)}"))
    return 0


def correct_pair(maps: str, kind: str, first: int, second: int) -> str:
    """Write what a person says of two steps beside a file of maps, and return it as a sentence."""
    saved = SavedMap.load(maps)
    steps = [step_name(saved.drives, step) for step in (first, second)]
    said = saved.corrections.with_pair(kind, *steps)
    file = saved.save(said)
    keep_folder_whole(saved.file, "corrections")
    told = saved.in_words(Said(kind, (steps[0], steps[1])))
    return f"{told}\nwritten to {named(file)}; {_how_to_obey(saved.file)}"


def _how_to_obey(maps: Path) -> str:
    """Write the command that solves again and obeys the corrections beside a file of maps."""
    if shared.trace_beside(str(maps)) is None:
        return f"solve again with -o {shlex.quote(str(maps))}"
    folder = shlex.quote(str(maps.parent))
    return f"to obey: ssh-abduction solve --theory {folder} {folder} -o {shlex.quote(str(maps))}"


def _unlike(saved: SavedMap, corrections: Corrections, new: Sequence[Said]) -> Iterator[str]:
    """Yield a warning for each two steps that are newly said to be one, but do not look alike."""
    if saved.trace is None or not new or saved.theory is None:
        return
    trace, theory = corrections.corrected(saved.trace), saved.theory
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
        steps = shared.at_comma(pair, saved.step_at_place if about_places else saved.step)
    except MapError as error:
        hint = "" if about_places else "; places are for --elsewhere and --same-place"
        raise MapError(f"{flag}: {error}{hint}") from None
    if len(steps) != 2 or steps[0] == steps[1]:
        places, others = "places, such as kitchen,p7", "steps, such as monday:12,tuesday:3"
        what = places if about_places else others
        raise MapError(f"{flag}: expected two different {what}, got {brief(pair)}; name two")
    return steps[0], steps[1]


@verb()
def run_name(options: argparse.Namespace) -> int:
    """Name a place, path, region, corridor, room or door.

    The name is written to corrections.yaml beside the map, for a step at this place. Solving again
    may renumber the places, but the name stays with the place of that step.
    """
    saved = SavedMap.load(options.maps, options.map).built()
    print(give_name(saved, options.what, options.name))
    return 0


def give_name(saved: SavedMap, what: str, name: str) -> str:
    """Name a thing in the corrections beside its map. Returns a sentence. Raises MapError."""
    kind, step = saved.thing_to_name(what)
    file = saved.save(saved.corrections.with_name(name, kind, step))
    keep_folder_whole(saved.file, "names")
    number = saved.number_at(kind, step)
    where = "" if number is None else f"{named_by_number(kind, number)}, "
    seen = typed_step(saved.drives, step_of(saved.drives, step))
    return printable(f"{where}the {kind} of {seen}, is {name.strip()!r}, in {named(file)}")


# Directions on the map as it is drawn, in degrees counterclockwise from east.
_WINDS = ("east", "northeast", "north", "northwest", "west", "southwest", "south", "southeast")
COMPASS = {name: 45.0 * k for k, name in enumerate(_WINDS)}


@dataclass(frozen=True)
class SavedMap:
    """A map and the drives that it was made of."""

    map: SSHMap
    drives: tuple[Drive, ...]
    file: Path  # the file of maps
    corrections: Corrections  # what a person said about it
    theory: Theory | None  # the theory of the map; None if the file does not say

    @classmethod
    def load(cls, path: str | os.PathLike[str], number: int | str = 1) -> SavedMap:
        """Read a map, by its number from 1 or its id, and the corrections beside it.

        Raises MapError if a file cannot be read, the maps do not name their drives, or the
        corrections are of another map.
        """
        file = Path(maps_path(str(path)))
        data = shared.read_maps(str(file), "give a file that solve -o wrote")
        listing = Listing.from_dict(data, named(file))
        known = {drive.name: drive.fingerprint for drive in listing.drives}
        if not known or None in known.values():
            raise MapError(
                f"{named(file)}: drives: expected the drives that were mapped, each with its "
                "fingerprint, got none; solve again, with -o"
            )
        ssh_map = listing.maps[listing.number(str(number))]
        if (own := beside(file)) is not None:
            said = load_corrections(own)
            said.check_drives(known)
        else:  # keep the names that the map has
            said = Corrections.of_names(ssh_map, listing.drives)
        drives = {**said.drives, **{name: str(mark) for name, mark in known.items()}}
        corrections = replace(said, drives=drives)
        found = cls(ssh_map, listing.drives, file, corrections, shared.written_theory(data))
        return found.named(found.corrections)

    def named(self, said: Corrections) -> SavedMap:
        """Return the same map with these corrections, and with their names."""
        return replace(self, map=said.named(self.map, self.drives), corrections=said)

    @cached_property
    def trace(self) -> Trace | None:
        """The trace of the map; None if it is not beside the map, nor in its file."""
        return shared.mapped_trace(str(self.file))

    def built(self) -> SavedMap:
        """Return the same map with paths, corridors, doors and rooms, derived if it has none."""
        if self.map.building is not None or self.trace is None:
            return self
        from ssh_abduction.building.derive import with_building  # loads numpy

        built = replace(self, map=with_building(self.map, self.trace))
        return built.named(self.corrections)

    @property
    def in_quarters(self) -> bool:
        """Whether stars have four directions."""
        return self.theory is not None and self.theory.star == "frame"

    def save(self, corrections: Corrections) -> Path:
        """Write the corrections beside the map, after a check. Returns their file.

        Raises MapError if a gateway contradicts the trace, or a drive or a step is unknown.
        """
        corrections.known_in(self.drives)
        if self.trace is not None:
            corrections.corrected(self.trace)
        file = self.file.parent / FILE
        save_corrections(corrections, file)
        return file

    def in_words(self, said: Naming | Said | Passage) -> str:
        """Put a correction into words, with the place of each step that is in this map."""

        def with_place(step: re.Match[str]) -> str:
            place = self.number_at("place", step[0])
            typed = typed_step(self.drives, step_of(self.drives, step[0]))
            return typed if place is None else f"{typed} [{self.map.called('place', place)}]"

        names = sorted((re.escape(drive.name) for drive in self.drives), key=len, reverse=True)
        return re.sub(rf"(?:{'|'.join(names)}):\d+", with_place, str(said))

    def thing(self, text: str) -> tuple[str, str]:
        """Find what a person names: return its kind, and a step there. Raises MapError.

        The text is a place, path or region by its number, such as "p4" or "path 2", or by its name,
        such as "kitchen"; or a step such as "monday:12", for the place where the robot was.
        """
        if found := self.numbered_or_named(text):
            return found
        try:
            return "place", self.step(text)
        except MapError as error:
            names = self.given | {f"{kind}{n}" for kind in NAMED for n in re.findall(r"\d+$", text)}
            near, said = meant(text, names, 3), f"name: expected one of this map, got {brief(text)}"
            if not near:
                said, near = str(error), "; or a place, corridor, room or door, such as room4"
            hint = "; a wing has no name: name its corridor" * ("wing" in text)
            hint += "; a junction has no name: name one of its places" * ("junction" in text)
            raise MapError(f"{said}; ssh-abduction show lists all{near}{hint}") from None

    @property
    def given(self) -> set[str]:
        """All names that a person gave."""
        return {name.text for name in self.map.names} | {naming.name for naming in self._names}

    @property
    def _names(self) -> tuple[Naming, ...]:
        """The names that a person gave in the drives of this map."""
        return self.corrections.known_in(self.drives).names

    def numbered_or_named(self, text: str) -> tuple[str, str] | None:
        """Find a place, path or region by its number or name, as `thing`; None for a step."""
        # A place may have two names, each of a step. So return the step of this name.
        for naming in self._names:
            if naming.name == text:
                return naming.kind, naming.step
        check_says_what(text, self.drives[0].name)
        kind, number = thing_named(text, self.map.names) or ("", -1)
        if kind == "dstate" and number in self.map.dstate_at:
            return "place", step_name(self.drives, self.map.dstate_at.index(number))
        if kind not in (*NAMED, "dstate"):
            return None
        at = self.map.dstate_at
        for label, t in firsts(zip(at, range(len(at)), strict=True)).items():
            if number_at(self.map, kind, label) == number:
                return kind, step_name(self.drives, t)
        region = next((r for r in self.map.regions or () if r.id == number), None)
        if kind == "region" and region is not None:
            others = {f"region{region_of(self.map.regions, place)}" for place in region.places}
            raise MapError(
                f"{text}: expected a region to which some step belongs, got {brief(text)}, whose "
                "places all belong to regions that are smaller or behind a door; name one of "
                f"{', '.join(sorted(others))}"
            )
        known = number in self.map.things().get(kind, ())
        why = "but no step tells it from others" if known else "but the map has none of this number"
        raise MapError(
            f"{text}: expected a {kind} of the map, got {brief(text)}, {why}; ssh-abduction show "
            "lists them"
        )

    def thing_to_name(self, text: str) -> tuple[str, str]:
        """Find what a person names, as `thing`. If it has a name, return the step of this name."""
        kind, step = self.thing(text)
        number = self.number_at(kind, step)
        there = [
            n.step for n in self._names if (n.kind, self.number_at(kind, n.step)) == (kind, number)
        ]
        return kind, step if step in there or not there else there[0]

    def step(self, text: str) -> str:
        """Return the name of a step, such as "monday:12". Raise MapError if there is none."""
        try:
            return step_name(self.drives, step_of(self.drives, text))
        except TraceError as error:
            raise MapError(str(error)) from None

    def step_at_place(self, text: str) -> str:
        """Return a step at a place, named as for `thing`. Raise MapError for anything else."""
        kind, step = self.thing(text)
        if kind != "place":
            raise MapError(
                f"expected a place or a step, got the {kind} {brief(text)}; name a place"
            )
        return step

    def gateway(self, text: str) -> tuple[tuple[str, float], ...]:
        """Return the steps at the place of a gateway, each with the gateway's direction.

        Directions are degrees clockwise from ahead. The text is a place and a direction on the
        drawn map, such as "p4 north" or "kitchen north"; or a step and a direction from the robot,
        such as "monday:12 left" or "monday:12 135". Raises MapError if the map has no such place or
        step, or no headings there.
        """
        where, _, way = text.strip().rpartition(" ")
        kind, step = self.thing(where.strip()) if where else ("", "")
        if kind != "place":
            raise MapError(
                "gateway: expected a place and a direction such as 'p4 north' or 'monday:12 left', "
                f"got {brief(text)}; write both"
            )
        if way not in COMPASS and self.numbered_or_named(where.strip()):
            raise MapError(
                f"gateway: expected {', '.join(COMPASS)} after a place, got {brief(way)}; take one "
                f"of them, or name a step, such as '{step} left'"
            )
        label = self.map.dstate_at[step_of(self.drives, step)]
        if way not in COMPASS:
            return self._seen_from(label, self._rounded(direction(way), text))
        drawn = self._drawn(self.map.dstates[label].place)
        # In a drawing that is not at right angles, start at the dstate that is drawn best.
        off = {s: (heading - COMPASS[way]) % 90 for s, heading in drawn.items()}
        best = min(off, key=lambda s: min(off[s], 90 - off[s]), default=None)
        if best is None:
            raise MapError(
                f"gateway: expected a place with known headings for {brief(text)}; say it by a "
                "step, such as 'monday:12 left'"
            )
        return self._seen_from(best, self._rounded(drawn[best] - COMPASS[way], text))

    def _seen_from(self, label: int, way: float) -> tuple[tuple[str, float], ...]:
        """List the steps at a dstate's place, each with the direction of a gateway from there.

        Directions are degrees clockwise from ahead. `way` is the direction from the dstate.
        """
        here = self.map.dstates[label]
        unit = 90 if self.in_quarters else 1
        ways = {
            s.id: (way + unit * (here.heading - s.heading)) % 360
            for s in self.map.dstates
            if s.place == here.place and s.heading is not None and here.heading is not None
        }
        drawn = self._drawn(here.place) if self.map.fit and not ways else {}
        if label in drawn:  # as in maps of logs
            ways = {s: round(way + drawn[s] - drawn[label]) % 360.0 for s in drawn}
        ways = ways or {label: way}
        steps = [(t, s) for t, s in enumerate(self.map.dstate_at) if s in ways]
        return tuple((step_name(self.drives, t), ways[s]) for t, s in steps)

    def _drawn(self, place: int | None) -> dict[int, float]:
        """The drawn headings of the dstates at a place, in degrees counterclockwise from east."""
        return {
            s.id: math.degrees(heading)
            for s in self.map.dstates
            if s.place == place
            and place is not None
            and (heading := self._layout[s.id][2]) is not None
        }

    @cached_property
    def _layout(self) -> Sequence[tuple[float, float, float | None]]:
        """The position and heading of each dstate as it is drawn."""
        from ssh_abduction.output.layout import layout  # loads scipy

        return layout(self.map).dstates

    def _rounded(self, degrees: float, text: str) -> float:
        """Round a direction to whole degrees or, if stars have four directions, to one of these."""
        if not self.in_quarters:
            return round(degrees) % 360.0
        quarter = round(degrees / 90)
        if abs(degrees - 90 * quarter) > 30:
            raise MapError(
                f"gateway: expected a direction ahead, right, back or left of the robot, got "
                f"{brief(text)}, which is between two; give a step, such as 'monday:12 left'"
            )
        return 90.0 * (quarter % 4)

    def number_at(self, kind: str, step: str) -> int | None:
        """Return the number of the place, path or region of a step; None if it has none."""
        return number_at(self.map, kind, self.map.dstate_at[step_of(self.drives, step)])
