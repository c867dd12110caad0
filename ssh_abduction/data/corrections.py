"""Names and corrections: what a person says about the drives of a map.

They are in a file `corrections.yaml` beside the map. Each sentence names steps, not places: a
place is "where the robot was at step 12 of Monday", written `monday:12`. So a sentence keeps its
meaning when the map is solved again, and when drives are added.

>>> from ssh_abduction import Trace
>>> monday = Trace.from_steps("aba", ["travel", "around"], name="monday")
>>> said = Corrections.for_drives(monday).with_name("kitchen", "place", "monday:1")
>>> [str(naming) for naming in said.names]
["name 'kitchen' of the place of monday:1"]

`load_corrections` and `save_corrections` read and write the file, in YAML. See
docs/reference/formats.md.
"""

from __future__ import annotations

import json
import math
import os
import warnings
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

from ssh_abduction.data import checks, groups
from ssh_abduction.data.drives import Drive, drives_of, fingerprints_of, step_name, step_of
from ssh_abduction.data.errors import MapError, TraceError, brief, is_writable, named, said_of
from ssh_abduction.data.files import json_line, parse_yaml, read_file, save_file
from ssh_abduction.data.map_parts import NAMED, Name, thing_named
from ssh_abduction.data.maps import SSHMap, checked_map
from ssh_abduction.data.parts_of_dstates import number_at
from ssh_abduction.data.schema import FieldReader, only_known
from ssh_abduction.data.star import near_quarter, star_to_json, with_gateway
from ssh_abduction.data.step import SEEN
from ssh_abduction.data.trace import Trace, checked_trace

FORMAT, VERSION = "ssh-corrections", 1
# What a person says of two steps, by kind. The kinds are fields of a theory.
ASSERTED = {
    "same": "are one dstate",
    "different": "are different dstates",
    "elsewhere": "are at different places",
    "same_place": "are at one place",
}
ASSERTIONS = tuple(ASSERTED)
# The kinds that contradict a kind if they are said of the same steps.
_AGAINST = {
    "same": ("different", "elsewhere"),
    "different": ("same",),
    "elsewhere": ("same", "same_place"),
    "same_place": ("elsewhere",),
}
# The directions of gateways by name, in degrees clockwise from ahead.
DIRECTIONS = {"ahead": 0.0, "right": 90.0, "back": 180.0, "left": 270.0}


@dataclass(frozen=True, slots=True)
class Naming:
    """A name for the place, path, region, corridor, room or door of a step.

    Attributes:
        name: The name.
        kind: "place", "path", "region", "corridor", "room" or "door".
        step: The step, such as "monday:12".
        note: A remark of the person; it has no effect.
    """

    name: str
    kind: str
    step: str
    note: str | None = None

    def __post_init__(self) -> None:
        checks.one_of("kind", self.kind, NAMED, MapError)
        object.__setattr__(self, "name", _a_line("name", self.name).strip())
        object.__setattr__(self, "step", _a_step(self.step))
        _a_note(self.note)

    def __str__(self) -> str:
        return f"name {brief(self.name)} of the {self.kind} of {self.step}"


@dataclass(frozen=True, slots=True)
class Said:
    """Two steps that a person says are one dstate or at one place, or are different ones.

    Attributes:
        kind: "same" (one dstate), "different" (two dstates), "elsewhere" (two places) or
            "same_place".
        steps: The two steps, such as ("monday:12", "tuesday:3").
        note: A remark of the person; it has no effect.
    """

    kind: str
    steps: tuple[str, str]
    note: str | None = None

    def __post_init__(self) -> None:
        checks.one_of("kind", self.kind, ASSERTIONS, MapError)
        if not isinstance(self.steps, tuple | list) or len(self.steps) != 2:
            raise MapError(
                f"expected two steps, such as [monday:12, tuesday:3], got {brief(self.steps)}; "
                "name two"
            )
        object.__setattr__(self, "steps", tuple(map(_a_step, self.steps)))
        if self.steps[0] == self.steps[1]:
            raise MapError(f"expected two different steps, got {self.steps[0]} twice; name another")
        _a_note(self.note)

    def __str__(self) -> str:
        return f"{self.kind}: {self.steps[0]}, {self.steps[1]}"


@dataclass(frozen=True, slots=True)
class Passage:
    """A gateway that a person says is open or closed.

    Attributes:
        is_open: Whether it is open.
        seen: For each step at which the robot faced it: the step, and the direction of the
            gateway in degrees clockwise from ahead.
        note: A remark of the person; it has no effect.
    """

    is_open: bool
    seen: tuple[tuple[str, float], ...]
    note: str | None = None

    def __post_init__(self) -> None:
        checks.a_flag("is_open", self.is_open, MapError)
        ways = []
        for i, at in enumerate(checks.a_list("seen", self.seen, MapError)):
            if not isinstance(at, tuple) or len(at) != 2:
                raise MapError(
                    f"seen[{i}]: expected a step and degrees, such as ('monday:12', 90.0), got "
                    f"{brief(at)}; give both"
                )
            ways.append((_a_step(at[0]), checks.a_number(f"seen[{i}]", at[1], MapError) % 360))
        object.__setattr__(self, "seen", tuple(ways))
        _a_note(self.note)

    def __str__(self) -> str:
        sights = ", ".join(f"{direction_in_words(way)} at {step}" for step, way in self.seen)
        return f"{'open' if self.is_open else 'closed'}: {sights}"


@dataclass(frozen=True)
class Corrections:
    """Names and corrections of a person, with the drives that they are about.

    They are immutable. `solve` finds only maps that agree with them.

    Attributes:
        drives: The fingerprint of each drive, by its name.
        names: The names.
        pairs: Pairs of steps that are said to be at one place or dstate, or not to be.
        gateways: Gateways that the person says are open or closed.
        source: The file that the corrections were read from.
    """

    drives: Mapping[str, str] = field(default_factory=dict)
    names: tuple[Naming, ...] = ()
    pairs: tuple[Said, ...] = ()
    gateways: tuple[Passage, ...] = ()
    source: str | None = field(default=None, compare=False)

    def __bool__(self) -> bool:
        """Whether anything is said."""
        return bool(self.names or self.pairs or self.gateways)

    @classmethod
    def of_names(cls, ssh_map: SSHMap, drives: Sequence[Drive]) -> Corrections:
        """Return the names of a map as corrections, each for the first step that it is about.

        A step can have only one name. So a second name of a place goes to the second step there.

        Args:
            ssh_map: The map whose places, paths and regions have names.
            drives: The drives of its trace.

        Raises:
            MapError: An argument is wrong.
        """
        checked_map(ssh_map)
        drives = _drives(drives)
        of_dstates = {
            kind: [number_at(ssh_map, kind, label) for label in range(len(ssh_map.dstates))]
            for kind in {name.kind for name in ssh_map.names}
        }
        left: dict[tuple[str, int], list[int]] = {}  # the steps that have no name yet
        found: list[Naming] = []
        for name in ssh_map.names:
            numbers = of_dstates[name.kind]
            here = [t for t, s in enumerate(ssh_map.dstate_at) if numbers[s] == name.id]
            if here := left.setdefault((name.kind, name.id), here):
                found.append(Naming(name.text, name.kind, step_name(drives, here.pop(0))))
        return cls(names=tuple(found))

    @classmethod
    def for_drives(cls, trace: Trace) -> Corrections:
        """Return empty corrections for the drives of a trace."""
        return cls(fingerprints_of(checked_trace(trace)))

    def with_name(self, name: str, kind: str, step: str) -> Corrections:
        """Name the place, path or region of a step. An earlier name for this step is replaced.

        Args:
            name: The new name.
            kind: "place", "path", "region", "corridor", "room" or "door".
            step: The step, such as "monday:12".

        Raises:
            MapError: Another place, path or region has this name, or an argument is wrong.
        """
        said = Naming(name, kind, step)
        # Keep the order: the first one of several names of a place counts.
        names = [said if (n.kind, n.step) == (kind, said.step) else n for n in self.names]
        return replace(self, names=(*names, *([] if said in names else [said])))

    def with_pair(self, kind: str, first: str, second: str) -> Corrections:
        """Say that two steps are one dstate or at one place, or that they are different ones.

        Earlier sentences about these steps that contradict this one are replaced.

        Args:
            kind: "same", "different", "elsewhere" or "same_place".
            first: A step, such as "monday:12".
            second: Another step.

        Raises:
            MapError: An argument is wrong, or sentences about other steps contradict this one.
        """
        said = Said(kind, (first, second))
        about = [other for other in self.pairs if set(other.steps) == set(said.steps)]
        new = () if any(other.kind == kind for other in about) else (said,)
        wrong = [other for other in about if other.kind in _AGAINST[kind]]
        return replace(self, pairs=(*(pair for pair in self.pairs if pair not in wrong), *new))

    def with_gateway(self, is_open: bool, seen: Iterable[tuple[str, float]]) -> Corrections:
        """Say that a gateway is open or closed. What was said about it before is replaced.

        Args:
            is_open: Whether it is open.
            seen: The steps at its place, each with the direction of the gateway in degrees
                clockwise from ahead.

        Raises:
            MapError: An argument is wrong.
        """
        passage = Passage(is_open, tuple(checks.a_list("seen", seen, MapError)))
        kept = [said for said in self.gateways if not set(said.seen) & set(passage.seen)]
        return replace(self, gateways=(*kept, passage))

    def check_drives(self, known: Mapping[str, str | None]) -> None:
        """Check that these corrections are about some of these drives.

        Args:
            known: The fingerprint of each drive, by its name; None if it is unknown.

        Raises:
            MapError: No drive is known, or a drive of a known name has other steps.
        """
        checks.an_object("known", known, MapError)
        where = self.source or "corrections"
        other = [d for d, mark in known.items() if self.drives.get(d, mark) not in (mark, None)]
        other = [d for d in other if known[d] is not None]
        if other or (self.drives and not set(self.drives) & set(known)):
            found = f"other steps of {other[0]}" if other else f"{', '.join(known)}"
            marks = {mark: name for name, mark in self.drives.items()}
            renamed = next((name for name, mark in known.items() if mark in marks), None)
            mend = (
                "the file belongs to another map: name another file, or remove this one"
                if other or renamed is None
                else f"{renamed} has the steps of {brief(marks[known[renamed] or ''])}: give the "
                "trace or its file this name again, or change it in the file of corrections"
            )
            raise MapError(
                f"{where}: drives: expected the drives that it was written for, "
                f"{', '.join(map(brief, self.drives))}, got {found}; {mend}"
            )

    def known_in(self, drives: Sequence[Drive]) -> Corrections:
        """Return these corrections without the sentences about steps of other drives.

        Raises:
            MapError: A sentence names a drive that these corrections do not list, or a step that
                its drive does not have.
        """
        drives = _drives(drives)
        names = {drive.name for drive in drives}

        def is_known(step: str) -> bool:
            drive = step.rpartition(":")[0]
            if drive in names:
                self._number(drives, step)
            elif drive not in self.drives:
                raise MapError(
                    f"{self.source or 'corrections'}: expected a step such as "
                    f"{drives[0].name}:0, of {', '.join({**self.drives, **dict.fromkeys(names)})}, "
                    f"got {brief(step)}; name the drive and the step"
                )
            return drive in names

        return replace(
            self,
            names=tuple(n for n in self.names if is_known(n.step)),
            pairs=tuple(p for p in self.pairs if all(map(is_known, p.steps))),
            gateways=tuple(
                replace(g, seen=seen)
                for g in self.gateways
                if (seen := tuple(at for at in g.seen if is_known(at[0])))
            ),
        )

    def assertions(self, trace: Trace) -> dict[str, tuple[tuple[int, int], ...]]:
        """Convert the pairs of steps to the fields of a theory that assert them.

        Pairs of other drives are left out.

        Returns:
            For each field, such as "same": the pairs, by the numbers of the steps.

        Raises:
            MapError: A sentence names a drive that neither the trace nor these corrections list,
                or a step that its drive does not have.
        """
        drives = drives_of(checked_trace(trace))
        found: dict[str, tuple[tuple[int, int], ...]] = dict.fromkeys(ASSERTIONS, ())
        for said in self.known_in(drives).pairs:
            first, second = (self._number(drives, step) for step in said.steps)
            found[said.kind] += ((first, second),)
        return found

    def corrected(self, trace: Trace) -> Trace:
        """Return a trace whose stars have the gateways that a person said are open or closed.

        A changed step keeps what the robot saw in its field `star_seen`.

        Raises:
            MapError: A sentence contradicts the trace: the robot passed a gateway that is said to
                be closed, or saw no star there.
        """
        drives = drives_of(checked_trace(trace))
        steps = list(trace.steps)
        for said in self.known_in(drives).gateways:
            for name, way in said.seen:
                t = self._number(drives, name)
                self._check_passable(trace, said, name, t, way)
                step = steps[t]
                star = step.star
                if star is None:
                    raise self._contradicted(
                        said, f"{name} has no star; record stars (gateways), or leave it out"
                    )
                changed = with_gateway(star, way, is_open=said.is_open)
                if changed != star:
                    extra = {SEEN: star_to_json(star), **step.extra}
                    steps[t] = replace(step, star=changed, extra=extra)
        return replace(trace, steps=tuple(steps))

    def named(self, ssh_map: SSHMap, drives: Sequence[Drive]) -> SSHMap:
        """Return a map with the names that a person gave.

        If two names are of one place of this map, the map has both, and shows the first one.

        Args:
            ssh_map: The map that gets the names.
            drives: The drives of its trace.
        """
        checked_map(ssh_map)
        found: list[Name] = []
        for naming in self.known_in(drives).names:
            label = ssh_map.dstate_at[self._number(drives, naming.step)]
            number = number_at(ssh_map, naming.kind, label)
            if number is not None:
                found.append(Name(naming.kind, number, naming.name))
        found.sort(key=lambda name: (name.kind, name.id))  # keeps the order of a place's names
        return replace(ssh_map, names=tuple(found))

    def without(self, sentence: Said | Passage) -> Corrections:
        """Return the same corrections without one sentence, of `pairs` or `gateways`.

        Raises:
            MapError: `sentence` is of another type.
        """
        if not isinstance(sentence, Said | Passage):
            raise MapError(
                f"sentence: expected an entry of pairs or gateways, got {brief(sentence)}; take one"
            )
        return replace(
            self,
            pairs=tuple(said for said in self.pairs if said != sentence),
            gateways=tuple(said for said in self.gateways if said != sentence),
        )

    def __post_init__(self) -> None:
        """Raise MapError if a name is a number or given twice, or if pairs are contradictory."""
        where = self.source or "corrections"
        for part, kind in (("names", Naming), ("pairs", Said), ("gateways", Passage)):
            mend = f"make it with {kind.__name__}"
            checked = checks.all_instances(part, getattr(self, part), kind, MapError, mend=mend)
            object.__setattr__(self, part, checked)
        if clash := _contradiction(self.pairs):
            raise MapError(
                f"{where}: {clash[0]}: expected what agrees with the other corrections, got a "
                f"contradiction of {' and '.join(map(str, clash[1:]))}; drop one of these, or say "
                "the opposite of it first"
            )
        first: dict[tuple[str, ...], int] = {}
        for i, naming in enumerate(self.names):
            drive, _, number = naming.name.rpartition(":")
            if thing_named(naming.name) or (drive in self.drives and number.isdecimal()):
                raise MapError(
                    f"{where}: names[{i}]: expected a name such as kitchen, got "
                    f"{brief(naming.name)}, which is how to write a dstate, step or part of a map "
                    f"by its number; give another one, such as 'room {naming.name}'"
                )
            for key, what in (
                ((naming.name,), f"another name than {brief(naming.name)}"),
                ((naming.kind, naming.step, ""), f"one name for the {naming.kind}"),
            ):
                if key in first:
                    other = self.names[first[key]]
                    raise MapError(
                        f"{where}: names[{i}]: expected {what}, as names[{first[key]}], the "
                        f"{other.kind} of {other.step}, has it, got {naming}; rename one of them"
                    )
                first[key] = i

    def _number(self, drives: Sequence[Drive], step: str) -> int:
        """Return the number of a step. Raise MapError if there is none."""
        try:
            return step_of(drives, step)
        except TraceError as error:
            raise MapError(f"{self.source or 'corrections'}: {error}") from None

    def _contradicted(self, said: object, why: str) -> MapError:
        return MapError(f"{self.source or 'corrections'}: {said}: it contradicts the trace: {why}")

    def _check_passable(self, trace: Trace, said: Passage, name: str, t: int, way: float) -> None:
        """Raise MapError if the robot passed a gateway that is said to be closed."""
        if said.is_open:
            return
        after, before = trace.steps[t].action, trace.steps[t - 1].action if t else None
        for quarter, action, what in ((0, after, "left"), (2, before, "came to")):
            if near_quarter(way) == quarter and action is not None and action.kind == "travel":
                why = f"the robot {what} {name} through it; say it is open"
                raise self._contradicted(said, why)


def _contradiction(pairs: Sequence[Said]) -> list[Said]:
    """Find two steps that are said to be apart, and sentences that join them; empty if none."""
    for kind, joins in (("different", ("same",)), ("elsewhere", ("same", "same_place"))):
        said = {frozenset(one.steps): one for one in pairs if one.kind in joins}
        joined = defaultdict[str, dict[str, None]](
            dict, groups.linked(one.steps for one in said.values())
        )
        for apart in (one for one in pairs if one.kind == kind):
            if chain := groups.way(*apart.steps, joined.__getitem__):
                return [apart, *(said[frozenset(pair)] for pair in pairwise(chain))]
    return []


def direction_in_words(way: float) -> str:
    """Say a direction: ahead, right, back, left, or degrees clockwise from ahead."""
    return {degrees: name for name, degrees in DIRECTIONS.items()}.get(way, f"{way:g}")


def _drives(value: object) -> tuple[Drive, ...]:
    """Return drives in a tuple, or raise MapError for other values."""
    mend = "take drives_of(trace), or those of a solution"
    return checks.all_instances("drives", value, Drive, MapError, mend=mend)


def checked_corrections(value: object) -> Corrections:
    """Return a value if it is Corrections, or raise MapError."""
    mend = "read them with load_corrections, or make them with Corrections.for_drives"
    return checks.an_instance("corrections", value, Corrections, MapError, mend=mend)


def _a_step(step: object) -> str:
    """Return the name of a step, such as "monday:12". Raise MapError for another text."""
    text = checks.a_text("step", step, MapError, mend="name a step, such as monday:12")
    drive, _, number = text.rpartition(":")
    if not (drive and number.isascii() and number.isdecimal() and is_writable(text)):
        raise MapError(
            f"step: expected a drive, a colon and a step, such as monday:12, got {brief(text)}; "
            "name one"
        )
    return f"{drive}:{int(number)}"


def _a_line(field: str, value: object) -> str:
    """Return a text on one line. Raise MapError for other values, or if the text is empty."""
    text = checks.a_text(field, value, MapError)
    if not text.strip() or not text.isprintable():
        raise MapError(f"{field}: expected a text on one line, got {brief(text)}; give one")
    return text


def _a_note(note: object) -> None:
    if note is not None:
        _a_line("note", note)


FILE = "corrections.yaml"  # the name of the file beside a map
CORRECTED = "Made before the last correction. Solve again to obey it."  # said on the page
LARGEST = 2**24  # bytes
HEAD = """\
# Names and corrections of a person. You can edit this file, or use `ssh-abduction name` and
# `ssh-abduction correct`, which write it anew: they keep each `note:`, but not comments like this.
"""
T = TypeVar("T")


def load_corrections(path: str | os.PathLike[str]) -> Corrections:
    """Read a file of names and corrections.

    Args:
        path: The file; or a folder, for the file `corrections.yaml` in it.

    Raises:
        MapError: The file cannot be read or is malformed. The error names the field.
    """
    file = file_in(path)
    data = read_file(file, LARGEST, "a file of corrections", MapError)
    return from_yaml(data, str(file))


def save_corrections(corrections: Corrections, path: str | os.PathLike[str]) -> None:
    """Write names and corrections into a file.

    Args:
        corrections: The names and corrections.
        path: The file; or a folder, for the file `corrections.yaml` in it.

    Raises:
        MapError: The file cannot be written.
    """
    file = file_in(path)
    data = (HEAD + to_yaml(checked_corrections(corrections))).encode()
    save_file(str(file), data, "corrections", MapError)


def file_in(path: str | os.PathLike[str]) -> Path:
    """Return the file of corrections that a path names: itself, or the one in a folder."""
    file = Path(checks.a_path("path", path, MapError) or FILE)
    return file / FILE if file.is_dir() else file


def beside(maps: str | os.PathLike[str] | None) -> Path | None:
    """Return the file of corrections beside a file of maps; None if there is none.

    Raises MapError if a folder has its name.
    """
    if maps is None or str(maps) == "-":
        return None
    file = Path(checks.a_path("maps", maps, MapError)).parent / FILE
    if file.is_dir():
        raise MapError(
            f"{named(file)}: expected a file of corrections, got a folder; give it another name"
        )
    return file if file.exists() else None


def named_beside(
    maps: Iterable[SSHMap], drives: Sequence[Drive], path: str | os.PathLike[str] | None
) -> tuple[SSHMap, ...]:
    """Return maps with the names in the file of corrections beside their file, if there is one.

    `drives` are the drives of the trace of the maps, with fingerprints; empty if unknown. If the
    file of corrections is of other drives, a warning says so. Raises MapError if it is malformed.
    """
    file = beside(path)
    if file is None or not drives:
        return tuple(maps)
    said = load_corrections(file)
    try:
        said.check_drives({drive.name: drive.fingerprint for drive in drives})
    except MapError as error:
        warnings.warn(f"{error}; its names are not used", stacklevel=3)
        return tuple(maps)
    return tuple(said.named(ssh_map, drives) for ssh_map in maps)


def to_yaml(corrections: Corrections) -> str:
    """Write names and corrections as YAML. `from_yaml` reads them."""
    import yaml  # loads slowly

    said = corrections
    data: dict[str, Any] = {
        "format": FORMAT,
        "version": VERSION,
        "drives": dict(said.drives),
        "names": [{"name": n.name, n.kind: n.step} | only_known(note=n.note) for n in said.names],
    }
    for kind in ASSERTIONS:
        pairs = [pair for pair in said.pairs if pair.kind == kind]
        data[kind] = [
            {"steps": [*pair.steps], "note": pair.note} if pair.note else [*pair.steps]
            for pair in pairs
        ]
    data["gateways"] = [
        {
            "open" if gateway.is_open else "closed": {
                step: direction_in_words(way) for step, way in gateway.seen
            }
        }
        | only_known(note=gateway.note)
        for gateway in said.gateways
    ]
    kept = {name: value for name, value in data.items() if value or name == "drives"}
    kept = json.loads(json_line(kept))  # YAML knows no texts of numpy
    how: dict[str, Any] = {"sort_keys": False, "allow_unicode": True, "default_flow_style": None}
    return str(yaml.safe_dump(kept, width=100, **how))


def from_yaml(text: str | bytes, source: str = "corrections") -> Corrections:
    """Read names and corrections from YAML. Raises MapError, which names source and field."""
    try:
        data = parse_yaml(text)
    except ValueError as error:
        raise MapError(f"{source}: expected YAML, got {error}; mend it there") from None
    return _CorrectionsReader(named(source)).corrections(data, source)


class _CorrectionsReader(FieldReader):
    """Checks the fields of a file of corrections. Errors name the file and the field."""

    mend = "mend it there"

    def corrections(self, data: object, source: str) -> Corrections:
        """Convert the data of a file."""
        fields = ("format", "version", "drives", "names", *ASSERTIONS, "gateways")
        record = self._only(data, "file", fields)
        if record.get("format") != FORMAT:
            raise self.wrong("format", f'"{FORMAT}"', record.get("format"))
        if record.get("version") != str(VERSION):
            expected = f"{VERSION} (another one is of another ssh-abduction)"
            raise self.wrong("version", expected, record.get("version"))
        record = {name: value for name, value in record.items() if value}  # others say nothing
        each = partial(self.each, record, optional=True)
        return Corrections(
            self.values(self.text)(record.get("drives", {}), "drives"),
            each("names", self._naming),
            tuple(said for kind in ASSERTIONS for said in each(kind, partial(self._said, kind))),
            each("gateways", self._passage),
            source,
        )

    def _naming(self, value: object, where: str) -> Naming:
        record = self._only(value, where, ("name", *NAMED, "note"))
        kinds = [kind for kind in NAMED if kind in record]
        if len(kinds) != 1:
            raise self.wrong(where, f"one of {', '.join(NAMED)}", value)
        return self._made(Naming, where, record, record.get("name"), kinds[0], record[kinds[0]])

    def _said(self, kind: str, value: object, where: str) -> Said:
        record = value if isinstance(value, Mapping) else {"steps": value}
        self._only(record, where, ("steps", "note"))
        return self._made(Said, where, record, kind, record.get("steps"))

    def _passage(self, value: object, where: str) -> Passage:
        record = self._only(value, where, ("open", "closed", "note"))
        if ("open" in record) == ("closed" in record):
            raise self.wrong(where, "one of open, closed", value)
        state = "open" if "open" in record else "closed"
        if not (seen := record[state]) or not isinstance(seen, Mapping):
            expected = "steps and directions, such as monday:12: left"
            raise self.wrong(f"{where}.{state}", expected, seen)
        with said_of(f"{self.where}: {where}.{state}", MapError):
            ways = tuple((step, direction(way)) for step, way in seen.items())
        return self._made(Passage, where, record, state == "open", ways)

    def _made(
        self, kind: Callable[..., T], where: str, record: Mapping[str, Any], /, *values: Any
    ) -> T:
        """Make a sentence from its values and the note of its record, which may be empty."""
        with said_of(f"{self.where}: {where}", MapError):
            return kind(*values, record.get("note") or None)

    def _only(self, value: object, where: str, fields: Sequence[str]) -> Mapping[str, Any]:
        """Return an object that has no other fields than these."""
        if not isinstance(value, Mapping):
            raise self.wrong(where, ", ".join(fields), value)
        if unknown := set(value) - set(fields):
            raise self.wrong(where, f"only {', '.join(fields)}", min(unknown, key=str))
        return value


def direction(text: str) -> float:
    """Read a direction: ahead, right, back, left, or degrees clockwise. Raises MapError."""
    with suppress(ValueError, TypeError):
        degrees = DIRECTIONS[text] if text in DIRECTIONS else float(text)
        if math.isfinite(degrees):
            return degrees % 360
    raise MapError(
        f"direction: expected {', '.join(DIRECTIONS)}, or degrees clockwise from ahead, got "
        f"{brief(text)}; take one"
    )
