"""From a robot's log to the minimal maps of the building, and to a folder that tells the whole run.

A building whose walls meet at right angles is mapped by the topological theory with stars. Elsewhere stars are too often misread, and what lies right of a path that bends is not to be said: there
displacements tell places apart, and no sides are asked for. The same goes where doors are the places, as a path may lead across a room in any direction. And it goes
for a building whose stars no map fits, as a junction was passed unnoticed, or one star misread.
"""

from __future__ import annotations

import itertools
import json
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from statistics import median
from typing import Any

from perception.places.importing import Imported, import_log
from perception.readers.scans import RobotLog
from ssh_abduction.data.deprecated import renamed_parameters
from ssh_abduction.data.files import json_line
from ssh_abduction.data.logs import log_of
from ssh_abduction.evaluation.ladder import Rung, UnderWay, ladder, rungs
from ssh_abduction.page.html import view_page
from ssh_abduction.robot_logs.log_report import report
from ssh_abduction.solver import Solution, Status, find_backbone
from ssh_abduction.theory.theory import Theory

_log = log_of(__name__)

# A log is mapped in this share of the time that the robot drove, unless a limit is given: what the import took is taken off it, and the ladder has a quarter of the rest.
SHARE, LADDER = 1 / 20, 1 / 4
# The minimal maps, and each rung of the ladder, have so many seconds at least, however short the drive was.
LEAST, LEAST_RUNG = 5.0, 1.0
# A rung has so many seconds at most: the ladder is for the reader, and nothing depends on its proofs.
RUNG = 10.0
# Metres a second that the robot is taken to have driven where the log has no clock. Robots whose logs have one drove 0.2 to 0.4 on the average.
SPEED = 0.5
# So many minimal maps are listed, and ranked by how well they close.
MAPS = 300
# What is said where no map fits the stars that the walls suggested to use.
NO_STARS = "No map fits the stars of the log: some star was misread, or a place was passed unnoticed. So the log was mapped without stars and sides."
# What is said where somebody ended the run before it was through.
INTERRUPTED = "The run was interrupted: its map is the best one so far, and the log is mapped again by the next call."
# Times between scans that are longer than so many times the usual one are gaps of the log, or clocks that jumped: they do not count as driving.
GAP = 20.0

# The theory of buildings whose stars say nothing that one could rely on.
BARE = Theory.topological().replace(star="none", boundary="none")


@dataclass(frozen=True, eq=False)
class LogMap:
    """What became of a log.

    log       the scans
    imported  the trace, and how it was made
    solution  its minimal maps, in the order of how well they close
    rungs     what each kind of evidence is worth; empty where that was not asked
    seconds   processor time of each stage, from the track on
    limit     seconds that there were for the minimal maps
    notes     what is to be said of its track and of how it was mapped
    interrupted  whether somebody ended the run before it was through
    """

    log: RobotLog
    imported: Imported
    solution: Solution
    rungs: tuple[Rung, ...]
    seconds: Mapping[str, float]
    limit: float
    notes: tuple[str, ...] = ()
    interrupted: bool = False

    @property
    def drove(self) -> float | None:
        """Seconds that the robot drove, by the clock of the log; None where its times are cut, wrapped or missing."""
        return seconds_driven(self.log)

    def to_dict(self) -> dict[str, Any]:
        """What run.json holds: settings, counts, and the time of each stage."""
        solution, scale, trace = self.solution, self.imported.scale, self.imported.trace
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
                "notes": list(self.log.notes),
            },
            "scale": asdict(scale),
            "right_angles": trace.extra["right_angles"],
            "theory": solution.theory.to_dict(),
            "notes": list(self.notes),
            "visits": len(self.imported.visits),
            "steps": len(trace),
            "interrupted": self.interrupted,
            "status": solution.status.value,
            "complete": solution.complete,
            "count": solution.count,
            "cost": solution.cost.to_dict() if solution.cost else None,
            "ladder": [rung.to_dict() for rung in self.rungs],
            "seconds": dict(self.seconds),
            "limit": round(self.limit, 1),
            "drove": self.drove,
        }

    def files(self) -> dict[str, bytes]:
        """The folder of a run, by name: trace.jsonl, maps.json, page.html, report.html and run.json, which comes last."""
        trace, solution = self.imported.trace, self.solution
        if not self.interrupted:
            shared = find_backbone(solution, trace, time_limit=self.limit)
            solution = replace(solution, shared=shared)
        found = {
            "trace.jsonl": "".join(f"{line}\n" for line in trace.to_lines()),
            "maps.json": f"{json_line(solution.to_dict())}\n",
        }
        if solution.maps:
            found["page.html"] = view_page(solution, trace).html
        found["report.html"] = report(self.log, self.imported, solution, self.rungs, self.to_dict())
        found["run.json"] = f"{json.dumps(self.to_dict(), indent=2, ensure_ascii=False)}\n"
        return {name: text.encode() for name, text in found.items()}


def theory_for(imported: Imported) -> Theory:
    """The theory that suits a building: with stars and sides where its places are junctions and its walls meet at right angles, else BARE."""
    return Theory.topological() if imported.trace.extra["right_angles"] else BARE


def seconds_driven(log: RobotLog) -> float | None:
    """Seconds that the robot drove, by the clock of a log; None where its times are cut, wrapped or missing."""
    times = [scan.time for scan in log.scans if scan.time is not None]
    steps = [later - earlier for earlier, later in itertools.pairwise(times)]
    if (
        not steps
        or any(step < 0 for step in steps)
        or sum(step > 0 for step in steps) < len(steps) / 2
    ):
        return None
    usual = median(step for step in steps if step > 0)
    return math.fsum(step for step in steps if step < GAP * usual) or None


def seconds_left(log: RobotLog, imported: Imported) -> float:
    """What the import left of the time in which a log is to be mapped: the twentieth part of what the robot drove. Below 0 where it left none."""
    drove = seconds_driven(log) or float(imported.track.way[-1]) / SPEED
    return SHARE * drove - math.fsum(imported.seconds.values())


class LogMapping(UnderWay):
    """The mapping of a log that is under way. A handler of signals, or another thread, may end it, and ask what is known.

    Attributes:
        known: What is known once a search has begun, for a program that ends before the mapping is through.
    """

    known: Callable[[], LogMap]


@renamed_parameters("limit", "maps")
def map_log(
    log: RobotLog,
    theory: Theory | None = None,
    *,
    choices: Mapping[str, Any] | None = None,
    gateway: float | None = None,
    radius: float | None = None,
    doors: bool | None = None,
    name: str | None = None,
    time_limit: float | None = None,
    max_maps: int | None = MAPS,
    with_ladder: bool = True,
    mapping: LogMapping | None = None,
) -> LogMap:
    """The minimal maps of a building, from a robot's log.

    theory           the axioms. Where it is None, `theory_for` chooses, and if no map satisfies what it chose, the log is mapped again by BARE
    choices          fields of Theory, laid over that: a choice about one thing leaves the others as they suit the log
    gateway, radius  metres, as in perception.places.scale.Scale; what the log suggests, where they are None
    doors            whether doors are the places, as in perception.places.importing.import_log; what the log suggests, where it is None
    limit            seconds for the minimal maps; None for what is left of a twentieth of the time that the robot drove, and LEAST at least
    maps             so many of them are listed at most
    with_ladder      whether it is found out, too, what each kind of evidence is worth
    mapping          what can interrupt this from elsewhere

    Ctrl-C during a search ends it, and what follows, with the best map so far: `interrupted` says so. Raises LogError, and TheoryError for a theory that does not suit the trace.
    """
    mapping = mapping or LogMapping()
    imported = import_log(log, gateway, radius, name, doors)
    seconds = dict(imported.seconds)
    _log.info("%d visits, %d steps", len(imported.visits), len(imported.trace))
    chosen = (theory or theory_for(imported)).replace(**choices or {})
    left = seconds_left(log, imported)
    allowed = (
        max(left * (1 - LADDER if with_ladder else 1), LEAST) if time_limit is None else time_limit
    )
    notes = imported.notes
    climbed: list[Rung] = []

    def outcome(solution: Solution, interrupted: bool = True) -> LogMap:
        said = (*notes, INTERRUPTED) if interrupted else notes
        return LogMap(
            log, imported, solution, tuple(climbed), dict(seconds), allowed, said, interrupted
        )

    mapping.known = lambda: outcome(mapping.snapshot())
    begin = time.process_time()
    solution = mapping.solve(imported.trace, chosen, time_limit=allowed, max_maps=max_maps)
    if (
        solution.status is Status.UNSATISFIABLE
        and theory is None
        and not {"star", "boundary", "level"} & set(choices or ())
    ):
        bare = BARE.replace(**choices or {})
        if bare != chosen:
            chosen, notes = bare, (*notes, NO_STARS)
            solution = mapping.solve(imported.trace, chosen, time_limit=allowed, max_maps=max_maps)
    mapping.known = lambda: outcome(solution)
    seconds["maps"] = round(time.process_time() - begin, 3)
    if with_ladder and not mapping.interrupted:
        begin, stars = time.process_time(), chosen.star != "none"
        share = (left - seconds["maps"]) / len(list(rungs(imported.trace, chosen, stars)))
        most = min(max(share, LEAST_RUNG), RUNG)
        climbed += ladder(
            imported.trace,
            chosen,
            time_limit=most,
            max_maps=1,
            stars=stars,
            known=solution,
            under_way=mapping,
        )
        seconds["ladder"] = round(time.process_time() - begin, 3)
    return outcome(solution, mapping.interrupted)
