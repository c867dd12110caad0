"""Keeps the map of a building while a robot drives: laser scans come one at a time.

There are three tiers. `observe` takes a scan in bounded time. `task` matches the new visits with
earlier ones, and gathers what a search needs. `solved` searches for the map, which may take long
and may run in another process; `accept` takes its result.

Places have numbers that last. A number never moves to another place. If a search joins two places,
the place keeps the older number. If a later search takes that back, the younger number returns.

The result of `finish` is that of `import_log` for the whole log.
"""

from __future__ import annotations

import itertools
import math
import os
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from perception.errors import LogError
from perception.places.distinctive import WIDTH, Visit
from perception.places.importing import Grown, Imported, Tell, assembled, tell_nobody
from perception.places.live import LiveLog, LivePlace
from perception.places.passages import spaced
from perception.places.relations import Relocation
from perception.places.saved import STATE
from perception.readers.scans import RobotLog, Scan
from ssh_abduction.data.checks import an_instance, one_of
from ssh_abduction.data.corrections import Corrections, Naming
from ssh_abduction.data.errors import named
from ssh_abduction.data.files import json_line, mend_of, parse_json, read_file, retire, write_file
from ssh_abduction.data.groups import first_index_of, indices_of
from ssh_abduction.data.odometry import Pose, displacement_between, moved
from ssh_abduction.data.trace import Trace
from ssh_abduction.data.words import counted
from ssh_abduction.runtime.limits import LimitError, Watch, in_process
from ssh_abduction.solution import Solution

NAMES = "drive.names"
FORMAT, VERSION, MOST = "ssh-live-names", 2, 2**26
# The standard deviation of the position of the robot relative to a known place: metres, and metres
# for each metre driven since the last visit that the map has.
NEAR, DRIFT = 0.5, 0.02
# The robot is at no place if all places are farther away than this many metres.
AWAY = 1.5
# A place has moved if its middle is this many metres from where it was.
MOVED = 1.0
# Metres from one station to the next while it is unknown where the robot is, and how far behind the
# robot they are.
STATION, BEHIND = 2.0, 3.0
LOOK = 1.0  # metres from one look at visits to come to the next
EVERY = 1.0  # seconds from saving to saving
POLL = 0.2  # seconds to wait for a search
# Units of work of a search, each about a second of a quiet core.
WORK = 5.0
TRAIL = 0.3  # metres between points of the way, for pages
RIVALS = 5  # rivals that are told
SURE = 0.005  # a join of less probability is not doubtful
# What a person says of two visits, as in corrections: a place is the same, or another one.
SAID = ("same_place", "elsewhere")


@dataclass(frozen=True, eq=False)
class RobotSeen:
    """What the mapper knows after a scan.

    Attributes:
        pose: The pose of the robot on the track: x, y in metres and heading in radians.
        on_map: Its pose on the last map; None without a map.
        belief: The probability that the robot is at each place, by its number. The rest is the
            probability that it is at none.
        visits: The visits that are final now.
    """

    pose: Pose
    on_map: Pose | None
    belief: Mapping[int, float]
    visits: tuple[Visit, ...]


@dataclass(frozen=True, slots=True)
class Event:
    """A change of the map.

    Attributes:
        kind: "new", "joined", "retracted", "moved" or "renamed" (by a person).
        place: The number of the place.
        other: For "joined", the number that is no longer used. For "retracted", the number of the
            place that it was joined with.
    """

    kind: str
    place: int
    other: int | None = None

    def __str__(self) -> str:
        other = {"joined": f" with place {self.other}", "retracted": f" from place {self.other}"}
        said = {"new": "is new", "retracted": "is apart again"}.get(self.kind, f"was {self.kind}")
        return f"place {self.place} {said}{other.get(self.kind, '')}"


@dataclass(frozen=True, eq=False)
class MapTask:
    """All that the search for a map needs."""

    log: RobotLog  # with the ranges of a scan every 0.3 m, for corridors and doors
    grown: Grown
    width: float
    work: float
    said: tuple[tuple[str, int, int], ...] = ()  # corrections: a kind of SAID, and two scans


@dataclass(frozen=True, eq=False)
class FoundMap:
    """The result of a search.

    Attributes:
        scans: The scan of each visit.
        places: The number of the place of each visit in this map.
        poses: (n, 3) the fitted pose of each visit: the middle of its place in metres, and by how
            many radians the track is turned there.
        middles: (n, 2) the middle of each visit by the track, in metres.
        located: Whether the map says where the robot is. If it was lifted, closures have to connect
            the new trajectory with the old map first.
        said: How good the map is: the verdict of its solution.
        files: The files of the map, by name.
        sure: The same as plain data: `nats`, `bound`, `confidence`, `doubtful` joins and `rivals`.
            A join is two scans, each of a visit.
    """

    scans: tuple[int, ...]
    places: tuple[int, ...]
    poses: np.ndarray[Any, np.dtype[np.float64]]
    middles: np.ndarray[Any, np.dtype[np.float64]]
    said: str
    files: Mapping[str, bytes]
    located: bool = True
    # For pages: the walls and the way of the robot, as `log_ground.ground_of` makes them, and the
    # `frame` that they are in.
    ground: Mapping[str, Any] = field(default_factory=dict)
    sure: Mapping[str, Any] = field(default_factory=dict)


def solved(task: MapTask, watch: Watch | None = None) -> FoundMap | None:
    """Search for the map of a task. Return None if there is nothing to map yet.

    The watch is that of `in_process`, which stops the process of the search. Raises LogError if
    the search finds no map, and AbductionError if corrections contradict each other.
    """
    # The process of the search needs them. A robot that starts again should not wait for them.
    from ssh_abduction.page.content import Ground
    from ssh_abduction.page.html import view_page
    from ssh_abduction.robot_logs.log_ground import frame_among_visits, ground_of
    from ssh_abduction.robot_logs.log_maps import BARE
    from ssh_abduction.solver import solve

    grown = task.grown
    try:
        done = assembled(
            (task.log, grown.track, ()), grown.visits, grown.closings, task.width, "live", {}
        )
    except LogError:  # the robot hardly moved
        return None
    first = first_index_of(int(step.extra["visit"]) for step in done.trace.steps)
    steps, scans = [first[k] for k in range(len(done.visits))], [v.scan for v in done.visits]
    said: dict[str, Any] = {kind: [] for kind in SAID}
    for kind, *pair in task.said:
        said[kind].append(tuple(steps[nearest(scans, scan)] for scan in pair))
    solution = solve(done.trace, BARE.replace(**said), max_maps=1, work_limit=task.work)
    if not solution.maps:
        what = "corrections that a map can obey" if task.said else "a map"
        raise LogError(f"live: expected {what}, got none; give more work, or take one back")
    ssh_map = solution.maps[0]
    places = (ssh_map.dstates[ssh_map.dstate_at[t]].place for t in steps)
    seen = ground_of(task.log, done, ssh_map)
    files = {
        "trace.jsonl": "".join(f"{line}\n" for line in done.trace.to_lines()).encode(),
        "maps.json": f"{json_line(solution.to_dict())}\n".encode(),
        "page.html": view_page(solution, done.trace, ground=Ground(seen)).html.encode(),
    }
    return FoundMap(
        tuple(scans),
        tuple(-1 if place is None else place for place in places),
        done.poses,
        np.array([visit.middle for visit in done.visits]).reshape(-1, 2),
        solution.verdict,
        files,
        _is_located(done),
        {
            **{key: seen[key] for key in ("walls", "box", "way")},
            "frame": frame_among_visits(done, ssh_map),
        },
        _sureness(solution, done.trace, scans),
    )


def nearest(scans: Sequence[int], scan: int) -> int:
    """The index of the visit whose scan is nearest: later scans may move a visit a little."""
    return min(range(len(scans)), key=lambda k: abs(scans[k] - scan))


def _sureness(solution: Solution, trace: Trace, scans: Sequence[int]) -> dict[str, Any]:
    """How sure a map is, as in `FoundMap`. `scans` has the scan of each visit."""
    weighed = solution.weighed
    if weighed is None:
        return {}
    visit_at = [int(step.extra["visit"]) for step in trace.steps]
    steps = first_index_of(visit_at)

    def joins(at: Sequence[int]) -> set[tuple[int, int]]:
        groups = indices_of([at[steps[k]] for k in range(len(scans))]).values()
        return {pair for visits in groups for pair in itertools.pairwise(visits)}

    def told(pairs: set[tuple[int, int]]) -> list[list[int]]:
        return [[scans[k] for k in pair] for pair in sorted(pairs)]

    best, *others = (joins(rival.at) for rival in weighed.rivals)
    rivals = [
        {"probability": round(p, 4), "joined": told(other - best), "apart": told(best - other)}
        for p, other in zip(weighed.weights[1:], others, strict=True)
        if other != best
    ]
    return {
        "nats": round(weighed.nats, 2),
        "bound": round(weighed.bound, 2),
        "confidence": weighed.place_confidence,
        # None if the search did not finish: then it is unknown which joins are doubtful.
        "doubtful": None
        if weighed.doubtful is None
        else [
            {"scans": [scans[visit_at[t]] for t in pair], "probability": round(p, 4)}
            for *pair, p in weighed.doubtful
        ],
        "rivals": rivals[:RIVALS],
    }


def _is_located(done: Imported) -> bool:
    """Whether closures connect the last unbroken part of a drive with an earlier part."""
    if not done.track.breaks:
        return True
    scan_of = [int(step.extra["scan"]) for step in done.trace.steps]
    begin = done.track.breaks[-1]
    pairs = ((scan_of[one.first], scan_of[one.last]) for one in done.trace.closures)
    return any(min(pair) < begin <= max(pair) for pair in pairs)


@dataclass
class _Names:
    """The lasting numbers of places.

    The first visit to a place founds its number. Wherever this visit is, there is the number. If a
    place has the founders of several numbers, it has the oldest number, and the others rest.
    """

    founders: list[int] = field(default_factory=list)  # the scan of the visit that founded each
    resting: dict[int, int] = field(default_factory=dict)  # a number that rests, and the one in use
    place_of: dict[int, int] = field(default_factory=dict)  # by the scan of the visit
    middles: dict[int, tuple[float, float]] = field(default_factory=dict)  # metres, on the map
    texts: dict[int, str] = field(default_factory=dict)  # the names that a person gave
    anchor: tuple[Pose, Pose] | None = None  # a pose on the track, and the same on the map
    said: list[tuple[str, int, int]] = field(default_factory=list)  # as in `MapTask`

    def update(self, found: FoundMap) -> list[Event]:
        """Number the places of a map, and say what changed."""
        number_of, resting = dict[int, int](), dict[int, int]()
        for number, scan in enumerate(self.founders):
            used = number_of.setdefault(found.places[nearest(found.scans, scan)], number)
            resting |= {} if used == number else {number: used}
        events = [Event("joined", used, n) for n, used in resting.items() if n not in self.resting]
        events += [
            Event("retracted", n, used) for n, used in self.resting.items() if n not in resting
        ]
        visits: dict[int, list[int]] = {}
        for k, (scan, place) in enumerate(zip(found.scans, found.places, strict=True)):
            if place not in number_of:
                number_of[place] = len(self.founders)
                events.append(Event("new", number_of[place]))
                self.founders.append(scan)
            visits.setdefault(number_of[place], []).append(k)
        before, self.resting = self.middles, resting
        self.place_of = {found.scans[k]: number for number, some in visits.items() for k in some}
        means = {n: found.poses[some, :2].mean(axis=0).tolist() for n, some in visits.items()}
        self.middles = {number: (x, y) for number, (x, y) in means.items()}
        events += [
            Event("moved", number)
            for number, middle in self.middles.items()
            if number in before and math.dist(before[number], middle) > MOVED
        ]
        return events


class OnlineLogMapper:
    """Keeps the track, the visits and the map of a drive while its scans come.

    Args:
        width: The width of the robot in metres. It cannot pass narrower parts of the free space.
        tell: A function that gets each note on suspicious odometry, at once.

    Attributes:
        live: The scans, the track, the visits and the closures so far.
        said: How good the last map is; empty without a map.
        sure: The same as plain data (see `FoundMap`).

    Raises:
        LogError: An argument is invalid.

    Example:
        >>> from ssh_abduction.robot_logs.log_mapper import OnlineLogMapper
        >>> mapper = OnlineLogMapper(width=0.5)
        >>> mapper.places()
        []
    """

    def __init__(self, width: float = WIDTH, tell: Tell = tell_nobody) -> None:
        self.live = LiveLog(width, tell)
        self.said, self.sure = "", dict[str, Any]()
        self._names = _Names()
        self._asked = 0  # the number of final visits at the last task
        self._way = 0.0  # metres since the anchor
        self._last: Pose | None = None
        self._looked, self._expected = -math.inf, list[Visit]()  # the last look at visits to come
        self._relocation: Relocation | None = None  # while it is unknown where the robot is
        self._station = 0.0  # metres since the last station of the relocation

    def __len__(self) -> int:
        """The number of scans."""
        return len(self.live)

    def observe(self, scan: Scan) -> RobotSeen:
        """Add the next scan, with odometry in metres and radians, in bounded time.

        Raises LogError if it is no Scan, or lacks ranges or a finite odometry.
        """
        an_instance("scan", scan, Scan, LogError, mend="give a Scan of perception.readers.scans")
        one, visits = self.live.add(scan)
        far = math.dist(self._last[:2], one.pose[:2]) if self._last else 0.0
        self._last, self._way, self._station = one.pose, self._way + far, self._station + far
        if one.broken and len(self) > 1:
            self._names.anchor = self._relocation = None
        if self._names.anchor is None and self._names.middles:
            self._relocate(far)
        on_map = self.on_map(one.pose)
        return RobotSeen(one.pose, on_map, self._belief(on_map), tuple(visits))

    def lift(self) -> None:
        """Say that the robot may be anywhere at the next scan, for example after it was off.

        Until closures show where it is on the map, `observe` returns no pose on the map.
        """
        self.live.lift()
        self._names.anchor = None
        self._relocation = self.live.relocation()

    def _relocate(self, far: float) -> None:
        """Compare what the robot sees with the known visits, after it drove `far` metres."""
        self._relocation = self._relocation or self.live.relocation()
        if self._relocation is None:
            return
        if self._relocation.left:
            self._names.anchor = self._relocation.go_on(far / STATION)
        elif self._station > STATION and (seen := self.live.around(BEHIND)):
            self._station = 0.0
            self._relocation.begin(*seen)
        if self._names.anchor is not None:
            self._relocation, self._way = None, self._station + BEHIND

    def on_map(self, pose: Pose) -> Pose | None:
        """A pose on the track, moved to the last map; None if the robot is not located on it."""
        if self._names.anchor is None:
            return None
        on_track, on_map = self._names.anchor
        return moved(on_map, displacement_between(on_track, pose))

    def _belief(self, pose: Pose | None) -> dict[int, float]:
        if pose is None:
            return {}
        spread = NEAR + DRIFT * self._way
        near = {
            place: math.exp(-(math.dist(middle, pose[:2]) ** 2) / (2 * spread**2))
            for place, middle in self._names.middles.items()
        }
        total = sum(near.values()) + math.exp(-(AWAY**2) / (2 * NEAR**2))
        found = {place: p / total for place, p in near.items() if p / total > 0.01}
        return dict(sorted(found.items(), key=lambda item: -item[1]))

    def places(self) -> list[LivePlace]:
        """The places that the robot passed, by fitted poses, without a search."""
        return self.live.places()

    @property
    def is_due(self) -> bool:
        """Whether a visit became final since the last task."""
        return len(self.live.visits) > self._asked

    def task(self, work: float = WORK) -> MapTask:
        """Gather what `solved` needs to search for a map, with this many units of work.

        New visits are matched with earlier ones first.
        """
        self._asked = len(self.live.visits)
        grown, nothing = self.live.grown(), np.zeros(0)
        kept = {*spaced(grown.track, len(self.live))}
        scans = tuple(
            scan if k in kept else replace(scan, ranges=nothing)
            for k, scan in enumerate(self.live.log.scans)
        )
        said = tuple((kind, first, second) for kind, first, second in self._names.said)
        return MapTask(RobotLog(scans), grown, self.live.width, work, said)

    def accept(self, found: FoundMap | None) -> list[Event]:
        """Take the result of `solved`, and return what changed."""
        if found is None:
            return []
        an_instance("found", found, FoundMap, LogError, mend="give what `solved` returned")
        events = self._names.update(found)
        if found.located and found.scans[-1] >= self.live.begun:
            (ahead, left), (x, y, turn) = found.middles[-1].tolist(), found.poses[-1].tolist()
            self._names.anchor = (ahead, left, 0.0), (x, y, turn)
            self._relocation, self._way = None, 0.0
        self.said, self.sure = found.said, dict(found.sure)
        return events

    def correct(self, kind: str, first: int, second: int) -> None:
        """Say that two visits are at one place ("same_place") or at two ("elsewhere").

        A visit is given by its scan, as in `to_dict`. This replaces what was said of the two
        visits before. The next search obeys. Raises LogError for another kind or scan.
        """
        one_of("kind", kind, SAID, LogError)
        scans = self._names.place_of
        if first == second or not scans.keys() >= {first, second}:
            known = ", ".join(map(str, sorted(scans))) or "no map yet"
            raise LogError(
                f"scans: expected two different ones of {known}, got {first} and {second}; take "
                "scans of the map"
            )
        pair = min(first, second), max(first, second)
        self._names.said = [one for one in self._names.said if tuple(one[1:]) != pair]
        self._names.said.append((kind, *pair))
        self._asked = -1

    def name(self, place: int, text: str) -> Event:
        """Name a place by its number.

        Raises LogError if there is none of this number, and MapError if the name is that of another
        place, or no name.
        """
        if place not in self._names.middles:
            raise LogError(
                f"place: expected one of {counted(len(self._names.middles), 'places')}, got "
                f"{place}; take a number of the map"
            )
        texts = {**self._names.texts, place: text}
        Corrections(names=tuple(Naming(one, "place", f"place:{n}") for n, one in texts.items()))
        self._names.texts[place] = text.strip()
        return Event("renamed", place)

    def _provisional(self) -> list[list[float]]:
        """The middles of the visits that the last map lacks, in metres on the map."""
        if abs(self._way - self._looked) > LOOK:
            self._looked, self._expected = self._way, self.live.expected()
        last = max(self._names.place_of, default=-1)
        visits = [one for one in (*self.live.visits, *self._expected) if one.scan > last]
        middles = (one.middle.tolist() for one in visits)
        if self._names.place_of:  # there is a map, and it may not be known where the robot is on it
            here = (self.on_map((x, y, 0.0)) for x, y in middles)
            middles = (list(at[:2]) for at in here if at)
        return [[round(x, 2), round(y, 2)] for x, y in middles]

    def next(self) -> str:
        """Where the robot should look again to make the map surer, in words."""
        pairs = [(one["probability"], *one["scans"]) for one in self.sure.get("doubtful") or ()]
        for rival in self.sure.get("rivals", ()):
            pairs += [(rival["probability"], *pair) for pair in rival["joined"]]
        pairs = [pair for pair in pairs if SURE < pair[0] < 1 - SURE]
        if not pairs:
            is_known = self.sure.get("doubtful") is not None
            return (
                "no join is doubtful"
                if is_known
                else "it is not known yet which joins are doubtful"
            )
        p, first, second = min(pairs, key=lambda pair: abs(pair[0] - 0.5))
        place = self._names.place_of[second]
        return (
            f"drive through place {place}: the visits of scans {first} and {second} are at one "
            f"place with probability {p:.2f}"
        )

    def to_dict(self) -> dict[str, Any]:
        """The map so far as plain data: places by number, edges, and the pose of the robot."""
        names, order = self._names, sorted(self._names.place_of.items())
        travels = {tuple(sorted((a, b))) for (_, a), (_, b) in itertools.pairwise(order)}
        scans = {n: [scan for scan, at in order if at == n] for n in names.middles}
        return {
            "places": [
                {
                    "place": place,
                    "x": round(x, 2),
                    "y": round(y, 2),
                    "name": names.texts.get(place),
                    "scans": scans[place],
                }
                for place, (x, y) in sorted(names.middles.items())
            ],
            "edges": sorted(pair for pair in travels if pair[0] != pair[1]),
            "provisional": self._provisional(),
            "scans": len(self.live),
            "visits": len(self.live.visits),
            "said": self.said,
            "sure": self.sure,
        }

    def finish(self, name: str | None = None) -> Imported:
        """Import the log so far, as `import_log` does. Raises LogError as it does."""
        return self.live.finish(name)

    def save(self, folder: str | os.PathLike[str]) -> None:
        """Save the state in a folder. To save there again only adds what is new. Raises OSError."""
        self.live.save(folder)
        names = {"format": FORMAT, "version": VERSION, "said": self.said, "sure": self.sure}
        names |= {"names": asdict(self._names)}
        write_file(Path(folder) / NAMES, json_line(names).encode())

    @staticmethod
    def is_saved(folder: str | os.PathLike[str]) -> bool:
        """Whether a folder has the state of a drive."""
        return any((Path(folder) / name).exists() for name in (STATE, NAMES))

    @staticmethod
    def load(folder: str | os.PathLike[str], tell: Tell = tell_nobody) -> OnlineLogMapper:
        """Restore the state from a folder, to go on. Raises LogError."""
        mapper = OnlineLogMapper(tell=tell)
        mapper.live = LiveLog.load(folder, tell)
        file = Path(folder) / NAMES
        data = parse_json(read_file(file, MOST, "the names of places", LogError))
        if (data.get("format"), version := data.get("version")) != (FORMAT, VERSION):
            raise LogError(
                f"{named(file)}: expected names of version {VERSION}, got {version}; move the "
                "folder away, and start anew"
            )
        mapper.said, mapper.sure = data["said"], data["sure"]
        for field_name, value in data["names"].items():
            kept = {int(k): one for k, one in value.items()} if isinstance(value, dict) else value
            setattr(mapper._names, field_name, kept)
        return mapper


class MapSearch:
    """Searches for maps in another process, one at a time. It ends with this program.

    Attributes:
        error: Why the last search failed; empty if it did not.
    """

    def __init__(self) -> None:
        self.error = ""
        self._thread: threading.Thread | None = None
        self._watch, self._found = Watch(None), list[FoundMap | None]()

    @property
    def is_busy(self) -> bool:
        """Whether a search runs, or its result was not taken yet."""
        return self._thread is not None

    def begin(self, task: MapTask) -> None:
        """Begin a search. None may be busy."""
        assert self._thread is None
        self._watch, self._found, self.error = Watch(None), [], ""

        def search() -> None:
            try:
                self._found.append(in_process(solved, task, watch=self._watch))
            except LimitError as error:
                self.error = "" if self._watch.interrupted else f"the search ended: {error.reason}"
            except Exception as error:  # the robot drives on without a new map
                self.error = str(error)

        self._thread = threading.Thread(target=search, daemon=True)
        self._thread.start()

    def taken(self, wait: float = 0.0) -> FoundMap | None:
        """Take the result, if there is one within `wait` seconds; None if there is none."""
        if self._thread is not None:
            self._thread.join(wait)
        if self._thread is None or self._thread.is_alive():
            return None
        self._thread = None
        return self._found[0] if self._found else None

    def end(self) -> None:
        """End the search, and its process."""
        if self._thread is not None:
            self._watch.interrupted = True
            self._thread.join()
            self._thread = None


class LiveSession:
    """A drive that is mapped, saved and told about while it goes on.

    Args:
        mapper: The mapper, which may have a saved state.
        folder: The folder to save to each second, with the files of the last map; None for none.
        say: A function that takes a line about what happened.
        work: Units of work for each search, each about a second of a quiet core.
    """

    def __init__(
        self, mapper: OnlineLogMapper, folder: Path | None, say: Tell, work: float = WORK
    ) -> None:
        self.mapper, self.folder, self.work = mapper, folder, work
        self.seen: RobotSeen | None = None
        self.maps = 0  # the number of maps so far
        self.events: list[str] = []  # what was said of the maps
        self.page: bytes | None = None  # of the last map
        self.ground: Mapping[str, Any] = {}  # the walls and the way of the last map
        self.told = mapper.to_dict()  # the map as plain data, at most a second old
        self._say, self._search, self._saved, self._failed = say, MapSearch(), 0.0, False
        self.scan: Scan | None = None  # the last one
        self.trail: list[tuple[int, Pose]] = []  # scans since the last map, and poses on the track

    def take(self, scan: Scan) -> RobotSeen:
        """Add the next scan. Say when it becomes known where the robot is on the map."""
        before, self.seen, self.scan = self.seen, self.mapper.observe(scan), scan
        pose = self.seen.pose
        if not self.trail or math.dist(self.trail[-1][1][:2], pose[:2]) > TRAIL:
            self.trail.append((len(self.mapper) - 1, pose))
        if self.seen.on_map is not None and (before is None or before.on_map is None):
            x, y, _ = self.seen.on_map
            self.happened(f"the robot is located at ({x:.1f}, {y:.1f}) on the map")
        return self.seen

    def tick(self, wait: float = 0.0) -> bool:
        """Do what is due: take a map, begin a search, save. Return whether `told` is new."""
        found = self._search.taken(wait)
        if error := self._search.error:
            self._search.error, text = "", f"no new map: {error}"
            if text not in self.events[-1:]:
                self.happened(text)
        if found is not None:
            for event in self.mapper.accept(found):
                self.happened(event)
            self.maps += 1
            self.page, self.ground = found.files.get("page.html"), found.ground
            self.trail = [one for one in self.trail if one[0] >= found.scans[-1]]
            self._keep(found.files)
        if self.mapper.is_due and not self._search.is_busy:
            self._search.begin(self.mapper.task(self.work))
        is_new = found is not None or time.monotonic() - self._saved > EVERY
        if is_new:
            self.save()
            self.told = self.mapper.to_dict()
        return is_new

    def happened(self, event: object) -> None:
        """Say an event, and keep it for pages and topics."""
        self.events.append(str(event))
        self._say(str(event))

    def restart(self, mapper: OnlineLogMapper) -> None:
        """Begin a new drive. The search ends, and all files move to `before-N` in the folder."""
        self._search.end()
        self.save()
        with self._told():
            retire(self.folder)
        self.mapper, self.seen, self.told, self.page = mapper, None, mapper.to_dict(), None
        self.scan, self.trail, self.ground, self.maps = None, [], {}, 0

    def save(self) -> None:
        """Save the state. If the folder cannot be written, say so once."""
        self._saved = time.monotonic()
        if self.folder is not None and len(self.mapper):
            with self._told():
                self.mapper.save(self.folder)

    def end(self) -> None:
        """Search for the map of the whole drive, and save all. Ctrl-C ends the search."""
        try:
            if len(self.mapper):
                self._search.end()
                self._search.begin(self.mapper.task(self.work))
                while self._search.is_busy:
                    self.tick(POLL)
        finally:
            self._search.end()
            self.save()

    def _keep(self, files: Mapping[str, bytes]) -> None:
        if self.folder is not None:
            with self._told():
                self.folder.mkdir(parents=True, exist_ok=True)
                for name, data in files.items():
                    write_file(self.folder / name, data)

    @contextmanager
    def _told(self) -> Iterator[None]:
        try:
            yield
            self._failed = False
        except OSError as error:
            if not self._failed:
                self._say(
                    f"{named(self.folder)}: cannot be written: {error.strerror}; the map goes on "
                    f"in memory; {mend_of(error)}"
                )
            self._failed = True
