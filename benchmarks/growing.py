"""Measure a map that grows while a robot drives: does it end as `import` of the whole log?

    python benchmarks/growing.py LOG... [--saves 3]

Each log is fed scan by scan, and saved and restored at random scans. A row has the processor time
of a scan (median, 99th percentile), of matching after a final visit (the worst), of saving and
restoring, and whether trace, poses and notes are those of `import`.
"""

from __future__ import annotations

import argparse
import random
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np

from perception.places.importing import import_log
from perception.places.live import LiveLog
from perception.readers.logs import read_log

Result = TypeVar("Result")


def timed(seconds: list[float], work: Callable[..., Result], *given: object) -> Result:
    """Call a function, and note its processor time."""
    begin = time.process_time()
    result = work(*given)
    seconds.append(time.process_time() - begin)
    return result


def row(path: str, saves: int, folder: Path) -> str:
    """Feed a log, and return the row of the table."""
    log, live = read_log(path), LiveLog()
    chosen = set(random.Random(7).sample(range(len(log)), saves))
    scan_s, match_s, save_s, load_s = ([0.0] for _ in range(4))
    for k, scan in enumerate(log.scans):
        _, visits = timed(scan_s, live.add, scan)
        if visits:
            timed(match_s, live.grown)
        if k in chosen:
            timed(save_s, live.save, folder)
            live = timed(load_s, LiveLog.load, folder)
    done, whole = live.finish(), import_log(log)
    same = (
        done.trace.steps == whole.trace.steps
        and done.trace.closures == whole.trace.closures
        and (done.poses == whole.poses).all()
        and done.notes == whole.notes
    )
    middle, high = np.percentile(scan_s, [50, 99]) * 1000
    cells = [
        Path(path).name.partition(".")[0],
        f"{len(log)}",
        f"{done.track.way[-1]:.0f} m",
        f"{middle:.0f} / {high:.0f} ms",
        f"{max(match_s):.2f} s",
        f"{max(save_s) * 1000:.0f} / {max(load_s) * 1000:.0f} ms",
        "yes" if same else "no",
    ]
    return f"| {' | '.join(cells)} |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("logs", nargs="+", metavar="LOG")
    parser.add_argument("--saves", type=int, default=3)
    options = parser.parse_args()
    print("| log | scans | way | scan | visit | save / restore | equal |")
    print("|---|---|---|---|---|---|---|")
    for path in options.logs:
        with tempfile.TemporaryDirectory() as folder:
            print(row(path, options.saves, Path(folder)), flush=True)


if __name__ == "__main__":
    main()
