"""Maps as text for a terminal."""

from __future__ import annotations

from collections.abc import Sequence

from ssh_abduction.errors import printable
from ssh_abduction.explain import Explanation
from ssh_abduction.maps import SSHMap
from ssh_abduction.solver.result import Solution, Status
from ssh_abduction.theory.evidence import evidence_of
from ssh_abduction.trace import Trace


def headline(solution: Solution, count: int, explanation: Explanation | None) -> str:
    """How a search ended, on one line. `count` is how many maps it found, of which the solution need not hold any."""
    if explanation:
        return f"{solution.status.value}: {explanation}"
    if solution.status is Status.UNSATISFIABLE and not solution.stopped:
        kinds = ", ".join(evidence.name for evidence in evidence_of(solution.theory))
        return f"unsatisfiable: no map satisfies the axioms: those that clingo found are refused as wholes, by evidence ({kinds})"
    if solution.status is Status.UNSATISFIABLE:
        return f"unsatisfiable: no map satisfies the axioms; why was not found out in time ({solution.stopped})"
    why = f" ({solution.stopped})" if solution.stopped else ""
    seconds = f"{solution.seconds.total:.2f} s, {solution.prefix} of {solution.steps} steps given to clingo"
    bound = ", ".join(f"at least {counted(v, k)}" for k, v in solution.bound.to_dict().items())
    if solution.cost is None:
        return f"{solution.status.value}{why}: no map of all {solution.steps} steps yet; any has {bound or 'no proven bound'}; {seconds}"
    counts = ", ".join(counted(v, k) for k, v in solution.cost.to_dict().items())
    if solution.status is Status.FEASIBLE:
        return f"feasible{why}: {counts}, not proven minimal; any map has {bound or 'no proven bound'}; {seconds}"
    return f"optimal: {counts}; {counted(count, 'minimal maps')}{'' if solution.complete else f', and there may be more{why}'}; {seconds}"


def counted(number: int, things: str) -> str:
    """8 dstates, 1 dstate."""
    return f"{number} {things.removesuffix('s') if number == 1 else things}"


def table(head: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Columns aligned under a head. What would break the table, or steer the terminal, is escaped."""
    cells = [[*head], *([printable(str(cell)) for cell in row] for row in rows)]
    widths = [max(len(row[i]) for row in cells) for i in range(len(head))]
    return "\n".join("  " + "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in cells)


def describe(ssh_map: SSHMap) -> str:
    """A map: its paths with their places in order, and its dstates with where they are and where actions lead."""
    parts = []
    if ssh_map.paths:
        parts += [f"  path {p.id}: places {' – '.join(map(str, p.order))}" for p in ssh_map.paths]
    if ssh_map.excused:
        parts += [f"  excused from sides: paths {h} and {g}" for h, g in ssh_map.excused]
    leads: dict[int, list[str]] = {}
    for source, action, target in ssh_map.links:
        leads.setdefault(source, []).append(f"{action} → {target}")
    rows = [
        [s.id, s.view, "" if s.place is None else s.place, course(s.path, s.direction), ", ".join(leads.get(s.id, []))]
        for s in ssh_map.dstates
    ]
    if any(s.place is not None for s in ssh_map.dstates):
        parts.append(table(["dstate", "view", "place", "path", "links"], rows))
    else:
        parts.append(table(["dstate", "view", "links"], [[row[0], row[1], row[4]] for row in rows]))
    return "\n".join(parts)


def course(path: int | None, direction: int | None) -> str:
    """A path and the direction along it: 2+ or 2-."""
    return "" if path is None else f"{path}{'+' if direction == 1 else '-'}"


def differences(maps: Sequence[SSHMap], trace: Trace) -> str:
    """The steps at which the maps disagree, and on what. A dstate, place or path is named by the first step at it."""
    named = [_named(ssh_map) for ssh_map in maps]
    rows: list[list[object]] = []
    for t, step in enumerate(trace.steps):
        for i, sort in enumerate(("dstate", "place", "path")):
            cells = [names[t][i] for names in named]
            if len(set(cells)) > 1:
                rows.append([t, step.view, sort, *("none" if c is None else "new" if c == t else f"of step {c}" for c in cells)])
    return table(["step", "view", "", *(f"map {i + 1}" for i in range(len(maps)))], rows)


def _named(ssh_map: SSHMap) -> list[tuple[int | None, int | None, int | None]]:
    """For each step the first steps at its dstate, at its place, and along its path."""
    first: dict[tuple[str, int], int] = {}
    found: list[tuple[int | None, int | None, int | None]] = []
    for t, label in enumerate(ssh_map.labels):
        s = ssh_map.dstates[label]
        dstate, place, path = (
            None if name is None else first.setdefault((sort, name), t)
            for sort, name in (("dstate", s.id), ("place", s.place), ("path", s.path))
        )
        found.append((dstate, place, path))
    return found
