"""Write what the page tells of a run, below its map, as plain data: tables and sentences.

It tells of drives, of corridors and rooms, of doubtful joins, of faults (steps that the map treats
as wrong), of the settings, of times, and of the log.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

from perception.places.importing import Imported
from perception.readers.scans import RobotLog
from ssh_abduction.building.telling import told
from ssh_abduction.data.drives import drives_of
from ssh_abduction.data.errors import TheoryError
from ssh_abduction.data.words import counted
from ssh_abduction.output.roads import place_of_steps
from ssh_abduction.page.content import Section
from ssh_abduction.rivals.listing import Listing, joins_of_drives
from ssh_abduction.solution import Solution, Status

OF_LOG = "The log"  # the title of the section that does not depend on the map


def report(
    log: RobotLog, imported: Imported, solution: Solution, run: Mapping[str, Any]
) -> tuple[Section, ...]:
    """Make the sections of the report of a run. `run` is what run.json has."""
    return tuple(_sections(log, imported, solution, run))


def _sections(
    log: RobotLog, imported: Imported, solution: Solution, run: Mapping[str, Any]
) -> Iterator[Section]:
    yield Section("Summary", (_summary(solution, run), *run["notes"]))
    yield from _drives(imported, solution, run)
    if solution.maps and (lines := [line.strip() for line in told(solution.maps[0])]):
        yield Section("Corridors, rooms and doors", lines)
    if solution.weighed and not solution.weighed.doubt:
        yield _doubts(solution)
    if solution.status is Status.OPTIMAL:
        yield Section("Rival maps", (f"{solution.summary}.",))
    if solution.maps:
        yield _faults(solution)
    yield _settings(run)
    yield _time(run)
    yield Section(OF_LOG, _log(log))


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


def _drives(imported: Imported, solution: Solution, run: Mapping[str, Any]) -> Iterator[Section]:
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
    yield Section("Drives", (f"{joined}.",), (head, *rows))
    yield _joins_of_drives(solution)


def _joins_of_drives(solution: Solution) -> Section:
    """Make the table of the places that two drives have in common, with their probabilities."""
    pairs = joins_of_drives(Listing.of(solution))
    rows = [
        (f"{pair.first}:{join.first}", f"{pair.second}:{join.second}", pair.how_sure(join))
        for pair in pairs
        for join in (*pair.forced, *pair.possible)
    ]
    alone = [str(pair) for pair in pairs if not pair.forced and not pair.possible]
    head = ("step", "and step", "how sure")
    table = (head, *rows) if rows else ()
    return Section("Joins between drives", [f"{one}." for one in alone], table)


def _doubts(solution: Solution) -> Section:
    """Make the table of the joins of the first map that are not sure."""
    doubts = solution.weighed.doubtful if solution.weighed else None
    if not doubts:
        said = (
            "Unknown: a map that costs less may exist, with other joins. To search longer, use "
            "--time-limit."
            if doubts is None
            else "None: each two visits that the first map puts at one place are there with a "
            "probability of at least 0.95. Which way they faced may be less sure."
        )
        return Section("Doubtful joins", (said,))
    places = place_of_steps(solution.maps[0])
    rows = [(first, second, places[second], f"{share:.2f}") for first, second, share in doubts]
    return Section("Doubtful joins", (), (("step", "and step", "place", "probability"), *rows))


def _faults(solution: Solution) -> Section:
    """List what changed between drives, or the steps that the first map treats as wrong."""
    faults, theory = solution.maps[0].faults, solution.theory
    title = "What changed between drives" if theory.changed else "What the map treats as wrong"
    if faults:
        rows = ((f.step, str(f), f.cost) for f in faults)
        return Section(title, (), (("step", "what", "cost"), *rows))
    if theory.changed or theory.misread or theory.slipped or theory.jumped:
        return Section(title, ("Nothing.",))
    would = " (--set misread=4 would)" if may_misread(solution) else ""
    return Section(title, (f"Nothing: the theory allows no faults{would}.",))


def _settings(run: Mapping[str, Any]) -> Section:
    """Make the table of the settings: the width of the robot, and the theory."""
    told = ((n, value) for n, value in run["theory"].items() if value not in (None, False, [], 0))
    theory = "; ".join(f"{name}={_setting(value)}" for name, value in told)
    rows = [
        ("setting", "value", "meaning"),
        ("width", f"{run['width']:g} m", "of the robot; it cannot pass narrower parts"),
        ("theory", theory, "which axioms hold, and what is minimised"),
    ]
    return Section("Settings", (), rows)


def _setting(value: Any) -> str:
    """Write the value of a field of a theory as after --set."""
    if isinstance(value, list):
        return ",".join(map(_setting, value))
    return str(value).lower() if isinstance(value, bool) else str(value)


def _time(run: Mapping[str, Any]) -> Section:
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
    said = f"{text}. The search for the minimal maps had {run['limit']:g} s at most."
    return Section("Time", (said,), (("stage", "processor", "share"), *rows))


def _log(log: RobotLog) -> list[str]:
    """List what the reader of the log noticed: its format, notes, and damaged parts."""
    said = [f"{log.source}: {log.format}, {counted(len(log), 'scans')}.", *log.sources, *log.notes]
    if log.damaged:
        said.append(
            f"Skipped: {counted(len(log.damaged), 'damaged parts')} of the log. The first ones:"
        )
        said += [f"{damage.line}: {damage.what}" for damage in log.damaged[:10]]
    return said
