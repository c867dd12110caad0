"""A recording for the viewer of rerun (rerun.io): the scans, the track and the map of a log.

The viewer shows the walls, the places with their names, the rooms, and the robot's way. Its slider
moves through the steps of the trace, with the robot and its scan at each step.
"""

from __future__ import annotations

import base64
import io
import os
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from ssh_abduction.data.checks import needed
from ssh_abduction.data.errors import AbductionError
from ssh_abduction.data.files import save_file
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.output.scene import colour_of
from ssh_abduction.page.content import Ground, beams_of

Array = NDArray[np.float64]

GREY, BLUE, RED = (138, 138, 138), (0, 114, 178), (213, 94, 0)
AHEAD = 0.8  # metres: the length of the arrow of the robot
UP = 0.02  # metres of a mark above the one below it


def save_recording(
    file: str | os.PathLike[str], name: str, ssh_map: SSHMap, trace: Trace, ground: Ground
) -> None:
    """Write a recording (.rrd).

    Args:
        file: The file.
        name: The name of the recording in the viewer.
        ssh_map: The map. Its places are drawn where the robot visited them.
        trace: The trace that was mapped.
        ground: What the laser saw, as the page of the map has it.

    Raises:
        AbductionError: The package rerun-sdk is missing, or the file cannot be written.
    """
    with needed("rerun", "rerun-sdk", "'.[rerun]' in your clone"):
        import rerun as rr
    seen: Any = ground.seen
    spots = np.array(seen["spots"])
    way = _raised(np.array(seen["way"]), 1)
    recording = rr.RecordingStream(name)
    save_file(file, b"", "recording", AbductionError)  # rerun ends in a traceback if it cannot
    recording.save(file)

    def log(path: str | list[str], *marks: Any) -> None:
        recording.log(path, *marks, static=True)

    log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
    log("/walls", rr.Points3D(_walls(seen), colors=GREY, radii=seen["grain"] / 2))
    log("/track", rr.LineStrips3D([way], colors=GREY))
    at = [ssh_map.dstates[label].place for label in ssh_map.dstate_at]
    numbers = sorted({place for place in at if place is not None})
    middle = {
        p: _raised(np.mean([spots[t, :2] for t in range(len(at)) if at[t] == p], axis=0), 3)
        for p in numbers
    }
    log(
        "/map/places",
        rr.Points3D(
            [*middle.values()],
            labels=[ssh_map.name_of("place", p) or f"p{p}" for p in numbers],
            colors=RED,
            radii=0.2,
        ),
    )
    ways = sorted(
        {
            (min(one, other), max(one, other))
            for one, other in pairwise(at)
            if one is not None and other is not None and one != other
        }
    )
    log("/map/ways", rr.LineStrips3D([[middle[p], middle[q]] for p, q in ways], colors=BLUE))
    for room in ssh_map.rooms:
        if room.outline:
            outline = _raised(np.array([*room.outline, room.outline[0]]), 2)
            colour = tuple(bytes.fromhex(colour_of(room.id)[1:]))
            mark = rr.LineStrips3D([outline], colors=colour)
            log(["map", "rooms", ssh_map.called("room", room.id)], mark)
    for t, (x, y, heading) in enumerate(spots):
        recording.set_time("step", sequence=t)
        ahead = AHEAD * np.array([np.cos(heading), np.sin(heading), 0.0])
        robot = rr.Arrows3D(origins=[_raised(np.array([x, y]), 4)], vectors=[ahead], colors=RED)
        recording.log("/robot", robot)
        points = _scan(trace, t, spots[t])
        recording.log("/scan", rr.Points3D(_raised(points, 2), colors=RED, radii=0.05))
    recording.flush()
    recording.disconnect()


def _raised(points: Array, layer: int) -> Array:
    """Give points of the plane a height, by which marks lie above each other."""
    height = np.full((*points.shape[:-1], 1), layer * UP)
    return np.concatenate([points, height], axis=-1)


def _walls(seen: Any) -> Array:
    """The middles of the points of the walls, in metres: (n, 3)."""
    picture = Image.open(io.BytesIO(base64.b64decode(seen["walls"].partition(",")[2])))
    rows, columns = np.nonzero(np.asarray(picture))
    left, top, *_ = seen["box"]
    points = np.stack([left + (columns + 0.5) * seen["grain"], top - (rows + 0.5) * seen["grain"]])
    return _raised(points.T, 0)


def _scan(trace: Trace, step: int, spot: Sequence[float] | Array) -> Array:
    """The points that the laser saw at a step, in metres: (n, 2); none if it has no scan."""
    image = trace.steps[step].image
    if not isinstance(image, tuple) or not image:
        return np.zeros((0, 2))
    ranges = np.array(image, dtype=float)
    first, between = np.radians(beams_of(trace, len(ranges)))
    angles = spot[2] + first + between * np.arange(len(ranges))
    near = ranges < ranges.max()  # a range that is the largest one has no echo
    away = np.stack([ranges * np.cos(angles), ranges * np.sin(angles)], axis=1)
    return np.asarray(spot[:2] + away[near])
