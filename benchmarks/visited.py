"""Which places a robot really visited, and how right the events of a mapper are.

    python benchmarks/visited.py TRACE --log LOG [--truth drive.json] [-o named.jsonl]

An event is a visit according to a mapper: a scan, and the place at which the mapper says that the
scan was taken. The mapper is a trace, with or without a map, or a skeleton. The truth comes from
corrected poses, or from the file that the simulator writes beside a log (format ssh-drive). With
-o, the trace is written with the names of the true places. Then `ssh-abduction evaluate maps.json
named.jsonl` can name dstates, places and paths.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.ndimage import label
from skeleton import poses_of

from perception.readers.logs import read_log
from ssh_abduction import SSHMap, Trace
from ssh_abduction.data import Action, DState, Step
from ssh_abduction.evaluation import (
    Evaluation,
    Relations,
    VisitsEvaluation,
    evaluate,
    evaluate_visits,
    told_poses,
)
from ssh_abduction.evaluation.pose_truth import NEAR

Array = NDArray[np.float64]
# A robot visits a place within this many metres. In ACES3, 1.5 to 6 m give the same 15 visits.
REACH = 3.0
# An event is at a door within this many metres.
DOOR = 1.0
# Events at no known place are one place if their average distance is below this, in metres.
APART = 2.0
# A robot has left a place at this distance, in metres. Swerving in a rotunda is not leaving.
AWAY = 5.0
# ACES3: the corridors along y and along x, in metres of the corrected poses. Crossings are places.
ACES_COLUMNS, ACES_ROWS = (-20.0, -1.0, 22.5), (-0.5, -19.0, -39.0)
ACES_NAMES = ("NW", "N", "NE"), ("W", "C", "E"), ("SW", "S", "SE")
ACES_ROUTE = ["N", "NE", "E", "SE", "S", "SW", "W", "NW", "N", "C", "S", "C", "W", "C", "E"]


@dataclass(frozen=True)
class Visit:
    """A stay at a true place.

    Attributes:
        place: Name of the place.
        first: Index of the first scan there.
        last: Index of the last scan there.
    """

    place: str
    first: int
    last: int


@dataclass(frozen=True)
class Truth:
    """What is known of a log, for evaluation only.

    Attributes:
        poses: (n, 3) true pose of each scan: x and y in metres, heading in radians.
        visits: Visits to places that a mapper should find, in order; empty if unknown.
        doorways: Visits to the doors that the robot drove through, in order; empty if unknown.
            Going in and out by one door counts once.
        doors: x and y of each door in metres, by name; None if unknown.
        rooms: Name of the room of each scan; empty if unknown.
        grid: Whether places are the crossings of ACES3, whose corridors are the true paths.
        times: Time of each scan in seconds; empty if unknown.
        relations: Relative poses between times that were checked by hand; None without any.
    """

    poses: Array
    visits: tuple[Visit, ...] = ()
    doorways: tuple[Visit, ...] = ()
    doors: Mapping[str, Sequence[float]] | None = None
    rooms: tuple[str | None, ...] = ()
    grid: bool = False
    times: tuple[float | None, ...] = ()
    relations: Relations | None = None

    @staticmethod
    def of_aces(poses: Array) -> Truth:
        """Make the truth of ACES3, with its 15 visits.

        Args:
            poses: (n, 3) corrected pose of each scan.

        Raises:
            ValueError: The poses do not pass the places in the known order.
        """
        places = {
            name: (x, y)
            for y, names in zip(ACES_ROWS, ACES_NAMES, strict=True)
            for x, name in zip(ACES_COLUMNS, names, strict=True)
        }
        visits = visits_of(places, poses)
        if (route := [visit.place for visit in visits]) != ACES_ROUTE:
            raise ValueError(
                f"expected the route {' '.join(ACES_ROUTE)}, got {' '.join(route)}; "
                "give the corrected poses of ACES3"
            )
        return Truth(poses, visits, grid=True)

    @staticmethod
    def load(path: Path) -> Truth:
        """Read the truth from the file that the simulator wrote beside a log."""
        told = json.loads(path.read_text())
        poses = np.array(told["poses"])
        doors = {name: door["at"] for name, door in told.get("doors", {}).items()}
        if doors:
            return Truth(
                poses,
                doorways=doorways_of(told["crossings"], poses),
                doors=doors,
                rooms=tuple(told["scans"]),
            )
        return Truth(
            poses,
            tuple(Visit(visit["place"], visit["first"], visit["last"]) for visit in told["visits"]),
        )

    def matched(self, scans: Sequence[int]) -> list[int | None]:
        """Match events with visits.

        If several events are at one visit, only the one nearest to its middle is matched.

        Args:
            scans: Scan of each event.

        Returns:
            For each event, the index of its visit; None without a visit.
        """
        found: list[int | None] = [None] * len(scans)
        for number, visit in enumerate(self.visits):
            middle = (visit.first + visit.last) / 2
            at = [i for i, scan in enumerate(scans) if visit.first <= scan <= visit.last]
            if at:
                found[min(at, key=lambda i: abs(scans[i] - middle))] = number
        return found

    def names(self, scans: Sequence[int], poses: Array | None = None) -> list[str]:
        """Name the true place of each event.

        It is the place of a visit, or else a door that is near. Other events that are close
        together get one place, which is named after their room.

        Args:
            scans: Scan of each event.
            poses: (n, 3) pose of each event; None for the true poses of the scans.
        """
        named: list[str | None] = [
            next((v.place for v in self.visits if v.first <= scan <= v.last), None)
            for scan in scans
        ]
        at = (self.poses[np.asarray(scans, dtype=int)] if poses is None else poses)[:, :2]
        for i, (x, y) in enumerate(at):
            if named[i] is None and self.doors:
                door = min(self.doors, key=lambda name: math.dist(self.doors[name], (x, y)))  # type: ignore[index]
                named[i] = door if math.dist(self.doors[door], (x, y)) <= DOOR else None
        rooms = [self.rooms[scan] if self.rooms else None for scan in scans]
        for room in dict.fromkeys(rooms):
            here = [i for i in range(len(scans)) if rooms[i] == room and named[i] is None]
            groups = (
                fcluster(linkage(at[here], "average"), APART, "distance")
                if len(here) > 1
                else np.ones(len(here), int)
            )
            numbers = {
                group: number for number, group in enumerate(dict.fromkeys(groups.tolist()), 1)
            }
            for i, group in zip(here, groups.tolist(), strict=True):
                named[i] = f"{room or 'elsewhere'} {numbers[group]}"
        return [name or "" for name in named]


def visits_of(
    places: Mapping[str, Sequence[float]], poses: Array, reach: float = REACH
) -> tuple[Visit, ...]:
    """Find the stays of a robot within reach of places.

    Between two visits to one place, the robot visits another place.

    Args:
        places: x and y of each place in metres, by name.
        poses: (n, 3) pose of each scan.
        reach: Metres.
    """
    visits: list[Visit] = []
    for scan, (x, y, _) in enumerate(poses.tolist()):
        place = min(places, key=lambda name: math.dist(places[name], (x, y)))
        if math.dist(places[place], (x, y)) <= reach:
            first = visits.pop().first if visits and visits[-1].place == place else scan
            visits.append(Visit(place, first, scan))
    return tuple(visits)


def doorways_of(crossings: Sequence[Mapping[str, Any]], poses: Array) -> tuple[Visit, ...]:
    """Make visits to the doors that a robot drove through.

    A visit has the scans within DOOR metres of the crossing, along the way of the robot. Going in
    and out by one door counts once.

    Args:
        crossings: Name of the door and index of the scan of each crossing, in order.
        poses: (n, 3) pose of each scan.
    """
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T))])
    found: list[Visit] = []
    for crossing in crossings:
        at = way[min(crossing["scan"], len(way) - 1)]
        first, last = (
            int(np.searchsorted(way, at - DOOR)),
            int(np.searchsorted(way, at + DOOR, side="right")) - 1,
        )
        if found and found[-1].place == crossing["door"]:
            first = found.pop().first
        found.append(Visit(crossing["door"], first, last))
    return tuple(found)


@dataclass(frozen=True)
class Events:
    """The events of a mapper, in order.

    Attributes:
        scans: Index of the scan of each event.
        places: Place of each event according to the mapper; None if the mapper does not say.
        poses: (n, 3) pose of each event, as seen by the mapper from the true pose of the robot.
            None if the events are at the poses of the robot.
    """

    scans: tuple[int, ...]
    places: tuple[Hashable, ...]
    poses: Array | None = None

    @staticmethod
    def of(trace: Trace, ssh_map: SSHMap | None = None) -> Events:
        """List the visits of a trace that was made from a log, with their places in a map.

        Args:
            trace: The trace.
            ssh_map: The map; None if there is none.
        """
        starts = [t for t in range(len(trace)) if t == 0 or trace.actions[t - 1].kind != "turn"]
        places = [
            None if ssh_map is None else ssh_map.dstates[ssh_map.dstate_at[t]].place for t in starts
        ]
        told = told_poses(trace)
        poses = [pose for t in starts if (pose := told[t]) is not None]
        return Events(
            tuple(int(trace.steps[t].extra["scan"]) for t in starts),
            tuple(places),
            np.array(poses) if len(poses) == len(starts) else None,
        )


def passes(events: Events, truth: Truth) -> tuple[int, int]:
    """Count how often the robot passed the position of an event at another time.

    It passes the position if it comes within NEAR metres after it was farther away than AWAY, or
    before it is.

    Returns:
        The number of passes, and the number of those during which there is also an event.
    """
    where = truth.poses[list(events.scans)] if events.poses is None else events.poses
    come = noticed = 0
    for (x, y, _), scan in zip(where, events.scans, strict=True):
        distance = np.hypot(*(truth.poses[:, :2] - (x, y)).T)
        parts, _ = label(distance <= AWAY)
        for part in set(parts[distance <= NEAR].tolist()) - {parts[scan], 0}:
            come += 1
            noticed += any(parts[other] == part for other in events.scans)
    return come, noticed


@dataclass(frozen=True)
class Figures:
    """How right a mapper is.

    Attributes:
        nodes: Number of places of the mapper that were visited.
        events: Number of events.
        precision: Share of the events that match true visits; None if unknown.
        recall: Share of the true visits that have an event or, if visits are unknown, of the doors
            that were driven through; None if both are unknown.
        passes: How often the robot passed the position of an event at another time, and how often
            there was an event then.
        named: Accuracy, edges and pairs by the names of the true places, as in `evaluate`.
        posed: Pairs of events by poses, as in `evaluate`.
        related: Pairs of events by relations that were checked by hand; None without relations.
    """

    nodes: int
    events: int
    precision: float | None
    recall: float | None
    passes: tuple[int, int]
    named: Evaluation
    posed: VisitsEvaluation
    related: VisitsEvaluation | None

    @property
    def isomorphic(self) -> bool:
        """Whether the places of the mapper are those that were visited, as far as this is known.

        Events are at one place exactly if they truly are, and events and true visits correspond.
        """
        return (
            bool(self.named.maps[0].places_right)
            and self.precision in (None, 1.0)
            and self.recall in (None, 1.0)
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the figures as a dict from short names; None for an unknown figure."""
        named, row = (
            self.named.maps[0],
            {
                "nodes": self.nodes,
                "events": self.events,
                "event_precision": self.precision,
                "event_recall": self.recall,
                "passes": self.passes,
            },
        )
        row |= {
            "places_right": named.places_right,
            "accuracy": named.accuracy,
            "edge_precision": named.edge_precision,
            "edge_recall": named.edge_recall,
            "isomorphic": self.isomorphic,
        }
        for judge in (self.posed, self.related):
            if judge is not None and (pairs := judge.maps[0].places) is not None:
                row[judge.judge] = {**pairs.to_dict(), **asdict(judge.places)}
        return row


def judged(events: Events, truth: Truth) -> Figures:
    """Compare the events of a mapper with the truth."""
    hits = sum(visit is not None for visit in truth.matched(events.scans))
    noticed = sum(
        any(door.first <= scan <= door.last for scan in events.scans) for door in truth.doorways
    )
    names = truth.names(events.scans, events.poses)
    poses = truth.poses[list(events.scans)] if events.poses is None else events.poses
    numbers = {place: i for i, place in enumerate(dict.fromkeys(events.places))}
    # In this trace and map each place has one dstate, so accuracy is that of places.
    steps = [
        Step(
            "v",
            truth={"dstate": name, "place": name, "pose": pose.tolist()},
            extra={"time": truth.times[scan] if truth.times else None},
        )
        for name, pose, scan in zip(names, poses, events.scans, strict=True)
    ]
    trace = Trace((*(replace(step, action=Action.of("travel")) for step in steps[:-1]), steps[-1]))
    dstates = tuple(DState(i, "v", i, None, None) for i in range(len(numbers)))
    ssh_map = SSHMap(
        tuple(numbers[place] for place in events.places), dstates, (), tuple(range(len(numbers)))
    )
    return Figures(
        nodes=len(numbers),
        events=len(names),
        precision=hits / len(names) if truth.visits else None,
        recall=hits / len(truth.visits)
        if truth.visits
        else noticed / len(truth.doorways)
        if truth.doorways
        else None,
        passes=passes(events, truth),
        named=evaluate([ssh_map], trace),
        posed=evaluate_visits([ssh_map], trace),
        related=truth.relations and evaluate_visits([ssh_map], trace, relations=truth.relations),
    )


def with_names(trace: Trace, truth: Truth) -> Trace:
    """Copy a trace, with the true place of each step as its truth.

    If a step has a true pose, its truth also has that pose and the heading. In ACES3, it also has
    path and direction.
    """
    told = told_poses(trace)
    scans = [int(step.extra["scan"]) for step in trace.steps]
    names = truth.names(
        scans,
        np.array(
            [
                truth.poses[scan] if pose is None else pose
                for scan, pose in zip(scans, told, strict=True)
            ]
        ),
    )
    known = {visit.place for visit in truth.visits}
    steps = []
    for step, name, pose in zip(trace.steps, names, told, strict=True):
        says: dict[str, Any] = {"place": name}
        if pose is not None:
            quarter = round(pose[2] / (math.pi / 2)) % 4
            says |= {"pose": list(pose), "heading": "ENWS"[quarter]}
            if truth.grid and name in known:
                row = next(i for i, names in enumerate(ACES_NAMES) if name in names)
                along = (
                    f"row {row}" if quarter % 2 == 0 else f"column {ACES_NAMES[row].index(name)}"
                )
                says |= {"path": along, "direction": 1 if quarter < 2 else -1}
        steps.append(replace(step, truth=says))
    return replace(trace, steps=tuple(steps))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("trace", metavar="TRACE", help="the trace that import made from the log")
    parser.add_argument("--log", type=Path, help="the log, whose corrected poses are the truth")
    parser.add_argument(
        "--truth", type=Path, help="the file that the simulator wrote beside the log"
    )
    parser.add_argument("-o", "--output", help="write the trace with the names of the true places")
    options = parser.parse_args()
    trace = Trace.load(options.trace)
    truth = truth_of(options.log, options.truth)
    events = Events.of(trace)
    matched = truth.matched(events.scans)
    poses = truth.poses[list(events.scans)] if events.poses is None else events.poses
    for scan, (x, y, heading), name, visit in zip(
        events.scans, poses, truth.names(events.scans, poses), matched, strict=True
    ):
        print(
            f"scan {scan:4}  ({x:6.1f}, {y:6.1f}, {math.degrees(heading):4.0f})  "
            f"{name}{'' if visit is not None or not truth.visits else '  no visit'}"
        )
    figures = judged(events, truth)
    if truth.visits:
        missed = [visit.place for number, visit in enumerate(truth.visits) if number not in matched]
        print(
            f"{len(matched)} events, precision {figures.precision:.2f}, recall "
            f"{figures.recall:.2f}; missed: {' '.join(missed) or 'none'}"
        )
    if truth.doorways:
        print(
            f"{len(matched)} events; an event or more at {figures.recall:.0%} of "
            f"{len(truth.doorways)} doors driven through"
        )
    print(
        "came back {} times to where an event is, and noticed it {} times".format(*figures.passes)
    )
    if options.output:
        with_names(trace, truth).save(options.output)


def truth_of(log: Path, truth: Path | None = None) -> Truth:
    """Find the truth of a log.

    It comes from a file of the simulator, or from corrected poses. For ACES3, it also has the
    visits to its nine places. For a log with a file of relations beside it, such as Freiburg, it
    also has these.

    Args:
        log: The log.
        truth: The file that the simulator wrote; None without one.
    """
    if truth is not None:
        return Truth.load(truth)
    read = read_log(str(log))
    poses = np.array(poses_of(read, "corrected"))
    if log.name.startswith("aces"):
        return Truth.of_aces(poses)
    relations = log.with_suffix(".relations")
    return Truth(
        poses,
        times=tuple(scan.time for scan in read.scans),
        relations=Relations.load(relations) if relations.exists() else None,
    )


if __name__ == "__main__":
    main()
