"""Maps of whole logs beside the skeleton of the metric map, under the same measures.

    python benchmarks/logs.py [LOG ...] [--plans FOLDER] --out rows.jsonl [--runs FOLDER]
                              [--page docs/measurements/logs.md]

The script prints tables in Markdown. With --plans, a robot is simulated in each floor plan of a
folder, one drive for each seed, and these logs are added. `ssh-abduction map` maps each log. Its
events (visits according to a mapper) and its first map are compared with the truth. The same is
done with skeletons of occupancy grids. One grid has the scans at their corrected poses, which a
robot does not have. The skeleton of this grid is judged without and with nodes at doors. The other
grid has the scans at the poses of the odometry, which any robot has. The method `pairs` counts
which pairs of visits and of travels the map joins, and which it should (`courses.py`). For drives
through floor plans, it also finds the rooms and doors that the map does not tell apart
(`rooms.py`). The truth of a simulated log NAME.log is in NAME.truth.json beside the log. Rows that
are stored are not measured again.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain, pairwise, product
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
from courses import counts_of, joins_of
from pages import print_rows, seeds_from
from rooms import rooms_and_doors, told_line, untold
from skeleton import lay, poses_of, skeleton_of
from truth import diagram, reliability
from visited import Events, Truth, judged, truth_of

from perception.readers.logs import read_log
from ssh_abduction import Solution, SSHMap, Trace
from ssh_abduction.data.map_file import read_json
from ssh_abduction.data.maps import maps_of

OURS = "ssh-abduction"
# For each skeleton: the poses of the scans in the grid, and whether doors are nodes.
SKELETONS = {
    "skeleton": ("corrected", False),
    "skeleton with doors": ("corrected", True),
    "skeleton, odometry": ("odometry", False),
}
# Pairs of visits and of travels in the map of `ssh-abduction`, and partings.
PAIRS = "pairs"
METHODS = (OURS, PAIRS, *SKELETONS)
HEAD = (
    "| log | mapper | places | events | events: precision, recall | passes noticed | "
    "accuracy | edges: precision, recall | pairs: joined, returns | pairs: precision, "
    "recall | CPU s |",
    "|---|---|---|---|---|---|---|---|---|---|---|",
)
HEAD_OF_PAIRS = (
    "| log | visits | places | visit pairs: right of joined (2 m) | found of true (1 m) | "
    "travel pairs: right of joined | found of true | partings with a visit | s |",
    "|---|---|---|---|---|---|---|---|---|",
)
SIMULATED = (
    "| mapper | logs | mapped | isomorphic | places right | doors noticed | passes "
    "noticed | places, median | accuracy, median | edges: precision, recall, medians | "
    "pairs: precision, recall, of all logs |",
    "|---|---|---|---|---|---|---|---|---|---|---|",
)


def name_of(log: Path) -> str:
    return log.name.partition(".")[0].removesuffix("-corrected")


def sidecar(log: Path) -> Path | None:
    """Find the file with the truth that the simulator wrote beside a log; None if there is none."""
    beside = log.with_name(f"{name_of(log)}.truth.json")
    return beside if beside.exists() else None


def driven(plans: Path, seeds: Sequence[int], runs: Path) -> Iterator[Path]:
    """Yield a log for each floor plan of a folder and each seed.

    A log that does not exist is simulated: a round of 200 m with the default odometer.

    Args:
        plans: Folder of the floor plans.
        seeds: Seeds of the drives through each plan.
        runs: Folder for the logs.
    """
    runs.mkdir(parents=True, exist_ok=True)
    for plan, seed in product(sorted(plans.glob("*.xml")), seeds):
        log = runs / f"{plan.stem.removesuffix('_updated')}-{seed}.log"
        if not log.exists():
            command = [
                sys.executable,
                "-m",
                "ssh_abduction",
                "simulate",
                str(plan),
                "--format",
                "carmen",
                "--seed",
                str(seed),
                "-o",
                str(log),
            ]
            subprocess.run(command, check=True, capture_output=True)
        yield log


def by_skeleton(log: Path, kind: str, doors: bool) -> Events:
    read = read_log(str(log))
    poses = poses_of(read, kind)
    passed = skeleton_of(read, poses, doors=doors).events(poses)
    return Events(tuple(scan for scan, _ in passed), tuple(node for _, node in passed))


def mapped(log: Path, runs: Path) -> tuple[Trace, SSHMap | None]:
    """Return the trace that `ssh-abduction map` made of a log, and its first map; None without one.

    The command is run unless its results exist.

    Args:
        log: The log.
        runs: Folder with a folder of results for each log.

    Raises:
        OSError, ValueError: There is no trace.
    """
    folder = runs / name_of(log)
    if not (folder / "maps.json").exists():
        command = [
            sys.executable,
            "-m",
            "ssh_abduction",
            "-q",
            "map",
            str(log),
            "-o",
            str(folder),
            "--set",
            "ladder=false",
        ]
        done = subprocess.run(
            command, check=False, capture_output=True
        )  # the exit code is not 0 if a map is not proven minimal
        if not (folder / "maps.json").exists():
            raise ValueError(
                done.stderr.decode(errors="replace").strip().rpartition("\n")[2]
                or f"map ended with {done.returncode}"
            )
    maps = maps_of(read_json(folder / "maps.json"), str(folder / "maps.json"))
    return Trace.load(folder / "trace.jsonl"), maps[0] if maps else None


def by_map(log: Path, runs: Path) -> Events:
    """Return the events of `ssh-abduction map` on a log, with their places in its first map.

    Raises:
        OSError, ValueError: There is no map.
    """
    trace, ssh_map = mapped(log, runs)
    if ssh_map is None:
        raise ValueError("no map")
    return Events.of(trace, ssh_map)


def known_truth(log: Path) -> Truth | None:
    """Find the truth of a log; None if it has neither corrected poses nor a file of truth."""
    try:
        return truth_of(log, sidecar(log))
    except ValueError as error:
        print(f"{name_of(log)}: judged without a truth: {error}", file=sys.stderr)
        return None


def pairs_row(log: Path, truth: Truth | None, runs: Path) -> dict[str, Any]:
    """Make the row of a log in the table of pairs. Without a truth it has only counts of the map.

    Args:
        log: The log.
        truth: Its truth; None if the log has no corrected poses.
        runs: Folder with a folder of results for each log.
    """
    row: dict[str, Any] = {
        "log": name_of(log),
        "method": PAIRS,
        "simulated": sidecar(log) is not None,
    }
    try:
        trace, ssh_map = mapped(log, runs)
    except (OSError, ValueError) as error:
        return row | {"failed": str(error)}
    run = read_json(runs / name_of(log) / "run.json")
    row |= {"visits": run["visits"], "seconds": sum(run["seconds"].values())}
    row |= {"status": run["status"], "places": None if ssh_map is None else len(ssh_map.places)}
    if truth is None:
        return row
    solution = Solution.load(runs / name_of(log) / "maps.json", trace)
    row |= {"confidence": solution.confidence, "joins": joins_of(trace, solution)}
    if truth.doors and ssh_map is not None and (beside := sidecar(log)) is not None:
        row["untold"] = untold(trace, ssh_map, *rooms_and_doors(json.loads(beside.read_text())))
    return row | counts_of(trace, ssh_map, truth.poses)


def row_of(log: Path, method: str, truth: Truth, runs: Path) -> dict[str, Any]:
    row = {"log": name_of(log), "method": method, "simulated": sidecar(log) is not None}
    began = process_time()
    try:
        events = by_map(log, runs) if method == OURS else by_skeleton(log, *SKELETONS[method])
    except (OSError, ValueError) as error:
        failed = row | {"failed": str(error)}
        trace = runs / name_of(log) / "trace.jsonl"
        if method == OURS and trace.exists():  # judge the events also without a map
            events = Events.of(Trace.load(trace))
            told = judged(replace(events, places=tuple(range(len(events.places)))), truth).to_dict()
            failed |= {
                name: told[name] for name in ("events", "event_precision", "event_recall", "passes")
            }
        return failed
    return row | {"seconds": process_time() - began, **judged(events, truth).to_dict()}


def shown(*values: float | None) -> str:
    return ", ".join("–" if value is None else f"{value:.2f}" for value in values)


def lines_of(row: dict[str, Any]) -> Iterator[str]:
    """Make the row of a recorded log and, if it has relations, one for pairs by relations."""
    if "failed" in row:
        came = "{1} of {0}".format(*row["passes"]) if "passes" in row else ""
        found = shown(row["event_precision"], row["event_recall"]) if came else ""
        told = f"{row['failed']} | {row.get('events', '')} | {found} | {came}"
        yield f"| {row['log']} | {row['method']} | {told} | | | | | |"
        return
    pairs, (come, noticed) = row["poses"], row["passes"]
    cells = [
        row["log"],
        row["method"],
        row["nodes"],
        row["events"],
        shown(row["event_precision"], row["event_recall"]),
        f"{noticed} of {come}",
    ]
    cells += [
        shown(row["accuracy"]),
        shown(row["edge_precision"], row["edge_recall"]),
        f"{pairs['joined']}, {pairs['returns']}",
    ]
    cells += [
        shown(pairs["precision"], pairs["recall"]),
        "–" if row["method"] == OURS else f"{row['seconds']:.1f}",
    ]
    yield "| " + " | ".join(map(str, cells)) + " |"
    if (pairs := row.get("relations")) is not None:
        counts = f"{pairs['joined']}, {pairs['returns']}"
        rates = shown(pairs["precision"], pairs["recall"])
        yield f"| by relations | {row['method']} | | | | | | | {counts} | {rates} | |"


def pairs_line(row: dict[str, Any]) -> str:
    """Make the row of a log, or the sum of many, in the table of pairs."""
    if "failed" in row:
        return f"| {row['log']} | {row['failed']} | | | | | | | |"
    cells = [row["log"], row["visits"], "no map" if row["places"] is None else row["places"]]
    if "visit_pairs" not in row:
        return "| " + " | ".join(map(str, [*cells, "–", "–", "–", "–", "–"])) + seconds_cell(row)
    pairs, travels, parted = row["visit_pairs"], row["travel_pairs"], row["partings"]
    for part, whole in (
        (pairs["right"], pairs["joined"]),
        (pairs["found"], pairs["true"]),
        (travels["right"], travels["joined"]),
        (travels["right"], travels["true"]),
        (parted["noticed"], parted["all"]),
    ):
        cells.append(f"{part} of {whole}")
    return "| " + " | ".join(map(str, cells)) + seconds_cell(row)


def seconds_cell(row: dict[str, Any]) -> str:
    return f" | {row['seconds']:.0f} |"


def total(rows: Sequence[dict[str, Any]], name: str) -> dict[str, Any]:
    """Add up the rows of logs with a truth, to a row with a name."""
    whole: dict[str, Any] = {"log": f"**{name}**"}
    rows = [row for row in rows if "visit_pairs" in row]
    for key in ("visits", "seconds"):
        whole[key] = sum(row[key] for row in rows)
    whole["places"] = sum(row["places"] or 0 for row in rows)
    for key in ("visit_pairs", "travel_pairs", "partings"):
        names = rows[0][key] if rows else ()
        whole[key] = {part: sum(row[key][part] for row in rows) for part in names}
    return whole


def simulated_line(method: str, rows: Sequence[dict[str, Any]]) -> str:
    """Make the row of one method in the table of simulated logs, from the rows of all logs."""
    done = [row for row in rows if "failed" not in row]
    if not done:
        return f"| {method} | {len(rows)} | 0 | 0 | 0 | | | | | | |"

    def median(name: str) -> float | None:
        return statistics.median([row[name] for row in done if row[name] is not None] or [0])

    joined, right, returns = (
        sum(row["poses"][name] for row in done) for name in ("joined", "right", "returns")
    )
    come, noticed = (sum(row["passes"][k] for row in done) for k in (0, 1))
    cells = [
        method,
        len(rows),
        len(done),
        sum(row["isomorphic"] for row in done),
        sum(row["places_right"] for row in done),
    ]
    cells += [
        shown(statistics.mean(row["event_recall"] for row in done)),
        f"{noticed} of {come}",
        median("nodes"),
        shown(median("accuracy")),
    ]
    cells += [
        shown(median("edge_precision"), median("edge_recall")),
        shown(right / joined if joined else None, right / returns if returns else None),
    ]
    return "| " + " | ".join(map(str, cells)) + " |"


def draw(path: Path, logs: Sequence[Path], runs: Path) -> None:
    """Draw each log with its skeleton and its first map into a file.

    The skeleton, of the grid at the corrected poses, is blue with squares. Places of the map are
    orange circles, and its events red points.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, panels = plt.subplots(
        2, math.ceil(len(logs) / 2), figsize=(5.5 * math.ceil(len(logs) / 2), 11), squeeze=False
    )
    for axes in panels.flat:
        axes.axis("off")
    for axes, log in zip(panels.flat, logs, strict=False):
        read = read_log(str(log))
        poses = poses_of(read, "corrected")
        lay(axes, skeleton_of(read, poses), poses)
        axes.set_title(name_of(log))
        try:
            events = by_map(log, runs)
        except (OSError, ValueError) as error:
            print(f"{name_of(log)}: {error}", file=sys.stderr)
            continue
        at = np.array(
            [poses[scan] for scan in events.scans] if events.poses is None else events.poses
        )[:, :2]
        middle = {
            place: at[[i for i, other in enumerate(events.places) if other == place]].mean(axis=0)
            for place in events.places
        }
        for here, there in pairwise(events.places):
            axes.plot(*np.array([middle[here], middle[there]]).T, color="tab:orange", linewidth=1.5)
        for place, (x, y) in zip(events.places, at, strict=True):
            axes.plot([x, middle[place][0]], [y, middle[place][1]], color="tab:red", linewidth=1)
            axes.plot(x, y, ".", color="tab:red", markersize=4)
        for number, (x, y) in enumerate(middle.values()):
            axes.annotate(
                str(number),
                (x, y),
                fontsize=8,
                ha="center",
                va="center",
                bbox={"boxstyle": "circle,pad=0.2", "fc": "tab:orange", "ec": "none"},
            )
    figure.tight_layout()
    figure.savefig(path, dpi=60)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("logs", nargs="*", type=Path, metavar="LOG")
    parser.add_argument(
        "--plans", type=Path, metavar="FOLDER", help="floor plans (.xml) to simulate drives in"
    )
    parser.add_argument(
        "--seeds",
        type=seeds_from,
        default=seeds_from("1-5"),
        metavar="FIRST-LAST",
        help="seeds of the drives through each plan (default: 1-5)",
    )
    parser.add_argument(
        "--out",
        type=Path,
        required=True,
        metavar="JSONL",
        help="file of rows; new rows are added",
    )
    parser.add_argument(
        "--runs",
        type=Path,
        default=Path("runs"),
        metavar="FOLDER",
        help="folder with a folder of results for each log (default: runs)",
    )
    parser.add_argument(
        "--methods",
        nargs="+",
        choices=METHODS,
        default=METHODS,
        help="mappers to judge (default: all)",
    )
    parser.add_argument(
        "--figure",
        type=Path,
        help="draw the given logs with their skeletons and maps into this file",
    )
    parser.add_argument("--page", type=Path, help="also write the tables into this page")
    options = parser.parse_args()
    rows = (
        [json.loads(line) for line in options.out.read_text().splitlines()]
        if options.out.exists()
        else []
    )
    known = {(row["log"], row["method"]) for row in rows}
    for log in chain(
        options.logs, driven(options.plans, options.seeds, options.runs) if options.plans else ()
    ):
        wanted = [method for method in options.methods if (name_of(log), method) not in known]
        truth = known_truth(log) if wanted else None
        for method in wanted:
            if method == PAIRS:
                rows.append(pairs_row(log, truth, options.runs))
            elif truth is not None:
                rows.append(row_of(log, method, truth, options.runs))
            else:
                continue
            with options.out.open("a") as file:
                print(json.dumps(rows[-1]), file=file)
    if options.figure:
        draw(options.figure, options.logs, options.runs)
    pairs = [row for row in rows if row["method"] == PAIRS]
    rows = [row for row in rows if row["method"] != PAIRS]
    if pairs:
        print_rows(
            [*HEAD_OF_PAIRS, *map(pairs_line, [*pairs, total(pairs, "all")])],
            options.page,
            r"\| log \| visits",
        )
        print(told_line(pairs))
        joins = [(p, right) for row in pairs for p, right in row.get("joins", ())]
        if joins:
            error, brier = reliability(joins)
            print(
                f"{len(joins)} joins, {sum(not right for _, right in joins)} of them false: "
                f"expected calibration error {error:.3f}, Brier score {brier:.3f} "
                f"({diagram(joins)})"
            )
    if not rows:
        return
    real = sorted(
        (row for row in rows if not row["simulated"]),
        key=lambda row: (row["log"], METHODS.index(row["method"])),
    )
    print_rows(
        [*HEAD, *(line for row in real for line in lines_of(row))],
        options.page,
        r"\| log \| mapper",
    )
    simulated = [row for row in rows if row["simulated"]]
    if simulated:
        by_method = [[row for row in simulated if row["method"] == method] for method in METHODS]
        print_rows(
            [*SIMULATED, *(simulated_line(rows[0]["method"], rows) for rows in by_method if rows)],
            options.page,
            r"\| mapper \| logs",
        )


if __name__ == "__main__":
    main()
