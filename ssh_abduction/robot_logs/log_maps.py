"""Find the minimal maps of a building from a robot's log, and make the files of its run folder.

The default theory uses neither stars (a star is the set of ways out that are seen at a place) nor
sides of paths. In real buildings a way out is too often misread, and paths that bend have no
defined sides. Displacements distinguish places. Views come from clustering, so each may be misread,
at a price that grows with its confidence.
"""

from __future__ import annotations

import itertools
import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from statistics import median
from typing import Any

import numpy as np

from perception.errors import LogError
from perception.images import images_of
from perception.places.distinctive import WIDTH
from perception.places.importing import Imported, import_log, join_logs
from perception.readers.scans import RobotLog
from perception.recognition import recogniser as new_recogniser
from ssh_abduction.building.derive import with_building
from ssh_abduction.data.checks import all_instances
from ssh_abduction.data.corrections import Corrections
from ssh_abduction.data.drives import drives_of, starts_of
from ssh_abduction.data.errors import TheoryError
from ssh_abduction.data.files import json_line
from ssh_abduction.data.map_parts import DState
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.page.content import Ground
from ssh_abduction.page.html import Page, view_page
from ssh_abduction.robot_logs.log_ground import ground_of
from ssh_abduction.robot_logs.log_report import may_misread, report
from ssh_abduction.runtime.loggers import begin_stage, log_of
from ssh_abduction.solution import Solution, Status, obeyed, with_correction_warnings, with_names
from ssh_abduction.solver import Ranking, Search, Start, find_backbone
from ssh_abduction.theory.fields import FAULT, PATHS
from ssh_abduction.theory.theory import Theory

_log = log_of(__name__)

# Without a limit, the search gets SHARE of a unit of work for each second that the robot drove, and
# at least LEAST units.
SHARE, LEAST = 1 / 40, 8.0
# Without a map, the search is given LONGER times its time, at most PATIENCE times.
LONGER, PATIENCE = 4.0, 3
# The recogniser treats all ranges below this, in metres, as equal. So does the clustering of views.
FLOOR = 0.3
# Speed of the robot in metres per second, assumed if the log has no clock. Robots whose logs have a
# clock drove 0.2 to 0.4 on average. If a robot is slower than SLOWEST by its clock, it mostly
# stood, or the clock does not count seconds.
SPEED, SLOWEST = 0.5, 0.02
# At most this many minimal maps are listed. They are ranked by how well their loops close.
MAPS = 300
# A note, if somebody ended the run.
INTERRUPTED = (
    "The run was interrupted: its map is the best one so far, "
    "and the log is mapped again by the next call."
)
# A time between scans that exceeds the median by this factor is a gap in the log or a jump of its
# clock. It does not count as driving.
GAP = 20.0
# A clock is unusable if more than this share of its steps goes back.
BACK = 0.01

# The theory for logs. Stars and sides are unreliable there. So are views: a robot that faces one
# way at one place may see two views. So a place may have two dstates in one direction of a path.
# Nothing tells which travels go straight on, so the maps have edges and no paths.
# The errors of odometry and of matches have heavy tails: two true returns can fit badly together.
# Their misfit has a price, and does not forbid them (joint=1).
# Views come from clustering. So each may be misread, at the log odds of its confidence in nats.
# Their clusters still differ sometimes, so a place may have two dstates in one direction.
BARE = Theory.topological().replace(
    star="none", boundary="none", without=PATHS, joint=1, misread=round(math.log(99) / FAULT, 2)
)


@dataclass(frozen=True, eq=False)
class LogMap:
    """The minimal maps of a robot's log, and how they were made.

    Attributes:
        log: The robot's log. The scans of several drives follow each other.
        imported: The trace of the log, and how it was made.
        solution: The minimal maps. Those whose loops close best come first.
        seconds: Processor time of each stage in seconds, by the name of the stage. Reading the log
            does not count.
        limit: Seconds that the search for minimal maps was allowed.
        notes: Sentences about problems of the track and of the mapping.
        interrupted: Whether the run was interrupted, so that the solution may not be minimal.
    """

    log: RobotLog
    imported: Imported
    solution: Solution
    seconds: Mapping[str, float]
    limit: float
    notes: tuple[str, ...] = ()
    interrupted: bool = False

    def _drives(self) -> list[dict[str, Any]]:
        """What was imported from the log of each drive, as plain data."""
        trace, visits = self.imported.trace, self.imported.visits
        bounds = itertools.pairwise([0, *self.imported.starts, len(self.log)])
        return [
            {
                "name": drive.name,
                "scans": stop - begin,
                "metres": round(float(np.ptp(self.imported.track.way[begin:stop])), 1),
                "visits": sum(begin <= visit.scan < stop for visit in visits),
                "steps": drive.stop - drive.first,
            }
            for drive, (begin, stop) in zip(drives_of(trace), bounds, strict=True)
        ]

    @property
    def drove(self) -> float | None:
        """The seconds that the robot drove; None if the clock of the log is unusable."""
        return seconds_driven(self.log)

    def to_dict(self) -> dict[str, Any]:
        """The contents of run.json as a dict: settings, counts, and the time of each stage."""
        solution, trace = self.solution, self.imported.trace
        return {
            "format": "ssh-run",
            "version": 1,
            "program": version("ssh-abduction"),
            "log": {
                "source": self.log.source,
                "format": self.log.format,
                "scans": len(self.log),
                "metres": round(float(self.imported.track.way[-1]), 1),
                "damaged": len(self.log.damaged),
                "sources": list(self.log.sources),
                "notes": list(self.log.notes),
            },
            "width": self.imported.width,
            "theory": solution.theory.to_dict(),
            "notes": list(self.notes),
            "visits": len(self.imported.visits),
            "steps": len(trace),
            "interrupted": self.interrupted,
            "status": solution.status.value,
            "complete": solution.complete,
            "count": solution.count,
            "cost": solution.cost.to_dict() if solution.cost else None,
            "seconds": dict(self.seconds),
            "limit": round(self.limit, 1),
            "drove": self.drove,
            **({"drives": self._drives()} if solution.joined else {}),
        }

    def files(self) -> dict[str, bytes]:
        """Make the files of the run's folder: a dict from names to contents, run.json last."""
        trace, solution = self.imported.trace, self.solution
        begin_stage("page")
        if not self.interrupted:
            shared = find_backbone(solution, trace, work_limit=self.limit)
            solution = replace(solution, shared=shared)
        found = {
            "trace.jsonl": "".join(f"{line}\n" for line in trace.to_lines()),
            "maps.json": f"{json_line(solution.to_dict())}\n",
        }
        best = solution.maps[0] if solution.maps else None
        told = report(self.log, self.imported, solution, self.to_dict())
        ground = Ground(ground_of(self.log, self.imported, best), told)
        page = view_page(solution if best else [_unjoined(trace)], trace, ground=ground)
        if best is None:
            said = {"verdict": "No map. The drive is shown alone.", "sentence": solution.headline}
            page = Page({**page.content, **said})
        found["page.html"] = page.html
        files = {name: text.encode() for name, text in found.items()}
        if solution.maps:
            files["recogniser.skops"] = recogniser_file(trace, solution.maps[0])
        run = f"{json.dumps(self.to_dict(), indent=2, ensure_ascii=False)}\n"
        return {**files, "run.json": run.encode()}


def _unjoined(trace: Trace) -> SSHMap:
    """The drive alone, as a map that joins no two steps."""
    dstates = tuple(DState(t, view) for t, view in enumerate(trace.views))
    links = tuple((t, a.name, t + 1) for t, a in enumerate(trace.actions) if not a.starts)
    return SSHMap(tuple(range(len(trace))), dstates, links, starts=starts_of(trace))


def recogniser_of(trace: Trace, ssh_map: SSHMap) -> Any:
    """Train a recogniser on the images of the trace of a log, labelled with the dstates of a map.

    It recognises dstates in the images of another drive. This is the last step of the bootstrap
    loop (Kuipers & Beeson 2002). Raises PerceptionError if a step has no
    image.
    """
    return new_recogniser(FLOOR).fit(images_of(trace), ssh_map.dstate_at)


def recogniser_file(trace: Trace, ssh_map: SSHMap) -> bytes:
    """Make the content of a file of `recogniser_of`, which `perception.store` reads."""
    from perception.store import written  # loads skops, which live does without

    return written(recogniser_of(trace, ssh_map))


def seconds_driven(log: RobotLog) -> float | None:
    """Compute the seconds that the robot drove, by the clock of a log.

    Long gaps between scans do not count, and neither do a few steps back. Return None if the clock
    is missing, often runs backwards, or mostly stands still.
    """
    times = [scan.time for scan in log.scans if scan.time is not None]
    steps = [later - earlier for earlier, later in itertools.pairwise(times)]
    runs_back = sum(step < 0 for step in steps) > BACK * len(steps)
    if not steps or runs_back or sum(step > 0 for step in steps) < len(steps) / 2:
        return None
    usual = median(step for step in steps if step > 0)
    return math.fsum(step for step in steps if 0 < step < GAP * usual) or None


def work_for(log: RobotLog, imported: Imported) -> float:
    """Compute the units of work for mapping a log: a fortieth of the seconds that it drove.

    The time of the import does not count, so that a log gets the same work on each machine.
    """
    metres = float(imported.track.way[-1])
    drove = seconds_driven(log)
    if drove is None or metres < SLOWEST * drove:
        drove = metres / SPEED
    return SHARE * drove


def _chosen(theory: Theory | None, choices: Mapping[str, Any]) -> Theory:
    """Return a theory with some fields chosen; None stands for BARE.

    Where the choices do not go with misread views, views are right. So they are with stars.
    """
    if theory is not None:
        return theory.replace(**choices)
    trusting = {"misread": 0.0, **choices}
    try:
        return BARE.replace(**choices if choices.get("star", "none") == "none" else trusting)
    except TheoryError:
        return BARE.replace(**trusting)


def how_it_ended(solution: Solution, allowed: float) -> str | None:
    """Say why a search found no map or proved none minimal; None if there is nothing to say."""
    if solution.status is Status.UNSATISFIABLE:
        let = (
            "Let some steps be wrong (--set misread=4), or ask" if may_misread(solution) else "Ask"
        )
        return (
            f"No map satisfies the axioms. {let} why: ssh-abduction explain FOLDER, with the "
            "folder of this map."
        )
    if solution.stopped not in ("time limit", "work limit") or solution.status is Status.OPTIMAL:
        return None
    missing = "a proof" if solution.maps else "a map"
    if solution.stopped == "time limit":
        return f"The search ended at the time limit without {missing}. Give it more seconds."
    return (
        f"The search ended after {allowed:.0f} units of work without {missing}. To search longer, "
        f"give a limit: --work-limit {math.ceil(LONGER * allowed / 10) * 10}."
    )


class LogMapping:
    """The mapping of a log while it runs. Another thread or a signal handler may interrupt it.

    Each search begins with the `known` maps that the checker accepts.
    """

    def __init__(self, known: tuple[SSHMap, ...] = ()) -> None:
        self._start = Start(known=known)
        self.search: Search | None = None  # the current or last search; None before the first one
        self.interrupted = False  # whether `interrupt` was called, or Ctrl-C ended a search
        self.latest: Callable[[], LogMap] | None = None  # what `known` returns

    def interrupt(self) -> None:
        """End the current search soon, with its best answer so far. End later searches, too."""
        self.interrupted = True
        if self.search is not None:
            self.search.interrupt()

    def snapshot(self) -> Solution:
        """Return what the current search knows so far. The search cannot be used afterwards."""
        assert self.search
        return self.search.snapshot("interrupted")

    def solve(
        self,
        trace: Trace,
        theory: Theory,
        *,
        time_limit: float | None,
        max_maps: int | None,
        work_limit: float | None = None,
    ) -> Solution:
        """Solve a trace as `ssh_abduction.solve` does. Ctrl-C ends this and all later searches."""
        theory.check_steps(trace)
        self.search = Search(
            trace,
            theory,
            time_limit=time_limit,
            work_limit=work_limit,
            max_maps=max_maps,
            _start=self._start,
        )
        if self.interrupted:  # perhaps before there was a search
            self.search.interrupt()
        solution = self.search.solution(tuple(self.search))
        self.interrupted |= solution.stopped == "interrupted"
        return solution

    def known(self) -> LogMap:
        """The result so far, for a program that has to end before the mapping does.

        Call it only after the search for maps has begun.
        """
        assert self.latest
        return self.latest()


def map_log(
    log: RobotLog | Sequence[RobotLog],
    theory: Theory | None = None,
    *,
    choices: Mapping[str, Any] | None = None,
    width: float = WIDTH,
    name: str | Sequence[str] | None = None,
    time_limit: float | None = None,
    work_limit: float | None = None,
    max_maps: int | None = MAPS,
    corrections: Corrections | None = None,
    mapping: LogMapping | None = None,
    tell: Callable[[str], None] = lambda note: None,
) -> LogMap:
    """Find the minimal maps of a building from a robot's log, or the joint maps of several logs.

    Ctrl-C during a search ends the mapping with the best map so far. `interrupted` of the result is
    then true.

    Args:
        log: The robot's log; or the logs of several drives through one building. It may be unknown
            where each drive starts.
        theory: The axioms; None for BARE, which uses no stars, sides or paths.
        choices: Values for some fields of Theory, by name. They replace the values in `theory`.
        width: The width of the robot in metres. It cannot pass narrower parts of the free space.
        name: The name of the trace, or the names of the drives. None for no name, or for "drive 1",
            "drive 2" and so on.
        time_limit: Seconds after which the search ends in any case; None for no limit.
        work_limit: Units of work for the search. A unit is about a second of a quiet core. One log
            and work limit give one map on each machine. None: until the time limit or, if there is
            none, a unit for 40 seconds of driving, and at least 8. If no map is found by then, the
            search goes on for up to 64 times as many units.
        max_maps: List at most this many minimal maps; None lists all.
        corrections: Names and corrections of a person, to be obeyed.
        mapping: An object through which another thread can interrupt the mapping; None for none.
        tell: A function that is called with each note on the log and on the search, as soon as the
            note is known.

    Raises:
        LogError: A log cannot be imported.
        TraceError: Two drives have one name, or their logs differ in what they record.
        TheoryError: The theory does not suit the trace.
        MapError: The corrections are of other drives, or contradict the trace.
    """
    mapping = mapping or LogMapping()

    # 1. Trace and theory: import the logs, and obey the corrections.
    log, imported = _imported(log, name, width, tell)
    seconds, notes = dict(imported.seconds), imported.notes
    trace, chosen = imported.trace, _chosen(theory, choices or {})
    if corrections is not None:
        trace, chosen = obeyed(corrections, trace, chosen)
        imported = replace(imported, trace=trace)
    _log.info("%d visits, %d steps", len(imported.visits), len(trace))

    # 2. Work as it suits the log.
    by_drive = max(work_for(log, imported), LEAST)
    given = time_limit if work_limit is None else work_limit
    allowed = by_drive if given is None else given

    def outcome(solution: Solution, interrupted: bool = True) -> LogMap:
        """Make the result for the solution so far, with its names and notes."""
        ended = INTERRUPTED if interrupted else how_it_ended(solution, allowed)
        warnings = (*notes, ended) if ended else notes
        solution = _with_poses(solution, trace)
        solution = solution if corrections is None else with_names(corrections, solution, trace)
        solution = solution if imported.track.is_reliable else _doubted(solution)
        return LogMap(log, imported, solution, dict(seconds), allowed, warnings, interrupted)

    # 3. Maps: solve the trace.
    mapping.latest = lambda: outcome(mapping.snapshot())
    begin = time.process_time()
    limits: dict[str, Any] = {"time_limit": time_limit, "max_maps": max_maps}
    begin_stage("search")
    solution = mapping.solve(trace, chosen, work_limit=allowed, **limits)
    tries = 0 if given is not None else PATIENCE
    while solution.status is Status.UNKNOWN and tries and not mapping.interrupted:
        allowed, tries = allowed * LONGER, tries - 1
        tell(f"No map was found yet. The search goes on for up to {allowed:.0f} units of work.")
        solution = mapping.solve(trace, chosen, work_limit=allowed, **limits)
    posed = _with_poses(solution, trace)
    solution = replace(posed, maps=tuple(with_building(each, trace) for each in posed.maps))
    if corrections is not None:
        solution = with_correction_warnings(corrections, solution)
    seconds["maps"] = round(time.process_time() - begin, 3)
    return outcome(solution, mapping.interrupted)


def _with_poses(solution: Solution, trace: Trace) -> Solution:
    """Fit the poses of the first map, if the time limit left no time for it."""
    if solution.theory.displacement != "use" or not solution.maps or solution.maps[0].fit:
        return solution
    first, *others = solution.maps
    return replace(solution, maps=(Ranking(trace).fitted(first), *others))


def _doubted(solution: Solution) -> Solution:
    """Mark the costs of the maps of a solution as doubtful, because the track is unreliable."""
    if solution.weighed is None:
        return solution
    weighed = replace(solution.weighed, doubt="the track is unreliable")
    return replace(solution, support=replace(solution.support, weighed=weighed))


def _imported(
    given: RobotLog | Sequence[RobotLog],
    name: str | Sequence[str] | None,
    width: float,
    tell: Callable[[str], None],
) -> tuple[RobotLog, Imported]:
    """Import the logs that `map_log` was given. Return the joint log, and its import."""
    if isinstance(given, RobotLog):
        return given, import_log(given, width, None if name is None else str(name), tell)
    logs = all_instances("log", given, RobotLog, LogError, mend="read one with read_log")
    if not logs:
        raise LogError("log: expected at least one log, got none; read one with read_log")
    names = [f"drive {i + 1}" for i in range(len(logs))] if name is None else list(name)
    if len(names) != len(logs):
        raise LogError(
            f"name: expected {len(logs)}, one per drive, got {len(names)}; name each log"
        )

    def telling(drive: str) -> Callable[[str], None]:
        return lambda note: tell(f"{drive}: {note}")

    parts = [
        import_log(log, width, drive, telling(drive))
        for log, drive in zip(logs, names, strict=True)
    ]
    return join_logs(logs, parts)
