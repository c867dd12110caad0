"""From a robot's log to the minimal maps of the building, and to a folder that tells the whole run.

A building whose walls meet at right angles is mapped by the topological theory with stars. Elsewhere stars are too often misread, and what lies right of a path that bends is not to be said: there
displacements tell places apart, and no sides are asked for.
"""

from __future__ import annotations

import itertools
import json
import math
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from importlib.metadata import version
from statistics import median
from typing import Any

from perception.places.importing import Imported, import_log
from perception.readers.scans import RobotLog
from ssh_abduction.files import json_line
from ssh_abduction.log_report import report
from ssh_abduction.logs import log_of
from ssh_abduction.rivals.page.html import view_page
from ssh_abduction.rungs import Rung, ladder
from ssh_abduction.solver.result import Solution
from ssh_abduction.solver.search import solve
from ssh_abduction.theory.theory import Theory

_log = log_of(__name__)

# Seconds for all minimal maps, and for each rung of the ladder.
LIMIT, RUNG = 60.0, 10.0
# So many minimal maps are listed, and ranked by how well they close.
MAPS = 300
# Times between scans that are longer than so many times the usual one are gaps of the log, or clocks that jumped: they do not count as driving.
GAP = 20.0


@dataclass(frozen=True, eq=False)
class LogMap:
    """What became of a log.

    log       the scans
    imported  the trace, and how it was made
    solution  its minimal maps, in the order of how well they close
    rungs     what each kind of evidence is worth; empty where that was not asked
    seconds   processor time of each stage, from the track on
    """

    log: RobotLog
    imported: Imported
    solution: Solution
    rungs: tuple[Rung, ...]
    seconds: Mapping[str, float]

    @property
    def drove(self) -> float | None:
        """Seconds that the robot drove, by the clock of the log; None where its times are cut, wrapped or missing."""
        times = [scan.time for scan in self.log.scans if scan.time is not None]
        steps = [later - earlier for earlier, later in itertools.pairwise(times)]
        if not steps or any(step < 0 for step in steps) or sum(step > 0 for step in steps) < len(steps) / 2:
            return None
        usual = median(step for step in steps if step > 0)
        return math.fsum(step for step in steps if step < GAP * usual) or None

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
            "visits": len(self.imported.visits),
            "steps": len(trace),
            "status": solution.status.value,
            "complete": solution.complete,
            "count": solution.count,
            "cost": solution.cost.to_dict() if solution.cost else None,
            "ladder": [rung.to_dict() for rung in self.rungs],
            "seconds": dict(self.seconds),
            "drove": self.drove,
        }

    def files(self) -> dict[str, bytes]:
        """The folder of a run, by name: trace.jsonl, maps.json, page.html, report.html and run.json, which comes last."""
        trace, solution = self.imported.trace, self.solution
        found = {"trace.jsonl": "".join(f"{line}\n" for line in trace.to_lines()), "maps.json": f"{json_line(solution.to_dict())}\n"}
        if solution.maps:
            found["page.html"] = view_page(solution, trace).html
        found["report.html"] = report(self.log, self.imported, solution, self.rungs, self.to_dict())
        found["run.json"] = f"{json.dumps(self.to_dict(), indent=2, ensure_ascii=False)}\n"
        return {name: text.encode() for name, text in found.items()}


def theory_for(imported: Imported) -> Theory:
    """The theory that suits the walls of a building."""
    if imported.trace.extra["right_angles"]:
        return Theory.topological()
    return Theory.topological().replace(star="none", boundary="none")


def map_log(
    log: RobotLog,
    theory: Theory | None = None,
    *,
    choices: Mapping[str, Any] | None = None,
    gateway: float | None = None,
    radius: float | None = None,
    name: str | None = None,
    limit: float | None = LIMIT,
    maps: int = MAPS,
    rung_limit: float | None = RUNG,
) -> LogMap:
    """The minimal maps of a building, from a robot's log.

    theory           the axioms; `theory_for` chooses, where it is None
    choices          fields of Theory, laid over that: a choice about one thing leaves the others as they suit the log
    gateway, radius  metres, as in perception.places.scale.Scale; what the log suggests, where they are None
    limit            seconds for the minimal maps
    maps             so many of them are listed at most
    rung_limit       seconds for each rung of the ladder; None leaves the ladder out

    Raises LogError, and TheoryError for a theory that does not suit the trace.
    """
    imported = import_log(log, gateway, radius, name)
    seconds = dict(imported.seconds)
    _log.info("%d visits, %d steps", len(imported.visits), len(imported.trace))
    chosen = (theory or theory_for(imported)).replace(**choices or {})
    begin = time.process_time()
    solution = solve(imported.trace, chosen, limit=limit, maps=maps)
    seconds["maps"] = round(time.process_time() - begin, 3)
    begin = time.process_time()
    rungs: tuple[Rung, ...] = ()
    if rung_limit is not None:
        rungs = tuple(ladder(imported.trace, chosen, limit=rung_limit, maps=1, stars=chosen.star != "none", known=solution))
    seconds["ladder"] = round(time.process_time() - begin, 3)
    return LogMap(log, imported, solution, rungs, seconds)
