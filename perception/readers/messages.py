"""Parses single lines of the logs of CARMEN, g2o and TORO."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perception.readers.lines import LONGEST_LINE
from ssh_abduction.data.errors import brief
from ssh_abduction.data.odometry import Pose

# Kinds of lines with scans. Many logs hold each scan in several kinds of lines, so the most
# informative kind comes first: with the geometry of the laser and poses, without the geometry,
# without poses.
KINDS = ("ROBOTLASER1", "FLASER", "RAWLASER1")
# The lines of a pose graph.
VERTICES, EDGES = (b"VERTEX2", b"VERTEX_SE2"), (b"EDGE2", b"EDGE_SE2")
# Largest number of beams of a scan.
MOST_BEAMS = 100_000
# Poses beyond this, in metres, are not poses of a robot in a building.
FARTHEST = 1e6
NAME = re.compile(rb"[A-Za-z][A-Za-z0-9_]*$")
_PARAMETERS = {
    b"robot_frontlaser_offset": "offset",
    b"robot_frontlaser_side_offset": "side",
    b"robot_frontlaser_angular_offset": "angle",
    b"robot_front_laser_max": "reach",
    b"laser_front_laser_fov": "fov",
}


class Damaged(Exception):  # noqa: N818 - becomes a Damage
    """A line or message of a known kind that cannot be read."""


@dataclass(frozen=True, slots=True)
class ScanLine:
    """A line that holds a scan."""

    kind: str  # first word of the line, one of KINDS
    ranges: NDArray[np.float64]  # (n,) ranges in metres
    # Bearing of the first beam and step between beams in radians, and reach in metres; None if the
    # line does not have them.
    shape: tuple[float, float, float] | None
    first: Pose | None  # first pose: the pose of the laser, or a corrected pose; None without poses
    second: Pose | None  # second pose: the pose of the robot; None without poses
    time: float | None  # seconds; None if missing
    after: int  # number of words after the poses


def words(raw: bytes | None) -> list[bytes]:
    """Split a line into words. None is a line that was too long to be read.

    Raises Damaged for such a line, or one that does not begin with the name of a message.
    """
    if raw is None:
        raise Damaged(f"expected a line of at most {LONGEST_LINE // 2**20} MiB, got a longer one")
    tokens = raw.split()
    if not tokens or tokens[0].startswith(b"#"):
        return []
    if not NAME.match(tokens[0]):
        raise Damaged(f"expected the name of a message, got {_quoted(tokens[0])}")
    return tokens


def scan_line(tokens: list[bytes]) -> ScanLine | None:
    """Parse a line with a scan; None for another kind of line. Raises Damaged."""
    kind = tokens[0].decode("ascii")
    if kind not in KINDS:
        return None
    # A FLASER line has only ranges and poses. Lines of other kinds begin with the geometry.
    if kind == "FLASER":
        beams, after = _ranges(tokens, 1)
        poses = after
        end = after + 6
        shape = None
    else:
        if len(tokens) < 9:
            raise Damaged(f"expected at least 8 values after {kind}, got {len(tokens) - 1}")
        start, step = number_of(tokens[2]), number_of(tokens[4])
        reach = number_of(tokens[5], may_be_infinite=True)
        if not 0 < abs(step) <= math.tau or abs(start) > 2 * math.tau:
            raise Damaged(f"expected a start and a step in radians, got {start:g} and {step:g}")
        shape = start, step, reach if reach > 0 else math.inf
        beams, after = _ranges(tokens, 8)
        poses = after + 1 + _whole(tokens[after] if after < len(tokens) else b"", "remissions")
        end = poses if kind == "RAWLASER1" else poses + 11
    if not end <= len(tokens) <= end + 3:
        raise Damaged(
            f"expected {end} to {end + 3} words in a {kind} of {len(beams)} beams, got "
            f"{len(tokens)}"
        )
    first = second = None
    if kind != "RAWLASER1":
        first, second = pose_at(tokens, poses), pose_at(tokens, poses + 3)
    return ScanLine(kind, beams, shape, first, second, time_at(tokens, end), len(tokens) - end)


def refuse_cut(tag: bytes, count: int, usual: int) -> None:
    """Raise Damaged if a line has fewer words than usual. Then its last number may be cut, too."""
    if count < usual:
        raise Damaged(
            f"expected at least {usual - count} more words, as most lines {tag.decode('ascii')} "
            "have, got the end of a line that was cut"
        )


def _ranges(tokens: list[bytes], at: int) -> tuple[NDArray[np.float64], int]:
    """Parse a count at index `at` and its ranges: metres, (n,), and the index after them."""
    count = _whole(tokens[at] if at < len(tokens) else b"", "beams")
    if count == 0:
        raise Damaged("expected at least one beam, got none")
    start = at + 1
    words = tokens[start : start + count]
    if len(words) < count:
        raise Damaged(f"expected {count} ranges, got {len(words)}")
    try:
        return np.array(list(map(float, words))), start + count
    except ValueError:
        wrong = next(word for word in words if not _is_number(word))
        raise Damaged(f"expected a range, got {_quoted(wrong)}") from None


def pose_at(tokens: list[bytes], at: int) -> Pose:
    """Parse the pose that begins at word `at`, in metres and radians. Raises Damaged."""
    if len(tokens) < at + 3:
        raise Damaged(
            f"expected a pose of three numbers after word {at}, got {max(0, len(tokens) - at)}"
        )
    x, y, heading = map(number_of, tokens[at : at + 3])
    if max(abs(x), abs(y)) > FARTHEST or abs(heading) > FARTHEST:
        raise Damaged(f"expected a pose in metres and radians, got {x:g} {y:g} {heading:g}")
    return x, y, heading


def vertex_of(tokens: list[bytes]) -> tuple[int, Pose]:
    """Parse the line of a vertex: its number and its pose. Raises Damaged."""
    return _whole(tokens[1] if len(tokens) > 1 else b"", "vertex"), pose_at(tokens, 2)


def edge_of(tokens: list[bytes]) -> tuple[tuple[int, int], Pose]:
    """Parse the line of an edge: the numbers of its vertices, and the motion. Raises Damaged."""
    if len(tokens) < 3:
        raise Damaged("expected an edge between two vertices, got fewer words")
    return (_whole(tokens[1], "vertex"), _whole(tokens[2], "vertex")), pose_at(tokens, 3)


def parameters_of(tokens: list[bytes]) -> dict[str, float]:
    """Return the parameter of the front laser, if any, by a short name such as "fov".

    `tokens` is a PARAM line of a CARMEN log. Raises Damaged if the value is no number.
    """
    if len(tokens) < 2 or tokens[1] not in _PARAMETERS:
        return {}
    return {_PARAMETERS[tokens[1]]: number_of(tokens[2] if len(tokens) > 2 else b"")}


def time_at(tokens: list[bytes], at: int) -> float | None:
    """Parse the time in seconds in word `at`.

    None if the time is missing or unreadable. That is no error, since times are not essential.
    """
    if at >= len(tokens) or not _is_number(tokens[at]):
        return None
    time = float(tokens[at])
    return time if math.isfinite(time) else None


def number_of(word: bytes, may_be_infinite: bool = False) -> float:
    """Parse a number. Raises Damaged if it is no number, or not finite unless `may_be_infinite`."""
    if not _is_number(word) or not (math.isfinite(value := float(word)) or may_be_infinite):
        raise Damaged(f"expected a finite number, got {_quoted(word)}")
    return value


def _whole(word: bytes, what: str) -> int:
    """Parse a whole number that is not negative and not too large. Raises Damaged."""
    if not (word.isdigit() and len(word) < 10) or (value := int(word)) > MOST_BEAMS * 1000:
        raise Damaged(f"expected a number ({what}), got {_quoted(word)}")
    return value


def _is_number(word: bytes) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _quoted(word: bytes) -> str:
    return brief(word[:40].decode("utf-8", "replace"), 40)
