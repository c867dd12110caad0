"""Make the replays of the page: the steps of traces, with images and a localised robot's beliefs.

A belief gives the probability that the robot is at each dstate (a place and a heading) of a map.

Images are laser ranges, all on one scale. Each number becomes one character, which
compresses better than digits. The alphabet has no character that HTML or JSON would escape.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from perception.errors import PerceptionError
from perception.images import images_held
from ssh_abduction.data.errors import MapError, TraceError, brief, is_finite, named
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Step, Trace

BELIEVING = 5.0  # processor seconds for beliefs in all maps except the first
# The largest number of dstates of a belief that are shown, and their least probability.
BELIEVED, LEAST = 12, 0.01
ALPHABET = "".join(chr(c) for c in range(35, 127) if chr(c) not in "&<>\\")
LOST = "!"  # a beam that measured nothing
MOST = 100_000  # characters of all images of a page
# The most beams of an image. If FEWEST beams per image are too many for the page, all images are
# left out.
BEAMS, FEWEST = 181, 24
# The longest range that is drawn, as a percentile of all ranges. The longest of all may be that of
# a corridor, which would make all rooms small.
FAR = 95
HALF = 180.0


@dataclass(frozen=True, slots=True)
class Run:
    """The trace of a robot that is localised in the maps, to be replayed with its beliefs."""

    # The trace of the robot. It may be the trace that was mapped.
    trace: Trace
    # A function that takes a map and returns the belief at each step, as Belief objects or as dicts
    # from `Belief.to_dict`. It returns None for a map in which the robot was not localised.
    beliefs: Callable[[SSHMap], Iterable[Any] | None] = field(repr=False)


def replays(
    maps: Sequence[SSHMap], labelings: Sequence[int], trace: Trace | None, run: Run | None
) -> list[dict[str, Any]]:
    """Make the replays for the slider of the page, a dict for each.

    The last one is the trace that was mapped, if known. If `run`, which is localised in the
    maps, has another trace, it comes first. `labelings` has, for each map, the number of its
    labeling (the dstates of all steps).
    """
    first = maps[0]
    name = "the trace that was mapped"
    views = [str(first.dstates[label].shown) for label in first.dstate_at]
    if trace is None:  # nothing but views is known
        mapped = {"name": name, "steps": [{"view": view, "action": None} for view in views]}
    else:
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
    """Make the replay of a trace."""
    replay: dict[str, Any] = {
        "name": name,
        "steps": [_step(step, view) for step, view in zip(trace.steps, views, strict=True)],
    }
    images = drawn_images(trace)
    return replay if images is None else {**replay, "images": images}


def _step(step: Step, view: str) -> dict[str, Any]:
    """Make a dict of what was observed at a step, and of the next action."""
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


def _beliefs(maps: Sequence[SSHMap], labelings: Sequence[int], run: Run) -> dict[str, Any]:
    """Compute the beliefs of a run in the maps, by labeling, as far as there is time.

    Maps with the same labeling have the same links, and therefore the same beliefs. Malformed
    beliefs raise MapError.
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
    """Check and shorten a belief to [verdict, nowhere, [[dstate, probability], …]]."""
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
            f"localise --json prints them, got something else; run localise with these maps"
        ) from None
    shown = [[s, round(p, 3)] for s, p in likely[:BELIEVED] if p >= LEAST]
    return [verdict, round(nowhere, 3), shown]


def beams_of(trace: Trace, count: int) -> tuple[float, float]:
    """Find the bearings of a number of laser beams of a trace.

    Return the bearing of the first beam in degrees counterclockwise from straight ahead, and
    the degrees from each beam to the next. The field `beams` of the trace's header gives them;
    TraceError if it is wrong. Without it, the beams cover the half circle ahead from right to
    left, as most scanners do. The first of an odd number of beams points straight to the right.
    The first of an even number is half a beam further to the left.
    """
    beams = trace.extra.get("beams")
    if beams is None:
        usual = HALF / (count - 1) if count % 2 and count > 1 else HALF / count
        return -usual * (count - 1) / 2, usual
    given = beams if isinstance(beams, dict) else {}
    first, step = given.get("first"), given.get("step")
    if not (is_finite(first) and is_finite(step) and step != 0) or (
        abs(step) * (count - 1) > 360 + 1e-6
    ):
        raise TraceError(
            f'{named(trace.source or "trace")}: beams: expected {{"first": degrees, "step": '
            f"degrees}}, counterclockwise from straight ahead, with which {count} beams go round "
            f"once at most, got {brief(beams)}; mend the header, or leave it out"
        )
    return float(first), float(step)


def drawn_images(trace: Trace) -> dict[str, Any] | None:
    """Encode the laser images of a trace.

    Returns:
        A dict with `images`, which has a text or None for each step; `first` and `step` (degrees
        counterclockwise); and `reach` (the metres that the last character of the alphabet means).
        None if the trace has no laser images that can be read, or too many for a page.
    """
    try:
        held = images_held(trace)
    except PerceptionError as error:
        warnings.warn(f"{error}; the page is made without images", stacklevel=2)
        return None
    known = [image for image in held if image is not None]
    if not known or "panorama" in trace.extra:
        return None
    most = max(len(image) for image in known)
    first, step = beams_of(trace, most)
    # Leave out beams until all images fit. If too few would remain, leave out the images.
    every = max(-(-most // BEAMS), -(-most * len(known) // MOST))
    if -(-most // every) < min(FEWEST, most):
        warnings.warn(
            f"{len(known)} images are more than a page holds; the page is made without images",
            stacklevel=2,
        )
        return None
    ranges = np.concatenate([image[np.isfinite(image) & (image > 0)] for image in known])
    reach = float(np.percentile(ranges, FAR)) if len(ranges) else 1.0
    return {
        "first": round(first, 3),
        "step": round(step * every, 4),
        "reach": round(reach, 2),
        "images": [None if image is None else _text(image[::every] / reach) for image in held],
    }


def _text(shares: NDArray[np.float64]) -> str:
    """Encode numbers from 0 to 1 as characters. A larger number counts as 1, NaN becomes LOST."""
    last = len(ALPHABET) - 1
    return "".join(
        LOST if math.isnan(x) else ALPHABET[round(last * min(max(x, 0.0), 1.0))]
        for x in shares.tolist()
    )
