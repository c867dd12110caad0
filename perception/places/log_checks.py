"""Checks whether a log is one drive in order, with usable odometry in metres and radians.

The units of the odometry are recognised, and converted. The thresholds were measured on ten
recorded logs and ten simulated drives. No good log reaches any of them
(benchmarks/robustness.md). Each check says what is wrong and what to do.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from perception.errors import LogError
from perception.places import odometers
from perception.places.following import FAILING, contradicting_scans, follow, share_failing
from perception.places.track import Track, odometer_covariance, wrapped
from perception.readers.scans import RobotLog, Scan
from ssh_abduction.data.errors import named
from ssh_abduction.data.odometry import displacement_between
from ssh_abduction.data.words import counted

# Units of odometry, and how many make a metre.
UNITS = {"metres": 1.0, "millimetres": 1000.0, "centimetres": 100.0}
# STRETCH: number of scans over which odometry is compared with scan matching, at least LEAST_SCANS.
# UNLIKE: largest relative difference of the two.
STRETCH, LEAST_SCANS, UNLIKE = 80, 10, 0.25
# Scans do not match if matching fails for more than this share of them. In a wrong unit they may
# agree with the odometry, as it alone decides if nothing matches.
HOPELESS = 0.5
# Scans that are farther apart than SPARSE metres overlap too little, and those farther apart than
# FAR_OFF hardly overlap. Good logs have up to 1 m.
SPARSE, FAR_OFF = 1.5, 5.0
# Share of the way that the robot drives straight ahead by the headings of its odometry: good logs
# have 0.95 or more, reversed logs -0.99, headings in degrees at most 0.1. It is judged from
# LEAST_WAY metres on.
AHEAD, SIDEWAYS, LEAST_WAY = 0.9, 0.5, 10.0
# In a shuffled log, scans some steps apart are about as far apart as neighbours: the quartiles of
# their distances differ by at most this factor. In a drive, they grow with the number of steps. If
# two sources of odometry alternate, the lower quartile is that of one source.
LAGS, ALIKE = (2, 4, 8), 1.3
# If several lasers scan in turn, more than MIXED of MIXED_TRIED scans resemble the second to fourth
# scan before them ALIKE_ONE times as much as the last one. Ten logs have at most 1 %, also with
# only each eighth scan; two lasers have 7 % if one scans eight times as often as the other.
MIXED_TRIED, MIXED, ALIKE_ONE, IN_TURN = 200, 8, 3, (1, 2, 3, 4)
# In good logs, matches contradict the odometer in at most 2 % of the steps. A contradiction is a
# chi-square above CONTRADICTS (three degrees of freedom).
OVERRIDING, CONTRADICTS = 0.08, 25.0
# Scans with fewer beams often match badly. Of the scans of good logs over a half circle, 41 to 95 %
# fail to match with 20 beams, 0 to 35 % with 45, 0 to 7 % with 60, and at most 3 % with 90.
FEW_BEAMS = 90
# In good logs, the way by odometry over every second scan is at least 0.98 times the way over all.
TO_AND_FRO = 0.8
# A robot returns if it comes near a point where it was before, and drove at least AWAY metres in
# between. Near is within NEAR metres, plus DRIFT metres for each metre driven in between.
NEAR, DRIFT, AWAY = 3.0, 0.02, 15.0
# The laser is dark if DARK scans in a row show no wall.
DARK = 5
# Beams that meet walls are at most this many metres long, in the median of a log. Good logs have up
# to 3 m.
FAR_WALLS = 50.0
# In more than half of the scans of good logs, more than this share of the beams meets a wall.
MEETING = 0.02


def refuse_lengths(log: RobotLog) -> None:
    """Raise a LogError if the ranges of a log are too long to be metres."""
    lengths, shares = [], []
    for scan in log.scans:
        met = scan.ranges[(scan.ranges > 0) & (scan.ranges < scan.laser.reach)]
        lengths += [float(np.median(met))] if len(met) else []
        shares.append(len(met) / len(scan.ranges))
    reach = log.scans[0].laser.reach
    if np.median(shares) < MEETING and math.isfinite(reach):
        raise LogError(
            f"{named(log.source)}: expected beams that meet walls within the reach of the laser, "
            f"{reach:.4g} m, got hardly any in most scans; if the ranges are in centimetres or "
            "millimetres, divide them, or say how far the laser reaches (--set no_return=METRES)"
        )
    usual = float(np.median(lengths or [0.0]))
    if usual > FAR_WALLS:
        unit, count = ("millimetres", 1000) if usual > 10 * FAR_WALLS else ("centimetres", 100)
        raise LogError(
            f"{named(log.source)}: expected ranges in metres, got beams that are {usual:.0f} m "
            f"long in the median; if they are in {unit}, divide the ranges by {count}"
        )


def refuse_shuffled(log: RobotLog) -> None:
    """Raise a LogError if the scans of a log are in random order."""
    if len(log) < 4 * max(LAGS):
        return
    places = log.odometry[:, :2]
    next_to, *apart = (
        float(np.percentile(np.hypot(*(places[lag:] - places[:-lag]).T), 25)) for lag in (1, *LAGS)
    )
    if next_to == 0 or not all(next_to / ALIKE < far < next_to * ALIKE for far in apart):
        return
    back = odometers.times_back(log)
    clock = f", and their times run back {odometers.times(back)}" if back else ""
    raise LogError(
        f"{named(log.source)}: expected scans in the order of the drive, got {len(log)} in random "
        f"order: by the odometry, a scan is as far from the next one as from the eighth after it"
        f"{clock}; sort the log by time, or record it again"
    )


def refuse_mixed(log: RobotLog) -> None:
    """Raise a LogError if scans of several lasers come in turn, as if they were of one."""
    if len(log) <= max(IN_TURN) or odometers.usual_step(log) > SPARSE:
        return
    some = np.unique(np.linspace(max(IN_TURN), len(log) - 1, MIXED_TRIED).astype(int)).tolist()
    mixed = 0
    for k in some:
        last, *earlier = (odometers.change_between(log.scans[k - n], log.scans[k]) for n in IN_TURN)
        mixed += last > odometers.MOVED and min(earlier) < last / ALIKE_ONE
    if mixed > MIXED:
        raise LogError(
            f"{named(log.source)}: expected the scans of one laser, got those of several in turn, "
            f"with one mount: {100 * mixed / len(some):.0f} % of the scans are unlike the one "
            "before, and like an earlier one; keep the scans of one laser, or give each laser a "
            "frame of its own, with a transform"
        )


def checked(log: RobotLog) -> tuple[RobotLog, list[str], list[str]]:
    """Check whether a log is one drive in order, before its scans are matched. Raises LogError.

    Return the log with the odometry of a single source, in metres and radians; notes on what
    was converted; and notes on what is wrong with the whole log.
    """
    refuse_lengths(log)
    refuse_shuffled(log)
    refuse_mixed(log)
    log, alternating = odometers.keep_one_source(log)
    units, converted = units_of(log)
    log = units.convert(log)
    return log, [*alternating, *converted], describe_drive(log)


def describe_drive(log: RobotLog, begin: int = 0) -> list[str]:
    """Describe a log that is reversed, has several drives, or has scans far apart.

    `begin` is the number of the first scan.
    """
    return [
        *_about_order(log),
        *_about_odometry(log),
        *(_about_seam(log, scan, begin, what) for scan, what in odometers.seams_of(log)),
    ]


def _about_seam(log: RobotLog, scan: int, begin: int, what: str) -> str:
    """Describe a scan at which a second drive may begin."""
    where = f"{what} before scan {begin + scan} (line or message {log.scans[scan].line})"
    if math.dist(log.scans[scan - 1].odometry[:2], log.scans[scan].odometry[:2]) <= odometers.FAR:
        return (
            f"{where}, while the odometry goes on. If the file holds two drives, cut it there and "
            "map each part."
        )
    return (
        f"{where}, so the file seems to hold two drives. If they were in two buildings, cut the "
        "file there and map each part."
    )


def _about_order(log: RobotLog) -> list[str]:
    """Describe scans that are in reverse order, out of order, or too far apart."""
    notes, usual = [], odometers.usual_step(log)
    # Between scans that are far apart, the robot may have turned in any way.
    if usual <= FAR_OFF and way_of(log) >= LEAST_WAY and ahead(log) < -SIDEWAYS:
        notes.append(
            "The robot drives backwards all the way by its odometry, so the scans are probably in "
            "reverse order. Reverse the log, or turn the headings by half a circle."
        )
    back = odometers.times_back(log)
    if back > odometers.RUNS_BACK * len(log):
        notes.append(
            f"The times of the scans run back {odometers.times(back)} in {len(log)} scans. If the "
            "log is not in the order of time, sort it."
        )
    if usual > FAR_OFF:
        notes.append(
            f"The usual step between two scans is {usual:.0f} m by the odometry, so that they "
            "hardly overlap. Take all scans of the drive, at least one per metre. If they are "
            "closer together, the odometry does not count metres, or the log is not in order."
        )
    return notes


def _about_odometry(log: RobotLog) -> list[str]:
    """Describe odometry that is missing, alternates, or does not fit its own headings."""
    straight, usual = ahead(log), odometers.usual_step(log)
    back_and_forth = odometers.goes_back_and_forth(log)
    if odometers.is_missing(log) and odometers.moves_unseen(log):
        missing = odometers.stands_still(log)
        steps = f"{missing.sum()} of {counted(len(missing), 'steps')}"
        return [
            f"The odometry stands still in {steps}, while the scans show that the robot "
            "moved. So the map rests on the scans alone. Record the odometry, or name its topic "
            "(--set odom_topic)."
        ]
    if back_and_forth < TO_AND_FRO and 0 < usual <= FAR_OFF:
        return [
            "The odometry goes back and forth: over every second scan it is "
            f"{100 * back_and_forth:.0f} % as long as over all scans. Two programs may publish it, "
            "or the log is not in order. Stop one of them, or sort the log."
        ]
    if way_of(log) >= LEAST_WAY and abs(straight) <= SIDEWAYS and usual <= SPARSE:
        share = round(100 * straight)
        return [
            f"The robot drives {'backwards' if share < 0 else 'ahead'} for {abs(share)} % of its "
            "way by the odometry. Unless it can drive sideways, its headings are wrong: write them "
            "in radians, counterclockwise."
        ]
    return []


def judged(log: RobotLog, track: Track, explained: bool) -> tuple[Track, list[str]]:
    """Judge whether a track rests on poor matches, contradicts itself, or never returns.

    Return the track, which is marked if it is unreliable, and notes. If another note already
    gives a cause (`explained`), none is suggested here.
    """
    failing, overriding = share_failing(track), _overriding(log, track)
    is_reliable = failing <= FAILING and overriding <= OVERRIDING
    notes = _about_darkness(log, track)
    if not is_reliable:
        is_explained = explained and _beams_of(log) >= FEW_BEAMS
        notes.append(
            f"The track is unreliable: scan matching fails in {100 * failing:.0f} % of the scans, "
            f"and contradicts the odometry in {100 * overriding:.0f} % of the steps, where good "
            f"logs have 2 % at most. It is {track.way[-1]:.0f} m long. The map may be "
            f"wrong.{'' if is_explained else f' Do this: {advice(log)}.'}"
        )
    # If matching fails in much of the log, single contradictions say nothing more.
    elif contradictions := contradicting_scans(log, track):
        notes.append(
            f"The scans before and after scan {contradictions[0]} (line or message "
            f"{log.scans[contradictions[0]].line}) contradict each other"
            f"{f', and so at {len(contradictions) - 1} more' if contradictions[1:] else ''}. The "
            "robot may have been carried there, or the file may hold two drives: cut it there, and "
            f"map each part.{_about_gaps(log, contradictions)}"
        )
        is_reliable = False
    if track.way[-1] > 2 * AWAY and not returns(track):
        notes.append(
            f"In {track.way[-1]:.0f} m the robot never comes back to where it was before, at least "
            f"{AWAY:.0f} m earlier on its way. So no loop is closed, and nothing confirms the map. "
            "Drive each corridor twice, or end where the drive began."
        )
    return replace(track, is_reliable=is_reliable), notes


def _about_gaps(log: RobotLog, scans: Sequence[int]) -> str:
    """Say that scans which contradict those before them are far from these, if most of them are."""
    places = log.odometry[:, :2]
    gap = float(np.median([math.dist(places[i - 1], places[i]) for i in scans]))
    if gap <= SPARSE:
        return ""
    return (
        f" Or matching failed, as these scans are {gap:.1f} m apart: take all scans of the drive, "
        "at least one per metre."
    )


def _about_darkness(log: RobotLog, track: Track) -> list[str]:
    """Describe the first stretch of scans in which the laser sees no wall."""
    # A stretch begins and ends at an edge of the mask.
    edges = np.flatnonzero(np.diff([0, *np.isnan(track.shares), 0])).reshape(-1, 2)
    dark = [(begin, end) for begin, end in edges.tolist() if end - begin >= DARK]
    if not dark:
        return []
    (begin, end), more = dark[0], len(dark) - 1
    again = "one more stretch" if more == 1 else f"{more} more stretches"
    return [
        f"The laser sees no wall in {end - begin} scans, from scan {begin} (line or message "
        f"{log.scans[begin].line}) on{f', and in {again}' if more else ''}. The "
        "odometry alone says how the robot moved there. If the laser was covered while the robot "
        "was carried, cut the log there, and map each part."
    ]


def advice(log: RobotLog) -> str:
    """Say what to do about a log whose scans match badly."""
    usual = odometers.usual_step(log)
    if _beams_of(log) < FEW_BEAMS:
        return (
            f"record at least {FEW_BEAMS} beams per scan, as matching needs them; these scans have "
            f"{_beams_of(log):.0f}"
        )
    if odometers.is_missing(log):
        return (
            "record the odometry, or name its topic (--set odom_topic); matching alone needs "
            "scans that are a few centimetres apart"
        )
    if usual > SPARSE:
        return (
            f"take all scans of the drive, at least one per metre; these are {usual:.1f} m apart "
            "by the odometry. If they are not, the odometry does not count metres"
        )
    return (
        "put the scans into the order of the drive, and check the unit of the odometry and the "
        "direction of the beams (--set fov, --set mount). If these are right, record more scans "
        "per metre, or take a laser whose ranges are off by less than 5 cm"
    )


def _beams_of(log: RobotLog) -> float:
    """The number of beams of a scan, in the median."""
    return float(np.median([scan.laser.beams for scan in log.scans]))


def _overriding(log: RobotLog, track: Track) -> float:
    """The share of the steps in which matching contradicts the odometry."""
    count, unknown = 0, odometers.unmeasured(log).union(track.cuts)
    for i in range(1, len(log)):
        measured = displacement_between(log.scans[i - 1].odometry, log.scans[i].odometry)
        seen = displacement_between(track.pose(i - 1), track.pose(i))
        off = np.array([*np.subtract(seen[:2], measured[:2]), wrapped(seen[2] - measured[2])])
        spread = np.diag(odometer_covariance(measured))
        count += i not in unknown and float((off**2 / spread).sum()) > CONTRADICTS
    return count / max(len(log) - 1, 1)


def describe_missing_closures(track: Track) -> list[str]:
    """Say in a note that no closure was found, if the robot comes back to where it was."""
    said = (
        "By its track, the robot comes back to where it was, but no scans there match: no loop "
        "closure is found. So nothing corrects the drift of the track, and the map may show one "
        "place twice. If the robot did come back, check the scans and the odometry."
    )
    return [said] if returns(track, 2 * AWAY) else []


def returns(track: Track, away: float = AWAY) -> bool:
    """Whether the robot comes back to where it was at least `away` metres earlier on its way."""
    some = np.unique(np.searchsorted(track.way, np.arange(0.0, track.way[-1], 1.0)))
    places, way = track.poses[some, :2], track.way[some]
    for i in range(len(some)):
        gap = way[i] - way[:i]
        far = np.hypot(*(places[:i] - places[i]).T)
        if ((gap >= away) & (far <= NEAR + DRIFT * gap)).any():
            return True
    return False


@dataclass(frozen=True)
class Units:
    """The units of odometry."""

    count: float = 1.0  # how many units of length make a metre
    degrees: bool = False  # whether headings are in degrees

    def converted(self, scan: Scan) -> Scan:
        """Copy a scan, with its odometry in metres and radians."""
        if self == Units():
            return scan
        x, y, heading = scan.odometry
        heading = wrapped(math.radians(heading)) if self.degrees else heading
        return replace(scan, odometry=(x / self.count, y / self.count, heading))

    def convert(self, log: RobotLog) -> RobotLog:
        """Copy a log, with its odometry in metres and radians."""
        return log if self == Units() else replace(log, scans=tuple(map(self.converted, log.scans)))


def units_of(log: RobotLog) -> tuple[Units, list[str]]:
    """Recognise the units of a log's odometry. Also return notes on other units than m and rad."""
    count, counted = _length(log)
    log = Units(count).convert(log)
    degrees = way_of(log) >= LEAST_WAY and abs(ahead(log)) <= SIDEWAYS
    # The robot drives ahead by headings in the right unit only.
    degrees = degrees and ahead(Units(degrees=True).convert(log)) >= AHEAD
    turned = [
        "The headings of the odometry are read as degrees: by radians, the robot would drive "
        "sideways. Write them in radians to be sure."
    ]
    return Units(count, degrees), [*counted, *(turned if degrees else [])]


def _length(log: RobotLog) -> tuple[float, list[str]]:
    """Recognise from a stretch of the log how many units make a metre. Also return notes."""
    usual = odometers.usual_step(log)
    if usual <= SPARSE:
        return 1.0, []
    far = np.hypot(*np.diff(log.odometry[:, :2], axis=0).T)
    begin = int(np.argmax(far > usual / 2))
    stretch = replace(log, scans=log.scans[begin : begin + STRETCH])
    if len(stretch) < LEAST_SCANS:
        return 1.0, []

    # Relative difference between odometry in this unit and scan matching.
    def off(unit: str) -> float:
        tried = Units(UNITS[unit]).convert(stretch)
        seen = follow(tried)
        ways = [np.hypot(*np.diff(way[:, :2], axis=0).T) for way in (tried.odometry, seen.poses)]
        if seen.breaks or share_failing(seen) > FAILING:
            return math.inf
        return float(np.abs(ways[0] - ways[1]).sum() / max(ways[1].sum(), 1e-9))

    # Matching cannot correct metres that are too large to be true.
    offs = {unit: off(unit) for unit in UNITS if unit != "metres" or usual <= FAR_OFF}
    found = min(offs, key=offs.__getitem__)
    if found == "metres" or offs[found] > UNLIKE:
        return 1.0, []
    count = UNITS[found]
    return count, [
        "The odometry does not count metres: its usual step between two scans would be "
        f"{usual:.0f} m. It is read as {found}, which agrees with scan matching: "
        f"{usual / count:.2f} m per step."
    ]


def ahead(log: RobotLog) -> float:
    """Compute the share of the way that the robot drives ahead, from -1 (backwards) to 1.

    It is 1 for a robot that stands. Jumps of the odometer do not count.
    """
    poses = log.odometry
    steps = np.diff(poses[:, :2], axis=0)
    length = np.hypot(*steps.T)
    length[length > max(odometers.FAR, odometers.UNUSUAL * odometers.usual_step(log))] = 0.0
    if not length.any():
        return 1.0
    turns = (np.diff(poses[:, 2]) + math.pi) % math.tau - math.pi
    off = np.arctan2(steps[:, 1], steps[:, 0]) - poses[:-1, 2] - turns / 2
    return float((length * np.cos(off)).sum() / length.sum())


def way_of(log: RobotLog) -> float:
    """Compute the length of the drive by odometry, in metres."""
    return float(np.hypot(*np.diff(log.odometry[:, :2], axis=0).T).sum())
