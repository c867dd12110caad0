"""Who falls for a repeated wing? Our maps beside robust pose graphs of gtsam, on the same closures.

    python benchmarks/tournament.py [--seeds 7700-7723] [--work 6] [--save FILE] [--picture FILE]

Each drive (`wings.py`) has eight true closures, and four (even seeds) or eight (odd seeds) false
ones that agree with each other. The script prints each answer, and then the table.

A program *believes* a closure if a pose graph gives it a weight above 0.5, or if our map puts its
two ends at one place. An answer is *right* if it believes the true closures and no others, and
*wrong* if it believes a false one. Our map is *true* if its dstates and places are the true ones.
An answer is *sure* if its confidence is at least 0.95. GNC has no confidence, so each of its
answers counts as sure. In another row only those count that pass a chi-square test of the poses.

With --save, each judged answer is a line of FILE, and answers in FILE are not computed again.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable, Sequence, Set
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from typing import TypeAlias

import numpy as np
import pose_graphs
from arguments import add_number, seeds_from
from numpy.typing import NDArray
from pose_graphs import Fitted
from truth import SURE, is_true, partition
from wings import WingDrive, wings

from ssh_abduction import Solution, Theory, Trace, solve
from ssh_abduction.data.odometry import Pose
from ssh_abduction.solver import fit

# A pose graph believes a closure of more than this weight.
BELIEVED = 0.5
# The poses of a pose graph are rejected if a larger misfit is less probable.
REJECT = 0.01
# The false closures for each true one, of even and of odd seeds.
RATIOS = (0.5, 1.0)
THEORY = Theory.topological()
# How the picture shows the steps on the spine and in each wing: Okabe and Ito's colours.
KINDS = (("spine", "#999999", "."), ("first wing", "#0072B2", "s"), ("second wing", "#E69F00", "o"))
FALSE = "#D55E00"
HEAD = (
    "| program | right | wrong | wrong and sure | true map | false map, sure | true map listed | "
    "median CPU s |",
    "|---|---|---|---|---|---|---|---|",
)


@dataclass(frozen=True)
class Judged:
    """What a program says about a drive.

    Attributes:
        right: Whether it believes the true closures and no others.
        wrong: Whether it believes a false closure.
        sure: Whether it is sure of its answer.
        true: Whether its map is the true one; None if it makes no map.
        listed: Whether the true map is among the maps that it lists; None if it lists no maps.
        seconds: CPU seconds.
    """

    right: bool
    wrong: bool
    sure: bool
    true: bool | None = None
    listed: bool | None = None
    seconds: float = 0.0


# A program gets a drive and units of work. It returns what its answer says, for each row.
Program: TypeAlias = Callable[[WingDrive, float], dict[str, Judged]]


def judged(drive: WingDrive, believed: Set[int], sure: bool) -> Judged:
    """Judge which closures of a drive are believed."""
    true = set(range(len(drive.trace.closures))) - drive.false
    return Judged(believed == true, bool(believed & drive.false), sure)


def judged_graph(drive: WingDrive, fitted: Fitted, sure: bool) -> Judged:
    """Judge which closures a pose graph believes."""
    return judged(drive, {i for i, weight in enumerate(fitted.weights) if weight > BELIEVED}, sure)


def judged_map(drive: WingDrive, solution: Solution) -> Judged:
    """Judge the first map, and look for the true one among all maps and their rivals."""
    if not solution.maps:
        return replace(judged(drive, set(), sure=False), true=False, listed=False)
    first, closures = solution.maps[0], enumerate(drive.trace.closures)
    believed = {i for i, c in closures if first.place_of(c.first) == first.place_of(c.last)}
    true = partition(drive.known.dstates), partition(drive.known.places)
    rivals = solution.weighed.rivals if solution.weighed else ()
    listed = [(partition(rival.dstates), partition(rival.places)) for rival in rivals]
    found = true in listed or any(is_true(ssh_map, drive.known) for ssh_map in solution.maps)
    answer = judged(drive, believed, (solution.confidence or 0.0) >= SURE)
    return replace(answer, true=is_true(first, drive.known), listed=found)


def gnc(drive: WingDrive, work: float) -> dict[str, Judged]:
    fitted = pose_graphs.graduated(drive.trace)
    return {
        "gtsam, GNC": judged_graph(drive, fitted, sure=True),
        "the same, with a chi-square test": judged_graph(drive, fitted, fitted.p >= REJECT),
    }


def hybrid(drive: WingDrive, work: float) -> dict[str, Judged]:
    fitted = pose_graphs.hybrid(drive.trace)
    sure = (fitted.confidence or 0.0) >= SURE
    return {"gtsam, hybrid smoother": judged_graph(drive, fitted, sure)}


def ours(drive: WingDrive, work: float) -> dict[str, Judged]:
    solution = solve(drive.trace, THEORY, work_limit=work)
    return {"`solve`, with the closures": judged_map(drive, solution)}


def ours_without(drive: WingDrive, work: float) -> dict[str, Judged]:
    solution = solve(without_closures(drive.trace), THEORY, work_limit=work)
    return {"`solve`, without them": judged_map(drive, solution)}


def ours_told(drive: WingDrive, work: float) -> dict[str, Judged]:
    """Solve with the true closures only: what a program that sorts them could reach."""
    true = [c for i, c in enumerate(drive.trace.closures) if i not in drive.false]
    solution = solve(replace(drive.trace, closures=tuple(true)), THEORY, work_limit=work)
    return {"`solve`, told which closures are true": judged_map(drive, solution)}


def without_closures(trace: Trace) -> Trace:
    return replace(trace, closures=())


def drives_of(seeds: Sequence[int]) -> list[WingDrive]:
    return [wings(seed, RATIOS[seed % 2]) for seed in seeds]


def table(found: dict[str, list[Judged]]) -> str:
    """Sum up, in a row for each program."""
    rows = []
    for name, answers in found.items():
        counts = [
            sum(answer.right for answer in answers),
            sum(answer.wrong for answer in answers),
            sum(answer.wrong and answer.sure for answer in answers),
        ]
        maps = [answer for answer in answers if answer.true is not None]
        of_maps = [
            sum(bool(answer.true) for answer in maps),
            sum(answer.sure and not answer.true for answer in maps),
            sum(bool(answer.listed) for answer in maps),
        ]
        seconds = statistics.median(answer.seconds for answer in answers)
        cells = [*counts, *(of_maps if maps else "–––"), f"{seconds:.1f}"]
        rows.append(f"| {name} | {' | '.join(map(str, cells))} |")
    return "\n".join([*HEAD, *rows])


def draw(drives: Sequence[WingDrive], work: float, picture: Path) -> None:
    """Draw the first drive on which GNC is wrong: its truth, GNC's poses, and those of our maps."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    for drive in drives:
        fitted = pose_graphs.graduated(drive.trace)
        if judged_graph(drive, fitted, sure=True).wrong:
            break
    kept = sum(fitted.weights[i] > BELIEVED for i in drive.false)
    panels: list[tuple[str, Sequence[Pose]]] = [
        ("The drive, and its false closures", drive.poses),
        (f"GNC believes {kept} of {len(drive.false)} false closures", fitted.poses),
    ]
    for name, trace in (
        ("Our map", drive.trace),
        ("Our map without the closures", without_closures(drive.trace)),
    ):
        solution = solve(trace, THEORY, work_limit=work)
        fits = fit(trace, solution.maps[0]).poses
        at = [(fits[s].x, fits[s].y, fits[s].heading) for s in solution.maps[0].dstate_at]
        answer = judged_map(drive, solution)
        words = f"{'true' if answer.true else 'false'}, {'sure' if answer.sure else 'not sure'}"
        panels.append((f"{name}: {words}", at))
    figure, axes = plt.subplots(
        2, 2, figsize=(11, 7), layout="constrained", sharex=True, sharey=True
    )
    wing = np.array([drive.wing_of(t) for t in range(len(drive.poses))])
    for axis, (title, poses) in zip(axes.flat, panels, strict=True):
        at = _laid_on(poses, drive.poses)
        axis.plot(*at.T, color="#999999", linewidth=1)
        for number, (name, colour, marker) in enumerate(KINDS):
            axis.plot(*at[wing == number].T, marker, color=colour, label=name, markersize=7)
        axis.set(title=title, aspect="equal")
    bow = {"arrowstyle": "-", "connectionstyle": "arc3,rad=-0.3", "color": FALSE, "ls": "--"}
    for closure in (drive.trace.closures[i] for i in drive.false):
        ends = (drive.poses[t][:2] for t in (closure.first, closure.last))
        axes[0, 0].annotate("", *ends, arrowprops=bow)
    axes[0, 0].plot([], [], "--", color=FALSE, label="false closure")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    figure.supylabel("metres")
    figure.savefig(picture, dpi=100)


def _laid_on(poses: Sequence[Pose], truth: Sequence[Pose]) -> NDArray[np.float64]:
    """Move and turn the positions of poses as near to the true ones as possible, (n, 2)."""
    found, true = (np.array(some)[:, :2] @ [1, 1j] for some in (poses, truth))
    off, offset = found - found.mean(), true - true.mean()
    turn = np.vdot(off, offset)
    laid = off * turn / abs(turn) + true.mean()
    return np.column_stack([laid.real, laid.imag])


def programs_of() -> list[Program]:
    """List the programs; without gtsam, only ours."""
    own: list[Program] = [ours, ours_without, ours_told]
    if pose_graphs.installed():
        return [gnc, hybrid, *own]
    print("gtsam is not installed: pip install '.[bench]'")
    return own


def saved(path: Path) -> dict[tuple[str, str], dict[str, Judged]]:
    """Read the answers of earlier runs: for each drive and program, by the name of the row."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    return {
        (drive, program): {name: Judged(**one) for name, one in answers.items()}
        for drive, program, answers in map(json.loads, lines)
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument(
        "--seeds", type=seeds_from, default=range(7700, 7724), help="seeds, such as 7700-7723"
    )
    add_number(parser, "--work", "W", 6.0, "units of work for each map")
    parser.add_argument("--save", type=Path, metavar="FILE", help="keep answers in this file")
    parser.add_argument("--picture", type=Path, metavar="FILE", help="draw a drive into this file")
    options = parser.parse_args()
    drives = drives_of(options.seeds)
    programs = programs_of()
    found: dict[str, list[Judged]] = {}
    known = saved(options.save) if options.save else {}
    for drive, program in product(drives, programs):
        if (key := (drive.known.name, program.__name__)) not in known:
            began = time.process_time()
            answers = program(drive, options.work)
            seconds = time.process_time() - began
            known[key] = {name: replace(one, seconds=seconds) for name, one in answers.items()}
            record = [*key, {name: asdict(one) for name, one in known[key].items()}]
            print(json.dumps(record), flush=True)
            if options.save:
                with options.save.open("a", encoding="utf-8") as file:
                    file.write(f"{json.dumps(record)}\n")
        for name, one in known[key].items():
            found.setdefault(name, []).append(one)
    print(f"\n{table(found)}")
    if options.picture:
        draw(drives, options.work, options.picture)


if __name__ == "__main__":
    main()
