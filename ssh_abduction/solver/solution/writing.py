"""Write solutions: the summary in words, and the JSON that `solve --json` prints."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any

from ssh_abduction.data.drives import drives_of, with_fingerprints
from ssh_abduction.data.map_file import SOLUTION_FORMAT, VERSION
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.output import cards
from ssh_abduction.solver.solution.sharing import Backbone
from ssh_abduction.solver.values import Cost, Status
from ssh_abduction.theory.theory import Theory

if TYPE_CHECKING:
    from ssh_abduction.solver.solution.result import Solution


def summary_of(solution: Solution, count: int, backbone: Backbone | None) -> str:
    """Say in one sentence how many minimal maps there are, and in which steps they differ.

    `count` maps were found. They need not be in the solution.
    """
    if solution.status is Status.UNSATISFIABLE:
        return "no map satisfies the axioms"
    if backbone is None:
        return "a map that is not proven minimal" if solution.cost else "no map was found"
    minimal = solution.levels[0].count if solution.levels else count
    listed = solution.minimal_listed
    kind = "minimal map" if solution.weighed is None else "map"
    text = f"{'' if listed else 'at least '}{minimal} {kind}{'' if minimal == 1 else 's'}"
    text += "" if solution.weighed is None else " of least cost"
    if not listed:
        text += (
            f" (listing was stopped by the {solution.stopped})"
            if solution.stopped != "interrupted"
            else " (listing was interrupted)"
        )
    # A single map differs from no other one.
    if not (listed and minimal == 1):
        text += f": {replace(backbone, drives=solution.drives).sentence}" + (
            "" if backbone.proven else ", as far as is known: other maps may differ in more"
        )
    more = sum(level.count for level in solution.levels[1:])
    unit = "nats " if solution.weighed else ""
    text += f"; and {more} with up to {solution.within} {unit}more" if more else ""
    return text + (f"; {solution.weighed.sentence}" if solution.weighed else "")


def opening(theory: Theory, steps: int, within: int) -> dict[str, Any]:
    """Return the fields of a solution's JSON that come before the maps."""
    head = {
        "format": SOLUTION_FORMAT,
        "version": VERSION,
        "theory": theory.to_dict(),
        "steps": steps,
    }
    return {**head, **({"within": within} if within else {})}


def written_map(ssh_map: SSHMap, cost: Cost | None = None) -> dict[str, Any]:
    """Return a map as plain data, as it is in a solution's JSON, perhaps with a cost."""
    return ssh_map.to_dict() | ({"cost": cost.to_dict()} if cost else {})


def written_trace(trace: Trace) -> dict[str, Any]:
    """Return the lines of a trace file without images, for the file of a solution."""
    steps = tuple(replace(step, image=None, truth=None) for step in trace.steps)
    bare = replace(trace, steps=steps, images=None, drive=drives_of(trace)[0].name)
    return {"trace": [json.loads(line) for line in bare.to_lines()]}


def ending(solution: Solution, count: int, backbone: Backbone | None) -> dict[str, Any]:
    """Return the fields of a solution's JSON that come after the maps.

    `count` maps were written. The solution need not hold them.
    """
    end: dict[str, Any] = {
        "status": solution.status.value,
        "complete": solution.complete,
        "count": count,
        "cost": solution.cost.to_dict() if solution.cost else None,
        "bound": solution.bound.to_dict(),
        "prefix": solution.effort.prefix,
        "grounding": asdict(solution.effort.grounding),
        "seconds": {
            k: round(getattr(solution.seconds, k), 6) for k in ("total", "ground", "solve")
        },
    }
    end["summary"] = summary_of(solution, count, backbone)
    recorded = solution.support.recorded
    drives = () if recorded is None else recorded.drives
    if recorded is None and solution.trace is not None:
        drives = with_fingerprints(solution.trace)
    if onto := solution.support.onto or (() if recorded is None else recorded.onto):
        end["onto"] = list(onto)
    if drives:
        end["drives"] = [drive.to_dict() for drive in drives]
    # Leave out fields that would say nothing.
    if backbone and not (solution.minimal_listed and count == 1):
        end["backbone"] = backbone.to_dict()
    if solution.within:
        end["levels"] = [level.to_dict() for level in solution.levels]
        if solution.minimal_listed and not solution.complete:
            end["minimal_listed"] = True
    if recorded is not None and recorded.written_certificate is not None:
        end["certificate"] = dict(recorded.written_certificate)
    elif solution.certificate:
        end["certificate"] = solution.certificate.to_dict(solution.trace)
    if solution.weighed is not None:
        end["weighed"] = solution.weighed.to_dict()
    if joins := solution.by_minimality:
        end["by_minimality"] = [join.to_dict() for join in joins]
    if solution.stopped:
        end["stopped"] = solution.stopped
    if solution.partial:
        end["partial"] = solution.partial.to_dict()
    if solution.effort.evidence:
        end["evidence"] = {name: dict(said) for name, said in solution.effort.evidence.items()}
    if solution.warnings:
        end["warnings"] = list(solution.warnings)
    if recorded is not None and recorded.explanation is not None:
        end["explanation"] = dict(recorded.explanation)
    return end


def table_of_maps(solution: Solution) -> str:
    """Return an HTML table with a row for each map: its counts, and perhaps its chi-square."""
    costs = solution.costs
    chi2 = [ssh_map.fit.chi2 if ssh_map.fit else None for ssh_map in solution.maps]
    columns: dict[str, list[object]] = {"map": [*range(1, solution.count + 1)]}
    columns |= {
        name: [getattr(cost, name) for cost in costs]
        for name in ("dstates", "places", "paths", "excuses", "faults")
    }
    columns |= {"chi-square": ["" if chi is None else f"{chi:.1f}" for chi in chi2]}
    # Columns of zeros are left out.
    shown = {name: column for name, column in columns.items() if any(column)}
    return cards.html_table([*shown], zip(*shown.values(), strict=True), "maps")
