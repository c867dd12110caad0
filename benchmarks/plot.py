"""Draw how time grows with the steps of a trace and the dstates of its map, from a stored run.

    python benchmarks/plot.py RESULTS.json [PICTURE]

The default picture is docs/figures/growth.png.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import statistics
from pathlib import Path
from typing import Any

import matplotlib as mpl
from table import instances, median_seconds

mpl.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.lines import Line2D

PICTURE = Path(__file__).parent.parent / "docs" / "figures" / "growth.png"
STYLES = {  # Colours (Okabe and Ito) and markers both differ, so that either is enough.
    "ssh-abduction": ("#000000", "o", "ssh-abduction"),
    "plain.lp": ("#D55E00", "s", "plain.lp"),
    "dfainductor": ("#0072B2", "^", "dfainductor"),
    "z3gi": ("#009E73", "D", "z3gi"),
    "RPNI": ("#E69F00", "v", "RPNI, not minimal"),
    "GSM": ("#CC79A7", "P", "GSM, not minimal"),
}
PANELS = (  # label of the axis, families of instances, and the range of numbers
    (
        "steps",
        "images",
        {
            "notched rectangle": (r"rectangle .*", "-"),
            "random machine, 8 states": (r"moore 8/2 .*", ":"),
            "maze 5x5": (r"maze 5x5 .*", "--"),
        },
        (1_000, 10_000, 100_000),
    ),
    (
        "dstates",
        "states",
        {
            "random machines, 2 views": (r"moore (8|12|20)/2 n=800|moore 50/2 .*", ":"),
            "mazes": (r"maze [2-5]x. n=1600|maze [68]x.*", "--"),
        },
        (10, 20, 50, 100, 200),
    ),
)
STEP_UP = 1.35  # factor between the heights of tools that are over the limit


def draw(results: dict[str, Any], picture: Path) -> None:
    """Draw the two panels, by steps and by dstates, into a file."""
    limit = results["limit"]
    top = limit * STEP_UP ** (len(STYLES) + 1)
    figure, axes = plt.subplots(1, 2, figsize=(11, 5), sharey=True, layout="constrained")
    for axis, (label, size, families, ticks) in zip(axes, PANELS, strict=True):
        for pattern, line in families.values():
            for level, (tool, (colour, marker, _)) in enumerate(STYLES.items(), 1):
                points = sorted(curve(results, pattern, tool, size))
                heights = [
                    seconds if seconds < math.inf else limit * STEP_UP**level
                    for _, seconds in points
                ]
                axis.plot(
                    [x for x, _ in points], heights, line, color=colour, alpha=0.6, linewidth=1.2
                )
                for (x, seconds), y in zip(points, heights, strict=True):
                    axis.plot(
                        x,
                        y,
                        marker,
                        color=colour,
                        markersize=6,
                        fillstyle="full" if seconds < math.inf else "none",
                    )
        axis.axhspan(limit, top, color="0.93", zorder=0)
        axis.text(
            0.01,
            0.985,
            f"not solved in {limit:g} s",
            transform=axis.transAxes,
            va="top",
            fontsize=9,
            color="0.35",
        )
        axis.set(xscale="log", yscale="log", xlabel=label, ylim=(None, top))
        axis.set_xticks(ticks, [f"{tick:,}" for tick in ticks])
        axis.grid(alpha=0.3)
        kinds = [
            Line2D([], [], color="0.3", linestyle=line, label=name)
            for name, (_, line) in families.items()
        ]
        axis.legend(handles=kinds, loc="lower right", fontsize=9)
    axes[0].set_ylabel("seconds")
    tools = [
        Line2D([], [], color=colour, marker=marker, linestyle="", label=name)
        for colour, marker, name in STYLES.values()
    ]
    figure.legend(handles=tools, loc="outside upper center", ncols=len(tools), frameon=False)
    figure.savefig(picture, dpi=110, metadata={"Software": None})
    plt.close(figure)


def curve(results: dict[str, Any], pattern: str, tool: str, size: str) -> list[tuple[float, float]]:
    """Collect the size and the median time of each instance of a family.

    Args:
        results: The stored run.
        pattern: Regular expression for the names of the instances.
        tool: Name of the tool.
        size: "images" for the number of images. "states" for the number of states: the proven one
            or, if none is proven, that of the true world.

    Returns:
        Size and seconds of each instance.
    """
    points = []
    for name, by_tool in instances(results).items():
        if re.fullmatch(pattern, name) and any("seconds" in cell for cell in by_tool.get(tool, [])):
            cells = [cell for others in by_tool.values() for cell in others]
            proven = [cell["dstates"] for cell in cells if cell.get("proven")]
            states = proven or [cell["true_dstates"] for cell in cells if cell.get("true_dstates")]
            images = [cell["images"] for cell in cells if cell.get("images")]
            points.append(
                (
                    statistics.median(images if size == "images" else states),
                    median_seconds(by_tool[tool]),
                )
            )
    return points


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("results", type=Path, metavar="RESULTS.json", help="a stored run")
    parser.add_argument(
        "picture",
        type=Path,
        nargs="?",
        default=PICTURE,
        metavar="PICTURE",
        help="file to draw into",
    )
    options = parser.parse_args()
    draw(json.loads(options.results.read_text(encoding="utf-8")), options.picture)


if __name__ == "__main__":
    main()
