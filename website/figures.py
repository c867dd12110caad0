"""Draws the pictures of docs/explanation/how.md into docs/figures.

They show one simulated drive and one example.

    PYTHONPATH=benchmarks python website/figures.py
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path

os.environ["SOURCE_DATE_EPOCH"] = (
    "0"  # matplotlib writes a date into its files, which would differ from run to run
)

import matplotlib
import numpy as np
from paper_figures import draw_views, draw_world

from perception.images import images_of
from simulator.tours import simulate
from simulator.world import World
from ssh_abduction import Theory, Trace, solve
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.evaluation.figures import draw_quality
from ssh_abduction.learning.learner import BootstrapLearner
from ssh_abduction.output import to_svg

ROOT = Path(__file__).parent.parent
FIGURES = ROOT / "docs" / "figures"
EXAMPLES = ROOT / "examples"
# The stages of the loop: what goes in and comes out stands between the boxes.
STAGES = (("drive", "images"), ("cluster", "views"), ("solve", "map"), ("train", "recogniser"))


def loop() -> str:
    """The four stages in a row, with what flows between them, and back to the first."""
    parts = []
    for i, (stage, made) in enumerate(STAGES):
        x = 20 + 170 * i
        onward = "h70" if i < len(STAGES) - 1 else "h80 v60 H65 v-34"
        parts += [
            f'<rect x="{x}" y="40" width="90" height="40" rx="6" fill="#e3f0ee" stroke="#00796b"/>',
            f'<text x="{x + 45}" y="65">{stage}</text>',
            f'<path d="M{x + 90},60 {onward}" class="flow"/>',
            f'<text x="{x + 127}" y="52" class="made">{made}</text>',
        ]
    parts.append(
        '<text x="360" y="112" class="made">the robot knows its places, and drives on</text>'
    )
    style = (
        "text{font:13px sans-serif;text-anchor:middle}.made{font-style:italic;fill:#555}"
        ".flow{fill:none;stroke:#555;stroke-width:1.5;marker-end:url(#end)}"
    )
    head = (
        '<marker id="end" markerWidth="8" markerHeight="8" refX="6" refY="4" orient="auto">'
        '<path d="M0,0 L7,4 L0,8 z" fill="#555"/></marker>'
    )
    return (
        '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 720 140" width="720">'
        f"<style>{style}</style><defs>{head}</defs>{''.join(parts)}</svg>"
    )


def folded() -> SSHMap:
    """The map of the rectangle where no axiom tells its opposite corners apart."""
    return solve(
        Trace.load(EXAMPLES / "notched-rectangle.jsonl"), Theory(without=("side_of_branch",))
    ).maps[0]


@cache
def rivals() -> tuple[SSHMap, ...]:
    """The minimal maps of the ACES3 route."""
    return tuple(solve(Trace.load(EXAMPLES / "aces3-route.jsonl"), max_maps=None).maps)


DRAWN: dict[str, Callable[[], str]] = {
    "loop": loop,
    "folded": lambda: to_svg(folded()),
    "rival-1": lambda: to_svg(rivals()[0]),
    "rival-3": lambda: to_svg(rivals()[2]),
}


def draw_learning() -> None:
    """The world, the views and their number, of five tours."""
    matplotlib.rcParams.update({"svg.fonttype": "none", "svg.hashsalt": "how"})
    world = World.named("notched-rectangle")
    trace = simulate(world, tours=5, seed=3)
    learner = BootstrapLearner().fit(trace)
    truth = np.array([step.truth["dstate"] for step in trace.steps])
    images = images_of(trace)
    draw_world(FIGURES / "world.svg", world, [step.truth["pose"] for step in trace.steps])
    draw_views(FIGURES / "views.svg", images, learner.views_, truth)
    draw_quality(FIGURES / "quality.svg", learner.clusterer_.quality_, {}, learner.clusterer_.k_)


def main() -> int:
    FIGURES.mkdir(exist_ok=True)
    draw_learning()
    for name, drawing in DRAWN.items():
        (FIGURES / f"{name}.svg").write_text(drawing() + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
