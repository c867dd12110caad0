"""Are joint maps of several drives right, if each drive is a part of one log?

    python benchmarks/log_drives.py LOG … [--drives 2] [--limit 30]

Each log is cut by time into drives that share no scan. They are mapped together. Nothing is known
of where a drive starts. The script prints the pairs of visits that the joint map has at one place,
within drives and between drives. Corrected poses decide which pairs are right: true middles within
2 m. A pair within 1 m is truly one place.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations, pairwise
from pathlib import Path

from courses import ONE, SURE
from logs import name_of

from perception.readers.logs import read_log
from perception.readers.scans import RobotLog
from ssh_abduction import SSHMap, Trace, map_log
from ssh_abduction.data import drives_of
from ssh_abduction.evaluation import told_poses
from ssh_abduction.rivals import Listing, joins_of_drives


def parts_of(log: RobotLog, drives: int) -> list[RobotLog]:
    """Cut a log by time into drives with equally many scans."""
    bounds = [len(log) * k // drives for k in range(drives + 1)]
    return [replace(log, scans=log.scans[a:b]) for a, b in pairwise(bounds)]


def counts(trace: Trace, ssh_map: SSHMap | None) -> tuple[list[int], list[int]]:
    """Count pairs of visits within drives, and between drives: joined, right, true, found."""
    drive_of = {t: k for k, d in enumerate(drives_of(trace)) for t in range(d.first, d.stop)}
    starts = [t for t in range(len(trace)) if t == 0 or trace.actions[t - 1].kind != "turn"]
    told = told_poses(trace)
    within, between = [0] * 4, [0] * 4
    for i, j in combinations(starts, 2):
        far = math.dist(told[i][:2], told[j][:2])  # type: ignore[index]
        joined = ssh_map is not None and ssh_map.place_of(i) == ssh_map.place_of(j)
        row = within if drive_of[i] == drive_of[j] else between
        new = (joined, joined and far <= ONE, far <= SURE, joined and far <= SURE)
        row[:] = [count + one for count, one in zip(row, new, strict=True)]
    return within, between


def cells(found: Sequence[int]) -> str:
    joined, right, true, both = found
    return f"{right} of {joined} | {both} of {true}"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("logs", nargs="+", type=Path, metavar="LOG")
    parser.add_argument("--drives", type=int, default=2, metavar="N", help="parts of a log")
    parser.add_argument("--limit", type=float, default=30, metavar="S", help="seconds for each")
    options = parser.parse_args()
    print(
        "| log | drives joined | within drives: right of joined | found of true "
        "| between drives: right of joined | found of true | joins forced, possible | CPU s |"
        "\n|---|---|---|---|---|---|---|---|"
    )
    for path in options.logs:
        begin = time.process_time()
        done = map_log(
            parts_of(read_log(str(path)), options.drives),
            time_limit=options.limit,
        )
        maps = done.solution.maps
        within, between = counts(done.imported.trace, maps[0] if maps else None)
        pairs = joins_of_drives(Listing.of(done.solution)) if maps else ()
        kinds = [sum(len(getattr(p, kind)) for p in pairs) for kind in ("forced", "possible")]
        joined = "all" if maps and len(maps[0].pieces) == 1 else "not all" if maps else "no map"
        print(
            f"| {name_of(path)} | {joined} | {cells(within)} | {cells(between)} "
            f"| {kinds[0]}, {kinds[1]} | {time.process_time() - begin:.0f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
