"""Write the report of a run as an HTML page.

It shows the map over the laser scans, the ladder (the maps with fewer kinds of evidence), faults
(steps that the map treats as wrong), rival maps, and times. Scans are drawn at corrected poses if
the log has them. The map itself was made without corrected poses.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from perception.places.importing import Imported
from perception.readers.scans import Pose, RobotLog
from ssh_abduction.checker.joins import sentence_of
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.odometry import between, moved
from ssh_abduction.data.words import counted
from ssh_abduction.evaluation.ladder import Rung
from ssh_abduction.output.drawing import COLOURS, escaped, page, text
from ssh_abduction.solver import Solution, Status

Array = NDArray[np.float64]
Point = tuple[float, float]

# The picture has at most one point of a wall in each square with sides of this many metres.
GRAIN = 0.2
# A metre has this many units of the page, or fewer, so that the picture is at most LARGEST wide.
METRE, LARGEST = 14.0, 1500.0
# Beams longer than this many metres are not drawn: their ends are too far apart to show a wall.
DRAWN = 12.0

STYLE = """
:root { color-scheme: light dark; --ink: #1c1c1c; --paper: #ffffff; --line: #c8c8c8 }
@media (prefers-color-scheme: dark) { :root { --ink: #e6e6e6; --paper: #16181c; --line: #44484f } }
body { font: 15px/1.5 system-ui, sans-serif; color: var(--ink); background: var(--paper) }
body { max-width: 70rem; margin: 2rem auto; padding: 0 1rem }
table { border-collapse: collapse; display: block; overflow-x: auto }
th, td { border-bottom: 1px solid var(--line); padding: .2rem .8rem .2rem 0; text-align: left }
figure { margin: 1rem 0; background: white; border: 1px solid var(--line) }
figure svg { width: 100%; height: auto; display: block }
figcaption { color: #333; padding: .4rem .6rem }
code { overflow-wrap: anywhere }
"""


def report(
    log: RobotLog,
    imported: Imported,
    solution: Solution,
    rungs: Sequence[Rung],
    run: Mapping[str, Any],
) -> str:
    """Make the page as the text of an HTML file that loads no other file.

    Args:
        log: The robot's log, with its scans.
        imported: The trace of the log, and how it was made.
        solution: The minimal maps.
        rungs: The rungs of the ladder, each with one more kind of evidence; empty without a ladder.
        run: The contents of run.json.
    """
    name = imported.trace.name or "log"
    parts = [
        f"<h1>{escaped(name)}</h1>",
        *map(_paragraph, [_summary(solution, run), *run["notes"]]),
        _figure(log, imported, solution),
        "<h2>What each kind of evidence is worth</h2>" + _ladder(rungs) if rungs else "",
        "<h2>Rival maps</h2>" + _paragraph(solution.summary or "There is no other minimal map.")
        if solution.maps
        else "",
        "<h2>What the map disbelieves</h2>" + _faults(solution) if solution.maps else "",
        "<h2>Settings</h2>" + _settings(run),
        "<h2>Time</h2>" + _time(run),
        "<h2>The log</h2>" + _log(log, run),
        "<h2>Visits</h2>" + _visits(imported, solution),
    ]
    return (
        '<!DOCTYPE html>\n<html lang="en"><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width">'
        '<meta http-equiv="Content-Security-Policy" '
        "content=\"default-src 'none'; style-src 'unsafe-inline'\">"
        f"<title>{escaped(name)}</title><style>{STYLE}</style>\n"
        + "\n".join(part for part in parts if part)
        + "\n</html>\n"
    )


def _summary(solution: Solution, run: Mapping[str, Any]) -> str:
    """Say in two sentences how long the log is, and how large the map is."""
    log, cost = run["log"], solution.cost
    seen = (
        f"{log['scans']} scans on a way of {log['metres']:g} m; "
        f"{run['visits']} visits to distinctive places, {run['steps']} steps."
    )
    if cost is None:
        return f"{seen} No map of them: {solution.status.value}."
    if solution.status is not Status.OPTIMAL:
        proven = "a map without a proof that it is the best"
    elif solution.complete and solution.count == 1:
        proven = "one minimal map" if solution.weighed is None else "one map of least cost"
    else:
        proven = f"{'' if solution.complete else 'at least '}{solution.count} minimal maps"
    if solution.weighed is not None:
        proven += f"; {solution.weighed.sentence}"
    elif told := sentence_of(solution.by_minimality, solution.count):
        proven += f"; {told}"
    size = f"{cost.places} places, {cost.paths} paths, {cost.dstates} distinctive states"
    return f"{seen} {size}: {proven}."


def _figure(log: RobotLog, imported: Imported, solution: Solution) -> str:
    """Draw the first map over the scans, with a caption."""
    corrected = all(scan.corrected is not None for scan in log.scans)
    poses: list[Pose] = (
        [scan.corrected or (0.0, 0.0, 0.0) for scan in log.scans]
        if corrected
        else [_pose(row) for row in imported.track.poses]
    )
    walls = _walls(log, poses)
    # The middle of each visit, relative to the pose at which its scan is drawn.
    spots = {
        number: moved(
            poses[visit.scan],
            between(_pose(imported.track.poses[visit.scan]), (*_xy(visit.middle), 0.0)),
        )[:2]
        for number, visit in enumerate(imported.visits)
    }
    extent = 1.0
    if len(walls):
        extent = float(np.ptp(np.concatenate([walls, [p[:2] for p in poses]]), axis=0).max())
    unit = min(METRE, LARGEST / max(extent, 1.0))

    def on_page(point: Sequence[float]) -> Point:
        return point[0] * unit, -point[1] * unit

    dots = "".join(f"M{x * unit:.0f} {-y * unit:.0f}h0" for x, y in walls)
    way = " ".join(f"{x:.1f},{y:.1f}" for x, y in (on_page(pose[:2]) for pose in poses))
    width = max(GRAIN * unit * 0.7, 1)
    best = solution.maps[0] if solution.maps else None
    marks = [
        f'<path d="{dots}" stroke="#9a9a9a" stroke-width="{width:.1f}" stroke-linecap="round" '
        'fill="none"/>',
        f'<polyline points="{way}" fill="none" stroke="#b9c7d6" stroke-width="1"/>',
        *_streets(imported, best, {n: on_page(p) for n, p in spots.items()}),
    ]
    points = [on_page(p) for p in walls] + [on_page(p[:2]) for p in poses]
    picture = page(marks, points or [(0.0, 0.0)], margin=20)
    poses_said = (
        "corrected poses of the log, which were not read for the map"
        if corrected
        else "the poses of the track, which drifts"
    )
    caption = (
        f"The {'first map' if solution.maps else 'visits'} over the scans, at {poses_said}. "
        "Numbers are places; small dots are visits."
    )
    return f"<figure>{picture}<figcaption>{caption}</figcaption></figure>"


def _streets(
    imported: Imported, ssh_map: SSHMap | None, spots: Mapping[int, Point]
) -> Iterator[str]:
    """Draw the streets and the places of a map, or only the visits without a map.

    Args:
        imported: The trace, and how it was made.
        ssh_map: The map; None if there is none.
        spots: The point of each visit on the page.
    """
    trace = imported.trace
    if ssh_map is None:
        yield from (
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" fill="#d55e00"/>' for x, y in spots.values()
        )
        return
    of_label = {state.id: state for state in ssh_map.dstates}
    visit_of = [int(step.extra["visit"]) for step in trace.steps]
    place_of = {
        visit: of_label[label].place for visit, label in zip(visit_of, ssh_map.labels, strict=True)
    }
    # A place is drawn at the mean of its visits.
    visited: dict[int | None, list[Point]] = {}
    for visit, place in place_of.items():
        visited.setdefault(place, []).append(spots[visit])
    middle = {
        place: (float(np.mean([x for x, _ in at])), float(np.mean([y for _, y in at])))
        for place, at in visited.items()
    }
    for (t, before), (_, after) in pairwise(enumerate(ssh_map.labels)):
        if trace.actions[t].kind == "travel":
            a, b = (middle[of_label[label].place] for label in (before, after))
            colour = COLOURS[(of_label[before].path or 0) % len(COLOURS)]
            yield (
                f'<path d="M{a[0]:.1f} {a[1]:.1f}L{b[0]:.1f} {b[1]:.1f}" stroke="{colour}" '
                'stroke-width="5" stroke-opacity=".75" fill="none"/>'
            )
    yield from (f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3" fill="#444"/>' for x, y in spots.values())
    for place, (x, y) in middle.items():
        if place is not None:
            yield (
                f'<circle cx="{x:.1f}" cy="{y:.1f}" r="11" fill="white" stroke="#222" '
                'stroke-width="2"/>' + text(x, y, str(place), "#222", 12, "bold")
            )


def _walls(log: RobotLog, poses: Sequence[Pose]) -> Array:
    """Find the walls: one point, in metres, for each square in which a laser beam ended, (n, 2).

    The squares have sides of GRAIN metres. In a log of more than 100 scans, at least two beams must
    have ended in a square, so that few stray beams are drawn.

    Args:
        log: The robot's log.
        poses: The pose of each scan.
    """
    found = []
    for scan, pose in zip(log.scans, poses, strict=True):
        x, y, heading = moved(pose, scan.laser.mount)
        near = np.isfinite(scan.ranges) & (scan.ranges < min(DRAWN, scan.laser.reach))
        angles = heading + scan.laser.bearings[near]
        found.append(
            np.stack(
                [x + scan.ranges[near] * np.cos(angles), y + scan.ranges[near] * np.sin(angles)],
                axis=1,
            )
        )
    cells = np.rint(np.concatenate(found) / GRAIN).astype(int)
    kept, counts = np.unique(cells, axis=0, return_counts=True)
    return np.asarray(kept[counts > (1 if len(log) > 100 else 0)] * GRAIN)


def _ladder(rungs: Sequence[Rung]) -> str:
    """Make the table of the ladder. Each rung is a row, with one more kind of evidence."""
    rows = []
    for rung in rungs:
        cost = rung.solution.cost
        counts = (cost.dstates, cost.places, cost.paths) if cost else ("–", "–", "–")
        rows.append(
            (rung.name, rung.solution.status.value, *counts, f"{rung.solution.seconds.total:.1f} s")
        )
    return _table(("evidence", "status", "dstates", "places", "paths", "time"), rows)


def _faults(solution: Solution) -> str:
    """Make the table of the steps that the first map treats as wrong."""
    faults = solution.maps[0].faults
    if not faults:
        allowed = solution.theory.misread or solution.theory.slipped or solution.theory.jumped
        return _paragraph(
            "Nothing." if allowed else "Nothing: the theory allows no faults (--misread 4 would)."
        )
    return _table(
        ("step", "what", "seen", "cost"), [(f.step, f.kind, f.seen, f.cost) for f in faults]
    )


def _settings(run: Mapping[str, Any]) -> str:
    """Make the table of the settings: what counts as a place, and the theory."""
    theory = ", ".join(
        f"{name} {value}"
        for name, value in run["theory"].items()
        if value not in (None, False, [], 0)
    )
    rows = [
        ("places", "junctions, turning points", "where the ways of the free space part"),
        ("width", f"{run['width']:g} m", "of the robot; narrower parts are no ways"),
        ("theory", theory, "the axioms, and the choices in them"),
    ]
    return _table(("", "", ""), rows)


def _time(run: Mapping[str, Any]) -> str:
    """Make the table of the processor time of each stage, and compare it with the drive."""
    total = math.fsum(run["seconds"].values())
    rows = [
        (stage, f"{seconds:.2f} s", f"{100 * seconds / max(total, 1e-9):.0f} %")
        for stage, seconds in run["seconds"].items()
    ]
    told = f"All stages together took {total:.1f} s of processor time"
    if run["drove"]:
        share = f"a share of 1/{run['drove'] / max(total, 1e-9):.0f}"
        told = f"The robot drove {run['drove']:.0f} s. {told}, {share}"
    return _table(("stage", "processor", "share"), rows) + _paragraph(
        f"{told}. The search for the minimal maps had {run['limit']:g} s at most."
    )


def _log(log: RobotLog, run: Mapping[str, Any]) -> str:
    """List what the reader of the log noticed: its format, notes, and damaged parts."""
    said = [f"{log.source}: {log.format}, {len(log)} scans.", *log.notes]
    if log.damaged:
        said.append(
            f"Skipped: {counted(len(log.damaged), 'damaged parts')} of the log. The first ones:"
        )
        said += [f"{damage.line}: {damage.what}" for damage in log.damaged[:10]]
    return "<ul>" + "".join(f"<li>{escaped(line)}</li>" for line in said) + "</ul>"


def _visits(imported: Imported, solution: Solution) -> str:
    """Make a table with a row for each step: what was seen and done, and its dstate and place."""
    labels = solution.maps[0].labels if solution.maps else None
    states = {state.id: state for state in solution.maps[0].dstates} if solution.maps else {}
    rows = []
    for t, step in enumerate(imported.trace.steps):
        state = states[labels[t]] if labels else None
        # A question mark means that it is uncertain what was seen.
        star = " ".join(
            "?"
            if entry is None
            else f"{entry:g}"
            if isinstance(entry, int | float)
            else f"{entry.bearing:g}°{'' if entry.open else '?'}"
            for entry in step.star or ()
        )
        rows.append(
            (
                t,
                step.extra["visit"],
                step.extra["scan"],
                "?" if step.view is None else step.view,
                star,
                step.action.name if step.action else "",
                state.id if state else "–",
                "–" if state is None or state.place is None else state.place,
            )
        )
    return _table(("step", "visit", "scan", "view", "star", "action", "dstate", "place"), rows)


def _table(head: Iterable[object], rows: Iterable[Iterable[object]]) -> str:
    titles = "".join(f"<th>{escaped(str(cell))}</th>" for cell in head)
    body = "".join(
        "<tr>" + "".join(f"<td>{escaped(str(cell))}</td>" for cell in row) + "</tr>" for row in rows
    )
    return f"<table><tr>{titles}</tr>{body}</table>"


def _paragraph(told: str) -> str:
    return f"<p>{escaped(told)}</p>"


def _pose(row: Array) -> Pose:
    x, y, heading = row
    return float(x), float(y), float(heading)


def _xy(middle: Array) -> Point:
    x, y = middle
    return float(x), float(y)
