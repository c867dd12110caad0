"""Draw figures of commands with matplotlib (the extra `plot`)."""

from __future__ import annotations

import importlib
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ssh_abduction.data.checks import needed
from ssh_abduction.data.errors import AbductionError
from ssh_abduction.data.files import write_file

BLUE, ORANGE, GREEN, GREY = "#0072b2", "#d55e00", "#009e73", "#888888"


def require_matplotlib() -> None:
    """Raise AbductionError if matplotlib cannot be loaded. Call this before hours of work."""
    try:
        with needed("plot", "matplotlib", "'.[plot]' in your clone"):
            importlib.import_module("matplotlib")
    except AbductionError:
        raise
    except Exception as error:  # matplotlib reads settings such as MPLBACKEND when it is loaded
        raise AbductionError(
            f"plot: expected matplotlib to load, got {type(error).__name__}: {error}; "
            "mend its settings"
        ) from None


def load_pyplot() -> Any:
    """Load matplotlib.pyplot and set the style of all figures."""
    require_matplotlib()
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    pyplot.rcParams.update(
        {"font.size": 9, "axes.spines.top": False, "axes.spines.right": False, "figure.dpi": 110}
    )
    return pyplot


def save_figure(figure: Any, path: str | Path) -> None:
    """Write a figure in the format of its file's ending, and close it."""
    drawn = io.BytesIO()
    figure.savefig(drawn, format=Path(path).suffix[1:].lower(), bbox_inches="tight")
    load_pyplot().close(figure)
    write_file(path, drawn.getvalue())


def draw_quality(
    path: str | Path, quality: Mapping[int, float], uncertainty: Mapping[int, float], chosen: int
) -> None:
    """Draw M for each k (number of clusters), and U, which may be unknown. Mark the chosen k."""
    figure, axes = load_pyplot().subplots(figsize=(5.5, 3.2))
    axes.plot(list(quality), list(quality.values()), "o-", color=BLUE, label="M")
    axes.axvline(chosen, color=GREY, linestyle=":", label=f"k = {chosen}")
    axes.set(xlabel="number of clusters k", ylabel="M: separation of clusters")
    if uncertainty:
        limits = min(0.7, *uncertainty.values()), 1.02
        right = right_axis(axes, [*uncertainty], [*uncertainty.values()], "U(v|x)")
        right.set(ylabel="U: views determined by dstates", ylim=limits)
    figure.legend(frameon=False, loc="lower center", bbox_to_anchor=(0.5, 0.9), ncols=3)
    save_figure(figure, path)


def right_axis(axes: Any, x: Sequence[float], y: Sequence[float], label: str) -> Any:
    """Draw a dashed curve against an axis on the right, and return the axis."""
    right = axes.twinx()
    right.plot(x, y, "s--", color=ORANGE, markersize=3, label=label)
    right.spines["right"].set_visible(True)
    return right


def draw_beliefs(path: str | Path, beliefs: Sequence[Mapping[str, Any]]) -> None:
    """Draw the entropy of each belief, and the probability that the robot is nowhere on the map.

    Beliefs are as `Belief.to_dict` returns them. Steps at which the robot was lost or nowhere
    are shaded.
    """
    pyplot = load_pyplot()
    figure, (upper, lower) = pyplot.subplots(
        2, 1, figsize=(7, 3.8), sharex=True, height_ratios=(2, 1)
    )
    # Shade the steps at which the robot was lost or nowhere, behind both curves.
    steps = np.arange(len(beliefs))
    edges = np.repeat(steps, 2) + np.tile([-0.5, 0.5], len(steps))
    for verdict, colour in (("lost", ORANGE), ("nowhere", GREY)):
        shaded = np.array([belief["verdict"] == verdict for belief in beliefs])
        label = verdict if shaded.any() else None
        style = {"color": colour, "alpha": 0.25, "linewidth": 0, "label": label}
        for axes in (upper, lower):
            style |= {"where": np.repeat(shaded, 2), "transform": axes.get_xaxis_transform()}
            axes.fill_between(edges, 0, 1, **style)
    entropy = np.array([belief["entropy"] for belief in beliefs])
    upper.plot(steps, entropy, "o-", color=BLUE, markersize=3, label="entropy")
    if any(collapsed := [belief["collapsed"] for belief in beliefs]):
        at, label = np.flatnonzero(collapsed), "the belief collapsed"
        upper.plot(at, entropy[at], "x", color="black", markersize=7, label=label)
    upper.set(ylabel="entropy, bits", ylim=(0, None))
    upper.legend(frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=4)
    lower.plot(steps, [belief["nowhere"] for belief in beliefs], color=BLUE)
    lower.set(xlabel="step", ylabel="p(nowhere)", ylim=(0, 1.03), xlim=(-0.5, len(steps) - 0.5))
    save_figure(figure, path)
