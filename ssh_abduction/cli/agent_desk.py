"""Answers to the questions of agents about maps, as tools of the Model Context Protocol."""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ssh_abduction.building.telling import corridor_in_words, room_in_words, summary, told
from ssh_abduction.cli import shared
from ssh_abduction.cli.correct import SavedMap, correct_pair, give_name
from ssh_abduction.cli.parsing import MAPS
from ssh_abduction.cli.use import way_in_words
from ssh_abduction.data.building import Corridor, MapDoor, MapRoom
from ssh_abduction.data.checks import needed
from ssh_abduction.data.corrections import FILE
from ssh_abduction.data.drives import step_of
from ssh_abduction.data.errors import AbductionError, MapError, brief, named
from ssh_abduction.data.map_parts import list_in_words
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.data.words import meant
from ssh_abduction.explain.pair_reasons import explain_pair
from ssh_abduction.rivals.explore import next_experiment
from ssh_abduction.rivals.listing import Listing, PairInMap, trusted
from ssh_abduction.theory.theory import Theory

if TYPE_CHECKING:
    from mcp.server.mcpserver import MCPServer

Answer = dict[str, Any]

SECONDS = 20.0  # for each answer that needs a search
SURE = 0.95  # what is at least as probable is called sure
INSTRUCTIONS = (
    "Maps of buildings that a robot drove through. Name things by number, such as p4, room4, "
    "corridor2 or door1, by a name that a person gave, or by a step of the drive, such as "
    "'step 90'. A probability in an answer is that of the joins of visits that the answer needs: "
    "that the robot was at one place twice. Walls and doors are taken as the laser saw them, "
    "but no answer is sure of a room that a gap as narrow as a door may divide."
)


def server_of(desk: MapDesk) -> MCPServer[Any]:
    """Make a server with a tool for each question that a desk answers.

    Raises AbductionError if the package mcp is missing.
    """
    with needed("mcp", "mcp", "'.[mcp]' in your clone"):
        from mcp.server.mcpserver import MCPServer
        from mcp.server.mcpserver.exceptions import ToolError

    def tool(answer: Callable[..., Answer]) -> Callable[..., Answer]:
        @functools.wraps(answer)
        def answered(*args: Any, **kwargs: Any) -> Answer:
            try:
                return answer(*args, **kwargs)
            except AbductionError as error:
                raise ToolError(str(error)) from None

        return answered

    server: MCPServer[Any] = MCPServer(
        "ssh-abduction", instructions=INSTRUCTIONS, log_level="ERROR"
    )
    for answer in desk.tools:
        server.tool()(tool(answer))
    return server


@dataclass(frozen=True)
class KnownMap:
    """The first map of a folder, with what is known of its rivals."""

    saved: SavedMap
    listing: Listing
    trace: Trace

    @classmethod
    def load(cls, folder: Path) -> KnownMap:
        """Read the map of a folder. Raises MapError if there is none."""
        file = folder / MAPS
        saved, trace = SavedMap.load(file), shared.mapped_trace(str(file))
        if trace is None:
            raise MapError(f"{named(folder)}: expected a trace beside the map, got none; map again")
        return cls(saved.built(), shared.listing_of(str(file)), trace)

    @property
    def map(self) -> SSHMap:
        """The map, with its rooms and names."""
        return self.saved.map

    def found(self, text: str) -> tuple[str, str, bool]:
        """Find what an agent names: its kind, a step there, and whether it is a step itself."""
        text = text.strip()
        if (step := re.fullmatch(r"(?:step|visit) ?(\d+)", text)) and not self.map.starts:
            text = f"{self.saved.drives[0].name}:{int(step[1])}"
        names, bare = sorted(self.saved.given), text.casefold().removeprefix("the ")
        text = next((name for name in names if name.casefold() == bare), text)
        try:
            return *self.saved.thing(text), self.saved.numbered_or_named(text) is None
        except MapError:
            if any(letter.isdigit() for letter in text):
                raise
            near = meant(text, names, 3).removeprefix("; ") or "or a number, such as room4"
            known = ", ".join(names) or "it has none"
            raise MapError(
                f"{text}: expected a name of this map ({known}), got none of them; {near}"
            ) from None

    def two_steps(self, one: str, other: str) -> tuple[int, int]:
        """Find a step at each of two things. Raises MapError if it is the same step."""
        first, second = (step_of(self.saved.drives, self.found(text)[1]) for text in (one, other))
        if first == second:
            raise MapError(f"expected two visits, got step {first} twice; name two steps")
        return first, second

    def called(self, kind: str, step: str) -> str:
        """Name a thing by its kind, number and name."""
        number = self.saved.number_at(kind, step)
        return f"the {kind} of {step}" if number is None else self.map.called(kind, number)

    def steps(self, kind: str, number: int | None) -> frozenset[int]:
        """The steps at a place, or in a room or corridor."""
        places = self.map.things().get(kind, {}).get(-1 if number is None else number, ())
        at = (self.map.dstates[label].place for label in self.map.dstate_at)
        return frozenset(t for t, place in enumerate(at) if place in places)

    def steps_at(self, places: Iterable[int]) -> frozenset[int]:
        """The steps at some places."""
        return frozenset(t for place in places for t in self.steps("place", place))

    def share(self, holds: Callable[[Sequence[int]], bool]) -> float | None:
        """The probability of the maps for whose places of the steps something holds.

        None if the costs of maps give no probability.
        """
        if (weighed := trusted(self.listing.weighed)) is None:
            return None
        pairs = zip(weighed.weights, weighed.rivals, strict=True)
        return round(math.fsum(w for w, rival in pairs if holds(rival.at)), 4)

    def meeting(self, one: Collection[int], other: Collection[int]) -> float | None:
        """The probability that a step of one set is at one place with a step of another set."""
        return self.share(lambda at: not {at[t] for t in one}.isdisjoint(at[t] for t in other))

    def as_mapped(self, steps: Collection[int]) -> float | None:
        """The probability that all visits to the places of some steps are joined as in the map."""

        def partition(at: Sequence[int]) -> set[frozenset[int]]:
            groups = {at[t] for t in steps}
            return {frozenset(u for u, p in enumerate(at) if p == group) for group in groups}

        weighed = self.listing.weighed
        best = partition(weighed.rivals[0].at) if weighed else set()
        return self.share(lambda at: partition(at) == best)

    def may_be_two(self, room: int) -> bool:
        """Whether the robot passed a gap in a room that is no wider than a door of this map."""
        places, doors = self.map.rooms[room].places, self.map.doors
        widest = max((door.width for door in doors), default=0.0)
        at = [self.map.dstates[label].place for label in self.map.dstate_at]
        return any(
            here in places and there in places and sum(widths) <= widest
            for step, here, there in zip(self.trace.steps, at, at[1:], strict=False)
            for widths in step.extra.get("widths", ())
        )

    def sureness(self, probability: float | None, rooms: Iterable[int]) -> Answer:
        """How sure an answer about some rooms is, as a number and in words."""
        narrow = sorted(filter(self.may_be_two, rooms))
        if not narrow or not probability or probability < SURE:
            return _sureness(probability)
        two = ", ".join(self.map.called("room", room) for room in narrow)
        said = f"doubtful: a gap as narrow as a door may divide {two}"
        return {"probability": probability, "how_sure": said}


class MapDesk:
    """Answers questions about the maps in some folders. Each of `tools` is a question.

    Args:
        folders: Folders that `map` wrote, or that `live` saves to.
        write: Whether to answer also the questions that change corrections.yaml.

    Raises:
        AbductionError: A folder is not of this program, or two have one name.
    """

    def __init__(self, folders: Sequence[str], *, write: bool = False) -> None:
        self._folders: dict[str, Path] = {}
        for folder in map(Path, folders):
            name = folder.resolve().name
            _check_folder(folder)
            if name in self._folders:
                raise MapError(f"{named(folder)}: expected another name, got {name} twice; rename")
            self._folders[name] = folder.resolve()
        self._write = write

    @property
    def tools(self) -> tuple[Callable[..., Answer], ...]:
        """The questions, as functions with a docstring for agents."""
        asked = (
            self.list_buildings,
            self.list_rooms_and_places,
            self.find,
            self.beside,
            self.is_same,
            self.why,
            self.route,
            self.doubts,
            self.next_experiment,
        )
        return (*asked, self.name, self.correct) if self._write else asked

    def list_buildings(self) -> Answer:
        """List the buildings that can be asked about, and how sure the map of each is."""
        return {"buildings": [*map(self._summary, self._folders)]}

    def _summary(self, name: str) -> Answer:
        try:
            known = self._known(name)
        except MapError as error:
            return {"building": name, "said": str(error)}
        said = f"{known.listing.verdict} {summary(known.map)}."
        return {"building": name, "said": said, "steps": known.listing.steps}

    def list_rooms_and_places(self, building: str = "") -> Answer:
        """List the corridors, rooms, doors and places of a building, with positions in metres."""
        known = self._known(building)
        kinds: dict[str, Sequence[Corridor | MapRoom | MapDoor]]
        kinds = {"corridor": known.map.corridors, "room": known.map.rooms, "door": known.map.doors}
        listed = {
            f"{kind}s": [
                {**thing.to_dict(), "name": known.map.name_of(kind, thing.id)} for thing in things
            ]
            for kind, things in kinds.items()
        }
        places = [_place(known, place) for place in known.map.places]
        return {"said": [line.strip() for line in told(known.map)], **listed, "places": places}

    def find(self, what: str, building: str = "") -> Answer:
        """Find a place, room, corridor or door by name, number, or step of the drive."""
        known = self._known(building)
        kind, step, _ = known.found(what)
        number = known.saved.number_at(kind, step)
        if number is None:
            raise MapError(f"{what}: the map has no {kind} there")
        answer: Answer = {"kind": kind, "number": number, "name": known.map.name_of(kind, number)}
        if kind == "place":
            return {**answer, **_place(known, number)}
        if kind == "room":
            room = known.map.rooms[number]
            return {**answer, "said": room_in_words(known.map, room), "places": [*room.places]}
        if kind == "corridor":
            corridor = known.map.corridors[number]
            said = corridor_in_words(known.map, corridor)
            return {**answer, "said": said, "places": [*corridor.order]}
        return answer

    def beside(self, what: str, building: str = "") -> Answer:
        """Say which rooms are behind a corridor, or beside a room or a place."""
        known = self._known(building)
        kind, step, _ = known.found(what)
        number, indoors = known.saved.number_at(kind, step), known.map.building
        if kind not in ("place", "room", "corridor") or number is None or indoors is None:
            raise MapError(
                f"{what}: expected a place, room or corridor, got the {kind} of {step}; name one"
            )
        here, ways = {number}, set[int | None]()
        if kind == "room":
            here, ways = {*indoors.rooms[number].places}, {*indoors.rooms[number].doors}
        elif kind == "corridor":
            corridor = indoors.corridors[number]
            here = {*corridor.order}
            ways = {*corridor.doors, *(opening.door for opening in corridor.openings)}
        doors = [door for door in indoors.doors if door.id in ways or here & {*door.places}]
        own = {indoors.room_of(place) for place in here}
        rooms = sorted({room for door in doors for room in door.rooms} - own)
        beyond = here.union(*(indoors.rooms[room].places for room in rooms))
        called = ", ".join(known.map.called("room", room) for room in rooms)
        probability = known.as_mapped(known.steps_at(beyond)) if rooms else None
        concerned = {*rooms, *(room for room in own if room is not None)}
        return {
            "said": f"beside {known.called(kind, step)}: {called or 'no room that is known'}",
            "rooms": rooms,
            "names": [known.map.name_of("room", room) for room in rooms],
            "doors": [door.id for door in doors],
            **known.sureness(probability, concerned),
            "all": "not known: there may be doors that the robot did not drive through or notice",
        }

    def is_same(self, one: str, other: str, building: str = "") -> Answer:
        """Say whether two things are one, and how sure that is.

        Such as 'room4' and 'step 90' for "is room 4 the room I saw at step 90?".
        """
        known = self._known(building)
        found = [known.found(text) for text in (one, other)]
        kinds = {kind for kind, _, is_step in found if not is_step} or {"place"}
        if len(kinds) > 1 or not kinds <= {"place", "room", "corridor"}:
            raise MapError(
                f"expected two things of one kind, or a thing and a step, got {brief(one)} and "
                f"{brief(other)}; name a place, room or corridor"
            )
        (kind,) = kinds
        numbers = [known.saved.number_at(kind, step) for _, step, _ in found]
        if None in numbers:
            step = found[numbers.index(None)][1]
            raise MapError(f"{step}: the map has no {kind} there")
        groups = [known.steps(kind, number) for number in numbers]
        for k, (_, step, is_step) in enumerate(found):
            if is_step:
                groups[k] = _stay(groups[k], step_of(known.saved.drives, step))
        same = numbers[0] == numbers[1]
        if same and (groups[0] <= groups[1] or groups[1] <= groups[0]):
            smaller, larger = sorted(groups, key=len)
            groups = [smaller, larger - smaller]  # the other visits
        share: float | None = 1.0  # the robot was there only once
        if all(groups):
            share = known.meeting(*groups)
            share = share if same or share is None else round(1 - share, 4)
        things = [known.called(kind, step) for _, step, _ in found]
        text = f"yes, both are {things[0]}" if same else f"no, {things[0]} and {things[1]} are two"
        concerned = {n for n in numbers if n is not None and same and kind == "room"}
        return {"same": same, "said": text, **known.sureness(share, concerned)}

    def why(self, one: str, other: str, building: str = "") -> Answer:
        """Say why two visits are at one place, or at two, by the axioms and the odometry."""
        known = self._known(building)
        steps = known.two_steps(one, other)
        # A visit has several headings. Take those of one dstate, if the visits share one.
        at = known.map.dstate_at
        stays = [_stay(known.steps("place", known.map.place_of(t)), t) for t in steps]
        alike = (pair for pair in product(*map(sorted, stays)) if len({at[t] for t in pair}) == 1)
        first, second = sorted(next(alike, steps))
        theory = known.saved.theory or Theory.topological()
        how: dict[str, Any] = {"time_limit": SECONDS, "known": known.listing.maps}
        explained = explain_pair(known.trace, first, second, theory, **how)
        pair = PairInMap.of(known.listing, first, second)
        said = f"{pair}\n{explained}" if pair else str(explained)
        return {"steps": [first, second], "said": said, "verdict": explained.verdict.value}

    def route(self, goal: str, start: str = "", building: str = "") -> Answer:
        """Tell the shortest way to a place, room or corridor in words.

        It starts where the robot was last, unless a start is named.
        """
        known = self._known(building)
        ends = [(text and self._end(known, text)) or None for text in (start, goal)]
        drives = known.saved.drives
        here, there, words = way_in_words(known.map, known.trace, drives, ends[0], ends[1] or goal)
        return {"from": here, "to": there, "said": "; ".join(words), "words": list(words)}

    def _end(self, known: KnownMap, text: str) -> str:
        kind, step, is_step = known.found(text)
        return step if is_step or kind == "door" else f"{kind}{known.saved.number_at(kind, step)}"

    def doubts(self, building: str = "") -> Answer:
        """List the joins of visits that may be false, and what else is suspicious in the map."""
        known = self._known(building)
        weighed = known.listing.weighed
        joins: Iterator[Answer] = (
            {
                "steps": [str(first), str(second)],
                "place": known.map.place_of(int(first)),
                "probability": round(share, 4),
            }
            for first, second, share in (weighed and weighed.doubtful) or ()
        )
        said = " ".join([known.listing.verdict, known.listing.sureness])
        faults = [str(fault) for fault in known.map.faults]
        warned = list(known.listing.warnings)
        return {"said": said, "joins": list(joins), "faults": faults, "warnings": warned}

    def next_experiment(self, building: str = "") -> Answer:
        """Plan the actions after which maps that cost nearly the same would disagree."""
        known = self._known(building)
        how: dict[str, Any] = {"theory": known.saved.theory, "time_limit": SECONDS}
        found = next_experiment(known.listing, known.trace, **how)
        return {"said": f"{found.sentence}. {known.listing.sureness}", "actions": [*found.actions]}

    def name(self, what: str, name: str, building: str = "") -> Answer:
        """Give a name to a place, room, corridor, door, path or region."""
        known = self._known(building)
        _, step, is_step = known.found(what)
        return {"said": give_name(known.saved, step if is_step else what, name)}

    def correct(self, one: str, other: str, same: bool, building: str = "") -> Answer:
        """Say that two places or steps are one place, or that they are two.

        The map obeys when a person solves it again. The answer has the command.
        """
        known = self._known(building)
        kind = "same_place" if same else "elsewhere"
        return {"said": correct_pair(str(known.saved.file), kind, *known.two_steps(one, other))}

    def _known(self, building: str) -> KnownMap:
        """Read the map of a building. Raises MapError if there is no such building, or no map."""
        name = building or next(iter(self._folders))
        if name not in self._folders or (not building and len(self._folders) > 1):
            raise MapError(
                f"building: expected {list_in_words(self._folders)}, got {brief(building)}"
                f"{meant(building, self._folders) or '; name one of these'}"
            )
        folder = self._folders[name]
        _check_folder(folder)
        if not (folder / MAPS).is_file():
            raise MapError(f"{name}: there is no map yet; ask again when the robot has driven on")
        return KnownMap.load(folder)


def _check_folder(folder: Path) -> None:
    """Raise MapError if a folder is not of map or live, or has a file outside of it."""
    from ssh_abduction.robot_logs.log_mapper import OnlineLogMapper

    if not (shared.trace_beside(str(folder / MAPS)) or OnlineLogMapper.is_saved(folder)):
        got = "no folder" if not folder.is_dir() else "another one"
        raise MapError(
            f"{named(folder)}: expected a folder that map wrote or that live saves to, got {got}; "
            "map a log with -o, and name that folder"
        )
    for name in (MAPS, "trace.jsonl", "run.json", FILE, "page.html"):
        if (folder / name).resolve().parent != folder.resolve():
            raise MapError(
                f"{named(folder / name)}: expected a file of the folder, got a link; copy it"
            )


def _place(known: KnownMap, place: int) -> Answer:
    """Describe a place as plain data."""
    indoors, fit = known.map.building, known.map.fit
    found: Answer = {"place": place, "name": known.map.name_of("place", place)}
    label = next((s.id for s in known.map.dstates if s.place == place), None)
    if label is not None and fit is not None and fit.poses:
        found |= {"x": round(fit.poses[label].x, 2), "y": round(fit.poses[label].y, 2)}
    if indoors is not None:
        found |= {"room": indoors.room_of(place), "corridor": indoors.corridor_of(place)}
    return {**found, "steps": sorted(known.steps("place", place))}


def _stay(steps: Collection[int], step: int) -> frozenset[int]:
    """The steps around one, without a gap."""
    first = last = step
    while first - 1 in steps:
        first -= 1
    while last + 1 in steps:
        last += 1
    return frozenset(range(first, last + 1))


def _sureness(probability: float | None) -> Answer:
    """How sure an answer is, as a number and in words."""
    if probability is None:
        return {"probability": None, "how_sure": "not known"}
    word = "sure" if probability >= SURE else "doubtful"
    return {"probability": probability, "how_sure": f"{word}: probability {probability:.2f}"}
