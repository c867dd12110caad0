"""Maps of whole logs, judged by the truth.

    python benchmarks/logs.py [LOG ...] [--plans FOLDER] --out rows.jsonl [--runs FOLDER]

The script prints tables in Markdown. With --plans, a robot is simulated in each floor plan of a
folder, one drive for each seed, and these logs are added. `ssh-abduction map` maps each log. The
method `pairs` counts which pairs of visits and of travels the map joins, and which it should
(`courses.py`). For drives through floor plans, it also finds the rooms and doors that the map does
not tell apart (`rooms.py`). The method `events` compares the events (visits according to the map)
with the true visits (`visited.py`). The truth of a simulated log NAME.log is in NAME.truth.json
beside the log. Rows that are stored are not measured again.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
from collections.abc import Iterator, Sequence
from itertools import chain, pairwise, product
from pathlib import Path
from typing import Any

import numpy as np
from arguments import seeds_from
from courses import counts_of, joins_of
from rooms import rooms_and_doors, told_line, untold
from skeleton import lay, poses_of, skeleton_of
from truth import diagram, reliability
from visited import Events, Truth, judged, truth_of

from perception.readers.logs import read_log
from ssh_abduction import Solution, SSHMap, Trace
from ssh_abduction.data.map_parts import read_json
from ssh_abduction.data.maps import maps_of

PAIRS, EVENTS = "pairs", "events"
HEAD_OF_EVENTS = (
    "| log | places | events | events: precision, recall | passes noticed | accuracy | "
    "edges: precision, recall | pairs: precision, recall |",
    "|---|---|---|---|---|---|---|---|",
)
HEAD_OF_PAIRS = (
    "| log | visits | places | visit pairs: right of joined (2 m) | found of true (1 m) | "
    "travel pairs: right of joined | found of true | partings with a visit | s |",
    "|---|---|---|---|---|---|---|---|---|",
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
    row["confidence"] = solution.confidence
    row["place_confidence"] = solution.weighed and solution.weighed.place_confidence
    row["joins"] = joins_of(trace, solution)
    if truth.doors and ssh_map is not None and (beside := sidecar(log)) is not None:
        row["untold"] = untold(trace, ssh_map, *rooms_and_doors(json.loads(beside.read_text())))
    return row | counts_of(trace, ssh_map, truth.poses)


def events_row(log: Path, truth: Truth, runs: Path) -> dict[str, Any]:
    """Compare the events of `ssh-abduction map` on a log with its truth."""
    row = {"log": name_of(log), "method": EVENTS}
    try:
        return row | judged(by_map(log, runs), truth).to_dict()
    except (OSError, ValueError) as error:
        return row | {"failed": str(error)}


def shown(*values: float | None) -> str:
    return ", ".join("–" if value is None else f"{value:.2f}" for value in values)


def events_line(row: dict[str, Any]) -> str:
    """Make the row of a log in the table of events."""
    if "failed" in row:
        return f"| {row['log']} | {row['failed']} | | | | | | |"
    cells = [
        row["log"],
        row["nodes"],
        row["events"],
        shown(row["event_precision"], row["event_recall"]),
        "{1} of {0}".format(*row["passes"]),
        shown(row["accuracy"]),
        shown(row["edge_precision"], row["edge_recall"]),
        shown(row["poses"]["precision"], row["poses"]["recall"]),
    ]
    return "| " + " | ".join(map(str, cells)) + " |"


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
        choices=(PAIRS, EVENTS),
        default=[PAIRS],
        help="measures (default: pairs)",
    )
    parser.add_argument(
        "--figure",
        type=Path,
        help="draw the given logs with their skeletons and maps into this file",
    )
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
                rows.append(events_row(log, truth, options.runs))
            else:
                continue
            with options.out.open("a") as file:
                print(json.dumps(rows[-1]), file=file)
    if options.figure:
        draw(options.figure, options.logs, options.runs)
    pairs = [row for row in rows if row["method"] == PAIRS]
    if pairs:
        print(*HEAD_OF_PAIRS, *map(pairs_line, [*pairs, total(pairs, "all")]), sep="\n")
        print(told_line(pairs))
        joins = [(p, right) for row in pairs for p, right in row.get("joins", ())]
        if joins:
            error, brier = reliability(joins)
            print(
                f"{len(joins)} joins, {sum(not right for _, right in joins)} of them false: "
                f"expected calibration error {error:.3f}, Brier score {brier:.3f} "
                f"({diagram(joins)})"
            )
    if events := [row for row in rows if row["method"] == EVENTS]:
        print(*HEAD_OF_EVENTS, *map(events_line, events), sep="\n")


if __name__ == "__main__":
    main()
