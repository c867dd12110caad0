"""Make the replays of the page: the steps of traces, with images and a localised robot's beliefs.

A belief gives the probability that the robot is at each dstate (a place and a heading) of a map.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

from ssh_abduction.data.errors import MapError
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Step, Trace
from ssh_abduction.page.images import drawn_images

BELIEVING = 5.0  # processor seconds for beliefs in all maps except the first
# The largest number of dstates of a belief that are shown, and their least probability.
BELIEVED, LEAST = 12, 0.01


@dataclass(frozen=True, slots=True)
class Run:
    """The trace of a robot that is localised in the maps, to be replayed with its beliefs.

    Attributes:
        trace: The trace of the robot. It may be the trace that was mapped.
        beliefs: A function that takes a map and returns the belief at each step, as Belief objects
            or as dicts from `Belief.to_dict`. It returns None for a map in which the robot was not
            localised.
    """

    trace: Trace
    beliefs: Callable[[SSHMap], Iterable[Any] | None] = field(repr=False)


def replays(
    maps: Sequence[SSHMap], labelings: Sequence[int], trace: Trace | None, run: Run | None
) -> list[dict[str, Any]]:
    """Make the replays for the slider of the page.

    Args:
        maps: The maps.
        labelings: For each map, the number of its labeling (the dstates of all steps).
        trace: The trace that was mapped; None if it is unknown.
        run: A run that is localised in the maps; None for none.

    Returns:
        A dict for each replay. The last one is the trace that was mapped. If `run` has another
        trace, it comes first.
    """
    first = maps[0]
    name = "the trace that was mapped"
    if trace is None:
        mapped = {"name": name, "steps": _steps_of_map(first)}
    else:
        views = [str(first.dstates[label].shown) for label in first.dstate_at]
        mapped = _replay(trace, name, views)
    if run is None:
        return [mapped]
    beliefs = _beliefs(maps, labelings, run)
    if run.trace == trace:
        return [{**mapped, "beliefs": beliefs}]
    unknown = ["not known"] * len(run.trace)
    other = _replay(run.trace, f"localised: {run.trace.name or 'another run'}", unknown)
    return [{**other, "beliefs": beliefs, "other": True}, mapped]


def _replay(trace: Trace, name: str, views: Sequence[str]) -> dict[str, Any]:
    """Make the replay of a trace.

    Args:
        views: For each step, the text to show if the step has no view.
    """
    replay: dict[str, Any] = {
        "name": name,
        "steps": [_step(step, view) for step, view in zip(trace.steps, views, strict=True)],
    }
    images = drawn_images(trace)
    return replay if images is None else {**replay, "images": images}


def _step(step: Step, view: str) -> dict[str, Any]:
    """Make a dict of what was observed at a step, and of the next action.

    Args:
        view: The text to show if the step has no view.
    """
    record: dict[str, Any] = {
        "view": view if step.view is None else str(step.view),
        "action": step.action.name if step.action else None,
    }
    if step.displacement is not None:
        record["moved"] = [round(number, 3) for number in step.displacement]
    if step.confidence is not None:
        record["confidence"] = round(step.confidence, 3)
    if step.gateways is not None:
        record["star"] = [
            [round(gateway.bearing, 1), gateway.open] for gateway in step.gateways.gateways
        ]
    return record


def _steps_of_map(first: SSHMap) -> list[dict[str, Any]]:
    """Reconstruct the views and actions of the trace from a map.

    An action is None if several actions join the two dstates.
    """
    actions: dict[tuple[int, int], list[str]] = {}
    for s, action, x in first.links:
        actions.setdefault((s, x), []).append(action)
    done = [actions.get(pair, []) for pair in pairwise(first.dstate_at)]
    names = [some[0] if len(some) == 1 else None for some in done]
    views: list[Any] = [first.dstates[label].shown for label in first.dstate_at]
    for fault in first.faults:
        if fault.kind == "misread" and fault.seen is not None:
            views[fault.step] = fault.seen
    return [
        {"view": str(view), "action": action}
        for view, action in zip(views, [*names, None], strict=True)
    ]


def _beliefs(maps: Sequence[SSHMap], labelings: Sequence[int], run: Run) -> dict[str, Any]:
    """Compute the beliefs of a run in the maps, as far as there is time.

    Maps with the same labeling have the same links, and therefore the same beliefs.

    Args:
        labelings: For each map, the number of its labeling.

    Returns:
        For the number of each labeling, as text, a belief for each step.

    Raises:
        MapError: The beliefs are malformed, or not one for each step.
    """
    found: dict[str, Any] = {}
    end = time.process_time() + BELIEVING
    tried: set[int] = set()
    for ssh_map, labeling in zip(maps, labelings, strict=True):
        if labeling in tried or (tried and time.process_time() > end):
            continue
        tried.add(labeling)
        beliefs = run.beliefs(ssh_map)
        if beliefs is None:
            continue
        listed = [belief if isinstance(belief, dict) else belief.to_dict() for belief in beliefs]
        if len(listed) != len(run.trace):
            raise MapError(
                f"beliefs: expected {len(run.trace)}, one for each step of the run, "
                f"got {len(listed)}; localise this run"
            )
        found[str(labeling)] = [_belief(belief, len(ssh_map.dstates)) for belief in listed]
    return found


def _belief(belief: dict[str, Any], count: int) -> list[Any]:
    """Shorten a belief to [verdict, nowhere, [[dstate, probability], …]], and check it.

    Args:
        belief: The belief as a dict from `Belief.to_dict`.
        count: The number of dstates of the map.
    """
    try:
        likely = sorted(
            ((int(s), float(p)) for s, p in belief["probabilities"]), key=lambda pair: -pair[1]
        )
        verdict, nowhere = str(belief["verdict"]), float(belief["nowhere"])
        if not all(0 <= s < count and 0 <= p <= 1 for s, p in likely) or not 0 <= nowhere <= 1:
            raise ValueError
    except (KeyError, TypeError, ValueError):
        raise MapError(
            f"beliefs: expected verdict, nowhere and probabilities of dstates 0 to {count - 1}, as "
            f"localise --json prints them, got something else; localise in these maps again"
        ) from None
    return [
        verdict,
        round(nowhere, 3),
        [[s, round(p, 3)] for s, p in likely[:BELIEVED] if p >= LEAST],
    ]
