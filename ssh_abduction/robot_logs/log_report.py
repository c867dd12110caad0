"""Write the report of a run as an HTML page.

It shows the map over the laser scans, the ladder (the maps with fewer kinds of evidence), faults
(steps that the map treats as wrong), rival maps, and times. Scans are drawn at corrected poses if
the log has them. The map itself was made without corrected poses.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from perception.places.importing import Imported
from perception.readers.scans import RobotLog
from ssh_abduction.building.telling import told
from ssh_abduction.data.drives import drives_of
from ssh_abduction.data.errors import TheoryError
from ssh_abduction.data.files import filled
from ssh_abduction.data.words import counted
from ssh_abduction.output.cards import html_table, html_text, paragraph
from ssh_abduction.output.roads import place_of_steps
from ssh_abduction.rivals.listing import Listing, joins_of_drives
from ssh_abduction.robot_logs.log_picture import figure
from ssh_abduction.solver import Solution, Status

_table = partial(html_table, is_whole=True)
TEMPLATE = Path(__file__).parent / "report.html"


def report(
    log: RobotLog,
    imported: Imported,
    solution: Solution,
    run: Mapping[str, Any],
) -> str:
    """Make the page as the text of an HTML file that loads no other file."""
    name = imported.trace.name or "log"
    parts = [
        f"<h1>{html_text(name)}</h1>",
        *map(
            paragraph,
            [solution.verdict, _summary(solution, run), *run["notes"], *solution.warnings],
        ),
        figure(log, imported, solution),
        *_drives(imported, solution, run),
        *_building(solution),
        "<h2>Doubtful joins</h2>" + _doubts(solution)
        if solution.weighed and not solution.weighed.doubt
        else "",
        "<h2>Rival maps</h2>" + paragraph(f"{solution.summary}.")
        if solution.status is Status.OPTIMAL
        else "",
        _faults(solution) if solution.maps else "",
        "<h2>Settings</h2>" + _settings(run),
        "<h2>Time</h2>" + _time(run),
        "<h2>The log</h2>" + _log(log),
    ]
    body = "\n".join(part for part in parts if part)
    return filled(TEMPLATE, name=html_text(name), body=body)


def may_misread(solution: Solution) -> bool:
    """Check whether the theory of a solution forbids misread views, but could allow them."""
    try:
        return not solution.theory.misread and bool(solution.theory.replace(misread=4))
    except TheoryError:
        return False


def _summary(solution: Solution, run: Mapping[str, Any]) -> str:
    """Say in two sentences how long the log is, and how large the map is."""
    log, cost = run["log"], solution.cost
    seen = (
        f"{counted(log['scans'], 'scans')} along {log['metres']:g} m; "
        f"{counted(run['visits'], 'visits')} to distinctive places, "
        f"{counted(run['steps'], 'steps')}."
    )
    if cost is None:
        return seen
    paths = f", {counted(cost.paths, 'paths')}" if cost.paths else ""
    dstates = counted(cost.dstates, "distinctive states")
    size = f"{counted(cost.places, 'places')}{paths}, {dstates}"
    sure = f"; {solution.sureness}" if solution.sureness else ""
    return f"{seen} {size}{sure}."


def _drives(imported: Imported, solution: Solution, run: Mapping[str, Any]) -> Iterator[str]:
    """Make a table of the drives, and a table of the places that drives have in common."""
    drives = drives_of(imported.trace)
    if len(drives) < 2 or not solution.maps:
        return
    places = place_of_steps(solution.maps[0])
    at = [set(places[drive.first : drive.stop]) - {None} for drive in drives]
    rows = []
    for k, (drive, one) in enumerate(zip(drives, run["drives"], strict=True)):
        others = set().union(*at[:k], *at[k + 1 :])
        counts = (one["scans"], f"{one['metres']:g} m", one["visits"], one["steps"])
        rows.append((drive.name, *counts, len(at[k]), len(at[k] & others)))
    joined = solution.joined[0].upper() + solution.joined[1:]
    head = ("drive", "scans", "way", "visits", "steps", "places", "shared with other drives")
    yield "<h2>Drives</h2>" + _table(head, rows) + paragraph(f"{joined}.")
    yield "<h2>Joins between drives</h2>" + _joins_of_drives(solution)


def _building(solution: Solution) -> Iterator[str]:
    """List the corridors, rooms and doors of the first map."""
    if solution.maps and (lines := [line.strip() for line in told(solution.maps[0])]):
        items = "".join(f"<li>{html_text(line)}</li>" for line in lines)
        yield f"<h2>Corridors, rooms and doors</h2><ul>{items}</ul>"


def _joins_of_drives(solution: Solution) -> str:
    """Make the table of the places that two drives have in common, with their probabilities."""
    pairs = joins_of_drives(Listing.of(solution))
    rows = [
        (f"{pair.first}:{join.first}", f"{pair.second}:{join.second}", pair.how_sure(join))
        for pair in pairs
        for join in (*pair.forced, *pair.possible)
    ]
    alone = [str(pair) for pair in pairs if not pair.forced and not pair.possible]
    head = ("step", "and step", "how sure")
    return (_table(head, rows) if rows else "") + "".join(paragraph(f"{one}.") for one in alone)


def _doubts(solution: Solution) -> str:
    """Make the table of the joins of the first map that are not sure."""
    doubts = solution.weighed.doubtful if solution.weighed else None
    if doubts is None:
        return paragraph(
            "Unknown: a map that costs less may exist, with other joins. To search longer, use "
            "--time-limit."
        )
    if not doubts:
        return paragraph(
            "None: each two visits that the first map puts at one place are there with a "
            "probability of at least 0.95. Which way they faced may be less sure."
        )
    places = place_of_steps(solution.maps[0])
    rows = [(first, second, places[second], f"{share:.2f}") for first, second, share in doubts]
    return _table(("step", "and step", "place", "probability"), rows)


def _faults(solution: Solution) -> str:
    """List what changed between drives, or the steps that the first map treats as wrong."""
    faults, theory = solution.maps[0].faults, solution.theory
    rows = [(f.step, str(f), f.cost) for f in faults]
    found = _table(("step", "what", "cost"), rows) if rows else paragraph("Nothing.")
    if theory.changed:
        return "<h2>What changed between drives</h2>" + found
    if not (theory.misread or theory.slipped or theory.jumped):
        would = " (--set misread=4 would)" if may_misread(solution) else ""
        found = paragraph(f"Nothing: the theory allows no faults{would}.")
    return "<h2>What the map treats as wrong</h2>" + found


def _settings(run: Mapping[str, Any]) -> str:
    """Make the table of the settings: what is a place, the width of the robot, the theory."""
    told = ((n, value) for n, value in run["theory"].items() if value not in (None, False, [], 0))
    theory = "; ".join(f"{name}={_setting(value)}" for name, value in told)
    rows = [
        ("width", f"{run['width']:g} m", "of the robot; it cannot pass narrower parts"),
        ("theory", theory, "which axioms hold, and what is minimised"),
    ]
    return _table(("", "", ""), rows)


def _setting(value: Any) -> str:
    """Write the value of a field of a theory as after --set."""
    if isinstance(value, list):
        return ",".join(map(_setting, value))
    return str(value).lower() if isinstance(value, bool) else str(value)


def _time(run: Mapping[str, Any]) -> str:
    """Make the table of the processor time of each stage, and compare it with the drive."""
    total = math.fsum(run["seconds"].values())
    rows = [
        (stage, f"{seconds:.2f} s", f"{100 * seconds / max(total, 1e-9):.0f} %")
        for stage, seconds in run["seconds"].items()
    ]
    text = f"All stages together took {total:.1f} s of processor time"
    if run["drove"]:
        share = f"1/{run['drove'] / max(total, 1e-9):.0f} of the duration of the drive"
        text = f"The robot drove {run['drove']:.0f} s. {text}, which is {share}"
    return _table(("stage", "processor", "share"), rows) + paragraph(
        f"{text}. The search for the minimal maps had {run['limit']:g} s at most."
    )


def _log(log: RobotLog) -> str:
    """List what the reader of the log noticed: its format, notes, and damaged parts."""
    said = [f"{log.source}: {log.format}, {counted(len(log), 'scans')}.", *log.sources, *log.notes]
    if log.damaged:
        said.append(
            f"Skipped: {counted(len(log.damaged), 'damaged parts')} of the log. The first ones:"
        )
        said += [f"{damage.line}: {damage.what}" for damage in log.damaged[:10]]
    return "<ul>" + "".join(f"<li>{html_text(line)}</li>" for line in said) + "</ul>"
